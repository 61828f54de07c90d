"""What a centrifuge record holds, with types, and which parameters of two records are of the same level."""

from __future__ import annotations

import re
from typing import Annotated

from imulab.errors import RecordError
from imulab.records.calibration import Calibration
from imulab.records.sections import Above0, Length, Part, PlainKind, Quantity, Size, field, part

# What code reads of a centrifuge record, with types.


Sense = Annotated[int, PlainKind("1 or -1", lambda value: type(value) is int and value in (1, -1))]


class CentrifugeModel(Part):
    """``model``; the terms of the curve by axis."""

    radius: Quantity
    gravity: Quantity
    reference: Quantity
    curve: dict[str, str]
    highest_specific_force: Length
    temperature: Quantity | None = None


class CurveTried(Part):
    """One model of the curve that was tried."""

    model: str
    coefficients: int
    chi_square: float
    chosen: bool


class Curve(Part):
    """The models tried on one axis."""

    tried: list[CurveTried]


class LevelRepeatability(Part):
    """``fit.repeatability``."""

    relative_standard_deviation: Size
    direction: Length
    within_power_cycle: Size


class CycleRow(Part):
    """K and zeta of one power cycle, by axis."""

    power_cycle: float
    x: dict[str, Quantity] = field(default_factory=dict)
    y: dict[str, Quantity] = field(default_factory=dict)
    x_down: dict[str, Quantity] = field(default_factory=dict)
    y_down: dict[str, Quantity] = field(default_factory=dict)

    def of(self, key: str) -> dict[str, Quantity]:
        """Return the values of ``x``, ``y``, ``x_down`` or ``y_down``."""
        return {"x": self.x, "y": self.y, "x_down": self.x_down, "y_down": self.y_down}[key]


class BudgetError(Part):
    """One row of the error budget."""

    error: str
    bounded: bool
    value: float | None
    standard_uncertainty: Size | None
    unit: str
    effect: float
    removed: float | None
    basis: str


class CentrifugeSummary(Part):
    """``fit``; factors and degrees of freedom by parameter, curves by axis."""

    method: str
    noise: str
    coverage_factor_95: dict[str, float]
    degrees_of_freedom: dict[str, float]
    curves: dict[str, Curve]
    repeatability: LevelRepeatability
    power_cycles: list[CycleRow] = field(default_factory=list)
    error_budget: list[BudgetError]


class DriftLine(Part):
    """Amplitudes in and out of phase with their covariance; of a run also K, from its amplitude."""

    A: float
    B: float
    covariance: Annotated[list[Annotated[list[float], 2]], 2]
    unit: str
    K: Quantity | None = None


class LevelRow(Part):
    """One of ``levels``: its runs by their place in ``runs``, and the drift per specific force of each axis."""

    level: int
    specific_force: Above0
    runs: list[int]
    x: DriftLine | None = None
    y: DriftLine | None = None
    x_down: DriftLine | None = None
    y_down: DriftLine | None = None

    def line(self, key: str) -> DriftLine | None:
        """Return the drift of ``x``, ``y``, ``x_down`` or ``y_down``."""
        return {"x": self.x, "y": self.y, "x_down": self.x_down, "y_down": self.y_down}[key]


class RunRow(Part):
    """One of ``runs``; what follows `specific_force` is of loaded runs."""

    file: str
    window: str | None = None
    power_cycle: float
    role: str
    sense: Sense
    spin_axis: str
    specific_force: Length
    table_rate_used: Quantity
    table_rate_from: str
    periods: float
    x: DriftLine | None = None
    y: DriftLine | None = None
    fog: DriftLine

    def line(self, axis: str) -> DriftLine | None:
        """Return the line of ``x`` or ``y``."""
        return {"x": self.x, "y": self.y}[axis]


class LineSpectrum(Part):
    """One of ``data.spectra``: heights of lines over the rate, rad/s, by column."""

    level: int
    spin_axis: str
    rate: Annotated[list[float], "rates"]
    height: dict[str, Annotated[list[float], "rates"]]


class CentrifugeEvidence(Part):
    """``data``."""

    spectra: list[LineSpectrum]


class CentrifugeRecord(Part):
    """A centrifuge record."""

    model: CentrifugeModel
    fit: CentrifugeSummary
    levels: Annotated[list[LevelRow], "levels"]
    runs: Annotated[list[RunRow], "runs"]
    data: CentrifugeEvidence


def centrifuge_of(record: Calibration) -> CentrifugeRecord:
    """Return the sections of a record; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, CentrifugeRecord)


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    centrifuge_of(record)


def highest_force(record: Calibration) -> float:
    """Return the specific force of the highest level, m/s^2; errors as for `centrifuge_of`."""
    return max(float(level.specific_force.value) for level in centrifuge_of(record).levels)


def level_of(levels: list[LevelRow], number: int) -> LevelRow:
    """Return the level of this number.

    Raises
    ------
    RecordError
        There is none.
    """
    for level in levels:
        if level.level == number:
            return level
    raise RecordError(f"levels: level {number} is missing")


def force_of(record: Calibration, number: int) -> float:
    """Return the specific force of a level, m/s^2; errors as for `level_of`."""
    return float(level_of(centrifuge_of(record).levels, number).specific_force.value)


# Parameters of a level are numbered: whether a number means the same level in two records.


_OF_A_LEVEL = re.compile(r"_(K|zeta|cross)_\d+$")
_SAME_LEVEL = 0.01  # relative: levels of two records this near are compared as one


def same_meaning(name: str, first: Calibration, second: Calibration) -> bool:
    """Return whether a parameter is of the same thing in both records, as one of a level is where the levels agree."""
    if not _OF_A_LEVEL.search(name):
        return True
    levels = [
        [level.specific_force.value for level in (centrifuge_of(r).levels if "levels" in r.sections else ())]
        for r in (first, second)
    ]
    return len(levels[0]) == len(levels[1]) and all(
        abs(a - b) <= _SAME_LEVEL * abs(a) for a, b in zip(*levels, strict=True)
    )
