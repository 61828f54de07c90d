r"""Units of records as the D-SI writes them: ``m/s^2`` is ``\metre\second\tothe{-2}``.

Products of powers alone: the D-SI has deprecated ``\per``. Source: D-SI 2.2.1 (PTB), SI brochure, 9th edition.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction

from imulab.errors import UnitError
from imulab.units import STANDARD_GRAVITY

_NAMES = {
    "m": r"\metre",
    "s": r"\second",
    "rad": r"\radian",
    "mrad": r"\milli\radian",
    "deg": r"\degree",
    "K": r"\kelvin",
    "degC": r"\degreecelsius",
    "Hz": r"\hertz",
    "T": r"\tesla",
    "uT": r"\micro\tesla",
    "V": r"\volt",
    "mV": r"\milli\volt",
    "A": r"\ampere",
    "mA": r"\milli\ampere",
}
NOT_SI: Mapping[str, str] = {
    "count": "1 count = one step of the item's digital output",
    "pulse": "1 pulse = one pulse of the item's output",
    "g": f"1 g = {STANDARD_GRAVITY} m/s^2",
}
"""Units of outputs that the D-SI has no name for; in its units they are numbers."""
_TOKEN = re.compile(r"\s*(sqrt\(|\^-?\d+|[A-Za-z]+|1|[/*()])")


def dsi_unit(unit: str) -> tuple[str, str]:
    r"""Return a unit as the D-SI writes it, and the definition of what in it is no unit of the SI (else empty).

    Raises
    ------
    UnitError
        The D-SI has no name for a part of it.

    Examples
    --------
    >>> dsi_unit("rad/s/sqrt(Hz)")[0], dsi_unit("m/s^2/(m/s^2)")[0]
    ('\\radian\\second\\tothe{-1}\\hertz\\tothe{-0.5}', '\\one')
    """
    tokens = [match[1] for match in _TOKEN.finditer(unit)]
    if "".join(tokens) != re.sub(r"\s", "", unit) or not tokens:
        raise _unknown(unit)
    tokens.reverse()
    powers = _product(tokens, unit)
    if tokens:
        raise _unknown(unit)
    definitions = "; ".join(NOT_SI[name] for name in powers if name in NOT_SI)
    parts = []
    for name, power in powers.items():
        if name not in NOT_SI and name not in _NAMES:
            raise _unknown(unit)
        if power and name in _NAMES:
            parts.append(_NAMES[name] + ("" if power == 1 else rf"\tothe{{{float(power):g}}}"))
    return "".join(parts) or r"\one", definitions


def _unknown(unit: str) -> UnitError:
    return UnitError(f"unit {unit}: the D-SI of certificates has no name for it")


def _product(tokens: list[str], unit: str) -> dict[str, Fraction]:
    """Return the powers of the names up to a closing bracket or the end."""
    powers: dict[str, Fraction] = {}
    sign = 1
    while True:
        for name, power in _factor(tokens, unit).items():
            powers[name] = powers.get(name, Fraction(0)) + sign * power
        if not tokens or tokens[-1] == ")":
            return powers
        operator = tokens.pop()
        if operator not in "/*":
            raise _unknown(unit)
        sign = -1 if operator == "/" else 1


def _factor(tokens: list[str], unit: str) -> dict[str, Fraction]:
    token = tokens.pop() if tokens else ""
    if token in ("(", "sqrt("):
        powers = _product(tokens, unit)
        if not tokens or tokens.pop() != ")":
            raise _unknown(unit)
        if token == "sqrt(":
            powers = {name: power / 2 for name, power in powers.items()}
    elif token == "1":
        powers = {}
    elif token.isalpha():
        powers = {token: Fraction(1)}
    else:
        raise _unknown(unit)
    if tokens and tokens[-1].startswith("^"):
        exponent = int(tokens.pop()[1:])
        powers = {name: power * exponent for name, power in powers.items()}
    return powers
