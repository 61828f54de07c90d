"""The registry: one entry per procedure, with all that the rest of the package asks of it.

Nobody else tells procedures apart by name. A further procedure is a folder with an entry, and a line here.
"""

from __future__ import annotations

from collections.abc import Iterator

from imulab.errors import RecordError
from imulab.procedures.centrifuge.entry import ENTRY as CENTRIFUGE
from imulab.procedures.gyro_array.entry import ENTRY as GYRO_ARRAY
from imulab.procedures.noise.entry import ENTRY as NOISE
from imulab.procedures.procedure import Procedure, Section
from imulab.procedures.rate.entry import ENTRY as RATE
from imulab.procedures.thermal.entry import ENTRY as THERMAL
from imulab.procedures.tumble.entry import ENTRY as TUMBLE
from imulab.procedures.warmup.entry import ENTRY as WARMUP
from imulab.records.calibration import Calibration

PROCEDURES: dict[str, Procedure] = {
    entry.command: entry for entry in (TUMBLE, GYRO_ARRAY, WARMUP, CENTRIFUGE, NOISE, THERMAL, RATE)
}
"""By the names of the command line and of fleets' manifests."""


def procedure_of(record: Calibration) -> Procedure:
    """Return the procedure that made a record.

    Raises
    ------
    RecordError
        It is not known.
    """
    for entry in PROCEDURES.values():
        if entry.name == record.procedure:
            return entry
    known = " ".join(entry.name for entry in PROCEDURES.values())
    raise RecordError(f"unknown procedure {record.procedure!r}; known procedures: {known}")


def joined_of(record: Calibration) -> list[Procedure]:
    """Return the other procedures whose results a record holds beside its own."""
    others = (entry for entry in PROCEDURES.values() if entry.joined is not None and entry.name != record.procedure)
    return [entry for entry in others if entry.name in record.fit]


def sections() -> Iterator[Section]:
    """Yield every kind of section that a unit's tables can have."""
    for entry in PROCEDURES.values():
        yield from entry.sections


def section(kind: str) -> Section | None:
    """Return a kind of section, None where no procedure has it."""
    return next((known for known in sections() if known.kind == kind), None)
