"""The tables of a unit: the numbers of its records in the order of the C core's structs, and of their application."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from imulab.device.array_settings import Fusion
from imulab.device.tables import DeviceTable
from imulab.errors import RecordError
from imulab.procedures.order import check_after, check_order
from imulab.procedures.registry import procedure_of
from imulab.records.calibration import Calibration


def tables_of(record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
    """Return the tables of a record, in the order in which they are applied.

    An array fuses by `fusion`; by what its record carries where that is None.

    Raises
    ------
    RecordError
        The record lacks a parameter or has one that cannot be.
    """
    return procedure_of(record).tables(record, fusion)


def tables_of_all(records: Sequence[Calibration], fusion: Fusion | None = None) -> list[DeviceTable]:
    """Return the tables of several records of one unit, in their order; an array fuses by `fusion` where it is given.

    The columns of each name its record by its SHA-256, so that what a blob corrected is known by the records in it.

    Raises
    ------
    RecordError
        Two records give the same section, are of different units, or would correct one error twice or out of turn.
    """
    serials = {serial: None for record in records if (serial := record.sensor.get("serial"))}
    if len(serials) > 1:
        raise RecordError(f"records of different units: {' '.join(serials)}; expected those of one")
    tables = [
        replace(table, columns={**table.columns, "record": record.sealed()[0]})
        for record in records
        for table in tables_of(record, fusion)
    ]
    kinds = [table.kind for table in tables]
    twice = sorted({kind for kind in kinds if kinds.count(kind) > 1})
    if twice:
        raise RecordError(f"two records give a {twice[0]} table; a unit has one")
    check_order(kinds)
    check_after((table.kind, table.columns, (table.columns["record"],)) for table in tables)
    return tables
