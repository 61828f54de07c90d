"""Recordings to native CSV."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from imulab.errors import OptionError
from imulab.files import replacing
from imulab.recording import Recording

_ROWS_AT_ONCE = 65536


def write_csv(blocks: Recording | Iterable[Recording], path: str | Path) -> None:
    """Write a recording, or its consecutive blocks, as native CSV, whole or not at all.

    Numbers are written so that they read back exactly; metadata becomes head comments ``# key: value``.

    Raises
    ------
    OptionError
        The name does not end in .csv, or the file cannot be written there.
    """
    if Path(path).suffix.lower() != ".csv":
        raise OptionError(
            f"{path}: cannot write this kind of file; expected a name that ends in .csv (Parquet is not supported yet)"
        )
    with replacing(path) as stream:
        write_csv_to(blocks, stream)


def write_csv_to(blocks: Recording | Iterable[Recording], stream: BinaryIO) -> None:
    """Write a recording, or its consecutive blocks, as native CSV to an open binary stream."""
    head = True
    for block in [blocks] if isinstance(blocks, Recording) else blocks:
        if head:
            stream.write(_head(block).encode("utf-8"))
            head = False
        columns = list(block.columns.values())
        for start in range(0, len(block), _ROWS_AT_ONCE):
            texts = [map(repr, column[start : start + _ROWS_AT_ONCE].tolist()) for column in columns]
            rows = "\n".join(map(",".join, zip(*texts, strict=True)))
            stream.write(rows.encode("ascii") + b"\n")


def _head(recording: Recording) -> str:
    for name in recording.columns:
        if not name or set(name) & set(',"[]#\r\n') or name != name.strip():
            raise OptionError(f"{recording.name}: column name {name!r} cannot be written to CSV")
    comments = "".join(f"# {_one_line(key)}: {_one_line(value)}\n" for key, value in recording.metadata.items())
    titles = ",".join(f"{name} [{unit}]" if unit != "1" else name for name, unit in recording.units.items())
    return f"{comments}{titles}\n"


def _one_line(text: str) -> str:
    return " ".join(text.splitlines())
