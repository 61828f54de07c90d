"""A nine-parameter gyroscope triad turned by hand between holds: plain quaternions, nothing of the package.

The path is made at eight times the sampling rate; a sample is the mean of its interval, or a point behind a low pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

G, EARTH, FINE = 9.80665, 7.292e-5, 8
PAIRS = [(i, j) for i in range(3) for j in range(3) if i != j]
PROFILES = {
    "raised cosine": lambda x: x - np.sin(2 * np.pi * x) / (2 * np.pi),
    "minimum jerk": lambda x: x**3 * (10 - 15 * x + 6 * x**2),
    "half sine": lambda x: (1 - np.cos(np.pi * x)) / 2,
}


@dataclass(frozen=True)
class Hand:
    """How a unit is turned and sampled; angles in rad, rates in rad/s, times in s.

    `tremor` at 8 Hz and `sway` at half a hertz are rms angles about each axis; `vibration` is the amplitude of what
    23.3 Hz add to the rate; `lost` is the share of samples that is missing, in runs of `run`, without a trace in the
    time stamps; `felt` is the g-sensitivity, rad/s per g.
    """

    profile: str = "raised cosine"
    rate: float = 100.0
    hold: float = 4.0
    turn: float = 2.0
    noise: float = np.radians(0.05)
    accel_noise: float = 0.3e-3 * G
    tremor: float = 0.0
    sway: float = 0.0
    vibration: float = 0.0
    lost: float = 0.0
    run: int = 1
    felt: float = 0.0
    flicker: float = 0.0
    points: bool = False
    count: int = 24


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton's product of quaternions (w, x, y, z)."""
    w = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(axis=-1, keepdims=True)
    v = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([w, v], axis=-1)


def conjugate(q: np.ndarray) -> np.ndarray:
    """The opposite rotation."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def exponential(vector: np.ndarray) -> np.ndarray:
    """The rotation by a rotation vector."""
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) * vector / 2], axis=-1)


def logarithm(q: np.ndarray) -> np.ndarray:
    """The rotation vector of a rotation."""
    q = np.where(q[..., :1] < 0, -q, q)
    size = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    return 2 * np.arctan2(size, q[..., :1]) * q[..., 1:] / np.maximum(size, 1e-300)


def in_body(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Components in the body of a vector of the room; q turns the body's components into those of the room."""
    pure = np.concatenate([np.zeros((*q.shape[:-1], 1)), np.broadcast_to(vector, (*q.shape[:-1], 3))], axis=-1)
    return product(product(conjugate(q), pure), q)[..., 1:]


def attitudes(rng: np.random.Generator, count: int) -> np.ndarray:
    """Attitudes that spread over the sphere in no order, with any heading; the last is the first."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index
    up = np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    up = rng.permutation(up + 0.15 * rng.standard_normal(up.shape))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    size = np.linalg.norm(axis, axis=1, keepdims=True)
    tilt = exponential(axis / np.maximum(size, 1e-12) * np.arctan2(size, up[:, 2:]))
    heading = exponential(rng.uniform(-np.pi, np.pi, (count, 1)) * np.array([0.0, 0.0, 1.0]))
    q = product(heading, tilt)
    q[-1] = q[0]
    return q


def path(rng: np.random.Generator, hand: Hand) -> np.ndarray:
    """Attitude in time, (n, 4), at FINE times the rate: holds, and turns as long as their angle asks."""
    q = attitudes(rng, hand.count)
    fine, parts = hand.rate * FINE, []
    for here, there in zip(q, [*q[1:], None], strict=True):
        parts.append(np.repeat(here[None], round(hand.hold * fine), axis=0))
        if there is None:
            break
        way = logarithm(product(conjugate(here), there))
        seconds = hand.turn * max(1.0, float(np.linalg.norm(way)) / (np.pi / 2))
        share = PROFILES[hand.profile](np.arange(1, round(seconds * fine)) / round(seconds * fine))[:, None]
        bend = np.sin(np.pi * share) * 0.3 * rng.standard_normal(3)
        parts.append(product(product(here, exponential(share * way)), exponential(bend)))
    whole = np.concatenate(parts)
    time = np.arange(len(whole))[:, None] / fine
    moved = np.zeros((len(whole), 3))
    for size, frequency in ((hand.tremor, 8.0), (hand.sway, 0.5)):
        if size:
            moved += size * np.sqrt(2) * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi, 3))
    return product(whole, exponential(moved))


def sampled(fine: np.ndarray, points: bool) -> np.ndarray:
    """Samples of what is known at FINE times the rate: means of the intervals, or points behind a low pass."""
    count = len(fine) // FINE
    if not points:
        return fine[: count * FINE].reshape(count, FINE, -1).mean(axis=1)
    # A Gaussian low pass with half the power at .3 of the sampling rate.
    width = FINE * np.sqrt(np.log(2)) / (2 * np.pi * 0.3)
    reach = np.arange(-round(5 * width), round(5 * width) + 1)
    kernel = np.exp(-((reach / width) ** 2) / 2)
    smooth = [np.convolve(np.pad(c, len(reach) // 2, mode="edge"), kernel / kernel.sum(), "valid") for c in fine.T]
    return np.column_stack(smooth)[FINE // 2 : count * FINE : FINE]


def turned_by_hand(seed: int, hand: Hand) -> tuple[Any, dict[str, float]]:
    """A recording of calibrated accelerometers and of gyroscopes with errors, rad/s, and the truth by name."""
    from imulab.recording import Recording

    rng = np.random.default_rng([seed, 39])
    scale, zero = 1 + 0.005 * rng.standard_normal(3), np.radians(0.2) * rng.standard_normal(3)
    skew = np.eye(3)
    for i, j in PAIRS:
        skew[i, j] = 0.01 * rng.standard_normal()
    felt = hand.felt * rng.standard_normal((3, 3))
    q = path(rng, hand)
    rate = np.vstack([np.zeros(3), logarithm(product(conjugate(q[:-1]), q[1:]))]) * hand.rate * FINE
    rate += in_body(q, EARTH * np.array([np.cos(0.84), 0.0, np.sin(0.84)]))
    force = in_body(q, np.array([0.0, 0.0, G]))
    turns, forces = sampled(rate, hand.points), sampled(force, hand.points)
    time = np.arange(len(turns)) / hand.rate
    outputs = scale * (turns @ skew.T + zero + forces / G @ felt.T) + hand.noise * rng.standard_normal(turns.shape)
    if hand.vibration:
        outputs += hand.vibration * np.sin(2 * np.pi * 23.3 * time[:, None] + rng.uniform(0, 2 * np.pi, 3))
    if hand.flicker:
        f = np.fft.rfftfreq(len(outputs), 1 / hand.rate)
        shape = np.concatenate([[0.0], f[1:] ** -0.5])
        white = np.fft.rfft(rng.standard_normal(outputs.shape), axis=0)
        wave = np.fft.irfft(shape[:, None] * white, len(f) * 2 - 2, axis=0)
        outputs[: len(wave)] += hand.flicker * (wave / wave.std())[: len(outputs)]
    accel = forces + hand.accel_noise * rng.standard_normal(forces.shape)
    kept = np.ones(len(outputs), dtype=bool)
    for first in np.flatnonzero(rng.random(len(outputs)) < hand.lost / hand.run).tolist():
        kept[first : first + hand.run] = False
    columns = {"time": time[: kept.sum()]}
    columns |= {f"accel_{a}": accel[kept, i] for i, a in enumerate("xyz")}
    columns |= {f"gyro_{a}": outputs[kept, i] for i, a in enumerate("xyz")}
    units = {"time": "s"} | {name: "m/s^2" if name[0] == "a" else "rad/s" for name in columns if name != "time"}
    truth = {f"gyro_scale_factor_{a}": float(scale[i]) for i, a in enumerate("xyz")}
    truth |= {f"gyro_misalignment_{'xyz'[i]}{'xyz'[j]}": float(skew[i, j]) for i, j in PAIRS}
    truth |= {f"gyro_bias_{a}": float(zero[i]) for i, a in enumerate("xyz")}
    return Recording(columns, units, name="hand.csv"), truth
