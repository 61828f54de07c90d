"""Fuse several gyroscopes on one axis into one rate."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from json import dumps
from typing import TYPE_CHECKING, Annotated, Any

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import (
    AsJson,
    GivenFiles,
    OutputFile,
    RecordingFile,
    ReportFile,
    call,
    check_outputs,
    check_record_outputs,
    progress_bar,
    quantity,
    reading,
    warn,
    whole_number,
    with_notes,
)
from imulab.device import STARTS
from imulab.display import aligned
from imulab.errors import OptionError, meant
from imulab.options import OUTPUT
from imulab.procedures.gyro_array import OF_THE_SOURCE

if TYPE_CHECKING:
    from imulab.device.unit import Blob
    from imulab.procedures.gyro_array.compare import Comparison, ExperimentRow
    from imulab.procedures.gyro_array.fuse import Fuser
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


# Output of the commands.


_TITLE = {
    "static": "at rest, 100 Hz, 2000 s",
    "dynamic": "on a rate table, -12.5 cos(0.2 pi t - 0.2 pi) deg/s, 50 Hz, 100 s",
}


def describe_experiment(name: str, seeds: int, rows: list[ExperimentRow]) -> str:
    """Return the two tables of an experiment: without and with a calibrated start."""
    from imulab.report.traces import plain_number

    lines = [f"{name}: 6 gyros {_TITLE[name]}; medians of {seeds} seeds"]
    for calibrated in (False, True):
        lines += ["", f"{'with' if calibrated else 'without'} a calibrated start"]
        body = [
            [r.method, *(plain_number(v, 4) for v in (r.rate_std, r.rate_max, r.angle_std, r.angle_max))]
            for r in rows
            if r.calibrated == calibrated
        ]
        lines += aligned(["method", "rate std deg/s", "rate max deg/s", "angle std deg", "angle max deg"], body)
    return "\n".join(lines)


def experiment_json(name: str, seeds: int, rows: list[ExperimentRow]) -> str:
    """Return the same as JSON."""
    return dumps({"experiment": name, "seeds": seeds, "rows": [asdict(row) for row in rows]}, indent=1)


def describe_comparison(comparison: Comparison) -> str:
    """Return a table of all seven methods for each axis."""
    from imulab.procedures.gyro_array.elements import unit_of_angle
    from imulab.procedures.gyro_array.figures import method_texts
    from imulab.report.traces import plain_number

    model, data = comparison.record.model, comparison.record.data
    lines = [
        f"{comparison.elements.count} gyros on each axis, {comparison.record.fit['samples']} samples at "
        f"{comparison.record.fit['sample_rate']['value']:.6g} Hz; truth: {model['truth']}"
    ]
    for a, axis in enumerate(comparison.elements.axes):
        unit = comparison.elements.units[a]
        angle, factor = unit_of_angle(unit)
        halves = any(
            not isinstance(rows, str) and rows[a].split_half is not None for rows in comparison.figures.values()
        )
        titles = [
            "method", f"rate std {unit}", f"rate max {unit}", f"angle std {angle}", f"angle max {angle}", "reduction",
            "noise/limit", "bandwidth Hz", *([f"split-half {unit}"] if halves else []),
        ]  # fmt: skip
        body, reasons = [], []
        for method, rows in comparison.figures.items():
            if isinstance(rows, str):
                body.append([method, *["–"] * (len(titles) - 1)])
                reasons.append(f"({method} cannot run: {rows})")
                continue
            body.append([method, *method_texts(rows[a], factor, 4, halves=halves)])
        lines += ["", *([f"axis {axis}"] if axis else []), *aligned(titles, body), *reasons]
        lines.append(
            f"single gyro, mean of {_gyros_of_mean(comparison.elements.names[a], data['working'][a])}: "
            f"{plain_number(data['single'][a], 4)} {unit}; limit of one sample {plain_number(data['limit'][a], 4)} "
            f"{unit}"
        )
    lines.append(
        "rate std with the mean removed; reduction: single gyro over method; bandwidth at -3 dB, half the sampling "
        "rate where nothing is filtered"
    )
    return "\n".join(lines)


def _gyros_of_mean(names: Sequence[str], working: Sequence[str]) -> str:
    """Return the gyros that the mean single gyro is the mean of."""
    if len(working) == len(names):
        return "all"
    failed = " ".join(name for name in names if name not in working)
    return f"the {len(working)} that work (not {failed})" if working else "none"


# Fuse several gyroscopes on one axis into one rate.


ToSimulate = Annotated[str, option("OUT.csv", "Recording to write.", "-o", "--output"), OUTPUT]
WholeImus = Annotated[bool, option("", "A board of whole IMUs; it has options of its own (--imus --help).", "--imus")]


def plan(*, imus: WholeImus = False, json: AsJson = False, **options: Any) -> None:
    """Say how to put down and to move a board of whole IMUs.

    And what that will give. Elements of one axis need no plan.
    """
    from imulab.cli.show import finish_plan

    finish_plan(call(il.plan_imus, **options), None, json=json)


def simulate(*, imus: WholeImus = False, output: ToSimulate, **options: Any) -> None:
    """Simulate a recording of an array.

    With its truth in the columns truth_rate.
    """
    elements = options["elements"]
    _simulate(il.simulate_array, output, f"{elements} gyros on each axis", options)


def simulate_imus(*, imus: WholeImus = False, output: ToSimulate, **options: Any) -> None:
    """Simulate a board of whole IMUs that is put down, then turned and shaken by hand.

    With its truth in the head of the file.
    """
    _simulate(il.simulate_imus, output, f"{options['elements']} IMUs", options)


def _simulate(function: Callable[..., Recording], output: str, what: str, options: dict[str, Any]) -> None:
    from imulab.writers import write_csv

    check_outputs([output], [])
    recording = call(function, **options)
    write_csv(recording, output)
    print(f"{output}: {len(recording)} samples, {what}, serial {recording.metadata['serial']}")


def merge(
    files: Annotated[list[str], Argument("FILE FILE...", "Recordings, a gyroscope each.")],
    *,
    output: Annotated[str, option("OUT", "Recording of the array to write.", "-o", "--output"), OUTPUT],
    **options: Any,
) -> None:
    """Join files of one gyro each to an array.

    By time, at the times of the first file.
    """
    from imulab.cli.options import note, read_recording
    from imulab.writers import check_writable, write

    how = reading(options)
    check_outputs([output], [*files, *([how["layout"]] if how["layout"] else [])])
    check_writable(output)
    recordings = [read_recording(file, **how) for file in files]
    merged = call(il.merge_array, recordings, **options)
    write(merged.recording, output)
    for message in merged.notes:
        note(message)
    print(f"{output}: {len(merged.recording)} samples, {len(files)} gyros")


def calibrate(
    still: Annotated[str, Argument("STILL", "Recording at rest.")],
    *,
    imus: WholeImus = False,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Find bias, noise and alignment of every element.

    Bias, noise and correlation at rest; sign and scale or alignment in motion.
    """
    from imulab.cli.show import finish
    from imulab.procedures.registry import run_task

    moving = options.pop("moving")
    check_record_outputs(
        output, report, [name for name in (still, moving, options["layout"], options["noise"]) if name]
    )
    files = [still] if moving is None else [still, moving]
    finish(run_task("array", files, options, GivenFiles()), output, report, json=json)


def calibrate_imus(
    file: RecordingFile,
    *,
    imus: WholeImus = False,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Find where each IMU of a board sits, how it is turned, and how late it answers.

    From one recording: the board lies still in several attitudes, and is turned and shaken by hand. No reference but
    gravity.
    """
    from imulab.cli.options import read_recording
    from imulab.cli.show import finish
    from imulab.procedures.gyro_array.imus.logs import with_all_instances
    from imulab.readers.streams import one_clock

    check_record_outputs(output, report, [name for name in (file, options["layout"]) if name])
    recording = one_clock(read_recording(file, **with_all_instances(file, reading(options))))
    finish(call(il.calibrate_imus, recording, **options).calibration, output, report, json=json)


def fuse(file: RecordingFile, *, imus: WholeImus = False, output: OutputFile = None, **options: Any) -> None:
    """Fuse a file or a live stream into one rate.

    CSV or Parquet to OUT, CSV to standard output; - fuses each line as it comes.
    """
    from imulab.estimation.sampling import mend_blocks
    from imulab.procedures.gyro_array.fuse import Fuser
    from imulab.procedures.gyro_array.stream import FuseOptions, carried, fusion_text
    from imulab.quantities import interval
    from imulab.readers import is_pipe, read_blocks
    from imulab.readers.streams import on_clock_of
    from imulab.writers import check_writable, write, write_csv_to

    calibration, initial_bias, rate, still = (
        options[name] for name in ("calibration", "initial_bias", "rate", "still")
    )
    records = [name for name in (calibration, None if initial_bias in STARTS else initial_bias) if name]
    check_outputs([output], [name for name in (file, options["layout"], *records) if name])
    how = reading(options)
    if output:
        check_writable(output)
    method, memory = options["method"], options["memory"]
    fusion_text(method, memory)  # refuses before a record is read
    known = None if calibration is None else _load_any(calibration)
    by = fusion_text(method, memory, held=carried(known))
    settings = FuseOptions(
        method=by.method,
        memory="growing" if by.memory is None else by.memory,
        start=by.start,
        initial_bias=initial_bias if initial_bias in STARTS else _load(initial_bias, "--initial-bias"),
        calibration=known,
        rate=None if rate is None else quantity(rate, "--rate", "frequency", "Hz"),
        still=None if still is None else interval(still, "--still"),
    )
    fuser = Fuser(settings, tell=warn) if file == "-" else Fuser(settings)  # a stream may never end
    rows: Iterable[Recording] = on_clock_of(read_blocks(file, **how))
    rows = rows if is_pipe(file) else mend_blocks(rows)  # a stream is fused as it comes
    blocks = (part.recording() for part in fuser.fuse(with_notes(rows)))
    if output:
        write(blocks, output)
    else:
        first = next(blocks)  # fused before anything is written, so that a refusal leaves no head behind
        write_csv_to(_flushed(first, blocks), sys.stdout.buffer)
        sys.stdout.buffer.flush()
    _print_findings(fuser, verdict=output is not None)


def fuse_imus(file: RecordingFile, *, imus: WholeImus = False, output: OutputFile = None, **options: Any) -> None:
    """Fuse a board of whole IMUs into one specific force, rate and angular acceleration.

    Each with its standard uncertainty; rates beyond the gyroscopes' range are bridged by the accelerometers.
    """
    from imulab.estimation.sampling import mend_blocks
    from imulab.procedures.gyro_array.imus.fuse import BoardFuser, board_of, limits_of
    from imulab.procedures.gyro_array.imus.logs import with_all_instances
    from imulab.procedures.registry import load_any
    from imulab.readers import is_pipe, read_blocks
    from imulab.readers.streams import on_clock_of
    from imulab.writers import check_writable, write, write_csv_to

    calibration = options["calibration"]
    check_outputs([output], [name for name in (file, options["layout"], calibration) if name])
    how = with_all_instances(file, reading(options))
    if output:
        check_writable(output)
    known = load_any(calibration)
    board_of(known, options["at"])  # refuses before a recording is read

    def blocks() -> Iterable[Recording]:
        rows: Iterable[Recording] = on_clock_of(read_blocks(file, **how))
        return rows if is_pipe(file) else mend_blocks(rows)

    stated = {name: options[name] for name in ("gyro_range", "accel_range")}
    limits = call(limits_of, known, () if is_pipe(file) else blocks(), **stated)
    fuser = BoardFuser(board_of(known, options["at"], limits))
    parts = (part.recording() for part in fuser.fuse(with_notes(blocks())))
    if output:
        write(parts, output)
        print(f"{output}: {fuser.share()}")
    else:
        first = next(parts)
        write_csv_to(_flushed(first, parts), sys.stdout.buffer)
        sys.stdout.buffer.flush()
    for line in fuser.notes():
        warn(line)


def _load(name: str, option: str) -> Calibration:
    from pathlib import Path

    from imulab.procedures.gyro_array.elements import check_calibration
    from imulab.procedures.registry import load

    if option == "--initial-bias" and not Path(name).exists():
        raise OptionError(
            f"--initial-bias {name!r}: expected first, zero, or the file of a record{meant(STARTS, name)}"
        )
    record = load(name)
    check_calibration(record, name)
    return record


def _load_any(name: str) -> Calibration | Blob:
    from imulab.device.unit import Blob
    from imulab.procedures.gyro_array.elements import check_calibration
    from imulab.procedures.registry import load_any

    record = load_any(name)
    if not isinstance(record, Blob):
        check_calibration(record, name)
    return record


def _flushed(first: Recording, rest: Iterator[Recording]) -> Iterator[Recording]:
    """Yield blocks, each written out before the next is read."""
    yield first
    sys.stdout.buffer.flush()
    for block in rest:
        yield block
        sys.stdout.buffer.flush()


def _print_findings(fuser: Fuser, *, verdict: bool) -> None:
    """Print the findings on a fusion; the verdict first, unless standard output is the rate."""
    from imulab.cli.show import verdict_lines
    from imulab.display import verdict_of

    lines = fuser.notes() + (fuser.health.lines() if fuser.health is not None else [])
    if verdict:
        print("\n".join(verdict_lines(verdict_of(lines))))
    for line in lines:
        warn(line)


def compare(
    file: Annotated[str | None, Argument("FILE", "Recording, with or without truth_rate.")] = None,
    *,
    experiment: Annotated[
        str | None, option("|".join(OF_THE_SOURCE), "Run the source's set-up instead of a FILE.", words=OF_THE_SOURCE)
    ] = None,
    seeds: Annotated[str, option("N", "Runs of the experiment.")] = "20",
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Run every method over one recording.

    Or over the source's experiments; says what fusing buys.
    """
    from imulab.cli.show import write_both

    calibration = options["calibration"]
    if (file is None) == (experiment is None):
        raise OptionError("array compare: expected FILE, or --experiment static|dynamic")
    check_outputs([output], [name for name in (file, calibration, options["layout"]) if name], report=report)
    how = reading(options)
    count = whole_number(seeds, "--seeds")
    if experiment is not None:
        if output or report or options["memory"]:
            raise OptionError("array compare: -o, --report and --memory need a FILE")
        from imulab.procedures.gyro_array.compare import run_experiment

        with progress_bar("seeds", count) as progress:
            rows = run_experiment(experiment, seeds=count, progress=progress)
        print(experiment_json(experiment, count, rows) if json else describe_experiment(experiment, count, rows))
        return
    from imulab.cli.show import verdict_lines
    from imulab.procedures.gyro_array.compare import compare_methods
    from imulab.procedures.gyro_array.stream import carried, fusion_text
    from imulab.readers import read
    from imulab.readers.streams import one_clock

    record = None if calibration is None else _load(calibration, "--calibration")
    by = fusion_text(None, options["memory"], held=carried(record))
    kept = "growing" if by.memory is None else by.memory
    comparison = compare_methods(
        one_clock(read(str(file), **how)), calibration=record, memory=kept, count_from=by.start
    )
    write_both(comparison.record, output, report)
    if not json:
        print("\n".join(verdict_lines(comparison.record.verdict)))
    print(comparison.record.to_json().rstrip("\n") if json else describe_comparison(comparison))
    for name, what in ((output, "record"), (report, "report")):
        if name and not json:
            print(f"{what}: {name}")
    for message in comparison.warnings:
        warn(message)


def compare_imus(
    file: RecordingFile, *, imus: WholeImus = False, report: ReportFile = None, json: AsJson = False, **options: Any
) -> None:
    """Compare each IMU of a board with what the others say.

    Fused, by their mean, and one by one: what fusing the board buys, without any truth.
    """
    from imulab.cli.options import read_recording
    from imulab.cli.show import verdict_lines
    from imulab.display import Note, verdict_of
    from imulab.files import write_text
    from imulab.procedures.gyro_array.imus.logs import with_all_instances
    from imulab.readers.streams import one_clock
    from imulab.report import render_page
    from imulab.report.traces import ReportTable

    calibration = options["calibration"]
    check_outputs([], [name for name in (file, options["layout"], calibration) if name], report=report)
    recording = one_clock(read_recording(file, **with_all_instances(file, reading(options))))
    compared = call(il.compare_imus, recording, **options)
    verdict, exhibits = verdict_of(compared.notes), compared.exhibits()
    if report:
        notes = [note for note in compared.notes if isinstance(note, Note)]
        page = render_page(
            "Fused board", recording.metadata.get("serial", recording.name), exhibits, verdict=verdict, notes=notes,
            provenance=[("recording", file), ("record", calibration)],
        )  # fmt: skip
        write_text(report, page)
    if json:
        print(dumps(compared.content(), indent=1))
    else:
        lines = [*verdict_lines(verdict), exhibits.headline]
        for item in exhibits.items:
            if isinstance(item, ReportTable):
                lines += ["", item.title, *aligned(item.columns, item.rows)]
        print("\n".join(lines))
        if report:
            print(f"report: {report}")
    for message in compared.notes:
        warn(message)


def _calibrate_functions() -> list[Any]:
    from imulab.procedures.gyro_array.procedure import Older

    return [il.calibrate_array, Older]


COMMANDS = (
    Command("array plan", plan, lambda: [il.plan_imus]),
    Command("array simulate", simulate, lambda: [il.simulate_array]),
    Command("array simulate --imus", simulate_imus, lambda: [il.simulate_imus]),
    Command("array merge", merge, lambda: [il.merge_array], without=("element",)),
    Command("array calibrate", calibrate, _calibrate_functions, without=("element",)),
    Command("array calibrate --imus", calibrate_imus, lambda: [il.calibrate_imus], without=("element",)),
    Command("array fuse", fuse, lambda: [il.fuse], without=("element",)),
    Command("array fuse --imus", fuse_imus, lambda: [il.fuse_imus], without=("element",)),
    Command("array compare", compare, lambda: [il.compare_methods], without=("element",)),
    Command("array compare --imus", compare_imus, lambda: [il.compare_imus], without=("element",)),
)
