"""The time of each sample of a stream: the device's stamps without wrap-around, or arrival times, straightened."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array
from imulab.units import parse_unit

_WRAPS = ((2**32, 1e-6), (2**32, 1e-3), (2**24, 1e-6), (2**16, 1e-3))
"""Counters that begin again: after how many ticks, and how long a tick is, s."""
_NEAR, _NEAR_STEPS = 0.25, 10.0
"""A stamp at most so far behind the last, s or usual steps, goes on from it."""
_SOON, _SOON_PART = 10.0, 0.005
"""A stamp that goes on within both behind a wrap-around, s and part of the counter's length, has wrapped around."""
_RESTART = 1.0
"""Stamps that jump back by more than this, s, are those of a device that has started again."""
_SET_ANEW = 600.0
"""Stamps that jump ahead by more than this, s, are those of a clock that was set: nobody waits so long in a test."""
_LATE = 1.5
"""Steps in time longer than so many usual ones have lost samples between them."""
_ALIKE = 5
"""So many steps that are alike tell the rate."""
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
    stray
        Samples whose stamp fits neither those before nor those after; they are left out.
    damaged
        Lines or messages that could not be read, or stretches of bytes between them.
    restarts
        Times that the device began to count its time anew, or that its clock was set.
    """

    lost: int = 0
    gaps: int = 0
    repeated: int = 0
    reordered: int = 0
    stray: int = 0
    damaged: int = 0
    restarts: int = 0

    def summary(self) -> str:
        """Return in words what was wrong; nothing where nothing was."""
        parts = (
            (self.lost, "lost"),
            (self.repeated, "came again and left out"),
            (self.reordered, "came late and left out"),
            (self.stray, "with a time that fits nowhere and left out"),
            (self.damaged, "damaged lines or messages"),
            (self.restarts, "times that the device started again or its clock was set"),
        )
        return ", ".join(f"{number} {words}" for number, words in parts if number)


class DeviceClock:
    """Stamps of a device in their own unit, without wrap-around; they rise from sample to sample.

    A stamp that jumps is believed once the next one goes on from it: a damaged digit moves one stamp, while a gap, a
    counter that begins again or a device that does moves all that follow.
    """

    def __init__(self, unit: str, counts: Counts) -> None:
        factor = parse_unit(unit).factor
        self._restart, self._set_anew = _RESTART / factor, _SET_ANEW / factor
        self._near = _NEAR / factor
        lengths = sorted(count * tick for count, tick in _WRAPS)
        self._wraps = [(length / factor, min(_SOON, _SOON_PART * length) / factor) for length in lengths]
        self._counts = counts
        self._offset = 0.0
        self._last: float | None = None
        self._step: float | None = None

    def times(self, stamps: Array) -> tuple[Array, NDArray[np.bool_], bool]:
        """Take stamps on.

        Returns
        -------
        times, kept, again
            Times in the stamps' unit and which samples to keep, both of shape (n,); whether the last sample is to be
            given again with the next ones, because only they can tell what its stamp is worth.
        """
        times = stamps + self._offset
        steps = np.diff(times) if self._last is None else np.diff(times, prepend=self._last)
        again = False
        if self._last is None or steps.min() <= 0 or steps.max() > self._reach(steps):
            times, kept, again = self._judged(stamps.tolist(), self._reach(steps))
        else:
            kept = np.ones(len(times), dtype=np.bool_)
        good = times[kept]
        if not good.size:
            return times, kept, again
        steps = np.diff(good) if self._last is None else np.diff(good, prepend=self._last)
        if steps.size:
            usual = float(np.median(steps))
            step = usual if self._step is None else self._step
            if len(steps) >= _ALIKE and steps.max() < _LATE * steps.min():
                step = usual  # all steps are alike: those of another rate, and no losses
            late = steps > _LATE * step
            if late.any():
                self._counts.gaps += int(late.sum())
                self._counts.lost += int((np.round(steps[late] / step) - 1).sum())
            # The usual step follows slowly, and no further than a jitter, so that gaps do not become usual.
            self._step = step + 0.05 * (min(usual, _LATE * step) - step)
        self._last = float(good[-1])
        return times, kept, again

    def _reach(self, steps: Array) -> float:
        """Return how far a stamp goes on from the last at most; `steps` tell it where no step is known yet."""
        step = self._step
        if step is None:
            step = float(np.median(np.abs(steps))) if steps.size else 0.0
        return max(self._near, _NEAR_STEPS * step)

    def _judged(self, stamps: list[float], reach: float) -> tuple[Array, NDArray[np.bool_], bool]:
        """Go through a block with a stamp that does not rise, or jumps ahead."""
        last = self._last
        times, kept = np.empty(len(stamps)), np.zeros(len(stamps), dtype=np.bool_)
        for index, stamp in enumerate(stamps):
            step = None if last is None else stamp + self._offset - last
            if step is not None and -self._restart <= step <= 0:
                self._counts.repeated += step == 0
                self._counts.reordered += step < 0
                continue
            if step is None or not 0 < step <= reach:
                after = next((other for other in stamps[index + 1 :] if other != stamp), None)
                if after is None:
                    self._counts.repeated += len(stamps) - 1 - index
                    return times, kept, True
                if not 0 < after - stamp <= reach:
                    self._counts.stray += 1
                    continue
                if last is not None:
                    self._jump(stamp, last)
            kept[index] = True
            times[index] = last = stamp + self._offset
        return times, kept, False

    def _jump(self, stamp: float, last: float) -> None:
        """Take a jump of the stamps out of the time, where it is none of time."""
        step = stamp + self._offset - last
        wrap = next((w for w, soon in self._wraps if step < 0 < step + w <= soon and stamp < w), None)
        if wrap is not None:
            self._offset += wrap
        elif step < 0 or step > self._set_anew:
            self._counts.restarts += 1
            self._offset = last + self._restart - stamp


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
