"""``imulab thermal``: simulate and fit."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from imulab.cli.fit_options import one_of, with_options
from imulab.cli.options import AsJson, GivenFiles, OutputFile, ReportFile, call, check_outputs
from imulab.procedures.thermal.choices import LAWS, TEMPERATURES
from imulab.procedures.thermal.task import OPTIONS


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    group.command("simulate")(simulate)
    group.command("fit")(fit)
    return group


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
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate tumbles at set points of a chamber and rest ramps of one unit, a file each, into a folder."""
    from imulab.procedures.thermal.simulate import simulate_thermal

    made = call(
        simulate_thermal, temperatures=temperatures, attitudes=attitudes, ramps=ramps, law=law, noise=noise,
        turn_on=turn_on, duration=duration, rate=rate, seed=seed,
    )  # fmt: skip
    made.save(output)
    print(f"{output}: {len(made)} recordings, law {law}")


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
    from imulab.cli.result import finish
    from imulab.procedures.run import run_task

    given = [name for name in (options["layout"], options["prior"]) if name]
    check_outputs([output, report], [*files, *given])
    finish(run_task("thermal", files, options, GivenFiles()), output, report, json=json)
