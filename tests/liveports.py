"""A unit on a pseudo-terminal that no reader holds up, and `imulab live` as a process; nothing waits for ever."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

import imulab as il
from benchpage import PATIENCE


class Device:
    """Sends pieces at a pace from a thread, once somebody listens; then those that are late by a second are lost.

    Parameters
    ----------
    pieces
        Bytes, each sent whole unless its reader is gone.
    rate
        Pieces a second.
    patient
        Whether it waits for its reader instead.
    """

    def __init__(self, pieces: Sequence[bytes], rate: float, *, patient: bool = False) -> None:
        self.end, self._kept_open = os.openpty()
        tty.setraw(self._kept_open)
        os.set_blocking(self.end, False)
        self.port = os.ttyname(self._kept_open)
        self._speed = termios.tcgetattr(self._kept_open)[4]
        self.sent: list[tuple[int, float]] = []
        self.done = threading.Event()
        self._pieces, self._rate, self._patient = pieces, rate, patient
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        if not patient:
            self.begin()

    def begin(self) -> None:
        """Send; a patient one waits until it is told that somebody listens, since opening a port empties it."""
        self._thread.start()

    def await_listener(self) -> None:
        """Wait until somebody has opened the port, who sets its speed."""
        while termios.tcgetattr(self._kept_open)[4] == self._speed and not self._stop.is_set():
            time.sleep(0.01)

    def _run(self) -> None:
        self.await_listener()
        number, begun = 0, time.monotonic()
        while number < len(self._pieces) and not self._stop.is_set():
            due = begun + number / self._rate
            if due > time.monotonic():
                time.sleep(0.002)
                continue
            if not self._patient and time.monotonic() - due > 1.0:
                number += 1
                continue
            if not self._put(self._pieces[number]):
                return
            self.sent.append((number, time.monotonic()))
            number += 1
        self.done.set()

    def _put(self, data: bytes) -> bool:
        while data and not self._stop.is_set():
            if not select.select([], [self.end], [], 0.05)[1]:
                continue
            try:
                data = data[os.write(self.end, data) :]
            except BlockingIOError:
                time.sleep(0.002)
            except OSError:
                return False
        return not data

    def follow(self, numbers: np.ndarray) -> bool:
        """Whether pieces of these numbers were sent one after the other."""
        places = np.searchsorted([number for number, _ in self.sent], numbers)
        return bool((np.diff(places) == 1).all())

    def answer(self, asked: bytes, pieces: Sequence[bytes], seconds: float = 30.0) -> None:
        """Send one piece for each time that these bytes are asked for, instead of by itself."""
        got, end = b"", time.monotonic() + seconds
        for piece in pieces:
            while asked not in got and time.monotonic() < end and not self._stop.is_set():
                if select.select([self.end], [], [], 0.05)[0]:
                    got += os.read(self.end, 4096)
            got = got[got.find(asked) + len(asked) :]
            self._put(piece)
        self.done.set()

    def unplug(self) -> None:
        """Close the device's end: whoever reads or writes at the port gets an error."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(2.0)
        with suppress(OSError):
            os.close(self.end)

    def close(self) -> None:
        self.unplug()
        with suppress(OSError):
            os.close(self._kept_open)


@contextmanager
def device(pieces: Sequence[bytes], rate: float, *, patient: bool = False) -> Iterator[Device]:
    """A device that is gone afterwards."""
    made = Device(pieces, rate, patient=patient)
    try:
        yield made
    finally:
        made.close()


class Process:
    """`imulab live` with these words; what it prints is gathered, with the time of each line."""

    def __init__(self, words: Sequence[str], folder: Path, **options: object) -> None:
        self.lines: list[tuple[float, str]] = []
        self._process = subprocess.Popen(
            [sys.executable, "-m", "imulab", "live", *words],
            cwd=folder,
            stdin=options.pop("stdin", subprocess.DEVNULL),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            **options,
        )
        self.stdin = self._process.stdin
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append((time.monotonic(), line.rstrip()))

    @property
    def text(self) -> str:
        return "\n".join(line for _, line in self.lines)

    def said(self, what: str, seconds: float = PATIENCE) -> float:
        """Wait until it has said something, and return when; infinite if it never does."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for when, line in list(self.lines):
                if what in line:
                    return when
            if self._process.poll() is not None and not self._reader.is_alive():
                break
            time.sleep(0.01)
        return next((when for when, line in self.lines if what in line), float("inf"))

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def peak_memory(self) -> float:
        """Bytes that it has taken at most."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        return 1024.0 * int(status.partition("VmHWM:")[2].split()[0])

    def kill(self) -> None:
        self._process.kill()
        self.ended()

    def ended(self, seconds: float = PATIENCE) -> int:
        """Return the exit status; a process that does not end is killed, and the test fails."""
        try:
            status = self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(5.0)
            raise AssertionError(f"still running after {seconds:g} s; it said:\n{self.text}") from None
        self._reader.join(5.0)
        if not self._reader.is_alive() and self._process.stdout is not None:
            self._process.stdout.close()
        if self.stdin is not None:
            with suppress(OSError):
                self.stdin.close()
        return status


@contextmanager
def live(words: Sequence[str], folder: Path, **options: object) -> Iterator[Process]:
    """`imulab live` as a process, which is gone afterwards."""
    process = Process(words, folder, **options)
    try:
        yield process
    finally:
        process.kill()


TITLES = "time [us],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]"


def lines_of(recording: il.Recording, columns: Sequence[str] = (), unit: str = "us") -> list[bytes]:
    """A recording as a sketch prints it: titles every 100 rows, stamps as whole numbers, readings with 5 places."""
    names = [name for name in recording.columns if name != "time" and (not columns or name in columns)]
    head = (",".join([f"time [{unit}]", *(f"{name} [{recording.units[name]}]" for name in names)]) + "\r\n").encode()
    stamps = (recording.time * {"us": 1e6, "ms": 1e3}[unit]).round().astype(int).tolist()
    rows = zip(stamps, *(recording.columns[name].tolist() for name in names), strict=True)
    texts = [(f"{t}," + ",".join(f"{v:.5f}" for v in row) + "\r\n").encode() for t, *row in rows]
    return [head + line if k % 100 == 0 else line for k, line in enumerate(texts)]


def content(record: Path) -> dict[str, object]:
    """What a record says, apart from when it was made."""
    found = json.loads(record.read_text())
    return {key: value for key, value in found.items() if key not in ("created", "content_sha256")}
