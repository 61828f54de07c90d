"""The estimators of a tumble test.

Least squares in units of g, the published first-order iteration, and which attitudes determine the parameters best.

`solve_norm` minimises ``sum_p w_p (|f(M_p)| - 1)^2`` with the model inverted exactly; the published first-order
iteration (linearised.py) returns the same `TumbleSolution`.

Noise-length term: second-order expansion of |f + e|.

Source: the method's patent, its equation (4) with the products paired as docs/tumble_method.md says.

The information of an attitude is the gradient of |f| for a nominal sensor, a function of its upward direction alone.
Attitudes are exchanged one by one for the best of a list of candidates (Fedorov 1972; Atkinson, Donev and Tobias,
Optimum Experimental Designs, 2007, ch. 12) from several starts, and on the free sphere then moved to where they are
best. Many sets come within 1 % of the least sum of variances; the one whose worst axis is known best is taken,
because a triad is as good as its worst axis.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from imulab.errors import DataError
from imulab.estimation.least_squares import (
    Factors,
    Fit,
    factorise,
    huber_weights,
    inverse_root,
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
from imulab.units import from_si

# The default estimator of a tumble test, for batches of problems in units of g.


REWEIGHTING_PASSES = {False: 4, True: 30}
_LEAST_SCALE = 1e-20  # g, far below rounding: stands for the scatter of attitudes that are exact
WEIGHTS_AT_REST = 1e-4  # relative change of the weights that ends the iteration
_FIT_STEPS = 40  # of Levenberg and Marquardt
_REFIT_STEPS = 15  # without one attitude of many the solution is near; what wanders for longer is not determined
_REFIT_AT_MOST = 150  # attitudes up to which each is left out by a fit of its own; above, the linear formula serves
_REFIT_TOLERANCE = 1e-7  # the next step would be a thousandth of it, or less


class Prior(Struct, frozen=True):
    """Earlier knowledge of the scaled parameters: normal, as observations ``rows (theta - mean) = 0 ± 1``.

    `mean` has shape (p,), `rows` shape (q, p), with ``rows' rows`` the inverse of the covariance.
    """

    mean: Array
    rows: Array


class TumbleProblem(Struct, frozen=True):
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

    def only(self, which: NDArray[Any]) -> TumbleProblem:
        """Return the problem with some of its attitudes, by index or mask of shape (n,)."""
        return replace(
            self,
            reading=self.reading[:, which],
            covariance=None if self.covariance is None else self.covariance[:, which],
            motion=None if self.motion is None else self.motion[which],
        )

    def held_still(self, solution: TumbleSolution) -> TumbleProblem:
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


class TumbleSolution(Struct, frozen=True, dict=True):
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

    @cached_property
    def factors(self) -> Factors:
        """Of the Jacobian under the weights; their basis is what the model explains, in units of the weights."""
        return factorise(self.jacobian, self.weights)

    @cached_property
    def leverage(self) -> Array:
        """Leverage of each attitude under the weights, shape (b, n)."""
        return np.asarray(np.einsum("bnp,bnp->bn", self.factors.basis, self.factors.basis))

    @cached_property
    def inverse_root(self) -> Array:
        """``U U' = (J' W J)^-1`` without down-weights, upper triangular, shape (b, p, p)."""
        if (self.down_weights == 1).all():
            return self.factors.inverse_root()
        return inverse_root(self.jacobian, 1 / self.variance)

    def covariance(self, size: int | None = None) -> Array:
        """Return the covariance of the parameters, or of the first `size` where the model has no others, (b, p, p)."""
        root = self.inverse_root[:, :size, :size]
        return np.asarray(root @ root.transpose(0, 2, 1))

    def standardised(self) -> Array:
        """Residuals over their standard deviations, shape (b, n)."""
        return np.asarray(self.residuals / (np.sqrt(self.variance) * np.maximum(self.scale, _LEAST_SCALE)[:, None]))


def start_parameters(order: int, count: int = 1, cross: bool = False) -> Array:
    """Return the nominal sensor as a start, shape (count, p)."""
    theta = np.zeros((count, parameter_count(order, cross)))
    theta[:, 3:6] = 1.0
    return theta


def solve_norm(problem: TumbleProblem, start: Array | None = None) -> TumbleSolution:
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
    lengthening, noise_variance = magnitude_noise(problem, theta)
    variance, down, scale = noise_variance, np.ones((count, n)), np.ones(count)
    excess, freedom = np.zeros(count), np.full(count, np.inf)
    iterations = np.zeros(count, dtype=np.int64)
    repeat = problem.robust or problem.covariance is not None
    for number in range(REWEIGHTING_PASSES[problem.robust] if repeat else 1):
        # The first pass only has to be good enough to weigh by.
        fit = _least_squares(problem, theta, down / variance, lengthening, 1e-9 if number or not repeat else 1e-4)
        iterations += fit.iterations
        theta, before = fit.parameters, down / variance
        lengthening, noise_variance = magnitude_noise(problem, theta, fit.jacobian)
        residuals = fit.residuals
        if problem.covariance is not None and problem.excess and not problem.robust:
            excess, freedom = plausible_excess(residuals, noise_variance, 1 - leverage(fit.jacobian, 1 / variance))
        variance = noise_variance + excess[:, None]
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
    return TumbleSolution(
        theta=theta,
        residuals=fit.residuals,
        deviations=fit.residuals + (0.0 if problem.motion is not None else lengthening),
        lengthening=lengthening,
        jacobian=fit.jacobian,
        variance=variance,
        own_variance=noise_variance,
        down_weights=down,
        scale=scale,
        excess=np.sqrt(excess),
        freedom=freedom,
        iterations=iterations,
        converged=fit.converged,
    )


def _least_squares(
    problem: TumbleProblem, theta: Array, weights: Array, lengthening: Array, tolerance: float = 1e-9
) -> Fit:
    return fit_lengths(
        theta, problem.reading, weights, lengthening, problem.order, tolerance=tolerance, most=_FIT_STEPS
    )


def informed_rows(problem: TumbleProblem, jacobian: Array, weights: Array) -> tuple[Array, Array]:
    """Return Jacobian (n + q, p) and weights (n + q,) of one problem with the rows of its prior."""
    if problem.prior is None:
        return jacobian, weights
    return np.vstack([jacobian, problem.prior.rows]), np.concatenate([weights, np.ones(len(problem.prior.rows))])


def data_freedom(problem: TumbleProblem, jacobian: Array, weights: Array) -> float:
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


def magnitude_noise(problem: TumbleProblem, theta: Array, jacobian: Array | None = None) -> tuple[Array, Array]:
    """Return by how much noise lengthens |f|, and the variance of |f|, shapes (b, n)."""
    if problem.covariance is None:
        return np.zeros(problem.reading.shape[:2]), np.ones(problem.reading.shape[:2])
    if jacobian is None:
        jacobian = norm_and_jacobian(theta, problem.reading, problem.order)[1]
    return length_noise(theta, jacobian, problem.covariance, problem.motion)


def evaluate(problem: TumbleProblem, solution: TumbleSolution) -> TumbleSolution:
    """Return residuals, Jacobian and variances of all attitudes under a solution for some of them, a batch of one.

    The excess variance is the solution's; down-weights are ones.
    """
    norm, jacobian, _, _ = norm_and_jacobian(solution.theta, problem.reading, problem.order)
    lengthening, noise_variance = magnitude_noise(problem, solution.theta, jacobian)
    if problem.covariance is None:
        lengthening = lengthening + solution.lengthening[:, :1]
    residuals = norm - 1 - lengthening
    return replace(
        solution,
        residuals=residuals,
        deviations=residuals if problem.motion is not None else norm - 1,
        lengthening=lengthening,
        jacobian=jacobian,
        variance=noise_variance + solution.excess[:, None] ** 2,
        own_variance=noise_variance,
        down_weights=np.ones(norm.shape),
    )


def forces(problem: TumbleProblem, solution: TumbleSolution) -> Array:
    """Return the specific force in each attitude, units of g, shape (b, n, 3)."""
    return norm_and_jacobian(solution.theta, problem.reading, problem.order)[2]


def leave_one_out(problem: TumbleProblem, solution: TumbleSolution) -> Array:
    """Return the error |f| - 1 of each attitude under the fit to all others, shape (n,), for a batch of one.

    The n refits have the weights of the whole fit and no prior. Beyond some hundred attitudes no single one moves the
    fit, and the linear formula r / (1 - h) is exact enough.
    """
    if problem.reading.shape[1] > _REFIT_AT_MOST or problem.cross:
        errors: Array = (solution.residuals / (1 - solution.leverage))[0]
        return errors
    return left_out_lengths(
        solution.theta, problem.reading, solution.weights, solution.lengthening, problem.order,
        tolerance=_REFIT_TOLERANCE, most=_REFIT_STEPS,
    )  # fmt: skip


# The published first-order iteration of a tumble test (method ``linearised``), and the source's rules for it.


_PASSES = 50  # of the source's iteration at most
_DIVERGED = 0.98
"""A relative change of scale, or of bias in g, after which the linear step cannot be meant."""


class Threshold(Struct, frozen=True):
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


def solve_linearised(problem: TumbleProblem, name: str, threshold: Threshold = SOURCE_THRESHOLD) -> TumbleSolution:
    """Run the published first-order iteration for a batch of one; weights and excess variance as for `solve_norm`.

    ``sum_i sum_j d_ji a_i^(j+1) + m_1 a_x a_y + m_2 a_y a_z + m_3 a_z a_x = (|B|^2 - 1) / 2``, solved by linear least
    squares until every change is below the threshold. The misalignments m_1, m_2, m_3 are the model's m_yx, m_zy, m_zx.

    Raises
    ------
    DataError
        The iteration does not converge, or ends where the model cannot be inverted.
    """
    lengthening, noise_variance = magnitude_noise(problem, start_parameters(problem.order))
    theta, passes = _linearised_iteration(problem, lengthening[0], noise_variance[0], name, threshold)
    solution = _evaluated(problem, theta, passes, name)
    if problem.covariance is None:
        return solution
    for _ in range(REWEIGHTING_PASSES[False]):
        before = solution.excess
        spare = 1 - solution.leverage
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
    problem: TumbleProblem, lengthening: Array, variance: Array, name: str, threshold: Threshold
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


def _evaluated(problem: TumbleProblem, theta: Array, iterations: int, name: str) -> TumbleSolution:
    """Wrap parameters of the linearised iteration as a solution."""
    norm, jacobian, _, _ = norm_and_jacobian(theta, problem.reading, problem.order)
    if not np.isfinite(norm).all():
        raise DataError(
            f"{name}: method linearised ends at a nonlinearity under which no specific force leads to some of these "
            "attitudes; use --method norm"
        )
    lengthening, noise_variance = magnitude_noise(problem, theta, jacobian)
    n = norm.shape[1]
    return TumbleSolution(
        theta=theta,
        residuals=norm - 1 - lengthening,
        deviations=norm - 1 - (lengthening if problem.motion is not None else 0.0),
        lengthening=lengthening,
        jacobian=jacobian,
        variance=noise_variance,
        own_variance=noise_variance,
        down_weights=np.ones((1, n)),
        scale=np.ones(1),
        excess=np.zeros(1),
        freedom=np.full(1, np.inf),
        iterations=np.array([iterations]),
        converged=np.array([True]),
    )


# The search behind a plan: sets of attitudes that are D- or A-optimal for a tumble test.


CLOSEST = np.radians(3.0)
"""Two attitudes closer than this are the same attitude: the same axis vertical."""
_KEPT_CLEAR = 2 * CLOSEST
"""What a plan with distinct verticals keeps from a vertical axis, so that an attitude put down 3 deg off does too."""
_STARTS = 12  # of the search for a set of attitudes
_ATTITUDES_OVER_STARTS = 600  # attitudes over all starts: with many attitudes the first start is as good as the best
_SWEEPS = 40  # of exchanges from one start
_POLISH_RADII = np.repeat(np.radians([8.0, 3.0, 1.0]), 4)
_CAP = 48  # directions around an attitude that are tried in its place
_BALANCED = 3
"""So many of the best starts are polished and balanced."""
_BALANCE_ROUNDS = 6  # of exchanges that even out how well each axis is known
_BALANCE_RADII = np.repeat(np.radians([3.0, 1.0]), 3)
_AS_GOOD = 1.01
"""Sums of variances within this factor of the least are taken for equal."""
_RIDGE = 1e-9
"""Information that keeps the matrix regular while attitudes are still missing."""
_UNDETERMINED = 1e6  # variance, in that of one attitude's noise, of a parameter that a set does not determine
_QUICK_ROUNDS = 2  # of exchanges where a person waits for the next attitude
_QUICK_RADII = np.radians([8.0, 3.0, 3.0, 1.0])


def information_rows(directions: Array, order: int) -> Array:
    """Return the gradient of |f| with respect to the scaled parameters of a nominal sensor, shape (n, p)."""
    rows: Array = norm_and_jacobian(start_parameters(order), directions[None], order)[1][0]
    return rows


def near_vertical(directions: Array, angle: float) -> NDArray[np.bool_]:
    """Return which of x, y and z is vertical within `angle`, up or down, at each upward direction, shape (n, 3)."""
    vertical: NDArray[np.bool_] = np.abs(directions) > np.cos(angle) * np.linalg.norm(directions, axis=1, keepdims=True)
    return vertical


def inverse(information: Array) -> Array:
    """Return the covariance that belongs to an information matrix."""
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


class Search(Struct, frozen=True, dict=True):
    """What a set of attitudes is for.

    Attributes
    ----------
    order
        Order of the model.
    criterion
        ``"A"``, least sum of variances, or ``"D"``, least volume of the confidence region.
    before
        Upward directions already measured, shape (k, 3).
    distinct_verticals
        Whether x, y and z are each to be vertical, up or down, in one attitude at most.
    """

    order: int
    criterion: str
    before: Array
    distinct_verticals: bool = False

    @cached_property
    def base(self) -> Array:
        """Information of the attitudes already measured."""
        fixed = information_rows(self.before, self.order)
        information: Array = fixed.T @ fixed + _RIDGE * np.eye(parameter_count(self.order))
        return information

    def covariance(self, directions: Array) -> Array:
        """Covariance of the parameters with these attitudes added, per variance of |f| / g."""
        rows = information_rows(directions, self.order)
        return inverse(self.base + rows.T @ rows)

    def gain(self, rows: Array, kept: Array, weight: Array | float = 1.0) -> Array:
        """What adding each row to those kept improves.

        By A the drop of the sum of weight times variance, by D the growth of the determinant.
        """
        carried = rows @ inverse(self.base + kept.T @ kept)
        variance: Array = 1 + np.einsum("ij,ij->i", carried, rows)
        if self.criterion == "D":
            return variance
        gain: Array = (carried**2 * weight).sum(axis=1) / variance
        return gain

    def taken(self, points: Array, others: Array) -> NDArray[np.bool_]:
        """Points that would repeat an attitude: it measures nothing new that a longer hold would not."""
        near = np.vstack([others, self.before])
        repeated: NDArray[np.bool_] = (points @ near.T).max(axis=1, initial=-1.0) > np.cos(CLOSEST)
        if self.distinct_verticals:
            used = near_vertical(near, _KEPT_CLEAR).any(axis=0)
            repeated |= (near_vertical(points, _KEPT_CLEAR) & used).any(axis=1)
        return repeated


def optimal_set(search: Search, points: Array, count: int, seed: int, *, free: bool) -> Array | None:
    """Choose `count` of the candidate `points`, shape (m, 3), and move them from there if `free`.

    Returns the directions, shape (count, 3), or None where no choice determines the model.
    """
    rng = np.random.default_rng(seed)
    rows = information_rows(points, search.order)
    starts = [
        _exchange(search, points, rows, count, rng)
        for _ in range(max(2, min(_STARTS, _ATTITUDES_OVER_STARTS // count)))
    ]
    starts.sort(key=lambda directions: _cost(search.covariance(directions), search.criterion))
    if not np.isfinite(_cost(search.covariance(starts[0]), search.criterion)):
        return None
    if not free:
        return _most_alike(search, starts)
    polished = [_polish(search, directions, rng, _POLISH_RADII) for directions in starts[:_BALANCED]]
    if search.criterion == "D":
        return _most_alike(search, polished)
    return _most_alike(
        search, polished + [each for polished_set in polished for each in _balance(search, polished_set, rng)]
    )


def quick_set(
    search: Search, points: Array, count: int, seed: int, *, weight: Array | float = 1.0, move: bool = True
) -> Array | None:
    """Choose as `optimal_set` does, but from one start: within hundredths of a second, for who waits for the answer.

    The sum of weight times variance is made least. Returns the directions, shape (count, 3), or None where this choice
    does not determine the model.
    """
    rng = np.random.default_rng(seed)
    chosen = _exchange(search, points, information_rows(points, search.order), count, rng, weight)
    if np.diag(search.covariance(chosen)).max() > _UNDETERMINED:
        return None
    if not move:
        return chosen
    for _ in range(_QUICK_ROUNDS):
        variance = np.diag(search.covariance(chosen)).reshape(-1, 3)
        weight = weight * (variance / variance.mean(axis=1, keepdims=True)).ravel() ** 2
        chosen = _polish(search, chosen, rng, _QUICK_RADII, weight)
    return chosen


def _exchange(
    search: Search, points: Array, rows: Array, count: int, rng: np.random.Generator, weight: Array | float = 1.0
) -> Array:
    """Exchange attitudes from a random start until no exchange helps."""
    chosen = rng.choice(len(rows), count, replace=False)
    for _ in range(_SWEEPS):
        moved = False
        for place in range(count):
            others = np.delete(chosen, place)
            gain = search.gain(rows, rows[others], weight)
            gain[search.taken(points, points[others])] = -np.inf
            best = int(np.argmax(gain))
            if gain[best] > gain[chosen[place]] * (1 + 1e-9) or gain[chosen[place]] == -np.inf:
                chosen[place], moved = best, True
        if not moved:
            break
    directions: Array = points[chosen]
    return directions


def _polish(
    search: Search, directions: Array, rng: np.random.Generator, radii: Array, weight: Array | float = 1.0
) -> Array:
    """Move each attitude within shrinking caps to where it gives most."""
    best = directions.copy()
    for radius in radii:
        for place in range(len(best)):
            others = np.delete(best, place, axis=0)
            cap = best[place] + radius * rng.uniform(-1, 1, (_CAP, 3))
            cap = np.vstack([best[place], cap / np.linalg.norm(cap, axis=1, keepdims=True)])
            gain = search.gain(information_rows(cap, search.order), information_rows(others, search.order), weight)
            gain[1:][search.taken(cap[1:], others)] = -np.inf
            best[place] = cap[int(np.argmax(gain))]
    return best


def _balance(search: Search, directions: Array, rng: np.random.Generator) -> list[Array]:
    """Sets made from one by weighting up, again and again, the variances of axes that are worse than the others."""
    sets = [directions]
    weight: Array = np.ones(parameter_count(search.order))
    for _ in range(_BALANCE_ROUNDS):
        variance = np.diag(search.covariance(sets[-1])).reshape(-1, 3)
        weight = weight * (variance / variance.mean(axis=1, keepdims=True)).ravel() ** 2
        sets.append(_polish(search, sets[-1], rng, _BALANCE_RADII, weight))
    return sets[1:]


def _most_alike(search: Search, sets: list[Array]) -> Array:
    """The set with the least cost; by A the one of the least worst axes among those as good as it."""
    cost = [_cost(search.covariance(directions), search.criterion) for directions in sets]
    if search.criterion == "D":
        return sets[int(np.argmin(cost))]
    good = [directions for directions, each in zip(sets, cost, strict=True) if each <= _AS_GOOD * min(cost)]
    return min(good, key=lambda directions: _worst_axes(search.covariance(directions)))


def _worst_axes(covariance: Array) -> float:
    """Sum over bias, scale factor, misalignment, k2 ... of the variance of the worst of its three."""
    return float(np.diag(covariance).reshape(-1, 3).max(axis=1).sum())


def _cost(covariance: Array, criterion: str) -> float:
    if criterion == "D":
        return float(np.linalg.slogdet(covariance)[1])
    return float(np.trace(covariance))


# Which further attitudes would tell apart what these cannot.


_CANDIDATES = 400  # directions, 10 deg apart, among which the next attitude is chosen


def sphere_points(count: int) -> Array:
    """Return directions spread evenly over the sphere (Fibonacci lattice), shape (count, 3)."""
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - height**2)
    points: Array = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])
    return points


def helpful_attitudes(order: int, solution: TumbleSolution, count: int) -> str:
    """Name the upward directions (body axes) that add most to what the attitudes determine.

    Each is the candidate with the largest variance of |f| under the information so far, a step of the exchange on the
    D-criterion (Fedorov 1972).
    """
    candidates = sphere_points(_CANDIDATES)
    present = solution.jacobian[0]
    cross = present.shape[1] > parameter_count(order)
    rows = norm_and_jacobian(start_parameters(order, cross=cross), candidates[None], order)[1][0]
    information = present.T @ present + 1e-6 * np.eye(present.shape[1])
    chosen = []
    for _ in range(count):
        gain = np.einsum("ij,jk,ik->i", rows, np.linalg.inv(information), rows)
        best = int(np.argmax(gain))
        information = information + np.outer(rows[best], rows[best])
        chosen.append("(" + ", ".join(f"{value:+.2f}" for value in candidates[best]) + ")")
    return " and ".join(chosen)
