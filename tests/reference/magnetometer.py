"""Magnetometers and accelerometers at rest, simulated and bounded apart from the code under test.

Equations (../shared/methods/magnetometer.md): M = D m + h (+ D k2 terms), f up at rest, m.f = -|m||f| sin(dip).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Truth:
    """One unit: accelerometers (bias g, scale, misalignment yx zx zy, k2 1/g), magnetometers (D, h), dip (rad)."""

    bias: np.ndarray
    scale: np.ndarray
    misalignment: np.ndarray
    k2: np.ndarray
    matrix: np.ndarray
    hard_iron: np.ndarray
    dip: float

    def vector(self) -> np.ndarray:
        """All parameters in one vector: D by rows, h, dip, bias, scale, misalignment, k2."""
        return np.concatenate(
            [self.matrix.ravel(), self.hard_iron, [self.dip], self.bias, self.scale, self.misalignment, self.k2]
        )


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation, uniformly distributed."""
    q = rng.standard_normal(4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def random_unit(rng: np.random.Generator, dip: float, mounting: np.ndarray | None = None, size: float = 50.0) -> Truth:
    """A unit with soft iron of some 10 %, hard iron of about the field, and magnetometers mounted any way."""
    turn = random_rotation(rng) if mounting is None else mounting
    soft = np.eye(3) + 0.1 * rng.uniform(-1, 1, (3, 3))
    return Truth(
        bias=0.02 * rng.standard_normal(3),
        scale=1 + 0.01 * rng.standard_normal(3),
        misalignment=0.01 * rng.standard_normal(3),
        k2=0.003 * rng.standard_normal(3),
        matrix=size * turn @ soft,
        hard_iron=size * rng.uniform(-1, 1, 3),
        dip=dip,
    )


def directions(attitudes: np.ndarray, dip: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Up and field in body components; `attitudes` carry the world (east, north, up) into the body, shape (n, 3, 3)."""
    dip = np.broadcast_to(dip, len(attitudes))
    field = np.stack([np.zeros_like(dip), np.cos(dip), -np.sin(dip)], axis=1)
    return attitudes[:, :, 2], np.einsum("nij,nj->ni", attitudes, field)


def accelerometer_output(truth: Truth, force: np.ndarray) -> np.ndarray:
    """Outputs in units of g."""
    yx, zx, zy = truth.misalignment
    s = force @ np.array([[1, 0, 0], [yx, 1, 0], [zx, zy, 1]]).T
    return truth.scale * (s + truth.k2 * s**2 + truth.bias)


def simulate(
    truth: Truth, attitudes: np.ndarray, rng: np.random.Generator, *, accel: float, field: float, dip: float
) -> tuple[np.ndarray, np.ndarray]:
    """Outputs of both triads, shape (n, 3): noise of an axis, in units of g and of the field, more of dip, rad."""
    n = len(attitudes)
    up, m = directions(attitudes, truth.dip + dip * rng.standard_normal(n))
    outputs = accelerometer_output(truth, up) + accel * rng.standard_normal((n, 3))
    m = m + field * rng.standard_normal((n, 3))
    return outputs, m @ truth.matrix.T + truth.hard_iron


def residuals(vector: np.ndarray, outputs: np.ndarray, mag: np.ndarray) -> np.ndarray:
    """|f| - 1, |m| - 1 and dip less its parameter, shape (n, 3), of a parameter vector as `Truth.vector` has it."""
    matrix, hard_iron, dip = vector[:9].reshape(3, 3), vector[9:12], vector[12]
    bias, scale, (yx, zx, zy), k2 = vector[13:16], vector[16:19], vector[19:22], vector[22:25]
    a = outputs / scale - bias
    s = 2 * a / (1 + np.sqrt(1 + 4 * k2 * a))
    x = s[:, 0]
    y = s[:, 1] - yx * x
    z = s[:, 2] - zx * x - zy * y
    f = np.column_stack([x, y, z])
    m = np.linalg.solve(matrix, (mag - hard_iron).T).T
    lengths = np.linalg.norm(f, axis=1), np.linalg.norm(m, axis=1)
    sine = -np.einsum("ni,ni->n", f, m) / lengths[0] / lengths[1]
    return np.column_stack([lengths[0] - 1, lengths[1] - 1, np.arcsin(sine) - dip])


def bound(truth: Truth, attitudes: np.ndarray, *, accel: float, field: float, dip: float) -> np.ndarray:
    """Cramer-Rao bound of the covariance of `Truth.vector`, by central differences of the residuals.

    The covariance of the three residuals of an attitude is that of the noise of both triads through the same residuals.
    """
    up, m = directions(attitudes, truth.dip)
    outputs, mag = accelerometer_output(truth, up), m @ truth.matrix.T + truth.hard_iron
    vector = truth.vector()

    def slope(function, at):
        columns = []
        for k in range(len(at)):
            step = 1e-6 * max(abs(at[k]), 1e-1)
            high, low = at.copy(), at.copy()
            high[k] += step
            low[k] -= step
            columns.append((function(high) - function(low)) / (2 * step))
        return np.stack(columns, axis=-1)

    by_parameters = slope(lambda v: residuals(v, outputs, mag), vector)
    information = np.zeros((len(vector), len(vector)))
    noise = np.zeros((6, 6))
    noise[:3, :3] = accel**2 * np.eye(3)
    noise[3:, 3:] = field**2 * truth.matrix @ truth.matrix.T
    for i in range(len(attitudes)):
        by_output = slope(
            lambda six, i=i: residuals(vector, six[None, :3], six[None, 3:])[0], np.concatenate([outputs[i], mag[i]])
        )
        variance = by_output @ noise @ by_output.T + np.diag([0.0, 0.0, dip**2])
        information += by_parameters[i].T @ np.linalg.solve(variance, by_parameters[i])
    return np.linalg.inv(information)
