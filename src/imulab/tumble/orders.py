"""Which order of the model the attitudes support.

Nested orders are compared by F-test, by the Bayesian information criterion and by the error of each attitude predicted
from all others. The F-test and BIC alone have picked order 4 on real recordings where it predicts ten times worse than
order 2; prediction decides, among the orders that the attitudes can see at all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from imulab.estimate import Observability, bayesian_information, f_test, observability
from imulab.recording import Array
from imulab.tumble.model import HIGHEST_ORDER, parameter_count
from imulab.tumble.solve import Problem, Solution, leave_one_out, solve_norm

_SIGNIFICANT = 0.05
_SIGNIFICANT_BEYOND = 0.01
"""For orders above 2: four tests at 5 % each would find something too often."""
_ROUNDING = 1e-30
"""Smallest variance of |f| that is told from rounding, g^2."""
_NOTHING_KNOWN = 1e12
"""Inverse variance where no residual tells the noise: only the geometry is judged then."""


@dataclass(frozen=True)
class OrderRow:
    """One row of the table of orders; rms and leave-one-out error in m/s^2, as Huber's loss feels the residuals."""

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


@dataclass(frozen=True)
class OrderChoice:
    """The table of orders, lowest first, the order that it leads to, its solution and what that determines."""

    order: int
    rows: tuple[OrderRow, ...]
    solution: Solution
    observability: Observability


def choose_order(problem: Problem, gravity: float) -> OrderChoice:
    """Compare orders 1 to 5 and choose the one that predicts best and can be observed.

    All orders are compared with the same weights: each attitude's own noise, with the excess that order 1 and 2 leave
    unexplained at most. A higher order is taken only if it predicts better than the one chosen so far and the F-test
    finds its gain significant at 5 % (1 % above order 2).

    Parameters
    ----------
    problem
        Attitudes of one unit (a batch of one), as many as order 1 has parameters or more; its order is ignored.
    gravity
        Magnitude of gravity, m/s^2, the scale of the figures in the table.
    """
    n = problem.reading.shape[1]
    fits = {}
    for order in range(1, HIGHEST_ORDER + 1):
        if n > parameter_count(order) or (order == 1 and n == parameter_count(1)):
            trial = replace(problem, order=order)
            fits[order] = trial, solve_norm(trial)
    smallest = min((fit.excess[0] for order, (_, fit) in fits.items() if order <= 2), default=0.0)
    rows: list[OrderRow] = []
    seen = {order: observability(fit.jacobian[0], absolute_weights(trial, fit)) for order, (trial, fit) in fits.items()}
    chosen = 1
    best = np.inf
    costs: dict[int, float] = {}
    for order, (trial, fit) in fits.items():
        size = parameter_count(order)
        common = 1 / (fit.own_variance[0] + smallest**2)
        costs[order] = float((fit.down_weights[0] * common * fit.residuals[0] ** 2).sum())
        row = _row(trial, fit, seen[order], costs, gravity)
        rows.append(row)
        better = row.leave_one_out is not None and row.leave_one_out < best
        level = _SIGNIFICANT if order <= 2 else _SIGNIFICANT_BEYOND
        significant = order == 1 or f_test(costs[chosen], parameter_count(chosen), costs[order], size, n) < level
        if row.observable and better and significant:
            chosen, best = order, row.leave_one_out or np.inf
    return OrderChoice(chosen, tuple(rows), fits[chosen][1], seen[chosen])


def _row(problem: Problem, fit: Solution, seen: Observability, costs: dict[int, float], gravity: float) -> OrderRow:
    order = problem.order
    size, n = parameter_count(order), problem.reading.shape[1]
    predicted: float | None = None
    if n > size:
        errors = leave_one_out(problem, fit)
        # What counts is psi, not the residual: a knocked attitude cannot be predicted by any order.
        felt = fit.down_weights[0] * errors
        predicted = gravity * float(np.sqrt(np.mean(felt**2)))
        predicted = predicted if np.isfinite(predicted) else None
    below = order - 1
    return OrderRow(
        order=order,
        parameters=size,
        degrees_of_freedom=n - size,
        rms=gravity * float(np.sqrt(np.mean((fit.down_weights[0] * fit.deviations[0]) ** 2))),
        leave_one_out=predicted,
        f_probability=f_test(costs[below], parameter_count(below), costs[order], size, n) if below else None,
        bic=bayesian_information(costs[order], size, n),
        condition_number=seen.condition,
        rank=seen.rank,
        observable=seen.rank == size and bool(fit.converged[0]),
    )


def absolute_weights(problem: Problem, fit: Solution) -> Array:
    """Weights in true inverse variances, shape (n,): where noise is unknown, its level comes from the residuals."""
    weights: Array = fit.weights[0] / max(fit.scale[0] ** 2, _ROUNDING)  # as many attitudes as parameters leave nothing
    n, size = problem.reading.shape[1], parameter_count(problem.order)
    if problem.covariance is None and n > size and not problem.robust:
        mean_square = float((weights * fit.residuals[0] ** 2).sum()) / (n - size)
        weights = weights / max(mean_square, _ROUNDING)
    elif problem.covariance is None and n <= size:
        weights = weights * _NOTHING_KNOWN
    return weights
