"""A row of plots that share their axes, coloured by temperature."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.recording import Array
from imulab.report.elements import Figure
from imulab.report.traces import SYMBOLS, axis

_ACROSS = 3
_DECADES = [1, 10, 100, 1000]
_SCALE = ("#2c4fa3", "#3d8fc4", "#58b5a6", "#a3bf58", "#e0a83c", "#d5663a", "#a8322f")
"""Cold to warm; distinct in lightness too."""


def axis_style(title: str, **more: Any) -> dict[str, Any]:
    """Return a Plotly axis in the style of the reports."""
    return axis("", **more) | {"title": {"text": title, "standoff": 12}}


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
    """Return a trace without points for each temperature, for the key."""
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
    """Lay out one plot per name, at most three across, with a common key of temperatures below the title.

    On a logarithm of time bins that widen with time lie evenly.
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
        layout[f"xaxis{suffix}"] = axis_style(
            "s after power-on" if bottom else "", domain=[left, left + width], anchor=f"y{suffix}", **scale
        )
        layout[f"yaxis{suffix}"] = axis_style(
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
