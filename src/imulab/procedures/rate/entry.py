"""The entry of the rate test in the registry."""

from __future__ import annotations

from imulab.procedures.procedure import Procedure, Section, deferred
from imulab.procedures.rate.task import TASK

_HERE = "imulab.procedures.rate"

ENTRY = Procedure(
    name="rate",
    command="rate",
    title="Gyroscopes at known rates",
    line_title="Rate",
    task=TASK,
    check=deferred(f"{_HERE}.sections:check"),
    exhibits=deferred(f"{_HERE}.figures:exhibits"),
    tables=deferred(f"{_HERE}.device:tables_of"),
    sections=(
        Section(
            "gyro",
            golden=deferred("imulab.device.golden:golden_gyroscopes"),
            apply=deferred(f"{_HERE}.device:apply_rate"),
            triad="gyro",
        ),
    ),
    elsewhere="{target} wants accelerometers too, and a rate record holds gyroscopes alone",
    joined=deferred(f"{_HERE}.figures:exhibits_of_joined"),
    rows=deferred(f"{_HERE}.engineering:rows"),
    beyond=deferred("imulab.device.gyroscopes:beyond_rates"),
    beyond_message=deferred("imulab.device.gyroscopes:beyond_message"),
    change_unit=deferred(f"{_HERE}.engineering:change_unit"),
)
