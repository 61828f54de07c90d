"""The report of a fleet: the line's statistics from records, history and limits as one HTML file."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from typing import Annotated

from imulab.arguments import Folder
from imulab.errors import OptionError, first_of
from imulab.files import write_page
from imulab.fleet import figures
from imulab.fleet.engine import Summary
from imulab.fleet.history import History, open_history
from imulab.fleet.limits import load_limits
from imulab.fleet.run import HISTORY, FleetState, default_history, fleet_status, own_files, read_by, refuse_overwriting
from imulab.fleet.statistics import (
    FEWEST_FOR_OUTLIERS,
    FleetChange,
    ParameterStatistics,
    change_limit,
    changes_since,
    line_statistics,
    not_compared,
    parameter_units,
)
from imulab.fleet.store import Store
from imulab.options import file, text
from imulab.procedures.registry import PROCEDURES
from imulab.report import render_page
from imulab.report.traces import Exhibits, Figure, ReportTable

_NAMED = 4  # units that a sentence names
_FEWEST_TO_DRAW = 4
"""Fewest units with a figure of their distribution."""


def write_fleet_report(
    folder: Folder,
    output: str | PathLike[str],
    *,
    limits: Annotated[str | PathLike[str] | None, file("L.toml")] = None,
    history: Annotated[str | None, text("URL")] = None,
) -> None:
    """Write the statistics of a fleet's records.

    Parameters
    ----------
    folder, output
        Folder of the fleet, and HTML file to write.
    limits
        Limits of parameters, for Cpk. None if not given.
    history
        As for `run_fleet`. That in the folder where there is one, if not given.

    Raises
    ------
    ReadError, UnitError, OptionError
        The folder, the limits or the history cannot be used, or there is no record yet.

    Examples
    --------
    >>> import imulab as il
    >>> first, second = il.simulate_fleet("line", units=8)
    >>> il.run_fleet(first, "line/records", workers=1).count("failed")
    0
    >>> il.write_fleet_report("line/records", "line.html", limits="line/limits.toml")
    """
    output = os.fspath(output)
    folder, limits = os.fspath(folder), None if limits is None else os.fspath(limits)
    state = fleet_status(folder)
    refuse_overwriting([Path(output)], {**own_files(Store(Path(folder)), state.manifest), **read_by(state.manifest)})
    exhibits, summaries = _exhibits(state, limits, history)
    provenance = [
        ("folder", folder),
        ("manifest", state.manifest.name),
        ("units", f"{len(state.rows)}: {', '.join(f'{state.count(s)} {s}' for s in ('done', 'failed', 'missing'))}"),
        ("limits", limits or "none given"),
        ("records made", " to ".join(sorted({min(s.created for s in summaries), max(s.created for s in summaries)}))),
        ("software", ", ".join(sorted({summary.software for summary in summaries}))),
    ]
    write_page(
        output,
        render_page("Fleet", Path(folder).name, exhibits, provenance=provenance, notes=_warnings(state)),
    )


def exhibits_of_folder(folder: str, *, limits: str | None = None, history: str | None = None) -> Exhibits:
    """Return the figures and tables of a fleet's folder; options and errors as for `write_fleet_report`."""
    return _exhibits(fleet_status(folder), limits, history)[0]


def _exhibits(state: FleetState, limits: str | None, history: str | None) -> tuple[Exhibits, list[Summary]]:
    """Return the figures and tables, and the summaries that they are made from."""
    summaries = [row.summary for row in state.rows if row.summary is not None]
    if not summaries:
        raise OptionError(
            f"{state.folder}: no records yet: {state.count('failed')} units failed, the others are missing"
        )
    known = {} if limits is None else load_limits(limits, parameter_units(summaries))
    statistics = line_statistics(summaries, known)
    with ExitStack() as stack:
        past = _history(state.folder, history, stack)
        changes = [] if past is None else changes_since(summaries, past.of([summary.serial for summary in summaries]))
    return fleet_exhibits(state, statistics, changes), summaries


def fleet_exhibits(
    state: FleetState, statistics: Sequence[ParameterStatistics], changes: Sequence[FleetChange]
) -> Exhibits:
    """Return the figures and tables of a fleet's report."""
    out = {serial for item in statistics for serial, o in zip(item.serials, item.outliers, strict=True) if o}
    capable = [item for item in statistics if item.capability is not None]
    drifting = [item.name for item in statistics if item.drift is not None and item.drift.significant]
    fresh = [change for change in changes if not change.same_files]
    limited = any(item.limits is not None for item in statistics)
    moved = {change.serial for change in fresh if abs(change.deviations or 0.0) > change_limit(len(fresh))}
    facts = [
        ("units done", f"{state.count('done')} of {len(state.rows)}"),
        ("failed", str(state.count("failed"))),
        ("records to look at first", str(len(state.doubtful))),
        *([("beyond the limits", str(len(figures.beyond_limits(statistics)[0])))] if limited else []),
        ("units that stand out", str(len(out)) if any(item.enough for item in statistics) else "–"),
        ("parameters that drift", str(len(drifting))),
    ]
    phrases = [f"{state.count('done')} of {len(state.rows)} units have their record"]
    doubtful = first_of([row.unit.serial for row in state.doubtful], _NAMED)
    phrases[0] += (state.verdicts and f": {state.verdicts}") + (doubtful and f" ({doubtful})")
    if state.failures:
        phrases.append(f"{len(state.failures)} failed")
    phrases += _beyond(statistics)
    phrases += _standing(statistics, out)
    if drifting:
        phrases.append(f"{first_of(drifting, _NAMED)} {'drifts' if len(drifting) == 1 else 'drift'} over the date")
    if capable:
        worst = min(capable, key=lambda item: item.capability.cpk if item.capability else 0.0)
        if worst.capability is not None:
            facts.append(("smallest Cpk", f"{worst.capability.cpk:.2f}"))
            phrases.append(f"the smallest Cpk is {worst.capability.cpk:.2f} ({worst.name})")
    if fresh:
        facts.append(("changed since last", str(len(moved))))
    if moved:
        phrases.append(f"{first_of(sorted(moved), _NAMED)} changed since the last calibration")
    items: list[Figure | ReportTable | None] = [figures.failure_table(state.failures), figures.limits_table(statistics)]
    verdicts = figures.verdict_table(state)
    items += [verdicts] if state.doubtful else []
    for procedure in dict.fromkeys(item.procedure for item in statistics):
        title = PROCEDURES[procedure].line_title
        mine = [item for item in statistics if item.procedure == procedure]
        enough = max(len(item.values) for item in mine) >= _FEWEST_TO_DRAW
        items += [
            *(figures.distributions(title, mine) if enough else []),
            figures.summary_table(title, mine),
            *(figures.over_date(title, mine) if enough else []),
            figures.change_figure(title, [change for change in changes if change.procedure == procedure]),
        ]
    items += [figures.outlier_table(statistics), figures.change_table(changes)]
    items += [] if state.doubtful else [verdicts]
    return Exhibits("; ".join(phrases) + ".", facts, [item for item in items if item is not None])


def _beyond(statistics: Sequence[ParameterStatistics]) -> Iterator[str]:
    """Return a sentence on the units beyond their limits, where there are limits."""
    units, parameters = figures.beyond_limits(statistics)
    if units:
        verb = "is" if len(units) == 1 else "are"
        yield f"{first_of(units, _NAMED)} {verb} beyond the limits of {first_of(parameters, _NAMED)}"
    elif any(item.limits is not None for item in statistics):
        yield "none is beyond the limits"


def _standing(statistics: Sequence[ParameterStatistics], out: set[str]) -> Iterator[str]:
    """Return a sentence on the units that stand out, and on procedures with too few units to tell."""
    if any(item.enough for item in statistics):
        named = f"{first_of(sorted(out), _NAMED)} {'stands' if len(out) == 1 else 'stand'} out"
        yield named if out else "none stands out"
    most: dict[str, int] = {}
    for item in statistics:
        most[item.procedure] = max(most.get(item.procedure, 0), len(item.values))
    for procedure, count in most.items():
        if count < FEWEST_FOR_OUTLIERS:
            procedure_named = f" of {PROCEDURES[procedure].line_title}" if len(most) > 1 else ""
            yield f"too few units{procedure_named} ({count} of {FEWEST_FOR_OUTLIERS}) to tell which stands out"


def _history(folder: str, url: str | None, stack: ExitStack) -> History | None:
    if url == "none":
        return None
    if url is None:
        if not (Path(folder) / HISTORY).is_file():
            return None
        url = default_history(folder)
    return stack.enter_context(open_history(url, there=True))


def _differing(summaries: Sequence[Summary]) -> Iterator[str]:
    """Return a sentence on the parameters that are not compared between units, and on their substitutes."""
    reasons = {procedure: why for (procedure, _), why in not_compared(summaries).items()}
    for procedure, why in reasons.items():
        mine = [summary for summary in summaries if summary.procedure == procedure and summary.on_line is not None]
        title = PROCEDURES[procedure].line_title
        bare = [summary.serial for summary in mine if summary.on_line and not summary.on_line.parameters]
        yield (
            f"{title}: the units have a {why}, so their coefficients mean different things: they are not compared, and "
            "no limit of them is applied. What is compared is named with its temperature, as in 'bias_x at 20.0 degC', "
            "for the units that were measured there."
        )
        if bare:
            yield f"{title}: {first_of(bare, _NAMED)} took in no such temperature and cannot be compared."


def _warnings(state: FleetState) -> list[str]:
    summaries = [row.summary for row in state.rows if row.summary is not None]
    notes = list(_differing(summaries))
    if state.at_work:
        notes.append(
            f"A run is at work on the folder ({state.at_work}): this is what was there when the report was made."
        )
    missing = state.count("missing")
    if missing:
        notes.append(f"{missing} units have no record yet.")
    return notes
