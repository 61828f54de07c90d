"""The default estimator of a tumble test, for batches of problems in units of g.

`solve_norm` minimises ``sum_p w_p (|f(M_p)| - 1)^2`` with the model inverted exactly; the published first-order
iteration (linearised.py) returns the same `Solution`.

Noise-length term: second-order expansion of |f + e|.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.least_squares import (
    Fit,
    huber_weights,
    leverage,
    plausible_excess,
    robust_scale,
)
from imulab.procedures.tumble.attitudes import Motion
from imulab.procedures.tumble.model import (
    fit_lengths,
    left_out_lengths,
    length_noise,
    norm_and_jacobian,
    parameter_count,
)
from imulab.recording import Array

REWEIGHTING_PASSES = {False: 4, True: 30}
WEIGHTS_AT_REST = 1e-4
_FIT_STEPS = 40
_REFIT_STEPS = 15  # without one attitude of many the solution is near; what wanders for longer is not determined
_REFIT_AT_MOST = 150
_REFIT_TOLERANCE = 1e-7  # the next step would be a thousandth of it, or less


@dataclass(frozen=True)
class Prior:
    """Earlier knowledge of the scaled parameters: normal, as observations ``rows (theta - mean) = 0 ± 1``.

    `mean` has shape (p,), `rows` shape (q, p), with ``rows' rows`` the inverse of the covariance.
    """

    mean: Array
    rows: Array


@dataclass(frozen=True)
class Problem:
    """Attitudes of a batch of units, scaled: outputs less a nominal zero, over a nominal scale, in units of g.

    Attributes
    ----------
    reading
        Shape (b, n, 3).
    covariance
        Of each mean, shape (b or 1, n, 3, 3), in g^2; None where nothing is known.
    order
        Order of the model.
    robust
        Huber's loss instead of squares.
    excess
        Whether the attitudes get the common further variance that their scatter makes plausible.
    prior
        Earlier knowledge of the parameters.
    cross
        Whether the model has cross terms.
    motion
        How the attitudes moved while they were held, in g and g^2; None where nothing is known of it.
    """

    reading: Array
    covariance: Array | None
    order: int
    robust: bool = False
    excess: bool = True
    prior: Prior | None = None
    cross: bool = False
    motion: Motion | None = None

    def only(self, which: NDArray[Any]) -> Problem:
        """Return the problem with some of its attitudes, by index or mask of shape (n,)."""
        return replace(
            self,
            reading=self.reading[:, which],
            covariance=None if self.covariance is None else self.covariance[:, which],
            motion=None if self.motion is None else self.motion[which],
        )

    def held_still(self, solution: Solution) -> Problem:
        """Return attitudes that do not move, whose magnitudes and noise are those that this problem was solved with."""
        if self.motion is None:
            return self
        q = -solution.jacobian[:, :, :3]
        square = (q**2).sum(axis=2)
        shift = solution.lengthening / square
        noise = solution.own_variance / square
        return replace(
            self,
            reading=self.reading - shift[:, :, None] * q,
            covariance=noise[:, :, None, None] * np.eye(3),
            motion=None,
        )


@dataclass(frozen=True)
class Solution:
    """Solutions of a batch of problems, in units of g.

    Attributes
    ----------
    theta
        Zero, relative scale factor, misalignment, nonlinearity, shape (b, p).
    residuals
        |f| - 1 less the lengthening by noise, shape (b, n).
    deviations
        |f| - 1 as it is, shape (b, n); of the mean magnitude where the attitudes move.
    lengthening
        By how much noise makes |f| too long, less what motion makes it too short, shape (b, n).
    jacobian
        Of |f|, shape (b, n, p).
    variance
        Of |f| in each attitude, own and excess, shape (b, n); ones where noise is unknown.
    own_variance
        Without excess.
    down_weights
        Huber's factors, shape (b, n), ones without robust loss.
    scale
        Standard deviation that residuals were standardised with, in units of sqrt(variance), shape (b,).
    excess
        Standard deviation added to each attitude, shape (b,).
    freedom
        Effective degrees of freedom of `variance`, shape (b,): infinite where the attitudes' own noise is all.
    iterations, converged
        Shape (b,).
    """

    theta: Array
    residuals: Array
    deviations: Array
    lengthening: Array
    jacobian: Array
    variance: Array
    own_variance: Array
    down_weights: Array
    scale: Array
    excess: Array
    freedom: Array
    iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]

    @property
    def weights(self) -> Array:
        """Weights of the last pass, shape (b, n)."""
        return self.down_weights / self.variance

    def standardised(self) -> Array:
        """Residuals over their standard deviations, shape (b, n)."""
        return self.residuals / (np.sqrt(self.variance) * self.scale[:, None])


def start_parameters(order: int, count: int = 1, cross: bool = False) -> Array:
    """Return the nominal sensor as a start, shape (count, p)."""
    theta = np.zeros((count, parameter_count(order, cross)))
    theta[:, 3:6] = 1.0
    return theta


def solve_norm(problem: Problem, start: Array | None = None) -> Solution:
    """Fit |f| = 1 by weighted least squares, or with Huber's loss.

    Weights are ``1 / (q' C q + tau^2)``, q = d|f|/dM: each attitude's own noise along its own vertical, and what the
    attitudes scatter beyond it (`plausible_excess`). They and the lengthening of |f| by noise across it are recomputed
    at the solution and the fit is repeated until they rest (at most 4 passes, 30 with Huber's loss).

    Parameters
    ----------
    problem
        The attitudes.
    start
        Start parameters, shape (b, p); the nominal sensor if not given.
    """
    count, n, _ = problem.reading.shape
    theta = start_parameters(problem.order, count, problem.cross) if start is None else start
    size = theta.shape[1]
    lengthening, own = magnitude_noise(problem, theta)
    variance, down, scale = own, np.ones((count, n)), np.ones(count)
    excess, freedom = np.zeros(count), np.full(count, np.inf)
    iterations = np.zeros(count, dtype=np.int64)
    repeat = problem.robust or problem.covariance is not None
    for number in range(REWEIGHTING_PASSES[problem.robust] if repeat else 1):
        # The first pass only has to be good enough to weigh by.
        fit = _least_squares(problem, theta, down / variance, lengthening, 1e-9 if number or not repeat else 1e-4)
        iterations += fit.iterations
        theta, before = fit.parameters, down / variance
        lengthening, own = magnitude_noise(problem, theta, fit.jacobian)
        residuals = fit.residuals
        if problem.covariance is not None and problem.excess and not problem.robust:
            excess, freedom = plausible_excess(residuals, own, 1 - leverage(fit.jacobian, 1 / variance))
        variance = own + excess[:, None]
        if problem.robust:
            standard = residuals / np.sqrt(variance * np.maximum(1 - leverage(fit.jacobian, down / variance), 0.05))
            measured = robust_scale(residuals / np.sqrt(variance), size)
            scale = np.maximum(measured, 1.0) if problem.covariance is not None else measured
            down = huber_weights(standard / np.maximum(scale, 1e-12)[:, None])
        if np.abs(down / variance / before - 1).max() < WEIGHTS_AT_REST:
            break
    if problem.covariance is None:
        lengthening = np.repeat(_mean_square(fit, down, size)[:, None], n, axis=1)
        fit = _least_squares(problem, theta, down / variance, lengthening)
        theta = fit.parameters
    return Solution(
        theta=theta,
        residuals=fit.residuals,
        deviations=fit.residuals + (0.0 if problem.motion is not None else lengthening),
        lengthening=lengthening,
        jacobian=fit.jacobian,
        variance=variance,
        own_variance=own,
        down_weights=down,
        scale=scale,
        excess=np.sqrt(excess),
        freedom=freedom,
        iterations=iterations,
        converged=fit.converged,
    )


def _least_squares(problem: Problem, theta: Array, weights: Array, lengthening: Array, tolerance: float = 1e-9) -> Fit:
    return fit_lengths(
        theta, problem.reading, weights, lengthening, problem.order, tolerance=tolerance, most=_FIT_STEPS
    )


def informed_rows(problem: Problem, jacobian: Array, weights: Array) -> tuple[Array, Array]:
    """Return Jacobian (n + q, p) and weights (n + q,) of one problem with the rows of its prior."""
    if problem.prior is None:
        return jacobian, weights
    return np.vstack([jacobian, problem.prior.rows]), np.concatenate([weights, np.ones(len(problem.prior.rows))])


def data_freedom(problem: Problem, jacobian: Array, weights: Array) -> float:
    """Return attitudes less the parameters that they, rather than the prior, determine: ``n - tr(H^-1 J' W J)``."""
    n, size = jacobian.shape
    if problem.prior is None:
        return float(n - size)
    information = jacobian.T @ (jacobian * weights[:, None])
    whole = information + problem.prior.rows.T @ problem.prior.rows
    return float(n - np.trace(np.linalg.solve(whole, information)))


def _mean_square(fit: Fit, down: Array, size: int) -> Array:
    """Variance of |f| from the residuals, shape (b,): without better knowledge, that of every component of f."""
    count = fit.residuals.shape[1]
    used: Array = (down * fit.residuals**2).sum(axis=1) / max(count - size, 1)
    return used


def magnitude_noise(problem: Problem, theta: Array, jacobian: Array | None = None) -> tuple[Array, Array]:
    """Return by how much noise lengthens |f|, and the variance of |f|, shapes (b, n)."""
    if problem.covariance is None:
        return np.zeros(problem.reading.shape[:2]), np.ones(problem.reading.shape[:2])
    if jacobian is None:
        jacobian = norm_and_jacobian(theta, problem.reading, problem.order)[1]
    return length_noise(theta, jacobian, problem.covariance, problem.motion)


def evaluate(problem: Problem, solution: Solution) -> Solution:
    """Return residuals, Jacobian and variances of all attitudes under a solution for some of them, a batch of one.

    The excess variance is the solution's; down-weights are ones.
    """
    norm, jacobian, _, _ = norm_and_jacobian(solution.theta, problem.reading, problem.order)
    lengthening, own = magnitude_noise(problem, solution.theta, jacobian)
    if problem.covariance is None:
        lengthening = lengthening + solution.lengthening[:, :1]
    residuals = norm - 1 - lengthening
    return replace(
        solution,
        residuals=residuals,
        deviations=residuals if problem.motion is not None else norm - 1,
        lengthening=lengthening,
        jacobian=jacobian,
        variance=own + solution.excess[:, None] ** 2,
        own_variance=own,
        down_weights=np.ones(norm.shape),
    )


def forces(problem: Problem, solution: Solution) -> Array:
    """Return the specific force in each attitude, units of g, shape (b, n, 3)."""
    return norm_and_jacobian(solution.theta, problem.reading, problem.order)[2]


def leave_one_out(problem: Problem, solution: Solution) -> Array:
    """Return the error |f| - 1 of each attitude under the fit to all others, shape (n,), for a batch of one.

    The n refits have the weights of the whole fit and no prior. Beyond some hundred attitudes no single one moves the
    fit, and the linear formula r / (1 - h) is exact enough.
    """
    if problem.reading.shape[1] > _REFIT_AT_MOST or problem.cross:
        errors: Array = (solution.residuals / (1 - leverage(solution.jacobian, solution.weights)))[0]
        return errors
    return left_out_lengths(
        solution.theta, problem.reading, solution.weights, solution.lengthening, problem.order,
        tolerance=_REFIT_TOLERANCE, most=_REFIT_STEPS,
    )  # fmt: skip
