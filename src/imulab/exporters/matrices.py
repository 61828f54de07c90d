"""Records to programs that take a matrix and an offset of each triad.

X-io Fusion, imu_calib and magnetometer_pipeline of ROS, MotionCal.

``m = W (M - h)``, outputs M in a unit of field. The polar forms of W are ``W = P Q = Q R``: P and R symmetric, Q a
rotation. A program that turns outputs by Q first takes P and ``Q h``, one that turns them last takes R and h; one that
turns nothing takes R and h, and is off by the angle of Q.

Source: Fusion (S. Madgwick), FusionCalibration.h of 1.2, FusionModel.h from 1.3 on: the same formulas, g and deg/s.
Before 1.2 FusionCalibrationMagnetic was ``softIronMatrix raw - hardIronOffset``.

Source: imu_calib (D. Koch), accel_calib.cpp: ``SM`` holds 9 numbers row by row, ``bias`` 3, subtracted after scaling.
magnetometer_pipeline (M. Pecka), bias_remover.cpp: ``initial_mag_bias_x``, ``_y``, ``_z`` and
``initial_mag_scaling_matrix``, 9 numbers row by row.

Source: MotionCal (P. Stoffregen), send_calibration: bytes 117 84, 16 floats, little-endian: six zeros, V, B, invW 00 11
22 01 02 12, and their CRC-16 (A001, from FFFF), low byte first. Adafruit_Sensor_Calibration keeps the same 68 bytes in
its EEPROM.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.model import (
    AXES,
    ROTATION_NOT_TOLD,
    accel_terms,
    gyro_terms,
    held_accelerometers,
    inverse_gain,
    magnetometers_alone,
    one_unit,
    origin_of,
    settle_losses,
    single_precision,
    write_one,
    yaml_number,
)
from imulab.exporters.texts import c_comment, hash_comments
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import Accelerometers, Gyroscopes, Magnetometers
from imulab.units import conversion_factor, parse_unit

# Magnetometers for programs that hold a symmetric matrix, with or without a rotation beside it.


_NEGLIGIBLE = np.radians(0.01)
_NEGLIGIBLE_QUADRATIC = 1e-4  # of the field: smaller quadratic terms are left out without a comment


@dataclass(frozen=True)
class FieldCorrection:
    """``m = W (M - h)`` in the unit of the outputs: W, shape (3, 3), keeps the field's magnitude; h, shape (3,).

    `unit` is that of the outputs; `magnitude` the field's in it; `quadratic` is the largest quadratic term, as a part
    of the field.
    """

    matrix: Array
    hard_iron: Array
    unit: str
    magnitude: float
    quadratic: float

    @property
    def rotation(self) -> Array:
        """Q, shape (3, 3)."""
        left, _, right = np.linalg.svd(self.matrix)
        q: Array = left @ right
        return q

    @property
    def angle(self) -> float:
        """Angle of Q, rad."""
        return float(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1.0, 1.0)))

    def in_unit(self, symbol: str) -> Array:
        """Return the hard iron in a unit of field."""
        return self.hard_iron * parse_unit(self.unit).factor / parse_unit(symbol).factor


def largest_quadratic(mag: Magnetometers) -> float:
    """Return the largest quadratic term, as a part of the field."""
    return float(np.abs(mag.quadratic).max()) * (1.0 if mag.field is None else mag.field)


def in_field(mag: Magnetometers) -> bool:
    """Return whether the outputs are in a unit of field."""
    return parse_unit(mag.unit).quantity == "magnetic field"


def field_correction(mag: Magnetometers, target: str) -> FieldCorrection:
    """Return the correction of a unit's magnetometers in the unit of their outputs.

    Where the field's magnitude was not stated, the mean sensitivity of the outputs is taken as right.

    Raises
    ------
    OptionError
        Their outputs are no field.
    """
    if not in_field(mag):
        raise OptionError(
            f"{target}: corrects magnetometers in units of field, but the record has outputs in {mag.unit}"
        )
    matrix = mag.soft_iron
    if mag.field is not None:
        scale = 1 / parse_unit(mag.unit).factor
        magnitude = mag.field * scale
    else:
        magnitude = scale = 1 / float(np.cbrt(abs(np.linalg.det(matrix))))
    return FieldCorrection(scale * matrix, mag.hard_iron, mag.unit, magnitude, largest_quadratic(mag))


def quadratic_loss(part: float) -> list[str]:
    """Return the words for quadratic terms that a target leaves out, if they matter; `part` is the largest."""
    return [f"mag_k2, {100 * part:.2g} % of the field"] if part > _NEGLIGIBLE_QUADRATIC else []


def settle_magnetometers(lost: list[str], target: str, options: ExportOptions) -> list[str]:
    """Refuse losses of the magnetometers, or return and report the comments on them.

    Raises
    ------
    OptionError
        Something that matters would be lost, and that was not asked for.
    """
    if not lost:
        return []
    if not options.lossy:
        raise OptionError(f"{target} cannot hold {' and '.join(lost)}; add --lossy to leave it out")
    comment = f"left out (lossy): {' and '.join(lost)}"
    options.tell(f"{target}: {comment}")
    return [comment]


def symmetric(
    magnetometers: Magnetometers, target: str, options: ExportOptions, *, turned: bool
) -> tuple[FieldCorrection, list[str]]:
    """Return the correction with a symmetric matrix, with a rotation if `turned`, and the angle that is lost.

    Raises
    ------
    OptionError
        The axes are mirrored, which no rotation is, or something would be lost and that was not asked for.
    """
    mag = field_correction(magnetometers, target)
    if np.linalg.det(mag.matrix) < 0:
        raise OptionError(
            f"{target}: the magnetometers' axes are left-handed: no rotation turns them into the body frame"
        )
    lost = []
    if not turned and mag.angle > _NEGLIGIBLE:
        lost.append(f"how the magnetometers are turned against the accelerometers, {np.degrees(mag.angle):.3g} deg")
    return mag, settle_magnetometers([*lost, *quadratic_loss(mag.quadratic)], target, options)


def euler(rotation: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw, deg, of ``R = Rz(yaw) Ry(pitch) Rx(roll)``, as both autopilots have it."""
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = -np.arcsin(np.clip(rotation[2, 0], -1.0, 1.0))
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    return float(np.degrees(roll)), float(np.degrees(pitch)), float(np.degrees(yaw))


def px4_rows(mag: FieldCorrection, options: ExportOptions, *, turned: bool = True) -> list[tuple[str, float | str]]:
    """Return PX4's parameters: ``Rot (K (M - OFF))``, gauss, K symmetric; without Rot where it is not `turned`.

    Raises
    ------
    OptionError
        A scale is one that PX4 does not take.
    """
    q = mag.rotation
    matrix = q.T @ mag.matrix
    for axis, value in zip("xyz", np.diag(matrix).tolist(), strict=True):
        if not 0.1 <= value <= 3:
            raise OptionError(f"px4: magnetometer scale of axis {axis} is {value:.4g}; PX4 takes 0.1 to 3")
    offset = mag.in_unit("gauss")
    rows: list[tuple[str, float | str]] = [("CAL_MAG0_ID", str(options.mag_device_id))]
    rows += [(f"CAL_MAG0_{a}OFF", float(offset[i])) for i, a in enumerate("XYZ")]
    rows += [(f"CAL_MAG0_{a}SCALE", float(matrix[i, i])) for i, a in enumerate("XYZ")]
    pairs = (("X", 0, 1), ("Y", 0, 2), ("Z", 1, 2))
    rows += [(f"CAL_MAG0_{a}ODIAG", float(matrix[i, j])) for a, i, j in pairs]
    if not turned:
        return rows
    if options.mag_mount == "internal":
        return [*rows, ("CAL_MAG0_ROT", "-1")]
    angles = zip(("ROLL", "PITCH", "YAW"), euler(q), strict=True)
    return [*rows, ("CAL_MAG0_ROT", "100"), *((f"CAL_MAG0_{name}", angle) for name, angle in angles)]


def ardupilot_rows(mag: FieldCorrection, options: ExportOptions, *, turned: bool = True) -> list[tuple[str, float]]:
    """Return ArduPilot's parameters: ``K (M + OFS)`` after COMPASS_ORIENT, mgauss, K symmetric.

    Without the orientation where it is not `turned`.

    Raises
    ------
    OptionError
        A value is one that ArduPilot does not take.
    """
    q = mag.rotation
    external = options.mag_mount == "external"
    matrix = mag.matrix @ q.T if external else q.T @ mag.matrix
    offset = -(q @ mag.in_unit("mgauss") if external else mag.in_unit("mgauss"))
    off = np.array([matrix[0, 1], matrix[0, 2], matrix[1, 2]])
    if (np.diag(matrix) < 0.2).any() or not (np.diag(matrix) <= 5).all() or (np.abs(off) >= 1).any():
        raise OptionError(
            "ardupilot: takes magnetometer scales of 0.2 to 5 and off-diagonals below 1, found "
            f"{' '.join(f'{value:.3g}' for value in (*np.diag(matrix), *off))}"
        )
    if np.abs(offset).max() > 1800:
        raise OptionError(f"ardupilot: takes at most 1800 mgauss of hard iron, found {np.abs(offset).max():.4g}")
    rows = [(f"COMPASS_OFS_{a}", float(offset[i])) for i, a in enumerate("XYZ")]
    rows += [(f"COMPASS_DIA_{a}", float(matrix[i, i])) for i, a in enumerate("XYZ")]
    rows += [(f"COMPASS_ODI_{a}", float(off[i])) for i, a in enumerate("XYZ")]
    rows.append(("COMPASS_SCALE", 0.0))
    if not (external and turned):
        return rows
    angles = zip(("ROLL", "PITCH", "YAW"), euler(q), strict=True)
    rows += [("COMPASS_EXTERNAL", 1.0), ("COMPASS_ORIENT", 101.0), ("CUST_ROT_ENABLE", 1.0)]
    return rows + [(f"CUST_ROT1_{name}", angle) for name, angle in angles]


# x-io Fusion: ``misalignment (sensitivity . (raw - offset))``, and ``softIronMatrix (raw - hardIronOffset)``.


_ENGINEERING = {"m/s^2": "g", "rad/s": "deg/s"}


def export_fusion(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imulab_fusion.h``.

    Raises
    ------
    OptionError
        Fusion cannot hold the record.
    """
    alone = magnetometers_alone(records, "fusion")
    if alone is not None:
        return _write_fusion(folder, origin_of(alone[0]), _magnetic(alone[1]), [_FUSION_MAG, ROTATION_NOT_TOLD])
    unit = one_unit(records, "fusion")
    accel, error, how = held_accelerometers(unit, inverse_gain, misalignment=True)
    gyro = unit.gyro
    names, costs = gyro_terms(gyro, bias=False) if gyro is not None else ([], [])
    drift = [cost for cost in costs if "within" in cost]
    lost = settle_losses(
        "fusion",
        (accel_terms(unit.accel, misalignment=False), error),
        ([name for name in names if name.startswith(("gyro_g_sensitivity", "gyro_k"))], drift),
        how=how,
        options=options,
    )
    lines = _inertial("accelerometer", accel, "m/s^2")
    lines += _inertial("gyroscope", gyro, "rad/s") if gyro is not None else []
    if unit.mag is not None:
        lost += settle_magnetometers(quadratic_loss(largest_quadratic(unit.mag)), "fusion", options)
        lines += _magnetic(unit.mag)
    comments = [
        "calibrated = Misalignment (Sensitivity . (raw - Offset))",
        *([_FUSION_MAG] if unit.mag is not None else []),
        "no axes are turned: the results are in the record's axes",
        *lost,
    ]
    return _write_fusion(folder, unit.origin, lines, comments)


_FUSION_MAG = "magnetometers: calibrated = softIronMatrix (raw - hardIronOffset)"


def _write_fusion(folder: Path, origin: Sequence[str], lines: Sequence[str], comments: Sequence[str]) -> list[Path]:
    """Write the header, with the comments and constants in it."""
    first = [
        "x-io Fusion, " + origin[0],
        origin[1],
        "include it behind Fusion.h: for FusionModelInertial and FusionModelMagnetic, or before 1.3",
        "FusionCalibrationInertial and FusionCalibrationMagnetic",
    ]
    head = [*c_comment(*first, *comments), "#ifndef IMULAB_FUSION_H", "#define IMULAB_FUSION_H", ""]
    return write_one(folder, "imulab_fusion.h", [*head, *lines, "#endif"])


def _inertial(name: str, triad: Accelerometers | Gyroscopes, si: str) -> list[str]:
    """Return the constants of a triad whose outputs are in SI, and taken in g or deg/s; or in counts or volts."""
    engineering = _ENGINEERING[si]
    result = conversion_factor(si, engineering)
    raw = engineering if triad.unit == si else triad.unit
    taken = result if triad.unit == si else 1.0
    return [
        *c_comment(f"raw in {raw}, calibrated in {engineering}"),
        _matrix(f"{name}Misalignment", np.asarray(np.linalg.inv(triad.matrix), dtype=np.float64)),
        _vector(f"{name}Sensitivity", result / taken / triad.scale),
        _vector(f"{name}Offset", taken * triad.scale * triad.bias),
        "",
    ]


def _magnetic(mag: Magnetometers) -> list[str]:
    """Return the constants of magnetometers: in uT; or of raw counts or volts, in uT where the field is known."""
    raw, calibrated = mag.unit, "uT"
    if in_field(mag):
        held = field_correction(mag, "fusion")
        raw, soft, hard = "uT", held.matrix, held.in_unit("uT")
    elif mag.field is not None:
        soft, hard = mag.soft_iron / parse_unit("uT").factor, mag.hard_iron
    else:
        calibrated, soft, hard = "units of the local field", mag.soft_iron, mag.hard_iron
    return [
        *c_comment(f"raw in {raw}, calibrated in {calibrated}"),
        _matrix("softIronMatrix", soft),
        _vector("hardIronOffset", hard),
        *c_comment(f"before Fusion 1.2, softIronMatrix raw - hardIronOffset: hardIronOffset = {_numbers(soft @ hard)}"),
        "",
    ]


def _numbers(values: Array) -> str:
    return "{" + ", ".join(f"{single_precision(value)}f" for value in values) + "}"


def _matrix(name: str, matrix: Array) -> str:
    return f"static const FusionMatrix {name} = {{{{{', '.join(_numbers(row) for row in matrix)}}}}};"


def _vector(name: str, values: Array) -> str:
    return f"static const FusionVector {name} = {{{_numbers(values)}}};"


# ROS: imu_calib's ``a = SM raw - bias``, accelerometers only, and magnetometer_pipeline's ``matrix (raw - bias)``,
# T.


def export_ros(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imu_calib.yaml``.

    Raises
    ------
    OptionError
        imu_calib cannot hold the record.
    """
    alone = magnetometers_alone(records, "ros")
    if alone is not None:
        of_mag, more = _magnetometers(alone[1], options)
        comments = ["ROS, " + origin_of(alone[0])[0], origin_of(alone[0])[1], ROTATION_NOT_TOLD, *more]
        return write_one(folder, "imu_calib.yaml", [*hash_comments(comments), *of_mag])
    unit = one_unit(records, "ros")
    gyro = unit.gyro
    accel, error, how = held_accelerometers(unit, inverse_gain, misalignment=True)
    matrix = np.linalg.inv(accel.gain)
    bias = np.linalg.solve(accel.matrix, accel.bias)
    lost = settle_losses(
        "ros",
        (accel_terms(unit.accel, misalignment=False), error),
        gyro_terms(gyro, bias=True) if gyro is not None else ([], []),
        how=how,
        options=options,
    )
    of_mag, more = ([], []) if unit.mag is None else _magnetometers(unit.mag, options)
    comments = [
        "ROS imu_calib, " + unit.origin[0],
        unit.origin[1],
        f"a = SM raw - bias, m/s^2, from raw outputs in {accel.unit}",
        "no axes are turned: the result is in the record's axes",
        *lost,
        *more,
    ]
    lines = hash_comments(comments)
    lines += ["SM:", *(f"  - {yaml_number(value)}" for value in matrix.ravel())]
    lines += ["bias:", *(f"  - {yaml_number(value)}" for value in bias)]
    return write_one(folder, "imu_calib.yaml", lines + of_mag)


def _magnetometers(magnetometers: Magnetometers, options: ExportOptions) -> tuple[list[str], list[str]]:
    """Return the keys of magnetometer_pipeline, and comments on them."""
    if not in_field(magnetometers):
        comment = f"its file has no place for magnetometers with outputs in {magnetometers.unit}: theirs are left out"
        options.tell(f"ros: {comment}")
        return [], [comment]
    mag = field_correction(magnetometers, "ros")
    lost = settle_magnetometers(quadratic_loss(mag.quadratic), "ros", options)
    bias = mag.in_unit("T")
    lines = [f"initial_mag_bias_{axis}: {yaml_number(value)}" for axis, value in zip(AXES, bias, strict=True)]
    lines += ["initial_mag_scaling_matrix:", *(f"  - {yaml_number(value)}" for value in mag.matrix.ravel())]
    return lines, ["magnetometer_pipeline: field = initial_mag_scaling_matrix (raw - initial_mag_bias), T", *lost]


# MotionCal and Adafruit's sensor calibration: ``invW (raw - V)``, uT, invW symmetric; magnetometers only.


_NAMES = ("hardiron", "softiron")


def export_motioncal(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``motioncal.txt``.

    Raises
    ------
    OptionError
        The record has no magnetometers, or ones that a symmetric matrix cannot correct.
    """
    alone = magnetometers_alone(records, "motioncal")
    if alone is None:
        unit = one_unit(records, "motioncal")
        record, magnetometers = unit.record, unit.mag
    else:
        record, magnetometers = alone
    if magnetometers is None:
        raise OptionError("motioncal: holds magnetometers only, and the record has none (imulab tumble mag)")
    origin = origin_of(record)
    mag, lost = symmetric(magnetometers, "motioncal", options, turned=False)
    matrix = mag.rotation.T @ mag.matrix
    matrix = (matrix + matrix.T) / 2
    offset, field = mag.in_unit("uT"), mag.magnitude * conversion_factor(mag.unit, "uT")
    comments = [
        "MotionCal and Adafruit_Sensor_Calibration, " + origin[0],
        origin[1],
        "corrected = invW (raw - V), uT: V is the hard iron, invW the soft iron (symmetric), B the field's magnitude",
        "no axes are turned: raw must be in the axes of the record's magnetometer outputs",
        *lost,
    ]
    lines = hash_comments(comments)
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
