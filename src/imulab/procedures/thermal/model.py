"""Tumble's error model with parameters that follow the temperature, and the specific force with its derivatives.

    M = S(T) (A + b(T)),  A = s,  s = [[1, 0, 0], [m_yx(T), 1, 0], [m_zx(T), m_zy(T), 1]] f

Each parameter is a polynomial of ``theta = (T - T0) / H`` from -1 to 1, T0 the middle of the measured range and H half
of it; the fit works in Chebyshev polynomials, records hold powers of T - T0. Outside the range the law's value at its
end is held. A turn of the whole triad by heat is not seen (gauge).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from imulab.recording import Array

AXES = ("x", "y", "z")
MISALIGNMENTS = tuple(f"gyro_misalignment_{a}{b}" for a in AXES for b in AXES if a != b)
SENSITIVITIES = tuple(f"gyro_g_sensitivity_{a}{b}" for a in AXES for b in AXES)
"""Of gyroscopes, in the order of their parameters."""
GROUPS = (("bias", AXES), ("scale_factor", AXES), ("misalignment", ("yx", "zx", "zy")))
"""Kinds of parameters, three each, in the order of the parameter vector."""


@dataclass(frozen=True)
class Laws:
    """The range of temperature, degC, and the degrees of the polynomials of bias, scale factor and misalignment."""

    low: float
    high: float
    degrees: tuple[int, int, int]

    @property
    def middle(self) -> float:
        """T0, degC."""
        return 0.5 * (self.low + self.high)

    @property
    def half(self) -> float:
        """H, K."""
        return 0.5 * (self.high - self.low)

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return 3 * sum(degree + 1 for degree in self.degrees)

    def place(self, temperature: Array) -> Array:
        """Return theta, clipped to the range."""
        place: Array = np.clip((temperature - self.middle) / self.half, -1.0, 1.0)
        return place

    def design(self, temperature: Array) -> Array:
        """Return the derivatives of the nine parameters by the coefficients, shape (n, 9, size)."""
        return self._spread(np.asarray(chebyshev.chebvander(self.place(temperature), max(self.degrees)), np.float64))

    def slope(self, temperature: Array) -> Array:
        """Return the derivatives of `design` by the temperature, 1/K."""
        highest = max(self.degrees)
        change = chebyshev.chebder(np.eye(highest + 1)) if highest else np.zeros((1, 1))
        values = chebyshev.chebvander(self.place(temperature), max(highest - 1, 0)) @ change
        return self._spread(values / self.half)

    def _spread(self, functions: Array) -> Array:
        design, at = np.zeros((len(functions), 9, self.size)), 0
        for group, degree in enumerate(self.degrees):
            for axis in range(3):
                design[:, 3 * group + axis, at : at + degree + 1] = functions[:, : degree + 1]
                at += degree + 1
        return design

    def to_powers(self) -> Array:
        """Return the matrix from the fit's coefficients to those of powers of T - T0 in K, shape (size, size)."""
        matrix, at = np.zeros((self.size, self.size)), 0
        for degree in self.degrees:
            block = np.zeros((degree + 1, degree + 1))
            for k in range(degree + 1):
                powers = chebyshev.cheb2poly([0.0] * k + [1.0])
                block[: len(powers), k] = powers
            block /= self.half ** np.arange(degree + 1.0)[:, None]
            for _ in AXES:
                matrix[at : at + degree + 1, at : at + degree + 1] = block
                at += degree + 1
        return matrix

    def names(self) -> list[str]:
        """Return the names of the coefficients in a record: ``bias_x``, ``bias_x_t1`` (per K), ``bias_x_t2`` ..."""
        return [
            f"{kind}_{axis}" + (f"_t{power}" if power else "")
            for (kind, axes), degree in zip(GROUPS, self.degrees, strict=True)
            for axis in axes
            for power in range(degree + 1)
        ]

    def spoken(self) -> list[str]:
        """Return what messages call the coefficients."""
        changes = ("", "change of {} with temperature", "curvature of {} with temperature")
        return [
            changes[min(power, 2)].format(name) if power else name
            for (kind, axes), degree in zip(GROUPS, self.degrees, strict=True)
            for name in (f"{kind}_{axis}" for axis in axes)
            for power in range(degree + 1)
        ]

    def units(self, output: str) -> list[str]:
        """Return the units of the coefficients in a record."""
        own = ("m/s^2", f"{output}/(m/s^2)", "rad")
        per = ("", "/K", "/K^2", "/K^3", "/K^4", "/K^5")
        return [
            unit + per[power]
            for unit, degree in zip(own, self.degrees, strict=True)
            for _ in AXES
            for power in range(degree + 1)
        ]


def law_names(name: str, unit: str, degree: int) -> tuple[list[str], list[str]]:
    """Return the names and units of the coefficients of one law: ``NAME`` and ``NAME_t1`` (per K) ..."""
    names = [name, *(f"{name}_t{power}" for power in range(1, degree + 1))]
    return names, [unit, *(f"{unit}/K" + (f"^{power}" if power > 1 else "") for power in range(1, degree + 1))]


def forces(parameters: Array, reading: Array) -> tuple[Array, Array]:
    """Return the specific force and its derivatives by the parameters.

    Parameters
    ----------
    parameters
        Bias, scale factor relative to the nominal one, misalignment, shape (n, 9), in units of g.
    reading
        Outputs over the nominal scale factor, in g, shape (n, 3).

    Returns
    -------
    tuple
        f (n, 3), in g; df/dp (n, 3, 9); the derivatives of f by the bias are the negative of T^-1.
    """
    bias, scale, m = parameters[:, :3], parameters[:, 3:6], parameters[:, 6:9]
    sensed = reading / scale - bias
    inverse = np.zeros((len(reading), 3, 3))
    inverse[:, range(3), range(3)] = 1.0
    inverse[:, 1, 0], inverse[:, 2, 1] = -m[:, 0], -m[:, 2]
    inverse[:, 2, 0] = m[:, 2] * m[:, 0] - m[:, 1]
    force: Array = np.einsum("nij,nj->ni", inverse, sensed)
    change = np.zeros((len(reading), 3, 9))
    change[:, :, 0:3] = -inverse
    change[:, :, 3:6] = -inverse * ((sensed + bias) / scale)[:, None, :]
    change[:, :, 6] = -inverse[:, :, 1] * force[:, :1]
    change[:, :, 7] = -inverse[:, :, 2] * force[:, :1]
    change[:, :, 8] = -inverse[:, :, 2] * force[:, 1:2]
    return force, change
