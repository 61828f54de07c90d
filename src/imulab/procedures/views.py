"""What recordings and records show of themselves, and what is done with them next: `imulab.views.Views`.

`Recording` and `Calibration` lie below all procedures; their methods ask the package for this module when called.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from imulab.errors import OptionError, RecordError, listed
from imulab.procedures.apply import apply
from imulab.procedures.exporting import export as export_records
from imulab.procedures.inputs import as_recording
from imulab.procedures.loading import load as load
from imulab.procedures.procedure import Row
from imulab.procedures.registry import procedure_of
from imulab.procedures.reports import exhibits_of, parameter_rows
from imulab.procedures.reports import write_report as write_report
from imulab.reading import Reading
from imulab.recording import Recording
from imulab.records.calibration import Calibration
from imulab.report.channels import channel_figures
from imulab.report.elements import format_uncertain
from imulab.report.plots import Plot, Plots
from imulab.shown import LINES, WIDTH, aligned, html_table
from imulab.verdict import SENTENCES

_COLOURS = {"good": "#1f6f8b", "look": "#b58a1b", "bad": "#c8553d"}
_STYLE = "border-left: 4px solid {}; padding: 2px 10px; margin: 6px 0"


def text(record: Calibration) -> str:
    """Return a record in a few lines: what it is of, its verdict, its headline, its parameters."""
    verdict = record.verdict
    reasons = f": {_short(verdict.reasons[0])}" if verdict.reasons else ""
    more = f" (and {len(verdict.reasons) - 1} more)" if len(verdict.reasons) > 1 else ""
    lines = [_title(record), f"{verdict.state}: {SENTENCES[verdict.state]}{reasons}{more}"]
    lines += [headline] if (headline := _headline(record)) else []
    rows = [f"  {_short(line)}" for line in aligned(*found)] if (found := _summary(record))[1] else _grouped(record)
    room = LINES - len(lines)
    if len(rows) > room:
        rows = [*rows[: room - 1], f"  ... and {len(rows) - room + 1} more: to_frame() has all parameters"]
    return "\n".join(lines + rows)


def html(record: Calibration) -> str:
    """Return a record as HTML: what it is of, its verdict, its headline, its parameters."""
    verdict = record.verdict
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in verdict.reasons)
    rows = [[row.name, *_number(row), row.unit] for row in parameter_rows(record)]
    table = html_table(["parameter", "value", "standard uncertainty", "unit"], rows)
    titles, first = _summary(record)
    if first:
        table = f"{html_table(titles, first)}<details><summary>all parameters</summary>{table}</details>"
    return (
        f"<div><strong>{escape(_title(record))}</strong>"
        f'<div style="{_STYLE.format(_COLOURS[verdict.state])}">{escape(verdict.state)}: '
        f"{escape(SENTENCES[verdict.state])}<ul>{reasons}</ul></div>"
        f"<p>{escape(_headline(record))}</p>{table}</div>"
    )


def plots(record: Calibration, name: str | int | None) -> Plots | Plot:
    """Return the figures of a record's report, or the one of this name."""
    found = Plots(exhibits_of(record).figures, _title(record))
    return found if name is None else found[name]


def apply_to(
    record: Calibration, data: Any, reading: Mapping[str, Any] | Reading, *, again: bool, heading: bool
) -> Recording:
    """Return data corrected by a record."""
    return apply(record, as_recording(data, reading, Calibration.apply), again=again, heading=heading)


def export_to(record: Calibration, target: str, folder: str | Path, **options: Any) -> list[Path]:
    """Write a record in the form of another program."""
    known = [name for name in signature(export_records).parameters if name not in ("to", "records", "folder")]
    for name in options:
        if name not in known:
            raise OptionError(f"export: unknown option {name!r}; known: {listed(known, name)}")
    return export_records(target, record, folder, **options)


def recording_html(recording: Recording) -> str:
    """Return a recording as HTML: its length, and the range of each column."""
    rows = []
    for name, values in recording.columns.items():
        finite = values[np.isfinite(values)]
        ends = (finite.min(), finite.mean(), finite.max()) if finite.size else ()
        missing = str(len(values) - finite.size) if finite.size < len(values) else ""
        rows.append([name, recording.units[name], *([f"{end:.6g}" for end in ends] or ["–"] * 3), missing])
    time = recording.time
    length = "" if time is None or len(time) < 2 else f" over {time[-1] - time[0]:.6g} s"
    head = "".join(f"<br>{escape(key)}: {escape(value)}" for key, value in recording.metadata.items())
    return (
        f"<div><strong>{escape(recording.name)}</strong>: {len(recording)} samples{length}{head}"
        f"{html_table(['column', 'unit', 'min', 'mean', 'max', 'missing'], rows)}</div>"
    )


def recording_plots(recording: Recording, name: str | int | None) -> Plots | Plot:
    """Return a recording's channels over time, a figure for each sensor, or the one of this name."""
    found = Plots(channel_figures(recording), recording.name)
    return found if name is None else found[name]


def _title(record: Calibration) -> str:
    serial = record.sensor.get("serial", "a unit without serial number")
    return f"{record.procedure} calibration of {serial}, {record.created}"


def _headline(record: Calibration) -> str:
    """Return the result in a sentence; nothing of a record that lacks what it is made from."""
    try:
        return exhibits_of(record).headline
    except RecordError:
        return ""


def _summary(record: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return the table that a record shows first; nothing of one that lacks what it is made from."""
    try:
        return procedure_of(record).summary(record)
    except RecordError:
        return [], []


def _grouped(record: Calibration) -> list[str]:
    """Return the parameters as lines, those that differ in their last part alone in one."""
    groups: dict[tuple[str, str], list[str]] = {}
    for row in parameter_rows(record):
        stem, _, last = row.name.rpartition("_")
        stem, last = (stem, f"{last} ") if stem and (len(last) < 3 or last.isdecimal()) else (row.name, "")
        groups.setdefault((stem, row.unit), []).append(
            last + " ± ".join(_number(row)[: 1 if row.standard_uncertainty is None else 2])
        )
    width = max((len(stem) for stem, _ in groups), default=0)
    return [_short(f"  {stem:{width}}  {', '.join(texts)} {unit}") for (stem, unit), texts in groups.items()]


def _number(row: Row) -> tuple[str, str]:
    value, uncertainty = format_uncertain(row.value, row.standard_uncertainty)
    return value, uncertainty


def _short(line: str) -> str:
    return line if len(line) <= WIDTH else line[: WIDTH - 4] + " ..."
