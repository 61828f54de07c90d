"""How good a model is: what it leaves of cycles and temperatures that it has not seen, and where it jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError
from imulab.procedures.warmup.curves import Curves
from imulab.procedures.warmup.model import WarmupTable, edge_jumps, exit_jump
from imulab.procedures.warmup.solve import CurveSolution, coefficients_of, find_scales, fitted_noise, solve, statistics
from imulab.recording import Array

CANDIDATES = (("interval-cubic", 0), ("knot-cubic", 0), ("knot-log-cubic", 1), ("exponential", 2), ("exponential", 3))
"""Models that are compared, and how many time scales each has."""
_SMOOTH_SCALE = 20.0  # s


@dataclass(frozen=True)
class Judged:
    """A fitted model and its errors; root mean squares over t < T_M with white noise taken off, per axis.

    Attributes
    ----------
    model, count
        Name and number of time scales (0 for ``none`` and the cubics in time).
    solution
        The fit to everything; None for ``none``.
    training
        What is left of the cycles' curves, shape (axes,).
    left_cycle
        Of cycles left out of the fit (of units, where units are pooled), or None where that is impossible.
    left_temperature
        Of the temperatures between the outer ones, each left out of the fit, or None.
    by_temperature, left_by_temperature
        The first and the third at each calibration temperature, shape (k, axes); NaN where there is none.
    edge_jump, exit_jump
        Largest jump at an edge, largest |Z(T_M)|, shape (axes,).
    scales_covariance
        Jackknife over the temperatures, shape (count, count); None where there are too few.
    """

    model: str
    count: int
    solution: CurveSolution | None
    training: Array
    left_cycle: Array | None
    left_temperature: Array | None
    by_temperature: Array
    left_by_temperature: Array
    edge_jump: Array
    exit_jump: Array
    scales_covariance: Array | None

    @property
    def label(self) -> str:
        """Name in tables: the exponentials say how many."""
        return f"{self.model} ({self.count})" if self.model == "exponential" else self.model

    @property
    def table(self) -> WarmupTable:
        """The fitted table."""
        if self.solution is None:
            raise DataError("there is no table of no model")
        return self.solution.table


def judge_none(curves: Curves) -> Judged:
    """Return the errors without compensation."""
    square = statistics(curves, "knot-cubic", ())
    left = square.square / square.weight[:, None] - curves.expected_noise()
    a = len(curves.axes)
    none = np.full((len(curves.temperatures), a), np.nan)
    return Judged(
        model="none",
        count=0,
        solution=None,
        training=_root(left),
        left_cycle=_root(left),
        left_temperature=None,
        by_temperature=_by_group(curves, left),
        left_by_temperature=none,
        edge_jump=np.zeros(a),
        exit_jump=np.zeros(a),
        scales_covariance=None,
    )


def judge(curves: Curves, model: str, count: int, weights: Array, *, by_unit: bool = False) -> Judged:
    """Fit a model and measure what it leaves.

    Leaving a single cycle out keeps the shared time scales; leaving a temperature out finds them anew.
    """
    scales = find_scales(curves, model, count, weights) if count else ()
    sums = statistics(curves, model, scales)
    solution = solve(curves, model, scales, sums, weights)
    noise = curves.expected_noise()
    left = sums.mean_square(coefficients_of(curves, solution.table)) - fitted_noise(curves, solution, sums)
    cycle = _leave_cycles(curves, model, scales, weights, noise, by_unit)
    temperature, others = _leave_temperatures(curves, model, scales, weights, noise)
    times = np.linspace(0.0, curves.settling_time, 301)
    jumps = edge_jumps(solution.table, times)
    return Judged(
        model=model,
        count=count,
        solution=solution,
        training=_root(left),
        left_cycle=cycle,
        left_temperature=None if temperature is None else _root(temperature[np.isfinite(temperature[:, 0])]),
        by_temperature=_by_group(curves, left),
        left_by_temperature=np.full((len(curves.temperatures), len(curves.axes)), np.nan)
        if temperature is None
        else _by_group(curves, temperature),
        edge_jump=jumps.max(axis=0, initial=0.0),
        exit_jump=np.abs(exit_jump(solution.table)).max(axis=0),
        scales_covariance=_jackknife(np.array(others), len(scales)),
    )


def _leave_cycles(
    curves: Curves, model: str, scales: tuple[float, ...], weights: Array, noise: Array, by_unit: bool
) -> Array | None:
    """Root mean square error, shape (axes,), of cycles (or units) predicted from the others."""
    sums = statistics(curves, model, scales)
    owner = curves.unit if by_unit else np.arange(len(curves.cycles))
    groups = len(curves.temperatures)
    errors = []
    for o in np.unique(owner):
        kept = weights * (owner != o)
        if np.unique(curves.group[kept > 0]).size < groups:
            continue  # its temperature would have no cycle left
        out = owner == o
        table = solve(curves, model, scales, sums, kept).table
        errors.append((sums.mean_square(coefficients_of(curves, table)) - noise)[out])
    return _root(np.concatenate(errors)) if errors else None


def _leave_temperatures(
    curves: Curves, model: str, scales: tuple[float, ...], weights: Array, noise: Array
) -> tuple[Array | None, list[tuple[float, ...]]]:
    """Mean square errors of the cycles at each inner temperature, predicted from the others, and the scales found.

    Shape (c, axes), NaN at the outer temperatures; None where fewer than three temperatures were measured.
    """
    groups = len(curves.temperatures)
    if groups < 3:
        return None, []
    errors = np.full((len(curves.cycles), len(curves.axes)), np.nan)
    found = []
    for k in range(groups):
        out = curves.group == k
        kept = weights * ~out
        own = find_scales(curves, model, len(scales), kept, scales) if scales else ()
        found.append(own)
        if 0 < k < groups - 1:
            sums = statistics(curves, model, own)
            table = solve(curves, model, own, sums, kept, np.delete(np.arange(groups), k)).table
            errors[out] = (sums.mean_square(coefficients_of(curves, table)) - noise)[out]
    return errors, found


@dataclass(frozen=True)
class Worst:
    """What to expect at the power-on temperature between calibration temperatures where a table is worst.

    Attributes
    ----------
    temperature
        degC.
    error
        Root mean square over t < T_M of one start there, its repeatability included, shape (axes,).
    """

    temperature: float
    error: Array


def worst_between(curves: Curves, chosen: Judged, spread: Repeatability) -> Worst | None:
    """Return the error to expect at the worst power-on temperature, from temperatures left out of the fit.

    Interpolation over a gap h errs by up to ``f'' h^2 / 8``; a temperature between neighbours h1 and h2 away, left
    out, by ``f'' h1 h2 / 2``. Each gap takes the larger f'' of its two ends. None with fewer than three temperatures,
    and for ``interval-cubic``, whose errors at its end points show what its wide intervals do.
    """
    t = curves.temperatures
    left = np.nan_to_num(chosen.left_by_temperature)
    if len(t) < 3 or chosen.model == "interval-cubic":
        return None
    gap = np.diff(t)
    repeated = np.nan_to_num(spread.cycle)
    own = np.sqrt(np.maximum(left[1:-1] ** 2 - repeated**2, 0.0))
    bend = np.zeros_like(left)
    bend[1:-1] = own / (gap[:-1] * gap[1:])[:, None]
    between = np.maximum(bend[:-1], bend[1:]) * (gap**2 / 4)[:, None]
    total = np.sqrt(between**2 + np.nan_to_num(chosen.training) ** 2 + repeated**2)
    size = np.sqrt(np.mean(curves.mean**2, axis=(0, 1)))
    place = int(np.argmax((total / np.maximum(size, 1e-300)).max(axis=1)))
    return Worst(float(t[place] + gap[place] / 2), total[place])


def _jackknife(values: Array, count: int) -> Array | None:
    """Covariance of the time scales from those found with each temperature left out (Efron and Tibshirani 1993, 11)."""
    n = len(values)
    if not count or n < 3:
        return None
    deviation = values - values.mean(axis=0)
    return np.asarray((n - 1) / n * deviation.T @ deviation)


def choose(curves: Curves, rows: list[Judged]) -> Judged:
    """Return the model that predicts best: cycles and temperatures that it has not seen, every kind of sensor alike.

    The score is the sum of both mean squares relative to those without compensation; of two models within 2 % the one
    with fewer time scales is taken.
    """
    none = next(row for row in rows if row.model == "none")
    fitted = [row for row in rows if row.model != "none"]
    scores = np.array([_score(curves, row, none) for row in fitted])
    good = [row for row, score in zip(fitted, scores, strict=True) if score <= 1.02 * scores.min()]
    return min(good, key=lambda row: row.count)


def _score(curves: Curves, row: Judged, none: Judged) -> float:
    parts = [part for part in (row.left_cycle, row.left_temperature) if part is not None] or [row.training]
    total = 0.0
    for index in curves.kinds().values():
        size = max(float(np.mean(none.training[index] ** 2)), 1e-300)
        total += sum(float(np.mean(part[index] ** 2)) for part in parts) / size
    return total


def _root(mean_squares: Array) -> Array:
    """Root of the mean over cycles (c, axes); what is below the noise counts as nothing."""
    return np.asarray(np.sqrt(np.maximum(mean_squares.mean(axis=0), 0.0)))


def _by_group(curves: Curves, mean_squares: Array) -> Array:
    return np.stack([_root(mean_squares[curves.group == k]) for k in range(len(curves.temperatures))])


@dataclass(frozen=True)
class Repeatability:
    """How well cycles repeat, root mean squares over t < T_M without white noise, per axis.

    Attributes
    ----------
    cycle
        Deviation of a cycle from the mean of its unit and temperature, shape (axes,); NaN where none was repeated.
    uncertainty
        Of `cycle`: with n degrees of freedom and a white part w^2 taken off, its square r^2 is known to
        (r^2 + w^2) sqrt(2 / n); so what is lost in the noise (r = 0) is known to w (2 / n)^(1/4), shape (axes,).
    freedom
        Degrees of freedom.
    by_temperature
        The same at each calibration temperature, shape (k, axes).
    unit
        Deviation of a unit's mean from that of its temperature, over what repeatability explains, (axes,), or None.
    """

    cycle: Array
    uncertainty: Array
    freedom: int
    by_temperature: Array
    unit: Array | None


def repeatability(curves: Curves) -> Repeatability:
    """Return the repeatability between power cycles, the floor that no table can beat, and the spread between units.

    Each cycle's curve is first smoothed by a cubic in ln(1 + t / 20 s), whose four coefficients pass far less noise
    than the bins do; what white noise leaves in them is taken off.
    """
    scales = (_SMOOTH_SCALE,)
    sums = statistics(curves, "knot-log-cubic", scales)
    own = np.linalg.solve(sums.normal, sums.moment)
    metric = sums.normal.sum(axis=0) / sums.weight.sum()
    size = own.shape[1]
    noise = curves.noise * (size / sums.weight + 1 / curves.reference_seconds)[:, None]
    groups, a = len(curves.temperatures), len(curves.axes)
    within, freedom = np.zeros((groups, a)), np.zeros(groups)
    between, units, members = np.zeros(a), 0, 0.0
    for k in range(groups):
        means = []
        for u in np.unique(curves.unit[curves.group == k]):
            chosen = (curves.group == k) & (curves.unit == u)
            n = int(chosen.sum())
            mean = own[chosen].mean(axis=0)
            within[k] += _squares(own[chosen] - mean, metric) - (n - 1) * noise[chosen].mean(axis=0)
            freedom[k] += n - 1
            means.append(mean)
            members += 1 / n
        if len(means) > 1:
            between += _squares(np.array(means) - np.mean(means, axis=0), metric)
            units += len(means) - 1
    total = int(freedom.sum())
    cycle = np.sqrt(np.maximum(within.sum(axis=0) / total, 0.0)) if total else np.full(a, np.nan)
    known = (np.nan_to_num(cycle) ** 2 + noise.mean(axis=0)) * np.sqrt(2 / max(total, 1))
    uncertainty = np.sqrt(cycle**2 + known) - cycle
    each = np.sqrt(np.maximum(within / np.maximum(freedom, 1)[:, None], 0.0))
    each[freedom == 0] = np.nan
    unit = None
    if units:
        pairs = len(set(zip(curves.unit.tolist(), curves.group.tolist(), strict=True)))
        one = np.where(np.isfinite(cycle), cycle, 0.0) ** 2 + noise.mean(axis=0)
        unit = np.sqrt(np.maximum(between / units - one * members / pairs, 0.0))
    return Repeatability(cycle, uncertainty, total, each, unit)


def _squares(deviations: Array, metric: Array) -> Array:
    """Sum over curves of their mean squares, for coefficients (n, p, axes): shape (axes,)."""
    found: Array = np.einsum("npa,pq,nqa->a", deviations, metric, deviations)
    return found


def cycle_weights(curves: Curves, spread: Repeatability) -> Array:
    """Return the weight of each cycle under a random effect per unit, shape (c,).

    ``1 / (1 + n rho)`` for each of the n cycles of a unit at a temperature, rho the variance between units over that
    of a cycle: all cycles alike where units do not differ, all units alike where they differ much.
    """
    if spread.unit is None:
        return np.ones(len(curves.cycles))
    own = np.where(np.isfinite(spread.cycle), spread.cycle, 0.0) ** 2 + curves.expected_noise().mean(axis=0)
    rho = float(np.mean(spread.unit**2 / np.maximum(own, 1e-300)))
    same = (curves.unit[:, None] == curves.unit) & (curves.group[:, None] == curves.group)
    weights: Array = 1 / (1 + rho * same.sum(axis=1))
    return np.asarray(weights / weights.max())
