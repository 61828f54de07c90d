"""Columns of large recordings in temporary files: what has to look at a whole column has one at a time in memory."""

from __future__ import annotations

import errno
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import IO, Any

import numpy as np

from imulab.errors import DataError
from imulab.recording import Array, Recording

LARGE = 1 << 28
"""Bytes of a file whose rows are not kept in memory."""


def is_large(file: str | PathLike[str] | None) -> bool:
    """Return whether a file is so large that its rows are not kept in memory."""
    if file is None or not (path := Path(file)).is_file():
        return False
    return path.stat().st_size > LARGE


def on_disk(blocks: Iterator[Recording]) -> Recording:
    """Return a recording from its blocks of rows, its columns in temporary files, which go with the last use of them.

    Raises
    ------
    DataError
        There is no room for the files.
    """
    first = next(blocks)
    files = {name: _file() for name in first.columns}
    notes: dict[str, None] = {}
    head, block = replace(first, columns={}), first
    while True:
        notes |= dict.fromkeys(block.notes)
        for name, file in files.items():
            _write(file, block.columns[name], head.name)
        if (following := next(blocks, None)) is None:
            break
        block = following
    columns = {name: _mapped(file) for name, file in files.items()}
    return replace(head, columns=columns, units=first.units, notes=tuple(notes))


def stored_as(values: Array, like: Array) -> Array:
    """Return values, shape (n,), in a temporary file where `like` is in one; else as they are."""
    base: Any = like
    while base is not None and not isinstance(base, np.memmap):
        base = getattr(base, "base", None)
    if base is None:
        return values
    file = _file()
    _write(file, values, "recording")
    return _mapped(file)


def _file() -> IO[bytes]:
    return tempfile.TemporaryFile()


def _write(file: IO[bytes], values: Array, name: str) -> None:
    try:
        file.write(np.ascontiguousarray(values, dtype=np.float64).data)
        file.flush()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        raise DataError(
            f"{name}: no room in {tempfile.gettempdir()} for columns that do not fit in memory; expected 8 bytes for "
            "each number of the log there, or another folder in the environment variable TMPDIR"
        ) from None


def _mapped(file: IO[bytes]) -> Array:
    with file:
        return np.memmap(file, np.float64, "r") if file.tell() else np.empty(0)
