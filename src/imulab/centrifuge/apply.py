"""A centrifuge record applied: the acceleration-sensitive drift taken off the rates of a two-axis gyroscope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.calibration import Calibration
from imulab.centrifuge.model import CURVE_UNITS, curve
from imulab.errors import DataError, RecordError, UnitError
from imulab.recording import Array, Recording
from imulab.units import from_si, parse_unit

FORCE_COLUMNS = ("accel_x", "accel_y")
_BEYOND = 1.001
"""The highest level is not exceeded by its own rounding."""


@dataclass(frozen=True)
class AxisCurve:
    """Compensation of one axis: K0, rad/s/(m/s^2), c1, 1/(m/s^2), c2, 1/(m/s^2)^2, and the direction, rad."""

    K0: float
    c1: float
    c2: float
    direction: float


def drift_rate(force_x: Array, force_y: Array, axis: AxisCurve) -> Array:
    """Return the drift ``K(a) (a_x cos theta + a_y sin theta)``, ``a = hypot(a_x, a_y)``.

    Parameters
    ----------
    force_x, force_y
        Level specific force, m/s^2, shape (n,).
    axis
        The axis's curve.

    Returns
    -------
    Array
        rad/s, shape (n,); NaN where a force is.
    """
    along = force_x * np.cos(axis.direction) + force_y * np.sin(axis.direction)
    result: Array = curve(np.hypot(force_x, force_y), axis.K0, axis.c1, axis.c2) * along
    return result


def apply_centrifuge(record: Calibration, recording: Recording) -> Recording:
    """Return the recording with the drift subtracted from `dtg_x` and `dtg_y`, in their units; the rest is unchanged.

    Raises
    ------
    RecordError
        The record has no direction, or no curve for a column that the recording has.
    DataError
        The recording has neither `dtg_x` nor `dtg_y`, or no `accel_x`, `accel_y`.
    UnitError
        Rates that are in count or V, or forces that are no specific force.
    """
    names = [name for name in ("dtg_x", "dtg_y") if name in recording]
    if not names:
        raise DataError(f"{recording.name}: no column dtg_x or dtg_y; found {' '.join(recording.columns)}")
    curves = {name: axis_curve(record, name[-1]) for name in names}
    force_x, force_y = (_force(recording, name) for name in FORCE_COLUMNS)
    corrected = {}
    for name, axis in curves.items():
        unit = recording.units[name]
        if parse_unit(unit).quantity != "rate":
            raise UnitError(f"{recording.name}: column {name} is in {unit}, but the record corrects rates in rad/s")
        corrected[name] = recording.column(name) - from_si(drift_rate(force_x, force_y, axis), unit)
    return recording.with_columns(corrected, {})


def axis_curve(record: Calibration, axis: str) -> AxisCurve:
    """Return the compensation of an axis, ``x`` or ``y``, from a record.

    Raises
    ------
    RecordError
        It lacks the curve or its direction.
    """
    _check_parameters(record)
    if f"{axis}_K0" not in record.parameters:
        raise RecordError(f"the record has no curve for dtg_{axis} (no {axis}_K0)")
    if f"{axis}_direction" not in record.parameters:
        raise RecordError(
            f"the record has no {axis}_direction: it was made without table_angle, so that the direction of the "
            f"drift in the "
            "gyroscope is not known"
        )
    terms = [record.value(f"{axis}_{term}") if f"{axis}_{term}" in record.parameters else 0.0 for term in ("c1", "c2")]
    return AxisCurve(record.value(f"{axis}_K0"), terms[0], terms[1], record.value(f"{axis}_direction"))


def beyond_levels(record: Calibration, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie beyond the highest level tested, and the largest specific force, m/s^2."""
    top = highest_force(record)
    size = np.hypot(*(_force(recording, name) for name in FORCE_COLUMNS))
    size = np.where(np.isfinite(size), size, 0.0)
    return int(np.count_nonzero(size > _BEYOND * top)), float(size.max(initial=0.0))


def highest_force(record: Calibration) -> float:
    """Return the specific force of the highest level, m/s^2.

    Raises
    ------
    RecordError
        The record does not say.
    """
    try:
        return max(float(level["specific_force"]["value"]) for level in record.sections["levels"])
    except (KeyError, TypeError, ValueError):
        raise RecordError("the record lacks its levels") from None


def _check_parameters(record: Calibration) -> None:
    for name, parameter in record.parameters.items():
        expected = CURVE_UNITS.get(name.rpartition("_")[2])
        if expected is not None and parameter.unit != expected:
            raise RecordError(f"the record has {name} in {parameter.unit!r}, expected {expected!r}")


def _force(recording: Recording, name: str) -> Array:
    if name not in recording:
        raise DataError(
            f"{recording.name}: no column {name}: the drift needs the level specific force accel_x and accel_y; "
            f"found {' '.join(recording.columns)}"
        )
    unit = recording.units[name]
    if parse_unit(unit).quantity != "acceleration":
        raise UnitError(f"{recording.name}: column {name} is in {unit}, but the record needs specific force in m/s^2")
    return recording.si(name)
