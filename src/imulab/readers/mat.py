"""MATLAB files of version 5 to 7 through a layout: ``from = "variable"``, ``"struct/field"``, ``"matrix[0]"``.

Read here and not by scipy.io, whose compiled reader ends the process on some damaged files. Source: MathWorks,
"MAT-File Format" (version 5): a head of 128 bytes, then elements u32 type, u32 size, payload padded to 8 bytes; a
matrix is an element that holds flags, dimensions, name and numbers.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from math import prod
from pathlib import Path
from typing import BinaryIO

import numpy as np

from imulab.errors import ReadError, listed
from imulab.files import open_file
from imulab.readers.arrays import floats_of_rows, origins, recordings, sliced
from imulab.readers.formats import Budget, unpack
from imulab.recording import Array, Layout, Recording

_HEAD = 128  # bytes of the head of a MAT-file, level 5
_NAMED = 4096  # bytes of a variable that hold its name: the format allows 63 letters
_ORDERS = {b"IM": "<", b"MI": ">"}
_MATRIX, _COMPRESSED = 14, 15  # miMATRIX and miCOMPRESSED of the MAT-file format
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
# MxSTRUCT_CLASS, mxDOUBLE_CLASS and mxUINT64_CLASS of the MAT-file format
_STRUCT, _FIRST_NUMBER, _LAST_NUMBER = 2, 6, 15
_CLASSES = {1: "a cell", 2: "a struct", 3: "an object", 4: "text", 5: "a sparse matrix"}
_COMPLEX = 0x0800  # flag of a complex array
_DEEPEST = 20  # structs within structs
_LISTED = 20  # names that a message lists


class _DamagedError(Exception):
    """The bytes are no element of the format."""


@dataclass(frozen=True)
class _Variable:
    """A variable: name, dimensions, class, and either its numbers or its fields; both None for other classes."""

    name: str
    shape: tuple[int, ...]
    kind: int
    numbers: np.ndarray | None = None
    fields: dict[str, _Variable] | None = None

    def describe(self, prefix: str = "") -> Iterator[str]:
        """Yield what a layout can name: the variable, or each field of a struct."""
        if not self.fields:
            yield f"{prefix}{self.name} ({' x '.join(map(str, self.shape))})"
        for name, field in (self.fields or {}).items():
            yield from replace(field, name=name).describe(f"{prefix}{self.name}/")


def blocks(path: Path, name: str, layout: Layout | None) -> Iterator[Recording]:
    """Yield the columns that a layout names; packed variables that it names are held in memory, as the format requires.

    Raises
    ------
    ReadError
        The file is cut or damaged, there is no layout, or a variable is not there or no column.
    """
    wanted = origins(layout, name, "MATLAB") if layout is not None else {}
    roots = {variable.partition("/")[0] for variable, _ in wanted.values()}
    try:
        budget = Budget(path, name)
        with open_file(path) as stream:
            data = _content(stream)
            variables = {known.name: known for known in _variables(data, roots if layout else None, budget)}
    except (_DamagedError, EOFError, zlib.error, struct.error, UnicodeDecodeError, ValueError, MemoryError) as error:
        raise ReadError(f"{name}: truncated or damaged, not a whole MATLAB file: {error}") from None
    if layout is None:
        names = [name for variable in variables.values() for name in variable.describe()]
        known = ", ".join(names[:_LISTED]) + (" ..." if len(names) > _LISTED else "") or "none"
        raise ReadError(f"{name}: say with --layout FILE.toml which variable is which column; variables found: {known}")
    take: dict[str, Callable[[int, int], Array]] = {}
    lengths: dict[str, int] = {}
    for column, (path_there, number) in wanted.items():
        where = f"{name}: {layout.name} takes {column} from {path_there!r}"
        array = _numbers(variables, path_there, where)
        lengths[column], rows = sliced(array.shape, number, False, where)
        take[column] = partial(floats_of_rows, rows, array, where)
    yield from recordings(take, lengths, layout, name)


def _numbers(variables: dict[str, _Variable], path: str, where: str) -> np.ndarray:
    """Return the numbers of ``variable`` or ``struct/field``."""
    inside: dict[str, _Variable] | None = variables
    for part in path.split("/"):
        if inside is None:
            raise ReadError(f"{where}, found no struct")
        if part not in inside:
            raise ReadError(f"{where}, found {listed(inside, part) or 'no variables'}")
        variable = inside[part]
        inside = variable.fields
    if variable.numbers is None:
        raise ReadError(f"{where}: expected real numbers, found {_CLASSES.get(variable.kind, 'complex ones')}")
    return variable.numbers


# --- the format ----------------------------------------------------------------------------------------------------


def _content(stream: BinaryIO) -> memoryview:
    """Return the bytes of the file, of which memory holds only what is looked at."""
    head = stream.read(_HEAD)
    if len(head) < _HEAD:
        raise _DamagedError(f"the head has {len(head)} bytes, expected {_HEAD}")
    if head[126:128] not in _ORDERS:
        raise _DamagedError("the head does not tell the order of bytes")
    return memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))


def _variables(data: memoryview, wanted: set[str] | None, budget: Budget) -> Iterator[_Variable]:
    """Yield the variables of a file, with numbers only for the wanted ones; all if None."""
    order = _ORDERS[bytes(data[126:128])]
    at = _HEAD
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at) if at + 8 <= len(data) else (0, len(data))
        if size > len(data) - at - 8:
            raise _DamagedError(f"no whole variable at byte {at}")
        payload: bytes | memoryview = data[at + 8 : at + 8 + size]
        at += 8 + size
        if kind == _COMPRESSED:
            if wanted is not None:
                named = _matrix(zlib.decompressobj().decompress(payload, _NAMED)[8:], order, set(), 0)
                if named.name not in wanted:
                    yield named
                    continue
            payload = unpack(zlib.decompressobj, payload, budget.left)
            budget.take(len(payload))
            elements = list(_elements(payload, order))
            if len(elements) != 1:
                raise _DamagedError(f"no single variable before byte {at}")
            kind, payload = elements[0]
        if kind != _MATRIX:
            raise _DamagedError(f"an element of type {kind} before byte {at}, expected a variable")
        yield _matrix(payload, order, wanted, 0)


def _elements(data: bytes | memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield type and payload of the elements within another; small ones have the payload in the tag."""
    view, at = memoryview(data), 0  # views: a variable may be as large as memory allows
    while at < len(data):
        if len(data) - at < 8:
            raise _DamagedError("an element is cut")
        kind, size = struct.unpack_from(f"{order}II", data, at)
        small = kind >> 16
        start = at + 4 if small else at + 8
        kind, size = (kind & 0xFFFF, small) if small else (kind, size)
        if size > (4 if small else len(data) - start):
            raise _DamagedError(f"an element of {size} bytes in {len(data) - start}")
        yield kind, view[start : start + size]
        at = at + 8 if small else start + size + (-size % 8)


def _matrix(data: bytes | memoryview, order: str, wanted: set[str] | None, depth: int) -> _Variable:
    """Return a matrix as a variable; `wanted` None accepts any name."""
    if not data:
        return _Variable("", (0, 0), 0)  # an empty field
    elements = _elements(data, order)
    flags = struct.unpack_from(f"{order}I", _next(elements, (6,)))[0]
    shape = tuple(int(n) for n in np.frombuffer(_next(elements, (5,)), f"{order}i4"))
    if len(shape) < 2 or min(shape) < 0:
        raise _DamagedError(f"dimensions {shape}")
    name = bytes(_next(elements, (1, 2))).decode("utf-8")
    kind = flags & 0xFF
    if wanted is not None and name not in wanted:
        return _Variable(name, shape, kind)
    if kind == _STRUCT and prod(shape) == 1 and depth < _DEEPEST:
        return _Variable(name, shape, kind, fields=_fields(elements, order, depth))
    if not _FIRST_NUMBER <= kind <= _LAST_NUMBER or flags & _COMPLEX:
        return _Variable(name, shape, kind)
    stored, payload = next(elements, (0, memoryview(b"")))
    if stored not in _STORED:
        raise _DamagedError(f"numbers of type {stored} in {name!r}")
    numbers = np.frombuffer(payload, order + _STORED[stored] if _STORED[stored][1] != "1" else _STORED[stored])
    if numbers.size != prod(shape):
        raise _DamagedError(f"{name!r} has {numbers.size} numbers, expected {' x '.join(map(str, shape))}")
    return _Variable(name, shape, kind, numbers=numbers.reshape(shape, order="F"))


def _fields(elements: Iterator[tuple[int, memoryview]], order: str, depth: int) -> dict[str, _Variable]:
    width = struct.unpack_from(f"{order}i", _next(elements, (5,)))[0]
    names = bytes(_next(elements, (1, 2)))
    if width < 1 or len(names) % width:
        raise _DamagedError(f"names of {width} in {len(names)} bytes")
    fields = {}
    for start in range(0, len(names), width):
        name = names[start : start + width].partition(b"\0")[0].decode("utf-8")
        fields[name] = _matrix(_next(elements, (_MATRIX,)), order, None, depth + 1)
    return fields


def _next(elements: Iterator[tuple[int, memoryview]], kinds: tuple[int, ...]) -> memoryview:
    kind, payload = next(elements, (0, memoryview(b"")))
    if kind not in kinds:
        raise _DamagedError(f"an element of type {kind}, expected {kinds[0]}")
    return payload
