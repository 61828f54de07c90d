"""A rate record as the table that the C core runs, and as the correction of recordings, of one axis too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.device.tables import DeviceTable, gyro_powers, gyro_table
from imulab.device.unit import DeviceUnit
from imulab.errors import DataError, UnitError
from imulab.procedures.rate import AXES
from imulab.procedures.rate.schema import model_of
from imulab.recording import Recording
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor, from_si, parse_unit


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


def apply_rate(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with the gyroscopes that the record holds as body rate, in their unit if it is one of rate.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording lacks one of these gyroscopes.
    """
    names = [f"gyro_{axis}" for axis in str(columns["axes"])]
    outputs, kept = [np.zeros(len(recording))] * 3, {}
    for name in names:
        if name not in recording:
            raise DataError(f"{recording.name}: no column {name}, which the record corrects; found "
                            f"{' '.join(recording.columns)}")  # fmt: skip
        given, needed = recording.units[name], str(columns["output_unit"])
        try:
            outputs[AXES.index(name[-1])] = recording.column(name) * conversion_factor(given, needed)
        except UnitError:
            raise UnitError(
                f"{recording.name}: column {name} is in {given}, but the record calibrates outputs in {needed}"
            ) from None
        known = parse_unit(given)
        kept[name] = known.symbol if known.quantity == "rate" else "rad/s"
    rate, _ = unit.gyro(outputs, None)
    return recording.with_columns({n: from_si(rate[AXES.index(n[-1])], of) for n, of in kept.items()}, kept)
