"""``imulab warmup``: plan, simulate, fit, and the table as a spreadsheet."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from imulab.cli.options import (
    AsJson,
    GivenFiles,
    OutputFile,
    ReportFile,
    call,
    check_outputs,
    naming,
    one_of,
    warn,
    with_options,
)
from imulab.errors import OptionError
from imulab.procedures.warmup import LAWS, TEMPERATURES
from imulab.procedures.warmup.procedure import OPTIONS

if TYPE_CHECKING:
    from imulab.procedures.warmup.plan import WarmupPlan

Temperatures = Annotated[str, typer.Option(metavar="T,T,...", help="Calibration temperatures, degC, ascending.")]


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    for function in (plan, simulate, fit, table):
        group.command(function.__name__)(function)
    return group


def plan(
    temperatures: Temperatures = TEMPERATURES,
    cycles: Annotated[str, typer.Option(help="Power cycles at each temperature.")] = "5",
    soak: Annotated[str, typer.Option(help="Before each power-on, unit off, s, or with a unit.")] = "60 min",
    record: Annotated[str, typer.Option(help="Recording from power-on on, s, or with a unit.")] = "10 min",
    ramp: Annotated[str, typer.Option(metavar="K/MIN", help="Of the chamber, K/min.")] = "2 K/min",
    noise: Annotated[str, typer.Option(metavar="N", help="Angle random walk, deg/sqrt(h).")] = "0.3 deg/sqrt(h)",
    repeatability: Annotated[str, typer.Option(help="Of the curve from cycle to cycle, percent.")] = "2 %",
    output: Annotated[
        str | None, typer.Option("-o", "--output", metavar="PLAN.csv", help="Programme to write.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Write the chamber programme and its duration; say which temperatures are missing."""
    from imulab.procedures.warmup.plan import plan_warmup
    from imulab.units import from_si

    check_outputs([output], [])
    result = call(
        plan_warmup, temperatures=temperatures, cycles=cycles, soak=soak, record=record, ramp=ramp, noise=noise,
        repeatability=repeatability,
    )  # fmt: skip
    if output:
        result.save(output)
    if json:
        _print_plan(result)
        return
    print(result)
    print(
        "standard uncertainty of a curve at its temperature: "
        f"{from_si(result.curve_uncertainty, 'deg/h'):.2g} deg/h from noise, and "
        f"{100 * result.repeatability_uncertainty:.2g} % of the curve from repeatability"
    )
    for message in result.warnings:
        warn(message)
    if result.proposal != result.temperatures:
        print(f"better: --temperatures {','.join(f'{t:g}' for t in result.proposal)}")
    if output:
        print(f"plan: {output}")


def _print_plan(result: WarmupPlan) -> None:
    from dataclasses import asdict

    from imulab.records.calibration import json_text

    print(
        json_text(
            {
                "temperatures": list(result.temperatures),
                "cycles": result.cycles,
                "duration": {"value": result.duration, "unit": "s"},
                "steps": [asdict(step) for step in result.steps],
                "curve_uncertainty": {"value": result.curve_uncertainty, "unit": "rad/s"},
                "repeatability": {"value": result.repeatability_uncertainty, "unit": "1"},
                "proposal": list(result.proposal),
                "warnings": list(result.warnings),
            }
        ),
        end="",
    )
    for message in result.warnings:
        warn(message)


def simulate(
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder for the recordings.")],
    temperatures: Temperatures = TEMPERATURES,
    cycles: Annotated[str, typer.Option(help="Power cycles at each temperature.")] = "3",
    law: Annotated[str, one_of(LAWS, "How the zeros depend on temperature.")] = "smooth",
    duration: Annotated[str, typer.Option(help="Of each recording.")] = "600 s",
    rate: Annotated[str, typer.Option(help="Sample rate.")] = "10 Hz",
    units: Annotated[str, typer.Option(help="Number of units of one type.")] = "1",
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate the power cycles of a warm-up test, a file each, into a folder."""
    from imulab.procedures.warmup.simulate import simulate_warmup

    made = call(
        simulate_warmup, temperatures=temperatures, cycles=cycles, law=law, duration=duration, rate=rate, units=units,
        seed=seed,
    )  # fmt: skip
    made.save(output)
    print(f"{output}: {len(made)} recordings of {made.duration:g} s, law {law}")


@with_options(OPTIONS)
def fit(
    files: Annotated[list[str], typer.Argument(metavar="FILE...", help="Recordings, one power cycle each.")],
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Fit the table of a unit's warm-up to recordings of power cycles at several temperatures.

    Prints the comparison of the models; -o writes the calibration record, --report its figures.
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import run_task

    check_outputs([output, report], [*files, *([options["layout"]] if options["layout"] else [])])
    finish(run_task("warmup", files, options, GivenFiles()), output, report, json=json)


def table(
    file: Annotated[str, typer.Argument(metavar="RECORD|TABLE.csv", help="Record, or table to make a record of.")],
    output: Annotated[str, typer.Option("-o", "--output", metavar="OUT", help="Table (.csv) or record to write.")],
    per_second: Annotated[
        bool, typer.Option("--per-second", help="Write cubics in powers of t in s, not of t / settling time.")
    ] = False,
) -> None:
    """Write a record's table as CSV for a spreadsheet, or make a record of such a table."""
    from imulab.cli.options import is_json
    from imulab.device.unit import is_blob
    from imulab.procedures.warmup.spreadsheet import warmup_table

    check_outputs([output], [file])
    if is_json(file) or is_blob(file):  # a blob is refused as a record, with the reason
        with naming(file):
            sheet = call(warmup_table, file, per_second=per_second)
        if not output.lower().endswith(".csv"):
            raise OptionError(f"{output}: expected a name that ends in .csv")
        sheet.save(output)
        print(f"table: {output}")
        return
    if output.lower().endswith(".csv"):
        raise OptionError(f"{output}: a table makes a record; expected a name such as unit.json")
    if per_second:
        raise OptionError(f"{file}: --per-second writes a table; how a table that is read counts, its titles say")
    warmup_table(file).save(output)
    print(f"record: {output}")
