"""Calibrations over temperature whose recordings cannot show what disturbs them."""

from __future__ import annotations

from functools import partial

import numpy as np
from _thermal_oven import MG, POINTS, G, Oven
from scenario import Scenario, Trial

import imulab as il
from imulab.display import Note
from imulab.procedures.thermal.record import predict_parameters
from imulab.recording import Recording

GROUP = "Thermal"


def soaks(oven: Oven, *, both: bool) -> list[Recording]:
    """Return soaks at five set points, all reached by warming; or each from either side, as their heads say."""
    if both:
        back = [oven.soak(point, -1.0, stated=True) for point in POINTS[::-1]]
        return [oven.soak(point, stated=True) for point in POINTS] + back
    return [oven.soak(point) for point in (*POINTS, 0.0, 40.0)]


def trial(seed: int, *, both: bool = False, **disturbance: float) -> Trial:
    """Fit the soaks of one unit; quantities are biases at the set points, or scale factors where they scatter."""
    oven = Oven(np.random.default_rng(seed), **disturbance)
    calibration = il.fit_thermal(soaks(oven, both=both), gravity=G).calibration
    values, spread = predict_parameters(calibration, np.array(POINTS))
    truth = np.vstack([each.T for each in oven.truth(np.array(POINTS))])
    factor = []
    for name in ("bias_x", "scale_factor_x"):
        parameter = calibration.parameters[name]
        low, high = parameter.interval_95 or (-1.96, 1.96)
        factor += [(high - low) / 2 / (parameter.standard_uncertainty if parameter.interval_95 else 1.0)] * 3
    off = values[:6] - truth
    covered = np.abs(off) <= np.array(factor)[:, None] * spread[:6]
    warned = any(not isinstance(warning, Note) for warning in calibration.warnings)
    covered = covered[3:] if "scatter" in disturbance else covered[:3]
    return Trial(tuple(covered.ravel().tolist()), warned, float(np.sqrt(np.mean(off[:3] ** 2)) / MG))


def row(name: str, lowest: float, *, both: bool = False, **disturbance: float) -> Scenario:
    """Return a scenario of one disturbance, whose intervals hold the truth in `lowest` % at least."""
    return Scenario(
        GROUP, name, partial(trial, both=both, **disturbance), trials=12, coverage=(lowest, 100.0), false_alarms=4.0,
        unit="mg of bias",
    )  # fmt: skip


SCENARIOS = [
    row("soaks from one side, nothing disturbed", 93.0),
    row("elements 1.5 K behind the thermometer at the ends", 88.0, behind=1.5),
    row("a loop of 0.3 mg, soaks from one side: noted", 75.0, loop=0.3 * MG),
    row("scale factors that scatter by 100 ppm", 90.0, scatter=1e-4),
]
