"""``imulab tumble check``: what a test of a record by fresh attitudes found, for people and for scripts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from imulab.cli.speech import coloured
from imulab.procedures.tumble.checkfigures import meaning, measured, next_step, of_magnetometers
from imulab.procedures.tumble.engineering import small_g
from imulab.records.json_text import json_text

if TYPE_CHECKING:
    from imulab.procedures.tumble.attitudes import Attitudes
    from imulab.procedures.tumble.compare import Check
    from imulab.procedures.tumble.mag.check import MagCheck
    from imulab.records.calibration import Calibration


def as_text(check: Check, attitudes: Attitudes, held: Calibration, record: str, file: str) -> str:
    """Return the verdict with its p, what to do next, and the residual of every attitude."""
    lines = [
        f"{coloured('pass' if check.passed else 'fail')}: {meaning(check)}",
        *next_step(check, record, file),
        measured(check, attitudes),
        *of_magnetometers(check, attitudes, held.model.get("field", {}).get("unit", "1")),
    ]
    for index, value in enumerate(check.residuals.tolist()):
        beyond = "  beyond the limit" if check.limit is not None and abs(value) > check.limit else ""
        expected = ""
        if check.standard_uncertainty is not None:
            expected = f" ± {small_g(check.standard_uncertainty[index])}"
        field = ""
        if check.mag is not None:
            field = f", |m| {100 * check.mag.magnitude[index]:+.2f} %, dip {np.degrees(check.mag.dip[index]):+.2f} deg"
        lines.append(f"{attitudes.label(index)}: {small_g(value)}{expected}{field}{beyond}")
    return "\n".join(lines)


def as_json(check: Check, attitudes: Attitudes, notes: Sequence[str]) -> str:
    """Return the same as JSON, in SI."""
    uncertainty = [None] * len(attitudes) if check.standard_uncertainty is None else check.standard_uncertainty.tolist()
    return json_text(
        {
            "verdict": "pass" if check.passed else "fail",
            "p": check.probability,
            "chi_square": check.chi_square,
            "degrees_of_freedom": len(attitudes),
            "limit": None if check.limit is None else {"value": check.limit, "unit": "m/s^2"},
            "gravity": check.gravity.entry(),
            "attitudes": [
                {"label": attitudes.label(i), "residual": value, "standard_uncertainty": u}
                for i, (value, u) in enumerate(zip(np.asarray(check.residuals).tolist(), uncertainty, strict=True))
            ],
            **({} if check.mag is None else {"mag": _of_mag(check.mag)}),
            "notes": [str(note) for note in notes],
        }
    ).rstrip()


def _of_mag(mag: MagCheck) -> dict[str, Any]:
    return {
        "p": mag.probability,
        "common": {
            name: {"value": value, "standard_uncertainty": u, "unit": unit}
            for name, value, u, unit in zip(
                ("magnitude", "dip"), mag.common.tolist(), mag.common_uncertainty.tolist(), ("1", "rad"), strict=True
            )
        },
        "magnitude": mag.magnitude.tolist(),
        "dip": {"value": mag.dip.tolist(), "unit": "rad"},
        "hard_iron_change": {"value": mag.hard_iron.tolist(), "p": mag.explained},
    }
