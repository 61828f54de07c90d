"""Gyro array: speed against a bare C loop, NumPy, filterpy, allantools; memory; the real array. Style: run.py."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from ctypes import CDLL, POINTER, c_double, c_long
from pathlib import Path

import numpy as np
from timing import measured, seconds

import imulab as il
from imulab.device.unit import array_stream
from imulab.procedures.gyro_array.fuse import fuse
from imulab.procedures.gyro_array.stream import FuseOptions
from imulab.recording import Recording

_BARE = r"""
/* The source's recursion and nothing else: six gyros, growing memory, weights not kept. */
void fuse(long m, const double *z, double *rate) {
    double b[6], d[6] = {0}, before = 0;
    for (int i = 0; i < 6; i++) before += z[i] / 6;
    for (int i = 0; i < 6; i++) b[i] = z[i] - before;
    before = 0;
    for (int i = 0; i < 6; i++) before += (z[i] - b[i]) / 6;
    rate[0] = before;
    for (long k = 1; k < m; k++) {
        double g = 1.0 / (double)(k + 1), total = 0, sum = 0;
        const double *now = z + 6 * k;
        for (int i = 0; i < 6; i++) {
            b[i] = (1 - g) * b[i] + g * (now[i] - before);
            double y = now[i] - b[i], e = y - before;
            d[i] = (1 - g) * d[i] + g * e * e;
            double w = 1 / (d[i] < 1e-300 ? 1e-300 : d[i]);
            total += w;
            sum += w * y;
        }
        before = sum / total;
        rate[k] = before;
    }
}
"""
_SAMPLES = 400_000
_METHODS = ("feedback", "robust", "mean", "least-squares")


def rows() -> list[tuple[str, str, str]]:
    """Return what was measured, what was found, and what was asked."""
    return [*_speed(), *_peers(), *_noise(), *_memory(), *_real()]


def _streams(method: str, readings: np.ndarray) -> Callable[[], object]:
    n, axes = readings.shape[2], readings.shape[1]
    return lambda: array_stream(method, n, axes, rate=100.0).process(readings, flags=False).rate


def _readings(axes: int = 1, samples: int = _SAMPLES) -> np.ndarray:
    return 0.05 * np.random.default_rng(1).standard_normal((samples, axes, 6))


def _speed() -> list[tuple[str, str, str]]:
    readings, three = _readings(), _readings(3)
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "bare.c", Path(folder) / "bare.so"
        source.write_text(_BARE)
        subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
        bare = CDLL(str(library)).fuse
        pointer = POINTER(c_double)
        bare.argtypes = [c_long, pointer, pointer]
        out = np.empty(_SAMPLES)

        def loop() -> None:
            bare(_SAMPLES, readings.ctypes.data_as(pointer), out.ctypes.data_as(pointer))

        loop()
        difference = np.abs(array_stream("feedback", 6, 1).process(readings).rate[:, 0] - out).max()
        ones = [_streams(method, readings) for method in _METHODS]
        threes = [_streams(method, three) for method in _METHODS]
        c, *times = seconds(loop, *ones, *threes)
    one = dict(zip(_METHODS, times, strict=False))
    of_three = dict(zip(_METHODS, times[len(_METHODS) :], strict=True))
    per = 1e9 / _SAMPLES
    return [
        ("`feedback`, 6 gyros, against a bare `gcc -O2` loop of the same recursion",
         f"{one['feedback'] / c:.2f} times its time ({one['feedback'] * per:.0f} ns a sample)", "<= 1.3"),
        ("the two differ by", f"{difference:.1e}", "<= 1e-12"),
        ("`robust` against `feedback`",
         f"{one['robust'] / one['feedback']:.2f} times its time ({one['robust'] * per:.0f} ns)", "<= 5"),
        ("`mean`", f"{one['mean'] * per:.0f} ns a sample", ""),
        ("`least-squares`", f"{one['least-squares'] * per:.0f} ns a sample", ""),
        *((f"three axes in one call, `{method}`", f"{of_three[method] * per:.0f} ns a sample",
           "<= 250" if method == "robust" else "") for method in _METHODS),
    ]  # fmt: skip


def _numpy_loop(readings: np.ndarray) -> np.ndarray:
    """What one would write with NumPy: the recursion, a sample at a time."""
    b = readings[0] - readings[0].mean()
    d, out = np.zeros(6), np.empty(len(readings))
    before = out[0] = (readings[0] - b).mean()
    for k in range(1, len(readings)):
        g = 1 / (k + 1)
        b = (1 - g) * b + g * (readings[k] - before)
        y = readings[k] - b
        d = (1 - g) * d + g * (y - before) ** 2
        w = 1 / np.maximum(d, 1e-300)
        before = out[k] = (w * y).sum() / w.sum()
    return out


def _peers() -> list[tuple[str, str, str]]:
    readings = _readings()
    few = np.ascontiguousarray(readings[:4000, 0])
    ours, loop = seconds(_streams("feedback", readings), lambda: _numpy_loop(few), repeats=5)
    found = [
        (
            "`feedback` against a NumPy loop over the samples",
            f"{loop / 4000 / (ours / _SAMPLES):.0f} times faster",
            ">= 150",
        )
    ]
    try:
        from filterpy.kalman import KalmanFilter
    except ImportError:
        return [*found, ("`feedback` against filterpy's KalmanFilter", "filterpy is not installed", ">= 500")]

    def peer() -> None:
        f = KalmanFilter(dim_x=7, dim_z=6)
        f.H = np.column_stack([np.ones(6), np.eye(6)])
        f.R, f.Q = 0.0025 * np.eye(6), 1e-6 * np.eye(7)
        for z in few[:1000]:
            f.predict()
            f.update(z)

    ours, theirs = seconds(_streams("feedback", readings), peer, repeats=3)
    ratio = theirs / 1000 / (ours / _SAMPLES)
    return [*found, ("`feedback` against filterpy's KalmanFilter", f"{ratio:.0f} times faster", ">= 500")]


def _noise() -> list[tuple[str, str, str]]:
    samples = np.random.default_rng(2).standard_normal(10_000_000)
    try:
        import allantools
    except ImportError:
        return []
    found: dict[str, np.ndarray] = {}

    def ours() -> None:
        found["ours"] = il.allan_deviation(samples, 100.0).deviation

    def theirs() -> None:
        found["theirs"] = allantools.oadev(samples, rate=100.0, data_type="freq", taus="octave")[1]

    mine, peer = seconds(ours, theirs, repeats=3)
    difference = np.abs(found["ours"] / found["theirs"][: len(found["ours"])] - 1).max()
    noise = "import numpy as np; z = np.random.default_rng(2).standard_normal(10_000_000); "
    peaks = [
        measured("-c", noise + call)[1]
        for call in (
            "import imulab as il; il.allan_deviation(z, 100.0)",
            "import allantools; allantools.oadev(z, rate=100.0, data_type='freq', taus='octave')",
        )
    ]
    return [
        ("Allan deviation, 10 million samples, octave taus, against allantools",
         f"{mine / peer:.2f} times its time ({mine:.2f} s), differing by {difference:.0e}", "< 1; <= 1e-12"),
        ("the same: peak memory of a process, the samples (80 MB) included",
         f"{peaks[0]:.0f} MB (allantools {peaks[1]:.0f} MB)", ""),
    ]  # fmt: skip


def _memory() -> list[tuple[str, str, str]]:
    """A file of 2 GB; IMULAB_BENCH_GB makes it smaller."""
    size = float(os.environ.get("IMULAB_BENCH_GB", "2")) * 1e9
    rng = np.random.default_rng(3)
    lines = [",".join(map(repr, row)) + "\n" for row in (0.05 * rng.standard_normal((50_000, 6))).tolist()]
    with tempfile.TemporaryDirectory() as folder:
        big = Path(folder) / "big.csv"
        written, k = 0, 0
        with big.open("w") as stream:
            stream.write("time [s]," + ",".join(f"gyro_{i} [deg/s]" for i in range(1, 7)) + "\n")
            while written < size:
                text = "".join(f"{(k + i) / 1000:.3f},{line}" for i, line in enumerate(lines))
                stream.write(text)
                written, k = written + len(text), k + len(lines)
        # A process of its own asks for the peak: a child's counts this one's memory, from before it became imulab.
        command = [sys.executable, "-m", "imulab", "array", "fuse", str(big), "-o", str(Path(folder) / "out.csv")]
        asking = (
            "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True); "
            "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
        )
        begin = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", asking, *command], check=True, capture_output=True, text=True)
        took = time.perf_counter() - begin
    peak = int(done.stdout.split()[-1]) / 1024
    return [(f"fuse a CSV of {written / 1e9:.1f} GB: peak memory", f"{peak:.0f} MB ({took:.0f} s)", "< 400 MB")]


def _real() -> list[tuple[str, str, str]]:
    folder = Path(os.environ.get("IMULAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    file = folder / "mimu4444" / "exp_1.bin"
    if not file.exists():
        return []
    recording = il.read(file)
    columns: dict[str, np.ndarray] = {"time": recording.time}
    for i in range(1, 9):
        x, y, z = (recording.columns[f"gyro_{a}_{i}"] for a in "xyz")
        for axis, values in zip("xyz", (x, y, z) if i % 2 else (-y, -x, -z), strict=True):
            columns[f"gyro_{axis}_{i}"] = values
    quiet = (recording.time > 468.2) & (recording.time < 496.0)
    found = []
    for method in ("mean", "least-squares", "feedback", "robust"):
        halves = []
        for first in (1, 2):
            half = {"time": columns["time"]} | {
                f"gyro_{a}_{k + 1}": columns[f"gyro_{a}_{i}"] for a in "xyz" for k, i in enumerate(range(first, 9, 2))
            }
            part = Recording(half, {n: "s" if n == "time" else "deg/s" for n in half})
            halves.append(fuse(part, FuseOptions(method=method), flags=False).rate[quiet])
        text = "/".join(f"{value:.3f}" for value in (halves[0] - halves[1]).std(axis=0))
        asked = "<= .138/.138/.097" if method == "robust" else ""
        found.append((f"split half of the real array, x/y/z, deg/s, `{method}`", text, asked))
    return found


if __name__ == "__main__":
    for line in rows():
        print(" | ".join(line))
