"""The entry of the calibration over temperature in the registry."""

from __future__ import annotations

from imulab.procedures.procedure import Procedure, deferred
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
    tables=deferred(f"{_HERE}.record:no_tables"),
    sections=(),
    not_applied="laws over temperature are not in the C core yet; 'imulab show' and 'imulab report' read it",
    elsewhere="laws over temperature are not exported yet",
    rows=deferred(f"{_HERE}.engineering:rows"),
    change_unit=deferred(f"{_HERE}.engineering:change_unit"),
    same_meaning=deferred(f"{_HERE}.engineering:same_meaning"),
)
