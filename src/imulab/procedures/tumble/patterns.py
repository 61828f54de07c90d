"""Residuals that are no scatter: a function of the direction of gravity, or of time.

A group of columns B (n, k) that the model does not have is regressed on the weighted residuals beside the model's own
Jacobian J (n, p): with the parts of both that J cannot absorb (the hat matrix accounted for), the F-test asks whether
the group explains more than chance would.

In the directions u = f / |f| the model's own columns span: bias, the first degree; scale factor and misalignment, the
second; k2 and k3, the pure powers of the third and fourth. What is left of the third degree are three products of two
axes (cross terms) and xyz, of the fourth six products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.estimation.least_squares import f_test
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.choices import HIGHEST_ORDER
from imulab.procedures.tumble.model import AXES, MISALIGNMENTS
from imulab.procedures.tumble.solve import Problem, Solution, forces
from imulab.recording import Array
from imulab.records.triads import CROSS_TERMS

FALSE_ALARM = 0.01
"""Share of tests without any pattern in which one is named: 1 % for direction, 1 % for time."""
_FEWEST = 4  # degrees of freedom that must be left beside a pattern
_TOLD_APART = 0.02  # share of a column that the model must leave of it
_TINY = 1e-7  # g: patterns below 0.1 µg are rounding
_MICRO = 1e6


@dataclass(frozen=True)
class Pattern:
    """What a group of columns explains of the residuals.

    Attributes
    ----------
    probability
        Of so large a gain by chance (F-test).
    value, uncertainty
        Coefficients of the columns, and their standard uncertainties, shape (k,).
    size
        Root mean square of the pattern over the attitudes, in units of the residuals.
    """

    probability: float
    value: Array
    uncertainty: Array
    size: float


def find_pattern(columns: Array, solution: Solution) -> Pattern | None:
    """Regress the residuals of a batch of one on `columns`, shape (n, k), beside the model; None if it cannot tell.

    Attitudes of weight 0 do not count.
    """
    used = solution.weights[0] > 0
    n, k = int(used.sum()), columns.shape[1]
    size = solution.jacobian.shape[2]
    if n - size - k < _FEWEST:
        return None
    root = np.sqrt(solution.weights[0, used])[:, None]
    model = solution.jacobian[0, used] * root
    basis = np.linalg.qr(model / np.linalg.norm(model, axis=0))[0]
    y, weighted = solution.residuals[0, used] * root[:, 0], columns[used] * root
    y, left = y - basis @ (basis.T @ y), weighted - basis @ (basis.T @ weighted)
    scale = np.linalg.norm(weighted, axis=0)
    u, values, vt = np.linalg.svd(left / scale, full_matrices=False)
    if values[-1] < _TOLD_APART:
        return None
    inverse = vt.T / values
    value = inverse @ (u.T @ y) / scale
    cost, gain = float(y @ y), float(((u.T @ y) ** 2).sum())
    noise = (cost - gain) / (n - size - k)
    return Pattern(
        probability=f_test(cost, size, cost - gain, size + k, n),
        value=value,
        uncertainty=np.sqrt(max(noise, 0.0) * (inverse**2).sum(axis=1)) / scale,
        size=float(np.sqrt(np.mean((left @ value / root[:, 0]) ** 2))),
    )


def direction_findings(problem: Problem, solution: Solution, *, order_chosen: bool) -> list[str]:
    """Say where the residuals are a function of direction that the model does not hold.

    Parameters
    ----------
    problem, solution
        A batch of one.
    order_chosen
        Whether the order was chosen from the data, which has tried the next power then.
    """
    force = forces(problem, solution)[0]
    x, y, z = (force / np.linalg.norm(force, axis=1)[:, None]).T
    power = problem.order + 2
    groups = {
        "cross": np.column_stack([x * x * y, y * y * z, z * z * x]),
        "other": np.column_stack([x * y * z, x**3 * y, y**3 * z, z**3 * x, x * y**3, y * z**3, z * x**3]),
    }
    if not order_chosen and problem.order < HIGHEST_ORDER:
        alike = [x**power, y**power, z**power] if problem.order else [x * y, z * x, z * y]
        groups["order"] = np.column_stack(alike)
    if problem.cross:
        del groups["cross"]
    found = {name: find_pattern(columns, solution) for name, columns in groups.items()}
    patterns = {name: pattern for name, pattern in found.items() if pattern is not None and pattern.size > _TINY}
    if not patterns:
        return []
    likeliest = min(patterns, key=lambda name: patterns[name].probability)
    pattern = patterns[likeliest]
    if pattern.probability * len(patterns) > FALSE_ALARM:
        return []
    unit, terms = "µg/g²", list(CROSS_TERMS)
    if likeliest == "order" and problem.order:
        unit, terms = f"µg/g{'²³⁴⁵'[power - 3]}", [f"k{power - 1}_{axis}" for axis in AXES]
    elif likeliest == "order":
        unit, terms = "µrad", [f"misalignment_{pair}" for pair in MISALIGNMENTS]
    sizes = ", ".join(
        f"{name} {_MICRO * value:+.0f} ± {_MICRO * u:.0f}"
        for name, value, u in zip(terms, pattern.value, pattern.uncertainty, strict=False)
    )
    looks, remedy = {
        "cross": (
            f"they look like products of two axes ({sizes} {unit})",
            f"--cross --order {problem.order or 1} fits these",
        ),
        "order": (
            f"they look like the next order ({sizes} {unit})",
            f"--order {problem.order + 1} fits it, or --order auto",
        ),
        "other": ("they look like products of the third and fourth degree", "no option fits these; repeat the test"),
    }[likeliest]
    return [
        f"the residuals are a function of the direction of gravity, {_MICRO * pattern.size:.3g} µg rms (probability by "
        f"chance {_chance(pattern.probability)}): {looks}, which the uncertainties do not hold; {remedy}"
    ]


def time_findings(attitudes: Attitudes, problem: Problem, solution: Solution) -> list[str]:
    """Say where the residuals show that the zeros drift: columns ``q_i (t - mean t)``, q = d|f|/d reading."""
    if attitudes.trace is None:
        return []
    middle = (attitudes.start + attitudes.stop) / 2
    span = float(attitudes.stop[-1] - attitudes.start[0])
    time = (middle - middle.mean()) / span
    pattern = find_pattern(-solution.jacobian[0][:, 0:3] * time[:, None], solution)
    if pattern is None or pattern.size < _TINY or pattern.probability > FALSE_ALARM:
        return []
    sizes = ", ".join(
        f"{axis} {1e3 * value:+.2g} ± {1e3 * u:.1g} mg"
        for axis, value, u in zip(AXES, pattern.value, pattern.uncertainty, strict=True)
    )
    return [
        f"the zeros drift over the test: the residuals show {sizes} from its beginning to its end (probability by "
        f"chance {_chance(pattern.probability)}); let the unit warm up, and put the attitudes in no particular order"
    ]


def _chance(probability: float) -> str:
    return f"{probability:.1g}" if probability >= 1e-6 else "below 1e-6"
