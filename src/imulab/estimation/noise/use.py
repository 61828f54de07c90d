"""What users of a noise model need: white noise and walk for a filter, and the uncertainty of a bias from a mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.noise.terms import SIGMA, TIME, allan_terms, letters, mean_terms
from imulab.recording import Array

_AT_BOUND = 1.5
"""A Gauss-Markov term within this factor of the shortest time constant is the edge of the band, no slow noise."""
_WHITE_TO_FILTER = 3.0
"""Horizons of so many time constants see a Gauss-Markov term as white noise."""
_NO_TIME = 1e-30
_OF_FLICKER = 0.1
"""Share of B^2 h that is white to a filter.

Both numbers are from filters run on simulated noise (1/f with a corner of 3 and 30 s, Gauss-Markov of 20 times the
white density, h = 10 to 300 s): their errors are the smallest so, and their predictions right to 15 %. With all of it
in the walk, errors are up to twice as large, and 1.4 to 2 times the prediction.
"""


def walk_square(values: Array, horizon: Array, interval: float, shortest: float = 0.0) -> Array:
    """Return the square of the walk that predicts the mean over a horizon as well as the model does, (u/sqrt(s))^2.

    ``K_h^2 = 3 sigma^2_slow(h)/h``, sigma^2_slow the Allan variance of 1/f noise, walk and Gauss-Markov terms of more
    than h/3; those at the shortest time constant are the edge of the band.

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
        slow = slow + np.where(_is_fast(values, k, horizon, shortest), 0.0, parts[..., 4 + k, :])
    return np.asarray(3 * slow / horizon)


def white_square(values: Array, horizon: Array, shortest: float = 0.0) -> Array:
    """Return the square of the white noise that goes with the walk of a horizon, (u/sqrt(Hz))^2, shape (..., t).

    ``N_h^2 = N^2 + 0.1 B^2 h + sum 2 S^2 T [1 - (T/h) (1 - e^(-h/T))]`` over the Gauss-Markov terms that `walk_square`
    leaves out, whose integral over h it predicts; those at the edge of the band count in full. Parameters as there.
    """
    total = values[..., :1] ** 2 + _OF_FLICKER * values[..., 1:2] ** 2 * horizon
    edge = at_band_edge(values, shortest)
    for k, (sigma, time) in enumerate(zip(SIGMA, TIME, strict=True)):
        density = 2 * values[..., sigma, None] ** 2 * values[..., time, None]
        many = np.maximum(horizon, _NO_TIME) / np.maximum(values[..., time, None], _NO_TIME)
        share = np.where(edge[..., k, None], 1.0, 1 + np.expm1(-many) / many)
        total = total + np.where(_is_fast(values, k, horizon, shortest), share * density, 0.0)
    return np.asarray(total)


def bias_square(values: Array, duration: Array, interval: float) -> Array:
    """Return u^2 of the mean over a duration at rest as a measure of the bias, shape (..., t): see `mean_terms`."""
    return np.asarray(mean_terms(values, duration, interval).sum(axis=-2))


def at_band_edge(values: Array, shortest: float) -> NDArray[np.bool_]:
    """Return which Gauss-Markov terms, shape (..., 2), lie at the shortest time constant that the fit allowed, s.

    Such a term is the roll-off of the sensor's filter at the end of the band, and no slow noise.
    """
    return np.asarray((values[..., SIGMA] > 0) & (values[..., TIME] <= _AT_BOUND * shortest))


def letters_inside(model: NDArray[np.bool_], values: Array, shortest: float) -> str:
    """Return the letters of a model without the Gauss-Markov terms that are the edge of the band; arguments (8,)."""
    return letters(model).replace("G", "", int(np.count_nonzero(at_band_edge(values, shortest))))


def edge_as_white(values: Array, covariance: Array, shortest: float) -> tuple[Array, Array]:
    """Return a model whose Gauss-Markov terms at the end of the band are white noise, as slower noise sees them.

    ``N^2 + sum 2 S^2 T`` in place of N^2; a term that is left is the first.

    Parameters
    ----------
    values, covariance
        Parameters, shape (8,), and the covariance of their logarithms, shape (8, 8).
    shortest
        The least time constant that the fit allowed, s.
    """
    edge = np.flatnonzero(at_band_edge(values, shortest))
    if not edge.size:
        return values, covariance
    found, turn = values.copy(), np.eye(len(values))
    parts = np.zeros(len(values))
    parts[0] = values[0] ** 2
    for k in edge.tolist():
        parts[[SIGMA[k], TIME[k]]] = 2 * values[SIGMA[k]] ** 2 * values[TIME[k]]
        found[[SIGMA[k], TIME[k]]] = 0.0
    found[0] = np.sqrt(white_square(values, np.zeros(1), shortest)[0])
    # d ln N: of a term's variance by S as by N, by T half as much.
    parts[list(TIME)] /= 2
    turn[0] = parts / found[0] ** 2
    turn[found == 0] = 0.0
    if found[SIGMA[0]] == 0:
        order = np.arange(len(values))
        order[[*SIGMA, *TIME]] = [*SIGMA[::-1], *TIME[::-1]]
        found, turn = found[order], turn[order]
    return found, np.asarray(turn @ covariance @ turn.T)


def _is_fast(values: Array, k: int, horizon: Array, shortest: float) -> NDArray[np.bool_]:
    edge = at_band_edge(values, shortest)[..., k, None]
    return np.asarray(edge | (values[..., TIME[k], None] <= horizon / _WHITE_TO_FILTER))
