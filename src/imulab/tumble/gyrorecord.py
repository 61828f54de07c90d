"""A tumble record with the gyroscope triad added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imulab.calibration import Calibration, Covariance, Parameter
from imulab.estimate import coverage_factor
from imulab.recording import Array, Recording
from imulab.tumble.gyro import PAIRS, GyroFit, gyro_names
from imulab.units import parse_unit

_AXES = ("x", "y", "z")
_WORST_SCALE = 0.1
_STANDS_OUT = 6.0
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
            },
        },
        data={
            **record.data,
            "gyro": {"start": fit.start.tolist(), "stop": fit.stop.tolist(), "residual": fit.residuals.tolist()},
        },
        warnings=(*(w for w in record.warnings if not w.startswith("gyro")), *_warnings(fit)),
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
    if fit.sensitivity is not None and fit.sensitivity_uncertainty is not None:
        found |= {
            f"gyro_g_sensitivity_{a}{b}": Parameter(
                float(fit.sensitivity[i, j]), float(fit.sensitivity_uncertainty[i, j]), "rad/s/(m/s^2)"
            )
            for i, a in enumerate(_AXES)
            for j, b in enumerate(_AXES)
        }
    return found


def _covariance_names(fit: GyroFit) -> list[str]:
    sensitivities = [] if fit.sensitivity is None else [f"gyro_g_sensitivity_{a}{b}" for a in _AXES for b in _AXES]
    return gyro_names() + sensitivities


def _covariance(fit: GyroFit) -> Array:
    """Covariance of all gyroscope parameters; the sensitivities, from rest, are taken as independent."""
    if fit.sensitivity_uncertainty is None:
        return fit.covariance
    return _diagonal_blocks(fit.covariance, np.diag(fit.sensitivity_uncertainty.ravel() ** 2))


def _diagonal_blocks(first: Array, second: Array) -> Array:
    n, m = len(first), len(second)
    joined = np.zeros((n + m, n + m))
    joined[:n, :n], joined[n:, n:] = first, second
    return joined


def _warnings(fit: GyroFit) -> list[str]:
    found = list(fit.notes)
    if parse_unit(fit.unit).quantity == "rate":
        nominal = 1 / parse_unit(fit.unit).factor
        found += [
            f"gyro scale factor of {axis} is off by {100 * (value / nominal - 1):+.0f} %: is the unit right?"
            for axis, value in zip(_AXES, fit.scale_factor, strict=True)
            if abs(value / nominal - 1) > _WORST_SCALE
        ]
    rms = float(np.degrees(np.sqrt(np.mean(fit.residuals**2))))
    if rms > _LARGE_MISS:
        found.append(f"gyro: the turns miss the change of gravity's direction by {rms:.2g} deg rms")
    worst = int(np.argmax(fit.residuals))
    others = float(np.sqrt(np.mean(np.delete(fit.residuals, worst) ** 2)))
    if fit.residuals[worst] > _STANDS_OUT * others:
        found.append(
            f"gyro: the turn at {fit.start[worst]:.1f} to {fit.stop[worst]:.1f} s misses by "
            f"{np.degrees(fit.residuals[worst]):.3g} deg, the others by {np.degrees(others):.3g} deg rms"
        )
    return found
