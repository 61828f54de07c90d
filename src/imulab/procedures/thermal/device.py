"""A thermal record in use: tables for the C core, correction of recordings, comparison, and prior knowledge.

The laws are `imulab.procedures.thermal.model`, in powers of theta for each piece (`Laws.in_pieces`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from imulab.columns import triad
from imulab.device.tables import DeviceTable, Field, field_of, values_of, whole
from imulab.device.unit import VECTORS, DeviceUnit, correct_gyroscopes, outputs_of
from imulab.display import Note
from imulab.errors import DataError, RecordError
from imulab.procedures.procedure import OnLine
from imulab.procedures.thermal.model import AXES, GROUPS, MISALIGNMENTS, SENSITIVITIES, Laws
from imulab.procedures.thermal.schema import (
    RampModel,
    ThermalGyroModel,
    ThermalModel,
    gyros_of,
    is_ramp,
    refuse_ramp,
    thermal_of,
)
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.triads import AccelerometerLaws, GyroscopeLaws, output_to_si
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit, to_si

# The table of the gyroscopes, and the vectors of a unit's self-test.


_NODES = np.linspace(-1.0, 1.0, 65)  # theta at which scale factors are checked


def read_gyro_laws(record: Calibration) -> Array:
    """Return biases (rad/s) and scale factors (output per rad/s) in powers of theta, shape (pieces, 6, terms).

    Theta goes from -1 to 1 over the range, or from each knot of the bias to the next.

    Raises
    ------
    RecordError
        The record lacks a coefficient, has one in another unit, or a scale factor is 0 within the range.
    """
    model = gyros_of(record).model
    gyro = model.gyro
    assert gyro is not None
    laws, about = model.gyro_laws, model.reference_temperature.value
    coefficients = np.zeros((len(laws.edges) - 1, 6, max(laws.degrees) + 1))
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
                coefficients[:, row, 0] = from_si(1.0, gyro.output_unit)
                continue
            names, units = laws.named(group, f"gyro_{kind}_{axis}"), laws.measured(group, unit)
            values = [values_of(record, [name], per)[0] for name, per in zip(names, units, strict=True)]
            law = laws.in_pieces(group, np.array(values), about)
            coefficients[:, row, : law.shape[1]] = law
    check_scale_factors(coefficients)
    return coefficients


def check_scale_factors(laws: Array) -> None:
    """Refuse laws, shape (pieces, rows, terms), of which rows 3 to 5, the scale factors, are 0 anywhere."""
    scale = np.polynomial.polynomial.polyval(_NODES, laws[:, 3:6].reshape(-1, laws.shape[2]).T).reshape(-1, 3, 65)
    if not (np.sign(scale) == np.sign(scale[:1, :, :1])).all() or not scale.all():
        raise RecordError("the record has a scale factor of 0 within its range of temperature")


def _matrix(record: Calibration, gyro: ThermalGyroModel) -> Array:
    """Return T, the identity where there were no turns."""
    matrix = np.eye(3)
    if gyro.scale == "turns":
        matrix[~np.eye(3, dtype=np.bool_)] = values_of(record, MISALIGNMENTS, "rad")
    return matrix


def _sensitivity(record: Calibration) -> Array:
    """Return the g-sensitivities, rad/s per m/s^2, shape (3, 3)."""
    return values_of(record, SENSITIVITIES, "rad/s/(m/s^2)").reshape(3, 3)


def gyroscope_laws(record: Calibration) -> GyroscopeLaws | None:
    """Return the gyroscopes' laws for exporters, None where there are none; errors as for `read_gyro_laws`."""
    model = gyros_of(record).model
    if model.gyro is None:
        return None
    laws = read_gyro_laws(record)
    factor, unit = output_to_si(model.gyro.output_unit, "rad/s")
    laws[:, 3:] *= factor
    felt = _sensitivity(record) if model.gyro.g_sensitivity else np.zeros((3, 3))
    return GyroscopeLaws(model.gyro_laws.edges, laws, _matrix(record, model.gyro), felt, unit)


def make_gyro_table(record: Calibration, columns: Mapping[str, Any]) -> DeviceTable:
    """Return the table of the gyroscopes; errors as for `read_gyro_laws`."""
    model = gyros_of(record).model
    assert model.gyro is not None
    laws = read_gyro_laws(record)
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


def golden_gyroscopes(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return test vectors: outputs within 5 rad/s under 2 g at temperatures in and beyond the range, and rates."""
    low, high = field_of(table, "knot")[[0, -1]]
    temperature = np.repeat(rng.uniform(low - 5.0, high + 5.0, VECTORS // 2), 2)
    rates = rng.uniform(-5, 5, (VECTORS, 3))
    force = rng.uniform(-2 * STANDARD_GRAVITY, 2 * STANDARD_GRAVITY, (VECTORS, 3))
    laws = field_of(table, "coefficient").reshape(-1, 6, int(field_of(table, "terms")))
    output = (rates + laws[0, :3, 0]) * laws[0, 3:6, 0]
    temperature[5], output[1, 1] = np.nan, np.nan
    turn_rates, _ = DeviceUnit.of(table).thermal_gyro(temperature, list(output.T), list(force.T))
    return {
        "": VECTORS,
        "scale": 5.0,
        "temperature": temperature,
        "output": output,
        "force": force,
        "rate": np.column_stack(turn_rates),
    }


# The table of the accelerometers, and the vectors of a unit's self-test.


def read_laws(record: Calibration) -> Array:
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
    coefficients = np.zeros((len(laws.edges) - 1, 9, max(laws.degrees) + 1))
    for row, part in enumerate(laws.parts):
        law = laws.in_pieces(row // 3, values[part], model.reference_temperature.value)
        coefficients[:, row, : law.shape[1]] = law
    check_scale_factors(coefficients)
    return coefficients


def accelerometer_laws(record: Calibration) -> AccelerometerLaws | None:
    """Return the accelerometers' laws for exporters, None of rest ramps; errors as for `read_laws`."""
    if is_ramp(record):
        return None
    model = thermal_of(record).model
    return AccelerometerLaws(model.laws.edges, read_laws(record), model.output_unit)


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the tables of a thermal record; errors as for `read_laws`."""
    column = str(record.options.get("temperature_column") or "temperature")
    known = {"temperature": column, "range": list(gyros_of(record).model.range)}
    if is_ramp(record):
        return (make_gyro_table(record, known),)
    model, laws = thermal_of(record).model, read_laws(record)
    fields = (
        Field("pieces", whole(len(laws))),
        Field("terms", whole(laws.shape[2])),
        Field("knot", model.laws.edges, pointed=True),
        Field("coefficient", laws, pointed=True),
    )
    table = DeviceTable("thermal", fields, {"output_unit": model.output_unit, **known})
    return (table,) if model.gyro is None else (table, make_gyro_table(record, known))


def golden_accelerometers(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return test vectors: outputs within 2 g at temperatures in and beyond the range, and specific forces."""
    low, high = field_of(table, "knot")[[0, -1]]
    temperature = np.repeat(rng.uniform(low - 5.0, high + 5.0, VECTORS // 2), 2)
    force = rng.uniform(-2 * STANDARD_GRAVITY, 2 * STANDARD_GRAVITY, (VECTORS, 3))
    laws = field_of(table, "coefficient").reshape(-1, 9, int(field_of(table, "terms")))
    output = (force + laws[0, :3, 0]) * laws[0, 3:6, 0]
    temperature[5], output[1, 1] = np.nan, np.nan
    forces, _ = DeviceUnit.of(table).thermal(temperature, list(output.T))
    return {
        "": VECTORS,
        "scale": 2 * STANDARD_GRAVITY,
        "temperature": temperature,
        "output": output,
        "force": np.column_stack(forces),
    }


# Correction of recordings by the C core, at the temperature of each sample.


_ACCEL, _GYRO = triad("accel"), triad("gyro")


def apply_thermal(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with accel_* as specific force, m/s^2, in the body frame of the record's gauge.

    A row whose temperature is not a number becomes not a number.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording has no accelerometer triad, or not the column of temperature that the record needs.
    """
    outputs = outputs_of(recording, "accel", str(columns["output_unit"]))
    force, _ = unit.thermal(_read_temperature(columns, recording), outputs)
    return recording.with_columns(dict(zip(_ACCEL, force, strict=True)), dict.fromkeys(_ACCEL, "m/s^2"))


def apply_gyro(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with gyro_* as body rate by the laws at each sample's temperature.

    Raises
    ------
    UnitError, DataError
        As for `correct_gyroscopes`, or the recording has no such column of temperature.
    """
    return correct_gyroscopes(unit, columns, recording, _read_temperature(columns, recording))


def _read_temperature(columns: Mapping[str, Any], recording: Recording) -> Array:
    """Return the temperatures by which the record's laws are evaluated, degC, shape (n,)."""
    name = str(columns["temperature"])
    others = [key for key in recording.columns if key.startswith("temperature_")]
    if name == "temperature" and name not in recording and len(others) == 1:
        (name,) = others
    if name not in recording:
        advice = "expected what the unit's own thermometer says, which the record's laws follow"
        raise recording.lacking(f"column {name}", name, advice)
    if parse_unit(recording.units[name]).quantity != "temperature":
        raise DataError(f"{recording.name}: column {name}: expected a temperature, found {recording.units[name]}")
    return to_si(recording.column(name), recording.units[name])


def remarks(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return warnings of rows outside the range or without a temperature."""
    return _warn_temperature(columns, recording) if set(_ACCEL) <= set(recording.columns) else []


def gyro_remarks(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return the same for gyroscopes, unless there are accelerometers, for which `remarks` says it."""
    there = set(recording.columns)
    return _warn_temperature(columns, recording) if set(_GYRO) <= there and not set(_ACCEL) <= there else []


def _warn_temperature(columns: Mapping[str, Any], recording: Recording) -> list[str]:
    low, high = columns["range"]
    temperature = _read_temperature(columns, recording)
    lost, outside = ~np.isfinite(temperature), (temperature < low) | (temperature > high)
    messages: list[str] = []
    if lost.any():
        messages.append(
            f"{recording.name}: {lost.sum()} rows without a temperature are not corrected: not a number there"
        )
    if outside.any():
        far = float(np.maximum(low - temperature[outside], temperature[outside] - high).max())
        text = (
            f"{recording.name}: {outside.sum()} of {len(recording)} rows lie outside the {low:g} to {high:g} degC that "
            f"were measured, by up to {far:.1f} K: corrected as at the end of the range"
        )
        messages.append(text if far > 1 else Note(text))
    return messages


# Comparison of two records at common temperatures, since each has powers about a T0 of its own.


ON_LINE = np.arange(-60.0, 161.0, 20.0)
"""Temperatures at which the units of a line are compared, degC; most are measured at 20 degC."""
_SAME = 0.05  # K between reference temperatures that are the same, half of the last digit of temperatures
_LEAST = 1.0  # K that two ranges must share, so that temperatures written to 0.1 degC differ
Kind = tuple[str, tuple[str, ...], Laws, int]
"""A kind of parameters: name, axes, laws, and its group among these."""


def at_common_temperatures(first: Calibration, second: Calibration) -> tuple[Calibration, Calibration]:
    """Return both records with the values of their laws at common temperatures in place of coefficients.

    Raises
    ------
    RecordError
        Their ranges of temperature have less than 1 K in common.
    """
    models = [_model_of(record) for record in (first, second)]
    low, high = max(model.range[0] for model in models), min(model.range[1] for model in models)
    if high - low < _LEAST:
        ranges = " and ".join(f"{model.range[0]:.1f} to {model.range[1]:.1f} degC" for model in models)
        raise RecordError(f"cannot compare laws over {ranges}; expected ranges that share {_LEAST:g} K or more")
    both = all(model.gyro is not None for model in models)
    whole_ones = all(isinstance(model, ThermalModel) for model in models)
    kinds = [_list_laws(model, both, accelerometers=whole_ones) for model in models]
    if not kinds[0]:
        raise RecordError("cannot compare a record of rest ramps with one without gyroscopes: they share no parameter")
    terms = [[laws.terms[group] for _, _, laws, group in each] for each in kinds]
    counts = [max(pair) for pair in zip(*terms, strict=True)]
    low, high = np.ceil(10 * low) / 10, np.floor(10 * high) / 10
    nodes = [np.linspace(low, high, count) if count > 1 else np.array([0.5 * (low + high)]) for count in counts]
    nodes = [np.round(places, 1) for places in nodes]
    return _evaluate_at(first, kinds[0], nodes), _evaluate_at(second, kinds[1], nodes)


def on_line(record: Calibration) -> OnLine:
    """Return the values of a record's laws at the temperatures `ON_LINE` within its range."""
    model = _model_of(record)
    about, laws = model.reference_temperature, _list_laws(model, model.gyro is not None)
    if model.gyro is not None and model.gyro.scale == "turns":
        laws.append(("gyro_scale_factor", AXES, model.gyro_laws, 1))
    low, high = model.range
    nodes = ON_LINE[(low <= ON_LINE) & (high >= ON_LINE)]
    values = _evaluate_at(record, laws, [nodes] * len(laws)) if nodes.size else replace(record, parameters={}, fit={})
    freedom = [each for each in values.fit.get("degrees_of_freedom", {}).values() if each]
    named = tuple(f"{kind}_{axis}" for kind, axes, _, _ in laws for axis in axes)
    begun = tuple(f"{name}_" for name in named)  # powers, knots, and what a spline's value and slopes are at T0
    coefficients = frozenset(name for name in record.parameters if name in named or name.startswith(begun))
    own_knots = model.knots if isinstance(model, ThermalModel) else None
    knots = *(own_knots or ()), *((model.gyro and model.gyro.knots) or ())
    return OnLine(
        values.parameters,
        ("reference_temperature", about.unit),
        (about.value, *knots),
        _SAME,
        coefficients,
        min(freedom, default=None),
    )


def _model_of(record: Calibration) -> RampModel:
    """Return the model of a record, that of rest ramps without accelerometers."""
    return gyros_of(record).model if is_ramp(record) else thermal_of(record).model


def _list_laws(model: RampModel, gyroscopes: bool, *, accelerometers: bool = True) -> list[Kind]:
    """Return the kinds of parameters that follow the temperature."""
    kinds: list[Kind] = []
    if accelerometers and isinstance(model, ThermalModel):
        kinds += [(kind, axes, model.laws, group) for group, (kind, axes) in enumerate(GROUPS)]
    return [*kinds, ("gyro_bias", AXES, model.gyro_laws, 0)] if gyroscopes else kinds


def _evaluate_at(record: Calibration, laws: list[Kind], nodes: list[Array]) -> Calibration:
    """Return a record with the values of these laws at temperatures of each, degC, in place of coefficients."""
    sections, names = gyros_of(record), record.covariance.names
    fit, freedom = sections.fit, record.fit.get("degrees_of_freedom")
    scatters = {}
    if not is_ramp(record):
        turn_on = thermal_of(record).fit.between_recordings
        scatters = {"bias": (turn_on.bias, turn_on.rank), "scale_factor": (turn_on.scale_factor, turn_on.rank)}
    if fit.gyro is not None:
        scatters["gyro_bias"] = fit.gyro.between_recordings.bias, fit.gyro.between_recordings.rank
    rows, values, labels, units = [], [], [], []
    known: dict[str, float | None] = {}
    about = sections.model.reference_temperature.value
    for (kind, axes, law, group), places in zip(laws, nodes, strict=True):
        functions = law.recorded(group, places, about)
        for axis in axes:
            used = law.named(group, f"{kind}_{axis}")
            row = np.zeros((len(places), len(names)))
            row[:, [names.index(name) for name in used]] = functions
            rows.append(row)
            values.append(functions @ np.array([record.value(name) for name in used]))
            labels += [f"{kind}_{axis} at {temperature:.1f} degC" for temperature in places]
            units += [record.parameters[used[0]].unit] * len(places)
        # The scatter between recordings, of few degrees of freedom, dominates the uncertainty of these values.
        scatter, rank = scatters.get(kind, (None, 0))
        few = scatter is not None and scatter.value > 0 and rank > 0
        known |= dict.fromkeys(labels[-len(axes) * len(places) :], rank if few else freedom)
    spread = np.vstack(rows)
    matrix = spread @ record.covariance.array() @ spread.T
    parameters = {
        label: Parameter(float(value), float(u), unit)
        for label, value, u, unit in zip(labels, np.concatenate(values), np.sqrt(np.diag(matrix)), units, strict=True)
    }
    covariance = Covariance(tuple(labels), tuple(map(tuple, matrix.tolist())))
    fit_section = {**record.fit, "degrees_of_freedom": known}
    return replace(record, parameters=parameters, covariance=covariance, fit=fit_section)


# A thermal record at one temperature, as prior knowledge of a tumble test or of turns.


_BEYOND = 1.0  # K outside the record's range, up to which its laws are taken to hold
_GAUGE = "x input axis along body x, y input axis in the body xy plane"


def at_temperature(record: Calibration, temperature: float | None, name: str) -> Calibration:
    """Return a record of order 1 as a tumble test gives it, at a temperature, degC, of the recording `name`.

    The variances of biases and scale factors include the scatter between power cycles.

    Raises
    ------
    RecordError
        The recording has no temperature, or one outside the record's range; or the record does not know the scatter
        between power cycles.
    """
    refuse_ramp(record, "a prior of accelerometers")
    thermal = thermal_of(record)
    between = thermal.fit.between_recordings
    temperature = _check_in_range(record, temperature, name)
    if between.from_ == "unknown":
        raise RecordError(
            "the thermal record does not know how far biases move from one power cycle to the next, and cannot be a "
            "prior: fit it with more recordings, or with --turn-on-scatter"
        )
    laws, about = thermal.model.laws, thermal.model.reference_temperature.value
    names, rows = list(record.covariance.names), []
    labels = [f"{kind}_{axis}" for kind, axes in GROUPS for axis in axes]
    for number, label in enumerate(labels):
        group, row = number // 3, np.zeros(len(names))
        functions = laws.recorded(group, np.array([temperature]), about)[0]
        row[[names.index(name) for name in laws.named(group, label)]] = functions
        rows.append(row)
    design = np.array(rows)
    values = design @ np.array([record.value(each) for each in names])
    cycle = np.concatenate([np.full(3, between.bias.value), values[3:6] * between.scale_factor.value, np.zeros(3)])
    matrix = design @ record.covariance.array() @ design.T + np.diag(cycle**2)
    units = [record.parameters[label].unit for label in labels]
    model = {key: record.model[key] for key in ("order", "gravity", "output_unit")}
    return replace(
        record,
        procedure="tumble",
        parameters={
            label: Parameter(float(value), float(u), unit)
            for label, value, u, unit in zip(labels, values, np.sqrt(np.diag(matrix)), units, strict=True)
        },
        covariance=Covariance(tuple(labels), tuple(map(tuple, matrix.tolist()))),
        model={**model, "gauge": _GAUGE, "temperature": {"value": temperature, "unit": "degC"}},
        fit={},
        data={},
        warnings=(),
    )


def gyros_at_temperature(record: Calibration, temperature: float | None, name: str) -> Calibration:
    """Return a record of the gyroscopes without their biases, at a temperature, degC, of the recording `name`.

    Raises
    ------
    RecordError
        The recording has no temperature, or one outside the record's range; or the record holds no scale factors.
    """
    gyro = gyros_of(record).model.gyro
    if gyro is None or gyro.scale == "nominal":
        raise RecordError(
            "prior: a thermal record without scale factors of gyroscopes; expected one of thermal fit --with gyro from "
            "tumbles whose turns tell them"
        )
    at = np.array([_check_in_range(record, temperature, name)])
    about = gyros_of(record).model.reference_temperature.value
    low, high = gyros_of(record).model.range
    laws = Laws(low, high, (gyro.degrees.scale_factor, 0, 0))
    labels = [f"gyro_scale_factor_{axis}" for axis in AXES]
    plain = [*MISALIGNMENTS, *(SENSITIVITIES if gyro.g_sensitivity else ())]
    names = list(record.covariance.names)
    design = np.zeros((3 + len(plain), len(names)))
    for row, label in enumerate(labels):
        design[row, [names.index(each) for each in laws.named(0, label)]] = laws.recorded(0, at, about)[0]
    for row, label in enumerate(plain, 3):
        design[row, names.index(label)] = 1.0
    labels += plain
    values = design @ np.array([record.value(each) for each in names])
    matrix = design @ record.covariance.array() @ design.T
    return replace(
        record,
        procedure="rate",
        parameters={
            label: Parameter(float(value), float(u), record.parameters[label].unit)
            for label, value, u in zip(labels, values, np.sqrt(np.diag(matrix)), strict=True)
        },
        covariance=Covariance(tuple(labels), tuple(map(tuple, matrix.tolist()))),
        model={
            "gyro_output_unit": gyro.output_unit,
            "gyro_order": 1,
            "temperature": {"value": float(at[0]), "unit": "degC"},
        },
        fit={},
        data={},
        warnings=(),
    )


def _check_in_range(record: Calibration, temperature: float | None, name: str) -> float:
    """Return the temperature of a recording if it has one within the record's range; else raise RecordError."""
    low, high = gyros_of(record).model.range
    if temperature is None:
        raise RecordError(
            f"{name}: no column temperature; a thermal record is a prior at the temperature of the recording"
        )
    if not low - _BEYOND <= temperature <= high + _BEYOND:
        raise RecordError(
            f"{name}: made at {temperature:.1f} degC, outside the {low:.1f} to {high:.1f} degC of the thermal record, "
            "which is no prior there"
        )
    return temperature
