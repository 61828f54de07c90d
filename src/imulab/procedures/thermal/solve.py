"""Least squares of ``|f(M_p, T_p)| = g`` over the holds of all recordings, with what is common to some of them.

The covariance of the rows (`imulab.procedures.thermal.rows`) is

    V = noise + excess + sum over what several rows share: an error of the reading of the temperature, N(0, u_T^2), and
    an offset of each bias (and scale factor) per power cycle, N(0, tau^2)

tau^2 is where the generalised sum of squares exceeds that with free offsets by q, the rank that free offsets add (the
method of moments of Mandel and Paule, for a vector). Everything is in units of g.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from imulab.estimation.least_squares import chi_square_probability, plausible_excess
from imulab.procedures.thermal.model import Laws, forces
from imulab.procedures.thermal.rows import Problem, Rows, linearise, parameters_of, whitener
from imulab.recording import Array

_PASSES, _STEPS = 4, 12
_RESTS = 1e-10
_LOOSE = 0.01
"""What temperature is taken to change, in g, while the fit starts."""
_SEEN = 1e-7
"""Share of the largest singular value below which offsets are not told from the laws."""

_TELLS = 0.1
"""Share of what an offset moves by itself that must be left beside the laws for it to tell how far offsets go."""


@dataclass(frozen=True)
class Scatter:
    """Between recordings: tau of bias and scale factor, rank q that free offsets add, variance of one offset.

    `bound`: tau is what polynomials leave, of a spline that takes the offset of each recording for the law.
    """

    tau: Array = field(default_factory=lambda: np.zeros(2))
    rank: int = 0
    spread: Array = field(default_factory=lambda: np.zeros(2))
    probability: float | None = None
    bound: bool = False

    @property
    def resolution(self) -> float:
        """Standard uncertainty of one offset of a bias, as the recordings tell it."""
        return float(np.sqrt(max(self.spread[0] - self.tau[0] ** 2, 0.0)))


@dataclass(frozen=True)
class Solution:
    """What was found: coefficients (c,), their covariance, rows, excess (g), tau, and degrees of freedom of each.

    The coefficients are those of the laws, then the lag and the loops that were fitted beside them.
    """

    laws: Laws
    coefficients: Array
    covariance: Array
    rows: Rows
    excess: float
    excess_freedom: float
    scatter: Scatter
    by_tau: Array
    chi_square: float
    freedom: int
    converged: bool

    def degrees_of_freedom(self, weights: Array) -> float:
        """Return Satterthwaite's degrees of freedom of ``weights . coefficients``, which may be the first ones only."""
        n = len(weights)
        whole = float(weights @ self.covariance[:n, :n] @ weights)
        own = 1 / self.excess_freedom if np.isfinite(self.excess_freedom) else 0.0
        if self.scatter.rank:
            share = float(weights @ self.by_tau[:n, :n] @ weights) * self.scatter.spread[0] / max(whole, 1e-300)
            own += min(share, 1.0) ** 2 / self.scatter.rank
        return 1 / own if own > 0 else np.inf


def solve(problem: Problem, laws: Laws, *, tau: float | None = None) -> Solution:
    """Fit the laws; `tau` is the scatter of the biases from one power cycle to the next, g, if it is known."""
    still = replace(problem, free=())
    coefficients = _start(still, laws)
    if problem.free:  # a lag is the shift of laws that must be there first
        begun = _directions(still, laws, coefficients)
        coefficients = _iterate(still, laws, coefficients, begun, _LOOSE**2, np.zeros(2), 1e-6)[0]
        coefficients = np.append(coefficients, np.zeros(len(problem.free)))
    directions = _directions(problem, laws, coefficients)
    excess, excess_freedom, scatter, converged = 0.0, np.inf, Scatter(), False
    if tau is not None:
        scatter = Scatter(np.array([tau, 0.0]))
    for number in range(_PASSES):
        coefficients, directions, rows, converged = _iterate(
            problem, laws, coefficients, directions, excess, scatter.tau, _RESTS if number else 1e-6
        )
        if not converged:
            break
        before = excess, scatter.tau
        if number < _PASSES - 1:
            excess, excess_freedom = excess_of(rows, excess)
            if tau is None:
                scatter = between(rows, excess)
        if number and np.allclose([excess, *scatter.tau**2], [before[0], *before[1] ** 2], rtol=1e-3, atol=1e-16):
            break
    return concluded(laws, coefficients, rows, (excess, excess_freedom), scatter, converged=converged)


def concluded(
    laws: Laws, coefficients: Array, rows: Rows, excess: tuple[float, float], scatter: Scatter, *, converged: bool
) -> Solution:
    """Return what coefficients and rows at the end of a fit say; `excess` is a variance and its degrees of freedom."""
    white = whitener(rows, excess[0], scatter.tau)
    jacobian, residual = white(rows.jacobian), white(rows.residual)
    inverse = np.linalg.pinv(jacobian, rcond=1e-13)
    loading = inverse @ white(rows.offsets[0])
    count = len(coefficients)
    left = residual - jacobian @ (inverse @ residual)
    return Solution(
        laws, coefficients, (inverse @ inverse.T)[:count, :count], rows, float(np.sqrt(excess[0])), excess[1],
        scatter, (loading @ loading.T)[:count, :count], float(left @ left), len(residual) - jacobian.shape[1],
        converged,
    )  # fmt: skip


def _start(problem: Problem, laws: Laws) -> Array:
    """Return the coefficients to start from: those of a fit without temperature, its outliers not told yet."""
    flat = replace(laws, degrees=(0, 0, 0), knots=())
    start = nominal(flat, problem.zero)
    start, _, _, _ = _iterate(problem, flat, start, _directions(problem, flat, start), _LOOSE**2, np.zeros(2), 1e-3)
    return laws.constant(start)


def nominal(laws: Laws, zero: Array) -> Array:
    """Return the coefficients of an ideal sensor with these biases, shape (3,)."""
    return laws.constant(np.concatenate([zero, np.ones(3), np.zeros(3)]))


def _directions(problem: Problem, laws: Laws, coefficients: Array) -> Array:
    """Mean direction of each unmoved group at these coefficients."""
    count = int(problem.group.max(initial=-1)) + 1
    force, _ = forces(parameters_of(problem, laws, coefficients)[0], problem.reading)
    found = np.array([force[problem.group == k].mean(axis=0) for k in range(count)]).reshape(-1, 3)
    found /= np.linalg.norm(found, axis=1)[:, None]
    return found


def _iterate(
    problem: Problem, laws: Laws, coefficients: Array, directions: Array, excess: float, tau: Array, tolerance: float
) -> tuple[Array, Array, Rows, bool]:
    """Gauss-Newton steps with V as it is."""
    rows = linearise(problem, laws, coefficients, directions)
    for _ in range(_STEPS):
        white = whitener(rows, excess, tau)
        jacobian = white(rows.jacobian)
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        step = -np.linalg.lstsq(jacobian / scale, white(rows.residual), rcond=1e-11)[0] / scale
        coefficients = coefficients + step[: len(coefficients)]
        directions = _directions(problem, laws, coefficients)
        rows = linearise(problem, laws, coefficients, directions)
        if np.abs(step[: laws.size]).max() < tolerance:
            return coefficients, directions, rows, True
    return coefficients, directions, rows, False


def excess_of(rows: Rows, excess: float) -> tuple[float, float]:
    """Return the variance that magnitudes scatter with beyond their own, whatever power cycles did, and its freedom."""
    white = whitener(rows, excess, np.zeros(2))
    columns = white(np.hstack([rows.jacobian, rows.offsets[0]]))
    u, values, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    u = u[:, values > _SEEN * values[0]]
    given = white(rows.residual)
    left = given - u @ (u.T @ given)
    own = np.diag(rows.noise)
    spare = 1 - (u**2).sum(axis=1)
    used = rows.magnitude & (rows.owner >= 0)
    residual = left[used] * np.sqrt(own[used] + excess)
    found, freedom = plausible_excess(residual[None], own[used][None], spare[used][None])
    return float(found[0]), float(freedom[0])


def between(rows: Rows, excess: float) -> Scatter:
    """Return the scatter of biases between power cycles, and of scale factors where that is significant at 5 %."""
    white = whitener(rows, excess, np.zeros(2))
    residual, laws = white(rows.residual), white(rows.jacobian)
    bias, scale = (white(given) for given in rows.offsets)
    s, force = offset_modes(np.hstack([laws, bias]), scale, residual)
    second, probability = 0.0, None
    if len(s):
        probability = chi_square_probability(float((force**2).sum()), len(s))
        if probability < 0.05:
            second = _moments(s, force)
            white = whitener(rows, excess, np.array([0.0, second]))
            residual, laws, bias = white(rows.residual), white(rows.jacobian), white(rows.offsets[0])
    s, force = offset_modes(laws, bias, residual)
    if not len(s):
        return Scatter(np.array([0.0, second]), 0, np.zeros(2), probability)
    tau = _moments(s, force)
    typical = 1 / float(np.mean(s**2)) if len(s) else 0.0
    return Scatter(np.array([tau, second]), len(s), np.array([tau**2 + typical, 0.0]), probability)


def offset_modes(laws: Array, offsets: Array, residual: Array) -> tuple[Array, Array]:
    """Return the singular values of the offsets beside the laws, and what the residual has along each."""
    columns = laws / np.maximum(np.linalg.norm(laws, axis=0), 1e-300)
    u, values, _ = np.linalg.svd(columns, full_matrices=False)
    u = u[:, values > _SEEN * values[0]]
    beside = offsets - u @ (u.T @ offsets)
    v, s, _ = np.linalg.svd(beside, full_matrices=False)
    seen = s > _TELLS * np.linalg.norm(offsets, axis=0).max()
    return s[seen], v[:, seen].T @ (residual - u @ (u.T @ residual))


def _moments(s: Array, force: Array) -> float:
    """Return the tau at which ``sum force^2 / (1 + s^2 tau^2)`` is the number of terms; 0 where it is less at once."""
    if (force**2).sum() <= len(s):
        return 0.0
    low, high = 0.0, float(np.sqrt((force**2).sum())) / float(s.min())
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if (force**2 / (1 + (s * middle) ** 2)).sum() > len(s) else (low, middle)
    return 0.5 * (low + high)
