"""Rests of a recording of turns by hand, and how far the unit turned between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError, SegmentError
from imulab.procedures.rate.choices import AXES
from imulab.procedures.rate.turnchecks import check_motions, even_stamps
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.units import parse_unit, to_si

_BLOCK = 0.1  # s
_LEAST, _TRIM = 6, 1
_STILL, _OF_LARGEST, _NOISE, _OUT, _OUT_WIDE, _WIDEST = 5.0, 0.02, 4.0, 3.0, 2.0, 10
_TURNED = np.radians(15)


@dataclass(frozen=True)
class AxisTurns:
    """The turns about one body axis.

    Attributes
    ----------
    count, angle
        Turns made, signed, and the angle that the gyroscope states, rad, shape (k,).
    residual, uncertainty
        What is left of each angle by the scale factor found, and its standard uncertainty, rad, shape (k,).
    scale, scale_uncertainty
        Stated over true angle.
    freedom
        Turns less one where they scatter beyond the fence, and that scatter is in the uncertainty; else None.
    motion
        Number of each turn among the motions, shape (k,).
    """

    count: Array
    angle: Array
    residual: Array
    uncertainty: Array
    scale: float
    scale_uncertainty: float
    freedom: int | None
    motion: tuple[int, ...]


@dataclass(frozen=True)
class Motions:
    """What happened between rests, m of them.

    Attributes
    ----------
    start, stop
        End of the rest before and start of the rest after, s, shape (m,).
    angle
        Net turn by the gyroscopes as they state it, whole turns included, about each body axis, rad, shape (m, 3).
    closing
        Rotation vector from the attitude before to that after, rad, shape (m, 3).
    zero
        Standard uncertainty of the angle by that of the zero between both rests, rad, shape (m, 3).
    before, after
        Mean specific force at the rests, m/s^2, shape (m, 3); None without accelerometers.
    steps
        Turns of each sample of a motion, rad, one array of shape (n, 3) each.
    span
        First and last sample of each motion.
    period
        Usual time between two samples, s.
    bias
        Mean output at rest, rad/s, shape (3,), and its standard uncertainty.
    notes
        What was done to the recording.
    """

    start: Array
    stop: Array
    angle: Array
    closing: Array
    zero: Array
    before: Array | None
    after: Array | None
    steps: tuple[Array, ...]
    bias: Array
    bias_uncertainty: Array
    span: tuple[tuple[int, int], ...]
    period: float
    notes: tuple[str, ...] = ()


def find_motions(recording: Recording, fence: float) -> Motions:
    """Find rests, and what the gyroscopes say of the motion between each two.

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
    unit = recording.triad_unit("gyro")
    if parse_unit(unit).quantity != "rate":
        raise DataError(f"{recording.name}: gyroscopes in {unit}; turns are counted in a unit of rate, such as deg/s")
    rate = to_si(recording.triad("gyro"), unit)
    force = to_si(recording.triad("accel"), recording.triad_unit("accel")) if "accel_x" in recording else None
    rests = _rests(time, rate)
    if len(rests) < 2:
        raise SegmentError(
            f"{recording.name}: {len(rests)} rests of 0.5 s found, expected one before and one after each turn: lay "
            "the unit against its fence, and wait 2 s"
        )
    check_motions(time, rate, rests, fence, recording.name)
    zero = np.array([rate[a:b].mean(axis=0) for a, b in rests])
    spread = np.array([_of_mean(rate[a:b]) for a, b in rests])
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
        closing=np.array([rotation_vector(composed(row[2])) for row in rows]),
        zero=np.array([row[3] for row in rows]),
        before=None if means is None else means[:-1],
        after=None if means is None else means[1:],
        steps=tuple(row[2] for row in rows),
        bias=zero.mean(axis=0),
        bias_uncertainty=zero.std(axis=0, ddof=1) / np.sqrt(len(zero)),
        span=tuple(row[4] for row in rows),
        period=float(np.median(np.diff(time))),
        notes=tuple(notes),
    )


def _rests(time: Array, rate: Array) -> list[tuple[int, int]]:
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
    steady = [_steady(means, a, b) for a, b in edges.tolist() if b - a >= _LEAST]
    return [((a + _TRIM) * size, (b - _TRIM) * size) for a, b in steady if b - a >= _LEAST]


def _steady(means: Array, first: int, last: int) -> tuple[int, int]:
    """Return first block and end of a rest without what at its ends stands out of it, as a turn that begins slowly."""
    width = int(np.clip((last - first) // 5, 1, _WIDEST))
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(means[first:last], axis=0)])
    part = (sums[width:] - sums[:-width]) / width
    off = np.linalg.norm(part - np.median(part, axis=0), axis=1)
    usual = np.flatnonzero(off <= (_OUT if width == 1 else _OUT_WIDE) * np.median(off))
    return first + int(usual[0]), first + int(usual[-1]) + width


def _of_mean(rate: Array) -> Array:
    """Return the standard uncertainty of a mean by those of its four quarters, or by the middle two, shape (3,).

    By these where the mean lies further from theirs, as a slow start or end of a turn in the rest makes it.
    """
    quarter = len(rate) // 4
    means = rate[: 4 * quarter].reshape(4, quarter, 3).mean(axis=1)
    return np.asarray(np.maximum(means.std(axis=0, ddof=1) / 2, np.abs(means.mean(axis=0) - means[1:3].mean(axis=0))))


def composed(steps: Array) -> Array:
    """Return the quaternion of small turns one after the other, rad, shape (n, 3), by halving their number.

    Each is taken from its integrated rates by the turn before (Bortz, IEEE Trans. AES-7 (1971) 61): ``a x b / 12``.
    """
    steps = steps + np.vstack([np.zeros(3), np.cross(steps[:-1], steps[1:]) / 12])
    size = np.linalg.norm(steps, axis=1, keepdims=True)
    found = np.hstack([np.cos(size / 2), steps * np.sinc(size / 2 / np.pi) / 2])
    while len(found) > 1:
        if len(found) % 2:
            found = np.vstack([found, [1.0, 0.0, 0.0, 0.0]])
        a, b = found[::2], found[1::2]
        scalar = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(axis=1, keepdims=True)
        vector = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
        found = np.hstack([scalar, vector])
    return np.asarray(found[0] / np.linalg.norm(found[0]))


def rotation_vector(quaternion: Array) -> Array:
    """Return the shortest rotation vector of a quaternion, rad, shape (3,)."""
    q = quaternion if quaternion[0] >= 0 else -quaternion
    size = float(np.linalg.norm(q[1:]))
    return np.asarray(q[1:] * (2 * np.arctan2(size, q[0]) / max(size, 1e-300)))


def carried(quaternion: Array, direction: Array) -> Array:
    """Return what a fixed direction becomes in body components through a turn of the body, shape (3,)."""
    w, v = quaternion[0], -quaternion[1:]
    return np.asarray(direction + 2 * w * np.cross(v, direction) + 2 * np.cross(v, np.cross(v, direction)))
