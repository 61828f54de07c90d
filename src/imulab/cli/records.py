"""Commands on records and recordings of every procedure: apply, show, report, demo."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imulab.cli.convert import write_out
from imulab.cli.fit_options import READ, reading, with_options
from imulab.cli.options import (
    AsJson,
    OutputFile,
    RecordFile,
    check_outputs,
    is_json,
    naming,
    note,
    quantity,
    warn,
    with_notes,
)
from imulab.errors import ImulabError, OptionError, RecordError

if TYPE_CHECKING:
    from imulab.device.blob import Blob
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


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
    from imulab.power_on import with_power_on_temperature
    from imulab.procedures.apply import apply_blocks, loaded, with_heading
    from imulab.procedures.loading import load_any
    from imulab.readers import read_blocks

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
    from imulab.power_on import TAKEN_FROM
    from imulab.procedures.apply import results_in, warnings_of
    from imulab.verdict import Note

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
    from imulab.device.blob import is_blob, load_blob
    from imulab.procedures.loading import load
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
    from imulab.readers import formats, shipped
    from imulab.readers.layout import EXAMPLE, shipped_file, shipped_names
    from imulab.shown import aligned
    from imulab.toml import load_toml

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
    from imulab.procedures.changes import compare_records
    from imulab.procedures.loading import load

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
    from imulab.procedures.loading import load
    from imulab.procedures.reports import write_report

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
