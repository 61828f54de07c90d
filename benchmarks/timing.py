"""How the measurements are made: medians of functions that take turns, processes of their own, peak memory."""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

Row = tuple[str, str, str]
"""What was measured, what was found, what was asked."""


class Times(float):
    """The median of the rounds of a measurement, which is printed with its range; over another, a ratio in each round.

    Functions that took turns met the same machine in a round, so that the ratio of a round says more than that of
    medians.
    """

    rounds: tuple[float, ...]

    def __new__(cls, rounds: Iterable[float]) -> Times:
        kept = tuple(rounds)
        made = super().__new__(cls, statistics.median(kept))
        made.rounds = kept
        return made

    def __truediv__(self, other: float) -> Times:
        by = other.rounds if isinstance(other, Times) else (other,) * len(self.rounds)
        return Times(mine / its for mine, its in zip(self.rounds, by, strict=True))

    def __sub__(self, other: float) -> Times:
        by = other.rounds if isinstance(other, Times) else (other,) * len(self.rounds)
        return Times(mine - its for mine, its in zip(self.rounds, by, strict=True))

    def __mul__(self, factor: float) -> Times:
        return Times(factor * mine for mine in self.rounds)

    __rmul__ = __mul__

    def __format__(self, form: str) -> str:
        if len(self.rounds) < 2:
            return format(float(self), form)
        low, middle, high = (format(value, form) for value in (min(self.rounds), float(self), max(self.rounds)))
        return f"{middle} ({low} to {high})"


def seconds(
    *functions: Callable[[], object], repeats: int = 5, clock: Callable[[], float] = time.perf_counter
) -> list[Times]:
    """Return the times of each function by a clock, that of the day if not stated, the functions taking turns."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repeats):
        for collected, function in zip(times, functions, strict=True):
            begin = clock()
            function()
            collected.append(clock() - begin)
    return [Times(collected) for collected in times]


def compiled() -> dict[str, str]:
    """The environment, in which Python keeps what it compiles, as it does for those who install a package."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def processor_seconds(*commands: list[str], repeats: int = 7) -> list[Times]:
    """Return the processor times of each command, started in turn, after a first time that does not count."""
    times: list[list[float]] = [[] for _ in commands]
    for _ in range(repeats + 1):
        for collected, command in zip(times, commands, strict=True):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([sys.executable, *command], check=True, capture_output=True, env=compiled())
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            collected.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return [Times(collected[1:]) for collected in times]


_MEASURER = """
import resource, subprocess, sys, time
begin = time.perf_counter()
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
took = time.perf_counter() - begin
sys.stderr.buffer.write(done.stderr[-2000:])
print(took, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)
sys.exit(done.returncode)
"""


def measured(*arguments: str, folder: str | Path = ".") -> tuple[float, float]:
    """Time, s, and peak resident memory, MB, of a Python process with these arguments.

    A small process stands between, because a child begins with the memory of the process that starts it.
    """
    done = subprocess.run(
        [sys.executable, "-c", _MEASURER, sys.executable, *arguments], cwd=folder, capture_output=True, text=True,
        env=compiled(),
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)}: {done.stderr}")
    took, peak = map(float, done.stdout.split())
    return took, peak


def exponent(sizes: list[float], values: list[float]) -> float:
    """Exponent of the growth of `values` with `sizes`: the slope between the two largest sizes."""
    from math import log

    return log(values[-1] / values[-2]) / log(sizes[-1] / sizes[-2])
