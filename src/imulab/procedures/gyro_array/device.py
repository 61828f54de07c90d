"""An array calibration as the table that the C core runs, and the vectors by which an exported unit tests itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.device.array_settings import ArraySettings, Fusion, array_table, element_white_noise, fusion_of
from imulab.device.tables import Table
from imulab.device.unit import fuse_table
from imulab.errors import RecordError
from imulab.recording import Array
from imulab.records.calibration import Calibration

_SAMPLES = 300


def tables_of(record: Calibration, fusion: Fusion | None = None) -> tuple[Table, ...]:
    """Return the table of an array: its elements' biases, alignment and noise; readings in rad/s.

    It fuses by `fusion`, by what the record carries if not given.

    Raises
    ------
    RecordError
        It is no calibration, or the method has no table.
    """
    if record.model.get("kind") != "calibration":
        raise RecordError(f"expected the record of an array calibration, found one of a {record.model.get('kind')}")
    elements = record.sections["elements"]
    axes = len(record.model["axes"])
    white = element_white_noise(record.sections)
    matrices = None
    if record.model["aligned"]:
        matrices = np.array(
            [e["matrix"]["value"] if "matrix" in e else [[1 / e["scale_factor"]["value"]]] for e in elements]
        )
        white = np.sqrt(np.einsum("nab,bn->an", matrices**2, white**2))
    by = fusion or fusion_of(record.model.get("fusion"))
    weights = None
    if by.method == "robust":
        inverse = 1 / np.maximum(white, 1e-300) ** 2
        weights = inverse / inverse.sum(axis=1, keepdims=True)
    elif by.method == "covariance":
        weights = np.array(record.sections["correlation"]["weights"], dtype=np.float64)
    elif by.method == "kalman":
        raise RecordError("method kalman has no table for a unit: expected another method, such as --method robust")
    settings = ArraySettings(
        by.method,
        len(elements),
        axes,
        bias=np.array([np.atleast_1d(element["bias"]["value"]) for element in elements]).T,
        matrices=matrices,
        weights=weights,
        memory=by.memory,
        start=by.start,
        rate=float(record.fit["sample_rate"]["value"]),
    )
    table = array_table(settings)
    return (Table(table.kind, table.fields, {**table.columns, **by.to_dict(), "unit": "rad/s", "rate": settings.rate}),)


def golden(table: Table, rng: np.random.Generator) -> dict[str, Any]:
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
