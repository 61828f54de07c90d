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
from imulab.readers.instances import LoggedTriad, imus_on_one_clock
from imulab.readers.selection import Selection
from imulab.readers.streams import LoggedStream, Piece, side_by_side
from imulab.recording import EVERY, Array, Recording

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
_INTEGRALS = "vehicle_imu"
_ACCEL = dict.fromkeys(triad("accel"), "m/s^2")
_GYRO = dict.fromkeys(triad("gyro"), "rad/s")
_MAGS = ("sensor_mag", "vehicle_magnetometer")
"""Magnetometers, gauss: as measured, and as corrected and rotated by PX4."""
_MAG = dict.fromkeys(triad("mag"), "gauss")
_VECTORS = ("gyro_rad", "accelerometer_m_s2", "magnetometer_ga", "delta_angle", "delta_velocity")
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
    if selection.instance == EVERY:
        yield _every_imu(path, contents, selection, name)
        return
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
    instance = selection.single
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
        _check_size(contents, number, title, fields, name)
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


def _fields(contents: _Contents, title: str, name: str, *, device: bool = False) -> dict[str, _Field]:
    """Return the places of the needed fields in a message, with `device` that of the sensor's number too."""
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
    whole = [key for key, f in layout.items() if f.count == 1 and np.dtype(f.kind).kind in "iu"]
    odd = next((key for key in needed if key.startswith("timestamp") and key not in whole), None)
    if odd:
        raise ReadError(f"{name}: {title}: expected whole microseconds in {odd}, found numbers with a point")
    more = [key for key in ("device_id", "accel_device_id", "gyro_device_id") if device and key in whole]
    return {key: layout[key] for key in (*needed, *more)}


def _width(fields: dict[str, _Field]) -> int:
    """Return the bytes of a message up to the end of its last needed field."""
    return max(f.offset + np.dtype(f.kind).itemsize * f.count for f in fields.values())


def _check_size(contents: _Contents, number: int, title: str, fields: dict[str, _Field], name: str) -> None:
    if contents.smallest[number] < _width(fields):
        raise ReadError(
            f"{name}: a {title} message of {contents.smallest[number]} bytes, expected at least {_width(fields)}"
        )


def _needed(title: str, layout: dict[str, _Field]) -> list[str]:
    if title == "sensor_combined":
        relative = ["accelerometer_timestamp_relative"] if "accelerometer_timestamp_relative" in layout else []
        return ["timestamp", "gyro_rad", "accelerometer_m_s2", *relative]
    stamp = "timestamp_sample" if "timestamp_sample" in layout else "timestamp"
    if title == _INTEGRALS:
        return [stamp, "delta_angle", "delta_velocity", "delta_angle_dt", "delta_velocity_dt"]
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
                rows = logs.gather(records.block, records.offsets[indices], _width(fields))
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


# --- all IMUs ----------------------------------------------------------------------------------------------------


def _every_imu(path: Path, contents: _Contents, selection: Selection, name: str) -> Recording:
    """Return all IMUs on one clock: of sensor_accel and sensor_gyro, or of vehicle_imu where that has more samples."""
    topic, _ = selection.beside(_MAGS[0])
    there: dict[str, list[tuple[int, int]]] = {}
    for number, (title, instance) in contents.subscriptions.items():
        if contents.counts.get(number):
            there.setdefault(title, []).append((instance, number))
    if topic not in (None, *_TOPICS[:2], _INTEGRALS):
        raise OptionError(
            f"{name}: topic {topic!r}; all IMUs of a ULog are in sensor_accel and sensor_gyro, or in {_INTEGRALS}"
        )
    second = {
        title: (sorted((contents.counts[n] for _, n in there.get(title, [])), reverse=True)[1:2] or [0])[0]
        for title in (*_TOPICS[:2], _INTEGRALS)
    }
    integrals = second[_INTEGRALS] > min(second["sensor_accel"], second["sensor_gyro"])
    wanted = (_INTEGRALS,) if (integrals if topic is None else topic == _INTEGRALS) else _TOPICS[:2]
    places = {number: (title, instance) for title in wanted for instance, number in sorted(there.get(title, []))}
    if not places and _TOPICS[2] in there:
        raise ReadError(
            f"{name}: sensor_combined holds the one IMU that PX4 flies by; log sensor_accel and sensor_gyro of all "
            "instances at full rate"
        )
    fields = {number: _fields(contents, title, name, device=True) for number, (title, _) in places.items()}
    for number, (title, _) in places.items():
        _check_size(contents, number, title, fields[number], name)
    triads: dict[str, list[LoggedTriad]] = {"accel": [], "gyro": []}
    for number, got in _whole(path, contents, fields).items():
        title, instance = places[number]
        for sensor, logged in _triads(title, instance, got, name):
            triads[sensor].append(logged)
    if wanted == (_INTEGRALS,):
        contents.notes.append(Note("vehicle_imu holds means over its interval of outputs that PX4 has corrected"))
    head = {**contents.info, "time_origin": "boot"}
    return imus_on_one_clock(triads["accel"], triads["gyro"], name, head, contents.notes)


def _whole(path: Path, contents: _Contents, fields: dict[int, dict[str, _Field]]) -> dict[int, dict[str, Array]]:
    """Return the fields of all messages of some subscriptions, by subscription and field."""
    parts: dict[int, list[np.ndarray]] = {number: [] for number in fields}
    with open_file(path) as stream:
        for records in logs.walk_stream(stream, logs.ULOG, _HEADER, contents.limit, []):
            for number, needed in fields.items():
                indices = records.of(ord("D") | number << 8)
                parts[number].append(logs.gather(records.block, records.offsets[indices], _width(needed)))
    return {
        number: {key: logs.field(rows, f.offset, f.kind, f.count) for key, f in fields[number].items()}
        for number, rows in ((number, np.concatenate(every)) for number, every in parts.items())
    }


def _triads(title: str, instance: int, got: dict[str, Array], name: str) -> list[tuple[str, LoggedTriad]]:
    """Return the triads of an instance by sensor; an integral is a mean, at the middle of its interval."""
    stamp = next(iter(got.values())).astype(np.int64)
    what = f"{title} {instance}"
    for key in (key for key in got if key.endswith("device_id")):
        if (got[key] != got[key][0]).any():
            raise ReadError(f"{name}: {what} changes from one sensor to another, by its {key}; expected one sensor")
    if title != _INTEGRALS:
        values = np.column_stack([got[key].astype(np.float64) for key in "xyz"])
        device = int(got["device_id"][0]) if "device_id" in got else 0
        return [(title.removeprefix("sensor_"), LoggedTriad(what, stamp, values, device))]
    triads = []
    for sensor, key in (("accel", "delta_velocity"), ("gyro", "delta_angle")):
        interval = got[f"{key}_dt"].astype(np.int64)
        there = interval > 0
        values = got[key][there].astype(np.float64) / (interval[there, None] / 1e6)
        device = int(got[f"{sensor}_device_id"][0]) if f"{sensor}_device_id" in got else 0
        triads.append((sensor, LoggedTriad(what, stamp[there] - interval[there] // 2, values, device)))
    return triads
