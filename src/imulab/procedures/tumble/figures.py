"""The figures and tables of a tumble record, from the record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.estimation.ranked import median, rms
from imulab.procedures.tumble.engineering import micro_g, small_g
from imulab.procedures.tumble.mag.figures import mag_facts, mag_figures, mag_headline
from imulab.procedures.tumble.model import AXES
from imulab.procedures.tumble.sections import (
    HeldAttitudes,
    Trace,
    TurnAside,
    Turns,
    attitudes_of,
    data_of,
    fit_of,
    gyro_of,
    model_of,
)
from imulab.procedures.tumble.sphere import sphere_figure
from imulab.procedures.tumble.tables import orders_table, parameters_table, propagated_table, shares_table
from imulab.records.calibration import Calibration
from imulab.report.bulk import bulk, edge_marks, edge_note
from imulab.report.elements import ALARM, BAD, GOOD, LEGEND, QUIET, Exhibits, Figure, ReportTable, plain_number
from imulab.report.traces import axis, correlation_map, log_axis, scatter, strongest_pair
from imulab.units import from_si


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
        ("worst u(scale factor)", f"{plain_number(worst, 2)} ppm" if worst is not None else "not stated"),
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
        items[1:1] = mag_figures(record)
        facts += mag_facts(record)
    aside = f"; {bad} more {'was' if bad == 1 else 'were'} {_held_back(record)}" if bad else ""
    if fit.gyro is not None:
        aside += f"; {gyro_headline(record)}"
    if fit.mag is not None:
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


def _held_back(record: Calibration) -> str:
    return "set aside" if fit_of(record).set_aside else "down-weighted"


def _worst_scale_uncertainty(record: Calibration) -> float | None:
    found = [record.parameter(f"scale_factor_{axis}") for axis in AXES]
    relative = [1e6 * p.standard_uncertainty / abs(p.value) for p in found if p.standard_uncertainty and p.value]
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
    beyond = bulk(np.array(after), usual if usual.any() else None, median(np.array(bars)) if bars else 0.0)
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
        + (f"; {bad} {_held_back(record)} in red, as diamonds" if bad else "")
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
            "xaxis": axis(
                "attitude", dtick=max(1, round(len(number) / 20)), range=[0.4, len(number) + 0.6], anchor="y"
            ),
            "yaxis": axis("after, µg", domain=[0, 0.6]) | scale,
            "yaxis2": axis("before, mg", domain=[0.68, 1]),
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


def _trace(trace: Trace, data: HeldAttitudes) -> Figure:
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
            "xaxis": axis("time, s"),
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


def _turns(data: Turns, aside: list[TurnAside]) -> Figure:
    turns = [(a, b, miss, GOOD) for a, b, miss in zip(data.start, data.stop, data.residual, strict=True)]
    turns += [(turn.start, turn.stop, turn.miss.value, BAD) for turn in aside]
    turns.sort(key=lambda turn: turn[0])
    angle = [float(from_si(turn[2], "deg")) for turn in turns]
    number = list(range(1, len(angle) + 1))
    text = [f"{a:.1f} to {b:.1f} s" for a, b, *_ in turns]
    left = float(from_si(rms(data.residual), "deg"))
    beyond = bulk(np.array(angle))
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
            "xaxis": axis("turn", dtick=max(1, round(len(number) / 20)), range=[0.4, len(number) + 0.6]),
            "yaxis": axis("residual angle, deg", **({} if beyond is None else {"range": [0, beyond.high]})),
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
    names = [name for name, one in zip(record.covariance.names, shown.tolist(), strict=True) if one]
    return Figure(
        title="Correlation of the parameters",
        message=f"The pair that is told apart least: {strongest_pair(correlation, names)}." if len(names) > 1 else "",
        caption="From −1 to +1, with numbers on hovering. Near 1 or −1 off the diagonal: two parameters that the data "
        "hardly tell apart, or whose uncertainty has a source in common (a table, a clock): their difference, or sum, "
        "is known better than either.",
        traces=[correlation_map(correlation, names)],
        layout={
            "xaxis": {"tickangle": -45, "automargin": True},
            "yaxis": {"autorange": "reversed", "automargin": True},
        },
        height=max(420, 26 * len(names) + 130),
    )
