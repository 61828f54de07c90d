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


def sine_trial(seed: int, table_noise: float, sweep: bool) -> Trial:
    """Fit a sine or a sweep of 100 deg/s whose recorded rate is noisy, deg/s; whether the verdict is not good."""
    import imulab as il

    rng = np.random.default_rng(seed)
    unit, time = triad(rng), np.arange(6000) / 100
    rate = 100 * np.sin(2 * np.pi * (0.05 * time + 1.95 / 120 * time**2 if sweep else 0.3 * time))
    out = np.degrees(unit.scale * (np.radians(rate)[:, None] * unit.turn[:, 2] + unit.zero))
    out += 0.1 * rng.standard_normal(out.shape)
    table = rate + table_noise * rng.standard_normal(len(rate))
    units = {"gyro": "deg/s", "table_rate": "deg/s"}
    made = il.Recording.from_arrays(time=time, gyro=out, table_rate=table, units=units)
    record = il.fit_rate(made, latitude=0.0).calibration
    p = record.parameters["gyro_scale_factor_z"]
    value = p.value / (180 / np.pi)
    low, high = p.interval_95 or (p.value - 1.96 * p.standard_uncertainty, p.value + 1.96 * p.standard_uncertainty)
    covered = bool(low <= unit.scale[2] * (180 / np.pi) <= high)
    return Trial((covered,), record.verdict.state != "good", float(1e6 * (value / unit.scale[2] - 1)))


def noisy(name: str, noise: float, sweep: bool, largest_error: float) -> Scenario:
    """One scenario of a noisy rate."""
    trial = partial(sine_trial, table_noise=noise, sweep=sweep)
    return Scenario(GROUP, name, trial, 40, (93.0, 100.0), false_alarms=4.0, largest_error=largest_error, unit="ppm")


def row(name: str, table: Table, trials: int = 12, **asked: Any) -> Scenario:
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
    noisy("sine, recorded rate exact", 0.0, False, 25.0),
    noisy("sweep, recorded rate exact", 0.0, True, 50.0),
    noisy("sine, recorded rate noisy by 2 deg/s of 100", 2.0, False, 500.0),
    noisy("sweep, recorded rate noisy by 2 deg/s of 100", 2.0, True, 500.0),
    noisy("sine, recorded rate noisy by 5 deg/s of 100", 5.0, False, 1200.0),
    noisy("sweep, recorded rate noisy by 5 deg/s of 100", 5.0, True, 1200.0),
]
