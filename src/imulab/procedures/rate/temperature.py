"""How scale factors follow the temperature, where a column of it spans enough and does not merely follow time.

``M = S (1 + c (t - mean t)) s + ...``: a column ``w (t - mean t)`` beside those of the fit, weighted least squares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imulab.procedures.rate.choices import AXES
from imulab.procedures.rate.dwells import Dwells
from imulab.procedures.rate.solve import Problem, Solution, design, without_lean
from imulab.recording import Array, Recording
from imulab.records.calibration import Parameter
from imulab.units import parse_unit

_SPAN = 5.0  # K
_FOLLOWS = 0.9
"""Share of the temperature's variance that a line over time explains, beyond which the two cannot be told apart."""


def temperature_slopes(
    recordings: Sequence[Recording], dwells: Sequence[Dwells], problem: Problem, solution: Solution
) -> dict[str, Parameter]:
    """Return ``gyro_scale_factor_slope_i``, 1/K, of each gyroscope whose runs tell it from a drift over time."""
    temperature = _temperatures(recordings, dwells)
    if temperature is None:
        return {}
    means = without_lean(problem, [found[: len(problem.faces)] for found in solution.coefficients])
    time = np.arange(len(temperature), dtype=np.float64)  # of dwells in order: runs have clocks of their own
    found = {}
    for i, axis in enumerate(problem.gyros):
        own = problem.axis == axis
        if not own.any() or np.ptp(temperature[own]) < _SPAN or _explained(temperature[own], time[own]) > _FOLLOWS:
            continue
        warmer = temperature[own] - temperature[own].mean()
        columns = design(problem, i, solution.orders[i])[own]
        columns = columns[:, np.abs(columns).max(axis=0) > 0]
        columns = np.column_stack([problem.rate[own] * warmer, warmer, columns])
        weight = 1 / np.sqrt(problem.variance[own, i] + (1e-10 * np.abs(means).max()) ** 2)
        size = np.abs(columns).max(axis=0)
        scaled = columns / size * weight[:, None]
        inverse = np.linalg.pinv(scaled)
        left = means[own, i] * weight
        slope = inverse @ left
        freedom = len(left) - np.linalg.matrix_rank(scaled)
        if freedom < 1:
            continue
        beyond = max(float(np.sum((left - scaled @ slope) ** 2)) / freedom, 1.0)
        scale = float(solution.coefficients[i][problem.faces.index(axis)])
        u = float(np.sqrt((inverse @ inverse.T)[0, 0] * beyond)) / size[0] / abs(scale)
        found[f"gyro_scale_factor_slope_{AXES[axis]}"] = Parameter(float(slope[0] / size[0]) / scale, u, "1/K")
    return found


def _temperatures(recordings: Sequence[Recording], dwells: Sequence[Dwells]) -> Array | None:
    """Return the mean temperature of each dwell, degC; None where a recording has no column of it."""
    found = []
    for recording, of in zip(recordings, dwells, strict=True):
        if "temperature" not in recording or parse_unit(recording.units["temperature"]).quantity != "temperature":
            return None
        time, values = recording.si("time"), recording.si("temperature")
        first, last = np.searchsorted(time, of.start), np.searchsorted(time, of.stop, side="right")
        found += [float(values[a:b].mean()) for a, b in zip(first, last, strict=True)]
    return np.array(found) if np.isfinite(found).all() else None


def _explained(values: Array, time: Array) -> float:
    return float(np.corrcoef(values, time)[0, 1] ** 2)
