"""Distribution functions of statistics, over arrays of any shapes that numpy broadcasts, and the sine integral.

The smaller tail is right to 1e-12 of its value, down to the smallest numbers, for 0.01 to 1e12 and infinitely many
degrees of freedom. Computed in C (`_distributions`), whose head names the series and fractions: ``import
scipy.special`` would take 0.2 s of processor time, more than most commands need.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from imulab.estimation import _distributions
from imulab.recording import Array

_SMALL = 1e-3  # probabilities below are known to a digit


def normal_cdf(value: ArrayLike) -> Array:
    """Return the probability that a standard normal variable is below `value` (DLMF 7.18.1: ``erfc(-z/sqrt 2)/2``)."""
    return _elementwise(_distributions.fill_normal_cdf, value)


def normal_quantile(probability: ArrayLike) -> Array:
    """Return the value below which a standard normal variable lies with a probability (Halley's method)."""
    return _elementwise(_distributions.fill_normal_quantile, probability)


def chi_square_tail(value: ArrayLike, freedom: ArrayLike) -> Array:
    """Return the probability that chi-square with `freedom` degrees exceeds `value`: ``Q(freedom/2, value/2)``.

    Q is the regularised incomplete gamma function, DLMF 8.2.4.
    """
    return _elementwise(_distributions.fill_chi_square_tail, value, freedom)


def chi_square_upper_quantile(probability: ArrayLike, freedom: ArrayLike) -> Array:
    """Return the value that chi-square with `freedom` degrees exceeds with a probability."""
    return _elementwise(_distributions.fill_chi_square_upper_quantile, probability, freedom)


def f_tail(value: ArrayLike, numerator_freedom: ArrayLike, denominator_freedom: ArrayLike) -> Array:
    """Return the probability that Fisher's F, the ratio of two mean squares of the same noise, exceeds `value`.

    ``I_x(n/2, m/2)``, ``x = n / (n + m value)``, of m and n degrees of freedom above and below; I is the regularised
    incomplete beta function, DLMF 8.17.2.
    """
    return _elementwise(_distributions.fill_f_tail, value, numerator_freedom, denominator_freedom)


def f_quantile(probability: ArrayLike, numerator_freedom: ArrayLike, denominator_freedom: ArrayLike) -> Array:
    """Return the value below which Fisher's F lies with a probability."""
    return _elementwise(_distributions.fill_f_quantile, probability, numerator_freedom, denominator_freedom)


def t_cdf(value: ArrayLike, freedom: ArrayLike) -> Array:
    """Return the probability that Student's t with `freedom` degrees is below `value`.

    ``I_x(n/2, 1/2)/2`` for ``value <= 0``, ``x = n / (n + value^2)``, n the degrees of freedom (DLMF 8.17.2).
    """
    return _elementwise(_distributions.fill_t_cdf, value, freedom)


def t_quantile(probability: ArrayLike, freedom: ArrayLike) -> Array:
    """Return the value below which Student's t with `freedom` degrees lies with a probability."""
    return _elementwise(_distributions.fill_t_quantile, probability, freedom)


def sine_integral(value: ArrayLike) -> Array:
    """Return ``Si(value)``, the integral of ``sin(t)/t`` from 0 (DLMF 6.2.9)."""
    return _elementwise(_distributions.fill_sine_integral, value)


def probability_text(value: float | None, least: float = 1e-12) -> str:
    """Return a probability for a sentence: ``p = 0.031``, ``p = 3e-05``, or ``p below 1e-12``; NaN is not tested."""
    if value is None or math.isnan(value):
        return "not tested"
    digits = 2 if value >= _SMALL else 1
    return f"p = {value:.{digits}g}" if value >= least else f"p below {least:g}"


def probability_fact(value: float | None, least: float = 1e-12) -> str:
    """Return a probability as a value beside its label: ``0.031``."""
    return probability_text(value, least).removeprefix("p ").removeprefix("= ")


def _elementwise(fill: Callable[..., None], *arguments: ArrayLike) -> Array:
    """Return a function's values for each element of its broadcast arguments; a number where all are numbers."""
    arrays = [np.asarray(argument, dtype=np.float64) for argument in arguments]
    shape = np.broadcast(*arrays).shape
    values = np.empty(shape)
    fill(values, *(a if a.size == 1 else np.ascontiguousarray(np.broadcast_to(a, shape)) for a in arrays))
    result: Array = values[()]
    return result
