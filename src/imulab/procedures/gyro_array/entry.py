"""The entry of the gyro array in the registry."""

from __future__ import annotations

from imulab.procedures.gyro_array.task import TASK
from imulab.procedures.procedure import Procedure, Section, deferred

_HERE = "imulab.procedures.gyro_array"

ENTRY = Procedure(
    name="gyro_array",
    command="array",
    title="Gyro array",
    line_title="Gyro array",
    task=TASK,
    check=deferred(f"{_HERE}.sections:check"),
    exhibits=deferred(f"{_HERE}.figures:exhibits"),
    summary=deferred(f"{_HERE}.figures:summary"),
    tables=deferred(f"{_HERE}.device:tables_of"),
    fusion=deferred(f"{_HERE}.memory:fusion_of_record"),
    sections=(Section("array", golden=deferred(f"{_HERE}.device:golden")),),
    not_applied="'imulab array fuse --calibration' takes it",
    elsewhere="{target} fuses no array of gyroscopes",
)
