"""Biases and noise of an array at rest, and how uncertain the biases are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from imulab.estimation.allan import AllanCurve
from imulab.estimation.column_noise import ColumnNoise, columns_noise
from imulab.procedures.gyro_array.model import Elements
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.mean_noise import mean_uncertainties

_CANDIDATES = ("N", "NK", "NB", "NG", "NBK")
"""Models of the noise: a stretch at rest is too short to tell more."""


@dataclass(frozen=True)
class AtRest:
    """What the recording at rest says: biases, their uncertainties, curves and noise per axis and element; rad/s."""

    bias: Array
    curves: tuple[tuple[AllanCurve, ...], ...]
    noise: tuple[tuple[ColumnNoise, ...], ...]
    white: Array
    uncertainty: Array
    duration: float
    rate: float


def at_rest(
    readings: Array, rate: float, elements: Elements, record: Calibration | None, head: Mapping[str, str]
) -> tuple[AtRest, list[str]]:
    """Return what readings at rest say, shape (m, axes, n), rad/s, at a rate, Hz, and what there is to say of `record`.

    Raises
    ------
    RecordError
        The noise record is none, or lacks an element.
    """
    n, duration = elements.count, len(readings) / rate
    columns = [readings[:, a, i] for a in range(len(elements.axes)) for i in range(n)]
    each = columns_noise(columns, rate, candidates=_CANDIDATES)
    notes: list[str] = []
    if record is None:
        spread = np.array([one.mean_uncertainty(duration) for one in each])
    else:
        names = [name for row in elements.names for name in row]
        spread, notes = mean_uncertainties(record, names, duration, "rad/s", head)
    noise = tuple(tuple(each[k : k + n]) for k in range(0, len(each), n))
    curves = tuple(tuple(one.curve for one in row) for row in noise)
    white = np.array([[curve.deviation[0] for curve in row] for row in curves])
    spread = spread.reshape(len(elements.axes), n)
    return AtRest(readings.mean(axis=0), curves, noise, white, spread, duration, rate), notes


def unseen(noises: Mapping[str, ColumnNoise], rest: AtRest) -> list[str]:
    """Return by how much noise that is slower than a stretch shows could raise the uncertainties of the biases."""
    most = max((each.unseen(rest.duration) for each in noises.values()), default=1.0)
    if most == 1:
        return []
    largest = math.degrees(float(rest.uncertainty.max())) * 3600
    return [
        f"the uncertainties of the biases, up to {largest:.3g} deg/h, hold the noise that {rest.duration:.4g} s show; "
        f"slower noise, which so short a stretch cannot show, could make them up to {most:.2g} times as large "
        "(--noise RECORD: the noise of a longer log)"
    ]
