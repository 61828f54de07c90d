"""Vectors by which an exported unit tests itself, of the tables that several procedures make."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.device.tables import DeviceTable, field_of
from imulab.device.unit import DeviceUnit
from imulab.units import STANDARD_GRAVITY

VECTORS = 64


def golden_gyroscopes(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return outputs under a specific force, and their rates."""
    rates = rng.uniform(-5, 5, (VECTORS, 3))  # rad/s, about 300 deg/s
    if any(field.name == "high" for field in table.fields):
        rates *= 0.9 * np.minimum(1, np.minimum(-field_of(table, "low"), field_of(table, "high")) / 5)
    force = rng.uniform(-2 * STANDARD_GRAVITY, 2 * STANDARD_GRAVITY, (VECTORS, 3))
    output = (rates + field_of(table, "bias")) / field_of(table, "gain")
    output[1, 2] = np.nan
    rate, _ = DeviceUnit.of(table).gyro(list(output.T), list(force.T))
    return {"": VECTORS, "scale": 5.0, "output": output, "force": force, "rate": np.column_stack(rate)}
