"""Model the noise of sensors at rest, for filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import imulab as il
from imulab.cli.command import Argument, Command, option
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
    is_json,
    naming,
    quantity,
    reading,
    warn,
)
from imulab.display import printable
from imulab.errors import OptionError, RecordError
from imulab.options import OUTPUT
from imulab.quantities import labelled

if TYPE_CHECKING:
    from collections.abc import Callable

    from imulab.estimation.noise.rest import Rest
    from imulab.recording import Recording


# ``imulab allan``: the noise of any recording.


def allan(file: RecordingFile, *, report: ReportFile = None, json: AsJson = False, **options: Any) -> None:
    """Print Allan deviation and noise coefficients.

    Of every sensor column of a recording at rest.
    """
    from imulab.estimation.column_noise import analyse
    from imulab.readers import read, read_blocks
    from imulab.recording import is_large, on_disk

    check_outputs([], [name for name in (file, options["layout"]) if name], report=report)
    how = reading(options)
    recording = on_disk(read_blocks(file, **how)) if is_large(file) else read(file, **how)
    with labelled("--{}", ["taus"]):
        analysis = analyse(recording, options["taus"])
    if report:
        from imulab.files import write_text
        from imulab.report.noise_figures import noise_page

        write_text(report, noise_page(analysis, recording))
    if json:
        from json import dumps

        print(dumps(analysis, indent=1, ensure_ascii=False, allow_nan=False))
    else:
        print(describe(analysis))
        if report:
            print(f"report: {report}")
    for message in analysis["warnings"]:
        warn(message)


def describe(analysis: dict[str, Any]) -> str:
    """Return coefficients and curves as tables."""
    from imulab.display import aligned
    from imulab.report.noise_figures import coefficient_rows
    from imulab.report.parameters import small_unit
    from imulab.report.traces import plain_number

    sizes: dict[tuple[int, float], list[str]] = {}
    for name, column in analysis["columns"].items():
        of_column = {**analysis, **column}
        sizes.setdefault((of_column["samples"], of_column["sample_rate"]["value"]), []).append(name)
    texts = [f"{n} samples at {rate:.6g} Hz" for n, rate in sizes]
    if len(sizes) > 1:
        texts = [f"{text} ({' '.join(names)})" for text, names in zip(texts, sizes.values(), strict=True)]
    lines = [f"{printable(analysis['file'])}: {', '.join(texts)}", ""]
    lines += aligned(["column", "coefficient", "value", "u", "unit"], coefficient_rows(analysis))
    names = list(analysis["columns"])
    units = {name: small_unit(analysis["columns"][name]["unit"]).scale for name in names}
    lines += ["", "Allan deviation"]
    by_times: dict[tuple[float, ...], list[str]] = {}
    for name in names:
        by_times.setdefault(tuple(analysis["columns"][name]["tau"]), []).append(name)
    for times, together in by_times.items():
        deviations = [[d * units[n][1] for d in analysis["columns"][n]["deviation"]] for n in together]
        body = [[plain_number(each, 4) for each in row] for row in zip(times, *deviations, strict=True)]
        lines += aligned(["tau s", *(f"{n} {units[n][0]}" for n in together)], body)
    return "\n".join(lines)


# Model the noise of sensors at rest, for filters.


_LISTED = "kalibr, openvins, vins, px4, ardupilot, gtsam, ros or matlab"


def _programs() -> tuple[str, ...]:
    from imulab.procedures.noise.wants import PROGRAMS

    return tuple(PROGRAMS)


def fit(
    files: Annotated[list[str], Argument("LOG...", "Logs at rest of one unit.")],
    *,
    output: OutputFile = None,
    report: ReportFile = None,
    json: AsJson = False,
    program: Annotated[
        str | None,
        option("PROGRAM", f"Print what {_LISTED} wants, key: value.", "--for", words=_programs),
    ] = None,
    rate: Annotated[str | None, option("HZ", "--for: samples that it gets; as the logs.")] = None,
    step: Annotated[str | None, option("TIME", "--for: between predictions; px4 10 ms, ardupilot 12 ms.")] = None,
    **options: Any,
) -> None:
    """Fit a model of the noise to logs at rest.

    Column by column; several logs of a unit add up. Prints the terms with their 95 % intervals, and what a filter
    wants; -o writes the record, --report its figures. With --for, a noise record in place of the logs gives the same,
    and -o FILE.yaml writes what is printed (px4 also .params, ardupilot .param).
    """
    from imulab.cli.show import finish
    from imulab.procedures.noise.schema import fit_of
    from imulab.procedures.noise.wants import check_program, noise_for
    from imulab.procedures.registry import load, run_task

    inputs = [*files, *([options["layout"]] if options["layout"] else [])]
    keys_file = output if program is not None and _holds_keys(output, program) else None
    if keys_file is None:
        check_record_outputs(output, report, inputs)
    else:
        check_outputs([output], inputs, report=report)
    hertz = None if rate is None else quantity(rate, "--rate", "frequency", "Hz")
    seconds = None if step is None else quantity(step, "--step", "time", "s")
    if program is not None:
        check_program(program, "--for")
    elif rate is not None or step is not None:
        raise OptionError("--rate and --step say how the filter of --for runs: expected --for")
    saved = program is not None and len(files) == 1 and is_json(files[0])
    record = load(files[0]) if saved else run_task("noise", files, options, GivenFiles())
    if program is None:
        finish(record, output, report, json=json)
        return
    with labelled("--{}", ["rate", "step"]), naming(files[0]) if saved else nullcontext():
        wanted = noise_for(record, program, rate=hertz, step=seconds)
    printed = "\n".join(f"{key}: {value:.4g}" for key, value in wanted.items())
    if keys_file:
        _write_keys(wanted, keys_file, program, files)
        printed += f"\n{program}: {keys_file}"
    finish(record, None if keys_file else output, report, json=json, describe=lambda _: printed)
    for key in [key for key, value in wanted.items() if value == 0]:
        warn(
            f"{key}: none was seen in {fit_of(record).length.value:.4g} s, and 0 makes a filter trust a bias for ever; "
            "record longer, or take a value below the limits that noise fit prints without --for"
        )


_KEYS_FILES = {".yaml": "", ".yml": "", ".txt": "", ".params": "px4", ".param": "ardupilot"}
"""Endings of files for the keys of a program, and the only program that reads them."""


def _holds_keys(output: str | None, program: str) -> bool:
    """Return whether a file is to hold the keys of a program, by its ending."""
    return _KEYS_FILES.get(Path(output or "").suffix.lower()) in ("", program)


def _write_keys(wanted: Mapping[str, float], output: str, program: str, files: Sequence[str]) -> None:
    """Write the keys of a program as its parameter file, or as YAML."""
    from imulab.exporters.model import single_precision, yaml_number
    from imulab.exporters.texts import hash_comments
    from imulab.files import write_text

    ending = Path(output).suffix.lower()

    def row(key: str, value: float) -> str:
        if ending == ".params":
            return f"1\t1\t{key}\t{single_precision(value)}\t9"
        return f"{key},{single_precision(value)}" if ending == ".param" else f"{key}: {yaml_number(value)}"

    rows = [row(key, float(f"{value:.4g}")) for key, value in wanted.items()]
    origin = f"{program}: noise of {' '.join(files)}, the largest of the three axes (imulab {il.__version__})"
    write_text(output, "\n".join([*hash_comments([origin]), *rows]) + "\n")


def plan(
    *,
    output: Annotated[
        str | None, option("PLAN.csv", "Uncertainties over the length, to write.", "-o", "--output"), OUTPUT
    ] = None,
    json: AsJson = False,
    **options: Any,
) -> None:
    """Say how long to record for a wanted accuracy.

    At rest, for each noise term.
    """
    from imulab.cli.show import finish_plan

    check_outputs([output], [options["from_"]] if options["from_"] else [])
    if output is not None and not output.lower().endswith(".csv"):
        raise OptionError(f"{output}: expected a name that ends in .csv")
    result = call(il.plan_noise, **options)
    finish_plan(result, output, json=json)


def check(
    record: RecordFile,
    files: Annotated[list[str], Argument("LOG...", "Logs at rest, of the record's rate.")],
    *,
    report: ReportFile = None,
    json: AsJson = False,
    **options: Any,
) -> int:
    """Hold a new log against a noise record.

    Tests whether a log at rest is of the noise of the record; exit status 0: pass, 1: fail. Several logs add up.
    Says what differs by how much; a log that is of the same noise fails once in twenty tests.
    """
    from imulab.cli.show import finish_check
    from imulab.procedures.noise.check import check_logs
    from imulab.procedures.noise.fit import read_log
    from imulab.procedures.procedure import source_of
    from imulab.procedures.registry import load

    check_outputs([], [name for name in (record, *files, options["layout"]) if name], report=report)
    held = load(record)
    access, how = GivenFiles(), reading(options)
    tolerance, false_alarm = options["tolerance"], options["false_alarm"]

    def log(file: str, choose: Callable[[Recording], Sequence[str]]) -> Recording | Rest:
        return read_log(
            None if file == "-" else access.path(file),
            lambda: (access.blocks(file, **how), source_of(access, file)),
            lambda: access.recording(file, **how),
            choose,
        )

    with labelled("--{}", ["tolerance", "false_alarm"]):
        try:
            result = check_logs(held, lambda choose: [log(file, choose) for file in files], tolerance, false_alarm)
        except RecordError as error:
            raise RecordError(f"{record}: {error}") from None
    return finish_check(result, held, record, files, [], report, json=json)


def simulate(
    *,
    output: Annotated[str, option("OUT", "Log to write, .csv or .parquet.", "-o", "--output"), OUTPUT],
    **options: Any,
) -> None:
    """Simulate a log at rest.

    From given noise or from a record's, with its truth in the head of the file. Logs of any length are written in
    blocks.
    """
    from imulab.procedures.noise.simulate import noise_log
    from imulab.writers import check_writable, write

    check_outputs([output], [options["from_"]] if options["from_"] else [])
    check_writable(output)
    log = call(noise_log, **options)
    write(log.blocks(), output)
    print(f"{output}: {log.count} samples of {' '.join(log.values)}, {log.count / log.rate:g} s at {log.rate:g} Hz")


COMMANDS = (
    Command("noise fit", fit, lambda: [il.fit_noise]),
    Command("noise plan", plan, lambda: [il.plan_noise]),
    Command("noise check", check, lambda: [il.check_noise]),
    Command("allan", allan, lambda: [il.allan_deviation]),
    Command("noise simulate", simulate, lambda: [il.simulate_noise]),
)
