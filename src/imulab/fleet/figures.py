"""What the report of a fleet shows: its parameters over units and dates, and what changed since last time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imulab.errors import first_of
from imulab.fleet import panels as small
from imulab.fleet.display import Display, display_of
from imulab.fleet.reporttables import number
from imulab.fleet.statistics import FEWEST_FOR_OUTLIERS, Drift, FleetChange, ParameterStatistics, change_limit
from imulab.recording import Array
from imulab.report import panels as grid
from imulab.report.bulk import bulk, edge_marks, edge_note
from imulab.report.elements import BAD, GOOD, QUIET, Figure
from imulab.report.traces import rounded, scatter

MOST_PANELS = 24
_MOST_POINTS = 1500


def shown_first(statistics: Sequence[ParameterStatistics]) -> list[ParameterStatistics]:
    """Return the parameters to draw: all, or of many those that need to be looked at, in the order of the records."""
    if len(statistics) <= MOST_PANELS:
        return list(statistics)

    def weight(item: ParameterStatistics) -> tuple[float, float]:
        cpk = math.inf if item.capability is None else item.capability.cpk
        found = int(item.outliers.sum()) + (item.drift is not None and item.drift.significant)
        return cpk, -float(found)

    chosen = sorted(statistics, key=weight)[:MOST_PANELS]
    return [item for item in statistics if item in chosen]


def distributions(title: str, statistics: Sequence[ParameterStatistics]) -> list[Figure]:
    """Draw a histogram of each parameter, with median, units that stand out, and limits."""
    panels = shown_first(statistics)
    pages = grid.pages(panels)
    return [
        _distributions(grid.paged(f"{title}: distribution over the units", n, len(pages)), page,
                       small.which_are_drawn(statistics, panels))
        for n, page in enumerate(pages)
    ]  # fmt: skip


def _distributions(title: str, panels: Sequence[ParameterStatistics], lead: str) -> Figure:
    traces: list[dict[str, Any]] = []
    layout = grid.grid()
    beyond = 0
    for index, item in enumerate(panels):
        shown = display_of(item.unit)
        values = np.asarray(shown.of(item.values))
        x, y = grid.names(index)
        far = bulk(values)
        inside = np.ones(len(values), dtype=bool) if far is None else ~far.beyond
        edges = small.bin_edges(values[inside])
        counts, edges = np.histogram(values[inside], bins=edges)
        limits = small.limits_in_view(item, shown, values[inside])
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
        grid.panel(layout, index, len(panels), f"{item.name}, {shown.unit}", "units")
        if far is not None:
            far = replace(far, low=min(far.low, *limits, far.high), high=max(far.high, *limits, far.low))
            labels = [f"{s} {number(float(v))}" for s, v in zip(item.serials, values, strict=True)]
            traces += edge_marks(
                far, values, small.staggered(far.beyond, int(counts.max())), labels, axes=(x, y), upright=False
            )
            layout[grid.axis_key(x)]["range"] = [far.low, far.high]
            layout[grid.axis_key(y)]["range"] = [0, 1.25 * int(counts.max())]
            beyond += int(far.beyond.sum())
        below_labels = 1.0 if far is None else 0.8
        layout["shapes"] += [grid.line(x, y, float(shown.of(item.median)), "#22303a", "dot", below_labels)]
        layout["shapes"] += [grid.line(x, y, end, BAD, "solid") for end in limits]
        layout[grid.axis_key(y)]["rangemode"] = "tozero"
    standing = sorted({s for item in panels for s, o in zip(item.serials, item.outliers, strict=True) if o})
    return Figure(
        title,
        lead + "Bars count units. Dotted: median. Red lines: limits that lie near. Red diamonds: units whose "
        "robust z is so large that a healthy line of this size shows such a unit in one of a hundred cases."
        + edge_note(beyond),
        traces,
        layout,
        height=grid.height(len(panels)),
        message=f"{'Stands' if len(standing) == 1 else 'Stand'} out: {first_of(standing, 6)}."
        if standing
        else "No unit stands out."
        if any(item.enough for item in panels)
        else f"Fewer than {FEWEST_FOR_OUTLIERS} units: too few to tell which stands out.",
    )


def _outlier_marks(serials: Sequence[str], values: Array, out: np.ndarray, x: str, y: str) -> dict[str, Any]:
    """Mark the units that stand out, at the foot of a histogram."""
    return scatter(
        rounded(values[out]), [0] * int(out.sum()), "markers", text=[s for s, o in zip(serials, out, strict=True) if o],
        marker={"color": BAD, "size": 9, "symbol": "diamond"}, cliponaxis=False, xaxis=x, yaxis=y,
        hovertemplate="%{text}: %{x}<extra></extra>",
    )  # fmt: skip


def over_date(title: str, statistics: Sequence[ParameterStatistics]) -> list[Figure]:
    """Draw each parameter over the date, or over the number of the unit where there is but one date."""
    panels = shown_first(statistics)
    dated = any(item.drift is not None for item in panels)
    name = f"{title}: over the {'date' if dated else 'units in the order of the manifest'}"
    pages = grid.pages(panels)
    return [
        _over_date(grid.paged(name, n, len(pages)), page, small.which_are_drawn(statistics, panels), dated=dated)
        for n, page in enumerate(pages)
    ]


def _over_date(title: str, panels: Sequence[ParameterStatistics], lead: str, *, dated: bool) -> Figure:
    traces: list[dict[str, Any]] = []
    layout = grid.grid()
    beyond = 0
    for index, item in enumerate(panels):
        shown = display_of(item.unit)
        values = np.asarray(shown.of(item.values))
        x, y = grid.names(index)
        out = item.outliers
        places = item.days if dated else np.arange(1.0, len(values) + 1)
        where = [small.date(day) for day in places] if dated else places.tolist()
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
        grid.panel(layout, index, len(panels), f"{item.name}, {shown.unit}")
        layout[grid.axis_key(x)] |= small.date_axis(places) if dated else {"nticks": 5}
        far = bulk(values)
        if far is not None:
            labels = [f"{s} {number(float(v))}" for s, v in zip(item.serials, values, strict=True)]
            traces += edge_marks(far, values, where, labels, axes=(x, y))
            layout[grid.axis_key(y)]["range"] = [far.low, far.high]
            beyond += int(far.beyond.sum())
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
        + " Red diamonds stand out."
        + edge_note(beyond),
        traces,
        layout,
        height=grid.height(len(panels)),
        message=(f"Beyond chance: {', '.join(drifting)}." if drifting else "No drift is beyond chance.")
        if dated
        else "",
    )


def _drift_line(drift: Drift, shown: Display, x: str, y: str) -> dict[str, Any]:
    """Draw the fitted drift from the first date to the last."""
    ends = np.array([drift.value_at_start, drift.value_at_start + drift.per_day * drift.days])
    colour, dash = (BAD, "dash") if drift.significant else (QUIET, "solid")
    days = [small.date(drift.start), small.date(drift.start + drift.days)]
    line = {"color": colour, "width": 2, "dash": dash}
    return scatter(days, rounded(shown.of(ends)), "lines", line=line, xaxis=x, yaxis=y, hoverinfo="skip")


def change_figure(title: str, changes: Sequence[FleetChange]) -> Figure | None:
    """Draw every change since the last calibration in its standard uncertainties, a column for each parameter."""
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
        far = replace(far, beyond=(deviations < far.low) | (deviations > far.high))
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
    """Lay out a column for each parameter, over the band of what chance explains."""
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
