"""Views of recordings and records: reports, comparisons, texts for terminals and notebooks.

`Recording` and `Calibration` lie below all procedures; the package's face hands these functions down to their methods.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from imulab import report
from imulab.display import LINES, SENTENCES, WIDTH, aligned, html_table
from imulab.errors import LackingError, OptionError, RecordError, listed
from imulab.estimation.distributions import probability_text
from imulab.files import write_page
from imulab.frames import foreign_of, frame_library, is_frame, name_of
from imulab.procedures.registry import joined_of, procedure_of
from imulab.procedures.registry import load as load
from imulab.procedures.result import Drawn, Record, as_read, as_record
from imulab.recording import Reading, Recording
from imulab.records.calibration import Calibration
from imulab.records.comparison import RecordComparison, compared
from imulab.report.parameters import Row, parameters_table, reading_unit
from imulab.report.traces import (
    BAD,
    GOOD,
    QUIET,
    Exhibits,
    Figure,
    ReportTable,
    figure_axis,
    format_uncertain,
    plain_number,
    scatter,
)

if TYPE_CHECKING:
    from imulab.report.plots import Plot, Plots

# The report of a record.


def exhibits_of(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record; of one that lacks the data that they need, its parameters alone.

    Raises
    ------
    RecordError
        Its procedure is not known, or it has something else in place of that data.
    """
    try:
        exhibits = procedure_of(record).exhibits(record)
    except LackingError as error:
        if not record.parameters:
            raise
        table = parameters_table(parameter_rows(record), "u is the standard uncertainty, – where none is stated.")
        lacking = str(error)
        headline = f"{lacking[:1].upper()}{lacking[1:]}: its parameters alone are shown; fit again for all figures."
        return Exhibits(headline, [], [table])
    for procedure in joined_of(record):
        more = procedure.joined(record)
        exhibits = replace(
            exhibits,
            headline=f"{exhibits.headline} {more.headline}",
            facts=[*exhibits.facts, *more.facts],
            items=[*exhibits.items, *more.items],
        )
    return exhibits


def parameter_rows(record: Calibration) -> Sequence[Row]:
    """Return the parameters of a record in the units in which people read them."""
    return procedure_of(record).rows(record)


def render_record(record: Calibration) -> str:
    """Return the report of a record as HTML text; errors as for `exhibits_of`."""
    return report.render(record, exhibits_of(record), procedure_of(record).title)


def write_report(record: Record, path: str | Path) -> None:
    """Write the report of a record as one HTML file that opens without a network.

    Parameters
    ----------
    record
        A record, or its file.
    path
        HTML file to write.

    Raises
    ------
    RecordError
        The record cannot be read, or lacks the data that its figures need.
    OptionError
        The file cannot be written there, or what is given is no record.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81)
    >>> il.write_report(fit.calibration, "sn42.html")
    """
    write_page(path, render_record(as_record(record, "write_report")))


# Comparison of two records of one unit.


@dataclass(frozen=True, repr=False)
class Changes(Drawn, RecordComparison):
    """Two records of one unit.

    Attributes
    ----------
    changes
        Parameters that both have, second record less first: difference, standard uncertainty, whether significant.
    probability
        Probability of such differences of all parameters if nothing changed; None where a covariance is missing.
    left_out
        Parameters that one record alone has, or that mean something else in the other.
    models
        Differences of the two models as texts; a change may come from these.
    record
        The first of the two.
    """

    record: Calibration = field(kw_only=True)

    subject: ClassVar[str] = "Two records of a unit"

    def exhibits(self) -> Exhibits:
        """Return each change in units of its uncertainty, and as a table."""
        p = self.probability
        together = "" if p is None else f"; all together: {probability_text(p)} if nothing changed"
        models = f"; the records differ in {', '.join(self.models)}" if self.models else ""
        headline = f"{verdict(self)}{together}{models}."
        table = ReportTable("Changes", "", TITLES, change_rows(self))
        return Exhibits(headline[0].upper() + headline[1:], [], [_changes_figure(self, table.rows), table])


TITLES = ["parameter", "change", "u", "change / u", "unit", ""]
"""Column titles of `change_rows`."""


def compare_records(first: Record, second: Record) -> Changes:
    """Compare two records of one unit by one procedure, in units of their combined uncertainty.

    ``d = p_2 - p_1``, ``u^2(d) = u_1^2 + u_2^2`` less what both have in common; a change counts as significant where
    ``|d| / u`` exceeds what chance gives one of all the parameters in twenty comparisons (Bonferroni).

    Parameters
    ----------
    first, second
        Records, or their files.

    Raises
    ------
    RecordError
        They are of different procedures or in different units, or one states no uncertainty.
    OptionError
        One is no record.

    Examples
    --------
    >>> import imulab as il
    >>> first, second = (il.fit_tumble(il.simulate_tumble(gravity=9.81), order=n, gravity=9.81) for n in (1, 2))
    >>> il.compare_records(first.calibration, second.calibration).models
    ('order 1 and 2',)
    """
    earlier, later = (as_record(record, "compare_records") for record in (first, second))
    procedure = procedure_of(earlier)
    pair = procedure.comparable(earlier, later) if later.procedure == earlier.procedure else (earlier, later)
    return Changes(**vars(compared(*pair, procedure.same_meaning)), record=earlier)


def verdict(comparison: RecordComparison) -> str:
    """Return which parameters changed."""
    changed = [change.name for change in comparison.changes if change.significant]
    judged = sum(change.standard_uncertainty is not None for change in comparison.changes)
    named = f"{len(changed)} of {judged} parameters changed: {' '.join(changed)}"
    return named if changed else "no significant change"


def change_rows(comparison: RecordComparison) -> list[list[str]]:
    """Return each change in the units in which people read it."""
    rows = []
    for change in comparison.changes:
        read = reading_unit(change.unit, change.name)
        factor, unit = read.factor, read.of_difference
        u = change.standard_uncertainty
        texts = (plain_number(change.difference * factor, 3), "not stated")
        difference, uncertainty = texts if u is None else format_uncertain(change.difference * factor, u * abs(factor))
        deviations = "–" if change.deviations is None else f"{change.deviations:+.1f}"
        rows.append([change.name, difference, uncertainty, deviations, unit, "changed" if change.significant else ""])
    return rows


def _changes_figure(comparison: RecordComparison, rows: list[list[str]]) -> Figure:
    judged = [(c, row) for c, row in zip(comparison.changes, rows, strict=True) if c.deviations is not None]
    marks = [change.significant for change, _ in judged]
    trace = scatter(
        [change.deviations for change, _ in judged], [change.name for change, _ in judged], "markers",
        error_x={"type": "constant", "value": 1, "color": QUIET, "thickness": 1},
        marker={"size": 9, "color": [BAD if mark else GOOD for mark in marks],
                "symbol": ["diamond" if mark else "circle" for mark in marks]},
        text=[f"{row[1]} ± {row[2]} {row[4]}" for _, row in judged],
        hovertemplate="%{y}: %{x:.1f} u<br>%{text}<extra></extra>",
    )  # fmt: skip
    return Figure(
        title="Change of each parameter in units of its standard uncertainty",
        message=f"{sum(marks)} of {len(marks)} parameters changed." if any(marks) else "No significant change.",
        caption="Second record less first; bars: one standard uncertainty. Red diamonds: more than chance explains "
        "among so many parameters.",
        traces=[trace],
        layout={
            "xaxis": figure_axis("change / u", zeroline=True, zerolinecolor=QUIET),
            "yaxis": figure_axis("", automargin=True, autorange="reversed", dtick=1),
            "showlegend": False,
        },
        height=120 + 22 * len(judged),
    )


# Texts, pages and figures of records and recordings: `imulab.display.Views`.


_COLOURS = {"good": "#1f6f8b", "look": "#b58a1b", "bad": "#c8553d"}
_STYLE = "border-left: 4px solid {}; padding: 2px 10px; margin: 6px 0"


def text(record: Calibration) -> str:
    """Return a record in a few lines: title, verdict, headline, parameters."""
    verdict = record.verdict
    reasons = f": {_shorten(verdict.reasons[0])}" if verdict.reasons else ""
    more = f" (and {len(verdict.reasons) - 1} more)" if len(verdict.reasons) > 1 else ""
    lines = [_title(record), f"{verdict.state}: {SENTENCES[verdict.state]}{reasons}{more}"]
    lines += [f"next: {_shorten(action)}" for action in verdict.next[:1]]
    lines += [headline] if (headline := _headline(record)) else []
    rows = [f"  {_shorten(line)}" for line in aligned(*table)] if (table := _summary(record))[1] else _grouped(record)
    room = LINES - len(lines)
    if len(rows) > room:
        rows = [*rows[: room - 1], f"  ... and {len(rows) - room + 1} more: to_frame() has all parameters"]
    return "\n".join(lines + rows)


def html(record: Calibration) -> str:
    """Return a record as HTML: title, verdict, headline, parameters."""
    verdict = record.verdict
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in verdict.reasons)
    reasons += "".join(f"<li><b>next:</b> {escape(action)}</li>" for action in verdict.next)
    rows = [[row.name, *_format_row(row), row.unit] for row in parameter_rows(record)]
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
    from imulab.report.plots import Plots

    drawn = Plots(exhibits_of(record).figures, _title(record))
    return drawn if name is None else drawn[name]


def apply_to(record: Calibration, data: Any, reading: Mapping[str, Any] | Reading, **options: Any) -> Any:
    """Return data corrected by a record: of a data frame a frame of the same library, of all else a recording."""
    from imulab.procedures.apply import apply

    corrected = apply(record, as_read(data, reading, Calibration.apply), **options)
    if not is_frame(data):
        return corrected
    polars = frame_library(data) == "polars"
    frame: Any = corrected.to_frame("polars" if polars else "pandas")
    if len(frame) != len(data):
        return frame
    foreign = foreign_of(data)
    read = {f"{name} [{corrected.units[name]}]" for title in foreign if (name := name_of(title)) in corrected}
    frame = frame.drop(list(read)) if polars else frame.drop(columns=list(read)).set_axis(data.index)
    if polars:
        return frame.with_columns(data[title] for title in foreign)
    return frame.assign(**{title: data[title] for title in foreign})


def export_to(record: Calibration, target: str, folder: str | Path, **options: Any) -> list[Path]:
    """Write a record in the form of another program."""
    from imulab.procedures.exporting import export as export_records

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
    time = None if time is None else time[np.isfinite(time)]
    length = "" if time is None or len(time) < 2 else f" over {time[-1] - time[0]:.6g} s"
    head = "".join(f"<br>{escape(key)}: {escape(value)}" for key, value in recording.metadata.items())
    return (
        f"<div><strong>{escape(recording.name)}</strong>: {len(recording)} samples{length}{head}"
        f"{html_table(['column', 'unit', 'min', 'mean', 'max', 'missing'], rows)}</div>"
    )


def recording_plots(recording: Recording, name: str | int | None) -> Plots | Plot:
    """Return a recording's channels over time, a figure for each sensor, or the one of this name."""
    from imulab.report.noise_figures import channel_figures
    from imulab.report.plots import Plots

    drawn = Plots(channel_figures(recording), recording.name)
    return drawn if name is None else drawn[name]


def _title(record: Calibration) -> str:
    serial = record.sensor.get("serial", "a unit without serial number")
    return f"{record.procedure} calibration of {serial}, {record.created}"


def _headline(record: Calibration) -> str:
    """Return the result in a sentence; empty for a record that lacks its data."""
    try:
        return exhibits_of(record).headline
    except RecordError:
        return ""


def _summary(record: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return titles and rows of a record's first table; empty for a record that lacks its data."""
    try:
        return procedure_of(record).summary(record)
    except RecordError:
        return [], []


def _grouped(record: Calibration) -> list[str]:
    """Return the parameters as lines; those whose names differ in the last part alone share one."""
    groups: dict[tuple[str, str], list[str]] = {}
    for row in parameter_rows(record):
        stem, _, last = row.name.rpartition("_")
        stem, last = (stem, f"{last} ") if stem and (len(last) < 3 or last.isdecimal()) else (row.name, "")
        groups.setdefault((stem, row.unit), []).append(
            last + " ± ".join(_format_row(row)[: 1 if row.standard_uncertainty is None else 2])
        )
    width = max((len(stem) for stem, _ in groups), default=0)
    return [_shorten(f"  {stem:{width}}  {', '.join(texts)} {unit}") for (stem, unit), texts in groups.items()]


def _format_row(row: Row) -> tuple[str, str]:
    return row.text()


def _shorten(line: str) -> str:
    return line if len(line) <= WIDTH else line[: WIDTH - 4] + " ..."
