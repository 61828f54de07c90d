"""A triad that is held by hand, or logged badly: plain equations, nothing of the package."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

G, RATE = 9.81362, 100.0
BIAS = np.array([0.02, -0.03, 0.01]) * G
SCALE = np.array([1.01, 0.99, 1.005])
MISALIGNMENT = np.array([0.01, -0.008, 0.006])
NAMES = [
    *(f"bias_{axis}" for axis in "xyz"),
    *(f"scale_factor_{axis}" for axis in "xyz"),
    *(f"misalignment_{pair}" for pair in ("yx", "zx", "zy")),
]
TRUTH = np.concatenate([BIAS, SCALE, MISALIGNMENT])


@dataclass(frozen=True)
class Hand:
    """How a unit is held: sway below about 0.5 Hz in rad rms, tilts and accelerations at 8 Hz, in rad and m/s^2."""

    sway: float = 0.0
    tilt: float = 0.0
    shake: float = 0.0
    noise: float = 0.3e-3 * G
    hold: float = 6.0
    count: int = 24


def slow(rng: np.random.Generator, count: int, frequency: float) -> np.ndarray:
    """Noise of about unit variance below a frequency, (count, 3): white noise shaped in its spectrum."""
    size = 8 * count
    f = np.fft.rfftfreq(size, 1 / RATE)
    shape = 1 / (1 + (f / frequency) ** 4)
    wave = np.fft.irfft(shape[:, None] * np.fft.rfft(rng.standard_normal((size, 3)), axis=0), size, axis=0)
    return wave[:count] / np.sqrt((shape**2).sum() / (size / 2))


def turned(vector: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """A vector (3,) turned by rotation vectors (n, 3): Rodrigues."""
    size = np.linalg.norm(angles, axis=1, keepdims=True)
    axis = angles / np.maximum(size, 1e-300)
    along = axis * (axis @ vector)[:, None]
    return along + np.cos(size) * (vector - along) + np.sin(size) * np.cross(axis, vector)


def samples(seed: int, hand: Hand) -> tuple[np.ndarray, np.ndarray]:
    """Time (n,) and outputs (n, 3), m/s^2, of a tumble test."""
    rng = np.random.default_rng(seed)
    up = rng.standard_normal((hand.count, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    resting, moving = round(hand.hold * RATE), round(1.5 * RATE)
    time = np.arange(resting)[:, None] / RATE
    s = ((1 - np.cos(np.pi * (np.arange(moving) + 0.5) / moving)) / 2)[:, None]
    parts = []
    for here, there in zip(up, np.roll(up, -1, axis=0), strict=True):
        wave = np.cos(2 * np.pi * 8.0 * time + rng.uniform(0, 2 * np.pi, (2, 1, 3)))
        angles = hand.sway * slow(rng, resting, 0.5) + hand.tilt * wave[0]
        parts.append(G * turned(here, angles) + hand.shake * wave[1])
        angle = np.arccos(here @ there)
        path = (np.sin((1 - s) * angle) * here + np.sin(s * angle) * there) / np.sin(angle)
        parts.append(G * path + 0.6 * np.sin(2 * np.pi * s * np.array([1.3, 2.9, 6.1])))
    force = np.vstack(parts)
    yx, zx, zy = MISALIGNMENT
    sensed = force @ np.array([[1, 0, 0], [yx, 1, 0], [zx, zy, 1]]).T
    outputs = SCALE * (sensed + BIAS) + hand.noise * rng.standard_normal(force.shape)
    return np.arange(len(outputs)) / RATE, outputs
