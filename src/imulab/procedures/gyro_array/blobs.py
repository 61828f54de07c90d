"""The array of an exported blob: how it fuses, and its stream."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imulab.device.array_settings import ArraySettings, Fusion, fusion_of
from imulab.device.blob import Blob
from imulab.errors import RecordError, UnitError
from imulab.procedures.gyro_array.model import Elements, count_of_axes
from imulab.recording import Array
from imulab.units import conversion_factor, parse_unit


def fusion_of_blob(blob: Blob) -> Fusion:
    """Return how an exported blob fuses.

    Raises
    ------
    RecordError
        It holds no array.
    """
    return fusion_of(_array_section(blob))


@dataclass(frozen=True)
class _InUnits:
    """A stream in rad/s behind readings in another unit."""

    stream: Any
    factor: Array

    def process(self, readings: Array, **more: Any) -> Any:
        out = self.stream.process(readings * self.factor[:, None], **more)
        return replace(out, rate=out.rate / self.factor)


def blob_stream(blob: Blob, elements: Elements, recording: str) -> _InUnits:
    """Return the stream of an exported blob."""
    from imulab.device.unit import Stream

    section = _array_section(blob)
    if (section["elements"], section["axes"]) != (elements.count, len(elements.axes)):
        raise RecordError(
            f"{recording}: {elements.count} gyros on {count_of_axes(len(elements.axes))}; the blob {blob.name} holds "
            f"{section['elements']} on {count_of_axes(section['axes'])}"
        )
    for row, unit in zip(elements.names, elements.units, strict=True):
        if parse_unit(unit).quantity != "rate":
            raise UnitError(f"{recording}: column {row[0]} is in {unit}; the blob {blob.name} is in rad/s")
    factor = np.array([conversion_factor(unit, "rad/s") for unit in elements.units])
    settings = ArraySettings(section["method"], elements.count, len(elements.axes), rate=section["rate"])
    return _InUnits(Stream.of_blob(blob.data, settings), factor)


def _array_section(blob: Blob) -> Any:
    """What a blob says of its array."""
    section = next((s for s in blob.text["sections"] if s["kind"] == "array"), None)
    if section is None:
        raise RecordError(f"{blob.name}: the blob holds no array")
    return section
