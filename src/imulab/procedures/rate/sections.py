"""What code reads of a rate record, with types."""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar

from imulab.errors import RecordError
from imulab.procedures.rate.choices import AXES
from imulab.records.calibration import Calibration
from imulab.records.sections import Part, Quantity, Size, part

T = TypeVar("T")
PerDwell = Annotated[list[T], "dwells"]


class Model(Part):
    """``model``."""

    gyro_order: int
    gyro_output_unit: str
    axes: str
    largest_rate: Quantity


class OfAxis(Part):
    """One of ``fit.axes``."""

    probability: Size
    by_noise: Size
    loop: Size | None
    repeatability: Size | None
    repeatability_by_noise: Size | None
    scatter: Size


class Fit(Part):
    """``fit``."""

    runs: int
    dwells: int
    rates_from: str
    between_runs: Size
    table_uncertainty: Size | None
    rate_uncertainty: Quantity
    mounting_uncertainty: Size | None
    axes: dict[str, OfAxis]


class Seen(Part):
    """``data.dwells``: of each its gyroscope, rate, rad/s, and what is left of the line, a fraction of the largest."""

    axis: PerDwell[str]
    rate: PerDwell[float]
    residual: PerDwell[float]
    standard_uncertainty: PerDwell[float]
    direction: PerDwell[Literal["rising", "falling", "turning"]]


class Data(Part):
    """``data``."""

    dwells: Seen


class Rate(Part):
    """A rate record."""

    model: Model
    fit: Fit
    data: Data


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    axes = part(record, Rate).model.axes
    if not axes or any(axis not in AXES for axis in axes) or len(set(axes)) < len(axes):
        raise RecordError(f"model.axes: expected axes such as xyz, found {axes!r}")


def rate_of(record: Calibration) -> Rate:
    """Return the sections of a record; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, Rate)
