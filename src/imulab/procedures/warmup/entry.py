"""The entry of the warm-up in the registry."""

from __future__ import annotations

from imulab.procedures.procedure import Procedure, Section, deferred
from imulab.procedures.warmup.task import TASK

_HERE = "imulab.procedures.warmup"

ENTRY = Procedure(
    name="warmup",
    command="warmup",
    title="Warm-up table",
    line_title="Warm-up",
    task=TASK,
    check=deferred(f"{_HERE}.sections:check"),
    exhibits=deferred(f"{_HERE}.figures:exhibits"),
    summary=deferred(f"{_HERE}.figures:summary"),
    tables=deferred(f"{_HERE}.device:tables_of"),
    sections=(
        Section(
            "warmup",
            golden=deferred(f"{_HERE}.device:golden"),
            apply=deferred(f"{_HERE}.apply:apply_warmup"),
            unchanged=deferred(f"{_HERE}.apply:unchanged"),
            remarks=deferred(f"{_HERE}.apply:remarks"),
            since_power_on=True,
        ),
    ),
    elsewhere="{target} has no parameter that follows the time since power-on, at most some that follow temperature",
)
