"""The gyro array in the registry: its options, its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

from imulab.errors import OptionError
from imulab.options import READING, parsed, part_of, read_options
from imulab.procedures.procedure import Files, Procedure, Section, Task
from imulab.quantities import span

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.tables import DeviceTable, Fusion
    from imulab.procedures.gyro_array.fit import ArrayFit
    from imulab.records.calibration import Calibration
    from imulab.report.traces import Exhibits


# The fit as a task: from a recording at rest and, if there is one, one in motion.


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.gyro_array.fit import calibrate_array
    from imulab.readers.streams import one_clock

    part = values["part"]
    at_rest = {**part, "window": values["interval"] or part["window"]}
    still = one_clock(access.recording(files[0], values["layout"], **at_rest))
    moving = None
    if len(files) > 1:
        moving = one_clock(access.recording(files[1], values["layout"], **{**part, "window": None}))
    noise = None if values["noise"] is None else access.record(values["noise"])
    return calibrate_array(
        still, moving, averaging_time=values["averaging"], fusion=values["fusion"], noise=noise
    ).calibration


class Older(TypedDict, total=False):
    """Older names of options.

    Attributes
    ----------
    interval
        The same as window, by its older name.
    """

    interval: Annotated[str | None, parsed(span, "FROM:TO", unit="s"), READING]


def _function() -> Callable[..., ArrayFit]:
    from imulab.procedures.gyro_array.public import calibrate_array

    return calibrate_array


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.procedures.gyro_array.stream import fusion_text

    values = read_options(TASK.options, texts, label)
    if values["interval"] is not None and values["window"]:
        names = label.format("interval"), label.format("window")
        raise OptionError(f"{names[0]} together with {names[1]}: expected one of them, they say the same")
    by = (values["method"], values["memory"])
    fusion = None if by == (None, None) else fusion_text(*by, label)
    return {**values, "fusion": fusion, "part": part_of(values)}


TASK = Task(
    files="STILL, or STILL;MOVING",
    count=(1, 2),
    function=_function,
    values=_values,
    fit=_fit,
    without=("moving", "element"),
    more=(Older,),
)


# The procedure and its section of a device.


class ArraySection(Section):
    """Biases, alignment and noise of the gyroscopes of an array, and how they are fused."""

    kind = "array"
    corrects = False

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.gyro_array.device import golden

        return golden(table, random)


class ImusSection(Section):
    """Places, matrices, biases and noise of the whole IMUs of a board."""

    kind = "imus"
    corrects = False

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.gyro_array.imus.device import golden

        return golden(table, random)


class GyroArrayProcedure(Procedure):
    """The array of gyroscopes that are fused into one rate."""

    name = "gyro_array"
    command = "array"
    title = "Gyro array"
    line_title = "Gyro array"
    not_applied = "'imulab array fuse --calibration' takes it, with --imus that of whole IMUs"
    elsewhere = "{target} fuses no array of gyroscopes or of whole IMUs"
    task = TASK
    sections = (ArraySection(), ImusSection())

    def check(self, record: Calibration) -> None:
        from imulab.procedures.gyro_array.schema import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.gyro_array.figures import exhibits

        return exhibits(record)

    def summary(self, record: Calibration) -> tuple[list[str], list[list[str]]]:
        from imulab.procedures.gyro_array.figures import summary

        return summary(record)

    def reservations(self, record: Calibration) -> list[str]:
        from imulab.procedures.gyro_array.figures import reservations

        return reservations(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        if _whole(record):
            from imulab.procedures.gyro_array.imus.device import tables_of_board

            return tables_of_board(record, fusion)
        from imulab.procedures.gyro_array.device import tables_of

        return tables_of(record, fusion)

    def fused_by(self, record: Calibration) -> tuple[str, ...]:
        return ("at", "gyro_range", "accel_range") if _whole(record) else ("method", "memory")

    def fusion(self, record: Calibration, stated: Mapping[str, Any]) -> Fusion:
        if _whole(record):
            from imulab.procedures.gyro_array.imus.device import fusion_of_board

            return fusion_of_board(record, stated)
        from imulab.procedures.gyro_array.stream import fusion_of_record

        return fusion_of_record(record, stated)


def _whole(record: Calibration) -> bool:
    return record.model.get("kind") == "imus"
