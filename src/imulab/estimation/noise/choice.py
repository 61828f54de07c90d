"""Which terms the noise of a record has, and what all models that it allows say together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.noise.likelihood import Fits, Flags, fit
from imulab.estimation.noise.terms import NAMES, Bins, terms
from imulab.recording import Array

CANDIDATES = ("N", "NK", "NB", "NG", "NBK", "NGK", "NGB", "NGG", "NGGK")
PER_PARAMETER, _RIVAL, _QUANTISATION = 4.0, 4.0, 12.0
"""What a parameter must gain in deviance, how near a rival is, what quantisation noise must gain."""
_LARGEST_VARIANCE = 2.0
"""Of the logarithm of a square: beyond it the expansion that it comes from says nothing more."""
_HALVINGS = 60


@dataclass(frozen=True)
class Choice:
    """Candidate models fitted to the spectra of columns.

    Attributes
    ----------
    models
        Which parameters each candidate has, shape (c, m, 8), c columns and m candidates.
    values, deviance, covariance
        As in `likelihood.Fits`, shapes (c, m, 8), (c, m) and (c, m, 8, 8).
    """

    models: Flags
    values: Array
    deviance: Array
    covariance: Array

    @property
    def _cost(self) -> Array:
        return np.asarray(self.deviance + PER_PARAMETER * self.models.sum(axis=-1))

    @property
    def chosen(self) -> NDArray[np.int64]:
        """The candidate of the least deviance plus 4 for each parameter, shape (c,)."""
        return np.asarray(self._cost.argmin(axis=-1))

    @property
    def rivals(self) -> Flags:
        """Candidates within 4 of the chosen one, shape (c, m)."""
        near = self._cost - self._cost.min(axis=-1, keepdims=True) < _RIVAL
        near[np.arange(len(near)), self.chosen] = False
        return np.asarray(near)

    @property
    def weights(self) -> Array:
        """``exp(-deviance/2 - parameters)`` over their sum, shape (c, m).

        A parameter counts half of what it does in the choice: with the same price averages are too sure of the fewest
        terms, and the mean over a tenth of a log of a Gauss-Markov process as long is within 2 u in 87 %, not 91 %.
        """
        exponent = self.deviance / 2 + self.models.sum(axis=-1)
        weights = np.exp(exponent.min(axis=-1, keepdims=True) - exponent)
        return np.asarray(weights / weights.sum(axis=-1, keepdims=True))


def choose(
    bins: Bins,
    limits: tuple[float, float],
    power: Array,
    freedom: Array,
    candidates: tuple[str, ...] = CANDIDATES,
    full_band: bool = False,
) -> Choice:
    """Fit candidate models to the spectra of columns.

    Quantisation noise joins all candidates of a column where it gains 12 in the best one; it shows only in spectra that
    reach up to half the sampling rate (`full_band`).

    Parameters
    ----------
    bins, limits, power, freedom
        As for `likelihood.fit`; power and freedom have shape (c, b).
    candidates
        Letters of the models; a single one is fitted as it is.
    full_band
        Whether the spectra reach up to half the sampling rate.
    """
    models = np.array([terms(each) for each in candidates])
    found = _fitted(bins, models, limits, power, freedom)
    if not full_band or len(candidates) == 1:
        return found
    best = found.chosen
    with_q = models | terms("Q")
    joins = np.zeros(len(power), dtype=np.bool_)
    for index in sorted(set(best.tolist())):
        columns = np.flatnonzero(best == index)
        tried = fit(bins, with_q[index : index + 1], limits, power[columns], freedom[columns])
        joins[columns] = found.deviance[columns, index] - tried.deviance >= _QUANTISATION
    if not joins.any():
        return found
    again = _fitted(bins, with_q, limits, power[joins], freedom[joins])
    for name in Choice.__annotations__:
        getattr(found, name)[joins] = getattr(again, name)
    return found


def _fitted(bins: Bins, models: Flags, limits: tuple[float, float], power: Array, freedom: Array) -> Choice:
    found: Fits = fit(bins, models, limits, power, freedom)
    shape = (len(power), len(models))
    return Choice(
        np.repeat(models[None], len(power), axis=0),
        found.values.reshape(*shape, -1),
        found.deviance.reshape(shape),
        found.covariance.reshape(*shape, len(NAMES), len(NAMES)),
    )


@dataclass(frozen=True)
class Averaged:
    """A positive quantity, a variance, as all candidates together have it: a mixture of lognormal distributions.

    Attributes
    ----------
    squares
        Of each candidate, shape (c, m, t).
    spread
        Variance of the logarithms of these, shape (c, m, t).
    weights
        Of the candidates, shape (c, m).
    """

    squares: Array
    spread: Array
    weights: Array

    @property
    def mean(self) -> Array:
        """Weighted mean of the squares, shape (c, t)."""
        return np.asarray(np.einsum("cm,cmt->ct", self.weights, self.squares))

    @property
    def expected(self) -> Array:
        """Weighted mean of the expectations ``square exp(spread/2)``, shape (c, t)."""
        return np.asarray(np.einsum("cm,cmt->ct", self.weights, self.squares * np.exp(self.spread / 2)))

    def quantile(self, probability: float) -> Array:
        """Return what the square is below with a probability, shape (c, t); 0 where that is the share of no noise."""
        from imulab.estimation.special import ndtr

        with np.errstate(divide="ignore"):
            centre = np.log(self.squares)
        width = np.sqrt(self.spread) + 1e-9
        finite = np.isfinite(centre)
        low = np.where(finite, centre - 9 * width, np.inf).min(axis=1)
        high = np.where(finite, centre + 9 * width, -np.inf).max(axis=1)
        nothing = (self.weights[:, :, None] * ~finite).sum(axis=1) >= probability
        low, high = np.where(nothing, 0.0, low), np.where(nothing, 0.0, high)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            below = np.einsum("cm,cmt->ct", self.weights, ndtr((middle[:, None] - centre) / width))
            low, high = np.where(below < probability, middle, low), np.where(below < probability, high, middle)
        return np.where(nothing, 0.0, np.exp(high))


def average(choice: Choice, square: Callable[[Array], Array]) -> Averaged:
    """Return a quantity over all candidates, with the uncertainty that the covariance of each gives it.

    Parameters
    ----------
    choice
        The fitted candidates of columns.
    square
        Parameters (..., 8) -> variance (..., t), for example `allan_variance` at some averaging times.
    """
    step = 1e-4
    shifts = np.concatenate([np.zeros((1, len(NAMES))), step * np.eye(len(NAMES)), -step * np.eye(len(NAMES))])
    each = square(choice.values[..., None, :] * np.exp(shifts))
    safe = np.maximum(each, 1e-300)
    slope = np.log(safe[..., 1 : len(NAMES) + 1, :] / safe[..., len(NAMES) + 1 :, :]) / (2 * step)
    spread = np.einsum("cmpt,cmpq,cmqt->cmt", slope, choice.covariance, slope)
    return Averaged(each[..., 0, :], np.clip(spread, 0, _LARGEST_VARIANCE), choice.weights)
