"""A thermal record as the table that the C core runs, and the vectors by which an exported unit tests itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.device.golden import VECTORS
from imulab.device.tables import DeviceTable, Field, field_of, values_of, whole
from imulab.device.unit import DeviceUnit
from imulab.procedures.thermal.gyrodevice import check_scale_factors, gyro_table_of
from imulab.procedures.thermal.sections import thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import AccelerometerLaws
from imulab.units import STANDARD_GRAVITY


def laws_of(record: Calibration) -> Array:
    """Return the coefficients of the nine laws in powers of theta, SI, shape (pieces, 9, terms).

    Theta goes from -1 to 1 over the range, or from each knot of the bias to the next.

    Raises
    ------
    RecordError
        The record lacks a coefficient, or has one in another unit, or a scale factor is 0 within the range.
    """
    model = thermal_of(record).model
    laws, units = model.laws, model.laws.units(model.output_unit)
    values = np.array([values_of(record, [name], unit)[0] for name, unit in zip(laws.names(), units, strict=True)])
    found = np.zeros((len(laws.edges) - 1, 9, max(laws.degrees) + 1))
    for row, part in enumerate(laws.parts):
        law = laws.in_pieces(row // 3, values[part], model.reference_temperature.value)
        found[:, row, : law.shape[1]] = law
    check_scale_factors(found)
    return found


def accelerometers(record: Calibration) -> AccelerometerLaws:
    """Return the laws as exporters take them; errors as for `laws_of`."""
    model = thermal_of(record).model
    return AccelerometerLaws(model.laws.edges, laws_of(record), model.output_unit)


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the tables of a thermal record; errors as for `laws_of`."""
    model, laws = thermal_of(record).model, laws_of(record)
    fields = (
        Field("pieces", whole(len(laws))),
        Field("terms", whole(laws.shape[2])),
        Field("knot", model.laws.edges, pointed=True),
        Field("coefficient", laws, pointed=True),
    )
    column = str(record.options.get("temperature_column") or "temperature")
    known = {"temperature": column, "range": list(model.range)}
    table = DeviceTable("thermal", fields, {"output_unit": model.output_unit, **known})
    return (table,) if model.gyro is None else (table, gyro_table_of(record, known))


def golden(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return outputs within 2 g at temperatures within the range and beyond it, and their specific forces."""
    low, high = field_of(table, "knot")[[0, -1]]
    temperature = np.repeat(rng.uniform(low - 5.0, high + 5.0, VECTORS // 2), 2)
    force = rng.uniform(-2 * STANDARD_GRAVITY, 2 * STANDARD_GRAVITY, (VECTORS, 3))
    laws = field_of(table, "coefficient").reshape(-1, 9, int(field_of(table, "terms")))
    output = (force + laws[0, :3, 0]) * laws[0, 3:6, 0]
    temperature[5], output[1, 1] = np.nan, np.nan
    found, _ = DeviceUnit.of(table).thermal(temperature, list(output.T))
    return {
        "": VECTORS,
        "scale": 2 * STANDARD_GRAVITY,
        "temperature": temperature,
        "output": output,
        "force": np.column_stack(found),
    }
