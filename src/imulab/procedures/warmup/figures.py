"""The figures and tables of a warm-up record, from the record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.procedures.warmup.engineering import engineering_unit
from imulab.procedures.warmup.grid import axis_style, grid, temperature_colour, temperature_mark
from imulab.procedures.warmup.model import WarmupTable, evaluate, record_table
from imulab.procedures.warmup.sections import Cycle, Fit, drawn_of, model_of
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
_LOST = "in noise"
_INSTANTS = (0.0, 30.0, 100.0, 200.0)


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    table = record_table(record)
    if not record.fit:
        return _handmade(table)
    kinds = _kinds(table)
    fit = drawn_of(record).fit
    chosen, none = fit.row(), fit.row("none")
    head, (label, factor) = next(iter(kinds.values())), engineering_unit(table.units[0])
    before, after = (_rms(row.training, head) * factor for row in (none, chosen))
    left = f"{plain_number(after, 2)} {label}" if after > 0 else "nothing above the noise"
    floor = fit.repeatability.cycle
    edges = table.model == "interval-cubic"
    jump = ("largest edge jump", chosen.edge_jump) if edges else ("largest |Z(T_M)|", chosen.exit_jump)
    facts = [
        ("left at the tests", _text(chosen.training, head, factor, f" {label}")),
        ("temperature left out", _text(chosen.left_temperature, head, factor, f" {label}")),
        *_worst(record, fit, table, head, factor, label),
        ("repeatability", _text(floor, head, factor, f" {label}")),
        (jump[0], f"{_largest(jump[1], head, factor)} {label}"),
        ("settling time T_M", f"{table.settling_time:g} s"),
        ("power cycles", str(fit.cycles)),
    ]
    items: list[Figure | ReportTable] = []
    for kind, index in kinds.items():
        items.append(_models(record, table, kind, index))
    if fit.repeatability.unit is not None:
        items.append(_units(fit, table, kinds, fit.repeatability.unit))
    for kind, index in kinds.items():
        items.append(_cycles(record, table, kind, index))
    for kind, index in kinds.items():
        items.append(_residuals(record, table, kind, index))
    for kind, index in kinds.items():
        items.append(_by_temperature(record, table, kind, index))
    items += [_over_temperature(table), _tests(record, table)]
    return Exhibits(
        headline=f"The {chosen.model} table leaves {left} of "
        f"{plain_number(before, 2)} {label} rms in the {table.settling_time:g} s after power-on"
        + (f"; power cycles repeat to {_text(floor, head, factor, f' {label}')}." if _rms(floor, head) > 0 else "."),
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
            cells += [_text(fit.row(name).training, [i], factor) for name in ("none", None)]
            floor, u = fit.repeatability.cycle[i], fit.repeatability.standard_uncertainty[i]
            known = format_uncertain(floor * factor, u * factor) if floor and u else [_text([floor], [0], factor)]
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
    error = _text([record.value(name) for name in names], list(range(len(names))), factor, f" {label}")
    return [(f"at worst, near {at.value:.3g} °C", error)]


def _handmade(table: WarmupTable) -> Exhibits:
    low, high = table.temperatures[[0, -1]]
    return Exhibits(
        headline=f"Table of model {table.model}, {low:g} to {high:g} degC, made from a file of coefficients.",
        facts=[("model", table.model), ("T_M", f"{table.settling_time:g} s"), ("axes", " ".join(table.axes))],
        items=[_over_temperature(table)],
    )


def _kinds(table: WarmupTable) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for i, axis in enumerate(table.axes):
        found.setdefault("gyroscopes" if axis.startswith("gyro") else "accelerometers", []).append(i)
    return found


def _rms(values: list[float | None] | None, index: list[int]) -> float:
    chosen = [values[i] for i in index] if values else [None]
    if any(value is None for value in chosen):
        return float("nan")
    return float(np.sqrt(np.mean(np.square(np.array(chosen, dtype=np.float64)))))


def _text(values: list[float | None] | None, index: list[int], factor: float, unit: str = "") -> str:
    """Root mean square of some axes as text; what is not above the white noise has no number."""
    value = _rms(values, index) * factor
    if np.isnan(value):
        return "–"
    return f"{plain_number(value, 2)}{unit}" if value > 0 else _LOST


def _models(record: Calibration, table: WarmupTable, kind: str, index: list[int]) -> ReportTable:
    label, factor = engineering_unit(table.units[index[0]])
    rows, highlight = [], None
    fit = drawn_of(record).fit
    for number, row in enumerate(fit.models):
        if row.chosen:
            highlight = number
        scales = ", ".join(plain_number(value, 3) for value in row.scales) or "–"
        none = row.model == "none"
        rows.append(
            [
                row.model,
                _text(row.training, index, factor),
                "–" if none else _text(row.left_cycle, index, factor),
                _text(row.left_temperature, index, factor),
                "–" if none else _largest(row.edge_jump, index, factor),
                "–" if none else _largest(row.exit_jump, index, factor),
                scales,
            ]
        )
    floor = _text(fit.repeatability.cycle, index, factor, f" {label}")
    what = "unit" if model_of(record).pool == "type" else "cycle"
    return ReportTable(
        title=f"Models compared, {kind}, {label}",
        caption="Root mean square over all axes and the time t after power-on up to T_M, from which the unit is "
        "settled and nothing is subtracted; white noise taken off. Z is what the table subtracts. Columns: the cycles "
        f"fitted, of each {what} left out, of each temperature left out (its neighbours are then twice as far as in "
        "use); largest jump where a power-on temperature crosses an edge; largest |Z(T_M)|, which exit zero drops at "
        f"once. No table can beat the repeatability of cycles, {floor}.",
        columns=["model", "at tests", f"{what} left out", "temp. left out", "edge jump", "|Z(T_M)|", "tau, s"],
        rows=rows,
        highlight=highlight,
    )


def _units(fit: Fit, table: WarmupTable, kinds: dict[str, list[int]], units: list[float | None]) -> ReportTable:
    """Whether one table for the type is enough, axis by axis."""
    found = fit.repeatability
    rows = []
    for index in kinds.values():
        for i in index:
            label, factor = engineering_unit(table.units[i])
            unit, cycle, uncertainty = units[i], found.cycle[i], found.standard_uncertainty[i]
            verdict = "–"
            if unit is not None and cycle is not None and uncertainty is not None:
                verdict = "each unit" if unit > cycle + 2 * uncertainty else "one per type"
            shown = [_text(values, [i], factor) for values in (units, found.cycle)]
            rows.append([table.axes[i], *shown, verdict, label])
    return ReportTable(
        title=f"Spread between {fit.units} units",
        caption="Root mean square deviation of a unit's curve from that of the type, beside that of a cycle from its "
        "unit. Where units differ clearly more than their cycles do (by two standard uncertainties of the latter), a "
        "table for each unit would gain; otherwise one per type is enough.",
        columns=["axis", "between units", "between cycles", "table for", "unit"],
        rows=rows,
    )


def _largest(values: list[float | None], index: list[int], factor: float) -> str:
    known = [value for i in index if (value := values[i]) is not None]
    return plain_number(max(known) * factor, 2) if known else "–"


def _cycles(record: Calibration, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = engineering_unit(table.units[index[0]])
    time = np.linspace(0.0, table.settling_time * (1 - 1e-9), _POINTS)
    cells: list[list[dict[str, Any]]] = []
    for i in index:
        traces: list[dict[str, Any]] = []
        for cycle in drawn_of(record).data.cycles:
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


def _residuals(record: Calibration, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = engineering_unit(table.units[index[0]])
    cells: list[list[dict[str, Any]]] = [[] for _ in index]
    data = drawn_of(record).data
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


def _by_temperature(record: Calibration, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = engineering_unit(table.units[index[0]])
    drawn = drawn_of(record)
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
        values = [_rms(row, index) * factor for row in rows]
        points = [(t, v) for t, v in zip(knots, values, strict=True) if np.isfinite(v) and v > 0]
        if points:
            x, y = [t for t, _ in points], rounded([v for _, v in points], 4)
            line, marker = {"color": colour, "dash": dash}, {"symbol": symbol, "size": 8}
            hover = f"{name}<br>%{{x:g}} degC: %{{y:.3g}} {label}<extra></extra>"
            traces.append(scatter(x, y, "lines+markers", name=name, line=line, marker=marker, hovertemplate=hover))
    after = [(_rms(row, index) * factor, at) for row, at in zip(chosen.by_temperature, knots, strict=True)]
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
    for number, index in enumerate(_kinds(table).values()):
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


def _tests(record: Calibration, table: WarmupTable) -> ReportTable:
    label, factor = engineering_unit(table.units[0])
    head = next(iter(_kinds(table).values()))
    drawn = drawn_of(record)
    chosen = drawn.fit.row()
    rows = []
    for k, at in enumerate(drawn.data.knots):
        members = [cycle for cycle in drawn.data.cycles if cycle.calibration_temperature == at]
        power_on = [cycle.power_on_temperature for cycle in members]
        drift = [None if (moved := cycle.settled_drift[i]) is None else abs(moved) for cycle in members for i in head]
        rows.append(
            [
                f"{at:g}",
                str(len(members)),
                f"{min(power_on):.2f} to {max(power_on):.2f}",
                _text(drawn.fit.repeatability.by_temperature[k], head, factor),
                _text(chosen.by_temperature[k], head, factor),
                _text(chosen.left_by_temperature[k], head, factor),
                _largest(drift, list(range(len(drift))), factor),
                f"{min(cycle.end for cycle in members):g}",
            ]
        )
    return ReportTable(
        title=f"The test, by temperature ({label})",
        caption="Repeatability, what is left, and what is left where this temperature was kept out of the fit; largest "
        "change of the settled part from T_M to its end; end of the shortest cycle.",
        columns=["degC", "cycles", "power-on, degC", "repeatability", "left", "left out", "settled drift", "end, s"],
        rows=rows,
    )
