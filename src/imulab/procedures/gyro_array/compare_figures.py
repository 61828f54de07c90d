"""The figures and tables of a comparison of methods, from its record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.errors import RecordError
from imulab.procedures.gyro_array.health import JUMPED, NON_FINITE, STUCK
from imulab.procedures.gyro_array.model import unit_of_angle
from imulab.procedures.gyro_array.sections import ComparisonRecord, comparison_of
from imulab.procedures.gyro_array.traces import allan_trace, curves, method_texts, of_axis
from imulab.records.calibration import Calibration
from imulab.report.elements import BAD, GOOD, INK, Exhibits, Figure, ReportTable, plain_number
from imulab.report.traces import DASHES, axis, log_axis, scatter

_MOST_NAMED = 4
_PALETTE = {
    "robust": GOOD,
    "mean": "#7a8790",
    "least-squares": "#8e6bbd",
    "feedback": BAD,
    "support": "#c99a2e",
    "covariance": "#4f9d69",
    "kalman": "#2e4057",
    "single gyro": "#b9c2c8",
}
_NUMBER = {method: number for number, method in enumerate(_PALETTE)}
"""By which each method has its dashes and marks in every figure."""


def exhibits_of_comparison(record: Calibration) -> Exhibits:
    """Return what a report on a comparison shows."""
    held = comparison_of(record)
    data, model = held.data, held.model
    found = {method: rows for method, rows in data.figures.items() if not isinstance(rows, str)}
    name = "robust" if "robust" in found else "mean"
    best = found.get(name)
    if best is None:
        raise RecordError("the record holds figures of neither robust nor mean")
    unit = model.units[0]
    reduction = float(np.mean([row.reduction or 0.0 for row in best]))
    broken = [
        name
        for row, working in zip(data.readings_names, data.working or data.readings_names, strict=True)
        for name in row
        if name not in working
    ]
    facts = [
        ("gyros", f"{model.elements} × {len(model.axes)} {'axes' if len(model.axes) > 1 else 'axis'}"),
        (
            "single gyro" if not broken else "working single gyro",
            f"{plain_number(float(np.mean(data.single)), 3)} {unit}",
        ),
        (name, f"{plain_number(float(np.mean([row.rate_std for row in best])), 3)} {unit}"),
        ("noise / limit", plain_number(float(np.mean([row.over_limit for row in best])), 3)),
        ("truth", "column" if model.truth.startswith("column") else "still unit"),
        ("calibrated", "yes" if model.calibrated else "no"),
    ]
    items: list[Figure | ReportTable] = [_methods_table(held, a) for a in range(len(model.axes))]
    for a in range(len(model.axes)):
        items += [_allan_methods(held, a), _angles(held, a)]
        if data.health.known:
            items.append(_health(held, a))
    return Exhibits(
        headline=f"Fusing {model.elements} gyros by {name} makes the rate {plain_number(reduction, 3)} times "
        f"quieter than the mean single gyro{_that_works(broken)}; "
        + ("the common bias was calibrated." if model.calibrated else "the bias that all share remains: calibrate it."),
        facts=facts,
        items=items,
    )


def _that_works(broken: list[str]) -> str:
    """Return what the headline adds where gyros failed: with them the mean would be the size of the fault."""
    if not broken:
        return ""
    named = ", ".join(broken) if len(broken) <= _MOST_NAMED else f"{len(broken)} others"
    return f" that works ({named} did not)"


def _methods_table(record: ComparisonRecord, a: int) -> ReportTable:
    data, model = record.data, record.model
    unit = model.units[a]
    angle, factor = unit_of_angle(unit)
    halves = any(not isinstance(rows, str) and rows[a].split_half is not None for rows in data.figures.values())
    rows, highlight = [], None
    for number, (method, found) in enumerate(data.figures.items()):
        if method == "robust":
            highlight = number
        if isinstance(found, str):
            rows.append([method, *["–"] * (7 + halves)])
            continue
        rows.append([method, *method_texts(found[a], factor, 3, halves=halves)])
    return ReportTable(
        title=f"Methods{of_axis(model.axes[a])}",
        caption=f"Rates in {unit}, angles in {angle}. Rate error (standard deviation with the mean removed) and angle "
        "error against the truth; reduction of noise against the mean single gyro that works; noise from sample to "
        "sample over the limit of any fixed weights; bandwidth at −3 dB. Lower noise with less bandwidth, or below the "
        "limit, is low-pass filtering. Split half: difference of the two halves of the array.",
        columns=[
            "method",
            "rate std",
            "rate max",
            "angle std",
            "angle max",
            "reduction",
            "noise / limit",
            "bandwidth, Hz",
            *(["split half"] if halves else []),
        ],
        rows=rows,
        highlight=highlight,
    )


def _width(method: str) -> float:
    return 3.0 if method == "robust" else 1.5


def _allan_methods(record: ComparisonRecord, a: int) -> Figure:
    unit = record.model.units[a]
    held = record.data.allan
    order = ["single gyro", *[m for m in held if m not in ("single gyro", "robust")], "robust"]
    traces = [
        allan_trace(held[m][a], m, _PALETTE.get(m, INK), 1.0, _width(m), number=_NUMBER.get(m, 0))
        for m in order
        if m in held
    ]
    first = {m: d for m in held if (d := next((d for d in held[m][a].deviation if d > 0), None)) is not None}
    quiet = min(first, key=first.__getitem__, default="")
    return curves(
        message=f"At the shortest time {quiet} is the quietest, {plain_number(first[quiet], 2)} {unit}."
        if quiet
        else "",
        title=f"Allan deviation of each method{of_axis(record.model.axes[a])}",
        caption="On the left, how quiet a sample is: a curve that bends down there is low-pass filtered. On the "
        "right, what the angle drifts by: no weighting changes the bias that all gyros share.",
        traces=traces,
        x=log_axis("averaging time, s"),
        y=log_axis(f"Allan deviation, {unit}"),
        height=430,
    )


def _angles(record: ComparisonRecord, a: int) -> Figure:
    angle, factor = unit_of_angle(record.model.units[a])
    time = record.data.trace_time
    traces = [
        scatter(time, [factor * value for value in rows[a]], "lines", name=method,
                line={"color": _PALETTE.get(method, INK), "width": _width(method),
                      "dash": DASHES[_NUMBER.get(method, 0)]},
                hovertemplate=f"{method}<br>%{{x:.4g}} s: %{{y:.4g}} {angle}<extra></extra>")
        for method, rows in sorted(record.data.angle.items(), key=lambda item: item[0] == "robust")
    ]  # fmt: skip
    ends = {method: abs(factor * rows[a][-1]) for method, rows in record.data.angle.items()}
    if not ends:
        raise RecordError("data.angle: expected the angles of one method or more")
    least, most = min(ends, key=ends.__getitem__), max(ends, key=ends.__getitem__)
    return curves(
        message=f"At the end {least} is off by {plain_number(ends[least], 2)} {angle}, {most} by "
        f"{plain_number(ends[most], 2)} {angle}.",
        title=f"Angle error over time{of_axis(record.model.axes[a])}",
        caption="Integral of the rate error. A straight line is a bias; lines on top of each other differ in nothing "
        "that counts for an attitude.",
        traces=traces,
        x=axis("time, s"),
        y=axis(f"angle error, {angle}"),
    )


def _health(record: ComparisonRecord, a: int) -> Figure:
    health = record.data.health
    names = record.data.readings_names[a]
    weight = np.array(health.weight, dtype=np.float64)[:, a, :].T
    flags = np.array(health.flags)[:, a, :]
    traces: list[dict[str, Any]] = [
        {
            "type": "heatmap",
            "x": health.time,
            "y": names,
            "z": weight.tolist(),
            "zmin": 0,
            "zmax": max(0.5, float(weight.max())),
            "colorscale": [[0, "#ffffff"], [1, GOOD]],
            "colorbar": {"thickness": 12, "title": {"text": "weight"}},
            "hovertemplate": "%{y}, %{x:.4g} s<br>weight %{z:.2f}<extra></extra>",
        }
    ]
    for bit, label, symbol, colour in (
        (STUCK, "stuck", "square", BAD),
        (NON_FINITE, "non-finite", "x", INK),
        (JUMPED, "jumped", "triangle-up", "#c99a2e"),
    ):
        k, i = np.nonzero(flags & bit)
        if k.size:
            at, which = [health.time[index] for index in k], [names[index] for index in i]
            marker = {"symbol": symbol, "color": colour, "size": 7}
            hover = f"%{{y}} {label}, %{{x:.4g}} s<extra></extra>"
            traces.append(scatter(at, which, "markers", marker=marker, name=label, hovertemplate=hover))
    return curves(
        title=f"Weight and health of each gyro under robust{of_axis(record.model.axes[a])}",
        caption="Dark: counts for much. White: not in use. Marks: stuck, non-finite, or a bias that jumped and is "
        "being estimated again.",
        traces=traces,
        x=axis("time, s"),
        y={"automargin": True, "autorange": "reversed"},
        height=max(260, 30 * len(names) + 120),
    )
