"""What a fit is given, as people have it: a file, a recording, a data frame, or arrays."""

from __future__ import annotations

import hashlib
import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imulab.arguments import check, described
from imulab.errors import DataError, OptionError, listed
from imulab.frames import columns_of_arrays, is_frame, unmasked
from imulab.procedures.result import Result
from imulab.readers import read, read_blocks
from imulab.readers.selection import Selection
from imulab.reading import Data, Reading, Sampling, Window
from imulab.recording import Recording, Source
from imulab.records.calibration import Calibration

Record: TypeAlias = Calibration | Result | str | os.PathLike[str]
"""A record, a fit that holds it, or its file."""


_HINTS = get_type_hints(Reading, include_extras=True)
_OF_ARRAYS = ("rate", "time", "unit", "units")
_OF_FILES = ("layout", "topic", "instance")
_PART = ("window", "element")
_TITLED = "a file says itself, by its titles or a layout"
_EXPECTED = "a file name, a Recording, a data frame of pandas or polars, or arrays"


def as_recording(
    data: Data,
    reading: Mapping[str, Any] | Reading | Sampling,
    function: Callable[..., Any],
    columns: Callable[[NDArray[Any]], Mapping[str, ArrayLike]] | None = None,
    name: str = "data",
) -> Recording:
    """Return data as a recording.

    Parameters
    ----------
    data
        As people have them.
    reading
        How they are to be understood.
    function
        What was called with them, for messages.
    columns
        Array to its columns by name, where `data` is an array without names; a triad of accelerometers if not given.
    name
        The argument that they were given as.

    Raises
    ------
    OptionError
        A keyword that the function does not know, or that does not go with such data.
    DataError
        The data are something else; and what reading them raises.
    """
    called = function.__name__
    check_keywords(reading, function)
    given = {key: value for key, value in reading.items() if value is not None}
    part: dict[str, Any] = {key: given.get(key) for key in _PART}
    if isinstance(data, str | os.PathLike):
        _refuse(given, _OF_ARRAYS, called, _TITLED)
        return read(os.fspath(data), **_only(given, _OF_FILES), **part)
    _refuse(given, _OF_FILES, called, "only files have that")
    if isinstance(data, Recording):
        _refuse(given, _OF_ARRAYS, called, "a recording has its own")
        return _cut(data, **part)
    arrays = _only(given, ("rate", "unit", "units"))
    if is_frame(data):
        _refuse(given, ("time",), called, "a data frame has it as the column 'time'")
        return _cut(Recording.from_frame(data, **arrays), **part)  # type: ignore[arg-type]
    named: Mapping[str, ArrayLike]
    if isinstance(data, Mapping):
        named = data
    else:
        samples = _array(data, called, name)
        named = {"accel": samples} if columns is None else columns(samples)
    whole = {"rate": None, "unit": None, "units": None, **arrays, "name": "arrays"}
    return _cut(Recording(*columns_of_arrays({**_only(given, ("time",)), **named}, **whole), name="arrays"), **part)


def as_blocks(
    data: Data, reading: Mapping[str, Any] | Reading | Sampling, function: Callable[..., Any], name: str = "data"
) -> tuple[Iterator[Recording], Source | None]:
    """Return data in blocks, for what averages them, and the file that they are from; else as for `as_recording`."""
    if not isinstance(data, str | os.PathLike):
        whole = as_recording(data, reading, function, name=name)
        return iter((whole,)), whole.source
    check_keywords(reading, function)
    given = {key: value for key, value in reading.items() if value is not None}
    _refuse(given, _OF_ARRAYS, function.__name__, _TITLED)
    part = _only(given, _PART)
    path, source = Path(data), None
    if path.is_file():
        with path.open("rb") as stream:
            source = Source(str(data), hashlib.file_digest(stream, "sha256").hexdigest())
    return read_blocks(path, **_only(given, _OF_FILES), **part), source


def as_record(record: Record, called: str) -> Calibration:
    """Return a record: that of a fit, or read where its file is named.

    Raises
    ------
    OptionError
        It is neither.
    RecordError
        The file holds none.
    """
    if isinstance(record, Calibration):
        return record
    if isinstance(record, Result):
        return record.calibration
    if isinstance(record, str | os.PathLike):
        return Calibration.load(record)
    raise OptionError(f"{called}: expected a record or the name of its file, found {described(record)}")


def check_keywords(given: Mapping[str, Any], function: Callable[..., Any]) -> None:
    """Refuse keywords that a function does not have.

    Raises
    ------
    OptionError
        There is one; the message says which was meant. Or one that says how data are to be read has another type.
    """
    own = [p.name for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_KEYWORD]
    known = dict.fromkeys([*own, *Sampling.__annotations__, *Reading.__annotations__])
    for key in given:
        if key not in known:
            raise OptionError(f"{function.__name__}: unknown option {key!r}; known: {listed(known, key)}")
        if (hint := _HINTS.get(key)) is not None and given[key] is not None:
            check(given[key], hint, f"{function.__name__}: {key}")


def _array(data: object, called: str, name: str) -> NDArray[Any]:
    """Return samples without a name as an array of numbers."""
    if isinstance(data, np.ndarray | list | tuple) or hasattr(data, "__array__"):
        try:
            found = unmasked(data)
        except ValueError:
            found = np.empty(0, dtype=object)
        if found.dtype.kind in "iufbO" and found.ndim > 1:
            return found
        shape = f"an array of shape {found.shape}" if found.dtype.kind in "iufb" else "a list of something else"
        raise DataError(f"{called}: {name}: expected an array of numbers, a row for each sample, found {shape}")
    raise DataError(f"{called}: {name}: expected {_EXPECTED}, found {described(data)}")


def _cut(recording: Recording, window: Window | None, element: int | None) -> Recording:
    """Return one IMU of several, and what lies within a window of time."""
    parts = list(Selection(window=window, element=element).of(iter([recording]), recording.name))
    if len(parts) == 1:
        return parts[0]
    joined = {key: np.concatenate([part.columns[key] for part in parts]) for key in parts[0].columns}
    return replace(parts[0], columns=joined)


def _refuse(given: Mapping[str, Any], keys: Iterable[str], called: str, reason: str) -> None:
    for key in keys:
        if key in given:
            raise OptionError(f"{called}: {key} does not go with such data: {reason}")


def _only(given: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    return {key: given[key] for key in keys if key in given}
