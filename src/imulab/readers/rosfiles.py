"""The containers that ROS messages come in: ROS 1 bag, MCAP, ROS 2 sqlite.

Sources: ROS wiki "Bags/Format/2.0"; MCAP format specification, version 0; rosbag2_storage_sqlite3 (schema 1 to 4). Each
yields its messages as they lie in the file, in blocks, unparsed.

Not by rosbags (0.11): it unpacks each chunk in one call without a limit, so that the bounds of `unpacking` would need
the heads of all chunks parsed here as before, and it hands out one message at a time: 50,000 samples take it 0.26 s of
a ROS 1 bag and 0.12 s of MCAP, unread, against 0.04 s and 0.05 s here with their numbers.
"""

from __future__ import annotations

import bz2
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

import numpy as np

from imulab.errors import ReadError
from imulab.readers import logs
from imulab.readers.unpacking import Budget, unpack

BAG_MAGIC = b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
_BAG_LINE = b"#ROSBAG V2.0\n"
_FOOTER = 29
_LARGEST_CHUNK = 1 << 31
_LARGEST_VALUE = 1 << 28
_AT_ONCE = 1 << 13


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic: its number in the file, its name, its message type as ``package/Type``, its serialisation."""

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
    """Open a file by its first bytes.

    Raises
    ------
    ReadError
        It is none of these, is cut, or is damaged.
    """
    with path.open("rb") as stream:
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
        with path.open("rb") as stream:
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
            self.topics, found = self._index(stream)
            if found != counts:
                raise ReadError(
                    f"{name}: truncated or damaged: expected {counts[0]} connections and {counts[1]} chunks in the "
                    f"index, found {found[0]} and {found[1]}"
                )

    def messages(self, numbers: Iterable[int]) -> Iterator[logs.Records]:
        """Yield the messages of some connections, a chunk at a time."""
        wanted = [2 | number << 8 for number in numbers]
        budget = Budget(self._path, self._name)
        with self._path.open("rb") as stream:
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
        with path.open("rb") as stream:
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
            for found in self._blocks():
                self._define(found)
        self.topics = list(self._channels.values())

    def messages(self, numbers: Iterable[int]) -> Iterator[logs.Records]:
        """Yield the messages of some channels, a chunk or a block at a time."""
        wanted = [5 | number << 8 for number in numbers]
        for records in self._blocks():
            yield _kept(records, records.of(wanted))

    def _define(self, records: logs.Records) -> None:
        """Take in schemas (u16 id, name, ...) and channels (u16 id, u16 schema, topic, encoding ...)."""
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
        with self._path.open("rb") as stream:
            for records in logs.walk_stream(stream, logs.MCAP, len(MCAP_MAGIC), self._end, ending):
                for index in records.of(6).tolist():
                    yield self._chunk(records.payload(index), budget)
                if not (records.keys == 6).all():
                    yield records
        (end,) = ending
        if end.left or end.position != self._end:
            raise ReadError(f"{self._name}: damaged: no whole record at byte {end.position}")

    def _chunk(self, data: bytes, budget: Budget) -> logs.Records:
        """Take a chunk apart: u64 first and last time, u64 size, u32 CRC, compression, u64 size of the records."""
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
        with path.open("rb") as stream:
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
        """Refuse a view or a computed column in the place of a table: what they give is bounded by no file's size."""
        for table in ("topics", "messages"):
            found = [
                row
                for rows in self._query(f"SELECT type, sql FROM sqlite_master WHERE name = '{table}'")
                for row in rows
            ]
            computed = [row for rows in self._query(f"PRAGMA table_xinfo({table})") for row in rows if row[6]]
            if [kind for kind, _ in found] != ["table"] or computed or "VIRTUAL" in str(found[0][1]).upper():
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
        found = len(chunk) if len(chunk) <= size else f"more than {size}"
        raise ReadError(f"{name}: {where} is damaged: expected {size} bytes, found {found}")
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
        raise ReadError(f"{name}: compressed with {method}; reading it needs pip install 'imulab[ros]'") from None
    raise ReadError(f"{name}: compressed with {method!r}; expected none, bz2, lz4 or zstd")
