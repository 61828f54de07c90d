"""A level that changes at once, in samples of a sensor at rest: no noise, though an Allan curve reads it as one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.recording import Array

_BLOCKS, _SMALLEST = 256, 16
_LIMITS = {4: 5.5, 8: 5.8, 16: 7.0}
"""Blocks on each side of a step to how many times the usual difference it must be: white noise, 1/f noise, random walk
and sums of them reach one of these in 4 of 1000 recordings at most."""
_TO_SIGMA = 1.4826
_WHITE = 5.0


@dataclass(frozen=True)
class Step:
    """A change of level: its size, in the unit of the samples, and the first sample behind it."""

    size: float
    sample: int


def find_step(samples: Array) -> Step | None:
    """Return the plainest step of the level of samples, shape (n,), or None where noise explains what there is.

    The samples become 256 means of equal length. For every place between two of them, the means of 4, 8 and 16 on both
    sides are compared: of noise, whether white, 1/f or a random walk, these differences are alike everywhere, and a
    step makes one that is many times their median. Fewer than 4096 samples are too few to tell.
    """
    length = len(samples) // _BLOCKS
    if length < _SMALLEST:
        return None
    means = samples[: _BLOCKS * length].reshape(_BLOCKS, length).mean(axis=1)
    total = np.concatenate([[0.0], np.cumsum(means - means.mean())])
    white = float(np.diff(samples).std()) / np.sqrt(length)
    best, found = 1.0, None
    for width, limit in _LIMITS.items():
        place = np.arange(width, _BLOCKS - width + 1)
        change = (total[place + width] - 2 * total[place] + total[place - width]) / width
        index = int(np.argmax(np.abs(change)))
        others = np.abs(np.delete(change, np.s_[max(0, index - 2 * width) : index + 2 * width + 1]))
        least = max(limit * _TO_SIGMA * float(np.median(others)), _WHITE * white / np.sqrt(width))
        if least > 0 and abs(change[index]) > best * least:
            best = abs(change[index]) / least
            found = Step(float(change[index]), int(place[index]) * length)
    return found
