"""A procedure's fit, from files and the texts of its options to a record: what single commands and the fleet both run.

Going through one function is what makes a fleet's parameters equal the single command's to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from imulab.errors import RecordError
from imulab.procedures.options import FLAG
from imulab.procedures.procedure import Files
from imulab.procedures.registry import PROCEDURES
from imulab.records.calibration import Calibration


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

    What is wrong of a record that an option names, ``prior: ...``, is said with the name of its file.

    Raises
    ------
    ImulabError
        What the procedure's fit, its readers and its options raise.
    """
    task = PROCEDURES[name].task
    values = task.values({key: text for key, text in options.items() if text is not None}, label)
    try:
        return task.fit(files, values, access, progress)
    except RecordError as error:
        file = options.get(str(error).partition(":")[0])
        if file is None:
            raise
        raise RecordError(f"{file}: {error}") from None
