"""Calibrate an accelerometer triad with gravity alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

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
    progress_bar,
    quantity,
    read_recording,
    reading,
    whole_number,
)
from imulab.columns import units_without
from imulab.options import FLAG, OUTPUT, READING

if TYPE_CHECKING:
    from imulab.records.calibration import Calibration


# ``imulab tumble check``: the result as text and as JSON.


# Calibrate an accelerometer triad with gravity alone.


def plan(
    *,
    output: Annotated[str | None, option("PLAN.csv", "Plan to write.", "-o", "--output"), OUTPUT] = None,
    report: Annotated[str | None, option("SHEET.html", "Sheet to print."), OUTPUT] = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Choose the attitudes to measure.

    Predicts the uncertainty of every parameter, too.
    """
    from imulab.cli.show import run

    run(output=output, report=report, json=json, **options)


def simulate(
    *, output: Annotated[str, option("OUT", "Recording to write.", "-o", "--output"), OUTPUT], **options: Any
) -> None:
    """Simulate a recording of a tumble test.

    Of a random MEMS triad, with its truth in the head of the file.
    """
    from imulab.writers import check_writable, write

    check_writable(output)
    recording = call(il.simulate_tumble, **options)
    write(recording, output)
    print(
        f"{output}: {len(recording)} samples, {options['attitudes']} attitudes, serial {recording.metadata['serial']}"
    )


def fit(
    file: RecordingFile, *, output: OutputFile = None, report: ReportFile = None, json: AsJson = False, **options: Any
) -> None:
    """Calibrate an accelerometer triad.

    From a recording, or from a table of attitudes (no time column).

    Prints what was found; -o writes the calibration record, --report its figures.
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import run_task

    check_record_outputs(output, report, [name for name in (file, options["layout"], options["prior"]) if name])
    trials = None if options["monte_carlo"] is None else whole_number(options["monte_carlo"], "--monte-carlo")
    with progress_bar("Monte Carlo", trials) as progress:
        record = run_task("tumble", [file], options, GivenFiles(), progress=progress)
    finish(record, output, report, json=json)


def gyro(
    file: RecordingFile,
    *,
    accel_file: Annotated[str | None, option("FILE", "Accelerometers' recording, if not the same file.")] = None,
    accel_layout: Annotated[str | None, option("L.toml", "Columns of the accelerometers' file."), READING] = None,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Calibrate the gyroscope triad by the calibrated accelerometers.

    From the accelerometers' record and the turns between attitudes; writes one record with both triads.
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import load

    how, accel, noise = reading(options), options.pop("accel"), options["noise"]
    inputs = [name for name in (file, accel, accel_file, how["layout"], accel_layout, noise) if name]
    check_record_outputs(output, report, inputs)
    record = load(accel)
    units = how["units"]
    if accel_file is None:
        recording = accel_recording = read_recording(file, **how)
    else:
        recording = read_recording(file, **{**how, "units": units_without("accel", units)})
        of_accel = {"element": how["element"], "units": units_without("gyro", units)}
        accel_recording = read_recording(accel_file, layout=accel_layout or how["layout"], **of_accel)
    both = call(il.fit_gyro, record, recording, accel_data=accel_recording, **options)
    finish(
        both.calibration,
        output,
        report,
        json=json,
        describe=lambda both: _describe_gyroscopes(both, accel),
    )


def _describe_gyroscopes(record: Calibration, accelerometers: str) -> str:
    """Return the result of the gyroscopes' fit, without the accelerometers, whose record it uses."""
    from imulab.cli.show import verdict_lines
    from imulab.display import aligned
    from imulab.procedures.tumble.figures import gyro_headline, parameters_table

    table = parameters_table(record)
    rows = [row for row in table.rows if row[0].startswith("gyro_")]
    serial = record.sensor.get("serial", "unit without serial number")
    return "\n".join(
        [
            *verdict_lines(record.verdict),
            f"gyroscopes of {serial}: {gyro_headline(record)}",
            f"accelerometers: unchanged from {accelerometers}",
            "",
            table.title,
            *aligned(table.columns, rows),
        ]
    )


def mag(
    file: RecordingFile, *, output: OutputFile = None, report: ReportFile = None, json: AsJson = False, **options: Any
) -> None:
    """Calibrate a magnetometer triad beside it.

    In the accelerometers' frame, from the same attitudes, into one record of both.
    """
    from imulab.cli.show import finish
    from imulab.errors import OptionError
    from imulab.gravity import gravity_option
    from imulab.procedures.registry import load
    from imulab.procedures.tumble.mag.fit import fit_mag
    from imulab.procedures.tumble.mag.solve import parse_place

    how, accel = reading(options), options.pop("accel")
    check_record_outputs(output, report, [name for name in (file, accel, how["layout"]) if name])
    known = None if accel is None else load(accel)
    gravity, latitude, height = (options.pop(name) for name in ("gravity", "latitude", "height"))
    if options["place"] is not None and latitude is not None:
        raise OptionError("--place together with --latitude: expected one or the other")
    local = gravity_option(gravity, latitude, height, FLAG)
    place = call(parse_place, hemisphere=options.pop("hemisphere"), latitude=latitude, dip=options.pop("dip"))
    several = {name: tuple(options.pop(name) or ()) for name in ("same_direction", "drop")}
    result = call(
        fit_mag, read_recording(file, **how), accel=known, gravity=local, hemisphere=place.hemisphere, dip=place.dip,
        **several, **options,
    )  # fmt: skip
    finish(result.calibration, output, report, json=json)


def check(
    record: RecordFile, file: RecordingFile, *, report: ReportFile = None, json: AsJson = False, **options: Any
) -> int:
    """Hold fresh attitudes against a record.

    Tests whether they still agree with it, without refitting; exit status 0: pass, 1: fail. A record that still
    holds fails once in twenty tests.
    """
    from imulab.cli.show import finish_check, notes_on_data
    from imulab.errors import RecordError
    from imulab.gravity import gravity_option, of_place
    from imulab.procedures.registry import load
    from imulab.procedures.tumble.attitudes import find_attitudes
    from imulab.procedures.tumble.check import check_tumble

    check_outputs([], [name for name in (record, file, options["layout"]) if name], report=report)
    held = load(record)
    latitude, height = of_place(options["place"], options["gravity"], options["latitude"], options["height"], FLAG)
    local = gravity_option(options["gravity"], latitude, height, FLAG, beside=options["place"] is not None)
    limit = options["limit"]
    largest = None if limit is None else quantity(limit, "--limit", "acceleration", "mg")
    attitudes = find_attitudes(read_recording(file, **reading(options)))
    try:
        result = check_tumble(held, attitudes, limit=largest, gravity=local)
    except RecordError as error:
        raise RecordError(f"{record}: {error}") from None
    return finish_check(result, held, record, [file], notes_on_data(held, [attitudes.recording]), report, json=json)


COMMANDS = (
    Command("tumble plan", plan, lambda: [il.plan_tumble]),
    Command("tumble simulate", simulate, lambda: [il.simulate_tumble]),
    Command("tumble fit", fit, lambda: [il.fit_tumble]),
    Command("tumble gyro", gyro, lambda: [il.fit_gyro]),
    Command("tumble mag", mag, lambda: [il.fit_mag]),
    Command("tumble check", check, lambda: [il.check_tumble]),
)
