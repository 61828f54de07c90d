"""Alignment of an array's elements against their consensus, from a recording in motion.

All readings are one motion seen n times. The largest eigenvectors of their covariance, whitened by the noise at rest,
span what the elements sense of it (maximum likelihood of the factor model); the frame within is fixed by a convention.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from imulab.errors import ObservabilityError
from imulab.recording import Array

_BLOCKS = 20
_WORST = 0.05
_VISIBLE = 25.0  # variance of the motion over that of the noise, in the direction where it is least
_NEAR_PERMUTATION = 0.35  # rad


@dataclass(frozen=True)
class Alignment:
    """What each element senses of the array's rate, ``z_i = A_i w + b_i``.

    Attributes
    ----------
    sensing, standard_uncertainty
        A_i and its standard uncertainty, shape (n, axes, axes).
    residual
        Rms of what the consensus leaves of each element, rad/s, shape (n, axes).
    gauge
        The convention that fixes the frame.
    latency, latency_uncertainty
        By how much each element's readings come later than the median's (than the truth), s, shape (n,), or None.
    """

    sensing: Array
    standard_uncertainty: Array
    residual: Array
    gauge: str
    latency: Array | None = None
    latency_uncertainty: Array | None = None


def align(readings: Array, white: Array, truth: Array | None = None, *, strict: bool = True) -> Alignment:
    """Estimate what each element senses of the array's rate.

    Without `truth`, element 1 in its nominal orientation gives the directions and the mean over all elements of
    ``P_i' A_i`` is the unit matrix, P_i the nominal orientation of element i (a signed permutation where it is near
    one). With `truth`, A_i is the regression on it. Uncertainties: jackknife over 20 stretches of the recording.

    Parameters
    ----------
    readings
        In motion, shape (m, axes, n), rad/s; their means are taken off.
    white
        Standard deviation of a sample at rest, shape (axes, n).
    truth
        True rate, shape (m, axes), or None.
    strict
        Whether to refuse what is not fixed to 5 %.

    Raises
    ------
    ObservabilityError
        The motion does not excite every axis.
    """
    m, axes, n = readings.shape
    stacked = np.moveaxis(readings, 2, 1).reshape(m, n * axes)  # element by element
    # Biases may have changed since the array was at rest: what does not vary says nothing here.
    stacked = stacked - stacked.mean(axis=0)
    truth = None if truth is None else truth - truth.mean(axis=0)
    sigma = white.T.reshape(n * axes)
    edges = np.linspace(0, m, min(_BLOCKS, m // 4) + 1).astype(int)
    moments = [_moments(stacked[a:b], truth if truth is None else truth[a:b]) for a, b in pairwise(edges)]
    total = sum(moments[1:], start=moments[0].copy())
    sensing = _solve(total, sigma, axes, n, known=truth is not None)
    without = np.array([_solve(total - part, sigma, axes, n, known=truth is not None) for part in moments])
    blocks = len(moments)
    uncertainty = np.sqrt((blocks - 1) / blocks * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    size = n * axes
    weakest = np.linalg.eigvalsh(total[:size, :size] / np.outer(sigma, sigma))[-axes] / m
    if strict and (not np.isfinite(uncertainty).all() or uncertainty.max() > _WORST or weakest < _VISIBLE):
        # Its own first element is nearest to the frame: the axis about which it moves least against its noise.
        worst = int(np.argmin(readings[:, :, 0].std(axis=0) / white[:, 0]))
        axis = f" about {'xyz'[worst]}" if axes == 3 else ""
        raise ObservabilityError(
            f"the motion does not fix the elements' scale factors and alignment{axis} to {100 * _WORST:.0f} %; "
            "expected a recording that turns fast, both ways, about every axis"
        )
    full = sensing.reshape(n * axes, axes)
    weight = full / sigma[:, None] ** 2
    consensus = np.linalg.solve(full.T @ weight, weight.T @ stacked.T)
    residual = (stacked - consensus.T @ full.T).std(axis=0).reshape(n, axes)
    gauge = "truth_rate" if truth is not None else "mean over the elements of P_i' A_i = 1, directions of element 1"
    return Alignment(sensing, uncertainty, residual, gauge)


def _moments(stacked: Array, truth: Array | None) -> Array:
    """Second moments of readings, with those of the truth appended where there is one."""
    columns = stacked if truth is None else np.hstack([stacked, truth])
    moments: Array = columns.T @ columns
    return moments


def _solve(moments: Array, sigma: Array, axes: int, n: int, *, known: bool) -> Array:
    """Return A_i, shape (n, axes, axes)."""
    size = n * axes
    if known:
        inner = moments[size:, size:]
        if np.linalg.cond(inner) > 1e12:
            return np.full((n, axes, axes), np.nan)
        regression = np.linalg.solve(inner, moments[size:, :size]).T
        return np.asarray(regression, dtype=np.float64).reshape(n, axes, axes)
    scaled = moments / np.outer(sigma, sigma)
    loading = np.linalg.eigh(scaled)[1][:, -axes:] * sigma[:, None]
    parts: Array = loading.reshape(n, axes, axes)
    if np.linalg.cond(parts[0]) > 1e6:
        return np.full((n, axes, axes), np.nan)
    relative = _product(parts, np.linalg.inv(parts[0]))
    nominal = np.array([nominal_orientation(part) for part in relative])
    mean = np.einsum("iba,ibc->ac", nominal, relative) / n
    return _product(relative, np.linalg.inv(mean))


def _product(a: Array, b: Array) -> Array:
    product: Array = np.einsum("iab,bc->iac", a, b)
    return product


def nominal_orientation(matrix: Array) -> Array:
    """Return the signed permutation near a matrix, or the rotation nearest to it, shape (axes, axes)."""
    u, _, vt = np.linalg.svd(matrix)
    rotation: Array = u @ vt
    permutation = np.zeros_like(matrix)
    rows = np.arange(len(matrix))
    columns = np.argmax(np.abs(rotation), axis=1)
    permutation[rows, columns] = np.sign(rotation[rows, columns])
    near = np.abs(rotation - permutation).max() < _NEAR_PERMUTATION and len(set(columns.tolist())) == len(rows)
    return permutation if near else rotation
