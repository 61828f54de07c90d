"""ArduPilot DataFlash (.bin): IMU, or ACC and GYR, and MAG.

Source: ArduPilot AP_Logger (LogStructure.h): messages A3 95, u8 type, payload; messages of type 128 (FMT) give each
type's length, name, field types and field names. Time is ``TimeUS`` (``TimeMS`` in old logs), since boot.
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

MAGIC = b"\xa3\x95\x80"
_FMT = 128  # message that describes the layout of the others
_KINDS = {
    "a": ("<i2", 32, 1.0),
    "b": ("i1", 1, 1.0),
    "B": ("u1", 1, 1.0),
    "h": ("<i2", 1, 1.0),
    "H": ("<u2", 1, 1.0),
    "i": ("<i4", 1, 1.0),
    "I": ("<u4", 1, 1.0),
    "f": ("<f4", 1, 1.0),
    "d": ("<f8", 1, 1.0),
    "g": ("<f2", 1, 1.0),
    "n": ("S4", 1, 1.0),
    "N": ("S16", 1, 1.0),
    "Z": ("S64", 1, 1.0),
    "c": ("<i2", 1, 0.01),
    "C": ("<u2", 1, 0.01),
    "e": ("<i4", 1, 0.01),
    "E": ("<u4", 1, 0.01),
    "L": ("<i4", 1, 1e-7),
    "M": ("u1", 1, 1.0),
    "q": ("<i8", 1, 1.0),
    "Q": ("<u8", 1, 1.0),
}
_ACCEL = dict.fromkeys(triad("accel"), "m/s^2")
_GYRO = dict.fromkeys(triad("gyro"), "rad/s")
_FIELDS = {
    "IMU": ("AccX", "AccY", "AccZ", "GyrX", "GyrY", "GyrZ"),
    "ACC": ("AccX", "AccY", "AccZ"),
    "GYR": ("GyrX", "GyrY", "GyrZ"),
    "MAG": ("MagX", "MagY", "MagZ"),
}
_MAG = dict.fromkeys(triad("mag"), "mgauss")
_WHOLE = ("I", "TimeUS", "TimeMS", "SampleUS")  # fields that hold whole numbers
_NAME = re.compile(
    r"(IMU|ACC|GYR|MAG)([1-9]?)"
)  # before ArduPilot 4.1 each instance had its own message: IMU, IMU2, ACC1 ...


@dataclass(frozen=True, slots=True)
class _Field:
    offset: int
    kind: str
    factor: float


@dataclass(frozen=True, slots=True)
class _Format:
    """A message type: its name, its fields, and the length of its payload."""

    name: str
    fields: dict[str, _Field]
    length: int
    sensor: str | None
    instance: int | None  # None: field I holds it

    def rows(self, records: logs.Records, kind: int, file: str) -> np.ndarray:
        """Return the payloads of the messages of this type, shape (n, length)."""
        indices = records.of(kind)
        if not (records.sizes[indices] == self.length).all():
            raise ReadError(f"{file}: the format of message {self.name} changes within the file")
        return logs.gather(records.block, records.offsets[indices], self.length)

    def column(self, rows: np.ndarray, key: str) -> Array:
        f = self.fields[key]
        values = logs.field(rows, f.offset, f.kind).astype(np.float64)
        return values if f.factor == 1.0 else values * f.factor

    def ticks(self, rows: np.ndarray, *, sampled: bool = False) -> np.ndarray:
        """Return the time since boot, microseconds, of the message, or of its sample where the log tells that."""
        key = "TimeUS" if "TimeUS" in self.fields else "TimeMS"
        key = "SampleUS" if sampled and "SampleUS" in self.fields else key
        stamps = logs.field(rows, self.fields[key].offset, self.fields[key].kind).astype(np.int64)
        return stamps * 1000 if key == "TimeMS" else stamps


@dataclass(slots=True)
class _Contents:
    """Result of a first pass over the file: formats, and numbers of messages of each type and instance."""

    formats: dict[int, _Format] = field(default_factory=dict)
    counts: dict[tuple[int, int], int] = field(default_factory=dict)
    other: set[str] = field(default_factory=set)
    version: str = ""
    notes: list[str] = field(default_factory=list)


def blocks(path: Path, name: str, selection: Selection) -> Iterator[Recording]:
    """Yield the samples of one accelerometer and gyroscope, and of a magnetometer.

    Raises
    ------
    ReadError
        The file is no DataFlash log, is damaged, or has no such message or instance.
    OptionError
        An unknown message name.
    """
    contents = _survey(path, name)
    if selection.instance == EVERY:
        yield _every_imu(path, contents, selection, name)
        return
    streams, sources = _choose(contents, selection, name)
    metadata = {"autopilot": contents.version or "ArduPilot", "time_origin": "boot"}
    yield from side_by_side(
        streams,
        _pieces(path, contents, sources, name),
        name=name,
        per_second=1_000_000,
        origin=0,
        metadata=lambda _: metadata,
        notes=(
            *contents.notes,
            Finding(
                "ArduPilot logs outputs that it has already corrected by its INS_ parameters",
                "set the INS_ offsets to 0 and scales to 1, and record again",
            ),
        ),
    )


# --- contents ----------------------------------------------------------------------------------------------------


def _survey(path: Path, name: str) -> _Contents:
    contents = _Contents()
    ending: list[logs.Ending] = []
    with open_file(path) as stream:
        for records in logs.walk_stream(stream, logs.DATAFLASH, 0, path.stat().st_size, ending):
            for index in records.of(_FMT).tolist():
                _define(contents, records.payload(index), name)
            for kind in np.unique(records.keys).tolist():
                form = contents.formats.get(kind)
                if form is None:
                    continue
                if form.name == "MSG" and not contents.version and "Message" in form.fields:
                    _version(contents, form, records, kind)
                if form.sensor is None:
                    contents.other.add(form.name)
                    continue
                rows = form.rows(records, kind, name)
                instances = form.column(rows, "I") if form.instance is None else np.full(len(rows), form.instance)
                for instance, count in zip(*np.unique(instances, return_counts=True), strict=True):
                    place = (kind, int(instance))
                    contents.counts[place] = contents.counts.get(place, 0) + int(count)
    (end,) = ending
    # Cards and flash chips are filled with 00 or FF after the end of a log.
    filled = end.left and _is_fill(path, end.position)
    if end.damaged and not filled:
        shown = end.left[:3].hex(" ")
        raise ReadError(f"{name}: damaged at byte {end.position}: expected a message (a3 95 ..), found {shown}")
    if end.left:
        what = "filling behind" if filled else "the last message, cut,"
        contents.notes.append(
            Finding(
                f"truncated: {what} at byte {end.position}; read up to there",
                "check that the part read is the whole test, or take the log off again",
            )
        )
    return contents


def _is_fill(path: Path, position: int) -> bool:
    with open_file(path) as stream:
        stream.seek(position)
        first = stream.read(1)
        if first not in (b"\x00", b"\xff"):
            return False
        while data := stream.read(1 << 20):
            if data.strip(first):
                return False
    return True


def _define(contents: _Contents, payload: bytes, name: str) -> None:
    """Add a format message: u8 type, u8 length, char[4] name, char[16] types, char[64] field names."""
    kind, length = payload[0], payload[1]
    title = payload[2:6].rstrip(b"\0").decode("ascii", "replace")
    types = payload[6:22].rstrip(b"\0").decode("ascii", "replace")
    names = payload[22:86].rstrip(b"\0").decode("ascii", "replace").split(",")
    if kind == _FMT:
        return
    fields: dict[str, _Field] = {}
    kinds = {key.strip(): code for code, key in zip(types, names, strict=False)}
    offset = 0
    for code, key in zip(types, names, strict=False):
        if code not in _KINDS:
            break
        dtype, count, factor = _KINDS[code]
        fields[key.strip()] = _Field(offset, dtype, factor)
        offset += np.dtype(dtype).itemsize * count
    match = _NAME.fullmatch(title)
    sensor = match[1] if match else None
    instance = None
    if match and sensor:
        wanted = _FIELDS[sensor]
        instance = None if "I" in fields else int(match[2] or 1) - 1
        missing = [key for key in wanted if key not in fields]
        lacks = missing[0] if missing else "" if {"TimeUS", "TimeMS"} & set(fields) else "TimeUS"
        read = [key for key in (*wanted, *_WHOLE, "Health") if key in fields]
        odd = next(
            (key for key in read if np.dtype(fields[key].kind).kind not in ("iu" if key in _WHOLE else "iuf")), ""
        )
        if sensor == "MAG" and (lacks or odd or offset > length - 3):
            sensor = None  # the rest of the log can be read without it
        elif lacks:
            raise ReadError(f"{name}: message {title} has no field {lacks}; found {' '.join(fields) or 'none'}")
        elif odd:
            number = "a whole number" if odd in _WHOLE else "a number"
            raise ReadError(f"{name}: message {title}: expected {number} in field {odd}, found type {kinds[odd]!r}")
        elif offset > length - 3:
            raise ReadError(f"{name}: message {title}: fields of {offset} bytes in {length - 3}")
    if sensor is None and offset > length - 3:
        fields = {}
    contents.formats[kind] = _Format(title, fields, max(length - 3, 0), sensor, instance)


def _version(contents: _Contents, form: _Format, records: logs.Records, kind: int) -> None:
    for index in records.of(kind)[:20].tolist():
        text = records.payload(index)[form.fields["Message"].offset :].rstrip(b"\0").decode("utf-8", "replace")
        if text.startswith("Ardu"):
            contents.version = " ".join(text.split())
            return


def _choose(
    contents: _Contents, selection: Selection, name: str
) -> tuple[list[LoggedStream], dict[int, list[tuple[int, int | None, tuple[str, ...]]]]]:
    """Return the streams, and for each message type its stream, instance and fields."""
    wanted, magnetometer = selection.beside("MAG")
    if wanted not in (None, "IMU", "ACC", "GYR"):
        raise OptionError(f"{name}: topic {wanted!r}; of a DataFlash log these can be read: IMU ACC GYR MAG:N")
    every: dict[tuple[str, int], tuple[int, int | None]] = {}
    for kind, instance in contents.counts:
        form = contents.formats[kind]
        every[str(form.sensor), instance] = (kind, instance if form.instance is None else None)
    there = {place: source for place, source in every.items() if place[0] != "MAG"}
    titles = {title for title, _ in there}
    if not titles:
        known = " ".join(sorted(contents.other | {title for title, _ in every})) or "none"
        raise ReadError(f"{name}: no IMU, ACC or GYR messages; messages found: {known}")
    instance = selection.single
    topic = wanted or ("IMU" if "IMU" in titles else "ACC" if "ACC" in titles else "GYR")
    samples = {title: contents.counts[there[title, instance][0], instance] for title, n in there if n == instance}
    if not wanted and samples.get("ACC", 0) > logs.PLAINLY_MORE * samples.get("IMU", np.inf):
        gyros = samples.get("GYR", 0)
        if samples["IMU"] > logs.PLAINLY_MORE * gyros:
            contents.notes.append(
                Finding(
                    f"ACC, which has {samples['ACC']} samples, is not read but {samples['IMU']} of IMU: of GYR there "
                    f"are {gyros}; a topic chooses",
                    "choose the messages (--topic)",
                )
            )
        else:
            topic = "ACC"
            contents.notes.append(
                Finding(
                    f"ACC, which has {samples['ACC']} samples, is read rather than {samples['IMU']} of IMU; a topic "
                    "chooses",
                    "choose the messages (--topic)",
                )
            )
    if (topic, instance) not in there:
        known = ", ".join(f"{title} {number}" for title, number in sorted(there))
        raise OptionError(f"{name}: no {topic} of instance {instance}; found {known}")
    several = sum(title == topic for title, _ in there)
    if several > 1:
        contents.notes.append(Note(f"instance {instance} of {several} of {topic}"))
    streams, sources = _inertial(contents, there, topic, instance)
    _add_magnetometer(contents, every, (magnetometer, instance), streams, sources, name)
    return streams, sources


def _inertial(
    contents: _Contents, there: dict[tuple[str, int], tuple[int, int | None]], topic: str, instance: int
) -> tuple[list[LoggedStream], dict[int, list[tuple[int, int | None, tuple[str, ...]]]]]:
    sources: dict[int, list[tuple[int, int | None, tuple[str, ...]]]] = {}
    kind, number = there[topic, instance]
    form = contents.formats[kind]
    if topic == "GYR":
        sources[kind] = [(0, number, _FIELDS["GYR"])]
        return [LoggedStream("gyroscope", _GYRO)], sources
    if topic == "IMU":
        # "Temp" in old logs
        warm = tuple(key for key in ("T", "Temp") if key in form.fields and form.fields[key].kind[0] != "S")[:1]
        sources[kind] = [(0, number, (*_FIELDS["IMU"], *warm))]
        units = {**_ACCEL, **_GYRO, **({"temperature": "degC"} if warm else {})}
        return [LoggedStream("accelerometer", units)], sources
    sources[kind] = [(0, number, _FIELDS["ACC"])]
    streams = [LoggedStream("accelerometer", _ACCEL)]
    if ("GYR", instance) in there:
        kind, number = there["GYR", instance]
        sources[kind] = [(1, number, _FIELDS["GYR"])]
        streams.append(LoggedStream("gyroscope", _GYRO))
    return streams, sources


def _add_magnetometer(
    contents: _Contents,
    every: dict[tuple[str, int], tuple[int, int | None]],
    wanted: tuple[int | None, int],
    streams: list[LoggedStream],
    sources: dict[int, list[tuple[int, int | None, tuple[str, ...]]]],
    name: str,
) -> None:
    """Add the wanted magnetometer, or that of the same instance as the rest, or the first one."""
    asked, instance = wanted
    places = sorted(place for title, place in every if title == "MAG")
    if asked is not None and asked not in places:
        raise OptionError(
            f"{name}: no MAG of instance {asked}; instances found: {' '.join(map(str, places)) or 'none'}"
        )
    if not places:
        return
    place = asked if asked is not None else instance if instance in places else places[0]
    if len(places) > 1:
        others = ", ".join(f"MAG:{other}" for other in places if other != place)
        contents.notes.append(Note(f"instance {place} of {len(places)} of MAG; a topic chooses: {others}"))
    kind, number = every["MAG", place]
    healthy = tuple(key for key in ("Health",) if key in contents.formats[kind].fields)
    sources[kind] = [(len(streams), number, (*_FIELDS["MAG"], *healthy))]
    streams.append(LoggedStream("magnetometer", _MAG, placed=True))
    contents.notes.append(Note("MAG holds fields that ArduPilot has already corrected by its COMPASS_ parameters"))


# --- samples -----------------------------------------------------------------------------------------------------


def _pieces(
    path: Path, contents: _Contents, sources: dict[int, list[tuple[int, int | None, tuple[str, ...]]]], name: str
) -> Iterator[Piece]:
    with open_file(path) as stream:
        for records in logs.walk_stream(stream, logs.DATAFLASH, 0, path.stat().st_size, []):
            for kind, parts in sources.items():
                form = contents.formats[kind]
                rows = form.rows(records, kind, name)
                for slot, instance, keys in parts:
                    mine = rows if instance is None else rows[form.column(rows, "I") == instance]
                    values = np.column_stack([form.column(mine, key) for key in keys])
                    if form.sensor == "MAG" and "Health" in keys:
                        # A compass that does not answer repeats its last field.
                        mine, values = mine[values[:, 3] != 0], values[values[:, 3] != 0, :3]
                    if len(mine):
                        yield Piece(slot, form.ticks(mine), values)


# --- all IMUs ----------------------------------------------------------------------------------------------------


def _every_imu(path: Path, contents: _Contents, selection: Selection, name: str) -> Recording:
    """Return all IMUs on one clock: of ACC and GYR, or of IMU where that has more samples."""
    topic, _ = selection.beside("MAG")
    if topic not in (None, "IMU", "ACC", "GYR"):
        raise OptionError(f"{name}: topic {topic!r}; all IMUs of a DataFlash log are in IMU, or in ACC and GYR")
    counts: dict[str, list[int]] = {"IMU": [], "ACC": [], "GYR": []}
    for (kind, _), count in contents.counts.items():
        counts.get(str(contents.formats[kind].sensor), []).append(count)
    second = {title: (sorted(each, reverse=True)[1:2] or [0])[0] for title, each in counts.items()}
    raw = min(second["ACC"], second["GYR"]) >= max(second["IMU"], 1) if topic is None else topic != "IMU"
    titles = ("ACC", "GYR") if raw else ("IMU",)
    pieces: dict[tuple[str, int], list[tuple[np.ndarray, Array]]] = {}
    with open_file(path) as stream:
        for records in logs.walk_stream(stream, logs.DATAFLASH, 0, path.stat().st_size, []):
            for kind, instance in (place for place in contents.counts if contents.formats[place[0]].sensor in titles):
                form = contents.formats[kind]
                rows = form.rows(records, kind, name)
                mine = rows if form.instance is not None else rows[form.column(rows, "I") == instance]
                values = np.column_stack([form.column(mine, key) for key in _FIELDS[str(form.sensor)]])
                pieces.setdefault((str(form.sensor), instance), []).append((form.ticks(mine, sampled=True), values))
    triads: dict[str, list[LoggedTriad]] = {"ACC": [], "GYR": []}
    for (title, instance), parts in sorted(pieces.items()):
        ticks, values = (np.concatenate(each) for each in zip(*parts, strict=True))
        for sensor, place in (("ACC", slice(0, 3)), ("GYR", slice(3, 6))) if title == "IMU" else ((title, slice(3)),):
            triads[sensor].append(LoggedTriad(f"{title} {instance}", ticks, values[:, place]))
    head = {"autopilot": contents.version or "ArduPilot", "time_origin": "boot"}
    corrected = Note("ArduPilot logs outputs that it has already corrected by its INS_ parameters")
    return imus_on_one_clock(triads["ACC"], triads["GYR"], name, head, [*contents.notes, corrected])
