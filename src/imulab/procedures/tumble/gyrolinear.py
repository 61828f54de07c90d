"""Whether the scale factors of the gyroscopes change with the rate, from what the turns miss.

    M = S (A + b + even_i A_i^2 / w_i + odd_i A_i^3 / w_i^2),   A = T w,  w_i the largest rate of gyro i in the turns

Both terms of all three gyros are tried together beside the parameters of the fit (generalised least squares, F-test).
They are tested and said, never fitted: turns by hand seldom vary enough in rate to tell S from them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.estimation.least_squares import f_test
from imulab.procedures.tumble.gyroturns import COLUMNS, ROWS, Segments, carried
from imulab.procedures.tumble.rotation import weighted_turns
from imulab.recording import Array

_SIGNIFICANT = 0.01
_CLEAR = 3.0
_FEWEST_LEFT = 6


@dataclass(frozen=True)
class Nonlinearity:
    """Probability of the residuals if nothing changes with the rate, and what changes by how much.

    Attributes
    ----------
    probability
        Of so large a gain by chance (F-test).
    odd
        Change of the scale factor from rest to the largest rate, relative, shape (3,).
    even
        Half its difference between the two directions at the largest rate, relative, shape (3,).
    odd_uncertainty, even_uncertainty
        Their standard uncertainties, shape (3,).
    largest
        Largest rate about each axis in the turns, rad/s, shape (3,).
    """

    probability: float
    odd: Array
    even: Array
    odd_uncertainty: Array
    even_uncertainty: Array
    largest: Array

    def notes(self) -> list[str]:
        """Say what changes with the rate, if it is beyond chance."""
        if not self.probability < _SIGNIFICANT:
            return []
        found = []
        for i, axis in enumerate("xyz"):
            for what, value, u in (
                ("from slow turns to", self.odd[i], self.odd_uncertainty[i]),
                ("between the two directions at", 2 * self.even[i], 2 * self.even_uncertainty[i]),
            ):
                if abs(value) > _CLEAR * u:
                    rate = np.degrees(self.largest[i])
                    found.append(f"of {axis} by {100 * value:+.2g} % (u {100 * u:.1g} %) {what} {rate:.0f} deg/s")
        changes = "; ".join(found) or "of which axis, they do not tell"
        return [
            f"gyro: what the turns miss depends on the rate (p {self.probability:.1g}): the scale factor changes "
            f"{changes}: the record holds for turns as fast as these; measure at the rates of use, or on a rate table"
        ]


def test_linearity(
    segments: Segments, scale: Array, theta: Array, jacobian: Array, residual: Array, shared: Array, variance: float
) -> Nonlinearity | None:
    """Test whether what the turns miss depends on the rate; None where too few turns are left to tell.

    Parameters
    ----------
    scale, theta
        Output per rad/s and scaled parameters of the fit.
    jacobian, residual
        At the solution, (3 m, p) and (3 m,).
    shared
        Covariance of the residuals that directions of gravity and the zero bring, (3 m, 3 m).
    variance
        That each has beside, rad^2.
    """
    m, size = len(segments.before), theta.size
    if 2 * m < size + 6 + _FEWEST_LEFT:
        return None
    t = np.eye(3)
    t[ROWS, COLUMNS] = theta[3:9]
    inverse = np.linalg.inv(t)
    moved = scale * theta[9:12] if size > 9 else 0.0
    sensed = (segments.output - moved) / (scale * (1 + theta[:3]))
    sensed = np.where(segments.step[:, :, None] > 0, sensed, 0.0)
    largest = np.maximum(np.abs(sensed).max(axis=(0, 1)), 1e-12)
    weights = np.concatenate([sensed**3 / largest**2, sensed**2 / largest], axis=2)
    turned = weighted_turns(sensed @ inverse.T, segments.step, weights).weighted
    matrix = carried(segments, scale, theta)
    columns = [
        np.einsum("mij,mj->mi", matrix, np.cross(segments.before, turned[:, k] @ -inverse[:, k % 3])).ravel()
        for k in range(6)
    ]
    floor = max(variance, 1e-6 * float(np.trace(shared)) / m, 1e-24)
    root = np.linalg.cholesky(shared + floor * np.eye(3 * m))
    whole = np.linalg.solve(root, np.column_stack([jacobian, *columns, residual]))
    design, left = whole[:, :-1], whole[:, -1]
    length = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    design = design / length

    def solved(count: int) -> tuple[Array, float]:
        answer = np.linalg.lstsq(design[:, :count], left, rcond=None)[0]
        return answer, float(((left - design[:, :count] @ answer) ** 2).sum())

    cost, (answer, larger) = solved(size)[1], solved(size + 6)
    freedom = 2 * m - size - 6
    spread = np.linalg.pinv(design.T @ design) * (larger / freedom)
    u = np.sqrt(np.diag(spread)[size:]) / length[size:]
    # The residual is carried less found direction: parameters that lower it have its sign reversed.
    value = -answer[size:] / length[size:]
    probability = f_test(cost, size, larger, size + 6, 2 * m)
    return Nonlinearity(probability, value[:3], value[3:], u[:3], u[3:], largest)
