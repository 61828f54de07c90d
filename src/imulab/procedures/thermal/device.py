"""A thermal record as the table that the C core runs, and the vectors by which an exported unit tests itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from imulab.device.golden import VECTORS
from imulab.device.tables import DeviceTable, Field, field_of, values_of, whole
from imulab.device.unit import DeviceUnit
from imulab.errors import RecordError
from imulab.procedures.thermal.gyrodevice import gyro_table_of
from imulab.procedures.thermal.model import GROUPS, Laws
from imulab.procedures.thermal.sections import thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import AccelerometerLaws
from imulab.units import STANDARD_GRAVITY

_NODES = np.linspace(-1.0, 1.0, 65)


def laws_of(record: Calibration) -> Array:
    """Return the coefficients of the nine laws in powers of theta, -1 to 1 over the range, SI, shape (9, terms).

    Raises
    ------
    RecordError
        The record lacks a coefficient, or has one in another unit, or a scale factor is 0 within the range.
    """
    model = thermal_of(record).model
    low, high = model.range
    laws = Laws(low, high, model.degrees.each)
    terms = max(laws.degrees) + 1
    found, units = np.zeros((9, terms)), laws.units(model.output_unit)
    values = iter([values_of(record, [name], unit)[0] for name, unit in zip(laws.names(), units, strict=True)])
    place = Polynomial([laws.middle - model.reference_temperature.value, laws.half])
    for row, degree in enumerate(np.repeat(laws.degrees, len(GROUPS)).tolist()):
        law = Polynomial([next(values) for _ in range(degree + 1)])(place)
        found[row, : len(law.coef)] = law.coef
    scale = np.polynomial.polynomial.polyval(_NODES, found[3:6].T)
    if not (np.sign(scale) == np.sign(scale[:, :1])).all() or not scale.all():
        raise RecordError("the record has a scale factor of 0 within its range of temperature")
    return found


def accelerometers(record: Calibration) -> AccelerometerLaws:
    """Return the laws as exporters take them; errors as for `laws_of`."""
    model = thermal_of(record).model
    low, high = model.range
    return AccelerometerLaws(low, high, laws_of(record), model.output_unit)


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the tables of a thermal record; errors as for `laws_of`."""
    model, laws = thermal_of(record).model, laws_of(record)
    fields = (
        Field("pieces", whole(1)),
        Field("terms", whole(laws.shape[1])),
        Field("knot", np.array(model.range), pointed=True),
        Field("coefficient", laws[None], pointed=True),
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
