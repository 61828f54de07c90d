"""Accelerometers whose outputs have another unit than is stated, and whose zeros are off by 1 g and more."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from _attitude_table import BIAS, SCALE, UG, G, fitted, inside, table
from scenario import Scenario, Trial

GROUP = "Tumble: units and far zeros"


def run(seed: int, factor: float, offset: float) -> Trial:
    """Fit a table of outputs times `factor` with `offset`, g, on every axis; bad where they have another unit."""
    recording, truth = table(np.random.default_rng([seed, 5]))
    columns = {
        name: factor * (values + (offset * G if name.startswith("accel") else 0.0))
        for name, values in recording.columns.items()
    }
    for bias, scale in zip(BIAS, SCALE, strict=True):
        truth[bias] += offset * G / truth[scale]
    record = fitted(replace(recording, columns=columns))
    error = float(np.sqrt(np.mean([((record.value(name) - truth[name]) / UG) ** 2 for name in BIAS])))
    return Trial(inside(record, truth, BIAS), record.verdict.state == "bad", error)


def case(name: str, factor: float = 1.0, offset: float = 0.0) -> Scenario:
    """Return a scenario."""
    wrong = factor != 1.0
    return Scenario(
        GROUP,
        name,
        partial(run, factor=factor, offset=offset),
        trials=40,
        coverage=None if wrong else (93.0, 100.0),
        warned=95.0 if wrong else None,
        false_alarms=None if wrong else 1.0,
        unit="ug of bias",
    )


SCENARIOS = [
    case("as stated"),
    case("half of what is stated", factor=0.5),
    case("twice what is stated", factor=2.0),
    case("zeros at 1 g", offset=1.0),
    case("zeros at -2 g", offset=-2.0),
]
