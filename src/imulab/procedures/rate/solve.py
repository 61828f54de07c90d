"""Dwells to bias, scale factor, misalignment and nonlinearity.

The least squares, the choice of the order, and what the scale factors make of the temperature.

M_i = S_i (A_i + b_i),  A_i = s_i + k2_i s_i^2 + ...,  s = T w

Of gyroscope i in run m, whose table axis is body axis j, the means follow ``B_ij w`` plus a zero of that run, and
for j = i the powers of w; ``B = diag(S) T``. The covariance of the means holds their noise, the errors of single rates,
which all visits and all gyroscopes share, the level part of the Earth's rate that the table's turning does not average,
and what scatters beyond that. Source: generalised least squares (Aitken 1935); added variance: Mandel and Paule, Anal.
Chem. 42 (1970) 1194.

What dwells leave of a polynomial is compared rate by rate: an error of one commanded rate is shared by all its visits,
which therefore are no further evidence of a bend. Source: F-test of nested models; leave-one-out prediction.

All are fractions of the largest rate or of the scale factor, so that the uncertainty that all rates share drops out.
Terms: IEEE Std 528; definitions in docs/rate.md.

``M = S (1 + c (t - mean t)) s + ...``: a column ``w (t - mean t)`` beside those of the fit, weighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.decisions import (
    DWELLS_SCATTER,
    HYSTERESIS_SCATTERS,
    RATE_POWER,
    RATES_SCATTER_AS_NOISE,
    RUNS_SCATTER,
    SLOPES_KINK,
)
from imulab.estimation.distributions import normal_cdf, t_cdf
from imulab.estimation.least_squares import chi_square_probability, coverage_factor, f_test
from imulab.gravity import EARTH
from imulab.procedures.rate import AXES
from imulab.procedures.rate.axes import TableAxes
from imulab.procedures.rate.dwells import Dwells
from imulab.procedures.rate.schema import RateTest
from imulab.recording import Array, Recording
from imulab.records.calibration import Parameter
from imulab.units import STANDARD_GRAVITY, parse_unit

# All dwells of a test to bias, scale factor, misalignment and nonlinearity, by generalised least squares.


_HALVINGS = 60  # of a bracket, which ends before at 0.1 %
EXACT = 1e-10  # of the largest reading: noise that data without noise are given
_MOST_POWERS = 5  # of the rate that scatter is judged beside


@dataclass(frozen=True)
class RateProblem:
    """All dwells of a test, n of them, of g gyroscopes.

    Attributes
    ----------
    gyros
        Body axis of each gyroscope, shape (g,).
    run, axis, sign
        Of each dwell: its run, the body axis along the table's, and 1 where that points up, -1 where down, shape (n,).
    rate
        About the body axis, the Earth's included, rad/s, shape (n,).
    table
        Rate of the table as commanded or recorded, rad/s, shape (n,).
    mean, variance
        Of the outputs, shape (n, g).
    level
        Mean cosine and sine of the table's angle, shape (n, 2).
    rate_uncertainty
        Of the commanded rate of each dwell, which all visits of it share, rad/s, shape (n,).
    scale_error
        What each dwell's run adds to its scale factor, which delay and bandwidth share with it, shape (n,).
    zero_error
        What it adds to the zeros of its outputs, shape (n, g).
    loop_error
        What it adds to rising less falling at rate 0, a fraction of the largest rate; infinite where a loop cannot be
        told from a delay, shape (n,).
    reach
        Largest rate of its run, beyond all means by rate, rad/s, shape (n,); 0 for steps.
    branch
        1 where the rate of a sweep rises, -1 where it falls, shape (n,); 0 for steps.
    lean
        Of the table axis: its components over that along the body axis, shape (n, 3); None along the body axis.
    force
        Specific force at rate 0 in each run, m/s^2, shape (m, 3); None for g along the faces.
    """

    gyros: tuple[int, ...]
    run: NDArray[np.int64]
    axis: NDArray[np.int64]
    sign: NDArray[np.int64]
    rate: Array
    table: Array
    mean: Array
    variance: Array
    level: Array
    rate_uncertainty: Array
    scale_error: Array | None = None
    zero_error: Array | None = None
    loop_error: Array | None = None
    reach: Array | None = None
    branch: NDArray[np.int64] | None = None
    lean: Array | None = None
    force: Array | None = None

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.run.max()) + 1

    @property
    def faces(self) -> list[int]:
        """Body axes that the table turned about."""
        return sorted(set(self.axis.tolist()))


@dataclass(frozen=True)
class RateSolution:
    """Coefficients of each gyroscope, in the order of its columns, and their joint covariance.

    Attributes
    ----------
    coefficients
        Gyroscope to slopes over the rates about each face, powers of the rate about its own axis, zeros of the runs.
    covariance
        Of all of them, one gyroscope after the other.
    orders
        Highest power of the rate of each gyroscope.
    scatter
        Standard deviation that was added to each dwell, of each gyroscope, output.
    cycle
        Relative standard deviation of scale factors from run to run of one axis; 0 where noise explains it.
    cycle_freedom
        Runs of one axis beyond the first, summed over the axes; None where `cycle` is 0.
    chi_square, freedom
        Of the model with most powers, before anything was added.
    """

    coefficients: list[Array]
    covariance: Array
    orders: tuple[int, ...]
    scatter: Array
    cycle: float
    cycle_freedom: int | None
    chi_square: float
    freedom: int


def design(problem: RateProblem, gyro: int, order: int) -> Array:
    """Return the columns of gyroscope number `gyro`: slopes by face, powers of its own axis's rate, zeros of runs."""
    on_axis = problem.axis == problem.gyros[gyro]
    if problem.lean is None:
        columns = [np.where(problem.axis == face, problem.rate, 0.0) for face in problem.faces]
    else:
        columns = [problem.rate * problem.lean[:, face] for face in problem.faces]
    if on_axis.any():
        columns += [np.where(on_axis, problem.rate**power, 0.0) for power in range(2, order + 1)]
    columns += [(problem.run == run).astype(np.float64) for run in range(problem.runs)]
    return np.column_stack(columns)


def solve(problem: RateProblem, orders: Sequence[int]) -> RateSolution:
    """Fit all gyroscopes together, each with powers of the rate up to its order."""
    count = len(problem.gyros)
    rates = min(len(np.unique(np.round(problem.rate[problem.axis == face], 9))) for face in problem.faces)
    most = max(*orders, min(_MOST_POWERS, rates - 2))
    slopes = [
        _weighted(design(problem, i, orders[i]), problem.mean[:, i], problem.variance[:, i]) for i in range(count)
    ]
    gains = [estimates[: len(problem.faces)] for estimates in slopes]
    blocks = _shared_blocks(problem, gains)
    variance = problem.variance + (EXACT * np.abs(problem.mean).max()) ** 2
    scatter, chi_square, freedom = np.zeros(count), 0.0, 0
    for i in range(count):
        columns = design(problem, i, most)
        base = np.diag(variance[:, i]) + blocks[i, i]
        scatter[i], axis_chi_square = _scatter(columns, problem.mean[:, i], base)
        chi_square, freedom = chi_square + axis_chi_square, freedom + len(columns) - columns.shape[1]
    variance = variance + scatter**2
    cycle, cycle_freedom = _cycles(problem, most, variance, gains)
    for i in range(count):
        own_rate = np.where(problem.axis == problem.gyros[i], problem.rate * _own(problem, gains, i), 0.0)
        same = problem.run[:, None] == problem.run
        of_run = cycle**2 if problem.scale_error is None else cycle**2 + problem.scale_error**2
        blocks[i, i] = blocks[i, i] + of_run * same * np.outer(own_rate, own_rate) + np.diag(variance[:, i])
        if problem.zero_error is not None:
            blocks[i, i] += same * np.outer(problem.zero_error[:, i], problem.zero_error[:, i])
    whole = np.block([[blocks[i, k] for k in range(count)] for i in range(count)])
    columns = _diagonal([design(problem, i, orders[i]) for i in range(count)])
    estimates, matrix, _ = _general(columns, problem.mean.T.ravel(), whole)
    ends = np.cumsum([0, *(design(problem, i, orders[i]).shape[1] for i in range(count))])
    coefficients = [estimates[a:b] for a, b in pairwise(ends)]
    return RateSolution(coefficients, matrix, tuple(orders), scatter, cycle, cycle_freedom, chi_square, freedom)


def without_lean(problem: RateProblem, gains: Sequence[Array]) -> Array:
    """Return the means of runs about a gyroscope's own axis without what their table's lean adds, shape (n, g)."""
    if problem.lean is None:
        return problem.mean
    means = problem.mean.copy()
    for i, axis in enumerate(problem.gyros):
        on_axis = problem.axis == axis
        for k, face in enumerate(problem.faces):
            if face != axis:
                means[on_axis, i] -= gains[i][k] * problem.rate[on_axis] * problem.lean[on_axis, face]
    return means


def _own(problem: RateProblem, gains: list[Array], gyro: int) -> float:
    """Scale factor of a gyroscope, 0 where the table never turned about its axis."""
    axis = problem.gyros[gyro]
    return float(gains[gyro][problem.faces.index(axis)]) if axis in problem.faces else 0.0


def _shared_blocks(problem: RateProblem, gains: list[Array]) -> dict[tuple[int, int], Array]:
    """Return what the means of two gyroscopes share: errors of single rates, and the Earth's level part."""
    face = np.array([problem.faces.index(axis) for axis in problem.axis.tolist()])
    alike = np.isclose(problem.table[:, None], problem.table, rtol=1e-9, atol=1e-9).astype(np.float64)
    alike *= np.outer(problem.rate_uncertainty, problem.rate_uncertainty)
    same = (problem.run[:, None] == problem.run) * (problem.level @ problem.level.T) * EARTH**2 / 2
    blocks: dict[tuple[int, int], Array] = {}
    for i, first in enumerate(gains):
        for k, second in enumerate(gains):
            felt = np.outer(first[face] * problem.sign, second[face] * problem.sign)
            blocks[i, k] = np.asarray(alike * felt)
        across = (problem.axis != problem.gyros[i]).astype(np.float64) * np.abs(first).max()
        blocks[i, i] = blocks[i, i] + same * np.outer(across, across)
    return blocks


def _weighted(columns: Array, values: Array, variance: Array) -> Array:
    weight = 1 / np.sqrt(variance + (EXACT * np.abs(values).max()) ** 2 + 1e-300)
    size = np.abs(columns).max(axis=0)
    scaled = np.linalg.lstsq(columns / size * weight[:, None], values * weight, rcond=None)[0]
    return np.asarray(scaled / size)


def _general(columns: Array, values: Array, covariance: Array) -> tuple[Array, Array, float]:
    """Return coefficients, their covariance and chi-square of generalised least squares."""
    spread = np.sqrt(np.diag(covariance))
    lower = np.linalg.cholesky(covariance / np.outer(spread, spread))
    size = np.abs(columns).max(axis=0)
    white = np.linalg.solve(lower, np.column_stack([columns / size, values]) / spread[:, None])
    q, r = np.linalg.qr(white[:, :-1])
    estimate = np.linalg.solve(r, q.T @ white[:, -1])
    left = white[:, -1] - white[:, :-1] @ estimate
    inverse = np.linalg.inv(r)
    return estimate / size, inverse @ inverse.T / np.outer(size, size), float(left @ left)


def _scatter(columns: Array, values: Array, base: Array) -> tuple[float, float]:
    """Return the standard deviation to add to each dwell so that chi-square is as expected, and chi-square before."""
    freedom = len(columns) - columns.shape[1]
    chi_square = _general(columns, values, base)[2]
    if freedom < 1 or chi_square_probability(chi_square, freedom) > DWELLS_SCATTER.level:
        return 0.0, chi_square
    high = float(np.diag(base).mean()) * chi_square
    added = _root(lambda x: _general(columns, values, base + x * np.eye(len(base)))[2] - freedom, high)
    return float(np.sqrt(added)), chi_square


def _root(excess: Callable[[float], float], high: float) -> float:
    """Return where a falling function is 0, between 0 and `high`."""
    low = 0.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
        if high - low < 1e-3 * high:
            break
    return high


def _cycles(problem: RateProblem, order: int, variance: Array, gains: list[Array]) -> tuple[float, int | None]:
    """Return by how much scale factors differ from run to run of one axis, relative, all gyroscopes pooled."""
    groups, mean = [], without_lean(problem, gains)
    for i, axis in enumerate(problem.gyros):
        scale = _own(problem, gains, i)
        by_run = []
        for run in sorted(set(problem.run[problem.axis == axis].tolist())):
            which = problem.run == run
            part = RateProblem(
                (axis,), np.zeros(int(which.sum()), dtype=np.int64), problem.axis[which], problem.sign[which],
                problem.rate[which], problem.table[which], mean[which, i : i + 1],
                problem.variance[which, i : i + 1], problem.level[which], np.zeros(int(which.sum())),
            )  # fmt: skip
            columns = design(part, 0, 1)
            if len(columns) > columns.shape[1]:
                estimate, matrix, _ = _general(columns, part.mean[:, 0], np.diag(variance[which, i]))
                by_run.append((estimate[0] / scale, matrix[0, 0] / scale**2))
        if len(by_run) > 1:
            groups.append(np.array(by_run))
    freedom = sum(len(group) - 1 for group in groups)
    if not freedom:
        return 0.0, None

    def chi_square(added: float) -> float:
        total = 0.0
        for group in groups:
            weight = 1 / (group[:, 1] + added)
            total += float(weight @ (group[:, 0] - weight @ group[:, 0] / weight.sum()) ** 2)
        return total

    before = chi_square(0.0)
    if chi_square_probability(before, freedom) > RUNS_SCATTER.level:
        return 0.0, None
    high = max(float(group[:, 1].max()) for group in groups) * before
    return float(np.sqrt(_root(lambda x: chi_square(x) - freedom, high))), freedom


def _diagonal(blocks: list[Array]) -> Array:
    rows, columns = (sum(block.shape[k] for block in blocks) for k in (0, 1))
    joined = np.zeros((rows, columns))
    a = b = 0
    for block in blocks:
        joined[a : a + block.shape[0], b : b + block.shape[1]] = block
        a, b = a + block.shape[0], b + block.shape[1]
    return joined


# Which powers of the rate a gyroscope's output supports: by F-test, and by each rate predicted from the others.


HIGHEST = 5  # power of the rate, as in the C core


def choose_orders(problem: RateProblem) -> tuple[int, ...]:
    """Return the highest power of the rate of each gyroscope that its dwells support; 1 where none was turned about.

    A higher order is taken if its gain is more than noise and the scatter of the rates explain (chi-square and F-test,
    1 %), against the order chosen so far and that below it, and if it predicts each rate from the others better, by
    more than the standard error of that comparison.
    """
    return tuple(_order_of(problem, i) for i in range(len(problem.gyros)))


def _order_of(problem: RateProblem, gyro: int) -> int:
    on_axis = problem.axis == problem.gyros[gyro]
    if not on_axis.any():
        return 1
    key = np.unique(np.round(problem.table[on_axis] * problem.sign[on_axis], 6), return_inverse=True)[1]
    count = int(key.max()) + 1
    zeros = (problem.run[on_axis][:, None] == np.unique(problem.run[on_axis])).astype(np.float64)
    rate = problem.rate[on_axis] / np.abs(problem.rate[on_axis]).max()
    powers = np.column_stack([rate**p for p in range(1, max(min(HIGHEST, count - 2), 1) + 1)])
    values = problem.mean[on_axis, gyro]
    slope = float(np.ptp(values) / max(np.ptp(problem.rate[on_axis]), 1e-300))
    stated = problem.rate_uncertainty[on_axis] * slope
    of_rate = np.outer(stated, stated) * (key[:, None] == key)
    noise = problem.variance[on_axis, gyro] + (EXACT * np.abs(values).max()) ** 2
    lower = np.linalg.cholesky(np.diag(noise) + of_rate)
    visits = (key[:, None] == np.arange(count)).astype(np.float64)

    def cost(columns: Array) -> float:
        white = np.linalg.solve(lower, np.column_stack([columns, values]))
        left = white[:, -1] - white[:, :-1] @ np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
        return float(left @ left)

    def predicted(columns: Array) -> Array:
        white = np.linalg.solve(lower, np.column_stack([columns, values]))
        errors = []
        for k in range(count):
            rest, which = key != k, key == k
            fit = np.linalg.lstsq(white[rest, :-1], white[rest, -1], rcond=None)[0]
            spread = noise[which].sum() / which.sum() ** 2 + of_rate[which, which][0]
            errors.append(float((values[which] - columns[which] @ fit).mean() ** 2 / spread))
        return np.array(errors)

    within = cost(np.column_stack([zeros, visits]))
    models = {p: np.column_stack([powers[:, :p], zeros]) for p in range(1, powers.shape[1] + 1)}
    costs = {p: max(cost(columns) - within, 0.0) for p, columns in models.items()}
    chosen, best = 1, predicted(models[1])
    for order in range(2, len(models) + 1):
        if not all(_significant(costs, below, order, count) for below in {chosen, order - 1}):
            continue
        squares = predicted(models[order])
        gain = best - squares
        if gain.mean() > gain.std(ddof=1) / np.sqrt(count):
            chosen, best = order, squares
    return chosen


def _significant(costs: Mapping[int, float], below: int, order: int, count: int) -> bool:
    by_noise = chi_square_probability(costs[below] - costs[order], order - below)
    if chi_square_probability(costs[order], count - order - 1) > RATES_SCATTER_AS_NOISE.level:
        return by_noise < RATE_POWER.level
    return max(by_noise, f_test(costs[below], below + 1, costs[order], order + 1, count)) < RATE_POWER.level


# What a straight line leaves of a gyroscope's output over the rate: nonlinearity, asymmetry and hysteresis.


_ONE_SIDED = 1.645  # standard uncertainties: 95 % of normal values lie below
_SMALL = 1e-3  # of the largest rate: if smaller ones all show, the threshold is below them
_BY_PARTS = 15
"""Degrees of freedom of what the parts of a sweep say of its delay: half of them, since frequencies differ."""
_RATES, _POWERS = 7, 5
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


def linearity_of(problem: RateProblem, gyro: int, scale: float, order: int) -> Linearity:
    """Return what a line, and powers up to `order`, leave of gyroscope number `gyro` over the rates about its axis."""
    on_axis = problem.axis == problem.gyros[gyro]
    rate, runs = problem.rate[on_axis], problem.run[on_axis]
    values = problem.mean[on_axis, gyro] / scale
    variance = problem.variance[on_axis, gyro] / scale**2 + (EXACT * np.abs(rate).max()) ** 2
    key = np.unique(np.round(problem.table[on_axis] * problem.sign[on_axis], 6), return_inverse=True)[1]
    of_rate = problem.rate_uncertainty[on_axis] ** 2
    zeros = (runs[:, None] == np.unique(runs)).astype(np.float64)
    largest = max(float(np.abs(rate).max()), 0.0 if problem.reach is None else float(problem.reach[on_axis].max()))
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
    branch = (
        np.zeros(len(rate), dtype=np.int64)
        if problem.branch is None
        else problem.branch[on_axis] * problem.sign[on_axis]
    )
    direction = np.where(branch != 0, branch, _directions(rate, runs))
    powers = np.column_stack([*(rate**power for power in range(1, order + 1)), zeros])
    rest = _fitted(powers, values, variance)[0]
    beyond = _beyond_noise(key, direction, zeros, values, variance)
    error = np.zeros(len(rate)) if problem.loop_error is None else problem.loop_error[on_axis]
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
        threshold=_threshold(rate, problem.table[on_axis], left, variance, key),
        by_polynomial=max(abs(float(rest[key == k].mean())) for k in np.unique(key)) / largest,
        kink=_kink(rate / largest, values / largest, (variance + of_rate) / largest**2, zeros, len(means)),
    )


def _fitted(columns: Array, values: Array, variance: Array) -> tuple[Array, Array]:
    """Return what is left of a weighted fit, and its coefficients with their covariance, shape (p, p + 1)."""
    weight, size = 1 / np.sqrt(variance), np.abs(columns).max(axis=0)
    scaled = columns / size * weight[:, None]
    inverse = np.linalg.pinv(scaled)
    coefficients = inverse @ (values * weight) / size
    return values - columns @ coefficients, np.column_stack([coefficients, inverse @ inverse.T / np.outer(size, size)])


def _directions(rate: Array, runs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return whether the rate rose (1) or fell (-1) into and out of each dwell, 0 elsewhere."""
    directions = np.zeros(len(rate), dtype=np.int64)
    for run in np.unique(runs):
        which = np.flatnonzero(runs == run)
        step = np.sign(np.round(np.diff(rate[which]), 6))
        inner = np.where(step[:-1] == step[1:], step[1:], 0.0)
        directions[which[1:-1]] = inner.astype(np.int64)
    return directions


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
    fitted = _fitted(np.column_stack(columns), values, variance + of_rate)[1]
    u = np.sqrt(max(fitted[0, 1] + fitted[1, 2] - 2 * fitted[0, 2], 0.0))
    return float(fitted[0, 0] - fitted[1, 0]), float(u)


def _kink(rate: Array, values: Array, variance: Array, zeros: Array, count: int) -> float | None:
    """Return the difference of slopes beside powers of the rate, all over the largest, where it is significant."""
    if count < _RATES:
        return None
    powers = range(1, min(_POWERS, count - 3) + 1)
    columns = np.column_stack([np.abs(rate), *(rate**power for power in powers), zeros])
    left, fitted = _fitted(columns, values, variance)
    freedom = len(values) - np.linalg.matrix_rank(columns)
    beyond = max(float(np.sum(left**2 / variance)) / freedom, 1.0) if freedom > 0 else 1.0
    return 2 * float(fitted[0, 0]) if abs(fitted[0, 0]) > SLOPES_KINK.limit * np.sqrt(fitted[0, 1] * beyond) else None


def _beyond_noise(
    key: NDArray[Any], direction: NDArray[np.int64], zeros: Array, values: Array, variance: Array
) -> tuple[float, int] | None:
    """Return chi-square and degrees of freedom of visits of one rate from one side, where they scatter beyond noise."""
    cells = np.unique(3 * key + direction, return_inverse=True)[1]
    columns = np.column_stack([cells[:, None] == np.arange(cells.max() + 1), zeros]).astype(np.float64)
    freedom = len(values) - int(np.linalg.matrix_rank(columns))
    chi_square = float(np.sum(_fitted(columns, values, variance)[0] ** 2 / variance))
    return (
        (chi_square, freedom)
        if freedom and chi_square_probability(chi_square, freedom) < HYSTERESIS_SCATTERS.level
        else None
    )


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


def _repeatability(rate: Array, values: Array, variance: Array, runs: NDArray[np.int64]) -> tuple[float, float] | None:
    """Return the standard deviation of the scale factor over runs, relative, and that which noise makes."""
    rows = []
    for run in np.unique(runs):
        which = runs == run
        if which.sum() > 2:
            columns = np.column_stack([rate[which], np.ones(int(which.sum()))])
            rows.append(_fitted(columns, values[which], variance[which])[1][0, :2])
    if len(rows) < 2:
        return None
    table = np.array(rows)
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


# How scale factors follow the temperature, where a column of it spans enough and does not merely follow time.


_SPAN = 5.0  # K
_FOLLOWS = 0.9
"""Share of the temperature's variance that a line over time explains, beyond which the two cannot be told apart."""


def temperature_slopes(
    recordings: Sequence[Recording], dwells: Sequence[Dwells], problem: RateProblem, solution: RateSolution
) -> dict[str, Parameter]:
    """Return ``gyro_scale_factor_slope_i``, 1/K, of each gyroscope whose runs tell it from a drift over time.

    It is c of ``mean output = S (1 + c dT) w + d dT + ...``, w the rate, dT the temperature less its mean, and the dots
    the columns of `design`; by least squares over the dwells, weighted by their noise.
    """
    temperature = _temperatures(recordings, dwells)
    if temperature is None:
        return {}
    means = without_lean(problem, [row[: len(problem.faces)] for row in solution.coefficients])
    time = np.arange(len(temperature), dtype=np.float64)  # of dwells in order: runs have clocks of their own
    slopes = {}
    for i, axis in enumerate(problem.gyros):
        on_axis = problem.axis == axis
        if (
            not on_axis.any()
            or np.ptp(temperature[on_axis]) < _SPAN
            or _explained(temperature[on_axis], time[on_axis]) > _FOLLOWS
        ):
            continue
        warmer = temperature[on_axis] - temperature[on_axis].mean()
        columns = design(problem, i, solution.orders[i])[on_axis]
        columns = columns[:, np.abs(columns).max(axis=0) > 0]
        columns = np.column_stack([problem.rate[on_axis] * warmer, warmer, columns])
        weight = 1 / np.sqrt(problem.variance[on_axis, i] + (1e-10 * np.abs(means).max()) ** 2)
        size = np.abs(columns).max(axis=0)
        scaled = columns / size * weight[:, None]
        inverse = np.linalg.pinv(scaled)
        left = means[on_axis, i] * weight
        slope = inverse @ left
        freedom = len(left) - np.linalg.matrix_rank(scaled)
        if freedom < 1:
            continue
        beyond = max(float(np.sum((left - scaled @ slope) ** 2)) / freedom, 1.0)
        scale = float(solution.coefficients[i][problem.faces.index(axis)])
        u = float(np.sqrt((inverse @ inverse.T)[0, 0] * beyond)) / size[0] / abs(scale)
        slopes[f"gyro_scale_factor_slope_{AXES[axis]}"] = Parameter(float(slope[0] / size[0]) / scale, u, "1/K")
    return slopes


def _temperatures(recordings: Sequence[Recording], dwells: Sequence[Dwells]) -> Array | None:
    """Return the mean temperature of each dwell, degC; None where a recording has no column of it."""
    temperatures = []
    for recording, run_dwells in zip(recordings, dwells, strict=True):
        if "temperature" not in recording or parse_unit(recording.units["temperature"]).quantity != "temperature":
            return None
        time, values = recording.si("time"), recording.si("temperature")
        first, last = np.searchsorted(time, run_dwells.start), np.searchsorted(time, run_dwells.stop, side="right")
        temperatures += [float(values[a:b].mean()) for a, b in zip(first, last, strict=True)]
    return np.array(temperatures) if np.isfinite(temperatures).all() else None


def _explained(values: Array, time: Array) -> float:
    return float(np.corrcoef(values, time)[0, 1] ** 2)


# From the coefficients of a rate test to bias, scale factor, misalignment, powers of the rate and g-sensitivity.


_APART = 0.3  # singular value of ones and gravity on the faces: below it bias and g-sensitivity are not told apart


@dataclass(frozen=True)
class _Entry:
    """A parameter: its derivative by all coefficients, what the table's common error does to it, and the mounting's."""

    name: str
    unit: str
    value: float
    line: Array
    common: float = 0.0
    mounted: float = 0.0


def _entries(problem: RateProblem, solution: RateSolution, i: int, unit: str) -> list[_Entry]:
    """Return the parameters of gyroscope number `i`: quotients of its coefficients by its scale factor."""
    faces, size, coefficients, order = problem.faces, len(problem.faces), solution.coefficients[i], solution.orders[i]
    axis, first = AXES[problem.gyros[i]], sum(map(len, solution.coefficients[:i]))
    on_axis, count = faces.index(problem.gyros[i]), sum(map(len, solution.coefficients))
    scale = float(coefficients[on_axis])
    unity = np.eye(len(coefficients))
    zeros = [np.concatenate([np.zeros(size + order - 1), row]) for row in _of_zeros(problem)[0]]

    def spread(part: Array) -> Array:
        return np.concatenate([np.zeros(first), part, np.zeros(count - first - len(part))])

    def quotient(name: str, entry_unit: str, at: Array, mounted: float = 0.0) -> _Entry:
        value = float(at @ coefficients) / scale
        return _Entry(name, entry_unit, value, spread((at - value * unity[on_axis]) / scale), mounted=mounted)

    return [
        quotient(f"gyro_bias_{axis}", "rad/s", zeros[0]),
        _Entry(f"gyro_scale_factor_{axis}", f"{unit}/(rad/s)", scale, spread(unity[on_axis]), common=scale),
        *(
            quotient(f"gyro_misalignment_{axis}{AXES[face]}", "rad", unity[k], 1.0)
            for k, face in enumerate(faces)
            if k != on_axis
        ),
        *(
            quotient(f"gyro_k{p}_{axis}", "1/(rad/s)" + (f"^{p - 1}" if p > 2 else ""), unity[size + p - 2])
            for p in range(2, order + 1)
        ),
        *(
            quotient(f"gyro_g_sensitivity_{axis}{b}", "rad/s/(m/s^2)", at)
            for b, at in zip(AXES, zeros[1:], strict=False)
        ),
    ]


def model_parameters(
    test: RateTest, problem: RateProblem, solution: RateSolution, unit: str, axes: TableAxes | None = None
) -> tuple[list[str], Array, Array, list[str], dict[str, float]]:
    """Return names, values, covariance and units of bias, scale factor, misalignment and powers of the rate.

    And the degrees of freedom of those whose uncertainty few faces show.
    """
    measured = [i for i, axis in enumerate(problem.gyros) if axis in problem.faces]
    entries = [entry for i in measured for entry in _entries(problem, solution, i, unit)]
    entries.sort(key=lambda entry: _ORDER.index(entry.name.rpartition("_")[0]))
    jacobian = np.array([entry.line for entry in entries])
    shared = np.array([entry.common for entry in entries]) * (test.relative_uncertainty or 0.0)
    mounting = (test.mounting_uncertainty or 0.0) if axes is None else 0.0
    added_variance = np.array([entry.mounted for entry in entries]) * mounting**2
    names = [entry.name for entry in entries]
    few: dict[str, tuple[float, float]] = {}
    for i in measured:
        axis = AXES[problem.gyros[i]]
        added, freedom = _between_faces(problem, solution, problem.gyros[i])
        of_zeros = [f"gyro_bias_{axis}", *(f"gyro_g_sensitivity_{axis}{b}" for b in AXES)]
        for name, value in zip(of_zeros, added.tolist(), strict=False):
            added_variance[names.index(name)] = value
            if value:
                few[name] = (value, freedom)
    matrix = np.asarray(
        jacobian @ solution.covariance @ jacobian.T + np.outer(shared, shared) + np.diag(added_variance)
    )
    if axes is not None:
        matrix += _by_axes(problem, entries, axes)
    values = np.array([entry.value for entry in entries])
    # Welch and Satterthwaite: the share that few faces show has few degrees of freedom
    variance = dict(zip(names, np.diag(matrix).tolist(), strict=True))
    freedoms = {name: nu * (variance[name] / added) ** 2 for name, (added, nu) in few.items()}
    return names, values, matrix, [entry.unit for entry in entries], freedoms


def _by_axes(problem: RateProblem, entries: Sequence[_Entry], axes: TableAxes) -> Array:
    """Return the covariance that the table axes' own makes: ``dT = -T dA A^-1``, columns of A the axes of the faces."""
    groups = _faces_of_runs(problem)
    sides = {axis: sum(1 for other, _ in groups if other == axis) for axis, _ in groups}

    def faces(directions: Array) -> Array:
        matrix = np.zeros((3, 3))
        for (axis, sign), runs in groups.items():
            matrix[:, axis] += sign * directions[runs].mean(axis=0) / sides[axis]
        return matrix

    inverse, values = np.linalg.inv(faces(axes.direction)), {entry.name: entry.value for entry in entries}
    turn = np.array([[values[f"gyro_misalignment_{a}{b}"] if a != b else 1.0 for b in AXES] for a in AXES])

    def moved(change: Array) -> Array:
        x = -turn @ change @ inverse
        row = []
        for entry in entries:
            kind, _, pair = entry.name.rpartition("_")
            i = AXES.index(pair[0])
            if kind == "gyro_scale_factor":
                row.append(entry.value * x[i, i])
            elif kind == "gyro_misalignment":
                row.append(x[i, AXES.index(pair[1])] - entry.value * x[i, i])
            else:
                row.append(0.0)
        return np.array(row)

    by_record = np.array([moved(faces(change)) for change in axes.changes]).reshape(-1, len(entries))
    by_dwells = []
    for (axis, _), runs in groups.items():
        u = float(np.sqrt(np.sum(axes.spread[runs] ** 2))) / len(runs) / sides[axis]
        for k in range(3):
            if k != axis:
                change = np.zeros((3, 3))
                change[k, axis] = u
                by_dwells.append(moved(change))
    rest = np.array(by_dwells)
    return np.asarray(by_record.T @ axes.correlation @ by_record + rest.T @ rest)


_ORDER = ["gyro_bias", "gyro_scale_factor", "gyro_misalignment", *(f"gyro_k{power}" for power in range(2, 6)),
          "gyro_g_sensitivity"]  # fmt: skip


def _faces_of_runs(problem: RateProblem) -> dict[tuple[int, int], list[int]]:
    """Return the runs of each face: body axis along the table's, and which way it points."""
    by_face: dict[tuple[int, int], list[int]] = {}
    for run in range(problem.runs):
        first = int(np.argmax(problem.run == run))
        by_face.setdefault((int(problem.axis[first]), int(problem.sign[first])), []).append(run)
    return by_face


def _of_zeros(problem: RateProblem) -> tuple[Array, float]:
    """Return the weights of the runs' zeros in the bias and, where the faces tell them apart, in G, and the freedom.

    Every face counts alike, and its runs alike; shape (4, runs), or (1, runs) where the bias holds the mean of G f.
    """
    groups = list(_faces_of_runs(problem).values())
    first = [int(np.argmax(problem.run == runs[0])) for runs in groups]
    force = np.array(
        [STANDARD_GRAVITY * problem.sign[at] * np.eye(3)[problem.axis[at]] for at in first]
        if problem.force is None
        else [problem.force[runs].mean(axis=0) for runs in groups]
    )
    columns = np.column_stack([np.ones(len(groups)), force / STANDARD_GRAVITY])
    weights = np.zeros((4, problem.runs))
    if len(groups) < 4 or np.linalg.svd(columns, compute_uv=False)[-1] < _APART:
        axes = [int(problem.axis[at]) for at in first]
        for axis, runs in zip(axes, groups, strict=True):
            weights[0, runs] = 1 / len(set(axes)) / axes.count(axis) / len(runs)
        return weights[:1], len(groups) - 1
    inverse = np.linalg.pinv(columns)
    inverse[1:] /= STANDARD_GRAVITY
    for k, runs in enumerate(groups):
        weights[:, runs] = inverse[:, [k]] / len(runs)
    return weights, len(groups) - 4


def g_sensitivity(problem: RateProblem, solution: RateSolution) -> Array | None:
    """Return S G of each gyroscope, output per m/s^2, shape (g, 3); None where the faces do not tell it from b."""
    weights, _ = _of_zeros(problem)
    if len(weights) < 4:
        return None
    return np.array([weights[1:] @ row[len(row) - problem.runs :] for row in solution.coefficients])


def _between_faces(problem: RateProblem, solution: RateSolution, axis: int) -> tuple[Array, float]:
    """Return what faces scatter beyond noise adds to the variances of b and G of a gyroscope, and its freedom.

    (rad/s)^2 .., shape (k,): the expected share of the noise is taken off, so that it does not count twice.
    """
    i = problem.gyros.index(axis)
    coefficients, first = solution.coefficients[i], sum(map(len, solution.coefficients[:i]))
    scale, at = float(coefficients[problem.faces.index(axis)]), len(coefficients) - problem.runs
    zeros = coefficients[at:] / scale
    noise = (
        solution.covariance[first + at : first + len(coefficients), first + at : first + len(coefficients)] / scale**2
    )
    weights, freedom = _of_zeros(problem)
    groups = list(_faces_of_runs(problem).values())
    if freedom < 1:
        return np.zeros(len(weights)), 0
    mean = np.zeros((len(groups), problem.runs))
    for row, runs in zip(mean, groups, strict=True):
        row[runs] = 1 / len(runs)
    share = np.array([weights[:, runs].sum(axis=1) for runs in groups])
    # the columns whose pseudoinverse the weights are: one, and the force where there are four
    columns = np.linalg.pinv(share.T) if len(weights) > 1 else np.ones((len(groups), 1))
    rest = (np.eye(len(groups)) - columns @ np.linalg.pinv(columns)) @ mean
    beyond = max(float(np.sum((rest @ zeros) ** 2) - np.trace(rest @ noise @ rest.T)), 0.0) / freedom
    return np.asarray(np.sum(share**2, axis=0) * beyond), freedom
