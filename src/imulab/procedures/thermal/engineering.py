"""The units in which people read a thermal record: mg, percent, mrad, and what each changes by in a kelvin."""

from __future__ import annotations

from imulab.procedures.procedure import Row
from imulab.records.calibration import Calibration
from imulab.records.comparison import Change
from imulab.units import STANDARD_GRAVITY, from_si


def shown(name: str, unit: str) -> tuple[float, str]:
    """Return the factor from SI and the unit in which a coefficient is read."""
    kelvin = unit[unit.index("/K") :] if "/K" in unit else ""
    if name.startswith("bias"):
        return (1e6 if kelvin else 1e3) / STANDARD_GRAVITY, ("µg" if kelvin else "mg") + kelvin
    if name.startswith("gyro_bias"):
        return from_si(1.0, "deg/h" if kelvin else "deg/s"), ("deg/h" if kelvin else "deg/s") + kelvin
    if name.startswith("gyro_scale_factor") and unit.startswith("deg/s/(rad/s)"):
        return from_si(1.0, "rad/s") / from_si(1.0, "deg/s"), "deg/s/(deg/s)" + kelvin
    if name.startswith("gyro_g_sensitivity"):
        return from_si(1.0, "deg/h") * STANDARD_GRAVITY, "deg/h/g"
    if name.startswith(("misalignment", "gyro_misalignment")):
        return (1e6 if kelvin else 1e3), ("µrad" if kelvin else "mrad") + kelvin
    return 1.0, unit


def rows(record: Calibration) -> list[Row]:
    """Return the coefficients in the units in which people read them."""
    found = []
    for name, p in record.parameters.items():
        factor, unit = shown(name, p.unit)
        u = p.standard_uncertainty
        found.append(Row(name, p.value * factor, None if u is None else u * factor, unit))
    return found


def change_unit(change: Change, record: Calibration) -> tuple[float, str]:
    """Return the factor from SI and the unit in which the change of a coefficient is read."""
    return shown(change.name, change.unit)
