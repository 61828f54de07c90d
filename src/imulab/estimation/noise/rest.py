"""Logs at rest, column by column, as stretches that a noise model can be fitted to, in memory or block by block.

Rows without numbers and short gaps are bridged; long gaps end a stretch. A log of any length is read block by block;
one with other faults has to be in memory as a whole, where the messages about them are made.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding, Note, prefixed
from imulab.errors import DataError
from imulab.estimation.clock import read_clock
from imulab.estimation.column_noise import most_reach, moved_columns
from imulab.estimation.noise.readings import doubtful_units, dropouts, own_readings, takes_levels
from imulab.estimation.noise.spectrum import Accumulator, Stretch, slow_coefficients, transformed
from imulab.estimation.rows import deviation_of_steps, distinct, resolution
from imulab.estimation.sampling import (
    BRIDGED,
    KILOHERTZ_IN_MS,
    SAME_RATE,
    WIDEST_GAP,
    bridged,
    bridged_line,
    is_lossy,
    mend_stamps,
    mislabelled,
    sampling_rate,
    steady_part,
    usual_step,
)
from imulab.recording import Array, Recording, check_time
from imulab.units import parse_unit

# A recording at rest as stretches between gaps, or the reason why it cannot be.


FEWEST, SHORT = 500, 100.0
"""Fewest samples of a stretch; s below which only white noise and limits of slow noise can be determined."""
MOST, SHARE = 16, 0.05
"""Most stretches between gaps, and how long each must be relative to the longest."""
_PILED, _FEW_AT_END = 2, 10
"""An output is at the end of its range beyond so many times the readings at the next level, and so many more."""
_MOST_LEVELS = 50
"""Steps of a quantity's readings over its range from which their rounding does not matter."""
_COARSE_KELVIN = 0.2
"""Step of a temperature's readings from which a log is read as a whole, so that their rounding can be undone."""
_SHORT = 0.1
"""Share of the longest dwell at a level up to which another is no dwell, but noise beside an edge."""
_MOST_DWELLS, _LOWEST = 64, 8192
"""Dwells, the longest, and coefficients, the lowest, in which what rounding hides is followed."""
_MOST_BRIDGED = 0.02  # share of samples missing in short gaps beyond which neighbours are taken as such
_SEEN = 100_000  # samples of which distinct values are counted


@dataclass(frozen=True)
class Rest:
    """A recording at rest.

    Attributes
    ----------
    recording
        The part with one sampling rate, with bad rows bridged.
    interval
        Time between samples, s.
    parts
        For each stretch between gaps: first row, last + 1, and the places of its rows among evenly spaced samples (None
        where no row is missing).
    bridged
        Samples in gaps that were bridged by a straight line.
    notes
        Messages for the user.
    """

    recording: Recording
    interval: float
    parts: tuple[tuple[int, int, Array | None], ...]
    bridged: int
    notes: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Length of all stretches, s."""
        return self.interval * sum(_length(part) for part in self.parts)

    @property
    def short(self) -> bool:
        """Whether only white noise and limits of slow noise can be determined."""
        return self.duration < SHORT

    def samples(self, name: str) -> list[Array]:
        """Return the evenly spaced samples of a column, SI, stretch by stretch."""
        values = self.recording.si(name)
        return [
            values[start:stop] if place is None else np.interp(np.arange(place[-1] + 1), place, values[start:stop])
            for start, stop, place in self.parts
        ]

    def stretches(self, name: str) -> list[Stretch]:
        """Return the spectra of a column, stretch by stretch.

        Raises
        ------
        DataError
            The column is constant or clipped.
        """
        self._check(name)
        return [transformed(each, self.interval) for each in self.samples(name)]

    def slow(self, name: str) -> list[Array] | None:
        """Return the slow coefficients of a covariate, stretch by stretch; None where it does not change."""
        if name not in self.recording:
            return None
        samples = self.samples(name)
        if not all(np.isfinite(each).all() and float(np.ptp(each)) > 0 for each in samples):
            return None
        lines = [unrounded(each) for each in samples]
        slow = [slow_coefficients(each, self.interval) for each in lines if each is not None]
        return slow if len(slow) == len(samples) else None

    def hidden(self, name: str) -> list[Array]:
        """Return what the rounding of a covariate hides of it, stretch by stretch: see `hidden_by_rounding`."""
        return [hidden_by_rounding(each, self.interval) for each in self.samples(name)]

    def rounding(self, name: str) -> float:
        """Return the step of a slow quantity's readings, SI, where it is coarse for the range they take; else 0."""
        return max(map(coarse_step, self.samples(name)), default=0.0) if name in self.recording else 0.0

    def _check(self, name: str) -> None:
        values, unit = self.recording.column(name), self.recording.units[name]
        where = f"{self.recording.name}: column {name}"
        for start, stop, _ in self.parts:
            part = values[start:stop]
            if part.min() == part.max():
                raise DataError(
                    f"{where}: all samples are {part[0]:.6g} {unit}; expected the noise of a sensor at rest"
                )
            limit = _clipped(part)
            if limit is not None:
                count = int(np.count_nonzero(part == limit))
                lost = " (or are zeros in place of lost readings)" if limit == 0 else ""
                raise DataError(
                    f"{where}: {count} samples are at its limit, {limit:.6g} {unit}{lost}; expected a range that holds "
                    "the noise of a sensor at rest"
                )


def coarse_step(values: Array) -> float:
    """Return the step of readings of a slow quantity, shape (n,), that takes few levels and mostly repeats; else 0."""
    changes = np.flatnonzero(np.diff(values))
    step = resolution(values[distinct(np.concatenate([[0], changes, changes + 1]))])
    return 0.0 if 2 * len(changes) > len(values) or float(np.ptp(values)) > _MOST_LEVELS * step else step


@dataclass(frozen=True)
class _Dwells:
    """Where a slow quantity stays at one level of its readings, by the places of their changes, in samples.

    Between two changes by the same edge it has turned inside of its level, by anything from none to all of it, taken as
    uniform: a parabola of half a step, +- a step over root 12. Between changes by both edges the line through them is
    off by a parabola of a quarter of a step at most. Outside the first and the last change it may go anywhere.
    """

    place: Array
    middle: Array
    turns: Array
    step: float

    @property
    def long(self) -> NDArray[np.bool_]:
        """Whether each of them is a dwell: where the quantity is near an edge, its own noise changes the level."""
        length = np.diff(self.place)
        return np.asarray(length > _SHORT * length.max(initial=0.0))


def _dwells(values: Array, step: float) -> _Dwells:
    changes = np.flatnonzero(np.diff(values))
    middle: Array = (values[changes] + values[changes + 1]) / 2
    inside = np.sign(values[changes[:-1] + 1] - middle[:-1])
    place: Array = changes + np.float64(0.5)
    return _Dwells(place, middle, np.where(np.diff(middle) == 0, inside, 0.0), step)


def _bump(place: Array, count: int) -> tuple[slice, Array]:
    """Return the samples between two places, and a parabola that is 0 at both and 1 in the middle."""
    rows = slice(max(int(np.ceil(place[0])), 0), min(int(np.floor(place[1])) + 1, count))
    share = (np.arange(rows.start, rows.stop) - place[0]) / (place[1] - place[0])
    return rows, 4 * share * (1 - share)


def unrounded(values: Array) -> Array | None:
    """Return a slow quantity without the rounding of its readings, shape (n,); None where they show too little of it.

    Where most readings repeat the one before and few levels are taken, each change of level is at the middle of both,
    and the quantity is the line from one change to the next, with a parabola of half a step where it turns in between,
    held within its last level outside of them.
    """
    step = coarse_step(values)
    if not step:
        return values
    dwells = _dwells(values, step)
    place, middle = dwells.place, dwells.middle
    if float(np.ptp(middle)) == 0:
        return None
    inner = np.interp(np.arange(len(values)), place, middle)
    for start in np.flatnonzero(dwells.long & (dwells.turns != 0)).tolist():
        rows, bump = _bump(place[start : start + 2], len(values))
        inner[rows] += dwells.turns[start] * step / 2 * bump
    first, last = int(place[0] + 0.5), int(place[-1] + 0.5)
    for end, toward in ((slice(None, first), 1), (slice(last, None), -1)):
        ends = middle[::toward]
        far = int(np.argmax(ends != ends[0]))
        slope = (ends[far] - ends[0]) / (place[::toward][far] - place[::toward][0])
        line = ends[0] + slope * (np.arange(len(values))[end] - place[::toward][0])
        inner[end] = np.clip(line, values[end] - step / 2, values[end] + step / 2)
    return np.asarray(inner)


def hidden_by_rounding(values: Array, interval: float) -> Array:
    """Return the slow coefficients of what `unrounded` may be off by, a row of unit variance for each dwell, (k, J).

    They fall with the square of the frequency, so that only the lowest are returned; k is 0 for fine readings.
    """
    step, count = coarse_step(values), len(values)
    if not step:
        return np.empty((0, 0))
    dwells = _dwells(values, step)
    place = dwells.place
    size = np.where(dwells.turns != 0, step / np.sqrt(12), step / 4 / np.sqrt(3))
    longest = np.argsort(-np.diff(place) * dwells.long, kind="stable")[: min(_MOST_DWELLS, int(dwells.long.sum()))]
    rows = []
    for start in longest.tolist():
        where, bump = _bump(place[start : start + 2], count)
        rows.append(np.zeros(count))
        rows[-1][where] = size[start] * bump
    for edge, end in ((place[0], 0.0), (place[-1], count - 1.0)):
        outside = (np.arange(count) - edge) / (end - edge) if end != edge else np.zeros(count)
        rows.append(np.clip(outside, 0.0, None) * step / np.sqrt(12))
    return np.array([slow_coefficients(row, interval)[:_LOWEST] for row in rows])


def at_rest(recording: Recording, names: Sequence[str]) -> Rest:
    """Return a recording at rest as stretches of the columns `names`.

    A few rows without numbers and gaps of up to 10 samples become straight lines; longer gaps end a stretch. Where the
    rate changes, the longest part of one rate is used.

    Raises
    ------
    DataError
        There is no time or it does not rise, more than 1 % of the rows hold no numbers, a column moves, or no stretch
        holds 500 samples.
    """
    recording, notes = bridged(mend_stamps(recording), list(names))
    recording, more = own_readings(recording, names)
    recording, trimmed = steady_part(recording)
    notes = [*(prefixed(recording.name, note) for note in recording.notes), *notes, *more, *trimmed]
    if len(recording) < FEWEST:
        raise _too_few(recording, len(recording))
    rate, timing = sampling_rate(recording)
    for name, why in moved_columns(recording, list(names), rate).items():
        raise DataError(f"{recording.name}: column {name}: {why} Expected a unit at rest; choose its rest by --window")
    time = check_time(recording)
    usual = 1 / rate
    parts, filled, left_out, closed = _parts(time, lossy=is_lossy(recording))
    if not parts:
        raise _too_few(recording, left_out)
    # Lines about gaps come from notes_of_gaps: they say what follows for the noise, not for an Allan curve.
    notes += [line for line in timing if " in time, the longest " not in line]
    notes += [*notes_of_steps(recording, names), *doubtful_units(recording, names, rate)]
    notes += notes_of_gaps(recording.name, usual, list(map(_length, parts)), filled, left_out, len(time))
    if closed:
        # In less time than the samples took, a random walk went as far.
        high = 100 * (1 / math.sqrt(1 - closed) - 1)
        notes.append(
            Finding(
                f"{recording.name}: {100 * closed:.2g} % of the samples are lost in short gaps, which were closed up: "
                f"random walk comes out {high:.2g} % too large, time constants {100 * closed:.2g} % too short",
                "record again without lost samples",
            )
        )
    return Rest(recording, usual, tuple(parts), filled, tuple(notes))


def notes_of_steps(recording: Recording, names: Sequence[str]) -> list[str]:
    """Return notes on outputs whose steps are larger than their noise, from the first samples of a recording."""
    notes: list[str] = []
    for name in names:
        samples = recording.column(name)[:_SEEN]
        step, noise = resolution(samples), deviation_of_steps(samples) / math.sqrt(2)
        if step > noise > 0:
            notes.append(
                Finding(
                    f"{recording.name}: column {name}: steps of {step:.3g} {recording.units[name]}, {step / noise:.2g} "
                    "times the noise of a sample: the white noise holds what rounding adds, up to all of it",
                    "log finer steps: a smaller range, or more digits",
                )
            )
    return notes


def notes_of_gaps(
    name: str, interval: float, lengths: Sequence[int], filled: int, left_out: int, rows: int
) -> list[str]:
    """Return notes on what was bridged and left out of a log, and on short stretches; lengths in samples."""
    notes: list[str] = []
    if filled:
        kind = Note if filled < 0.01 * rows else Finding
        text = f"{name}: {filled} samples missing in short gaps are bridged by straight lines"
        notes.append(kind(text, "record again without lost samples"))
    duration = sum(lengths) * interval
    if len(lengths) > 1 or left_out:
        words = f"{len(lengths)} stretches of {duration:.4g} s in all" if len(lengths) > 1 else "one stretch"
        lost = f"; {left_out} samples in shorter ones are left out" if left_out else ""
        notes.append(
            Finding(
                f"{name}: gaps in time leave {words}, which are taken as records of the same noise{lost}",
                "record again without lost samples",
            )
        )
    if duration < SHORT:
        notes.append(
            Note(f"{name}: {duration:.3g} s; below {SHORT:g} s only white noise and limits of slow noise can be told")
        )
    return notes


def _too_few(recording: Recording, count: int) -> DataError:
    return DataError(f"{recording.name}: {count} samples in a row; expected at least {FEWEST}, better 100 s and more")


def _length(part: tuple[int, int, Array | None]) -> int:
    start, stop, place = part
    return stop - start if place is None else int(place[-1]) + 1


def _parts(time: Array, *, lossy: bool) -> tuple[list[tuple[int, int, Array | None]], int, int, float]:
    """Return stretches between gaps, how many samples are bridged within them, how many lie outside them, and a share.

    The share is that of the samples lost in short gaps where these are so many that lines across them would change the
    noise: then the samples on both sides are taken as neighbours.
    """
    clock = read_clock(time, lossy=lossy)
    wide, steps = clock.gaps, clock.missing + 1
    lost = int(clock.missing[steps <= WIDEST_GAP].sum())
    closed = 0.0
    if lost > _MOST_BRIDGED * len(time):
        closed = lost / (lost + len(time))
        wide, steps = wide[steps > WIDEST_GAP], steps[steps > WIDEST_GAP]
    edges = [0, *(wide[steps > WIDEST_GAP] + 1).tolist(), len(time)]
    parts: list[tuple[int, int, Array | None]] = []
    filled = 0
    for start, stop in pairwise(edges):
        inside = (wide >= start) & (wide < stop - 1) & (steps > 1)
        place = None
        if inside.any():
            between = np.ones(stop - start - 1)
            between[wide[inside] - start] = steps[inside]
            place = np.concatenate([[0.0], np.cumsum(between)])
        parts.append((start, stop, place))
    lengths = np.array([stop - start for start, stop, _ in parts])
    least = max(FEWEST, SHARE * int(lengths.max()))
    order = np.argsort(-lengths, kind="stable")[:MOST]
    kept = [parts[k] for k in sorted(order.tolist()) if lengths[k] >= least]
    filled = sum(_length(part) - (part[1] - part[0]) for part in kept)
    return kept, filled, int(len(time) - sum(stop - start for start, stop, _ in kept)), closed


def is_clipped(piled: int, next_to: int) -> bool:
    """Return whether the outermost level has more samples than noise puts there, by the number at the next level."""
    return piled > _FEW_AT_END and piled > _PILED * next_to + _FEW_AT_END


def _clipped(values: Array) -> float | None:
    """Return the limit at which samples pile up (more than twice as many as at the next level), or None."""
    if not takes_levels(values[:_SEEN]):
        return None
    for limit, outside, nearest in ((values.max(), np.less, np.max), (values.min(), np.greater, np.min)):
        piled = int(np.count_nonzero(values == limit))
        if piled > _FEW_AT_END:
            below = nearest(values[outside(values, limit)])
            if is_clipped(piled, int(np.count_nonzero(values == below))):
                return float(limit)
    return None


# A log of any length, read block by block: its rows go into spectra and are not kept.


_FEWEST_STEPS = 100
"""Fewest steps of time that show the rate."""


class _AsWholeError(Exception):
    """The log has to be read as a whole."""


@dataclass(frozen=True)
class LongRest(Rest):
    """A recording at rest whose rows were not kept: its `recording` has none. Otherwise as `Rest`.

    Attributes
    ----------
    spectra_by_column
        Spectra by column, stretch by stretch.
    temperature
        Slow coefficients of the temperature, stretch by stretch; None where it does not change.
    """

    spectra_by_column: dict[str, list[Stretch]] = field(default_factory=dict)
    temperature: list[Array] | None = None

    def stretches(self, name: str) -> list[Stretch]:
        """Return the spectra of a column, stretch by stretch."""
        return self.spectra_by_column[name]

    def slow(self, name: str) -> list[Array] | None:
        """Return the slow coefficients of the temperature, stretch by stretch; None where it does not change."""
        return self.temperature if name == "temperature" else None

    def hidden(self, name: str) -> list[Array]:
        """Return nothing for each stretch: a log with coarse readings is read as a whole."""
        return [np.empty((0, 0))] * len(self.parts)

    def rounding(self, name: str) -> float:
        """Return 0: a log with coarse readings is read as a whole."""
        return 0.0


def long_rest(blocks: Iterable[Recording], names: Sequence[str]) -> LongRest | None:
    """Return a log at rest from its blocks of rows, in order; None where it has to be read as a whole.

    Parameters
    ----------
    blocks
        Blocks of one file.
    names
        Columns to fit.
    """
    log = _Log(list(names))
    try:
        for block in blocks:
            log.add(block)
        return log.rest()
    except _AsWholeError:
        return None


class _Level:
    """Evidence of whether a column is at rest: means over 1 s, steps, and the outermost levels on both sides."""

    def __init__(self, samples: Array, size: int) -> None:
        self._size = size
        self._fine = takes_levels(samples)
        self._unfinished, self._last = samples[:0], samples[:0]
        self._least, self._most = np.inf, -np.inf
        self._sums = np.zeros(3)
        self._outer: tuple[dict[float, int], dict[float, int]] = ({}, {})

    def add(self, samples: Array) -> None:
        """Take the next samples, shape (k,)."""
        steps = np.diff(np.concatenate([self._last, samples]))
        self._last = samples[-1:].copy()
        self._sums += len(steps), steps.sum(), np.einsum("i,i", steps, steps)
        held = np.concatenate([self._unfinished, samples])
        means = held[: len(held) // self._size * self._size].reshape(-1, self._size).mean(axis=1)
        self._unfinished = held[len(means) * self._size :].copy()
        if len(means):
            self._least, self._most = min(self._least, means.min()), max(self._most, means.max())
        for sign, outer in zip((1.0, -1.0), self._outer, strict=True):
            left = sign * samples
            for _ in range(2):
                if len(left):
                    level = float(left.max())
                    outer[level] = outer.get(level, 0) + int(np.count_nonzero(left == level))
                    left = left[left < level]
            for level in sorted(outer)[:-2]:
                del outer[level]

    def settled(self, quantity: str) -> bool:
        """Whether the column is at rest, with noise and within its range."""
        count, total, square = self._sums.tolist()
        noise = float(np.sqrt(max(square / count - (total / count) ** 2, 0.0) / (2 * self._size)))
        clipped = self._fine and any(is_clipped(*(outer[k] for k in sorted(outer)[::-1])) for outer in self._outer)
        varies = all(len(outer) == 2 for outer in self._outer)
        return varies and not clipped and self._most - self._least <= most_reach(quantity, noise)


@dataclass(frozen=True)
class _Part:
    """A stretch: samples, how many of them were missing, spectra by column, slow coefficients of temperature."""

    count: int
    filled: int
    spectra: dict[str, Stretch]
    temperature: Array | None


class _Log:
    """A log that takes blocks of rows and turns them into stretches."""

    def __init__(self, names: list[str]) -> None:
        self._names = names
        self._head: Recording | None = None
        self._notes: dict[str, None] = {}
        self._waiting: Recording | None = None
        self._rows = self._bad = 0
        self._first_bad = ""
        self._coarse: list[str] = []
        self._time = np.empty(0)
        self._usual = self._longest = 0.0
        self._steps, self._duration = 0, 0.0
        self._levels: dict[str, _Level] = {}
        self._last: dict[str, float] = {}
        self._warm, self._range = False, np.array([np.inf, -np.inf])
        self._gathered: dict[str, Accumulator] = {}
        self._count = self._filled = 0
        self._parts: list[_Part] = []

    def add(self, block: Recording) -> None:
        """Take the next rows; last rows without numbers wait for the next block."""
        self._notes |= dict.fromkeys(block.notes)
        if self._waiting is not None:
            columns = {k: np.concatenate([self._waiting.columns[k], v]) for k, v in block.columns.items()}
            block = replace(block, columns=columns, first_row=self._waiting.first_row)
        fine = self._finite(block)
        stop = len(fine) - int(np.argmax(fine[::-1])) if fine.any() else 0
        self._waiting = _rows(block, stop, len(block)) if stop < len(block) else None
        if stop:
            self._take(_rows(block, 0, stop), fine[:stop])

    def rest(self) -> LongRest:
        """Return the log; it takes no more rows."""
        if self._head is None:
            raise _AsWholeError
        if self._waiting is not None:
            self._take(self._waiting, self._finite(self._waiting))
        self._end()
        head, interval = self._head, self._duration / self._steps
        settled = all(self._levels[name].settled(parse_unit(head.units[name]).quantity) for name in self._names)
        most = max(part.count for part in self._parts)
        parts = [part for part in self._parts if part.count >= max(FEWEST, SHARE * most)]
        if not settled or not parts or self._bad > BRIDGED * self._rows:
            raise _AsWholeError
        kept, filled = sum(part.count for part in parts), sum(part.filled for part in parts)
        bad = [bridged_line(head.name, self._bad, self._rows, self._first_bad)] if self._bad else []
        slow = [part.temperature for part in parts if part.temperature is not None]
        lengths = [part.count for part in parts]
        timing = mislabelled(head, 1 / interval, float(self._time[0]), self._duration, least=KILOHERTZ_IN_MS)
        return LongRest(
            head,
            interval,
            tuple((0, count, None) for count in lengths),
            filled,
            (
                *(prefixed(head.name, note) for note in self._notes),
                *bad,
                *(prefixed(head.name, note) for note in timing),
                *self._coarse,
                *notes_of_gaps(head.name, interval, lengths, filled, self._rows + filled - kept, self._rows),
            ),
            {name: [part.spectra[name] for part in parts] for name in self._names},
            slow if self._warm and self._range[1] > self._range[0] else None,
        )

    def _finite(self, block: Recording) -> NDArray[np.bool_]:
        return np.asarray(np.logical_and.reduce([np.isfinite(block.column(name)) for name in self._names]))

    def _take(self, block: Recording, fine: NDArray[np.bool_]) -> None:
        time = block.time
        if time is None or not np.isfinite(time).all():
            raise _AsWholeError
        columns = {name: np.asarray(block.si(name), dtype=np.float64) for name in self._names}
        if any(dropouts(values) is not None for values in columns.values()):
            raise _AsWholeError
        if not fine.all():
            self._first_bad = self._first_bad or block.place(int(np.argmin(fine)))
            self._bad += int(np.count_nonzero(~fine))
            columns = {name: self._bridge(name, values) for name, values in columns.items()}
        steps = np.diff(np.concatenate([self._time, time]))
        if len(steps) and not steps.min() > 0:
            raise _AsWholeError
        wide = 0 if self._head is None else int(np.count_nonzero(steps > self._longest))
        if wide and wide != len(read_clock(np.concatenate([self._time, time])).gaps):
            raise _AsWholeError  # late stamps among the gaps
        if self._head is None:
            self._begin(block, steps, columns)
        elif len(steps) >= _FEWEST_STEPS and abs(np.log(usual_step(steps)[0] / self._usual)) > SAME_RATE:
            raise _AsWholeError
        for name, level in self._levels.items():
            level.add(columns[name])
        if self._warm:
            warmth = np.asarray(block.si("temperature"), dtype=np.float64)
            self._warm = bool(np.isfinite(warmth).all())
            if self._warm and resolution(warmth) >= _COARSE_KELVIN:
                raise _AsWholeError
            self._range = np.array([min(self._range[0], warmth.min()), max(self._range[1], warmth.max())])
            columns["temperature"] = warmth
        self._add(steps, columns)
        self._rows += len(time)
        self._time = time[-1:].copy()

    def _bridge(self, name: str, values: Array) -> Array:
        """Return values with straight lines for missing numbers, from the last sample before the block on."""
        values = np.concatenate([[self._last.get(name, np.nan)], values])
        known = np.flatnonzero(np.isfinite(values))
        if not len(known):
            raise _AsWholeError
        return np.asarray(np.interp(np.arange(1, len(values)), known, values[known]))

    def _begin(self, block: Recording, steps: Array, columns: dict[str, Array]) -> None:
        if len(steps) < FEWEST:
            raise _AsWholeError
        self._head, filled = _rows(block, 0, 0), bridged(block, self._names)[0]
        if own_readings(filled, self._names)[1]:
            raise _AsWholeError
        rate = 1 / usual_step(steps)[0]
        self._coarse = [*notes_of_steps(filled, self._names), *doubtful_units(filled, self._names, rate)]
        self._warm = "temperature" in block
        self._usual, self._longest = usual_step(steps)
        self._levels = {name: _Level(columns[name], max(1, round(1 / self._usual))) for name in self._names}
        self._renew()

    def _renew(self) -> None:
        self._gathered = {name: Accumulator(self._usual) for name in self._names}
        if self._warm:
            self._gathered["temperature"] = Accumulator(self._usual, despike=False)
        self._count = self._filled = 0

    def _add(self, steps: Array, columns: dict[str, Array]) -> None:
        """Add rows to the stretch; beyond a long gap another stretch begins."""
        wide = steps > self._longest
        self._steps += int(np.count_nonzero(~wide))
        self._duration += float(steps[~wide].sum())
        many = np.where(wide, np.maximum(np.round(steps / self._usual), 1.0), 1.0)
        rows = len(columns[self._names[0]])
        first = rows - len(steps)  # 1 where the first row of the block is that of the log, and no step leads to it
        edges = [0, *(np.flatnonzero(many > WIDEST_GAP) + first).tolist(), rows]
        for number, (start, stop) in enumerate(pairwise(edges)):
            if number:
                self._end()
                self._renew()
            if stop > start:
                inside = many[start + 1 - first if number else 0 : stop - first]
                self._extend(inside, {name: values[start:stop] for name, values in columns.items()})

    def _extend(self, steps: Array, columns: dict[str, Array]) -> None:
        """Add rows, with straight lines across missing ones; a step in samples leads to each row but a log's first."""
        begun = len(columns[self._names[0]]) == len(steps)
        place = np.cumsum(np.concatenate([[0.0], steps]))
        even = place[-1] == len(steps)
        wanted = np.arange(float(begun), place[-1] + 1)
        for name, gathered in self._gathered.items():
            values = columns.get(name)
            if values is not None:
                known = [self._last[name], *values] if begun and not even else values
                gathered.add(values if even else np.interp(wanted, place, known))
        self._last = {name: float(values[-1]) for name, values in columns.items()}
        self._count += len(wanted)
        self._filled += len(wanted) - len(columns[self._names[0]])

    def _end(self) -> None:
        """End the stretch."""
        if len(self._parts) == MOST:
            raise _AsWholeError
        spectra, slow = {}, None
        if self._count >= FEWEST:
            interval = self._duration / self._steps
            spectra = {name: self._gathered.pop(name).stretch(interval) for name in self._names}
            slow = self._gathered.pop("temperature").slow() if self._warm else None
        self._parts.append(_Part(self._count, self._filled, spectra, slow))


def _rows(block: Recording, start: int, stop: int) -> Recording:
    """Return rows of a block."""
    columns = {name: values[start:stop] for name, values in block.columns.items()}
    return replace(block, columns=columns, first_row=block.first_row + start)
