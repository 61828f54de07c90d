"""Elements on clocks of their own, brought to one; gaps in time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from imulab.errors import DataError
from imulab.estimation.sampling import usual_step
from imulab.recording import Array, Recording, check_finite, check_time

_GAP = 1.5
_MOST_OFFSET = 0.5
_TO_ESTIMATE = 16
_MOST_NAMED = 3


@dataclass
class Clock:
    """Watches time over the blocks of a recording: the sampling rate of its beginning, gaps, and order."""

    nominal: float | None = None
    steps: list[float] = field(default_factory=list)
    last: float | None = None
    count: int = 0
    total: float = 0.0
    gaps: list[str] = field(default_factory=list)

    def watch(self, block: Recording) -> None:
        """Check a block's time against what came before, and note its gaps.

        Raises
        ------
        DataError
            There is no time column, or time stands still or runs backwards.
        """
        if "time" not in block:
            raise DataError(f"{block.name}: no column time; found {' '.join(block.columns)}")
        time = check_time(block)
        if not len(time):
            return
        if self.last is not None and not time[0] > self.last:
            raise DataError(
                f"{block.name}: {block.place(0)}, column time: time runs backwards: expected more than "
                f"{self.last:.15g} s, found {time[0]:.15g} s"
            )
        known = time if self.last is None else np.concatenate([[self.last], time])
        step = np.diff(known)
        if len(self.steps) < _TO_ESTIMATE:
            self.steps += step[: _TO_ESTIMATE - len(self.steps)].tolist()
        if self.steps:
            longest = usual_step(np.array(self.steps))[1] if self.nominal is None else _GAP / self.nominal
            wide = np.flatnonzero(step > longest)
            for index in wide.tolist():
                self.count += 1
                self.total += float(step[index])
                if len(self.gaps) < _MOST_NAMED:
                    row = index + (0 if self.last is not None else 1)
                    self.gaps.append(
                        f"a gap of {step[index]:.6g} s before {block.place(row)} at {known[index + 1]:.6g} s"
                    )
        self.last = float(time[-1])

    @property
    def rate(self) -> float:
        """Sampling rate, Hz: as given, or from the first steps of time; 100 while there are none."""
        if self.nominal is not None:
            return self.nominal
        return 1 / usual_step(np.array(self.steps))[0] if self.steps else 100.0

    @property
    def settled(self) -> bool:
        """Whether further blocks can no longer change `rate`."""
        return self.nominal is not None or len(self.steps) >= _TO_ESTIMATE

    def lines(self, name: str) -> list[str]:
        """Return what there is to say of gaps."""
        found = [f"{name}: {gap}" for gap in self.gaps]
        if self.count > len(self.gaps):
            found.append(
                f"{name}: {self.count - len(self.gaps)} more gaps; {self.total:.6g} s in all {self.count} together"
            )
        return found


def own_clocks(recording: Recording) -> dict[int, str]:
    """Return the columns ``time_1 .. time_n`` in which elements have clocks of their own."""
    found = {}
    for name in recording.columns:
        number = name.removeprefix("time_")
        if number != name and number.isdecimal():
            found[int(number)] = name
    return found


def to_one_clock(blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Interpolate elements with clocks of their own (columns ``time_i``) to the column ``time``, block by block.

    Linear between an element's samples. Rows before an element's first sample or after its last are dropped.

    Raises
    ------
    DataError
        A clock stands still or runs backwards, or is more than half a second away from ``time``.
    """
    held: Recording | None = None
    until = -np.inf  # time of the last row given out
    for block in blocks:
        clocks = own_clocks(block)
        if not clocks:
            yield block
            continue
        if "time" not in block:
            raise DataError(f"{block.name}: columns time_1 .. but no column time; expected the clock to interpolate to")
        joined = block if held is None else _join(held, block)
        time, own = check_time(joined), _own_times(joined, clocks)
        start, stop = max(t[0] for t in own.values()), min(t[-1] for t in own.values())
        ready = np.flatnonzero((time > until) & (time >= start) & (time <= stop))
        if ready.size:
            until = float(time[ready[-1]])
            yield _interpolated(joined, time[ready], own, clocks, ready)
        keep = min(int(np.searchsorted(t, until, side="right")) - 1 for t in (*own.values(), time))
        held = _rows(joined, np.arange(max(keep, 0), len(time)))


def on_one_clock(recording: Recording) -> Recording:
    """Return a whole recording with its elements interpolated to the column ``time``; errors as for `to_one_clock`.

    Raises
    ------
    DataError
        The clocks have no time in common.
    """
    for block in to_one_clock([recording]):
        return block
    raise DataError(f"{recording.name}: the clocks of the elements have no time in common with column time")


def _join(first: Recording, second: Recording) -> Recording:
    columns = {name: np.concatenate([values, second.columns[name]]) for name, values in first.columns.items()}
    return replace(first, columns=columns)


def _own_times(recording: Recording, clocks: dict[int, str]) -> dict[int, Array]:
    own: dict[int, Array] = {}
    time = recording.si("time")
    for number, name in clocks.items():
        check_finite(recording, [name])
        own[number] = recording.si(name)
        step = np.diff(own[number])
        if step.size and step.min() <= 0:
            place = recording.place(int(np.argmax(step <= 0)) + 1)
            raise DataError(f"{recording.name}: {place}, column {name}: the clock runs backwards or stands still")
        apart = np.abs(own[number] - time)
        if apart.max() > _MOST_OFFSET:
            index = int(np.argmax(apart))
            raise DataError(
                f"{recording.name}: {recording.place(index)}, column {name}: the clocks disagree: "
                f"{own[number][index]:.9g} s where time is {time[index]:.9g} s; expected less than {_MOST_OFFSET} s "
                "apart"
            )
    return own


def _interpolated(
    block: Recording, time: Array, own: dict[int, Array], clocks: dict[int, str], ready: np.ndarray
) -> Recording:
    columns = {name: values[ready] for name, values in block.columns.items() if name not in clocks.values()}
    for name in columns:
        stem, _, number = name.rpartition("_")
        if stem.startswith("gyro") and number.isdecimal() and int(number) in own:
            columns[name] = np.interp(time, own[int(number)], block.columns[name])
    units = {name: block.units[name] for name in columns}
    return replace(block, columns=columns, units=units, first_row=block.first_row + int(ready[0]))


def _rows(block: Recording, index: np.ndarray) -> Recording:
    columns = {name: values[index] for name, values in block.columns.items()}
    return replace(block, columns=columns, first_row=block.first_row + (int(index[0]) if index.size else 0))
