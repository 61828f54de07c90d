"""The registry of procedures; records loaded by the procedure that they name; a procedure's fit from files and texts.

No other module distinguishes procedures by name. A further procedure is a folder with a class, and a line here.
Commands and fleets share `run_task`, so that their parameters are equal to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imulab.errors import RecordError, file_name, readable
from imulab.files import open_file
from imulab.options import FLAG
from imulab.procedures.centrifuge.procedure import CentrifugeProcedure
from imulab.procedures.gyro_array.procedure import GyroArrayProcedure
from imulab.procedures.magnetometer.procedure import MagnetometerProcedure
from imulab.procedures.noise.procedure import NoiseProcedure
from imulab.procedures.procedure import Files, Procedure, Section
from imulab.procedures.rate.procedure import RateProcedure
from imulab.procedures.thermal.procedure import ThermalProcedure
from imulab.procedures.tumble.procedure import TumbleProcedure
from imulab.procedures.warmup.procedure import WarmupProcedure
from imulab.quantities import labelled
from imulab.records.calibration import Calibration

if TYPE_CHECKING:
    from imulab.device.unit import Blob

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
        MagnetometerProcedure(),
    )
}
"""The procedures by their names on the command line and in manifests of fleets."""


def procedure_of(record: Calibration) -> Procedure:
    """Return the procedure that made a record.

    Raises
    ------
    RecordError
        There is no such procedure.
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


# Records and blobs from their files; a record is checked by the procedure that it names.


_LARGEST = 1 << 28
"""Most bytes of a file that are read as a record."""


def load(path: str | Path) -> Calibration:
    """Read a calibration record.

    Raises
    ------
    RecordError
        The file is missing, is no record, is of a newer version, was altered, or lacks something.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_tumble(il.simulate_tumble(gravity=9.81), gravity=9.81)
    >>> fit.save("sn42.json")
    >>> il.load("sn42.json").procedure
    'tumble'
    """
    return load_sealed(path)[0]


def load_sealed(path: str | Path) -> tuple[Calibration, str]:
    """Return a calibration record and its ``content_sha256``; errors as for `load`."""
    with readable(path, RecordError, ".json"), open_file(file_name(path)) as stream:
        data = stream.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise RecordError(f"{path}: more than {_LARGEST >> 20} MiB; expected a record, of some kilobytes")
    return loads_sealed(data, str(path))


def loads(data: bytes, name: str) -> Calibration:
    """Return a calibration record from the bytes of its file; errors as for `load`."""
    return loads_sealed(data, name)[0]


def load_any(path: str | Path) -> Calibration | Blob:
    """Return a record or a blob from its file; errors as for `load` and `load_blob`."""
    from imulab.device.unit import is_blob, load_blob

    return load_blob(path) if is_blob(path) else load(path)


def loads_sealed(data: bytes, name: str) -> tuple[Calibration, str]:
    """Return a record from the bytes of its file, and its ``content_sha256``; errors as for `load`."""
    from imulab.records.reading import parsed

    record, seal = parsed(data, name)
    try:
        for procedure in PROCEDURES.values():
            if procedure.name == record.procedure:
                procedure.check(record)
    except RecordError as error:
        raise RecordError(f"{name}: {error}") from None
    return record, seal


# A procedure's fit from files and the texts of its options, for commands and fleets.


def _silent(_: int) -> None:
    pass


def _text(value: str | bool) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else value


def run_task(
    name: str,
    files: Sequence[str],
    options: Mapping[str, Any],
    access: Files,
    *,
    label: str = FLAG,
    progress: Callable[[int], None] = _silent,
) -> Calibration:
    """Return the record of one unit's fit; `options` are texts, truth values of switches, or None.

    An error in a record that an option names, ``prior: ...``, is raised with the name of its file.

    Raises
    ------
    ImulabError
        What the procedure's fit, its readers and its options raise.
    """
    task = PROCEDURES[name].task
    texts = {key.rstrip("_"): _text(value) for key, value in options.items() if value is not None}
    values = task.values(texts, label)
    with labelled(label, options):
        try:
            return task.fit(files, values, access, progress)
        except RecordError as error:
            file = options.get(str(error).partition(":")[0])
            if file is None:
                raise
            raise RecordError(f"{file}: {error}") from None
