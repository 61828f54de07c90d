"""The array of gyroscopes that are fused into one rate, as the registry knows it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from imulab.procedures.gyro_array.task import TASK
from imulab.procedures.procedure import Procedure, Section

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.array_settings import Fusion
    from imulab.device.tables import DeviceTable
    from imulab.records.calibration import Calibration
    from imulab.report.elements import Exhibits


class ArraySection(Section):
    """Biases, alignment and noise of the gyroscopes of an array, and how they are fused."""

    kind = "array"
    corrects = False

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.gyro_array.device import golden

        return golden(table, random)


class GyroArrayProcedure(Procedure):
    """The array of gyroscopes that are fused into one rate."""

    name = "gyro_array"
    command = "array"
    title = "Gyro array"
    line_title = "Gyro array"
    not_applied = "'imulab array fuse --calibration' takes it"
    elsewhere = "{target} fuses no array of gyroscopes"
    fuses = True
    task = TASK
    sections = (ArraySection(),)

    def check(self, record: Calibration) -> None:
        from imulab.procedures.gyro_array.sections import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.gyro_array.figures import exhibits

        return exhibits(record)

    def summary(self, record: Calibration) -> tuple[list[str], list[list[str]]]:
        from imulab.procedures.gyro_array.figures import summary

        return summary(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.gyro_array.device import tables_of

        return tables_of(record, fusion)

    def fusion(self, record: Calibration, method: str | None, memory: str | None) -> Fusion:
        from imulab.procedures.gyro_array.memory import fusion_of_record

        return fusion_of_record(record, method, memory)
