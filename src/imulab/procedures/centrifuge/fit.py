"""The fit of a centrifuge test: from manifest and recordings to K(a) with its uncertainty, and the record.

Stages: `run` reduces each recording to lines (regression in `lines`), `levels` pools runs, `parameters` corrects errors
of the rig and fits K(a); `plan` has the error budget. The equations stand there, their sources too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import file_digest
from os import PathLike, fspath
from pathlib import Path
from typing import Annotated

import numpy as np

from imulab.errors import DataError, OptionError, ReadError, listed, quoted
from imulab.files import open_file
from imulab.options import READING, choice, file
from imulab.procedures.centrifuge import CURVES, METHODS
from imulab.procedures.centrifuge.levels import Levels, level_numbers, pool_levels
from imulab.procedures.centrifuge.manifest import Manifest, Run, load_manifest
from imulab.procedures.centrifuge.parameters import Estimates, corrected, estimate, find_corrections
from imulab.procedures.centrifuge.plan import error_budget
from imulab.procedures.centrifuge.record import make_record
from imulab.procedures.centrifuge.run import LoadedRun, StaticRun, reduce_run, reduce_static
from imulab.procedures.result import Result
from imulab.readers import read_blocks
from imulab.readers.streams import on_clock_of
from imulab.recording import Array, Recording, Source
from imulab.records.calibration import Calibration


@dataclass(frozen=True, repr=False)
class CentrifugeFit(Result):
    """A reduced centrifuge test: the record, and the runs, levels and estimates behind it.

    Examples
    --------
    >>> import imulab as il
    >>> test = il.simulate_centrifuge(levels="1,10", cycles=1, duration="60 s", static_duration="30 s")
    >>> fit = il.fit_centrifuge(test.manifest, test)
    >>> fit.calibration.parameters["x_K0"].unit
    'rad/s/(m/s^2)'
    """

    calibration: Calibration
    runs: tuple[LoadedRun, ...]
    levels: Levels
    estimates: Estimates


def fit_centrifuge(
    manifest: Manifest | str | PathLike[str],
    recording_of: Callable[[Run], Iterable[Recording]] | None = None,
    *,
    method: Annotated[str, choice(METHODS)] = "least-squares",
    curve: Annotated[str, choice(("auto", *CURVES))] = "auto",
    layout: Annotated[str | PathLike[str] | None, file("NAME|L.toml"), READING] = None,
    sources: Callable[[], Sequence[Source]] | None = None,
    progress: Callable[[int], None] | None = None,
) -> CentrifugeFit:
    """Reduce a centrifuge test to K and zeta at every level and the curve K(a), run by run, block by block.

    ``least-squares``: X, Y and FOG regressed on constant, trend, and lines at chi, 2 chi, 3 chi and the net rate,
    with the phase measured by the encoder or the frequency refined on the FOG; ``fourier``: whole-period sums at the
    manifest's rate, as published. ``K_i = |X - FOG| / a_i``, ``zeta_i = K_i / K_1 - 1``.

    Parameters
    ----------
    manifest
        The test, or the file that states it.
    recording_of
        Gives the consecutive blocks of a run's recording, such as a simulation's; read beside the manifest's file where
        that is given.
    method
        least-squares, or fourier (the source's whole-period sums).
    curve
        Terms of K(a).
    layout
        Columns of foreign files; see imulab show --formats.
    sources
        Called when all is read; returns the files that the record is made from.
    progress
        Called with the number of runs done.

    Returns
    -------
    CentrifugeFit

    Raises
    ------
    OptionError
        Unknown method or curve.
    DataError, UnitError
        A run cannot be what the manifest says; the message names run and file.

    References
    ----------
    CN102636185A; IEEE Std 813, 836, 1057.

    Examples
    --------
    >>> import imulab as il
    >>> test = il.simulate_centrifuge(levels="1,10", cycles=1, duration="60 s", static_duration="30 s")
    >>> test.save("test")
    >>> il.fit_centrifuge("test/manifest.toml").calibration.procedure
    'centrifuge'
    """
    check_options(method, curve)
    if isinstance(manifest, str | PathLike):
        manifest, beside, read_from = _read_beside(fspath(manifest), layout)
        recording_of, sources = recording_of or beside, sources or read_from
    if not isinstance(manifest, Manifest):
        raise OptionError(f"fit_centrifuge: expected a manifest or its file, found {quoted(manifest)}")
    if not callable(recording_of):
        raise OptionError("fit_centrifuge: a manifest without its file needs recording_of, a function of a run")
    recordings = _TemperatureKeeper(recording_of)
    statics: list[StaticRun] = []
    runs: list[LoadedRun] = []
    numbers, drawn = level_numbers(manifest), set[tuple[str, int]]()
    order = sorted(range(len(manifest.runs)), key=lambda i: manifest.runs[i].role != "static")
    for done, index in enumerate(order, start=1):
        run = manifest.runs[index]
        if run.role == "static":
            statics.append(reduce_static(recordings(run), manifest, index))
        else:
            rest = _static_mean(statics, run, manifest, index) if method == "fourier" else None
            place = run.spin_axis, numbers[index]
            runs.append(reduce_run(recordings(run), manifest, index, rest, spectrum=place not in drawn))
            drawn.add(place)
        if progress is not None:
            progress(done)
    _check_channels(statics, runs, manifest)
    levels = before = pool_levels(runs, manifest, method)
    corrections = find_corrections(runs, before.lines, correct=method == "least-squares")
    if corrections.common:
        levels = pool_levels(corrected(runs, corrections), manifest, method)
    estimates = estimate(levels, manifest, method=method, curve=curve)
    record = make_record(
        manifest=manifest,
        statics=statics,
        runs=runs,
        levels=levels,
        estimates=estimates,
        budget=error_budget(runs, before.lines, manifest, corrections.corrected),
        findings=corrections.warnings,
        options={"method": method, "curve": curve},
        sources=sources() if sources is not None else (),
        temperature=float(np.mean(recordings.temperatures)) if recordings.temperatures else None,
    )
    return CentrifugeFit(record, tuple(runs), levels, estimates)


def _read_beside(
    file: str, layout: str | PathLike[str] | None
) -> tuple[Manifest, Callable[[Run], Iterable[Recording]], Callable[[], list[Source]]]:
    """Return a manifest, a function that reads the recordings beside it, and one that states their files and hashes."""
    test, folder = load_manifest(file), Path(file).parent
    paths = {run.file: folder / run.file for run in test.runs}
    for index, run in enumerate(test.runs):  # a missing file is refused before hours of data are read
        if not paths[run.file].is_file():
            raise ReadError(f"{test.place(index)}: no such file")

    def blocks(run: Run) -> Iterable[Recording]:
        return on_clock_of(read_blocks(paths[run.file], None if layout is None else fspath(layout), window=run.window))

    def sources() -> list[Source]:
        return [_source(called, path) for called, path in ((file, Path(file)), *paths.items())]

    return test, blocks, sources


def _source(called: str, path: Path) -> Source:
    with open_file(path) as stream:
        return Source(called, file_digest(stream, "sha256").hexdigest())


def check_options(method: str, curve: str) -> None:
    """Check the options before any data are read.

    Raises
    ------
    OptionError
        Unknown method or curve.
    """
    if method not in METHODS:
        raise OptionError(f"method {method!r}: expected one of {listed(METHODS, method)}")
    if curve != "auto" and curve not in CURVES:
        raise OptionError(f"curve {curve!r}: expected one of {listed(('auto', *CURVES), curve)}")


@dataclass
class _TemperatureKeeper:
    """Reader of blocks that keeps the temperature at the start of each run."""

    source: Callable[[Run], Iterable[Recording]]
    temperatures: list[float] = field(default_factory=list)

    def __call__(self, run: Run) -> Iterator[Recording]:
        for number, block in enumerate(self.source(run)):
            if number == 0 and (temperature := block.mean_temperature()) is not None:
                self.temperatures.append(temperature)
            yield block


def _static_mean(statics: list[StaticRun], run: Run, manifest: Manifest, index: int) -> Array:
    """Return the mean of the static records of a run's power cycle, weighted by their samples."""
    mine = [static for static in statics if static.run.power_cycle == run.power_cycle]
    if len({static.channels for static in mine}) > 1:
        raise DataError(f"{manifest.place(index)}: the static runs of its power cycle have different columns")
    mean: Array = np.average([static.mean for static in mine], axis=0, weights=[static.samples for static in mine])
    return mean


def _check_channels(statics: list[StaticRun], runs: list[LoadedRun], manifest: Manifest) -> None:
    reduced: list[StaticRun | LoadedRun] = [*statics, *runs]
    for each in reduced:
        if "dtg_y" not in each.channels and any("dtg_y" in run.channels for run in runs):
            raise DataError(f"{manifest.place(each.index)}: no column dtg_y, which other runs have")
