"""What figures are made of: axes, curves and bands, the dashes and marks that tell them apart, maps of correlation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from imulab.recording import Array
from imulab.report.elements import BAD, GOOD

MARGIN = {"l": 70, "r": 20, "t": 64, "b": 55}
"""A legend above the plot has room below the buttons in the corner."""
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot", "6px 2px 2px 2px", "2px 6px")
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "x", "star", "triangle-down", "cross")
"""What tells lines apart without colour, by their number."""


def axis(title: str, **more: Any) -> dict[str, Any]:
    """Return the layout of an axis."""
    return {"title": {"text": title}, "zeroline": False, "gridcolor": "#e6eaed", **more}


def log_axis(title: str, **more: Any) -> dict[str, Any]:
    """Return the layout of a logarithmic axis."""
    return axis(title, **{"type": "log", "dtick": 1, "exponentformat": "none"} | more)


def short_log_axis(title: str, **more: Any) -> dict[str, Any]:
    """Return the layout of a logarithmic axis over a decade or two, with numbers at 2 and 5 between the powers."""
    return log_axis(title, **{"dtick": "D2", "tickformat": "~g"} | more)


def scatter(x: Sequence[Any], y: Sequence[Any], mode: str, **more: Any) -> dict[str, Any]:
    """Return lines or markers."""
    return {"type": "scatter", "mode": mode, "x": x, "y": y, **more}


def band(x: Array, low: Array, high: Array, colour: str, digits: int = 7, **more: Any) -> dict[str, Any]:
    """Return the area between two curves, in a faint shade of a colour #rrggbb."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    around, edge = rounded([*x, *x[::-1]], digits), rounded([*low, *high[::-1]], digits)
    fill = {"fill": "toself", "fillcolor": f"rgba({red},{green},{blue},0.18)", "line": {"width": 0}}
    return scatter(around, edge, "lines", **fill, hoverinfo="skip", **more)


def rounded(values: Any, digits: int = 7) -> list[float | None]:
    """Return values for a figure, which needs no more than seven digits; what is not finite leaves a gap."""
    found = np.asarray(values, dtype=np.float64)
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in found.tolist()]


def correlation_map(matrix: Array, names: Sequence[str], **more: Any) -> dict[str, Any]:
    """Return a map of correlations from -1 to 1, shape (n, n)."""
    return {
        "type": "heatmap", "z": matrix.round(3).tolist(), "x": names, "y": names, "zmin": -1, "zmax": 1,
        "colorscale": [[0, GOOD], [0.5, "#ffffff"], [1, BAD]], "xgap": 1, "ygap": 1, "colorbar": {"thickness": 12},
        "hovertemplate": "%{y}, %{x}: %{z:.2f}<extra></extra>", **more,
    }  # fmt: skip


def strongest_pair(matrix: Array, names: Sequence[str]) -> str:
    """Return the two that are most correlated, and by how much, such as ``a and b, -0.93``."""
    i, j = divmod(int(np.argmax(np.abs(np.triu(matrix, 1)))), len(names))
    return f"{names[i]} and {names[j]}, {matrix[i, j]:+.2f}"
