"""All dwells of a test to bias, scale factor, misalignment and nonlinearity, by generalised least squares.

    M_i = S_i (A_i + b_i),  A_i = s_i + k2_i s_i^2 + ...,  s = T w

Of gyroscope i in run m, whose table axis is body axis j, the means follow ``B_ij w`` plus a zero of that run, and
for j = i the powers of w; ``B = diag(S) T``. The covariance of the means holds their noise, the errors of single rates,
which all visits and all gyroscopes share, the level part of the Earth's rate that the table's turning does not average,
and what scatters beyond that. Source: generalised least squares (Aitken 1935); added variance: Mandel and Paule, Anal.
Chem. 42 (1970) 1194.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from imulab.earth import EARTH
from imulab.estimation.least_squares import chi_square_probability
from imulab.recording import Array

_CHANCE = 0.01
_HALVINGS = 60
_EXACT = 1e-10
_MOST_POWERS = 5


@dataclass(frozen=True)
class Problem:
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
class Solution:
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


def design(problem: Problem, gyro: int, order: int) -> Array:
    """Return the columns of gyroscope number `gyro`: slopes by face, powers of its own axis's rate, zeros of runs."""
    own = problem.axis == problem.gyros[gyro]
    if problem.lean is None:
        columns = [np.where(problem.axis == face, problem.rate, 0.0) for face in problem.faces]
    else:
        columns = [problem.rate * problem.lean[:, face] for face in problem.faces]
    if own.any():
        columns += [np.where(own, problem.rate**power, 0.0) for power in range(2, order + 1)]
    columns += [(problem.run == run).astype(np.float64) for run in range(problem.runs)]
    return np.column_stack(columns)


def solve(problem: Problem, orders: Sequence[int]) -> Solution:
    """Fit all gyroscopes together, each with powers of the rate up to its order."""
    count = len(problem.gyros)
    rates = min(len(np.unique(np.round(problem.rate[problem.axis == face], 9))) for face in problem.faces)
    most = max(*orders, min(_MOST_POWERS, rates - 2))
    slopes = [
        _weighted(design(problem, i, orders[i]), problem.mean[:, i], problem.variance[:, i]) for i in range(count)
    ]
    gains = [found[: len(problem.faces)] for found in slopes]
    blocks = _shared_blocks(problem, gains)
    variance = problem.variance + (_EXACT * np.abs(problem.mean).max()) ** 2
    scatter, chi_square, freedom = np.zeros(count), 0.0, 0
    for i in range(count):
        columns = design(problem, i, most)
        base = np.diag(variance[:, i]) + blocks[i, i]
        scatter[i], own = _scatter(columns, problem.mean[:, i], base)
        chi_square, freedom = chi_square + own, freedom + len(columns) - columns.shape[1]
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
    found, matrix, _ = _general(columns, problem.mean.T.ravel(), whole)
    ends = np.cumsum([0, *(design(problem, i, orders[i]).shape[1] for i in range(count))])
    coefficients = [found[a:b] for a, b in pairwise(ends)]
    return Solution(coefficients, matrix, tuple(orders), scatter, cycle, cycle_freedom, chi_square, freedom)


def without_lean(problem: Problem, gains: Sequence[Array]) -> Array:
    """Return the means of runs about a gyroscope's own axis without what their table's lean adds, shape (n, g)."""
    if problem.lean is None:
        return problem.mean
    found = problem.mean.copy()
    for i, axis in enumerate(problem.gyros):
        own = problem.axis == axis
        for k, face in enumerate(problem.faces):
            if face != axis:
                found[own, i] -= gains[i][k] * problem.rate[own] * problem.lean[own, face]
    return found


def _own(problem: Problem, gains: list[Array], gyro: int) -> float:
    """Scale factor of a gyroscope, 0 where the table never turned about its axis."""
    axis = problem.gyros[gyro]
    return float(gains[gyro][problem.faces.index(axis)]) if axis in problem.faces else 0.0


def _shared_blocks(problem: Problem, gains: list[Array]) -> dict[tuple[int, int], Array]:
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
    weight = 1 / np.sqrt(variance + (_EXACT * np.abs(values).max()) ** 2 + 1e-300)
    size = np.abs(columns).max(axis=0)
    found = np.linalg.lstsq(columns / size * weight[:, None], values * weight, rcond=None)[0]
    return np.asarray(found / size)


def _general(columns: Array, values: Array, covariance: Array) -> tuple[Array, Array, float]:
    """Return coefficients, their covariance and chi-square of generalised least squares."""
    spread = np.sqrt(np.diag(covariance))
    lower = np.linalg.cholesky(covariance / np.outer(spread, spread))
    size = np.abs(columns).max(axis=0)
    white = np.linalg.solve(lower, np.column_stack([columns / size, values]) / spread[:, None])
    q, r = np.linalg.qr(white[:, :-1])
    found = np.linalg.solve(r, q.T @ white[:, -1])
    left = white[:, -1] - white[:, :-1] @ found
    inverse = np.linalg.inv(r)
    return found / size, inverse @ inverse.T / np.outer(size, size), float(left @ left)


def _scatter(columns: Array, values: Array, base: Array) -> tuple[float, float]:
    """Return the standard deviation to add to each dwell so that chi-square is as expected, and chi-square before."""
    freedom = len(columns) - columns.shape[1]
    chi_square = _general(columns, values, base)[2]
    if freedom < 1 or chi_square_probability(chi_square, freedom) > _CHANCE:
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


def _cycles(problem: Problem, order: int, variance: Array, gains: list[Array]) -> tuple[float, int | None]:
    """Return by how much scale factors differ from run to run of one axis, relative, all gyroscopes pooled."""
    groups, mean = [], without_lean(problem, gains)
    for i, axis in enumerate(problem.gyros):
        scale = _own(problem, gains, i)
        own = []
        for run in sorted(set(problem.run[problem.axis == axis].tolist())):
            which = problem.run == run
            part = Problem(
                (axis,), np.zeros(int(which.sum()), dtype=np.int64), problem.axis[which], problem.sign[which],
                problem.rate[which], problem.table[which], mean[which, i : i + 1],
                problem.variance[which, i : i + 1], problem.level[which], np.zeros(int(which.sum())),
            )  # fmt: skip
            columns = design(part, 0, 1)
            if len(columns) > columns.shape[1]:
                found, matrix, _ = _general(columns, part.mean[:, 0], np.diag(variance[which, i]))
                own.append((found[0] / scale, matrix[0, 0] / scale**2))
        if len(own) > 1:
            groups.append(np.array(own))
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
    if chi_square_probability(before, freedom) > _CHANCE:
        return 0.0, None
    high = max(float(group[:, 1].max()) for group in groups) * before
    return float(np.sqrt(_root(lambda x: chi_square(x) - freedom, high))), freedom


def _diagonal(blocks: list[Array]) -> Array:
    rows, columns = (sum(block.shape[k] for block in blocks) for k in (0, 1))
    found = np.zeros((rows, columns))
    a = b = 0
    for block in blocks:
        found[a : a + block.shape[0], b : b + block.shape[1]] = block
        a, b = a + block.shape[0], b + block.shape[1]
    return found
