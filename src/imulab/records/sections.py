"""Typed parts of a record: what a procedure's code fills, writes into the record, and reads from it again.

The annotation of a field says what its value must be: ``float`` (any number), ``int`` (0 or more), ``str``, ``bool``,
``Literal`` words, one of the kinds below, another `Part`, or ``list[X]``, ``tuple[X, ...]``, ``dict[str, X]`` and
``X | None`` of these. ``Annotated[list[X], 3]`` has three entries, and ``Annotated[list[X], "axes"]`` as many as every
other list of that name in the part that is read. Keys that no field names are ignored. A field whose name is a word of
Python ends with ``_``. Dataclasses are made by calling them, so that a record must hold all that they need.

`entries` writes a part in the order of its fields. A field with the default None is left out of the record where it is
None; a field with the default `null` is written as null, and may be missing in older records.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    TypeAlias,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
from msgspec import NODEFAULT
from msgspec import field as field

from imulab.errors import LackingError, RecordError, quoted
from imulab.quantities import LARGEST, SMALLEST

if TYPE_CHECKING:
    from imulab.gravity import Gravity, ModelField, Site
    from imulab.records.calibration import Calibration

P = TypeVar("P", bound="Part")
T = TypeVar("T")
Place: TypeAlias = "tuple[Place, str | int] | None"
"""Place of a value in a record: the place of its container, and its key or index there; None for the record."""
_Counts: TypeAlias = dict[str, tuple[int, Place]]
_Reader: TypeAlias = Callable[[Any, Place, _Counts], Any]


class PlainKind(msgspec.Struct, frozen=True):
    """A plain value: its name in messages, and its test."""

    name: str
    fits: Callable[[Any], bool]


def _is_number(value: Any) -> bool:
    return type(value) is float or (isinstance(value, int | float) and not isinstance(value, bool))


Positive = Annotated[float, PlainKind("a number above 0", lambda value: _is_number(value) and value >= SMALLEST)]
Size = Annotated[float, PlainKind("a number of 0 or more", lambda value: _is_number(value) and value >= 0)]
Uncertainty = Annotated[
    float,
    PlainKind("0, or a number of 1e-100 or more", lambda value: _is_number(value) and (not value or value >= SMALLEST)),
]
_PLAIN = {
    float: PlainKind("a number", _is_number),
    int: PlainKind("a whole number of 0 or more", lambda value: type(value) is int and 0 <= value < 2**53),
    str: PlainKind("a text", lambda value: isinstance(value, str)),
    bool: PlainKind("true or false", lambda value: type(value) is bool),
}


class _PartMeta(msgspec.StructMeta):
    """Metaclass of parts, which passes keywords on to derived classes; msgspec's does not."""

    def __new__(mcls, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **config: Any) -> Any:
        return super().__new__(mcls, name, bases, namespace, kw_only=True, **config)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
class Part(msgspec.Struct, metaclass=_PartMeta, frozen=True, dict=True):
    """One part of a record; reading a field that the record lacks raises RecordError.

    A record need not hold what nobody asks it for: one that is only exported needs no data for figures.
    """

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name not in self.__struct_fields__:
                raise AttributeError(f"{type(self).__name__} has no field {name}")
            raise LackingError(f"the record lacks {_text((self.__dict__['place'], name.rstrip('_')))}")


def null() -> Any:
    """Return the default None of a field that is written as null, and that older records lack."""
    return field(default_factory=_none)


def _none() -> None:
    return None


def holds(value: Part, name: str) -> bool:
    """Return whether the record of a part has a field, and not its default."""
    try:
        object.__getattribute__(value, name)
    except AttributeError:
        return False
    return True


def entries(value: Part) -> dict[str, Any]:
    """Return a part as it stands in a record, in the order of its fields."""
    return {
        key: _plain(item)
        for name, key, optional in _written(type(value))
        if (item := getattr(value, name)) is not None or not optional
    }


def _plain(value: Any) -> Any:
    """Return the value of a field as it stands in a record."""
    if isinstance(value, Part):
        return entries(value)
    if type(value) is list:
        return [_plain(item) for item in value] if value and isinstance(value[0], Part) else value
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value


@cache
def _written(kind: type[Part]) -> list[tuple[str, str, bool]]:
    """Return the name of each field, its key in a record, and whether it is left out where it is None."""
    return [(known.name, known.name.rstrip("_"), known.default is None) for known in msgspec.structs.fields(kind)]


class Named(dict[str, Any]):
    """Values by name; reading one that the record lacks raises RecordError."""

    def __init__(self, values: Mapping[str, Any], place: Place) -> None:
        super().__init__(values)
        self.place = place

    def __missing__(self, key: str) -> Any:
        raise LackingError(f"the record lacks {_text((self.place, key))}")


class Quantity(Part):
    """A value with its unit, and its standard uncertainty where one is stated."""

    value: float
    unit: str
    standard_uncertainty: Size | None = None


class Measured(Part):
    """A value with its standard uncertainty and its unit."""

    value: float
    standard_uncertainty: Size | None
    unit: str


class StatedGravity(Part):
    """``model.gravity``: local gravity, m/s^2, and where it is from."""

    value: Positive
    unit: str
    standard_uncertainty: Size | None = null()
    from_: str

    @classmethod
    def of(cls, gravity: Gravity) -> StatedGravity:
        """Return the gravity that a record was made with."""
        return cls(
            value=gravity.value,
            unit="m/s^2",
            standard_uncertainty=gravity.standard_uncertainty,
            from_=gravity.origin,
        )


class FieldPlace(Part):
    """Place of a test in rad and m, and the field of a model there: its name, the day, magnitude, dip, declination."""

    latitude: float
    longitude: float
    height: float | None = null()
    model: str
    date: str
    field: Quantity
    dip: Quantity
    declination: Quantity

    @classmethod
    def of(cls, where: Site, field: ModelField) -> FieldPlace:
        """Return the place of a test, with a model's field there."""

        def known(pair: tuple[float, float], unit: str) -> Quantity:
            return Quantity(value=pair[0], unit=unit, standard_uncertainty=pair[1])

        return cls(
            latitude=where.latitude, longitude=where.longitude, height=where.height, model=field.model, date=field.date,
            field=known(field.magnitude, "T"), dip=known(field.dip, "rad"),
            declination=known(field.declination, "rad"),
        )  # fmt: skip


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
            raise LackingError(f"the record lacks {place}")
        value = value[key]
    return read(kind, value, place)


def read(kind: type[T], value: Any, place: str = "") -> T:
    """Return plain values as a part or a dataclass; errors as for `part`."""
    annotation: Any = kind
    result: T = _reader(annotation)(value, (None, place) if place else None, {})
    return result


_WHOLE = 2**63 - 1
"""Largest whole number that arrays hold."""


def check_sizes(value: Any, where: Place = None) -> None:
    """Refuse numbers larger than any quantity.

    Raises
    ------
    RecordError
        There is one; the message names its place.
    """
    if isinstance(value, dict):
        for key, item in value.items():
            kind = type(item)
            if not (kind is str or item is None or (kind is float and -LARGEST <= item <= LARGEST)):  # as most are
                check_sizes(item, (where, key))
    elif isinstance(value, list):
        try:
            if not value or (min(value) >= -_WHOLE and max(value) <= _WHOLE):
                return
        except TypeError:  # there are texts, lists or None among them
            pass
        for index, item in enumerate(value):
            check_sizes(item, (where, index))
    elif _is_number(value) and not -LARGEST <= value <= LARGEST:
        raise _mistake(where, f"a number of at most {LARGEST:g}", value)
    elif type(value) is int and not -_WHOLE <= value <= _WHOLE:
        raise _mistake(where, f"a whole number of at most {_WHOLE:g}", value)


@cache
def _reader(kind: Any) -> _Reader:
    """Return the function that reads values of an annotation, from a plain value, its place, and the lists' lengths."""
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return lambda value, where, counts: value
    if kind is float:
        return _read_number
    if kind in _PLAIN:
        return _plain_reader(_PLAIN[kind])
    if origin is Literal:
        return _plain_reader(PlainKind(f"one of {' '.join(arguments)}", lambda word: word in arguments))
    if origin is Annotated and isinstance(arguments[1], PlainKind):
        return _plain_reader(arguments[1])
    if origin is Annotated:
        return _list_reader(get_args(arguments[0])[0], arguments[1])
    if origin is list:
        return _list_reader(arguments[0], None)
    if origin is tuple:
        count = None if arguments[-1] is Ellipsis else len(arguments)
        items = _list_reader(arguments[0], count)
        return lambda value, where, counts: tuple(items(value, where, counts))
    if origin in (dict, Mapping):
        return _mapping_reader(_reader(arguments[1]), lacks_named=origin is dict)
    if arguments:
        return _union_reader(arguments)
    return _dataclass_reader(kind) if is_dataclass(kind) else _part_reader(kind)


def _read_number(value: Any, where: Place, counts: _Counts) -> float:
    if type(value) is float:
        return value
    if not _is_number(value):
        raise _mistake(where, _PLAIN[float].name, value)
    return float(value)


def _plain_reader(kind: PlainKind) -> _Reader:
    fits = kind.fits

    def read_plain(value: Any, where: Place, counts: _Counts) -> Any:
        if not fits(value):
            raise _mistake(where, kind.name, value)
        return value

    return read_plain


def _list_reader(kind: Any, count: int | str | None) -> _Reader:
    """Return the reader of a list of a fixed length, or of the length of other lists of that name."""
    read_item = _reader(kind)

    def read_list(value: Any, where: Place, counts: _Counts) -> list[Any]:
        if type(value) is not list and (isinstance(value, str) or not isinstance(value, Sequence)):
            raise _mistake(where, "a list", value)
        if count is not None:
            expected, same = (count, None) if isinstance(count, int) else counts.setdefault(count, (len(value), where))
            if len(value) != expected:
                as_there = f", as {_text(same)} has" if same is not None else ""
                raise RecordError(f"{_text(where)}: expected {expected} entries{as_there}, found {len(value)}")
            if not value:
                raise _mistake(where, "1 entry or more", value)
        if kind is float and (kinds := set(map(type, value))) <= {float, int}:
            return list(map(float, value)) if int in kinds else list(value)
        return [read_item(item, (where, index), counts) for index, item in enumerate(value)]

    return read_list


def _mapping_reader(read_item: _Reader, *, lacks_named: bool) -> _Reader:
    """Return the reader of values by name; with `lacks_named`, a missing one raises an error with its place."""

    def read_mapping(value: Any, where: Place, counts: _Counts) -> dict[str, Any]:
        items = {key: read_item(item, (where, key), counts) for key, item in _named(value, where).items()}
        return Named(items, where) if lacks_named else items

    return read_mapping


def _union_reader(members: tuple[Any, ...]) -> _Reader:
    """Return the reader of ``X | None``, or of a list or else a plain value."""
    others = [_reader(member) for member in members if member is not type(None)]
    optional = len(others) < len(members)
    read_list, read_other = others[0], others[-1]

    def read_union(value: Any, where: Place, counts: _Counts) -> Any:
        if value is None and optional:
            return None
        return (read_list if isinstance(value, list) else read_other)(value, where, counts)

    return read_union


def _part_reader(kind: type[Part]) -> _Reader:
    hints = get_type_hints(kind, include_extras=True)
    known = [
        (f.name, f.name.rstrip("_"), _reader(hints[f.name]), f.default is NODEFAULT and f.default_factory is NODEFAULT)
        for f in msgspec.structs.fields(kind)
    ]

    def read_part(value: Any, where: Place, counts: _Counts) -> Any:
        value, held, missing = _named(value, where), {}, []
        for name, key, read_item, required in known:
            if key in value:
                held[name] = read_item(value[key], (where, key), counts)
            elif required:
                missing.append(name)
        return _incomplete(kind, held, missing, where) if missing else kind(**held)

    return read_part


def _incomplete(kind: type[Part], held: Mapping[str, Any], missing: Sequence[str], where: Place) -> Part:
    """Return a part without the fields that the record lacks: reading one of these raises an error."""
    result = kind(**held, **dict.fromkeys(missing))
    result.__dict__["place"] = where
    for name in missing:
        getattr(kind, name).__delete__(result)  # the slot is empty then, so that `Part.__getattr__` is asked
    return result


def _dataclass_reader(kind: Any) -> _Reader:
    hints = get_type_hints(kind, include_extras=True)
    known = [
        (f.name, _reader(hints[f.name]), f.default is MISSING and f.default_factory is MISSING) for f in fields(kind)
    ]

    def read_dataclass(value: Any, where: Place, counts: _Counts) -> Any:
        value, held = _named(value, where), {}
        for name, read_item, required in known:
            if name in value:
                held[name] = read_item(value[name], (where, name), counts)
            elif required:
                raise LackingError(f"the record lacks {_text((where, name))}")
        return kind(**held)

    return read_dataclass


def _named(value: Any, where: Place) -> Mapping[str, Any]:
    if type(value) is not dict and not isinstance(value, Mapping):
        raise _mistake(where, "named values", value)
    return value


def _text(where: Place) -> str:
    """Return a place as messages state it: ``fit.orders[2].rms``."""
    if where is None:
        return ""
    outer, key = _text(where[0]), where[1]
    if isinstance(key, int):
        return f"{outer}[{key}]"
    return f"{outer}.{key}" if outer else key


def _mistake(where: Place, expected: str, value: Any) -> RecordError:
    return RecordError(f"{_text(where)}: expected {expected}, found {quoted(value)}")
