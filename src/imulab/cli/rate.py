"""Calibrate gyroscopes by a rate table or by turns."""

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
    read_recording,
    reading,
)
from imulab.errors import OptionError
from imulab.options import OUTPUT

if TYPE_CHECKING:
    pass


def plan(
    *,
    output: Annotated[
        str | None, option("TEST.toml", "Manifest, or .csv list of stays.", "-o", "--output"), OUTPUT
    ] = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Say how long to stay at each rate.

    And what the test will give; writes the manifest that rate fit takes.
    """
    from imulab.cli.show import finish_plan

    check_outputs([output], [options["noise"]] if options["noise"] else [])
    if output is not None and not output.lower().endswith((".toml", ".csv")):
        raise OptionError(f"{output}: expected a name that ends in .toml (the manifest) or .csv (the list of stays)")
    result = call(il.plan_rate, **options)
    finish_plan(result, output, json=json)


def simulate(
    *, output: Annotated[str, option("DIR", "Folder for the recordings.", "-o", "--output"), OUTPUT], **options: Any
) -> None:
    """Simulate a unit on a rate table.

    A file for each face and cycle, their manifest test.toml, and the truth.
    """
    made = call(il.simulate_rate, **options)
    made.save(output)
    print(f"{output}: test.toml, {len(made.recordings)} recordings, truth in truth.json")


def fit(
    file: Annotated[str, Argument("TEST.toml|FILE", "Manifest of a test, or one recording.")],
    *,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Calibrate gyroscopes from steps of rate.

    On a rate table: bias, scale factor, misalignment, and what a line does not hold. Each recording holds steps of
    rate in both directions; its manifest says which body axis was along the table's.
    """
    from pathlib import Path

    from imulab.cli.show import finish
    from imulab.procedures.rate.schema import load_test
    from imulab.procedures.registry import run_task

    runs = load_test(file).runs if file.lower().endswith(".toml") and "://" not in file else ()
    inputs = [file, options["layout"], options["accel"], options["prior"]]
    inputs += [str(Path(file).parent / run.file) for run in runs]
    check_record_outputs(output, report, [name for name in inputs if name])
    finish(run_task("rate", [file], options, GivenFiles()), output, report, json=json)


def turn(
    file: Annotated[str, Argument("FILE", "Recording of whole turns, with a rest around each.")],
    *,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Find scale factors from whole turns by hand.

    Against a fence; no equipment needed.
    """
    from imulab.cli.show import finish

    how = reading(options)
    inputs = [name for name in (file, how["layout"], options["accel"], options["prior"]) if name]
    check_record_outputs(output, report, inputs)
    result = call(il.fit_turns, read_recording(file, **how), **options)
    finish(result.calibration, output, report, json=json)


COMMANDS = (
    Command("rate plan", plan, lambda: [il.plan_rate]),
    Command("rate simulate", simulate, lambda: [il.simulate_rate]),
    Command("rate fit", fit, lambda: [il.fit_rate]),
    Command("rate turn", turn, lambda: [il.fit_turns]),
)
