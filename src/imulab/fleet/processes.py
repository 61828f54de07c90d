"""Processes of this machine, which joblib starts, feeds and ends.

Each keeps the memory of one recording for the next: glibc would give it back and have it cleared page by page, which
took 14 % of the time of a unit of 50,000 samples (71 ms instead of 62).
"""

from __future__ import annotations

import ctypes
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from typing import TypeVar

T = TypeVar("T")

_LOOK = 0.2
"""Seconds between two looks of a process at whether the one that started it is still there."""

_KEPT = {-3: 1 << 25, -1: 1 << 27}
"""Bytes up to which glibc is to keep memory: M_MMAP_THRESHOLD, of which that is the most, and M_TRIM_THRESHOLD.

joblib starts a process anew, with a warning, that has kept 300 MB more than at first.
"""


class WorkersLostError(Exception):
    """Processes have ended under their work; what they had not written is to be done again."""


def available() -> int:
    """Return how many processors this process may use, by its affinity and the quota of its control group."""
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
    """Close results that nobody takes, silently: joblib warns, and its thread may look for work that was dropped."""
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
    """Start processes with interrupts blocked, and threads that start more of them.

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
    """Keep memory, and end this process soon after the one that started it, whatever that dies of."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    with suppress(AttributeError, OSError, TypeError):  # another C library, or a system that does not give its own
        for parameter, size in _KEPT.items():
            ctypes.CDLL(None).mallopt(parameter, size)
