"""Removal of what is no noise from a log at rest: spikes, knocks, spectral lines, and changes of level."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.decisions import LEVEL_STEP, SPECTRAL_LINE
from imulab.estimation.distributions import chi_square_upper_quantile
from imulab.estimation.rows import median, medians, quantile
from imulab.recording import Array

_BLOCK, _SPIKE = 50, 6.0  # samples of a block whose median is the level; sigma beyond which a sample is a spike
_CHUNK = 1 << 16  # samples whose deviations are compared together
_TO_SIGMA = 1.959964  # 95 % of |x| of a normal distribution
# Fewest coefficients of a bin with its own median; coefficients left out on each side of a line
_FEWEST, _SKIRT = 16, 3
_LEAST = 100  # coefficients of a median: that of 16 is sometimes off by a factor of 3
_STRONG, _NEAR, _WANDERS, _MOST_STRONG, _ROUNDS = 1e3, 50, 0.01, 8, 14
"""Strong lines: power over the median, coefficients fitted on both sides, largest share of power left, how many lines,
rounds of the search for the frequency."""
_STRONG_SLOW, _SLOW = 1e5, 200
"""The same limit among the lowest coefficients, which show slow noise: a slow sway must not pass for a line."""
_NOISE = 3.0
"""Noise beside a line, over the median of its squares: their mean is 2.2 medians, and scatters over 100 of them."""
_LOWEST, _SURE = (1 << 16) - 1, 4.0
"""Coefficients that show whether there may be a step, and for how many standard deviations of what others add."""
# Blocks whose median is the usual level around one; fewest blocks; largest share of knocked blocks
_AROUND, _FEWEST_BLOCKS, _MOST_KNOCKED = 21, 64, 0.05
_KNOCK_OFF, _FIFTH, _LOUD = 6.0, 10, 3.0
"""A block is knocked if its median is 6 sigma off those around it, or if ten of its samples are 3 times as far from the
median as in nineteen of twenty blocks."""


@dataclass(frozen=True)
class Line:
    """A spectral line: frequency, Hz, and amplitude of the sine, in the unit of the samples."""

    frequency: float
    amplitude: float


@dataclass(frozen=True)
class LevelChange:
    """A change of the level: time from the start of the stretch, s, its size, and the size's standard uncertainty."""

    time: float
    size: float
    standard_uncertainty: float


def ordered_blocks(samples: Array) -> Array:
    """Return blocks of 50 samples, each in rising order, shape (n // 50, 50)."""
    count = len(samples) // _BLOCK
    return np.sort(samples[: count * _BLOCK].reshape(count, _BLOCK), axis=1)


def _medians_of(ordered: Array) -> Array:
    """Return the medians of `ordered_blocks`, shape (k,)."""
    medians_of_blocks: Array = (ordered[:, _BLOCK // 2 - 1] + ordered[:, _BLOCK // 2]) / 2
    return medians_of_blocks


def spikes_removed(samples: Array, ordered: Array) -> tuple[Array, int]:
    """Return samples, shape (n,), with spikes replaced, and the number of spikes; `ordered`: their `ordered_blocks`.

    A spike is more than 6 sigma off the line through medians of 50 samples, with sigma from the 95 % of the deviations
    of the 65,536 samples around it: 4 % of spikes do not change it. Samples that hardly ever change have no spikes.

    Examples
    --------
    >>> x = np.random.default_rng(1).standard_normal(1000)
    >>> x[500] = 20.0
    >>> cleaned, count = spikes_removed(x, ordered_blocks(x))
    >>> count, bool(abs(cleaned[500]) < 1)
    (1, True)
    """
    blocks = len(ordered)
    if blocks < 4:
        return samples, 0
    # Lines join the middles of neighbouring blocks; the outer ones are extended.
    level = _medians_of(ordered)
    rise = np.diff(level)
    share = (np.arange(_BLOCK) + 0.5) / _BLOCK
    reach = _reach(ordered, level)
    count, cleaned = 0, samples
    half = _BLOCK // 2
    body = slice(half, half + (blocks - 1) * _BLOCK)
    for start in range(0, blocks - 1, _CHUNK // _BLOCK):
        stop = min(start + _CHUNK // _BLOCK, blocks - 1)
        part = samples[body][start * _BLOCK : stop * _BLOCK]
        every = max(1, len(part) // 8192)
        some = np.arange(0, len(part), every)
        block = some // _BLOCK
        near = level[start:stop][block] + rise[start:stop][block] * share[some - _BLOCK * block]
        limit = _SPIKE / _TO_SIGMA * quantile(np.abs(part[::every] - near), 0.95)
        if limit > 0 and float(reach[start:stop].max()) > limit:
            line = (level[start:stop, None] + rise[start:stop, None] * share).ravel()
            far = np.flatnonzero(np.abs(part - line) > limit)
            cleaned = samples.copy() if far.size and not count else cleaned
            cleaned[half + start * _BLOCK + far] = line[far]
            count += len(far)
    for edge, near in ((slice(0, half), level[0]), (slice(body.stop, None), level[-1])):
        off = np.abs(samples[edge] - near)
        if limit > 0 and len(off) and float(off.max()) > limit:
            cleaned = samples.copy() if not count else cleaned
            cleaned[edge] = np.where(off > limit, near, samples[edge])
            count += int(np.count_nonzero(off > limit))
    return cleaned, count


def _reach(ordered: Array, level: Array) -> Array:
    """Return how far at most samples of two neighbouring blocks are off the line between their medians, (k - 1,)."""
    above = np.maximum(ordered[1:, -1], ordered[:-1, -1]) - np.minimum(level[1:], level[:-1])
    below = np.maximum(level[1:], level[:-1]) - np.minimum(ordered[1:, 0], ordered[:-1, 0])
    # The line is rounded.
    return np.asarray(np.maximum(above, below) + 4 * np.spacing(np.abs(level).max()))


def knocks_removed(samples: Array, ordered: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return samples, shape (n,), with knocks replaced by straight lines, and the knocks' first and last + 1, (k, 2).

    `ordered` are their `ordered_blocks`. A knock is a block of 50 samples whose median is 6 sigma off the median of the
    21 blocks around it, or with ten samples farther from that than three times what nineteen of twenty blocks have;
    half a block on both sides belongs to it. Where more than 5 % of all blocks are knocked, none is replaced.
    """
    count = len(ordered)
    none = np.empty((0, 2), dtype=np.int64)
    if count < _FEWEST_BLOCKS:
        return samples, none
    level = _medians_of(ordered)
    # Of the ten samples that are farthest from the median, some are the smallest and the others the largest.
    below = np.subtract(level, ordered[:, :_FIFTH].T, order="C")
    above = np.subtract(ordered[:, : -_FIFTH - 1 : -1].T, level, order="C")
    far = np.maximum.reduce([below[-1], above[-1], *np.minimum(below[:-1], above[-2::-1])])
    around = np.lib.stride_tricks.sliding_window_view(np.pad(level, _AROUND // 2, mode="reflect"), _AROUND)
    off = np.abs(level - medians(around))
    knocked = np.zeros(count, dtype=np.bool_)
    for size, limit in ((off, _KNOCK_OFF / _TO_SIGMA), (far, _LOUD)):
        beyond = size > limit * quantile(size, 0.95)
        if beyond.any() and quantile(size, 0.9) > 0:  # samples in whole counts hardly ever differ
            knocked |= beyond
    if not 0 < np.count_nonzero(knocked) <= _MOST_KNOCKED * count:
        return samples, none
    # A knock that reaches into the next block includes it.
    half = _BLOCK // 2
    edge = np.flatnonzero(np.diff(np.concatenate([[0], knocked.astype(np.int8), [0]]))).reshape(-1, 2) * _BLOCK
    edge = np.clip(edge + half * np.array([-1, 1]), 0, len(samples))
    cleaned = samples.copy()
    centre = half + _BLOCK * np.flatnonzero(~knocked)
    for start, stop in edge.tolist():
        cleaned[start:stop] = np.interp(np.arange(start, stop), centre, level[~knocked])
    return cleaned, edge


def line_groups(
    squares: Array, first: NDArray[np.int64], last: NDArray[np.int64], averages: int, count: int, interval: float
) -> tuple[NDArray[np.bool_], tuple[Line, ...]]:
    """Return which cosine coefficients belong to no spectral line, and the lines, from squares of the coefficients.

    A square, averaged over `averages` coefficients, belongs to a line beyond the 1e-9 point of chi-square about the
    median of the 100 coefficients around it; no line is looked for below the 25th. Three coefficients on both sides are
    left out with it, and all that stand out themselves, because a strong line leaks far.

    Returns
    -------
    tuple
        Which coefficients are no lines, shape (J,), and the lines, the largest first.
    """
    limit = float(chi_square_upper_quantile(SPECTRAL_LINE.level, averages) / chi_square_upper_quantile(0.5, averages))
    noise = averages / float(chi_square_upper_quantile(0.5, averages))  # the mean of chi-square over its median
    fine = np.ones(len(squares), dtype=np.bool_)
    level = _levels(squares, first, last, limit)
    out = np.flatnonzero((squares > limit * level) & (level > 0))
    if not out.size:
        return fine, ()
    level = _levels(squares, first, last)  # beside lines too
    lines = []
    for group in np.split(out, np.flatnonzero(np.diff(out) > 2 * _SKIRT + 1) + 1):
        reach = max(_SKIRT, int(group[-1] - group[0]))
        span = slice(max(int(group[0]) - reach, 0), int(group[-1]) + reach + 1)
        fine[span] = False
        above = squares[group] - level[group]
        f = float((above * (group + 1)).sum() / above.sum()) / (2 * count * interval)
        power = max(float((squares[span] - level[span] * noise).sum()), float(above.max()))
        lines.append(Line(f, float(np.sqrt(2 * power / count))))
    return fine, tuple(sorted(lines, key=lambda line: -line.amplitude))


def _levels(squares: Array, first: NDArray[np.int64], last: NDArray[np.int64], limit: float | None = None) -> Array:
    """Return the median around each coefficient, bin by bin, shape (J,); 0 where too few are around it.

    With a limit, inf where half of them exceed the largest over the limit: there none is beyond limit times the median.
    """
    width = last - first + 1
    level = np.zeros(len(width))
    for k in np.flatnonzero(width >= _FEWEST).tolist():
        beside = max(0, (_LEAST - int(width[k]) + 1) // 2)
        around = squares[max(int(first[k]) - 1 - beside, 0) : int(last[k]) + beside]
        clear = limit and 2 * np.count_nonzero(around > around.max() / limit) > len(around)
        level[k] = np.inf if clear else median(around)
    # Narrow bins take as many neighbours on both sides, or noise that falls with frequency would shift the median.
    centre = (first + last) // 2 - 1
    for half, most in ((_LEAST // 4, _LEAST // 2), (_LEAST // 2, len(squares) - _LEAST // 2)):
        near = np.flatnonzero((width < _FEWEST) & (centre >= half) & (centre < min(most, len(squares) - half)))
        if near.size:
            level[near] = medians(squares[centre[near, None] + np.arange(-half, half + 1)])
    levels = np.zeros(len(squares))
    levels[first[0] - 1 : last[-1]] = np.repeat(level, width)
    return levels


def strong_lines_removed(c: Array, lines: Sequence[Line], interval: float) -> tuple[Array, tuple[Line, ...]]:
    """Return coefficients c_1 .. c_{n-1} without the strong lines, and the lines that were removed.

    The leakage of a sine falls only with the distance j: 100 sigma of it raise the white noise by a third, and half a
    sigma in 40,000 samples raises it by 0.2 %. So a sine of constant frequency is fitted to the coefficients next to
    its line and subtracted from all. A line that wanders, which leaves more than 1 % of its power beside the noise,
    stays.
    """
    taken = []
    for line in lines[:_MOST_STRONG]:
        middle = round(2 * (len(c) + 1) * interval * line.frequency)
        near = slice(max(middle - _NEAR, 0), middle + _NEAR)
        power = c[near] ** 2
        around = median(c[max(middle - 10 * _NEAR, 0) : middle + 10 * _NEAR] ** 2)
        if power.max() < (_STRONG if middle > _SLOW else _STRONG_SLOW) * around:
            continue
        j = np.arange(1, len(c) + 1, dtype=np.float64)
        place, size = _sine(c[near], j[near], float(j[near][np.argmax(power)]), len(c) + 1)
        left = c[near] - _sine_coefficients(j[near], place, len(c) + 1).T @ size
        if float(np.sum(left**2)) < _WANDERS * float(power.sum()) + _NOISE * around * len(left):
            c = c - _sine_coefficients(j, place, len(c) + 1).T @ size
            taken.append(Line(place / (2 * (len(c) + 1) * interval), float(np.hypot(*size))))
    return c, tuple(taken)


def _sine(c: Array, j: Array, start: float, count: int) -> tuple[float, Array]:
    """Return the frequency, in units of j, and the cosine and sine amplitudes that fit coefficients best."""

    def fitted(place: float) -> tuple[float, Array]:
        basis = _sine_coefficients(j, place, count).T
        size = np.asarray(np.linalg.lstsq(basis, c)[0], dtype=np.float64)
        return float(np.sum((c - basis @ size) ** 2)), size

    low, high = start - 1.5, start + 1.5
    for _ in range(_ROUNDS):
        grid = np.linspace(low, high, 11) + 1e-9  # off whole numbers, where the formula is 0/0
        best = int(np.argmin([fitted(place)[0] for place in grid.tolist()]))
        low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, 10)])
    place = (low + high) / 2
    return place, fitted(place)[1]


def _sine_coefficients(j: Array, place: float, count: int) -> Array:
    """Return the coefficients of cosine and sine of ``w (i + 1/2)``, w = pi place/n, i = 0 .. n - 1, shape (2, ...)."""
    below, above = np.pi * (place - j) / count, np.pi * (place + j) / count
    cosine = np.sin(count * below) / np.sin(below / 2) + np.sin(count * above) / np.sin(above / 2)
    sine = (1 - np.cos(count * below)) / np.sin(below / 2) + (1 - np.cos(count * above)) / np.sin(above / 2)
    return np.asarray(np.stack([cosine, sine]) * np.sqrt(2 / count) / 4)


MOST_STEPS = 5  # of a stretch: with more, the steps are noise


def find_steps(
    slow: Array,
    variances: Array,
    count: int,
    interval: float,
    limit: float = LEVEL_STEP.limit,
    most: int = MOST_STEPS,
) -> tuple[LevelChange, ...]:
    """Return changes of level, found one after the other by size over standard uncertainty under the noise model.

    A step at sample k has the coefficients ``h_j = -sqrt(2/n) sin(pi j k/n)/s_j``, s_j = 2 sin(pi j/2n); its size is
    ``sum h_j c_j/lambda_j / sum h_j^2/lambda_j``, and z is that over its uncertainty. A place with ``|z|`` above the
    limit is a step.

    Parameters
    ----------
    slow, variances
        The lowest coefficients and their variances, shape (J,); infinite variances leave coefficients out.
    count, interval
        Samples of the stretch, n, and the time between them, s.
    limit
        Limit of ``|z|``.
    most
        Number of steps that are looked for.
    """
    steps: list[LevelChange] = []
    c, lowest, places = slow, _lowest_places(variances, count), None
    while len(steps) < most and _perhaps_a_step(c, *lowest, count, limit):
        places = places or _places_of_steps(variances, count)
        place, size, u = _largest_step(c, places, count)
        if not abs(size) > limit * u:
            break
        steps.append(LevelChange(place * interval, size, u))
        if len(steps) < most:
            c = c - size * step_coefficients(len(c), place, count)
    return tuple(sorted(steps, key=lambda step: step.time))


def step_coefficients(many: int, place: float, count: int) -> Array:
    """Return the coefficients c_1 .. c_J, J = `many`, of a unit step at sample `place` of `count`."""
    return np.asarray(
        -np.sqrt(2 / count) * _sines(np.pi * place / count, many) / (2 * _sines(np.pi / (2 * count), many))
    )


def _sines(step: float, many: int) -> Array:
    """Return ``sin(j step)``, j = 1 .. `many`, by the addition theorem from a coarse and a fine grid of angles."""
    width = math.isqrt(many) + 1
    coarse, fine = (np.exp(1j * angle * np.arange(width + 1)) for angle in (step * width, step))
    sines: Array = (coarse[:, None] * fine[:width]).imag.ravel()[1 : many + 1]
    return sines


def _places_of_steps(variances: Array, count: int) -> tuple[int, Array, Array]:
    """Return in how many intervals places are tried, ``1/(lambda_j s_j)``, and ``1/u^2`` of the size at each place."""
    # The spacing of places is that of the highest coefficient, but no finer than the samples.
    grid = len(variances) + 1 if len(variances) + 1 >= count else 1 << (len(variances)).bit_length()
    grid = min(grid, count)
    s = 2 * np.sin(np.pi * np.arange(1, min(len(variances), grid - 1) + 1) / (2 * count))
    weight = 1 / variances[: len(s)] / s
    return grid, weight, (np.sum(weight / s) - _cosines(weight / s, grid)) / count


def _lowest_places(variances: Array, count: int) -> tuple[tuple[int, Array, Array], float]:
    """Return the places that the lowest coefficients tell apart, and the most that all others add to ``1/u^2``."""
    x = (np.pi / count * np.arange(_LOWEST + 1, len(variances) + 1)) ** 2
    s_squared = x * (1 - x / 12)  # no more than s_j^2
    return _places_of_steps(variances[:_LOWEST], count), float(np.sum(2 / (variances[_LOWEST:] * s_squared))) / count


def _perhaps_a_step(c: Array, places: tuple[int, Array, Array], more: float, count: int, limit: float) -> bool:
    """Return whether the z of all coefficients may exceed a limit somewhere, from the lowest ones and what others add.

    Where the others hold a share of ``1/u^2`` and the z of all is at the limit, that of the lowest is normal about
    ``limit sqrt(1 - share)``, with the variance `share`.
    """
    score, information = _scores(c, places, count)
    least = np.maximum(information, 1e-300)
    share = more / (least + more)
    z = limit * np.sqrt(1 - share) - _SURE * np.sqrt(share)
    return bool((np.abs(score) > np.maximum(z, 0.0) * np.sqrt(least)).any())


def _largest_step(c: Array, places: tuple[int, Array, Array], count: int) -> tuple[float, float, float]:
    """Return place, size and uncertainty of the step with the largest z, with all places tried by a transform."""
    score, information = _scores(c, places, count)
    best = int(np.argmax(np.abs(score) / np.sqrt(np.maximum(information, 1e-300))))
    size, u = float(score[best] / information[best]), float(1 / np.sqrt(information[best]))
    return (best + 1) * count / places[0], size, u


def _scores(c: Array, places: tuple[int, Array, Array], count: int) -> tuple[Array, Array]:
    """Return size over squared uncertainty of a step, and ``1/u^2``, at each place, shapes (grid - 1,)."""
    grid, weight, information = places
    score = -np.sqrt(2 / count) * _sums_of_sines(c[: len(weight)] * weight, grid)
    beside = math.ceil(_BLOCK * grid / count)  # places as near to an end as a spike or knock is long are no level
    if 2 * beside < len(score):
        score[:beside] = score[len(score) - beside :] = 0.0
    return score, information


def _sums_of_sines(weight: Array, grid: int) -> Array:
    """Return ``S_q = sum_j w_j sin(pi j q/grid)``, j = 1 .. grid - 1, for q = 1 .. grid - 1.

    With N = grid, ``sin(pi j/N) (w_j + w_N-j) + (w_j - w_N-j)/2`` has the transform ``(S_2k+1 - S_2k-1) - i S_2k``; it
    is half as long as the odd continuation of w, whose transform holds these sums, too.
    """
    padded = np.zeros(grid + 1)
    padded[1 : 1 + len(weight)] = weight
    odd = (padded - padded[::-1])[1:-1] / 2
    padded += padded[::-1]
    padded[1:-1] *= _sines(np.pi / grid, grid - 1)
    padded[1:-1] += odd
    transformed = np.fft.rfft(padded[:-1])
    transformed.real[0] /= 2
    sums = np.empty(grid - 1)
    sums[::2] = transformed.real.cumsum()[: grid // 2]
    sums[1::2] = -transformed.imag[1 : (grid + 1) // 2]
    return sums


def _cosines(weight: Array, grid: int) -> Array:
    """Return ``sum_j w_j cos(2 pi j q/grid)``, j = 1 .. grid - 1, for q = 1 .. grid - 1."""
    padded = np.zeros(grid)
    padded[1 : 1 + len(weight)] = weight
    half = np.fft.rfft(padded).real[1:]
    return np.concatenate([half, half[: (grid - 1) // 2][::-1]])
