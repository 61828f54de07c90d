"""Boards of whole IMUs: time of the fit and of the unit's code, and the figures of one real board."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
from timing import Row, seconds

import imulab as il
from imulab.device.imus import ImusStream
from imulab.procedures.gyro_array.imus.fuse import board_of
from imulab.procedures.gyro_array.imus.schema import imus_of

DATA = Path(os.environ.get("IMULAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
PITCH = 0.01905  # m, between the columns of chips of a MIMU4444, by its drawing
CLIPPED = np.radians(1000.0)
SAMPLES = 20_000


def rows() -> list[Row]:
    return [*_times(), *_real_board(DATA / "mimu4444" / "exp_1.bin")]


def _times() -> list[Row]:
    board = il.simulate_imus(elements=8, duration="40 s", age="0 ms", seed=1)
    (fit,) = seconds(lambda: il.calibrate_imus(board, gravity=9.80665), repeats=5, clock=time.process_time)
    found = [("fit of eight IMUs, 40 s of motion at 100 Hz, processor time", f"{fit:.2f} s", "<= 0.9 s (prototype)")]
    for count in (4, 8, 32):
        board = il.simulate_imus(elements=count, attitudes=6, duration="8 s", age="0 ms", seed=1)
        known = board_of(il.calibrate_imus(board, gravity=9.80665).calibration)
        assert known.settings is not None
        names = [f"{s}_{x}_{k + 1}" for s in ("accel", "gyro") for k in range(count) for x in "xyz"]
        once = np.stack([board.si(name) for name in names], axis=1).reshape(-1, 2, count, 3)[-800:]
        readings, step = np.tile(once, (SAMPLES // len(once), 1, 1, 1)), np.full(SAMPLES, 0.01)
        stream = ImusStream.of(known.settings)
        (spent,) = seconds(lambda s=stream, r=readings, t=step: s.process(t, r), repeats=7, clock=time.process_time)
        found.append((f"one sample of {count} IMUs fused, in motion", f"{1e9 * spent / SAMPLES:.0f} ns", "< 1000 ns"))
    return found


def _real_board(file: Path) -> list[Row]:
    if not file.is_file():
        return []
    record = il.calibrate_imus(file, gravity="9.82+-0.001").calibration
    held = imus_of(record)
    place = np.array([imu.position.value for imu in held.imus])
    # Chips 1, 3, 5, 7 lie alike, so that where their sensing points are cancels.
    size = float(np.mean([place[4, 0], place[6, 0], -place[2, 1], -place[6, 1]]) / PITCH)
    stated, nominal = held.fit.size.gravity, held.fit.size.gyro_scale
    assert stated is not None
    assert nominal is not None
    late = np.mean([imu.accel_latency.value for imu in held.imus])
    turning = [row for row in il.compare_imus(file, calibration=record).accel["turning"] if row is not None]
    fused, mean = (np.median([getattr(row, name) for row in turning]) for name in ("fused", "mean"))
    what, (words, figures) = "MIMU4444, one recording: ", _clipped(file, record)
    return [
        (
            f"{what}size over the drawing's, by gravity",
            f"{size:.4f}, u {stated.standard_uncertainty:.4f}",
            "within .005",
        ),
        (f"{what}size over the drawing's, by the nominal scale", f"{size * nominal.value:.4f}", "within .005"),
        (f"{what}accelerometers later than gyroscopes", f"{1e3 * late:.2f} ms", "2.02 ms (document)"),
        (f"{what}halves of the motion, rms z of positions", f"{held.fit.halves:.2f}", "< 1.5"),
        (f"{what}one IMU predicted by the others fused; by their mean", f"{fused:.2f}; {mean:.1f} m/s^2", "< 2.5"),
        (what + words, figures, "rms < 80 deg/s"),
    ]


def _clipped(file: Path, record: il.Calibration) -> tuple[str, str]:
    """Error of the rate where the gyroscopes are clipped by us, against the rate where they are not."""
    whole = il.read(file)
    columns = {
        name: np.clip(whole.si(name), -CLIPPED, CLIPPED) if name.startswith("gyro") else values
        for name, values in whole.columns.items()
    }
    units = {name: "rad/s" if name.startswith("gyro") else unit for name, unit in whole.units.items()}
    cut = il.fuse_imus(il.Recording(columns, units, {}, whole.name), calibration=record, gyro_range=CLIPPED)
    true = il.fuse_imus(whole, calibration=record)
    rows = cut.bridged & ~true.bridged
    error = np.degrees(np.linalg.norm(cut.rate[rows] - true.rate[rows], axis=1))
    return (
        f"rate bridged beyond 1000 deg/s, {int(rows.sum())} samples",
        f"rms {np.sqrt(np.mean(error**2)):.0f}, median {np.median(error):.0f} deg/s",
    )
