"""Parameters of a level are numbered: whether a number means the same level in two records."""

from __future__ import annotations

import re

from imulab.procedures.centrifuge.sections import centrifuge_of
from imulab.records.calibration import Calibration

_OF_A_LEVEL = re.compile(r"_(K|zeta|cross)_\d+$")
_SAME_LEVEL = 0.01


def same_meaning(name: str, first: Calibration, second: Calibration) -> bool:
    """Return whether a parameter is of the same thing in both records, as one of a level is where the levels agree."""
    if not _OF_A_LEVEL.search(name):
        return True
    levels = [
        [level.specific_force.value for level in (centrifuge_of(r).levels if "levels" in r.sections else ())]
        for r in (first, second)
    ]
    return len(levels[0]) == len(levels[1]) and all(
        abs(a - b) <= _SAME_LEVEL * abs(a) for a, b in zip(*levels, strict=True)
    )
