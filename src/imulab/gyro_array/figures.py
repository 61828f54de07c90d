"""The figures and tables of an array's record, from the record alone: of a calibration, or of a comparison."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from imulab.calibration import Calibration
from imulab.exhibit import BAD, GOOD, INK, Exhibits, Figure, Table, format_uncertain, plain_number
from imulab.units import from_si

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
_ELEMENT_SHADES = ("#1f6f8b", "#c8553d", "#8e6bbd", "#c99a2e", "#4f9d69", "#2e4057", "#d081a5", "#6f7f3f")
_JUMPED, _STUCK, _NON_FINITE, _EXCLUDED = 8, 4, 1, 16


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    return _comparison(record) if record.model["kind"] == "comparison" else _calibration(record)


def _axis(title: str, **more: Any) -> dict[str, Any]:
    return {"title": {"text": title}, "zeroline": False, "gridcolor": "#e6eaed", **more}


def _log(title: str, **more: Any) -> dict[str, Any]:
    return _axis(title, type="log", dtick=1, exponentformat="none", **more)


def _of_axis(axis: str) -> str:
    return f", axis {axis}" if axis else ""


# ---- calibration ---------------------------------------------------------------------------------------------------


def _calibration(record: Calibration) -> Exhibits:
    elements, model = record.sections["elements"], record.model
    shared = record.sections["correlation"]
    limits = [_deg(limit["value"]) for limit in shared["limit"]]
    tau = shared["averaging_time"]["value"]
    spread = float(np.degrees(np.ptp(np.array([np.atleast_1d(e["bias"]["value"]) for e in elements]), axis=0)).max())
    worst = float(np.degrees(max(np.max(e["bias"]["standard_uncertainty"]) for e in elements)))
    facts = [
        ("elements", f"{model['elements']} × {len(model['axes'])} {'axes' if len(model['axes']) > 1 else 'axis'}"),
        ("at rest", f"{plain_number(record.fit['duration']['value'], 3)} s"),
        ("spread of biases", f"{plain_number(spread, 3)} deg/s"),
        ("worst u(bias)", f"{plain_number(worst, 2)} deg/s"),
        (f"limit at {tau:g} s", f"{plain_number(min(limits), 3)} deg/s"),
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
        f"weights would "
        f"bring {plain_number(single, 3)} deg/s of a single one at {tau:g} s down to "
        f"{plain_number(float(np.mean(limits)), 3)} deg/s.",
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
                value = float(np.atleast_1d(element[key]["value"])[a]) * factor
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
        caption="Value ± standard uncertainty. Bias is the plain mean at rest, the part that all share (Earth "
        "rate too) "
        "included. Angle random walk (ARW), bias instability and rate random walk (RRW) are read from the Allan curves "
        "below; 0 ± u means that the recording is too short or the "
        "effect too small to be seen.",
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
        caption=f"Rate = matrix (reading − bias); rows of the matrix are x, y, z. Gauge: {record.model['gauge']}. "
        "u: largest standard uncertainty of an entry. A residual far above the noise means errors that a matrix "
        "cannot hold "
        "(nonlinearity, timing, g-sensitivity).",
        columns=["element", "x", "y", "z", "u, 10⁻⁶", "residual, deg/s"],
        rows=rows,
    )


def _allan_elements(record: Calibration, a: int) -> Figure:
    traces = []
    for i, curve in enumerate(record.data["allan"][a]):
        traces.append(_curve(curve, record.sections["elements"][i]["name"], _ELEMENT_SHADES[i % 8], math.degrees(1)))
    return Figure(
        title=f"Allan deviation of each gyro{_of_axis(record.model['axes'][a])}",
        caption="Slope −1/2: angle random walk. Flat: bias instability. Slope +1/2: rate random walk. A curve "
        "apart from the "
        "others is a gyro apart from the others; the last points on the right are few averages.",
        traces=traces,
        layout={
            "xaxis": _log("averaging time, s"),
            "yaxis": _log("Allan deviation, deg/s"),
            "legend": {"orientation": "h", "y": 1.14},
        },
        height=400,
    )


def _curve(curve: dict[str, Any], name: str, colour: str, factor: float, width: float = 1.6) -> dict[str, Any]:
    known = [(t, d) for t, d in zip(curve["tau"], curve["deviation"], strict=True) if d > 0]
    return {
        "type": "scatter",
        "mode": "lines",
        "x": [t for t, _ in known],
        "y": [d * factor for _, d in known],
        "line": {"color": colour, "width": width},
        "name": name,
        "hovertemplate": f"{name}<br>%{{x:.3g}} s: %{{y:.3g}}<extra></extra>",
    }


def _correlation(record: Calibration, a: int) -> Figure:
    shared = record.sections["correlation"]
    names = [f"{record.model['axes'][a]} {e['name']}".strip() for e in record.sections["elements"]]
    matrix = np.array(shared["matrix"][a])
    text = [[f"{value:.2f}" for value in row] for row in matrix]
    noise = float(np.median(shared["standard_uncertainty"][a]))
    return Figure(
        title=f"Correlation of the noise{_of_axis(record.model['axes'][a])}",
        caption=f"At {shared['averaging_time']['value']:g} s, ± {noise:.2f} each. What all share, no weights "
        f"remove; a pair "
        "that goes together counts for less than two.",
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


# ---- comparison ----------------------------------------------------------------------------------------------------


def _comparison(record: Calibration) -> Exhibits:
    data, model = record.data, record.model
    found = {method: rows for method, rows in data["figures"].items() if not isinstance(rows, str)}
    best = found.get("robust") or found["mean"]
    name = "robust" if "robust" in found else "mean"
    unit = model["units"][0]
    reduction = float(np.mean([row["reduction"] for row in best]))
    facts = [
        ("gyros", f"{model['elements']} × {len(model['axes'])} {'axes' if len(model['axes']) > 1 else 'axis'}"),
        ("single gyro", f"{plain_number(float(np.mean(data['single'])), 3)} {unit}"),
        (name, f"{plain_number(float(np.mean([row['rate_std'] for row in best])), 3)} {unit}"),
        ("noise / limit", plain_number(float(np.mean([row["over_limit"] for row in best])), 3)),
        ("truth", "column" if model["truth"].startswith("column") else "still unit"),
        ("calibrated", "yes" if model["calibrated"] else "no"),
    ]
    items: list[Figure | Table] = [_methods_table(record, a) for a in range(len(model["axes"]))]
    for a in range(len(model["axes"])):
        items += [_allan_methods(record, a), _angles(record, a)]
        if data["health"]:
            items.append(_health(record, a))
    return Exhibits(
        headline=f"Fusing {model['elements']} gyros by {name} makes the rate {plain_number(reduction, 3)} "
        f"times quieter than "
        "the mean single gyro; "
        + (
            "the common bias was calibrated."
            if model["calibrated"]
            else "the bias that all share remains: calibrate it."
        ),
        facts=facts,
        items=items,
    )


def _methods_table(record: Calibration, a: int) -> Table:
    data, model = record.data, record.model
    unit = model["units"][a]
    angle, factor = _angle(unit)
    halves = any(not isinstance(rows, str) and rows[a]["split_half"] is not None for rows in data["figures"].values())
    rows, highlight = [], None
    for number, (method, found) in enumerate(data["figures"].items()):
        if method == "robust":
            highlight = number
        if isinstance(found, str):
            rows.append([method, *["–"] * (7 + halves)])
            continue
        row = found[a]
        split = [] if not halves else ["–" if row["split_half"] is None else plain_number(row["split_half"], 3)]
        rows.append(
            [
                method,
                plain_number(row["rate_std"], 3),
                plain_number(row["rate_max"], 3),
                plain_number(factor * row["angle_std"], 3),
                plain_number(factor * row["angle_max"], 3),
                plain_number(row["reduction"], 3),
                plain_number(row["over_limit"], 3),
                plain_number(row["bandwidth"], 3),
                *split,
            ]
        )
    return Table(
        title=f"Methods{_of_axis(model['axes'][a])}",
        caption=f"Rates in {unit}, angles in {angle}. Rate error (standard deviation with the mean removed) and "
        f"angle error "
        "against the truth; "
        "reduction of noise "
        "against the mean single gyro; noise from sample to sample over the limit of any fixed weights; "
        "bandwidth at −3 dB. "
        "Lower noise with less bandwidth is low-pass filtering. Split half: difference of the two halves of the array.",
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


def _angle(unit: str) -> tuple[str, float]:
    return {"deg/s": ("deg", 1.0), "rad/s": ("rad", 1.0), "deg/h": ("deg", 1 / 3600)}.get(unit, (f"{unit} s", 1.0))


def _width(method: str) -> float:
    return 3.0 if method == "robust" else 1.5


def _allan_methods(record: Calibration, a: int) -> Figure:
    unit = record.model["units"][a]
    curves = record.data["allan"]
    order = ["single gyro", *[m for m in curves if m not in ("single gyro", "robust")], "robust"]
    traces = [_curve(curves[m][a], m, _PALETTE[m], 1.0, _width(m)) for m in order if m in curves]
    return Figure(
        title=f"Allan deviation of each method{_of_axis(record.model['axes'][a])}",
        caption="On the left, how quiet a sample is: a curve that bends down there is low-pass filtered. On the "
        "right, what the "
        "angle drifts by: no weighting changes the bias that all gyros share.",
        traces=traces,
        layout={
            "xaxis": _log("averaging time, s"),
            "yaxis": _log(f"Allan deviation, {unit}"),
            "legend": {"orientation": "h", "y": 1.16},
        },
        height=430,
    )


def _angles(record: Calibration, a: int) -> Figure:
    angle, factor = _angle(record.model["units"][a])
    time = record.data["trace_time"]
    traces = [
        {
            "type": "scatter",
            "mode": "lines",
            "x": time,
            "y": [factor * value for value in rows[a]],
            "line": {"color": _PALETTE[method], "width": _width(method)},
            "name": method,
            "hovertemplate": f"{method}<br>%{{x:.4g}} s: %{{y:.4g}} {angle}<extra></extra>",
        }
        for method, rows in sorted(record.data["angle"].items(), key=lambda item: item[0] == "robust")
    ]
    return Figure(
        title=f"Angle error over time{_of_axis(record.model['axes'][a])}",
        caption="Integral of the rate error. A straight line is a bias; lines on top of each other differ in "
        "nothing that "
        "counts for an attitude.",
        traces=traces,
        layout={
            "xaxis": _axis("time, s"),
            "yaxis": _axis(f"angle error, {angle}"),
            "legend": {"orientation": "h", "y": 1.16},
        },
        height=400,
    )


def _health(record: Calibration, a: int) -> Figure:
    health = record.data["health"]
    names = record.data["readings_names"][a]
    weight = np.array(health["weight"])[:, a, :].T
    flags = np.array(health["flags"])[:, a, :]
    traces: list[dict[str, Any]] = [
        {
            "type": "heatmap",
            "x": health["time"],
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
        (_STUCK, "stuck", "square", BAD),
        (_NON_FINITE, "non-finite", "x", INK),
        (_JUMPED, "jumped", "triangle-up", "#c99a2e"),
    ):
        k, i = np.nonzero(flags & bit)
        if k.size:
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "x": [health["time"][index] for index in k],
                    "y": [names[index] for index in i],
                    "marker": {"symbol": symbol, "color": colour, "size": 7},
                    "name": label,
                    "hovertemplate": f"%{{y}} {label}, %{{x:.4g}} s<extra></extra>",
                }
            )
    return Figure(
        title=f"Weight and health of each gyro under robust{_of_axis(record.model['axes'][a])}",
        caption="Dark: counts for much. White: not in use. Marks: stuck, non-finite, or a bias that jumped and "
        "is being "
        "estimated again.",
        traces=traces,
        layout={
            "xaxis": _axis("time, s"),
            "yaxis": {"automargin": True, "autorange": "reversed"},
            "legend": {"orientation": "h", "y": 1.16},
        },
        height=max(260, 30 * len(names) + 120),
    )
