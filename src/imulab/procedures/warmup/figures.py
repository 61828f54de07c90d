"""The figures and tables of a warm-up record, from the record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.procedures.warmup.engineering import engineering_unit
from imulab.procedures.warmup.grid import axis_style, grid, temperature_colour, temperature_mark
from imulab.procedures.warmup.model import WarmupTable, evaluate, record_table
from imulab.procedures.warmup.sections import Cycle, Fit, Warmup, drawn_of
from imulab.procedures.warmup.tables import (
    axes_by_kind,
    largest_text,
    models_table,
    rms_of,
    rms_text,
    tests_table,
    units_table,
)
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import (
    BAD,
    GOOD,
    INK,
    LEGEND,
    QUIET,
    Exhibits,
    Figure,
    ReportTable,
    format_uncertain,
    plain_number,
)
from imulab.report.traces import rounded, scatter

_POINTS = 121
_INSTANTS = (0.0, 30.0, 100.0, 200.0)


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    table = record_table(record)
    if not record.fit:
        return _exhibits_of_table(table)
    by_kind = axes_by_kind(table)
    drawn = drawn_of(record)
    fit = drawn.fit
    chosen, none = fit.row(), fit.row("none")
    head, (label, factor) = next(iter(by_kind.values())), engineering_unit(table.units[0])
    before, after = (rms_of(row.training, head) * factor for row in (none, chosen))
    left = f"{plain_number(after, 2)} {label}" if after > 0 else "nothing above the noise"
    floor = fit.repeatability.cycle
    repeat = rms_text(floor, head, factor, f" {label}")
    edges = table.model == "interval-cubic"
    jump = ("largest edge jump", chosen.edge_jump) if edges else ("largest |Z(T_M)|", chosen.exit_jump)
    facts = [
        ("left at the tests", rms_text(chosen.training, head, factor, f" {label}")),
        ("temperature left out", rms_text(chosen.left_temperature, head, factor, f" {label}")),
        *_worst(record, fit, table, head, factor, label),
        ("repeatability", repeat),
        (jump[0], f"{largest_text(jump[1], head, factor)} {label}"),
        ("settling time T_M", f"{table.settling_time:g} s"),
        ("power cycles", str(fit.cycles)),
    ]
    items: list[Figure | ReportTable] = []
    for kind, index in by_kind.items():
        items.append(models_table(drawn, table, kind, index))
    if fit.repeatability.unit is not None:
        items.append(units_table(fit, table, by_kind, fit.repeatability.unit))
    for kind, index in by_kind.items():
        items.append(_cycles(drawn, table, kind, index))
    for kind, index in by_kind.items():
        items.append(_residuals(drawn, table, kind, index))
    for kind, index in by_kind.items():
        items.append(_by_temperature(drawn, table, kind, index))
    items += [_over_temperature(table), tests_table(drawn, table)]
    return Exhibits(
        headline=f"The {chosen.model} table leaves {left} of "
        f"{plain_number(before, 2)} {label} rms in the {table.settling_time:g} s after power-on"
        + (f"; power cycles repeat to {repeat}." if rms_of(floor, head) > 0 else "."),
        facts=facts,
        items=items,
    )


def summary(record: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return, for each axis, what the table subtracts at power-on, and the error without and with it."""
    table = record_table(record)
    at = table.temperatures[[0, len(table.temperatures) // 2, -1]].tolist()
    first = [evaluate(table, np.zeros(1), _inside(table, temperature)) for temperature in at]
    fit = drawn_of(record).fit if record.fit else None
    rows = []
    for i, axis in enumerate(table.axes):
        label, factor = engineering_unit(table.units[i])
        cells = ["–" if z is None else plain_number(float(z[i, 0]) * factor, 3) for z in first]
        if fit is not None:
            cells += [rms_text(fit.row(name).training, [i], factor) for name in ("none", None)]
            floor, u = fit.repeatability.cycle[i], fit.repeatability.standard_uncertainty[i]
            known = format_uncertain(floor * factor, u * factor) if floor and u else [rms_text([floor], [0], factor)]
            cells.append(" ± ".join(known))
        rows.append([axis, *cells, label])
    titles = ["rms before", "rms after", "cycles repeat to"] if fit is not None else []
    return ["axis", *(f"power-on, {temperature:g} °C" for temperature in at), *titles, "unit"], rows


def _worst(
    record: Calibration, fit: Fit, table: WarmupTable, index: list[int], factor: float, label: str
) -> list[tuple[str, str]]:
    """What to expect at the worst power-on temperature; nothing where a record does not hold it."""
    at = fit.worst_temperature
    names = [f"worst_temperature_error_{table.axes[i]}" for i in index]
    if at is None or not all(name in record.parameters for name in names):
        return []
    error = rms_text([record.value(name) for name in names], list(range(len(names))), factor, f" {label}")
    return [(f"at worst, near {at.value:.3g} °C", error)]


def _exhibits_of_table(table: WarmupTable) -> Exhibits:
    low, high = table.temperatures[[0, -1]]
    return Exhibits(
        headline=f"Table of model {table.model}, {low:g} to {high:g} degC, made from a file of coefficients.",
        facts=[("model", table.model), ("T_M", f"{table.settling_time:g} s"), ("axes", " ".join(table.axes))],
        items=[_over_temperature(table)],
    )


def _cycles(drawn: Warmup, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = engineering_unit(table.units[index[0]])
    time = np.linspace(0.0, table.settling_time * (1 - 1e-9), _POINTS)
    cells: list[list[dict[str, Any]]] = []
    for i in index:
        traces: list[dict[str, Any]] = []
        for cycle in drawn.data.cycles:
            at = cycle.calibration_temperature
            colour, mark = temperature_colour(at, table.temperatures), temperature_mark(at, table.temperatures)
            traces.append(
                {
                    "mode": "markers",
                    "x": cycle.time,
                    "y": rounded(np.array(cycle.curve[i], dtype=np.float64) * factor, 4),
                    "marker": {"color": colour, "symbol": mark, "size": 4, "opacity": 0.55},
                    "hovertemplate": f"{at:g} degC, {cycle.file}<br>%{{x:.0f}} s: %{{y:.3g}} {label}<extra></extra>",
                }
            )
        for at in table.temperatures.tolist():
            z = evaluate(table, time, _inside(table, at))
            if z is not None:
                traces.append(
                    {
                        "mode": "lines",
                        "x": rounded(time, 4),
                        "y": rounded(z[i] * factor, 4),
                        "line": {"color": temperature_colour(at, table.temperatures), "width": 2},
                        "hovertemplate": f"{at:g} degC, fitted<br>%{{x:.0f}} s: %{{y:.3g}} {label}<extra></extra>",
                    }
                )
        cells.append(traces)
    half = " In the half-open intervals each line is that of the interval which begins there."
    return grid(
        title=f"Power cycles and what the unit subtracts, {kind}",
        caption="Points: each cycle less its settled mean, averaged over bins. Lines: the table at the calibration "
        "temperatures (colours and marks). A line beside its points is what the model cannot follow."
        + (half if table.model == "interval-cubic" else ""),
        names=[table.axes[i] for i in index],
        cells=cells,
        y_title=label,
        temperatures=table.temperatures,
    )


def _residuals(drawn: Warmup, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = engineering_unit(table.units[index[0]])
    cells: list[list[dict[str, Any]]] = [[] for _ in index]
    data = drawn.data
    for at in data.knots:
        members = [cycle for cycle in data.cycles if cycle.calibration_temperature == at]
        time, left = _mean_residual(table, members)
        for cell, i in zip(cells, index, strict=True):
            cell.append(
                {
                    "mode": "lines+markers",
                    "x": rounded(time, 4),
                    "y": rounded(left[i] * factor, 4),
                    "line": {"color": temperature_colour(at, table.temperatures), "width": 1.2},
                    "marker": {"size": 4, "symbol": temperature_mark(at, table.temperatures)},
                    "hovertemplate": f"{at:g} degC, {len(members)} cycles<br>%{{x:.0f}} s: %{{y:.3g}} {label}"
                    "<extra></extra>",
                }
            )
    return grid(
        title=f"What is left, {kind}",
        caption="Mean over the cycles of each temperature, less the table, over the logarithm of time. Scatter about "
        "zero is noise (most in the short bins at first) and repeatability; an arch or an offset common to a "
        "temperature is the model.",
        names=[table.axes[i] for i in index],
        cells=cells,
        y_title=label,
        temperatures=table.temperatures,
        log_time=True,
    )


def _mean_residual(table: WarmupTable, members: list[Cycle]) -> tuple[Array, Array]:
    """Mean over cycles of curve less table, on the bins that all of them have: time (b,), residual (axes, b)."""
    size = min(len(cycle.time) for cycle in members)
    total, time = np.zeros((len(table.axes), size)), np.zeros(size)
    for cycle in members:
        own = np.array(cycle.time[:size])
        z = evaluate(table, own, _inside(table, cycle.power_on_temperature))
        curve = np.array(cycle.curve, dtype=np.float64)[:, :size]
        total += curve - (0.0 if z is None else z)
        time += own
    return time / len(members), total / len(members)


def _inside(table: WarmupTable, temperature: float) -> float:
    return float(np.clip(temperature, table.temperatures[0], table.temperatures[-1]))


def _by_temperature(drawn: Warmup, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = engineering_unit(table.units[index[0]])
    fit, knots = drawn.fit, drawn.data.knots
    chosen = fit.row()
    lines = [
        ("none", fit.row("none").by_temperature, QUIET, "solid", "circle"),
        (f"{chosen.model}, left out", chosen.left_by_temperature, BAD, "dash", "square"),
        (chosen.model, chosen.by_temperature, GOOD, "solid", "diamond"),
        ("repeatability", fit.repeatability.by_temperature, INK, "dot", "x"),
    ]
    source = next((row for row in fit.models if row.model == "interval-cubic" and not row.chosen), None)
    if source is not None:
        lines.insert(1, ("interval-cubic", source.by_temperature, "#b08a3e", "dashdot", "triangle-up"))
    traces = []
    for name, rows, colour, dash, symbol in lines:
        values = [rms_of(row, index) * factor for row in rows]
        points = [(t, v) for t, v in zip(knots, values, strict=True) if np.isfinite(v) and v > 0]
        if points:
            x, y = [t for t, _ in points], rounded([v for _, v in points], 4)
            line, marker = {"color": colour, "dash": dash}, {"symbol": symbol, "size": 8}
            hover = f"{name}<br>%{{x:g}} degC: %{{y:.3g}} {label}<extra></extra>"
            traces.append(scatter(x, y, "lines+markers", name=name, line=line, marker=marker, hovertemplate=hover))
    after = [(rms_of(row, index) * factor, at) for row, at in zip(chosen.by_temperature, knots, strict=True)]
    worst, at = max((pair for pair in after if pair[0] > 0), default=(0.0, 0.0))
    return Figure(
        message=f"The chosen table is farthest off at {at:g} degC: {plain_number(worst, 2)} {label}.",
        title=f"Error by power-on temperature, {kind}",
        caption="Root mean square over all axes and the time up to T_M. Left out: predicted from the neighbouring "
        "temperatures alone. Nothing lies far below the repeatability; what is lost in the noise has no point.",
        traces=traces,
        layout={
            "xaxis": axis_style("power-on temperature, degC", tickvals=knots),
            "yaxis": axis_style(f"rms, {label}", type="log", dtick="D2" if len(traces) > 9 else 1),
            "legend": LEGEND,
        },
        height=400,
    )


def _over_temperature(table: WarmupTable) -> Figure:
    """Z at a few instants over power-on temperature: jumps at edges are seen at once."""
    low, high = table.temperatures[[0, -1]]
    fine = np.linspace(low, high, 201)
    near = np.concatenate([[t - 1e-9 * (1 + abs(t)), t] for t in table.temperatures])
    at = np.unique(np.concatenate([fine, near[(near >= low) & (near <= high)]]))
    instants = np.array([t for t in _INSTANTS if t < table.settling_time])
    z = np.array([evaluate(table, instants, float(t)) for t in at])  # (t, axes, instants)
    spread = np.abs(z[:, :, 0]).max(axis=0)
    traces: list[dict[str, Any]] = []
    names = []
    for number, index in enumerate(axes_by_kind(table).values()):
        i = index[int(np.argmax(spread[index]))]
        label, factor = engineering_unit(table.units[i])
        names.append((table.axes[i], label))
        suffix = "" if number == 0 else "2"
        for j, instant in enumerate(instants):
            shade = ["#12303c", GOOD, "#5aa5bd", "#a9cfdb"][j]
            dash = ["solid", "dash", "dashdot", "dot"][j]
            traces.append(
                scatter(rounded(at, 12), rounded(z[:, i, j] * factor, 4), "lines", name=f"{instant:g} s",
                        showlegend=number == 0, xaxis=f"x{suffix}", yaxis=f"y{suffix}",
                        line={"color": shade, "width": 2, "dash": dash},
                        hovertemplate=f"{instant:g} s<br>%{{x:.1f}} degC: %{{y:.3g}} {label}<extra></extra>")
            )  # fmt: skip
    layout: dict[str, Any] = {"legend": {**LEGEND, "title": {"text": "after power-on: "}}}
    for number, (axis, label) in enumerate(names):
        suffix = "" if number == 0 else "2"
        domain = [0, 1] if len(names) == 1 else [[0, 0.44], [0.56, 1]][number]
        layout[f"xaxis{suffix}"] = axis_style("power-on temperature, degC", domain=domain, anchor=f"y{suffix}")
        layout[f"yaxis{suffix}"] = axis_style(f"{axis}, {label}", anchor=f"x{suffix}")
    steps = (
        "A vertical step is a jump at an edge: two power-ons a hair apart are corrected by that much differently."
        if table.model == "interval-cubic"
        else "Outside these temperatures nothing is subtracted."
    )
    return Figure(
        title="What the unit subtracts, over power-on temperature",
        caption="The axis with the largest curve of each kind, at instants after power-on. " + steps,
        traces=traces,
        layout=layout,
        height=380,
    )
