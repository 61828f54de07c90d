"""Rotations from sampled rates: many segments at once, composed by pairs instead of sample by sample.

Source: Savage, Strapdown inertial navigation integration algorithm design, part 1, J. Guidance Control Dynamics 21
(1998) 19: the rotation vector of a constant rate is exact; pairs are composed as quaternions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array


def frame_rotations(rate: Array, time: Array, start: NDArray[np.int64], stop: NDArray[np.int64]) -> Array:
    """Return the matrices that carry fixed directions, in body components, from sample `start` to sample `stop`.

    ``dv/dt = -w x v``, with the rate between two samples taken as their mean.

    Parameters
    ----------
    rate
        Body rate w, rad/s, shape (n, 3).
    time
        s, shape (n,).
    start, stop
        First and last sample of each segment, shape (m,).

    Returns
    -------
    Array
        Shape (m, 3, 3).
    """
    index = start[:, None] + np.arange(int(max(1, (stop - start).max())))
    inside = index < stop[:, None]
    here, there = np.where(inside, index, 0), np.where(inside, index + 1, 0)
    return composed_turns(0.5 * (rate[here] + rate[there]) * (time[there] - time[here])[:, :, None])


def composed_turns(angle: Array) -> Array:
    """Return the matrices that carry fixed directions through the steps of each segment.

    Parameters
    ----------
    angle
        Rotation vector of the body in each step, rad, shape (m, n, 3); zero after a segment's end.

    Returns
    -------
    Array
        Shape (m, 3, 3).
    """
    q = _quaternions(_padded(-angle))
    while q.shape[1] > 1:
        q = _compose(q[:, 1::2], q[:, 0::2])
    return _matrices(q[:, 0])


def _padded(steps: Array) -> Array:
    """Steps with zeros behind them, shape (m, a power of two, k)."""
    missing = (1 << max(steps.shape[1] - 1, 0).bit_length()) - steps.shape[1]
    return np.pad(steps, ((0, 0), (0, missing), (0, 0)))


def _quaternions(vector: Array) -> Array:
    """Rotation vectors (..., 3) as quaternions (..., 4), scalar first."""
    half = 0.5 * np.sqrt(np.einsum("...i,...i->...", vector, vector))
    quaternions = np.empty((*half.shape, 4))
    quaternions[..., 0] = np.cos(half)
    # sin(half) / half is 1 to rounding below the least angle that is told from none.
    least = np.maximum(half, 1e-150)
    quaternions[..., 1:] = (0.5 * np.sin(least) / least)[..., None] * vector
    return quaternions


def _compose(second: Array, first: Array) -> Array:
    """Quaternion of the rotation `first` followed by `second`."""
    a, p, q, r = np.moveaxis(second, -1, 0)
    b, x, y, z = np.moveaxis(first, -1, 0)
    product = np.empty(np.broadcast_shapes(second.shape, first.shape))
    product[..., 0] = a * b - (p * x + q * y + r * z)
    product[..., 1] = a * x + b * p + (q * z - r * y)
    product[..., 2] = a * y + b * q + (r * x - p * z)
    product[..., 3] = a * z + b * r + (p * y - q * x)
    return product


def _matrices(q: Array) -> Array:
    """Rotation matrices (m, 3, 3) of unit quaternions (m, 4)."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrices: Array = np.array(rows).transpose(2, 0, 1)
    return matrices


@dataclass(frozen=True)
class Turns:
    """Turns over segments, and their sensitivity to errors of the rate.

    Attributes
    ----------
    matrix
        Carries fixed directions, in body components, from the start of each segment to its end, shape (m, 3, 3).
    weighted
        ``sum C_i' x_i dt`` for each weight x (k of them): an error ``dw = a x`` of the rate changes a carried
        direction v by ``C (v x sum C_i' x_i dt a)``. Shape (m, k, 3, 3).
    """

    matrix: Array
    weighted: Array


def weighted_turns(rate: Array, step: Array, weights: Array) -> Turns:
    """Compose turns with their sensitivities by pairs; both are monoids, so that no loop over samples is needed.

    Parameters
    ----------
    rate
        Mean rate of each step, rad/s, shape (m, n, 3).
    step
        Duration of each step, s, zero after a segment's end, shape (m, n).
    weights
        Shape (m, n, k).
    """
    angle = _padded(-rate * step[:, :, None])
    q = _quaternions(angle)
    half = _matrices(_quaternions(0.5 * angle).reshape(-1, 4)).reshape(*angle.shape, 3)
    scaled = _padded(weights * step[:, :, None])
    sums = scaled[..., None, None] * np.swapaxes(half, -1, -2)[:, :, None]
    while q.shape[1] > 1:
        first = q[:, 0::2]
        back = np.swapaxes(_matrices(first.reshape(-1, 4)).reshape(*first.shape[:2], 3, 3), -1, -2)
        sums = sums[:, 0::2] + back[:, :, None] @ sums[:, 1::2]
        q = _compose(q[:, 1::2], first)
    return Turns(_matrices(q[:, 0]), sums[:, 0])
