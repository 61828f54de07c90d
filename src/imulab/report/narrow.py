"""Figures for a phone: panels that stand side by side go beneath one another."""

from __future__ import annotations

import math
from typing import Any

from imulab.report.elements import Figure

_LEAST, _MOST = 150, 300
_GAP = 74
_KEY_LINE = 21
"""Height of a panel, room between panels for ticks and titles, and height of a line of the key, pixels."""
_MOST_NUMBERS = 8


def narrow(figure: Figure) -> dict[str, Any] | None:
    """Return layout and height of a figure for a narrow screen; None where they stay as they are."""
    layout = {key: _with_fewer_numbers(value) for key, value in figure.layout.items()}
    keys = _legend_lines(figure)
    panels = [key[5:] for key in layout if key.startswith("xaxis") and "yaxis" + key[5:] in layout]
    if len({tuple(layout["xaxis" + panel].get("domain", (0, 1))) for panel in panels}) < 2:
        if not keys and layout == figure.layout:
            return None
        return {"layout": layout, "height": figure.height + keys * _KEY_LINE}
    margin = {"l": 62, "r": 14, "t": 30, "b": 55, **{k: v for k, v in layout.get("margin", {}).items() if k == "l"}}
    shares = [_domain(layout["yaxis" + panel]) for panel in panels]
    tallest = max(high - low for low, high in shares) * (figure.height - 75)
    size = min(max(tallest, _LEAST), _MOST)
    plot = len(panels) * size + (len(panels) - 1) * _GAP
    changed: dict[str, Any] = {}
    places: dict[tuple[float, float], float] = {}
    first = layout["yaxis" + panels[0]].get("title", {})
    for number, panel in enumerate(panels):
        top = 1 - number * (size + _GAP) / plot
        x, y = layout["xaxis" + panel], layout["yaxis" + panel]
        places[(round(_domain(x)[0], 9), round(_domain(y)[1], 9))] = top
        changed["xaxis" + panel] = {**x, "domain": [0, 1]}
        title = y.get("title", {}) if y.get("title", {}).get("text") else first
        changed["yaxis" + panel] = {**y, "domain": [max(top - size / plot, 0.0), top], "title": title}
        if "showticklabels" in y:
            changed["yaxis" + panel]["showticklabels"] = True
    notes = [_moved(note, places) for note in layout.get("annotations", [])]
    legend = {**layout.get("legend", {}), "y": 1 + 26 / plot, "yanchor": "bottom"}
    return {
        "layout": {**layout, **changed, "annotations": notes, "legend": legend, "margin": margin},
        "height": round(plot + margin["t"] + margin["b"] + keys * _KEY_LINE),
    }


def _with_fewer_numbers(axis: Any) -> Any:
    """Return an axis that is numbered evenly, with no more numbers than a narrow screen has room for."""
    if not isinstance(axis, dict) or axis.get("type") == "log" or not {"dtick", "range"} <= axis.keys():
        return axis
    low, high = axis["range"]
    return {**axis, "dtick": max(axis["dtick"], math.ceil((high - low) / _MOST_NUMBERS))}


def _domain(axis: dict[str, Any]) -> tuple[float, float]:
    low, high = axis.get("domain", (0.0, 1.0))
    return float(low), float(high)


def _moved(note: dict[str, Any], places: dict[tuple[float, float], float]) -> dict[str, Any]:
    """Return a note, the title of a panel with its panel."""
    if note.get("xref") != "paper" or note.get("yref") != "paper":
        return note
    top = places.get((round(note["x"], 9), round(note["y"], 9)))
    return note if top is None else {**note, "x": 0, "y": top}


def _legend_lines(figure: Figure) -> int:
    if figure.layout.get("showlegend") is False:
        return 0
    named = [t for t in figure.traces if t.get("name") and t.get("showlegend", True) and t["type"] != "heatmap"]
    return math.ceil(len(named) / 2) if len(named) > 1 else 0
