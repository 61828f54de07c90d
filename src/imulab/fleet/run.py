"""A run over a fleet: every unit that has no record of its present files and options is fitted, once."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Annotated

from imulab._version import VERSION
from imulab.arguments import Folder
from imulab.display import SENTENCES, Shown
from imulab.errors import ImulabError, OptionError, first_of
from imulab.files import real_path, write_text
from imulab.fleet import ENGINES
from imulab.fleet.engine import (
    DONE,
    FAILED,
    KEPT,
    LEFT,
    Engine,
    Job,
    Outcome,
    Summary,
    WorkersLostError,
    kept,
    open_engine,
    summarise,
)
from imulab.fleet.history import History, open_history
from imulab.fleet.manifest import FleetManifest, FleetUnit, is_url, load_fleet
from imulab.fleet.store import Store
from imulab.fleet.table import FleetRow, check_table, write_table
from imulab.options import choice, parsed, text
from imulab.procedures.registry import PROCEDURES
from imulab.quantities import whole, whole_number

_FRUITLESS = 5
"""Losses of workers in a row, with no unit done between them, after which the run gives up."""
_QUICK = 2.0  # s of this process that are spent on looking before others are started
_FLUSH = 2.0  # s between two writings of what is done
_NAMED = 3  # units that a sentence names
TABLE, HISTORY = "parameters.csv", "history.sqlite"


@dataclass(frozen=True, repr=False)
class FleetState(Shown):
    """State of a fleet.

    Attributes
    ----------
    folder, manifest
        Where the records are, and what was asked.
    rows
        Every unit of the manifest in its order: ``done``, ``failed`` or ``missing``.
    kept
        Number of units that had their record before this run.
    at_work
        Process that works on the folder now, or None.
    seconds
        Time that the run took.
    notes
        What a person must know besides, a sentence each.
    """

    folder: str
    manifest: FleetManifest
    rows: tuple[FleetRow, ...]
    kept: int = 0
    at_work: str | None = None
    seconds: float = 0.0
    notes: tuple[str, ...] = ()

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return how many units are done, failed and missing, the verdicts of their records, and which units failed."""
        counts = ", ".join(f"{self.count(name)} {name}" for name in ("done", "failed", "missing"))
        rows = [[row.unit.serial, "; ".join(row.unit.files), row.reason or ""] for row in self.failures]
        units = f"{len(self.rows)} unit{'s' * (len(self.rows) != 1)}"
        headline = f"{units} of {self.manifest.name}: {counts}" + (self.judged and f"; {self.judged}")
        return headline, ["failed", "files", "reason"], rows

    def count(self, status: str) -> int:
        """Return the number of units with this status."""
        return sum(row.status == status for row in self.rows)

    @property
    def doubtful(self) -> list[FleetRow]:
        """The units whose record is not ``good``, the ``bad`` ones first."""
        return [row for state in ("bad", "look") for row in self.rows if row.verdict == state]

    @property
    def judged(self) -> str:
        """How many records are good, and which are not, with reasons: ``2 good, 1 look: SN2 ...``; or nothing."""
        same: dict[str, list[str]] = {}
        for row in self.doubtful:
            same.setdefault(row.first_reason, []).append(row.unit.serial)
        named = [f"{first_of(serials, _NAMED)} {reason}" for reason, serials in same.items()]
        return self.verdicts + (": " + first_of(named, _NAMED, "; ") if named else "")

    @property
    def verdicts(self) -> str:
        """How many records are good, to be looked at, and bad: ``2 good, 1 look``; empty without records."""
        counts = {state: sum(row.verdict == state for row in self.rows) for state in SENTENCES}
        return ", ".join(f"{count} {state}" for state, count in counts.items() if count)

    @property
    def failures(self) -> tuple[FleetRow, ...]:
        """The units that failed."""
        return tuple(row for row in self.rows if row.status == FAILED)


def default_history(folder: str | Path) -> str:
    """Return the URL of a fleet's history if no other is named."""
    return f"sqlite:///{real_path(folder) / HISTORY}"


def run_fleet(
    manifest: str | PathLike[str] | FleetManifest,
    folder: Folder,
    *,
    engine: Annotated[str, choice(ENGINES)] = "local",
    scheduler: Annotated[str | None, text("ADDRESS")] = None,
    workers: Annotated[int | str | None, parsed(whole_number, "N")] = None,
    history: Annotated[str | None, text("URL")] = None,
    table: Annotated[str | None, text("OUT")] = None,
    started: Callable[[int], None] = lambda _: None,
    progress: Callable[[int], None] = lambda _: None,
) -> FleetState:
    """Calibrate every unit of a manifest that has no record of its present files and options yet.

    Writes ``folder/<serial>.json`` as soon as a unit is done, ``folder/parameters.csv`` and the history at the end and
    on the way. It can be killed at any moment; the next run does what is missing. One unit's failure is that unit's.

    Parameters
    ----------
    manifest
        CSV or Parquet, path or URL: ``serial,procedure,file`` and options of the fits; or such a one as it was read.
    folder
        Where the records go; made if it is not there.
    engine
        Processes of this machine, or a Dask cluster.
    scheduler
        Scheduler of a Dask cluster, as tcp://host:8786. One is started here if not given.
    workers
        Processes; one for each processor if not given.
    history
        SQLite or PostgreSQL, or none; a file in DIR if not given. A URL of SQLAlchemy.
    table
        .csv or .parquet; parameters.csv in DIR if not given. Table of all parameters.
    started, progress
        Called once with the number of units, then with the number of units that are over.

    Raises
    ------
    ReadError, OptionError
        The manifest, an option, the folder, the cluster or the history cannot be used.

    Examples
    --------
    >>> import imulab as il
    >>> first, second = il.simulate_fleet("line", units=8)
    >>> il.run_fleet(first, "line/records", workers=1).count("done")
    8
    """
    begin = time.monotonic()
    number = None if workers is None else whole(workers, "workers")
    fleet = manifest if isinstance(manifest, FleetManifest) else load_fleet(os.fspath(manifest))
    folder = os.fspath(folder)
    if not folder:
        raise OptionError("output '': expected the name of a folder to write to")
    store = Store(real_path(folder))
    if store.folder.exists() and not store.folder.is_dir():
        raise OptionError(f"{folder}: expected a folder to write to, found a file")
    if table is not None:
        check_table(table)
    table_file = Path(table) if table is not None else store.folder / TABLE
    refuse_overwriting([table_file, *(store.record(unit.serial) for unit in fleet.units)], read_by(fleet))
    if table is not None:
        refuse_overwriting([table_file], own_files(store, fleet, table=False))
    with ExitStack() as stack:
        notes: list[str] = []
        past = _open_history(history, stack) if history else None
        machine = stack.enter_context(open_engine(engine, scheduler=scheduler, workers=number))
        token = stack.enter_context(store.run())
        if history is None:
            try:
                past = _open_history(default_history(store.folder), stack)
            except OptionError as error:
                notes.append(f"no history is kept: {error}")
        store.keep_manifest(fleet)
        started(len(fleet.units))
        keeper = _Keeper(store, fleet, past, progress)
        try:
            _work_through(machine, Job(str(store.folder), fleet.base, token), keeper)
        finally:
            store.tidy()
        keeper.flush()
        rows = keeper.rows()
        write_table(rows, table_file)
    return FleetState(
        folder, fleet, rows, kept=keeper.kept, seconds=time.monotonic() - begin,
        notes=(*notes, *keeper.notes, *_remarks_on(rows)),
    )  # fmt: skip


def read_by(fleet: FleetManifest) -> dict[str, str]:
    """Return the local files that a fleet reads, full name to name: manifest, recordings, layouts, priors."""
    if is_url(fleet.base):
        return {}
    files = {_absolute(os.path.join(fleet.base, Path(fleet.name).name)): fleet.name}  # noqa: PTH118
    for unit in fleet.units:
        options = PROCEDURES[unit.procedure].task.options
        paths = [unit.options[o.name] for o in options if o.reads.file and o.name in unit.options]
        for name in (*unit.files, *paths):
            if not is_url(name):
                files[_absolute(os.path.join(fleet.base, name))] = name  # noqa: PTH118
    return files


def own_files(store: Store, fleet: FleetManifest, *, table: bool = True) -> dict[str, str]:
    """Return the files in a fleet's folder, full name to name."""
    names = [HISTORY, TABLE] if table else [HISTORY]
    mine = [*(store.record(unit.serial) for unit in fleet.units), *(store.folder / name for name in names)]
    return {_absolute(path): str(path) for path in mine}


def _absolute(path: str | Path) -> str:
    folder, name = os.path.split(os.path.abspath(path))  # noqa: PTH100
    return os.path.join(_real_folder(folder), name)  # noqa: PTH118


@lru_cache(maxsize=64)
def _real_folder(folder: str) -> str:
    return os.path.realpath(folder)


def refuse_overwriting(outputs: Iterable[Path], kept: Mapping[str, str]) -> None:
    """Refuse an output that would replace a file that is to be kept.

    Raises
    ------
    OptionError
        One does.
    """
    for path in outputs:
        taken = kept.get(_absolute(path))
        if taken is not None:
            raise OptionError(f"{path}: would overwrite {taken}; expected another name or folder")


def _open_history(url: str, stack: ExitStack) -> History | None:
    return None if url == "none" else stack.enter_context(open_history(url))


class _Keeper:
    """Receiver of outcomes: it keeps what is done, and writes folder and history."""

    def __init__(
        self, store: Store, fleet: FleetManifest, history: History | None, progress: Callable[[int], None]
    ) -> None:
        self.store = store
        self.left = {unit.serial: unit for unit in fleet.units}
        self.unseen: set[str] = set()
        self.kept = 0
        self.notes: list[str] = []
        self._fleet = fleet
        self._history = history
        self._progress = progress
        self._over: dict[str, Outcome] = {}
        self._new: list[Summary] = []
        self._flushed = time.monotonic()
        self.before = {path.stem for path in store.folder.glob("*.json")}

    def take(self, outcome: Outcome) -> None:
        """Take one outcome in."""
        if outcome.status == LEFT:  # a worker that has another folder of this name: it is to send the record back
            self.unseen.add(outcome.serial)
            return
        unit = self.left.pop(outcome.serial, None)
        if unit is None:
            return
        if outcome.text is not None:
            write_text(self.store.record(unit.serial), outcome.text)
        if outcome.status == FAILED and self.store.reason(unit.serial) is None:
            self.store.fail(unit, outcome.reason)
        # A record that was not there before was made by a process that ended before it could say so.
        self.kept += outcome.status == KEPT and unit.serial in self.before
        self._over[unit.serial] = replace(outcome, text=None)
        if outcome.summary is not None:
            self._new.append(outcome.summary)
        if time.monotonic() - self._flushed > _FLUSH:
            self.flush()
        self._progress(len(self._over))

    def flush(self) -> None:
        """Hand what is new to the history."""
        if self._history is not None:
            try:
                self._history.add(self._new)
            except OptionError as error:  # the records are the truth, and the next run hands them in again
                self._history = None
                self.notes.append(f"the history is not complete: {error}")
        self._new.clear()
        self._flushed = time.monotonic()

    def rows(self) -> tuple[FleetRow, ...]:
        """Return the state of every unit, in the order of the manifest."""
        return tuple(
            FleetRow(unit, DONE if outcome.status == KEPT else outcome.status, outcome.reason, outcome.summary)
            for unit in self._fleet.units
            for outcome in [self._over[unit.serial]]
        )


def _remarks_on(rows: Sequence[FleetRow]) -> Iterator[str]:
    """Return remarks on the records as a whole, which no single record can make."""
    made = [row.summary for row in rows if row.summary is not None]
    others = [summary.software for summary in made if summary.software != f"imulab {VERSION}"]
    if others:
        yield (
            f"{_counted(len(others), 'record')} of another version ({', '.join(sorted(set(others)))}) kept: "
            f"to fit again with imulab {VERSION}, use another folder"
        )
    owners: dict[object, list[str]] = {}
    for row in rows:
        if row.summary is not None:  # one log may hold several sensors: options tell them apart
            key = row.unit.procedure, row.summary.inputs, tuple(row.unit.options.items())
            owners.setdefault(key, []).append(row.unit.serial)
    shared = [serials for serials in owners.values() if len(serials) > 1]
    if shared:
        more = f" (and {_counted(len(shared) - 1, 'more set')} like these)" if len(shared) > 1 else ""
        first = shared[0]
        yield f"serials {first_of(first, 3)} were made from files of the same content{more}: is a file named twice?"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _take_kept(base: str, keeper: _Keeper) -> None:
    """Take the units that are done already, if that takes no longer than to start processes would."""
    until = time.process_time() + _QUICK
    for unit in () if is_url(base) else list(keeper.left.values()):
        if time.process_time() > until:
            return
        if unit.serial in keeper.before and not any(map(is_url, unit.files)):
            with suppress(ImulabError):  # said when the unit is worked on
                if (outcome := kept(unit, base, keeper.store)) is not None:
                    keeper.take(outcome)


def _work_through(engine: Engine, job: Job, keeper: _Keeper) -> None:
    """Work until every unit is done or has failed, also if processes end meanwhile."""
    _take_kept(job.base, keeper)
    fruitless = 0
    while keeper.left:
        before = len(keeper.left)
        # Whatever was under work when a process ended is tried with nothing beside it, so that a unit that ends its
        # process is told from those that happened to be near.
        suspects = keeper.store.marked() & set(keeper.left)
        easy = [unit for unit in keeper.left.values() if unit.serial not in suspects]
        away = [unit for unit in easy if unit.serial in keeper.unseen]
        try:
            if away:
                _take_all(engine.run(away, replace(job, folder=None)), keeper)
            elif easy:
                _take_all(engine.run(easy, job), keeper)
            for serial in sorted(suspects & set(keeper.left)):
                _take_all(engine.run_alone(keeper.left[serial], job), keeper)
        except WorkersLostError as error:
            fruitless = fruitless + 1 if len(keeper.left) == before and not suspects else 0
            if fruitless >= _FRUITLESS:
                raise OptionError(
                    f"worker processes ended {fruitless} times before a unit was done ({' '.join(str(error).split())})"
                ) from None


def _take_all(outcomes: Iterator[Outcome], keeper: _Keeper) -> None:
    with closing(outcomes):  # type: ignore[type-var]
        for outcome in outcomes:
            keeper.take(outcome)


def fleet_status(folder: Folder) -> FleetState:
    """Return the state of a fleet, from its records alone.

    Parameters
    ----------
    folder
        Where the records are.

    Raises
    ------
    OptionError
        The folder is none of a fleet.

    Examples
    --------
    >>> import imulab as il
    >>> first, second = il.simulate_fleet("line", units=8)
    >>> il.run_fleet(first, "line/records", workers=1).seconds > 0
    True
    >>> il.fleet_status("line/records").failures
    ()
    """
    folder = os.fspath(folder)
    store = Store(Path(folder))
    fleet = store.manifest()
    return FleetState(folder, fleet, tuple(_row(store, unit) for unit in fleet.units), at_work=store.at_work())


def _row(store: Store, unit: FleetUnit) -> FleetRow:
    reason = store.reason(unit.serial)
    if reason is not None:
        return FleetRow(unit, FAILED, reason, None)
    there = store.made_for(unit)
    return FleetRow(unit, "missing", "", None) if there is None else FleetRow(unit, DONE, "", summarise(*there))
