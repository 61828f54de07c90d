"""Attitudes that were knocked: does the default find them, name them, and give the truth without them?"""

from __future__ import annotations

from functools import partial

import numpy as np
from _attitude_table import BIAS, SCALE, fitted, inside, table
from scenario import Scenario, Trial

GROUP = "Tumble: knocked attitudes"
SMALLEST, LARGEST = 3e3, 50e3  # ug


def run(seed: int, knocks: int, k2: float, count: int, stated: float | None) -> Trial:
    """Fit one table with every default; warned where every knocked attitude, and no other, is set aside and named."""
    rng = np.random.default_rng(seed)
    which = rng.choice(count, knocks, replace=False)
    sizes = rng.choice([-1, 1], knocks) * np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST), knocks))
    knocked = list(zip(which.tolist(), sizes.tolist(), strict=True))
    recording, truth = table(rng, count=count, k2=k2, stated=stated, knocks=knocked)
    record = fitted(recording)
    aside = {number - 1 for number in record.fit["set_aside"]}
    named = sum("set aside" in message for message in record.warnings) == len(aside)
    warned = bool(aside) if not knocks else named and aside == set(which.tolist())
    return Trial(inside(record, truth, (*BIAS, *SCALE)), warned)


def case(knocks: int, k2: float, count: int = 24, stated: float | None = 1.0) -> Scenario:
    """Return a scenario with 60 ug of noise."""
    of = "no attitude" if not knocks else f"{knocks} attitude{'s' if knocks > 1 else ''}"
    extra = "" if stated == 1.0 else ", noise not stated" if stated is None else ", noise stated at half"
    return Scenario(
        GROUP,
        f"{of} of {count} knocked by 3 to 50 mg, k2 of {k2:g} ug/g^2{extra}",
        partial(run, knocks=knocks, k2=k2, count=count, stated=stated),
        trials=40,
        coverage=(92.0, 100.0),
        warned=95.0 if knocks else None,
        false_alarms=None if knocks else 2.3,
        source="92 % after knocks, at most 2.3 % of sound attitudes set aside where noise is unknown or understated",
    )


SCENARIOS = [
    case(0, 40),
    case(1, 0),
    case(1, 1000),
    case(2, 40),
    case(3, 40),
    case(2, 40, count=48),
    case(0, 40, stated=None),
    case(1, 40, stated=None),
    case(0, 40, stated=0.5),
    case(1, 40, stated=0.5),
]
