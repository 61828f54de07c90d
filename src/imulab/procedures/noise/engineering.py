"""The units in which people read noise: angle random walk in deg/sqrt(h), bias instability in deg/h, and so on."""

from __future__ import annotations

import math
from collections.abc import Sequence

from imulab.estimation.noise.terms import NAMES
from imulab.procedures.procedure import Row
from imulab.records.calibration import Calibration
from imulab.records.comparison import Change
from imulab.report.noise_figures import shown_unit

_ALLAN = {
    "white": "angle_random_walk",
    "flicker": "bias_instability",
    "walk": "rate_random_walk",
    "quantisation": "quantisation",
}
_LONGEST_FIRST = sorted([*NAMES, "ramp"], key=len, reverse=True)


def shown(term: str, unit: str) -> tuple[float, str]:
    """Return the factor from SI, and the unit, of a term of a column in `unit`; ``bias`` is a level of it."""
    if term.endswith("_time"):
        return 1.0, "s"
    if term == "ramp":
        level, name = shown("bias", unit)
        return 3600.0 * level, f"{name}/h"
    name, factor = shown_unit(unit, _ALLAN.get(term, "bias_instability"))
    return factor, name


def density(unit: str) -> tuple[float, str]:
    """Return the factor from SI, and the unit, of a noise density as data sheets have it."""
    if unit == "rad/s":
        return 180 / math.pi, "deg/s/√Hz"
    return (1e6 / 9.80665, "µg/√Hz") if unit == "m/s^2" else (1.0, f"{unit}/√Hz")


def label(term: str, unit: str) -> str:
    """Return what people call a term of a column in `unit`."""
    accel = unit == "m/s^2"
    names = {
        "white": "velocity random walk" if accel else "angle random walk",
        "flicker": "bias instability (1/f noise)",
        "walk": "acceleration random walk" if accel else "rate random walk",
        "quantisation": "quantisation",
        "ramp": "ramp",
        "gm1_sigma": "Gauss-Markov noise",
        "gm1_time": "its correlation time",
        "gm2_sigma": "second Gauss-Markov noise",
        "gm2_time": "its correlation time",
    }
    return names[term]


def split(name: str) -> tuple[str, str]:
    """Return column and term of a parameter's name."""
    for term in _LONGEST_FIRST:
        if name.endswith(f"_{term}"):
            return name[: -len(term) - 1], term
    return name, ""


def base_unit(record: Calibration, column: str) -> str:
    """Return the SI unit of a column of a record."""
    unit = record.parameter(f"{column}_white").unit
    return unit.removesuffix("/sqrt(Hz)")


def rows(record: Calibration) -> Sequence[Row]:
    """Return the parameters of a record in the units in which people read them."""
    found = []
    for name, p in record.parameters.items():
        column, term = split(name)
        factor, unit = shown(term, base_unit(record, column)) if term else (1.0, p.unit)
        u = p.standard_uncertainty
        found.append(Row(name, p.value * factor, None if u is None else u * factor, unit))
    return found


def change_unit(change: Change, record: Calibration) -> tuple[float, str]:
    """Return the factor from SI and the unit in which people read the change of a parameter."""
    column, term = split(change.name)
    return shown(term, base_unit(record, column)) if term else (1.0, change.unit)
