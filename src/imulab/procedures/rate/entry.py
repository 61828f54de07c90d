"""The test of gyroscopes at known rates or by whole turns, as the registry knows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.procedures.procedure import Procedure, Section
from imulab.procedures.rate.task import TASK

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.array_settings import Fusion
    from imulab.device.tables import DeviceTable
    from imulab.device.unit import DeviceUnit
    from imulab.procedures.procedure import Row
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.records.comparison import Change
    from imulab.report.elements import Exhibits


class RateSection(Section):
    """Bias, scale factor, misalignment and nonlinearity of gyroscopes."""

    kind = "gyro"
    triad = "gyro"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.device.golden import golden_gyroscopes

        return golden_gyroscopes(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.rate.device import apply_rate

        return apply_rate(unit, columns, recording)


class RateProcedure(Procedure):
    """The test of gyroscopes at known rates or by whole turns."""

    name = "rate"
    command = "rate"
    title = "Gyroscopes at known rates"
    line_title = "Rate"
    elsewhere = "{target} wants accelerometers too, and a rate record holds gyroscopes alone"
    joins = True
    task = TASK
    sections = (RateSection(),)

    def check(self, record: Calibration) -> None:
        from imulab.procedures.rate.sections import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.rate.figures import exhibits

        return exhibits(record)

    def joined(self, record: Calibration) -> Exhibits:
        from imulab.procedures.rate.figures import exhibits_of_joined

        return exhibits_of_joined(record)

    def rows(self, record: Calibration) -> Sequence[Row]:
        from imulab.procedures.rate.engineering import rows

        return rows(record)

    def change_unit(self, change: Change, record: Calibration) -> tuple[float, str]:
        from imulab.procedures.rate.engineering import change_unit

        return change_unit(change, record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.rate.device import tables_of

        return tables_of(record)

    def beyond(self, record: Calibration, recording: Recording) -> tuple[int, float]:
        from imulab.device.gyroscopes import beyond_rates

        return beyond_rates(record, recording)

    def beyond_message(self, record: Calibration, count: int, largest: float) -> str:
        from imulab.device.gyroscopes import beyond_message

        return beyond_message(record, count, largest)
