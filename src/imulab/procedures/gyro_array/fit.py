"""Calibration of an array's elements: biases and noise at rest, alignment in motion (see `alignment`)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from imulab.device.tables import Fusion
from imulab.display import Bad, Finding, Note, prefixed
from imulab.errors import DataError, ObservabilityError, OptionError, UnitError, first_of
from imulab.estimation._allan import integrate
from imulab.estimation.column_noise import noise_lines
from imulab.estimation.decisions import SCALE_OFF_UNIT
from imulab.estimation.noise_coefficients import COEFFICIENTS, DeviationCurve, coefficients_dict
from imulab.estimation.rows import LeftOut, find_step, leave_out, stuck_message, stuck_run
from imulab.estimation.sampling import sampling_rate
from imulab.procedures.gyro_array.alignment import (
    Alignment,
    AtRest,
    align_in_time,
    at_rest,
    bend_notes,
    latency_notes,
    slower_noise,
    slower_noise_text,
)
from imulab.procedures.gyro_array.elements import (
    ROWS_AT_ONCE,
    Checks,
    Elements,
    feedback_notes,
    find_elements,
    find_rest,
    fixed_weights,
    on_one_clock,
)
from imulab.procedures.result import Result
from imulab.recording import Array, Recording, check_finite, check_time, release
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.units import parse_unit, to_si

_FEWEST_SAMPLES = 200  # at rest whose variances are known
_FEWEST_DIFFERENCES = 4  # per element, for the covariance matrix
_OVERLAP = 8  # windows that begin within the length of one
_CLIPPED_RUN = 3  # equal readings in a row at an end of the range that show a clipped output
_HARMFUL_STEP = 5.0  # times the uncertainty of a bias, in the median of all gyros
_SHARED = 0.5  # mean correlation of the elements' noise from which a warning is given


@dataclass(frozen=True, repr=False)
class ArrayFit(Result):
    """A calibration of an array, with the Allan curves behind it, axis by axis.

    Examples
    --------
    >>> import imulab as il
    >>> still = il.simulate_array(experiment="static", duration=60.0)
    >>> fit = il.calibrate_array(still)
    >>> len(fit.curves), len(fit.curves[0])  # one axis of six gyros
    (1, 6)
    """

    calibration: Calibration
    curves: tuple[tuple[DeviationCurve, ...], ...]


def calibrate_array(
    still: Recording,
    moving: Recording | None = None,
    *,
    averaging_time: float = 1.0,
    serial: str | None = None,
    fusion: Fusion | None = None,
    noise: Calibration | None = None,
) -> ArrayFit:
    """Return the calibration of an array's elements from a recording at rest and, if there is one, one in motion.

    At rest, in the longest such stretch: each element's bias is its mean, with the part common to all; N, B, K come
    from the model of its noise, and so does the uncertainty of the bias, unless `noise` is stated; the covariance
    matrix at `averaging_time` is half the mean of the products of successive differences of means (the Allan
    covariance; Vaccaro and Zaki 2017). In motion: `align`.

    Parameters
    ----------
    still, moving
        Recordings with the columns gyro_1 .. (or gyro_x_1 ..) in rad/s, deg/s or deg/h.
    averaging_time
        Averaging time of the covariance matrix, s.
    fusion
        Method and memory that `array fuse` and `export` take from the record; robust and growing if None.
    noise
        Noise record of the same gyros, for the uncertainties of the biases; the noise of `still` if None.

    Raises
    ------
    DataError
        Samples that are not finite, a dead element, too few samples, no stretch at rest (`find_rest`).
    UnitError
        The elements have different units, or none of rate.
    ObservabilityError
        The motion does not excite every axis.
    """
    still = on_one_clock(still)
    elements = find_elements(still)
    for unit in elements.units:
        if parse_unit(unit).quantity != "rate":
            raise UnitError(f"{still.name}: array calibrate needs rates, rad/s deg/s deg/h; found {unit}")
    if elements.count < 2:
        raise DataError(f"{still.name}: {elements.count} element on each axis; expected 2 or more")
    if not averaging_time > 0:
        raise OptionError(f"averaging time {averaging_time:g} s: expected more than 0")
    checks = _check_readings(still, elements)
    _refuse_stuck(still, elements)
    left_out = _bridge_rows(still, elements)
    warnings = [prefixed(still.name, note) for note in still.notes]
    warnings += [prefixed(still.name, note) for note in left_out.notes()]
    still, cut, (rate, timing) = _still_part(left_out, elements)
    warnings += cut
    if cut or left_out.kinds:
        checks = _check_readings(still, elements)
    rest, notes = at_rest(still, rate, elements, noise)
    warnings += [*(prefixed(still.name, line) for line in notes), *timing]
    aligned = None
    if moving is not None:
        aligned, more = _align_in_motion(moving, elements, rest)
        warnings += more
    warnings += [prefixed(still.name, line) for line in checks.units()]
    covariance, used, count = _allan_covariance(still, elements, rest, aligned, averaging_time)
    if used < averaging_time * 0.999:
        warnings.append(
            Note(
                f"{still.name}: {rest.duration:.4g} s at rest are too short for a covariance at {averaging_time:g} s: "
                f"taken at {used:.3g} s"
            )
        )
    noises = {elements.names[a][i]: gyro_noise for a, row in enumerate(rest.noise) for i, gyro_noise in enumerate(row)}
    warnings += [prefixed(still.name, line) for line in noise_lines(noises)]
    warnings += [prefixed(still.name, line) for line in _warn_steps(still, elements, rest)]
    slower = slower_noise(noises, rest) if noise is None else 1.0
    if slower > 1:
        warnings.append(Note(f"{still.name}: {slower_noise_text(slower, rest.uncertainty, rest.duration)}"))
    if fusion is not None and fusion.method == "feedback":
        warnings += [prefixed(still.name, line) for line in feedback_notes(elements.count, rest.rate)]
    record = _make_record(still, moving, elements, rest, aligned, covariance, used, count, warnings)
    if slower > 1:
        record = replace(record, fit={**record.fit, "slower_noise": slower})
    if fusion is not None:
        record = replace(record, model={**record.model, "fusion": fusion.to_dict()})
    if serial is not None:
        record = Calibration(**{**record.__dict__, "sensor": {**record.sensor, "serial": serial}})
    return ArrayFit(record, rest.curves)


def _bridge_rows(recording: Recording, elements: Elements) -> LeftOut:
    return leave_out(recording, [name for row in elements.names for name in row])


def _blocks_of_rows(count: int) -> Iterator[slice]:
    return (slice(start, min(start + ROWS_AT_ONCE, count)) for start in range(0, count, ROWS_AT_ONCE))


def _readings_si(recording: Recording, elements: Elements, rows: slice = slice(None)) -> Array:
    """Return the readings of all rows or some, rad/s, shape (m, axes, n), with those of a gyro side by side."""
    readings = np.empty((len(elements.axes), elements.count, len(range(*rows.indices(len(recording))))))
    _fill_si(readings, recording, elements, rows)
    return np.moveaxis(readings, 2, 0)


def _fill_si(readings: Array, recording: Recording, elements: Elements, rows: slice) -> None:
    """Fill `readings`, shape (axes, n, m), with those of some rows, rad/s."""
    columns = dict(recording.columns)  # which gives back the memory of columns on disk below, for all at once
    for a, (row, unit) in enumerate(zip(elements.names, elements.units, strict=True)):
        for i, name in enumerate(row):
            np.multiply(columns[name][rows], to_si(1.0, unit), out=readings[a, i])
    release(*columns.values())


def _check_readings(recording: Recording, elements: Elements) -> Checks:
    """Return the checks of readings; those that are no numbers are refused, and so are dead gyros."""
    names = [name for row in elements.names for name in row]
    check_finite(recording, names)
    for name in names:
        values = recording.column(name)
        if len(values) and values[0] == values[-1] and np.ptp(values) == 0:
            raise DataError(f"{recording.name}: column {name}: all samples are {values[0]:g}: a dead gyro")
    checks = Checks(elements.names)
    for rows in _blocks_of_rows(len(recording)):
        checks.watch(_readings_si(recording, elements, rows))
    for line in checks.doubled():
        raise DataError(f"{recording.name}: {line}")
    return checks


def _refuse_stuck(recording: Recording, elements: Elements, *, moving: bool = False) -> None:
    """Refuse a gyro that repeats one reading for a while, while the others change."""
    for row in elements.names:
        for name in row:
            others = [recording.columns[other] for other in row if other != name]
            if (run := stuck_run(recording.columns[name], others, moving=moving)) is not None:
                raise DataError(
                    f"{recording.name}: {stuck_message(recording, name, run)}; leave it out, or read a part without "
                    "it (--window)"
                )


def _still_part(left_out: LeftOut, elements: Elements) -> tuple[Recording, list[str], tuple[float, list[str]]]:
    """Return the longest stretch at rest, a message where that is not the whole recording, and its `sampling_rate`."""
    still = left_out.recording
    if len(still) < _FEWEST_SAMPLES:
        raise DataError(f"{still.name}: {len(still)} samples at rest are too few; expected {_FEWEST_SAMPLES} or more")
    rate, timing = sampling_rate(still)
    rest = find_rest(partial(_readings_si, still, elements), len(still), rate, elements.names, still.name)
    left_out.check(rest.start, rest.stop, "the recording at rest")
    if not rest.moved:
        return still, [], (rate, timing)
    time = still.si("time")
    columns = {name: values[rest.start : rest.stop] for name, values in still.columns.items()}
    part = replace(still, columns=columns, first_row=still.first_row + rest.start)
    if len(part) < _FEWEST_SAMPLES:
        raise DataError(
            f"{still.name}: not at rest throughout ({rest.moved}), and the longest stretch at rest has {len(part)} "
            f"samples; expected {_FEWEST_SAMPLES} or more"
        )
    first, last = time[rest.start], time[rest.stop - 1]
    whole = all(f"accel_{axis}_{k}" in still.columns for axis in "xyz" for k in range(1, elements.count + 1))
    shortened = Finding(
        f"{still.name}: not at rest throughout ({rest.moved}): used is the longest stretch at rest, {first:.6g} to "
        f"{last:.6g} s ({last - first:.4g} of {time[-1] - time[0]:.4g} s); --window FROM:TO chooses another",
        ("calibrate the whole IMUs (array calibrate --imus), or " if whole else "")
        + "record again at rest, or state the part at rest (--window)",
    )
    return part, [shortened], sampling_rate(part)


def _align_in_motion(moving: Recording, elements: Elements, rest: AtRest) -> tuple[Alignment, list[str]]:
    moving = on_one_clock(moving)
    its = find_elements(moving)
    if its.names != elements.names:
        raise DataError(
            f"{moving.name}: {its.count} elements on {len(its.axes)} axes; expected {elements.count} on "
            f"{len(elements.axes)} as at rest"
        )
    _check_readings(moving, its)
    _refuse_stuck(moving, its, moving=True)
    clipped = _clipped_rows(_readings_si(moving, its))
    left_out = _bridge_rows(moving, its)
    readings = _readings_si(left_out.recording, its)
    clipped |= _clipped_rows(readings)  # of a range that a single false reading exceeds
    kinds = {kind: rows & ~clipped for kind, rows in left_out.kinds.items()}  # all at their limits repeat themselves
    left_out = LeftOut(left_out.recording, left_out.names, kinds)
    moving = left_out.recording
    notes = [prefixed(moving.name, note) for note in moving.notes]
    notes += [prefixed(moving.name, note) for note in left_out.notes()]
    if clipped.any():
        notes.append(
            Finding(
                f"{moving.name}: {int(clipped.sum())} samples at the end of a gyro's range were left out",
                "turn more slowly, or set a larger range, and record it again",
            )
        )
    truth = its.truth(moving)
    if truth is not None:
        truth = np.column_stack([to_si(truth[:, a], unit) for a, unit in enumerate(its.units)])[~clipped]
    kept = readings[~clipped] - rest.bias
    checks = Checks(its.names)
    checks.watch(kept)
    other_units = checks.units()
    notes += [prefixed(moving.name, line) for line in other_units]
    notes += [Note(f"{moving.name}: {line}; the record puts it right") for line in checks.turned()]
    if len(kept) < _FEWEST_SAMPLES:
        raise DataError(f"{moving.name}: {len(kept)} usable samples in motion; expected {_FEWEST_SAMPLES} or more")
    try:
        time = check_time(moving) if "time" in moving else np.arange(len(moving)) / rest.rate
        alignment = align_in_time(time[~clipped], kept, rest.white, truth)
    except ObservabilityError as error:
        raise ObservabilityError(f"{moving.name}: {error}") from None
    names = its.names[0] if len(its.axes) == 1 else [f"element {i + 1}" for i in range(its.count)]
    lines = [*latency_notes(alignment, names), *bend_notes(alignment, names)]
    if truth is None and not other_units:
        lines += _warn_scales(alignment, its)
    return alignment, [*notes, *(prefixed(moving.name, line) for line in lines)]


def _warn_scales(alignment: Alignment, elements: Elements) -> list[str]:
    """Return a message on gyros whose scale factors lie farther off the others' than those of one range do."""
    size = np.linalg.norm(alignment.sensing, axis=2).T
    off = size / np.median(size)
    far = np.abs(off - 1) > SCALE_OFF_UNIT
    if not far.any():
        return []
    listed = first_of([f"{elements.names[a][i]} reads {off[a, i]:.3g}" for a, i in np.argwhere(far).tolist()], 3)
    return [
        Bad(
            f"in motion {listed} times the rate of most gyros: another range or unit? The scale of the array is the "
            f"mean of all, and so {100 * abs(float(off.mean()) - 1):.2g} % off",
            "correct the range or the unit of these columns, or leave them out",
        )
    ]


def _warn_steps(still: Recording, elements: Elements, rest: AtRest) -> list[str]:
    """Return a message on gyros whose level changes at rest by much more than the uncertainty of a usual bias."""
    usual = float(np.median(rest.uncertainty))
    steps = []
    for name in (name for row in elements.names for name in row):
        step = find_step(np.asarray(still.column(name), dtype=np.float64))
        release(still.column(name))
        if step is not None and abs(to_si(step.size, still.units[name])) > _HARMFUL_STEP * usual:
            steps.append(f"{name} by {step.size:+.2g} {still.units[name]} near {still.si('time')[step.sample]:.4g} s")
    if not steps:
        return []
    return [
        Finding(
            f"the level changes at rest: {first_of(steps, 3)}; the bias is the mean of both levels",
            "record again at rest, or read the part after the change (--window)",
        )
    ]


def _clipped_rows(readings: Array) -> np.ndarray:
    """Return the rows in which a gyro stays at its largest or smallest reading for several samples in a row."""
    flat = readings.reshape(len(readings), -1)
    rows = np.zeros(len(flat), dtype=bool)
    for column in flat.T:
        for extreme in (column.min(), column.max()):
            at = column == extreme
            runs = np.convolve(at, np.ones(_CLIPPED_RUN), mode="valid")
            if (runs >= _CLIPPED_RUN).any():
                rows |= at
    return rows


def _allan_covariance(
    still: Recording, elements: Elements, rest: AtRest, aligned: Alignment | None, averaging_time: float
) -> tuple[Array, float, int]:
    """Return the Allan covariance of each axis, (axes, n, n), the averaging time used, and its degrees of freedom."""
    n, m, rate = elements.count, len(still), rest.rate
    size = max(1, min(round(averaging_time * rate), m // (_FEWEST_DIFFERENCES * n + 1)))
    starts = np.arange(0, m - 2 * size + 1, max(1, size // _OVERLAP))
    covariance = np.zeros((len(elements.axes), n, n))
    for part in np.array_split(starts, -(-m // max(ROWS_AT_ONCE, 4 * size))):
        rows = slice(int(part[0]), int(part[-1]) + 2 * size)
        total = np.zeros((len(elements.axes), n, rows.stop - rows.start + 1))
        _fill_si(total[:, :, 1:], still, elements, rows)
        for a, i in np.ndindex(rest.bias.shape):
            integrate(total[a, i, 1:], float(rest.bias[a, i]))
        its = part - part[0]
        difference = (total[:, :, its + 2 * size] - 2 * total[:, :, its + size] + total[:, :, its]) / size
        if aligned is not None:
            difference = np.einsum("iab,bim->aim", np.linalg.inv(aligned.sensing), difference)
        covariance += difference @ difference.transpose(0, 2, 1)
    # Equivalent number of independent differences for white noise: NIST SP 1065, table 5.
    freedom = max(2, round(1.5 * m / size))
    for names, variances in zip(elements.names, np.einsum("aii->ai", covariance).tolist(), strict=True):
        for name, variance in zip(names, variances, strict=True):
            if not variance > 0:
                raise DataError(
                    f"{still.name}: column {name}: its means over {size / rate:.3g} s do not differ: a dead gyro, or a "
                    "unit in which its readings are as good as zero"
                )
    return covariance / (2 * len(starts)), size / rate, freedom


def _with_unit(value: Any, uncertainty: Any, unit: str) -> dict[str, Any]:
    return {"value": value, "standard_uncertainty": uncertainty, "unit": unit}


def _element_entries(
    elements: Elements, rest: AtRest, aligned: Alignment | None
) -> tuple[list[dict[str, Any]], dict[str, Parameter]]:
    """Return the record's entry for each element, and the parameters in them."""
    axes = len(elements.axes)
    spread = rest.uncertainty
    single_axis = axes == 1

    def scalar(values: Array) -> Any:
        """Return a number for one axis, a list over x, y, z for three."""
        return float(values[0]) if single_axis else values.tolist()

    listed = []
    parameters: dict[str, Parameter] = {}
    for i in range(elements.count):
        entry: dict[str, Any] = {
            "name": elements.names[0][i] if single_axis else str(i + 1),
            "bias": _with_unit(scalar(rest.bias[:, i]), scalar(spread[:, i]), "rad/s"),
        }
        for a, axis in enumerate(elements.axes):
            label = f"{axis}_{i + 1}" if axis else f"{i + 1}"
            parameters[f"bias_{label}"] = Parameter(float(rest.bias[a, i]), float(spread[a, i]), "rad/s")
        if aligned is not None:
            inverse = np.linalg.inv(aligned.sensing[i])
            carried = np.sqrt((inverse**2) @ aligned.standard_uncertainty[i] ** 2 @ (inverse**2))
            if single_axis:
                value, u = float(aligned.sensing[i, 0, 0]), float(aligned.standard_uncertainty[i, 0, 0])
                entry["scale_factor"] = _with_unit(value, u, "1")
                parameters[f"scale_factor_{i + 1}"] = Parameter(value, u, "1")
            else:
                entry["matrix"] = _with_unit(inverse.tolist(), carried.tolist(), "1")
            entry["residual"] = {"value": scalar(aligned.residual[i]), "unit": "rad/s"}
            if aligned.latency is not None and aligned.latency_uncertainty is not None:
                entry["latency"] = _with_unit(float(aligned.latency[i]), float(aligned.latency_uncertainty[i]), "s")
        dicts = [coefficients_dict(rest.noise[a][i].coefficients, "rad/s") for a in range(axes)]
        for name in COEFFICIENTS:
            entry[name] = dicts[0][name] if single_axis else _over_axes([coefficients[name] for coefficients in dicts])
        listed.append(entry)
    return listed, parameters


def _warn_shared_noise(correlation: float) -> list[str]:
    """Return a message on noise that the elements have in common, by their mean correlation."""
    if correlation <= _SHARED:
        return []
    return [
        Finding(
            f"the elements' noise is shared (mean correlation {correlation:.2f}): was the array at rest? Fusion "
            "cannot remove it",
            "record the array at rest, on a firm base",
        )
    ]


def _make_record(
    still: Recording,
    moving: Recording | None,
    elements: Elements,
    rest: AtRest,
    aligned: Alignment | None,
    covariance: Array,
    averaging_time: float,
    differences: int,
    warnings: list[str],
) -> Calibration:
    listed, parameters = _element_entries(elements, rest, aligned)
    sigma = np.sqrt(np.einsum("aii->ai", covariance))
    correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
    warnings = [*warnings, *_warn_shared_noise(_mean_correlation(correlation))]
    sources = tuple(r.source for r in (still, moving) if r is not None and r.source is not None)
    return Calibration(
        procedure="gyro_array",
        parameters=parameters,
        covariance=Covariance((), ()),
        model={
            "kind": "calibration",
            "elements": elements.count,
            "axes": list(elements.axes),
            "aligned": aligned is not None,
            "gauge": aligned.gauge if aligned is not None else None,
            "unit": elements.units[0],
            **_temperature(still),
        },
        fit={
            "duration": {"value": rest.duration, "unit": "s"},
            "sample_rate": {"value": rest.rate, "unit": "Hz"},
            "samples": len(still),
            "samples_in_motion": 0 if moving is None else len(moving),
        },
        options={"averaging_time": averaging_time},
        data={
            "allan": [
                [
                    {"tau": c.tau.tolist(), "deviation": c.deviation.tolist(), "u": c.standard_uncertainty.tolist()}
                    for c in row
                ]
                for row in rest.curves
            ]
        },
        sensor={key: still.metadata[key] for key in ("serial", "model") if key in still.metadata},
        sources=sources,
        warnings=tuple(warnings),
        sections={
            "elements": listed,
            "correlation": _correlation(elements, covariance, correlation, averaging_time, differences),
        },
    )


def _correlation(
    elements: Elements, covariance: Array, correlation: Array, averaging_time: float, differences: int
) -> dict[str, Any]:
    """Return the record's section on common noise, with the fixed weights that follow from it."""
    fixed = [fixed_weights(matrix) for matrix in covariance]
    return {
        "averaging_time": {"value": averaging_time, "unit": "s"},
        "axes": list(elements.axes),
        "matrix": correlation.tolist(),
        "standard_uncertainty": (np.maximum(1 - correlation**2, 0.0) / math.sqrt(differences)).tolist(),
        "covariance": covariance.tolist(),
        "unit": "(rad/s)^2",
        "weights": [weights.tolist() for weights, _ in fixed],
        "limit": [{"value": limit, "unit": "rad/s"} for _, limit in fixed],
    }


def _over_axes(coefficients: list[dict[str, Any]]) -> dict[str, Any]:
    """Return one entry with lists over x, y, z from an entry for each axis."""
    reasons = [axis_coefficient["reason"] for axis_coefficient in coefficients if "reason" in axis_coefficient]
    listed = {
        key: [axis_coefficient[key] for axis_coefficient in coefficients] for key in ("value", "standard_uncertainty")
    }
    return {**listed, "unit": coefficients[0]["unit"], **({"reason": reasons[0]} if reasons else {})}


def _mean_correlation(correlation: Array) -> float:
    n = correlation.shape[1]
    off = ~np.eye(n, dtype=bool)
    return float(np.mean(np.abs(correlation[:, off])))


def _temperature(still: Recording) -> dict[str, Any]:
    temperature = still.mean_temperature()
    return {} if temperature is None else {"temperature": {"value": temperature, "unit": "degC"}}
