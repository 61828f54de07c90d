"""The triads of a unit as matrices, as other programs hold them: what a procedure makes of its record for exporters.

Accelerometers: ``s = T f``, ``A = s + k2 s^2 + ...``, ``M = S (A + b)``. Gyroscopes: ``s = T w``,
``M = S (A + b + G f)``. Outputs M are in SI, or in counts or volts. Magnetometers: ``s = T m``, ``A = s + k2 s^2``,
``P M = S (A + b)``.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct, field

from imulab.recording import Array
from imulab.units import STANDARD_GRAVITY, conversion_factor, parse_unit

CROSS_TERMS = ("k_xy", "k_yz", "k_zx")
"""Parameters of the products of two axes."""


class Gyroscopes(Struct, frozen=True):
    """``M = S (A + G f + b)``, ``A = s + k2 s^2 + ...``, ``s = T w``.

    Scale factor S (3,), matrix T (3, 3), g-sensitivity G (3, 3), bias (3,), unit of M, k2 .. ke (e - 1, 3).
    """

    scale: Array
    matrix: Array
    sensitivity: Array
    bias: Array
    unit: str
    nonlinearity: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def gain(self) -> Array:
        """``S T``: output per rate, shape (3, 3)."""
        return self.scale[:, None] * self.matrix


class AccelerometerLaws(Struct, frozen=True):
    """``M = S(T) (T(T) f + b(T))`` over temperature: laws of the nine parameters in powers of theta, unit of M.

    ``theta`` goes from -1 at one of the `knots`, degC, to 1 at the next, and stays at its end outside; `coefficient`
    (pieces, 9, terms) has for each piece between knots the rows b_x b_y b_z, S_x S_y S_z, m_yx m_zx m_zy.
    """

    knots: Array
    coefficient: Array
    unit: str

    @property
    def low(self) -> float:
        """The lower end of the range, degC."""
        return float(self.knots[0])

    @property
    def high(self) -> float:
        """The upper end of the range, degC."""
        return float(self.knots[-1])

    def parameters(self, temperature: Array) -> Array:
        """Return the nine parameters at temperatures (n,), shape (n, 9)."""
        return _in_pieces(self.knots, self.coefficient, temperature)

    def output(self, force: Array, temperature: Array) -> Array:
        """Return the outputs for specific forces (k, 3) at temperatures (n,), shape (n, k, 3)."""
        bias, scale, skew = np.split(self.parameters(temperature)[:, None, :], 3, axis=2)
        yx, zx, zy = np.moveaxis(skew, 2, 0)
        x, y, z = force.T
        sensed = np.stack([x + 0 * yx, yx * x + y, zx * x + zy * y + z], axis=2)
        return np.asarray(scale * (sensed + bias), dtype=np.float64)


def _in_pieces(knots: Array, coefficient: Array, temperature: Array) -> Array:
    """Return laws in pieces between knots, (pieces, rows, terms), at temperatures (n,), shape (n, rows)."""
    held = np.clip(temperature, knots[0], knots[-1])
    piece = np.clip(np.searchsorted(knots, held, side="right") - 1, 0, len(knots) - 2)
    start, stop = knots[piece], knots[piece + 1]
    theta = (2 * held - start - stop) / (stop - start)
    powers = theta[:, None] ** np.arange(coefficient.shape[2])
    laws: Array = np.einsum("nk,nik->ni", powers, coefficient[piece])
    return laws


class GyroscopeLaws(Struct, frozen=True):
    """``M = S(T) (T w + G f + b(T))`` over temperature: laws in powers of theta between `knots`, as of accelerometers.

    The rows of `coefficient` (pieces, 6, terms) are b_x b_y b_z, rad/s, and S_x S_y S_z, unit of M per rad/s; matrix T
    (3, 3) and sensitivity G (3, 3).
    """

    knots: Array
    coefficient: Array
    matrix: Array
    sensitivity: Array
    unit: str

    def at(self, temperature: Array) -> list[Gyroscopes]:
        """Return the triad at temperatures (n,)."""
        law = _in_pieces(self.knots, self.coefficient, temperature)
        return [Gyroscopes(row[3:], self.matrix, self.sensitivity, row[:3], self.unit) for row in law]


class Accelerometers(Struct, frozen=True):
    """``M = S (A + b)``: scale factor (3,), lower-triangular T (3, 3), bias (3,), k2 .. ke (e - 1, 3), unit of M.

    With cross terms `CROSS_TERMS` (3,) in A.
    """

    scale: Array
    matrix: Array
    bias: Array
    nonlinearity: Array
    cross: Array
    unit: str

    @property
    def gain(self) -> Array:
        """``S T``: output per specific force, shape (3, 3)."""
        return self.scale[:, None] * self.matrix

    def output(self, force: Array) -> Array:
        """Return the outputs for specific forces, m/s^2, shape (n, 3)."""
        sensed = force @ self.matrix.T
        reading = sensed + sum(k * sensed ** (power + 2) for power, k in enumerate(self.nonlinearity))
        reading = reading + self.cross * sensed * np.roll(sensed, -1, axis=1)
        output: Array = self.scale * (reading + self.bias)
        return output


class Magnetometers(Struct, frozen=True):
    """Magnetometers ``P M = S (A + b)``, ``A = s + k2 s^2``, ``s = T m``: outputs M in a field m.

    Scale factor S (3,), matrix T (3, 3), bias (3,), k2 (3,), signed permutation P (3, 3), the unit of outputs M, and
    the magnitude of the field, T; None where that is not known, and m is in units of it.
    """

    scale: Array
    matrix: Array
    bias: Array
    quadratic: Array
    axes: Array
    unit: str
    field: float | None

    @property
    def soft_iron(self) -> Array:
        """W of ``m = W (M - h)``, without quadratic terms, shape (3, 3)."""
        w: Array = np.asarray(np.linalg.solve(self.matrix, self.axes / self.scale[:, None]), dtype=np.float64)
        return w

    @property
    def hard_iron(self) -> Array:
        """The h of ``m = W (M - h)``, in the unit of the outputs, shape (3,)."""
        h: Array = self.axes.T @ (self.scale * self.bias)
        return h


class Triads(Struct, frozen=True):
    """The accelerometers of a unit, and its gyroscopes and magnetometers, None where the record has none."""

    accel: Accelerometers
    gyro: Gyroscopes | None
    mag: Magnetometers | None = None


class LinearFit(Struct, frozen=True):
    """Accelerometers fitted again without nonlinearity, or None, and a remark on them.

    `remark` goes on from the parameters that were fitted: ``are those of the whole model: ...``.
    """

    accel: Accelerometers | None
    remark: str


NOT_FITTED = LinearFit(None, "are those of the whole model")
"""Of a procedure that fits nothing anew."""


def output_to_si(unit: str, si: str) -> tuple[float, str]:
    """Return the factor from outputs to SI, and the unit that they then have; counts and volts stay."""
    if parse_unit(unit).quantity == "output":
        return 1.0, parse_unit(unit).symbol
    return conversion_factor(unit, si), si


def text_in_g(force: float) -> str:
    """Return a specific force, m/s^2, in mg or ug, as text."""
    g = force / STANDARD_GRAVITY
    return f"{1e3 * g:.3g} mg" if g >= 1e-3 else f"{1e6 * g:.3g} µg"
