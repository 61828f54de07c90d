"""MATLAB files of version 5 to 7 through a layout: ``from = "variable"``, ``"struct/field"``, ``"matrix[0]"``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from imulab.errors import ReadError
from imulab.readers.arrays import origins, recordings, sliced, to_floats
from imulab.readers.layout import Layout
from imulab.recording import Array, Recording


def blocks(path: Path, name: str, layout: Layout | None) -> Iterator[Recording]:
    """Yield the columns that a layout names; the variables are held in memory, which the format asks for.

    Raises
    ------
    ReadError
        The file is cut or damaged, there is no layout, or a variable is not there or no column.
    """
    if layout is None:
        found = ", ".join(f"{key} ({' x '.join(map(str, shape))})" for key, shape, _ in _call("whosmat", path, name))
        raise ReadError(
            f"{name}: say with --layout FILE.toml which variable is which column; variables found: {found or 'none'}"
        )
    wanted = origins(layout, name, "MATLAB")
    roots = sorted({variable.partition("/")[0] for variable, _ in wanted.values()})
    variables = _call("loadmat", path, name, variable_names=roots)
    take: dict[str, Callable[[int, int], Array]] = {}
    lengths: dict[str, int] = {}
    for column, (variable, number) in wanted.items():
        where = f"{name}: {layout.name} takes {column} from {variable!r}"
        root, *fields = variable.split("/")
        if root not in variables:
            found = " ".join(str(key) for key, *_ in _call("whosmat", path, name))
            raise ReadError(f"{where}, found {found or 'no variables'}")
        array: Any = variables[root]
        for field in fields:
            names = getattr(getattr(array, "dtype", None), "names", None)
            if not names or field not in names:
                raise ReadError(f"{where}, found {' '.join(names) if names else 'no struct'}")
            array = array[field]
            while isinstance(array, np.ndarray) and array.dtype == object and array.size == 1:
                array = array.ravel()[0]
        if not isinstance(array, np.ndarray) or array.dtype.names:
            raise ReadError(
                f"{where}: expected numbers, found {'a struct' if hasattr(array, 'dtype') else type(array).__name__}"
            )
        if array.dtype.kind not in "iufb":
            raise ReadError(f"{where}: expected real numbers, found {array.dtype}")
        lengths[column], rows = sliced(array.shape, number, False, where)
        take[column] = partial(_floats, rows, array, where)
    yield from recordings(take, lengths, layout, name)


def _floats(rows: Callable[[Any, int, int], Any], array: Any, where: str, start: int, stop: int) -> Array:
    return to_floats(rows(array, start, stop), where)


def _call(function: str, path: Path, name: str, **options: Any) -> Any:
    import scipy.io

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return getattr(scipy.io, function)(path, appendmat=False, **options)
    except (Exception, MemoryError) as error:  # scipy raises whatever the bytes lead it to
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise ReadError(f"{name}: not a whole MATLAB file: {text}") from None
