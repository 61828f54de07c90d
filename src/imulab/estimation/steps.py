"""A level that jumps, in samples of a sensor at rest: no noise, though an Allan curve reads it as one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from imulab.estimation.ranked import MAD_TO_SIGMA, median
from imulab.recording import Array

_BLOCKS, _SMALLEST = 256, 16
_LIMITS = {4: 5.5, 8: 5.8, 16: 7.0}
"""Blocks on each side of a step to how many times the usual difference it must be: white noise, 1/f noise, random walk
and sums of them reach one of these in 4 of 1000 recordings at most."""
_WHITE = 5.0
_REACHES = (8, 16, 32, 64)
"""Blocks on each side of a step over which it is held against smooth drifts."""
_TAUS = np.geomspace(0.003, 2.0, 20)
"""Time constants of exponential drifts, in lengths of the part that they are fitted to."""
_ALLOWED, _PLAIN = 6.0, 10.0
"""By how many variances of a mean a step may fit worse than a drift near its place, and must fit better farther out."""


@dataclass(frozen=True)
class Step:
    """A change of level: its size, in the unit of the samples, the first sample behind it, and how exact that is."""

    size: float
    sample: int
    within: int


def find_step(samples: Array) -> Step | None:
    """Return the plainest step of the level of samples, shape (n,), or None where noise explains what there is.

    The samples become 256 means of equal length. For every place between two of them, the means of 4, 8 and 16 on both
    sides are compared: of noise, whether white, 1/f or a random walk, these differences are alike everywhere, and a
    step makes one that is many times their median. So does a drift that is faster in one part of the recording than in
    the others; a step therefore has to fit the means around it better than smooth drifts do. Fewer than 4096 samples
    are too few to tell.
    """
    length = len(samples) // _BLOCKS
    if length < _SMALLEST:
        return None
    means = samples[: _BLOCKS * length].reshape(_BLOCKS, length).mean(axis=1)
    total = np.concatenate([[0.0], np.cumsum(means - means.mean())])
    white = deviation_of_steps(samples) / np.sqrt(length)
    best, found = 1.0, None
    for width, limit in _LIMITS.items():
        place = np.arange(width, _BLOCKS - width + 1)
        change = (total[place + width] - 2 * total[place] + total[place - width]) / width
        index = int(np.argmax(np.abs(change)))
        others = np.abs(np.delete(change, np.s_[max(0, index - 2 * width) : index + 2 * width + 1]))
        least = max(limit * MAD_TO_SIGMA * median(others), _WHITE * white / np.sqrt(width))
        if least > 0 and abs(change[index]) > best * least:
            best = abs(change[index]) / least
            found = Step(float(change[index]), int(place[index]) * length, 4 * length)
    return found if found is not None and _jumps(means, found.sample // length) else None


def deviation_of_steps(samples: Array) -> float:
    """Return the standard deviation of the differences between neighbouring samples, shape (n,), n >= 2."""
    step = np.diff(samples)
    square = float(np.einsum("i,i", step, step)) / len(step)  # std would copy a long log twice
    return float(np.sqrt(max(square - float(step.mean()) ** 2, 0.0)))


def _jumps(means: Array, place: int) -> bool:
    """Whether a step near a place fits the means around it better than any smooth drift.

    A drift is a polynomial of fourth order, or one of second order with an exponential (or two); the step comes with a
    polynomial of second order or with an exponential, so that neither has more to adapt.
    """
    for reach in _REACHES:
        low, high = max(0, place - reach), min(_BLOCKS, place + reach)
        part = means[low:high]
        count = len(part)
        time = np.linspace(-1, 1, count)
        rises = [[np.exp(sign * (time - sign) / (2 * tau)) for tau in _TAUS] for sign in (-1, 1)]
        powers = np.vander(time, 5, increasing=True)
        # Two neighbouring exponentials have every time constant between theirs.
        pairs = [pair for one in rises for pair in pairwise(one)]
        smooth = min(
            _misfit(np.column_stack(basis), part) for basis in ([powers], *([powers[:, :3], *p] for p in pairs))
        )
        later = np.arange(count)[:, None] >= np.arange(max(place - low - 2, 1), min(place - low + 3, count))
        jumping = min(
            _misfit(np.column_stack([basis, step]), part)
            for step in later.T.astype(np.float64)
            for basis in (powers[:, :3], *(np.column_stack([powers[:, 0], r]) for one in rises for r in one))
        )
        allowed = _ALLOWED * smooth if reach < _REACHES[-1] else -_PLAIN * jumping
        if jumping > smooth + allowed / (count - 5):
            return False
    return True


def _misfit(basis: Array, values: Array) -> float:
    """Sum of the squares that a basis, shape (n, k), leaves of values, shape (n,)."""
    return float(np.sum((values - basis @ np.linalg.lstsq(basis, values)[0]) ** 2))
