"""Tabulate and subtract the bias after power-on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import (
    AsJson,
    GivenFiles,
    OutputFile,
    ReportFile,
    call,
    check_outputs,
    check_record_outputs,
    naming,
    warn_older,
)
from imulab.errors import OptionError
from imulab.options import OUTPUT

if TYPE_CHECKING:
    pass


def plan(
    *,
    output: Annotated[str | None, option("PLAN.csv", "Programme to write.", "-o", "--output"), OUTPUT] = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Write the chamber programme of a test.

    With its duration; says which temperatures are missing.
    """
    from imulab.cli.show import finish_plan

    check_outputs([output], [])
    result = call(il.plan_warmup, **options)
    finish_plan(result, output, json=json)


def simulate(
    *, output: Annotated[str, option("DIR", "Folder for the recordings.", "-o", "--output"), OUTPUT], **options: Any
) -> None:
    """Simulate the power cycles of a test.

    A file each, into a folder.
    """
    made = call(il.simulate_warmup, **options)
    files = made.save(output)
    print(f"{output}: {len(made)} recordings of {made.duration:g} s, law {options['law']}")
    warn_older(output, [file.name for file in files])


def fit(
    files: Annotated[list[str], Argument("FILE...", "Recordings, one power cycle each.")],
    *,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Fit the table of a unit to its power cycles.

    Recordings of power cycles at several temperatures. Prints the comparison of the models; -o writes the
    calibration record, --report its figures.
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import run_task

    check_record_outputs(output, report, [*files, *([options["layout"]] if options["layout"] else [])])
    finish(run_task("warmup", files, options, GivenFiles()), output, report, json=json)


def table(
    file: Annotated[str, Argument("RECORD|TABLE.csv", "Record, or table to make a record of.")],
    *,
    output: Annotated[str, option("OUT", "Table (.csv) or record to write.", "-o", "--output"), OUTPUT],
    **options: Any,
) -> None:
    """Write the table as CSV, or a record from that CSV.

    The CSV is for a spreadsheet.
    """
    from imulab.cli.options import is_json
    from imulab.device.unit import is_blob

    check_outputs([output], [file])
    if is_json(file) or is_blob(file):  # a blob is refused as a record, with the reason
        with naming(file):
            sheet = call(il.warmup_table, file, **options)
        if not output.lower().endswith(".csv"):
            raise OptionError(f"{output}: expected a name that ends in .csv")
        sheet.save(output)
        print(f"table: {output}")
        return
    if output.lower().endswith(".csv"):
        raise OptionError(f"{output}: a table makes a record; expected a name such as unit.json")
    if options["per_second"]:
        raise OptionError(f"{file}: --per-second writes a table; how a table that is read counts, its titles say")
    il.warmup_table(file).save(output)
    print(f"record: {output}")


COMMANDS = (
    Command("warmup plan", plan, lambda: [il.plan_warmup]),
    Command("warmup simulate", simulate, lambda: [il.simulate_warmup]),
    Command("warmup fit", fit, lambda: [il.fit_warmup]),
    Command("warmup table", table, lambda: [il.warmup_table], without=("data",)),
)
