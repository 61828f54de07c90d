"""The triads of a tumble record as matrices, whole and without nonlinearity, for the files of other programs."""

from __future__ import annotations

import numpy as np

from imulab.device.gyroscopes import gyro_powers
from imulab.procedures.tumble.device import mag_axes
from imulab.procedures.tumble.refit import refit_linear
from imulab.procedures.tumble.sections import data_of, fit_of, model_of
from imulab.records.calibration import Calibration
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
from imulab.report.elements import plain_number

_AXES = "xyz"


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
    factor, kept = output_to_si(model_of(record).gyro_output_unit, "rad/s")
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
    model = model_of(record)
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
