"""Calibration records from their files, each checked by the procedure that it names; records and blobs alike."""

from __future__ import annotations

from pathlib import Path

from imulab.device.blob import Blob, is_blob, load_blob
from imulab.errors import RecordError, file_name, readable
from imulab.procedures.registry import PROCEDURES
from imulab.records.calibration import Calibration
from imulab.records.reading import parsed


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
    """Read a calibration record and its ``content_sha256``; errors as for `load`."""
    with readable(path, RecordError):
        data = Path(file_name(path)).read_bytes()
    return loads_sealed(data, str(path))


def loads(data: bytes, name: str) -> Calibration:
    """Read a calibration record from the bytes of its file; errors as for `load`."""
    return loads_sealed(data, name)[0]


def load_any(path: str | Path) -> Calibration | Blob:
    """Read a record or a blob; errors as for `load` and `load_blob`."""
    return load_blob(path) if is_blob(path) else load(path)


def loads_sealed(data: bytes, name: str) -> tuple[Calibration, str]:
    """Return a record from the bytes of its file, and its ``content_sha256``; errors as for `load`."""
    record, seal = parsed(data, name)
    try:
        for procedure in PROCEDURES.values():
            if procedure.name == record.procedure:
                procedure.check(record)
    except RecordError as error:
        raise RecordError(f"{name}: {error}") from None
    return record, seal
