"""The calibration over temperature as the registry knows it: its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.options import part_of, read_options
from imulab.procedures.procedure import Files, Procedure, Section, Task

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.tables import DeviceTable, Fusion
    from imulab.device.unit import DeviceUnit
    from imulab.procedures.procedure import OnLine
    from imulab.procedures.thermal.fit import ThermalFit
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.records.triads import AccelerometerLaws, GyroscopeLaws
    from imulab.report.traces import Exhibits


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.thermal.fit import fit_thermal

    recordings = [access.recording(name, values["layout"], **values["part"]) for name in files]
    prior = None if values["prior"] is None else access.record(values["prior"])
    return fit_thermal(recordings, prior=prior, **values["fit"]).calibration


_OF_THE_FIT = ("degrees", "tilt", "turn_on_scatter", "gyro_turn_on_scatter", "settle", "temperature_column")


def _function() -> Callable[..., ThermalFit]:
    from imulab.procedures.thermal.fit import fit_thermal

    return fit_thermal


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.gravity import at_latitude, gravity_option, of_place

    values = read_options(TASK.options, texts, label)
    values["with"] = values["with"] or ()
    place = values["place"]
    latitude, height = of_place(place, values["gravity"], values["latitude"], values["height"], label)
    earth = at_latitude(latitude, label.format("latitude")) if values["with"] else None
    beside = earth is not None or place is not None
    gravity = gravity_option(values["gravity"], latitude, height, label, beside=beside)
    fit = {name: values[name] for name in _OF_THE_FIT}
    fit |= {"gravity": gravity, "with_": values["with"], "latitude": None if earth is None else earth.latitude}
    return {**values, "fit": fit, "part": part_of(values)}


TASK = Task(
    files="the recordings of one unit at several temperatures",
    count=(1, None),
    function=_function,
    values=_values,
    fit=_fit,
)


class AccelerometerLawsSection(Section):
    """Laws of accelerometers over temperature."""

    kind = "thermal"
    triad = "accel"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.thermal.device import golden_accelerometers

        return golden_accelerometers(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.thermal.device import apply_thermal

        return apply_thermal(unit, columns, recording)

    def remarks(self, columns: Mapping[str, Any], recording: Recording) -> list[str]:
        from imulab.procedures.thermal.device import remarks

        return remarks(columns, recording)


class GyroscopeLawsSection(Section):
    """Laws of gyroscopes over temperature."""

    kind = "thermal_gyro"
    triad = "gyro"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.thermal.device import golden_gyroscopes

        return golden_gyroscopes(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.thermal.device import apply_gyro

        return apply_gyro(unit, columns, recording)

    def remarks(self, columns: Mapping[str, Any], recording: Recording) -> list[str]:
        from imulab.procedures.thermal.device import gyro_remarks

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
        from imulab.procedures.thermal.schema import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.thermal.figures import exhibits

        return exhibits(record)

    def comparable(self, first: Calibration, second: Calibration) -> tuple[Calibration, Calibration]:
        from imulab.procedures.thermal.device import at_common_temperatures

        return at_common_temperatures(first, second)

    def on_line(self, record: Calibration) -> OnLine | None:
        from imulab.procedures.thermal.device import on_line

        return on_line(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.thermal.device import tables_of

        return tables_of(record)

    def laws(self, record: Calibration) -> AccelerometerLaws | None:
        from imulab.procedures.thermal.device import accelerometer_laws

        return accelerometer_laws(record)

    def gyro_laws(self, record: Calibration) -> GyroscopeLaws | None:
        from imulab.procedures.thermal.device import gyroscope_laws

        return gyroscope_laws(record)
