"""The centrifuge test in the registry: its options, its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.errors import ReadError
from imulab.options import read_options
from imulab.procedures.procedure import Files, Procedure, Section, Task, noting_head, source_of

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.tables import DeviceTable, Fusion
    from imulab.device.unit import DeviceUnit
    from imulab.procedures.centrifuge.fit import CentrifugeFit
    from imulab.procedures.centrifuge.manifest import Run
    from imulab.recording import Recording, Source
    from imulab.records.calibration import Calibration
    from imulab.report.traces import Exhibits


# The fit as a task: from a manifest, which names the recordings.


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.centrifuge.fit import fit_centrifuge
    from imulab.procedures.centrifuge.manifest import load_manifest
    from imulab.readers.streams import on_clock_of

    (manifest,) = files
    test = load_manifest(access.path(manifest), manifest)
    names = {run.file: access.beside(manifest, run.file) for run in test.runs}
    for index, run in enumerate(test.runs):  # a missing file is refused before hours of data are read
        if not access.path(names[run.file]).is_file():
            raise ReadError(f"{test.place(index)}: no such file")

    heads: dict[str, Mapping[str, str]] = {}

    def blocks(run: Run) -> Iterable[Recording]:
        name = names[run.file]
        return on_clock_of(noting_head(access.blocks(name, values["layout"], window=run.window), heads, name))

    def sources() -> list[Source]:
        named = [(manifest, manifest), *names.items()]
        stated = (source_of(access, name, called, heads=heads) for called, name in named)
        return [source for source in stated if source is not None]

    return fit_centrifuge(
        test,
        blocks,
        method=values["method"],
        curve=values["curve"],
        sources=sources,
        progress=progress,
    ).calibration


def _function() -> Callable[..., CentrifugeFit]:
    from imulab.procedures.centrifuge.fit import fit_centrifuge

    return fit_centrifuge


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    return read_options(TASK.options, texts, label)


TASK = Task(
    files="the manifest of one test",
    count=(1, 1),
    function=_function,
    values=_values,
    fit=_fit,
)


# The procedure and its section of a device.


class CentrifugeSection(Section):
    """Drift by the curve K(a) and the specific force."""

    kind = "centrifuge"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.centrifuge.device import golden

        return golden(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.centrifuge.device import apply_centrifuge

        return apply_centrifuge(unit, columns, recording)


class CentrifugeProcedure(Procedure):
    """The g-sensitive drift of a flexible gyro, which changes with g."""

    name = "centrifuge"
    command = "centrifuge"
    title = "Centrifuge test"
    line_title = "Centrifuge"
    elsewhere = "{target} has no parameter for drift that depends on acceleration"
    task = TASK
    sections = (CentrifugeSection(),)

    def check(self, record: Calibration) -> None:
        from imulab.procedures.centrifuge.schema import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.centrifuge.figures import exhibits

        return exhibits(record)

    def summary(self, record: Calibration) -> tuple[list[str], list[list[str]]]:
        from imulab.procedures.centrifuge.figures import summary

        return summary(record)

    def same_meaning(self, name: str, first: Calibration, second: Calibration) -> bool:
        from imulab.procedures.centrifuge.schema import same_meaning

        return same_meaning(name, first, second)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.centrifuge.device import tables_of

        return tables_of(record)

    def beyond(self, record: Calibration, recording: Recording) -> tuple[int, float]:
        from imulab.procedures.centrifuge.device import beyond_levels

        return beyond_levels(record, recording)

    def beyond_message(self, record: Calibration, count: int, largest: float) -> str:
        from imulab.procedures.centrifuge.device import beyond_message

        return beyond_message(record, count, largest)
