"""The warm-up in the registry: its options, its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from imulab.options import part_of, read_options
from imulab.procedures.procedure import Files, Procedure, Section, Task, noting_head, source_of

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.tables import DeviceTable, Fusion
    from imulab.device.unit import DeviceUnit
    from imulab.procedures.warmup.cycles import Cycle
    from imulab.procedures.warmup.fit import WarmupFit
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.report.traces import Exhibits


# The fit as a task: from recordings of power cycles.


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.warmup.cycles import find_power_cycle
    from imulab.procedures.warmup.fit import fit_warmup
    from imulab.readers.streams import on_clock_of

    heads: dict[str, Mapping[str, str]] = {}

    def cycle(name: str) -> Cycle:
        blocks = noting_head(access.blocks(name, values["layout"], **values["part"]), heads, name)
        measured = find_power_cycle(
            on_clock_of(blocks, "gyro"),
            latest_start=values["latest_start"],
            temperature_from_column=values["temperature_column"],
        )
        return replace(measured, source=source_of(access, name, heads=heads))

    return fit_warmup([cycle(name) for name in files], **values["fit"]).calibration


_OF_THE_FIT = ("model", "temperatures", "tolerance", "settling_time", "taper_time", "pool", "axes", "beyond")


def _function() -> Callable[..., WarmupFit]:
    from imulab.procedures.warmup.fit import fit_warmup

    return fit_warmup


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.procedures.warmup.fit import check_options

    values = read_options(TASK.options, texts, label)
    fit = {name: values[name] for name in _OF_THE_FIT}
    fit |= {"settling_limit": values["settling_limit"], "exit": values["exit"]}
    check_options(**{name: value for name, value in fit.items() if name not in ("axes", "settling_limit")})
    return {**values, "fit": fit, "part": part_of(values)}


TASK = Task(
    files="the recordings of its power cycles",
    count=(1, None),
    function=_function,
    values=_values,
    fit=_fit,
)


# The procedure and its section of a device.


class WarmupSection(Section):
    """Bias over the time since power-on, by power-on temperature."""

    kind = "warmup"
    since_power_on = True

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.warmup.device import golden

        return golden(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.warmup.device import apply_warmup

        return apply_warmup(unit, columns, recording)

    def unchanged(self, columns: Mapping[str, Any], recording: Recording) -> str | None:
        from imulab.procedures.warmup.device import unchanged

        return unchanged(columns, recording)

    def remarks(self, columns: Mapping[str, Any], recording: Recording) -> list[str]:
        from imulab.procedures.warmup.device import remarks

        return remarks(columns, recording)


class WarmupProcedure(Procedure):
    """The bias of the minutes after power-on."""

    name = "warmup"
    command = "warmup"
    title = "Warm-up table"
    line_title = "Warm-up"
    elsewhere = "{target} has no parameter that follows the time since power-on, at most some that follow temperature"
    task = TASK
    sections = (WarmupSection(),)

    def check(self, record: Calibration) -> None:
        from imulab.procedures.warmup.schema import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.warmup.figures import exhibits

        return exhibits(record)

    def summary(self, record: Calibration) -> tuple[list[str], list[list[str]]]:
        from imulab.procedures.warmup.figures import summary

        return summary(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.warmup.device import tables_of

        return tables_of(record)
