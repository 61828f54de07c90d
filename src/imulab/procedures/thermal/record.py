"""The calibration record of a thermal test: coefficients in SI, and what its figures need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from imulab.estimation.least_squares import Observability, coverage_factor
from imulab.gravity import Gravity, gravity_findings
from imulab.procedures.thermal.degrees import LeftOut, Step, clusters_of, spoken_degrees
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.lag import Drift, entries, findings
from imulab.procedures.thermal.model import AXES, GROUPS, Laws, law_names
from imulab.procedures.thermal.rows import Problem, together
from imulab.procedures.thermal.sections import thermal_of
from imulab.procedures.thermal.solve import Solution
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.verdict import Note

_STANDS_OUT = 5.0
_MOST_NAMED = 6
_WORSE = 3.0
_MOVES = (0.01, 0.005)
"""What biases (g) and scale factors hardly move by from one power cycle to the next."""
_SAME = 1e-9
"""Of two values of gravity that are one."""
_GAUGE = "x input axis along body x, y input axis in the body xy plane, at every temperature"


def make_record(
    holds: Holds,
    problem: Problem,
    solution: Solution,
    drift: Drift,
    steps: Sequence[Step],
    left_out: Sequence[LeftOut],
    view: Observability,
    gravity: Gravity,
    scale: Array,
    options: Mapping[str, Any],
    name: str,
) -> Calibration:
    """Turn a solution in units of g into the record."""
    laws, g = solution.laws, gravity.value
    values, matrix = in_si_powers(solution, gravity, scale)
    names, units = laws.names(), laws.units(holds.unit)
    freedom = [solution.degrees_of_freedom(row) for row in laws.to_powers()]
    parameters = {
        key: Parameter(float(value), float(u), unit, interval_95=interval_of(float(value), float(u), nu))
        for key, value, u, unit, nu in zip(names, values, np.sqrt(np.diag(matrix)), units, freedom, strict=True)
    }
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
            "range": [laws.low, laws.high],
            "reference_temperature": {"value": laws.middle, "unit": "degC"},
            "gravity": gravity.entry(),
            "output_unit": holds.unit,
            "gauge": _GAUGE,
        },
        fit=_fit(holds, residual, solution, steps, left_out, view, options, g) | entries(drift, g),
        options=dict(options),
        data=_data(holds, g * residual, g * uncertainty),
        sensor=sensor,
        sources=sources,
        warnings=tuple(_findings(holds, solution, drift, left_out, gravity, options, name)),
    )


def _fit(
    holds: Holds,
    residual: Array,
    solution: Solution,
    steps: Sequence[Step],
    left_out: Sequence[LeftOut],
    view: Observability,
    options: Mapping[str, Any],
    g: float,
) -> dict[str, Any]:
    return {
        "recordings": len(holds.recordings),
        "holds": len(holds),
        "temperatures": int(clusters_of(holds.temperature).max(initial=0)) + 1,
        "rms": {"value": g * float(np.sqrt(np.mean(residual**2))), "unit": "m/s^2"},
        "excess": {"value": g * solution.excess, "unit": "m/s^2"},
        "chi_square": solution.chi_square,
        "degrees_of_freedom": solution.freedom,
        "condition_number": view.condition,
        "between_recordings": _turn_on(solution, options, g),
        "left_out_temperature": [
            {"temperature": e.temperature, "holds": e.holds, "rms": g * e.rms, "chi_square": e.chi_square}
            for e in left_out
        ],
        "degrees": [
            {
                "degrees": list(step.degrees),
                "left_out": None if step.left_out is None else g * step.left_out,
                "probability": step.probability,
                "chosen": step.chosen,
            }
            for step in steps
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
    factor, share = [], []
    for group, degree in enumerate(laws.degrees):
        for axis in range(3):
            factor += [(g, float(scale[axis]) / g, 1.0)[group]] * (degree + 1)
            share += [(1.0, -1.0, 0.0)[group]] * (degree + 1)
    matrix = np.array(factor)[:, None] * laws.to_powers()
    values = matrix @ solution.coefficients[: laws.size]
    shared = np.array(share) * values * gravity.standard_uncertainty / g
    covariance: Array = matrix @ solution.covariance[: laws.size, : laws.size] @ matrix.T + np.outer(shared, shared)
    return values, covariance


def _unlike(solution: Solution, name: str) -> list[str]:
    """Return what says that recordings are hardly of one unit, mounted alike: a scatter that no power cycle makes."""
    bias, scale = solution.scatter.tau.tolist()
    found = [
        text
        for size, text in (
            (bias / _MOVES[0], f"biases by {1e3 * bias:.3g} mg"),
            (scale / _MOVES[1], f"scale factors by {100 * scale:.2g} %"),
        )
        if size > 1
    ]
    return [
        f"{name}: from one recording to the next {' and '.join(found)} differ, which no power cycle does: are all of "
        "one unit, its axes named alike, its temperatures by one thermometer?"
    ] * bool(found)


def of_record(record: Calibration, gravity: float, uncertainty: float) -> tuple[Laws, Array, Array, Array, float]:
    """Return the laws of a record with coefficients and covariance in units of g, the outputs' scale, per g.

    Last is the variance that an error of `gravity` adds to every ``|f| / g``: none where the record rests on the same,
    whose part is taken out of the covariance then.
    """
    model = thermal_of(record).model
    laws = Laws(model.range[0], model.range[1], model.degrees.each)
    names, factor, share = laws.names(), list[float](), list[float]()
    scale = [gravity * abs(record.value(f"scale_factor_{axis}")) for axis in AXES]
    for group, degree in enumerate(laws.degrees):
        for axis in range(3):
            factor += [(gravity, scale[axis] / gravity, 1.0)[group]] * (degree + 1)
            share += [(1.0, -1.0, 0.0)[group]] * (degree + 1)
    inverse = np.linalg.inv(np.array(factor)[:, None] * laws.to_powers())
    values, covariance = np.array([record.value(name) for name in names]), record.cov(*names)
    stated = float(record.model["gravity"].get("standard_uncertainty") or 0.0) / model.gravity.value
    same = abs(model.gravity.value / gravity - 1) < _SAME
    if same:
        shared = np.array(share) * values * stated
        covariance = covariance - np.outer(shared, shared)
    common = 0.0 if same else (uncertainty / gravity) ** 2
    return laws, inverse @ values, inverse @ covariance @ inverse.T, np.array(scale), common


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
        "resolution": {"value": g * float(np.sqrt(max(scatter.spread[0] - scatter.tau[0] ** 2, 0.0))), "unit": "m/s^2"},
        "from": "argument" if known else "recordings" if scatter.rank else "unknown",
    }


def _findings(
    holds: Holds,
    solution: Solution,
    drift: Drift,
    left_out: Sequence[LeftOut],
    gravity: Gravity,
    options: Mapping[str, Any],
    name: str,
) -> list[str]:
    found = [*(note for r in holds.recordings for note in r.notes), *holds.notes]
    found += gravity_findings(gravity, holds.recordings[0])
    if not solution.scatter.rank and "turn_on_scatter" not in options:
        found.append(
            f"{name}: too few recordings to tell how far biases move from one power cycle to the next, so no "
            "uncertainty holds that: record more temperatures or come back to some, or state --turn-on-scatter"
        )
    found += _unlike(solution, name)
    if options["degrees"] == "auto" and not solution.laws.degrees[0] and solution.scatter.tau[0] > 0:
        found.append(
            f"{name}: the recordings' biases differ by {1e3 * solution.scatter.tau[0]:.2g} mg (standard deviation); so "
            "few recordings do not tell whether by their temperature or from power cycle to power cycle: record five "
            "temperatures or more, or state --degrees"
        )
    if options["degrees"] == "auto":
        found.append(Note(f"degrees chosen: {spoken_degrees(solution.laws.degrees)}"))
    far = [each for each in left_out if each.chi_square > _WORSE**2]
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


def law_at(record: Calibration, name: str, degree: int, offset: Array) -> tuple[Array, Array]:
    """Return a law and its standard uncertainty, SI, at offsets from T0, K, shapes (n,)."""
    names, _ = law_names(name, "", degree)
    powers = offset[:, None] ** np.arange(degree + 1)
    values: Array = powers @ np.array([record.value(each) for each in names])
    return values, np.sqrt(np.einsum("ni,ij,nj->n", powers, record.covariance.block(names), powers))


def predicted(record: Calibration, temperature: Array) -> tuple[Array, Array]:
    """Return the nine parameters over temperature and their standard uncertainties, SI, shapes (9, n)."""
    low, high = record.model["range"]
    offset = np.clip(temperature, low, high) - float(record.model["reference_temperature"]["value"])
    found = [
        law_at(record, f"{kind}_{axis}", degree, offset)
        for (kind, axes), degree in zip(GROUPS, thermal_of(record).model.degrees.each, strict=True)
        for axis in axes
    ]
    return np.array([values for values, _ in found]), np.array([spread for _, spread in found])
