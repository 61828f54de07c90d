"""Arrays of a file through a layout: what HDF5, MATLAB and Parquet files have in common."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from imulab.errors import ReadError
from imulab.readers.layout import Readings
from imulab.recording import Array, Layout, Recording

ROWS = 1 << 16  # of a block of a table held in memory
_INDEXED = re.compile(r"(.*?)\[(\d{1,9})\]")
FLAT = re.compile(r"(.*?)\[(\d{1,9})::(\d{1,9})\]")
"""Every third number of an array from the first on: ``acc[0::3]``."""


def origins(layout: Layout, name: str, kind: str) -> dict[str, tuple[str, int | None]]:
    """Return for each column its variable and, from ``variable[2]``, the number of the array's column.

    Raises
    ------
    ReadError
        The layout takes a column by number, or says what belongs to text.
    """
    variables: dict[str, tuple[str, int | None]] = {}
    text = ("prefix", "skip_incomplete") if kind != "JSON" else ("prefix",)
    for key in text:
        if getattr(layout, key):
            raise ReadError(f"{name}: {layout.name}: {key} is for text, and this is a {kind} file; leave it out")
    for column, entry in layout.columns.items():
        if not isinstance(entry.origin, str):
            raise ReadError(
                f"{name}: {layout.name} takes {column} from column {entry.origin}; in a {kind} file they have names: "
                + (
                    'from = "key" or "object.key", with [0] behind it for a place in an array'
                    if kind == "JSON"
                    else 'from = "variable" or "group/dataset", with [0] behind it for a column of a matrix'
                )
            )
        if entry.date and kind != "JSON":
            raise ReadError(
                f'{name}: {layout.name}: column {column}: unit "iso" is for text, and this is a {kind} file'
            )
        match = _INDEXED.fullmatch(entry.origin)
        variables[column] = (match[1], int(match[2])) if match else (entry.origin, None)
    return variables


def sliced(
    shape: tuple[int, ...], number: int | None, by_rows: bool, where: str
) -> tuple[int, Callable[[Any, int, int], Any]]:
    """Return the length of a column of an array, and a function that returns its rows ``start`` to ``stop``.

    Parameters
    ----------
    shape
        Of the array.
    number
        Which column; None where the array is a vector.
    by_rows
        Whether each column of the matrix is a row of the array (MATLAB in HDF5).

    Raises
    ------
    ReadError
        The array has another shape; `where` begins the message.
    """
    long = [size for size in shape if size != 1]
    if number is None and len(long) <= 1:
        axis = next((i for i, size in enumerate(shape) if size != 1), len(shape) - 1)
        if not shape:
            raise ReadError(f"{where}: expected a vector, found a single value")

        def vector(array: Any, start: int, stop: int) -> Any:
            index: list[Any] = [0] * len(shape)
            index[axis] = slice(start, stop)
            return array[tuple(index)]

        return shape[axis], vector
    if len(shape) != 2:
        raise ReadError(f"{where}: expected a vector or a matrix, found an array of {' x '.join(map(str, shape))}")
    if number is None:
        raise ReadError(
            f"{where}: a matrix of {' x '.join(map(str, shape))}; say which column, with [0] behind its name"
        )
    rows, columns = (shape[1], shape[0]) if by_rows else shape
    if number >= columns:
        raise ReadError(f"{where}: column {number} of a matrix with {columns} columns (counted from 0)")
    if by_rows:
        return rows, lambda array, start, stop: array[number, start:stop]
    return rows, lambda array, start, stop: array[start:stop, number]


def floats_of_rows(rows: Callable[[Any, int, int], Any], source: Any, where: str, start: int, stop: int) -> Array:
    """Return rows `start` to `stop` of an array as floats; `rows` selects them, errors as for `to_floats`."""
    return to_floats(rows(source, start, stop), where)


def to_floats(values: Any, where: str) -> Array:
    """Return an array as float64.

    Raises
    ------
    ReadError
        It holds no real numbers.
    """
    array = np.asarray(values)
    if array.dtype.kind not in "iufb":
        raise ReadError(f"{where}: expected real numbers, found {array.dtype}")
    return array.astype(np.float64, copy=not array.flags.owndata)  # views, of mapped files, must not outlive them


def recordings(
    take: Mapping[str, Callable[[int, int], Array]], lengths: Mapping[str, int], layout: Layout, name: str
) -> Iterator[Recording]:
    """Yield blocks of columns that are read by ``take[column](start, stop)``.

    Raises
    ------
    ReadError
        The columns have different lengths, or none at all.
    """
    if len(set(lengths.values())) > 1:
        described = ", ".join(f"{column} {length}" for column, length in lengths.items())
        raise ReadError(f"{name}: columns of different length: {described}")
    total = next(iter(lengths.values()), 0)
    if total == 0:
        raise ReadError(f"{name}: no rows of data")
    readings = Readings(layout, name)
    for start in range(0, total, ROWS):
        stop = min(start + ROWS, total)
        columns = {column: function(start, stop) for column, function in take.items()}
        converted = readings.of(columns, start + 1)
        yield Recording(
            columns=converted,
            units=layout.units,
            metadata={**(layout.metadata or {}), **readings.epoch},
            name=name,
            first_row=start + 1,
            from_file=True,
        )
