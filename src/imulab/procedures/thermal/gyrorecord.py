"""The gyroscopes' part of a thermal record."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from imulab.procedures.thermal.gyro import Gyroscopes, notes_on_turns
from imulab.procedures.thermal.gyroscale import ScaleLaws, block_diagonal, joint_covariance, rescaled
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.lag import entries
from imulab.procedures.thermal.model import AXES, MISALIGNMENTS, SENSITIVITIES, Laws, law_names
from imulab.procedures.thermal.record import at_reference, interval_of, law_at, told_by
from imulab.procedures.thermal.sections import thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.units import from_si, parse_unit
from imulab.verdict import UNJUDGED, Note

_WORSE = 3.0


def with_gyroscopes(
    record: Calibration, holds: Holds, gyros: Gyroscopes, turned: ScaleLaws | None, name: str
) -> Calibration:
    """Return the record with the gyroscopes' laws, their covariance (independent of the accelerometers') and data."""
    gyros = gyros if turned is None else rescaled(gyros, turned)
    laws = gyros.solution.laws
    names, units = names_and_units(laws, sensitivity=gyros.sensitivity)
    matrix, n = _to_si(gyros, record.model["gravity"]["value"]), gyros.count
    coefficients, covariance = gyros.solution.coefficients[:n], gyros.solution.covariance[:n, :n]
    freedom = [gyros.solution.degrees_of_freedom(row) for row in matrix]
    if turned is not None:
        own, more, their_units = scale_to_si(turned, gyros.held.size, gyros.held.unit)
        names, units, freedom = names + more, units + their_units, freedom + [np.inf] * len(more)
        matrix = block_diagonal(matrix, own)
        coefficients = np.concatenate([coefficients, turned.coefficients])
        covariance = joint_covariance(gyros, turned)
    values, covariance = matrix @ coefficients, matrix @ covariance @ matrix.T
    parameters = {
        key: Parameter(float(value), float(u), unit, interval_95=interval_of(float(value), float(u), nu))
        for key, value, u, unit, nu in zip(names, values, np.sqrt(np.diag(covariance)), units, freedom, strict=True)
    }
    if laws.knots:
        parameters = at_reference(laws, values, covariance, "gyro_bias", "rad/s") | parameters
    joined = block_diagonal(record.covariance.array(), covariance)
    fit = _fit(gyros, known="gyro_turn_on_scatter" in record.options)
    return replace(
        record,
        parameters={**record.parameters, **parameters},
        covariance=Covariance((*record.covariance.names, *names), tuple(map(tuple, joined.tolist()))),
        model={
            **record.model,
            "gyro": {
                "output_unit": gyros.held.unit,
                "degrees": {"bias": laws.degrees[0], "scale_factor": 0 if turned is None else turned.degree},
                **({"knots": list(laws.knots)} if laws.knots else {}),
                "g_sensitivity": gyros.sensitivity,
                "scale": "nominal" if turned is None else "turns",
            },
        },
        fit={**record.fit, "gyro": fit if turned is None else {**fit, "turns": _turns(turned)}},
        data={**record.data, "gyro": _data(holds, gyros)},
        warnings=(*record.warnings, *_findings(record, holds, gyros, turned, name)),
        verdict=UNJUDGED,
    )


def _to_si(gyros: Gyroscopes, gravity: float) -> Array:
    """Return the matrix from the fit's coefficients to those of powers of T - T0, and of G to rad/s per m/s^2."""
    size, count = gyros.size, gyros.count
    matrix = np.eye(count) / gravity
    matrix[:size, :size] = gyros.solution.laws.to_powers()[:size, :size]
    return matrix


def scale_to_si(turned: ScaleLaws, size: Array, output: str) -> tuple[Array, list[str], list[str]]:
    """Return the matrix from coefficients of scale factors to powers of T - T0, outputs per rad/s, names and units."""
    count, width = len(turned.coefficients), turned.degree + 1
    unit = from_si(1.0, output) if parse_unit(output).quantity == "rate" else 1.0
    powers = turned.laws.to_powers()[3 : 3 + width, 3 : 3 + width]
    matrix = np.eye(count)
    names: list[str] = []
    units: list[str] = []
    for k, axis in enumerate(AXES):
        own = slice(k * width, (k + 1) * width)
        matrix[own, own] = powers * size[k] * unit
        law = law_names(f"gyro_scale_factor_{axis}", f"{output}/(rad/s)", turned.degree)
        names, units = names + law[0], units + law[1]
    return matrix, names + list(MISALIGNMENTS), units + ["rad"] * len(MISALIGNMENTS)


def _turns(turned: ScaleLaws) -> dict[str, Any]:
    return {
        "recordings": turned.recordings,
        "turns": turned.turns,
        "rms": {"value": turned.miss, "unit": "rad"},
        "chi_square": turned.chi_square,
        "degrees_of_freedom": turned.freedom,
    }


def names_and_units(laws: Laws, *, sensitivity: bool) -> tuple[list[str], list[str]]:
    """Return the names and units of the biases' coefficients and of the g-sensitivities."""
    names = [name for axis in AXES for name in laws.named(0, f"gyro_bias_{axis}")]
    units = laws.measured(0, "rad/s") * len(AXES)
    if sensitivity:
        names += SENSITIVITIES
        units += ["rad/s/(m/s^2)"] * len(SENSITIVITIES)
    return names, units


def _fit(gyros: Gyroscopes, *, known: bool) -> dict[str, Any]:
    solution = gyros.solution
    return {
        "holds": len(gyros.held),
        "rms": {"value": float(np.sqrt(np.mean(solution.rows.residual**2))), "unit": "rad/s"},
        "excess": {"value": solution.excess, "unit": "rad/s"},
        "chi_square": solution.chi_square,
        "degrees_of_freedom": solution.freedom,
        "between_recordings": {
            "bias": {"value": float(solution.scatter.tau[0]), "unit": "rad/s"},
            "rank": solution.scatter.rank,
            "resolution": {"value": solution.scatter.resolution, "unit": "rad/s"},
            "from": "argument" if known else told_by(solution.scatter),
        },
        "g_sensitivity_probability": gyros.probability,
        "latitude": None if gyros.held.earth is None else gyros.held.earth.latitude,
        **entries(gyros.drift, 1.0, "rad/s"),
        "left_out_temperature": [
            {"temperature": e.temperature, "holds": e.holds, "rms": e.rms, "chi_square": e.chi_square}
            for e in gyros.left_out
        ],
    }


def _data(holds: Holds, gyros: Gyroscopes) -> dict[str, Any]:
    held = gyros.held
    return {
        "recording": [holds.recordings[k].name for k in held.recording.tolist()],
        "temperature": held.temperature.tolist(),
        "rate": held.rate.tolist(),
        "residual": gyros.solution.rows.residual.reshape(-1, 3).tolist(),
    }


def _findings(record: Calibration, holds: Holds, gyros: Gyroscopes, turned: ScaleLaws | None, name: str) -> list[str]:
    found = [*gyros.held.notes, *([] if gyros.held.earth is None else [gyros.held.earth.note()])]
    found += notes_on_turns(holds, gyros.aside)
    scatter = gyros.solution.scatter
    if not scatter.rank and "gyro_turn_on_scatter" not in record.options:
        found.append(
            f"gyro: {name}: too few recordings to tell how far biases move from one power cycle to the next, so no "
            "uncertainty holds that: record more temperatures or come back to some, or state --gyro-turn-on-scatter"
        )
    found += [
        f"gyro: {each.temperature:.0f} degC, left out, is missed by {np.degrees(each.rms):.2g} deg/s rms, more than "
        "its uncertainty explains: the law has a bend between the temperatures; record one more there"
        for each in gyros.left_out
        if each.chi_square > _WORSE**2
    ]
    if scatter.bound:
        left = np.degrees(3600 * scatter.tau[0])
        found.append(
            Note(
                f"gyro: {name}: a spline cannot tell the offset of a power cycle from the law where a temperature has "
                f"one recording; {left:.3g} deg/h, what polynomials of degree 3 leave, counts as the scatter between "
                "power cycles, an upper bound: come back to temperatures to learn more"
            )
        )
    found += _drifts(gyros, name)
    laws = gyros.solution.laws
    bias = f"bias by a spline with {len(laws.knots)} knots" if laws.knots else f"bias of degree {laws.degrees[0]}"
    if turned is None:
        return [*found, Note(f"gyro: {bias}; no turns tell the scale factors, which are as stated")]
    said = f"gyro: {bias}, scale factor of degree {turned.degree} from {turned.turns} turns"
    return [*found, *turned.notes, Note(said)]


def _drifts(gyros: Gyroscopes, name: str) -> list[str]:
    """Return what lag and loop mean for corrected outputs, where they are significant."""
    drift, found = gyros.drift, []
    if drift.values is None or drift.covariance is None:
        return []
    hourly, u = np.degrees(3600 * drift.values[1:]), np.sqrt(np.diag(drift.covariance))
    if 0 in drift.free:
        found.append(
            f"gyro: {name}: biases differ from their laws by those of {drift.values[0]:.3g} s before (u {u[0]:.2g} s); "
            "corrected outputs keep that"
        )
    if 1 in drift.free:
        each = ", ".join(f"{axis} {h:+.3g}" for axis, h in zip(AXES, hourly, strict=True))
        found.append(
            f"gyro: {name}: biases differ between warming and cooling: in the middle of the range they are {each} "
            f"deg/h (u {np.degrees(3600 * u[1:].max()):.2g}) from their laws in warming, and as much the other way in "
            "cooling, which corrected outputs keep"
        )
    return found


def gyro_scale_predicted(record: Calibration, temperature: Array) -> tuple[Array, Array]:
    """Return the three scale factors over temperature and their standard uncertainties, SI, shapes (3, n)."""
    model = thermal_of(record).model
    laws = model.gyro_laws
    powers = laws.recorded(1, temperature, model.reference_temperature.value)
    found = [law_at(record, laws.named(1, f"gyro_scale_factor_{axis}"), powers) for axis in AXES]
    return np.array([values for values, _ in found]), np.array([spread for _, spread in found])


def gyro_predicted(record: Calibration, temperature: Array) -> tuple[Array, Array]:
    """Return the three biases over temperature and their standard uncertainties, rad/s, shapes (3, n)."""
    model = thermal_of(record).model
    laws = model.gyro_laws
    powers = laws.recorded(0, temperature, model.reference_temperature.value)
    found = [law_at(record, laws.named(0, f"gyro_bias_{axis}"), powers) for axis in AXES]
    return np.array([values for values, _ in found]), np.array([spread for _, spread in found])
