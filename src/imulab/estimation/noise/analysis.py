"""The noise of one column, from its stretches at rest to a model: band, allowance, candidates, intervals, test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from imulab.estimation.noise.band import Allowance, Band, allow, usable_band, within
from imulab.estimation.noise.choice import CANDIDATES, Averaged, Choice, average, choose
from imulab.estimation.noise.cleaning import STEP, Step, find_steps, step_coefficients
from imulab.estimation.noise.cosine import Stretch, variances_of_coefficients
from imulab.estimation.noise.intervals import profile
from imulab.estimation.noise.likelihood import Flags, fit, time_limits
from imulab.estimation.noise.moments import Fit, test_of_fit
from imulab.estimation.noise.regression import Regression, regress, without
from imulab.estimation.noise.spectrum import Spectrum
from imulab.estimation.noise.terms import Bins, letters, prepare, terms
from imulab.recording import Array

_RICHEST = "NGGK"


@dataclass(frozen=True)
class Analysis:
    """The noise of a column.

    Attributes
    ----------
    stretches
        What it was found from.
    band, allowance
        Up to which frequency, and how exactly, a model is held against the spectra.
    limits
        Least and greatest time constant, s.
    choice
        The candidates, fitted, c = 1.
    """

    stretches: tuple[Stretch, ...]
    band: Band
    allowance: Allowance
    limits: tuple[float, float]
    choice: Choice

    @property
    def spectra(self) -> tuple[Spectrum, ...]:
        """The spectra with what counts of them."""
        return self.allowance.spectra

    @cached_property
    def bins(self) -> Bins:
        """The bins of all spectra."""
        return prepare(self.spectra)

    @property
    def interval(self) -> float:
        """Time between samples, s."""
        return self.stretches[0].interval

    @property
    def length(self) -> float:
        """Length of the longest stretch, s."""
        return max(each.count for each in self.stretches) * self.interval

    @property
    def index(self) -> int:
        """Which candidate is chosen."""
        return int(self.choice.chosen[0])

    @property
    def model(self) -> Flags:
        """Which parameters the chosen candidate has, shape (8,)."""
        return np.asarray(self.choice.models[0, self.index])

    @property
    def letters(self) -> str:
        """The terms of the chosen candidate."""
        return letters(self.model)

    @property
    def values(self) -> Array:
        """Parameters of the chosen candidate, shape (8,)."""
        return np.asarray(self.choice.values[0, self.index])

    @property
    def covariance(self) -> Array:
        """Of the logarithms of these, shape (8, 8)."""
        return np.asarray(self.choice.covariance[0, self.index])

    @cached_property
    def test(self) -> Fit:
        """The test of fit of the chosen candidate."""
        return test_of_fit(self.spectra, self.values, self.band.highest)

    def intervals(self, model: Flags | None = None) -> tuple[Array, Array]:
        """Return the ends of 95 % intervals, shapes (8,), of the chosen candidate or of it with more terms."""
        models = (self.model if model is None else model | self.model)[None]
        low, high = profile(
            self.bins, self.values[None], models, self.limits, self.bins.power[None], self.bins.freedom[None]
        )
        return low[0], high[0]

    def average(self, square: Callable[[Array], Array]) -> Averaged:
        """Return a variance over all candidates; see `choice.average`."""
        return average(self.choice, square)

    def variances(self) -> list[Array]:
        """Return the variance of the coefficients in the bins of each spectrum, (b,)."""
        return _split(self.bins.variances(self.values[None])[0], self.spectra)

    def steps(self, stretches: Sequence[Stretch], limit: float = STEP) -> list[tuple[Step, ...]]:
        """Return the changes of level of stretches, its own or these before something was taken out, by its noise."""
        found, start = [], 0
        variances = self.variances()
        for each in stretches:
            stop = start + len(each.spectra)
            level = variances_of_coefficients(variances[start:stop], each)
            found.append(find_steps(each.slow, level, each.count, each.interval, limit))
            start = stop
        return found

    def regressed(self, covariates: Sequence[Array]) -> Regression:
        """Return how the column follows covariates: of each stretch their slow coefficients, shape (k, J)."""
        return regress(self.stretches, covariates, self._refit)

    def _refit(self, spectra: Sequence[Spectrum]) -> tuple[Sequence[Array], float]:
        """The chosen model fitted to spectra that count what those of the analysis do."""
        bins = prepare(
            [
                Spectrum(s.interval, s.count, s.first, s.last, s.power, mine.freedom)
                for s, mine in zip(spectra, self.spectra, strict=True)
            ]
        )
        found = fit(bins, self.model[None], self.limits, bins.power[None], bins.freedom[None])
        return _split(bins.variances(found.values)[0], self.spectra), float(found.deviance[0])


def analysed(
    stretches: Sequence[Stretch], candidates: tuple[str, ...] = CANDIDATES, highest: float | None = None
) -> Analysis:
    """Return the noise of a column from its stretches at rest, of one sampling rate.

    Parameters
    ----------
    stretches
        One or more, whose deviances add up.
    candidates
        Letters of the models; a single one is fitted as it is.
    highest
        Up to which frequency, Hz; found from the spectra if not given.
    """
    return analyses([stretches], candidates, highest)[0]


def analyses(
    columns: Sequence[Sequence[Stretch]], candidates: tuple[str, ...] = CANDIDATES, highest: float | None = None
) -> list[Analysis]:
    """Return the noise of columns with the same times, all at once: see `analysed`."""
    spectra = [[each for stretch in stretches for each in stretch.spectra] for stretches in columns]
    nyquist = 0.5 / columns[0][0].interval
    bands = [
        usable_band(each) if highest is None else Band(min(highest, nyquist), highest >= nyquist) for each in spectra
    ]
    found: dict[int, Analysis] = {}
    for band in dict.fromkeys(bands):
        alike = [k for k, its in enumerate(bands) if its == band]
        fitted = _of_one_band([spectra[k] for k in alike], band, candidates)
        found |= {k: Analysis(tuple(columns[k]), band, *its) for k, its in zip(alike, fitted, strict=True)}
    return [found[k] for k in range(len(columns))]


def _of_one_band(
    columns: Sequence[Sequence[Spectrum]], band: Band, candidates: tuple[str, ...]
) -> list[tuple[Allowance, tuple[float, float], Choice]]:
    inside = [[within(each, band.highest) for each in spectra] for spectra in columns]
    bins, limits = prepare(inside[0]), time_limits(inside[0])
    power = np.array([np.concatenate([each.power for each in spectra]) for spectra in inside])
    freedom = np.array([np.concatenate([each.freedom for each in spectra]) for spectra in inside])
    richest = terms(_RICHEST + "Q" * band.full)[None]
    variances = bins.variances(fit(bins, richest, limits, power, freedom).values)
    allowances = [allow(spectra, _split(each, spectra)) for spectra, each in zip(inside, variances, strict=True)]
    freedom = np.array([np.concatenate([each.freedom for each in allowance.spectra]) for allowance in allowances])
    choice = choose(bins, limits, power, freedom, candidates, full_band=band.full and band.flat)
    parts = [Choice(*(getattr(choice, name)[k : k + 1] for name in Choice.__annotations__)) for k in range(len(power))]
    return [(allowance, limits, part) for allowance, part in zip(allowances, parts, strict=True)]


def intervals_of(found: Sequence[Analysis], index: Sequence[int]) -> list[tuple[Array, Array]]:
    """Return the ends of 95 % intervals, shapes (8,), of one candidate of each column, columns as in `analyses`."""
    ends: dict[int, tuple[Array, Array]] = {}
    for limits in dict.fromkeys(each.limits for each in found):
        alike = [k for k, each in enumerate(found) if each.limits == limits]
        bins = [found[k].bins for k in alike]
        values, models = (
            np.array([getattr(found[k].choice, name)[0, index[k]] for k in alike]) for name in ("values", "models")
        )
        power, freedom = np.array([each.power for each in bins]), np.array([each.freedom for each in bins])
        parts = profile(bins[0], values, models, limits, power, freedom)
        ends |= dict(zip(alike, zip(*parts, strict=True), strict=True))
    return [ends[k] for k in range(len(found))]


def without_steps(stretches: Sequence[Stretch], steps: Sequence[Sequence[Step]]) -> list[Stretch]:
    """Return stretches without the changes of level that were found in them."""
    cleaned = []
    for stretch, its in zip(stretches, steps, strict=True):
        for step in its:
            unit = step_coefficients(len(stretch.slow), step.time / stretch.interval, stretch.count)
            stretch = without(stretch, step.size * unit)
        cleaned.append(stretch)
    return cleaned


def _split(variances: Array, spectra: Sequence[Spectrum]) -> list[Array]:
    return np.split(variances, np.cumsum([len(each.power) for each in spectra])[:-1])
