"""A warm-up table as the C core runs it, and the vectors by which an exported unit tests itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from imulab.device.tables import DeviceTable, Field, field_of, whole
from imulab.device.unit import DeviceUnit
from imulab.errors import RecordError
from imulab.procedures.warmup.choices import EXITS, MODELS
from imulab.procedures.warmup.model import record_table
from imulab.recording import Array
from imulab.records.calibration import Calibration

_COLDEST, _HOTTEST, _HAIR = -273.15, 1000.0, 1e-3
"""How far a table is held beyond its edges, degC, and how soon its slope ends there, K."""
_TICK = 0.01  # s


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
        temperatures, coefficients, slopes = _held(table["model"], temperatures, coefficients, slopes, reach)
    elif tolerance:
        reach = (float(temperatures[0]) - tolerance, float(temperatures[-1]) + tolerance)
        temperatures, coefficients, slopes = _held(table["model"], temperatures, coefficients, slopes, reach)
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


def _held(
    model: str, temperatures: Array, coefficients: Array, slopes: Array | None, reach: tuple[float, float]
) -> tuple[Array, Array, Array | None]:
    """Return a table that goes on as at its edges, as far as it is to reach, degC.

    Outer intervals reach further, or there are outer knots of the same value.

    A unit needs no rule of its own for that. Slopes of exponential amplitudes end a hair beyond the outer knots.
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
    """Time from which on the table's curve no longer changes, s."""
    return float(table["settling_time"]) + (float(table["taper_time"]) if table["exit"] == "taper" else 0.0)


def golden(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return power-on temperatures at, between and beyond the knots, times, and the biases there."""
    knots, axes = field_of(table, "temperature"), int(field_of(table, "axes"))
    between = knots[:-1] + np.diff(knots) * rng.uniform(0.1, 0.9, len(knots) - 1)
    starts = np.concatenate([knots, between, [knots[0] - 1, knots[-1] + 1, np.nan]])
    end = float(field_of(table, "settling_time") + field_of(table, "taper_time")) * 1.1 / _TICK
    ticks = np.unique(np.concatenate([[0, 1], np.linspace(0, end, 30)])).astype(np.uint32)
    unit = DeviceUnit.of(table)
    bias = np.empty((len(starts), len(ticks), axes))
    for place, start in zip(bias, starts, strict=True):
        left, _ = unit.warmup(float(start), _TICK, ticks, [np.zeros(len(ticks))] * axes)
        place[:] = -np.column_stack([column for column in left if column is not None])
    # The size of the numbers that a polynomial adds up, not of a sum that may be near zero.
    sizes = np.abs(field_of(table, "coefficient")).sum(axis=2).max(axis=0)
    return {
        "starts": len(starts),
        "ticks": ticks,
        "TICKS": len(ticks),
        "tick": _TICK,
        "temperature": starts,
        "scale": np.where(sizes > 0, sizes, 1.0),
        "bias": bias + 0.0,
    }
