"""The columns of a board of whole IMUs, and the ends of their ranges, as they stand in a recording."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from imulab.device.imus import NO_LIMIT
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY

SENSORS = ("accel", "gyro")
_IN_A_ROW = 3  # equal readings at an extreme that show the end of a range
_LEAST = {"accel": 1.9 * STANDARD_GRAVITY, "gyro": math.radians(100)}  # no range ends below


def readings_of(recording: Recording, names: Mapping[str, list[list[str]]]) -> Array:
    """Return readings of accelerometers, m/s^2, and gyroscopes, rad/s, shape (n, 2, K, 3).

    Rows in which all are exactly zero are those of a lost link: not numbers.
    """
    readings = np.empty((len(recording), 2, len(names["accel"]), 3))
    for s, sensor in enumerate(SENSORS):
        for k, triad in enumerate(names[sensor]):
            for axis, name in enumerate(triad):
                readings[:, s, k, axis] = recording.si(name)
    readings[(readings == 0).all(axis=(1, 2, 3))] = np.nan
    return readings


class RangeFinder:
    """The ends of the ranges that readings reach, watched block by block.

    An extreme of a column is the end of its range where it stands three times in a row, far from rest.
    """

    def __init__(self, count: int) -> None:
        shape = (2, 2, count, 3)  # upwards and downwards
        self._most, self._run, self._longest = np.full(shape, -np.inf), np.zeros(shape, int), np.zeros(shape, int)

    def watch(self, readings: Array) -> None:
        """Take in the next readings, shape (n, 2, K, 3)."""
        if not len(readings):
            return
        for side, sign in enumerate((1.0, -1.0)):
            values = np.where(np.isfinite(readings), sign * readings, -np.inf)
            top = values.max(axis=0)
            higher = top > self._most[side]
            self._most[side] = np.maximum(top, self._most[side])
            self._run[side][higher] = self._longest[side][higher] = 0
            for at in np.argwhere(top == self._most[side]):
                self._count(side, tuple(at), values[(slice(None), *at)])
            self._run[side][top < self._most[side]] = 0

    def _count(self, side: int, at: tuple[int, ...], values: Array) -> None:
        held = values == self._most[side][at]
        breaks = np.flatnonzero(~held)
        if not breaks.size:
            self._run[side][at] += len(held)
            runs = self._run[side][at]
        else:
            runs = max(self._run[side][at] + breaks[0], np.diff(breaks, append=len(held)).max() - 1)
            self._run[side][at] = len(held) - 1 - breaks[-1]
        self._longest[side][at] = max(self._longest[side][at], runs)

    def limits(self) -> Array:
        """Return the sizes of readings at the end of the range, shape (2, K); `NO_LIMIT` where none is known."""
        least = np.array([_LEAST[sensor] for sensor in SENSORS])[:, None, None]
        ends = (self._longest >= _IN_A_ROW) & (self._most > least)
        return np.asarray(np.where(ends, self._most, NO_LIMIT).min(axis=(0, 3)))
