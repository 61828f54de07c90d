"""The noise parameters of programs that use an IMU, by their keys and in their units: largest axis of each sensor.

Sources: Kalibr's ConfigReader.py; OpenVINS' Propagator.cpp; integration_base.h of VINS-Mono; PX4's covariance.cpp;
ArduPilot's AP_NavEKF3; GTSAM's CombinedImuFactor.cpp; MATLAB's documented units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from imulab.errors import OptionError, RecordError, listed
from imulab.procedures.noise.schema import NoiseSummary, fit_of
from imulab.records.calibration import Calibration

STEPS = {"px4": 0.010, "ardupilot": 0.012}
"""Time between predictions of the filters that take their noise by it, s: EKF2_PREDICT_US and EKF_TARGET_DT."""


@dataclass(frozen=True)
class Sizes:
    """Noise of a sensor in SI: white N_h and walk K_h for a filter, 1/f noise B, uncertainty u of a bias from a mean.

    `density` is the white noise N alone, from which the variance of a sample is computed.
    """

    white: float
    walk: float
    flicker: float
    bias: float
    density: float


def _continuous(s: Sizes, gyro: bool, rate: float, step: float) -> dict[str, float]:
    sensor = "gyroscope" if gyro else "accelerometer"
    return {f"{sensor}_noise_density": s.white, f"{sensor}_random_walk": s.walk}


def _vins(s: Sizes, gyro: bool, rate: float, step: float) -> dict[str, float]:
    sensor = "gyr" if gyro else "acc"
    return {f"{sensor}_n": s.white * math.sqrt(2 * rate), f"{sensor}_w": s.walk * math.sqrt(rate)}


def _px4(s: Sizes, gyro: bool, rate: float, step: float) -> dict[str, float]:
    sensor = "GYR" if gyro else "ACC"
    return {
        f"EKF2_{sensor}_NOISE": s.white / math.sqrt(step),
        f"EKF2_{sensor}_B_NOISE": s.walk / math.sqrt(step),
    }


def _ardupilot(s: Sizes, gyro: bool, rate: float, step: float) -> dict[str, float]:
    names = ("EK3_GYRO_P_NSE", "EK3_GBIAS_P_NSE") if gyro else ("EK3_ACC_P_NSE", "EK3_ABIAS_P_NSE")
    return dict(zip(names, (s.white / math.sqrt(step), s.walk / math.sqrt(step)), strict=True))


def _gtsam(s: Sizes, gyro: bool, rate: float, step: float) -> dict[str, float]:
    names = ("gyroscopeCovariance", "biasOmegaCovariance") if gyro else ("accelerometerCovariance", "biasAccCovariance")
    return dict(zip(names, (s.white**2, s.walk**2), strict=True))


def _ros(s: Sizes, gyro: bool, rate: float, step: float) -> dict[str, float]:
    name = "angular_velocity_covariance" if gyro else "linear_acceleration_covariance"
    return {name: s.density**2 * rate + s.bias**2}


def _matlab(s: Sizes, gyro: bool, rate: float, step: float) -> dict[str, float]:
    sensor, long = ("gyroparams", "Gyroscope") if gyro else ("accelparams", "Accelerometer")
    return {
        f"{sensor}.NoiseDensity": s.density,
        f"{sensor}.BiasInstability": s.flicker,
        f"{sensor}.RandomWalk": s.walk,
        f"insfilterMARG.{long}Noise": s.density**2 * rate,
        f"insfilterMARG.{long}BiasNoise": s.walk**2 / rate,
    }


PROGRAMS: dict[str, Callable[[Sizes, bool, float, float], dict[str, float]]] = {
    "kalibr": _continuous,
    "openvins": _continuous,
    "vins": _vins,
    "px4": _px4,
    "ardupilot": _ardupilot,
    "gtsam": _gtsam,
    "ros": _ros,
    "matlab": _matlab,
}
_WITH_RATE = ("kalibr", "openvins")


def check_program(program: str, called: str = "for") -> str:
    """Return the name of a program; raises OptionError where it is not known."""
    if program not in PROGRAMS:
        raise OptionError(f"{called} {program!r}: expected one of {listed(PROGRAMS, program)}")
    return program


def noise_for(
    record: Calibration, program: str, *, rate: float | None = None, step: float | None = None
) -> dict[str, float]:
    """Return the parameters of a program's filter for the noise in a record, by its keys.

    Parameters
    ----------
    record
        Of `fit_noise`.
    program
        One of `PROGRAMS`.
    rate
        Samples per second that the program is given, Hz; those of the record if not given.
    step
        Time between predictions of the filter, s; that of `STEPS` if not given.

    Raises
    ------
    OptionError
        The program is not known, or rate or step is not above 0.
    RecordError
        The record holds no gyroscope and no accelerometer in SI.
    """
    keys_of_program = PROGRAMS[check_program(program)]
    fit = fit_of(record)
    for name, value, unit in (("rate", rate, "Hz"), ("step", step, "s")):
        if value is not None and not value > 0:
            raise OptionError(f"{name} {value:g} {unit}: expected more than 0")
    f, d = rate or fit.sample_rate.value, step or STEPS.get(program, 0.01)
    keys: dict[str, float] = {}
    for unit, gyro in (("rad/s", True), ("m/s^2", False)):
        names = [name for name, column in fit.columns.items() if column.unit == unit]
        if names:
            keys |= keys_of_program(_largest(record, fit, names), gyro, f, d)
    if not keys:
        units = " ".join(dict.fromkeys(column.unit for column in fit.columns.values()))
        raise RecordError(
            f"{program}: expected gyroscopes in rad/s or accelerometers in m/s^2, found columns in {units}"
        )
    return keys | ({"update_rate": f} if program in _WITH_RATE else {})


def _largest(record: Calibration, fit: NoiseSummary, names: list[str]) -> Sizes:
    def largest(term: str) -> float:
        keys = [f"{name}_{term}" for name in names]
        return max((record.parameters[key].value for key in keys if key in record.parameters), default=0.0)

    return Sizes(
        max(fit.filter_white[name].value for name in names),
        max(fit.filter_walk[name].value for name in names),
        largest("flicker"),
        max(fit.bias_uncertainty[name].standard_uncertainty.value[-1] for name in names),
        largest("white"),
    )


def for_export(record: Calibration) -> dict[str, Any]:
    """Return white noise and walk of every column in the form of ``allan --json``, which exporters read."""
    fit = fit_of(record)
    return {
        "sample_rate": {"value": fit.sample_rate.value, "unit": "Hz"},
        "columns": {
            name: {
                "unit": column.unit,
                "angle_random_walk": {"value": fit.filter_white[name].value},
                "rate_random_walk": {"value": fit.filter_walk[name].value},
            }
            for name, column in fit.columns.items()
        },
    }
