"""Medians, quantiles, distinct values, root mean squares.

NumPy's own load its package for masked arrays, which takes 0.03 s of processor time, a tenth of a short command.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imulab.recording import Array

NORMAL_95 = 1.96
"""Standard deviations of a normal distribution from its mean to the ends of its 95 %."""
MAD_TO_SIGMA = 1.4826
"""Median absolute deviation to the standard deviation of a normal distribution, as the literature rounds it."""


def median(values: NDArray[Any]) -> float:
    """Return the median of values of any shape, NaN if there is one among them.

    Examples
    --------
    >>> median(np.array([4, 1, 2, 3]))
    2.5
    """
    return float(medians(values.ravel()))


def medians(values: NDArray[Any], axis: int = -1) -> Array:
    """Return the medians of values along an axis, NaN where there is one among them.

    Examples
    --------
    >>> medians(np.array([[4.0, 1.0, 2.0], [7.0, 9.0, 8.0]])).tolist()
    [2.0, 8.0]
    """
    count = values.shape[axis]
    pair = [(count - 1) // 2, count // 2]
    low, high = np.moveaxis(np.partition(values, pair, axis), axis, 0)[pair]
    return np.where(np.isnan(values.max(axis)), np.nan, (low + high) / 2)


def quantile(values: NDArray[Any], share: float) -> float:
    """Return the value below which this share of values, finite, of any shape, lies, on lines between neighbours.

    Examples
    --------
    >>> quantile(np.array([4.0, 1.0, 2.0]), 0.75)
    3.0
    """
    place = share * (values.size - 1)
    below = int(place)
    pair = [below, min(below + 1, values.size - 1)]
    low, high = np.partition(values, pair, axis=None)[pair]
    return float(low + (place - below) * (high - low))


def distinct(values: NDArray[Any]) -> NDArray[Any]:
    """Return the different values among values of any shape, sorted.

    Examples
    --------
    >>> distinct(np.array([3, 1, 3])).tolist()
    [1, 3]
    """
    ordered = np.sort(values, axis=None)
    return np.asarray(ordered[np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)]])


def rms(values: ArrayLike) -> float:
    """Return the root mean square of values.

    Examples
    --------
    >>> rms([3.0, -4.0])
    3.5355339059327378
    """
    return float(np.sqrt(np.mean(np.square(values))))
