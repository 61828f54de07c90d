"""Where the work is done: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import logging
import queue
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import Any, Protocol

from imulab._version import VERSION
from imulab.errors import OptionError, listed
from imulab.fleet import ENGINES, processes
from imulab.fleet.manifest import FleetUnit
from imulab.fleet.processes import WorkersLostError
from imulab.fleet.work import Job, Outcome, work

_CONNECT = 10.0
"""Seconds to wait for a scheduler, and as many for its first worker: both must be over within 45 s."""
_AHEAD = 3
"""Units at the scheduler for each thread of the cluster, so that none waits for the driver."""
_LOST = 30.0
"""Seconds without scheduler, without workers, or with nothing left of what was submitted, before giving up."""


class Engine(Protocol):
    """Something that works on units."""

    def run(self, units: Sequence[FleetUnit], job: Job) -> Iterator[Outcome]:
        """Work on the units, and give each outcome as it comes; raises WorkersLostError."""

    def run_alone(self, unit: FleetUnit, job: Job) -> Iterator[Outcome]:
        """Work on one unit with nothing beside it, in a process that may end."""


class LocalEngine:
    """Processes of this machine: nothing to start; one process works without a second."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def run(self, units: Sequence[FleetUnit], job: Job) -> Iterator[Outcome]:
        """Work on the units in several processes."""
        workers = min(self.workers, max(len(units), 1))
        calls = ((unit, job) for unit in units)
        return (work(*call) for call in calls) if workers == 1 else processes.run(work, calls, workers)

    def run_alone(self, unit: FleetUnit, job: Job) -> Iterator[Outcome]:
        """Work on one unit in a process of its own."""
        return processes.run(work, [(unit, job)], 1)


class DaskEngine:
    """Workers of a Dask cluster."""

    def __init__(self, client: Any, name: str) -> None:
        self._client = client
        self._name = name

    def run(self, units: Sequence[FleetUnit], job: Job) -> Iterator[Outcome]:
        """Work on the units on the cluster, and see to it that a lost cluster is noticed."""
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
        """Give each outcome as it comes; the scheduler has a few units for each thread."""
        from distributed import as_completed

        threads = sum(self._client.ncores().values())
        waiting = (self._client.submit(work, unit, job, pure=False) for unit in units)
        first = list(islice(waiting, _AHEAD * max(threads, 1)))
        running = as_completed(first, loop=self._client.loop, with_results=True)  # type: ignore[no-untyped-call]
        for _, outcome in running:
            yield outcome
            running.update(list(islice(waiting, 1)))  # type: ignore[no-untyped-call]

    def run_alone(self, unit: FleetUnit, job: Job) -> Iterator[Outcome]:
        """Work on one unit."""
        return self.run([unit], job)


class _Watch:
    """Notices that nothing more will come of a cluster, which Dask would wait for without end."""

    def __init__(self, client: Any, name: str) -> None:
        self._client = client
        self._name = name
        self._since: dict[str, float] = {}

    def forget_losses(self) -> None:
        self._since.clear()

    def look(self, *, end: bool = False) -> None:
        """Raise if the cluster is lost for some time; with `end`, because work has ended in an error, at once."""
        patience = 0.0 if end else _LOST
        workers: Any = {}
        tasks: dict[str, Any] = {}
        connected = self._client.status == "running"
        if connected:
            try:
                workers, tasks = self._client.ncores(), self._client.processing()
            except Exception:  # the connection was lost in between
                connected = False
        if self._seen("scheduler", not connected, patience):
            raise OptionError(f"scheduler {self._name}: the connection is lost; a second run does what is missing")
        if connected and self._seen("workers", not workers, patience):
            raise OptionError(f"scheduler {self._name}: no workers are left; a second run does what is missing")
        if connected and self._seen("tasks", not any(tasks.values()), _LOST):
            raise WorkersLostError("nothing is left of what was submitted")

    def _seen(self, what: str, bad: bool, patience: float) -> bool:
        """Return whether `bad` has held for so long."""
        if not bad:
            self._since.pop(what, None)
            return False
        now = time.monotonic()
        return now - self._since.setdefault(what, now) >= patience


@contextmanager
def open_engine(kind: str, *, scheduler: str | None, workers: int | None) -> Iterator[Engine]:
    """Give the engine for a run.

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
        yield LocalEngine(workers or processes.available())
        return
    with ExitStack() as stack:
        yield _dask(scheduler, workers, stack)


def _dask(scheduler: str | None, workers: int | None, stack: ExitStack) -> DaskEngine:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise OptionError("--engine dask needs Dask: pip install 'imulab[fleet]'") from None
    for name in ("asyncio", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("asyncio", "distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # `_Watch` reports what a person must know
    if scheduler is None:
        count = workers or processes.available()
        cluster = stack.enter_context(
            LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=count, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
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
    """Wait until something listens at an address: a client that fails to connect leaves its complaints on the screen.

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
    """Check that there are workers, and that each has this version of imulab."""
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
