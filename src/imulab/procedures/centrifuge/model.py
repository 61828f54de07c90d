"""What a centrifuge test measures: specific force, the drift K(a) a, and the names of its parameters.

A line at the phase chi is written as the complex number ``Z = A + i B`` for ``A cos chi + B sin chi``. chi is the angle
from the X input axis to the specific force, turning X to Y: ``arg Z`` is where in the gyroscope's frame the drift is
largest. What is fixed in the arm reaches Y a quarter turn after X: Y shows ``i Z`` where X shows ``Z``.

Source: CN102636185A; IEEE Std 813 (two-axis gyroscopes), IEEE Std 836 (precision centrifuge), IEEE Std 528.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from imulab.recording import Array

Force = TypeVar("Force", float, Array)

K_UNIT = "rad/s/(m/s^2)"
CURVE_UNITS = {"K0": K_UNIT, "c1": "1/(m/s^2)", "c2": "1/(m/s^2)^2"}
CROSS_UNIT = "rad/s/(m/s^2)^2"
EARTH_RATE = 7.292115e-5
"""rad/s (WGS 84)."""


def specific_force(arm_rate: float, radius: float) -> float:
    """Return the specific force ``a = w^2 R``, m/s^2, of an arm rate, rad/s, at a radius, m."""
    return arm_rate**2 * radius


def curve(force: Force, K0: float, c1: float = 0.0, c2: float = 0.0) -> Force:
    """Return ``K(a) = K0 (1 + c1 a + c2 a^2)``, rad/s/(m/s^2), at specific forces, m/s^2."""
    return K0 * (1 + (c1 + c2 * force) * force)


def fog_share(axes: int) -> np.ndarray:
    """Return the matrix from the lines of (X, [Y,] FOG) to those of the residuals (X - FOG, [Y - i FOG])."""
    return np.array([[1, 0, -1], [0, 1, -1j]] if axes == 2 else [[1, -1]], dtype=np.complex128)


def real_covariance(covariance: np.ndarray) -> Array:
    """Return the covariance of (Re z_1, Im z_1, Re z_2, ...) of circular complex numbers with ``E[z z*] = covariance``.

    Circular: noise that does not know the phase of the line, so that both of its components are alike.
    """
    size = len(covariance)
    real = np.empty((2 * size, 2 * size))
    real[0::2, 0::2] = real[1::2, 1::2] = covariance.real / 2
    real[1::2, 0::2] = covariance.imag / 2
    real[0::2, 1::2] = -covariance.imag / 2
    return real
