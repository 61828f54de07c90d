"""Rate tests: a loop of hysteresis, and what only seems to be one."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from _rate_table import LATITUDE, WAY, Table, run, triad
from scenario import Scenario, Trial

GROUP = "Rate table"


def loop_trial(seed: int, table: Table) -> Trial:
    """Fit one test of three faces; whether hysteresis was said, and the fitted loop of all axes off the true one."""
    import imulab as il
    from imulab.procedures.rate.schema import RateTest, Run
    from imulab.procedures.rate.simulate import RateRecordings

    rng = np.random.default_rng(seed)
    unit = triad(rng)
    recordings, runs = [], []
    for axis in range(3):
        for cycle in range(table.cycles):
            time, out = run(rng, unit, table, axis)
            name = f"{'xyz'[axis]}{cycle}.csv"
            units = {"gyro": "deg/s"}
            recordings.append(il.Recording.from_arrays(time=time, gyro=out, units=units, name=name))
            runs.append(Run(name, f"+{'xyz'[axis]}", tuple(np.radians(WAY).tolist())))
    test = RateTest(tuple(runs), 1e-4, mounting_uncertainty=3e-4, latitude=float(LATITUDE))
    fit = il.fit_rate(RateRecordings(test, tuple(recordings), {}))
    warned = any("hysteresis" in reason for reason in fit.calibration.verdict.reasons)
    pairs = [line.fitted_loop for line in fit.linearity.values() if line.fitted_loop is not None]
    covered = tuple(abs(value - table.loop) <= 1.96 * u for value, u in pairs)
    return Trial(covered, warned, float(np.mean([1e6 * (value - table.loop) for value, _ in pairs])))


def row(name: str, table: Table, trials: int = 20, **asked: Any) -> Scenario:
    """One scenario of hysteresis."""
    return Scenario(GROUP, name, partial(loop_trial, table=table), trials, unit="ppm of the loop", **asked)


SAID: dict[str, Any] = {"coverage": None, "warned": 95.0}
QUIET: dict[str, Any] = {"coverage": (93.0, 100.0), "false_alarms": 4.0}
SCENARIOS = [
    row("no loop, one cycle", Table(), 30, **QUIET),
    row("no loop, three cycles", Table(cycles=3), 10, **QUIET),
    *(row(f"loop of {loop} ppm, one cycle", Table(1e-6 * loop), **SAID) for loop in (100, 200, 1000)),
    row("loop of 200 ppm, three cycles", Table(2e-4, cycles=3), 8, **SAID),
    row("play of 200 ppm, one cycle", Table(2e-4, "play"), **SAID),
    row("loop of 200 ppm that is pointed, one cycle", Table(2e-4, "triangle"), **SAID),
    row("zeros that walk by 0.001 deg/s/sqrt(s), one cycle", Table(walk=1e-3), 30, coverage=None, false_alarms=4.0),
    row("scale factors that drift by 200 ppm, one cycle", Table(drift=2e-4), 20, coverage=None, false_alarms=4.0),
]
