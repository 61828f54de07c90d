"""A run whose rate changes all the time: what the gyroscopes' delay and bandwidth do to it, and means by rate.

``M = S (w - tau w' + c w'' ...)`` by least squares, to fourth order in the frequency: the delay tau and the fall of the
amplitude, ``1 - (c - tau^2 / 2) (2 pi f)^2``, come apart from the scale factor S, which is that at frequency 0. Of one
sine ``w''`` is w: amplitude and phase at its frequency are all that it shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array

_BINS, _LEAST = 20, 10
_BATCHES = 32
_POWER, _SINE, _BESIDE = 0.999, 0.998, 3
_PER_PERIOD = 16
_BESIDE_NOISE = 8
_SMOOTH = 0.02
_LONGEST = 1 << 17
_SHOWN = 3.0
_OWN, _CLEAR = 1e-3, 100
"""Share of a derivative's power that is its own, not the rate's and lower ones', and how far that exceeds noise."""


@dataclass(frozen=True)
class Sweep:
    """What a run says of the gyroscope along the table axis; values with standard uncertainties.

    Attributes
    ----------
    delay
        s.
    bandwidth
        Where a first-order lag with the same fall of amplitude is at -3 dB, Hz; None where none shows.
    beyond
        What the bandwidth exceeds with 95 % where none shows, Hz; None where it cannot be told.
    frequency
        Of the one sine that the rate is, Hz; None of a sweep.
    scale_error
        What not knowing delay, bandwidth and drift adds to the scale factor, a fraction.
    """

    delay: tuple[float, float]
    bandwidth: tuple[float, float] | None
    beyond: float | None
    frequency: float | None
    scale_error: float


@dataclass(frozen=True)
class Binned:
    """Means by rate, rising rates first and then falling ones, n of them, of g gyroscopes.

    Attributes
    ----------
    rate
        Of the table, as the gyroscopes feel it, rad/s, shape (n,).
    duration
        Time spent at it, s, shape (n,).
    middle
        Mean time, s, shape (n,).
    mean, variance
        Of the outputs, and of those means by the passes through each rate, shape (n, g).
    """

    rate: Array
    duration: Array
    middle: Array
    mean: Array
    variance: Array


def is_smooth(rate: Array, blocks: Array) -> bool:
    """Return whether a rate changes all the time, sample by sample or over 0.1 s, and not in steps."""
    for values in (rate, blocks):
        step = np.abs(np.diff(values))
        if step.size and float(np.median(step)) > _SMOOTH * float(step.max()) > 0:
            return True
    return False


def rate_of_angle(angle: Array, time: Array) -> Array:
    """Return the rate of an angle, both rad, by differences of fourth order, shape (n,)."""
    rate = np.gradient(angle, time)
    even = (time[4:] - time[:-4]) / 4
    rate[2:-2] = (8 * (angle[3:-1] - angle[1:-3]) - (angle[4:] - angle[:-4])) / (12 * even)
    return np.asarray(rate)


def reduce_sweep(time: Array, rate: Array, outputs: list[Array], main: int) -> tuple[Sweep, Binned]:
    """Return delay and bandwidth of gyroscope number `main`, and the means of all by rate.

    Parameters
    ----------
    time, rate
        s, and the table's rate about the body axis, rad/s, shape (n,).
    outputs
        Of each gyroscope, shape (n,).
    """
    step = float(np.median(np.diff(time[:10_001])))
    top, frequency = _spectrum(rate, step)
    many = _PER_PERIOD if frequency is None else 2 * _PER_PERIOD
    side = max(1, round(1 / (many * top * step)))
    inner, derivatives = _derivatives(rate, time, side, step)
    at, known = time[inner], rate[inner]
    derivatives = _apart(at, known, derivatives, _noise(rate, side * step))
    if frequency is None and len(derivatives) < 2:  # a part of one period, whose spectrum has no peak
        frequency = float(derivatives[0].std() / known.std() / (2 * np.pi))
    values = outputs[main][inner]
    sweep, felt = _regressed(at, known, derivatives, values, frequency)
    trend = (at - at.mean()) / float(np.ptp(at))
    columns = [np.ones(len(at)), trend, felt, felt**2, felt**3]
    matrix = np.column_stack([column / np.abs(column).max() for column in columns])
    kept = [output[inner] for output in outputs]
    normal = np.linalg.pinv(matrix.T @ matrix)
    fits = normal @ (matrix.T @ np.column_stack(kept))
    # The drift is taken off by this fit, and its error is in the scale factor as far as the rate drifts, too.
    of_drift = float(np.sqrt(_covariance(matrix, normal, values - matrix @ fits[:, main])[1, 1]))
    along = felt - felt.mean()
    share = of_drift * float(trend @ along) / float(along @ along) / float(np.ptp(values) / np.ptp(felt))
    sweep = replace(sweep, scale_error=float(np.hypot(sweep.scale_error, share)))
    binned = _by_rate(at, felt, kept, matrix, fits, step)
    if sweep.frequency is not None:
        largest = float(np.abs(felt).max())
        binned = replace(binned, variance=binned.variance * _colour(matrix, kept, fits, binned, largest))
    return sweep, binned


def _spectrum(rate: Array, step: float) -> tuple[float, float | None]:
    """Return the frequency below which the rate's power lies, Hz, and that of the one sine that it is, if it is one."""
    factor = max(1, len(rate) // _LONGEST)
    values = rate[: len(rate) // factor * factor].reshape(-1, factor).mean(axis=1) if factor > 1 else rate
    values = values - values.mean()
    power = np.abs(np.fft.rfft(values * np.hanning(len(values)))) ** 2
    frequency = np.fft.rfftfreq(len(values), step * factor)
    power[0] = 0.0
    share = np.cumsum(power) / power.sum()
    top = float(frequency[min(int(np.searchsorted(share, _POWER)) + 1, len(frequency) - 1)])
    peak = int(np.argmax(power))
    beside = slice(max(0, peak - _BESIDE), peak + _BESIDE + 1)
    one = power[beside].sum() > _SINE * power.sum() and peak > _BESIDE
    return top, float(power[beside] @ frequency[beside] / power[beside].sum()) if one else None


def _derivatives(rate: Array, time: Array, side: int, step: float) -> tuple[NDArray[np.int64], list[Array]]:
    """Return the samples that have neighbours, without a gap between, and four derivatives of the rate there."""
    h = side

    def once(x: Array) -> Array:
        n = len(x)
        near = 8 * (x[3 * h : n - h] - x[h : n - 3 * h])
        return np.asarray((near - (x[4 * h :] - x[: n - 4 * h])) / (12 * h * step))

    def twice(x: Array) -> Array:
        n = len(x)
        near = 16 * (x[3 * h : n - h] + x[h : n - 3 * h])
        return np.asarray((near - 30 * x[2 * h : n - 2 * h] - x[4 * h :] - x[: n - 4 * h]) / (12 * (h * step) ** 2))

    inner = slice(2 * h, -2 * h)
    second = twice(rate)
    whole = time[8 * h :] - time[: len(rate) - 8 * h] < 8.8 * h * step
    found = [part[whole] for part in (once(rate)[inner], second[inner], once(second), twice(second))]
    return np.flatnonzero(whole) + 4 * h, found


def _noise(rate: Array, spacing: float) -> list[float]:
    """Return the variances of four derivatives by the noise of the rate itself, as its eighth differences show it."""
    of_rate = float(np.mean(np.diff(rate[:_LONGEST], n=8) ** 2)) / 12870
    once, twice = np.array([1, -8, 0, 8, -1]) / 12, np.array([-1, 16, -30, 16, -1]) / 12
    kernels = [once, twice, np.convolve(once, twice), np.convolve(twice, twice)]
    return [of_rate * float(kernel @ kernel) / spacing ** (2 * k) for k, kernel in enumerate(kernels, 1)]


def _apart(time: Array, rate: Array, derivatives: list[Array], noise: list[float]) -> list[Array]:
    """Return the derivatives of a rate before that, beyond the first, which the rate and those before it make up.

    Or which is the noise of the rate, by more than a hundredth.
    """
    kept = [np.ones(len(time)), time - time.mean(), rate, derivatives[0]]
    for number, column in enumerate(derivatives[1:], 1):
        matrix = np.column_stack(kept)
        matrix = matrix / np.abs(matrix).max(axis=0)
        found = np.linalg.pinv(matrix.T @ matrix) @ (matrix.T @ column)
        left = column - matrix @ found
        if float(left @ left) < max(_OWN * float(column @ column), _CLEAR * noise[number] * len(column)):
            return derivatives[:number]
        kept.append(column)
    return derivatives


def _regressed(
    time: Array, rate: Array, derivatives: list[Array], values: Array, frequency: float | None
) -> tuple[Sweep, Array]:
    """Return what a gyroscope's output says of delay and bandwidth, and the rate that it felt."""
    first = derivatives[0]
    derivatives = derivatives[:1] if frequency is not None else derivatives
    columns = [rate, *derivatives]
    columns += [np.ones(len(rate)), time - time.mean(), rate**2, *([] if frequency is not None else [rate**3])]
    size = np.array([float(np.abs(column).max()) or 1.0 for column in columns])
    matrix = np.column_stack(columns) / size
    normal = np.linalg.pinv(matrix.T @ matrix)
    found = normal @ (matrix.T @ values)
    left = values - matrix @ found
    spread = _covariance(matrix, normal, left) / np.outer(size, size)
    found = found / size
    scale = float(found[0])
    still = np.delete(matrix, range(1, len(derivatives) + 1), axis=1)
    known = float(_covariance(still, np.linalg.pinv(still.T @ still), left)[0, 0]) / size[0] ** 2
    more = float(np.sqrt(max(float(spread[0, 0]) - known, 0.0))) / abs(scale)
    if frequency is not None:
        omega = 2 * np.pi * frequency
        phase = float(np.arctan2(-found[1] * omega * np.sign(scale), abs(scale)))
        u = float(np.sqrt(spread[1, 1])) / abs(scale)
        felt = np.cos(phase) * rate - np.sin(phase) / omega * first
        return Sweep((phase / omega, u), None, None, frequency, more), felt
    tau, c = -found[1] / scale, found[2] / scale
    lines = np.zeros((2, len(found)))
    lines[0, :2] = -tau / scale, -1 / scale
    lines[1, :3] = (-2 * c + 2 * tau**2) / scale, 2 * tau / scale, 2 / scale  # of 2 c - tau^2
    both = lines @ spread @ lines.T
    square, u_square = float(2 * c - tau**2), float(np.sqrt(both[1, 1]))
    bandwidth = beyond = None
    if square > _SHOWN * u_square:
        corner = float(1 / (2 * np.pi * np.sqrt(square)))
        bandwidth = (corner, corner * u_square / (2 * square))
    else:
        beyond = float(1 / (2 * np.pi * np.sqrt(max(square, 0.0) + 2 * u_square + 1e-300)))
    felt = rate + sum(
        k / scale * column for k, column in zip(found[1 : len(derivatives) + 1], derivatives, strict=True)
    )
    return Sweep((float(tau), float(np.sqrt(both[0, 0]))), bandwidth, beyond, None, more), felt


def _covariance(matrix: Array, normal: Array, left: Array) -> Array:
    """Return the covariance of coefficients by what is left of the fit in parts of the run, correlated as it may be."""
    edges = np.linspace(0, len(left), _BATCHES + 1).astype(np.int64)[:-1]
    scores = np.add.reduceat(matrix * left[:, None], edges, axis=0)
    wide = _BATCHES / (_BATCHES - 1)  # the scores of all batches add up to zero
    return np.asarray(normal @ (scores.T @ scores * wide) @ normal)


def _colour(matrix: Array, outputs: list[Array], fits: Array, binned: Binned, largest: float) -> Array:
    """Return by what to multiply the variances of means by rate, as if independent, for noise that has a colour.

    What enters the scale factor at one frequency is the noise near that frequency. With d the rate, over its largest,
    freed of the columns of bias, drift and square, and D and R the spectra of d and of what the fit left, the variance
    of the slope is ``mean(|D|^2 |R|^2) / (d d)^2``, |R|^2 averaged over the frequencies beside each. The fit took
    from R about one frequency; without that correction the mean over 2 n + 1 of them would be low by 1 / (2 n + 1).
    """
    others = matrix[:, [0, 1, 3]]
    along = matrix[:, 2] - others @ (np.linalg.pinv(others.T @ others) @ (others.T @ matrix[:, 2]))
    size = len(along)
    lines = np.abs(np.fft.rfft(along)) ** 2
    lines /= lines.sum()
    window = np.ones(2 * _BESIDE_NOISE + 1)
    count = np.convolve(np.ones(len(lines) - 1), window, mode="same") - 1  # none at frequency 0
    length = binned.duration
    apart = binned.rate - length @ binned.rate / length.sum()
    factors = []
    for k, output in enumerate(outputs):
        power = np.abs(np.fft.rfft(output - matrix @ fits[:, k]))[1:] ** 2
        beside = np.convolve(power, window, mode="same") / count / size
        variance = float(lines[1:] @ beside) / float(along @ along) / largest**2
        each = float(np.mean(binned.variance[:, k] * length))  # pooled, for 1 s
        factors.append(variance * float(length @ apart**2) / each if each > 0 else 1.0)
    return np.array(factors)


def _by_rate(time: Array, felt: Array, outputs: list[Array], matrix: Array, fits: Array, step: float) -> Binned:
    """Return the means of outputs by rate, each moved along its line to the middle of its bin, without their drift."""
    low, high = float(felt.min()), float(felt.max())
    number = np.minimum(((felt - low) / (high - low) * _BINS).astype(np.int64), _BINS - 1)
    number = np.where(np.gradient(felt) > 0, number, 2 * _BINS - 1 - number)
    middle = low + (np.arange(_BINS) + 0.5) / _BINS * (high - low)
    middle = np.concatenate([middle, middle[::-1]])
    count = np.bincount(number, minlength=2 * _BINS)
    which = np.flatnonzero(count > max(_LEAST, len(felt) // 5000))
    size = count[which]

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(number, values, minlength=2 * _BINS)[which] / size)

    starts = np.concatenate([[0], np.flatnonzero(np.diff(number)) + 1])
    place = number[starts]
    means, variances = [], []
    for k, output in enumerate(outputs):
        left = output - matrix @ fits[:, k]
        curve = np.column_stack([middle**p for p in range(1, 4)])[which]
        slopes = fits[2:, k] / np.array([np.abs(felt**p).max() for p in range(1, 4)])
        means.append(mean(left) + fits[0, k] + curve @ slopes)
        passes = np.add.reduceat(left, starts) ** 2
        variances.append(np.bincount(place, passes, minlength=2 * _BINS)[which] / size**2)
    return Binned(
        middle[which],
        np.asarray(size * step, dtype=np.float64),
        mean(time),
        np.column_stack(means),
        np.column_stack(variances),
    )
