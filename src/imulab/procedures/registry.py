"""The registry: the procedures, with all that the rest of the package asks of them.

Nobody else tells procedures apart by name. A further procedure is a folder with a class, and a line here.
"""

from __future__ import annotations

from collections.abc import Iterator

from imulab.errors import RecordError
from imulab.procedures.centrifuge.entry import CentrifugeProcedure
from imulab.procedures.gyro_array.entry import GyroArrayProcedure
from imulab.procedures.noise.entry import NoiseProcedure
from imulab.procedures.procedure import Procedure, Section
from imulab.procedures.rate.entry import RateProcedure
from imulab.procedures.thermal.entry import ThermalProcedure
from imulab.procedures.tumble.entry import TumbleProcedure
from imulab.procedures.warmup.entry import WarmupProcedure
from imulab.records.calibration import Calibration

PROCEDURES: dict[str, Procedure] = {
    procedure.command: procedure
    for procedure in (
        TumbleProcedure(),
        GyroArrayProcedure(),
        WarmupProcedure(),
        CentrifugeProcedure(),
        NoiseProcedure(),
        ThermalProcedure(),
        RateProcedure(),
    )
}
"""By the names of the command line and of fleets' manifests."""


def procedure_of(record: Calibration) -> Procedure:
    """Return the procedure that made a record.

    Raises
    ------
    RecordError
        It is not known.
    """
    for procedure in PROCEDURES.values():
        if procedure.name == record.procedure:
            return procedure
    known = " ".join(procedure.name for procedure in PROCEDURES.values())
    raise RecordError(f"unknown procedure {record.procedure!r}; known procedures: {known}")


def joined_of(record: Calibration) -> list[Procedure]:
    """Return the other procedures whose results a record holds beside its own."""
    others = (procedure for procedure in PROCEDURES.values() if procedure.joins and procedure.name != record.procedure)
    return [procedure for procedure in others if procedure.name in record.fit]


def sections() -> Iterator[Section]:
    """Yield every kind of section that a unit's tables can have."""
    for procedure in PROCEDURES.values():
        yield from procedure.sections


def section(kind: str) -> Section | None:
    """Return a kind of section, None where no procedure has it."""
    return next((known for known in sections() if known.kind == kind), None)
