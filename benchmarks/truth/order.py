"""The order of the model is chosen by imulab: do the stated intervals hold, whatever the nonlinearity is?"""

from __future__ import annotations

from functools import partial

import numpy as np
from _attitude_table import BIAS, SCALE, UG, fitted, inside, table
from scenario import Scenario, Trial

GROUP = "Tumble: order chosen from the data"
SOURCE = "intervals that hold for every nonlinearity are too wide for some: 92 % or more are asked in every case"


def run(seed: int, k2: float, k3: float, names: tuple[str, ...], stated: float | None) -> Trial:
    """Fit one table with every default."""
    recording, truth = table(np.random.default_rng(seed), k2=k2, k3=k3, stated=stated)
    record = fitted(recording)
    unit = UG if names == BIAS else 1e-6
    error = float(np.sqrt(np.mean([((record.value(name) - truth[name]) / unit) ** 2 for name in names])))
    return Trial(inside(record, truth, names), bool(record.fit["set_aside"]), error)


def case(name: str, k2: float, k3: float, names: tuple[str, ...], stated: float | None = 1.0) -> Scenario:
    """Return a scenario of 24 attitudes with 60 ug of noise."""
    of, unit = ("bias", "ug") if names[0].startswith("bias") else ("scale factor", "ppm")
    return Scenario(
        GROUP,
        f"{name}: {of}",
        partial(run, k2=k2, k3=k3, names=names, stated=stated),
        trials=80,
        coverage=(92.0, 100.0),
        false_alarms=1.0,
        unit=unit,
        source=SOURCE,
    )


SCENARIOS = [
    case("no nonlinearity", 0, 0, BIAS),
    case("no nonlinearity", 0, 0, SCALE),
    case("k2 of 40 ug/g^2", 40, 0, BIAS),
    case("k2 of 80 ug/g^2", 80, 0, BIAS),
    case("k3 of 60 ug/g^3", 0, 60, SCALE),
    case("k3 of 120 ug/g^3", 0, 120, SCALE),
    case("k2 of 80 ug/g^2 and k3 of 60 ug/g^3", 80, 60, BIAS),
    case("k2 of 40 ug/g^2, noise not stated", 40, 0, BIAS, None),
    case("k3 of 60 ug/g^3, noise not stated", 0, 60, SCALE, None),
]
