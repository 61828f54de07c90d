"""The spectrum that noise models are fitted to: mean squares of cosine coefficients in bins of frequency.

A log of up to 4 million samples is transformed as a whole. Of a longer one, stretches of 262,144 samples give the
spectrum down to a frequency, and means of m samples the spectrum below it. All bins are stated for the full rate, and
the memory needed does not grow with the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.noise.cleaning import (
    Line,
    knocks_removed,
    line_groups,
    ordered_blocks,
    spikes_removed,
    strong_lines_removed,
)
from imulab.estimation.rows import distinct
from imulab.recording import Array, converted, release

# Bins of frequency.


_ALONE, _PER_DECADE = 24, 60  # lowest coefficients with a bin of their own; bins in a decade above them


@dataclass(frozen=True)
class Spectrum:
    """Mean squares of the orthonormal cosine coefficients of one stretch at rest, in bins of frequency.

    ``c_j = sqrt(2/n) sum_i x_i cos(pi j (i + 1/2)/n)``, of frequency ``j/(2 n dt)``. Several logs, or segments between
    gaps, are several spectra, whose deviances add up.

    Attributes
    ----------
    interval
        Time between samples, dt, s.
    count
        Samples of the stretch, n.
    first, last
        First and last j of each bin, both inclusive, shape (b,).
    power
        Mean ``c_j^2`` of each bin, the square of the samples' unit, shape (..., b): leading axes count columns or
        trials.
    freedom
        Number of coefficients in each mean, shape (b,) or that of `power`: fewer than ``last - first + 1`` where lines
        are left out, 0 for a bin that is left out, no whole number after an allowance for ripple.
    """

    interval: float
    count: int
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    power: Array
    freedom: Array

    @property
    def length(self) -> float:
        """Length of the stretch, s."""
        return self.count * self.interval


def bins(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return first and last j of each bin, shapes (b,): j = 1 .. 24 alone, then 60 bins a decade up to count - 1.

    Examples
    --------
    >>> first, last = bins(40)
    >>> first[22:].tolist(), last[22:].tolist()
    ([23, 24, 25, 26, 27, 29, 30, 31, 32, 33, 34, 36, 37, 39], [23, 24, 25, 26, 28, 29, 30, 31, 32, 33, 35, 36, 38, 39])
    """
    steps = int(np.ceil(_PER_DECADE * np.log10(max(count / _ALONE, 1)))) + 1
    edges = np.ceil((_ALONE + 1) * 10 ** (np.arange(steps) / _PER_DECADE)).astype(np.int64)
    starts = distinct(np.concatenate([np.arange(1, _ALONE + 1), edges]))
    first = starts[starts < count]
    return first, np.append(first[1:] - 1, count - 1)


# Cosine transform of any number of samples.


WHOLE, STRETCH = 1 << 22, 1 << 18
"""Most samples that are transformed as a whole; samples of a stretch of a longer log."""
_TOGETHER = 2
"""Stretches that are transformed together."""
_MEANS = 1 << 21
"""Most means that are kept: with more, each is of twice as many samples."""
_SHARE = 32
"""Only the lowest 32nd of the means' frequencies is used, where averaging takes at most 0.08 % from slow noise."""
SLOW = 1 << 19  # lowest coefficients that are kept one by one, for steps and covariates
_PARTS, _LEAST_PART, _LONG_PART = 64, 50, STRETCH // 4
"""Parts whose loudness is told, fewest samples of a part, and samples of a part of a longer log than a whole."""
_FINE = 1 << 10  # angles of the finer of the two tables whose products give all sines


@dataclass(frozen=True)
class Stretch:
    """Spectra and slow coefficients of one column of one stretch at rest.

    Attributes
    ----------
    spectra
        One spectrum; for a long log that of its means and that of its stretches at the full rate.
    slow
        Lowest coefficients of the whole stretch, c_1 .. c_J, J <= 524288, shape (J,): for steps and covariates.
    used
        Whether each of these is in the spectra and not left out as a line, shape (J,).
    lines
        Spectral lines that were left out, the largest first.
    spikes
        Number of samples that were replaced.
    knocks
        Start and length, s, of each part that was replaced because it differs from the noise around it.
    loudness
        Mean square of the steps from sample to sample in equal parts of the stretch, shape (p,).
    """

    spectra: tuple[Spectrum, ...]
    slow: Array
    used: NDArray[np.bool_]
    lines: tuple[Line, ...]
    spikes: int
    knocks: tuple[tuple[float, float], ...] = ()
    loudness: Array = field(default_factory=lambda: np.empty(0))

    @property
    def count(self) -> int:
        """Number of samples; there are ``count - 1`` coefficients."""
        return self.spectra[0].count

    @property
    def interval(self) -> float:
        """Time between samples, s."""
        return self.spectra[0].interval


def smooth_count(count: int) -> int:
    """Return the largest number up to `count` >= 1 of the form 2^a 3^b 5^c, whose transform is fast.

    Examples
    --------
    >>> smooth_count(1007)
    1000
    """
    best, five = 1, 1
    while five <= count:
        three = five
        while three <= count:
            best = max(best, three << ((count // three).bit_length() - 1))
            three *= 3
        five *= 5
    return best


def cosine_coefficients(samples: Array, most: int | None = None) -> Array:
    """Return ``c_j = sqrt(2/n) sum_i x_i cos(pi j (i + 1/2)/n)``, j = 1 .. n - 1, of samples of shape (n,).

    With `most` only those are returned whose j is not above it.

    Examples
    --------
    >>> [f"{c:.4f}" for c in cosine_coefficients(np.array([2.0, 0.0, 0.0, -1.0]))]
    ['1.9598', '0.5000', '0.8118']
    """
    n = len(samples)
    turned = _turned(samples, most)
    if most is not None and most <= n // 2:
        return np.asarray(turned.real[1:] * np.sqrt(2 / n))
    c = np.concatenate([turned.real[1:], -turned.imag[n - len(turned) : 0 : -1]])[:most]
    c *= np.sqrt(2 / n)
    return np.asarray(c)


def _turned(samples: Array, most: int | None = None) -> NDArray[np.complex128]:
    """Return ``sqrt(n/2) (c_j - i c_{n-j})`` of samples of shape (n,), j = 0 .. n // 2, or up to `most`."""
    n = len(samples)
    ordered = np.empty(n)
    _fill_ordered(ordered, samples)
    turned = np.fft.rfft(ordered)
    del ordered
    low = turned if most is None else turned[: most + 1]
    low *= _turns(n, len(low))
    return low


def _fill_ordered(ordered: Array, samples: Array) -> None:
    """Fill `ordered` with samples less their mean, both of shape (n,): the even ones, then the odd ones backwards.

    The Fourier transform of these, turned, is the cosine transform.
    """
    mean, even = samples.mean(), (len(samples) + 1) // 2
    np.subtract(samples[::2], mean, out=ordered[:even])
    np.subtract(samples[1::2][::-1], mean, out=ordered[even:])


def _turns(n: int, count: int) -> NDArray[np.complex128]:
    """Return ``exp(-i pi j/(2 n))``, j = 0 .. count - 1, shape (count,)."""
    # Each angle is the sum of a coarse and a fine one, which needs a thousandth of the exponentials.
    fine, coarse = np.arange(_FINE), _FINE * np.arange(count // _FINE + 1)
    turn = np.multiply.outer(np.exp(-0.5j * np.pi / n * coarse), np.exp(-0.5j * np.pi / n * fine))
    return np.asarray(turn.ravel()[:count])


class Accumulator:
    """Spectrum of one column whose samples arrive block by block.

    Parameters
    ----------
    interval
        Time between samples, s.
    despike
        Whether spikes are replaced by the line through the medians around them.
    long
        Whether there will be more samples than are transformed as a whole, where that is known.

    Examples
    --------
    >>> gathered = Accumulator(0.01)
    >>> for seed in range(3):
    ...     gathered.add(np.random.default_rng(seed).standard_normal(1000))
    >>> gathered.stretch().count
    3000
    """

    def __init__(self, interval: float, despike: bool = True, long: bool = False) -> None:
        self._interval, self._despike, self._long = interval, despike, long
        self._waiting = np.empty(0)
        self._held = self._spikes = self._stretches = 0
        self._squares, self._turns = np.zeros(1), np.empty(0, dtype=np.complex128)
        self._knocks: list[NDArray[np.int64]] = []
        self._loudness = np.empty(0)
        self._means, self._filled, self._averaged = np.empty(0), 0, 1

    def add(self, samples: Array) -> None:
        """Take the next samples, finite, shape (k,)."""
        self._long = self._long or self._held + len(samples) > WHOLE
        if self._long:
            rest = self._transform(self._all())
            samples = np.concatenate([rest, samples]) if len(rest) else samples
            self._waiting, self._held = np.empty(STRETCH), 0
            samples = self._transform(samples)
        elif not len(self._waiting):
            self._waiting = np.empty(WHOLE)  # at once: many small arrays would leave holes in the memory
        self._waiting[self._held : self._held + len(samples)] = samples
        self._held += len(samples)

    def stretch(self, interval: float | None = None) -> Stretch:
        """Return the spectra of all samples; the accumulator takes no more.

        Parameters
        ----------
        interval
            Time between samples, s, where it is known better now.
        """
        self._interval = interval or self._interval
        held = self._all()
        self._waiting = np.empty(0)
        if not self._stretches:
            return self.whole(held)
        if len(held):
            held = self._cleaned(held)
            self._add_means(held)
        return self._two_parts()

    def slow(self) -> Array:
        """Return the lowest coefficients of a covariate, with lines, shape (J,); the accumulator takes no more."""
        if self._stretches:
            return self.stretch().slow
        held = self._all()
        return cosine_coefficients(held[: smooth_count(len(held))], SLOW)

    def _all(self) -> Array:
        return self._waiting[: self._held]

    def _cleaned(self, samples: Array) -> Array:
        if not self._despike:
            return samples
        ordered = ordered_blocks(samples)
        without, knocks = knocks_removed(samples, ordered)
        self._knocks.append(knocks + self._stretches * STRETCH)
        samples, count = spikes_removed(without, ordered if without is samples else ordered_blocks(without))
        self._spikes += count
        part = _LONG_PART if self._long else max(len(samples) // _PARTS, _LEAST_PART)
        parts = np.diff(samples[: len(samples) // part * part].reshape(-1, part), axis=1)
        self._loudness = np.concatenate([self._loudness, np.einsum("pi,pi->p", parts, parts) / (part - 1)])
        return samples

    def _knocked(self) -> tuple[tuple[float, float], ...]:
        edges = np.concatenate([np.empty((0, 2), dtype=np.int64), *self._knocks])
        return tuple((start * self._interval, (stop - start) * self._interval) for start, stop in edges.tolist())

    def whole(self, samples: Array) -> Stretch:
        """Return the spectrum of a log that is in memory as a whole, shape (n,)."""
        count = smooth_count(len(samples))
        c = cosine_coefficients(self._cleaned(samples)[:count])
        first, last = bins(count)
        squares = c * c
        fine, lines = line_groups(squares, first, last, 1, count, self._interval)
        c, strong = strong_lines_removed(c, lines, self._interval)
        if strong:
            squares = c * c
            fine, weak = line_groups(squares, first, last, 1, count, self._interval)
            lines = tuple(sorted([*strong, *weak], key=lambda line: -line.amplitude))
        spectrum = binned(squares, fine, (first, last), self._interval, count)
        return Stretch((spectrum,), c[:SLOW].copy(), fine[:SLOW], lines, self._spikes, self._knocked(), self._loudness)

    def _transform(self, samples: Array) -> Array:
        """Add the squares of all whole stretches, some at a time; return the rest."""
        while many := min(len(samples) // STRETCH, _TOGETHER):
            ordered = np.empty((many, STRETCH))
            for row, part in zip(ordered, samples[: ordered.size].reshape(ordered.shape), strict=True):
                stretch = self._cleaned(part)
                _fill_ordered(row, stretch)
                self._add_means(stretch)
                self._stretches += 1
            if not len(self._turns):
                self._turns = _turns(STRETCH, STRETCH // 2 + 1)
            turned = np.fft.rfft(ordered)
            turned *= self._turns
            squares = turned.view(np.float64)
            squares *= squares
            squares[0] += self._squares
            self._squares = squares.sum(axis=0)
            samples = samples[ordered.size :]
        return samples

    def _add_means(self, samples: Array) -> None:
        """Add means of samples; their number is a multiple of that of a mean, except at the end of the log."""
        if not len(self._means):
            self._means = np.empty(_MEANS)
        if self._filled + len(samples) // self._averaged > _MEANS:
            self._filled //= 2
            self._means[: self._filled] = 0.5 * (
                self._means[: 2 * self._filled : 2] + self._means[1 : 2 * self._filled : 2]
            )
            self._averaged *= 2
        count = len(samples) // self._averaged
        part = samples[: count * self._averaged]
        while len(part) > count:
            part = 0.5 * (part[::2] + part[1::2])
        self._means[self._filled : self._filled + count] = part
        self._filled += count

    def _two_parts(self) -> Stretch:
        many = smooth_count(self._filled)
        count = many * self._averaged
        used = many // _SHARE
        slow = cosine_coefficients(self._means[:many], used) * np.sqrt(self._averaged)
        edges = bins(count)
        low = edges[1] <= used
        kept = (edges[0][low], edges[1][low])
        fine, lines = line_groups(slow**2, *kept, 1, count, self._interval)
        parts = [binned(slow**2, fine, kept, self._interval, count)]
        first, last = bins(STRETCH)
        low_and_high = self._squares.reshape(-1, 2) * (2 / (STRETCH * self._stretches))
        squares = np.concatenate([low_and_high[1:, 0], low_and_high[STRETCH // 2 - 1 : 0 : -1, 1]])
        high = first > (kept[1][-1] + 0.5) * STRETCH / count  # half a bin between the two parts is lost
        fine_above, more = line_groups(squares, first, last, self._stretches, STRETCH, self._interval)
        above = binned(squares, fine_above, (first[high], last[high]), self._interval, STRETCH)
        parts.append(
            Spectrum(self._interval, STRETCH, above.first, above.last, above.power, above.freedom * self._stretches)
        )
        edge = above.first[0] / (2 * STRETCH * self._interval)
        named = [*lines, *(each for each in more if each.frequency >= edge)]
        lines = tuple(sorted(named, key=lambda line: -line.amplitude))
        return Stretch(tuple(parts), slow, fine, lines, self._spikes, self._knocked(), self._loudness)


def binned(
    squares: Array,
    fine: NDArray[np.bool_],
    edges: tuple[NDArray[np.int64], NDArray[np.int64]],
    interval: float,
    count: int,
) -> Spectrum:
    """Return the spectrum from squares of coefficients, c_1 .. c_J, shape (J,), of which only the `fine` ones count."""
    first, last = edges
    inside = slice(int(first[0]) - 1, int(last[-1]))
    starts = first - first[0]
    freedom = np.add.reduceat(fine[inside].astype(np.float64), starts)
    total = np.add.reduceat(np.where(fine[inside], squares[inside], 0.0), starts)
    # A bin without coefficients has no weight, but its logarithm must exist.
    power = np.where(freedom > 0, total / np.maximum(freedom, 1), 1.0)
    return Spectrum(interval, count, first, last, power, freedom)


def transformed(samples: Array, interval: float, despike: bool = True, unit: str = "1") -> Stretch:
    """Return the spectra, SI, of samples in a unit, finite, shape (n,): see `Accumulator`."""
    gathered = Accumulator(interval, despike, long=len(samples) > WHOLE)
    if len(samples) <= WHOLE:
        return gathered.whole(converted(np.asarray(samples, dtype=np.float64), unit))
    for start in range(0, len(samples), _TOGETHER * STRETCH):
        gathered.add(converted(samples[start : start + _TOGETHER * STRETCH], unit))
        release(samples)
    return gathered.stretch()


def slow_coefficients(samples: Array, interval: float) -> Array:
    """Return the lowest coefficients of a covariate in memory, finite, shape (n,): see `Accumulator.slow`."""
    gathered = Accumulator(interval, despike=False)
    gathered.add(samples)
    return gathered.slow()


def frequencies(spectrum: Spectrum) -> Array:
    """Return the middle of each bin, Hz, shape (b,)."""
    return np.asarray((spectrum.first + spectrum.last) / (4 * spectrum.length))


def variances_of_coefficients(variances: Sequence[Array], stretch: Stretch, many: int) -> Array:
    """Return the variances of the lowest coefficients, shape (many,), from those in the bins of each spectrum, (b,).

    Between the bins it is interpolated linearly in the logarithms of frequency and variance.
    """
    f = np.concatenate([frequencies(each) for each in stretch.spectra])
    j = np.arange(1, many + 1)
    wanted = np.log(j / (2 * stretch.count * stretch.interval))
    return np.asarray(np.exp(np.interp(wanted, np.log(f), np.log(np.concatenate(variances)))))
