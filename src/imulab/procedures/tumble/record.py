"""The calibration record of a tumble test.

Parameters in SI and in the units that people read, and what a fit notes besides its values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from imulab.display import Bad, Finding, Note
from imulab.errors import first_of
from imulab.estimation.decisions import (
    ATTITUDE_STANDS_OUT,
    ATTITUDE_STANDS_OUT_BY,
    ATTITUDES_SCATTER,
    ATTITUDES_TOO_QUIET,
    SCALE_OF_ANOTHER_UNIT,
    SCALE_OFF_UNIT,
)
from imulab.estimation.least_squares import Observability, chi_square_probability, coverage_factor
from imulab.estimation.likely_unit import ANOTHER_RANGE
from imulab.gravity import Gravity, gravity_findings
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.blend import Blended
from imulab.procedures.tumble.checks import shake_warnings
from imulab.procedures.tumble.model import (
    AXES,
    GAUGE,
    MISALIGNMENTS,
    gravity_slope,
    parameter_count,
    parameter_names,
    parameter_units,
    powers_of_gravity,
)
from imulab.procedures.tumble.orders import FREEDOM, HIGHEST_TESTED, Aside, direction_findings, time_findings
from imulab.procedures.tumble.schema import (
    DeviationTrace,
    HeldAttitudes,
    OrderBlend,
    OrderRow,
    PriorShares,
    Spread,
    Trials,
    TumbleEvidence,
    TumbleModel,
    TumbleSummary,
    data_of,
    fit_of,
    gyro_model_of,
    model_of,
)
from imulab.procedures.tumble.solve import CLOSEST, TumbleProblem, TumbleSolution, data_freedom, forces, near_vertical
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.sections import Length, Quantity, StatedGravity, entries
from imulab.report.parameters import Row, reading_unit, rows_of, small_g, with_zero_outputs
from imulab.report.traces import plain_number
from imulab.units import parse_unit

if TYPE_CHECKING:
    from imulab.procedures.tumble.montecarlo import MonteCarlo

# What a fit found besides its values: attitudes set aside, and what its uncertainties hold for.


_SELDOM_MISSED = 6
"""Degrees of freedom at the highest order tested from which a knock is seldom missed."""
_NEGLIGIBLE = 0.01  # µg or ppm: an order that is left out and moves less is not named
# Degrees of freedom below which an order is hardly checked; and that are asked for then
FEW_DEGREES, _ENOUGH_DEGREES = 5, 9
_WORST_MISALIGNMENT = 0.1  # rad: a larger misalignment is an axis with another name or sign
_MOST_NAMED = 8  # attitudes that a warning names
_STATE_UNIT = "state the unit that the outputs have (count, if none of m/s^2 g mg fits)"
_RANGES = {0.25: "four times", 0.5: "twice", 2.0: "half", 4.0: "a quarter of"}
"""How outputs shrink or grow where a sensor is set to another range than its driver assumes."""


class FittedAttitudes(Struct, frozen=True):
    """All attitudes that were found, those set aside included, under the solution for the others."""

    attitudes: Attitudes
    problem: TumbleProblem
    solution: TumbleSolution
    aside: Aside


class StatedUncertainty(Struct, frozen=True):
    """Stated covariance, in units of g, and its degrees of freedom (None: noise known); both also given the order."""

    covariance: Array
    freedom: float | None
    given_order: Array | None = None
    freedom_given_order: float | None = None
    blended: Blended | None = None


@dataclass(frozen=True)
class Estimate:
    """Estimate from the attitudes that were not set aside, in units of g.

    `with_gravity` says that the covariance holds gravity's own uncertainty already; `prior` is the record's entry on an
    earlier record, and `notes` are findings about that. `explained_by` is the higher order that explains
    attitudes which this one would take for knocked.
    """

    attitudes: Attitudes
    problem: TumbleProblem
    solution: TumbleSolution
    given_order: StatedUncertainty | None
    stated: StatedUncertainty | None
    found: FittedAttitudes
    observability: Observability
    orders: tuple[OrderRow, ...]
    with_gravity: bool = False
    prior: PriorShares | None = None
    notes: Sequence[str] = ()
    explained_by: int | None = None


def aside_of(record: Calibration, attitudes: Attitudes) -> NDArray[np.bool_]:
    """Return which of the attitudes a record set aside, if it was made from these, shape (n,)."""
    aside = np.zeros(len(attitudes), dtype=np.bool_)
    held = data_of(record).attitudes
    if held is not None and np.array_equal(held.mean, attitudes.mean):
        aside[[number - 1 for number in fit_of(record).set_aside]] = True
    return aside


def _signed(residual: float) -> str:
    """Return a residual |f| - g, m/s^2, as the figures label it, with its sign."""
    return f"{'+' if residual > 0 else ''}{small_g(residual)}"


def aside_warnings(complete: FittedAttitudes, options: Mapping[str, Any], gravity: float) -> list[str]:
    """Name the attitudes that were set aside, or say why a knocked one may not have been; gravity in m/s^2."""
    if options["loss"] != "auto":
        return []
    if options["method"] != "norm":
        return [Note("method linearised keeps every attitude: only method norm sets knocked ones aside")]
    if options.get("cross"):
        return [
            Note(
                "with cross terms every attitude is kept: a knocked one is not looked for (fit without --cross to see)"
            )
        ]
    aside, off = complete.aside, gravity * complete.solution.residuals[0]
    named: list[str] = [
        Finding(
            f"{complete.attitudes.label(index)} set aside: {_signed(off[index])} "
            f"({abs(deviations):.0f} standard uncertainties) from what the others give, as if it had been knocked or "
            "had not settled; --loss square keeps it",
            "measure this attitude again",
        )
        for index, deviations in zip(aside.index, aside.deviations, strict=True)
    ]
    n = len(complete.attitudes)
    lowest, highest = (options["order"],) * 2 if isinstance(options["order"], int) else (1, HIGHEST_TESTED)
    enough = parameter_count(lowest) + 1 + FREEDOM[complete.problem.covariance is not None]
    if n < enough:
        named.append(Note(f"{n} attitudes are too few to tell a knocked one from the others: {enough} or more can"))
    elif n - parameter_count(highest) < _SELDOM_MISSED:
        named.append(
            Note(
                f"a knocked attitude among only {n} may stay unseen: one that is off by 8 standard uncertainties is "
                "found in 60 to 97 of 100 tests of 18 attitudes, and in 97 or more of 24"
            )
        )
    return named


def freedom_finding(attitudes: int, size: int, order: int) -> str | None:
    """Say that so many attitudes are few for the parameters of an order, where they are."""
    freedom = attitudes - size
    if freedom >= FEW_DEGREES:
        return None
    return Finding(
        f"only {freedom} degree{'' if freedom == 1 else 's'} of freedom: {attitudes} attitudes hardly check whether "
        f"order {order} is enough, and the uncertainties hold only if it is; {size + _ENOUGH_DEGREES} or more would "
        "tell",
        "record more attitudes (imulab tumble plan --add FILE)",
    )


def source_warnings(complete: FittedAttitudes, method: str) -> list[str]:
    """Say what of the test departs from the source of method linearised: no nonlinearity, or an axis vertical twice."""
    if method != "linearised":
        return []
    order = complete.problem.order
    warnings: list[str] = []
    if order < 2:
        note = f"order {order} has no nonlinearity, which the source of method linearised fits (order 4 in its example)"
        warnings.append(Note(note))
    vertical = near_vertical(forces(complete.problem, complete.solution)[0], CLOSEST)
    for axis, column in zip(AXES, vertical.T, strict=True):
        which = np.flatnonzero(column).tolist()
        if len(which) > 1:
            named = first_of([complete.attitudes.label(index) for index in which], _MOST_NAMED)
            warnings.append(
                Finding(
                    f"axis {axis} is vertical within {np.degrees(CLOSEST):.0f} deg in {len(which)} attitudes ("
                    f"{named}): the source of method linearised has no axis vertical in two; "
                    "tumble plan --method linearised chooses attitudes without such",
                    "choose attitudes by imulab tumble plan --method linearised",
                )
            )
    return warnings


def size_warnings(attitudes: Attitudes, solution: TumbleSolution) -> list[str]:
    """Return warnings of errors too large for an accelerometer: unit or columns are probably stated wrongly."""
    theta = solution.theta[0]
    messages: list[str] = []
    if parse_unit(attitudes.unit).quantity == "acceleration":
        off = [(axis, value) for axis, value in zip(AXES, theta[3:6].tolist(), strict=True)]
        messages += [
            Finding(
                f"scale factor of {axis} is off by {100 * (value - 1):+.0f} %: is the unit right?",
                "correct the unit in the titles of accel_x accel_y accel_z, or state it: --unit accel=UNIT",
            )
            for axis, value in off
            if SCALE_OFF_UNIT < abs(value - 1) <= SCALE_OF_ANOTHER_UNIT
        ]
        if other := {axis: value for axis, value in off if abs(value - 1) > SCALE_OF_ANOTHER_UNIT}:
            scale = float(np.median(list(other.values())))
            ranges = (words for factor, words in _RANGES.items() if abs(scale / factor - 1) < SCALE_OFF_UNIT)
            words, action = f"outputs of a sensor are never so far off {attitudes.unit}", _STATE_UNIT
            if times := next(ranges, ""):
                words, action = f"as if the sensor's range were {times} the one that its driver assumes", ANOTHER_RANGE
            messages.append(
                Bad(
                    f"the scale factor of {' '.join(other)} is off by more than {100 * SCALE_OF_ANOTHER_UNIT:.0f} %, "
                    f"it is {scale:.3g} (median): {words}",
                    action,
                )
            )
    messages += [
        Finding(
            f"misalignment_{pair} of {1e3 * value:+.0f} mrad: do the columns belong together?",
            "check which column is which axis, and title them accordingly",
        )
        for pair, value in zip(MISALIGNMENTS, theta[6:9], strict=False)  # order 0 has none
        if abs(value) > _WORST_MISALIGNMENT
    ]
    return messages


def assumption_notes(stated: StatedUncertainty | None) -> list[str]:
    """Say which nonlinearity the attitudes do not show, and what it would move."""
    if stated is None or stated.blended is None:
        return []
    notes: list[str] = []
    asymmetry = stated.blended.asymmetry
    if asymmetry is not None and asymmetry.alike:
        notes.append(
            Note(
                f"k2, or scale factors that differ by up to {_TO_MICRO * 2 * asymmetry.size:.2g} ppm between + and -, "
                f"explain these attitudes alike: biases differ by up to {_TO_MICRO * asymmetry.bias:.2g} µg between "
                "the two, which the uncertainties hold; 48 attitudes or less noise tell, and --asymmetry 20ppm narrows "
                "them where scale factors are known to differ by no more"
            )
        )
    if (alike := stated.blended.asymmetry_as_k2) is not None:
        notes.append(
            Note(
                f"scale factors are taken to differ between + and - by as little as k2 is stated to be, "
                f"{_TO_MICRO * alike:.2g} ppm; --asymmetry states another size"
            )
        )
    for order, (bias, scale) in stated.blended.assumed.items():
        unit = f"µg/g{'⁰¹²³'[order]}"
        moved = [
            f"{value:.2g} {quantity}"
            for value, quantity in ((bias, "µg of bias"), (scale, "ppm of scale factor"))
            if value > _NEGLIGIBLE
        ]
        notes.append(
            Note(
                f"these attitudes do not show k{order}: the uncertainties assume k{order} = 0"
                f"{' and scale factors that do not differ between + and -' * (order == 2)}; 1 {unit} of it moves up "
                f"to {' and '.join(moved)} (tumble plan --order 3 chooses attitudes that show it)"
            )
        )
    return notes


# The calibration record of a tumble test: parameters in SI, and what its figures need.


_DOWN_WEIGHTED = 0.5  # Huber's weight below which an attitude is named, and left out of patterns
_HIGH_CONDITION = 300.0  # condition number from which the attitudes hardly tell parameters apart
_TO_MICRO = 1e6  # to µg and ppm
_REMEDIES = {
    ("norm", "square"): "--loss auto sets it aside",
    ("norm", "auto"): "it was not set aside: --loss huber limits its pull",
    ("linearised", "square"): "--method norm --loss auto sets it aside",
    ("linearised", "auto"): "--method norm sets it aside",
}


class Scaling(Struct, frozen=True):
    """Nominal zero and scale (output per g) of each axis, shape (3,), that the fit works relative to."""

    zero: Array
    scale: Array


def make_record(
    estimate: Estimate,
    gravity: Gravity,
    scaling: Scaling,
    options: Mapping[str, Any],
    monte_carlo: MonteCarlo | None = None,
) -> Calibration:
    """Turn an estimate in units of g into the record.

    ``S = scale sigma / g``, ``b = (zero + scale z) / S``, ``k_j = theta_j / g^(j-1)``; covariances are carried along by
    their derivatives, and gravity's own uncertainty is added, which all scale factors and biases share.
    """
    attitudes, problem, solution, complete = estimate.attitudes, estimate.problem, estimate.solution, estimate.found
    outliers = _find_outliers(problem, solution)
    g, recording = gravity.value, attitudes.recording
    parameters, matrix, shared = _parameters(estimate, gravity, scaling)
    freedom = data_freedom(problem, solution.jacobian[0], 1 / solution.variance[0])
    chi_square = float((solution.down_weights[0] * solution.residuals[0] ** 2 / solution.own_variance[0]).sum())
    if problem.covariance is None:
        chi_square *= g**2
    return Calibration(
        procedure="tumble",
        parameters=parameters,
        covariance=Covariance((), ())
        if matrix is None
        else Covariance(tuple(parameters), tuple(map(tuple, matrix.tolist()))),
        model=entries(_model(attitudes, problem, gravity)),
        fit=entries(
            _summary(
                estimate,
                options,
                g,
                chi_square,
                freedom,
                shared={gravity.name: dict(zip(parameters, shared.tolist(), strict=True))} if shared.any() else None,
                trials=None if monte_carlo is None else _propagated(monte_carlo, scaling, gravity, problem.order),
            )
        ),
        options=dict(options),
        data=entries(_evidence(complete.attitudes, scaling, complete.problem, complete.solution, g)),
        sensor={key: recording.metadata[key] for key in ("serial", "model", "element") if key in recording.metadata},
        sources=(recording.source,) if recording.source else (),
        warnings=(
            *_warnings(estimate, gravity, options, outliers),
            *_scatter_warnings(problem, solution, chi_square, freedom, order_chosen=bool(estimate.orders)),
            *shake_warnings(problem.motion, solution),
            *_pattern_warnings(attitudes, problem, solution, outliers, order_chosen=bool(estimate.orders)),
            *source_warnings(complete, str(options["method"])),
            *aside_warnings(complete, options, g),
            *assumption_notes(estimate.stated),
            *estimate.notes,
        ),
    )


def _parameters(
    estimate: Estimate, gravity: Gravity, scaling: Scaling
) -> tuple[dict[str, Parameter], Array | None, Array]:
    """Return the parameters in SI, their covariance, (p, p), and what of it they share through gravity, (p,)."""
    g, order, cross, stated = gravity.value, estimate.problem.order, estimate.problem.cross, estimate.stated
    names, units = parameter_names(order, cross), parameter_units(order, estimate.attitudes.unit, cross)
    values, derivative = si_parameters(estimate.solution.theta[0], scaling, g, order)
    shared = (not estimate.with_gravity) * gravity.standard_uncertainty / g * gravity_slope(values, order)
    matrix = None if stated is None else derivative @ stated.covariance @ derivative.T + np.outer(shared, shared)
    uncertainty: list[float | None] = [None] * len(names)
    given_order: list[float | None] = [None] * len(names)
    if matrix is not None:
        uncertainty = np.sqrt(np.diag(matrix)).tolist()
    if stated is not None and stated.given_order is not None:
        given_order = np.sqrt(np.diag(derivative @ stated.given_order @ derivative.T) + shared**2).tolist()
    columns = zip(names, values.tolist(), uncertainty, units, given_order, strict=True)
    return (
        {name: Parameter(v, u, unit, standard_uncertainty_given_order=o) for name, v, u, unit, o in columns},
        matrix,
        shared,
    )


def _model(attitudes: Attitudes, problem: TumbleProblem, gravity: Gravity) -> TumbleModel:
    """Return the law of the record, and the conditions of the test."""
    return TumbleModel(
        order=problem.order,
        gravity=StatedGravity.of(gravity),
        output_unit=attitudes.unit,
        gauge=GAUGE,
        cross=True if problem.cross else None,
        temperature=None if attitudes.temperature is None else Quantity(value=attitudes.temperature, unit="degC"),
    )


def _summary(
    estimate: Estimate,
    options: Mapping[str, Any],
    g: float,
    chi_square: float,
    freedom: float,
    *,
    shared: dict[str, dict[str, float]] | None,
    trials: Trials | None,
) -> TumbleSummary:
    """Return how the estimate was made, and how well it fits."""
    problem, solution, orders, stated = estimate.problem, estimate.solution, estimate.orders, estimate.stated
    n, size = len(estimate.attitudes), solution.theta.shape[1]
    return TumbleSummary(
        method=options["method"],
        loss=options["loss"],
        attitudes=n,
        set_aside=[number + 1 for number in estimate.found.aside.index],
        rms=Length(value=g * float(np.sqrt(np.mean(solution.deviations[0] ** 2))), unit="m/s^2"),
        leave_one_out=_leave_one_out(orders, problem, solution, str(options["method"]), g),
        degrees_of_freedom=n - size if problem.prior is None else freedom,
        reduced_chi_square=chi_square / freedom if freedom > 0 else None,
        noise="known" if problem.covariance is not None else "estimated from the residuals",
        excess=Length(value=g * float(solution.excess[0]), unit="m/s^2"),
        effective_degrees_of_freedom=None if stated is None else stated.freedom,
        coverage_factor_95=None if stated is None else coverage_factor(stated.freedom),
        coverage_factor_95_given_order=_coverage_factor_given_order(stated),
        blend=_blend(stated),
        rank=estimate.observability.rank,
        condition_number=estimate.observability.condition,
        iterations=int(solution.iterations[0]),
        orders=list(orders),
        shared=shared,
        monte_carlo=trials,
        prior=estimate.prior,
    )


def _coverage_factor_given_order(stated: StatedUncertainty | None) -> float | None:
    """Return the coverage factor if the order were known to be right, None where it was not chosen from the data."""
    if stated is None or stated.blended is None or stated.given_order is None:
        return None
    return coverage_factor(stated.freedom_given_order)


def _blend(stated: StatedUncertainty | None) -> OrderBlend | None:
    """Return up to which order the stated uncertainty holds, and the noise that each order takes."""
    if stated is None or stated.blended is None:
        return None
    noise = {str(order): share for order, share in stated.blended.noise.items()}
    narrower = stated.blended.narrower
    return OrderBlend(
        highest_order=stated.blended.order, noise_share=noise, narrower=None if narrower is None else dict(narrower)
    )


def _propagated(trials: MonteCarlo, scaling: Scaling, gravity: Gravity, order: int) -> Trials:
    """Return mean, standard deviation and 95 % interval of every parameter over the trials, in SI."""
    drawn = np.random.default_rng(2).standard_normal((len(trials.theta), 1))
    values = _si_values(trials.theta, scaling, gravity.value + gravity.standard_uncertainty * drawn, order)
    low, high = np.quantile(values, [0.025, 0.975], axis=0)
    columns = zip(parameter_names(order), values.mean(axis=0), values.std(axis=0, ddof=1), low, high, strict=True)
    return Trials(
        trials=len(values),
        failed=trials.failed,
        parameters={
            name: Spread(mean=float(m), standard_deviation=float(s), interval_95=[float(a), float(b)])
            for name, m, s, a, b in columns
        },
    )


def _si_values(theta: Array, scaling: Scaling, g: float | Array, order: int) -> Array:
    """Parameter vectors in SI, shape (b, p); one gravity, or one for each, shape (b, 1)."""
    scale_factor = scaling.scale * theta[:, 3:6] / g
    bias = (scaling.zero + scaling.scale * theta[:, 0:3]) / scale_factor
    powers = powers_of_gravity(order, theta.shape[1])
    return np.hstack([bias, scale_factor, theta[:, 6:9], theta[:, 9:] / g**powers])


def scaled_parameters(values: Array, scaling: Scaling, g: float) -> Array:
    """Return parameters in SI, shape (p,), as scaled ones: the inverse of `_si_values`."""
    bias, scale_factor = values[:3], values[3:6]
    powers = np.repeat(np.arange(1, len(values) // 3 - 2), 3)
    return np.concatenate(
        [
            (scale_factor * bias - scaling.zero) / scaling.scale,
            scale_factor * g / scaling.scale,
            values[6:9],
            values[9:] * g**powers,
        ]
    )


def si_derivative(theta: Array, scaling: Scaling, g: float) -> Array:
    """Return the derivatives of the parameters in SI by the scaled ones, shape (p, p)."""
    return si_parameters(theta, scaling, g, len(theta) // 3 - 2)[1]


def si_parameters(theta: Array, scaling: Scaling, g: float, order: int) -> tuple[Array, Array]:
    """Return the parameter vector in SI and its derivative with respect to theta, shape (p, p)."""
    values = _si_values(theta[None], scaling, g, order)[0]
    bias, scale_factor, sigma = values[:3], values[3:6], theta[3:6]
    powers = powers_of_gravity(order, len(theta))
    derivative = np.diag(
        np.concatenate([scaling.scale / scale_factor, scaling.scale / g, np.ones(len(theta[6:9])), g**-powers])
    )
    derivative[range(3), range(3, 6)] = -bias / sigma
    return values, derivative


def _leave_one_out(
    orders: tuple[OrderRow, ...], problem: TumbleProblem, solution: TumbleSolution, method: str, g: float
) -> Length | None:
    """Error of each attitude predicted from the others, rms: from the table of orders, or by the linear formula."""
    for row in orders:
        if row.order == problem.order and row.leave_one_out is not None and method == "norm" and not problem.cross:
            return Length(value=row.leave_one_out, unit="m/s^2")
    if problem.reading.shape[1] <= solution.theta.shape[1]:
        return None
    free = np.maximum(1 - solution.leverage[0], 1e-12)
    felt = solution.down_weights[0] * solution.residuals[0] / free
    return Length(value=g * float(np.sqrt(np.mean(felt**2))), unit="m/s^2")


def _evidence(
    attitudes: Attitudes, scaling: Scaling, problem: TumbleProblem, solution: TumbleSolution, g: float
) -> TumbleEvidence:
    """Return of each attitude its mean output, force and residual, and the deviation over time."""
    known = problem.covariance is not None
    before = np.linalg.norm(problem.reading[0], axis=1) - 1
    uncertainty = np.sqrt(solution.own_variance[0]) * g
    held = HeldAttitudes(
        label=[attitudes.label(i) for i in range(len(attitudes))],
        start=attitudes.start.tolist(),
        stop=attitudes.stop.tolist(),
        samples=attitudes.samples.tolist(),
        mean=attitudes.mean.tolist(),
        covariance=None if attitudes.covariance is None else attitudes.covariance.tolist(),
        force=(g * forces(problem, solution)[0]).tolist(),
        residual=(g * solution.deviations[0]).tolist(),
        residual_before=(g * before).tolist(),
        standard_uncertainty=uncertainty.tolist() if known else None,
        lengthening=(g * solution.lengthening[0]).tolist(),
        down_weight=solution.down_weights[0].tolist(),
    )
    trace = attitudes.trace
    if trace is None:
        return TumbleEvidence(attitudes=held)
    deviation = DeviationTrace(
        time=np.round(trace.time, 6).tolist(),
        deviation=(np.sqrt(trace.variance) / float(np.mean(scaling.scale)) * g).tolist(),
        threshold=float(np.sqrt(trace.threshold) / np.mean(scaling.scale) * g),
        unit="m/s^2",
    )
    return TumbleEvidence(attitudes=held, trace=deviation)


def _warnings(
    estimate: Estimate, gravity: Gravity, options: Mapping[str, Any], outliers: Mapping[int, float]
) -> list[str]:
    attitudes, problem, solution = estimate.attitudes, estimate.problem, estimate.solution
    return [
        *attitudes.recording.notes,
        *attitudes.notes,
        *gravity_findings(gravity, attitudes.recording),
        *(
            _order_warnings(estimate)
            or _attitude_warnings(attitudes, problem, solution, options, outliers, gravity.value)
        ),
        *_freedom_warnings(problem, solution, estimate.observability),
        *size_warnings(attitudes, solution),
    ]


def _order_warnings(estimate: Estimate) -> list[str]:
    """Say that the model is too simple, where a higher order explains what would pass for a knock."""
    order = estimate.explained_by
    if order is None:
        return []
    return [
        f"the model is too simple: order {order} explains attitudes that would pass for knocked ones at order "
        f"{estimate.problem.order}, and none is set aside; fit with --order {order} or --order auto"
    ]


def beyond_noise(problem: TumbleProblem, chi_square: float, freedom: float) -> bool:
    """Whether attitudes scatter so much that their own noise would do it once in a hundred tests or less."""
    known = problem.covariance is not None and freedom >= 1
    return known and chi_square_probability(chi_square, freedom) < ATTITUDES_SCATTER.level


def _scatter_warnings(
    problem: TumbleProblem, solution: TumbleSolution, chi_square: float, freedom: float, *, order_chosen: bool
) -> list[str]:
    """Say that the attitudes scatter beyond their noise, or far below it.

    The uncertainties hold what scatters: with the order chosen from the data that is a note. With one that was stated
    it may be what the model lacks, which is no scatter.
    """
    known = problem.covariance is not None and problem.prior is None and not problem.robust
    if known and freedom > 0 and chi_square_probability(chi_square, freedom) > 1 - ATTITUDES_TOO_QUIET.level:
        return [
            Finding(
                "the attitudes scatter less than their own noise lets expect (reduced chi-square "
                f"{chi_square / freedom:.3g}): that noise is overstated, and every uncertainty is about "
                f"{np.sqrt(freedom / max(chi_square, 1e-12)):.2g} times too large",
                "leave the stated noise out (columns std_*)"
                if problem.motion is None
                else "record again on something firm: shaking within the attitudes counts as their noise",
            )
        ]
    if not beyond_noise(problem, chi_square, freedom):
        return []
    added = f"; {_TO_MICRO * solution.excess[0]:.3g} µg were added to each attitude's uncertainty"
    text = Finding(
        "the attitudes scatter more than their own noise explains (reduced chi-square "
        f"{chi_square / freedom:.3g}){added if solution.excess[0] > 0 else ''}",
        "record the attitudes again, each held still until it has settled",
    )
    if solution.excess[0] > 0 and order_chosen:
        return [Note(text)]
    return [Finding(text, "fit with --order auto" if not order_chosen else "put the unit on something firm")]


def _pattern_warnings(
    attitudes: Attitudes,
    problem: TumbleProblem,
    solution: TumbleSolution,
    outliers: Mapping[int, float],
    *,
    order_chosen: bool,
) -> list[str]:
    """Warn of residuals that depend on direction or time, outliers left out; not with a prior, which bends them too."""
    if problem.prior is not None:
        return []
    kept = np.where(solution.down_weights < _DOWN_WEIGHTED, 0.0, solution.down_weights)
    kept[0, list(outliers)] = 0.0
    regular = solution if np.array_equal(kept, solution.down_weights) else replace(solution, down_weights=kept)
    return [
        *direction_findings(problem, regular, order_chosen=order_chosen),
        *time_findings(attitudes, problem, regular),
    ]


def _attitude_warnings(
    attitudes: Attitudes,
    problem: TumbleProblem,
    solution: TumbleSolution,
    options: Mapping[str, Any],
    outliers: Mapping[int, float],
    gravity: float,
) -> list[str]:
    deviation = gravity * solution.deviations[0]
    if problem.robust:
        down = solution.down_weights[0]
        which = np.flatnonzero(down < _DOWN_WEIGHTED).tolist()
        single: list[str] = [
            Finding(
                f"down-weighted to {down[i]:.2f}: {attitudes.label(i)}, residual {_signed(deviation[i])}",
                "measure this attitude again",
            )
            for i in which
        ]
    else:
        single = [
            Finding(
                f"{attitudes.label(i)} stands out by {standard:.0f} standard deviations "
                f"(residual {_signed(deviation[i])}); {_REMEDIES[options['method'], options['loss']]}",
                "measure this attitude again",
            )
            for i, standard in outliers.items()
        ]
    if len(single) <= _MOST_NAMED:
        return single
    more = f"and {len(single) - _MOST_NAMED} more attitudes like these"
    return [*single[:_MOST_NAMED], Finding(more, "measure these attitudes again")]


def _freedom_warnings(problem: TumbleProblem, solution: TumbleSolution, observability: Observability) -> list[str]:
    n, size = problem.reading.shape[1], solution.theta.shape[1]
    messages: list[str] = []
    if observability.condition > _HIGH_CONDITION:
        confused = observability.confused(parameter_names(problem.order, problem.cross))
        messages.append(
            Finding(
                f"condition number {observability.condition:.0f}: these attitudes hardly separate "
                f"{' '.join(confused[:6])}",
                "record more attitudes (imulab tumble plan --add FILE)",
            )
        )
    if n == size and problem.covariance is None:
        messages.append(
            Finding(
                f"{n} attitudes for {size} parameters leave nothing to estimate the noise from: no uncertainty is "
                "stated",
                "record more attitudes (imulab tumble plan --add FILE)",
            )
        )
    few = freedom_finding(n, size, problem.order)
    if few is not None and problem.prior is None:
        messages.append(few)
    return messages


def _find_outliers(problem: TumbleProblem, solution: TumbleSolution) -> dict[int, float]:
    """Return the attitudes that stand out, and by how many standard deviations.

    Each residual is held against its noise and excess, scaled by the scatter of the others with itself left out
    (externally studentised; Belsley, Kuh and Welsch 1980), or against its own noise where that is more. What the
    attitudes scatter in common is a long and quiet hold's too.
    """
    n, size = problem.reading.shape[1], solution.theta.shape[1]
    freedom = n - size
    if freedom < FEW_DEGREES:
        return {}
    share = np.maximum(1 - solution.leverage[0], 1e-3)
    standard = np.abs(solution.residuals[0]) / np.sqrt(solution.variance[0] * share)
    others = np.sqrt(np.maximum(((standard**2 * share).sum() - standard**2) / (freedom - 1), 0.0))
    stated = np.sqrt(solution.own_variance[0] / solution.variance[0])
    standard = standard / np.maximum(others, stated if problem.covariance is not None else 1e-12)
    limit = max(ATTITUDE_STANDS_OUT_BY.limit, coverage_factor(freedom - 1, 1 - ATTITUDE_STANDS_OUT.level / n))
    return {i: float(standard[i]) for i in np.flatnonzero(standard > limit).tolist()}


# The parameters of a tumble record as rows and tables that its record alone does not give.


def same_meaning(name: str, first: Calibration, second: Calibration) -> bool:
    """Return whether a parameter means the same in both records: magnetometers' outputs may be renamed otherwise."""
    if name == "dip":
        return False  # of the place, not of the unit
    return not name.startswith("mag_") or first.model.get("mag_axes") == second.model.get("mag_axes")


def propagated_rows(record: Calibration, trials: Trials) -> list[list[str]]:
    """Return the Monte Carlo intervals beside the linear ones: name, both, ratio of their widths, unit."""
    fit = fit_of(record)
    coverage = fit.coverage_factor_95_given_order or fit.coverage_factor_95 or 0.0
    rows = []
    for name, propagated in trials.parameters.items():
        parameter = record.parameter(name)
        read = reading_unit(parameter.unit, name)
        u = parameter.standard_uncertainty_given_order or parameter.standard_uncertainty or 0.0
        linear = (parameter.value - coverage * u, parameter.value + coverage * u)
        texts = [" to ".join(read.texts(end, u)[0] for end in ends) for ends in (linear, propagated.interval_95)]
        width = linear[1] - linear[0]
        ratio = (propagated.interval_95[1] - propagated.interval_95[0]) / width if width else math.nan
        rows.append([name, *texts, f"{ratio:.3f}", read.symbol])
    return rows


def predicted_rows(uncertainties: dict[str, float]) -> list[tuple[str, str, str]]:
    """Return predicted uncertainties (units of g) as name, text and unit."""
    units = {"bias": "µg", "scale_factor": "ppm", "misalignment": "µrad"}
    rows = []
    for name, value in uncertainties.items():
        stem = name.rpartition("_")[0]
        unit = units.get(stem) or f"µg/g{'⁰¹²³⁴⁵'[int(stem[1:])] if stem[1:].isdigit() else ''}"
        rows.append((name, plain_number(value * 1e6, 3), unit))
    return rows


def rows(record: Calibration) -> list[Row]:
    """Return the parameters as they are read, with what counts and volts are at zero specific force and rate."""
    table = with_zero_outputs(record, rows_of(record), "", model_of(record).output_unit)
    if "gyro_bias_x" not in record.parameters:
        return table
    return with_zero_outputs(record, table, "gyro_", gyro_model_of(record).gyro_output_unit)
