"""What the IMUs of one rigid board read, and how that changes with every number of the board and of its motion.

Body frame: that of the accelerometers of IMU 1, whose matrix is lower triangular. Origin: IMU 1. With the specific
force s at the origin, the rate w, W = [w]x, and the angular acceleration al,

    accelerometers k:  y_k(t) = Ta_k [s + (W^2 + [al]x) r_k](t - ta_k) + ba_k
    gyroscopes k:      z_k(t) = Tg_k w(t - tg_k) + bg_k

The angular acceleration is free in each sample and not tied to the derivative of the rate. Source: Skog, Nilsson,
Haendel, Nehorai, IEEE Trans. Signal Process. 64(16) 4218 (2016); Carlsson, Skog, Jalden, IEEE Sensors J. 21(6) 8451
(2021).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.recording import Array

ACCEL, ACCEL_BIAS, POSITION, ACCEL_LATENCY = slice(0, 9), slice(9, 12), slice(12, 15), 15
GYRO, GYRO_BIAS, GYRO_LATENCY = slice(16, 25), slice(25, 28), 28
OF_ACCEL, OF_GYRO = slice(0, 16), slice(16, 29)
NUMBERS = 29
"""Of one IMU, in this order: Ta by rows, ba, r, ta, Tg by rows, bg, tg."""
FORCE, ACCELERATION, RATE = slice(0, 3), slice(3, 6), slice(6, 9)
"""Of one sample: s, al, w."""


@dataclass(frozen=True)
class Board:
    """The numbers of the K IMUs of a board, shape (K, 29); SI."""

    numbers: Array

    @property
    def accel(self) -> Array:
        """Ta, shape (K, 3, 3)."""
        return self.numbers[:, ACCEL].reshape(-1, 3, 3)

    @property
    def accel_bias(self) -> Array:
        """ba, m/s^2, shape (K, 3)."""
        return self.numbers[:, ACCEL_BIAS]

    @property
    def position(self) -> Array:
        """r, m, shape (K, 3)."""
        return self.numbers[:, POSITION]

    @property
    def gyro(self) -> Array:
        """Tg, shape (K, 3, 3)."""
        return self.numbers[:, GYRO].reshape(-1, 3, 3)

    @property
    def gyro_bias(self) -> Array:
        """bg, rad/s, shape (K, 3)."""
        return self.numbers[:, GYRO_BIAS]


def cross(vector: Array) -> Array:
    """Return [v]x of vectors, shape (..., 3), as matrices, shape (..., 3, 3)."""
    matrix = np.zeros((*vector.shape[:-1], 3, 3))
    x, y, z = (vector[..., k] for k in range(3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix


def lever(rate: Array, acceleration: Array) -> Array:
    """Return W^2 + [al]x, shape (n, 3, 3), of rates and angular accelerations, shape (n, 3)."""
    square = np.square(rate).sum(1)[:, None, None]
    return np.asarray(rate[:, :, None] * rate[:, None, :] - square * np.eye(3) + cross(acceleration))


def predicted(board: Board, motion: Array) -> tuple[Array, Array, Array]:
    """Return the force at each IMU, and what accelerometers and gyroscopes read, shape (n, K, 3) each.

    `motion` has s, al, w of each sample, shape (n, 9).
    """
    shape = (len(motion), len(board.numbers), 3)
    by_lever = lever(motion[:, RATE], motion[:, ACCELERATION]) @ board.position.T
    force = motion[:, None, FORCE] + np.swapaxes(by_lever, 1, 2)
    accel = np.matmul(force.swapaxes(0, 1), board.accel.swapaxes(1, 2)).swapaxes(0, 1) + board.accel_bias
    gyro = (motion[:, RATE] @ board.gyro.reshape(-1, 3).T).reshape(shape) + board.gyro_bias
    return force, accel, gyro


def motion_jacobian(board: Board, motion: Array) -> tuple[Array, Array]:
    """Return how readings change with s, al, w: accelerometers, shape (n, K, 3, 9), and gyroscopes, (K, 3, 3), by w.

    ``d(W^2 r)/dw = (w.r) I + w r' - 2 r w'``; ``d([al]x r)/d al = -[r]x``.
    """
    r, unit = board.position, np.eye(3)
    accel = np.empty((len(motion), len(r), 3, 9))
    accel[..., FORCE] = board.accel
    accel[..., ACCELERATION] = board.accel @ -cross(r)
    # By w it is linear in w: of each component of w, shape (3, K, 3, 3).
    along, w_r = r.T[:, :, None, None] * unit, unit[:, None, :, None] * r[None, :, None, :]
    by_rate = np.matmul(board.accel, along + w_r - 2 * np.swapaxes(w_r, 2, 3))
    accel[..., RATE] = (motion[:, RATE] @ by_rate.reshape(3, -1)).reshape(len(motion), len(r), 3, 3)
    return accel, board.gyro


def board_jacobian(board: Board, motion: Array, change: Array) -> tuple[Array, Array]:
    """Return how readings change with the board: accelerometers, shape (n, K, 3, 16), and gyroscopes, (n, K, 3, 13).

    `change` is the derivative of the motion by time, shape (n, 9). Readings are taken at t + latency, so that the
    columns of the latencies are minus the derivative of what is predicted.
    """
    n, count = len(motion), len(board.numbers)
    force, _, _ = predicted(board, motion)
    rate, slope = motion[:, RATE], change[:, RATE]
    each = rate[:, :, None] * slope[:, None, :]
    turning = each + np.swapaxes(each, 1, 2) - 2 * np.einsum("nj,nj->n", rate, slope)[:, None, None] * np.eye(3)
    turning += cross(change[:, ACCELERATION])
    force_change = change[:, None, FORCE] + np.swapaxes(turning @ board.position.T, 1, 2)
    accel, gyro = np.zeros((n, count, 3, 16)), np.zeros((n, count, 3, 13))
    for row in range(3):
        accel[:, :, row, 3 * row : 3 * row + 3] = force
        gyro[:, :, row, 3 * row : 3 * row + 3] = rate[:, None]
        accel[:, :, row, 9 + row] = gyro[:, :, row, 9 + row] = 1.0
    accel[..., POSITION] = np.matmul(board.accel, lever(rate, motion[:, ACCELERATION])[:, None])
    by_time = np.matmul(force_change.swapaxes(0, 1), board.accel.swapaxes(1, 2))
    accel[..., ACCEL_LATENCY] = -by_time.swapaxes(0, 1)
    gyro[..., 12] = -(slope @ board.gyro.reshape(-1, 3).T).reshape(n, count, 3)
    return accel, gyro
