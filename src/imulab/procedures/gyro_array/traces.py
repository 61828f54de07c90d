"""What the figures of an array have in common: axes, legend, a curve of Allan deviation."""

from __future__ import annotations

from typing import Any

from imulab.procedures.gyro_array.sections import AllanCurve

MARGIN = {"l": 70, "r": 20, "t": 64, "b": 55}
"""A legend above the plot has room below the buttons in the corner."""


def axis(title: str, **more: Any) -> dict[str, Any]:
    """Return the layout of an axis."""
    return {"title": {"text": title}, "zeroline": False, "gridcolor": "#e6eaed", **more}


def log_axis(title: str, **more: Any) -> dict[str, Any]:
    """Return the layout of a logarithmic axis."""
    return axis(title, type="log", dtick=1, exponentformat="none", **more)


def of_axis(letter: str) -> str:
    """Return what a title adds for one of three axes."""
    return f", axis {letter}" if letter else ""


DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot", "6px 2px 2px 2px", "2px 6px")
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "x", "star", "triangle-down", "cross")
"""What tells lines apart without colour, by their number."""


def allan_trace(
    curve: AllanCurve, name: str, colour: str, factor: float, width: float = 1.6, *, number: int = 0
) -> dict[str, Any]:
    """Return a line of deviation times a factor over averaging time, s; values of 0 have no place on a log scale."""
    known = [(t, d) for t, d in zip(curve.tau, curve.deviation, strict=False) if d > 0]
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "x": [t for t, _ in known],
        "y": [d * factor for _, d in known],
        "line": {"color": colour, "width": width, "dash": DASHES[number % len(DASHES)]},
        "marker": {"symbol": SYMBOLS[number % len(SYMBOLS)], "size": 6},
        "name": name,
        "hovertemplate": f"{name}<br>%{{x:.3g}} s: %{{y:.3g}}<extra></extra>",
    }
