"""Repeatability: what a power cycle does to the drift beyond noise, and what a run does besides.

A gyroscope that comes back from power-off with another K has it at all levels: such a change does not average out over
levels, and cancels in zeta. The scatter of the runs is split into an effect of the power cycle and the rest, by least
squares with a value for each level and one for each cycle; a variance is added where chi-square passes its 5 % point.

Source: Mandel and Paule, Analytical Chemistry 42 (1970) 1194.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.least_squares import chi_square_limit, excess_variance
from imulab.recording import Array

_LEVEL = 0.05


@dataclass(frozen=True)
class Deviations:
    """What runs of one axis found, relative to the line of their level.

    Attributes
    ----------
    level, cycle
        Labels of each run's level (and sense), and power cycle, shape (n,).
    size, turn
        Relative deviation along the line, and across it, rad, shape (n,).
    size_variance, turn_variance
        By noise and rates, shape (n,).
    """

    level: NDArray[np.int64]
    cycle: NDArray[np.int64]
    size: Array
    turn: Array
    size_variance: Array
    turn_variance: Array


@dataclass(frozen=True)
class Repeatability:
    """Variances beyond the noise, of all axes alike; 0 where noise explains the scatter.

    Attributes
    ----------
    cycle
        Of K from power cycle to power cycle, at all levels alike, relative.
    turn
        Of the direction of the drift, likewise, rad^2.
    run
        Of K from run to run within a power cycle, relative.
    chi_square, freedom
        Of the sizes of the power cycles over their noise.
    run_freedom
        Degrees of freedom of `run`.
    """

    cycle: float = 0.0
    turn: float = 0.0
    run: float = 0.0
    chi_square: float = 0.0
    freedom: int = 0
    run_freedom: int = 0


def find_repeatability(axes: Sequence[Deviations]) -> Repeatability:
    """Return what the scatter of the runs calls for beyond their noise."""
    run, _, run_freedom = _excess([_rest(a, a.size, a.size_variance) for a in axes])
    cycle, chi_square, freedom = _excess([_of_cycles(a, a.size, a.size_variance + run) for a in axes])
    turn, _, _ = _excess([_of_cycles(a, a.turn, a.turn_variance) for a in axes])
    return Repeatability(cycle, turn, run, chi_square, freedom, run_freedom)


_Scatter = tuple[Array, Array, int]
"""Deviations, their variances, and degrees of freedom."""


def _fitted(a: Deviations, values: Array, variance: Array) -> tuple[Array, Array, int]:
    """Values of the cycles (their weighted mean zero), their weights, and rank of the design."""
    levels, cycles = np.unique(a.level), np.unique(a.cycle)
    design = np.concatenate([a.level[:, None] == levels, a.cycle[:, None] == cycles], axis=1).astype(float)
    root = 1 / np.sqrt(np.maximum(variance, 1e-24))
    found, _, rank, _ = np.linalg.lstsq(design * root[:, None], values * root, rcond=1e-9)
    weights: Array = design[:, len(levels) :].T @ root**2
    effect = found[len(levels) :]
    return effect - np.average(effect, weights=weights), weights, int(rank)


def _of_cycles(a: Deviations, values: Array, variance: Array) -> _Scatter:
    if not len(values):
        return np.empty(0), np.empty(0), 0
    effect, weights, rank = _fitted(a, values, variance)
    return effect, 1 / weights, rank - len(np.unique(a.level))


def _rest(a: Deviations, values: Array, variance: Array) -> _Scatter:
    if not len(values):
        return np.empty(0), np.empty(0), 0
    effect, _, rank = _fitted(a, values, variance)
    left = values - effect[np.searchsorted(np.unique(a.cycle), a.cycle)]
    weights = 1 / np.maximum(variance, 1e-24)
    for level in np.unique(a.level):
        mine = a.level == level
        left[mine] -= np.average(left[mine], weights=weights[mine])
    return left, 1 / weights, len(values) - rank


def _excess(parts: Sequence[_Scatter]) -> tuple[float, float, int]:
    """Variance to add, chi-square without it, and degrees of freedom."""
    values, variance = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    freedom = sum(part[2] for part in parts)
    if not freedom:
        return 0.0, 0.0, 0
    chi_square = float((values**2 / variance).sum())
    if chi_square <= chi_square_limit(freedom, _LEVEL):
        return 0.0, chi_square, freedom
    return float(excess_variance(values[None], variance[None], freedom)[0]), chi_square, freedom
