"""The uncertainty of a triad whatever the order of its nonlinearity, and whether or not + and - differ.

An order chosen from the data states an uncertainty as if it were right. Here all orders that the attitudes show are
fitted with the same weights, each step from one to the next is shrunk by the share of it that is likely to be noise
(`imulab.estimation.least_squares`), and the chosen values are stated with
``V + (theta_chosen - theta)(theta_chosen - theta)'``.

A scale factor that differs by 2 q between positive and negative input shows as u |u| what k2 shows as u^3: the two are
nearly alike. It is a second explanation of what is seen as k2, of unknown size: orders 1 to 3 (or to the chosen one)
are blended for each size of q, and averaged by how probable they make the attitudes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec import Struct

from imulab.estimation.least_squares import (
    Blend,
    Fit,
    blend,
    huber_inflation,
    inverse_root,
)
from imulab.estimation.rows import median
from imulab.procedures.tumble.model import fit_lengths, norm_and_jacobian, parameter_count
from imulab.procedures.tumble.orders import OrderChoice
from imulab.procedures.tumble.solve import (
    TumbleProblem,
    TumbleSolution,
)
from imulab.recording import Array

HIGHEST_BLENDED = 3  # order that the blend allows for: k3; higher ones are taken where they are seen
_UNSEEN = 10.0
"""Factor by which a step raises the uncertainty of a bias or scale factor from which the attitudes do not show it."""
_LEAST_FREEDOM = 2  # degrees of freedom that an order must leave where the noise is estimated
_TOLERANCE, _STEPS = 1e-9, 40  # of a fit in scaled parameters, and its most steps
_BLEND_PASSES = 8  # in which noise, weights and order agree
_AT_REST, _NOISE_AT_REST = 1e-10, 1e-8
"""Change of scaled parameters, and relative one of their noise, below which they do: a pass leaves a hundredth."""
_LEAST_VARIANCE = 1e-40  # g^2, far below that of rounding: stands for a variance of 0
_SIZES = (np.geomspace(5e-6, 5e-3, 7), 40e-6)
"""Sizes of k2 and k3 before the data, in units of g: the grid and the half width of a half-Cauchy distribution."""
_ASYMMETRIES = (np.geomspace(20e-6, 5e-3, 9), 250e-6)  # the same of q
_SYMMETRIC, _LINEAR = 0.4, 0.3  # how probable before the data q = 0 is, and k2 = 0, and k3 = 0
_BIAS_WIDER = 1.1
"""Calibrated: at a noise of 60 µg q of 200 ppm is hardly seen, and moves biases by 150 µg."""
USUAL_NONLINEARITY = 20e-6  # of k2 and k3, in units of g: knowledge whose gain is stated
_LIKELY = 0.05
"""Share of the sets of terms from which one counts as an explanation of the attitudes, and below which none does."""


class Asymmetry(Struct, frozen=True):
    """Two explanations of the same attitudes: k2, or a scale factor of 1 + q for positive and 1 - q for negative input.

    Attributes
    ----------
    size
        Largest q, where it explains them.
    bias
        Largest difference of a bias between the two, g.
    alike
        Whether the attitudes need one of the two, and do not tell which.
    """

    size: float
    bias: float
    alike: bool


class Blended(Struct, frozen=True):
    """Blend of the fits of all orders, in units of g.

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
    asymmetry
        k2 and q as explanations of the same; None where the attitudes do not show k2.
    narrower
        How many times biases and scale factors would be narrower with k2 and k3 known to 20 µg; None if told or unseen.
    asymmetry_as_k2
        Standard deviation of q, relative, where it was taken as that of k2, since only the latter is stated.
    """

    theta: Array
    covariance: Array
    order: int
    freedom: float | None
    noise: Mapping[int, float]
    assumed: Mapping[int, tuple[float, float]]
    asymmetry: Asymmetry | None = None
    narrower: Mapping[str, float] | None = None
    asymmetry_as_k2: float | None = None

    def about(self, theta: Array) -> Array:
        """Return the covariance of other values, of this order or a lower one, shape (p,): ``V + d d'``."""
        size = len(theta)
        away = theta - self.theta[:size]
        return np.asarray(self.covariance[:size, :size] + np.outer(away, away))


def blend_orders(problem: TumbleProblem, choice: OrderChoice, asymmetry: float | None = None) -> Blended:
    """Blend the orders from 1 to 3, or to the chosen one where that is higher, as far as the attitudes show them.

    A scale factor that differs by 2 q between + and - is scatter of the attitudes that it makes depend on each other,
    ``C = W^-1 + tau^2 Q Q'``, Q the derivatives by q. The orders are blended for each tau of a grid, and these blends
    averaged by how probable they make the attitudes. q is no term of a model of its own: it is told from k2 only where
    it is 20 times the noise of an attitude, while taken for k2 it moves a bias by a third of itself.

    Parameters
    ----------
    problem
        Attitudes of one unit (a batch of one); its order is ignored.
    choice
        From `choose_order`.
    asymmetry
        Standard deviation of q, if known.
    """
    top = _highest_shown(problem, choice)
    solution = choice.solutions[top]
    fits = {order: _refit(problem, choice.solutions[order], solution, order) for order in range(1, top + 1)}
    n, size = problem.reading.shape[1], parameter_count(top)
    cost = float((fits[top].weights[0] * fits[top].residuals[0] ** 2).sum())
    scale, freedom = _noise(problem, solution, cost, n - size)
    root = np.sqrt(scale * solution.variance[0])
    rows = np.hstack([fits[top].jacobian[0], _asymmetry_columns(problem, fits[top].parameters, top)])
    beside = _Beside(
        rows / root[:, None],
        [(fit.parameters[0], solution.down_weights[0] * fit.residuals[0] / root) for fit in fits.values()],
        freedom,
        range(9, min(size, parameter_count(HIGHEST_BLENDED))),
    )
    of_sizes = beside.shares() if top > 1 and asymmetry is None else None
    averaged = beside.average(of_sizes, asymmetry or 0.0)
    wider = np.where(np.arange(size) < 3, 1.0 if of_sizes is None else _BIAS_WIDER, 1.0)
    matrix = averaged.covariance * np.outer(wider, wider)
    return Blended(
        averaged.values,
        matrix,
        top,
        freedom,
        dict(zip(range(2, top + 1), averaged.noise.tolist(), strict=True)),
        {order: _effect_of_left_out(problem, solution, order) for order in range(top + 1, HIGHEST_BLENDED + 1)},
        None if of_sizes is None else beside.two_explanations(of_sizes),
        None if of_sizes is None else _narrower(problem, choice, matrix),
    )


def _narrower(problem: TumbleProblem, choice: OrderChoice, matrix: Array) -> dict[str, float]:
    """Return by how much less uncertain the middle bias and scale factor are with k2 and k3 known to 20 µg."""
    known = with_known_spread(problem, choice, (USUAL_NONLINEARITY, USUAL_NONLINEARITY)).covariance
    ratio = np.sqrt(np.diag(matrix)[:6] / np.diag(known)[:6])
    return {"bias": median(ratio[:3]), "scale_factor": median(ratio[3:])}


def _asymmetry_columns(problem: TumbleProblem, theta: Array, order: int) -> Array:
    """Return the derivatives of |f| by q of each axis, shape (n, 3): ``A_i = s_i + q_i |s_i|``."""
    _, jacobian, force, _ = norm_and_jacobian(theta, problem.reading, order)
    s = force[0] @ np.array([[1.0, theta[0, 6], theta[0, 7]], [0.0, 1.0, theta[0, 8]], [0.0, 0.0, 1.0]])
    return np.asarray(jacobian[0, :, 0:3] * theta[0, 3:6] * np.abs(s))


def _half_cauchy(grid: Array, width: float, none: float) -> tuple[Array, Array]:
    """Return sizes, 0 the first, and how probable they are before the data, shapes (k,)."""
    density = grid / (1 + (grid / width) ** 2)  # of a grid of logarithms
    return np.append(0.0, grid), np.append(none, (1 - none) * density / density.sum())


class _Beside(Struct, frozen=True):
    """Fits of a rising order, and what q does beside them.

    Attributes
    ----------
    rows
        Derivatives of |f| by the parameters of the highest order, then by q, in units of the noise, shape (n, p + 3).
    fits
        Parameters and residuals, in the same units, of each order.
    freedom
        Degrees of freedom of the noise, None where it is known.
    nonlinear
        The columns of k2 and k3, if their sizes are to be told by the attitudes.
    """

    rows: Array
    fits: Sequence[tuple[Array, Array]]
    freedom: float | None
    nonlinear: range

    def average(self, of_sizes: Array | None, asymmetry: float) -> Blend:
        """Return the average of the blends over the sizes of q, by their shares, or the blend at a known one."""
        sizes = np.array([asymmetry]) if of_sizes is None else _half_cauchy(*_ASYMMETRIES, _SYMMETRIC)[0]
        shares = np.ones(1) if of_sizes is None else of_sizes.sum(axis=(0, 1))
        blends = self._blends(sizes)
        mean = shares @ blends.values
        away = blends.values - mean
        matrix = np.einsum("t,tpq->pq", shares, blends.covariance) + away.T @ (shares[:, None] * away)
        return Blend(mean, matrix, shares @ blends.noise)

    def shares(self) -> Array:
        """Return how probable the attitudes make each size of k2, k3 and q, shape (k2, k3, q)."""
        size = self.rows.shape[1] - 3
        normal = [*self.nonlinear, *range(size, size + 3)]
        others, columns = np.delete(self.rows, normal, axis=1), self.rows[:, normal]
        basis = np.linalg.qr(others / np.linalg.norm(others, axis=0))[0]
        q, r = np.linalg.qr(columns - basis @ (basis.T @ columns))
        parameters, residuals = self.fits[-1]
        observed = q.T @ (self.rows[:, :size] @ parameters - residuals)
        # The covariance of what is observed is I + sum tau^2 R_i R_i'. Given the sizes of k2 and k3 it is U' U, of a QR
        # decomposition; then the singular values of the terms of q serve every size of q.
        grids = [_half_cauchy(*_SIZES, _LINEAR)] * (len(self.nonlinear) // 3)
        grids += [(np.zeros(1), np.ones(1))] * (2 - len(grids))
        (k2, before_k2), (k3, before_k3), (q, before_q) = *grids, _half_cauchy(*_ASYMMETRIES, _SYMMETRIC)
        tau = np.repeat(np.stack(np.meshgrid(k2, k3, indexing="ij"), axis=-1), 3, axis=-1)[..., : len(normal) - 3]
        stacked = np.zeros((len(k2), len(k3), len(normal) - 3 + len(r), len(r)))
        stacked[..., : len(normal) - 3, :] = tau[..., None] * r[:, :-3].T
        stacked[..., len(normal) - 3 :, :] = np.eye(len(r))
        root = np.linalg.qr(stacked, mode="r")
        white = np.linalg.solve(np.swapaxes(root, -1, -2), np.column_stack([r[:, -3:], observed]))
        directions, values, _ = np.linalg.svd(white[..., :3], full_matrices=False)
        left = white[..., 3:]
        along = np.swapaxes(directions, -1, -2) @ left
        growth = 1 + (q[:, None] * values[..., None, :]) ** 2
        square = ((left - directions @ along) ** 2).sum(axis=-2) + (along[..., None, :, 0] ** 2 / growth).sum(axis=-1)
        spread = np.log(np.abs(np.diagonal(root, axis1=-2, axis2=-1))).sum(axis=-1)[..., None]
        logs = -spread - np.log(growth).sum(axis=-1) / 2
        logs -= square / 2 if self.freedom is None else (self.freedom + len(r)) / 2 * np.log1p(square / self.freedom)
        shares = np.exp(logs - logs.max()) * before_k2[:, None, None] * before_k3[:, None] * before_q
        return np.asarray(shares / shares.sum())

    def _blends(self, sizes: Array) -> Blend:
        """Blend the orders where q is normal about 0, of each size: a step of generalised least squares from each fit.

        The orders are nested, so that the factor of the highest holds those of the others.
        """
        size, count = self.rows.shape[1] - 3, len(self.fits)
        left, values, _ = np.linalg.svd(self.rows[:, size:], full_matrices=False)
        shrunk = left * (1 - 1 / np.sqrt(1 + (sizes[:, None] * values) ** 2))[:, None]
        all_rows = np.column_stack([self.rows[:, :size], *(residuals for _, residuals in self.fits)])
        white = all_rows - shrunk @ (left.T @ all_rows)
        rows, missed = white[..., :size], white[..., size:]
        inverse = inverse_root(rows, np.ones(rows.shape[:2]))
        pull = np.swapaxes(rows, 1, 2) @ missed
        theta, matrices = np.zeros((len(sizes), count, size)), np.zeros((len(sizes), count, size, size))
        for row, (parameters, _) in enumerate(self.fits):
            p = len(parameters)
            matrices[:, row, :p, :p] = inverse[:, :p, :p] @ np.swapaxes(inverse[:, :p, :p], 1, 2)
            theta[:, row, :p] = -(matrices[:, row, :p, :p] @ pull[:, :p, row, None])[..., 0]
        theta[sizes == 0] = 0.0  # a fit is the minimum already
        costs = ((missed + rows @ np.swapaxes(theta, 1, 2)) ** 2).sum(axis=1)
        for row, (parameters, _) in enumerate(self.fits):
            theta[:, row, : len(parameters)] += parameters
        return blend(theta, matrices, costs[:, :-1] - costs[:, 1:], [3] * (count - 1), freedom=self.freedom)

    def two_explanations(self, shares: Array) -> Asymmetry:
        """Return how k2 and q, each beside order 1, explain the same; `shares` of all sizes."""
        size, linear = self.rows.shape[1] - 3, parameter_count(1)
        k2, q = (
            np.linalg.lstsq(np.hstack([self.rows[:, :linear], columns]), -self.fits[0][1], rcond=None)[0]
            for columns in (self.rows[:, linear : linear + 3], self.rows[:, size:])
        )
        neither, by_k2, by_q = shares[0, :, 0].sum(), shares[1:, :, 0].sum(), shares[0, :, 1:].sum()
        return Asymmetry(
            float(np.abs(q[linear:]).max()),
            float(np.abs(k2[:3] - q[:3]).max()),
            bool(neither < _LIKELY < min(by_k2, by_q)),
        )


def with_known_spread(
    problem: TumbleProblem, choice: OrderChoice, spread: tuple[float, float], asymmetry: float | None = None
) -> Blended:
    """Return the blend of all orders where k2 and k3 are normal about 0 with known standard deviations.

    ``theta = (J' W J / s^2 + P)^-1 J' W y / s^2`` with ``P = diag(0 .., tau_2^-2, tau_3^-2)``; s^2 is 1, or where noise
    is unknown estimated from ``n - tr(V J' W J / s^2)`` degrees of freedom.

    Parameters
    ----------
    problem, choice
        As for `blend_orders`.
    spread
        tau_2 and tau_3, in units of g.
    asymmetry
        Standard deviation of q; that of k2, which is as large at 1 g, if not stated.
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
    norm, jacobian, _, _ = norm_and_jacobian(theta, problem.reading, top)
    for _ in range(_BLEND_PASSES):
        information = jacobian[0].T @ (jacobian[0] * weights[:, None])
        gradient = jacobian[0].T @ (weights * (norm[0] - 1 - lengthening)) + scale * precision * theta[0]
        whole = information + scale * np.diag(precision)
        root = np.sqrt(np.diag(whole))
        inverse = np.linalg.inv(whole / np.outer(root, root)) / np.outer(root, root)
        step, before = inverse @ gradient, scale
        theta = theta - step[None]
        norm, jacobian, _, _ = norm_and_jacobian(theta, problem.reading, top)
        if problem.covariance is None and not problem.robust:
            freedom = max(n - float(np.trace(inverse @ information)), 1.0)
            scale = max(float((weights * (norm[0] - 1 - lengthening) ** 2).sum()) / freedom, _LEAST_VARIANCE)
        if np.abs(step).max() < _AT_REST and abs(scale - before) <= _NOISE_AT_REST * scale:
            break
    root = np.sqrt(scale * start.variance[0])
    rows = np.hstack([jacobian[0], _asymmetry_columns(problem, theta, top)]) / root[:, None]
    residuals = start.down_weights[0] * (norm[0] - 1 - lengthening) / root
    known = np.hstack([np.diag(np.sqrt(precision)), np.zeros((size, 3))])
    fits = [(theta[0], np.concatenate([residuals, np.sqrt(precision) * theta[0]]))]
    averaged = _Beside(np.vstack([rows, known]), fits, freedom, range(0)).average(None, asymmetry or spread[0])
    as_k2 = spread[0] if asymmetry is None else None
    return Blended(averaged.values, averaged.covariance, top, freedom, {}, {}, asymmetry_as_k2=as_k2)


def _highest_shown(problem: TumbleProblem, choice: OrderChoice) -> int:
    """The highest order up to 3 whose steps the attitudes show, or the chosen one."""
    n = problem.reading.shape[1]
    least = 0 if problem.covariance is not None and not problem.robust else _LEAST_FREEDOM
    shown = 1
    for row in choice.rows[1:HIGHEST_BLENDED]:
        if not row.observable or n - row.parameters < least:
            break
        solution = choice.solutions[row.order]
        below, above = solution.covariance(parameter_count(row.order - 1))[0], solution.covariance()[0]
        if (np.diag(above)[:6] > _UNSEEN**2 * np.diag(below)[:6]).any():
            break
        shown = row.order
    return max(shown, choice.order)


def _refit(problem: TumbleProblem, start: TumbleSolution, common: TumbleSolution, order: int) -> Fit:
    """Fit an order with the weights, and the lengthening of |f|, of another."""
    return fit_lengths(
        start.theta, problem.reading, common.weights, common.lengthening, order, tolerance=_TOLERANCE, most=_STEPS
    )


def _noise(problem: TumbleProblem, solution: TumbleSolution, cost: float, left: float) -> tuple[float, float | None]:
    """Variance of the attitudes over that of the solution, and its degrees of freedom; None where it is known."""
    if problem.robust and left > 0:
        factor = float(huber_inflation(solution.standardised(), solution.theta.shape[1])[0])
        return max(factor * float(solution.scale[0] ** 2), _LEAST_VARIANCE), float(left)
    if problem.covariance is None and left > 0:
        return max(cost / left, _LEAST_VARIANCE), float(left)
    return 1.0, float(solution.freedom[0]) if np.isfinite(solution.freedom[0]) else None


def _effect_of_left_out(problem: TumbleProblem, solution: TumbleSolution, order: int) -> tuple[float, float]:
    """``(J'WJ)^-1 J'W J_k``: largest change of a bias and of a scale factor by one unit of a k that is left out."""
    theta = np.zeros((1, parameter_count(order)))
    theta[:, : solution.theta.shape[1]] = solution.theta
    left_out = norm_and_jacobian(theta, problem.reading, order)[1][0, :, -3:]
    pull = solution.jacobian[0].T @ (left_out / solution.variance[0][:, None])
    moved = np.abs(solution.covariance()[0] @ pull)
    return float(moved[0:3].max()), float(moved[3:6].max())
