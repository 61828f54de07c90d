"""HDF5, and MATLAB v7.3 (which is HDF5 with transposed matrices), through a layout: ``from = "group/dataset"``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

from imulab.errors import ReadError
from imulab.files import within
from imulab.readers.arrays import floats_of_rows, origins, recordings, sliced
from imulab.readers.formats import Budget, library
from imulab.recording import Array, Layout, Recording

_LISTED = 20  # names that a message lists


def blocks(path: Path, name: str, layout: Layout | None) -> Iterator[Recording]:
    """Yield the columns that a layout names.

    Raises
    ------
    ReadError
        The library is missing, the file is cut or damaged, there is no layout, or a dataset is not there or no column.
    """
    h5py = library("h5py", "HDF5", "hdf5", name)
    try:
        file = h5py.File(within(path), "r")
    except Exception as error:  # h5py raises OSError, RuntimeError, KeyError ...
        raise ReadError(f"{name}: not a whole HDF5 file: {_short(error)}") from None
    with file:
        try:
            yield from _recordings(h5py, file, Budget(path, name), name, layout)
        except (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError) as error:
            raise ReadError(f"{name}: damaged: {_short(error)}") from None


def _recordings(h5py: Any, file: Any, budget: Budget, name: str, layout: Layout | None) -> Iterator[Recording]:
    if layout is None:
        raise ReadError(
            f"{name}: say with --layout FILE.toml which dataset is which column; datasets found: {_list(h5py, file)}"
        )
    counted: set[Any] = set()
    take: dict[str, Callable[[int, int], Array]] = {}
    lengths: dict[str, int] = {}
    for column, (variable, number) in origins(layout, name, "HDF5").items():
        where = f"{name}: {layout.name} takes {column} from {variable!r}"
        dataset, member = _dataset(h5py, file, variable)
        if dataset is None:
            raise ReadError(f"{where}, found {_list(h5py, file)}")
        _check_storage(dataset, where)
        if dataset.id not in counted and _unpacked(dataset) > dataset.id.get_storage_size():
            budget.take(_unpacked(dataset))
        counted.add(dataset.id)
        lengths[column], rows = sliced(dataset.shape or (), number, "MATLAB_class" in dataset.attrs, where)
        source = dataset if member is None else dataset.fields(member)
        take[column] = partial(floats_of_rows, rows, source, where)
    yield from recordings(take, lengths, layout, name)


def _check_storage(dataset: Any, where: str) -> None:
    if dataset.external or dataset.is_virtual:
        raise ReadError(f"{where}: its numbers lie in other files; expected a file that holds its own data")


def _unpacked(dataset: Any) -> int:
    """Return the bytes that a dataset takes in memory, or one of its chunks if that is more."""
    chunk = prod(dataset.chunks) * dataset.dtype.itemsize if dataset.chunks else 0
    return max(int(dataset.nbytes), chunk)


def _dataset(h5py: Any, file: Any, variable: str) -> tuple[Any, str | None]:
    """Return a dataset, or a table's dataset and the name of its member."""
    item = _get(h5py, file, variable)
    if isinstance(item, h5py.Dataset):
        return item, None
    parent, _, member = variable.rpartition("/")
    item = _get(h5py, file, parent)
    if isinstance(item, h5py.Dataset) and item.dtype.names and member in item.dtype.names:
        return item, member
    return None, None


def _get(h5py: Any, file: Any, path: str) -> Any:
    """Return what lies at a path of this file, or None; links that lead into other files are not followed."""
    item = file
    for part in path.strip("/").split("/"):
        if not part or not isinstance(item, h5py.Group):
            return None
        if isinstance(item.get(part, getlink=True), h5py.ExternalLink):
            return None
        item = item.get(part)
        if item is not None and item.file.filename != file.filename:
            return None  # a soft link may lead through an external one
    return item


def _list(h5py: Any, file: Any) -> str:
    names: list[str] = []

    def note(path: str, item: Any) -> bool | None:
        if isinstance(item, h5py.Dataset) and not path.startswith("#"):
            members = item.dtype.names
            names.extend([f"{path}/{m}" for m in members] if members else [f"{path} ({_size(item.shape)})"])
        return True if len(names) > _LISTED else None

    file.visititems(note)
    return ", ".join(names[:_LISTED]) + (" ..." if len(names) > _LISTED else "") if names else "none"


def _size(shape: tuple[int, ...] | None) -> str:
    return " x ".join(map(str, shape)) if shape else "a single value"


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__
