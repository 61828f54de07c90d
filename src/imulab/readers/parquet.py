"""Parquet: columns named ``name [unit]``, or any names through a layout; file metadata as ``key: value``.

By pyarrow, as everywhere: it reads and writes files larger than memory part by part, for which polars has no stable
calls, and is imported in 0.55 s against 0.7 s; both take 170 MB.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from imulab.columns import kind_of, measured, parse_column_title
from imulab.display import Note
from imulab.errors import ReadError, listed
from imulab.files import within
from imulab.readers.arrays import ROWS, origins, to_floats
from imulab.readers.formats import Budget, library
from imulab.readers.layout import Readings
from imulab.recording import CORRECTED_BY, Array, Layout, Recording

_NUMPY = {"double": "f8", "float": "f4", "halffloat": "f2"}  # numpy's names of pyarrow's types that it does not know
_BYTES = 8  # of a number in memory
_NOT_OURS = ("ARROW:", "org.apache.")
_OTHERS_JSON = ("pandas", "huggingface", "geo")  # metadata of other writers, whose text begins with a brace


def blocks(
    path: Path, name: str, layout: Layout | None, stated: Mapping[str, str] | None = None
) -> Iterator[Recording]:
    """Yield the rows of a Parquet file.

    Raises
    ------
    ReadError
        The library is missing, the file is cut or damaged, has no rows, or a column that holds no numbers.
    UnitError
        A column has no unit or an unknown one.
    """
    arrow = library("pyarrow", "Parquet", "tables", name)
    from pyarrow import parquet

    row, budget = 1, Budget(path, name, most=math.inf)
    try:
        with parquet.ParquetFile(within(path), memory_map=False, pre_buffer=False, buffer_size=1 << 20) as file:
            there = file.schema_arrow.names
            columns, units = _columns(there, name, layout, stated)
            notes: tuple[Note, ...] = ()
            if layout is None:
                texts = [key for key, title in columns.items() if _is_text(arrow, file.schema_arrow, title, key)]
                columns = {key: title for key, title in columns.items() if key not in texts}
                notes = tuple(Note(f"column {key} holds text, which is left out") for key in texts)
                units = {key: units[key] for key in columns}
            # Runs of one value take no room in the file, and a page is unpacked as a whole.
            for number in range(file.metadata.num_row_groups):
                budget.check(file.metadata.row_group(number).total_byte_size)
            stored = file.schema_arrow.metadata or {}
            readings = Readings(layout, name) if layout else None
            metadata = {**_metadata(stored), **((layout and layout.metadata) or {})}
            corrected = tuple(stored.get(CORRECTED_BY.encode(), b"").decode("utf-8", "replace").splitlines())
            for batch in file.iter_batches(
                batch_size=ROWS, columns=list(dict.fromkeys(columns.values())), use_threads=False
            ):
                if batch.num_rows == 0:
                    continue
                budget.take(_BYTES * batch.num_rows * len(columns))
                values = {key: _floats(arrow, batch.column(title), title, name) for key, title in columns.items()}
                if readings is not None:
                    values = readings.of(values, row)
                yield Recording(
                    values, units, metadata, name, first_row=row, corrected_by=corrected, notes=notes, from_file=True
                )
                row += batch.num_rows
    except (arrow.ArrowException, OSError, ValueError, MemoryError) as error:
        raise ReadError(f"{name}: not a whole Parquet file: {' '.join(str(error).split())[:160]}") from None
    if row == 1:
        raise ReadError(f"{name}: no rows of data")


def _is_text(arrow: Any, schema: Any, title: str, column: str) -> bool:
    """Return whether a column that imulab does not know holds text."""
    kind = schema.field(title).type
    return kind_of(measured(column)) is None and (arrow.types.is_string(kind) or arrow.types.is_large_string(kind))


def _columns(
    there: list[str], name: str, layout: Layout | None, stated: Mapping[str, str] | None
) -> tuple[dict[str, str], dict[str, str]]:
    """Return for each column its title in the file, and its unit."""
    columns: dict[str, str] = {}
    units: dict[str, str] = {}
    if layout is None:
        for title in there:
            key, unit = parse_column_title(title, name, stated)
            if key in columns:
                raise ReadError(f"{name}: column {key} appears twice")
            columns[key], units[key] = title, unit
        return columns, units
    for key, (title, number) in origins(layout, name, "Parquet").items():
        title = title if number is None else f"{title}[{number}]"
        if there.count(title) != 1:
            raise ReadError(
                f"{name}: {layout.name} takes {key} from a column named {title!r}, found {listed(there, title)}"
            )
        columns[key] = title
    return columns, layout.units


def _metadata(pairs: dict[bytes, bytes]) -> dict[str, str]:
    texts = {k.decode("utf-8", "replace"): v.decode("utf-8", "replace") for k, v in pairs.items()}
    return {
        key: " ".join(value.splitlines())
        for key, value in texts.items()
        if key != CORRECTED_BY and not key.startswith(_NOT_OURS) and not (key in _OTHERS_JSON and value.startswith("{"))
    }


def _floats(arrow: Any, column: Any, title: str, name: str) -> Array:
    kind = column.type
    if not (arrow.types.is_integer(kind) or arrow.types.is_floating(kind) or arrow.types.is_boolean(kind)):
        raise ReadError(f"{name}: column {title}: expected numbers, found {kind}")
    if column.null_count or arrow.types.is_boolean(kind):
        column = column.cast(arrow.float64(), safe=False).fill_null(float("nan"))
    # Its buffer, because pyarrow's own conversion imports pandas, which takes longer than most files.
    dtype = np.dtype(_NUMPY.get(str(column.type), str(column.type)))
    values = np.frombuffer(column.buffers()[1], dtype, len(column), column.offset * dtype.itemsize)
    return to_floats(values, f"{name}: column {title}")
