"""How long to record: the uncertainty of each term of a noise model as a function of the record's length.

Source: the Cramer-Rao bound of the Whittle likelihood that the fit maximises (`likelihood.information`).
"""

from __future__ import annotations

import numpy as np

from imulab.estimation.noise.likelihood import Flags, fit, information, profile, time_limits, within
from imulab.estimation.noise.spectrum import Spectrum, bins
from imulab.estimation.noise.terms import prepare
from imulab.estimation.rows import medians
from imulab.recording import Array

LONGEST = 1e9
"""s, 30 years: longer than any record."""
_FEWEST, _DRAWN = 500, 100  # samples of the shortest planned record; records drawn for the limits of absent terms
_PER_DECADE = 6  # lengths tried in a decade


def accuracy(values: Array, interval: float, length: float, highest: float | None = None, ripple: float = 0.0) -> Array:
    """Return the relative standard uncertainty of each parameter from a record of a length, shape (8,).

    The Cramer-Rao bound of the logarithms, the root of the inverse of ``1/2 sum d (d ln lambda)(d ln lambda)'``; NaN
    for a term that is 0.

    Parameters
    ----------
    values
        Parameters of the model, shape (8,).
    interval
        Time between samples, s.
    length
        Length of the record, s.
    highest
        Highest frequency of the spectrum that is used, Hz; half the sampling rate if None.
    ripple
        eps, relative deviation of the level of each bin from the model, which more samples do not reduce.

    Examples
    --------
    White noise from a million samples:

    >>> round(float(accuracy(np.array([1.0, 0, 0, 0, 0, 0, 0, 0]), 0.01, 1e4)[0]), 6)
    0.000707
    """
    covariance = information(prepare([_empty(interval, length, highest, ripple)]), values)
    return np.where(values > 0, np.sqrt(np.diag(covariance)), np.nan)


def accuracy_curve(
    values: Array, interval: float, highest: float | None = None, ripple: float = 0.0
) -> tuple[Array, Array]:
    """Return lengths of records, s, shape (t,), and the uncertainties that they reach, shape (t, 8), never rising.

    Arguments as for `accuracy`.
    """
    shortest = _FEWEST * interval
    steps = max(int(np.ceil(_PER_DECADE * np.log10(LONGEST / shortest))), 1)
    lengths = np.geomspace(shortest, max(LONGEST, 2 * shortest), steps + 1)
    each = np.array([accuracy(values, interval, length, highest, ripple) for length in lengths.tolist()])
    return lengths, np.minimum.accumulate(each, axis=0)


def length_for(lengths: Array, reached: Array, wanted: float) -> float:
    """Return the length of a record, s, that reaches a relative standard uncertainty; infinite where none does.

    Parameters
    ----------
    lengths, reached
        Of `accuracy_curve`: s, and the uncertainty of one parameter, shapes (t,).
    wanted
        Relative standard uncertainty, for example 0.1.
    """
    if not reached[-1] <= wanted:
        return float("inf")
    # Between the lengths of the curve the uncertainty is a power of the length; np.interp wants it rising.
    return float(np.exp(np.interp(np.log(wanted), np.log(reached[::-1]), np.log(lengths[::-1]))))


def visible(
    values: Array, model: Flags, interval: float, length: float, highest: float | None = None, draws: int = _DRAWN
) -> Array:
    """Return the 95 % upper limits that a record of a length sets to the terms of a model, shape (8,).

    They are medians of the upper ends of profile intervals over drawn spectra, the same at every call; NaN for terms
    that the model lacks.

    Parameters
    ----------
    values, interval, length, highest
        The actual noise, as for `accuracy`.
    model
        Terms of the noise and those to be limited, shape (8,).
    draws
        Number of drawn spectra.
    """
    spectrum = _empty(interval, length, highest)
    frame, limits = prepare([spectrum]), time_limits([spectrum])
    freedom = np.broadcast_to(spectrum.freedom, (draws, len(spectrum.freedom)))
    used = np.maximum(freedom, 1)
    power = frame.variances(values[None]) * np.random.default_rng(1).chisquare(used) / used
    best = fit(frame, model[None], limits, power, freedom)
    every = np.broadcast_to(model, best.values.shape)
    return medians(profile(frame, best.values, every, limits, power, freedom)[1], 0)


def _empty(interval: float, length: float, highest: float | None, ripple: float = 0.0) -> Spectrum:
    count = max(round(length / interval), _FEWEST)
    first, last = bins(count)
    many = (last - first + 1).astype(np.float64)
    spectrum = Spectrum(interval, count, first, last, np.ones(len(first)), many / (1 + many * ripple**2 / 2))
    return spectrum if highest is None else within(spectrum, highest)
