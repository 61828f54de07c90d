"""The gyroscopes' part of a thermal record."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from imulab.procedures.thermal.gyro import Gyroscopes
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import AXES, law_names
from imulab.procedures.thermal.record import interval_of, law_at
from imulab.procedures.thermal.sections import thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.verdict import UNJUDGED, Note

SENSITIVITIES = tuple(f"gyro_g_sensitivity_{a}{b}" for a in AXES for b in AXES)
_WORSE = 3.0


def with_gyroscopes(record: Calibration, holds: Holds, gyros: Gyroscopes, gravity: float, name: str) -> Calibration:
    """Return the record with the gyroscopes' laws, their covariance (independent of the accelerometers') and data."""
    solution, laws = gyros.solution, gyros.solution.laws
    matrix = _to_si(gyros, gravity)
    values, covariance = matrix @ solution.coefficients, matrix @ solution.covariance @ matrix.T
    names, units = names_and_units(laws.degrees[0], sensitivity=gyros.sensitivity)
    freedom = [solution.degrees_of_freedom(row) for row in matrix]
    parameters = {
        key: Parameter(float(value), float(u), unit, interval_95=interval_of(float(value), float(u), nu))
        for key, value, u, unit, nu in zip(names, values, np.sqrt(np.diag(covariance)), units, freedom, strict=True)
    }
    n = len(record.covariance.names)
    joined = np.zeros((n + len(names), n + len(names)))
    joined[:n, :n], joined[n:, n:] = record.covariance.array(), covariance
    return replace(
        record,
        parameters={**record.parameters, **parameters},
        covariance=Covariance((*record.covariance.names, *names), tuple(map(tuple, joined.tolist()))),
        model={
            **record.model,
            "gyro": {
                "output_unit": gyros.held.unit,
                "degrees": {"bias": laws.degrees[0], "scale_factor": 0},
                "g_sensitivity": gyros.sensitivity,
                "scale": "nominal",
            },
        },
        fit={**record.fit, "gyro": _fit(gyros, known="gyro_turn_on_scatter" in record.options)},
        data={**record.data, "gyro": _data(holds, gyros)},
        warnings=(*record.warnings, *_findings(record, holds, gyros, name)),
        verdict=UNJUDGED,
    )


def _to_si(gyros: Gyroscopes, gravity: float) -> Array:
    """Return the matrix from the fit's coefficients to those of powers of T - T0, and of G to rad/s per m/s^2."""
    size, count = gyros.size, len(gyros.solution.coefficients)
    matrix = np.eye(count) / gravity
    matrix[:size, :size] = gyros.solution.laws.to_powers()[:size, :size]
    return matrix


def names_and_units(degree: int, *, sensitivity: bool) -> tuple[list[str], list[str]]:
    """Return the names and units of the biases' coefficients and of the g-sensitivities."""
    laws = [law_names(f"gyro_bias_{axis}", "rad/s", degree) for axis in AXES]
    names, units = ([each for law in laws for each in law[k]] for k in range(2))
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
            "from": "argument" if known else "recordings" if solution.scatter.rank else "unknown",
        },
        "g_sensitivity_probability": gyros.probability,
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


def _findings(record: Calibration, holds: Holds, gyros: Gyroscopes, name: str) -> list[str]:
    found = list(gyros.held.notes)
    found += [
        f"gyro: {holds.label(index)} left out: its outputs differ from the others of its recording: the unit turned"
        for index in gyros.aside.tolist()
    ]
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
    return [*found, Note(f"gyro: bias of degree {gyros.solution.laws.degrees[0]}; scale factors as stated by the unit")]


def gyro_predicted(record: Calibration, temperature: Array) -> tuple[Array, Array]:
    """Return the three biases over temperature and their standard uncertainties, rad/s, shapes (3, n)."""
    model = thermal_of(record).model
    assert model.gyro is not None
    low, high = model.range
    offset = np.clip(temperature, low, high) - model.reference_temperature.value
    found = [law_at(record, f"gyro_bias_{axis}", model.gyro.degrees.bias, offset) for axis in AXES]
    return np.array([values for values, _ in found]), np.array([spread for _, spread in found])
