"""What is found of one column of a log at rest: its noise, its lines and steps, and what it drifts with."""

from __future__ import annotations

from dataclasses import dataclass

from imulab.estimation.noise.analysis import Analysis, Regression
from imulab.estimation.noise.cleaning import LevelChange, Line

_COVARIATE_UNITS = {"time": "s", "temperature": "K"}


@dataclass(frozen=True)
class CovariateDrift:
    """How a column follows time or temperature: slope and its uncertainty in SI, with the models without and with it.

    `taken` says whether the model is that of what is left.
    """

    covariate: str
    found: Regression
    letters: tuple[str, str]
    taken: bool

    @property
    def slope(self) -> float:
        """Unit of the column over that of the covariate."""
        return float(self.found.slope[0])

    @property
    def standard_uncertainty(self) -> float:
        """Of the slope."""
        return float(self.found.standard_uncertainty[0])


@dataclass(frozen=True)
class ColumnModel:
    """The noise of a column.

    Attributes
    ----------
    name, unit
        Of the column; the unit in SI.
    analysis
        Spectrum, candidates, chosen model.
    spikes, knocks, lines, steps
        What was found that is no noise; of knocks start and length, s.
    drifts
        How it follows time and temperature.
    """

    name: str
    unit: str
    analysis: Analysis
    spikes: int
    knocks: tuple[tuple[float, float], ...]
    lines: tuple[Line, ...]
    steps: tuple[LevelChange, ...]
    drifts: tuple[CovariateDrift, ...]
