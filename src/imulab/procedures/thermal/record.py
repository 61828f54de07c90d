"""The calibration record of a thermal test: coefficients in SI, and what its figures need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from imulab.estimation.least_squares import coverage_factor
from imulab.gravity import Gravity, gravity_findings
from imulab.procedures.thermal.agreement import disagreements
from imulab.procedures.thermal.calibrations import Own, own_calibrations
from imulab.procedures.thermal.degrees import Found, clusters_of, spoken_degrees
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.lag import Drift, entries, findings
from imulab.procedures.thermal.model import AXES, GROUPS, SHARES, Laws
from imulab.procedures.thermal.rows import Problem, together
from imulab.procedures.thermal.sections import thermal_of
from imulab.procedures.thermal.solve import Scatter, Solution
from imulab.procedures.thermal.untold import untold
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.verdict import Note

_STANDS_OUT = 5.0
_MOST_NAMED = 6
_WORSE = 3.0
_SAME = 1e-9
"""Of two values of gravity that are one."""
_GAUGE = "x input axis along body x, y input axis in the body xy plane, at every temperature"


def make_record(
    holds: Holds,
    problem: Problem,
    found: Found,
    drift: Drift,
    gravity: Gravity,
    scale: Array,
    options: Mapping[str, Any],
    name: str,
) -> Calibration:
    """Turn a solution in units of g into the record."""
    solution, g = found.solution, gravity.value
    laws = solution.laws
    values, matrix = in_si_powers(solution, gravity, scale)
    names, units = laws.names(), laws.units(holds.unit)
    freedom = [solution.degrees_of_freedom(row) for row in laws.to_powers()]
    parameters = {
        key: Parameter(float(value), float(u), unit, interval_95=interval_of(float(value), float(u), nu))
        for key, value, u, unit, nu in zip(names, values, np.sqrt(np.diag(matrix)), units, freedom, strict=True)
    }
    if laws.knots:
        parameters = at_reference(laws, values, matrix, "bias", "m/s^2") | parameters
    residual, uncertainty = _residuals(problem, solution)
    sensor = {
        key: text for key in ("serial", "model", "element") for r in holds.recordings if (text := r.metadata.get(key))
    }
    sources = tuple(r.source for r in holds.recordings if r.source is not None)
    return Calibration(
        procedure="thermal",
        parameters=parameters,
        covariance=Covariance(tuple(names), tuple(map(tuple, matrix.tolist()))),
        model={
            "order": 1,
            "degrees": {kind: degree for (kind, _), degree in zip(GROUPS, laws.degrees, strict=True)},
            **({"knots": list(laws.knots)} if laws.knots else {}),
            "range": [laws.low, laws.high],
            "reference_temperature": {"value": laws.middle, "unit": "degC"},
            "gravity": gravity.entry(),
            "output_unit": holds.unit,
            "gauge": _GAUGE,
        },
        fit=_fit(holds, residual, found, options, g) | entries(drift, g),
        options=dict(options),
        data=_data(holds, g * residual, g * uncertainty)
        | _alone(own_calibrations(problem, solution), holds, np.append(np.full(3, g), scale / g)),
        sensor=sensor,
        sources=sources,
        warnings=tuple(_findings(holds, problem, found, drift, gravity, options, name)),
    )


def at_reference(laws: Laws, values: Array, covariance: Array, kind: str, unit: str) -> dict[str, Parameter]:
    """Return the biases at T0 that a spline has there, by the name that those of polynomials have."""
    weights, found = laws.cardinal(np.array([laws.middle]))[0], {}
    for axis, part in zip(AXES, laws.parts[:3], strict=True):
        u = float(np.sqrt(weights @ covariance[part, part] @ weights))
        found[f"{kind}_{axis}"] = Parameter(float(weights @ values[part]), u, unit)
    return found


def _fit(holds: Holds, residual: Array, found: Found, options: Mapping[str, Any], g: float) -> dict[str, Any]:
    solution = found.solution
    return {
        "recordings": len(holds.recordings),
        "holds": len(holds),
        "temperatures": int(clusters_of(holds.temperature).max(initial=0)) + 1,
        "rms": {"value": g * float(np.sqrt(np.mean(residual**2))), "unit": "m/s^2"},
        "excess": {"value": g * solution.excess, "unit": "m/s^2"},
        "chi_square": solution.chi_square,
        "degrees_of_freedom": solution.freedom,
        "condition_number": found.view.condition,
        "between_recordings": _turn_on(solution, options, g),
        "left_out_temperature": [
            {"temperature": e.temperature, "holds": e.holds, "rms": g * e.rms, "chi_square": e.chi_square}
            for e in found.left_out
        ],
        "degrees": [
            {
                "degrees": list(step.degrees),
                "left_out": None if step.left_out is None else g * step.left_out,
                "probability": step.probability,
                "chosen": step.chosen,
                "knots": step.knots,
            }
            for step in found.steps
        ],
    }


def _data(holds: Holds, residual: Array, uncertainty: Array) -> dict[str, Any]:
    """Return each hold as the figures draw it; residual and uncertainty of |f| - g in m/s^2."""
    return {
        "holds": {
            "recording": [holds.recordings[k].name for k in holds.recording.tolist()],
            "start": holds.start.tolist(),
            "stop": holds.stop.tolist(),
            "temperature": holds.temperature.tolist(),
            "rate": holds.rate.tolist(),
            "group": [None if k < 0 else k for k in holds.group.tolist()],
            "mean": holds.mean.tolist(),
            "residual": residual.tolist(),
            "standard_uncertainty": uncertainty.tolist(),
        }
    }


def _alone(calibrations: list[Own], holds: Holds, factor: Array) -> dict[str, Any]:
    """Return what each recording gives alone; `factor` makes biases and scale factors SI, shape (6,)."""
    if not calibrations:
        return {}
    each = np.append(factor, np.ones(3))
    names = ["prior" if own.recording < 0 else holds.recordings[own.recording].name for own in calibrations]
    return {
        "calibrations": {
            "recording": names,
            "temperature": [own.temperature for own in calibrations],
            "values": [(each * own.values).tolist() for own in calibrations],
            "standard_uncertainty": [(each * own.standard_uncertainty).tolist() for own in calibrations],
        }
    }


def interval_of(value: float, uncertainty: float, freedom: float) -> tuple[float, float] | None:
    """Return the interval that holds a value with 95 % by Student's t; None where a normal distribution serves."""
    if not np.isfinite(freedom):
        return None
    reach = coverage_factor(freedom) * uncertainty
    return value - reach, value + reach


def in_si_powers(solution: Solution, gravity: Gravity, scale: Array) -> tuple[Array, Array]:
    """Return the coefficients of powers of T - T0 in SI, and their covariance.

    ``b = beta g``, ``S = scale sigma / g``; an error of gravity moves biases by dg/g and scale factors by -dg/g.
    """
    laws, g = solution.laws, gravity.value
    factor, share = _factors(laws, g, scale)
    matrix = factor[:, None] * laws.to_powers()
    values = matrix @ solution.coefficients[: laws.size]
    shared = share * values * gravity.standard_uncertainty / g
    covariance: Array = matrix @ solution.covariance[: laws.size, : laws.size] @ matrix.T + np.outer(shared, shared)
    return values, covariance


def _factors(laws: Laws, gravity: float, scale: Array) -> tuple[Array, Array]:
    """Return the factor of each coefficient from units of g to SI, and what it changes by relative to gravity's."""
    each = np.concatenate([np.full(3, gravity), scale / gravity, np.ones(3)])
    counts = np.repeat(laws.terms, 3)
    return np.repeat(each, counts), np.repeat(np.repeat([1.0, -1.0, 0.0], 3), counts)


def of_record(record: Calibration, gravity: float, uncertainty: float) -> tuple[Laws, Array, Array, Array, float]:
    """Return the laws of a record with coefficients and covariance in units of g, the outputs' scale, per g.

    Last is the variance that an error of `gravity` adds to every ``|f| / g``: none where the record rests on the same,
    whose part is taken out of the covariance then.
    """
    model = thermal_of(record).model
    laws = model.laws
    names = laws.names()
    scale = np.array([gravity * abs(record.value(f"scale_factor_{axis}")) for axis in AXES])
    factor, share = _factors(laws, gravity, scale)
    inverse = np.linalg.inv(factor[:, None] * laws.to_powers())
    values, covariance = np.array([record.value(name) for name in names]), record.cov(*names)
    stated = float(record.model["gravity"].get("standard_uncertainty") or 0.0) / model.gravity.value
    same = abs(model.gravity.value / gravity - 1) < _SAME
    if same:
        shared = share * values * stated
        covariance = covariance - np.outer(shared, shared)
    common = 0.0 if same else (uncertainty / gravity) ** 2
    return laws, inverse @ values, inverse @ covariance @ inverse.T, scale, common


def _residuals(problem: Problem, solution: Solution) -> tuple[Array, Array]:
    """Return |f| - 1 less the lengthening by noise, and its standard uncertainty, of each hold, in g."""
    rows = solution.rows
    used = rows.magnitude & (rows.owner >= 0)
    order = np.argsort(rows.owner[used])
    return rows.residual[used][order], np.sqrt(np.diag(rows.noise)[used][order])


def _turn_on(solution: Solution, options: Mapping[str, Any], g: float) -> dict[str, Any]:
    scatter = solution.scatter
    known = "turn_on_scatter" in options
    return {
        "bias": {"value": g * float(scatter.tau[0]), "unit": "m/s^2"},
        "scale_factor": {"value": float(scatter.tau[1]), "unit": "1"},
        "rank": scatter.rank,
        "resolution": {"value": g * scatter.resolution, "unit": "m/s^2"},
        "from": "argument" if known else told_by(scatter),
    }


def told_by(scatter: Scatter) -> str:
    """Return what tells the scatter between power cycles, as a record says it, where it was not stated."""
    return "polynomials" if scatter.bound else "recordings" if scatter.rank else "unknown"


def _findings(
    holds: Holds, problem: Problem, fitted: Found, drift: Drift, gravity: Gravity, options: Mapping[str, Any], name: str
) -> list[str]:
    solution = fitted.solution
    found = [*(note for r in holds.recordings for note in r.notes), *holds.notes]
    found += gravity_findings(gravity, holds.recordings[0])
    if not solution.scatter.rank and "turn_on_scatter" not in options:
        found.append(
            f"{name}: too few recordings to tell how far biases move from one power cycle to the next, so no "
            "uncertainty holds that: record more temperatures or come back to some, or state --turn-on-scatter"
        )
    if solution.scatter.bound:
        found.append(
            Note(
                f"{name}: a spline cannot tell the offset of a power cycle from the law where a temperature has one "
                f"recording; {1e3 * solution.scatter.tau[0]:.2g} mg, what polynomials of degree 3 leave, counts as the "
                "scatter between power cycles, an upper bound: come back to temperatures to learn more"
            )
        )
    if fitted.missed:
        higher, probability = fitted.missed
        found.append(
            f"{name}: degrees {solution.laws.spelled} are too low: what {','.join(map(str, higher))} add has a "
            f"probability of {probability:.1g} by chance, and no uncertainty holds what is missing: state higher "
            "ones, or leave --degrees out"
        )
    else:
        found += disagreements(holds, problem, solution, name)
    if options["degrees"] == "auto" and not solution.laws.degrees[0] and solution.scatter.tau[0] > 0:
        found.append(
            f"{name}: the recordings' biases differ by {1e3 * solution.scatter.tau[0]:.2g} mg (standard deviation); so "
            "few recordings do not tell whether by their temperature or from power cycle to power cycle: record five "
            "temperatures or more, or state --degrees"
        )
    found += untold(problem, solution, drift, name)
    if options["degrees"] == "auto":
        found.append(Note(f"degrees chosen: {spoken_degrees(solution.laws.degrees, len(solution.laws.knots))}"))
    far = [each for each in fitted.left_out if each.chi_square > _WORSE**2]
    found += [
        f"{each.temperature:.0f} degC, left out, is missed by {1e6 * each.rms:.0f} ug rms, more than its uncertainty "
        "explains: the unit's law has a bend between the temperatures; record one more there"
        for each in far
    ]
    found += findings(drift, solution, name)
    rows = solution.rows
    # What recordings have in common is expected of power cycles, and no hold's own.
    whole, own = (together(rows, solution.excess**2, tau) for tau in (solution.scatter.tau, np.zeros(2)))
    left = own @ np.linalg.solve(whole, rows.residual)
    standard = np.abs(left) / np.sqrt(np.diag(rows.noise) + solution.excess**2)
    out = np.flatnonzero((standard > _STANDS_OUT) & (rows.owner >= 0))
    for index in out[np.argsort(-standard[out], kind="stable")][:_MOST_NAMED].tolist():
        what = "its magnitude" if rows.magnitude[index] else "its direction, although nothing was to move: a knock?"
        found.append(f"{holds.label(int(rows.owner[index]))} stands out by {standard[index]:.0f} u in {what}")
    return found


def law_at(record: Calibration, names: Sequence[str], functions: Array) -> tuple[Array, Array]:
    """Return a law and its standard uncertainty, SI, shapes (n,), from what its coefficients are multiplied by."""
    values: Array = functions @ np.array([record.value(each) for each in names])
    return values, np.sqrt(np.einsum("ni,ij,nj->n", functions, record.covariance.block(names), functions))


def predicted(record: Calibration, temperature: Array) -> tuple[Array, Array]:
    """Return the nine parameters over temperature and their standard uncertainties, SI, shapes (9, n)."""
    model = thermal_of(record).model
    laws, about = model.laws, model.reference_temperature.value
    found = [
        law_at(record, laws.named(group, f"{kind}_{axis}"), laws.recorded(group, temperature, about))
        for group, (kind, axes) in enumerate(GROUPS)
        for axis in axes
    ]
    return np.array([values for values, _ in found]), np.array([spread for _, spread in found])


def deviation_of_force(record: Calibration, temperature: Array) -> Array:
    """Return the standard deviation of a component of the corrected force by the laws, m/s^2, shape (n,).

    Root of the mean over all directions of f, of magnitude g: the variance of the bias, and a third of those of scale
    factor and misalignment, whose covariances with it have no mean.
    """
    values, spread = predicted(record, temperature)
    g = thermal_of(record).model.gravity.value
    relative = np.concatenate([spread[:3] / g, spread[3:6] / np.abs(values[3:6]), spread[6:]])
    found: Array = g * np.sqrt(SHARES @ relative**2)
    return found
