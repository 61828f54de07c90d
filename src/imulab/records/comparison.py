"""Comparison of two records of a unit by the same procedure: changes in units of their combined uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imulab.errors import RecordError
from imulab.estimation.decisions import PARAMETER_CHANGED
from imulab.estimation.least_squares import chi_square_probability, coverage_factor
from imulab.recording import Array
from imulab.records.calibration import Calibration

_SINGULAR = 1e-9
"""Eigenvalues of the correlations below this share of the largest belong to parameters that follow from others."""
_ALIKE = {"degC": (1.0, 0.0), "s": (0.0, 0.1)}
"""Quantities of two models differ beyond this, absolute and relative; others beyond 1e-6 relative."""


@dataclass(frozen=True)
class Change:
    """Change of one parameter: difference and its standard uncertainty, None where one record states none."""

    name: str
    difference: float
    standard_uncertainty: float | None
    unit: str
    significant: bool

    @property
    def deviations(self) -> float | None:
        """Difference in units of its standard uncertainty, None where there is none."""
        return self.difference / self.standard_uncertainty if self.standard_uncertainty else None


@dataclass(frozen=True)
class RecordComparison:
    """Two records of one unit.

    Attributes
    ----------
    changes
        Parameters that both have, second record less first.
    probability
        Of differences as large as all of them together, were nothing changed (chi-square with both covariances); None
        where a covariance is missing.
    left_out
        Parameters that one record alone has, or that mean something else in the other.
    models
        In what the two models differ (order, gravity, temperature ...), a text each: a change may come from that.
    """

    changes: tuple[Change, ...]
    probability: float | None
    left_out: tuple[str, ...] = ()
    models: tuple[str, ...] = ()


def compared(
    first: Calibration, second: Calibration, same_meaning: Callable[[str, Calibration, Calibration], bool] | None = None
) -> RecordComparison:
    """Return the comparison of two records of one unit by one procedure, in units of their combined uncertainty.

    A change counts as significant where it exceeds what chance gives one of all the parameters in twenty comparisons
    (Bonferroni), by Student's t where a noise was estimated. A parameter without an uncertainty, or one that the
    record keeps out of its covariance (the largest of several residuals), is shown, not judged.
    `same_meaning` says whether a parameter means the same in both, where its name does not.

    Raises
    ------
    RecordError
        They are of different procedures or in different units, or one states no uncertainty.
    """
    if first.procedure != second.procedure:
        raise RecordError(
            f"cannot compare a {first.procedure} record with a {second.procedure} record; expected two of one procedure"
        )
    _check_units(first, second)
    shared = [
        name
        for name in first.parameters
        if name in second.parameters and (same_meaning is None or same_meaning(name, first, second))
    ]
    if not shared:
        raise RecordError(
            "the two records have no parameter that means the same in both: their models differ "
            f"({'; '.join(_model_differences(first.model, second.model)) or 'in all names'})"
        )
    judged = [name for name in shared if _uncertainty(name, first, second)]
    if not judged:
        raise RecordError("a record without uncertainties cannot be compared")
    share = 1 - PARAMETER_CHANGED.level / len(judged)
    changes = []
    for name in shared:
        uncertainty = _uncertainty(name, first, second)
        difference = second.parameters[name].value - first.parameters[name].value
        known = [freedom for record in (first, second) if (freedom := _freedom(record, name)) is not None]
        limit = coverage_factor(float(sum(known)) if known else None, share) if uncertainty else np.inf
        significant = uncertainty is not None and abs(difference) > limit * uncertainty
        changes.append(Change(name, difference, uncertainty, first.parameters[name].unit, bool(significant)))
    either = dict.fromkeys([*first.parameters, *second.parameters])
    return RecordComparison(
        tuple(changes),
        _joint(first, second, judged, changes),
        tuple(name for name in either if name not in shared),
        tuple(_model_differences(first.model, second.model)),
    )


def _check_units(first: Calibration, second: Calibration) -> None:
    units = [record.model.get("output_unit") for record in (first, second)]
    if units[0] != units[1]:
        raise RecordError(f"the records have different output units: {units[0]} and {units[1]}")
    for name, parameter in first.parameters.items():
        other = second.parameters.get(name, parameter).unit
        if parameter.unit != other:
            raise RecordError(f"the records have {name} in different units: {parameter.unit} and {other}")


def _model_differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> Iterator[str]:
    """Return the entries of both models that differ: words, numbers, quantities with a unit, sets of these."""
    for key, mine in first.items():
        its = second.get(key)
        if isinstance(mine, dict) and isinstance(its, dict):
            yield from (f"{key} {text}" for text in _quantity_differences(mine, its))
        elif isinstance(mine, str | int) and isinstance(its, str | int) and mine != its:
            yield f"{key} {mine} and {its}"


def _quantity_differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> Iterator[str]:
    """Return the difference of two quantities with a unit, or those of two sets of entries."""
    if not {"value", "unit"} <= first.keys() & second.keys():
        yield from _model_differences(first, second)
        return
    values, unit = (first["value"], second["value"]), first["unit"]
    absolute, relative = _ALIKE.get(unit, (0.0, 1e-6))
    if unit == second["unit"] and abs(values[0] - values[1]) > absolute + relative * max(map(abs, values)):
        yield f"{values[0]:.7g} and {values[1]:.7g} {unit}"


def _uncertainty(name: str, first: Calibration, second: Calibration) -> float | None:
    """Return the uncertainty of a difference; None where a record states none, or keeps it out of its covariance."""
    a, b = (record.parameters[name].standard_uncertainty for record in (first, second))
    if a is None or b is None:
        return None
    if any(record.covariance.names and name not in record.covariance.names for record in (first, second)):
        return None
    return float(np.sqrt(max(a**2 + b**2 - _shared(first, second, [name])[0, 0], 0.0))) or None


def _shared(first: Calibration, second: Calibration, names: list[str]) -> Array:
    """Return the covariance of errors that both records have in common (gravity of a place), which cancel."""
    total = np.zeros((len(names), len(names)))
    mine, its = (record.fit.get("shared", {}) for record in (first, second))
    for what in mine.keys() & its.keys():
        first_terms, second_terms = (np.array([terms[what].get(name, 0.0) for name in names]) for terms in (mine, its))
        total += np.outer(first_terms, second_terms) + np.outer(second_terms, first_terms)
    return total


def _freedom(record: Calibration, name: str) -> float | None:
    """Return the degrees of freedom of a parameter's uncertainty; None where the noise was known."""
    fit = record.fit
    if "effective_degrees_of_freedom" in fit:
        effective: float | None = fit["effective_degrees_of_freedom"]
        return effective
    noise = fit.get("noise")
    if noise == "known" and not fit.get("excess", {}).get("value"):
        return None
    stated = fit.get("degrees_of_freedom", fit.get("repeatability"))
    if isinstance(stated, dict):  # of each parameter, or of the scatter that all of them come from
        stated = stated.get(name, stated.get("degrees_of_freedom"))
    return float(stated) if isinstance(stated, int | float) and stated > 0 else None


def _joint(first: Calibration, second: Calibration, judged: list[str], changes: Sequence[Change]) -> float | None:
    if any(name not in record.covariance.names for record in (first, second) for name in judged):
        return None
    total = sum(_block(record, judged) for record in (first, second)) - _shared(first, second, judged)
    scale = np.sqrt(np.diag(total))
    vector = np.array([change.difference for change in changes if change.name in judged]) / scale
    values, vectors = np.linalg.eigh(total / np.outer(scale, scale))
    free = values > _SINGULAR * values[-1]
    chi_square = float(((vector @ vectors[:, free]) ** 2 / values[free]).sum())
    return chi_square_probability(chi_square, int(free.sum()))


def _block(record: Calibration, names: list[str]) -> Array:
    index = [record.covariance.names.index(name) for name in names]
    block: Array = record.covariance.array()[np.ix_(index, index)]
    return block


def different_units(*named: tuple[str, Mapping[str, str]], keys: Sequence[str] = ("serial",)) -> str | None:
    """Return words for two things that belong to different units; None where all may belong to one.

    ``("a.csv", head)`` and ``("the record", sensor)`` give ``a.csv is of serial 7, the record of 8``. What states no
    serial number, or no element of an array (`keys`), speaks for no unit.
    """
    for key in keys:
        stated = [(name, head[key]) for name, head in named if head.get(key)]
        for name, value in stated[1:]:
            if value != stated[0][1]:
                return f"{stated[0][0]} is of {key} {stated[0][1]}, {name} of {value}"
    return None
