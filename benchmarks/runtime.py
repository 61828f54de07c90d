"""The C core: ratios to a plain copy and to a bare loop, in C and through Python, and its size on a Cortex-M4F."""

from __future__ import annotations

import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import madeup
from imulab.device.unit import DeviceUnit
from imulab.exporters import export
from imulab.procedures.apply import tables_of
from imulab.procedures.warmup import MODELS

CORE = Path(__file__).resolve().parents[1] / "runtime"
SAMPLES = 1_000_000
NAMES = {
    "tumble": "`il_tumble_block`, order 1, against a copy of the same arrays",
    "feedback": "array `feedback`, 6 gyros, against a bare `gcc -O2` loop",
    "robust": "array `robust` against `feedback`",
    "robust-three": "array `robust`, three axes, ns a sample",
}


def rows() -> list[tuple[str, str, str]]:
    """Return what was measured, what was found, and what was asked."""
    return [*_in_c(), *_through_python(), *_exported(), *_footprint()]


def _in_c() -> list[tuple[str, str, str]]:
    """`make -C runtime speed`, three times: median of each ratio."""
    found: dict[str, list[float]] = {}
    asked: dict[str, str] = {}
    for _ in range(3):
        done = subprocess.run(["make", "-s", "-C", str(CORE), "speed"], check=True, capture_output=True, text=True)
        for line in done.stdout.splitlines():
            name, ratio, limit = line.split(" #")[0].split()
            found.setdefault(name, []).append(float(ratio))
            asked[name] = f"<= {limit}"
    made = []
    for name, ratios in found.items():
        title = NAMES.get(name) or f"`il_warmup_block`, {name.removeprefix('warmup-')}, 6 axes, against a copy"
        found_here = statistics.median(ratios)
        shown = f"{found_here:.0f}" if name == "robust-three" else f"{found_here:.2f} times its time"
        made.append((title, shown, asked[name]))
    return made


def _race(first: Callable[[], object], second: Callable[[], object]) -> float:
    times: list[list[float]] = [[], []]
    for _ in range(11):
        for collected, function in zip(times, (first, second), strict=True):
            begin = time.perf_counter()
            function()
            collected.append(time.perf_counter() - begin)
    return statistics.median(times[0]) / statistics.median(times[1])


def _through_python() -> list[tuple[str, str, str]]:
    rng = np.random.default_rng(1)
    columns = [rng.uniform(-5000, 5000, SAMPLES) for _ in range(3)]
    triad = DeviceUnit.of(*tables_of(madeup.tumble(1)))
    made = [
        (
            "`Unit.tumble`, order 1, 3 x 1e6 samples, against `numpy.copy`",
            f"{_race(lambda: triad.tumble(columns), lambda: [c.copy() for c in columns]):.2f} times its time",
            "<= 3",
        )
    ]
    ticks = np.arange(SAMPLES, dtype=np.uint32)
    tick = madeup.SETTLED / SAMPLES  # all of it is compensated
    for model in MODELS:
        table = DeviceUnit.of(*tables_of(madeup.warmup(model, "hold")))
        ratio = _race(
            lambda table=table: table.warmup(20.0, tick, ticks, columns[:2]), lambda: [c.copy() for c in columns[:2]]
        )
        made.append((f"`Unit.warmup`, {model}, 2 axes, against `numpy.copy`", f"{ratio:.2f} times its time", "<= 4"))
    return made


def _exported() -> list[tuple[str, str, str]]:
    """The self-test of an exported unit: what its own compiler makes of it against Python's numbers."""
    made = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export("c", [madeup.tumble(5, gyro=True, sensitive=True), madeup.centrifuge(), madeup.warmup()], folder)
        for real, asked in (("double", "0 (bit for bit)"), ("float", "<= 2e-6")):
            command = ["make", "-s", "-C", name, "test", f"CC=cc -DIMULAB_REAL={real}"]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            (worst,) = re.findall(r"worst (\S+)", done.stdout)
            made.append((f"exported unit, {real}, against Python: worst difference of full scale", worst, asked))
    done = subprocess.run(["make", "-s", "-C", str(CORE), "coverage"], check=True, capture_output=True, text=True)
    lines, branches = re.findall(r"([\d.]+) % of", done.stdout.splitlines()[-1])
    return [*made, ("C core: lines / branches that its own tests run", f"{lines} % / {branches} %", ">= 98 %")]


def _footprint() -> list[tuple[str, str, str]]:
    if shutil.which("arm-none-eabi-gcc") is None:
        return []
    done = subprocess.run(["make", "-s", "-C", str(CORE), "size"], check=True, capture_output=True, text=True)
    sizes = re.findall(r"^\s+(\d+)\s.*/(\w+)\.o$", done.stdout, re.MULTILINE)
    stack = dict(re.findall(r"^  (il_\w+) +(\d+)", done.stdout, re.MULTILINE))
    worst = ", ".join(f"`{name}` {stack[name]}" for name in ("il_tumble_apply", "il_warmup_bias", "il_array_step"))
    return [
        ("code on Cortex-M4F, float, -Os, bytes", ", ".join(f"{name} {size}" for size, name in sizes), "reported"),
        ("worst stack there, bytes, without libm", worst, "reported"),
    ]


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
