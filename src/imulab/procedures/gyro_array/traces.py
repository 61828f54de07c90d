"""What the figures of an array have in common: titles of axes, rows of numbers, curves."""

from __future__ import annotations

from typing import Any

from imulab.procedures.gyro_array.sections import AllanCurve, MethodRow
from imulab.report.elements import LEGEND, Figure, plain_number
from imulab.report.traces import DASHES, MARGIN, SYMBOLS, scatter


def of_axis(letter: str) -> str:
    """Return what a title adds for one of three axes."""
    return f", axis {letter}" if letter else ""


def curves(
    title: str, caption: str, traces: list[dict[str, Any]], x: dict[str, Any], y: dict[str, Any], message: str = "",
    height: int = 400,
) -> Figure:  # fmt: skip
    """Return a figure of one plot with a legend above it."""
    layout = {"xaxis": x, "yaxis": y, "legend": LEGEND, "margin": MARGIN}
    return Figure(title, caption, traces, layout, height, message)


def allan_trace(
    curve: AllanCurve, name: str, colour: str, factor: float, width: float = 1.6, *, number: int = 0
) -> dict[str, Any]:
    """Return a line of deviation times a factor over averaging time, s; values of 0 have no place on a log scale."""
    known = [(t, d * factor) for t, d in zip(curve.tau, curve.deviation, strict=False) if d > 0]
    return scatter(
        [t for t, _ in known],
        [d for _, d in known],
        "lines+markers",
        line={"color": colour, "width": width, "dash": DASHES[number % len(DASHES)]},
        marker={"symbol": SYMBOLS[number % len(SYMBOLS)], "size": 6},
        name=name,
        hovertemplate=f"{name}<br>%{{x:.3g}} s: %{{y:.3g}}<extra></extra>",
    )


def method_texts(row: MethodRow, factor: float, digits: int, *, halves: bool) -> list[str]:
    """Return the figures of a method as cells of a table, angles times a factor, with or without that of the halves."""
    values = [
        row.rate_std, row.rate_max, factor * row.angle_std, factor * row.angle_max, row.reduction, row.over_limit,
        row.bandwidth, *([row.split_half] if halves else []),
    ]  # fmt: skip
    return ["–" if value is None else plain_number(value, digits) for value in values]
