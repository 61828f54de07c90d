"""Noise models fitted to a spectrum by maximum likelihood, many models and spectra at a time.

Source: Whittle (1953); the likelihood is exact for white noise plus walk. Fisher scoring in the logarithms of the
parameters, damped; starts from multiplicative updates of the variances with time constants on a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.noise.spectrum import Spectrum
from imulab.estimation.noise.terms import LINEAR, NAMES, SIGMA, TIME, Bins
from imulab.recording import Array

Flags = NDArray[np.bool_]
_SIZES = [*range(LINEAR), *SIGMA]
_NONE, _LITTLE = 1e-6, 0.03
"""A term below this share of every bin is 0; at which share one begins that was 0."""
_GRID, _STARTS, _UPDATES = 8, 3, 12
_ROUNDS, _DONE, _LONGEST = 60, 1e-5, 2.0
"""Rounds of scoring at most, change of the deviance that ends them, longest step of a logarithm."""
_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e8
_ROWS = 2000  # rows of a batch whose arrays stay small


@dataclass(frozen=True)
class Fits:
    """Models fitted to spectra, one in each row.

    Attributes
    ----------
    values
        Parameters in the order of `NAMES`, shape (r, 8); a term that was found to be nothing is 0.
    deviance
        ``-2 ln L`` but for a constant of the spectrum, shape (r,).
    covariance
        Of the logarithms of the parameters that are not 0, from the Fisher information, shape (r, 8, 8).
    """

    values: Array
    deviance: Array
    covariance: Array


def time_limits(spectra: Sequence[Spectrum]) -> tuple[float, float]:
    """Return the least and the greatest time constant that spectra can tell, s: 2/f_max and the longest stretch.

    A shorter one is white noise up to the highest frequency of the spectra, f_max; a longer one is a walk.
    """
    highest = [
        float(each.last[np.flatnonzero(np.atleast_2d(each.freedom).any(axis=0))[-1]]) / (2 * each.length)
        for each in spectra
    ]
    return 2 / max(highest), max(each.length for each in spectra)


def deviance(bins: Bins, values: Array) -> Array:
    """Return ``-2 ln L = sum_b d_b [ln lambda_b + P_b/lambda_b]`` of models, shape (r, 8), as shape (r,).

    The powers of `bins` have shape (b,) or (r, b).
    """
    total = bins.variances(values)
    return np.asarray((bins.freedom * (np.log(total) + bins.power / total)).sum(axis=-1))


def information(bins: Bins, values: Array) -> Array:
    """Return the covariance of the logarithms of a model's parameters, shape (8,), that the bins can tell, (8, 8)."""
    power = bins.variances(values[None])
    return np.asarray(
        _inverse(_expansion(bins, values[None].copy(), power, bins.freedom[None])[2], values[None] > 0)[0]
    )


def fit(bins: Bins, models: Flags, limits: tuple[float, float], power: Array, freedom: Array) -> Fits:
    """Fit every model to every spectrum: rows count models, then spectra.

    Parameters
    ----------
    bins
        Of the spectra; their own power is not looked at.
    models
        Which parameters each model has, shape (m, 8), at least one variance each.
    limits
        Least and greatest time constant of a Gauss-Markov term, s.
    power, freedom
        Of spectra with these bins, shape (t, b).

    Returns
    -------
    Fits
        Rows t m, in the order ``spectrum * m + model``.
    """
    at_a_time = max(1, _ROWS // (len(models) * 10))
    parts = [
        _best(bins, models, limits, power[k : k + at_a_time], freedom[k : k + at_a_time])
        for k in range(0, len(power), at_a_time)
    ]
    return Fits(*(np.concatenate([getattr(each, name) for each in parts]) for name in Fits.__annotations__))


def _best(bins: Bins, models: Flags, limits: tuple[float, float], power: Array, freedom: Array) -> Fits:
    """The deepest minimum that is reached from the best three starts of each model."""
    chosen, start = _starts(bins, models, limits, power, freedom)
    spectrum = chosen // len(models)
    found = score(bins, start, start > 0, limits, power[spectrum], freedom[spectrum])
    order = np.lexsort([found.deviance, chosen])
    best = order[np.flatnonzero(np.r_[True, np.diff(chosen[order]) > 0])]
    shape = (len(power), len(models))
    values, reached = found.values[best].reshape(*shape, -1), found.deviance[best].reshape(shape)
    for index in np.argsort(models.sum(axis=1)).tolist():
        inner = np.flatnonzero((models <= models[index]).all(axis=1) & (models < models[index]).any(axis=1))
        if inner.size:
            _not_above(bins, models[index], limits, power, freedom, (values, reached), index, inner)
    values = _sorted(values.reshape(-1, len(NAMES)))
    spectrum = np.arange(len(values)) // len(models)
    fisher = _expansion(bins, values, power[spectrum], freedom[spectrum])[2]
    return Fits(values, reached.ravel(), _inverse(fisher, values > 0))


def _not_above(
    bins: Bins,
    model: Flags,
    limits: tuple[float, float],
    power: Array,
    freedom: Array,
    reached: tuple[Array, Array],
    index: int,
    inner: NDArray[np.int64],
) -> None:
    """Start again from the best model inside this one, where that one came to a lower minimum."""
    values, deviances = reached
    lowest = inner[deviances[:, inner].argmin(axis=1)]
    rows = np.arange(len(power))
    rows = rows[deviances[rows, lowest] < deviances[:, index] - _DONE]
    if not rows.size:
        return
    least = values[rows, lowest[rows]]
    start = with_a_little(bins, least, model, limits)
    again = score(bins, start, start > 0, limits, power[rows], freedom[rows])
    lower = again.deviance < deviances[rows, lowest[rows]]
    values[rows, index] = np.where(lower[:, None], again.values, least)
    deviances[rows, index] = np.minimum(again.deviance, deviances[rows, lowest[rows]])


def with_a_little(bins: Bins, values: Array, models: Flags, limits: tuple[float, float]) -> Array:
    """Return parameters, shape (r, 8), with what models (r, 8) have and they have not at a small share of each bin."""
    start, total = values.copy(), bins.variances(values)
    middle = np.full(len(values), np.sqrt(limits[0] * limits[1]))
    for k in _SIZES:
        missing = models[..., k] & (values[:, k] == 0)
        if missing.any():
            unit = bins.unit[k] if k < LINEAR else bins.markov(middle)[0]
            start[missing, k] = np.sqrt(_LITTLE * (total / unit).min(axis=1))[missing]
            if k in SIGMA:
                start[missing, k + 1] = middle[missing]
    return start


def _sorted(values: Array) -> Array:
    """Gauss-Markov terms from the shortest to the longest time constant, a single one in the first place."""
    first, second = [SIGMA[0], TIME[0]], [SIGMA[1], TIME[1]]
    swap = (values[:, SIGMA[1]] > 0) & ((values[:, SIGMA[0]] == 0) | (values[:, TIME[0]] > values[:, TIME[1]]))
    values[np.ix_(swap, first + second)] = values[np.ix_(swap, second + first)]
    return values


def _starts(
    bins: Bins, models: Flags, limits: tuple[float, float], power: Array, freedom: Array
) -> tuple[NDArray[np.int64], Array]:
    """Row (spectrum * models + model) of each start, and its parameters: T on a grid, variances by a few updates."""
    grid = np.geomspace(limits[0], limits[1], 2 * _GRID + 1)[1::2]
    shapes = np.concatenate([bins.unit, bins.markov(grid)[0]])
    owner, used, times = [], [], []
    for index, present in enumerate(models):
        markov = int(present[list(SIGMA)].sum())
        for pick in combinations(range(_GRID), markov):
            row = np.zeros(len(shapes), dtype=np.bool_)
            row[:LINEAR] = present[:LINEAR]
            row[[LINEAR + k for k in pick]] = True
            owner.append(index)
            used.append(row)
            times.append([*pick, *[-1] * (2 - markov)])
    flags, picks, owners = np.array(used), np.array(times), np.array(owner)
    size = np.where(flags, 1.0, 0.0) / flags.sum(axis=1, keepdims=True) / shapes.mean(axis=1)
    level = (power * freedom).sum(axis=1) / freedom.sum(axis=1)
    sizes = level[:, None, None] * size  # spectra, starts, shapes
    for _ in range(_UPDATES):
        weight = freedom[:, None] / (total := sizes @ shapes)
        sizes *= np.sqrt((weight * power[:, None] / total @ shapes.T) / (weight @ shapes.T))
    total = sizes @ shapes
    reached = (freedom[:, None] * (np.log(total) + power[:, None] / total)).sum(axis=2)
    rows, values = [], []
    for index in range(len(models)):
        mine = np.flatnonzero(owners == index)
        best = mine[np.argsort(reached[:, mine], axis=1)[:, :_STARTS]]
        spectrum = np.repeat(np.arange(len(power)), best.shape[1])
        best = best.ravel()
        value = np.zeros((len(best), len(NAMES)))
        value[:, :LINEAR] = np.sqrt(sizes[spectrum, best, :LINEAR])
        for k in range(2):
            pick = picks[best, k]
            has = pick >= 0
            value[has, SIGMA[k]] = np.sqrt(sizes[spectrum[has], best[has], LINEAR + pick[has]])
            value[has, TIME[k]] = grid[pick[has]]
        rows.append(spectrum * len(models) + index)
        values.append(value)
    return np.concatenate(rows), np.concatenate(values)


def score(bins: Bins, start: Array, free: Flags, limits: tuple[float, float], power: Array, freedom: Array) -> Fits:
    """Return the minima of the deviance next to starts, in the parameters that are free.

    Parameters
    ----------
    start
        Parameters, shape (r, 8); a term of 0 stays absent.
    free
        Which of them to fit, shape (r, 8).
    power, freedom
        Of the spectrum of each row, shape (r, b).
    """
    values, free = start.copy(), free & (start > 0)
    now, slope, fisher = _expansion(bins, values, power, freedom)
    damping, going = np.full(len(values), 1e-3), np.ones(len(values), dtype=np.bool_)
    edges = np.log(limits)
    for _ in range(_ROUNDS):
        rows = np.flatnonzero(going)
        if not rows.size:
            break
        step = _step(slope[rows], fisher[rows], _movable(values[rows], free[rows], slope[rows], edges), damping[rows])
        tried = _stepped(values[rows], step, edges)
        new, new_slope, new_fisher = _expansion(bins, tried, power[rows], freedom[rows])
        better = new <= now[rows] + 1e-9
        gain = np.where(better, now[rows] - new, np.inf)
        got = rows[better]
        values[got], now[got] = tried[better], new[better]
        slope[got], fisher[got] = new_slope[better], new_fisher[better]
        damping[rows] = np.clip(damping[rows] * np.where(better, 0.1, 10.0), _LEAST_DAMPING, _MOST_DAMPING)
        going[rows] = np.where(better, (gain > _DONE) | (np.abs(step).max(axis=1) >= 1), damping[rows] < _MOST_DAMPING)
    return Fits(values, now, _inverse(fisher, free & (values > 0)))


def _expansion(bins: Bins, values: Array, power: Array, freedom: Array) -> tuple[Array, Array, Array]:
    """Deviance (r,), half its slope downwards (r, 8) and Fisher information (r, 8, 8), by logarithms of parameters.

    Terms that are nothing become 0 in `values`.
    """
    parts = np.zeros((len(values), len(NAMES), power.shape[-1]))
    parts[:, :LINEAR] = values[:, :LINEAR, None] ** 2 * bins.unit
    for sigma, time in zip(SIGMA, TIME, strict=True):
        rows = np.flatnonzero(values[:, sigma] > 0)
        if rows.size:
            unit, slope = bins.markov(values[rows, time])
            square = values[rows, sigma, None] ** 2
            parts[rows, sigma], parts[rows, time] = square * unit, square * slope
    total = parts[:, _SIZES].sum(axis=1)
    parts /= total[:, None]
    nothing = (parts.max(axis=2) < _NONE) & (values > 0)
    nothing[:, TIME] = nothing[:, SIGMA]
    values[nothing] = 0
    parts[nothing] = 0
    parts[:, _SIZES] *= 2
    ratio = power / total
    weighted = parts * freedom[:, None]
    slope = 0.5 * np.einsum("rpb,rb->rp", weighted, ratio - 1)
    fisher = 0.5 * weighted @ parts.transpose(0, 2, 1)
    return (freedom * (np.log(total) + ratio)).sum(axis=1), slope, fisher


def _movable(values: Array, free: Flags, slope: Array, edges: Array) -> Flags:
    """Free parameters but for time constants that press against a limit."""
    movable = free & (values > 0)
    for time in TIME:
        at = np.log(np.maximum(values[:, time], 1e-300))
        movable[:, time] &= ~(
            (at <= edges[0] + 1e-9) & (slope[:, time] < 0) | (at >= edges[1] - 1e-9) & (slope[:, time] > 0)
        )
    return movable


def _step(slope: Array, fisher: Array, movable: Flags, damping: Array) -> Array:
    diagonal = np.einsum("rpp->rp", fisher)
    system = np.where(movable[:, :, None] & movable[:, None, :], fisher, 0.0)
    np.einsum("rpp->rp", system)[...] += np.where(movable, damping[:, None] * diagonal + 1e-12, 1.0)
    step = np.linalg.solve(system, np.where(movable, slope, 0.0)[:, :, None])[:, :, 0]
    longest = np.abs(step).max(axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1, _LONGEST / np.maximum(longest, 1e-300)))


def _stepped(values: Array, step: Array, edges: Array) -> Array:
    moved = values * np.exp(step)
    for time in TIME:
        present = values[:, time] > 0
        moved[present, time] = np.clip(moved[present, time], *np.exp(edges))
    return np.asarray(moved)


def _inverse(fisher: Array, free: Flags) -> Array:
    """Covariance of the free parameters, 0 for the others."""
    both = free[:, :, None] & free[:, None, :]
    scale = np.where(free, np.sqrt(np.maximum(np.einsum("rpp->rp", fisher), 1e-200)), 1.0)
    outer = scale[:, :, None] * scale[:, None, :]
    scaled = np.where(both, fisher / outer, 0.0)
    np.einsum("rpp->rp", scaled)[...] += np.where(free, 1e-9, 1.0)
    return np.where(both, np.linalg.inv(scaled) / outer, 0.0)
