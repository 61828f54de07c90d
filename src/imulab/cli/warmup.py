"""``imulab warmup``: plan, simulate, fit, and the table as a spreadsheet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imulab.cli.fit_options import with_options
from imulab.cli.options import (
    AsJson,
    GivenFiles,
    OutputFile,
    ReportFile,
    check_outputs,
    naming,
    quantity,
    warn,
    whole_number,
)
from imulab.errors import OptionError
from imulab.procedures.warmup.choices import TEMPERATURES
from imulab.procedures.warmup.task import OPTIONS, temperature_list
from imulab.quantities import number as _number

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
    ramp: Annotated[str, typer.Option(metavar="K/MIN", help="Of the chamber, K/min.")] = "2",
    noise: Annotated[str, typer.Option(metavar="N", help="Angle random walk, deg/sqrt(h).")] = "0.3",
    repeatability: Annotated[str, typer.Option(help="Of the curve from cycle to cycle, percent.")] = "2",
    output: Annotated[
        str | None, typer.Option("-o", "--output", metavar="PLAN.csv", help="Programme to write.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Write the chamber programme and its duration; say which temperatures are missing."""
    from math import sqrt

    from imulab.cli.columns import aligned
    from imulab.procedures.warmup.plan import plan_warmup, programme
    from imulab.writers import write_csv

    check_outputs([output], [])
    seconds = quantity(record, "--record", "time", "s")
    result = plan_warmup(
        temperatures=temperature_list(temperatures),
        cycles=whole_number(cycles, "--cycles"),
        soak=quantity(soak, "--soak", "time", "s"),
        record=seconds,
        ramp=_number(ramp, "--ramp") / 60,
    )
    share = _number(repeatability, "--repeatability")
    if output:
        write_csv(programme(result), output)
    white = result.curve_uncertainty(60 * _number(noise, "--noise"), seconds, min(300.0, seconds / 2))
    if json:
        _print_plan(result, white, share / sqrt(result.cycles))
        return
    total = len(result.temperatures) * result.cycles
    print(
        f"{total} power cycles: {len(result.temperatures)} temperatures, {result.cycles} at each; "
        f"the chamber is busy for {_hours(result.duration)}"
    )
    rows = []
    for at in result.temperatures:
        steps = [step for step in result.steps if step.cycle and step.set_point == at]
        end = steps[-1].start + steps[-1].duration
        rows.append([f"{at:g}", str(result.cycles), _hours(steps[0].start), _hours(end)])
    print("\n".join(aligned(["set point, degC", "cycles", "from, h:min", "to, h:min"], rows)))
    print(
        f"standard uncertainty of a curve at its temperature: {white:.2g} deg/h from noise, and "
        f"{share / sqrt(result.cycles):.2g} % of the curve from repeatability"
    )
    for message in result.warnings:
        warn(message)
    if result.proposal != result.temperatures:
        print(f"better: --temperatures {','.join(f'{t:g}' for t in result.proposal)}")
    if output:
        print(f"plan: {output}")


def _print_plan(result: WarmupPlan, white: float, share: float) -> None:
    from dataclasses import asdict

    from imulab.records.json_text import json_text
    from imulab.units import to_si

    print(
        json_text(
            {
                "temperatures": list(result.temperatures),
                "cycles": result.cycles,
                "duration": {"value": result.duration, "unit": "s"},
                "steps": [asdict(step) for step in result.steps],
                "curve_uncertainty": {"value": to_si(white, "deg/h"), "unit": "rad/s"},
                "repeatability": {"value": share / 100, "unit": "1"},
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
    law: Annotated[str, typer.Option(help="How the zeros depend on temperature: smooth or bent.")] = "smooth",
    duration: Annotated[str, typer.Option(help="Of each recording.")] = "600 s",
    rate: Annotated[str, typer.Option(help="Sample rate.")] = "10 Hz",
    units: Annotated[str, typer.Option(help="Number of units of one type.")] = "1",
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate the power cycles of a warm-up test, a file each, into a folder."""
    from imulab.procedures.warmup.simulate import simulate_warmup
    from imulab.writers import write_csv

    at = temperature_list(temperatures)
    number, many = whole_number(cycles, "--cycles"), whole_number(units, "--units")
    start = whole_number(seed, "--seed")
    for name, value, low in (("--cycles", number, 1), ("--units", many, 1), ("--seed", start, 0)):
        if value < low:
            raise OptionError(f"{name} {value}: expected a whole number from {low}")
    options: dict[str, Any] = {
        "duration": quantity(duration, "--duration", "time", "s"),
        "sample_rate": quantity(rate, "--rate", "frequency", "Hz"),
    }
    spread = 0.0 if many == 1 else 0.05
    simulate_warmup(at[0], law=law, seed=start, unit_spread=spread, **options)  # refuses before a folder is made
    folder = Path(output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{output}: the folder cannot be made: {error.strerror}") from None
    for unit in range(many):
        serial = f"SIM-{start + unit:04d}"
        for i, temperature in enumerate(at):
            for cycle in range(number):
                recording = simulate_warmup(
                    temperature, law=law, serial=serial, unit_spread=spread, seed=[start, unit, i, cycle], **options
                )
                middle = f"{serial}_" if many > 1 else ""
                write_csv(recording, folder / f"cycle_{middle}{temperature:+g}_{cycle + 1}.csv")
    print(f"{output}: {many * len(at) * number} recordings of {options['duration']:g} s, law {law}")


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
    from imulab.cli.result import finish
    from imulab.procedures.run import run_task

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
    from imulab.atomic_write import write_text
    from imulab.cli.options import is_json
    from imulab.device.blob import is_blob
    from imulab.procedures.loading import load
    from imulab.procedures.warmup.spreadsheet import read_table, record_of_table, write_table
    from imulab.quantities import labelled

    check_outputs([output], [file])
    if is_json(file) or is_blob(file):  # a blob is refused by `load`, with the reason
        with naming(file), labelled("--{}", ["per-second"]):
            text = write_table(load(file), per_second=per_second)
        if not output.lower().endswith(".csv"):
            raise OptionError(f"{output}: expected a name that ends in .csv")
        write_text(output, text)
        print(f"table: {output}")
        return
    if output.lower().endswith(".csv"):
        raise OptionError(f"{output}: a table makes a record; expected a name such as unit.json")
    if per_second:
        raise OptionError(f"{file}: --per-second writes a table; how a table that is read counts, its titles say")
    record_of_table(read_table(file), file).save(output)
    print(f"record: {output}")


def _hours(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d} h"
