"""The slow noise of gyroscopes at rest while the temperature changes: 1/f noise and random walk beside the laws.

In one recording they look like bends of a law, and they set how well it is known. The means of n parts of a recording
have the covariance ``V = c (1 + p F + q W)`` on each axis: 1 of white noise, F of 1/f noise, W of a random walk that
begins with the recording. The level c belongs to an axis, the ratios p and q to the sensor.

1/f noise is the sum of first-order Markov processes of equal variance with time constants in steps of two (Keshner,
Proc. IEEE 70 (1982) 212), from a part of the recording to twice its length.

A ratio that maximises the likelihood is 0 in many recordings whose slow noise is small, and then uncertainties are too
narrow. So V is the mean over a grid of ratios, weighed by the restricted likelihood (Patterson and Thompson, Biometrika
58 (1971) 545) beside the laws' terms; ratios are taken as equally likely on a logarithmic scale.
"""

from __future__ import annotations

import numpy as np

from imulab.estimation.rows import median
from imulab.recording import Array

_RATIOS = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 13)])
"""Variance of 1/f noise and of the walk beside the laws' terms, the mean over all directions, over that of white
noise."""


def fit_slow_noise(mean: Array, terms: Array, time: Array) -> Array:
    """Return the covariance of the means of equal parts of a recording by slow noise on each axis, shape (3, n, n).

    Parameters
    ----------
    mean
        Mean outputs, shape (n, 3).
    terms
        What the laws may follow, shape (n, k), with a constant among the columns.
    time
        Time of each part, s, shape (n,).
    """
    sizes, parts = _fit_sizes(mean, terms, time)
    covariance: Array = np.tensordot(sizes[:, 1:], np.array(parts[1:]), 1)
    return covariance


def fit_noise(mean: Array, terms: Array, time: Array) -> Array:
    """Return the covariance by all noise, white noise too, of axes as many as there are, shape (axes, n, n)."""
    sizes, parts = _fit_sizes(mean, terms, time)
    covariance: Array = np.tensordot(sizes, np.array(parts), 1)
    return covariance


def _fit_sizes(mean: Array, terms: Array, time: Array) -> tuple[Array, list[Array]]:
    """Return the sizes of white noise, 1/f noise and walk of each axis, shape (axes, 3), and their covariances."""
    u, sizes, _ = np.linalg.svd(terms / np.linalg.norm(terms, axis=0))
    free = u[:, np.count_nonzero(sizes > 1e-6 * sizes[0]) :].T
    parts = [np.eye(len(time)), *slow_covariances(time)]
    beside = [free @ part @ free.T for part in parts]
    level = [np.trace(each) / len(free) for each in beside]
    parts, beside = ([each / size for each, size in zip(these, level, strict=True)] for these in (parts, beside))
    left, likelihood, levels = free @ mean, [], []
    for p in _RATIOS:
        # With the eigenvectors of the walk beside the rest, every q costs a division only.
        factor = np.linalg.cholesky(beside[0] + p * beside[1])
        inverse = np.linalg.inv(factor)
        walk, modes = np.linalg.eigh(inverse @ beside[2] @ inverse.T)
        squares = (modes.T @ inverse @ left) ** 2
        for q in _RATIOS:
            relative = 1 + q * np.maximum(walk, 0.0)
            level_of_axis = (squares / relative[:, None]).mean(axis=0)
            half = np.log(np.diag(factor)).sum() + 0.5 * np.log(relative).sum()
            likelihood.append(-mean.shape[1] * half - 0.5 * len(free) * np.log(level_of_axis).sum())
            levels.append(level_of_axis)
    ratios = np.array([(1.0, p, q) for p in _RATIOS for q in _RATIOS])
    weight = np.exp(np.array(likelihood) - max(likelihood))
    weight /= weight.sum()
    return np.einsum("k,ka,kp->ap", weight, np.array(levels), ratios), parts


def slow_covariances(time: Array) -> tuple[Array, Array]:
    """Return the covariances of 1/f noise and of a random walk at these times, shapes (n, n)."""
    apart, begun = np.abs(time[:, None] - time), time - time[0] + (time[1] - time[0]) / 2
    step, length = median(np.diff(time)), 2 * float(time[-1] - time[0])
    constants = step * 2.0 ** np.arange(np.ceil(np.log2(length / step)) + 1)
    flicker = np.exp(-apart[:, :, None] / constants).sum(axis=2)
    return flicker, np.minimum(begun[:, None], begun)
