"""What a thermal record shows: each parameter over temperature with its band, what is left, and how it predicts."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.procedures.thermal.degrees import spoken_degrees
from imulab.procedures.thermal.engineering import rows as engineering_rows
from imulab.procedures.thermal.gyrofigures import COLOURS, gyro_exhibits, own_points
from imulab.procedures.thermal.model import AXES, GROUPS
from imulab.procedures.thermal.record import deviation_of_force, predicted
from imulab.procedures.thermal.sections import Own, Thermal, thermal_of
from imulab.records.calibration import Calibration
from imulab.report.elements import GOOD, INK, LEGEND, Exhibits, Figure, ReportTable, format_uncertain, plain_number
from imulab.report.traces import DASHES, axis, band, rounded, scatter
from imulab.units import STANDARD_GRAVITY

_POINTS = 81
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
    values, spread = predicted(record, temperature)
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
        *(_over_temperature(k, temperature, values, spread, found.data.calibrations) for k in range(3)),
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


def _over_temperature(group: int, temperature: Any, values: Any, spread: Any, alone: Own | None) -> Figure:
    name, factor, unit = _READ[group]
    traces: list[dict[str, Any]] = []
    for k in range(3):
        row, label = 3 * group + k, GROUPS[group][1][k]
        middle = values[row][len(temperature) // 2]

        def read(each: Any, zero: float = 0.0, middle: float = middle) -> Any:
            return (each / middle - zero if group == 1 else each) * factor

        own, u = read(values[row], 1.0), 2 * np.abs(read(spread[row]))
        traces += [
            band(temperature, own - u, own + u, COLOURS[k], showlegend=False),
            scatter(rounded(temperature), rounded(own), "lines", name=label,
                    line={"color": COLOURS[k], "dash": DASHES[k]}),
        ]  # fmt: skip
        if alone is not None:
            point, reach = np.array(alone.values)[:, row], np.array(alone.standard_uncertainty)[:, row]
            traces.append(own_points(np.array(alone.temperature), read(point, 1.0), 2 * read(reach), k, label))
    return Figure(
        title=f"{name.capitalize()} over temperature",
        caption="Bands: two standard uncertainties, all that power cycles differ by included."
        + (" Points: what each recording at a steady temperature gives alone, bars two of its own." if alone else "")
        + (f" Change from the value at {temperature[len(temperature) // 2]:.3g} degC." if group == 1 else ""),
        traces=traces,
        layout={
            "xaxis": axis("temperature, degC"),
            "yaxis": axis(f"{name}, {unit}", exponentformat="none"),
            "legend": LEGEND,
        },
    )


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
    rate = np.array(held.rate)
    traces = []
    for label, which, symbol, colour in (
        ("warming", rate > 0, "triangle-up", "#c8553d"),
        ("cooling", rate < 0, "triangle-down", GOOD),
        ("steady", rate == 0, "circle", INK),
    ):
        if which.any():
            traces.append(
                scatter(
                    rounded(np.array(held.temperature)[which]), rounded(np.array(held.residual)[which] * _MICRO_G, 4),
                    "markers", name=label, marker={"symbol": symbol, "color": colour, "size": 7},
                    error_y={"type": "data", "array": rounded(np.array(held.standard_uncertainty)[which] * _MICRO_G, 3),
                             "thickness": 1},
                )
            )  # fmt: skip
    return Figure(
        title="Residual |f| - g of each hold over temperature",
        caption="Bars: the hold's own standard uncertainty. Warming and cooling apart: where they differ, the unit "
        "lags behind its thermometer, or does not come back; a lag or loop that is significant is taken out here, "
        "while corrected outputs keep it.",
        traces=traces,
        layout={"xaxis": axis("temperature, degC"), "yaxis": axis("|f| - g, µg"), "legend": LEGEND},
    )


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
                "–" if row.probability is None else f"{row.probability:.3f}",
            ]
        )
    return ReportTable(
        "Degrees compared",
        f"Of {', '.join(kind.replace('_', ' ') for kind, _ in GROUPS)} on axes {' '.join(AXES)}. A lower degree is "
        "taken where its step is insignificant (probability above 0.01) and left-out temperatures are predicted "
        "no worse; a spline of the bias where it is no cubic (the same test, as far as recordings tell) and predicts "
        "them at most a tenth worse, since it then lacks a knot.",
        ["degrees", "left out, µg", "probability"],
        rows,
        highlight=chosen,
    )
