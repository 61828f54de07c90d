"""What code reads of a noise record, with types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from imulab.errors import RecordError
from imulab.records.calibration import Calibration
from imulab.records.sections import Above0, Length, Part, Positive, Quantity, Size, part, read


class Model(Part):
    """``model``."""

    terms: dict[str, str]
    horizon: Above0


class ForFilter(Part):
    """One of ``fit.filter_white`` and ``fit.filter_walk``."""

    value: Size
    unit: str
    interval_95: Annotated[list[Size], 2]


class Values(Part):
    """Several values with their unit."""

    value: list[float]
    unit: str


class Bias(Part):
    """One of ``fit.bias_uncertainty``."""

    time: Values
    standard_uncertainty: Values


class Candidate(Part):
    """One of ``fit.columns.NAME.candidates``."""

    model: str
    deviance: float
    weight: Size
    values: Annotated[list[Size], 8]


class Line(Part):
    """A line of the spectrum."""

    frequency: Above0
    amplitude: Length


class Step(Part):
    """A change of level."""

    time: Length
    size: Quantity


class TestOfFit(Part):
    """The test of fit."""

    statistic: float
    degrees_of_freedom: int
    probability: Size


class Drift(Part):
    """How a column follows time or temperature."""

    follows: str
    slope: Quantity
    significant: bool
    removed: bool


class Column(Part):
    """One of ``fit.columns``."""

    unit: str
    interval: Above0
    length: Above0
    samples: int
    spikes: int
    lines: list[Line]
    steps: list[Step]
    full_band: bool
    ripple: Size
    shortest_time: Above0
    test: TestOfFit
    chosen: str
    candidates: list[Candidate]
    drifts: list[Drift]

    @property
    def values(self) -> list[float]:
        """The parameters of the chosen candidate."""
        return next(each.values for each in self.candidates if each.model == self.chosen)


class Fit(Part):
    """``fit``."""

    horizon: Above0
    sample_rate: Above0
    length: Above0
    logs: int
    band: dict[str, Above0]
    test: dict[str, Size]
    filter_white: dict[str, ForFilter]
    filter_walk: dict[str, ForFilter]
    bias_uncertainty: dict[str, Bias]
    columns: dict[str, Column]


class Binned(Part):
    """One of ``data.columns.NAME.spectra``."""

    interval: Positive
    count: int
    first: Annotated[list[int], "bins"]
    last: Annotated[list[int], "bins"]
    power: Annotated[list[Size], "bins"]
    freedom: Annotated[list[Size], "bins"]
    counted: Annotated[list[Size], "bins"]
    variance: Annotated[list[Positive], "bins"]


class Allan(Part):
    """``data.columns.NAME.allan``."""

    tau: Annotated[list[Positive], "times"]
    measured: Annotated[list[Size], "times"]
    fitted: Annotated[list[Size], "times"]
    low: Annotated[list[Size], "times"]
    high: Annotated[list[Size], "times"]


class Noise(Part):
    """A noise record, its ``data`` apart, whose columns differ in length."""

    model: Model
    fit: Fit


@dataclass(frozen=True)
class Drawn:
    """What the figures of a column are drawn from."""

    spectra: list[Binned]
    allan: Allan


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    for name in part(record, Noise).fit.columns:
        drawn_of(record, name)


def fit_of(record: Calibration) -> Fit:
    """Return the section ``fit``; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, Fit, "fit")


def drawn_of(record: Calibration, column: str) -> Drawn:
    """Return what the figures of a column are drawn from.

    Raises
    ------
    RecordError
        The record lacks it, or its lists do not fit each other.
    """
    where = f"data.columns.{column}"
    columns = record.data.get("columns")
    held = columns.get(column) if isinstance(columns, Mapping) else None
    if not isinstance(held, Mapping) or not isinstance(held.get("spectra"), Sequence) or not held["spectra"]:
        raise RecordError(f"the record lacks {where}.spectra")
    spectra = [read(Binned, each, f"{where}.spectra[{k}]") for k, each in enumerate(held["spectra"])]
    for k, each in enumerate(spectra):
        edges = list(zip(each.first, each.last, strict=True))
        if any(not 1 <= low <= high < each.count for low, high in edges):
            raise RecordError(f"{where}.spectra[{k}]: expected bins from 1 to {each.count - 1}")
    return Drawn(spectra, read(Allan, held.get("allan"), f"{where}.allan"))
