"""The channels of a recording over time: a figure for each sensor, thinned to what a screen can show."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.recording import Array, Recording
from imulab.report.elements import BAD, GOOD, LEGEND, QUIET, Figure

_POINTS = 2000
"""Columns of pixels that a curve is thinned to; the smallest and the largest sample of each stay."""
_COLOURS = (GOOD, BAD, "#7a5c99", "#6f7f3f", "#2c4fa3", "#a8322f", "#2e4057", QUIET)
_DASHES = ("solid", "dot", "dash", "dashdot")


def channel_figures(recording: Recording) -> list[Figure]:
    """Return a figure for each sensor of a recording: its columns over time, or over their rows."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name, unit in recording.units.items():
        if name != "time":
            stem = name.partition("_")[0] if not name.startswith(("truth_", "std_")) else "_".join(name.split("_")[:2])
            groups.setdefault((stem, unit), []).append(name)
    time = recording.time
    place = np.arange(1.0, len(recording) + 1) if time is None else time
    return [_figure(recording, names, stem, unit, place) for (stem, unit), names in groups.items()]


def thinned(place: Array, values: Array, points: int = _POINTS) -> tuple[Array, Array]:
    """Return a curve that looks the same on so many columns of pixels: smallest and largest sample of each.

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


def _figure(recording: Recording, names: list[str], stem: str, unit: str, place: Array) -> Figure:
    over = "time, s" if "time" in recording else "row"
    thin = len(recording) > 2 * _POINTS
    traces = [_trace(*thinned(place, recording.columns[name]), name, number) for number, name in enumerate(names)]
    return Figure(
        title=f"{stem} over {over.partition(',')[0]}",
        caption="Drawn are the smallest and the largest sample of each short piece." if thin else "",
        traces=traces,
        layout={
            "xaxis": {"title": {"text": over}, "gridcolor": "#e6eaed", "zeroline": False},
            "yaxis": {"title": {"text": f"{stem}, {unit}"}, "gridcolor": "#e6eaed", "zeroline": False},
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
        "line": {"color": _COLOURS[number % len(_COLOURS)], "width": 1, "dash": _DASHES[number // len(_COLOURS) % 4]},
    }
