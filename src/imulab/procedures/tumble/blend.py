"""The uncertainty of a triad whatever the order of its nonlinearity: orders 1 to 3, or to the chosen one, blended.

An order chosen from the data states an uncertainty as if it were right. Here all orders that the attitudes show are
fitted with the same weights, each step from one to the next is shrunk by the share of it that is likely to be noise
(`imulab.estimation.order_blend`), and the chosen values are stated with
``V + (theta_chosen - theta)(theta_chosen - theta)'``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from imulab.estimation.least_squares import Fit, covariance, huber_inflation
from imulab.estimation.order_blend import blend
from imulab.procedures.tumble.model import fit_lengths, norm_and_jacobian, parameter_count
from imulab.procedures.tumble.orders import OrderChoice
from imulab.procedures.tumble.solve import Problem, Solution
from imulab.recording import Array

HIGHEST_BLENDED = 3
_UNSEEN = 10.0
"""Factor by which a step raises the uncertainty of a bias or scale factor from which the attitudes do not show it."""
_LEAST_FREEDOM = 2
_TOLERANCE, _STEPS = 1e-9, 40
_PASSES = 8
_TINY = 1e-300


@dataclass(frozen=True)
class Blended:
    """What the orders say together, in units of g.

    Attributes
    ----------
    theta, covariance
        Scaled parameters up to `order`, shape (p,), and their covariance.
    order
        Highest order that counts.
    freedom
        Degrees of freedom of the noise where it was estimated, else None.
    noise
        Share of each step that is noise, by the order that it leads to.
    assumed
        For each order up to 3 that the attitudes do not show: the largest change of a bias and of a scale factor by
        one unit of one axis's coefficient.
    """

    theta: Array
    covariance: Array
    order: int
    freedom: float | None
    noise: Mapping[int, float]
    assumed: Mapping[int, tuple[float, float]]

    def about(self, theta: Array) -> Array:
        """Return the covariance of other values, of this order or a lower one, shape (p,): ``V + d d'``."""
        size = len(theta)
        away = theta - self.theta[:size]
        return np.asarray(self.covariance[:size, :size] + np.outer(away, away))


def blend_orders(problem: Problem, choice: OrderChoice) -> Blended:
    """Blend the orders from 1 to 3, or to the chosen one where that is higher, as far as the attitudes show them.

    Parameters
    ----------
    problem
        Attitudes of one unit (a batch of one); its order is ignored.
    choice
        From `choose_order`.
    """
    top = _highest_shown(problem, choice)
    solution = choice.solutions[top]
    fits = {order: _refit(problem, choice.solutions[order], solution, order) for order in range(1, top + 1)}
    n, size = problem.reading.shape[1], parameter_count(top)
    costs = {order: float((fit.weights[0] * fit.residuals[0] ** 2).sum()) for order, fit in fits.items()}
    scale, freedom = _noise(problem, solution, costs[top], n - size)
    jacobian, weights = fits[top].jacobian, 1 / solution.variance
    values, covariances = np.zeros((top, size)), np.zeros((top, size, size))
    for order, fit in fits.items():
        p = parameter_count(order)
        values[order - 1, :p] = fit.parameters[0]
        covariances[order - 1, :p, :p] = covariance(jacobian[:, :, :p], weights)[0]
    gains = [costs[order - 1] - costs[order] for order in range(2, top + 1)]
    found = blend(values, covariances, gains, [3] * (top - 1), scale=scale, freedom=freedom)
    return Blended(
        found.values,
        found.covariance,
        top,
        freedom,
        dict(zip(range(2, top + 1), found.noise.tolist(), strict=True)),
        {order: _effect_of_left_out(problem, solution, order) for order in range(top + 1, HIGHEST_BLENDED + 1)},
    )


def with_known_spread(problem: Problem, choice: OrderChoice, spread: tuple[float, float]) -> Blended:
    """Return what all orders say where k2 and k3 are normal about 0 with known standard deviations.

    ``theta = (J' W J / s^2 + P)^-1 J' W y / s^2`` with ``P = diag(0 .., tau_2^-2, tau_3^-2)``; s^2 is 1, or where noise
    is unknown estimated from ``n - tr(V J' W J / s^2)`` degrees of freedom.

    Parameters
    ----------
    problem, choice
        As for `blend_orders`.
    spread
        tau_2 and tau_3, in units of g.
    """
    top = max(HIGHEST_BLENDED, choice.order)
    n, size, start = problem.reading.shape[1], parameter_count(top), choice.solution
    theta = np.zeros((1, size))
    theta[0, : start.theta.shape[1]] = start.theta[0]
    precision = np.zeros(size)
    precision[9:15] = np.repeat(1 / np.square(spread), 3)
    weights, lengthening = start.weights[0], start.lengthening[0]
    cost, left = float((weights * start.residuals[0] ** 2).sum()), max(n - start.theta.shape[1], 1)
    scale, freedom = _noise(problem, start, cost, left)
    matrix = np.zeros((size, size))
    for _ in range(_PASSES):
        norm, rows, _, _ = norm_and_jacobian(theta, problem.reading, top)
        information = rows[0].T @ (rows[0] * weights[:, None])
        gradient = rows[0].T @ (weights * (norm[0] - 1 - lengthening)) + scale * precision * theta[0]
        whole = information + scale * np.diag(precision)
        root = np.sqrt(np.diag(whole))
        inverse = np.linalg.inv(whole / np.outer(root, root)) / np.outer(root, root)
        matrix = scale * inverse
        theta = theta - (inverse @ gradient)[None]
        if problem.covariance is None and not problem.robust:
            residuals = norm_and_jacobian(theta, problem.reading, top)[0][0] - 1 - lengthening
            freedom = max(n - float(np.trace(inverse @ information)), 1.0)
            scale = max(float((weights * residuals**2).sum()) / freedom, _TINY)
    return Blended(theta[0], matrix, top, freedom, {}, {})


def _highest_shown(problem: Problem, choice: OrderChoice) -> int:
    """The highest order up to 3 whose steps the attitudes show, or the chosen one."""
    n = problem.reading.shape[1]
    least = 0 if problem.covariance is not None and not problem.robust else _LEAST_FREEDOM
    shown = 1
    for row in choice.rows[1:HIGHEST_BLENDED]:
        if not row.observable or n - row.parameters < least:
            break
        solution = choice.solutions[row.order]
        below = covariance(solution.jacobian[:, :, : parameter_count(row.order - 1)], 1 / solution.variance)[0]
        above = covariance(solution.jacobian, 1 / solution.variance)[0]
        if (np.diag(above)[:6] > _UNSEEN**2 * np.diag(below)[:6]).any():
            break
        shown = row.order
    return max(shown, choice.order)


def _refit(problem: Problem, start: Solution, common: Solution, order: int) -> Fit:
    """Fit an order with the weights, and the lengthening of |f|, of another."""
    return fit_lengths(
        start.theta, problem.reading, common.weights, common.lengthening, order, tolerance=_TOLERANCE, most=_STEPS
    )


def _noise(problem: Problem, solution: Solution, cost: float, left: float) -> tuple[float, float | None]:
    """Variance of the attitudes over that of the solution, and its degrees of freedom; None where it is known."""
    if problem.robust and left > 0:
        factor = float(huber_inflation(solution.standardised(), solution.theta.shape[1])[0])
        return factor * float(solution.scale[0] ** 2), float(left)
    if problem.covariance is None and left > 0:
        return max(cost / left, _TINY), float(left)
    return 1.0, float(solution.freedom[0]) if np.isfinite(solution.freedom[0]) else None


def _effect_of_left_out(problem: Problem, solution: Solution, order: int) -> tuple[float, float]:
    """``(J'WJ)^-1 J'W J_k``: largest change of a bias and of a scale factor by one unit of a k that is left out."""
    theta = np.zeros((1, parameter_count(order)))
    theta[:, : solution.theta.shape[1]] = solution.theta
    left_out = norm_and_jacobian(theta, problem.reading, order)[1][0, :, -3:]
    pull = solution.jacobian[0].T @ (left_out / solution.variance[0][:, None])
    moved = np.abs(covariance(solution.jacobian, 1 / solution.variance)[0] @ pull)
    return float(moved[0:3].max()), float(moved[3:6].max())
