"""What a tumble record holds, with types: filled by those who write it, checked as it is read."""

from __future__ import annotations

import math
from typing import Annotated, TypeVar

from imulab.errors import RecordError
from imulab.records.calibration import Calibration
from imulab.records.sections import (
    FieldPlace,
    Length,
    Measured,
    Part,
    Quantity,
    Size,
    StatedGravity,
    Uncertainty,
    field,
    holds,
    null,
    part,
)

T = TypeVar("T")
PerAttitude = Annotated[list[T], "attitudes"]
PerSample = Annotated[list[T], "trace"]
PerTurn = Annotated[list[T], "turns"]
PerField = Annotated[list[T], "fields"]
Three = Annotated[list[T], 3]


class TumbleModel(Part):
    """``model``: the law of the accelerometers, and the conditions of the test."""

    order: int
    gravity: StatedGravity
    output_unit: str
    gauge: str
    cross: bool | None = None
    temperature: Quantity | None = None


class GyroModel(Part):
    """What ``model`` adds of gyroscopes."""

    gyro_output_unit: str


class MagModel(Part):
    """What ``model`` adds of magnetometers: their law, and which output became which axis."""

    mag_order: int = 1
    mag_output_unit: str
    mag_axes: str = "+x +y +z"
    field: Quantity | None = null()
    place: FieldPlace | None = None


class OrderRow(Part):
    """One row of ``fit.orders``; rms and leave-one-out error in m/s^2, as Huber's loss feels the residuals.

    `largest_uncertainty` is the predicted standard uncertainty of |f| where on the sphere it is largest, m/s^2.
    """

    order: int
    parameters: int
    degrees_of_freedom: float
    rms: Size
    leave_one_out: Size | None = null()
    f_probability: float | None = null()
    bic: float | None = null()
    condition_number: float
    rank: int
    observable: bool
    largest_uncertainty: Size | None = null()

    @property
    def scatter(self) -> float:
        """Standard deviation of the residuals, m/s^2."""
        return self.rms * math.sqrt((self.degrees_of_freedom + self.parameters) / max(self.degrees_of_freedom, 1))


class Spread(Part):
    """A parameter over the trials of a Monte Carlo run, in its SI unit."""

    mean: float
    standard_deviation: Size
    interval_95: Annotated[list[float], 2]


class Trials(Part):
    """``fit.monte_carlo``."""

    trials: int
    failed: int
    parameters: dict[str, Spread]


class PriorShares(Part):
    """``fit.prior``: what it aged, its test, and what each parameter owes to it, as a share of its variance."""

    content_sha256: str
    created: str
    probability: Size
    ageing: dict[str, Quantity]
    shares: dict[str, float]


class OrderBlend(Part):
    """``fit.blend``: the highest order that the stated uncertainty allows for, and the noise that each order takes.

    `narrower`: how many times narrower biases and scale factors would be with k2 and k3 known to 20 µg.
    """

    highest_order: int
    noise_share: dict[str, float]
    narrower: dict[str, float] | None = None


class TurnAside(Part):
    """A turn that was set aside, s, and what it missed, rad."""

    start: float
    stop: float
    miss: Length


class ClockState(Part):
    """``fit.gyro.clock``: relative uncertainty, whose clock it is, and how the two differ; s."""

    of: str
    standard_uncertainty: Size
    accel_clock_rate: Measured | None = None
    latency: Measured | None = None


class RateValues(Part):
    """A value of each gyroscope, with its standard uncertainty."""

    value: Three[float]
    standard_uncertainty: Three[float]
    unit: str


class LargestRates(Part):
    """The largest rate that each gyroscope had."""

    value: Three[float]
    unit: str


class RateTest(Part):
    """``fit.gyro.nonlinearity``: scale factors that change with the rate: the test, sizes, and the rates."""

    probability: Size
    odd: RateValues
    even: RateValues
    largest_rate: LargestRates


class GyroSummary(Part):
    """``fit.gyro``."""

    turns: int
    cost: Length
    rms: Length
    degrees_of_freedom: float
    coverage_factor_95: Size | None = null()
    condition_number: float
    bias: str
    g_sensitivity: str
    latitude: float | None
    clock: ClockState
    nonlinearity: RateTest | None
    set_aside: list[TurnAside] = field(default_factory=list)
    between_samples: list[float] | None = None
    lost_samples: float | None = None


class FieldAgreement(Part):
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


class MagSummary(Part):
    """``fit.mag``."""

    attitudes: int
    magnitude: FieldAgreement
    dip: FieldAgreement
    noise: str
    sigma_magnitude: Size
    sigma_dip: Length
    sigma_direction: Length | None = None
    condition_number: float
    set_aside: list[int] = field(default_factory=list)
    heading: Heading
    moved: dict[str, float]
    of_one_sample: OneSample | None = None


class TumbleSummary(Part):
    """``fit``: how the accelerometers' estimate was made, and how well it fits; `shared` in SI, by what is shared."""

    method: str
    loss: str
    attitudes: int
    set_aside: list[int] = field(default_factory=list)
    rms: Length
    leave_one_out: Length | None = null()
    degrees_of_freedom: float
    reduced_chi_square: float | None = null()
    noise: str
    excess: Length
    effective_degrees_of_freedom: Size | None
    coverage_factor_95: Size | None
    coverage_factor_95_given_order: Size | None = None
    blend: OrderBlend | None = None
    rank: int
    condition_number: float
    iterations: int
    orders: list[OrderRow]
    shared: dict[str, dict[str, float]] | None = None
    monte_carlo: Trials | None = None
    prior: PriorShares | None = None
    gyro: GyroSummary | None = None
    mag: MagSummary | None = None

    @property
    def freedom(self) -> float | None:
        """Degrees of freedom of the uncertainties, None where the noise was known; old records hold one number only."""
        return (
            self.effective_degrees_of_freedom
            if holds(self, "effective_degrees_of_freedom")
            else self.degrees_of_freedom
        )


class HeldAttitudes(Part):
    """``data.attitudes``: of each its mean output, the specific force, m/s^2, and what is left of |f| - g."""

    label: PerAttitude[str]
    start: PerAttitude[float | None]
    stop: PerAttitude[float | None]
    samples: PerAttitude[int | None]
    mean: PerAttitude[Three[float]]
    covariance: PerAttitude[Three[Three[float]]] | None = null()
    force: PerAttitude[Three[float]]
    residual: PerAttitude[float]
    residual_before: PerAttitude[float]
    standard_uncertainty: PerAttitude[Uncertainty] | None
    lengthening: PerAttitude[float] | None = null()
    down_weight: PerAttitude[float]

    @property
    def stretches(self) -> list[tuple[float, float]]:
        """Start and stop of each, s; none for a table of attitudes."""
        return [(a, b) for a, b in zip(self.start, self.stop, strict=True) if a is not None and b is not None]


class DeviationTrace(Part):
    """``data.trace``: standard deviation within the sliding window over time, and the threshold of rest."""

    time: PerSample[float]
    deviation: PerSample[float]
    threshold: float
    unit: str


class TurnResiduals(Part):
    """``data.gyro``: of each turn its edges, s, and the residual angle, rad."""

    start: PerTurn[float]
    stop: PerTurn[float]
    residual: PerTurn[float]


class MagFields(Part):
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


class TumbleEvidence(Part):
    """``data``."""

    attitudes: HeldAttitudes | None = None
    trace: DeviationTrace | None = None
    gyro: TurnResiduals | None = None
    mag: MagFields | None = None


class Tumble(Part):
    """A tumble record."""

    model: TumbleModel
    fit: TumbleSummary
    data: TumbleEvidence


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    data = part(record, Tumble).data
    gyro_model_of(record), mag_model_of(record)
    if data.trace is not None and data.attitudes is not None and None in [*data.attitudes.start, *data.attitudes.stop]:
        raise RecordError("data.attitudes: expected a start and a stop for each, as there is a trace over time")


def model_of(record: Calibration) -> TumbleModel:
    """Return the section ``model``; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, TumbleModel, "model")


def gyro_model_of(record: Calibration) -> GyroModel:
    """Return what the section ``model`` says of gyroscopes; errors as for `model_of`."""
    return part(record, GyroModel, "model")


def mag_model_of(record: Calibration) -> MagModel:
    """Return what the section ``model`` says of magnetometers; errors as for `model_of`."""
    return part(record, MagModel, "model")


def fit_of(record: Calibration) -> TumbleSummary:
    """Return the section ``fit``; errors as for `model_of`."""
    return part(record, TumbleSummary, "fit")


def attitudes_of(record: Calibration) -> HeldAttitudes:
    """Return the attitudes that a record was fitted to.

    Raises
    ------
    RecordError
        It holds none, or something else.
    """
    return part(record, HeldAttitudes, "data.attitudes")


def gyro_of(record: Calibration) -> GyroSummary:
    """Return what was found of the gyroscopes; errors as for `attitudes_of`."""
    return part(record, GyroSummary, "fit.gyro")


def data_of(record: Calibration) -> TumbleEvidence:
    """Return the section ``data``; errors as for `model_of`."""
    return part(record, TumbleEvidence, "data")
