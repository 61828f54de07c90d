"""``imulab centrifuge``: plan, simulate and reduce."""

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
    progress_bar,
    warn,
    with_options,
)
from imulab.display import aligned
from imulab.errors import OptionError
from imulab.procedures.centrifuge.procedure import OPTIONS

if TYPE_CHECKING:
    from imulab.procedures.centrifuge.plan import Plan

ManifestFile = Annotated[str, typer.Argument(metavar="MANIFEST", help="Manifest of the test, TOML.")]
Levels = Annotated[str, typer.Option(help="Specific forces in g, with commas; the lowest is the reference.")]
Radius = Annotated[str, typer.Option(help="Arm axis to the gyroscope's centre.")]
NetRate = Annotated[str, typer.Option("--net-rate", help="Rate at which the gyroscope turns against the room.")]
Cycles = Annotated[str, typer.Option(help="Number of power cycles.")]
BothSenses = Annotated[bool, typer.Option("--both-senses", help="Every level in both senses.")]


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    group.command("plan")(plan)
    group.command("simulate")(simulate)
    group.command("reduce")(reduce)
    return group


def plan(
    levels: Levels = "1,2,5,10,15,20,30,40",
    radius: Radius = "2 m",
    net_rate: NetRate = "40 deg/s",
    duration: Annotated[str, typer.Option(help="Of each run, s, or with a unit.")] = "15 min",
    cycles: Cycles = "2",
    both_senses: BothSenses = False,
    drift: Annotated[str, typer.Option("--drift", metavar="K", help="Expected drift per g.")] = "3.3 deg/h/g",
    dtg_noise: Annotated[str, typer.Option(help="Angle random walk of the gyroscope.")] = "0.01 deg/sqrt(h)",
    fog_noise: Annotated[str, typer.Option(help="Angle random walk of the FOG.")] = "0.005 deg/sqrt(h)",
    uncertainty: Annotated[str, typer.Option(help="Wanted standard uncertainty of K, relative.")] = "1 %",
    radius_uncertainty: Annotated[str, typer.Option(help="Standard uncertainty of the radius.")] = "0 m",
    rate_uncertainty: Annotated[str, typer.Option(help="Standard uncertainty of the arm rates.")] = "0 deg/s",
    output: Annotated[
        str | None,
        typer.Option("-o", "--output", metavar="PLAN.toml", help="Manifest, or .csv list of runs, to write."),
    ] = None,
    json: AsJson = False,
) -> None:
    """List the runs for wanted levels, predict uncertainties, and say which are too short, too close or too noisy."""
    from imulab.procedures.centrifuge.plan import plan_centrifuge

    check_outputs([output], [])
    if output is not None and not output.lower().endswith((".toml", ".csv")):
        raise OptionError(f"{output}: expected a name that ends in .toml (the manifest) or .csv (the list of runs)")
    result = call(
        plan_centrifuge, levels=levels, radius=radius, net_rate=net_rate, duration=duration, cycles=cycles,
        both_senses=both_senses, drift=drift, dtg_noise=dtg_noise, fog_noise=fog_noise, uncertainty=uncertainty,
        radius_uncertainty=radius_uncertainty, rate_uncertainty=rate_uncertainty,
    )  # fmt: skip
    if output is not None:
        result.save(output)
    head, titles, rows = result.shown()
    print(_plan_json(result) if json else "\n".join([head, *aligned(titles, rows)]))
    if output is not None and not json:
        print(f"{'plan' if output.lower().endswith('.csv') else 'manifest'}: {output}")
    for message in result.warnings:
        warn(message)


def simulate(
    context: typer.Context,
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder to write manifest and runs to.")],
    manifest: Annotated[
        str | None, typer.Option("--plan", metavar="PLAN.toml", help="Manifest to simulate, as plan writes it.")
    ] = None,
    levels: Levels = "1,2,5,10,15,20",
    radius: Radius = "2 m",
    net_rate: NetRate = "40 deg/s",
    cycles: Cycles = "2",
    both_senses: BothSenses = False,
    duration: Annotated[str, typer.Option(help="Of each run, s, or with a unit.")] = "5 min",
    static_duration: Annotated[str, typer.Option(help="Of each static run, s, or with a unit.")] = "1 min",
    rate: Annotated[str, typer.Option(help="Sample rate.")] = "50 Hz",
    nonlinearity: Annotated[str, typer.Option(help="K(20 g) / K(0) - 1.")] = "1 %",
    tilt: Annotated[str, typer.Option(help="Table axis against the arm's axis.")] = "10 arcsec",
    no_angle: Annotated[bool, typer.Option("--no-angle", help="No table_angle column.")] = False,
    unit: Annotated[str, typer.Option(help="Of the rates: deg/h deg/s rad/s.")] = "deg/h",
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate the test of a tuned gyroscope of 3.3 deg/h/g: a manifest, a CSV file for each run, and the truth."""
    from pathlib import Path

    from imulab.procedures.centrifuge.simulate import simulate_centrifuge

    if manifest is not None:
        for name in ("levels", "radius", "net_rate", "cycles", "both_senses"):
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                option = f"--{name.replace('_', '-')}"
                raise OptionError(f"{option}: --plan {manifest} says that already; expected one or the other")
    simulation = call(
        simulate_centrifuge, plan=manifest, levels=levels, radius=radius, net_rate=net_rate, cycles=cycles,
        both_senses=both_senses, duration=duration, static_duration=static_duration, rate=rate,
        nonlinearity=nonlinearity, tilt=tilt, no_angle=no_angle, unit=unit, seed=seed,
    )  # fmt: skip
    folder = Path(output)
    check_outputs([str(folder / "manifest.toml")] if folder.is_dir() else [], [manifest] if manifest else [])
    runs = len(simulation.manifest.runs)
    with progress_bar("runs", runs) as progress:
        simulation.save(folder, progress)
    print(f"{folder / 'manifest.toml'}: {runs} runs, truth in {folder / 'truth.json'}")


@with_options(OPTIONS)
def reduce(
    manifest: ManifestFile,
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Reduce a centrifuge test to K and its nonlinearity at every g, and to the curve K(a) that apply subtracts.

    The recordings are read once, block by block. Prints what was found; -o writes the record, --report its figures.
    """
    from pathlib import Path

    from imulab.cli.show import finish
    from imulab.procedures.centrifuge.manifest import load_manifest
    from imulab.procedures.registry import run_task

    test = load_manifest(manifest)
    files = [str(Path(manifest).parent / run.file) for run in test.runs]
    check_outputs([output, report], [manifest, *([options["layout"]] if options["layout"] else []), *files])
    with progress_bar("runs", len(test.runs)) as progress:
        record = run_task("centrifuge", [manifest], options, GivenFiles(), progress=progress)
    finish(record, output, report, json=json)


def _plan_json(result: Plan) -> str:
    from imulab.records.calibration import json_text

    def of(value: float | None, unit: str) -> dict[str, Any]:
        return {"value": None if value is None or value == float("inf") else value, "unit": unit}

    return json_text(
        {
            "runs": len(result.manifest.runs),
            "duration": of(result.duration, "s"),
            "static_duration": of(result.static_duration, "s"),
            "total": of(result.total, "s"),
            "wanted": of(result.wanted, "1"),
            "levels": [
                {
                    "specific_force": of(level.force, "m/s^2"),
                    "arm_rate": of(level.arm_rate, "rad/s"),
                    "table_rate": of(level.table_rate, "rad/s"),
                    "periods": level.periods,
                    "relative_uncertainty": level.relative,
                    "zeta_uncertainty": level.zeta,
                    "needed": of(level.needed, "s"),
                }
                for level in result.levels
            ],
            "warnings": list(result.warnings),
        }
    ).rstrip()
