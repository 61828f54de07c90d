"""The board by Gauss-Newton steps in which the motion of every sample is eliminated (variable projection).

With the whitened derivatives H by a sample's motion and J by the board, and the residual e: M = H'H, v = H'e, G = H'J,
S = sum J'J - G' M^-1 G, q = sum J'e - G' M^-1 v, X += S^-1 q; then two Newton steps of each sample's s, al, w.
Readings are taken anew at t + latency after each step (quintic splines).

Noise in motion is not noise at rest. A chip that samples by a clock of its own gives readings 0 to 1 ms old, which adds
``tau^2 d d'``, ``d = Tg al``, to the covariance of its gyroscopes; what else there is scales the readings of a sample,
accelerometers and gyroscopes apart. The covariance is the larger of S^-1 and a sandwich over stretches of the motion.

Biases of accelerometers drift. What the rests scatter beyond their noise is an error of each, however long it lasts; in
each half of the motion every bias is off by an unknown, whose variance is what rests and halves disagree by.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.gyro_array.imus.model import (
    ACCEL,
    ACCEL_BIAS,
    ACCEL_LATENCY,
    ACCELERATION,
    FORCE,
    GYRO,
    GYRO_LATENCY,
    NUMBERS,
    OF_ACCEL,
    OF_GYRO,
    POSITION,
    RATE,
    Board,
    board_jacobian,
    motion_jacobian,
    predicted,
)
from imulab.recording import Array

PRIOR = np.empty(NUMBERS)
"""Standard deviations of what is taken for granted of each number of an IMU, about its nominal value; SI."""
PRIOR[ACCEL], PRIOR[ACCEL_BIAS], PRIOR[POSITION], PRIOR[ACCEL_LATENCY] = 0.05, 0.3, 0.1, 0.01
PRIOR[GYRO], PRIOR[25:28], PRIOR[GYRO_LATENCY] = 0.05, np.inf, 0.01
_LENGTH = 1e-4  # m/s^2, by which |s| at rest may differ from gravity
_AT_ONCE = 1 << 22  # numbers of the largest array of a part of the samples
_STEPS, _LAST = 5, 4  # Gauss-Newton steps at most, at first and with the last weights; one with those between
_SMALL = 1.0  # squared length of a step, in standard deviations, that the next divides by a hundred or more
_REWEIGHTED = 3
_ACCELERATION = 1e3  # rad/s^2, standard deviation of each sample's
_SAME_SIZE = 1e-5  # of the mean scale factor, between halves of one motion
STRETCHES = 20
"""Parts of the motion whose scatter is compared with the stated covariance."""


@dataclass(frozen=True)
class Measured:
    """Readings of a board: means at rest, and samples in motion that are read at any time nearby; SI.

    Attributes
    ----------
    accel, gyro
        Splines over time of the readings, of columns IMU by IMU, shape (3 K,).
    time, first
        Times of the samples in motion, s, shape (n,), and where each unbroken run of them begins.
    rest_accel, rest_gyro, rest_count
        Means, shape (rests, K, 3), and the numbers of samples behind them.
    accel_noise, gyro_noise
        Standard deviation of a sample at rest, shape (K, 3).
    nominal
        How each IMU is turned on the board, signed permutations as a rule, shape (K, 3, 3).
    """

    accel: Any
    gyro: Any
    time: Array
    first: NDArray[np.intp]
    rest_accel: Array
    rest_gyro: Array
    rest_count: Array
    accel_noise: Array
    gyro_noise: Array
    nominal: Array
    gravity: float

    @property
    def count(self) -> int:
        """Number of IMUs."""
        return len(self.nominal)

    def at(self, board: Board) -> tuple[Array, Array]:
        """Return the readings at each sample's time plus each IMU's latency, shape (n, K, 3) each."""
        return tuple(
            np.stack([spline[k](self.time + late) for k, late in enumerate(board.numbers[:, number].tolist())], axis=1)
            for spline, number in ((self.accel, ACCEL_LATENCY), (self.gyro, GYRO_LATENCY))
        )  # type: ignore[return-value]


@dataclass(frozen=True)
class Weights:
    """By what the standard deviation of each sample is larger than at rest, and the age of readings, s.

    `drift` and `offset`, m/s^2: standard deviations of the accelerometers' biases from rest to rest, and in motion.
    """

    accel: Array
    gyro: Array
    rest: Array
    age: float = 0.0
    drift: float = 0.0
    offset: float = 0.0


@dataclass(frozen=True)
class Held:
    """What is taken for granted of a linear function of the board's numbers, whose row has shape (29 K,)."""

    row: Array
    value: float
    u: float


@dataclass(frozen=True)
class Solution:
    """A board, the motion that goes with it, shape (n, 9), and the equations that they solve.

    Attributes
    ----------
    force
        At each rest, shape (rests, 3).
    information, scores
        S of the two halves of the motion, shape (2, 29 K, 29 K), and q of its stretches, shape (STRETCHES, 29 K).
    at_rest, score_at_rest
        Those of the rests.
    prior, pull
        Those of what is taken for granted, without the size.
    free
        Which numbers the gauge leaves free, shape (29 K,).
    residuals
        Of accelerometers and gyroscopes in motion, shape (n, K, 3) each.
    """

    board: Board
    motion: Array
    weights: Weights
    force: Array
    information: Array
    scores: Array
    at_rest: Array
    score_at_rest: Array
    prior: Array
    pull: Array
    free: NDArray[np.bool_]
    residuals: tuple[Array, Array]

    def covariance(self, size: Held) -> tuple[Array, float]:
        """Return the covariance with a size, shape (29 K, 29 K), and the median factor by which stretches widen it."""
        free = self.free
        information, scores = _with_offsets(self.information, self.scores, self.weights.offset)
        matrix = information.sum(0) + self.at_rest + self.prior + np.multiply.outer(size.row, size.row) / size.u**2
        inverse = np.linalg.inv(matrix[np.ix_(free, free)])
        blocks = inverse @ scores[:, free].T
        blocks -= blocks.mean(axis=1, keepdims=True)
        spread = np.sqrt(np.square(blocks).sum(1) * STRETCHES / (STRETCHES - 1))
        wider = np.maximum(1.0, spread / np.sqrt(np.diag(inverse)))
        covariance = np.zeros(matrix.shape)
        covariance[np.ix_(free, free)] = inverse * np.multiply.outer(wider, wider)
        return covariance, float(np.median(wider))

    def halves(self, size: Held) -> tuple[Array, Array]:
        """Return by what the numbers of the second half of the motion exceed those of the first, and its deviation.

        Without what a common factor on all positions explains; shape (K, 29) each.
        """
        free = self.free
        information, all_scores = _with_offsets(self.information, self.scores, self.weights.offset)
        parts = np.split(all_scores, 2)
        steps, variance = [], np.zeros(int(free.sum()))
        more = self.at_rest + self.prior + np.multiply.outer(size.row, size.row) / _SAME_SIZE**2
        for half, scores in zip(information, parts, strict=True):
            inverse = np.linalg.inv((half + more)[np.ix_(free, free)])
            steps.append(inverse @ (scores.sum(0) + self.score_at_rest + self.pull)[free])
            variance += np.diag(inverse)
        apart, deviation = np.zeros(len(free)), np.full(len(free), np.inf)
        apart[free], deviation[free] = steps[1] - steps[0], np.sqrt(variance)
        by_imu, its_deviation = apart.reshape(-1, NUMBERS), deviation.reshape(-1, NUMBERS)
        position, weight = self.board.position, its_deviation[:, POSITION] ** -2.0
        larger = float((weight * position * by_imu[:, POSITION]).sum() / (weight * position**2).sum())
        by_imu[:, POSITION] -= larger * position
        return by_imu, its_deviation


def mean_scale(measured: Measured) -> Array:
    """Return the row of the mean scale factor of all gyroscopes, shape (29 K,)."""
    row = np.zeros((measured.count, NUMBERS))
    row[:, GYRO] = measured.nominal.reshape(-1, 9) / (3 * measured.count)
    return row.ravel()


def common_accel(measured: Measured) -> list[Array]:
    """Return the rows of the mean scale factors along the body axes and of the mean biases, shape (29 K,) each."""
    rows = []
    for axis in range(3):
        scale, bias = np.zeros((measured.count, NUMBERS)), np.zeros((measured.count, NUMBERS))
        column = measured.nominal[:, :, axis]
        along = np.zeros((measured.count, 3, 3))
        along[:, :, axis] = column
        scale[:, ACCEL] = along.reshape(-1, 9) / measured.count
        bias[:, ACCEL_BIAS] = column / measured.count
        rows += [scale.ravel(), bias.ravel()]
    return [*rows[::2], *rows[1::2]]


@dataclass(frozen=True)
class _Rows:
    """Whitened rows of some samples.

    Attributes
    ----------
    accel_scale, gyro_scale
        What whitens them: scales, shape (n, K, 3), and matrices, shape (n, K, 3, 3).
    by_accel, by_gyro
        H of the accelerometers by s, al, w, shape (n, 3 K, 9), and of the gyroscopes by w, shape (n, 3 K, 3).
    accel, gyro
        Residuals, shape (n, 3 K).
    """

    accel_scale: Array
    gyro_scale: Array
    by_accel: Array
    by_gyro: Array
    accel: Array
    gyro: Array

    def normal(self) -> Array:
        """Return M = H'H; IMUs in one line do not tell the angular acceleration about that line."""
        matrix = self.by_accel.swapaxes(1, 2) @ self.by_accel
        matrix[:, RATE, RATE] += self.by_gyro.swapaxes(1, 2) @ self.by_gyro
        matrix[:, ACCELERATION, ACCELERATION] += np.eye(3) / _ACCELERATION**2
        return np.asarray(matrix)

    def score(self) -> Array:
        """Return v = H'e, shape (n, 9)."""
        v = (self.accel[:, None] @ self.by_accel)[:, 0]
        v[:, RATE] += (self.gyro[:, None] @ self.by_gyro)[:, 0]
        return np.asarray(v)


class _Problem:
    """Residuals and derivatives of a board at its samples, whitened."""

    def __init__(self, measured: Measured, held: Sequence[Held]) -> None:
        self.measured, self.held = measured, held
        count = measured.count
        self.free = np.ones((count, NUMBERS), dtype=bool)
        self.free[0, [1, 2, 5]] = False  # Ta_1 is lower triangular: that is the body frame
        self.free[0, POSITION] = False
        self.free[0, GYRO_LATENCY] = False
        self.centre = np.zeros((count, NUMBERS))
        self.centre[:, ACCEL] = self.centre[:, GYRO] = measured.nominal.reshape(count, 9)
        self.prior = np.broadcast_to(PRIOR, (count, NUMBERS)).copy()

    def whitened(self, board: Board, motion: Array, weights: Weights, part: slice) -> tuple[Array, Array]:
        """Return the scale of each accelerometer's row, (n, K, 3), and the matrix of each gyroscope triad's rows."""
        measured = self.measured
        accel = 1 / (measured.accel_noise * weights.accel[part, None, None])
        noise = measured.gyro_noise * weights.gyro[part, None, None]
        gyro = np.eye(3) / noise[..., None]
        if weights.age:
            # (D^2 + t^2 d d')^-1/2 is a projection after D^-1.
            v = np.einsum("kij,nj->nki", board.gyro, motion[part, ACCELERATION]) * weights.age / noise
            square = np.square(v).sum(-1)
            less = np.where(square > 0, (1 / np.sqrt(1 + square) - 1) / np.maximum(square, 1e-300), 0.0)
            gyro = (np.eye(3) + less[..., None, None] * v[..., :, None] * v[..., None, :]) @ gyro
        return accel, gyro

    def samples(self, board: Board, motion: Array, readings: tuple[Array, Array], weights: Weights) -> Array:
        """Return the motion after a Newton step of each sample."""
        moved = motion.copy()
        for part, _ in self._parts():
            rows = self._by_motion(board, motion, readings, weights, part)
            moved[part] += np.linalg.solve(rows.normal(), rows.score()[..., None])[..., 0]
        return moved

    def _by_motion(
        self, board: Board, motion: Array, readings: tuple[Array, Array], weights: Weights, part: slice
    ) -> _Rows:
        n, count = part.stop - part.start, self.measured.count
        accel, gyro = self.whitened(board, motion, weights, part)
        _, its_accel, its_gyro = predicted(board, motion[part])
        by_accel, by_gyro = motion_jacobian(board, motion[part])
        by_accel *= accel[..., None]
        return _Rows(
            accel, gyro, by_accel.reshape(n, 3 * count, 9), (gyro @ by_gyro).reshape(n, 3 * count, 3),
            ((readings[0][part] - its_accel) * accel).reshape(n, 3 * count),
            (gyro @ (readings[1][part] - its_gyro)[..., None]).reshape(n, 3 * count),
        )  # fmt: skip

    def equations(
        self, board: Board, motion: Array, readings: tuple[Array, Array], weights: Weights
    ) -> tuple[Array, Array]:
        """Return S of two halves, shape (2, 29 K, 29 K), and q of STRETCHES parts of the motion, without priors.

        The gyroscopes read w alone, the last of a sample's unknowns: with M = L L', their columns of L^-1 G have three
        rows, not nine.
        """
        count = self.measured.count
        across = [np.zeros((2, a * count, b * count)) for a, b in ((16, 16), (16, 13), (13, 13))]
        within = [np.zeros((2, count, size, size)) for size in (16, 13)]
        scores = np.zeros((STRETCHES, count, NUMBERS))
        change = self.changes(motion)
        for part, stretch in self._parts():
            half = 2 * stretch // STRETCHES
            rows = self._by_motion(board, motion, readings, weights, part)
            n = part.stop - part.start
            inverse = np.linalg.inv(np.linalg.cholesky(rows.normal()))
            step = inverse.swapaxes(1, 2) @ (inverse @ rows.score()[..., None])
            left = (rows.accel - (rows.by_accel @ step)[..., 0], rows.gyro - (rows.by_gyro @ step[:, RATE])[..., 0])
            by_board = board_jacobian(board, motion[part], change[part])
            by_board = by_board[0] * rows.accel_scale[..., None], rows.gyro_scale @ by_board[1]
            z = []
            for k, (mine, h, lower) in enumerate(
                zip(by_board, (rows.by_accel, rows.by_gyro), (inverse, inverse[:, RATE, RATE]), strict=True)
            ):
                columns, size = (OF_ACCEL, OF_GYRO)[k], mine.shape[-1]
                turned = (lower @ h.swapaxes(1, 2)).reshape(n, len(lower[0]), count, 3).swapaxes(1, 2)
                z.append((turned @ mine).swapaxes(1, 2).reshape(n, -1, size * count))
                by_imu = mine.swapaxes(0, 1).reshape(count, 3 * n, size)
                within[k][half] += by_imu.swapaxes(1, 2) @ by_imu
                off = left[k].reshape(n, count, 3).swapaxes(0, 1).reshape(count, 3 * n, 1)
                scores[stretch, :, columns] += (by_imu.swapaxes(1, 2) @ off)[..., 0]
            last = z[0][:, RATE].reshape(3 * n, -1)
            whole, gyro = z[0].reshape(9 * n, -1), z[1].reshape(3 * n, -1)
            across[0][half] += whole.T @ whole
            across[1][half] += last.T @ gyro
            across[2][half] += gyro.T @ gyro
        return _assembled(across, within), scores.reshape(STRETCHES, -1)

    def at_rest(self, board: Board, force: Array, weights: Weights) -> tuple[Array, Array, Array]:
        """Return S and q of the rests, and the force at each after a Newton step, shape (rests, 3)."""
        measured, count = self.measured, self.measured.count
        size = NUMBERS * count
        motion = np.zeros((len(force), 9))
        motion[:, FORCE] = force
        by_accel, by_gyro = board_jacobian(board, motion, np.zeros_like(motion))
        _, its_accel, its_gyro = predicted(board, motion)
        factor, count_at_rest = weights.rest[:, None, None], measured.rest_count[:, None, None]
        accel = 1 / (factor * np.sqrt(np.square(measured.accel_noise) / count_at_rest + weights.drift**2))
        gyro = np.sqrt(count_at_rest) / (factor * measured.gyro_noise)
        e = np.concatenate([(measured.rest_accel - its_accel) * accel, (measured.rest_gyro - its_gyro) * gyro], axis=1)
        j = np.zeros((len(force), 2 * count, 3, count, NUMBERS))
        h = np.zeros((len(force), 2 * count, 3, 3))
        for k in range(count):
            j[:, k, :, k, OF_ACCEL] = by_accel[:, k] * accel[:, k, :, None]
            j[:, count + k, :, k, OF_GYRO] = by_gyro[:, k] * gyro[:, k, :, None]
            h[:, k] = board.accel[k] * accel[:, k, :, None]
        length = np.linalg.norm(force, axis=1)
        rows = 6 * count + 1
        h = np.concatenate([h.reshape(-1, rows - 1, 3), (force / length[:, None] / _LENGTH)[:, None]], axis=1)
        e = np.concatenate([e.reshape(-1, rows - 1), ((measured.gravity - length) / _LENGTH)[:, None]], axis=1)
        j = np.concatenate([j.reshape(-1, rows - 1, size), np.zeros((len(force), 1, size))], axis=1)
        m, v, g = h.swapaxes(1, 2) @ h, np.einsum("nri,nr->ni", h, e), h.swapaxes(1, 2) @ j
        total = np.einsum("nri,nrj->ij", j, j, optimize=True) - np.einsum(
            "nij,nik->jk", g, np.linalg.solve(m, g), optimize=True
        )
        step = np.linalg.solve(m, v[..., None])[..., 0]
        score = np.einsum("nri,nr->i", j, e) - np.einsum("nij,ni->j", g, step)
        return total, score, force + step

    def changes(self, motion: Array) -> Array:
        """Return the derivative of the motion by time, shape (n, 9): central, of means of three; 0 at ends of runs.

        The motion of a sample has the noise of its own readings, with which a sharper derivative would correlate.
        """
        time = self.measured.time
        change = np.zeros_like(motion)
        run = np.searchsorted(self.measured.first, np.arange(len(time)), side="right")
        whole = run[4:] == run[:-4]
        rise = motion[4:] + motion[3:-1] - motion[1:-3] - motion[:-4]
        change[2:-2][whole] = (rise / (3 * (time[3:-1] - time[1:-3]))[:, None])[whole]
        return change

    def priors(self, board: Board) -> tuple[Array, Array]:
        """Return the information of what is taken for granted, shape (29 K, 29 K), and its pull, shape (29 K,)."""
        inverse = np.where(np.isfinite(self.prior), self.prior, np.inf) ** -2.0
        information, pull = np.diag(inverse.ravel()), (inverse * (self.centre - board.numbers)).ravel()
        for held in self.held:
            information += np.multiply.outer(held.row, held.row) / held.u**2
            pull += held.row * (held.value - float(held.row @ board.numbers.ravel())) / held.u**2
        return information, pull

    def _parts(self) -> Iterator[tuple[slice, int]]:
        """Yield the samples in parts, none of which reaches beyond the stretch that is yielded with it."""
        size = max(16, _AT_ONCE // (9 * NUMBERS * self.measured.count))
        edges = (np.arange(STRETCHES + 1) * len(self.measured.time) // STRETCHES).tolist()
        for stretch, (begin, end) in enumerate(itertools.pairwise(edges)):
            for start in range(begin, end, size):
                yield slice(start, min(start + size, end)), stretch

    def weights(
        self, board: Board, motion: Array, readings: tuple[Array, Array], left: Array, drift: float, offset: float
    ) -> Weights:
        """Return how much noisier than at rest each sample is, after the age of the readings is accounted for.

        `left` are the accelerometers' residuals at rest, shape (rests, K, 3).
        """
        count = self.measured.count
        _, its_accel, its_gyro = predicted(board, motion)
        # Only by what the IMUs differ: what they have in common is the motion, or the model. Their age moves them along
        # the angular acceleration; across it they show their noise.
        apart = np.einsum("kij,nkj->nki", np.linalg.inv(board.gyro), readings[1] - its_gyro)
        apart -= apart.mean(axis=1, keepdims=True)
        acceleration = np.square(motion[:, ACCELERATION]).sum(1)
        along = np.square(np.einsum("nki,ni->nk", apart, motion[:, ACCELERATION])).sum(1) / acceleration
        usual = float(np.square(self.measured.gyro_noise).mean())
        gyro = _factors((np.square(apart).sum((1, 2)) - along) / usual, 2 * (count - 1))
        older = float((along / (count - 1) - usual * gyro**2).sum()) / float(acceleration.sum())
        age = math.sqrt(older) if older > 0 else 0.0
        square_accel = np.square((readings[0] - its_accel) / self.measured.accel_noise).sum((1, 2))
        variance = np.square(self.measured.accel_noise) / self.measured.rest_count[:, None, None] + drift**2
        return Weights(
            _factors(square_accel, max(3 * count - 6, 0)),
            gyro,
            _factors((np.square(left) / variance).sum((1, 2)), 3 * count - 3),
            age,
            drift,
            offset,
        )

    def left_at_rest(self, board: Board, force: Array) -> Array:
        """Return the accelerometers' residuals at rest, shape (rests, K, 3)."""
        at_rest = np.zeros((len(force), 9))
        at_rest[:, FORCE] = force
        return np.asarray(self.measured.rest_accel - predicted(board, at_rest)[1])

    def drift(self, left: Array, matrix: Array, still: Array) -> float:
        """Return the standard deviation of biases from rest to rest, m/s^2, by the median rest's residuals.

        `matrix` and `still` are the information of all and of the rests, of the free numbers; what the board's numbers
        take up of the residuals is in them.
        """
        of_accel = np.flatnonzero(np.nonzero(self.free)[1] < OF_ACCEL.stop)
        absorbed = float(np.linalg.solve(matrix, still)[of_accel, of_accel].sum())
        freedom = left[0].size - 2 - absorbed / len(left)  # of a rest
        if freedom < 1:
            return 0.0
        usual = (np.square(self.measured.accel_noise) / self.measured.rest_count[:, None, None]).mean()
        median = (1 - 2 / (9 * freedom)) ** 3  # of chi-square over its freedom (Wilson, Hilferty 1931)
        square = float(np.median(np.square(left).sum((1, 2)))) / (freedom * median)
        return math.sqrt(max(square - float(usual), 0.0))


def _bias_places(size: int) -> NDArray[np.intp]:
    """Return the places of the accelerometers' biases among so many numbers, shape (3 K,)."""
    return np.arange(size).reshape(-1, NUMBERS)[:, ACCEL_BIAS].ravel()


def _with_offsets(information: Array, scores: Array, offset: float) -> tuple[Array, Array]:
    """Return S of halves and q of stretches where in each half every bias is off by an unknown, of `offset` m/s^2."""
    if not offset:
        return information, scores
    biases = _bias_places(scores.shape[1])
    halves, parts = [], []
    for half, its_scores in zip(information, np.split(scores, 2), strict=True):
        unknown = half[np.ix_(biases, biases)] + np.eye(len(biases)) / offset**2
        gain = np.linalg.solve(unknown, half[biases])
        halves.append(half - half[:, biases] @ gain)
        parts.append(its_scores - its_scores[:, biases] @ gain)
    return np.array(halves), np.concatenate(parts)


def _offset(information: Array, scores: Array, rest: Array, slope: Array, free: NDArray[np.bool_]) -> float:
    """Return the standard deviation of biases in halves of the motion from those at rest, m/s^2, by what they disagree.

    `information`, `scores` are S of the halves and q of the stretches, `rest` and `slope` those of all else, of which
    `free` are fitted.
    """
    biases = _bias_places(len(slope))
    size = len(biases)
    across = np.concatenate([half[np.ix_(free, biases)] for half in information], axis=1)
    whole = (information.sum(0) + rest)[np.ix_(free, free)]
    solved = np.linalg.solve(whole, np.column_stack([across, (scores.sum(0) + slope)[free]]))
    information_of_offsets = -across.T @ solved[:, :-1]
    for k, half in enumerate(information):
        information_of_offsets[k * size : (k + 1) * size, k * size : (k + 1) * size] += half[np.ix_(biases, biases)]
    by_half = np.concatenate([part.sum(0)[biases] for part in np.split(scores, 2)])
    values, directions = np.linalg.eigh(information_of_offsets)
    along = directions.T @ (by_half - across.T @ solved[:, -1])
    known = values > 1e-6 * values[-1]
    excess = float((np.square(along[known]) / values[known] - 1).sum())
    return math.sqrt(max(excess / float(values[known].sum()), 0.0))


def _assembled(across: list[Array], within: list[Array]) -> Array:
    """Return what the IMUs' own products exceed those across by, of columns IMU by IMU, shape (2, 29 K, 29 K)."""
    count = within[0].shape[1]
    total = np.zeros((2, count, NUMBERS, count, NUMBERS))
    for matrix, rows, columns in zip(across, (OF_ACCEL, OF_ACCEL, OF_GYRO), (OF_ACCEL, OF_GYRO, OF_GYRO), strict=True):
        block = matrix.reshape(2, count, rows.stop - rows.start, count, columns.stop - columns.start)
        total[:, :, rows, :, columns] = -block
        if rows != columns:
            total[:, :, columns, :, rows] = -block.transpose(0, 3, 4, 1, 2)
    for each, columns in zip(within, (OF_ACCEL, OF_GYRO), strict=True):
        for k in range(count):
            total[:, k, columns, k, columns] += each[:, k]
    return total.reshape(2, count * NUMBERS, count * NUMBERS)


def _factors(square: Array, freedom: int) -> Array:
    return np.maximum(1.0, np.sqrt(square / freedom)) if freedom else np.ones_like(square)


def solve(
    measured: Measured, start: Board, motion: Array, size: Held, held: Sequence[Held] = (), *, steps: int = _STEPS
) -> Solution:
    """Return the board that fits best, from a start that is off by some degrees, percent and milliseconds.

    `motion` are the s, al, w of each sample to start from, shape (n, 9); `size` is held with what else is `held`.
    """
    problem = _Problem(measured, [size, *held])
    board, motion = start, motion.copy()
    ones = np.ones(len(motion))
    weights = Weights(ones, ones, np.ones(len(measured.rest_count)))
    force = np.einsum("kji,nkj->ni", measured.nominal, measured.rest_accel) / measured.count
    free = problem.free.ravel()
    for stage in range(_REWEIGHTED + 1):
        for _ in range(steps if stage == 0 else _LAST if stage == _REWEIGHTED else 1):
            readings = measured.at(board)
            if stage == 0:
                # Each time from the gyroscopes: forces alone fit a rate and its opposite alike.
                motion[:, RATE] = np.einsum("kij,nkj->ni", np.linalg.inv(board.gyro), readings[1] - board.gyro_bias)
                motion[:, RATE] /= measured.count
                motion = problem.samples(board, motion, readings, weights)
                force = problem.at_rest(board, force, weights)[2]
            motion = problem.samples(board, motion, readings, weights)
            still, score, force = problem.at_rest(board, force, weights)
            total, scores = problem.equations(board, motion, readings, weights)
            information, pull = problem.priors(board)
            moving, its_scores = _with_offsets(total, scores, weights.offset)
            matrix = (moving.sum(0) + still + information)[np.ix_(free, free)]
            step, slope = np.zeros(len(free)), (its_scores.sum(0) + score + pull)[free]
            step[free] = np.linalg.solve(matrix, slope)
            board = Board(board.numbers + step.reshape(board.numbers.shape))
            if float(slope @ step[free]) < _SMALL:
                break
        if stage < _REWEIGHTED:
            left = problem.left_at_rest(board, force)
            drift = problem.drift(left, matrix, still[np.ix_(free, free)])
            offset = _offset(total, scores, still + information, score + pull, free)
            weights = problem.weights(board, motion, measured.at(board), left, drift, max(drift, offset))
    readings = measured.at(board)
    motion = problem.samples(board, motion, readings, weights)
    _, accel, gyro = predicted(board, motion)
    information = information - np.multiply.outer(size.row, size.row) / size.u**2
    return Solution(
        board, motion, weights, force, total, scores, still, score, information, pull, free,
        (readings[0] - accel, readings[1] - gyro),
    )  # fmt: skip


def expected_covariance(measured: Measured, board: Board, motion: Array, force: Array, size: Held) -> Array:
    """Return the covariance of a fit to readings of such a board in such a motion, shape (29 K, 29 K)."""
    problem = _Problem(measured, [size])
    ones = np.ones(len(motion))
    weights = Weights(ones, ones, np.ones(len(force)))
    _, accel, gyro = predicted(board, motion)
    information = problem.equations(board, motion, (accel, gyro), weights)[0].sum(0)
    information += problem.at_rest(board, force, weights)[0] + problem.priors(board)[0]
    free = problem.free.ravel()
    covariance = np.zeros(information.shape)
    covariance[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
    return covariance


def with_scale(solution: Solution, factor: float) -> Solution:
    """Return the board and motion of rates that are `factor` times as large; nothing that is read changes."""
    numbers, motion = solution.board.numbers.copy(), solution.motion.copy()
    numbers[:, POSITION] /= factor**2
    numbers[:, GYRO] /= factor
    motion[:, RATE] *= factor
    motion[:, ACCELERATION] *= factor**2
    return replace(solution, board=Board(numbers), motion=motion)
