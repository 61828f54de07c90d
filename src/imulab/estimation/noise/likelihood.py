"""Noise models fitted to a spectrum by maximum likelihood, with profile intervals, in the band that the spectrum shows.

Source: Whittle (1953); the likelihood is exact for white noise plus walk. Fisher scoring in the logarithms of the
parameters, damped as by Levenberg and Marquardt; it starts from multiplicative updates of the variances with time
constants on a grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from imulab.errors import OptionError
from imulab.estimation.decisions import BIN_OFF_MODEL
from imulab.estimation.noise.spectrum import Spectrum, frequencies
from imulab.estimation.noise.terms import LINEAR, NAMES, SIGMA, TIME, Bins
from imulab.estimation.rows import NORMAL_95
from imulab.recording import Array

# The band in which a model is fitted, and the ripple that is allowed for: no spectrum is exactly the model's.


_AGREE, _SIGMAS, _SHARP = 0.03, 3.0, 0.2
"""How far two octaves may differ beyond so many sigma; largest value of these sigma that shows an agreement at all."""
# Share of the Nyquist frequency from which the band is whole; share of the sampling rate below which it is filtered
# (an octave below Nyquist is 0.25)
_FULL, _NEARLY_FULL = 0.999, 0.24
_RIPPLE_FREEDOM, _FEWEST_BINS = 200, 16
"""Fewest coefficients of a bin that shows the ripple; fewest such bins."""
_OFF = 0.10  # a bin that is off by less, relative, is kept whatever its scatter
_BOUND, _EXPECTED = 6.635, 0.9819
"""Bound of the squared deviation of a bin over its variance, and the expectation of the bounded value."""


@dataclass(frozen=True)
class Band:
    """The usable band of a spectrum.

    Attributes
    ----------
    highest
        f_max, Hz: half the sampling rate where the band is full.
    full
        Whether that is the whole band of the samples.
    flat
        Whether there is white noise at its end; where no two octaves agree, the band is full and this is False.
    roll_off
        Relative standard uncertainty of N from what a filter's roll-off may leave.
    """

    highest: float
    full: bool
    flat: bool = True
    roll_off: float = field(default=0.0, compare=False)

    def filtered(self, interval: float) -> bool:
        """Return whether it ends below a sensor's filter; without one it ends at a quarter of the sampling rate."""
        return self.flat and self.highest * interval < _NEARLY_FULL


def usable_band(spectra: Sequence[Spectrum]) -> Band:
    """Return the usable band: f_max is halved from half the rate until its two highest octaves agree, then once more.

    They agree within 3 % + 3 sigma. In a long record these 3 % are explained by a term of their own, which makes N too
    small: so the band ends an octave lower, unless 3 sigma are more than 20 %. Quantisation of an angle rises with
    frequency: where white noise and quantisation together, ``a + b s^2``, bring the three highest octaves to agreement,
    or the highest octave is clearly above the next, the band is full.
    """
    nyquist = 0.5 / spectra[0].interval
    f, p, d = (np.concatenate(each) for each in zip(*((frequencies(s), s.power, s.freedom) for s in spectra)))  # noqa: B905
    highest = nyquist
    if not _same_level(f, p, d, highest, 2) and _rising(f, p, d, nyquist):
        return Band(nyquist, True)
    while highest == nyquist or d[f <= highest / 4].sum() > _RIPPLE_FREEDOM:
        if _same_level(f, p, d, highest, 2):
            far, u = _apart(f, p, d, highest, 2)
            full = highest > _FULL * nyquist
            if _SIGMAS * u[0] > _SHARP or (full and far[0] < -_SIGMAS * u[0]):
                # A first-order filter takes 0.76 of the octaves' difference from the band, and half of that from N.
                left = 0.0 if full else 0.38 * float(max(far[0], 0.0) + u[0]) / math.sqrt(3)
                return Band(highest, full, roll_off=left)
            # A first-order filter leaves a quarter of it an octave lower, of which N has at most half.
            return Band(highest / 2, False, roll_off=float(_AGREE + _SIGMAS * u[0]) / 8 / math.sqrt(3))
        highest /= 2
    return Band(nyquist, True, False)


def _same_level(f: Array, p: Array, d: Array, highest: float, octaves: int) -> bool:
    """Return whether the highest octaves have the same level, each compared with the highest."""
    far, u = _apart(f, p, d, highest, octaves)
    return bool((np.abs(far) <= _AGREE + _SIGMAS * u).all())


def _apart(f: Array, p: Array, d: Array, highest: float, octaves: int) -> tuple[Array, Array]:
    """Return the log ratios of octaves' levels to the highest one's, and their uncertainties; inf for a level of 0."""
    level, freedom = [], []
    for k in range(octaves):
        inside = (f <= highest / 2**k * (1 + 1e-9)) & (f > highest / 2 ** (k + 1)) & (d > 0)
        freedom.append(float(d[inside].sum()))
        level.append(float((p * d)[inside].sum()) / max(freedom[-1], 1.0))
    if min(freedom) <= 0 or min(level) <= 0:
        return np.full(octaves - 1, np.inf), np.zeros(octaves - 1)
    u = np.sqrt(2 / np.array(freedom[1:]) + 2 / freedom[0])
    return np.asarray(np.log(np.array(level[1:]) / level[0])), np.asarray(u)


def _rising(f: Array, p: Array, d: Array, nyquist: float) -> bool:
    """Return whether white noise and quantisation of an angle explain the three highest octaves."""
    top = (f > nyquist / 8) & (d > 0) & (p > 0)
    square = 4 * np.sin(np.pi / 2 * f[top] / nyquist) ** 2
    root = np.sqrt(d[top]) / p[top]
    a, b = np.linalg.lstsq(np.column_stack([root, root * square]), root * p[top])[0]
    if b <= 0 or a <= 0:
        return False
    return _same_level(f[top], p[top] / (a + b * square), d[top], nyquist, 3)


def within(spectrum: Spectrum, highest: float) -> Spectrum:
    """Return a spectrum whose bins beyond a frequency, Hz, have no weight."""
    inside = spectrum.last / (2 * spectrum.length) <= highest * (1 + 1e-9)
    return replace(spectrum, freedom=np.where(inside, spectrum.freedom, 0.0))


@dataclass(frozen=True)
class Allowance:
    """Ripple of a spectrum about its model, and the bins that are farther off.

    Attributes
    ----------
    ripple
        eps, the relative standard deviation of the level of bins beyond their noise.
    spectra
        Spectra with the degrees of freedom that this leaves, and none for the bins that are off.
    off
        Lowest and highest frequency of each run of bins left out, Hz, and the factor by which they are off.
    """

    ripple: float
    spectra: tuple[Spectrum, ...]
    off: tuple[tuple[float, float, float], ...]


def allow(spectra: Sequence[Spectrum], variances: Sequence[Array]) -> Allowance:
    """Return spectra whose weights allow for their ripple about a model, with variances in their bins, shapes (b,).

    ``eps^2`` is the variance of ``ln(P/lambda)`` beyond 2/d over bins with d > 200, by maximum likelihood with bounded
    influence: so the bins with most coefficients decide, while a median over all bins would find 1 to 4 % of ripple in
    noise without any. d becomes ``d/(1 + d eps^2/2)``. Bins that are then off by 5 sigma and 10 % are left out.
    """
    logarithm = [
        np.log(np.maximum(s.power, 1e-300) / v) + 1 / np.maximum(s.freedom, 1)
        for s, v in zip(spectra, variances, strict=True)
    ]
    log = np.concatenate(logarithm)
    freedom = np.concatenate([s.freedom for s in spectra])
    ripple = _ripple(log, freedom)
    far = _far_bins(log, freedom, ripple)
    ripple = _ripple(log[~far], freedom[~far])  # bins that are left out are no ripple
    far = _far_bins(log, freedom, ripple)
    edges = np.cumsum([len(s.power) for s in spectra])[:-1]
    parts, off = [], []
    for spectrum, part, out in zip(spectra, logarithm, np.split(far, edges), strict=True):
        left = spectrum.freedom / (1 + spectrum.freedom * ripple**2 / 2)
        parts.append(replace(spectrum, freedom=np.where(out, 0.0, left)))
        runs = np.flatnonzero(np.diff(np.concatenate([[0], out.astype(int), [0]]))).reshape(-1, 2)
        for start, stop in runs.tolist():
            low, high = (each / (2 * spectrum.length) for each in (spectrum.first[start], spectrum.last[stop - 1]))
            off.append((float(low), float(high), float(np.exp(part[start:stop].mean()))))
    return Allowance(ripple, tuple(parts), tuple(off))


def _far_bins(logarithm: Array, freedom: Array, ripple: float) -> NDArray[np.bool_]:
    """Return which bins are off by 5 sigma and 10 %, allowing for the ripple."""
    u = np.sqrt(2 / np.maximum(freedom, 1) + ripple**2)
    size = np.abs(logarithm)
    return np.asarray((freedom > _FEWEST_BINS) & (size > np.log1p(_OFF)) & (size > BIN_OFF_MODEL.limit * u))


def _ripple(logarithm: Array, freedom: Array) -> float:
    """Return the scatter of the bins' levels beyond what their numbers of coefficients explain."""
    many = freedom > _RIPPLE_FREEDOM
    if np.count_nonzero(many) < _FEWEST_BINS:
        return 0.0
    square, chance = logarithm[many] ** 2, 2 / freedom[many]

    def beyond(eps: float) -> float:
        spread = chance + eps**2
        return float(np.sum((np.minimum(square / spread, _BOUND) - _EXPECTED) / spread))

    if beyond(0.0) <= 0:
        return 0.0
    low, high = 0.0, float(np.sqrt(square.max()))
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if beyond(middle) > 0 else (low, middle)
    return high


# Noise models fitted by maximum likelihood, many models and spectra together.


Flags = NDArray[np.bool_]
_SIZES = [*range(LINEAR), *SIGMA]
_NONE, _LITTLE = 1e-6, 0.03
"""Share of every bin below which a term is 0; share at which an absent term starts."""
# Time constants of the grid, how many of the best are starts, and updates of the sizes before that
_GRID, _STARTS, _UPDATES = 8, 3, 12
_ROUNDS, _DONE, _LONGEST = 60, 1e-5, 2.0
"""Most rounds of scoring, change of the deviance that ends them, longest step of a logarithm."""
# Damping of Levenberg-Marquardt steps: below the least they are pure Newton steps, above the most there is no step
_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e8
_ROWS = 2000  # rows of a batch whose arrays stay small


@dataclass(frozen=True)
class Fits:
    """Models fitted to spectra, one in each row.

    Attributes
    ----------
    values
        Parameters in the order of `NAMES`, shape (r, 8); a term that vanished in the fit is 0.
    deviance
        ``-2 ln L`` without a constant of the spectrum, shape (r,).
    covariance
        Covariance of the logarithms of the parameters that are not 0, from the Fisher information, shape (r, 8, 8).
    """

    values: Array
    deviance: Array
    covariance: Array


def time_limits(spectra: Sequence[Spectrum]) -> tuple[float, float]:
    """Return the least and the greatest time constant that spectra show, s: 2/f_max and the longest stretch.

    A shorter one is white noise up to the highest frequency of the spectra, f_max; a longer one is a walk.

    Raises
    ------
    OptionError
        The band that was asked for ends below the lowest frequency of the spectra.
    """
    highest = [
        float(each.last[counted[-1]]) / (2 * each.length)
        for each in spectra  # those of the upper frequencies have none in a narrow band
        if (counted := np.flatnonzero(np.atleast_2d(each.freedom).any(axis=0))).size
    ]
    if not highest:
        lowest = min(float(each.last[0]) / (2 * each.length) for each in spectra)
        raise OptionError(f"band: expected {lowest:.3g} Hz, the lowest frequency that these data show, or more")
    return 2 / max(highest), max(each.length for each in spectra)


def deviance(bins: Bins, values: Array) -> Array:
    """Return the deviance of models, parameters (r, 8): ``-2 ln L = sum_b d_b [ln lambda_b + P_b/lambda_b]``, (r,).

    The powers of `bins` have shape (b,) or (r, b).
    """
    total = bins.variances(values)
    return np.asarray((bins.freedom * (np.log(total) + bins.power / total)).sum(axis=-1))


def information(bins: Bins, values: Array) -> Array:
    """Return the Cramer-Rao covariance of the logarithms of a model's parameters, shape (8,), from bins, (8, 8)."""
    power = bins.variances(values[None])
    return np.asarray(
        _inverse(_expansion(bins, values[None].copy(), power, bins.freedom[None])[2], values[None] > 0)[0]
    )


def fit(bins: Bins, models: Flags, limits: tuple[float, float], power: Array, freedom: Array) -> Fits:
    """Return the fits of every model to every spectrum, the minima of `deviance`; rows count models, then spectra.

    Parameters
    ----------
    bins
        Bins of the spectra; their own power is not used.
    models
        Which parameters each model has, shape (m, 8), at least one variance each.
    limits
        Least and greatest time constant of a Gauss-Markov term, s.
    power, freedom
        Power and freedom of spectra with these bins, shape (t, b).

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
    """Return the lowest minimum reached from the best three starts of each model."""
    chosen, start = _starts(bins, models, limits, power, freedom)
    spectrum = chosen // len(models)
    fits = score(bins, start, start > 0, limits, power[spectrum], freedom[spectrum])
    order = np.lexsort([fits.deviance, chosen])
    best = order[np.flatnonzero(np.r_[True, np.diff(chosen[order]) > 0])]
    shape = (len(power), len(models))
    values, reached = fits.values[best].reshape(*shape, -1), fits.deviance[best].reshape(shape)
    for index in np.argsort(models.sum(axis=1)).tolist():
        inner = np.flatnonzero((models <= models[index]).all(axis=1) & (models < models[index]).any(axis=1))
        if inner.size:
            _refit_from_inner(bins, models[index], limits, power, freedom, (values, reached), index, inner)
    values = _sorted(values.reshape(-1, len(NAMES)))
    spectrum = np.arange(len(values)) // len(models)
    fisher = _expansion(bins, values, power[spectrum], freedom[spectrum])[2]
    return Fits(values, reached.ravel(), _inverse(fisher, values > 0))


def _refit_from_inner(
    bins: Bins,
    model: Flags,
    limits: tuple[float, float],
    power: Array,
    freedom: Array,
    reached: tuple[Array, Array],
    index: int,
    inner: NDArray[np.int64],
) -> None:
    """Start again from the best model within this one where that one has a lower minimum; changes `reached`."""
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
    """Return parameters, shape (r, 8), with absent terms of models (r, 8) added at a small share of each bin."""
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
    """Return parameters with Gauss-Markov terms sorted by time constant, a single one in the first place."""
    first, second = [SIGMA[0], TIME[0]], [SIGMA[1], TIME[1]]
    swap = (values[:, SIGMA[1]] > 0) & ((values[:, SIGMA[0]] == 0) | (values[:, TIME[0]] > values[:, TIME[1]]))
    values[np.ix_(swap, first + second)] = values[np.ix_(swap, second + first)]
    return values


def _starts(
    bins: Bins, models: Flags, limits: tuple[float, float], power: Array, freedom: Array
) -> tuple[NDArray[np.int64], Array]:
    """Return row (spectrum * models + model) and parameters of each start: T on a grid, variances by a few updates."""
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
    """Return the minima of the deviance next to starts, over the parameters that are free.

    Parameters
    ----------
    start
        Parameters, shape (r, 8); a term of 0 stays absent.
    free
        Parameters that are fitted, shape (r, 8).
    power, freedom
        Power and freedom of the spectrum of each row, shape (r, b).
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
    """Return deviance (r,), half its downward slope (r, 8) and Fisher information (r, 8, 8) in log parameters.

    Terms that vanish become 0 in `values`.
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
    """Return the free parameters, without time constants that press against a limit."""
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
    """Return the covariance of the free parameters, 0 for the others."""
    both = free[:, :, None] & free[:, None, :]
    scale = np.where(free, np.sqrt(np.maximum(np.einsum("rpp->rp", fisher), 1e-200)), 1.0)
    outer = scale[:, :, None] * scale[:, None, :]
    scaled = np.where(both, fisher / outer, 0.0)
    np.einsum("rpp->rp", scaled)[...] += np.where(free, 1e-9, 1.0)
    return np.where(both, np.linalg.inv(scaled) / outer, 0.0)


# Intervals of the parameters from the profile of the likelihood.


_DEVIANCE_95 = 3.84
"""The 95 % point of chi-square with one degree of freedom."""
_END_TRIALS, _EXACT = 14, 0.01
"""Most trials for an end, and how close the root of the deviance must come to that of the level."""
_FIRST = 1.0
"""Longest first step of a logarithm."""


def profile(
    bins: Bins, values: Array, models: Flags, limits: tuple[float, float], power: Array, freedom: Array
) -> tuple[Array, Array]:
    """Return the lower and upper ends of the 95 % intervals of the parameters of best fits, shapes (r, 8).

    An end is where the deviance, minimised over all other parameters, is 3.84 above its minimum. A lower end that is
    never reached is 0; an end of a time constant is then its limit. Parameters that a model lacks have NaN.

    Parameters
    ----------
    bins, limits
        As for `likelihood.fit`.
    values
        The best fits, shape (r, 8).
    models
        Which parameters each model has, shape (r, 8).
    power, freedom
        Power and freedom of the spectrum of each row, shape (r, b).
    """
    best = score(bins, values, values > 0, limits, power, freedom)
    row, parameter = (np.repeat(each, 2) for each in np.nonzero(models))
    side = np.tile([-1.0, 1.0], len(row) // 2)
    ends = _Ends(bins, limits, power[row], freedom[row], best.deviance[row], parameter, side)
    # A term that vanishes in the best fit may be there when another parameter is held.
    start = with_a_little(bins, best.values, models, limits)[row]
    absent = best.values[row, parameter] == 0
    spread = np.sqrt(best.covariance[row, parameter, parameter])
    start[absent, parameter[absent]], spread[absent] = ends.just_visible(best.values[row[absent]], absent), _FIRST
    ends_found = np.full((2, *values.shape), np.nan)
    ends_found[(side > 0).astype(int), row, parameter] = ends.find(start, np.clip(NORMAL_95 * spread, 1e-6, _FIRST))
    return ends_found[0], ends_found[1]


@dataclass(frozen=True)
class _Ends:
    """One end of the profile interval of one parameter in each row."""

    bins: Bins
    limits: tuple[float, float]
    power: Array
    freedom: Array
    lowest: Array
    parameter: NDArray[np.int64]
    side: Array

    def just_visible(self, values: Array, absent: Flags) -> Array:
        """Return a tenth of the size at which absent terms would show; time constants as they are."""
        parameter = self.parameter[absent]
        middle = np.full(len(parameter), np.sqrt(self.limits[0] * self.limits[1]))
        unit = self.bins.markov(middle)[0]
        linear = parameter < LINEAR
        unit[linear] = self.bins.unit[parameter[linear]]
        information = 0.5 * (self.freedom[absent] * (unit / self.bins.variances(values)) ** 2).sum(axis=1)
        return np.where(np.isin(parameter, TIME), middle, 0.1 * information**-0.25)

    def find(self, values: Array, first: Array) -> Array:
        """Return the ends, by secants of the root of the deviance, from best values and first steps of logarithms."""
        timed = np.isin(self.parameter, TIME)
        floor, ceiling = (
            np.where(timed, np.log(edge), far) for edge, far in zip(self.limits, (-700, 700), strict=True)
        )
        values, ends = values.copy(), self._never_reached(values)
        low = np.log(values[np.arange(len(values)), self.parameter])
        below = np.full(len(low), -np.sqrt(_DEVIANCE_95))
        high, above, last = np.full((3, len(low)), np.nan)
        trial = low + self.side * first
        for _ in range(_END_TRIALS):
            rows = np.flatnonzero(np.isnan(ends))
            if not rows.size:
                break
            at = np.clip(trial[rows], floor[rows], ceiling[rows])
            root, values[rows] = self._fit_held(values[rows], at, rows)
            out = root > 0
            at_limit = ~out & (
                (at <= floor[rows]) & (self.side[rows] < 0) | (at >= ceiling[rows]) & (self.side[rows] > 0)
            )
            done = (np.abs(root) < _EXACT) | at_limit
            end = np.where(at_limit, np.where(self.side[rows] < 0, *self.limits), np.exp(at))
            ends[rows[done]] = end[done]
            moved = np.where(at == low[rows], 1.0, np.abs(at - low[rows]))
            reach = np.clip(moved * -root / np.maximum(root - below[rows], 1e-9), 0.1 * first[rows], 2.0)
            # A bound that stays for the second time counts half (Illinois rule).
            again = last[rows] == out
            above[rows] = np.where(out, root, np.where(again, above[rows] / 2, above[rows]))
            below[rows] = np.where(out, np.where(again, below[rows] / 2, below[rows]), root)
            high[rows], low[rows] = np.where(out, at, high[rows]), np.where(out, low[rows], at)
            last[rows] = out
            between = low[rows] - below[rows] * (high[rows] - low[rows]) / (above[rows] - below[rows])
            trial[rows] = np.where(np.isnan(high[rows]), low[rows] + self.side[rows] * reach, between)
        return np.where(np.isnan(ends), np.exp(np.clip(trial, floor, ceiling)), ends)

    def _never_reached(self, start: Array) -> Array:
        """Return 0 for lower ends of terms without which the model fits as well, NaN for all others."""
        ends = np.full(len(start), np.nan)
        rows = np.flatnonzero((self.side < 0) & ~np.isin(self.parameter, TIME))
        without = start[rows].copy()
        without[np.arange(len(rows)), self.parameter[rows]] = 0
        for sigma, time in zip(SIGMA, TIME, strict=True):
            without[without[:, sigma] == 0, time] = 0
        some = (without > 0).any(axis=1)
        rows, without = rows[some], without[some]
        rest = score(self.bins, without, without > 0, self.limits, self.power[rows], self.freedom[rows])
        ends[rows[rest.deviance - self.lowest[rows] < _DEVIANCE_95]] = 0.0
        return ends

    def _fit_held(self, values: Array, at: Array, rows: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the root of the deviance above its minimum, less that of the level, with the parameter held."""
        held, index = values.copy(), np.arange(len(rows))
        held[index, self.parameter[rows]] = np.exp(at)
        free = held > 0
        free[index, self.parameter[rows]] = False
        fitted = score(self.bins, held, free, self.limits, self.power[rows], self.freedom[rows])
        root = np.sqrt(np.maximum(fitted.deviance - self.lowest[rows], 0)) - np.sqrt(_DEVIANCE_95)
        # A term that vanished here may be there again at the next trial.
        return root, np.where(fitted.values > 0, fitted.values, np.where(np.isin(np.arange(8), TIME), held, 0.1 * held))
