"""The uncertainty of means at rest as measures of a bias, from a noise record of the same sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np

from imulab.errors import RecordError, listed
from imulab.estimation.noise.terms import bias_square
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.comparison import different_units
from imulab.records.sections import Above0, Part, Size, part

_TIMES_THE_REST = 4.0
"""Part of the record that a mean may last: 93 to 99 % of such means are within twice their uncertainty."""


class _Values(Part):
    value: list[float]


class _Bias(Part):
    time: _Values
    standard_uncertainty: _Values


class _Candidate(Part):
    weight: Size
    values: Annotated[list[Size], 8]


class _Column(Part):
    unit: str
    interval: Above0
    length: Above0
    candidates: list[_Candidate]


class _Fit(Part):
    bias_uncertainty: dict[str, _Bias]
    columns: dict[str, _Column]


def mean_uncertainties(
    record: Calibration, columns: Sequence[str], duration: float, unit: str, head: Mapping[str, str]
) -> tuple[Array, list[str]]:
    """Return the standard uncertainty of each column's mean over a duration, shape (k,), and notes.

    ``u^2`` of `bias_square`, averaged over the candidate models by their weights, times what the uncertainty of their
    parameters adds, as the record states it at 1, 10, 100 s ...

    Parameters
    ----------
    record
        Of `fit_noise`.
    columns
        Their names.
    duration
        At rest, s.
    unit
        SI unit that their noise must have.
    head
        The head of the recording, whose ``serial`` is held against that of the record.

    Raises
    ------
    RecordError
        The record is of something else, lacks a column, or has it in another unit.
    """
    if "bias_uncertainty" not in record.fit:
        raise RecordError(f"noise: expected a record of imulab noise fit, found a {record.procedure} record")
    fit = part(record, _Fit, "fit")
    uncertainties = []
    for name in columns:
        if name not in fit.columns:
            raise RecordError(f"noise: the record has no column {name}; its columns: {listed(fit.columns, name)}")
        column, stated = fit.columns[name], fit.bias_uncertainty[name]
        if column.unit != unit:
            raise RecordError(f"noise: column {name} of the record is in {column.unit}; expected {unit}")
        time = np.array(stated.time.value)
        weights = np.array([each.weight for each in column.candidates])
        models = np.array([each.values for each in column.candidates])
        square = weights @ bias_square(models, np.append(time, duration), column.interval.value) / weights.sum()
        more = np.array(stated.standard_uncertainty.value) ** 2 / square[:-1]
        uncertainties.append(np.sqrt(square[-1] * np.interp(np.log(duration), np.log(time), more)))
    notes = []
    shortest = min(fit.columns[name].length.value for name in columns)
    if shortest < _TIMES_THE_REST * duration:
        notes.append(
            f"noise: the record is of {shortest:.4g} s, and noise that is slower does not show in it; expected "
            f"{_TIMES_THE_REST:g} times the {duration:.4g} s at rest, better 10 times"
        )
    if other := different_units(("the record", record.sensor), ("the recording", head)):
        notes.append(f"noise: {other}")
    return np.array(uncertainties), notes
