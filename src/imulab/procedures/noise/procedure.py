"""The noise of a unit in the registry: its options, its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.options import part_of, read_options
from imulab.procedures.procedure import Files, Procedure, Task, source_of

if TYPE_CHECKING:
    from imulab.device.tables import DeviceTable, Fusion
    from imulab.estimation.noise.rest import Rest
    from imulab.procedures.noise.fit import NoiseFit
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.report.traces import Exhibits


# The fit as a task: from logs at rest.


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.noise.fit import chosen_columns, fit_recordings, read_log
    from imulab.recording import Recording

    heads: dict[str, Mapping[str, str]] = {}

    def read(name: str) -> Recording | Rest:
        part = {"layout": values["layout"], **values["part"]}
        log = read_log(
            None if name == "-" else access.path(name),
            lambda: (access.blocks(name, **part), None),
            lambda: access.recording(name, **part),
            lambda first: chosen_columns(first, values["columns"]),
        )
        heads[name] = (log if isinstance(log, Recording) else log.recording).metadata
        return log

    recordings = map(read, files)
    sources = (source for name in files if (source := source_of(access, name, heads=heads)) is not None)
    fit = {name: values[name] for name in ("terms", "horizon", "band", "regress", "columns", "steps")}
    return fit_recordings(recordings, sources=sources, **fit).calibration


def _function() -> Callable[..., NoiseFit]:
    from imulab.procedures.noise.fit import fit_noise

    return fit_noise


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.procedures.noise import check_options

    values = read_options(TASK.options, texts, label)
    check_options(values["terms"], values["horizon"], values["band"], values["regress"], values["steps"], label)
    return {**values, "part": part_of(values)}


TASK = Task(files="its logs at rest", count=(1, None), function=_function, values=_values, fit=_fit)


# The procedure.


class NoiseProcedure(Procedure):
    """The stochastic model of sensors at rest."""

    name = "noise"
    command = "noise"
    title = "Noise at rest"
    line_title = "Noise"
    not_applied = "it says how large the noise is, which no correction takes away; 'imulab export --noise' takes it"
    elsewhere = "it holds no calibration; 'imulab noise fit --for' prints what filters want of it"
    task = TASK

    def check(self, record: Calibration) -> None:
        from imulab.procedures.noise.schema import check

        check(record)

    def same_meaning(self, name: str, first: Calibration, second: Calibration) -> bool:
        from imulab.procedures.noise.schema import same_meaning

        return same_meaning(name, first, second)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.noise.figures import exhibits

        return exhibits(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.noise.fit import no_tables

        return no_tables(record)

    def noise(self, record: Calibration) -> Mapping[str, Any]:
        from imulab.procedures.noise.wants import for_export

        return for_export(record)
