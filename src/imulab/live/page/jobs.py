"""Commands that the page runs: each in a process of its own, as if typed, with what it says and what it makes."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import time
from typing import IO

from imulab.errors import OptionError

_LONGEST, _MOST_LINES, _LONGEST_LINE = 1 << 20, 1000, 4000
_GRACE, _EVERY = 5.0, 0.1
_WINDOWS = sys.platform == "win32"


@dataclass
class Job:
    """One command.

    Attributes
    ----------
    number
        Of this session, from 1.
    path
        Of the command: ``tumble fit``.
    command
        What to type for the same, quoted for a shell.
    words
        The same without quotes, and without the program's name.
    outputs
        Paths that it is to write.
    state
        ``running``, ``done``, ``refused`` (exit status 2, or 1 of a test that failed), ``cancelled``.
    said, text
        What it has said beside its result (the lines of standard error), and its result (standard output).
    began, ended
        Seconds since 1970.
    """

    number: int
    path: str
    command: str
    words: list[str]
    outputs: list[str]
    state: str = "running"
    status: int | None = None
    said: list[str] = field(default_factory=list)
    text: str = ""
    began: float = field(default_factory=time)
    ended: float | None = None


class Jobs:
    """The commands of a session; `tell` is called with every change, from other threads."""

    def __init__(self, tell: Callable[[Job], object]) -> None:
        self.jobs: dict[int, Job] = {}
        self._tell = tell
        self._processes: dict[int, subprocess.Popen[str]] = {}
        self._watches: dict[int, threading.Thread] = {}
        self._due: set[int] = set()

    def run(self, path: str, words: Sequence[str], outputs: Sequence[str]) -> Job:
        """Begin to run a command in the working folder.

        Raises
        ------
        OptionError
            It cannot be started.
        """
        number = len(self.jobs) + 1
        job = Job(number, path, shlex.join(["imulab", *words]), list(words), list(outputs))
        process = _started(words)
        self.jobs[number], self._processes[number] = job, process
        self._watches[number] = threading.Thread(target=self._watch, args=(job, process), daemon=True)
        self._watches[number].start()
        self._tell(job)
        return job

    def cancel(self, number: int) -> None:
        """End a command; what it has half written goes with it."""
        job, process = self.jobs.get(number), self._processes.get(number)
        if job is None or process is None or job.state != "running":
            return
        job.state = "cancelled"
        _signal(process, signal.SIGTERM)
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            _signal(process, signal.SIGTERM if _WINDOWS else signal.SIGKILL)
        self._watches[number].join(_GRACE)

    def end(self) -> None:
        """End all commands."""
        for number in list(self._processes):
            self.cancel(number)

    def _watch(self, job: Job, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        assert process.stderr is not None
        reader = threading.Thread(target=self._listen, args=(job, process.stderr), daemon=True)
        reader.start()
        job.text = _read(process.stdout)
        reader.join()
        job.status = process.wait()
        job.ended = time()
        if job.state == "running":
            job.state = "done" if job.status == 0 else "refused"
        for path in [] if job.state == "done" else job.outputs:
            with suppress(OSError):
                Path(path).rmdir()  # a folder that it has made before it was refused
        del self._processes[job.number]
        self._tell(job)

    def _listen(self, job: Job, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                if len(job.said) < _MOST_LINES:
                    job.said.append(line.rstrip()[:_LONGEST_LINE])
                    self._soon(job)

    def _soon(self, job: Job) -> None:
        """Tell of a job in a moment, with what it says until then: many lines are not told one by one."""
        if job.number not in self._due:
            self._due.add(job.number)
            timer = threading.Timer(_EVERY, self._tell_due, (job,))
            timer.daemon = True
            timer.start()

    def _tell_due(self, job: Job) -> None:
        self._due.discard(job.number)
        if job.ended is None:
            self._tell(job)


def _read(stream: IO[str]) -> str:
    more = 0
    with stream:
        text = stream.read(_LONGEST)
        while part := stream.read(1 << 16):
            more += len(part)
    return f"{text}\n... and {more} characters more" if more else text


def _signal(process: subprocess.Popen[str], number: int) -> None:
    """Signal a command and the processes that it has started."""
    with suppress(ProcessLookupError):
        if _WINDOWS:
            process.terminate()
        else:
            os.killpg(process.pid, number)


def _started(words: Sequence[str]) -> subprocess.Popen[str]:
    """Start a command in a process; raises OptionError where that fails."""
    try:
        # -P: the working folder is no place to import from.
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "imulab", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "PYTHONUTF8": "1", "NO_COLOR": "1"},
            start_new_session=not _WINDOWS,
        )
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "a text that is none"
        raise OptionError(f"imulab {words[0]}: cannot be started: {reason}") from None
