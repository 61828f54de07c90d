"""How the degrees of the laws are chosen, and how well temperatures are predicted that were left out whole.

From the highest degrees *down*, a step at a time, where a step is insignificant (F at 1 %) and interior temperatures,
left out whole, are predicted no worse: upward selection stops short where a law has a kink. The same is done with a
natural cubic spline of the bias. It is taken where its values at the knots differ significantly from a cubic, as far as
recordings tell that, and it predicts the temperatures left out at most a tenth worse than polynomials do: without one
of its knots it must bridge twice the distance, which costs polynomials nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.errors import ObservabilityError
from imulab.estimation.least_squares import Observability, observability
from imulab.procedures.thermal.choices import APART, DEGREES, LEAST_KNOTS
from imulab.procedures.thermal.model import GROUPS, Laws, cardinal_spline
from imulab.procedures.thermal.rows import Problem, Rows, together, whitener
from imulab.procedures.thermal.solve import Solution, solve
from imulab.recording import Array

Degrees = tuple[int, int, int]
_INSIGNIFICANT = 0.01
_NO_WORSE = 1.0
_HANDICAP = 1.1
"""Error at temperatures left out, over that of polynomials, up to which a spline is taken."""
_TOLD = 2000.0
_TUMBLE = 9
"""Attitudes that tell the parameters at one temperature."""


@dataclass(frozen=True)
class LeftOut:
    """One interior temperature left out whole: degC, holds, rms of | |f| - g | there in g, chi-square per hold."""

    temperature: float
    holds: int
    rms: float
    chi_square: float


@dataclass(frozen=True)
class Step:
    """Degrees that were compared: rms over the temperatures left out (g), probability of the step, whether chosen.

    `knots`: how many the spline of the bias had, 0 of a polynomial.
    """

    degrees: Degrees
    left_out: float | None
    probability: float | None
    chosen: bool = False
    knots: int = 0


@dataclass(frozen=True)
class Found:
    """Laws that were fitted: the solution, what was compared on the way, temperatures left out, what the rows tell.

    `missed`: higher degrees that the holds need, and how probable what these add would be by chance, where the degrees
    were stated.
    """

    solution: Solution
    steps: list[Step]
    left_out: list[LeftOut]
    view: Observability
    missed: tuple[Degrees, float] | None = None


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
    """One temperature left out: its rows with their V, and all others whitened; the Jacobians have every column.

    `untold` are the columns of a spline that has a knot there: fits to all other temperatures do without them.
    """

    number: int
    jacobian: Array
    target: Array
    covariance: Array
    rest: Array
    rest_target: Array
    untold: tuple[int, ...] = ()


def splits(solution: Solution, cluster: NDArray[np.int64]) -> list[Split]:
    """Return the split at each interior temperature: the factor of V is what takes time, and no choice changes it."""
    rows, found = solution.rows, []
    whole = np.zeros(rows.jacobian.shape[1])
    whole[: len(solution.coefficients)] = solution.coefficients
    target = rows.jacobian @ whole - rows.residual
    at = np.where(rows.owner >= 0, cluster[rows.owner], -1)
    for number in range(1, int(cluster.max(initial=0))):
        jacobian, untold = _without_knot(rows.jacobian, solution.laws, number)
        train, test = at != number, (at == number) & rows.magnitude
        white = whitener(rows_where(rows, train), solution.excess**2, solution.scatter.tau)
        own = together(rows_where(rows, test), solution.excess**2, solution.scatter.tau)
        rest = white(jacobian[train]), white(target[train])
        found.append(Split(number, jacobian[test], target[test], own, *rest, untold))
    return found


def _without_knot(jacobian: Array, laws: Laws, number: int) -> tuple[Array, tuple[int, ...]]:
    """Return the Jacobian by the coefficients of the spline without one of its knots, and by one that bends there.

    The columns of the latter, one for each axis, are returned too; without a spline nothing changes.
    """
    if not laws.knots:
        return jacobian, ()
    fewer = np.delete(laws.knots, number)
    basis = np.insert(cardinal_spline(tuple(fewer.tolist()))(laws.knots), number, 0.0, axis=1)
    basis[number, number] = 1.0
    changed = jacobian.copy()
    for part in laws.parts[:3]:
        changed[:, part] = jacobian[:, part] @ basis
    return changed, tuple(part.start + number for part in laws.parts[:3])


def left_out(given: Sequence[Split], kept: NDArray[np.bool_]) -> list[LeftOut]:
    """Return the errors at each interior temperature under a fit, with these coefficients alone, to all others."""
    found = []
    for split in given:
        columns = np.ones(split.rest.shape[1], dtype=np.bool_)
        columns[: len(kept)] = kept
        columns[list(split.untold)] = False
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


def rows_where(rows: Rows, which: NDArray[np.bool_]) -> Rows:
    """Return some of the rows, with every column."""
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


def choose(
    problem: Problem, laws: Laws, wanted: str | Degrees, tau: float | None, name: str, *, spline: bool = False
) -> Found:
    """Solve with the degrees wanted, or with those that data and prediction support; `spline` that of the bias.

    Raises
    ------
    ObservabilityError
        The holds cannot separate the coefficients; the message names them.
    """
    cluster = clusters_of(problem.temperature)
    knots = knots_at(problem.temperature, cluster, laws)
    limit = max(len(knots) - 2, 0)
    highest = replace(laws, degrees=(min(DEGREES[0], limit), min(DEGREES[1], limit), min(DEGREES[2], limit)))

    def solved(own: Laws, known: float | None) -> Solution:
        return solve(problem, own, tau=known)

    if wanted != "auto":
        own = replace(laws, degrees=(int(wanted[0]), int(wanted[1]), int(wanted[2])), knots=knots if spline else ())
        if max(own.degrees) >= len(knots) or (spline and len(knots) < LEAST_KNOTS):
            needed = f"{LEAST_KNOTS} temperatures or more" if spline else "a degree below their number"
            raise ObservabilityError(
                f"{name}: degrees {own.spelled} at {len(knots)} temperatures (5 K apart); expected {needed}: record at "
                "more temperatures"
            )
        solution, view = _observable(problem, own, tau, name)
        solution = bounded(solution, tau, solved)
        held = left_out(splits(solution, cluster), np.ones(own.size, dtype=np.bool_))
        missed = _missed(problem, solution, highest, tau, name)
        return Found(solution, [], _at(held, problem, cluster), view, missed)
    found = _descended(problem, highest, cluster, tau, name)
    steps = found.steps
    if len(knots) >= LEAST_KNOTS:
        try:
            bent = _descended(problem, replace(highest, knots=knots), cluster, tau, name)
        except ObservabilityError:
            pass  # the holds do not tell so many values of the bias
        else:
            steps = steps + bent.steps
            if bends(bent.solution, tau) and predicts(bent.left_out, found.left_out):
                solution = bounded(bent.solution, tau, solved)
                held = left_out(splits(solution, cluster), np.ones(solution.laws.size, dtype=np.bool_))
                found = replace(bent, solution=solution, left_out=held)
    own = found.solution.laws
    unique = {
        (step.degrees, step.knots): replace(step, chosen=(step.degrees, step.knots) == (own.degrees, len(own.knots)))
        for step in steps
    }
    return replace(found, steps=list(unique.values()), left_out=_at(found.left_out, problem, cluster))


def _missed(
    problem: Problem, solution: Solution, highest: Laws, tau: float | None, name: str
) -> tuple[Degrees, float] | None:
    """Return the degrees that ``auto`` starts from, as far as the holds tell them, if stated ones are too low (1 %)."""
    own = solution.laws
    bias, scale, misalignment = (max(pair) for pair in zip(own.degrees, highest.degrees, strict=True))
    larger = replace(own, degrees=(bias, scale, misalignment))
    try:
        higher, _ = _highest(problem, larger, tau, name)
    except ObservabilityError:
        return None
    added = [
        place
        for part, before in zip(higher.laws.parts, own.parts, strict=True)
        for place in range(part.start + before.stop - before.start, part.stop)
    ]
    if not added:
        return None
    probability = wald(higher, np.eye(higher.laws.size)[added])
    return (higher.laws.degrees, probability) if probability < _INSIGNIFICANT else None


def bounded(solution: Solution, tau: float | None, solved: Callable[[Laws, float | None], Solution]) -> Solution:
    """Return a spline's solution with the scatter between power cycles that polynomials leave, if it cannot tell it.

    `solved` returns the solution of laws with a scatter, or with none known.

    A spline takes the offset of the only recording at a knot for the law. What polynomials leave is that scatter and
    the bends that they do not follow: a bound.
    """
    if not solution.laws.knots or solution.scatter.rank or tau is not None:
        return solution
    scatter = solved(replace(solution.laws, knots=()), None).scatter
    again = solved(solution.laws, float(scatter.tau[0]))
    return replace(again, scatter=replace(scatter, bound=True)) if scatter.rank and again.converged else solution


def knots_at(temperature: Array, cluster: NDArray[np.int64], laws: Laws) -> tuple[float, ...]:
    """Return the temperatures that were calibrated, degC, the outer ones at the ends of the range."""
    inner = [float(temperature[cluster == number].mean()) for number in range(1, int(cluster.max(initial=0)))]
    return (laws.low, *inner, laws.high)


def _descended(problem: Problem, highest: Laws, cluster: NDArray[np.int64], tau: float | None, name: str) -> Found:
    """Return the fit with the degrees to which steps down lead; a spline stays."""
    solution, view = _highest(problem, highest, tau, name)
    given = splits(solution, cluster)
    held = left_out(given, np.ones(solution.laws.size, dtype=np.bool_))
    steps = [Step(solution.laws.degrees, rms_of(held), None, knots=len(highest.knots))]
    while True:
        free = [group for group in range(3) if solution.laws.degrees[group] and not (group == 0 and highest.knots)]
        down = [step_down(solution, group, given) for group in free]
        steps += down
        fine = [step for step in down if may_be_taken(step, rms_of(held))]
        if not fine:
            return Found(solution, steps, held, view)
        best = max(fine, key=lambda step: step.probability or 0.0)
        solution, view = _observable(problem, replace(solution.laws, degrees=best.degrees), tau, name)
        given = splits(solution, cluster)
        held = left_out(given, np.ones(solution.laws.size, dtype=np.bool_))


def _highest(problem: Problem, laws: Laws, tau: float | None, name: str) -> tuple[Solution, Observability]:
    """Return the fit of the highest degrees, down from those given, that the holds determine."""
    while True:
        lowered = list(laws.degrees)
        free = [group for group in range(3) if lowered[group] and not (group == 0 and laws.knots)]
        try:
            return _observable(problem, laws, tau, name)
        except ObservabilityError:
            if not free:
                raise
        lowered[max(free, key=lambda group: (group, lowered[group]))] -= 1
        laws = replace(laws, degrees=(lowered[0], lowered[1], lowered[2]))


def bends(solution: Solution, tau: float | None) -> bool:
    """Return whether a spline's values at the knots lie on no cubic (F at 1 %), or nobody can tell.

    That is where a spline takes the offset of the only recording at a knot for the law.
    """
    if not solution.scatter.rank and tau is None:
        return True
    laws, count = solution.laws, len(solution.laws.knots)
    cubics = np.vander(laws.place(np.array(laws.knots)), 4)
    beside = np.linalg.qr(cubics, mode="complete").Q[:, 4:].T
    weights = np.zeros((3 * (count - 4), 3 * count))
    for axis, part in enumerate(laws.parts[:3]):
        weights[axis * (count - 4) : (axis + 1) * (count - 4), part] = beside
    return wald(solution, weights) < _INSIGNIFICANT


def predicts(bent: Sequence[LeftOut], straight: Sequence[LeftOut]) -> bool:
    """Return whether a spline predicts the temperatures that both could leave out well enough to be taken."""
    both = {each.temperature for each in bent} & {each.temperature for each in straight}
    errors = [rms_of([each for each in given if each.temperature in both]) for given in (bent, straight)]
    return errors[0] is not None and errors[1] is not None and errors[0] <= _HANDICAP * errors[1]


def _observable(problem: Problem, laws: Laws, tau: float | None, name: str) -> tuple[Solution, Observability]:
    solution = solve(problem, laws, tau=tau)
    view = seen(solution)
    size = solution.rows.jacobian.shape[1] - len(problem.free)
    if view.rank < size or not solution.converged:
        names = laws.spoken() + [f"direction of unmoved hold {k // 2 + 1}" for k in range(size - laws.size)]
        confused = ", ".join(view.confused(names)[:6])
        raise ObservabilityError(
            f"{name}: {len(problem.reading)} holds determine {view.rank} of the {size} unknowns of degrees "
            f"{laws.spelled}; they cannot separate {confused}; {_help(problem, laws)} would help"
        )
    return solution, view


def _help(problem: Problem, laws: Laws) -> str:
    """Return what would tell the coefficients that these holds do not."""
    if np.count_nonzero(problem.group < 0) < _TUMBLE and problem.known is None:
        return "a tumble beside the rest ramps, the unit turned through a dozen attitudes at one temperature,"
    more = "more attitudes at each temperature"
    return f"{more}, or lower --degrees," if max(laws.degrees) else more


def step_down(solution: Solution, group: int, given: Sequence[Split]) -> Step:
    """Return what is lost where the highest power of one kind is left out: Wald's test, and the prediction."""
    laws, degrees = solution.laws, list(solution.laws.degrees)
    gone = np.array([part.stop - 1 for part in laws.parts[3 * group : 3 * group + 3]])
    size = len(solution.coefficients)
    kept = np.ones(size, dtype=np.bool_)
    kept[gone] = False
    degrees[group] -= 1
    lower = (degrees[0], degrees[1], degrees[2])
    return Step(lower, rms_of(left_out(given, kept)), wald(solution, np.eye(size)[gone]), knots=len(laws.knots))


def wald(solution: Solution, weights: Array) -> float:
    """Return the probability of such ``weights . coefficients``, (k, first ones), if the true ones were 0."""
    size = weights.shape[1]
    value = weights @ solution.coefficients[:size]
    covariance = weights @ solution.covariance[:size, :size] @ weights.T
    square = float(value @ np.linalg.solve(covariance, value)) / len(value)
    return tail(square, len(value), min(solution.degrees_of_freedom(row) for row in weights))


def tail(square: float, count: int, freedom: float) -> float:
    """Return the probability of so large a mean square of `count` terms; chi-square where the freedom is infinite."""
    from imulab.estimation.special import chdtrc, fdtrc

    return float(fdtrc(count, freedom, square) if np.isfinite(freedom) else chdtrc(count, count * square))


def rms_of(found: Sequence[LeftOut]) -> float | None:
    """Return the rms over all holds of the temperatures left out; None where there are none."""
    total = sum(each.holds for each in found)
    return float(np.sqrt(sum(each.holds * each.rms**2 for each in found) / total)) if total else None


def may_be_taken(step: Step, before: float | None) -> bool:
    """Return whether a step down is insignificant, and temperatures left out are known to be predicted no worse.

    `before` is their rms without the step: an F-test alone may lack all power.
    """
    told = step.left_out is not None and before is not None and step.left_out <= _NO_WORSE * before
    return told and (step.probability or 0) > _INSIGNIFICANT


def _at(found: Sequence[LeftOut], problem: Problem, cluster: NDArray[np.int64]) -> list[LeftOut]:
    """Return them with the temperature instead of its number."""
    return [replace(each, temperature=float(problem.temperature[cluster == each.temperature].mean())) for each in found]


def spoken_degrees(degrees: Degrees, knots: int = 0) -> str:
    """Return degrees as messages say them: ``bias 3, scale factor 2, misalignment 1``, or a spline of the bias."""
    said = [f"{kind.replace('_', ' ')} {degree}" for (kind, _), degree in zip(GROUPS, degrees, strict=True)]
    return ", ".join([f"bias by a spline with {knots} knots", *said[1:]] if knots else said)
