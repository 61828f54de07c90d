"""What code reads of a warm-up record, with types; its table is `imulab.procedures.warmup.model.WarmupTable`."""

from __future__ import annotations

from typing import Annotated, TypeVar

from imulab.errors import LackingError, RecordError
from imulab.records.calibration import Calibration
from imulab.records.sections import Above0, Part, Positive, Quantity, Size, field, part

# What code reads of a warm-up record, with types; its table is `imulab.procedures.warmup.model.WarmupTable`.


T = TypeVar("T")
PerAxis = Annotated[list[T], "axes"]
PerTemperature = Annotated[list[T], "temperatures"]
Rows = Annotated[list[Annotated[list[Annotated[list[float], "terms"]], "axes"]], "rows"]


class WarmupModel(Part):
    """``model``; `after` is the SHA-256 of the thermal record that the cycles were corrected by, None for none."""

    model: str
    settling_time: Above0
    pool: str = "unit"
    after: str | None = None
    temperature: Quantity | None = None


class ModelRow(Part):
    """One row of ``fit.models``; each a number for each axis, None where it is not known."""

    model: str
    chosen: bool
    scales: list[float]
    training: PerAxis[float | None]
    left_cycle: PerAxis[float | None] | None
    left_temperature: PerAxis[float | None] | None
    by_temperature: PerTemperature[PerAxis[float | None]]
    left_by_temperature: PerTemperature[PerAxis[float | None]]
    edge_jump: PerAxis[float | None]
    exit_jump: PerAxis[float | None]


class CycleRepeatability(Part):
    """``fit.repeatability``: what power cycles repeat to, and units, where there are several."""

    cycle: PerAxis[float | None]
    standard_uncertainty: PerAxis[float | None]
    by_temperature: PerTemperature[PerAxis[float | None]]
    unit: PerAxis[float | None] | None


class WarmupSummary(Part):
    """``fit``."""

    cycles: int
    units: int
    axes: PerAxis[str]
    axis_units: PerAxis[str]
    exit_rms: PerAxis[float | None]
    noise: PerAxis[float | None]
    models: list[ModelRow]
    repeatability: CycleRepeatability
    worst_temperature: Quantity | None = None

    def row(self, model: str | None = None) -> ModelRow:
        """Return the row of a model, of the chosen one if not given.

        Raises
        ------
        RecordError
            The record lacks it.
        """
        for row in self.models:
            if row.chosen if model is None else row.model == model:
                return row
        which = "the chosen model" if model is None else f"model {model}"
        raise LackingError(f"the record lacks {which} in fit.models")


class HeldTable(Part):
    """``table`` as the file holds it."""

    model: str
    temperatures: list[float]
    axes: PerAxis[str]
    units: PerAxis[str]
    coefficients: Rows
    slopes: Rows
    settling_time: Positive
    exit: str
    taper_time: Positive = 60.0
    beyond: str = "zero"
    tolerance: Size = 0.0
    time_scale: Positive | None = None
    time_constants: list[Positive] = field(default_factory=list)


class CycleCurve(Part):
    """One of ``data.cycles``: a power cycle in bins, referenced to its settled mean."""

    file: str
    serial: str | None = None
    power_on_temperature: float
    calibration_temperature: float
    end: float
    settled_mean: PerAxis[float | None]
    settled_drift: PerAxis[float | None]
    time: list[float]
    curve: PerAxis[list[float | None]]


class WarmupEvidence(Part):
    """``data``."""

    cycles: Annotated[list[CycleCurve], "cycles"]

    @property
    def knots(self) -> list[float]:
        """The calibration temperatures, rising."""
        return sorted({cycle.calibration_temperature for cycle in self.cycles})


class WarmupRecord(Part):
    """A warm-up record."""

    model: WarmupModel
    fit: WarmupSummary
    table: HeldTable
    data: WarmupEvidence


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    part(record, WarmupRecord)


def model_of(record: Calibration) -> WarmupModel:
    """Return the section ``model``; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, WarmupModel, "model")


def drawn_of(record: Calibration) -> WarmupRecord:
    """Return the sections of a record whose figures are drawn; errors as for `model_of`.

    Raises
    ------
    RecordError
        Its curves do not fit their times, or its rows by temperature the temperatures of its cycles.
    """
    warmup = part(record, WarmupRecord)
    for number, cycle in enumerate(warmup.data.cycles):
        if any(len(row) != len(cycle.time) for row in cycle.curve):
            raise RecordError(f"data.cycles[{number}].curve: expected {len(cycle.time)} values an axis, as of time")
    rows, knots = len(warmup.fit.repeatability.by_temperature), len(warmup.data.knots)
    if rows != knots:
        raise RecordError(f"fit.repeatability.by_temperature: expected {knots} rows, one a temperature, found {rows}")
    return warmup
