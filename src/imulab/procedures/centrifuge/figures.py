"""The figures and tables of a centrifuge record, from the record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.errors import RecordError
from imulab.estimation.least_squares import coverage_factor
from imulab.procedures.centrifuge.findings import (
    axis_label,
    change_uncertainty,
    curve_at,
    facts,
    headline,
    numbers,
    prefixes,
)
from imulab.procedures.centrifuge.sections import Centrifuge, centrifuge_of, force_of, level_of
from imulab.procedures.centrifuge.tables import (
    PER_G,
    budget_table,
    curve_table,
    cycle_tables,
    level_table,
    parameters_table,
    relative,
    run_table,
)
from imulab.records.calibration import Calibration
from imulab.report.elements import BAD, GOOD, INK, LEGEND, QUIET, Exhibits, Figure, ReportTable
from imulab.report.panels import axis_key, names
from imulab.report.traces import SYMBOLS, axis, band, rounded, scatter
from imulab.units import STANDARD_GRAVITY, from_si

_POINTS = 121
_SHOWN_SPECTRA = 3
_DECADES = [10.0**n for n in range(-6, 7)]
_SPECTRUM_CAPTION = (
    "Hann-windowed, height of a sine. The FOG's line is rotation: tilt and flexure of the table axis. What is left of "
    "X without it is the drift K a, marked as fitted. A broad foot under a line is a rate that wanders; further lines "
    "are vibration."
)
_SPECTRA = (("dtg_x", "X"), ("fog", "FOG"), ("residual_x", "X − FOG"))
_CYCLES = (GOOD, BAD, INK, "#7a5c99", "#b8860b", "#4c8c4a")


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    sets, r = prefixes(record), centrifuge_of(record)
    if not sets or not all(numbers(record, prefix) for prefix in sets):
        raise RecordError("the record lacks x_K0, or the K of any level")
    items: list[Figure | ReportTable] = [_zeta(record, sets)]
    if any(f"{p}direction" in record.parameters for p in sets):
        items.append(_polar(record, [p for p in sets if f"{p}direction" in record.parameters]))
    items += [_repeatability(record, r, sets), *_spectra(r)]
    items += [
        level_table(record, r.levels, sets),
        *cycle_tables(r.fit.power_cycles),
        curve_table(r.fit, sets),
        budget_table(r.fit),
        parameters_table(record, r.fit),
        run_table(r.runs),
    ]
    return Exhibits(headline=headline(record, sets[0]), facts=facts(record, sets), items=items)


def _scatter(x: Any, y: Any, name: str, mode: str, **more: Any) -> dict[str, Any]:
    return scatter(rounded(x), rounded(y), mode, name=name, **more)


def _bars(values: Any, colour: str) -> dict[str, Any]:
    return {"type": "data", "array": rounded(values), "color": colour, "thickness": 1.2, "width": 4}


def _zeta(record: Calibration, sets: list[str]) -> Figure:
    """Change of K over g: the source's zeta and the fitted curve, each with its 95 % interval."""
    traces: list[dict[str, Any]] = []
    shown = [p for p in sets if "down" not in p] or sets
    for number, prefix in enumerate(shown):
        levels = numbers(record, prefix)
        force = np.array([force_of(record, level) for level in levels])
        grid = np.linspace(0.0, 1.02 * force.max(), _POINTS)
        K0 = record.value(f"{prefix}K0")
        K, _ = curve_at(record, prefix, grid)
        half = coverage_factor(None) * np.array([change_uncertainty(record, prefix, a) for a in grid])
        x = grid / STANDARD_GRAVITY
        change = 100 * (K / K0 - 1)
        where = _place(number)
        traces += [
            band(x, change + 100 * half, change - 100 * half, GOOD, name="curve, 95 %",
                 showlegend=number == 0, **where),
            _scatter(x, change, "fitted curve", "lines", line={"color": GOOD, "width": 2},
                showlegend=number == 0, **where),
        ]  # fmt: skip
        measured = np.array([record.value(f"{prefix}K_{level}") for level in levels])
        factors = centrifuge_of(record).fit.coverage_factor_95
        u = np.array([_half_width(record, factors, f"{prefix}K_{level}") for level in levels])
        traces.append(
            _scatter(force / STANDARD_GRAVITY, 100 * (measured / K0 - 1), "K_i against K0, 95 %", "markers",
                     marker={"color": INK, "size": 7}, showlegend=number == 0,
                     error_y=_bars(100 * u / K0, INK), **where)
        )  # fmt: skip
        later = levels[1:]
        if later:
            zeta = [100 * record.value(f"{prefix}zeta_{level}") for level in later]
            bars = [100 * _half_width(record, factors, f"{prefix}zeta_{n}") for n in later]
            spread = 0.012 * float(force.max()) / STANDARD_GRAVITY
            traces.append(
                _scatter(force[1:] / STANDARD_GRAVITY + spread, zeta, "zeta_i against K_1, 95 %", "markers",
                         marker={"color": BAD, "size": 7, "symbol": "diamond-open"}, showlegend=number == 0,
                         error_y=_bars(bars, BAD), **where)
            )  # fmt: skip
    return Figure(
        title="Change of the drift factor with specific force",
        caption="K is the drift per specific force, zeta its change from K_1, the lowest level and the weakest run, "
        "so that all zeta share one error; the fitted curve uses every level and is what apply subtracts. Filled "
        "points are the same K_i against the curve's K0. Points off the band by more than their bars are not "
        "described by the curve.",
        traces=traces,
        layout=_panels([f"{axis_label(p)}: change of K, %" for p in shown], "specific force, g"),
        height=430,
    )


def _half_width(record: Calibration, factors: dict[str, float], name: str) -> float:
    """Half the 95 % interval of a parameter."""
    return (record.parameter(name).standard_uncertainty or 0.0) * factors[name]


def _place(number: int) -> dict[str, Any]:
    """The axes of a panel, as a trace names them."""
    return dict(zip(("xaxis", "yaxis"), names(number), strict=True))


def _panels(titles: list[str], below: str, gap: float = 0.09) -> dict[str, Any]:
    """Layout of panels side by side, the legend above."""
    count = len(titles)
    width = (1 - gap * (count - 1)) / count
    layout: dict[str, Any] = {
        "legend": dict(LEGEND),
        "margin": {"l": 70, "r": 20, "t": 50, "b": 55},
    }
    for number, title in enumerate(titles):
        x, y = names(number)
        start = number * (width + gap)
        layout[axis_key(x)] = axis(below, domain=[start, start + width], anchor=y, automargin=True)
        layout[axis_key(y)] = axis(title, anchor=x, automargin=True)
    return layout


def _polar(record: Calibration, sets: list[str]) -> Figure:
    """The complex K of each level in the gyroscope's frame."""
    traces: list[dict[str, Any]] = []
    shown = [p for p in sets if "down" not in p] or sets
    annotations = []
    for number, prefix in enumerate(shown):
        x, y = names(number)
        where = _place(number)
        key = prefix[0] if "down" not in prefix else f"{prefix[0]}_down"
        rows = [(row, line) for row in centrifuge_of(record).levels if (line := row.line(key)) is not None]
        if not rows:
            raise RecordError(f"the record lacks levels with {key}")
        z = np.array([complex(line.A, line.B) for _, line in rows]) * PER_G
        force = [from_si(row.specific_force.value, "g") for row, _ in rows]
        angle = np.linspace(0, 2 * np.pi, 49)
        for index, (_, line) in enumerate(rows):
            size, axes = np.linalg.eigh(np.array(line.covariance) * PER_G**2)
            ring = axes * np.sqrt(np.maximum(size, 0.0)) @ np.array([np.cos(angle), np.sin(angle)])
            ring *= 2.448  # 95 % of a two-dimensional normal distribution
            traces.append(
                _scatter(z[index].real + ring[0], z[index].imag + ring[1], "95 % region", "lines",
                    line={"color": QUIET, "width": 1},
                         hoverinfo="skip", showlegend=index == 0 and number == 0, **where)
            )  # fmt: skip
        traces.append(
            _scatter(z.real, z.imag, "level, coloured by g", "lines+markers", line={"color": QUIET, "width": 1,
                "dash": "dot"},
                     marker={"color": rounded(force), "colorscale": "Viridis", "size": 9,
                         "line": {"color": "#ffffff", "width": 1},
                             "showscale": number == len(shown) - 1,
                             "colorbar": {"title": {"text": "g"}, "thickness": 12}},
                     text=[f"{f:.3g} g" for f in force], hovertemplate="%{text}<extra></extra>",
                     showlegend=number == 0, **where)
        )  # fmt: skip
        annotations += [
            {"x": z[index].real, "y": z[index].imag, "xref": x, "yref": y, "showarrow": True,
             "text": f"{force[index]:.3g} g", "arrowcolor": QUIET, "ax": 26, "ay": -24 if index else 24}
            for index in (0, len(rows) - 1)
        ]  # fmt: skip
    layout = _panels([f"{axis_label(p)}: along Y, deg/h/g" for p in shown], "along X, deg/h/g", gap=0.13)
    layout["annotations"] = annotations
    for number in range(len(shown)):
        x, y = names(number)
        layout[axis_key(y)] |= {"scaleanchor": x, "scaleratio": 1}
        layout[axis_key(x)] |= {"constrain": "domain"}
    caption = (
        "Where in the gyroscope's frame the drift per g is largest, and how large: points in a line outward are "
        "nonlinearity in size, across it a turning of the drift, which the magnitude does not show. The largest ring "
        "is that of the lowest level."
    )
    return Figure("Complex drift factor of each level", caption, traces, layout, height=440)


def _repeatability(record: Calibration, r: Centrifuge, sets: list[str]) -> Figure:
    """K of every run against its level's K, by power cycle."""
    traces: list[dict[str, Any]] = []
    axes = list(dict.fromkeys(p[0] for p in sets))
    cycles = sorted({row.power_cycle for row in r.runs if row.role == "loaded"})
    number_of = {run: row.level for row in r.levels for run in row.runs}
    for number, letter in enumerate(axes):
        for cycle_number, cycle in enumerate(cycles):
            x, y, bars = [], [], []
            for index, run in enumerate(r.runs):
                found = run.line(letter)
                if run.role != "loaded" or run.power_cycle != cycle or found is None or found.K is None:
                    continue
                prefix = f"{letter}_" + ("down_" if run.spin_axis == "down" else "")
                if index not in number_of:
                    raise RecordError(f"levels: none has run {index}")
                level = number_of[index]
                K = record.value(f"{prefix}K_{level}")
                x.append(level + 0.5 * ((cycle_number + 0.5) / len(cycles) - 0.5) + 0.06 * (run.sense < 0))
                y.append(100 * relative(found.K.value, K))
                bars.append(100 * (relative(found.K.standard_uncertainty or 0.0, K) + 1))
            colour = _CYCLES[cycle_number % len(_CYCLES)]
            traces.append(
                _scatter(x, y, f"power cycle {cycle:g}", "markers", **_place(number),
                         marker={"symbol": SYMBOLS[cycle_number % len(SYMBOLS)], "size": 7, "color": colour},
                         error_y={"type": "data", "array": bars, "thickness": 1, "width": 3, "color": QUIET},
                         showlegend=number == 0)
            )  # fmt: skip
    layout = _panels([f"{letter.upper()}: K off its level, %" for letter in axes], "level (number)")
    ticks = [row.level for row in r.levels]
    texts = [f"{row.level}<br>{from_si(row.specific_force.value, 'g'):.3g} g" for row in r.levels]
    for number in range(len(axes)):
        x_key, y_key = map(axis_key, names(number))
        layout[x_key] |= {"tickvals": ticks, "ticktext": texts}
        layout[y_key] |= {"zeroline": True, "zerolinecolor": QUIET}
    spread = r.fit.repeatability
    words = [
        f"{what} by {size:.2g} {unit} beyond their noise"
        for what, size, unit in (
            ("K differs from cycle to cycle", 100 * spread.relative_standard_deviation, "%"),
            ("its direction", np.degrees(spread.direction.value), "deg"),
            ("K differs from run to run", 100 * spread.within_power_cycle, "%"),
        )
        if size
    ]
    text = "; ".join(words) + ": in the uncertainties" if words else "The scatter is explained by the noise"
    said = f"{text}." if len(cycles) > 1 else "One power cycle only: nothing is known of repeatability."
    caption = f"K of each run, relative to that of its level; bars are one standard uncertainty of a run. {said}"
    return Figure("Repeatability over power cycles", caption, traces, layout, height=400)


def _spectra(r: Centrifuge) -> list[Figure]:
    """Spectra of X, FOG and residual around the table rate, at the lowest, a middle and the highest level."""
    found = [spectrum for spectrum in r.data.spectra if spectrum.spin_axis == r.data.spectra[0].spin_axis]
    if not found:
        return []
    picked = sorted({0, len(found) // 2, len(found) - 1})[:_SHOWN_SPECTRA]
    traces: list[dict[str, Any]] = []
    titles, annotations = [], []
    for number, index in enumerate(picked):
        spectrum = found[index]
        x, y = names(number)
        rate = from_si(np.array(spectrum.rate), "deg/s")
        lines = zip(_SPECTRA, (QUIET, "#b8860b", GOOD), ("solid", "dot", "dash"), strict=True)
        for (name, label), colour, dash in lines:
            height = np.maximum(from_si(np.array(spectrum.height[name]), "deg/h"), 1e-6)
            width = 2.4 if name == "residual_x" else 1.6
            traces.append(
                _scatter(rate, height, label, "lines", line={"color": colour, "width": width, "dash": dash},
                         **_place(number), showlegend=number == 0)
            )  # fmt: skip
        row = level_of(r.levels, spectrum.level)
        key = "x" if spectrum.spin_axis == "up" else "x_down"
        drift, a = row.line(key), row.specific_force.value
        if drift is None:
            raise RecordError(f"level {row.level} lacks {key}")
        K = abs(complex(drift.A, drift.B))
        line = from_si(K * a, "deg/h")
        centre = float(np.median(rate))
        traces.append(
            _scatter([centre], [line], "fitted K a", "markers", **_place(number),
                     showlegend=number == 0, marker={"color": BAD, "size": 10, "symbol": "circle-open",
                         "line": {"width": 2}})
        )  # fmt: skip
        titles.append("height, deg/h" if number == 0 else "")
        annotations.append(
            {"xref": f"{x} domain", "yref": f"{y} domain", "x": 0.0, "y": 1.01, "showarrow": False,
             "xanchor": "left", "yanchor": "bottom",
             "text": f"<b>{from_si(a, 'g'):.3g} g</b>: K a = {line:.3g} deg/h"}
        )  # fmt: skip
    layout = _panels(titles, "rate, deg/s", gap=0.07)
    layout["annotations"] = annotations
    layout["legend"]["y"] = 1.09
    layout["margin"]["t"] = 75
    for number in range(len(picked)):
        x, y = names(number)
        layout[axis_key(y)] |= {"type": "log", "tickvals": _DECADES, "ticktext": [f"{v:g}" for v in _DECADES]}
        layout[axis_key(x)] |= {"nticks": 5}
    return [Figure("Spectrum around the table rate", _SPECTRUM_CAPTION, traces, layout, height=425)]
