"""A warm-up record applied by the C core: the table's curve is subtracted while the unit warms up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.calibration import Calibration
from imulab.errors import DataError, RecordError, UnitError
from imulab.recording import Array, Recording
from imulab.runtime import Unit
from imulab.units import conversion_factor
from imulab.warmup.model import Table, table_from
from imulab.warmup.poweron import power_on_temperature

_TICK, _LONG, _LONG_TICK = 1e-6, 2000.0, 1e-4  # s: the core counts time in ticks, 2^32 of them
_LAST_TICK = 2**32 - 1
_PIECE = 32768  # samples at a time: their ticks stay in the cache


def apply_warmup(unit: Unit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with ``output - Z(t; T)`` in the axes of the record, their units kept.

    `t` is the column time, counted from power-on; `T` is ``power_on_temperature`` of the head of the file. Without it,
    or outside the table, the recording passes unchanged (`temperature_warning` says so).

    Raises
    ------
    UnitError
        A column's unit cannot be converted to the record's.
    DataError
        The recording lacks time or an axis of the record.
    """
    factors = []
    for axis, made_in in zip(columns["axes"], columns["units"], strict=True):
        recording.column(axis)
        try:
            factors.append(conversion_factor(made_in, recording.units[axis]))
        except UnitError:
            raise UnitError(
                f"{recording.name}: column {axis} is in {recording.units[axis]}, but the record corrects {made_in}"
            ) from None
    time = recording.time
    if time is None:
        raise DataError(f"{recording.name}: no column time; a warm-up record needs the time since power-on")
    temperature = power_on_temperature(recording)
    if temperature is None:
        return recording
    tick = _TICK if columns["end"] < _LONG else _LONG_TICK
    axes = list(columns["axes"])
    given = [recording.columns[axis] for axis in axes]
    corrected = [np.empty(len(recording)) for _ in axes]
    buffer = np.empty(min(_PIECE, len(recording)))
    for start in range(0, len(recording), _PIECE):
        piece = slice(start, start + _PIECE)
        ticks, unknown = _ticks(time[piece], tick, buffer)
        into = [column[piece] for column in corrected]
        _, active = unit.warmup(
            temperature, tick, ticks, [column[piece] for column in given], factors=factors, into=into
        )
        if not active:
            return recording
        if unknown is not None:
            for values in into:
                values[unknown] = np.nan
    return recording.with_columns(dict(zip(axes, corrected, strict=True)), {})


def _ticks(time: Array, tick: float, buffer: Array) -> tuple[NDArray[np.uint32], NDArray[np.bool_] | None]:
    """Return times in whole ticks, and which of them are no numbers, if any; `buffer` has room for them."""
    count = np.divide(time, tick, out=buffer[: len(time)])
    np.rint(count, out=count)
    if count.min() >= 0 and count.max() <= _LAST_TICK:  # also False where a time is NaN
        return count.astype(np.uint32), None
    unknown = ~np.isfinite(time)
    count[unknown] = 0
    return np.clip(count, 0, _LAST_TICK).astype(np.uint32), unknown if unknown.any() else None


def temperature_warning(low: float, high: float, recording: Recording) -> str | None:
    """Return why a table from `low` to `high`, degC, leaves a recording unchanged, in one line, or None."""
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
