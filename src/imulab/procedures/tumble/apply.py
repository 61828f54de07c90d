"""A tumble record applied: raw triads to specific force and body rate, by the C core."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.columns import triad
from imulab.device.unit import DeviceUnit
from imulab.errors import DataError, UnitError
from imulab.procedures.tumble.device import tables_of
from imulab.procedures.tumble.model import AXES
from imulab.procedures.tumble.sections import model_of
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import STANDARD_GRAVITY, conversion_factor, from_si, parse_unit, to_si

_FAR = 2.0
_ACCEL = triad("accel")
_GYRO = triad("gyro")
_MAG = triad("mag")


def apply_tumble(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with accel_* as specific force, m/s^2, in the body frame of the record's gauge.

    NaN stays in what it touches; an output that lies beyond a turning point of the polynomial becomes NaN.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording has no accelerometer triad.
    """
    force, _ = unit.tumble(_outputs(recording, "accel", str(columns["output_unit"])))
    return recording.with_columns(dict(zip(_ACCEL, force, strict=True)), dict.fromkeys(_ACCEL, "m/s^2"))


def apply_gyro(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with gyro_* as body rate, in their unit if that is one of rate, else in rad/s.

    accel_* are the specific force (already corrected), which the g-sensitivity needs.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording lacks a gyroscope, or the accelerometers that the record's g-sensitivity needs.
    """
    outputs = _outputs(recording, "gyro", str(columns["output_unit"]))
    kept = parse_unit(recording.triad_unit("gyro"))
    kept_unit = kept.symbol if kept.quantity == "rate" else "rad/s"
    force = None
    if any(name in recording for name in _ACCEL):
        force = [to_si(recording.column(name), recording.units[name]) for name in _ACCEL]
    elif np.isnan(unit.gyro([np.zeros(1)] * 3, None)[0][0][0]):
        raise DataError(
            f"{recording.name}: the record corrects the gyroscopes' g-sensitivity, which needs accel_x, accel_y and "
            f"accel_z; found {' '.join(recording.columns)}"
        )
    rate, _ = unit.gyro(outputs, force)
    return recording.with_columns(
        {name: from_si(values, kept_unit) for name, values in zip(_GYRO, rate, strict=True)},
        dict.fromkeys(_GYRO, kept_unit),
    )


def apply_mag(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with mag_* as the field in the body frame: uT, or parts of the local field (unit 1).

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording has no magnetometer triad.
    """
    field, _ = unit.mag(_outputs(recording, "mag", str(columns["output_unit"])))
    known = "uT" if columns["field_unit"] == "T" else "1"
    return recording.with_columns(
        {name: from_si(values, known) for name, values in zip(_MAG, field, strict=True)}, dict.fromkeys(_MAG, known)
    )


def _outputs(recording: Recording, sensor: str, needed: str) -> list[Array]:
    """Columns of a triad in the unit of the outputs that the record calibrates."""
    factor = output_factor(recording.name, sensor, recording.triad_unit(sensor), needed)
    columns = [recording.column(f"{sensor}_{axis}") for axis in AXES]
    return columns if factor == 1.0 else [column * factor for column in columns]


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


def specific_force(record: Calibration, output: Array) -> Array:
    """Return the specific force, m/s^2, for outputs in the record's unit; both of shape (n, 3).

    Raises
    ------
    RecordError
        The record lacks a parameter, or has one that cannot be.
    """
    force, _ = DeviceUnit.of(tables_of(record)[0]).tumble(list(output.T))
    return np.column_stack(force)


def field_in_body(record: Calibration, output: Array) -> Array:
    """Return the field in the body frame, T or parts of the local one, for outputs in the record's unit, (n, 3) each.

    Raises
    ------
    RecordError
        The record lacks a parameter, or has one that cannot be.
    """
    (table,) = (table for table in tables_of(record) if table.kind == "mag")
    field, _ = DeviceUnit.of(table).mag(list(output.T))
    return np.column_stack(field)


def beyond_test(record: Calibration, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie far beyond the 1 g that the record was made at, and the largest, m/s^2.

    Counted only where the record has nonlinearity, which gravity has shown within 1 g and nowhere else.
    """
    model = model_of(record)
    if model.order <= 1 and not model.cross:
        return 0, 0.0
    scale = np.array([record.value(f"scale_factor_{axis}") for axis in AXES])
    bias = np.array([record.value(f"bias_{axis}") for axis in AXES])
    factor = conversion_factor(recording.triad_unit("accel"), model.output_unit)
    reading = np.abs(recording.triad("accel") * factor / scale - bias)
    largest = np.where(np.isfinite(reading), reading, 0.0).max(axis=1, initial=0.0)
    return int(np.count_nonzero(largest > _FAR * STANDARD_GRAVITY)), float(largest.max(initial=0.0))


def beyond_message(record: Calibration, count: int, largest: float) -> str:
    """Say that so many samples, the largest in m/s^2, lie beyond what shows the nonlinearity."""
    most = f"{from_si(largest, 'g'):.1f} g"
    return f"{count} samples beyond 2 g (up to {most}): the record's nonlinearity was measured within 1 g"
