"""Where an array is at rest: judged element by element, and by what all elements do together, however mounted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError
from imulab.estimation.noise_coefficients import resolution
from imulab.recording import Array

_WINDOW = 1.0  # s
_FEWEST_WINDOWS = 12
_SMALLEST_WINDOW = 8
_QUIETEST = 0.1
_QUIET_FACTOR = 3.0
_STEP_NOISE = 0.29
"""Standard deviation that rounding brings at least, in steps of the output."""
_DRIFT = math.radians(1.0)
"""How far the zero of a gyro at rest may wander within one recording, rad/s."""
_SHORTEST = 5  # windows
_TOGETHER = 10.0
_ALIKE = 1.25
_STEADY, _STEADY_SPREAD = math.radians(5.0), 0.1
_LARGEST_ZERO = math.radians(100.0)
_MOST_SAMPLES = 20_000


@dataclass(frozen=True)
class Rest:
    """A stretch at rest: first sample, last + 1, and what moved first outside of it ("" where it is everything)."""

    start: int
    stop: int
    moved: str = ""


def find_rest(readings: Array, rate: float, names: Sequence[Sequence[str]], name: str) -> Rest:
    """Find the longest stretch in which an array is at rest.

    A window of a second is quiet where the standard deviation of every gyro is at most 3 times that of its own quietest
    windows (a tenth of all; rounding counts), and its mean within 1 deg/s of the median of the quiet ones. Then the
    whole stretch is at rest unless its elements go together (`together`), or read a rate that no zero has.

    Parameters
    ----------
    readings
        Shape (m, axes, n), rad/s.
    rate
        Sampling rate, Hz.
    names
        Columns by axis and element, for messages.
    name
        The recording's name, for messages.

    Raises
    ------
    DataError
        No stretch of five windows is quiet, or the quiet one moves.
    """
    count, axes, n = readings.shape
    size = max(_SMALLEST_WINDOW, min(round(_WINDOW * rate), count // _FEWEST_WINDOWS))
    windows = readings[: count // size * size].reshape(-1, size, axes, n)
    spread, mean = windows.std(axis=1), windows.mean(axis=1)
    usual = np.quantile(spread, _QUIETEST, axis=0)
    steps = np.array([[resolution(readings[:, a, i]) for i in range(n)] for a in range(axes)])
    usual = np.maximum(usual, _STEP_NOISE * steps)
    loud = spread > _QUIET_FACTOR * usual
    calm = ~loud.any(axis=(1, 2))
    centre = np.median(mean[calm] if calm.any() else mean, axis=0)
    away = np.abs(mean - centre) > np.maximum(_DRIFT, _SHORTEST * usual / math.sqrt(size))
    restless = loud | away
    edges = np.diff(np.concatenate([[0], (~restless.any(axis=(1, 2))).astype(int), [0]]))
    runs = np.flatnonzero(edges).reshape(-1, 2)
    first, last = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))].tolist() if len(runs) else (0, 0)
    if last - first < _SHORTEST:
        moves, ratio = common_motion(mean - mean.mean(axis=0), usual / math.sqrt(size))
        if ratio > _TOGETHER:
            raise DataError(_motion_message(name, moves, ratio))
        raise DataError(
            f"{name}: no stretch of {_SHORTEST * size / rate:.3g} s at rest: "
            f"{_restless_message(restless, spread, mean - centre, names, size / rate)}; expected a recording at rest"
        )
    start, stop = first * size, count if last == len(windows) else last * size
    _refuse_motion(readings[start:stop], mean[first:last], usual, size, names, name)
    if (start, stop) == (0, count):
        return Rest(0, count)
    return Rest(start, stop, _restless_message(restless, spread, mean - centre, names, size / rate))


def common_motion(off: Array, noise: Array) -> tuple[float, float]:
    """Return how far the elements of an array go together, rms, and its ratio to what each does on its own.

    The largest eigenvectors of the covariance, as many as there are axes, whitened by `noise`, hold what all elements
    see of one motion, in whichever orientation and sense. A ratio that a quarter of the elements falls short of does
    not count; neither does what elements share in unlike sizes, as they share a temperature.

    Parameters
    ----------
    off
        Readings or their means less their mean over time, shape (m, axes, n).
    noise
        Their standard deviation at rest, shape (axes, n).
    """
    count, axes, n = off.shape
    scale = np.maximum(noise, 1e-300).reshape(-1)
    flat = off.reshape(count, -1) / scale
    _, vectors = np.linalg.eigh(flat.T @ flat)
    shared = vectors[:, -axes:]
    common = flat @ shared @ shared.T
    seen = np.sqrt(np.mean(((common * scale).reshape(count, axes, n)) ** 2, axis=0).sum(axis=0) / axes)
    apart = np.sqrt(np.mean((((flat - common) * scale).reshape(count, axes, n)) ** 2, axis=0).sum(axis=0) / axes)
    low, high = np.quantile(seen, [0.25, 0.75])
    if high > _ALIKE * low:
        return float(np.median(seen)), 0.0
    ratio = np.sort(seen / np.maximum(apart, 1e-300))[(n - 1) // 4]
    return float(np.median(seen)), float(ratio)


def _refuse_motion(
    readings: Array, mean: Array, usual: Array, size: int, names: Sequence[Sequence[str]], name: str
) -> None:
    """Refuse a quiet stretch whose elements go together, or that turns steadily."""
    slow = common_motion(mean - mean.mean(axis=0), usual / math.sqrt(size))
    part = readings[: min(len(readings), _MOST_SAMPLES) // size * size]
    blocks = part.reshape(-1, size, *part.shape[1:])
    fast = common_motion((blocks - blocks.mean(axis=1, keepdims=True)).reshape(part.shape), usual)
    moves, ratio = max(slow, fast, key=lambda found: found[1])
    if ratio > _TOGETHER:
        raise DataError(_motion_message(name, moves, ratio))
    steady = readings.mean(axis=0)
    rates = np.sqrt((steady**2).sum(axis=0))
    low, middle, high = np.quantile(rates, [0.0, 0.5, 1.0])
    if len(rates) > 2 and middle > _STEADY and high - low < _STEADY_SPREAD * middle:
        raise DataError(
            f"{name}: all elements read {math.degrees(middle):.3g} deg/s: the array turns steadily; expected a "
            "recording at rest"
        )
    worst = np.unravel_index(int(np.argmax(np.abs(steady))), steady.shape)
    if abs(steady[worst]) > _LARGEST_ZERO:
        raise DataError(
            f"{name}: column {names[int(worst[0])][int(worst[1])]}: {math.degrees(steady[worst]):.4g} deg/s on "
            f"average, which is no zero (is the unit right?); expected less than {math.degrees(_LARGEST_ZERO):.0f} "
            "deg/s at rest"
        )


def _motion_message(name: str, moves: float, ratio: float) -> str:
    return (
        f"{name}: the array moves: its elements go together by {math.degrees(moves):.3g} deg/s, {ratio:.0f} times what "
        "they differ; expected a recording at rest"
    )


def _restless_message(
    restless: np.ndarray, spread: Array, off: Array, names: Sequence[Sequence[str]], step: float
) -> str:
    """Name the gyro that moves most, its rate, and when, s from the beginning."""
    reach = np.where(restless, np.hypot(spread, off), 0.0)
    k, a, i = (int(index) for index in np.unravel_index(int(np.argmax(reach)), reach.shape))
    return f"{names[a][i]} moves by {math.degrees(reach[k, a, i]):.3g} deg/s {k * step:.3g} s after the beginning"
