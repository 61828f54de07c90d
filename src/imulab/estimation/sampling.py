"""What time shows of a recording's sampling: rate, gaps, changes of rate, a wrong unit; rows without numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from imulab.display import Finding, Note, prefixed
from imulab.errors import DataError
from imulab.estimation.clock import EPOCHS, GAP, Clock, read_clock, same_rows, step_range
from imulab.estimation.rows import median, quantile
from imulab.recording import (
    EVEN_SAMPLES,
    Array,
    Recording,
    by_clock,
    check_finite,
    check_time,
    joined,
    state_rate,
    stored_as,
)
from imulab.units import ask_unit_of_time, likely_times, to_si

WIDEST_GAP = 10.0
"""Most sampling intervals across which readings are interpolated."""
_FEWEST = 3  # samples of a recording that has a rate
_COARSE = 0.2  # share of steps beyond the limit from which time stamps are coarse and the steps are no gaps
_BLOCKS, _SMALLEST_BLOCK = 100, 100  # blocks whose usual steps show a change of rate; fewest steps of a block
_MORE_IN_BURSTS = 10  # times as many steps of a block where stamps come in bursts
SAME_RATE = 0.05  # relative: parts of a recording whose steps are this close have one rate
_SLOWEST, _FAST, _FASTEST = 0.5, 20_000.0, 40_000.0
"""Rates, Hz: at the first and last the unit of time is doubted; between the others, gyroscopes of 32 kHz being made,
where another unit makes rate and duration likely."""
KILOHERTZ_IN_MS = 2.0
"""Rate, Hz, up to which samples at 1 or 2 kHz seem to come whose times in ms are titled s."""
TOO_SLOW = 5.0
"""Rate, Hz, up to which the unit of time is noted, for up to 5 kHz in ms titled s look like this, and doubted where
there are too few samples to go on."""
_MOMENT = 1.0  # s: a shorter recording is hardly one of a test
BRIDGED, FEW = 0.01, 0.001
"""Largest share of rows without numbers; share of the rows below which what is bridged or left out is only noted."""


_IN_PLACE = "; another one is missing for each"


class StampNote(Note):
    """What was done to rows because of their time stamps."""

    __slots__ = ()


class StampFinding(Finding):
    """The same, of so many rows that someone should look."""

    __slots__ = ()


class TimeUnitNote(Note):
    """The question whether the unit of time is right, where the rate is only rare."""

    __slots__ = ()


class TimeUnitFinding(Finding):
    """The same, where rate or duration are hardly those of a test."""

    __slots__ = ()


def mend_stamps(recording: Recording) -> Recording:
    """Return a recording whose time rises, with notes on what was done for that (`read_clock`).

    Rows that came again are dropped. Readings that share stamps are spread evenly, in their order. A recording whose
    time rises, or runs backwards, is returned as it is.

    Raises
    ------
    DataError
        Time stands still, or the rate cannot be told from coarse stamps; the message names the row, and `sample_rate`.
    """
    if not recording.on_one_clock:
        return by_clock(recording, mend_stamps)
    clock = _clock_of_shared(recording)
    if clock is None:
        return recording
    columns = dict(recording.columns)
    if clock.kept is not None:
        columns = {name: stored_as(values[clock.kept], values) for name, values in columns.items()}
    if clock.even is not None:
        columns["time"] = stored_as(clock.even / to_si(1.0, recording.units["time"]), columns["time"])
    lines = recording.lines_before if clock.kept is None else None
    return replace(
        recording, columns=columns, lines_before=lines, notes=(*recording.notes, *_stamp_notes(clock, len(recording)))
    )


def times_in_order(recording: Recording) -> Array:
    """Return a time for each row by the rule of `mend_stamps`, s, shape (n,); one that came twice has its stamp.

    Raises
    ------
    DataError
        As for `mend_stamps` and `check_time`.
    """
    clock = _clock_of_shared(recording)
    if clock is None:
        return check_time(recording)
    kept = np.ones(len(recording), dtype=bool) if clock.kept is None else clock.kept
    times = recording.si("time")[kept] if clock.even is None else clock.even
    return np.asarray(times[np.cumsum(kept) - 1])


def mend_blocks(blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Yield the blocks of `whole_where_shared` with `mend_stamps`."""
    return map(mend_stamps, whole_where_shared(blocks))


def whole_where_shared(blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Yield the blocks of a recording; as one where rows of the first share stamps, whose rate takes all of them."""
    rest = iter(blocks)
    for block in rest:
        yield joined([block, *rest]) if _shares(block.time) else block
        yield from rest


def _shares(time: Array | None) -> bool:
    return time is not None and bool((time[1:] == time[:-1]).any())


def _clock_of_shared(recording: Recording) -> Clock | None:
    """Return what stamps show that rows share; None where none do, or where time runs backwards or is no number.

    Raises
    ------
    DataError
        Time stands still, or the rate cannot be told from coarse stamps.
    """
    time = recording.time
    if time is None or not _shares(time):
        return None
    clock = read_clock(time, same_rows(recording.columns))
    if not clock.doubt:
        return clock
    if clock.backwards or not np.isfinite(time).all():
        return None  # refused by `check_time`, or bridged
    raise DataError(_standstill(recording, clock))


def _standstill(recording: Recording, clock: Clock) -> str:
    row = clock.doubtful_row
    raw, unit = recording.column("time"), recording.units["time"]
    place = f"{recording.name}: {recording.place(row)}, column time"
    if clock.doubt == "time stands still":
        return (
            f"{place}: time stands still: expected more than {raw[row - 1]:.15g} {unit}, found {raw[row]:.15g} {unit}; "
            f"{EVEN_SAMPLES}"
        )
    return f"{place}: {clock.doubt}: the sampling rate cannot be told; {EVEN_SAMPLES}"


def _stamp_notes(clock: Clock, rows: int) -> list[str]:
    notes: list[str] = []
    if clock.repeated:
        many = f"{clock.repeated} row{'s' if clock.repeated > 1 else ''} that came twice, with stamp and all values,"
        text = f"{many} {'are' if clock.repeated > 1 else 'is'} dropped{_IN_PLACE if clock.replaced else ''}"
        few = clock.repeated == 1 or clock.repeated < FEW * rows
        notes.append(StampNote(text) if few else StampFinding(text, "record each message once"))
    if clock.even is not None:
        notes.append(
            StampNote(
                f"readings share time stamps, which are {clock.tick:.3g} s apart: taken in order and as even, "
                f"{clock.rate:.6g} Hz by their number over time"
            )
        )
    return notes


def is_lossy(recording: Recording) -> bool:
    """Return whether rows of a recording were dropped that came twice, each in place of another."""
    return any(note.endswith(_IN_PLACE) for note in stamp_notes(recording))


def stamp_notes(recording: Recording) -> list[str]:
    """Return the notes of a recording on what was done to its time stamps."""
    return [note for note in recording.notes if isinstance(note, StampNote | StampFinding)]


def usual_step(step: Array) -> tuple[float, float]:
    """Return the usual step of time, s, and the longest step that is no gap, from steps of time, shape (n,), n >= 1.

    Beyond 1.5 times the median a step is a gap, unless a fifth of all steps are: then time is written that coarsely
    (stamps in whole milliseconds at 700 Hz alternate between 1 and 2 ms), and the limit is 1.5 times the step that a
    fifth exceed. The usual step is that of `read_clock`.
    """
    if step.max() <= GAP * step.min():  # no gap, whatever the median is
        usual = float(step.mean())
        return usual, GAP * usual
    longest = GAP * median(step)
    if np.mean(step > longest) > _COARSE:
        longest = GAP * quantile(step, 1 - _COARSE)
    return read_clock(np.concatenate([[0.0], np.cumsum(step)])).step, longest


def sampling_rate(recording: Recording) -> tuple[float, list[str]]:
    """Return the mean sampling rate of a recording over what is no gap, Hz, and warnings about its time.

    The warnings name gaps, a change of rate, and a rate at which no sensor is logged (then the unit of time is wrong).

    Raises
    ------
    DataError
        There is no time column, time does not rise, or there are fewer than 3 samples.
    """
    if "time" not in recording:
        raise DataError(
            f"{recording.name}: no column time; expected one, the noise depends on the sampling rate; "
            f"{state_rate(recording.name)}"
        )
    time = check_time(recording)
    if len(time) < _FEWEST:
        raise DataError(f"{recording.name}: {len(time)} samples are too few; expected at least {_FEWEST}")
    lossy = is_lossy(recording)
    start, stop = steady_rows(time, lossy=lossy)
    clock = read_clock(time[start:stop], lossy=lossy)
    odd = mislabelled(recording, clock.rate, float(time[0]), float(time[-1] - time[0]), least=KILOHERTZ_IN_MS)
    odd = [prefixed(recording.name, line) for line in odd]
    if (start, stop) != (0, len(time)):
        return clock.rate, [_change(recording, time, start, stop), *odd]
    count = len(clock.gaps)
    if not count:
        return clock.rate, odd
    step = time[clock.gaps + 1] - time[clock.gaps]
    worst = int(np.argmax(step))
    return clock.rate, [
        Finding(
            f"{recording.name}: {count} gap{'s' if count > 1 else ''} in time, the longest {step[worst]:.3g} s "
            f"after {recording.place(int(clock.gaps[worst]))}; the samples on both sides are taken as neighbours",
            "record again without lost samples",
        ),
        *odd,
    ]


def steady_rows(time: Array, *, lossy: bool = False) -> tuple[int, int]:
    """Return the first row, and the last plus 1, of the longest stretch with one sampling rate; times in s, shape (n,).

    Blocks of at least a hundred samples have different rates where their usual steps differ by more than 5 %; a single
    block that differs is passed over. `lossy` is as for `read_clock`.
    """
    if len(time) > 1:
        least, widest = step_range(time)
        if widest < (1 + SAME_RATE / 2) * least:  # as most are
            return 0, len(time)
    step = np.diff(time)
    size = max(_SMALLEST_BLOCK, -(-len(step) // _BLOCKS))
    if step.size and median(step) < float(step.mean()) / 2:  # in bursts: a block holds many of them
        size *= _MORE_IN_BURSTS
    count = len(step) // size
    if count < 2:
        return 0, len(time)
    blocks = [time[k * size : (k + 1) * size + 1] for k in range(count)]
    size_of_step = np.log([read_clock(block, lossy=lossy).step for block in blocks])
    best = (0, 0)
    for level in size_of_step:
        same = np.abs(size_of_step - level) < SAME_RATE
        same[1:-1] |= same[:-2] & same[2:]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
        runs = edges.reshape(-1, 2)
        widest = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))]
        if widest[1] - widest[0] > best[1] - best[0]:
            best = (int(widest[0]), int(widest[1]))
    return best[0] * size, len(time) if best[1] == count else best[1] * size


def steady_part(recording: Recording) -> tuple[Recording, list[str]]:
    """Return the longest stretch of a recording with one sampling rate, and a warning where that is not all of it.

    Raises
    ------
    DataError
        Time does not rise.
    """
    if "time" not in recording:
        return recording, []
    time = check_time(recording)
    start, stop = steady_rows(time, lossy=is_lossy(recording))
    if (start, stop) == (0, len(time)):
        return recording, []
    columns = {name: values[start:stop] for name, values in recording.columns.items()}
    line = Finding(
        f"{_change(recording, time, start, stop)}; used are {recording.place(start)} to {recording.place(stop - 1)}, "
        f"{time[stop - 1] - time[start]:.4g} s",
        "state the part to use (--window)",
    )
    return replace(recording, columns=columns, first_row=recording.first_row + start), [line]


def bridged(recording: Recording, names: list[str]) -> tuple[Recording, list[str]]:
    """Return a recording without the few rows that hold no numbers, and a message that counts them.

    A row without a time is dropped; other samples that are not finite become the line through their neighbours.

    Raises
    ------
    DataError
        More than 1 % of the rows are bad; the message names the first.
    """
    bad = np.zeros(len(recording), dtype=bool)
    for name in names:
        bad |= ~np.isfinite(recording.column(name))
    timed = np.isfinite(recording.column("time")) if "time" in recording else np.ones(len(recording), dtype=bool)
    count = int(np.count_nonzero(bad | ~timed))
    if not count:
        return recording, []
    if count > BRIDGED * len(recording):
        check_finite(recording, [*names, *(["time"] if "time" in recording else [])])
    columns = dict(recording.columns)
    if not timed.all():
        columns = {name: stored_as(values[timed], values) for name, values in columns.items()}
    row = np.arange(len(recording), dtype=np.float64)[timed]
    for name in names:
        fine = np.isfinite(columns[name])
        if not fine.all():
            columns[name] = stored_as(np.interp(row, row[fine], columns[name][fine]), columns[name])
    first = recording.place(int(np.argmax(bad | ~timed)))
    return replace(recording, columns=columns), [bridged_line(recording.name, count, len(recording), first)]


def bridged_line(name: str, count: int, rows: int, first: str) -> str:
    """Return the finding of how many of a file's rows hold no numbers, and where the first is: a note of a few."""
    many = f"{count} row{'s' if count > 1 else ''} without numbers"
    where = first if count == 1 else f"the first {first}"
    kind = Note if count == 1 or count < FEW * rows else Finding
    return kind(f"{name}: {many} ({where}) bridged from their neighbours", "record again without lost samples")


def _change(recording: Recording, time: Array, start: int, stop: int) -> str:
    """Return the message of where the rate changes, and between which rates."""

    def rate(rows: slice) -> float:
        return read_clock(time[rows], lossy=is_lossy(recording)).rate

    steady = rate(slice(start, stop))
    other = rate(slice(stop, None)) if len(time) - stop > start else rate(slice(None, start))
    at = stop if len(time) - stop > start else start
    return (
        f"{recording.name}: the sampling rate changes near {recording.place(at)}: {steady:.4g} Hz on one side of it, "
        f"{other:.4g} Hz on the other"
    )


def mislabelled(
    recording: Recording, rate: float, time: float, duration: float, *, least: float = _SLOWEST
) -> list[str]:
    """Return whether the unit of time is right: a finding if rate or duration are hardly those of a test, or a note.

    A rate that is only rare is noted where another unit makes rate and duration likely.

    Parameters
    ----------
    recording
        What is asked; not where its unit of time, or its rate, was stated.
    rate
        Its rate, Hz.
    time
        One of its stamps, s. A rare rate is a finding where that would be later than 2099 if it counts from 1970.
    duration
        From its first stamp to its last, s.
    least
        Rate, Hz, up to which there is a finding. Where time sets every figure, 1 kHz in ms titled s must not pass.
    """
    if recording.time_stated:
        return []
    slow, short = rate <= TOO_SLOW, duration < _MOMENT
    odd = not least < rate < _FASTEST or (slow and time > EPOCHS[1])
    doubt = doubt_unit_of_time(recording.units["time"], rate, duration, rare=slow or short, odd=odd)
    if not doubt:
        return []
    kind = TimeUnitFinding if odd or short or rate > _FAST else TimeUnitNote
    return [
        kind(
            f"{doubt} If not, every figure that depends on time is wrong",
            "correct the unit of the column time, or state it: --unit time=UNIT",
        )
    ]


def doubt_unit_of_time(unit: str, rate: float, duration: float, *, rare: bool = False, odd: bool | None = None) -> str:
    """Return the question whether a unit of time is right, or an empty text.

    Parameters
    ----------
    unit, rate, duration
        Of the times, their rate, Hz, and how long they last, s.
    rare
        Whether to ask where another unit makes rate and duration likely.
    odd
        Whether to ask anyhow; where the rate is none from 0.5 Hz to 40 kHz if None.
    """
    odd = not _SLOWEST < rate < _FASTEST if odd is None else odd
    if not odd and not ((rare or rate > _FAST) and likely_times(unit, rate, duration)):
        return ""
    asked = ask_unit_of_time(unit, rate, duration)
    return f"column time [{unit}]: {1 / rate:.3g} s from row to row ({rate:.3g} Hz): {asked}"
