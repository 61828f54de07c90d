"""The test of fit: Allan variances of a record against those of the model, by the method of wavelet moments.

Source: Guerrier, Skaloud, Stebler and Victoria-Feser (2013). The record is continued by its mirror image, so that its
Allan variances are sums over squares of cosine coefficients, whose covariance is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imulab.estimation.noise.spectrum import Spectrum
from imulab.estimation.noise.terms import prepare
from imulab.recording import Array

_SHORTEST, _LONGEST = 4.0, 10.0  # tau f_max at least; parts of the record at least
_STEP = 1e-4
_NODES = 32


@dataclass(frozen=True)
class Fit:
    """How well a model fits.

    Attributes
    ----------
    statistic, freedom, probability
        J, its degrees of freedom, and the probability of a larger J of a good model; 1 where there is nothing to test.
    tau
        Averaging times, s, shape (t,).
    variance, predicted
        Allan variances of the record (its mirror image continuing it) and of the model, shape (t,).
    values
        The parameters that fit the Allan variances best, one step of Gauss and Newton from the model, shape (8,).
    """

    statistic: float
    freedom: int
    probability: float
    tau: Array
    variance: Array
    predicted: Array
    values: Array


def test_of_fit(spectra: Sequence[Spectrum], values: Array, highest: float) -> Fit:
    """Hold the Allan variances at octaves of averaging time, 4/f_max to L/10, against a model.

    ``J = r' Omega^-1 r``, r the difference that is left when the parameters are fitted to it, of cube roots, which are
    nearly normal (Wilson and Hilferty 1931), Omega the covariance of the Allan variances under the model.

    Parameters
    ----------
    spectra
        What the model was fitted to.
    values
        Its parameters in the order of `NAMES`, shape (8,).
    highest
        f_max, Hz.
    """
    from imulab.estimation.special import chdtrc

    interval, length = spectra[0].interval, max(each.length for each in spectra)
    lowest = max(1, int(np.ceil(_SHORTEST / highest / interval - 1e-9)))
    octaves = max(0, int(np.floor(np.log2(max(length / _LONGEST / interval / lowest, 0.5)))) + 1)
    m = lowest * 2 ** np.arange(octaves)
    tau = m.astype(np.float64) * interval
    bins, present = prepare(spectra), np.flatnonzero(values > 0)
    nothing = Fit(0.0, 0, 1.0, tau, np.empty(0), np.empty(0), values)
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
    found = weight @ (counted * bins.power)
    scale = 1 / predicted[0]
    root = np.linalg.cholesky((spread * scale[:, None]) @ (spread * scale[:, None]).T)
    # The cube root of what is distributed as chi-square over its freedom is nearly normal, about 1 - 2/(9 freedom).
    square = np.sum((spread * scale[:, None]) ** 2, axis=1)
    ratio = 3 * (np.cbrt(np.maximum(found * scale, 0.0)) - (1 - square / 9))
    r = np.linalg.solve(root, ratio)
    basis = np.linalg.solve(root, slope * scale[:, None])
    step, _, rank, _ = np.linalg.lstsq(basis, r, rcond=1e-6)
    freedom = octaves - int(rank)
    statistic = float(np.sum((r - basis @ step) ** 2))
    better = values.copy()
    better[present] *= np.exp(np.clip(step, -2, 2))
    probability = float(chdtrc(freedom, statistic)) if freedom else 1.0
    return Fit(statistic, freedom, probability, tau, found, predicted[0], better)


def allan_of_bins(records: Sequence[Sequence[Spectrum]]) -> tuple[Array, Array]:
    """Return octaves of averaging time up to a quarter of a record, s, and the Allan variance there, shapes (t,).

    Sums over the bins of each record, which its mirror image continues and whose lines are left out: they need no
    samples. Records count by how many means they hold.
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
    """Which part of all coefficients of the record each bin holds, those left out as lines included."""
    return np.asarray((spectrum.last - spectrum.first + 1) / spectrum.count)


def _weights(spectrum: Spectrum, m: np.ndarray) -> Array:
    """Mean over each bin of ``2 sin^4(m w/2)/(m^2 sin^2(w/2))``, w = pi j/n, for means of m samples, shape (t, b)."""
    width = (spectrum.last - spectrum.first + 1).astype(np.float64)
    share = (np.arange(_NODES) + 0.5) / _NODES
    # Midpoints stand for the j of a bin; those of a narrow one are repeated.
    offset = np.floor(share * width[:, None])
    half = np.pi * (spectrum.first[:, None] + offset) / (2 * spectrum.count)
    return np.stack([np.mean(2 * np.sin(k * half) ** 4 / (k * np.sin(half)) ** 2, axis=1) for k in m])
