"""What a thermal record shows: each parameter over temperature with its band, what is left, and how it predicts."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.procedures.thermal.degrees import spoken_degrees
from imulab.procedures.thermal.engineering import rows as engineering_rows
from imulab.procedures.thermal.gyrofigures import gyro_exhibits
from imulab.procedures.thermal.lag import moved
from imulab.procedures.thermal.lawfigures import Alone, Curves, law_figure, power_cycles, values_at_middle
from imulab.procedures.thermal.model import AXES, GROUPS
from imulab.procedures.thermal.record import deviation_of_force, predicted
from imulab.procedures.thermal.sections import Thermal, thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import BAD, GOOD, INK, LEGEND, Exhibits, Figure, ReportTable, format_uncertain, plain_number
from imulab.report.traces import axis, rounded, scatter
from imulab.units import STANDARD_GRAVITY

_POINTS = 81
_MANY, _PARTS, _FEWEST = 60, 9, 3
"""Holds whose bars hide one another; the parts that they are averaged in, an odd number, since a soak in the middle is
not to be parted; and the fewest of one."""
_READ = (
    ("bias", 1e3 / STANDARD_GRAVITY, "mg"),
    ("scale factor", 1e6, "ppm"),
    ("misalignment", 1e3, "mrad"),
)
_MICRO_G = 1e6 / STANDARD_GRAVITY


def exhibits(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record."""
    found = thermal_of(record)
    low, high = found.model.range
    temperature = np.linspace(low, high, _POINTS)
    _, spread = predicted(record, temperature)
    fit = found.fit
    worst = float(spread[:3].max()) * _MICRO_G
    laws, rms = found.model.laws, plain_number(fit.rms.value * _MICRO_G, 3)
    kind = "degrees " + ", ".join(map(str, laws.degrees))
    if laws.knots:
        kind = spoken_degrees(laws.degrees, len(laws.knots))
    headline = (
        f"{low:.0f} to {high:.0f} degC, {kind}: |f| - g is {rms} µg rms over {fit.holds} holds; "
        f"biases are known to {plain_number(worst, 2)} µg or better."
    )
    tau = fit.between_recordings
    told = f"{plain_number(tau.bias.value * _MICRO_G, 2)} µg"
    told = {
        "unknown": "not known",
        "polynomials": f"at most {told}",
    }.get(tau.from_, f"{told} ({tau.from_})")
    facts = [
        ("recordings", str(fit.recordings)),
        ("temperatures", str(fit.temperatures)),
        ("biases, power cycle to power cycle", told),
        ("left-out temperatures", _left(found)),
        *_drift(found),
    ]
    items: list[Figure | ReportTable] = [
        _coefficients(record),
        *(_over_temperature(k, record, temperature) for k in range(3)),
        _of_force(record, found, temperature),
        _residuals(found),
    ]
    if found.model.gyro is not None:
        gyro_facts, gyro_items = gyro_exhibits(record, temperature)
        facts += gyro_facts
        items += gyro_items
    if fit.left_out_temperature:
        items.append(_predicted(found))
    if fit.degrees:
        items.append(_compared(found))
    return Exhibits(headline, facts, items)


def _drift(found: Thermal) -> list[tuple[str, str]]:
    """Return lag and loops as facts, where the recordings tell them."""
    fit, facts = found.fit, []
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


def _left(found: Thermal) -> str:
    rows = found.fit.left_out_temperature
    return f"{plain_number(max(row.rms for row in rows) * _MICRO_G, 2)} µg rms at worst" if rows else "–"


def _coefficients(record: Calibration) -> ReportTable:
    rows = []
    for row in engineering_rows(record):
        value, u = format_uncertain(row.value, row.standard_uncertainty)
        rows.append([row.name, value, u, row.unit])
    reference = record.model["reference_temperature"]["value"]
    model = thermal_of(record).model
    splines = [("bias_x", model.knots), ("gyro_bias_x", None if model.gyro is None else model.gyro.knots)]
    at_knots = [
        f" Of a spline, {name}_at_1 ... are the values at {', '.join(f'{knot:.4g}' for knot in knots)} degC."
        for name, knots in splines
        if knots
    ]
    return ReportTable(
        f"Coefficients of powers of T - {reference:g} degC",
        "bias_x is the value at that temperature, bias_x_t1 its change per kelvin, bias_x_t2 the coefficient of the "
        "square ... Outside the range each law is held at its end." + "".join(at_knots),
        ["parameter", "value", "u", "unit"],
        rows,
    )


def _over_temperature(group: int, record: Calibration, temperature: Array) -> Figure:
    name, factor, unit = _READ[group]
    kind, axes = GROUPS[group]
    part = slice(3 * group, 3 * group + 3)
    found = thermal_of(record)
    values, u = (each[part] for each in predicted(record, temperature))
    # Scale factors are read relative to those in the middle of the range.
    factors = factor / np.abs(values[:, [len(temperature) // 2]]) if group == 1 else np.full((3, 1), factor)
    own, alone = found.data.calibrations, None
    if own is not None:
        at = np.array(own.temperature)
        each, reach = (factors * np.array(of).T[part] for of in (own.values, own.standard_uncertainty))
        alone = Alone(at, each, factors * predicted(record, at)[0][part], reach)
    read = power_cycles(found.fit.between_recordings.from_)
    if alone is not None:
        read += " Points: what each recording at a steady temperature gives alone, bars two of its own."
    at_middle = values_at_middle(record, [f"{kind}_{axis}" for axis in axes]) if group else ""
    curves = Curves(axes, temperature, factors * values, factors * u)
    title = f"{name.capitalize()} over temperature"
    return law_figure(title, name, unit, curves, alone, read=read, at_middle=at_middle)


def _of_force(record: Calibration, found: Thermal, temperature: Any) -> Figure:
    laws, between = deviation_of_force(record, temperature), found.fit.between_recordings
    cycle = np.hypot(between.bias.value, found.model.gravity.value * between.scale_factor.value / np.sqrt(3))
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
            "xaxis": axis("temperature, degC"),
            "yaxis": axis("standard deviation, µg", rangemode="tozero"),
            "legend": LEGEND,
        },
    )


def _residuals(found: Thermal) -> Figure:
    held = found.data.holds
    temperature, residual, u = (np.array(each) for each in (held.temperature, held.residual, held.standard_uncertainty))
    rate = moved(np.array(held.recording), temperature, np.array(held.rate))
    many, edges = len(residual) > _MANY, np.linspace(temperature.min(), temperature.max(), _PARTS + 1)
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
            "xaxis": axis("temperature, degC"),
            "yaxis": axis("|f| - g, µg"),
            "legend": LEGEND,
            "showlegend": True,
        },
    )


def _means(temperature: Array, values: Array, edges: Array, label: str, marker: dict[str, Any]) -> dict[str, Any]:
    """Return the means of points between edges, with twice their standard uncertainty by the scatter."""
    number = np.searchsorted(edges[1:-1], temperature)
    count = np.bincount(number, minlength=_PARTS)
    told = count >= _FEWEST
    at, mean, square = (
        np.bincount(number, weights=each, minlength=_PARTS)[told] / count[told]
        for each in (temperature, values, values**2)
    )
    u = np.sqrt(np.maximum(square - mean**2, 0) / (count[told] - 1))
    bars = {"type": "data", "array": rounded(2 * u, 3), "thickness": 2}
    marker = marker | {"size": 11, "opacity": 1}
    name = f"{label}, means"
    return scatter(rounded(at), rounded(mean, 4), "markers", name=name, marker=marker, error_y=bars)


def _predicted(found: Thermal) -> ReportTable:
    rows = [
        [f"{row.temperature:.1f}", str(row.holds), plain_number(row.rms * _MICRO_G, 3), f"{row.chi_square:.2f}"]
        for row in found.fit.left_out_temperature
    ]
    return ReportTable(
        "Temperatures left out",
        "| |f| - g | at each interior temperature under the fit to all others; chi-square per hold is about 1 where "
        "the stated uncertainty holds there.",
        ["degC", "holds", "rms, µg", "chi-square"],
        rows,
    )


def _compared(found: Thermal) -> ReportTable:
    rows, chosen = [], None
    for number, row in enumerate(found.fit.degrees):
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
