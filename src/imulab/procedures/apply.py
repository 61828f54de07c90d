"""Records and blobs to corrected recordings: the C core does the arithmetic, one dispatch over its sections.

Not named after its function: a submodule ``imulab.apply`` would take the place of ``imulab.apply()`` once imported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any

from imulab.device.blob import Blob
from imulab.device.unit import Unit
from imulab.errors import DataError, RecordError
from imulab.procedures.centrifuge.apply import apply_centrifuge, beyond_levels, highest_force
from imulab.procedures.device_tables import tables_of
from imulab.procedures.tumble.apply import apply_gyro, apply_tumble, beyond_test
from imulab.procedures.warmup.apply import apply_warmup, record_table, unchanged
from imulab.procedures.warmup.poweron import LATEST_START
from imulab.recording import Recording
from imulab.records.calibration import Calibration
from imulab.units import from_si
from imulab.verdict import SENTENCES, Note

_FAR_IN_TEMPERATURE = 20.0

_Correct = Callable[[Unit, Mapping[str, Any], Recording], Recording]
_APPLY: dict[str, _Correct] = {
    "tumble": apply_tumble,
    "gyro": apply_gyro,
    "centrifuge": apply_centrifuge,
    "warmup": apply_warmup,
}
_BEYOND = {"tumble": beyond_test, "centrifuge": beyond_levels}


@dataclass(frozen=True)
class Loaded:
    """A record or blob in the C core, ready to run.

    Attributes
    ----------
    unit
        Its tables in the C core.
    sections
        Each section's kind and columns, in the order of application.
    name
        What the corrected recording calls it.
    holds
        SHA-256 of the record; for a blob its own, then those of the records it was made from.
    again
        Whether it is applied to a recording that it corrected before.
    """

    unit: Unit
    sections: tuple[tuple[str, Mapping[str, Any]], ...]
    name: str
    holds: tuple[str, ...]
    again: bool = False


def loaded(
    record: Calibration | Blob, name: str | None = None, *, again: bool = False, latest_start: float = LATEST_START
) -> Loaded:
    """Return a record (in double) or a blob (with its floats) ready to run.

    Parameters
    ----------
    record
        What corrects a recording.
    name
        What the corrected recording calls it; procedure and serial number, or the blob's file, if not given.
    again
        Whether to correct a recording a second time.
    latest_start
        A recording that starts later after power-on is refused by a warm-up table, s.

    Raises
    ------
    RecordError
        There is nothing to apply in it, or it lacks a parameter.
    """

    def started(kind: str, columns: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
        return kind, {**columns, "latest_start": latest_start} if kind == "warmup" else columns

    if isinstance(record, Blob):
        # The table of an array is for `array fuse`; it leaves the other columns of a recording alone.
        sections = [
            started(str(section["kind"]), section) for section in record.text["sections"] if section["kind"] != "array"
        ]
        unknown = [kind for kind, _ in sections if kind not in _APPLY]
        if unknown:
            raise RecordError(f"{record.name}: a section {unknown[0]!r} cannot be applied to a recording")
        if not sections:
            raise RecordError(f"{record.name}: nothing in this blob corrects a recording; array fuse takes it")
        holds = (sha256(record.data).hexdigest(), *map(str, record.text.get("records", ())))
        return Loaded(Unit(record.data), tuple(sections), name or record.name, holds, again)
    if record.procedure == "gyro_array":
        raise RecordError("a gyro_array record cannot be applied: 'imulab array fuse --calibration' takes it")
    if record.procedure == "warmup":
        record_table(record)  # says in words what the core would refuse by a number
    tables = tables_of(record)
    known = name or f"{record.procedure} {record.sensor.get('serial', '')}".rstrip()
    corrections = tuple(started(table.kind, table.columns) for table in tables)
    return Loaded(Unit.of(*tables), corrections, known, (record.sealed()[0],), again)


def apply(record: Calibration | Blob | Loaded, recording: Recording, *, again: bool = False) -> Recording:
    """Return the recording corrected by a record; columns that it does not touch pass unchanged.

    The result names the record and its SHA-256 in `corrected_by`, which its file will hold. A recording that the same
    record corrected before is refused, unless `again`.

    Raises
    ------
    RecordError
        The record's procedure has nothing to apply here.
    UnitError
        The recording's unit cannot be converted to the record's.
    DataError
        The recording lacks the columns that the record corrects, or was corrected by this record already.
    """
    ready = record if isinstance(record, Loaded) else loaded(record, again=again)
    before = {entry.rpartition("sha256:")[2] for entry in recording.corrected_by}
    if not ready.again and before.intersection(ready.holds):
        raise DataError(
            f"{recording.name}: already corrected by {ready.name}: a second time would take its errors off twice; "
            "expected the recording as it was measured, or --again (again=True)"
        )
    corrected = recording
    for kind, columns in sections_for(ready.sections, recording):
        corrected = _APPLY[kind](ready.unit, columns, corrected)
    if corrected is recording:
        return recording
    return replace(corrected, corrected_by=(*recording.corrected_by, f"{ready.name} sha256:{ready.holds[0]}"))


def apply_blocks(records: Iterable[Calibration | Blob | Loaded], blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Correct consecutive blocks of a recording by several records in the order given.

    Raises
    ------
    DataError
        None of the records corrects anything in it; and what `apply` raises.
    """
    chain = [record if isinstance(record, Loaded) else loaded(record) for record in records]
    warm_up = any(kind == "warmup" for ready in chain for kind, _ in ready.sections)
    end = -math.inf
    for number, given in enumerate(blocks):
        if warm_up and given.time is not None and len(given):  # within a block `apply` looks itself
            if not given.time[0] > end:
                raise DataError(
                    f"{given.name}: {given.place(0)}, column time: time does not rise: expected more than {end:.9g} s, "
                    f"found {given.time[0]:.9g} s"
                )
            end = float(given.time[-1])
        block = given
        for ready in chain:
            block = apply(ready, block)
        if number == 0 and block is given:
            raise DataError(next(iter(_why_unchanged(chain, given)), f"{given.name}: nothing to correct in it"))
        yield block


def _why_unchanged(chain: Iterable[Loaded], recording: Recording) -> Iterator[str]:
    for ready in chain:
        for kind, columns in ready.sections:
            if kind == "warmup" and (message := unchanged(columns, recording)):
                yield message


def sections_for(
    sections: Iterable[tuple[str, Mapping[str, Any]]], recording: Recording
) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the sections that a recording has the columns for, where it has those of one triad of two."""
    absent = {kind for kind, triad in (("tumble", "accel"), ("gyro", "gyro")) if not _has_any(recording, triad)}
    kept = [section for section in sections if section[0] not in absent]
    return kept or list(sections)  # with nothing to correct, the section itself says which columns it expects


def _has_any(recording: Recording, triad: str) -> bool:
    return any(f"{triad}_{axis}" in recording for axis in "xyz")


def _missing_triad(record: Calibration | Blob, recording: Recording) -> list[str]:
    if isinstance(record, Blob):
        kinds = {str(section["kind"]) for section in record.text["sections"]}
    else:
        kinds = {"tumble", "gyro"} if "gyro_bias_x" in record.parameters else set()
    triads = {"accel": "accelerometers", "gyro": "gyroscopes"}
    absent = [triad for triad in triads if not _has_any(recording, triad)]
    if not {"tumble", "gyro"} <= kinds or len(absent) != 1:
        return []
    (there,) = triads.keys() - set(absent)
    return [Note(f"{recording.name}: no {triads[absent[0]]} in it: its {triads[there]} alone are corrected")]


def warnings_of(record: Calibration | Blob, recording: Recording) -> list[str]:
    """Return what a user should know about applying this record to this recording."""
    found = []
    if isinstance(record, Calibration) and record.verdict.state == "bad":
        found.append(f"the record's verdict is bad, {SENTENCES['bad']}: {record.verdict.reasons[0]}")
    sensor = record.text["sensor"] if isinstance(record, Blob) else record.sensor
    for key in ("serial", "element"):
        mine, its = sensor.get(key), recording.metadata.get(key)
        if mine and its and mine != its:
            found.append(f"{recording.name}: {key} {its}, but the record was made for {mine}")
    found += _missing_triad(record, recording)
    messages = []
    for columns in _warmup_columns(record):
        there = [axis for axis in columns["axes"] if axis in recording]
        if message := unchanged(columns, recording):
            messages.append(message)
        elif 0 < len(there) < len(columns["axes"]):
            absent = [axis for axis in columns["axes"] if axis not in there]
            messages.append(
                Note(
                    f"{recording.name}: no {' '.join(absent)} in it: {' '.join(there)} alone are corrected for warm-up"
                )
            )
    if isinstance(record, Blob) or record.procedure == "warmup":
        return [*found, *messages]
    made = record.model.get("temperature")
    here = recording.mean_temperature()
    if made is None or here is None or abs(here - made["value"]) <= _FAR_IN_TEMPERATURE:
        return found
    return [
        *found,
        f"{recording.name}: temperature {here:.1f} degC is {abs(here - made['value']):.0f} K away from the "
        f"{made['value']:.1f} degC at which the record was made",
    ]


def _warmup_columns(record: Calibration | Blob) -> list[Mapping[str, Any]]:
    """What the sections of the record's or blob's warm-up tables say of themselves."""
    if isinstance(record, Blob):
        return [section for section in record.text["sections"] if section["kind"] == "warmup"]
    return [table.columns for table in tables_of(record)] if record.procedure == "warmup" else []


def beyond_test_of(record: Calibration | Blob, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie far beyond what the record was made at, and the largest, m/s^2."""
    if isinstance(record, Blob):
        return 0, 0.0
    beyond = _BEYOND.get(record.procedure)
    return (0, 0.0) if beyond is None else beyond(record, recording)


def beyond_message(record: Calibration | Blob, count: int, largest: float) -> str:
    """Say that `count` samples, up to `largest`, m/s^2, lie beyond what the record was made at."""
    most = f"{from_si(largest, 'g'):.1f} g"
    if isinstance(record, Calibration) and record.procedure == "centrifuge":
        return (
            f"{count} samples beyond {from_si(highest_force(record), 'g'):.4g} g (up to {most}), the highest level "
            "of the record's test: K(a) is extrapolated there"
        )
    return f"{count} samples beyond 2 g (up to {most}): the record's nonlinearity was measured within 1 g"
