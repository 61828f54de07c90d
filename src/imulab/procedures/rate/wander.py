"""How far the mean of a zero over a recording is from that over the next: white noise, and what wanders (1/f).

The means y of 64 parts of a recording, freed of a line over time, have the covariance ``a I + c F``, F that of noise
whose density falls as one over the frequency, of Allan variance 1 at any time; a and c are those of the largest
restricted likelihood. The mean of all has the variance a / 64, and c, the Allan variance to which no longer recording
brings it. What lies below the lowest frequency of a recording has no part in that: no recording shows it. Source:
Patterson and Thompson, Biometrika 58 (1971) 545; Barnes et al., IEEE Trans. Instrum. Meas. IM-20 (1971) 105.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from imulab.recording import Array

PARTS = 64
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 121)])


def variance_of_mean(means: Array) -> float:
    """Return half the mean square by which the mean over such a recording differs from that over the next.

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
    """Return contrasts of the parts that neither noise correlates, and their variances over a, by the ratio c / a.

    Shapes (62, 64) and (122, 62).
    """
    lag = np.abs(np.arange(-1.0, PARTS + 1))
    curve = lag**2 * np.log(np.maximum(lag, 1.0))
    flicker = -np.diff(curve, 2) / (4 * np.log(2))
    number = np.arange(PARTS)
    line = np.column_stack([np.ones(PARTS), number - number.mean()])
    free = np.linalg.svd(line)[0][:, 2:]
    spread, turn = np.linalg.eigh(free.T @ flicker[np.abs(number[:, None] - number)] @ free)
    return (free @ turn).T, 1 + _RATIOS[:, None] * spread
