"""Rotations from sampled rates: many segments at once, composed by pairs instead of sample by sample.

Source: Savage, Strapdown inertial navigation integration algorithm design, part 1, J. Guidance Control Dynamics 21
(1998) 19: the rotation vector of a constant rate is exact; pairs are composed as quaternions.
"""

from __future__ import annotations

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
    steps = int(max(1, (stop - start).max()))
    length = 1 << (steps - 1).bit_length()
    index = start[:, None] + np.arange(length)
    inside = index < stop[:, None]
    here, there = np.where(inside, index, 0), np.where(inside, index + 1, 0)
    angle = -0.5 * (rate[here] + rate[there]) * (time[there] - time[here])[:, :, None]
    q = _quaternions(angle)
    while q.shape[1] > 1:
        q = _compose(q[:, 1::2], q[:, 0::2])
    return _matrices(q[:, 0])


def _quaternions(vector: Array) -> Array:
    """Rotation vectors (..., 3) as quaternions (..., 4), scalar first."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * vector * np.sinc(half / np.pi)], axis=-1)


def _compose(second: Array, first: Array) -> Array:
    """Quaternion of the rotation `first` followed by `second`."""
    a, u = second[..., :1], second[..., 1:]
    b, v = first[..., :1], first[..., 1:]
    scalar = a * b - np.sum(u * v, axis=-1, keepdims=True)
    return np.concatenate([scalar, a * v + b * u + np.cross(u, v)], axis=-1)


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
