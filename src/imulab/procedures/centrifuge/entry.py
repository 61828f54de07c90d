"""The g-sensitive drift of a flexible gyro, which changes with g, as the registry knows it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from imulab.procedures.centrifuge.task import TASK
from imulab.procedures.procedure import Procedure, Section

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.array_settings import Fusion
    from imulab.device.tables import DeviceTable
    from imulab.device.unit import DeviceUnit
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.report.elements import Exhibits


class CentrifugeSection(Section):
    """Drift by the curve K(a) and the specific force."""

    kind = "centrifuge"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.centrifuge.device import golden

        return golden(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.centrifuge.apply import apply_centrifuge

        return apply_centrifuge(unit, columns, recording)


class CentrifugeProcedure(Procedure):
    """The g-sensitive drift of a flexible gyro, which changes with g."""

    name = "centrifuge"
    command = "centrifuge"
    title = "Centrifuge test"
    line_title = "Centrifuge"
    elsewhere = "{target} has no parameter for drift that depends on acceleration"
    task = TASK
    sections = (CentrifugeSection(),)

    def check(self, record: Calibration) -> None:
        from imulab.procedures.centrifuge.sections import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.centrifuge.figures import exhibits

        return exhibits(record)

    def summary(self, record: Calibration) -> tuple[list[str], list[list[str]]]:
        from imulab.procedures.centrifuge.findings import summary

        return summary(record)

    def same_meaning(self, name: str, first: Calibration, second: Calibration) -> bool:
        from imulab.procedures.centrifuge.meaning import same_meaning

        return same_meaning(name, first, second)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.centrifuge.device import tables_of

        return tables_of(record)

    def beyond(self, record: Calibration, recording: Recording) -> tuple[int, float]:
        from imulab.procedures.centrifuge.apply import beyond_levels

        return beyond_levels(record, recording)

    def beyond_message(self, record: Calibration, count: int, largest: float) -> str:
        from imulab.procedures.centrifuge.apply import beyond_message

        return beyond_message(record, count, largest)
