"""The fitted curve K(a) = K0 (1 + c1 a + c2 a^2), and which of its terms the levels call for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.errors import OptionError, listed
from imulab.estimation.least_squares import chi_square_limit, chi_square_probability
from imulab.estimation.order_blend import blend
from imulab.procedures.centrifuge.choices import CURVES
from imulab.recording import Array

_NESTED = ("constant", "c1", "c1+c2")
_GAIN = 0.05
_ROUNDING = 1e-9


@dataclass(frozen=True)
class CurveFit:
    """A curve through the K_i of one axis.

    Attributes
    ----------
    model
        Key of `CURVES`.
    coefficients
        Of 1, a, a^2: ``K(a) = p0 + p1 a + p2 a^2``; zero where the model has no such term.
    from_levels
        Matrix that turns the K_i into them, shape (3, n).
    covariance
        Of `coefficients`, shape (3, 3): given the model where it was given; whichever of them is right where it was
        chosen here (`imulab.estimation.order_blend`).
    chi_square, freedom
        Of the residuals.
    tried
        Model, number of coefficients, chi-square and whether it was chosen, of every model that the levels allow.
    """

    model: str
    coefficients: Array
    from_levels: Array
    covariance: Array
    chi_square: float
    freedom: int
    tried: tuple[tuple[str, int, float, bool], ...]

    @property
    def probability(self) -> float | None:
        """Of so large a chi-square if the model holds; None without degrees of freedom."""
        return chi_square_probability(self.chi_square, self.freedom) if self.freedom > 0 else None


def fit_curve(force: Array, K: Array, covariance: Array, model: str = "auto") -> CurveFit:
    """Fit K(a) by generalised least squares.

    A term is taken where it lowers chi-square by more than the 5 % point of chi-square with one degree of freedom;
    where even the largest model leaves more scatter than the covariance explains, chi-square counts in units of that
    scatter (F-test). What is chosen so has its own values, and the uncertainty of all models together.

    Parameters
    ----------
    force
        Specific force of the levels, m/s^2, shape (n,).
    K, covariance
        Shapes (n,), (n, n).
    model
        ``auto``, ``constant``, ``c1``, ``c2`` or ``c1+c2``.

    Raises
    ------
    OptionError
        The model is unknown, or has more coefficients than there are levels.
    """
    if model != "auto" and model not in CURVES:
        raise OptionError(f"curve {model!r}: expected one of {listed(('auto', *CURVES), model)}")
    if model != "auto" and len(CURVES[model]) + 1 > len(K):
        raise OptionError(f"curve {model!r}: {len(K)} levels; expected at least {len(CURVES[model]) + 1}")
    names = [name for name, terms in CURVES.items() if len(terms) + 1 <= max(len(K) - 1, 1) or name == model]
    whitened = np.asarray(np.linalg.cholesky(_regular(covariance, K)), dtype=np.float64)
    found = {name: _solve(force, K, whitened, CURVES[name]) for name in names}
    chosen = model
    if model == "auto":
        largest = max(names, key=lambda name: len(CURVES[name]))
        freedom = len(K) - 1 - len(CURVES[largest])
        scale = max(1.0, min(value[2] for value in found.values()) / freedom) if freedom > 0 else 1.0
        chosen = min(names, key=lambda name: found[name][2] / scale + chi_square_limit(1, _GAIN) * len(CURVES[name]))
    coefficients, matrix, chi_square = found[chosen]
    given = matrix @ covariance @ matrix.T
    return CurveFit(
        chosen, coefficients, matrix,
        _blended(force, K, whitened, covariance, coefficients, given) if model == "auto" else given,
        chi_square, len(K) - 1 - len(CURVES[chosen]),
        tuple((name, 1 + len(CURVES[name]), found[name][2], name == chosen) for name in names),
    )  # fmt: skip


def _blended(force: Array, K: Array, root: Array, covariance: Array, chosen: Array, given: Array) -> Array:
    """Covariance of the chosen coefficients whichever model is right: nowhere less than that given the model."""
    nested = [name for name in _NESTED if len(CURVES[name]) < len(K)]
    steps = [_solve(force, K, root, CURVES[name]) for name in nested]
    squares = np.array([chi_square for *_, chi_square in steps])
    found = blend(
        np.array([coefficients for coefficients, *_ in steps]),
        np.array([matrix @ covariance @ matrix.T for _, matrix, _ in steps]),
        -np.diff(squares), np.ones(len(steps) - 1), prior=0.0,
    )  # fmt: skip
    scale = np.max(force) ** np.arange(3.0)
    values, vectors = np.linalg.eigh((found.about(chosen) - given) * np.outer(scale, scale))
    more: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(scale, scale)
    return given + more


def _regular(covariance: Array, K: Array) -> Array:
    """Keep a covariance of (nearly) noise-free data invertible, and rounding from looking significant."""
    floor = max(float(np.diagonal(covariance).max()) * 1e-12, (_ROUNDING * float(np.abs(K).max())) ** 2, 1e-60)
    regular: Array = covariance + floor * np.eye(len(covariance))
    return regular


def _solve(force: Array, K: Array, root: Array, terms: tuple[int, ...]) -> tuple[Array, Array, float]:
    top = float(force.max())
    powers = (0, *terms)
    design = np.stack([(force / top) ** power for power in powers], axis=1)
    white = np.linalg.solve(root, design)
    matrix = np.zeros((3, len(K)))
    matrix[list(powers)] = np.linalg.pinv(white) @ np.linalg.inv(root) / (top ** np.array(powers, dtype=float))[:, None]
    coefficients = matrix @ K
    left = np.linalg.solve(root, K - design @ (coefficients[list(powers)] * top ** np.array(powers, dtype=float)))
    return coefficients, matrix, float(left @ left)
