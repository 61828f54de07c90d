"""The figures and tables of a record of a magnetometer alone, from the record."""

from __future__ import annotations

import numpy as np

from imulab.procedures.magnetometer.device import matrices, output_unit, surface_of
from imulab.procedures.magnetometer.schema import FieldModel, FieldReadings, FieldSummary, MagnetometerRecord
from imulab.procedures.magnetometer.solve import direction_rows
from imulab.records.calibration import Calibration
from imulab.records.sections import part
from imulab.report.parameters import parameters_table, rows_of
from imulab.report.traces import (
    AXIS_COLOURS,
    DASHES,
    GOOD,
    INK,
    LEGEND,
    QUIET,
    Exhibits,
    Figure,
    ReportTable,
    figure_axis,
    marker,
    plain_number,
    rounded,
    scatter,
)

_PLANES = (("x", "y"), ("y", "z"), ("z", "x"))


def exhibits(record: Calibration) -> Exhibits:
    """Return headline, facts, figures and tables of a record."""
    held = part(record, MagnetometerRecord)
    fit, model = held.fit, held.model
    how = "a level turn" if model.upright else "all directions"
    direction = plain_number(float(np.degrees(fit.direction.value)), 2)
    facts = [
        ("readings", str(fit.readings)),
        ("|m| scatters by", f"{plain_number(100 * fit.rms, 2)} %"),
        ("u(direction)", f"{direction} deg"),
        ("widest gap", f"{np.degrees(fit.widest_gap.value):.0f} deg"),
    ]
    headline = (
        f"The field of {fit.readings - fit.set_aside} readings of {how} has one magnitude within "
        f"{plain_number(100 * fit.rms, 2)} % rms; its direction is known to {direction} deg beside the rotation to the "
        "body, which is not told."
    )
    items: list[Figure | ReportTable] = [
        parameters_table(
            rows_of(record),
            "mag_bias: hard iron, the output without a field. mag_soft: symmetric matrix from the field to the output. "
            f"Not told: {', '.join(fit.not_told)}.",
        ),
        _sphere_figure(record, model, held.data),
        _residual_figure(held.data),
        _direction_figure(record, model, fit),
    ]
    return Exhibits(headline, facts, items)


def _residual_figure(data: FieldReadings) -> Figure:
    """Return |m| - 1 of the readings over time."""
    used = np.array(data.used)
    timed = data.time[0] is not None
    place = [t for t in data.time if t is not None] if timed else list(range(1, len(used) + 1))
    residual = 100 * np.array(data.magnitude)
    aside = int((~used).sum())
    return Figure(
        title="Magnitude of the field over the recording",
        message=f"|m| scatters by {np.sqrt(np.mean(residual[used] ** 2)):.2g} % rms of the field.",
        caption="|m| less the field's magnitude, in per cent, of some readings. A step is iron that came near, a bump "
        f"steel that passed by.{' Red diamonds were set aside.' if aside else ''}",
        traces=[
            scatter(rounded(np.array(place, dtype=float)), rounded(residual), "markers", marker=marker(~used, 5),
                    hovertemplate="%{x}<br>%{y:+.2f} %<extra></extra>"),
        ],
        layout={
            "xaxis": figure_axis("time, s" if timed else "reading"),
            "yaxis": figure_axis("|m|, %", zeroline=True),
            "showlegend": False,
        },
    )  # fmt: skip


def _sphere_figure(record: Calibration, model: FieldModel, data: FieldReadings) -> Figure:
    """Return the outputs, scaled alone, and the corrected field, in the planes of the axes."""
    hard, soft = matrices(record)
    size = float(np.cbrt(np.linalg.det(soft))) * model.field.value  # output per field of length 1
    before, offset = np.array(data.output) * output_unit(record) / size, float(np.linalg.norm(hard)) / size
    after = np.full_like(before, np.nan)
    after[:, ["xyz".index(axis) for axis in model.axes]] = data.field
    planes = [plane for plane in _PLANES if set(plane) <= set(model.axes)]
    circle = np.linspace(0, 2 * np.pi, 91)
    reach = 1.08 * max(1.0, float(np.abs(before[:, ["xyz".index(axis) for axis in model.axes]]).max()))
    traces, layout = [], {}
    for place, (first, second) in enumerate(planes):
        number = "" if place == 0 else str(place + 1)
        axes = {"xaxis": f"x{number}", "yaxis": f"y{number}", "showlegend": place == 0}
        i, j = "xyz".index(first), "xyz".index(second)
        traces += [
            scatter(rounded(np.cos(circle)), rounded(np.sin(circle)), "lines", line={"color": INK, "width": 1},
                    hoverinfo="skip", name="the field's magnitude", **axes),
            scatter(rounded(before[:, i]), rounded(before[:, j]), "markers", name="as measured",
                    marker={"color": QUIET, "symbol": "x", "size": 5}, **axes),
            scatter(rounded(after[:, i]), rounded(after[:, j]), "markers", name="corrected",
                    marker={"color": GOOD, "size": 4}, **axes),
        ]  # fmt: skip
        width = 0.26 if len(planes) > 1 else 0.6
        layout[f"xaxis{number}"] = figure_axis(
            first, domain=[0.37 * place, 0.37 * place + width], range=[-reach, reach], anchor=f"y{number}"
        )
        layout[f"yaxis{number}"] = figure_axis(
            second, range=[-reach, reach], anchor=f"x{number}", scaleanchor=f"x{number}"
        )
    return Figure(
        title="The field before and after",
        message=f"Hard iron moves the outputs by {offset:.2g} times the field; corrected, they lie on one "
        f"{'circle' if model.upright else 'sphere'}.",
        caption="Outputs in units of the field, as measured (scaled alone) and corrected. Points within the circle lie "
        "nearer to its axis, not nearer to its centre.",
        traces=traces,
        layout={**layout, "legend": LEGEND},
        height=430,
    )


def _direction_figure(record: Calibration, model: FieldModel, fit: FieldSummary) -> Figure:
    """Return the standard uncertainty of |m| by direction, along great circles through the axes."""
    axes, angle = model.axes, np.radians(np.arange(0, 361, 5))
    traces = []
    theta, covariance = surface_of(record)
    for k, (first, second) in enumerate(plane for plane in _PLANES if set(plane) <= set(axes)):
        directions = np.zeros((len(angle), len(axes)))
        directions[:, axes.index(first)], directions[:, axes.index(second)] = np.cos(angle), np.sin(angle)
        rows, _ = direction_rows(theta, directions)
        known = np.sqrt(np.einsum("np,pq,nq->n", rows, covariance, rows))
        traces.append(
            scatter(rounded(np.degrees(angle)), rounded(100 * known), "lines", name=f"{first} to {second}",
                    line={"color": AXIS_COLOURS[k], "dash": DASHES[k]},
                    hovertemplate="%{x} deg<br>%{y:.2g} %<extra></extra>")
        )  # fmt: skip
    return Figure(
        title="What the magnitude is known to in each direction",
        message=f"At worst {plain_number(100 * fit.largest_magnitude, 2)} % of the field, rms "
        f"{plain_number(100 * fit.magnitude, 2)} %.",
        caption="Standard uncertainty of |m| by the parameters, with the field in the plane of two axes, from the "
        "first towards the second. Peaks are directions that the turning left out.",
        traces=traces,
        layout={
            "xaxis": figure_axis("direction of the field, deg", dtick=90),
            "yaxis": figure_axis("u(|m|), %", rangemode="tozero"),
            "legend": LEGEND,
        },
    )
