"""What code reads of a tumble record, with types."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, TypeVar

from imulab.errors import RecordError
from imulab.records.calibration import Calibration
from imulab.records.sections import Length, Part, Positive, Quantity, Size, part

T = TypeVar("T")
PerAttitude = Annotated[list[T], "attitudes"]
PerSample = Annotated[list[T], "trace"]
PerTurn = Annotated[list[T], "turns"]
PerField = Annotated[list[T], "fields"]
Three = Annotated[list[T], 3]


class StatedGravity(Part):
    """``model.gravity``: local gravity, m/s^2, and where it is from."""

    value: Positive
    unit: str
    standard_uncertainty: Size | None = None
    from_: str


class Model(Part):
    """``model``."""

    order: int
    output_unit: str
    gyro_output_unit: str
    mag_output_unit: str
    mag_order: int = 1
    mag_axes: str = "+x +y +z"
    field: Quantity | None = None
    gravity: StatedGravity
    gauge: str
    cross: bool = False
    temperature: Quantity | None = None


class Order(Part):
    """One row of ``fit.orders``; rms and errors in m/s^2."""

    order: int
    parameters: int
    rms: Size
    leave_one_out: Size | None = None
    f_probability: float | None = None
    bic: float | None = None
    condition_number: float
    rank: int
    observable: bool
    largest_uncertainty: Size | None = None


class Spread(Part):
    """A parameter over the trials of a Monte Carlo run, in its SI unit."""

    interval_95: Annotated[list[float], 2]


class Trials(Part):
    """``fit.monte_carlo``."""

    trials: int
    failed: int
    parameters: dict[str, Spread]


class Prior(Part):
    """``fit.prior``: what each parameter owes to the prior, as a share of its variance."""

    created: str
    shares: dict[str, float]


class Blend(Part):
    """``fit.blend``: the highest order that the stated uncertainty allows for."""

    highest_order: int


class TurnAside(Part):
    """A turn that was set aside, s, and what it missed, rad."""

    start: float
    stop: float
    miss: Length


class GyroFit(Part):
    """``fit.gyro``."""

    turns: int
    rms: Length
    degrees_of_freedom: float
    coverage_factor_95: Size | None = None
    set_aside: list[TurnAside] = field(default_factory=list)


class Agreement(Part):
    """How well |m| (as a part of the field) or the dip (rad) agree over the attitudes."""

    rms: Size
    leave_one_out: Size


class Heading(Part):
    """``fit.mag.heading``: standard uncertainty from the parameters, and of one reading, rad."""

    standard_uncertainty: Length
    of_one_reading: Length


class OneSample(Part):
    """``fit.mag.of_one_sample``: noise of one axis, m/s^2 and parts of the field."""

    accel: Length
    mag: Length


class MagFit(Part):
    """``fit.mag``."""

    attitudes: int
    magnitude: Agreement
    dip: Agreement
    noise: str
    sigma_magnitude: Size
    sigma_dip: Length
    condition_number: float
    set_aside: list[int] = field(default_factory=list)
    heading: Heading
    of_one_sample: OneSample | None = None
    moved: dict[str, float]


class Fit(Part):
    """``fit``."""

    loss: str
    attitudes: int
    set_aside: list[int] = field(default_factory=list)
    rms: Length
    leave_one_out: Length | None = None
    degrees_of_freedom: float
    effective_degrees_of_freedom: Size | None
    reduced_chi_square: float | None = None
    coverage_factor_95: Size | None
    coverage_factor_95_given_order: Size | None = None
    noise: str
    excess: Length
    condition_number: float
    shared: dict[str, dict[str, float]] = field(default_factory=dict)
    orders: list[Order]
    blend: Blend | None = None
    monte_carlo: Trials | None = None
    prior: Prior | None = None
    gyro: GyroFit | None = None
    mag: MagFit | None = None

    @property
    def freedom(self) -> float | None:
        """Degrees of freedom of the uncertainties, None where the noise was known; old records hold one number only."""
        return (
            self.effective_degrees_of_freedom
            if "effective_degrees_of_freedom" in vars(self)
            else self.degrees_of_freedom
        )


class HeldAttitudes(Part):
    """``data.attitudes``: of each its mean output, the specific force, m/s^2, and what is left of |f| - g."""

    label: PerAttitude[str]
    start: PerAttitude[float | None]
    stop: PerAttitude[float | None]
    samples: PerAttitude[int | None]
    mean: PerAttitude[Three[float]]
    covariance: PerAttitude[Three[Three[float]]] | None = None
    force: PerAttitude[Three[float]]
    residual: PerAttitude[float]
    residual_before: PerAttitude[float]
    standard_uncertainty: PerAttitude[float] | None
    lengthening: PerAttitude[float] | None = None
    down_weight: PerAttitude[float]

    @property
    def stretches(self) -> list[tuple[float, float]]:
        """Start and stop of each, s; none for a table of attitudes."""
        return [(a, b) for a, b in zip(self.start, self.stop, strict=True) if a is not None and b is not None]


class Trace(Part):
    """``data.trace``: standard deviation within the sliding window over time, and the threshold of rest."""

    time: PerSample[float]
    deviation: PerSample[float]
    threshold: float


class Turns(Part):
    """``data.gyro``: of each turn its edges, s, and the residual angle, rad."""

    start: PerTurn[float]
    stop: PerTurn[float]
    residual: PerTurn[float]


class Fields(Part):
    """``data.mag``: of each attitude its number, output, field and specific force (of length 1), and what is left.

    `magnitude` is |m| less that of the field, as a part of it; `dip` is in rad.
    """

    number: PerField[int]
    label: PerField[str]
    mean: PerField[Three[float]]
    field: PerField[Three[float]]
    force: PerField[Three[float]]
    magnitude: PerField[float]
    dip: PerField[float]
    used: PerField[bool]


class Data(Part):
    """``data``."""

    attitudes: HeldAttitudes | None = None
    trace: Trace | None = None
    gyro: Turns | None = None
    mag: Fields | None = None


class Tumble(Part):
    """A tumble record."""

    model: Model
    fit: Fit
    data: Data


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    data = part(record, Tumble).data
    if data.trace is not None and data.attitudes is not None and None in [*data.attitudes.start, *data.attitudes.stop]:
        raise RecordError("data.attitudes: expected a start and a stop for each, as there is a trace over time")


def model_of(record: Calibration) -> Model:
    """Return the section ``model``; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, Model, "model")


def fit_of(record: Calibration) -> Fit:
    """Return the section ``fit``; errors as for `model_of`."""
    return part(record, Fit, "fit")


def attitudes_of(record: Calibration) -> HeldAttitudes:
    """Return the attitudes that a record was fitted to.

    Raises
    ------
    RecordError
        It holds none, or something else.
    """
    return part(record, HeldAttitudes, "data.attitudes")


def gyro_of(record: Calibration) -> GyroFit:
    """Return what was found of the gyroscopes; errors as for `attitudes_of`."""
    return part(record, GyroFit, "fit.gyro")


def data_of(record: Calibration) -> Data:
    """Return the section ``data``; errors as for `model_of`."""
    return part(record, Data, "data")
