"""Noise coefficients read from an Allan curve, where their model fits it.

Sources: IEEE Std 952 (annex C) and IEEE Std 647 for the coefficients; the variance of a mean of correlated samples for
the term of short correlation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from imulab.errors import DataError
from imulab.estimation.allan import AllanCurve
from imulab.recording import Array

COEFFICIENTS = ("angle_random_walk", "bias_instability", "rate_random_walk", "quantisation")
_FLICKER = 2 * math.log(2) / math.pi
_OCTAVE_CORRELATION = 0.5
"""Of estimates an octave apart, measured on white noise and random walk (.45 to .6); falls as its power."""
_LEAST_FREEDOM = 4.0  # about a fifth of the recording
_FEWEST = 4
_FEWEST_TO_TEST = 6
_FITS, _PLAINLY_NOT = 0.05, 1e-3
"""Probabilities of chi-square: the model passes; it plainly does not."""
_ALLOWANCES = (0.0, 0.02, 0.05)
"""What the variance may be off the model beyond its scatter: real noise is not exactly of these kinds."""
_SHOWS = 3.0  # standard deviations
_PLAIN = 0.2
"""Relative uncertainty of N^2 up to which a part of the curve tells white noise."""
_FREE = np.array([[*choice, True] for choice in product((False, True), repeat=3)])
"""Which parameters are not held at zero: every choice of the three that cannot be negative."""
_COARSE = 2.2  # of the deviation from sample to sample; whole counts of an angle show steps of 2.0 of it at most


@dataclass(frozen=True)
class Coefficient:
    """A noise coefficient and its standard uncertainty; both nan where `reason` says why it is not determined.

    Unit of the samples times s (quantisation), s^1/2, 1 or s^-1/2.
    """

    value: float
    standard_uncertainty: float
    reason: str = ""


@dataclass(frozen=True)
class NoiseCoefficients:
    """N, B, K, Q of ``sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + 3 Q^2 / tau^2``.

    Attributes
    ----------
    angle_random_walk, bias_instability, rate_random_walk, quantisation
        The coefficients.
    covariance
        Of N^2, B^2, K^2 as the curve gives them, shape (3, 3).
    shortest, longest
        Averaging times that the model was fitted to, s.
    left_out
        Whether shorter averaging times of the curve were left out because the model plainly does not fit there.
    correlation_time
        Over which a low-pass filter correlates the white noise, s; 0 where none shows.
    ceiling
        Largest Allan variance that the far end of the curve allows, in the squared unit of the samples.
    """

    angle_random_walk: Coefficient
    bias_instability: Coefficient
    rate_random_walk: Coefficient
    quantisation: Coefficient
    covariance: Array
    shortest: float = 0.0
    longest: float = 0.0
    left_out: bool = False
    correlation_time: float = 0.0
    ceiling: float = 0.0

    @property
    def filtered(self) -> bool:
        """Whether the noise is plainly correlated from sample to sample."""
        return self.left_out or self.correlation_time > 0

    def variance(self, tau: Array) -> Array:
        """Return the Allan variance that N, B and K predict, shape of `tau`; nan where one is not determined."""
        values = [getattr(self, name).value ** 2 for name in COEFFICIENTS[:3]]
        variance: Array = _terms(tau)[:, :3] @ np.array(values)
        return variance

    def mean_uncertainty(self, duration: float) -> float:
        """Return the standard uncertainty of the mean over a duration, s, as an estimate of the bias.

        ``u^2 = E[x | x >= N^2 / T]``, x normal about the Allan variance that the coefficients predict at T, with the
        variance that their covariance gives it: what the curve, which ends at T / 5, leaves open counts as well. A
        recording that is shorter than the noise is correlated cannot show it. Where the model does not fit, the largest
        variance that the far end of the curve allows.
        """
        predicted = float(self.variance(np.array([duration]))[0])
        if math.isnan(predicted):
            return math.sqrt(self.ceiling)
        terms = _terms(np.array([duration]))[0, :3]
        spread = math.sqrt(max(float(terms @ self.covariance @ terms), 0.0))
        if spread == 0.0:
            return math.sqrt(predicted)
        cut = (float(terms[0]) * self.angle_random_walk.value**2 - predicted) / spread
        density, above = math.exp(-(cut**2) / 2) / math.sqrt(2 * math.pi), math.erfc(cut / math.sqrt(2)) / 2
        return math.sqrt(predicted + spread * density / above)


@dataclass(frozen=True)
class _Fit:
    """A fit of (N^2, B^2, K^2, c) over the averaging times from number `low` up to `high`, not included.

    `probability` is that of its chi-square, `from_first` that of the fit from the first averaging time on.
    """

    values: Array
    covariance: Array
    probability: float
    low: int
    high: int
    from_first: float = 1.0


def read_coefficients(curve: AllanCurve, resolution: float = 0.0) -> NoiseCoefficients:
    """Read noise coefficients from an Allan curve, with uncertainties, where their model fits it.

    Generalised least squares of ``sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + c / tau^2`` over
    averaging times about an octave apart, up to about a fifth of the recording; an estimate's relative variance is 2 /
    freedom, neighbours are correlated. N^2, B^2 and K^2 are not negative. c takes up what is correlated over few
    samples, exactly so beyond the length of the correlation: negative behind a low-pass filter, ``3 Q^2`` for an angle
    that is quantised. The shortest averaging times are left out until chi-square lets the model pass, and one octave
    more. Where the model passes nowhere, a curve whose short part shows white noise gives N alone, and any other curve
    nothing. A coefficient that the curve does not show is 0 with the size that it may have as its uncertainty.

    Parameters
    ----------
    curve
        Allan deviation over averaging time.
    resolution
        Step of the samples, in their unit; noise below 0.45 of it is not determined.

    Raises
    ------
    DataError
        The curve has fewer than four usable averaging times.
    """
    tau, deviation, freedom = curve.tau, curve.deviation, curve.freedom
    if not (deviation > 0).any():
        zero = Coefficient(0.0, 0.0)
        return NoiseCoefficients(zero, zero, zero, zero, np.zeros((3, 3)))
    keep = _octaves(tau, (freedom >= _LEAST_FREEDOM) & (deviation > 0))
    if len(keep) < _FEWEST:
        raise DataError("noise coefficients: the recording is too short; expected some 50 samples or more")
    tau, variance, relative = tau[keep], deviation[keep] ** 2, np.sqrt(2 / freedom[keep])
    ceiling = float(np.max((variance * (1 + 2 * relative))[-3:]))
    if resolution > _COARSE * deviation[0]:
        reason = f"the samples take steps that are {resolution / deviation[0]:.1f} times as large as their noise"
        return undetermined(reason, ceiling)
    if len(tau) < _FEWEST_TO_TEST:
        return _coefficients(_fitted(tau, variance, relative, 0, len(tau), 0.0), tau, ceiling)
    whole = _longest_fit(tau, variance, relative, len(tau))
    if whole is not None:
        return _coefficients(whole, tau, ceiling)
    for high in range(len(tau) - 1, _FEWEST_TO_TEST - 1, -1):
        part = _longest_fit(tau, variance, relative, high)
        if part is not None and _shows_white(part, tau):
            return _coefficients(part, tau, ceiling)
    reason = f"the curve from {tau[0]:.3g} to {tau[-1]:.3g} s is not that of white noise, 1/f noise and random walk"
    return undetermined(reason, ceiling)


def resolution(samples: Array) -> float:
    """Return the smallest step between different values of samples, shape (n,), or 0 where all are the same.

    The first 20,000 samples tell it.
    """
    values = np.unique(samples[:20_000])
    return float(np.diff(values).min()) if len(values) > 1 else 0.0


def undetermined(reason: str, ceiling: float = 0.0) -> NoiseCoefficients:
    """Return coefficients none of which is determined, for this reason."""
    none = Coefficient(math.nan, math.nan, reason)
    return NoiseCoefficients(none, none, none, none, np.full((3, 3), np.nan), ceiling=ceiling)


def coefficients_dict(found: NoiseCoefficients, unit: str) -> dict[str, Any]:
    """Return the coefficients as plain JSON values with their units: null, and why, where one is not determined."""
    units = (f"{unit}/sqrt(Hz)", unit, f"{unit}/sqrt(s)", {"rad/s": "rad", "m/s^2": "m/s"}.get(unit, f"{unit} s"))
    listed: dict[str, Any] = {}
    for name, its in zip(COEFFICIENTS, units, strict=True):
        one: Coefficient = getattr(found, name)
        known = not one.reason
        listed[name] = {
            "value": one.value if known else None,
            "standard_uncertainty": one.standard_uncertainty if known else None,
            "unit": its,
            **({} if known else {"reason": one.reason}),
        }
    return listed


def _octaves(tau: Array, usable: np.ndarray) -> np.ndarray:
    """Numbers of usable averaging times that are an octave apart or a little more."""
    kept: list[int] = []
    for index in np.flatnonzero(usable).tolist():
        if not kept or tau[index] > 1.99 * tau[kept[-1]]:
            kept.append(index)
    return np.array(kept, dtype=np.int64)


def _terms(tau: Array) -> Array:
    """Derivative of the Allan variance by N^2, B^2, K^2 and c, shape (t, 4)."""
    return np.column_stack([1 / tau, np.full(len(tau), _FLICKER), tau / 3, tau**-2.0])


def _fitted(tau: Array, variance: Array, relative: Array, low: int, high: int, allowance: float) -> _Fit:
    from imulab.estimation.special import chdtrc

    part = slice(low, high)
    tau, variance = tau[part], variance[part]
    relative = np.hypot(relative[part], allowance)
    short = len(tau) < _FEWEST_TO_TEST  # too few to tell a fourth term
    terms = _terms(tau)[:, : 3 if short else 4]
    correlation = _OCTAVE_CORRELATION ** np.abs(np.subtract.outer(np.log2(tau), np.log2(tau)))
    root = np.linalg.cholesky(correlation + 1e-12 * np.eye(len(tau)))
    predicted = variance
    for _ in range(12):
        sigma = (relative * predicted)[:, None]
        whitened = np.linalg.solve(root, np.column_stack([terms, variance]) / sigma)
        scale = np.linalg.norm(whitened[:, :-1], axis=0)
        scaled = whitened[:, :-1] / scale
        found, misfit = not_negative(scaled, whitened[:, -1])
        values = found / scale
        last, predicted = predicted, np.maximum(terms @ values, 1e-3 * variance)
        if np.allclose(last, predicted, rtol=1e-6, atol=0):
            break
    covariance = np.linalg.inv(scaled.T @ scaled) / np.outer(scale, scale)
    if short:
        values = np.append(values, 0.0)
        covariance = np.pad(covariance, (0, 1))
    left = len(tau) - np.count_nonzero(values[:3]) - (0 if short else 1)
    return _Fit(values, covariance, float(chdtrc(max(left, 1), misfit**2)), low, high)


def not_negative(columns: Array, target: Array) -> tuple[Array, float]:
    """Return least squares in which the first three parameters are not negative, and the length of what is left.

    The best of the eight choices of those that are zero. scipy's nnls, of which this is a small case, takes 0.3 s of
    processor time to load.
    """
    size = columns.shape[1]
    free = _FREE[:, :size]
    gram, seen = columns.T @ columns, columns.T @ target
    systems = np.where(free[:, :, None] & free[:, None, :], gram, np.eye(size))
    found = np.linalg.solve(systems, np.where(free, seen, 0.0)[:, :, None])[:, :, 0]
    explained = np.where((found[:, :3] >= 0).all(axis=1), found @ seen, -np.inf)
    best = found[explained.argmax()]
    return best, float(np.linalg.norm(target - columns @ best))


def _longest_fit(tau: Array, variance: Array, relative: Array, high: int) -> _Fit | None:
    """The fit up to averaging time number `high` that tells N best, or None where the model passes nowhere."""
    best: _Fit | None = None
    from_first = 1.0
    for allowance in _ALLOWANCES:
        for low in range(high - _FEWEST_TO_TEST + 1):
            found = _fitted(tau, variance, relative, low, high, allowance)
            if low == 0 and allowance == 0:
                from_first = found.probability
            if found.probability < _FITS:
                continue
            if 0 < low <= high - _FEWEST_TO_TEST - 1:  # what just passes is still off by a standard deviation or two
                found = _fitted(tau, variance, relative, low + 1, high, allowance)
            if best is None or found.covariance[0, 0] < best.covariance[0, 0]:
                best = replace(found, from_first=from_first)
            break
        if best is not None and best.low == 0:
            break
    return best


def _shows_white(fit: _Fit, tau: Array) -> bool:
    """Whether white noise makes up most of the variance in half of the averaging times that were fitted."""
    white, spread = fit.values[0], math.sqrt(fit.covariance[0, 0])
    part = tau[fit.low : fit.high]
    mostly = white / part > 0.5 * (_terms(part) @ fit.values)
    return bool(spread < _PLAIN * white and np.mean(mostly) >= 0.5)


def _coefficients(fit: _Fit, tau: Array, ceiling: float) -> NoiseCoefficients:
    spreads = np.sqrt(np.diag(fit.covariance))
    shortest, longest = float(tau[fit.low]), float(tau[fit.high - 1])
    white, flicker, walk = (_root(v, s) for v, s in zip(fit.values[:3], spreads[:3], strict=True))
    if fit.high < len(tau):
        reason = f"beyond {longest:.3g} s the curve is not that of white noise, 1/f noise and random walk"
        flicker = walk = Coefficient(math.nan, math.nan, reason)
    short, uncertain = float(fit.values[3]), float(spreads[3])
    if fit.low:
        quantisation = Coefficient(math.nan, math.nan, f"averaging times below {shortest:.3g} s do not fit the model")
    else:
        quantisation = _root(max(short, 0.0) / 3, uncertain / 3)
    filtered = short < -_SHOWS * uncertain and fit.values[0] > 0
    return NoiseCoefficients(
        white,
        flicker,
        walk,
        quantisation,
        fit.covariance[:3, :3],
        shortest,
        longest,
        fit.low > 0 and fit.from_first < _PLAINLY_NOT,
        -short / (1.5 * float(fit.values[0])) if filtered else 0.0,
        ceiling,
    )


def _root(square: float, spread: float) -> Coefficient:
    """A coefficient from its square."""
    size = math.sqrt(square)
    return Coefficient(size, float(min(spread / (2 * size) if size else math.inf, math.sqrt(spread))))
