"""The terms of a noise model: variances of cosine coefficients and means, Allan variance, and what a filter needs.

The parameters of a model are an array, shape (..., 8), in the order of `NAMES`; a term that is absent is 0. A filter
needs white noise and walk, and the uncertainty of a bias from a mean at rest.

Sources: IEEE Std 952 and 647 (the terms), Whittle (1953); sums over samples are exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.distributions import sine_integral
from imulab.estimation.noise.spectrum import Spectrum
from imulab.recording import Array

# Variances of cosine coefficients and of means, and Allan variance.


NAMES = ("white", "flicker", "walk", "quantisation", "gm1_sigma", "gm1_time", "gm2_sigma", "gm2_time")
LINEAR, SIGMA, TIME = 4, (4, 6), (5, 7)
"""Number of terms before the Gauss-Markov ones; places of these terms' parameters."""
_LETTERS = {"N": (0,), "B": (1,), "K": (2,), "Q": (3,)}
_FLICKER = 2 * math.log(2) / math.pi
_NODES = 16  # up to so many frequencies a bin is summed over each; a larger one by Gauss's rule
_SERIES = 0.5
"""Duration in time constants below which differences of exponentials are computed as power series."""


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


def is_model(letters: str) -> bool:
    """Return whether a text is the letters of a model: each known, each once, G up to twice."""
    return all(letter in "NBKQG" and letters.count(letter) <= (2 if letter == "G" else 1) for letter in letters)


def letters(present: NDArray[np.bool_]) -> str:
    """Return the letters of a model, white noise first, from which parameters it has, shape (8,).

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
    """Return the sum of ``coefficients[i] (-x)^(first + i)``."""
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
    """Return the parts of u^2 by each term, u the uncertainty of a mean as a measure of the bias, shape (..., 6, t).

    ``u^2 = N^2/t + (2 ln 2/pi) B^2 + K^2 t/3 + 2 Q^2/t^2 + sum V_G(t)``. A Gauss-Markov term counts by its variance
    about its long-term mean; 1/f noise and walk, which have no such mean, by their Allan variance. Arguments as for
    `allan_terms`.
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
    """Precomputed arrays that give the variances of coefficients in bins, (b,), of one or more spectra in a row.

    Attributes
    ----------
    unit
        Variances for unit N, B, K, Q, shape (4, b).
    sine, angular
        ``s^2 = 4 sin^2(pi j/2n)`` and ``w^2 = (pi j/L)^2``, harmonic means over each bin, shape (b,).
    sign
        Mean of ``(-1)^j`` over each bin, shape (b,).
    interval, length
        dt and L, s, shape (b,), or (1,) where all bins have the same.
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
        """Return the variances for unit S and time constants, shape (r,), and their d/d ln T, shapes (r, b)."""
        t = time[:, None]
        a, ratio = self.interval / t, t / self.length
        body = 2 * np.sinh(a) / (4 * np.sinh(a / 2) ** 2 + self.sine)
        square = self.angular * t**2
        end, over = self.sign * np.exp(-1 / ratio), 1 + square
        share = ratio * (1 - end)
        known = 2 * share / over
        rest = 1 - known
        slope = 2 * (share - end) / over - 2 * known * square / over
        return body * rest, body * (-a * (1 / np.tanh(a) - body) * rest - slope)

    def variances(self, values: Array) -> Array:
        """Return the variance of the coefficients of models, shape (r, 8), in each bin, shape (r, b)."""
        total = values[:, :LINEAR] ** 2 @ self.unit
        for sigma, time in zip(SIGMA, TIME, strict=True):
            rows = np.flatnonzero(values[:, sigma] > 0)
            total[rows] += values[rows, sigma, None] ** 2 * self.markov(values[rows, time])[0]
        return np.asarray(total)


def prepare(spectra: Sequence[Spectrum]) -> Bins:
    """Return the bins of spectra, one spectrum after the other.

    Source: the cosine transform diagonalises the second differences of a walk, so that white noise and walk are exact;
    1/f noise is within 4e-4 of the exact variance, Gauss-Markov noise within 2e-4 (n = 600).
    """
    each = [_bins_of_spectrum(spectrum) for spectrum in spectra]
    alike = len({(spectrum.interval, spectrum.count) for spectrum in spectra}) == 1
    unit, sine, angular, sign, interval, length, power, freedom = (
        np.concatenate(parts, axis=-1) for parts in zip(*each, strict=True)
    )
    if alike:
        interval, length = interval[:1], length[:1]
    return Bins(unit, sine, angular, sign, interval, length, power, freedom)


def _bins_of_spectrum(spectrum: Spectrum) -> list[Array]:
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
    """Return the frequencies j at which bins are evaluated, their weights, shapes (b, 16), and the means of (-1)^j."""
    width = (last - first + 1).astype(np.float64)
    steps = np.arange(_NODES, dtype=np.float64)
    # Gauss-Legendre of four points; NumPy's own load its package for polynomials.
    points = np.array([-0.8611363115940526, -0.33998104358485626, 0.33998104358485626, 0.8611363115940526])
    weights = np.array([0.34785484513745357, 0.6521451548625464, 0.6521451548625464, 0.34785484513745357])
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
    """Return what the ends of the stretch leave of 1/f noise: ``(2/pi) [Si(pi j) - (1 - cos pi j)/(pi j)]``."""
    x = np.pi * j
    near = np.minimum(x, 25 * np.pi)
    exact = sine_integral(near) - (1 - np.cos(near)) / near
    return np.asarray(np.where(x <= 24.5 * np.pi, 2 / np.pi * exact, 1 - 2 / (np.pi * x) + 4 / np.pi * sign / x**3))


# What a filter needs: white noise and walk over its horizon, and the uncertainty of a bias from a mean.


_AT_BOUND = 1.5
"""A Gauss-Markov term within this factor of the shortest time constant is the edge of the band, not slow noise."""
_WHITE_TO_FILTER = 3.0
"""A Gauss-Markov term is white noise over horizons of at least so many time constants."""
_NO_TIME = 1e-30  # s: stands for no time constant where a ratio of times is taken
_OF_FLICKER = 0.1
"""Share of B^2 h that is white noise to a filter.

Both numbers minimise the errors of filters run on simulated noise (1/f with a corner of 3 and 30 s, Gauss-Markov of 20
times the white density, h = 10 to 300 s); the predicted errors are then right to 15 %. With all of it in the walk, the
errors are up to twice as large, and 1.4 to 2 times the prediction.
"""


def walk_square(values: Array, horizon: Array, interval: float, shortest: float = 0.0) -> Array:
    """Return the square of the random walk that predicts the mean over a horizon best, (u/sqrt(s))^2.

    ``K_h^2 = 3 sigma^2_slow(h)/h``, with sigma^2_slow the Allan variance of 1/f noise, walk and Gauss-Markov terms of
    more than h/3; terms at the shortest time constant are the edge of the band and left out.

    Parameters
    ----------
    values
        Parameters, shape (..., 8).
    horizon
        h, s, shape (t,).
    interval
        Time between samples, s.
    shortest
        Least time constant that the fit allowed, s.
    """
    parts = allan_terms(values, horizon, interval)
    slow = parts[..., 1, :] + parts[..., 2, :]
    for k in range(2):
        slow = slow + np.where(_is_fast(values, k, horizon, shortest), 0.0, parts[..., 4 + k, :])
    return np.asarray(3 * slow / horizon)


def white_square(values: Array, horizon: Array, shortest: float = 0.0) -> Array:
    """Return the square of the white noise that belongs to that walk, (u/sqrt(Hz))^2, shape (..., t).

    ``N_h^2 = N^2 + 0.1 B^2 h + sum 2 S^2 T [1 - (T/h) (1 - e^(-h/T))]`` over the Gauss-Markov terms that `walk_square`
    leaves out: their mean over h. Terms at the edge of the band count in full. Parameters as there.
    """
    total = values[..., :1] ** 2 + _OF_FLICKER * values[..., 1:2] ** 2 * horizon
    edge = at_band_edge(values, shortest)
    for k, (sigma, time) in enumerate(zip(SIGMA, TIME, strict=True)):
        density = 2 * values[..., sigma, None] ** 2 * values[..., time, None]
        many = np.maximum(horizon, _NO_TIME) / np.maximum(values[..., time, None], _NO_TIME)
        share = np.where(edge[..., k, None], 1.0, 1 + np.expm1(-many) / many)
        total = total + np.where(_is_fast(values, k, horizon, shortest), share * density, 0.0)
    return np.asarray(total)


def bias_square(values: Array, duration: Array, interval: float) -> Array:
    """Return u^2 of the mean over a duration at rest as a measure of the bias, shape (..., t): see `mean_terms`."""
    return np.asarray(mean_terms(values, duration, interval).sum(axis=-2))


def at_band_edge(values: Array, shortest: float) -> NDArray[np.bool_]:
    """Return whether Gauss-Markov terms, shape (..., 2), lie at the shortest time constant that the fit allowed, s.

    Such a term is the roll-off of the sensor's filter at the end of the band, not slow noise.
    """
    return np.asarray((values[..., SIGMA] > 0) & (values[..., TIME] <= _AT_BOUND * shortest))


def letters_inside(model: NDArray[np.bool_], values: Array, shortest: float) -> str:
    """Return the letters of a model without Gauss-Markov terms at the edge of the band; arguments of shape (8,)."""
    return letters(model).replace("G", "", int(np.count_nonzero(at_band_edge(values, shortest))))


def edge_as_white(values: Array, covariance: Array, shortest: float) -> tuple[Array, Array]:
    """Return a model and its covariance with Gauss-Markov terms at the edge of the band as white noise.

    ``N^2 + sum 2 S^2 T`` in place of N^2; a term that remains is the first.

    Parameters
    ----------
    values, covariance
        Parameters, shape (8,), and the covariance of their logarithms, shape (8, 8).
    shortest
        Least time constant that the fit allowed, s.
    """
    edge = np.flatnonzero(at_band_edge(values, shortest))
    if not edge.size:
        return values, covariance
    terms, turn = values.copy(), np.eye(len(values))
    parts = np.zeros(len(values))
    parts[0] = values[0] ** 2
    for k in edge.tolist():
        parts[[SIGMA[k], TIME[k]]] = 2 * values[SIGMA[k]] ** 2 * values[TIME[k]]
        terms[[SIGMA[k], TIME[k]]] = 0.0
    terms[0] = np.sqrt(white_square(values, np.zeros(1), shortest)[0])
    # d ln N: a term's variance depends on S as on N, on T half as much.
    parts[list(TIME)] /= 2
    turn[0] = parts / terms[0] ** 2
    turn[terms == 0] = 0.0
    if terms[SIGMA[0]] == 0:
        order = np.arange(len(values))
        order[[*SIGMA, *TIME]] = [*SIGMA[::-1], *TIME[::-1]]
        terms, turn = terms[order], turn[order]
    return terms, np.asarray(turn @ covariance @ turn.T)


def _is_fast(values: Array, k: int, horizon: Array, shortest: float) -> NDArray[np.bool_]:
    edge = at_band_edge(values, shortest)[..., k, None]
    return np.asarray(edge | (values[..., TIME[k], None] <= horizon / _WHITE_TO_FILTER))
