"""The figures and tables of an array's record, from the record alone; those of a comparison in `compare_figures`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from imulab.procedures.gyro_array.compare_figures import exhibits_of_comparison
from imulab.procedures.gyro_array.traces import MARGIN, allan_trace, log_axis, of_axis
from imulab.records.calibration import Calibration
from imulab.report.elements import BAD, GOOD, LEGEND, Exhibits, Figure, Table, format_uncertain, plain_number
from imulab.units import from_si

_ELEMENT_SHADES = ("#1f6f8b", "#c8553d", "#8e6bbd", "#c99a2e", "#4f9d69", "#2e4057", "#d081a5", "#6f7f3f")


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    return exhibits_of_comparison(record) if record.model["kind"] == "comparison" else _calibration(record)


def _calibration(record: Calibration) -> Exhibits:
    elements, model = record.sections["elements"], record.model
    shared = record.sections["correlation"]
    limit = float(np.mean([_deg(limit["value"]) for limit in shared["limit"]]))
    tau = shared["averaging_time"]["value"]
    spread = float(np.degrees(np.ptp(np.array([np.atleast_1d(e["bias"]["value"]) for e in elements]), axis=0)).max())
    worst = float(np.degrees(max(np.max(e["bias"]["standard_uncertainty"]) for e in elements)))
    facts = [
        ("elements", f"{model['elements']} × {len(model['axes'])} {'axes' if len(model['axes']) > 1 else 'axis'}"),
        ("at rest", f"{plain_number(record.fit['duration']['value'], 3)} s"),
        ("spread of biases", f"{plain_number(spread, 3)} deg/s"),
        ("worst u(bias)", f"{plain_number(worst, 2)} deg/s"),
        (f"limit at {tau:g} s", f"{plain_number(limit, 3)} deg/s"),
        ("alignment", "from motion" if model["aligned"] else "not measured"),
    ]
    items: list[Figure | Table] = [_elements_table(record)]
    if model["aligned"] and len(model["axes"]) == 3:
        items.append(_matrix_table(record))
    items += [_allan_elements(record, a) for a in range(len(model["axes"]))]
    items += [_correlation(record, a) for a in range(len(model["axes"]))]
    single = _deg(float(np.mean([math.sqrt(c) for m in shared["covariance"] for c in np.diag(np.array(m))])))
    return Exhibits(
        headline=f"{model['elements']} gyros whose biases differ by up to {plain_number(spread, 3)} deg/s; best "
        f"weights would bring {plain_number(single, 3)} deg/s of a single one at {tau:g} s down to "
        f"{plain_number(limit, 3)} deg/s.",
        facts=facts,
        items=items,
    )


def _deg(value: float) -> float:
    return float(from_si(value, "deg/s"))


def _elements_table(record: Calibration) -> Table:
    rows = []
    one = len(record.model["axes"]) == 1
    for element in record.sections["elements"]:
        for a, axis in enumerate(record.model["axes"]):

            def text(key: str, factor: float, a: int = a, element: dict[str, Any] = element) -> str:
                found = np.atleast_1d(np.array(element[key]["value"], dtype=np.float64))[a]
                if math.isnan(found):
                    return "not determined"
                value = float(found) * factor
                u = float(np.atleast_1d(element[key]["standard_uncertainty"])[a]) * factor
                return " ± ".join(format_uncertain(value, u))

            scale = (
                " ± ".join(
                    format_uncertain(element["scale_factor"]["value"], element["scale_factor"]["standard_uncertainty"])
                )
                if one and "scale_factor" in element
                else None
            )
            rows.append(
                [
                    element["name"] if not axis else f"{axis} {element['name']}",
                    text("bias", 180 / math.pi),
                    *([scale] if scale else []),
                    text("angle_random_walk", 60 * 180 / math.pi),
                    text("bias_instability", 3600 * 180 / math.pi),
                    text("rate_random_walk", 3600 * 60 * 180 / math.pi),
                ]
            )
    scaled = one and record.model["aligned"]
    return Table(
        title="Elements",
        caption="Value ± standard uncertainty. Bias is the plain mean at rest, the part that all share (Earth rate "
        "too) included. Angle random walk (ARW), bias instability and rate random walk (RRW) are read from the Allan "
        "curves below; 0 ± u means that the recording is too short or the effect too small to be seen, not determined "
        "that the curve is not that of such noises (the warnings say why).",
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


def _matrix_table(record: Calibration) -> Table:
    rows = []
    for element in record.sections["elements"]:
        matrix, u = element["matrix"]["value"], element["matrix"]["standard_uncertainty"]
        cells = ["  ".join(f"{value:+.4f}" for value in row) for row in matrix]
        residual = max(_deg(v) for v in np.atleast_1d(element["residual"]["value"]))
        rows.append([element["name"], *cells, f"{1e6 * np.max(u):.0f}", plain_number(residual, 3)])
    return Table(
        title="Alignment",
        caption=f"Rate = matrix (reading − bias); rows of the matrix are x, y, z. Gauge: {record.model['gauge']}. u: "
        "largest standard uncertainty of an entry. A residual far above the noise means errors that a matrix cannot "
        "hold (nonlinearity, timing, g-sensitivity).",
        columns=["element", "x", "y", "z", "u, 10⁻⁶", "residual, deg/s"],
        rows=rows,
    )


def _allan_elements(record: Calibration, a: int) -> Figure:
    traces = []
    for i, curve in enumerate(record.data["allan"][a]):
        traces.append(
            allan_trace(
                curve, record.sections["elements"][i]["name"], _ELEMENT_SHADES[i % 8], math.degrees(1), number=i
            )
        )
    return Figure(
        title=f"Allan deviation of each gyro{of_axis(record.model['axes'][a])}",
        caption="Slope −1/2: angle random walk. Flat: bias instability. Slope +1/2: rate random walk. A curve apart "
        "from the others is a gyro apart from the others; the last points on the right are few averages.",
        traces=traces,
        layout={
            "xaxis": log_axis("averaging time, s"),
            "yaxis": log_axis("Allan deviation, deg/s"),
            "legend": LEGEND,
            "margin": MARGIN,
        },
        height=400,
    )


def _correlation(record: Calibration, a: int) -> Figure:
    shared = record.sections["correlation"]
    names = [f"{record.model['axes'][a]} {e['name']}".strip() for e in record.sections["elements"]]
    matrix = np.array(shared["matrix"][a])
    text = [[f"{value:.2f}" for value in row] for row in matrix]
    noise = float(np.median(shared["standard_uncertainty"][a]))
    off = np.where(np.eye(len(names), dtype=bool), 0.0, matrix)
    i, j = np.unravel_index(int(np.argmax(np.abs(off))), off.shape)
    return Figure(
        message=f"The pair that goes together most: {names[i]} and {names[j]}, {off[i, j]:+.2f}."
        if len(names) > 1
        else "",
        title=f"Correlation of the noise{of_axis(record.model['axes'][a])}",
        caption=f"At {shared['averaging_time']['value']:g} s, ± {noise:.2f} each. What all share, no weights remove; "
        "a pair that goes together counts for less than two.",
        traces=[
            {
                "type": "heatmap",
                "z": matrix.round(3).tolist(),
                "x": names,
                "y": names,
                "zmin": -1,
                "zmax": 1,
                "colorscale": [[0, GOOD], [0.5, "#ffffff"], [1, BAD]],
                "xgap": 1,
                "ygap": 1,
                "text": text,
                "texttemplate": "%{text}" if len(names) <= 12 else "",
                "colorbar": {"thickness": 12},
                "hovertemplate": "%{y}, %{x}: %{z:.2f}<extra></extra>",
            }
        ],
        layout={"xaxis": {"automargin": True}, "yaxis": {"autorange": "reversed", "automargin": True}},
        height=max(360, 28 * len(names) + 120),
    )
