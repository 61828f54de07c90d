"""How the measurements are made: medians of functions that take turns, processes of their own, peak memory."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

Row = tuple[str, str, str]
"""What was measured, what was found, what was asked."""


def seconds(*functions: Callable[[], object], repeats: int = 5) -> list[float]:
    """Median time of each function, the functions taking turns."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repeats):
        for collected, function in zip(times, functions, strict=True):
            begin = time.perf_counter()
            function()
            collected.append(time.perf_counter() - begin)
    return [statistics.median(collected) for collected in times]


def process(*arguments: str) -> Callable[[], object]:
    """A Python process with these arguments, as a function to time."""
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


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
        [sys.executable, "-c", _MEASURER, sys.executable, *arguments], cwd=folder, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)}: {done.stderr}")
    took, peak = map(float, done.stdout.split())
    return took, peak


def exponent(sizes: list[float], values: list[float]) -> float:
    """Exponent of the growth of `values` with `sizes`: the slope between the two largest sizes."""
    from math import log

    return log(values[-1] / values[-2]) / log(sizes[-1] / sizes[-2])
