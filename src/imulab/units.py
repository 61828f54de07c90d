"""Unit strings and their SI values.

Inside imulab every number is in SI (s, m/s^2, rad, rad/s; temperature in degC). This module is the one place
that knows other units. What a sensor puts out before calibration (counts, volts) has no SI value of its own:
such units are kept as they are, with the quantity ``"output"``; only `conversion_factor` turns mV into V and mA into A.

Source: SI brochure, 9th edition; standard gravity: 3rd CGPM (1901), 9.80665 m/s^2 exactly.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, overload

from imulab.errors import UnitError, meant

if TYPE_CHECKING:  # the command line parses units before it needs NumPy
    import numpy as np
    from numpy.typing import NDArray

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity, m/s^2. A unit of measurement, not the gravity of any place."""

_DEGREE = math.pi / 180.0  # rad


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit: its symbol, the quantity that it measures, and ``SI = value * factor + offset``."""

    symbol: str
    quantity: str
    factor: float = 1.0
    offset: float = 0.0


_UNITS = {
    unit.symbol: unit
    for unit in (
        Unit("s", "time"),
        Unit("ms", "time", 1e-3),
        Unit("us", "time", 1e-6),
        Unit("ns", "time", 1e-9),
        Unit("min", "time", 60.0),
        Unit("h", "time", 3600.0),
        Unit("m/s^2", "acceleration"),
        Unit("g", "acceleration", STANDARD_GRAVITY),
        Unit("mg", "acceleration", 1e-3 * STANDARD_GRAVITY),
        Unit("ug", "acceleration", 1e-6 * STANDARD_GRAVITY),
        Unit("m/s", "velocity"),
        Unit("rad", "angle"),
        Unit("mrad", "angle", 1e-3),
        Unit("urad", "angle", 1e-6),
        Unit("deg", "angle", _DEGREE),
        Unit("arcsec", "angle", _DEGREE / 3600.0),
        Unit("rad/s", "rate"),
        Unit("mrad/s", "rate", 1e-3),
        Unit("deg/s", "rate", _DEGREE),
        Unit("mdeg/s", "rate", 1e-3 * _DEGREE),
        Unit("deg/min", "rate", _DEGREE / 60.0),
        Unit("deg/h", "rate", _DEGREE / 3600.0),
        Unit("rad/s^2", "angular acceleration"),
        Unit("degC", "temperature"),
        Unit("K", "temperature", 1.0, -273.15),
        Unit("T", "magnetic field"),
        Unit("mT", "magnetic field", 1e-3),
        Unit("uT", "magnetic field", 1e-6),
        Unit("nT", "magnetic field", 1e-9),
        Unit("gauss", "magnetic field", 1e-4),
        Unit("mgauss", "magnetic field", 1e-7),
        Unit("count", "output"),
        Unit("V", "output"),
        Unit("mV", "output"),
        Unit("A", "output"),
        Unit("mA", "output"),
        Unit("pulse/s", "output"),
        Unit("count/(deg/s)", "output per rate", 1.0 / _DEGREE),
        Unit("V/(deg/s)", "output per rate", 1.0 / _DEGREE),
        Unit("mV/(deg/s)", "output per rate", 1.0 / _DEGREE),
        Unit("A/(deg/s)", "output per rate", 1.0 / _DEGREE),
        Unit("mA/(deg/s)", "output per rate", 1.0 / _DEGREE),
        Unit("pulse/s/(deg/s)", "output per rate", 1.0 / _DEGREE),
        Unit("m", "length"),
        Unit("mm", "length", 1e-3),
        Unit("Hz", "frequency"),
        Unit("kHz", "frequency", 1e3),
        Unit("1", "number"),
        Unit("ppm", "number", 1e-6),
    )
}

_SPELLINGS = {
    "µs": "us",
    "μs": "us",
    "µg": "ug",
    "μg": "ug",
    "m/s²": "m/s^2",
    "m/s2": "m/s^2",
    "m/s**2": "m/s^2",
    "°C": "degC",
    "℃": "degC",
    "°/s": "deg/s",
    "°": "deg",
    "°/h": "deg/h",
    "°/hr": "deg/h",
    "deg/hr": "deg/h",
    "°/min": "deg/min",
    "dps": "deg/s",
    "mdps": "mdeg/s",
    "m°/s": "mdeg/s",
    "µrad": "urad",
    "μrad": "urad",
    "µT": "uT",
    "μT": "uT",
    "Gauss": "gauss",
    "mG": "mgauss",
    "counts": "count",
    "LSB": "count",
    "lsb": "count",
    "pulses/s": "pulse/s",
}
_ELECTRIC = {"V": ("V", 1.0), "mV": ("V", 1e-3), "A": ("A", 1.0), "mA": ("A", 1e-3)}


def parse_unit(text: str, quantities: Sequence[str] = ()) -> Unit:
    """Return the unit that a symbol stands for.

    Parameters
    ----------
    text
        Symbol, e.g. ``"m/s^2"``, ``"mg"``, ``"deg/h"``, ``"count"``.
    quantities
        What it is expected to measure: a message lists these units alone; any that is known is returned.

    Raises
    ------
    UnitError
        The symbol is not known; the message lists those that are.
    """
    symbol = text.strip()
    unit = _UNITS.get(_SPELLINGS.get(symbol, symbol))
    if unit is None and "@" in symbol:
        unit = _increment(symbol)
    if unit is None:
        known = known_units(*quantities)
        written, parts = _letters(symbol), symbol.count("/")
        alike = [n for n in known if _letters(n) == written and (quantities or n.count("/") == parts)]
        raise UnitError(f"unknown unit {text!r}; known units: {' '.join(known)}{meant(alike, symbol, 0.0)}")
    return unit


def _letters(symbol: str) -> str:
    """Return what two spellings of a unit have in common, such as ``degs`` of ``deg/s``, ``DEG/sec`` and ``degps``.

    Another prefix, quantity or size is no spelling: rpm is not ppm, mGal not mg, Mrad not mrad, m/s not m/s^2.
    """
    lower = re.sub(r"^M(?=[A-Za-z])", "mega", symbol).lower()
    short = re.sub(r"p(?=[sh])|(?<=s)ec\b|[^a-z\d]", "", re.sub(r"\d+", "2", lower))
    return re.sub(r"(?<=.)(.)\1+$", r"\1", short)


def known_units(*quantities: str) -> list[str]:
    """Return the symbols of the units of some quantities; without any, of all."""
    return [unit.symbol for unit in _UNITS.values() if not quantities or unit.quantity in quantities]


_GAINED = {"angle": "rate", "velocity": "acceleration"}
"""Quantities that are gained in a sample, and what they are in a second."""


def _increment(symbol: str) -> Unit | None:
    """Return the unit of increments with their rate, ``deg@125Hz``: times 125 they are the mean rate over a sample."""
    gained, _, often = symbol.partition("@")
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?(?:e\+?\d+)?)\s*(k?)Hz\s*", often)
    base = _UNITS.get(_SPELLINGS.get(gained.strip(), gained.strip()))
    if match is None or base is None or base.quantity not in _GAINED or not 0 < float(match[1]) < math.inf:
        return None
    rate = float(match[1]) * (1e3 if match[2] else 1.0)
    return Unit(f"{base.symbol}@{rate:g}Hz", _GAINED[base.quantity], base.factor * rate)


def parse_scale_factor(text: str) -> tuple[Unit, Unit]:
    """Return the units of output and measured quantity of a scale factor such as ``V/(deg/s)``.

    Raises
    ------
    UnitError
        It is no output (count, V, mV, A, mA, pulse/s) per unit of something else.
    """
    for place in (i for i, sign in enumerate(text) if sign == "/"):
        output, measured = text[:place], text[place + 1 :].strip()
        if measured.startswith("(") and measured.endswith(")"):
            measured = measured[1:-1]
        try:
            pair = parse_unit(output), parse_unit(measured)
        except UnitError:
            continue
        if pair[0].quantity == "output" and not pair[1].quantity.startswith("output"):
            return pair
    raise UnitError(f"unit {text!r}: expected an output per unit of what is measured, such as V/(deg/s) or count/g")


@overload
def to_si(values: float, unit: str) -> float: ...
@overload
def to_si(values: NDArray[np.float64], unit: str) -> NDArray[np.float64]: ...
def to_si(values: float | NDArray[np.float64], unit: str) -> float | NDArray[np.float64]:
    """Convert values in `unit` to SI (counts and volts are returned as they are).

    Raises
    ------
    UnitError
        The unit is not known.
    """
    known = parse_unit(unit)
    if known.factor == 1.0 and known.offset == 0.0:
        return values
    converted = values * known.factor
    converted += known.offset  # in place: a column of a long log is large
    return converted


@overload
def from_si(values: float, unit: str) -> float: ...
@overload
def from_si(values: NDArray[np.float64], unit: str) -> NDArray[np.float64]: ...
def from_si(values: float | NDArray[np.float64], unit: str) -> float | NDArray[np.float64]:
    """Convert SI values to `unit`; the inverse of `to_si`.

    Raises
    ------
    UnitError
        The unit is not known.
    """
    known = parse_unit(unit)
    if known.factor == 1.0 and known.offset == 0.0:
        return values
    return (values - known.offset) / known.factor


def si_unit(symbol: str) -> str:
    """Return the unit of values that `to_si` returns: counts and volts keep theirs.

    Raises
    ------
    UnitError
        The unit is not known.
    """
    unit = parse_unit(symbol)
    if unit.factor == 1.0 and unit.offset == 0.0:
        return unit.symbol
    of_it = (other for other in _UNITS.values() if other.quantity == unit.quantity)
    return next((other.symbol for other in of_it if other.factor == 1.0 and other.offset == 0.0), unit.symbol)


_LIKELY_RATES, _LIKELY_DURATIONS = (1.0, 10_000.0), (10.0, 7 * 86_400.0)
"""Rates, Hz, and durations, s, of tests: what else a unit of time may be makes both likely."""


def likely_times(unit: str, rate: float, duration: float) -> str:
    """Return in which other units times of a rate, Hz, and a duration, s, are likely: ``100 Hz if it is in ms``."""
    likely = []
    for other in ("s", "ms", "us"):
        factor = conversion_factor(other, unit)
        if (
            _LIKELY_RATES[0] <= rate / factor < _LIKELY_RATES[1]
            and _LIKELY_DURATIONS[0] <= duration * factor <= _LIKELY_DURATIONS[1]
            and factor != 1.0  # the same unit, perhaps by another name
        ):
            likely.append(f"{rate / factor:.4g} Hz if it is in {other}")
    return " or ".join(likely)


def ask_unit_of_time(unit: str, rate: float, duration: float) -> str:
    """Return the question whether a unit of time is right, with what else it may be."""
    likely = likely_times(unit, rate, duration)
    return f"is the unit of time right{': ' if likely else ''}{likely}?"


def conversion_factor(source: str, target: str) -> float:
    """Return the factor that turns an interval in `source` into one in `target`.

    Raises
    ------
    UnitError
        The two do not measure the same quantity; of the outputs only V and mV, and A and mA, convert to each other.
    """
    a, b = parse_unit(source), parse_unit(target)
    (base, factor), (other, divisor) = (_ELECTRIC.get(unit.symbol, (unit.symbol, 1.0)) for unit in (a, b))
    if base == other and a.symbol != b.symbol:
        return factor / divisor
    if a.quantity != b.quantity or (a.quantity.startswith("output") and a.symbol != b.symbol):
        raise UnitError(f"cannot convert {a.symbol} ({a.quantity}) to {b.symbol} ({b.quantity})")
    return a.factor / b.factor if a.symbol != b.symbol else 1.0
