"""``imulab rate``: plan, simulate, fit and turn."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from imulab.cli.options import (
    READ,
    AsJson,
    GivenFiles,
    OutputFile,
    ReportFile,
    call,
    check_outputs,
    read_recording,
    reading,
    warn,
    with_options,
)
from imulab.errors import OptionError
from imulab.procedures.rate import FENCE, RATES
from imulab.procedures.rate.procedure import OPTIONS

if TYPE_CHECKING:
    from imulab.procedures.rate.plan import RatePlan, TurnPlan


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    group.command("plan")(plan)
    group.command("simulate")(simulate)
    group.command("fit")(fit)
    group.command("turn")(turn)
    return group


def plan(
    rates: Annotated[str, typer.Option(metavar="R,R,...", help="Sizes of the rates, deg/s.")] = RATES,
    arw: Annotated[str | None, typer.Option(metavar="N", help="Angle random walk, deg/sqrt(h).")] = None,
    bias_instability: Annotated[str | None, typer.Option(metavar="B", help="Bias instability, deg/h.")] = None,
    noise: Annotated[str | None, typer.Option(metavar="RECORD", help="Both, from a record of noise fit.")] = None,
    uncertainty: Annotated[str, typer.Option(help="Wanted of the mean of a stay, a fraction.")] = "20 ppm",
    of: Annotated[str, typer.Option(help="Fraction of what: the largest rate (full) or each (reading).")] = "full",
    faces: Annotated[str, typer.Option(help="Body axes up along the table axis, one after the other.")] = "+x,+y,+z",
    cycles: Annotated[str, typer.Option(help="Runs of each face; 5 for repeatability.")] = "3",
    order: Annotated[str, typer.Option(help="Highest power of the rate that the fit is to have.")] = "1",
    latitude: Annotated[str | None, typer.Option(help="Of the place, deg, for the manifest.")] = None,
    table_uncertainty: Annotated[
        str | None, typer.Option(metavar="FRACTION", help="That all rates have in common, such as 20ppm.")
    ] = None,
    turn: Annotated[
        str | None, typer.Option(metavar="FRACTION", help="Turns by hand in place of a table, such as 0.02%.")
    ] = None,
    fence: Annotated[str, typer.Option(help="Of those turns: of the difference of two stops, deg.")] = FENCE,
    output: Annotated[
        str | None, typer.Option("-o", "--output", metavar="TEST.toml", help="Manifest, or .csv list of stays.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Say how long to stay at each rate and what the test will give, and write the manifest that rate fit takes."""
    from imulab.display import aligned
    from imulab.procedures.rate.plan import RatePlan, plan_rate

    check_outputs([output], [noise] if noise else [])
    if output is not None and not output.lower().endswith((".toml", ".csv")):
        raise OptionError(f"{output}: expected a name that ends in .toml (the manifest) or .csv (the list of stays)")
    result = call(
        plan_rate, rates=rates, arw=arw, bias_instability=bias_instability, noise=noise, uncertainty=uncertainty,
        of=of, faces=faces, cycles=cycles, order=order, latitude=latitude, table_uncertainty=table_uncertainty,
        turn=turn, fence=fence,
    )  # fmt: skip
    if output is not None:
        if not isinstance(result, RatePlan):
            raise OptionError(f"{output}: turns by hand have no manifest; expected --turn without -o")
        result.save(output)
    head, titles, rows = result.shown()
    print(_plan_json(result) if json else "\n".join([head, *aligned(titles, rows)]))
    if output is not None and not json:
        print(f"{'plan' if output.lower().endswith('.csv') else 'manifest'}: {output}")
    for message in result.warnings if isinstance(result, RatePlan) else ():
        warn(message)


def _plan_json(result: RatePlan | TurnPlan) -> str:
    from imulab.procedures.rate.plan import RatePlan
    from imulab.records.calibration import json_text

    if not isinstance(result, RatePlan):
        reached = [{"turns": n, "relative_uncertainty": u} for n, u in enumerate(result.reached.tolist(), 1)]
        said: dict[str, Any] = {"turns": result.turns, "stops": result.stops, "wanted": result.wanted}
        return json_text({**said, "reached": reached}).rstrip()
    quantity = {"rate": "rad/s", "duration": "s", "uncertainty": "rad/s", "wanted": "rad/s"}
    return json_text(
        {
            "runs": len(result.test.runs),
            "duration": {"value": result.duration, "unit": "s"},
            "rates": [
                {name: {"value": getattr(each, name), "unit": unit} for name, unit in quantity.items()}
                for each in result.rates
            ],
            "predicted": result.predicted,
            "warnings": list(result.warnings),
        }
    ).rstrip()


def simulate(
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder for the recordings.")],
    rates: Annotated[str, typer.Option(metavar="R,R,...", help="Sizes of the rates, deg/s.")] = RATES,
    faces: Annotated[str, typer.Option(help="Body axes up along the table axis, one after the other.")] = "+x,+y,+z",
    cycles: Annotated[str, typer.Option(help="Runs of each face.")] = "1",
    hold: Annotated[str | None, typer.Option(help="Time at each rate, s; 8 s if not given.")] = None,
    noise: Annotated[str, typer.Option(help="Standard deviation of one sample, deg/s.")] = "0.03 deg/s",
    rate: Annotated[str, typer.Option(help="Samples per second, Hz.")] = "100 Hz",
    bend: Annotated[str, typer.Option(help="Largest part of k3, a fraction of the largest rate.")] = "0",
    loop: Annotated[str, typer.Option(help="Rising less falling at rate 0, a fraction of the largest rate.")] = "0",
    latitude: Annotated[str, typer.Option(help="Of the place, deg.")] = "48 deg",
    table: Annotated[str, typer.Option(help="Standard deviation of what all rates are off by, a fraction.")] = "0",
    sweep: Annotated[
        str | None, typer.Option(help="Duration of a swept sine, 0.05 to 2 Hz, in place of steps, s.")
    ] = None,
    lag: Annotated[str, typer.Option(help="Time constant of the gyroscopes, s.")] = "0 s",
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate a unit on a rate table: a file for each face and cycle, their manifest test.toml, and the truth."""
    from imulab.procedures.rate.simulate import simulate_rate

    made = call(
        simulate_rate, rates=rates, faces=faces, cycles=cycles, hold=hold, noise=noise, rate=rate, bend=bend, loop=loop,
        latitude=latitude, table=table, sweep=sweep, lag=lag, seed=seed,
    )  # fmt: skip
    made.save(output)
    print(f"{output}: test.toml, {len(made.recordings)} recordings, truth in truth.json")


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
    from pathlib import Path

    from imulab.cli.show import finish
    from imulab.procedures.rate.schema import load_test
    from imulab.procedures.registry import run_task

    runs = load_test(file).runs if file.lower().endswith(".toml") and "://" not in file else ()
    inputs = [file, options["layout"], options["accel"], options["prior"]]
    inputs += [str(Path(file).parent / run.file) for run in runs]
    check_outputs([output, report], [name for name in inputs if name])
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
    accel: Annotated[
        str | None, typer.Option(metavar="RECORD", help="Tumble record, whose accelerometers tell the turns' axes.")
    ] = None,
    prior: Annotated[
        str | None, typer.Option(metavar="RECORD", help="Earlier record of the same gyroscopes, as prior knowledge.")
    ] = None,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Find the scale factors of gyroscopes from whole turns by hand against a fence, no equipment needed."""
    from imulab.cli.show import finish
    from imulab.procedures.rate.turns import fit_turns

    check_outputs([output, report], [name for name in (file, options["layout"], accel, prior) if name])
    recording = read_recording(file, **reading(options))
    finish(
        call(fit_turns, recording, fence=fence, turns=turns, clock=clock, accel=accel, prior=prior).calibration,
        output,
        report,
        json=json,
    )
