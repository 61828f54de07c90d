"""What it may cost that a parameter is taken as constant over temperature where the holds do not tell its change.

A term left out of the laws moves all others: with the Jacobian J and the derivatives A by what is left out, times its
usual size, both whitened, coefficients err by ``-J^+ A a``, a of size 1. What of A is left beside J, B, tells a to the
covariance ``(1 + B'B)^-1``. Where what this leaves in the biases is more than half of their uncertainty, it is said.
"""

from __future__ import annotations

import numpy as np

from imulab.procedures.thermal.model import GROUPS
from imulab.procedures.thermal.rows import Problem, whitener
from imulab.procedures.thermal.solve import Solution

_USUAL = {1: (1e-4, "100 ppm/K"), 2: (1e-5, "10 urad/K")}
"""Slopes of scale factor and misalignment that sensors of this kind have, 1/K and rad/K."""
_PLACES = 33
_WORTH = 0.5
"""Of the biases' uncertainty: what adds an eighth to it is said."""


def untold(problem: Problem, solution: Solution, name: str) -> list[str]:
    """Return what biases may err by, for scale factor and misalignment, where that adds to their uncertainty."""
    laws, rows = solution.laws, solution.rows
    groups = [group for group in _USUAL if not laws.degrees[group]]
    if not groups:
        return []
    white = whitener(rows, solution.excess**2, solution.scatter.tau)
    jacobian = white(rows.jacobian)
    inverse = np.linalg.pinv(jacobian, rcond=1e-13)
    temperature = problem.temperature if problem.known is None else np.append(problem.temperature, problem.known[0])
    place = laws.place(temperature)[rows.owner]  # a prior's owner is -1
    design = laws.design(np.linspace(laws.low, laws.high, _PLACES))[:, :3]
    covariance = solution.covariance[: laws.size, : laws.size]
    stated = np.sqrt(np.mean(np.einsum("tpc,cd,tpd->tp", design, covariance, design)))
    found = []
    for group in groups:
        slope, usual = _USUAL[group]
        constants = [part.start for part in laws.parts[3 * group : 3 * group + 3]]
        term = white(rows.jacobian[:, constants] * place[:, None]) * slope * laws.half
        shift = inverse @ term
        beside = term - jacobian @ shift
        moved = design @ shift[: laws.size]
        left = np.linalg.inv(np.eye(3) + beside.T @ beside)
        error = np.sqrt(np.mean(np.einsum("tpa,ab,tpb->tp", moved, left, moved)))
        if error > _WORTH * stated:
            kind = GROUPS[group][0].replace("_", " ")
            found.append(
                f"{name}: the holds do not tell whether {kind} follows the temperature, which is taken as constant: "
                f"one that moves by {usual}, as is usual, errs biases by {1e3 * error:.2g} mg, where their uncertainty "
                f"is {1e3 * stated:.2g} mg: another axis up while the temperature changes, or attitudes at another "
                "temperature, would tell"
            )
    return found
