"""The processes that fit the units of a fleet: on this machine or on a Dask cluster, and the work of each on one unit.

What a worker does with one unit.
"""

from __future__ import annotations

import logging
import os
import pickle
import queue
import signal
import socket
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Protocol, TypeVar

from imulab._version import VERSION
from imulab.display import UNJUDGED, Note, Verdict
from imulab.errors import ImulabError, OptionError, install, listed
from imulab.files import write_text
from imulab.fleet import ENGINES
from imulab.fleet.manifest import FleetUnit, UnitFiles
from imulab.fleet.store import MOST_ATTEMPTS, Store, request_of
from imulab.procedures.procedure import OnLine
from imulab.procedures.registry import PROCEDURES, run_task
from imulab.records.calibration import Calibration, Parameter

# Processes of this machine, managed by joblib.


T = TypeVar("T")

_LOOK = 0.2
"""Seconds between two checks of a process that the one that started it still runs."""


class WorkersLostError(Exception):
    """Processes have ended during their work; units without a written record have to be fitted again."""


def available() -> int:
    """Return the number of processors that this process may use, by its affinity and its control group's quota."""
    from joblib import cpu_count

    return int(cpu_count())


def run(function: Callable[..., T], calls: Iterable[tuple[object, ...]], processes: int) -> Iterator[T]:
    """Give the results of calls as they come, each from a process that uses one thread for linear algebra.

    The processes wait for further work and end with this one. An error or interrupt here ends them at once.

    Raises
    ------
    WorkersLostError
        A process has ended under its work; the others are ended too.
    """
    from joblib import Parallel, delayed, parallel_config

    # Where joblib is asked for one process it works in this one, which must outlive its work.
    config = parallel_config(
        "loky", n_jobs=max(2, processes), inner_max_num_threads=1, initializer=_begin, initargs=(os.getpid(),)
    )
    try:
        with ExitStack() as stack:
            with _no_interrupts():  # joblib starts processes and threads as soon as it is entered
                stack.enter_context(config)
                parallel = stack.enter_context(Parallel(return_as="generator_unordered", max_nbytes=None))
                results = parallel(delayed(function)(*call) for call in calls)
                stack.callback(_close, results)
            for result in results:  # noqa: UP028 - `yield from` would close them too, with a warning
                yield result
    except BrokenProcessPool as error:
        raise WorkersLostError(str(error)) from None


def _close(results: Generator[object, None, None]) -> None:
    """Close results that nobody reads, silently: joblib warns, and its thread may look for work that was dropped."""
    hook = threading.excepthook
    threading.excepthook = lambda _: None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            results.close()
    finally:
        threading.excepthook = hook


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Block interrupts while processes, and threads that start processes, are started.

    An interrupt of the terminal goes to all its processes; this one alone reports it, once the processes have been
    started.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # Python's own helper process lets interrupts through again where it is started after they were held back.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(parent: int) -> None:
    """End this process soon after the one that started it ends, for whatever reason."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# Work on one unit: nothing if its record exists, else fit and write it, and return the outcome.


DONE, KEPT, FAILED, LEFT = "done", "kept", "failed", "left"
"""Made now; made before; refused, with a reason; not touched, because another run has taken over."""


@dataclass(frozen=True)
class Job:
    """Values common to all units of a run: folder of the records, base of the manifest's paths, token of the run.

    Without a folder the records are sent back.
    """

    folder: str | None
    base: str
    token: str


@dataclass(frozen=True)
class Summary:
    """The part of a record that a run, its table and its history use.

    `inputs` are the hashes of its files; `freedom` the degrees of freedom of its uncertainties, None where the noise
    was known; `on_line` is what its own parameters are about, where that differs from record to record.
    """

    serial: str
    procedure: str
    created: str
    date: str | None
    software: str
    content_sha256: str
    inputs: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    warnings: tuple[str, ...]
    freedom: float | None
    verdict: Verdict = UNJUDGED
    on_line: OnLine | None = None

    @property
    def when(self) -> str:
        """Date of the recording if its head states one, otherwise that of the record."""
        return self.date or self.created


@dataclass(frozen=True)
class Outcome:
    """Result of the work on one unit; `text` is the record if the worker does not see the folder."""

    serial: str
    status: str
    reason: str = ""
    summary: Summary | None = None
    text: str | None = field(default=None, repr=False)


def work(unit: FleetUnit, job: Job) -> Outcome:
    """Return the outcome for a unit: its record is made, unless one from the same files and options exists."""
    if job.folder is None:
        return _fit(unit, job, None)
    store = Store(Path(job.folder))
    with store.turn(job.token) as mine:
        if mine is False:
            return Outcome(unit.serial, LEFT)
        if mine is None:
            return _fit(unit, job, None)
        if store.begin(unit.serial) >= MOST_ATTEMPTS:
            reason = f"its process ended {MOST_ATTEMPTS} times while it worked on this unit (killed, or out of memory)"
            outcome = Outcome(unit.serial, FAILED, reason)
        else:
            outcome = _fit(unit, job, store)
        if outcome.status == FAILED:
            store.fail(unit, outcome.reason)
        store.end(unit.serial)
        return outcome


def _work_all(units: Sequence[FleetUnit], job: Job) -> bytes:
    """Return the outcomes of units, pickled: Dask would measure, pickle and pass on each value within them."""
    return pickle.dumps([work(unit, job) for unit in units])


def kept(unit: FleetUnit, base: str, store: Store) -> Outcome | None:
    """Return the outcome of a unit that has a record of its present files and options, else None."""
    with UnitFiles(base) as files:
        return _kept(unit, files, store)


def _kept(unit: FleetUnit, files: UnitFiles, store: Store) -> Outcome | None:
    there = store.made_for(unit)
    if there is None or not files.unchanged(there[0].sections["fleet"].get("inputs", ())):
        return None
    return Outcome(unit.serial, KEPT, summary=summarise(*there))


def _fit(unit: FleetUnit, job: Job, store: Store | None) -> Outcome:
    try:
        with UnitFiles(job.base) as files:
            if store is not None and (there := _kept(unit, files, store)) is not None:
                return there
            record = make_record(unit, files)
        content_sha256, text = record.sealed()
        if store is not None:
            write_text(store.record(unit.serial), text)
        summary = summarise(record, content_sha256)
        return Outcome(unit.serial, DONE, summary=summary, text=None if store is not None else text)
    except ImulabError as error:
        return Outcome(unit.serial, FAILED, _one_line(str(error)))
    except Exception as error:
        if os.environ.get("IMULAB_DEBUG"):
            raise
        return Outcome(unit.serial, FAILED, _one_line(f"{type(error).__name__}: {error} (a fault of imulab)"))


def make_record(unit: FleetUnit, files: UnitFiles) -> Calibration:
    """Return the record of a unit, fitted as the single command does, with the files that it was made from."""
    record = run_task(unit.procedure, unit.files, unit.options, files, label="column {}")
    others = [serial for serial in files.serials if serial != unit.serial]
    says = [
        Note(f"the file states serial {serial!r}, the manifest {unit.serial!r}: the manifest's is used")
        for serial in others
    ]
    made = {
        **request_of(unit),
        "inputs": [{"file": name, "sha256": sha256} for name, sha256 in files.inputs.items()],
        **({} if files.date is None else {"date": files.date}),
    }
    return replace(
        record,
        sensor={**record.sensor, "serial": unit.serial},
        warnings=(*record.warnings, *says),
        sections={**record.sections, "fleet": made},
    )


def summarise(record: Calibration, content_sha256: str) -> Summary:
    """Return the values that table and history use of a record that `make_record` has made."""
    made = record.sections["fleet"]
    on_line = PROCEDURES[made["procedure"]].on_line(record)
    return Summary(
        serial=record.sensor["serial"],
        procedure=made["procedure"],
        created=record.created,
        date=made.get("date"),
        software=record.software,
        content_sha256=content_sha256,
        inputs=tuple(item["sha256"] for item in made["inputs"]),
        parameters={**record.parameters, **({} if on_line is None else on_line.parameters)},
        warnings=record.warnings,
        freedom=_freedom(record) if on_line is None else on_line.freedom,
        verdict=record.verdict,
        on_line=on_line,
    )


def _freedom(record: Calibration) -> float | None:
    freedom = record.fit.get("degrees_of_freedom")
    estimated = str(record.fit.get("noise", "known")).startswith("estimated")
    return float(freedom) if estimated and isinstance(freedom, int | float) and freedom > 0 else None


def _one_line(text: str) -> str:
    return " ".join(text.split())


# Engines: processes of this machine, or the workers of a Dask cluster.


_CONNECT = 10.0
"""Seconds to wait for a scheduler, and as many for its first worker: both must be over within 45 s."""
_AHEAD = 3
"""Batches at the scheduler for each thread of the cluster, so that none waits for the driver."""
_ROUNDS, _LARGEST_BATCH = 4, 16
"""A task costs some 15 ms of processor time: few units come one by one, many in batches, some for each thread."""
_UNWATCHED = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
}
"""Settings of a cluster of this run alone: nobody looks at what Dask measures, by default 50 times a second."""
_LOST = 30.0
"""Seconds without scheduler, without workers, or with nothing left of what was submitted, before giving up."""


class Engine(Protocol):
    """Base of the engines, which work on units."""

    def run(self, units: Sequence[FleetUnit], job: Job) -> Iterator[Outcome]:
        """Yield each outcome as it comes; raises WorkersLostError."""

    def run_alone(self, unit: FleetUnit, job: Job) -> Iterator[Outcome]:
        """Return the outcome of one unit, worked on alone, in a process that may end."""


class LocalEngine:
    """Processes of this machine; with a single one, no second process is started."""

    def __init__(self, workers: int | None) -> None:
        self.workers = workers

    def run(self, units: Sequence[FleetUnit], job: Job) -> Iterator[Outcome]:
        """Yield the outcomes of units from several processes."""
        workers = min(self.workers or available(), max(len(units), 1))
        calls = ((unit, job) for unit in units)
        return (work(*call) for call in calls) if workers == 1 else run(work, calls, workers)

    def run_alone(self, unit: FleetUnit, job: Job) -> Iterator[Outcome]:
        """Return the outcome of one unit from its own process."""
        return run(work, [(unit, job)], 1)


class DaskEngine:
    """Workers of a Dask cluster."""

    def __init__(self, client: Any, name: str) -> None:
        self._client = client
        self._name = name

    def run(self, units: Sequence[FleetUnit], job: Job) -> Iterator[Outcome]:
        """Yield the outcomes of units from the cluster; a lost cluster raises an error."""
        results: queue.SimpleQueue[Outcome | BaseException | None] = queue.SimpleQueue()

        def consume() -> None:
            try:
                for outcome in self._outcomes(units, job):
                    results.put(outcome)
                results.put(None)
            except BaseException as error:
                results.put(error)

        threading.Thread(target=consume, daemon=True).start()
        watch = _Watch(self._client, self._name)
        while True:
            try:
                result = results.get(timeout=1.0)
            except queue.Empty:
                watch.look()
                continue
            watch.forget_losses()
            if result is None:
                return
            if isinstance(result, BaseException):
                watch.look(end=True)
                raise WorkersLostError(str(result)) from None
            yield result

    def _outcomes(self, units: Sequence[FleetUnit], job: Job) -> Iterator[Outcome]:
        """Yield each outcome as it comes; the scheduler holds a few batches of units for each thread."""
        from distributed import as_completed

        ahead = _AHEAD * max(sum(self._client.ncores().values()), 1)
        size = min(max(len(units) // (_ROUNDS * ahead), 1), _LARGEST_BATCH)
        batches = (units[start : start + size] for start in range(0, len(units), size))
        waiting = (self._client.submit(_work_all, batch, job, pure=False) for batch in batches)
        first = list(islice(waiting, ahead))
        running = as_completed(first, loop=self._client.loop, with_results=True)  # type: ignore[no-untyped-call]
        for _, outcomes in running:
            yield from pickle.loads(outcomes)
            running.update(list(islice(waiting, 1)))  # type: ignore[no-untyped-call]

    def run_alone(self, unit: FleetUnit, job: Job) -> Iterator[Outcome]:
        """Return the outcome of one unit."""
        return self.run([unit], job)


class _Watch:
    """Check of whether a cluster is lost, for which Dask would wait without end."""

    def __init__(self, client: Any, name: str) -> None:
        self._client = client
        self._name = name
        self._since: dict[str, float] = {}

    def forget_losses(self) -> None:
        self._since.clear()

    def look(self, *, end: bool = False) -> None:
        """Raise if the cluster has been lost for some time; with `end`, because work has ended in an error, at once."""
        patience = 0.0 if end else _LOST
        workers: Any = {}
        tasks: dict[str, Any] = {}
        connected = self._client.status == "running"
        if connected:
            try:
                workers, tasks = self._client.ncores(), self._client.processing()
            except Exception:  # the connection was lost in between
                connected = False
        if self._has_lasted("scheduler", not connected, patience):
            raise OptionError(f"scheduler {self._name}: the connection is lost; a second run does what is missing")
        if connected and self._has_lasted("workers", not workers, patience):
            raise OptionError(f"scheduler {self._name}: no workers are left; a second run does what is missing")
        if connected and self._has_lasted("tasks", not any(tasks.values()), _LOST):
            raise WorkersLostError("nothing is left of what was submitted")

    def _has_lasted(self, what: str, bad: bool, patience: float) -> bool:
        """Return whether `bad` has lasted for so long."""
        if not bad:
            self._since.pop(what, None)
            return False
        now = time.monotonic()
        return now - self._since.setdefault(what, now) >= patience


@contextmanager
def open_engine(kind: str, *, scheduler: str | None, workers: int | None) -> Iterator[Engine]:
    """Return the engine for a run.

    Raises
    ------
    OptionError
        Unknown engine, options that do not go together, or a cluster that cannot be reached or used.
    """
    if kind not in ENGINES:
        raise OptionError(f"engine {kind!r}: unknown engine; known engines: {listed(ENGINES, kind)}")
    if scheduler is not None and kind != "dask":
        raise OptionError(f"--scheduler {scheduler!r} needs --engine dask")
    if scheduler is not None and workers is not None:
        raise OptionError("--workers together with --scheduler: a cluster has the workers that it has")
    if workers is not None and workers < 1:
        raise OptionError(f"--workers {workers}: expected 1 or more")
    if kind == "local":
        yield LocalEngine(workers)
        return
    with ExitStack() as stack:
        yield _dask(scheduler, workers, stack)


def _dask(scheduler: str | None, workers: int | None, stack: ExitStack) -> DaskEngine:
    try:
        from dask import config
        from distributed import Client, LocalCluster
    except ImportError:
        raise OptionError(f"--engine dask needs Dask: {install('fleet')}") from None
    for name in ("asyncio", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("asyncio", "distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # `_Watch` reports what a person must know
    if scheduler is None:
        count = workers or available()
        stack.enter_context(config.set(_UNWATCHED))
        cluster = stack.enter_context(
            LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=count,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL + 1,  # of the workers' processes too, which may outlive the scheduler
            )
        )
        scheduler = str(cluster.scheduler_address)
    _check_address(scheduler)
    try:
        client = stack.enter_context(Client(scheduler, timeout=_CONNECT, set_as_default=False))  # type: ignore[no-untyped-call]
    except Exception as error:  # something answers there that is no scheduler, or nothing in time
        reason = _last_line(error)
        raise OptionError(f"scheduler {scheduler}: cannot be reached within {_CONNECT:.0f} s ({reason})") from None
    _check_workers(client, scheduler)
    return DaskEngine(client, scheduler)


def _check_address(address: str) -> None:
    """Wait until something listens at an address, because a client that fails to connect prints its errors.

    Raises
    ------
    OptionError
        The address is none, has an unknown host, or nothing listens there in time.
    """
    from distributed.comm.addressing import get_address_host_port, parse_address

    place = f"scheduler {address}: cannot be reached"
    try:
        scheme, _ = parse_address(address)
        host, port = get_address_host_port(address, strict=True)
    except (ValueError, KeyError) as error:
        raise OptionError(f"{place}: expected an address such as tcp://host:8786 ({_last_line(error)})") from None
    if scheme not in ("tcp", "tls"):
        return
    end = time.monotonic() + _CONNECT
    while True:
        try:
            socket.create_connection((host, port), timeout=max(end - time.monotonic(), 0.1)).close()
            return
        except socket.gaierror as error:
            raise OptionError(f"{place}: {error.strerror}") from None
        except OSError as error:
            if time.monotonic() > end - 0.5:
                raise OptionError(f"{place} within {_CONNECT:.0f} s ({error.strerror or error})") from None
        time.sleep(0.2)


def _check_workers(client: Any, name: str) -> None:
    """Refuse a cluster without workers, or with a worker of another version of imulab."""
    try:
        client.wait_for_workers(1, timeout=_CONNECT)
    except TimeoutError:
        raise OptionError(f"scheduler {name}: has no workers (waited {_CONNECT:.0f} s)") from None
    try:
        versions = client.run(_version)
    except Exception as error:
        raise OptionError(f"scheduler {name}: its workers cannot import imulab ({_last_line(error)})") from None
    for address, version in versions.items():
        if version != VERSION:
            raise OptionError(f"scheduler {name}: worker {address} has imulab {version}, expected {VERSION}")


def _version() -> str:
    return VERSION


def _last_line(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
