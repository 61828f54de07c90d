"""A warm-up record on the device: table of the C core, test vectors, and its curve subtracted from recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.device.tables import DeviceTable, Field, field_of, whole
from imulab.device.unit import DeviceUnit
from imulab.display import Note
from imulab.errors import RecordError, UnitError
from imulab.estimation.sampling import times_in_order
from imulab.procedures.warmup import EXITS, MODELS
from imulab.procedures.warmup.model import record_table
from imulab.recording import (
    LATEST_START,
    Array,
    Recording,
    check_clock,
    check_start,
    power_on_temperature,
    state_power_on,
)
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor

# The table of the C core, and the vectors by which exported code tests itself.


_COLDEST, _HOTTEST, _HAIR = -273.15, 1000.0, 1e-3
"""How far a table with ``beyond="hold"`` reaches, degC, and the distance over which its slope ends there, K."""
_GOLDEN_STEP = 0.01  # s


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the table of a warm-up record; errors as for `record_table` and `warmup_table`."""
    table, after = warmup_table(record_table(record).to_section()), record.model.get("after")
    return (table if after is None else replace(table, columns={**table.columns, "after": after}),)


def warmup_table(table: Mapping[str, Any]) -> DeviceTable:
    """Return the warm-up table of a record's section ``table``.

    Raises
    ------
    RecordError
        Its numbers do not fit each other.
    """
    if table["model"] not in MODELS or table["exit"] not in EXITS:
        raise RecordError(f"the table has model {table['model']!r} and exit {table['exit']!r}, which are not known")
    model = MODELS.index(table["model"])
    temperatures = np.array(table["temperatures"], dtype=np.float64)
    coefficients = np.array(table["coefficients"], dtype=np.float64)
    slopes = np.array(table["slopes"], dtype=np.float64) if table["model"] == "exponential" else None
    constants = np.zeros(3)
    if table["model"] == "exponential":
        constants[: len(table["time_constants"])] = table["time_constants"]
    tolerance = float(table.get("tolerance", 0.0))
    if table.get("beyond", "zero") == "hold":
        reach = (_COLDEST, _HOTTEST)
        temperatures, coefficients, slopes = _extend(table["model"], temperatures, coefficients, slopes, reach)
    elif tolerance:
        reach = (float(temperatures[0]) - tolerance, float(temperatures[-1]) + tolerance)
        temperatures, coefficients, slopes = _extend(table["model"], temperatures, coefficients, slopes, reach)
    axes = list(table["axes"])
    rows = len(temperatures) - (table["model"] == "interval-cubic")
    terms = len(table["time_constants"]) if table["model"] == "exponential" else 4
    shape = (rows, len(axes), terms)
    if coefficients.shape != shape or (slopes is not None and slopes.shape != shape):
        raise RecordError(f"the table has coefficients of shape {coefficients.shape}, expected {shape}")
    fields = (
        Field("model", whole(model)),
        Field("exit", whole(EXITS.index(table["exit"]))),
        Field("temperatures", whole(len(temperatures))),
        Field("axes", whole(len(axes))),
        Field("terms", whole(terms)),
        Field("settling_time", np.array(float(table["settling_time"]))),
        Field("taper_time", np.array(float(table["taper_time"]) if table["exit"] == "taper" else 0.0)),
        Field("time_scale", np.array(float(table.get("time_scale") or 0.0))),
        Field("time_constant", constants),
        Field("temperature", temperatures, pointed=True),
        Field("coefficient", coefficients, pointed=True),
        Field("slope", slopes, pointed=True),
    )
    ends = [float(temperatures[0]), float(temperatures[-1])]
    return DeviceTable(
        "warmup",
        fields,
        {"axes": axes, "units": list(table["units"]), "range": ends, "end": _end(table), "exit": table["exit"]},
    )


def _extend(
    model: str, temperatures: Array, coefficients: Array, slopes: Array | None, reach: tuple[float, float]
) -> tuple[Array, Array, Array | None]:
    """Return a table extended to `reach`, degC, with the values at its edges.

    Outer intervals reach further, or there are outer knots with the same values: so a unit needs no rule for this.
    Slopes of exponential amplitudes end a thousandth of a kelvin beyond the outer knots.
    """
    low, high = float(temperatures[0]), float(temperatures[-1])
    if model == "interval-cubic":
        return np.array([reach[0], *temperatures[1:-1], reach[1]]), coefficients, None
    hair = min(_HAIR, (low - reach[0]) / 2)
    outside = ([reach[0]], [reach[1]])
    if slopes is not None:
        outside = ([reach[0], low - hair], [high + hair, reach[1]])
    count = len(outside[0])
    ends = [np.repeat(coefficients[[k]], count, axis=0) for k in (0, -1)]
    level = None if slopes is None else np.zeros_like(ends[0])
    return (
        np.array([*outside[0], *temperatures, *outside[1]]),
        np.concatenate([ends[0], coefficients, ends[1]]),
        None if slopes is None or level is None else np.concatenate([level, slopes, level]),
    )


def _end(table: Mapping[str, Any]) -> float:
    """Return the time after which the table's curve no longer changes, s."""
    return float(table["settling_time"]) + (float(table["taper_time"]) if table["exit"] == "taper" else 0.0)


def golden(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return power-on temperatures at, between and beyond the knots, times, and the biases there."""
    knots, axes = field_of(table, "temperature"), int(field_of(table, "axes"))
    between = knots[:-1] + np.diff(knots) * rng.uniform(0.1, 0.9, len(knots) - 1)
    starts = np.concatenate([knots, between, [knots[0] - 1, knots[-1] + 1, np.nan]])
    end = float(field_of(table, "settling_time") + field_of(table, "taper_time")) * 1.1 / _GOLDEN_STEP
    ticks = np.unique(np.concatenate([[0, 1], np.linspace(0, end, 30)])).astype(np.uint32)
    unit = DeviceUnit.of(table)
    bias = np.empty((len(starts), len(ticks), axes))
    for place, start in zip(bias, starts, strict=True):
        left, _ = unit.warmup(float(start), _GOLDEN_STEP, ticks, [np.zeros(len(ticks))] * axes)
        place[:] = -np.column_stack([column for column in left if column is not None])
    # The tolerance follows the largest term of a polynomial, because the sum may be near zero.
    sizes = np.abs(field_of(table, "coefficient")).sum(axis=2).max(axis=0)
    return {
        "starts": len(starts),
        "ticks": ticks,
        "TICKS": len(ticks),
        "tick": _GOLDEN_STEP,
        "temperature": starts,
        "scale": np.where(sizes > 0, sizes, 1.0),
        "bias": bias + 0.0,
    }


# Correction of recordings by the C core: the table's curve is subtracted while the unit warms up.


_TICK, _LONG, _LONG_TICK = 1e-6, 2000.0, 1e-4  # s: the core counts time in ticks, 2^32 of them
_LAST_TICK = 2**32 - 1  # the core's counter stops there
_PIECE = 32768  # samples in one step: their ticks stay in the cache


def apply_warmup(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with ``output - Z(t; T)`` in those axes of the record that it has; their units are kept.

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
        raise recording.lacking("column time", "time", "a warm-up record needs the time since power-on")
    time = _check_time(recording, columns.get("latest_start", LATEST_START))
    temperature = power_on_temperature(recording)
    if temperature is None or unchanged(columns, recording) is not None:
        return recording
    tick = _TICK if columns["end"] < _LONG else _LONG_TICK
    outputs = [recording.columns[axis] if axis in there else None for axis in columns["axes"]]
    corrected = [None if column is None else np.empty(len(recording)) for column in outputs]
    buffer = np.empty(min(_PIECE, len(recording)))
    for start in range(0, len(recording), _PIECE):
        piece = slice(start, start + _PIECE)
        ticks = _ticks(time[piece], tick, buffer)
        into = _slice_columns(corrected, piece)
        _, active = unit.warmup(temperature, tick, ticks, _slice_columns(outputs, piece), factors=factors, into=into)
        if not active:
            return recording
    pairs = zip(columns["axes"], corrected, strict=True)
    return recording.with_columns({axis: column for axis, column in pairs if column is not None}, {})


def present_axes(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return the axes of a table that a recording has.

    Raises
    ------
    DataError
        It has none of them.
    """
    there = [axis for axis in columns["axes"] if axis in recording]
    if not there:
        recording.column(columns["axes"][0])  # raises the message of a missing column
    return there


def _slice_columns(columns: Sequence[Array | None], piece: slice) -> list[Array | None]:
    return [None if column is None else column[piece] for column in columns]


def _check_time(recording: Recording, latest: float) -> Array:
    """Return the column time, s, after a check that it counts from power-on (only in a recording's first block)."""
    time = times_in_order(recording)
    if time.size and recording.first_row == 1:
        check_start(recording, float(time[0]), latest)
        check_clock(recording, time)
    return time


def _ticks(time: Array, tick: float, buffer: Array) -> NDArray[np.uint32]:
    """Return times in whole ticks, computed in `buffer`."""
    count = np.divide(time, tick, out=buffer[: len(time)])
    np.rint(count, out=count)
    return np.clip(count, 0, _LAST_TICK, out=count).astype(np.uint32)


def unchanged(columns: Mapping[str, Any], recording: Recording) -> str | None:
    """Return the reason why the table of a record or blob leaves a recording unchanged, or None.

    `columns` are those of its section in the C core: range of temperatures, degC, and end of the correction, s.
    """
    low, high = columns["range"]
    temperature = power_on_temperature(recording)
    if temperature is None:
        return (
            f"{recording.name}: no power_on_temperature in the head of the file: nothing corrected; "
            f"{state_power_on(recording, '21.5')}"
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
    """Return remarks on correcting a recording: why it stays unchanged, or which axes it lacks."""
    if message := unchanged(columns, recording):
        return [message]
    there = [axis for axis in columns["axes"] if axis in recording]
    absent = [axis for axis in columns["axes"] if axis not in there]
    if not there or not absent:
        return []
    return [Note(f"{recording.name}: no {' '.join(absent)} in it: {' '.join(there)} alone are corrected for warm-up")]
