"""The size of a board: gravity turned from rest to rest by the fused rate, or a distance that is known.

With angular accelerations free in every sample, rates c times as large on a board 1/c^2 times as large fit alike. The
fused rate, integrated from one rest to the next, turns the one's gravity into the other's where c is right:

    g_(j+1) = C(c w + phi x w + b) g_j

solved for c, a small rotation phi between gyroscopes and accelerometers, and a bias b. A board that is put down stops
between two samples, at an instant that they do not tell: of a rate that changes by d in a step T, the turn is known to
d T/sqrt(12). Each pair of rests is weighted by what its second differences, 2 d^2 for such a stop, and the noise say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.procedures.gyro_array.imus.model import GYRO_LATENCY, Board, cross
from imulab.procedures.gyro_array.imus.prepare import Prepared
from imulab.recording import Array

_LONGEST = 30.0  # s between two rests
_FEWEST = 5  # pairs of rests
_PASSES = 6
_ROTATION, _BIAS = 2e-3, 2e-4  # rad, rad/s: standard deviations of what is solved beside the scale
_FAR, _MEDIAN = 3.0, 1.177  # standard deviations at which a pair counts half, and of the median of a Rayleigh variate
_STOP = 1 / 24**0.5  # steps, by which a turn is uncertain for each unit of the second differences of the rate
_LEAST = 2e-4  # of the factor's standard uncertainty: a stretch of the rate beyond half the sampling rate is unseen


@dataclass(frozen=True)
class Factor:
    """By what the rates that were fitted must be multiplied, with its standard uncertainty."""

    value: float
    u: float


def by_gravity(prepared: Prepared, board: Board, force: Array) -> Factor | None:
    """Return the factor on rates that turns gravity from rest to rest; None for fewer than five pairs of rests.

    `force` is that at each rest in the body frame, shape (rests, 3).
    """
    pairs = _pairs(prepared)
    if len(pairs) < _FEWEST:
        return None
    direction = force / np.linalg.norm(force, axis=1, keepdims=True)
    rate, drift = _fused_rate(prepared, board), _rest_rate(prepared, board)
    noise = float(np.square(prepared.measured.gyro_noise).mean()) / (len(board.numbers) * prepared.rate)
    parts = [(slice(begin - 1, end + 1), j) for j, begin, end in pairs]
    unknown, weight, spread, u = np.zeros(7), np.ones(len(parts)), 1.0, np.inf
    prior = np.diag([0.0] + [_ROTATION**-2.0] * 3 + [_BIAS**-2.0] * 3)
    for _ in range(_PASSES):
        rows, off = [], []
        for part, j in parts:
            time, nominal = prepared.time[part], rate[part] - (drift[j] + drift[j + 1]) / 2
            turned = nominal * (1 + unknown[0]) + np.cross(unknown[1:4], nominal) + unknown[4:]
            end, effect, stops = _turn(time, turned, nominal)
            ahead = end @ direction[j]
            across = cross(ahead)
            covariance = across @ stops @ across.T + noise * (time[-1] - time[0]) * np.eye(3)
            whitening = np.linalg.inv(np.linalg.cholesky(covariance))
            rows.append(whitening @ across @ effect)
            off.append(whitening @ (direction[j + 1] - ahead))
        a, y = np.array(rows), np.array(off)
        root = np.sqrt(weight)[:, None] / spread
        design = (a * root[..., None]).reshape(-1, 7)
        matrix = design.T @ design + prior
        step = np.linalg.solve(matrix, design.T @ (y * root).ravel() - prior @ unknown)
        unknown = unknown + step
        # Two components tell; by their median, and with a weight that falls with the square of the distance.
        left = np.linalg.norm(y - a @ step, axis=1)
        spread = max(float(np.median(left)) / _MEDIAN, 1.0)
        weight = 1 / (1 + np.square(left / (_FAR * spread)))
        u = float(np.sqrt(np.linalg.inv(matrix)[0, 0]))
    return Factor(1 + float(unknown[0]), float(np.hypot(u, _LEAST)))


def _pairs(prepared: Prepared) -> list[tuple[int, int, int]]:
    """Return the rests that are followed by another without a break in the readings, and the samples between."""
    broken = np.concatenate([[0], np.cumsum(prepared.broken)])
    pairs = []
    for j, (begin, end) in enumerate(zip(prepared.rests[:-1, 1].tolist(), prepared.rests[1:, 0].tolist(), strict=True)):
        short = prepared.time[end] - prepared.time[begin] < _LONGEST
        if short and end - begin > 1 and broken[end + 1] == broken[max(begin - 1, 0)]:
            pairs.append((j, begin, end))
    return pairs


def _fused_rate(prepared: Prepared, board: Board) -> Array:
    rate = np.zeros((len(prepared.time), 3))
    for k, spline in enumerate(prepared.measured.gyro):
        readings = spline(prepared.time + board.numbers[k, GYRO_LATENCY]) - board.gyro_bias[k]
        rate += readings @ np.linalg.inv(board.gyro[k]).T
    return rate / len(board.numbers)


def _rest_rate(prepared: Prepared, board: Board) -> Array:
    """Return the fused rate that is read at each rest, shape (rests, 3): by what biases have drifted."""
    readings = prepared.measured.rest_gyro - board.gyro_bias
    return np.asarray(np.einsum("kij,nkj->ni", np.linalg.inv(board.gyro), readings) / len(board.numbers))


def _turn(time: Array, rate: Array, nominal: Array) -> tuple[Array, Array, Array]:
    """Return C from the first sample to the last, how its small turn changes with c, phi, b, and its covariance.

    Shapes (3, 3), (3, 7), (3, 3). By rotation vectors of each step, with the term of a rate that changes linearly in
    the step (Bortz 1971). The covariance is that of stops between samples.
    """
    step = np.diff(time)[:, None]
    vector = (rate[1:] + rate[:-1]) * step / 2 + np.cross(rate[:-1], rate[1:]) * step**2 / 12
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    x = -cross(vector)
    safe = np.maximum(angle, 1e-9)
    each = np.eye(3) + np.sin(safe) / safe * x + (1 - np.cos(safe)) / safe**2 * (x @ x)
    since = np.empty((len(time), 3, 3))
    since[0] = np.eye(3)
    for i, turn in enumerate(each):
        since[i + 1] = turn @ since[i]
    share = np.empty(len(time))
    share[1:-1], share[0], share[-1] = (time[2:] - time[:-2]) / 2, step[0, 0] / 2, step[-1, 0] / 2
    to_end = since[-1] @ np.swapaxes(since, 1, 2)
    stops = np.einsum("nij,nj->ni", to_end[1:-1], np.diff(nominal, 2, axis=0)) * step[1:] * _STOP
    to_end *= share[:, None, None]
    effect = np.empty((3, 7))
    effect[:, 0] = np.einsum("nij,nj->i", to_end, nominal)
    effect[:, 1:4] = -np.einsum("nij,njk->ik", to_end, cross(nominal))
    effect[:, 4:] = to_end.sum(0)
    return since[-1], effect, stops.T @ stops
