"""The entry of the centrifuge test in the registry."""

from __future__ import annotations

from imulab.procedures.centrifuge.task import TASK
from imulab.procedures.procedure import Procedure, Section, deferred

_HERE = "imulab.procedures.centrifuge"

ENTRY = Procedure(
    name="centrifuge",
    command="centrifuge",
    title="Centrifuge test",
    line_title="Centrifuge",
    task=TASK,
    check=deferred(f"{_HERE}.sections:check"),
    exhibits=deferred(f"{_HERE}.figures:exhibits"),
    summary=deferred(f"{_HERE}.findings:summary"),
    tables=deferred(f"{_HERE}.device:tables_of"),
    sections=(
        Section(
            "centrifuge",
            golden=deferred(f"{_HERE}.device:golden"),
            apply=deferred(f"{_HERE}.apply:apply_centrifuge"),
        ),
    ),
    elsewhere="{target} has no parameter for drift that depends on acceleration",
    same_meaning=deferred(f"{_HERE}.meaning:same_meaning"),
    beyond=deferred(f"{_HERE}.apply:beyond_levels"),
    beyond_message=deferred(f"{_HERE}.apply:beyond_message"),
)
