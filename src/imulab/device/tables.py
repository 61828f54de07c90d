"""Tables as the C core's structs and as bytes: of gyroscopes, of polynomials, and of the fusion of an array.

A blob is little-endian, versioned and closed by a CRC-32; the core checks it (``runtime/table.c`` has the layout).
The desk runs the same core on the same layout with 8 bytes per number, so that nothing is computed twice.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.device import METHODS, STARTS
from imulab.errors import OptionError, RecordError, listed, meant
from imulab.recording import Array, Recording
from imulab.records.calibration import BLOB_MAGIC, Calibration
from imulab.units import conversion_factor, from_si

# Structs and bytes.


VERSION, WITH_POWERS, WITH_IMUS = 1, 2, 3
"""Of the format; the second where gyroscopes have powers of the rate, the third with whole IMUs.

Older cores refuse these as newer.
"""
TEXT = 0  # kind of the section that holds a record's text
KINDS = {"tumble": 1, "gyro": 2, "centrifuge": 3, "warmup": 4, "array": 5, "mag": 6, "thermal": 7, "thermal_gyro": 8,
         "imus": 9}  # fmt: skip


@dataclass(frozen=True)
class Field:
    """One member of a C struct: whole or real numbers, shape () for a scalar, or a pointer to real numbers.

    None stands for NULL.
    """

    name: str
    values: NDArray[Any] | None
    pointed: bool = False

    @property
    def whole(self) -> bool:
        """Whether the member holds whole numbers."""
        return self.values is not None and self.values.dtype.kind in "iu"


@dataclass(frozen=True)
class DeviceTable:
    """The members of one section's struct (``il_tumble`` ...), in order, and a description of its columns."""

    kind: str
    fields: tuple[Field, ...]
    columns: Mapping[str, Any]

    def payload(self, width: int) -> bytes:
        """Return the section's bytes, `width` bytes per real number."""
        parts: list[bytes] = []
        pointed = [field for field in self.fields if field.pointed]
        mask = sum(1 << i for i, field in enumerate(pointed) if field.values is not None)
        masked = self.kind != "array"
        for field in self.fields:
            if not field.whole and not masked:  # the array's optional tables are announced before its real numbers
                parts.append(struct.pack("<I", mask))
                masked = True
            if field.values is not None:
                parts.append(field.values.astype("<u4" if field.whole else f"<f{width}").tobytes())
        return b"".join(parts)


def pack(tables: Sequence[DeviceTable], width: int, text: Mapping[str, Any] | None = None) -> bytes:
    """Return a blob of these sections; `width` is 8 on the desk and 4 for a unit.

    Raises
    ------
    RecordError
        A number is beyond the range of a float.
    """
    sections = [] if text is None else [(TEXT, json.dumps(text, ensure_ascii=False, sort_keys=True).encode("utf-8"))]
    with np.errstate(over="ignore"):
        for table in tables:
            for field in table.fields:
                if field.values is not None and not np.isfinite(field.values.astype(f"<f{width}")).all():
                    raise RecordError(f"{table.kind} {field.name}: {field.values} is beyond what {width} bytes hold")
    sections += [(KINDS[table.kind], table.payload(width)) for table in tables]
    body = b"".join(struct.pack("<II", kind, len(payload)) + payload for kind, payload in sections)
    bent = any(table.kind == "gyro" and any(field.name == "order" for field in table.fields) for table in tables)
    whole_imus = any(table.kind == "imus" for table in tables)
    version = WITH_IMUS if whole_imus else WITH_POWERS if bent else VERSION
    head = BLOB_MAGIC + struct.pack("<HHI", version, width, len(BLOB_MAGIC) + 8 + len(body) + 4)
    return head + body + struct.pack("<I", zlib.crc32(head + body))


def whole(value: int) -> NDArray[np.int64]:
    """Return a whole number as the value of a field."""
    return np.array(int(value), dtype=np.int64)


def values_of(record: Calibration, names: Sequence[str], unit: str) -> Array:
    """Return the values of parameters, after a check that they are in this unit.

    Raises
    ------
    RecordError
        The record lacks one, or has it in another unit.
    """
    values = []
    for name in names:
        parameter = record.parameter(name)
        if parameter.unit != unit:
            raise RecordError(f"the record has {name} in {parameter.unit!r}, expected {unit!r}")
        values.append(parameter.value)
    return np.array(values, dtype=np.float64)


def nonzero(scale: Array) -> Array:
    """Return scale factors; refuse a zero.

    Raises
    ------
    RecordError
        One is.
    """
    if not (scale != 0).all():
        raise RecordError("the record has a scale factor of 0")
    return scale


def field_of(table: DeviceTable, name: str) -> NDArray[Any]:
    """Return the values of a table's field."""
    (values,) = [field.values for field in table.fields if field.name == name]
    return np.asarray(values)


# Fusion of a gyro array, as settings and as a table.


MOST_ELEMENTS = 64  # of an axis, as IL_ARRAY_ELEMENTS of the largest configuration of the C core
MOST_COUNT = 1_000_000_000
"""Largest starting count of the growing memory."""


@dataclass(frozen=True)
class Fusion:
    """How a unit fuses several sensors.

    Attributes
    ----------
    method, memory, start
        Of gyros on one axis; None for the growing memory that begins at k = `start`.
    at, gyro_range, accel_range
        Of whole IMUs: the point of the specific force, and where their ranges end, rad/s and m/s^2; None if not known.
    """

    method: str = "robust"
    memory: float | None = None
    start: int = 1
    at: str = "centroid"
    gyro_range: float | None = None
    accel_range: float | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise OptionError(f"method {self.method!r}: expected one of {listed(METHODS, self.method)}")

    def to_dict(self) -> dict[str, Any]:
        """Return that of gyros on one axis as it stands in a record or a blob."""
        return {"method": self.method, "memory": "growing" if self.memory is None else self.memory, "start": self.start}


def fusion_of(held: Any) -> Fusion:
    """Return the fusion in a record or a blob; robust with growing memory if it states none.

    Raises
    ------
    RecordError
        It is no such method, memory or count.
    """
    if held is None:
        return Fusion()
    if isinstance(held, Mapping):
        method, memory, start = held.get("method"), held.get("memory", "growing"), held.get("start", 1)
        gain = isinstance(memory, float) and 0 < memory < 1
        if method in METHODS and (gain or memory == "growing") and type(start) is int and 1 <= start <= MOST_COUNT:
            return Fusion(str(method), memory if isinstance(memory, float) else None, start)
    raise RecordError(f"fusion: expected a method, a memory and a starting count, found {str(held)[:60]}")


@dataclass(frozen=True)
class ArraySettings:
    """Settings of a fusion; times in s become samples at `rate`.

    Attributes
    ----------
    method, elements, axes
        Name of the method, gyros per axis, 1 or 3 axes.
    memory, start
        None for the growing memory that begins at k = `start`, or a fixed gain in (0, 1).
    initial_bias
        ``first``, ``zero``, or biases (axes, elements) in the unit of the data.
    kernel
        Of ``support``: ``gaussian`` or ``exponential``.
    bias, matrices
        Calibration, removed first: z = matrix (reading - bias); (axes, elements) and (elements, axes, axes).
    weights
        (axes, elements): of ``covariance``; for ``robust`` inverse variances, relative, to start with.
    gain
        Of ``kalman``: (axes, elements + 1, elements), steady-state gain of rate and biases.
    rate
        Samples per second.
    gate, spread_gate
        Of ``robust``: standard deviations of a gyro's own noise, and of the array in this sample.
    weight_cap, weight_floor, scale_tolerance
        Largest weight; smallest variance in mean variances; share of the rate by which healthy gyros may differ.
    memory_time, stuck_time, jump_time, quiet_time
        Of ``robust``, s.
    """

    method: str
    elements: int
    axes: int = 1
    memory: float | None = None
    start: int = 1
    initial_bias: Any = "first"
    kernel: str = "gaussian"
    bias: Any = None
    matrices: Any = None
    weights: Any = None
    gain: Any = None
    rate: float = 100.0
    gate: float = 6.0
    spread_gate: float = 4.0
    weight_cap: float = 0.5
    weight_floor: float = 0.05
    scale_tolerance: float = 0.01
    memory_time: float = 100.0
    stuck_time: float = 0.5
    jump_time: float = 0.5
    quiet_time: float = 1.0


def array_table(settings: ArraySettings) -> DeviceTable:
    """Return the table of an array's settings.

    Raises
    ------
    OptionError
        The method is unknown, or an array has another shape.
    """
    s, n, axes = settings, settings.elements, settings.axes
    if s.method not in METHODS:
        raise OptionError(f"unknown method {s.method!r}; known methods: {listed(METHODS, s.method)}")
    if s.kernel not in ("gaussian", "exponential"):
        raise OptionError(
            f"unknown kernel {s.kernel!r}; known kernels: {listed(('gaussian', 'exponential'), s.kernel)}"
        )
    if axes not in (1, 3):
        raise OptionError(f"{axes} axes: expected 1 or 3")
    least = 3 if s.method == "robust" else 1
    if not least <= n <= MOST_ELEMENTS:
        raise OptionError(f"{s.method}: expected {least} to {MOST_ELEMENTS} gyros per axis, found {n}")
    if s.memory is not None and not 0 < s.memory < 1:
        raise OptionError(f"memory {s.memory}: expected growing, or a gain between 0 and 1")
    if not (s.rate > 0 and np.isfinite(s.rate)):
        raise OptionError(f"rate {s.rate}: expected more than 0 Hz")
    stated_bias = s.initial_bias if not isinstance(s.initial_bias, str) else None
    if stated_bias is None and s.initial_bias not in STARTS:
        hint = meant(STARTS, s.initial_bias)
        raise OptionError(f"initial bias {s.initial_bias!r}: expected first, zero or biases{hint}")

    def samples(time: float, least: int) -> np.int64:
        return np.int64(min(max(round(time * s.rate), least), 2**31))

    words = {
        "method": METHODS.index(s.method),
        "elements": n,
        "axes": axes,
        "initial": 2 if stated_bias is not None else STARTS.index(s.initial_bias),
        "kernel": ("gaussian", "exponential").index(s.kernel),
        "start": s.start,
        "cap": samples(s.memory_time, 100),
        "stuck": samples(s.stuck_time, 20),
        "jump": samples(s.jump_time, 10),
        "quiet": samples(s.quiet_time, 5),
    }
    numbers = {
        "memory": s.memory or 0.0,
        "gate": s.gate,
        "spread_gate": s.spread_gate,
        "scale_tolerance": s.scale_tolerance,
        "weight_cap": s.weight_cap,
        "weight_floor": s.weight_floor,
    }
    pointed = {
        "offset": _shaped(s.bias, (axes, n), "bias"),
        "matrix": _shaped(s.matrices, (n, axes, axes), "matrices"),
        "bias": _shaped(stated_bias, (axes, n), "initial bias"),
        "weight": _shaped(s.weights, (axes, n), "weights"),
        "gain": _shaped(s.gain, (axes, n + 1, n), "gain"),
    }
    fields = [Field(name, np.array(value, dtype=np.int64)) for name, value in words.items()]
    fields += [Field(name, np.array(value, dtype=np.float64)) for name, value in numbers.items()]
    fields += [Field(name, values, pointed=True) for name, values in pointed.items()]
    return DeviceTable("array", tuple(fields), {"elements": n, "axes": axes, "method": s.method})


def _shaped(values: Any, shape: tuple[int, ...], name: str) -> Array | None:
    if values is None:
        return None
    array = np.asarray(values, dtype=np.float64)
    if array.size != np.prod(shape):
        raise OptionError(f"{name}: expected shape {shape}, found {array.shape}")
    if not np.isfinite(array).all():
        raise OptionError(f"{name}: expected finite numbers")
    return array.reshape(shape)


# The table of a triad of gyroscopes, and the polynomials that accelerometers and gyroscopes have.


HIGHEST_POWER = 5  # of the rate in the C core's polynomial
_BEYOND = 1.05
"""Factor of the largest tested rate that noise, bias and the Earth's rate do not exceed."""


def gyro_table(
    scale: Array,
    bias: Array,
    misalignment: Array,
    powers: Array,
    columns: Mapping[str, Any],
    *,
    sensitivity: Array | None = None,
) -> DeviceTable:
    """Return the table of gyroscopes ``M = S (s + k2 s^2 + ... + b + G f)``, ``s = T w``.

    Scale factor S and bias b (3,), T and sensitivity G (3, 3), powers k2 .. ke (e - 1, 3).

    Raises
    ------
    RecordError
        A scale factor is 0.
    """
    fields = [
        Field("has_sensitivity", whole(sensitivity is not None)),
        *([Field("order", whole(len(powers) + 1))] if len(powers) else []),
        Field("gain", 1.0 / nonzero(scale)),
        Field("bias", bias),
        Field("turn", np.linalg.inv(misalignment)),
        *([] if sensitivity is None else [Field("sensitivity", sensitivity)]),
        *(polynomial(powers) if len(powers) else ()),
    ]
    return DeviceTable("gyro", tuple(fields), columns)


def gyro_powers(record: Calibration) -> Array:
    """Return k2 .. ke of the gyroscopes of a record, SI, shape (e - 1, 3); 0 where it has none.

    Raises
    ------
    RecordError
        One is in another unit.
    """
    powers = np.zeros((HIGHEST_POWER - 1, 3))
    for row, power in enumerate(range(2, HIGHEST_POWER + 1)):
        for i, axis in enumerate("xyz"):
            if (name := f"gyro_k{power}_{axis}") in record.parameters:
                powers[row, i] = values_of(record, [name], "1/(rad/s)" + (f"^{power - 1}" if power > 2 else ""))[0]
    return powers[: int(np.max(np.flatnonzero(powers.any(axis=1)) + 1, initial=0))]


def polynomial(nonlinearity: Array) -> tuple[Field, Field, Field]:
    """Return the fields of ``s + k2 s^2 + ...``: readings between its turning points, and k2 .. ke, shape (e - 1, 3).

    Raises
    ------
    RecordError
        A coefficient cannot be.
    """
    ends = np.array([monotone_range(nonlinearity[:, axis]) for axis in range(3)])
    largest = float(np.finfo(np.float32).max)
    low, high = (np.clip(ends[:, k], -largest, largest) for k in range(2))
    return Field("low", low), Field("high", high), Field("nonlinearity", nonlinearity)


def monotone_range(nonlinearity: Array) -> tuple[float, float]:
    """Return the readings between the turning points of ``s + k2 s^2 + ...`` next to zero, infinite without any."""
    if not nonlinearity.any():
        return -np.inf, np.inf
    powers = np.concatenate([[0.0, 1.0], nonlinearity])
    slope = np.polynomial.polynomial.polyder(powers)
    try:
        turns = np.polynomial.polynomial.polyroots(slope)
    except np.linalg.LinAlgError:
        raise RecordError("the record has a nonlinearity that cannot be: it has no turning points") from None
    real = turns[np.abs(turns.imag) < 1e-12 * np.maximum(np.abs(turns), 1.0)].real
    low, high = real[real < 0].max(initial=-np.inf), real[real > 0].min(initial=np.inf)
    ends = [float(np.polynomial.polynomial.polyval(s, powers)) if np.isfinite(s) else s for s in (low, high)]
    return ends[0], ends[1]


def beyond_rates(record: Calibration, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie beyond the largest rate tested by more than 5 %, and the largest rate, rad/s.

    Nothing where the record does not say what was tested.
    """
    if "largest_rate" not in record.model:
        return 0, 0.0
    sizes = [np.zeros(len(recording))]
    for axis in record.model.get("axes", "xyz"):
        if (name := f"gyro_{axis}") in recording:
            factor = conversion_factor(recording.units[name], record.model["gyro_output_unit"])
            rate = recording.column(name) * (factor / record.value(f"gyro_scale_factor_{axis}"))
            size = np.abs(rate - record.value(f"gyro_bias_{axis}"))
            sizes.append(np.where(np.isfinite(size), size, 0.0))
    size = np.maximum.reduce(sizes)
    return int(np.count_nonzero(size > _BEYOND * record.model["largest_rate"]["value"])), float(size.max(initial=0.0))


def beyond_message(record: Calibration, count: int, largest: float) -> str:
    """Return the message that so many samples, the largest in rad/s, lie beyond the rates of the test."""
    held = "line" if record.model["gyro_order"] == 1 else "polynomial"
    return (
        f"{count} samples beyond {from_si(record.model['largest_rate']['value'], 'deg/s'):.4g} deg/s (up to "
        f"{from_si(largest, 'deg/s'):.4g} deg/s), the largest rate of the record's test: its {held} is extrapolated "
        "there"
    )
