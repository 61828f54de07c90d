"""The units in which people read a rate record: deg/h, ppm and mrad."""

from __future__ import annotations

from imulab.procedures.procedure import Row
from imulab.procedures.rate.sections import Prior
from imulab.records.calibration import Calibration
from imulab.records.comparison import Change
from imulab.report.elements import ReportTable, format_uncertain
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit

_FIGURES = ("gyro_nonlinearity", "gyro_asymmetry", "gyro_hysteresis")


def shown(name: str, unit: str) -> tuple[float, float, str]:
    """Return the factor and offset from SI and the unit in which a parameter is read."""
    if name.startswith("gyro_bias"):
        return from_si(1.0, "deg/h"), 0.0, "deg/h"
    if name.startswith("gyro_delay"):
        return 1e3, 0.0, "ms"
    if name.startswith("gyro_threshold"):
        return from_si(1.0, "deg/s"), 0.0, "deg/s"
    if name.startswith("gyro_g_sensitivity"):
        return from_si(STANDARD_GRAVITY, "deg/h"), 0.0, "deg/h/g"
    if name.startswith("gyro_misalignment"):
        return 1e3, 0.0, "mrad"
    if name.startswith(_FIGURES):
        return 1e6, 0.0, "ppm"
    if name.startswith("gyro_scale_factor_slope"):
        return 1e6, 0.0, "ppm/K"
    if name.startswith("gyro_scale_factor"):
        nominal = parse_unit(unit.removesuffix("/(rad/s)"))
        if nominal.quantity == "rate":
            return 1e6 * nominal.factor, -1e6, "ppm off nominal"
    return 1.0, 0.0, unit


def rows(record: Calibration) -> list[Row]:
    """Return the parameters in the units in which people read them."""
    found = []
    for name, p in record.parameters.items():
        factor, offset, unit = shown(name, p.unit)
        u = p.standard_uncertainty
        found.append(Row(name, p.value * factor + offset, None if u is None else u * factor, unit))
    return found


def change_unit(change: Change, record: Calibration) -> tuple[float, str]:
    """Return the factor from SI and the unit in which the change of a parameter is read."""
    factor, offset, unit = shown(change.name, change.unit)
    return factor, "ppm" if offset else unit


def prior_table(prior: Prior, record: Calibration) -> ReportTable:
    """Return what the prior, the test without it, and both as one fit say of each parameter."""
    found = []
    for name, of in prior.parameters.items():
        factor, offset, unit = shown(name, of.test.unit)
        texts: list[str] = []
        for one in (of.prior, of.test, record.parameter(name)):
            u = one.standard_uncertainty
            texts.append(" ± ".join(format_uncertain(one.value * factor + offset, None if u is None else u * factor)))
        found.append([name, *texts, unit])
    chance = "" if prior.probability is None else f" Probability of such differences: {prior.probability:.2g}."
    return ReportTable(
        "The earlier record and this test",
        "Each alone, and both as one fit, the result, ± standard uncertainties. What all rates of one table, or "
        f"one clock, have in common does not fall with a second test.{chance}",
        ["parameter", "earlier", "this test", "both", "unit"],
        found,
    )
