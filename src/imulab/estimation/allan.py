"""Allan deviation.

Source: NIST SP 1065 (equations 11 and table 5) for the overlapping estimator and its equivalent degrees of freedom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError, OptionError
from imulab.estimation import TAUS
from imulab.estimation.ranked import distinct
from imulab.recording import Array

_CHUNK = 1 << 14
_DENSE_PER_DECADE = 24
_FEWEST = 3


@dataclass(frozen=True, repr=False)
class AllanCurve:
    """Overlapping Allan deviation over averaging time.

    Attributes
    ----------
    tau
        Averaging times, s, shape (t,).
    deviation, standard_uncertainty
        Allan deviation and its standard uncertainty, in the unit of the samples, shape (t,).
    freedom
        Equivalent degrees of freedom, shape (t,).
    """

    tau: Array
    deviation: Array
    standard_uncertainty: Array
    freedom: Array

    def __repr__(self) -> str:
        least = int(np.argmin(self.deviation))
        return (
            f"AllanCurve({len(self.tau)} averaging times from {self.tau[0]:.4g} to {self.tau[-1]:.4g} s, "
            f"least deviation {self.deviation[least]:.3g} at {self.tau[least]:.4g} s)"
        )


def allan_deviation(samples: Array, rate: float, taus: str | Array = "octave") -> AllanCurve:
    """Compute the overlapping Allan deviation of evenly spaced samples.

    ``sigma^2(m / rate) = sum_k (x_{k+2m} - 2 x_{k+m} + x_k)^2 / (2 (m / rate)^2 (N - 2m))``, x the integral of the
    samples less their mean, N its length.

    Parameters
    ----------
    samples
        Rate or specific force, shape (n,), n >= 3.
    rate
        Sampling rate, Hz.
    taus
        ``octave`` (m = 1, 2, 4 ...), ``dense`` (24 a decade), or averaging times in s, shape (t,), which are rounded to
        whole numbers of samples.

    Raises
    ------
    DataError
        Fewer than 3 samples, or samples that are not finite.
    OptionError
        `taus` or `rate` cannot be used.
    """
    data = np.asarray(samples, dtype=np.float64)
    if data.ndim != 1 or len(data) < _FEWEST:
        raise DataError(f"Allan deviation: expected at least {_FEWEST} samples of one quantity, found {data.shape}")
    if not rate > 0 or not math.isfinite(rate):
        raise OptionError(f"sampling rate {rate:g}: expected a positive number of Hz")
    integral = np.empty(len(data) + 1)
    integral[0] = 0.0
    centred = data - data[0]  # a constant becomes exactly 0
    mean = centred.mean()
    if not math.isfinite(mean):
        raise DataError("Allan deviation: expected finite samples")
    np.cumsum(np.subtract(centred, mean, out=centred), out=integral[1:])
    integral *= 1 / rate
    counts = _averages(len(integral), rate, taus)
    squares = np.array([_square(integral, m) for m in counts.tolist()])
    variance = squares / (2.0 * (len(integral) - 2 * counts)) / counts.astype(np.float64) ** 2 * rate**2
    freedom = _freedom(len(integral), counts, variance)
    deviation = np.sqrt(variance)
    return AllanCurve(counts / rate, deviation, deviation / np.sqrt(2 * freedom), freedom)


def _averages(length: int, rate: float, taus: str | Array) -> np.ndarray:
    """Numbers of samples to average, each with two terms or more in its sum."""
    most = (length - 2) // 2
    if isinstance(taus, str):
        if taus == "octave":
            counts = 2 ** np.arange(0, int(math.log2(most)) + 1)
        elif taus == "dense":
            steps = int(_DENSE_PER_DECADE * math.log10(most)) + 1
            counts = distinct(np.round(10 ** (np.arange(steps) / _DENSE_PER_DECADE))).astype(np.int64)
        else:
            raise OptionError(f"taus {taus!r}: expected {' or '.join(TAUS)}")
    else:
        times = np.asarray(taus, dtype=np.float64)
        if not np.isfinite(times).all():
            raise OptionError("taus: expected finite averaging times")
        counts = distinct(np.round(times * rate).astype(np.int64))
    counts = counts[(counts >= 1) & (counts <= most)]
    if not counts.size:
        raise OptionError(f"taus: expected averaging times from {1 / rate:g} s to {most / rate:g} s")
    return counts


def _square(integral: Array, m: int) -> float:
    """Sum of squared second differences at lag m, in pieces that stay in the cache."""
    count = len(integral) - 2 * m
    buffer = np.empty(min(_CHUNK, count))
    total = []
    for start in range(0, count, _CHUNK):
        stop = min(start + _CHUNK, count)
        piece = buffer[: stop - start]
        np.multiply(integral[start + m : stop + m], -2.0, out=piece)
        piece += integral[start + 2 * m : stop + 2 * m]
        piece += integral[start:stop]
        total.append(float(np.einsum("i,i", piece, piece)))  # not BLAS, whose threads cost more than they save here
    return math.fsum(total)


def _freedom(length: int, counts: np.ndarray, variance: Array) -> Array:
    """Equivalent degrees of freedom of the overlapping estimator, by the slope of the curve at each point."""
    n, m = float(length), counts.astype(np.float64)
    white = (3 * (n - 1) / (2 * m) - 2 * (n - 2) / n) * 4 * m**2 / (4 * m**2 + 5)
    flicker = np.where(m == 1, 2 * (n - 2) ** 2 / (2.3 * n - 4.9), 5 * n**2 / (4 * m * (n + 3 * m)))
    walk = (n - 2) / m * ((n - 1) ** 2 - 3 * m * (n - 1) + 4 * m**2) / max(n - 3, 1) ** 2
    safe = np.log(np.maximum(variance, 1e-300))
    slope = np.gradient(safe, np.log(m)) if len(m) > 1 else np.array([-1.0])
    chosen: Array = np.where(slope < -0.5, white, np.where(slope < 0.5, flicker, walk))
    return np.maximum(chosen, 1.0)
