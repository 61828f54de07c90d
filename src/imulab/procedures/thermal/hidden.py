"""What recordings over temperature cannot show: how far it may shift the biases, and its usual size in uncertainties.

Slopes of scale factors and misalignments, a lag behind the thermometer, an element that stays behind it at the ends of
the range, a loop approached from one side: each is a column of the least-squares problem (`thermal.solve`). What of it
is left beside the laws moves their coefficients by ``(J' V^-1 J)^-1 J' V^-1 c``.

Soaks alone cannot show an element that stays behind: a law of the thermometer's temperature stretched by a little is a
law of the same degree. Where soaks are quiet, slope times a usual 0.8 K is many times the uncertainty of scale factors;
it is then stated beside them, since uncertainties grow by 1.3 times at most, and they hold for the thermometer's
reading in a soak of that kind.

Missing terms (`bias_shift_from_unobserved`): a term that the holds do not show shifts all coefficients by ``-J^+ A a``,
J the whitened Jacobian, A the whitened derivatives by the term times its usual size, and a of variance 1. The part B of
A beside J reduces the variance of a to ``(1 + B'B)^-1``. A warning is given where the shift of the biases is large
beside their uncertainty.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imulab.display import Finding, Note
from imulab.procedures.thermal import STRETCHES, TURNS
from imulab.procedures.thermal.degrees import LagAndLoops
from imulab.procedures.thermal.model import GROUPS
from imulab.procedures.thermal.solve import (
    ThermalProblem,
    ThermalSolution,
)
from imulab.recording import Array

# Shift of the biases by slopes of scale factors and misalignments that the holds do not show.


_USUAL_SLOPES = {1: (STRETCHES, f"{1e6 * STRETCHES:.0f} ppm/K"), 2: (TURNS, f"{1e6 * TURNS:.0f} urad/K")}
_PLACES = 33  # temperatures over which the shift of the biases is averaged
_WORTH = 0.5
"""Share of the biases' uncertainty from which a shift is warned of: it adds an eighth to it."""


def bias_shift_from_unobserved(problem: ThermalProblem, solution: ThermalSolution, name: str) -> list[str]:
    """Return warnings of what unobserved slopes shift the biases by, beside their uncertainty."""
    laws, rows = solution.laws, solution.rows
    groups = [group for group in _USUAL_SLOPES if not laws.degrees[group]]
    if not groups:
        return []
    white = solution.white
    jacobian = white(rows.jacobian)
    inverse = np.linalg.pinv(jacobian, rcond=1e-13)
    design = laws.design(np.linspace(laws.low, laws.high, _PLACES))[:, :3]
    covariance = solution.covariance[: laws.size, : laws.size]
    stated = float(np.sqrt(np.mean(np.einsum("tpc,cd,tpd->tp", design, covariance, design))))

    def error_by(term: Array) -> float:
        """Return the root mean square shift of the biases over the range by terms of shape (N, k)."""
        shift = inverse @ white(term)
        beside = white(term) - jacobian @ shift
        moved = design @ shift[: laws.size]
        left = np.linalg.inv(np.eye(term.shape[1]) + beside.T @ beside)
        return float(np.sqrt(np.mean(np.einsum("tpa,ab,tpb->tp", moved, left, moved))))

    temperature = problem.temperature if problem.known is None else np.append(problem.temperature, problem.known[0])
    place = laws.place(temperature)[rows.owner]  # a prior's owner is -1
    messages: list[str] = []
    for group in groups:
        slope, usual = _USUAL_SLOPES[group]
        constants = [part.start for part in laws.parts[3 * group : 3 * group + 3]]
        error = error_by(rows.jacobian[:, constants] * place[:, None] * slope * laws.half)
        if error > _WORTH * stated:
            kind = GROUPS[group][0].replace("_", " ")
            messages.append(
                Finding(
                    f"{name}: the holds do not tell whether {kind} follows the temperature, which is taken as "
                    f"constant: one that moves by {usual}, as is usual, shifts the biases by {1e3 * error:.2g} mg, "
                    f"where their uncertainty is {1e3 * stated:.2g} mg: another axis up while the temperature changes, "
                    "or attitudes at another temperature, would tell",
                    "record another axis up while the temperature changes",
                )
            )
    return messages


# What the recordings cannot show, at a usual size in the uncertainties.


_BEHIND, _LOOP, _FOLLOWS = 0.8, 0.15e-3, 20.0
"""Usual standard deviations: of what an element stays behind its thermometer at both ends of the range, K; of loops
between warming and cooling in its middle, g; and of a lag, s. The lag is an estimate, 0.5 J/K of a package and the
board around it behind 40 K/W; no published figure was found. Ramps of both directions measure it (`fit.lag`)."""
_SHOWN, _WIDER = 0.1, 1.3
"""Part of the variance of biases, or scale factors, or misalignments, from which a hidden effect is noted, and how much
wider all of them may make their uncertainties: an effect whose usual size is larger is stated beside them."""
_FAILS = 4.0
"""Shift of the biases by a usual lag, over their uncertainty, from which it is no note: an interval that is 1.3 times
wider misses every other usual lag."""
_SHOWN_IN = (("biases", 1e3, "mg"), ("scale factors", 1e6, "ppm"), ("misalignments", 1e3, "mrad"))


def cover_hidden(
    problem: ThermalProblem, solution: ThermalSolution, drift: LagAndLoops, name: str
) -> tuple[ThermalSolution, list[str]]:
    """Return the solution with what its recordings cannot show in the covariance, and what would show it.

    Each effect has a usual size, as a prior of mean 0. What remains of it beside the laws moves the coefficients by
    ``(J' V^-1 J)^-1 J' V^-1 c``; where the recordings show an effect, little of it remains.
    """
    rows, laws, size = solution.rows, solution.laws, solution.laws.size
    white = solution.white
    jacobian = white(rows.jacobian)
    inverse = np.linalg.pinv(jacobian, rcond=1e-13)
    design = laws.design(np.linspace(laws.low, laws.high, _PLACES))

    def spread(matrix: Array) -> Array:
        """Return the mean variances of biases, scale factors and misalignments over the range, shape (3,)."""
        each = ((design @ matrix[:size, :size]) * design).sum(axis=2).mean(axis=0)
        means: Array = each.reshape(3, 3).mean(axis=1)
        return means

    stated, total = spread(solution.covariance), np.zeros_like(solution.covariance)
    effects = []
    for columns, what, action in _hidden_effects(problem, solution, drift):
        shift, whitened = inverse @ white(columns), white(columns)
        beside = whitened - jacobian @ shift
        left = np.linalg.inv(np.eye(columns.shape[1]) + beside.T @ beside)
        moved = shift[: len(total)]
        gained = moved @ left @ moved.T
        total += gained
        effects.append((what, spread(gained), action))
    room = np.sqrt((_WIDER**2 - 1) * stated / np.maximum(spread(total), 1e-300))
    share = np.ones(len(total))
    for number, part in enumerate(laws.parts):
        share[part] = min(room[number // 3], 1.0)
    held = np.minimum(room, 1.0)
    messages: list[str] = []
    for what, variances, action in effects:
        moved_by = [
            f"the {kinds} by {size * np.sqrt(variance):.2g} {unit}, of which their uncertainty holds "
            f"{size * part * np.sqrt(variance):.2g} {unit}"
            for (kinds, size, unit), variance, part, variance_stated in zip(
                _SHOWN_IN, variances.tolist(), held.tolist(), stated.tolist(), strict=True
            )
            if variance > _SHOWN * variance_stated
        ]
        if moved_by:
            text = f"{name}: {what}; it moves {', and '.join(moved_by)}"
            fails = action and variances[0] > _FAILS**2 * stated[0]
            messages.append(Finding(text, action) if fails else Note(text))
    return replace(solution, covariance=solution.covariance + share[:, None] * total * share), messages


def _hidden_effects(
    problem: ThermalProblem, solution: ThermalSolution, drift: LagAndLoops
) -> list[tuple[Array, str, str]]:
    """Return columns of effects, each of its usual size, shape (N, k), what to say, and what to do where it is large.

    Where that is empty, the recordings cannot say that it is large.
    """
    rows, laws, owner = solution.rows, solution.laws, solution.rows.owner
    mine = owner >= 0
    temperature, rate = problem.temperature[owner], problem.rate[owner]
    place = laws.place(temperature)[:, None]
    felt = [columns.reshape(len(owner), -1, 3).sum(axis=1) * mine[:, None] for columns in rows.offsets]
    slope = laws.slope(temperature) @ solution.coefficients[: laws.size]
    heat = (felt[0] * slope[:, :3] + felt[1] * slope[:, 3:6]).sum(axis=1)
    steady = (rate == 0) & mine
    effects = []
    if steady.any() and (laws.degrees[0] or laws.knots):
        effects.append(
            (
                _BEHIND * place * (heat * steady)[:, None],
                f"soaks do not show how far the elements stay behind the thermometer: {_BEHIND:g} K at both ends of "
                "the range is usual; one more soak at an end, the unit wrapped against the air, would show it",
                "",
            )
        )
    side = np.zeros(len(owner)) if problem.side is None else problem.side[owner]
    if drift.values is None and not (side[mine] != 0).any():
        way = np.where(rate == 0, 1.0, np.sign(rate))[:, None]
        effects.append(
            (
                _LOOP * way * (1 - place**2) * felt[0],
                "biases may differ between warming and cooling, which recordings from one side do not show: "
                f"{1e3 * _LOOP:g} mg are usual; reach the temperatures from both sides, 'reached_by: cooling' in the "
                "head of such a soak",
                "",
            )
        )
    if drift.values is None and drift.reason:
        effects.append(
            (
                _FOLLOWS * rows.drift[:, :1],
                f"a lag of the biases behind the thermometer, {_FOLLOWS:g} s is usual, looks like their laws where the "
                "temperature goes one way only; record the way back too",
                "let the temperature change more slowly, or record the way back too",
            )
        )
    return effects
