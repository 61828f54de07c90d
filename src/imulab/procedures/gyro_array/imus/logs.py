"""Logs of autopilots as recordings of whole IMUs: whether such a log can tell where they sit, and why it cannot.

What is decided is measured on the log: how fast it turns about each axis, whether the instances' clocks run alike, how
wide the noise at rest is, and how much the board vibrates.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imulab.display import Finding, Note
from imulab.errors import DataError, ObservabilityError
from imulab.procedures.gyro_array.imus.columns import readings_of
from imulab.procedures.gyro_array.imus.prepare import MOVING, Prepared, names_of, prepare
from imulab.readers.instances import INSTANCES
from imulab.recording import EVERY, Array, Recording

_LEAST_RATE, _MOST_RATE = 80.0, 400.0  # Hz: below, splines miss a hand's motion; above, a fit takes minutes
_WINDOW, _LIVELIEST = 0.5, 10.0  # s: windows, and the parts whose rates are stated
_LAG_WINDOW, _FURTHEST = 8.0, 1.0  # s: of a lag, and the longest that is looked for
_ALIKE = 0.8  # correlation from which a lag is known
_DRIFT = {"gyroscopes": 2e-3, "accelerometers": 2e-2}
"""s between first and last lag that are refused. Lever arms of 0.1 m move accelerometers' by up to 0.01 s."""
_SMOOTH = 0.1  # s: of accelerometers, whose noise else exceeds their slope where the board turns slowly
_APART, _FAR = 2e-4, 5e-2  # s: drifts that are said, and lags that are refused
_SURE, _FEWEST_LAGS = 6.0, 4  # standard deviations of a drift, of so few windows, and their least number
_STILL = 0.3  # m/s^2: no accelerometer that lies still is noisier
_NARROW = 15.0  # Hz: a filter below damps what a hand does
_LOW = (2.0, 8.0)  # Hz: where the noise at rest is compared with that above
_SHAKEN = 30.0  # Hz: a hand does nothing faster
_VIBRATES, _SEVERAL = 2.0, 4  # times the noise at rest, and IMUs of which the fit tells vibration apart
_DO = (
    "log raw readings of all instances (PX4: sensor_accel and sensor_gyro; ArduPilot: ACC and GYR), motors off, while "
    "the board is put down in twelve attitudes and turned by hand about all axes"
)

_LEAVE_OUT = (
    "convert the log with --instance all, leave the columns of this IMU out, number the others anew, and read that"
)


def with_all_instances(data: object, reading: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of reading by which a flight log is read as all its IMUs, unless an instance is named."""
    chosen = reading.get("instance")
    return {**reading, "instance": EVERY if chosen is None and isinstance(data, str | os.PathLike) else chosen}


def prepare_board(recording: Recording, gravity: float) -> Prepared:
    """Return what `prepare` does; of a flight log, with noise as large as its correlation from row to row makes it.

    Raises
    ------
    ObservabilityError
        A log that cannot tell where its IMUs sit, with the reason as measured.
    DataError
        As for `prepare`; the instances' clocks run apart.
    """
    if INSTANCES not in recording.metadata:
        return prepare(recording, gravity)
    series = _series(recording)
    if series.rate < _LEAST_RATE:
        raise _cannot_tell(
            recording, f"{series.rate:.3g} readings a second of each IMU, where {_LEAST_RATE:g} are needed"
        )
    messages = _check_clocks(recording, series)
    _check_turning(recording, series)
    prepared = prepare(recording, gravity)
    noise = float(np.sqrt(np.square(prepared.measured.accel_noise).mean()))
    if noise > _STILL:
        raise _cannot_tell(recording, f"it lies nowhere still: its accelerometers scatter by {noise:.2g} m/s^2 at rest")
    bands = _noise(recording, prepared)
    step = math.ceil(series.rate / _MOST_RATE - 0.01)
    if step > 1:
        thinned = replace(recording, columns={name: values[::step] for name, values in recording.columns.items()})
        prepared = prepare(thinned, gravity)
        messages.append(Note(f"one row in {step} of {series.rate:.4g} a second is used"))
    wider = [max(1.0, math.sqrt(prepared.rate / (2 * band))) for band in bands]
    measured = prepared.measured
    measured = replace(measured, accel_noise=measured.accel_noise * wider[0], gyro_noise=measured.gyro_noise * wider[1])
    prepared = replace(prepared, measured=measured, correlation=(wider[0], wider[1]))
    if min(bands) < _NARROW:
        what = "accelerometers" if bands[0] <= bands[1] else "gyroscopes"
        messages.append(
            Finding(
                f"the {what} were filtered at about {min(bands):.2g} Hz before they were logged, by their noise at "
                "rest: positions and latencies can be off by more than stated",
                "set the filters wider, or log raw readings",
            )
        )
    return replace(prepared, notes=(*recording.notes, *messages, *prepared.notes))


def _cannot_tell(recording: Recording, reason: str) -> ObservabilityError:
    return ObservabilityError(f"{recording.name}: this log cannot tell where its IMUs sit: {reason}; {_DO}")


@dataclass(frozen=True)
class _Series:
    """Finite rows of a log: times, s, and readings, shape (n, K, 3), SI; rate, Hz."""

    time: Array
    accel: Array
    gyro: Array
    rate: float


def _series(recording: Recording) -> _Series:
    readings = readings_of(recording, names_of(recording))
    good = np.isfinite(readings).all(axis=(1, 2, 3))
    if good.sum() < 2:
        raise DataError(f"{recording.name}: no time at which all of {recording.metadata[INSTANCES]} have readings")
    time = recording.si("time")[good]
    return _Series(time, readings[good, 0], readings[good, 1], 1 / float(np.median(np.diff(time))))


def _check_turning(recording: Recording, series: _Series) -> None:
    """Refuse a log that does not turn about every axis in the parts in which it turns most."""
    size = max(round(_WINDOW * series.rate), 2)
    rate = series.gyro[:, 0] - np.median(series.gyro[:, 0], axis=0)
    count = len(rate) // size
    square = np.square(rate[: count * size]).reshape(count, size, 3).mean(axis=1)
    fastest = np.argsort(-square.sum(axis=1))
    moving = int((square.sum(axis=1) > MOVING**2).sum())
    most = max(moving, round(_LIVELIEST / _WINDOW))
    about = np.sqrt(square[fastest[:most]].mean(axis=0)) if count else np.zeros(3)
    shown = ", ".join(f"{math.degrees(value):.2g} about {axis}" for value, axis in zip(about, "xyz", strict=True))
    if about.min() < MOVING:
        raise _cannot_tell(
            recording,
            f"it is turned by only {math.degrees(float(about.min())):.2g} deg/s rms about axis "
            f"{'xyz'[int(about.argmin())]} of IMU 1 in the {min(most, count) * _WINDOW:g} s in which it turns most "
            f"({shown}), where {math.degrees(MOVING):.0f} are needed about each",
        )


def _check_clocks(recording: Recording, series: _Series) -> list[str]:
    """Refuse instances whose time stamps run fast or slow against those of IMU 1, or are far off; say small drifts."""
    messages: list[str] = []
    rates = np.linalg.norm(series.gyro, axis=2, keepdims=True)  # however the chips are turned
    for sensor, readings in (("gyroscopes", rates), ("accelerometers", _turned_alike(series))):
        for k in range(1, readings.shape[1]):
            at, lag = _lags(series, readings[:, 0], readings[:, k])
            if len(at) < _FEWEST_LAGS:
                continue
            slope, middle = np.polyfit(at, lag, 1)
            left = lag - slope * at - middle
            u = math.sqrt(float(left @ left) / max(len(at) - 2, 1) / float(np.square(at - at.mean()).sum()))
            drift = slope * (at[-1] - at[0])
            who, way = f"the time stamps of the {sensor} of IMU {k + 1}", "fast" if slope > 0 else "slow"
            late = float(np.median(lag))
            if abs(drift) > _DRIFT[sensor] and abs(slope) > _SURE * u:
                raise DataError(
                    f"{recording.name}: {who} run {100 * abs(slope):.2g} % {way} against IMU 1's: "
                    f"their lag goes from {1e3 * lag[0]:.3g} to {1e3 * lag[-1]:.3g} ms; expected one clock: "
                    f"{_LEAVE_OUT}"
                )
            if abs(late) > _FAR:
                raise DataError(
                    f"{recording.name}: {who} are {1e3 * abs(late):.3g} ms {'late' if late > 0 else 'early'} against "
                    "IMU 1's; expected stamps of the moment of sampling: {_LEAVE_OUT}"
                )
            if sensor == "gyroscopes" and abs(drift) > _APART and abs(slope) > _SURE * u:
                messages.append(
                    Finding(
                        f"{who} run {1e6 * abs(slope):.2g} ppm {way} against IMU 1's, by "
                        f"{1e3 * abs(drift):.2g} ms in all: its latencies hold in the middle of the motion only",
                        "stamp all instances by one clock",
                    )
                )
    return messages


def _turned_alike(series: _Series) -> Array:
    """Return the accelerometers' readings, smoothed and turned into the frame of IMU 1's, shape (n, K, 3), m/s^2."""
    taper = np.hanning(max(round(_SMOOTH * series.rate), 1) + 2)[1:-1]
    smooth = np.apply_along_axis(np.convolve, 0, series.accel, taper / taper.sum(), "same")
    for k in range(1, smooth.shape[1]):
        left, _, right = np.linalg.svd(smooth[:, 0].T @ smooth[:, k])
        upright = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
        smooth[:, k] = smooth[:, k] @ (left @ upright @ right).T
    return np.asarray(smooth)


def _lags(series: _Series, first: Array, other: Array) -> tuple[Array, Array]:
    """Return by what `other` lags behind `first`, shape (n, columns), in windows of motion, and their middles, s."""
    size, reach = round(_LAG_WINDOW * series.rate), round(_FURTHEST * series.rate)
    at, lags = [], []
    turning = np.linalg.norm(series.gyro[:, 0], axis=1)
    for begin in range(0, len(first) - size + 1, size // 2):
        part = slice(begin, begin + size)
        whole = series.time[begin + size - 1] - series.time[begin] < 1.1 * _LAG_WINDOW
        if not whole or np.square(turning[part]).mean() < MOVING**2:
            continue
        a, b = (np.fft.rfft(x[part] - x[part].mean(axis=0), 2 * size, axis=0) for x in (first, other))
        products = np.fft.irfft((np.conj(a) * b).sum(axis=1))
        shifts = np.arange(-reach, reach + 1)
        shift = int(shifts[np.argmax(products[shifts])])
        inner = slice(max(begin + shift, 1), min(begin + size + shift, len(other) - 1))
        x = first[inner.start - shift : inner.stop - shift]
        y = (other[inner] - other[inner].mean(axis=0)).ravel()
        slope = np.gradient(x, 1 / series.rate, axis=0)
        design = np.stack([(each - each.mean(axis=0)).ravel() for each in (x, slope)], axis=1)
        fit = np.linalg.lstsq(design, y, rcond=None)[0]
        if fit[0] > 0 and np.square(y - design @ fit).sum() < (1 - _ALIKE**2) * np.square(y).sum():
            at.append(float(series.time[part].mean()))
            lags.append(shift / series.rate - float(fit[1] / fit[0]))
    return np.array(at), np.array(lags)


def _power(prepared: Prepared, splines: list[Any], begins: list[int], size: int) -> Array:
    """Return the density of the readings' variance over frequency, of a column, in windows that begin at these samples.

    Shape (size // 2 + 1,), in bins of one over the windows' time.
    """
    taper, line = np.hanning(size)[:, None], np.linspace(-1, 1, size)[:, None]
    power, count = np.zeros(size // 2 + 1), 0
    for spline in splines:
        for begin in begins:
            values = spline(prepared.time[begin : begin + size])
            values = values - values.mean(axis=0)
            values -= line * (line * values).sum(axis=0) / (line * line).sum()
            power += np.square(np.abs(np.fft.rfft(taper * values, axis=0))).mean(axis=1)
            count += 1
    return np.asarray(2 * power / (max(count, 1) * size * float(np.square(taper).sum())))


def _noise(recording: Recording, prepared: Prepared) -> tuple[float, float]:
    """Return the bandwidths of the noise of accelerometers and gyroscopes at rest, Hz.

    Above 2 Hz, by the variance over its density from 2 to 8 Hz.

    Raises
    ------
    ObservabilityError
        Fewer than four IMUs vibrate in motion: they do not read it at one instant, and positions come out wrong.
    """
    size, time = 2 * round(prepared.rate / 2), prepared.time
    begins = np.searchsorted(time, prepared.measured.time[::size]).tolist()
    still, moving = (
        [k for k in parts if k + size <= len(time) and time[k + size - 1] - time[k] < size / prepared.rate]
        for parts in ([k for i, j in prepared.rests.tolist() for k in range(i, j - size + 1, size)], begins)
    )
    frequency = np.fft.rfftfreq(size, 1 / prepared.rate)
    bands = []
    for splines in (prepared.measured.accel, prepared.measured.gyro):
        power = _power(prepared, splines, still, size)
        low = power[(frequency >= _LOW[0]) & (frequency < _LOW[1])].mean()
        above = power[frequency >= _LOW[0]].sum() * (frequency[1] - frequency[0])
        bands.append(float(min(_LOW[0] + above / max(low, 1e-300), prepared.rate / 2)) if still else prepared.rate / 2)
    edge = min(_SHAKEN, 0.35 * prepared.rate)
    rest, motion = (
        math.sqrt(float(_power(prepared, prepared.measured.accel, parts, size)[frequency > edge].sum()))
        for parts in (still, moving)
    )
    floor = float(np.sqrt(np.square(prepared.measured.accel_noise).mean()))
    if prepared.measured.count < _SEVERAL and still and motion > _VIBRATES * max(rest, 0.25 * floor):
        raise _cannot_tell(
            recording,
            f"in motion its accelerometers vibrate by {motion:.2g} m/s^2 rms above {edge:.0f} Hz, where they have "
            f"{rest:.2g} at rest, and {prepared.measured.count} IMUs that sample at different instants do not tell "
            "that from lever arms",
        )
    return bands[0], bands[1]
