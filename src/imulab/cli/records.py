"""Commands on records and recordings of every procedure: apply, show, report, demo, convert, export."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import (
    AsJson,
    OutputFile,
    RecordFile,
    RecordingFile,
    call,
    check_outputs,
    how_to_read,
    is_json,
    naming,
    note,
    quantity,
    reading,
    warn,
    with_notes,
)
from imulab.errors import OptionError, RecordError, listed
from imulab.files import open_file
from imulab.options import OUTPUT

if TYPE_CHECKING:
    from imulab.device.unit import Blob
    from imulab.procedures.apply import Loaded
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


# ``imulab convert``: any recording to native CSV or Parquet.


def convert(
    file: RecordingFile,
    *,
    with_: Annotated[
        list[str] | None,
        option(
            "FILE[@LAYOUT]",
            "Another sensor of the same unit, whose columns are added with their times; repeatable.",
            repeated=True,
        ),
    ] = None,
    one_clock: Annotated[
        bool, option("", "Interpolate sensors with clocks of their own to the fastest; its noise is not theirs.")
    ] = False,
    output: OutputFile = None,
    **options: Any,
) -> None:
    """Write a recording of any kind as CSV or Parquet.

    Native CSV or Parquet to OUT, or CSV to standard output.
    """
    from imulab.readers import read_blocks
    from imulab.readers.streams import file_and_layout, on_clock_of

    others = [file_and_layout(text) for text in with_ or []]
    inputs = [name for pair in ((file, options["layout"]), *others) for name in pair if name]
    check_outputs([output], inputs)
    how = reading(options)
    blocks = _read_joined(file, others, how) if others else read_blocks(file, **how)
    write_out(with_notes(on_clock_of(blocks) if one_clock else blocks), output)


def _read_joined(file: str, others: Sequence[tuple[str, str | None]], how: Mapping[str, Any]) -> Iterator[Recording]:
    """Yield the rows of files and layouts that hold other sensors, joined to `file`.

    Units, the window, and what to do with damaged lines are stated for all of them together.
    """
    from imulab.readers import read
    from imulab.readers.selection import Selection, SharedUnits, windowed
    from imulab.readers.streams import join_recordings

    units, ends = SharedUnits(how["units"]), Selection(window=how["window"]).ends
    first = read(file, **{**how, "units": units, "window": None})
    more = [read(other, layout, units=units, damaged=how["damaged"]) for other, layout in others]
    if units.unused:
        names = ", ".join([file, *(other for other, _ in others)])
        raise OptionError(f"--unit {units.unused[0]}: no such column in {names}")
    yield from windowed(iter([join_recordings(first, more)]), ends, file)


def write_out(blocks: Iterable[Recording], output: str | None) -> None:
    """Write blocks to a file by its ending, or as CSV to standard output."""
    from imulab.writers import check_writable, write, write_csv_to

    if output:
        check_writable(output)
        write(blocks, output)
        return
    # The first block is made before anything is written, so that a refusal leaves no head behind.
    rest = iter(blocks)
    write_csv_to(chain([next(rest)], rest), sys.stdout.buffer)
    sys.stdout.buffer.flush()


# ``imulab export``: records to firmware, autopilots and toolboxes.


def export(
    records: Annotated[list[str], Argument("RECORD...", "Calibration records of one unit.")],
    *,
    output: Annotated[str, option("DIR", "Folder to write to.", "-o", "--output"), OUTPUT],
    **options: Any,
) -> None:
    """Write firmware, a blob, or another program's files.

    Calibration records in the form of firmware, an autopilot or a toolbox.
    """
    to = options.pop("to")
    write = partial(il.export, records=records, folder=output, tell=warn)
    files = call(write, to=to, **options)
    for file in files:
        print(f"{to}: {file}")


# Commands on records and recordings of every procedure: apply, show, report, demo.


def apply(
    files: Annotated[list[str], Argument("RECORD... FILE", "Records, then the recording.")],
    *,
    output: OutputFile = None,
    **options: Any,
) -> None:
    """Correct a recording by records.

    By one or more of them, in the order given; CSV or Parquet to OUT, CSV to standard output.
    """
    from imulab.procedures.apply import add_heading, apply_blocks, heading_kind, loaded
    from imulab.procedures.correction_order import order_warnings
    from imulab.procedures.registry import load_any
    from imulab.readers import read_blocks
    from imulab.readers.streams import on_clock_of
    from imulab.recording import with_power_on_temperature

    if len(files) < 2:
        raise OptionError("apply: expected at least one RECORD and the FILE to correct")
    *names, file = files
    check_outputs([output], files)
    how = reading(options)
    try:
        records = [load_any(name) for name in names]
    except RecordError:
        if file != "-" and is_json(file):
            raise OptionError(
                f"{file}: expected a recording as the last file, found a record: records go first"
            ) from None
        raise
    chain, start = [], quantity(options["latest_start"], "--latest-start", "time", "s")
    for name, record in zip(names, records, strict=True):
        with naming(name):
            chain.append(
                loaded(
                    record,
                    Path(name).name,
                    again=options["again"],
                    latest_start=start,
                )
            )
    for message in order_warnings([part.kind for ready in chain for part, _ in ready.sections]):
        warn(message)
    if kind := heading_kind(options["heading"], "--heading"):
        chain = add_heading(chain, records, kind)
    blocks = with_notes(_say_resampled(on_clock_of(read_blocks(file, **how))), notes=False)
    if options["temperature_column"] and any(part.since_power_on for ready in chain for part, _ in ready.sections):
        blocks = with_power_on_temperature(blocks)
    rows = _Rows()
    write_out(rows.counted(apply_blocks(chain, _with_warnings(records, chain, blocks))), output)
    by = " and ".join(dict.fromkeys(Path(name).name for name in names))
    what = "standard input" if file == "-" else file
    note(f"{rows.count} rows of {what} corrected by {by}: {output or 'standard output'}")


def _say_resampled(blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Yield blocks, and say once which sensors were interpolated to the clock of another."""
    from imulab.recording import RESAMPLED

    for number, block in enumerate(blocks):
        yield block
        if number == 0 and RESAMPLED in block.metadata:
            note(f"{block.name}: {RESAMPLED}: {block.metadata[RESAMPLED]}")


@dataclass
class _Rows:
    """Counter of rows."""

    count: int = 0

    def counted(self, blocks: Iterable[Recording]) -> Iterator[Recording]:
        """Yield blocks and count their rows."""
        for block in blocks:
            self.count += len(block)
            yield block


def _with_warnings(
    records: list[Calibration | Blob], chain: Sequence[Loaded], blocks: Iterable[Recording]
) -> Iterator[Recording]:
    """Yield blocks; print warnings after the first, and at the end which samples are doubtful."""
    from imulab.display import Note, prefixed
    from imulab.procedures.apply import DoubtfulSamples, list_earlier, warn_before_applying, warn_of_unit
    from imulab.recording import TAKEN_FROM

    samples = DoubtfulSamples(records, chain)
    for number, block in enumerate(blocks):
        samples.add(block)
        yield block
        if number == 0:  # after it was corrected: where it is refused, the refusal is the one line there is
            messages = [message for record in records for message in warn_before_applying(record, block)]
            if power_on := block.metadata.get(TAKEN_FROM):
                messages.append(Note(f"{block.name}: the power-on temperature was taken from {power_on}"))
            doubts = [doubt for ready in chain for doubt in warn_of_unit(ready, block)] + list_earlier(block)
            messages += [prefixed(block.name, doubt) for doubt in doubts]
            for message in dict.fromkeys(messages):
                warn(message)
    for message in samples.warnings():
        warn(message)


def show(
    files: Annotated[list[str] | None, Argument("FILE [FILE]", "Record or recording, or two records.")] = None,
    *,
    formats: Annotated[bool, option("", "List the kinds of recording that can be read.")] = False,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Say what is in a record or recording, or what changed.

    Changes are those between two records of one unit. Of a certificate: what it says, and whether its signature holds.
    """
    if formats:
        _show_formats(files or [], json=json)
        return
    if not files:
        raise OptionError("show: expected a FILE, two records, or --formats")
    if len(files) > 2:
        raise OptionError(f"show: expected one file or two records, found {len(files)} files")
    if len(files) == 2:
        _show_changes(*files, json=json)
        return
    (file,) = files
    from imulab.cli.show import describe_blob, describe_record, describe_recording, recording_json
    from imulab.device.unit import is_blob, load_blob
    from imulab.procedures.registry import load
    from imulab.readers import read_blocks

    if options["layout"] is None and is_blob(file):
        blob = load_blob(file)
        print(dumps(blob.text, indent=1, ensure_ascii=False) if json else describe_blob(blob))
        return
    if options["layout"] is None and is_json(file):
        record = load(file)
        print(record.to_json().rstrip("\n") if json else describe_record(record))
        return
    if options["layout"] is None and _is_page(file):
        from imulab.certificate.reading import certificate_in, describe_certificate

        if (xml := certificate_in(file)) is not None:
            if json:
                raise OptionError(f"{file}: a certificate; its XML is what programs read, so show prints no JSON of it")
            print(describe_certificate(xml, file))
            return
    blocks = read_blocks(file, **reading(options))
    print(recording_json(blocks) if json else describe_recording(blocks))


def _is_page(file: str) -> bool:
    """Return whether a file begins as a PDF or as XML, in which certificates come."""
    from imulab.readers.formats import page

    try:
        if not Path(file).is_file():
            return False  # a pipe can be read only once
        with open_file(file) as stream:
            return page(stream.read(1024)) is not None
    except OSError:
        return False


def _show_formats(names: list[str], *, json: bool) -> None:
    """Print what can be read, or the layouts of these names."""
    from imulab.display import aligned
    from imulab.files import load_toml
    from imulab.readers import formats, shipped
    from imulab.readers.layout import EXAMPLE, shipped_file, shipped_names

    tables = {}
    for name in names:
        path = shipped_file(name)
        if path is None:
            raise OptionError(f"show --formats {name}: expected the name of a layout: {listed(shipped_names(), name)}")
        tables[name] = load_toml(path, name, "layout")
        if not json:
            print(path.read_text(encoding="utf-8").rstrip("\n"))
    if names and json:
        print(dumps(tables, indent=1, ensure_ascii=False))
    if names:
        return
    if json:
        kinds = [dict(zip(("name", "files", "use", "layout", "needs"), row, strict=True)) for row in formats.table()[1]]
        known = [dict(zip(("name", "files", "columns"), row, strict=True)) for row in shipped.table()[1]]
        print(dumps({"formats": kinds, "layouts": known}, indent=1, ensure_ascii=False))
        return
    lines = [*aligned(*formats.table()), "", "Layouts that come with imulab (--layout NAME):", ""]
    lines += [*aligned(*shipped.table()), "", "imulab show --formats NAME prints one, to copy and change."]
    print("\n".join([*lines, "", "A layout of your own (--layout FILE.toml):", "", EXAMPLE.rstrip("\n")]))


def _show_changes(first: str, second: str, *, json: bool) -> None:
    from imulab.cli.show import describe_changes
    from imulab.procedures.registry import load
    from imulab.procedures.views import compare_records

    records = [load(first), load(second)]
    comparison = compare_records(*records)
    if json:
        from dataclasses import asdict

        print(dumps({k: v for k, v in asdict(comparison).items() if k != "record"}, indent=1))
        return
    from imulab.records.comparison import different_units

    if other := different_units((first, records[0].sensor), (second, records[1].sensor)):
        warn(f"records of different units: {other}; give two of one unit to see what changed in it")
    print(describe_changes(first, second, comparison, records[0]))


def report(
    file: RecordFile, *, output: Annotated[str, option("OUT.html", "Report to write.", "-o", "--output"), OUTPUT]
) -> None:
    """Draw the report of a record."""
    from imulab.procedures.registry import load
    from imulab.procedures.views import write_report

    check_outputs([], [file], report=output)
    write_report(load(file), output)
    print(f"report: {output}")


def demo(folder: Annotated[str, Argument("[DIR]", "Folder to write to; demo if not given.")] = "demo") -> None:
    """Run five procedures and a fleet on simulated instruments.

    Writes recordings, records, corrected data, reports, and a page that shows them.
    """
    from functools import partial

    from imulab.cli import main
    from imulab.cli.demo import run

    print(run(folder, partial(main, project=False)))


COMMANDS = (
    Command("apply", apply, lambda: [il.apply], without=("record",)),
    Command("show", show, lambda: [how_to_read()]),
    Command("report", report),
    Command("demo", demo),
    Command("convert", convert, lambda: [how_to_read()]),
    Command("export", export, lambda: [il.export]),
)
