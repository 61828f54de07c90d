"""The source's two experiments, over many seeds: every method with and without a calibrated start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imulab.device.methods import METHODS
from imulab.errors import OptionError, listed
from imulab.procedures.gyro_array.choices import EXPERIMENTS, OF_THE_SOURCE
from imulab.procedures.gyro_array.compare import rate_figures
from imulab.procedures.gyro_array.fit import calibrate_array
from imulab.procedures.gyro_array.fuse import FuseOptions, open_stream
from imulab.procedures.gyro_array.model import find_elements
from imulab.procedures.gyro_array.simulate import NoiseModel, simulate_array

CALIBRATION_TIME = 60.0
"""Duration of the recording at rest that a calibrated start comes from, s."""


@dataclass(frozen=True)
class ExperimentRow:
    """Medians over the seeds for one method: rate error, deg/s, and angle error, deg, each as std and largest."""

    method: str
    calibrated: bool
    rate_std: float
    rate_max: float
    angle_std: float
    angle_max: float


def run_experiment(
    experiment: str,
    *,
    seeds: int = 20,
    noise: NoiseModel | None = None,
    methods: tuple[str, ...] = METHODS,
    progress: Callable[[int], None] = lambda _: None,
) -> list[ExperimentRow]:
    """Run one of the source's set-ups (6 gyros) over many seeds.

    A calibrated start takes the biases, and for `covariance` and `kalman` the noise, from 60 s at rest before the run.

    Raises
    ------
    OptionError
        The experiment is unknown, or there is no seed.
    """
    if experiment not in OF_THE_SOURCE:
        raise OptionError(f"experiment {experiment!r}: expected one of {listed(OF_THE_SOURCE, experiment)}")
    if not 1 <= seeds <= 10_000:
        raise OptionError(f"seeds {seeds}: expected 1 to 10000")
    rate = EXPERIMENTS[experiment][0]
    found: dict[tuple[str, bool], list[tuple[float, float, float, float]]] = {}
    for seed in range(1, seeds + 1):
        recording = simulate_array(experiment=experiment, seed=seed, **vars(noise or NoiseModel()))
        # The stretch at rest comes first; the same gyros with the same turn-on biases.
        still = simulate_array(
            experiment="static",
            rate=rate,
            duration=CALIBRATION_TIME,
            session=1,
            seed=seed,
            **vars(noise or NoiseModel()),
        )
        record = calibrate_array(still).calibration
        elements = find_elements(recording)
        readings = elements.readings(recording)
        truth = elements.truth(recording)
        assert truth is not None
        for method in methods:
            for calibrated in (False, True):
                if method == "covariance" and not calibrated:
                    continue
                start = record if calibrated and method == "feedback" else "first"
                options = FuseOptions(
                    method=method,
                    initial_bias=start,
                    calibration=record if calibrated and method != "feedback" else None,
                )
                stream = open_stream(options, elements, rate, readings[:10_000])
                error = stream.process(readings, flags=False).rate[:, 0] - truth[:, 0]
                found.setdefault((method, calibrated), []).append(rate_figures(error, rate))
        progress(seed)
    return [
        ExperimentRow(method, calibrated, *map(float, np.median(np.array(values), axis=0)))
        for (method, calibrated), values in sorted(found.items(), key=lambda item: item[0][1])
    ]
