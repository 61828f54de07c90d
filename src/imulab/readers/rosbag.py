"""sensor_msgs/Imu (with MagneticField and Temperature) out of ROS 1 bags, MCAP and ROS 2 sqlite files and folders.

Sources: ROS wiki "Bags/Format/2.0"; MCAP format specification, version 0; rosbag2_storage_sqlite3 (schema 1 to 4). Each
yields its messages as they lie in the file, in blocks, unparsed.

Not by rosbags (0.11): it unpacks each chunk in one call without a limit, so that the bounds of `unpacking` would need
the heads of all chunks parsed here as before, and it hands out one message at a time: 50,000 samples take it 0.26 s of
a ROS 1 bag and 0.12 s of MCAP, unread, against 0.04 s and 0.05 s here with their numbers.

The payloads of a topic have a fixed size, so that a NumPy view reads thousands at once. Sources: the definitions of
sensor_msgs/Imu, sensor_msgs/MagneticField and std_msgs/Header; OMG DDS-XTypes 1.3, 7.4 (plain CDR: little or big
endian, doubles aligned to 8 bytes behind a head of 4); ROS wiki "Messages" (ROS 1: little endian, not aligned). A
covariance of -1 at its first place, or a reading of NaN, says that a quantity is not reported.
"""

from __future__ import annotations

import bz2
import logging
import re
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

import numpy as np

from imulab.columns import triad
from imulab.display import Finding, Note
from imulab.errors import OptionError, ReadError, install, listed
from imulab.files import open_file
from imulab.readers import logs
from imulab.readers.formats import Budget, unpack
from imulab.readers.selection import Selection
from imulab.readers.streams import LoggedStream, Piece, side_by_side
from imulab.recording import Array, Recording
from imulab.units import parse_unit

# The folder of a ROS 2 bag: its data files and their order.


def files_of(folder: Path, name: str) -> list[Path]:
    """Return the data files in a ROS 2 bag's folder in order: those in its metadata, or else all.

    Raises
    ------
    ReadError
        There is none, or one that the folder's metadata lists is missing or compressed as a whole.
    """
    paths = sorted((p for p in folder.iterdir() if p.suffix in (".mcap", ".db3")), key=_natural)
    metadata = folder / "metadata.yaml"
    listed: list[str] = []
    if metadata.is_file():
        listed = re.findall(r"^\s*-\s+['\"]?([^'\"\s]+\.(?:mcap|db3)(?:\.zstd)?)['\"]?\s*$", _text(metadata), re.M)
    for entry in listed:
        if entry.endswith(".zstd"):
            raise ReadError(f"{name}: {entry} is compressed as a whole; decompress it first with 'zstd -d'")
        if not (folder / Path(entry).name).is_file():
            raise ReadError(f"{name}: {entry} is listed in metadata.yaml, but it is not there")
    if listed:
        return [folder / Path(entry).name for entry in listed]
    if not paths:
        common = next((ending for ending in (".csv", ".parquet") if any(folder.glob(f"*{ending}"))), "")
        raise ReadError(
            f"{name}: expected a file, found a folder that is no ROS 2 bag (no .mcap or .db3 in it)"
            + (f"; name the files in it: {name}/*{common}" if common else "")
        )
    return paths


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", path.name)]


def _text(path: Path) -> str:
    with open_file(path) as stream:
        return stream.read().decode("utf-8", "replace")


# The containers that ROS messages come in: ROS 1 bag, MCAP, ROS 2 sqlite.


BAG_MAGIC = b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
_BAG_LINE = b"#ROSBAG V2.0\n"
_FOOTER = 29  # bytes of the footer of an MCAP file without its magic
_LARGEST_CHUNK = 1 << 31  # bytes, unpacked, that memory is given for
_LARGEST_VALUE = 1 << 28  # bytes of a value in SQLite that are read
_AT_ONCE = 1 << 13  # rows of the database that are fetched at once


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic: number in the file, name, message type as ``package/Type``, serialisation."""

    number: int
    name: str
    type: str
    encoding: str


class Container(Protocol):
    """A file of ROS messages."""

    topics: list[Topic]

    def messages(self, numbers: Iterable[int]) -> Iterator[logs.Records]:
        """Yield the messages of some topics in blocks; the keys are the topics' numbers."""
        ...


def open_container(path: Path, name: str) -> Container:
    """Return the open file in the format that its first bytes show.

    Raises
    ------
    ReadError
        It is none of these, is cut, or is damaged.
    """
    with open_file(path) as stream:
        head = stream.read(16)
    if head.startswith(BAG_MAGIC):
        return Bag(path, name)
    if head.startswith(MCAP_MAGIC):
        return Mcap(path, name)
    if head.startswith(SQLITE_MAGIC):
        return Sqlite(path, name)
    raise ReadError(f"{name}: expected a ROS bag, MCAP or sqlite file, found {head[:8]!r}")


# --- ROS 1 -------------------------------------------------------------------------------------------------------


class Bag:
    """A ROS 1 bag, version 2.0: chunks of messages, then an index that lists the connections."""

    def __init__(self, path: Path, name: str) -> None:
        self._path, self._name = path, name
        self._size = path.stat().st_size
        with open_file(path) as stream:
            line = stream.read(len(_BAG_LINE))
            if line != _BAG_LINE:
                shown = line.decode("ascii", "replace").strip()
                raise ReadError(f"{name}: expected a bag of version 2.0, found {shown!r}")
            fields, data = self._record(stream, self._size)
            self._start = stream.tell() + data
            index = self._number(fields, b"index_pos", 8)
            if index == 0:
                raise ReadError(f"{name}: the bag has no index (it was not closed); run 'rosbag reindex' on it")
            if not self._start <= index <= self._size:
                raise ReadError(f"{name}: truncated: the index should be at byte {index}, the file has {self._size}")
            self._end = index
            counts = [self._number(fields, key, 4) for key in (b"conn_count", b"chunk_count")]
            stream.seek(index)
            self.topics, indexed = self._index(stream)
            if indexed != counts:
                raise ReadError(
                    f"{name}: truncated or damaged: expected {counts[0]} connections and {counts[1]} chunks in the "
                    f"index, found {indexed[0]} and {indexed[1]}"
                )

    def messages(self, numbers: Iterable[int]) -> Iterator[logs.Records]:
        """Yield the messages of some connections, a chunk at a time."""
        wanted = [2 | number << 8 for number in numbers]
        budget = Budget(self._path, self._name)
        with open_file(self._path) as stream:
            stream.seek(self._start)
            while stream.tell() < self._end:
                place = stream.tell()
                fields, size = self._record(stream, self._end)
                if fields.get(b"op") != b"\x05":
                    stream.seek(size, 1)
                    continue
                where = f"the chunk at byte {place}"
                method = fields.get(b"compression", b"?").decode("ascii", "replace")
                chunk = _decompressed(
                    stream.read(size), method, self._number(fields, b"size", 4), budget, self._name, where
                )
                records, position, _ = logs.walk_all(logs.ROSBAG, chunk)
                if position != len(chunk):
                    raise ReadError(f"{self._name}: {where} is damaged")
                yield _kept(records, records.of(wanted))

    def _index(self, stream: BinaryIO) -> tuple[list[Topic], list[int]]:
        topics: list[Topic] = []
        chunks = 0
        while stream.tell() < self._size:
            fields, size = self._record(stream, self._size)
            data = stream.read(size)
            if fields.get(b"op") == b"\x06":
                chunks += 1
            elif fields.get(b"op") == b"\x07":
                details = _bag_fields(data, self._name)
                topics.append(
                    Topic(
                        self._number(fields, b"conn", 4),
                        fields.get(b"topic", b"?").decode("utf-8", "replace"),
                        details.get(b"type", b"?").decode("utf-8", "replace"),
                        "ros1",
                    )
                )
        return topics, [len(topics), chunks]

    def _record(self, stream: BinaryIO, end: int) -> tuple[dict[bytes, bytes], int]:
        """Read the fields of a record and the size of its data."""
        place = stream.tell()
        head = stream.read(4)
        length = int.from_bytes(head, "little")
        if len(head) == 4 and length <= end - place - 8:
            fields = _bag_fields(stream.read(length), self._name)
            size = int.from_bytes(stream.read(4), "little")
            if size <= end - stream.tell():
                return fields, size
        raise ReadError(f"{self._name}: truncated or damaged: no whole record at byte {place}")

    def _number(self, fields: dict[bytes, bytes], key: bytes, size: int) -> int:
        value = fields.get(key, b"")
        if len(value) != size:
            raise ReadError(f"{self._name}: damaged: a record lacks its field {key.decode()}")
        return int.from_bytes(value, "little")


def _bag_fields(data: bytes, name: str) -> dict[bytes, bytes]:
    fields: dict[bytes, bytes] = {}
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        key, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
        if not equals or at + 4 + size > len(data):
            raise ReadError(f"{name}: damaged: the head of a record is no list of fields")
        fields[key] = value
        at += 4 + size
    return fields


# --- MCAP --------------------------------------------------------------------------------------------------------


class Mcap:
    """An MCAP file: messages, mostly in chunks, then a summary that lists schemas and channels."""

    def __init__(self, path: Path, name: str) -> None:
        self._path, self._name = path, name
        size = path.stat().st_size
        start = len(MCAP_MAGIC)
        with open_file(path) as stream:
            if size >= 2 * start + _FOOTER:
                stream.seek(size - start - _FOOTER)
            tail = stream.read()
            if len(tail) != _FOOTER + start or not tail.endswith(MCAP_MAGIC) or tail[0] != 2:
                raise ReadError(f"{name}: truncated: the file does not end as an MCAP file does; try 'mcap recover'")
            footer = size - start - _FOOTER
            summary = int.from_bytes(tail[9:17], "little")
            if summary and not start <= summary <= footer:
                raise ReadError(f"{name}: damaged: the summary should be at byte {summary}, the file has {size}")
            self._end = summary or footer
            stream.seek(summary or footer)
            records, position, _ = logs.walk_all(logs.MCAP, stream.read(footer - self._end))
            if position != footer - self._end:
                raise ReadError(f"{name}: damaged: the summary at byte {self._end} is no list of records")
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Topic] = {}
        self._define(records)
        if not self._channels or not self._schemas:  # a summary need not repeat them
            for block in self._blocks():
                self._define(block)
        self.topics = list(self._channels.values())

    def messages(self, numbers: Iterable[int]) -> Iterator[logs.Records]:
        """Yield the messages of some channels, a chunk or a block at a time."""
        wanted = [5 | number << 8 for number in numbers]
        for records in self._blocks():
            yield _kept(records, records.of(wanted))

    def _define(self, records: logs.Records) -> None:
        """Add schemas (u16 id, name, ...) and channels (u16 id, u16 schema, topic, encoding ...)."""
        for index in records.of([3, 4]).tolist():
            data, text = records.payload(index), []
            number, at = int.from_bytes(data[:2], "little"), 2 if records.keys[index] == 3 else 4
            for _ in range(at // 2):
                size = int.from_bytes(data[at : at + 4], "little")
                text.append(data[at + 4 : at + 4 + size].decode("utf-8", "replace"))
                at += 4 + size
            if at > len(data):
                raise ReadError(f"{self._name}: damaged: a schema or channel of {len(data)} bytes, expected {at}")
            if len(text) == 1:
                self._schemas[number] = text[0]
            else:
                kind = self._schemas.get(int.from_bytes(data[2:4], "little"), "?").replace("/msg/", "/")
                self._channels[number] = Topic(number, text[0], kind, text[1])

    def _blocks(self) -> Iterator[logs.Records]:
        ending: list[logs.Ending] = []
        budget = Budget(self._path, self._name)
        with open_file(self._path) as stream:
            for records in logs.walk_stream(stream, logs.MCAP, len(MCAP_MAGIC), self._end, ending):
                for index in records.of(6).tolist():
                    yield self._chunk(records.payload(index), budget)
                if not (records.keys == 6).all():
                    yield records
        (end,) = ending
        if end.left or end.position != self._end:
            raise ReadError(f"{self._name}: damaged: no whole record at byte {end.position}")

    def _chunk(self, data: bytes, budget: Budget) -> logs.Records:
        """Return the records of a chunk: u64 first and last time, u64 size, u32 CRC, compression, u64 size."""
        where = f"the chunk that begins at {int.from_bytes(data[:8], 'little')} ns"
        size, crc = int.from_bytes(data[16:24], "little"), int.from_bytes(data[24:28], "little")
        at = 32 + int.from_bytes(data[28:32], "little")
        method = data[32:at].decode("ascii", "replace")
        if at + 8 > len(data) or int.from_bytes(data[at : at + 8], "little") != len(data) - at - 8:
            raise ReadError(f"{self._name}: {where} is damaged")
        chunk = _decompressed(data[at + 8 :], method or "none", size, budget, self._name, where)
        if crc and zlib.crc32(chunk) != crc:
            raise ReadError(f"{self._name}: {where} is damaged (its CRC-32 does not match)")
        records, position, _ = logs.walk_all(logs.MCAP, chunk)
        if position != len(chunk):
            raise ReadError(f"{self._name}: {where} is damaged")
        return records


# --- ROS 2 sqlite --------------------------------------------------------------------------------------------------


class Sqlite:
    """A ROS 2 bag in sqlite."""

    def __init__(self, path: Path, name: str) -> None:
        self._path, self._name = path, name
        with open_file(path) as stream:
            head = stream.read(100)
        page, count = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
        expected = count * (65536 if page == 1 else page)
        if path.stat().st_size < expected:
            raise ReadError(f"{name}: truncated: expected {expected} bytes, found {path.stat().st_size}")
        for beside in (Path(f"{path}-wal"), Path(f"{path}-journal")):
            if beside.is_file() and beside.stat().st_size:
                raise ReadError(
                    f"{name}: the bag was not closed: {beside.name} holds changes that are not in it yet; put them in "
                    f"with: sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)'"
                )
        self._check_tables()
        rows = [row for rows in self._query("SELECT id, name, type, serialization_format FROM topics") for row in rows]
        if not all(isinstance(number, int) for number, *_ in rows):
            raise ReadError(f"{name}: damaged: a topic without a number")
        self.topics = [Topic(row[0], str(row[1]), str(row[2]).replace("/msg/", "/"), str(row[3])) for row in rows]

    def messages(self, numbers: Iterable[int]) -> Iterator[logs.Records]:
        """Yield the messages of some topics in the order of their arrival, thousands at a time."""
        listed = ",".join(str(int(number)) for number in numbers)
        order = "ORDER BY timestamp, id"
        for rows in self._query(f"SELECT topic_id, data FROM messages WHERE topic_id IN ({listed}) {order}"):
            if not all(isinstance(data, bytes) for _, data in rows):
                raise ReadError(f"{self._name}: damaged: a message that is not bytes")
            sizes = np.array([len(data) for _, data in rows], dtype=np.int64)
            offsets = np.concatenate([[0], np.cumsum(sizes[:-1])]).astype(np.int64)
            keys = np.array([number for number, _ in rows], dtype=np.int64)
            yield logs.Records(b"".join(data for _, data in rows), offsets, sizes, keys)

    def _check_tables(self) -> None:
        """Refuse a view or a computed column in place of a table: its content is not bounded by the file's size."""
        for table in ("topics", "messages"):
            tables = [
                row
                for rows in self._query(f"SELECT type, sql FROM sqlite_master WHERE name = '{table}'")
                for row in rows
            ]
            computed = [row for rows in self._query(f"PRAGMA table_xinfo({table})") for row in rows if row[6]]
            if [kind for kind, _ in tables] != ["table"] or computed or "VIRTUAL" in str(tables[0][1]).upper():
                raise ReadError(f"{self._name}: not a ROS 2 bag, or damaged: expected a plain table {table}")

    def _query(self, text: str) -> Iterator[list[tuple[Any, ...]]]:
        try:
            connection = sqlite3.connect(f"{self._path.resolve().as_uri()}?immutable=1", uri=True)
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST_VALUE)
            connection.text_factory = lambda data: data.decode("utf-8", "replace")
            try:
                cursor = connection.execute(text)
                while rows := cursor.fetchmany(_AT_ONCE):
                    yield rows
            finally:
                connection.close()
        except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
            raise ReadError(f"{self._name}: not a ROS 2 bag, or damaged: {error}") from None


# --- common --------------------------------------------------------------------------------------------------------


def _kept(records: logs.Records, indices: logs.Integers) -> logs.Records:
    return logs.Records(records.block, records.offsets[indices], records.sizes[indices], records.keys[indices] >> 8)


def _decompressed(data: bytes, method: str, size: int, budget: Budget, name: str, where: str) -> bytes:
    if size > _LARGEST_CHUNK:
        raise ReadError(f"{name}: {where} is damaged: it says that it holds {size} bytes")
    if method == "none":
        chunk = data
    else:
        decoder = _decoder(method, name)
        budget.take(size)
        try:
            chunk = unpack(decoder, data, size)
        except Exception as error:  # each library has errors of its own
            raise ReadError(f"{name}: {where} is damaged: {method} says {error}") from None
    if len(chunk) != size:
        held = len(chunk) if len(chunk) <= size else f"more than {size}"
        raise ReadError(f"{name}: {where} is damaged: expected {size} bytes, found {held}")
    return chunk


def _decoder(method: str, name: str) -> Callable[[], Any]:
    if method == "bz2":
        return bz2.BZ2Decompressor
    try:
        if method == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            return cast("Callable[[], Any]", LZ4FrameDecompressor)
        if method == "zstd":
            try:
                from compression import zstd  # type: ignore[import-not-found, unused-ignore]
            except ImportError:
                from backports import zstd
            return cast("Callable[[], Any]", zstd.ZstdDecompressor)
    except ImportError:
        raise ReadError(f"{name}: compressed with {method}: {install('ros')}") from None
    raise ReadError(f"{name}: compressed with {method!r}; expected none, bz2, lz4 or zstd")


# sensor_msgs/Imu (with MagneticField and Temperature) out of ROS 1 bags, MCAP and ROS 2 sqlite files.


_IMU, _TEMPERATURE, _FIELD = "sensor_msgs/Imu", "sensor_msgs/Temperature", "sensor_msgs/MagneticField"
_DOUBLES = {_IMU: 37, _TEMPERATURE: 2, _FIELD: 12}
_GYRO_AT, _ACCEL_AT = 13, 25  # behind quaternion and its covariance, behind the rate and its covariance
_ACCEL = dict.fromkeys(triad("accel"), "m/s^2")
_GYRO = dict.fromkeys(triad("gyro"), "rad/s")
_MAG = dict.fromkeys(triad("mag"), "T")
_MOST_FIELD = 1e-3
"""T; ten times and more what a magnetometer of a moving unit sees, hard iron included, or can put out."""
_EARTH = (15e-6, 120e-6)
"""T; fields on Earth with the hard iron of an ordinary unit, so narrow that one unit at most fits a number."""
_SAMPLES_LOOKED_AT = 4096  # samples that show what a topic reports; a chunk may hold only one
_ZSTD = b"\x28\xb5\x2f\xfd"


def blocks(path: Path, name: str, selection: Selection) -> Iterator[Recording]:
    """Yield the samples of one Imu topic, or of an accelerometer's and a gyroscope's, with the magnetometer beside it.

    Raises
    ------
    ReadError
        The file is cut or damaged, or holds no Imu topic.
    OptionError
        It holds several and none is chosen, or the chosen one is not there.
    """
    selection.refuse(name, "a ROS bag", topic=False)
    files = [open_container(file, name) for file in (files_of(path, name) if path.is_dir() else [path])]
    topics = [topic for file in files for topic in file.topics]
    notes: list[str] = []
    chosen, field = _choose(topics, selection.topic, name)
    slots = {topic: slot for slot, topic in enumerate(chosen)}
    field = field or _beside(topics, _FIELD, chosen, "magnetometer", notes)
    warm = _beside(topics, _TEMPERATURE, chosen, "temperature", notes)
    for topic in (field, warm):
        if topic is not None:
            slots[topic] = len(slots)
    there, pieces = _reported(_pieces(files, slots, name), name, chosen[0])
    if len(chosen) == 2:
        taken = [slice(0, 3), slice(3, 6)]
        streams = [LoggedStream("accelerometer", _ACCEL), LoggedStream("gyroscope", _GYRO)]
    else:
        if not any(there):
            raise ReadError(f"{name}: {chosen[0]} reports neither specific force nor rate (covariance -1 or nan)")
        taken = [slice(0 if there[0] else 3, 6 if there[1] else 3)]
        streams = [
            LoggedStream(
                "accelerometer" if there[0] else "gyroscope",
                {**(_ACCEL if there[0] else {}), **(_GYRO if there[1] else {})},
            )
        ]
        notes += [
            Finding(f"{chosen[0]} does not report the {what}", "choose a topic that has both (--topic)")
            for what, is_there in zip(("accelerometer", "gyroscope"), there, strict=True)
            if not is_there
        ]
    if field is not None:
        taken.append(slice(0, 3))
        streams.append(LoggedStream("magnetometer", _MAG, placed=True))
        pieces = _in_tesla(pieces, slots[field], field, notes)
    if warm is not None:
        taken.append(slice(0, 1))
        streams.append(LoggedStream("temperature", {"temperature": "degC"}, slow=True))
    yield from side_by_side(
        streams,
        (Piece(p.stream, p.ticks, p.values[:, taken[p.stream]]) for p in pieces),
        name=name,
        per_second=1_000_000_000,
        origin=None,
        metadata=lambda epoch: {
            "topic": ",".join([*chosen, *([field] if field is not None else [])]),
            "epoch": f"{epoch // 10**9}.{epoch % 10**9:09d} s",
        },
        notes=notes,
    )


# --- topics --------------------------------------------------------------------------------------------------------


def _choose(topics: list[Topic], wanted: str | None, name: str) -> tuple[list[str], str | None]:
    """Return the topics of an Imu, one or two, and that of a magnetometer if one is asked for."""
    there = _names_of_type(topics, _IMU)
    if not there:
        known = ", ".join(dict.fromkeys(f"{t.name} ({t.type})" for t in topics)) or "none"
        raise ReadError(f"{name}: no topic of sensor_msgs/Imu; topics found: {known}")
    fields = _names_of_type(topics, _FIELD)
    entries = wanted.split(",") if wanted is not None else []
    named = [entry if entry.startswith("/") or entry in (*there, *fields) else f"/{entry}" for entry in entries]
    field = next((entry for entry in named if entry in fields), None)
    chosen = [entry for entry in named if entry != field]
    if not chosen:
        if len(there) > 1:
            raise OptionError(f"{name}: several Imu topics, choose one with --topic: {' '.join(there)}")
        logging.getLogger(__name__).info("%s: topic %s, the only one of an Imu", name, there[0])
        return there, field
    for entry in chosen:
        if entry not in there:
            also = f"; of MagneticField: {' '.join(fields)}" if fields else ""
            raise OptionError(f"{name}: no Imu topic {entry}; Imu topics found: {listed(there, entry)}{also}")
    if len(chosen) > 2 or len(set(chosen)) < len(chosen):
        raise OptionError(f"{name}: topic {wanted!r}: expected one, or the accelerometer's and the gyroscope's: A,G")
    return chosen, field


def _names_of_type(topics: list[Topic], kind: str) -> list[str]:
    return list(dict.fromkeys(topic.name for topic in topics if topic.type == kind))


def _beside(topics: list[Topic], kind: str, chosen: list[str], what: str, notes: list[str]) -> str | None:
    """Return the topic of a type that belongs to the chosen ones, if any: in their namespace, or the only one."""
    names = _names_of_type(topics, kind)
    near = [name for name in names if name.rpartition("/")[0] == chosen[0].rpartition("/")[0]]
    near = near or [name for name in names if name.startswith(f"{chosen[0]}/")] or names
    if len(near) == 1:
        return near[0]
    if near:
        how = f"; --topic {chosen[0]},{near[0]} takes the first" if kind == _FIELD else ""
        notes.append(Note(f"{what} left out: several topics could be it: {' '.join(near)}{how}"))
    return None


# --- messages ------------------------------------------------------------------------------------------------------


def _pieces(files: list[Container], slots: dict[str, int], name: str) -> Iterator[Piece]:
    for file in files:
        mine = {topic.number: topic for topic in file.topics if topic.name in slots and topic.type in _DOUBLES}
        if not mine:
            continue
        for records in file.messages(mine):
            for number in np.unique(records.keys).tolist():
                topic = mine[number]
                ticks, values = _decoded(records, records.of(number), topic, name)
                yield Piece(slots[topic.name], ticks, _READINGS[topic.type](values))


def _in_tesla(pieces: Iterator[Piece], stream: int, topic: str, notes: list[str]) -> Iterator[Piece]:
    """Yield pieces with magnetic fields in tesla; drivers that write another unit are recognised by the size."""
    factor = None
    for piece in pieces:
        if piece.stream != stream:
            yield piece
            continue
        size = np.linalg.norm(piece.values, axis=1)
        if factor is None and np.isfinite(size).any():
            usual = float(np.median(size[np.isfinite(size)]))
            factor, remarks = _unit_of_field(usual, topic)
            notes += remarks
        yield replace(piece, values=piece.values * factor) if factor else piece


def _unit_of_field(size: float, topic: str) -> tuple[float, list[Note]]:
    """Return the factor to tesla for a field of this usual size, stated as tesla, and a note."""
    if size <= _MOST_FIELD:
        return 1.0, []
    wrong = f"{topic} says that the field is {size:.3g} T, which none on Earth is"
    for unit in ("mT", "gauss", "uT", "mgauss", "nT"):
        factor = parse_unit(unit).factor
        if _EARTH[0] <= size * factor <= _EARTH[1]:
            return factor, [Note(f"{wrong}: its readings are taken as {unit}")]
    return 1.0, [Note(f"{wrong}, and no other unit fits: its readings are left as they are")]


def _reported(pieces: Iterator[Piece], name: str, topic: str) -> tuple[list[bool], Iterator[Piece]]:
    """Return whether the clock's stream reports specific force and rate, from its first samples; and all pieces."""
    before: list[Piece] = []
    there, count = [False, False], 0
    for piece in pieces:
        before.append(piece)
        if piece.stream == 0:
            there = [there[i] or bool(np.isfinite(piece.values[:, 3 * i : 3 * i + 3]).any()) for i in (0, 1)]
            count += len(piece.ticks)
            if all(there) or count >= _SAMPLES_LOOKED_AT:
                break
    if not count:
        raise ReadError(f"{name}: no messages on {topic}")
    return there, chain(before, pieces)


def _readings(values: Array) -> Array:
    """Return specific force and rate, shape (n, 6), NaN where the covariance says that they are not reported."""
    readings = np.empty((len(values), 6))
    for place, at in ((0, _ACCEL_AT), (3, _GYRO_AT)):
        unknown = values[:, at + 3] == -1
        readings[:, place : place + 3] = np.where(unknown[:, None], np.nan, values[:, at : at + 3])
    return readings


def _field(values: Array) -> Array:
    """Return magnetic fields, shape (n, 3), NaN where the covariance says that they are not reported."""
    return np.where(values[:, 3:4] == -1, np.nan, values[:, :3])


_READINGS: dict[str, Callable[[Array], Array]] = {_IMU: _readings, _FIELD: _field, _TEMPERATURE: lambda v: v[:, :1]}


def _decoded(records: logs.Records, indices: logs.Integers, topic: Topic, name: str) -> tuple[logs.Integers, Array]:
    """Return header stamps, ns, (n,), and the doubles after the header, (n, count)."""
    if topic.encoding not in ("cdr", "ros1"):
        raise ReadError(f"{name}: {topic.name} is serialised as {topic.encoding!r}; expected cdr or ros1")
    count = _DOUBLES[topic.type]
    offsets, sizes = records.offsets[indices], records.sizes[indices]

    def refuse(length: int) -> None:
        first = records.block[int(offsets[0]) : int(offsets[0]) + 4]
        hint = "; each message is compressed: convert the bag first ('ros2 bag convert')" if first == _ZSTD else ""
        raise ReadError(f"{name}: {topic.name}: a message of {length} bytes is no {topic.type}{hint}")

    if sizes.min() < 16:
        refuse(int(sizes.min()))
    head = logs.gather(records.block, offsets, 16)
    if topic.encoding == "ros1":
        big = np.zeros(len(head), dtype=bool)
    else:
        if (head[:, 0] != 0).any() or (head[:, 1] > 1).any():
            refuse(int(sizes[0]))
        big = head[:, 1] == 0
    ticks = np.empty(len(head), dtype=np.int64)
    values = np.empty((len(head), count))
    for order, these in (("<", np.flatnonzero(~big)), (">", np.flatnonzero(big))):
        numbers = logs.field(head[these], 4, f"{order}u4", 3).astype(np.int64)
        ticks[these] = numbers[:, 0] * 10**9 + numbers[:, 1]
        frame = numbers[:, 2]
        for length in np.unique(frame).tolist():
            same = these[frame == length]
            start = 16 + length if topic.encoding == "ros1" else 4 + (12 + length + 7) // 8 * 8
            if sizes[same].min() < start + 8 * count:
                refuse(int(sizes[same].min()))
            values[same] = logs.field(
                logs.gather(records.block, offsets[same] + start, 8 * count), 0, f"{order}f8", count
            )
    return ticks, values
