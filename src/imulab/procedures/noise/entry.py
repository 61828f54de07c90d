"""The stochastic model of sensors at rest, as the registry knows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.procedures.noise.task import TASK
from imulab.procedures.procedure import Procedure

if TYPE_CHECKING:
    from imulab.device.array_settings import Fusion
    from imulab.device.tables import DeviceTable
    from imulab.procedures.procedure import Row
    from imulab.records.calibration import Calibration
    from imulab.records.comparison import Change
    from imulab.report.elements import Exhibits


class NoiseProcedure(Procedure):
    """The stochastic model of sensors at rest."""

    name = "noise"
    command = "noise"
    title = "Noise at rest"
    line_title = "Noise"
    not_applied = "it says how large the noise is, which no correction takes away; 'imulab export --noise' takes it"
    elsewhere = "it holds no calibration; 'imulab noise fit --for' prints what filters want of it"
    task = TASK

    def check(self, record: Calibration) -> None:
        from imulab.procedures.noise.sections import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.noise.figures import exhibits

        return exhibits(record)

    def rows(self, record: Calibration) -> Sequence[Row]:
        from imulab.procedures.noise.engineering import rows

        return rows(record)

    def change_unit(self, change: Change, record: Calibration) -> tuple[float, str]:
        from imulab.procedures.noise.engineering import change_unit

        return change_unit(change, record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.noise.record import no_tables

        return no_tables(record)

    def noise(self, record: Calibration) -> Mapping[str, Any]:
        from imulab.procedures.noise.wants import for_export

        return for_export(record)
