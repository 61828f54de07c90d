"""The tables of a unit: the numbers of its records in the order of the C core's structs, and of their application."""

from __future__ import annotations

from collections.abc import Sequence

from imulab.device.array_settings import Fusion
from imulab.device.tables import DeviceTable
from imulab.errors import RecordError
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
    made_by = procedure_of(record)
    return made_by.tables(record) if made_by.fusion is None else made_by.tables(record, fusion)


def tables_of_all(records: Sequence[Calibration], fusion: Fusion | None = None) -> list[DeviceTable]:
    """Return the tables of several records of one unit, in their order; an array fuses by `fusion` where it is given.

    Raises
    ------
    RecordError
        Two records give the same section, or are of different units.
    """
    serials = {serial: None for record in records if (serial := record.sensor.get("serial"))}
    if len(serials) > 1:
        raise RecordError(f"records of different units: {' '.join(serials)}; expected those of one")
    tables = [table for record in records for table in tables_of(record, fusion)]
    kinds = [table.kind for table in tables]
    twice = sorted({kind for kind in kinds if kinds.count(kind) > 1})
    if twice:
        raise RecordError(f"two records give a {twice[0]} table; a unit has one")
    check_order(kinds)
    return tables


def check_order(kinds: Sequence[str]) -> None:
    """Refuse sections, by kind in the order of application, that would correct one error twice or out of turn.

    Raises
    ------
    RecordError
        A tumble is beside a thermal record, which contains it; or a warm-up table comes before the thermal record.
    """
    if "thermal" not in kinds:
        return
    if "tumble" in kinds:
        raise RecordError(
            "a tumble and a thermal record together: both take off bias, scale factor and misalignment; expected the "
            "thermal record alone (thermal fit --prior takes the tumble's knowledge in)"
        )
    if "gyro" in kinds and "thermal_gyro" in kinds:
        raise RecordError(
            "a gyroscope record beside a thermal one that holds gyroscopes too: both take off their biases; expected "
            "the thermal record alone, or one fitted without --with gyro"
        )
    if "warmup" in kinds[: list(kinds).index("thermal")]:
        raise RecordError(
            "a warm-up record before a thermal one: expected the thermal record first, since the warm-up is what is "
            "left after the laws over temperature"
        )
