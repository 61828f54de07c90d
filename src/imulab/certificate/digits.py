"""Numbers as a certificate prints them: U to two significant digits, the value to the same place.

Sources: ILAC-P14:09/2020; JCGM 100:2008, 7.2.6. By decimals: rounding of doubles would take 1.25 to 1.2.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from decimal import ROUND_HALF_UP, Context, Decimal

_EXACT = Context(prec=800, rounding=ROUND_HALF_UP)
"""Holds every double to any place; halves go away from zero."""
_LARGE, _SMALL = 6, -6
"""Powers of ten beyond which a number is printed as a multiple of a power of a thousand."""
_PREFIXED = {"m/s^2": ("mm/s²", 3), "rad": ("mrad", 3), "rad/s": ("mrad/s", 3), "T": ("µT", 6), "s": ("ms", 3)}
"""Unit to the smaller one in which it is printed, and its power of ten."""
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def rounded(values: Iterable[float], uncertainty: float, power: int = 0) -> tuple[list[str], str, int]:
    """Return values and an uncertainty above 0 as texts, and the power of ten that all are multiples of.

    Parameters
    ----------
    values
        What has this uncertainty: a value, and its limits.
    uncertainty
        Rounded to two significant digits; the values are rounded to its last place.
    power
        Power of ten of the unit in which they are printed.

    Examples
    --------
    >>> rounded([-0.1739146, 0.2504], 0.000743, -3)
    (['-173.91', '250.40'], '0.74', 0)
    """
    exact = [Decimal(value).scaleb(-power, _EXACT) for value in (*values, uncertainty)]
    u = _to_place(exact[-1], exact[-1].adjusted() - 1)
    last = u.adjusted() - 1
    largest = max(number.adjusted() for number in (exact[0], u) if number)
    common = 3 * (largest // 3) if largest >= _LARGE or last < _SMALL else 0
    texts = [_text(_to_place(number, last), common) for number in (*exact[:-1], u)]
    return texts[:-1], texts[-1], common


def _to_place(number: Decimal, place: int) -> Decimal:
    return number.quantize(Decimal(1).scaleb(place), context=_EXACT)


def _text(number: Decimal, power: int) -> str:
    text = f"{number.scaleb(-power, _EXACT):f}"
    return text.removeprefix("-") if not number else text


def limits_text(lower: float, upper: float, power: int = 0) -> str:
    """Return limits as they were agreed, without the noise of conversions; nothing for one that is not finite."""
    return " … ".join(_limit(end, power) for end in (lower, upper))


def _limit(end: float, power: int) -> str:
    if not math.isfinite(end):
        return ""
    text = f"{Decimal(f'{end:.9g}').scaleb(-power):f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def significant(number: float, digits: int = 3) -> str:
    """Return a number to some significant digits, without an exponent."""
    exact = Decimal(number)
    return _text(_to_place(exact, exact.adjusted() - digits + 1), 0) if exact else "0"


def smaller_units(sizes: Iterable[tuple[str, float]]) -> dict[str, tuple[str, int]]:
    """Return the unit in which each is printed, with its power of ten, from units and the values in them.

    It is the same for all values of a unit, the smaller one where none is above 1.
    """
    largest: dict[str, float] = {}
    for unit, size in sizes:
        largest[unit] = max(largest.get(unit, 0.0), abs(size))
    return {
        unit: (_PREFIXED[unit][0], -_PREFIXED[unit][1]) if unit in _PREFIXED and size < 1 else (printed_unit(unit), 0)
        for unit, size in largest.items()
    }


def printed_unit(unit: str) -> str:
    """Return a unit of a record as people write it.

    Examples
    --------
    >>> printed_unit("1/(m/s^2)^2"), printed_unit("rad/s/sqrt(Hz)"), printed_unit("degC")
    ('1/(m/s²)²', 'rad/s/√Hz', '°C')
    """
    unit = re.sub(r"\^(-?\d+)", lambda match: match[1].translate(_SUPERSCRIPTS), unit)
    unit = re.sub(r"sqrt\((\w+)\)", r"√\1", unit)
    return unit.replace("degC", "°C").replace("deg", "°").replace("uT", "µT")


def times_power(unit: str, power: int) -> str:
    """Return a unit with the power of ten of the numbers before it.

    Examples
    --------
    >>> times_power("1", -6), times_power("rad/s²", 0)
    ('10⁻⁶', 'rad/s²')
    """
    if not power:
        return unit
    ten = f"10{str(power).translate(_SUPERSCRIPTS)}"
    return ten if unit == "1" else f"{ten} {unit}"
