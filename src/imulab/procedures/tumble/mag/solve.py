"""One fit of both triads: every attitude's |f|, |m| and dip, each with its variance.

``min sum_p r_p' V_p^-1 r_p`` over both triads and the dip. An accelerometer error is common to all dips, which is why
the accelerometers are fitted anew, from where their own fit ended. Noise that is not known is estimated by restricted
maximum likelihood, where i and j run over the blocks k and l,

    sum_l S_kl (sigma_l'^2 - sigma_l^2) = q_k - tr_k P,   q_k = sum (P r)_i^2,   S_kl = sum P_ij^2

with ``P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1`` and blocks |m|, dip and directions held. Intervals take Student's
t with ``nu = v^2 / (a' K a)``: v the variance of a parameter, ``a_k = dv/dsigma_k^2``, K half the covariance of
sigma_k^2.

Sources: Patterson and Thompson, Biometrika 58 (1971) 545 (REML); Satterthwaite, Biometrics Bulletin 2 (1946) 110.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.least_squares import chi_square_probability
from imulab.procedures.tumble.mag.model import Invariants, Layout, invariants
from imulab.procedures.tumble.mag.pointing import Held, with_held
from imulab.recording import Array

_STEPS = 60
_TOLERANCE = 1e-11
_CLOSE = 0.03
"""Standard deviations of the residuals to which parameters need to be known for a pass over the variances."""
_DAMPING, _NEAR = 1e-4, 1e-9
"""Where a minimisation starts, and where one that was near."""
_PASSES = 50
_RESTS = 1e-3
_BEYOND_BY_CHANCE = 0.05
"""Probability of chi-square below which attitudes whose noise is known scatter beyond it."""
_HUBER = 2.0
_LEAST = 1e-24  # variance that exact data leave, or rounding in them
_BLOCKS = np.array([0, 1, 2, 3, 3])
"""Whose variance each residual of an attitude has: |f|, |m|, dip, direction held."""


@dataclass(frozen=True)
class Pair:
    """Outputs of both triads in the attitudes, scaled so that both vectors have a length of about 1.

    Attributes
    ----------
    accel, mag
        Shape (n, 3).
    noise
        Covariance of the six outputs, shape (n, 6, 6); None where the magnetometers' is not known.
    accel_variance
        Of |f|, from the accelerometers' own fit, shape (n,).
    lengthening
        By how much noise makes |f| too long, shape (n,).
    accel_freedom
        Degrees of freedom of `accel_variance`, infinite where it is known.
    accel_size
        Number of the accelerometers' parameters.
    prior
        Mean and rows ``rows (theta - mean) = 0 ± 1`` of the accelerometers' parameters; None without.
    mag_order
        1 or 2.
    held
        Attitudes in which a body axis points one way.
    """

    accel: Array
    mag: Array
    noise: Array | None
    accel_variance: Array
    lengthening: Array
    accel_freedom: float
    accel_size: int
    prior: tuple[Array, Array] | None = None
    mag_order: int = 1
    held: Held | None = None

    @property
    def layout(self) -> Layout:
        """Where the parameters stand."""
        return Layout(9 + 3 * self.mag_order, self.accel_size, 0 if self.held is None else self.held.size)

    def only(self, kept: NDArray[np.intp]) -> Pair:
        """Return the pair with some of the attitudes, by index."""
        return replace(
            self,
            accel=self.accel[kept],
            mag=self.mag[kept],
            noise=None if self.noise is None else self.noise[kept],
            accel_variance=self.accel_variance[kept],
            lengthening=self.lengthening[kept],
            held=None if self.held is None else self.held.only(kept),
        )

    def evaluate(self, theta: Array) -> Invariants:
        """Return residuals, less the lengthening of |f|, and derivatives."""
        found = invariants(theta, self.accel, self.mag, self.layout)
        found.residuals[:, 0] -= self.lengthening
        return found if self.held is None else with_held(found, theta, self.layout, self.held)


@dataclass(frozen=True)
class Joint:
    """What the fit found.

    Attributes
    ----------
    pair
        What was fitted.
    theta
        Shape (p,), as the layout of `pair` says.
    found
        Residuals and derivatives at the solution.
    information
        V_p^-1 without Huber's weights, shape (n, k, k); nil for directions that are not held.
    covariance
        Of theta, shape (p, p).
    freedom
        Degrees of freedom of each parameter's variance, shape (p,).
    sigma
        Standard deviations of |m|, dip and directions held: estimated, or what was added to the known noise.
    down_weights
        Huber's factors of |m| and dip, shape (n,).
    converged
        Whether both loops came to rest.
    """

    pair: Pair
    theta: Array
    found: Invariants
    information: Array
    covariance: Array
    freedom: Array
    sigma: Array
    down_weights: Array
    converged: bool


def solve(pair: Pair, start: Array, *, robust: bool = False) -> Joint:
    """Fit both triads from start parameters (p,); `robust` limits the pull of single attitudes on field and dip.

    Where both are unknown, the dip's standard deviation is no smaller than the field's: magnitudes alone could
    otherwise be bent until a few attitudes have no dip residuals at all.

    Raises
    ------
    numpy.linalg.LinAlgError
        The parameters run away, or end where they are not determined.
    """
    theta, down = start, np.ones(len(pair.mag))
    unknown = pair.noise is None
    first = float(np.median(pair.accel_variance))
    extra = np.array([first if unknown else 0.0] * 2 + [first])
    free = np.array([unknown, unknown, pair.held is not None])
    rested = False
    found = pair.evaluate(theta)
    for number in range(_PASSES):
        weigh = _root(_information(pair, _known(pair, found), extra, down))
        theta, found, settled = _minimise(pair, weigh, theta, found, _NEAR if number else _DAMPING, _CLOSE)
        known = _known(pair, found)
        before, weights_before = extra, down
        if number == 0 and not unknown:
            free[:2] = _scatters_beyond(found, known)
        if free.any():
            extra = _likelihood_pass(pair, found, _information(pair, known, extra, down), extra, down, free)
        if robust:
            down = _huber(found, known, extra)
        rests = np.abs(extra - before) <= _RESTS * extra + _LEAST
        if settled and rests.all() and np.abs(down - weights_before).max() < _RESTS:
            rested = True
            break
    weigh = _root(_information(pair, known, extra, down))
    theta, found, settled = _minimise(pair, weigh, theta, found)
    known = _known(pair, found)
    information = _information(pair, known, extra, np.ones(len(down)))
    covariance, freedom = _uncertainty(pair, found, _information(pair, known, extra, down), extra, free)
    if not (np.diag(covariance) > 0).all():
        raise np.linalg.LinAlgError("the fit ends where parameters are not determined")
    return Joint(pair, theta, found, information, covariance, freedom, np.sqrt(extra), down, rested and settled)


def _known(pair: Pair, found: Invariants) -> Array:
    """V_0 of |f|, |m| and dip, shape (n, 3, 3): ``B C B'``, and of |f| at least what its own fit says."""
    v = np.zeros((len(pair.mag), 3, 3))
    if pair.noise is not None:
        v = found.by_outputs @ pair.noise @ found.by_outputs.transpose(0, 2, 1)
    v[:, 0, 0] = np.maximum(v[:, 0, 0], pair.accel_variance) + _LEAST
    return v


def _information(pair: Pair, known: Array, extra: Array, down: Array) -> Array:
    """Return V^-1 of each attitude, shape (n, k, k), with variances `extra` added and Huber's weights."""
    v = known.copy()
    v[:, 1, 1] += extra[0] + _LEAST
    v[:, 2, 2] += extra[1] + _LEAST
    factor = np.column_stack([np.ones(len(down)), np.sqrt(down), np.sqrt(down)])
    inverse: Array = np.linalg.inv(v) * factor[:, :, None] * factor[:, None, :]
    if pair.held is None:
        return inverse
    whole = np.zeros((len(v), 5, 5))
    whole[:, :3, :3] = inverse
    whole[:, 3, 3] = whole[:, 4, 4] = (pair.held.group >= 0) / (extra[2] + _LEAST)
    return whole


def _root(information: Array) -> Array:
    """Return R with ``R' R = V^-1``, shape (n, k, k)."""
    upper = np.zeros_like(information)
    upper[:, :3, :3] = np.linalg.cholesky(information[:, :3, :3]).transpose(0, 2, 1)
    for k in range(3, information.shape[1]):
        upper[:, k, k] = np.sqrt(information[:, k, k])
    return upper


def _rows(pair: Pair, found: Invariants, theta: Array, weigh: Array) -> tuple[Array, Array]:
    """Whitened residuals and Jacobian of all attitudes, one after the other, with the rows of the prior."""
    residuals = np.einsum("nij,nj->ni", weigh, found.residuals).ravel()
    jacobian = (weigh @ found.by_parameters).reshape(-1, len(theta))
    if pair.prior is None:
        return residuals, jacobian
    mean, rows = pair.prior
    own = np.zeros((len(rows), len(theta)))
    own[:, pair.layout.of_accel] = rows
    return np.concatenate([residuals, rows @ (theta[pair.layout.of_accel] - mean)]), np.vstack([jacobian, own])


def _minimise(
    pair: Pair, weigh: Array, theta: Array, found: Invariants, damping: float = _NEAR, close: float = 0.0
) -> tuple[Array, Invariants, bool]:
    """Levenberg-Marquardt with columns scaled to length 1, until a step is below the tolerance.

    Or until it changes the whitened residuals by less than `close`. Returns parameters, residuals there, and whether it
    came to rest.

    Raises
    ------
    numpy.linalg.LinAlgError
        The parameters run away.
    """
    residuals, jacobian = _rows(pair, found, theta, weigh)
    cost = float(residuals @ residuals)
    for _ in range(_STEPS):
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
        scaled = np.vstack([jacobian / scale, np.sqrt(damping) * np.eye(len(theta))])
        if not (np.isfinite(scaled).all() and np.isfinite(residuals).all()):
            raise np.linalg.LinAlgError("the fit runs away")
        step = np.linalg.lstsq(scaled, -np.append(residuals, np.zeros(len(theta))), rcond=None)[0] / scale
        with np.errstate(all="ignore"):
            there = pair.evaluate(theta + step)
            new, slope = _rows(pair, there, theta + step, weigh)
        reached = float(new @ new)
        small = np.abs(step).max() < _TOLERANCE or np.linalg.norm(jacobian @ step) < close
        if reached <= cost * (1 + 1e-12):
            theta, found, residuals, jacobian = theta + step, there, new, slope
            cost, damping = reached, damping / 10
        else:
            damping *= 10
        if small or damping > 1e12:
            return theta, found, bool(small)
    return theta, found, False


def weighted_jacobian(joint: Joint) -> Array:
    """Return the Jacobian of the solution over the standard deviations of its rows, with those of the prior."""
    return _rows(joint.pair, joint.found, joint.theta, _root(joint.information))[1]


def _covariance(pair: Pair, found: Invariants, information: Array) -> Array:
    """Return ``(J' V^-1 J)^-1``, shape (p, p)."""
    size = found.by_parameters.shape[2]
    carried = information @ found.by_parameters
    normal = found.by_parameters.reshape(-1, size).T @ carried.reshape(-1, size)
    if pair.prior is not None:
        own = np.zeros((size, size))
        own[pair.layout.of_accel, pair.layout.of_accel] = pair.prior[1].T @ pair.prior[1]
        normal = normal + own
    scale = np.sqrt(np.diag(normal))
    inverse: Array = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    return inverse


def _blocks(information: Array, found: Invariants, covariance: Array) -> tuple[Array, Array]:
    """Return ``tr_k P``, shape (4,), and S, shape (4, 4), without forming P."""
    k = found.residuals.shape[1]
    carried = information @ found.by_parameters  # V^-1 J
    inside = carried @ covariance @ carried.transpose(0, 2, 1)
    gram = np.zeros((4, *covariance.shape))
    trace, squares = np.zeros(4), np.zeros((4, 4))
    for i, block in enumerate(_BLOCKS[:k]):
        gram[block] += carried[:, i].T @ carried[:, i]
        trace[block] += (information[:, i, i] - inside[:, i, i]).sum()
        for j, other in enumerate(_BLOCKS[:k]):
            squares[block, other] += (information[:, i, j] * (information[:, i, j] - 2 * inside[:, i, j])).sum()
    spread = gram @ covariance
    squares += spread.reshape(4, -1) @ spread.transpose(0, 2, 1).reshape(4, -1).T
    return trace, squares


def _likelihood_pass(
    pair: Pair, found: Invariants, information: Array, extra: Array, down: Array, free: Array
) -> Array:
    """One pass of restricted maximum likelihood for the variances of |m|, dip and directions held."""
    covariance = _covariance(pair, found, information)
    trace, squares = _blocks(information, found, covariance)
    carried = information @ found.by_parameters
    weighted = (information @ found.residuals[:, :, None])[:, :, 0]
    felt = weighted - carried @ (covariance @ np.tensordot(carried, found.residuals, ((0, 1), (0, 1))))
    weights = np.ones_like(felt)
    weights[:, 1:3] = 1 / np.maximum(down, 1e-12)[:, None]
    square = np.bincount(_BLOCKS[: felt.shape[1]], (weights * felt**2).sum(axis=0), 4)
    new = extra.copy()
    which = np.flatnonzero(free)
    change = np.linalg.solve(squares[1:, 1:][np.ix_(which, which)], (square - trace)[1:][which])
    new[which] = np.maximum(extra[which] + change, 0.0)
    if pair.noise is None and new[1] < new[0]:
        both = slice(1, 3)
        change = (square - trace)[both].sum() / squares[both, both].sum()
        new[:2] = max(float(extra[:2].mean()) + change, 0.0)
    new[np.logical_not(free)] = 0.0
    return new


def _scatters_beyond(found: Invariants, known: Array) -> Array:
    """Whether |m|, and the dip, scatter beyond their known noise; each has about half of the parameters they have."""
    n, size = len(known), found.by_parameters.shape[2]
    chi = (found.residuals[:, :3] ** 2 / (np.einsum("nii->ni", known) + _LEAST))[:, 1:].sum(axis=0)
    freedom = max(n - size / 3, 1.0)
    return np.array([chi_square_probability(float(value), freedom) < _BEYOND_BY_CHANCE for value in chi])


def _huber(found: Invariants, known: Array, extra: Array) -> Array:
    """``min(1, 2/d)`` with ``d^2 = r1^2/sigma_m^2 + r2^2/sigma_delta^2``, shape (n,)."""
    variance = np.einsum("nii->ni", known)[:, 1:] + extra[:2] + _LEAST
    d = np.sqrt((found.residuals[:, 1:3] ** 2 / variance).sum(axis=1))
    weights: Array = np.minimum(1.0, _HUBER / np.maximum(d, 1e-300))
    return weights


def _uncertainty(pair: Pair, found: Invariants, information: Array, extra: Array, free: Array) -> tuple[Array, Array]:
    """Covariance of theta, and the degrees of freedom of each variance in it."""
    covariance = _covariance(pair, found, information)
    squares = _blocks(information, found, covariance)[1]
    carried = (information @ found.by_parameters) @ covariance
    each = (carried**2).sum(axis=0)
    by_block = np.zeros((4, len(covariance)))
    np.add.at(by_block, _BLOCKS[: len(each)], each)  # dv/dsigma_k^2
    spread = np.zeros((4, 4))
    if np.isfinite(pair.accel_freedom):
        spread[0, 0] = float(np.median(pair.accel_variance)) ** 2 / pair.accel_freedom
    which = np.flatnonzero(free) + 1
    spread[np.ix_(which, which)] = np.linalg.inv(squares[np.ix_(which, which)])
    with np.errstate(divide="ignore"):
        freedom = np.diag(covariance) ** 2 / np.einsum("kp,kl,lp->p", by_block, spread, by_block)
    return covariance, freedom
