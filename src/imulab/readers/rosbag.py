"""sensor_msgs/Imu (and Temperature) out of ROS 1 bags, MCAP and ROS 2 sqlite files.

The payloads of a topic have a fixed size, so that a NumPy view reads thousands at once. Sources: the definitions of
sensor_msgs/Imu and std_msgs/Header; OMG DDS-XTypes 1.3, 7.4 (plain CDR: little or big endian, doubles aligned to 8
bytes behind a head of 4); ROS wiki "Messages" (ROS 1: little endian, not aligned). A covariance of -1 at its first
place, or a reading of NaN, says that a quantity is not reported.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from imulab.columns import triad
from imulab.errors import OptionError, ReadError, listed
from imulab.readers import logs
from imulab.readers.rosfiles import Container, Topic, open_container
from imulab.readers.rosfolder import files_of
from imulab.readers.selection import Selection
from imulab.readers.streams import LoggedStream, Piece, on_one_clock
from imulab.recording import Array, Recording

_IMU, _TEMPERATURE = "sensor_msgs/Imu", "sensor_msgs/Temperature"
_DOUBLES = {_IMU: 37, _TEMPERATURE: 2}
_GYRO_AT, _ACCEL_AT = 13, 25  # behind quaternion and its covariance, behind the rate and its covariance
_ACCEL = dict.fromkeys(triad("accel"), "m/s^2")
_GYRO = dict.fromkeys(triad("gyro"), "rad/s")
_ENOUGH = 4096  # samples to find out what a topic reports; a chunk may hold only one
_ZSTD = b"\x28\xb5\x2f\xfd"


def blocks(path: Path, name: str, selection: Selection) -> Iterator[Recording]:
    """Yield the samples of one Imu topic, or of an accelerometer's and a gyroscope's.

    Raises
    ------
    ReadError
        The file is cut or damaged, or holds no Imu topic.
    OptionError
        It holds several and none is chosen, or the chosen one is not there.
    """
    selection.refuse(name, "a ROS bag", topic=False)
    files = [open_container(file, name) for file in (files_of(path, name) if path.is_dir() else [path])]
    topics = [topic for file in files for topic in file.topics]
    chosen = _choose(topics, selection.topic, name)
    notes: list[str] = []
    slots = {topic: slot for slot, topic in enumerate(chosen)}
    warm = _temperature(topics, chosen, notes)
    if warm is not None:
        slots[warm] = len(slots)
    there, pieces = _reported(_pieces(files, slots, name), name, chosen[0])
    if len(chosen) == 2:
        taken = [slice(0, 3), slice(3, 6)]
        streams = [LoggedStream("accelerometer", _ACCEL), LoggedStream("gyroscope", _GYRO)]
    else:
        if not any(there):
            raise ReadError(f"{name}: {chosen[0]} reports neither specific force nor rate (covariance -1 or nan)")
        taken = [slice(0 if there[0] else 3, 6 if there[1] else 3)]
        streams = [
            LoggedStream(
                "accelerometer" if there[0] else "gyroscope",
                {**(_ACCEL if there[0] else {}), **(_GYRO if there[1] else {})},
            )
        ]
        notes += [
            f"{chosen[0]} does not report the {what}"
            for what, is_there in zip(("accelerometer", "gyroscope"), there, strict=True)
            if not is_there
        ]
    if warm is not None:
        taken.append(slice(0, 1))
        streams.append(LoggedStream("temperature", {"temperature": "degC"}, slow=True))
    yield from on_one_clock(
        streams,
        (Piece(p.stream, p.ticks, p.values[:, taken[p.stream]]) for p in pieces),
        name=name,
        per_second=1_000_000_000,
        origin=None,
        metadata=lambda epoch: {
            "topic": ",".join(chosen),
            "epoch": f"{epoch // 10**9}.{epoch % 10**9:09d} s",
        },
        notes=tuple(notes),
    )


# --- topics --------------------------------------------------------------------------------------------------------


def _choose(topics: list[Topic], wanted: str | None, name: str) -> list[str]:
    there = list(dict.fromkeys(topic.name for topic in topics if topic.type == _IMU))
    if not there:
        found = ", ".join(dict.fromkeys(f"{t.name} ({t.type})" for t in topics)) or "none"
        raise ReadError(f"{name}: no topic of sensor_msgs/Imu; topics found: {found}")
    if wanted is None:
        if len(there) > 1:
            raise OptionError(f"{name}: several Imu topics, choose one with --topic: {' '.join(there)}")
        logging.getLogger(__name__).info("%s: topic %s, the only one of an Imu", name, there[0])
        return there
    chosen = [entry if entry.startswith("/") or entry in there else f"/{entry}" for entry in wanted.split(",")]
    for entry in chosen:
        if entry not in there:
            raise OptionError(f"{name}: no Imu topic {entry}; Imu topics found: {listed(there, entry)}")
    if len(chosen) > 2 or len(set(chosen)) < len(chosen):
        raise OptionError(f"{name}: topic {wanted!r}: expected one, or the accelerometer's and the gyroscope's: A,G")
    return chosen


def _temperature(topics: list[Topic], chosen: list[str], notes: list[str]) -> str | None:
    """Return the temperature topic that belongs to the chosen ones, if any: in their namespace, or the only one."""
    names = list(dict.fromkeys(topic.name for topic in topics if topic.type == _TEMPERATURE))
    near = [name for name in names if name.rpartition("/")[0] == chosen[0].rpartition("/")[0]]
    near = near or [name for name in names if name.startswith(f"{chosen[0]}/")] or names
    if len(near) == 1:
        return near[0]
    if near:
        notes.append(f"temperature left out: several topics could be it: {' '.join(near)}")
    return None


# --- messages ------------------------------------------------------------------------------------------------------


def _pieces(files: list[Container], slots: dict[str, int], name: str) -> Iterator[Piece]:
    for file in files:
        mine = {topic.number: topic for topic in file.topics if topic.name in slots and topic.type in _DOUBLES}
        if not mine:
            continue
        for records in file.messages(mine):
            for number in np.unique(records.keys).tolist():
                topic = mine[number]
                ticks, values = _decoded(records, records.of(number), topic, name)
                yield Piece(slots[topic.name], ticks, _readings(values) if topic.type == _IMU else values[:, :1])


def _reported(pieces: Iterator[Piece], name: str, topic: str) -> tuple[list[bool], Iterator[Piece]]:
    """Return whether the clock's stream reports specific force and rate, by its first samples; and all pieces."""
    before: list[Piece] = []
    there, count = [False, False], 0
    for piece in pieces:
        before.append(piece)
        if piece.stream == 0:
            there = [there[i] or bool(np.isfinite(piece.values[:, 3 * i : 3 * i + 3]).any()) for i in (0, 1)]
            count += len(piece.ticks)
            if all(there) or count >= _ENOUGH:
                break
    if not count:
        raise ReadError(f"{name}: no messages on {topic}")
    return there, chain(before, pieces)


def _readings(values: Array) -> Array:
    """Return specific force and rate, shape (n, 6), NaN where the covariance says that they are not reported."""
    readings = np.empty((len(values), 6))
    for place, at in ((0, _ACCEL_AT), (3, _GYRO_AT)):
        unknown = values[:, at + 3] == -1
        readings[:, place : place + 3] = np.where(unknown[:, None], np.nan, values[:, at : at + 3])
    return readings


def _decoded(records: logs.Records, indices: logs.Integers, topic: Topic, name: str) -> tuple[logs.Integers, Array]:
    """Return header stamps, ns (n,), and the doubles behind the header (n, count)."""
    if topic.encoding not in ("cdr", "ros1"):
        raise ReadError(f"{name}: {topic.name} is serialised as {topic.encoding!r}; expected cdr or ros1")
    count = _DOUBLES[topic.type]
    offsets, sizes = records.offsets[indices], records.sizes[indices]

    def refuse(found: int) -> None:
        first = records.block[int(offsets[0]) : int(offsets[0]) + 4]
        hint = "; each message is compressed: convert the bag first ('ros2 bag convert')" if first == _ZSTD else ""
        raise ReadError(f"{name}: {topic.name}: a message of {found} bytes is no {topic.type}{hint}")

    if sizes.min() < 16:
        refuse(int(sizes.min()))
    head = logs.gather(records.block, offsets, 16)
    if topic.encoding == "ros1":
        big = np.zeros(len(head), dtype=bool)
    else:
        if (head[:, 0] != 0).any() or (head[:, 1] > 1).any():
            refuse(int(sizes[0]))
        big = head[:, 1] == 0
    ticks = np.empty(len(head), dtype=np.int64)
    values = np.empty((len(head), count))
    for order, these in (("<", np.flatnonzero(~big)), (">", np.flatnonzero(big))):
        numbers = logs.field(head[these], 4, f"{order}u4", 3).astype(np.int64)
        ticks[these] = numbers[:, 0] * 10**9 + numbers[:, 1]
        frame = numbers[:, 2]
        for length in np.unique(frame).tolist():
            same = these[frame == length]
            start = 16 + length if topic.encoding == "ros1" else 4 + (12 + length + 7) // 8 * 8
            if sizes[same].min() < start + 8 * count:
                refuse(int(sizes[same].min()))
            values[same] = logs.field(
                logs.gather(records.block, offsets[same] + start, 8 * count), 0, f"{order}f8", count
            )
    return ticks, values
