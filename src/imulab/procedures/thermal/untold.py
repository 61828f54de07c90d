"""What it may cost that the holds do not tell how scale factors follow the temperature, or how biases lag behind it.

A term left out of the laws moves all others: with the Jacobian J and the derivatives A by what is left out, times its
usual size, both whitened, coefficients err by ``-J^+ A a``, a of size 1. What of A is left beside J, B, tells a to the
covariance ``(1 + B'B)^-1``. Where what this leaves in the biases matters beside their uncertainty, it is said.
"""

from __future__ import annotations

import numpy as np

from imulab.procedures.thermal.choices import STRETCHES, TURNS
from imulab.procedures.thermal.lag import Drift
from imulab.procedures.thermal.model import GROUPS
from imulab.procedures.thermal.rows import Problem, whitener
from imulab.procedures.thermal.solve import Solution
from imulab.recording import Array

_USUAL = {1: (STRETCHES, f"{1e6 * STRETCHES:.0f} ppm/K"), 2: (TURNS, f"{1e6 * TURNS:.0f} urad/K")}
_LAG = 5.0
"""s, that a sensor on the thermometer's own board may lag behind it."""
_PLACES = 33
_WORTH = 0.5
"""Of the biases' uncertainty: what adds an eighth to it is said."""


def untold(problem: Problem, solution: Solution, drift: Drift, name: str) -> list[str]:
    """Return what biases may err by, for scale factor, misalignment and lag, where that adds to their uncertainty."""
    laws, rows = solution.laws, solution.rows
    groups = [group for group in _USUAL if not laws.degrees[group]]
    if not groups and not drift.reason:
        return []
    white = whitener(rows, solution.excess**2, solution.scatter.tau)
    jacobian = white(rows.jacobian)
    inverse = np.linalg.pinv(jacobian, rcond=1e-13)
    design = laws.design(np.linspace(laws.low, laws.high, _PLACES))[:, :3]
    covariance = solution.covariance[: laws.size, : laws.size]
    stated = float(np.sqrt(np.mean(np.einsum("tpc,cd,tpd->tp", design, covariance, design))))

    def error_by(term: Array) -> float:
        """Return the root mean square error of the biases, over the range, that such terms, (N, k), leave."""
        shift = inverse @ white(term)
        beside = white(term) - jacobian @ shift
        moved = design @ shift[: laws.size]
        left = np.linalg.inv(np.eye(term.shape[1]) + beside.T @ beside)
        return float(np.sqrt(np.mean(np.einsum("tpa,ab,tpb->tp", moved, left, moved))))

    temperature = problem.temperature if problem.known is None else np.append(problem.temperature, problem.known[0])
    place, found = laws.place(temperature)[rows.owner], []  # a prior's owner is -1
    for group in groups:
        slope, usual = _USUAL[group]
        constants = [part.start for part in laws.parts[3 * group : 3 * group + 3]]
        error = error_by(rows.jacobian[:, constants] * place[:, None] * slope * laws.half)
        if error > _WORTH * stated:
            kind = GROUPS[group][0].replace("_", " ")
            found.append(
                f"{name}: the holds do not tell whether {kind} follows the temperature, which is taken as constant: "
                f"one that moves by {usual}, as is usual, errs biases by {1e3 * error:.2g} mg, where their uncertainty "
                f"is {1e3 * stated:.2g} mg: another axis up while the temperature changes, or attitudes at another "
                "temperature, would tell"
            )
    if drift.reason and (error := error_by(rows.drift[:, :1] * _LAG)) > stated:
        found.append(
            f"{name}: the temperature changes fast, and the recordings do not tell a lag behind the thermometer: one "
            f"of {_LAG:g} s errs biases by {1e3 * error:.2g} mg, where their uncertainty is {1e3 * stated:.2g} mg: let "
            "it change more slowly, or record the way back too"
        )
    return found
