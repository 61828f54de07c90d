"""``imulab rate``: simulate, fit and turn."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from imulab.cli.fit_options import READ, reading, with_options
from imulab.cli.options import AsJson, GivenFiles, OutputFile, ReportFile, call, check_outputs, read_recording
from imulab.procedures.rate.choices import FENCE, RATES
from imulab.procedures.rate.task import OPTIONS


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    group.command("simulate")(simulate)
    group.command("fit")(fit)
    group.command("turn")(turn)
    return group


def simulate(
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder for the recordings.")],
    rates: Annotated[str, typer.Option(metavar="R,R,...", help="Sizes of the rates, deg/s.")] = RATES,
    faces: Annotated[str, typer.Option(help="Body axes up along the table axis, one after the other.")] = "+x,+y,+z",
    cycles: Annotated[str, typer.Option(help="Runs of each face.")] = "1",
    hold: Annotated[str, typer.Option(help="Time at each rate, s.")] = "8 s",
    noise: Annotated[str, typer.Option(help="Standard deviation of one sample, deg/s.")] = "0.03 deg/s",
    rate: Annotated[str, typer.Option(help="Samples per second, Hz.")] = "100 Hz",
    bend: Annotated[str, typer.Option(help="Largest part of k3, a fraction of the largest rate.")] = "0",
    loop: Annotated[str, typer.Option(help="Rising less falling at rate 0, a fraction of the largest rate.")] = "0",
    latitude: Annotated[str, typer.Option(help="Of the place, deg.")] = "48 deg",
    table: Annotated[str, typer.Option(help="Standard deviation of what all rates are off by, a fraction.")] = "0",
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate a unit on a rate table, a file for each face and cycle, with their manifest test.toml, into a folder."""
    from imulab.procedures.rate.simulate import simulate_rate

    made = call(
        simulate_rate, rates=rates, faces=faces, cycles=cycles, hold=hold, noise=noise, rate=rate, bend=bend, loop=loop,
        latitude=latitude, table=table, seed=seed,
    )  # fmt: skip
    made.save(output)
    print(f"{output}: test.toml and {len(made.recordings)} recordings")


@with_options(OPTIONS)
def fit(
    file: Annotated[str, typer.Argument(metavar="TEST.toml|FILE", help="Manifest of a test, or one recording.")],
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Calibrate gyroscopes on a rate table: bias, scale factor, misalignment, and what a line does not hold.

    Each recording holds steps of rate in both directions; its manifest says which body axis was along the table's.
    """
    from imulab.cli.result import finish
    from imulab.procedures.run import run_task

    check_outputs([output, report], [file, *([options["layout"]] if options["layout"] else [])])
    finish(run_task("rate", [file], options, GivenFiles()), output, report, json=json)


@with_options(READ)
def turn(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Recording of whole turns, with a rest around each.")],
    options: dict[str, str | None],
    fence: Annotated[str, typer.Option(help="Uncertainty of the difference of two stops, deg.")] = FENCE,
    turns: Annotated[
        str | None, typer.Option(metavar="N,N,...", help="Number of turns of each, such as 1,5,-6; else counted.")
    ] = None,
    clock: Annotated[
        str | None, typer.Option(metavar="FRACTION", help="Uncertainty of the sample rate, such as 50ppm.")
    ] = None,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Find the scale factors of gyroscopes from whole turns by hand against a fence, no equipment needed."""
    from imulab.cli.result import finish
    from imulab.procedures.rate.turns import fit_turns

    check_outputs([output, report], [file, *([options["layout"]] if options["layout"] else [])])
    recording = read_recording(file, **reading(options))
    finish(call(fit_turns, recording, fence=fence, turns=turns, clock=clock).calibration, output, report, json=json)
