"""Allan deviation, and the noise coefficients read from it.

Sources: IEEE Std 952 (annex C) and IEEE Std 647 for the coefficients; NIST SP 1065 (equations 11 and table 5) for the
overlapping estimator and its equivalent degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from imulab.errors import DataError, OptionError
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.units import from_si, parse_unit

_CHUNK = 1 << 14
_DENSE_PER_DECADE = 24
_FEWEST = 3
_LONGEST = 5  # coefficients are read from averaging times up to this part of the recording
_GAP = 1.5
_COARSE = 0.2
_FLICKER = 2 * math.log(2) / math.pi
_OCTAVE_CORRELATION = 0.5
"""Of estimates an octave apart, measured on white noise and random walk (.45 to .6); falls as its power."""
_SENSORS = ("gyro", "dtg", "fog", "accel")
COEFFICIENTS = ("angle_random_walk", "bias_instability", "rate_random_walk")
_STILL = {"rate": (math.radians(5.0), "deg/s"), "acceleration": (1.0, "m/s^2")}
"""How far the zero of a sensor at rest may drift, SI, and the unit to say it in."""
_NOISE_REACH = 20.0


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class Coefficient:
    """A noise coefficient and its standard uncertainty; unit of the samples times s^1/2, 1 or s^-1/2."""

    value: float
    standard_uncertainty: float


@dataclass(frozen=True)
class NoiseCoefficients:
    """Coefficients N, B, K of ``sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3``.

    `covariance` is that of their squares (N^2, B^2, K^2) as the curve gives them, shape (3, 3).
    """

    angle_random_walk: Coefficient
    bias_instability: Coefficient
    rate_random_walk: Coefficient
    covariance: Array

    def variance(self, tau: Array) -> Array:
        """Return the Allan variance that the coefficients predict, shape of `tau`."""
        values = [getattr(self, name).value ** 2 for name in COEFFICIENTS]
        variance: Array = _terms(tau) @ np.array(values)
        return variance

    def mean_uncertainty(self, duration: float) -> float:
        """Return the standard uncertainty of the mean over a duration, s, as an estimate of the bias.

        ``u^2 = E[x | x >= N^2 / T]``, x normal about the Allan variance that the coefficients predict at T, with the
        variance that their covariance gives it: what the curve, which ends at T / 5, leaves open counts as well. A
        recording that is shorter than the noise is correlated cannot show it.
        """
        terms = _terms(np.array([duration]))[0]
        predicted = float(self.variance(np.array([duration]))[0])
        spread = math.sqrt(max(float(terms @ self.covariance @ terms), 0.0))
        if spread == 0.0:
            return math.sqrt(predicted)
        cut = (float(terms[0]) * self.angle_random_walk.value**2 - predicted) / spread
        density, above = math.exp(-(cut**2) / 2) / math.sqrt(2 * math.pi), math.erfc(cut / math.sqrt(2)) / 2
        return math.sqrt(predicted + spread * density / above)


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
    mean = data.mean()
    if not math.isfinite(mean):
        raise DataError("Allan deviation: expected finite samples")
    np.cumsum(data - mean, out=integral[1:])
    integral *= 1 / rate
    counts = _averages(len(integral), rate, taus)
    squares = np.array([_square(integral, m) for m in counts.tolist()])
    variance = squares / (2.0 * (len(integral) - 2 * counts)) / counts.astype(np.float64) ** 2 * rate**2
    freedom = _freedom(len(integral), counts, variance)
    deviation = np.sqrt(variance)
    return AllanCurve(counts / rate, deviation, deviation / np.sqrt(2 * freedom), freedom)


def read_coefficients(curve: AllanCurve) -> NoiseCoefficients:
    """Read angle random walk, bias instability and rate random walk from an Allan curve, with uncertainties.

    Non-negative generalised least squares of ``sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3`` over
    averaging times up to about a fifth of the recording; an estimate's relative variance is 2 / freedom, neighbours are
    correlated. A coefficient that the curve does not show is 0 with the size that it may have as its uncertainty.

    Raises
    ------
    DataError
        The curve has fewer than four usable averaging times.
    """
    from scipy.optimize import nnls

    use = (curve.freedom >= _LONGEST - 1) & (curve.deviation > 0)
    if not (curve.deviation > 0).any():
        zero = Coefficient(0.0, 0.0)
        return NoiseCoefficients(zero, zero, zero, np.zeros((3, 3)))
    if np.count_nonzero(use) < 4:
        raise DataError("noise coefficients: the recording is too short; expected some 50 samples or more")
    tau, variance = curve.tau[use], curve.deviation[use] ** 2
    relative = np.sqrt(2 / curve.freedom[use])
    apart = np.abs(np.subtract.outer(np.log2(tau), np.log2(tau)))
    correlation = _OCTAVE_CORRELATION**apart
    terms = _terms(tau)
    predicted = variance
    for _ in range(20):
        sigma = relative * predicted
        root = np.linalg.cholesky(correlation * np.outer(sigma, sigma) + np.diag(1e-12 * sigma**2))
        whitened = np.linalg.solve(root, np.column_stack([terms, variance]))
        scale = np.linalg.norm(whitened[:, :-1], axis=0)
        values = nnls(whitened[:, :-1] / scale, whitened[:, -1])[0] / scale
        last, predicted = predicted, terms @ values
        if np.allclose(last, predicted, rtol=1e-10, atol=0):
            break
    scaled = whitened[:, :-1] / scale
    covariance = np.linalg.inv(scaled.T @ scaled) / np.outer(scale, scale)
    found = []
    for value, spread in zip(values, np.sqrt(np.diag(covariance)), strict=True):
        size = math.sqrt(value)
        found.append(Coefficient(size, float(min(spread / (2 * size) if size else math.inf, math.sqrt(spread)))))
    white, flicker, walk = found
    return NoiseCoefficients(white, flicker, walk, covariance)


def noise_columns(recording: Recording) -> Iterator[str]:
    """Yield the names of the columns that hold outputs of inertial sensors."""
    return (name for name in recording.columns if name.split("_")[0] in _SENSORS)


def usual_step(step: Array) -> tuple[float, float]:
    """Return the usual step of time, s, and the longest that is no gap, from steps of time, shape (n,), n >= 1.

    Beyond 1.5 times the median a step is a gap, unless a fifth of all steps are: then time is written that coarsely
    (stamps in whole milliseconds at 700 Hz alternate between 1 and 2 ms), and the limit is 1.5 times the step that a
    fifth exceed. The usual step is the mean of those that are no gaps.
    """
    longest = _GAP * float(np.median(step))
    if np.mean(step > longest) > _COARSE:
        longest = _GAP * float(np.quantile(step, 1 - _COARSE))
    return float(step[step <= longest].mean()), longest


def sampling_rate(recording: Recording) -> tuple[float, list[str]]:
    """Return the sampling rate, Hz, of a recording, and what there is to say of gaps in its time.

    Raises
    ------
    DataError
        There is no time column, time does not rise, or there are fewer than 3 samples.
    """
    if "time" not in recording:
        raise DataError(f"{recording.name}: no column time; expected one, the noise depends on the sampling rate")
    time = check_time(recording)
    if len(time) < _FEWEST:
        raise DataError(f"{recording.name}: {len(time)} samples are too few; expected at least {_FEWEST}")
    step = np.diff(time)
    usual, longest = usual_step(step)
    wide = np.flatnonzero(step > longest)
    if not wide.size:
        return (len(time) - 1) / float(time[-1] - time[0]), []
    worst = int(wide[np.argmax(step[wide])])
    return 1 / usual, [
        f"{recording.name}: {wide.size} gap{'s' if wide.size > 1 else ''} in time, the longest {step[worst]:.3g} s "
        f"after {recording.place(worst)}; the samples on both sides are taken as neighbours"
    ]


def analyse(recording: Recording, taus: str = "octave") -> dict[str, Any]:
    """Return Allan curves and noise coefficients of every sensor column, in SI, as plain JSON values.

    Raises
    ------
    DataError, OptionError
        As for `allan_deviation`; also without a time column, or without any sensor column.
    """
    rate, notes = sampling_rate(recording)
    names = list(noise_columns(recording))
    if not names:
        raise DataError(
            f"{recording.name}: no sensor column (gyro_.. accel_.. dtg_.. fog); found {' '.join(recording.columns)}"
        )
    check_finite(recording, names)
    notes += _motion_notes(recording, names, rate)
    columns: dict[str, Any] = {}
    for name in names:
        unit = {"rate": "rad/s", "acceleration": "m/s^2"}.get(
            parse_unit(recording.units[name]).quantity, recording.units[name]
        )
        curve = allan_deviation(recording.si(name), rate, taus)
        found = read_coefficients(curve)
        columns[name] = {
            "unit": unit,
            "mean": float(recording.si(name).mean()),
            **coefficients_dict(found, unit),
            "tau": curve.tau.tolist(),
            "deviation": curve.deviation.tolist(),
            "standard_uncertainty": curve.standard_uncertainty.tolist(),
        }
    return {
        "format": "imulab.noise",
        "version": 1,
        "file": recording.name,
        "sensor": {key: recording.metadata[key] for key in ("serial", "model") if key in recording.metadata},
        "samples": len(recording),
        "sample_rate": {"value": rate, "unit": "Hz"},
        "taus": taus,
        "warnings": [*(f"{recording.name}: {note}" for note in recording.notes), *notes],
        "columns": columns,
    }


def _motion_notes(recording: Recording, names: list[str], rate: float) -> list[str]:
    """Say where means over a second range farther than any zero drifts and than noise explains: the unit moved."""
    size = max(1, round(rate))
    moved: dict[str, dict[str, float]] = {}
    for name in names:
        quantity = parse_unit(recording.units[name]).quantity
        if quantity not in _STILL:
            continue
        samples = recording.si(name)
        means = samples[: len(samples) // size * size].reshape(-1, size).mean(axis=1)
        reach = float(np.ptp(means)) if means.size else 0.0
        noise = float(np.diff(samples).std()) / math.sqrt(2 * size)
        if reach > max(_STILL[quantity][0], _NOISE_REACH * noise):
            moved.setdefault(quantity, {})[name] = reach
    return [
        f"{recording.name}: column{'s' * (len(reaches) > 1)} {' '.join(reaches)}: means over a second range over up to "
        f"{from_si(max(reaches.values()), _STILL[quantity][1]):.3g} {_STILL[quantity][1]}: did the unit move? Then "
        "these are the coefficients of its motion, not of its noise"
        for quantity, reaches in moved.items()
    ]


def coefficients_dict(found: NoiseCoefficients, unit: str) -> dict[str, Any]:
    """Return the coefficients as plain JSON values with their units."""
    units = (f"{unit}/sqrt(Hz)", unit, f"{unit}/sqrt(s)")
    return {
        name: {
            "value": getattr(found, name).value,
            "standard_uncertainty": getattr(found, name).standard_uncertainty,
            "unit": its,
        }
        for name, its in zip(COEFFICIENTS, units, strict=True)
    }


def _terms(tau: Array) -> Array:
    """Derivative of the Allan variance by N^2, B^2, K^2, shape (t, 3)."""
    return np.column_stack([1 / tau, np.full(len(tau), _FLICKER), tau / 3])


def _averages(length: int, rate: float, taus: str | Array) -> np.ndarray:
    """Numbers of samples to average, each with two terms or more in its sum."""
    most = (length - 2) // 2
    if isinstance(taus, str):
        if taus == "octave":
            counts = 2 ** np.arange(0, int(math.log2(most)) + 1)
        elif taus == "dense":
            steps = int(_DENSE_PER_DECADE * math.log10(most)) + 1
            counts = np.unique(np.round(10 ** (np.arange(steps) / _DENSE_PER_DECADE))).astype(np.int64)
        else:
            raise OptionError(f"taus {taus!r}: expected octave or dense")
    else:
        counts = np.unique(np.round(np.asarray(taus, dtype=np.float64) * rate).astype(np.int64))
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
