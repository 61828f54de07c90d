"""The attitudes of a tumble test on two equal-area maps of the sphere."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.estimation.ranked import quantile
from imulab.procedures.tumble.sections import attitudes_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import ALARM, BAD, GOOD, INK, QUIET, Figure
from imulab.units import from_si


def sphere_figure(record: Calibration) -> Figure:
    """Return the attitudes as points on the hemispheres around +z and −z, coloured by their residual."""
    data = attitudes_of(record)
    force = np.array(data.force)
    u = force / np.linalg.norm(force, axis=1, keepdims=True)
    residual = np.array([float(from_si(value, "ug")) for value in data.residual])
    weight = np.array(data.down_weight)
    limit = quantile(np.abs(residual[weight >= ALARM]), 0.95) if (weight >= ALARM).any() else 1.0
    up = u[:, 2] >= 0
    traces: list[dict[str, Any]] = []
    for upper, axes in ((True, ("x", "y")), (False, ("x2", "y2"))):
        traces += _graticule(axes)
        chosen = up if upper else ~up
        labels = [label for label, c in zip(data.label, chosen.tolist(), strict=True) if c]
        traces.append(_hemisphere(u[chosen], residual[chosen], labels, limit, axes, upper=upper))
    hidden = {"visible": False, "range": [-1.25, 1.25], "fixedrange": True}
    return Figure(
        title="Attitudes on the sphere",
        caption="Direction of the specific force (up) in the body frame, equal-area maps: left the "
        "hemisphere around +z, right that around −z. Large empty regions are what the calibration has not seen.",
        traces=traces,
        layout={
            "margin": {"l": 10, "r": 10, "t": 20, "b": 10},
            "xaxis": {**hidden, "domain": [0, 0.47]},
            "yaxis": {**hidden, "scaleanchor": "x"},
            "xaxis2": {**hidden, "domain": [0.5, 0.97]},
            "yaxis2": {**hidden, "scaleanchor": "x2", "anchor": "x2"},
            "annotations": [
                note
                for axes, side in ((("x", "y"), "+z"), (("x2", "y2"), "−z"))
                for note in (
                    _label(axes, 1.15, 0, "+x"),
                    _label(axes, -1.15, 0, "−x"),
                    _label(axes, 0, 1.12, "+y"),
                    _label(axes, 0, -1.12, "−y"),
                    _label(axes, 0, 0, side),
                )
            ],
        },
        height=420,
    )


def _hemisphere(
    up: Array, residual: Array, labels: list[str], limit: float, axes: tuple[str, str], *, upper: bool
) -> dict[str, Any]:
    """Return the attitudes of one hemisphere as points, coloured by residual from -limit to limit, µg."""
    x, y = _equal_area(up, upper)
    return {
        "type": "scatter",
        "mode": "markers",
        "x": x.tolist(),
        "y": y.tolist(),
        "xaxis": axes[0],
        "yaxis": axes[1],
        "showlegend": False,
        "marker": {
            "size": 12,
            "color": residual.tolist(),
            "cmin": -limit,
            "cmax": limit,
            "colorscale": [[0, GOOD], [0.5, "#f4efe6"], [1, BAD]],
            "line": {"color": INK, "width": 1},
            "showscale": upper,
            "colorbar": {"title": {"text": "|f| − g, µg"}, "thickness": 12},
        },
        "text": labels,
        "customdata": up.round(3).tolist(),
        "hovertemplate": "%{text}<br>up (%{customdata[0]}, %{customdata[1]}, %{customdata[2]})<extra></extra>",
    }


def _equal_area(u: Array, upper: bool) -> tuple[Array, Array]:
    """Lambert's azimuthal equal-area map of a hemisphere onto the unit disc."""
    z = u[:, 2] if upper else -u[:, 2]
    radius = np.sqrt(np.maximum(1 - z, 0.0))
    ring = np.maximum(np.hypot(u[:, 0], u[:, 1]), 1e-12)
    return radius * u[:, 0] / ring, radius * u[:, 1] / ring


def _graticule(axes: tuple[str, str]) -> list[dict[str, Any]]:
    angle = np.linspace(0, 2 * np.pi, 121)
    circles = [np.sqrt(1 - np.cos(np.radians(t))) for t in (30, 60, 90)]
    return [
        {
            "type": "scatter",
            "mode": "lines",
            "x": (r * np.cos(angle)).round(4).tolist(),
            "y": (r * np.sin(angle)).round(4).tolist(),
            "xaxis": axes[0],
            "yaxis": axes[1],
            "hoverinfo": "skip",
            "line": {"color": INK if r == circles[-1] else "#d5dbdf", "width": 1},
            "showlegend": False,
        }
        for r in circles
    ]


def _label(axes: tuple[str, str], x: float, y: float, text: str) -> dict[str, Any]:
    return {
        "xref": axes[0],
        "yref": axes[1],
        "x": x,
        "y": y,
        "text": text,
        "showarrow": False,
        "font": {"color": QUIET if (x, y) == (0, 0) else INK},
    }
