"""The tumble test as the registry knows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.procedures.procedure import Procedure, Section
from imulab.procedures.tumble.task import TASK

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.array_settings import Fusion
    from imulab.device.tables import DeviceTable
    from imulab.device.unit import DeviceUnit
    from imulab.procedures.procedure import Row
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.records.comparison import Change
    from imulab.records.triads import LinearFit, Triads
    from imulab.report.elements import Exhibits


class AccelerometerSection(Section):
    """Bias, scale factor, misalignment and nonlinearity of accelerometers."""

    kind = "tumble"
    triad = "accel"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.tumble.device import golden_accelerometers

        return golden_accelerometers(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.tumble.apply import apply_tumble

        return apply_tumble(unit, columns, recording)


class GyroscopeSection(Section):
    """Bias, scale factor, misalignment and g-sensitivity of gyroscopes."""

    kind = "gyro"
    triad = "gyro"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.device.golden import golden_gyroscopes

        return golden_gyroscopes(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.tumble.apply import apply_gyro

        return apply_gyro(unit, columns, recording)


class MagnetometerSection(Section):
    """Bias and matrix of magnetometers."""

    kind = "mag"
    triad = "mag"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.tumble.device import golden_magnetometers

        return golden_magnetometers(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.tumble.apply import apply_mag

        return apply_mag(unit, columns, recording)


class TumbleProcedure(Procedure):
    """The tumble test of an accelerometer triad, with gyroscopes and magnetometers on the same attitudes."""

    name = "tumble"
    command = "tumble"
    title = "Tumble calibration"
    line_title = "Tumble"
    states_triads = True
    has_heading = True
    task = TASK
    sections = (AccelerometerSection(), GyroscopeSection(), MagnetometerSection())

    def check(self, record: Calibration) -> None:
        from imulab.procedures.tumble.sections import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.tumble.figures import exhibits

        return exhibits(record)

    def rows(self, record: Calibration) -> Sequence[Row]:
        from imulab.procedures.tumble.engineering import engineering_rows

        return engineering_rows(record)

    def change_unit(self, change: Change, record: Calibration) -> tuple[float, str]:
        from imulab.procedures.tumble.engineering import change_unit

        return change_unit(change, record)

    def same_meaning(self, name: str, first: Calibration, second: Calibration) -> bool:
        from imulab.procedures.tumble.engineering import same_meaning

        return same_meaning(name, first, second)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.tumble.device import tables_of

        return tables_of(record)

    def heading(self, record: Calibration) -> Callable[[Recording], Recording]:
        from imulab.procedures.tumble.mag.heading import heading_of

        return heading_of(record)

    def beyond(self, record: Calibration, recording: Recording) -> tuple[int, float]:
        from imulab.procedures.tumble.apply import beyond_test

        return beyond_test(record, recording)

    def beyond_message(self, record: Calibration, count: int, largest: float) -> str:
        from imulab.procedures.tumble.apply import beyond_message

        return beyond_message(record, count, largest)

    def triads(self, record: Calibration) -> Triads:
        from imulab.procedures.tumble.triads import triads_of

        return triads_of(record)

    def linear_fit(self, record: Calibration, *, misalignment: bool) -> LinearFit:
        from imulab.procedures.tumble.triads import linear_fit

        return linear_fit(record, misalignment=misalignment)
