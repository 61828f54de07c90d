"""Accelerometers and magnetometers at rest: what one attitude says of both triads.

    s = T m,  A_i = s_i (+ k2_i s_i^2),  M_i = S_i A_i + h_i          both triads, with a T of their own

Gravity and the field have one magnitude each, and one angle between them, in every attitude:

    r0 = |f| - 1,   r1 = |m| - 1,   r2 = dip(u, e) - delta,   dip = atan2(-u.e, |u x e|),   u = m/|m|, e = f/|f|

in units of gravity, of the field, and rad. The dip is positive where the field points down.

Sources: Gebre-Egziabher et al., J. Aerosp. Eng. 19 (2006) 87 (magnitude); Vasconcelos et al., IEEE Trans. Aerosp.
Electron. Syst. 47 (2011) 1293 (soft iron as one matrix); Liu et al., Sensors 14 (2014) 8485 (constant angle to
gravity).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.procedures.tumble.model import invert
from imulab.recording import Array

Pairs = tuple[tuple[int, int], ...]
ACCELEROMETERS: Pairs = ((1, 0), (2, 0), (2, 1))
"""Misalignments m_yx, m_zx, m_zy of the triad that defines the body frame."""
MAGNETOMETERS: Pairs = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Misalignments of a triad that is turned into that frame: field along j sensed by magnetometer i."""
_AXES = "xyz"


@dataclass(frozen=True)
class Vectors:
    """The vector that a triad measures, shape (n, 3), and what its derivatives are made of.

    ``dv = T^-1 (ds - dT v)``, ``ds = (dA - sum dk_j s^j) / A'(s)``: `back` is ``T^-1``, `slope` is A'(s), `reading` A.
    """

    vector: Array
    back: Array
    slope: Array
    reading: Array
    s: Array
    scale: Array
    pairs: Pairs
    highest: int

    def slopes(self, gradient: Array) -> tuple[Array, Array]:
        """Return how something changes with parameters and outputs, of its gradients by the vector.

        Shape (n, k, 3) to (n, k, p), in the order zero (3), scale (3), misalignments, nonlinearity, and (n, k, 3).
        """
        along = gradient @ self.back
        steep = along / self.slope[:, None, :]
        by_output = steep / self.scale
        i, j = np.transpose(self.pairs).tolist()
        columns = [-by_output, -by_output * self.reading[:, None, :], -along[:, :, i] * self.vector[:, None, j]]
        columns += [-steep * (self.s**power)[:, None, :] for power in range(2, self.highest + 1)]
        return np.concatenate(columns, axis=2), by_output

    @property
    def by_parameters(self) -> Array:
        """Derivatives of the vector, shape (n, 3, p)."""
        return self.slopes(np.broadcast_to(np.eye(3), (len(self.vector), 3, 3)))[0]


def triad(theta: Array, output: Array, pairs: Pairs) -> Vectors:
    """Invert a triad's model: ``v = T^-1 s``.

    Parameters
    ----------
    theta
        Zero, scale, a misalignment for each of `pairs`, then k2 of three axes, k3 ..., shape (p,).
    output
        Shape (n, 3).
    pairs
        Places (i, j) of T's free off-diagonals.
    """
    fixed = 6 + len(pairs)
    scale, powers = theta[3:6], theta[fixed:].reshape(-1, 3)
    reading = (output - theta[:3]) / scale
    s = reading if not len(powers) else invert(reading, np.zeros(3), powers).force
    turn = np.eye(3)
    turn[tuple(np.transpose(pairs))] = theta[6:fixed]
    back = np.asarray(np.linalg.inv(turn), dtype=np.float64)
    slope = 1.0 + sum((j * k * s ** (j - 1) for j, k in enumerate(powers, start=2)), np.zeros_like(s))
    return Vectors(s @ back.T, back, slope, reading, s, scale, pairs, len(powers) + 1)


@dataclass(frozen=True)
class Layout:
    """Where the parameters stand: magnetometers' (m), the dip, accelerometers' (f), and of directions held (d)."""

    mag: int
    accel: int
    directions: int = 0

    @property
    def dip_at(self) -> int:
        """Place of the dip."""
        return self.mag

    @property
    def of_accel(self) -> slice:
        """Places of the accelerometers' parameters."""
        return slice(self.mag + 1, self.mag + 1 + self.accel)

    @property
    def of_directions(self) -> slice:
        """Places of the parameters of directions held."""
        return slice(self.mag + 1 + self.accel, self.size)

    @property
    def size(self) -> int:
        """Number of all parameters."""
        return self.mag + 1 + self.accel + self.directions


@dataclass(frozen=True)
class Invariants:
    """Residuals of both triads in each attitude and their derivatives.

    `residuals` has shape (n, k): |f| - 1, |m| - 1, dip - delta, and what else is held. `by_parameters` has shape
    (n, k, p); `by_outputs`, shape (n, 3, 6), is that of the first three by the outputs of the accelerometers and then
    of the magnetometers. `force` and `field` are f and m with their derivatives.
    """

    residuals: Array
    by_parameters: Array
    by_outputs: Array
    force: Vectors
    field: Vectors


def dips(field: Array, force: Array) -> Array:
    """Return ``atan2(-u.e, |u x e|)``, rad, shape (n,): positive where the field points against the specific force."""
    turn, back = [1, 2, 0], [2, 0, 1]
    across = field[:, turn] * force[:, back] - field[:, back] * force[:, turn]  # np.cross takes four times as long
    angle: Array = np.arctan2(-(field * force).sum(axis=1), np.sqrt((across**2).sum(axis=1)))
    return angle


def invariants(theta: Array, accel: Array, mag: Array, layout: Layout) -> Invariants:
    """Return residuals and derivatives at a parameter vector.

    ``dr0 = e' df``, ``dr1 = u' dm``, ``dr2 = t' dm/|m| + v' df/|f| - d(delta)`` with
    ``t = -(e + u sin dip) / cos dip``, ``v = -(u + e sin dip) / cos dip``.

    Parameters
    ----------
    theta
        Shape (p,), as `layout` says.
    accel, mag
        Outputs, scaled so that vectors have a length of about 1, shape (n, 3).
    layout
        Places of the parameters.
    """
    m = triad(theta[: layout.mag], mag, MAGNETOMETERS)
    f = triad(theta[layout.of_accel], accel, ACCELEROMETERS)
    m_length, f_length = (np.sqrt((of.vector**2).sum(axis=1)) for of in (m, f))
    u, e = m.vector / m_length[:, None], f.vector / f_length[:, None]
    dip = dips(m.vector, f.vector)
    sine, cosine = np.sin(dip)[:, None], np.cos(dip)[:, None]
    t = -(e + u * sine) / cosine / m_length[:, None]
    v = -(u + e * sine) / cosine / f_length[:, None]
    by_parameters, by_outputs = np.zeros((len(mag), 3, layout.size)), np.zeros((len(mag), 3, 6))
    by_parameters[:, ::2, layout.of_accel], by_outputs[:, ::2, :3] = f.slopes(np.stack([e, v], axis=1))
    by_parameters[:, 1:, : layout.mag], by_outputs[:, 1:, 3:] = m.slopes(np.stack([u, t], axis=1))
    by_parameters[:, 2, layout.dip_at] = -1.0
    residuals = np.column_stack([f_length - 1, m_length - 1, dip - theta[layout.dip_at]])
    return Invariants(residuals, by_parameters, by_outputs, f, m)


def mag_names(order: int) -> list[str]:
    """Return the names of the magnetometers' parameters in a record, and of the dip."""
    return [
        *(f"mag_bias_{axis}" for axis in _AXES),
        *(f"mag_scale_factor_{axis}" for axis in _AXES),
        *(f"mag_misalignment_{_AXES[i]}{_AXES[j]}" for i, j in MAGNETOMETERS),
        *(f"mag_k2_{axis}" for axis in _AXES if order == 2),
        "dip",
    ]
