"""The entry of the calibration over temperature in the registry."""

from __future__ import annotations

from imulab.procedures.procedure import Procedure, Section, deferred
from imulab.procedures.thermal.task import TASK

_HERE = "imulab.procedures.thermal"

ENTRY = Procedure(
    name="thermal",
    command="thermal",
    title="Calibration over temperature",
    line_title="Thermal",
    task=TASK,
    check=deferred(f"{_HERE}.sections:check"),
    exhibits=deferred(f"{_HERE}.figures:exhibits"),
    tables=deferred(f"{_HERE}.device:tables_of"),
    sections=(
        Section(
            "thermal",
            golden=deferred(f"{_HERE}.device:golden"),
            apply=deferred(f"{_HERE}.apply:apply_thermal"),
            triad="accel",
            remarks=deferred(f"{_HERE}.apply:remarks"),
        ),
        Section(
            "thermal_gyro",
            golden=deferred(f"{_HERE}.gyrodevice:golden"),
            apply=deferred(f"{_HERE}.apply:apply_gyro"),
            triad="gyro",
            remarks=deferred(f"{_HERE}.apply:gyro_remarks"),
        ),
    ),
    laws=deferred(f"{_HERE}.device:accelerometers"),
    gyro_laws=deferred(f"{_HERE}.gyrodevice:gyroscopes"),
    elsewhere="{target} takes no laws over temperature",
    rows=deferred(f"{_HERE}.engineering:rows"),
    change_unit=deferred(f"{_HERE}.engineering:change_unit"),
    comparable=deferred(f"{_HERE}.compare:at_common_temperatures"),
    on_line=deferred(f"{_HERE}.compare:on_line"),
)
