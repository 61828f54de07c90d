"""The figures and tables of a tumble record, from the record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.calibration import Calibration
from imulab.exhibit import ALARM, BAD, GOOD, QUIET, Exhibits, Figure, Table, format_uncertain, plain_number
from imulab.tumble.engineering import engineering_rows, propagated_rows
from imulab.tumble.model import AXES
from imulab.tumble.sphere import sphere_figure
from imulab.units import from_si


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    fit, model, data = record.fit, record.model, record.data["attitudes"]
    good = [weight >= ALARM for weight in data["down_weight"]]
    used = [value for value, ok in zip(data["residual"], good, strict=True) if ok] or data["residual"]
    bad = len(good) - sum(good)
    left_out = fit.get("leave_one_out")
    worst = _worst_scale_uncertainty(record)
    facts = [
        ("attitudes", str(len(good))),
        ("order", str(model["order"])),
        (f"rms, {len(used)} of {len(good)}" if bad else "rms of |f| − g", small_g(_rms(used))),
        ("leave-one-out", small_g(left_out["value"]) if left_out else "not computed"),
        ("worst u(scale factor)", f"{plain_number(worst, 2)} ppm" if worst is not None else "not stated"),
        ("condition number", plain_number(fit["condition_number"], 3)),
    ]
    items: list[Figure | Table] = [_residuals(record), _parameters(record)]
    if "monte_carlo" in fit:
        items.append(_propagated(record))
    if "prior" in fit:
        items.append(_shares(record))
    if fit["orders"]:
        items.append(_orders(record))
    items.append(sphere_figure(record))
    if "trace" in record.data:
        items.append(_trace(record))
    if "gyro" in record.data:
        items.append(_turns(record))
    if record.covariance.names:
        items.append(_correlation(record))
    aside = f"; {bad} more {'was' if bad == 1 else 'were'} {_held_back(record)}" if bad else ""
    if "gyro" in fit:
        missed = from_si(fit["gyro"]["rms"]["value"], "deg")
        aside += (
            f"; {fit['gyro']['turns']} turns of the gyroscopes carry gravity's direction within {missed:.2g} deg rms"
        )
    return Exhibits(
        headline=f"After calibration the specific force of {len(used)} attitudes has magnitude g within "
        f"{small_g(_rms(used))} rms (before: {small_g(_rms(data['residual_before']))}){aside}.",
        facts=facts,
        items=items,
    )


def _held_back(record: Calibration) -> str:
    return "set aside" if record.fit.get("set_aside") else "down-weighted"


def small_g(value: float) -> str:
    """Return an acceleration in µg or mg, three significant digits."""
    micro = _micro_g(value)
    return (
        f"{micro:.3g} µg"
        if abs(micro) < 999.5
        else f"{micro / 1e3:.4g} mg"
        if abs(micro) < 1e6
        else f"{micro / 1e6:.3g} g"
    )


def _micro_g(value: float) -> float:
    return float(from_si(value, "ug"))


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _worst_scale_uncertainty(record: Calibration) -> float | None:
    found = [record.parameters[f"scale_factor_{axis}"] for axis in AXES]
    relative = [1e6 * p.standard_uncertainty / abs(p.value) for p in found if p.standard_uncertainty is not None]
    return max(relative) if relative else None


def _axis(title: str, **more: Any) -> dict[str, Any]:
    return {"title": {"text": title}, "zeroline": False, "gridcolor": "#e6eaed", **more}


def _residuals(record: Calibration) -> Figure:
    data = record.data["attitudes"]
    number = list(range(1, len(data["residual"]) + 1))
    after = [_micro_g(value) for value in data["residual"]]
    sigma = data["standard_uncertainty"]
    excess = record.fit["excess"]["value"]
    bars = None if sigma is None else [_micro_g(float(np.hypot(value, excess))) for value in sigma]
    colours = [BAD if weight < ALARM else GOOD for weight in data["down_weight"]]
    marker = {"color": colours, "size": 8}
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "markers",
        "x": number,
        "y": after,
        "marker": marker,
        "xaxis": "x",
        "yaxis": "y",
        "text": data["label"],
        "hovertemplate": "%{text}<br>%{y:.1f} µg<extra></extra>",
        "name": "after",
    }
    if bars is not None:
        trace["error_y"] = {"type": "data", "array": bars, "thickness": 1, "width": 2, "color": QUIET}
    before = [_micro_g(value) / 1e3 for value in data["residual_before"]]
    bad = sum(weight < ALARM for weight in data["down_weight"])
    span = _span([value for value, colour in zip(after, colours, strict=True) if colour == GOOD] or after, bars)
    return Figure(
        title="Residual |f| − g of each attitude",
        caption="Above: with the nominal sensor (for counts and volts: the span of each axis). Below: calibrated"
        + ("; bars are one standard uncertainty of |f|" if bars else "")
        + (f"; {bad} attitude{'s' if bad > 1 else ''} {_held_back(record)} in red" if bad else "")
        + ". A pattern in the lower plot is an error that the model does not know.",
        traces=[
            {
                "type": "bar",
                "x": number,
                "y": before,
                "marker": {"color": QUIET},
                "xaxis": "x",
                "yaxis": "y2",
                "hovertemplate": "attitude %{x}<br>%{y:.2f} mg<extra></extra>",
                "name": "before",
            },
            trace,
        ],
        layout={
            "xaxis": _axis(
                "attitude", dtick=max(1, round(len(number) / 20)), range=[0.4, len(number) + 0.6], anchor="y"
            ),
            "yaxis": _axis("after, µg", domain=[0, 0.6], range=[-span, span]),
            "yaxis2": _axis("before, mg", domain=[0.68, 1]),
            "showlegend": False,
            "annotations": [
                {
                    "x": x,
                    "y": span if y > 0 else -span,
                    "text": f"{y / 1e3:+.2f} mg",
                    "showarrow": True,
                    "ax": 34,
                    "ay": 14 if y > 0 else -14,
                    "arrowcolor": BAD,
                    "font": {"color": BAD},
                    "xref": "x",
                    "yref": "y",
                }
                for x, y in zip(number, after, strict=True)
                if abs(y) > span
            ],
        },
        height=460,
    )


def _span(values: list[float], bars: list[float] | None) -> float:
    """Half the height of the residual plot: what the attitudes that count need."""
    return 1.25 * (max(map(abs, values)) + (float(np.median(bars)) if bars else 0.0)) or 1.0


def _basis(record: Calibration) -> str:
    """Say what the uncertainties rest on."""
    fit = record.fit
    freedom = fit.get("effective_degrees_of_freedom", fit["degrees_of_freedom"])
    if fit["noise"] != "known" and freedom is None:
        return "As many parameters as attitudes: nothing tells the noise, and no uncertainty is stated."
    if fit["noise"] != "known":
        return f"Noise estimated from the residuals; Student's t with {freedom:.0f} degrees of freedom."
    if not fit["excess"]["value"] or freedom is None:
        return "Noise known from the attitudes' own scatter; normal quantiles."
    return (
        f"Noise known from the attitudes' own scatter, with {_micro_g(fit['excess']['value']):.3g} µg more for each "
        f"attitude, as its residual makes plausible; Student's t with {freedom:.0f} effective degrees of freedom."
    )


def _parameters(record: Calibration) -> Table:
    blend = record.fit.get("blend")
    factors = {False: record.fit["coverage_factor_95"], True: record.fit.get("gyro", {}).get("coverage_factor_95")}
    rows = []
    for row in engineering_rows(record):
        factor = factors[row.name.startswith("gyro_")]
        value, uncertainty = row.text()
        interval = "not stated"
        if row.standard_uncertainty is not None and factor is not None:
            half = factor * row.standard_uncertainty
            interval = " to ".join(format_uncertain(row.value + s * half, row.standard_uncertainty)[0] for s in (-1, 1))
        given = [] if blend is None else ["–" if row.given_order is None else f"{row.given_order:.2g}"]
        rows.append([row.name, value, uncertainty, *given, interval, row.unit])
    basis = _basis(record)
    if blend is not None:
        basis += (
            f" The standard uncertainty holds whatever the order is, up to {blend['highest_order']}; beside it what it "
            f"would be if order {record.model['order']} were known to be right."
        )
    turned = ""
    if "gyro" in record.fit:
        degrees = record.fit["gyro"]["degrees_of_freedom"]
        turned = f" Gyroscopes: M = S (T ω + b + G f), Student's t with {degrees} degrees of freedom."
    return Table(
        title="Parameters",
        caption=f"M = S (A + b), A = s + k2 s² + …, s = T f. {basis} Gauge: {record.model['gauge']}.{turned}",
        columns=[
            "parameter",
            "value",
            "standard uncertainty",
            *([] if blend is None else [f"if order {record.model['order']} is right"]),
            "95 % interval",
            "unit",
        ],
        rows=rows,
    )


def _propagated(record: Calibration) -> Table:
    trials = record.fit["monte_carlo"]
    failed = f", {trials['failed']} more did not converge" if trials["failed"] else ""
    return Table(
        title="Monte Carlo",
        caption=f"95 % intervals of {trials['trials']} trials (JCGM 101{failed}) beside the linear ones. A ratio far "
        "from 1 means that the model is not linear over its own uncertainty: trust the trials then.",
        columns=["parameter", "linear", "Monte Carlo", "ratio of widths", "unit"],
        rows=propagated_rows(record),
    )


def _shares(record: Calibration) -> Table:
    prior = record.fit["prior"]
    rows = [[name, f"{100 * share:.0f} %", f"{100 * (1 - share):.0f} %"] for name, share in prior["shares"].items()]
    return Table(
        title="Prior and data",
        caption=f"Where the knowledge of each parameter comes from: the prior (a record of {prior['created']}) or "
        "these attitudes; variance now over that of the prior with what it aged since.",
        columns=["parameter", "from the prior", "from the data"],
        rows=rows,
    )


def _orders(record: Calibration) -> Table:
    rows, highlight = [], None
    for index, row in enumerate(record.fit["orders"]):
        if row["order"] == record.model["order"]:
            highlight = index
        probability = row["f_probability"]
        rows.append(
            [
                str(row["order"]),
                str(row["parameters"]),
                plain_number(_micro_g(row["rms"]), 4),
                plain_number(_micro_g(row["leave_one_out"]), 4) if row["leave_one_out"] is not None else "–",
                f"{probability:.2g}" if probability is not None else "–",
                f"{row['bic']:.1f}" if row["bic"] is not None else "–",
                plain_number(_micro_g(predicted), 3)
                if (predicted := row.get("largest_uncertainty")) is not None
                else "–",
                plain_number(row["condition_number"], 3),
                "yes" if row["observable"] else f"no, rank {row['rank']} of {row['parameters']}",
            ]
        )
    huber = " Rms of all attitudes, a down-weighted one by its weight." if record.fit["loss"] == "huber" else ""
    return Table(
        title="Choice of the order",
        caption="A higher order fits closer (rms) whether it is right or not. It is taken only if it also predicts "
        "attitudes it has not seen better (leave-one-out), by more than the error of that comparison, if the F-test "
        "finds the gain significant, and if the attitudes can observe it: nowhere on the sphere may the predicted "
        f"uncertainty of |f| exceed 4 times the scatter at order 1.{huber}",
        columns=[
            "order",
            "parameters",
            "rms, µg",
            "leave-one-out, µg",
            "F-test p",
            "BIC",
            "largest u(|f|), µg",
            "condition",
            "observable",
        ],
        rows=rows,
        highlight=highlight,
    )


def _trace(record: Calibration) -> Figure:
    trace, data = record.data["trace"], record.data["attitudes"]
    deviation = [max(float(from_si(value, "mg")), 1e-6) for value in trace["deviation"]]
    return Figure(
        title="Where the unit was at rest",
        caption="Standard deviation within a sliding window (three axes together), the threshold below which the unit "
        "counts as at rest, and the stretches that were used (shaded), without their settling edges.",
        traces=[
            {
                "type": "scatter",
                "mode": "lines",
                "x": trace["time"],
                "y": deviation,
                "line": {"color": GOOD, "width": 1},
                "name": "windowed standard deviation",
                "hovertemplate": "%{x:.1f} s<br>%{y:.3g} mg<extra></extra>",
            },
            {
                "type": "scatter",
                "mode": "lines",
                "x": [trace["time"][0], trace["time"][-1]],
                "y": [float(from_si(trace["threshold"], "mg"))] * 2,
                "line": {"color": BAD, "dash": "dash"},
                "name": "threshold",
                "hoverinfo": "skip",
            },
        ],
        layout={
            "xaxis": _axis("time, s"),
            "yaxis": _axis("standard deviation, mg", type="log", dtick=1, exponentformat="none"),
            "legend": {"orientation": "h", "y": 1.12},
            "shapes": [
                {
                    "type": "rect",
                    "xref": "x",
                    "yref": "paper",
                    "x0": a,
                    "x1": b,
                    "y0": 0,
                    "y1": 1,
                    "fillcolor": GOOD if weight >= ALARM else BAD,
                    "opacity": 0.13,
                    "line": {"width": 0},
                }
                for a, b, weight in zip(data["start"], data["stop"], data["down_weight"], strict=True)
            ],
        },
    )


def _turns(record: Calibration) -> Figure:
    data = record.data["gyro"]
    aside = record.fit["gyro"].get("set_aside", [])
    turns = [(a, b, miss, GOOD) for a, b, miss in zip(data["start"], data["stop"], data["residual"], strict=True)]
    turns += [(turn["start"], turn["stop"], turn["miss"]["value"], BAD) for turn in aside]
    turns.sort(key=lambda turn: turn[0])
    angle = [float(from_si(turn[2], "deg")) for turn in turns]
    number = list(range(1, len(angle) + 1))
    text = [f"{a:.1f} to {b:.1f} s" for a, b, *_ in turns]
    rms = float(from_si(_rms(data["residual"]), "deg"))
    return Figure(
        title="What the gyroscopes miss in each turn",
        caption="Angle between the direction of gravity as the gyroscopes carry it and the one found after the turn, "
        f"rms {rms:.3g} deg. A few high bars: very fast turns, or a unit that moved while it was taken to be at rest."
        + (" Red: set aside." if aside else ""),
        traces=[
            {
                "type": "bar",
                "x": number,
                "y": angle,
                "marker": {"color": [turn[3] for turn in turns] if aside else GOOD},
                "text": text,
                "textposition": "none",
                "hovertemplate": "turn %{x}, %{text}<br>%{y:.3f} deg<extra></extra>",
            }
        ],
        layout={
            "xaxis": _axis("turn", dtick=max(1, round(len(number) / 20)), range=[0.4, len(number) + 0.6]),
            "yaxis": _axis("residual angle, deg"),
            "showlegend": False,
        },
        height=320,
    )


def _correlation(record: Calibration) -> Figure:
    matrix = record.covariance.array()
    sigma = np.sqrt(np.diag(matrix))
    correlation = matrix / np.outer(sigma, sigma)
    names = list(record.covariance.names)
    return Figure(
        title="Correlation of the parameters",
        caption="Far from white off the diagonal: two parameters that these attitudes hardly tell apart.",
        traces=[
            {
                "type": "heatmap",
                "z": correlation.round(3).tolist(),
                "x": names,
                "y": names,
                "zmin": -1,
                "zmax": 1,
                "colorscale": [[0, GOOD], [0.5, "#ffffff"], [1, BAD]],
                "xgap": 1,
                "ygap": 1,
                "colorbar": {"thickness": 12},
                "hovertemplate": "%{y}, %{x}: %{z:.2f}<extra></extra>",
            }
        ],
        layout={
            "xaxis": {"tickangle": -45, "automargin": True},
            "yaxis": {"autorange": "reversed", "automargin": True},
        },
        height=max(420, 26 * len(names) + 130),
    )
