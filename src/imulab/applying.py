"""Records and blobs to corrected recordings: the C core does the arithmetic, one dispatch over its sections.

Not named after its function: a submodule ``imulab.apply`` would take the place of ``imulab.apply()`` once imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

from imulab.blob import Blob
from imulab.calibration import Calibration
from imulab.errors import RecordError
from imulab.recording import Recording
from imulab.runtime import Unit
from imulab.tables import tables_of
from imulab.tumble.apply import apply_gyro, apply_tumble, beyond_test

_FAR_IN_TEMPERATURE = 20.0

_Correct = Callable[[Unit, Mapping[str, Any], Recording], Recording]
_APPLY: dict[str, _Correct] = {"tumble": apply_tumble, "gyro": apply_gyro}
_PROCEDURES = ("tumble",)


@dataclass(frozen=True)
class Loaded:
    """A record or blob in the C core, ready to run: each section's kind and columns, in the order of application."""

    unit: Unit
    sections: tuple[tuple[str, Mapping[str, Any]], ...]


def loaded(record: Calibration | Blob) -> Loaded:
    """Return a record (in double) or a blob (with its floats) ready to run.

    Raises
    ------
    RecordError
        There is nothing to apply in it, or it lacks a parameter.
    """
    if isinstance(record, Blob):
        sections = [(str(section["kind"]), section) for section in record.text["sections"]]
        unknown = [kind for kind, _ in sections if kind not in _APPLY]
        if unknown:
            raise RecordError(f"{record.name}: a section {unknown[0]!r} cannot be applied to a recording")
        return Loaded(Unit(record.data), tuple(sections))
    if record.procedure not in _PROCEDURES:
        known = " ".join(_PROCEDURES)
        raise RecordError(f"a {record.procedure} record cannot be applied; known procedures: {known}")
    tables = tables_of(record)
    return Loaded(Unit.of(*tables), tuple((table.kind, table.columns) for table in tables))


def apply(record: Calibration | Blob | Loaded, recording: Recording) -> Recording:
    """Return the recording corrected by a record; columns that it does not touch pass unchanged.

    Raises
    ------
    RecordError
        The record's procedure has nothing to apply here.
    UnitError
        The recording's unit cannot be converted to the record's.
    DataError
        The recording lacks the columns that the record corrects.
    """
    ready = record if isinstance(record, Loaded) else loaded(record)
    for kind, columns in ready.sections:
        recording = _APPLY[kind](ready.unit, columns, recording)
    return recording


def apply_blocks(records: Iterable[Calibration | Blob], blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Correct consecutive blocks of a recording by several records in the order given."""
    chain = [loaded(record) for record in records]
    for block in blocks:
        for ready in chain:
            block = apply(ready, block)
        yield block


def warnings_of(record: Calibration | Blob, recording: Recording) -> list[str]:
    """Return what a user should know about applying this record to this recording."""
    found = []
    sensor = record.text["sensor"] if isinstance(record, Blob) else record.sensor
    mine, its = sensor.get("serial"), recording.metadata.get("serial")
    if mine and its and mine != its:
        found.append(f"{recording.name}: serial {its}, but the record was made for {mine}")
    made = None if isinstance(record, Blob) else record.model.get("temperature")
    here = recording.mean_temperature()
    if made is None or here is None or abs(here - made["value"]) <= _FAR_IN_TEMPERATURE:
        return found
    return [
        *found,
        f"{recording.name}: temperature {here:.1f} degC is {abs(here - made['value']):.0f} K away from the "
        f"{made['value']:.1f} degC at which the record was made",
    ]


def identity(record: Calibration | Blob) -> str:
    """Return what two copies of one record or blob share."""
    return sha256(record.data).hexdigest() if isinstance(record, Blob) else record.to_dict()["content_sha256"]


def beyond_test_of(record: Calibration | Blob, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie far beyond what the record was made at, and the largest, m/s^2."""
    if isinstance(record, Blob) or record.procedure != "tumble":
        return 0, 0.0
    return beyond_test(record, recording)
