"""A tumble record as the tables that the C core runs and as matrices for other programs.

Recordings corrected by it.

The linear part of a model with nonlinearity is not the best linear model: where the attitudes hardly separate scale
factor and k3, the one has taken what the other has given. A target that holds no k3 needs the scale factor without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from imulab.columns import triad
from imulab.device.tables import (
    DeviceTable,
    Field,
    field_of,
    gyro_powers,
    gyro_table,
    nonzero,
    polynomial,
    values_of,
    whole,
)
from imulab.device.unit import VECTORS, DeviceUnit, outputs_of
from imulab.errors import RecordError
from imulab.estimation.least_squares import covariance, least_squares, leverage, observability, plausible_excess
from imulab.procedures.tumble import HIGHEST_ORDER
from imulab.procedures.tumble.model import AXES, gravity_slope, norm_and_jacobian, parameter_names
from imulab.procedures.tumble.schema import data_of, fit_of, gyro_model_of, mag_model_of, model_of
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.triads import (
    CROSS_TERMS,
    Accelerometers,
    Gyroscopes,
    LinearFit,
    Magnetometers,
    Triads,
    output_to_si,
    text_in_g,
)
from imulab.report.traces import plain_number
from imulab.units import STANDARD_GRAVITY, conversion_factor, from_si

# A tumble record as the tables that the C core runs, and the vectors by which an exported unit tests itself.


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
    columns = {"output_unit": gyro_model_of(record).gyro_output_unit}
    return (gyro_table(scale, bias, misalignment, gyro_powers(record), columns, sensitivity=g),)


def _mag(record: Calibration) -> tuple[DeviceTable, ...]:
    """Magnetometers: ``m = T^-1 s`` with s of each output, whose signs and places are in ``T^-1 P``."""
    model = mag_model_of(record)
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


# A tumble record applied: raw triads to specific force and body rate, by the C core.


_LARGEST_FORCE = 2.0  # g: outputs at rest or in a hand hardly exceed it; more is a wrong unit or another record
_ACCEL = triad("accel")
_GYRO = triad("gyro")


def apply_tumble(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with accel_* as specific force, m/s^2, in the body frame of the record's gauge.

    NaN stays in what it touches; an output that lies beyond a turning point of the polynomial becomes NaN.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording has no accelerometer triad.
    """
    force, _ = unit.tumble(outputs_of(recording, "accel", str(columns["output_unit"])))
    return recording.with_columns(dict(zip(_ACCEL, force, strict=True)), dict.fromkeys(_ACCEL, "m/s^2"))


def specific_force(record: Calibration, output: Array) -> Array:
    """Return the specific force, m/s^2, for outputs in the record's unit; both of shape (n, 3).

    Raises
    ------
    RecordError
        The record lacks a parameter, or has one that cannot be.
    """
    force, _ = DeviceUnit.of(tables_of(record)[0]).tumble(list(output.T))
    return np.column_stack(force)


def field_in_body(record: Calibration, output: Array) -> Array:
    """Return the field in the body frame, T or parts of the local one, for outputs in the record's unit, (n, 3) each.

    Raises
    ------
    RecordError
        The record lacks a parameter, or has one that cannot be.
    """
    (table,) = (table for table in tables_of(record) if table.kind == "mag")
    field, _ = DeviceUnit.of(table).mag(list(output.T))
    return np.column_stack(field)


def beyond_test(record: Calibration, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie far beyond the 1 g that the record was made at, and the largest, m/s^2.

    Counted only where the record has nonlinearity, which gravity has shown within 1 g and nowhere else.
    """
    model = model_of(record)
    if model.order <= 1 and not model.cross:
        return 0, 0.0
    scale = np.array([record.value(f"scale_factor_{axis}") for axis in AXES])
    bias = np.array([record.value(f"bias_{axis}") for axis in AXES])
    factor = conversion_factor(recording.triad_unit("accel"), model.output_unit)
    reading = np.abs(recording.triad("accel") * factor / scale - bias)
    largest = np.where(np.isfinite(reading), reading, 0.0).max(axis=1, initial=0.0)
    return int(np.count_nonzero(largest > _LARGEST_FORCE * STANDARD_GRAVITY)), float(largest.max(initial=0.0))


def beyond_message(record: Calibration, count: int, largest: float) -> str:
    """Say that so many samples, the largest in m/s^2, lie beyond what shows the nonlinearity."""
    most = f"{from_si(largest, 'g'):.4g} g"
    return f"{count} samples beyond 2 g (up to {most}): the record's nonlinearity was measured within 1 g"


# A record at a smaller model: fitted anew to the attitudes that the record holds.


_LINEAR = 1  # order
_WEIGHED = 3  # passes until weights and excess agree
_KEPT = 0.5  # attitudes that count for less than half were set aside by the record's own fit


def refit_linear(record: Calibration, *, misalignment: bool) -> Calibration | None:
    """Return a record of order 1, with bias and scale factor (and misalignment) fitted to the record's attitudes.

    Minimises ``sum w (|f| - g - l)^2``, l the lengthening of |f| by noise and motion that the record states, over the
    parameters that are left; w holds the scatter about the smaller model, so that the uncertainties do too.

    Parameters
    ----------
    record
        Of a tumble test.
    misalignment
        Whether the smaller model has misalignment; it is 0 otherwise.

    Returns
    -------
    Calibration or None
        The record with other parameters, covariance and rms; None where it holds no attitudes, or too few to see them.
    """
    held = data_of(record).attitudes
    free = np.arange(9 if misalignment else 6)
    if held is None:
        return None
    gravity = model_of(record).gravity
    kept, stated = np.array(held.down_weight) >= _KEPT, held.standard_uncertainty
    n, g = int(kept.sum()), float(gravity.value)
    # An attitude without uncertainty cannot be weighed beside others.
    if n <= len(free) or not all(stated or [1.0]):
        return None
    names = parameter_names(_LINEAR)
    nominal = np.array([record.value(name) for name in names[3:6]])
    reading = (np.array(held.mean)[kept] / (nominal * g))[None]
    lengthening = np.array(held.lengthening or np.zeros(len(kept)))[kept] / g
    noise_variance: Array = np.ones((1, n)) if stated is None else (np.array(stated)[kept] / g)[None] ** 2

    def model(parameters: Array) -> tuple[Array, Array]:
        theta = np.zeros((1, 9))
        theta[0, free] = parameters
        norm, jacobian = norm_and_jacobian(theta, reading, _LINEAR)[:2]
        return norm[0] - 1 - lengthening, jacobian[0][:, free]

    start: Array = np.concatenate([[record.value(name) / g for name in names[:3]], np.ones(3), np.zeros(3)])[free]
    variance: Array = noise_variance
    for _ in range(_WEIGHED):
        fit = least_squares(model, start, 1 / variance[0])
        start = fit.parameters[0]
        if stated is not None:
            spare = 1 - leverage(fit.jacobian, 1 / variance)
            variance = noise_variance + plausible_excess(fit.residuals, noise_variance, spare)[0][:, None]
    square = float((fit.residuals**2 / variance).sum()) / (n - len(free))
    # Where nothing was stated of the noise, the residuals tell it.
    factor = square if stated is None else 1.0
    conditioning = observability(fit.jacobian[0], 1 / (variance[0] * max(factor, np.finfo(float).tiny)))
    if conditioning.rank < len(free) or not fit.converged[0]:
        return None
    theta = np.zeros(9)
    theta[free] = start
    zero, relative = theta[:3], theta[3:6]
    values = np.concatenate([g * zero / relative, nominal * relative, theta[6:]])
    slope = np.diag(np.concatenate([g / relative, nominal, np.ones(3)]))
    slope[range(3), range(3, 6)] = -g * zero / relative**2
    shared = float(gravity.standard_uncertainty or 0.0) / g * gravity_slope(values, _LINEAR)
    whole = slope[:, free] @ (covariance(fit.jacobian, 1 / variance)[0] * factor) @ slope[:, free].T
    whole += np.outer(shared, shared)
    fitted = {
        name: replace(record.parameters[name], value=float(value), standard_uncertainty=float(np.sqrt(spread)))
        if name in record.parameters
        else Parameter(float(value), float(np.sqrt(spread)), "rad")
        for name, value, spread in zip(names, values, np.diag(whole), strict=True)
    }
    gyro = {name: parameter for name, parameter in record.parameters.items() if name.startswith("gyro_")}
    return replace(
        record,
        parameters=fitted | gyro,
        covariance=Covariance(tuple(names), tuple(map(tuple, whole.tolist()))),
        model={key: value for key, value in record.model.items() if key != "cross"} | {"order": _LINEAR},
        fit={"attitudes": n, "rms": {"value": g * float(np.sqrt(np.mean(fit.residuals**2))), "unit": "m/s^2"}},
    )


# The triads of a tumble record as matrices, whole and without nonlinearity, for the files of other programs.


def triads_of(record: Calibration) -> Triads:
    """Return the triads of a record.

    Raises
    ------
    RecordError
        It lacks a parameter.
    """
    return Triads(_accelerometers(record), _gyroscopes(record), _magnetometers(record))


def linear_fit(record: Calibration, *, misalignment: bool) -> LinearFit:
    """Return the accelerometers fitted anew to the record's attitudes, without nonlinearity (and misalignment)."""
    held = data_of(record).attitudes
    refitted = refit_linear(record, misalignment=misalignment)
    if refitted is None:
        why = (
            f"the record's {len(held.mean)} attitudes are too few, or not the ones, to fit them to anew"
            if held is not None
            else "the record holds no attitudes to fit them to anew"
        )
        return LinearFit(None, f"are those of the whole model: {why}")
    uncertain = {name: p.standard_uncertainty or 0.0 for name, p in refitted.parameters.items()}
    bias = max(uncertain[f"bias_{axis}"] for axis in _AXES)
    scale = max(uncertain[f"scale_factor_{axis}"] / refitted.value(f"scale_factor_{axis}") for axis in _AXES)
    return LinearFit(
        _accelerometers(refitted),
        f"were fitted anew to the record's {fit_of(refitted).attitudes} attitudes, without what is left out: "
        f"|f| - g there is {text_in_g(fit_of(refitted).rms.value)} rms, {text_in_g(fit_of(record).rms.value)} by "
        f"the whole model; standard uncertainties up to {text_in_g(bias)} and {plain_number(1e6 * scale, 3)} ppm",
    )


def _accelerometers(record: Calibration) -> Accelerometers:
    model = model_of(record)
    factor, kept = output_to_si(model.output_unit, "m/s^2")
    matrix = np.eye(3)
    for i, j in ((1, 0), (2, 0), (2, 1)):
        matrix[i, j] = record.value(f"misalignment_{_AXES[i]}{_AXES[j]}")
    terms = [[record.value(f"k{power}_{axis}") for axis in _AXES] for power in range(2, model.order + 1)]
    return Accelerometers(
        scale=np.array([record.value(f"scale_factor_{axis}") for axis in _AXES]) * factor,
        matrix=matrix,
        bias=np.array([record.value(f"bias_{axis}") for axis in _AXES]),
        nonlinearity=np.array(terms).reshape(-1, 3),
        cross=np.array([record.value(n) for n in CROSS_TERMS]) if CROSS_TERMS[0] in record.parameters else np.zeros(3),
        unit=kept,
    )


def _gyroscopes(record: Calibration) -> Gyroscopes | None:
    if "gyro_output_unit" not in record.model:
        return None
    factor, kept = output_to_si(gyro_model_of(record).gyro_output_unit, "rad/s")
    matrix, sensitivity = np.eye(3), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            pair = _AXES[i] + _AXES[j]
            if i != j:
                matrix[i, j] = record.value(f"gyro_misalignment_{pair}")
            if "gyro_g_sensitivity_xx" in record.parameters:
                sensitivity[i, j] = record.value(f"gyro_g_sensitivity_{pair}")
    return Gyroscopes(
        scale=np.array([record.value(f"gyro_scale_factor_{axis}") for axis in _AXES]) * factor,
        matrix=matrix,
        sensitivity=sensitivity,
        bias=np.array([record.value(f"gyro_bias_{axis}") for axis in _AXES]),
        unit=kept,
        nonlinearity=gyro_powers(record),
    )


def _magnetometers(record: Calibration) -> Magnetometers | None:
    if "mag_output_unit" not in record.model:
        return None
    model = mag_model_of(record)
    matrix = np.eye(3)
    for i, j in ((i, j) for i in range(3) for j in range(3) if i != j):
        matrix[i, j] = record.value(f"mag_misalignment_{_AXES[i]}{_AXES[j]}")
    return Magnetometers(
        scale=np.array([record.value(f"mag_scale_factor_{axis}") for axis in _AXES]),
        matrix=matrix,
        bias=np.array([record.value(f"mag_bias_{axis}") for axis in _AXES]),
        quadratic=np.array([record.value(f"mag_k2_{axis}") if model.mag_order == 2 else 0.0 for axis in _AXES]),
        axes=mag_axes(model.mag_axes),
        unit=model.mag_output_unit,
        field=model.field.value if model.field is not None and model.field.unit == "T" else None,
    )
