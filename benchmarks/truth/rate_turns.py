"""Whole turns by hand: the Earth's rate, a tilted axis, and samples that are lost without a trace."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from _whole_turns import LATITUDE, Hand, session, unit
from scenario import Scenario, Trial

GROUP = "Whole turns by hand"


def trial(
    seed: int, hand: Hand, word: str = "", latitude: bool = False, force: bool = False, bias: bool = False
) -> Trial:
    """Fit one recording about z; whether a reason of the verdict has a word in it, any word where it is empty."""
    import imulab as il

    rng = np.random.default_rng(seed)
    truth = unit(rng)
    time, gyro, felt = session(rng, truth, hand)
    columns: dict[str, Any] = {"gyro": gyro} | ({"accel": felt} if force else {})
    units = {"gyro": "deg/s"} | ({"accel": "m/s^2"} if force else {})
    made = il.Recording.from_arrays(time=time, units=units, **columns)
    record = il.fit_turns(made, latitude=float(LATITUDE) if latitude else None).calibration
    name, true, factor = (
        ("gyro_bias_z", truth.zero[2], 1.0) if bias else ("gyro_scale_factor_z", truth.scale[2], 180 / np.pi)
    )
    p = record.parameters[name]
    value, u = p.value / factor, p.standard_uncertainty / factor
    low, high = (
        (value - 1.96 * u, value + 1.96 * u) if p.interval_95 is None else (end / factor for end in p.interval_95)
    )
    warned = any(word in reason for reason in record.verdict.reasons)
    error = np.degrees(value - true) * 3600 if bias else 1e6 * (value / true - 1)
    return Trial((bool(low <= true <= high),), warned, float(error))


def row(name: str, hand: Hand, trials: int = 60, coverage: Any = (93.0, 100.0), **asked: Any) -> Scenario:
    """One scenario."""
    limits = {key: asked.pop(key) for key in ("warned", "false_alarms", "largest_error") if key in asked}
    unit_of = "deg/h" if asked.get("bias") else "ppm"
    return Scenario(GROUP, name, partial(trial, hand=hand, **asked), trials, coverage, unit=unit_of, **limits)


BACK = Hand((1, -1) * 5)
SCENARIOS = [
    row("scale factor, three on and three back", Hand(), 100, false_alarms=4.0),
    row("scale factor, five times on and back", BACK, 100, false_alarms=4.0),
    row("bias, no latitude", Hand(), bias=True),
    row("bias, latitude", Hand(), bias=True, latitude=True),
    row("bias, latitude and accelerometers", Hand(), bias=True, latitude=True, force=True, largest_error=6.0),
    row("axis tilted by 0.5 deg", Hand(tilt=0.5)),
    row("axis tilted by 2 deg", Hand(tilt=2.0)),
    row("0.1 % of the samples lost", Hand(lost=0.001), coverage=(88.0, 100.0)),
    row("0.5 % of the samples lost", Hand(lost=0.005), coverage=(88.0, 100.0), word="lost", warned=75.0),
    row("0.5 % of the samples lost, five times on and back", Hand((1, -1) * 5, lost=0.005), word="lost", warned=80.0),
]
