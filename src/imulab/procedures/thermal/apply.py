"""A thermal record applied by the C core: raw triads to specific force by the laws at each sample's temperature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.columns import triad
from imulab.device.unit import DeviceUnit
from imulab.errors import DataError, UnitError
from imulab.recording import Array, Recording
from imulab.units import conversion_factor, from_si, parse_unit, to_si
from imulab.verdict import Note

_ACCEL, _GYRO = triad("accel"), triad("gyro")


def apply_thermal(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with accel_* as specific force, m/s^2, in the body frame of the record's gauge.

    A row whose temperature is not a number becomes not a number.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording has no accelerometer triad, or not the column of temperature that the record goes by.
    """
    outputs = _outputs(recording, "accel", str(columns["output_unit"]))
    force, _ = unit.thermal(_temperature(columns, recording), outputs)
    return recording.with_columns(dict(zip(_ACCEL, force, strict=True)), dict.fromkeys(_ACCEL, "m/s^2"))


def apply_gyro(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with gyro_* as body rate, in their unit if that is one of rate, else in rad/s.

    accel_* are the specific force (already corrected), which the g-sensitivity needs.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording lacks a gyroscope, the temperature, or the accelerometers that the g-sensitivity needs.
    """
    outputs = _outputs(recording, "gyro", str(columns["output_unit"]))
    kept = parse_unit(recording.triad_unit("gyro"))
    kept_unit = kept.symbol if kept.quantity == "rate" else "rad/s"
    force = None
    if set(_ACCEL) <= set(recording.columns):
        force = [to_si(recording.column(name), recording.units[name]) for name in _ACCEL]
    elif np.isnan(unit.thermal_gyro(np.full(1, columns["range"][0]), [np.zeros(1)] * 3, None)[0][0][0]):
        raise DataError(
            f"{recording.name}: the record corrects the gyroscopes' g-sensitivity, which needs accel_x, accel_y and "
            f"accel_z; found {' '.join(recording.columns)}"
        )
    rate, _ = unit.thermal_gyro(_temperature(columns, recording), outputs, force)
    return recording.with_columns(
        {name: from_si(values, kept_unit) for name, values in zip(_GYRO, rate, strict=True)},
        dict.fromkeys(_GYRO, kept_unit),
    )


def _outputs(recording: Recording, sensor: str, needed: str) -> list[Array]:
    """Return the columns of a triad in the unit of the outputs that the record calibrates."""
    given = recording.triad_unit(sensor)
    try:
        factor = conversion_factor(given, needed)
    except UnitError:
        raise UnitError(
            f"{recording.name}: columns {' '.join(triad(sensor))} are in {given}, but the record calibrates "
            f"outputs in {needed}"
        ) from None
    return list((recording.triad(sensor) * factor).T)


def _temperature(columns: Mapping[str, Any], recording: Recording) -> Array:
    name = str(columns["temperature"])
    others = [key for key in recording.columns if key.startswith("temperature_")]
    if name == "temperature" and name not in recording and len(others) == 1:
        (name,) = others
    if name not in recording:
        raise DataError(
            f"{recording.name}: no column {name}; found {' '.join(recording.columns)}: expected what the unit's own "
            "thermometer says, which the record's laws follow"
        )
    if parse_unit(recording.units[name]).quantity != "temperature":
        raise DataError(f"{recording.name}: column {name}: expected a temperature, found {recording.units[name]}")
    return to_si(recording.column(name), recording.units[name])


def remarks(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return what is to be known of correcting a recording: rows outside the range or without a temperature."""
    return _remarks(columns, recording) if set(_ACCEL) <= set(recording.columns) else []


def gyro_remarks(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return the same of gyroscopes, where no accelerometers beside them have it said already."""
    there = set(recording.columns)
    return _remarks(columns, recording) if set(_GYRO) <= there and not set(_ACCEL) <= there else []


def _remarks(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    low, high = columns["range"]
    temperature = _temperature(columns, recording)
    lost, outside = ~np.isfinite(temperature), (temperature < low) | (temperature > high)
    found: list[str] = []
    if lost.any():
        found.append(f"{recording.name}: {lost.sum()} rows without a temperature are not corrected: not a number there")
    if outside.any():
        far = float(np.maximum(low - temperature[outside], temperature[outside] - high).max())
        text = (
            f"{recording.name}: {outside.sum()} of {len(recording)} rows lie outside the {low:g} to {high:g} degC that "
            f"were measured, by up to {far:.1f} K: corrected as at the end of the range"
        )
        found.append(text if far > 1 else Note(text))
    return found
