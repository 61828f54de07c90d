"""An array of gyroscopes on a body that is turned by hand, each element late by its own latency: plain NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def moving_array(
    rng: np.random.Generator, time: Array, sensing: Array, late: Sequence[float], noise: float, *, still: bool = False
) -> Array:
    """Readings of elements that sense ``A_i w(t - late_i)``, A of shape (n, axes, axes), with white noise.

    Shape (m, axes, n). The rate is a sum of twelve sines of 0.1 to 1 Hz and 5 to 25 deg/s about each axis.
    """
    n, axes, _ = sensing.shape
    frequency, phase = rng.uniform(0.1, 1.0, (12, axes)), rng.uniform(0, 2 * np.pi, (12, axes))
    size = np.radians(rng.uniform(5, 25, (12, axes))) * (not still)

    def rate(when: Array) -> Array:
        return (size * np.sin(2 * np.pi * frequency * when[:, None, None] + phase)).sum(axis=1)

    seen = np.stack([rate(time - late[i]) @ sensing[i].T for i in range(n)], axis=2)
    return np.asarray(seen + rng.normal(0, noise, seen.shape), dtype=np.float64)


def columns(readings: Array) -> dict[str, Array]:
    """Name readings as a recording does: gyro_1 .., or gyro_x_1 .. on three axes."""
    _, axes, n = readings.shape
    stem = ["gyro"] if axes == 1 else [f"gyro_{a}" for a in "xyz"]
    return {f"{stem[a]}_{i + 1}": readings[:, a, i] for a in range(axes) for i in range(n)}
