"""The time of each sample of a stream: the device's time stamps without wrap-around, or straightened arrival times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array
from imulab.units import parse_unit

_WRAPS = ((2**32, 1e-6), (2**32, 1e-3), (2**24, 1e-6), (2**16, 1e-3))
"""Counters that wrap around: after how many ticks, and the length of a tick, s."""
_NEAR, _NEAR_STEPS = 0.25, 10.0
"""A stamp at most this far after another, s or usual steps, continues it."""
_SURE = 2.5
"""A stamp at most so many usual steps after the last, or after a wrap-around, is accepted without a next one."""
_SOON, _SOON_PART = 10.0, 0.005
"""A stamp within both after a wrap-around, s and part of the counter's length, has wrapped around."""
_RESTART = 1.0
"""Stamps that jump back by more than this, s, show that the device has started again."""
_SET_ANEW = 600.0
"""Stamps that jump ahead by more than this, s, show that a clock was set: no test has such a pause."""
_SLOWEST = 10.0
"""s, the longest step of any rate."""
_LATE = 1.5
"""Steps longer than so many usual ones have lost samples between them."""
_ALIKE = 5
"""So many similar steps show the rate."""
_POINTS, _APART = 48, 0.5  # pairs of number and arrival that show the rate; s between them
_PAUSE, _PAUSE_STEPS = 0.5, 20.0
"""A stream without stamps that falls behind by more than both, s and steps, has paused."""
_PART = 0.1  # s of samples with shared stamps that are placed together
_FEWEST_PARTS, _FIRST_PART = 3, 1.5  # of these, and s of them, that show the rate of samples that share stamps


@dataclass
class Counts:
    """Faults of a stream so far.

    Attributes
    ----------
    lost
        Missing samples, by the steps in time.
    gaps
        Places where samples are missing.
    repeated, reordered
        Samples that came again, or after later ones; they are left out.
    stray
        Samples whose stamp fits neither those before nor those after; they are left out.
    damaged
        Lines or messages that could not be read, or stretches of bytes between them.
    restarts
        How often the device started its time again, or its clock was set.
    unread_share
        Share of the bytes that came faster than they were read, and are lost.
    """

    lost: int = 0
    gaps: int = 0
    repeated: int = 0
    reordered: int = 0
    stray: int = 0
    damaged: int = 0
    restarts: int = 0
    unread_share: float = 0.0

    def summary(self) -> str:
        """Return the faults in words; empty without any."""
        parts = (
            (self.lost, "lost"),
            (self.repeated, "came again and left out"),
            (self.reordered, "came late and left out"),
            (self.stray, "with a time that fits nowhere and left out"),
            (self.damaged, "damaged lines or messages"),
            (self.restarts, "times that the device started again or its clock was set"),
        )
        words = [f"{number} {text}" for number, text in parts if number]
        if self.unread_share:
            words.append(f"{100 * self.unread_share:.2g} % of the bytes, which came faster than they are read")
        return ", ".join(words)


class DeviceClock:
    """Time stamps of a device in their unit, without wrap-around; they rise from sample to sample.

    A stamp that jumps is accepted once the next one continues it, or the next two do in similar steps: a damaged digit
    moves one stamp, while a gap, a wrap-around, a restart or a slower rate moves all that follow. `wraps` is where
    stamps begin again, if that is known.
    """

    def __init__(self, unit: str, counts: Counts, wraps: float | None = None) -> None:
        factor = parse_unit(unit).factor
        self._restart, self._set_anew = _RESTART / factor, _SET_ANEW / factor
        self._near, self._slowest = _NEAR / factor, _SLOWEST / factor
        lengths = sorted({count * tick for count, tick in _WRAPS} | ({wraps * factor} if wraps else set()))
        self._wraps = [(length / factor, min(_SOON, _SOON_PART * length) / factor) for length in lengths]
        self._counts = counts
        self._offset = 0.0
        self._last: float | None = None
        self._step: float | None = None
        self._recent: Array = np.empty(0)
        self._missing: Array = np.empty(0)
        self._paused = False

    def cut(self) -> None:
        """Count no samples as lost before the next one: the stream was interrupted."""
        self._paused = True

    def times(self, stamps: Array) -> tuple[Array, NDArray[np.bool_], list[int]]:
        """Return the times of stamps.

        Returns
        -------
        times, kept, again
            Times in the stamps' unit and which samples to keep, both of shape (n,); the numbers of the samples to
            repeat before the next ones, because only those can decide on their stamps.
        """
        times = stamps + self._offset
        steps = np.diff(times) if self._last is None else np.diff(times, prepend=self._last)
        kept, again = np.ones(len(times), dtype=np.bool_), list[int]()
        usual = self._step or 0.0
        rising = steps[steps > 0]
        if len(rising) >= _ALIKE:
            usual = min(self._step or np.inf, _middle(rising))
        if self._last is None or steps.min() <= 0 or steps.max() > _SURE * usual:
            times, kept, again = self._judged(stamps.tolist(), usual)
        good = times[kept]
        if good.size:
            self._count(np.diff(good) if self._last is None or self._paused else np.diff(good, prepend=self._last))
            self._paused = False
            self._last = float(good[-1])
        return times, kept, again

    def _count(self, steps: Array) -> None:
        """Count the missing samples, and follow the usual step."""
        if not steps.size:
            return
        usual = _middle(steps)
        known = longer = usual if self._step is None else self._step
        joined = np.append(self._recent, steps)
        newest = joined[-_ALIKE:]
        if len(newest) == _ALIKE and _alike(newest.tolist()):
            self._step = float(newest.mean())
            longer = max(self._step, known)
        else:  # slowly, and only within the jitter, so that gaps do not become usual
            self._step = known + 0.05 * (min(usual, _LATE * known) - known)
        missing = np.append(self._missing, np.round(steps / longer) - 1)
        missing[joined <= _LATE * longer] = 0  # also of steps that turn out to be those of another rate
        self._counts.gaps += int(np.count_nonzero(missing)) - int(np.count_nonzero(self._missing))
        self._counts.lost += int(missing.sum() - self._missing.sum())
        self._recent, self._missing = joined[1 - _ALIKE :], missing[1 - _ALIKE :]

    def _judged(self, stamps: list[float], usual: float) -> tuple[Array, NDArray[np.bool_], list[int]]:
        """Return times, kept samples and repeats of a block with a stamp that falls, or jumps ahead."""
        last = self._last
        times, kept = np.empty(len(stamps)), np.zeros(len(stamps), dtype=np.bool_)
        for index, stamp in enumerate(stamps):
            step = None if last is None else stamp + self._offset - last
            if step is not None and -self._restart <= step <= 0:
                self._counts.repeated += step == 0
                self._counts.reordered += step < 0
                continue
            if step is None or not 0 < step <= _SURE * usual:
                places = _others(stamps, index)
                ahead = np.diff([stamps[place] for place in places]).tolist()
                believed = self._believed(step, ahead, max(self._near, _NEAR_STEPS * usual))
                if believed is None:
                    self._counts.repeated += len(stamps) - index - len(places)
                    return times, kept, places
                if not believed:
                    self._counts.stray += 1
                    continue
                if last is not None:
                    self._jump(stamp, last, _SURE * max(usual, ahead[0]))
            kept[index] = True
            times[index] = last = stamp + self._offset
        return times, kept, []

    def _believed(self, step: float | None, ahead: list[float], reach: float) -> bool | None:
        """Return whether to accept a stamp that jumped by `step`, by the one or two steps after it; None: not yet."""
        if not ahead:
            return None
        if ahead[0] <= 0 or (step is not None and 0 < step <= reach):
            return ahead[0] > 0
        if ahead[0] <= reach:  # a stamp that fell is rejected if the next one continues the last before it
            return step is None or not step < 0 < step + ahead[0] <= reach
        return ahead[0] <= self._slowest and _alike(ahead) if len(ahead) > 1 else None

    def _jump(self, stamp: float, last: float, sure: float) -> None:
        """Remove a jump of the stamps from the time unless time has really passed."""
        step = stamp + self._offset - last
        wrap = next((w for w, soon in self._wraps if step < 0 < step + w <= max(soon, sure) and stamp < w), None)
        if wrap is not None:
            self._offset += wrap
        elif step < 0 or step > self._set_anew:
            self._counts.restarts += 1
            self._offset = last + self._restart - stamp


def _others(stamps: list[float], index: int) -> list[int]:
    """Return the places of a stamp and of the next two stamps that differ from the one before."""
    places = [index]
    for place in range(index + 1, len(stamps)):
        if stamps[place] != stamps[places[-1]]:
            places.append(place)
        if len(places) == 3:
            break
    return places


def _middle(steps: Array) -> float:
    """Return the lower median; for a few numbers `numpy.median` takes ten times as long."""
    return float(np.sort(steps)[(len(steps) - 1) // 2])


def _alike(steps: Sequence[float]) -> bool:
    return max(steps) < _LATE * min(steps)


class SharedClock:
    """Time stamps of a device that several samples share: samples lie evenly, on a line through the stamps.

    The line is that of `ArrivalClock`, through the last sample of each stamp; the interface is that of `DeviceClock`.
    """

    def __init__(self, unit: str, counts: Counts, wraps: float | None = None) -> None:
        self._unit, self._factor, self._wraps = unit, parse_unit(unit).factor, wraps
        self._counts, self._of_stamps = counts, Counts()
        self._device: DeviceClock | None = None
        self._line, self._origin = ArrivalClock(counts), 0.0

    def cut(self) -> None:
        """Count no samples as lost before the next one: the stream was interrupted."""
        if self._device is not None:
            self._device.cut()
        self._line.cut()

    def times(self, stamps: Array) -> tuple[Array, NDArray[np.bool_], list[int]]:
        """Return the times of stamps, as `DeviceClock.times` does; the samples of the last stamp wait for the next."""
        begins = np.concatenate([[0], np.flatnonzero(np.diff(stamps)) + 1])
        times, kept = np.empty(len(stamps)), np.zeros(len(stamps), dtype=np.bool_)
        whole = len(begins) - 1
        waits = times, kept, list(range(len(stamps)))
        if not whole or (self._device is None and abs(stamps[-1] - stamps[0]) * self._factor < _FIRST_PART):
            return waits
        device = self._device or DeviceClock(self._unit, self._of_stamps, self._wraps)
        of_stamp, good, undecided = device.times(stamps[begins[:whole]])
        whole = undecided[0] if undecided else whole
        parts = self._parts(begins, of_stamp, np.flatnonzero(good[:whole]).tolist())
        if self._device is None:
            if len(parts) < _FEWEST_PARTS:
                vars(self._of_stamps).update(vars(Counts()))
                return waits
            self._device, self._origin = device, parts[0][1]
            self._line.begin([len(rows) for rows, _ in parts], [stamp for _, stamp in parts])
        for rows, stamp in parts:
            times[rows] = (self._origin + self._line.times(len(rows), stamp)) / self._factor
            kept[rows] = True
        self._counts.restarts, self._counts.stray = self._of_stamps.restarts, self._of_stamps.stray
        return times, kept, list(range(int(begins[whole]), len(stamps)))

    def _parts(self, begins: NDArray[np.intp], of_stamp: Array, places: list[int]) -> list[tuple[list[int], float]]:
        """Return the samples of a tenth of a second each, or of one stamp, and their last stamp, s."""
        parts: list[tuple[list[int], float]] = []
        begun = -np.inf
        for place in places:
            stamp, rows = float(of_stamp[place]) * self._factor, range(int(begins[place]), int(begins[place + 1]))
            if stamp - begun < _PART:
                parts[-1] = [*parts[-1][0], *rows], stamp
            else:
                parts.append(([*rows], stamp))
                begun = stamp
        return parts


class ArrivalClock:
    """Times of samples without stamps: a robust line of arrival times over the numbers of samples.

    The line is Theil's (median of slopes; Sen 1968) through the ends of at most 48 blocks, half a second apart once
    there are so many: bursts of a driver or a network have no effect, and a drift is followed.
    """

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._numbers: list[float] = []
        self._arrivals: list[float] = []
        self._count = 0
        self._last = 0.0
        self._origin: float | None = None
        self._paused = False

    def cut(self) -> None:
        """Count no samples as lost before the next one: the stream was interrupted."""
        self._paused = True

    def times(self, count: int, arrival: float) -> Array:
        """Return the times of the next `count` samples, s from about the first, shape (count,)."""
        if self._origin is None:
            self._origin = arrival
        arrival -= self._origin
        number = self._count + count - 1.0
        slope, level = self._line()
        if slope and arrival - (level + slope * number) > max(_PAUSE, _PAUSE_STEPS * slope):
            if not self._paused:
                self._counts.gaps += 1
                self._counts.lost += round((arrival - level) / slope - number)
            shift = arrival - (level + slope * number)
            self._arrivals = [each + shift for each in self._arrivals]
            level += shift
        self._paused = False
        known = self._numbers[-1] if self._numbers else -1.0
        if number > known and (len(self._numbers) < _POINTS or arrival - self._arrivals[-1] >= _APART):
            self._numbers.append(number)
            self._arrivals.append(arrival)
            del self._numbers[:-_POINTS], self._arrivals[:-_POINTS]
            slope, level = self._line()
        if not slope:  # one block only: its samples came since the time before, at an unknown rate
            slope = max(arrival - self._last, 1e-3) / count if self._count else 1e-2
            level = arrival - slope * number
        numbers = np.arange(self._count, self._count + count, dtype=np.float64)
        times: Array = level + slope * numbers
        if self._count and times[0] <= self._last:  # a better line lies lower: slow down until it catches up
            end = max(float(times[-1]), self._last + 0.5 * slope * count)
            times = self._last + (end - self._last) / count * (numbers + 1 - self._count)
        self._count += count
        self._last = float(times[-1])
        return times

    def begin(self, counts: list[int], arrivals: list[float]) -> None:
        """Fit the line to the blocks of the first seconds before their times are asked for."""
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
        earlier, later = np.triu_indices(len(x), 1)
        slope = float(np.median((y[later] - y[earlier]) / (x[later] - x[earlier])))
        return max(slope, 1e-7), float(np.median(y - slope * x))
