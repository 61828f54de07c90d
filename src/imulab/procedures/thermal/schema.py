"""The sections of a thermal record, with types: filled by those who write it, checked as it is read."""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar

from imulab.errors import RecordError
from imulab.procedures.thermal.model import Laws
from imulab.records.calibration import Calibration
from imulab.records.sections import Length, Measured, Part, Quantity, Size, StatedGravity, Uncertainty, null, part

T = TypeVar("T")
PerHold = Annotated[list[T], "holds"]
PerGyroHold = Annotated[list[T], "holds of gyroscopes"]
PerCalibration = Annotated[list[T], "calibrations"]
PerChange = Annotated[list[T], "recordings with accelerometers"]
Three = Annotated[list[T], 3]
Nine = Annotated[list[T], 9]


class LawDegrees(Part):
    """``model.degrees``: the degrees of the laws of each kind of parameter."""

    bias: int
    scale_factor: int
    misalignment: int

    @property
    def each(self) -> tuple[int, int, int]:
        """The degrees in the order of the kinds."""
        return self.bias, self.scale_factor, self.misalignment


class GyroDegrees(Part):
    """``model.gyro.degrees``."""

    bias: int
    scale_factor: int


class ThermalGyroModel(Part):
    """``model.gyro``: the unit of the gyroscopes' outputs, the degrees of their laws, and what else was fitted.

    The knots of their biases are in degC, None where these are polynomials.
    """

    output_unit: str
    degrees: GyroDegrees
    knots: list[float] | None = None
    g_sensitivity: bool
    scale: Literal["nominal", "turns"]


class RampModel(Part):
    """``model`` of rest ramps, and what the whole model has of gyroscopes; the range of temperature in degC."""

    range: Annotated[list[float], 2]
    reference_temperature: Quantity
    gyro: ThermalGyroModel | None = None

    @property
    def gyro_laws(self) -> Laws:
        """The laws of the gyroscopes' biases and scale factors."""
        assert self.gyro is not None
        degrees = self.gyro.degrees.bias, self.gyro.degrees.scale_factor, 0
        return Laws(self.range[0], self.range[1], degrees, tuple(self.gyro.knots or ()))


class ThermalModel(RampModel):
    """``model``; the knots of the bias in degC, None where it is a polynomial."""

    order: int
    degrees: LawDegrees
    knots: list[float] | None = None
    gravity: StatedGravity
    output_unit: str
    gauge: str

    @property
    def laws(self) -> Laws:
        """The laws of the accelerometers."""
        return Laws(self.range[0], self.range[1], self.degrees.each, tuple(self.knots or ()))


class LeftOutTemperature(Part):
    """One row of ``fit.left_out_temperature``: degC, and rms in m/s^2."""

    temperature: float
    holds: int
    rms: Size
    chi_square: Size


class DegreesTried(Part):
    """One row of ``fit.degrees``."""

    degrees: Three[int]
    left_out: Size | None
    probability: float | None
    chosen: bool
    knots: int = 0


class TurnOn(Part):
    """``fit.between_recordings``: standard deviation of biases and scale factors between power cycles.

    `from_` says how that is known: ``recordings``, ``argument``, ``unknown``, or ``polynomials``, an upper bound.
    `resolution` is the standard uncertainty of one such offset; None in older records.
    """

    bias: Length
    scale_factor: Length
    rank: int
    resolution: Length | None = null()
    from_: str


class TestedEffect(Measured):
    """``fit.lag`` in s, ``fit.loop_x`` ...: a value, its probability by chance, and whether it is in the fit."""

    probability: float
    fitted: bool


class GyroTurnOn(Part):
    """``fit.gyro.between_recordings``: standard deviation of biases between power cycles, as in `TurnOn`."""

    bias: Length
    rank: int
    resolution: Length | None = null()
    from_: str


class GyroTurns(Part):
    """``fit.gyro.turns``: numbers of recordings and turns, rms error of gravity's direction, and how they agree."""

    recordings: int
    turns: int
    rms: Length
    chi_square: Size
    degrees_of_freedom: int


class ThermalGyroSummary(Part):
    """``fit.gyro``; rms in rad/s, as those of temperatures left out."""

    holds: int
    rms: Length
    excess: Length
    chi_square: Size
    degrees_of_freedom: float
    between_recordings: GyroTurnOn
    g_sensitivity_probability: float | None = null()
    latitude: float | None = null()
    lag: TestedEffect | None = null()
    loop_x: TestedEffect | None = null()
    loop_y: TestedEffect | None = null()
    loop_z: TestedEffect | None = null()
    left_out_temperature: list[LeftOutTemperature]
    turns: GyroTurns | None = None


class RampSummary(Part):
    """``fit`` of rest ramps, and what the whole model has of gyroscopes.

    `not_told` lists the parameters that such a test cannot show, of a whole test None.
    """

    not_told: list[str] | None = None
    gyro: ThermalGyroSummary | None = None


class ThermalSummary(RampSummary):
    """``fit``."""

    recordings: int
    holds: int
    temperatures: int
    rms: Length
    excess: Length
    chi_square: Size
    degrees_of_freedom: float
    condition_number: float
    between_recordings: TurnOn
    left_out_temperature: list[LeftOutTemperature]
    degrees: list[DegreesTried]
    lag: TestedEffect | None = null()
    loop_x: TestedEffect | None = null()
    loop_y: TestedEffect | None = null()
    loop_z: TestedEffect | None = null()


class HoldResiduals(Part):
    """``data.holds``: recording, edges, s, temperature, degC, its change, K/s, and residual |f| - g of each hold.

    `group` numbers the holds between which the unit was not turned; None for a hold by itself.
    """

    recording: PerHold[str]
    start: PerHold[float | None]
    stop: PerHold[float | None]
    temperature: PerHold[float]
    rate: PerHold[float]
    group: PerHold[int | None]
    mean: PerHold[Three[float]]
    residual: PerHold[float]
    standard_uncertainty: PerHold[Uncertainty]


class GyroHoldResiduals(Part):
    """``data.gyro``: temperature, degC, its change, K/s, and residuals of the rates, rad/s, of each hold."""

    recording: PerGyroHold[str]
    temperature: PerGyroHold[float]
    rate: PerGyroHold[float]
    residual: PerGyroHold[Three[float]]


class OwnCalibrations(Part):
    """``data.calibrations``: the nine parameters by each steady recording alone, SI, at its temperature, degC.

    In the order of bias, scale factor and misalignment.
    """

    recording: PerCalibration[str]
    temperature: PerCalibration[float]
    values: PerCalibration[Nine[float]]
    standard_uncertainty: PerCalibration[Nine[float]]


class AccelChange(Part):
    """``data.accel_change`` of rest ramps: the change of the accelerometers' output along gravity, by recording.

    `up` is the direction up in the body; `change`, m/s^2, at each `temperature`, degC, is from the middle of the range.
    """

    recording: PerChange[str]
    up: PerChange[Three[float]]
    temperature: PerChange[list[float]]
    change: PerChange[list[float]]
    standard_uncertainty: PerChange[list[float]]


class RampEvidence(Part):
    """``data`` of rest ramps, and what the whole model has of gyroscopes."""

    gyro: GyroHoldResiduals | None = None
    accel_change: AccelChange | None = None


class ThermalEvidence(RampEvidence):
    """``data``."""

    holds: HoldResiduals
    calibrations: OwnCalibrations | None = None


class RampRecord(Part):
    """What records of rest ramps, without accelerometers, and whole thermal records have in common."""

    model: RampModel
    fit: RampSummary
    data: RampEvidence


class ThermalRecord(Part):
    """A thermal record."""

    model: ThermalModel
    fit: ThermalSummary
    data: ThermalEvidence


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    thermal = gyros_of(record) if is_ramp(record) else thermal_of(record)
    low, high = thermal.model.range
    if not low < high:
        raise RecordError(f"model.range: expected two temperatures in rising order, found {low:g} and {high:g}")
    if isinstance(thermal.model, ThermalModel):
        _check_knots(thermal.model, thermal.model, "model")
    if thermal.model.gyro is not None:
        _check_knots(thermal.model, thermal.model.gyro, "model.gyro")


def _check_knots(model: RampModel, triad: ThermalModel | ThermalGyroModel, where: str) -> None:
    """Refuse knots of a triad's biases that are no temperatures in rising order over the range."""
    (low, high), knots = model.range, triad.knots
    if knots is None:
        return
    if not (len(knots) > 2 and [low, high] == [knots[0], knots[-1]] and sorted(set(knots)) == knots):
        raise RecordError(
            f"{where}.knots: expected three temperatures or more in rising order, from {low:g} to {high:g}, the ends "
            f"of the range; found {' '.join(f'{knot:g}' for knot in knots)}"
        )
    if triad.degrees.bias != 3:
        raise RecordError(f"{where}.degrees.bias: expected 3 of a spline, found {triad.degrees.bias}")


def thermal_of(record: Calibration) -> ThermalRecord:
    """Return the sections of a record; raises RecordError for a wrong part, for a missing one when it is asked for."""
    return part(record, ThermalRecord)


def gyros_of(record: Calibration) -> RampRecord:
    """Return the sections of a record as far as they are of gyroscopes; errors as for `thermal_of`."""
    return part(record, RampRecord)


def is_ramp(record: Calibration) -> bool:
    """Return whether a record is of rest ramps, which tell the gyroscopes' biases alone."""
    return gyros_of(record).fit.not_told is not None


def refuse_ramp(record: Calibration, purpose: str) -> None:
    """Raise RecordError for a record of rest ramps, which is not enough for a purpose, such as ``a prior``."""
    if is_ramp(record):
        raise RecordError(
            f"the thermal record is of rest ramps, which tell no scale factors and no accelerometers: it is not enough "
            f"for {purpose}; expected one of tumbles over temperature"
        )
