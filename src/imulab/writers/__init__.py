"""Recordings to native CSV and Parquet, with doubles as the shortest decimals that read back exactly."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

import imulab.writers._digits as _digits
from imulab.errors import DataError, OptionError, file_name, install, quoted
from imulab.files import replacing
from imulab.recording import CORRECTED_BY, Array, Recording

if TYPE_CHECKING:
    from collections.abc import Mapping


# Powers of ten to 128 bits, for the C modules that read and print numbers; made when first needed.


_LOWEST, _HIGHEST = -342, 308  # powers of ten between which double precision has numbers


@cache
def powers_of_five() -> bytes:
    """Return 5^q for q = -342 .. 308, each scaled by a power of two to 128 bits: high half, low half (uint64).

    Rounded as D. Lemire, "Number parsing at a gigabyte per second", 2021, prescribes: up for -27 <= q < 0, else down.
    """
    words = []
    for q in range(_LOWEST, _HIGHEST + 1):
        power = 5 ** abs(q)
        size = power.bit_length()
        if q >= 0:
            number = power << 128 - size if size <= 128 else power >> size - 128
        elif q >= -27:
            number = (1 << size + 127) // power + 1
        else:
            number = (1 << 2 * size + 128) // power + 1
            number >>= number.bit_length() - 128
        words += [number >> 64, number & (1 << 64) - 1]
    return struct.pack(f"={len(words)}Q", *words)


@cache
def powers_of_ten() -> bytes:
    """Return 10^k for k = -292 .. 324, each scaled by a power of two to 128 bits, rounded up: high half, low half."""
    words = []
    for k in range(-292, 325):
        power = 5 ** abs(k)
        size = power.bit_length()
        if k >= 0:
            number = power << 128 - size if size <= 128 else -(-power >> size - 128)
        else:
            number = -(-(1 << size + 127) // power)
        words += [number >> 64, number & (1 << 64) - 1]
    return struct.pack(f"={len(words)}Q", *words)


# Doubles as the shortest decimals that read back exactly, as Python writes them, many at once.


def decimal_rows(table: Array) -> bytes | memoryview:
    """Return a table, shape (rows, columns), as lines of decimals with commas between them."""
    if not table.size or not _prepare():
        return "".join(",".join(map(repr, row)) + "\n" for row in table.tolist()).encode("ascii")
    out = bytearray(25 * table.size)
    return memoryview(out)[: _digits.rows(np.ascontiguousarray(table, dtype=np.float64), table.shape[1], out)]


@cache
def _prepare() -> bool:
    """Pass the powers of ten to C; return False where it cannot use them and writes numbers another way."""
    return _digits.prepare(powers_of_ten())


# Recordings to native CSV and Parquet.


_ROWS_AT_ONCE = 65536  # of text that is made in memory
_ROW_GROUP = 1 << 18  # rows of a row group of a Parquet file


def write(blocks: Recording | Iterable[Recording], path: str | Path) -> None:
    """Write a recording, or its consecutive blocks, as native CSV or Parquet by the ending of the name.

    Numbers read back exactly; columns keep their names, order and units; metadata becomes head comments
    ``# key: value`` or Parquet metadata. The file is written whole or not at all.

    Raises
    ------
    OptionError
        The name ends in neither .csv nor .parquet, or the file cannot be written there.

    Examples
    --------
    >>> import imulab as il
    >>> il.write(il.simulate_tumble(), "recording.csv")
    >>> il.read("recording.csv").units["accel_x"]
    'm/s^2'
    """
    kind = Path(file_name(path)).suffix.lower()
    if kind not in (".csv", ".parquet"):
        raise OptionError(f"{path}: cannot write this kind of file; expected a name that ends in .csv or .parquet")
    with replacing(path) as stream:
        (write_csv_to if kind == ".csv" else write_parquet_to)(blocks, stream)


def check_writable(path: str) -> None:
    """Refuse a name that `write` cannot write, before the work.

    Raises
    ------
    OptionError
        It cannot, or the library for it is not here.
    """
    kind = Path(path).suffix.lower()
    if kind not in (".csv", ".parquet"):
        raise OptionError(f"{path}: cannot write this kind of file; expected a name that ends in .csv or .parquet")
    if kind == ".parquet":
        _pyarrow()


def write_csv(blocks: Recording | Iterable[Recording], path: str | Path) -> None:
    """Write a recording, or its consecutive blocks, as native CSV; see `write`.

    Raises
    ------
    OptionError
        The name does not end in .csv, or the file cannot be written there.

    Examples
    --------
    >>> import imulab as il
    >>> il.write_csv(il.simulate_tumble(), "recording.csv")
    >>> len(il.read("recording.csv")) > 0
    True
    """
    if Path(file_name(path)).suffix.lower() != ".csv":
        raise OptionError(f"{path}: cannot write this kind of file; expected a name that ends in .csv")
    write(blocks, path)


def write_csv_to(blocks: Recording | Iterable[Recording], stream: BinaryIO) -> None:
    """Write a recording, or its consecutive blocks, as native CSV to an open binary stream."""
    head = True
    for block in _several(blocks):
        if head:
            stream.write(_head(block).encode("utf-8"))
            head = False
        columns = list(block.columns.values())
        for start in range(0, len(block), _ROWS_AT_ONCE):
            part = [column[start : start + _ROWS_AT_ONCE] for column in columns]
            stream.write(decimal_rows(np.column_stack(part)) if part else b"\n")


def write_parquet_to(blocks: Recording | Iterable[Recording], stream: BinaryIO) -> None:
    """Write a recording, or its consecutive blocks, as Parquet to an open binary stream.

    Raises
    ------
    OptionError
        The library for Parquet is not here.
    """
    arrow = _pyarrow()
    from pyarrow import parquet

    writer = None
    waiting: list[Any] = []
    try:
        for block in _several(blocks):
            titles = [_title(name, unit) for name, unit in block.units.items()]
            arrays = [_arrow_array(arrow, column) for column in block.columns.values()]
            table = arrow.Table.from_arrays(arrays, names=titles)
            if writer is None:
                table = table.replace_schema_metadata(_clean(block.metadata) | _corrected_by(block))
                # Measured doubles hardly repeat: a dictionary costs time and saves nothing.
                writer = parquet.ParquetWriter(stream, table.schema, compression="zstd", use_dictionary=False)
            waiting.append(table.replace_schema_metadata(writer.schema.metadata))
            if sum(part.num_rows for part in waiting) >= _ROW_GROUP:
                writer.write_table(arrow.concat_tables(waiting))
                waiting = []
        if writer is not None and waiting:
            writer.write_table(arrow.concat_tables(waiting))
    finally:
        if writer is not None:
            writer.close()


def _arrow_array(arrow: Any, column: Array) -> Any:
    """Return numbers as pyarrow holds them; its own conversion would import pandas, half of a command's time."""
    buffer = arrow.py_buffer(np.ascontiguousarray(column))
    return arrow.Array.from_buffers(arrow.from_numpy_dtype(column.dtype), len(column), [None, buffer])


def _pyarrow() -> Any:
    try:
        import pyarrow
    except ImportError:
        raise OptionError(f"writing Parquet needs pyarrow, which is not here: {install('tables')}") from None
    return pyarrow


def _several(blocks: Recording | Iterable[Recording]) -> Iterator[Recording]:
    block = None
    for block in [blocks] if isinstance(blocks, Recording) else blocks:
        if not isinstance(block, Recording):
            raise DataError(f"expected a Recording to write, found {quoted(block)}")
        yield block
    if not isinstance(blocks, Recording) and block is None:
        raise DataError("expected a Recording to write, found none")


def _title(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit != "1" else name


def _clean(metadata: Mapping[str, str]) -> dict[str, str]:
    return {_one_line(key): _one_line(value) for key, value in metadata.items()}


def _corrected_by(recording: Recording) -> dict[str, str]:
    return {CORRECTED_BY: "\n".join(map(_one_line, recording.corrected_by))} if recording.corrected_by else {}


def _head(recording: Recording) -> str:
    for name in recording.columns:
        if not name or set(name) & set(',"[]#\r\n') or name != name.strip():
            raise OptionError(f"{recording.name}: column name {name!r} cannot be written to CSV")
    pairs = [
        *_clean(recording.metadata).items(),
        *((CORRECTED_BY, _one_line(entry)) for entry in recording.corrected_by),
    ]
    comments = "".join(f"# {key}: {value}\n" for key, value in pairs)
    titles = ",".join(_title(name, unit) for name, unit in recording.units.items())
    return f"{comments}{titles}\n"


def _one_line(text: str) -> str:
    return " ".join(text.splitlines())
