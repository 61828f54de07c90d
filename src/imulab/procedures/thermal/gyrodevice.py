"""The gyroscopes of a thermal record as the table that the C core runs, and the vectors of a unit's self-test."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.device.golden import VECTORS
from imulab.device.tables import DeviceTable, Field, field_of, values_of, whole
from imulab.device.unit import DeviceUnit
from imulab.errors import RecordError
from imulab.procedures.thermal.model import AXES, MISALIGNMENTS, SENSITIVITIES
from imulab.procedures.thermal.sections import GyroModel, thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import GyroscopeLaws, output_to_si
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit

_NODES = np.linspace(-1.0, 1.0, 65)


def gyro_laws_of(record: Calibration) -> Array:
    """Return biases (rad/s) and scale factors (output per rad/s) in powers of theta, shape (pieces, 6, terms).

    Theta goes from -1 to 1 over the range, or from each knot of the bias to the next.

    Raises
    ------
    RecordError
        The record lacks a coefficient, has one in another unit, or a scale factor is 0 within the range.
    """
    model = thermal_of(record).model
    gyro = model.gyro
    assert gyro is not None
    laws, about = model.gyro_laws, model.reference_temperature.value
    found = np.zeros((len(laws.edges) - 1, 6, max(laws.degrees) + 1))
    for i, axis in enumerate(AXES):
        for row, group, kind, unit in (
            (i, 0, "bias", "rad/s"),
            (3 + i, 1, "scale_factor", f"{gyro.output_unit}/(rad/s)"),
        ):
            if kind == "scale_factor" and gyro.scale == "nominal":
                if parse_unit(gyro.output_unit).quantity != "rate":
                    raise RecordError(
                        f"the record has outputs of gyroscopes in {gyro.output_unit}, and no scale factor"
                    )
                found[:, row, 0] = from_si(1.0, gyro.output_unit)
                continue
            names, units = laws.named(group, f"gyro_{kind}_{axis}"), laws.measured(group, unit)
            values = [values_of(record, [name], per)[0] for name, per in zip(names, units, strict=True)]
            law = laws.in_pieces(group, np.array(values), about)
            found[:, row, : law.shape[1]] = law
    check_scale_factors(found)
    return found


def check_scale_factors(laws: Array) -> None:
    """Refuse laws, shape (pieces, rows, terms), of which rows 3 to 5, the scale factors, are 0 anywhere."""
    scale = np.polynomial.polynomial.polyval(_NODES, laws[:, 3:6].reshape(-1, laws.shape[2]).T).reshape(-1, 3, 65)
    if not (np.sign(scale) == np.sign(scale[:1, :, :1])).all() or not scale.all():
        raise RecordError("the record has a scale factor of 0 within its range of temperature")


def _matrix(record: Calibration, gyro: GyroModel) -> Array:
    """Return T, the identity where turns did not tell it."""
    matrix = np.eye(3)
    if gyro.scale == "turns":
        matrix[~np.eye(3, dtype=np.bool_)] = values_of(record, MISALIGNMENTS, "rad")
    return matrix


def _sensitivity(record: Calibration) -> Array:
    return values_of(record, SENSITIVITIES, "rad/s/(m/s^2)").reshape(3, 3)


def gyroscopes(record: Calibration) -> GyroscopeLaws | None:
    """Return the laws as exporters take them, None where there are none; errors as for `gyro_laws_of`."""
    model = thermal_of(record).model
    if model.gyro is None:
        return None
    laws = gyro_laws_of(record)
    factor, unit = output_to_si(model.gyro.output_unit, "rad/s")
    laws[:, 3:] *= factor
    felt = _sensitivity(record) if model.gyro.g_sensitivity else np.zeros((3, 3))
    return GyroscopeLaws(model.gyro_laws.edges, laws, _matrix(record, model.gyro), felt, unit)


def gyro_table_of(record: Calibration, columns: Mapping[str, Any]) -> DeviceTable:
    """Return the table of the gyroscopes; errors as for `gyro_laws_of`."""
    model = thermal_of(record).model
    assert model.gyro is not None
    laws = gyro_laws_of(record)
    fields = [
        Field("has_sensitivity", whole(model.gyro.g_sensitivity)),
        Field("pieces", whole(len(laws))),
        Field("terms", whole(laws.shape[2])),
        Field("turn", np.linalg.inv(_matrix(record, model.gyro))),
    ]
    if model.gyro.g_sensitivity:
        fields.append(Field("sensitivity", _sensitivity(record)))
    fields += [Field("knot", model.gyro_laws.edges, pointed=True), Field("coefficient", laws, pointed=True)]
    return DeviceTable("thermal_gyro", tuple(fields), {"output_unit": model.gyro.output_unit, **columns})


def golden(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return outputs within 5 rad/s under 2 g, at temperatures within the range and beyond it, and their rates."""
    low, high = field_of(table, "knot")[[0, -1]]
    temperature = np.repeat(rng.uniform(low - 5.0, high + 5.0, VECTORS // 2), 2)
    rates = rng.uniform(-5, 5, (VECTORS, 3))
    force = rng.uniform(-2 * STANDARD_GRAVITY, 2 * STANDARD_GRAVITY, (VECTORS, 3))
    laws = field_of(table, "coefficient").reshape(-1, 6, int(field_of(table, "terms")))
    output = (rates + laws[0, :3, 0]) * laws[0, 3:6, 0]
    temperature[5], output[1, 1] = np.nan, np.nan
    found, _ = DeviceUnit.of(table).thermal_gyro(temperature, list(output.T), list(force.T))
    return {
        "": VECTORS,
        "scale": 5.0,
        "temperature": temperature,
        "output": output,
        "force": force,
        "rate": np.column_stack(found),
    }
