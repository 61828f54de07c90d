"""The time of each sample of a stream: the device's stamps without wrap-around, or arrival times, straightened."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array
from imulab.units import parse_unit

_WRAPS = 2**32
"""Counters of microseconds and of milliseconds begin again after so many."""
_SOON = 10.0
"""A stamp that goes on within so many seconds behind a wrap-around has wrapped around, s."""
_RESTART = 1.0
"""Stamps that jump back by more than this, s, are those of a device that has started again."""
_LATE = 1.5
"""Steps in time longer than so many usual ones have lost samples between them."""
_POINTS, _APART = 48, 0.5
_PAUSE, _PAUSE_STEPS = 0.5, 20.0
"""A stream without stamps that falls behind by more than both, s and steps, has paused."""


@dataclass
class Counts:
    """What was wrong with a stream so far.

    Attributes
    ----------
    lost
        Samples that are missing, by the steps in time.
    gaps
        Places where they are missing.
    repeated, reordered
        Samples that came again, or behind later ones; they are left out.
    damaged
        Lines or messages that could not be read, or stretches of bytes between them.
    restarts
        Times that the device began to count its time anew.
    """

    lost: int = 0
    gaps: int = 0
    repeated: int = 0
    reordered: int = 0
    damaged: int = 0
    restarts: int = 0


class DeviceClock:
    """Stamps of a device in their own unit, without wrap-around; they rise from sample to sample."""

    def __init__(self, unit: str, counts: Counts) -> None:
        self._factor = parse_unit(unit).factor
        self._wraps = sorted(_WRAPS * tick / self._factor for tick in (1e-6, 1e-3))
        self._counts = counts
        self._offset = 0.0
        self._last: float | None = None
        self._step: float | None = None

    def times(self, stamps: Array, arrival: float) -> tuple[Array, NDArray[np.bool_]]:
        """Return times in the stamps' unit, and which samples to keep, both of shape (n,)."""
        times = stamps + self._offset
        steps = np.diff(times, prepend=times[0] - 1.0 if self._last is None else self._last)
        kept = np.ones(len(times), dtype=np.bool_)
        if steps.min() <= 0:
            times, kept = self._mended(stamps.tolist())
        good = times[kept]
        if not good.size:
            return times, kept
        steps = np.diff(good) if self._last is None else np.diff(good, prepend=self._last)
        if steps.size:
            usual = float(np.median(steps))
            step = usual if self._step is None else self._step
            late = steps > _LATE * step
            if late.any():
                self._counts.gaps += int(late.sum())
                self._counts.lost += int((np.round(steps[late] / step) - 1).sum())
            # The usual step follows slowly, and no further than a jitter, so that gaps do not become usual.
            self._step = step + 0.05 * (min(usual, _LATE * step) - step)
        self._last = float(good[-1])
        return times, kept

    def _mended(self, stamps: list[float]) -> tuple[Array, NDArray[np.bool_]]:
        """Go through a block with a stamp that does not rise."""
        last = self._last
        times, kept = np.empty(len(stamps)), np.ones(len(stamps), dtype=np.bool_)
        for index, stamp in enumerate(stamps):
            time = stamp + self._offset
            if last is not None and time <= last:
                back = (last - time) * self._factor
                wrap = next((w for w in self._wraps if 0 < time + w - last <= _SOON / self._factor), None)
                if wrap is not None:
                    self._offset += wrap
                elif back > _RESTART:
                    self._counts.restarts += 1
                    self._offset = last + _RESTART / self._factor - stamp
                else:
                    kept[index] = False
                    self._counts.repeated += time == last
                    self._counts.reordered += time < last
                    continue
                time = stamp + self._offset
            times[index], last = time, time
        return times, kept


class ArrivalClock:
    """Times of samples without stamps: a robust line through arrival times over the numbers of samples.

    The line is Theil's (median of slopes; Sen 1968) through the ends of at most 48 blocks, half a second apart once
    there are so many, so that bursts of a driver or a network leave no trace and a drift is followed.
    """

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._numbers: list[float] = []
        self._arrivals: list[float] = []
        self._count = 0
        self._last = 0.0
        self._origin: float | None = None

    def times(self, count: int, arrival: float) -> Array:
        """Return the times of the next `count` samples, s from about the first, shape (count,)."""
        if self._origin is None:
            self._origin = arrival
        arrival -= self._origin
        number = self._count + count - 1.0
        slope, level = self._line()
        if slope and arrival - (level + slope * number) > max(_PAUSE, _PAUSE_STEPS * slope):
            self._counts.gaps += 1
            self._counts.lost += round((arrival - level) / slope - number)
            shift = arrival - (level + slope * number)
            self._arrivals = [each + shift for each in self._arrivals]
            level += shift
        known = self._numbers[-1] if self._numbers else -1.0
        if number > known and (len(self._numbers) < _POINTS or arrival - self._arrivals[-1] >= _APART):
            self._numbers.append(number)
            self._arrivals.append(arrival)
            del self._numbers[:-_POINTS], self._arrivals[:-_POINTS]
            slope, level = self._line()
        if not slope:  # one block only: its samples came since the time before, of which nothing is known
            slope = max(arrival - self._last, 1e-3) / count if self._count else 1e-2
            level = arrival - slope * number
        numbers = np.arange(self._count, self._count + count, dtype=np.float64)
        times: Array = level + slope * numbers
        if self._count and times[0] <= self._last:  # a better line lies lower: catch up with it without standing still
            end = max(float(times[-1]), self._last + 0.5 * slope * count)
            times = self._last + (end - self._last) / count * (numbers + 1 - self._count)
        self._count += count
        self._last = float(times[-1])
        return times

    def begin(self, counts: list[int], arrivals: list[float]) -> None:
        """Learn the line from the blocks of the first seconds before their times are asked for."""
        if not counts:
            return
        self._origin = arrivals[0]
        ends = np.cumsum(counts) - 1.0
        some = np.unique(np.linspace(0, len(ends) - 1, min(len(ends), _POINTS)).round().astype(int))
        self._numbers = ends[some].tolist()
        self._arrivals = [arrivals[k] - self._origin for k in some.tolist()]

    def _line(self) -> tuple[float, float]:
        if len(self._numbers) < 3:
            return 0.0, 0.0
        x, y = np.array(self._numbers), np.array(self._arrivals)
        one, other = np.triu_indices(len(x), 1)
        slope = float(np.median((y[other] - y[one]) / (x[other] - x[one])))
        return max(slope, 1e-7), float(np.median(y - slope * x))
