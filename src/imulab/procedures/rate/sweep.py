"""A run whose rate changes all the time: what the gyroscopes' delay and bandwidth do to it, and means by rate.

``M = S (w - tau w' + c w'' ...)`` by least squares, to fourth order in the frequency: the delay tau and the fall of the
amplitude, ``1 - (c - tau^2 / 2) (2 pi f)^2``, come apart from the scale factor S, which is that at frequency 0. Of one
sine ``w''`` is w: amplitude and phase at its frequency are all that it shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.rate.regression import (
    BOW,
    CUBE,
    DERIVATIVES,
    KERNELS,
    ONE,
    RATE,
    SQUARE,
    TIME,
    TURN,
    WHOLE,
    Moments,
    blocks,
    felt_rate,
    moments,
    regressors,
    rising,
    with_neighbours,
)
from imulab.procedures.rate.wander import PARTS, variance_of_mean
from imulab.recording import Array

_BINS, _LEAST = 20, 10
_POWER, _SINE, _BESIDE = 0.999, 0.998, 3
_PER_PERIOD = 16
_BESIDE_NOISE = 8
_SMOOTH = 0.02
_LONGEST = 1 << 17
_SHOWN = 3.0
_OWN, _CLEAR = 1e-3, 100
"""Share of a derivative's power that is its own, not the rate's and lower ones', and how far that exceeds noise."""
_TOLD = 0.05
"""Share of the power of w' that no function of rate and branch has; of one sine 0.01, of a chirp from 0 Hz 0.25."""


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
    loop_error
        What not knowing the delay adds to rising less falling at rate 0, a fraction of the largest rate; None where
        loop and delay cannot be told apart.
    zero_error
        What the zero of each of g gyroscopes wanders beyond the noise of the means by rate, output, shape (g,).
    largest
        Largest rate of the table, beyond the means by rate, rad/s.
    rising
        Number of the means by rate at which it rises; they come first.
    """

    delay: tuple[float, float]
    bandwidth: tuple[float, float] | None
    beyond: float | None
    frequency: float | None
    scale_error: float
    loop_error: float | None
    zero_error: Array
    largest: float
    rising: int


@dataclass(frozen=True)
class Binned:
    """Means by rate, rising rates first and then falling ones, n of them, of g gyroscopes.

    Attributes
    ----------
    rising
        Number of rising rates.
    rate
        Of the table, as the gyroscopes feel it, rad/s, shape (n,).
    duration
        Time spent at it, s, shape (n,).
    middle
        Mean time, s, shape (n,).
    mean, variance
        Of the outputs, and of those means by the passes through each rate, shape (n, g).
    wander
        Variance of the mean over the whole run, shape (g,).
    """

    rising: int
    rate: Array
    duration: Array
    middle: Array
    mean: Array
    variance: Array
    wander: Array


def is_smooth(rate: Array, blocks: Array) -> bool:
    """Return whether a rate changes all the time, sample by sample or over 0.1 s, and not in steps."""
    for values in (rate, blocks):
        step = np.diff(values)
        np.abs(step, out=step)
        if step.size and np.count_nonzero(step > _SMOOTH * float(step.max())) > step.size / 2:
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
    samples = with_neighbours(time, rate, outputs, side, step)
    sums = regressors(samples)
    noise = _noise(time, rate, step, side * step)
    count = _apart(sums, noise)
    if frequency is None and count < 2:  # a part of one period, whose spectrum has no peak
        frequency = float(np.sqrt(sums.variance(DERIVATIVES[0]) / sums.variance(RATE)) / (2 * np.pi))
    largest, derivatives = float(np.abs(rate).max()), DERIVATIVES[: 1 if frequency is not None else count]
    loop = [TURN, BOW] if frequency is None and _loop_told(sums, noise[0]) else []
    sweep, weights = _regressed(sums, main, derivatives, loop, frequency, largest)
    felt = felt_rate(samples, weights)
    if loop:  # the branches change when the gyroscope feels it
        sums = regressors(samples, felt)
        sweep, weights = _regressed(sums, main, derivatives, loop, frequency, largest)
        felt = felt_rate(samples, weights)
    rises = rising(felt)
    curve = _curve(samples.time, felt, rises, samples.outputs)
    sweep = replace(sweep, scale_error=float(np.hypot(sweep.scale_error, curve.by_drift(main))))
    binned = _by_rate(samples.time, felt, rises, curve, step)
    if sweep.frequency is not None:
        factor = max(1, min(side, len(felt) // _LONGEST))
        binned = replace(binned, variance=binned.variance * _colour(samples.time, felt, curve, binned, factor))
    known = np.mean(binned.variance * binned.duration[:, None], axis=0) / binned.duration.sum()
    zero = np.sqrt(np.maximum(binned.wander - known, 0.0))
    return replace(sweep, zero_error=zero, rising=binned.rising), binned


@dataclass(frozen=True)
class _Curve:
    """Outputs of g gyroscopes as a constant, a drift over time, powers of the rate over its largest, and a loop.

    Attributes
    ----------
    columns
        Of these seven, for a part of the samples, shape (7, n): 1, time, and what `_by_branch` returns.
    fits
        Coefficients of each gyroscope, shape (g, 7).
    sums
        Of the products of the columns and the outputs.
    outputs
        Of each gyroscope, shape (n,).
    """

    columns: Callable[[slice], Array]
    fits: Array
    sums: Moments
    outputs: list[Array]

    def left(self, k: int) -> Array:
        """Return what the curve of gyroscope number `k` leaves of its output, shape (n,)."""
        found = np.empty(len(self.outputs[k]))
        for _, part in blocks(len(found)):
            found[part] = self.outputs[k][part] - self.fits[k] @ self.columns(part)
        return found

    def by_drift(self, k: int) -> float:
        """Return what the error of the drift does to the scale factor, as far as the rate drifts, too, a fraction."""
        every, whole = range(self.sums.columns), self.sums.whole
        drift = float(np.sqrt(self.sums.covariance(every, every, k, self.fits[k])[1, 1]))
        together = (whole[1, 2] - whole[0, 1] * whole[0, 2] / whole[0, 0]) / whole[0, 0]
        line = self.sums.fitted([0, 2], k)[1]
        return drift * float(together / line) / self.sums.variance(2)


def _curve(time: Array, felt: Array, rises: NDArray[np.bool_], outputs: list[Array]) -> _Curve:
    middle, span, largest = float(time.mean()), float(np.ptp(time)), float(np.abs(felt).max())

    def columns(part: slice) -> Array:
        rate = felt[part] / largest
        return np.array([np.ones(len(rate)), (time[part] - middle) / span, *_by_branch(rate, rises[part])])

    sums = moments(len(felt), columns, outputs)
    fits = np.array([sums.fitted(range(sums.columns), k) for k in range(len(outputs))])
    return _Curve(columns, fits, sums, outputs)


def _by_branch(rate: Array, rises: NDArray[np.bool_]) -> list[Array]:
    """Return three powers of a rate, 1 where it rises and -1 where it falls, and that times the square."""
    square, turn = rate**2, np.where(rises, 1.0, -1.0)
    return [rate, square, square * rate, turn, turn * square]


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


def _noise(time: Array, rate: Array, step: float, spacing: float) -> list[float]:
    """Return the variances of four derivatives by the noise of the rate itself, as its eighth differences show it.

    What differs across a gap is no noise.
    """
    whole = time[8:_LONGEST] - time[: _LONGEST - 8][: len(time) - 8] < WHOLE * step
    of_rate = float(np.mean(np.diff(rate[:_LONGEST], n=8)[whole] ** 2)) / 12870
    return [of_rate * float(kernel @ kernel) / spacing ** (2 * k) for k, kernel in enumerate(KERNELS, 1)]


def _apart(found: Moments, noise: list[float]) -> int:
    """Return the number of derivatives of a rate before that, beyond the first, which those before it make up.

    Or which is the noise of the rate, by more than a hundredth.
    """
    count = float(found.whole[ONE, ONE])
    for number, column in enumerate(DERIVATIVES[1:], 1):
        left = found.left_of(column, [ONE, TIME, RATE, *DERIVATIVES[:number]])
        if left < max(_OWN * float(found.whole[column, column]), _CLEAR * noise[number] * count):
            return number
    return len(DERIVATIVES)


def _loop_told(found: Moments, noise: float) -> bool:
    """Return whether w' differs from pass to pass at one rate, as no loop does; its noise does not count."""
    slope, count = DERIVATIVES[0], float(found.whole[ONE, ONE])
    left = found.left_of(slope, [ONE, TIME, RATE, TURN, BOW])
    return left - noise * count > _TOLD * float(found.whole[slope, slope])


def _regressed(
    moments: Moments,
    main: int,
    derivatives: Sequence[int],
    loop: Sequence[int],
    frequency: float | None,
    largest: float,
) -> tuple[Sweep, Array]:
    """Return what a gyroscope says of delay and bandwidth, and the weights of rate and derivatives in what it felt."""
    still = [RATE, *loop, ONE, TIME, SQUARE, *([] if frequency is not None else [CUBE])]
    columns = [RATE, *derivatives, *still[1:]]
    found = moments.fitted(columns, main)
    spread = moments.covariance(columns, columns, main, found)
    scale, weights = float(found[0]), np.zeros(5)
    known = moments.covariance(still, columns, main, found)
    more = float(np.sqrt(max(float(spread[0, 0] - known[0, 0]), 0.0))) / abs(scale)
    of_loop = None
    if loop:
        at = columns.index(TURN)
        of_loop = 2 * float(np.sqrt(max(float(spread[at, at] - known[1, 1]), 0.0))) / abs(scale) / largest
    if frequency is not None:
        omega = 2 * np.pi * frequency
        phase = float(np.arctan2(-found[1] * omega * np.sign(scale), abs(scale)))
        u = float(np.sqrt(spread[1, 1])) / abs(scale)
        weights[:2] = np.cos(phase), -np.sin(phase) / omega
        return Sweep((phase / omega, u), None, None, frequency, more, None, np.zeros(0), largest, 0), weights
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
    weights[: len(derivatives) + 1] = [1.0, *(found[1 : len(derivatives) + 1] / scale)]
    delay = float(tau), float(np.sqrt(both[0, 0]))
    return Sweep(delay, bandwidth, beyond, None, more, of_loop, np.zeros(0), largest, 0), weights


def _colour(time: Array, felt: Array, curve: _Curve, binned: Binned, factor: int) -> Array:
    """Return by what to multiply the variances of means by rate, as if independent, for noise that has a colour.

    What enters the scale factor at one frequency is the noise near that frequency. With d the rate, over its largest,
    freed of the columns of bias, drift and square, and D and R the spectra of d and of what the fit left, the variance
    of the slope is ``mean(|D|^2 |R|^2) / (d d)^2``, |R|^2 averaged over the frequencies beside each. The fit took
    from R about one frequency; without that correction the mean over 2 n + 1 of them would be low by 1 / (2 n + 1).
    Of long runs means of `factor` samples serve, far fewer than a period has.
    """
    rate, trend = _thin(felt, factor), _thin(time, factor)
    largest = float(np.abs(felt).max())
    others = np.column_stack([np.ones(len(rate)), (trend - trend.mean()) / np.ptp(trend), (rate / largest) ** 2])
    along = rate / largest - others @ (np.linalg.pinv(others.T @ others) @ (others.T @ rate / largest))
    del others, trend, rate
    size = len(along)
    lines = np.abs(np.fft.rfft(along)) ** 2
    lines /= lines.sum()
    window = np.ones(2 * _BESIDE_NOISE + 1)
    count = np.convolve(np.ones(len(lines) - 1), window, mode="same") - 1  # none at frequency 0
    length = binned.duration
    apart = binned.rate - length @ binned.rate / length.sum()
    factors = []
    for k in range(len(curve.fits)):
        power = np.abs(np.fft.rfft(_thin(curve.left(k), factor)))[1:] ** 2
        beside = np.convolve(power, window, mode="same") / count / size
        variance = float(lines[1:] @ beside) / float(along @ along) / largest**2
        each = float(np.mean(binned.variance[:, k] * length))  # pooled, for 1 s
        factors.append(variance * float(length @ apart**2) / each if each > 0 else 1.0)
    return np.array(factors)


def _thin(values: Array, factor: int) -> Array:
    """Return means of `factor` values that follow one another."""
    return values if factor == 1 else values[: len(values) // factor * factor].reshape(-1, factor).mean(axis=1)


def _by_rate(time: Array, felt: Array, rises: NDArray[np.bool_], curve: _Curve, step: float) -> Binned:
    """Return the means of outputs by rate, each moved along its curve to the middle of its bin, without their drift."""
    low, high = float(felt.min()), float(felt.max())
    number = _bins(felt, rises, low, high)
    middle = low + (np.arange(_BINS) + 0.5) / _BINS * (high - low)
    middle = np.concatenate([middle, middle[::-1]])
    count = np.bincount(number, minlength=2 * _BINS)
    which = np.flatnonzero(count > max(_LEAST, len(felt) // 5000))
    size = count[which]

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(number, values, minlength=2 * _BINS)[which] / size)

    starts = np.concatenate([[0], np.flatnonzero(number[1:] != number[:-1]) + 1])
    place = number[starts]
    powers = np.array(_by_branch(middle[which] / max(abs(low), abs(high)), which < _BINS))
    parts = np.linspace(0, len(felt), PARTS, endpoint=False).astype(np.int64)
    means, variances, wander = [], [], []
    for k, fit in enumerate(curve.fits):
        rest = curve.left(k)
        means.append(mean(rest) + fit[0] + fit[2:] @ powers)
        passes = np.add.reduceat(rest, starts) ** 2
        variances.append(np.bincount(place, passes, minlength=2 * _BINS)[which] / size**2)
        wander.append(variance_of_mean(np.add.reduceat(rest, parts) / np.diff(parts, append=len(felt))))
    return Binned(
        int(np.count_nonzero(which < _BINS)),
        middle[which],
        np.asarray(size * step, dtype=np.float64),
        mean(time),
        np.column_stack(means),
        np.column_stack(variances),
        np.array(wander),
    )


def _bins(felt: Array, rises: NDArray[np.bool_], low: float, high: float) -> NDArray[np.int64]:
    """Return the number of each sample's rate: of its bin where it rises, and on beyond those where it falls."""
    number = np.empty(len(felt), dtype=np.int64)
    for _, part in blocks(len(felt)):
        number[part] = (felt[part] - low) / (high - low) * _BINS
    np.minimum(number, _BINS - 1, out=number)
    np.subtract(2 * _BINS - 1, number, out=number, where=~rises)
    return number
