"""What each recording at a steady temperature says by itself: its own calibration, to hold beside the laws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.procedures.thermal.model import forces
from imulab.procedures.thermal.rows import Problem, parameters_of
from imulab.procedures.thermal.solve import Solution
from imulab.recording import Array

_FEWEST = 12
"""Holds, for nine parameters."""
_CONDITION = 1e3
"""Of the nine parameters' columns, each scaled to one: worse ones cannot be told apart by so few attitudes."""


@dataclass(frozen=True)
class Own:
    """The nine parameters of one recording and their standard uncertainties, in units of g, at its temperature, degC.

    `recording` is its number, -1 for the prior.
    """

    recording: int
    temperature: float
    values: Array
    standard_uncertainty: Array


def own_calibrations(problem: Problem, solution: Solution) -> list[Own]:
    """Return the calibration that each recording gives alone, where it can, and a prior's.

    The laws at the temperature of each hold, and nine constants added to them, fitted to ``|f| = g`` of the
    recording's holds: one Gauss-Newton step, because the laws are already near. The uncertainty holds that of the
    temperature, which moves the point along the laws.
    """
    parameters, _, _, slope = parameters_of(problem, solution.laws, solution.coefficients)
    force, change = forces(parameters, problem.reading)
    length = np.linalg.norm(force, axis=1)
    columns = np.einsum("ni,nij->nj", force / length[:, None], change)
    rows = solution.rows
    used = np.flatnonzero(rows.magnitude & (rows.owner >= 0))
    used = used[np.argsort(rows.owner[used])]
    residual = rows.residual[used]
    weight = 1 / np.sqrt(np.diag(rows.noise)[used] + solution.excess**2)
    found = []
    for number in np.unique(problem.recording).tolist():
        own = (problem.recording == number) & problem.shared
        if own.sum() < _FEWEST:
            continue
        matrix = columns[own] * weight[own, None]
        size = np.linalg.norm(matrix, axis=0)
        if np.linalg.cond(matrix / size) > _CONDITION:
            continue
        inverse = np.linalg.pinv(matrix)
        values = parameters[own].mean(axis=0) - inverse @ (weight[own] * residual[own])
        by_heat = (slope[own] * problem.step[own, None]).mean(axis=0)
        u = np.sqrt((inverse**2).sum(axis=1) + by_heat**2)
        found.append(Own(number, float(problem.temperature[own].mean()), values, u))
    if problem.known is not None:
        temperature, values, covariance = problem.known
        found.append(Own(-1, temperature, values, np.sqrt(np.diag(covariance))))
    return found
