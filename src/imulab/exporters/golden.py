"""Golden vectors: inputs over the range of a table, and what the C core makes of them on the desk, in double."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.device.tables import Table
from imulab.device.unit import Unit, fuse_table
from imulab.recording import Array
from imulab.units import STANDARD_GRAVITY

_VECTORS = 64
_TICK = 0.01  # s
_SAMPLES = 300


def golden_of(table: Table) -> dict[str, Any]:
    """Return names (after ``golden_<kind>_``; an empty one for the count) and values of a table's vectors."""
    made: dict[str, Any] = _MAKE[table.kind](table, np.random.default_rng(20250101))
    return made


def _field(table: Table, name: str) -> NDArray[Any]:
    (values,) = [field.values for field in table.fields if field.name == name]
    return np.asarray(values)


def _tumble(table: Table, rng: np.random.Generator) -> dict[str, Any]:
    reach = 0.9 * np.minimum(2 * STANDARD_GRAVITY, np.minimum(-_field(table, "low"), _field(table, "high")))
    output = (rng.uniform(-1, 1, (_VECTORS, 3)) * reach + _field(table, "bias")) / _field(table, "gain")
    output[1, 1] = np.nan
    force, _ = Unit.of(table).tumble(list(output.T))
    return {"": _VECTORS, "scale": 2 * STANDARD_GRAVITY, "output": output, "force": np.column_stack(force)}


def _gyro(table: Table, rng: np.random.Generator) -> dict[str, Any]:
    rates = rng.uniform(-5, 5, (_VECTORS, 3))  # rad/s, about 300 deg/s
    force = rng.uniform(-2 * STANDARD_GRAVITY, 2 * STANDARD_GRAVITY, (_VECTORS, 3))
    output = (rates + _field(table, "bias")) / _field(table, "gain")
    output[1, 2] = np.nan
    rate, _ = Unit.of(table).gyro(list(output.T), list(force.T))
    return {"": _VECTORS, "scale": 5.0, "output": output, "force": force, "rate": np.column_stack(rate)}


def _centrifuge(table: Table, rng: np.random.Generator) -> dict[str, Any]:
    force = rng.uniform(-1, 1, (_VECTORS, 2)) * float(_field(table, "highest")) / np.sqrt(2)
    rate = rng.uniform(-1, 1, (_VECTORS, 2)) * 0.01  # rad/s
    rate[1, 0] = np.nan
    out, _ = Unit.of(table).centrifuge(list(force.T), list(rate.T))
    expected = np.column_stack([column for column in out if column is not None])
    scale = float(np.nanmax(np.abs(np.concatenate([rate, expected]))))
    return {"": _VECTORS, "scale": scale, "force": force, "rate": rate, "expected": expected}


def _warmup(table: Table, rng: np.random.Generator) -> dict[str, Any]:
    knots, axes = _field(table, "temperature"), int(_field(table, "axes"))
    between = knots[:-1] + np.diff(knots) * rng.uniform(0.1, 0.9, len(knots) - 1)
    starts = np.concatenate([knots, between, [knots[0] - 1, knots[-1] + 1, np.nan]])
    end = float(_field(table, "settling_time") + _field(table, "taper_time")) * 1.1 / _TICK
    ticks = np.unique(np.concatenate([[0, 1], np.linspace(0, end, 30)])).astype(np.uint32)
    unit = Unit.of(table)
    bias = np.empty((len(starts), len(ticks), axes))
    for place, start in zip(bias, starts, strict=True):
        left, _ = unit.warmup(float(start), _TICK, ticks, [np.zeros(len(ticks))] * axes)
        place[:] = -np.column_stack([column for column in left if column is not None])
    # The size of the numbers that a polynomial adds up, not of a sum that may be near zero.
    sizes = np.abs(_field(table, "coefficient")).sum(axis=2).max(axis=0)
    return {
        "starts": len(starts),
        "ticks": ticks,
        "TICKS": len(ticks),
        "tick": _TICK,
        "temperature": starts,
        "scale": np.where(sizes > 0, sizes, 1.0),
        "bias": bias + 0.0,
    }


def _array(table: Table, rng: np.random.Generator) -> dict[str, Any]:
    """A slow turn seen by all gyros, with noise, one spike and a gap."""
    elements, axes = table.columns["elements"], table.columns["axes"]
    turn = 0.2 * np.sin(np.linspace(0, 6, _SAMPLES))[:, None, None]
    noise = 1e-3 * rng.uniform(0.5, 1.5, (axes, elements)) * rng.standard_normal((_SAMPLES, axes, elements))
    reading: Array = turn + noise + 5e-3 * rng.standard_normal((axes, elements))
    reading[_SAMPLES // 2, :, 0] += 5.0
    reading[_SAMPLES // 3 : _SAMPLES // 3 + 5, :, elements - 1] = np.nan
    flat = reading.reshape(_SAMPLES, axes * elements)
    rate = fuse_table(table, flat)
    return {"": _SAMPLES, "scale": float(np.nanmax(np.abs(rate))), "reading": flat, "rate": rate}


_MAKE = {"tumble": _tumble, "gyro": _gyro, "centrifuge": _centrifuge, "warmup": _warmup, "array": _array}
