"""How far a unit turned between its rests, and what is wrong with a recording of turns.

A rest is where the rates stay at their noise; between two rests they are composed to one rotation, exactly for a rate
that is constant between samples. A recording whose stamps come in bursts is evened; one with a gap in a turn, or with
saturated outputs, is refused.

Source: Savage, J. Guidance Control Dynamics 21 (1998) 19 (rotation vectors and quaternions).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from imulab.display import Note, prefixed
from imulab.errors import DataError, SegmentError
from imulab.estimation.sampling import stamp_notes
from imulab.procedures.rate import AXES
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.units import parse_unit, to_si

# Rests, and how far the unit turned between them.


_BLOCK = 0.1  # s
_LEAST, _TRIM = 6, 1  # fewest blocks of a rest; blocks that are cut off at both its ends
_STILL, _OF_LARGEST, _NOISE = 5.0, 0.02, 4.0
"""A block is at rest if its scatter is below so many quiet ones, and its mean below this share of the largest rate or
so many sigma of a quiet mean."""
_OUT, _OUT_WIDE, _WIDEST = 3.0, 2.0, 10
"""Ends of a rest are cut off whose mean is off by so many medians: over one block, and over several, up to 10."""


@dataclass(frozen=True)
class Motions:
    """The m motions between rests.

    Attributes
    ----------
    start, stop
        End of the rest before and start of the rest after, s, shape (m,).
    angle
        Integral of each gyroscope's output over the motion, whole turns included, rad, shape (m, 3).
    closing
        Rotation vector from the attitude before to that after, rad, shape (m, 3).
    zero
        Standard uncertainty of the angle by that of the zero at both rests, rad, shape (m, 3).
    before, after
        Mean specific force at the rests, m/s^2, shape (m, 3); None without accelerometers.
    steps
        For each motion the small turns from sample to sample, rad, shape (n, 3).
    span
        First and last sample of each motion.
    period
        Usual time between two samples, s.
    zeros
        Mean output at each rest, rad/s, shape (m + 1, 3).
    notes
        Notes on changes to the recording, such as evened time stamps.
    """

    start: Array
    stop: Array
    angle: Array
    closing: Array
    zero: Array
    before: Array | None
    after: Array | None
    steps: tuple[Array, ...]
    zeros: Array
    span: tuple[tuple[int, int], ...]
    period: float
    notes: tuple[str, ...] = ()


def find_motions(recording: Recording, fence: float) -> Motions:
    """Return the motions between the rests of a recording.

    Raises
    ------
    SegmentError
        There are fewer than two rests.
    DataError
        The gyroscopes are not in a unit of rate, or a turn lacks samples or is saturated.
    """
    names = [f"gyro_{axis}" for axis in AXES]
    check_finite(recording, [name for name in names if name in recording])
    time, notes = even_stamps(check_time(recording), recording.name)
    notes += [prefixed(recording.name, note) for note in stamp_notes(recording)]
    unit = recording.triad_unit("gyro")
    if parse_unit(unit).quantity != "rate":
        raise DataError(f"{recording.name}: gyroscopes in {unit}; turns are counted in a unit of rate, such as deg/s")
    rate = to_si(recording.triad("gyro"), unit)
    force = to_si(recording.triad("accel"), recording.triad_unit("accel")) if "accel_x" in recording else None
    rests = _find_rests(time, rate)
    if len(rests) < 2:
        raise SegmentError(
            f"{recording.name}: {len(rests)} rests of 0.5 s found, expected one before and one after each turn: lay "
            "the unit against its fence, and wait 2 s"
        )
    check_motions(time, rate, rests, fence, recording.name)
    zero = np.array([rate[a:b].mean(axis=0) for a, b in rests])
    spread = np.array([_uncertainty_of_mean(rate[a:b]) for a, b in rests])
    middle = np.array([(time[a] + time[b - 1]) / 2 for a, b in rests])
    rows = []
    for k in range(len(rests) - 1):
        a, b = rests[k][1] - 1, rests[k + 1][0]
        share = ((time[a : b + 1] - middle[k]) / (middle[k + 1] - middle[k]))[:, None]
        free = rate[a : b + 1] - zero[k] * (1 - share) - zero[k + 1] * share
        steps = (free[1:] + free[:-1]) / 2 * np.diff(time[a : b + 1])[:, None]
        duration = float(time[b] - time[a])
        rows.append((time[a], time[b], steps, duration / 2 * np.sqrt(spread[k] ** 2 + spread[k + 1] ** 2), (a, b)))
    means = None if force is None else np.array([force[a:b].mean(axis=0) for a, b in rests])
    return Motions(
        start=np.array([row[0] for row in rows]),
        stop=np.array([row[1] for row in rows]),
        angle=np.array([row[2].sum(axis=0) for row in rows]),
        closing=np.array([rotation_vector(compose_turns(row[2])) for row in rows]),
        zero=np.array([row[3] for row in rows]),
        before=None if means is None else means[:-1],
        after=None if means is None else means[1:],
        steps=tuple(row[2] for row in rows),
        zeros=zero,
        span=tuple(row[4] for row in rows),
        period=float(np.median(np.diff(time))),
        notes=tuple(notes),
    )


def _find_rests(time: Array, rate: Array) -> list[tuple[int, int]]:
    """Return first sample and end of each stretch in which the gyroscopes are still."""
    size = max(2, round(_BLOCK / float(np.median(np.diff(time)))))
    count = len(rate) // size
    if count < 2 * _LEAST:
        return []
    blocks = rate[: count * size].reshape(count, size, 3)
    means, variance = blocks.mean(axis=1), blocks.var(axis=1).sum(axis=1)
    quiet = float(np.quantile(variance, 0.1))
    calm = variance <= _STILL**2 * quiet + 1e-24
    zero = np.median(means[calm][: 2 * _LEAST], axis=0)
    off = np.linalg.norm(means - zero, axis=1)
    still = calm & (off < max(_OF_LARGEST * float(off.max()), _NOISE * np.sqrt(quiet / size)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int))).reshape(-1, 2)
    steady = [_trim_rest(means, a, b) for a, b in edges.tolist() if b - a >= _LEAST]
    return [((a + _TRIM) * size, (b - _TRIM) * size) for a, b in steady if b - a >= _LEAST]


def _trim_rest(means: Array, first: int, last: int) -> tuple[int, int]:
    """Return first block and end of a rest without ends that are off it, as where a turn begins slowly."""
    width = int(np.clip((last - first) // 5, 1, _WIDEST))
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(means[first:last], axis=0)])
    part = (sums[width:] - sums[:-width]) / width
    off = np.linalg.norm(part - np.median(part, axis=0), axis=1)
    usual = np.flatnonzero(off <= (_OUT if width == 1 else _OUT_WIDE) * np.median(off))
    return first + int(usual[0]), first + int(usual[-1]) + width


def _uncertainty_of_mean(rate: Array) -> Array:
    """Return the standard uncertainty of a mean over a rest, shape (3,).

    By the scatter of its four quarters, or by its distance from the mean of the middle two if that is larger, as where
    the rest holds the slow start or end of a turn.
    """
    quarter = len(rate) // 4
    means = rate[: 4 * quarter].reshape(4, quarter, 3).mean(axis=1)
    return np.asarray(np.maximum(means.std(axis=0, ddof=1) / 2, np.abs(means.mean(axis=0) - means[1:3].mean(axis=0))))


def compose_turns(steps: Array) -> Array:
    """Return the quaternion of successive small turns, rad, shape (n, 3), by composing neighbours until one is left.

    A small turn is the integral b of the rates plus ``a x b / 12``, a that before (Bortz, IEEE Trans. AES-7 (1971) 61).
    """
    steps = steps + np.vstack([np.zeros(3), np.cross(steps[:-1], steps[1:]) / 12])
    size = np.linalg.norm(steps, axis=1, keepdims=True)
    quaternions = np.hstack([np.cos(size / 2), steps * np.sinc(size / 2 / np.pi) / 2])
    while len(quaternions) > 1:
        if len(quaternions) % 2:
            quaternions = np.vstack([quaternions, [1.0, 0.0, 0.0, 0.0]])
        a, b = quaternions[::2], quaternions[1::2]
        scalar = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(axis=1, keepdims=True)
        vector = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
        quaternions = np.hstack([scalar, vector])
    return np.asarray(quaternions[0] / np.linalg.norm(quaternions[0]))


def rotation_vector(quaternion: Array) -> Array:
    """Return the shortest rotation vector of a quaternion, rad, shape (3,)."""
    q = quaternion if quaternion[0] >= 0 else -quaternion
    size = float(np.linalg.norm(q[1:]))
    return np.asarray(q[1:] * (2 * np.arctan2(size, q[0]) / max(size, 1e-300)))


def carry_direction(quaternion: Array, direction: Array) -> Array:
    """Return a fixed direction in body components after a turn of the body, shape (3,)."""
    w, v = quaternion[0], -quaternion[1:]
    return np.asarray(direction + 2 * w * np.cross(v, direction) + 2 * np.cross(v, np.cross(v, direction)))


# Time stamps in bursts, gaps within a turn, and saturated outputs.


_QUICK, _SHARE_IN_BURSTS = 0.25, 0.25  # of the mean step; share of such short steps from which stamps come in bursts
_KEEPS = 0.1  # s by which such stamps are off a straight line at most
_GAP = 3.0  # usual steps: within a longer one motion may be hidden
_SHAKE = (2 * np.pi * 2.0) ** 2 / 12
"""Angle error across a gap, over rate and gap cubed: a straight line in place of a rate that a hand varies at 2 Hz."""
_STILL_SAMPLES = 10  # equal samples in a row from which an output stands still
_QUIET = 0.5  # share of equal neighbours at rest from which this is usual for the output


def even_stamps(time: Array, name: str) -> tuple[Array, list[str]]:
    """Return time stamps, s, evened where they come in bursts, and the note that says so.

    A quarter of the steps or more are shorter than a quarter of the mean, as no sensor samples, and the stamps keep to
    a straight line within 0.1 s and ten samples.
    """
    if len(time) < 2:
        raise DataError(f"{name}: {len(time)} row of readings; expected turns between rests, of thousands")
    step = np.diff(time)
    mean = float(step.mean())
    if float((step < _QUICK * mean).mean()) < _SHARE_IN_BURSTS:
        return time, []
    count = np.arange(len(time), dtype=np.float64)
    even = np.polynomial.Polynomial.fit(count, time, 1)(count)
    if float(np.abs(time - even).max()) > _KEEPS + _STILL_SAMPLES * mean:
        return time, []
    note = Note(
        f"{name}: the time stamps come in bursts (steps of {1e3 * float(step.min()):.3g} to "
        f"{1e3 * float(step.max()):.3g} ms): taken as even, {1 / float(even[1] - even[0]):.5g} Hz"
    )
    return np.asarray(even), [note]


def check_motions(time: Array, rate: Array, rests: list[tuple[int, int]], fence: float, name: str) -> None:
    """Refuse a gap inside a turn that may hide more motion than the fence, and an output that is saturated.

    Raises
    ------
    DataError
        There is one; the message names the time.
    """
    usual = float(np.median(np.diff(time)))
    repeats = np.mean([np.mean(np.diff(rate[a:b], axis=0) == 0, axis=0) for a, b in rests], axis=0)
    for (_, end), (start, _) in pairwise(rests):
        part, at = rate[end - 1 : start + 1], time[end - 1 : start + 1]
        step = np.diff(at)
        beside = np.maximum(np.linalg.norm(part[1:], axis=1), np.linalg.norm(part[:-1], axis=1))
        hidden = np.where(step > _GAP * usual, _SHAKE * beside * step**3, 0.0)
        worst = int(np.argmax(hidden))
        if hidden[worst] > fence:
            raise DataError(
                f"{name}: samples are missing from {at[worst]:.2f} to {at[worst + 1]:.2f} s, while the unit turned at "
                f"{np.degrees(beside[worst]):.0f} deg/s: the angle of that turn is not known; leave it out (--window)"
            )
        for axis in range(3):
            values = np.abs(part[:, axis])
            top = values == values.max()
            edges = np.flatnonzero(np.diff(np.concatenate([[False], top, [False]]).astype(int))).reshape(-1, 2)
            longest = edges[int(np.argmax(edges[:, 1] - edges[:, 0]))]
            if longest[1] - longest[0] >= _STILL_SAMPLES and repeats[axis] < _QUIET:
                raise DataError(
                    f"{name}: gyro_{AXES[axis]} stands still at {np.degrees(values.max()):.5g} deg/s from "
                    f"{at[longest[0]]:.2f} to {at[longest[1] - 1]:.2f} s: its output is saturated; turn more slowly"
                )
