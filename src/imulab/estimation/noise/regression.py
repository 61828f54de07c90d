"""Drift that follows a covariate, time or temperature, told apart from slow noise: least squares under the noise model.

Source: generalised least squares; the cosine coefficients of the noise are independent, with the model's variances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imulab.estimation.noise.cosine import Stretch, binned, variances_of_coefficients
from imulab.estimation.noise.spectrum import Spectrum
from imulab.recording import Array

Refit = Callable[[Sequence[Spectrum]], tuple[Sequence[Array], float]]
"""Fits a model to spectra; returns its variance in each bin of each of them, (b,), and its deviance."""
_ROUNDS = 3
_PLAIN, _PENALTY, _GAIN = 3.0, 4.0, 6.0


@dataclass(frozen=True)
class Regression:
    """How samples follow covariates.

    Attributes
    ----------
    slope, standard_uncertainty
        In the unit of the samples over that of the covariate, shape (k,).
    gain
        By how much the deviance falls that all of them together are taken out.
    residual
        The stretches without what follows the covariates.
    """

    slope: Array
    standard_uncertainty: Array
    gain: float
    residual: tuple[Stretch, ...]

    @property
    def follows(self) -> bool:
        """Whether a slope is beyond 3 standard uncertainties, and the deviance, at 4 a parameter, falls by 6."""
        z = np.abs(self.slope) / self.standard_uncertainty
        return bool(z.max() > _PLAIN and self.gain - _PENALTY * len(z) >= _GAIN)


def ramp_coefficients(stretch: Stretch) -> Array:
    """Return the slow coefficients of time, s, over a stretch, shape (J,)."""
    n = stretch.count
    j = np.arange(1, len(stretch.slow) + 1)
    # sum_i i cos(pi j (i + 1/2)/n) = -(1 - (-1)^j)/(4 sin^2(pi j/2n)) cos(pi j/2n)
    half = np.pi * j / (2 * n)
    return np.asarray(-np.sqrt(2 / n) * stretch.interval * (j % 2) * np.cos(half) / (2 * np.sin(half) ** 2))


def regress(
    stretches: Sequence[Stretch], covariates: Sequence[Array], refit: Refit, rounds: int = _ROUNDS
) -> Regression:
    """Regress stretches on covariates, with the noise model fitted again to what is left, in three rounds.

    ``b = (X' Lambda^-1 X)^-1 X' Lambda^-1 c``, the coefficients of the stretches one below the other.

    Parameters
    ----------
    stretches
        One or more of the same column.
    covariates
        Of each stretch the slow coefficients of each covariate, shape (k, J); all k are fitted at once.
    refit
        Fits the noise model to spectra.
    """
    spectra = [each for stretch in stretches for each in stretch.spectra]
    variances, before = refit(spectra)
    residual: tuple[Stretch, ...] = tuple(stretches)
    after = before
    for _ in range(rounds):
        slope, covariance = _slopes(stretches, covariates, variances)
        residual = tuple(
            without(stretch, slope @ np.atleast_2d(x)) for stretch, x in zip(stretches, covariates, strict=True)
        )
        variances, after = refit([each for stretch in residual for each in stretch.spectra])
    slope, covariance = _slopes(stretches, covariates, variances)
    return Regression(slope, np.sqrt(np.diag(covariance)), before - after, residual)


def _slopes(
    stretches: Sequence[Stretch], covariates: Sequence[Array], variances: Sequence[Array]
) -> tuple[Array, Array]:
    size, start = len(np.atleast_2d(covariates[0])), 0
    normal, right = np.zeros((size, size)), np.zeros(size)
    for stretch, given in zip(stretches, covariates, strict=True):
        stop = start + len(stretch.spectra)
        weight = counted(stretch) / variances_of_coefficients(variances[start:stop], stretch)
        x = np.atleast_2d(given)
        normal += x * weight @ x.T
        right += x * weight @ stretch.slow
        start = stop
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return np.asarray(covariance @ right), covariance


def counted(stretch: Stretch) -> Array:
    """Return how much each slow coefficient counts, shape (J,): what its bin counts of its coefficients."""
    counts = np.zeros(len(stretch.slow))
    f = np.arange(1, len(counts) + 1) / stretch.count
    for spectrum in stretch.spectra:
        share = spectrum.freedom / (spectrum.last - spectrum.first + 1)
        place = np.searchsorted(spectrum.first / spectrum.count, f + 1e-12, side="right") - 1
        inside = (place >= 0) & (f <= spectrum.last[-1] / spectrum.count + 1e-12)
        counts[inside] = np.minimum(share[place[inside]], 1.0)
    return np.where(stretch.used, counts, 0.0)


def without(stretch: Stretch, taken: Array) -> Stretch:
    """Return a stretch whose slow coefficients are less by `taken`, shape (J,), and its spectra accordingly."""
    slow = stretch.slow - taken
    spectrum = stretch.spectra[0]
    low = spectrum.last <= len(slow)
    edges = (spectrum.first[low], spectrum.last[low])
    power = spectrum.power.copy()
    power[low] = binned(slow**2, stretch.used, edges, spectrum.interval, spectrum.count).power
    return replace(stretch, slow=slow, spectra=(replace(spectrum, power=power), *stretch.spectra[1:]))
