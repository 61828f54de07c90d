"""The calibration over temperature in the registry: its options, its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.procedures.procedure import (
    ELEMENT,
    READING,
    Files,
    Option,
    Procedure,
    Section,
    Task,
    file_option,
    measure,
    part_of,
    read_options,
    text_option,
)
from imulab.procedures.thermal import degrees_text, further_of

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.tables import DeviceTable, Fusion
    from imulab.device.unit import DeviceUnit
    from imulab.procedures.procedure import OnLine, Row
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.records.comparison import Change
    from imulab.records.triads import AccelerometerLaws, GyroscopeLaws
    from imulab.report.traces import Exhibits


# The accelerometer triad of a unit over temperature, from recordings that are a power cycle each.


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.thermal.fit import fit_thermal

    recordings = [access.recording(name, values["layout"], **values["part"]) for name in files]
    prior = None if values["prior"] is None else access.record(values["prior"])
    return fit_thermal(recordings, prior=prior, **values["fit"]).calibration


GRAVITY = (
    text_option("gravity", "Local gravity, m/s^2, as 9.81362 or 9.81362+-0.00002; else of the head.", shows="G"),
    text_option("latitude", "Latitude, deg, for normal gravity; with gyro for the Earth's rate.", shows="DEG"),
    text_option("height", "Height above the ellipsoid, m.", shows="M"),
)
OPTIONS = (
    Option(
        "degrees",
        "Of the laws of bias, scale factor and misalignment, 3,2,1, or spline,2,1; auto: from there down, or a spline.",
        degrees_text,
        "auto",
        "auto|B,S,M",
    ),
    *GRAVITY,
    file_option("prior", "Tumble record of this unit at a known temperature: counts as one recording.", "RECORD"),
    Option("with", "Further triads of the recordings, in one record.", further_of, shows="gyro", choices=("gyro",)),
    measure("tilt", "How far a hold tips while it warms or cools, mrad.", "angle", "mrad", "0.2 mrad"),
    measure(
        "turn_on_scatter", "What biases move by from one power cycle to the next, mg, if known.", "acceleration", "mg",
        shows="SIZE",
    ),
    measure(
        "gyro_turn_on_scatter", "The same of the gyroscopes' biases, deg/s, if known.", "rate", "deg/s", shows="SIZE"
    ),
    measure("settle", "Left out at the start of a recording, s; 300 s where time is from power-on.", "time", "s",
            shows="TIME"),
    text_option("temperature_column", "Column of the unit's own thermometer, where there are several.", shows="NAME"),
    *READING,
    ELEMENT,
)  # fmt: skip
_OF_THE_FIT = ("degrees", "tilt", "turn_on_scatter", "gyro_turn_on_scatter", "settle", "temperature_column")


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.gravity import at_latitude, gravity_option

    values = read_options(OPTIONS, texts, label)
    values["with"] = values["with"] or ()
    earth = at_latitude(values["latitude"], label.format("latitude")) if values["with"] else None
    gravity = gravity_option(values["gravity"], values["latitude"], values["height"], label, beside=earth is not None)
    fit = {name: values[name] for name in _OF_THE_FIT}
    fit |= {"gravity": gravity, "with_": values["with"], "latitude": None if earth is None else earth.latitude}
    return {**values, "fit": fit, "part": part_of(values)}


TASK = Task(
    files="the recordings of one unit at several temperatures",
    count=(1, None),
    options=OPTIONS,
    values=_values,
    fit=_fit,
)


# The calibration of accelerometers and gyroscopes over temperature, as the registry knows it.


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

    def rows(self, record: Calibration) -> Sequence[Row]:
        from imulab.procedures.thermal.schema import rows

        return rows(record)

    def change_unit(self, change: Change, record: Calibration) -> tuple[float, str]:
        from imulab.procedures.thermal.schema import change_unit

        return change_unit(change, record)

    def comparable(self, first: Calibration, second: Calibration) -> tuple[Calibration, Calibration]:
        from imulab.procedures.thermal.device import at_common_temperatures

        return at_common_temperatures(first, second)

    def on_line(self, record: Calibration) -> OnLine | None:
        from imulab.procedures.thermal.device import on_line

        return on_line(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.thermal.device import tables_of

        return tables_of(record)

    def laws(self, record: Calibration) -> AccelerometerLaws:
        from imulab.procedures.thermal.device import accelerometers

        return accelerometers(record)

    def gyro_laws(self, record: Calibration) -> GyroscopeLaws | None:
        from imulab.procedures.thermal.device import gyroscopes

        return gyroscopes(record)
