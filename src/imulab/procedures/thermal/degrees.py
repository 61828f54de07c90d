"""How the degrees of the laws are chosen, and how well temperatures are predicted that were left out whole.

From the highest degrees *down*, a step at a time, where a step is insignificant (F at 1 %) and interior temperatures,
left out whole, are predicted no worse: upward selection stops short where a law has a kink.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.errors import ObservabilityError
from imulab.estimation.least_squares import Observability, observability
from imulab.procedures.thermal.choices import APART, DEGREES
from imulab.procedures.thermal.model import GROUPS, Laws
from imulab.procedures.thermal.rows import Problem, Rows, together, whitener
from imulab.procedures.thermal.solve import Solution, solve
from imulab.recording import Array

Degrees = tuple[int, int, int]
_INSIGNIFICANT = 0.01
_NO_WORSE = 1.0
_TOLD = 2000.0


@dataclass(frozen=True)
class LeftOut:
    """One interior temperature left out whole: degC, holds, rms of | |f| - g | there in g, chi-square per hold."""

    temperature: float
    holds: int
    rms: float
    chi_square: float


@dataclass(frozen=True)
class Step:
    """Degrees that were compared: rms over the temperatures left out (g), probability of the step, whether chosen."""

    degrees: Degrees
    left_out: float | None
    probability: float | None
    chosen: bool = False


def clusters_of(temperature: Array) -> NDArray[np.int64]:
    """Return the number of the temperature that each hold is at; those within 5 K of the first of a cluster are one."""
    order, number, first = np.argsort(temperature, kind="stable"), -1, -np.inf
    found = np.empty(len(temperature), dtype=np.int64)
    for index in order.tolist():
        if temperature[index] > first + APART:
            number, first = number + 1, temperature[index]
        found[index] = number
    return found


def seen(solution: Solution) -> Observability:
    """Return what the holds tell apart, unmoved directions included; lag and loops were judged before."""
    rows = solution.rows
    fitted = np.s_[solution.laws.size : len(solution.coefficients)]
    return observability(np.delete(rows.jacobian, fitted, axis=1), 1 / (np.diag(rows.noise) + solution.excess**2))


@dataclass(frozen=True)
class Split:
    """One temperature left out: its rows with their V, and all others whitened; the Jacobians have every column."""

    number: int
    jacobian: Array
    target: Array
    covariance: Array
    rest: Array
    rest_target: Array


def splits(solution: Solution, cluster: NDArray[np.int64]) -> list[Split]:
    """Return the split at each interior temperature: the factor of V is what takes time, and no choice changes it."""
    rows, found = solution.rows, []
    whole = np.zeros(rows.jacobian.shape[1])
    whole[: len(solution.coefficients)] = solution.coefficients
    target = rows.jacobian @ whole - rows.residual
    at = np.where(rows.owner >= 0, cluster[rows.owner], -1)
    for number in range(1, int(cluster.max(initial=0))):
        train, test = at != number, (at == number) & rows.magnitude
        white = whitener(_part(rows, train), solution.excess**2, solution.scatter.tau)
        own = together(_part(rows, test), solution.excess**2, solution.scatter.tau)
        given = rows.jacobian[train], target[train]
        found.append(Split(number, rows.jacobian[test], target[test], own, white(given[0]), white(given[1])))
    return found


def left_out(given: Sequence[Split], kept: NDArray[np.bool_]) -> list[LeftOut]:
    """Return the errors at each interior temperature under a fit, with these coefficients alone, to all others."""
    found = []
    for split in given:
        columns = np.ones(split.rest.shape[1], dtype=np.bool_)
        columns[: len(kept)] = kept
        rest, jacobian = split.rest[:, columns], split.jacobian[:, columns]
        values = np.linalg.svd(rest / np.maximum(np.linalg.norm(rest, axis=0), 1e-300), compute_uv=False)
        if not values[-1] > values[0] / _TOLD or len(rest) < rest.shape[1]:
            continue  # the only tumble is at this temperature: the others do not determine the laws
        inverse = np.linalg.pinv(rest, rcond=1e-13)
        error = split.target - jacobian @ (inverse @ split.rest_target)
        carried = jacobian @ inverse
        scatter = split.covariance + carried @ carried.T
        chi_square = float(error @ np.linalg.solve(scatter, error)) / len(error)
        found.append(LeftOut(split.number, len(error), float(np.sqrt(np.mean(error**2))), chi_square))
    return found


def _part(rows: Rows, which: NDArray[np.bool_]) -> Rows:
    return replace(
        rows,
        residual=rows.residual[which],
        jacobian=rows.jacobian[which],
        noise=rows.noise[np.ix_(which, which)],
        offsets=(rows.offsets[0][which], rows.offsets[1][which]),
        errors=rows.errors[which],
        drift=rows.drift[which],
        owner=rows.owner[which],
        magnitude=rows.magnitude[which],
    )


def choose(problem: Problem, laws: Laws, wanted: str | Degrees, tau: float | None, name: str) -> tuple[
    Solution, list[Step], list[LeftOut], Observability
]:  # fmt: skip
    """Solve with the degrees wanted, or with those that data and prediction support.

    Raises
    ------
    ObservabilityError
        The holds cannot separate the coefficients; the message names them.
    """
    cluster = clusters_of(problem.temperature)
    limit = max(int(cluster.max(initial=0)) + 1 - 2, 0)
    if wanted != "auto":
        degrees = (int(wanted[0]), int(wanted[1]), int(wanted[2]))
        if max(degrees) > int(cluster.max(initial=0)):
            raise ObservabilityError(
                f"{name}: degrees {','.join(map(str, degrees))} at {int(cluster.max()) + 1} temperatures (5 K apart); "
                "expected a degree below their number: record at more temperatures"
            )
        solution, view = _observable(problem, replace(laws, degrees=degrees), tau, name)
        return solution, [], _at(left_out(splits(solution, cluster), _all(laws, degrees)), problem, cluster), view
    degrees = _start(problem, laws, limit, tau, name)
    solution, view = _observable(problem, replace(laws, degrees=degrees), tau, name)
    given = splits(solution, cluster)
    held = left_out(given, _all(laws, degrees))
    steps = [Step(degrees, _rms(held), None, True)]
    while True:
        down = [_step(solution, group, given) for group in range(3) if solution.laws.degrees[group]]
        steps += down
        before = _rms(held)
        fine = [step for step in down if (step.probability or 0) > _INSIGNIFICANT and _no_worse(step.left_out, before)]
        if not fine:
            break
        best = max(fine, key=lambda step: step.probability or 0.0)
        solution, view = _observable(problem, replace(laws, degrees=best.degrees), tau, name)
        given = splits(solution, cluster)
        held = left_out(given, _all(laws, best.degrees))
    chosen = solution.laws.degrees
    unique = {step.degrees: replace(step, chosen=step.degrees == chosen) for step in steps}
    return solution, list(unique.values()), _at(held, problem, cluster), view


def _start(problem: Problem, laws: Laws, limit: int, tau: float | None, name: str) -> Degrees:
    """Return the highest degrees, of those from which auto starts, that the holds determine."""
    tried = [min(degree, limit) for degree in DEGREES]
    while any(tried):
        degrees = (tried[0], tried[1], tried[2])
        try:
            _observable(problem, replace(laws, degrees=degrees), tau, name)
        except ObservabilityError:
            group = max((k for k in range(3) if tried[k]), key=lambda k: (k, tried[k]))
            tried[group] -= 1
            continue
        return degrees
    return (0, 0, 0)


def _observable(problem: Problem, laws: Laws, tau: float | None, name: str) -> tuple[Solution, Observability]:
    solution = solve(problem, laws, tau=tau)
    view = seen(solution)
    size = solution.rows.jacobian.shape[1] - len(problem.free)
    if view.rank < size or not solution.converged:
        names = laws.spoken() + [f"direction of unmoved hold {k // 2 + 1}" for k in range(size - laws.size)]
        confused = ", ".join(view.confused(names)[:6])
        raise ObservabilityError(
            f"{name}: {len(problem.reading)} holds determine {view.rank} of the {size} unknowns of degrees "
            f"{','.join(map(str, laws.degrees))}; they cannot separate {confused}; more attitudes at each temperature, "
            "or lower --degrees, would help"
        )
    return solution, view


def _step(solution: Solution, group: int, given: Sequence[Split]) -> Step:
    """Return what is lost where the highest power of one kind is left out: Wald's test, and the prediction."""
    degrees = list(solution.laws.degrees)
    kept = np.ones(solution.laws.size, dtype=np.bool_)
    at = 0
    for kind, degree in enumerate(solution.laws.degrees):
        for _ in range(3):
            at += degree + 1
            kept[at - 1] = kept[at - 1] and kind != group
    gone = np.flatnonzero(~kept)
    value = solution.coefficients[gone]
    square = float(value @ np.linalg.solve(solution.covariance[np.ix_(gone, gone)], value)) / len(value)
    freedom = min(solution.degrees_of_freedom(row) for row in np.eye(len(kept))[gone])
    degrees[group] -= 1
    probability = tail(square, len(value), freedom)
    return Step((degrees[0], degrees[1], degrees[2]), _rms(left_out(given, kept)), probability)


def tail(square: float, count: int, freedom: float) -> float:
    """Return the probability of so large a mean square of `count` terms; chi-square where the freedom is infinite."""
    from imulab.estimation.special import chdtrc, fdtrc

    return float(fdtrc(count, freedom, square) if np.isfinite(freedom) else chdtrc(count, count * square))


def _all(laws: Laws, degrees: Degrees) -> NDArray[np.bool_]:
    return np.ones(replace(laws, degrees=degrees).size, dtype=np.bool_)


def _rms(found: Sequence[LeftOut]) -> float | None:
    total = sum(each.holds for each in found)
    return float(np.sqrt(sum(each.holds * each.rms**2 for each in found) / total)) if total else None


def _no_worse(error: float | None, before: float | None) -> bool:
    return error is None or before is None or error <= _NO_WORSE * before


def _at(found: Sequence[LeftOut], problem: Problem, cluster: NDArray[np.int64]) -> list[LeftOut]:
    """Return them with the temperature instead of its number."""
    return [replace(each, temperature=float(problem.temperature[cluster == each.temperature].mean())) for each in found]


def spoken_degrees(degrees: Degrees) -> str:
    """Return degrees as messages say them: ``bias 3, scale factor 2, misalignment 1``."""
    return ", ".join(f"{kind.replace('_', ' ')} {degree}" for (kind, _), degree in zip(GROUPS, degrees, strict=True))
