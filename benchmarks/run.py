"""Measurements against what they were asked to reach, and against peers: one Markdown file, RESULTS.md.

Each part has a ``rows()``; its name as an argument measures it alone (and prints, without writing). Ratios are medians
of interleaved runs in one process; absolute times depend on the machine.
"""

from __future__ import annotations

import importlib
import multiprocessing
import platform
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
PARTS = {
    "house": "Starting",
    "gyro_array": "Gyro array and Allan deviation",
    "tumble": "Tumble",
    "runtime": "The C core",
    "door": "At the door",
    "peers": "The same tasks call by call with peers",
    "growth": "Growth",
    "recordings": "Recordings",
    "thermal": "Thermal",
    "whole_arrays": "Whole arrays",
    "warmup": "Warm-up",
    "fleet": "Fleet",
    "accuracy": "Accuracy and real recordings",
    "centrifuge": "Centrifuge",
}
"""From the quickest to the slowest."""
PEERS = ("numpy", "scipy", "polars", "allantools", "filterpy", "imucal", "lmfit", "rosbags", "joblib", "dask")


def main(chosen: list[str]) -> None:
    unknown = [name for name in chosen if name not in PARTS]
    if unknown:
        sys.exit(f"unknown part {unknown[0]}; known parts: {' '.join(PARTS)}")
    lines = [
        "# Measurements",
        "",
        f"Made by `make bench`; medians of interleaved runs and, in brackets, the range. {_versions()}.",
    ]
    for name in chosen or PARTS:
        lines += ["", f"## {PARTS[name]}", "", "| what | found | asked |", "|---|---|---|"]
        begin = time.perf_counter()
        for what, found, asked in _rows(name):
            print(f"{what}: {found}" + (f" (asked: {asked})" if asked else ""), flush=True)
            lines.append(f"| {what} | {found} | {asked} |")
        print(f"-- {PARTS[name]}: {time.perf_counter() - begin:.0f} s", flush=True)
    if not chosen:
        (HERE / "RESULTS.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _rows(name: str) -> list[tuple[str, str, str]]:
    """The rows of a part, from a process of its own: peak memory is that of a process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_measure, name).result()


def _measure(name: str) -> list[tuple[str, str, str]]:
    return list(importlib.import_module(name).rows())


def _versions() -> str:
    found = [f"Python {platform.python_version()}", f"imulab {version('imulab')}"]
    for name in PEERS:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed")
    return ", ".join([*found, platform.machine(), "2 cores"])


if __name__ == "__main__":
    main(sys.argv[1:])
