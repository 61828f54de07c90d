"""A thermal record at one temperature, as prior knowledge of a tumble test or of turns there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imulab.errors import RecordError
from imulab.procedures.thermal.model import AXES, GROUPS, MISALIGNMENTS, SENSITIVITIES, Laws
from imulab.procedures.thermal.sections import thermal_of
from imulab.records.calibration import Calibration, Covariance, Parameter

_BEYOND = 1.0  # K
_GAUGE = "x input axis along body x, y input axis in the body xy plane"


def at_temperature(record: Calibration, temperature: float | None, name: str) -> Calibration:
    """Return a record of order 1 as a tumble test gives it, at a temperature, degC, of the recording `name`.

    Biases have the variance of one power cycle in theirs, scale factors too where the record found it.

    Raises
    ------
    RecordError
        The recording has no temperature, or one outside the record's range; or the record does not know the scatter
        between power cycles.
    """
    found = thermal_of(record)
    between = found.fit.between_recordings
    temperature = _within(record, temperature, name)
    if between.from_ == "unknown":
        raise RecordError(
            "the thermal record does not know how far biases move from one power cycle to the next, and cannot be a "
            "prior: fit it with more recordings, or with --turn-on-scatter"
        )
    laws, about = found.model.laws, found.model.reference_temperature.value
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
    """Return a record of the gyroscopes but for their biases, at a temperature, degC, of the recording `name`.

    Raises
    ------
    RecordError
        The recording has no temperature, or one outside the record's range; or the record holds no scale factors.
    """
    gyro = thermal_of(record).model.gyro
    if gyro is None or gyro.scale == "nominal":
        raise RecordError(
            "prior: a thermal record without scale factors of gyroscopes; expected one of thermal fit --with gyro from "
            "tumbles whose turns tell them"
        )
    at = np.array([_within(record, temperature, name)])
    about = thermal_of(record).model.reference_temperature.value
    low, high = thermal_of(record).model.range
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


def _within(record: Calibration, temperature: float | None, name: str) -> float:
    """Return the temperature of a recording, if there is one and the record's laws hold there."""
    low, high = thermal_of(record).model.range
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
