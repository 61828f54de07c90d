"""Measure how a gyroscope's g-sensitive drift changes with g."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import (
    AsJson,
    GivenFiles,
    OutputFile,
    ReportFile,
    call,
    check_outputs,
    check_record_outputs,
    progress_bar,
)
from imulab.errors import OptionError
from imulab.options import OUTPUT

if TYPE_CHECKING:
    pass


def plan(
    *,
    output: Annotated[
        str | None, option("PLAN.toml", "Manifest, or .csv list of runs, to write.", "-o", "--output"), OUTPUT
    ] = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """List the runs of a test, with what they will give.

    For wanted levels; predicts uncertainties, and says which runs are too short, too close or too noisy.
    """
    from imulab.cli.show import finish_plan

    check_outputs([output], [])
    if output is not None and not output.lower().endswith((".toml", ".csv")):
        raise OptionError(f"{output}: expected a name that ends in .toml (the manifest) or .csv (the list of runs)")
    result = call(il.plan_centrifuge, **options)
    finish_plan(result, output, json=json)


def simulate(
    typed: set[str],
    *,
    output: Annotated[str, option("DIR", "Folder to write manifest and runs to.", "-o", "--output"), OUTPUT],
    **options: Any,
) -> None:
    """Simulate the runs of a test.

    Of a tuned gyroscope of 3.3 deg/h/g: a manifest, a CSV file for each run, and the truth.
    """
    from pathlib import Path

    manifest = options["plan"]
    if manifest is not None:
        for name in ("levels", "radius", "net_rate", "cycles", "both_senses"):
            if name in typed:
                option = f"--{name.replace('_', '-')}"
                raise OptionError(f"{option}: --plan {manifest} says that already; expected one or the other")
    simulation = call(il.simulate_centrifuge, **options)
    folder = Path(output)
    check_outputs([str(folder / "manifest.toml")] if folder.is_dir() else [], [manifest] if manifest else [])
    runs = len(simulation.manifest.runs)
    with progress_bar("runs", runs) as progress:
        simulation.save(folder, progress)
    print(f"{folder / 'manifest.toml'}: {runs} runs, truth in {folder / 'truth.json'}")


def reduce(
    manifest: Annotated[str, Argument("MANIFEST", "Manifest of the test, TOML.")],
    *,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Reduce a test to K at every g and to its curve.

    K and its nonlinearity at every g, and the curve K(a) that apply subtracts. The recordings are read once, block
    by block. Prints what was found; -o writes the record, --report its figures.
    """
    from pathlib import Path

    from imulab.cli.show import finish
    from imulab.procedures.centrifuge.manifest import load_manifest
    from imulab.procedures.registry import run_task

    test = load_manifest(manifest)
    files = [str(Path(manifest).parent / run.file) for run in test.runs]
    check_record_outputs(output, report, [manifest, *([options["layout"]] if options["layout"] else []), *files])
    with progress_bar("runs", len(test.runs)) as progress:
        record = run_task("centrifuge", [manifest], options, GivenFiles(), progress=progress)
    finish(record, output, report, json=json)


COMMANDS = (
    Command("centrifuge plan", plan, lambda: [il.plan_centrifuge]),
    Command("centrifuge simulate", simulate, lambda: [il.simulate_centrifuge]),
    Command("centrifuge reduce", reduce, lambda: [il.fit_centrifuge]),
)
