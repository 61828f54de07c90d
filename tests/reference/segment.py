"""Segmentation of a tumble recording into static attitudes, written out plainly.

Blocks of samples, windows of blocks, stretches of quiet windows, attitudes of stretches, and the error with which the
attitudes predict each other; one definition a function, without regard to speed. Shares nothing with the package.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def blocks(samples: Array, time: Array, length: int) -> tuple[Array, Array, Array]:
    """Return mean and mean squared scatter (b, 3) of blocks of samples (n, 3), and the longest step in time of each."""
    count = len(samples) // length
    parts = samples[: count * length].reshape(count, length, 3)
    mean = parts.mean(axis=1)
    steps = np.append(np.diff(time), 0.0)[: count * length].reshape(count, length)
    return mean, ((parts - mean[:, None]) ** 2).mean(axis=1), steps.max(axis=1)


def window_variance(mean: Array, scatter: Array, broken: NDArray[np.bool_], width: int) -> Array:
    """Return the variance of each window of blocks, summed over the axes, infinite where time breaks off within it."""
    result = []
    for first in range(len(mean) - width + 1):
        own = slice(first, first + width)
        between = mean[own] - mean[own].mean(axis=0)
        result.append(np.inf if broken[own].any() else (scatter[own].mean(axis=0) + (between**2).mean(axis=0)).sum())
    return np.array(result)


def stretches(variance: Array, limit: float, width: int, trim: int, fewest: int) -> list[tuple[int, int]]:
    """Return the runs of blocks that quiet windows cover, without their ends, where enough blocks are left."""
    covered = np.zeros(len(variance) + width - 1, dtype=bool)
    for first in np.flatnonzero(variance <= limit):
        covered[first : first + width] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], covered.astype(int), [0]])))
    trimmed = [(int(start) + trim, int(stop) - trim) for start, stop in edges.reshape(-1, 2)]
    return [(start, stop) for start, stop in trimmed if stop - start >= fewest]


def attitudes(mean: Array, found: list[tuple[int, int]], same: float) -> tuple[list[int], Array]:
    """Return the attitude of each stretch, where neighbours within `same` radii are one, and the attitudes' means."""
    own = np.array([mean[start:stop].mean(axis=0) for start, stop in found])
    radius = (own.max(axis=0) - own.min(axis=0)).max() / 2
    number = [0]
    for before, after in itertools.pairwise(own):
        number.append(number[-1] + int(np.linalg.norm(after - before) > same * radius))
    of_attitude = [
        np.vstack([mean[start:stop] for (start, stop), n in zip(found, number, strict=True) if n == k]).mean(axis=0)
        for k in range(number[-1] + 1)
    ]
    return number, np.array(of_attitude)


def ellipsoid_error(points: Array) -> float:
    """Return the root mean square error, in radii, of an ellipsoid through all points but one at that one."""
    centre = (points.max(axis=0) + points.min(axis=0)) / 2
    radius = (points.max(axis=0) - points.min(axis=0)).max() / 2
    x, y, z = ((points - centre) / radius).T
    design = np.column_stack([x * x, y * y, z * z, x * y, y * z, z * x, x, y, z])
    errors = []
    for out in range(len(points)):
        rest = np.arange(len(points)) != out
        coefficients = np.linalg.lstsq(design[rest], np.ones(len(points) - 1), rcond=None)[0]
        errors.append(1 - design[out] @ coefficients)
    return float(np.sqrt(np.mean(np.square(errors))) / 2)


def batches(
    mean: Array, found: list[tuple[int, int]], number: list[int], centre: Array, size: int
) -> tuple[list[int], Array, list[int], list[Array]]:
    """Return the first block and the moments of each batch, and for each attitude their number and their scatter."""
    first = [list(range(start, stop - size + 1, size)) for start, stop in found]
    moments, counts, scatters = [], [], []
    for k in range(max(number) + 1):
        x, y, z = (mean - centre[k]).T
        each = np.column_stack([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])
        begins = [at for begin, n in zip(first, number, strict=True) if n == k for at in begin]
        own = [each[at : at + size].mean(axis=0) for at in begins]
        deviation = np.array(own) - np.mean(own, axis=0)
        moments += own
        counts.append(len(own))
        scatters.append(deviation.T @ deviation)
    return [at for begin in first for at in begin], np.array(moments), counts, scatters


def motion(samples: Array, length: int, found: list[tuple[int, int]], number: list[int], centre: Array) -> list[Array]:
    """Return sums of products (a, 3, 3): differences of samples, blocks about the centre, and their slopes."""
    mean = blocks(samples, np.arange(float(len(samples))), length)[0]
    sums = [np.zeros((len(centre), 3, 3)) for _ in range(3)]
    for (start, stop), k in zip(found, number, strict=True):
        step = np.diff(samples[start * length : stop * length], axis=0)
        off = mean[start:stop] - centre[k]
        slope = (mean[start + 2 : stop] - mean[start : stop - 2]) / 2
        for total, rows in zip(sums, (step, off, slope), strict=True):
            total[k] += rows.T @ rows
    return sums
