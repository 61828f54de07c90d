"""The published first-order iteration of a tumble test (method ``linearised``), and the source's rules for it.

Source: the method's patent, its equation (4) with the products paired as docs/tumble_method.md says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from imulab.errors import DataError
from imulab.estimation.least_squares import leverage, plausible_excess
from imulab.procedures.tumble.model import norm_and_jacobian
from imulab.procedures.tumble.solve import (
    REWEIGHTING_PASSES,
    WEIGHTS_AT_REST,
    Problem,
    Solution,
    magnitude_noise,
    start_parameters,
)
from imulab.recording import Array
from imulab.units import from_si

_PASSES = 50
_DIVERGED = 0.98
"""A relative change of scale, or of bias in g, after which the linear step cannot be meant."""


@dataclass(frozen=True)
class Threshold:
    """Changes from one pass to the next below which the iteration rests: relative, in g, and in rad."""

    scale_factor: float
    bias: float
    misalignment: float

    def in_si(self, gravity: float) -> list[float]:
        """Return the three in SI: 1, m/s^2 and rad."""
        return [self.scale_factor, self.bias * gravity, self.misalignment]

    def describe(self) -> str:
        """Return the three as a person reads them."""
        angle = from_si(self.misalignment, "arcsec")
        return f"{1e6 * self.scale_factor:.3g} ppm, {1e6 * self.bias:.3g} ug, {angle:.3g} arcsec"


SOURCE_THRESHOLD = Threshold(5e-6, 2e-6, 3 / 3600 * np.pi / 180)


def solve_linearised(problem: Problem, name: str, threshold: Threshold = SOURCE_THRESHOLD) -> Solution:
    """Run the published first-order iteration for a batch of one; weights and excess variance as for `solve_norm`.

    ``sum_i sum_j d_ji a_i^(j+1) + m_1 a_x a_y + m_2 a_y a_z + m_3 a_z a_x = (|B|^2 - 1) / 2``, solved by linear least
    squares until every change is below the threshold. The misalignments m_1, m_2, m_3 are the model's m_yx, m_zy, m_zx.

    Raises
    ------
    DataError
        The iteration does not converge, or ends where the model cannot be inverted.
    """
    lengthening, own = magnitude_noise(problem, start_parameters(problem.order))
    theta, passes = _linearised_iteration(problem, lengthening[0], own[0], name, threshold)
    solution = _evaluated(problem, theta, passes, name)
    if problem.covariance is None:
        return solution
    for _ in range(REWEIGHTING_PASSES[False]):
        before = solution.excess
        spare = 1 - leverage(solution.jacobian, solution.weights)
        excess, freedom = plausible_excess(solution.residuals, solution.own_variance, spare)
        variance = solution.own_variance[0] + excess
        theta, passes = _linearised_iteration(problem, solution.lengthening[0], variance, name, threshold)
        solution = _evaluated(problem, theta, passes, name)
        total = solution.own_variance + excess[:, None]
        solution = replace(solution, variance=total, excess=np.sqrt(excess), freedom=freedom)
        if np.abs(solution.excess - before).max() <= WEIGHTS_AT_REST * solution.excess.max():
            break
    return solution


def _linearised_iteration(
    problem: Problem, lengthening: Array, variance: Array, name: str, threshold: Threshold
) -> tuple[Array, int]:
    """Repeat the linear step until it rests; return theta, shape (1, p), and the number of passes."""
    order = problem.order
    root = 1 / np.sqrt(variance)
    reading = problem.reading[0]
    bias, scale, misalignment = np.zeros(3), np.ones(3), np.zeros(3)
    for number in range(1, _PASSES + 1):
        a = reading / scale - bias
        x = a[:, 0]
        y = a[:, 1] - misalignment[0] * x
        z = a[:, 2] - misalignment[1] * x - misalignment[2] * y
        products = np.column_stack([a[:, 0] * a[:, 1], a[:, 2] * a[:, 0], a[:, 1] * a[:, 2]])
        design = np.column_stack([*(a ** (j + 1) for j in range(order + 1)), products])
        right = (x * x + y * y + z * z - 1) / 2 - lengthening
        solution = np.linalg.lstsq(design * root[:, None], right * root, rcond=None)[0]
        change = solution[: 3 * (order + 1)].reshape(order + 1, 3)
        bias = bias + change[0]
        scale = scale * (1 + change[1])
        misalignment = misalignment + solution[3 * (order + 1) :]
        if not (np.abs(change[:2]).max() < _DIVERGED and np.isfinite(solution).all()):
            break
        moved = Threshold(*(float(np.abs(part).max()) for part in (change[1], change[0], solution[3 * (order + 1) :])))
        if (
            moved.scale_factor < threshold.scale_factor
            and moved.bias < threshold.bias
            and (moved.misalignment < threshold.misalignment)
        ):
            theta = np.concatenate([scale * bias, scale, misalignment, change[2:].ravel()])[None]
            return theta, number
    else:
        raise DataError(
            f"{name}: method linearised is not at rest after {_PASSES} passes: the last one changed parameters by "
            f"{moved.describe()}, the threshold is {threshold.describe()}; use a larger threshold or method norm"
        )
    raise DataError(
        f"{name}: method linearised does not converge on these attitudes (after {number} passes); use --method norm"
    )


def _evaluated(problem: Problem, theta: Array, iterations: int, name: str) -> Solution:
    """Wrap parameters of the linearised iteration as a solution."""
    norm, jacobian, _, _ = norm_and_jacobian(theta, problem.reading, problem.order)
    if not np.isfinite(norm).all():
        raise DataError(
            f"{name}: method linearised ends at a nonlinearity under which no specific force leads to some of these "
            "attitudes; use --method norm"
        )
    lengthening, own = magnitude_noise(problem, theta, jacobian)
    n = norm.shape[1]
    return Solution(
        theta=theta,
        residuals=norm - 1 - lengthening,
        deviations=norm - 1 - (lengthening if problem.motion is not None else 0.0),
        lengthening=lengthening,
        jacobian=jacobian,
        variance=own,
        own_variance=own,
        down_weights=np.ones((1, n)),
        scale=np.ones(1),
        excess=np.zeros(1),
        freedom=np.full(1, np.inf),
        iterations=np.array([iterations]),
        converged=np.array([True]),
    )
