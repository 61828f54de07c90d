"""The Allan deviation, and the noise coefficients N, B, K, Q of the model that is fitted to a column's spectrum.

Sources: NIST SP 1065 (equation 11 and table 5) for the overlapping estimator and its equivalent degrees of freedom;
IEEE Std 952 (annex C) and IEEE Std 647 for the coefficients.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imulab.errors import DataError, OptionError, meant
from imulab.estimation import TAUS
from imulab.estimation._allan import fill_squares, integrate
from imulab.estimation.decisions import NOISE_MODEL_REJECTED
from imulab.estimation.distributions import probability_text
from imulab.estimation.noise.analysis import Analysis, average, intervals_of
from imulab.estimation.noise.spectrum import frequencies
from imulab.estimation.noise.terms import NAMES, SIGMA, TIME, bias_square, letters
from imulab.estimation.rows import NORMAL_95, distinct
from imulab.recording import Array, release

# Allan deviation.


_DENSE_PER_DECADE = 24  # averaging times in a decade of a dense curve, 10 % apart
_FEWEST = 3  # samples: an Allan variance needs two neighbouring means, and one more for a second pair
_AT_ONCE = 1 << 18  # samples that are taken from disk together


@dataclass(frozen=True, repr=False)
class DeviationCurve:
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
        return self._text(1.0, "")

    def _text(self, factor: float, unit: str) -> str:
        """Return the curve in a line, its least deviation times a factor, in a unit."""
        least = int(np.argmin(self.deviation))
        return (
            f"AllanCurve({len(self.tau)} averaging times from {self.tau[0]:.4g} to {self.tau[-1]:.4g} s, "
            f"least deviation {factor * self.deviation[least]:.3g}{unit} at {self.tau[least]:.4g} s)"
        )


def allan_deviation(
    samples: Array, rate: float, taus: str | Array = "octave", room: Array | None = None
) -> DeviationCurve:
    """Return the overlapping Allan deviation of evenly spaced samples.

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
    room
        Shape (n + 1,), overwritten: a long array costs time to make, and columns of one length can share it.

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
    integral = np.empty(len(data) + 1) if room is None else room
    integral[0] = 0.0
    centred, first = integral[1:], data[0]
    for start in range(0, len(data), _AT_ONCE):  # samples on disk come into memory part by part
        rows = slice(start, start + _AT_ONCE)
        np.subtract(data[rows], first, out=centred[rows])  # a constant becomes exactly 0
        release(data)
    mean = centred.mean()
    if not math.isfinite(mean):
        raise DataError("Allan deviation: expected finite samples")
    integrate(centred, mean)
    counts = _averages(len(integral), rate, taus)
    squares = np.empty(len(counts))
    fill_squares(squares, integral, counts)
    variance = squares / (2.0 * (len(integral) - 2 * counts)) / counts.astype(np.float64) ** 2
    freedom = _freedom(len(integral), counts, variance)
    deviation = np.sqrt(variance)
    return DeviationCurve(counts / rate, deviation, deviation / np.sqrt(2 * freedom), freedom)


def _averages(length: int, rate: float, taus: str | Array) -> np.ndarray:
    """Return how many samples are averaged at each point of the curve, so that every sum has two terms or more."""
    most = (length - 2) // 2
    if isinstance(taus, str):
        if taus == "octave":
            counts = 2 ** np.arange(0, int(math.log2(most)) + 1)
        elif taus == "dense":
            steps = int(_DENSE_PER_DECADE * math.log10(most)) + 1
            counts = distinct(np.round(10 ** (np.arange(steps) / _DENSE_PER_DECADE))).astype(np.int64)
        else:
            raise OptionError(f"taus {taus!r}: expected {' or '.join(TAUS)}{meant(TAUS, taus)}")
    else:
        times = np.asarray(taus, dtype=np.float64)
        if not np.isfinite(times).all():
            raise OptionError("taus: expected finite averaging times")
        counts = distinct(np.round(times * rate).astype(np.int64))
    counts = counts[(counts >= 1) & (counts <= most)]
    if not counts.size:
        raise OptionError(f"taus: expected averaging times from {1 / rate:g} s to {most / rate:g} s")
    return counts


def _freedom(length: int, counts: np.ndarray, variance: Array) -> Array:
    """Return the equivalent degrees of freedom at each point: those of the noise with the curve's slope there.

    White noise below a slope of the logarithms of the variance of -1/2, 1/f noise up to 1/2, random walk above it
    (NIST SP 1065, table 5).
    """
    n, m = float(length), counts.astype(np.float64)
    white = (3 * (n - 1) / (2 * m) - 2 * (n - 2) / n) * 4 * m**2 / (4 * m**2 + 5)
    flicker = np.where(m == 1, 2 * (n - 2) ** 2 / (2.3 * n - 4.9), 5 * n**2 / (4 * m * (n + 3 * m)))
    walk = (n - 2) / m * ((n - 1) ** 2 - 3 * m * (n - 1) + 4 * m**2) / max(n - 3, 1) ** 2
    safe = np.log(np.maximum(variance, 1e-300))
    slope = np.gradient(safe, np.log(m)) if len(m) > 1 else np.array([-1.0])
    chosen: Array = np.where(slope < -0.5, white, np.where(slope < 0.5, flicker, walk))
    return np.maximum(chosen, 1.0)


# Noise coefficients: N, B, K, Q of the fitted model, where the record agrees with it.


COEFFICIENTS = ("angle_random_walk", "bias_instability", "rate_random_walk", "quantisation")
_EDGE, _SHARE = 1.5, 0.003
"""In shortest time constants, and of the record's length: a faster Gauss-Markov process is the sensor's filter; the
second counts where the band has no level end."""
_LEVELS = 0.01
"""Relative standard uncertainty of taking the level at the end of the band for white noise."""
_MUCH = 2.0
"""A warning says by what factor unseen noise could enlarge the uncertainty of a mean from this factor on."""


@dataclass(frozen=True)
class Coefficient:
    """A noise coefficient, its standard uncertainty and its 95 % interval; all NaN where it is not determined.

    In the unit of the samples times s (quantisation), s^1/2, 1 or s^-1/2; `reason` says why it is not determined. In
    the interval the deviance is at most 3.84 above its minimum (profile likelihood); the standard uncertainty is the
    longer side over 1.96.
    """

    value: float
    standard_uncertainty: float
    interval: tuple[float, float] = (math.nan, math.nan)
    reason: str = ""


@dataclass(frozen=True)
class NoiseCoefficients:
    """N, B, K, Q of ``sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + 3 Q^2 / tau^2``.

    Attributes
    ----------
    angle_random_walk, bias_instability, rate_random_walk, quantisation
        The coefficients.
    highest
        Up to which frequency the noise counts, Hz; 0 where nothing is determined.
    filtered
        Whether the noise is clearly correlated from sample to sample.
    """

    angle_random_walk: Coefficient
    bias_instability: Coefficient
    rate_random_walk: Coefficient
    quantisation: Coefficient
    highest: float = 0.0
    filtered: bool = False


def read_coefficients(columns: Sequence[Analysis]) -> list[NoiseCoefficients]:
    """Return the noise coefficients of columns, with profile-likelihood intervals, where their model fits.

    They come from the model of white noise, 1/f noise and random walk together, with quantisation of an angle where it
    shows. A coefficient that the record does not show is 0 or small, with an interval from 0. Where Gauss-Markov
    processes explain the record clearly better, B and K are not determined, unless those processes are the sensor's
    filter. Where the test of fit rejects the best model at 1 %, only N is given: the level at the end of the band,
    where that is level.
    """
    wanted = [(k, index) for k, analysis in enumerate(columns) for index in sorted({*_candidates(analysis)} - {-1})]
    ends = dict(zip(wanted, intervals_of([columns[k] for k, _ in wanted], [index for _, index in wanted]), strict=True))
    return [
        _read(analysis, *({i: ends[k, i] for i in _candidates(analysis) if i >= 0}, _candidates(analysis)))
        for k, analysis in enumerate(columns)
    ]


def fits(analysis: Analysis) -> bool:
    """Return whether the test of fit accepts the best model at 1 %."""
    return bool(analysis.test.probability >= NOISE_MODEL_REJECTED.level)


def _candidates(analysis: Analysis) -> tuple[int, int, int]:
    """Return the candidate models that N, B and K are taken from; -1 for none."""
    if not fits(analysis):
        return (-1, -1, -1)
    names = ["".join(sorted(letters(model).replace("Q", ""))) for model in analysis.choice.models[0]]
    near = analysis.choice.rivals[0].copy()
    near[analysis.index] = True
    if any("G" not in name for name, is_near in zip(names, near.tolist(), strict=True) if is_near):
        every = names.index("BKN")
        return (every, every, every)
    if (analysis.values[list(TIME)] <= _fast(analysis)).all():
        flicker, walk = (names.index(each) if each in names else -1 for each in ("BGN", "GKN"))
        return (-1, flicker, walk)
    return (-1, -1, -1)


def _fast(analysis: Analysis) -> float:
    """Return the longest time constant, s, of a Gauss-Markov process that counts as the sensor's filter."""
    return max(_EDGE * analysis.limits[0], 0.0 if analysis.band.flat else _SHARE * analysis.length)


def _white(analysis: Analysis) -> Coefficient:
    """Return the white noise, averaged over all candidates, with processes behind the filter: ``N^2 + sum 2 s^2 T``."""

    def square(values: Array) -> Array:
        sizes, times = values[..., list(SIGMA)], values[..., list(TIME)]
        density = np.where(times <= _fast(analysis), 2 * sizes**2 * times, 0.0)
        return np.asarray(values[..., :1] ** 2 + density.sum(axis=-1, keepdims=True))

    white = average(analysis.choice, square)
    return _coefficient(*np.sqrt(white.quantiles(0.5, 0.025, 0.975)[:, 0, 0]).tolist())


def _read(
    analysis: Analysis, ends: Mapping[int, tuple[Array, Array]], candidates: tuple[int, int, int]
) -> NoiseCoefficients:
    band = analysis.band
    # Half of the band is given up where nothing is filtered.
    filtered = band.highest * analysis.interval < 0.24
    if not fits(analysis):
        reason = f"the noise is not that of the model (test of fit: {probability_text(analysis.test.probability)})"
        none = undetermined(reason, band.highest, filtered)
        return replace(none, angle_random_walk=_level(analysis)) if band.flat else none

    def one(k: int, index: int) -> Coefficient:
        if index < 0:
            return _not_determined(
                f"the noise is also {_markov(analysis)}, no 1/f noise or random walk: imulab noise fit"
            )
        return _coefficient(*(float(part[k]) for part in (analysis.choice.values[0, index], *ends[index])))

    white = one(0, candidates[0]) if candidates[0] >= 0 else _white(analysis)
    angle = _not_determined("does not show" if band.full else f"would show above {band.highest:.4g} Hz only")
    if analysis.model[NAMES.index("quantisation")] and candidates[0] >= 0:
        angle = one(3, candidates[0])
    flicker, walk = one(1, candidates[1]), one(2, candidates[2])
    filtered = filtered or (not band.flat and candidates[0] < 0)
    return NoiseCoefficients(_widened(white, band.roll_off), flicker, walk, angle, band.highest, filtered)


def _widened(coefficient: Coefficient, relative: float) -> Coefficient:
    """Return a coefficient whose interval is widened by a further relative standard uncertainty."""
    value, more = coefficient.value, relative * coefficient.value
    sides = [math.hypot(end - value, NORMAL_95 * more) for end in coefficient.interval]
    return _coefficient(value, value - sides[0], value + sides[1])


def _level(analysis: Analysis) -> Coefficient:
    """Return the white noise as the level of the two highest octaves of the band, which agree."""
    highest = analysis.band.highest
    f = np.concatenate([frequencies(each) for each in analysis.spectra])
    top = np.where(f > highest / 4, analysis.bins.freedom, 0.0)
    if not top.any():  # spectral lines, or frequencies off the model, take all of it
        return _not_determined(f"no frequency from {highest / 4:.3g} to {highest:.3g} Hz is left without a line")
    value = math.sqrt(float((top * analysis.bins.power).sum() / top.sum()) * analysis.interval)
    u = value * math.hypot(_LEVELS, math.sqrt(1 / (2 * float(top.sum()))))
    return Coefficient(value, u, (value - NORMAL_95 * u, value + NORMAL_95 * u))


def _markov(analysis: Analysis) -> str:
    """Return the words for the Gauss-Markov processes of the fitted model."""
    times = [f"{analysis.values[t]:.3g}" for t, size in zip(TIME, SIGMA, strict=True) if analysis.values[size] > 0]
    return f"a Gauss-Markov {'process' if len(times) == 1 else 'processes'} of {' and '.join(times)} s"


def _coefficient(value: float, low: float, high: float) -> Coefficient:
    return Coefficient(value, max(high - value, value - low) / NORMAL_95, (low, high))


def _not_determined(reason: str) -> Coefficient:
    return Coefficient(math.nan, math.nan, reason=reason)


def undetermined(reason: str, highest: float = 0.0, filtered: bool = False) -> NoiseCoefficients:
    """Return coefficients none of which is determined, for one reason."""
    none = _not_determined(reason)
    return NoiseCoefficients(none, none, none, none, highest, filtered)


def mean_uncertainty(analysis: Analysis, duration: float) -> float:
    """Return the standard uncertainty of a mean over a duration, s, as a measure of the bias.

    ``u^2`` of `noise.terms.bias_square`, averaged over all candidates, each times exp(variance of ln u^2 / 2).
    """
    square = average(analysis.choice, lambda values: bias_square(values, np.array([duration]), analysis.interval))
    return float(np.sqrt(square.expected[0, 0]))


def unseen(analysis: Analysis, coefficients: NoiseCoefficients, duration: float) -> float:
    """Return by what factor noise too weak to show could enlarge that uncertainty; 1 where it is below 2.

    Taken is 1/f noise or random walk at the upper end of its interval, beside the white noise.
    """
    white, *slow = (each.interval[1] for each in (coefficients.angle_random_walk, coefficients.bias_instability,
                                                  coefficients.rate_random_walk))  # fmt: skip
    if math.isnan(slow[0]):
        return 1.0
    ends = np.zeros((2, len(NAMES)))
    ends[:, 0], ends[0, 1], ends[1, 2] = white, *slow
    largest = float(bias_square(ends, np.array([duration]), analysis.interval).max())
    ratio = math.sqrt(largest) / mean_uncertainty(analysis, duration)
    return ratio if ratio > _MUCH else 1.0


def coefficients_dict(coefficients: NoiseCoefficients, unit: str) -> dict[str, Any]:
    """Return the coefficients as plain JSON values with their units: null and the reason where not determined."""
    units = (f"{unit}/sqrt(Hz)", unit, f"{unit}/sqrt(s)", {"rad/s": "rad", "m/s^2": "m/s"}.get(unit, f"{unit} s"))
    listed: dict[str, Any] = {}
    for name, its in zip(COEFFICIENTS, units, strict=True):
        coefficient: Coefficient = getattr(coefficients, name)
        known = not coefficient.reason
        listed[name] = {
            "value": coefficient.value if known else None,
            "standard_uncertainty": coefficient.standard_uncertainty if known else None,
            "interval_95": list(coefficient.interval) if known else None,
            "unit": its,
            **({} if known else {"reason": coefficient.reason}),
        }
    return listed
