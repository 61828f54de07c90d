"""The parameters of the gyroscopes from their turns: generalised least squares, and what each turn is uncertain by.

A turn misses its direction of gravity by two angles, across the direction after it. Their covariance V is the sum of

- q int w^2 dt of the noise of the rate, q from the holds by windows of the same kind (`windows.noise_density`);
- the noise of both directions, from neighbouring windows within the holds, between which the gyroscopes say how the
  unit moved;
- the zero of the two holds, as far as their noise hides it, times int w dt;
- what all turns share: the zero of all holds, and the accelerometers' parameters;
- tau^2, what is beyond all this, such that the weighted squares equal their degrees of freedom; not below 0.

To the covariance of the parameters comes what all turns of a recording have alike: half the difference of the two
readings between samples, and the share p of samples that may be lost. A loss at random takes p off every scale factor,
and it scatters: a sample that is lost takes the angle of its step from the turn, so that V grows by p D,
D = sum (w dt)^2 (rho x u)(rho x u)', rho the rate. That is no noise of one size for all turns, so that restricted
likelihood tells p from tau^2, and from a rate that is another in each turn. The length of the runs of lost samples is
not known: p is said and carried in the uncertainty, never corrected by.

Source: Aitken, Proc. Roy. Soc. Edinburgh 55 (1935) 42 (generalised least squares); Birge, Phys. Rev. 40 (1932) 207
(squares that equal their degrees of freedom); `restricted_log_likelihood`.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from imulab.display import Note
from imulab.estimation.decisions import SAMPLES_LOST, SCALE_CHANGE, SCALE_CHANGES_WITH_RATE
from imulab.estimation.distributions import probability_text
from imulab.estimation.least_squares import chi_square_limit, f_test, restricted_log_likelihood
from imulab.estimation.rows import median
from imulab.procedures.tumble.gyro.rotation import weighted_turns
from imulab.procedures.tumble.gyro.solve import TurnSolution
from imulab.procedures.tumble.gyro.turns import (
    body_rate,
    by_directions,
    directions_missed,
    directions_smeared,
    misalignment,
    model,
)
from imulab.procedures.tumble.gyro.windows import mean_of_holds
from imulab.recording import Array

_ITERATIONS = 6
_SETTLED = 1e-3  # standard uncertainties: what a step leaves is of its square
_LEAST = 1e-9  # rad: no direction is known better, and no rounding is larger
_DOUBLINGS = 60
_FEWEST_LEFT = 6  # degrees of freedom that the test of linearity must leave
_LOST = np.geomspace(1e-5, 0.2, 21)  # shares of samples, beside none at all
_BEYOND = np.concatenate([[0.0], np.geomspace(0.05, 20.0, 8)])  # tau^2, in medians of the diagonal of V
_AROUND = np.geomspace(0.2, 5.0, 5)  # the same in that which was found
_WANDERS = np.geomspace(0.1, 4.0, 6)  # variance of a rate that each turn has to itself, in that of the zeros of holds


class Nonlinearity(Struct, frozen=True):
    """Probability of the residuals if nothing changes with the rate, and what changes by how much.

    Attributes
    ----------
    probability
        Of so large a gain by chance (F-test).
    odd
        Change of the scale factor from rest to the largest rate, relative, shape (3,).
    even
        Half its difference between the two directions at the largest rate, relative, shape (3,).
    odd_uncertainty, even_uncertainty
        Their standard uncertainties, shape (3,).
    largest
        Largest rate about each axis in the turns, rad/s, shape (3,).
    """

    probability: float
    odd: Array
    even: Array
    odd_uncertainty: Array
    even_uncertainty: Array
    largest: Array

    def notes(self) -> list[str]:
        """Say what changes with the rate, if it is beyond chance."""
        if not self.probability < SCALE_CHANGES_WITH_RATE.level:
            return []
        phrases = []
        for i, axis in enumerate("xyz"):
            for what, value, u in (
                ("from slow turns to", self.odd[i], self.odd_uncertainty[i]),
                ("between the two directions at", 2 * self.even[i], 2 * self.even_uncertainty[i]),
            ):
                if abs(value) > SCALE_CHANGE.limit * u:
                    rate = np.degrees(self.largest[i])
                    phrases.append(f"of {axis} by {100 * value:+.2g} % (u {100 * u:.1g} %) {what} {rate:.0f} deg/s")
        changes = "; ".join(phrases) or "of which axis, they do not tell"
        return [
            f"gyro: what the turns miss depends on the rate ({probability_text(self.probability)}): the scale factor "
            f"changes {changes}: the record holds for turns as fast as these; "
            "measure at the rates of use, or on a rate table"
        ]


class TurnEstimate(Struct, frozen=True):
    """What the turns say of the scaled parameters.

    Attributes
    ----------
    solution
        The turns with the parameters of this estimate.
    covariance
        Of the parameters, (p, p), without what `reading` and `lost` add.
    gain
        Change of the parameters with the residuals, (p, 2 m).
    across
        The two directions of each turn that its residuals are along, (m, 2, 3).
    root
        Lower triangular root of V, (2 m, 2 m).
    beyond
        tau^2, rad^2.
    reading
        Half the change of the parameters from one reading between samples to the other, (p,).
    smear
        Change of the parameters with what is not known of a low-pass filter that was taken off, (p, k).
    linearity
        Whether what the turns miss depends on the rate; None where too few turns are left to tell.
    lost
        Root mean square of the share of samples that may be lost.
    lost_most_likely
        The share that fits best.
    samples_lost
        Whether so good a fit is beyond chance.
    """

    solution: TurnSolution
    covariance: Array
    gain: Array
    across: Array
    root: Array
    beyond: float
    reading: Array
    smear: Array
    linearity: Nonlinearity | None = None
    lost: float = 0.0
    lost_most_likely: float = 0.0
    samples_lost: bool = False

    def common(self) -> Array:
        """Return what sampling, losses and a filter, which all turns have alike, move the parameters by, (p, 2 + k)."""
        loss = np.zeros(len(self.covariance))
        loss[:3] = self.lost
        return np.column_stack([self.reading, loss, self.smear])

    def total(self) -> Array:
        """Return the covariance with all that a recording has alike in all its turns, (p, p)."""
        total: Array = self.covariance + self.common() @ self.common().T
        return total

    def notes(self, step: float) -> list[str]:
        """Return what is to be said of these turns, sampled every `step` s."""
        messages: list[str] = []
        off = np.abs(self.reading[:3])
        if (off > np.sqrt(np.diag(self.total()))[:3] / 2).any():
            messages.append(
                Note(
                    f"gyro: {1 / step:.3g} Hz is slow for these turns: scale factors are uncertain by "
                    f"{1e6 * off.max():.0f} ppm for it, which their uncertainty covers: record at {2 / step:.3g} Hz, "
                    "or turn half as fast"
                )
            )
        if self.samples_lost:
            messages.append(f"gyro: {self.loss_note()}")
        return messages + ([] if self.linearity is None else self.linearity.notes())

    def loss_note(self) -> str:
        """Say how many samples seem to be lost, and what to do."""
        return (
            f"the turns miss as if {100 * self.lost_most_likely:.2g} % of the samples were lost: the scale factors may "
            "be low by as much, or by more if several are lost in a row, and their uncertainties are widened by it: "
            "record with a counter, or with time stamps of the sensor"
        )

    def project(self, vectors: Array) -> Array:
        """Return the parts of vectors, (3 m, k), along the residuals, (2 m, k)."""
        m = len(self.across)
        parts: Array = np.einsum("mij,mjk->mik", self.across, vectors.reshape(m, 3, -1)).reshape(2 * m, -1)
        return parts


def estimate_turns(solved: TurnSolution, directions: Array, zero: Array | None) -> TurnEstimate:
    """Return the estimate from turns that were found and tested with equal weights.

    Parameters
    ----------
    directions
        Covariance of the upward directions of all holds beside the noise in them, rad^2, (3 n, 3 n).
    zero
        Standard uncertainty of the output at rest, (3,), or None where the biases are fitted.
    """
    segments, scale, size = solved.segments, solved.scale, solved.theta.size
    theta: Array = np.concatenate([solved.theta, np.zeros(12 - size)])
    shell = TurnEstimate(
        solved, np.empty(0), np.empty(0), normals(segments.after), np.empty(0), 0.0, np.zeros(size), np.empty((size, 0))
    )
    matrix: Array = np.empty(0)
    root: Array = np.empty(0)
    by_zero: Array = np.empty(0)
    for _ in range(_ITERATIONS):
        left, slopes = model(segments, scale, theta, fit_bias=True)
        residual, jacobian = shell.project(left[:, None])[:, 0], shell.project(slopes)
        if not root.size:
            by_zero = jacobian[:, 9:] / scale
            matrix = _covariance_of_turns(solved, theta, shell, directions, zero, by_zero)
            beyond = _variance_beyond(matrix, jacobian[:, :size], residual)
            root = np.asarray(np.linalg.cholesky(matrix + beyond * np.eye(len(matrix))), dtype=np.float64)
        white = np.linalg.solve(root, np.column_stack([jacobian[:, :size], residual]))
        inverse = np.linalg.pinv(white[:, :-1])
        covariance, step = inverse @ inverse.T, inverse @ white[:, -1]
        theta[:size] -= step
        left -= slopes[:, :size] @ step
        if (np.abs(step) < _SETTLED * np.sqrt(np.diag(covariance))).all():
            break
    theta = theta[:size]
    gain = -inverse @ np.linalg.inv(root)
    other = replace(segments, output=segments.output + segments.half)
    moved = directions_missed(other, scale, theta) - directions_missed(segments, scale, theta)
    estimate = replace(
        shell, solution=replace(solved, theta=theta, residual=left, jacobian=slopes[:, :size]), covariance=covariance,
        gain=gain, root=root, beyond=beyond, reading=gain @ shell.project(moved[:, None])[:, 0],
    )  # fmt: skip
    estimate = replace(estimate, smear=_smear(estimate))
    columns, largest = rate_columns(estimate)
    estimate = replace(estimate, linearity=test_linearity(estimate, columns, largest))
    estimate, covariance = _with_losses(estimate, matrix, columns, by_zero)
    if estimate.samples_lost:
        # Losses take the more from a turn the faster it is, as an output that is not linear does.
        lossy = replace(estimate, root=np.asarray(np.linalg.cholesky(covariance), dtype=np.float64))
        estimate = replace(estimate, linearity=test_linearity(lossy, columns, largest))
    return estimate


def _smear(estimate: TurnEstimate) -> Array:
    """Return by how much the parameters move with one standard uncertainty of each part of a filter, (p, k)."""
    solved, readings = estimate.solution, estimate.solution.readings
    if not any(readings.case.smear):
        return np.empty((len(estimate.covariance), 0))
    derivatives = readings.derivatives[:, solved.kept]
    columns = estimate.project(directions_smeared(solved.segments, derivatives, solved.scale, solved.theta))
    white = np.linalg.solve(estimate.root, np.column_stack([estimate.project(solved.jacobian), columns]))
    design, added = white[:, : -columns.shape[1]], white[:, -columns.shape[1] :]
    across = added - design @ np.linalg.lstsq(design, added, rcond=None)[0]
    # across = Q R: one standard uncertainty along each direction is a column of the inverse of R.
    return np.asarray(estimate.gain @ columns @ np.linalg.inv(np.linalg.qr(across)[1]))


def normals(directions: Array) -> Array:
    """Return two directions across each of (m, 3) and each other, (m, 2, 3)."""
    axis = np.eye(3)[np.abs(directions).argmin(axis=1)]
    first = np.cross(directions, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


def _covariance_of_turns(
    solved: TurnSolution, theta: Array, shell: TurnEstimate, directions: Array, zero: Array | None, by_zero: Array
) -> Array:
    """Return V without tau^2, (2 m, 2 m); `by_zero` are the derivatives by the outputs at rest, (2 m, 3)."""
    segments, scale, m = solved.segments, solved.scale, len(solved.segments.start)
    flat = shell.project(by_directions(segments, scale, theta, len(directions) // 3))
    shared = flat @ directions @ flat.T
    if zero is not None:
        shared += by_zero * zero**2 @ by_zero.T
    blocks = shared.reshape(m, 2, m, 2)
    each = by_zero.reshape(m, 2, 3)
    moved = solved.rest.moved_variance * np.ones(3)
    blocks[range(m), :, range(m), :] += np.einsum("mij,j,mkj->mik", each, moved, each)
    density, direction = noise_of_turns(solved, theta)
    alone = density * segments.squared + 2 * direction + _LEAST**2
    blocks[range(m), :, range(m), :] += alone[:, None, None] * np.eye(2)
    return np.asarray(blocks.reshape(2 * m, 2 * m), dtype=np.float64)


def noise_of_turns(solved: TurnSolution, theta: Array) -> tuple[float, float]:
    """Return the density of the rates' noise, rad^2/s, and the variance that noise leaves in a direction, rad^2.

    Neighbouring windows of a hold differ by both noises, once the gyroscopes have said how the unit moved in between.
    That bounds the density where the unit sways, by which neighbouring mean rates differ too.
    """
    density, within = float(np.mean(solved.readings.density / solved.scale**2)), solved.readings.within(solved.rest)
    if not len(within.start):
        return density, 0.0
    left = directions_missed(within, solved.scale, theta).reshape(-1, 1, 3)
    miss = np.einsum("mij,mkj->mi", normals(within.after), left)
    square = float(mean_of_holds((miss**2).sum(axis=1, keepdims=True) / 2, within.attitude)[0])
    during = float(within.squared.mean())
    return min(density, square / during), max(square - density * during, 0.0) / 2


def _variance_beyond(matrix: Array, jacobian: Array, residual: Array) -> float:
    """Return tau^2 >= 0 with which the weighted squares of the best fit equal 2 m - p."""
    freedom = len(residual) - jacobian.shape[1]
    values, vectors = np.linalg.eigh(matrix)
    design, left = vectors.T @ jacobian, vectors.T @ residual

    def squares(beyond: float) -> float:
        weight = 1 / np.sqrt(np.maximum(values, _LEAST**2) + beyond)
        whole, column = design * weight[:, None], left * weight
        return float(((column - whole @ np.linalg.lstsq(whole, column, rcond=None)[0]) ** 2).sum())

    if freedom < 1 or squares(0.0) <= freedom:
        return 0.0
    low, high = 0.0, float(residual @ residual)
    for _ in range(_DOUBLINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if squares(middle) > freedom else (low, middle)
    return (low + high) / 2


def _with_losses(estimate: TurnEstimate, matrix: Array, columns: Array, by_zero: Array) -> tuple[TurnEstimate, Array]:
    """Return the estimate with the share of samples that may be lost, and the likeliest covariance with losses.

    The share is the root mean square over p and tau^2, weighted by their likelihood.

    Before the data none is lost with probability 1/2; else every share from .001 to 20 % is as probable on a scale of
    logarithms. Where the output seems not to be linear, the `columns` of `rate_columns` are fitted beside: what they
    explain is no loss, nor what a zero of each turn's own explains, as far as the zeros of the holds scatter; `by_zero`
    are the derivatives by outputs at rest, (2 m, 3).
    """
    linearity, jacobian = estimate.linearity, estimate.project(estimate.solution.jacobian)
    if linearity is not None and linearity.probability < SCALE_CHANGES_WITH_RATE.level:
        jacobian = np.column_stack([jacobian, columns])
    residual = estimate.project(estimate.solution.residual[:, None])[:, 0]
    beyond = np.concatenate([median(np.diag(matrix)) * _BEYOND, estimate.beyond * _AROUND])

    def likelihoods(shares: Array, further: Array) -> Array:
        return restricted_log_likelihood(matrix + shares[:, None, None] * further, jacobian, residual, beyond)

    none = likelihoods(np.append(0.0, _WANDERS), _own_rates(by_zero * estimate.solution.rest.scatter))
    by_loss = loss_covariance(estimate)
    logs = likelihoods(_LOST, by_loss)
    top = max(none.max(), logs.max())
    lost, kept = np.exp(logs - top).mean(axis=1), float(np.exp(none - top).mean(axis=1).max())
    posterior = lost / len(_LOST) / (lost.mean() + kept)
    best, scatter = (int(k) for k in np.unravel_index(int(logs.argmax()), logs.shape))
    gained = 2 * float(logs.max() - none.max())
    estimate = replace(
        estimate,
        lost=float(np.sqrt(posterior @ _LOST**2)),
        lost_most_likely=float(_LOST[best]),
        # No share lies below 0: by chance half of all gains are 0.
        samples_lost=gained > chi_square_limit(1, 2 * SAMPLES_LOST.level),
    )
    return estimate, matrix + _LOST[best] * by_loss + beyond[scatter] * np.eye(len(matrix))


def _own_rates(by_rate: Array) -> Array:
    """Return the covariance of residuals by a rate of each turn's own, of variance 1 about each axis, (2 m, 2 m)."""
    m = len(by_rate) // 2
    each = by_rate.reshape(m, 2, 3)
    blocks = np.zeros((m, 2, m, 2))
    blocks[range(m), :, range(m), :] = each @ np.swapaxes(each, 1, 2)
    return blocks.reshape(2 * m, 2 * m)


def loss_covariance(estimate: TurnEstimate) -> Array:
    """Return D, by which V grows with the share of samples that are lost one by one, (2 m, 2 m)."""
    solved = estimate.solution
    segments = solved.segments
    rate = body_rate(segments, solved.scale, solved.theta)
    turns = weighted_turns(rate, segments.step, np.empty((*rate.shape[:2], 0)), squares=True)
    x, y, z = segments.before.T
    cross = np.zeros((len(x), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross -= np.swapaxes(cross, 1, 2)
    arms = estimate.across @ turns.matrix @ cross
    # Pieces of one step are lost together.
    each = solved.readings.span.pieces * arms @ turns.squares @ np.swapaxes(arms, 1, 2)
    m = len(each)
    whole = np.zeros((m, 2, m, 2))
    whole[range(m), :, range(m), :] = each
    return whole.reshape(2 * m, 2 * m)


# Whether the scale factors of the gyroscopes change with the rate, from what the turns miss.


def rate_columns(estimate: TurnEstimate) -> tuple[Array, Array]:
    """Return how the residuals change with terms in the square and the cube of the rate, and the largest rates.

    M = S (A + b + even_i A_i^2 / w_i + odd_i A_i^3 / w_i^2),   A = T w,  w_i the largest rate of gyro i in the turns

    Returns
    -------
    tuple
        Derivatives by odd_x .. odd_z, even_x .. even_z, rad, (2 m, 6), and w_i, rad/s, (3,).
    """
    solved = estimate.solution
    segments, scale, theta = solved.segments, solved.scale, solved.theta
    rate, t = body_rate(segments, scale, theta), misalignment(theta)
    sensed, moving = rate @ t.T, segments.step > 0
    largest, powers = np.empty(3), np.empty((*moving.shape, 6))
    for axis in range(3):  # one by one: NumPy is slow along axes of three
        each, cube, square = sensed[:, :, axis], powers[:, :, axis], powers[:, :, 3 + axis]
        largest[axis] = max(np.abs(each).max(where=moving, initial=0.0), 1e-12)
        share = each / largest[axis]
        np.multiply(share, each, out=square)
        np.multiply(share, square, out=cube)
    turns = weighted_turns(rate, segments.step, powers)
    inverse = np.linalg.inv(t)
    columns = [
        np.einsum("mij,mj->mi", turns.matrix, np.cross(segments.before, turns.weighted[:, k] @ -inverse[:, k % 3]))
        for k in range(6)
    ]
    return estimate.project(np.column_stack([column.ravel() for column in columns])), largest


def test_linearity(estimate: TurnEstimate, columns: Array, largest: Array) -> Nonlinearity | None:
    """Return whether what the turns miss depends on the rate; None where too few turns are left to tell.

    All terms of `rate_columns` are tried together beside the parameters of the fit (F-test). They are tested and said,
    never fitted: turns by hand seldom vary enough in rate to tell S from them.
    """
    count, size = len(estimate.root), estimate.solution.theta.size
    freedom = count - size - 6
    if freedom < _FEWEST_LEFT:
        return None
    jacobian, residual = (
        estimate.project(estimate.solution.jacobian),
        estimate.project(estimate.solution.residual[:, None]),
    )
    whole = np.linalg.solve(estimate.root, np.column_stack([jacobian, columns, residual]))
    design, left = whole[:, :-1], whole[:, -1]
    length = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    design = design / length

    def fitted(columns: int) -> tuple[Array, float]:
        answer = np.linalg.lstsq(design[:, :columns], left, rcond=None)[0]
        return answer, float(((left - design[:, :columns] @ answer) ** 2).sum())

    cost, (answer, larger) = fitted(size)[1], fitted(size + 6)
    spread = np.linalg.pinv(design.T @ design) * (larger / freedom)
    u = np.sqrt(np.diag(spread)[size:]) / length[size:]
    # The residual is carried less true direction: parameters that lower it have its sign reversed.
    value = -answer[size:] / length[size:]
    probability = f_test(cost, size, larger, size + 6, count)
    return Nonlinearity(probability, value[:3], value[3:], u[:3], u[3:], largest)
