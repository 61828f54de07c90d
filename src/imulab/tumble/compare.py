"""Fresh attitudes against a record, and one record of a unit against another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.attitudes import Attitudes
from imulab.calibration import Calibration
from imulab.errors import RecordError
from imulab.estimate import chi_square_probability, coverage_factor
from imulab.recording import Array
from imulab.tumble.apply import output_factor, specific_force

_FALSE_ALARM = 0.05


@dataclass(frozen=True)
class Check:
    """How well a record still holds.

    Attributes
    ----------
    residuals
        |f| - g of each attitude under the record, m/s^2, shape (n,).
    limit
        m/s^2.
    """

    residuals: Array
    limit: float

    @property
    def passed(self) -> bool:
        """Whether every attitude is within the limit."""
        return bool((np.abs(self.residuals) <= self.limit).all())

    @property
    def worst(self) -> int:
        """Index of the attitude that is farthest off."""
        return int(np.argmax(np.abs(self.residuals)))


def check_tumble(record: Calibration, attitudes: Attitudes, *, limit: float, gravity: float | None = None) -> Check:
    """Hold fresh attitudes against an existing record, without refitting.

    Parameters
    ----------
    record
        Of procedure tumble.
    attitudes
        From `find_attitudes`.
    limit
        Largest | |f| - g | that passes, m/s^2.
    gravity
        Where the attitudes were measured, m/s^2; that of the record if not given.

    Raises
    ------
    RecordError
        The record is of another procedure.
    UnitError
        The attitudes' unit cannot be converted to the record's.
    """
    if record.procedure != "tumble":
        raise RecordError(f"a {record.procedure} record cannot be checked by attitudes; expected a tumble record")
    factor = output_factor(attitudes.recording.name, "accel", attitudes.unit, str(record.model["output_unit"]))
    force = specific_force(record, attitudes.mean * factor)
    local = float(record.model["gravity"]["value"]) if gravity is None else gravity
    return Check(np.linalg.norm(force, axis=1) - local, limit)


@dataclass(frozen=True)
class Change:
    """What became of one parameter: the difference, its standard uncertainty and the number of those that it is."""

    name: str
    difference: float
    standard_uncertainty: float
    unit: str
    significant: bool

    @property
    def deviations(self) -> float:
        """Difference in units of its standard uncertainty."""
        return self.difference / self.standard_uncertainty


@dataclass(frozen=True)
class Comparison:
    """Two records of one unit.

    Attributes
    ----------
    changes
        Parameters that both have, second record less first.
    probability
        Of differences as large as all of them together, were nothing changed (chi-square with both covariances); None
        where a covariance is missing.
    """

    changes: tuple[Change, ...]
    probability: float | None


def compare_records(first: Calibration, second: Calibration) -> Comparison:
    """Compare two tumble records of one unit, in units of their combined uncertainty.

    A change counts as significant where it exceeds what chance gives one of all the parameters in twenty comparisons
    (Bonferroni), by Student's t where a noise was estimated.

    Raises
    ------
    RecordError
        They are no two tumble records with the same output unit, or one states no uncertainty.
    """
    for record in (first, second):
        if record.procedure != "tumble":
            raise RecordError(f"cannot compare a {record.procedure} record; expected two tumble records")
        if not record.covariance.names:
            raise RecordError("a record without uncertainties cannot be compared")
    units = [str(record.model["output_unit"]) for record in (first, second)]
    if units[0] != units[1]:
        raise RecordError(f"the records have different output units: {units[0]} and {units[1]}")
    names = [name for name in first.parameters if name in second.parameters]
    freedoms = [
        r.fit["degrees_of_freedom"] for r in (first, second) if r.fit["noise"] != "known" or r.fit["excess"]["value"]
    ]
    limit = coverage_factor(float(sum(freedoms)) if freedoms else None, 1 - _FALSE_ALARM / len(names))
    changes = []
    for name in names:
        a, b = first.parameters[name], second.parameters[name]
        uncertainty = float(np.hypot(a.standard_uncertainty or 0.0, b.standard_uncertainty or 0.0))
        difference = b.value - a.value
        changes.append(Change(name, difference, uncertainty, a.unit, abs(difference) > limit * uncertainty))
    total = sum(_block(record, names) for record in (first, second))
    vector = np.array([change.difference for change in changes])
    scale = np.sqrt(np.diag(total))
    chi_square = float(vector / scale @ np.linalg.solve(total / np.outer(scale, scale), vector / scale))
    return Comparison(tuple(changes), chi_square_probability(chi_square, len(names)))


def _block(record: Calibration, names: list[str]) -> Array:
    index = [record.covariance.names.index(name) for name in names]
    block: Array = record.covariance.array()[np.ix_(index, index)]
    return block
