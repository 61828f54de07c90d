"""MotionCal and Adafruit's sensor calibration: ``invW (raw - V)``, uT, invW symmetric; magnetometers only.

Source: MotionCal (P. Stoffregen), send_calibration: bytes 117 84, 16 floats, little-endian: six zeros, V, B, invW 00 11
22 01 02 12, and their CRC-16 (A001, from FFFF), low byte first. Adafruit_Sensor_Calibration keeps the same 68 bytes in
its EEPROM.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.magnetometer import symmetric
from imulab.exporters.model import one_unit, single_precision, write_one
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor

_NAMES = ("hardiron", "softiron")


def export(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``motioncal.txt``.

    Raises
    ------
    OptionError
        The record has no magnetometers, or ones that a symmetric matrix cannot correct.
    """
    unit = one_unit(records, "motioncal")
    if unit.mag is None:
        raise OptionError("motioncal: holds magnetometers only, and the record has none (imulab tumble mag)")
    mag, lost = symmetric(unit.mag, "motioncal", options, turned=False)
    matrix = mag.rotation.T @ mag.matrix
    matrix = (matrix + matrix.T) / 2
    offset, field = mag.in_unit("uT"), mag.magnitude * conversion_factor(mag.unit, "uT")
    comments = [
        "MotionCal and Adafruit_Sensor_Calibration, " + unit.origin[0],
        unit.origin[1],
        "corrected = invW (raw - V), uT: V is the hard iron, invW the soft iron (symmetric), B the field's magnitude",
        "no axes are turned: raw must be in the axes of the record's magnetometer outputs",
        *lost,
    ]
    lines = [f"# {line}" for line in comments]
    lines += [f"V    {_row(offset)}", f"B    {single_precision(field)}", *(f"invW {_row(row)}" for row in matrix)]
    lines += ["", "# in a sketch with Adafruit_Sensor_Calibration:"]
    for name, values in zip(_NAMES, (offset, matrix.ravel()), strict=True):
        lines += [f"cal.mag_{name}[{i}] = {single_precision(value)}f;" for i, value in enumerate(values)]
    lines += [f"cal.mag_field = {single_precision(field)}f;", ""]
    lines += ["# the bytes that MotionCal sends to a unit, and Adafruit_Sensor_Calibration keeps in its EEPROM:"]
    return write_one(folder, "motioncal.txt", [*lines, packet(matrix, offset, field).hex(" ")])


def _row(values: Array) -> str:
    return " ".join(single_precision(value) for value in values)


def packet(matrix: Array, offset: Array, field: float) -> bytes:
    """Return the 68 bytes for a symmetric matrix, shape (3, 3), hard iron (3,) and magnitude, uT."""
    numbers = [*np.zeros(6), *offset, field, *np.diag(matrix), matrix[0, 1], matrix[0, 2], matrix[1, 2]]
    data = bytes([117, 84]) + struct.pack("<16f", *numbers)
    checksum = 0xFFFF
    for byte in data:
        checksum ^= byte
        for _ in range(8):
            checksum = checksum >> 1 ^ (0xA001 if checksum & 1 else 0)
    return data + struct.pack("<H", checksum)
