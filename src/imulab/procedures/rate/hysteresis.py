"""Hysteresis of a gyroscope: how far rising and falling rates differ, apart from what drifts, walks and scatters.

Dwells of steps (`fit_loop`): the output is ``value of the rate + zero of the run + a t + h d g(x)``, x the rate over
the largest, t the time within the run, d = 1 where the rate was reached from below, -1 from above, and g the width of
one of three loops: ``1 - x^2``, that of play, a narrow one. The covariance is the noise, a scatter of each dwell, a
zero that walks, ``K^2 min(t, t')``, and a scale factor that drifts, ``c t x``. Their variances are not known: h is the
mean over a grid of them and over the loops, weighted by restricted likelihood. So the loop is never part of the
scatter it is held against, and what walks or drifts is not taken for a loop.

Means by rate of sweeps (`fit_hysteresis`): rising less falling at each rate.

Sources: Patterson and Thompson, Biometrika 58 (1971) 545, restricted likelihood; IEEE Std 528 (terms).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.decisions import DWELLS_SCATTER, HYSTERESIS_SCATTERS
from imulab.estimation.distributions import normal_cdf, t_cdf
from imulab.estimation.least_squares import chi_square_probability, f_test
from imulab.recording import Array

_BY_PARTS = 15
"""Degrees of freedom of a delay by the batches of a sweep: half their number, since each has other frequencies."""
_NONE = 0.8  # probability beforehand that dwells do not scatter, nor zeros walk, nor a scale factor drift, each
_LEAST, _GRID, _COARSE, _MANY = 0.3, 5, 2, 150
"""Least variance of scatter, walk and drift over that of noise, and number of variances, fewer from so many dwells."""
_DRIFTS = 0.1  # of chi-square without drift: where less is left, the dwells scatter since they drift
_SHAPES: tuple[Callable[[Array], Array], ...] = (
    lambda x: 1 - x**2,
    lambda x: np.where(x < 1 - 1e-9, 1.0, 0.0),
    lambda x: np.maximum(1 - x, 0.0) ** 3,
)
"""Width of a loop over that at rate 0, by the rate over the largest: of an ellipse, of play, and a narrow one."""


def fit_weighted(columns: Array, values: Array, variance: Array) -> tuple[Array, Array]:
    """Return the residual of a weighted fit, and its coefficients with their covariance, shape (p, p + 1)."""
    weight, size = 1 / np.sqrt(variance), np.abs(columns).max(axis=0)
    size = np.where(size > 0, size, 1.0)  # that of a run without dwells here is 0
    scaled = columns / size * weight[:, None]
    inverse = np.linalg.pinv(scaled)
    coefficients = inverse @ (values * weight) / size
    return values - columns @ coefficients, np.column_stack([coefficients, inverse @ inverse.T / np.outer(size, size)])


def fit_drift(
    rate: Array, values: Array, variance: Array, runs: NDArray[Any], time: Array, powers: Array
) -> tuple[Array, float, float] | None:
    """Return what a line over time in each run adds to the outputs, and the changes of slope and zero over a run.

    The zero and the slope over the rate change by ``a t`` and ``c t``, t the time from the middle of the run. None
    where that leaves more than a tenth of what `powers` of the rate and zeros of the runs leave, or chance may do it.

    Parameters
    ----------
    rate, values, variance, runs, time
        As for `fit_loop`, but rates and outputs in rad/s, shape (n,).
    powers
        Columns of the model without drift, shape (n, k).
    """
    which = (runs[:, None] == np.unique(runs)).astype(np.float64)
    within = time - which @ ((time @ which) / which.sum(axis=0))
    lines = np.column_stack([which * within[:, None], which * (within * rate)[:, None]])
    before = float(np.sum(fit_weighted(powers, values, variance)[0] ** 2 / variance))
    left, fitted = fit_weighted(np.column_stack([powers, lines]), values, variance)
    after, freedom = float(np.sum(left**2 / variance)), len(rate) - powers.shape[1] - lines.shape[1]
    if freedom < 1 or after > _DRIFTS * before or chi_square_probability(before, freedom) > DWELLS_SCATTER.level:
        return None
    size = powers.shape[1]
    if f_test(before, size, after, size + lines.shape[1], len(rate)) > DWELLS_SCATTER.level:
        return None
    slopes = fitted[size:, 0]
    lasts = np.array([np.ptp(time[runs == run]) for run in np.unique(runs)])
    zero, scale = (lasts * part for part in np.split(slopes, 2))
    return lines @ slopes, float(np.sqrt(np.mean(scale**2))), float(np.sqrt(np.mean(zero**2)))


def find_directions(rate: Array, runs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return whether the rate rose (1) or fell (-1) into and out of each dwell, 0 elsewhere."""
    directions = np.zeros(len(rate), dtype=np.int64)
    for run in np.unique(runs):
        which = np.flatnonzero(runs == run)
        step = np.sign(np.round(np.diff(rate[which]), 6))
        inner = np.where(step[:-1] == step[1:], step[1:], 0.0)
        directions[which[1:-1]] = inner.astype(np.int64)
    return directions


def fit_loop(
    rate: Array,
    values: Array,
    variance: Array,
    key: NDArray[Any],
    runs: NDArray[Any],
    time: Array,
    direction: NDArray[np.int64],
    walk: float = 0.0,
) -> tuple[float, tuple[float, float]] | None:
    """Return the probability that noise alone makes such a loop, and h and its standard uncertainty; None without one.

    Parameters
    ----------
    rate
        Rate of each of n dwells over the largest, shape (n,).
    values, variance
        Outputs over scale factor and largest rate, and the variances of their noise, shape (n,).
    key, runs, time, direction
        Which rate and run; middle of the dwell, s; and `find_directions`, shape (n,).
    walk
        Variance per second by which the zero walks at least, as dwells about other axes show it.
    """
    apart = (direction == 0) & (np.abs(rate) < 1 - 1e-9)  # dwells on a branch that is not known
    beside = np.column_stack([key[:, None] == np.unique(key), np.eye(len(rate))[:, apart]]).astype(np.float64)
    shapes = np.column_stack([direction * shape(np.abs(rate)) for shape in _SHAPES])
    noise = np.diag(variance) - walk / 2 * np.abs(time[:, None] - time) * (runs[:, None] == runs)
    fitted = _fit_shapes(shapes, beside, rate, values, noise, runs, time)
    return None if fitted is None else (fitted[2], (2 * fitted[0], 2 * fitted[1]))


def test_bend(
    rate: Array,
    values: Array,
    variance: Array,
    of_rate: Array,
    key: NDArray[Any],
    runs: NDArray[Any],
    time: Array,
    order: int,
) -> float:
    """Return the probability that noise, scatter, walk and drift alone make the next two powers beyond `order`.

    Parameters are those of `fit_loop`; `of_rate` is the variance that all visits of a rate share, shape (n,).
    """
    powers = range(1, min(order + 2, len(np.unique(key)) - 1) + 1)
    columns = np.column_stack([rate**power for power in powers])
    noise = np.diag(variance) + (key[:, None] == key) * np.sqrt(np.outer(of_rate, of_rate))
    fitted = (
        _fit_shapes(columns[:, order:], columns[:, :order], rate, values, noise, runs, time)
        if len(powers) > order
        else None
    )
    return 1.0 if fitted is None else fitted[2]


def _fit_shapes(
    shapes: Array, beside: Array, rate: Array, values: Array, noise: Array, runs: NDArray[Any], time: Array
) -> tuple[float, float, float] | None:
    """Return coefficient of the shapes, its uncertainty, and the probability that noise makes it; None if not visible.

    Columns `beside` them, and a zero and a linear drift of it in each run, are taken off first. Models are averaged.
    """
    number, which = np.unique(runs, return_inverse=True)
    within = time - np.array([time[runs == run].min() for run in number])[which]
    of_run = np.eye(len(number))[which]
    nuisance = np.column_stack([beside, of_run, of_run * within[:, None]])
    free = null_space((nuisance / np.maximum(np.abs(nuisance).max(axis=0), 1e-300)).T)
    shapes = free.T @ shapes
    if free.shape[1] < 2 or not (np.sum(shapes**2, axis=0) > 1e-9).all():
        return None
    walk = np.where(which[:, None] == which, np.minimum(within[:, None], within), 0.0)
    parts = [np.eye(len(rate)), walk, np.outer(within * rate, within * rate)]
    noise, *parts = (free.T @ part @ free for part in (noise, *parts))
    return _average_models(noise, parts, shapes, free.T @ values, _GRID if len(rate) < _MANY else _COARSE)


def _average_models(
    noise: Array, parts: list[Array], shapes: Array, values: Array, number: int
) -> tuple[float, float, float]:
    """Return mean and standard uncertainty of the coefficient of shapes, and the probability that noise makes it.

    The covariance is that of the noise and each of three parts in one of `number` sizes, or not at all.
    """
    usual = float(np.trace(noise))
    most = max(100.0, 3 * float(values @ values) / usual)
    ladder = np.append(0.0, np.geomspace(_LEAST, most, number))
    before = np.log(np.append(_NONE, np.full(number, (1 - _NONE) / number)))
    places = np.array(list(product(range(number + 1), repeat=3)))
    scaled = np.array([usual / max(float(np.trace(part)), 1e-300) * part for part in parts])
    value, u, likelihood = _fit_each(noise + np.tensordot(ladder[places], scaled, 1), shapes, values)
    logs = likelihood + before[places].sum(axis=1)[:, None]
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    mean = float((weight * value).sum())
    spread = float(np.sqrt((weight * (u**2 + (value - mean) ** 2)).sum()))
    return mean, spread, 2 * float((weight * normal_cdf(-np.abs(value) / u)).sum())


def null_space(rows: Array) -> Array:
    """Return an orthonormal basis of the vectors that all rows are normal to, shape (n, k)."""
    _, spread, turn = np.linalg.svd(rows)
    rank = int(np.sum(spread > 1e-9 * spread[0]))
    return np.asarray(turn[rank:].T)


def _fit_each(covariances: Array, shapes: Array, values: Array) -> tuple[Array, Array, Array]:
    """Return the coefficient of each shape alone, its standard uncertainty, and the log restricted likelihood.

    For m covariances, shape (m, n, n), and k shapes, shape (n, k): three arrays of shape (m, k).
    """
    lower = np.linalg.cholesky(covariances)
    white = np.linalg.solve(lower, np.column_stack([shapes, values]))
    columns, output = white[:, :, :-1], white[:, :, -1]
    square = np.sum(columns**2, axis=1)
    value = np.einsum("mn,mns->ms", output, columns) / square
    left = np.sum(output**2, axis=1)[:, None] - value**2 * square
    roots = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
    return value, 1 / np.sqrt(square), -roots[:, None] - np.log(square) / 2 - left / 2


def test_one_rate(rate: Array, table: Array, values: Array, variance: Array, zeros: Array, worst: int) -> float:
    """Return the probability that by chance the rate of dwell `worst` stands apart, as the others scatter (F-test).

    A rate that is listed wrong stands apart from the line, either way round; a drift or slow noise scatters all dwells.
    """
    size = np.round(np.abs(table), 6)
    there = size == size[worst]
    ways = [way for way in (there & (rate >= 0), there & (rate < 0)) if way.any()]
    line = np.column_stack([rate, zeros])
    whole = np.column_stack([line, *ways])
    before, after = (float(np.sum(fit_weighted(c, values, variance)[0] ** 2 / variance)) for c in (line, whole))
    return min(len(np.unique(size)) * f_test(before, line.shape[1], after, whole.shape[1], len(rate)), 1.0)


def test_visits(
    key: NDArray[Any], direction: NDArray[np.int64], zeros: Array, values: Array, variance: Array
) -> tuple[float, int] | None:
    """Return chi-square and degrees of freedom of visits of one rate from one side; None where noise explains them.

    Dwells whose branch is not known are left out: a loop itself makes these scatter.
    """
    known = direction != 0
    if not known.any():
        return None
    cells = np.unique(3 * key[known] + direction[known], return_inverse=True)[1]
    columns = np.column_stack([cells[:, None] == np.arange(cells.max() + 1), zeros[known]]).astype(np.float64)
    freedom = int(known.sum()) - int(np.linalg.matrix_rank(columns))
    chi_square = float(np.sum(fit_weighted(columns, values[known], variance[known])[0] ** 2 / variance[known]))
    return (
        (chi_square, freedom)
        if freedom and chi_square_probability(chi_square, freedom) < HYSTERESIS_SCATTERS.level
        else None
    )


def fit_hysteresis(
    left: Array,
    variance: Array,
    key: NDArray[Any],
    runs: NDArray[Any],
    direction: NDArray[np.int64],
    rate: Array,
    error: Array,
    beyond: tuple[float, int] | None,
) -> tuple[float | None, tuple[float, float] | None, tuple[float, float] | None]:
    """Return `Linearity.loop`, `fitted_loop` and `hysteresis`, all over the largest rate.

    The loop ``h (1 - (w/w_max)^2)`` is fitted to rising less falling at each rate by weighted least squares. `error` is
    the standard uncertainty of h by the delay of a sweep, infinite where the two cannot be distinguished.
    """
    rows = []
    for k in np.unique(key):
        pairs = []
        for run in np.unique(runs):
            up, down = (np.flatnonzero((key == k) & (runs == run) & (direction == d)) for d in (1, -1))
            if up.size and down.size and np.isfinite(error[up[0]]):
                u2 = variance[up].sum() / up.size**2 + variance[down].sum() / down.size**2
                pairs.append((float(left[up].mean() - left[down].mean()), float(u2), float(error[up[0]]) ** 2))
        if pairs:
            means = np.array(pairs).mean(axis=0)
            rows.append((float(rate[key == k].mean()), means[0], *(means[1:] / len(pairs))))
    if not rows:
        return None, None, None
    table = np.array(rows)
    worst = int(np.argmax(np.abs(table[:, 1])))
    loop = 1 - table[:, 0] ** 2
    size = float(table[worst, 1]), float(np.sqrt(table[worst, 2] + table[worst, 3] * loop[worst] ** 2))
    spread = float(np.sum(loop**2 / table[:, 2]))
    if len(rows) < 2 or spread <= 0:
        return None, None, size
    slope = float(np.sum(loop * table[:, 1] / table[:, 2])) / spread
    chi_square = float(np.sum((table[:, 1] - slope * loop) ** 2 / table[:, 2]))
    t = float(abs(slope) / np.sqrt(1 / spread + table[:, 3].max()))
    chances = [2 * float(t_cdf(-t, _BY_PARTS) if table[:, 3].any() else normal_cdf(-t))]
    freedom, wide = len(rows) - 1, [1.0]
    if chi_square_probability(chi_square, freedom) < HYSTERESIS_SCATTERS.level:  # another shape, or dwells scatter more
        wide.append(chi_square / freedom)
        chances.append(2 * float(t_cdf(-t / np.sqrt(wide[-1]), freedom)))
    if beyond:
        wide.append(beyond[0] / beyond[1])
        chances.append(2 * float(t_cdf(-t / np.sqrt(wide[-1]), beyond[1])))
    return max(chances), (slope, float(np.sqrt(max(wide) / spread + table[:, 3].max()))), size
