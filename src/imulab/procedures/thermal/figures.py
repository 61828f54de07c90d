"""What a thermal record shows: each parameter over temperature with its band, laws, and gyroscopes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imulab.procedures.thermal.degrees import moved, spoken_degrees
from imulab.procedures.thermal.model import AXES, GROUPS
from imulab.procedures.thermal.record import deviation_of_force, gyro_predicted, gyro_scale_predicted, predicted
from imulab.procedures.thermal.schema import ThermalRecord, thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.parameters import parameters_table, rows_of
from imulab.report.traces import (
    BAD,
    DASHES,
    GOOD,
    INK,
    LEGEND,
    Exhibits,
    Figure,
    ReportTable,
    band,
    figure_axis,
    format_uncertain,
    plain_number,
    rounded,
    scatter,
)
from imulab.units import STANDARD_GRAVITY, from_si

# Laws over temperature as figures: the curves, and beneath them how well they are known and what lies off them.


COLOURS = (GOOD, "#b58a1b", "#7a5c99")
SYMBOLS = ("circle", "diamond", "square")
_UPPER, _LOWER = [0.5, 1.0], [0.0, 0.38]
"""Shares of the figure's height."""


@dataclass(frozen=True)
class LawCurves:
    """Three laws in the unit of their figure: names, temperatures, degC (n,), values and their u, (3, n)."""

    names: tuple[str, ...]
    temperature: Array
    values: Array
    standard_uncertainty: Array


@dataclass(frozen=True)
class Alone:
    """What recordings give alone in the same unit: temperatures, degC (m,), values, the laws there and u, (3, m)."""

    temperature: Array
    values: Array
    laws: Array
    standard_uncertainty: Array | None = None


def law_figure(
    title: str, what: str, unit: str, curves: LawCurves, alone: Alone | None, *, read: str, at_middle: str = ""
) -> Figure:
    """Return the figure of three laws.

    Parameters
    ----------
    what, unit
        Of the laws' axis.
    read
        How to read band and points.
    at_middle
        The values in the middle of the range, in words: the laws are then drawn as changes from these.
    """
    temperature, reach = curves.temperature, 2 * curves.standard_uncertainty
    middle = len(temperature) // 2
    zero = curves.values[:, middle] if at_middle else np.zeros(len(curves.names))
    beneath: dict[str, Any] = {"yaxis": "y2", "showlegend": False}
    traces = []
    for k, name in enumerate(curves.names):
        line = {"color": COLOURS[k], "dash": DASHES[k]}
        around = band(temperature, -reach[k], reach[k], COLOURS[k], **beneath) | {"line": line | {"width": 1}}
        traces += [
            scatter(rounded(temperature), rounded(curves.values[k] - zero[k]), "lines", name=name, line=line),
            around,
        ]
        if alone is not None:
            u = None if alone.standard_uncertainty is None else 2 * alone.standard_uncertainty[k]
            traces += [
                own_points(alone.temperature, alone.values[k] - zero[k], None, k, name),
                own_points(alone.temperature, alone.values[k] - alone.laws[k], u, k, name) | beneath,
            ]
    message = (
        f"The laws are known to {plain_number(float(reach.max()), 2)} {unit} or better (two standard uncertainties)"
    )
    if alone is not None:
        off = plain_number(float(np.abs(alone.values - alone.laws).max()), 2)
        message += f"; what recordings give alone is up to {off} {unit} off them"
    changes = f" Change from the value at {temperature[middle]:.3g} degC: {at_middle}." if at_middle else ""
    plain = {"exponentformat": "none", "automargin": True}
    return Figure(
        title=title,
        message=f"{message}.",
        caption=f"Above: the laws. Beneath: what is off them, and bands of two standard uncertainties, {read}{changes}",
        traces=traces,
        layout={
            "xaxis": figure_axis("temperature, degC", anchor="y2"),
            "yaxis": figure_axis(f"{what}, {unit}", domain=_UPPER, **plain),
            "yaxis2": figure_axis(f"off the law, {unit}", domain=_LOWER, **plain),
            "legend": LEGEND,
        },
        height=560,
    )


def power_cycles(known_from: str) -> str:
    """Return what bands hold of the scatter between power cycles, known by a record's ``between_recordings.from``."""
    if known_from == "unknown":
        return "without what power cycles add, which is not known."
    return "what power cycles differ by included."


def values_at_middle(record: Calibration, names: Sequence[str]) -> str:
    """Return coefficients of a record in words: as those of powers of T - T0 they are values in the middle."""
    by_name = {row.name: row for row in rows_of(record)}
    rows = [by_name[name] for name in names]
    each = (f"{row.name[-2:].lstrip('_')} {format_uncertain(row.value, row.standard_uncertainty)[0]}" for row in rows)
    return f"{', '.join(each)} {rows[0].unit}"


def own_points(temperature: Array, values: Array, reach: Array | None, axis: int, label: str) -> dict[str, Any]:
    """Return the values of single recordings as points with bars, beside the law of an axis."""
    bars = {} if reach is None else {
        "error_y": {"type": "data", "array": rounded(np.abs(reach)), "thickness": 1, "color": COLOURS[axis]}
    }  # fmt: skip
    marker = {"symbol": SYMBOLS[axis], "color": COLOURS[axis], "size": 7}
    return scatter(
        rounded(temperature), rounded(values), "markers", name=f"{label} alone", showlegend=False, marker=marker, **bars
    )


# What a thermal record shows of its gyroscopes: their biases over temperature with the band, and what is left.


def gyro_exhibits(record: Calibration, temperature: Array) -> tuple[list[tuple[str, str]], list[Figure]]:
    """Return the facts and figures of the gyroscopes of a record over temperatures, degC."""
    thermal = thermal_of(record)
    fit, data = thermal.fit.gyro, thermal.data.gyro
    assert fit is not None
    assert data is not None
    values, spread = (from_si(each, "deg/s") for each in gyro_predicted(record, temperature))
    tau = fit.between_recordings
    words = f"{plain_number(_hourly(tau.bias.value), 2)} deg/h"
    words = {"unknown": "not known", "polynomials": f"at most {words}"}.get(tau.from_, f"{words} ({tau.from_})")
    left = fit.left_out_temperature
    worst = f"{plain_number(_hourly(max(row.rms for row in left)), 2)} deg/h rms at worst" if left else "–"
    facts = [
        ("gyroscope biases", f"known to {plain_number(float(spread.max()) * 3600, 2)} deg/h or better"),
        ("gyroscope biases, power cycle to power cycle", words),
        ("gyroscope biases at left-out temperatures", worst),
    ]
    if fit.turns is not None:
        turns = f"{fit.turns.turns}, missed by {plain_number(np.degrees(fit.turns.rms.value), 2)} deg rms"
        facts.append(("turns", turns))
        if not thermal.model.gyro_laws.degrees[1]:
            # A law that nothing could bend is no figure over temperature.
            scale, u = gyro_scale_predicted(record, temperature)
            known = plain_number(1e6 * float((u / np.abs(scale)).max()), 2)
            words = f"known to {known} ppm where the turns were, and taken as the same at all temperatures"
            facts.append(("gyroscope scale factors", words))
    residual = from_si(np.array(data.residual), "deg/h")
    points = [
        scatter(rounded(np.array(data.temperature)), rounded(residual[:, k], 4), "markers", name=name,
                marker={"symbol": SYMBOLS[k], "color": COLOURS[k], "size": 7})
        for k, name in enumerate(AXES)
    ]  # fmt: skip
    place = figure_axis("temperature, degC")
    figures = [
        law_figure(
            "Bias of the gyroscopes over temperature",
            "bias",
            "deg/s",
            LawCurves(AXES, temperature, values, spread),
            _recordings(record),
            read=power_cycles(tau.from_) + " Points: the mean of each recording that stayed at its temperature.",
        ),
        Figure(
            title="What the laws leave of the gyroscopes at rest",
            caption="Law less output of each hold. A recording whose points lie together away from zero is a power "
            "cycle whose biases are offset; within it they scatter by noise, the Earth's rate (15 deg/h) and drift.",
            traces=points,
            layout={"xaxis": place, "yaxis": figure_axis("law less output, deg/h"), "legend": LEGEND},
        ),
    ]
    if fit.turns is not None and thermal.model.gyro_laws.degrees[1]:
        figures.insert(1, _scale_factors(record, temperature, fit.turns.recordings))
    return facts, figures


def _recordings(record: Calibration) -> Alone | None:
    """Return the mean bias of each recording that stayed at its temperature, deg/s; None where there are none."""
    data = thermal_of(record).data.gyro
    assert data is not None
    steady = np.array(data.rate) == 0
    names, index = np.unique(np.array(data.recording)[steady], return_inverse=True)
    if not len(names):
        return None
    at = np.array(data.temperature)[steady]
    laws = gyro_predicted(record, at)[0]
    values = laws - np.array(data.residual).reshape(-1, 3)[steady].T
    mean = np.array([np.bincount(index, weights=each) for each in (at, *values, *laws)]) / np.bincount(index)
    return Alone(mean[0], from_si(mean[1:4], "deg/s"), from_si(mean[4:], "deg/s"))


def _scale_factors(record: Calibration, temperature: Array, recordings: int) -> Figure:
    values, spread = gyro_scale_predicted(record, temperature)
    factors = 1e6 / np.abs(values[:, [len(temperature) // 2]])
    return law_figure(
        "Scale factor of the gyroscopes over temperature",
        "scale factor",
        "ppm",
        LawCurves(AXES, temperature, factors * values, factors * spread),
        None,
        read=f"from turns in {recordings} recordings.",
        at_middle=values_at_middle(record, [f"gyro_scale_factor_{axis}" for axis in AXES]),
    )


def _hourly(rate: float) -> float:
    return float(from_si(rate, "deg/h"))


# What a thermal record shows: each parameter over temperature with its band, what is left, and how it predicts.


_POINTS = 81  # of a curve
_POINTS_DRAWN_ALONE, _PARTS, _FEWEST = 60, 9, 3
"""Holds whose bars hide one another; the parts that they are averaged in, an odd number, since a soak in the middle is
not to be parted; and the fewest of one."""
_READ = (
    ("bias", 1e3 / STANDARD_GRAVITY, "mg"),
    ("scale factor", 1e6, "ppm"),
    ("misalignment", 1e3, "mrad"),
)
_MICRO_G = 1e6 / STANDARD_GRAVITY  # to µg


def exhibits(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record."""
    thermal = thermal_of(record)
    low, high = thermal.model.range
    temperature = np.linspace(low, high, _POINTS)
    _, spread = predicted(record, temperature)
    fit = thermal.fit
    worst = float(spread[:3].max()) * _MICRO_G
    laws, rms = thermal.model.laws, plain_number(fit.rms.value * _MICRO_G, 3)
    kind = "degrees " + ", ".join(map(str, laws.degrees))
    if laws.knots:
        kind = spoken_degrees(laws.degrees, len(laws.knots))
    headline = (
        f"{low:.0f} to {high:.0f} degC, {kind}: |f| - g is {rms} µg rms over {fit.holds} holds; "
        f"biases are known to {plain_number(worst, 2)} µg or better."
    )
    tau = fit.between_recordings
    words = f"{plain_number(tau.bias.value * _MICRO_G, 2)} µg"
    words = {
        "unknown": "not known",
        "polynomials": f"at most {words}",
    }.get(tau.from_, f"{words} ({tau.from_})")
    facts = [
        ("recordings", str(fit.recordings)),
        ("temperatures", str(fit.temperatures)),
        ("biases, power cycle to power cycle", words),
        ("left-out temperatures", _left(thermal)),
        *_drift(thermal),
    ]
    items: list[Figure | ReportTable] = [
        _coefficients(record),
        *(_over_temperature(k, record, temperature) for k in range(3)),
        _of_force(record, thermal, temperature),
        _residuals(thermal),
    ]
    if thermal.model.gyro is not None:
        gyro_facts, gyro_items = gyro_exhibits(record, temperature)
        facts += gyro_facts
        items += gyro_items
    if fit.left_out_temperature:
        items.append(_predicted(thermal))
    if fit.degrees:
        items.append(_compared(thermal))
    return Exhibits(headline, facts, items)


def _drift(thermal: ThermalRecord) -> list[tuple[str, str]]:
    """Return lag and loops as facts, where the recordings tell them."""
    fit, facts = thermal.fit, []
    for label, tested, factor, unit in (
        ("lag behind the thermometer", fit.lag, 1.0, "s"),
        *(
            (f"loop of {name}", loop, _MICRO_G, "µg")
            for name, loop in zip(AXES, (fit.loop_x, fit.loop_y, fit.loop_z), strict=True)
        ),
    ):
        if tested is not None and tested.standard_uncertainty is not None:
            value, u = format_uncertain(tested.value * factor, tested.standard_uncertainty * factor)
            facts.append(
                (label, f"{value} {unit} (u {u}), " + ("taken out of the laws" if tested.fitted else "not significant"))
            )
    return facts


def _left(thermal: ThermalRecord) -> str:
    rows = thermal.fit.left_out_temperature
    return f"{plain_number(max(row.rms for row in rows) * _MICRO_G, 2)} µg rms at worst" if rows else "–"


def _coefficients(record: Calibration) -> ReportTable:
    reference = record.model["reference_temperature"]["value"]
    model = thermal_of(record).model
    splines = [("bias_x", model.knots), ("gyro_bias_x", None if model.gyro is None else model.gyro.knots)]
    at_knots = [
        f" Of a spline, {name}_at_1 ... are the values at {', '.join(f'{knot:.4g}' for knot in knots)} degC."
        for name, knots in splines
        if knots
    ]
    return parameters_table(
        rows_of(record),
        "bias_x is the value at that temperature, bias_x_t1 its change per kelvin, bias_x_t2 the coefficient of the "
        "square ... Outside the range each law is held at its end." + "".join(at_knots),
        f"Coefficients of powers of T - {reference:g} degC",
    )


def _over_temperature(group: int, record: Calibration, temperature: Array) -> Figure:
    name, factor, unit = _READ[group]
    kind, axes = GROUPS[group]
    part = slice(3 * group, 3 * group + 3)
    thermal = thermal_of(record)
    values, u = (each[part] for each in predicted(record, temperature))
    # Scale factors are read relative to those in the middle of the range.
    factors = factor / np.abs(values[:, [len(temperature) // 2]]) if group == 1 else np.full((3, 1), factor)
    calibrations, alone = thermal.data.calibrations, None
    if calibrations is not None:
        at = np.array(calibrations.temperature)
        each, reach = (
            factors * np.array(rows).T[part] for rows in (calibrations.values, calibrations.standard_uncertainty)
        )
        alone = Alone(at, each, factors * predicted(record, at)[0][part], reach)
    read = power_cycles(thermal.fit.between_recordings.from_)
    if alone is not None:
        read += " Points: what each recording at a steady temperature gives alone, bars two of its own."
    at_middle = values_at_middle(record, [f"{kind}_{axis}" for axis in axes]) if group else ""
    curves = LawCurves(axes, temperature, factors * values, factors * u)
    title = f"{name.capitalize()} over temperature"
    return law_figure(title, name, unit, curves, alone, read=read, at_middle=at_middle)


def _of_force(record: Calibration, thermal: ThermalRecord, temperature: Any) -> Figure:
    laws, between = deviation_of_force(record, temperature), thermal.fit.between_recordings
    cycle = np.hypot(between.bias.value, thermal.model.gravity.value * between.scale_factor.value / np.sqrt(3))
    known = between.from_ != "unknown"
    traces = [
        scatter(
            rounded(temperature), rounded(each * _MICRO_G, 4), "lines", name=name, line={"color": colour, "dash": dash}
        )
        for name, each, colour, dash in (
            ("by the laws", laws, GOOD, "solid"),
            *([("and the power cycle's own offset", np.hypot(laws, cycle), INK, "dash")] if known else []),
        )
    ]
    return Figure(
        title="Standard deviation of the corrected force over temperature",
        caption="Of one component, its root mean square over all directions, without noise"
        + (
            "; dashed with what biases and scale factors differ by from one power cycle to the next."
            if known
            else "; what power cycles add is not known."
        ),
        traces=traces,
        layout={
            "xaxis": figure_axis("temperature, degC"),
            "yaxis": figure_axis("standard deviation, µg", rangemode="tozero"),
            "legend": LEGEND,
        },
    )


def _residuals(thermal: ThermalRecord) -> Figure:
    held = thermal.data.holds
    temperature, residual, u = (np.array(each) for each in (held.temperature, held.residual, held.standard_uncertainty))
    rate = moved(np.array(held.recording), temperature, np.array(held.rate))
    many, edges = len(residual) > _POINTS_DRAWN_ALONE, np.linspace(temperature.min(), temperature.max(), _PARTS + 1)
    traces = []
    for label, which, symbol, colour in (
        ("warming", rate > 0, "triangle-up", BAD),
        ("cooling", rate < 0, "triangle-down", GOOD),
        ("steady", rate == 0, "circle", INK),
    ):
        if which.any():
            at, left = temperature[which], residual[which] * _MICRO_G
            marker = {"symbol": symbol, "color": colour, "size": 5 if many else 7, "opacity": 0.5 if many else 1}
            bars = {"type": "data", "array": rounded(u[which] * _MICRO_G, 3), "thickness": 1, "visible": not many}
            points = scatter(rounded(at), rounded(left, 4), "markers", name=label, marker=marker, error_y=bars)
            traces += [points, *([_means(at, left, edges, label, marker)] if many else [])]
    return Figure(
        title="Residual |f| - g of each hold over temperature",
        caption=(
            "Large marks: means of holds in a ninth of the range, bars two standard uncertainties by their scatter. "
            if many
            else "Bars: the hold's own standard uncertainty. "
        )
        + "Where warming and cooling differ, the unit lags behind its thermometer, or does not come back; a lag or "
        "loop that is significant is taken out here, while corrected outputs keep it.",
        traces=traces,
        layout={
            "xaxis": figure_axis("temperature, degC"),
            "yaxis": figure_axis("|f| - g, µg"),
            "legend": LEGEND,
            "showlegend": True,
        },
    )


def _means(temperature: Array, values: Array, edges: Array, label: str, marker: dict[str, Any]) -> dict[str, Any]:
    """Return the means of points between edges, with twice their standard uncertainty by the scatter."""
    number = np.searchsorted(edges[1:-1], temperature)
    count = np.bincount(number, minlength=_PARTS)
    enough = count >= _FEWEST
    at, mean, square = (
        np.bincount(number, weights=each, minlength=_PARTS)[enough] / count[enough]
        for each in (temperature, values, values**2)
    )
    u = np.sqrt(np.maximum(square - mean**2, 0) / (count[enough] - 1))
    bars = {"type": "data", "array": rounded(2 * u, 3), "thickness": 2}
    marker = marker | {"size": 11, "opacity": 1}
    name = f"{label}, means"
    return scatter(rounded(at), rounded(mean, 4), "markers", name=name, marker=marker, error_y=bars)


def _predicted(thermal: ThermalRecord) -> ReportTable:
    rows = [
        [f"{row.temperature:.1f}", str(row.holds), plain_number(row.rms * _MICRO_G, 3), f"{row.chi_square:.2f}"]
        for row in thermal.fit.left_out_temperature
    ]
    return ReportTable(
        "Temperatures left out",
        "| |f| - g | at each interior temperature under the fit to all others; chi-square per hold is about 1 where "
        "the stated uncertainty holds there.",
        ["degC", "holds", "rms, µg", "chi-square"],
        rows,
    )


def _compared(thermal: ThermalRecord) -> ReportTable:
    rows, chosen = [], None
    for number, row in enumerate(thermal.fit.degrees):
        chosen = number if row.chosen else chosen
        rows.append(
            [
                ", ".join(
                    [f"spline with {row.knots} knots" if row.knots else str(row.degrees[0]), *map(str, row.degrees[1:])]
                ),
                "–" if row.left_out is None else plain_number(row.left_out * _MICRO_G, 3),
                "–" if row.probability is None else "< 0.001" if row.probability < 0.001 else f"{row.probability:.3f}",
            ]
        )
    return ReportTable(
        "Degrees compared",
        f"Of {', '.join(kind.replace('_', ' ') for kind, _ in GROUPS)} on axes {' '.join(AXES)}. A step leaves "
        "the highest power of one kind out, and is "
        "taken where that power is insignificant (probability above 0.01) and left-out temperatures are predicted "
        "no worse; a spline of the bias where it is no cubic (the same test, as far as recordings tell) and predicts "
        "them at most a tenth worse, since it then lacks a knot.",
        ["degrees", "error at temperatures left out, µg", "probability that the power left out is chance"],
        rows,
        highlight=chosen,
    )
