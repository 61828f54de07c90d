"""The figures and tables of a warm-up record, made from the record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.estimation.rows import rms
from imulab.procedures.warmup.model import WarmupTable, evaluate, record_table
from imulab.procedures.warmup.schema import CycleCurve, WarmupRecord, WarmupSummary, drawn_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.parameters import small_unit
from imulab.report.traces import (
    BAD,
    GOOD,
    INK,
    LEGEND,
    QUIET,
    SYMBOLS,
    Exhibits,
    Figure,
    ReportTable,
    figure_axis,
    format_uncertain,
    plain_number,
    rounded,
    scatter,
)

# A row of plots that share their axes, coloured by temperature.


_ACROSS = 3  # panels in a row
_DECADES = [1, 10, 100, 1000]  # s that an axis of time is numbered by
_SCALE = ("#2c4fa3", "#3d8fc4", "#58b5a6", "#a3bf58", "#e0a83c", "#d5663a", "#a8322f")
"""Colours from cold to warm; they differ in lightness too."""


def temperature_colour(temperature: float, temperatures: Array) -> str:
    """Return the colour of a temperature between the coldest and the warmest, as #rrggbb."""
    low, high = float(temperatures[0]), float(temperatures[-1])
    position = float(np.clip((temperature - low) / max(high - low, 1e-9), 0, 1)) * (len(_SCALE) - 1)
    first = min(int(position), len(_SCALE) - 2)
    share = position - first
    ends = [np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) for colour in _SCALE[first : first + 2]]
    mixed = np.rint((1 - share) * ends[0] + share * ends[1]).astype(int)
    return "#" + "".join(f"{value:02x}" for value in mixed)


def temperature_mark(temperature: float, temperatures: Array) -> str:
    """Return the mark of the calibration temperature that is nearest."""
    return SYMBOLS[int(np.argmin(np.abs(temperatures - temperature))) % len(SYMBOLS)]


def _temperature_key(temperatures: Array) -> list[dict[str, Any]]:
    """Return, for the key, a trace without points for each temperature."""
    return [
        {
            "type": "scatter",
            "mode": "lines+markers",
            "x": [None],
            "y": [None],
            "name": f"{at:g} °C",
            "line": {"color": temperature_colour(at, temperatures), "width": 3},
            "marker": {"symbol": temperature_mark(at, temperatures), "size": 7},
        }
        for at in temperatures.tolist()
    ]


def grid(
    *,
    title: str,
    caption: str,
    names: list[str],
    cells: list[list[dict[str, Any]]],
    y_title: str,
    temperatures: Array,
    log_time: bool = False,
) -> Figure:
    """Return a figure of one plot per name, at most three across, with a common key of temperatures below the title.

    On a logarithmic axis, bins that widen with time are evenly spaced.
    """
    across = min(len(names), _ACROSS)
    down = -(-len(names) // across)
    gap_x, gap_y = 0.06, 0.16 / down
    width, height = (1 - gap_x * (across - 1)) / across, (1 - gap_y * (down - 1)) / down
    layout: dict[str, Any] = {
        "showlegend": True,
        "legend": {"orientation": "h", "x": 0, "y": 1 + 0.09 / down, "yanchor": "bottom", "itemsizing": "constant"},
        "annotations": [],
    }
    traces = _temperature_key(temperatures)
    for number, (name, cell) in enumerate(zip(names, cells, strict=True)):
        row, column = divmod(number, across)
        suffix = "" if number == 0 else str(number + 1)
        left, top = column * (width + gap_x), 1 - row * (height + gap_y)
        here = {"type": "scatter", "showlegend": False, "xaxis": f"x{suffix}", "yaxis": f"y{suffix}"}
        traces += [{**here, **trace} for trace in cell]
        bottom = row == down - 1
        scale = {"type": "log", "tickvals": _DECADES} if log_time else {"rangemode": "tozero"}
        layout[f"xaxis{suffix}"] = figure_axis(
            "s after power-on" if bottom else "", domain=[left, left + width], anchor=f"y{suffix}", **scale
        )
        layout[f"yaxis{suffix}"] = figure_axis(
            y_title if column == 0 else "",
            domain=[top - height, top],
            anchor=f"x{suffix}",
            showticklabels=column == 0,
            ticks="outside" if column == 0 else "",
            tickcolor="#ffffff",
            **({} if number == 0 else {"matches": "y"}),
        )
        layout["annotations"].append(
            {
                "text": f"<b>{name}</b>",
                "xref": "paper",
                "yref": "paper",
                "x": left,
                "y": top,
                "xanchor": "left",
                "yanchor": "bottom",
                "showarrow": False,
            }
        )
    return Figure(title=title, caption=caption, traces=traces, layout=layout, height=120 + 280 * down)


# The tables of a warm-up record, and its numbers as text.


_LOST = "in noise"


def models_table(drawn: WarmupRecord, table: WarmupTable, kind: str, index: list[int]) -> ReportTable:
    """Return the table of the compared models, over the axes of one kind."""
    label, factor = small_unit(table.units[index[0]]).scale
    rows, highlight = [], None
    fit = drawn.fit
    for number, row in enumerate(fit.models):
        if row.chosen:
            highlight = number
        scales = ", ".join(plain_number(value, 3) for value in row.scales) or "–"
        none = row.model == "none"
        rows.append(
            [
                row.model,
                rms_text(row.training, index, factor),
                "–" if none else rms_text(row.left_cycle, index, factor),
                rms_text(row.left_temperature, index, factor),
                "–" if none else largest_text(row.edge_jump, index, factor),
                "–" if none else largest_text(row.exit_jump, index, factor),
                scales,
            ]
        )
    floor = rms_text(fit.repeatability.cycle, index, factor, f" {label}")
    what = "unit" if drawn.model.pool == "type" else "cycle"
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


def units_table(
    fit: WarmupSummary, table: WarmupTable, kinds: dict[str, list[int]], units: list[float | None]
) -> ReportTable:
    """Return the table that shows, axis by axis, whether one table for the type is enough."""
    spread = fit.repeatability
    rows = []
    for index in kinds.values():
        for i in index:
            label, factor = small_unit(table.units[i]).scale
            unit, cycle, uncertainty = units[i], spread.cycle[i], spread.standard_uncertainty[i]
            verdict = "–"
            if unit is not None and cycle is not None and uncertainty is not None:
                verdict = "each unit" if unit > cycle + 2 * uncertainty else "one per type"
            shown = [rms_text(values, [i], factor) for values in (units, spread.cycle)]
            rows.append([table.axes[i], *shown, verdict, label])
    return ReportTable(
        title=f"Spread between {fit.units} units",
        caption="Root mean square deviation of a unit's curve from that of the type, beside that of a cycle from its "
        "unit. Where units differ clearly more than their cycles do (by two standard uncertainties of the latter), a "
        "table for each unit would gain; otherwise one per type is enough.",
        columns=["axis", "between units", "between cycles", "table for", "unit"],
        rows=rows,
    )


def tests_table(drawn: WarmupRecord, table: WarmupTable) -> ReportTable:
    """Return the table of what each calibration temperature showed, over the axes of the first kind."""
    label, factor = small_unit(table.units[0]).scale
    head = next(iter(axes_by_kind(table).values()))
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
                rms_text(drawn.fit.repeatability.by_temperature[k], head, factor),
                rms_text(chosen.by_temperature[k], head, factor),
                rms_text(chosen.left_by_temperature[k], head, factor),
                largest_text(drift, list(range(len(drift))), factor),
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


def axes_by_kind(table: WarmupTable) -> dict[str, list[int]]:
    """Return the places of the gyroscopes' axes, and of the accelerometers'."""
    kinds: dict[str, list[int]] = {}
    for i, axis in enumerate(table.axes):
        kinds.setdefault("gyroscopes" if axis.startswith("gyro") else "accelerometers", []).append(i)
    return kinds


def rms_of(values: list[float | None] | None, index: list[int]) -> float:
    """Return the root mean square of the values of some axes, NaN where one is not known."""
    chosen = [values[i] for i in index] if values else [None]
    if any(value is None for value in chosen):
        return float("nan")
    return rms(np.array(chosen, dtype=np.float64))


def rms_text(values: list[float | None] | None, index: list[int], factor: float, unit: str = "") -> str:
    """Return the root mean square of some axes as text; values below the white noise have no number."""
    value = rms_of(values, index) * factor
    if np.isnan(value):
        return "–"
    return f"{plain_number(value, 2)}{unit}" if value > 0 else _LOST


def largest_text(values: list[float | None], index: list[int], factor: float) -> str:
    """Return the largest of the values of some axes as text."""
    known = [value for i in index if (value := values[i]) is not None]
    return plain_number(max(known) * factor, 2) if known else "–"


# Figures and summary of a record.


_POINTS = 121  # of a curve
_INSTANTS = (0.0, 30.0, 100.0, 200.0)  # s after power-on that are drawn over the temperature


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    table = record_table(record)
    if not record.fit:
        return _table_exhibits(table)
    by_kind = axes_by_kind(table)
    drawn = drawn_of(record)
    fit = drawn.fit
    chosen, none = fit.row(), fit.row("none")
    head, (label, factor) = next(iter(by_kind.values())), small_unit(table.units[0]).scale
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
        label, factor = small_unit(table.units[i]).scale
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
    record: Calibration, fit: WarmupSummary, table: WarmupTable, index: list[int], factor: float, label: str
) -> list[tuple[str, str]]:
    """Return the fact about the error at the worst power-on temperature; nothing where a record lacks it."""
    at = fit.worst_temperature
    names = [f"worst_temperature_error_{table.axes[i]}" for i in index]
    if at is None or not all(name in record.parameters for name in names):
        return []
    error = rms_text([record.value(name) for name in names], list(range(len(names))), factor, f" {label}, rms of axes")
    return [(f"at worst, near {at.value:.3g} °C", error)]


def _table_exhibits(table: WarmupTable) -> Exhibits:
    low, high = table.temperatures[[0, -1]]
    return Exhibits(
        headline=f"Table of model {table.model}, {low:g} to {high:g} degC, made from a file of coefficients.",
        facts=[("model", table.model), ("T_M", f"{table.settling_time:g} s"), ("axes", " ".join(table.axes))],
        items=[_over_temperature(table)],
    )


def _cycles(drawn: WarmupRecord, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = small_unit(table.units[index[0]]).scale
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


def _residuals(drawn: WarmupRecord, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = small_unit(table.units[index[0]]).scale
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


def _mean_residual(table: WarmupTable, members: list[CycleCurve]) -> tuple[Array, Array]:
    """Return the mean over cycles of curve less table, on the bins that all have: time (b,), residual (axes, b)."""
    size = min(len(cycle.time) for cycle in members)
    total, time = np.zeros((len(table.axes), size)), np.zeros(size)
    for cycle in members:
        cycle_time = np.array(cycle.time[:size])
        z = evaluate(table, cycle_time, _inside(table, cycle.power_on_temperature))
        curve = np.array(cycle.curve, dtype=np.float64)[:, :size]
        total += curve - (0.0 if z is None else z)
        time += cycle_time
    return time / len(members), total / len(members)


def _inside(table: WarmupTable, temperature: float) -> float:
    return float(np.clip(temperature, table.temperatures[0], table.temperatures[-1]))


def _by_temperature(drawn: WarmupRecord, table: WarmupTable, kind: str, index: list[int]) -> Figure:
    label, factor = small_unit(table.units[index[0]]).scale
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
            "xaxis": figure_axis("power-on temperature, degC", tickvals=knots),
            "yaxis": figure_axis(f"rms, {label}", type="log", dtick="D2" if len(traces) > 9 else 1),
            "legend": LEGEND,
        },
        height=400,
    )


def _over_temperature(table: WarmupTable) -> Figure:
    """Return the figure of Z at a few instants over power-on temperature, which shows jumps at edges."""
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
        label, factor = small_unit(table.units[i]).scale
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
        layout[f"xaxis{suffix}"] = figure_axis("power-on temperature, degC", domain=domain, anchor=f"y{suffix}")
        layout[f"yaxis{suffix}"] = figure_axis(f"{axis}, {label}", anchor=f"x{suffix}")
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
