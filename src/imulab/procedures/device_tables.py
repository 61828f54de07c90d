"""The tables of a record: its numbers in the order of the C core's structs, in the order in which they are applied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.device.array_settings import ArraySettings, Fusion, array_table, element_white_noise, fusion_of
from imulab.device.tables import Field, Table
from imulab.errors import RecordError
from imulab.recording import Array
from imulab.records.calibration import Calibration

MODELS = ("interval-cubic", "knot-cubic", "knot-log-cubic", "exponential")
EXITS = ("zero", "hold", "taper")
_AXES = "xyz"
_CROSSED = 256
"""Added to the order of a table that has cross terms."""


def tables_of(record: Calibration, fusion: Fusion | None = None) -> tuple[Table, ...]:
    """Return the tables of a record, in the order in which they are applied.

    An array fuses by `fusion`; by what its record carries where that is None.

    Raises
    ------
    RecordError
        The record lacks a parameter or has one that cannot be.
    """
    try:
        if record.procedure == "gyro_array":
            return _array(record, fusion)
        return _BUILD[record.procedure](record)
    except KeyError as error:
        raise RecordError(f"the record lacks {error.args[0]}") from None


# ---- tumble --------------------------------------------------------------------------------------------------------


def _tumble(record: Calibration) -> tuple[Table, ...]:
    order, output = record.model["order"], str(record.model["output_unit"])
    if type(order) is not int or not 0 <= order <= 5:
        raise RecordError(f"the record has order {order!r}, expected a whole number from 0 to 5")
    scale = _each(record, "scale_factor_{}", _AXES, f"{output}/(m/s^2)")
    nonlinearity = np.array(
        [_each(record, f"k{p}_{{}}", _AXES, "1/(m/s^2)" + (f"^{p - 1}" if p > 2 else "")) for p in range(2, order + 1)]
    ).reshape(-1, 3)
    ends = np.array([monotone_range(nonlinearity[:, axis]) for axis in range(3)])
    largest = float(np.finfo(np.float32).max)
    crossed = "k_xy" in record.parameters
    table = Table(
        "tumble",
        (
            Field("order", _whole(max(order, 1) + _CROSSED * crossed)),
            Field("gain", 1.0 / _nonzero(scale)),
            Field("bias", _each(record, "bias_{}", _AXES, "m/s^2")),
            Field("misalignment", _each(record, "misalignment_{}", ("yx", "zx", "zy"), "rad")),
            Field("low", np.clip(ends[:, 0], -largest, largest)),
            Field("high", np.clip(ends[:, 1], -largest, largest)),
            Field("nonlinearity", nonlinearity),
            *([Field("cross", _each(record, "k_{}", ("xy", "yz", "zx"), "1/(m/s^2)"))] if crossed else []),
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


_COLDEST, _HOTTEST, _HAIR = -273.15, 1000.0, 1e-3
"""How far a table is held beyond its edges, degC, and how soon its slope ends there, K."""
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
    tolerance = float(table.get("tolerance", 0.0))
    if table.get("beyond", "zero") == "hold":
        reach = (_COLDEST, _HOTTEST)
        temperatures, coefficients, slopes = _held(table["model"], temperatures, coefficients, slopes, reach)
    elif tolerance:
        reach = (float(temperatures[0]) - tolerance, float(temperatures[-1]) + tolerance)
        temperatures, coefficients, slopes = _held(table["model"], temperatures, coefficients, slopes, reach)
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
    return Table(
        "warmup",
        fields,
        {"axes": axes, "units": list(table["units"]), "range": ends, "end": _end(table), "exit": table["exit"]},
    )


def _held(
    model: str, temperatures: Array, coefficients: Array, slopes: Array | None, reach: tuple[float, float]
) -> tuple[Array, Array, Array | None]:
    """Return a table that goes on as at its edges, as far as it is to reach, degC.

    Outer intervals reach further, or there are outer knots of the same value.

    A unit needs no rule of its own for that. Slopes of exponential amplitudes end a hair beyond the outer knots.
    """
    low, high = float(temperatures[0]), float(temperatures[-1])
    if model == "interval-cubic":
        return np.array([reach[0], *temperatures[1:-1], reach[1]]), coefficients, None
    hair = min(_HAIR, (low - reach[0]) / 2)
    outside = ([reach[0]], [reach[1]])
    if slopes is not None:
        outside = ([reach[0], low - hair], [high + hair, reach[1]])
    count = len(outside[0])
    ends = [np.repeat(coefficients[[k]], count, axis=0) for k in (0, -1)]
    level = None if slopes is None else np.zeros_like(ends[0])
    return (
        np.array([*outside[0], *temperatures, *outside[1]]),
        np.concatenate([ends[0], coefficients, ends[1]]),
        None if slopes is None or level is None else np.concatenate([level, slopes, level]),
    )


def _end(table: Mapping[str, Any]) -> float:
    """Time from which on the table's curve no longer changes, s."""
    return float(table["settling_time"]) + (float(table["taper_time"]) if table["exit"] == "taper" else 0.0)


# ---- gyro array ----------------------------------------------------------------------------------------------------


def _array(record: Calibration, fusion: Fusion | None) -> tuple[Table, ...]:
    """The method that the record carries, with the elements' biases, alignment and noise; readings in rad/s."""
    if record.model.get("kind") != "calibration":
        raise RecordError(f"expected the record of an array calibration, found one of a {record.model.get('kind')}")
    elements = record.sections["elements"]
    axes = len(record.model["axes"])
    white = element_white_noise(record.sections)
    matrices = None
    if record.model["aligned"]:
        matrices = np.array(
            [e["matrix"]["value"] if "matrix" in e else [[1 / e["scale_factor"]["value"]]] for e in elements]
        )
        white = np.sqrt(np.einsum("nab,bn->an", matrices**2, white**2))
    by = fusion or fusion_of(record.model.get("fusion"))
    weights = None
    if by.method == "robust":
        inverse = 1 / np.maximum(white, 1e-300) ** 2
        weights = inverse / inverse.sum(axis=1, keepdims=True)
    elif by.method == "covariance":
        weights = np.array(record.sections["correlation"]["weights"], dtype=np.float64)
    elif by.method == "kalman":
        raise RecordError("method kalman has no table for a unit: expected another method, such as --method robust")
    settings = ArraySettings(
        by.method,
        len(elements),
        axes,
        bias=np.array([np.atleast_1d(element["bias"]["value"]) for element in elements]).T,
        matrices=matrices,
        weights=weights,
        memory=by.memory,
        start=by.start,
        rate=float(record.fit["sample_rate"]["value"]),
    )
    table = array_table(settings)
    return (Table(table.kind, table.fields, {**table.columns, **by.to_dict(), "unit": "rad/s", "rate": settings.rate}),)


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
