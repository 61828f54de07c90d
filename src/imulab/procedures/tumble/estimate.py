"""The parameters of an accelerometer triad from static attitudes.

With the options of a fit checked before there is data.
"""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from imulab.display import Note
from imulab.errors import DataError, ObservabilityError, OptionError, first_of, listed, meant
from imulab.estimation.least_squares import Observability, huber_inflation, observability
from imulab.gravity import Gravity
from imulab.procedures.tumble import FROM_DATA, FURTHER, HIGHEST_ORDER, LOSSES, METHODS
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.blend import Blended, blend_orders, with_known_spread
from imulab.procedures.tumble.checks import check_attitudes, check_residuals, far_zero, untilted
from imulab.procedures.tumble.gyro.rotation import check_axes
from imulab.procedures.tumble.model import GROUPS, MISALIGNMENTS, parameter_count, parameter_names
from imulab.procedures.tumble.orders import (
    NONE_ASIDE,
    Aside,
    OrderChoice,
    absolute_weights,
    choose_order,
    explaining_order,
    find_disturbed,
    solve_orders,
)
from imulab.procedures.tumble.record import Estimate, FittedAttitudes, Scaling, StatedUncertainty
from imulab.procedures.tumble.schema import model_of
from imulab.procedures.tumble.solve import (
    Threshold,
    TumbleProblem,
    TumbleSolution,
    evaluate,
    forces,
    helpful_attitudes,
    informed_rows,
    solve_linearised,
    solve_norm,
)
from imulab.records.calibration import Calibration, Parameter
from imulab.units import parse_unit, to_si

# The options of a tumble fit, checked before there is data.


_FAINTEST, _STRONGEST = 1e-6, 1e-2  # T


def check_method(method: str, order: int | str) -> None:
    """Check that there is such a method, and that it fits such an order.

    Raises
    ------
    OptionError
        It is unknown, or cannot.
    """
    if method not in METHODS:
        raise OptionError(f"method {method!r}: expected one of {listed(METHODS, method)}")
    if order == 0 and method == "linearised":
        raise OptionError("order 0 needs method norm, found method linearised")


def check_options(
    order: int | str,
    method: str,
    loss: str,
    *,
    monte_carlo: int | None = None,
    with_prior: bool = False,
    ageing: Sequence[float] = (),
    nonlinearity: tuple[float, float] | None = None,
    asymmetry: float | None = None,
    cross: bool = False,
    threshold: Sequence[float] | None = None,
    preset: Sequence[float] | None = None,
    further: Sequence[str] = (),
    field: float | None = None,
    hemisphere: str | None = None,
    dip: object = None,
) -> None:
    """Check what can be checked before there is data.

    Raises
    ------
    OptionError
        An option has an unknown value, or does not go with another.
    """
    known = ("auto", *range(HIGHEST_ORDER + 1), "blend")
    if order not in known or isinstance(order, bool):
        raise OptionError(f"order {order!r}: expected one of {listed(map(str, known), order)}")
    check_method(method, order)
    if loss not in LOSSES:
        raise OptionError(f"loss {loss!r}: expected one of {listed(LOSSES, loss)}")
    if loss == "huber" and method == "linearised":
        raise OptionError("loss huber needs method norm, found method linearised")
    if threshold is not None:
        _check_threshold(threshold, method)
    if preset is not None and method != "linearised":
        raise OptionError(f"preset needs method linearised, found method {method}")
    if with_prior and (method != "norm" or loss == "huber"):
        raise OptionError(f"a prior needs method norm and loss square or auto, found method {method} and loss {loss}")
    if ageing and not with_prior:
        raise OptionError("ageing without a prior: expected both, it is that of the prior's unit")
    if len(ageing) > len(GROUPS) or not all(0 <= value < np.inf for value in ageing):
        raise OptionError(
            f"ageing {' '.join(f'{value:g}' for value in ageing)}: expected up to three standard deviations of 0 or "
            "more, of biases (m/s^2), scale factors (1) and misalignments (rad)"
        )
    if order == "blend" and (method != "norm" or with_prior or monte_carlo is not None):
        raise OptionError("order blend needs method norm, and goes neither with a prior nor with monte-carlo")
    _check_known_spread(order, nonlinearity, asymmetry, with_prior=with_prior)
    if cross and (method != "norm" or order in (0, *FROM_DATA) or with_prior or monte_carlo is not None):
        raise OptionError(
            f"cross needs method norm and an order of 1 to {HIGHEST_ORDER}, and goes with no prior and no monte-carlo"
        )
    if "mag" in further:
        _check_with_mag(
            method=None if method == "norm" else method, order=order if order in (0, "blend") else None,
            cross=cross or None, prior=with_prior or None, nonlinearity=nonlinearity, asymmetry=asymmetry,
            monte_carlo=monte_carlo,
        )  # fmt: skip
    check_field(field)
    _check_mag_options("mag" in further, field=field, hemisphere=hemisphere, dip=dip)
    if monte_carlo is not None:
        _check_monte_carlo(monte_carlo, method, with_prior=with_prior)


def _check_known_spread(
    order: int | str, nonlinearity: tuple[float, float] | None, asymmetry: float | None, *, with_prior: bool
) -> None:
    if nonlinearity is not None:
        if order not in FROM_DATA or with_prior:
            raise OptionError(f"nonlinearity needs order auto or blend without a prior, found order {order}")
        if not all(0 < value < np.inf for value in nonlinearity):
            raise OptionError(f"nonlinearity {nonlinearity}: expected two standard deviations above 0, of k2 and k3")
    if asymmetry is not None:
        if order not in FROM_DATA or with_prior:
            raise OptionError(f"asymmetry needs order auto or blend without a prior, found order {order}")
        if not 0 < asymmetry < np.inf:
            raise OptionError(f"asymmetry {asymmetry:g}: expected a standard deviation above 0")


def _check_monte_carlo(trials: int, method: str, *, with_prior: bool) -> None:
    from imulab.procedures.tumble.montecarlo import check_trials

    check_trials(trials)
    if method != "norm":
        raise OptionError(f"monte-carlo needs method norm, found method {method}")
    if with_prior:
        raise OptionError("monte-carlo draws the attitudes anew, not a prior: expected one of the two options")


def _check_threshold(threshold: Sequence[float], method: str) -> None:
    if method != "linearised":
        raise OptionError(f"threshold needs method linearised, found method {method}")
    if len(threshold) != 3 or not all(0 < value < np.inf for value in threshold):
        raise OptionError(
            f"threshold {' '.join(f'{value:g}' for value in threshold)}: expected three changes above 0, of scale "
            "factors (1), biases (m/s^2) and misalignments (rad)"
        )


def further_triads(triads: str | Sequence[str], called: str) -> tuple[str, ...]:
    """Return the names of further triads, given as a text such as ``"gyro,mag"`` or one by one.

    Raises
    ------
    OptionError
        There is no such triad, or one is named twice.
    """
    names = tuple(name.strip() for name in triads.split(",")) if isinstance(triads, str) else tuple(triads)
    for name in names:
        if name not in FURTHER:
            raise OptionError(f"{called} {name!r}: expected gyro, mag or both, as in gyro,mag{meant(FURTHER, name)}")
    if len(set(names)) < len(names):
        raise OptionError(f"{called} {','.join(names)}: expected each triad once")
    return names


def _check_with_mag(**others: object) -> None:
    """Refuse what the joint fit of accelerometers and magnetometers does not have."""
    for name, value in others.items():
        if value is not None:
            shown = name.replace("_", "-") + (f" {value}" if isinstance(value, str | int) and value is not True else "")
            raise OptionError(
                f"with_ mag does not go with {shown}: both triads are fitted together by method norm, order auto or 1 "
                "to 5, from these attitudes alone"
            )


def _check_mag_options(asked: bool, **stated: object) -> None:
    """Refuse what is stated of a field where no magnetometers are asked for."""
    for name, value in stated.items():
        if value is not None and not asked:
            raise OptionError(f"{name} without magnetometers: expected it with mag, or with gyro,mag")


def check_field(field: float | None) -> None:
    """Check that a magnitude, T, can be that of the field.

    Raises
    ------
    OptionError
        It is far from any on Earth.
    """
    if field is not None and not (isinstance(field, numbers.Real) and _FAINTEST < field < _STRONGEST):
        raise OptionError(f"field {field:g} T: expected its magnitude, such as 48.2uT (25 to 65 uT on Earth)")


# Order 0, bias and scale factor only: what a record says of the misalignment that six faces of a cube cannot tell.


def with_assumed_alignment(record: Calibration) -> Calibration:
    """Return a record; one of order 0 has misalignments of 0 without uncertainty, and a note that they are assumed."""
    if model_of(record).order > 0:
        return record
    assumed = {f"misalignment_{pair}": Parameter(0.0, None, "rad") for pair in MISALIGNMENTS}
    note = Note(
        "order 0 takes every misalignment as 0: each mrad that there is puts 1 mg per g of one axis into another; "
        "order 1 and nine or more attitudes over the sphere determine it"
    )
    return dataclasses.replace(
        record, parameters={**record.parameters, **assumed}, warnings=(*record.warnings, note), verdict=record.verdict
    )


# The parameters of an accelerometer triad from static attitudes, in units of g, and how certain they are.


def estimate_triad(
    attitudes: Attitudes,
    gravity: Gravity,
    scaling: Scaling,
    order: int | str,
    loss: str = "auto",
    rest: Threshold | None = None,
    *,
    nonlinearity: tuple[float, float] | None = None,
    asymmetry: float | None = None,
    prior: Calibration | None = None,
    ageing: Sequence[float] = (),
    cross: bool = False,
) -> Estimate:
    """Set attitudes aside, choose the order, solve, and state the uncertainty; `rest` is that of method linearised."""
    every = _problem(attitudes, scaling, robust=loss == "huber")
    known = None
    if prior is not None:
        from imulab.procedures.tumble.prior import combine_with_prior, known_of, prior_shares, prior_warnings

        known = known_of(prior, scaling, gravity, attitudes.unit)
    aside, fitted, explained_by = NONE_ASIDE, dict[int, TumbleSolution](), None
    if loss == "auto" and rest is None and not cross:
        aside, fitted, explained_by = _set_aside(every, order)
    used, kept = every, attitudes
    if aside.index:
        used, kept = every.only(aside.others(len(attitudes))), attitudes.only(aside.others(len(attitudes)))
    choice: OrderChoice | None = None
    if order in FROM_DATA and len(kept) >= parameter_count(1):
        choice = choose_order(used, gravity.value, fitted or solve_orders(used))
    problem = replace(used, order=choice.order if choice else 1 if order in FROM_DATA else int(order), cross=cross)
    aged = None
    if known is not None:
        aged = combine_with_prior(problem, known, gravity, _scaled_ageing(ageing, gravity.value))
        problem = aged.problem
    solution, conditioning = _solve(problem, kept, rest, choice, aged.solution if aged else fitted.get(problem.order))
    given_order = (
        StatedUncertainty(aged.covariance, aged.freedom) if aged else _uncertainty_given_order(problem, solution)
    )
    stated = given_order
    if choice is not None and given_order is not None:
        blended = _blended(used, choice, nonlinearity, asymmetry)
        problem, solution, stated = _with_order_uncertainty(
            used, problem, solution, given_order, blended, order == "blend"
        )
    complete = _with_aside(attitudes, replace(every, order=problem.order, cross=cross), solution, aside)
    check_residuals(kept, solution, gravity.value)
    check_axes(attitudes, forces(complete.problem, complete.solution)[0])
    estimate = Estimate(
        kept, problem, solution, given_order, stated, complete, conditioning, choice.rows if choice else (),
        explained_by=explained_by,
    )  # fmt: skip
    if prior is None or known is None or aged is None:
        return estimate
    return dataclasses.replace(
        estimate,
        with_gravity=aged.with_gravity,
        prior=prior_shares(prior, known, aged, scaling, gravity),
        notes=prior_warnings(prior, aged, attitudes.recording, len(kept)),
    )


def _problem(attitudes: Attitudes, scaling: Scaling, *, robust: bool) -> TumbleProblem:
    """Return the attitudes in units of g, relative to the nominal sensor."""
    reading = ((attitudes.mean - scaling.zero) / scaling.scale)[None]
    spread = scaling.scale[:, None] * scaling.scale
    noise = None if attitudes.covariance is None else (attitudes.covariance / spread)[None]
    motion = None if attitudes.motion is None else attitudes.motion.scaled(scaling.scale)
    return TumbleProblem(reading, noise, 1, robust=robust, motion=motion)


def _fits(problem: TumbleProblem, order: int | str) -> dict[int, TumbleSolution]:
    """Fit the orders that are asked for."""
    return solve_orders(problem) if order in FROM_DATA else {int(order): solve_norm(replace(problem, order=int(order)))}


def _set_aside(problem: TumbleProblem, order: int | str) -> tuple[Aside, dict[int, TumbleSolution], int | None]:
    """Return the knocked attitudes, the fits of the others, and the higher order that explains them all instead."""
    aside, fitted = find_disturbed(problem, lambda subset: _fits(subset, order))
    if aside.index and order not in FROM_DATA:
        whole = replace(problem, order=int(order))
        solution = solve_norm(whole)
        if explained_by := explaining_order(whole, solution):
            return NONE_ASIDE, {int(order): solution}, explained_by
    return aside, fitted, None


def _with_aside(
    attitudes: Attitudes, problem: TumbleProblem, solution: TumbleSolution, aside: Aside
) -> FittedAttitudes:
    """Return all attitudes under the solution, those set aside with the down-weight 0."""
    if not aside.index:
        return FittedAttitudes(attitudes, problem, solution, aside)
    every = evaluate(problem, solution)
    kept = every.down_weights.copy()
    kept[0, list(aside.index)] = 0.0
    return FittedAttitudes(attitudes, problem, replace(every, down_weights=kept), aside)


def _blended(
    problem: TumbleProblem, choice: OrderChoice, nonlinearity: tuple[float, float] | None, asymmetry: float | None
) -> Blended:
    if nonlinearity is None:
        return blend_orders(problem, choice, asymmetry)
    return with_known_spread(problem, choice, nonlinearity, asymmetry)


def _with_order_uncertainty(
    used: TumbleProblem,
    problem: TumbleProblem,
    solution: TumbleSolution,
    given_order: StatedUncertainty,
    blended: Blended,
    at_blend: bool,
) -> tuple[TumbleProblem, TumbleSolution, StatedUncertainty]:
    """Return problem, solution and covariance with the uncertainty of the order; the blended values if asked."""
    if not at_blend:
        about = blended.about(solution.theta[0])
        return (
            problem,
            solution,
            StatedUncertainty(about, blended.freedom, given_order.covariance, given_order.freedom, blended),
        )
    problem = replace(used, order=blended.order)
    blend_solution = evaluate(problem, replace(solution, theta=blended.theta[None]))
    blend_solution = replace(blend_solution, down_weights=solution.down_weights)
    return problem, blend_solution, StatedUncertainty(blended.covariance, blended.freedom, blended=blended)


def _scaled_ageing(ageing: Sequence[float], gravity: float) -> tuple[float | None, ...]:
    """Return what is known of the ageing of each group in g, 1 and rad, None where nothing is."""
    known = [value / unit for value, unit in zip(ageing, (gravity, 1.0, 1.0), strict=False)]
    return (*known, *[None] * (len(GROUPS) - len(known)))


def checked_scaling(
    attitudes: Attitudes, gravity: float, method: str = "norm", preset: Sequence[float] | None = None
) -> Scaling:
    """Return the nominal sensor, once the attitudes can be those of an accelerometer triad.

    By its unit, for counts and volts from the span of each axis; a far zero by the outputs' sphere. Method linearised
    starts where its source does: at no bias, and at the `preset` scale factors, if there are any.
    """
    centre = far_zero(attitudes.mean)
    check_attitudes(attitudes, gravity, centre)
    if preset is not None:
        return Scaling(np.zeros(3), np.broadcast_to(np.asarray(preset, float), 3).copy())
    unit = parse_unit(attitudes.unit)
    if unit.quantity == "acceleration":
        zero = centre if method == "norm" else np.zeros(3)
        return Scaling(zero, np.full(3, gravity / to_si(1.0, unit.symbol)))
    high, low = attitudes.mean.max(axis=0), attitudes.mean.min(axis=0)
    if np.array_equal(high, low):  # a single attitude has no span: its length is 1 g
        return Scaling(np.zeros(3), np.full(3, float(np.linalg.norm(high)) or 1.0))
    return Scaling((high + low) / 2, np.maximum((high - low) / 2, (high - low).max() / 20))


def _solve(
    problem: TumbleProblem,
    attitudes: Attitudes,
    linearised: Threshold | None,
    choice: OrderChoice | None,
    solved: TumbleSolution | None,
) -> tuple[TumbleSolution, Observability]:
    """Return the solution and its observability; a solution by norm that exists already is used.

    `linearised` is where method linearised rests, None for method norm.
    """
    n, size = problem.reading.shape[1], parameter_count(problem.order, problem.cross)
    if linearised is None and choice is not None:
        solution, ranks = choice.solution, choice.observability
    else:
        solution = solved or _solved(problem, attitudes, linearised)
        ranks = observability(*informed_rows(problem, solution.jacobian[0], absolute_weights(problem, solution)))
    if ranks.rank < size:
        names = parameter_names(problem.order, problem.cross)
        confused = ranks.confused(names)
        shown = first_of(confused, 8, " ")  # by six faces, at order 2: k2_z is the eighth
        help_from = helpful_attitudes(problem.order, solution, count=2)
        many = f"{n} attitudes determine" if n != 1 else "1 attitude determines"
        raise ObservabilityError(
            f"{attitudes.recording.name}: {many} {ranks.rank} of the {size} parameters of order {problem.order}"
            f"{untilted(attitudes.mean)}; they cannot separate {shown}; upward directions {help_from} "
            "would help most"
        )
    if not solution.converged[0]:
        raise DataError(
            f"{attitudes.recording.name}: the fit of order {problem.order} does not converge on these {n} attitudes "
            f"(condition number {ranks.condition:.0f}); use a lower order or more attitudes"
        )
    return solution, ranks


def _solved(problem: TumbleProblem, attitudes: Attitudes, linearised: Threshold | None) -> TumbleSolution:
    n, size = problem.reading.shape[1], parameter_count(problem.order, problem.cross)
    if linearised is not None and n >= size:
        return solve_linearised(problem, attitudes.recording.name, linearised)
    return solve_norm(problem)


def _uncertainty_given_order(problem: TumbleProblem, solution: TumbleSolution) -> StatedUncertainty | None:
    """Return the covariance of theta given the order; None where the noise cannot be estimated."""
    n, size = problem.reading.shape[1], parameter_count(problem.order, problem.cross)
    freedom = n - size
    base = solution.covariance()[0]
    if problem.robust and freedom > 0:
        factor = huber_inflation(solution.standardised(), size)[0] * solution.scale[0] ** 2
        return StatedUncertainty(base * factor, float(freedom))
    if problem.covariance is not None:
        known = float(solution.freedom[0])
        return StatedUncertainty(base, known if np.isfinite(known) else None)
    if freedom == 0:
        return None
    chi_square = float((solution.residuals[0] ** 2 / solution.variance[0]).sum())
    return StatedUncertainty(base * (chi_square / freedom), float(freedom))
