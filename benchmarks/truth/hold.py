"""A unit that sways and trembles while it is held."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from _hold import NAMES, SCALE, TRUTH, G, Hand, samples
from scenario import Scenario, Trial


def recording(time: np.ndarray, outputs: np.ndarray) -> Any:
    """Samples as a recording."""
    from imulab.recording import Recording

    columns = {"time": time} | {f"accel_{axis}": outputs[:, i].copy() for i, axis in enumerate("xyz")}
    return Recording(columns, dict.fromkeys(columns, "m/s^2") | {"time": "s"}, name="hand.csv")


def judged(record: Any, word: str) -> Trial:
    """What a record of order 1 states, against the truth; whether a warning has a word in it."""
    parameters = [record.parameters[name] for name in NAMES]
    error = np.array([p.value for p in parameters]) - TRUTH
    half = record.fit["coverage_factor_95"] * np.array([p.standard_uncertainty for p in parameters])
    return Trial(
        covered=tuple((np.abs(error) <= half).tolist()),
        warned=any(word in warning for warning in record.warnings),
        error=1e6 * float((error[3:6] / SCALE).mean()),
    )


def trial(seed: int, hand: Hand, word: str) -> Trial:
    """Fit one simulated test at order 1."""
    import imulab as il

    attitudes = il.find_attitudes(recording(*samples(seed, hand)))
    return judged(il.fit_tumble(attitudes, order=1, gravity=G).calibration, word)


def row(name: str, hand: Hand, word: str = "scatter less", trials: int = 60, **asked: Any) -> Scenario:
    """One scenario; the error is the mean of the three scale factors'."""
    return Scenario("Tumble: motion in a hold", name, partial(trial, hand=hand, word=word), trials, unit="ppm", **asked)


SWAY = {f"sway of {d} degrees rms": Hand(sway=np.radians(d)) for d in (0.3, 0.5, 1.0)}
SCENARIOS = [
    row("at rest", Hand(), coverage=(93.0, 98.5), false_alarms=5.0),
    *(row(name, hand, coverage=(93.0, 98.5), largest_error=10.0) for name, hand in SWAY.items()),
    row("shaken by 20 mg at 8 Hz", Hand(shake=0.02 * G), "shakes", 30, coverage=(93.0, 100.0)),
    row("trembles by 20 mrad at 8 Hz", Hand(tilt=0.02), "shakes", 30, coverage=None, warned=95.0),
    row("trembles by 50 mrad at 8 Hz", Hand(tilt=0.05), "shakes", 30, coverage=None, warned=95.0),
    row("at rest, no word of shaking", Hand(), "shakes", coverage=None, false_alarms=5.0),
]
