"""Sweeps of a rate test, whose rate changes all the time: delay and bandwidth of the gyroscopes, and means by rate.

`reduce_sweep`: the output is ``M = S (w - tau w' + c w'' ...)``, w the table's rate, fitted by least squares
with derivatives up to the fourth. The scale factor S is that at frequency 0, tau is the delay, and the amplitude falls
as ``1 - (c - tau^2 / 2) (2 pi f)^2``. Of a single sine ``w''`` is proportional to w, so that it shows amplitude and
phase at its own frequency alone.

Variance of a mean over a whole run (`variance_of_mean`): 64 means y of equal parts, without a line over time, have the
covariance ``a I + c F``, F that of flicker noise with Allan variance 1. With a and c of largest restricted likelihood
the mean of all varies by ``a / 64 + c``. Noise below the lowest frequency of the recording does not show in it.

Sources: Patterson and Thompson, Biometrika 58 (1971) 545; Barnes et al., IEEE Trans. Instrum. Meas. IM-20 (1971) 105.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array

# The variance of a mean over a whole run, by white and flicker noise.


PARTS = 64  # of a recording, over which white and flicker noise differ
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 121)])


def variance_of_mean(means: Array) -> float:
    """Return the Allan variance of the mean over such a recording, ``a / 64 + c``.

    Parameters
    ----------
    means
        Of equal parts of the recording, one after the other, shape (64,).
    """
    contrasts, shares = _contrasts()
    square = (contrasts @ means) ** 2
    if not square.any():
        return 0.0
    white = np.mean(square / shares, axis=1)
    best = int(np.argmin(len(square) * np.log(white) + np.log(shares).sum(axis=1)))
    return float(white[best] * (1 / PARTS + _RATIOS[best]))


@cache
def _contrasts() -> tuple[Array, Array]:
    """Return contrasts of the parts that are uncorrelated under both noises, and their variances over a.

    Shapes (62, 64), and (122, 62): a row for each ratio c / a.
    """
    lag = np.abs(np.arange(-1.0, PARTS + 1))
    curve = lag**2 * np.log(np.maximum(lag, 1.0))
    flicker = -np.diff(curve, 2) / (4 * np.log(2))
    number = np.arange(PARTS)
    line = np.column_stack([np.ones(PARTS), number - number.mean()])
    free = np.linalg.svd(line)[0][:, 2:]
    spread, turn = np.linalg.eigh(free.T @ flicker[np.abs(number[:, None] - number)] @ free)
    return (free @ turn).T, 1 + _RATIOS[:, None] * spread


# Least squares over a sweep, block by block, so that a run of 10^7 samples takes a few columns of memory.


ONE, TIME, RATE, SQUARE, CUBE, TURN, BOW, *DERIVATIVES = range(11)
"""Places of the columns of `sweep_moments`: 1; time from its mean, s; the rate, its square and cube; +1 where the rate
rises and -1 where it falls; that sign times ``(rate / largest rate)^2``; four derivatives of the rate."""
WHOLE = 8.8
"""Median steps that eight steps span at most where no sample is missing."""
_SWEEP_BATCHES, _SWEEP_BLOCK = 32, 1 << 15
"""Batches of a sweep whose scatter gives the uncertainties; samples held at once, which bounds memory."""
_POWERS = np.vander(np.arange(-4.0, 5.0), increasing=True).T
KERNELS = np.linalg.solve(_POWERS, np.diag([1.0, 1.0, 2.0, 6.0, 24.0, 0.0, 0.0, 0.0, 0.0]))[:, 1:5].T
"""Four derivatives of polynomials of degree 8, over the spacing to the power of their order, shape (4, 9)."""
INTERPOLATION = np.array([-1.0, 8.0, -28.0, 56.0, 0.0, 56.0, -28.0, 8.0, -1.0]) / 70
"""Value in the middle of polynomials of degree 7, by their eight neighbours, shape (9,)."""


@dataclass(frozen=True)
class Samples:
    """The n samples of a sweep that have four neighbours on either side, without a gap between.

    Attributes
    ----------
    time, outputs
        Times, s, and outputs of each gyroscope, shape (n,).
    rate
        Rate of the table at all samples, rad/s.
    first
        Index in `rate` of the first neighbour of each sample, shape (n,); None where the samples have no gap.
    side, spacing
        Samples and time, s, from neighbour to neighbour.
    """

    time: Array
    outputs: list[Array]
    rate: Array
    first: NDArray[np.int64] | None
    side: int
    spacing: float

    def neighbours(self, part: slice) -> Array:
        """Return the rate at each of n samples and its eight neighbours, shape (9, n)."""
        shifts = [k * self.side for k in range(9)]
        if self.first is None:
            return np.array([self.rate[part.start + shift : part.stop + shift] for shift in shifts])
        return np.array([self.rate[self.first[part] + shift] for shift in shifts])


def take_with_neighbours(time: Array, rate: Array, outputs: Sequence[Array], side: int, step: float) -> Samples:
    """Return the samples that have neighbours `side` samples apart, without a gap between."""
    whole = time[8 * side :] - time[: len(rate) - 8 * side] < WHOLE * side * step
    first = None if whole.all() else np.flatnonzero(whole)
    which = slice(4 * side, len(rate) - 4 * side) if first is None else first + 4 * side
    return Samples(time[which], [output[which] for output in outputs], rate, first, side, side * step)


def blocks(count: int) -> Iterator[tuple[int, slice]]:
    """Yield the parts of `count` samples, each small enough for a cache, with the number of its batch."""
    edges = np.linspace(0, count, _SWEEP_BATCHES + 1).astype(np.int64).tolist()
    for batch, (first, last) in enumerate(pairwise(edges)):
        for start in range(first, last, _SWEEP_BLOCK):
            yield batch, slice(start, min(start + _SWEEP_BLOCK, last))


@dataclass(frozen=True)
class Moments:
    """Sums of products of c columns and g outputs over each batch of a run, shape (batches, c + g, c + g)."""

    batches: Array
    columns: int

    @property
    def whole(self) -> Array:
        """Sums over all batches, shape (c + g, c + g)."""
        return np.asarray(self.batches.sum(axis=0))

    def variance(self, column: int) -> float:
        """Return the variance of a column; column 0 is that of ones."""
        whole = self.whole
        return float(whole[column, column] / whole[0, 0] - (whole[column, 0] / whole[0, 0]) ** 2)

    def fit(self, columns: Sequence[int], output: int) -> Array:
        """Return the least-squares coefficients of an output by columns."""
        return self._solve(columns, self.columns + output)

    def residual_square(self, column: int, others: Sequence[int]) -> float:
        """Return the sum of squares of a column's residual in its fit by others."""
        return float(self.whole[column, column] - self.whole[column, others] @ self._solve(others, column))

    def covariance(self, columns: Sequence[int], fitted: Sequence[int], output: int, coefficients: Array) -> Array:
        """Return the covariance of coefficients of columns, by the residual of `coefficients` of columns `fitted`."""
        scores = self.scores(columns, fitted, output, coefficients)
        return np.asarray(scores.T @ scores)

    def scores(self, columns: Sequence[int], fitted: Sequence[int], output: int, coefficients: Array) -> Array:
        """Return what each batch adds to the errors of coefficients, shape (batches, columns).

        The residual may be correlated within a batch; each score is enlarged by what the fit took from its batch.
        Source: Bell and McCaffrey, Survey Methodology 28 (2002) 169.
        """
        both = self.batches[:, columns]
        size, normal = self._normal(columns)
        scores = (both[:, :, self.columns + output] - both[:, :, fitted] @ coefficients) / size
        spread, turn = np.linalg.eigh(normal)
        half = turn * np.sqrt(np.maximum(spread, 0.0)) @ turn.T
        share, turn = np.linalg.eigh(half @ (both[:, :, columns] / np.outer(size, size)) @ half)
        kept = np.einsum("bji,bj->bi", turn, scores @ half) / np.sqrt(np.maximum(1 - share, 1 / _SWEEP_BATCHES))
        return np.asarray(np.einsum("bij,bj->bi", turn, kept) @ half / size)

    def freedom(self, columns: Sequence[int]) -> float:
        """Return the degrees of freedom of the variance of the first coefficient (Satterthwaite)."""
        size, normal = self._normal(columns)
        line = normal[0] / size
        shares = np.einsum("i,bij,j->b", line, self.batches[np.ix_(range(len(self.batches)), columns, columns)], line)
        return float(shares.sum() ** 2 / (shares @ shares))

    def _normal(self, columns: Sequence[int]) -> tuple[Array, Array]:
        """Return the root sum of squares of each column, and the inverse of the normal matrix over these sizes."""
        whole = self.whole[np.ix_(columns, columns)]
        size = np.sqrt(np.diag(whole))
        size = np.where(size > 0, size, 1.0)
        return size, np.linalg.pinv(whole / np.outer(size, size))

    def _solve(self, columns: Sequence[int], column: int) -> Array:
        size, normal = self._normal(columns)
        return np.asarray(normal @ (self.whole[columns, column] / size) / size)


def moments(count: int, columns: Callable[[slice], Sequence[Array] | Array], outputs: Sequence[Array]) -> Moments:
    """Return the sums of products of outputs and columns; `columns` makes these for each part of `count` samples."""
    whole, number = None, 0
    for batch, part in blocks(count):
        made = columns(part)
        rows = np.array([*made, *(output[part] for output in outputs)])
        whole = np.zeros((_SWEEP_BATCHES, len(rows), len(rows))) if whole is None else whole
        number = len(made)
        whole[batch] += rows @ rows.T
    assert whole is not None
    return Moments(whole, number)


def sweep_moments(samples: Samples, felt: Array | None = None) -> Moments:
    """Return the sums of products of the columns ``ONE`` to ``DERIVATIVES`` and the outputs.

    The rate rises or falls as the gyroscopes felt it, where `felt` is known, else as the table turned.
    """
    middle, largest = float(samples.time.mean()), float(np.abs(samples.rate).max())
    rises = None if felt is None else rising(felt)
    scales = samples.spacing ** -np.arange(1.0, 5.0)

    def columns(part: slice) -> list[Array]:
        near = samples.neighbours(part)
        rate = near[4]
        derivatives = scales[:, None] * (KERNELS @ near)
        square = rate**2
        turn = np.sign(derivatives[0]) if rises is None else np.where(rises[part], 1.0, -1.0)
        loop = turn, turn * (square if felt is None else felt[part] ** 2) / largest**2
        return [np.ones(len(rate)), samples.time[part] - middle, rate, square, square * rate, *loop, *derivatives]

    return moments(len(samples.time), columns, samples.outputs)


def rising(rate: Array) -> NDArray[np.bool_]:
    """Return whether a rate rises at each sample, shape (n,)."""
    rises = np.empty(len(rate), dtype=bool)
    rises[1:-1], rises[0], rises[-1] = rate[2:] > rate[:-2], rate[1] > rate[0], rate[-1] > rate[-2]
    return rises


def weigh_derivatives(samples: Samples, weights: Array, own: Array | None = None) -> Array:
    """Return the rate and its four derivatives, each times its weight (5,), at each of n samples, shape (n,).

    The rate at the sample itself is that which was recorded, or which the neighbours tell by weights `own`, shape (9,).
    """
    taps = (weights[1:] * samples.spacing ** -np.arange(1.0, 5.0)) @ KERNELS
    taps[4] += weights[0]
    if own is not None:
        taps += taps[4] * (own - np.eye(9)[4])
    rate = np.empty(len(samples.time))
    for _, part in blocks(len(rate)):
        rate[part] = taps @ samples.neighbours(part)
    return rate


# A run whose rate changes all the time: delay and bandwidth of the gyroscopes, and means by rate.


_BINS, _FEWEST_BLOCKS = 20, 10  # bins of the rate in which outputs are averaged; samples in one at least
_POWER, _SINE, _BESIDE = 0.999, 0.998, 3
"""Share of the power below the end of the band; of a sine, share of it within so many bins of the peak."""
_PER_PERIOD = 16  # pieces of a period of the fastest motion, over which samples are averaged
_BESIDE_NOISE = 8  # samples on both sides over which noise is averaged
_SMOOTH = 0.02  # of the largest step of the rate: it changes all the time if more steps than half exceed this
_LONGEST = 1 << 17  # samples that are analysed; more are thinned
_SHOWN = 3.0  # standard uncertainties that ``2 c - tau^2`` must exceed for a bandwidth to be stated
_CLEAN, _OVER_NOISE = 1e-6, 10.0
"""Share of the rate's power below which its noise does not matter; power over that of the noise from which a frequency
belongs to the motion."""
_QUIETEST, _APART = 0.1, 1.5
"""Share of frequencies that show the noise of the rate alone; factor beyond which differences show motion instead."""
_OWN, _CLEAR = 1e-3, 100
"""A derivative counts if rate and lower derivatives leave this share of its power, so many times that of its noise."""
_TOLD = 0.05
"""Share of the power of w' that no function of rate and branch has; of one sine 0.01, of a chirp from 0 Hz 0.25."""


@dataclass(frozen=True)
class Sweep:
    """Delay and bandwidth of the gyroscope along the table axis, and what they leave uncertain; value and uncertainty.

    Attributes
    ----------
    delay
        Delay, s.
    bandwidth
        Frequency at which a first-order lag with the same fall of amplitude is at -3 dB, Hz; None where it is beyond
        what the run shows.
    beyond
        Lower limit of such a bandwidth, 95 %, Hz; None for a single sine.
    frequency
        Frequency of the single sine that the rate is, Hz; None for a sweep.
    scale_error
        Standard uncertainty of the scale factor by delay, bandwidth and drift, a fraction.
    loop_error
        Standard uncertainty of rising less falling at rate 0 by the delay, a fraction of the largest rate; None where
        loop and delay cannot be distinguished.
    zero_error
        Wander of the zero of each of g gyroscopes beyond the noise of the means by rate, output, shape (g,).
    largest
        Largest rate of the table, rad/s; the means by rate lie within it.
    rising
        Number of means at rising rates; they come first.
    freedom
        Degrees of freedom of the scale factor's uncertainty.
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
    freedom: float = np.inf


@dataclass(frozen=True)
class Binned:
    """The outputs of g gyroscopes averaged in n bins of the rate, rising rates first.

    Attributes
    ----------
    rising
        Number of rising rates.
    rate
        Rate of the table as the gyroscopes feel it, rad/s, shape (n,).
    duration
        Time spent at it, s, shape (n,).
    middle
        Mean time, s, shape (n,).
    mean, variance
        Mean outputs, and variances of these means by the passes through each rate, shape (n, g).
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
    """Return delay and bandwidth of gyroscope number `main`, and the means of all outputs by rate.

    Parameters
    ----------
    time, rate
        Times, s, and the table's rate about the body axis, rad/s, shape (n,).
    outputs
        Output of each gyroscope, shape (n,).
    """
    step = float(np.median(np.diff(time[:10_001])))
    noise_of_rate = _noise_of_rate(time, rate)
    top, frequency = _find_band(rate, step, noise_of_rate)
    many = _PER_PERIOD if frequency is None else 2 * _PER_PERIOD
    side = max(1, round(1 / (many * top * step)))
    samples = take_with_neighbours(time, rate, outputs, side, step)
    sums = sweep_moments(samples)
    noise = _derivative_noise(noise_of_rate, side * step)
    count = _count_derivatives(sums, noise)
    if frequency is None and count < 2:  # a part of one period, whose spectrum has no peak
        frequency = float(np.sqrt(sums.variance(DERIVATIVES[0]) / sums.variance(RATE)) / (2 * np.pi))
    largest, derivatives = float(np.abs(rate).max()), DERIVATIVES[: 1 if frequency is not None else count]
    loop = [TURN, BOW] if frequency is None and _is_loop_observable(sums, noise[0]) else []
    sweep, weights = _fit_lag(sums, main, derivatives, loop, frequency, largest)
    felt = weigh_derivatives(samples, weights)
    if loop:  # the branches change when the gyroscope feels it
        sums = sweep_moments(samples, felt)
        sweep, weights = _fit_lag(sums, main, derivatives, loop, frequency, largest)
        felt = weigh_derivatives(samples, weights)
    rises = rising(felt)
    curve = _fit_curve(samples.time, felt, rises, samples.outputs)
    sweep = replace(sweep, scale_error=float(np.hypot(sweep.scale_error, curve.drift_error(main))))
    by = weigh_derivatives(samples, weights, INTERPOLATION) if noise_of_rate > _CLEAN * float(np.var(rate)) else None
    binned = _average_by_rate(samples.time, felt, rises, curve, step, by)
    if sweep.frequency is not None:
        factor = max(1, min(side, len(felt) // _LONGEST))
        binned = replace(binned, variance=binned.variance * _colour_factors(samples.time, felt, curve, binned, factor))
    known = np.mean(binned.variance * binned.duration[:, None], axis=0) / binned.duration.sum()
    zero = np.sqrt(np.maximum(binned.wander - known, 0.0))
    return replace(sweep, zero_error=zero, rising=binned.rising), binned


@dataclass(frozen=True)
class _Curve:
    """The outputs of g gyroscopes as a constant, a drift over time, powers of the rate over its largest, and a loop.

    Attributes
    ----------
    columns
        Returns the seven columns for a part of the samples, shape (7, n): 1, time, and `_branch_columns`.
    fits
        Coefficients of each gyroscope, shape (g, 7).
    sums
        Sums of products of columns and outputs.
    outputs
        Output of each gyroscope, shape (n,).
    """

    columns: Callable[[slice], Array]
    fits: Array
    sums: Moments
    outputs: list[Array]

    def residual(self, k: int) -> Array:
        """Return the output of gyroscope number `k` less its curve, shape (n,)."""
        residual = np.empty(len(self.outputs[k]))
        for _, part in blocks(len(residual)):
            residual[part] = self.outputs[k][part] - self.fits[k] @ self.columns(part)
        return residual

    def drift_error(self, k: int) -> float:
        """Return the scale factor's uncertainty by that of the drift, as far as the rate drifts too, a fraction."""
        every, whole = range(self.sums.columns), self.sums.whole
        drift = float(np.sqrt(self.sums.covariance(every, every, k, self.fits[k])[1, 1]))
        together = (whole[1, 2] - whole[0, 1] * whole[0, 2] / whole[0, 0]) / whole[0, 0]
        line = self.sums.fit([0, 2], k)[1]
        return drift * float(together / line) / self.sums.variance(2)


def _fit_curve(time: Array, felt: Array, rises: NDArray[np.bool_], outputs: list[Array]) -> _Curve:
    middle, span, largest = float(time.mean()), float(np.ptp(time)), float(np.abs(felt).max())

    def columns(part: slice) -> Array:
        rate = felt[part] / largest
        return np.array([np.ones(len(rate)), (time[part] - middle) / span, *_branch_columns(rate, rises[part])])

    sums = moments(len(felt), columns, outputs)
    fits = np.array([sums.fit(range(sums.columns), k) for k in range(len(outputs))])
    return _Curve(columns, fits, sums, outputs)


def _branch_columns(rate: Array, rises: NDArray[np.bool_]) -> list[Array]:
    """Return a rate, its square and cube, +1 where it rises and -1 where it falls, and that sign times the square."""
    square, turn = rate**2, np.where(rises, 1.0, -1.0)
    return [rate, square, square * rate, turn, turn * square]


def _power_of_rate(rate: Array) -> tuple[Array, float, int]:
    """Return the power of a rate over frequency, that of white noise of variance 1, and samples averaged beforehand."""
    factor = max(1, len(rate) // _LONGEST)
    values = rate[: len(rate) // factor * factor].reshape(-1, factor).mean(axis=1) if factor > 1 else rate
    window = np.hanning(len(values))
    power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2
    power[0] = 0.0
    return power, float(window @ window) / factor, factor


def _find_band(rate: Array, step: float, noise: float) -> tuple[float, float | None]:
    """Return the frequency below which the rate's power lies, Hz, and that of the rate if it is a single sine.

    `noise` is the variance of the recorded rate's noise, above which the power of the motion stands.
    """
    power, white, factor = _power_of_rate(rate)
    power[power < _OVER_NOISE * noise * white] = 0.0
    frequency = np.fft.rfftfreq(len(rate) // factor, step * factor)
    share = np.cumsum(power) / power.sum()
    top = float(frequency[min(int(np.searchsorted(share, _POWER)) + 1, len(frequency) - 1)])
    peak = int(np.argmax(power))
    beside = slice(max(0, peak - _BESIDE), peak + _BESIDE + 1)
    single_line = power[beside].sum() > _SINE * power.sum() and peak > _BESIDE
    return top, float(power[beside] @ frequency[beside] / power[beside].sum()) if single_line else None


def _derivative_noise(of_rate: float, spacing: float) -> list[float]:
    """Return the variances of four derivatives by the variance of the recorded rate's noise."""
    return [of_rate * float(kernel @ kernel) / spacing ** (2 * k) for k, kernel in enumerate(KERNELS, 1)]


def _noise_of_rate(time: Array, rate: Array) -> float:
    """Return the variance of white noise of the recorded rate, by its eighth differences.

    White noise of variance s^2 has eighth differences of variance 12870 s^2; those across a gap are left out. A motion
    near half the sampling rate has such differences too: the quietest tenth of the spectrum is a limit, where white
    noise has at most 0.105 of its mean power.
    """
    step = float(np.median(np.diff(time[:10_001])))
    whole = time[8:_LONGEST] - time[: _LONGEST - 8][: len(time) - 8] < WHOLE * step
    of_differences = float(np.mean(np.diff(rate[:_LONGEST], n=8)[whole] ** 2)) / 12870 if whole.any() else 0.0
    power, white, _ = _power_of_rate(rate[:_LONGEST])
    quietest = float(np.quantile(power[1:], _QUIETEST)) / -np.log1p(-_QUIETEST) / white
    return float(min(of_differences, _APART * quietest))


def _count_derivatives(moments: Moments, noise: list[float]) -> int:
    """Return how many derivatives of the rate can be fitted.

    From the second on one cannot where rate and lower derivatives leave less than a thousandth of its power, or where
    its power is noise of the recorded rate by more than a hundredth.
    """
    count = float(moments.whole[ONE, ONE])
    for number, column in enumerate(DERIVATIVES[1:], 1):
        left = moments.residual_square(column, [ONE, TIME, RATE, *DERIVATIVES[:number]])
        if left < max(_OWN * float(moments.whole[column, column]), _CLEAR * noise[number] * count):
            return number
    return len(DERIVATIVES)


def _is_loop_observable(moments: Moments, noise: float) -> bool:
    """Return whether w' differs from pass to pass at the same rate beyond its noise, as a loop does not."""
    slope, count = DERIVATIVES[0], float(moments.whole[ONE, ONE])
    left = moments.residual_square(slope, [ONE, TIME, RATE, TURN, BOW])
    return left - noise * count > _TOLD * float(moments.whole[slope, slope])


def _fit_lag(
    moments: Moments,
    main: int,
    derivatives: Sequence[int],
    loop: Sequence[int],
    frequency: float | None,
    largest: float,
) -> tuple[Sweep, Array]:
    """Return delay and bandwidth of a gyroscope, and the weights of rate and derivatives in the rate that it felt.

    Of ``S (w - tau w' + c w'')``: delay tau; ``2 c - tau^2 = 1 / (2 pi f)^2``, f the corner of the first-order lag with
    the same fall of amplitude.
    """
    still = [RATE, *loop, ONE, TIME, SQUARE, *([] if frequency is not None else [CUBE])]
    columns = [RATE, *derivatives, *still[1:]]
    coefficients = moments.fit(columns, main)
    scores = moments.scores(columns, columns, main, coefficients)
    spread = scores.T @ scores
    scale, weights = float(coefficients[0]), np.zeros(5)
    without = moments.scores(still, columns, main, coefficients)
    more = float(np.linalg.norm(scores[:, 0] - without[:, 0])) / abs(scale)
    of_loop = None
    if loop:
        at = columns.index(TURN)
        of_loop = 2 * float(np.linalg.norm(scores[:, at] - without[:, 1])) / abs(scale) / largest
    if frequency is not None:
        omega = 2 * np.pi * frequency
        phase = float(np.arctan2(-coefficients[1] * omega * np.sign(scale), abs(scale)))
        u = float(np.sqrt(spread[1, 1])) / abs(scale)
        weights[:2] = np.cos(phase), -np.sin(phase) / omega
        freedom = 4.0 * _BESIDE_NOISE  # two of each frequency by which the noise is known
        return Sweep((phase / omega, u), None, None, frequency, more, None, np.zeros(0), largest, 0, freedom), weights
    tau, c = -coefficients[1] / scale, coefficients[2] / scale
    lines = np.zeros((2, len(coefficients)))
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
    weights[: len(derivatives) + 1] = [1.0, *(coefficients[1 : len(derivatives) + 1] / scale)]
    delay = float(tau), float(np.sqrt(both[0, 0]))
    freedom = moments.freedom(columns)
    return Sweep(delay, bandwidth, beyond, None, more, of_loop, np.zeros(0), largest, 0, freedom), weights


def _colour_factors(time: Array, felt: Array, curve: _Curve, binned: Binned, factor: int) -> Array:
    """Return the factor of the variances of means by rate, of each gyroscope, for noise that is not white.

    The scale factor at one frequency takes up the noise near that frequency. With d the rate over its largest, less
    its fit by bias, drift and square, and D and R the spectra of d and of the residual, the variance of the slope is
    ``mean(|D|^2 |R|^2) / (d d)^2``, |R|^2 averaged over 2 n neighbouring frequencies: the fit took out about one.
    Long runs are averaged over `factor` samples first, far fewer than a period has.
    """
    rate, trend = _average_samples(felt, factor), _average_samples(time, factor)
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
        power = np.abs(np.fft.rfft(_average_samples(curve.residual(k), factor)))[1:] ** 2
        beside = np.convolve(power, window, mode="same") / count / size
        variance = float(lines[1:] @ beside) / float(along @ along) / largest**2
        each = float(np.mean(binned.variance[:, k] * length))  # pooled, for 1 s
        factors.append(variance * float(length @ apart**2) / each if each > 0 else 1.0)
    return np.array(factors)


def _average_samples(values: Array, factor: int) -> Array:
    """Return the means of successive groups of `factor` values."""
    return values if factor == 1 else values[: len(values) // factor * factor].reshape(-1, factor).mean(axis=1)


def _average_by_rate(
    time: Array, felt: Array, rises: NDArray[np.bool_], curve: _Curve, step: float, by: Array | None
) -> Binned:
    """Return the mean outputs by rate, without drift; each is moved along the fitted curve to the middle of its bin.

    Where the recorded rate is noisy, a bin of it holds what noise brought there, and outputs follow less than the rate.
    Bins of a rate `by` that has noise of its own do not: in them the mean rate belongs to the mean output (Wald, Ann.
    Math. Stat. 11 (1940) 284).
    """
    instrument = felt if by is None else by
    low, high = float(instrument.min()), float(instrument.max())
    number = _number_bins(instrument, rises, low, high)
    middle = low + (np.arange(_BINS) + 0.5) / _BINS * (high - low)
    middle = np.concatenate([middle, middle[::-1]])
    count = np.bincount(number, minlength=2 * _BINS)
    which = np.flatnonzero(count > max(_FEWEST_BLOCKS, len(felt) // 5000))
    size = count[which]

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(number, values, minlength=2 * _BINS)[which] / size)

    starts = np.concatenate([[0], np.flatnonzero(number[1:] != number[:-1]) + 1])
    place = number[starts]
    rates = middle[which] if by is None else mean(felt)
    drift = (mean(time) - time.mean()) / np.ptp(time)
    powers = np.array(_branch_columns(middle[which] / max(abs(low), abs(high)), which < _BINS))
    parts = np.linspace(0, len(felt), PARTS, endpoint=False).astype(np.int64)
    means, variances, wander = [], [], []
    for k, fit in enumerate(curve.fits):
        rest = curve.residual(k)
        means.append(mean(rest) + fit[0] + fit[2:] @ powers if by is None else mean(curve.outputs[k]) - fit[1] * drift)
        passes = np.add.reduceat(rest, starts) ** 2
        variances.append(np.bincount(place, passes, minlength=2 * _BINS)[which] / size**2)
        wander.append(variance_of_mean(np.add.reduceat(rest, parts) / np.diff(parts, append=len(felt))))
    return Binned(
        int(np.count_nonzero(which < _BINS)),
        rates,
        np.asarray(size * step, dtype=np.float64),
        mean(time),
        np.column_stack(means),
        np.column_stack(variances),
        np.array(wander),
    )


def _number_bins(felt: Array, rises: NDArray[np.bool_], low: float, high: float) -> NDArray[np.int64]:
    """Return the bin of each sample: 0 to 19 by its rate where this rises, and 39 down to 20 where it falls."""
    number = np.empty(len(felt), dtype=np.int64)
    for _, part in blocks(len(felt)):
        number[part] = (felt[part] - low) / (high - low) * _BINS
    np.minimum(number, _BINS - 1, out=number)
    np.subtract(2 * _BINS - 1, number, out=number, where=~rises)
    return number
