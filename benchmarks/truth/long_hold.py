"""One hold that is much longer than the others, in a test whose attitudes scatter by more than the noise of a hold."""

from __future__ import annotations

from functools import partial

import numpy as np
from _attitude_table import BIAS, UG, G, directions, inside
from scenario import Scenario, Trial

import imulab as il
from imulab.recording import Recording

GROUP = "Tumble: a long first hold"
BLAMED = ("stands out", "set aside")


def run(seed: int, scatter: float, quiet: float) -> Trial:
    """Fit a table of 24 attitudes of 20 ug of noise, the first so many times quieter; `scatter` in ug is unstated."""
    rng = np.random.default_rng([seed, 11])
    up = directions(rng, 24)
    bias, scale = 0.02 * G * rng.standard_normal(3), 1 + 0.01 * rng.standard_normal(3)
    noise = np.full(24, 20 * UG)
    noise[0] /= quiet
    force = (G + scatter * UG * rng.standard_normal(24))[:, None] * up
    output = scale * (force + bias) + noise[:, None] * rng.standard_normal((24, 3))
    columns = {f"accel_{axis}": output[:, i].copy() for i, axis in enumerate("xyz")}
    columns |= {f"std_accel_{axis}": noise for axis in "xyz"}
    made = Recording(columns=columns, units=dict.fromkeys(columns, "m/s^2"), name="table", lines_before=1)
    record = il.fit_tumble(il.find_attitudes(made), gravity=G).calibration
    truth = dict(zip(BIAS, bias.tolist(), strict=True))
    error = float(np.sqrt(np.mean([(record.value(name) - truth[name]) ** 2 for name in BIAS]))) / UG
    return Trial(inside(record, truth, BIAS), any(word in w for w in record.warnings for word in BLAMED), error)


SCENARIOS = [
    Scenario(
        GROUP,
        f"scatter of {scatter} ug, first hold {quiet} times as quiet",
        partial(run, scatter=float(scatter), quiet=float(quiet)),
        trials=60,
        coverage=(93.0, 100.0),
        false_alarms=2.0,
        unit="ug of bias",
    )
    for scatter, quiet in ((0, 1), (200, 1), (200, 5), (200, 20))
]
