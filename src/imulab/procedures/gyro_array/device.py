"""An array's record on the device: the table of the C core and its test vectors, apart from the estimators."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.device.tables import ArraySettings, DeviceTable, Fusion, array_table, fusion_of
from imulab.device.unit import fuse_table
from imulab.errors import RecordError
from imulab.procedures.gyro_array.elements import check_calibration
from imulab.procedures.gyro_array.schema import array_of
from imulab.recording import Array
from imulab.records.calibration import Calibration

_SAMPLES = 300  # of the exported self-test


def tables_of(record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
    """Return the table of an array: its elements' biases, alignment and noise; readings in rad/s.

    It fuses as `fusion` says, or as the record states.

    Raises
    ------
    RecordError
        The record is no calibration, or the method has no table.
    """
    check_calibration(record)
    held = array_of(record)
    white = held.white_noise
    matrices = None
    if held.model.aligned:
        matrices = np.array([element.alignment for element in held.elements])
        white = np.sqrt(np.einsum("nab,bn->an", matrices**2, white**2))
    by = fusion or fusion_of(record.model.get("fusion"))
    weights = None
    if by.method == "robust":
        inverse = 1 / np.maximum(white, 1e-300) ** 2
        weights = inverse / inverse.sum(axis=1, keepdims=True)
    elif by.method == "covariance":
        weights = np.array(held.correlation.weights, dtype=np.float64)
    elif by.method == "kalman":
        raise RecordError("method kalman has no table for a unit: expected another method, such as --method robust")
    settings = ArraySettings(
        by.method,
        len(held.elements),
        len(held.model.axes),
        bias=np.array([element.bias.values for element in held.elements]).T,
        matrices=matrices,
        weights=weights,
        memory=by.memory,
        start=by.start,
        rate=float(held.fit.sample_rate.value),
    )
    table = array_table(settings)
    return (
        DeviceTable(
            table.kind, table.fields, {**table.columns, **by.to_dict(), "unit": "rad/s", "rate": settings.rate}
        ),
    )


def golden(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return a slow turn seen by all gyros, with noise, one spike and a gap, and the fused rates."""
    elements, axes = table.columns["elements"], table.columns["axes"]
    turn = 0.2 * np.sin(np.linspace(0, 6, _SAMPLES))[:, None, None]
    noise = 1e-3 * rng.uniform(0.5, 1.5, (axes, elements)) * rng.standard_normal((_SAMPLES, axes, elements))
    reading: Array = turn + noise + 5e-3 * rng.standard_normal((axes, elements))
    reading[_SAMPLES // 2, :, 0] += 5.0
    reading[_SAMPLES // 3 : _SAMPLES // 3 + 5, :, elements - 1] = np.nan
    flat = reading.reshape(_SAMPLES, axes * elements)
    rate = fuse_table(table, flat)
    return {"": _SAMPLES, "scale": float(np.nanmax(np.abs(rate))), "reading": flat, "rate": rate}
