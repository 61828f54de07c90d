"""A thermal record as the table that the C core runs, and the vectors by which an exported unit tests itself."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from imulab.device.golden import VECTORS
from imulab.device.tables import DeviceTable, Field, field_of, values_of, whole
from imulab.device.unit import DeviceUnit
from imulab.errors import RecordError
from imulab.procedures.thermal.gyrodevice import gyro_table_of
from imulab.procedures.thermal.model import cardinal_spline
from imulab.procedures.thermal.sections import Model, thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import AccelerometerLaws
from imulab.units import STANDARD_GRAVITY

_NODES = np.linspace(-1.0, 1.0, 65)


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
    edges = knots_of(model)
    found = np.zeros((len(edges) - 1, 9, max(laws.degrees) + 1))
    for piece, (start, stop) in enumerate(pairwise(edges.tolist())):
        middle, half = 0.5 * (start + stop), 0.5 * (stop - start)
        for row, part in enumerate(laws.parts):
            if row < 3 and laws.knots:
                cubic, about = cardinal_spline(laws.knots).c[::-1, piece] @ values[part], start
            else:
                cubic, about = values[part], model.reference_temperature.value
            law = Polynomial(cubic)(Polynomial([middle - about, half])).coef
            found[piece, row, : len(law)] = law
    scale = np.polynomial.polynomial.polyval(_NODES, found[:, 3:6].reshape(-1, found.shape[2]).T).reshape(-1, 3, 65)
    if not (np.sign(scale) == np.sign(scale[:1, :, :1])).all() or not scale.all():
        raise RecordError("the record has a scale factor of 0 within its range of temperature")
    return found


def accelerometers(record: Calibration) -> AccelerometerLaws:
    """Return the laws as exporters take them; errors as for `laws_of`."""
    model = thermal_of(record).model
    return AccelerometerLaws(knots_of(model), laws_of(record), model.output_unit)


def knots_of(model: Model) -> Array:
    """Return the temperatures between which each piece of the laws holds, degC: the range, or the bias's knots."""
    return np.array(model.knots or model.range)


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the tables of a thermal record; errors as for `laws_of`."""
    model, laws = thermal_of(record).model, laws_of(record)
    fields = (
        Field("pieces", whole(len(laws))),
        Field("terms", whole(laws.shape[2])),
        Field("knot", knots_of(model), pointed=True),
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
