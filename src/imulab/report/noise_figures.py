"""The figures of a recording: its channels over time, and the noise of a recording at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from imulab._version import VERSION
from imulab.columns import kind_of
from imulab.display import Note, verdict_of
from imulab.estimation.distributions import chi_square_upper_quantile
from imulab.recording import Array, Recording
from imulab.report import render_page
from imulab.report import traces as panels
from imulab.report.parameters import reading_unit, sample_unit, small_unit
from imulab.report.traces import (
    BAD,
    DASHES,
    GOOD,
    INK,
    LEGEND,
    MARGIN,
    QUIET,
    SYMBOLS,
    TIME,
    Exhibits,
    Figure,
    ReportTable,
    band,
    bulk,
    edge_marks,
    edge_note,
    figure_axis,
    format_uncertain,
    log_axis,
    plain_number,
    rounded,
    scatter,
)

# The channels of a recording over time: a figure for each sensor, thinned to the pixels of a screen.


_POINTS = 2000
"""Columns of pixels to which a curve is thinned; the smallest and the largest sample of each stay."""
_CHANNEL_COLOURS = (GOOD, BAD, "#7a5c99", "#6f7f3f", "#2c4fa3", "#a8322f", "#2e4057", QUIET)
_DASHES = ("solid", "dot", "dash", "dashdot")


def channel_figures(recording: Recording) -> list[Figure]:
    """Return a figure for each sensor of a recording: its columns over time, or over their rows."""
    figures: list[Figure] = []
    for clock, stamped in recording.clocks.items():
        groups: dict[tuple[str, str], list[str]] = {}
        for name in stamped:
            stem = name.partition("_")[0] if not name.startswith(("truth_", "std_")) else "_".join(name.split("_")[:2])
            groups.setdefault((stem, recording.units[name]), []).append(name)
        part = recording.stream(clock)
        time = part.time
        place = np.arange(1.0, len(part) + 1) if time is None else time
        figures += [_channel_figure(part, names, stem, unit, place) for (stem, unit), names in groups.items()]
    return figures


def thinned(place: Array, values: Array, points: int = _POINTS) -> tuple[Array, Array]:
    """Return a curve of equal look on so many columns of pixels: the smallest and largest sample of each.

    Samples that are not finite become gaps.
    """
    size = -(-len(values) // points)
    if size < 3:
        return place, values
    starts = np.arange(0, len(values), size)
    known = np.isfinite(values)
    low = np.minimum.reduceat(np.where(known, values, np.inf), starts)
    high = np.maximum.reduceat(np.where(known, values, -np.inf), starts)
    middle = place[np.minimum(starts + size // 2, len(place) - 1)]
    empty = low > high
    ends = np.column_stack([np.where(empty, np.nan, low), np.where(empty, np.nan, high)])
    return np.repeat(middle, 2), ends.ravel()


def _channel_figure(recording: Recording, names: list[str], stem: str, unit: str, place: Array) -> Figure:
    """Return the columns of one sensor over time or rows."""
    over = TIME if "time" in recording else "row"
    thin = len(recording) > 2 * _POINTS
    traces = [_trace(*thinned(place, recording.columns[name]), name, number) for number, name in enumerate(names)]
    return Figure(
        title=f"{stem} over {over.partition(',')[0]}",
        caption="Drawn are the smallest and the largest sample of each short piece." if thin else "",
        traces=traces,
        layout={
            "xaxis": figure_axis(over),
            "yaxis": figure_axis(f"{stem}, {unit}"),
            "legend": LEGEND,
            "showlegend": len(names) > 1,
        },
    )


def _trace(place: Array, values: Array, name: str, number: int) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines" if len(place) > 1 else "markers",
        "name": name,
        "x": [float(x) if np.isfinite(x) else None for x in place],
        "y": [float(y) if np.isfinite(y) else None for y in values],
        "line": {
            "color": _CHANNEL_COLOURS[number % len(_CHANNEL_COLOURS)],
            "width": 1,
            "dash": _DASHES[number // len(_CHANNEL_COLOURS) % 4],
        },
    }


# The report of the noise of a recording at rest: coefficients, Allan curves with their intervals, and the samples.


_BLOCKS = 400  # means of the samples in the drawing over time
_DIGITS = 5  # of the numbers in a drawing
_COLOURS = (GOOD, BAD, "#8e6bbd", "#c99a2e", "#4f9d69", INK)
_MOST_LINES = len(_COLOURS)
_MOST_NAMED = 6  # columns whose numbers the headline states
_AS_NOISE = {"bias_instability": "column_flicker", "quantisation": "column_quantisation"}
"""Coefficients that are read in the units of these parameters of a noise record, and not by their SI units."""


def noise_page(analysis: dict[str, Any], recording: Recording) -> str:
    """Return the report of an analysis by `imulab.estimation.column_noise.analyse`, and of its recording, as HTML."""
    verdict = verdict_of(analysis["warnings"])
    return render_page(
        "Noise at rest",
        analysis["sensor"].get("serial", analysis["file"]),
        exhibits_of_noise(analysis, recording),
        verdict=verdict,
        notes=[note for note in analysis["warnings"] if isinstance(note, Note)],
        provenance=[
            ("file", analysis["file"]),
            ("samples", f"{analysis['samples']} at {analysis['sample_rate']['value']:.6g} Hz"),
            ("averaging times", analysis["taus"]),
            *((f"sensor {key}", value) for key, value in analysis["sensor"].items()),
            ("software", f"imulab {VERSION}"),
        ],
    )


def exhibits_of_noise(analysis: dict[str, Any], recording: Recording) -> Exhibits:
    """Return headline, facts, tables and figures of the report."""
    length = analysis["samples"] / analysis["sample_rate"]["value"]
    kinds: dict[str, list[str]] = {}
    for name, column in analysis["columns"].items():
        kinds.setdefault(column["unit"], []).append(name)
    rows = coefficient_rows(analysis)
    white = [row for row in rows if row[1] in ("angle random walk", "velocity random walk", "white noise")]
    known = [f"{row[0]} {row[2]} ± {row[3]} {row[4]}" for row in white if row[2] != "not determined"]
    more = f" and {len(known) - _MOST_NAMED} more columns in the table" if len(known) > _MOST_NAMED else ""
    lost = f"; not determined for {len(white) - len(known)} of {len(white)} columns" if len(known) < len(white) else ""
    items: list[Figure | ReportTable] = [coefficients_table(rows)]
    for names in kinds.values():
        items += [
            allan_figure(analysis["columns"], names[k : k + _MOST_LINES]) for k in range(0, len(names), _MOST_LINES)
        ]
    items += [_samples_figure(analysis, recording, page) for page in panels.pages(list(analysis["columns"]))]
    return Exhibits(
        headline=f"At rest for {length:.4g} s; white noise, as angle or velocity random walk: "
        + (f"{'; '.join(known[:_MOST_NAMED])}{more}{lost}." if known else "not determined."),
        facts=[
            ("length", f"{length:.4g} s"),
            ("sampling rate", rates_of({name: _rate(analysis, name) for name in analysis["columns"]})),
            ("columns", str(len(analysis["columns"]))),
        ],
        items=items,
    )


def interval(column: dict[str, Any]) -> tuple[Array, Array]:
    """Return the 95 % interval of a column's Allan deviation, by chi-square with its degrees of freedom."""
    deviation, u = np.array(column["deviation"]), np.array(column["standard_uncertainty"])
    known = u > 0
    freedom = np.where(known, (deviation / np.where(known, u, 1.0)) ** 2 / 2, 1.0)
    limits = (chi_square_upper_quantile(tail, freedom) for tail in (0.025, 0.975))
    low, high = (deviation * np.where(known, np.sqrt(freedom / limit), 1.0) for limit in limits)
    return low, high


def allan_figure(columns: Mapping[str, Any], names: Sequence[str]) -> Figure:
    """Return the Allan curves of columns of one unit, by `imulab.estimation.column_noise.analyse`."""
    unit, factor = small_unit(columns[names[0]]["unit"]).scale
    traces: list[dict[str, Any]] = []
    fitted: list[dict[str, Any]] = []
    lowest: list[tuple[float, float, str]] = []
    for k, name in enumerate(names):
        column = columns[name]
        shown = np.array(column["deviation"]) > 0
        if not shown.any():
            continue
        low, high = (factor * end[shown] for end in interval(column))
        tau, deviation = np.array(column["tau"])[shown], factor * np.array(column["deviation"])[shown]
        at = int(np.argmin(deviation))
        lowest.append((float(deviation[at]), float(tau[at]), name))
        traces += [
            band(tau, low, high, _COLOURS[k], _DIGITS, showlegend=False),
            scatter(rounded(tau, _DIGITS), rounded(deviation, _DIGITS), "lines+markers", name=name,
                    line={"color": _COLOURS[k], "dash": DASHES[k]}, marker={"symbol": SYMBOLS[k], "size": 6},
                    hovertemplate=f"{name}<br>%{{x:.3g}} s: %{{y:.3g}} {unit}<extra></extra>"),
        ]  # fmt: skip
        fitted += _model_curve(column, factor, name, _COLOURS[k])
    message = "All samples are the same."
    if lowest:
        level, at_time, which = min(lowest)
        message = f"The lowest point is {plain_number(level, 3)} {unit} at {plain_number(at_time, 2)} s ({which})."
    return Figure(
        title=f"Allan deviation, {', '.join(names)}",
        message=message,
        caption="Deviation between neighbouring means over the averaging time. Shaded: 95 % interval, "
        "wide on the right where there are few averages. "
        + ("Dotted: the model that the coefficients are of. " if fitted else "")
        + "Slope −1/2: white noise. Flat: bias instability. Slope +1/2: a random walk of the zero.",
        traces=traces + fitted,
        layout={
            "xaxis": log_axis("averaging time, s"),
            "yaxis": log_axis(f"Allan deviation, {unit}", automargin=True),
            "legend": LEGEND,
            "margin": MARGIN,
            "showlegend": len(names) > 1,
        },
        height=430,
    )


def _model_curve(column: dict[str, Any], factor: float, name: str, colour: str) -> list[dict[str, Any]]:
    """Return the Allan deviation of the model as a dotted curve; no trace without a model."""
    known = [(t, d) for t, d in zip(column["tau"], column.get("fitted") or [], strict=False) if d is not None]
    if not known:
        return []
    tau, deviation = np.array(known).T
    line = {"line": {"color": colour, "width": 1, "dash": "dot"}, "hoverinfo": "skip", "showlegend": False}
    return [
        scatter(rounded(tau, _DIGITS), rounded(factor * deviation, _DIGITS), "lines", name=f"{name}, fitted", **line)
    ]


def _rate(analysis: dict[str, Any], name: str) -> float:
    return float(analysis["columns"][name].get("sample_rate", analysis["sample_rate"])["value"])


def rates_of(rates: Mapping[str, float]) -> str:
    """Return the sampling rates of columns for a fact of a report: one, or one for each clock with its sensors."""
    by_rate: dict[str, dict[str, None]] = {}
    for name, rate in rates.items():
        by_rate.setdefault(f"{rate:.6g} Hz", {})[kind_of(name) or name] = None
    return next(iter(by_rate)) if len(by_rate) == 1 else ", ".join(f"{' '.join(n)} {r}" for r, n in by_rate.items())


def _samples_figure(analysis: dict[str, Any], recording: Recording, names: Sequence[str]) -> Figure:
    """Return range and mean of the samples in equal blocks, so that spikes show in recordings of any length."""
    layout = panels.grid()
    traces: list[dict[str, Any]] = []
    beyond = 0
    for index, name in enumerate(names):
        unit, factor = sample_unit(analysis["columns"][name]["unit"]).scale
        values = recording.si(name)
        values = factor * (values[np.isfinite(values)] - analysis["columns"][name]["mean"])
        rate = _rate(analysis, name)
        size = max(1, len(values) // _BLOCKS)
        blocks = values[: len(values) // size * size].reshape(-1, size)
        time = np.asarray((np.arange(len(blocks)) + 0.5) * size / rate, dtype=np.float64)
        low, mean, high = blocks.min(axis=1), blocks.mean(axis=1), blocks.max(axis=1)
        x, y = panels.names(index)
        line = {"line": {"color": GOOD, "width": 1}, "hoverinfo": "skip", "xaxis": x, "yaxis": y}
        traces += [
            band(time, low, high, GOOD, _DIGITS, xaxis=x, yaxis=y),
            scatter(rounded(time, _DIGITS), rounded(mean, _DIGITS), "lines", **line),
        ]
        panels.panel(layout, index, len(names), f"{name}, {unit}")
        layout[panels.axis_key(x)]["title"] = {"text": "time, s", "font": {"size": 11}, "standoff": 4}
        ends = np.concatenate([low, high])
        far = bulk(ends, pixels=panels.PANEL)
        if far is not None:
            labels = [f"{value:.3g}" for value in ends.tolist()]
            traces += edge_marks(far, ends, [*time.tolist(), *time.tolist()], labels, axes=(x, y))
            layout[panels.axis_key(y)]["range"] = [far.low, far.high]
            beyond += int(far.beyond.sum())
    return Figure(
        title=f"The samples less their mean, {', '.join(names)}",
        message="Some samples lie far off the rest: was the unit touched, or are readings false?"
        if beyond
        else "No sample lies far off the rest.",
        caption="In equal blocks of time: shaded from the smallest to the largest sample, line: the mean. A unit at "
        "rest shows a level band; a step or a bump is a disturbance, which the coefficients suffer from."
        + edge_note(beyond),
        traces=traces,
        layout=layout,
        height=panels.height(len(names)),
    )


def coefficients_table(rows: list[list[str]]) -> ReportTable:
    """Return the table of rows of coefficients."""
    return ReportTable(
        "Noise coefficients",
        "Value and standard uncertainty u, of the model that fits the spectrum best; <: not seen, and with 95 % below "
        "this. Angle (velocity) random walk: the white noise of the rate (specific force). Bias instability: the level "
        "of 1/f noise, below which no averaging helps. Rate (acceleration) random walk: how the zero wanders.",
        ["column", "coefficient", "value", "u", "unit"],
        rows,
    )


def coefficient_rows(analysis: dict[str, Any]) -> list[list[str]]:
    """Return column, coefficient, value, uncertainty and unit of all coefficients of an analysis."""
    rows = []
    for name, column in analysis["columns"].items():
        for key, title in (
            ("angle_random_walk", "angle random walk"),
            ("bias_instability", "bias instability"),
            ("rate_random_walk", "rate random walk"),
            ("quantisation", "quantisation"),
        ):
            if key == "quantisation" and not _visible(column[key]):
                continue
            unit, factor = reading_unit(column[key]["unit"], _AS_NOISE.get(key, "")).scale
            texts = ("not determined", "")
            if column[key]["value"] is not None:
                texts = format_uncertain(*(column[key][part] * factor for part in ("value", "standard_uncertainty")))
                if column[key]["value"] == 0:
                    texts = (f"< {plain_number(column[key]['interval_95'][1] * factor, 2)}", "")
            label = title
            if column["unit"] == "m/s^2":
                label = title.replace("angle", "velocity").replace("rate", "acceleration")
            elif column["unit"] != "rad/s":
                label = title.replace("angle random walk", "white noise").removeprefix("rate ")
            rows.append([name, label, *texts, unit])
    return rows


def _visible(coefficient: dict[str, Any]) -> bool:
    """Return whether a coefficient is beyond three times its uncertainty."""
    return coefficient["value"] is not None and bool(coefficient["value"] > 3 * coefficient["standard_uncertainty"])
