"""Dwells to bias, scale factor, misalignment and nonlinearity, by generalised least squares.

Model of gyroscope i: ``M_i = S_i (A_i + b_i)``, ``A_i = s_i + k2_i s_i^2 + ...``, ``s = T w``, w the rate.

Fit (`solve`): in a run whose table axis is body axis j the mean output is ``B_ij w``, ``B = diag(S) T``, plus the zero
of that run, and for j = i powers of w. The covariance of the means is the sum of their noise; of the errors of
commanded rates, which all visits and all gyroscopes share; of the horizontal part of the Earth's rate, as far as the
table's turning does not average it; and of an added variance where the dwells scatter beyond these, or of zeros that
walk.

Order (`choose_orders`): residuals are compared rate by rate, since all visits share the error of a commanded rate and
are no further evidence of a bend.

Nonlinearity, asymmetry, hysteresis (`measure_linearity`) are fractions of the largest rate or of the scale factor, so
that the uncertainty that all rates share drops out; docs/rate.md defines them.

Sources: IEEE Std 528 (terms); Aitken (1935), generalised least squares; Mandel and Paule, Anal. Chem. 42 (1970) 1194,
added variance; Patterson and Thompson, Biometrika 58 (1971) 545, restricted likelihood; F-test of nested models and
leave-one-out prediction.
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
    RATE_POWER,
    RATES_SCATTER_AS_NOISE,
    RUNS_SCATTER,
    SLOPES_KINK,
    ZEROS_WALK,
)
from imulab.estimation.least_squares import chi_square_probability, coverage_factor, f_test
from imulab.gravity import EARTH
from imulab.procedures.rate import AXES
from imulab.procedures.rate.axes import TableAxes
from imulab.procedures.rate.dwells import Dwells
from imulab.procedures.rate.hysteresis import (
    find_directions,
    fit_drift,
    fit_hysteresis,
    fit_loop,
    fit_weighted,
    null_space,
    test_bend,
    test_one_rate,
    test_visits,
)
from imulab.procedures.rate.schema import RateTest
from imulab.recording import Array, Recording
from imulab.records.calibration import Parameter
from imulab.units import STANDARD_GRAVITY, parse_unit

# All dwells of a test to bias, scale factor, misalignment and nonlinearity, by generalised least squares.


_HALVINGS = 60  # of a bracket, at most; 0.1 % of its end is enough
EXACT = 1e-10  # of the largest reading: noise that is assumed of data without noise
_WALKS = np.geomspace(0.1, 1e8, 60)  # variances of a walk or scatter over that of noise that are tried
_MOST_POWERS = 5  # powers of the rate in the model by which scatter is judged


@dataclass(frozen=True)
class RateProblem:
    """The n dwells of all runs of a test, of g gyroscopes.

    Attributes
    ----------
    gyros
        Body axis of each gyroscope, shape (g,).
    run, axis, sign
        Run of each dwell, body axis along the table's, and 1 where that points up, -1 where down, shape (n,).
    rate
        Rate about the body axis, the Earth's included, rad/s, shape (n,).
    table
        Rate of the table as commanded or recorded, rad/s, shape (n,).
    mean, variance
        Mean outputs and their variances, shape (n, g).
    level
        Mean cosine and sine of the table's angle, shape (n, 2).
    rate_uncertainty
        Standard uncertainty of the commanded rate of each dwell, which all its visits share, rad/s, shape (n,).
    scale_error, zero_error, loop_error
        `Sweep.scale_error`, `zero_error` and `loop_error` of each dwell's run, shapes (n,), (n, g) and (n,); the last
        is infinite where a loop cannot be distinguished from a delay.
    reach
        Largest rate of its run if that is a sweep, rad/s, shape (n,); 0 for steps.
    branch
        1 where the rate of a sweep rises, -1 where it falls, shape (n,); 0 for steps.
    lean
        Components of the table axis over that along the body axis, shape (n, 3); None if it lies along the body axis.
    force
        Specific force at rate 0 in each run, m/s^2, shape (m, 3); None for g along the faces.
    time
        Middle of each dwell in its recording, s, shape (n,); None where it is not known.
    rounding
        Standard uncertainty of a mean by steps of the output that are coarser than its noise, which all visits of a
        rate in a run share, output, shape (g,); None for 0.
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
    time: Array | None = None
    rounding: Array | None = None

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.run.max()) + 1

    @property
    def faces(self) -> list[int]:
        """Body axes that the table turned about."""
        return sorted(set(self.axis.tolist()))

    def rounded(self, gyro: int) -> float:
        """Return `rounding` of gyroscope number `gyro`."""
        return 0.0 if self.rounding is None else float(self.rounding[gyro])


@dataclass(frozen=True)
class RateSolution:
    """Coefficients of each gyroscope, in the order of its columns, and their joint covariance.

    Attributes
    ----------
    coefficients
        For each gyroscope: slopes over the rates about each face, powers of the rate about its axis, zeros of the runs.
    covariance
        Covariance of all coefficients, one gyroscope after the other.
    orders
        Highest power of the rate of each gyroscope.
    scatter
        Standard deviation that was added to each dwell, for each gyroscope, output.
    walk
        Variance per second by which its zero walks, as dwells about other axes show it, output^2/s, shape (g,).
    cycle
        Relative standard deviation of scale factors from run to run of one axis; 0 where noise explains it.
    cycle_freedom
        Runs of one axis beyond the first, summed over the axes; None where `cycle` is 0.
    chi_square, freedom
        Chi-square and degrees of freedom of the model with most powers, before any variance was added.
    """

    coefficients: list[Array]
    covariance: Array
    orders: tuple[int, ...]
    scatter: Array
    walk: Array
    cycle: float
    cycle_freedom: int | None
    chi_square: float
    freedom: int


def design(problem: RateProblem, gyro: int, order: int) -> Array:
    """Return the design matrix of gyroscope number `gyro`: slopes by face, powers of the rate, zeros of the runs."""
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
    """Return the fit of all gyroscopes together, each with powers of the rate up to its order.

    ``x = (A' C^-1 A)^-1 A' C^-1 M``, A the columns of `design` and C the covariance that the module describes.
    """
    count = len(problem.gyros)
    rates = min(len(np.unique(np.round(problem.rate[problem.axis == face], 9))) for face in problem.faces)
    most = max(*orders, min(_MOST_POWERS, rates - 2))
    slopes = [
        _fit_weighted_slopes(design(problem, i, orders[i]), problem.mean[:, i], problem.variance[:, i])
        for i in range(count)
    ]
    gains = [estimates[: len(problem.faces)] for estimates in slopes]
    blocks = _shared_covariance(problem, gains)
    variance = problem.variance + (EXACT * np.abs(problem.mean).max()) ** 2
    scatter, chi_square, freedom = np.zeros(count), 0.0, 0
    walk, walks, across = _covariance_of_walk(problem), [], np.zeros(count)
    for i in range(count):
        columns = design(problem, i, most)
        base = np.diag(variance[:, i]) + blocks[i, i]
        across[i] = _fit_walk(problem, i, most, base, walk, problem.axis != problem.gyros[i])
        walks.append(_fit_walk(problem, i, most, base, walk, problem.axis >= 0) * walk)
        axis_chi_square = _fit_generalised(columns, problem.mean[:, i], base)[2]
        scatter[i] = _fit_scatter(columns, problem.mean[:, i], base + walks[i])[0]
        blocks[i, i] = blocks[i, i] + walks[i]
        chi_square, freedom = chi_square + axis_chi_square, freedom + len(columns) - columns.shape[1]
    variance = variance + scatter**2
    cycle, cycle_freedom = _fit_run_scatter(problem, walks, variance, gains)
    for i in range(count):
        own_rate = np.where(problem.axis == problem.gyros[i], problem.rate * _own_scale_factor(problem, gains, i), 0.0)
        same = problem.run[:, None] == problem.run
        of_run = cycle**2 if problem.scale_error is None else cycle**2 + problem.scale_error**2
        blocks[i, i] = blocks[i, i] + of_run * same * np.outer(own_rate, own_rate) + np.diag(variance[:, i])
        if problem.zero_error is not None:
            blocks[i, i] += same * np.outer(problem.zero_error[:, i], problem.zero_error[:, i])
    whole = np.block([[blocks[i, k] for k in range(count)] for i in range(count)])
    columns = _join_diagonally([design(problem, i, orders[i]) for i in range(count)])
    estimates, matrix, _ = _fit_generalised(columns, problem.mean.T.ravel(), whole)
    ends = np.cumsum([0, *(design(problem, i, orders[i]).shape[1] for i in range(count))])
    coefficients = [estimates[a:b] for a, b in pairwise(ends)]
    return RateSolution(coefficients, matrix, tuple(orders), scatter, across, cycle, cycle_freedom, chi_square, freedom)


def subtract_lean(problem: RateProblem, gains: Sequence[Array]) -> Array:
    """Return the mean outputs less what the lean of the table axis adds through misalignment, shape (n, g)."""
    if problem.lean is None:
        return problem.mean
    means = problem.mean.copy()
    for i, axis in enumerate(problem.gyros):
        on_axis = problem.axis == axis
        for k, face in enumerate(problem.faces):
            if face != axis:
                means[on_axis, i] -= gains[i][k] * problem.rate[on_axis] * problem.lean[on_axis, face]
    return means


def _own_scale_factor(problem: RateProblem, gains: list[Array], gyro: int) -> float:
    """Return the scale factor of a gyroscope, 0 where the table never turned about its axis."""
    axis = problem.gyros[gyro]
    return float(gains[gyro][problem.faces.index(axis)]) if axis in problem.faces else 0.0


def _shared_covariance(problem: RateProblem, gains: list[Array]) -> dict[tuple[int, int], Array]:
    """Return the covariance of the means of each two gyroscopes by single rates, the Earth's rate, and rounding.

    Errors of a commanded rate are common to all its visits and all gyroscopes. The Earth's horizontal rate has a
    variance of half its square about a random direction, as far as the turning of the table does not average it.
    """
    face = np.array([problem.faces.index(axis) for axis in problem.axis.tolist()])
    one_rate = np.isclose(problem.table[:, None], problem.table, rtol=1e-9, atol=1e-9)
    alike = one_rate * np.outer(problem.rate_uncertainty, problem.rate_uncertainty)
    same_run = problem.run[:, None] == problem.run
    same = same_run * (problem.level @ problem.level.T) * EARTH**2 / 2
    blocks: dict[tuple[int, int], Array] = {}
    for i, first in enumerate(gains):
        for k, second in enumerate(gains):
            felt = np.outer(first[face] * problem.sign, second[face] * problem.sign)
            blocks[i, k] = np.asarray(alike * felt)
        across = (problem.axis != problem.gyros[i]).astype(np.float64) * np.abs(first).max()
        blocks[i, i] = blocks[i, i] + same * np.outer(across, across) + problem.rounded(i) ** 2 * (same_run & one_rate)
    return blocks


def _fit_weighted_slopes(columns: Array, values: Array, variance: Array) -> Array:
    weight = 1 / np.sqrt(variance + (EXACT * np.abs(values).max()) ** 2 + 1e-300)
    size = np.abs(columns).max(axis=0)
    scaled = np.linalg.lstsq(columns / size * weight[:, None], values * weight, rcond=None)[0]
    return np.asarray(scaled / size)


def _fit_generalised(columns: Array, values: Array, covariance: Array) -> tuple[Array, Array, float]:
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


def _covariance_of_walk(problem: RateProblem) -> Array:
    """Return the covariance over dwells of zeros that walk by 1 per sqrt(s), shape (n, n): ``(T - |t - t'|) / 2``.

    T is the time from the first dwell of a run to the last, so that the zero of a run is that at its begin or end.
    0 where times are not known, and for sweeps, whose means by rate are of all times.
    """
    covariance = np.zeros((len(problem.rate), len(problem.rate)))
    for run in range(problem.runs):
        which = np.flatnonzero(problem.run == run)
        if problem.time is not None and (problem.reach is None or not problem.reach[which].any()):
            time = problem.time[which]
            covariance[np.ix_(which, which)] = (np.ptp(time) - np.abs(time[:, None] - time)) / 2
    return covariance


def _fit_walk(problem: RateProblem, gyro: int, order: int, base: Array, walk: Array, where: NDArray[np.bool_]) -> float:
    """Return the factor of `walk` that explains the dwells `where`, 0 where noise or scatter explain them as well.

    It is of greatest restricted likelihood. Each run has a slope of its own, since a mounting or a scale factor that
    differs from run to run is no walk.
    """
    if not walk[where][:, where].any():
        return 0.0
    slopes = problem.rate[:, None] * (problem.run[:, None] == np.arange(problem.runs))
    columns, values = np.column_stack([design(problem, gyro, order), slopes])[where], problem.mean[where, gyro]
    base, walk = base[where][:, where], walk[where][:, where]
    usual = np.diag(base).mean() * _WALKS
    sizes = usual / np.diag(walk).mean()
    gains = _gain_likelihood(columns, values, base, walk, sizes)
    if (
        gains.max() < coverage_factor(None, 1 - 2 * ZEROS_WALK.level) ** 2
        or gains.max() < _gain_likelihood(columns, values, base, np.eye(len(base)), usual).max()
    ):
        return 0.0
    return float(sizes[gains.argmax()])


def _gain_likelihood(columns: Array, values: Array, base: Array, part: Array, sizes: Array) -> Array:
    """Return by how much ``base + x part`` makes twice the log restricted likelihood larger, for each size x.

    Residuals that are free of the columns, and independent by both covariances, have variances ``1 + x r``.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(base))
    free = inverse.T @ null_space((inverse @ columns / np.maximum(np.abs(columns).max(axis=0), 1e-300)).T)
    ratios, axes = np.linalg.eigh(free.T @ part @ free)
    squares = (axes.T @ (free.T @ values)) ** 2
    variances = 1 + sizes[:, None] * np.maximum(ratios, 0.0)
    return np.asarray(np.sum(squares - squares / variances - np.log(variances), axis=1))


def _fit_scatter(columns: Array, values: Array, base: Array) -> tuple[float, float]:
    """Return the standard deviation to add to each dwell so that chi-square is as expected, and chi-square before."""
    freedom = len(columns) - columns.shape[1]
    chi_square = _fit_generalised(columns, values, base)[2]
    if freedom < 1 or chi_square_probability(chi_square, freedom) > DWELLS_SCATTER.level:
        return 0.0, chi_square
    high = float(np.diag(base).mean()) * chi_square
    added = _find_root(lambda x: _fit_generalised(columns, values, base + x * np.eye(len(base)))[2] - freedom, high)
    return float(np.sqrt(added)), chi_square


def _find_root(excess: Callable[[float], float], high: float) -> float:
    """Return where a falling function is 0, between 0 and `high`."""
    low = 0.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
        if high - low < 1e-3 * high:
            break
    return high


def _fit_run_scatter(
    problem: RateProblem, walks: list[Array], variance: Array, gains: list[Array]
) -> tuple[float, int | None]:
    """Return the relative standard deviation of scale factors over runs of one axis, and its degrees of freedom.

    All gyroscopes are pooled; 0 and None where noise and `walks`, shapes (n, n), explain the scatter (chi-square).
    """
    groups, mean = [], subtract_lean(problem, gains)
    for i, axis in enumerate(problem.gyros):
        scale = _own_scale_factor(problem, gains, i)
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
                covariance = np.diag(variance[which, i]) + walks[i][np.ix_(which, which)]
                estimate, matrix, _ = _fit_generalised(columns, part.mean[:, 0], covariance)
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
    return float(np.sqrt(_find_root(lambda x: chi_square(x) - freedom, high))), freedom


def _join_diagonally(blocks: list[Array]) -> Array:
    rows, columns = (sum(block.shape[k] for block in blocks) for k in (0, 1))
    joined = np.zeros((rows, columns))
    a = b = 0
    for block in blocks:
        joined[a : a + block.shape[0], b : b + block.shape[1]] = block
        a, b = a + block.shape[0], b + block.shape[1]
    return joined


# The order that a gyroscope's dwells support: by F-test, and by each rate predicted from the others.


HIGHEST = 5  # power of the rate, as in the C core


def choose_orders(problem: RateProblem) -> tuple[int, ...]:
    """Return the highest power of the rate of each gyroscope that its dwells support; 1 where its axis was not turned.

    A higher order is taken if it lowers chi-square by more than noise and the scatter of the rates explain (chi-square
    and F-test), against the order chosen so far and against the next lower one, and if it predicts each rate from the
    others better by more than the standard error of that comparison.
    """
    return tuple(_choose_order(problem, i) for i in range(len(problem.gyros)))


def _choose_order(problem: RateProblem, gyro: int) -> int:
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
    stated = np.hypot(problem.rate_uncertainty[on_axis] * slope, problem.rounded(gyro))
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
        if not all(_is_significant(costs, below, order, count) for below in {chosen, order - 1}):
            continue
        squares = predicted(models[order])
        gain = best - squares
        if gain.mean() > gain.std(ddof=1) / np.sqrt(count):
            chosen, best = order, squares
    return chosen


def _is_significant(costs: Mapping[int, float], below: int, order: int, count: int) -> bool:
    by_noise = chi_square_probability(costs[below] - costs[order], order - below)
    if chi_square_probability(costs[order], count - order - 1) > RATES_SCATTER_AS_NOISE.level:
        return by_noise < RATE_POWER.level
    return max(by_noise, f_test(costs[below], below + 1, costs[order], order + 1, count)) < RATE_POWER.level


# The residual of a straight line over the rate: nonlinearity, asymmetry and hysteresis.


_ONE_SIDED = 1.645  # standard uncertainties: 95 % of normal values lie below
_SMALL = 1e-3  # of the largest rate: if all rates show and none is smaller, the threshold is not known
_RATES, _POWERS = 7, 5
"""Fewest different rates that distinguish a kink from powers of the rate, and these powers."""


@dataclass(frozen=True)
class Linearity:
    """How far one gyroscope is from linear: fractions of the largest rate or scale factor, with uncertainties.

    Attributes
    ----------
    rate, residual, uncertainty
        Rate of each dwell about its axis, rad/s, and the residual of the line with its standard uncertainty, a fraction
        of the largest rate, shape (n,).
    direction
        1 where the rate was rising, -1 where it was falling, 0 at turning points, shape (n,).
    nonlinearity
        Largest residual of a rate in absolute value, and the standard uncertainty of that residual. A maximum of
        absolute values is never 0, nor normal.
    hysteresis
        Largest difference of rising less falling at one rate, and the standard uncertainty of that difference.
    asymmetry
        Slope of positive less slope of negative rates, ``(S+ - S-) / S``, and its standard uncertainty.
    probability
        Probability that noise alone leaves such residuals of the line.
    one_rate
        Probability that the rate with the largest residual stands apart from the others by chance, as they scatter.
    bend
        Probability that noise, scatter, walk and drift make the next two powers of the rate beyond those chosen.
    by_noise
        Limit that the largest residual stays below with 95 % by noise alone.
    loop
        Probability that noise alone makes the loop between rising and falling rates; None where no rate was visited
        both ways.
    fitted_loop
        Rising less falling at rate 0, of the loop ``1 - (w/w_max)^2`` fitted to all rates, and its uncertainty.
    repeatability
        Standard deviation of the scale factor over runs, and that which noise makes; None with one run.
    threshold
        Least rate that shows in the output, and its standard uncertainty, rad/s; None without small rates.
    by_polynomial
        Largest residual of a rate beside the powers of the rate that were chosen.
    kink
        Difference of the slopes of positive and negative rates beside five powers of the rate, where noise alone makes
        it in less than one test of a thousand; else None.
    drift
        Change of the scale factor, a fraction, and of the zero, rad/s, over a run, where it explains nine tenths of the
        scatter beyond noise; it is taken off the other figures. Else None.
    """

    rate: Array
    residual: Array
    uncertainty: Array
    direction: NDArray[np.int64]
    nonlinearity: tuple[float, float]
    asymmetry: tuple[float, float] | None
    hysteresis: tuple[float, float] | None
    probability: float
    one_rate: float
    bend: float
    by_noise: float
    loop: float | None
    fitted_loop: tuple[float, float] | None
    repeatability: tuple[float, float] | None
    threshold: tuple[float, float] | None
    by_polynomial: float
    kink: float | None
    drift: tuple[float, float] | None


def measure_linearity(problem: RateProblem, gyro: int, scale: float, order: int, walk: float) -> Linearity:
    """Return nonlinearity, asymmetry, hysteresis and threshold of gyroscope number `gyro`, and the residuals behind.

    ``r = M / S - w - zero of the run``, by weighted least squares of a line over the rates about its axis. Nonlinearity
    is the largest absolute mean of r at one rate over the largest rate; its uncertainty is that of this mean. `walk` is
    that of the gyroscope's zero, as in `RateSolution`.
    """
    on_axis = problem.axis == problem.gyros[gyro]
    rate, runs = problem.rate[on_axis], problem.run[on_axis]
    values = problem.mean[on_axis, gyro] / scale
    variance = problem.variance[on_axis, gyro] / scale**2 + (EXACT * np.abs(rate).max()) ** 2
    key = np.unique(np.round(problem.table[on_axis] * problem.sign[on_axis], 6), return_inverse=True)[1]
    of_rate = problem.rate_uncertainty[on_axis] ** 2 + (problem.rounded(gyro) / scale) ** 2
    zeros = (runs[:, None] == np.unique(runs)).astype(np.float64)
    largest = max(float(np.abs(rate).max()), 0.0 if problem.reach is None else float(problem.reach[on_axis].max()))
    branch = np.zeros_like(runs) if problem.branch is None else problem.branch[on_axis] * problem.sign[on_axis]
    drift = None if branch.any() else _fit_drift(rate, values, variance, key, runs, problem.time, on_axis)
    values = values if drift is None else values - drift[0]
    left, _ = fit_weighted(np.column_stack([rate, zeros]), values, variance)
    means = _mean_by_rate(left, variance, of_rate, key)
    spread = np.sqrt(means[:, 1])
    worst = int(np.argmax(np.abs(means[:, 0])))
    freedom = len(means) - 2
    chi_square = float(np.sum((means[:, 0] / spread) ** 2))
    probability = chi_square_probability(chi_square, freedom) if freedom > 0 else 1.0
    reach = coverage_factor(None, 1 - 0.05 / len(means))
    direction = np.where(branch != 0, branch, find_directions(rate, runs))
    powers = np.column_stack([*(rate**power for power in range(1, order + 1)), zeros])
    rest = fit_weighted(powers, values, variance)[0]
    freedom = max(len(rest) - powers.shape[1], 1)
    scattered = variance * max(float(np.sum(rest**2 / variance)) / freedom, 1.0)
    beyond = test_visits(key, direction, zeros, values, variance)
    error = np.zeros(len(rate)) if problem.loop_error is None else problem.loop_error[on_axis]
    loop, fitted_loop, hysteresis = fit_hysteresis(
        left / largest, variance / largest**2, key, runs, direction, rate / largest, error, beyond
    )
    bend = 1.0
    if not branch.any() and problem.time is not None:
        steps, visits = (rate / largest, values / largest, variance / largest**2), (key, runs, problem.time[on_axis])
        bend = test_bend(*steps, of_rate / largest**2, *visits, order)
        if loop is not None:
            loop, fitted_loop = fit_loop(*steps, *visits, direction, walk / (scale * largest) ** 2) or (None, None)
    return Linearity(
        rate=rate,
        residual=left / largest,
        uncertainty=np.sqrt(variance) / largest,
        direction=direction,
        nonlinearity=(float(abs(means[worst, 0])) / largest, float(spread[worst]) / largest),
        asymmetry=_fit_asymmetry(rate, values, scattered, zeros, direction, of_rate),
        hysteresis=hysteresis,
        probability=probability,
        one_rate=test_one_rate(
            rate, problem.table[on_axis], values, variance + of_rate, zeros, int(np.argmax(key == worst))
        ),
        bend=bend,
        by_noise=reach * float(spread.max()) / largest,
        loop=loop,
        fitted_loop=fitted_loop,
        repeatability=_measure_repeatability(rate, values, variance, runs),
        threshold=_find_threshold(rate, problem.table[on_axis], left, variance, key),
        by_polynomial=max(abs(float(rest[key == k].mean())) for k in np.unique(key)) / largest,
        kink=_fit_kink(rate / largest, values / largest, (variance + of_rate) / largest**2, zeros, len(means)),
        drift=None if drift is None else drift[1:],
    )


def _mean_by_rate(left: Array, variance: Array, of_rate: Array, key: NDArray[Any]) -> Array:
    """Return mean residual of each rate and the variance of that, shape (rates, 2)."""
    visits = [key == k for k in np.unique(key)]
    return np.array([[left[v].mean(), variance[v].sum() / v.sum() ** 2 + of_rate[v].mean()] for v in visits])


def _fit_drift(
    rate: Array,
    values: Array,
    variance: Array,
    key: NDArray[Any],
    runs: NDArray[np.int64],
    time: Array | None,
    on_axis: NDArray[np.bool_],
) -> tuple[Array, float, float] | None:
    """Return the drift beside as many powers of the rate as its different values support (`fit_drift`)."""
    if time is None:
        return None
    zeros = (runs[:, None] == np.unique(runs)).astype(np.float64)
    most = max(min(_POWERS, int(key.max()) - 1), 1)
    powers = np.column_stack([*(rate**power for power in range(1, most + 1)), zeros])
    return fit_drift(rate, values, variance, runs, time[on_axis], powers)


def _fit_asymmetry(
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
    fitted = fit_weighted(np.column_stack(columns), values, variance + of_rate)[1]
    u = np.sqrt(max(fitted[0, 1] + fitted[1, 2] - 2 * fitted[0, 2], 0.0))
    return float(fitted[0, 0] - fitted[1, 0]), float(u)


def _fit_kink(rate: Array, values: Array, variance: Array, zeros: Array, count: int) -> float | None:
    """Return the difference of slopes beside powers of the rate, all over the largest, where it is significant."""
    if count < _RATES:
        return None
    powers = range(1, min(_POWERS, count - 3) + 1)
    columns = np.column_stack([np.abs(rate), *(rate**power for power in powers), zeros])
    left, fitted = fit_weighted(columns, values, variance)
    freedom = len(values) - np.linalg.matrix_rank(columns)
    beyond = max(float(np.sum(left**2 / variance)) / freedom, 1.0) if freedom > 0 else 1.0
    return 2 * float(fitted[0, 0]) if abs(fitted[0, 0]) > SLOPES_KINK.limit * np.sqrt(fitted[0, 1] * beyond) else None


def _measure_repeatability(
    rate: Array, values: Array, variance: Array, runs: NDArray[np.int64]
) -> tuple[float, float] | None:
    """Return the standard deviation of the scale factor over runs, relative, and that which noise makes."""
    rows = []
    for run in np.unique(runs):
        which = runs == run
        if which.sum() > 2:  # a line through two dwells leaves no scatter
            columns = np.column_stack([rate[which], np.ones(int(which.sum()))])
            rows.append(fit_weighted(columns, values[which], variance[which])[1][0, :2])
    if len(rows) < 2:
        return None
    table = np.array(rows)
    return float(table[:, 0].std(ddof=1)), float(np.sqrt(table[:, 1].mean()))


def _find_threshold(
    rate: Array, table: Array, left: Array, variance: Array, key: NDArray[Any]
) -> tuple[float, float] | None:
    """Return the least rate from which on the output exceeds half of the line with 95 %, and its uncertainty, rad/s.

    The true threshold lies between this rate and the next lower one: their distance over sqrt(12). None where no rate
    of the table is below a thousandth of the largest and all of them show.
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


# Scale factors over temperature, where the recordings span enough of it and it does not merely follow time.


_SPAN = 5.0  # K, the least range of temperature from which a slope is stated
_FOLLOWS = 0.9
"""Share of the temperature's variance that a line over time explains, from which the two cannot be distinguished."""


def temperature_slopes(
    recordings: Sequence[Recording], dwells: Sequence[Dwells], problem: RateProblem, solution: RateSolution
) -> dict[str, Parameter]:
    """Return ``gyro_scale_factor_slope_i``, 1/K, of each gyroscope whose runs distinguish it from a drift over time.

    It is c of ``mean output = S (1 + c dT) w + d dT + ...``, w the rate, dT the temperature less its mean, and the dots
    the columns of `design`; by least squares over the dwells, weighted by their noise.
    """
    temperature = _mean_temperatures(recordings, dwells)
    if temperature is None:
        return {}
    means = subtract_lean(problem, [row[: len(problem.faces)] for row in solution.coefficients])
    time = np.arange(len(temperature), dtype=np.float64)  # of dwells in order: runs have clocks of their own
    slopes = {}
    for i, axis in enumerate(problem.gyros):
        on_axis = problem.axis == axis
        if (
            not on_axis.any()
            or np.ptp(temperature[on_axis]) < _SPAN
            or _share_explained(temperature[on_axis], time[on_axis]) > _FOLLOWS
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


def _mean_temperatures(recordings: Sequence[Recording], dwells: Sequence[Dwells]) -> Array | None:
    """Return the mean temperature of each dwell, degC; None where a recording has no column of it."""
    temperatures = []
    for recording, run_dwells in zip(recordings, dwells, strict=True):
        if "temperature" not in recording or parse_unit(recording.units["temperature"]).quantity != "temperature":
            return None
        time, values = recording.si("time"), recording.si("temperature")
        first, last = np.searchsorted(time, run_dwells.start), np.searchsorted(time, run_dwells.stop, side="right")
        temperatures += [float(values[a:b].mean()) for a, b in zip(first, last, strict=True)]
    return np.array(temperatures) if np.isfinite(temperatures).all() else None


def _share_explained(values: Array, time: Array) -> float:
    return float(np.corrcoef(values, time)[0, 1] ** 2)


# From the coefficients of a rate test to bias, scale factor, misalignment, powers of the rate and g-sensitivity.


_APART = 0.3  # singular value of ones and gravity on the faces: below it bias and g-sensitivity are one


@dataclass(frozen=True)
class _Entry:
    """A parameter, its derivative by all coefficients, and by the common error of the table and of the mounting."""

    name: str
    unit: str
    value: float
    line: Array
    common: float = 0.0
    mounted: float = 0.0


def _derive_parameters(problem: RateProblem, solution: RateSolution, i: int, unit: str) -> list[_Entry]:
    """Return the parameters of gyroscope number `i`: its coefficients over its scale factor, and that itself."""
    faces, size, coefficients, order = problem.faces, len(problem.faces), solution.coefficients[i], solution.orders[i]
    axis, first = AXES[problem.gyros[i]], sum(map(len, solution.coefficients[:i]))
    on_axis, count = faces.index(problem.gyros[i]), sum(map(len, solution.coefficients))
    scale = float(coefficients[on_axis])
    unity = np.eye(len(coefficients))
    zeros = [np.concatenate([np.zeros(size + order - 1), row]) for row in _weigh_zeros(problem)[0]]

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

    ``S = B_ii``, ``T_ij = B_ij / S``, ``b = zero / S``, ``k_p = c_p / S`` of the coefficients of `solve`, with the
    covariance ``J C J'``, J the derivatives of these. To it are added what the table states for all rates, the mounting
    of each face, and the scatter of zeros between faces. Last come the degrees of freedom of parameters whose
    uncertainty rests on that scatter.
    """
    measured = [i for i, axis in enumerate(problem.gyros) if axis in problem.faces]
    entries = [entry for i in measured for entry in _derive_parameters(problem, solution, i, unit)]
    entries.sort(key=lambda entry: _ORDER.index(entry.name.rpartition("_")[0]))
    jacobian = np.array([entry.line for entry in entries])
    shared = np.array([entry.common for entry in entries]) * (test.relative_uncertainty or 0.0)
    mounting = (test.mounting_uncertainty or 0.0) if axes is None else 0.0
    added_variance = np.array([entry.mounted for entry in entries]) * mounting**2
    names = [entry.name for entry in entries]
    few: dict[str, tuple[float, float]] = {}
    for i in measured:
        axis = AXES[problem.gyros[i]]
        added, freedom = _variance_between_faces(problem, solution, problem.gyros[i])
        of_zeros = [f"gyro_bias_{axis}", *(f"gyro_g_sensitivity_{axis}{b}" for b in AXES)]
        for name, value in zip(of_zeros, added.tolist(), strict=False):
            added_variance[names.index(name)] = value
            if value:
                few[name] = (value, freedom)
    matrix = np.asarray(
        jacobian @ solution.covariance @ jacobian.T + np.outer(shared, shared) + np.diag(added_variance)
    )
    if axes is not None:
        matrix += _covariance_by_axes(problem, entries, axes)
    values = np.array([entry.value for entry in entries])
    # Welch and Satterthwaite: of the variance only the part between faces has few degrees of freedom
    variance = dict(zip(names, np.diag(matrix).tolist(), strict=True))
    freedoms = {name: nu * (variance[name] / added) ** 2 for name, (added, nu) in few.items()}
    return names, values, matrix, [entry.unit for entry in entries], freedoms


def _covariance_by_axes(problem: RateProblem, entries: Sequence[_Entry], axes: TableAxes) -> Array:
    """Return the parameters' covariance by that of the table axes: ``dT = -T dA A^-1``, columns of A these axes."""
    groups = _group_runs_by_face(problem)
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


def _group_runs_by_face(problem: RateProblem) -> dict[tuple[int, int], list[int]]:
    """Return the runs of each face; a face is the body axis along the table's and its sign."""
    by_face: dict[tuple[int, int], list[int]] = {}
    for run in range(problem.runs):
        first = int(np.argmax(problem.run == run))
        by_face.setdefault((int(problem.axis[first]), int(problem.sign[first])), []).append(run)
    return by_face


def _weigh_zeros(problem: RateProblem) -> tuple[Array, float]:
    """Return the weights of the runs' zeros in the bias and the g-sensitivity G, and the degrees of freedom.

    ``zero = b + G f`` by least squares over faces, f the specific force; every face counts alike, and its runs alike.
    Shape (4, runs), or (1, runs) where the faces cannot distinguish them, and the bias contains the mean of G f.
    """
    groups = list(_group_runs_by_face(problem).values())
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
    """Return S G of each gyroscope, output per m/s^2, shape (g, 3); None where the faces do not show it beside b."""
    weights, _ = _weigh_zeros(problem)
    if len(weights) < 4:
        return None
    return np.array([weights[1:] @ row[len(row) - problem.runs :] for row in solution.coefficients])


def _variance_between_faces(problem: RateProblem, solution: RateSolution, axis: int) -> tuple[Array, float]:
    """Return the variances of b and G of a gyroscope by the scatter of faces beyond noise, and degrees of freedom.

    Shape (1,) or (4,), (rad/s)^2 for b. The noise's expected share of the scatter is subtracted, so that noise does not
    count twice.
    """
    i = problem.gyros.index(axis)
    coefficients, first = solution.coefficients[i], sum(map(len, solution.coefficients[:i]))
    scale, at = float(coefficients[problem.faces.index(axis)]), len(coefficients) - problem.runs
    zeros = coefficients[at:] / scale
    noise = (
        solution.covariance[first + at : first + len(coefficients), first + at : first + len(coefficients)] / scale**2
    )
    weights, freedom = _weigh_zeros(problem)
    groups = list(_group_runs_by_face(problem).values())
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
