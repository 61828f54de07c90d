"""The rule of the clock: rate, jitter, gaps, coarse and repeated stamps, from the times of samples alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.rows import median, medians, quantile
from imulab.recording import Array, Recording

Rows = NDArray[np.int64]

GAP = 1.5  # usual steps: a longer step may be a gap
_AT_ONCE = 1 << 16  # steps that are looked at together
_COARSE = 0.2  # share of steps beyond the limit from which time stamps are coarse and the steps are no gaps
_BEAT = 0.3  # scatter of the distances between long steps, over their mean, below which they are a beat and no losses
_SHORT = 0.5  # usual steps: a shorter one may catch up with a late one
_LAG = 32  # samples over which the usual step is looked for first
_BESIDE, _FARTHEST = 9, 101  # stamps on each side of a long step that show whether it lasts
_ROUNDS = 3  # of gaps and usual step from each other
_LASTS = 0.5  # usual steps: what a gap moves all later stamps by, at least
_MANY, _SHARE = 5, 0.001  # rows, and share of the rows, that share a stamp where stamps are coarse
_FROZEN, _FEW_MORE = 3, 2  # times the usual number of rows at a stamp, and so many more: the clock stood still
_FEWEST_MARKS = 3  # stamps that show a rate
_ALIKE = 1.5  # readings: the numbers at two stamps that differ by less say nothing of which stamp is of which readings
_UNEQUAL = 0.05  # scatter of the readings at a stamp, over their number, from which readings may be lost
_SHORTEST_LOSS = 9  # steps: a long step exactly every so often, or less often, is a sample lost by a program
_MILLISECOND = (
    1.0005e-3  # s: but at steps as short it is the beat of a clock of milliseconds with a rate such as 990 Hz
)
_NEAR = 0.2  # of the median step: steps this close to a multiple of it are multiples
_APART, _WANDERS = 8, 3.0  # growth of the variance of delays from one step to eight, which random losses exceed
_FAR = 3.0  # steps: longer delays are none of coarse stamps
_SURE_RATE = 0.02  # largest relative uncertainty of a rate
_REPEATS = 0.5  # share of rows as the row before that makes such a row no sign of a message that came twice
_OTHERWISE_UNIQUE = 0.05  # share of different readings among rows that share a stamp, of a message that came twice


@dataclass(frozen=True, slots=True)
class Clock:
    """What the time stamps of a recording show.

    Attributes
    ----------
    rate
        Mean rate over what is no gap, Hz: samples over time; NaN where it cannot be told.
    jitter
        Standard deviation of the steps from stamp to stamp that are no gaps, s.
    gaps, missing
        The row before each gap, among those that are kept, and the number of samples missing in it.
    widest
        The longest step, s.
    tick
        Usual step from stamp to stamp, s, where readings share stamps; else 0.
    kept
        The rows without those that came again, shape (n,); None where all are.
    even
        The times of the kept rows in order, s, where readings share stamps; else None.
    replaced
        Whether rows that came again stand for others, which are missing.
    backwards
        Number of steps back in time.
    doubt
        Why the rate cannot be told; empty where it can.
    doubtful_row
        The row that shows it.
    """

    rate: float
    jitter: float = 0.0
    gaps: Rows = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    missing: Rows = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    widest: float = 0.0
    tick: float = 0.0
    kept: NDArray[np.bool_] | None = None
    even: Array | None = None
    replaced: bool = False
    backwards: int = 0
    doubt: str = ""
    doubtful_row: int = 0

    @property
    def step(self) -> float:
        """Usual step from sample to sample, s."""
        return 1 / self.rate

    @property
    def repeated(self) -> int:
        """Number of rows that came again."""
        return 0 if self.kept is None else int(np.count_nonzero(~self.kept))


def read_clock(time: Array, same: NDArray[np.bool_] | None = None, *, lossy: bool = False) -> Clock:
    """Return what time stamps, s, shape (n,), show.

    A step is a gap where it moves all later stamps by half a usual step or more: a late stamp, whose followers catch
    up, is none. Readings that share stamps are spread evenly, with the rate of a line of the stamps over their numbers.

    Parameters
    ----------
    same
        Which rows hold the values of the row before, shape (n,): such a row with the same stamp came again, if stamps
        are unique otherwise.
    lossy
        Whether samples are known to be missing, so that steps of several usual ones are gaps and no coarse stamps.
    """
    if len(time) <= 1:
        return Clock(np.nan, doubt="a single sample" if len(time) else "no samples")
    least, widest = step_range(time)
    if least > 0 and widest <= GAP * least < np.inf:  # no gap, whatever the usual step is
        return Clock((len(time) - 1) / float(time[-1] - time[0]), _jitter(time), widest=widest)
    step = np.diff(time)
    if not np.isfinite(step).all():
        return Clock(np.nan, doubt="a time that is no number", doubtful_row=int(np.argmin(np.isfinite(time))))
    if least < 0:
        row = int(np.argmax(step < 0)) + 1
        return Clock(
            np.nan,
            widest=widest,
            backwards=int(np.count_nonzero(step < 0)),
            doubt="time runs backwards",
            doubtful_row=row,
        )
    if least > 0:
        return _unique_stamps(time, step, lossy=lossy)
    kept = None if same is None else _without_repeats(step, same)
    if kept is None:
        return _shared_stamps(time)
    replaced = _replaced(time, kept)
    left = read_clock(time[kept], lossy=replaced)
    row = int(np.flatnonzero(kept)[left.doubtful_row])
    return replace(left, kept=kept, replaced=replaced, doubtful_row=row)


def same_rows(columns: Mapping[str, Array], above: Mapping[str, float] | None = None) -> NDArray[np.bool_]:
    """Return which rows equal the row before in all columns but time, shape (n,); `above` is the row before the first.

    Values that are no numbers are equal.
    """
    sensors = [name for name in columns if name != "time"]
    count = len(next(iter(columns.values()), ()))
    same = np.full(count, bool(sensors))
    for name in sensors:
        values = columns[name]
        before = np.concatenate([[np.nan if above is None else above[name]], values[:-1]])
        same &= (values == before) | (np.isnan(values) & np.isnan(before))
    if count and above is None:
        same[0] = False
    return same


EPOCHS = 946_684_800.0, 4_102_444_800.0  # s since 1970: the years 2000 to 2099


def is_epoch(seconds: float) -> bool:
    """Return whether a time, s, counts from 1970: a date of this century."""
    return EPOCHS[0] <= seconds < EPOCHS[1]


def epoch_of(metadata: Mapping[str, str], first: float) -> float | None:
    """Return when times were zero, s since 1970, by the first of them or the head's ``epoch``; None where unknown."""
    if is_epoch(first):
        return 0.0
    number, _, unit = metadata.get("epoch", "").strip().partition(" ")
    try:
        epoch = float(number)
    except ValueError:
        return None
    return epoch if unit.strip() in ("", "s") and is_epoch(epoch) else None


_AFTER_MIDNIGHT, _DAY = "s after midnight", 86_400.0


def begins_later(first: Recording, other: Recording) -> float:
    """Return by how much later than that of `first` the time 0 of `other` is, s; 0 where their heads do not tell.

    The heads of bags, and of files with dates or times of day, hold an ``epoch``.
    """
    epochs = [epoch_of(each.metadata, float(each.si("time")[0])) for each in (first, other)]
    if epochs[0] is not None and epochs[1] is not None:
        return round(epochs[1] - epochs[0], 6)  # what a number of s since 1970 resolves
    clocks = [each.metadata.get("epoch", "").partition(" ") for each in (first, other)]
    if all(clock[2] == _AFTER_MIDNIGHT for clock in clocks):
        late = float(clocks[1][0]) - float(clocks[0][0])
        return late - _DAY * round(late / _DAY)
    return 0.0


def utc(seconds: float) -> str:
    """Return a time since 1970, s, as a date: ``2022-06-22 20:13:58``."""
    return str(np.datetime64(int(seconds), "s")).replace("T", " ")


def _without_repeats(step: Array, same: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Return the rows that did not come again, shape (n,); None where rows of one stamp are readings.

    Counts that are equal by chance are as often equal in rows of different stamps.
    """
    still = np.concatenate([[False], step == 0])
    again = still & same
    count, others = int(np.count_nonzero(again)), int(np.count_nonzero(still & ~same))
    by_chance = float(same[1:][step > 0].mean()) if (step > 0).any() else 1.0
    if not count or by_chance > _REPEATS or others > _OTHERWISE_UNIQUE * (count + others):
        return None
    return ~again


def _replaced(time: Array, kept: NDArray[np.bool_]) -> bool:
    """Return whether rows that came again stand for others that did not come: the steps that hold them are long."""
    step = np.diff(time[kept])
    before = np.cumsum(kept)[~kept] - 1
    before = before[before < len(step)]
    return bool(before.size) and float(np.mean(step[before] > GAP * median(step))) > 1 - _OTHERWISE_UNIQUE


def step_range(time: Array) -> tuple[float, float]:
    """Return the shortest and the longest step between stamps, s, shape (n,), n >= 2; NaN where one is no number."""
    ends = [(part.min(), part.max()) for part in _steps(time)]
    return float(np.min(ends)), float(np.max(ends))


def _jitter(time: Array) -> float:
    """Return the standard deviation of the steps between stamps, s."""
    usual = float(time[-1] - time[0]) / (len(time) - 1)
    squares = (float(np.einsum("i,i", part, part)) for part in (step - usual for step in _steps(time)))
    return math.sqrt(math.fsum(squares) / (len(time) - 1))


def _steps(time: Array) -> Iterator[Array]:
    """Yield the steps between stamps part by part, so that those of a long log are never all in memory."""
    return (np.diff(time[start : start + _AT_ONCE + 1]) for start in range(0, len(time) - 1, _AT_ONCE))


def _unique_stamps(time: Array, step: Array, *, lossy: bool) -> Clock:
    usual, coarse = _usual(time, step, lossy=lossy)
    usual, rows, missing = _find_gaps(np.arange(len(time)), time, usual, coarse=coarse)
    regular = np.ones(len(step), dtype=bool)
    regular[rows] = False
    jitter = float(np.sqrt(np.mean((step[regular] - usual) ** 2)))
    return Clock(1 / usual, jitter, rows, missing, float(step.max()))


def _usual(time: Array, step: Array, *, lossy: bool) -> tuple[float, bool]:
    """Return a first guess of the usual step, s, and whether stamps are coarse or come in bursts."""
    middle = median(step)
    lag = min(_LAG if len(step) < 64 * _LAG else 8 * _LAG, len(step))
    over_many = median((time[lag:] - time[:-lag])[:: max(1, lag // 4)]) / lag
    long = np.flatnonzero(step > GAP * middle)
    regular = step[step <= GAP * middle]
    short = step.min() <= _SHORT * middle
    multiple = step / middle
    if not short and np.mean(np.abs(multiple - np.rint(multiple)) < _NEAR) > 1 - _NEAR:
        beats, apart = _are_even(long), np.diff(long)
        if beats and not lossy and middle <= _MILLISECOND:
            return over_many, True
        beats = beats and (np.ptp(apart) > 0 or apart[0] < _SHORTEST_LOSS)
        many = long.size > _COARSE * len(step)
        if (beats or many) and not lossy and not _wander(step / over_many - 1):
            return over_many, True
        return float(regular.mean()), False
    if long.size > _COARSE * len(step) or middle < _SHORT * over_many:
        return over_many, True
    return middle if short else float(regular.mean()), False


def _are_even(places: Rows) -> bool:
    """Return whether places of long steps follow each other at even distances: losses do so seldom."""
    apart = np.diff(places)
    return apart.size > _BESIDE and bool(apart.std() < _BEAT * apart.mean())


def _wander(late: Array) -> bool:
    """Return whether delays from stamp to stamp, in steps, add up as random losses do; coarse stamps come back."""
    late = np.clip(late, -_FAR, _FAR)  # a single long gap is neither
    total = np.cumsum(late)
    return len(late) > 2 * _APART and float(np.var(total[_APART:] - total[:-_APART])) > _WANDERS * float(np.var(late))


def _find_gaps(
    number: Rows, stamps: Array, usual: float, least: float = _LASTS, *, coarse: bool
) -> tuple[float, Rows, Rows]:
    """Return the usual step, s, the places of gaps between stamps, and how many samples are missing in each.

    Parameters
    ----------
    number, stamps
        The numbers of samples among those read, and their stamps, s, shape (m,): all, or the first of each stamp.
    usual
        First guess of the step from sample to sample, s.
    least
        Samples by which a gap moves all later stamps, at least.
    coarse
        Whether stamps are so coarse, or come in such bursts, that a long step alone is no gap.
    """
    steps, many = np.diff(stamps), np.diff(number)
    span, count = float(stamps[-1] - stamps[0]), int(number[-1] - number[0])
    places, missing = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    for _ in range(_ROUNDS):
        late = steps / usual - many
        wide = np.flatnonzero(late > least)
        guess = np.maximum(np.rint(late[wide]), 1).astype(np.int64)
        if wide.size and (coarse or (late < -_SHORT).any()):  # something may catch up
            wide, guess = _lasting(number, stamps, usual, wide, guess, least)
        outside = count - int(many[wide].sum())
        left = float(span - steps[wide].sum())
        settled = np.array_equal(wide, places)
        places, missing = wide, guess
        if outside > 0 and left > 0:
            usual = left / outside
        if settled:
            break
    if coarse and _are_even(places[missing == 1]):  # the beat of a rate with a clock
        places = places[missing > 1]
        usual = float(span - steps[places].sum()) / (count - int(many[places].sum()))
        missing = np.rint(steps[places] / usual - many[places]).astype(np.int64)
    return usual, places, missing


def _lasting(number: Rows, stamps: Array, usual: float, wide: Rows, guess: Rows, least: float) -> tuple[Rows, Rows]:
    """Return those of the long steps after which stamps stay late, and by how many samples."""
    late = np.concatenate([[0.0], np.diff(stamps) / usual - np.diff(number), [0.0]])
    with_next = late[wide + 1] + np.minimum(late[wide], late[wide + 2])
    wide, guess, with_next = (values[with_next > 0] for values in (wide, guess, with_next))
    kept = np.where(with_next >= least, guess, 0)
    reach = np.minimum(np.maximum(_BESIDE, 3 * guess + 2), _FARTHEST)
    for _ in range(_ROUNDS):
        moved = np.zeros(len(stamps))
        moved[wide + 1] = kept
        late = stamps / usual - number - np.cumsum(moved)
        shift = np.empty(len(wide))
        for size in np.unique(reach).tolist():
            these = np.flatnonzero(reach == size)
            beside = np.arange(size)
            after = late[np.minimum(wide[these, None] + 1 + beside, len(stamps) - 1)]
            before = late[np.maximum(wide[these, None] - beside, 0)]
            shift[these] = medians(after) - medians(before) + kept[these]
        now = np.where(shift >= least, np.maximum(np.rint(shift), 1), 0).astype(np.int64)
        if np.array_equal(now, kept):
            break
        kept = now
    return wide[kept > 0], kept[kept > 0]


def _shared_stamps(time: Array) -> Clock:
    """Return the clock of readings that share stamps: the line of stamps over the numbers of their readings."""
    step = np.diff(time)
    widest = float(step.max())
    still = np.flatnonzero(step == 0)
    first = int(still[0]) + 1
    marks = np.flatnonzero(step > 0) + 1  # the first reading of each stamp but the first
    if len(still) < max(_MANY, _SHARE * len(time)) or len(marks) < _FEWEST_MARKS:
        return Clock(np.nan, widest=widest, doubt="time stands still", doubtful_row=first)
    counts = np.diff(np.concatenate([[0], marks, [len(time)]]))
    longest = int(np.argmax(counts))
    if counts[longest] > _FROZEN * quantile(counts, 0.9) + _FEW_MORE:
        row = 1 + int(marks[longest - 1] if longest else 0)
        return Clock(
            np.nan,
            widest=widest,
            doubt=f"time stands still for {counts[longest]} rows",
            doubtful_row=row,
        )
    lag = min(max(1, len(marks) // 10), 200, len(marks) - 1)
    usual = median((time[marks[lag:]] - time[marks[:-lag]]) / (marks[lag:] - marks[:-lag]))
    of_last = _are_of_last(time, marks, usual)
    number = marks - 1 if of_last else marks
    stamps = time[number]
    tick = median(np.diff(stamps))
    scatter = quantile(np.abs(np.diff(stamps) / usual - np.diff(number)), 0.9)
    usual, places, missing = _find_gaps(number, stamps, usual, max(0.75, 1.5 * scatter), coarse=True)
    lost = np.zeros(len(number))
    lost[places + 1] = missing
    place = number + np.cumsum(lost)
    away = place - place.mean()
    usual = float(away @ stamps) / float(away @ away)
    late = stamps / usual - place
    uneven = float(np.diff(late).std())
    readings = float(np.mean(counts[1:-1]))
    if max(1.0, uneven) > _SURE_RATE * (number[-1] - number[0]) or (
        uneven > max(1.0, _UNEQUAL * readings) and _wander(np.diff(late))
    ):
        return Clock(
            np.nan,
            widest=widest,
            tick=tick,
            doubt=f"{counts[1:-1].min()} to {counts[1:-1].max()} rows at each of the time stamps, which are coarse",
            doubtful_row=first,
        )
    above = number[places] if of_last else number[places + 1] - 1
    even = _spread(len(time), number, stamps, usual, above)
    regular = np.ones(len(number) - 1, dtype=bool)
    regular[places] = False
    jitter = float(np.sqrt(np.mean((np.diff(stamps) - usual * np.diff(number))[regular] ** 2)))
    return Clock(1 / usual, jitter, above, missing, widest, tick, None, even)


def _are_of_last(time: Array, marks: Rows, usual: float) -> bool:
    """Return whether a stamp tells when its last reading was taken, not its first: the program stamps what it fetches.

    The readings since the stamp before are then those of this stamp, and not those of the one before.
    """
    counts = np.diff(np.concatenate([[0], marks, [len(time)]]))
    steps = np.diff(time[np.concatenate([[0], marks])]) / usual
    by_first, by_last = np.abs(steps - counts[:-1]), np.abs(steps - counts[1:])
    # The log may begin or end within a stamp: the readings of the first and of the last may be fewer than it had.
    better = int(np.count_nonzero((by_first > by_last + _ALIKE)[1:]))
    worse = int(np.count_nonzero((by_last > by_first + _ALIKE)[:-1]))
    return better > 2 * worse


def _spread(count: int, number: Rows, stamps: Array, usual: float, above: Rows) -> Array:
    """Return evenly spaced times of readings, s: one line between gaps, or through each stamp where they drift."""
    part = np.zeros(count, dtype=np.int64)
    part[above + 1] = 1
    part = np.cumsum(part)
    rows = np.arange(count)
    offset = stamps - usual * number
    level = np.bincount(part[number], offset) / np.bincount(part[number])
    even = np.asarray(usual * rows + level[part])
    furthest = float(np.abs(offset - level[part[number]]).max())
    if furthest <= 2 * max(median(np.diff(stamps)), 2 * usual) and (np.diff(even) > 0).all():
        return even
    ends = stamps[0] - usual * number[0], stamps[-1] + usual * (count - number[-1])
    return np.asarray(np.interp(rows, np.concatenate([[0], number, [count]]), [ends[0], *stamps, ends[1]]))
