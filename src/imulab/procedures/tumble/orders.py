"""Which order of the model the attitudes support.

Nested orders are compared by F-test, by the Bayesian information criterion and by the error of each attitude predicted
from all others. The F-test and BIC alone have picked order 4 on real recordings where it predicts ten times worse than
order 2; prediction decides, by more than the error of the comparison, among the orders that the attitudes can see all
over the sphere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from imulab.estimation.least_squares import (
    Observability,
    bayesian_information,
    covariance,
    f_test,
    leverage,
    observability,
)
from imulab.procedures.tumble.advice import sphere_points
from imulab.procedures.tumble.choices import HIGHEST_ORDER
from imulab.procedures.tumble.model import norm_and_jacobian, parameter_count
from imulab.procedures.tumble.solve import Problem, Solution, leave_one_out, solve_norm, start_parameters
from imulab.recording import Array

_SIGNIFICANT = 0.05
_SIGNIFICANT_BEYOND = 0.01
"""For orders above 2: four tests at 5 % each would find something too often."""
_BLIND_SPOT = 4.0
"""Predicted standard uncertainty of |f| anywhere on the sphere, over the scatter at order 1, where an order guesses."""
_DIRECTIONS = 400
_ROUNDING = 1e-30
"""Smallest variance of |f| that is told from rounding, g^2."""
_NOTHING_KNOWN = 1e12
"""Inverse variance where no residual tells the noise: only the geometry is judged then."""


@dataclass(frozen=True)
class OrderRow:
    """One row of the table of orders; rms and leave-one-out error in m/s^2, as Huber's loss feels the residuals.

    `largest_uncertainty` is the predicted standard uncertainty of |f| where on the sphere it is largest, m/s^2.
    """

    order: int
    parameters: int
    degrees_of_freedom: int
    rms: float
    leave_one_out: float | None
    f_probability: float | None
    bic: float | None
    condition_number: float
    rank: int
    observable: bool
    largest_uncertainty: float | None

    @property
    def scatter(self) -> float:
        """Standard deviation of the residuals, m/s^2."""
        return self.rms * float(np.sqrt((self.degrees_of_freedom + self.parameters) / max(self.degrees_of_freedom, 1)))


@dataclass(frozen=True)
class OrderChoice:
    """The table of orders, lowest first, the order that it leads to, and the solution of each order that was fitted."""

    order: int
    rows: tuple[OrderRow, ...]
    solutions: Mapping[int, Solution]
    observability: Observability

    @property
    def solution(self) -> Solution:
        """That of the order chosen."""
        return self.solutions[self.order]


def solve_orders(problem: Problem) -> dict[int, Solution]:
    """Fit the orders that the attitudes are enough for: more than parameters, or as many at order 1."""
    n = problem.reading.shape[1]
    return {
        order: solve_norm(replace(problem, order=order))
        for order in range(1, HIGHEST_ORDER + 1)
        if n > parameter_count(order) or (order == 1 and n == parameter_count(1))
    }


def choose_order(problem: Problem, gravity: float, solutions: Mapping[int, Solution]) -> OrderChoice:
    """Compare orders 1 to 5 and choose the one that predicts best and can be observed.

    All orders are compared with the same weights: each attitude's own noise, with the excess that order 1 and 2 leave
    unexplained at most. A higher order is taken only if

    - the mean of its squared leave-one-out errors is below that of the order chosen so far by more than the standard
      error of the difference, each attitude weighted by 1 less its leverage: one that no other attitude is near is
      predicted badly by any order, and tells nothing of which is better,
    - the F-test finds its gain significant, at 5 % (1 % above order 2), against the order chosen so far and against
      the next lower one,
    - its predicted standard uncertainty of |f| is nowhere on the sphere above 4 times the scatter of the residuals at
      order 1 (their sum of squares over degrees of freedom).

    Parameters
    ----------
    problem
        Attitudes of one unit (a batch of one), as many as order 1 has parameters or more; its order is ignored.
    gravity
        Magnitude of gravity, m/s^2, the scale of the figures in the table.
    solutions
        From `solve_orders`.
    """
    n = problem.reading.shape[1]
    smallest = min((fit.excess[0] for order, fit in solutions.items() if order <= 2), default=0.0)
    trials = {order: replace(problem, order=order) for order in solutions}
    seen = {
        order: observability(fit.jacobian[0], absolute_weights(trials[order], fit)) for order, fit in solutions.items()
    }
    rows: list[OrderRow] = []
    chosen, best = 1, None
    costs: dict[int, float] = {}
    for order, fit in solutions.items():
        common = 1 / (fit.own_variance[0] + smallest**2)
        costs[order] = float((fit.down_weights[0] * common * fit.residuals[0] ** 2).sum())
        squares = _left_out_squares(trials[order], fit)
        row = _row(trials[order], fit, seen[order], costs, squares, gravity)
        rows.append(row)
        if not row.observable or squares is None:
            continue
        if best is None or (
            _smaller(squares, best, 1 - leverage(fit.jacobian, fit.weights)[0])
            and _significant(costs, chosen, order, n)
            and (row.largest_uncertainty or 0.0) <= _BLIND_SPOT * rows[0].scatter
        ):
            chosen, best = order, squares
    return OrderChoice(chosen, tuple(rows), solutions, seen[chosen])


def _left_out_squares(problem: Problem, fit: Solution) -> Array | None:
    """Squared error of each attitude predicted from the others, shape (n,); None where there is nothing to tell.

    What counts is psi, not the residual: a knocked attitude cannot be predicted by any order.
    """
    if problem.reading.shape[1] <= parameter_count(problem.order):
        return None
    squares: Array = (fit.down_weights[0] * leave_one_out(problem, fit)) ** 2
    return squares if np.isfinite(squares).all() else None


def _smaller(squares: Array, best: Array, weights: Array) -> bool:
    """Whether one mean of paired squares is below the other by more than the standard error of the difference."""
    gain = weights * (best - squares)
    return bool(gain.mean() > gain.std(ddof=1) / np.sqrt(len(gain)))


def _significant(costs: Mapping[int, float], chosen: int, order: int, n: int) -> bool:
    level = _SIGNIFICANT if order <= 2 else _SIGNIFICANT_BEYOND
    return all(
        f_test(costs[below], parameter_count(below), costs[order], parameter_count(order), n) < level
        for below in {chosen, order - 1}
    )


def _row(
    problem: Problem,
    fit: Solution,
    seen: Observability,
    costs: Mapping[int, float],
    squares: Array | None,
    gravity: float,
) -> OrderRow:
    order = problem.order
    size, n = parameter_count(order), problem.reading.shape[1]
    below = order - 1
    observable = seen.rank == size and bool(fit.converged[0])
    return OrderRow(
        order=order,
        parameters=size,
        degrees_of_freedom=n - size,
        rms=gravity * float(np.sqrt(np.mean((fit.down_weights[0] * fit.deviations[0]) ** 2))),
        leave_one_out=None if squares is None else gravity * float(np.sqrt(squares.mean())),
        f_probability=f_test(costs[below], parameter_count(below), costs[order], size, n) if below else None,
        bic=bayesian_information(costs[order], size, n),
        condition_number=seen.condition,
        rank=seen.rank,
        observable=observable,
        largest_uncertainty=gravity * _largest_uncertainty(problem, fit) if observable and n > size else None,
    )


def _largest_uncertainty(problem: Problem, fit: Solution) -> float:
    """Predicted standard uncertainty of |f|, in g, in the direction where it is largest."""
    points = sphere_points(_DIRECTIONS)[None]
    rows = norm_and_jacobian(start_parameters(problem.order), points, problem.order)[1][0]
    matrix = covariance(fit.jacobian, absolute_weights(problem, fit)[None])[0]
    return float(np.sqrt(np.einsum("ni,ij,nj->n", rows, matrix, rows, optimize=True).max()))


def absolute_weights(problem: Problem, fit: Solution) -> Array:
    """Weights in true inverse variances, shape (n,): where noise is unknown, its level comes from the residuals."""
    weights: Array = fit.weights[0] / max(fit.scale[0] ** 2, _ROUNDING)  # as many attitudes as parameters leave nothing
    n, size = problem.reading.shape[1], fit.theta.shape[1]
    if problem.covariance is None and n > size and not problem.robust:
        mean_square = float((weights * fit.residuals[0] ** 2).sum()) / (n - size)
        weights = weights / max(mean_square, _ROUNDING)
    elif problem.covariance is None and n <= size:
        weights = weights * _NOTHING_KNOWN
    return weights
