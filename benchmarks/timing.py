"""How the measurements are made: medians of functions that take turns, processes of their own, peak memory."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

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


def peak_memory(*arguments: str) -> float:
    """Peak resident memory, MB, of a Python process with these arguments; its output is thrown away."""
    child = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise RuntimeError(f"{arguments} failed")
    return usage.ru_maxrss / 1024


def exponent(sizes: list[float], values: list[float]) -> float:
    """Exponent of the growth of `values` with `sizes`: the slope between the two largest sizes."""
    from math import log

    return log(values[-1] / values[-2]) / log(sizes[-1] / sizes[-2])
