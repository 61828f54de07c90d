"""The tables of a centrifuge record, in the units that people read: deg/h/g, per cent, arcsec, µrad/g."""

from __future__ import annotations

import numpy as np

from imulab.procedures.centrifuge.sections import CycleRow, Error, Fit, Level, Line, Run
from imulab.records.calibration import Calibration
from imulab.report.elements import ReportTable, format_uncertain, plain_number
from imulab.units import STANDARD_GRAVITY, from_si

PER_G = float(from_si(STANDARD_GRAVITY, "deg/h"))
"""deg/h/g in one rad/s/(m/s^2)."""

ENGINEERING = {
    "K": (PER_G, "deg/h/g"),
    "K0": (PER_G, "deg/h/g"),
    "zeta": (100.0, "%"),
    "c1": (1e6 * STANDARD_GRAVITY, "ppm/g"),
    "c2": (1e6 * STANDARD_GRAVITY**2, "ppm/g²"),
    "direction": (180 / np.pi, "deg"),
    "cross": (PER_G * STANDARD_GRAVITY, "deg/h/g²"),
}
"""By the stem of a parameter: factor from SI, and unit."""
_BUDGET = {
    "rad": (180 * 3600 / np.pi, "arcsec"),
    "rad/(m/s^2)": (1e6 * STANDARD_GRAVITY, "µrad/g"),
    "s": (1e3, "ms"),
    "rad/s": (180 / np.pi, "deg/s"),
    "1": (100.0, "%"),
    "m": (1e6, "µm"),
}


def parameters_table(record: Calibration, fit: Fit) -> ReportTable:
    """Return every parameter with its uncertainty and interval."""
    rows = []
    for name, parameter in record.parameters.items():
        stem = next((part for part in name.split("_")[1:] if part != "down"), "")
        factor, unit = ENGINEERING.get(stem, (1.0, parameter.unit))
        value, u = parameter.value * factor, (parameter.standard_uncertainty or 0.0) * factor
        ends = " to ".join(format_uncertain(value + sign * fit.coverage_factor_95[name] * u, u)[0] for sign in (-1, 1))
        nu = fit.degrees_of_freedom[name]
        rows.append([name, *format_uncertain(value, u), ends, unit, "many" if nu > 999 else f"{nu:.0f}"])
    return ReportTable(
        title="Parameters",
        caption="K_i: drift per specific force at level i; zeta_i = K_i/K_1 − 1; K(a) = K0 (1 + c1 a + c2 a²), a "
        "term that is absent is 0; "
        f"direction: from X toward Y. Noise: {fit.noise}; 95 % intervals by Student's t.",
        columns=["parameter", "value", "standard uncertainty", "95 % interval", "unit", "degrees of freedom"],
        rows=rows,
    )


def level_table(record: Calibration, levels: list[Level], sets: list[str]) -> ReportTable:
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


def curve_table(fit: Fit, sets: list[str]) -> ReportTable:
    """Return the models of the curve that were tried."""
    rows = []
    for prefix in sets:
        found = fit.curves[prefix.rstrip("_")]
        axis = prefix.rstrip("_").replace("_", " ")
        rows += [
            [axis, each.model, str(each.coefficients), f"{each.chi_square:.2f}", "chosen" * each.chosen]
            for each in found.tried
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
            found = cycle.of(key)
            cells = [
                " ± ".join(format_uncertain(100 * z.value, 100 * (z.standard_uncertainty or 0.0))) if z else "–"
                for z in (found.get(name) for name in names)
            ]
            rows.append([str(cycle.power_cycle), key.replace("_", " "), *cells])
    return [
        ReportTable(
            "zeta of each power cycle, %",
            "Each K_i against K_1 of the same power cycle, ± its standard uncertainty.",
            ["power cycle", "axis", *names],
            rows,
        )
    ]


def budget_table(fit: Fit) -> ReportTable:
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


def _sized(entry: Error, factor: float) -> tuple[str, str]:
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


def run_table(runs: list[Run]) -> ReportTable:
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
        row += [str(run.power_cycle if name == "cycle" else run.spin_axis) for name in varied]
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


def _line(entry: Line) -> tuple[str, str]:
    size = from_si(float(np.hypot(entry.A, entry.B)), "deg/h")
    u = from_si(float(np.sqrt(max(np.trace(np.array(entry.covariance)), 0.0) / 2)), "deg/h")
    return format_uncertain(size, u)
