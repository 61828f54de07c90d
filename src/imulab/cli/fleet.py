"""Calibrate many units, and watch the line."""

from __future__ import annotations

import json as encoder
import sys
from contextlib import ExitStack
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, Literal

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import AsJson, call, check_outputs, progress_bar, warn
from imulab.display import SENTENCES
from imulab.options import OUTPUT, choice

if TYPE_CHECKING:
    from imulab.fleet.run import FleetState

_FAILURES_NAMED = 3  # failures that are named; the rest is counted


def run(
    manifest: Annotated[str, Argument("MANIFEST", "CSV or Parquet: serial,procedure,file and options of the fits.")],
    *,
    output: Annotated[str, option("DIR", "Folder of the records.", "-o", "--output"), OUTPUT],
    json: AsJson = False,
    **options: Any,
) -> int:
    """Calibrate every unit of a manifest that has no record.

    Or one of other files or options. Exit status 2 if a unit failed; all others are finished. Killed at any moment,
    the next run does what is missing.
    """
    with ExitStack() as stack:
        update: list[Any] = []

        def started(total: int) -> None:
            update.append(stack.enter_context(progress_bar("units", total)))

        state = call(il.run_fleet, manifest, output, started=started, progress=lambda done: update[0](done), **options)
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
        print(
            "\n".join(
                [*_failures(state), f"records: {output}", f"table: {options['table'] or f'{output}/parameters.csv'}"]
            )
        )
    return _verdict(state)


def status(folder: Annotated[str, Argument("DIR", "Folder of a fleet.")], *, json: AsJson = False) -> int:
    """Say what is done, failed and missing.

    Exit status 2 if a unit failed.
    """
    state = il.fleet_status(folder)
    if json:
        print(_as_json(state))
    else:
        print(state.shown()[0])
        print("at work: " + (state.at_work or "nobody"))
        print("".join(f"{line}\n" for line in _failures(state)), end="")
    return 2 if state.failures else 0


def report(
    folder: Annotated[str, Argument("DIR", "Folder of a fleet.")],
    *,
    output: Annotated[str, option("OUT.html", "Report to write.", "-o", "--output"), OUTPUT],
    **options: Any,
) -> None:
    """Draw the statistics of the line.

    Distributions, outliers, drift, Cpk, and what changed since the last calibration.
    """
    check_outputs([output], [options["limits"]] if options["limits"] else [])
    il.write_fleet_report(folder, output, **options)
    print(f"report: {output}")


def certificate(
    folder: Annotated[str, Argument("DIR", "Folder of a fleet.")],
    *,
    lab: Annotated[str, option("LAB.toml", "Who issues them; certificate.number has {serial} in it.")],
    limits: Annotated[str | None, option("LIMITS.toml", "Limits of parameters, by the rule in LAB.toml.")] = None,
    language: Annotated[
        Literal["en", "de"] | None, choice(("en", "de"), help="Language of the texts; else that of LAB.toml.")
    ] = None,
    fonts: Annotated[str | None, option("DIR", "Fonts for letters that those of the PDF lack.")] = None,
    sign: Annotated[
        str | None, option("KEY.pem", "Private key and its certificate, by which the XML is signed.")
    ] = None,
    output: Annotated[str, option("DIR", "Folder of the certificates.", "-o", "--output"), OUTPUT],
) -> int:
    """Write the certificate of every unit.

    SERIAL.pdf for people and SERIAL.xml for programs. Exit status 2 if a unit has none, with the reason; all others
    are written.
    """
    from imulab.certificate.laboratory import day_remarks, template_remarks

    units = il.fleet_status(folder).rows
    with progress_bar("certificates", len(units)) as update:
        refused = il.write_fleet_certificates(
            folder, output, lab=lab, limits=limits, language=language, fonts=fonts, sign=sign, progress=update
        )
    print(f"certificates: {len(units) - len(refused)} in {output}")
    certified = [row.summary for row in units if row.summary and row.unit.serial not in refused]
    if certified:
        tumbled = certified[0].procedure == "tumble"
        remarks = template_remarks(lab, certified[0].parameters, tumbled=tumbled)
        latest = max(each.created for each in certified)
        for remark in [*remarks, *day_remarks(lab, latest, datetime.now(UTC).date())]:
            warn(remark)
    if not refused:
        return 0
    print("".join(f"none: {serial}: {reason}\n" for serial, reason in refused.items()), end="")
    first = next(iter(refused.items()))
    print(f"imulab: {len(refused)} of {len(units)} units have no certificate: {first[0]}: {first[1]}", file=sys.stderr)
    return 2


def simulate(
    *, output: Annotated[str, option("DIR", "Folder to write to.", "-o", "--output"), OUTPUT], **options: Any
) -> None:
    """Simulate a line of accelerometers.

    Recordings of two calibrations of each unit, two manifests and limits. The zero of z drifts over the units, unit
    5 is far off, and unit 7 changes between its two calibrations.
    """
    first, second = call(il.simulate_fleet, output, **options)
    print(f"manifests: {first} {second}")
    print(f"limits: {first.parent / 'limits.toml'}")


def _failures(state: FleetState) -> list[str]:
    return [f"failed: {row.unit.serial} ({'; '.join(row.unit.files)}): {row.reason}" for row in state.failures]


def _verdict(state: FleetState) -> int:
    """Say on standard error, in one line, that units failed."""
    failures = state.failures
    if not failures:
        return 0
    shown = "; ".join(f"{row.unit.serial}: {row.reason}" for row in failures[:_FAILURES_NAMED])
    more = f"; and {len(failures) - _FAILURES_NAMED} more" if len(failures) > _FAILURES_NAMED else ""
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
                {
                    "serial": row.unit.serial,
                    "verdict": row.verdict,
                    "reasons": list(row.summary.verdict.reasons),
                    "next": list(row.summary.verdict.next),
                }
                for row in state.doubtful
                if row.summary is not None
            ],
        },
        indent=1,
        ensure_ascii=False,
    )


COMMANDS = (
    Command("fleet run", run, lambda: [il.run_fleet]),
    Command("fleet status", status),
    Command("fleet report", report, lambda: [il.write_fleet_report]),
    Command("fleet certificate", certificate),
    Command("fleet simulate", simulate, lambda: [il.simulate_fleet]),
)
