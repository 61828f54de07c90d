"""What a worker does with one unit: nothing if its record is there, else fit and write, and say how it went."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from imulab.atomic_write import write_text
from imulab.errors import ImulabError
from imulab.fleet.manifest import FleetUnit
from imulab.fleet.sources import UnitFiles
from imulab.fleet.store import MOST_ATTEMPTS, Store, request_of
from imulab.procedures.procedure import OnLine
from imulab.procedures.registry import PROCEDURES
from imulab.procedures.run import run_task
from imulab.records.calibration import Calibration, Parameter
from imulab.verdict import UNJUDGED, Note, Verdict

DONE, KEPT, FAILED, LEFT = "done", "kept", "failed", "left"
"""Made now; there already; refused, with a reason; not touched, because another run has taken over."""


@dataclass(frozen=True)
class Job:
    """What all units of a run share: the folder of the records, the base of the manifest's paths, the run's token.

    Without a folder the records are sent back.
    """

    folder: str | None
    base: str
    token: str


@dataclass(frozen=True)
class Summary:
    """What a run, its table and its history need to know of a record.

    `inputs` are the hashes of its files; `freedom` the degrees of freedom of its uncertainties, None where the noise
    was known; `on_line` is what its own parameters are about, where that differs from record to record.
    """

    serial: str
    procedure: str
    created: str
    date: str | None
    software: str
    content_sha256: str
    inputs: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    warnings: tuple[str, ...]
    freedom: float | None
    verdict: Verdict = UNJUDGED
    on_line: OnLine | None = None

    @property
    def when(self) -> str:
        """Date of the recording where its head states one, otherwise that of the record."""
        return self.date or self.created


@dataclass(frozen=True)
class Outcome:
    """How one unit went; `text` is the record where the worker does not see the folder."""

    serial: str
    status: str
    reason: str = ""
    summary: Summary | None = None
    text: str | None = field(default=None, repr=False)


def work(unit: FleetUnit, job: Job) -> Outcome:
    """Make the record of one unit, unless it is there already and was made from the same files and options."""
    if job.folder is None:
        return _fit(unit, job, None)
    store = Store(Path(job.folder))
    with store.turn(job.token) as mine:
        if mine is False:
            return Outcome(unit.serial, LEFT)
        if mine is None:
            return _fit(unit, job, None)
        if store.begin(unit.serial) >= MOST_ATTEMPTS:
            reason = f"its process ended {MOST_ATTEMPTS} times while it worked on this unit (killed, or out of memory)"
            outcome = Outcome(unit.serial, FAILED, reason)
        else:
            outcome = _fit(unit, job, store)
        if outcome.status == FAILED:
            store.fail(unit, outcome.reason)
        store.end(unit.serial)
        return outcome


def _fit(unit: FleetUnit, job: Job, store: Store | None) -> Outcome:
    try:
        with UnitFiles(job.base) as files:
            if store is not None:
                there = store.made_for(unit)
                if there is not None and files.unchanged(there[0].sections["fleet"].get("inputs", ())):
                    return Outcome(unit.serial, KEPT, summary=summarise(*there))
            record = make_record(unit, files)
        content_sha256, text = record.sealed()
        if store is not None:
            write_text(store.record(unit.serial), text)
        summary = summarise(record, content_sha256)
        return Outcome(unit.serial, DONE, summary=summary, text=None if store is not None else text)
    except ImulabError as error:
        return Outcome(unit.serial, FAILED, _one_line(str(error)))
    except Exception as error:
        if os.environ.get("IMULAB_DEBUG"):
            raise
        return Outcome(unit.serial, FAILED, _one_line(f"{type(error).__name__}: {error} (a fault of imulab)"))


def make_record(unit: FleetUnit, files: UnitFiles) -> Calibration:
    """Fit a unit as the single command does, and add what it was made from."""
    record = run_task(unit.procedure, unit.files, unit.options, files, label="column {}")
    others = [serial for serial in files.serials if serial != unit.serial]
    says = [
        Note(f"the file states serial {serial!r}, the manifest {unit.serial!r}: the manifest's is used")
        for serial in others
    ]
    made = {
        **request_of(unit),
        "inputs": [{"file": name, "sha256": sha256} for name, sha256 in files.inputs.items()],
        **({} if files.date is None else {"date": files.date}),
    }
    return replace(
        record,
        sensor={**record.sensor, "serial": unit.serial},
        warnings=(*record.warnings, *says),
        sections={**record.sections, "fleet": made},
    )


def summarise(record: Calibration, content_sha256: str) -> Summary:
    """Return what table and history need of a record that `make_record` has made."""
    made = record.sections["fleet"]
    on_line = PROCEDURES[made["procedure"]].on_line(record)
    return Summary(
        serial=record.sensor["serial"],
        procedure=made["procedure"],
        created=record.created,
        date=made.get("date"),
        software=record.software,
        content_sha256=content_sha256,
        inputs=tuple(item["sha256"] for item in made["inputs"]),
        parameters={**record.parameters, **({} if on_line is None else on_line.parameters)},
        warnings=record.warnings,
        freedom=_freedom(record) if on_line is None else on_line.freedom,
        verdict=record.verdict,
        on_line=on_line,
    )


def _freedom(record: Calibration) -> float | None:
    freedom = record.fit.get("degrees_of_freedom")
    estimated = str(record.fit.get("noise", "known")).startswith("estimated")
    return float(freedom) if estimated and isinstance(freedom, int | float) and freedom > 0 else None


def _one_line(text: str) -> str:
    return " ".join(text.split())
