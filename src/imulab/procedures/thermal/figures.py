"""The figures and tables of a thermal record: each law over temperature with its band, and residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec.structs import replace

from imulab.estimation.distributions import probability_fact
from imulab.procedures.thermal.degrees import describe_degrees, mask_drift_rates
from imulab.procedures.thermal.model import AXES, GROUPS
from imulab.procedures.thermal.record import (
    deviation_of_force,
    predict_gyro_bias,
    predict_gyro_scale,
    predict_parameters,
)
from imulab.procedures.thermal.schema import (
    AccelChange,
    DegreesTried,
    LeftOutTemperature,
    RampRecord,
    ThermalRecord,
    gyros_of,
    is_ramp,
    thermal_of,
)
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.parameters import ReadingUnit, parameters_table, reading_unit, rows_of, small_text, small_unit
from imulab.report.traces import (
    AXIS_COLOURS,
    BAD,
    DASHES,
    GOOD,
    INK,
    LEGEND,
    Exhibits,
    Figure,
    Group,
    ReportTable,
    band,
    figure_axis,
    format_uncertain,
    number_text,
    plain_number,
    point_traces,
    points,
    rounded,
    scatter,
    table,
)
from imulab.units import from_si

# A figure of laws: the curves above, and beneath them their uncertainty and single recordings.


SYMBOLS = ("circle", "diamond", "square")
_UPPER, _LOWER = [0.5, 1.0], [0.0, 0.38]
"""Shares of the figure's height."""


def axis_groups(count: int) -> list[Group]:
    """Return the looks of three axes' points, for values of `count` holds in the order of holds, then axes."""
    axis = np.tile(np.arange(len(AXES)), count)
    return [Group(name, axis == k, SYMBOLS[k], AXIS_COLOURS[k]) for k, name in enumerate(AXES)]


@dataclass(frozen=True)
class LawCurves:
    """Three laws in the unit of their figure: names, temperatures, degC (n,), values and their u, (3, n)."""

    names: tuple[str, ...]
    temperature: Array
    values: Array
    standard_uncertainty: Array


@dataclass(frozen=True)
class Alone:
    """The values of single recordings in the same unit: temperatures, degC (m,), values, laws there and u, (3, m)."""

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
        Title and unit of the laws' axis.
    read
        How to read band and points.
    at_middle
        The values in the middle of the range, in words; the laws are then drawn as changes from these.
    """
    temperature, reach = curves.temperature, 2 * curves.standard_uncertainty
    middle = len(temperature) // 2
    zero = curves.values[:, middle] if at_middle else np.zeros(len(curves.names))
    beneath: dict[str, Any] = {"yaxis": "y2", "showlegend": False}
    traces = []
    for k, name in enumerate(curves.names):
        line = {"color": AXIS_COLOURS[k], "dash": DASHES[k]}
        around = band(temperature, -reach[k], reach[k], AXIS_COLOURS[k], **beneath) | {"line": line | {"width": 1}}
        traces += [
            scatter(rounded(temperature), rounded(curves.values[k] - zero[k]), "lines", name=name, line=line),
            around,
        ]
        if alone is not None:
            u = None if alone.standard_uncertainty is None else 2 * alone.standard_uncertainty[k]
            traces += [
                *_alone_points(alone.temperature, alone.values[k] - zero[k], None, k, name),
                *_alone_points(alone.temperature, alone.values[k] - alone.laws[k], u, k, name, **beneath),
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


def describe_power_cycles(known_from: str) -> str:
    """Return whether bands include the scatter between power cycles, from ``between_recordings.from`` of a record."""
    if known_from == "unknown":
        return "without what power cycles add, which is not known."
    return "what power cycles differ by included."


def values_at_middle(record: Calibration, names: Sequence[str]) -> str:
    """Return the first coefficients of laws in words: of powers of T - T0 these are the values in the middle."""
    by_name = {row.name: row for row in rows_of(record)}
    rows = [by_name[name] for name in names]
    each = (f"{row.name[-2:].lstrip('_')} {format_uncertain(row.value, row.standard_uncertainty)[0]}" for row in rows)
    return f"{', '.join(each)} {rows[0].unit}"


def _alone_points(
    temperature: Array, values: Array, reach: Array | None, axis: int, label: str, **more: Any
) -> list[dict[str, Any]]:
    """Return the values of single recordings as points with bars, in the look of an axis, without a key."""
    group = Group(f"{label} alone", np.ones(len(values), dtype=np.bool_), SYMBOLS[axis], AXIS_COLOURS[axis])
    return point_traces(temperature, values, reach, [group], size=7, **{"showlegend": False, **more})


# Gyroscopes.


def gyro_exhibits(record: Calibration, temperature: Array) -> tuple[list[tuple[str, str]], list[Figure]]:
    """Return the facts and figures of the gyroscopes of a record over temperatures, degC."""
    thermal = gyros_of(record)
    fit, data = thermal.fit.gyro, thermal.data.gyro
    assert fit is not None
    assert data is not None
    values, gyro_u = predict_gyro_bias(record, temperature)
    tau = fit.between_recordings
    facts = [
        ("gyroscope biases", f"known to {small_text(float(gyro_u.max()), 'rad/s', 2)} or better"),
        ("gyroscope biases, power cycle to power cycle", _turn_on_text(tau.from_, tau.bias.value, "rad/s")),
        ("gyroscope biases at left-out temperatures", _left_out_text(fit.left_out_temperature, "rad/s")),
    ]
    if fit.turns is not None:
        turns = f"{fit.turns.turns}, missed by {plain_number(np.degrees(fit.turns.rms.value), 2)} deg rms"
        facts.append(("turns", turns))
        if not thermal.model.gyro_laws.degrees[1]:
            # A law that nothing could bend is no figure over temperature.
            scale, u = predict_gyro_scale(record, temperature)
            known = plain_number(1e6 * float((u / np.abs(scale)).max()), 2)
            text = f"known to {known} ppm where the turns were, and taken as the same at all temperatures"
            facts.append(("gyroscope scale factors", text))
    curves = LawCurves(AXES, temperature, from_si(values, "deg/s"), from_si(gyro_u, "deg/s"))
    read = describe_power_cycles(tau.from_) + " Points: the mean of each recording that stayed at its temperature."
    figures = [
        law_figure(
            "Bias of the gyroscopes over temperature", "bias", "deg/s", curves, _steady_means(record), read=read
        ),
        points(
            "What the laws leave of the gyroscopes at rest",
            "Law less output of each hold. A recording whose points lie together away from zero is a power "
            "cycle whose biases are offset; within it they scatter by noise, the Earth's rate (15 deg/h) and drift.",
            ("temperature, degC", np.repeat(data.temperature, len(AXES))),
            ("law less output, deg/h", from_si(np.array(data.residual).ravel(), "deg/h")),
            None,
            axis_groups(len(data.temperature)),
            size=7,
        ),
    ]
    if fit.turns is not None and thermal.model.gyro_laws.degrees[1]:
        figures.insert(1, _scale_factor_figure(record, temperature, fit.turns.recordings))
    return facts, figures


def _steady_means(record: Calibration) -> Alone | None:
    """Return the mean bias of each recording that stayed at its temperature, deg/s; None where there are none."""
    data = gyros_of(record).data.gyro
    assert data is not None
    steady = np.array(data.rate) == 0
    names, index = np.unique(np.array(data.recording)[steady], return_inverse=True)
    if not len(names):
        return None
    at = np.array(data.temperature)[steady]
    laws = predict_gyro_bias(record, at)[0]
    values = laws - np.array(data.residual).reshape(-1, 3)[steady].T
    mean = np.array([np.bincount(index, weights=each) for each in (at, *values, *laws)]) / np.bincount(index)
    return Alone(mean[0], from_si(mean[1:4], "deg/s"), from_si(mean[4:], "deg/s"))


def _scale_factor_figure(record: Calibration, temperature: Array, recordings: int) -> Figure:
    values, spread = predict_gyro_scale(record, temperature)
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


def _turn_on_text(known_from: str, scatter: float, unit: str) -> str:
    """Return the scatter of biases between power cycles, SI, as a fact, with how it is known."""
    text = small_text(scatter, unit, 2)
    return {"unknown": "not known", "polynomials": f"at most {text}"}.get(known_from, f"{text} ({known_from})")


# The record.


_POINTS = 81  # of a curve
_POINTS_DRAWN_ALONE, _PARTS, _FEWEST = 60, 9, 3
"""Most holds that are drawn with bars; parts of the range in which more are averaged, an odd number so that a soak in
the middle is not divided; and the fewest holds of a part."""
_READ = (
    ("bias", reading_unit("m/s^2")),
    ("scale factor", ReadingUnit("ppm", 1e6)),
    ("misalignment", reading_unit("rad")),
)


def exhibits(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record."""
    if is_ramp(record):
        return _ramp_exhibits(record, gyros_of(record))
    thermal = thermal_of(record)
    low, high = thermal.model.range
    temperature = np.linspace(low, high, _POINTS)
    _, spread = predict_parameters(record, temperature)
    fit = thermal.fit
    laws, tau = thermal.model.laws, fit.between_recordings
    kind = "degrees " + ", ".join(map(str, laws.degrees))
    if laws.knots:
        kind = describe_degrees(laws.degrees, len(laws.knots))
    headline = (
        f"{low:.0f} to {high:.0f} degC, {kind}: |f| - g is {small_text(fit.rms.value, 'm/s^2')} rms over {fit.holds} "
        f"holds; biases are known to {small_text(float(spread[:3].max()), 'm/s^2', 2)} or better."
    )
    facts = [
        ("recordings", str(fit.recordings)),
        ("temperatures", str(fit.temperatures)),
        ("biases, power cycle to power cycle", _turn_on_text(tau.from_, tau.bias.value, "m/s^2")),
        ("left-out temperatures", _left_out_text(fit.left_out_temperature, "m/s^2")),
        *_lag_and_loop_facts(thermal),
    ]
    items: list[Figure | ReportTable] = [
        _coefficients_table(record),
        *(_parameter_figure(k, record, temperature) for k in range(3)),
        _force_figure(record, thermal, temperature),
        _residual_figure(thermal),
    ]
    if thermal.model.gyro is not None:
        gyro_facts, gyro_items = gyro_exhibits(record, temperature)
        facts += gyro_facts
        items += gyro_items
    if fit.left_out_temperature:
        items.append(_left_out_table(thermal))
    if fit.degrees:
        items.append(_degrees_table(thermal))
    return Exhibits(headline, facts, items)


def _ramp_exhibits(record: Calibration, ramp: RampRecord) -> Exhibits:
    """Return the figures and tables of a record of rest ramps."""
    low, high = ramp.model.range
    temperature = np.linspace(low, high, _POINTS)
    u, laws = predict_gyro_bias(record, temperature)[1], ramp.model.gyro_laws
    kind = f"a spline with {len(laws.knots)} knots" if laws.knots else f"degree {laws.degrees[0]}"
    headline = (
        f"{low:.0f} to {high:.0f} degC at rest, biases of gyroscopes of {kind}, known to "
        f"{small_text(float(u.max()), 'rad/s', 2)} or better; scale factors are not told."
    )
    facts, items = gyro_exhibits(record, temperature)
    facts.append(("not told", "scale factors, misalignments, g-sensitivities; accelerometers"))
    if ramp.data.accel_change is not None:
        items.append(_accel_change_figure(ramp.data.accel_change))
    return Exhibits(headline, facts, [_coefficients_table(record), *items])


def _accel_change_figure(change: AccelChange) -> Figure:
    """Return the figure of the accelerometers' output along gravity over temperature, by recording."""
    traces = []
    for k, name in enumerate(change.recording):
        colour, at = AXIS_COLOURS[k % len(AXIS_COLOURS)], np.array(change.temperature[k])
        values, u = from_si(np.array(change.change[k]), "mg"), from_si(np.array(change.standard_uncertainty[k]), "mg")
        line = {"color": colour, "dash": DASHES[k % len(DASHES)]}
        traces += [
            band(at, values - 2 * u, values + 2 * u, colour, showlegend=False),
            scatter(rounded(at), rounded(values), "lines", name=name, line=line),
        ]
    most = max(abs(each) for row in change.change for each in row)
    return Figure(
        title="Output of the accelerometers along gravity over temperature",
        message=f"It changes by up to {plain_number(float(from_si(most, 'mg')), 2)} mg from the middle of the range.",
        caption="Change of the mean output along gravity, with a band of two standard uncertainties: of bias and scale "
        "factor together, which one attitude does not tell apart. Nothing is corrected by it.",
        traces=traces,
        layout={
            "xaxis": figure_axis("temperature, degC"),
            "yaxis": figure_axis("change along gravity, mg", exponentformat="none"),
            "legend": LEGEND,
        },
    )


def _lag_and_loop_facts(thermal: ThermalRecord) -> list[tuple[str, str]]:
    """Return lag and loops as facts, where they are observable."""
    fit, facts = thermal.fit, []
    loops = zip(AXES, (fit.loop_x, fit.loop_y, fit.loop_z), strict=True)
    for label, tested in (
        ("lag behind the thermometer", fit.lag),
        *((f"loop of {name}", loop) for name, loop in loops),
    ):
        if tested is not None and tested.standard_uncertainty is not None:
            read = small_unit(tested.unit)
            value, u = read.texts(tested.value, tested.standard_uncertainty)
            verdict = "taken out of the laws" if tested.fitted else "not significant"
            facts.append((label, f"{value} {read.symbol} (u {u}), {verdict}"))
    return facts


def _left_out_text(rows: Sequence[LeftOutTemperature], unit: str) -> str:
    """Return the largest error at a left-out temperature, SI, as a fact."""
    return f"{small_text(max(row.rms for row in rows), unit, 2)} rms at worst" if rows else "–"


def _coefficients_table(record: Calibration) -> ReportTable:
    """Return the coefficients of all laws."""
    reference = record.model["reference_temperature"]["value"]
    model = gyros_of(record).model
    splines = [
        ("bias_x", None if is_ramp(record) else thermal_of(record).model.knots),
        ("gyro_bias_x", None if model.gyro is None else model.gyro.knots),
    ]
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


def _parameter_figure(group: int, record: Calibration, temperature: Array) -> Figure:
    """Return the law of one kind of parameters over temperature, with the calibrations of single recordings."""
    name, read_unit = _READ[group]
    kind, axes = GROUPS[group]
    part = slice(3 * group, 3 * group + 3)
    thermal = thermal_of(record)
    values, u = (each[part] for each in predict_parameters(record, temperature))
    # Scale factors are read relative to those in the middle of the range.
    nominal = np.abs(values[:, [len(temperature) // 2]]) if group == 1 else np.ones((3, 1))
    factors = read_unit.factor / nominal
    calibrations, alone = thermal.data.calibrations, None
    if calibrations is not None:
        at = np.array(calibrations.temperature)
        each, reach = (
            factors * np.array(rows).T[part] for rows in (calibrations.values, calibrations.standard_uncertainty)
        )
        alone = Alone(at, each, factors * predict_parameters(record, at)[0][part], reach)
    read = describe_power_cycles(thermal.fit.between_recordings.from_)
    if alone is not None:
        read += " Points: what each recording at a steady temperature gives alone, bars two of its own."
    at_middle = values_at_middle(record, [f"{kind}_{axis}" for axis in axes]) if group else ""
    curves = LawCurves(axes, temperature, factors * values, factors * u)
    title = f"{name.capitalize()} over temperature"
    return law_figure(title, name, read_unit.symbol, curves, alone, read=read, at_middle=at_middle)


def _force_figure(record: Calibration, thermal: ThermalRecord, temperature: Array) -> Figure:
    """Return the standard deviation of the corrected force over temperature, without and with power cycles."""
    laws, between = deviation_of_force(record, temperature), thermal.fit.between_recordings
    cycle = np.hypot(between.bias.value, thermal.model.gravity.value * between.scale_factor.value / np.sqrt(3))
    known = between.from_ != "unknown"
    traces = [
        scatter(
            rounded(temperature),
            rounded(from_si(each, "ug"), 4),
            "lines",
            name=name,
            line={"color": colour, "dash": dash},
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


def _residual_figure(thermal: ThermalRecord) -> Figure:
    """Return the residual |f| - g of each hold over temperature, warming and cooling apart; with means if many."""
    holds = thermal.data.holds
    temperature, rate = np.array(holds.temperature), np.array(holds.rate)
    rate = mask_drift_rates(np.array(holds.recording), temperature, rate)
    residual, u = (from_si(np.array(values), "ug") for values in (holds.residual, holds.standard_uncertainty))
    groups = [
        Group("warming", rate > 0, "triangle-up", BAD),
        Group("cooling", rate < 0, "triangle-down", GOOD),
        Group("steady", rate == 0, "circle", INK),
    ]
    many = len(residual) > _POINTS_DRAWN_ALONE
    figure = points(
        "Residual |f| - g of each hold over temperature",
        (
            "Large marks: means of holds in a ninth of the range, bars two standard uncertainties by their scatter. "
            if many
            else "Bars: the hold's own standard uncertainty. "
        )
        + "Where warming and cooling differ, the unit lags behind its thermometer, or does not come back; a lag or "
        "loop that is significant is taken out here, while corrected outputs keep it.",
        ("temperature, degC", temperature),
        ("|f| - g, µg", residual),
        None if many else u,
        groups,
        size=5 if many else 7,
        opacity=0.5 if many else 1,
        showlegend=True,
    )
    means = [trace for group in groups for trace in _mean_traces(temperature, residual, group)] if many else []
    return replace(figure, traces=figure.traces + means)


def _mean_traces(temperature: Array, values: Array, group: Group) -> list[dict[str, Any]]:
    """Return the means of a group's points in parts of the range, with two standard uncertainties by their scatter."""
    edges = np.linspace(temperature.min(), temperature.max(), _PARTS + 1)[1:-1]
    at, members = temperature[group.members], values[group.members]
    number = np.searchsorted(edges, at)
    count = np.bincount(number, minlength=_PARTS)
    enough = count >= _FEWEST
    place, mean, square = (
        np.bincount(number, weights=weights, minlength=_PARTS)[enough] / count[enough]
        for weights in (at, members, members**2)
    )
    u = np.sqrt(np.maximum(square - mean**2, 0) / (count[enough] - 1))
    marks = Group(f"{group.name}, means", np.ones(len(place), dtype=np.bool_), group.symbol, group.colour)
    return point_traces(place, mean, 2 * u, [marks], size=11)


def _left_out_table(thermal: ThermalRecord) -> ReportTable:
    """Return the errors at temperatures that were left out of the fit."""
    read = small_unit("m/s^2")
    columns: dict[str, Callable[[LeftOutTemperature], str]] = {
        "degC": lambda row: f"{row.temperature:.1f}",
        "holds": lambda row: str(row.holds),
        f"rms, {read.symbol}": lambda row: number_text(row.rms, read.factor),
        "chi-square": lambda row: f"{row.chi_square:.2f}",
    }
    return table(
        "Temperatures left out",
        "| |f| - g | at each interior temperature under the fit to all others; chi-square per hold is about 1 where "
        "the stated uncertainty holds there.",
        columns,
        thermal.fit.left_out_temperature,
    )


def _degrees_table(thermal: ThermalRecord) -> ReportTable:
    """Return the degrees that were compared, with the chosen ones highlighted."""
    read, tried = small_unit("m/s^2"), thermal.fit.degrees

    def name(row: DegreesTried) -> str:
        bias = f"spline with {row.knots} knots" if row.knots else str(row.degrees[0])
        return ", ".join([bias, *map(str, row.degrees[1:])])

    def chance(row: DegreesTried) -> str:
        p = row.probability
        return "–" if p is None else probability_fact(p)

    columns: dict[str, Callable[[DegreesTried], str]] = {
        "degrees": name,
        f"error at temperatures left out, {read.symbol}": lambda row: number_text(row.left_out, read.factor),
        "probability that the power left out is chance": chance,
    }
    chosen = [number for number, row in enumerate(tried) if row.chosen]
    return table(
        "Degrees compared",
        f"Of {', '.join(kind.replace('_', ' ') for kind, _ in GROUPS)} on axes {' '.join(AXES)}. A step leaves "
        "the highest power of one kind out, and is "
        "taken where that power is insignificant (probability above 0.01) and left-out temperatures are predicted "
        "no worse; a spline of the bias where it is no cubic (the same test, as far as recordings tell) and predicts "
        "them at most a tenth worse, since it then lacks a knot.",
        columns,
        tried,
        highlight=chosen[-1] if chosen else None,
    )
