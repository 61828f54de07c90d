"""Records, recordings and plans in a few lines of plain text, and what every fit does with its result."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
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
    # Both streams of a terminal are one to its reader, who has the gravest reason in the first line already.
    there = record.verdict.reasons[:1] if not json and describe is None and _on_terminal() else ()
    for message in record.warnings:
        if message not in there:
            (warn if message in record.verdict.reasons else note)(message)
    if record.verdict.state == "bad" and (json or speech().quiet):
        for action in record.verdict.next:
            warn(f"next: {action}")


def _on_terminal() -> bool:
    return sys.stdout.isatty() and sys.stderr.isatty()


# ``imulab tumble plan`` and ``thermal plan``: a plan to CSV, sheet and what is printed.


def run(*, output: str | None, report: str | None, json: bool, **options: Any) -> None:
    """Plan, print the prediction, and write what was asked for."""
    from imulab.procedures.tumble.plan import plan_tumble

    check_plan_outputs(output, report, [name for name in (options["add"], options["from_"]) if name])
    finish_plan(call(plan_tumble, **options), output, report, json=json)


def check_plan_outputs(output: str | None, report: str | None, inputs: list[str]) -> None:
    """Check before the work that the plan can be written; errors as for `check_outputs`."""
    check_outputs([output], inputs, report=report)
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


_MOST_ROWS = 1 << 21  # whose times are held at once
_LEAST_JITTER = 1e-6  # s: a smaller one is that of rounding
_SHOWN = 0.1  # s: times are shown to this
_MANY_ATTITUDES = 100  # rows of a table from which it may be a recording that lacks its time


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
    from imulab.estimation.distributions import probability_fact
    from imulab.procedures.views import TITLES, change_rows, verdict

    lines = [f"{second} less {first}: {verdict(comparison)}", "", *aligned(TITLES, change_rows(comparison))]
    if comparison.probability is not None:
        lines += ["", f"all together: probability {probability_fact(comparison.probability)} if nothing had changed"]
    if comparison.models:
        lines += ["", f"the records differ in {', '.join(comparison.models)}: a change may come from that"]
    if comparison.left_out:
        lines += [
            "",
            f"not compared (in one record alone, of the place, or of another meaning): {' '.join(comparison.left_out)}",
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

    def texts(self, step: float | None = None) -> list[str]:
        """Return the numbers in six digits, or in those that show this step, with the number of missing values."""
        numbers = (self.low, self.total / self.finite, self.high) if self.finite else ()
        many = step is not None and any(abs(x) >= 1e6 * step for x in numbers)
        digits = ".1f" if many and step is not None and step < 1 else ".0f" if many else ".6g"
        return [*([f"{x:{digits}}" for x in numbers] or ["–"] * 3), str(self.missing)]


class _Clock(Struct):
    """Times of the blocks, and which rows equal the row before: what `read_clock` wants; of long files by parts."""

    time: list[Array] = []
    same: list[Any] = []
    last: dict[str, float] = {}
    end: float = nan
    rows: int = 0
    parts: list[_Summary] = []

    def add(self, block: Recording) -> None:
        import numpy as np

        from imulab.estimation.clock import same_rows

        time = block.time
        if time is None or not len(block):
            return
        still = time[0] == self.end or (time[1:] == time[:-1]).any()
        self.time.append(time)
        self.same.append(same_rows(block.columns, self.last or None) if still else np.zeros(len(time), dtype=bool))
        self.last, self.end = {name: float(values[-1]) for name, values in block.columns.items()}, float(time[-1])
        self.rows += len(time)
        if self.rows > _MOST_ROWS:
            self.parts.append(self._part())
            self.time, self.same, self.rows = [time[-1:].copy()], [np.zeros(1, dtype=bool)], 0

    def summary(self, metadata: Mapping[str, str]) -> _Summary:
        """Return what the clock shows."""
        from imulab.estimation.clock import epoch_of, utc

        if not self.time:
            return _Summary()
        last = [self._part()] if self.rows or not self.parts else []  # nothing but the end of the part before
        parts = [part for part in (*self.parts, *last) if part.first is not None]
        if not parts:
            return _Summary()
        first, whole = parts[0].first or 0.0, parts[0]
        for part in parts[1:]:
            whole = whole.joined(part)
        epoch = epoch_of(metadata, first)
        if epoch is not None:
            whole.utc, whole.utc_end = utc(epoch + first), utc(epoch + whole.last)
        return whole

    def _part(self) -> _Summary:
        import numpy as np

        from imulab.estimation.clock import read_clock
        from imulab.estimation.sampling import steady_rows

        time = np.concatenate(self.time)
        clock = read_clock(time, np.concatenate(self.same))
        finite = time[np.isfinite(time)]
        if not finite.size:
            return _Summary()
        summary = _Summary(float(finite[0]), float(finite[-1]), doubt=clock.doubt, backwards=clock.backwards)
        if clock.doubt:
            return summary
        summary.repeated, summary.tick, lossy = clock.repeated, clock.tick, clock.replaced
        rising = time if clock.kept is None else time[clock.kept]
        rising = rising if clock.even is None else clock.even
        start, stop = steady_rows(rising, lossy=lossy)
        if (start, stop) != (0, len(rising)):
            clock = read_clock(rising[start:stop], lossy=lossy)
            summary.steady = (float(rising[start]), float(rising[stop - 1]))
        summary.rate, summary.jitter, summary.steps = clock.rate, clock.jitter, stop - start - 1 - len(clock.gaps)
        summary.gaps, summary.missing = len(clock.gaps), int(clock.missing.sum())
        summary.widest = clock.widest if summary.gaps else 0.0
        return summary


class _Summary(Struct):
    """What the time stamps of a recording show; times in s."""

    first: float | None = None
    last: float = 0.0
    utc: str | None = None
    utc_end: str | None = None
    rate: float = nan
    jitter: float = nan
    gaps: int = 0
    missing: int = 0
    widest: float = 0.0
    repeated: int = 0
    tick: float = 0.0
    backwards: int = 0
    steady: tuple[float, float] | None = None
    doubt: str = ""
    steps: int = 0

    def joined(self, later: _Summary) -> _Summary:
        """Return the summary of two parts of a recording."""
        steps = self.steps + later.steps
        duration = self.steps / self.rate + later.steps / later.rate
        return _Summary(
            first=self.first,
            last=later.last,
            rate=steps / duration,
            jitter=((self.steps * self.jitter**2 + later.steps * later.jitter**2) / max(steps, 1)) ** 0.5,
            gaps=self.gaps + later.gaps,
            missing=self.missing + later.missing,
            widest=max(self.widest, later.widest),
            repeated=self.repeated + later.repeated,
            tick=max(self.tick, later.tick),
            backwards=self.backwards + later.backwards,
            steady=self.steady or later.steady,
            doubt=self.doubt or later.doubt,
            steps=steps,
        )

    def text(self) -> list[str]:
        if self.first is None:
            return []
        rate = f"{self.rate:.6g} Hz" if self.rate > 0 else f"unknown: {self.doubt}"
        widest = f" (the widest {self.widest:.6g} s), missing {self.missing}" if self.gaps else ""
        jitter = f", jitter {1e3 * self.jitter:.3g} ms" if self.jitter >= _LEAST_JITTER else ""
        repeated = f", repeated {self.repeated}" if self.repeated else ""
        gaps = f", gaps {self.gaps}{widest}" if self.rate > 0 else ""
        lines = [f"duration {self.last - self.first:.6g} s, rate {rate}{gaps}{repeated}{jitter}"]
        lines.append(f"start {self.first:.1f} s, end {self.last:.1f} s")
        if self.utc:
            until = f", until {self.utc_end} UTC" if self.utc_end != self.utc else ""
            lines.append(f"time {self.first:.1f} to {self.last:.1f} s ({self.utc} UTC){until}")
        if self.steady:
            lines.append(f"the rate changes: it is that of {self.steady[0]:.1f} to {self.steady[1]:.1f} s")
        if self.repeated:
            rows = "1 row" if self.repeated == 1 else f"{self.repeated} rows"
            lines.append(f"repeated: {rows} with stamp and values of the row before, which procedures drop")
        if self.tick and self.rate > 0:
            lines.append(f"readings share time stamps, which are {self.tick:.3g} s apart: taken in order and as even")
        if self.backwards:
            times = "once" if self.backwards == 1 else f"{self.backwards} times"
            lines.append(f"time runs backwards {times}: procedures refuse it (--damaged skip leaves out torn rows)")
        elif not self.rate > 0 and self.doubt != "a single sample":
            lines.append("procedures refuse this time: where samples are even, state sample_rate in a layout instead")
        return lines


class _Contents(Struct):
    """Content of a recording, updated by each block."""

    last: Recording
    columns: dict[str, _Column]
    clocks: dict[str, _Clock]
    samples: int
    notes: list[str]


def _contents(blocks: Iterable[Recording]) -> _Contents:
    columns: dict[str, _Column] = {}
    clocks, samples, notes = {"time": _Clock()}, 0, dict[str, None]()
    block = None
    for block in blocks:
        samples += len(block)
        notes |= dict.fromkeys(block.notes)
        for name in block.columns:
            columns.setdefault(name, _Column())
        for clock in block.clocks:
            part = block.stream(clock)
            clocks.setdefault(clock, _Clock()).add(part)
            for name, values in part.columns.items():
                columns[clock if name == "time" else name].add(values)
    if block is None:
        raise ReadError("the recording is empty")
    return _Contents(block, columns, clocks, samples, list(notes))


def describe_recording(blocks: Iterable[Recording]) -> str:
    """Return a recording in lines: samples, rate, gaps, duration, and each column's range."""
    from imulab.estimation.sampling import doubt_unit_of_time
    from imulab.recording import state_rate
    from imulab.units import to_si

    contents = _contents(blocks)
    last = contents.last
    lines = [f"{printable(last.name)}: {contents.samples} samples"]
    for clock, names in last.clocks.items() if "time" in last else ():
        summary = contents.clocks[clock].summary(last.metadata)
        text = summary.text()
        if len(last.clocks) > 1:
            text[:1] = [f"{clock} ({' '.join(names)}): {contents.columns[clock].finite} samples, {text[0]}"]
        duration = summary.last - (summary.first or 0.0)
        doubt = doubt_unit_of_time(last.units[clock], summary.rate, duration) if summary.rate > 0 else ""
        lines += [*text, *([f"{doubt} --unit time=UNIT states it"] if doubt else [])]
    if "time" not in last:
        lines.append("no time column: a table of attitudes, a row each")
        lines += [f"or else {state_rate(printable(last.name))}"] if contents.samples > _MANY_ATTITUDES else []
    steps = {clock: _SHOWN / to_si(1.0, last.units[clock]) for clock in last.clocks if clock in last}
    rows = [[name, last.units[name], *column.texts(steps.get(name))] for name, column in contents.columns.items()]
    lines += ["", *aligned(["column", "unit", "min", "mean", "max", "missing"], rows)]
    if last.metadata:
        lines += ["", *(f"{key}: {value}" for key, value in last.metadata.items())]
    lines += [f"{'warning' if note.startswith('truncated') else 'note'}: {note}" for note in contents.notes]
    return "\n".join(lines)


def _clock_json(clock: _Summary) -> dict[str, Any]:
    known = clock.first is not None
    return {
        "start": {"value": clock.first, "unit": "s", "utc": clock.utc},
        "end": {"value": clock.last if known else None, "unit": "s", "utc": clock.utc_end},
        "duration": {"value": clock.last - clock.first if clock.first is not None else None, "unit": "s"},
        "sample_rate": {"value": clock.rate if clock.rate > 0 else None, "unit": "Hz"},
        "jitter": {"value": clock.jitter if clock.rate > 0 else None, "unit": "s"},
        "gaps": clock.gaps,
        "missing": clock.missing,
        "repeated": clock.repeated,
    }


def recording_json(blocks: Iterable[Recording]) -> str:
    """Return the same as JSON, each column in its own unit; null for unknown values."""
    from imulab.records.calibration import json_text

    contents = _contents(blocks)
    last = contents.last
    about = {clock: _clock_json(each.summary(last.metadata)) for clock, each in contents.clocks.items()}
    return json_text(
        {
            "file": last.name,
            "samples": contents.samples,
            **about["time"],
            **(
                {"clocks": {name: {**about[name], "columns": columns} for name, columns in last.clocks.items()}}
                if len(about) > 1
                else {}
            ),
            "columns": {
                name: {"unit": last.units[name], **column.values()} for name, column in contents.columns.items()
            },
            "metadata": dict(last.metadata),
            "notes": contents.notes,
        }
    ).rstrip()
