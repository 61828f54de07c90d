"""A thermal record applied by the C core: raw triads to specific force by the laws at each sample's temperature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.columns import triad
from imulab.device.unit import DeviceUnit
from imulab.errors import DataError, UnitError
from imulab.recording import Array, Recording
from imulab.units import conversion_factor, parse_unit, to_si
from imulab.verdict import Note

_ACCEL = triad("accel")


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
    given, needed = recording.triad_unit("accel"), str(columns["output_unit"])
    try:
        factor = conversion_factor(given, needed)
    except UnitError:
        raise UnitError(
            f"{recording.name}: columns {' '.join(_ACCEL)} are in {given}, but the record calibrates "
            f"outputs in {needed}"
        ) from None
    outputs = list((recording.triad("accel") * factor).T)
    force, _ = unit.thermal(_temperature(columns, recording), outputs)
    return recording.with_columns(dict(zip(_ACCEL, force, strict=True)), dict.fromkeys(_ACCEL, "m/s^2"))


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
    if not set(_ACCEL) <= set(recording.columns):
        return []
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
