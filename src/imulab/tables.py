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
from imulab.errors import RecordError
from imulab.recording import Array

VERSION = 1
TEXT = 0
KINDS = {"tumble": 1, "gyro": 2, "centrifuge": 3, "warmup": 4, "array": 5}
MODELS = ("interval-cubic", "knot-cubic", "knot-log-cubic", "exponential")
EXITS = ("zero", "hold", "taper")
METHODS = ("mean", "support", "least-squares", "feedback", "robust", "covariance", "kalman")
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


def _centrifuge(record: Calibration) -> tuple[Table, ...]:
    axes = [axis for axis in "xy" if f"{axis}_K0" in record.parameters]
    if not axes:
        raise RecordError("the record lacks x_K0")
    for axis in axes:
        if f"{axis}_direction" not in record.parameters:
            raise RecordError(
                f"the record has no {axis}_direction: it was reduced without table_angle, "
                "so the drift's direction is not known and cannot be removed"
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
        Field("taper_time", np.array(float(table.get("taper_time") or 0.0))),
        Field("time_scale", np.array(float(table.get("time_scale") or 0.0))),
        Field("time_constant", constants),
        Field("temperature", temperatures, pointed=True),
        Field("coefficient", coefficients, pointed=True),
        Field("slope", slopes, pointed=True),
    )
    return Table("warmup", fields, {"axes": axes, "units": list(table["units"])})


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


_BUILD = {"tumble": _tumble, "centrifuge": _centrifuge, "warmup": _warmup}
