"""``imulab centrifuge``: plan, simulate and reduce."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imulab.cli.fit_options import with_options
from imulab.cli.options import (
    AsJson,
    GivenFiles,
    OutputFile,
    ReportFile,
    check_outputs,
    progress_bar,
    quantity,
    warn,
    whole_number,
)
from imulab.errors import OptionError
from imulab.procedures.centrifuge.task import OPTIONS

if TYPE_CHECKING:
    from imulab.procedures.centrifuge.manifest import Manifest
    from imulab.procedures.centrifuge.plan import Plan
    from imulab.procedures.centrifuge.simulate import Truth

ManifestFile = Annotated[str, typer.Argument(metavar="MANIFEST", help="Manifest of the test, TOML.")]
Levels = Annotated[str, typer.Option(help="Specific forces in g, with commas; the lowest is the reference.")]
Radius = Annotated[str, typer.Option(help="Arm axis to the gyroscope's centre.")]
NetRate = Annotated[str, typer.Option("--net-rate", help="Rate at which the gyroscope turns against the room.")]
Cycles = Annotated[str, typer.Option(help="Number of power cycles.")]
BothSenses = Annotated[bool, typer.Option("--both-senses", help="Every level in both senses.")]

_WALK = {"deg/sqrt(h)": 0.01745329251994329577 / 60, "deg/√h": 0.01745329251994329577 / 60, "rad/sqrt(s)": 1.0}
_DRIFT = {"deg/h/g": 0.01745329251994329577 / 3600 / 9.80665, "rad/s/(m/s^2)": 1.0}


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
    result = plan_centrifuge(
        levels=_levels(levels),
        radius=quantity(radius, "--radius", "length", "m"),
        net_rate=quantity(net_rate, "--net-rate", "rate", "deg/s"),
        duration=quantity(duration, "--duration", "time", "s"),
        cycles=whole_number(cycles, "--cycles"),
        both_senses=both_senses,
        K=_special(drift, "--drift", _DRIFT),
        dtg_noise=_special(dtg_noise, "--dtg-noise", _WALK),
        fog_noise=_special(fog_noise, "--fog-noise", _WALK),
        uncertainty=_fraction(uncertainty, "--uncertainty"),
        radius_uncertainty=quantity(radius_uncertainty, "--radius-uncertainty", "length", "m"),
        rate_uncertainty=quantity(rate_uncertainty, "--rate-uncertainty", "rate", "deg/s"),
    )
    if output is not None:
        _write_plan(result, output)
    wanted = _fraction(uncertainty, "--uncertainty")
    print(_plan_json(result, wanted) if json else _plan_text(result, wanted))
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
    from dataclasses import replace

    from imulab.procedures.centrifuge.manifest import load_manifest
    from imulab.procedures.centrifuge.simulate import simulate_centrifuge, typical_truth

    if manifest is not None:
        for name in ("levels", "radius", "net_rate", "cycles", "both_senses"):
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                option = f"--{name.replace('_', '-')}"
                raise OptionError(f"{option}: --plan {manifest} says that already; expected one or the other")
        test = load_manifest(manifest)
    else:
        test = _typical_test(levels, radius, net_rate, cycles, f"SIM-{seed}", both_senses=both_senses)
    truth = typical_truth(_fraction(nonlinearity, "--nonlinearity"))
    truth = replace(truth, rig=replace(truth.rig, tilt=quantity(tilt, "--tilt", "angle", "arcsec")))
    simulation = simulate_centrifuge(
        test,
        truth,
        sample_rate=quantity(rate, "--rate", "frequency", "Hz"),
        duration=quantity(duration, "--duration", "time", "s"),
        static_duration=quantity(static_duration, "--static-duration", "time", "s"),
        encoder=not no_angle,
        unit=unit,
        seed=whole_number(seed, "--seed"),
    )
    _check_folder(output, test, manifest)
    _write_simulation(simulation, test, truth, output)


def _typical_test(levels: str, radius: str, net_rate: str, cycles: str, serial: str, *, both_senses: bool) -> Manifest:
    """Return the manifest of a test that options state; errors as those of a plan."""
    from imulab.procedures.centrifuge.manifest import make_manifest
    from imulab.procedures.centrifuge.plan import plan_centrifuge

    force, arm = _levels(levels), quantity(radius, "--radius", "length", "m")
    net, number = quantity(net_rate, "--net-rate", "rate", "deg/s"), whole_number(cycles, "--cycles")
    plan_centrifuge(
        levels=force, radius=arm, net_rate=net, cycles=number, K=1.0, dtg_noise=0.0, fog_noise=0.0, uncertainty=1.0
    )
    return make_manifest(
        levels=force, radius=arm, net_rate=net, cycles=number, both_senses=both_senses,
        radius_uncertainty=1e-5 * arm, rate_uncertainty=quantity("0.0005", "", "rate", "deg/s"),
        sensor={"serial": serial, "model": "simulated tuned gyroscope"},
    )  # fmt: skip


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

    from imulab.cli.result import finish
    from imulab.procedures.centrifuge.manifest import load_manifest
    from imulab.procedures.run import run_task

    test = load_manifest(manifest)
    files = [str(Path(manifest).parent / run.file) for run in test.runs]
    check_outputs([output, report], [manifest, *([options["layout"]] if options["layout"] else []), *files])
    with progress_bar("runs", len(test.runs)) as progress:
        record = run_task("centrifuge", [manifest], options, GivenFiles(), progress=progress)
    finish(record, output, report, json=json)


def _levels(text: str) -> list[float]:
    from imulab.units import to_si

    try:
        values = [float(part) for part in text.removesuffix("g").split(",")]
    except ValueError:
        raise OptionError(f"--levels {text!r}: expected specific forces in g, with commas, such as 1,2,5,10") from None
    if not all(0 < value < 1e4 for value in values):
        raise OptionError(f"--levels {text!r}: expected specific forces above 0 g")
    return [to_si(value, "g") for value in values]


def _special(text: str, option: str, units: dict[str, float]) -> float:
    """Return a number with one of a few units; the first where there is none."""
    match = re.fullmatch(r"\s*(\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+)\s*(\S.*)?", text)
    unit = (match[2] or next(iter(units))).strip() if match else ""
    if match is None or unit not in units:
        raise OptionError(f"{option} {text!r}: expected a number with one of {', '.join(units)}")
    return float(match[1]) * units[unit]


def _fraction(text: str, option: str) -> float:
    match = re.fullmatch(r"\s*(-?\d+\.?\d*(?:[eE][-+]?\d+)?)\s*(%|ppm)?\s*", text)
    if match is None:
        raise OptionError(f"{option} {text!r}: expected a fraction such as 0.01 or 1 %")
    return float(match[1]) * {None: 1.0, "%": 1e-2, "ppm": 1e-6}[match[2]]


def _plan_text(result: Plan, wanted: float) -> str:
    from imulab.shown import aligned
    from imulab.units import from_si

    rows = [
        [
            f"{from_si(level.force, 'g'):.4g}",
            f"{from_si(level.arm_rate, 'deg/s'):.4f}",
            f"{from_si(level.table_rate, 'deg/s'):.4f}",
            f"{level.periods:.0f}",
            f"{100 * level.relative:.3g}",
            "–" if level.zeta is None else f"{100 * level.zeta:.3g}",
            "–" if level.needed == float("inf") else f"{level.needed / 60:.1f}",
        ]
        for level in result.levels
    ]
    too_few = sum(level.relative > wanted for level in result.levels)
    titles = ["level, g", "arm, deg/s", "table, deg/s", "periods", "u(K), %", "u(zeta), %", "needed, min"]
    head = (
        f"{len(result.manifest.runs)} runs, {result.total / 3600:.1f} h of recording ({result.duration / 60:.0f} min "
        f"each, static {result.static_duration / 60:.0f} min); "
        + (f"{too_few} of {len(result.levels)} levels do not reach" if too_few else "every level reaches")
        + f" u(K) = {100 * wanted:.3g} % (needed: how long a run must be for that)"
    )
    return "\n".join([head, *aligned(titles, rows)])


def _plan_json(result: Plan, wanted: float) -> str:
    from imulab.records.json_text import json_text

    def of(value: float | None, unit: str) -> dict[str, Any]:
        return {"value": None if value is None or value == float("inf") else value, "unit": unit}

    return json_text(
        {
            "runs": len(result.manifest.runs),
            "duration": of(result.duration, "s"),
            "static_duration": of(result.static_duration, "s"),
            "total": of(result.total, "s"),
            "wanted": of(wanted, "1"),
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


def _write_plan(result: Plan, output: str) -> None:
    from imulab.atomic_write import write_text
    from imulab.procedures.centrifuge.manifest import manifest_text
    from imulab.units import from_si

    test = result.manifest
    if output.lower().endswith(".toml"):
        comments = [
            f"{len(test.runs)} runs; warm up 10 min after each power-on, then the static record of "
            f"{result.static_duration / 60:.0f} min,",
            f"then the loaded runs of {result.duration / 60:.0f} min. Columns: time, dtg_x, dtg_y, fog, table_angle.",
        ]
        write_text(output, manifest_text(test, comments))
        return
    lines = ["number,file,power_cycle,role,sense,arm_rate [deg/s],table_rate [deg/s],specific_force [g]"]
    for number, run in enumerate(test.runs, start=1):
        lines.append(
            f"{number},{run.file},{run.power_cycle},{run.role},{run.sense},{from_si(run.arm_rate, 'deg/s'):.4f},"
            f"{from_si(run.table_rate, 'deg/s'):.4f},{from_si(test.force(run), 'g'):.6g}"
        )
    write_text(output, "\n".join(lines) + "\n")


def _check_folder(output: str, test: Manifest, manifest: str | None) -> None:
    """Check that nothing but an older simulation is overwritten: the recordings of a test have the same names."""
    from pathlib import Path

    for run in test.runs:
        if Path(run.file).name != run.file:
            raise OptionError(f"{run.file}: expected file names without folders in a manifest to simulate")
    folder = Path(output)
    check_outputs([str(folder / "manifest.toml")] if folder.is_dir() else [], [manifest] if manifest else [])
    taken = [name for name in ("manifest.toml", *(run.file for run in test.runs)) if (folder / name).exists()]
    if taken and not (folder / "truth.json").is_file():
        raise OptionError(
            f"{folder / taken[0]}: exists and is no simulation (no truth.json beside it); expected another folder"
        )


def _write_simulation(simulation: Any, test: Manifest, truth: Truth, output: str) -> None:
    import json as text
    from dataclasses import asdict
    from pathlib import Path

    from imulab.atomic_write import write_text
    from imulab.procedures.centrifuge.manifest import manifest_text
    from imulab.writers import write_csv

    folder = Path(output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{folder}: the folder cannot be made: {error.strerror}") from None
    with progress_bar("runs", len(test.runs)) as progress:
        for done, run in enumerate(test.runs, start=1):
            write_csv(simulation(run), folder / run.file)
            progress(done)
    write_text(folder / "truth.json", text.dumps(asdict(truth), indent=1) + "\n")
    write_text(folder / "manifest.toml", manifest_text(test, ["simulated; the truth is in truth.json, SI units"]))
    print(f"{folder / 'manifest.toml'}: {len(test.runs)} runs, truth in {folder / 'truth.json'}")
