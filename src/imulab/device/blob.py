"""Blobs: the tables of one unit as the bytes that its firmware loads, read back on the desk."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from imulab.device.tables import KINDS, TEXT, DeviceTable, pack
from imulab.device.unit import DeviceUnit
from imulab.errors import RecordError
from imulab.printable import first_hidden
from imulab.records.calibration import BLOB_MAGIC, Calibration, plain_values
from imulab.records.sections import Part, Positive, Size, check_sizes, read

FORMAT = "imulab.blob"
_HEAD = 16


class _Kind(Part):
    kind: str
    record: str | None = None
    """SHA-256 of the record that it is from; blobs of version 0.1 do not say."""


class _Text(Part):
    sensor: dict[str, str]
    software: str
    records: list[str]
    sections: list[_Kind]


class _Triad(Part):
    output_unit: str


class _Thermal(Part):
    output_unit: str
    temperature: str
    range: Annotated[list[float], 2]


class _Centrifuge(Part):
    axes: list[str]
    highest: Size


class _Warmup(Part):
    axes: Annotated[list[str], "columns"]
    units: Annotated[list[str], "columns"]
    range: Annotated[list[float], 2]
    end: Size


class _Array(Part):
    elements: int
    axes: int
    method: str
    rate: Positive


_COLUMNS: dict[str, type[Part]] = {
    "tumble": _Triad,
    "gyro": _Triad,
    "mag": _Triad,
    "thermal": _Thermal,
    "thermal_gyro": _Thermal,
    "centrifuge": _Centrifuge,
    "warmup": _Warmup,
    "array": _Array,
}
"""What the text says of a section of each kind."""


@dataclass(frozen=True)
class Blob:
    """A blob: its bytes, and what it says about itself (sensor, columns and units of each section)."""

    name: str
    data: bytes
    text: Mapping[str, Any]


def make_blob(records: Sequence[Calibration], tables: Sequence[DeviceTable]) -> bytes:
    """Return the blob of these tables, float numbers, with what the desk needs to apply it.

    Raises
    ------
    RecordError
        A number is beyond the range of a float.
    """
    text = {
        "format": FORMAT,
        "sensor": {key: value for record in records for key, value in record.sensor.items()},
        "software": records[0].software,
        "records": [record.to_dict()["content_sha256"] for record in records],
        "sections": [{"kind": table.kind, **table.columns} for table in tables],
    }
    return pack(tables, 4, plain_values(text, ""))


def is_blob(path: str | Path) -> bool:
    """Return whether a file begins like a blob; False where it cannot be read."""
    try:
        if not Path(path).is_file():
            return False  # a pipe can be read only once
        with Path(path).open("rb") as stream:
            return stream.read(len(BLOB_MAGIC)) == BLOB_MAGIC
    except OSError:
        return False


def load_blob(path: str | Path) -> Blob:
    """Read a blob and check it by the core's own loader.

    Raises
    ------
    RecordError
        The file is missing, cut, corrupt, of a newer version, or no blob.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        DeviceUnit(data)
    except RecordError as error:
        raise RecordError(f"{path}: not a blob that can be used: {error}") from None
    text = next((payload for kind, payload in _sections(data) if kind == TEXT), None)
    try:
        content = json.loads((text or b"").decode("utf-8"))
        if content["format"] != FORMAT or not all(section["kind"] for section in content["sections"]):
            raise ValueError
    except (ValueError, KeyError, TypeError):
        raise RecordError(f"{path}: the blob has no description of its units: it is for firmware only") from None
    names = {number: name for name, number in KINDS.items()}
    try:
        _check_text(content, [names[kind] for kind, _ in _sections(data) if kind != TEXT])
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None
    if place := first_hidden(content):
        raise RecordError(f"{path}: {place} holds a control or bidirectional character; expected plain text")
    return Blob(str(path), data, content)


def _check_text(text: Any, kinds: list[str]) -> None:
    """Check that what a blob says of its sections, of these kinds, in this order, is what `make_blob` writes."""
    _complete(_Text, text, "its text")
    check_sizes(text)
    stated = [section["kind"] for section in text["sections"]]
    if stated != kinds:
        raise RecordError(f"its text speaks of {' '.join(map(str, stated))}, but it holds {' '.join(kinds)}")
    for number, kind in enumerate(kinds):
        _complete(_COLUMNS[kind], text["sections"][number], f"sections[{number}]")


def _complete(kind: type[Part], text: Any, place: str) -> None:
    found = read(kind, text, place)
    missing = [key for key in kind.__dataclass_fields__ if key not in vars(found)]
    if missing:
        raise RecordError(f"{place} lacks {missing[0]}")


def _sections(data: bytes) -> Iterator[tuple[int, bytes]]:
    at, end = _HEAD, len(data) - 4
    while at < end:
        kind, size = struct.unpack_from("<II", data, at)
        yield kind, data[at + 8 : at + 8 + size]
        at += 8 + size
