"""The figures and tables of an array's record, a fused rate, and a comparison of methods."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from imulab.errors import LackingError, RecordError
from imulab.procedures.gyro_array.alignment import TRUTH, slower_noise_text
from imulab.procedures.gyro_array.elements import JUMPED, NON_FINITE, STUCK, unit_of_angle
from imulab.procedures.gyro_array.imus.figures import exhibits as imus_exhibits
from imulab.procedures.gyro_array.imus.schema import imus_of
from imulab.procedures.gyro_array.schema import (
    ArrayRecord,
    ComparisonRecord,
    ElementCurve,
    MethodRow,
    PerGyro,
    array_of,
    comparison_of,
)
from imulab.records.calibration import Calibration
from imulab.report.traces import (
    BAD,
    DASHES,
    GOOD,
    INK,
    LEGEND,
    MARGIN,
    SYMBOLS,
    TIME,
    Exhibits,
    Figure,
    ReportTable,
    correlation_map,
    figure_axis,
    format_uncertain,
    log_axis,
    plain_number,
    scatter,
    strongest_pair,
)
from imulab.units import from_si

# Common parts: titles of axes, rows of numbers, curves.


def axis_suffix(letter: str) -> str:
    """Return the end of a title for one of three axes."""
    return f", axis {letter}" if letter else ""


def curves(
    title: str, caption: str, traces: list[dict[str, Any]], x: dict[str, Any], y: dict[str, Any], message: str = "",
    height: int = 400,
) -> Figure:  # fmt: skip
    """Return a figure of one plot with a legend above it."""
    layout = {"xaxis": x, "yaxis": y, "legend": LEGEND, "margin": MARGIN}
    return Figure(title, caption, traces, layout, height, message)


def allan_trace(
    curve: ElementCurve, name: str, colour: str, factor: float, width: float = 1.6, *, number: int = 0
) -> dict[str, Any]:
    """Return a line of deviation times a factor over averaging time, s; 0 has no place on a logarithmic axis."""
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
    """Return the figures of a method as cells of a table, angles times a factor, with that of the halves on request."""
    values = [
        row.rate_std, row.rate_max, factor * row.angle_std, factor * row.angle_max, row.reduction, row.over_limit,
        row.bandwidth, *([row.split_half] if halves else []),
    ]  # fmt: skip
    return ["–" if value is None else plain_number(value, digits) for value in values]


# A comparison of methods.


_MOST_NAMED = 4  # methods that a sentence names
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
"""Each method has its own dashes and marks in every figure."""


def comparison_exhibits(record: Calibration) -> Exhibits:
    """Return what a report on a comparison shows."""
    held = comparison_of(record)
    data, model = held.data, held.model
    tables = {method: rows for method, rows in data.figures.items() if not isinstance(rows, str)}
    name = "robust" if "robust" in tables else "mean"
    best = tables.get(name)
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
    """Return the end of the headline where gyros failed: the mean over them would be the size of the fault."""
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
    for number, (method, figures) in enumerate(data.figures.items()):
        if method == "robust":
            highlight = number
        if isinstance(figures, str):
            rows.append([method, *["–"] * (7 + halves)])
            continue
        rows.append([method, *method_texts(figures[a], factor, 3, halves=halves)])
    return ReportTable(
        title=f"Methods{axis_suffix(model.axes[a])}",
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
        title=f"Allan deviation of each method{axis_suffix(record.model.axes[a])}",
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
        title=f"Angle error over time{axis_suffix(record.model.axes[a])}",
        caption="Integral of the rate error. A straight line is a bias; lines on top of each other differ in nothing "
        "that counts for an attitude.",
        traces=traces,
        x=figure_axis(TIME),
        y=figure_axis(f"angle error, {angle}"),
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
        title=f"Weight and health of each gyro under robust{axis_suffix(record.model.axes[a])}",
        caption="The stronger the colour, the more it counts. Blank: not in use. Marks: stuck, non-finite, or a bias "
        "that jumped and is being estimated again.",
        traces=traces,
        x=figure_axis(TIME),
        y={"automargin": True, "autorange": "reversed"},
        height=max(260, 30 * len(names) + 120),
    )


# A calibration.


_ELEMENT_SHADES = ("#1f6f8b", "#c8553d", "#8e6bbd", "#c99a2e", "#4f9d69", "#2e4057", "#d081a5", "#6f7f3f")


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    kind = record.model.get("kind")
    if kind == "imus":
        return imus_exhibits(record)
    return comparison_exhibits(record) if kind == "comparison" else _calibration(array_of(record))


def summary(record: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return the first table of the report: each gyro with its uncertainties, or each method."""
    first = next(item for item in exhibits(record).items if isinstance(item, ReportTable))
    return first.columns, first.rows


def reservations(record: Calibration) -> list[str]:
    """Return what a certificate must say of the values: whose scale they have, and what their uncertainties lack."""
    earth = "The Earth's rate, up to 15 deg/h along an axis, was not taken off: biases of gyroscopes hold it."
    if record.model.get("kind") == "imus":
        board = imus_of(record)
        nominal = (
            "Positions, and the mean scale factor of all gyroscopes, rest on the nominal value of that mean and its "
            "tolerance."
        )
        kept = f"Held near their nominal values, which the recording does not tell: {'; '.join(board.not_determined)}."
        return [earth, *[nominal] * (board.size_from == "gyro scale"), *[kept] * bool(board.not_determined)]
    relative = (
        "Scale factors and alignment are relative to the mean of all elements. The scale factor of that mean was not "
        "measured: uncertainties do not hold its error."
    )
    gauge = record.model.get("gauge")
    reserved = [earth, *[relative] * (gauge not in (None, TRUTH))]
    if record.model.get("kind") == "calibration" and (slower := array_of(record).fit.slower_noise):
        uncertainties = np.array([element.bias.uncertainties for element in array_of(record).elements])
        text = slower_noise_text(slower, uncertainties, array_of(record).fit.duration.value)
        reserved.append(f"{text[0].upper()}{text[1:]}.")
    return reserved


def _calibration(record: ArrayRecord) -> Exhibits:
    elements, model, shared = record.elements, record.model, record.correlation
    limit = float(np.mean([_deg(limit.value) for limit in shared.limit]))
    tau = shared.averaging_time.value
    spread = float(np.degrees(np.ptp(np.array([element.bias.values for element in elements]), axis=0)).max())
    worst = float(np.degrees(max(element.bias.uncertainties.max() for element in elements)))
    facts = [
        ("elements", f"{model.elements} × {len(model.axes)} {'axes' if len(model.axes) > 1 else 'axis'}"),
        ("at rest", f"{plain_number(record.fit.duration.value, 3)} s"),
        ("spread of biases", f"{plain_number(spread, 3)} deg/s"),
        ("worst u(bias)", f"{plain_number(worst, 2)} deg/s"),
        (f"limit at {tau:g} s", f"{plain_number(limit, 3)} deg/s"),
        ("alignment", "from motion" if model.aligned else "not measured"),
    ]
    items: list[Figure | ReportTable] = [_elements_table(record)]
    if model.aligned and len(model.axes) == 3:
        items.append(_matrix_table(record))
    items += [_allan_elements(record, a) for a in range(len(model.axes))]
    items += [_correlation(record, a) for a in range(len(model.axes))]
    single = _deg(float(np.mean([math.sqrt(c) for m in shared.covariance for c in np.diag(np.array(m))])))
    return Exhibits(
        headline=f"{model.elements} gyros whose biases differ by up to {plain_number(spread, 3)} deg/s; best "
        f"weights would bring {plain_number(single, 3)} deg/s of a single one at {tau:g} s down to "
        f"{plain_number(limit, 3)} deg/s.",
        facts=facts,
        items=items,
    )


def _deg(value: float) -> float:
    return float(from_si(value, "deg/s"))


def _elements_table(record: ArrayRecord) -> ReportTable:
    rows = []
    single_axis = len(record.model.axes) == 1
    for element in record.elements:
        scale = element.scale_factor if single_axis else None
        for a, axis in enumerate(record.model.axes):
            rows.append(
                [
                    element.name if not axis else f"{axis} {element.name}",
                    _text(element.bias, a, 180 / math.pi),
                    *([] if scale is None else [" ± ".join(format_uncertain(scale.value, scale.standard_uncertainty))]),
                    _text(element.angle_random_walk, a, 60 * 180 / math.pi),
                    _text(element.bias_instability, a, 3600 * 180 / math.pi),
                    _text(element.rate_random_walk, a, 3600 * 60 * 180 / math.pi),
                ]
            )
    scaled = single_axis and record.model.aligned
    return ReportTable(
        title="Elements",
        caption="Value ± standard uncertainty. Bias is the plain mean at rest, the part that all share (Earth rate "
        "too) included. Angle random walk (ARW), bias instability and rate random walk (RRW) are those of the noise "
        "model whose Allan curves are below; 0 ± u means that the recording is too short or the effect too small to be "
        "seen, not determined that the noise is not that of the model (the warnings say why).",
        columns=[
            "gyro",
            "bias, deg/s",
            *(["scale factor"] if scaled else []),
            "ARW, deg/√h",
            "bias instability, deg/h",
            "RRW, deg/h/√h",
        ],
        rows=rows,
    )


def _text(per_gyro: PerGyro, a: int, factor: float) -> str:
    """Return value and standard uncertainty on an axis as text, times a factor for the unit."""
    value, u = float(per_gyro.values[a]) * factor, float(per_gyro.uncertainties[a]) * factor
    if math.isnan(value):
        return "not determined"
    return " ± ".join(format_uncertain(value, None if math.isnan(u) else u))


def _matrix_table(record: ArrayRecord) -> ReportTable:
    rows = []
    for element in record.elements:
        if element.matrix is None or element.residual is None:
            raise LackingError(f"the record lacks the matrix or residual of element {element.name}")
        cells = ["  ".join(f"{value:+.4f}" for value in row) for row in element.matrix.value]
        worst = 1e6 * np.max(element.matrix.standard_uncertainty)
        rows.append([element.name, *cells, f"{worst:.0f}", plain_number(_deg(element.residual.values.max()), 3)])
    return ReportTable(
        title="Alignment",
        caption=f"Rate = matrix (reading − bias); rows of the matrix are x, y, z. Gauge: {record.model.gauge}. u: "
        "largest standard uncertainty of an entry. A residual far above the noise means errors that a matrix cannot "
        "hold (nonlinearity, timing, g-sensitivity).",
        columns=["element", "x", "y", "z", "u, 10⁻⁶", "residual, deg/s"],
        rows=rows,
    )


def _allan_elements(record: ArrayRecord, a: int) -> Figure:
    traces = []
    for i, curve in enumerate(record.data.allan[a]):
        traces.append(allan_trace(curve, record.elements[i].name, _ELEMENT_SHADES[i % 8], math.degrees(1), number=i))
    return curves(
        title=f"Allan deviation of each gyro{axis_suffix(record.model.axes[a])}",
        caption="Slope −1/2: angle random walk. Flat: bias instability. Slope +1/2: rate random walk. A curve apart "
        "from the others is a gyro apart from the others; the last points on the right are few averages.",
        traces=traces,
        x=log_axis("averaging time, s"),
        y=log_axis("Allan deviation, deg/s"),
    )


def _correlation(record: ArrayRecord, a: int) -> Figure:
    shared = record.correlation
    names = [f"{record.model.axes[a]} {element.name}".strip() for element in record.elements]
    matrix = np.array(shared.matrix[a])
    noise = float(np.median(shared.standard_uncertainty[a]))
    return correlation_map(
        message=f"The pair that goes together most: {strongest_pair(matrix, names)}." if len(names) > 1 else "",
        title=f"Correlation of the noise{axis_suffix(record.model.axes[a])}",
        caption=f"At {shared.averaging_time.value:g} s, ± {noise:.2f} each. What all share, no weights remove; "
        "a pair that goes together counts for less than two.",
        matrix=matrix,
        names=names,
        numbered=len(names) <= 12,
        height=max(360, 28 * len(names) + 120),
    )
