"""Tables as the C core's structs and as the bytes ("blob") that it loads.

A blob is little-endian, versioned and closed by a CRC-32; the core checks it (``runtime/table.c`` has the layout).
The desk runs the same core on the same layout with 8 bytes per number, so that nothing is computed twice.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.errors import RecordError
from imulab.recording import Array
from imulab.records.calibration import BLOB_MAGIC, Calibration

VERSION, WITH_POWERS = 1, 2
"""Of the format; the second where gyroscopes have powers of the rate, which older cores then refuse as newer."""
TEXT = 0
KINDS = {"tumble": 1, "gyro": 2, "centrifuge": 3, "warmup": 4, "array": 5, "mag": 6, "thermal": 7, "thermal_gyro": 8}


@dataclass(frozen=True)
class Field:
    """One member of a C struct: whole or real numbers, of shape () for a scalar, or real numbers that it points to.

    None stands for NULL.
    """

    name: str
    values: NDArray[Any] | None
    pointed: bool = False

    @property
    def whole(self) -> bool:
        """Whether the member holds whole numbers."""
        return self.values is not None and self.values.dtype.kind in "iu"


@dataclass(frozen=True)
class DeviceTable:
    """The members of one section's struct (``il_tumble`` ...), in order, and what the desk knows about its columns."""

    kind: str
    fields: tuple[Field, ...]
    columns: Mapping[str, Any]

    def payload(self, width: int) -> bytes:
        """Return the section's bytes, `width` bytes per real number."""
        parts: list[bytes] = []
        pointed = [field for field in self.fields if field.pointed]
        mask = sum(1 << i for i, field in enumerate(pointed) if field.values is not None)
        masked = self.kind != "array"
        for field in self.fields:
            if not field.whole and not masked:  # the array's optional tables are announced before its real numbers
                parts.append(struct.pack("<I", mask))
                masked = True
            if field.values is not None:
                parts.append(field.values.astype("<u4" if field.whole else f"<f{width}").tobytes())
        return b"".join(parts)


def pack(tables: Sequence[DeviceTable], width: int, text: Mapping[str, Any] | None = None) -> bytes:
    """Return a blob of these sections; `width` is 8 on the desk and 4 for a unit.

    Raises
    ------
    RecordError
        A number is beyond the range of a float.
    """
    sections = [] if text is None else [(TEXT, json.dumps(text, ensure_ascii=False, sort_keys=True).encode("utf-8"))]
    with np.errstate(over="ignore"):
        for table in tables:
            for field in table.fields:
                if field.values is not None and not np.isfinite(field.values.astype(f"<f{width}")).all():
                    raise RecordError(f"{table.kind} {field.name}: {field.values} is beyond what {width} bytes hold")
    sections += [(KINDS[table.kind], table.payload(width)) for table in tables]
    body = b"".join(struct.pack("<II", kind, len(payload)) + payload for kind, payload in sections)
    bent = any(table.kind == "gyro" and any(field.name == "order" for field in table.fields) for table in tables)
    head = BLOB_MAGIC + struct.pack(
        "<HHI", WITH_POWERS if bent else VERSION, width, len(BLOB_MAGIC) + 8 + len(body) + 4
    )
    return head + body + struct.pack("<I", zlib.crc32(head + body))


def whole(value: int) -> NDArray[np.int64]:
    """Return a whole number as the value of a field."""
    return np.array(int(value), dtype=np.int64)


def values_of(record: Calibration, names: Sequence[str], unit: str) -> Array:
    """Return the values of parameters, in this unit.

    Raises
    ------
    RecordError
        The record lacks one, or has it in another unit.
    """
    values = []
    for name in names:
        parameter = record.parameter(name)
        if parameter.unit != unit:
            raise RecordError(f"the record has {name} in {parameter.unit!r}, expected {unit!r}")
        values.append(parameter.value)
    return np.array(values, dtype=np.float64)


def nonzero(scale: Array) -> Array:
    """Return scale factors; none is 0.

    Raises
    ------
    RecordError
        One is.
    """
    if not (scale != 0).all():
        raise RecordError("the record has a scale factor of 0")
    return scale


def field_of(table: DeviceTable, name: str) -> NDArray[Any]:
    """Return the values of a table's field."""
    (values,) = [field.values for field in table.fields if field.name == name]
    return np.asarray(values)
