"""What code reads of a rate record, with types."""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar

from imulab.errors import RecordError
from imulab.procedures.rate.choices import AXES
from imulab.records.calibration import Calibration
from imulab.records.sections import Part, Quantity, Size, part

T = TypeVar("T")
PerDwell = Annotated[list[T], "dwells"]
PerTurn = Annotated[list[T], "turns"]


class Model(Part):
    """``model``."""

    gyro_order: int
    gyro_output_unit: str
    axes: str
    from_: str
    largest_rate: Quantity


class OfModel(Part):
    """The part of a record that one of steps and one of turns share."""

    model: Model


class OfAxis(Part):
    """One of ``fit.axes``."""

    probability: Size
    by_noise: Size
    loop: Size | None
    fitted_loop: float | None
    fitted_loop_uncertainty: Size | None
    repeatability: Size | None
    repeatability_by_noise: Size | None
    order: int
    by_polynomial: Size
    scatter: Size


class Swept(Part):
    """One of ``fit.sweeps``; s and Hz."""

    file: str
    axis: str
    frequency: Size | None
    delay: float
    delay_uncertainty: Size
    bandwidth: Size | None
    bandwidth_uncertainty: Size | None
    bandwidth_beyond: Size | None


class OfPrior(Part):
    """One parameter of ``fit.prior``: what the prior says of it, and the test without that."""

    prior: Quantity
    test: Quantity


class Prior(Part):
    """``fit.prior``."""

    probability: Size | None
    parameters: dict[str, OfPrior]


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
    sweeps: list[Swept]
    prior: Prior


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


class TurnsFit(Part):
    """``fit`` of turns."""

    turns: int
    fence: Quantity
    clock: Size | None
    prior: Prior


class Turned(Part):
    """``data.turns``; angles in rad."""

    axis: PerTurn[str]
    start: PerTurn[float]
    stop: PerTurn[float]
    count: PerTurn[float]
    angle: PerTurn[float]
    residual: PerTurn[float]
    standard_uncertainty: PerTurn[float]


class TurnsData(Part):
    """``data`` of turns."""

    turns: Turned


class Turns(Part):
    """A record of turns."""

    model: Model
    fit: TurnsFit
    data: TurnsData


class Rate(Part):
    """A rate record."""

    model: Model
    fit: Fit
    data: Data


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    if record.model.get("from") == "turns":
        part(record, Turns)
    else:
        part(record, Rate)
    axes = model_of(record).axes
    if not axes or any(axis not in AXES for axis in axes) or len(set(axes)) < len(axes):
        raise RecordError(f"model.axes: expected axes such as xyz, found {axes!r}")


def model_of(record: Calibration) -> Model:
    """Return the model of a record of steps or of turns; errors as for `rate_of`."""
    return part(record, OfModel).model


def rate_of(record: Calibration) -> Rate:
    """Return the sections of a record; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, Rate)


def turns_of(record: Calibration) -> Turns:
    """Return the sections of a record of turns; errors as for `rate_of`."""
    return part(record, Turns)
