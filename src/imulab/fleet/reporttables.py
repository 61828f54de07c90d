"""The tables of a fleet's report: every parameter, units that stand out, changes, failures."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from imulab.fleet.display import display_of
from imulab.fleet.run import FleetState
from imulab.fleet.statistics import FleetChange, ParameterStatistics, change_limit
from imulab.fleet.table import Row
from imulab.report.elements import ReportTable, format_uncertain, plain_number

_MOST_ROWS = 40


def number(value: float, digits: int = 4) -> str:
    """Return a number as text, an infinite or unknown one as a dash."""
    return plain_number(value, digits) if math.isfinite(value) else "–"


def summary_table(title: str, statistics: Sequence[ParameterStatistics]) -> ReportTable:
    """Return one line for each parameter: where it lies, how it spreads, what stands out, drifts, and is capable of."""
    rows = []
    for item in statistics:
        shown = display_of(item.unit)
        factor = abs(shown.factor)
        robust = item.robust_deviation * factor
        median = shown.of(item.median)
        stated = item.uncertainties[np.isfinite(item.uncertainties)]
        typical = float(np.median(stated)) * factor if stated.size else 0.0
        places = _places(robust or typical or abs(median))
        several = len(item.values) > 1
        drift = "–"
        if item.drift is not None:
            slope, error = format_uncertain(item.drift.per_day * factor, item.drift.standard_uncertainty * factor)
            drift = f"{slope} ± {error}" + (" !" if item.drift.significant else "")
        capable, beyond = "–", "–"
        if item.capability is not None:
            capable = f"{item.capability.cpk:.2f} (≥ {item.capability.at_least:.2f})"
            beyond = str(len(item.capability.beyond))
        rows.append(
            [
                item.name,
                shown.unit,
                str(len(item.values)),
                f"{median:.{places}f}",
                number(robust, 3) if several else "–",
                number(item.deviation * factor, 3) if several else "–",
                number(typical, 3) if stated.size else "–",
                str(int(item.outliers.sum())) if item.enough else "–",
                drift,
                capable,
                beyond,
            ]
        )
    titles = ["parameter", "unit", "units", "median", "robust σ", "σ", "typical u", "stand out", "drift per day"]
    return ReportTable(
        f"{title}: every parameter",
        "Robust σ is 1.4826 times the median distance from the median; where σ is much larger, single units stand out. "
        "Where the typical standard uncertainty u is not well below σ, the spread is the calibration's, not the "
        "sensors'. Drift is a straight line over the date, ± one standard uncertainty, ! where chance would give it "
        "less than once in a thousand. Cpk = min(USL − mean, mean − LSL) / 3σ, with its one-sided 95 % bound.",
        [*titles, "Cpk", "beyond"],
        rows,
    )


def _places(scale: float) -> int:
    """Decimals that show a hundredth of a scale."""
    if not scale > 0 or not math.isfinite(scale):
        return 3
    return min(max(0, 2 - math.floor(math.log10(scale))), 9)


def outlier_table(statistics: Sequence[ParameterStatistics]) -> ReportTable | None:
    """List the units that stand out, furthest first."""
    rows = []
    for item in statistics:
        shown = display_of(item.unit)
        for i in np.flatnonzero(item.outliers).tolist():
            value, error = format_uncertain(
                float(shown.of(float(item.values[i]))), float(item.uncertainties[i]) * abs(shown.factor)
            )
            rows.append(
                (abs(float(item.z[i])), [item.serials[i], item.name, value, error, shown.unit, f"{item.z[i]:+.1f}"])
            )
    if not rows:
        return None
    rows.sort(key=lambda row: -row[0])
    more = f" The first {_MOST_ROWS} of {len(rows)}." if len(rows) > _MOST_ROWS else ""
    return ReportTable(
        "Units that stand out",
        "Robust z: distance from the median in robust standard deviations." + more,
        ["serial", "parameter", "value", "u", "unit", "robust z"],
        [row for _, row in rows[:_MOST_ROWS]],
    )


def change_table(changes: Sequence[FleetChange]) -> ReportTable | None:
    """List the largest changes since the last calibration."""
    if not changes:
        return None
    ranked = sorted(changes, key=lambda change: (change.same_files, -abs(change.deviations or 0.0)))
    limit = change_limit(sum(not change.same_files for change in changes))
    rows = []
    for change in ranked[:_MOST_ROWS]:
        shown = display_of(change.unit)
        factor = abs(shown.factor)
        u = None if change.standard_uncertainty is None else change.standard_uncertainty * factor
        difference, error = format_uncertain((change.new - change.old) * shown.factor, u)
        z = change.deviations
        remark = "same files, fitted again" if change.same_files else "changed" if z and abs(z) > limit else ""
        rows.append(
            [
                change.serial, change.name, difference, error, shown.unit,
                "–" if z is None else f"{z:+.1f}", change.before[:16].replace("T", " "), remark,
            ]
        )  # fmt: skip
    again = sum(change.same_files for change in changes)
    return ReportTable(
        "Largest changes since the last calibration",
        f"{len(changes)} parameters have an earlier value; the first {len(rows)} by their change in normal "
        "deviations, with the uncertainties of both calibrations."
        + (" Values of the same files fitted again share their noise: no uncertainty applies." if again else ""),
        ["serial", "parameter", "change", "u", "unit", "deviations", "last calibration", "remark"],
        rows,
    )


def verdict_table(state: FleetState) -> ReportTable | None:
    """List the verdict of every unit that has a record, the gravest first."""
    good = [row for row in state.rows if row.verdict == "good"]
    rows = [*state.doubtful, *good]
    if not rows:
        return None
    more = f" The first {_MOST_ROWS} of {len(rows)}; parameters.csv has all." if len(rows) > _MOST_ROWS else ""
    return ReportTable(
        "The verdict of each unit",
        "Look: understand the reason before you use the record. Bad: do not use it as it is. "
        "imulab show SERIAL.json has all that a record says." + more,
        ["serial", "procedure", "verdict", "reason"],
        [[row.unit.serial, row.unit.procedure, row.verdict, row.first_reason or "–"] for row in rows[:_MOST_ROWS]],
        message=f"{len(good)} of {len(rows)} are good.",
    )


def failure_table(failures: Sequence[Row]) -> ReportTable | None:
    """List the units that failed."""
    if not failures:
        return None
    more = f" The first {_MOST_ROWS} of {len(failures)}." if len(failures) > _MOST_ROWS else ""
    return ReportTable(
        "Units that failed",
        "They have no record; the next run tries them again." + more,
        ["serial", "file", "reason"],
        [[row.unit.serial, "; ".join(row.unit.files), row.reason] for row in failures[:_MOST_ROWS]],
    )
