"""The size of a board: gravity turned from rest to rest by the fused rate, or a distance that is known.

With angular accelerations free in every sample, rates c times as large on a board 1/c^2 times as large fit alike. The
fused rate, integrated from one rest to the next, turns the one's gravity into the other's where c is right:

    g_(j+1) = C(c w + phi x w + b) g_j

solved for c, a small rotation phi between gyroscopes and accelerometers, and a bias b.
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
_START = 0.01  # rad, of a pair, at first
_FAR, _MEDIAN = 3.0, 1.177  # standard deviations at which a pair counts half, and of the median of a Rayleigh variate
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
    rate = _fused_rate(prepared, board)
    parts = [(slice(begin - 1, end + 1), j) for j, begin, end in pairs]
    unknown, weight = np.zeros(7), np.ones(len(parts))
    scale = np.array([1 / _ROTATION] * 3 + [1 / _BIAS] * 3)
    spread, u = _START, np.inf
    for _ in range(_PASSES):
        rows, off = [], []
        for part, j in parts:
            turned = rate[part] * (1 + unknown[0]) + np.cross(unknown[1:4], rate[part]) + unknown[4:]
            end, effect = _turn(prepared.time[part], turned, rate[part])
            ahead = end @ direction[j]
            rows.append(cross(ahead) @ effect)
            off.append(direction[j + 1] - ahead)
        a, y = np.array(rows), np.array(off)
        root = np.sqrt(weight)[:, None] / spread
        design = (a * root[..., None]).reshape(-1, 7)
        matrix = design.T @ design
        matrix[1:, 1:] += np.diag(scale**2)
        right = design.T @ (y * root).ravel()
        right[1:] -= scale**2 * unknown[1:]
        step = np.linalg.solve(matrix, right)
        unknown = unknown + step
        left = np.linalg.norm(y - a @ step, axis=1)
        # Putting a board down jolts it beyond half the sampling rate: of two components, by their median, and a weight
        # that falls with the square of the distance.
        spread = max(float(np.median(left)) / _MEDIAN, 1e-6)
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


def _turn(time: Array, rate: Array, nominal: Array) -> tuple[Array, Array]:
    """Return C from the first sample to the last, shape (3, 3), and how its small turn changes with c, phi, b, (3, 7).

    By rotation vectors of each step, with the term of a rate that changes linearly in the step (Bortz 1971).
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
    to_end = since[-1] @ np.swapaxes(since, 1, 2) * share[:, None, None]
    effect = np.empty((3, 7))
    effect[:, 0] = np.einsum("nij,nj->i", to_end, nominal)
    effect[:, 1:4] = -np.einsum("nij,njk->ik", to_end, cross(nominal))
    effect[:, 4:] = to_end.sum(0)
    return since[-1], effect
