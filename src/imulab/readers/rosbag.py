"""sensor_msgs/Imu (with MagneticField and Temperature) out of ROS 1 bags, MCAP and ROS 2 sqlite files.

The payloads of a topic have a fixed size, so that a NumPy view reads thousands at once. Sources: the definitions of
sensor_msgs/Imu, sensor_msgs/MagneticField and std_msgs/Header; OMG DDS-XTypes 1.3, 7.4 (plain CDR: little or big
endian, doubles aligned to 8 bytes behind a head of 4); ROS wiki "Messages" (ROS 1: little endian, not aligned). A
covariance of -1 at its first place, or a reading of NaN, says that a quantity is not reported.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
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
from imulab.units import parse_unit
from imulab.verdict import Note

_IMU, _TEMPERATURE, _FIELD = "sensor_msgs/Imu", "sensor_msgs/Temperature", "sensor_msgs/MagneticField"
_DOUBLES = {_IMU: 37, _TEMPERATURE: 2, _FIELD: 12}
_GYRO_AT, _ACCEL_AT = 13, 25  # behind quaternion and its covariance, behind the rate and its covariance
_ACCEL = dict.fromkeys(triad("accel"), "m/s^2")
_GYRO = dict.fromkeys(triad("gyro"), "rad/s")
_MAG = dict.fromkeys(triad("mag"), "T")
_MOST_FIELD = 1e-3
"""T; ten times and more what a magnetometer of a moving unit sees, hard iron included, or can put out."""
_EARTH = (15e-6, 120e-6)
"""T; fields on Earth with the hard iron of an ordinary unit, so narrow that one unit at most fits a number."""
_ENOUGH = 4096  # samples to find out what a topic reports; a chunk may hold only one
_ZSTD = b"\x28\xb5\x2f\xfd"


def blocks(path: Path, name: str, selection: Selection) -> Iterator[Recording]:
    """Yield the samples of one Imu topic, or of an accelerometer's and a gyroscope's, with the magnetometer beside it.

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
    notes: list[str] = []
    chosen, field = _choose(topics, selection.topic, name)
    slots = {topic: slot for slot, topic in enumerate(chosen)}
    field = field or _beside(topics, _FIELD, chosen, "magnetometer", notes)
    warm = _beside(topics, _TEMPERATURE, chosen, "temperature", notes)
    for topic in (field, warm):
        if topic is not None:
            slots[topic] = len(slots)
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
    if field is not None:
        taken.append(slice(0, 3))
        streams.append(LoggedStream("magnetometer", _MAG, placed=True))
        pieces = _in_tesla(pieces, slots[field], field, notes)
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
            "topic": ",".join([*chosen, *([field] if field is not None else [])]),
            "epoch": f"{epoch // 10**9}.{epoch % 10**9:09d} s",
        },
        notes=notes,
    )


# --- topics --------------------------------------------------------------------------------------------------------


def _choose(topics: list[Topic], wanted: str | None, name: str) -> tuple[list[str], str | None]:
    """Return the topics of an Imu, one or two, and that of a magnetometer if one is asked for."""
    there = _of_type(topics, _IMU)
    if not there:
        found = ", ".join(dict.fromkeys(f"{t.name} ({t.type})" for t in topics)) or "none"
        raise ReadError(f"{name}: no topic of sensor_msgs/Imu; topics found: {found}")
    fields = _of_type(topics, _FIELD)
    entries = wanted.split(",") if wanted is not None else []
    named = [entry if entry.startswith("/") or entry in (*there, *fields) else f"/{entry}" for entry in entries]
    field = next((entry for entry in named if entry in fields), None)
    chosen = [entry for entry in named if entry != field]
    if not chosen:
        if len(there) > 1:
            raise OptionError(f"{name}: several Imu topics, choose one with --topic: {' '.join(there)}")
        logging.getLogger(__name__).info("%s: topic %s, the only one of an Imu", name, there[0])
        return there, field
    for entry in chosen:
        if entry not in there:
            also = f"; of MagneticField: {' '.join(fields)}" if fields else ""
            raise OptionError(f"{name}: no Imu topic {entry}; Imu topics found: {listed(there, entry)}{also}")
    if len(chosen) > 2 or len(set(chosen)) < len(chosen):
        raise OptionError(f"{name}: topic {wanted!r}: expected one, or the accelerometer's and the gyroscope's: A,G")
    return chosen, field


def _of_type(topics: list[Topic], kind: str) -> list[str]:
    return list(dict.fromkeys(topic.name for topic in topics if topic.type == kind))


def _beside(topics: list[Topic], kind: str, chosen: list[str], what: str, notes: list[str]) -> str | None:
    """Return the topic of a type that belongs to the chosen ones, if any: in their namespace, or the only one."""
    names = _of_type(topics, kind)
    near = [name for name in names if name.rpartition("/")[0] == chosen[0].rpartition("/")[0]]
    near = near or [name for name in names if name.startswith(f"{chosen[0]}/")] or names
    if len(near) == 1:
        return near[0]
    if near:
        left = f"{what} left out: several topics could be it: {' '.join(near)}"
        notes.append(left if kind != _FIELD else Note(f"{left}; --topic {chosen[0]},{near[0]} takes the first"))
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
                yield Piece(slots[topic.name], ticks, _READINGS[topic.type](values))


def _in_tesla(pieces: Iterator[Piece], stream: int, topic: str, notes: list[str]) -> Iterator[Piece]:
    """Pass pieces on, a magnetometer's in tesla: drivers that write another unit are found out by its size."""
    factor = None
    for piece in pieces:
        if piece.stream != stream:
            yield piece
            continue
        size = np.linalg.norm(piece.values, axis=1)
        if factor is None and np.isfinite(size).any():
            usual = float(np.median(size[np.isfinite(size)]))
            factor, said = _unit_of_field(usual, topic)
            notes += said
        yield replace(piece, values=piece.values * factor) if factor else piece


def _unit_of_field(size: float, topic: str) -> tuple[float, list[Note]]:
    """Return the factor to tesla of a field of this usual size, stated as tesla, and what is said of it."""
    if size <= _MOST_FIELD:
        return 1.0, []
    wrong = f"{topic} says that the field is {size:.3g} T, which none on Earth is"
    for unit in ("mT", "gauss", "uT", "mgauss", "nT"):
        factor = parse_unit(unit).factor
        if _EARTH[0] <= size * factor <= _EARTH[1]:
            return factor, [Note(f"{wrong}: its readings are taken as {unit}")]
    return 1.0, [Note(f"{wrong}, and no other unit fits: its readings are left as they are")]


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


def _field(values: Array) -> Array:
    """Return magnetic fields, shape (n, 3), NaN where the covariance says that they are not reported."""
    return np.where(values[:, 3:4] == -1, np.nan, values[:, :3])


_READINGS: dict[str, Callable[[Array], Array]] = {_IMU: _readings, _FIELD: _field, _TEMPERATURE: lambda v: v[:, :1]}


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
