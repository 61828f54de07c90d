"""Calibrate a magnetometer triad alone."""

from __future__ import annotations

from typing import Annotated, Any

import imulab as il
from imulab.cli.command import Command, option
from imulab.cli.options import (
    AsJson,
    GivenFiles,
    OutputFile,
    RecordFile,
    RecordingFile,
    ReportFile,
    call,
    check_outputs,
    check_record_outputs,
    read_recording,
    reading,
)
from imulab.options import OUTPUT


def plan(*, json: AsJson = False, **options: Any) -> None:
    """Say how many readings to take, and how far to tilt.

    And what that will give.
    """
    from imulab.cli.show import finish_plan

    finish_plan(call(il.plan_magnetometer, **options), None, json=json)


def simulate(
    *, output: Annotated[str, option("OUT", "Recording to write.", "-o", "--output"), OUTPUT], **options: Any
) -> None:
    """Simulate a magnetometer that is waved or turned level.

    With its truth in the head of the file.
    """
    from imulab.writers import check_writable, write

    check_writable(output)
    recording = call(il.simulate_magnetometer, **options)
    write(recording, output)
    print(f"{output}: {len(recording)} readings, serial {recording.metadata['serial']}")


def fit(
    file: RecordingFile, *, output: OutputFile = None, report: ReportFile = None, json: AsJson = False, **options: Any
) -> None:
    """Calibrate a magnetometer triad alone.

    From readings waved through all directions, or of a level turn. Hard and soft iron in the body's gauge: how the
    magnetometers are turned against the body is not told.
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import run_task

    check_record_outputs(output, report, [name for name in (file, options["layout"]) if name])
    finish(run_task("magnetometer", [file], options, GivenFiles()), output, report, json=json)


def check(
    record: RecordFile, file: RecordingFile, *, report: ReportFile = None, json: AsJson = False, **options: Any
) -> int:
    """Hold new readings against a record.

    Tests whether they still agree with it, without refitting; exit status 0: pass, 1: fail. A record that still holds
    fails once in twenty tests.
    """
    from imulab.cli.show import finish_check, notes_on_data
    from imulab.errors import RecordError
    from imulab.procedures.registry import load

    check_outputs([], [name for name in (record, file, options["layout"]) if name], report=report)
    held = load(record)
    recording = read_recording(file, **reading(options))
    try:
        result = call(il.check_magnetometer, held, recording)
    except RecordError as error:
        raise RecordError(f"{record}: {error}") from None
    return finish_check(result, held, record, [file], notes_on_data(held, [recording]), report, json=json)


COMMANDS = (
    Command("magnetometer plan", plan, lambda: [il.plan_magnetometer]),
    Command("magnetometer simulate", simulate, lambda: [il.simulate_magnetometer]),
    Command("magnetometer fit", fit, lambda: [il.fit_magnetometer]),
    Command("magnetometer check", check, lambda: [il.check_magnetometer]),
)
