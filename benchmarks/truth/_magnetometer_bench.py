"""A unit with accelerometers and magnetometers turned by hand through attitudes, in a field that people have.

Written apart from imulab: rotation matrices, its own turns, sensors and disturbances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Recording

G = 9.80665
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Disturbance:
    """What disturbs the test; all nil where nothing does.

    `sway` rad rms of the whole unit about each axis, below 2 Hz; `corner` Hz of the magnetometers' low pass (0: none);
    `mains` uT of an alias at `alias` Hz; `gradient` uT/m with the magnetometers `lever` m off the centre of the turns;
    `phone` uT that comes from the middle attitude on; `poses`: the second half of the attitudes points one way.
    """

    sway: float = 0.0
    corner: float = 0.0
    mains: float = 0.0
    alias: float = 0.1
    gradient: float = 0.0
    lever: float = 0.05
    phone: float = 0.0
    poses: bool = False


@dataclass(frozen=True)
class Bench:
    """The recording, and the true parameters of the magnetometers as matrix (uT/uT) and hard iron (uT)."""

    recording: Recording
    matrix: Array
    hard_iron: Array
    dip: float
    accel: dict[str, float]


def rotation(vector: Array) -> Array:
    """Return rotation matrices of rotation vectors, shape (n, 3) to (n, 3, 3)."""
    angle = np.linalg.norm(vector, axis=1)
    x, y, z = (vector / np.maximum(angle, 1e-300)[:, None]).T
    nil = np.zeros_like(x)
    cross = np.array([[nil, -z, y], [z, nil, -x], [-y, x, nil]]).transpose(2, 0, 1)
    return np.asarray(
        np.eye(3) + np.sin(angle)[:, None, None] * cross + (1 - np.cos(angle))[:, None, None] * cross @ cross,
        dtype=np.float64,
    )


def rotation_vector(matrix: Array) -> Array:
    """Return the rotation vector of one rotation matrix that is not a half turn."""
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    sine, cosine = np.linalg.norm(axis) / 2, (np.trace(matrix) - 1) / 2
    return np.asarray(axis / max(2 * sine, 1e-12) * np.arctan2(sine, cosine), dtype=np.float64)


def low_pass(values: Array, corner: float, rate: float) -> Array:
    """Return values, shape (n, 3), after a filter of the first order."""
    gain, out = 1 - np.exp(-2 * np.pi * corner / rate), np.empty_like(values)
    state = values[0].copy()
    for k, row in enumerate(values):
        state += gain * (row - state)
        out[k] = state
    return out


def band(rng: np.random.Generator, count: int, highest: float, rate: float) -> Array:
    """Return normal noise of unit variance below a frequency, shape (count, 3)."""
    spectrum = np.fft.rfft(rng.standard_normal((count, 3)), axis=0)
    f = np.fft.rfftfreq(count, 1 / rate)
    noise = np.fft.irfft(spectrum * ((f > 0.1) & (f < highest))[:, None], count, axis=0)
    return np.asarray(noise / noise.std(), dtype=np.float64)


def attitudes(rng: np.random.Generator, count: int, *, poses: bool) -> Array:
    """Return rotations, world to body, shape (count, 3, 3): any; or half of them about an axis that points one way."""
    turns, upper = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    turns = turns * np.sign(np.einsum("nii->ni", upper))[:, None, :]
    turns[np.linalg.det(turns) < 0] *= -1
    if poses:
        half = count // 2
        for first, axis in ((count - half, np.array([1.0, 0.0, 0.0])), (count - half // 2, np.array([0.0, 1.0, 0.0]))):
            rolls = 2 * np.pi * np.arange(half // 2) / (half // 2)
            turns[first - 0 : first + half // 2] = rotation(rolls[:, None] * axis) @ turns[first]
    return np.asarray(turns, dtype=np.float64)


def record(
    rng: np.random.Generator,
    disturbance: Disturbance,
    *,
    count: int = 24,
    rate: float = 50.0,
    hold: float = 4.0,
    move: float = 2.0,
    noise: float = 0.15,
) -> Bench:
    """Return a recording of a test; `noise` of a sample of the magnetometers in uT, accelerometers have 0.3 mg."""
    turns = attitudes(rng, count, poses=disturbance.poses)
    held, moving = round(hold * rate), round(move * rate)
    path, index = [], []
    for k in range(count):
        path.append(np.broadcast_to(turns[k], (held, 3, 3)))
        index += [k] * held
        if k + 1 < count:
            progress = np.linspace(0, 1, moving + 2)[1:-1]
            smooth = progress**3 * (10 - 15 * progress + 6 * progress**2)
            path.append(rotation(smooth[:, None] * rotation_vector(turns[k + 1] @ turns[k].T)) @ turns[k])
            index += [k] * moving
    body = np.concatenate(path)
    n = len(body)
    if disturbance.sway:
        body = rotation(disturbance.sway * band(rng, n, 2.0, rate)) @ body
    time = np.arange(n) / rate
    dip, size = np.radians(67.0), 48.0
    earth = size * np.array([0.0, np.cos(dip), -np.sin(dip)])
    field = np.tile(earth, (n, 1))
    if disturbance.gradient:
        tensor = rng.standard_normal((3, 3))
        tensor = tensor + tensor.T - np.eye(3) * np.trace(tensor + tensor.T) / 3
        tensor *= disturbance.gradient / np.linalg.norm(tensor, 2)
        arm = rng.standard_normal(3)
        arm *= disturbance.lever / np.linalg.norm(arm)
        field = field + np.einsum("nji,j->ni", body, arm) @ tensor
    if disturbance.mains:
        pole = rng.standard_normal(3)
        wave = np.sin(2 * np.pi * (disturbance.alias * time + rng.uniform()))
        field = field + disturbance.mains * wave[:, None] * pole / np.linalg.norm(pole)
    if disturbance.phone:
        pole = rng.standard_normal(3)
        field = field + np.where(np.array(index) >= count // 2, disturbance.phone, 0.0)[:, None] * (
            pole / np.linalg.norm(pole)
        )
    m = np.einsum("nij,nj->ni", body, field)
    f = G * body[:, :, 2]
    matrix = np.eye(3) + 0.05 * rng.uniform(-1, 1, (3, 3)) + np.radians(3) * np.cross(np.eye(3), rng.uniform(-1, 1, 3))
    hard_iron = 0.5 * size * rng.uniform(-1, 1, 3)
    outputs = m @ matrix.T + hard_iron
    if disturbance.corner:
        outputs = low_pass(outputs, disturbance.corner, rate)
    outputs = 0.02 * np.round((outputs + noise * rng.standard_normal((n, 3))) / 0.02)
    accel = {f"bias_{a}": 0.02 * G * float(rng.standard_normal()) for a in "xyz"}
    accel |= {f"scale_factor_{a}": 1 + 0.01 * float(rng.standard_normal()) for a in "xyz"}
    accel |= {f"misalignment_{p}": 0.01 * float(rng.standard_normal()) for p in ("yx", "zx", "zy")}
    lower = np.eye(3)
    lower[1, 0], lower[2, 0], lower[2, 1] = (accel[f"misalignment_{p}"] for p in ("yx", "zx", "zy"))
    sensed = (f @ lower.T + [accel[f"bias_{a}"] for a in "xyz"]) * [accel[f"scale_factor_{a}"] for a in "xyz"]
    sensed = sensed + 3e-4 * G * rng.standard_normal((n, 3))
    columns = {"time": time, **{f"accel_{a}": sensed[:, i] for i, a in enumerate("xyz")}}
    columns |= {f"mag_{a}": outputs[:, i] for i, a in enumerate("xyz")}
    units = {c: "s" if c == "time" else "m/s^2" if c[0] == "a" else "uT" for c in columns}
    return Bench(Recording(columns, units), matrix, hard_iron, dip, accel)
