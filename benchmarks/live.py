"""A live session at 1 kHz through a pseudo-terminal: samples lost, share of a core, memory, and how late the screen is.

    python benchmarks/live.py [MINUTES]

The unit is a thread that writes lines of nine channels and a temperature that rises by 1 K a second, by which each
picture of the screen tells the time of the newest sample that it shows.
"""

from __future__ import annotations

import os
import re
import select
import subprocess
import sys
import tempfile
import threading
import time
import tty
from pathlib import Path

import numpy as np

import imulab as il

RATE, EVERY = 1000, 20
TITLES = [
    f"{sensor}_{axis} [{unit}]" for sensor, unit in (("accel", "g"), ("gyro", "deg/s"), ("mag", "uT")) for axis in "xyz"
]


def written(minutes: float) -> list[str]:
    """Lines of a unit that lies 18 s in each attitude, with noise of 1 mg, without their stamps."""
    rng = np.random.default_rng(1)
    rows = []
    for _ in range(int(minutes * 3) + 1):
        up = rng.standard_normal(3)
        accel = np.tile(up / np.linalg.norm(up), (20 * RATE, 1))
        accel[: 2 * RATE] += 0.3 * rng.standard_normal((2 * RATE, 3))
        accel += 1e-3 * rng.standard_normal(accel.shape)
        rows += [",".join(f"{v:.5f}" for v in row) for row in np.column_stack([accel, accel, accel]).tolist()]
    return rows


class Unit(threading.Thread):
    """Writes what is due every few milliseconds, and notes when."""

    def __init__(self, end: int, rows: list[str], count: int) -> None:
        super().__init__(daemon=True)
        self.end, self.rows, self.count, self.sent = end, rows, count, 0
        self.when = np.zeros(count // EVERY + 1)
        self.behind = 0.0

    def run(self) -> None:
        head = ("time [us]," + ",".join(TITLES) + ",temperature [degC]\n").encode()
        begun = time.monotonic()
        while self.sent < self.count:
            due = min(int((time.monotonic() - begun) * RATE), self.count)
            for k in range(self.sent, due):
                if k % EVERY == 0:
                    self.when[k // EVERY] = time.monotonic()
                line = f"{k * 1000},{self.rows[k]},{k / RATE:.3f}\n".encode()
                self.put(head + line if k % RATE == 0 else line)
            self.sent = max(self.sent, due)
            self.behind = max(self.behind, time.monotonic() - begun - self.sent / RATE)
            time.sleep(0.004)

    def put(self, data: bytes) -> None:
        while data:
            try:
                data = data[os.write(self.end, data) :]
            except BlockingIOError:
                time.sleep(0.001)


def usage(pid: int) -> tuple[float, float]:
    """Return the processor time, s, and the memory, MiB, of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    tick = os.sysconf("SC_CLK_TCK")
    return (int(fields[11]) + int(fields[12])) / tick, int(fields[21]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main(minutes: float) -> None:
    rows, count = written(minutes), int(minutes * 60 * RATE)
    (end, port), (screen, drawn) = os.openpty(), os.openpty()
    tty.setraw(port)
    os.set_blocking(end, False)
    folder = Path(tempfile.mkdtemp())
    words = ["live", f"serial:{os.ttyname(port)}@2000000", "--attitudes", "200", "--order", "2", "--save", "rec.csv"]
    process = subprocess.Popen(
        [sys.executable, "-m", "imulab", *words],
        cwd=folder,
        stdin=drawn,
        stdout=drawn,
        stderr=drawn,
        env=os.environ | {"TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40"},
    )
    text = b""
    while b"waiting for samples" not in text:
        text += os.read(screen, 1 << 16)
    unit = Unit(end, rows, count)
    unit.start()
    late: list[float] = []
    seen, measured = b"", []
    while unit.is_alive() and process.poll() is None:
        if not select.select([screen], [], [], 0.1)[0]:
            continue
        text = (text + os.read(screen, 1 << 16))[-20_000:]
        now = time.monotonic()
        found = re.findall(rb"(\d+\.\d)\x1b?[^\n]{0,8}\xc2\xb0C", text)
        if found and found[-1] != seen:
            seen = found[-1]
            place = int(float(seen) * RATE) // EVERY
            if 0 < place < len(unit.when) and unit.when[place] and float(seen) > 5:
                late.append(now - float(unit.when[place]))
                if late[-1] > 0.3:
                    print(f"at {seen.decode()} s the screen was {late[-1]:.2f} s behind")
        if unit.sent > 5 * RATE and (not measured or now - measured[-1][0] > 10):
            measured.append((now, *usage(process.pid)))
    time.sleep(2.0)
    measured.append((time.monotonic(), *usage(process.pid)))
    os.write(screen, b"q")
    for _ in range(600):
        if b"any key ends" in text:  # the record is made
            os.write(screen, b"q")
        if process.poll() is not None:
            break
        if select.select([screen], [], [], 0.1)[0]:
            text = (text + os.read(screen, 1 << 16))[-20_000:]
    process.kill()
    print(text[-600:].decode() if process.returncode else "")
    first, last = measured[0], measured[-1]
    saved = np.concatenate([block.si("time") for block in il.read_blocks(folder / "rec.csv")])
    places = np.round(saved * RATE).astype(int)
    print(f"{minutes:g} min, {RATE} Hz, 10 columns: {unit.sent} sent, {len(saved)} saved, from number {places[0]} on")
    print(f"lost: {unit.sent - len(saved)}; not in order or twice: {int((np.diff(places) != 1).sum())}")
    print(f"processor: {100 * (last[1] - first[1]) / (last[0] - first[0]):.1f} % of a core")
    print("memory, MiB: " + " ".join(f"{each[2]:.0f}" for each in measured[:: max(1, len(measured) // 12)]))
    middle, most = np.percentile(late, [50, 99])
    print(
        f"screen behind the unit: median {1e3 * middle:.0f} ms, 99 % {1e3 * most:.0f} ms, most {1e3 * max(late):.0f} ms"
    )
    print(f"the unit itself was late by {1e3 * unit.behind:.0f} ms at most; exit status {process.returncode}")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 30.0)
