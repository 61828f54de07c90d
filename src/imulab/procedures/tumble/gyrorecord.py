"""A tumble record with the gyroscope triad added."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from imulab.estimation.least_squares import coverage_factor
from imulab.procedures.tumble.gyro import PAIRS, GyroFit, gyro_names
from imulab.procedures.tumble.gyroclock import CRYSTAL, Clock
from imulab.procedures.tumble.gyrolinear import Nonlinearity
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.units import parse_unit
from imulab.verdict import UNJUDGED, Bad, Note

_AXES = ("x", "y", "z")
_WORST_SCALE = 0.1
_USUAL = (
    (np.degrees(1), "are the rates in deg/s?"),
    (np.radians(1), "are the rates in rad/s?"),
    (2.0, "is the sample rate twice what the time stamps say?"),
    (0.5, "is the sample rate half what the time stamps say?"),
)
"""Factors by which scale factors are off, and what makes them so."""
_ALIKE = 5.7  # Student's t of three at 1 %, over root 3
_CLEAR = 4.0
_SMALLEST_ALIKE = 0.05  # %
_LARGE_MISS = 2.0  # deg


def with_gyro(record: Calibration, fit: GyroFit, recording: Recording, accelerometers: Recording) -> Calibration:
    """Return the record with parameters, covariance and residuals of the gyroscope triad; an earlier one is replaced.

    Both triads are in the frame that the accelerometers define.
    """
    kept = {name: p for name, p in record.parameters.items() if not name.startswith("gyro_")}
    names = [name for name in record.covariance.names if not name.startswith("gyro_")]
    index = [record.covariance.names.index(name) for name in names]
    block = record.covariance.array()[np.ix_(index, index)]
    sources = {source.file: source for source in record.sources}
    sources |= {r.source.file: r.source for r in (accelerometers, recording) if r.source is not None}
    turns = len(fit.residuals)
    freedom = 2 * turns - (12 if fit.fit_bias else 9)
    # The gyroscopes' covariance holds what the accelerometers' adds; the covariance between the two is not kept.
    joined = _diagonal_blocks(block, _covariance(fit))
    return replace(
        record,
        parameters=kept | _parameters(fit),
        covariance=Covariance((*names, *_covariance_names(fit)), tuple(map(tuple, joined.tolist()))),
        model={**record.model, "gyro_output_unit": fit.unit},
        sources=tuple(sources.values()),
        fit={
            **record.fit,
            "gyro": {
                "turns": turns,
                "cost": {"value": fit.cost, "unit": "rad^2"},
                "rms": {"value": float(np.sqrt(fit.cost / turns)), "unit": "rad"},
                "degrees_of_freedom": freedom,
                "coverage_factor_95": coverage_factor(float(freedom)) if freedom > 0 else None,
                "condition_number": fit.observability.condition,
                "bias": "fitted to the turns" if fit.fit_bias else "from the outputs at rest",
                "g_sensitivity": "none" if fit.sensitivity is None else "from the outputs at rest",
                "latitude": None if fit.earth is None else fit.earth.latitude,
                "clock": _clock(fit.clock),
                "nonlinearity": _nonlinearity(fit.nonlinearity),
                "set_aside": [
                    {"start": start, "stop": stop, "miss": {"value": miss, "unit": "rad"}}
                    for start, stop, miss in fit.aside.tolist()
                ],
            },
        },
        data={
            **record.data,
            "gyro": {"start": fit.start.tolist(), "stop": fit.stop.tolist(), "residual": fit.residuals.tolist()},
        },
        warnings=(*(w for w in record.warnings if not w.startswith("gyro")), *_warnings(fit)),
        verdict=UNJUDGED,
    )


def with_gyro_of(record: Calibration, known: Calibration) -> Calibration:
    """Return the record with the gyroscope triad of another record of the same unit, if that has one."""
    if "gyro_output_unit" not in known.model:
        return record
    names = [name for name in known.covariance.names if name.startswith("gyro_")]
    joined = _diagonal_blocks(record.covariance.array(), known.covariance.block(names))
    sources = {source.file: source for source in (*known.sources, *record.sources)}
    return replace(
        record,
        parameters={
            **record.parameters,
            **{name: p for name, p in known.parameters.items() if name.startswith("gyro_")},
        },
        covariance=Covariance((*record.covariance.names, *names), tuple(map(tuple, joined.tolist()))),
        model={**record.model, "gyro_output_unit": known.model["gyro_output_unit"]},
        sources=tuple(sources.values()),
        fit={**record.fit, **{key: part for key, part in known.fit.items() if key == "gyro"}},
        data={**record.data, **{key: part for key, part in known.data.items() if key == "gyro"}},
        warnings=(*record.warnings, *(w for w in known.warnings if w.startswith("gyro"))),
        verdict=UNJUDGED,
    )


def _parameters(fit: GyroFit) -> dict[str, Parameter]:
    sigma = np.sqrt(np.diag(fit.covariance))
    found = {f"gyro_bias_{a}": Parameter(float(fit.bias[i]), float(sigma[9 + i]), "rad/s") for i, a in enumerate(_AXES)}
    found |= {
        f"gyro_scale_factor_{a}": Parameter(float(fit.scale_factor[i]), float(sigma[i]), f"{fit.unit}/(rad/s)")
        for i, a in enumerate(_AXES)
    }
    found |= {
        f"gyro_misalignment_{p}": Parameter(
            float(fit.misalignment[_AXES.index(p[0]), _AXES.index(p[1])]), float(sigma[3 + k]), "rad"
        )
        for k, p in enumerate(PAIRS)
    }
    if fit.sensitivity is not None and fit.sensitivity_covariance is not None:
        own = np.sqrt(np.diag(fit.sensitivity_covariance)).reshape(3, 3)
        found |= {
            f"gyro_g_sensitivity_{a}{b}": Parameter(float(fit.sensitivity[i, j]), float(own[i, j]), "rad/s/(m/s^2)")
            for i, a in enumerate(_AXES)
            for j, b in enumerate(_AXES)
        }
    return found


def _covariance_names(fit: GyroFit) -> list[str]:
    sensitivities = [] if fit.sensitivity is None else [f"gyro_g_sensitivity_{a}{b}" for a in _AXES for b in _AXES]
    return gyro_names() + sensitivities


def _covariance(fit: GyroFit) -> Array:
    """Covariance of all gyroscope parameters; the sensitivities, from rest, are taken as independent of the others."""
    if fit.sensitivity_covariance is None:
        return fit.covariance
    return _diagonal_blocks(fit.covariance, fit.sensitivity_covariance)


def _diagonal_blocks(first: Array, second: Array) -> Array:
    n, m = len(first), len(second)
    joined = np.zeros((n + m, n + m))
    joined[:n, :n], joined[n:, n:] = first, second
    return joined


def _clock(clock: Clock) -> dict[str, Any]:
    """What the record says of the clock: relative uncertainty, whose it is, and how the two differ."""
    found: dict[str, Any] = {"of": clock.of, "standard_uncertainty": clock.uncertainty}
    other = clock.comparison
    if other is not None:
        found["accel_clock_rate"] = {"value": other.rate, "standard_uncertainty": other.rate_uncertainty, "unit": "1"}
        found["latency"] = {"value": -other.delay, "standard_uncertainty": other.delay_uncertainty, "unit": "s"}
    return found


def _nonlinearity(found: Nonlinearity | None) -> dict[str, Any] | None:
    """What the record says of scale factors that change with the rate: test, sizes, and the rates seen."""
    if found is None:
        return None
    return {
        "probability": found.probability,
        "odd": _with_uncertainty(found.odd, found.odd_uncertainty),
        "even": _with_uncertainty(found.even, found.even_uncertainty),
        "largest_rate": {"value": found.largest.tolist(), "unit": "rad/s"},
    }


def _with_uncertainty(value: Array, uncertainty: Array) -> dict[str, Any]:
    return {"value": value.tolist(), "standard_uncertainty": uncertainty.tolist(), "unit": "1"}


def _off_nominal(fit: GyroFit) -> list[str]:
    """Say if the scale factors are far from the stated unit, or all three by the same."""
    known = parse_unit(fit.unit)
    if known.quantity != "rate":
        return []
    ratio = fit.scale_factor * known.factor
    error = 100 * (ratio - 1)
    listed = " ".join(f"{value:+.3g}" for value in error.tolist())
    if np.abs(error).max() > 100 * _WORST_SCALE:
        middle = float(np.exp(np.mean(np.log(np.abs(ratio)))))
        guess = next((f": {says}" for of, says in _USUAL if abs(middle / of - 1) < _WORST_SCALE), "")
        return [
            Bad(
                f"gyro: the scale factors are off by {listed} % (x y z){guess or ': is the unit right?'}; check the "
                f"unit ({fit.unit}) and the sample rate of the recording"
            )
        ]
    mean, spread = float(error.mean()), float(error.std(ddof=1))
    own = 100 * float(np.sqrt(np.diag(fit.covariance)[:3]).max() / fit.scale_factor.mean())
    if abs(mean) > max(_ALIKE * spread, _CLEAR * own, _SMALLEST_ALIKE):
        return [
            f"gyro: the scale factors are off by {listed} % (x y z), all by the same: a sample rate or a clock that is "
            "off by as much does that; compare the time stamps with a clock"
        ]
    return []


def _warnings(fit: GyroFit) -> list[str]:
    found = [*fit.notes, *([] if fit.earth is None else [fit.earth.note()])]
    found += _off_nominal(fit)
    if fit.clock.counted and fit.clock.of == "gyro" and fit.clock.assumed == CRYSTAL:
        found.append(
            Note(
                "gyro: the time stamps are counted in even steps: the scale factors are true to the "
                f"{1e6 * CRYSTAL:.0f} ppm of a crystal only if a crystal sets the sample rate; a sensor's own "
                "oscillator is off by up to some percent: state it, such as --clock 10000ppm for 1 %"
            )
        )
    rms = float(np.degrees(np.sqrt(np.mean(fit.residuals**2))))
    if rms > _LARGE_MISS:
        found.append(f"gyro: the turns miss the change of gravity's direction by {rms:.2g} deg rms")
    return found
