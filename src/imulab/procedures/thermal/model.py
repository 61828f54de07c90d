"""Tumble's error model with parameters that follow the temperature, and the specific force with its derivatives.

    M = S(T) (s + b(T)),  s = [[1, 0, 0], [m_yx(T), 1, 0], [m_zx(T), m_zy(T), 1]] f

Each parameter is a polynomial of ``theta = (T - T0) / H`` from -1 to 1, T0 the middle of the measured range and H half
of it. The fit works in Chebyshev polynomials; records hold powers of T - T0. The bias may be a natural cubic spline
instead, whose coefficients are its values at the knots. Outside the range each law keeps its value at the end. A
rotation of the whole triad with temperature is not observable (gauge).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.polynomial import Polynomial, chebyshev

from imulab.recording import Array

AXES = ("x", "y", "z")
MISALIGNMENTS = tuple(f"gyro_misalignment_{a}{b}" for a in AXES for b in AXES if a != b)
SENSITIVITIES = tuple(f"gyro_g_sensitivity_{a}{b}" for a in AXES for b in AXES)
"""Parameters of gyroscopes, in their order."""
GROUPS = (("bias", AXES), ("scale_factor", AXES), ("misalignment", ("yx", "zx", "zy")))
"""Kinds of parameters, three each, in the order of the parameter vector."""
SHARES = np.repeat([1.0, 1 / 3, 1 / 3], len(AXES)) / len(AXES)
"""Shares of the parameters' variances in that of a component of the corrected force, in g, the mean over components
and directions."""


@dataclass(frozen=True)
class Laws:
    """The nine laws: range of temperature, degC, and degrees of bias, scale factor and misalignment.

    With `knots`, degC, from one end of the range to the other, the bias is a natural cubic spline, of degree 3.
    """

    low: float
    high: float
    degrees: tuple[int, int, int]
    knots: tuple[float, ...] = ()

    @property
    def middle(self) -> float:
        """T0, degC."""
        return 0.5 * (self.low + self.high)

    @property
    def half(self) -> float:
        """H, K."""
        return 0.5 * (self.high - self.low)

    @property
    def terms(self) -> tuple[int, int, int]:
        """Number of coefficients of one law of each kind."""
        bias, scale_factor, misalignment = (degree + 1 for degree in self.degrees)
        return len(self.knots) or bias, scale_factor, misalignment

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return 3 * sum(self.terms)

    @property
    def parts(self) -> list[slice]:
        """Places of the coefficients of each of the nine laws."""
        ends = np.cumsum(np.repeat(self.terms, 3)).tolist()
        return [slice(start, stop) for start, stop in zip([0, *ends], ends, strict=False)]

    @property
    def spelled(self) -> str:
        """The laws in the words of the option ``--degrees``: ``3,2,1`` or ``spline,2,1``."""
        bias, *others = map(str, self.degrees)
        return ",".join(["spline" if self.knots else bias, *others])

    def place(self, temperature: Array) -> Array:
        """Return theta, clipped to the range."""
        place: Array = np.clip((temperature - self.middle) / self.half, -1.0, 1.0)
        return place

    def design(self, temperature: Array) -> Array:
        """Return the matrices from the fit's coefficients to the parameters at temperatures, shape (n, 9, size)."""
        functions = np.asarray(chebyshev.chebvander(self.place(temperature), max(self.degrees)), np.float64)
        return self._spread(functions, self.cardinal(temperature) if self.knots else functions)

    def bias_functions(self, temperature: Array) -> Array:
        """Return the functions of a bias's law in the fit, shape (n, terms)."""
        if self.knots:
            return self.cardinal(temperature)
        return np.asarray(chebyshev.chebvander(self.place(temperature), self.degrees[0]), np.float64)

    def slope(self, temperature: Array) -> Array:
        """Return the derivatives of `design` by the temperature, 1/K."""
        highest = max(self.degrees)
        change = chebyshev.chebder(np.eye(highest + 1)) if highest else np.zeros((1, 1))
        values = chebyshev.chebvander(self.place(temperature), max(highest - 1, 0)) @ change / self.half
        return self._spread(values, self.cardinal(temperature, derivative=1) if self.knots else values)

    def cardinal(self, temperature: Array, derivative: int = 0) -> Array:
        """Return the splines that are 1 at one knot and 0 at all others, or their derivatives, shape (n, knots)."""
        splines: Array = cardinal_spline(self.knots)(np.clip(temperature, self.low, self.high), derivative)
        return splines

    def _spread(self, functions: Array, bias_functions: Array) -> Array:
        """Return the functions of all laws at the places of their coefficients, shape (n, 9, size)."""
        design = np.zeros((len(functions), 9, self.size))
        for law, part in enumerate(self.parts):
            design[:, law, part] = (bias_functions if law < 3 else functions)[:, : part.stop - part.start]
        return design

    def constant(self, parameters: Array) -> Array:
        """Return the coefficients of laws that are constant at these nine parameters."""
        coefficients = np.zeros(self.size)
        for law, part in enumerate(self.parts):
            is_spline = law < 3 and self.knots
            coefficients[part if is_spline else part.start] = parameters[law]
        return coefficients

    def to_powers(self) -> Array:
        """Return the matrix from the fit's coefficients to a record's, shape (size, size).

        A record's are coefficients of powers of T - T0 in K, or values at knots.
        """
        matrix = np.zeros((self.size, self.size))
        for law, part in enumerate(self.parts):
            count = part.stop - part.start
            matrix[part, part] = np.eye(count) if law < 3 and self.knots else self._powers(count)
        return matrix

    def _powers(self, count: int) -> Array:
        """Return the matrix from Chebyshev coefficients of one law to those of powers of T - T0."""
        block = np.eye(count)
        for k in range(2, count):  # T_k = 2 x T_k-1 - T_k-2
            block[1:, k] = 2 * block[:-1, k - 1]
            block[:, k] -= block[:, k - 2]
        block /= self.half ** np.arange(float(count))[:, None]
        return block

    def recorded(self, group: int, temperature: Array, about: float) -> Array:
        """Return the functions of one law of a record at temperatures, shape (n, terms).

        `about` is the record's reference temperature, degC.
        """
        if group == 0 and self.knots:
            return self.cardinal(temperature)
        offset = np.clip(temperature, self.low, self.high) - about
        functions: Array = offset[:, None] ** np.arange(self.degrees[group] + 1)
        return functions

    @property
    def edges(self) -> Array:
        """Ends of the pieces of the laws, degC: of the range, or the bias's knots."""
        return np.array(self.knots or (self.low, self.high))

    def in_pieces(self, group: int, coefficients: Array, about: float) -> Array:
        """Return a law of a record in powers of theta, -1 to 1 between two `edges`, shape (pieces, terms).

        `about` is the record's reference temperature, degC.
        """
        edges, is_spline = self.edges.tolist(), bool(group == 0 and self.knots)
        pieces = np.zeros((len(edges) - 1, self.degrees[group] + 1))
        for piece, (start, stop) in enumerate(pairwise(edges)):
            middle, half = 0.5 * (start + stop), 0.5 * (stop - start)
            cubic = cardinal_spline(self.knots).coefficients[:, piece] @ coefficients if is_spline else coefficients
            law = Polynomial(cubic)(Polynomial([middle - (start if is_spline else about), half])).coef
            pieces[piece, : len(law)] = law
        return pieces

    def names(self) -> list[str]:
        """Return the names of the coefficients in a record: ``bias_x``, ``bias_x_t1`` (per K), ``bias_x_t2`` ...

        Values at knots are ``bias_x_at_1``, ``bias_x_at_2`` ...
        """
        return [
            name for group, (kind, axes) in enumerate(GROUPS) for a in axes for name in self.named(group, f"{kind}_{a}")
        ]

    def named(self, group: int, law: str) -> list[str]:
        """Return the names of the coefficients of one law in a record."""
        if group == 0 and self.knots:
            return [f"{law}_at_{number}" for number in range(1, len(self.knots) + 1)]
        return law_names(law, "", self.degrees[group])[0]

    def spoken(self) -> list[str]:
        """Return the names of the coefficients in messages."""
        changes = ("", "change of {} with temperature", "curvature of {} with temperature")
        words = []
        for group, (kind, axes) in enumerate(GROUPS):
            for name in (f"{kind}_{axis}" for axis in axes):
                if group == 0 and self.knots:
                    words += [f"{name} at {knot:.0f} degC" for knot in self.knots]
                else:
                    words += [name, *(changes[min(k, 2)].format(name) for k in range(1, self.degrees[group] + 1))]
        return words

    def units(self, output: str) -> list[str]:
        """Return the units of the coefficients in a record."""
        kinds = enumerate(("m/s^2", f"{output}/(m/s^2)", "rad"))
        return [each for group, unit in kinds for each in 3 * self.measured(group, unit)]

    def measured(self, group: int, unit: str) -> list[str]:
        """Return the units of the coefficients of one law in a record, `unit` that of its values."""
        if group == 0 and self.knots:
            return [unit] * len(self.knots)
        return law_names("", unit, self.degrees[group])[1]


@dataclass(frozen=True)
class CardinalSpline:
    """The natural cubic splines that are 1 at one of n knots and 0 at all others.

    Attributes
    ----------
    knots
        Ascending, shape (n,).
    coefficients
        Of powers 0 to 3 of the distance from a piece's first knot, by piece and spline, shape (4, n - 1, n).
    """

    knots: Array
    coefficients: Array

    def __call__(self, at: Array, derivative: int = 0) -> Array:
        """Return the splines or their first derivatives, shape (m, n); the end pieces go on beyond the knots."""
        piece = np.clip(np.searchsorted(self.knots, at, side="right") - 1, 0, len(self.knots) - 2)
        x = (at - self.knots[piece])[:, None]
        a, b, c, d = self.coefficients[:, piece]
        values: Array = b + x * (2 * c + 3 * x * d) if derivative else a + x * (b + x * (c + x * d))
        return values


@lru_cache(maxsize=256)
def cardinal_spline(knots: tuple[float, ...]) -> CardinalSpline:
    """Return the splines of these knots, two at least.

    The slopes s at the knots make the second derivative continuous, and 0 at both ends (de Boor, A Practical Guide to
    Splines, ch. IV); scipy.interpolate, which has the same, takes as long to load as a fit takes.
    """
    at, value = np.array(knots), np.eye(len(knots))
    step = np.diff(at)[:, None]
    secant = np.diff(value, axis=0) / step
    inverse = 1 / step[:, 0]
    left, right = np.append(inverse, 0.0), np.insert(inverse, 0, 0.0)
    equations = np.diag(2 * (left + right)) + np.diag(inverse, 1) + np.diag(inverse, -1)
    bends = 3 * secant / step
    slopes = np.linalg.solve(equations, np.pad(bends, ((0, 1), (0, 0))) + np.pad(bends, ((1, 0), (0, 0))))
    excess = (slopes[:-1] + slopes[1:] - 2 * secant) / step
    return CardinalSpline(
        at, np.stack([value[:-1], slopes[:-1], (secant - slopes[:-1]) / step - excess, excess / step])
    )


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
