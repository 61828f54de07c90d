"""What a record of a magnetometer alone holds, with types: filled by those who write it, checked as it is read."""

from __future__ import annotations

from typing import Annotated, TypeVar

from imulab.procedures.magnetometer import AXES
from imulab.records.calibration import Calibration
from imulab.records.sections import FieldPlace, Length, Part, Positive, Quantity, Size, part

T = TypeVar("T")
PerReading = Annotated[list[T], "readings"]
Three = Annotated[list[T], 3]


class FieldModel(Part):
    """``model``: outputs, the field's magnitude and where it is from, how the unit was turned, what is not told."""

    mag_output_unit: str
    field: Quantity
    field_from: str
    gauge: str
    turned: str
    upright: str | None = None
    place: FieldPlace | None = None

    @property
    def axes(self) -> str:
        """Axes whose parameters the record holds: all, or those that a level turn went through."""
        return AXES.replace(self.upright or "-", "")


class FieldSummary(Part):
    """``fit``: how well one magnitude fits the readings, and what the parameters leave open of the corrected field.

    `rms` is of |m| as a part of the field; `magnitude` and `largest_magnitude` are standard uncertainties of |m|, rms
    and largest over all directions, `direction` that of the field's direction, beside the rotation; `widest_gap` is the
    angle of the direction farthest from all readings. `inflation` is what errors in common of readings in a row
    multiply the covariance by.
    """

    readings: int
    set_aside: int
    rms: Size
    noise: Length
    inflation: Positive
    degrees_of_freedom: Positive
    coverage_factor_95: Positive
    condition_number: float
    magnitude: Size
    largest_magnitude: Size
    direction: Length
    widest_gap: Length
    not_told: list[str]


class FieldReadings(Part):
    """``data``: of some readings, evenly spread, time, s, output, corrected field, of length 1, and |m| - 1."""

    time: PerReading[float | None]
    output: PerReading[Three[float]]
    field: PerReading[list[float]]
    magnitude: PerReading[float]
    used: PerReading[bool]


class MagnetometerRecord(Part):
    """A record of a magnetometer alone."""

    model: FieldModel
    fit: FieldSummary
    data: FieldReadings


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    part(record, MagnetometerRecord)


def model_of(record: Calibration) -> FieldModel:
    """Return the section ``model``; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, FieldModel, "model")


def fit_of(record: Calibration) -> FieldSummary:
    """Return the section ``fit``; errors as for `model_of`."""
    return part(record, FieldSummary, "fit")


def data_of(record: Calibration) -> FieldReadings:
    """Return the section ``data``; errors as for `model_of`."""
    return part(record, FieldReadings, "data")
