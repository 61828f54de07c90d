"""A scale factor that differs between positive and negative input, which looks like a quadratic term."""

from __future__ import annotations

from functools import partial

import numpy as np
from _attitude_table import BIAS, SCALE, UG, fitted, inside, table
from scenario import Scenario, Trial

GROUP = "Tumble: scale factors that differ between + and -"
SOURCE = "as for the order that is chosen from the data: intervals that hold for each size are too wide for some"


def run(seed: int, q: float, noise: float, count: int, names: tuple[str, ...], stated: float | None = 1.0) -> Trial:
    """Fit one table with every default."""
    recording, truth = table(np.random.default_rng([seed, 7]), q=q, noise=noise, count=count, stated=stated)
    record = fitted(recording)
    unit = UG if names == BIAS else 1e-6
    error = float(np.sqrt(np.mean([((record.value(name) - truth[name]) / unit) ** 2 for name in names])))
    return Trial(inside(record, truth, names), record.verdict.state != "good", error)


def case(q: float, noise: float, count: int = 24, names: tuple[str, ...] = BIAS, **more: float) -> Scenario:
    """Return a scenario: q in ppm, noise of an attitude in ug."""
    of, unit = ("bias", "ug") if names[0].startswith("bias") else ("scale factor", "ppm")
    return Scenario(
        GROUP,
        f"{f'± {q:g} ppm' if q else 'none'}, noise of {noise:g} ug, {count} attitudes: {of}",
        partial(run, q=q, noise=noise, count=count, names=names),
        trials=40,
        coverage=(more.get("least", 93.0), 100.0),
        false_alarms=3.0 if not q else None,
        unit=unit,
        source=SOURCE,
    )


SCENARIOS = [
    case(0, 20),
    case(0, 60),
    case(100, 20),
    case(200, 20),
    case(400, 20),
    case(1000, 20),
    case(400, 20, names=SCALE),
    case(100, 60),
    case(200, 60, least=90.0),  # q is hardly seen, and moves biases by 150 ug: 90.6 % of 1,800 intervals
    case(400, 60),
    case(1000, 60),
    case(400, 60, names=SCALE),
    case(200, 60, 48),
]
