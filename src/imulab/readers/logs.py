"""Records of a log, found by the C module `_logs`, and their payloads as NumPy arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

import imulab.readers._logs as _logs
from imulab.errors import ReadError

ULOG, DATAFLASH, MCAP, ROSBAG = range(4)
MORE, FULL, DAMAGED = range(3)

Integers = NDArray[np.int64]
PLAINLY_MORE = 1.5
"""A message with so many times fewer samples than another of the same content is logged at a low rate, for display."""
_AT_ONCE = 1 << 18  # messages whose starts are held at once
BLOCK_BYTES = 1 << 23  # read at once
_MCAP_READ = (3, 4, 5, 6)  # schema, channel, message, chunk; attachments may be larger than memory


@dataclass(frozen=True, slots=True)
class Records:
    """Consecutive records of a block: payload offsets, payload sizes and keys, each of shape (n,)."""

    block: bytes
    offsets: Integers
    sizes: Integers
    keys: Integers

    def payload(self, index: int) -> bytes:
        """Return the payload of one record."""
        start = int(self.offsets[index])
        return self.block[start : start + int(self.sizes[index])]

    def of(self, keys: int | list[int]) -> Integers:
        """Return the indices of the records of these kinds."""
        return np.flatnonzero(np.isin(self.keys, keys))


def walk(kind: int, block: bytes, start: int = 0, lengths: Any = None) -> tuple[Records, int, int]:
    """Return the records of a block from `start`, where the walk ended, and why (MORE, FULL, DAMAGED)."""
    room = min(_AT_ONCE, len(block) // 3 + 1)
    offsets, sizes, keys = (np.empty(room, dtype=np.int64) for _ in range(3))
    table = np.zeros(256, dtype=np.uint8) if lengths is None else lengths
    count, position, status = _logs.walk(kind, block, start, table, offsets, sizes, keys)
    return Records(block, offsets[:count], sizes[:count], keys[:count]), position, status


def walk_all(kind: int, block: bytes) -> tuple[Records, int, int]:
    """Return all records of a block."""
    parts: list[Records] = []
    position, status = 0, FULL
    while status == FULL:
        records, position, status = walk(kind, block, position)
        parts.append(records)
    if len(parts) == 1:
        return parts[0], position, status
    joined = (np.concatenate([getattr(part, name) for part in parts]) for name in ("offsets", "sizes", "keys"))
    return Records(block, *joined), position, status


def gather(block: bytes, offsets: Integers, width: int) -> NDArray[np.uint8]:
    """Return `width` bytes from each offset, shape (n, width); all must lie within the block."""
    if offsets.size == 0:
        return np.empty((0, width), dtype=np.uint8)
    view = sliding_window_view(np.frombuffer(block, dtype=np.uint8), width)
    taken: NDArray[np.uint8] = view[offsets]
    return taken


def field(rows: NDArray[np.uint8], offset: int, kind: str, count: int = 1) -> NDArray[Any]:
    """Return a field of gathered payloads, shape (n,) or (n, count), as numbers of NumPy type `kind`."""
    dtype = np.dtype(kind)
    part = np.ascontiguousarray(rows[:, offset : offset + count * dtype.itemsize])
    values = part.view(dtype)
    return values[:, 0] if count == 1 else values


@dataclass(frozen=True, slots=True)
class Ending:
    """End of a log: the byte where reading stopped, how many bytes were left, and whether they are damaged."""

    position: int
    left: bytes
    damaged: bool


def walk_stream(stream: BinaryIO, kind: int, start: int, limit: int, ending: list[Ending]) -> Iterator[Records]:
    """Yield the records of a file from byte `start` to byte `limit`; its ending is appended to `ending`."""
    lengths = np.zeros(256, dtype=np.uint8)
    stream.seek(start)
    base, rest = start, b""
    while True:
        data = stream.read(min(BLOCK_BYTES, limit - base - len(rest)))
        block = rest + data
        position, status = 0, FULL
        while status == FULL:
            records, position, status = walk(kind, block, position, lengths)
            if records.keys.size:
                yield records
        base += position
        rest = block[position:]
        if status == MORE and (size := _passed_over(kind, rest, limit - base)):
            base, rest = base + size, b""
            stream.seek(base)
            continue
        if status == DAMAGED or not data:
            ending.append(Ending(base, rest, status == DAMAGED))
            return


def _passed_over(kind: int, rest: bytes, most: int) -> int:
    """Return the size of a record that need not be read, if it is whole in the file but not in the block, or 0."""
    if kind != MCAP or len(rest) < 9 or rest[0] in _MCAP_READ:
        return 0
    size = 9 + int.from_bytes(rest[1:9], "little")
    return size if len(rest) < size <= most else 0


def text_of(data: bytes, name: str, what: str) -> str:
    """Return a text of a log, decoded.

    Raises
    ------
    ReadError
        It is not UTF-8.
    """
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        raise ReadError(f"{name}: {what}: expected UTF-8 text, found {data[:20]!r}") from None
