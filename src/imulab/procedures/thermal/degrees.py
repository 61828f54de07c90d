"""The choice of the laws' degrees, and of lag and loops of the biases beside them.

Degrees (`choose_laws`): from the highest *down*, one step at a time, as long as a step is insignificant (F at 1 %) and
interior temperatures that are left out whole are predicted no worse. (Upward selection stops too early where a law has
a kink.) The same is done with a natural cubic spline of the bias. It is taken if its values at the knots lie on no
cubic, by the same test, and if it predicts left-out temperatures at most a tenth worse than polynomials: without a knot
a spline must bridge twice the distance.

Lag and loops (`fit_lag_and_loops`): a lag L of the unit, ``p(T - L dT/dt)``, and a loop h of each axis,
``h sign(dT/dt) (1 - theta^2)``, are fitted beside the laws. Lag and loops are each tested given the other (F at 1 %);
the significant ones stay in the fit. Corrected outputs use L = 0 and h = 0, since a unit would have to differentiate
its temperature.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding, Note
from imulab.errors import ObservabilityError
from imulab.estimation.decisions import (
    LAG_OR_LOOP,
    THERMAL_DEGREES_TOO_LOW,
    THERMAL_LAW_BENDS,
    THERMAL_POWER,
)
from imulab.estimation.distributions import chi_square_tail, f_tail
from imulab.estimation.least_squares import Observability, observability
from imulab.procedures.thermal import APART, DEGREES, LEAST_KNOTS
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import AXES, GROUPS, Laws, cardinal_spline
from imulab.procedures.thermal.schema import TestedEffect
from imulab.procedures.thermal.solve import (
    ThermalProblem,
    ThermalSolution,
    row_covariance,
    solve,
)
from imulab.recording import Array

# Choice of the degrees, and prediction of temperatures that were left out whole.


Degrees = tuple[int, int, int]
_NO_WORSE = 1.0  # times the error at temperatures left out that a lower degree may have
_HANDICAP = 1.1
"""Error at temperatures left out, over that of polynomials, up to which a spline is taken."""
_TOLD = 2000.0  # condition number up to which a temperature can be left out
_TUMBLE = 9
"""Fewest attitudes that determine the parameters at one temperature."""


@dataclass(frozen=True)
class LeftOutCluster:
    """An interior temperature, degC, left out whole: its holds, rms of | |f| - g | in g, chi-square per hold."""

    temperature: float
    holds: int
    rms: float
    chi_square: float


@dataclass(frozen=True)
class DegreesStep:
    """Degrees that were compared: rms over the temperatures left out (g), probability of the step, whether chosen.

    `knots` is the number of knots of the bias, 0 for a polynomial.
    """

    degrees: Degrees
    left_out: float | None
    probability: float | None
    chosen: bool = False
    knots: int = 0


@dataclass(frozen=True)
class ChosenLaws:
    """The fitted laws: solution, compared degrees, temperatures left out, and observability.

    `missed`, where the degrees were stated too low: higher ones that the holds need, and the probability of their
    additional coefficients by chance.
    """

    solution: ThermalSolution
    steps: list[DegreesStep]
    left_out: list[LeftOutCluster]
    view: Observability
    missed: tuple[Degrees, float] | None = None


def number_temperatures(temperature: Array) -> NDArray[np.int64]:
    """Return the number of each hold's temperature, ascending; those within 5 K of the first of a cluster are one."""
    order, number, first = np.argsort(temperature, kind="stable"), -1, -np.inf
    numbers = np.empty(len(temperature), dtype=np.int64)
    for index in order.tolist():
        if temperature[index] > first + APART:
            number, first = number + 1, temperature[index]
        numbers[index] = number
    return numbers


def judge_observability(solution: ThermalSolution) -> Observability:
    """Return rank and condition of laws and directions of unmoved holds; lag and loops are judged elsewhere."""
    rows = solution.rows
    fitted = np.s_[min(solution.laws.size, len(solution.coefficients)) : len(solution.coefficients)]
    return observability(np.delete(rows.jacobian, fitted, axis=1), 1 / (np.diag(rows.noise) + solution.excess**2))


@dataclass(frozen=True)
class Split:
    """One temperature left out: its rows with their covariance V, and all others whitened, as their triangle R.

    `untold` are the columns of the spline's knot there, which fits to all other temperatures do not determine.
    """

    number: int
    jacobian: Array
    target: Array
    covariance: Array
    rest: Array
    rest_target: Array
    untold: tuple[int, ...] = ()


def split_temperatures(solution: ThermalSolution, cluster: NDArray[np.int64]) -> list[Split]:
    """Return the split at each interior temperature, once for all degrees, since whitening takes the time."""
    rows, parts = solution.rows, []
    whole = np.zeros(rows.jacobian.shape[1])
    whole[: len(solution.coefficients)] = solution.coefficients
    target = rows.jacobian @ whole - rows.residual
    at = np.where(rows.owner >= 0, cluster[rows.owner], -1)
    count = len(at)
    whitened = solution.white(np.column_stack([np.eye(count), rows.jacobian, target]))
    covariance = row_covariance(rows, solution.excess**2, solution.scatter.tau)
    for number in range(1, int(cluster.max(initial=0))):
        both, missing = _remove_knot(np.vstack([rows.jacobian, whitened[:, count:-1]]), solution.laws, number)
        jacobian, white = both[:count], both[count:]
        out, test = np.flatnonzero(at == number), (at == number) & rows.magnitude
        test_weight = covariance[np.ix_(test, test)]
        # A row is left out by an unknown of its own: the triangle below these unknowns is that of the other rows.
        columns = np.column_stack([whitened[:, out], white, whitened[:, -1]])
        rest = np.asarray(np.linalg.qr(columns, mode="r"))[len(out) :, len(out) :]
        parts.append(Split(number, jacobian[test], target[test], test_weight, rest[:, :-1], rest[:, -1], missing))
    return parts


def _remove_knot(jacobian: Array, laws: Laws, number: int) -> tuple[Array, tuple[int, ...]]:
    """Return the Jacobian by coefficients of the spline without one of its knots, and by its bend at that knot.

    Also returns the columns of the bend, one for each axis. Without a spline nothing changes.
    """
    if not laws.knots:
        return jacobian, ()
    fewer = np.delete(laws.knots, number)
    basis = np.insert(cardinal_spline(tuple(fewer.tolist()))(np.array(laws.knots)), number, 0.0, axis=1)
    basis[number, number] = 1.0
    changed = jacobian.copy()
    for part in laws.parts[:3]:
        changed[:, part] = jacobian[:, part] @ basis
    return changed, tuple(part.start + number for part in laws.parts[:3])


def predict_left_out(splits: Sequence[Split], kept: NDArray[np.bool_]) -> list[LeftOutCluster]:
    """Return the errors at each interior temperature under a fit of the `kept` coefficients to all others.

    ``e = y - J p``, p the fit to the other temperatures with covariance P; chi-square is ``e' (V + J P J')^-1 e``.
    """
    errors = []
    for split in splits:
        columns = np.ones(split.rest.shape[1], dtype=np.bool_)
        columns[: len(kept)] = kept
        columns[list(split.untold)] = False
        rest, jacobian = split.rest[:, columns], split.jacobian[:, columns]
        size = np.maximum(np.linalg.norm(rest, axis=0), 1e-300)
        u, values, v = np.linalg.svd(rest / size, full_matrices=False)
        if not values[-1] > values[0] / _TOLD or len(rest) < rest.shape[1]:
            continue  # the other temperatures do not determine the laws: the only tumble is here
        inverse = v.T / values @ u.T / size[:, None]
        error = split.target - jacobian @ (inverse @ split.rest_target)
        carried = jacobian @ inverse
        scatter = split.covariance + carried @ carried.T
        chi_square = float(error @ np.linalg.solve(scatter, error)) / len(error)
        errors.append(LeftOutCluster(split.number, len(error), float(np.sqrt(np.mean(error**2))), chi_square))
    return errors


def choose_laws(
    problem: ThermalProblem, laws: Laws, wanted: str | Degrees, tau: float | None, name: str, *, spline: bool = False
) -> ChosenLaws:
    """Return the fit with the degrees wanted, or with those that data and prediction support.

    `spline`: the bias is a natural cubic spline.

    Raises
    ------
    ObservabilityError
        The holds cannot separate the coefficients; the message names them.
    """
    cluster = number_temperatures(problem.temperature)
    knots = place_knots(problem.temperature, cluster, laws)
    limit = max(len(knots) - 2, 0)
    highest = replace(laws, degrees=(min(DEGREES[0], limit), min(DEGREES[1], limit), min(DEGREES[2], limit)))

    def solved(form: Laws, known: float | None) -> ThermalSolution:
        return solve(problem, form, tau=known)

    if wanted != "auto":
        form = replace(laws, degrees=(int(wanted[0]), int(wanted[1]), int(wanted[2])), knots=knots if spline else ())
        if max(form.degrees) >= len(knots) or (spline and len(knots) < LEAST_KNOTS):
            needed = f"{LEAST_KNOTS} temperatures or more" if spline else "a degree below their number"
            raise ObservabilityError(
                f"{name}: degrees {form.spelled} at {len(knots)} temperatures (5 K apart); expected {needed}: record "
                "at more temperatures"
            )
        solution, view = _solve_observable(problem, form, tau, name)
        solution = bound_scatter(solution, tau, solved)
        held = predict_left_out(split_temperatures(solution, cluster), np.ones(form.size, dtype=np.bool_))
        missed = _find_missed_degrees(problem, solution, highest, tau, name)
        return ChosenLaws(solution, [], _name_temperatures(held, problem, cluster), view, missed)
    chosen = _step_down_degrees(problem, highest, cluster, tau, name)
    steps = chosen.steps
    if len(knots) >= LEAST_KNOTS:
        try:
            bent = _step_down_degrees(problem, replace(highest, knots=knots), cluster, tau, name)
        except ObservabilityError:
            pass  # the holds do not determine so many values of the bias
        else:
            steps = steps + bent.steps
            if law_bends(bent.solution, tau) and spline_predicts(bent.left_out, chosen.left_out):
                solution = bound_scatter(bent.solution, tau, solved)
                held = predict_left_out(
                    split_temperatures(solution, cluster), np.ones(solution.laws.size, dtype=np.bool_)
                )
                chosen = replace(bent, solution=solution, left_out=held)
    form = chosen.solution.laws
    unique = {
        (step.degrees, step.knots): replace(step, chosen=(step.degrees, step.knots) == (form.degrees, len(form.knots)))
        for step in steps
    }
    return replace(chosen, steps=list(unique.values()), left_out=_name_temperatures(chosen.left_out, problem, cluster))


def _find_missed_degrees(
    problem: ThermalProblem, solution: ThermalSolution, highest: Laws, tau: float | None, name: str
) -> tuple[Degrees, float] | None:
    """Return the highest degrees that the holds determine, and their probability, if stated ones are too low."""
    stated = solution.laws
    bias, scale, misalignment = (max(pair) for pair in zip(stated.degrees, highest.degrees, strict=True))
    larger = replace(stated, degrees=(bias, scale, misalignment))
    if larger == stated:
        return None
    try:
        higher, _ = _fit_highest(problem, larger, tau, name)
    except ObservabilityError:
        return None
    added = [
        place
        for part, before in zip(higher.laws.parts, stated.parts, strict=True)
        for place in range(part.start + before.stop - before.start, part.stop)
    ]
    if not added:
        return None
    probability = wald_probability(higher, np.eye(higher.laws.size)[added])
    return (higher.laws.degrees, probability) if probability < THERMAL_DEGREES_TOO_LOW.level else None


def bound_scatter(
    solution: ThermalSolution, tau: float | None, solved: Callable[[Laws, float | None], ThermalSolution]
) -> ThermalSolution:
    """Return a spline's solution with an upper bound of the scatter between power cycles, if it shows none itself.

    A spline takes the offset of the only recording at a knot for the law. The residuals of polynomials hold that
    scatter and the bends that they do not follow, and thus bound it. `solved` solves laws with a known scatter or None.
    """
    if not solution.laws.knots or solution.scatter.rank or tau is not None:
        return solution
    scatter = solved(replace(solution.laws, knots=()), None).scatter
    again = solved(solution.laws, float(scatter.tau[0]))
    return replace(again, scatter=replace(scatter, bound=True)) if scatter.rank and again.converged else solution


def place_knots(temperature: Array, cluster: NDArray[np.int64], laws: Laws) -> tuple[float, ...]:
    """Return the knots of a spline: the calibrated temperatures, degC, the outer ones at the ends of the range."""
    inner = [float(temperature[cluster == number].mean()) for number in range(1, int(cluster.max(initial=0)))]
    return (laws.low, *inner, laws.high)


def _step_down_degrees(
    problem: ThermalProblem, highest: Laws, cluster: NDArray[np.int64], tau: float | None, name: str
) -> ChosenLaws:
    """Return the fit after all steps down that may be taken; a spline of the bias keeps its degree."""
    solution, view = _fit_highest(problem, highest, tau, name)
    parts = split_temperatures(solution, cluster)
    held = predict_left_out(parts, np.ones(solution.laws.size, dtype=np.bool_))
    steps = [DegreesStep(solution.laws.degrees, rms_left_out(held), None, knots=len(highest.knots))]
    while True:
        free = [group for group in range(3) if solution.laws.degrees[group] and not (group == 0 and highest.knots)]
        down = [step_down(solution, group, parts) for group in free]
        steps += down
        fine = [step for step in down if may_be_taken(step, rms_left_out(held))]
        if not fine:
            return ChosenLaws(solution, steps, held, view)
        best = max(fine, key=lambda step: step.probability or 0.0)
        solution, view = _solve_observable(problem, replace(solution.laws, degrees=best.degrees), tau, name)
        parts = split_temperatures(solution, cluster)
        held = predict_left_out(parts, np.ones(solution.laws.size, dtype=np.bool_))


def _fit_highest(
    problem: ThermalProblem, laws: Laws, tau: float | None, name: str
) -> tuple[ThermalSolution, Observability]:
    """Return the fit of the highest degrees that the holds determine, from those of `laws` down."""
    while True:
        lowered = list(laws.degrees)
        free = [group for group in range(3) if lowered[group] and not (group == 0 and laws.knots)]
        try:
            return _solve_observable(problem, laws, tau, name)
        except ObservabilityError:
            if not free:
                raise
        lowered[max(free, key=lambda group: (group, lowered[group]))] -= 1
        laws = replace(laws, degrees=(lowered[0], lowered[1], lowered[2]))


def law_bends(solution: ThermalSolution, tau: float | None) -> bool:
    """Return whether a spline's values at the knots lie on no cubic (F at 1 %), or this cannot be tested.

    It cannot where the scatter between power cycles is not known: each offset then looks like a bend.
    """
    if not solution.scatter.rank and tau is None:
        return True
    laws, count = solution.laws, len(solution.laws.knots)
    cubics = np.vander(laws.place(np.array(laws.knots)), 4)
    beside = np.linalg.qr(cubics, mode="complete").Q[:, 4:].T
    weights = np.zeros((3 * (count - 4), 3 * count))
    for axis, part in enumerate(laws.parts[:3]):
        weights[axis * (count - 4) : (axis + 1) * (count - 4), part] = beside
    return wald_probability(solution, weights) < THERMAL_LAW_BENDS.level


def spline_predicts(bent: Sequence[LeftOutCluster], straight: Sequence[LeftOutCluster]) -> bool:
    """Return whether a spline predicts left-out temperatures, of those that both could leave out, well enough."""
    both = {each.temperature for each in bent} & {each.temperature for each in straight}
    errors = [
        rms_left_out([each for each in predictions if each.temperature in both]) for predictions in (bent, straight)
    ]
    return errors[0] is not None and errors[1] is not None and errors[0] <= _HANDICAP * errors[1]


def _solve_observable(
    problem: ThermalProblem, laws: Laws, tau: float | None, name: str
) -> tuple[ThermalSolution, Observability]:
    """Return the solution and its observability; raises ObservabilityError where coefficients are not determined."""
    solution = solve(problem, laws, tau=tau)
    view = judge_observability(solution)
    size = solution.rows.jacobian.shape[1] - len(problem.free)
    if view.rank < size or not solution.converged:
        names = laws.spoken() + [f"direction of unmoved hold {k // 2 + 1}" for k in range(size - laws.size)]
        confused = ", ".join(view.confused(names)[:6])
        raise ObservabilityError(
            f"{name}: {len(problem.reading)} holds determine {view.rank} of the {size} unknowns of degrees "
            f"{laws.spelled}; they cannot separate {confused}; {_suggest_recordings(problem, laws)} would help"
        )
    return solution, view


def _suggest_recordings(problem: ThermalProblem, laws: Laws) -> str:
    """Return which further recordings would determine the coefficients."""
    if np.count_nonzero(problem.group < 0) < _TUMBLE and problem.known is None:
        return "a tumble beside the rest ramps, the unit turned through a dozen attitudes at one temperature,"
    more = "more attitudes at each temperature"
    return f"{more}, or lower --degrees," if max(laws.degrees) else more


def step_down(solution: ThermalSolution, group: int, parts: Sequence[Split]) -> DegreesStep:
    """Return the step that leaves out the highest power of one kind: its probability and its prediction."""
    laws, degrees = solution.laws, list(solution.laws.degrees)
    gone = np.array([part.stop - 1 for part in laws.parts[3 * group : 3 * group + 3]])
    size = len(solution.coefficients)
    kept = np.ones(size, dtype=np.bool_)
    kept[gone] = False
    degrees[group] -= 1
    lower = (degrees[0], degrees[1], degrees[2])
    return DegreesStep(
        lower,
        rms_left_out(predict_left_out(parts, kept)),
        wald_probability(solution, np.eye(size)[gone]),
        knots=len(laws.knots),
    )


def wald_probability(solution: ThermalSolution, weights: Array) -> float:
    """Return the probability of such ``weights . coefficients``, weights (k, n), if the true ones are 0 (Wald, F)."""
    size = weights.shape[1]
    value = weights @ solution.coefficients[:size]
    covariance = weights @ solution.covariance[:size, :size] @ weights.T
    square = float(value @ np.linalg.solve(covariance, value)) / len(value)
    return tail_probability(square, len(value), min(solution.degrees_of_freedom(row) for row in weights))


def tail_probability(square: float, count: int, freedom: float) -> float:
    """Return the probability of so large a mean square of `count` terms: F, chi-square for infinite freedom."""
    return float(f_tail(square, count, freedom) if np.isfinite(freedom) else chi_square_tail(count * square, count))


def rms_left_out(errors: Sequence[LeftOutCluster]) -> float | None:
    """Return the rms over all holds of the temperatures left out; None where there are none."""
    total = sum(each.holds for each in errors)
    return float(np.sqrt(sum(each.holds * each.rms**2 for each in errors) / total)) if total else None


def may_be_taken(step: DegreesStep, before: float | None) -> bool:
    """Return whether a step down is insignificant and predicts left-out temperatures no worse.

    `before` is their rms before the step. The prediction counts too, because an F-test alone may lack power.
    """
    no_worse = step.left_out is not None and before is not None and step.left_out <= _NO_WORSE * before
    return no_worse and (step.probability or 0) > THERMAL_POWER.level


def _name_temperatures(
    errors: Sequence[LeftOutCluster], problem: ThermalProblem, cluster: NDArray[np.int64]
) -> list[LeftOutCluster]:
    """Return the errors with temperatures, degC, instead of their numbers."""
    return [
        replace(each, temperature=float(problem.temperature[cluster == each.temperature].mean())) for each in errors
    ]


def describe_degrees(degrees: Degrees, knots: int = 0) -> str:
    """Return degrees in words: ``bias 3, scale factor 2, misalignment 1``, or a spline of the bias."""
    words = [f"{kind.replace('_', ' ')} {degree}" for (kind, _), degree in zip(GROUPS, degrees, strict=True)]
    return ", ".join([f"bias by a spline with {knots} knots", *words[1:]] if knots else words)


# Lag of the biases behind the thermometer, and loops between warming and cooling.


_STILL = 0.05
"""Share of the fastest change in a recording, below which the sign of a change is the thermometer's noise."""
_SHARED = 0.5
"""Share of the range in which the unit must both warm and cool: elsewhere a bend of the law looks like a lag."""
_TELLS = 0.05
"""Least length of the part of lag's and loops' columns beside the laws and each other, over their length."""
_NAMES = ("lag", *(f"loop_{axis}" for axis in AXES))
ALL = (0, 1, 2, 3)
"""Lag and loops of x, y and z, as `ThermalProblem.free`."""


@dataclass(frozen=True)
class LagAndLoops:
    """Lag (s) and loops (g): values, shape (4,), covariance, and probabilities of lag and of loops by chance.

    Where they are not observable, `values` is None, and `reason` says why; it is empty if the temperature never drifts.
    """

    values: Array | None = None
    covariance: Array | None = None
    probability: tuple[float, float] = (1.0, 1.0)
    reason: str = ""

    @property
    def free(self) -> tuple[int, ...]:
        """The significant ones, as `ThermalProblem.free`."""
        lag, loop = (probability < LAG_OR_LOOP.level for probability in self.probability)
        return (0,) * lag + (1, 2, 3) * loop


def drift_rates(holds: Holds) -> Array:
    """Return the change of the temperature in each hold, K/s; 0 in soaks, and where it hardly changes."""
    return mask_drift_rates(holds.recording, holds.temperature, holds.rate)


def mask_drift_rates(recording: NDArray[Any], temperature: Array, rate: Array) -> Array:
    """Return the changes `rate` of the temperature, K/s, with 0 in soaks and where it hardly changes."""
    rate = rate.copy()
    for each in np.unique(recording):
        of_recording = recording == each
        soak = np.ptp(temperature[of_recording]) < APART
        rate[of_recording & (np.abs(rate) < (np.inf if soak else _STILL * np.abs(rate[of_recording]).max()))] = 0.0
    return rate


def fit_lag_and_loops(problem: ThermalProblem, solution: ThermalSolution, tau: float | None) -> LagAndLoops:
    """Return lag and loops fitted beside the laws of a solution, each tested given the other."""
    reason = explain_unobservable_lag(
        problem.temperature, problem.rate, solution, solution.laws.size, len(problem.free)
    )
    if reason == "" and problem.side is not None and len(np.unique(problem.side[problem.side != 0])) == 2:
        return _fit_loops_of_soaks(problem, solution, tau)
    if reason is not None:
        return LagAndLoops(reason=reason)
    whole = solve(replace(problem, free=ALL), solution.laws, tau=tau)
    if not whole.converged:
        return LagAndLoops(reason="the fit of lag and loop beside the laws did not converge")
    return judge_lag_and_loops(whole, solution.laws.size)


def judge_lag_and_loops(whole: ThermalSolution, size: int) -> LagAndLoops:
    """Return lag and loops, the coefficients after the first `size` of a solution, with their probabilities."""
    values, covariance = whole.coefficients[size:], whole.covariance[size:, size:]
    probability = []
    for part in (slice(0, 1), slice(1, 4)):
        terms = values[part]
        square = float(terms @ np.linalg.solve(covariance[part, part], terms)) / len(terms)
        freedom = min(whole.degrees_of_freedom(row) for row in np.eye(size + 4)[size:][part])
        probability.append(tail_probability(square, len(terms), freedom))
    return LagAndLoops(values, covariance, (probability[0], probability[1]))


def _fit_loops_of_soaks(problem: ThermalProblem, solution: ThermalSolution, tau: float | None) -> LagAndLoops:
    """Return loops fitted beside the laws of soaks that were reached from either side; a lag does not show there."""
    size, loops = solution.laws.size, ALL[1:]
    if not _is_observable(solution, size, len(problem.free), loops):
        return LagAndLoops(reason="the soaks reached by warming and by cooling do not tell loops and laws apart")
    whole = solve(replace(problem, free=loops), solution.laws, tau=tau)
    if not whole.converged:
        return LagAndLoops(reason="the fit of loops beside the laws did not converge")
    terms, covariance = whole.coefficients[size:], np.full((4, 4), np.nan)
    covariance[1:, 1:] = whole.covariance[size:, size:]
    square = float(terms @ np.linalg.solve(covariance[1:, 1:], terms)) / len(terms)
    freedom = min(whole.degrees_of_freedom(row) for row in np.eye(size + 3)[size:])
    return LagAndLoops(np.append(np.nan, terms), covariance, (1.0, tail_probability(square, len(terms), freedom)))


def explain_unobservable_lag(
    temperature: Array, rate: Array, solution: ThermalSolution, size: int, free: int
) -> str | None:
    """Return why lag and loops are not observable: empty if the temperature never drifts, None if they are.

    The solution has `free` columns for them after the first `size`.
    """
    reason = _explain_temperatures(temperature, rate)
    if reason is None and not _is_observable(solution, size, free, ALL):
        return "the holds in which the temperature drifts do not tell lag, loop and laws apart"
    return reason


def _explain_temperatures(temperature: Array, rate: Array) -> str | None:
    """Return why these temperatures cannot distinguish lag from law: empty if they never drift, None if they can."""
    up, down = (temperature[sign * rate > 0] for sign in (1, -1))
    if not up.size and not down.size:
        return ""
    if not up.size or not down.size:
        return (
            f"the recordings only {'warm' if up.size else 'cool'}, which cannot tell a lag behind the thermometer from "
            "the laws: record the way back too"
        )
    both = min(up.max(), down.max()) - max(up.min(), down.min())
    if both < _SHARED * np.ptp(temperature):
        return (
            f"the unit both warms and cools in {max(both, 0.0):.0f} K of {np.ptp(temperature):.0f} K, too "
            "little to tell a lag behind the thermometer from the laws: record the way back too"
        )
    return None


def _is_observable(solution: ThermalSolution, size: int, free: int, wanted: tuple[int, ...]) -> bool:
    """Return whether the columns of the wanted lag and loops are independent of the laws and of each other."""
    rows = solution.rows
    white = solution.white
    rest = white(np.delete(rows.jacobian, np.s_[size : size + free], axis=1))
    columns = white(rows.drift[:, list(wanted)])
    length = np.linalg.norm(columns, axis=0)
    if not length.min() > 0:
        return False
    u, values, _ = np.linalg.svd(rest / np.maximum(np.linalg.norm(rest, axis=0), 1e-300), full_matrices=False)
    u = u[:, values > 1e-7 * values[0]]
    columns = columns / length
    return bool(np.linalg.svd(columns - u @ (u.T @ columns), compute_uv=False)[-1] > _TELLS)


def warn_lag_and_loops(drift: LagAndLoops, solution: ThermalSolution, name: str) -> list[str]:
    """Return warnings of a significant lag or loop, with the error that corrected outputs keep."""
    if drift.values is None:
        return [Note(f"{name}: {drift.reason}")] if drift.reason else []
    assert drift.covariance is not None
    u = np.sqrt(np.diag(drift.covariance))
    messages: list[str] = []
    if 0 in drift.free:
        laws = solution.laws
        slope = laws.slope(np.linspace(laws.low, laws.high, 81)) @ solution.coefficients[: laws.size]
        lag = float(drift.values[0])
        who = "biases lag the temperature" if lag > 0 else "the temperature lags the biases"
        messages.append(
            Finding(
                f"{name}: {who} by {abs(lag):.3g} s (u {u[0]:.2g} s); corrected outputs use none, and are off by up to "
                f"{1e3 * np.abs(slope[:, :3]).max() * abs(lag) / 60:.2g} mg where it changes by 1 K/min",
                "record ramps at the speed at which the temperature changes in use",
            )
        )
    if 1 in drift.free:
        each = ", ".join(f"{axis} {1e3 * h:+.2f}" for axis, h in zip(AXES, drift.values[1:], strict=True))
        messages.append(
            Finding(
                f"{name}: biases differ between warming and cooling: in the middle of the range they are {each} mg "
                f"(u {1e3 * u[1:].max():.2g} mg) from their laws in warming, and as much the other way in cooling, "
                "which corrected outputs keep",
                "let each temperature soak longer, warming and cooling",
            )
        )
    return messages


def list_effects(drift: LagAndLoops, scale: float, unit: str = "m/s^2") -> dict[str, TestedEffect | None]:
    """Return ``lag``, ``loop_x`` ... of the record's fit, loops times `scale` in `unit`; None if not observable."""
    if drift.values is None:
        return dict.fromkeys(_NAMES)
    assert drift.covariance is not None
    size, u = np.array([1.0, scale, scale, scale]), np.sqrt(np.diag(drift.covariance))
    return {
        name: TestedEffect(
            value=float(drift.values[k] * size[k]),
            standard_uncertainty=float(u[k] * size[k]),
            unit=unit if k else "s",
            probability=drift.probability[min(k, 1)],
            fitted=k in drift.free,
        )
        if np.isfinite(u[k])
        else None
        for k, name in enumerate(_NAMES)
    }
