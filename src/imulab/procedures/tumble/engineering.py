"""The parameters of a tumble record in the units that people read: mg, ppm, mrad, µg/g²."""

from __future__ import annotations

import math
from dataclasses import dataclass

from imulab.procedures.procedure import Row
from imulab.procedures.tumble.record import zero_outputs
from imulab.procedures.tumble.sections import Trials, fit_of, model_of
from imulab.records.calibration import Calibration
from imulab.records.comparison import Change
from imulab.report.elements import format_uncertain, plain_number
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit

_OFF_NOMINAL = "ppm off nominal"
"""A scale factor whose nominal value is known is read as its difference from it."""


@dataclass(frozen=True)
class EngineeringRow(Row):
    """One parameter as people read it.

    `given_order` is the standard uncertainty if the order chosen from the data is right, None where none was chosen.
    `interval` is the 95 % interval where the parameter has one of its own.
    """

    given_order: float | None = None
    interval: tuple[float, float] | None = None

    def text(self) -> tuple[str, str]:
        """Return value and uncertainty as text."""
        return format_uncertain(self.value, self.standard_uncertainty)


def change_unit(change: Change, record: Calibration) -> tuple[float, str]:
    """Return the factor and the unit in which the change of a parameter is read."""
    output = model_of(record).output_unit
    factor, _, unit = _converted(change.name, change.unit, output, parse_unit(output).quantity == "acceleration")
    return factor, "ppm" if unit == _OFF_NOMINAL else unit


def same_meaning(name: str, first: Calibration, second: Calibration) -> bool:
    """Return whether a parameter means the same in both records: magnetometers' outputs may be renamed otherwise."""
    if name == "dip":
        return False  # of the place, not of the unit
    return not name.startswith("mag_") or first.model.get("mag_axes") == second.model.get("mag_axes")


def propagated_rows(record: Calibration, trials: Trials) -> list[list[str]]:
    """Return the Monte Carlo intervals beside the linear ones: name, both, ratio of their widths, unit."""
    fit, output = fit_of(record), model_of(record).output_unit
    physical = parse_unit(output).quantity == "acceleration"
    coverage = fit.coverage_factor_95_given_order or fit.coverage_factor_95 or 0.0
    rows = []
    for name, found in trials.parameters.items():
        parameter = record.parameter(name)
        factor, offset, unit = _converted(name, parameter.unit, output, physical)
        u = parameter.standard_uncertainty_given_order or parameter.standard_uncertainty or 0.0
        linear = [parameter.value - coverage * u, parameter.value + coverage * u]
        texts = [
            " to ".join(format_uncertain(end * factor + offset, u * abs(factor))[0] for end in ends)
            for ends in (linear, found.interval_95)
        ]
        width = linear[1] - linear[0]
        ratio = (found.interval_95[1] - found.interval_95[0]) / width if width else math.nan
        rows.append([name, *texts, f"{ratio:.3f}", unit])
    return rows


def predicted_rows(uncertainties: dict[str, float]) -> list[tuple[str, str, str]]:
    """Return predicted uncertainties (units of g) as name, text and engineering unit."""
    rows = []
    for name, value in uncertainties.items():
        stem = name.rpartition("_")[0]
        factor, unit = {"bias": (1e6, "µg"), "scale_factor": (1e6, "ppm"), "misalignment": (1e6, "µrad")}.get(
            stem, (1e6, f"µg/g{'⁰¹²³⁴⁵'[int(stem[1:])] if stem[1:].isdigit() else ''}")
        )
        rows.append((name, plain_number(value * factor, 3), unit))
    return rows


def engineering_rows(record: Calibration) -> list[EngineeringRow]:
    """Return the parameters in engineering units, the outputs at zero specific force included for counts and volts."""
    rows = []
    output = model_of(record).output_unit
    physical = parse_unit(output).quantity == "acceleration"
    zeros = {} if physical else zero_outputs(record)
    for name, parameter in record.parameters.items():
        stem, _, axis = name.rpartition("_")
        factor, offset, unit = _converted(name, parameter.unit, output, physical)
        rows.append(
            EngineeringRow(
                name,
                parameter.value * factor + offset,
                _scaled(parameter.standard_uncertainty, factor),
                unit,
                _scaled(parameter.standard_uncertainty_given_order, factor),
                _interval(parameter.interval_95, factor, offset),
            )
        )
        if stem == "bias" and axis == "z":
            rows += [
                EngineeringRow(f"zero_output_{a}", z.value, z.standard_uncertainty, output) for a, z in zeros.items()
            ]
    return rows


def _interval(ends: tuple[float, float] | None, factor: float, offset: float) -> tuple[float, float] | None:
    if ends is None:
        return None
    low, high = sorted(end * factor + offset for end in ends)
    return low, high


def _scaled(uncertainty: float | None, factor: float) -> float | None:
    return None if uncertainty is None else uncertainty * abs(factor)


def _converted(name: str, unit: str, output: str, physical: bool) -> tuple[float, float, str]:
    """Factor, offset and unit that turn a parameter of either triad into engineering units."""
    stem = name.rpartition("_")[0]
    if stem.startswith("mag_") or name == "dip":
        return _of_field(stem or name, unit)
    if not stem.startswith("gyro_"):
        return _engineering(stem, output, physical)
    if stem == "gyro_bias":
        return from_si(1.0, "deg/s"), 0.0, "deg/s"
    if stem == "gyro_scale_factor":
        sensed = unit.removesuffix("/(rad/s)")
        if parse_unit(sensed).quantity == "rate":
            return 1e6 / from_si(1.0, sensed), -1e6, _OFF_NOMINAL
        return 1.0, 0.0, unit
    if stem == "gyro_misalignment":
        return 1e3, 0.0, "mrad"
    if stem == "gyro_g_sensitivity":
        return from_si(STANDARD_GRAVITY, "deg/h"), 0.0, "deg/h/g"
    return (1e6, 0.0, "ppm") if unit == "1" else (1.0, 0.0, unit)  # of a rate table


def _of_field(stem: str, unit: str) -> tuple[float, float, str]:
    """Factor, offset and unit of a magnetometers' parameter, or of the dip."""
    if stem in ("dip", "mag_misalignment"):
        return (from_si(1.0, "deg"), 0.0, "deg") if stem == "dip" else (1e3, 0.0, "mrad")
    if stem == "mag_bias":
        return (1e6, 0.0, "uT") if unit == "T" else (1.0, 0.0, "of the field")
    if stem == "mag_scale_factor" and unit.endswith("/T"):
        sensed = unit.removesuffix("/T")
        if parse_unit(sensed).quantity == "magnetic field":
            return 1e6 / from_si(1.0, sensed), -1e6, _OFF_NOMINAL
        return 1e-6, 0.0, f"{sensed}/uT"
    return 1.0, 0.0, unit


def _engineering(stem: str, output: str, physical: bool) -> tuple[float, float, str]:
    """Factor, offset and unit that turn an SI parameter into engineering units."""
    if stem == "bias":
        return from_si(1.0, "mg"), 0.0, "mg"
    if stem == "scale_factor":
        if physical:
            return 1e6 / from_si(1.0, output), -1e6, _OFF_NOMINAL
        return 1.0, 0.0, f"{output}/(m/s²)"
    if stem == "misalignment":
        return 1e3, 0.0, "mrad"
    power = int(stem[1:] or "2")  # a cross term is k_xy: of the second degree, as k2
    superscript = "⁰¹²³⁴⁵"[power]
    return 1e6 * STANDARD_GRAVITY ** (power - 1), 0.0, f"µg/g{superscript}"


def small_g(value: float) -> str:
    """Return an acceleration in µg or mg, three significant digits."""
    micro = micro_g(value)
    return (
        f"{micro:.3g} µg"
        if abs(micro) < 999.5
        else f"{micro / 1e3:.4g} mg"
        if abs(micro) < 1e6
        else f"{micro / 1e6:.3g} g"
    )


def micro_g(value: float) -> float:
    """Return an acceleration in µg."""
    return float(from_si(value, "ug"))
