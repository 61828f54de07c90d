"""The figures and tables of a centrifuge record, from the record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.errors import LackingError, RecordError
from imulab.estimation.least_squares import coverage_factor
from imulab.procedures.centrifuge.manifest import curve
from imulab.procedures.centrifuge.schema import (
    BudgetError,
    CentrifugeRecord,
    CentrifugeSummary,
    CycleRow,
    DriftLine,
    LevelRow,
    RunRow,
    centrifuge_of,
    force_of,
    level_of,
)
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.parameters import reading_unit, rows_of
from imulab.report.traces import (
    BAD,
    GOOD,
    INK,
    LEGEND,
    QUIET,
    SYMBOLS,
    Exhibits,
    Figure,
    ReportTable,
    axis_key,
    band,
    figure_axis,
    format_uncertain,
    names,
    plain_number,
    rounded,
    scatter,
)
from imulab.units import STANDARD_GRAVITY, from_si

# The tables of a centrifuge record, in the units that people read: deg/h/g, per cent, arcsec, µrad/g.


PER_G = float(from_si(STANDARD_GRAVITY, "deg/h"))
"""deg/h/g in one rad/s/(m/s^2)."""
_BUDGET = {
    "rad": (180 * 3600 / np.pi, "arcsec"),
    "rad/(m/s^2)": (1e6 * STANDARD_GRAVITY, "µrad/g"),
    "s": (1e3, "ms"),
    "rad/s": (180 / np.pi, "deg/s"),
    "1": (100.0, "%"),
    "m": (1e6, "µm"),
}


def parameters_table(record: Calibration, fit: CentrifugeSummary) -> ReportTable:
    """Return every parameter with its uncertainty and interval."""
    rows = []
    for row in rows_of(record):
        u, nu = row.standard_uncertainty or 0.0, fit.degrees_of_freedom[row.name]
        half = fit.coverage_factor_95[row.name] * u
        ends = " to ".join(format_uncertain(row.value + sign * half, u)[0] for sign in (-1, 1))
        rows.append([row.name, *row.text(), ends, row.unit, "many" if nu > 999 else f"{nu:.0f}"])
    return ReportTable(
        title="Parameters",
        caption="K_i: drift per specific force at level i; zeta_i = K_i/K_1 − 1; K(a) = K0 (1 + c1 a + c2 a²), a "
        "term that is absent is 0; "
        f"direction: from X toward Y. Noise: {fit.noise}; 95 % intervals by Student's t.",
        columns=["parameter", "value", "standard uncertainty", "95 % interval", "unit", "degrees of freedom"],
        rows=rows,
    )


def level_table(record: Calibration, levels: list[LevelRow], sets: list[str]) -> ReportTable:
    """Return K and zeta at each level."""
    columns = ["level", "specific force, g", "runs"]
    for prefix in sets:
        label = prefix.rstrip("_").replace("_", " ")
        columns += [f"K {label}, deg/h/g", "u", f"zeta {label}, %", "u"]
    rows = []
    for level in levels:
        number = level.level
        row = [str(number), f"{from_si(level.specific_force.value, 'g'):.4g}", str(len(level.runs))]
        for prefix in sets:
            K = record.parameters.get(f"{prefix}K_{number}")
            zeta = record.parameters.get(f"{prefix}zeta_{number}")
            row += (
                ["–", "–"] if K is None else format_uncertain(K.value * PER_G, (K.standard_uncertainty or 0.0) * PER_G)
            )
            row += (
                ["–", "–"]
                if zeta is None
                else format_uncertain(100 * zeta.value, 100 * (zeta.standard_uncertainty or 0.0))
            )
        rows.append(row)
    return ReportTable(
        "K and zeta at each level", "u: standard uncertainty. All zeta share the error of K_1.", columns, rows
    )


def curve_table(fit: CentrifugeSummary, sets: list[str]) -> ReportTable:
    """Return the models of the curve that were tried."""
    rows = []
    for prefix in sets:
        curve = fit.curves[prefix.rstrip("_")]
        axis = prefix.rstrip("_").replace("_", " ")
        rows += [
            [axis, each.model, str(each.coefficients), f"{each.chi_square:.2f}", "chosen" * each.chosen]
            for each in curve.tried
        ]
    return ReportTable(
        "Terms of the curve",
        "Weighted fits to the K_i. A term is taken where it lowers chi-square by more than its 5 % point; a term that "
        "was not taken is 0, with the uncertainty of all these models together.",
        ["axis", "terms beside K0", "coefficients", "chi-square", ""],
        rows,
    )


def cycle_tables(cycles: list[CycleRow]) -> list[ReportTable]:
    """Return zeta of each power cycle by itself, where there are several; older records do not hold it."""
    if len(cycles) < 2:
        return []
    sets = [key for key in ("x", "y", "x_down", "y_down") if any(cycle.of(key) for cycle in cycles)]
    names = [n for n in dict.fromkeys(n for c in cycles for key in sets[:1] for n in c.of(key)) if "zeta" in n]
    if not names:
        return []
    rows = []
    for cycle in cycles:
        for key in sets:
            values = cycle.of(key)
            cells = [
                " ± ".join(format_uncertain(100 * z.value, 100 * (z.standard_uncertainty or 0.0))) if z else "–"
                for z in (values.get(name) for name in names)
            ]
            rows.append([f"{cycle.power_cycle:g}", key.replace("_", " "), *cells])
    return [
        ReportTable(
            "zeta of each power cycle, %",
            "Each K_i against K_1 of the same power cycle, ± its standard uncertainty.",
            ["power cycle", "axis", *names],
            rows,
        )
    ]


def budget_table(fit: CentrifugeSummary) -> ReportTable:
    """Return the error budget."""
    rows = []
    for entry in fit.error_budget:
        factor, unit = _BUDGET.get(entry.unit, (1.0, entry.unit))
        rows.append(
            [entry.error, "yes" if entry.bounded else "no", *_sized(entry, factor), unit, _share(entry.effect),
             "–" if entry.removed is None else _share(entry.removed), entry.basis]
        )  # fmt: skip
    return ReportTable(
        "Error budget (X axis)",
        "Effect on K at the highest level: what is left, and what subtraction or combination removed. Bounded: by "
        "these data; where not, value and effect are those of the size named.",
        ["error", "bounded", "value", "u", "unit", "effect on K", "removed", "from"],
        rows,
    )


def _sized(entry: BudgetError, factor: float) -> tuple[str, str]:
    value, u = entry.value, entry.standard_uncertainty
    if value is None:
        return "–", "–" if u is None else plain_number(u * factor, 2)
    if u is None or u == 0:
        return plain_number(value * factor, 3), "–"
    return format_uncertain(value * factor, u * factor)


def relative(value: float, other: float) -> float:
    """Return how much larger a value is than another, as a share; nan where that is 0."""
    return value / other - 1 if other else float("nan")


def _share(value: float) -> str:
    if value == 0:
        return "0"
    percent = 100 * abs(value)
    return "< 0.0001 %" if percent < 1e-4 else f"{plain_number(percent, 2)} %"


def run_table(runs: list[RunRow]) -> ReportTable:
    """Return what was measured in each run; a column that says the same of all runs goes to the caption."""
    axes = [axis for axis in "xy" if any(run.line(axis) is not None for run in runs)]
    origins = list(dict.fromkeys(run.table_rate_from for run in runs if run.role == "loaded"))
    varied = ["cycle"] * (len({run.power_cycle for run in runs}) > 1)
    varied += ["spin axis"] * (len({run.spin_axis for run in runs}) > 1)
    columns = ["run", "file", *varied, "g", "sense", "table rate, deg/s"]
    columns += ["from"] * (len(origins) > 1)
    columns += ["periods"]
    columns += [*(f"{axis.upper()} drift ± u, deg/h" for axis in axes), "FOG line, deg/h"]
    rows = []
    for index, run in enumerate(runs):
        row = [str(index + 1), " ".join([run.file, *([] if run.window is None else [run.window])])]
        row += [f"{run.power_cycle:g}" if name == "cycle" else run.spin_axis for name in varied]
        if run.role == "static":
            rows.append([*row, "0", "static", *["–"] * (len(columns) - len(row) - 2)])
            continue
        row += [
            f"{from_si(run.specific_force.value, 'g'):.4g}",
            f"{run.sense:+d}",
            f"{from_si(run.table_rate_used.value, 'deg/s'):.5f}",
        ]
        row += [run.table_rate_from] * (len(origins) > 1)
        row += [f"{run.periods:.0f}"]
        row += ["–" if (line := run.line(axis)) is None else " ± ".join(_line(line)) for axis in axes]
        rows.append([*row, _line(run.fog)[0]])
    source = f" Table rates from: {origins[0]}." if len(origins) == 1 else ""
    caption = (
        "Drift: what X and Y show at the table rate, less what the FOG shows there (rotation), with its standard "
        f"uncertainty u. Sense −1: both rates reversed.{source}"
    )
    return ReportTable("Runs", caption, columns, rows)


def _line(entry: DriftLine) -> tuple[str, str]:
    size = from_si(float(np.hypot(entry.A, entry.B)), "deg/h")
    u = from_si(float(np.sqrt(max(np.trace(np.array(entry.covariance)), 0.0) / 2)), "deg/h")
    return format_uncertain(size, u)


# What a centrifuge record says of each axis: its curve, a headline, facts, and a summary with uncertainties.


_CURVE = {
    name: reading_unit(unit, name)
    for name, unit in (("K0", "rad/s/(m/s^2)"), ("c1", "1/(m/s^2)"), ("c2", "1/(m/s^2)^2"))
}
"""The coefficients of the curve, and how they are read."""


def summary(record: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return the curve of each axis, and what it changes up to the highest level, with uncertainties."""
    sets, top = prefixes(record), force_of(record, max(level.level for level in centrifuge_of(record).levels))
    rows = []
    for prefix in sets:
        cells = []
        for name, read in _CURVE.items():
            parameter = record.parameters.get(f"{prefix}{name}")
            texts = ("–",) if parameter is None else read.texts(parameter.value, parameter.standard_uncertainty)
            cells.append(" ± ".join(texts))
        K, _ = curve_at(record, prefix, np.array([top]))
        change = 100 * relative(float(K[0]), record.value(f"{prefix}K0"))
        cells.append(" ± ".join(format_uncertain(change, 100 * change_uncertainty(record, prefix, top))))
        rows.append([axis_label(prefix), *cells])
    return [
        "axis",
        *(f"{name}, {read.symbol}" for name, read in _CURVE.items()),
        f"change at {text_in_g(top)}, %",
    ], rows


def headline(record: Calibration, prefix: str) -> str:
    """Return the g-sensitivity in one sentence, and by how much it departs from the linear."""
    levels = numbers(record, prefix)
    last = levels[-1]
    first, top = text_in_g(force_of(record, levels[0])), text_in_g(force_of(record, last))
    if last == levels[0]:
        return f"{axis_label(prefix)} drifts by {_per_g(record, f'{prefix}K_{last}')} at {first}."
    zeta = record.parameter(f"{prefix}zeta_{last}")
    measured = _change(zeta.value, zeta.standard_uncertainty)
    curved = change_uncertainty(record, prefix, force_of(record, last))
    if centrifuge_of(record).model.curve[prefix.rstrip("_")] == "constant":
        return (
            f"{axis_label(prefix)} drifts linearly with g, by {_per_g(record, f'{prefix}K0')} from {first} to {top}; "
            f"the factor at {top} is {measured} than that at {first}."
        )
    K, _ = curve_at(record, prefix, np.array([force_of(record, last)]))
    fitted = _change(relative(float(K[0]), record.value(f"{prefix}K0")), curved)
    return (
        f"{axis_label(prefix)} drifts by {_per_g(record, f'{prefix}K_{levels[0]}')} at {first}, its drift factor; "
        f"at {top} the factor is {measured} measured directly against {first}, and {fitted} by the curve through all "
        "levels."
    )


def facts(record: Calibration, sets: list[str]) -> list[tuple[str, str]]:
    """Return the figures that the head of a report shows: name and value."""
    lines = []
    for prefix in sets[:2]:
        K0 = record.parameter(f"{prefix}K0")
        value, u = format_uncertain(K0.value * PER_G, (K0.standard_uncertainty or 0.0) * PER_G, digits=1)
        digits = u.replace(".", "").lstrip("0")
        lines.append((f"K0 {axis_label(prefix)}, deg/h/g", f"{value}({digits})"))
    r = centrifuge_of(record)
    loaded = [row for row in r.runs if row.role == "loaded"]
    lines += [
        ("curve", ", ".join(dict.fromkeys(r.model.curve.values()))),
        ("levels", str(len(r.levels))),
        ("loaded runs", str(len(loaded))),
        ("highest level", text_in_g(r.model.highest_specific_force.value)),
    ]
    return lines


def _per_g(record: Calibration, name: str) -> str:
    K = record.parameter(name)
    value, u = format_uncertain(K.value * PER_G, (K.standard_uncertainty or 0.0) * PER_G)
    return f"{value} ± {u} deg/h per g"


def _change(share: float, uncertainty: float | None) -> str:
    change, u = format_uncertain(100 * abs(share), 100 * (uncertainty or 0.0))
    return f"{change} ± {u} % {'smaller' if share < 0 else 'larger'}"


def change_uncertainty(record: Calibration, prefix: str, force: float) -> float:
    """Return the standard uncertainty of K(a)/K0 - 1 from those of c1 and c2."""
    names = [n for n in (f"{prefix}c1", f"{prefix}c2") if n in record.parameters]
    if not names:
        return 0.0
    C = record.covariance.block(names)
    gradient = np.array([force if n.endswith("c1") else force**2 for n in names])
    return float(np.sqrt(max(gradient @ C @ gradient, 0.0)))


def curve_at(record: Calibration, prefix: str, force: Array) -> tuple[Array, Array]:
    """Return K(a), rad/s/(m/s^2), and its standard uncertainty at specific forces, m/s^2, shapes (n,)."""
    terms = {
        t: record.value(f"{prefix}{t}") if f"{prefix}{t}" in record.parameters else 0.0 for t in ("K0", "c1", "c2")
    }
    K = curve(force, **terms)
    names = [n for n in ("K0", "c1", "c2") if f"{prefix}{n}" in record.parameters]
    C = record.covariance.block([f"{prefix}{n}" for n in names])
    gradient = {"K0": K / terms["K0"], "c1": terms["K0"] * force, "c2": terms["K0"] * force**2}
    J = np.stack([gradient[n] for n in names], axis=1)
    return K, np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, C, J), 0.0))


def prefixes(record: Calibration) -> list[str]:
    """Return the sets of parameters that a record has: ``x_``, ``y_``, ``x_down_`` ..."""
    return [p for p in ("x_", "y_", "x_down_", "y_down_") if f"{p}K0" in record.parameters]


def numbers(record: Calibration, prefix: str) -> list[int]:
    """Return the levels of a set, rising."""
    return [row.level for row in centrifuge_of(record).levels if f"{prefix}K_{row.level}" in record.parameters]


def axis_label(prefix: str) -> str:
    """Return the words for a set of parameters: ``X``, or ``X, spin axis down``."""
    return prefix[0].upper() + (", spin axis down" if "down" in prefix else "")


def text_in_g(force: float) -> str:
    """Return a specific force, m/s^2, in g."""
    return f"{from_si(force, 'g'):.3g} g"


# Figures and tables of a record.


_POINTS = 121  # of a curve
_SHOWN_SPECTRA = 3  # the lowest, the middle and the highest level
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
        raise LackingError("the record lacks x_K0, or the K of any level")
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
    """Return the figure of the change of K over g: zeta and the fitted curve, each with its 95 % interval."""
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
    """Return half the 95 % interval of a parameter."""
    return (record.parameter(name).standard_uncertainty or 0.0) * factors[name]


def _place(number: int) -> dict[str, Any]:
    """Return the axes of a panel, as a trace names them."""
    return dict(zip(("xaxis", "yaxis"), names(number), strict=True))


def _panels(titles: list[str], below: str, gap: float = 0.09) -> dict[str, Any]:
    """Return the layout of panels side by side, with the legend above."""
    count = len(titles)
    width = (1 - gap * (count - 1)) / count
    layout: dict[str, Any] = {
        "legend": dict(LEGEND),
        "margin": {"l": 70, "r": 20, "t": 50, "b": 55},
    }
    for number, title in enumerate(titles):
        x, y = names(number)
        start = number * (width + gap)
        layout[axis_key(x)] = figure_axis(below, domain=[start, start + width], anchor=y, automargin=True)
        layout[axis_key(y)] = figure_axis(title, anchor=x, automargin=True)
    return layout


def _polar(record: Calibration, sets: list[str]) -> Figure:
    """Return the figure of each level's complex K in the gyroscope's frame."""
    traces: list[dict[str, Any]] = []
    shown = [p for p in sets if "down" not in p] or sets
    annotations = []
    for number, prefix in enumerate(shown):
        x, y = names(number)
        where = _place(number)
        key = prefix[0] if "down" not in prefix else f"{prefix[0]}_down"
        rows = [(row, line) for row in centrifuge_of(record).levels if (line := row.line(key)) is not None]
        if not rows:
            raise LackingError(f"the record lacks levels with {key}")
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


def _repeatability(record: Calibration, r: CentrifugeRecord, sets: list[str]) -> Figure:
    """Return the figure of every run's K against its level's, by power cycle."""
    traces: list[dict[str, Any]] = []
    axes = list(dict.fromkeys(p[0] for p in sets))
    cycles = sorted({row.power_cycle for row in r.runs if row.role == "loaded"})
    number_of = {run: row.level for row in r.levels for run in row.runs}
    for number, letter in enumerate(axes):
        for cycle_number, cycle in enumerate(cycles):
            x, y, bars = [], [], []
            for index, run in enumerate(r.runs):
                run_line = run.line(letter)
                if run.role != "loaded" or run.power_cycle != cycle or run_line is None or run_line.K is None:
                    continue
                prefix = f"{letter}_" + ("down_" if run.spin_axis == "down" else "")
                if index not in number_of:
                    raise RecordError(f"levels: none has run {index}")
                level = number_of[index]
                K = record.value(f"{prefix}K_{level}")
                x.append(level + 0.5 * ((cycle_number + 0.5) / len(cycles) - 0.5) + 0.06 * (run.sense < 0))
                y.append(100 * relative(run_line.K.value, K))
                bars.append(100 * (relative(run_line.K.standard_uncertainty or 0.0, K) + 1))
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
    message = f"{text}." if len(cycles) > 1 else "One power cycle only: nothing is known of repeatability."
    caption = f"K of each run, relative to that of its level; bars are one standard uncertainty of a run. {message}"
    return Figure("Repeatability over power cycles", caption, traces, layout, height=400)


def _spectra(r: CentrifugeRecord) -> list[Figure]:
    """Return spectra of X, FOG and residual around the table rate, at the lowest, a middle and the highest level."""
    shown = [spectrum for spectrum in r.data.spectra if spectrum.spin_axis == r.data.spectra[0].spin_axis]
    if not shown:
        return []
    picked = sorted({0, len(shown) // 2, len(shown) - 1})[:_SHOWN_SPECTRA]
    traces: list[dict[str, Any]] = []
    titles, annotations = [], []
    for number, index in enumerate(picked):
        spectrum = shown[index]
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
            raise LackingError(f"level {row.level} lacks {key}")
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
