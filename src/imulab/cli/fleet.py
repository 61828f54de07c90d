"""``imulab fleet``: run, status, report and simulate."""

from __future__ import annotations

import json as encoder
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imulab.cli.options import AsJson, call, check_outputs, one_of, progress_bar, warn
from imulab.display import SENTENCES
from imulab.errors import OptionError
from imulab.fleet import ENGINES

if TYPE_CHECKING:
    from imulab.fleet.run import FleetState

HistoryUrl = Annotated[
    str | None,
    typer.Option("--history", metavar="URL", help="SQLite or PostgreSQL, or none; a file in DIR if not given."),
]
_FEW = 3


def commands(settings: dict[str, Any]) -> typer.Typer:
    """Return the group of commands."""
    group = typer.Typer(**settings)
    for function in (run, status, report, simulate):
        group.command(function.__name__)(function)
    return group


def run(
    manifest: Annotated[
        str, typer.Argument(metavar="MANIFEST", help="CSV or Parquet: serial,procedure,file and options of the fits.")
    ],
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder of the records.")],
    engine: Annotated[str, one_of(ENGINES, "Processes of this machine, or a Dask cluster.")] = "local",
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Of a Dask cluster, as tcp://host:8786.")
    ] = None,
    workers: Annotated[
        str | None, typer.Option("--workers", metavar="N", help="Processes; one for each processor if not given.")
    ] = None,
    history: HistoryUrl = None,
    table: Annotated[
        str | None,
        typer.Option("--table", metavar="OUT", help=".csv or .parquet; parameters.csv in DIR if not given."),
    ] = None,
    json: AsJson = False,
) -> int:
    """Calibrate every unit of a manifest that has no record yet, or one of other files or options.

    Exit status 2 if a unit failed; all others are finished. Killed at any moment, the next run does what is missing.
    """
    from imulab.fleet.run import run_fleet

    with ExitStack() as stack:
        update: list[Any] = []

        def started(total: int) -> None:
            update.append(stack.enter_context(progress_bar("units", total)))

        state = call(
            run_fleet,
            manifest,
            output,
            engine=engine,
            scheduler=scheduler,
            workers=workers,
            history=history,
            table=table,
            started=started,
            progress=lambda done: update[0](done),
        )
    for note in state.notes:
        warn(note)
    if json:
        print(_as_json(state))
    else:
        made = state.count("done") - state.kept
        kept = f", {state.kept} were there already" if state.kept else ""
        units = "1 unit" if len(state.rows) == 1 else f"{len(state.rows)} units"
        print(f"{units}: {made} done{kept}, {state.count('failed')} failed, {state.seconds:.1f} s")
        if state.judged:
            print(f"verdicts: {state.judged}")
        print("\n".join([*_failures(state), f"records: {output}", f"table: {table or f'{output}/parameters.csv'}"]))
    return _verdict(state)


def status(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Folder of a fleet.")],
    json: AsJson = False,
) -> int:
    """Say where a fleet stands; exit status 2 if a unit failed."""
    from imulab.fleet.run import fleet_status

    state = fleet_status(folder)
    if json:
        print(_as_json(state))
    else:
        print(state.shown()[0])
        print("at work: " + (state.at_work or "nobody"))
        print("".join(f"{line}\n" for line in _failures(state)), end="")
    return 2 if state.failures else 0


def report(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Folder of a fleet.")],
    output: Annotated[str, typer.Option("-o", "--output", metavar="OUT.html", help="Report to write.")],
    limits: Annotated[
        str | None, typer.Option("--limits", metavar="L.toml", help="Limits of parameters, for Cpk.")
    ] = None,
    history: HistoryUrl = None,
) -> None:
    """Draw the line's statistics: distributions, outliers, drift, Cpk, and what changed since the last calibration."""
    from imulab.fleet.report import write_fleet_report

    check_outputs([output], [limits] if limits else [])
    write_fleet_report(folder, output, limits=limits, history=history)
    print(f"report: {output}")


def simulate(
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder to write to.")],
    units: Annotated[str, typer.Option("--units", metavar="N", help="Number of units, 8 or more.")] = "12",
    seed: Annotated[str, typer.Option("--seed", metavar="N", help="Of the random numbers.")] = "1",
) -> None:
    """Simulate a line of accelerometers.

    Recordings of two calibrations of each unit, two manifests and limits. The zero of z drifts over the units, unit 5
    is far off, and unit 7 changes between its two calibrations.
    """
    from imulab.procedures.tumble.simulate import simulate_fleet

    if not output:
        raise OptionError("output '': expected the name of a folder to write to")
    first, second = call(simulate_fleet, output, units=units, seed=seed)
    print(f"manifests: {first} {second}")
    print(f"limits: {first.parent / 'limits.toml'}")


def _failures(state: FleetState) -> list[str]:
    return [f"failed: {row.unit.serial} ({'; '.join(row.unit.files)}): {row.reason}" for row in state.failures]


def _verdict(state: FleetState) -> int:
    """Say on standard error, in one line, that units failed."""
    failures = state.failures
    if not failures:
        return 0
    shown = "; ".join(f"{row.unit.serial}: {row.reason}" for row in failures[:_FEW])
    more = f"; and {len(failures) - _FEW} more" if len(failures) > _FEW else ""
    print(f"imulab: {len(failures)} of {len(state.rows)} units failed: {shown}{more}", file=sys.stderr)
    return 2


def _as_json(state: FleetState) -> str:
    return encoder.dumps(
        {
            "units": len(state.rows),
            **{name: state.count(name) for name in ("done", "failed", "missing")},
            "verdicts": {name: sum(row.verdict == name for row in state.rows) for name in SENTENCES},
            "kept": state.kept,
            "at_work": state.at_work,
            "failures": [
                {"serial": row.unit.serial, "files": list(row.unit.files), "reason": row.reason}
                for row in state.failures
            ],
            "doubtful": [
                {"serial": row.unit.serial, "verdict": row.verdict, "reasons": list(row.summary.verdict.reasons)}
                for row in state.doubtful
                if row.summary is not None
            ],
        },
        indent=1,
        ensure_ascii=False,
    )
