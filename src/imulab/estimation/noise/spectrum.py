"""The spectrum that noise models are fitted to: mean squares of cosine coefficients in bins of frequency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.ranked import distinct
from imulab.recording import Array

_ALONE, _PER_DECADE = 24, 60


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
        were left out, 0 for a bin that is left out, no whole number after an allowance for ripple.
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
