"""The functions of the gyro array as people call them: data as they have them, options as keywords."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike, fspath
from typing import Annotated, Any, Unpack, cast

from numpy.typing import NDArray

from imulab.device import METHODS, STARTS
from imulab.device.unit import Blob, is_blob, load_blob
from imulab.errors import DataError, OptionError
from imulab.options import PROGRAM, READING, file, measure, parsed, text
from imulab.procedures.gyro_array import compare, fit
from imulab.procedures.gyro_array.compare import Comparison
from imulab.procedures.gyro_array.fit import ArrayFit
from imulab.procedures.gyro_array.fuse import Fused
from imulab.procedures.gyro_array.fuse import fuse as fuse_recording
from imulab.procedures.gyro_array.merge import Merged, merge_recordings
from imulab.procedures.gyro_array.stream import RATE_WALK, FuseOptions, carried, fusion_text
from imulab.procedures.result import Record, as_record, as_recording, check_keywords
from imulab.quantities import in_si, interval, span
from imulab.recording import Data, Part, Reading, Recording, Window
from imulab.records.calibration import Calibration

_LABEL = "array: {}"


def calibrate_array(
    still: Data,
    moving: Annotated[Data | None, file()] = None,
    *,
    averaging: Annotated[float | str, measure("time", "s")] = "1 s",
    method: Annotated[str | None, text("METHOD", METHODS)] = None,
    memory: Annotated[str | float | None, text("growing|growing:N|GAIN", ("growing",))] = None,
    noise: Record | None = None,
    **reading: Unpack[Reading],
) -> ArrayFit:
    """Calibrate the elements of an array from data at rest and, if there are some, data in motion.

    At rest, in the longest stretch that is: each element's bias is its plain mean, the common part included; N, B, K
    come from the model of its noise, and so does the bias's uncertainty (`ColumnNoise.mean_uncertainty`); the
    covariance matrix at `averaging` is half the mean of the products of successive differences of means (the Allan
    covariance; Vaccaro and Zaki 2017). In motion: scale factors, or a 3 x 3 alignment of each element.

    Parameters
    ----------
    still
        A file, recording, data frame or arrays with the columns gyro_1 .. (or gyro_x_1 ..) in rad/s, deg/s or deg/h; or
        the readings of n gyros, shape (m, n) or (m, n, 3).
    moving
        Recording in motion, for alignment and scale. As `still`.
    averaging
        Averaging time of the covariance matrix. In s.
    method
        Method that fuse and export take from the record; robust if not given.
    memory
        Its memory: growing, growing:COUNT, or a gain between 0 and 1. Growing if not given.
    noise
        Noise record of the same gyros, for the uncertainties of the biases. Of `fit_noise`, or its file, from a log
        that is longer than `still`: the uncertainties of the biases are those of its model.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window` (of `still` alone).

    Raises
    ------
    DataError
        Samples that are not finite, a dead element, too few samples, no stretch at rest.
    UnitError
        The elements have different units, or none of rate.
    ObservabilityError
        The motion does not excite every axis.
    OptionError
        An option has a value that cannot be.
    RecordError
        `noise` is no noise record, or lacks a gyro.

    Examples
    --------
    >>> import imulab as il
    >>> still = il.simulate_array(experiment="static", duration=60.0)
    >>> sorted(il.calibrate_array(still).calibration.parameters)[:2]
    ['bias_1', 'bias_2']
    """
    at_rest = _timed(as_recording(still, reading, calibrate_array, gyros_of, "still"), "calibrate_array")
    in_motion = None
    if moving is not None:
        rest: dict[str, Any] = {key: value for key, value in reading.items() if key != "window"}
        in_motion = as_recording(moving, _fitting(moving, rest), calibrate_array, gyros_of, "moving")
    fusion = None
    if method is not None or memory is not None:
        fusion = fusion_text(method, None if memory is None else str(memory), _LABEL)
    return fit.calibrate_array(
        at_rest, in_motion, averaging_time=in_si(averaging, "averaging", "time", "s"),
        serial=reading.get("serial"), fusion=fusion,
        noise=None if noise is None else as_record(noise, "calibrate_array: noise"),
    )  # fmt: skip


def fuse(
    data: Data,
    options: Annotated[FuseOptions | None, "keywords, as in fuse(data, method='mean')"] = None,
    *,
    method: Annotated[str | None, text("METHOD", METHODS)] = None,
    memory: Annotated[str | float | None, text("growing|growing:N|GAIN", ("growing",))] = None,
    initial_bias: Annotated[Record, text("|".join((*STARTS, "RECORD")), STARTS)] = "first",
    calibration: Record | Blob | None = None,
    rate: Annotated[float | str | None, measure("frequency", "Hz")] = None,
    rate_walk: float | None = None,
    still: Annotated[tuple[float, float] | str | None, text("FROM:TO", unit="s")] = None,
    window: Annotated[Window | None, parsed(span, "FROM:TO", unit="s"), READING] = None,
    weights: Annotated[bool, PROGRAM] = False,
    flags: Annotated[bool, PROGRAM] = True,
    **reading: Unpack[Part],
) -> Fused:
    """Fuse the readings of an array into one rate.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays with the columns gyro_1 .. (or gyro_x_1 ..); or the readings of n gyros,
        shape (m, n) or (m, n, 3).
    options
        The keywords as one object, instead of them, for what fuses block by block.
    method
        mean support least-squares feedback robust covariance kalman; that of the calibration, or robust.
    memory
        growing, growing:COUNT, or a gain between 0 and 1; that of the calibration, or growing.
    initial_bias
        Biases to start from. ``first``, ``zero``, or the record, or its file, whose biases the recursion starts from.
    calibration
        Record of array calibrate, taken off first. Or a blob, or the file of either: its biases are taken off, its
        noise gives the weights.
    rate
        Sampling rate; from the first samples if not given. In Hz, of arrays without `time`; the nominal rate of what
        has a time of its own.
    rate_walk
        Process noise of `kalman`, rad/s/sqrt(s).
    still
        The unit is known to be at rest then. From when to when, s, as ``(10, 60)`` or ``"10:60"``.
    window
        As for `fit_tumble`.
    weights, flags
        Whether to keep the weight and the state of each gyro in each sample.
    reading
        How arrays and files are to be understood: `time`, `unit` or `units`; `layout`, `topic`, `instance`, `element`.

    Raises
    ------
    DataError
        No elements, too few for the method, no time, or time that does not rise.
    UnitError
        The elements of an axis have different units, or others than the record.
    RecordError
        The record is not of this array.
    OptionError
        An option has a value that cannot be.

    Examples
    --------
    >>> import imulab as il
    >>> board = il.simulate_array(duration=20.0)
    >>> il.fuse(board, method="mean").rate.shape == (len(board), 1)
    True
    """
    hertz = None if rate is None else in_si(rate, "rate", "frequency", "Hz")
    rest = interval(still, "still") if isinstance(still, str) else still
    check_keywords(reading, fuse)
    nominal, sampling = (hertz, None) if _has_time(data) else (None, hertz)
    stated: dict[str, Any] = {**reading, "window": window, "rate": sampling}
    recording = _timed(as_recording(data, stated, fuse, gyros_of), "fuse")
    named = (method, memory, calibration, rate_walk, rest, None if initial_bias == "first" else initial_bias, nominal)
    if options is None:
        options = _options(method, memory, initial_bias, calibration, rate_walk, rest)
        options = options if nominal is None else replace(options, rate=nominal)
    elif any(value is not None for value in named):
        raise OptionError("fuse: options together with other keywords: expected one or the other")
    return fuse_recording(recording, options, weights=weights, flags=flags)


def compare_methods(
    data: Data,
    *,
    calibration: Record | None = None,
    memory: Annotated[str | float | None, text("growing|growing:N|GAIN", ("growing",))] = None,
    count_from: int | None = None,
    **reading: Unpack[Reading],
) -> Comparison:
    """Run all seven methods over one recording: errors, limit, Allan curves, bandwidth.

    The truth is the column ``truth_rate`` (or ``truth_rate_x`` ..); without it the unit must be still, or still for a
    stretch of 5 s or more: the figures are then of the longest such stretch, and the truth there is 0. With six gyros
    or more the two halves of the array (odd and even elements) are also fused apart; half of the standard deviation of
    their difference estimates the noise of the whole without any truth.

    Parameters
    ----------
    data
        As for `fuse`.
    calibration
        Record of array calibrate, taken off first. Or its file.
    memory
        growing, growing:COUNT, or a gain between 0 and 1; that of the calibration, or growing.
    count_from
        Count of the first sample under growing memory; that of `memory` if not given.
    reading
        How arrays and files are to be understood, as for `fuse`.

    Raises
    ------
    DataError
        No elements, no time, an axis without a finite reading, or neither truth nor a stretch at rest.
    OptionError
        An option has a value that cannot be.

    Examples
    --------
    >>> import imulab as il
    >>> sorted(il.compare_methods(il.simulate_array()).figures)[0]
    'covariance'
    """
    recording = _timed(as_recording(data, reading, compare_methods, gyros_of), "compare_methods")
    record = None if calibration is None else as_record(calibration, "compare_methods: calibration")
    by = fusion_text(None, None if memory is None else str(memory), _LABEL, carried(record))
    gain: str | float = "growing" if by.memory is None else by.memory
    count = by.start if count_from is None else count_from
    if count < 1:
        raise OptionError(f"count_from {count}: expected 1 or more")
    return compare.compare_methods(recording, calibration=record, memory=gain, count_from=count)


def merge_array(
    recordings: Annotated[Sequence[Data], "a list of recordings, one of each gyroscope"],
    *,
    axis: Annotated[str | None, text("x|y|z")] = None,
    column: Annotated[str | None, text("NAME")] = None,
    align: bool = False,
    **reading: Unpack[Reading],
) -> Merged:
    """Join recordings of one gyroscope each to the recording of an array, by time, at the times of the first.

    The others are interpolated, linearly; in a gap of more than 10 of their sampling intervals they are NaN. Nothing is
    extrapolated.

    Parameters
    ----------
    recordings
        Two or more files, recordings or data frames, on clocks that agree unless `align` is chosen.
    axis
        Take this axis of each. ``x``, ``y`` or ``z``; all three (or the only one) if not given.
    column
        Take this column of each. In place of an axis.
    align
        Move the clocks to where the motion fits the first.
    reading
        How arrays and files are to be understood, as for `fuse`.

    Raises
    ------
    OptionError
        `axis` and `column` are both given, or `axis` is none.
    DataError
        There is only one recording, or one twice; a recording has no gyroscope or no time; they have no time in
        common; `align` finds no motion that fits.
    UnitError
        The units of two gyroscopes cannot be converted to each other.

    Examples
    --------
    >>> import imulab as il
    >>> first, second = (il.simulate_tumble(attitudes=6, seed=seed) for seed in (1, 2))
    >>> [name for name in il.merge_array([first, second], axis="x").recording.columns]
    ['time', 'gyro_1', 'gyro_2']
    """
    if axis is not None and axis not in ("x", "y", "z"):
        raise OptionError(f"axis {axis!r}: expected x, y or z")
    if axis is not None and column is not None:
        raise OptionError("axis and column both say which column to take: expected one of them")
    parts = [as_recording(each, reading, merge_array, gyros_of, "recordings") for each in recordings]
    return merge_recordings(parts, axis=axis, column=column, align=align)


def gyros_of(readings: NDArray[Any]) -> Mapping[str, NDArray[Any]]:
    """Return the columns of readings of shape (m, n), single axes, or (m, n, 3), triads.

    Raises
    ------
    DataError
        They have another shape.
    """
    if readings.ndim == 2:
        return {f"gyro_{number + 1}": readings[:, number] for number in range(readings.shape[1])}
    if readings.ndim == 3 and readings.shape[2] == 3:
        pairs = [(axis, number) for axis in range(3) for number in range(readings.shape[1])]
        return {f"gyro_{'xyz'[axis]}_{number + 1}": readings[:, number, axis] for axis, number in pairs}
    raise DataError(f"arrays: expected readings of shape (m, n) or (m, n, 3), found {readings.shape}")


def _timed(recording: Recording, called: str) -> Recording:
    """Return a recording, refused where arrays came without their rate."""
    if recording.source is None and "time" not in recording and len(recording):
        raise DataError(f"{called}: {recording.name}: no time: expected rate=, time= or a column 'time'")
    return recording


def _has_time(data: object) -> bool:
    """Return whether data bring a time of their own, beside which a rate is the nominal one."""
    columns = data if isinstance(data, Mapping) else getattr(data, "columns", ()) if hasattr(data, "__len__") else ()
    return isinstance(data, str | PathLike) or any(str(name).partition("[")[0].strip() == "time" for name in columns)


def _fitting(data: object, reading: dict[str, Any]) -> dict[str, Any]:
    """Return the keywords of the data at rest that go with those in motion too."""
    ours = ("layout", "topic", "instance") if isinstance(data, str | PathLike) else ("rate", "time", "unit", "units")
    ours = ("element",) if hasattr(data, "corrected_by") else (*ours, "element")
    return {key: value for key, value in reading.items() if key in ours and key != "time"}


def _options(
    method: str | None,
    memory: str | float | None,
    initial_bias: Record,
    calibration: Record | Blob | None,
    rate_walk: float | None,
    still: tuple[float, float] | None,
) -> FuseOptions:
    """Return keywords as the options that they are."""
    known: Calibration | Blob | None = None
    if isinstance(calibration, Blob):
        known = calibration
    elif isinstance(calibration, str | PathLike) and is_blob(fspath(calibration)):
        known = load_blob(fspath(calibration))
    elif calibration is not None:
        known = as_record(calibration, "fuse: calibration")
    start = cast(Any, initial_bias)
    if not isinstance(initial_bias, str) or initial_bias not in STARTS:
        start = as_record(initial_bias, "fuse: initial_bias")
    by = fusion_text(method, None if memory is None else str(memory), _LABEL, carried(known))
    gain: str | float = "growing" if by.memory is None else by.memory
    walk = RATE_WALK if rate_walk is None else rate_walk
    return FuseOptions(by.method, gain, by.start, start, known, rate_walk=walk, still=still)
