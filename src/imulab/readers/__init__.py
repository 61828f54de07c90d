"""Files to recordings: one module per family of formats, one dispatch."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from imulab.errors import ReadError
from imulab.readers.layout import Layout, load_layout
from imulab.readers.mimu import is_mimu, read_mimu
from imulab.readers.text import TextFile
from imulab.recording import Recording, Source

_LIVE_BYTES = 1 << 16

__all__ = ["Layout", "load_layout", "read", "read_blocks"]


def read(file: str | Path, layout: str | Path | Layout | None = None) -> Recording:
    """Read a recording as a whole.

    Parameters
    ----------
    file
        Path of the file; ``-`` reads standard input.
    layout
        How to read a file that is not native CSV: the path of a layout file, or a `Layout`.

    Returns
    -------
    Recording
        With its source's name and SHA-256.

    Raises
    ------
    ReadError, UnitError
        The file cannot be read; the message names file, row and column.
    """
    with _open(file) as stream:
        if layout is None and is_mimu(_start(stream)):
            return read_mimu(stream, _name(file))
        text = TextFile(stream, _name(file), _layout(layout))
        blocks = list(text.blocks())
        source = Source(_name(file), text.sha256())
    first = blocks[0]
    joined = {name: np.concatenate([block.columns[name] for block in blocks]) for name in first.columns}
    return Recording(
        columns=joined if len(blocks) > 1 else first.columns,
        units=first.units,
        metadata=first.metadata,
        name=first.name,
        source=source,
        lines_before=first.lines_before,
        notes=first.notes,
    )


def read_blocks(
    file: str | Path, layout: str | Path | Layout | None = None, *, live: bool = False
) -> Iterator[Recording]:
    """Read a recording in blocks of some ten thousand rows, for what does not fit in memory.

    Parameters and errors are those of `read`; every block has the metadata, and knows its first row. With `live`, whole
    lines of standard input are a block as soon as they are there.
    """
    with _open(file) as stream:
        if layout is None and not live and is_mimu(_start(stream)):
            yield read_mimu(stream, _name(file))
            return
        if live:
            stream = cast(BinaryIO, _Live(stream))
        yield from TextFile(stream, _name(file), _layout(layout)).blocks()


class _Live:
    """A stream whose `read` returns what is there instead of waiting for all that was asked for."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def read(self, size: int) -> bytes:
        return bytes(self._stream.read1(min(size, _LIVE_BYTES)))  # type: ignore[attr-defined]


def _start(stream: BinaryIO) -> bytes:
    """Return the first bytes of a stream without taking them."""
    return bytes(stream.peek(_LIVE_BYTES)) if isinstance(stream, BufferedReader) else b""


def _name(file: str | Path) -> str:
    """What messages and records call a file; bytes that are no UTF-8 are written as escapes."""
    return "standard input" if str(file) == "-" else os.fsencode(file).decode("utf-8", "backslashreplace")


def _layout(layout: str | Path | Layout | None) -> Layout | None:
    return load_layout(layout) if isinstance(layout, str | Path) else layout


def _open(file: str | Path) -> BinaryIO:
    if str(file) == "-":
        return sys.stdin.buffer
    try:
        return Path(file).open("rb")
    except FileNotFoundError:
        raise ReadError(f"{file}: no such file") from None
    except IsADirectoryError:
        raise ReadError(f"{file}: expected a file, found a folder") from None
    except OSError as error:
        raise ReadError(f"{file}: cannot be read: {error.strerror}") from None
