"""The entry of the noise procedure in the registry."""

from __future__ import annotations

from imulab.procedures.noise.task import TASK
from imulab.procedures.procedure import Procedure, deferred

_HERE = "imulab.procedures.noise"

ENTRY = Procedure(
    name="noise",
    command="noise",
    title="Noise at rest",
    line_title="Noise",
    task=TASK,
    check=deferred(f"{_HERE}.sections:check"),
    exhibits=deferred(f"{_HERE}.figures:exhibits"),
    tables=deferred(f"{_HERE}.record:no_tables"),
    sections=(),
    not_applied="it says how large the noise is, which no correction takes away; 'imulab export --noise' takes it",
    elsewhere="it holds no calibration; 'imulab noise fit --for' prints what filters want of it",
    noise=deferred(f"{_HERE}.wants:for_export"),
    rows=deferred(f"{_HERE}.engineering:rows"),
    change_unit=deferred(f"{_HERE}.engineering:change_unit"),
)
