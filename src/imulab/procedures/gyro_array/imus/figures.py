"""What a report on a board of whole IMUs shows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from imulab.device.imus import NO_LIMIT
from imulab.procedures.gyro_array.imus.schema import Imu, ImusRecord, Three, imus_of
from imulab.records.calibration import Calibration
from imulab.records.sections import Above0
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
    figure_axis,
    format_uncertain,
    log_axis,
    plain_number,
    rounded,
    scatter,
)
from imulab.units import STANDARD_GRAVITY

_CHI = math.sqrt(-2 * math.log(0.05))
"""Axes of an ellipse that holds two normal variates with 95 %, in standard deviations."""
_SOURCES = {
    "gravity": "gravity turned from rest to rest",
    "stated": "a stated distance",
    "gyro scale": "the nominal scale of the gyroscopes",
}


def exhibits(calibration: Calibration) -> Exhibits:
    """Return headline, facts, figures and tables of a board's record."""
    record = imus_of(calibration)
    fit = record.fit
    largest = max(u or 0.0 for imu in record.imus for u in imu.position.standard_uncertainty)
    facts = [
        ("IMUs", f"{record.model.imus}"),
        ("rests", f"{fit.rests}"),
        ("in motion", f"{plain_number(fit.duration.value, 3)} s"),
        ("largest u(position)", f"{plain_number(1e3 * largest, 2)} mm"),
        ("size from", record.size_from),
        ("age of readings", f"{plain_number(1e3 * fit.age.value, 2)} ms"),
    ]
    if fit.bridged:
        facts.append(("samples that fusion bridges", f"{plain_number(100 * fit.bridged, 2)} %"))
    return Exhibits(
        headline=f"{record.model.imus} IMUs: positions known to {plain_number(1e3 * largest, 2)} mm or better, the "
        f"size of the board from {_SOURCES[record.size_from]}",
        facts=facts,
        items=_items(record, calibration),
    )


def _items(record: ImusRecord, calibration: Calibration) -> list[Figure | ReportTable]:
    items: list[Figure | ReportTable] = [*_imus_tables(record), _size_table(record)]
    if (record.limits < NO_LIMIT).any():
        items.append(_ranges_table(record))
    if record.not_determined:
        rows = [[name] for name in record.not_determined]
        caption = "What is known no better than before the recording; it is held near its nominal value."
        items.append(ReportTable("Not told by this recording", caption, ["what"], rows))
    items += [_board(record, calibration, 0, 1), _board(record, calibration, 0, 2), _latencies(record)]
    return [*items, _residuals(record, "accel"), _residuals(record, "gyro")]


def _board(record: ImusRecord, calibration: Calibration, across: int, up: int) -> Figure:
    """Return the board seen along an axis, with its IMUs and the ellipses of their positions."""
    place = 1e3 * np.array([imu.position.value for imu in record.imus])
    names = ["xyz"[axis] for axis in (across, up)]
    x, y = place[:, across], place[:, up]
    turn = np.linspace(0, 2 * math.pi, 49)
    circle = _CHI * np.stack([np.cos(turn), np.sin(turn)])
    ellipses = {}
    for k in range(1, len(place)):
        keys = [f"position_{name}_{k + 1}" for name in names]
        if all(key in calibration.covariance.names for key in keys):
            ellipses[k] = 1e3 * np.linalg.cholesky(calibration.covariance.block(keys)) @ circle
    largest = max((float(np.abs(ellipse).max()) for ellipse in ellipses.values()), default=1.0)
    room = 0.1 * max(float(np.ptp(x)), float(np.ptp(y)), 1e-3)
    factor = max((each for each in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if each * largest <= room), default=1)
    traces = [
        scatter(
            rounded(x[k] + factor * ellipse[0]), rounded(y[k] + factor * ellipse[1]), "lines",
            line={"color": GOOD, "width": 1.2}, fill="toself", fillcolor="rgba(31,111,139,0.18)", hoverinfo="skip",
            showlegend=False,
        )
        for k, ellipse in ellipses.items()
    ]  # fmt: skip
    # IMUs that lie one above the other have one label.
    near = np.hypot(x[:, None] - x, y[:, None] - y) < room / 4
    names_there = [", ".join(record.imus[j].name for j in np.flatnonzero(row)) for row in near]
    labels = [text if near[k].argmax() == k else "" for k, text in enumerate(names_there)]
    traces.append(
        scatter(
            rounded(x), rounded(y), "markers+text", marker={"color": INK, "size": 7},
            text=labels, hovertext=names_there, textposition="top right", showlegend=False,
            hovertemplate=f"IMU %{{hovertext}}<br>{names[0]} %{{x:.3f}} mm, {names[1]} %{{y:.3f}} mm<extra></extra>",
        )
    )  # fmt: skip
    layout = {
        "xaxis": figure_axis(f"{names[0]}, mm"),
        "yaxis": figure_axis(f"{names[1]}, mm", scaleanchor="x", scaleratio=1),
        "margin": MARGIN,
    }
    enlarged = f", drawn {factor} times as large" if factor > 1 else ""
    caption = (
        f"Sensing elements of the accelerometers from IMU 1, body axes {names[0]} and {names[1]}. Ellipses "
        f"hold the place with 95 %{enlarged}; the size of the board, common to all, is part of them."
    )
    return Figure(f"The board, {names[0]} and {names[1]}", caption, traces, layout, 460)


def _latencies(record: ImusRecord) -> Figure:
    traces = []
    for number, (name, values) in enumerate(
        (
            ("accelerometers", [imu.accel_latency for imu in record.imus]),
            ("gyroscopes", [i.gyro_latency for i in record.imus]),
        )
    ):
        traces.append(
            scatter(
                [f"{imu.name}" for imu in record.imus], rounded([1e3 * each.value for each in values]), "markers",
                name=name, marker={"color": (GOOD, BAD)[number], "symbol": SYMBOLS[number], "size": 9},
                error_y={
                    "type": "data", "array": rounded([1.96e3 * (each.standard_uncertainty or 0.0) for each in values]),
                    "color": (GOOD, BAD)[number],
                },
                hovertemplate=f"{name} of IMU %{{x}}: %{{y:.4f}} ms<extra></extra>",
            )
        )  # fmt: skip
    layout = {
        "xaxis": figure_axis("IMU", type="category"),
        "yaxis": figure_axis("latency, ms"),
        "legend": LEGEND,
        "margin": MARGIN,
    }
    caption = "How much later each triad answers than the gyroscopes of IMU 1; bars are 95 % intervals."
    return Figure("How late each IMU answers", caption, traces, layout)


def _residuals(record: ImusRecord, sensor: str) -> Figure:
    """Return the residuals in motion of one kind of sensor by stretches, with their noise at rest."""
    motion, accel = record.data.motion, sensor == "accel"
    values = np.array(motion.accel_residual if accel else np.degrees(motion.gyro_residual))
    unit, word = ("m/s²", "accelerometers") if accel else ("deg/s", "gyroscopes")
    noise = float(np.mean(record.accel_noise if accel else np.degrees(record.gyro_noise)))
    traces = [
        scatter(
            rounded(motion.time), rounded(values[:, k]), "lines+markers", name=f"IMU {imu.name}",
            line={"width": 1.2, "dash": DASHES[k % len(DASHES)]},
            marker={"size": 5, "symbol": SYMBOLS[k % len(SYMBOLS)]},
        )
        for k, imu in enumerate(record.imus)
    ]  # fmt: skip
    ends = [motion.time[0], motion.time[-1]]
    traces.append(
        scatter(ends, [noise, noise], "lines", name="at rest", line={"color": INK, "dash": "dot", "width": 1.2})
    )
    layout = {"xaxis": figure_axis(TIME), "yaxis": log_axis(f"rms, {unit}"), "legend": LEGEND, "margin": MARGIN}
    caption = (
        f"Readings of the {word} less those of the fitted board, rms of 20 stretches of the motion; dotted: noise at "
        "rest. Far above it, the IMUs are not read at one instant, or the board shakes faster than it is sampled."
    )
    return Figure(f"Residuals of the {word} in motion", caption, traces, layout)


def _cell(value: float, uncertainty: float | None, factor: float) -> str:
    text, u = format_uncertain(value * factor, None if uncertainty is None else uncertainty * factor)
    return f"{text} ± {u}" if uncertainty else text


def _three(values: Three, factor: float, nominal: float = 0.0) -> list[str]:
    return [_cell(v - nominal, u, factor) for v, u in zip(values.value, values.standard_uncertainty, strict=True)]


def _imus_tables(record: ImusRecord) -> list[ReportTable]:
    """Return where each IMU sits, how late it answers, and its errors; misalignments are in the record."""

    def table(title: str, caption: str, titles: Iterable[str], cells: Callable[[Imu], list[str]]) -> ReportTable:
        return ReportTable(title, caption, ["IMU", *titles], [[imu.name, *cells(imu)] for imu in record.imus])

    return [
        table(
            "Where each IMU sits",
            "Positions of the sensing elements from IMU 1, rotation vectors from its frame; standard uncertainties.",
            [f"{axis}, mm" for axis in "xyz"] + [f"rotation {axis}, deg" for axis in "xyz"],
            lambda imu: [*_three(imu.position, 1e3), *_three(imu.rotation, math.degrees(1))],
        ),
        table(
            "Latencies",
            "How much later each triad answers than the gyroscopes of IMU 1.",
            ["accelerometers, ms", "gyroscopes, ms"],
            lambda imu: [
                _cell(each.value, each.standard_uncertainty, 1e3) for each in (imu.accel_latency, imu.gyro_latency)
            ],
        ),
        table(
            "Biases",
            "Of each IMU, along its own axes.",
            [f"accel {axis}, mg" for axis in "xyz"] + [f"gyro {axis}, deg/s" for axis in "xyz"],
            lambda imu: [*_three(imu.accel.bias, 1e3 / STANDARD_GRAVITY), *_three(imu.gyro.bias, math.degrees(1))],
        ),
        table(
            "Scale factors",
            "Of each IMU, along its own axes, off nominal; misalignments are in the record.",
            [f"{sensor} {axis}, ppm" for sensor in ("accel", "gyro") for axis in "xyz"],
            lambda imu: [*_three(imu.accel.scale_factor, 1e6, 1.0), *_three(imu.gyro.scale_factor, 1e6, 1.0)],
        ),
    ]


def _ranges_table(record: ImusRecord) -> ReportTable:
    def cell(end: Above0 | None, factor: float) -> str:
        return "–" if end is None else plain_number(end.value * factor, 5)

    return ReportTable(
        "Ends of the ranges",
        "As stated, or as this recording reaches them; fusion bridges samples with a gyroscope there.",
        ["IMU", "accelerometers m/s²", "gyroscopes deg/s"],
        [[imu.name, cell(imu.accel_range, 1.0), cell(imu.gyro_range, math.degrees(1))] for imu in record.imus],
    )


def _size_table(record: ImusRecord) -> ReportTable:
    size = record.fit.size
    sources = (("gravity", size.gravity), ("stated", size.stated), ("gyro scale", size.gyro_scale))
    rows = [
        [
            ("* " if name == record.size_from else "") + _SOURCES[name],
            _cell(value.value, value.standard_uncertainty, 1.0),
        ]
        for name, value in sources
        if value is not None
    ]
    return ReportTable(
        "The size of the board",
        "What each source makes of the size of the board, as a factor on the one that was taken (*).",
        ["source", "factor"],
        rows,
    )
