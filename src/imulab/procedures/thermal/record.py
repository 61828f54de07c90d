"""The calibration record of a thermal test: coefficients in SI, what its figures need, and its warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imulab.display import UNJUDGED, Finding, Note
from imulab.estimation.decisions import HOLD_DISAGREEMENT, TEMPERATURE_MISSED
from imulab.estimation.distributions import probability_fact
from imulab.estimation.least_squares import coverage_factor
from imulab.gravity import Gravity, gravity_findings
from imulab.procedures.thermal.agreement import warn_disagreement
from imulab.procedures.thermal.degrees import (
    ChosenLaws,
    LagAndLoops,
    describe_degrees,
    list_effects,
    number_temperatures,
    warn_lag_and_loops,
)
from imulab.procedures.thermal.gyro import ThermalGyroscopes, note_turns
from imulab.procedures.thermal.hidden import bias_shift_from_unobserved
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import AXES, GROUPS, MISALIGNMENTS, SENSITIVITIES, SHARES, Laws, law_names
from imulab.procedures.thermal.schema import (
    DegreesTried,
    GyroDegrees,
    GyroHoldResiduals,
    GyroTurnOn,
    GyroTurns,
    HoldResiduals,
    LawDegrees,
    LeftOutTemperature,
    OwnCalibrations,
    ThermalEvidence,
    ThermalGyroModel,
    ThermalGyroSummary,
    ThermalModel,
    ThermalSummary,
    TurnOn,
    gyros_of,
    thermal_of,
)
from imulab.procedures.thermal.solve import (
    OwnCalibration,
    Scatter,
    ThermalProblem,
    ThermalSolution,
    own_calibrations,
    row_covariance,
)
from imulab.procedures.thermal.turns import ScaleLaws, block_diagonal, joint_covariance, rescale_gyroscopes
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.sections import Length, Quantity, StatedGravity, entries
from imulab.report.parameters import text_in
from imulab.units import from_si, parse_unit

# Accelerometers.


_MOST_NAMED = 6  # holds that warnings name
_SAME = 1e-9
"""Relative difference up to which two values of gravity are the same."""
_GAUGE = "x input axis along body x, y input axis in the body xy plane, at every temperature"


def make_record(
    holds: Holds,
    problem: ThermalProblem,
    chosen: ChosenLaws,
    drift: LagAndLoops,
    gravity: Gravity,
    scale: Array,
    options: Mapping[str, Any],
    name: str,
) -> Calibration:
    """Return the record of a solution in units of g."""
    solution, g = chosen.solution, gravity.value
    laws = solution.laws
    values, matrix = convert_to_si(solution, gravity, scale)
    names, units = laws.names(), laws.units(holds.unit)
    freedom = [solution.degrees_of_freedom(row) for row in laws.to_powers()]
    parameters = {
        key: Parameter(float(value), float(u), unit, interval_95=student_interval(float(value), float(u), nu))
        for key, value, u, unit, nu in zip(names, values, np.sqrt(np.diag(matrix)), units, freedom, strict=True)
    }
    if laws.knots:
        parameters = biases_at_reference(laws, values, matrix, "bias", "m/s^2") | parameters
    residual, uncertainty = _residuals(problem, solution)
    sensor = {
        key: text for key in ("serial", "model", "element") for r in holds.recordings if (text := r.metadata.get(key))
    }
    sources = tuple(r.source for r in holds.recordings if r.source is not None)
    return Calibration(
        procedure="thermal",
        parameters=parameters,
        covariance=Covariance(tuple(names), tuple(map(tuple, matrix.tolist()))),
        model=entries(
            ThermalModel(
                order=1,
                degrees=LawDegrees(bias=laws.degrees[0], scale_factor=laws.degrees[1], misalignment=laws.degrees[2]),
                knots=list(laws.knots) or None,
                range=[laws.low, laws.high],
                reference_temperature=Quantity(value=laws.middle, unit="degC"),
                gravity=StatedGravity.of(gravity),
                output_unit=holds.unit,
                gauge=_GAUGE,
            )
        ),
        fit=entries(_summarize_fit(holds, residual, chosen, drift, options, g)),
        options=dict(options),
        data=entries(
            ThermalEvidence(
                holds=_hold_residuals(holds, g * residual, g * uncertainty),
                calibrations=_own_calibrations(
                    own_calibrations(problem, solution), holds, np.append(np.full(3, g), scale / g)
                ),
            )
        ),
        sensor=sensor,
        sources=sources,
        warnings=tuple(_warn_fit(holds, problem, chosen, drift, gravity, options, name)),
    )


def biases_at_reference(laws: Laws, values: Array, covariance: Array, kind: str, unit: str) -> dict[str, Parameter]:
    """Return the values of the biases' splines at T0, under the names of polynomials' biases."""
    weights, parameters = laws.cardinal(np.array([laws.middle]))[0], {}
    for axis, part in zip(AXES, laws.parts[:3], strict=True):
        u = float(np.sqrt(weights @ covariance[part, part] @ weights))
        parameters[f"{kind}_{axis}"] = Parameter(float(weights @ values[part]), u, unit)
    return parameters


def _summarize_fit(
    holds: Holds, residual: Array, chosen: ChosenLaws, drift: LagAndLoops, options: Mapping[str, Any], g: float
) -> ThermalSummary:
    """Return ``fit``: how the laws were chosen, and how well they fit."""
    solution, effects = chosen.solution, list_effects(drift, g)
    return ThermalSummary(
        recordings=len(holds.recordings),
        holds=len(holds),
        temperatures=int(number_temperatures(holds.temperature).max(initial=0)) + 1,
        rms=Length(value=g * float(np.sqrt(np.mean(residual**2))), unit="m/s^2"),
        excess=Length(value=g * solution.excess, unit="m/s^2"),
        chi_square=solution.chi_square,
        degrees_of_freedom=solution.freedom,
        condition_number=chosen.view.condition,
        between_recordings=_turn_on_section(solution, options, g),
        left_out_temperature=[
            LeftOutTemperature(
                temperature=each.temperature, holds=each.holds, rms=g * each.rms, chi_square=each.chi_square
            )
            for each in chosen.left_out
        ],
        degrees=[
            DegreesTried(
                degrees=list(step.degrees),
                left_out=None if step.left_out is None else g * step.left_out,
                probability=step.probability,
                chosen=step.chosen,
                knots=step.knots,
            )
            for step in chosen.steps
        ],
        lag=effects["lag"],
        loop_x=effects["loop_x"],
        loop_y=effects["loop_y"],
        loop_z=effects["loop_z"],
    )


def _hold_residuals(holds: Holds, residual: Array, uncertainty: Array) -> HoldResiduals:
    """Return ``data.holds``; residual and uncertainty of |f| - g in m/s^2."""
    return HoldResiduals(
        recording=[holds.recordings[k].name for k in holds.recording.tolist()],
        start=holds.start.tolist(),
        stop=holds.stop.tolist(),
        temperature=holds.temperature.tolist(),
        rate=holds.rate.tolist(),
        group=[None if k < 0 else k for k in holds.group.tolist()],
        mean=holds.mean.tolist(),
        residual=residual.tolist(),
        standard_uncertainty=uncertainty.tolist(),
    )


def _own_calibrations(calibrations: list[OwnCalibration], holds: Holds, factor: Array) -> OwnCalibrations | None:
    """Return ``data.calibrations``; `factor` converts biases and scale factors to SI, shape (6,)."""
    if not calibrations:
        return None
    each = np.append(factor, np.ones(3))
    names = [
        "prior" if calibration.recording < 0 else holds.recordings[calibration.recording].name
        for calibration in calibrations
    ]
    return OwnCalibrations(
        recording=names,
        temperature=[calibration.temperature for calibration in calibrations],
        values=[(each * calibration.values).tolist() for calibration in calibrations],
        standard_uncertainty=[(each * calibration.standard_uncertainty).tolist() for calibration in calibrations],
    )


def student_interval(value: float, uncertainty: float, freedom: float) -> tuple[float, float] | None:
    """Return the 95 % interval of a value by Student's t; None for infinite degrees of freedom."""
    if not np.isfinite(freedom):
        return None
    reach = coverage_factor(freedom) * uncertainty
    return value - reach, value + reach


def convert_to_si(solution: ThermalSolution, gravity: Gravity, scale: Array) -> tuple[Array, Array]:
    """Return the coefficients of powers of T - T0 in SI, and their covariance.

    ``b = beta g``, ``S = scale sigma / g``; an error of gravity changes biases by dg/g and scale factors by -dg/g.
    """
    laws, g = solution.laws, gravity.value
    factor, share = _si_factors(laws, g, scale)
    matrix = factor[:, None] * laws.to_powers()
    values = matrix @ solution.coefficients[: laws.size]
    shared = share * values * gravity.standard_uncertainty / g
    covariance: Array = matrix @ solution.covariance[: laws.size, : laws.size] @ matrix.T + np.outer(shared, shared)
    return values, covariance


def _si_factors(laws: Laws, gravity: float, scale: Array) -> tuple[Array, Array]:
    """Return the factor of each coefficient from units of g to SI, and its relative change over that of gravity."""
    each = np.concatenate([np.full(3, gravity), scale / gravity, np.ones(3)])
    counts = np.repeat(laws.terms, 3)
    return np.repeat(each, counts), np.repeat(np.repeat([1.0, -1.0, 0.0], 3), counts)


def laws_in_g(record: Calibration, gravity: float, uncertainty: float) -> tuple[Laws, Array, Array, Array, float]:
    """Return the laws of a record, coefficients and covariance in units of g, and the outputs' scale, per g.

    Last is the variance that an error of `gravity` adds to every ``|f| / g``. It is 0 where the record was made with
    the same gravity, whose error is then subtracted from the covariance.
    """
    model = thermal_of(record).model
    laws = model.laws
    names = laws.names()
    scale = np.array([gravity * abs(record.value(f"scale_factor_{axis}")) for axis in AXES])
    factor, share = _si_factors(laws, gravity, scale)
    inverse = np.linalg.inv(factor[:, None] * laws.to_powers())
    values, covariance = np.array([record.value(name) for name in names]), record.cov(*names)
    stated = float(record.model["gravity"].get("standard_uncertainty") or 0.0) / model.gravity.value
    same = abs(model.gravity.value / gravity - 1) < _SAME
    if same:
        shared = share * values * stated
        covariance = covariance - np.outer(shared, shared)
    common = 0.0 if same else (uncertainty / gravity) ** 2
    return laws, inverse @ values, inverse @ covariance @ inverse.T, scale, common


def _residuals(problem: ThermalProblem, solution: ThermalSolution) -> tuple[Array, Array]:
    """Return |f| - 1 of each hold, corrected for the lengthening by noise, and its standard uncertainty, in g."""
    rows = solution.rows
    used = rows.magnitude & (rows.owner >= 0)
    order = np.argsort(rows.owner[used])
    return rows.residual[used][order], np.sqrt(np.diag(rows.noise)[used][order])


def _turn_on_section(solution: ThermalSolution, options: Mapping[str, Any], g: float) -> TurnOn:
    """Return ``fit.between_recordings``: the scatter between power cycles, and how it is known."""
    scatter = solution.scatter
    return TurnOn(
        bias=Length(value=g * float(scatter.tau[0]), unit="m/s^2"),
        scale_factor=Length(value=float(scatter.tau[1]), unit="1"),
        rank=scatter.rank,
        resolution=Length(value=g * scatter.resolution, unit="m/s^2"),
        from_="argument" if "turn_on_scatter" in options else scatter_source(scatter),
    )


def scatter_source(scatter: Scatter) -> str:
    """Return how the scatter between power cycles is known, where it was not stated."""
    return "polynomials" if scatter.bound else "recordings" if scatter.rank else "unknown"


def _warn_fit(
    holds: Holds,
    problem: ThermalProblem,
    fitted: ChosenLaws,
    drift: LagAndLoops,
    gravity: Gravity,
    options: Mapping[str, Any],
    name: str,
) -> list[str]:
    """Return the warnings and notes of a fit of the accelerometers."""
    solution = fitted.solution
    messages = [*(note for r in holds.recordings for note in r.notes), *holds.notes]
    messages += gravity_findings(gravity, holds.recordings[0])
    if not solution.scatter.rank and "turn_on_scatter" not in options:
        messages.append(
            f"{name}: too few recordings to tell how far biases move from one power cycle to the next; no uncertainty "
            "covers this: record more temperatures or come back to some, or state --turn-on-scatter"
        )
    if solution.scatter.bound:
        messages.append(
            Note(
                f"{name}: a spline cannot tell the offset of a power cycle from the law where a temperature has one "
                f"recording; {1e3 * solution.scatter.tau[0]:.2g} mg, what polynomials of degree 3 leave, counts as the "
                "scatter between power cycles, an upper bound: come back to temperatures to learn more"
            )
        )
    if fitted.missed:
        higher, probability = fitted.missed
        messages.append(
            f"{name}: degrees {solution.laws.spelled} are too low: what {','.join(map(str, higher))} add has a "
            f"probability of {probability_fact(probability)} by chance, and the stated "
            "uncertainties do not cover what is missing: state higher ones, or leave --degrees out"
        )
    else:
        messages += warn_disagreement(holds, problem, solution, name)
    if options["degrees"] == "auto" and not solution.laws.degrees[0] and solution.scatter.tau[0] > 0:
        messages.append(
            f"{name}: the recordings' biases differ by {1e3 * solution.scatter.tau[0]:.2g} mg (standard deviation); so "
            "few recordings do not tell whether by their temperature or from power cycle to power cycle: record five "
            "temperatures or more, or state --degrees"
        )
    messages += bias_shift_from_unobserved(problem, solution, name)
    if options["degrees"] == "auto":
        messages.append(Note(f"degrees chosen: {describe_degrees(solution.laws.degrees, len(solution.laws.knots))}"))
    far = [each for each in fitted.left_out if each.chi_square > TEMPERATURE_MISSED.limit**2]
    messages += [
        Finding(
            f"{each.temperature:.0f} degC, left out, is missed by {1e6 * each.rms:.0f} µg rms, more than its "
            "uncertainty explains: the unit's law has a bend between the temperatures; record one more there",
            f"record at one more temperature beside {each.temperature:.0f} degC",
        )
        for each in far
    ]
    return messages + warn_lag_and_loops(drift, solution, name) + _warn_odd_holds(holds, solution)


def _warn_odd_holds(holds: Holds, solution: ThermalSolution) -> list[str]:
    """Return messages on the holds that stand out from the others of their recording."""
    rows = solution.rows
    messages: list[str] = []
    # Residuals less the part that a recording has in common, since that is due to its power cycle.
    whole, noise = (row_covariance(rows, solution.excess**2, tau) for tau in (solution.scatter.tau, np.zeros(2)))
    left = noise @ np.linalg.solve(whole, rows.residual)
    standard = np.abs(left) / np.sqrt(np.diag(rows.noise) + solution.excess**2)
    out = np.flatnonzero((standard > HOLD_DISAGREEMENT.limit) & (rows.owner >= 0))
    for index in out[np.argsort(-standard[out], kind="stable")][:_MOST_NAMED].tolist():
        what = "its magnitude" if rows.magnitude[index] else "its direction, although nothing was to move: a knock?"
        messages.append(
            Finding(
                f"{holds.label(int(rows.owner[index]))} stands out by {standard[index]:.0f} u in {what}",
                "leave this hold out (--window), or record it again",
            )
        )
    return messages


def evaluate_law(record: Calibration, names: Sequence[str], functions: Array) -> tuple[Array, Array]:
    """Return the values of a law and their standard uncertainties, SI, shapes (n,): ``F p`` and ``F C F'``.

    F are its functions at n temperatures, shape (n, k), p the coefficients `names` and C their covariance.
    """
    values: Array = functions @ np.array([record.value(each) for each in names])
    return values, np.sqrt(np.einsum("ni,ij,nj->n", functions, record.covariance.block(names), functions))


def predict_parameters(record: Calibration, temperature: Array) -> tuple[Array, Array]:
    """Return the nine parameters over temperature and their standard uncertainties, SI, shapes (9, n)."""
    model = thermal_of(record).model
    laws, about = model.laws, model.reference_temperature.value
    by_group = [
        evaluate_law(record, laws.named(group, f"{kind}_{axis}"), laws.recorded(group, temperature, about))
        for group, (kind, axes) in enumerate(GROUPS)
        for axis in axes
    ]
    return np.array([values for values, _ in by_group]), np.array([spread for _, spread in by_group])


def deviation_of_force(record: Calibration, temperature: Array) -> Array:
    """Return the standard deviation of a component of the corrected force by the laws, m/s^2, shape (n,).

    Root of the mean over all directions of f, of magnitude g: the variance of the bias, and a third of those of scale
    factor and misalignment, whose covariances with it have no mean.
    """
    values, spread = predict_parameters(record, temperature)
    g = thermal_of(record).model.gravity.value
    relative = np.concatenate([spread[:3] / g, spread[3:6] / np.abs(values[3:6]), spread[6:]])
    sd: Array = g * np.sqrt(SHARES @ relative**2)
    return sd


# Gyroscopes.


def with_gyroscopes(
    record: Calibration, holds: Holds, gyros: ThermalGyroscopes, turned: ScaleLaws | None, name: str
) -> Calibration:
    """Return the record with the gyroscopes' laws, taken as independent of the accelerometers' ones."""
    gyros = gyros if turned is None else rescale_gyroscopes(gyros, turned)
    gravity = record.model["gravity"]["value"] if gyros.sensitivity else 1.0  # rest ramps have neither
    laws = gyros.solution.laws
    names, units = names_and_units(laws, sensitivity=gyros.sensitivity)
    matrix, n = _gyro_to_si(gyros, gravity), gyros.count
    coefficients, covariance = gyros.solution.coefficients[:n], gyros.solution.covariance[:n, :n]
    freedom = [gyros.solution.degrees_of_freedom(row) for row in matrix]
    if turned is not None:
        scale_matrix, more, their_units = scale_to_si(turned, gyros.held.size, gyros.held.unit)
        names, units, freedom = names + more, units + their_units, freedom + [np.inf] * len(more)
        matrix = block_diagonal(matrix, scale_matrix)
        coefficients = np.concatenate([coefficients, turned.coefficients])
        covariance = joint_covariance(gyros, turned)
    values, covariance = matrix @ coefficients, matrix @ covariance @ matrix.T
    parameters = {
        key: Parameter(float(value), float(u), unit, interval_95=student_interval(float(value), float(u), nu))
        for key, value, u, unit, nu in zip(names, values, np.sqrt(np.diag(covariance)), units, freedom, strict=True)
    }
    if laws.knots:
        parameters = biases_at_reference(laws, values, covariance, "gyro_bias", "rad/s") | parameters
    joined = block_diagonal(record.covariance.array(), covariance)
    summary = _summarize_gyro(gyros, turned, known="gyro_turn_on_scatter" in record.options)
    return replace(
        record,
        parameters={**record.parameters, **parameters},
        covariance=Covariance((*record.covariance.names, *names), tuple(map(tuple, joined.tolist()))),
        model={
            **record.model,
            "gyro": entries(
                ThermalGyroModel(
                    output_unit=gyros.held.unit,
                    degrees=GyroDegrees(bias=laws.degrees[0], scale_factor=0 if turned is None else turned.degree),
                    knots=list(laws.knots) or None,
                    g_sensitivity=gyros.sensitivity,
                    scale="nominal" if turned is None else "turns",
                )
            ),
        },
        fit={**record.fit, "gyro": entries(summary)},
        data={**record.data, "gyro": entries(_gyro_hold_residuals(holds, gyros))},
        warnings=(*record.warnings, *_warn_gyroscopes(record, holds, gyros, turned, name)),
        verdict=UNJUDGED,
    )


def _gyro_to_si(gyros: ThermalGyroscopes, gravity: float) -> Array:
    """Return the matrix from the fit's coefficients to powers of T - T0, and from G to rad/s per m/s^2."""
    size, count = gyros.size, gyros.count
    matrix = np.eye(count) / gravity
    matrix[:size, :size] = gyros.solution.laws.to_powers()[:size, :size]
    return matrix


def scale_to_si(turned: ScaleLaws, size: Array, output: str) -> tuple[Array, list[str], list[str]]:
    """Return the matrix from coefficients of scale factors to powers of T - T0, output per rad/s; names and units."""
    count, width = len(turned.coefficients), turned.degree + 1
    unit = from_si(1.0, output) if parse_unit(output).quantity == "rate" else 1.0
    powers = turned.laws.to_powers()[3 : 3 + width, 3 : 3 + width]
    matrix = np.eye(count)
    names: list[str] = []
    units: list[str] = []
    for k, axis in enumerate(AXES):
        factor = slice(k * width, (k + 1) * width)
        matrix[factor, factor] = powers * size[k] * unit
        law = law_names(f"gyro_scale_factor_{axis}", f"{output}/(rad/s)", turned.degree)
        names, units = names + law[0], units + law[1]
    return matrix, names + list(MISALIGNMENTS), units + ["rad"] * len(MISALIGNMENTS)


def _turns_section(turned: ScaleLaws) -> GyroTurns:
    """Return ``fit.gyro.turns``: the turns of the recordings, and how well they agree."""
    return GyroTurns(
        recordings=turned.recordings,
        turns=turned.turns,
        rms=Length(value=turned.miss, unit="rad"),
        chi_square=turned.chi_square,
        degrees_of_freedom=turned.freedom,
    )


def names_and_units(laws: Laws, *, sensitivity: bool) -> tuple[list[str], list[str]]:
    """Return the names and units of the biases' coefficients and of the g-sensitivities."""
    names = [name for axis in AXES for name in laws.named(0, f"gyro_bias_{axis}")]
    units = laws.measured(0, "rad/s") * len(AXES)
    if sensitivity:
        names += SENSITIVITIES
        units += ["rad/s/(m/s^2)"] * len(SENSITIVITIES)
    return names, units


def _summarize_gyro(gyros: ThermalGyroscopes, turned: ScaleLaws | None, *, known: bool) -> ThermalGyroSummary:
    """Return ``fit.gyro``: how the laws were fitted, and how well; `known`: the turn-on scatter was stated."""
    solution, effects = gyros.solution, list_effects(gyros.drift, 1.0, "rad/s")
    return ThermalGyroSummary(
        holds=len(gyros.held),
        rms=Length(value=float(np.sqrt(np.mean(solution.rows.residual**2))), unit="rad/s"),
        excess=Length(value=solution.excess, unit="rad/s"),
        chi_square=solution.chi_square,
        degrees_of_freedom=solution.freedom,
        between_recordings=GyroTurnOn(
            bias=Length(value=float(solution.scatter.tau[0]), unit="rad/s"),
            rank=solution.scatter.rank,
            resolution=Length(value=solution.scatter.resolution, unit="rad/s"),
            from_="argument" if known else scatter_source(solution.scatter),
        ),
        g_sensitivity_probability=gyros.probability,
        latitude=None if gyros.held.earth is None else gyros.held.earth.latitude,
        lag=effects["lag"],
        loop_x=effects["loop_x"],
        loop_y=effects["loop_y"],
        loop_z=effects["loop_z"],
        left_out_temperature=[
            LeftOutTemperature(temperature=each.temperature, holds=each.holds, rms=each.rms, chi_square=each.chi_square)
            for each in gyros.left_out
        ],
        turns=None if turned is None else _turns_section(turned),
    )


def _gyro_hold_residuals(holds: Holds, gyros: ThermalGyroscopes) -> GyroHoldResiduals:
    """Return ``data.gyro``; residuals in rad/s."""
    held = gyros.held
    return GyroHoldResiduals(
        recording=[holds.recordings[k].name for k in held.recording.tolist()],
        temperature=held.temperature.tolist(),
        rate=held.rate.tolist(),
        residual=gyros.solution.rows.residual.reshape(-1, 3).tolist(),
    )


def _warn_gyroscopes(
    record: Calibration, holds: Holds, gyros: ThermalGyroscopes, turned: ScaleLaws | None, name: str
) -> list[str]:
    """Return the warnings and notes of a fit of the gyroscopes."""
    messages = [*gyros.held.notes, *([] if gyros.held.earth is None else [gyros.held.earth.note()])]
    messages += note_turns(holds, gyros.aside)
    scatter = gyros.solution.scatter
    if not scatter.rank and "gyro_turn_on_scatter" not in record.options and len(holds.recordings) == 1:
        messages.append(  # one ramp is all that was meant to be recorded, and tells what it can
            Note(
                f"gyro: {name}: one recording is one power cycle: how far the next one moves the biases is in no "
                "uncertainty; further ramps tell, or --gyro-turn-on-scatter"
            )
        )
    elif not scatter.rank and "gyro_turn_on_scatter" not in record.options:
        messages.append(
            f"gyro: {name}: too few recordings to tell how far biases move from one power cycle to the next; no "
            "uncertainty covers this: record more temperatures or come back to some, or state --gyro-turn-on-scatter"
        )
    messages += [
        Finding(
            f"gyro: {each.temperature:.0f} degC, left out, is missed by {np.degrees(each.rms):.2g} deg/s rms, more "
            "than its uncertainty explains: the law has a bend between the temperatures; record one more there",
            f"record at one more temperature beside {each.temperature:.0f} degC",
        )
        for each in gyros.left_out
        if each.chi_square > TEMPERATURE_MISSED.limit**2
    ]
    if scatter.bound:
        messages.append(
            Note(
                f"gyro: {name}: a spline cannot tell the offset of a power cycle from the law where a temperature has "
                f"one recording; {text_in(float(scatter.tau[0]), 'deg/h')} deg/h, what polynomials of degree 3 leave, "
                "counts as the scatter between power cycles, an upper bound: come back to temperatures to learn more"
            )
        )
    messages += _warn_gyro_drift(gyros, name)
    laws = gyros.solution.laws
    bias = f"bias by a spline with {len(laws.knots)} knots" if laws.knots else f"bias of degree {laws.degrees[0]}"
    if turned is None:
        return [*messages, Note(f"gyro: {bias}; no turns tell the scale factors, which are as stated")]
    summary = f"gyro: {bias}, scale factor of degree {turned.degree} from {turned.turns} turns"
    return [*messages, *turned.notes, Note(summary)]


def _warn_gyro_drift(gyros: ThermalGyroscopes, name: str) -> list[str]:
    """Return warnings of a significant lag or loop, with the error that corrected outputs keep."""
    drift = gyros.drift
    messages: list[str] = []
    if drift.values is None or drift.covariance is None:
        return []
    u = np.sqrt(np.diag(drift.covariance))
    if 0 in drift.free:
        messages.append(
            Finding(
                f"gyro: {name}: biases differ from their laws by those of {drift.values[0]:.3g} s before (u {u[0]:.2g} "
                "s); corrected outputs keep that",
                "record ramps at the speed at which the temperature changes in use",
            )
        )
    if 1 in drift.free:
        loops = from_si(drift.values[1:], "deg/h")
        each = ", ".join(f"{axis} {loop:+.3g}" for axis, loop in zip(AXES, loops, strict=True))
        messages.append(
            Finding(
                f"gyro: {name}: biases differ between warming and cooling: in the middle of the range they are {each} "
                f"deg/h (u {text_in(float(u[1:].max()), 'deg/h', 2)}) from their laws in warming, and as much the "
                "other way in cooling, which corrected outputs keep",
                "let each temperature soak longer, warming and cooling",
            )
        )
    return messages


def predict_gyro_scale(record: Calibration, temperature: Array) -> tuple[Array, Array]:
    """Return the three scale factors over temperature and their standard uncertainties, SI, shapes (3, n)."""
    return _predict_gyro(record, 1, "gyro_scale_factor", temperature)


def predict_gyro_bias(record: Calibration, temperature: Array) -> tuple[Array, Array]:
    """Return the three biases over temperature and their standard uncertainties, rad/s, shapes (3, n)."""
    return _predict_gyro(record, 0, "gyro_bias", temperature)


def _predict_gyro(record: Calibration, group: int, kind: str, temperature: Array) -> tuple[Array, Array]:
    """Return one kind of parameters over temperature and their standard uncertainties, SI, shapes (3, n)."""
    model = gyros_of(record).model
    laws = model.gyro_laws
    functions = laws.recorded(group, temperature, model.reference_temperature.value)
    by_axis = [evaluate_law(record, laws.named(group, f"{kind}_{axis}"), functions) for axis in AXES]
    return np.array([values for values, _ in by_axis]), np.array([spread for _, spread in by_axis])
