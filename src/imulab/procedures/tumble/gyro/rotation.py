"""Rotations from sampled rates, and whether the accelerometer's axes belong to the gyroscope's.

Source: Savage, Strapdown inertial navigation integration algorithm design, part 1, J. Guidance Control Dynamics 21
(1998) 19: the rotation vector of a constant rate is exact; steps are composed as quaternions, in C (`_rotation`).

Where a recording holds both triads, the turn that the gyroscopes see between two attitudes must carry the first
direction of gravity into the second. Swapped or reversed axes make a left-handed or foreign frame that cannot.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

import imulab.procedures.tumble._rotation as _rotation
from imulab.columns import triad
from imulab.errors import DataError
from imulab.estimation.rows import median
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.recording import Array
from imulab.units import parse_unit, to_si

# Rotations from sampled rates, many segments at once.


class Turns(Struct, frozen=True):
    """Turns over segments, and their sensitivity to errors of the rate.

    Attributes
    ----------
    matrix
        Carries fixed directions, in body components, from the start of each segment to its end, shape (m, 3, 3).
    weighted
        ``sum C_i' x_i dt`` for each weight x (k of them), C_i from the start to the middle of step i: an error
        ``dw = a x`` of the rate changes a carried direction v by ``C (v x sum C_i' x_i dt a)``. Shape (m, k, 3, 3).
    squares
        ``sum (C_i' w_i dt)(C_i' w_i dt)'``: covariance, over p, of ``sum C_i' w_i dt`` over lost steps, where each is
        lost by itself with a small probability p. Shape (m, 3, 3), or (0, 3, 3) where it was not asked for.
    """

    matrix: Array
    weighted: Array
    squares: Array


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
    mean = 0.5 * (rate[1:] + rate[:-1])
    return _turns(mean, np.diff(time), np.empty((len(mean), 0)), start, stop).matrix


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


def weighted_turns(rate: Array, step: Array, weights: Array, *, squares: bool = False) -> Turns:
    """Return composed turns with their sensitivities, and where asked with their `squares`.

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
    return _turns(
        rate.reshape(-1, 3), step.ravel(), weights.reshape(segments * n, weights.shape[2]), start, start + n, squares
    )


def _turns(
    rate: Array, step: Array, weights: Array, start: NDArray[np.int64], stop: NDArray[np.int64], squares: bool = False
) -> Turns:
    """Return segments of one sequence of steps of rates, (n, 3), and durations, (n,), with weights (n, k)."""
    m, k = len(start), weights.shape[1]
    turns = Turns(np.empty((m, 3, 3)), np.empty((m, k, 3, 3)), np.empty((m if squares else 0, 3, 3)))
    _rotation.turns(
        np.ascontiguousarray(rate), np.ascontiguousarray(step), np.ascontiguousarray(weights),
        np.ascontiguousarray(start, dtype=np.int64), np.ascontiguousarray(stop, dtype=np.int64),
        turns.matrix, turns.weighted, turns.squares,
    )  # fmt: skip
    return turns


# Do the accelerometer's axes belong to the gyroscope's? Gravity's magnitude alone cannot tell two axes apart.


_LONGEST_TURN = 20.0  # s; beyond it the drift of a cheap gyroscope counts
_FEWEST_TURNS = 4  # turns by which the axes of both triads are matched
_WRONG = np.radians(15.0)
_RIGHT = np.radians(5.0)


def check_axes(attitudes: Attitudes, force: Array) -> None:
    """Check that gyroscope columns, where there are any, turn with the accelerometers.

    Parameters
    ----------
    attitudes
        Of a continuous recording; a table is not checked.
    force
        Calibrated specific force in each attitude, shape (n, 3), any unit.

    Raises
    ------
    DataError
        The axes do not agree as they are named, but would after exchanging or reversing some.
    """
    recording = attitudes.recording
    names = triad("gyro")
    time, pieces = recording.time, attitudes.pieces
    if time is None or pieces is None or not all(name in recording for name in names):
        return
    if any(parse_unit(recording.units[name]).quantity != "rate" for name in names):
        return
    if not all(np.isfinite(recording.column(name)).all() for name in names):
        return
    first = np.unique(pieces[:, 2], return_index=True)[1]
    last = np.append(first[1:], len(pieces)) - 1
    start, stop = pieces[last[:-1], 1] - 1, pieces[first[1:], 0]
    short = time[stop] - time[start] <= _LONGEST_TURN
    if np.count_nonzero(short) < _FEWEST_TURNS:
        return
    edges, samples = pieces[:, :2].ravel(), pieces[:, 1] - pieces[:, 0]
    bias = {
        name: np.mean(np.add.reduceat(recording.column(name)[: edges[-1]], edges[:-1])[::2] / samples) for name in names
    }
    rows = [slice(first, last + 1) for first, last in zip(start[short].tolist(), stop[short].tolist(), strict=True)]

    def turns(sign: float) -> Array:
        """Return the turns by the gyroscopes, or by all reversed, one at a time: a long log is large."""
        ends, matrices = np.zeros(1, dtype=np.int64), []
        for part in rows:
            rates = [to_si(recording.column(name)[part] - bias[name], recording.units[name]) for name in names]
            ends[0] = part.stop - part.start - 1
            matrices.append(frame_rotations(sign * np.column_stack(rates), time[part], np.zeros_like(ends), ends))
        return np.concatenate(matrices)

    turn = turns(1.0)
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    before, after = up[:-1][short], up[1:][short]
    if not _median_miss(turn, before, after) > _WRONG:
        return
    mirrored = turns(-1.0)
    miss = {}
    for name, m in _signed_permutations().items():
        miss[f"accelerometer columns taken as {name}"] = _median_miss(turn, before @ m.T, after @ m.T)
        # With all gyroscopes reversed, accelerometers taken as m are gyroscopes taken as -det(m) m'.
        axes = _axes_of(-np.linalg.det(m) * m.T)
        gyros = "gyroscopes all reversed" if axes == "-x -y -z" else f"gyroscope columns taken as {axes}"
        miss[gyros] = _median_miss(mirrored, before @ m.T, after @ m.T)
    # Reversing all three axes of gravity changes nothing: of two equals, the one with fewer reversals is meant.
    best = min(miss, key=lambda name: (round(miss[name], 9), name.count("-")))
    if miss[best] < _RIGHT:
        as_named = miss["accelerometer columns taken as x y z"]
        raise DataError(
            f"{recording.name}: columns accel_x accel_y accel_z: axes swapped or reversed: between attitudes the "
            f"direction of gravity misses the turn of gyro_x gyro_y gyro_z by {np.degrees(as_named):.0f} deg "
            f"(median of {np.count_nonzero(short)} turns), but by {np.degrees(miss[best]):.1f} deg with the {best}"
        )


def _median_miss(turn: Array, before: Array, after: Array) -> float:
    cosine = np.einsum("mij,mj,mi->m", turn, before, after)
    return median(np.arccos(np.clip(cosine, -1, 1)))


def _signed_permutations() -> dict[str, Array]:
    """All 48 ways to name three axes: text such as ``y x -z`` to matrix."""
    matrices = {}
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            matrices[_axes_of(matrix)] = matrix
    return matrices


def _axes_of(matrix: Array) -> str:
    """Return a signed permutation as text, ``y x -z``: which axis each row takes."""
    return " ".join(("-" if row.sum() < 0 else "") + "xyz"[np.argmax(np.abs(row))] for row in matrix)
