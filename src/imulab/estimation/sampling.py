"""What time shows of a recording's sampling: rate, gaps, changes of rate, a wrong unit; rows without numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imulab.display import Finding, Note
from imulab.errors import DataError
from imulab.estimation.rows import median, quantile
from imulab.recording import Array, Recording, check_finite, check_time, stored_as
from imulab.units import to_si

WIDEST_GAP = 10.0
"""Most sampling intervals across which readings are interpolated."""
_FEWEST = 3  # samples of a recording that has a rate
GAP = 1.5  # usual steps: a longer step is a gap
_COARSE = 0.2  # share of steps beyond the limit from which time stamps are coarse and the steps are no gaps
_BLOCKS, _SMALLEST_BLOCK = 100, 100  # blocks whose median steps show a change of rate; fewest steps of a block
SAME_RATE = 0.05  # relative: parts of a recording whose steps are this close have one rate
_SLOWEST, _FASTEST = 5.0, 20_000.0  # Hz: rates at which inertial sensors are logged
_USUAL = (10.0, 10_000.0)  # Hz: likely rates, for the guess at the right unit of time
BRIDGED, FEW = 0.01, 0.001
"""Largest share of rows without numbers; share of the rows below which what is bridged or left out is only noted."""


def usual_step(step: Array) -> tuple[float, float]:
    """Return the usual step of time, s, and the longest step that is no gap, from steps of time, shape (n,), n >= 1.

    Beyond 1.5 times the median a step is a gap, unless a fifth of all steps are: then time is written that coarsely
    (stamps in whole milliseconds at 700 Hz alternate between 1 and 2 ms), and the limit is 1.5 times the step that a
    fifth exceed. The usual step is the mean of those that are no gaps.
    """
    if step.max() <= GAP * step.min():  # no gap, whatever the median is
        usual = float(step.mean())
        return usual, GAP * usual
    longest = GAP * median(step)
    if np.mean(step > longest) > _COARSE:
        longest = GAP * quantile(step, 1 - _COARSE)
    return float(step[step <= longest].mean()), longest


def sampling_rate(recording: Recording) -> tuple[float, list[str]]:
    """Return the sampling rate of a recording, Hz, and warnings about its time.

    The warnings name gaps, a change of rate, and a rate at which no sensor is logged (then the unit of time is wrong).

    Raises
    ------
    DataError
        There is no time column, time does not rise, or there are fewer than 3 samples.
    """
    if "time" not in recording:
        raise DataError(f"{recording.name}: no column time; expected one, the noise depends on the sampling rate")
    time = check_time(recording)
    if len(time) < _FEWEST:
        raise DataError(f"{recording.name}: {len(time)} samples are too few; expected at least {_FEWEST}")
    step = np.diff(time)
    usual, longest = usual_step(step)
    start, stop = steady_rows(time)
    if (start, stop) != (0, len(time)):
        return 1 / usual, [_change(recording, time, start, stop), *mislabelled(recording, 1 / usual)]
    wide = np.flatnonzero(step > longest)
    if not wide.size:
        rate = (len(time) - 1) / float(time[-1] - time[0])
        return rate, mislabelled(recording, rate)
    worst = int(wide[np.argmax(step[wide])])
    return 1 / usual, [
        Finding(
            f"{recording.name}: {wide.size} gap{'s' if wide.size > 1 else ''} in time, the longest {step[worst]:.3g} s "
            f"after {recording.place(worst)}; the samples on both sides are taken as neighbours",
            "record again without lost samples",
        ),
        *mislabelled(recording, 1 / usual),
    ]


def steady_rows(time: Array) -> tuple[int, int]:
    """Return the first row, and the last plus 1, of the longest stretch with one sampling rate; times in s, shape (n,).

    Blocks of at least a hundred samples have different rates where their usual steps differ by more than 5 %; a single
    block that differs is passed over.
    """
    step = np.diff(time)
    if step.size and step.max() < (1 + SAME_RATE / 2) * step.min():  # as most are
        return 0, len(time)
    size = max(_SMALLEST_BLOCK, -(-len(step) // _BLOCKS))
    count = len(step) // size
    if count < 2:
        return 0, len(time)
    blocks = np.array_split(step[: count * size], count)
    size_of_step = np.log([usual_step(block)[0] for block in blocks])
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
    start, stop = steady_rows(time)
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
        return 1 / usual_step(np.diff(time[rows]))[0]

    steady = rate(slice(start, stop))
    other = rate(slice(stop, None)) if len(time) - stop > start else rate(slice(None, start))
    at = stop if len(time) - stop > start else start
    return (
        f"{recording.name}: the sampling rate changes near {recording.place(at)}: {steady:.4g} Hz on one side of it, "
        f"{other:.4g} Hz on the other"
    )


def mislabelled(recording: Recording, rate: float) -> list[str]:
    """Return a warning where no sensor is logged at this rate, with the unit of time that would make it a usual one."""
    if _SLOWEST < rate < _FASTEST:
        return []
    unit = recording.units["time"]
    others = {other: rate * to_si(1.0, unit) / to_si(1.0, other) for other in ("us", "ms", "s") if other != unit}
    likely = [
        f"{value:.4g} Hz if it is in {other}" for other, value in others.items() if _USUAL[0] <= value < _USUAL[1]
    ]
    guess = f": {' or '.join(likely)}" if likely else ""
    return [
        Finding(
            f"{recording.name}: column time [{unit}]: {1 / rate:.3g} s from row to row ({rate:.3g} Hz): is the unit of "
            f"time right{guess}? If not, every figure that depends on time is wrong",
            "correct the unit of the column time",
        )
    ]
