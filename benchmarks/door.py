"""What a caller gets: public functions and whole commands, by processor time, beside what the task asks at the least.

`IMULAB_BENCH_ROWS` makes the long recordings shorter than ten million rows.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from ctypes import CDLL, POINTER, c_double, c_long
from pathlib import Path

import numpy as np
from timing import Row, measured, processor_seconds, seconds
from tumble import plain_scipy_fit, table

import imulab as il
from imulab.device.unit import array_stream

DATA = Path(os.environ.get("IMULAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
LONG = int(os.environ.get("IMULAB_BENCH_ROWS", "10000000"))
G = 9.80665
CPU = time.process_time


def rows() -> Iterator[Row]:
    """Yield what was measured, what was found, and what was asked, the quick ones first."""
    yield from _fits()
    yield from _allan()
    yield from _fuse()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        yield from _commands(folder)
        yield from _files(folder)
        yield from _long(folder)


def _fits() -> Iterator[Row]:
    attitudes = il.find_attitudes(il.simulate_tumble(attitudes=38, order=1, gravity=G, seed=4))
    means = il.find_attitudes(table(attitudes.mean))
    for function in (il.fit_tumble, lambda each, **_: plain_scipy_fit(each.mean)):
        function(means, gravity=G)  # what it imports does not count
    one, auto, peer = seconds(
        lambda: il.fit_tumble(means, order=1, gravity=G), lambda: il.fit_tumble(means, gravity=G),
        lambda: plain_scipy_fit(means.mean), repeats=31, clock=CPU,
    )  # fmt: skip
    yield "`il.fit_tumble`, 38 attitudes, order 1, over scipy's lm by hand", f"{one / peer:.2f} times", "<= 1.5"
    yield "`il.fit_tumble`, 38 attitudes, `auto`, over the same", f"{auto / peer:.1f} times", "<= 6"
    slow = {"flicker": "12 deg/h", "walk": "60 deg/h/sqrt(h)"}
    white, coloured = (
        il.simulate_noise(white="0.3 deg/sqrt(h)", duration="10000 s", columns="gyro_x", **also) for also in ({}, slow)
    )
    fit, longer = seconds(lambda: il.fit_noise(white), lambda: il.fit_noise(coloured), repeats=5, clock=CPU)
    yield "`il.fit_noise`, one axis of a million samples", f"{1e3 * fit:.0f} ms", "<= 150 ms"
    yield "the same with 1/f noise and a random walk", f"{1e3 * longer:.0f} ms", ""


_LOOP = r"""
void squares(long n, const double *x, long lags, const long *lag, double *sums) {
    for (long i = 0; i < lags; i++) {
        sums[i] = 0;
        for (long k = 0, m = lag[i]; k < n - 2 * m; k++) {
            const double d = x[k + 2 * m] - 2 * x[k + m] + x[k];
            sums[i] += d * d;
        }
    }
}
"""


def _allan() -> Iterator[Row]:
    import allantools

    from imulab.estimation._allan import fill_squares

    for count in (LONG // 10, LONG):
        samples = np.random.default_rng(2).standard_normal(count)
        ours, peer = seconds(
            lambda z=samples: il.allan_deviation(z, 100.0),
            lambda z=samples: allantools.oadev(z, rate=100.0, data_type="freq", taus="octave"),
            clock=CPU,
        )
        what = f"`il.allan_deviation`, {count / 1e6:g} million samples, over allantools' oadev"
        yield what, f"{ours / peer:.2f} times", "<= 0.4"
    integral, lags = np.cumsum(samples), 2 ** np.arange(int(np.log2(LONG)) - 1)
    sums, pointer = np.empty(len(lags)), POINTER(c_double)
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "loop.so"
        (Path(folder) / "loop.c").write_text(_LOOP)
        subprocess.run(
            ["gcc", "-O2", "-shared", "-fPIC", "-o", str(library), str(library.with_suffix(".c"))], check=True
        )
        loop = CDLL(str(library)).squares
        loop.argtypes = [c_long, pointer, c_long, POINTER(c_long), pointer]
        arguments = (len(integral), integral.ctypes.data_as(pointer), len(lags), lags.ctypes.data_as(POINTER(c_long)))
        ours, peer = seconds(
            lambda: fill_squares(sums, integral, lags), lambda: loop(*arguments, sums.ctypes.data_as(pointer))
        )
    yield "the curve's sums alone, wall, over a `gcc -O2` loop on one core", f"{ours / peer:.2f} times", "<= 1.0"


def _fuse() -> Iterator[Row]:
    recording = il.simulate_array(experiment="static", duration=4000.0, rate=100.0)
    readings = np.column_stack([recording.column(f"gyro_{i}") for i in range(1, 7)])[:, None]
    ours, core = seconds(
        lambda: il.fuse(recording, method="robust"),
        lambda: array_stream("robust", 6, 1, rate=100.0).process(readings, flags=False),
        clock=CPU,
    )
    yield (
        f"`il.fuse`, {len(recording):,} samples of six gyros, over its core alone",
        f"{ours / core:.2f} times",
        "<= 2.5",
    )


def _commands(folder: Path) -> Iterator[Row]:
    il.write_csv(il.simulate_noise(white="0.3 deg/sqrt(h)", duration="1 h"), folder / "noise.csv")
    short = il.simulate_tumble(attitudes=24, gravity=G)
    il.write_csv(short, folder / "short.csv")
    thermal, ramps, cycles = (_simulated(folder / name, words) for name, words in {
        "thermal": ["thermal", "simulate"],
        "ramps": ["thermal", "simulate", "--gyro", "--ramps", "2"],
        "cycles": ["warmup", "simulate"],
    }.items())  # fmt: skip
    out = ["-o", str(folder / "out.json")]
    jobs = [
        ("`noise fit`, three axes, 1 h at 100 Hz", ["noise", "fit", str(folder / "noise.csv"), *out], "<= 0.7 s"),
        ("`thermal fit`, five tumbles", ["thermal", "fit", *thermal, *out], "<= 0.45 s"),
        ("`thermal fit --with gyro`, five tumbles, two ramps", ["thermal", "fit", "--with", "gyro", *ramps, *out],
         "<= 1.0 s"),
        ("`warmup fit`, 24 cycles of 10 min", ["warmup", "fit", *cycles, *out], "<= 0.8 s"),
        (f"`convert` to Parquet, {len(short):,} rows", ["convert", str(folder / "short.csv"), "-o",
         str(folder / "out.parquet")], "<= 0.22 s"),
    ]  # fmt: skip
    if (DATA / "xsens_mti").is_dir():
        jobs.append(("`tumble gyro`, Xsens, after its accelerometers", _xsens(folder), "<= 0.62 s (1.2 of imu_tk's)"))
    times = processor_seconds(*(["-m", "imulab", *words] for _, words, _ in jobs), repeats=5)
    for (what, _, asked), spent in zip(jobs, times, strict=True):
        yield f"{what}, whole process", f"{spent:.2f} s", asked


def _simulated(folder: Path, words: list[str]) -> list[str]:
    subprocess.run([sys.executable, "-m", "imulab", *words, "-o", str(folder)], check=True, capture_output=True)
    return sorted(map(str, folder.glob("*.csv")))


def _xsens(folder: Path) -> list[str]:
    for sensor in ("accel", "gyro"):
        columns = "".join(f'{sensor}_{a} = {{ from = {i}, unit = "count" }}\n' for i, a in enumerate("xyz", start=1))
        text = f'delimiter = "whitespace"\n[columns]\ntime = {{ from = 0, unit = "s" }}\n{columns}'
        (folder / f"{sensor}.toml").write_text(text)
    files = {
        sensor: str(DATA / "xsens_mti" / f"xsens_{short}.mat") for sensor, short in (("accel", "acc"), ("gyro", "gyro"))
    }
    record, layout = folder / "accel.json", str(folder / "accel.toml")
    il.fit_tumble(il.read(files["accel"], layout), gravity=9.81744).calibration.save(record)
    both = ["--accel-file", files["accel"], "--accel-layout", layout, "--layout", str(folder / "gyro.toml")]
    return ["tumble", "gyro", files["gyro"], "--accel", str(record), *both, "-o", str(folder / "out.json")]


def _files(folder: Path) -> Iterator[Row]:
    import h5py
    import scipy.io

    rng = np.random.default_rng(5)
    names = [f"{sensor}_{a}" for sensor in ("accel", "gyro") for a in "xyz"]
    columns = {"time": np.arange(1_000_000) / 100} | {name: rng.standard_normal(1_000_000) for name in names}
    units = {name: "s" if name == "time" else "m/s^2" if name[0] == "a" else "rad/s" for name in columns}
    with h5py.File(folder / "log.h5", "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values).attrs["unit"] = units[name]
    scipy.io.savemat(folder / "log.mat", {name: values[:, None] for name, values in columns.items()})
    layout = folder / "log.toml"
    layout.write_text(
        "[columns]\n" + "".join(f'{name} = {{ from = "{name}", unit = "{unit}" }}\n' for name, unit in units.items())
    )

    def hashed(file: Path) -> str:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def by_h5py() -> list[np.ndarray]:
        hashed(folder / "log.h5")
        with h5py.File(folder / "log.h5") as file:
            return [np.asarray(file[name][()]) for name in columns]

    def by_scipy() -> object:
        hashed(folder / "log.mat")
        return scipy.io.loadmat(folder / "log.mat")

    ours, h5, mine, mat = seconds(
        lambda: il.read(folder / "log.h5", layout), by_h5py, lambda: il.read(folder / "log.mat", layout), by_scipy,
        repeats=7, clock=CPU,
    )  # fmt: skip
    yield "read HDF5, a million rows x 7, over h5py, SHA-256 in both", f"{ours / h5:.2f} times", "<= 2"
    yield "read MAT v5, the same, over scipy.io", f"{mine / mat:.2f} times", "<= 2"


def _long(folder: Path) -> Iterator[Row]:
    million = f"{LONG / 1e6:g} million"
    array = il.simulate_array(experiment="static", duration=LONG / 100, rate=100.0)
    for kind, asked in (("csv", "<= 6 s; <= 400 MB"), ("parquet", "")):
        il.write(array, folder / f"array.{kind}")
        words = ["-m", "imulab", "array", "calibrate", str(folder / f"array.{kind}"), "-o", str(folder / "out.json")]
        reading = ["-c", f"import imulab; imulab.read({str(folder / f'array.{kind}')!r})"]
        (spent, read), peak = processor_seconds(words, reading, repeats=2), measured(*words)[1]
        (folder / f"array.{kind}").unlink()
        what = f"`array calibrate`, {million} rows x 6 from {kind.upper() if kind == 'csv' else 'Parquet'}"
        yield what, f"{spent:.1f} s, of which {read:.1f} s to read; {peak:.0f} MB", asked
    del array
    for what, words in {
        "tumble fit": ["tumble", "fit", "--gravity", str(G), "-o", str(folder / "out.json")],
        "allan": ["allan"],
        "noise fit": ["noise", "fit", "-o", str(folder / "out.json")],
    }.items():
        peaks = []
        for count in (LONG // 10, LONG):
            file = folder / "long.csv"
            il.write_csv(
                il.simulate_tumble(attitudes=24, rate=count / 170, gravity=G) if what == "tumble fit"
                else il.simulate_noise(white="0.3 deg/sqrt(h)", duration=count / 100), file,
            )  # fmt: skip
            peaks.append(measured("-m", "imulab", *words, str(file))[1])
        found = f"{peaks[1]:.0f} MB, {peaks[1] / peaks[0]:.2f} times that of a tenth ({peaks[0]:.0f} MB)"
        yield f"`{what}`, {million} x 3, peak memory", found, "<= 250 MB; <= 1.6 times"
