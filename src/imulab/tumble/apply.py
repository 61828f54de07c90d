"""A tumble record applied: raw triad to specific force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.calibration import Calibration
from imulab.errors import RecordError, UnitError
from imulab.recording import Array, Recording
from imulab.tumble.model import AXES, MISALIGNMENTS, invert, parameter_names, parameter_units
from imulab.units import STANDARD_GRAVITY, conversion_factor, from_si, parse_unit

_FAR = 2.0


def apply_tumble(record: Calibration, recording: Recording) -> Recording:
    """Return the recording with accel_* as specific force, m/s^2, in the body frame of the record's gauge.

    Where record and recording both have a gyroscope triad, gyro_* become the body rate in that frame.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording has no accelerometer triad.
    """
    _parameters(record)
    factor = output_factor(recording.name, "accel", recording.triad_unit("accel"), str(record.model["output_unit"]))
    force = specific_force(record, recording.triad("accel") * factor)
    names = [f"accel_{axis}" for axis in AXES]
    corrected = recording.with_columns(
        {name: np.ascontiguousarray(force[:, i]) for i, name in enumerate(names)}, dict.fromkeys(names, "m/s^2")
    )
    if "gyro_output_unit" in record.model and all(f"gyro_{axis}" in recording for axis in AXES):
        return _apply_gyro(record, corrected, force)
    return corrected


def _apply_gyro(record: Calibration, recording: Recording, force: Array) -> Recording:
    """Return the recording with gyro_* as body rate, in their unit if that is one of rate, else in rad/s."""
    unit = recording.triad_unit("gyro")
    factor = output_factor(recording.name, "gyro", unit, str(record.model["gyro_output_unit"]))
    rate = body_rate(record, recording.triad("gyro") * factor, force)
    kept = unit if parse_unit(unit).quantity == "rate" else "rad/s"
    names = [f"gyro_{axis}" for axis in AXES]
    return recording.with_columns(
        {name: from_si(np.ascontiguousarray(rate[:, i]), kept) for i, name in enumerate(names)},
        dict.fromkeys(names, kept),
    )


def output_factor(name: str, sensor: str, unit: str, needed: str) -> float:
    """Return the factor from a triad's unit to the unit of the outputs that a record calibrates.

    Raises
    ------
    UnitError
        There is none; the message names the recording and both units.
    """
    try:
        return conversion_factor(unit, needed)
    except UnitError:
        raise UnitError(
            f"{name}: columns {' '.join(f'{sensor}_{axis}' for axis in AXES)} are in {unit}, "
            f"but the record calibrates outputs in {needed}"
        ) from None


def body_rate(record: Calibration, output: Array, force: Array) -> Array:
    """Return the body rate, rad/s, for gyroscope outputs in the record's unit and specific force, m/s^2; shapes (n, 3).

    ``w = T^-1 (M / S - b - G f)``.

    Raises
    ------
    RecordError
        The record lacks a parameter.
    """
    try:
        scale = np.array([record.value(f"gyro_scale_factor_{axis}") for axis in AXES])
        bias = np.array([record.value(f"gyro_bias_{axis}") for axis in AXES])
        misalignment = np.eye(3)
        for i, row in enumerate(AXES):
            for j, column in enumerate(AXES):
                if i != j:
                    misalignment[i, j] = record.value(f"gyro_misalignment_{row}{column}")
        sensed = output / scale - bias
        if "gyro_g_sensitivity_xx" in record.parameters:
            sensitivity = [[record.value(f"gyro_g_sensitivity_{i}{j}") for j in AXES] for i in AXES]
            sensed = sensed - force @ np.array(sensitivity).T
    except KeyError as error:
        raise RecordError(f"the record lacks {error.args[0]}") from None
    rate: Array = sensed @ np.linalg.inv(misalignment).T
    return rate


def specific_force(record: Calibration, output: Array) -> Array:
    """Return the specific force, m/s^2, for outputs in the record's unit; both of shape (n, 3).

    ``A = M / S - b``, the polynomial inverted by Newton's method, then ``f = T^-1 s``. NaN stays in what it touches; an
    output that lies beyond a turning point of the polynomial becomes NaN.

    Raises
    ------
    RecordError
        The record lacks a parameter, or has one that cannot be.
    """
    p = _parameters(record)
    reading = output / p.scale - p.bias
    for axis in range(3):
        low, high = _monotone_range(p.nonlinearity[:, axis])
        column = reading[:, axis]
        reading[:, axis] = np.where((column < low) | (column > high), np.nan, column)
    return invert(reading, p.misalignment, p.nonlinearity).force


def beyond_test(record: Calibration, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie far beyond the 1 g that the record was made at, and the largest, m/s^2.

    Counted only where the record has nonlinearity, which gravity has shown within 1 g and nowhere else.
    """
    p = _parameters(record)
    if not p.nonlinearity.size:
        return 0, 0.0
    factor = conversion_factor(recording.triad_unit("accel"), str(record.model["output_unit"]))
    reading = np.abs(recording.triad("accel") * factor / p.scale - p.bias)
    largest = np.where(np.isfinite(reading), reading, 0.0).max(axis=1, initial=0.0)
    return int(np.count_nonzero(largest > _FAR * STANDARD_GRAVITY)), float(largest.max(initial=0.0))


@dataclass(frozen=True)
class _Parameters:
    scale: Array
    bias: Array
    misalignment: Array
    nonlinearity: Array  # (order - 1, 3)


def _parameters(record: Calibration) -> _Parameters:
    try:
        order = record.model["order"]
        units = parameter_units(order, str(record.model["output_unit"]))
        for name, unit in zip(parameter_names(order), units, strict=True):
            if record.parameters[name].unit != unit:
                raise RecordError(f"the record has {name} in {record.parameters[name].unit!r}, expected {unit!r}")
        scale = np.array([record.value(f"scale_factor_{axis}") for axis in AXES])
        bias = np.array([record.value(f"bias_{axis}") for axis in AXES])
        misalignment = np.array([record.value(f"misalignment_{pair}") for pair in MISALIGNMENTS])
        nonlinearity = np.array([[record.value(f"k{p}_{axis}") for axis in AXES] for p in range(2, order + 1)])
    except KeyError as error:
        raise RecordError(f"the record lacks {error.args[0]}") from None
    except TypeError:
        raise RecordError(f"the record has order {record.model['order']!r}, expected a whole number") from None
    if not (scale != 0).all():
        raise RecordError("the record has a scale factor of 0")
    return _Parameters(scale, bias, misalignment, nonlinearity.reshape(order - 1, 3))


def _monotone_range(nonlinearity: Array) -> tuple[float, float]:
    """Readings between the turning points of ``s + k2 s^2 + ...`` next to zero."""
    powers = np.concatenate([[0.0, 1.0], nonlinearity])
    slope = np.polynomial.polynomial.polyder(powers)
    turns = np.polynomial.polynomial.polyroots(slope)
    real = turns[np.abs(turns.imag) < 1e-12 * np.maximum(np.abs(turns), 1.0)].real
    low, high = real[real < 0].max(initial=-np.inf), real[real > 0].min(initial=np.inf)
    ends = [float(np.polynomial.polynomial.polyval(s, powers)) if np.isfinite(s) else s for s in (low, high)]
    return ends[0], ends[1]
