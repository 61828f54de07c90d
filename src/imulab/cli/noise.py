"""``imulab noise``: fit, plan, check, simulate."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from imulab.cli.fit_options import with_options
from imulab.cli.options import AsJson, GivenFiles, OutputFile, ReportFile, check_outputs
from imulab.procedures.noise.task import OPTIONS


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    for function in (fit,):
        group.command(function.__name__)(function)
    return group


@with_options(OPTIONS)
def fit(
    files: Annotated[list[str], typer.Argument(metavar="LOG...", help="Logs at rest of one unit.")],
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Fit a model of the noise to logs at rest, column by column; several logs of a unit add up.

    Prints the terms with their 95 % intervals, and what a filter wants; -o writes the record, --report its figures.
    """
    from imulab.cli.result import finish
    from imulab.procedures.run import run_task

    check_outputs([output, report], [*files, *([options["layout"]] if options["layout"] else [])])
    finish(run_task("noise", files, options, GivenFiles()), output, report, json=json)
