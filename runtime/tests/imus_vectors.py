"""What the fusion of whole IMUs must compute, by the dense least squares of tests/reference.

With faults, and beyond the range of the gyroscopes.
"""

import numpy as np
from write_c import LINES, emit

from reference import imus as reference

SAMPLES, FEW, EVERY, STEP = 128, 24, 3, 0.0078125
FIVE = 0.0234375 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [0.5, 0, -0.25]])


def fine(values, bits):
    """Multiples of 2^-bits, so that float and double start alike."""
    return np.round(np.ldexp(values, bits)) / 2.0**bits


def readings(board, rng):
    """Motion of up to 12 rad/s with noise, and one fault after the other; shape (n, 2, K, 3)."""
    y = board.readings(*reference.hand_motion(SAMPLES, STEP, rng))
    y += rng.normal(size=y.shape) * np.stack([board.accel_noise, board.gyro_noise])[None, :, :, None]
    y[:, 0], y[:, 1] = fine(y[:, 0], 16), np.clip(fine(y[:, 1], 20), -7.5, 7.5)
    y[:, 0, 4] = 0  # dead from the start
    y[30:60, 0, 1] = y[29, 0, 1]  # stuck in motion, with which three are left
    y[40, 0, 2, 1] += 4  # a knock of one of these
    y[70:73, 0, 0] = np.nan
    y[80, 1, 3] += 0.5  # a spike
    y[84:88, 1, 2, 0] = np.nan
    y[90:92, 0, 0, 2] = 200  # at the end of its range
    y[100:104] = np.nan
    y[104] = y[105]  # a row twice
    return y


def imus():
    rng = np.random.default_rng(8)
    for name, position in (("five", FIVE), ("two", FIVE[:2]), ("line", FIVE[0] * np.array([[-1], [0], [1], [2]]))):
        board = reference.make_board(position, rng, accel_noise=0.03125, gyro_noise=0.001953125)
        board.gyro_limit[:], board.accel_limit[:], board.gate, board.quiet = 7.5, 156.0, 30.664851, 16
        board.at += np.array([0.01171875, 0.0, -0.0078125])
        for field in ("accel", "gyro"):
            setattr(board, field, fine(getattr(board, field), 22))
        for field in ("accel_bias", "gyro_bias", "position", "at"):
            setattr(board, field, fine(getattr(board, field), 20))
        y = readings(board, rng) if name == "five" else readings_in_range(board, rng)
        fusion = reference.Fusion(board)
        rows = [fusion.step(0.0 if k == 0 else STEP, sample) for k, sample in enumerate(y)]
        numbers = {"at": board.at, "position": board.position, "accel": np.linalg.inv(board.accel),
                   "accel_bias": board.accel_bias, "accel_noise": board.accel_noise, "accel_limit": board.accel_limit,
                   "gyro": np.linalg.inv(board.gyro), "gyro_bias": board.gyro_bias, "gyro_noise": board.gyro_noise,
                   "gyro_limit": board.gyro_limit, "gyro_rows": board.gyro}  # fmt: skip
        for field, values in numbers.items():
            emit(f"v_imus_{name}_{field}", values.tolist())
        emit(f"v_imus_{name}_reading", y.reshape(len(y), -1).tolist())
        emit(f"v_imus_{name}_fused", [row[0].tolist() for row in rows[::EVERY]])
        standing = [[int(bridged), *(sum(1 << int(k) for k in used) for used in (accels, gyros))]
                    for _, bridged, accels, gyros in rows]  # fmt: skip
        emit(f"v_imus_{name}_standing", standing)  # bridged; bits of accelerometers and gyroscopes used
    LINES.append(f"enum {{ V_IMUS_SAMPLES = {SAMPLES}, V_IMUS_FEW = {FEW}, V_IMUS_EVERY = {EVERY} }};")
    emit("v_imus_step", STEP)


def readings_in_range(board, rng):
    y = board.readings(*(values[:FEW] for values in reference.hand_motion(SAMPLES, STEP, rng, size=2.0)))
    y += rng.normal(size=y.shape) * np.stack([board.accel_noise, board.gyro_noise])[None, :, :, None]
    return np.stack([fine(y[:, 0], 16), fine(y[:, 1], 20)], axis=1)
