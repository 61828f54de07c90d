"""Noise coefficients as people write them: 0.3 deg/sqrt(h), 100 ug/sqrt(Hz), 5 deg/h, and so on."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from imulab.errors import OptionError, UnitError
from imulab.estimation.noise.terms import NAMES, SIGMA, TIME
from imulab.quantities import in_si, split_quantity
from imulab.recording import Array
from imulab.units import parse_unit, si_unit

Markov: TypeAlias = str | tuple[float | str, float | str]
"""Standard deviation and correlation time of a Gauss-Markov term: ``"20 deg/h:300 s"``, or the two of them."""
EXAMPLES = {
    "white": "0.3 deg/sqrt(h)",
    "flicker": "5 deg/h",
    "walk": "3 deg/h/sqrt(h)",
    "quantisation": "1 arcsec",
    "gm": "20 deg/h:300 s",
}
_LEVELS = ("rate", "acceleration", "output", "number")
_INTEGRALS = {"m/s": ("m/s^2", 1.0), "mm/s": ("m/s^2", 1e-3)}
_HOUR = math.sqrt(3600.0)
# What follows the unit of a level, or of its integral, and the factor that it makes.
_OF_LEVEL = {
    "white": {"/sqrt(Hz)": 1.0},
    "walk": {"/s/sqrt(Hz)": 1.0, "/sqrt(h)": 1 / _HOUR, "/sqrt(s)": 1.0},
    "flicker": {"": 1.0},
}
_OF_INTEGRAL = {"white": {"/sqrt(h)": 1 / _HOUR, "/sqrt(s)": 1.0}, "quantisation": {"": 1.0}}
_SPELLINGS = (
    (re.compile(r"√\(?(Hz|hr?|s)\)?"), r"sqrt(\1)"),
    (re.compile(r"sqrt\(hr\)"), "sqrt(h)"),
    (re.compile(r"^(rad|deg)/s(?:\^2|²)/sqrt\(Hz\)$"), r"\1/s/s/sqrt(Hz)"),
    (re.compile(r"^m/s(?:\^3|³)/sqrt\(Hz\)$"), "m/s^2/s/sqrt(Hz)"),
)


@dataclass(frozen=True)
class GivenTerms:
    """Noise that was given by its coefficients: SI, shape (8,) in the order of `NAMES`, and the unit of its level."""

    values: Array
    unit: str


def given_terms(
    unit: str,
    *,
    white: float | str | None,
    flicker: float | str | None,
    walk: float | str | None,
    quantisation: float | str | None,
    gm: Markov | Sequence[Markov] | None,
) -> GivenTerms:
    """Return noise given by coefficients; numbers are in SI, texts have units.

    Parameters
    ----------
    unit
        SI unit of the level where no text has one.
    white, flicker, walk, quantisation
        N, B, K, Q.
    gm
        One or two Gauss-Markov terms.

    Raises
    ------
    OptionError
        A coefficient cannot be read, is not above 0, or is of another kind of sensor; or there is none.
    """
    values = np.zeros(len(NAMES))
    given: dict[str, float | str | None] = {
        "white": white, "flicker": flicker, "walk": walk, "quantisation": quantisation,
    }  # fmt: skip
    levels: dict[str, str] = {}
    for name, value in given.items():
        if value is not None:
            values[NAMES.index(name)], level = coefficient(value, name, name)
            levels |= {} if level is None else {name: level}
    for k, (sigma, time) in enumerate(_pairs(gm)):
        values[SIGMA[k]], level = coefficient(sigma, "gm", "flicker")
        values[TIME[k]] = in_si(time, "gm", "time", "s")
        levels |= {} if level is None else {"gm": level}
        if not 0 < values[TIME[k]] < math.inf:
            raise OptionError(f"gm {time}: expected a correlation time above 0")
    found = next(iter(levels.values()), unit)
    for name, level in levels.items():
        if level != found:
            raise OptionError(f"{name}: noise of an output in {level}; expected that of one in {found}")
    if not values.any():
        options = " ".join(f"--{name}" for name in EXAMPLES)
        raise OptionError(f'no noise is given: expected one of {options}, such as --white "{EXAMPLES["white"]}"')
    return GivenTerms(values, found)


def coefficient(value: float | str, option: str, term: str) -> tuple[float, str | None]:
    """Return a coefficient in SI, and the SI unit of the level that it belongs to, None for a bare number.

    Raises
    ------
    OptionError
        It is none; the message gives an example.
    """
    unit: str | None = None
    if isinstance(value, str):
        number, text = split_quantity(value, option, EXAMPLES[term])
        factor = 1.0
        if text:
            factor, unit = _unit(text, term, f"{option} {value!r}")
        size = number * factor
    else:
        size = in_si(value, option, "", EXAMPLES[term])
    if not 0 < size < math.inf:
        raise OptionError(f"{option} {value}: expected more than 0")
    return size, unit


def _unit(text: str, term: str, called: str) -> tuple[float, str]:
    """Factor to SI of a coefficient's unit, and the SI unit of the level."""
    for pattern, instead in _SPELLINGS:
        text = pattern.sub(instead, text)
    for endings, read in ((_OF_LEVEL, _level), (_OF_INTEGRAL, _integral)):
        for ending, factor in endings.get(term, {}).items():
            if text.endswith(ending) and (found := read(text[: len(text) - len(ending)])):
                return factor * found[0], found[1]
    raise OptionError(f"{called}: expected a number with a unit such as {EXAMPLES[term]}")


def _level(text: str) -> tuple[float, str] | None:
    try:
        unit = parse_unit(text)
    except UnitError:
        return None
    return (unit.factor, si_unit(text)) if unit.quantity in _LEVELS else None


def _integral(text: str) -> tuple[float, str] | None:
    if text in _INTEGRALS:
        level, factor = _INTEGRALS[text]
        return factor, level
    if text.endswith(" s") and (found := _level(text[:-2])):
        return found
    try:
        unit = parse_unit(text)
    except UnitError:
        return None
    return (unit.factor, "rad/s") if unit.quantity == "angle" else None


def _pairs(gm: Markov | Sequence[Markov] | None) -> list[tuple[float | str, float | str]]:
    alone = isinstance(gm, str) or (isinstance(gm, tuple) and len(gm) == 2 and not any(map(_is_pair, gm)))
    several: Sequence[object] = [gm] if alone else list(gm or ())
    pairs = []
    for each in several:
        parts = each.split(":") if isinstance(each, str) else each
        if not isinstance(parts, list | tuple) or len(parts) != 2:
            raise OptionError(f"gm {each!r}: expected standard deviation and time, such as {EXAMPLES['gm']}")
        pairs.append((parts[0], parts[1]))
    if len(pairs) > len(SIGMA):
        raise OptionError(f"gm: expected at most {len(SIGMA)} Gauss-Markov terms, found {len(pairs)}")
    return pairs


def _is_pair(value: object) -> bool:
    return isinstance(value, tuple | list) or (isinstance(value, str) and ":" in value)


def by_name(values: Array) -> Mapping[str, float]:
    """Return the terms that there are, SI, by the names of `NAMES`."""
    return {name: float(value) for name, value in zip(NAMES, values, strict=True) if value}
