"""The figures of a magnetometer triad, from the record alone."""

from __future__ import annotations

import numpy as np

from imulab.estimation.rows import rms
from imulab.procedures.tumble.mag.heading import read_law
from imulab.procedures.tumble.schema import MagFields, MagSummary, data_of, fit_of, mag_model_of, model_of
from imulab.records.calibration import Calibration
from imulab.report.traces import (
    GOOD,
    INK,
    LEGEND,
    QUIET,
    Figure,
    figure_axis,
    marker,
    number_axis,
    plain_number,
    rounded,
    scatter,
)

_AS_NAMED = "+x +y +z"
_LABEL = "%{text}<extra></extra>"
_PLANES = (("x", "y"), ("y", "z"), ("z", "x"))


def mag_headline(record: Calibration) -> str:
    """Return the result for the magnetometer triad as a sentence without its full stop."""
    fit = _read_fit(record)
    heading = np.degrees(fit.heading.standard_uncertainty.value)
    columns = mag_model_of(record).mag_axes
    turned = f"; mag_bias_x and all others are along body axes, whose x y z are the columns {columns}"
    return (
        f"the field of {fit.attitudes} attitudes has one magnitude within {100 * fit.magnitude.rms:.2g} % rms and one "
        f"dip within {np.degrees(fit.dip.rms):.2g} deg rms: magnetic heading is known to {heading:.2g} deg"
        f"{'' if columns == _AS_NAMED else turned}"
    )


def mag_facts(record: Calibration) -> list[tuple[str, str]]:
    """Return dip, leave-one-out error of |m|, and uncertainty of heading as facts."""
    fit = _read_fit(record)
    return [
        ("dip", f"{plain_number(float(np.degrees(record.value('dip'))), 4)} deg"),
        ("|m|, leave-one-out", f"{plain_number(100 * fit.magnitude.leave_one_out, 2)} %"),
        ("u(heading)", f"{plain_number(float(np.degrees(fit.heading.standard_uncertainty.value)), 2)} deg"),
    ]


def mag_figures(record: Calibration) -> list[Figure]:
    """Return residuals of |m| and dip, the sphere before and after, and the uncertainty of heading by attitude."""
    data = data_of(record).mag
    assert data is not None
    return [_residual_figure(data), _sphere_figure(record, data), _heading_figure(record, data)]


def _read_fit(record: Calibration) -> MagSummary:
    fit = fit_of(record).mag
    assert fit is not None
    return fit


def _residual_figure(data: MagFields) -> Figure:
    """Return the residuals of |m| and dip of each attitude, those set aside as red diamonds."""
    magnitude, dip = 100 * np.array(data.magnitude), np.degrees(data.dip)
    used = np.array(data.used)
    worst = int(np.argmax(np.where(used, np.abs(dip), -1.0)))
    disturbed = [label for label, kept in zip(data.label, data.used, strict=True) if not kept]
    aside = f" Red diamonds were set aside as disturbed: {', '.join(disturbed)}." if disturbed else ""
    look = {"marker": marker(~used, 8), "text": data.label, "xaxis": "x"}
    return Figure(
        title="Residual magnitude and dip of each attitude",
        message=f"The dip of attitude {data.number[worst]} is off most: {dip[worst]:+.2g} deg; rms "
        f"{rms(dip[used]):.2g} deg, and {rms(magnitude[used]):.2g} % of the field.",
        caption="Above: |m| less the field's magnitude, in per cent. Below: dip of each attitude less the common dip. "
        f"A disturbance such as iron near shows in both, a unit that moved in the dip alone.{aside}",
        traces=[
            scatter(data.number, rounded(magnitude), "markers", **look, yaxis="y2", name="|m|",
                    hovertemplate="%{text}<br>%{y:+.2f} %<extra></extra>"),
            scatter(data.number, rounded(dip), "markers", **look, yaxis="y", name="dip",
                    hovertemplate="%{text}<br>%{y:+.2f} deg<extra></extra>"),
        ],
        layout={
            "xaxis": number_axis("attitude", data.number, anchor="y"),
            "yaxis": figure_axis("dip, deg", domain=[0, 0.46], zeroline=True),
            "yaxis2": figure_axis("|m|, %", domain=[0.54, 1], zeroline=True),
            "showlegend": False,
        },
        height=460,
    )  # fmt: skip


def _sphere_figure(record: Calibration, data: MagFields) -> Figure:
    """Return the outputs, scaled and renamed alone, and the calibrated field in three planes."""
    from imulab.procedures.tumble.device import mag_axes

    output = np.array(data.mean) @ mag_axes(mag_model_of(record).mag_axes).T
    scale = abs(np.array([record.value(f"mag_scale_factor_{a}") for a in "xyz"])).mean()
    length = record.model["field"]["value"]
    before, after = output / scale / length, np.array(data.field)
    circle = np.linspace(0, 2 * np.pi, 91)
    reach = 1.08 * max(1.0, float(np.abs(before).max()))
    traces, layout = [], {}
    for place, (first, second) in enumerate(_PLANES):
        number = "" if place == 0 else str(place + 1)
        axes = {"xaxis": f"x{number}", "yaxis": f"y{number}"}
        i, j = "xyz".index(first), "xyz".index(second)
        shown = place == 0
        traces += [
            scatter(rounded(np.cos(circle)), rounded(np.sin(circle)), "lines", line={"color": INK, "width": 1},
                    hoverinfo="skip", name="the field's magnitude", showlegend=shown, **axes),
            scatter(rounded(before[:, i]), rounded(before[:, j]), "markers", name="as measured", showlegend=shown,
                    marker={"color": QUIET, "symbol": "x", "size": 7}, text=data.label, hovertemplate=_LABEL, **axes),
            scatter(rounded(after[:, i]), rounded(after[:, j]), "markers", name="calibrated", showlegend=shown,
                    marker={"color": GOOD, "size": 7}, text=data.label, hovertemplate=_LABEL, **axes),
        ]  # fmt: skip
        span = [0.36 * place, 0.36 * place + 0.28]
        layout[f"xaxis{number}"] = figure_axis(first, domain=span, range=[-reach, reach], anchor=f"y{number}")
        layout[f"yaxis{number}"] = figure_axis(
            second, range=[-reach, reach], anchor=f"x{number}", scaleanchor=f"x{number}"
        )
    offset = float(np.linalg.norm([record.value(f"mag_bias_{a}") for a in "xyz"]) / length)
    return Figure(
        title="The field before and after",
        message=f"Hard iron moves the outputs by {offset:.2g} times the field; calibrated, all lie on a sphere.",
        caption="Outputs of the attitudes in three planes, in units of the field: as measured (scaled alone), and "
        "calibrated in the accelerometers' frame. Points within the circle lie nearer to its axis, not nearer to its "
        "centre.",
        traces=traces,
        layout={**layout, "legend": LEGEND},
        height=430,
    )


def _heading_figure(record: Calibration, data: MagFields) -> Figure:
    """Return the uncertainty of heading in each attitude, by the parameters and of one reading."""
    length, gravity = float(record.model["field"]["value"]), model_of(record).gravity.value
    known, reading = read_law(record).horizontal_uncertainty(
        gravity * np.array(data.force), length * np.array(data.field)
    )
    known, reading = np.degrees(known), np.degrees(reading)
    worst = int(np.argmax(known))
    shared = {"text": data.label, "hovertemplate": "%{text}<br>%{y:.2g} deg<extra></extra>"}
    return Figure(
        title="What heading is known to in each attitude",
        message=f"By the parameters within {rms(known):.2g} deg rms, {known[worst]:.2g} deg in attitude "
        f"{data.number[worst]} at worst; one reading within {rms(reading):.2g} deg.",
        caption="Standard uncertainty of magnetic heading with the unit in that attitude: what the parameters leave "
        "open, common to all readings there, and with the scatter of |m| and f, that of one reading. Where the two are "
        "alike, more readings do not help.",
        traces=[
            scatter(data.number, rounded(reading), "markers", name="one reading",
                    marker={"color": QUIET, "symbol": "circle-open", "size": 8}, **shared),
            scatter(data.number, rounded(known), "markers", name="by the parameters",
                    marker={"color": GOOD, "size": 8}, **shared),
        ],
        layout={
            "xaxis": number_axis("attitude", data.number),
            "yaxis": figure_axis("u(heading), deg", rangemode="tozero"),
            "legend": LEGEND,
        },
        height=330,
    )  # fmt: skip
