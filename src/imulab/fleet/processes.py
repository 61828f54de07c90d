"""Processes of this machine, forked off one that has loaded what a fit needs: that takes time once, not in each."""

from __future__ import annotations

import ctypes
import math
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from queue import SimpleQueue
from types import ModuleType
from typing import TypeVar

T = TypeVar("T")

_FORKS = sys.platform == "linux"  # what other systems' libraries start when they are loaded does not always outlive it
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
_AHEAD = 64
"""Calls for each process that wait, so that none waits for a driver that is writing to the history."""

_KEPT = {-3: 1 << 25, -1: 1 << 28}
"""Bytes up to which glibc is to keep memory: M_MMAP_THRESHOLD, of which that is the most, and M_TRIM_THRESHOLD."""

_STARTING = threading.Lock()
"""Held where what all threads share is changed for a process that is started: environment and main module."""

_QUOTA = Path("/sys/fs/cgroup/cpu.max")


class ProcessLostError(Exception):
    """A process has ended under its work."""


def available() -> int:
    """Return how many processors this process may use, by its affinity and the quota of its control group."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = _QUOTA.read_text().split()
        return count if quota == "max" else max(1, min(count, math.ceil(int(quota) / int(period))))
    except (OSError, ValueError):
        return count


def prepare(modules: Sequence[str]) -> None:
    """Begin to load modules in the process that others will be forked off, and do not wait for it."""
    if _FORKS:
        multiprocessing.set_forkserver_preload(list(modules))
        _method()


def _method() -> str:
    """Return how processes are started, and start the one that is to fork if none runs."""
    if not _FORKS:
        return "spawn"
    from multiprocessing import forkserver, resource_tracker

    resource_tracker.ensure_running()  # by itself: it would let interrupts through again
    try:
        with _interrupts_later(), _STARTING, _one_thread_each():
            forkserver.ensure_running()
    except OSError:  # the name of the folder for temporary files is too long for a socket
        return "spawn"
    return "forkserver"


def run(function: Callable[..., T], calls: Iterable[tuple[object, ...]], processes: int) -> Iterator[T]:
    """Give the results of calls as they come; no process outlives this one.

    Raises
    ------
    ProcessLostError
        A process has ended under its work; the others are ended too.
    """
    context = multiprocessing.get_context(_method())
    pool = ProcessPoolExecutor(processes, mp_context=context, initializer=_attend)
    over: SimpleQueue[Future[T]] = SimpleQueue()
    left = 0
    try:
        for call in calls:
            with _interrupts_later(), _STARTING, _one_thread_each(), _without_main():
                future = pool.submit(function, *call)
            future.add_done_callback(over.put)
            left += 1
            if left >= _AHEAD * processes:
                yield over.get().result()
                left -= 1
        for _ in range(left):
            yield over.get().result()
    except (BrokenProcessPool, EOFError, ConnectionError) as error:  # the latter two: of the one that is to fork
        raise ProcessLostError(str(error)) from None
    finally:
        _end(pool)


def _end(pool: ProcessPoolExecutor) -> None:
    """Wait for what is under work and end the processes; a second interrupt does not wait."""
    workers = list((pool._processes or {}).values())
    try:
        pool.shutdown(cancel_futures=True)
    except KeyboardInterrupt:  # which would leave them waiting for work, and this process for them
        for worker in workers:
            worker.kill()
        raise


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that are started meanwhile use one thread for linear algebra and text: they are several already."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Start processes without being interrupted: none that nobody waits for, and none that hears of interrupts itself.

    An interrupt of the terminal goes to all its processes; this one says what is to be said of it.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main() -> Iterator[None]:
    """Start processes that do not run the script again that called: nothing that it defines is sent to them."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def keep_memory() -> None:
    """Keep the memory that one unit has used for the next, as far as the C library lets itself be told.

    Otherwise it goes back to the system with every recording, which clears it page by page before it gives it again: a
    seventh of the time of a unit.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library, or a system that does not give its own
        return
    for parameter, size in _KEPT.items():
        mallopt(parameter, size)


def _attend() -> None:
    """Leave interrupts to the process that started this one, and end with it, whatever that dies of."""
    keep_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
