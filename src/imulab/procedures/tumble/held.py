"""The samples of the holds: the covariance of each mean, and how the attitudes moved while they were held.

Source: batch means: Fishman, Grouping observations in digital simulation, Management Science 24 (1978) 510.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import imulab.procedures.tumble._segment as _segment
from imulab.estimation.ranked import distinct, median, medians
from imulab.procedures.tumble.attitudes import POOL_DEGREES, Motion
from imulab.recording import Array, Recording

SMALLEST_BLOCK = 4
"""Samples of a block whose scatter is told."""
_TREMOR_SECONDS = 0.125
"""A period of a hand's tremor: the magnitudes of shorter blocks rectify it, longer ones hide the motion of the hand."""
_BATCHES = 10
"""Batches per attitude: few, so that they are long against the correlation of the noise, but enough to tell it."""


@dataclass(frozen=True)
class Held:
    """The samples of all holds, one after the other, in blocks as long as a hand's tremor.

    `start` and `stop` are the stretches in blocks, `attitude` says whose each is; `centre` is an attitude's mean.
    """

    samples: tuple[Array, Array, Array]
    mean: Array
    scatter: Array
    length: int
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    attitude: NDArray[np.int64]
    centre: Array

    @classmethod
    def of(cls, recording: Recording, names: list[str], stretches: NDArray[np.int64], step: float) -> Held:
        """Return the samples of the `stretches`, rows (first, last + 1, attitude), which are `step` apart, s."""
        begin, end, attitude = np.ascontiguousarray(stretches.T)
        usual = math.ceil(_TREMOR_SECONDS / step - 0.01)
        length = min(max(SMALLEST_BLOCK, usual), int((end - begin).min()) // 2)
        size = (end - begin) // length
        index = np.concatenate([np.arange(a, a + n * length) for a, n in zip(begin, size, strict=True)])
        x, y, z = (np.ascontiguousarray(recording.column(name)[index], dtype=np.float64) for name in names)
        stop = np.cumsum(size)
        mean, scatter, unused = np.empty((stop[-1], 3)), np.empty((stop[-1], 3)), np.empty(stop[-1])
        _segment.blocks(x, y, z, x, length, mean, scatter, unused)
        first = np.unique(attitude, return_index=True)[1]
        total = np.add.reduceat(size, first)[:, None]
        centre = np.add.reduceat(mean, (stop - size)[first]) / total
        return cls((x, y, z), mean, scatter, length, stop - size, stop, attitude, centre)


def _statistics(held: Held) -> tuple[Array, Array, Array]:
    """Return `Motion.moments` of each attitude, their degrees of freedom, and the share of a batch in all."""
    count = len(held.centre)
    size = held.stop - held.start
    total = np.bincount(held.attitude, size, count)
    per_batch = max(1, min(int(median(total)) // _BATCHES, int(size.min()) // 2))
    first = np.empty(int((size // per_batch).sum()), dtype=np.int64)
    number = np.empty(count, dtype=np.int64)
    scatter: Array = np.empty((count, 9, 9))
    _segment.batches(
        held.mean, held.start, held.stop, held.attitude, held.centre, per_batch,
        first, np.empty((len(first), 9)), number, scatter,
    )  # fmt: skip
    freedom, share = number.astype(np.float64) - 1, np.full(count, float(per_batch)) / total
    moments: Array = scatter * (share / np.maximum(freedom, 1))[:, None, None]
    return moments, freedom, share


def _pooled(covariance: Array, freedom: Array, share: Array) -> Array:
    """Covariance of each mean, shrunk towards the noise common to all: a few batches alone make poor weights."""
    scatter = covariance / share[:, None, None]
    level = np.trace(scatter, axis1=1, axis2=2)
    usual = level <= 3 * median(level)
    pooled = np.einsum("n,nij->ij", freedom[usual], scatter[usual]) / max(float(freedom[usual].sum()), 1.0)
    own = freedom[:, None, None]
    shrunk: Array = (own * scatter + POOL_DEGREES * pooled) / (own + POOL_DEGREES)
    return shrunk * share[:, None, None]


def _motion(held: Held, moments: Array, freedom: Array, share: Array) -> Motion:
    """How the attitudes moved: ``D = cov(x_k) - C_w / B + [mean(e e') - C_w / 2B] / 12``, B samples in a block."""
    count, size = len(held.centre), held.stop - held.start
    sums = np.empty((3, count, 3, 3))
    _segment.motion(
        *held.samples, held.length, held.mean, held.start, held.stop, held.attitude, held.centre, *sums
    )  # fmt: skip
    terms = size * held.length - 1, size, np.maximum(size - 2, 0)
    numbers = np.array([np.bincount(held.attitude, each, count) for each in terms])
    difference, spread, slope = sums / np.maximum(numbers, 1)[:, :, None, None]
    white = difference / (2 * held.length)
    pooled = medians(white, 0)
    each = np.repeat(held.attitude, size)
    within: Array = np.column_stack([np.bincount(each, held.scatter[:, axis], count) for axis in range(3)])
    within = within * held.length / (held.length - 1) / np.bincount(each, minlength=count)[:, None]
    return Motion(
        lengthening=white * (1 + 1 / 24) - spread - slope / 12,
        moments=moments,
        usual=(pooled + (1e-3 * np.trace(pooled) + np.finfo(float).tiny) * np.eye(3)) * share[:, None, None],
        freedom=freedom,
        shake=np.maximum(within - held.length * np.einsum("nii->ni", white), 0.0),
    )


def covariance_and_motion(
    held: Held, recording: Recording, names: list[str], resolution: Array
) -> tuple[Array, Motion | None]:
    """Return the covariance of each mean, with that of rounding, and the motion in the attitudes."""
    moments, freedom, share = _statistics(held)
    noise = np.sqrt(medians(held.scatter, 0))
    if (noise < resolution / 2).any():
        resolution = resolutions(recording, names)
    # Noise below half a step of the output does not average its rounding away.
    rounding = np.where(noise < resolution / 2, resolution**2 / 12, 0.0)
    covariance = _pooled(moments[:, :3, :3], freedom, share)
    for matrices in (moments, covariance):
        matrices[:, range(3), range(3)] += rounding
    return covariance, _motion(held, moments, freedom, share)


def resolutions(recording: Recording, names: list[str], part: int | None = None) -> Array:
    """Smallest step between the values of each channel, shape (3,), or within the first `part` samples of each.

    0 for a channel of one value, but infinite for a part of one.
    """
    found = np.full(len(names), 0.0 if part is None else np.inf)
    for axis, name in enumerate(names):
        samples = recording.column(name)
        values = distinct(samples[:: max(1, len(samples) // 100_000)][:part])
        if len(values) > 1:
            found[axis] = np.diff(values).min()
    return found
