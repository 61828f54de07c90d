"""Streams as devices send them, written apart from what decodes them; and pseudo-terminals in the place of ports."""

from __future__ import annotations

import os
import struct
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

COUNT = 400


def drawn() -> np.random.Generator:
    """Return a generator begun anew, so that no stream depends on which tests ran before.

    A checksum of 8 bits lets one damaged frame in 256 pass: which one, must not change from run to run.
    """
    return np.random.default_rng(20)


def integers(count: int = COUNT, low: int = -8000, high: int = 8000) -> np.ndarray:
    return drawn().integers(low, high, (count, 9))


def native(count: int = COUNT) -> tuple[list[bytes], dict[str, np.ndarray]]:
    """Titles, then rows as a sketch prints them."""
    values = drawn().normal(0, 1, (count, 6)).round(4)
    stamps = 5000 * np.arange(count) + 7
    names = [f"{stem}_{axis}" for stem in ("accel", "gyro") for axis in "xyz"]
    head = "time [us]," + ",".join(f"{name} [{'g' if name[0] == 'a' else 'deg/s'}]" for name in names)
    lines = [f"{t}," + ",".join(f"{v:.4f}" for v in row) + "\r\n" for t, row in zip(stamps, values, strict=True)]
    columns = {"time": stamps.astype(float)} | dict(zip(names, values.T, strict=True))
    return [f"{head}\r\n".encode(), *(line.encode() for line in lines)], columns


def motioncal(count: int = COUNT) -> tuple[list[bytes], dict[str, np.ndarray]]:
    values = integers(count)
    scale = [1 / 8192] * 3 + [1 / 16] * 3 + [0.1] * 3
    names = [f"{stem}_{axis}" for stem in ("accel", "gyro", "mag") for axis in "xyz"]
    lines = [("Raw:" + ",".join(map(str, row)) + "\r\n").encode() for row in values.tolist()]
    return lines, {name: values[:, k] * scale[k] for k, name in enumerate(names)}


def ximu3(count: int = COUNT) -> tuple[list[bytes], dict[str, np.ndarray]]:
    """Inertial messages, with a magnetometer and a temperature now and then."""
    values = drawn().normal(0, 1, (count, 6)).round(4)
    stamps = 2500 * np.arange(count) + 1_000_000
    lines = [b"M,999000,0.5,-0.25,1.0\r\n", b"T,999500,24.5\r\n"]
    for index, (t, row) in enumerate(zip(stamps.tolist(), values.tolist(), strict=True)):
        lines.append((f"I,{t}," + ",".join(f"{v:.4f}" for v in row) + "\r\n").encode())
        if index % 50 == 49:
            lines.append(f"T,{t + 10},{25 + index / 100:.2f}\r\n".encode())
    names = [f"{stem}_{axis}" for stem in ("gyro", "accel") for axis in "xyz"]
    return lines, {"time": stamps.astype(float)} | dict(zip(names, values.T, strict=True))


def crc16(data: bytes) -> int:
    """CRC-16/MCRF4XX, transcribed from the MAVLink guide."""
    crc = 0xFFFF
    for byte in data:
        tmp = (byte ^ crc) & 0xFF
        tmp = (tmp ^ tmp << 4) & 0xFF
        crc = (crc >> 8 ^ tmp << 8 ^ tmp << 3 ^ tmp >> 4) & 0xFFFF
    return crc


def mavlink_frame(message: int, extra: int, payload: bytes, version: int, sequence: int) -> bytes:
    """A frame by the MAVLink guide: header, payload (version 2 drops zeros at its end), checksum with CRC_EXTRA."""
    if version == 1:
        body = bytes([len(payload), sequence & 255, 1, 1, message]) + payload
        magic = b"\xfe"
    else:
        payload = payload.rstrip(b"\0") or b"\0"
        body = bytes([len(payload), 0, 0, sequence & 255, 1, 1]) + message.to_bytes(3, "little") + payload
        magic = b"\xfd"
    return magic + body + struct.pack("<H", crc16(body + bytes([extra])))


HEARTBEAT = (0, 50, struct.pack("<IBBBBB", 0, 2, 3, 81, 3, 3))


def mavlink(kind: str, version: int, count: int = COUNT) -> tuple[list[bytes], dict[str, np.ndarray]]:
    """Frames of one kind with heartbeats between; numbers and CRC_EXTRA from message definitions (common.xml)."""
    names = [f"{stem}_{axis}" for stem in ("accel", "gyro", "mag") for axis in "xyz"]
    stamps = np.arange(count) * 10 + 5
    if kind == "HIGHRES_IMU":
        values = drawn().normal(0, 1, (count, 9)).astype(np.float32)
        payloads = [
            struct.pack("<Q13fH", int(t), *row.tolist(), 1013.0, 0.0, 0.0, 31.5, 0xFFFF)
            for t, row in zip(stamps, values, strict=True)
        ]
        number, extra = 105, 93
    else:
        values = integers(count)
        form, number, extra = {
            "RAW_IMU": ("<Q9h", 27, 144),
            "SCALED_IMU": ("<I9h", 26, 170),
            "SCALED_IMU2": ("<I9h", 116, 76),
            "SCALED_IMU3": ("<I9h", 129, 46),
        }[kind]
        payloads = [struct.pack(form, int(t), *row) for t, row in zip(stamps, values.tolist(), strict=True)]
    frames = []
    for index, payload in enumerate(payloads):
        if index % 40 == 0:
            frames.append(mavlink_frame(HEARTBEAT[0], HEARTBEAT[1], HEARTBEAT[2], version, index))
        frames.append(mavlink_frame(number, extra, payload, version, index))
    columns = {name: values[:, k].astype(float) for k, name in enumerate(names)}
    return frames, {"time": stamps.astype(float)} | columns


def crc8_dvb_s2(data: bytes) -> int:
    """Bit by bit, as polynomial division by x^8 + x^7 + x^6 + x^4 + x^2 + 1."""
    remainder = int.from_bytes(data, "big") << 8
    for place in range(len(data) * 8 - 1, -1, -1):
        if remainder >> (place + 8) & 1:
            remainder ^= 0x1D5 << place
    return remainder


def msp(version: int, count: int = COUNT) -> tuple[list[bytes], dict[str, np.ndarray]]:
    values = integers(count)
    frames = []
    for row in values.tolist():
        payload = struct.pack("<9h", *row)
        if version == 1:
            body = bytes([18, 102]) + payload
            check = 0
            for byte in body:
                check ^= byte
            frames.append(b"$M>" + body + bytes([check]))
        else:
            body = struct.pack("<BHH", 0, 102, 18) + payload
            frames.append(b"$X>" + body + bytes([crc8_dvb_s2(body)]))
    names = [f"{stem}_{axis}" for stem in ("accel", "gyro", "mag") for axis in "xyz"]
    return frames, {name: values[:, k].astype(float) for k, name in enumerate(names)}


@contextmanager
def terminal() -> Iterator[tuple[int, str]]:
    """A pseudo-terminal: the device's end, and the name of the port."""
    device, port = os.openpty()
    tty.setraw(port)
    try:
        yield device, os.ttyname(port)
    finally:
        for each in (device, port):
            with suppress(OSError):  # a test has unplugged it
                os.close(each)


def wait_for(what: Callable[[], bool], seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while not what():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True
