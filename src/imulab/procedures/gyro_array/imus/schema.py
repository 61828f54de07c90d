"""What the record of a board of whole IMUs holds, with types: filled by the fit, read by fusion, report and `load`.

Readings of IMU k, in SI, of the specific force f at its place and the rate w, both in the body frame:

    accel: y_i = S_i [(T Q' f)_i + b_i],    gyro: z_i = S_i [(T Q' w)_i + b_i]

as in a record of tumble, T with unit diagonal: lower triangular of accelerometers, full of gyroscopes. Q turns vectors
from the frame of the IMU's accelerometers to that of IMU 1, the body frame.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeVar

import numpy as np

from imulab.device.imus import NO_LIMIT
from imulab.errors import RecordError
from imulab.procedures.gyro_array.imus.model import ACCEL, GYRO, NUMBERS, Board, cross
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.sections import Above0, Length, Measured, Part, Quantity, Size, StatedGravity, null, part

T = TypeVar("T")
PerImu = Annotated[list[T], "imus"]
PerStretch = Annotated[list[T], "stretches"]
ACCEL_PAIRS, GYRO_PAIRS = ("yx", "zx", "zy"), ("xy", "xz", "yx", "yz", "zx", "zy")
SizeFrom = Literal["gravity", "stated", "gyro scale"]


class Three(Part):
    """Three numbers, over x, y, z or the pairs yx, zx, zy; an uncertainty is None where none can be stated."""

    value: Annotated[list[float], 3]
    standard_uncertainty: Annotated[list[Size | None], 3]
    unit: str


class Six(Part):
    """Six numbers, over the pairs xy, xz, yx, yz, zx, zy."""

    value: Annotated[list[float], 6]
    standard_uncertainty: Annotated[list[Size | None], 6]
    unit: str


class AccelTriad(Part):
    """The accelerometers of one IMU."""

    bias: Three
    scale_factor: Three
    misalignment: Three


class GyroTriad(Part):
    """The gyroscopes of one IMU."""

    bias: Three
    scale_factor: Three
    misalignment: Six


class Imu(Part):
    """One of ``imus``.

    `accel_noise` and `gyro_noise` are the standard deviations of a sample at rest, mean of the three axes.
    `accel_range` and `gyro_range` are the readings at the ends of the ranges, None where neither stated nor reached.
    """

    name: str
    position: Three
    rotation: Three
    accel_latency: Measured
    gyro_latency: Measured
    accel: AccelTriad
    gyro: GyroTriad
    accel_noise: Above0
    gyro_noise: Above0
    accel_range: Above0 | None = null()
    gyro_range: Above0 | None = null()


class Common(Part):
    """``common``: mean of all IMUs, along the body axes; None where attitudes at rest are too few to tell."""

    accel_scale_factor: Three | None = null()
    accel_bias: Three | None = null()


class ImusModel(Part):
    """``model``: `units` are those of accelerometers and gyroscopes in the recording."""

    kind: Literal["imus"]
    imus: int
    gauge: str
    gravity: StatedGravity
    units: Annotated[list[str], 2]
    temperature: Quantity | None = None


class BoardSize(Part):
    """What each source says of the board's size, as a factor on the one that was taken; None where it says nothing."""

    gravity: Measured | None = null()
    stated: Measured | None = null()
    gyro_scale: Measured | None = null()


class ImusSummary(Part):
    """``fit``: how much motion there was, and how well the board explains it.

    `accel_factor` and `gyro_factor` are how many times its noise at rest the scatter in motion is, by median. `age` is
    the standard deviation of the readings' age. `coherence` is the correlation of the angular acceleration from the
    accelerometers with the derivative of the rate; `halves` the rms of the positions' differences between two halves of
    the motion over their uncertainty; `widening` the factor of the sandwich over the stated uncertainty, by median.
    `clipped` is the share of the samples in motion that have a reading at its limit, `bridged` that of all samples with
    a gyroscope at the end of its range, stated or reached, where fusion takes the rate from the accelerometers.
    """

    sample_rate: Above0
    duration: Above0
    samples_in_motion: int
    rests: int
    clipped: Size
    bridged: Size | None = null()
    axis_rates: Three
    accel_residual: Length
    gyro_residual: Length
    accel_factor: Size
    gyro_factor: Size
    age: Length
    coherence: float
    widening: Size
    halves: Size | None = null()
    size: BoardSize


class MotionData(Part):
    """``data.motion``: by stretches of the motion, rms of the residuals of each IMU and of the rate, SI."""

    time: PerStretch[float]
    rate: PerStretch[Size]
    accel_residual: PerStretch[PerImu[Size]]
    gyro_residual: PerStretch[PerImu[Size]]


class ImusData(Part):
    """``data``."""

    motion: MotionData


class ImusRecord(Part):
    """The record of a board of whole IMUs."""

    model: ImusModel
    fit: ImusSummary
    imus: PerImu[Imu]
    common: Common
    origin: Literal["imu 1"]
    size_from: SizeFrom
    not_determined: list[str]
    data: ImusData

    @property
    def board(self) -> Board:
        """The numbers of the IMUs: matrices, biases, positions from IMU 1, latencies."""
        return Board(np.array([_numbers(imu) for imu in self.imus]))

    @property
    def accel_noise(self) -> Array:
        """Standard deviation of a sample of each IMU's accelerometers at rest, m/s^2, shape (K,)."""
        return np.array([imu.accel_noise.value for imu in self.imus])

    @property
    def gyro_noise(self) -> Array:
        """Standard deviation of a sample of each IMU's gyroscopes at rest, rad/s, shape (K,)."""
        return np.array([imu.gyro_noise.value for imu in self.imus])

    @property
    def limits(self) -> Array:
        """Readings at the ends of the ranges, m/s^2 and rad/s, shape (2, K); ``NO_LIMIT`` where they are not known."""
        ends = [[imu.accel_range for imu in self.imus], [imu.gyro_range for imu in self.imus]]
        return np.array([[NO_LIMIT if end is None else end.value for end in each] for each in ends])


def imus_of(record: Calibration) -> ImusRecord:
    """Return the sections of the record of a board of whole IMUs.

    Raises
    ------
    RecordError
        A part is wrong, or the record is of something else; a part that is missing raises when it is read.
    """
    if record.procedure != "gyro_array" or record.model.get("kind") != "imus":
        what = record.model.get("kind", record.procedure) if record.procedure == "gyro_array" else record.procedure
        raise RecordError(f"expected the record of 'imulab array calibrate --imus', found one of a {what}")
    held = part(record, ImusRecord)
    if len(record.sections.get("imus", ())) < 2:
        raise RecordError("imus: expected two or more")
    return held


# The numbers of an IMU in the record, and those of the model.


PER_IMU: tuple[tuple[str, str], ...] = (
    *((f"position_{axis}", "m") for axis in "xyz"),
    *((f"rotation_{axis}", "rad") for axis in "xyz"),
    ("accel_latency", "s"),
    ("gyro_latency", "s"),
    *((f"accel_bias_{axis}", "m/s^2") for axis in "xyz"),
    *((f"accel_scale_factor_{axis}", "1") for axis in "xyz"),
    *((f"accel_misalignment_{pair}", "rad") for pair in ACCEL_PAIRS),
    *((f"gyro_bias_{axis}", "rad/s") for axis in "xyz"),
    *((f"gyro_scale_factor_{axis}", "1") for axis in "xyz"),
    *((f"gyro_misalignment_{pair}", "rad") for pair in GYRO_PAIRS),
)
"""Names, before ``_k``, and units of the parameters of one IMU in the record, as many as in the model."""
AT_POSITION, AT_ROTATION, AT_ACCEL_LATENCY, AT_GYRO_LATENCY = slice(0, 3), slice(3, 6), 6, 7
AT_ACCEL_BIAS, AT_ACCEL_SCALE, AT_ACCEL_MISALIGNMENT = slice(8, 11), slice(11, 14), slice(14, 17)
AT_GYRO_BIAS, AT_GYRO_SCALE, AT_GYRO_MISALIGNMENT = slice(17, 20), slice(20, 23), slice(23, 29)
"""Where they stand among these."""


def rotation_matrix(vector: Array) -> Array:
    """Return the matrix of a rotation vector, shape (3, 3)."""
    angle = float(np.linalg.norm(vector))
    matrix = cross(vector)
    if angle < 1e-8:
        return np.asarray(np.eye(3) + matrix)
    turned: Array = np.eye(3) + math.sin(angle) / angle * matrix + (1 - math.cos(angle)) / angle**2 * (matrix @ matrix)
    return turned


def numbers_of(parameters: Array) -> Array:
    """Return the numbers of the model, shape (29,), of the parameters of one IMU in the record, shape (29,)."""
    to_imu = rotation_matrix(parameters[AT_ROTATION]).T
    numbers = np.zeros(NUMBERS)
    for place, pairs, bias, scale, misalignment in (
        (ACCEL, ACCEL_PAIRS, AT_ACCEL_BIAS, AT_ACCEL_SCALE, AT_ACCEL_MISALIGNMENT),
        (GYRO, GYRO_PAIRS, AT_GYRO_BIAS, AT_GYRO_SCALE, AT_GYRO_MISALIGNMENT),
    ):
        skewed = np.eye(3)
        for pair, value in zip(pairs, parameters[misalignment], strict=True):
            skewed["xyz".index(pair[0]), "xyz".index(pair[1])] = value
        numbers[place] = (parameters[scale][:, None] * skewed @ to_imu).ravel()
        numbers[place.stop : place.stop + 3] = parameters[scale] * parameters[bias]
    numbers[12:15] = parameters[AT_POSITION]
    numbers[15], numbers[28] = parameters[AT_ACCEL_LATENCY], parameters[AT_GYRO_LATENCY]
    return numbers


def _numbers(imu: Imu) -> Array:
    triads = (imu.accel, imu.gyro)
    each = [part.value for triad in triads for part in (triad.bias, triad.scale_factor, triad.misalignment)]
    late = [imu.accel_latency.value, imu.gyro_latency.value]
    return numbers_of(np.concatenate([imu.position.value, imu.rotation.value, late, *each]))
