"""Test of whether two sets of spectra show the same noise: by the terms of a model, and octave by octave without one.

Sources: the likelihood ratio of one common model against one model for each set, scaled by its mean over spectra drawn
from the common model (Bartlett 1937); ratios of mean squares in octaves, which are F variables whatever the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.distributions import chi_square_tail, f_quantile, f_tail, normal_cdf, normal_quantile
from imulab.estimation.noise.analysis import CANDIDATES, choose
from imulab.estimation.noise.likelihood import Flags, score, time_limits
from imulab.estimation.noise.spectrum import Spectrum, frequencies
from imulab.estimation.noise.terms import Bins, prepare
from imulab.recording import Array

_DRAWS = 100  # spectra drawn from the common model, which show how the two tests are correlated
_TAIL = 0.025  # on both sides of a 95 % interval
_SMALLEST, _LARGEST, _MOST_ALIKE, _LARGEST_SCORE = 1e-12, 1 - 1e-9, 0.99, 9.0
"""Limits of probabilities, correlations and normal scores, within which all formulas are finite."""


@dataclass(frozen=True)
class Octaves:
    """Mean squares of the second set over those of the first, octave by octave.

    Attributes
    ----------
    low, high
        Ends of each octave, Hz, shape (o,).
    ratio
        Ratio of the mean squares, each over the common model, shape (..., o).
    freedom
        Number of coefficients in both sets, shape (2, o).
    tolerance
        Relative change of size that the test allows.
    """

    low: Array
    high: Array
    ratio: Array
    freedom: Array
    tolerance: float = 0.0

    @property
    def allowed(self) -> Array:
        """Part of the ratio that the tolerance explains, shape (..., o)."""
        most = (1 + self.tolerance) ** 2
        return np.clip(self.ratio, 1 / most, most)

    @property
    def scores(self) -> Array:
        """Normal scores of the ratio beyond the tolerance, (..., o): standard normal for one noise, no tolerance."""
        left = self.ratio / self.allowed
        upper = f_tail(left, self.freedom[1], self.freedom[0])
        lower = f_tail(1 / left, self.freedom[0], self.freedom[1])
        tail = np.maximum(np.minimum(upper, lower), 1e-300)
        return np.asarray(np.where(upper < lower, 1.0, -1.0) * -normal_quantile(tail))

    @property
    def probability(self) -> Array:
        """Probability of so large a sum of squared scores if both sets are of the same noise, shape (...)."""
        return np.asarray(chi_square_tail(np.sum(self.scores**2, axis=-1), max(len(self.low), 1)))

    @property
    def interval(self) -> tuple[Array, Array]:
        """Ends of the 95 % interval of the ratio of the two powers, shapes (..., o)."""
        d1, d2 = self.freedom
        return self.ratio / f_quantile(1 - _TAIL, d2, d1), self.ratio / f_quantile(_TAIL, d2, d1)


@dataclass(frozen=True)
class Agreement:
    """Result of the test of whether two sets are of the same noise.

    Attributes
    ----------
    model
        Terms of the common model, shape (8,).
    terms_probability
        Probability of so large a likelihood ratio if both sets are of the same noise.
    octaves
        Ratios by octave.
    probability
        Probability that either test gives a probability as small as the smaller of the two, for the same noise.
    """

    model: Flags
    terms_probability: float
    octaves: Octaves
    probability: float


def agreement(
    first: Sequence[Spectrum],
    second: Sequence[Spectrum],
    highest: float,
    *,
    tolerance: float = 0.0,
    candidates: tuple[str, ...] = CANDIDATES,
    full_band: bool = False,
) -> Agreement:
    """Return the test of whether two sets of spectra of one sampling rate are of the same noise, within a tolerance.

    Of all changes within the tolerance, octave by octave, the one that brings the sets closest is tested. Spectra drawn
    from the common model give the mean of the likelihood ratio and the correlation of the two tests.

    Parameters
    ----------
    first, second
        Spectra of the two sets.
    highest
        Highest frequency that counts, Hz.
    tolerance
        Relative change of the size of the noise in an octave that the test allows.
    candidates, full_band
        For the choice of the common model, as for `choose`.
    """
    spectra = [*first, *second]
    bins, limits = prepare(spectra), time_limits(spectra)
    of_first = np.arange(len(bins.freedom)) < sum(len(each.power) for each in first)
    choice = choose(bins, limits, bins.power[None], bins.freedom[None], candidates, full_band)
    best = int(choice.chosen[0])
    values, model = choice.values[0, best], choice.models[0, best]
    variance = bins.variances(values[None])[0]
    used = np.maximum(bins.freedom, 1e-9)
    drawn = variance * np.random.default_rng(1).chisquare(used, (_DRAWS, len(used))) / used
    octaves = _octaves(spectra, of_first, np.concatenate([bins.power[None], drawn]) / variance, highest)
    held = replace(octaves, ratio=octaves.ratio[0], tolerance=tolerance)
    eased = np.where(of_first, bins.power, bins.power / _allowed(spectra, held, highest))
    ratios = _likelihood_ratios(bins, of_first, values, limits, np.concatenate([eased[None], drawn]))
    count = int(np.count_nonzero(values > 0))
    by_terms = chi_square_tail(count * ratios / max(float(ratios[1:].mean()), 1e-9), count)
    scores = normal_quantile(np.clip([by_terms[1:], octaves.probability[1:]], _SMALLEST, _LARGEST))
    together = _either(
        min(float(by_terms[0]), float(held.probability)), float(np.atleast_2d(np.corrcoef(scores))[0, 1])
    )
    return Agreement(model, float(by_terms[0]), held, together)


def _either(least: float, correlation: float) -> float:
    """Return the probability that one of two correlated tests gives a probability of `least` or below.

    ``2 p - int_c^inf phi(x) Phi((rho x - c)/sqrt(1 - rho^2)) dx``, c the normal score of p, rho the correlation of the
    scores. A number of independent tests in place of rho put 4 % too many pairs below 0.5.
    """
    rho = min(max(correlation, 0.0), _MOST_ALIKE)
    start = max(float(-normal_quantile(min(max(least, 1e-300), _LARGEST))), -_LARGEST_SCORE)
    x = np.linspace(start, start + _LARGEST_SCORE, 2001)
    both = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi) * normal_cdf((rho * x - start) / np.sqrt(1 - rho**2))
    return float(np.clip(2 * least - (both.sum() - (both[0] + both[-1]) / 2) * (x[1] - x[0]), 0, 1))


def _likelihood_ratios(bins: Bins, of_first: Flags, values: Array, limits: tuple[float, float], power: Array) -> Array:
    """Return twice the log likelihood ratios of powers, shape (r, b), each fitted from the common model's values on."""
    start = np.broadcast_to(values, (len(power), len(values)))
    deviances = []
    for part in (of_first | ~of_first, of_first, ~of_first):
        counted = np.broadcast_to(np.where(part, bins.freedom, 0.0), power.shape)
        deviances.append(score(bins, start, start > 0, limits, power, counted).deviance)
    return np.maximum(deviances[0] - deviances[1] - deviances[2], 0.0)


def _octaves(spectra: Sequence[Spectrum], of_first: Flags, relative: Array, highest: float) -> Octaves:
    """Return the octaves below `highest` that both sets have, from powers over the model, shape (r, b)."""
    below = np.concatenate([_octave(each, highest) for each in spectra])
    inside = below == np.arange(int(below.max()) + 1)[:, None]
    freedom = np.concatenate([each.freedom for each in spectra])
    counts = [(inside & part) * freedom for part in (of_first, ~of_first)]
    total = np.array([each.sum(axis=1) for each in counts])
    kept = np.flatnonzero((total >= 1).all(axis=0))[::-1]
    mean = [relative @ each[kept].T / many[kept] for each, many in zip(counts, total, strict=True)]
    edge = highest / np.exp2(kept.astype(np.float64))
    return Octaves(edge / 2, edge, mean[1] / mean[0], total[:, kept])


def _allowed(spectra: Sequence[Spectrum], octaves: Octaves, highest: float) -> Array:
    """Return the part of each bin's ratio that the tolerance explains, shape (b,); 1 in octaves without a ratio."""
    below = np.concatenate([_octave(each, highest) for each in spectra])
    factor = np.ones(int(below.max()) + 1)
    factor[np.rint(np.log2(highest / octaves.high)).astype(np.int64)] = octaves.allowed
    return np.asarray(factor[below])


def _octave(spectrum: Spectrum, highest: float) -> NDArray[np.int64]:
    """Return the number of each bin's octave below `highest`, Hz, counted from 0, shape (b,)."""
    return np.floor(np.log2(highest / np.minimum(frequencies(spectrum), highest))).astype(np.int64)
