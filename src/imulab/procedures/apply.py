"""Records and blobs to corrected recordings: the C core does the arithmetic with the tables of a unit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from os import PathLike, fspath
from pathlib import Path
from typing import Annotated, Any, Unpack

import numpy as np

from imulab.columns import INERTIAL, KINDS, kind_of, triad
from imulab.device.tables import DeviceTable, Fusion
from imulab.device.unit import Blob, DeviceUnit
from imulab.display import SENTENCES, Note
from imulab.errors import DataError, ImulabError, OptionError, RecordError, first_of, listed
from imulab.estimation.likely_unit import MOST_SAMPLES, doubt_by_correction, doubt_rates
from imulab.estimation.sampling import whole_where_shared
from imulab.options import choice, measure
from imulab.procedures.correction_order import (
    Correction,
    check_after,
    check_once,
    check_order,
    name_correction,
    parse_thermals,
)
from imulab.procedures.procedure import Procedure, Section
from imulab.procedures.registry import joined_of, load_any, procedure_of, section
from imulab.procedures.result import Record, as_read, as_record
from imulab.quantities import in_si
from imulab.recording import Data, Reading, Recording, with_power_on_temperature
from imulab.records.calibration import Calibration, warn_other_unit
from imulab.records.sections import Quantity, read

# The tables of a unit: the numbers of its records as the C core's structs, in the order of their application.


def tables_of(record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
    """Return the tables of a record, in the order in which they are applied.

    An array fuses by `fusion`, or as its record states where that is None.

    Raises
    ------
    RecordError
        The record lacks a parameter or has one that cannot be.
    """
    return procedure_of(record).tables(record, fusion)


def tables_of_all(
    records: Sequence[Calibration], fusions: Sequence[Fusion | None] = (), files: Sequence[str] = ()
) -> list[DeviceTable]:
    """Return the tables of several records of one unit, in their order.

    Each is fused by its entry of `fusions`, or as it states where that is None or there are none. The columns of each
    table hold the SHA-256 of its record, so that a blob names the records that are in it. Refusals name the records by
    `files`, or by procedure and serial number where that is empty.

    Raises
    ------
    RecordError
        Two records give the same section, are of different units, or would correct one error twice or out of turn.
    """
    serials = {serial: None for record in records if (serial := record.sensor.get("serial"))}
    if len(serials) > 1:
        raise RecordError(f"records of different units: {' '.join(serials)}; expected those of one")
    named_tables = [
        (file or _name(record), replace(table, columns={**table.columns, "record": record.sealed()[0]}))
        for record, fusion, file in zip(
            records, fusions or [None] * len(records), files or [""] * len(records), strict=True
        )
        for table in tables_of(record, fusion)
    ]
    tables = [table for _, table in named_tables]
    kinds = [table.kind for table in tables]
    check_order(kinds)
    check_once((name, table.kind, table.columns) for name, table in named_tables)
    if twice := next((kind for kind in kinds if kinds.count(kind) > 1), None):
        names = " and ".join(name for name, table in named_tables if table.kind == twice)
        raise RecordError(f"{names} each give a table of kind {twice}; a unit has one: give one of them")
    check_after((table.kind, table.columns, (table.columns["record"],)) for table in tables)
    return tables


# Correction of recordings.


_FAR_IN_TEMPERATURE = 20.0  # K between calibration and use, from which there is a warning of drifted biases


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
        Its name in the corrected recording.
    holds
        SHA-256 of the record; for a blob its own, then those of the records it was made from.
    again
        Whether it may be applied to a recording that it, or another of the same errors, corrected before.
    further
        Function that adds columns to the corrected recording; None where there is none.
    """

    unit: DeviceUnit
    sections: tuple[tuple[Section, Mapping[str, Any]], ...]
    name: str
    holds: tuple[str, ...]
    again: bool = False
    further: Callable[[Recording], Recording] | None = None


def loaded(record: Calibration | Blob, name: str | None = None, *, again: bool = False, **columns: Any) -> Loaded:
    """Return a record (in double) or a blob (with its floats) ready to run.

    Parameters
    ----------
    record
        The record or blob.
    name
        Its name in the corrected recording; procedure and serial number, or the blob's file, if not given.
    again
        Whether it may correct a recording a second time.
    columns
        Options of the sections: `latest_start` (a recording that starts later after power-on is refused by a warm-up
        table, s).

    Raises
    ------
    RecordError
        There is nothing to apply in it, or it lacks a parameter.
    """
    if isinstance(record, Blob):
        entries = [(str(entry["kind"]), entry) for entry in record.text["sections"]]
        known = [(section(kind), {**entry, **columns}) for kind, entry in entries]
        unknown = [kind for (kind, _), (known_section, _) in zip(entries, known, strict=True) if known_section is None]
        if unknown:
            raise RecordError(f"{record.name}: a section {unknown[0]!r} cannot be applied to a recording")
        # The table of an array, or of whole IMUs, is for `array fuse`, and corrects no columns.
        chain = tuple(
            (known_section, entry)
            for known_section, entry in known
            if known_section is not None and known_section.corrects
        )
        if not chain:
            whole = " --imus" if any(kind == "imus" for kind, _ in entries) else ""
            raise RecordError(f"{record.name}: nothing in this blob corrects a recording; array fuse{whole} takes it")
        holds = (sha256(record.data).hexdigest(), *map(str, record.text.get("records", ())))
        return Loaded(DeviceUnit(record.data), chain, name or record.name, holds, again)
    made_by = procedure_of(record)
    if made_by.not_applied:
        raise RecordError(f"a {record.procedure} record cannot be applied: {made_by.not_applied}")
    tables = tables_of(record)
    chain = tuple((made_by.section(table.kind), {**table.columns, **columns}) for table in tables)
    return Loaded(DeviceUnit.of(*tables), chain, name or _name(record), (record.sealed()[0],), again)


def _name(record: Calibration) -> str:
    return f"{record.procedure} {record.sensor.get('serial', '')}".rstrip()


HEADINGS = ("no", "magnetic", "true")


def heading_kind(value: bool | str, name: str = "heading") -> str:
    """Return ``magnetic`` or ``true``, empty for no heading; refuses other words."""
    if isinstance(value, str) and value not in HEADINGS:
        raise OptionError(f"{name} {value!r}: expected one of {listed(HEADINGS, value)}")
    return {True: "magnetic", False: "", "no": ""}.get(value, str(value))


def add_heading(chain: Sequence[Loaded], records: Sequence[Calibration | Blob], kind: str = "magnetic") -> list[Loaded]:
    """Return the chain, in which the last record with magnetometers adds heading, of a `kind`, and dip.

    Raises
    ------
    RecordError
        None of the records holds accelerometers and magnetometers.
    """
    extended, why = list(chain), ""
    for index in reversed(range(len(records))):
        record = records[index]
        if isinstance(record, Blob) or not procedure_of(record).has_heading:
            other = "a blob" if isinstance(record, Blob) else f"a {record.procedure} record"
            why = why or f"{extended[index].name}: heading needs a record with magnetometers, found {other}"
            continue
        try:
            extended[index] = replace(
                extended[index], further=procedure_of(record).heading(record, true=kind == "true")
            )
        except RecordError as error:
            why = f"{extended[index].name}: {error}"
            continue
        return extended
    raise RecordError(why)


def apply(
    record: Record | Blob | Loaded,
    data: Data,
    *,
    again: bool = False,
    latest_start: Annotated[float | str, measure("time", "s")] = "5 s",
    temperature_column: bool = False,
    heading: Annotated[bool | str, choice(HEADINGS, bare="magnetic")] = False,
    **reading: Unpack[Reading],
) -> Recording:
    """Return data corrected by a record; columns that it does not touch pass unchanged.

    The result names the record and its SHA-256 in `corrected_by`, which its file will hold; of a blob these are its own
    and those of the records in it. A recording that the same record corrected before is refused, unless `again`. Its
    `notes` say what the command warns of: a record whose verdict is *bad*, or of another unit or temperature, a triad
    that is missing, accelerometers that are probably in another unit than stated, and other records that corrected the
    recording's file, whose errors are not known; samples beyond the range of the record's test, infinite ones, and
    columns without a number.

    Parameters
    ----------
    record
        A record, a blob, or the file of one.
    data
        What is corrected: a file, recording, data frame or arrays.
    again
        Correct a recording that a record corrected before. The same record, or another of the same errors.
    latest_start
        Refuse a recording that starts later after power-on (warm-up). In s.
    temperature_column
        Take a missing power-on temperature from the first row's column temperature (warm-up).
    heading
        Add columns of magnetic or true heading and dip, deg, with uncertainties. Columns ``heading`` (of the body's x
        axis, clockwise from magnetic north; with ``"true"`` from true north, by the declination of the record's place),
        ``std_heading``, ``dip`` and ``std_dip`` of a unit at rest, with standard uncertainties by the record's
        covariance, the scatter of its attitudes, and the acceleration that shows where ``|f|`` is off g by more than
        1 %.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window`, `element`.

    Raises
    ------
    RecordError
        The record's procedure has nothing to apply here, another record took off the same errors before, it is a
        warm-up record of cycles that another thermal record had corrected than the recording, or `heading` is asked of
        one without magnetometers.
    UnitError
        The recording's unit cannot be converted to the record's.
    DataError
        The recording lacks the columns that the record corrects, was corrected by this record already, or nothing in
        it is to be corrected, such as after a warm-up.

    Examples
    --------
    >>> import imulab as il
    >>> recording = il.simulate_tumble(gravity=9.81)
    >>> record = il.fit_tumble(recording, order=1, gravity=9.81).calibration
    >>> truth = recording.column("truth_accel_x")
    >>> [round(abs(float((r.column("accel_x") - truth).mean())), 1) for r in (recording, il.apply(record, recording))]
    [0.4, 0.0]
    """
    name = None
    if isinstance(record, str | PathLike):
        name = Path(record).name
        record = load_any(fspath(record))
    if not isinstance(record, Blob | Loaded):
        record = as_record(record, "apply")
    recording = as_read(data, reading, apply)
    if isinstance(record, Loaded):
        ready = record
    else:
        ready = loaded(record, name, again=again, latest_start=in_si(latest_start, "latest_start", "time", "s"))
    if kind := heading_kind(heading):
        if isinstance(record, Loaded):
            raise OptionError("heading: expected a record, found one that was loaded without")
        (ready,) = add_heading([ready], [record], kind)
    before = {each.rpartition("sha256:")[2] for each in recording.corrected_by}
    if not ready.again and before.intersection(ready.holds):
        raise DataError(
            f"{recording.name}: already corrected by {ready.name}: a second time would take its errors off twice; "
            "expected the recording as it was measured, or --again (again=True)"
        )
    if temperature_column and any(part.since_power_on for part, _ in ready.sections):
        (recording,) = with_power_on_temperature([recording])
    check_after(
        ((part.kind, columns, ready.holds) for part, columns in ready.sections), parse_thermals(recording.corrected_by)
    )
    chosen = select_sections(ready.sections, recording)
    active = [(part.kind, columns) for part, columns in chosen if part.unchanged(columns, recording) is None]
    if not ready.again:
        instead = ", or --again (again=True) if the second was made of what the first left"
        check_once(((ready.name, *each) for each in active), recording.corrected_by, instead)
    corrected = recording
    for part, columns in chosen:
        corrected = part.apply(ready.unit, columns, corrected)
    if ready.further is not None:
        corrected = ready.further(corrected)
    if corrected is recording:
        if not isinstance(record, Loaded):  # a block of a chain may pass as it is
            why = next(iter(_explain_unchanged([ready], recording)), f"{recording.name}: nothing to correct in it")
            raise DataError(why)
        return recording
    notes = corrected.notes
    if not isinstance(record, Loaded):  # the command line says it of the first block
        earlier = map(Note, list_earlier(recording))  # as it may have to be: a later fit is not doubted for it
        doubts = [*warn_before_applying(record, recording), *warn_of_unit(ready, recording)]
        samples = DoubtfulSamples([record], [ready])
        samples.add(recording)
        notes = tuple(dict.fromkeys([*notes, *doubts, *earlier, *samples.warnings()]))
    by = (*recording.corrected_by, *_name_corrections(ready, active))
    return replace(corrected, corrected_by=by, notes=notes)


def _name_corrections(ready: Loaded, active: Sequence[tuple[str, Mapping[str, Any]]]) -> Iterator[Correction]:
    """Yield a line of `corrected_by` for each record; for a blob one for itself, then one for each record in it.

    `active` are the sections that corrected something: kind and columns.
    """
    made = [(columns.get("record", ready.holds[0]), part.kind) for part, columns in ready.sections]
    for digest in dict.fromkeys((ready.holds[0], *(digest for digest, _ in made))):
        line = name_correction(ready.name, digest, [kind for source, kind in made if source == digest])
        yield Correction(line, active)


def apply_blocks(records: Iterable[Calibration | Blob | Loaded], blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Yield consecutive blocks of a recording corrected by several records in their order.

    Raises
    ------
    DataError
        None of the records corrects anything in it; and what `apply` raises.
    """
    chain = [record if isinstance(record, Loaded) else loaded(record) for record in records]
    check_order([part.kind for ready in chain for part, _ in ready.sections])
    since_power_on = any(part.since_power_on for ready in chain for part, _ in ready.sections)
    end = -math.inf
    for number, raw in enumerate(whole_where_shared(blocks) if since_power_on else blocks):
        if since_power_on and raw.time is not None and len(raw):  # within a block `apply` looks itself
            if raw.time[0] < end:
                raise DataError(
                    f"{raw.name}: {raw.place(0)}, column time: time does not rise: expected more than {end:.9g} s, "
                    f"found {raw.time[0]:.9g} s"
                )
            end = float(raw.time[-1])
        block = raw
        for ready in chain:
            block = apply(ready, block)
        if number == 0 and block is raw:
            raise DataError(next(iter(_explain_unchanged(chain, raw)), f"{raw.name}: nothing to correct in it"))
        yield block


def _explain_unchanged(chain: Iterable[Loaded], recording: Recording) -> Iterator[str]:
    """Yield the reason of each section that does not correct a recording."""
    for ready in chain:
        for part, columns in ready.sections:
            if message := part.unchanged(columns, recording):
                yield message


def select_sections(
    sections: Sequence[tuple[Section, Mapping[str, Any]]], recording: Recording
) -> Sequence[tuple[Section, Mapping[str, Any]]]:
    """Return the sections of which a recording has columns; all of them where it has none."""
    kept = [part for part in sections if not part[0].triad or _has_any(recording, part[0].triad)]
    return kept or sections  # each section then names the columns that it expects


def _has_any(recording: Recording, sensor: str) -> bool:
    return any(name in recording for name in triad(sensor))


def _list_sections(record: Calibration | Blob) -> list[tuple[Section | None, Mapping[str, Any]]]:
    """Return the sections of a record or blob, each with the properties of its columns."""
    if isinstance(record, Blob):
        return [(section(str(entry["kind"])), entry) for entry in record.text["sections"]]
    if procedure_of(record).not_applied:
        return []
    return [(section(table.kind), table.columns) for table in tables_of(record)]


def warn_before_applying(record: Calibration | Blob, recording: Recording) -> list[str]:
    """Return warnings about applying a record to a recording: verdict, other unit, missing triads, temperature."""
    messages = []
    if isinstance(record, Calibration) and record.verdict.state == "bad":
        messages.append(f"the record's verdict is bad, {SENTENCES['bad']}: {record.verdict.reasons[0]}")
    messages += warn_other_unit(record.sensor, recording)
    parts = [(part, columns) for part, columns in _list_sections(record) if part is not None]
    triads = [part.triad for part, _ in parts if part.triad]
    absent = [triad for triad in triads if not _has_any(recording, triad)]
    if absent and len(absent) < len(triads):
        there = " and ".join(KINDS[triad].sensors for triad in triads if triad not in absent)
        missing = " and ".join(KINDS[triad].sensors for triad in absent)
        messages.append(Note(f"{recording.name}: no {missing} in it: its {there} alone are corrected"))
    for part, columns in parts:
        messages += part.remarks(columns, recording)
    stated = None if isinstance(record, Blob) else record.model.get("temperature")
    here = recording.mean_temperature()
    if stated is None or here is None:
        return messages
    made = read(Quantity, stated, "model.temperature").value
    if abs(here - made) > _FAR_IN_TEMPERATURE:
        messages.append(
            f"{recording.name}: temperature {here:.1f} degC is {abs(here - made):.0f} K away from the {made:.1f} degC "
            "at which the record was made"
        )
    return messages


def list_earlier(recording: Recording) -> list[str]:
    """Return a sentence on each correction before a recording was read; `check_once` knows what later ones were."""
    return [f"was corrected before, by {line}" for line in recording.corrected_by if not isinstance(line, Correction)]


def warn_of_unit(ready: Loaded, recording: Recording) -> list[str]:
    """Return warnings where sensors that a record corrects are probably in another unit than stated."""
    sections = [each for each in select_sections(ready.sections, recording) if each[0].triad in ("accel", "gyro")]
    if not sections or not len(recording) or not all(name in recording for name in triad("accel")):
        return []
    doubts, (part, columns) = [], sections[0]
    if part.triad == "accel":
        doubts.append(doubt_by_correction(recording, lambda scaled: part.apply(ready.unit, columns, scaled)))
    if sections[-1][0].triad == "gyro" and all(name in recording for name in triad("gyro")):
        head = {name: values[:MOST_SAMPLES] for name, values in recording.columns.items()}
        corrected = replace(recording, columns=head)
        for each, its in sections:
            corrected = each.apply(ready.unit, its, corrected)
        doubts.append(doubt_rates(corrected))
    return [doubt for doubt in doubts if doubt]


class DoubtfulSamples:
    """Samples of a recording that records correct by extrapolation, or not at all, counted over its blocks."""

    def __init__(self, records: Iterable[Calibration | Blob], chain: Iterable[Loaded]) -> None:
        self._tests = list_results(records)
        self._beyond, self._largest = [0] * len(self._tests), [0.0] * len(self._tests)
        triads = {part.triad for ready in chain for part, _ in ready.sections}
        self._sensors = {*INERTIAL, "mag"} if "" in triads else triads
        self._name, self._rows = "", 0
        self._finite: dict[str, bool] = {}
        self._infinite: dict[str, tuple[str, int]] = {}

    def add(self, block: Recording) -> None:
        """Take in the next block, as it was measured."""
        self._name, self._rows = block.name, self._rows + len(block)
        for index, (record, procedure) in enumerate(self._tests):
            try:
                here, most = procedure.beyond(record, block)
            except ImulabError:  # what only an earlier record of the chain makes usable; apply itself refuses the rest
                continue
            self._beyond[index] += here
            self._largest[index] = max(self._largest[index], most)
        for column, values in block.columns.items():
            if kind_of(column) not in self._sensors:
                continue
            self._finite[column] = self._finite.get(column, False) or bool(np.isfinite(values).any())
            if (infinite := np.flatnonzero(np.isinf(values))).size:
                row = infinite[0]
                message = f"{block.place(row)}, column {column}: expected a number, found {values[row]}"
                first, count = self._infinite.get(column, (message, 0))
                self._infinite[column] = first, count + infinite.size

    def warnings(self) -> list[str]:
        """Return a sentence on each kind of them."""
        messages = [
            f"{self._name}: {procedure.beyond_message(record, count, largest)}"
            for (record, procedure), count, largest in zip(self._tests, self._beyond, self._largest, strict=True)
            if count
        ]
        for first, count in self._infinite.values():
            more = f" (and {count - 1} more)" if count > 1 else ""
            messages.append(f"{self._name}: {first}{more}: {_NOT_CORRECTED}")
        if self._rows and (lost := [column for column, finite in self._finite.items() if not finite]):
            where = f"{'columns' if len(lost) > 1 else 'column'} {first_of(lost, 3)}"
            messages.append(
                f"{self._name}: {where}: expected numbers, found none in {self._rows} rows: {_NOT_CORRECTED}"
            )
        return messages


_NOT_CORRECTED = "what is corrected with it is not a number there"


def list_results(records: Iterable[Calibration | Blob]) -> list[tuple[Calibration, Procedure]]:
    """Return each record with each procedure whose results it holds; blobs are left out."""
    known = [record for record in records if isinstance(record, Calibration)]
    return [(record, procedure) for record in known for procedure in (procedure_of(record), *joined_of(record))]
