"""Allan curves and noise coefficients of every sensor column of a recording at rest."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import numpy as np

from imulab.columns import INERTIAL, kind_of
from imulab.display import Finding, Note, join_alike, prefixed
from imulab.errors import DataError, OptionError
from imulab.estimation.noise.analysis import CANDIDATES, Analysis, analyses, average
from imulab.estimation.noise.readings import doubtful_units, own_readings
from imulab.estimation.noise.spectrum import transformed
from imulab.estimation.noise.terms import allan_variance
from imulab.estimation.noise_coefficients import (
    DeviationCurve,
    NoiseCoefficients,
    allan_deviation,
    coefficients_dict,
    fits,
    mean_uncertainty,
    read_coefficients,
    undetermined,
    unseen,
)
from imulab.estimation.rows import Step, deviation_of_steps, find_step, leave_out, resolution
from imulab.estimation.sampling import bridged, mend_stamps, sampling_rate, steady_part
from imulab.recording import Array, Recording, check_not_resampled, release
from imulab.units import from_si, parse_unit, si_unit, to_si

_STILL = {"rate": (math.radians(5.0), "deg/s"), "acceleration": (1.0, "m/s^2")}
"""How far the zero of a sensor at rest may drift, SI, and the unit in which messages state it."""
_NOISE_REACH = 20.0  # standard uncertainties of a mean: means farther apart show a motion, not noise
_SAMPLES = "samples"  # the name of samples without a column
_LARGEST = 1e140  # beyond it, or below its inverse, squares overflow or vanish in double precision
_MOST_NAMED, _MOST_COLUMNS = 3, 6  # lines of a column, and columns with lines, that a note names
# Fewest samples for noise coefficients; fewest degrees of freedom of an Allan deviation that counts
FEWEST, _LEAST_FREEDOM = 50, 4.0
_COARSE = 2.2  # largest step of the output over the deviation from sample to sample; a rounded angle's is at most 2.0
_FITTED = 0.5  # shortest averaging time that the band shows, in units of 1/f_max


@dataclass(frozen=True)
class ColumnNoise:
    """Allan curve of a column, its noise coefficients, and the fitted model (None where none can be fitted)."""

    curve: DeviationCurve
    coefficients: NoiseCoefficients
    model: Analysis | None = None

    @property
    def fits(self) -> bool:
        """Whether there is a model and the record agrees with it."""
        return self.model is not None and fits(self.model)

    @property
    def lines(self) -> list[float]:
        """Frequencies of the spectral lines, Hz, the largest first; lines are not part of the noise."""
        return [] if self.model is None else [line.frequency for line in self.model.stretches[0].lines]

    def mean_uncertainty(self, duration: float) -> float:
        """Return the standard uncertainty of the mean over a duration, s, as a measure of the bias.

        The model's value; where the record does not agree with the model, at least the Allan deviation at the far end
        of the curve.
        """
        by_model = 0.0 if self.model is None else mean_uncertainty(self.model, duration)
        if self.fits:
            return by_model
        known = (self.curve.freedom >= _LEAST_FREEDOM) & (self.curve.deviation > 0)
        upper = (self.curve.deviation * np.sqrt(1 + 2 * np.sqrt(2 / self.curve.freedom)))[known]
        return max(by_model, float(upper[-3:].max(initial=0.0)))

    def unseen(self, duration: float) -> float:
        """Return by what factor noise too weak to show could enlarge that uncertainty; 1 where it is below 2."""
        return unseen(self.model, self.coefficients, duration) if self.model is not None and self.fits else 1.0

    def fitted(self, tau: Array) -> Array | None:
        """Return the Allan deviation of the model, nan where the band does not reach; None without a model."""
        if self.model is None or not self.fits:
            return None
        interval = self.model.interval
        variance = average(self.model.choice, lambda values: allan_variance(values, tau, interval)).mean[0]
        return np.where(tau * self.coefficients.highest >= _FITTED, np.sqrt(variance), np.nan)


def noise_columns(recording: Recording) -> Iterator[str]:
    """Yield the names of the columns that hold outputs of inertial sensors."""
    return (name for name in recording.columns if kind_of(name) in INERTIAL)


def analyse(recording: Recording, taus: str = "octave") -> dict[str, Any]:
    """Return Allan curves and noise coefficients of every sensor column, in SI, as plain JSON values.

    Errors as for `curves_and_noise`; also without any sensor column.
    """
    names = list(noise_columns(recording))
    if not names:
        raise recording.lacking(f"sensor column ({' '.join(INERTIAL)})", "gyro_x")
    clocks = {clock: [name for name in names if name in stamped] for clock, stamped in recording.clocks.items()}
    parts = [curves_and_noise(recording.stream(clock), stamped, taus) for clock, stamped in clocks.items() if stamped]
    columns: dict[str, Any] = {}
    for part, its_rate, noises, _ in parts:
        sampled = {"samples": len(part), "sample_rate": {"value": its_rate, "unit": "Hz"}} if len(parts) > 1 else {}
        for name, noise in noises.items():
            columns[name] = {**_column(part, name, noise), **sampled}
    first, rate, _, _ = parts[0]
    return {
        "format": "imulab.noise",
        "version": 1,
        "file": recording.name,
        "sensor": {key: recording.metadata[key] for key in ("serial", "model") if key in recording.metadata},
        "samples": len(first),
        "sample_rate": {"value": rate, "unit": "Hz"},
        "taus": taus,
        "warnings": list(dict.fromkeys(note for *_, notes in parts for note in notes)),
        "columns": {name: columns[name] for name in names},
    }


def _column(recording: Recording, name: str, noise: ColumnNoise) -> dict[str, Any]:
    return {
        "unit": si_unit(recording.units[name]),
        "mean": float(recording.si(name).mean()),
        **coefficients_dict(noise.coefficients, si_unit(recording.units[name])),
        "tau": noise.curve.tau.tolist(),
        "deviation": noise.curve.deviation.tolist(),
        "standard_uncertainty": noise.curve.standard_uncertainty.tolist(),
        "fitted": _listed(noise.fitted(noise.curve.tau)),
    }


def curves_and_noise(
    recording: Recording, wanted: Sequence[str], taus: str | Array
) -> tuple[Recording, float, dict[str, ColumnNoise], list[str]]:
    """Return the readings of a recording, their rate, Hz, the noise of the columns `wanted`, and notes.

    Where the sampling rate changes, the longest stretch of one rate is used; a few rows without numbers are bridged.
    The notes name both.

    Raises
    ------
    DataError, OptionError
        As for `allan_deviation`; also without a time column.
    """
    names = list(noise_columns(recording))  # of all sensors: each may show that a row is no reading
    check_not_resampled(recording, wanted)
    recording, rate, notes = _mended(recording, names)
    noises, more = _noises(recording, rate, names, wanted, taus)
    return recording, rate, noises, [*notes, *more]


def bridged_samples(samples: Array, rate: float) -> tuple[Array, list[str]]:
    """Return samples of an unknown sensor, shape (n,), of which up to 1 % are no numbers and are bridged, and notes.

    Raises
    ------
    DataError, OptionError
        As for `curves_and_noise`.
    """
    if not 1 / _LARGEST < rate < _LARGEST:
        raise OptionError(f"sampling rate {rate:g}: expected a positive number of Hz, such as sensors have")
    recording, notes = bridged(Recording({_SAMPLES: samples}, {_SAMPLES: "1"}, name=_SAMPLES), [_SAMPLES])
    _check_squares(recording, [_SAMPLES])
    return recording.columns[_SAMPLES], notes


def samples_noise(samples: Array, rate: float) -> tuple[ColumnNoise, list[str]]:
    """Return the noise of samples of an unknown sensor, shape (n,), n >= 50, at a rate, Hz, and notes."""
    recording = Recording({_SAMPLES: samples}, {_SAMPLES: "1"}, name=_SAMPLES)
    noises, notes = _noises(recording, rate, [], [_SAMPLES], "octave")
    return noises[_SAMPLES], notes


def _noises(
    recording: Recording, rate: float, names: list[str], wanted: Sequence[str], taus: str | Array
) -> tuple[dict[str, ColumnNoise], list[str]]:
    """Return the noise of the columns `wanted`, with notes; a column of a sensor that moved has no coefficients."""
    notes: list[str] = []
    moved = moved_columns(recording, names, rate)
    values, units = [recording.column(name) for name in wanted], [recording.units[name] for name in wanted]
    reasons = [moved.get(name, "") for name in wanted]
    noises = dict(zip(wanted, columns_noise(values, rate, reasons, units=units), strict=True))
    for name in wanted:
        samples = recording.si(name)
        if name not in moved and (step := find_step(samples)) is not None:
            notes.append(_step_line(recording, name, step))
        del samples  # before the next is made
    if not isinstance(taus, str) or taus != "octave":
        for name, curve in zip(wanted, _curves(values, units, rate, taus), strict=True):
            noises[name] = replace(noises[name], curve=curve)
    return noises, notes + [prefixed(recording.name, line) for line in noise_lines(noises)]


def _mended(recording: Recording, names: list[str]) -> tuple[Recording, float, list[str]]:
    """Return the rows that are readings, at one rate, Hz, and notes on the other rows."""
    recording = mend_stamps(recording)
    notes = [prefixed(recording.name, note) for note in recording.notes]
    recording, more = bridged(recording, names)
    for sensor in dict.fromkeys(map(kind_of, names)):
        left_out = leave_out(recording, [name for name in names if kind_of(name) == sensor])
        left_out.check(0, len(recording), "the recording")
        more += [prefixed(recording.name, note) for note in left_out.notes()]
        recording = left_out.recording
    _check_squares(recording, names)
    recording, mended = own_readings(recording, names)
    recording, trimmed = steady_part(recording)
    rate, timing = sampling_rate(recording)
    if not 1 / _LARGEST < rate < _LARGEST:
        raise DataError(f"{recording.name}: column time: {rate:.3g} samples in a second; expected a rate of sensors")
    return recording, rate, [*notes, *more, *mended, *trimmed, *timing, *doubtful_units(recording, names, rate)]


def _check_squares(recording: Recording, names: list[str]) -> None:
    """Refuse samples whose squares overflow in double precision."""
    for name in names:
        values = recording.si(name)
        index = int(np.argmax(values) if values.max() >= -values.min() else np.argmin(values))
        if abs(values[index]) > _LARGEST:
            raise DataError(
                f"{recording.name}: {recording.place(index)}, column {name}: expected a reading, found "
                f"{recording.column(name)[index]:.6g}, which is too large to be squared"
            )
        del values  # before the next is made


def _listed(values: Array | None) -> list[float | None] | None:
    return None if values is None else [None if math.isnan(value) else value for value in values.tolist()]


def columns_noise(
    columns: Sequence[Array],
    rate: float,
    moved: Sequence[str] = (),
    candidates: tuple[str, ...] = CANDIDATES,
    units: Sequence[str] = (),
) -> list[ColumnNoise]:
    """Return the Allan curves of columns, shape (n,) each, at a rate, Hz, and the coefficients of the fitted models.

    Spikes and spectral lines stay in the curve and are removed before the model is fitted. `moved` gives for each
    column the reason why it has no coefficients, or nothing; `units` are those of the columns, which are in SI without.

    Raises
    ------
    DataError, OptionError
        As for `allan_deviation`; fewer than 50 samples.
    """
    units = units or ["1"] * len(columns)
    curves = _curves(columns, units, rate)
    if columns and len(columns[0]) < FEWEST:
        raise DataError(
            f"noise coefficients: {len(columns[0])} samples are too few; expected some {FEWEST} samples or more"
        )
    why, stretches = [], []
    for samples, unit, curve, reason in zip(columns, units, curves, moved or repeat(""), strict=False):
        why.append(reason or _unfit(samples, float(curve.deviation[0]) / to_si(1.0, unit)))
        stretches += [] if why[-1] else [[transformed(samples, 1 / rate, unit=unit)]]
        release(samples)
    fit = [k for k, reason in enumerate(why) if not reason]
    analysed_columns = analyses(stretches, candidates) if fit else []
    models = dict(zip(fit, zip(read_coefficients(analysed_columns), analysed_columns, strict=True), strict=True))
    return [
        ColumnNoise(curve, *(models[k] if k in models else (undetermined(why[k]),))) for k, curve in enumerate(curves)
    ]


def _curves(
    columns: Sequence[Array], units: Sequence[str], rate: float, taus: str | Array = "octave"
) -> list[DeviationCurve]:
    """Return the Allan curves, SI, of columns in their units; only curves are converted, since a long log is large."""
    room = np.empty(len(columns[0]) + 1) if columns else None  # once: its memory costs as much time as the sums
    curves = [allan_deviation(samples, rate, taus, room) for samples in columns]
    factors = [to_si(1.0, unit) for unit in units]
    return [
        replace(curve, deviation=curve.deviation * factor, standard_uncertainty=curve.standard_uncertainty * factor)
        for curve, factor in zip(curves, factors, strict=True)
    ]


def _unfit(samples: Array, noise: float) -> str:
    """Return why no noise model can be fitted to samples with `noise` as their Allan deviation from one to the next."""
    if samples[0] == samples[-1] and not np.ptp(samples):
        return "all samples are the same: a dead sensor"
    if not noise:
        return "the samples differ by too little to be squared"
    step = resolution(samples)
    if step > _COARSE * noise:
        return f"the samples take steps that are {step / noise:.1f} times as large as their noise"
    return ""


def _step_line(recording: Recording, name: str, step: Step) -> str:
    """Return the warning of a change of level, which the coefficients would take for noise."""
    unit = recording.units[name]
    when = f" within {step.within} rows near {recording.place(step.sample)}"
    if recording.time is not None:
        duration = step.within * float(recording.time[-1] - recording.time[0]) / (len(recording) - 1)
        when = f" within {duration:.2g} s near {recording.time[step.sample]:.4g} s"
    size = from_si(abs(step.size), unit) if parse_unit(unit).quantity in _STILL else abs(step.size)
    return (
        f"{recording.name}: column {name}: the level changes by {size:.2g} {unit}{when}, which is no noise: "
        "bias instability and rate random walk contain it; read the parts before and after it apart (--window)"
    )


def noise_lines(noises: Mapping[str, ColumnNoise]) -> list[str]:
    """Return notes on columns by name: filters, spectral lines, and coefficients that are not determined."""
    undetermined_ones: list[tuple[str, str]] = []
    for name, noise in noises.items():
        its, action = noise.coefficients, "check the sensor, and the resolution of its log"
        if reason := its.angle_random_walk.reason:
            undetermined_ones.append((name, Finding(f"noise coefficients not determined: {reason}", action)))
        elif reason := its.bias_instability.reason:
            text = f"bias instability and random walk of the zero not determined: {reason}"
            undetermined_ones.append((name, Note(text, action)))
    messages = [prefixed(_columns(names), finding) for names, finding in join_alike(undetermined_ones)]
    filtered = {n: f.coefficients for n, f in noises.items() if f.coefficients.filtered}
    if filtered:
        highest = min(f.highest for f in filtered.values())
        messages.append(
            Note(
                f"{_columns(list(filtered))}: the noise is correlated from sample to sample, as behind a filter; the "
                f"coefficients are read from frequencies up to {highest:.3g} Hz"
            )
        )
    with_lines = {n: f.lines[:_MOST_NAMED] for n, f in noises.items() if f.lines}
    if with_lines:
        each = "; ".join(
            f"{n} {' '.join(f'{f:.4g}' for f in frequencies)}"
            for n, frequencies in list(with_lines.items())[:_MOST_COLUMNS]
        )
        more = len(with_lines) - _MOST_COLUMNS
        each += f"; and in {more} more columns" if more > 0 else ""
        messages.append(
            Note(
                f"spectral lines, taken out of the noise that the coefficients are read from, largest first, Hz: {each}"
            )
        )
    return messages


def _columns(names: list[str]) -> str:
    return f"column{'s' * (len(names) > 1)} {' '.join(names)}"


def most_reach(quantity: str, noise: float) -> float:
    """Return how far apart the means of a sensor at rest may lie, SI, for their noise; infinite for other sensors."""
    return max(_STILL[quantity][0], _NOISE_REACH * noise) if quantity in _STILL else math.inf


def moved_columns(recording: Recording, names: list[str], rate: float) -> dict[str, str]:
    """Return, by column, that the means over 1 s range farther than a drifting zero and noise explain."""
    size = max(1, min(round(rate), len(recording)))
    moved: dict[str, float] = {}
    for name in names:
        quantity = parse_unit(recording.units[name]).quantity
        if quantity not in _STILL:
            continue
        samples = recording.si(name)
        means = samples[: len(samples) // size * size].reshape(-1, size).mean(axis=1)
        reach = float(np.ptp(means)) if means.size else 0.0
        noise = deviation_of_steps(samples) / math.sqrt(2 * size)
        if reach > most_reach(quantity, noise):
            moved[name] = reach
        del samples  # before the next is made
    reasons: dict[str, str] = {}
    for quantity, (_, unit) in _STILL.items():
        reaches = {n: r for n, r in moved.items() if parse_unit(recording.units[n]).quantity == quantity}
        if reaches:
            most = from_si(max(reaches.values()), unit)
            why = f"means over a second range over up to {most:.3g} {unit}: did the unit move?"
            reasons |= dict.fromkeys(reaches, why)
    return reasons
