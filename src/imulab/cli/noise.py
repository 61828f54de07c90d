"""``imulab noise``: fit, plan, check, simulate; and ``imulab allan``, the noise of any recording."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

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
    lists,
    note,
    one_of,
    quantity,
    reading,
    warn,
    with_options,
)
from imulab.display import printable
from imulab.errors import OptionError, RecordError
from imulab.estimation import TAUS
from imulab.procedures.noise.procedure import OPTIONS
from imulab.quantities import labelled

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from imulab.estimation.noise.rest import Rest
    from imulab.procedures.noise.plan import NoisePlan
    from imulab.recording import Recording


# ``imulab allan``: the noise of any recording.


@with_options(READ)
def allan(
    file: RecordingFile,
    *,
    taus: Annotated[str, one_of(TAUS, "dense: 24 a decade.")] = "octave",
    options: dict[str, str | None],
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Print Allan deviation and noise coefficients of every sensor column of a recording at rest."""
    from imulab.estimation.column_noise import analyse
    from imulab.readers import read, read_blocks
    from imulab.recording import is_large, on_disk

    check_outputs([report], [name for name in (file, options["layout"]) if name])
    how = reading(options)
    recording = on_disk(read_blocks(file, **how)) if is_large(file) else read(file, **how)
    with labelled("--{}", ["taus"]):
        found = analyse(recording, taus)
    if report:
        from imulab.files import write_text
        from imulab.report.noise_figures import noise_page

        write_text(report, noise_page(found, recording))
    if json:
        from json import dumps

        print(dumps(found, indent=1, ensure_ascii=False, allow_nan=False))
    else:
        print(describe(found))
        if report:
            print(f"report: {report}")
    for message in found["warnings"]:
        warn(message)


def describe(found: dict[str, Any]) -> str:
    """Return coefficients and curves as tables."""
    from imulab.display import aligned
    from imulab.report.noise_figures import coefficient_rows, shown_unit
    from imulab.report.traces import plain_number

    lines = [f"{printable(found['file'])}: {found['samples']} samples at {found['sample_rate']['value']:.6g} Hz", ""]
    lines += aligned(["column", "coefficient", "value", "u", "unit"], coefficient_rows(found))
    names = list(found["columns"])
    units = {name: shown_unit(found["columns"][name]["unit"], "bias_instability") for name in names}
    lines += ["", "Allan deviation"]
    tau = found["columns"][names[0]]["tau"]
    body = [
        [plain_number(t, 4), *(plain_number(found["columns"][n]["deviation"][k] * units[n][1], 4) for n in names)]
        for k, t in enumerate(tau)
    ]
    lines += aligned(["tau s", *(f"{n} {units[n][0]}" for n in names)], body)
    return "\n".join(lines)


# ``imulab noise``: fit, plan, check, simulate.


White = Annotated[
    str | None, typer.Option(metavar="N", help="White noise, 0.3 deg/sqrt(h) or 100 ug/sqrt(Hz); SI without a unit.")
]
Flicker = Annotated[str | None, typer.Option(metavar="B", help="1/f noise, such as 5 deg/h.")]
Walk = Annotated[str | None, typer.Option(metavar="K", help="Random walk, such as 3 deg/h/sqrt(h).")]
Quantisation = Annotated[str | None, typer.Option(metavar="Q", help="Quantisation of the angle, such as 1 arcsec.")]
Markov = Annotated[
    list[str] | None,
    typer.Option(metavar="SIGMA:TIME", help="Gauss-Markov noise, such as '20 deg/h:300 s'; once or twice."),
]
FromRecord = Annotated[
    str | None, typer.Option("--from", metavar="RECORD", help="In place of terms: those of a record of noise fit.")
]


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    for function in (fit, plan, check, simulate):
        group.command(function.__name__)(function)
    return group


@with_options(OPTIONS)
def fit(
    files: Annotated[list[str], typer.Argument(metavar="LOG...", help="Logs at rest of one unit.")],
    options: dict[str, str | None],
    output: OutputFile = None,
    report: ReportFile = None,
    program: Annotated[
        str | None,
        typer.Option(
            "--for",
            metavar="PROGRAM",
            help="Print what its filter wants, key: value.",
            autocompletion=lists("imulab.procedures.noise.wants:PROGRAMS"),
        ),
    ] = None,
    rate: Annotated[str | None, typer.Option(metavar="HZ", help="--for: samples that it gets; as the logs.")] = None,
    step: Annotated[
        str | None, typer.Option(metavar="TIME", help="--for: between predictions; px4 10 ms, ardupilot 12 ms.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Fit a model of the noise to logs at rest, column by column; several logs of a unit add up.

    Prints the terms with their 95 % intervals, and what a filter wants; -o writes the record, --report its figures.
    """
    from imulab.cli.show import finish
    from imulab.procedures.noise.wants import check_program, noise_for
    from imulab.procedures.registry import run_task

    check_outputs([output, report], [*files, *([options["layout"]] if options["layout"] else [])])
    hertz = None if rate is None else quantity(rate, "--rate", "frequency", "Hz")
    seconds = None if step is None else quantity(step, "--step", "time", "s")
    if program is not None:
        check_program(program, "--for")
    elif rate is not None or step is not None:
        raise OptionError("--rate and --step say how the filter of --for runs: expected --for")
    record = run_task("noise", files, options, GivenFiles())
    if program is None:
        finish(record, output, report, json=json)
        return
    with labelled("--{}", ["rate", "step"]):
        wanted = noise_for(record, program, rate=hertz, step=seconds)
    finish(record, output, report, json=json, describe=lambda _: "\n".join(f"{k}: {v:.4g}" for k, v in wanted.items()))


def plan(
    source: FromRecord = None,
    wanted: Annotated[
        str,
        typer.Option("--for", metavar="10%|walk=10%,..", help="Wanted standard uncertainty, of all terms or by name."),
    ] = "10 %",
    white: White = None,
    flicker: Flicker = None,
    walk: Walk = None,
    quantisation: Quantisation = None,
    gm: Markov = None,
    rate: Annotated[str | None, typer.Option(help="Sampling rate, Hz; that of the record, or 100 Hz.")] = None,
    duration: Annotated[str | None, typer.Option(help="What a record of this length tells, s.")] = None,
    columns: Annotated[str | None, typer.Option(metavar="A,A,...", help="Of the record.")] = None,
    output: Annotated[
        str | None, typer.Option("-o", "--output", metavar="PLAN.csv", help="Uncertainties over the length, to write.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Say how long to record at rest for a wanted accuracy of each noise term."""
    from imulab.display import aligned
    from imulab.procedures.noise.plan import plan_noise

    check_outputs([output], [source] if source else [])
    if output is not None and not output.lower().endswith(".csv"):
        raise OptionError(f"{output}: expected a name that ends in .csv")
    result = call(
        plan_noise, from_=source, for_=wanted, white=white, flicker=flicker, walk=walk, quantisation=quantisation,
        gm=gm, rate=rate, duration=duration, columns=columns,
    )  # fmt: skip
    if output:
        result.save(output)
    if json:
        _print_plan(result)
        return
    lead, titles, rows = result.shown()
    print("\n".join([lead, *aligned(titles, rows)]))
    if output:
        print(f"plan: {output}")


def _print_plan(result: NoisePlan) -> None:
    from imulab.procedures.noise.fit import unit_of
    from imulab.records.calibration import json_text

    terms = [
        {
            "column": each.column,
            "term": each.term,
            "value": each.value,
            "unit": unit_of(each.term, each.unit),
            "relative_standard_uncertainty": finite(each.uncertainty),
            "limit": finite(each.limit),
            "wanted": finite(each.wanted),
            "length": None if (length := finite(each.length)) is None else {"value": length, "unit": "s"},
        }
        for each in result.terms
    ]
    print(json_text({"length": {"value": result.length, "unit": "s"}, "terms": terms}), end="")


def finite(value: float) -> float | None:
    """Return a number, None where it is none."""
    return value if math.isfinite(value) else None


@with_options(READ)
def check(
    record: RecordFile,
    files: Annotated[list[str], typer.Argument(metavar="LOG...", help="Logs at rest, of the record's rate.")],
    *,
    tolerance: Annotated[str, typer.Option(help="Change of size that is not held against the log.")] = "1 %",
    false_alarm: Annotated[
        str, typer.Option("--false-alarm", help="Share of logs of unchanged noise that fail.")
    ] = "5 %",
    options: dict[str, str | None],
    report: ReportFile = None,
    json: AsJson = False,
) -> int:
    """Test whether a new log at rest is of the noise of a record; exit status 0: pass, 1: fail.

    Several logs add up. Says what differs by how much; a log that is of the same noise fails once in twenty tests.
    """
    from imulab.cli.options import coloured
    from imulab.display import Note
    from imulab.procedures.noise.check import as_json, as_text, check_logs, check_page
    from imulab.procedures.noise.fit import read_log
    from imulab.procedures.procedure import source_of
    from imulab.procedures.registry import load

    check_outputs([report], [name for name in (record, *files, options["layout"]) if name])
    held = load(record)
    access, how = GivenFiles(), reading(options)

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
    if report:
        from imulab.files import write_text

        write_text(report, check_page(result, held, record=record, files=files))
    if json:
        from imulab.records.calibration import json_text

        print(json_text(as_json(result)), end="")
    else:
        print(as_text(result, record, files, coloured("pass" if result.passed else "fail")))
    for message in result.notes:
        (note if isinstance(message, Note) else warn)(message)
    if report and not json:
        print(f"report: {report}")
    return 0 if result.passed else 1


def simulate(
    output: Annotated[str, typer.Option("-o", "--output", metavar="OUT", help="Log to write, .csv or .parquet.")],
    white: White = None,
    flicker: Flicker = None,
    walk: Walk = None,
    quantisation: Quantisation = None,
    gm: Markov = None,
    source: FromRecord = None,
    rate: Annotated[str | None, typer.Option(help="Sampling rate, Hz; that of the record, or 100 Hz.")] = None,
    duration: Annotated[str, typer.Option(help="Of the log, s.")] = "1 h",
    columns: Annotated[
        str | None, typer.Option(metavar="A,A,...", help="Those of the record, or three axes of the sensor.")
    ] = None,
    seed: Annotated[str, typer.Option(help="Of the random numbers.")] = "1",
) -> None:
    """Simulate a log at rest from given noise or from a record's, with its truth in the head of the file.

    Logs of any length are written in blocks.
    """
    from imulab.procedures.noise.simulate import noise_log
    from imulab.writers import check_writable, write

    check_outputs([output], [source] if source else [])
    check_writable(output)
    log = call(
        noise_log, from_=source, white=white, flicker=flicker, walk=walk, quantisation=quantisation, gm=gm, rate=rate,
        duration=duration, columns=columns, seed=seed,
    )  # fmt: skip
    write(log.blocks(), output)
    print(f"{output}: {log.count} samples of {' '.join(log.values)}, {log.count / log.rate:g} s at {log.rate:g} Hz")
