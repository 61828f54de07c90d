"""``imulab tumble``: simulate, fit and check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from imulab.cli.options import (
    READ,
    AsJson,
    GivenFiles,
    OutputFile,
    RecordFile,
    RecordingFile,
    ReportFile,
    call,
    check_outputs,
    coloured,
    one_of,
    progress_bar,
    quantity,
    read_recording,
    reading,
    warn,
    whole_number,
    with_options,
)
from imulab.cli.show import finish
from imulab.procedures.procedure import FLAG
from imulab.procedures.tumble import CLOCKS, CRITERIA, HEMISPHERES, LOSSES, MAG_ORDERS, METHODS, SENSITIVITIES, STARTS
from imulab.procedures.tumble.check import meaning, measured, next_step, of_magnetometers
from imulab.procedures.tumble.procedure import GRAVITY, OPTIONS
from imulab.procedures.tumble.record import small_g
from imulab.records.calibration import json_text

if TYPE_CHECKING:
    from imulab.procedures.tumble.attitudes import Attitudes
    from imulab.procedures.tumble.check import Check
    from imulab.procedures.tumble.mag.check import MagCheck
    from imulab.records.calibration import Calibration


# ``imulab tumble check``: what a test of a record by fresh attitudes found, for people and for scripts.


def as_text(check: Check, attitudes: Attitudes, held: Calibration, record: str, file: str) -> str:
    """Return the verdict with its p, what to do next, and the residual of every attitude."""
    lines = [
        f"{coloured('pass' if check.passed else 'fail')}: {meaning(check)}",
        *next_step(check, record, file),
        measured(check, attitudes),
        *of_magnetometers(check, attitudes, held.model.get("field", {}).get("unit", "1")),
    ]
    for index, value in enumerate(check.residuals.tolist()):
        beyond = "  beyond the limit" if check.limit is not None and abs(value) > check.limit else ""
        expected = ""
        if check.standard_uncertainty is not None:
            expected = f" ± {small_g(check.standard_uncertainty[index])}"
        field = ""
        if check.mag is not None:
            field = f", |m| {100 * check.mag.magnitude[index]:+.2f} %, dip {np.degrees(check.mag.dip[index]):+.2f} deg"
        lines.append(f"{attitudes.label(index)}: {small_g(value)}{expected}{field}{beyond}")
    return "\n".join(lines)


def as_json(check: Check, attitudes: Attitudes, notes: Sequence[str]) -> str:
    """Return the same as JSON, in SI."""
    uncertainty = [None] * len(attitudes) if check.standard_uncertainty is None else check.standard_uncertainty.tolist()
    return json_text(
        {
            "verdict": "pass" if check.passed else "fail",
            "p": check.probability,
            "chi_square": check.chi_square,
            "degrees_of_freedom": len(attitudes),
            "limit": None if check.limit is None else {"value": check.limit, "unit": "m/s^2"},
            "gravity": check.gravity.entry(),
            "attitudes": [
                {"label": attitudes.label(i), "residual": value, "standard_uncertainty": u}
                for i, (value, u) in enumerate(zip(np.asarray(check.residuals).tolist(), uncertainty, strict=True))
            ],
            **({} if check.mag is None else {"mag": _of_mag(check.mag)}),
            "notes": [str(note) for note in notes],
        }
    ).rstrip()


def _of_mag(mag: MagCheck) -> dict[str, Any]:
    return {
        "p": mag.probability,
        "common": {
            name: {"value": value, "standard_uncertainty": u, "unit": unit}
            for name, value, u, unit in zip(
                ("magnitude", "dip"), mag.common.tolist(), mag.common_uncertainty.tolist(), ("1", "rad"), strict=True
            )
        },
        "magnitude": mag.magnitude.tolist(),
        "dip": {"value": mag.dip.tolist(), "unit": "rad"},
        "hard_iron_change": {"value": mag.hard_iron.tolist(), "p": mag.explained},
    }


# ``imulab tumble``: simulate and fit.


_OF_THE_RECORD = replace(GRAVITY[0], help="Local gravity, m/s^2; else of the file's head, else of the record.")
_OF_THE_TRIAD = replace(GRAVITY[0], help="Local gravity, m/s^2; else of the accelerometers' record, else of the head.")


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    group.command("plan")(plan)
    group.command("simulate")(simulate)
    group.command("fit")(fit)
    group.command("gyro")(gyro)
    group.command("mag")(mag)
    group.command("check")(check)
    return group


def plan(
    attitudes: Annotated[str, typer.Option(help="Number of attitudes to choose.")],
    noise: Annotated[
        str | None,
        typer.Option(metavar="20ug|FILE", help="Noise of |f| in one attitude, or a recording or record that has it."),
    ] = None,
    order: Annotated[str, typer.Option(help="Order of the model, 0 to 5; 3 shows what 2 would leave out.")] = "3",
    output: Annotated[str | None, typer.Option("-o", "--output", metavar="PLAN.csv", help="Plan to write.")] = None,
    criterion: Annotated[str, one_of(CRITERIA, "A: least sum of variances; D: smallest confidence region.")] = "A",
    source: Annotated[
        str,
        one_of(
            STARTS,
            "Where attitudes may lie: sphere, fixture:15 or head:15 (steps in deg), or a file that lists them.",
            "--from",
            metavar="sphere|FILE",
        ),
    ] = "sphere",
    add: Annotated[
        str | None, typer.Option(metavar="FILE", help="Attitudes already there: a plan, a record or a recording.")
    ] = None,
    report: Annotated[str | None, typer.Option("--report", metavar="SHEET.html", help="Sheet to print.")] = None,
    method: Annotated[str, one_of(METHODS, "Method of the fit that the attitudes are for.")] = "norm",
    distinct_verticals: Annotated[
        bool | None,
        typer.Option(
            "--distinct-verticals/--repeated-verticals",
            help="Whether x, y and z are each vertical in one attitude at most, as the source of method linearised "
            "demands; the default follows --method.",
        ),
    ] = None,
    with_: Annotated[
        str | None,
        one_of(
            ("mag",), "Give each attitude a heading too, for the magnetometers beside the accelerometers.", "--with"
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Choose the attitudes to measure, and predict the uncertainty of every parameter."""
    from imulab.cli.show import run

    run(
        output=output, report=report, json=json, attitudes=attitudes, noise=noise, order=order, criterion=criterion,
        from_=source, add=add, method=method, distinct_verticals=distinct_verticals, with_=with_,
    )  # fmt: skip


def simulate(
    output: Annotated[str, typer.Option("-o", "--output", metavar="OUT", help="Recording to write.")],
    attitudes: Annotated[str, typer.Option(help="Number of static attitudes.")] = "24",
    order: Annotated[str, typer.Option(help="Order of the true nonlinearity, 1 to 5.")] = "2",
    rate: Annotated[str, typer.Option(help="Sample rate.")] = "100 Hz",
    hold: Annotated[str, typer.Option(help="Duration of an attitude.")] = "5 s",
    move: Annotated[str, typer.Option(help="Duration of the motion between two.")] = "2 s",
    noise: Annotated[str, typer.Option(help="Standard deviation of one sample.")] = "0.7 mg",
    unit: Annotated[str, typer.Option(help="Unit of the outputs: m/s^2 g mg count V.")] = "m/s^2",
    gravity: Annotated[str, typer.Option(help="Local gravity.")] = "9.80665 m/s^2",
    knock: Annotated[str | None, typer.Option(help="Number of an attitude that is knocked.")] = None,
    field: Annotated[
        str | None, typer.Option(metavar="48uT", help="Magnitude of the magnetic field, uT, for columns mag_*.")
    ] = None,
    dip: Annotated[str, typer.Option(help="Its dip, positive where it points down.")] = "67 deg",
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate a tumble recording of a random MEMS triad, with its truth in the head of the file."""
    from imulab.procedures.tumble.simulate import simulate_tumble
    from imulab.writers import check_writable, write

    check_writable(output)
    recording = call(
        simulate_tumble, attitudes=attitudes, order=order, rate=rate, hold=hold, move=move, noise=noise, unit=unit,
        gravity=gravity, knock=knock, field=field, dip=dip, seed=seed,
    )  # fmt: skip
    write(recording, output)
    print(f"{output}: {len(recording)} samples, {attitudes} attitudes, serial {recording.metadata['serial']}")


@with_options(OPTIONS)
def fit(
    file: RecordingFile,
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Calibrate an accelerometer triad from a recording, or from a table of attitudes (no time column).

    Prints what was found; -o writes the calibration record, --report its figures.
    """
    from imulab.procedures.registry import run_task

    check_outputs([output, report], [name for name in (file, options["layout"], options["prior"]) if name])
    trials = None if options["monte_carlo"] is None else whole_number(options["monte_carlo"], "--monte-carlo")
    with progress_bar("Monte Carlo", trials) as progress:
        record = run_task("tumble", [file], options, GivenFiles(), progress=progress)
    finish(record, output, report, json=json)


@with_options(READ)
def gyro(
    file: RecordingFile,
    *,
    accel: Annotated[str, typer.Option("--accel", metavar="RECORD", help="Tumble record of the accelerometers.")],
    accel_file: Annotated[
        str | None,
        typer.Option("--accel-file", metavar="FILE", help="Accelerometers' recording, if not the same file."),
    ] = None,
    accel_layout: Annotated[
        str | None, typer.Option("--accel-layout", metavar="L.toml", help="Columns of the accelerometers' file.")
    ] = None,
    options: dict[str, str | None],
    fit_bias: Annotated[bool, typer.Option("--fit-bias", help="Fit the biases to the turns too.")] = False,
    g_sensitivity: Annotated[str, one_of(SENSITIVITIES, "Whether to fit what forces add to the rate.")] = "auto",
    clock: Annotated[
        str, typer.Option(help="Standard uncertainty of the clock's rate, common to the three scale factors.")
    ] = "50 ppm",
    clock_of: Annotated[
        str, one_of(CLOCKS, "Whose time stamps are right where two clocks differ.", "--clock-of")
    ] = "gyro",
    noise: Annotated[
        str | None, typer.Option(metavar="RECORD", help="Noise record of the same gyroscopes, for u of their biases.")
    ] = None,
    latitude: Annotated[
        str | None, typer.Option(metavar="DEG", help="Latitude, deg, for the vertical part of the Earth's rate.")
    ] = None,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Calibrate a gyroscope triad on top of the accelerometers' record; writes one record with both triads."""
    from imulab.procedures.registry import load
    from imulab.procedures.tumble.gyro.fit import fit_gyro

    inputs = [name for name in (file, accel, accel_file, options["layout"], accel_layout, noise) if name]
    check_outputs([output, report], inputs)
    record = load(accel)
    how = reading(options)
    recording = read_recording(file, **how)
    own = recording
    if accel_file is not None:
        own = read_recording(accel_file, layout=accel_layout or how["layout"], element=how["element"])
    both = call(
        fit_gyro, record, recording, accel_data=own, fit_bias=fit_bias, g_sensitivity=g_sensitivity, clock=clock,
        clock_of=clock_of, noise=noise, latitude=latitude,
    )  # fmt: skip
    finish(
        both.calibration,
        output,
        report,
        json=json,
        describe=lambda both: _of_gyroscopes(both, accel),
    )


def _of_gyroscopes(record: Calibration, accelerometers: str) -> str:
    """Return what a fit of the gyroscopes found, without the accelerometers, whose record it rests on."""
    from imulab.cli.show import verdict_line
    from imulab.display import aligned
    from imulab.procedures.tumble.figures import gyro_headline
    from imulab.procedures.views import exhibits_of
    from imulab.report.traces import ReportTable

    table = next(item for item in exhibits_of(record).items if isinstance(item, ReportTable))
    rows = [row for row in table.rows if row[0].startswith("gyro_")]
    serial = record.sensor.get("serial", "unit without serial number")
    return "\n".join(
        [
            verdict_line(record.verdict),
            f"gyroscopes of {serial}: {gyro_headline(record)}",
            f"accelerometers: unchanged from {accelerometers}",
            "",
            table.title,
            *aligned(table.columns, rows),
        ]
    )


@with_options((_OF_THE_TRIAD, *GRAVITY[1:], *READ))
def mag(
    file: RecordingFile,
    *,
    accel: Annotated[
        str | None,
        typer.Option(
            "--accel", metavar="RECORD", help="Tumble record of the accelerometers; of another test: a prior."
        ),
    ] = None,
    same_direction: Annotated[
        list[str] | None,
        typer.Option(
            "--same-direction", metavar="A-B", help="Attitudes in which one axis points the same way; repeatable."
        ),
    ] = None,
    field: Annotated[
        str | None, typer.Option(metavar="48.2uT", help="Magnitude of the local field, uT; without it the field is 1.")
    ] = None,
    loss: Annotated[
        str, one_of(LOSSES, "auto: set disturbed attitudes aside and name them; square: keep all; huber: limit them.")
    ] = "auto",
    mag_order: Annotated[str, one_of(MAG_ORDERS, "2: quadratic terms too; auto: where they predict.")] = "1",
    drop: Annotated[list[str] | None, typer.Option(metavar="N", help="Attitude to leave out; repeatable.")] = None,
    hemisphere: Annotated[str | None, one_of(HEMISPHERES, "To check the sign of the dip.")] = None,
    dip: Annotated[
        str | None,
        typer.Option(metavar="67.2+-0.2", help="Dip of the place, deg, to compare with the one found."),
    ] = None,
    order: Annotated[str, typer.Option(help="Order of the accelerometers' model, auto or 1 to 5.")] = "auto",
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Calibrate a magnetometer triad in the accelerometers' frame from the same attitudes, into one record of both."""
    from imulab.gravity import gravity_option
    from imulab.procedures.registry import load
    from imulab.procedures.tumble.mag.fit import fit_mag
    from imulab.procedures.tumble.mag.solve import stated_place

    check_outputs([output, report], [name for name in (file, accel, options["layout"]) if name])
    known = None if accel is None else load(accel)
    local = gravity_option(options["gravity"], options["latitude"], options["height"], FLAG)
    place = call(stated_place, hemisphere=hemisphere, latitude=options["latitude"], dip=dip)
    found = call(
        fit_mag, read_recording(file, **reading(options)), accel=known, same_direction=tuple(same_direction or ()),
        field=field, loss=loss, mag_order=mag_order, drop=tuple(drop or ()),
        hemisphere=place.hemisphere, dip=place.dip, gravity=local, order=order,
    )  # fmt: skip
    finish(found.calibration, output, report, json=json)


@with_options((_OF_THE_RECORD, *GRAVITY[1:], *READ))
def check(
    record: RecordFile,
    file: RecordingFile,
    *,
    options: dict[str, str | None],
    limit: Annotated[str | None, typer.Option(help="Largest | |f| - g | that passes, mg, beside the test.")] = None,
    report: ReportFile = None,
    json: AsJson = False,
) -> int:
    """Test whether fresh attitudes still agree with a record, without refitting; exit status 0: pass, 1: fail.

    A record that still holds fails once in twenty tests.
    """
    from imulab.errors import RecordError
    from imulab.gravity import gravity_option
    from imulab.procedures.apply import warnings_of
    from imulab.procedures.registry import load
    from imulab.procedures.tumble.attitudes import find_attitudes
    from imulab.procedures.tumble.check import check_tumble

    check_outputs([report], [name for name in (record, file, options["layout"]) if name])
    held = load(record)
    local = gravity_option(options["gravity"], options["latitude"], options["height"], FLAG)
    largest = None if limit is None else quantity(limit, "--limit", "acceleration", "mg")
    attitudes = find_attitudes(read_recording(file, **reading(options)))
    try:
        result = check_tumble(held, attitudes, limit=largest, gravity=local)
    except RecordError as error:
        raise RecordError(f"{record}: {error}") from None
    recording = attitudes.recording
    corrected = [f"{recording.name}: was corrected before, by {entry}" for entry in recording.corrected_by]
    if corrected:
        corrected[-1] += "; a record is checked by what the unit puts out, so the test means nothing here"
    notes = (*corrected, *warnings_of(held, recording), *result.notes)
    if report:
        from imulab.files import write_text
        from imulab.procedures.tumble.check import check_page

        write_text(report, check_page(result, attitudes, held, record=record, file=file, warnings=notes))
    print(as_json(result, attitudes, notes) if json else as_text(result, attitudes, held, record, file))
    for message in notes:
        warn(message)
    if report and not json:
        print(f"report: {report}")
    return 0 if result.passed else 1
