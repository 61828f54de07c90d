"""Commands on records and recordings of every procedure: apply, show, report, demo, convert, export."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imulab.cli.options import (
    READ,
    AsJson,
    OutputFile,
    RecordFile,
    RecordingFile,
    call,
    check_outputs,
    is_json,
    lists,
    naming,
    note,
    one_of,
    quantity,
    reading,
    warn,
    with_notes,
    with_options,
)
from imulab.errors import ImulabError, OptionError, RecordError

if TYPE_CHECKING:
    from imulab.device.unit import Blob
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


# ``imulab convert``: any recording to native CSV or Parquet.


@with_options(READ)
def convert(
    file: RecordingFile,
    options: dict[str, str | None],
    with_files: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="FILE[@LAYOUT]",
            help="Another sensor of the same unit, on the same clock, whose columns are added; repeatable.",
        ),
    ] = None,
    output: OutputFile = None,
) -> None:
    """Write a recording of any kind as native CSV or Parquet to OUT, or as CSV to standard output."""
    from imulab.readers import read, read_blocks
    from imulab.readers.streams import file_and_layout, join_recordings

    others = [file_and_layout(text) for text in with_files or []]
    inputs = [name for pair in ((file, options["layout"]), *others) for name in pair if name]
    check_outputs([output], inputs)
    blocks: Iterable[Recording] = read_blocks(file, **reading(options))
    if others:
        first = read(file, **reading(options))
        blocks = [join_recordings(first, [read(other, layout) for other, layout in others])]
    write_out(with_notes(blocks), output)


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
    records: Annotated[list[str], typer.Argument(metavar="RECORD...", help="Calibration records of one unit.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="TARGET",
            help="c blob px4 ardupilot kalibr openvins ros fusion motioncal.",
            autocompletion=lists("imulab.exporters:EXPORTERS"),
        ),
    ],
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder to write to.")],
    lossy: Annotated[
        bool, typer.Option("--lossy", help="Leave out what the target cannot hold, and fit the rest anew.")
    ] = False,
    device_id: Annotated[str, typer.Option("--device-id", metavar="N", help="PX4: number of the sensor.")] = "0",
    noise: Annotated[
        str | None, typer.Option("--noise", metavar="FILE", help="Noise record, or what 'allan --json' printed.")
    ] = None,
    method: Annotated[
        str | None, typer.Option("--method", help="c, blob: how an array fuses; what its record carries if not given.")
    ] = None,
    memory: Annotated[
        str | None, typer.Option("--memory", help="c, blob: growing, growing:COUNT, or a gain between 0 and 1.")
    ] = None,
    mag_mount: Annotated[
        str,
        one_of(
            ("external", "internal"),
            "px4, ardupilot: whether the magnetometers have a rotation of their own there, which holds their mounting.",
            "--mag-mount",
        ),
    ] = "external",
) -> None:
    """Write calibration records in the form of firmware, an autopilot or a toolbox."""
    from imulab.procedures.exporting import export as write

    if not output:
        raise OptionError("-o '': expected a folder to write to")
    files = call(
        write, to=to, records=records, folder=output, lossy=lossy, device_id=device_id, noise=noise, method=method,
        memory=memory, mag_mount=mag_mount, tell=warn,
    )  # fmt: skip
    for file in files:
        print(f"{to}: {file}")


# Commands on records and recordings of every procedure: apply, show, report, demo.


def add_commands(app: typer.Typer) -> None:
    """Add these commands to the root."""
    for name, function in (("apply", apply), ("show", show), ("report", report), ("demo", demo)):
        app.command(name)(function)


@with_options(READ)
def apply(
    files: Annotated[list[str], typer.Argument(metavar="RECORD... FILE", help="Records, then the recording.")],
    options: dict[str, str | None],
    again: Annotated[bool, typer.Option("--again", help="Correct a recording that a record corrected before.")] = False,
    latest_start: Annotated[
        str,
        typer.Option("--latest-start", help="Refuse a recording that starts later after power-on (warm-up)."),
    ] = "5 s",
    temperature_column: Annotated[
        bool,
        typer.Option(
            "--temperature-column",
            help="Take a missing power-on temperature from the first row's column temperature (warm-up).",
        ),
    ] = False,
    heading: Annotated[
        bool, typer.Option("--heading", help="Add columns of magnetic heading and dip, deg, with uncertainties.")
    ] = False,
    output: OutputFile = None,
) -> None:
    """Correct a recording by one or more records, in the order given; CSV or Parquet to OUT, CSV to standard output."""
    from imulab.procedures.apply import apply_blocks, loaded, with_heading
    from imulab.procedures.registry import load_any
    from imulab.readers import read_blocks
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
    chain, start = [], quantity(latest_start, "--latest-start", "time", "s")
    for name, record in zip(names, records, strict=True):
        with naming(name):
            chain.append(
                loaded(
                    record,
                    Path(name).name,
                    again=again,
                    latest_start=start,
                )
            )
    if heading:
        chain = with_heading(chain, records)
    blocks = with_notes(read_blocks(file, **how), notes=False)
    if temperature_column and any(part.since_power_on for ready in chain for part, _ in ready.sections):
        blocks = with_power_on_temperature(blocks)
    rows = _Rows()
    write_out(rows.counted(apply_blocks(chain, _with_warnings(records, blocks))), output)
    by = " and ".join(dict.fromkeys(Path(name).name for name in names))
    what = "standard input" if file == "-" else file
    note(f"{rows.count} rows of {what} corrected by {by}: {output or 'standard output'}")


@dataclass
class _Rows:
    """How many rows went through."""

    count: int = 0

    def counted(self, blocks: Iterable[Recording]) -> Iterator[Recording]:
        """Pass blocks on and count their rows."""
        for block in blocks:
            self.count += len(block)
            yield block


def _with_warnings(records: list[Calibration | Blob], blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Pass blocks on; say behind the first what a user should know, and at the end what lay beyond the test."""
    from imulab.display import Note
    from imulab.procedures.apply import results_in, warnings_of
    from imulab.recording import TAKEN_FROM

    tests = results_in(records)
    counts, largest, name = [0] * len(tests), [0.0] * len(tests), ""
    for number, block in enumerate(blocks):
        for index, (record, procedure) in enumerate(tests):
            try:
                here, most = procedure.beyond(record, block)
            except ImulabError:  # what only an earlier record of the chain makes usable; apply itself refuses the rest
                continue
            counts[index], largest[index], name = counts[index] + here, max(largest[index], most), block.name
        yield block
        if number == 0:  # after it was corrected: where it is refused, the refusal is the one line there is
            messages = [message for record in records for message in warnings_of(record, block)]
            if power_on := block.metadata.get(TAKEN_FROM):
                messages.append(Note(f"{block.name}: the power-on temperature was taken from {power_on}"))
            messages += [f"{block.name}: was corrected before, by {entry}" for entry in block.corrected_by]
            for message in dict.fromkeys(messages):
                warn(message)
    for (record, procedure), count, most in zip(tests, counts, largest, strict=True):
        if count:
            warn(f"{name}: {procedure.beyond_message(record, count, most)}")


@with_options(READ)
def show(
    files: Annotated[
        list[str] | None, typer.Argument(metavar="FILE [FILE]", help="Record or recording, or two records.")
    ] = None,
    *,
    options: dict[str, str | None],
    formats: Annotated[bool, typer.Option("--formats", help="List the kinds of recording that can be read.")] = False,
    json: AsJson = False,
) -> None:
    """Say what is in a record or a recording, or what changed between two records of one unit."""
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
    blocks = read_blocks(file, **reading(options))
    print(recording_json(blocks) if json else describe_recording(blocks))


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
            raise OptionError(f"show --formats {name}: expected the name of a layout: {' '.join(shipped_names())}")
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
    serials = [record.sensor.get("serial") for record in records]
    if all(serials) and serials[0] != serials[1]:
        warn(f"records of different units: {serials[0]} and {serials[1]}")
    print(describe_changes(first, second, comparison, records[0]))


def report(
    file: RecordFile,
    output: Annotated[str, typer.Option("-o", "--output", metavar="OUT.html", help="Report to write.")],
) -> None:
    """Draw the report of a record."""
    from imulab.procedures.registry import load
    from imulab.procedures.views import write_report

    check_outputs([output], [file])
    write_report(load(file), output)
    print(f"report: {output}")


def demo(
    context: typer.Context,
    folder: Annotated[str, typer.Argument(metavar="[DIR]", help="Folder to write to.")] = "demo",
) -> None:
    """Run the procedures on simulated rigs and write recordings, records, corrected data and reports."""
    from functools import partial

    from imulab.demo import run

    print(run(folder, partial(context.obj, project=False)))
