"""What fusing really buys: every method over one recording, with errors, limit, Allan curves and bandwidth."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from imulab.calibration import Calibration, Covariance
from imulab.errors import DataError, ImulabError
from imulab.gyro_array.fuse import Fused, FuseOptions, fuse, open_stream
from imulab.gyro_array.model import FEWEST_ROBUST, METHODS, Elements, array_calibration, find_elements, fixed_weights
from imulab.noise import allan_deviation, sampling_rate
from imulab.recording import Array, Recording
from imulab.units import parse_unit

_PROBE_SAMPLES = 16_384
_SEGMENT = 256
_HALF_POWER = math.sqrt(0.5)
_TRACE = 800
_QUIET_FACTOR = 3.0
_SHORTEST_QUIET = 5.0
_FILTERED = 0.9
_HALVES = 2 * FEWEST_ROBUST


@dataclass(frozen=True)
class Figures:
    """The figures of one method on one axis; rates in the unit of the readings, angles in that unit times s.

    ``rate_std`` has the mean removed; ``angle_*`` are of the integral of the rate error; ``reduction`` is the mean
    single
    gyro's rate_std over this one; ``over_limit`` the noise from sample to sample over (1' C^-1 1)^-1/2; `bandwidth`
    in Hz
    at -3 dB, half the sampling rate where nothing is filtered.
    """

    rate_std: float
    rate_max: float
    angle_std: float
    angle_max: float
    reduction: float
    over_limit: float
    bandwidth: float
    split_half: float | None = None


@dataclass(frozen=True)
class Comparison:
    """Every method over one recording.

    Attributes
    ----------
    figures
        Method to one `Figures` per axis, or to the reason why it cannot run.
    record
        All of it with curves and traces, as a record that a report can be drawn from.
    warnings
        What a reader must know.
    """

    figures: dict[str, tuple[Figures, ...] | str]
    elements: Elements
    record: Calibration
    warnings: tuple[str, ...]


def compare_methods(recording: Recording, *, calibration: Calibration | None = None) -> Comparison:
    """Run all seven methods over a recording.

    The truth is the column ``truth_rate`` (or ``truth_rate_x`` ..); without it the unit must be still, or still for a
    stretch of 5 s or more: the figures are then of the longest such stretch, and the truth there is 0. With six gyros
    or more the two halves of the array (odd and even elements) are also fused apart; half of the standard deviation of
    their difference estimates the noise of the whole without any truth.

    Raises
    ------
    DataError
        No elements, no time, or neither truth nor a stretch at rest.
    """
    elements = find_elements(recording)
    rate, notes = sampling_rate(recording)
    warnings = [*recording.notes, *notes]
    readings, calibrated = _corrected(recording, elements, calibration)
    truth = elements.truth(recording)
    start, stop = 0, len(recording)
    if truth is None:
        start, stop = _longest_quiet(recording, readings, rate)
        if stop - start < len(recording):
            time = recording.si("time")
            warnings.append(
                f"{recording.name}: no truth_rate: the figures are of the longest stretch at rest, "
                f"{time[start]:.6g} to {time[stop - 1]:.6g} s, with 0 as the truth"
            )
    reference = np.zeros((stop - start, len(elements.axes))) if truth is None else truth[start:stop]
    error = readings[start:stop] - reference[:, :, None]
    limits = _limits(error)
    singles = [float(np.nanmean(np.nanstd(error[:, a], axis=0))) for a in range(len(elements.axes))]
    figures: dict[str, tuple[Figures, ...] | str] = {}
    curves: dict[str, Any] = {}
    angles: dict[str, Any] = {}
    health: dict[str, Any] = {}
    for method in METHODS:
        try:
            options = FuseOptions(method=method, calibration=calibration, rate=rate)
            fused = fuse(recording, options, weights=method == "robust", flags=method == "robust")
            halves = _halves(recording, elements, options, calibration, start, stop)
            bandwidth = _bandwidth(recording, elements, options, calibration, rate)
        except ImulabError as problem:
            figures[method] = str(problem)
            continue
        off = fused.rate[start:stop] - reference
        figures[method] = tuple(
            _figures(off[:, a], rate, singles[a], limits[a], bandwidth[a], None if halves is None else halves[a])
            for a in range(len(elements.axes))
        )
        curves[method] = [_curve(off[:, a], rate) for a in range(len(elements.axes))]
        angles[method] = [_trace(np.cumsum(np.nan_to_num(off[:, a])) / rate) for a in range(len(elements.axes))]
        if method == "robust":
            health = _health(fused, recording)
    warnings += _filtering(figures, rate)
    curves["single gyro"] = [
        _curve(error[:, a, int(np.argsort(np.nanstd(error[:, a], axis=0))[elements.count // 2])], rate)
        for a in range(len(elements.axes))
    ]
    data = {
        "figures": {m: f if isinstance(f, str) else [asdict(x) for x in f] for m, f in figures.items()},
        "allan": curves,
        "angle": angles,
        "trace_time": _trace(recording.si("time")[start:stop]),
        "health": health,
        "single": singles,
        "limit": limits,
        "readings_names": [list(row) for row in elements.names],
    }
    record = Calibration(
        procedure="gyro_array",
        parameters={},
        covariance=Covariance((), ()),
        model={
            "kind": "comparison",
            "elements": elements.count,
            "axes": list(elements.axes),
            "unit": elements.units[0],
            "units": list(elements.units),
            "truth": "column truth_rate" if truth is not None else "a still unit",
            "calibrated": calibrated,
        },
        fit={
            "samples": stop - start,
            "sample_rate": {"value": rate, "unit": "Hz"},
            "duration": {"value": (stop - start) / rate, "unit": "s"},
        },
        data=data,
        sensor={key: recording.metadata[key] for key in ("serial", "model") if key in recording.metadata},
        sources=(recording.source,) if recording.source else (),
        warnings=tuple(warnings),
    )
    return Comparison(figures, elements, record, tuple(warnings))


def rate_figures(error: Array, rate: float) -> tuple[float, float, float, float]:
    """Return std (mean removed) and largest size of a rate error, shape (m,), and the same of its integral."""
    angle = np.cumsum(np.nan_to_num(error)) / rate
    return float(np.nanstd(error)), float(np.nanmax(np.abs(error))), float(angle.std()), float(np.abs(angle).max())


def _figures(
    error: Array, rate: float, single: float, limit: float, bandwidth: float, split_half: float | None
) -> Figures:
    std, largest, angle_std, angle_max = rate_figures(error, rate)
    step = np.diff(error[np.isfinite(error)])
    return Figures(
        rate_std=std,
        rate_max=largest,
        angle_std=angle_std,
        angle_max=angle_max,
        reduction=single / std if std > 0 else 0.0,
        over_limit=float(step.std() / math.sqrt(2)) / limit if limit > 0 else 0.0,
        bandwidth=bandwidth,
        split_half=split_half,
    )


def _corrected(recording: Recording, elements: Elements, calibration: Calibration | None) -> tuple[Array, bool]:
    """Readings with a record's biases and matrices taken off, shape (m, axes, n)."""
    readings = elements.readings(recording)
    if calibration is None:
        return readings, False
    known = array_calibration(calibration, elements)
    readings -= known.bias
    if known.matrices is not None:
        readings = np.einsum("nab,mbn->man", known.matrices, readings)
    return readings, True


def _limits(error: Array) -> list[float]:
    """Limit (1' C^-1 1)^-1/2 of each axis, C the covariance of the noise from sample to sample."""
    found = []
    for a in range(error.shape[1]):
        step = np.diff(error[np.isfinite(error[:, a]).all(axis=1), a], axis=0)
        covariance = step.T @ step / (2 * max(len(step), 1))
        live = np.diag(covariance) > 0
        try:
            found.append(fixed_weights(covariance[np.ix_(live, live)])[1] if live.any() and len(step) > 1 else 0.0)
        except np.linalg.LinAlgError:
            found.append(0.0)
    return [value if math.isfinite(value) else 0.0 for value in found]


def _longest_quiet(recording: Recording, readings: Array, rate: float) -> tuple[int, int]:
    """First sample and last + 1 of the longest stretch in which the array's median hardly moves."""
    middle = np.nanmedian(readings, axis=2)
    size = max(2, round(rate))
    count = len(middle) // size
    windows = np.nan_to_num(middle[: count * size], nan=1e300).reshape(count, size, -1).std(axis=1)
    if count:
        usual = np.quantile(windows, 0.1, axis=0)
        quiet = (windows <= _QUIET_FACTOR * usual).all(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], quiet.astype(int), [0]])))
        runs = edges.reshape(-1, 2)
        best = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))] if len(runs) else np.array([0, 0])
        drift = np.abs(np.diff(np.nanmean(middle[: count * size].reshape(count, size, -1), axis=1), axis=0))
        if (best[1] - best[0]) * size >= _SHORTEST_QUIET * rate and not _moving(drift, usual, size, best):
            stop = len(middle) if best[1] == count else int(best[1]) * size
            return int(best[0]) * size, stop
    raise DataError(
        f"{recording.name}: neither a column truth_rate nor a stretch of {_SHORTEST_QUIET:g} s at rest; "
        "expected one to tell errors from motion"
    )


def _moving(drift: Array, usual: Array, size: int, best: np.ndarray) -> bool:
    """Whether the means of successive windows wander more than the noise within them allows."""
    steps = drift[int(best[0]) : int(best[1]) - 1]
    return bool(len(steps)) and bool((np.median(steps, axis=0) > 10 * usual / math.sqrt(size) + 0.5 * usual).any())


def _halves(
    recording: Recording, elements: Elements, options: FuseOptions, record: Calibration | None, start: int, stop: int
) -> list[float] | None:
    """Standard deviation of the difference of the two halves of the array (odd and even elements), each axis."""
    if elements.count < _HALVES or options.method == "covariance":
        return None
    readings, _ = _corrected(recording, elements, record)
    plain = replace(options, calibration=None)
    rates = []
    for first in (0, 1):
        half = replace(elements, names=tuple(row[first::2] for row in elements.names))
        part = np.ascontiguousarray(readings[:, :, first::2])
        stream = open_stream(plain, half, options.rate or 1.0, part[:10_000])
        rates.append(stream.process(part, flags=False).rate[start:stop])
    apart: Array = rates[0] - rates[1]
    return [float(np.nanstd(difference)) for difference in apart.T]


def _bandwidth(
    recording: Recording, elements: Elements, options: FuseOptions, record: Calibration | None, rate: float
) -> list[float]:
    """Frequency at -3 dB of each axis: response to a small white probe that all gyros see, by its cross-spectrum."""
    readings = elements.readings(recording)[:_PROBE_SAMPLES]
    rng = np.random.default_rng(0)
    size = np.nanmedian(np.nanstd(np.diff(readings, axis=0), axis=0), axis=1)
    probe = rng.standard_normal(readings.shape[:2]) * np.where(size > 0, size, 1.0)
    # The probe is one rate for all: it must look the same through every element's matrix.
    seen = np.repeat(probe[:, :, None], elements.count, axis=2)
    if record is not None:
        matrices = array_calibration(record, elements).matrices
        if matrices is not None:
            seen = np.einsum("nab,mb->man", np.linalg.inv(matrices), probe)
    plain, shaken = (
        open_stream(options, elements, rate, readings).process(np.ascontiguousarray(part)).rate
        for part in (readings, readings + seen)
    )
    response = shaken - plain
    skip = len(response) // 4
    found = []
    for a in range(len(elements.axes)):
        gain = _transfer(probe[skip:, a], np.nan_to_num(response[skip:, a]))
        frequency = np.linspace(0, rate / 2, len(gain))
        below = np.flatnonzero(gain[1:] < _HALF_POWER)
        if not below.size:
            found.append(rate / 2)
            continue
        k = int(below[0]) + 1
        high, low = gain[k - 1], gain[k]
        share = (high - _HALF_POWER) / (high - low) if high > _HALF_POWER else 0.0
        found.append(float(frequency[k - 1] + share * (frequency[k] - frequency[k - 1])))
    return found


def _transfer(probe: Array, response: Array) -> Array:
    """Size of the transfer function, averaged over half-overlapping windowed segments (Welch)."""
    size = min(_SEGMENT, len(probe))
    window = np.hanning(size)
    starts = range(0, len(probe) - size + 1, size // 2)
    spectra = [
        (np.fft.rfft(window * probe[s : s + size]), np.fft.rfft(window * response[s : s + size])) for s in starts
    ]
    cross = sum(np.conj(p) * r for p, r in spectra)
    own = sum(np.abs(p) ** 2 for p, _ in spectra)
    gain: Array = np.abs(cross) / np.maximum(own, 1e-300)
    return gain


def _curve(error: Array, rate: float) -> dict[str, Any]:
    curve = allan_deviation(np.nan_to_num(error, nan=float(np.nanmean(error))), rate)
    return {"tau": curve.tau.tolist(), "deviation": curve.deviation.tolist(), "u": curve.standard_uncertainty.tolist()}


def _trace(values: Array) -> list[float]:
    step = max(1, -(-len(values) // _TRACE))
    thinned: list[float] = np.round(values[::step], 9).tolist()
    return thinned


def _health(fused: Fused, recording: Recording) -> dict[str, Any]:
    """Share of each stretch in which each gyro was in use, and its weight, for the figure over time."""
    weights, flags = fused.weights, fused.flags
    if weights is None or flags is None:
        return {}
    pieces = min(240, len(weights))
    edges = np.linspace(0, len(weights), pieces + 1).astype(int)[:-1]
    time = recording.si("time")
    counts = np.diff(np.append(edges, len(weights)))[:, None, None]
    return {
        "time": np.round(time[edges], 6).tolist(),
        "weight": np.round(np.add.reduceat(weights, edges, axis=0) / counts, 4).tolist(),
        "flags": np.bitwise_or.reduceat(flags, edges, axis=0).tolist(),
        "lines": fused.health.lines(),
    }


def _filtering(figures: dict[str, tuple[Figures, ...] | str], rate: float) -> list[str]:
    """Warn where less noise comes from a low-pass filter."""
    found = []
    for method, rows in figures.items():
        if isinstance(rows, str):
            continue
        for row in rows:
            if row.bandwidth < _FILTERED * rate / 2:
                found.append(
                    f"{method}: its bandwidth is {row.bandwidth:.3g} Hz of {rate / 2:.3g} Hz: where its rate "
                    f"noise is lower "
                    "that is low-pass filtering, which does not lower the angle error"
                )
                break
    return found


def output_unit(unit: str) -> tuple[str, float]:
    """Return the unit of angles for a unit of rates, and the factor from that rate times s to it."""
    known = parse_unit(unit).symbol
    return {"deg/s": ("deg", 1.0), "rad/s": ("rad", 1.0), "deg/h": ("deg", 1 / 3600)}.get(known, (f"{known} s", 1.0))
