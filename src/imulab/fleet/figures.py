"""The figures and tables of a fleet's report: parameters over units and dates, outliers, changes, failures.

Parameters over units and dates, units that stand out, what changed since last time, and failures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from imulab.errors import first_of
from imulab.fleet.run import FleetState
from imulab.fleet.statistics import FEWEST_FOR_OUTLIERS, FleetChange, FleetDrift, ParameterStatistics, change_limit
from imulab.fleet.table import FleetRow
from imulab.recording import Array
from imulab.report import traces as grid
from imulab.report.parameters import ReadingUnit, reading_unit
from imulab.report.traces import (
    BAD,
    GOOD,
    QUIET,
    Figure,
    ReportTable,
    bulk,
    edge_marks,
    edge_note,
    format_uncertain,
    plain_number,
    rounded,
    scatter,
    with_labels,
)

# Panels of the figures, one for each parameter.


_DAYS = 4.0
"""Dates that span at most so many days are shown with their time."""


_FEW_UNITS = 10
"""An axis up to so many units is numbered in steps of 1 or 2, where Plotly would take halves."""


def staggered(marked: NDArray[np.bool_], top: int) -> list[float]:
    """Return heights for marks at the side of a histogram, one below the other from above the highest bar down."""
    order = np.cumsum(marked) - 1
    return [round(top * (1.15 - 0.15 * (k % 7)), 3) for k in order.tolist()]


_SPANS_DRAWN, _SPANS_OVER_DATE = 10.0, 1.0
"""Limits so many times the spread of the values away from them are drawn; over the date only nearer ones."""


def limits_in_view(
    item: ParameterStatistics, shown: ReadingUnit, values: Array, spans: float = _SPANS_DRAWN
) -> list[float]:
    """Return the limits to draw: those at most `spans` spreads from the shown values, and any that a unit is beyond."""
    if item.limits is None:
        return []
    span = max(float(np.ptp(values)), 1e-300)
    ends = []
    for end, broken in (
        (item.limits.lower, item.values < item.limits.lower),
        (item.limits.upper, item.values > item.limits.upper),
    ):
        reach = span * (_SPANS_DRAWN if broken.any() else spans)
        if math.isfinite(end) and values.min() - reach <= shown.of(end) <= values.max() + reach:
            ends.append(float(shown.of(end)))
    return sorted(ends)


def with_limits(low: float, high: float, limits: Sequence[float]) -> tuple[float, float]:
    """Return the range of an axis that holds limits too, with room beyond them."""
    room = 0.04 * (max(high, *limits) - min(low, *limits)) if limits else 0.0
    return min([low, *(end - room for end in limits)]), max([high, *(end + room for end in limits)])


def bin_edges(values: Array) -> Array:
    """Return edges of bins by the rule of Freedman and Diaconis for the bulk of the values, at most 60 bins."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        half = abs(low) * 1e-6 or 0.5
        return np.linspace(low - half, high + half, 4)
    quarters = np.quantile(values, [0.25, 0.75])
    width = 2 * float(quarters[1] - quarters[0]) / len(values) ** (1 / 3) or (high - low) / 10
    return np.linspace(low, high, int(np.clip(math.ceil((high - low) / width), 5, 60)) + 1)


def date(day: float) -> str:
    """Return days since 1970 as dates of Plotly."""
    return datetime.fromtimestamp(day * 86400.0, UTC).strftime("%Y-%m-%d %H:%M:%S")


def date_axis(days: Array) -> dict[str, Any]:
    """Return an axis of dates with three ticks: the first date, the middle and the last."""
    first, last = float(np.nanmin(days)), float(np.nanmax(days))
    margin = 0.04 * max(last - first, 1 / 24)
    form = "%m-%d<br>%Y" if last - first > _DAYS else "%H:%M<br>%m-%d"
    ticks = [datetime.fromtimestamp(86400.0 * day, UTC) for day in (first, (first + last) / 2, last)]
    return {
        "type": "date",
        "range": [date(first - margin), date(last + margin)],
        "tickvals": [date(first), date((first + last) / 2), date(last)],
        "ticktext": [tick.strftime(form) for tick in ticks],
    }


def which_are_drawn(statistics: Sequence[ParameterStatistics], panels: Sequence[ParameterStatistics]) -> str:
    """Return a sentence where not all parameters are drawn, else nothing."""
    if len(panels) == len(statistics):
        return ""
    return f"{len(panels)} of {len(statistics)} parameters, those to be looked at first; the table has all. "


# The tables of a fleet's report: every parameter, units that stand out, changes, failures.


_MOST_ROWS = 40  # of a table on the page; the rest is in the files beside


def number(value: float, digits: int = 4) -> str:
    """Return a number as text; a dash for an infinite or unknown one."""
    return plain_number(value, digits) if math.isfinite(value) else "–"


def summary_table(title: str, statistics: Sequence[ParameterStatistics]) -> ReportTable:
    """Return one line for each parameter: where it lies, how it spreads, what stands out, drifts, and is capable of."""
    rows = []
    for item in statistics:
        shown = reading_unit(item.unit, item.name)
        factor = abs(shown.factor)
        robust = item.robust_deviation * factor
        median = shown.of(item.median)
        stated = item.uncertainties[np.isfinite(item.uncertainties)]
        typical = float(np.median(stated)) * factor if stated.size else 0.0
        places = _places(robust or typical or abs(median))
        several = len(item.values) > 1
        drift = "–"
        if item.drift is not None:
            slope, error = format_uncertain(item.drift.per_day * factor, item.drift.standard_uncertainty * factor)
            drift = f"{slope} ± {error}" + (" !" if item.drift.significant else "")
        capable = "–"
        if item.capability is not None:
            capable = f"{item.capability.cpk:.2f} (≥ {item.capability.at_least:.2f})"
        rows.append(
            [
                item.name,
                shown.symbol,
                str(len(item.values)),
                "–" if item.limits is None else str(int(item.beyond.sum())),
                f"{median:.{places}f}",
                number(robust, 3) if several else "–",
                number(item.deviation * factor, 3) if several else "–",
                number(typical, 3) if stated.size else "–",
                str(int(item.outliers.sum())) if item.enough else "–",
                drift,
                capable,
            ]
        )
    titles = ["parameter", "unit", "units", "beyond limits", "median", "robust σ", "σ", "typical u", "stand out"]
    return ReportTable(
        f"{title}: every parameter",
        "Robust σ is 1.4826 times the median distance from the median; where σ is much larger, single units stand out. "
        "Where the typical standard uncertainty u is not well below σ, the spread is the calibration's, not the "
        "sensors'. Drift is a straight line over the date, ± one standard uncertainty, ! where chance would give it "
        "less than once in a thousand. Cpk = min(USL − mean, mean − LSL) / 3σ, with its one-sided 95 % bound.",
        [*titles, "drift per day", "Cpk"],
        rows,
    )


def _places(scale: float) -> int:
    """Return the decimals that show a hundredth of a scale."""
    if not scale > 0 or not math.isfinite(scale):
        return 3
    return min(max(0, 2 - math.floor(math.log10(scale))), 9)


def _limits_text(*ends: float) -> str:
    """Return limits as text, either of which may be infinite."""
    low, high = sorted(ends)
    if math.isinf(low):
        return f"at most {high:.6g}"
    return f"at least {low:.6g}" if math.isinf(high) else f"{low:.6g} to {high:.6g}"


def limits_table(statistics: Sequence[ParameterStatistics]) -> ReportTable | None:
    """Return the table of the units that are beyond their limits."""
    rows = []
    for item in statistics:
        shown = reading_unit(item.unit, item.name)
        limits = "" if item.limits is None else _limits_text(shown.of(item.limits.lower), shown.of(item.limits.upper))
        for i in np.flatnonzero(item.beyond).tolist():
            value, error = format_uncertain(
                float(shown.of(float(item.values[i]))), float(item.uncertainties[i]) * abs(shown.factor)
            )
            rows.append([item.serials[i], item.name, value, error, limits, shown.symbol])
    if not rows:
        return None
    more = f" The first {_MOST_ROWS} of {len(rows)}." if len(rows) > _MOST_ROWS else ""
    return ReportTable(
        "Units beyond their limits",
        "By their values alone; a certificate allows for the uncertainties." + more,
        ["serial", "parameter", "value", "u", "limits", "unit"],
        rows[:_MOST_ROWS],
    )


def outlier_table(statistics: Sequence[ParameterStatistics]) -> ReportTable | None:
    """Return the table of the units that stand out, the farthest first."""
    rows = []
    for item in statistics:
        shown = reading_unit(item.unit, item.name)
        for i in np.flatnonzero(item.outliers).tolist():
            value, error = format_uncertain(
                float(shown.of(float(item.values[i]))), float(item.uncertainties[i]) * abs(shown.factor)
            )
            rows.append(
                (abs(float(item.z[i])), [item.serials[i], item.name, value, error, shown.symbol, f"{item.z[i]:+.1f}"])
            )
    if not rows:
        return None
    rows.sort(key=lambda row: -row[0])
    more = f" The first {_MOST_ROWS} of {len(rows)}." if len(rows) > _MOST_ROWS else ""
    return ReportTable(
        "Units that stand out",
        "Robust z: distance from the median in robust standard deviations." + more,
        ["serial", "parameter", "value", "u", "unit", "robust z"],
        [row for _, row in rows[:_MOST_ROWS]],
    )


def change_table(changes: Sequence[FleetChange]) -> ReportTable | None:
    """Return the table of the largest changes since the last calibration."""
    if not changes:
        return None
    ranked = sorted(changes, key=lambda change: (change.same_files, -abs(change.deviations or 0.0)))
    limit = change_limit(sum(not change.same_files for change in changes))
    rows = []
    for change in ranked[:_MOST_ROWS]:
        shown = reading_unit(change.unit, change.name)
        factor = abs(shown.factor)
        u = None if change.standard_uncertainty is None else change.standard_uncertainty * factor
        difference, error = format_uncertain((change.new - change.old) * shown.factor, u)
        z = change.deviations
        remark = "same files, fitted again" if change.same_files else "changed" if z and abs(z) > limit else ""
        rows.append(
            [
                change.serial, change.name, difference, error, shown.of_difference,
                "–" if z is None else f"{z:+.1f}", change.before[:16].replace("T", " "), remark,
            ]
        )  # fmt: skip
    again = sum(change.same_files for change in changes)
    return ReportTable(
        "Largest changes since the last calibration",
        f"{len(changes)} parameters have an earlier value; the first {len(rows)} by their change in normal "
        "deviations, with the uncertainties of both calibrations."
        + (" Values of the same files fitted again share their noise: no uncertainty applies." if again else ""),
        ["serial", "parameter", "change", "u", "unit", "deviations", "last calibration", "remark"],
        rows,
    )


def verdict_table(state: FleetState) -> ReportTable | None:
    """Return the table of the verdicts of all units with a record, the gravest first."""
    good = [row for row in state.rows if row.verdict == "good"]
    rows = [*state.doubtful, *good]
    if not rows:
        return None
    more = f" The first {_MOST_ROWS} of {len(rows)}; parameters.csv has all." if len(rows) > _MOST_ROWS else ""
    return ReportTable(
        "The verdict of each unit",
        "Look: understand the reason before you use the record. Bad: do not use it as it is. "
        "imulab show SERIAL.json has all that a record says." + more,
        ["serial", "procedure", "verdict", "reason"],
        [[row.unit.serial, row.unit.procedure, row.verdict, row.first_reason or "–"] for row in rows[:_MOST_ROWS]],
        message=f"{len(good)} of {len(rows)} are good.",
    )


def failure_table(failures: Sequence[FleetRow]) -> ReportTable | None:
    """Return the table of the units that failed."""
    if not failures:
        return None
    more = f" The first {_MOST_ROWS} of {len(failures)}." if len(failures) > _MOST_ROWS else ""
    return ReportTable(
        "Units that failed",
        "They have no record; the next run tries them again." + more,
        ["serial", "file", "reason"],
        [[row.unit.serial, "; ".join(row.unit.files), row.reason] for row in failures[:_MOST_ROWS]],
    )


# Figures: parameters over units and dates, and changes since the last calibration.


MOST_PANELS = 24  # of a page; the parameters that change most have them
_MOST_POINTS = 1500  # of a panel; usual units beyond are thinned, others never


def shown_first(statistics: Sequence[ParameterStatistics]) -> list[ParameterStatistics]:
    """Return the parameters to draw: all, or of many those that need to be looked at, in the order of the records."""
    if len(statistics) <= MOST_PANELS:
        return list(statistics)

    def weight(item: ParameterStatistics) -> tuple[bool, float, float]:
        cpk = math.inf if item.capability is None else item.capability.cpk
        alarms = int(item.outliers.sum()) + (item.drift is not None and item.drift.significant)
        return not item.beyond.any(), cpk, -float(alarms)

    chosen = sorted(statistics, key=weight)[:MOST_PANELS]
    return [item for item in statistics if item in chosen]


def distributions(title: str, statistics: Sequence[ParameterStatistics]) -> list[Figure]:
    """Return the histograms of parameters, with median, units that stand out, and limits."""
    panels = shown_first(statistics)
    pages = grid.pages(panels)
    return [
        _distributions(grid.paged(f"{title}: distribution over the units", n, len(pages)), page,
                       which_are_drawn(statistics, panels))
        for n, page in enumerate(pages)
    ]  # fmt: skip


def _distributions(title: str, panels: Sequence[ParameterStatistics], lead: str) -> Figure:
    traces: list[dict[str, Any]] = []
    layout = grid.grid()
    beyond = 0
    for index, item in enumerate(panels):
        shown = reading_unit(item.unit, item.name)
        values = np.asarray(shown.of(item.values))
        x, y = grid.names(index)
        far = bulk(values)
        inside = np.ones(len(values), dtype=bool) if far is None else ~far.beyond
        edges = bin_edges(values[inside])
        counts, edges = np.histogram(values[inside], bins=edges)
        limits = limits_in_view(item, shown, values[inside])
        traces.append(
            {
                "type": "bar",
                "x": rounded((edges[1:] + edges[:-1]) / 2),
                "y": counts.tolist(),
                "width": float(edges[1] - edges[0]),
                "marker": {"color": GOOD},
                "xaxis": x,
                "yaxis": y,
                "hovertemplate": "%{x}: %{y} units<extra></extra>",
            }
        )
        out = item.outliers & inside
        if out.any():
            traces.append(_outlier_marks(item.serials, values, out, x, y))
        grid.panel(layout, index, len(panels), f"{item.name}, {shown.symbol}", "units")
        if far is not None:
            low, high = with_limits(far.low, far.high, limits)
            far = replace(far, low=low, high=high)
            labels = [f"{s} {number(float(v))}" for s, v in zip(item.serials, values, strict=True)]
            traces += edge_marks(
                far, values, staggered(far.beyond, int(counts.max())), labels, axes=(x, y), upright=False
            )
            layout[grid.axis_key(x)]["range"] = [far.low, far.high]
            layout[grid.axis_key(y)]["range"] = [0, 1.25 * int(counts.max())]
            beyond += int(far.beyond.sum())
        elif limits:
            layout[grid.axis_key(x)]["range"] = with_limits(float(edges[0]), float(edges[-1]), limits)
        below_labels = 1.0 if far is None else 0.8
        layout["shapes"] += [grid.line(x, y, float(shown.of(item.median)), "#22303a", "dot", below_labels)]
        layout["shapes"] += [grid.line(x, y, end, BAD, "solid") for end in limits]
        layout[grid.axis_key(y)]["rangemode"] = "tozero"
        if counts.max() <= _FEW_UNITS:
            layout[grid.axis_key(y)]["dtick"] = 1 if counts.max() <= _FEW_UNITS / 2 else 2
    return Figure(
        title,
        lead + "Bars count units. Dotted: median. Red lines: limits. Red diamonds: units whose "
        "robust z is so large that a healthy line of this size shows such a unit in one of a hundred cases."
        + edge_note(beyond),
        traces,
        layout,
        height=grid.height(len(panels)),
        message=_named_units(panels),
    )


def _named_units(panels: Sequence[ParameterStatistics]) -> str:
    """Return sentences that name the units beyond their limits, if any, and those that stand out."""
    units, parameters = beyond_limits(panels)
    broken = f"Beyond the limits of {first_of(parameters, 6)}: {first_of(units, 6)}. " if units else ""
    standing = sorted({s for item in panels for s, o in zip(item.serials, item.outliers, strict=True) if o})
    if standing:
        return f"{broken}{'Stands' if len(standing) == 1 else 'Stand'} out: {first_of(standing, 6)}."
    if any(item.enough for item in panels):
        return f"{broken}No unit stands out."
    return f"{broken}Fewer than {FEWEST_FOR_OUTLIERS} units: too few to tell which stands out."


def beyond_limits(statistics: Sequence[ParameterStatistics]) -> tuple[list[str], list[str]]:
    """Return the serials of the units beyond their limits, sorted, and the parameters."""
    units = {s for item in statistics for s, b in zip(item.serials, item.beyond, strict=True) if b}
    return sorted(units), [item.name for item in statistics if item.beyond.any()]


def _outlier_marks(serials: Sequence[str], values: Array, out: np.ndarray, x: str, y: str) -> dict[str, Any]:
    """Add marks of the units that stand out, at the foot of a histogram."""
    return scatter(
        rounded(values[out]), [0] * int(out.sum()), "markers", text=[s for s, o in zip(serials, out, strict=True) if o],
        marker={"color": BAD, "size": 9, "symbol": "diamond"}, cliponaxis=False, xaxis=x, yaxis=y,
        hovertemplate="%{text}: %{x}<extra></extra>",
    )  # fmt: skip


def over_date(title: str, statistics: Sequence[ParameterStatistics]) -> list[Figure]:
    """Return the figure of each parameter over the date, or over the unit's number if there is a single date."""
    panels = shown_first(statistics)
    dated = any(item.drift is not None for item in panels)
    name = f"{title}: over the {'date' if dated else 'units in the order of the manifest'}"
    pages = grid.pages(panels)
    return [
        _over_date(grid.paged(name, n, len(pages)), page, which_are_drawn(statistics, panels), dated=dated)
        for n, page in enumerate(pages)
    ]


def _over_date(title: str, panels: Sequence[ParameterStatistics], lead: str, *, dated: bool) -> Figure:
    traces: list[dict[str, Any]] = []
    layout = grid.grid()
    beyond = 0
    for index, item in enumerate(panels):
        shown = reading_unit(item.unit, item.name)
        values = np.asarray(shown.of(item.values))
        x, y = grid.names(index)
        out = item.outliers
        places = item.days if dated else np.arange(1.0, len(values) + 1)
        where = [date(day) for day in places] if dated else places.tolist()
        order = np.argsort(places, kind="stable")
        usual = order[~out[order]]
        usual = usual[:: max(1, math.ceil(len(usual) / _MOST_POINTS))]
        for chosen, colour, size, symbol in ((usual, GOOD, 4, "circle"), (np.flatnonzero(out), BAD, 8, "diamond")):
            if chosen.size:
                traces.append(
                    scatter([where[i] for i in chosen], rounded(values[chosen]), "markers", xaxis=x, yaxis=y,
                            marker={"color": colour, "size": size, "symbol": symbol},
                            text=[item.serials[i] for i in chosen], hovertemplate="%{text}: %{y}<extra></extra>")
                )  # fmt: skip
        if item.drift is not None:
            traces.append(_drift_line(item.drift, shown, x, y))
        grid.panel(layout, index, len(panels), f"{item.name}, {shown.symbol}")
        layout[grid.axis_key(x)] |= date_axis(places) if dated else {"nticks": 5}
        far = bulk(values)
        inside = values if far is None else values[~far.beyond]
        limits = limits_in_view(item, shown, inside, _SPANS_OVER_DATE)
        layout["shapes"] += [grid.line(x, y, end, BAD, "solid", upright=False) for end in limits]
        if far is not None:
            low, high = with_limits(far.low, far.high, limits)
            far = with_labels(replace(far, low=low, high=high), values, grid.PANEL)
            labels = [f"{s} {number(float(v))}" for s, v in zip(item.serials, values, strict=True)]
            traces += edge_marks(far, values, where, labels, axes=(x, y))
            layout[grid.axis_key(y)]["range"] = [far.low, far.high]
            beyond += int(far.beyond.sum())
        elif limits:
            room = 0.06 * float(np.ptp(values))
            ends = with_limits(float(values.min()) - room, float(values.max()) + room, limits)
            layout[grid.axis_key(y)]["range"] = ends
    drifting = [item.name for item in panels if item.drift is not None and item.drift.significant]
    return Figure(
        title,
        lead
        + (
            "Lines: drift, red and dashed where it is beyond chance (1 in 1000). The date is that of the recording "
            "where its head has a line date, otherwise that of the record."
            if dated
            else "The records are of one date: nothing can be said of drift."
        )
        + " Red diamonds stand out. Level red lines: limits that lie near."
        + edge_note(beyond),
        traces,
        layout,
        height=grid.height(len(panels)),
        message=(f"Beyond chance: {', '.join(drifting)}." if drifting else "No drift is beyond chance.")
        if dated
        else "",
    )


def _drift_line(drift: FleetDrift, shown: ReadingUnit, x: str, y: str) -> dict[str, Any]:
    """Add the fitted drift from the first date to the last."""
    ends = np.array([drift.value_at_start, drift.value_at_start + drift.per_day * drift.days])
    colour, dash = (BAD, "dash") if drift.significant else (QUIET, "solid")
    days = [date(drift.start), date(drift.start + drift.days)]
    line = {"color": colour, "width": 2, "dash": dash}
    return scatter(days, rounded(shown.of(ends)), "lines", line=line, xaxis=x, yaxis=y, hoverinfo="skip")


def change_figure(title: str, changes: Sequence[FleetChange]) -> Figure | None:
    """Return the figure of all changes since the last calibration in standard uncertainties, a column per parameter."""
    usable = [change for change in changes if change.deviations is not None and not change.same_files]
    if not usable:
        return None
    limit = change_limit(len(usable))
    names = list(dict.fromkeys(change.name for change in usable))[: 2 * MOST_PANELS]
    groups = [[change for change in usable if change.name == name] for name in names]
    traces: list[dict[str, Any]] = []
    every: list[tuple[float, float, str]] = []
    for beyond, colour in ((False, GOOD), (True, BAD)):
        x: list[float] = []
        y: list[float] = []
        text: list[str] = []
        for place, group in enumerate(groups):
            for i, change in enumerate(group):
                z = float(change.deviations or 0.0)
                if (abs(z) > limit) == beyond:
                    x.append(round(place + 0.6 * ((i * 0.618034) % 1.0 - 0.5), 3))
                    y.append(round(z, 3))
                    text.append(f"{change.serial}, {change.name}")
        size, symbol = (8, "diamond") if beyond else (5, "circle")
        marker = {"color": colour, "size": size, "symbol": symbol, "opacity": 0.8}
        traces.append(scatter(x, y, "markers", text=text, marker=marker, hovertemplate="%{text}: %{y}<extra></extra>"))
        every += zip(x, y, text, strict=True)
    deviations = np.array([z for _, z, _ in every])
    far = bulk(deviations)
    scale: dict[str, Any] = {}
    if far is not None:
        far = replace(far, low=min(far.low, -1.3 * limit), high=max(far.high, 1.3 * limit))
        far = with_labels(replace(far, beyond=(deviations < far.low) | (deviations > far.high)), deviations, grid.PLOT)
        traces += edge_marks(far, deviations, [x for x, *_ in every], [f"{what}: {z:+.3g}" for _, z, what in every])
        scale = {"range": [far.low, far.high]}
    many = int(np.count_nonzero(np.abs(deviations) > limit))
    return Figure(
        f"{title}: change since each unit's last calibration",
        "(new − last) / √(u² + u²), as normal deviations (few degrees of freedom are allowed for). Of sensors that did "
        "not change, one such figure in a hundred has a point outside the band. A column that is off zero as a whole "
        "means a rig or a type that changed; one that is wider than the others, uncertainties stated too small. Red "
        "diamonds lie outside the band." + edge_note(0 if far is None else int(far.beyond.sum())),
        traces,
        _change_layout(names, limit, scale),
        height=430,
        message=f"{many} of {len(every)} changes {'is' if many == 1 else 'are'} outside the band of ±{limit:.2g}.",
    )


def _change_layout(names: Sequence[str], limit: float, scale: dict[str, Any]) -> dict[str, Any]:
    """Return the layout of a column for each parameter, over the band that chance explains."""
    return {
        "xaxis": {
            "tickvals": list(range(len(names))),
            "ticktext": names,
            "tickangle": -35,
            "range": [-0.6, len(names) - 0.4],
            "zeroline": False,
            "showgrid": False,
        },
        "yaxis": {
            "title": {"text": "change, normal deviations"},
            "gridcolor": "#e6eaed",
            "zerolinecolor": QUIET,
            **scale,
        },
        "shapes": [
            {
                "type": "rect",
                "xref": "paper",
                "x0": 0,
                "x1": 1,
                "y0": -limit,
                "y1": limit,
                "fillcolor": "#e6f1f4",
                "line": {"width": 0},
                "layer": "below",
            }
        ],
        "showlegend": False,
        "margin": {"l": 70, "r": 20, "t": 20, "b": 110},
    }
