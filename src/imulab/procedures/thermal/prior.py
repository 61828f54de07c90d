"""A thermal record at one temperature, as prior knowledge of a tumble test there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imulab.errors import RecordError
from imulab.procedures.thermal.model import GROUPS
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
    (low, high), between = found.model.range, found.fit.between_recordings
    if temperature is None:
        raise RecordError(
            f"{name}: no column temperature; a thermal record is a prior at the temperature of the recording"
        )
    if not low - _BEYOND <= temperature <= high + _BEYOND:
        raise RecordError(
            f"{name}: made at {temperature:.1f} degC, outside the {low:.1f} to {high:.1f} degC of the thermal record, "
            "which is no prior there"
        )
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
