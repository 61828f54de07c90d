"""Which further attitudes would tell apart what these cannot."""

from __future__ import annotations

import numpy as np

from imulab.procedures.tumble.model import norm_and_jacobian, parameter_count
from imulab.procedures.tumble.solve import Solution, start_parameters
from imulab.recording import Array

_CANDIDATES = 400


def sphere_points(count: int) -> Array:
    """Return directions spread evenly over the sphere (Fibonacci lattice), shape (count, 3)."""
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - height**2)
    points: Array = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])
    return points


def helpful_attitudes(order: int, solution: Solution, count: int) -> str:
    """Name the upward directions (body axes) that add most to what the attitudes determine.

    Each is the candidate with the largest variance of |f| under the information so far, a step of the exchange on the
    D-criterion (Fedorov 1972).
    """
    candidates = sphere_points(_CANDIDATES)
    present = solution.jacobian[0]
    cross = present.shape[1] > parameter_count(order)
    rows = norm_and_jacobian(start_parameters(order, cross=cross), candidates[None], order)[1][0]
    information = present.T @ present + 1e-6 * np.eye(present.shape[1])
    chosen = []
    for _ in range(count):
        gain = np.einsum("ij,jk,ik->i", rows, np.linalg.inv(information), rows)
        best = int(np.argmax(gain))
        information = information + np.outer(rows[best], rows[best])
        chosen.append("(" + ", ".join(f"{value:+.2f}" for value in candidates[best]) + ")")
    return " and ".join(chosen)
