"""What a straight line leaves of a gyroscope's output over the rate: nonlinearity, asymmetry and hysteresis.

All are fractions of the largest rate or of the scale factor, so that the uncertainty that all rates share drops out.
Terms: IEEE Std 528; definitions in docs/rate.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.least_squares import chi_square_probability, coverage_factor
from imulab.procedures.rate.solve import Problem
from imulab.recording import Array

_EXACT = 1e-10
_CHANCE = 0.01
_ONE_SIDED = 1.645
_SMALL = 1e-3
_BY_PARTS = 15
"""Degrees of freedom of what the parts of a sweep say of its delay: half of them, since frequencies differ."""
_RATES, _POWERS, _SURE = 7, 5, 3.29
"""Different rates that tell a kink from powers of the rate, such powers, and standard uncertainties of 1 in 1000."""


@dataclass(frozen=True)
class Linearity:
    """Of one gyroscope; fractions, with standard uncertainties.

    Attributes
    ----------
    rate, residual, uncertainty
        Of each dwell about its axis: rad/s, and what is left of the line, a fraction of the largest rate, shape (n,).
    direction
        1 where the rate was rising, -1 where it was falling, 0 at turning points, shape (n,).
    nonlinearity, hysteresis
        Largest of several, and the standard uncertainty of that one; the largest itself is never 0, nor normal.
    asymmetry
        Value and standard uncertainty.
    probability
        That noise alone leaves as much of the line.
    by_noise
        What the largest residual stays below with 95 % by noise alone.
    loop
        Probability that noise alone makes the loop between rising and falling rates; None where no rate was visited
        both ways.
    fitted_loop
        Rising less falling at rate 0 by all rates, the loop as ``1 - (w/w_max)^2``, and its standard uncertainty.
    repeatability
        Standard deviation of the scale factor over runs, and what noise makes of it; None with one run.
    threshold
        Least rate that shows, and its standard uncertainty by the rates below it, rad/s; None without small rates.
    by_polynomial
        Largest residual of the powers of the rate that were taken.
    kink
        By how much the slopes of positive and negative rates differ beside five powers of the rate, where noise alone
        does that less than once in a thousand tests; else None.
    """

    rate: Array
    residual: Array
    uncertainty: Array
    direction: NDArray[np.int64]
    nonlinearity: tuple[float, float]
    asymmetry: tuple[float, float] | None
    hysteresis: tuple[float, float] | None
    probability: float
    by_noise: float
    loop: float | None
    fitted_loop: tuple[float, float] | None
    repeatability: tuple[float, float] | None
    threshold: tuple[float, float] | None
    by_polynomial: float
    kink: float | None


def linearity_of(problem: Problem, gyro: int, scale: float, order: int) -> Linearity:
    """Return what a line, and powers up to `order`, leave of gyroscope number `gyro` over the rates about its axis."""
    own = problem.axis == problem.gyros[gyro]
    rate, runs = problem.rate[own], problem.run[own]
    values = problem.mean[own, gyro] / scale
    variance = problem.variance[own, gyro] / scale**2 + (_EXACT * np.abs(rate).max()) ** 2
    key = np.unique(np.round(problem.table[own] * problem.sign[own], 6), return_inverse=True)[1]
    of_rate = problem.rate_uncertainty[own] ** 2
    zeros = (runs[:, None] == np.unique(runs)).astype(np.float64)
    largest = max(float(np.abs(rate).max()), 0.0 if problem.reach is None else float(problem.reach[own].max()))
    left, _ = _fitted(np.column_stack([rate, zeros]), values, variance)
    means = np.array(
        [
            [left[key == k].mean(), variance[key == k].sum() / (key == k).sum() ** 2 + of_rate[key == k].mean()]
            for k in np.unique(key)
        ]
    )
    spread = np.sqrt(means[:, 1])
    worst = int(np.argmax(np.abs(means[:, 0])))
    freedom = len(means) - 2
    chi_square = float(np.sum((means[:, 0] / spread) ** 2))
    probability = chi_square_probability(chi_square, freedom) if freedom > 0 else 1.0
    reach = coverage_factor(None, 1 - 0.05 / len(means))
    branch = np.zeros(len(rate), dtype=np.int64) if problem.branch is None else problem.branch[own] * problem.sign[own]
    direction = np.where(branch != 0, branch, _directions(rate, runs))
    powers = np.column_stack([*(rate**power for power in range(1, order + 1)), zeros])
    rest = _fitted(powers, values, variance)[0]
    beyond = _beyond_noise(key, direction, zeros, values, variance)
    error = np.zeros(len(rate)) if problem.loop_error is None else problem.loop_error[own]
    loop, fitted_loop, hysteresis = _hysteresis(
        left / largest, variance / largest**2, key, runs, direction, rate / largest, error, beyond
    )
    return Linearity(
        rate=rate,
        residual=left / largest,
        uncertainty=np.sqrt(variance) / largest,
        direction=direction,
        nonlinearity=(float(abs(means[worst, 0])) / largest, float(spread[worst]) / largest),
        asymmetry=_asymmetry(rate, values, variance, zeros, direction, of_rate),
        hysteresis=hysteresis,
        probability=probability,
        by_noise=reach * float(spread.max()) / largest,
        loop=loop,
        fitted_loop=fitted_loop,
        repeatability=_repeatability(rate, values, variance, runs),
        threshold=_threshold(rate, problem.table[own], left, variance, key),
        by_polynomial=max(abs(float(rest[key == k].mean())) for k in np.unique(key)) / largest,
        kink=_kink(rate / largest, values / largest, (variance + of_rate) / largest**2, zeros, len(means)),
    )


def _fitted(columns: Array, values: Array, variance: Array) -> tuple[Array, Array]:
    """Return what is left of a weighted fit, and its coefficients with their covariance, shape (p, p + 1)."""
    weight, size = 1 / np.sqrt(variance), np.abs(columns).max(axis=0)
    scaled = columns / size * weight[:, None]
    inverse = np.linalg.pinv(scaled)
    found = inverse @ (values * weight) / size
    return values - columns @ found, np.column_stack([found, inverse @ inverse.T / np.outer(size, size)])


def _directions(rate: Array, runs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return whether the rate rose (1) or fell (-1) into and out of each dwell, 0 elsewhere."""
    found = np.zeros(len(rate), dtype=np.int64)
    for run in np.unique(runs):
        which = np.flatnonzero(runs == run)
        step = np.sign(np.round(np.diff(rate[which]), 6))
        inner = np.where(step[:-1] == step[1:], step[1:], 0.0)
        found[which[1:-1]] = inner.astype(np.int64)
    return found


def _asymmetry(
    rate: Array, values: Array, variance: Array, zeros: Array, direction: NDArray[np.int64], of_rate: Array
) -> tuple[float, float] | None:
    """Return (S+ - S-)/S by two slopes and one zero, beside the loop of hysteresis; None for rates of one sign."""
    if not (rate > 0).any() or not (rate < 0).any():
        return None
    columns = [np.maximum(rate, 0), np.minimum(rate, 0), zeros]
    first = np.concatenate([[True], (zeros[1:] != zeros[:-1]).any(axis=1)])
    came = np.where(first, 0.0, np.sign(np.round(np.diff(rate, prepend=0.0), 6)))
    if direction.any():  # the branch of a loop that the first dwell of a run is on is not known
        columns += [came * (1 - (rate / np.abs(rate).max()) ** 2), first.astype(np.float64)]
    found = _fitted(np.column_stack(columns), values, variance + of_rate)[1]
    u = np.sqrt(max(found[0, 1] + found[1, 2] - 2 * found[0, 2], 0.0))
    return float(found[0, 0] - found[1, 0]), float(u)


def _kink(rate: Array, values: Array, variance: Array, zeros: Array, count: int) -> float | None:
    """Return the difference of slopes beside powers of the rate, all over the largest, where it is significant."""
    if count < _RATES:
        return None
    powers = range(1, min(_POWERS, count - 3) + 1)
    columns = np.column_stack([np.abs(rate), *(rate**power for power in powers), zeros])
    left, found = _fitted(columns, values, variance)
    freedom = len(values) - np.linalg.matrix_rank(columns)
    beyond = max(float(np.sum(left**2 / variance)) / freedom, 1.0) if freedom > 0 else 1.0
    return 2 * float(found[0, 0]) if abs(found[0, 0]) > _SURE * np.sqrt(found[0, 1] * beyond) else None


def _beyond_noise(
    key: NDArray[Any], direction: NDArray[np.int64], zeros: Array, values: Array, variance: Array
) -> tuple[float, int] | None:
    """Return chi-square and degrees of freedom of visits of one rate from one side, where they scatter beyond noise."""
    cells = np.unique(3 * key + direction, return_inverse=True)[1]
    columns = np.column_stack([cells[:, None] == np.arange(cells.max() + 1), zeros]).astype(np.float64)
    freedom = len(values) - int(np.linalg.matrix_rank(columns))
    chi_square = float(np.sum(_fitted(columns, values, variance)[0] ** 2 / variance))
    return (chi_square, freedom) if freedom and chi_square_probability(chi_square, freedom) < _CHANCE else None


def _hysteresis(
    left: Array,
    variance: Array,
    key: NDArray[Any],
    runs: NDArray[Any],
    direction: NDArray[np.int64],
    rate: Array,
    error: Array,
    beyond: tuple[float, int] | None,
) -> tuple[float | None, tuple[float, float] | None, tuple[float, float] | None]:
    """Return the probability of a loop by noise, that loop, and the largest rising less falling, over the largest rate.

    `error` is what not knowing the delay of a sweep adds to a loop at rate 0, infinite where it tells no loop.
    """
    from imulab.estimation.special import ndtr, stdtr

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
    found = [2 * float(stdtr(_BY_PARTS, -t) if table[:, 3].any() else ndtr(-t))]
    freedom, wide = len(rows) - 1, [1.0]
    if chi_square_probability(chi_square, freedom) < _CHANCE:  # the loop has another shape, or dwells scatter more
        wide.append(chi_square / freedom)
        found.append(2 * float(stdtr(freedom, -t / np.sqrt(wide[-1]))))
    if beyond:
        wide.append(beyond[0] / beyond[1])
        found.append(2 * float(stdtr(beyond[1], -t / np.sqrt(wide[-1]))))
    return max(found), (slope, float(np.sqrt(max(wide) / spread + table[:, 3].max()))), size


def _repeatability(rate: Array, values: Array, variance: Array, runs: NDArray[np.int64]) -> tuple[float, float] | None:
    """Return the standard deviation of the scale factor over runs, relative, and that which noise makes."""
    found = []
    for run in np.unique(runs):
        which = runs == run
        if which.sum() > 2:
            columns = np.column_stack([rate[which], np.ones(int(which.sum()))])
            found.append(_fitted(columns, values[which], variance[which])[1][0, :2])
    if len(found) < 2:
        return None
    table = np.array(found)
    return float(table[:, 0].std(ddof=1)), float(np.sqrt(table[:, 1].mean()))


def _threshold(
    rate: Array, table: Array, left: Array, variance: Array, key: NDArray[Any]
) -> tuple[float, float] | None:
    """Return the least rate from which on the output exceeds half of what the line says, by 95 %, and its uncertainty.

    None where no rate of the table is below a thousandth of the largest and all of them show.
    """
    zero = 1 / float(np.sum(1 / variance))
    rows = []
    for k in np.unique(key[np.abs(table) > 1e-9 * np.abs(table).max()]):
        which = key == k
        size = abs(float(rate[which].mean()))
        response = float(np.sign(rate[which].mean()) * (rate + left)[which].mean())
        u = np.sqrt(variance[which].sum() / which.sum() ** 2 + zero)
        rows.append((size, response - _ONE_SIDED * u > size / 2))
    rows.sort()
    sizes, shows = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    if not shows[-1] or (shows.all() and sizes[0] > _SMALL * sizes[-1]):
        return None
    first = int(np.max(np.flatnonzero(~shows) + 1, initial=0))
    below = float(sizes[first - 1]) if first else 0.0
    return float(sizes[first]), float(sizes[first] - below) / np.sqrt(12)
