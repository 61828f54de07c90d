"""What is no noise in a log at rest: spikes, lines of the spectrum, steps of the level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array

_BLOCK, _SPIKE = 50, 6.0
_CHUNK = 1 << 16  # samples whose deviations are looked at together
_TO_SIGMA = 1.959964  # 95 % of |x| of a normal distribution
_FALSE_ALARM, _FEWEST, _SKIRT = 1e-9, 16, 3
_LEAST = 100  # coefficients whose median tells the level: that of 16 is off by a factor of 3 now and then
_STEP = 5.0
_MOST_STEPS = 5


@dataclass(frozen=True)
class Line:
    """A line of the spectrum: frequency, Hz, and amplitude of the sine, in the unit of the samples."""

    frequency: float
    amplitude: float


@dataclass(frozen=True)
class Step:
    """A change of the level: time from the start of the stretch, s, its size, and the size's standard uncertainty."""

    time: float
    size: float
    standard_uncertainty: float


def spikes_removed(samples: Array) -> tuple[Array, int]:
    """Return samples, shape (n,), with spikes replaced, and their number.

    A spike is more than 6 sigma off the line through medians of 50 samples, sigma from the 95 % of the deviations of
    65,536 samples around: 4 % of spikes do not change it. Samples that hardly ever change have no sigma, and no spikes.

    Examples
    --------
    >>> x = np.random.default_rng(1).standard_normal(1000)
    >>> x[500] = 20.0
    >>> cleaned, count = spikes_removed(x)
    >>> count, bool(abs(cleaned[500]) < 1)
    (1, True)
    """
    blocks = len(samples) // _BLOCK
    if blocks < 4:
        return samples, 0
    level = np.median(samples[: blocks * _BLOCK].reshape(blocks, _BLOCK), axis=1)
    # The line from the middle of a block to that of the next, and on beyond the first and the last.
    rise = np.diff(level)
    share = (np.arange(_BLOCK) + 0.5) / _BLOCK
    count, cleaned = 0, samples
    half = _BLOCK // 2
    body = slice(half, half + (blocks - 1) * _BLOCK)
    for start in range(0, blocks - 1, _CHUNK // _BLOCK):
        stop = min(start + _CHUNK // _BLOCK, blocks - 1)
        line = level[start:stop, None] + rise[start:stop, None] * share
        off = np.abs(samples[body][start * _BLOCK : stop * _BLOCK].reshape(line.shape) - line).ravel()
        limit = _SPIKE / _TO_SIGMA * float(np.quantile(off[:: max(1, len(off) // 8192)], 0.95))
        if limit > 0 and float(off.max()) > limit:
            far = np.flatnonzero(off > limit)
            cleaned = samples.copy() if not count else cleaned
            cleaned[half + start * _BLOCK + far] = line.ravel()[far]
            count += len(far)
    for edge, near in ((slice(0, half), level[0]), (slice(body.stop, None), level[-1])):
        off = np.abs(samples[edge] - near)
        if limit > 0 and len(off) and float(off.max()) > limit:
            cleaned = samples.copy() if not count else cleaned
            cleaned[edge] = np.where(off > limit, near, samples[edge])
            count += int(np.count_nonzero(off > limit))
    return cleaned, count


def line_groups(
    squares: Array, first: NDArray[np.int64], last: NDArray[np.int64], averages: int, count: int, interval: float
) -> tuple[NDArray[np.bool_], tuple[Line, ...]]:
    """Find lines: squares of coefficients that stand out of their bin, and what is beside them.

    A square, the mean of `averages`, is that of a line beyond the 1e-9 point of chi-square about the median of its bin,
    in bins of 16 and more, with their neighbours up to 100. Left out are three coefficients on both sides, and as many
    as stand out themselves: a strong line leaks far.

    Returns
    -------
    tuple
        Which coefficients are no lines, shape (J,), and the lines, the largest first.
    """
    from imulab.estimation.special import chdtri

    limit = float(chdtri(averages, _FALSE_ALARM) / chdtri(averages, 0.5))
    noise = averages / float(chdtri(averages, 0.5))  # the mean of chi-square over its median
    fine = np.ones(len(squares), dtype=np.bool_)
    level = np.zeros(len(squares))
    for start, stop in zip((first - 1).tolist(), last.tolist(), strict=True):
        if stop - start >= _FEWEST:
            beside = max(0, (_LEAST - (stop - start) + 1) // 2)
            level[start:stop] = np.median(squares[max(start - beside, 0) : stop + beside])
    out = np.flatnonzero((squares > limit * level) & (level > 0))
    if not out.size:
        return fine, ()
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


def find_steps(slow: Array, variances: Array, count: int, interval: float) -> tuple[Step, ...]:
    """Find steps of the level, one after the other, by their size over its standard uncertainty under the noise model.

    A step at sample k has the coefficients ``h_j = -sqrt(2/n) sin(pi j k/n)/s_j``, s_j = 2 sin(pi j/2n); its size is
    ``sum h_j c_j/lambda_j / sum h_j^2/lambda_j``, and z that over its uncertainty. |z| > 5 is a step.

    Parameters
    ----------
    slow, variances
        The lowest coefficients and their variances, shape (J,); infinite variances leave coefficients out.
    count, interval
        Samples of the stretch, n, and the time between them, s.
    """
    found: list[Step] = []
    c = slow
    while len(found) < _MOST_STEPS:
        place, size, u = _largest_step(c, variances, count)
        if not abs(size) > _STEP * u:
            break
        found.append(Step(place * interval, size, u))
        c = c - size * step_coefficients(len(c), place, count)
    return tuple(sorted(found, key=lambda step: step.time))


def step_coefficients(many: int, place: float, count: int) -> Array:
    """Return the coefficients c_1 .. c_J, J = `many`, of a unit step at sample `place` of `count`."""
    j = np.arange(1, many + 1)
    return np.asarray(-np.sqrt(2 / count) * np.sin(np.pi * j * place / count) / (2 * np.sin(np.pi * j / (2 * count))))


def _largest_step(c: Array, variances: Array, count: int) -> tuple[float, float, float]:
    """Place, size and uncertainty of the step with the largest z: all places by two transforms."""
    from scipy.fft import dst

    # Places are as fine as the highest of the coefficients can tell, and no finer than the samples.
    grid = len(c) + 1 if len(c) + 1 >= count else 1 << (len(c)).bit_length()
    grid = min(grid, count)
    used = c[: grid - 1]
    s = 2 * np.sin(np.pi * np.arange(1, len(used) + 1) / (2 * count))
    padded = np.zeros(grid - 1)
    padded[: len(used)] = used / variances[: len(used)] / s
    score = -np.sqrt(2 / count) * dst(padded, type=1) / 2
    weight = 1 / variances[: len(used)] / s**2
    information = (weight.sum() - _cosines(weight, grid)) / count
    z = np.abs(score) / np.sqrt(np.maximum(information, 1e-300))
    best = int(np.argmax(z))
    size, u = float(score[best] / information[best]), float(1 / np.sqrt(information[best]))
    return (best + 1) * count / grid, size, u


def _cosines(weight: Array, grid: int) -> Array:
    """``sum_j w_j cos(2 pi j q/grid)``, j = 1 .. grid - 1, for q = 1 .. grid - 1."""
    padded = np.zeros(grid)
    padded[1 : 1 + len(weight)] = weight
    half = np.fft.rfft(padded).real
    q = np.arange(1, grid)
    return np.asarray(half[np.minimum(q, grid - q)])
