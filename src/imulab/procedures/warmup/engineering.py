"""The units in which people read warm-up: deg/h and µg."""

from __future__ import annotations

from imulab.report.elements import plain_number
from imulab.units import conversion_factor

_SHOWN = {"rad/s": ("deg/h", "deg/h"), "m/s^2": ("ug", "µg")}


def engineering_unit(unit: str) -> tuple[str, float]:
    """Return the unit in which a quantity is shown, and the factor from its SI unit."""
    if unit not in _SHOWN:
        return unit, 1.0
    symbol, label = _SHOWN[unit]
    return label, conversion_factor(unit, symbol)


def in_engineering(value: float, unit: str, digits: int = 3) -> str:
    """Return a value with its unit as text."""
    label, factor = engineering_unit(unit)
    return f"{plain_number(value * factor, digits)} {label}"
