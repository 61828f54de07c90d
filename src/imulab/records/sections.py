"""Typed parts of a record: dataclasses that say what a procedure's code reads, and their reading from plain values.

The annotation of a field says what its value must be: ``float`` (any number), ``int`` (0 or more), ``str``, ``bool``,
``Literal`` words, one of the kinds below, another `Part`, or ``list[X]``, ``tuple[X, ...]``, ``dict[str, X]`` and
``X | None`` of these. ``Annotated[list[X], 3]`` has three entries, and ``Annotated[list[X], "axes"]`` as many as every
other list of that name in the part that is read. Keys that no field names are ignored. A field whose name is a word of
Python ends with ``_``. Other dataclasses are made by calling them, so that a record must hold all that they need.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import cache
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from imulab.errors import RecordError

if TYPE_CHECKING:
    from imulab.records.calibration import Calibration

LARGEST = 1e100
"""No quantity of a sensor is larger; squares and cubes of what is not are numbers."""

P = TypeVar("P", bound="Part")
T = TypeVar("T")
_Counts = dict[str, tuple[int, str]]


@dataclass(frozen=True)
class Kind:
    """A plain value: what messages call it, and its test."""

    name: str
    fits: Callable[[Any], bool]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


Positive = Annotated[float, Kind("a number above 0", lambda value: _is_number(value) and value > 0)]
Size = Annotated[float, Kind("a number of 0 or more", lambda value: _is_number(value) and value >= 0)]
_PLAIN = {
    float: Kind("a number", _is_number),
    int: Kind("a whole number of 0 or more", lambda value: type(value) is int and 0 <= value < 2**53),
    str: Kind("a text", lambda value: isinstance(value, str)),
    bool: Kind("true or false", lambda value: type(value) is bool),
}


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
class Part:
    """What code reads of one part of a record; whoever reads a field that the record lacks gets a RecordError.

    Its classes are frozen dataclasses with keywords only. A record need not hold what nobody asks it for: one that is
    only exported needs no data for figures.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name not in type(self).__dataclass_fields__:
                raise AttributeError(f"{type(self).__name__} has no field {name}")
            raise RecordError(f"the record lacks {_at(self.__dict__['_place'], name.rstrip('_'))}")


class Named(dict[str, Any]):
    """Values by name; whoever asks for one that the record lacks gets a RecordError."""

    def __init__(self, values: Mapping[str, Any], place: str) -> None:
        super().__init__(values)
        self.place = place

    def __missing__(self, key: str) -> Any:
        raise RecordError(f"the record lacks {_at(self.place, key)}")


class Quantity(Part):
    """A value with its unit, and its standard uncertainty where one is stated."""

    value: float
    unit: str
    standard_uncertainty: Size | None = None


class Length(Part):
    """A value of 0 or more with its unit."""

    value: Size
    unit: str


class Above0(Part):
    """A value above 0 with its unit."""

    value: Positive
    unit: str


def part(record: Calibration, kind: type[P], place: str = "") -> P:
    """Return a part of a record; `place` is such as ``data.attitudes``, empty for the record as a whole.

    Raises
    ------
    RecordError
        The record lacks it, or what is there is something else; the message names the place.
    """
    value: Any = {"model": record.model, "fit": record.fit, "data": record.data, **record.sections}
    for key in place.split(".") if place else ():
        if not isinstance(value, Mapping) or key not in value:
            raise RecordError(f"the record lacks {place}")
        value = value[key]
    return read(kind, value, place)


def read(kind: type[T], value: Any, place: str = "") -> T:
    """Return plain values as a part or another dataclass; errors as for `part`."""
    found: T = _read(value, kind, place, {})
    return found


def check_sizes(value: Any, where: str = "") -> None:
    """Refuse numbers that no quantity has.

    Raises
    ------
    RecordError
        There is one; the message names its place.
    """
    if isinstance(value, dict):
        for key, item in value.items():
            check_sizes(item, _at(where, key))
    elif isinstance(value, list):
        if value and set(map(type, value)) <= {float, int} and min(value) >= -LARGEST and max(value) <= LARGEST:
            return
        for index, item in enumerate(value):
            check_sizes(item, f"{where}[{index}]")
    elif _is_number(value) and not -LARGEST <= value <= LARGEST:
        raise _mistake(where, f"a number of at most {LARGEST:g}", value)


@cache
def _fields(kind: Any) -> list[tuple[str, Any, Field[Any]]]:
    """Name and annotation of each field, and the field."""
    hints = get_type_hints(kind, include_extras=True)
    return [(field.name, hints[field.name], field) for field in fields(kind)]


def _read(value: Any, kind: Any, where: str, counts: _Counts) -> Any:
    origin, given = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if kind in _PLAIN:
        plain = _tested(value, _PLAIN[kind], where)
        return float(plain) if kind is float else plain
    if origin is Literal:
        return _tested(value, Kind(f"one of {' '.join(given)}", lambda word: word in given), where)
    if origin is Annotated and isinstance(given[1], Kind):
        return _tested(value, given[1], where)
    if origin is Annotated:
        return _read_list(value, get_args(given[0])[0], where, counts, given[1])
    if origin is list:
        return _read_list(value, given[0], where, counts, None)
    if origin is tuple:
        return tuple(_read_list(value, given[0], where, counts, None))
    if origin in (dict, Mapping):
        held = {key: _read(item, given[1], _at(where, key), counts) for key, item in _named(value, where).items()}
        return Named(held, where) if origin is dict else held
    if given:  # X | None, or a list or else a plain value
        others = [other for other in given if other is not type(None)]
        if value is None and len(others) < len(given):
            return None
        return _read(value, others[-1 if len(others) > 1 and not isinstance(value, list) else 0], where, counts)
    if issubclass(kind, Part):
        return _read_part(_named(value, where), kind, where, counts)
    return _made(_named(value, where), kind, where, counts)


def _read_part(value: Mapping[str, Any], kind: Any, where: str, counts: _Counts) -> Any:
    found = object.__new__(kind)
    held: dict[str, Any] = {"_place": where}
    for name, hint, known in _fields(kind):
        key = name.rstrip("_")
        if key in value:
            held[name] = _read(value[key], hint, _at(where, key), counts)
        elif known.default_factory is not MISSING:
            held[name] = known.default_factory()
    found.__dict__.update(held)
    return found


def _made(value: Mapping[str, Any], kind: Any, where: str, counts: _Counts) -> Any:
    """A dataclass that is no `Part`, from the values of its fields."""
    held = {}
    for name, hint, known in _fields(kind):
        if name in value:
            held[name] = _read(value[name], hint, _at(where, name), counts)
        elif known.default is MISSING and known.default_factory is MISSING:
            raise RecordError(f"the record lacks {_at(where, name)}")
    return kind(**held)


def _read_list(value: Any, kind: Any, where: str, counts: _Counts, count: int | str | None) -> list[Any]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise _mistake(where, "a list", value)
    if count is not None:
        expected, of = (count, "") if isinstance(count, int) else counts.setdefault(count, (len(value), where))
        if len(value) != expected:
            as_there = f", as {of} has" if of else ""
            raise RecordError(f"{where}: expected {expected} entries{as_there}, found {len(value)}")
        if not value:
            raise _mistake(where, "1 entry or more", value)
    if kind is float and set(map(type, value)) <= {float, int}:
        return list(map(float, value))
    return [_read(item, kind, f"{where}[{index}]", counts) for index, item in enumerate(value)]


def _tested(value: Any, kind: Kind, where: str) -> Any:
    if not kind.fits(value):
        raise _mistake(where, kind.name, value)
    return value


def _named(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise _mistake(where, "named values", value)
    return value


def _at(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def _mistake(where: str, expected: str, value: Any) -> RecordError:
    text = repr(value)
    return RecordError(f"{where}: expected {expected}, found {text if len(text) <= 60 else text[:57] + '...'}")
