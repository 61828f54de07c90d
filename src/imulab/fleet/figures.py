"""What the report of a fleet shows: its parameters over units and dates, and what changed since last time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from imulab.exhibit import BAD, GOOD, QUIET, Figure, Table, format_uncertain, plain_number
from imulab.fleet import panels as small
from imulab.fleet.display import display_of
from imulab.fleet.statistics import Change, ParameterStatistics, change_limit
from imulab.fleet.table import Row

MOST_PANELS = 24
_MOST_POINTS = 1500
_MOST_ROWS = 40


def number(value: float, digits: int = 4) -> str:
    """Return a number as text, an infinite or unknown one as a dash."""
    return plain_number(value, digits) if math.isfinite(value) else "–"


def summary_table(title: str, statistics: Sequence[ParameterStatistics]) -> Table:
    """Return one line for each parameter: where it lies, how it spreads, what stands out, drifts, and is capable of."""
    rows = []
    for item in statistics:
        shown = display_of(item.unit)
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
        capable, beyond = "–", "–"
        if item.capability is not None:
            capable = f"{item.capability.cpk:.2f} (≥ {item.capability.at_least:.2f})"
            beyond = str(len(item.capability.beyond))
        rows.append(
            [
                item.name,
                shown.unit,
                str(len(item.values)),
                f"{median:.{places}f}",
                number(robust, 3) if several else "–",
                number(item.deviation * factor, 3) if several else "–",
                number(typical, 3) if stated.size else "–",
                str(int(item.outliers.sum())),
                drift,
                capable,
                beyond,
            ]
        )
    titles = ["parameter", "unit", "units", "median", "robust σ", "σ", "typical u", "stand out", "drift per day"]
    return Table(
        f"{title}: every parameter",
        "Robust σ is 1.4826 times the median distance from the median; where σ is much larger, single units stand out. "
        "Where the typical standard uncertainty u is not well below σ, the spread is the calibration's, not the "
        "sensors'. Drift is a straight line over the date, ± one standard uncertainty, ! where chance would give it "
        "less than once in a thousand. Cpk = min(USL − mean, mean − LSL) / 3σ, with its one-sided 95 % bound.",
        [*titles, "Cpk", "beyond"],
        rows,
    )


def _places(scale: float) -> int:
    """Decimals that show a hundredth of a scale."""
    if not scale > 0 or not math.isfinite(scale):
        return 3
    return min(max(0, 2 - math.floor(math.log10(scale))), 9)


def shown_first(statistics: Sequence[ParameterStatistics]) -> list[ParameterStatistics]:
    """Return the parameters to draw: all, or of many those that need to be looked at, in the order of the records."""
    if len(statistics) <= MOST_PANELS:
        return list(statistics)

    def weight(item: ParameterStatistics) -> tuple[float, float]:
        cpk = math.inf if item.capability is None else item.capability.cpk
        strange = int(item.outliers.sum()) + (item.drift is not None and item.drift.significant)
        return cpk, -float(strange)

    chosen = sorted(statistics, key=weight)[:MOST_PANELS]
    return [item for item in statistics if item in chosen]


def distributions(title: str, statistics: Sequence[ParameterStatistics]) -> Figure:
    """Draw a histogram of each parameter, with median, units that stand out, and limits."""
    panels = shown_first(statistics)
    traces: list[dict[str, Any]] = []
    layout = small.grid()
    for index, item in enumerate(panels):
        shown = display_of(item.unit)
        values = np.asarray(shown.of(item.values))
        x, y = small.names(index)
        edges = small.edges(values, item)
        counts, edges = np.histogram(values, bins=edges)
        traces.append(
            {
                "type": "bar",
                "x": small.plain((edges[1:] + edges[:-1]) / 2),
                "y": counts.tolist(),
                "width": float(edges[1] - edges[0]),
                "marker": {"color": GOOD},
                "xaxis": x,
                "yaxis": y,
                "hovertemplate": "%{x}: %{y} units<extra></extra>",
            }
        )
        out = item.outliers
        if out.any():
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "x": small.plain(values[out]),
                    "y": [0] * int(out.sum()),
                    "text": [s for s, o in zip(item.serials, out, strict=True) if o],
                    "marker": {"color": BAD, "size": 9, "symbol": "diamond"},
                    "cliponaxis": False,
                    "xaxis": x,
                    "yaxis": y,
                    "hovertemplate": "%{text}: %{x}<extra></extra>",
                }
            )
        small.panel(layout, index, len(panels), f"{item.name}, {shown.unit}")
        layout["shapes"] += [small.line(x, y, float(shown.of(item.median)), "#22303a", "dot")]
        layout["shapes"] += [small.line(x, y, end, BAD, "solid") for end in small.ends(item, shown)]
        layout[small.axis_key(y)]["rangemode"] = "tozero"
    return Figure(
        f"{title}: distribution over the units",
        small.some(statistics, panels)
        + "Bars count units. Dotted: median. Red lines: limits, where they are within sight. Red diamonds: units whose "
        "robust z is beyond what one normal population of this size in a hundred would show.",
        traces,
        layout,
        height=small.height(len(panels)),
    )


def over_date(title: str, statistics: Sequence[ParameterStatistics]) -> Figure:
    """Draw each parameter over the date, or over the number of the unit where there is but one date."""
    panels = shown_first(statistics)
    traces: list[dict[str, Any]] = []
    layout = small.grid()
    dated = any(item.drift is not None for item in panels)
    for index, item in enumerate(panels):
        shown = display_of(item.unit)
        values = np.asarray(shown.of(item.values))
        x, y = small.names(index)
        out = item.outliers
        places = item.days if dated else np.arange(1.0, len(values) + 1)
        order = np.argsort(places, kind="stable")
        usual = order[~out[order]]
        usual = usual[:: max(1, math.ceil(len(usual) / _MOST_POINTS))]
        for chosen, colour, size in ((usual, GOOD, 4), (np.flatnonzero(out), BAD, 8)):
            if chosen.size:
                traces.append(
                    {
                        "type": "scatter",
                        "mode": "markers",
                        "x": [small.date(day) for day in places[chosen]] if dated else places[chosen].tolist(),
                        "y": small.plain(values[chosen]),
                        "text": [item.serials[i] for i in chosen],
                        "marker": {"color": colour, "size": size},
                        "xaxis": x,
                        "yaxis": y,
                        "hovertemplate": "%{text}: %{y}<extra></extra>",
                    }
                )
        if item.drift is not None:
            ends = np.array(
                [item.drift.value_at_start, item.drift.value_at_start + item.drift.per_day * item.drift.days]
            )
            traces.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "x": [small.date(item.drift.start), small.date(item.drift.start + item.drift.days)],
                    "y": small.plain(np.asarray(shown.of(ends))),
                    "line": {"color": BAD if item.drift.significant else QUIET, "width": 2},
                    "xaxis": x,
                    "yaxis": y,
                    "hoverinfo": "skip",
                }
            )
        small.panel(layout, index, len(panels), f"{item.name}, {shown.unit}")
        layout[small.axis_key(x)] |= small.date_axis(places) if dated else {"nticks": 5}
    return Figure(
        f"{title}: over the {'date' if dated else 'units in the order of the manifest'}",
        small.some(statistics, panels)
        + (
            "Lines: drift, red where it is beyond chance (1 in 1000). The date is that of the recording where its head "
            "has a line date, otherwise that of the record."
            if dated
            else "The records are of one date: nothing can be said of drift."
        )
        + " Red points stand out.",
        traces,
        layout,
        height=small.height(len(panels)),
    )


def outlier_table(statistics: Sequence[ParameterStatistics]) -> Table | None:
    """List the units that stand out, furthest first."""
    rows = []
    for item in statistics:
        shown = display_of(item.unit)
        for i in np.flatnonzero(item.outliers).tolist():
            value, error = format_uncertain(
                float(shown.of(float(item.values[i]))), float(item.uncertainties[i]) * abs(shown.factor)
            )
            rows.append(
                (abs(float(item.z[i])), [item.serials[i], item.name, value, error, shown.unit, f"{item.z[i]:+.1f}"])
            )
    if not rows:
        return None
    rows.sort(key=lambda row: -row[0])
    more = f" The first {_MOST_ROWS} of {len(rows)}." if len(rows) > _MOST_ROWS else ""
    return Table(
        "Units that stand out",
        "Robust z: distance from the median in robust standard deviations." + more,
        ["serial", "parameter", "value", "u", "unit", "robust z"],
        [row for _, row in rows[:_MOST_ROWS]],
    )


def change_figure(title: str, changes: Sequence[Change]) -> Figure | None:
    """Draw every change since the last calibration in its standard uncertainties, a column for each parameter."""
    usable = [change for change in changes if change.deviations is not None and not change.same_files]
    if not usable:
        return None
    limit = change_limit(len(usable))
    names = list(dict.fromkeys(change.name for change in usable))[: 2 * MOST_PANELS]
    groups = [[change for change in usable if change.name == name] for name in names]
    traces = []
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
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": x,
                "y": y,
                "text": text,
                "marker": {"color": colour, "size": 5 if not beyond else 8, "opacity": 0.8},
                "hovertemplate": "%{text}: %{y}<extra></extra>",
            }
        )
    return Figure(
        f"{title}: change since each unit's last calibration",
        "(new − last) / √(u² + u²), as normal deviations (few degrees of freedom are allowed for). Of sensors that did "
        "not change, one such figure in a hundred has a point outside the band. A column that is off zero as a whole "
        "means a rig or a type that changed; one that is wider than the others, uncertainties stated too small.",
        traces,
        {
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
        },
        height=430,
    )


def change_table(changes: Sequence[Change]) -> Table | None:
    """List the largest changes since the last calibration."""
    if not changes:
        return None
    ranked = sorted(changes, key=lambda change: (change.same_files, -abs(change.deviations or 0.0)))
    limit = change_limit(sum(not change.same_files for change in changes))
    rows = []
    for change in ranked[:_MOST_ROWS]:
        shown = display_of(change.unit)
        factor = abs(shown.factor)
        u = None if change.standard_uncertainty is None else change.standard_uncertainty * factor
        difference, error = format_uncertain((change.new - change.old) * shown.factor, u)
        z = change.deviations
        remark = "same files, fitted again" if change.same_files else "changed" if z and abs(z) > limit else ""
        rows.append(
            [
                change.serial, change.name, difference, error, shown.unit,
                "–" if z is None else f"{z:+.1f}", change.before[:16].replace("T", " "), remark,
            ]
        )  # fmt: skip
    again = sum(change.same_files for change in changes)
    return Table(
        "Largest changes since the last calibration",
        f"{len(changes)} parameters have an earlier value; the first {len(rows)} by their change in normal "
        "deviations, with the uncertainties of both calibrations."
        + (" Values of the same files fitted again share their noise: no uncertainty applies." if again else ""),
        ["serial", "parameter", "change", "u", "unit", "deviations", "last calibration", "remark"],
        rows,
    )


def failure_table(failures: Sequence[Row]) -> Table | None:
    """List the units that failed."""
    if not failures:
        return None
    more = f" The first {_MOST_ROWS} of {len(failures)}." if len(failures) > _MOST_ROWS else ""
    return Table(
        "Units that failed",
        "They have no record; the next run tries them again." + more,
        ["serial", "file", "reason"],
        [[row.unit.serial, "; ".join(row.unit.files), row.reason] for row in failures[:_MOST_ROWS]],
    )
