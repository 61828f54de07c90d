"""A centrifuge record as the table that the C core runs, and the vectors by which an exported unit tests itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.device.golden import VECTORS
from imulab.device.tables import DeviceTable, Field, field_of
from imulab.device.unit import DeviceUnit
from imulab.errors import RecordError
from imulab.procedures.centrifuge.sections import highest_force
from imulab.recording import Array
from imulab.records.calibration import Calibration

_CURVE_UNITS = {"K0": "rad/s/(m/s^2)", "c1": "1/(m/s^2)", "c2": "1/(m/s^2)^2", "direction": "rad"}


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the table of a centrifuge record.

    Raises
    ------
    RecordError
        The record lacks an axis or the direction of its drift, or has a parameter in another unit.
    """
    axes = [axis for axis in "xy" if f"{axis}_K0" in record.parameters]
    if not axes:
        raise RecordError("the record lacks x_K0")
    for name, parameter in record.parameters.items():
        expected = _CURVE_UNITS.get(name.rpartition("_")[2])
        if expected is not None and parameter.unit != expected:
            raise RecordError(f"the record has {name} in {parameter.unit!r}, expected {expected!r}")
    for axis in axes:
        if f"{axis}_direction" not in record.parameters:
            raise RecordError(
                f"the record has no {axis}_direction: it was made without table_angle, "
                "so that the direction of the drift in the gyroscope is not known"
            )

    def both(name: str) -> Array:
        return np.array(
            [p.value if (p := record.parameters.get(f"{axis}_{name}")) is not None else 0.0 for axis in "xy"]
        )

    highest = highest_force(record)
    table = DeviceTable(
        "centrifuge",
        (
            Field("has", np.array([axis in axes for axis in "xy"], dtype=np.int64)),
            Field("highest", np.array(highest)),
            *(Field(name.lower(), both(name)) for name in ("K0", "c1", "c2")),
            Field("cosine", np.cos(both("direction"))),
            Field("sine", np.sin(both("direction"))),
        ),
        {"axes": axes, "highest": highest},
    )
    return (table,)


def golden(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return rates under specific forces up to the highest level, and what is left of them."""
    force = rng.uniform(-1, 1, (VECTORS, 2)) * float(field_of(table, "highest")) / np.sqrt(2)
    rate = rng.uniform(-1, 1, (VECTORS, 2)) * 0.01  # rad/s
    rate[1, 0] = np.nan
    out, _ = DeviceUnit.of(table).centrifuge(list(force.T), list(rate.T))
    expected = np.column_stack([column for column in out if column is not None])
    scale = float(np.nanmax(np.abs(np.concatenate([rate, expected]))))
    return {"": VECTORS, "scale": scale, "force": force, "rate": rate, "expected": expected}
