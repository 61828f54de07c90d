"""Parameters in the units that people read: one linear conversion for each SI unit."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import overload

from imulab.errors import UnitError
from imulab.recording import Array
from imulab.units import STANDARD_GRAVITY, conversion_factor, from_si, parse_unit

_PER_KELVIN = re.compile(r"(.+?)(/K(?:\^\d)?)")
_SMALL = {"mg": ("µg", 1e3), "mrad": ("µrad", 1e3)}
"""What changes by so little in a kelvin that a unit a thousand times smaller is read."""
_NOMINAL = {"/(m/s^2)": "acceleration", "/(rad/s)": "rate", "/T": "magnetic field"}
"""Scale factors whose nominal value is known: the quantity that is sensed over its SI unit."""
_NONLINEARITY = re.compile(r"1/\(m/s\^2\)(?:\^(\d))?")


@dataclass(frozen=True)
class Display:
    """``shown = factor value + offset`` in `unit`."""

    unit: str
    factor: float = 1.0
    offset: float = 0.0

    @overload
    def of(self, value: float) -> float: ...
    @overload
    def of(self, value: Array) -> Array: ...
    def of(self, value: float | Array) -> float | Array:
        """Return a value as it is shown."""
        return value * self.factor + self.offset


def display_of(unit: str) -> Display:
    """Return how parameters of a unit are shown.

    m/s^2 in mg, rad in mrad, rad/s in deg/h, T in uT, scale factors off nominal in ppm; their changes in a kelvin in
    µg/K, µrad/K, deg/h/K and ppm/K.
    """
    law = _PER_KELVIN.fullmatch(unit)
    if law is not None:
        shown = display_of(law[1])
        name, more = _SMALL.get(shown.unit, (shown.unit, 1.0))
        return Display(name + law[2], shown.factor * more)
    plain = {"m/s^2": "mg", "rad": "mrad", "rad/s": "deg/h", "T": "uT"}.get(unit)
    if plain is not None:
        return Display(plain, from_si(1.0, plain))
    if unit == "rad/s/(m/s^2)":
        return Display("deg/h/g", from_si(STANDARD_GRAVITY, "deg/h"))
    for over, quantity in _NOMINAL.items():
        sensed = unit.removesuffix(over)
        if sensed != unit and parse_unit(sensed).quantity == quantity:
            return Display("ppm", 1e6 / from_si(1.0, sensed), -1e6)
    match = _NONLINEARITY.fullmatch(unit)
    if match is not None:
        power = int(match[1] or 1)
        return Display(f"µg/g{'⁰¹²³⁴⁵⁶⁷⁸⁹'[power + 1]}", 1e6 * STANDARD_GRAVITY**power)
    return Display(unit)


def to_parameter_unit(value: float, unit: str, target: str) -> float:
    """Return a value in a parameter's unit; `unit` is that, one of its quantity, or the one it is shown in.

    Raises
    ------
    UnitError
        It is none of these.
    """
    shown = display_of(target)
    if unit == target:
        return value
    if unit in (shown.unit, shown.unit.replace("µ", "u")):
        return (value - shown.offset) / shown.factor
    try:
        return value * conversion_factor(unit, target)
    except UnitError:
        also = "" if shown.unit == target else f" or {shown.unit}"
        raise UnitError(f"unit {unit!r}: expected {target}{also}") from None
