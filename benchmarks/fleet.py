"""Fleets: many small units, many recordings, one process, two, and a cluster of two workers."""

from __future__ import annotations

import ctypes
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from timing import Row

import imulab as il
from imulab.fleet.run import run_fleet
from imulab.procedures.tumble.fit import fit_tumble

G = 9.80665
UNITS = 1000
RECORDINGS = 200
_PR_SET_CHILD_SUBREAPER = 36  # of Linux' prctl
SAMPLES = 50_000


def rows() -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return [*_tables(folder / "tables"), *_recordings(folder / "recordings"), *_overhead(folder / "tables")]


def _manifest(folder: Path, files: list[str]) -> Path:
    lines = ["serial,procedure,file,gravity", *(f"U{i:04d},tumble,{file},{G}" for i, file in enumerate(files))]
    path = folder / "manifest.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def _tables(folder: Path) -> list[Row]:
    """Tables of 24 attitudes, order chosen from the data."""
    folder.mkdir()
    rng = np.random.default_rng(1)
    for i in range(UNITS):
        up = rng.standard_normal((24, 3))
        up *= G / np.linalg.norm(up, axis=1, keepdims=True)
        outputs = (up + rng.normal(0, 0.1, 3)) * (1 + rng.normal(0, 0.01, 3)) + rng.normal(0, 1e-3, (24, 3))
        np.savetxt(
            folder / f"u{i}.csv", outputs, delimiter=",", fmt="%.6f", comments="",
            header="accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]",
        )  # fmt: skip
    manifest = _manifest(folder, [f"u{i}.csv" for i in range(UNITS)])
    ways = {
        "1 process": ["--workers", "1"],
        "2 processes": ["--workers", "2"],
        "a Dask cluster of 2 workers": ["--engine", "dask", "--workers", "2"],
    }
    times: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(2):
        for way, options in ways.items():
            times[way].append(_run(manifest, folder / "out", *options))
    again = _run(manifest, folder / "out", "--workers", "2", fresh=False)
    asked = {"2 processes": "<= 10 s on 2 free cores"}
    found = [
        (f"{UNITS} units of 24 attitudes as tables, {way}, whole command",
         f"{statistics.median(t):.1f} s wall, {min(t):.1f} s best", asked.get(way, ""))
        for way, t in times.items()
    ]  # fmt: skip
    return [*found, ("the same again, nothing to do, 2 processes", f"{again:.1f} s", "")]


def _run(manifest: Path, out: Path, *options: str, fresh: bool = True) -> float:
    return _fleet(manifest, out, *options, fresh=fresh)[0]


def _fleet(manifest: Path, out: Path, *options: str, fresh: bool = True) -> tuple[float, float]:
    if fresh:
        shutil.rmtree(out, ignore_errors=True)
    return _timed([sys.executable, "-m", "imulab", "fleet", "run", str(manifest), "-o", str(out), *options])


def _timed(command: list[str], path: str = "") -> tuple[float, float]:
    """Wall and processor time of a command with all processes that it starts."""
    # Processes that the command does not wait for become this one's, which does.
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONPATH": path})
    wall = time.perf_counter() - begin
    with suppress(ChildProcessError):
        while True:
            os.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def _read_all(files: list[str], workers: int) -> tuple[float, float]:
    """Times of a command that reads the files with so many processes; start of Python and processes included."""
    code = (
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from reading import read_only\n"
        "from joblib import Parallel, delayed, parallel_config\n"
        f"with parallel_config(backend='loky', n_jobs={workers}, inner_max_num_threads=1):\n"
        "    Parallel()(delayed(read_only)(file) for file in sys.argv[1:])\n"
    )
    return _timed([sys.executable, "-c", code, *files], str(Path(__file__).parent))


def _recordings(folder: Path) -> list[Row]:
    """Recordings of 50,000 samples of seven columns: the whole command against reading with as many processes."""
    folder.mkdir()
    for seed in range(8):
        hold = (SAMPLES / 100 - 2) / 24 - 2
        il.write(il.simulate_tumble(attitudes=24, order=2, hold=hold, seed=seed), folder / f"r{seed}.csv")
    for i in range(8, RECORDINGS):  # the same bytes by other names
        os.link(folder / f"r{i % 8}.csv", folder / f"r{i}.csv")
    files = [str(folder / f"r{i}.csv") for i in range(RECORDINGS)]
    samples = len(il.read(files[0]))
    manifest = _manifest(folder, [f"r{i}.csv" for i in range(RECORDINGS)])
    one = folder / "one.csv"
    one.write_text("\n".join(manifest.read_text().splitlines()[:2]) + "\n")
    found = []
    for workers in (1, 2):
        # Turn by turn; both are whole commands with as many processes, which may use as many threads.
        pairs = [
            (_fleet(manifest, folder / "out", "--workers", str(workers)), _read_all(files, workers)) for _ in range(3)
        ]
        ratios = [statistics.median(whole[k] / read[k] for whole, read in pairs) for k in (0, 1)]
        (wall, cpu), (read_wall, read_cpu) = (
            [min(pair[side][k] for pair in pairs) for k in (0, 1)] for side in (0, 1)
        )  # fmt: skip
        starts = [_fleet(one, folder / "out", "--workers", str(workers))[1], _read_all(files[:1], workers)[1]]
        found.append(
            (
                f"{RECORDINGS} recordings of {samples} samples x 11 columns, processes: {workers}",
                f"{ratios[0]:.2f} times reading them with as many processes ({wall:.1f} s against {read_wall:.1f} s); "
                f"in processor time {ratios[1]:.2f} times ({cpu:.1f} s against {read_cpu:.1f} s, of which "
                f"{starts[0]:.1f} s and {starts[1]:.1f} s for the start and one recording)",
                "<= 2 times" if workers == 2 else "",
            )
        )
    return found


def _overhead(folder: Path) -> list[Row]:
    """Where the time of a unit goes, in one process."""
    files = [str(folder / f"u{i}.csv") for i in range(100)]
    small = _manifest(folder, [f"u{i}.csv" for i in range(100)])
    parts: dict[str, list[float]] = {name: [] for name in ("read", "fit", "record", "fleet")}
    for _ in range(5):
        begin = time.perf_counter()
        recordings = [il.read(file) for file in files]
        read = time.perf_counter()
        fits = [fit_tumble(il.find_attitudes(recording), gravity=G) for recording in recordings]
        fitted = time.perf_counter()
        for i, fit in enumerate(fits):
            fit.calibration.save(folder / f"single{i}.json")
        saved = time.perf_counter()
        shutil.rmtree(folder / "one", ignore_errors=True)
        start = time.perf_counter()
        run_fleet(str(small), str(folder / "one"), workers=1)
        whole = time.perf_counter() - start
        for name, value in (
            ("read", read - begin), ("fit", fitted - read), ("record", saved - fitted),
            ("fleet", whole - (saved - begin)),
        ):  # fmt: skip
            parts[name].append(value / len(files))
    ms = {name: 1e3 * statistics.median(values) for name, values in parts.items()}
    return [
        ("a unit of 24 attitudes: reading", f"{ms['read']:.2f} ms", ""),
        ("a unit of 24 attitudes: fit, order chosen from the data", f"{ms['fit']:.1f} ms", ""),
        ("a unit of 24 attitudes: record, hashed and written", f"{ms['record']:.1f} ms", "<= 2 ms"),
        (
            "a unit of 24 attitudes: what the fleet adds (manifest, locks, history, table)",
            f"{ms['fleet']:.1f} ms",
            "< 20 ms",
        ),
    ]


if __name__ == "__main__":
    for line in rows():
        print(*line, sep=" | ")
