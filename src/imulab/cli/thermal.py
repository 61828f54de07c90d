"""Calibrate an accelerometer triad over temperature."""

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
    note,
    read_recording,
    reading,
    warn,
)
from imulab.options import OUTPUT

if TYPE_CHECKING:
    from imulab.procedures.thermal.plan import ThermalPlan


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
    from imulab.cli.show import check_plan_outputs, say_written, write_plan
    from imulab.display import aligned

    check_plan_outputs(output, report, [name for name in (options["noise"], options["from_"]) if Path(name).is_file()])
    made = call(il.plan_thermal, **options | {"with_": options["with_"] or ()})
    write_plan(made, output, report)
    if json:
        print(_plan_json(made), end="")
        return
    lead, titles, rows = made.shown()
    tables = [made.compared(), (["predicted sd of", "value", "unit"], [list(row) for row in made.predicted])]
    print("\n".join([lead, *aligned(titles, rows)]))
    for titles, rows in tables:
        print("\n".join(["", *aligned(titles, rows)]))
    say_written(output, report)


def _plan_json(made: ThermalPlan) -> str:
    """Return the plan for scripts, in SI."""
    from imulab.records.calibration import json_text

    def force(value: float) -> dict[str, Any]:
        return {"value": value, "unit": "m/s^2"}

    gyro = {}
    if made.gyro is not None:
        gyro["gyro"] = {
            "noise": {"value": made.gyro.noise, "unit": "rad/sqrt(s)"},
            "turn_on_scatter": {"value": made.gyro.turn_on_scatter, "unit": "rad/s"},
            "mean": {"value": made.gyro.mean, "unit": "rad/s"},
            "predicted": {"standard_uncertainty": made.gyro.deviation.tolist(), "unit": "rad/s"},
            "turns": made.gyro.turns,
            "turned_at": made.gyro.turned_at,
        }
    return json_text(
        {
            "degrees": list(made.degrees),
            "duration": {"value": made.duration, "unit": "s"},
            "noise": force(made.noise),
            "turn_on_scatter": force(made.turn_on_scatter),
            "mean": force(made.mean),
            "predicted": {
                "temperature": made.temperature.tolist(),
                "standard_uncertainty": made.deviation.tolist(),
                "unit": "m/s^2",
            },
            "soaks": [
                {
                    "temperature": soak.temperature,
                    "reached_by": "warming" if soak.warming else "cooling",
                    "start": soak.start,
                    "duration": soak.duration,
                    "up": soak.directions.tolist(),
                }
                for soak in made.soaks
            ],
            "compared": [
                {"soaks": each.soaks, "attitudes": each.attitudes, "mean": each.mean, "worst": each.worst}
                for each in made.tried
            ],
            **gyro,
        }
    )


def simulate(
    *, output: Annotated[str, option("DIR", "Folder for the recordings.", "-o", "--output"), OUTPUT], **options: Any
) -> None:
    """Simulate a unit at several temperatures.

    Tumbles at set points of a chamber and rest ramps of one unit, a file each, into a folder.
    """
    made = call(il.simulate_thermal, **options)
    made.save(output)
    print(f"{output}: {len(made)} recordings, law {options['law']}, truth in truth.json")


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
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import run_task

    given = [name for name in (options["layout"], options["prior"]) if name]
    check_outputs([output, report], [*files, *given])
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
    from imulab.cli.options import coloured
    from imulab.display import Note
    from imulab.errors import RecordError
    from imulab.procedures.apply import warnings_of
    from imulab.procedures.registry import load
    from imulab.procedures.thermal.check import as_json, as_text, check_page

    check_outputs([report], [name for name in (record, *files, options["layout"]) if name])
    held = load(record)
    how = reading(options)
    given = [read_recording(file, **how) for file in files]
    chosen = {name: value for name, value in options.items() if value is not None}
    try:
        found = call(il.check_thermal, held, given, **chosen)
    except RecordError as error:
        raise RecordError(f"{record}: {error}") from None
    notes = [*(each for one in given for each in warnings_of(held, one)), *found.notes]
    for one in given:
        notes += [
            f"{one.name}: was corrected before, by {entry}; a record is checked by what the unit puts out, so the test "
            "means nothing here"
            for entry in one.corrected_by
        ]
    if report:
        from imulab.files import write_text

        write_text(report, check_page(found, held, record=record, files=files, warnings=notes))
    if json:
        from imulab.records.calibration import json_text

        print(json_text(as_json(found)), end="")
    else:
        print(as_text(found, coloured("pass" if found.passed else "fail")))
    for message in notes:
        (note if isinstance(message, Note) else warn)(message)
    if report and not json:
        print(f"report: {report}")
    return 0 if found.passed else 1


COMMANDS = (
    Command("thermal plan", plan, lambda: [il.plan_thermal]),
    Command("thermal simulate", simulate, lambda: [il.simulate_thermal]),
    Command("thermal fit", fit, lambda: [il.fit_thermal]),
    Command("thermal check", check, lambda: [il.check_thermal]),
)
