"""A tumble record as the tables that the C core runs, and the vectors by which an exported unit tests itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.device.golden import VECTORS
from imulab.device.gyroscopes import gyro_powers, gyro_table, polynomial
from imulab.device.tables import DeviceTable, Field, field_of, nonzero, values_of, whole
from imulab.device.unit import DeviceUnit
from imulab.errors import RecordError
from imulab.procedures.tumble.choices import HIGHEST_ORDER
from imulab.procedures.tumble.sections import model_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import CROSS_TERMS
from imulab.units import STANDARD_GRAVITY

_AXES = "xyz"
_CROSSED = 256
"""Added to the order of a table that has cross terms."""


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the tables of a tumble record: accelerometers, and gyroscopes and magnetometers where it has them.

    Raises
    ------
    RecordError
        The record lacks a parameter, or has one in another unit or with a value that cannot be.
    """
    model = model_of(record)
    order, output = model.order, model.output_unit
    if order > HIGHEST_ORDER:
        raise RecordError(f"the record has order {order!r}, expected a whole number from 0 to 5")
    scale = values_of(record, [f"scale_factor_{axis}" for axis in _AXES], f"{output}/(m/s^2)")
    nonlinearity = np.array(
        [
            values_of(record, [f"k{p}_{axis}" for axis in _AXES], "1/(m/s^2)" + (f"^{p - 1}" if p > 2 else ""))
            for p in range(2, order + 1)
        ]
    ).reshape(-1, 3)
    crossed = CROSS_TERMS[0] in record.parameters
    table = DeviceTable(
        "tumble",
        (
            Field("order", whole(max(order, 1) + _CROSSED * crossed)),
            Field("gain", 1.0 / nonzero(scale)),
            Field("bias", values_of(record, [f"bias_{axis}" for axis in _AXES], "m/s^2")),
            Field("misalignment", values_of(record, [f"misalignment_{pair}" for pair in ("yx", "zx", "zy")], "rad")),
            *polynomial(nonlinearity),
            *([Field("cross", values_of(record, CROSS_TERMS, "1/(m/s^2)"))] if crossed else []),
        ),
        {"output_unit": output},
    )
    return (
        table,
        *(_gyro(record) if "gyro_bias_x" in record.parameters else ()),
        *(_mag(record) if "mag_bias_x" in record.parameters else ()),
    )


def _gyro(record: Calibration) -> tuple[DeviceTable, ...]:
    scale = np.array([record.value(f"gyro_scale_factor_{axis}") for axis in _AXES])
    misalignment = np.eye(3)
    for i, j in ((i, j) for i in range(3) for j in range(3) if i != j):
        misalignment[i, j] = record.value(f"gyro_misalignment_{_AXES[i]}{_AXES[j]}")
    g = None
    if "gyro_g_sensitivity_xx" in record.parameters:
        g = np.array([[record.value(f"gyro_g_sensitivity_{i}{j}") for j in _AXES] for i in _AXES])
    bias = np.array([record.value(f"gyro_bias_{axis}") for axis in _AXES])
    columns = {"output_unit": model_of(record).gyro_output_unit}
    return (gyro_table(scale, bias, misalignment, gyro_powers(record), columns, sensitivity=g),)


def _mag(record: Calibration) -> tuple[DeviceTable, ...]:
    """Magnetometers: ``m = T^-1 s`` with s of each output, whose signs and places are in ``T^-1 P``."""
    model = model_of(record)
    if model.mag_order not in (1, 2):
        raise RecordError(f"the record has mag_order {model.mag_order!r}, expected 1 or 2")
    axes = mag_axes(model.mag_axes)
    scale = np.array([record.value(f"mag_scale_factor_{axis}") for axis in _AXES])
    bias = np.array([record.value(f"mag_bias_{axis}") for axis in _AXES])
    misalignment = np.eye(3)
    for i, j in ((i, j) for i in range(3) for j in range(3) if i != j):
        misalignment[i, j] = record.value(f"mag_misalignment_{_AXES[i]}{_AXES[j]}")
    fields = [
        Field("order", whole(model.mag_order)),
        Field("gain", np.abs(axes).T @ (1.0 / nonzero(scale))),
        Field("bias", axes.T @ bias),
        Field("turn", np.linalg.inv(misalignment) @ axes),
    ]
    if model.mag_order == 2:
        fields.append(Field("quadratic", axes.T @ np.array([record.value(f"mag_k2_{axis}") for axis in _AXES])))
    unit = "T" if model.field is not None and model.field.unit == "T" else "1"
    return (DeviceTable("mag", tuple(fields), {"output_unit": model.mag_output_unit, "field_unit": unit}),)


def mag_axes(text: str) -> Array:
    """Return the signed permutation of ``"+y -x +z"``, shape (3, 3): row k names the output that becomes axis k.

    Raises
    ------
    RecordError
        It names no axis, or one twice.
    """
    named = np.zeros((3, 3))
    for axis, word in enumerate(text.split()[:3]):
        if len(word) == 2 and word[0] in "+-" and word[1] in _AXES:
            named[axis, _AXES.index(word[1])] = 1.0 if word[0] == "+" else -1.0
    if len(text.split()) != 3 or (np.abs(named).sum(axis=0) != 1).any() or (np.abs(named).sum(axis=1) != 1).any():
        raise RecordError(f"the record has mag_axes {text!r}, expected three such as '+y -x +z'")
    return named


def golden_accelerometers(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return outputs within 2 g, or as far as the polynomials rise, and their specific forces."""
    reach = 0.9 * np.minimum(2 * STANDARD_GRAVITY, np.minimum(-field_of(table, "low"), field_of(table, "high")))
    output = (rng.uniform(-1, 1, (VECTORS, 3)) * reach + field_of(table, "bias")) / field_of(table, "gain")
    output[1, 1] = np.nan
    force, _ = DeviceUnit.of(table).tumble(list(output.T))
    return {"": VECTORS, "scale": 2 * STANDARD_GRAVITY, "output": output, "force": np.column_stack(force)}


def golden_magnetometers(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return outputs of fields up to twice the local one, and those fields."""
    size = 1e-4 if table.columns["field_unit"] == "T" else 2.0
    output = (rng.uniform(-size, size, (VECTORS, 3)) + field_of(table, "bias")) / field_of(table, "gain")
    output[1, 0] = np.nan
    field, _ = DeviceUnit.of(table).mag(list(output.T))
    return {"": VECTORS, "scale": size, "output": output, "field": np.column_stack(field)}
