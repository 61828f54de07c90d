"""Compressed parts of files, unpacked within bounds: a few kilobytes can pretend to hold terabytes.

A file may unpack to 64 MiB, or to 200 times its size where that is more, but to no more than 8 GiB; measured data of
sensors compress by less than 20. `raise_limit` (``--unpack-limit``) allows more.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from imulab.errors import ReadError

_SMALL, _RATIO, _LARGEST = 1 << 26, 200, 1 << 33
_raised: ContextVar[int | None] = ContextVar("unpack_limit", default=None)


def raise_limit(size: int | None) -> None:
    """Set how many bytes a file may unpack to, for this thread; None goes back to the usual bounds."""
    _raised.set(size)


class Budget:
    """How much a file may still unpack to."""

    def __init__(self, path: Path, name: str) -> None:
        usual = max(_SMALL, min(_LARGEST, _RATIO * path.stat().st_size))
        self._name, self._limit = name, _raised.get() or usual
        self.left = self._limit

    def take(self, size: int) -> None:
        """Count bytes that are about to be unpacked.

        Raises
        ------
        ReadError
            They are more than the file may have.
        """
        self.left -= size
        if self.left < 0:
            raise ReadError(
                f"{self._name}: unpacks to more than {self._limit / 1e6:.0f} MB, which no measured data of this size "
                "do; where the file is to be trusted, --unpack-limit SIZE raises the limit"
            )


def unpack(decoder: Callable[[], Any], data: bytes | memoryview, most: int) -> bytes:
    """Return what compressed data hold, or a byte more than `most` where they hold more.

    `decoder` makes a decompressor as the standard library has them (zlib, bz2, and lz4 and zstd likewise).

    Raises
    ------
    EOFError
        The data end before their end is reached.
    """
    parts: list[bytes] = []
    room = most + 1
    while len(data) and room > 0:
        state = decoder()
        parts.append(state.decompress(data, room))
        room -= len(parts[-1])
        if not state.eof:
            if room > 0:
                raise EOFError("the data are cut")
            break
        data = state.unused_data or b""  # None from lz4
    return b"".join(parts)
