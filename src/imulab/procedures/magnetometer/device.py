"""The table of a unit's magnetometers from a record of them alone, and their matrices for other programs."""

from __future__ import annotations

import numpy as np

from imulab.device.tables import DeviceTable, Field, whole
from imulab.errors import RecordError
from imulab.procedures.magnetometer import AXES
from imulab.procedures.magnetometer.model import parameter_names
from imulab.procedures.magnetometer.schema import model_of
from imulab.procedures.magnetometer.solve import unpack
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import Magnetometers
from imulab.units import parse_unit


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the table ``m = turn (gain M - bias)``; an axis that a level turn does not show passes as it is.

    Raises
    ------
    RecordError
        The record lacks a parameter, or D has no inverse.
    """
    model = model_of(record)
    hard, soft = matrices(record)
    # Outputs in units of field become T, others parts of the field, so that all numbers are near 1 field.
    size = (
        1.0 if parse_unit(model.mag_output_unit).quantity == "magnetic field" else float(np.cbrt(np.linalg.det(soft)))
    )
    fields = (
        Field("order", whole(1)),
        Field("gain", np.full(3, output_unit(record) / size)),
        Field("bias", hard / size),
        Field("turn", np.asarray(np.linalg.inv(soft / size), dtype=np.float64)),
    )
    unit = "T" if model.field.unit == "T" else "1"
    return (DeviceTable("mag", fields, {"output_unit": model.mag_output_unit, "field_unit": unit}),)


def matrices(record: Calibration) -> tuple[Array, Array]:
    """Return h, shape (3,), and D, shape (3, 3), as the record states them; of an axis without, 0 and the mean of D."""
    axes = model_of(record).axes
    theta = np.array([record.value(name) for name in parameter_names(axes)])
    turned = [AXES.index(axis) for axis in axes]
    part_hard, part_soft = unpack(theta, len(axes))
    determinant = float(np.linalg.det(part_soft))
    if not determinant > 0:
        raise RecordError("the record's mag_soft is no matrix of an ellipsoid: its determinant is not above 0")
    hard, soft = np.zeros(3), determinant ** (1 / len(axes)) * np.eye(3)
    hard[turned] = part_hard
    soft[np.ix_(turned, turned)] = part_soft
    return hard, soft


def output_unit(record: Calibration) -> float:
    """Return the unit of the outputs in that of the biases: in T for units of field, else 1."""
    unit = parse_unit(model_of(record).mag_output_unit)
    return unit.factor if unit.quantity == "magnetic field" else 1.0


def surface_of(record: Calibration) -> tuple[Array, Array]:
    """Return h and the free elements of D for a field of length 1, in the unit of the biases, and their covariance."""
    model = model_of(record)
    names, d = parameter_names(model.axes), len(model.axes)
    scale = np.concatenate([np.ones(d), np.full(len(names) - d, model.field.value)])
    theta = scale * np.array([record.value(name) for name in names])
    return theta, record.cov(*names) * np.outer(scale, scale)


def magnetometers_of(record: Calibration) -> Magnetometers:
    """Return the triad as ``M = S (T m + b)`` for other programs; errors as for `tables_of`, and for a level turn.

    Raises
    ------
    RecordError
        The record is of a level turn, which tells two axes.
    """
    model = model_of(record)
    if model.upright is not None:
        raise RecordError(
            f"the record is of a level turn, and tells nothing of axis {model.upright}; turn the unit through all "
            "directions"
        )
    hard, soft = matrices(record)
    soft = soft / output_unit(record)  # output per T
    scale = np.diag(soft).copy()
    hard = hard / output_unit(record)
    return Magnetometers(
        scale, soft / scale[:, None], hard / scale, np.zeros(3), np.eye(3), model.mag_output_unit,
        model.field.value if model.field.unit == "T" else None,
    )  # fmt: skip
