"""Tables: a unit's numbers in the order of the C core's structs, and as the bytes ("blob") that the core loads.

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

from imulab.calibration import BLOB_MAGIC, Calibration
from imulab.errors import OptionError, RecordError
from imulab.recording import Array

VERSION = 1
TEXT = 0
KINDS = {"tumble": 1, "gyro": 2, "centrifuge": 3, "warmup": 4, "array": 5}
MODELS = ("interval-cubic", "knot-cubic", "knot-log-cubic", "exponential")
EXITS = ("zero", "hold", "taper")
METHODS = ("mean", "support", "least-squares", "feedback", "robust", "covariance", "kalman")
MOST_ELEMENTS = 64
_AXES = "xyz"


@dataclass(frozen=True)
class Field:
    """One member of a C struct: whole or real numbers, of shape () for a scalar, or real numbers that it points to.

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
class Table:
    """The members of one section's struct (``il_tumble`` ...), in order, and what the desk knows about its columns."""

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


def pack(tables: Sequence[Table], width: int, text: Mapping[str, Any] | None = None) -> bytes:
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
    head = BLOB_MAGIC + struct.pack("<HHI", VERSION, width, len(BLOB_MAGIC) + 8 + len(body) + 4)
    return head + body + struct.pack("<I", zlib.crc32(head + body))


def tables_of(record: Calibration) -> tuple[Table, ...]:
    """Return the tables of a record, in the order in which they are applied.

    Raises
    ------
    RecordError
        The record lacks a parameter or has one that cannot be.
    """
    try:
        return _BUILD[record.procedure](record)
    except KeyError as error:
        raise RecordError(f"the record lacks {error.args[0]}") from None


# ---- tumble --------------------------------------------------------------------------------------------------------


def _tumble(record: Calibration) -> tuple[Table, ...]:
    order, output = record.model["order"], str(record.model["output_unit"])
    if type(order) is not int or not 1 <= order <= 5:
        raise RecordError(f"the record has order {order!r}, expected a whole number from 1 to 5")
    scale = _each(record, "scale_factor_{}", _AXES, f"{output}/(m/s^2)")
    nonlinearity = np.array(
        [_each(record, f"k{p}_{{}}", _AXES, "1/(m/s^2)" + (f"^{p - 1}" if p > 2 else "")) for p in range(2, order + 1)]
    ).reshape(order - 1, 3)
    ends = np.array([monotone_range(nonlinearity[:, axis]) for axis in range(3)])
    largest = float(np.finfo(np.float32).max)
    table = Table(
        "tumble",
        (
            Field("order", _whole(order)),
            Field("gain", 1.0 / _nonzero(scale)),
            Field("bias", _each(record, "bias_{}", _AXES, "m/s^2")),
            Field("misalignment", _each(record, "misalignment_{}", ("yx", "zx", "zy"), "rad")),
            Field("low", np.clip(ends[:, 0], -largest, largest)),
            Field("high", np.clip(ends[:, 1], -largest, largest)),
            Field("nonlinearity", nonlinearity),
        ),
        {"output_unit": output},
    )
    return (table, *_gyro(record)) if "gyro_bias_x" in record.parameters else (table,)


def _gyro(record: Calibration) -> tuple[Table, ...]:
    scale = np.array([record.value(f"gyro_scale_factor_{axis}") for axis in _AXES])
    misalignment = np.eye(3)
    for i, j in ((i, j) for i in range(3) for j in range(3) if i != j):
        misalignment[i, j] = record.value(f"gyro_misalignment_{_AXES[i]}{_AXES[j]}")
    sensitive = "gyro_g_sensitivity_xx" in record.parameters
    fields = [
        Field("has_sensitivity", _whole(sensitive)),
        Field("gain", 1.0 / _nonzero(scale)),
        Field("bias", np.array([record.value(f"gyro_bias_{axis}") for axis in _AXES])),
        Field("turn", np.linalg.inv(misalignment)),
    ]
    if sensitive:
        g = [[record.value(f"gyro_g_sensitivity_{i}{j}") for j in _AXES] for i in _AXES]
        fields.append(Field("sensitivity", np.array(g)))
    return (Table("gyro", tuple(fields), {"output_unit": str(record.model["gyro_output_unit"])}),)


def monotone_range(nonlinearity: Array) -> tuple[float, float]:
    """Return the readings between the turning points of ``s + k2 s^2 + ...`` next to zero, infinite without any."""
    powers = np.concatenate([[0.0, 1.0], nonlinearity])
    slope = np.polynomial.polynomial.polyder(powers)
    turns = np.polynomial.polynomial.polyroots(slope)
    real = turns[np.abs(turns.imag) < 1e-12 * np.maximum(np.abs(turns), 1.0)].real
    low, high = real[real < 0].max(initial=-np.inf), real[real > 0].min(initial=np.inf)
    ends = [float(np.polynomial.polynomial.polyval(s, powers)) if np.isfinite(s) else s for s in (low, high)]
    return ends[0], ends[1]


# ---- centrifuge ----------------------------------------------------------------------------------------------------


_CURVE_UNITS = {"K0": "rad/s/(m/s^2)", "c1": "1/(m/s^2)", "c2": "1/(m/s^2)^2", "direction": "rad"}


def _centrifuge(record: Calibration) -> tuple[Table, ...]:
    axes = [axis for axis in "xy" if f"{axis}_K0" in record.parameters]
    if not axes:
        raise RecordError("the record lacks x_K0")
    for name, parameter in record.parameters.items():
        expected = _CURVE_UNITS.get(name.rpartition("_")[2])
        if expected is not None and parameter.unit != expected:
            raise RecordError(f"the record has {name} in {parameter.unit!r}, expected {expected!r}")
    for axis in axes:
        if f"{axis}_direction" not in record.parameters:
            raise RecordError(
                f"the record has no {axis}_direction: it was made without table_angle, "
                "so that the direction of the drift in the gyroscope is not known"
            )

    def both(name: str) -> Array:
        return np.array(
            [p.value if (p := record.parameters.get(f"{axis}_{name}")) is not None else 0.0 for axis in "xy"]
        )

    highest = max(float(level["specific_force"]["value"]) for level in record.sections["levels"])
    table = Table(
        "centrifuge",
        (
            Field("has", np.array([axis in axes for axis in "xy"], dtype=np.int64)),
            Field("highest", np.array(highest)),
            *(Field(name.lower(), both(name)) for name in ("K0", "c1", "c2")),
            Field("cosine", np.cos(both("direction"))),
            Field("sine", np.sin(both("direction"))),
        ),
        {"axes": axes, "highest": highest},
    )
    return (table,)


# ---- warm-up -------------------------------------------------------------------------------------------------------


def _warmup(record: Calibration) -> tuple[Table, ...]:
    return (warmup_table(record.sections["table"]),)


def warmup_table(table: Mapping[str, Any]) -> Table:
    """Return the warm-up table of a record's section ``table``.

    Raises
    ------
    RecordError
        Its numbers do not fit each other.
    """
    if table["model"] not in MODELS or table["exit"] not in EXITS:
        raise RecordError(f"the table has model {table['model']!r} and exit {table['exit']!r}, which are not known")
    model = MODELS.index(table["model"])
    temperatures = np.array(table["temperatures"], dtype=np.float64)
    coefficients = np.array(table["coefficients"], dtype=np.float64)
    slopes = np.array(table["slopes"], dtype=np.float64) if table["model"] == "exponential" else None
    constants = np.zeros(3)
    if table["model"] == "exponential":
        constants[: len(table["time_constants"])] = table["time_constants"]
    axes = list(table["axes"])
    rows = len(temperatures) - (table["model"] == "interval-cubic")
    terms = len(table["time_constants"]) if table["model"] == "exponential" else 4
    shape = (rows, len(axes), terms)
    if coefficients.shape != shape or (slopes is not None and slopes.shape != shape):
        raise RecordError(f"the table has coefficients of shape {coefficients.shape}, expected {shape}")
    fields = (
        Field("model", _whole(model)),
        Field("exit", _whole(EXITS.index(table["exit"]))),
        Field("temperatures", _whole(len(temperatures))),
        Field("axes", _whole(len(axes))),
        Field("terms", _whole(terms)),
        Field("settling_time", np.array(float(table["settling_time"]))),
        Field("taper_time", np.array(float(table["taper_time"]) if table["exit"] == "taper" else 0.0)),
        Field("time_scale", np.array(float(table.get("time_scale") or 0.0))),
        Field("time_constant", constants),
        Field("temperature", temperatures, pointed=True),
        Field("coefficient", coefficients, pointed=True),
        Field("slope", slopes, pointed=True),
    )
    ends = [float(temperatures[0]), float(temperatures[-1])]
    return Table("warmup", fields, {"axes": axes, "units": list(table["units"]), "range": ends, "end": _end(table)})


def _end(table: Mapping[str, Any]) -> float:
    """Time from which on the table's curve no longer changes, s."""
    return float(table["settling_time"]) + (float(table["taper_time"]) if table["exit"] == "taper" else 0.0)


# ---- gyro array ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ArraySettings:
    """How an array is fused; times in s become samples at `rate`.

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


def _array(record: Calibration) -> tuple[Table, ...]:
    """The robust method, with the elements' biases, alignment and noise; readings in rad/s."""
    if record.model.get("kind") != "calibration":
        raise RecordError(f"expected the record of an array calibration, found one of a {record.model.get('kind')}")
    elements = record.sections["elements"]
    axes = len(record.model["axes"])
    white = np.array([np.atleast_1d(element["angle_random_walk"]["value"]) for element in elements]).T
    matrices = None
    if record.model["aligned"]:
        matrices = np.array(
            [e["matrix"]["value"] if "matrix" in e else [[1 / e["scale_factor"]["value"]]] for e in elements]
        )
        white = np.sqrt(np.einsum("nab,bn->an", matrices**2, white**2))
    inverse = 1 / np.maximum(white, 1e-300) ** 2
    settings = ArraySettings(
        "robust",
        len(elements),
        axes,
        bias=np.array([np.atleast_1d(element["bias"]["value"]) for element in elements]).T,
        matrices=matrices,
        weights=inverse / inverse.sum(axis=1, keepdims=True),
        rate=float(record.fit["sample_rate"]["value"]),
    )
    table = array_table(settings)
    return (Table(table.kind, table.fields, {**table.columns, "unit": "rad/s", "rate": settings.rate}),)


def array_table(settings: ArraySettings) -> Table:
    """Return the table of an array's settings.

    Raises
    ------
    OptionError
        The method is unknown, or an array has another shape.
    """
    s, n, axes = settings, settings.elements, settings.axes
    if s.method not in METHODS:
        raise OptionError(f"unknown method {s.method!r}; known methods: {' '.join(METHODS)}")
    if s.kernel not in ("gaussian", "exponential"):
        raise OptionError(f"unknown kernel {s.kernel!r}; known kernels: gaussian exponential")
    if axes not in (1, 3):
        raise OptionError(f"{axes} axes: expected 1 or 3")
    least = 3 if s.method == "robust" else 1
    if not least <= n <= MOST_ELEMENTS:
        raise OptionError(f"{s.method}: expected {least} to {MOST_ELEMENTS} gyros per axis, found {n}")
    if s.memory is not None and not 0 < s.memory < 1:
        raise OptionError(f"memory {s.memory}: expected growing, or a gain between 0 and 1")
    if not (s.rate > 0 and np.isfinite(s.rate)):
        raise OptionError(f"rate {s.rate}: expected more than 0 Hz")
    given = s.initial_bias if not isinstance(s.initial_bias, str) else None
    if given is None and s.initial_bias not in ("first", "zero"):
        raise OptionError(f"initial bias {s.initial_bias!r}: expected first, zero or biases")

    def samples(time: float, least: int) -> np.int64:
        return np.int64(min(max(round(time * s.rate), least), 2**31))

    words = {
        "method": METHODS.index(s.method),
        "elements": n,
        "axes": axes,
        "initial": 2 if given is not None else ("first", "zero").index(s.initial_bias),
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
        "bias": _shaped(given, (axes, n), "initial bias"),
        "weight": _shaped(s.weights, (axes, n), "weights"),
        "gain": _shaped(s.gain, (axes, n + 1, n), "gain"),
    }
    fields = [Field(name, np.array(value, dtype=np.int64)) for name, value in words.items()]
    fields += [Field(name, np.array(value, dtype=np.float64)) for name, value in numbers.items()]
    fields += [Field(name, values, pointed=True) for name, values in pointed.items()]
    return Table("array", tuple(fields), {"elements": n, "axes": axes, "method": s.method})


def _shaped(values: Any, shape: tuple[int, ...], name: str) -> Array | None:
    if values is None:
        return None
    found = np.asarray(values, dtype=np.float64)
    if found.size != np.prod(shape):
        raise OptionError(f"{name}: expected shape {shape}, found {found.shape}")
    if not np.isfinite(found).all():
        raise OptionError(f"{name}: expected finite numbers")
    return found.reshape(shape)


# ---- small things --------------------------------------------------------------------------------------------------


def _whole(value: int) -> NDArray[np.int64]:
    return np.array(int(value), dtype=np.int64)


def _each(record: Calibration, name: str, places: Sequence[str], unit: str) -> Array:
    values = []
    for place in places:
        parameter = record.parameters[name.format(place)]
        if parameter.unit != unit:
            raise RecordError(f"the record has {name.format(place)} in {parameter.unit!r}, expected {unit!r}")
        values.append(parameter.value)
    return np.array(values, dtype=np.float64)


def _nonzero(scale: Array) -> Array:
    if not (scale != 0).all():
        raise RecordError("the record has a scale factor of 0")
    return scale


_BUILD = {"tumble": _tumble, "gyro_array": _array, "centrifuge": _centrifuge, "warmup": _warmup}
