"""Comparison of all methods of fusion over one recording, or over the source's experiments: errors and bandwidths."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import msgspec
import numpy as np

from imulab.device import METHODS
from imulab.display import Finding, Note, prefixed
from imulab.errors import DataError, ImulabError, OptionError, listed
from imulab.estimation.decisions import METHOD_FOLLOWS_LESS
from imulab.estimation.noise_coefficients import allan_deviation
from imulab.estimation.rows import MAD_TO_SIGMA
from imulab.estimation.sampling import sampling_rate
from imulab.procedures.gyro_array import EXPERIMENTS, OF_THE_SOURCE
from imulab.procedures.gyro_array.elements import (
    EXCLUDED,
    FEWEST_ROBUST,
    JUMPED,
    NON_FINITE,
    STUCK,
    Checks,
    Elements,
    array_calibration,
    feedback_notes,
    find_elements,
    fixed_weights,
    on_one_clock,
)
from imulab.procedures.gyro_array.figures import comparison_exhibits
from imulab.procedures.gyro_array.fit import calibrate_array
from imulab.procedures.gyro_array.fuse import Fused, fuse, warn_misaligned
from imulab.procedures.gyro_array.schema import MethodRow
from imulab.procedures.gyro_array.simulate import NoiseModel, simulate_array
from imulab.procedures.gyro_array.stream import FuseOptions, memory_text, open_stream
from imulab.procedures.result import Drawn
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, warn_other_unit
from imulab.report.traces import Exhibits

# What a comparison is made against: the working gyros, and the least noise of any fixed weights.


_IN_USE = 0.5  # share of the time: a gyro in use for less is left out of a comparison
_FEWEST = 2  # elements with a common time


@dataclass(frozen=True)
class Singles:
    """The single gyros of one axis.

    Attributes
    ----------
    working
        Whether each gyro counts, shape (n,): never stuck or jumped, finite and in use under `robust` in at least half
        of the samples.
    noise
        Mean of their standard deviations of the rate error, each over the samples in which the gyro was in use.
    limit
        (1' C^-1 1)^-1/2, C the covariance of the sample-to-sample noise of all gyros in use in at least half of the
        samples; 0 where it is unknown.
    middle
        Number of the gyro with the median noise.
    """

    working: np.ndarray
    noise: float
    limit: float
    middle: int


def single_gyros(error: Array, flags: np.ndarray | None) -> Singles:
    """Return noise and limit of the single gyros of one axis.

    A gyro that failed does not count: with it, the mean would be the size of the fault. Where none works, or health is
    not known, every gyro with a finite reading counts.

    Parameters
    ----------
    error
        Readings less the truth, shape (m, n).
    flags
        Health under `robust`, shape (m, n), or None.
    """
    used: np.ndarray = np.isfinite(error)
    if flags is not None:
        used = used & ((flags & (NON_FINITE | EXCLUDED)) == 0)
    there: np.ndarray = np.mean(used, axis=0) >= _IN_USE
    working = there.copy()
    if flags is not None:
        working &= ((flags & (STUCK | JUMPED)) == 0).all(axis=0)
    if not working.any():
        used = np.isfinite(error)
        there = working = np.any(used, axis=0)
    noise = np.full(len(working), np.nan)
    for i in np.flatnonzero(working):
        noise[i] = error[used[:, i], i].std()
    order = [int(i) for i in np.argsort(noise) if working[i]]
    return Singles(
        working=working,
        noise=float(np.mean(noise[working])) if working.any() else 0.0,
        limit=_limit(np.where(used, error, np.nan)[:, there]),
        middle=order[len(order) // 2] if order else 0,
    )


def _limit(error: Array) -> float:
    """Return the limit for errors with NaN where a gyro was not in use, each pair over the samples that it shares."""
    step = np.diff(error, axis=0)
    known = np.isfinite(step)
    step = np.where(known, step, 0.0)
    shared = known.T.astype(np.float64) @ known
    covariance = step.T @ step / np.maximum(2 * shared, 1)
    live = np.diag(covariance) > 0
    if not live.any() or shared.min() < _FEWEST:
        return 0.0
    try:
        limit = fixed_weights(covariance[np.ix_(live, live)])[1]
    except np.linalg.LinAlgError:
        return 0.0
    return limit if math.isfinite(limit) else 0.0


# Response of a method to a small white probe that is added to all gyros.


_PROBE_SAMPLES = 16_384  # samples over which the response of a method is measured
_SEGMENT = 256  # samples of a spectrum
_HALF_POWER = math.sqrt(0.5)
_FROZEN, _UNUSUAL = 0.5, 20.0  # a gyro is frozen from so many s, and times as long as usual
_FOLLOWED = 0.95  # of the time in which an element must move to be counted
_FEWEST_PAIRS = 4  # fewest segments whose scatter gives the uncertainty of a response


@dataclass(frozen=True)
class Response:
    """Bandwidth, Hz, at -3 dB (half the sampling rate where nothing is filtered), and gain for slow motion.

    `gain_uncertainty` is the standard uncertainty of the gain, `blind` the gyros that do not move.
    """

    bandwidth: float
    gain: float
    gain_uncertainty: float
    blind: tuple[str, ...] = ()


def responses(
    readings: Array, elements: Elements, options: FuseOptions, record: Calibration | None, rate: float
) -> list[Response]:
    """Return the response of each axis.

    The method runs with and without the probe: |S_pr| / S_pp of probe p and response r (Welch, windowed segments that
    overlap by half). The probe is as large as the gyros' noise. It is not added to a gyro that repeats a reading for
    longer than the steps of its output explain (`_frozen`), because a dead gyro sees no motion.

    Parameters
    ----------
    readings
        As logged, shape (m, axes, n); the first 16,384 samples are used.
    record
        Calibration in `options`, if any: the probe then goes through the elements' matrices.
    """
    readings = readings[:_PROBE_SAMPLES]
    step = np.diff(readings, axis=0)
    rng = np.random.default_rng(0)
    probe = rng.standard_normal(readings.shape[:2]) * _noise(step)
    shaken_by = np.repeat(probe[:, :, None], elements.count, axis=2)
    if record is not None:
        matrices = array_calibration(record, elements).matrices
        if matrices is not None:
            shaken_by = np.einsum("nab,mb->man", np.linalg.inv(matrices), probe)
    frozen = _frozen(step, rate)
    shaken_by[frozen] = 0.0
    plain, shaken = (
        open_stream(options, elements, rate, readings).process(np.ascontiguousarray(part)).rate
        for part in (readings, readings + shaken_by)
    )
    response = shaken - plain
    skip = len(response) // 4
    edges = []
    for a in range(len(elements.axes)):
        gain, uncertainty = _transfer(probe[skip:, a], np.nan_to_num(response[skip:, a]))
        frequency = np.linspace(0, rate / 2, len(gain))
        below = np.flatnonzero(gain[1:] < _HALF_POWER)
        edge = rate / 2
        if below.size:
            k = int(below[0]) + 1
            high, low = gain[k - 1], gain[k]
            share = (high - _HALF_POWER) / (high - low) if high > _HALF_POWER else 0.0
            edge = float(frequency[k - 1] + share * (frequency[k] - frequency[k - 1]))
        blind = tuple(name for i, name in enumerate(elements.names[a]) if frozen[:, a, i].mean() > 1 - _FOLLOWED)
        edges.append(Response(edge, float(gain[0]), uncertainty, blind))
    return edges


def _noise(step: Array) -> Array:
    """Return the usual noise of the gyros on each axis, from the median of their changes, shape (axes,); 1 if none.

    It is that of the median gyro: neither spikes nor a turn in a part of the recording enlarge the probe.
    """
    sigma = np.ones(step.shape[1])
    for a in range(step.shape[1]):
        sizes = [np.median(np.abs(column[np.isfinite(column)])) for column in step[:, a].T if np.isfinite(column).any()]
        size = MAD_TO_SIGMA * float(np.median(sizes)) / math.sqrt(2) if sizes else 0.0
        sigma[a] = size if size > 0 else 1.0
    return sigma


def _frozen(step: Array, rate: float) -> np.ndarray:
    """Return whether a gyro repeats its reading at a sample, shape (m, axes, n), from its changes between samples.

    A repeat lasts half a second or more, and 20 times as long as usual for that gyro: a healthy gyro whose steps are as
    large as its noise repeats readings too.
    """
    same = np.concatenate([np.zeros((1, *step.shape[1:]), dtype=bool), step == 0])
    frozen = np.zeros(same.shape, dtype=bool)
    for a, i in np.ndindex(*same.shape[1:]):
        changes = np.append(np.flatnonzero(~same[:, a, i]), len(same))
        runs = np.diff(changes)
        long = (runs > _FROZEN * rate) & (runs > _UNUSUAL * np.median(runs) * (len(runs) > 1))
        frozen[:, a, i] = np.repeat(long, runs)
    return frozen


def _transfer(probe: Array, response: Array) -> tuple[Array, float]:
    """Return the size of the transfer function, by windowed segments that overlap by half (Welch), and u at its start.

    The uncertainty is a jackknife that leaves out pairs of overlapping segments.
    """
    size = min(_SEGMENT, len(probe))
    window = np.hanning(size)
    starts = range(0, len(probe) - size + 1, max(1, size // 2))
    spectra = [
        (np.fft.rfft(window * probe[s : s + size]), np.fft.rfft(window * response[s : s + size])) for s in starts
    ]
    cross = np.array([np.conj(p) * r for p, r in spectra])
    power = np.array([np.abs(p) ** 2 for p, _ in spectra])
    gain: Array = np.abs(cross.sum(axis=0)) / np.maximum(power.sum(axis=0), 1e-300)
    pairs = np.arange(0, len(spectra), 2)
    if len(pairs) < _FEWEST_PAIRS:
        return gain, math.inf
    left = [np.add.reduceat(part[:, 0], pairs) for part in (cross, power)]
    without = np.abs(cross[:, 0].sum() - left[0]) / np.maximum(power[:, 0].sum() - left[1], 1e-300)
    return gain, float(np.sqrt((len(pairs) - 1) / len(pairs) * ((without - without.mean()) ** 2).sum()))


# The comparison: errors, limit, Allan curves and bandwidth of every method.


_TRACE = 800  # points of a drawing
_QUIET_FACTOR = 3.0  # times the usual scatter up to which a window is quiet
_SHORTEST_QUIET = 5.0  # s of rest over which methods are compared where no truth is known
_FILTERED = 0.9  # of half the sampling rate: a lower bandwidth is filtering
_BEYOND_LIMIT = 0.97  # of the least noise that weights can reach: less noise is filtering
_FOLLOWS, _FINEST = 0.95, 0.01  # share of a motion that a method must follow; least uncertainty of it that is shown
_FAR = 3.0  # times the noise: gyros that scatter by more about the fused rate contradict their record
_NOTHING = 1e-9  # of a gyro's noise: less is rounding
_HALVES = 2 * FEWEST_ROBUST  # elements of which both halves can be fused robustly


@dataclass(frozen=True, repr=False)
class Comparison(Drawn):
    """Comparison of every method over one recording.

    Attributes
    ----------
    figures
        By method: a `MethodRow` for each axis, or the reason why the method cannot run.
    record
        Figures, curves and traces as a record, from which a report is made.
    warnings
        Messages for the user.
    """

    figures: dict[str, tuple[MethodRow, ...] | str]
    elements: Elements
    record: Calibration
    warnings: tuple[str, ...]

    subject: ClassVar[str] = "Methods of fusion"

    def exhibits(self) -> Exhibits:
        """Return what its report shows."""
        return comparison_exhibits(self.record)

    def __repr__(self) -> str:
        lines = [f"Comparison of {len(self.figures)} methods, rate std in {' '.join(self.elements.units)}"]
        for method, rows in self.figures.items():
            text = rows if isinstance(rows, str) else " ".join(f"{axis.rate_std:.4g}" for axis in rows)
            lines.append(f"  {method:13}  {text[:120]}")
        return "\n".join(lines)


def compare_methods(
    recording: Recording,
    *,
    calibration: Calibration | None = None,
    memory: str | float = "growing",
    count_from: int = 1,
) -> Comparison:
    """Return the figures of all seven methods over a recording; `memory` and `count_from` as in `FuseOptions`.

    The truth is the column ``truth_rate`` (or ``truth_rate_x`` ..); without it the unit must be still, or still for a
    stretch of 5 s or more: the figures are then of the longest such stretch, and the truth there is 0. With six gyros
    or more the two halves of the array (odd and even elements) are also fused apart; half of the standard deviation of
    their difference estimates the noise of the whole without any truth. A single gyro is the mean of those that work
    (`single_gyros`).

    Raises
    ------
    DataError
        No elements, no time, an axis without a finite reading, or neither truth nor a stretch at rest.
    """
    recording = on_one_clock(recording)
    elements = find_elements(recording)
    rate, notes = sampling_rate(recording)
    warnings = [*(prefixed(recording.name, note) for note in recording.notes), *notes]
    warnings += [] if calibration is None else warn_other_unit(calibration.sensor, recording)
    logged = elements.readings(recording)
    readings, matrices = _correct_readings(logged, recording, elements, calibration)
    for a, row in enumerate(elements.names):
        if not np.isfinite(logged[:, a]).any():
            raise DataError(f"{recording.name}: columns {row[0]} to {row[-1]}: expected finite readings, found none")
    checks = Checks(elements.names)
    checks.watch(logged)
    lines = [*checks.lines(turned=matrices is None), *warn_misaligned(checks, matrices)]
    warnings += [prefixed(recording.name, line) for line in lines]
    truth = elements.truth(recording)
    start, stop = (0, len(recording)) if truth is not None else _longest_quiet(recording, readings, rate)
    if stop - start < len(recording):
        time = recording.si("time")
        text = f"{recording.name}: no truth_rate: the figures are of the longest stretch at rest, "
        warnings.append(Note(f"{text}{time[start]:.6g} to {time[stop - 1]:.6g} s, with 0 as the truth"))
    reference = np.zeros((stop - start, len(elements.axes))) if truth is None else truth[start:stop]
    options = partial(FuseOptions, memory=memory, start=count_from, rate=rate)
    runs = _run_methods(recording, elements, logged, readings, options, calibration, slice(start, stop))
    figures, data = _evaluate(recording, elements, runs, readings, reference, rate, slice(start, stop))
    warnings += _warn_robust(recording.name, readings, runs.rates.get("robust"), corrected=calibration is not None)
    warnings += _warn_filtering(figures, runs.response, rate)
    if not isinstance(figures["feedback"], str):
        warnings += [prefixed(recording.name, line) for line in feedback_notes(elements.count, rate)]
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
            "calibrated": calibration is not None,
            "memory": memory_text(memory, count_from),
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


@dataclass(frozen=True)
class _Runs:
    """By method: rates, difference of the halves, response, or the reason why it cannot run."""

    rates: dict[str, Fused] = field(default_factory=dict)
    halves: dict[str, list[float | None]] = field(default_factory=dict)
    response: dict[str, list[Response]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)


def _run_methods(
    recording: Recording, elements: Elements, logged: Array, readings: Array, options: Callable[..., FuseOptions],
    calibration: Calibration | None, part: slice,
) -> _Runs:  # fmt: skip
    """Return the results of all methods over a recording; halves and response are of a part of it."""
    runs = _Runs()
    lost = ~np.isfinite(readings).any(axis=2)
    for method in METHODS:
        try:
            chosen = options(method=method, calibration=calibration)
            fused = fuse(recording, chosen, weights=method == "robust", flags=method == "robust")
            spoilt = (np.isnan(fused.rate) & ~lost).any(axis=1)
            if spoilt.any():
                runs.failed[method] = (
                    f"its output is no number from {fused.time[int(np.argmax(spoilt))]:.6g} s on: a reading that is "
                    "none spoils it"
                )
                continue
            runs.halves[method] = _half_differences(readings, elements, chosen, part)
            runs.response[method] = responses(logged[part], elements, chosen, calibration, chosen.rate or 1.0)
            runs.rates[method] = fused
        except ImulabError as problem:
            runs.failed[method] = str(problem)
    return runs


def _evaluate(
    recording: Recording, elements: Elements, runs: _Runs, readings: Array, reference: Array, rate: float, part: slice
) -> tuple[dict[str, tuple[MethodRow, ...] | str], dict[str, Any]]:
    """Return the figures of each method against the truth of a part, and the data of the record."""
    axes = range(len(elements.axes))
    error = readings[part] - reference[:, :, None]
    known = runs.rates["robust"].flags if "robust" in runs.rates else None
    singles = [single_gyros(error[:, a], None if known is None else known[part, a]) for a in axes]
    off = {method: fused.rate[part] - reference for method, fused in runs.rates.items()}
    evaluated: dict[str, tuple[MethodRow, ...] | str] = {
        m: tuple(
            _figures(wrong[:, a], rate, singles[a], runs.response[m][a].bandwidth, runs.halves[m][a]) for a in axes
        )
        for m, wrong in off.items()
    }
    evaluated |= runs.failed
    figures = {method: evaluated[method] for method in METHODS}
    curves: dict[str, Any] = {m: [_curve(wrong[:, a], rate) for a in axes] for m, wrong in off.items()}
    curves["single gyro"] = [_curve(error[:, a, singles[a].middle], rate) for a in axes]
    return figures, {
        "figures": {
            m: f if isinstance(f, str) else [msgspec.structs.asdict(row) for row in f] for m, f in figures.items()
        },
        "allan": curves,
        "angle": {m: [_trace(np.cumsum(np.nan_to_num(wrong[:, a])) / rate) for a in axes] for m, wrong in off.items()},
        "trace_time": _trace(recording.si("time")[part]),
        "health": _health(runs.rates["robust"], recording) if "robust" in runs.rates else {},
        "single": [single.noise for single in singles],
        "limit": [single.limit for single in singles],
        "working": [
            [name for name, works in zip(row, single.working, strict=True) if works]
            for row, single in zip(elements.names, singles, strict=True)
        ],
        "readings_names": [list(row) for row in elements.names],
    }


def rate_figures(error: Array, rate: float) -> tuple[float, float, float, float]:
    """Return std (mean removed) and largest size of a rate error, shape (m,), and the same of its integral."""
    angle = np.cumsum(np.nan_to_num(error)) / rate
    return float(np.nanstd(error)), float(np.nanmax(np.abs(error))), float(angle.std()), float(np.abs(angle).max())


def _figures(error: Array, rate: float, single: Singles, bandwidth: float, split_half: float | None) -> MethodRow:
    """Return the figures of a method on one axis, as `MethodRow` defines them, from its error of the rate, (m,)."""
    std, largest, angle_std, angle_max = rate_figures(error, rate)
    noise = float(np.diff(error[np.isfinite(error)]).std() / math.sqrt(2))
    if std <= _NOTHING * single.noise:  # rounding only: the method follows a dead gyro
        std = noise = 0.0
    limit = single.limit
    return MethodRow(
        rate_std=std,
        rate_max=largest,
        angle_std=angle_std,
        angle_max=angle_max,
        reduction=single.noise / std if std > 0 else None,
        over_limit=noise / limit if limit > 0 else 0.0,
        bandwidth=bandwidth,
        split_half=split_half,
    )


def _correct_readings(
    logged: Array, recording: Recording, elements: Elements, calibration: Calibration | None
) -> tuple[Array, Array | None]:
    """Return readings without a record's biases and through its matrices, (m, axes, n), and these."""
    if calibration is None:
        return logged, None
    known = array_calibration(calibration, elements, recording.name)
    readings = logged - known.bias
    if known.matrices is None:
        return readings, None
    return np.einsum("nab,mbn->man", known.matrices, readings), known.matrices


def _longest_quiet(recording: Recording, readings: Array, rate: float) -> tuple[int, int]:
    """Return the first sample, and the last + 1, of the longest stretch in which the array's median hardly moves."""
    middle = _medians(readings)
    size = max(2, round(rate))
    count = len(middle) // size
    windows = middle[: count * size].reshape(count, size, -1).std(axis=1)  # NaN where no gyro was left
    whole = np.isfinite(windows).all(axis=1)
    if whole.any():
        usual = np.quantile(windows[whole], 0.1, axis=0)
        quiet = (windows <= _QUIET_FACTOR * usual).all(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], quiet.astype(int), [0]])))
        runs = edges.reshape(-1, 2)
        best = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))] if len(runs) else np.array([0, 0])
        drift = np.abs(np.diff(middle[: count * size].reshape(count, size, -1).mean(axis=1), axis=0))
        if (best[1] - best[0]) * size >= _SHORTEST_QUIET * rate and not _wanders(drift, usual, size, best):
            stop = len(middle) if best[1] == count else int(best[1]) * size
            return int(best[0]) * size, stop
    raise DataError(
        f"{recording.name}: neither a column truth_rate nor a stretch of {_SHORTEST_QUIET:g} s at rest; "
        "expected one to tell errors from motion"
    )


def _medians(readings: Array) -> Array:
    """Return the median over the finite readings of each sample, shape (m, axes); NaN where there is none."""
    count = np.isfinite(readings).sum(axis=2)
    ordered = np.sort(np.where(np.isfinite(readings), readings, np.nan), axis=2)  # nan goes to the end
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    last = readings.shape[2] - 1
    pair = [np.take_along_axis(ordered, np.minimum(k, last)[..., None], axis=2)[..., 0] for k in (low, high)]
    middle: Array = (pair[0] + pair[1]) / 2
    return middle


def _wanders(drift: Array, usual: Array, size: int, best: np.ndarray) -> bool:
    """Return whether the means of successive windows wander more than the noise within them explains."""
    steps = drift[int(best[0]) : int(best[1]) - 1]
    return bool(len(steps)) and bool((np.median(steps, axis=0) > 10 * usual / math.sqrt(size) + 0.5 * usual).any())


def _half_differences(readings: Array, elements: Elements, options: FuseOptions, kept: slice) -> list[float | None]:
    """Return the standard deviation of the difference of the halves (odd and even elements) on each axis."""
    if elements.count < _HALVES or options.method == "covariance":
        return [None] * len(elements.axes)
    plain = replace(options, calibration=None)
    rates = []
    for first in (0, 1):
        half = replace(elements, names=tuple(row[first::2] for row in elements.names))
        part = np.ascontiguousarray(readings[:, :, first::2])
        stream = open_stream(plain, half, options.rate or 1.0, part[:10_000])
        rates.append(stream.process(part, flags=False).rate[kept])
    apart: Array = rates[0] - rates[1]
    return [float(np.nanstd(column)) if np.isfinite(column).any() else None for column in apart.T]


def _curve(error: Array, rate: float) -> dict[str, Any]:
    finite = np.isfinite(error)
    curve = allan_deviation(np.where(finite, error, error[finite].mean() if finite.any() else 0.0), rate)
    return {"tau": curve.tau.tolist(), "deviation": curve.deviation.tolist(), "u": curve.standard_uncertainty.tolist()}


def _trace(values: Array) -> list[float]:
    step = max(1, -(-len(values) // _TRACE))
    thinned: list[float] = np.round(values[::step], 9).tolist()
    return thinned


def _health(fused: Fused, recording: Recording) -> dict[str, Any]:
    """Return, for the figure over time, the share of each stretch in which each gyro was in use, and its weight."""
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


def _warn_robust(name: str, readings: Array, robust: Fused | None, *, corrected: bool) -> list[str]:
    """Return a line for each gyro that failed, and one where corrected readings scatter by far more than from noise."""
    if robust is None or robust.flags is None:
        return []
    lines = robust.health.lines()
    if not corrected:
        return lines
    used = np.isfinite(readings) & ((robust.flags & (NON_FINITE | EXCLUDED)) == 0)
    off = np.where(used, readings - robust.rate[:, :, None], np.nan)
    for names, unit, apart in zip(robust.elements.names, robust.elements.units, np.moveaxis(off, 1, 0), strict=True):
        known = np.isfinite(apart).sum(axis=0) >= _IN_USE * len(apart)
        if not known.any():
            continue
        scatter = np.nanstd(apart[:, known], axis=0)
        noise = np.nanstd(np.diff(apart[:, known], axis=0), axis=0) / math.sqrt(2)
        times = float(np.median(scatter / np.maximum(noise, 1e-300)))
        if times > _FAR:
            lines.append(
                Finding(
                    f"{name}: {names[0]} to {names[-1]}, corrected by the record, scatter about the robust rate by "
                    f"{np.median(scatter):.3g} {unit}, {times:.3g} times their noise: the record does not hold for "
                    "this recording",
                    "calibrate the array again, with --moving",
                )
            )
    return lines


def _warn_filtering(
    figures: dict[str, tuple[MethodRow, ...] | str], response: dict[str, list[Response]], rate: float
) -> list[str]:
    """Return warnings where lower noise comes from not following motion: its fast part (low-pass filter), or all."""
    messages: list[str] = []
    for method, rows in figures.items():
        if isinstance(rows, str):
            continue
        slow = min(response[method], key=lambda answer: answer.gain)
        narrow = min(row.bandwidth for row in rows)
        beyond = min((row.over_limit for row in rows if row.over_limit > 0), default=1.0)
        if slow.gain + METHOD_FOLLOWS_LESS.limit * slow.gain_uncertainty < _FOLLOWS:
            verbs = "does not move and counts" if len(slow.blind) == 1 else "do not move and count"
            why = f": {' '.join(slow.blind)} {verbs} in it"
            messages.append(
                Finding(
                    f"{method}: it follows only {slow.gain:.2f} ± {max(slow.gain_uncertainty, _FINEST):.2f} of a motion"
                    f"{why if slow.blind else ''}",
                    "compare with the other methods before you use this one",
                )
            )
        elif narrow < _FILTERED * rate / 2:
            messages.append(
                Finding(
                    f"{method}: its bandwidth is {narrow:.3g} Hz of {rate / 2:.3g} Hz: where its rate noise is lower "
                    "that is low-pass filtering, which does not lower the angle error",
                    "compare the angle errors, not the rate noise",
                )
            )
        elif beyond < _BEYOND_LIMIT:
            messages.append(
                Finding(
                    f"{method}: its noise from sample to sample is {beyond:.2f} of the least that weights can reach: "
                    "that is low-pass filtering, which does not lower the angle error",
                    "compare the angle errors, not the rate noise",
                )
            )
    return messages


# The source's two experiments over many seeds: every method with and without a calibrated start.


CALIBRATION_TIME = 60.0
"""Duration of the recording at rest that a calibrated start comes from, s."""


@dataclass(frozen=True)
class ExperimentRow:
    """Medians over the seeds for one method: rate error, deg/s, and angle error, deg, each as std and largest."""

    method: str
    calibrated: bool
    rate_std: float
    rate_max: float
    angle_std: float
    angle_max: float


def run_experiment(
    experiment: str,
    *,
    seeds: int = 20,
    noise: NoiseModel | None = None,
    methods: tuple[str, ...] = METHODS,
    progress: Callable[[int], None] = lambda _: None,
) -> list[ExperimentRow]:
    """Return the results of one of the source's set-ups (6 gyros) over many seeds.

    A calibrated start takes the biases, and for `covariance` and `kalman` the noise, from 60 s at rest before the run.

    Raises
    ------
    OptionError
        The experiment is unknown, or there is no seed.
    """
    if experiment not in OF_THE_SOURCE:
        raise OptionError(f"experiment {experiment!r}: expected one of {listed(OF_THE_SOURCE, experiment)}")
    if not 1 <= seeds <= 10_000:
        raise OptionError(f"seeds {seeds}: expected 1 to 10000")
    rate = EXPERIMENTS[experiment][0]
    by_method: dict[tuple[str, bool], list[tuple[float, float, float, float]]] = {}
    for seed in range(1, seeds + 1):
        recording = simulate_array(experiment=experiment, seed=seed, **vars(noise or NoiseModel()))
        # The stretch at rest comes first; the same gyros with the same turn-on biases.
        still = simulate_array(
            experiment="static",
            rate=rate,
            duration=CALIBRATION_TIME,
            session=1,
            seed=seed,
            **vars(noise or NoiseModel()),
        )
        record = calibrate_array(still).calibration
        elements = find_elements(recording)
        readings = elements.readings(recording)
        truth = elements.truth(recording)
        assert truth is not None
        for method in methods:
            for calibrated in (False, True):
                if method == "covariance" and not calibrated:
                    continue
                start = record if calibrated and method == "feedback" else "first"
                options = FuseOptions(
                    method=method,
                    initial_bias=start,
                    calibration=record if calibrated and method != "feedback" else None,
                )
                stream = open_stream(options, elements, rate, readings[:10_000])
                error = stream.process(readings, flags=False).rate[:, 0] - truth[:, 0]
                by_method.setdefault((method, calibrated), []).append(rate_figures(error, rate))
        progress(seed)
    return [
        ExperimentRow(method, calibrated, *map(float, np.median(np.array(values), axis=0)))
        for (method, calibrated), values in sorted(by_method.items(), key=lambda item: item[0][1])
    ]
