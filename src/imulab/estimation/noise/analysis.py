"""The noise of one column: candidate models, the choice among them, drift with a covariate, and the test of fit.

Sources: generalised least squares for the drift (the cosine coefficients of the noise are independent, with the model's
variances); Guerrier, Skaloud, Stebler and Victoria-Feser (2013) for the test of fit by Allan variances. The record is
continued by its mirror image, which makes its Allan variances sums over squares of cosine coefficients, whose
covariance is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.decisions import FOLLOWS_COVARIATE, LEVEL_STEP
from imulab.estimation.distributions import chi_square_tail, normal_cdf
from imulab.estimation.noise.cleaning import MOST_STEPS, LevelChange, find_steps, step_coefficients
from imulab.estimation.noise.likelihood import (
    Allowance,
    Band,
    Fits,
    Flags,
    allow,
    fit,
    profile,
    time_limits,
    usable_band,
    within,
)
from imulab.estimation.noise.spectrum import Spectrum, Stretch, binned, variances_of_coefficients
from imulab.estimation.noise.terms import NAMES, Bins, letters, prepare, terms
from imulab.estimation.rows import median
from imulab.recording import Array

# Drift with a covariate, time or temperature, separated from slow noise by least squares under the noise model.


Refit = Callable[[Sequence[Spectrum]], tuple[Sequence[Array], float]]
"""Fits a model to spectra; returns its variance in each bin of each spectrum, (b,), and its deviance."""
# How often regression and noise model are fitted in turn, at least and at most, and the change of the slopes, in their
# uncertainties, that ends it
_REGRESSION_ROUNDS, _MOST_ROUNDS, _SETTLED = 3, 12, 0.01
_STANDS = 1e-9  # such a change that ends it at once: the rounds to come would change no more
_RAMP_COEFFICIENTS = 1 << 16  # lowest coefficients of a ramp that are used: they fall with the square of the frequency
_HIDES = 0.1
"""Variance of a coefficient by what a covariate's rounding hides, over its noise, from which it is left out."""
# Price of a covariate in deviance, as of a term of the model; further fall of the deviance that is asked for
_PENALTY, _GAIN = 4.0, 6.0


@dataclass(frozen=True)
class Regression:
    """Linear dependence of samples on covariates.

    Attributes
    ----------
    slope, standard_uncertainty
        In the unit of the samples over that of the covariate, shape (k,).
    gain
        Fall of the deviance when the dependence on all covariates is removed.
    residual
        The stretches without that dependence.
    """

    slope: Array
    standard_uncertainty: Array
    gain: float
    residual: tuple[Stretch, ...]

    @property
    def follows(self) -> bool:
        """Whether a slope exceeds 3 standard uncertainties and the deviance falls by 6 beyond 4 for each covariate."""
        z = np.abs(self.slope) / self.standard_uncertainty
        return bool(z.max() > FOLLOWS_COVARIATE.limit and self.gain - _PENALTY * len(z) >= _GAIN)


def ramp_coefficients(stretch: Stretch) -> Array:
    """Return the lowest cosine coefficients of time, s, over a stretch, shape (J,), J <= 65536."""
    n = stretch.count
    ramp = np.zeros(min(len(stretch.slow), _RAMP_COEFFICIENTS))
    j = np.arange(1, len(ramp) + 1, 2)  # a ramp has no even ones
    # sum_i i cos(pi j (i + 1/2)/n) = -(1 - (-1)^j)/(4 sin^2(pi j/2n)) cos(pi j/2n)
    half = np.pi * j / (2 * n)
    ramp[::2] = -np.sqrt(2 / n) * stretch.interval * np.cos(half) / (2 * np.sin(half) ** 2)
    return ramp


def regress(
    stretches: Sequence[Stretch],
    covariates: Sequence[Array],
    refit: Refit,
    rounds: int = _REGRESSION_ROUNDS,
    hidden: Sequence[Array] = (),
) -> Regression:
    """Return the dependence of stretches on covariates, fitted in turn with the noise model until both rest.

    ``b = (X' V^-1 X)^-1 X' V^-1 c``, with the cosine coefficients c of all stretches one below the other. V is the
    variance of the noise, Lambda, and where readings of the covariate are rounded ``b^2 H' H``, H what that hides.
    Coefficients in which it hides more than a tenth of the noise are left out of what remains: slow noise there cannot
    be told from it.

    Parameters
    ----------
    stretches
        One or more stretches of the same column.
    covariates
        For each stretch the lowest coefficients of each covariate, shape (k, J); all k are fitted together.
    refit
        Fits the noise model to spectra.
    rounds
        How often at least.
    hidden
        For each stretch rows of unit variance of what the rounding of the only covariate hides, shape (h, J) with the
        lowest J; empty where nothing is hidden.
    """
    spectra = [each for stretch in stretches for each in stretch.spectra]
    variances, before = refit(spectra)
    hidden = hidden or [np.empty((0, 0))] * len(stretches)
    slope = np.zeros(len(np.atleast_2d(covariates[0])))
    cleaned: list[Stretch] = []
    for number in range(_MOST_ROUNDS):
        last = slope
        slope, covariance = _slopes(stretches, covariates, variances, [last[0] * each for each in hidden])
        cleaned = [without(stretch, slope @ np.atleast_2d(x)) for stretch, x in zip(stretches, covariates, strict=True)]
        variances, after = refit([each for stretch in cleaned for each in stretch.spectra])
        change = float((np.abs(slope - last) / np.sqrt(np.diag(covariance))).max())
        if change < (_SETTLED if number + 1 >= rounds else _STANDS):
            break
    scaled = [slope[0] * each for each in hidden]
    slope, covariance = _slopes(stretches, covariates, variances, scaled)
    if any(each.size for each in hidden):
        cleaned = [_without_hidden(each, rows) for each, rows in zip(cleaned, scaled, strict=True)]
    return Regression(slope, np.sqrt(np.diag(covariance)), before - after, tuple(cleaned))


def _slopes(
    stretches: Sequence[Stretch], covariates: Sequence[Array], variances: Sequence[Array], hidden: Sequence[Array]
) -> tuple[Array, Array]:
    size, start = len(np.atleast_2d(covariates[0])), 0
    normal, right = np.zeros((size, size)), np.zeros(size)
    for stretch, covariate, rows in zip(stretches, covariates, hidden, strict=True):
        stop = start + len(stretch.spectra)
        x = np.atleast_2d(covariate)
        many = x.shape[1]
        weight = counted(stretch, many) / variances_of_coefficients(variances[start:stop], stretch, many)
        by_weight = x * weight
        normal += by_weight @ x.T
        right += by_weight @ stretch.slow[:many]
        if rows.any():
            lowest = np.s_[: rows.shape[1]]
            weighted = rows * weight[lowest]
            by_x = weighted @ x[:, lowest].T
            taken = np.linalg.solve(np.eye(len(rows)) + weighted @ rows.T, by_x)
            normal -= taken.T @ by_x
            right -= taken.T @ (weighted @ stretch.slow[lowest])
        start = stop
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return np.asarray(covariance @ right), covariance


def _without_hidden(stretch: Stretch, rows: Array) -> Stretch:
    """Return a stretch without the coefficients that rows of what is hidden, shape (h, J), move beyond its noise."""
    if not rows.any():
        return stretch
    spectrum = stretch.spectra[0]
    counts = (spectrum.freedom > 0) & (spectrum.last <= len(stretch.slow))
    noise = median(spectrum.power[counts]) if counts.any() else 0.0
    moved = np.zeros(len(stretch.slow))
    moved[: rows.shape[1]] = (rows**2).sum(axis=0)
    hidden = np.flatnonzero(moved > _HIDES * noise)
    used = stretch.used.copy()
    used[: hidden.max(initial=-1) + 1] = False
    return without(replace(stretch, used=used), np.zeros(len(stretch.slow)))


def counted(stretch: Stretch, many: int) -> Array:
    """Return the weights of the lowest coefficients, shape (many,): the shares of their bins' that count."""
    counts = np.zeros(many)
    for spectrum in stretch.spectra:
        share = np.minimum(spectrum.freedom / (spectrum.last - spectrum.first + 1), 1.0)
        scale, near = stretch.count / spectrum.count, 1e-12 * stretch.count
        start, stop = np.ceil(spectrum.first * scale - near), np.floor(spectrum.last[-1] * scale + near)
        edge = np.minimum(np.append(start, stop + 1).astype(np.int64) - 1, len(counts))
        counts[edge[0] : edge[-1]] = np.repeat(share, np.diff(edge))
    return np.where(stretch.used[:many], counts, 0.0)


def without(stretch: Stretch, taken: Array) -> Stretch:
    """Return a stretch with `taken`, shape (J,), subtracted from its J lowest coefficients and so from its spectra."""
    slow = np.concatenate([stretch.slow[: len(taken)] - taken, stretch.slow[len(taken) :]])
    spectrum = stretch.spectra[0]
    low = spectrum.last <= len(taken)
    edges = (spectrum.first[low], spectrum.last[low])
    power, freedom = spectrum.power.copy(), spectrum.freedom.copy()
    again = binned(slow[: len(taken)] ** 2, stretch.used, edges, spectrum.interval, spectrum.count)
    power[low], freedom[low] = again.power, np.minimum(freedom[low], again.freedom)
    return replace(stretch, slow=slow, spectra=(replace(spectrum, power=power, freedom=freedom), *stretch.spectra[1:]))


# Test of fit: Allan variances of a record against those of the model (generalised method of wavelet moments).


_SHORTEST, _LONGEST = 4.0, 10.0  # least tau f_max; least number of the longest tau in a record
_STEP = 1e-4  # relative change of a parameter from which slopes are computed
_NODES = 32  # midpoints of the integral of an Allan variance over a bin


@dataclass(frozen=True)
class MomentsFit:
    """How well a model describes the Allan variances of a record.

    Attributes
    ----------
    statistic, freedom, probability
        J, its degrees of freedom, and the probability of a larger J under the model; 1 where nothing can be tested.
    tau
        Averaging times, s, shape (t,).
    variance, predicted
        Allan variances of the record (continued by its mirror image) and of the model, shape (t,).
    values
        Parameters that fit the Allan variances best, one Gauss-Newton step from the model, shape (8,).
    """

    statistic: float
    freedom: int
    probability: float
    tau: Array
    variance: Array
    predicted: Array
    values: Array


def test_of_fit(spectra: Sequence[Spectrum], values: Array, highest: float) -> MomentsFit:
    """Return the test of a model by its Allan variances at octaves of averaging time from 4/f_max to L/10.

    ``J = r' Omega^-1 r``, r the difference of the cube roots, which are nearly normal (Wilson and Hilferty 1931), that
    is left after the parameters are fitted to it; Omega the covariance of the Allan variances under the model.

    Parameters
    ----------
    spectra
        Spectra that the model was fitted to.
    values
        Its parameters in the order of `NAMES`, shape (8,).
    highest
        f_max, Hz.
    """
    interval, length = spectra[0].interval, max(each.length for each in spectra)
    lowest = max(1, int(np.ceil(_SHORTEST / highest / interval - 1e-9)))
    octaves = max(0, int(np.floor(np.log2(max(length / _LONGEST / interval / lowest, 0.5)))) + 1)
    m = lowest * 2 ** np.arange(octaves)
    tau = m.astype(np.float64) * interval
    bins, present = prepare(spectra), np.flatnonzero(values > 0)
    nothing = MomentsFit(0.0, 0, 1.0, tau, np.empty(0), np.empty(0), values)
    if octaves <= len(present):
        return nothing
    weight = np.concatenate([_weights(each, m) for each in spectra], axis=1)
    counted = np.concatenate([_share(each) for each in spectra])
    kept = bins.freedom > 0
    weight[:, ~kept] = 0
    moved = np.tile(values, (len(present) + 1, 1))
    moved[np.arange(1, len(moved)), present] *= 1 + _STEP
    variance = bins.variances(moved)
    predicted = variance @ (weight * counted).T
    slope = ((predicted[1:] - predicted[0]) / _STEP).T
    spread = weight * counted * variance[0] * np.sqrt(2 / np.where(kept, bins.freedom, np.inf))
    observed = weight @ (counted * bins.power)
    scale = 1 / predicted[0]
    root = np.linalg.cholesky((spread * scale[:, None]) @ (spread * scale[:, None]).T)
    # The cube root of chi-square over its degrees of freedom is nearly normal, with the mean 1 - 2/(9 freedom).
    square = np.sum((spread * scale[:, None]) ** 2, axis=1)
    ratio = 3 * (np.cbrt(np.maximum(observed * scale, 0.0)) - (1 - square / 9))
    r = np.linalg.solve(root, ratio)
    basis = np.linalg.solve(root, slope * scale[:, None])
    step, _, rank, _ = np.linalg.lstsq(basis, r, rcond=1e-6)
    freedom = octaves - int(rank)
    statistic = float(np.sum((r - basis @ step) ** 2))
    better = values.copy()
    better[present] *= np.exp(np.clip(step, -2, 2))
    probability = float(chi_square_tail(statistic, freedom)) if freedom else 1.0
    return MomentsFit(statistic, freedom, probability, tau, observed, predicted[0], better)


def allan_of_bins(records: Sequence[Sequence[Spectrum]]) -> tuple[Array, Array]:
    """Return octaves of averaging time up to a quarter of a record, s, and the Allan variances there, shapes (t,).

    They are sums over the bins of each record, without its lines and without its samples. The record is continued by
    its mirror image. Records are weighted by the number of means in each.
    """
    interval, longest = records[0][0].interval, max(each.length for record in records for each in record)
    m = 2 ** np.arange(max(0, int(np.log2(longest / interval / 4))) + 1)
    total, weight = np.zeros(len(m)), np.zeros(len(m))
    for record in records:
        counts = np.maximum(max(each.length for each in record) / (m * interval) - 3, 0.0)
        for each in record:
            power = np.where(each.freedom > 0, each.power, 0.0)
            total += counts * (_weights(each, m) @ (_share(each) * power))
        weight += counts
    return np.asarray(m * interval, dtype=np.float64), np.asarray(total / weight)


def _share(spectrum: Spectrum) -> Array:
    """Return the share of all coefficients of the record in each bin, with those left out as lines."""
    return np.asarray((spectrum.last - spectrum.first + 1) / spectrum.count)


def _weights(spectrum: Spectrum, m: np.ndarray) -> Array:
    """Return the mean of ``2 sin^4(m w/2)/(m^2 sin^2(w/2))``, w = pi j/n, over bins, for means of m samples, (t, b)."""
    width = (spectrum.last - spectrum.first + 1).astype(np.float64)
    share = (np.arange(_NODES) + 0.5) / _NODES
    # Midpoints stand for the j of a bin; those of a narrow one are repeated.
    offset = np.floor(share * width[:, None])
    half = np.pi * (spectrum.first[:, None] + offset) / (2 * spectrum.count)
    over = 2 / np.square(np.sin(half))
    return np.stack([np.mean(np.square(np.square(np.sin(k * half)) / k) * over, axis=1) for k in m])


# Choice of the terms of a model, and quantities averaged over all candidate models.


CANDIDATES = ("N", "NK", "NB", "NG", "NBK", "NGK", "NGB", "NGG", "NGGK")
PER_PARAMETER, _RIVAL, _QUANTISATION = 4.0, 3.99, 12.0
"""Deviance that a parameter must gain; distance of a rival from the best, less than that of the same model with a term
that vanished, which rounding would decide; what quantisation noise must gain."""
_LARGEST_VARIANCE = 2.0
"""Largest variance of the logarithm of a square: the expansion that it comes from holds no farther."""
_HALVINGS = 60  # of a bracket that holds a quantile: to the last digit of a double


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
        """Candidate with the least deviance plus 4 for each parameter, shape (c,)."""
        return np.asarray(self._cost.argmin(axis=-1))

    @property
    def rivals(self) -> Flags:
        """Whether a candidate's cost is within 4 of the chosen one's, shape (c, m)."""
        near = self._cost - self._cost.min(axis=-1, keepdims=True) < _RIVAL
        near[np.arange(len(near)), self.chosen] = False
        return np.asarray(near)

    @property
    def weights(self) -> Array:
        """Weights of the candidates, ``exp(-deviance/2 - parameters)`` over their sum, shape (c, m).

        A parameter costs half of what it does in the choice. At the same price the averages favour the fewest terms too
        much: the mean over a tenth of a log of a Gauss-Markov process as long is within 2 u in 87 %, not 91 %.
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
    """Return the candidate models fitted to the spectra of columns.

    Quantisation noise joins all candidates of a column where the best one gains 12 by it. It shows only in spectra that
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
    choice = _fitted(bins, models, limits, power, freedom)
    if not full_band or len(candidates) == 1:
        return choice
    best = choice.chosen
    with_q = models | terms("Q")
    joins = np.zeros(len(power), dtype=np.bool_)
    for index in sorted(set(best.tolist())):
        columns = np.flatnonzero(best == index)
        tried = fit(bins, with_q[index : index + 1], limits, power[columns], freedom[columns])
        joins[columns] = choice.deviance[columns, index] - tried.deviance >= _QUANTISATION
    if not joins.any():
        return choice
    again = _fitted(bins, with_q, limits, power[joins], freedom[joins])
    for name in Choice.__annotations__:
        getattr(choice, name)[joins] = getattr(again, name)
    return choice


def _fitted(bins: Bins, models: Flags, limits: tuple[float, float], power: Array, freedom: Array) -> Choice:
    fits: Fits = fit(bins, models, limits, power, freedom)
    shape = (len(power), len(models))
    return Choice(
        np.repeat(models[None], len(power), axis=0),
        fits.values.reshape(*shape, -1),
        fits.deviance.reshape(shape),
        fits.covariance.reshape(*shape, len(NAMES), len(NAMES)),
    )


@dataclass(frozen=True)
class Averaged:
    """A variance averaged over all candidates: a mixture of lognormal distributions.

    Attributes
    ----------
    squares
        Variance by each candidate, shape (c, m, t).
    spread
        Variance of its logarithm, shape (c, m, t).
    weights
        Weights of the candidates, shape (c, m).
    """

    squares: Array
    spread: Array
    weights: Array

    @property
    def mean(self) -> Array:
        """Weighted mean of the variances, shape (c, t)."""
        return np.asarray(np.einsum("cm,cmt->ct", self.weights, self.squares))

    @property
    def expected(self) -> Array:
        """Weighted mean of the expected variances ``square exp(spread/2)``, shape (c, t)."""
        return np.asarray(np.einsum("cm,cmt->ct", self.weights, self.squares * np.exp(self.spread / 2)))

    def quantiles(self, *probabilities: float) -> Array:
        """Return the values below which the variance lies with probabilities, (p, c, t); 0 where none is as likely."""
        share = np.array(probabilities)[:, None, None]
        with np.errstate(divide="ignore"):
            centre = np.log(self.squares)
        width = np.sqrt(self.spread) + 1e-9
        finite = np.isfinite(centre)
        nothing = (self.weights[:, :, None] * ~finite).sum(axis=1) >= share
        low = np.where(nothing, 0.0, np.where(finite, centre - 9 * width, np.inf).min(axis=1))
        high = np.where(nothing, 0.0, np.where(finite, centre + 9 * width, -np.inf).max(axis=1))
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            below = np.einsum("cm,pcmt->pct", self.weights, normal_cdf((middle[:, :, None] - centre) / width))
            low, high = np.where(below < share, middle, low), np.where(below < share, high, middle)
        return np.where(nothing, 0.0, np.exp(high))


def average(choice: Choice, square: Callable[[Array], Array]) -> Averaged:
    """Return a variance averaged over all candidates, with the uncertainties of their parameters.

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


# Noise of one column: from its stretches at rest to a model with intervals and a test.


_RICHEST = "NGGK"


@dataclass(frozen=True)
class Analysis:
    """The noise of a column.

    Attributes
    ----------
    stretches
        The stretches that were analysed.
    band, allowance
        Highest frequency, and ripple, with which a model is fitted to the spectra.
    limits
        Least and greatest time constant, s.
    choice
        The fitted candidates, c = 1.
    """

    stretches: tuple[Stretch, ...]
    band: Band
    allowance: Allowance
    limits: tuple[float, float]
    choice: Choice

    @property
    def spectra(self) -> tuple[Spectrum, ...]:
        """Spectra with the weights of their bins."""
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
        """Number of the chosen candidate."""
        return int(self.choice.chosen[0])

    @property
    def model(self) -> Flags:
        """Which parameters the chosen candidate has, shape (8,)."""
        return np.asarray(self.choice.models[0, self.index])

    def cost(self, stretches: Sequence[Stretch], model: Flags) -> float:
        """Return the deviance of a model fitted to other stretches with the weights of these, plus 4 a parameter."""
        _, deviance = self._refit([each for stretch in stretches for each in stretch.spectra], model)
        return float(deviance + PER_PARAMETER * model.sum())

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
        """Covariance of the logarithms of the chosen candidate's parameters, shape (8, 8)."""
        return np.asarray(self.choice.covariance[0, self.index])

    @cached_property
    def test(self) -> MomentsFit:
        """The test of fit of the chosen candidate."""
        return test_of_fit(self.spectra, self.values, self.band.highest)

    def intervals(self, model: Flags | None = None) -> tuple[Array, Array]:
        """Return the ends of 95 % intervals, shapes (8,), of the chosen candidate, with the terms of `model` added."""
        models = (self.model if model is None else model | self.model)[None]
        low, high = profile(
            self.bins, self.values[None], models, self.limits, self.bins.power[None], self.bins.freedom[None]
        )
        return low[0], high[0]

    def average(self, square: Callable[[Array], Array]) -> Averaged:
        """Return a variance averaged over all candidates; see `average`."""
        return average(self.choice, square)

    def variances(self) -> list[Array]:
        """Return the variance of the coefficients in the bins of each spectrum, shapes (b,)."""
        return _split(self.bins.variances(self.values[None])[0], self.spectra)

    def steps(
        self, stretches: Sequence[Stretch], limit: float = LEVEL_STEP.limit, most: int = MOST_STEPS
    ) -> list[tuple[LevelChange, ...]]:
        """Return the changes of level of stretches, the analysed ones or earlier ones, under the chosen noise model."""
        steps, start = [], 0
        variances = self.variances()
        for each in stretches:
            stop = start + len(each.spectra)
            many = len(each.slow)
            level = variances_of_coefficients(variances[start:stop], each, many)
            # Vibration beyond the band, and bins off the model, would show as steps at the ends of the stretch.
            share = counted(replace(each, spectra=self.spectra[start:stop]), many)
            level = np.where(share > 0, level / np.maximum(share, 1e-300), np.inf)
            steps.append(find_steps(each.slow, level, each.count, each.interval, limit, most))
            start = stop
        return steps

    def regressed(self, covariates: Sequence[Array], hidden: Sequence[Array] = ()) -> Regression:
        """Return the column's dependence on covariates, given as slow coefficients of each stretch: see `regress`."""
        return regress(self.stretches, covariates, self._refit, hidden=hidden)

    def _refit(self, spectra: Sequence[Spectrum], model: Flags | None = None) -> tuple[Sequence[Array], float]:
        """Return variances and deviance of the chosen model fitted to spectra with the weights of the analysed ones."""
        model = self.model if model is None else model
        bins = prepare(
            [
                Spectrum(s.interval, s.count, s.first, s.last, s.power, np.minimum(mine.freedom, s.freedom))
                for s, mine in zip(spectra, self.spectra, strict=True)
            ]
        )
        refitted = fit(bins, model[None], self.limits, bins.power[None], bins.freedom[None])
        return _split(bins.variances(refitted.values)[0], self.spectra), float(refitted.deviance[0])


def analysed(
    stretches: Sequence[Stretch], candidates: tuple[str, ...] = CANDIDATES, highest: float | None = None
) -> Analysis:
    """Return the noise of a column from its stretches at rest, all of one sampling rate.

    Parameters
    ----------
    stretches
        One or more stretches, whose deviances are added.
    candidates
        Letters of the models; a single one is fitted as it is.
    highest
        Highest frequency that is fitted, Hz; from the spectra if None.
    """
    return analyses([stretches], candidates, highest)[0]


def analyses(
    columns: Sequence[Sequence[Stretch]], candidates: tuple[str, ...] = CANDIDATES, highest: float | None = None
) -> list[Analysis]:
    """Return the noise of columns with the same times, fitted together: see `analysed`."""
    spectra = [[each for stretch in stretches for each in stretch.spectra] for stretches in columns]
    nyquist = 0.5 / columns[0][0].interval
    bands = [
        usable_band(each) if highest is None else Band(min(highest, nyquist), highest >= nyquist) for each in spectra
    ]
    inside = [[within(each, band.highest) for each in its] for its, band in zip(spectra, bands, strict=True)]
    alike: dict[tuple[Band, tuple[float, float]], list[int]] = {}
    for k, (its, band) in enumerate(zip(inside, bands, strict=True)):
        alike.setdefault((band, time_limits(its)), []).append(k)
    by_column: dict[int, Analysis] = {}
    for (band, limits), members in alike.items():
        fitted = _fit_in_band([inside[k] for k in members], band, limits, candidates)
        by_column |= {
            k: Analysis(tuple(columns[k]), bands[k], allowance, limits, choice)
            for k, (allowance, choice) in zip(members, fitted, strict=True)
        }
    return [by_column[k] for k in range(len(columns))]


def _fit_in_band(
    columns: Sequence[Sequence[Spectrum]], band: Band, limits: tuple[float, float], candidates: tuple[str, ...]
) -> list[tuple[Allowance, Choice]]:
    bins = prepare(columns[0])
    power = np.array([np.concatenate([each.power for each in spectra]) for spectra in columns])
    freedom = np.array([np.concatenate([each.freedom for each in spectra]) for spectra in columns])
    richest = terms(_RICHEST + "Q" * band.full)[None]
    variances = bins.variances(fit(bins, richest, limits, power, freedom).values)
    allowances = [allow(spectra, _split(each, spectra)) for spectra, each in zip(columns, variances, strict=True)]
    freedom = np.array([np.concatenate([each.freedom for each in allowance.spectra]) for allowance in allowances])
    choice = choose(bins, limits, power, freedom, candidates, full_band=band.full and band.flat)
    parts = [Choice(*(getattr(choice, name)[k : k + 1] for name in Choice.__annotations__)) for k in range(len(power))]
    return list(zip(allowances, parts, strict=True))


def intervals_of(analysed_columns: Sequence[Analysis], index: Sequence[int]) -> list[tuple[Array, Array]]:
    """Return the ends of 95 % intervals, shapes (8,), of one candidate for each column; columns as in `analyses`."""
    ends: dict[int, tuple[Array, Array]] = {}
    for limits in dict.fromkeys(each.limits for each in analysed_columns):
        alike = [k for k, each in enumerate(analysed_columns) if each.limits == limits]
        bins = [analysed_columns[k].bins for k in alike]
        values, models = (
            np.array([getattr(analysed_columns[k].choice, name)[0, index[k]] for k in alike])
            for name in ("values", "models")
        )
        power, freedom = np.array([each.power for each in bins]), np.array([each.freedom for each in bins])
        parts = profile(bins[0], values, models, limits, power, freedom)
        ends |= dict(zip(alike, zip(*parts, strict=True), strict=True))
    return [ends[k] for k in range(len(analysed_columns))]


def without_steps(stretches: Sequence[Stretch], steps: Sequence[Sequence[LevelChange]]) -> list[Stretch]:
    """Return stretches without these changes of level."""
    cleaned = []
    for stretch, its in zip(stretches, steps, strict=True):
        for step in its:
            unit = step_coefficients(len(stretch.slow), step.time / stretch.interval, stretch.count)
            stretch = without(stretch, step.size * unit)
        cleaned.append(stretch)
    return cleaned


def _split(variances: Array, spectra: Sequence[Spectrum]) -> list[Array]:
    return np.split(variances, np.cumsum([len(each.power) for each in spectra])[:-1])
