"""PX4 ULog: sensor_accel and sensor_gyro, or sensor_combined where that has clearly more samples, and sensor_mag.

Source: the file format in the PX4 user guide ("ULog File Format", version 1): a header of 16 bytes, then messages
u16 size, u8 type, payload. Time is ``timestamp_sample`` (``timestamp`` where a log has none), microseconds since boot.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from imulab.columns import triad
from imulab.display import Finding, Note
from imulab.errors import OptionError, ReadError
from imulab.files import open_file
from imulab.readers import logs
from imulab.readers.selection import Selection
from imulab.readers.streams import LoggedStream, Piece, side_by_side
from imulab.recording import Recording

MAGIC = b"ULog\x01\x12\x35"
_HEADER = 16  # bytes: magic, version, start time
_SIZES = {
    "int8_t": "i1",
    "uint8_t": "u1",
    "bool": "u1",
    "char": "u1",
    "int16_t": "<i2",
    "uint16_t": "<u2",
    "int32_t": "<i4",
    "uint32_t": "<u4",
    "int64_t": "<i8",
    "uint64_t": "<u8",
    "float": "<f4",
    "double": "<f8",
}
_TOPICS = ("sensor_accel", "sensor_gyro", "sensor_combined")
_ACCEL = dict.fromkeys(triad("accel"), "m/s^2")
_GYRO = dict.fromkeys(triad("gyro"), "rad/s")
_MAGS = ("sensor_mag", "vehicle_magnetometer")
"""Magnetometers, gauss: as measured, and as corrected and rotated by PX4."""
_MAG = dict.fromkeys(triad("mag"), "gauss")
_VECTORS = ("gyro_rad", "accelerometer_m_s2", "magnetometer_ga")
_NO_ACCEL = 2**31 - 1  # relative time that marks a sample without acceleration
_KEPT = {"sys_name": "autopilot", "ver_hw": "hardware", "sys_uuid": "autopilot_uuid"}


@dataclass(frozen=True, slots=True)
class _Field:
    offset: int
    kind: str
    count: int


@dataclass(slots=True)
class _Contents:
    """Result of a first pass over the file."""

    formats: dict[str, str] = field(default_factory=dict)
    subscriptions: dict[int, tuple[str, int]] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    smallest: dict[int, int] = field(default_factory=dict)
    info: dict[str, str] = field(default_factory=dict)
    dropouts: list[int] = field(default_factory=list)
    limit: int = 0
    notes: list[str] = field(default_factory=list)


def blocks(path: Path, name: str, selection: Selection) -> Iterator[Recording]:
    """Yield the samples of one accelerometer and gyroscope, and of a magnetometer.

    Raises
    ------
    ReadError
        The file is no ULog, is damaged, or has no such topic or instance.
    OptionError
        An unknown topic.
    """
    contents = _survey(path, name)
    streams, sources = _choose(contents, selection, name)
    yield from side_by_side(
        streams,
        _pieces(path, contents, sources, name),
        name=name,
        per_second=1_000_000,
        origin=0,
        metadata=lambda _: {**contents.info, "time_origin": "boot"},
        notes=tuple(contents.notes),
    )


# --- what is inside ----------------------------------------------------------------------------------------------


def _survey(path: Path, name: str) -> _Contents:
    contents = _Contents(limit=path.stat().st_size)
    with open_file(path) as stream:
        head = stream.read(_HEADER)
        if len(head) < _HEADER or not head.startswith(MAGIC):
            raise ReadError(f"{name}: not a ULog: expected a header of {_HEADER} bytes, found {len(head)}")
        size = contents.limit
        contents.limit = _end_of_log(stream.read(43), size, name)
        ending: list[logs.Ending] = []
        for records in logs.walk_stream(stream, logs.ULOG, _HEADER, contents.limit, ending):
            kinds = records.keys & 0xFF
            for index in np.flatnonzero((kinds != ord("D")) & (kinds != ord("S"))).tolist():
                _define(contents, chr(int(kinds[index])), records.payload(index), name)
            data = np.flatnonzero(kinds == ord("D"))
            ids = records.keys[data] >> 8
            for number in np.unique(ids).tolist():
                sizes = records.sizes[data[ids == number]]
                contents.counts[number] = contents.counts.get(number, 0) + sizes.size
                contents.smallest[number] = min(contents.smallest.get(number, 1 << 16), int(sizes.min()))
    (end,) = ending
    if end.damaged and end.position < contents.limit:
        shown = end.left[:3].hex(" ")
        raise ReadError(f"{name}: damaged at byte {end.position}: expected a ULog message, found {shown}")
    if end.left and contents.limit == size:
        contents.notes.append(Note(f"truncated: the last message, at byte {end.position}, is cut; read up to there"))
    if contents.dropouts:
        contents.notes.append(
            Finding(
                f"{len(contents.dropouts)} dropouts of the logger, {sum(contents.dropouts)} ms in all",
                "record again with a faster card or fewer topics",
            )
        )
    return contents


def _end_of_log(first: bytes, size: int, name: str) -> int:
    """Return the end of the log; the first message states whether other data were appended (after a crash)."""
    if len(first) < 43 or first[2:3] != b"B":
        return size
    flags, appended = first[11:19], int.from_bytes(first[19:27], "little")
    if flags[0] & ~1 or any(flags[1:]):
        raise ReadError(f"{name}: needs a newer reader (incompatible flags {flags.hex()})")
    if not flags[0] & 1 or appended == 0:
        return size
    if not _HEADER <= appended <= size:
        raise ReadError(f"{name}: says that data were appended at byte {appended}, but has {size} bytes")
    return appended


def _define(contents: _Contents, kind: str, payload: bytes, name: str) -> None:
    if kind == "F":
        title, colon, fields = logs.text_of(payload, name, "a message format").partition(":")
        if not colon:
            raise ReadError(f"{name}: message format {title[:40]!r}: expected 'name:fields'")
        contents.formats[title] = fields
    elif kind == "A":
        if len(payload) < 4:
            raise ReadError(f"{name}: a subscription of {len(payload)} bytes, expected at least 4")
        number = int.from_bytes(payload[1:3], "little")
        contents.subscriptions[number] = (logs.text_of(payload[3:], name, "a subscription"), payload[0])
    elif kind == "I" and payload and len(payload) > payload[0]:
        key = payload[1 : 1 + payload[0]].decode("utf-8", "replace").partition(" ")
        if key[0].startswith("char[") and _KEPT.get(key[2]):
            contents.info[_KEPT[key[2]]] = payload[1 + payload[0] :].decode("utf-8", "replace").strip("\0 ")
    elif kind == "O" and len(payload) >= 2:
        contents.dropouts.append(int.from_bytes(payload[:2], "little"))


def _choose(
    contents: _Contents, selection: Selection, name: str
) -> tuple[list[LoggedStream], dict[int, tuple[int, str, dict[str, _Field]]]]:
    """Return the streams, and for each subscription its stream, its topic and the places of its fields."""
    topic, magnetometer = selection.beside(_MAGS[0])
    if topic is not None and topic not in _TOPICS:
        raise OptionError(f"{name}: topic {topic!r}; of a ULog these can be read: {' '.join(_TOPICS)} {_MAGS[0]}:N")
    there = {
        (title, instance): number
        for number, (title, instance) in contents.subscriptions.items()
        if contents.counts.get(number) and title in _TOPICS
    }
    if not there:
        others = sorted({contents.subscriptions[n][0] for n in contents.counts if n in contents.subscriptions})
        raise ReadError(
            f"{name}: no {' '.join(_TOPICS[:2])} or {_TOPICS[2]}; topics found: {' '.join(others) or 'none'}"
        )
    titles = {title for title, _ in there}
    instance = selection.instance or 0
    raw = [t for t in _TOPICS[:2] if t in titles]
    wanted = [topic] if topic else raw or ["sensor_combined"]
    if wanted == ["sensor_accel"] and "sensor_gyro" in titles:
        wanted.append("sensor_gyro")
    if topic is None and raw:
        samples = {t: contents.counts[there[t, instance]] if (t, instance) in there else 0 for t in _TOPICS}
        wanted = _raw_or_combined(samples, wanted, contents.notes)
    chosen = [title for title in wanted if (title, instance) in there]
    if not chosen:
        known = ", ".join(f"{title} {number}" for title, number in sorted(there))
        raise OptionError(f"{name}: no {' '.join(wanted)} of instance {instance}; found {known}")
    several = [f"{title} {number}" for title, number in sorted(there) if title in wanted]
    if len(several) > len(chosen):
        contents.notes.append(Note(f"instance {instance} of {', '.join(several)}"))
    mag = _magnetometer(contents, magnetometer, instance, name)
    streams: list[LoggedStream] = []
    sources: dict[int, tuple[int, str, dict[str, _Field]]] = {}
    for title, number in [(title, there[title, instance]) for title in chosen] + mag:
        fields = _fields(contents, title, name)
        needed = max(f.offset + np.dtype(f.kind).itemsize * f.count for f in fields.values())
        if contents.smallest[number] < needed:
            raise ReadError(
                f"{name}: a {title} message of {contents.smallest[number]} bytes, expected at least {needed}"
            )
        sources[number] = (len(streams), title, fields)
        if title == "sensor_accel":
            warm = {"temperature": "degC"} if "temperature" in fields else {}
            streams.append(LoggedStream("accelerometer", {**_ACCEL, **warm}))
        elif title == "sensor_gyro":
            streams.append(LoggedStream("gyroscope", _GYRO))
        elif title in _MAGS:
            streams.append(LoggedStream("magnetometer", _MAG, placed=True))
        else:
            streams += [LoggedStream("accelerometer", _ACCEL), LoggedStream("gyroscope", _GYRO)]
            contents.notes.append(
                Finding(
                    "sensor_combined holds outputs that PX4 has already corrected",
                    "log sensor_accel and sensor_gyro, and record again",
                )
            )
    return streams, sources


def _magnetometer(contents: _Contents, wanted: int | None, instance: int, name: str) -> list[tuple[str, int]]:
    """Return the magnetometer's topic and number, or None, and note which of several it is.

    `wanted` is the instance that was asked for; where none was, it is that of the accelerometer, or else the first.
    """
    there = {
        (title, place): number
        for number, (title, place) in contents.subscriptions.items()
        if contents.counts.get(number) and title in _MAGS
    }
    title = next((title for title in _MAGS if any(title == other for other, _ in there)), None)
    places = sorted(place for other, place in there if other == title)
    if wanted is not None and (title != _MAGS[0] or wanted not in places):
        known = ", ".join(f"{other} {place}" for other, place in sorted(there)) or "none"
        raise OptionError(f"{name}: no {_MAGS[0]} of instance {wanted}; magnetometers found: {known}")
    if title is None:
        return []
    place = wanted if wanted is not None else instance if instance in places else places[0]
    if title != _MAGS[0]:
        contents.notes.append(Note(f"{title} holds fields that PX4 has already corrected and turned"))
    elif len(places) > 1:
        others = ", ".join(f"{title}:{other}" for other in places if other != place)
        contents.notes.append(Note(f"instance {place} of {len(places)} of {title}; a topic chooses: {others}"))
    return [(title, there[title, place])]


def _raw_or_combined(samples: dict[str, int], raw: list[str], notes: list[str]) -> list[str]:
    """Return the topics to read: `raw` or, if it has clearly more samples, sensor_combined; note the choice."""
    combined = samples.pop("sensor_combined")
    few = " and ".join(f"{count} of {title}" for title, count in samples.items())
    if not any(combined > logs.PLAINLY_MORE * count for count in samples.values()):
        return raw
    read = not any(count > logs.PLAINLY_MORE * combined for count in samples.values())
    how = f"is read rather than {few}" if read else f"is not read: there are {few}"
    notes.append(Note(f"sensor_combined, which has {combined} samples, {how}; a topic chooses"))
    return ["sensor_combined"] if read else raw


def _fields(contents: _Contents, title: str, name: str) -> dict[str, _Field]:
    """Return the places of the needed fields in a message."""
    if title not in contents.formats:
        raise ReadError(f"{name}: {title} is logged, but its format is not in the file")
    layout: dict[str, _Field] = {}
    offset = 0
    for entry in contents.formats[title].split(";"):
        if not entry:
            continue
        match = re.fullmatch(r"(\w+?)(?:\[(\d{1,6})\])? (\w+)", entry)
        if match is None or match[1] not in _SIZES:
            if all(key in layout for key in _needed(title, layout)):
                break  # what follows is of no interest here
            raise ReadError(f"{name}: format of {title}: expected 'type name', found {entry[:40]!r}")
        count = int(match[2] or 1)
        layout[match[3]] = _Field(offset, _SIZES[match[1]], count)
        offset += np.dtype(_SIZES[match[1]]).itemsize * count
    needed = _needed(title, layout)
    for key in needed:
        if key not in layout or layout[key].count != (3 if key in _VECTORS else 1):
            raise ReadError(f"{name}: {title} has no field {key}; found {' '.join(layout)}")
    return {key: layout[key] for key in needed}


def _needed(title: str, layout: dict[str, _Field]) -> list[str]:
    if title == "sensor_combined":
        relative = ["accelerometer_timestamp_relative"] if "accelerometer_timestamp_relative" in layout else []
        return ["timestamp", "gyro_rad", "accelerometer_m_s2", *relative]
    stamp = "timestamp_sample" if "timestamp_sample" in layout else "timestamp"
    if title == _MAGS[1]:
        return [stamp, "magnetometer_ga"]
    warm = ["temperature"] if title == "sensor_accel" and "temperature" in layout else []
    return [stamp, "x", "y", "z", *warm]


# --- samples -----------------------------------------------------------------------------------------------------


def _pieces(
    path: Path, contents: _Contents, sources: dict[int, tuple[int, str, dict[str, _Field]]], name: str
) -> Iterator[Piece]:
    with open_file(path) as stream:
        for records in logs.walk_stream(stream, logs.ULOG, _HEADER, contents.limit, []):
            for number, (slot, title, fields) in sources.items():
                indices = records.of(ord("D") | number << 8)
                if not indices.size:
                    continue
                width = max(f.offset + np.dtype(f.kind).itemsize * f.count for f in fields.values())
                rows = logs.gather(records.block, records.offsets[indices], width)
                got = {key: logs.field(rows, f.offset, f.kind, f.count) for key, f in fields.items()}
                if title == "sensor_combined":
                    yield from _combined(got, slot)
                    continue
                stamp, *names = fields
                values = np.column_stack([got[key].astype(np.float64) for key in names])
                yield Piece(slot, got[stamp].astype(np.int64), values)


def _combined(got: dict[str, np.ndarray], slot: int) -> Iterator[Piece]:
    """Return sensor_combined as two streams: the accelerometer has its own time, relative to the gyroscope's."""
    stamp = got["timestamp"].astype(np.int64)
    relative = got.get("accelerometer_timestamp_relative", np.zeros_like(stamp)).astype(np.int64)
    there = relative != _NO_ACCEL
    yield Piece(slot, (stamp + relative)[there], got["accelerometer_m_s2"][there].astype(np.float64))
    yield Piece(slot + 1, stamp, got["gyro_rad"].astype(np.float64))
