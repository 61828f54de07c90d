"""A warm-up record applied: the table's curve is subtracted while the unit warms up."""

from __future__ import annotations

import numpy as np

from imulab.calibration import Calibration
from imulab.errors import DataError, RecordError, UnitError
from imulab.recording import Array, Recording
from imulab.units import conversion_factor
from imulab.warmup.model import Table, evaluate, table_from
from imulab.warmup.poweron import power_on_temperature

_PIECE = 4096


def apply_warmup(record: Calibration, recording: Recording) -> Recording:
    """Return the recording with ``output - Z(t; T)`` in the axes of the record, their units kept.

    `t` is the column time, counted from power-on; `T` is ``power_on_temperature`` of the head of the file. Without it,
    or outside the table, the recording passes unchanged (`temperature_warning` says so).

    Raises
    ------
    UnitError
        A column's unit cannot be converted to the record's.
    DataError
        The recording lacks time or an axis of the record.
    RecordError
        The record's table cannot be evaluated.
    """
    table = record_table(record)
    factors = []
    for axis, unit in zip(table.axes, table.units, strict=True):
        recording.column(axis)
        try:
            factors.append(conversion_factor(unit, recording.units[axis]))
        except UnitError:
            raise UnitError(
                f"{recording.name}: column {axis} is in {recording.units[axis]}, but the record corrects {unit}"
            ) from None
    time = recording.time
    if time is None:
        raise DataError(f"{recording.name}: no column time; a warm-up record needs the time since power-on")
    temperature = power_on_temperature(recording)
    if temperature is None or table.coefficients_at(temperature) is None:
        return recording
    outputs = [recording.columns[axis] for axis in table.axes]
    corrected = _corrected(table, time, temperature, outputs, np.array(factors))
    return recording.with_columns(dict(zip(table.axes, corrected, strict=True)), {})


def temperature_warning(record: Calibration, recording: Recording) -> str | None:
    """Return why the record leaves a recording unchanged, in one line, or None where it corrects it."""
    table = record_table(record)
    low, high = table.temperatures[[0, -1]]
    temperature = power_on_temperature(recording)
    if temperature is None:
        return (
            f"{recording.name}: no power_on_temperature in the head of the file: nothing corrected; "
            "expected a line such as '# power_on_temperature: 21.5'"
        )
    if low <= temperature <= high:
        return None
    return (
        f"{recording.name}: power-on temperature {temperature:g} degC is not within the table, "
        f"{low:g} to {high:g} degC: nothing corrected"
    )


def record_table(record: Calibration) -> Table:
    """Return the table of a warm-up record.

    Raises
    ------
    RecordError
        The record has none, or one that cannot be evaluated.
    """
    if "table" not in record.sections:
        raise RecordError("the warm-up record lacks its table")
    return table_from(record.sections["table"])


def _corrected(table: Table, time: Array, temperature: float, outputs: list[Array], factors: Array) -> list[Array]:
    """Return ``output - factor Z`` of each axis; the one place where a table is evaluated for a recording.

    In pieces that stay in the processor's cache: memory is then passed over once.
    """
    found = [np.empty(len(time)) for _ in outputs]
    quiet = table.exit == "zero"
    for start in range(0, len(time), _PIECE):
        piece = slice(start, start + _PIECE)
        z = None if quiet and time[piece].min() >= table.settling_time else evaluate(table, time[piece], temperature)
        if z is None:
            for result, output in zip(found, outputs, strict=True):
                result[piece] = output[piece]
            continue
        z *= factors[:, None]
        for result, output, curve in zip(found, outputs, z, strict=True):
            np.subtract(output[piece], curve, out=result[piece])
    return found
