"""Records, recordings and plans in a few lines of plain text, and what every fit does with its result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from math import inf, nan
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from imulab.cli.options import call, check_outputs, coloured, note, speech, warn
from imulab.display import SENTENCES, Verdict, aligned, printable
from imulab.errors import OptionError, ReadError
from imulab.files import replacing
from imulab.procedures.result import PlannedAttitudes, PlannedTest

if TYPE_CHECKING:
    from imulab.device.unit import Blob
    from imulab.procedures.result import RecordCheck
    from imulab.recording import Array, Recording
    from imulab.records.calibration import Calibration
    from imulab.records.comparison import RecordComparison


# Results of fits: written, printed, and their findings.


def write_both(record: Calibration, output: str | None, report: str | None) -> None:
    """Write a record and its report, both or none."""
    from imulab.procedures.views import render_record

    with ExitStack() as stack:
        # Both files are opened before either is finished, so that neither is left alone behind an error.
        to_record = stack.enter_context(replacing(output)) if output else None
        to_report = stack.enter_context(replacing(report)) if report else None
        if to_record:
            to_record.write(record.to_json().encode("utf-8"))
        if to_report:
            to_report.write(render_record(record).encode("utf-8"))


def finish(
    record: Calibration,
    output: str | None,
    report: str | None,
    *,
    json: bool,
    describe: Callable[[Calibration], str] | None = None,
) -> None:
    """Write a record and its report, both or none, and print the result, in full or as `describe` returns it."""
    write_both(record, output, report)
    if json:
        print(record.to_json(), end="")
    else:
        print(describe(record) if describe else describe_record(record, provenance=False))
        for name, what in ((output, "record"), (report, "report")):
            if name:
                print(f"{what}: {name}")
    for message in record.warnings:
        (warn if message in record.verdict.reasons else note)(message)
    if record.verdict.state == "bad" and (json or speech().quiet):
        for action in record.verdict.next:
            warn(f"next: {action}")


# ``imulab tumble plan`` and ``thermal plan``: a plan to CSV, sheet and what is printed.


def run(*, output: str | None, report: str | None, json: bool, **options: Any) -> None:
    """Plan, print the prediction, and write what was asked for."""
    from imulab.procedures.tumble.plan import plan_tumble

    check_plan_outputs(output, report, [name for name in (options["add"], options["from_"]) if name])
    finish_plan(call(plan_tumble, **options), output, report, json=json)


def check_plan_outputs(output: str | None, report: str | None, inputs: list[str]) -> None:
    """Check before the work that the plan can be written; errors as for `check_outputs`."""
    check_outputs([output, report], inputs)
    if output is not None and not output.lower().endswith(".csv"):
        raise OptionError(f"{output}: expected a name that ends in .csv")


def finish_plan(plan: PlannedTest, output: str | None, report: str | None = None, *, json: bool) -> None:
    """Write a plan and its sheet, both or neither, print it, and say what was written and what is wrong with it."""
    from imulab.records.calibration import json_text

    with ExitStack() as stack:
        to_sheet = stack.enter_context(replacing(report)) if report else None
        if output:
            plan.save(output)
        if to_sheet and isinstance(plan, PlannedAttitudes):
            to_sheet.write(plan.sheet().encode("utf-8"))
    if json:
        print(json_text(plan.content()), end="")
    else:
        print(plan.text())
        manifest = output is not None and output.lower().endswith(".toml")
        for name, what in ((output, "manifest" if manifest else "plan"), (report, "sheet")):
            if name:
                print(f"{what}: {name}")
    for message in plan.findings():
        warn(message)


# Results of tests of a record.


def notes_on_data(held: Calibration, recordings: Sequence[Recording]) -> list[str]:
    """Return notes on the recordings that a record is tested with."""
    corrected = [
        f"{recording.name}: was corrected before, by {entry}; a record is checked by what the unit puts out, so the "
        "test means nothing here"
        for recording in recordings
        for entry in recording.corrected_by
    ]
    from imulab.procedures.apply import warn_before_applying

    return corrected + [warning for recording in recordings for warning in warn_before_applying(held, recording)]


def finish_check(
    check: RecordCheck,
    held: Calibration,
    record: str,
    files: Sequence[str],
    notes: Sequence[str],
    report: str | None,
    *,
    json: bool,
) -> int:
    """Write the report, print the result and the notes; return the exit status, 0: pass, 1: fail."""
    from imulab.records.calibration import json_text

    notes = [*notes, *check.notes]
    if report:
        from imulab.files import write_text

        write_text(report, check.page(held, record, files, notes))
    if json:
        print(json_text(check.to_json(notes)).rstrip())
    else:
        print(check.text(record, files, coloured(check.verdict)))
    for message in notes:
        warn(message)
    if report and not json:
        print(f"report: {report}")
    return 0 if check.passed else 1


# Records and recordings in a few lines of plain text.


_GAP = 1.5  # of the usual step: a longer one is counted as a gap, as where recordings are read


def describe_record(record: Calibration, *, provenance: bool = True) -> str:
    """Return a record in lines: its verdict, headline, tables, and origin."""
    from imulab.procedures.views import exhibits_of
    from imulab.report.traces import ReportTable

    exhibits = exhibits_of(record)
    serial = record.sensor.get("serial", "unit without serial number")
    lines = verdict_lines(record.verdict)
    lines += [f"{record.procedure} calibration of {serial}", exhibits.headline, ""]
    for item in exhibits.items:
        if isinstance(item, ReportTable):
            mark = [["*" if i == item.highlight else "", *row] for i, row in enumerate(item.rows)]
            chosen = " (* chosen)" if item.highlight is not None else ""
            lines += [
                f"{item.title}{chosen}",
                *aligned(["", *item.columns], mark),
                *([item.message] if item.message else []),
                "",
            ]
    if provenance:
        lines += [f"created {record.created} by {record.software}"]
        lines += [f"source {printable(source.file)} SHA-256 {source.sha256}" for source in record.sources]
        lines += [
            f"{'warning' if message in record.verdict.reasons else 'note'}: {message}" for message in record.warnings
        ]
    return "\n".join(lines).rstrip()


def verdict_lines(verdict: Verdict) -> list[str]:
    """Return a verdict in lines: its state with the gravest reason and how many more there are; what to do next."""
    if not verdict.reasons:
        return [f"{coloured(verdict.state)}: {SENTENCES[verdict.state]}"]
    more = len(verdict.reasons) - 1
    others = f" (and {more} more: see the warnings)" if more else ""
    first = f"{coloured(verdict.state)}: {SENTENCES[verdict.state]}: {verdict.reasons[0]}{others}"
    return [first, *(f"next: {action}" for action in verdict.next)]


def describe_blob(blob: Blob) -> str:
    """Return a blob in lines: its unit, size, and the columns and units of each section."""
    serial = blob.text["sensor"].get("serial", "a unit without serial number")
    lines = [f"blob of {serial}: {len(blob.data)} bytes, float numbers, written by {blob.text['software']}"]
    for section in blob.text["sections"]:
        about = ", ".join(f"{key} {_joined(value)}" for key, value in section.items() if key != "kind")
        lines.append(f"  {section['kind']}: {about}")
    lines += [f"record SHA-256 {digest}" for digest in blob.text["records"]]
    return "\n".join(lines)


def _joined(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def describe_changes(first: str, second: str, comparison: RecordComparison, record: Calibration) -> str:
    """Return the changes from one record to the other; `record` gives the procedure and units."""
    from imulab.procedures.views import TITLES, change_rows, verdict

    lines = [f"{second} less {first}: {verdict(comparison)}", "", *aligned(TITLES, change_rows(comparison))]
    if comparison.probability is not None:
        lines += ["", f"all together: probability {comparison.probability:.2g} if nothing had changed"]
    if comparison.models:
        lines += ["", f"the records differ in {', '.join(comparison.models)}: a change may come from that"]
    if comparison.left_out:
        lines += [
            "",
            f"not compared (in one record alone, or of another meaning there): {' '.join(comparison.left_out)}",
        ]
    if "table" in record.sections:
        lines += ["", "the tables themselves are not compared"]
    return "\n".join(lines)


class _Column(Struct):
    """Range of a column, updated by each block."""

    low: float = inf
    high: float = -inf
    total: float = 0.0
    finite: int = 0
    missing: int = 0

    def add(self, values: Array) -> None:
        import numpy as np

        finite = values[np.isfinite(values)]
        self.missing += len(values) - finite.size
        self.finite += finite.size
        if finite.size:
            self.low, self.high = min(self.low, float(finite.min())), max(self.high, float(finite.max()))
            self.total += float(finite.sum())

    def values(self) -> dict[str, float | int | None]:
        some = self.finite > 0
        return {
            "min": self.low if some else None,
            "mean": self.total / self.finite if some else None,
            "max": self.high if some else None,
            "missing": self.missing,
        }

    def texts(self) -> list[str]:
        numbers = (self.low, self.total / self.finite, self.high) if self.finite else ()
        return [*([f"{x:.6g}" for x in numbers] or ["–"] * 3), str(self.missing)]


class _Clock(Struct):
    """Duration, rate and gaps, updated by each block; the usual step is that of the first block."""

    first: float | None = None
    last: float = 0.0
    usual: float = nan
    gaps: int = 0
    widest: float = 0.0
    backwards: int = 0
    broken: bool = False

    def add(self, time: Array) -> None:
        import numpy as np

        self.broken = self.broken or not np.isfinite(time).all()
        step = np.diff(time) if self.first is None else np.diff(time, prepend=self.last)
        if np.isnan(self.usual) and step.size:
            self.usual = float(np.median(step))
        if step.size:
            self.gaps += int(np.count_nonzero(step > _GAP * self.usual))
            self.widest = max(self.widest, float(step.max()))
            self.backwards += int(np.count_nonzero(step < 0))
        self.first = float(time[0]) if self.first is None else self.first
        self.last = float(time[-1])

    def text(self) -> list[str]:
        import numpy as np

        if self.broken or self.first is None:
            return []
        if np.isnan(self.usual):
            return ["duration 0 s, rate unknown: a single sample"]
        rising = self.usual > 0
        rate = f"{1 / self.usual:.6g} Hz" if rising else "unknown, time does not rise"
        widest = f" (the widest {self.widest:.6g} s)" if self.gaps and rising else ""
        lines = [f"duration {self.last - self.first:.6g} s, rate {rate}, gaps {self.gaps if rising else 0}{widest}"]
        times = "once" if self.backwards == 1 else f"{self.backwards} times"
        return [*lines, f"time runs backwards {times}: procedures refuse it"] if self.backwards else lines


class _Contents(Struct):
    """Content of a recording, updated by each block."""

    last: Recording
    columns: dict[str, _Column]
    clock: _Clock
    samples: int
    notes: list[str]


def _contents(blocks: Iterable[Recording]) -> _Contents:
    columns: dict[str, _Column] = {}
    clock, samples, notes = _Clock(), 0, dict[str, None]()
    block = None
    for block in blocks:
        samples += len(block)
        notes |= dict.fromkeys(block.notes)
        if block.time is not None and len(block):
            clock.add(block.time)
        for name, values in block.columns.items():
            columns.setdefault(name, _Column()).add(values)
    if block is None:
        raise ReadError("the recording is empty")
    return _Contents(block, columns, clock, samples, list(notes))


def describe_recording(blocks: Iterable[Recording]) -> str:
    """Return a recording in lines: samples, rate, gaps, duration, and each column's range."""
    contents = _contents(blocks)
    last = contents.last
    lines = [f"{printable(last.name)}: {contents.samples} samples"]
    lines += contents.clock.text() if "time" in last else ["no time column: a table of attitudes, a row each"]
    rows = [[name, last.units[name], *column.texts()] for name, column in contents.columns.items()]
    lines += ["", *aligned(["column", "unit", "min", "mean", "max", "missing"], rows)]
    if last.metadata:
        lines += ["", *(f"{key}: {value}" for key, value in last.metadata.items())]
    lines += [f"{'warning' if note.startswith('truncated') else 'note'}: {note}" for note in contents.notes]
    return "\n".join(lines)


def recording_json(blocks: Iterable[Recording]) -> str:
    """Return the same as JSON, each column in its own unit; null for unknown values."""
    from imulab.records.calibration import json_text

    contents = _contents(blocks)
    last, clock = contents.last, contents.clock
    duration = rate = None
    if clock.first is not None and not clock.broken:
        duration = clock.last - clock.first
        rate = 1 / clock.usual if clock.usual > 0 else None
    return json_text(
        {
            "file": last.name,
            "samples": contents.samples,
            "duration": {"value": duration, "unit": "s"},
            "sample_rate": {"value": rate, "unit": "Hz"},
            "gaps": clock.gaps,
            "columns": {
                name: {"unit": last.units[name], **column.values()} for name, column in contents.columns.items()
            },
            "metadata": dict(last.metadata),
            "notes": contents.notes,
        }
    ).rstrip()
