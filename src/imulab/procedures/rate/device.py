"""The table of a unit's gyroscopes from a rate record, apart since exports need it without the estimators."""

from __future__ import annotations

import numpy as np

from imulab.device.tables import DeviceTable, gyro_powers, gyro_table
from imulab.procedures.rate import AXES
from imulab.procedures.rate.schema import model_of
from imulab.records.calibration import Calibration
from imulab.units import from_si, parse_unit


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the table of a rate record; axes that it does not hold pass as they are.

    Raises
    ------
    RecordError
        The record lacks a parameter, or has one in another unit.
    """
    model = model_of(record)
    nominal = parse_unit(model.gyro_output_unit)
    usual = from_si(1.0, nominal.symbol) if nominal.quantity == "rate" else 1.0
    scale, bias, misalignment = np.full(3, usual), np.zeros(3), np.eye(3)
    for axis in model.axes:
        i = AXES.index(axis)
        scale[i], bias[i] = record.value(f"gyro_scale_factor_{axis}"), record.value(f"gyro_bias_{axis}")
        for other in model.axes.replace(axis, ""):
            name = f"gyro_misalignment_{axis}{other}"
            if name in record.parameters or model.from_ != "turns":  # turns by hand do not show it
                misalignment[i, AXES.index(other)] = record.value(name)
    columns = {"output_unit": model.gyro_output_unit, "axes": model.axes}
    return (gyro_table(scale, bias, misalignment, gyro_powers(record), columns),)
