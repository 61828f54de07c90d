"""A warm-up record applied by the C core: the table's curve is subtracted while the unit warms up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.device.unit import DeviceUnit
from imulab.errors import DataError, UnitError
from imulab.power_on import LATEST_START, check_clock, check_start, power_on_temperature
from imulab.recording import Array, Recording, check_time
from imulab.units import conversion_factor
from imulab.verdict import Note

_TICK, _LONG, _LONG_TICK = 1e-6, 2000.0, 1e-4  # s: the core counts time in ticks, 2^32 of them
_LAST_TICK = 2**32 - 1
_PIECE = 32768  # samples at a time: their ticks stay in the cache


def apply_warmup(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with ``output - Z(t; T)`` in those axes of the record that it has, their units kept.

    `t` is the column time, counted from power-on; `T` is ``power_on_temperature`` of the head of the file. Without it,
    or outside the table, the recording passes unchanged (`unchanged` says why).

    Raises
    ------
    UnitError
        A column's unit cannot be converted to the record's.
    DataError
        The recording lacks time or every axis of the record; its time does not count from power-on, does not rise or is
        of another unit.
    """
    factors, there = [], present_axes(columns, recording)
    for axis, made_in in zip(columns["axes"], columns["units"], strict=True):
        if axis not in there:
            factors.append(1.0)
            continue
        try:
            factors.append(conversion_factor(made_in, recording.units[axis]))
        except UnitError:
            raise UnitError(
                f"{recording.name}: column {axis} is in {recording.units[axis]}, but the record corrects {made_in}"
            ) from None
    time = recording.time
    if time is None:
        raise DataError(f"{recording.name}: no column time; a warm-up record needs the time since power-on")
    time = _checked(recording, columns.get("latest_start", LATEST_START))
    temperature = power_on_temperature(recording)
    if temperature is None or unchanged(columns, recording) is not None:
        return recording
    tick = _TICK if columns["end"] < _LONG else _LONG_TICK
    given = [recording.columns[axis] if axis in there else None for axis in columns["axes"]]
    corrected = [None if column is None else np.empty(len(recording)) for column in given]
    buffer = np.empty(min(_PIECE, len(recording)))
    for start in range(0, len(recording), _PIECE):
        piece = slice(start, start + _PIECE)
        ticks = _ticks(time[piece], tick, buffer)
        into = _parts(corrected, piece)
        _, active = unit.warmup(temperature, tick, ticks, _parts(given, piece), factors=factors, into=into)
        if not active:
            return recording
    found = zip(columns["axes"], corrected, strict=True)
    return recording.with_columns({axis: column for axis, column in found if column is not None}, {})


def present_axes(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return the axes of a table that a recording has.

    Raises
    ------
    DataError
        It has none of them.
    """
    there = [axis for axis in columns["axes"] if axis in recording]
    if not there:
        recording.column(columns["axes"][0])  # says what was expected and what was found
    return there


def _parts(columns: Sequence[Array | None], piece: slice) -> list[Array | None]:
    return [None if column is None else column[piece] for column in columns]


def _checked(recording: Recording, latest: float) -> Array:
    """Return the column time, s, once it is sure that it counts from power-on; a later block has no start."""
    time = check_time(recording)
    if time.size and recording.first_row == 1:
        check_start(recording, float(time[0]), latest)
        check_clock(recording, time)
    return time


def _ticks(time: Array, tick: float, buffer: Array) -> NDArray[np.uint32]:
    """Return times in whole ticks; `buffer` has room for them."""
    count = np.divide(time, tick, out=buffer[: len(time)])
    np.rint(count, out=count)
    return np.clip(count, 0, _LAST_TICK, out=count).astype(np.uint32)


def unchanged(columns: Mapping[str, Any], recording: Recording) -> str | None:
    """Return why the table of a record or blob leaves a recording unchanged, in one line, or None.

    `columns` are those of its section in the C core: range of temperatures, degC, and when the correction ends, s.
    """
    low, high = columns["range"]
    temperature = power_on_temperature(recording)
    if temperature is None:
        return (
            f"{recording.name}: no power_on_temperature in the head of the file: nothing corrected; "
            "expected a line such as '# power_on_temperature: 21.5'"
        )
    if not low <= temperature <= high:
        return (
            f"{recording.name}: power-on temperature {temperature:g} degC is not within the table, "
            f"{low:g} to {high:g} degC: nothing corrected"
            + ("" if np.isnan(temperature) else " (warmup fit --beyond hold: a table that goes on as at its edges)")
        )
    time = recording.time
    ends = columns["end"] if columns.get("exit", "hold") != "hold" else np.inf
    if recording.first_row == 1 and time is not None and time.size and time[0] >= ends:
        return (
            f"{recording.name}: starts {time[0]:.6g} s after power-on, where the correction has ended "
            f"({ends:g} s): nothing corrected"
        )
    return None


def remarks(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return what a user should know about correcting a recording: why it stays as it is, or which axes it lacks."""
    if message := unchanged(columns, recording):
        return [message]
    there = [axis for axis in columns["axes"] if axis in recording]
    absent = [axis for axis in columns["axes"] if axis not in there]
    if not there or not absent:
        return []
    return [Note(f"{recording.name}: no {' '.join(absent)} in it: {' '.join(there)} alone are corrected for warm-up")]
