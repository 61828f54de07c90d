"""What every fit does with its result: write it, print it, say what a user must know."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

from imulab.cli.options import note, warn

if TYPE_CHECKING:
    from imulab.records.calibration import Calibration


def write_both(record: Calibration, output: str | None, report: str | None) -> None:
    """Write a record and its report, both or none."""
    from imulab.atomic_write import replacing
    from imulab.procedures.reports import rendered

    with ExitStack() as stack:
        # Both files are opened before either is finished, so that neither is left alone behind an error.
        to_record = stack.enter_context(replacing(output)) if output else None
        to_report = stack.enter_context(replacing(report)) if report else None
        if to_record:
            to_record.write(record.to_json().encode("utf-8"))
        if to_report:
            to_report.write(rendered(record).encode("utf-8"))


def finish(
    record: Calibration,
    output: str | None,
    report: str | None,
    *,
    json: bool,
    describe: Callable[[Calibration], str] | None = None,
) -> None:
    """Write a record and its report, both or none, and say what was found, in full or as `describe` has it."""
    write_both(record, output, report)
    if json:
        print(record.to_json(), end="")
    else:
        from imulab.cli.show import describe_record

        print(describe(record) if describe else describe_record(record, provenance=False))
        for name, what in ((output, "record"), (report, "report")):
            if name:
                print(f"{what}: {name}")
    for message in record.warnings:
        (warn if message in record.verdict.reasons else note)(message)
