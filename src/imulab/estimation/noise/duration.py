"""How long to record: what a record of some length tells of each term of a noise model."""

from __future__ import annotations

import numpy as np

from imulab.errors import OptionError
from imulab.estimation.noise.intervals import profile
from imulab.estimation.noise.likelihood import Flags, fit, information, time_limits
from imulab.estimation.noise.spectrum import Spectrum, bins
from imulab.estimation.noise.terms import prepare
from imulab.recording import Array

_LONGEST = 1e10
"""s; no record is as long."""
_FEWEST, _DRAWN = 500, 100


def accuracy(values: Array, interval: float, length: float) -> Array:
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

    Examples
    --------
    White noise from a million samples:

    >>> round(float(accuracy(np.array([1.0, 0, 0, 0, 0, 0, 0, 0]), 0.01, 1e4)[0]), 6)
    0.000707
    """
    covariance = information(prepare([_empty(interval, length)]), values)
    return np.where(values > 0, np.sqrt(np.diag(covariance)), np.nan)


def length_for(values: Array, interval: float, parameter: int, wanted: float) -> float:
    """Return the length of a record, s, that determines a parameter to a relative standard uncertainty.

    Parameters
    ----------
    values, interval
        As for `accuracy`.
    parameter
        Its place in `NAMES`.
    wanted
        Relative standard uncertainty, for example 0.1.

    Raises
    ------
    OptionError
        The model has not got the parameter, or no record is long enough.
    """
    if not values[parameter] > 0:
        raise OptionError("length of a record: expected a term that the model has, found one that is 0")
    low, high = np.log(_FEWEST * interval), np.log(_LONGEST)
    if not accuracy(values, interval, _LONGEST)[parameter] <= wanted:
        raise OptionError(f"accuracy {wanted:g}: expected one that a record of {_LONGEST:.0e} s can reach")
    for _ in range(40):
        middle = (low + high) / 2
        reached = accuracy(values, interval, float(np.exp(middle)))[parameter] <= wanted
        low, high = (low, middle) if reached else (middle, high)
    return float(np.exp(high))


def visible(values: Array, model: Flags, interval: float, length: float) -> Array:
    """Return the 95 % limits that a record of a length sets to the terms of a model, shape (8,).

    The median upper end of the profile intervals over drawn spectra, the same at every call; NaN for terms that the
    model has not got.

    Parameters
    ----------
    values, interval, length
        As for `accuracy`: the noise that there is.
    model
        Its terms and those to be limited, shape (8,).
    """
    spectrum = _empty(interval, length)
    frame, limits = prepare([spectrum]), time_limits([spectrum])
    freedom = np.broadcast_to(spectrum.freedom, (_DRAWN, len(spectrum.freedom)))
    power = frame.variances(values[None]) * np.random.default_rng(1).chisquare(freedom) / freedom
    best = fit(frame, model[None], limits, power, freedom)
    every = np.broadcast_to(model, best.values.shape)
    return np.asarray(np.median(profile(frame, best.values, every, limits, power, freedom)[1], axis=0))


def _empty(interval: float, length: float) -> Spectrum:
    count = max(round(length / interval), _FEWEST)
    first, last = bins(count)
    return Spectrum(interval, count, first, last, np.ones(len(first)), (last - first + 1).astype(np.float64))
