"""Texts of options, from the command line or a manifest, to values in SI."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral, Real

from imulab.columns import expected_quantities
from imulab.errors import OptionError, RecordError, UnitError, quoted
from imulab.units import parse_unit, to_si

_BYTES = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}
LARGEST, SMALLEST = 1e100, 1e-100
"""Sizes of quantities whose squares, cubes and reciprocals are finite; 0 is one too."""
_WHOLE = 10**15
_FRACTIONS = {"1": 1.0, "%": 1e-2, "ppm": 1e-6}
RANDOM_WALK = {"deg/sqrt(h)": 0.01745329251994329577 / 60, "deg/√h": 0.01745329251994329577 / 60, "rad/sqrt(s)": 1.0}
"""Units of an angle random walk in texts, in SI."""
_BETWEEN = re.compile(r"\s+to\s+|[:,]")
"""Separators of an interval's ends: a colon; a comma or "to" are read as well."""
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*)?")


def quantity(text: str, option: str, kind: str, default_unit: str) -> float:
    """Return a text such as ``0.7mg`` or ``5 s`` in SI.

    Raises
    ------
    OptionError
        It is no number with a unit of this kind.
    """
    if re.search(r"\d,\d", text):
        raise OptionError(f"{option} {quoted(text)}: a decimal comma? expected a point")
    match = _QUANTITY.fullmatch(text)
    expected = f"{option} {quoted(text)}: expected a number, or one with a unit of {kind} such as 1 {default_unit}"
    if match is None:
        raise OptionError(expected)
    try:
        unit = parse_unit(match[2].strip() if match[2] else default_unit, (kind,))
    except UnitError as error:
        raise OptionError(f"{option} {quoted(text)}: {error}") from None
    if unit.quantity != kind:
        raise OptionError(expected)
    return to_si(_sized(match[1], option, text), unit.symbol)


def _sized(digits: str, option: str, text: str) -> float:
    """Return a number of a text; refuse one whose square or reciprocal no double holds."""
    value = float(digits)
    if value and not SMALLEST <= abs(value) <= LARGEST:
        raise OptionError(
            f"{option} {quoted(text)}: expected 0, or a number of a size from {SMALLEST:g} to {LARGEST:g}"
        )
    return value


def with_uncertainty(text: str) -> tuple[str, str | None]:
    """Return value and standard uncertainty of ``9.81362+-0.00002`` (``+/-``, ``±``), None without one."""
    first, sign, second = re.sub(r"\+/?-|±", "±", text).partition("±")
    return first, second if sign else None


def split_quantity(text: str, option: str, example: str) -> tuple[float, str]:
    """Return the number of a text such as ``0.3 deg/sqrt(h)`` and the text after it.

    Raises
    ------
    OptionError
        It does not begin with a number; the message gives an example.
    """
    match = _QUANTITY.fullmatch(text)
    if match is None or re.search(r"\d,\d", text):
        raise OptionError(f"{option} {quoted(text)}: expected a number with a unit such as {example}")
    return _sized(match[1], option, text), (match[2] or "").strip()


def in_si(value: float | str, option: str, kind: str, default_unit: str) -> float:
    """Return a quantity in SI: a number is in SI already, a text is read as on the command line.

    Raises
    ------
    OptionError
        It is neither a number nor a text that `quantity` reads.
    """
    if isinstance(value, str):
        return quantity(value, option, kind, default_unit)
    if isinstance(value, bool) or not isinstance(value, Real):
        raise OptionError(
            f"{option} {quoted(value)}: expected a number in SI, or a text with a unit such as '1 {default_unit}'"
        )
    return float(value) if not math.isfinite(value) else _sized(str(float(value)), option, str(value))


def of_units(value: float | str, option: str, units: Mapping[str, float]) -> float:
    """Return a quantity in SI as `in_si` does; a text has one of a few units, or the first of them where it has none.

    Raises
    ------
    OptionError
        It is none.
    """
    if not isinstance(value, str):
        return in_si(value, option, "", next(iter(units)))
    match = _QUANTITY.fullmatch(value)
    unit = (match[2] or next(iter(units))).strip() if match else ""
    if match is None or unit not in units:
        raise OptionError(f"{option} {quoted(value)}: expected a number with one of {', '.join(units)}")
    return _sized(match[1], option, value) * units[unit]


def fraction(value: float | str, option: str, bare: str = "1") -> float:
    """Return a fraction, given as a number or as a text such as ``1 %``; `bare` is the unit of a text without one.

    Raises
    ------
    OptionError
        It is none.
    """
    try:
        return of_units(value, option, {bare: _FRACTIONS[bare], **_FRACTIONS})
    except OptionError:
        raise OptionError(f"{option} {quoted(value)}: expected a fraction such as 0.01 or 1 %") from None


def temperature_list(values: Sequence[float] | str, option: str = "--temperatures") -> list[float]:
    """Return temperatures, degC, given as numbers or as a text such as ``-40,-30,0``.

    Raises
    ------
    OptionError
        It is no such list.
    """
    try:
        temperatures = [float(part) for part in (values.split(",") if isinstance(values, str) else values)]
        if not all(map(math.isfinite, temperatures)):
            raise ValueError
    except (TypeError, ValueError):
        raise OptionError(f"{option} {quoted(values)}: expected numbers such as -40,-30,0") from None
    return [_sized(repr(value), option, repr(value)) for value in temperatures]


def whole(value: int | str, option: str) -> int:
    """Return a whole number, given as one or as a text.

    Raises
    ------
    OptionError
        It is none.
    """
    if isinstance(value, str):
        return whole_number(value, option)
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise OptionError(f"{option} {quoted(value)}: expected a whole number")
    return int(value)


def size(text: str, option: str) -> int:
    """Return a text such as ``20GB`` or ``64 MiB`` as a number of bytes.

    Raises
    ------
    OptionError
        It is none.
    """
    match = _QUANTITY.fullmatch(text)
    factor = _BYTES.get((match[2] or "B").strip()) if match else None
    if match is None or factor is None or not 1 <= float(match[1]) * factor < 2**63:
        raise OptionError(f"{option} {quoted(text)}: expected a size such as 500MB, 20GB or 8GiB")
    return int(float(match[1]) * factor)


def whole_number(text: str, option: str) -> int:
    """Return a text as a whole number.

    Raises
    ------
    OptionError
        It is none.
    """
    try:
        value = int(text)
    except ValueError:
        raise OptionError(f"{option} {quoted(text)}: expected a whole number") from None
    if abs(value) >= _WHOLE:
        raise OptionError(f"{option} {quoted(text)}: expected a whole number of at most 15 digits")
    return value


class FromStart(float):
    """A time that counts from the first of a recording, s."""

    __slots__ = ()


def span(text: str, option: str) -> tuple[float | None, float | None]:
    """Return a part of a recording's time such as ``10:60``, ``10:`` or ``:60``, s; None for an end that is not given.

    An end with a sign, ``+10:+60``, is a `FromStart`.

    Raises
    ------
    OptionError
        It is none.
    """
    ends = _BETWEEN.split(text.strip())
    if len(ends) != 2 or not any(end.strip() for end in ends):
        raise OptionError(
            f"{option} {quoted(text)}: expected FROM:TO in seconds, such as 10:60, 10: or :60, "
            "or +10:+60 from the start"
        )
    first, last = (_end(end.strip(), option) for end in ends)
    return first, last


def _end(text: str, option: str) -> float | None:
    if not text:
        return None
    seconds = quantity(text, option, "time", "s")
    return FromStart(seconds) if text.startswith("+") else seconds


def interval(text: str, option: str) -> tuple[float, float]:
    """Return an interval of time such as ``468:496``, s; as messages print it, ``468 to 496 s``, it is read too.

    Raises
    ------
    OptionError
        It is none.
    """
    ends = [quantity(end, option, "time", "s") for end in _BETWEEN.split(text.strip())]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise OptionError(f"{option} {quoted(text)}: expected FROM:TO in seconds, such as 468:496")
    return ends[0], ends[1]


@contextmanager
def labelled(label: str, names: Iterable[str]) -> Iterator[None]:
    """Replace an option's bare name at the beginning of a refusal by its label; `label` is ``"--{}"`` or the like."""
    try:
        yield
    except (OptionError, RecordError) as error:
        word = str(error).partition(" ")[0].rstrip(":")
        if word not in names:
            raise
        shown = word.strip("_")
        shown = shown.replace("_", "-") if label.startswith("--") else shown
        raise type(error)(label.format(shown) + str(error)[len(word) :]) from None


def number(text: str, option: str) -> float:
    """Return a text as a finite number.

    Raises
    ------
    OptionError
        It is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not math.isfinite(value):
        raise OptionError(f"{option} {quoted(text)}: expected a number")
    return _sized(text, option, text)


def parse_units(text: str, called: str) -> dict[str, str]:
    """Return the units in ``accel=g,gyro=deg/s``.

    Raises
    ------
    OptionError
        It is no such list, or a unit is not known.
    """
    units: dict[str, str] = {}
    for part in text.split(","):
        name, sign, unit = part.partition("=")
        if not sign or not name.strip() or not unit.strip() or name.strip() in units:
            raise OptionError(
                f"{called} {quoted(text)}: expected NAME=UNIT, each name once, such as accel=g,gyro=deg/s"
            )
        try:
            units[name.strip()] = parse_unit(unit, expected_quantities(name.strip()) or ()).symbol
        except UnitError as error:
            raise OptionError(f"{called} {part.strip()}: {error}") from None
    return units
