"""Rotations from sampled rates, many segments at once.

Source: Savage, Strapdown inertial navigation integration algorithm design, part 1, J. Guidance Control Dynamics 21
(1998) 19: the rotation vector of a constant rate is exact; steps are composed as quaternions, in C (`_rotation`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import imulab.procedures.tumble._rotation as _rotation
from imulab.recording import Array


@dataclass(frozen=True)
class Turns:
    """Turns over segments, and their sensitivity to errors of the rate.

    Attributes
    ----------
    matrix
        Carries fixed directions, in body components, from the start of each segment to its end, shape (m, 3, 3).
    weighted
        ``sum C_i' x_i dt`` for each weight x (k of them), C_i from the start to the middle of step i: an error
        ``dw = a x`` of the rate changes a carried direction v by ``C (v x sum C_i' x_i dt a)``. Shape (m, k, 3, 3).
    """

    matrix: Array
    weighted: Array


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
    angle = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    return _turns(angle, np.empty((len(angle), 0)), start, stop).matrix


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
    return weighted_turns(angle, np.ones(angle.shape[:2]), np.empty((*angle.shape[:2], 0))).matrix


def weighted_turns(rate: Array, step: Array, weights: Array) -> Turns:
    """Compose turns with their sensitivities.

    Parameters
    ----------
    rate
        Mean rate of each step, rad/s, shape (m, n, 3).
    step
        Duration of each step, s, zero after a segment's end, shape (m, n).
    weights
        Shape (m, n, k).
    """
    segments, n = step.shape
    start = n * np.arange(segments)
    angle, scaled = rate * step[:, :, None], weights * step[:, :, None]
    return _turns(angle.reshape(-1, 3), scaled.reshape(segments * n, weights.shape[2]), start, start + n)


def _turns(angle: Array, weights: Array, start: NDArray[np.int64], stop: NDArray[np.int64]) -> Turns:
    """Segments of one sequence of steps, shape (n, 3), with weights (n, k) that hold the durations of the steps."""
    m, k = len(start), weights.shape[1]
    turns = Turns(np.empty((m, 3, 3)), np.empty((m, k, 3, 3)))
    _rotation.turns(
        np.ascontiguousarray(angle), np.ascontiguousarray(weights),
        np.ascontiguousarray(start, dtype=np.int64), np.ascontiguousarray(stop, dtype=np.int64),
        turns.matrix, turns.weighted,
    )  # fmt: skip
    return turns
