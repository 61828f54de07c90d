"""The stream of the C core that fuses an array's readings: method, memory, biases, weights and gains.

They come from options, from a calibration record, or from an exported blob. The gain of method `kalman` is computed
here. Source: Bayard and Ploen, US patent 6882964 (2003). The bias common to all gyros cannot be separated from the
rate, so the biases keep a constant sum; the rest is observable and has one steady-state gain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imulab.arguments import check_fields
from imulab.device import METHODS, STARTS
from imulab.device.tables import MOST_COUNT, ArraySettings, Fusion, fusion_of
from imulab.device.unit import Blob
from imulab.errors import OptionError, RecordError, UnitError, listed, meant
from imulab.estimation.rows import MAD_TO_SIGMA
from imulab.procedures.gyro_array.elements import ArrayCalibration, Elements, array_calibration, count_of_axes
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor, from_si, parse_unit

# Gain of method kalman: a rate that walks, and biases that walk.


RATE_WALK = math.radians(1.4)
"""Default process noise, rad/s/sqrt(s): follows 12.5 deg/s at 0.1 Hz, sampled at 50 Hz, without a visible lag."""
_BIAS_WALK = 0.004  # of the white noise in 1 s: walk of the biases where no record states it
_LOWEST = 0.05  # of the mean variance: no element counts as quieter


def steady_gain(white: Array, walk: Array, rate_walk: float, step: float) -> Array:
    """Return the steady-state gain of the state (rate, bias_1 .. bias_n), shape (n + 1, n).

    ``x' = x + (q, V c) sqrt(step)``, ``z = x_0 + b + white``; V spans the vectors of sum 0, from the discrete Riccati
    equation in (rate, c).

    Parameters
    ----------
    white
        Standard deviation of one sample, shape (n,).
    walk
        Rate random walk of each gyro, per sqrt(s), shape (n,).
    rate_walk
        Walk of the true rate, per sqrt(s).
    step
        Time between samples, s.
    """
    from scipy.linalg import solve_discrete_are

    n = len(white)
    basis = np.linalg.qr(np.column_stack([np.ones(n), np.eye(n)[:, : n - 1]]))[0][:, 1:]
    size = float(np.mean(white**2))
    h = np.column_stack([np.ones(n), basis])
    q = np.zeros((n, n))
    q[0, 0] = rate_walk**2 * step / size
    q[1:, 1:] = basis.T @ np.diag(walk**2) @ basis * step / size
    q[1:, 1:] += 1e-12 * np.eye(n - 1)
    r = np.diag(white**2) / size
    ahead = solve_discrete_are(np.eye(n), h.T, q, r)
    gain = ahead @ h.T @ np.linalg.inv(h @ ahead @ h.T + r)
    full: Array = np.vstack([gain[:1], basis @ gain[1:]])
    return full


def noise_about_mean(readings: Array) -> Array:
    """Return the standard deviation of each gyro's noise from residuals about the array mean, shape (axes, n).

    ``var_i = n / (n - 2) [m_i - sum_j m_j / (n (n - 1))]``, m_i the variance of the residual (the N-cornered hat); not
    below 5 % of the mean variance. Rows with readings that are not finite are left out; ones where no row is left.
    """
    _, axes, n = readings.shape
    sigma = np.ones((axes, n))
    for a in range(axes):
        rows = readings[np.isfinite(readings[:, a]).all(axis=1), a]
        if n < 3 or len(rows) < 50:
            continue
        residual = rows - rows.mean(axis=1, keepdims=True)
        # Successive differences: a differing scale factor shows in motion, but hardly from sample to sample.
        # The median of their size, so that spikes do not count.
        m = (MAD_TO_SIGMA * np.median(np.abs(np.diff(residual, axis=0)), axis=0)) ** 2 / 2
        variance = n / (n - 2) * (m - m.sum() / (n * (n - 1)))
        if variance.mean() > 0:
            sigma[a] = np.sqrt(np.maximum(variance, _LOWEST * variance.mean()))
    return sigma


def default_bias_walk(white: Array) -> Array:
    """Return the rate random walk where no record states one: 0.4 % of a sample's noise per sqrt(s)."""
    return _BIAS_WALK * white


# The array in an exported blob: its fusion, and its stream.


def fusion_of_blob(blob: Blob) -> Fusion:
    """Return the fusion of an exported blob.

    Raises
    ------
    RecordError
        The blob holds no array.
    """
    return fusion_of(_array_section(blob))


@dataclass(frozen=True)
class _InUnits:
    """A stream in rad/s behind readings in another unit."""

    stream: Any
    factor: Array

    def process(self, readings: Array, **more: Any) -> Any:
        out = self.stream.process(readings * self.factor[:, None], **more)
        return replace(out, rate=out.rate / self.factor)


def blob_stream(blob: Blob, elements: Elements, recording: str) -> _InUnits:
    """Return the stream of an exported blob."""
    from imulab.device.unit import Stream

    section = _array_section(blob)
    if (section["elements"], section["axes"]) != (elements.count, len(elements.axes)):
        raise RecordError(
            f"{recording}: {elements.count} gyros on {count_of_axes(len(elements.axes))}; the blob {blob.name} holds "
            f"{section['elements']} on {count_of_axes(section['axes'])}"
        )
    for row, unit in zip(elements.names, elements.units, strict=True):
        if parse_unit(unit).quantity != "rate":
            raise UnitError(f"{recording}: column {row[0]} is in {unit}; the blob {blob.name} is in rad/s")
    factor = np.array([conversion_factor(unit, "rad/s") for unit in elements.units])
    settings = ArraySettings(section["method"], elements.count, len(elements.axes), rate=section["rate"])
    return _InUnits(Stream.from_blob(blob.data, settings), factor)


def _array_section(blob: Blob) -> Any:
    """Return the section of a blob that holds its array."""
    section = next((s for s in blob.text["sections"] if s["kind"] == "array"), None)
    if section is None:
        raise RecordError(f"{blob.name}: the blob holds no array")
    return section


# Method and memory as texts, and in calibrations.


_MEMORIES = "expected growing, growing:COUNT, or a gain between 0 and 1"


def carried(calibration: Calibration | Blob | None) -> Fusion:
    """Return the method and memory of a calibration record or a blob; robust and growing where it has none."""
    if isinstance(calibration, Blob):
        return fusion_of_blob(calibration)
    return fusion_of(None if calibration is None else calibration.model.get("fusion"))


def fusion_of_record(record: Calibration, stated: Mapping[str, Any]) -> Fusion:
    """Return the fusion of a unit: `method` and `memory` where they are stated, else as in its record.

    Raises
    ------
    OptionError
        A text is unknown, or a keyword of whole IMUs is stated.
    """
    for name in ("at", "gyro_range", "accel_range"):
        if name in stated:
            raise OptionError(f"{name}: for whole IMUs; expected the record of 'imulab array calibrate --imus'")
    memory = stated.get("memory")
    return fusion_text(stated.get("method"), None if memory is None else str(memory), "{}", carried(record))


def memory_text(memory: str | float, start: int) -> str:
    """Return ``growing memory``, ``growing memory from 100 on`` or ``memory 0.01``."""
    if isinstance(memory, float):
        return f"memory {memory:g}"
    return "growing memory" + (f" from {start} on" if start > 1 else "")


def fusion_text(method: str | None, memory: str | None, label: str = "--{}", held: Fusion | None = None) -> Fusion:
    """Return method and memory from two texts, each that of `held` where it is None.

    Raises
    ------
    OptionError
        One is unknown.
    """
    before = held or Fusion()
    if method is not None and method not in METHODS:
        raise OptionError(f"{label.format('method')} {method!r}: expected one of {listed(METHODS, method)}")
    gain, start = before.memory, before.start
    if memory is not None:
        kind, start = parse_memory(memory, label.format("memory"))
        gain = kind if isinstance(kind, float) else None
    return Fusion(method or before.method, gain, start)


def parse_memory(text: str, option: str = "--memory") -> tuple[str | float, int]:
    """Return memory and starting count of a text such as ``growing``, ``growing:100`` or ``0.01``.

    Raises
    ------
    OptionError
        The text is none of these.
    """
    kind, colon, count = text.partition(":")
    if kind == "growing" and (not colon or (count.isascii() and count.isdecimal() and 0 < int(count) <= MOST_COUNT)):
        return "growing", int(count) if colon else 1
    try:
        gain = float(text)
    except ValueError:
        gain = np.nan
    if not 0 < gain < 1:
        raise OptionError(f"{option} {text!r}: {_MEMORIES}{meant(['growing'], kind)}")
    return gain, 1


# Options, and the stream that they open.


_WITHOUT_UNIT = 16.0  # rad/s in a second, or times the noise: walk of an unknown motion


@dataclass(frozen=True)
class FuseOptions:
    """Options of a fusion.

    Attributes
    ----------
    method
        One of ``mean support least-squares feedback robust covariance kalman``.
    memory
        ``growing``, or a gain between 0 and 1.
    start
        Count of the first sample under growing memory.
    initial_bias
        ``first``, ``zero``, or the record of an array calibration whose biases the recursion starts from.
    calibration
        Record whose biases (and matrices, if it has them) are applied first; its noise gives weights and gains. Or the
        blob of such a record, as the unit runs it: `robust` with the unit's settings and float numbers.
    rate
        Sampling rate, Hz; from the recording's first steps of time where None.
    rate_walk
        Process noise of `kalman`, rad/s/sqrt(s).
    still
        First and last time, s, at which the unit is known to be at rest: zero-rate updates then remove the common bias.

    Examples
    --------
    >>> import imulab as il
    >>> il.FuseOptions(method="feedback", memory=0.01).method
    'feedback'
    """

    method: str = "robust"
    memory: str | float = "growing"
    start: int = 1
    initial_bias: str | Calibration = "first"
    calibration: Calibration | Blob | None = None
    rate: float | None = None
    rate_walk: float = RATE_WALK
    still: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.method not in METHODS:
            raise OptionError(f"method {self.method!r}: expected one of {listed(METHODS, self.method)}")
        if isinstance(self.memory, str):
            if self.memory != "growing":
                raise OptionError(f"memory {self.memory!r}: {_MEMORIES}{meant(['growing'], self.memory)}")
        elif not 0 < self.memory < 1:
            raise OptionError(f"memory {self.memory:g}: {_MEMORIES}")
        if not 1 <= self.start <= MOST_COUNT:
            raise OptionError(f"memory growing:{self.start}: expected a count from 1 to {MOST_COUNT}")
        if isinstance(self.initial_bias, str) and self.initial_bias not in STARTS:
            hint = meant(STARTS, self.initial_bias)
            raise OptionError(f"initial bias {self.initial_bias!r}: expected first, zero or a record{hint}")
        if self.method == "covariance" and self.calibration is None:
            raise OptionError("method covariance needs --calibration RECORD: its weights come from a recording at rest")
        if isinstance(self.calibration, Blob):
            held = fusion_of_blob(self.calibration).to_dict()
            if {"method": self.method, "memory": self.memory, "start": self.start} != held:
                raise OptionError(
                    f"{self.calibration.name}: this blob fuses by {held['method']} with "
                    f"{memory_text(held['memory'], held['start'])}, and by nothing else"
                )
        if isinstance(self.calibration, Blob) and self.initial_bias != "first":
            raise OptionError(f"{self.calibration.name}: a blob holds the biases it starts from: no --initial-bias")
        if isinstance(self.initial_bias, Calibration) and self.calibration is not None:
            raise OptionError(
                "--initial-bias RECORD together with --calibration: the calibration takes the biases off already"
            )
        if self.rate is not None and not 0 < self.rate < 1e9:
            raise OptionError(f"rate {self.rate:g}: expected a positive number of Hz")
        if not 0 <= self.rate_walk < math.inf:
            raise OptionError(f"rate walk {self.rate_walk:g}: expected 0 or more")
        if self.still is not None and not self.still[0] < self.still[1]:
            raise OptionError(f"still {self.still[0]:g}:{self.still[1]:g}: expected a start before its end")


def open_stream(
    options: FuseOptions, elements: Elements, rate: float, first: Array, recording: str = "recording"
) -> Any:
    """Return a `runtime.Stream` for these elements of a recording of this name.

    The noise comes from the readings `first` where no record states it.

    Raises
    ------
    RecordError, UnitError
        The record is not of this array.
    """
    from imulab.device.unit import array_stream

    if isinstance(options.calibration, Blob):
        return blob_stream(options.calibration, elements, recording)
    calibration = None
    if options.calibration is not None:
        calibration = array_calibration(options.calibration, elements, recording)
    initial: Any = options.initial_bias
    bias = None if calibration is None else calibration.bias
    if isinstance(initial, Calibration):
        start = array_calibration(initial, elements, recording).bias
        if options.method == "feedback":
            initial = start
        else:  # the start is subtracted for good: the methods' estimates are relative to it
            initial, bias = "zero", start
    if options.method == "kalman" and bias is not None:
        initial = "zero"  # the noise of a first sample would stay in the biases until the gain removes it
    settings: dict[str, Any] = {
        "elements": elements.count,
        "axes": len(elements.axes),
        "memory": options.memory,
        "start": options.start,
        "initial_bias": initial,
        "bias": bias,
        "matrices": None if calibration is None else calibration.matrices,
        "rate": rate,
    }
    if calibration is not None and options.method in ("covariance", "robust"):
        settings["weights"] = np.ascontiguousarray(
            calibration.weights if options.method == "covariance" else _white_weights(calibration)
        )
    if options.method == "kalman":
        settings["gain"] = _gain(options, elements, rate, first, calibration)
    return array_stream(options.method, **settings)


def deviations_after_alignment(matrices: Array | None, spread: Array) -> Array:
    """Return standard deviations after alignment, shape (axes, n)."""
    if matrices is None:
        return spread
    turned: Array = np.sqrt(np.einsum("nab,bn->an", matrices**2, spread**2))
    return turned


def _white_weights(calibration: ArrayCalibration) -> Array:
    """Return the start weights of `robust`: inverse variances of the white noise."""
    inverse = 1 / np.maximum(deviations_after_alignment(calibration.matrices, calibration.white), 1e-300) ** 2
    weights: Array = inverse / inverse.sum(axis=1, keepdims=True)
    return weights


def _gain(
    options: FuseOptions, elements: Elements, rate: float, first: Array, calibration: ArrayCalibration | None
) -> Array:
    """Return the steady-state gain of `kalman`, shape (axes, n + 1, n)."""
    step = 1 / rate
    if calibration is not None:
        white = deviations_after_alignment(calibration.matrices, calibration.white) / np.sqrt(step)
        walk = deviations_after_alignment(calibration.matrices, calibration.walk)
        walk = np.maximum(walk, 0.1 * default_bias_walk(white))
    else:
        white = noise_about_mean(first)
        walk = default_bias_walk(white)
    gains = []
    for a, unit in enumerate(elements.units):
        if parse_unit(unit).quantity == "rate":
            rate_walk = float(from_si(options.rate_walk, unit))
            if calibration is None and (white[a] == 1.0).all():  # nothing is known: follow the motion
                rate_walk = _WITHOUT_UNIT / np.sqrt(step)
        else:
            rate_walk = _WITHOUT_UNIT * float(white[a].mean()) / np.sqrt(step)
        gains.append(steady_gain(white[a], walk[a], rate_walk, step))
    return np.ascontiguousarray(gains)
