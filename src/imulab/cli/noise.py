"""``imulab noise``: fit, plan, check, simulate."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from imulab.cli.fit_options import with_options
from imulab.cli.options import AsJson, GivenFiles, OutputFile, ReportFile, check_outputs, quantity
from imulab.errors import OptionError
from imulab.procedures.noise.task import OPTIONS


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    for function in (fit,):
        group.command(function.__name__)(function)
    return group


def _programs(incomplete: str) -> list[str]:
    from imulab.procedures.noise.wants import PROGRAMS

    return [name for name in PROGRAMS if name.startswith(incomplete)]


@with_options(OPTIONS)
def fit(
    files: Annotated[list[str], typer.Argument(metavar="LOG...", help="Logs at rest of one unit.")],
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    program: Annotated[
        str | None,
        typer.Option(
            "--for", metavar="PROGRAM", help="Print what its filter wants, key: value.", autocompletion=_programs
        ),
    ] = None,
    rate: Annotated[str | None, typer.Option(metavar="HZ", help="--for: samples that it gets; as the logs.")] = None,
    step: Annotated[
        str | None, typer.Option(metavar="TIME", help="--for: between predictions; px4 10 ms, ardupilot 12 ms.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Fit a model of the noise to logs at rest, column by column; several logs of a unit add up.

    Prints the terms with their 95 % intervals, and what a filter wants; -o writes the record, --report its figures.
    """
    from imulab.cli.result import finish
    from imulab.procedures.noise.wants import check_program, noise_for
    from imulab.procedures.run import run_task
    from imulab.quantities import labelled

    check_outputs([output, report], [*files, *([options["layout"]] if options["layout"] else [])])
    hertz = None if rate is None else quantity(rate, "--rate", "frequency", "Hz")
    seconds = None if step is None else quantity(step, "--step", "time", "s")
    if program is not None:
        check_program(program, "--for")
    elif rate is not None or step is not None:
        raise OptionError("--rate and --step say how the filter of --for runs: expected --for")
    record = run_task("noise", files, options, GivenFiles())
    if program is None:
        finish(record, output, report, json=json)
        return
    with labelled("--{}", ["rate", "step"]):
        wanted = noise_for(record, program, rate=hertz, step=seconds)
    finish(record, output, report, json=json, describe=lambda _: "\n".join(f"{k}: {v:.4g}" for k, v in wanted.items()))
