"""Whether biases lag behind the thermometer, or differ between warming and cooling.

The *lag* L is one for the unit, ``p(T - L dT/dt)``; the *loop* h one for each axis, ``h sign(dT/dt) (1 - theta^2)``.
All four are fitted beside the laws, and each of the two is tested, given the other, by F at 1 %; what is significant
stays in the fit. Soaks have loops by the side that they were reached from, where heads say it. Corrected outputs use
L = 0 and h = 0: a unit would have to differentiate its temperature.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.thermal.choices import APART
from imulab.procedures.thermal.degrees import tail
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import AXES
from imulab.procedures.thermal.rows import Problem, whitener
from imulab.procedures.thermal.solve import Solution, solve
from imulab.recording import Array
from imulab.verdict import Note

_SIGNIFICANT = 0.01
_STILL = 0.05
"""Share of the fastest change in a recording below which its sign is that of the thermometer's noise."""
_SHARED = 0.5
"""Share of the range in which the unit must both warm and cool: elsewhere a bend of the law looks like a lag."""
_TELLS = 0.05
"""Share of the columns of lag and loops that must be left beside the laws and each other."""
_NAMES = ("lag", *(f"loop_{axis}" for axis in AXES))
ALL = (0, 1, 2, 3)
"""Lag and loops of x, y and z, as `Problem.free`."""


@dataclass(frozen=True)
class Drift:
    """Lag (s) and loops (g): values, shape (4,), covariance, probability of each of the two if there were none.

    Where they cannot be told, `values` is None and `reason` says why, or is empty where the temperature never drifts.
    """

    values: Array | None = None
    covariance: Array | None = None
    probability: tuple[float, float] = (1.0, 1.0)
    reason: str = ""

    @property
    def free(self) -> tuple[int, ...]:
        """What is significant, as `Problem.free`."""
        lag, loop = (probability < _SIGNIFICANT for probability in self.probability)
        return (0,) * lag + (1, 2, 3) * loop


def moving(holds: Holds) -> Array:
    """Return the change of the temperature in each hold, K/s; 0 in soaks, and where it hardly moves."""
    return moved(holds.recording, holds.temperature, holds.rate)


def moved(recording: NDArray[Any], temperature: Array, rate: Array) -> Array:
    """Return `moving` of holds by the recording, temperature, degC, and its change, K/s, of each."""
    rate = rate.copy()
    for each in np.unique(recording):
        own = recording == each
        soak = np.ptp(temperature[own]) < APART
        rate[own & (np.abs(rate) < (np.inf if soak else _STILL * np.abs(rate[own]).max()))] = 0.0
    return rate


def drift_of(problem: Problem, solution: Solution, tau: float | None) -> Drift:
    """Fit lag and loops beside the laws of a solution, and test each given the other."""
    reason = untold(problem.temperature, problem.rate, solution, solution.laws.size, len(problem.free))
    if reason == "" and problem.side is not None and len(np.unique(problem.side[problem.side != 0])) == 2:
        return _of_soaks(problem, solution, tau)
    if reason is not None:
        return Drift(reason=reason)
    whole = solve(replace(problem, free=ALL), solution.laws, tau=tau)
    if not whole.converged:
        return Drift(reason="the fit of lag and loop beside the laws did not converge")
    return tested(whole, solution.laws.size)


def tested(whole: Solution, size: int) -> Drift:
    """Return lag and loops of a solution whose coefficients after the first `size` they are, each tested."""
    values, covariance = whole.coefficients[size:], whole.covariance[size:, size:]
    probability = []
    for part in (slice(0, 1), slice(1, 4)):
        own = values[part]
        square = float(own @ np.linalg.solve(covariance[part, part], own)) / len(own)
        freedom = min(whole.degrees_of_freedom(row) for row in np.eye(size + 4)[size:][part])
        probability.append(tail(square, len(own), freedom))
    return Drift(values, covariance, (probability[0], probability[1]))


def _of_soaks(problem: Problem, solution: Solution, tau: float | None) -> Drift:
    """Fit loops beside the laws of soaks that were reached from either side; they say nothing of a lag."""
    size, loops = solution.laws.size, ALL[1:]
    if not _told(solution, size, len(problem.free), loops):
        return Drift(reason="the soaks reached by warming and by cooling do not tell loops and laws apart")
    whole = solve(replace(problem, free=loops), solution.laws, tau=tau)
    if not whole.converged:
        return Drift(reason="the fit of loops beside the laws did not converge")
    own, covariance = whole.coefficients[size:], np.full((4, 4), np.nan)
    covariance[1:, 1:] = whole.covariance[size:, size:]
    square = float(own @ np.linalg.solve(covariance[1:, 1:], own)) / len(own)
    freedom = min(whole.degrees_of_freedom(row) for row in np.eye(size + 3)[size:])
    return Drift(np.append(np.nan, own), covariance, (1.0, tail(square, len(own), freedom)))


def untold(temperature: Array, rate: Array, solution: Solution, size: int, free: int) -> str | None:
    """Return why lag and loop are not told: empty where the temperature never drifts, None where they are.

    The solution's columns for what is `free` of them come after the first `size`.
    """
    reason = _reason(temperature, rate)
    if reason is None and not _told(solution, size, free, ALL):
        return "the holds in which the temperature drifts do not tell lag, loop and laws apart"
    return reason


def _reason(temperature: Array, rate: Array) -> str | None:
    """Return why the temperatures cannot tell lag from law: empty where they never drift, None where they can."""
    up, down = (temperature[sign * rate > 0] for sign in (1, -1))
    if not up.size and not down.size:
        return ""
    if not up.size or not down.size:
        return (
            f"the recordings only {'warm' if up.size else 'cool'}, which cannot tell a lag behind the thermometer from "
            "the laws: record the way back too"
        )
    both = min(up.max(), down.max()) - max(up.min(), down.min())
    if both < _SHARED * np.ptp(temperature):
        return (
            f"the unit both warms and cools in {max(both, 0.0):.0f} K of {np.ptp(temperature):.0f} K, too "
            "little to tell a lag behind the thermometer from the laws: record the way back too"
        )
    return None


def _told(solution: Solution, size: int, free: int, wanted: tuple[int, ...]) -> bool:
    rows = solution.rows
    white = whitener(rows, solution.excess**2, solution.scatter.tau)
    rest = white(np.delete(rows.jacobian, np.s_[size : size + free], axis=1))
    columns = white(rows.drift[:, list(wanted)])
    length = np.linalg.norm(columns, axis=0)
    if not length.min() > 0:
        return False
    u, values, _ = np.linalg.svd(rest / np.maximum(np.linalg.norm(rest, axis=0), 1e-300), full_matrices=False)
    u = u[:, values > 1e-7 * values[0]]
    columns = columns / length
    return bool(np.linalg.svd(columns - u @ (u.T @ columns), compute_uv=False)[-1] > _TELLS)


def findings(drift: Drift, solution: Solution, name: str) -> list[str]:
    """Return in words what was found, and what it means for corrected outputs."""
    if drift.values is None:
        return [Note(f"{name}: {drift.reason}")] if drift.reason else []
    assert drift.covariance is not None
    found, u = [], np.sqrt(np.diag(drift.covariance))
    if 0 in drift.free:
        laws = solution.laws
        slope = laws.slope(np.linspace(laws.low, laws.high, 81)) @ solution.coefficients[: laws.size]
        lag = float(drift.values[0])
        who = "biases lag the temperature" if lag > 0 else "the temperature lags the biases"
        found.append(
            f"{name}: {who} by {abs(lag):.3g} s (u {u[0]:.2g} s); corrected outputs use none, and are off by up to "
            f"{1e3 * np.abs(slope[:, :3]).max() * abs(lag) / 60:.2g} mg where it changes by 1 K/min"
        )
    if 1 in drift.free:
        each = ", ".join(f"{axis} {1e3 * h:+.2f}" for axis, h in zip(AXES, drift.values[1:], strict=True))
        found.append(
            f"{name}: biases differ between warming and cooling: in the middle of the range they are {each} mg "
            f"(u {1e3 * u[1:].max():.2g} mg) from their laws in warming, and as much the other way in cooling, which "
            "corrected outputs keep"
        )
    return found


def entries(drift: Drift, scale: float, unit: str = "m/s^2") -> dict[str, Any]:
    """Return ``lag``, ``loop_x`` ... of the record's fit, loops times `scale` in a unit; None where not told."""
    if drift.values is None:
        return dict.fromkeys(_NAMES)
    assert drift.covariance is not None
    size, u = np.array([1.0, scale, scale, scale]), np.sqrt(np.diag(drift.covariance))
    return {
        name: {
            "value": float(drift.values[k] * size[k]),
            "standard_uncertainty": float(u[k] * size[k]),
            "unit": unit if k else "s",
            "probability": drift.probability[min(k, 1)],
            "fitted": k in drift.free,
        }
        if np.isfinite(u[k])
        else None
        for k, name in enumerate(_NAMES)
    }
