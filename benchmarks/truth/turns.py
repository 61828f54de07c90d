"""Gyroscopes calibrated by turns of a hand: slow beginnings, tremor, vibration, slow sampling, samples lost."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from _turns import Hand, turned_by_hand
from scenario import Scenario, Trial

GROUP = "Tumble: gyroscopes turned by hand"


def trial(seed: int, hand: Hand, word: str) -> Trial:
    """Fit one simulated test; the error is the mean of the three scale factors', ppm."""
    import imulab as il

    made, truth = turned_by_hand(seed, hand)
    record = il.fit_tumble(made, order=1, gravity=9.80665, with_="gyro").calibration
    covered, errors = [], []
    for name, value in truth.items():
        if "bias" in name:
            continue
        p = record.parameters[name]
        covered.append(abs(p.value - value) <= record.fit["gyro"]["coverage_factor_95"] * p.standard_uncertainty)
        if "scale" in name:
            errors.append(p.value / value - 1)
    warned = any(word in line for line in record.verdict.reasons)
    return Trial(tuple(covered), warned, 1e6 * float(np.mean(errors)))


def row(name: str, hand: Hand, word: str = "gyro", **asked: Any) -> Scenario:
    """One scenario of a hand."""
    asked = {"coverage": (92.0, 99.5), "false_alarms": 5.0, "trials": 10} | asked
    return Scenario(GROUP, name, partial(trial, hand=hand, word=word), unit="ppm", **asked)


DEGREE = np.radians(1.0)
SCENARIOS = [
    row("a quiet hand, raised cosine", Hand()),
    row("a quiet hand, minimum jerk", Hand(profile="minimum jerk")),
    row("a quiet hand, half sine", Hand(profile="half sine")),
    row("white noise of .3 deg/s a sample", Hand(noise=0.3 * DEGREE)),
    row("vibration of 1 deg/s at 23 Hz", Hand(vibration=DEGREE)),
    row("vibration of 1 deg/s at 23 Hz, minimum jerk", Hand(vibration=DEGREE, profile="minimum jerk")),
    row("tremor of .1 mrad at 8 Hz", Hand(tremor=1e-4)),
    row("tremor of .3 mrad at 8 Hz", Hand(tremor=3e-4)),
    row("tremor of 2 mrad at 8 Hz", Hand(tremor=2e-3)),
    row("tremor of .3 mrad, turns of 4 s", Hand(tremor=3e-4, turn=4.0)),
    row("sway of 1 mrad at .5 Hz", Hand(sway=1e-3)),
    row("flicker of .05 deg/s rms", Hand(flicker=0.05 * DEGREE)),
    row("g-sensitivity of .1 deg/s/g", Hand(felt=0.1 * DEGREE)),
    row("turns of .6 s", Hand(turn=0.6)),
    row("25 Hz, means, turns of 1 s", Hand(rate=25.0, turn=1.0)),
    row("25 Hz, points, turns of .6 s", Hand(rate=25.0, turn=0.6, points=True)),
    row("1 % of the samples lost", Hand(lost=0.01), "lost", warned=95.0, false_alarms=None),
    row("1 % of the samples lost, in tens", Hand(lost=0.01, run=10), "lost", warned=90.0, false_alarms=None),
    row(".3 % of the samples lost", Hand(lost=0.003), "lost", warned=95.0, false_alarms=None),
]
