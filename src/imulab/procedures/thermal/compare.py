"""Two thermal records at temperatures of both, since each has coefficients of powers about a T0 of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imulab.errors import RecordError
from imulab.procedures.procedure import OnLine
from imulab.procedures.thermal.model import AXES, GROUPS, Laws
from imulab.procedures.thermal.sections import Model, thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter

ON_LINE = np.arange(-60.0, 161.0, 20.0)
"""Temperatures at which the units of a line are compared, degC: 20 degC is among them, where most are measured."""
_SAME = 0.05  # K between reference temperatures, half of what temperatures are written to
_LEAST = 1.0  # K that two ranges share, so that temperatures written to 0.1 degC differ
Kind = tuple[str, tuple[str, ...], Laws, int]
"""Of parameters: name, axes, laws, and which of these are its own."""


def at_common_temperatures(first: Calibration, second: Calibration) -> tuple[Calibration, Calibration]:
    """Return both records with the values of their laws in place of coefficients, as many as the higher degree takes.

    Raises
    ------
    RecordError
        Their ranges of temperature have less than 1 K in common.
    """
    models = [thermal_of(record).model for record in (first, second)]
    low, high = max(model.range[0] for model in models), min(model.range[1] for model in models)
    if high - low < _LEAST:
        ranges = " and ".join(f"{model.range[0]:.1f} to {model.range[1]:.1f} degC" for model in models)
        raise RecordError(f"cannot compare laws over {ranges}; expected ranges that share {_LEAST:g} K or more")
    both = all(model.gyro is not None for model in models)
    kinds = [_laws(model, both) for model in models]
    terms = [[laws.terms[group] for _, _, laws, group in each] for each in kinds]
    counts = [max(of) for of in zip(*terms, strict=True)]
    low, high = np.ceil(10 * low) / 10, np.floor(10 * high) / 10
    nodes = [np.linspace(low, high, count) if count > 1 else np.array([0.5 * (low + high)]) for count in counts]
    nodes = [np.round(places, 1) for places in nodes]
    return _at(first, kinds[0], nodes), _at(second, kinds[1], nodes)


def on_line(record: Calibration) -> OnLine:
    """Return the values of a record's laws at those of the temperatures `ON_LINE` that lie in its range."""
    model = thermal_of(record).model
    about, laws = model.reference_temperature, _laws(model, model.gyro is not None)
    if model.gyro is not None and model.gyro.scale == "turns":
        laws.append(("gyro_scale_factor", AXES, model.gyro_laws, 1))
    low, high = model.range
    nodes = ON_LINE[(low <= ON_LINE) & (high >= ON_LINE)]
    values = _at(record, laws, [nodes] * len(laws)) if nodes.size else replace(record, parameters={}, fit={})
    freedom = [each for each in values.fit.get("degrees_of_freedom", {}).values() if each]
    named = tuple(f"{kind}_{axis}" for kind, axes, _, _ in laws for axis in axes)
    begun = tuple(f"{name}_" for name in named)  # powers, knots, and what a spline's value and slopes are at T0
    own = frozenset(name for name in record.parameters if name in named or name.startswith(begun))
    knots = *(model.knots or ()), *((model.gyro and model.gyro.knots) or ())
    return OnLine(
        values.parameters,
        ("reference_temperature", about.unit),
        (about.value, *knots),
        _SAME,
        own,
        min(freedom, default=None),
    )


def _laws(model: Model, gyroscopes: bool) -> list[Kind]:
    """Return the kinds of parameters that follow the temperature: name, axes, laws, and which of these are its own."""
    found: list[Kind] = []
    found += [(kind, axes, model.laws, group) for group, (kind, axes) in enumerate(GROUPS)]
    return [*found, ("gyro_bias", AXES, model.gyro_laws, 0)] if gyroscopes else found


def _at(record: Calibration, laws: list[Kind], nodes: list[Array]) -> Calibration:
    """Return a record with the values of these laws at temperatures of each, degC, in place of coefficients."""
    sections, names = thermal_of(record), record.covariance.names
    fit, turn_on, freedom = sections.fit, sections.fit.between_recordings, record.fit.get("degrees_of_freedom")
    scatters = {"bias": (turn_on.bias, turn_on.rank), "scale_factor": (turn_on.scale_factor, turn_on.rank)}
    if fit.gyro is not None:
        scatters["gyro_bias"] = fit.gyro.between_recordings.bias, fit.gyro.between_recordings.rank
    rows, values, labels, units = [], [], [], []
    known: dict[str, float | None] = {}
    about = sections.model.reference_temperature.value
    for (kind, axes, law, group), own in zip(laws, nodes, strict=True):
        functions = law.recorded(group, own, about)
        for axis in axes:
            used = law.named(group, f"{kind}_{axis}")
            row = np.zeros((len(own), len(names)))
            row[:, [names.index(name) for name in used]] = functions
            rows.append(row)
            values.append(functions @ np.array([record.value(name) for name in used]))
            labels += [f"{kind}_{axis} at {temperature:.1f} degC" for temperature in own]
            units += [record.parameters[used[0]].unit] * len(own)
        # What recordings scatter by is told by few of them, and is most of what these values are uncertain by.
        scatter, rank = scatters.get(kind, (None, 0))
        few = scatter is not None and scatter.value > 0 and rank > 0
        known |= dict.fromkeys(labels[-len(axes) * len(own) :], rank if few else freedom)
    spread = np.vstack(rows)
    matrix = spread @ record.covariance.array() @ spread.T
    parameters = {
        label: Parameter(float(value), float(u), unit)
        for label, value, u, unit in zip(labels, np.concatenate(values), np.sqrt(np.diag(matrix)), units, strict=True)
    }
    covariance = Covariance(tuple(labels), tuple(map(tuple, matrix.tolist())))
    said = {**record.fit, "degrees_of_freedom": known}
    return replace(record, parameters=parameters, covariance=covariance, fit=said)
