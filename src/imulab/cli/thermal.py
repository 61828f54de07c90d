"""Calibrate accelerometers and gyroscopes over temperature."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import (
    AsJson,
    GivenFiles,
    OutputFile,
    RecordFile,
    ReportFile,
    call,
    check_outputs,
    check_record_outputs,
    read_recording,
    reading,
    warn_older,
)
from imulab.options import OUTPUT

if TYPE_CHECKING:
    pass


def plan(
    *,
    output: Annotated[str | None, option("PLAN.csv", "Plan to write.", "-o", "--output"), OUTPUT] = None,
    report: Annotated[str | None, option("SHEET.html", "Sheet to print."), OUTPUT] = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Choose soaks, temperatures and attitudes.

    For the time there is; says what the laws will give.
    """
    from imulab.cli.show import check_plan_outputs, finish_plan

    check_plan_outputs(output, report, [name for name in (options["noise"], options["from_"]) if Path(name).is_file()])
    made = call(il.plan_thermal, **options | {"with_": options["with_"] or ()})
    finish_plan(made, output, report, json=json)


def ramp(*, json: AsJson = False, **options: Any) -> None:
    """Say how long gyroscopes should rest while they warm.

    And how well one such ramp tells their biases over temperature.
    """
    from imulab.cli.show import finish_plan

    finish_plan(call(il.plan_ramp, **options), None, json=json)


def simulate(
    *, output: Annotated[str, option("DIR", "Folder for the recordings.", "-o", "--output"), OUTPUT], **options: Any
) -> None:
    """Simulate a unit at several temperatures.

    Tumbles at set points of a chamber and rest ramps of one unit, a file each, into a folder.
    """
    made = call(il.simulate_thermal, **options)
    made.save(output)
    print(f"{output}: {len(made)} recordings, law {options['law']}, truth in truth.json")
    warn_older(output, [recording.name for recording in made])


def fit(
    files: Annotated[list[str], Argument("FILE...", "Recordings, one power cycle each.")],
    *,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Fit one model to recordings at several temperatures.

    Recordings of one unit with a column temperature: full and partial tumbles at several temperatures, and
    recordings at rest in which the temperature drifts. Calibrates the accelerometer triad over temperature.
    Rest ramps alone give the biases of gyroscopes over temperature.
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import run_task

    inputs = [name for name in (options["layout"], options["prior"]) if name]
    check_record_outputs(output, report, [*files, *inputs])
    finish(run_task("thermal", files, options, GivenFiles()), output, report, json=json)


def check(
    record: RecordFile,
    files: Annotated[list[str], Argument("FILE...", "New recordings, one power cycle each.")],
    *,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> int:
    """Hold new recordings against a record.

    Tests whether they still agree with it, without refitting; exit status 0: pass, 1: fail. Attitudes at any
    temperature within the record's range, or rest ramps. A record that still holds fails once in twenty tests.
    """
    from imulab.cli.show import finish_check, notes_on_data
    from imulab.errors import RecordError
    from imulab.procedures.registry import load

    check_outputs([], [name for name in (record, *files, options["layout"]) if name], report=report)
    held = load(record)
    how = reading(options)
    recordings = [read_recording(file, **how) for file in files]
    chosen = {name: value for name, value in options.items() if value is not None}
    try:
        result = call(il.check_thermal, held, recordings, **chosen)
    except RecordError as error:
        raise RecordError(f"{record}: {error}") from None
    return finish_check(result, held, record, files, notes_on_data(held, recordings), report, json=json)


COMMANDS = (
    Command("thermal plan", plan, lambda: [il.plan_thermal]),
    Command("thermal ramp", ramp, lambda: [il.plan_ramp]),
    Command("thermal simulate", simulate, lambda: [il.simulate_thermal]),
    Command("thermal fit", fit, lambda: [il.fit_thermal]),
    Command("thermal check", check, lambda: [il.check_thermal]),
)
