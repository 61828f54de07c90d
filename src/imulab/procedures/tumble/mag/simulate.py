"""Simulated magnetometers on a unit that is turned by hand.

The equation of the model stands here a second time, so that fit and simulation do not share errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.errors import OptionError
from imulab.quantities import in_si
from imulab.recording import Array

_SOFT_IRON = 0.05  # of the scale factor, as some real units have
_HARD_IRON = 0.5  # of the field
_MOUNTING = np.radians(3.0)
_NOISE = 3e-3  # of the field, one sample
_RESOLUTION = 0.02e-6  # T
_STRONGEST = 1e-3  # T


@dataclass(frozen=True)
class HeadingTurns:
    """The turns of a unit from attitude to attitude.

    Attributes
    ----------
    axis, full
        Axis and angle, rad, of the body's turn to the next attitude, shapes (k, 3) and (k,).
    number, progress
        Attitude that each sample is in or leaves, and the part of the turn that is done, shape (n,).
    """

    axis: Array
    full: Array
    number: NDArray[np.int64]
    progress: Array


@dataclass(frozen=True)
class SeenField:
    """Outputs and the field in the body frame, uT, shapes (n, 3), and the parameters that made them."""

    outputs: Array
    field: Array
    truth: dict[str, float]


def simulate_field(
    turns: HeadingTurns, up: Array, field: float | str | Array, dip: float | str, known: Mapping[str, float], seed: int
) -> SeenField:
    """Return outputs in uT, ``M = D m + h`` with soft iron of 5 %, a mounting within degrees and hard iron, and truth.

    Parameters
    ----------
    turns
        Turns of the unit.
    up
        Upward direction in the body frame in the first attitude, shape (3,).
    field, dip
        Magnitude, T, and dip, rad; or the field in the body frame in the first attitude, T, shape (3,), which implies
        the dip.
    known
        Parameters of the sensor under the names of a record; random ones if it has no magnetometers.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        Field or dip cannot be.
    """
    dip = in_si(dip, "dip", "angle", "deg")
    if isinstance(field, float | int | str):
        field = in_si(field, "field", "magnetic field", "uT")
    magnitude = float(np.linalg.norm(field))
    if not 0 < magnitude < _STRONGEST:
        raise OptionError(f"field {magnitude:g}: expected its magnitude in T, such as 48e-6 (25e-6 to 65e-6 on Earth)")
    if not abs(dip) < np.pi / 2:
        raise OptionError(f"dip {dip:g}: expected an angle within 90 deg, positive where the field points down")
    rng = np.random.default_rng([seed, 1])
    direction = np.empty((len(turns.full), 3))
    north = np.cross(up, rng.standard_normal(3))
    direction[0] = np.cos(dip) * north / np.linalg.norm(north) - np.sin(dip) * up
    if np.ndim(field):
        direction[0] = np.asarray(field) / magnitude
    for k in range(len(direction) - 1):
        direction[k + 1] = rotate(direction[k : k + 1], turns.axis[k : k + 1], -turns.full[k : k + 1])[0]
    number = turns.number
    m = magnitude * rotate(direction[number], turns.axis[number], -turns.full[number] * turns.progress)
    matrix, hard_iron = _make_sensor(known, magnitude, rng)
    output = m @ matrix.T + hard_iron + _NOISE * magnitude * rng.standard_normal(m.shape)
    sine = -float(direction[0] @ up) / float(np.linalg.norm(up))
    truth = {"dip": dip if np.ndim(field) == 0 else float(np.arcsin(sine))}
    truth |= {f"mag_bias_{a}": float(hard_iron[i] / matrix[i, i]) for i, a in enumerate("xyz")}
    truth |= {f"mag_scale_factor_{a}": float(1e6 * matrix[i, i]) for i, a in enumerate("xyz")}
    truth |= {
        f"mag_misalignment_{'xyz'[i]}{'xyz'[j]}": float(matrix[i, j] / matrix[i, i])
        for i in range(3)
        for j in range(3)
        if i != j
    }
    return SeenField(1e6 * _RESOLUTION * np.round(output / _RESOLUTION), 1e6 * m, truth)


def _make_sensor(known: Mapping[str, float], field: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return matrix and hard iron, T, by the known parameters, or random ones."""
    if "mag_bias_x" in known:
        gain = 1e-6 * np.array([known[f"mag_scale_factor_{a}"] for a in "xyz"])
        turned = np.array([[known.get(f"mag_misalignment_{a}{b}", 1.0) for b in "xyz"] for a in "xyz"])
        return gain[:, None] * turned, gain * np.array([known[f"mag_bias_{a}"] for a in "xyz"])
    matrix = (
        np.eye(3) + _SOFT_IRON * rng.uniform(-1, 1, (3, 3)) + _MOUNTING * np.cross(np.eye(3), rng.uniform(-1, 1, 3))
    )
    return matrix, _HARD_IRON * field * rng.uniform(-1, 1, 3)


def rotate(vectors: Array, axis: Array, angle: Array) -> Array:
    """Return each vector rotated about its axis (Rodrigues)."""
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along = axis * np.einsum("ni,ni->n", axis, vectors)[:, None]
    turned: Array = vectors * cosine + np.cross(axis, vectors) * sine + along * (1 - cosine)
    return turned
