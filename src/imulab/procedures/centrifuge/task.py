"""A centrifuge test from its manifest, which names the recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.errors import ReadError
from imulab.procedures.centrifuge.choices import CURVES, METHODS
from imulab.procedures.options import LAYOUT, choice, read_options
from imulab.procedures.procedure import Files, Task, source_of

if TYPE_CHECKING:
    from imulab.recording import Source
    from imulab.records.calibration import Calibration


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.centrifuge.fit import fit_centrifuge
    from imulab.procedures.centrifuge.manifest import load_manifest

    (manifest,) = files
    test = load_manifest(access.path(manifest), manifest)
    names = {run.file: access.beside(manifest, run.file) for run in test.runs}
    for index, run in enumerate(test.runs):  # a missing file is refused before hours of data are read
        if not access.path(names[run.file]).is_file():
            raise ReadError(f"{test.place(index)}: no such file")

    def sources() -> list[Source]:
        named = [(manifest, manifest), *names.items()]
        return [source for called, name in named if (source := source_of(access, name, called)) is not None]

    return fit_centrifuge(
        test,
        lambda run: access.blocks(names[run.file], values["layout"], window=run.window),
        method=values["method"],
        curve=values["curve"],
        sources=sources,
        progress=progress,
    ).calibration


OPTIONS = (
    choice("method", "least-squares, or fourier (the source's whole-period sums).", METHODS, "least-squares"),
    choice("curve", "Terms of K(a).", ("auto", *CURVES), "auto"),
    LAYOUT,
)


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    return read_options(OPTIONS, texts, label)


TASK = Task(
    files="the manifest of one test",
    count=(1, 1),
    options=OPTIONS,
    values=_values,
    fit=_fit,
)
