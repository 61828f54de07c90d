"""Do the recordings agree as those of one unit do? What no power cycle explains is said, with who stands apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.thermal.choices import DEGREES
from imulab.procedures.thermal.degrees import clusters_of, rows_where, tail
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import Laws
from imulab.procedures.thermal.rows import Problem, whitener
from imulab.procedures.thermal.solve import Solution, between, excess_of, offset_modes, solve

_MOVES = 0.002
"""What biases hardly move by from one power cycle to the next, g."""
_BENDS = 0.01
"""The same where few temperatures leave the bends of the law in it."""
_STRETCHES = 0.005
"""What scale factors hardly move by."""
_SCATTERS, _NOISE = 0.25e-3, 4.0
"""Scatter of |f| within recordings that is asked about: in g, and in units of what the holds' own noise explains."""
_ENOUGH = 5
"""Temperatures that show the bends of a law, and recordings of which one can be told to stand apart."""
_APART = 0.4
"""Share of their disagreement that the others keep where one recording stands apart."""
_ATTITUDES = 6
"""Of a recording whose own scale factors can be told."""
_CHANCE = 0.005
"""How often chance lets a recording lie off the others so, in biases or in scale factors."""
_OFF_BIAS, _OFF_SCALE = 0.5e-3, 3e-4
"""Less than this is not asked about, in g and in 1."""
_USUAL = 1e-4
"""What scale factors may well move by from one power cycle to the next."""
_HOTTEST = 125.0
"""degC; sensors are rated to it."""


def disagreements(holds: Holds, problem: Problem, solution: Solution, name: str) -> list[str]:
    """Return what says that recordings are hardly of one unit, mounted alike, at rest, by one thermometer."""
    bias, scale = solution.scatter.tau.tolist()
    if not solution.scatter.rank:  # nobody measured it: it was stated
        bias = 0.0
    many = int(clusters_of(problem.temperature).max(initial=0)) + 1 >= _ENOUGH
    differ = [
        text
        for size, text in (
            (bias / (_MOVES if many else _BENDS), f"biases by {1e3 * bias:.3g} mg"),
            (scale / _STRETCHES, f"scale factors by {100 * scale:.2g} %"),
        )
        if size > 1
    ]
    rows, found = solution.rows, []
    own = float(np.median(np.sqrt(np.diag(rows.noise)[rows.magnitude])))
    scattered = solution.excess > max(_SCATTERS, _NOISE * own)
    apart = _apart(holds, problem, solution.laws) if differ or scattered else ""
    if differ and (apart or not solution.scatter.bound):  # a bound holds bends of the law, too
        found.append(
            f"{name}: from one recording to the next {' and '.join(differ)} differ, which no power cycle does: are all "
            f"of one unit, its axes named alike, its temperatures by one thermometer?{apart}"
        )
    if scattered:
        found.append(
            f"{name}: within recordings |f| scatters by {1e6 * solution.excess:.0f} ug, of which noise explains "
            f"{1e6 * own:.0f} ug: is a recording of another unit, with axes swapped, or with a jump of its outputs?"
            f"{'' if differ else apart}"
        )
    if not apart:
        found += _off(holds, problem, solution)
    if solution.laws.high > _HOTTEST:
        found.append(
            f"{name}: temperatures up to {solution.laws.high:.0f} degC, above what sensors are rated to: are these "
            "degrees Fahrenheit? expected degC or kelvins"
        )
    return found


def _apart(holds: Holds, problem: Problem, laws: Laws) -> str:
    """Return which recording the others agree without, as a sentence; nothing where that is none or several."""
    numbers = np.unique(problem.recording)
    if len(numbers) < _ENOUGH:
        return ""
    left = [_disagreement(_without(problem, problem.recording == number), laws) for number in numbers]
    order = np.argsort(left)
    best, second = (left[int(k)] for k in order[:2])
    if not best < min(_APART * second, _MOVES):
        return ""
    return f" Without {holds.recordings[int(numbers[order[0]])].name} the others agree to {1e6 * best:.0f} ug"


def _off(holds: Holds, problem: Problem, solution: Solution) -> list[str]:
    """Return which recording lies far off the laws, by how the others, without it, scatter about theirs.

    Its own offsets of bias, beside the laws, are compared with those of the others by F; of scale factors, which power
    cycles hardly move, with what noise and the others' scatter allow. Of five recordings under a cubic the others do
    not tell how far biases scatter: there the scale factors tell it alone.
    """
    rows = solution.rows
    numbers, attitudes = np.unique(problem.recording, return_counts=True)
    if len(numbers) < _ENOUGH:
        return []
    whose = np.where(rows.owner >= 0, problem.recording[rows.owner], -1)
    asked = []
    for number in numbers[attitudes >= _ATTITUDES].tolist():
        if not problem.shared[problem.recording == number].all():
            continue
        others = rows_where(rows, whose != number)
        excess, freedom = excess_of(others, solution.excess**2)
        scatter, white = between(others, excess), whitener(others, excess, np.zeros(2))
        own = np.s_[3 * number : 3 * number + 3]
        stretch, told = max(float(scatter.tau[1]), _USUAL), freedom
        if stretch > _USUAL:  # few recordings told it
            bias, scale = (white(given) for given in others.offsets)
            told = float(len(offset_modes(np.hstack([white(others.jacobian), bias]), scale, white(others.residual))[0]))
        tests = [(1, np.array([_BENDS, stretch]), told, _OFF_SCALE)]
        if scatter.rank:
            tests.append((0, scatter.tau, float(scatter.rank), _OFF_BIAS))
        for kind, tau, told, least in tests:
            white = whitener(rows, excess, tau)
            s, force = offset_modes(white(rows.jacobian), white(rows.offsets[kind][:, own]), white(rows.residual))
            if not len(s):
                continue
            size = float(np.sqrt(np.sum((force / s) ** 2) / 3))
            chance = len(numbers) * tail(float(np.mean(force**2)), len(s), told)
            if chance < _CHANCE and size > least:
                by = f"{1e6 * size:.0f} ppm in scale factors" if kind else f"{1e3 * size:.2g} mg in biases"
                asked.append((chance, f"{holds.recordings[number].name}: lies off the other recordings by {by}"))
    return [
        f"{said}, far more than they differ among themselves: is it of the same unit, at the temperature that it says, "
        "or have the laws a bend there? come back to that temperature"
        for _, said in sorted(asked)[:1]
    ]


def _without(problem: Problem, gone: NDArray[np.bool_]) -> Problem:
    kept = ~gone
    group = problem.group[kept]
    tied = group >= 0
    group[tied] = np.unique(group[tied], return_inverse=True)[1]
    return replace(
        problem,
        reading=problem.reading[kept],
        covariance=problem.covariance[kept],
        temperature=problem.temperature[kept],
        rate=problem.rate[kept],
        step=problem.step[kept],
        shared=problem.shared[kept],
        recording=np.unique(problem.recording[kept], return_inverse=True)[1],
        group=group,
        free=(),
        side=None if problem.side is None else problem.side[kept],
        wander=None if problem.wander is None else problem.wander[np.ix_(kept, kept)],
    )


def _disagreement(problem: Problem, laws: Laws) -> float:
    """Return the scatter between and within recordings about polynomials of the highest degrees, g."""
    limit = max(int(clusters_of(problem.temperature).max(initial=0)) - 1, 0)
    degrees = (min(DEGREES[0], limit), min(DEGREES[1], limit), min(DEGREES[2], limit))
    try:
        # As if biases moved by much, which a unit among others of its own would otherwise bend the laws by.
        found = solve(problem, replace(laws, degrees=degrees, knots=()), tau=_BENDS)
    except np.linalg.LinAlgError:
        return np.inf
    if not found.converged:
        return np.inf
    return float(np.hypot(found.excess, between(found.rows, found.excess**2).tau[0]))
