"""The figures and tables of a tumble record, from the record alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from imulab.estimation.distributions import probability_fact
from imulab.estimation.rows import median, quantile, rms
from imulab.procedures.tumble import record as engineering
from imulab.procedures.tumble.model import AXES
from imulab.procedures.tumble.orders import BLIND_SPOT
from imulab.procedures.tumble.schema import (
    DeviationTrace,
    HeldAttitudes,
    OrderBlend,
    OrderRow,
    PriorShares,
    Trials,
    TurnAside,
    TurnResiduals,
    attitudes_of,
    data_of,
    fit_of,
    gyro_of,
    mag_model_of,
    model_of,
)
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.parameters import micro_g, small_g
from imulab.report.traces import (
    ALARM,
    BAD,
    GOOD,
    INK,
    LEGEND,
    PLOT,
    QUIET,
    TIME,
    Exhibits,
    Figure,
    ReportTable,
    bulk,
    correlation_map,
    edge_marks,
    edge_note,
    figure_axis,
    format_uncertain,
    log_axis,
    plain_number,
    scatter,
    strongest_pair,
)
from imulab.units import from_si

# The attitudes of a tumble test on two equal-area maps of the sphere.


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


# The tables of a tumble record, from the record alone.


_MUCH_NARROWER = 1.5  # factor from which it is worth a line
_CLEARLY_BETTER = 0.9  # of the error of prediction of the order that was chosen
_AGREE = 10.0
"""Per cent by which the widths of two kinds of intervals may differ before it matters."""


def _basis(record: Calibration) -> str:
    """Say what the uncertainties rest on."""
    fit = fit_of(record)
    freedom = fit.freedom
    if fit.noise != "known" and freedom is None:
        return "As many parameters as attitudes: nothing tells the noise, and no uncertainty is stated."
    if fit.noise != "known":
        return f"Noise estimated from the residuals; Student's t with {freedom:.0f} degrees of freedom."
    if not fit.excess.value or freedom is None:
        return "Noise known from the attitudes' own scatter; normal quantiles."
    return (
        f"Noise known from the attitudes' own scatter, with {small_g(fit.excess.value)} more for each "
        f"attitude, as its residual makes plausible; Student's t with {freedom:.0f} effective degrees of freedom."
    )


def parameters_table(record: Calibration) -> ReportTable:
    """Return the parameters with their uncertainties."""
    fit, model = fit_of(record), model_of(record)
    factors = {False: fit.coverage_factor_95, True: None if fit.gyro is None else fit.gyro.coverage_factor_95}
    rows = []
    known = _with_order_known(record)
    for row in engineering.rows(record):
        factor = factors[row.name.startswith("gyro_")]
        value, uncertainty = row.text()
        interval = "not stated"
        if row.interval is not None and row.standard_uncertainty is not None:
            interval = " to ".join(format_uncertain(end, row.standard_uncertainty)[0] for end in row.interval)
        elif row.standard_uncertainty is not None and factor is not None:
            half = factor * row.standard_uncertainty
            interval = " to ".join(format_uncertain(row.value + s * half, row.standard_uncertainty)[0] for s in (-1, 1))
        order_known = "–" if row.given_order is None else format_uncertain(row.value, row.given_order)[1]
        order_cells = [order_known] if known else []
        rows.append([row.name, value, uncertainty, *order_cells, interval, row.unit])
    basis = _basis(record)
    if fit.blend is not None:
        basis += f" The standard uncertainty holds whatever the order is, up to {fit.blend.highest_order}"
        basis += f"; beside it what it would be if order {model.order} were known to be right." if known else "."
    turned = ""
    if fit.gyro is not None:
        turned = (
            f" Gyroscopes: M = S (T ω + b + G f), Student's t with {fit.gyro.degrees_of_freedom} degrees of freedom."
        )
    if fit.mag is not None:
        turned += (
            f" Magnetometers: the law of the accelerometers with the field m for f, T with six misalignments, outputs "
            f"renamed {mag_model_of(record).mag_axes}; Student's t."
        )
    return ReportTable(
        title="Parameters",
        caption=f"M = S (A + b), A = s + k2 s² + …, s = T f. {basis} Gauge: {model.gauge}.{turned}",
        columns=[
            "parameter",
            "value",
            "standard uncertainty",
            *([f"if order {model.order} is right"] if known else []),
            "95 % interval",
            "unit",
        ],
        rows=rows,
        message=_narrower(fit.blend),
    )


def _with_order_known(record: Calibration) -> bool:
    """Whether to show what the uncertainties of accelerometers alone would be with the order known: no larger ones."""
    fit = fit_of(record)
    return (
        fit.blend is not None
        and fit.gyro is None
        and fit.mag is None
        and all(
            p.standard_uncertainty_given_order <= (p.standard_uncertainty or 0.0)
            for p in record.parameters.values()
            if p.standard_uncertainty_given_order is not None
        )
    )


def _narrower(blended: OrderBlend | None) -> str:
    """Say which knowledge would narrow the uncertainties, and by how much, where it would."""
    if blended is None or blended.narrower is None:
        return ""
    gains = [
        f"{name.replace('_', ' ')} {ratio:.2g} times narrower"
        for name, ratio in blended.narrower.items()
        if ratio > _MUCH_NARROWER
    ]
    if not gains:
        return ""
    return f"If k2 and k3 are known to 20 µg/g² and 20 µg/g³: {', '.join(gains)} (--nonlinearity 20ug,20ug)."


def propagated_table(record: Calibration, trials: Trials) -> ReportTable:
    """Return the intervals by propagation of distributions beside the linear ones."""
    rows = engineering.propagated_rows(record, trials)
    failed = f", {trials.failed} more did not converge" if trials.failed else ""
    return ReportTable(
        title="Monte Carlo",
        message=_agreement(rows),
        caption=f"95 % intervals of {trials.trials} trials (JCGM 101{failed}) beside the linear ones. A ratio far "
        "from 1 means that the model is not linear over its own uncertainty: trust the trials then.",
        columns=["parameter", "linear", "Monte Carlo", "ratio of widths", "unit"],
        rows=rows,
    )


def _agreement(rows: list[list[str]]) -> str:
    """Say within what the linear and the Monte Carlo intervals agree."""
    if not rows:
        return ""
    name, *_, ratio, _ = max(rows, key=lambda row: abs(float(row[3]) - 1))
    percent = 100 * abs(float(ratio) - 1)
    apart = f"{plain_number(percent, 2)} % ({name})"
    if percent <= _AGREE:
        return f"The linear and the Monte Carlo intervals agree: their widths within {apart}."
    return (
        f"The linear and the Monte Carlo intervals differ: their widths by up to {apart}. Use the "
        "Monte Carlo intervals."
    )


def shares_table(prior: PriorShares) -> ReportTable:
    """Return what each parameter owes to the prior."""
    rows = [[name, f"{100 * share:.0f} %", f"{100 * (1 - share):.0f} %"] for name, share in prior.shares.items()]
    return ReportTable(
        title="Prior and data",
        caption=f"Where the knowledge of each parameter comes from: the prior (a record of {prior.created}) or "
        "these attitudes; variance now over that of the prior with what it aged since.",
        columns=["parameter", "from the prior", "from the data"],
        rows=rows,
    )


def orders_table(record: Calibration) -> ReportTable:
    """Return what the choice of the order rests on."""
    fit, chosen = fit_of(record), model_of(record).order
    rows, highlight = [], None
    for index, row in enumerate(fit.orders):
        if row.order == chosen:
            highlight = index
        rows.append(
            [
                str(row.order),
                str(row.parameters),
                plain_number(micro_g(row.rms), 4),
                plain_number(micro_g(row.leave_one_out), 4) if row.leave_one_out is not None else "–",
                probability_fact(row.f_probability) if row.f_probability is not None else "–",
                f"{row.bic:.1f}" if row.bic is not None else "–",
                plain_number(micro_g(row.largest_uncertainty), 3) if row.largest_uncertainty is not None else "–",
                plain_number(row.condition_number, 3),
                "yes" if row.observable else f"no, rank {row.rank} of {row.parameters}",
            ]
        )
    huber = " Rms of all attitudes, a down-weighted one by its weight." if fit.loss == "huber" else ""
    return ReportTable(
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
        message=_better_order(fit.orders, chosen),
    )


def _better_order(orders: Sequence[OrderRow], chosen: int) -> str:
    """Say which order predicts better, and is not taken because it leaves |f| uncertain somewhere."""
    errors = {row.order: row.leave_one_out for row in orders if row.observable and row.leave_one_out is not None}
    for row in sorted(orders, key=lambda each: errors.get(each.order, np.inf)):
        if row.order <= chosen or errors.get(row.order, np.inf) >= _CLEARLY_BETTER * errors.get(chosen, 0.0):
            continue
        if row.largest_uncertainty is not None and row.largest_uncertainty > BLIND_SPOT * orders[0].scatter:
            return (
                f"Order {row.order} predicts better here but leaves |f| uncertain by "
                f"{small_g(row.largest_uncertainty)} somewhere on the sphere: more attitudes would show it."
            )
    return ""


# The figures and tables of a tumble record, from the record alone.


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    fit, held, data = fit_of(record), data_of(record), attitudes_of(record)
    good = [weight >= ALARM for weight in data.down_weight]
    used = [value for value, ok in zip(data.residual, good, strict=True) if ok] or data.residual
    bad = len(good) - sum(good)
    left_out = fit.leave_one_out
    worst = _worst_scale_uncertainty(record)
    facts = [
        ("attitudes", str(len(good))),
        ("order", str(model_of(record).order)),
        (f"rms, {len(used)} of {len(good)}" if bad else "rms of |f| − g", small_g(rms(used))),
        ("leave-one-out", small_g(left_out.value) if left_out else "not computed"),
        ("scale factors known to", f"{plain_number(worst, 2)} ppm" if worst is not None else "not stated"),
        ("condition number", plain_number(fit.condition_number, 3)),
    ]
    items: list[Figure | ReportTable] = [_residuals(record), parameters_table(record)]
    if fit.monte_carlo is not None:
        items.append(propagated_table(record, fit.monte_carlo))
    if fit.prior is not None:
        items.append(shares_table(fit.prior))
    if fit.orders:
        items.append(orders_table(record))
    items.append(sphere_figure(record))
    if held.trace is not None:
        items.append(_trace(held.trace, data))
    if held.gyro is not None:
        items.append(_turns(held.gyro, gyro_of(record).set_aside))
    if record.covariance.names:
        items.append(_correlation(record))
    if held.mag is not None:
        from imulab.procedures.tumble.mag.figures import mag_facts, mag_figures

        items[1:1] = mag_figures(record)
        facts += mag_facts(record)
    aside = f"; {bad} more {'was' if bad == 1 else 'were'} {_exclusion_word(record)}" if bad else ""
    if fit.gyro is not None:
        aside += f"; {gyro_headline(record)}"
    if fit.mag is not None:
        from imulab.procedures.tumble.mag.figures import mag_headline

        aside += f"; {mag_headline(record)}"
    return Exhibits(
        headline=f"After calibration the specific force of {len(used)} attitudes has magnitude g within "
        f"{small_g(rms(used))} rms (before: {small_g(rms(data.residual_before))}){aside}.",
        facts=facts,
        items=items,
    )


def gyro_headline(record: Calibration) -> str:
    """Return the result for the gyroscope triad, without a point."""
    fit = gyro_of(record)
    missed = from_si(fit.rms.value, "deg")
    return f"{fit.turns} turns of the gyroscopes carry gravity's direction within {missed:.2g} deg rms"


def _exclusion_word(record: Calibration) -> str:
    return "set aside" if fit_of(record).set_aside else "down-weighted"


def _worst_scale_uncertainty(record: Calibration) -> float | None:
    scale_factors = [record.parameter(f"scale_factor_{axis}") for axis in AXES]
    relative = [
        1e6 * p.standard_uncertainty / abs(p.value) for p in scale_factors if p.standard_uncertainty and p.value
    ]
    return max(relative) if relative else None


def _residuals(record: Calibration) -> Figure:
    data = attitudes_of(record)
    number = list(range(1, len(data.residual) + 1))
    after = [micro_g(value) for value in data.residual]
    sigma = data.standard_uncertainty
    excess = fit_of(record).excess.value
    bars = None if sigma is None else [micro_g(float(np.hypot(value, excess))) for value in sigma]
    before = [micro_g(value) / 1e3 for value in data.residual_before]
    usual = np.array(data.down_weight) >= ALARM
    bad = len(number) - int(usual.sum())
    beyond = bulk(np.array(after), usual if usual.any() else None, median(np.array(bars)) if bars else 0.0, pixels=PLOT)
    marks = [] if beyond is None else edge_marks(beyond, np.array(after), number, [small_g(v) for v in data.residual])
    worst = int(np.argmax(np.where(usual, np.abs(after), -1.0)))
    scale = {} if beyond is None else {"range": [beyond.low, beyond.high]}
    return Figure(
        title="Residual |f| − g of each attitude",
        message=f"Before: {small_g(rms(data.residual_before))} rms. After: the largest of the attitudes that count "
        f"is {small_g(data.residual[worst])}, attitude {worst + 1}.",
        caption="Above, grey bars: with the nominal sensor (for counts and volts: the span of each axis). Below, "
        "points: calibrated"
        + ("; bars are one standard uncertainty of |f|" if bars else "")
        + (f"; {bad} {_exclusion_word(record)} in red, as diamonds" if bad else "")
        + ". f is the specific force, g local gravity, 1 µg = 9.8 µm/s². A pattern in the lower plot is an error that "
        "the model does not know." + edge_note(0 if beyond is None else int(beyond.beyond.sum())),
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
            _calibrated_points(data, after, bars),
            *marks,
        ],
        layout={
            "xaxis": figure_axis(
                "attitude", dtick=max(1, round(len(number) / 20)), range=[0.4, len(number) + 0.6], anchor="y"
            ),
            "yaxis": figure_axis("after, µg", domain=[0, 0.6]) | scale,
            "yaxis2": figure_axis("before, mg", domain=[0.68, 1]),
            "showlegend": False,
        },
        height=460,
    )


def _calibrated_points(data: HeldAttitudes, after: list[float], bars: list[float] | None) -> dict[str, Any]:
    """Return the residual of each attitude after calibration, µg, as a point, marked where it is held back."""
    colours = [BAD if weight < ALARM else GOOD for weight in data.down_weight]
    shapes = ["diamond" if weight < ALARM else "circle" for weight in data.down_weight]
    marker = {"color": colours, "size": 8, "symbol": shapes}
    trace = scatter(
        list(range(1, len(after) + 1)), after, "markers", marker=marker, xaxis="x", yaxis="y", text=data.label,
        name="after", hovertemplate="%{text}<br>%{y:.1f} µg<extra></extra>",
    )  # fmt: skip
    if bars is not None:
        trace["error_y"] = {"type": "data", "array": bars, "thickness": 1, "width": 2, "color": QUIET}
    return trace


def _trace(trace: DeviationTrace, data: HeldAttitudes) -> Figure:
    deviation = [max(float(from_si(value, "mg")), 1e-6) for value in trace.deviation]
    stretches = data.stretches
    rest = sum(stop - start for start, stop in stretches)
    whole = trace.time[-1] - trace.time[0]
    return Figure(
        title="Where the unit was at rest",
        message=f"{len(stretches)} stretches were used, {rest:.0f} s of {whole:.0f} s.",
        caption="Standard deviation within a sliding window (three axes together), the threshold below which the unit "
        "counts as at rest, and the stretches that were used (shaded), without their settling edges.",
        traces=[
            scatter(
                trace.time,
                deviation,
                "lines",
                line={"color": GOOD, "width": 1},
                name="windowed standard deviation",
                hovertemplate="%{x:.1f} s<br>%{y:.3g} mg<extra></extra>",
            ),
            scatter(
                [trace.time[0], trace.time[-1]],
                [float(from_si(trace.threshold, "mg"))] * 2,
                "lines",
                line={"color": BAD, "dash": "dash"},
                name="threshold",
                hoverinfo="skip",
            ),
        ],
        layout={
            "xaxis": figure_axis(TIME),
            "yaxis": log_axis("standard deviation, mg"),
            "legend": LEGEND,
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
                for (a, b), weight in zip(stretches, data.down_weight, strict=True)
            ],
        },
    )


def _turns(data: TurnResiduals, aside: list[TurnAside]) -> Figure:
    turns = [(a, b, miss, GOOD) for a, b, miss in zip(data.start, data.stop, data.residual, strict=True)]
    turns += [(turn.start, turn.stop, turn.miss.value, BAD) for turn in aside]
    turns.sort(key=lambda turn: turn[0])
    angle = [float(from_si(turn[2], "deg")) for turn in turns]
    number = list(range(1, len(angle) + 1))
    text = [f"{a:.1f} to {b:.1f} s" for a, b, *_ in turns]
    left = float(from_si(rms(data.residual), "deg"))
    beyond = bulk(np.array(angle), pixels=PLOT)
    marks = [] if beyond is None else edge_marks(beyond, np.array(angle), number, [f"{v:.3g} deg" for v in angle])
    return Figure(
        title="What the gyroscopes miss in each turn",
        message=f"Largest: {max(angle):.3g} deg, in turn {number[int(np.argmax(angle))]}; rms of those that count "
        f"{left:.3g} deg.",
        caption="Angle between the direction of gravity as the gyroscopes carry it and the one found after the turn. "
        "A few high bars: very fast turns, or a unit that moved while it was taken to be at rest."
        + (" Hatched and red: set aside." if aside else "")
        + edge_note(0 if beyond is None else int(beyond.beyond.sum())),
        traces=[
            {
                "type": "bar",
                "x": number,
                "y": angle,
                "marker": {
                    "color": [turn[3] for turn in turns] if aside else GOOD,
                    "pattern": {"shape": ["/" if turn[3] == BAD else "" for turn in turns]},
                },
                "text": text,
                "textposition": "none",
                "hovertemplate": "turn %{x}, %{text}<br>%{y:.3f} deg<extra></extra>",
            },
            *marks,
        ],
        layout={
            "xaxis": figure_axis("turn", dtick=max(1, round(len(number) / 20)), range=[0.4, len(number) + 0.6]),
            "yaxis": figure_axis("residual angle, deg", **({} if beyond is None else {"range": [0, beyond.high]})),
            "showlegend": False,
        },
        height=320,
    )


def _correlation(record: Calibration) -> Figure:
    matrix = record.covariance.array()
    sigma = np.sqrt(np.diag(matrix))
    correlation = matrix / np.outer(sigma, sigma)
    together = np.abs(correlation - np.eye(len(sigma))).max(axis=0) > 1e-12
    shown = together if together.any() else ~together  # those that go with no other would only take room
    correlation = correlation[np.ix_(shown, shown)]
    names = [name for name, is_shown in zip(record.covariance.names, shown.tolist(), strict=True) if is_shown]
    return correlation_map(
        title="Correlation of the parameters",
        message=f"The pair that is told apart least: {strongest_pair(correlation, names)}." if len(names) > 1 else "",
        caption="From −1 to +1, with numbers on hovering. Near 1 or −1 off the diagonal: two parameters that the data "
        "hardly tell apart, or whose uncertainty has a source in common (a table, a clock): their difference, or sum, "
        "is known better than either.",
        matrix=correlation,
        names=names,
        height=max(420, 26 * len(names) + 130),
    )
