"""Gyroscopes of a board that have another unit, or other axes, than its accelerometers; by a simulator of its own."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imulab.errors import DataError
from imulab.procedures.gyro_array.imus.prepare import prepare
from imulab.recording import Recording

G = 9.80665
HOLD, MOVE, SWAY, RATE = 3.0, 1.5, 12.0, 100.0
FACES = [(0, 0, 0), (90, 0, 0), (0, 90, 0), (180, 20, 0), (-90, 0, 30), (10, -90, 0), (45, 40, 0)]


def orientations(time: np.ndarray) -> Rotation:
    """Held on each face, turned smoothly from one to the next, and at last swayed by hand about all axes."""
    faces = Rotation.from_euler("xyz", FACES, degrees=True)
    place = np.minimum((time // (HOLD + MOVE)).astype(int), len(FACES) - 1)
    share = np.clip((time - place * (HOLD + MOVE) - HOLD) / MOVE, 0.0, 1.0)
    after = np.minimum(place + 1, len(FACES) - 1)
    turn = (faces[place].inv() * faces[after]).as_rotvec() * (share**3 * (10 - 15 * share + 6 * share**2))[:, None]
    since = time - len(FACES) * (HOLD + MOVE)
    sway = np.where(since > 0, np.sin(np.pi * np.clip(since / SWAY, 0, 1)) ** 2, 0.0)[:, None]
    swayed = sway * 0.6 * np.sin(2 * np.pi * since[:, None] * [0.7, 0.9, 1.1] + [0.0, 1.0, 2.0])
    return faces[place] * Rotation.from_rotvec(turn) * Rotation.from_rotvec(swayed)


def board(seed: int = 1, count: int = 3) -> dict[str, np.ndarray]:
    """Columns of IMUs 20 mm apart, m/s^2 and rad/s; rates and accelerations by differences of the orientation."""
    rng = np.random.default_rng(seed)
    time, h = np.arange(0.0, len(FACES) * (HOLD + MOVE) + SWAY + 2.0, 1 / RATE), 1e-4

    def rate_at(t: np.ndarray) -> np.ndarray:
        return (orientations(t - h).inv() * orientations(t + h)).as_rotvec() / (2 * h)

    rate, force = rate_at(time), orientations(time).inv().apply([0.0, 0.0, G])
    change = (rate_at(time + 1e-3) - rate_at(time - 1e-3)) / 2e-3
    columns = {"time": time}
    for k in range(count):
        arm = 0.02 * k * np.array([1.0, 0.5 * (k == 2), 0.0])
        accel = force + np.cross(change, arm) + np.cross(rate, np.cross(rate, arm)) + rng.normal(0, 0.2, 3)
        gyro = rate * (1 + rng.normal(0, 0.02, 3)) + rng.normal(0, 0.02, 3)
        for i, axis in enumerate("xyz"):
            columns[f"accel_{axis}_{k + 1}"] = accel[:, i] + rng.normal(0, 0.02, len(time))
            columns[f"gyro_{axis}_{k + 1}"] = gyro[:, i] + rng.normal(0, 0.002, len(time))
    return columns


def recording_of(columns: dict[str, np.ndarray]) -> Recording:
    units = {name: "s" if name == "time" else "m/s^2" if name.startswith("a") else "rad/s" for name in columns}
    return Recording(columns, units, name="board.csv")


def scaled(columns: dict[str, np.ndarray], factor: float, numbers: str) -> dict[str, np.ndarray]:
    return {k: factor * v if k.startswith("gyro") and k[-1] in numbers else v for k, v in columns.items()}


def exchanged(columns: dict[str, np.ndarray], sensor: str, signs: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """Of IMU 2: x and y of a sensor exchanged, and signs."""
    names = [f"{sensor}_{axis}_2" for axis in "xyz"]
    read = [signs[i] * columns[names[j]] for i, j in enumerate((1, 0, 2))]
    return {**columns, **dict(zip(names, read, strict=True))}


def test_a_board_whose_axes_agree_is_prepared():
    assert len(prepare(recording_of(board()), G).rests) >= len(FACES)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda c: scaled(c, 180 / np.pi, "123"), r"IMU 1 .* if gyro_x_1 .. gyro_z_1 are 57.3 times too large"),
        (lambda c: scaled(c, np.pi / 180, "123"), r"IMU 1 .* if gyro_x_1 .. gyro_z_1 are 57.3 times too small"),
        (
            lambda c: exchanged(c, "accel", (1, 1, -1)),
            r"IMU 2 .* if x is gyro_y_2, y is gyro_x_2, z is -gyro_z_2: are columns of either exchanged",
        ),
        (lambda c: exchanged(c, "gyro", (1, 1, 1)), r"IMU 2 .* if x is gyro_y_2, y is gyro_x_2 \(left-handed\): are"),
        (
            lambda c: scaled(c, -1.0, "3"),
            r"IMU 3 .* if x is -gyro_x_3, y is -gyro_y_3, z is -gyro_z_3 \(left-handed\): are",
        ),
    ],
)
def test_gyroscopes_that_turn_gravity_otherwise_are_refused(change, text):
    """They made boards of 0.03 mm or 40 mm positions that were wrong by as much, and drifts were blamed."""
    with pytest.raises(DataError, match=f"board.csv: gyroscopes and accelerometers of {text}"):
        prepare(recording_of(change(board())), G)
