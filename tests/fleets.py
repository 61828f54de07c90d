"""Fleets of simulated units as files, for the tests of `imulab.fleet`; the simulation is apart from imulab's."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

G = 9.80665


def attitudes(seed: int, count: int = 24, sigma: float = 1e-3) -> np.ndarray:
    """Outputs of a random triad in random attitudes, m/s^2, shape (count, 3)."""
    rng = np.random.default_rng(seed)
    up = rng.standard_normal((count, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    scale, bias = 1 + rng.normal(0, 0.01, 3), rng.normal(0, 0.1, 3)
    return np.asarray(scale * (G * up + bias) + rng.normal(0, sigma, (count, 3)))


def write_attitudes(path: Path, outputs: np.ndarray, head: str = "") -> None:
    rows = "\n".join(",".join(f"{value:.6f}" for value in row) for row in outputs)
    path.write_text(f"{head}accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]\n{rows}\n")


def write_manifest(path: Path, rows: list[dict[str, object]]) -> Path:
    titles = list(dict.fromkeys(title for row in rows for title in row))
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, titles, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return path


def make_fleet(folder: Path, units: int, **options: object) -> Path:
    """Write files and manifest of a fleet of tumble tables and return the manifest's path."""
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    for i in range(units):
        write_attitudes(folder / f"u{i}.csv", attitudes(i))
        rows.append({"serial": f"SN{i:03d}", "procedure": "tumble", "file": f"u{i}.csv", "gravity": G, **options})
    return write_manifest(folder / "manifest.csv", rows)


def command(*arguments: object, cwd: Path | None = None, env: dict[str, str] | None = None) -> subprocess.Popen[str]:
    """Start the command line and return its process."""
    return subprocess.Popen(
        [sys.executable, "-m", "imulab", *map(str, arguments)],
        cwd=cwd, env={**os.environ, **(env or {})}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


def records(folder: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every record: what shows whether it was written again."""
    return {path.stem: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.glob("*.json")}


def wait_for(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def children(pid: int) -> list[int]:
    """Processes that a process has started."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == pid:
                    found.append(int(entry.name))
            except (OSError, IndexError):
                continue
    return found


def workers_of(pid: int) -> list[int]:
    """Processes that do its work: those that joblib has started for it."""
    found = []
    for child in children(pid):
        try:
            if b"loky.backend.popen" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(child)
        except OSError:
            continue
    return found
