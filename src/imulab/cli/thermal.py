"""``imulab thermal``: plan, simulate, fit and check."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imulab.cli.options import (
    READ,
    AsJson,
    GivenFiles,
    OutputFile,
    RecordFile,
    ReportFile,
    call,
    check_outputs,
    note,
    one_of,
    read_recording,
    reading,
    warn,
    with_options,
)
from imulab.procedures.thermal import LAWS, TEMPERATURES
from imulab.procedures.thermal.procedure import OPTIONS
from imulab.procedures.tumble import STARTS

if TYPE_CHECKING:
    from imulab.procedures.thermal.plan import ThermalPlan


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    for function in (plan, simulate, fit, check):
        group.command(function.__name__)(function)
    return group


def plan(
    temperatures: Annotated[
        str, typer.Option(metavar="LOW,HIGH", help="Lowest and highest temperature, degC.")
    ] = "-20,60",
    time: Annotated[str, typer.Option(help="In the chamber, all told, min, or with a unit.")] = "8 h",
    soak: Annotated[str, typer.Option(help="Until the unit has the next temperature, min.")] = "45 min",
    attitude: Annotated[str, typer.Option(help="For one attitude, the turn to it included, min.")] = "1 min",
    noise: Annotated[
        str,
        typer.Option(metavar="60ug|FILE", help="Noise of |f| in one attitude, or a recording or record that has it."),
    ] = "60 ug",
    turn_on_scatter: Annotated[
        str, typer.Option(help="What biases move by from one power cycle to the next, mg.")
    ] = "0.1 mg",
    degrees: Annotated[str, typer.Option(metavar="B,S,M", help="Of bias, scale factor and misalignment.")] = "3,2,1",
    source: Annotated[
        str,
        one_of(
            STARTS,
            "Where attitudes may lie: sphere, fixture:15 or head:15 (steps in deg), or a file that lists them.",
            "--from",
            metavar="sphere|FILE",
        ),
    ] = "sphere",
    with_: Annotated[
        str | None, one_of(("gyro",), "Say what the same soaks give of the gyroscopes, too.", "--with")
    ] = None,
    gyro_noise: Annotated[
        str | None,
        typer.Option(metavar="N", help="Angle random walk of the gyroscopes, deg/sqrt(h); 0.3 if not given."),
    ] = None,
    gyro_turn_on_scatter: Annotated[
        str | None,
        typer.Option(help="What their biases move by from one power cycle to the next, deg/s; 0.01 if not given."),
    ] = None,
    output: Annotated[str | None, typer.Option("-o", "--output", metavar="PLAN.csv", help="Plan to write.")] = None,
    report: Annotated[str | None, typer.Option("--report", metavar="SHEET.html", help="Sheet to print.")] = None,
    json: AsJson = False,
) -> None:
    """Choose soaks, temperatures and attitudes for the time there is, and say what the laws will give."""
    from imulab.cli.show import check_plan_outputs, say_written, write_plan
    from imulab.display import aligned
    from imulab.procedures.thermal.plan import plan_thermal

    check_plan_outputs(output, report, [name for name in (noise, source) if Path(name).is_file()])
    made = call(
        plan_thermal, temperatures=temperatures, time=time, soak=soak, attitude=attitude, noise=noise,
        turn_on_scatter=turn_on_scatter, degrees=degrees, from_=source, with_=with_ or (), gyro_noise=gyro_noise,
        gyro_turn_on_scatter=gyro_turn_on_scatter,
    )  # fmt: skip
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
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder for the recordings.")],
    temperatures: Annotated[
        str, typer.Option(metavar="T,T,...", help="Set points of the chamber, degC, a tumble at each.")
    ] = TEMPERATURES,
    attitudes: Annotated[str, typer.Option(help="Static attitudes of each tumble; 0 for ramps alone.")] = "12",
    ramps: Annotated[str, typer.Option(help="Rest ramps from the lowest to the highest temperature.")] = "0",
    law: Annotated[str, one_of(LAWS, "How the biases follow the temperature.")] = "cubic",
    noise: Annotated[str, typer.Option(help="Standard deviation of one sample, m/s^2 or with a unit.")] = "0.7 mg",
    turn_on: Annotated[str, typer.Option(help="Scatter of biases between power cycles, m/s^2.")] = "0.1 mg",
    duration: Annotated[str, typer.Option(help="Of a ramp, s.")] = "30 min",
    rate: Annotated[str, typer.Option(help="Samples per second of a tumble.")] = "50 Hz",
    gyro: Annotated[bool, typer.Option("--gyro", help="Columns of gyroscopes too.")] = False,
    gyro_turn_on: Annotated[
        str, typer.Option(help="Scatter of their biases between power cycles, rad/s.")
    ] = "0.01 deg/s",
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate tumbles at set points of a chamber and rest ramps of one unit, a file each, into a folder."""
    from imulab.procedures.thermal.simulate import simulate_thermal

    made = call(
        simulate_thermal, temperatures=temperatures, attitudes=attitudes, ramps=ramps, law=law, noise=noise,
        turn_on=turn_on, duration=duration, rate=rate, gyro=gyro, gyro_turn_on=gyro_turn_on,
        seed=seed,
    )  # fmt: skip
    made.save(output)
    print(f"{output}: {len(made)} recordings, law {law}, truth in truth.json")


@with_options(OPTIONS)
def fit(
    files: Annotated[list[str], typer.Argument(metavar="FILE...", help="Recordings, one power cycle each.")],
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Calibrate an accelerometer triad over temperature from recordings of one unit with a column temperature.

    Full and partial tumbles at several temperatures, and recordings at rest in which the temperature drifts.
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import run_task

    given = [name for name in (options["layout"], options["prior"]) if name]
    check_outputs([output, report], [*files, *given])
    finish(run_task("thermal", files, options, GivenFiles()), output, report, json=json)


_OF_THE_CHECK = (
    "gravity",
    "latitude",
    "height",
    "tilt",
    "turn_on_scatter",
    "gyro_turn_on_scatter",
    "settle",
    "temperature_column",
)


@with_options((*(option for option in OPTIONS if option.name in _OF_THE_CHECK), *READ))
def check(
    record: RecordFile,
    files: Annotated[list[str], typer.Argument(metavar="FILE...", help="New recordings, one power cycle each.")],
    *,
    options: dict[str, str | None],
    limit: Annotated[str | None, typer.Option(help="Largest | |f| - g | that passes, mg, beside the test.")] = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> int:
    """Test whether new recordings still agree with a record, without refitting; exit status 0: pass, 1: fail.

    Attitudes at any temperature within the record's range, or rest ramps. A record that still holds fails once in
    twenty tests.
    """
    from imulab.cli.options import coloured
    from imulab.display import Note
    from imulab.errors import RecordError
    from imulab.procedures.apply import warnings_of
    from imulab.procedures.registry import load
    from imulab.procedures.thermal.check import as_json, as_text, check_page, check_thermal

    check_outputs([report], [name for name in (record, *files, options["layout"]) if name])
    held = load(record)
    given = [read_recording(file, **reading(options)) for file in files]
    chosen = {name: options[name] for name in _OF_THE_CHECK if options[name] is not None}
    try:
        found = call(check_thermal, held, given, limit=limit, **chosen)
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
