"""The entry of the tumble test in the registry."""

from __future__ import annotations

from imulab.procedures.procedure import Procedure, Section, deferred
from imulab.procedures.tumble.task import TASK

_HERE = "imulab.procedures.tumble"

ENTRY = Procedure(
    name="tumble",
    command="tumble",
    title="Tumble calibration",
    line_title="Tumble",
    task=TASK,
    check=deferred(f"{_HERE}.sections:check"),
    exhibits=deferred(f"{_HERE}.figures:exhibits"),
    tables=deferred(f"{_HERE}.device:tables_of"),
    sections=(
        Section(
            "tumble",
            golden=deferred(f"{_HERE}.device:golden_accelerometers"),
            apply=deferred(f"{_HERE}.apply:apply_tumble"),
            triad="accel",
        ),
        Section(
            "gyro",
            golden=deferred("imulab.device.golden:golden_gyroscopes"),
            apply=deferred(f"{_HERE}.apply:apply_gyro"),
            triad="gyro",
        ),
        Section(
            "mag",
            golden=deferred(f"{_HERE}.device:golden_magnetometers"),
            apply=deferred(f"{_HERE}.apply:apply_mag"),
            triad="mag",
        ),
    ),
    rows=deferred(f"{_HERE}.engineering:engineering_rows"),
    change_unit=deferred(f"{_HERE}.engineering:change_unit"),
    same_meaning=deferred(f"{_HERE}.engineering:same_meaning"),
    heading=deferred(f"{_HERE}.mag.heading:heading_of"),
    beyond=deferred(f"{_HERE}.apply:beyond_test"),
    beyond_message=deferred(f"{_HERE}.apply:beyond_message"),
    triads=deferred(f"{_HERE}.triads:triads_of"),
    linear_fit=deferred(f"{_HERE}.triads:linear_fit"),
)
