"""The terms of a noise model: the variance of their cosine coefficients, of their means, and their Allan variance.

The parameters of a model are an array, shape (..., 8), in the order of `NAMES`; a term that is absent is 0.

Sources: IEEE Std 952 and 647 (the terms), Whittle (1953); exact sums over samples throughout.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.noise.spectrum import Spectrum
from imulab.recording import Array

NAMES = ("white", "flicker", "walk", "quantisation", "gm1_sigma", "gm1_time", "gm2_sigma", "gm2_time")
LINEAR, SIGMA, TIME = 4, (4, 6), (5, 7)
"""How many terms come before the Gauss-Markov ones, and where those have their parameters."""
_LETTERS = {"N": (0,), "B": (1,), "K": (2,), "Q": (3,)}
_FLICKER = 2 * math.log(2) / math.pi
_NODES = 16
_SERIES = 0.5
"""Below this many time constants, differences of exponentials are summed as power series."""


def terms(letters: str) -> NDArray[np.bool_]:
    """Return which parameters a model has, shape (8,): N white, B 1/f, K walk, Q quantisation, G Gauss-Markov.

    Examples
    --------
    >>> [name for name, has in zip(NAMES, terms("NGK")) if has]
    ['white', 'walk', 'gm1_sigma', 'gm1_time']
    """
    present = np.zeros(len(NAMES), dtype=np.bool_)
    for letter in letters.replace("G", ""):
        present[list(_LETTERS[letter])] = True
    present[LINEAR : LINEAR + 2 * letters.count("G")] = True
    return present


def letters(present: NDArray[np.bool_]) -> str:
    """Return the letters of a model from which parameters it has, shape (8,), white noise first.

    Examples
    --------
    >>> letters(terms("KNG"))
    'NGK'
    """
    markov = "G" * int(np.count_nonzero(present[list(SIGMA)]))
    return "".join([*("N" * bool(present[0])), markov, *(each for each in "BKQ" if present[_LETTERS[each][0]])])


def markov_mean(time: Array, duration: Array, interval: float) -> Array:
    """Return the variance of a mean of a Gauss-Markov process of unit variance.

    ``V(m) = [m (1 + p)/(1 - p) - 2 p (1 - p^m)/(1 - p)^2]/m^2``, p = exp(-dt/T), m = duration/dt samples.

    Parameters
    ----------
    time
        Time constants T > 0, s, any shape that broadcasts with `duration`.
    duration
        Length of the mean, s.
    interval
        Time between samples, dt, s.
    """
    a, m = interval / np.asarray(time), np.asarray(duration) / interval
    x = a * m
    small = np.minimum(x, _SERIES)
    tail = np.where(
        x < _SERIES, _power_series(small, [1 / math.factorial(k) for k in range(2, 16)], 2), x + np.expm1(-x)
    )
    return np.asarray((m * _sinh_excess(a) + tail) / (2 * (m * np.sinh(a / 2)) ** 2))


def markov_allan(time: Array, tau: Array, interval: float) -> Array:
    """Return the Allan variance of a Gauss-Markov process of unit variance, ``2 [V(m) - V(2m)]``.

    Shapes and units as for `markov_mean`.
    """
    a, m = interval / np.asarray(time), np.asarray(tau) / interval
    x = a * m
    small = np.minimum(x, _SERIES)
    series = _power_series(small, [(4 - 2.0**k) / math.factorial(k) for k in range(3, 24)], 3)
    direct = 2 * x + np.expm1(-x) * (3 - np.exp(-x))
    return np.asarray((2 * m * _sinh_excess(a) + np.where(x < _SERIES, series, direct)) / (2 * m * np.sinh(a / 2)) ** 2)


def _power_series(x: Array, coefficients: Sequence[float], first: int) -> Array:
    """Sum of ``coefficients[i] (-x)^(first + i)``."""
    total = np.zeros_like(x)
    for each in reversed(coefficients):
        total = each - x * total
    return np.asarray((-x) ** first * total)


def _sinh_excess(a: Array) -> Array:
    """Return sinh(a) - a, by its series for small a."""
    square = np.minimum(a, 1.0) ** 2
    total = np.zeros_like(square)
    for k in range(19, 2, -2):
        total = 1 / math.factorial(k) + square * total
    return np.where(a < 1, a**3 * total, np.sinh(np.minimum(a, 700.0)) - a)


def allan_terms(values: Array, tau: Array, interval: float) -> Array:
    """Return the Allan variance of each term, shape (..., 6, t): N, B, K, Q and two Gauss-Markov terms.

    Parameters
    ----------
    values
        Parameters in the order of `NAMES`, shape (..., 8).
    tau
        Averaging times, whole numbers of samples, s, shape (t,).
    interval
        Time between samples, s.
    """
    tau = np.asarray(tau, dtype=np.float64)
    shapes = [1 / tau, np.full_like(tau, _FLICKER), tau / 3 * (1 + 0.5 * (interval / tau) ** 2), 3 / tau**2]
    linear = values[..., :LINEAR, None] ** 2 * np.stack(shapes)
    return np.concatenate([linear, _markov(values, tau, interval, markov_allan)], axis=-2)


def allan_variance(values: Array, tau: Array, interval: float) -> Array:
    """Return the Allan variance of a model, shape (..., t), the sum of `allan_terms`.

    Examples
    --------
    White noise of 2 u/sqrt(Hz), averaged over 4 s:

    >>> allan_variance(np.array([2.0, 0, 0, 0, 0, 0, 0, 0]), np.array([4.0]), 0.01).tolist()
    [1.0]
    """
    return np.asarray(allan_terms(values, tau, interval).sum(axis=-2))


def mean_terms(values: Array, duration: Array, interval: float) -> Array:
    """Return each term's part of u^2 of a mean over a duration as a measure of the bias, shape (..., 6, t).

    ``u^2 = N^2/t + (2 ln 2/pi) B^2 + K^2 t/3 + 2 Q^2/t^2 + sum V_G(t)``: a Gauss-Markov term counts about the mean of
    its process, 1/f noise and walk, which have none, by their Allan variance. Arguments as for `allan_terms`.
    """
    t = np.asarray(duration, dtype=np.float64)
    linear = values[..., :LINEAR, None] ** 2 * np.stack([1 / t, np.full_like(t, _FLICKER), t / 3, 2 / t**2])
    return np.concatenate([linear, _markov(values, t, interval, markov_mean)], axis=-2)


def _markov(values: Array, tau: Array, interval: float, unit: object) -> Array:
    sigma, time = values[..., SIGMA, None], values[..., TIME, None]
    present = sigma > 0
    return np.asarray(np.where(present, sigma**2 * unit(np.where(present, time, 1.0), tau, interval), 0.0))  # type: ignore[operator]


@dataclass(frozen=True)
class Bins:
    """What the variances of the coefficients in bins, (b,), are computed from, for one or more spectra in a row.

    Attributes
    ----------
    unit
        Variance for unit N, B, K, Q, shape (4, b).
    sine, angular
        ``s^2 = 4 sin^2(pi j/2n)`` and ``w^2 = (pi j/L)^2``, harmonic means over each bin, shape (b,).
    sign
        Mean of ``(-1)^j``, shape (b,).
    interval, length
        dt and L, s, shape (b,), or (1,) where they are the same everywhere.
    power, freedom
        As in `Spectrum`, shapes (..., b).
    """

    unit: Array
    sine: Array
    angular: Array
    sign: Array
    interval: Array
    length: Array
    power: Array
    freedom: Array

    def markov(self, time: Array) -> tuple[Array, Array]:
        """Return the variances for unit S and time constants, shape (r,), and d/d ln T of these, shapes (r, b)."""
        t = time[:, None]
        a, ratio = self.interval / t, t / self.length
        body = 2 * np.sinh(a) / (4 * np.sinh(a / 2) ** 2 + self.sine)
        left, square = np.exp(-1 / ratio), self.angular * t**2
        known = 2 * ratio * (1 - self.sign * left) / (1 + square)
        slope = 2 * (ratio * (1 - self.sign * left) - self.sign * left) / (1 + square) - 2 * known * square / (
            1 + square
        )
        return body * (1 - known), body * (-a * (1 / np.tanh(a) - body) * (1 - known) - slope)

    def variances(self, values: Array) -> Array:
        """Return the variance of the coefficients of models, shape (r, 8), in each bin, shape (r, b)."""
        total = values[:, :LINEAR] ** 2 @ self.unit
        for sigma, time in zip(SIGMA, TIME, strict=True):
            rows = np.flatnonzero(values[:, sigma] > 0)
            total[rows] += values[rows, sigma, None] ** 2 * self.markov(values[rows, time])[0]
        return np.asarray(total)


def prepare(spectra: Sequence[Spectrum]) -> Bins:
    """Return the bins of spectra, one after the other.

    Source: the cosine transform diagonalises the second differences of a walk, so that white noise and walk are exact;
    1/f noise is within 4e-4 of the exact variance, Gauss-Markov noise within 2e-4 (n = 600).
    """
    each = [_of_one(spectrum) for spectrum in spectra]
    alike = len({(spectrum.interval, spectrum.count) for spectrum in spectra}) == 1
    unit, sine, angular, sign, interval, length, power, freedom = (
        np.concatenate(parts, axis=-1) for parts in zip(*each, strict=True)
    )
    if alike:
        interval, length = interval[:1], length[:1]
    return Bins(unit, sine, angular, sign, interval, length, power, freedom)


def _of_one(spectrum: Spectrum) -> list[Array]:
    n, dt = spectrum.count, spectrum.interval
    j, weight, sign = _nodes(spectrum.first, spectrum.last)
    sine, angular = 4 * np.sin(np.pi * j / (2 * n)) ** 2, (np.pi * j / spectrum.length) ** 2

    def mean(values: Array) -> Array:
        return np.asarray(np.einsum("bk,bk->b", values, weight))

    harmonic = 1 / mean(1 / sine)
    flicker = mean(_flicker_end(j, sign[:, None]) / np.sqrt(sine))
    quantisation = mean(sine + 4 / n * (1 - sine / 4)) / dt**2
    unit = np.stack([np.full(len(sign), 1 / dt), flicker, dt / harmonic, quantisation])
    whole = np.ones(len(sign))
    return [
        unit,
        harmonic,
        1 / mean(1 / angular),
        sign,
        dt * whole,
        spectrum.length * whole,
        spectrum.power,
        spectrum.freedom,
    ]


def _nodes(first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Frequencies j at which each bin is evaluated, their weights, shapes (b, 16), and the mean of (-1)^j, (b,)."""
    width = (last - first + 1).astype(np.float64)
    steps = np.arange(_NODES, dtype=np.float64)
    points, weights = np.polynomial.legendre.leggauss(4)
    padding = np.zeros(_NODES - len(points))
    wide = (width > _NODES)[:, None]
    middle = (first + last)[:, None] / 2
    j = np.where(
        wide,
        middle + width[:, None] / 2 * np.concatenate([points, padding]),
        first[:, None] + np.minimum(steps, width[:, None] - 1),
    )
    weight = np.where(wide, np.concatenate([weights / 2, padding]), (steps < width[:, None]) / width[:, None])
    return j, weight, np.where(width % 2 == 1, (-1.0) ** (first % 2), 0.0) / width


def _flicker_end(j: Array, sign: Array) -> Array:
    """Return ``(2/pi) [Si(pi j) - (1 - cos pi j)/(pi j)]``, what the ends of the stretch leave of 1/f noise."""
    from imulab.estimation.special import sici

    x = np.pi * j
    near = np.minimum(x, 25 * np.pi)
    exact = sici(near)[0] - (1 - np.cos(near)) / near
    return np.asarray(np.where(x <= 24.5 * np.pi, 2 / np.pi * exact, 1 - 2 / (np.pi * x) + 4 / np.pi * sign / x**3))
