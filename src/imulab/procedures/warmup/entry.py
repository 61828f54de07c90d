"""The bias of the minutes after power-on, as the registry knows it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from imulab.procedures.procedure import Procedure, Section
from imulab.procedures.warmup.task import TASK

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.array_settings import Fusion
    from imulab.device.tables import DeviceTable
    from imulab.device.unit import DeviceUnit
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.report.elements import Exhibits


class WarmupSection(Section):
    """Bias over the time since power-on, by power-on temperature."""

    kind = "warmup"
    since_power_on = True

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.warmup.device import golden

        return golden(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.warmup.apply import apply_warmup

        return apply_warmup(unit, columns, recording)

    def unchanged(self, columns: Mapping[str, Any], recording: Recording) -> str | None:
        from imulab.procedures.warmup.apply import unchanged

        return unchanged(columns, recording)

    def remarks(self, columns: Mapping[str, Any], recording: Recording) -> list[str]:
        from imulab.procedures.warmup.apply import remarks

        return remarks(columns, recording)


class WarmupProcedure(Procedure):
    """The bias of the minutes after power-on."""

    name = "warmup"
    command = "warmup"
    title = "Warm-up table"
    line_title = "Warm-up"
    elsewhere = "{target} has no parameter that follows the time since power-on, at most some that follow temperature"
    task = TASK
    sections = (WarmupSection(),)

    def check(self, record: Calibration) -> None:
        from imulab.procedures.warmup.sections import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.warmup.figures import exhibits

        return exhibits(record)

    def summary(self, record: Calibration) -> tuple[list[str], list[list[str]]]:
        from imulab.procedures.warmup.figures import summary

        return summary(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.warmup.device import tables_of

        return tables_of(record)
