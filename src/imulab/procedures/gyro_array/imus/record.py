"""The record of a board of whole IMUs, from its numbers and their covariance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imulab.device.imus import NO_LIMIT
from imulab.errors import DataError
from imulab.procedures.gyro_array.imus.model import (
    ACCEL,
    ACCEL_LATENCY,
    GYRO,
    GYRO_LATENCY,
    NUMBERS,
    POSITION,
    Board,
    cross,
)
from imulab.procedures.gyro_array.imus.schema import (
    ACCEL_PAIRS,
    AT_ACCEL_BIAS,
    AT_ACCEL_LATENCY,
    AT_ACCEL_MISALIGNMENT,
    AT_ACCEL_SCALE,
    AT_GYRO_BIAS,
    AT_GYRO_LATENCY,
    AT_GYRO_MISALIGNMENT,
    AT_GYRO_SCALE,
    AT_POSITION,
    AT_ROTATION,
    GYRO_PAIRS,
    PER_IMU,
    AccelTriad,
    Common,
    GyroTriad,
    Imu,
    ImusData,
    ImusModel,
    ImusSummary,
    Six,
    SizeFrom,
    Three,
)
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.sections import Above0, Measured, entries

GAUGE = "frame of the accelerometers of IMU 1: its x input axis along body x, its y input axis in the body xy plane"
_DIGITS = 9  # of the covariance in the record
_STEP = 1e-6  # of the derivatives by differences, in the numbers' SI units


def parameters_of(numbers: Array, turned: Array | None = None) -> tuple[Array, Array]:
    """Return the parameters of one IMU in the record, shape (29,), and Q.

    With `turned`, a Q nearby, the rotation is the small one about the body axes from there.
    """
    from scipy.spatial.transform import Rotation

    accel, gyro = numbers[ACCEL].reshape(3, 3), numbers[GYRO].reshape(3, 3)
    # Ta' = Q L' is the QR decomposition of Ta', with a diagonal of L above 0.
    q, upper = np.linalg.qr(accel.T)
    signs = np.sign(np.diag(upper))
    q, lower = q * signs, upper.T * signs
    values = np.empty(NUMBERS)
    values[AT_ROTATION] = Rotation.from_matrix(q if turned is None else q @ turned.T).as_rotvec()
    for matrix, pairs, place, bias, scale, misalignment in (
        (lower, ACCEL_PAIRS, ACCEL, AT_ACCEL_BIAS, AT_ACCEL_SCALE, AT_ACCEL_MISALIGNMENT),
        (gyro @ q, GYRO_PAIRS, GYRO, AT_GYRO_BIAS, AT_GYRO_SCALE, AT_GYRO_MISALIGNMENT),
    ):
        factors = np.diag(matrix)
        values[scale], values[bias] = factors, numbers[place.stop : place.stop + 3] / factors
        rows, columns = (["xyz".index(pair[at]) for pair in pairs] for at in (0, 1))
        values[misalignment] = matrix[rows, columns] / factors[rows]
    values[AT_POSITION] = numbers[POSITION]
    values[AT_ACCEL_LATENCY], values[AT_GYRO_LATENCY] = numbers[ACCEL_LATENCY], numbers[GYRO_LATENCY]
    return values + 0.0, q  # no -0


def _vector_by_turn(vector: Array) -> Array:
    """Return how a rotation vector changes with a small turn about the body axes, shape (3, 3)."""
    angle, matrix = float(np.linalg.norm(vector)), cross(vector)
    if angle < 1e-6:
        return np.asarray(np.eye(3) - matrix / 2)
    return np.asarray(np.eye(3) - matrix / 2 + (1 - angle / 2 / np.tan(angle / 2)) / angle**2 * (matrix @ matrix))


def record_values(board: Board, covariance: Array) -> tuple[Array, Array]:
    """Return the parameters of the record, shape (K, 29), and their covariance, shape (29 K, 29 K).

    Raises
    ------
    DataError
        The axes of an IMU's accelerometers are left-handed.
    """
    count = len(board.numbers)
    values, jacobian = np.empty((count, NUMBERS)), np.zeros((count, NUMBERS, NUMBERS))
    for k, numbers in enumerate(board.numbers):
        if np.linalg.det(numbers[ACCEL].reshape(3, 3)) <= 0:
            raise DataError(f"IMU {k + 1}: its axes are left-handed: is one reversed, or are two exchanged?")
        values[k], turned = parameters_of(numbers)
        for column in range(NUMBERS):
            shift = np.zeros(NUMBERS)
            shift[column] = _STEP
            ahead, behind = (parameters_of(numbers + sign * shift, turned)[0] for sign in (1, -1))
            jacobian[k, :, column] = (ahead - behind) / (2 * _STEP)
        jacobian[k, AT_ROTATION] = _vector_by_turn(values[k, AT_ROTATION]) @ jacobian[k, AT_ROTATION]
    blocks = covariance.reshape(count, NUMBERS, count, NUMBERS)
    carried = np.einsum("kab,kblc,ldc->kald", jacobian, blocks, jacobian, optimize=True)
    return values, carried.reshape(covariance.shape)


def make_record(
    recording: Recording,
    board: Board,
    covariance: Array,
    noise: tuple[Array, Array],
    limits: Array | None = None,
    *,
    model: ImusModel,
    fit: ImusSummary,
    data: ImusData,
    common: Common,
    size_from: SizeFrom,
    not_determined: Sequence[str],
    options: dict[str, object],
    warnings: Sequence[str] = (),
    unknown: Sequence[slice] = (),
) -> Calibration:
    """Return the record of a board; `noise` are standard deviations at rest, m/s^2 and rad/s, shape (K, 3) each.

    `limits` are the ends of the ranges, shape (2, K), ``NO_LIMIT`` where they are not known.
    `unknown` are places among the parameters of each IMU whose uncertainty cannot be stated.
    """
    values, carried = record_values(board, covariance)
    count = len(values)
    deviation = np.sqrt(np.maximum(np.diag(carried), 0.0)).reshape(count, NUMBERS)
    fixed = deviation < 1e-15  # the gauge: IMU 1
    unstated = np.zeros((count, NUMBERS), dtype=bool)
    for place in unknown:
        unstated[:, place] = True
    shown = deviation.astype(object)
    shown[unstated] = None
    imus = [_imu(k, values[k], shown[k].tolist(), noise, limits) for k in range(count)]
    names = np.array([[f"{name}_{k + 1}" for name, _ in PER_IMU] for k in range(count)])
    units = np.broadcast_to(np.array([unit for _, unit in PER_IMU]), names.shape)
    parameters = {
        str(names[at]): Parameter(float(values[at]), None if unstated[at] else float(deviation[at]), str(units[at]))
        for at in np.ndindex(names.shape)
        if not fixed[at]
    }
    known = np.flatnonzero(~(fixed | unstated))
    matrix = carried[np.ix_(known, known)]
    return Calibration(
        procedure="gyro_array",
        parameters=parameters,
        covariance=Covariance(
            tuple(names.ravel()[known].tolist()),
            tuple(tuple(float(f"{v:.{_DIGITS}g}") for v in row) for row in ((matrix + matrix.T) / 2).tolist()),
        ),
        model=entries(model),
        fit=entries(fit),
        options=options,
        data=entries(data),
        sensor={key: recording.metadata[key] for key in ("serial", "model") if key in recording.metadata},
        sources=() if recording.source is None else (recording.source,),
        warnings=tuple(warnings),
        sections={
            "imus": [entries(imu) for imu in imus],
            "common": entries(common),
            "origin": "imu 1",
            "size_from": size_from,
            "not_determined": list(not_determined),
        },
    )


def _imu(k: int, values: Array, deviation: list[float | None], noise: tuple[Array, Array], limits: Array | None) -> Imu:
    def three(place: slice, unit: str) -> Three:
        return Three(value=values[place].tolist(), standard_uncertainty=deviation[place], unit=unit)

    def single(place: int) -> Measured:
        return Measured(value=float(values[place]), standard_uncertainty=deviation[place], unit="s")

    ranges = [
        Above0(value=float(limits[s, k]), unit=unit) if limits is not None and limits[s, k] < NO_LIMIT else None
        for s, unit in enumerate(("m/s^2", "rad/s"))
    ]
    six = Six(
        value=values[AT_GYRO_MISALIGNMENT].tolist(), standard_uncertainty=deviation[AT_GYRO_MISALIGNMENT], unit="rad"
    )
    return Imu(
        name=str(k + 1),
        position=three(AT_POSITION, "m"),
        rotation=three(AT_ROTATION, "rad"),
        accel_latency=single(AT_ACCEL_LATENCY),
        gyro_latency=single(AT_GYRO_LATENCY),
        accel=AccelTriad(
            bias=three(AT_ACCEL_BIAS, "m/s^2"),
            scale_factor=three(AT_ACCEL_SCALE, "1"),
            misalignment=three(AT_ACCEL_MISALIGNMENT, "rad"),
        ),
        gyro=GyroTriad(bias=three(AT_GYRO_BIAS, "rad/s"), scale_factor=three(AT_GYRO_SCALE, "1"), misalignment=six),
        accel_noise=Above0(value=float(np.sqrt(np.square(noise[0][k]).mean())), unit="m/s^2"),
        gyro_noise=Above0(value=float(np.sqrt(np.square(noise[1][k]).mean())), unit="rad/s"),
        accel_range=ranges[0],
        gyro_range=ranges[1],
    )
