"""A procedure's fit, from files and the texts of its options to a record: what single commands and the fleet both run.

Going through one function is what makes a fleet's parameters equal the single command's to the last bit. A further
procedure is one entry of `TASKS` and one module with two functions: texts to values, files and values to a record.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from imulab.procedures.centrifuge import task as centrifuge
from imulab.procedures.gyro_array import task as array
from imulab.procedures.task import Files, Task
from imulab.procedures.tumble import task as tumble
from imulab.procedures.warmup import task as warmup

if TYPE_CHECKING:
    from imulab.records.calibration import Calibration

__all__ = ["FLAG", "TASKS", "Files", "Task", "run_task"]

FLAG = "--{}"
"""How the command line calls an option in its messages."""

TASKS: dict[str, Task] = {
    "tumble": tumble.TASK,
    "array": array.TASK,
    "warmup": warmup.TASK,
    "centrifuge": centrifuge.TASK,
}


def _silent(_: int) -> None:
    pass


def run_task(
    name: str,
    files: Sequence[str],
    options: Mapping[str, str | None],
    access: Files,
    *,
    label: str = FLAG,
    progress: Callable[[int], None] = _silent,
) -> Calibration:
    """Fit one unit; `options` are texts, None where not given.

    Raises
    ------
    ImulabError
        What the procedure's fit, its readers and its options raise.
    """
    task = TASKS[name]
    values = task.values({key: text for key, text in options.items() if text is not None}, label)
    return task.fit(files, values, access, progress)
