"""Error model of an accelerometer triad, inverted: outputs to specific force.

    s = T f,  T = [[1, 0, 0], [m_yx, 1, 0], [m_zx, m_zy, 1]]
    A_i = s_i + k2_i s_i^2 + ... + ke_i s_i^e
    M_i = S_i (A_i + b_i)

The gauge: the x input axis is the body x axis, the y input axis lies in the body xy plane (IEEE Std 1293 calls the
off-diagonals input-axis misalignments). Gravity's magnitude cannot see a rotation of the whole triad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.recording import Array

AXES = ("x", "y", "z")
MISALIGNMENTS = ("yx", "zx", "zy")
HIGHEST_ORDER = 5
GAUGE = "x input axis along body x, y input axis in the body xy plane"
_NEWTON_STEPS = 12
_CLOSE = 1e-15


def parameter_count(order: int) -> int:
    """Return the number of parameters of the model, 3 (order + 2)."""
    return 3 * (order + 2)


def parameter_names(order: int) -> list[str]:
    """Return the names of the parameters in the order of the parameter vector."""
    return [
        *(f"bias_{axis}" for axis in AXES),
        *(f"scale_factor_{axis}" for axis in AXES),
        *(f"misalignment_{pair}" for pair in MISALIGNMENTS),
        *(f"k{power}_{axis}" for power in range(2, order + 1) for axis in AXES),
    ]


def parameter_units(order: int, output: str) -> list[str]:
    """Return the units of the parameters in a record, in the same order."""
    nonlinearity = ["1/(m/s^2)" if j == 1 else f"1/(m/s^2)^{j}" for j in range(1, order)]
    return ["m/s^2"] * 3 + [f"{output}/(m/s^2)"] * 3 + ["rad"] * 3 + [unit for unit in nonlinearity for _ in AXES]


@dataclass(frozen=True)
class Inversion:
    """Specific force of a batch of outputs, and what its derivatives need.

    All of shape (..., 3): `force` f, `sensed` s along the input axes, `slope` dA/ds.
    """

    force: Array
    sensed: Array
    slope: Array


def invert(reading: Array, misalignment: Array, nonlinearity: Array) -> Inversion:
    """Invert the model from ``A = M / S - b`` to the specific force.

    Newton's method on each axis's polynomial, then forward substitution; NaN passes into the components it touches.

    Parameters
    ----------
    reading
        A, shape (..., 3).
    misalignment
        m_yx, m_zx, m_zy, shape (..., 3).
    nonlinearity
        k2 ... ke, shape (..., e - 1, 3), in the inverse powers of the unit of `reading`.
    """
    sensed, slope = _solve_polynomial(reading, nonlinearity)
    with np.errstate(over="ignore", invalid="ignore"):
        x = sensed[..., 0]
        y = sensed[..., 1] - misalignment[..., 0] * x
        z = sensed[..., 2] - misalignment[..., 1] * x - misalignment[..., 2] * y
    return Inversion(np.stack([x, y, z], axis=-1), sensed, slope)


def _solve_polynomial(reading: Array, nonlinearity: Array) -> tuple[Array, Array]:
    """Solve ``s + k2 s^2 + ... = A`` for s; return s and the slope there."""
    powers = nonlinearity.shape[-2]
    if powers == 0:
        return reading, np.ones_like(reading)
    s = reading
    size = _CLOSE * np.maximum(np.abs(reading), 1.0)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            value, slope = _polynomial(s, nonlinearity)
            step = (value - reading) / slope
            # Each element stops by itself, so that its result does not depend on its neighbours.
            moving = np.abs(step) > size
            s = np.where(moving | np.isnan(step), s - step, s)
            if not moving.any():
                break  # and the slope is that at s
        else:
            slope = _polynomial(s, nonlinearity)[1]
        # Where the polynomial turns back there is no specific force that gives this output.
        solved = (slope > 0) & ~moving
        return np.where(solved, s, np.nan), np.where(solved, slope, np.nan)


def _polynomial(s: Array, nonlinearity: Array) -> tuple[Array, Array]:
    """Value and slope of ``s + k2 s^2 + ... + ke s^e`` by Horner's scheme."""
    # value = k2 + k3 s + ..., so that the polynomial is s (1 + s value); Horner's first two rows are written out.
    count = nonlinearity.shape[-2]
    value = nonlinearity[..., count - 1, :]
    if count == 1:
        scaled = s * value
        return s * (1 + scaled), 1 + (scaled + scaled)
    slope = value
    value = value * s + nonlinearity[..., count - 2, :]
    for index in reversed(range(count - 2)):
        slope = slope * s + value
        value = value * s + nonlinearity[..., index, :]
    return s * (1 + s * value), 1 + s * (2 * value + s * slope)


def norm_and_jacobian(theta: Array, reading: Array, order: int) -> tuple[Array, Array, Inversion, Array]:
    """Return |f| and its derivatives for a batch of parameter vectors.

    Parameters
    ----------
    theta
        Scaled parameters, shape (b, p): zero (in the unit of `reading`), relative scale factor, misalignment,
        nonlinearity.
    reading
        Outputs, shape (b, n, 3), already divided by a nominal scale factor.
    order
        Order e of the model.

    Returns
    -------
    tuple
        |f| (b, n); its derivatives with respect to theta (b, n, p); the inversion; ``q = d|f|/d reading`` (b, n, 3).
    """
    scale = theta[:, None, 3:6]
    misalignment = theta[:, None, 6:9]
    nonlinearity = theta[:, None, 9:].reshape(len(theta), 1, order - 1, 3)
    a = (reading - theta[:, None, 0:3]) / scale
    inversion = invert(a, misalignment, nonlinearity)
    f, s = inversion.force, inversion.sensed
    norm = np.maximum(np.sqrt(np.einsum("bni,bni->bn", f, f)), np.finfo(float).tiny)
    u = f / norm[:, :, None]
    # v solves T' v = u, so that d|f| = v . (ds - dT f)
    v = np.empty_like(u)
    v[..., 2] = u[..., 2]
    v[..., 1] = u[..., 1] - misalignment[..., 2] * v[..., 2]
    v[..., 0] = u[..., 0] - misalignment[..., 0] * v[..., 1] - misalignment[..., 1] * v[..., 2]
    per_reading = v / inversion.slope
    q = per_reading / scale
    jacobian = np.empty((*norm.shape, theta.shape[1]))
    jacobian[..., 0:3] = -q
    jacobian[..., 3:6] = -q * a
    jacobian[..., 6] = -v[..., 1] * f[..., 0]
    jacobian[..., 7] = -v[..., 2] * f[..., 0]
    jacobian[..., 8] = -v[..., 2] * f[..., 1]
    power = s
    for j in range(order - 1):
        power = power * s
        jacobian[..., 9 + 3 * j : 12 + 3 * j] = -per_reading * power
    return norm, jacobian, inversion, q
