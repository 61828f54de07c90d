"""What users of a noise model need: white noise and walk for a filter, and the uncertainty of a bias from a mean."""

from __future__ import annotations

import numpy as np

from imulab.estimation.noise.terms import SIGMA, TIME, allan_terms, mean_terms
from imulab.recording import Array

_AT_BOUND = 1.5
"""A Gauss-Markov term within this factor of the shortest time constant is the edge of the band, no slow noise."""


def walk_square(values: Array, horizon: Array, interval: float, shortest: float = 0.0) -> Array:
    """Return the square of the walk that predicts the mean over a horizon as well as the model does, (u/sqrt(s))^2.

    ``K_h^2 = 3 sigma^2_slow(h)/h``, sigma^2_slow the Allan variance of all terms but white noise, quantisation and
    Gauss-Markov terms at the shortest time constant.

    Parameters
    ----------
    values
        Parameters, shape (..., 8).
    horizon
        h, s, shape (t,).
    interval
        Time between samples, s.
    shortest
        The least time constant that the fit allowed, s.
    """
    parts = allan_terms(values, horizon, interval)
    slow = parts[..., 1, :] + parts[..., 2, :]
    for k in range(2):
        slow = slow + np.where(_fast(values, k, shortest)[..., None], 0.0, parts[..., 4 + k, :])
    return np.asarray(3 * slow / horizon)


def white_square(values: Array, shortest: float = 0.0) -> Array:
    """Return N^2 with the density 2 S^2 T of Gauss-Markov terms at the shortest time constant, (u/sqrt(Hz))^2.

    Parameters as for `walk_square`.
    """
    total = values[..., 0] ** 2
    for k, (sigma, time) in enumerate(zip(SIGMA, TIME, strict=True)):
        total = total + np.where(_fast(values, k, shortest), 2 * values[..., sigma] ** 2 * values[..., time], 0.0)
    return np.asarray(total)


def bias_square(values: Array, duration: Array, interval: float) -> Array:
    """Return u^2 of the mean over a duration at rest as a measure of the bias, shape (..., t): see `mean_terms`."""
    return np.asarray(mean_terms(values, duration, interval).sum(axis=-2))


def _fast(values: Array, k: int, shortest: float) -> Array:
    return np.asarray(values[..., TIME[k]] <= _AT_BOUND * shortest)
