"""Streams of binary messages: MAVLink 1 and 2, and MSP v1 and v2.

Frames are found here, so that after a cut frame the search goes on at its second byte and the next frame is not lost,
as it is in pymavlink's own parser; what a frame says, and whether its checksum is right, pymavlink decides.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from imulab.errors import OptionError
from imulab.live.lines import units_of
from imulab.live.stamps import Counts
from imulab.recording import Array

_V1, _V2 = 0xFE, 0xFD
_SIGNED, _SIGNATURE = 1, 13
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
"""Messages of MAVLink that are taken, the best first: unit of the stamp, columns, fields."""
MSP_RAW_IMU = 102
_POLL = b"$M<\x00" + bytes([MSP_RAW_IMU, MSP_RAW_IMU])


class PacketDecoder:
    """What both kinds of packets share: a buffer, and the search for the next frame after damage."""

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
        """Return the rows that were waiting for bytes of a frame that never came."""
        return self._table(ended=True)

    def _table(self, *, ended: bool) -> Array:
        rows, place, buffer = [], 0, self._buffer
        while place < len(buffer):
            length = self._length(buffer, place)
            if length is None and not ended:
                break  # not enough bytes to tell
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
        """Return the length of a frame that begins here, 0 where none does, None where that cannot be told yet."""
        raise NotImplementedError

    def _row(self, frame: bytes) -> list[float] | None:
        """Return the numbers of a frame, none of one that holds others; None where it is damaged."""
        raise NotImplementedError


class Mavlink(PacketDecoder):
    """One kind of message of one sender; the first sender and the best kind of the first seconds."""

    def __init__(self, head: bytes, counts: Counts) -> None:
        super().__init__(Counts())  # while looking for the kind nothing is counted
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
            return None  # of another dialect, or none: it has no checksum that is known
        if kind not in MESSAGES:
            return []
        self._seen.add(kind)
        sender = (message.get_srcSystem(), message.get_srcComponent())
        self._sender = self._sender or sender
        if kind != self._kind or sender != self._sender:
            return []
        return [float(getattr(message, field)) for field in self._fields]


class Msp(PacketDecoder):
    """MSP_RAW_IMU of Betaflight, INAV and their like, which is sent when it is asked for, in v1 or v2."""

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
    """Return whether two frames follow each other somewhere, by their first bytes and lengths."""
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
    """Return whether there is an answer of MSP with a right checksum."""
    decoder = Msp(Counts())
    return len(decoder.rows(head)) > 0


def _dialect() -> ModuleType:
    try:
        from pymavlink.dialects.v20 import ardupilotmega  # the common messages, and those of the most autopilots
    except ImportError:
        raise OptionError("MAVLink needs pymavlink, which is not here: pip install 'imulab[live]'") from None
    return ardupilotmega  # type: ignore[no-any-return]
