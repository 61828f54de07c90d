"""The parameters of an accelerometer triad from static attitudes, in units of g, and how certain they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imulab.errors import DataError, ObservabilityError, first_of
from imulab.estimation.least_squares import (
    Observability,
    covariance,
    huber_inflation,
    observability,
)
from imulab.gravity import Gravity
from imulab.procedures.tumble.advice import helpful_attitudes
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.axes import check_axes
from imulab.procedures.tumble.blend import Blended, blend_orders, with_known_spread
from imulab.procedures.tumble.checks import check_residuals
from imulab.procedures.tumble.choices import FROM_DATA
from imulab.procedures.tumble.findings import Estimate, Found, Stated
from imulab.procedures.tumble.linearised import Threshold, solve_linearised
from imulab.procedures.tumble.model import parameter_count, parameter_names
from imulab.procedures.tumble.orders import OrderChoice, absolute_weights, choose_order, solve_orders
from imulab.procedures.tumble.outliers import NONE_ASIDE, Aside, set_aside
from imulab.procedures.tumble.prior import GROUPS, entries, findings, known_of, put_together
from imulab.procedures.tumble.record import Scaling
from imulab.procedures.tumble.solve import Problem, Solution, evaluate, forces, informed_rows, solve_norm
from imulab.records.calibration import Calibration
from imulab.units import parse_unit, to_si


def estimate_triad(
    attitudes: Attitudes,
    gravity: Gravity,
    scaling: Scaling,
    order: int | str,
    loss: str = "auto",
    rest: Threshold | None = None,
    *,
    nonlinearity: tuple[float, float] | None = None,
    prior: Calibration | None = None,
    ageing: Sequence[float] = (),
    cross: bool = False,
) -> Estimate:
    """Set attitudes aside, choose the order, solve, and state the uncertainty; `rest` is that of method linearised."""
    every = _problem(attitudes, scaling, robust=loss == "huber")
    known = None
    if prior is not None:
        known = known_of(prior, scaling, gravity, attitudes.unit)
    aside, fitted = NONE_ASIDE, dict[int, Solution]()
    if loss == "auto" and rest is None and not cross:
        aside, fitted = set_aside(every, lambda of: _fits(of, order))
    used, kept = every, attitudes
    if aside.index:
        used, kept = every.only(aside.others(len(attitudes))), attitudes.only(aside.others(len(attitudes)))
    choice: OrderChoice | None = None
    if order in FROM_DATA and len(kept) >= parameter_count(1):
        choice = choose_order(used, gravity.value, fitted or solve_orders(used))
    problem = replace(used, order=choice.order if choice else 1 if order in FROM_DATA else int(order), cross=cross)
    aged = None
    if known is not None:
        aged = put_together(problem, known, gravity, _scaled_ageing(ageing, gravity.value))
        problem = aged.problem
    solution, seen = _solve(problem, kept, rest, choice, aged.solution if aged else fitted.get(problem.order))
    given = Stated(aged.covariance, aged.freedom) if aged else _given_order(problem, solution)
    stated = given
    if choice is not None and given is not None:
        blended = with_known_spread(used, choice, nonlinearity) if nonlinearity else blend_orders(used, choice)
        problem, solution, stated = _whatever_the_order(used, problem, solution, given, blended, order == "blend")
    found = _found(attitudes, replace(every, order=problem.order, cross=cross), solution, aside)
    check_residuals(kept, solution, gravity.value)
    check_axes(attitudes, forces(found.problem, found.solution)[0])
    estimate = Estimate(kept, problem, solution, given, stated, found, seen, choice.rows if choice else ())
    if prior is None or known is None or aged is None:
        return estimate
    return replace(
        estimate,
        with_gravity=aged.with_gravity,
        prior=entries(prior, known, aged, scaling, gravity),
        notes=findings(prior, aged, attitudes.recording, len(kept)),
    )


def _problem(attitudes: Attitudes, scaling: Scaling, *, robust: bool) -> Problem:
    """Return the attitudes in units of g, relative to the nominal sensor."""
    reading = ((attitudes.mean - scaling.zero) / scaling.scale)[None]
    spread = scaling.scale[:, None] * scaling.scale
    noise = None if attitudes.covariance is None else (attitudes.covariance / spread)[None]
    motion = None if attitudes.motion is None else attitudes.motion.scaled(scaling.scale)
    return Problem(reading, noise, 1, robust=robust, motion=motion)


def _fits(problem: Problem, order: int | str) -> dict[int, Solution]:
    """Fit the orders that are asked for."""
    return solve_orders(problem) if order in FROM_DATA else {int(order): solve_norm(replace(problem, order=int(order)))}


def _found(attitudes: Attitudes, problem: Problem, solution: Solution, aside: Aside) -> Found:
    """Return all attitudes under the solution, those set aside with the down-weight 0."""
    if not aside.index:
        return Found(attitudes, problem, solution, aside)
    every = evaluate(problem, solution)
    every.down_weights[0, list(aside.index)] = 0.0
    return Found(attitudes, problem, every, aside)


def _whatever_the_order(
    used: Problem, problem: Problem, solution: Solution, given: Stated, blended: Blended, at_blend: bool
) -> tuple[Problem, Solution, Stated]:
    """Return problem, solution and an uncertainty that holds whatever the order; the blend's own values if asked."""
    if not at_blend:
        about = blended.about(solution.theta[0])
        return problem, solution, Stated(about, blended.freedom, given.covariance, given.freedom, blended)
    problem = replace(used, order=blended.order)
    own = evaluate(problem, replace(solution, theta=blended.theta[None]))
    own = replace(own, down_weights=solution.down_weights)
    return problem, own, Stated(blended.covariance, blended.freedom, blended=blended)


def _scaled_ageing(ageing: Sequence[float], gravity: float) -> tuple[float | None, ...]:
    """Return what is known of the ageing of each group in g, 1 and rad, None where nothing is."""
    known = [value / unit for value, unit in zip(ageing, (gravity, 1.0, 1.0), strict=False)]
    return (*known, *[None] * (len(GROUPS) - len(known)))


def nominal_scaling(attitudes: Attitudes, gravity: float) -> Scaling:
    """Nominal sensor: by its unit, or for counts and volts from the span of each axis."""
    unit = parse_unit(attitudes.unit)
    if unit.quantity == "acceleration":
        return Scaling(np.zeros(3), np.full(3, gravity / to_si(1.0, unit.symbol)))
    high, low = attitudes.mean.max(axis=0), attitudes.mean.min(axis=0)
    return Scaling((high + low) / 2, np.maximum((high - low) / 2, (high - low).max() / 20))


def _solve(
    problem: Problem,
    attitudes: Attitudes,
    linearised: Threshold | None,
    choice: OrderChoice | None,
    solved: Solution | None,
) -> tuple[Solution, Observability]:
    """Solve the problem, unless that has been done by norm, and see what it determines.

    `linearised` is where method linearised rests, None for method norm.
    """
    n, size = problem.reading.shape[1], parameter_count(problem.order, problem.cross)
    if linearised is None and choice is not None:
        solution, seen = choice.solution, choice.observability
    else:
        solution = solved or _solved(problem, attitudes, linearised)
        seen = observability(*informed_rows(problem, solution.jacobian[0], absolute_weights(problem, solution)))
    if seen.rank < size:
        names = parameter_names(problem.order, problem.cross)
        confused = seen.confused(names)
        shown = first_of(confused, 8, " ")
        help_from = helpful_attitudes(problem.order, solution, count=2)
        found = f" (found at {attitudes.times()})" if attitudes.trace is not None and n < size else ""
        trace = f"; {attitudes.trace.describe()}" if attitudes.trace is not None and n < size else ""
        raise ObservabilityError(
            f"{attitudes.recording.name}: {n} attitudes{found} determine {seen.rank} of the {size} parameters of "
            f"order {problem.order}; they cannot separate {shown}; attitudes with the upward direction near "
            f"{help_from} would help most{trace}"
        )
    if not solution.converged[0]:
        raise DataError(
            f"{attitudes.recording.name}: the fit of order {problem.order} does not converge on these {n} attitudes "
            f"(condition number {seen.condition:.0f}); use a lower order or more attitudes"
        )
    return solution, seen


def _solved(problem: Problem, attitudes: Attitudes, linearised: Threshold | None) -> Solution:
    n, size = problem.reading.shape[1], parameter_count(problem.order, problem.cross)
    if linearised is not None and n >= size:
        return solve_linearised(problem, attitudes.recording.name, linearised)
    return solve_norm(problem)


def _given_order(problem: Problem, solution: Solution) -> Stated | None:
    """Return what is known of theta if the order is right; None where nothing tells the noise."""
    n, size = problem.reading.shape[1], parameter_count(problem.order, problem.cross)
    freedom = n - size
    base = covariance(solution.jacobian, 1 / solution.variance)[0]
    if problem.robust and freedom > 0:
        factor = huber_inflation(solution.standardised(), size)[0] * solution.scale[0] ** 2
        return Stated(base * factor, float(freedom))
    if problem.covariance is not None:
        known = float(solution.freedom[0])
        return Stated(base, known if np.isfinite(known) else None)
    if freedom == 0:
        return None
    chi_square = float((solution.residuals[0] ** 2 / solution.variance[0]).sum())
    return Stated(base * (chi_square / freedom), float(freedom))
