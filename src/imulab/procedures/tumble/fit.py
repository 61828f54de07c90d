"""Static attitudes to a calibration of the accelerometer triad."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from imulab.errors import DataError, ObservabilityError, OptionError, first_of
from imulab.estimation.least_squares import (
    Observability,
    covariance,
    huber_inflation,
    observability,
)
from imulab.gravity import Gravity, at_place, local_gravity
from imulab.procedures.inputs import Reading, Record, as_record
from imulab.procedures.result import Result
from imulab.procedures.tumble.advice import helpful_attitudes
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.axes import check_axes
from imulab.procedures.tumble.blend import Blended, blend_orders, with_known_spread
from imulab.procedures.tumble.checks import check_attitudes, check_residuals
from imulab.procedures.tumble.choices import FROM_DATA
from imulab.procedures.tumble.findings import Estimate, Found, Stated
from imulab.procedures.tumble.given import TumbleData, as_attitudes
from imulab.procedures.tumble.linearised import SOURCE_THRESHOLD, Threshold, solve_linearised
from imulab.procedures.tumble.model import parameter_count, parameter_names
from imulab.procedures.tumble.montecarlo import propagate
from imulab.procedures.tumble.options import check_options
from imulab.procedures.tumble.order_zero import with_assumed_alignment
from imulab.procedures.tumble.orders import OrderChoice, OrderRow, absolute_weights, choose_order, solve_orders
from imulab.procedures.tumble.outliers import NONE_ASIDE, Aside, set_aside
from imulab.procedures.tumble.prior import GROUPS, entries, findings, known_of, put_together
from imulab.procedures.tumble.record import Scaling, make_record
from imulab.procedures.tumble.sections import model_of
from imulab.procedures.tumble.solve import Problem, Solution, evaluate, forces, informed_rows, solve_norm
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import parse_unit, to_si


@dataclass(frozen=True, repr=False)
class TumbleFit(Result):
    """Result of a tumble fit.

    Attributes
    ----------
    calibration
        The record, with parameters in SI and their covariance.
    observability
        Rank, condition number and the combination that the attitudes determine worst.
    orders
        The table of orders, where the order was chosen from the data; empty otherwise.
    residuals
        ``|f| - g`` of each attitude, m/s^2, shape (n,).
    down_weights
        Factors of Huber's loss, shape (n,); without it ones, and zeros for attitudes set aside.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_tumble(il.simulate_tumble(order=1, gravity=9.81362), gravity=9.81362)
    >>> fit.residuals.shape, fit.observability.rank
    ((24,), 9)
    """

    calibration: Calibration
    observability: Observability
    orders: tuple[OrderRow, ...]
    residuals: Array
    down_weights: Array


def fit_tumble(
    data: TumbleData,
    *,
    order: int | str = "auto",
    gravity: float | str | Gravity | None = None,
    latitude: float | str | None = None,
    height: float | str | None = None,
    method: str = "norm",
    loss: str = "auto",
    nonlinearity: tuple[float, float] | None = None,
    prior: Record | None = None,
    ageing: Sequence[float] = (),
    monte_carlo: int | None = None,
    cross: bool = False,
    threshold: Sequence[float] | None = None,
    covariance: ArrayLike | None = None,
    progress: Callable[[int], None] = lambda _: None,
    **reading: Unpack[Reading],
) -> TumbleFit:
    """Calibrate an accelerometer triad from static attitudes.

    Method ``norm`` minimises ``sum_p w_p (|f(M_p)| - g - (tr C_p - u' C_p u) / 2g)^2`` with ``w_p = 1 / u' C_p u``;
    ``linearised`` is the published first-order iteration.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays with columns ``accel_x``, ``_y``, ``_z``; the triad alone, shape (n, 3);
        or attitudes from `find_attitudes`. Without a time each row is an attitude.
    order
        1 to 5; ``"auto"``: the order that predicts best among those that the attitudes can see, with an uncertainty
        that holds whatever the order; ``"blend"``: all of them, each as far as the data support it.
    gravity
        Local gravity, m/s^2, or a text such as ``"9.81362+-0.00002"``, whose standard uncertainty enters that of the
        scale factors. Without it that of the recording's head is used, or standard gravity, with a warning.
    latitude, height
        Instead of gravity: where that is normal gravity, as texts (``"47.4 deg"``, ``"400 m"``) or in rad and m; what a
        place differs by is part of the uncertainty.
    method
        ``"norm"`` or ``"linearised"``.
    loss
        ``"auto"``: attitudes that no order explains are set aside and named (``"square"`` with method linearised);
        ``"square"``: all count; ``"huber"``: the pull of single disturbed ones is limited (method norm only).
    nonlinearity
        Standard deviations of k2 and k3 about zero, in units of 1/g and 1/g^2, if known; order auto or blend.
    prior
        Earlier tumble record of the same unit, or its file, taken as a normal distribution of the parameters, which is
        widened by what the attitudes say that it aged; gives the order under ``"auto"``. Needs method norm, loss square
        and stated or measured noise.
    ageing
        Standard deviations of what biases (m/s^2), scale factors (1) and misalignments (rad) changed since the prior
        was made, as many as are known; the attitudes tell the others.
    monte_carlo
        Number of trials of a propagation of distributions (JCGM 101), method norm only; none if not given.
    cross
        Whether the model has cross terms k_xy, k_yz, k_zx, at an order that is given; no attitude is set aside then.
    threshold
        Changes of scale factors (1), biases (m/s^2) and misalignments (rad) from one pass to the next below which
        method linearised rests; the source's 5 ppm, 2 ug and 3 arcsec if not given.
    covariance
        Of means of attitudes without a time, in their squared unit, shape (3, 3) or (n, 3, 3).
    progress
        Called with the number of trials done so far.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window`, `element`.

    Raises
    ------
    ObservabilityError
        The attitudes cannot separate the model's parameters; the message names them and what would help.
    DataError
        The attitudes cannot be those of an accelerometer triad in the given unit.
    OptionError
        An option has an unknown value, or does not go with another.
    RecordError
        The prior lacks a parameter, or has outputs in another unit.

    Examples
    --------
    A simulated unit, whose true bias stands in the recording's head:

    >>> import imulab as il
    >>> recording = il.simulate_tumble(order=1, gravity=9.81)
    >>> fit = il.fit_tumble(recording, order=1, gravity=9.81)
    >>> abs(fit.calibration.parameters["bias_x"].value - float(recording.metadata["truth_bias_x"])) < 1e-3
    True

    The same of an array, with the text for people:

    >>> il.fit_tumble(recording.triad("accel"), rate=100.0, unit="m/s^2", order=1, gravity=9.81).save("unit.json")
    """
    check_options(
        order, method, loss, monte_carlo=monte_carlo, with_prior=prior is not None, ageing=ageing,
        nonlinearity=nonlinearity, cross=cross, threshold=threshold,
    )  # fmt: skip
    attitudes = as_attitudes(data, reading, fit_tumble, covariance)
    local = local_gravity(at_place(gravity, latitude, height), attitudes.recording)
    check_attitudes(attitudes, local.value)
    scaling = nominal_scaling(attitudes, local.value)
    known = None if prior is None else as_record(prior, "fit_tumble: prior")
    if known is not None:
        order = _prior_order(known, order, attitudes)
    rest = _threshold(threshold, local.value) if method == "linearised" else None
    estimate = estimate_triad(
        attitudes, local, scaling, order, loss, rest,
        nonlinearity=nonlinearity, prior=known, ageing=ageing, cross=cross,
    )  # fmt: skip
    trials = None
    if monte_carlo is not None:
        freedom = _freedom_for_trials(estimate)
        trials = propagate(
            estimate.problem, estimate.solution, trials=monte_carlo, freedom=freedom, progress=progress
        )  # fmt: skip
    options = {
        "order": order,
        "method": method,
        "loss": loss,
        "gravity": local.value,
        **({} if nonlinearity is None else {"nonlinearity": list(nonlinearity)}),
        **({} if monte_carlo is None else {"monte_carlo": monte_carlo}),
        **({"cross": True} if cross else {}),
        **({} if rest is None else {"threshold": rest.in_si(local.value)}),
    }
    record = make_record(estimate, local, scaling, options, trials)
    return TumbleFit(
        calibration=with_assumed_alignment(record) if estimate.problem.order == 0 else record,
        observability=estimate.observability,
        orders=estimate.orders,
        residuals=local.value * estimate.found.solution.deviations[0],
        down_weights=estimate.found.solution.down_weights[0],
    )


def _threshold(given: Sequence[float] | None, gravity: float) -> Threshold:
    """Return the changes at which method linearised rests, biases in g."""
    return SOURCE_THRESHOLD if given is None else Threshold(given[0], given[1] / gravity, given[2])


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


def _freedom_for_trials(estimate: Estimate) -> float | None:
    """Return the degrees of freedom of the noise that is drawn; refuse attitudes that tell nothing of theirs."""
    if estimate.given_order is None:
        attitudes, order = estimate.attitudes, estimate.problem.order
        raise OptionError(
            f"{attitudes.recording.name}: monte-carlo needs more attitudes than parameters, or their noise (std_* "
            f"columns); found {len(attitudes)} attitudes for {parameter_count(order)} parameters"
        )
    return estimate.given_order.freedom


def _prior_order(prior: Calibration, order: int | str, attitudes: Attitudes) -> int:
    """Return the order of the prior, which is that of the fit."""
    if prior.procedure != "tumble" or not prior.covariance.names:
        raise OptionError("prior: expected a tumble record that states uncertainties")
    if attitudes.covariance is None:
        raise OptionError(
            f"{attitudes.recording.name}: a prior needs the noise of the attitudes, to be weighed against: a "
            "recording, or std_* columns"
        )
    own = model_of(prior).order
    if order not in ("auto", own):
        raise OptionError(f"order {order} with a prior of order {own}: expected order {own} or auto")
    return own


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
