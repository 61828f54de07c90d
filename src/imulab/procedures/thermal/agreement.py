"""Whether recordings over temperature agree with each other, and with a record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding
from imulab.estimation.decisions import RECORDING_DISAGREEMENT
from imulab.estimation.least_squares import chi_square_probability
from imulab.estimation.rows import median
from imulab.procedures.thermal import DEGREES
from imulab.procedures.thermal.degrees import number_temperatures, tail_probability
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import Laws
from imulab.procedures.thermal.solve import (
    Rows,
    ThermalProblem,
    ThermalSolution,
    fit_excesses,
    fit_turn_on_scatter,
    offset_modes,
    solve,
    whitener,
    whitener_of,
)
from imulab.recording import Array

# Residuals under a record in two parts: what a recording has in common, as an offset of its power cycle, and the rest.


_SEEN = 1e-6  # of the largest singular value: smaller ones are rounding


def within_and_between(
    rows: Rows, whole: Array, noise: Array, unknown: Array, rank: int | None, *, by_share: bool = True
) -> tuple[float | None, float | None]:
    """Return the probabilities of the residuals within recordings, and of the offset that each has in common.

    The whitened residual r is split by an orthonormal basis Q of the offsets of power cycles: ``|r - Q Q'r|^2`` is
    chi-square distributed, the mean square of ``Q'r`` by F, since few power cycles determined their scatter.

    Parameters
    ----------
    whole, noise
        Covariances with and without laws and power cycles, shape (N, N).
    unknown
        Columns of unknown directions, which are projected out, shape (N, k).
    rank
        Number of offsets that determined the scatter between power cycles; 0 if it was stated, None if it is unknown,
        and offsets are not tested.
    by_share
        Degrees of freedom by Satterthwaite: the more of an offset's variance is noise, the more there are. This is
        wrong where power cycles move outputs by more than noise does, and their scatter came out small by chance.
    """
    white = whitener_of(whole)
    turns = _orthonormal_basis(white(unknown))
    offsets = white(rows.offsets[0])
    offsets = _orthonormal_basis(offsets - turns @ (turns.T @ offsets))
    residual = white(rows.residual)
    residual = residual - turns @ (turns.T @ residual)
    shared = offsets.T @ residual
    rest, spare = residual - offsets @ shared, len(residual) - turns.shape[1] - offsets.shape[1]
    within = chi_square_probability(float(rest @ rest), spare) if spare else None
    if rank is None or not len(shared):
        return within, None
    inner = white(white(noise).T)
    share = 1 - float(np.trace(offsets.T @ inner @ offsets)) / len(shared) if by_share else 1.0
    freedom = rank / max(share, 1e-3) ** 2 if rank else np.inf
    return within, tail_probability(float(shared @ shared) / len(shared), len(shared), freedom)


def _orthonormal_basis(columns: Array) -> Array:
    """Return an orthonormal basis of the columns, shape (n, rank)."""
    if not columns.shape[1]:
        return columns
    u, values, _ = np.linalg.svd(columns, full_matrices=False)
    kept: NDArray[np.bool_] = values > _SEEN * max(float(values[0]), 1e-300)
    basis: Array = u[:, kept]
    return basis


# Agreement of the recordings: warnings of differences that no power cycle explains, and of the outlier among them.


_MOVES = 0.002
"""Largest plausible scatter of biases between power cycles, g."""
_BENDS = 0.01
"""The same where few temperatures leave the bends of the law in it."""
_STRETCHES = 0.005
"""Largest plausible scatter of scale factors between power cycles."""
_SCATTERS, _NOISE = 0.25e-3, 4.0
"""Scatter of |f| within recordings from which there is a warning: in g, and over that by the holds' own noise."""
_FEWEST_TO_COMPARE = 5
"""Fewest temperatures that show the bends of a law, and fewest recordings among which there can be an outlier."""
_APART = 0.4
"""Share of the disagreement, at most, that remains without the outlier."""
_ATTITUDES = 6
"""Fewest attitudes of a recording that show scale factors of its own."""
_OFF_BIAS, _OFF_SCALE = 0.5e-3, 3e-4
"""Offsets below which there is no warning, g and 1."""
_USUAL = 1e-4
"""Usual scatter of scale factors between power cycles."""
_HOTTEST = 125.0
"""Highest temperature to which sensors are rated, degC."""


def warn_disagreement(holds: Holds, problem: ThermalProblem, solution: ThermalSolution, name: str) -> list[str]:
    """Return warnings where recordings can hardly be of one unit, mounted alike, at rest, with one thermometer."""
    bias, scale = solution.scatter.tau.tolist()
    if not solution.scatter.rank:  # it was stated, and not measured
        bias = 0.0
    many = int(number_temperatures(problem.temperature).max(initial=0)) + 1 >= _FEWEST_TO_COMPARE
    differ = [
        text
        for size, text in (
            (bias / (_MOVES if many else _BENDS), f"biases by {1e3 * bias:.3g} mg"),
            (scale / _STRETCHES, f"scale factors by {100 * scale:.2g} %"),
        )
        if size > 1
    ]
    rows = solution.rows
    messages: list[str] = []
    noise = median(np.sqrt(np.diag(rows.noise)[rows.magnitude]))
    scattered = solution.excess > max(_SCATTERS, _NOISE * noise)
    apart = _name_outlier(holds, problem, solution.laws) if differ or scattered else ""
    if differ and (apart or not solution.scatter.bound):  # a bound contains bends of the law
        messages.append(
            Finding(
                f"{name}: from one recording to the next {' and '.join(differ)} differ, which no power cycle does: are "
                f"all of one unit, its axes named alike, its temperatures by one thermometer?{apart}",
                "leave out recordings of another unit, axis order or thermometer",
            )
        )
    if scattered:
        bends = "" if many or apart else "do the laws bend more than so few temperatures show, or "
        messages.append(
            Finding(
                f"{name}: within recordings |f| scatters by {1e6 * solution.excess:.0f} µg, of which noise explains "
                f"{1e6 * noise:.0f} µg: {bends}is a recording of another unit, with axes swapped, or with a jump of "
                f"its outputs?{'' if differ else apart}",
                "record five temperatures or more, or state --degrees"
                if bends
                else "leave out the recording that is of another unit, or record it again",
            )
        )
    if not apart:
        messages += _warn_offset(holds, problem, solution)
    if solution.laws.high > _HOTTEST:
        messages.append(
            Finding(
                f"{name}: temperatures up to {solution.laws.high:.0f} degC, above what sensors are rated to: are these "
                "degrees Fahrenheit? expected degC or kelvins",
                "state the temperatures in degC or kelvins",
            )
        )
    return messages


def _name_outlier(holds: Holds, problem: ThermalProblem, laws: Laws) -> str:
    """Return a sentence that names the one recording without which the others agree; empty if there is none."""
    numbers = np.unique(problem.recording)
    if len(numbers) < _FEWEST_TO_COMPARE:
        return ""
    left = [_measure_disagreement(_leave_out(problem, problem.recording == number), laws) for number in numbers]
    order = np.argsort(left)
    best, second = (left[int(k)] for k in order[:2])
    if not best < min(_APART * second, _MOVES):
        return ""
    return f" Without {holds.recordings[int(numbers[order[0]])].name} the others agree to {1e6 * best:.0f} µg"


def _warn_offset(holds: Holds, problem: ThermalProblem, solution: ThermalSolution) -> list[str]:
    """Return a warning of the recording that lies farthest off the laws, measured by the scatter of the others.

    The offsets of its biases are compared with those of the others by F; offsets of its scale factors, which power
    cycles hardly change, with noise and the others' scatter. With five recordings and a cubic the others do not show
    how far biases scatter: there the scale factors decide alone.
    """
    rows = solution.rows
    numbers, attitudes = np.unique(problem.recording, return_counts=True)
    if len(numbers) < _FEWEST_TO_COMPARE:
        return []
    tested = [
        number
        for number in numbers[attitudes >= _ATTITUDES].tolist()
        if problem.shared[problem.recording == number].all()
    ]
    if not tested:
        return []
    others = [rows.recording != number for number in tested]
    asked = []
    for number, part, excess, freedom in zip(
        tested, others, *fit_excesses(rows, solution.excess**2, others), strict=True
    ):
        scatter = fit_turn_on_scatter(rows, excess, part)
        of_recording = np.s_[3 * number : 3 * number + 3]
        stretch, rank = max(float(scatter.tau[1]), _USUAL), freedom
        if stretch > _USUAL:  # determined by few recordings
            white = whitener(rows, excess, np.zeros(2))
            columns = white(np.column_stack([rows.jacobian, *rows.offsets, rows.residual]))[part]
            laws, scale, residual = np.hsplit(columns, [-1 - rows.offsets[1].shape[1], -1])
            rank = float(len(offset_modes(laws, scale, residual[:, 0])[0]))
        tests = [(1, np.array([_BENDS, stretch]), rank, _OFF_SCALE)]
        if scatter.rank:
            tests.append((0, scatter.tau, float(scatter.rank), _OFF_BIAS))
        for kind, tau, rank, least in tests:
            columns = np.column_stack([rows.jacobian, rows.offsets[kind][:, of_recording], rows.residual])
            laws, offsets, residual = np.hsplit(whitener(rows, excess, tau)(columns), [-4, -1])
            s, force = offset_modes(laws, offsets, residual[:, 0])
            if not len(s):
                continue
            size = float(np.sqrt(np.sum((force / s) ** 2) / 3))
            chance = len(numbers) * tail_probability(float(np.mean(force**2)), len(s), rank)
            if chance < RECORDING_DISAGREEMENT.level and size > least:
                by = f"{1e6 * size:.0f} ppm in scale factors" if kind else f"{1e3 * size:.2g} mg in biases"
                asked.append((chance, f"{holds.recordings[number].name}: lies off the other recordings by {by}"))
    return [
        Finding(
            f"{words}, far more than they differ among themselves: is it of the same unit, at the temperature that it "
            "says, or have the laws a bend there? come back to that temperature",
            "record again at that temperature",
        )
        for _, words in sorted(asked)[:1]
    ]


def _leave_out(problem: ThermalProblem, gone: NDArray[np.bool_]) -> ThermalProblem:
    """Return the problem without some of its holds."""
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


def _measure_disagreement(problem: ThermalProblem, laws: Laws) -> float:
    """Return the scatter between and within recordings about polynomials of the highest degrees, g."""
    limit = max(int(number_temperatures(problem.temperature).max(initial=0)) - 1, 0)
    degrees = (min(DEGREES[0], limit), min(DEGREES[1], limit), min(DEGREES[2], limit))
    try:
        # A large scatter, so that a recording of another unit does not bend the laws.
        free = solve(problem, replace(laws, degrees=degrees, knots=()), tau=_BENDS)
    except np.linalg.LinAlgError:
        return np.inf
    if not free.converged:
        return np.inf
    return float(np.hypot(free.excess, fit_turn_on_scatter(free.rows, free.excess**2).tau[0]))
