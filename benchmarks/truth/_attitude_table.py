"""Tables of attitudes of a triad with nonlinearity, noise and knocks: written apart from imulab's own models."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

import imulab as il
from imulab.recording import Recording
from imulab.records.calibration import Calibration

G = 9.80665
UG = G * 1e-6
BIAS = tuple(f"bias_{axis}" for axis in "xyz")
SCALE = tuple(f"scale_factor_{axis}" for axis in "xyz")
Array = NDArray[np.float64]


def directions(rng: np.random.Generator, count: int) -> Array:
    """Return attitudes as a hand makes them: spread over the sphere, each off by some degrees."""
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index + rng.uniform(0, 2 * np.pi)
    ring = np.sqrt(1 - height**2)
    u = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height]) + 0.1 * rng.standard_normal((count, 3))
    return rng.permutation(u / np.linalg.norm(u, axis=1)[:, None])


def table(
    rng: np.random.Generator,
    *,
    count: int = 24,
    k2: float = 0.0,
    k3: float = 0.0,
    q: float = 0.0,
    noise: float = 60.0,
    stated: float | None = 1.0,
    knocks: Sequence[tuple[int, float]] = (),
) -> tuple[Recording, dict[str, float]]:
    """Return a table of attitudes and the truth.

    Errors of 1 %, 20 mg and 10 mrad; k2 in ug/g^2, k3 in ug/g^3 and q in ppm with random signs: the scale factor is
    larger by q for positive and smaller by q for negative input; noise in ug; `stated` is the stated
    noise over the true one, or None; a knock lengthens or shortens one attitude's force by so many ug.
    """
    up = directions(rng, count)
    force = G * up
    for index, size in knocks:
        force[index] += size * UG * up[index]
    bias, scale = 0.02 * G * rng.standard_normal(3), 1 + 0.01 * rng.standard_normal(3)
    yx, zx, zy = 0.01 * rng.standard_normal(3)
    s = force.copy()
    s[:, 1] += yx * force[:, 0]
    s[:, 2] += zx * force[:, 0] + zy * force[:, 1]
    second, third = (size * 1e-6 * rng.choice([-1, 1], 3) for size in (k2, k3))
    if q:
        s = s + q * 1e-6 * rng.choice([-1, 1], 3) * np.abs(s)
    output = scale * (s + second / G * s**2 + third / G**2 * s**3 + bias)
    output += noise * UG * rng.standard_normal(output.shape)
    columns = {f"accel_{axis}": output[:, i].copy() for i, axis in enumerate("xyz")}
    if stated is not None:
        columns |= {f"std_accel_{axis}": np.full(count, stated * noise * UG) for axis in "xyz"}
    truth = dict(zip((*BIAS, *SCALE), (*bias.tolist(), *scale.tolist()), strict=True))
    return Recording(columns=columns, units=dict.fromkeys(columns, "m/s^2"), name="table", lines_before=1), truth


def fitted(recording: Recording) -> Calibration:
    """Return the record of a fit with every default."""
    return il.fit_tumble(il.find_attitudes(recording), gravity=G).calibration


def inside(record: Calibration, truth: dict[str, float], names: Sequence[str]) -> tuple[bool, ...]:
    """Return for each parameter whether its stated 95 % interval holds the truth."""
    factor = record.fit["coverage_factor_95"]
    return tuple(
        abs(record.value(name) - truth[name]) <= factor * (record.parameters[name].standard_uncertainty or 0.0)
        for name in names
    )
