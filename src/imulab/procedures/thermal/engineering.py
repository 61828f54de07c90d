"""The units in which people read a thermal record: mg, ppm, mrad, and what each changes by in a kelvin."""

from __future__ import annotations

from imulab.procedures.procedure import Row
from imulab.records.calibration import Calibration
from imulab.records.comparison import Change
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit


def shown(name: str, unit: str) -> tuple[float, float, str]:
    """Return the factor and offset from SI and the unit in which a coefficient is read."""
    kelvin = unit[unit.index("/K") :] if "/K" in unit else ""
    if name.startswith("bias"):
        return (1e6 if kelvin else 1e3) / STANDARD_GRAVITY, 0.0, ("µg" if kelvin else "mg") + kelvin
    if name.startswith("gyro_bias"):
        return from_si(1.0, "deg/h" if kelvin else "deg/s"), 0.0, ("deg/h" if kelvin else "deg/s") + kelvin
    if name.startswith(("scale_factor", "gyro_scale_factor")):
        of = "/(rad/s)" if name.startswith("gyro") else "/(m/s^2)"
        nominal = parse_unit(unit.removesuffix(kelvin).removesuffix(of))
        if nominal.quantity in ("acceleration", "rate"):
            own = 1e6 * nominal.factor
            return (own, 0.0, "ppm" + kelvin) if kelvin else (own, -1e6, "ppm off nominal")
    if name.startswith("gyro_g_sensitivity"):
        return from_si(1.0, "deg/h") * STANDARD_GRAVITY, 0.0, "deg/h/g"
    if name.startswith(("misalignment", "gyro_misalignment")):
        return (1e6 if kelvin else 1e3), 0.0, ("µrad" if kelvin else "mrad") + kelvin
    return 1.0, 0.0, unit


def rows(record: Calibration) -> list[Row]:
    """Return the coefficients in the units in which people read them."""
    found = []
    for name, p in record.parameters.items():
        factor, offset, unit = shown(name, p.unit)
        u = p.standard_uncertainty
        found.append(Row(name, p.value * factor + offset, None if u is None else u * factor, unit))
    return found


def change_unit(change: Change, record: Calibration) -> tuple[float, str]:
    """Return the factor from SI and the unit in which the change of a coefficient is read."""
    factor, offset, unit = shown(change.name, change.unit)
    return factor, "ppm" if offset else unit
