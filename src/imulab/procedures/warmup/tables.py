"""The tables of a warm-up record, and its numbers as text."""

from __future__ import annotations

import numpy as np

from imulab.estimation.ranked import rms
from imulab.procedures.warmup.engineering import engineering_unit
from imulab.procedures.warmup.model import WarmupTable
from imulab.procedures.warmup.sections import Fit, Warmup
from imulab.report.elements import ReportTable, plain_number

_LOST = "in noise"


def models_table(drawn: Warmup, table: WarmupTable, kind: str, index: list[int]) -> ReportTable:
    """Return the models that were compared, over the axes of one kind."""
    label, factor = engineering_unit(table.units[index[0]])
    rows, highlight = [], None
    fit = drawn.fit
    for number, row in enumerate(fit.models):
        if row.chosen:
            highlight = number
        scales = ", ".join(plain_number(value, 3) for value in row.scales) or "–"
        none = row.model == "none"
        rows.append(
            [
                row.model,
                rms_text(row.training, index, factor),
                "–" if none else rms_text(row.left_cycle, index, factor),
                rms_text(row.left_temperature, index, factor),
                "–" if none else largest_text(row.edge_jump, index, factor),
                "–" if none else largest_text(row.exit_jump, index, factor),
                scales,
            ]
        )
    floor = rms_text(fit.repeatability.cycle, index, factor, f" {label}")
    what = "unit" if drawn.model.pool == "type" else "cycle"
    return ReportTable(
        title=f"Models compared, {kind}, {label}",
        caption="Root mean square over all axes and the time t after power-on up to T_M, from which the unit is "
        "settled and nothing is subtracted; white noise taken off. Z is what the table subtracts. Columns: the cycles "
        f"fitted, of each {what} left out, of each temperature left out (its neighbours are then twice as far as in "
        "use); largest jump where a power-on temperature crosses an edge; largest |Z(T_M)|, which exit zero drops at "
        f"once. No table can beat the repeatability of cycles, {floor}.",
        columns=["model", "at tests", f"{what} left out", "temp. left out", "edge jump", "|Z(T_M)|", "tau, s"],
        rows=rows,
        highlight=highlight,
    )


def units_table(fit: Fit, table: WarmupTable, kinds: dict[str, list[int]], units: list[float | None]) -> ReportTable:
    """Return whether one table for the type is enough, axis by axis."""
    found = fit.repeatability
    rows = []
    for index in kinds.values():
        for i in index:
            label, factor = engineering_unit(table.units[i])
            unit, cycle, uncertainty = units[i], found.cycle[i], found.standard_uncertainty[i]
            verdict = "–"
            if unit is not None and cycle is not None and uncertainty is not None:
                verdict = "each unit" if unit > cycle + 2 * uncertainty else "one per type"
            shown = [rms_text(values, [i], factor) for values in (units, found.cycle)]
            rows.append([table.axes[i], *shown, verdict, label])
    return ReportTable(
        title=f"Spread between {fit.units} units",
        caption="Root mean square deviation of a unit's curve from that of the type, beside that of a cycle from its "
        "unit. Where units differ clearly more than their cycles do (by two standard uncertainties of the latter), a "
        "table for each unit would gain; otherwise one per type is enough.",
        columns=["axis", "between units", "between cycles", "table for", "unit"],
        rows=rows,
    )


def tests_table(drawn: Warmup, table: WarmupTable) -> ReportTable:
    """Return what each calibration temperature showed, over the axes of the first kind."""
    label, factor = engineering_unit(table.units[0])
    head = next(iter(axes_by_kind(table).values()))
    chosen = drawn.fit.row()
    rows = []
    for k, at in enumerate(drawn.data.knots):
        members = [cycle for cycle in drawn.data.cycles if cycle.calibration_temperature == at]
        power_on = [cycle.power_on_temperature for cycle in members]
        drift = [None if (moved := cycle.settled_drift[i]) is None else abs(moved) for cycle in members for i in head]
        rows.append(
            [
                f"{at:g}",
                str(len(members)),
                f"{min(power_on):.2f} to {max(power_on):.2f}",
                rms_text(drawn.fit.repeatability.by_temperature[k], head, factor),
                rms_text(chosen.by_temperature[k], head, factor),
                rms_text(chosen.left_by_temperature[k], head, factor),
                largest_text(drift, list(range(len(drift))), factor),
                f"{min(cycle.end for cycle in members):g}",
            ]
        )
    return ReportTable(
        title=f"The test, by temperature ({label})",
        caption="Repeatability, what is left, and what is left where this temperature was kept out of the fit; largest "
        "change of the settled part from T_M to its end; end of the shortest cycle.",
        columns=["degC", "cycles", "power-on, degC", "repeatability", "left", "left out", "settled drift", "end, s"],
        rows=rows,
    )


def axes_by_kind(table: WarmupTable) -> dict[str, list[int]]:
    """Return the numbers of the gyroscopes' axes, and of the accelerometers'."""
    found: dict[str, list[int]] = {}
    for i, axis in enumerate(table.axes):
        found.setdefault("gyroscopes" if axis.startswith("gyro") else "accelerometers", []).append(i)
    return found


def rms_of(values: list[float | None] | None, index: list[int]) -> float:
    """Return the root mean square of the values of some axes, nan where one is not known."""
    chosen = [values[i] for i in index] if values else [None]
    if any(value is None for value in chosen):
        return float("nan")
    return rms(np.array(chosen, dtype=np.float64))


def rms_text(values: list[float | None] | None, index: list[int], factor: float, unit: str = "") -> str:
    """Return the root mean square of some axes as text; what is not above the white noise has no number."""
    value = rms_of(values, index) * factor
    if np.isnan(value):
        return "–"
    return f"{plain_number(value, 2)}{unit}" if value > 0 else _LOST


def largest_text(values: list[float | None], index: list[int], factor: float) -> str:
    """Return the largest of the values of some axes as text."""
    known = [value for i in index if (value := values[i]) is not None]
    return plain_number(max(known) * factor, 2) if known else "–"
