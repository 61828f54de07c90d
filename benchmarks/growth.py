"""How time and memory of each main job grow at 1, 10 and 100 times the size: whole commands, files included."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from timing import Row, exponent, measured

import imulab as il

SIZES = (20_000, 200_000, 2_000_000)
G = 9.80665


def rows() -> list[Row]:
    jobs: list[tuple[str, Callable[[Path, int], list[str]]]] = [
        ("`convert` CSV to Parquet, rows x 7", _convert),
        ("`apply` order 2, rows x 7", _apply),
        ("`tumble fit`, samples", _tumble),
        ("`array fuse` robust, rows x 6 gyros", _fuse),
        ("`allan`, samples", _allan),
        ("`noise fit`, samples of six axes", _noise),
        ("`warmup fit`, 16 cycles, samples x 6 axes", _warmup),
        ("`centrifuge reduce`, samples of 3 channels", _centrifuge),
    ]
    found: list[Row] = []
    for what, prepare in jobs:
        times, peaks = [], []
        for size in SIZES:
            with tempfile.TemporaryDirectory() as folder:
                seconds, memory = measured("-m", "imulab", *prepare(Path(folder), size), folder=folder)
            times.append(seconds)
            peaks.append(memory)
        value = (
            ", ".join(f"{t:.2f} s" for t in times)
            + f"; exponent {exponent(list(map(float, SIZES)), times):.2f}; "
            + ", ".join(f"{m:.0f} MB" for m in peaks)
        )
        found.append((f"{what}: 0.02, 0.2, 2 million", value, "exponent 1 or less"))
    return found


def _imu(folder: Path, size: int) -> str:
    rng = np.random.default_rng(1)
    columns = {"time": np.arange(size) / 100}
    columns |= {f"accel_{a}": G * rng.uniform(-1, 1, size) for a in "xyz"}
    columns |= {f"gyro_{a}": rng.standard_normal(size) for a in "xyz"}
    units = {"time": "s"} | {f"accel_{a}": "m/s^2" for a in "xyz"} | {f"gyro_{a}": "deg/s" for a in "xyz"}
    il.write_csv(il.Recording(columns, units), folder / "in.csv")
    return "in.csv"


def _convert(folder: Path, size: int) -> list[str]:
    return ["convert", _imu(folder, size), "-o", "out.parquet"]


def _apply(folder: Path, size: int) -> list[str]:
    fit = il.fit_tumble(il.find_attitudes(il.simulate_tumble(order=2, gravity=G)), order=2, gravity=G)
    fit.calibration.save(folder / "r.json")
    return ["apply", "r.json", _imu(folder, size), "-o", "out.csv"]


def _tumble(folder: Path, size: int) -> list[str]:
    il.write_csv(il.simulate_tumble(order=1, attitudes=24, rate=size / 170, gravity=G), folder / "in.csv")
    return ["tumble", "fit", "in.csv", "--gravity", str(G), "-o", "out.json"]


def _fuse(folder: Path, size: int) -> list[str]:
    rng = np.random.default_rng(2)
    columns = {"time": np.arange(size) / 100}
    columns |= {f"gyro_{i}": 0.05 * rng.standard_normal(size) for i in range(1, 7)}
    units = {"time": "s"} | {f"gyro_{i}": "deg/s" for i in range(1, 7)}
    il.write_csv(il.Recording(columns, units), folder / "in.csv")
    return ["array", "fuse", "in.csv", "-o", "out.csv"]


def _allan(folder: Path, size: int) -> list[str]:
    rng = np.random.default_rng(3)
    columns = {"time": np.arange(size) / 100, "gyro_x": rng.standard_normal(size)}
    il.write_csv(il.Recording(columns, {"time": "s", "gyro_x": "deg/s"}), folder / "in.csv")
    return ["allan", "in.csv"]


def _noise(folder: Path, size: int) -> list[str]:
    rng = np.random.default_rng(4)
    columns = {f"{sensor}_{a}": rng.standard_normal(size) for sensor in ("gyro", "accel") for a in "xyz"}
    units = {name: "deg/s" if name.startswith("gyro") else "m/s^2" for name in columns} | {"time": "s"}
    il.write_csv(il.Recording({"time": np.arange(size) / 100, **columns}, units), folder / "in.csv")
    return ["noise", "fit", "in.csv"]


def _warmup(folder: Path, size: int) -> list[str]:
    names = []
    for i, temperature in enumerate((-40, -30, -20, -10, 0, 40, 50, 60)):
        for cycle in range(2):
            names.append(f"c{i}{cycle}.csv")
            recording = il.simulate_power_cycle(temperature, sample_rate=size / 16 / 600, seed=[i, cycle])
            il.write_csv(recording, folder / names[-1])
    return ["warmup", "fit", *names, "--model", "knot-log-cubic", "-o", "out.json"]


def _centrifuge(folder: Path, size: int) -> list[str]:
    rate = size / (2 * 4 * 180 + 2 * 30)
    subprocess.run(
        [sys.executable, "-m", "imulab", "centrifuge", "simulate", "--levels", "1,5,10,20", "--duration", "180 s",
         "--static-duration", "30 s", "--rate", f"{max(rate, 10):.3f} Hz", "-o", "test"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    return ["centrifuge", "reduce", "test/manifest.toml", "-o", "out.json"]
