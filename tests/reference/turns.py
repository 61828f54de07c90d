"""A six-axis unit that is turned from hold to hold: its motion and its outputs, in plain NumPy.

Each turn is about an axis fixed in the body, with rate proportional to ``1 - cos``: the direction of gravity is then
known at every instant without any integration. The unit is carried around a point beside it, so that the
accelerometers feel the motion too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
GRAVITY = 9.80665


@dataclass(frozen=True)
class Unit:
    """True errors of a unit, SI."""

    accel_bias: Array
    accel_scale: Array
    scale: Array
    misalignment: Array
    bias: Array
    sensitivity: Array
    arm: Array


def random_unit(rng: np.random.Generator, sensitivity: float = 0.0) -> Unit:
    """Draw a unit; `sensitivity` is the standard deviation of its g-sensitivities, rad/s/(m/s^2)."""
    misalignment = np.eye(3) + np.where(np.eye(3) > 0, 0.0, rng.normal(0, 0.01, (3, 3)))
    return Unit(
        accel_bias=rng.normal(0, 0.1, 3),
        accel_scale=1 + rng.normal(0, 0.01, 3),
        scale=1 + rng.normal(0, 0.01, 3),
        misalignment=misalignment,
        bias=rng.normal(0, np.radians(0.2), 3),
        sensitivity=sensitivity * rng.standard_normal((3, 3)),
        arm=rng.normal(0, 0.1, 3),
    )


@dataclass(frozen=True)
class Path:
    """Directions of gravity at rest (n, 3), axes of the turns between (n - 1, 3), angles and durations of the turns."""

    up: Array
    axis: Array
    angle: Array
    duration: Array
    hold: float

    @property
    def begin(self) -> Array:
        """Start of each turn, s, shape (n - 1,)."""
        return self.hold + np.concatenate([[0.0], np.cumsum(self.duration + self.hold)[:-1]])

    @property
    def end(self) -> float:
        """Of the recording, s."""
        return float(self.begin[-1] + self.duration[-1] + self.hold)


def _turned(v: Array, axis: Array, angle: Array) -> Array:
    """Body components of fixed directions v after the body turned about an axis in it by an angle (Rodrigues)."""
    c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
    return v * c - np.cross(axis, v) * s + axis * np.sum(axis * v, axis=-1)[..., None] * (1 - c)


def random_path(
    rng: np.random.Generator, holds: int = 24, hold: float = 3.0, turn: tuple[float, float] = (1.2, 3.0)
) -> Path:
    """Draw a path over the sphere: turns by 60 to 150 degrees about axes across the vertical, mostly."""
    up, axes, angles = [np.array([0.0, 0.0, 1.0])], [], []
    while len(up) < holds:
        axis = rng.standard_normal(3)
        axis -= 0.8 * up[-1] * (axis @ up[-1])
        axis /= np.linalg.norm(axis)
        angle = rng.uniform(np.radians(60), np.radians(150))
        new = _turned(up[-1], axis, np.array(angle))
        if max(new @ old for old in up) > np.cos(np.radians(18)) and rng.random() < 0.9:
            continue
        up.append(new)
        axes.append(axis)
        angles.append(angle)
    duration = rng.uniform(*turn, holds - 1)
    return Path(np.array(up), np.array(axes), np.array(angles), duration, hold)


def motion(path: Path, time: Array, arm: Array) -> tuple[Array, Array]:
    """Body rate, rad/s, and specific force, m/s^2, at given times, both (n, 3)."""
    begin = path.begin
    turn = np.clip(np.searchsorted(begin, time, side="right") - 1, 0, len(begin) - 1)
    share = np.clip((time - begin[turn]) / path.duration[turn], 0.0, 1.0)
    done = share - np.sin(2 * np.pi * share) / (2 * np.pi)
    speed = (path.angle / path.duration)[turn] * (1 - np.cos(2 * np.pi * share))
    faster = (2 * np.pi * path.angle / path.duration**2)[turn] * np.sin(2 * np.pi * share)
    axis = path.axis[turn]
    rate, change = axis * speed[:, None], axis * faster[:, None]
    up = _turned(path.up[turn], axis, path.angle[turn] * done)
    return rate, GRAVITY * up + np.cross(change, arm) + np.cross(rate, np.cross(rate, arm))


def gyroscopes(
    unit: Unit,
    path: Path,
    time: Array,
    rng: np.random.Generator,
    noise: float = np.radians(0.05),
    *,
    cubic: float = 0.0,
    limit: float | None = None,
) -> dict[str, Array]:
    """What the gyroscopes put out, rad/s; `cubic` is the change of the scale factors at 100 deg/s, of each axis."""
    rate, force = motion(path, time, unit.arm)
    sensed = rate @ unit.misalignment.T
    sensed = sensed * (1 + cubic * (sensed / np.radians(100)) ** 2)
    put_out = unit.scale * (sensed + unit.bias + force @ unit.sensitivity.T) + rng.normal(0, noise, rate.shape)
    if limit is not None:
        put_out = np.clip(put_out, -limit, limit)
    return {f"gyro_{a}": put_out[:, i] for i, a in enumerate("xyz")}


def accelerometers(
    unit: Unit, path: Path, time: Array, rng: np.random.Generator, noise: float = 0.7e-3 * GRAVITY
) -> dict[str, Array]:
    """What the accelerometers put out, m/s^2."""
    force = motion(path, time, unit.arm)[1]
    put_out = unit.accel_scale * (force + unit.accel_bias) + rng.normal(0, noise, force.shape)
    return {f"accel_{a}": put_out[:, i] for i, a in enumerate("xyz")}
