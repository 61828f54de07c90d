"""Decoders of live streams: lines of text (native titles, MotionCal, x-IMU3, layouts) and messages (MAVLink, MSP).

Lines are read one by one in Python: a stream has thousands of lines a second, where files have millions.

Frames of messages are found here, so that after a damaged frame the search goes on at its second byte and the next
frame is not lost, as it is in pymavlink's own parser; pymavlink reads the content of a frame and checks its checksum.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from imulab.columns import parse_column_title, triad
from imulab.errors import OptionError, ReadError, UnitError, install, quoted
from imulab.live.stamps import Counts
from imulab.readers.opened import fits
from imulab.recording import Array, Layout

# Lines of text.


Rows = list[list[float]]
_LONGEST = 1 << 14  # bytes: a longer line without an end is no text


def units_of(sensor: str, unit: str) -> dict[str, str]:
    """Return the columns of a sensor of three axes, with their unit."""
    return dict.fromkeys(triad(sensor), unit)


_EXTRA = {b"M": units_of("mag", "1"), b"T": {"temperature": "degC"}}
"""Messages of the x-IMU3 beside the inertial ones, with their columns."""


class LineDecoder:
    """Base of all streams of lines: it cuts bytes into lines, and counts those that cannot be read."""

    name = over = ""
    units: Mapping[str, str] = {}
    wraps: float | None = None
    """Where the column time begins again, in its unit, if a layout says so."""

    def __init__(self, counts: Counts) -> None:
        self.counts = counts
        self.metadata: dict[str, str] = {}
        self._rest = b""
        self._begun = False

    def rows(self, data: bytes) -> Array:
        """Return the rows that these bytes complete, shape (n, columns), up to a line that ends the stream."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST:
            self.counts.damaged += 1
            self._rest = b""
        rows: Rows = []
        for line in lines:
            line = line.strip()
            if self.over:
                break
            if not line:
                continue
            try:
                row = self._row(line)
            except (ValueError, KeyError, TypeError, IndexError):
                # A stream is often joined in the middle of a line, which is no damage.
                self.counts.damaged += self._begun
                row = None
            self._begun = True
            if row is not None and all(map(math.isfinite, row)):
                rows.append(row)
            elif row is not None:
                self.counts.damaged += 1
        return self._table(rows)

    def finish(self) -> Array:
        """Return no rows: a last line without an end may be cut."""
        return self._table([])

    def cut(self) -> None:
        """Forget a line whose end has not come; the next may begin in its middle, which is no damage."""
        self._rest, self._begun = b"", False

    def _table(self, rows: Rows) -> Array:
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(self.units))

    def _row(self, line: bytes) -> list[float] | None:
        """Return the numbers of a line, None if it has none; raise ValueError where it is damaged."""
        raise NotImplementedError


class Native(LineDecoder):
    """Rows below a line of titles ``name [unit]``, as in files; titles may be repeated, in another order too."""

    name = "titles with units"

    def __init__(self, titles: str, counts: Counts) -> None:
        super().__init__(counts)
        self.units = native_units(titles)
        self._titles = titles.encode()
        self._places: list[int] | None = None

    def _row(self, line: bytes) -> list[float] | None:
        if line == self._titles and self._places is None:
            self._places = list(range(len(self.units)))
            return None
        if b"[" in line and not line.startswith(b"#") and self._places is not None:
            self._read_titles(line.decode("utf-8", "replace"))
            return None
        if line.startswith(b"#"):
            key, colon, value = line[1:].decode("utf-8", "replace").partition(":")
            if colon:
                self.metadata[key.strip()] = value.strip()
            return None
        if self._places is None:
            return None
        fields = line.split(b",")
        if len(fields) != len(self.units):
            raise ValueError
        return [float(fields[place]) for place in self._places]

    def _read_titles(self, titles: str) -> None:
        """Read repeated titles; an incomplete line of them is damage."""
        words = titles.split(",")
        if len(words) < len(self.units) or not all(word.endswith("]") for word in words):
            raise ValueError
        units = native_units(titles) if is_titles(titles) else {}
        if units == self.units:
            self._places = [list(units).index(name) for name in self.units]
        else:
            self.over = (
                f"the stream's titles have changed from {quoted(self._titles.decode('utf-8', 'replace'))} to "
                f"{quoted(titles)}: expected the same columns and units to the end"
            )


class MotionCal(LineDecoder):
    """``Raw:`` and nine numbers in steps of its own, as MotionCal and Adafruit's sketches write them."""

    name = "MotionCal Raw:"
    units = units_of("accel", "g") | units_of("gyro", "deg/s") | units_of("mag", "uT")
    _SCALES = (8192.0,) * 3 + (16.0,) * 3 + (10.0,) * 3

    def _row(self, line: bytes) -> list[float] | None:
        if not line.startswith(b"Raw:"):
            if line[:4] in (b"Uni:", b"Cal1", b"Cal2"):
                return None
            raise ValueError
        numbers = [float(field) for field in line[4:].split(b",")]
        if len(numbers) != 9 or max(map(abs, numbers)) > 1 << 15:
            raise ValueError
        return [number / scale for number, scale in zip(numbers, self._SCALES, strict=True)]


class XImu3(LineDecoder):
    """ASCII messages of the x-IMU3: ``I`` inertial, with the latest ``M`` magnetometer and ``T`` temperature."""

    name = "x-IMU3 ASCII"

    def __init__(self, kinds: set[bytes], counts: Counts) -> None:
        super().__init__(counts)
        self.units = {"time": "us"} | units_of("gyro", "deg/s") | units_of("accel", "g")
        self._latest: dict[bytes, list[float]] = {}
        self._extra = [kind for kind in _EXTRA if kind in kinds]
        for kind in self._extra:
            self.units |= _EXTRA[kind]

    def _row(self, line: bytes) -> list[float] | None:
        kind, *fields = line.split(b",")
        numbers = [float(field) for field in fields]
        if kind == b"I" and len(numbers) == 7:
            if any(other not in self._latest for other in self._extra):
                return None  # at the beginning, before each sensor has sent a reading
            return numbers + [value for other in self._extra for value in self._latest[other]]
        if kind in self._extra and len(numbers) == 1 + len(_EXTRA[kind]):
            self._latest[kind] = numbers[1:]
        elif len(kind) != 1 or kind in b"IMT":
            raise ValueError
        return None


class LayoutDecoder(LineDecoder):
    """Delimited text or a JSON object a line, through a layout."""

    def __init__(self, layout: Layout, counts: Counts) -> None:
        super().__init__(counts)
        if any(column.date for column in layout.columns.values()):
            raise OptionError(f"{layout.name}: a live stream takes no dates; expected a time in s, ms or us")
        if layout.packet:
            raise OptionError(f"{layout.name}: a live stream takes no packets; expected a time of each row, or no time")
        if layout.named_numbers:
            raise OptionError(f"{layout.name}: a live stream has no head; expected scale and sample_rate as numbers")
        self.name = f"layout {layout.name}"
        self.units = {name: column.unit for name, column in layout.columns.items()}
        self._layout = layout
        time = layout.columns.get("time")
        self.wraps = abs(time.scale) * 2.0**time.bits if time is not None and time.bits else None
        if layout.sample_rate is not None:
            self.units = {"time": "s"} | self.units | {"time": "s"}
        self.metadata = dict(layout.metadata or {})
        self._count = 0
        self._places: list[int] | None = None
        origins = [column.origin for column in layout.columns.values()]
        self._titled = not all(isinstance(origin, int) for origin in origins)
        self._keys = [str(origin) for origin in origins]
        if not self._titled:
            self._places = [int(origin) for origin in origins]

    def _row(self, line: bytes) -> list[float] | None:
        text = line.decode(self._layout.encoding, "replace")
        if text.startswith("{"):
            document = json.loads(text)
            return [float(_look_up(document, key)) for key in self._keys]
        sign = self._layout.delimiter or next((sign for sign in ",;\t" if sign in text), " ")
        delimiter = None if sign == " " else sign
        behind = self._layout.behind_prefix([field.strip() for field in text.split(delimiter)])
        if behind is None:
            return None
        fields = behind
        if self._titled:
            titles = [field.strip('"') for field in fields]
            places = [[n for n, title in enumerate(titles) if fits(key, title)] for key in self._keys]
            if all(places):
                self._places = [numbers[0] for numbers in places]
                return None
        if self._places is None:
            return None
        if self._layout.decimal == ",":
            fields = [field.replace(",", ".") for field in fields]
        return [float(fields[place]) for place in self._places]

    def _table(self, rows: Rows) -> Array:
        layout = self._layout
        table = np.array(rows, dtype=np.float64).reshape(len(rows), len(layout.columns))
        named = dict(zip(layout.columns, table.T.copy(), strict=True))
        for name, column in layout.columns.items():
            column.convert(named[name])
        if layout.sample_rate is not None:
            numbers = named["time"] if "time" in named else self._count + np.arange(len(rows), dtype=np.float64)
            named["time"] = numbers / layout.sample_rate
            self._count += len(rows)
        return np.column_stack([named[name] for name in self.units])


def native_units(titles: str) -> dict[str, str]:
    """Return the columns of a native line of titles with their units.

    Raises
    ------
    ReadError, UnitError
        The line is no line of native titles.
    """
    pairs = [parse_column_title(title, "titles") for title in titles.split(",")]
    units = dict(pairs)
    if len(units) < len(pairs) or "[" not in titles or "accel_x" not in units:
        raise ReadError("titles: expected name [unit], each name once, accel_x among them")
    return units


def is_titles(line: str) -> bool:
    """Return whether a line is a line of native titles."""
    try:
        return bool(native_units(line))
    except (ReadError, UnitError):
        return False


def _look_up(document: Any, key: str) -> Any:
    if key in document:
        return document[key]
    for part in key.split("."):
        document = document[int(part) if isinstance(document, list) else part]
    return document


# Binary messages.


_V1, _V2 = 0xFE, 0xFD  # first bytes of frames of MAVLink 1 and 2
_SIGNED, _SIGNATURE = 1, 13  # flag and bytes of a signature in MAVLink 2
_RAW = [f"{axis}{sensor}" for sensor in ("acc", "gyro", "mag") for axis in "xyz"]
_SCALED = units_of("accel", "mg") | units_of("gyro", "mrad/s") | units_of("mag", "mgauss")
MESSAGES: dict[str, tuple[str, dict[str, str], list[str]]] = {
    "HIGHRES_IMU": (
        "us",
        units_of("accel", "m/s^2") | units_of("gyro", "rad/s") | units_of("mag", "gauss") | {"temperature": "degC"},
        ["time_usec", *_RAW, "temperature"],
    ),
    "SCALED_IMU": ("ms", _SCALED, ["time_boot_ms", *_RAW]),
    "SCALED_IMU2": ("ms", _SCALED, ["time_boot_ms", *_RAW]),
    "SCALED_IMU3": ("ms", _SCALED, ["time_boot_ms", *_RAW]),
    "RAW_IMU": (
        "us",
        units_of("accel", "count") | units_of("gyro", "count") | units_of("mag", "count"),
        ["time_usec", *_RAW],
    ),
}
"""Messages of MAVLink that are read, the best first: unit of the time stamp, columns, fields."""
MSP_RAW_IMU = 102  # number of that message of Betaflight and INAV
_POLL = b"$M<\x00" + bytes([MSP_RAW_IMU, MSP_RAW_IMU])


class PacketDecoder:
    """Base of both kinds of packets: a buffer, and the search for the next frame after damage."""

    name = over = ""
    units: Mapping[str, str] = {}

    def __init__(self, counts: Counts) -> None:
        self.counts = counts
        self.metadata: dict[str, str] = {}
        self._buffer = b""
        self._begun = False
        self._astray = False

    def rows(self, data: bytes) -> Array:
        """Return the rows that these bytes complete, shape (n, columns)."""
        self._buffer += data
        return self._table(ended=False)

    def finish(self) -> Array:
        """Return the rows that waited for the rest of a frame that never came."""
        return self._table(ended=True)

    def cut(self) -> None:
        """Forget a frame whose end has not come; the next may begin in its middle, which is no damage."""
        self._buffer, self._begun = b"", False

    def _table(self, *, ended: bool) -> Array:
        rows, place, buffer = [], 0, self._buffer
        while place < len(buffer):
            length = self._length(buffer, place)
            if length is None and not ended:
                break  # more bytes are needed
            frame = buffer[place : place + length] if length else b""
            if length and len(frame) < length and not ended:
                break
            row = self._row(frame) if length and len(frame) == length else None
            if row is None:
                self.counts.damaged += self._begun and not self._astray
                self._astray = True
                place += 1
                continue
            self._begun, self._astray = True, False
            rows += [row] if row else []
            place += length or 1
        self._buffer = buffer[place:]
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(self.units))

    def _length(self, buffer: bytes, place: int) -> int | None:
        """Return the length of a frame that begins here, 0 if none does, None if more bytes are needed."""
        raise NotImplementedError

    def _row(self, frame: bytes) -> list[float] | None:
        """Return the numbers of a frame, an empty list for other messages, None where it is damaged."""
        raise NotImplementedError


class Mavlink(PacketDecoder):
    """One kind of message of one sender: the first sender, and the best kind of the first seconds."""

    def __init__(self, head: bytes, counts: Counts) -> None:
        super().__init__(Counts())  # nothing is counted during the choice of the kind
        self._dialect = _dialect()
        self._parser = self._dialect.MAVLink(None)
        self._sender: tuple[int, int] | None = None
        self._kind = ""
        self._seen: set[str] = set()
        self.units = {}
        self.rows(head)
        self.kinds = [kind for kind in MESSAGES if kind in self._seen]
        self._kind = self.kinds[0] if self.kinds else ""
        self.name = f"MAVLink {self._kind}"
        unit, columns, self._fields = MESSAGES.get(self._kind, ("s", {}, []))
        self.units = {"time": unit} | columns
        self.counts, self._buffer, self._begun, self._astray = counts, b"", False, False

    def _length(self, buffer: bytes, place: int) -> int | None:
        magic = buffer[place]
        if magic not in (_V1, _V2):
            return 0
        if len(buffer) < place + 3:
            return None
        size = buffer[place + 1]
        if magic == _V1:
            return size + 8
        return size + 12 + _SIGNATURE * (buffer[place + 2] & _SIGNED)

    def _row(self, frame: bytes) -> list[float] | None:
        try:
            message: Any = self._parser.decode(bytearray(frame))
        except (self._dialect.MAVError, struct.error):
            return None
        kind = message.get_type()
        if kind.startswith("UNKNOWN"):
            return None  # of another dialect, or no frame: its checksum is unknown
        if kind not in MESSAGES:
            return []
        self._seen.add(kind)
        sender = (message.get_srcSystem(), message.get_srcComponent())
        self._sender = self._sender or sender
        if kind != self._kind or sender != self._sender:
            return []
        return [float(getattr(message, field)) for field in self._fields]


class Msp(PacketDecoder):
    """MSP_RAW_IMU of Betaflight, INAV and similar firmware, v1 or v2, which is sent on request."""

    name = "MSP RAW_IMU"
    units = units_of("accel", "count") | units_of("gyro", "count") | units_of("mag", "count")
    poll = _POLL

    def _length(self, buffer: bytes, place: int) -> int | None:
        head = buffer[place : place + 8]
        for kind, size in ((b"$M>", 4), (b"$X>", 8)):
            if len(head) < size and head[:3] == kind[: len(head)]:
                return None
            if head[:3] == kind:
                return head[3] + 6 if size == 4 else struct.unpack("<H", head[6:8])[0] + 9
        return 0

    def _row(self, frame: bytes) -> list[float] | None:
        if frame[1:2] == b"M":
            command, payload = frame[4], frame[5:-1]
            check = 0
            for byte in frame[3:-1]:
                check ^= byte
        else:
            (command,) = struct.unpack("<H", frame[4:6])
            payload, check = frame[8:-1], crc8(frame[3:-1])
        if check != frame[-1]:
            return None
        if command != MSP_RAW_IMU or len(payload) != 18:
            return []
        return [float(value) for value in struct.unpack("<9h", payload)]


def crc8(data: bytes) -> int:
    """Return the checksum of MSP v2: CRC-8 with the polynomial 0xD5 (DVB-S2)."""
    check = 0
    for byte in data:
        check ^= byte
        for _ in range(8):
            check = (check << 1 ^ 0xD5 if check & 0x80 else check << 1) & 0xFF
    return check


def looks_like_mavlink(head: bytes) -> bool:
    """Return whether two MAVLink frames follow each other somewhere, by their first bytes and lengths."""
    for magic, more in ((_V1, 8), (_V2, 12)):
        place = head.find(magic)
        while 0 <= place < len(head) - 1:
            after = place + head[place + 1] + more
            if after < len(head) - 1 and head[after] == magic:
                last = after + head[after + 1] + more
                if last <= len(head) and (last == len(head) or head[last] == magic):
                    return True
            place = head.find(magic, place + 1)
    return False


def looks_like_msp(head: bytes) -> bool:
    """Return whether there is an MSP answer with a correct checksum."""
    decoder = Msp(Counts())
    return len(decoder.rows(head)) > 0


def _dialect() -> ModuleType:
    try:
        from pymavlink.dialects.v20 import ardupilotmega  # the common messages, and those of the most autopilots
    except ImportError:
        raise OptionError(f"MAVLink needs pymavlink, which is not here: {install('live')}") from None
    return ardupilotmega  # type: ignore[no-any-return]
