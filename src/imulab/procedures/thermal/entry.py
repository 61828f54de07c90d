"""The calibration of accelerometers and gyroscopes over temperature, as the registry knows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.procedures.procedure import Procedure, Section
from imulab.procedures.thermal.task import TASK

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.array_settings import Fusion
    from imulab.device.tables import DeviceTable
    from imulab.device.unit import DeviceUnit
    from imulab.procedures.procedure import OnLine, Row
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.records.comparison import Change
    from imulab.records.triads import AccelerometerLaws, GyroscopeLaws
    from imulab.report.elements import Exhibits


class AccelerometerLawsSection(Section):
    """Laws of accelerometers over temperature."""

    kind = "thermal"
    triad = "accel"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.thermal.device import golden

        return golden(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.thermal.apply import apply_thermal

        return apply_thermal(unit, columns, recording)

    def remarks(self, columns: Mapping[str, Any], recording: Recording) -> list[str]:
        from imulab.procedures.thermal.apply import remarks

        return remarks(columns, recording)


class GyroscopeLawsSection(Section):
    """Laws of gyroscopes over temperature."""

    kind = "thermal_gyro"
    triad = "gyro"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.thermal.gyrodevice import golden

        return golden(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.thermal.apply import apply_gyro

        return apply_gyro(unit, columns, recording)

    def remarks(self, columns: Mapping[str, Any], recording: Recording) -> list[str]:
        from imulab.procedures.thermal.apply import gyro_remarks

        return gyro_remarks(columns, recording)


class ThermalProcedure(Procedure):
    """The calibration of accelerometers and gyroscopes over temperature."""

    name = "thermal"
    command = "thermal"
    title = "Calibration over temperature"
    line_title = "Thermal"
    elsewhere = "{target} takes no laws over temperature"
    over_temperature = True
    task = TASK
    sections = (AccelerometerLawsSection(), GyroscopeLawsSection())

    def check(self, record: Calibration) -> None:
        from imulab.procedures.thermal.sections import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.thermal.figures import exhibits

        return exhibits(record)

    def rows(self, record: Calibration) -> Sequence[Row]:
        from imulab.procedures.thermal.engineering import rows

        return rows(record)

    def change_unit(self, change: Change, record: Calibration) -> tuple[float, str]:
        from imulab.procedures.thermal.engineering import change_unit

        return change_unit(change, record)

    def comparable(self, first: Calibration, second: Calibration) -> tuple[Calibration, Calibration]:
        from imulab.procedures.thermal.compare import at_common_temperatures

        return at_common_temperatures(first, second)

    def on_line(self, record: Calibration) -> OnLine | None:
        from imulab.procedures.thermal.compare import on_line

        return on_line(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.thermal.device import tables_of

        return tables_of(record)

    def laws(self, record: Calibration) -> AccelerometerLaws:
        from imulab.procedures.thermal.device import accelerometers

        return accelerometers(record)

    def gyro_laws(self, record: Calibration) -> GyroscopeLaws | None:
        from imulab.procedures.thermal.gyrodevice import gyroscopes

        return gyroscopes(record)
