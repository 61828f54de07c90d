"""The calibration record of a warm-up test."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.procedures.warmup.cycles import Curves
from imulab.procedures.warmup.model import WarmupTable, evaluate, exit_jump
from imulab.procedures.warmup.quality import (
    CycleSpread,
    Judged,
    Worst,
    after_of,
    at_limit,
    expectations,
    quality_warnings,
)
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter

_DIGITS = 7  # of the numbers in a record


def make_record(
    *,
    curves: Curves,
    rows: list[Judged],
    chosen: Judged,
    table: WarmupTable,
    spread: CycleSpread,
    covariance: Array | None,
    settled: bool,
    by_unit: bool,
    worst: Worst | None,
    options: Mapping[str, Any],
) -> Calibration:
    """Return the record of a fitted table and its errors."""
    parameters, names, matrix = _parameters(curves, chosen, spread, worst)
    serials = sorted({cycle.serial for cycle in curves.cycles if cycle.serial})
    models = sorted({cycle.sensor_model for cycle in curves.cycles if cycle.sensor_model})
    sensor = {key: values[0] for key, values in (("serial", serials), ("model", models)) if len(values) == 1}
    return Calibration(
        procedure="warmup",
        parameters=parameters,
        covariance=Covariance(names, tuple(map(tuple, matrix.tolist()))),
        model={
            "model": table.model,
            "settling_time": {
                "value": table.settling_time,
                "unit": "s",
                "from": "argument" if options["settling_time"] is not None else "data",
            },
            "reference": "each cycle's own settled mean",
            "pool": "type" if by_unit else "unit",
            "serials": serials,
            "after": after_of(curves.cycles),
        },
        fit={
            "cycles": len(curves.cycles),
            "units": max(len(serials), 1),
            "axes": list(curves.axes),
            "axis_units": list(curves.units),
            "settled": settled,
            "models": [_row(row, row is chosen) for row in rows],
            "repeatability": {
                "cycle": _numbers(spread.cycle),
                "standard_uncertainty": _numbers(spread.uncertainty),
                "by_temperature": _numbers(spread.by_temperature),
                "degrees_of_freedom": spread.freedom,
                "unit": None if spread.unit is None else _numbers(spread.unit),
            },
            "worst_temperature": None if worst is None else {"value": worst.temperature, "unit": "degC"},
            "exit_rms": _numbers(np.sqrt(np.mean(exit_jump(table) ** 2, axis=0))),
            "noise": _numbers(np.sqrt(curves.noise)),
            "curve_misfit": misfit(curves, table),
            "coefficient_covariance": None if covariance is None else covariance.tolist(),
        },
        options={key: value for key, value in options.items() if value is not None},
        data=_data(curves),
        sensor=sensor,
        sources=tuple(cycle.source for cycle in curves.cycles if cycle.source is not None),
        warnings=(*quality_warnings(curves, chosen, settled), *expectations(curves, chosen, worst)),
        sections={"table": table.to_section()},
    )


def _parameters(
    curves: Curves, chosen: Judged, spread: CycleSpread, worst: Worst | None
) -> tuple[dict[str, Parameter], tuple[str, ...], Array]:
    """Return T_M, time scales, and per axis the repeatability and the model's errors; names and covariance."""
    parameters = {"settling_time": Parameter(curves.settling_time, None, "s")}
    blocks: list[tuple[tuple[str, ...], Array]] = []
    scales = chosen.solution.scales if chosen.solution else ()
    known = chosen.scales_covariance
    if scales:
        single_scale = chosen.model == "knot-log-cubic"
        names = ("time_scale",) if single_scale else tuple(f"time_constant_{j + 1}" for j in range(len(scales)))
        determined = [j for j, value in enumerate(scales) if not at_limit(curves, value)]
        for j, (name, value) in enumerate(zip(names, scales, strict=True)):
            parameters[name] = Parameter(
                value, float(np.sqrt(known[j, j])) if known is not None and j in determined else None, "s"
            )
        if known is not None and determined:
            blocks.append((tuple(names[j] for j in determined), known[np.ix_(determined, determined)]))
    for i, (axis, unit) in enumerate(zip(curves.axes, curves.units, strict=True)):
        if spread.freedom:
            uncertainty = float(spread.uncertainty[i])
            name = f"repeatability_{axis}"
            parameters[name] = Parameter(float(spread.cycle[i]), uncertainty, unit)
            blocks.append(((name,), np.array([[uncertainty**2]])))
        if spread.unit is not None:
            parameters[f"unit_spread_{axis}"] = Parameter(float(spread.unit[i]), None, unit)
        for key, values in (
            ("training_error", chosen.training),
            ("left_cycle_error", chosen.left_cycle),
            ("left_temperature_error", chosen.left_temperature),
            ("worst_temperature_error", None if worst is None else worst.error),
            ("edge_jump", chosen.edge_jump),
            ("exit_jump", chosen.exit_jump),
        ):
            if values is not None:
                parameters[f"{key}_{axis}"] = Parameter(float(values[i]), None, unit)
    names = tuple(name for block, _ in blocks for name in block)
    matrix, start = np.zeros((len(names), len(names))), 0
    for block, part in blocks:
        stop = start + len(block)
        matrix[start:stop, start:stop] = part
        start = stop
    return parameters, names, matrix


def _row(row: Judged, chosen: bool) -> dict[str, Any]:
    return {
        "model": row.label,
        "chosen": chosen,
        "scales": list(row.solution.scales) if row.solution else [],
        "training": _numbers(row.training),
        "left_cycle": None if row.left_cycle is None else _numbers(row.left_cycle),
        "left_temperature": None if row.left_temperature is None else _numbers(row.left_temperature),
        "by_temperature": _numbers(row.by_temperature),
        "left_by_temperature": _numbers(row.left_by_temperature),
        "edge_jump": _numbers(row.edge_jump),
        "exit_jump": _numbers(row.exit_jump),
    }


def _data(curves: Curves) -> dict[str, Any]:
    """Return the data of the figures: each cycle in bins, relative to its settled mean."""
    middle = (curves.shares * curves.nodes).sum(axis=2)
    cycles = []
    for i, cycle in enumerate(curves.cycles):
        there = curves.seconds[i] > 0
        cycles.append(
            {
                "file": cycle.name,
                "serial": cycle.serial,
                "power_on_temperature": cycle.temperature,
                "calibration_temperature": float(curves.temperatures[curves.group[i]]),
                "first_sample": cycle.first,
                "end": float(curves.end[i]),
                "settled_seconds": float(curves.reference_seconds[i]),
                "settled_mean": _numbers(curves.reference[i]),
                "settled_drift": _numbers(curves.drift[i]),
                "settled_drift_uncertainty": _numbers(curves.drift_uncertainty[i]),
                "moved_seconds": float(curves.moved[i, 0]),
                "time": _numbers(middle[i, there]),
                "seconds": _numbers(curves.seconds[i, there]),
                "curve": _numbers(curves.mean[i, there].T),
            }
        )
    return {"cycles": cycles}


def misfit(curves: Curves, table: WarmupTable) -> dict[str, Any]:
    """Return the rms of the mean curves' residuals over the temperatures in each bin of time, without white noise.

    White noise is taken off. To be added to the variance of a curve from ``coefficient_covariance``, which holds what
    does not repeat.
    """
    mean, seconds = curves.group_means()
    middle = 0.5 * (curves.edges[1:] + curves.edges[:-1])
    inside = middle < table.settling_time
    total = np.zeros((int(inside.sum()), len(curves.axes)))
    for k, at in enumerate(curves.temperatures):
        column = np.clip(curves.power_on[curves.group == k].mean(), *curves.temperatures[[0, -1]])
        z = evaluate(table, middle[inside], float(column))
        assert z is not None, at
        white = curves.noise / np.maximum(seconds[k, inside], 1.0)[:, None]
        total += ((mean[k, inside] - z.T) ** 2 - white) * (seconds[k, inside] > 0)[:, None]
    rms = np.sqrt(np.maximum(total / len(curves.temperatures), 0.0))
    return {
        "time": {"value": _numbers(middle[inside]), "unit": "s"},
        "rms": {
            axis: {"value": _numbers(column), "unit": unit}
            for axis, column, unit in zip(curves.axes, rms.T, curves.units, strict=True)
        },
    }


def _numbers(values: Array) -> Any:
    """Return numbers for figures and tables with seven digits, null for unknown ones."""
    if values.ndim > 1:
        return [_numbers(row) for row in values]
    return [float(f"{x:.{_DIGITS}g}") if np.isfinite(x) else None for x in values.tolist()]
