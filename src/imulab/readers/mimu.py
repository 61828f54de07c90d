"""MIMU4444: the log of an array of eight six-axis IMUs on one board.

Frames of 106 bytes, big-endian: AA, u16 sequence, 64 (hexadecimal, the length of what follows but the sum), u32 time
stamp of a 64 MHz clock, eight times three accelerometers and three gyroscopes i16, u16 sum of the bytes before it.
A short acknowledgement may stand before the first frame. Source: the recordings of Self-Calibration-Inertial-Sensor-
Arrays-BCD; GT Silicon, MIMU4444 interface description.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding, Note
from imulab.errors import ReadError
from imulab.files import open_file
from imulab.readers.selection import Selection
from imulab.recording import Array, Recording, Source
from imulab.units import STANDARD_GRAVITY

_FRAME = np.dtype(
    [("head", "u1"), ("sequence", ">u2"), ("size", "u1"), ("stamp", ">u4"), ("data", ">i2", (8, 6)), ("sum", ">u2")]
)
_HEAD, _SIZE = 0xAA, 0x64  # first byte of a frame, and bytes of its payload
_SEARCH = 4096  # bytes within which the first frame is looked for
_CLOCK = 64e6  # Hz
_WRAP = 1 << 32  # ticks, 67 s
_RESTARTED = 60_000  # frames: a larger jump of the sequence is a restart
_ACCEL_STEP = STANDARD_GRAVITY / 2048  # m/s^2
_GYRO_STEP = 1 / 16.4  # deg/s


def is_mimu(start: bytes) -> bool:
    """Return whether the first bytes of a file (at least two frames) hold a MIMU4444 frame with a correct sum."""
    return _first_frame(start) is not None


def blocks(path: Path, name: str, selection: Selection) -> Iterator[Recording]:
    """Yield the whole log, ten minutes of which are 25 MB."""
    selection.refuse(name, "such a log")
    with open_file(path) as stream:
        yield read_mimu(stream, name)


def read_mimu(stream: BinaryIO, name: str) -> Recording:
    """Return a MIMU4444 log: ``time [s]`` from 0, ``gyro_x_1 .. gyro_z_8 [deg/s]``, ``accel_..`` [m/s^2].

    Axes are as logged. Damaged bytes between frames are skipped, and a log that ends in the middle of a frame is read
    up to there; notes say so.

    Raises
    ------
    ReadError
        No frame was found.
    """
    data = stream.read()
    frames, skipped, cut = _frames(data)
    if not len(frames):
        raise ReadError(f"{name}: no whole MIMU4444 frame of {_FRAME.itemsize} bytes was found")
    stamp: NDArray[np.int64] = frames["stamp"].astype(np.int64)
    sequence: NDArray[np.int64] = frames["sequence"].astype(np.int64)
    lost = np.mod(np.diff(sequence) - 1, 1 << 16)
    ticks = _ticks(stamp, lost)
    columns: dict[str, Array] = {"time": np.cumsum(ticks) / _CLOCK}
    units = {"time": "s"}
    for sensor, first, step, unit in (("gyro", 3, _GYRO_STEP, "deg/s"), ("accel", 0, _ACCEL_STEP, "m/s^2")):
        for axis, letter in enumerate("xyz"):
            for element in range(8):
                title = f"{sensor}_{letter}_{element + 1}"
                columns[title] = step * frames["data"][:, element, first + axis].astype(np.float64)
                units[title] = unit
    notes: list[str] = []
    if cut is not None:
        notes.append(Note(f"truncated: the last frame, at byte {cut}, is cut; read up to there"))
    if skipped:
        notes.append(
            Finding(
                f"{skipped} bytes between frames were skipped as damaged",
                "check the link of the logger, and record again",
            )
        )
    if lost.any():
        index = int(np.flatnonzero(lost)[0])
        notes.append(
            Finding(
                f"{int(lost.sum())} frames are missing from the log, the first after row {index + 1}",
                "check the link of the logger, and record again",
            )
        )
    return Recording(
        columns=columns,
        units=units,
        metadata={"model": "MIMU4444"},
        name=name,
        source=Source(name, hashlib.sha256(data).hexdigest()),
        notes=tuple(notes),
        from_file=True,
    )


def _ticks(stamp: NDArray[np.int64], lost: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the ticks from frame to frame; across missing frames, with the wraps that their number implies."""
    step = np.mod(np.diff(stamp), _WRAP)
    if step.size:
        usual = float(np.median(step))
        wraps = np.round(((lost + 1) * usual - step) / _WRAP).astype(np.int64)
        step = step + _WRAP * np.where(lost < _RESTARTED, np.maximum(wraps, 0), 0)
    return np.concatenate([np.zeros(1, dtype=np.int64), step])


def _first_frame(data: bytes, furthest: int = _SEARCH) -> int | None:
    """Return the place of the first frame with a correct sum, or None."""
    place = data.find(_HEAD)
    while 0 <= place <= min(len(data) - _FRAME.itemsize, furthest):
        if data[place + 3] == _SIZE and _good(data[place : place + _FRAME.itemsize]).all():
            return place
        place = data.find(_HEAD, place + 1)
    return None


def _good(data: bytes) -> np.ndarray:
    """Return for each frame whether head, size and sum are right."""
    raw = np.frombuffer(data, dtype=np.uint8).reshape(-1, _FRAME.itemsize)
    frames = raw.view(_FRAME)[:, 0]
    total = raw[:, :-2].sum(axis=1, dtype=np.uint32) % (1 << 16)
    good: np.ndarray = (frames["head"] == _HEAD) & (frames["size"] == _SIZE) & (total == frames["sum"])
    return good


def _frames(data: bytes) -> tuple[np.ndarray, int, int | None]:
    """Return the good frames, the number of bytes skipped after the first, and the place of a last, cut frame."""
    frames, skipped, size, cut = [], 0, _FRAME.itemsize, None
    place = _first_frame(data)
    while place is not None:
        count = (len(data) - place) // size
        run = data[place : place + count * size]
        good = _good(run) if count else np.empty(0, dtype=bool)
        length = count if good.all() else int(np.argmin(good))
        frames.append(np.frombuffer(run[: length * size], dtype=_FRAME))
        place += length * size
        step = _first_frame(data[place:], len(data))
        if step is None:
            if _begins_frame(data[place:]):
                cut = place
            else:
                skipped += len(data) - place
            break
        skipped += step
        place += step
    return (np.concatenate(frames) if frames else np.empty(0, dtype=_FRAME)), skipped, cut


def _begins_frame(rest: bytes) -> bool:
    """Return whether the last bytes of a log are the beginning of a frame that was being written."""
    return 0 < len(rest) < _FRAME.itemsize and rest[0] == _HEAD and rest[3:4] in (b"", bytes([_SIZE]))
