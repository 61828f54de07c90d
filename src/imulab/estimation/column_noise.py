"""Allan curves and noise coefficients of every sensor column of a recording at rest."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imulab.errors import DataError
from imulab.estimation.allan import AllanCurve, allan_deviation
from imulab.estimation.noise_coefficients import (
    NoiseCoefficients,
    coefficients_dict,
    read_coefficients,
    resolution,
    undetermined,
)
from imulab.estimation.rows import leave_out
from imulab.estimation.sampling import bridged, sampling_rate, steady_part
from imulab.estimation.spectral_lines import Lines, spectral_lines
from imulab.estimation.steps import Step, find_step
from imulab.recording import Array, Recording
from imulab.units import from_si, parse_unit
from imulab.verdict import Note

_SENSORS = ("gyro", "dtg", "fog", "accel")
_STILL = {"rate": (math.radians(5.0), "deg/s"), "acceleration": (1.0, "m/s^2")}
"""How far the zero of a sensor at rest may drift, SI, and the unit to say it in."""
_NOISE_REACH = 20.0
_LARGEST = 1e140
_MOST_NAMED, _MOST_COLUMNS = 3, 6


@dataclass(frozen=True)
class ColumnNoise:
    """Allan curve of a column, its noise coefficients, and the lines of its spectrum."""

    curve: AllanCurve
    coefficients: NoiseCoefficients
    lines: Lines


def noise_columns(recording: Recording) -> Iterator[str]:
    """Yield the names of the columns that hold outputs of inertial sensors."""
    return (name for name in recording.columns if name.split("_")[0] in _SENSORS)


def analyse(recording: Recording, taus: str = "octave") -> dict[str, Any]:
    """Return Allan curves and noise coefficients of every sensor column, in SI, as plain JSON values.

    Of a recording whose sampling rate changes, the longest stretch of one rate counts; a few rows without numbers are
    bridged. Both is said.

    Raises
    ------
    DataError, OptionError
        As for `allan_deviation`; also without a time column, or without any sensor column.
    """
    names = list(noise_columns(recording))
    if not names:
        raise DataError(
            f"{recording.name}: no sensor column (gyro_.. accel_.. dtg_.. fog); found {' '.join(recording.columns)}"
        )
    notes = [f"{recording.name}: {note}" for note in recording.notes]
    recording, more = bridged(recording, names)
    for sensor in dict.fromkeys(name.split("_")[0] for name in names):
        left_out = leave_out(recording, [name for name in names if name.split("_")[0] == sensor])
        left_out.check(0, len(recording), "the recording")
        more += [type(note)(f"{recording.name}: {note}") for note in left_out.notes()]
        recording = left_out.recording
    _check_squares(recording, names)
    recording, trimmed = steady_part(recording)
    rate, timing = sampling_rate(recording)
    if not 1 / _LARGEST < rate < _LARGEST:
        raise DataError(f"{recording.name}: column time: {rate:.3g} samples in a second; expected a rate of sensors")
    notes += [*more, *trimmed, *timing]
    moved = moved_columns(recording, names, rate)
    columns: dict[str, Any] = {}
    noises: dict[str, ColumnNoise] = {}
    for name in names:
        unit = {"rate": "rad/s", "acceleration": "m/s^2"}.get(
            parse_unit(recording.units[name]).quantity, recording.units[name]
        )
        samples = recording.si(name)
        noises[name] = column_noise(samples, rate, moved.get(name, ""))
        if name not in moved and (step := find_step(noises[name].lines.samples)) is not None:
            notes.append(_step_line(recording, name, step))
        curve = noises[name].curve if taus == "octave" else allan_deviation(samples, rate, taus)
        columns[name] = {
            "unit": unit,
            "mean": float(samples.mean()),
            **coefficients_dict(noises[name].coefficients, unit),
            "tau": curve.tau.tolist(),
            "deviation": curve.deviation.tolist(),
            "standard_uncertainty": curve.standard_uncertainty.tolist(),
        }
    notes += [type(line)(f"{recording.name}: {line}") for line in noise_lines(noises)]
    return {
        "format": "imulab.noise",
        "version": 1,
        "file": recording.name,
        "sensor": {key: recording.metadata[key] for key in ("serial", "model") if key in recording.metadata},
        "samples": len(recording),
        "sample_rate": {"value": rate, "unit": "Hz"},
        "taus": taus,
        "warnings": notes,
        "columns": columns,
    }


def _check_squares(recording: Recording, names: list[str]) -> None:
    """Refuse samples whose squares, summed over a recording, are no numbers of this machine."""
    for name in names:
        size = np.abs(recording.si(name))
        index = int(np.argmax(size))
        if size[index] > _LARGEST:
            raise DataError(
                f"{recording.name}: {recording.place(index)}, column {name}: expected a reading, found "
                f"{recording.column(name)[index]:.6g}, which is too large to be squared"
            )


def column_noise(samples: Array, rate: float, moved: str = "") -> ColumnNoise:
    """Return the Allan curve of samples, shape (n,), at a rate, Hz, and the coefficients that can be read from it.

    Lines of the spectrum stay in the curve and are taken out for the coefficients. `moved` is why there are none.

    Raises
    ------
    DataError, OptionError
        As for `allan_deviation` and `read_coefficients`.
    """
    curve = allan_deviation(samples, rate)
    why = moved if np.ptp(samples) else "all samples are the same: a dead sensor"
    if why:
        return ColumnNoise(curve, undetermined(why), Lines(np.empty(0), np.empty(0), samples))
    lines = spectral_lines(samples, rate)
    of_noise = allan_deviation(lines.samples, rate) if len(lines.frequency) else curve
    found = read_coefficients(of_noise, resolution(samples))
    return ColumnNoise(curve, found, lines)


def _step_line(recording: Recording, name: str, step: Step) -> str:
    """Say that a level jumped, which the coefficients take for noise."""
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
    """Return what is to say of columns by name: filters and lines, and coefficients that are not determined."""
    told: dict[str, list[str]] = {}
    for name, noise in noises.items():
        reason = noise.coefficients.angle_random_walk.reason or noise.coefficients.bias_instability.reason
        if reason:
            told.setdefault(reason, []).append(name)
    said = [f"{_columns(names)}: noise coefficients not determined: {reason}" for reason, names in told.items()]
    filtered = {n: f.coefficients for n, f in noises.items() if f.coefficients.filtered}
    if filtered:
        shortest = max(f.shortest for f in filtered.values())
        time = max(f.correlation_time for f in filtered.values())
        how = f", over {1e3 * time:.3g} ms as behind a low-pass filter of {0.16 / time:.3g} Hz" if time else ""
        said.append(
            Note(
                f"{_columns(list(filtered))}: the noise is correlated from sample to sample{how}; the coefficients are "
                f"read from averaging times of {shortest:.3g} s and more"
            )
        )
    with_lines = {n: f.lines.frequency[:_MOST_NAMED] for n, f in noises.items() if len(f.lines.frequency)}
    if with_lines:
        each = "; ".join(
            f"{n} {' '.join(f'{f:.4g}' for f in found)}" for n, found in list(with_lines.items())[:_MOST_COLUMNS]
        )
        more = len(with_lines) - _MOST_COLUMNS
        each += f"; and in {more} more columns" if more > 0 else ""
        said.append(
            Note(
                f"spectral lines, taken out of the noise that the coefficients are read from, largest first, Hz: {each}"
            )
        )
    return said


def _columns(names: list[str]) -> str:
    return f"column{'s' * (len(names) > 1)} {' '.join(names)}"


def moved_columns(recording: Recording, names: list[str], rate: float) -> dict[str, str]:
    """Return the columns whose means over a second range farther than any zero drifts and than noise explains: why."""
    size = max(1, min(round(rate), len(recording)))
    moved: dict[str, float] = {}
    for name in names:
        quantity = parse_unit(recording.units[name]).quantity
        if quantity not in _STILL:
            continue
        samples = recording.si(name)
        means = samples[: len(samples) // size * size].reshape(-1, size).mean(axis=1)
        reach = float(np.ptp(means)) if means.size else 0.0
        noise = float(np.diff(samples).std()) / math.sqrt(2 * size)
        if reach > max(_STILL[quantity][0], _NOISE_REACH * noise):
            moved[name] = reach
    reasons: dict[str, str] = {}
    for quantity, (_, unit) in _STILL.items():
        reaches = {n: r for n, r in moved.items() if parse_unit(recording.units[n]).quantity == quantity}
        if reaches:
            most = from_si(max(reaches.values()), unit)
            why = f"means over a second range over up to {most:.3g} {unit}: did the unit move?"
            reasons |= dict.fromkeys(reaches, why)
    return reasons
