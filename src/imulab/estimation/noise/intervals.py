"""Intervals of the parameters of a noise model from the profile of its likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.noise.likelihood import Flags, score, with_a_little
from imulab.estimation.noise.terms import LINEAR, SIGMA, TIME, Bins
from imulab.estimation.ranked import NORMAL_95
from imulab.recording import Array

_LEVEL = 3.84
"""The 95 % point of chi-square with one degree of freedom."""
_ROUNDS, _EXACT = 14, 0.01
"""Trials for an end at most, and how close the root of the deviance must come to that of the level."""
_FIRST = 1.0
"""The longest first step of a logarithm."""


def profile(
    bins: Bins, values: Array, models: Flags, limits: tuple[float, float], power: Array, freedom: Array
) -> tuple[Array, Array]:
    """Return the lower and upper ends of the 95 % intervals of the parameters of best fits, shapes (r, 8).

    An end is where the deviance, least in all other parameters, is 3.84 above its minimum. A lower end that is never
    reached is 0, an end of a time constant its limit. Parameters that a model has not got have NaN.

    Parameters
    ----------
    bins, limits
        As for `likelihood.fit`.
    values
        The best fits, shape (r, 8).
    models
        Which parameters each model has, shape (r, 8).
    power, freedom
        Of the spectrum of each row, shape (r, b).
    """
    best = score(bins, values, values > 0, limits, power, freedom)
    row, parameter = (np.repeat(each, 2) for each in np.nonzero(models))
    side = np.tile([-1.0, 1.0], len(row) // 2)
    ends = _Ends(bins, limits, power[row], freedom[row], best.deviance[row], parameter, side)
    # What is nothing in the best fit may be something when another parameter is held.
    start = with_a_little(bins, best.values, models, limits)[row]
    absent = best.values[row, parameter] == 0
    spread = np.sqrt(best.covariance[row, parameter, parameter])
    start[absent, parameter[absent]], spread[absent] = ends.just_visible(best.values[row[absent]], absent), _FIRST
    found = np.full((2, *values.shape), np.nan)
    found[(side > 0).astype(int), row, parameter] = ends.find(start, np.clip(NORMAL_95 * spread, 1e-6, _FIRST))
    return found[0], found[1]


@dataclass(frozen=True)
class _Ends:
    """One end of the interval of one parameter in each row."""

    bins: Bins
    limits: tuple[float, float]
    power: Array
    freedom: Array
    lowest: Array
    parameter: NDArray[np.int64]
    side: Array

    def just_visible(self, values: Array, absent: Flags) -> Array:
        """A tenth of the size at which terms that the best fit has not got would show; a time constant as it is."""
        parameter = self.parameter[absent]
        middle = np.full(len(parameter), np.sqrt(self.limits[0] * self.limits[1]))
        unit = self.bins.markov(middle)[0]
        linear = parameter < LINEAR
        unit[linear] = self.bins.unit[parameter[linear]]
        information = 0.5 * (self.freedom[absent] * (unit / self.bins.variances(values)) ** 2).sum(axis=1)
        return np.where(np.isin(parameter, TIME), middle, 0.1 * information**-0.25)

    def find(self, values: Array, first: Array) -> Array:
        """Find the ends by secants of the root of the deviance, from best values and first steps of logarithms."""
        timed = np.isin(self.parameter, TIME)
        floor, ceiling = (
            np.where(timed, np.log(edge), far) for edge, far in zip(self.limits, (-700, 700), strict=True)
        )
        values, found = values.copy(), self._never_reached(values)
        low = np.log(values[np.arange(len(values)), self.parameter])
        below = np.full(len(low), -np.sqrt(_LEVEL))
        high, above, last = np.full((3, len(low)), np.nan)
        trial = low + self.side * first
        for _ in range(_ROUNDS):
            rows = np.flatnonzero(np.isnan(found))
            if not rows.size:
                break
            at = np.clip(trial[rows], floor[rows], ceiling[rows])
            root, values[rows] = self._held(values[rows], at, rows)
            out = root > 0
            at_limit = ~out & (
                (at <= floor[rows]) & (self.side[rows] < 0) | (at >= ceiling[rows]) & (self.side[rows] > 0)
            )
            done = (np.abs(root) < _EXACT) | at_limit
            end = np.where(at_limit, np.where(self.side[rows] < 0, *self.limits), np.exp(at))
            found[rows[done]] = end[done]
            moved = np.where(at == low[rows], 1.0, np.abs(at - low[rows]))
            reach = np.clip(moved * -root / np.maximum(root - below[rows], 1e-9), 0.1 * first[rows], 2.0)
            # A bound that stays where it was for the second time counts half (the Illinois rule).
            again = last[rows] == out
            above[rows] = np.where(out, root, np.where(again, above[rows] / 2, above[rows]))
            below[rows] = np.where(out, np.where(again, below[rows] / 2, below[rows]), root)
            high[rows], low[rows] = np.where(out, at, high[rows]), np.where(out, low[rows], at)
            last[rows] = out
            between = low[rows] - below[rows] * (high[rows] - low[rows]) / (above[rows] - below[rows])
            trial[rows] = np.where(np.isnan(high[rows]), low[rows] + self.side[rows] * reach, between)
        return np.where(np.isnan(found), np.exp(np.clip(trial, floor, ceiling)), found)

    def _never_reached(self, start: Array) -> Array:
        """0 for lower ends of terms without which the model fits as well, NaN for all others."""
        found = np.full(len(start), np.nan)
        rows = np.flatnonzero((self.side < 0) & ~np.isin(self.parameter, TIME))
        without = start[rows].copy()
        without[np.arange(len(rows)), self.parameter[rows]] = 0
        for sigma, time in zip(SIGMA, TIME, strict=True):
            without[without[:, sigma] == 0, time] = 0
        some = (without > 0).any(axis=1)
        rows, without = rows[some], without[some]
        rest = score(self.bins, without, without > 0, self.limits, self.power[rows], self.freedom[rows])
        found[rows[rest.deviance - self.lowest[rows] < _LEVEL]] = 0.0
        return found

    def _held(self, values: Array, at: Array, rows: NDArray[np.int64]) -> tuple[Array, Array]:
        """Root of the deviance above its minimum, less that of the level, with the parameter held, and the best fit."""
        held, index = values.copy(), np.arange(len(rows))
        held[index, self.parameter[rows]] = np.exp(at)
        free = held > 0
        free[index, self.parameter[rows]] = False
        fitted = score(self.bins, held, free, self.limits, self.power[rows], self.freedom[rows])
        root = np.sqrt(np.maximum(fitted.deviance - self.lowest[rows], 0)) - np.sqrt(_LEVEL)
        # What vanished here may be something again at the next trial.
        return root, np.where(fitted.values > 0, fitted.values, np.where(np.isin(np.arange(8), TIME), held, 0.1 * held))
