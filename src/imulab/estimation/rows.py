"""Robust statistics of samples, and what in a recording is no noise: changes of level, and rows that are not readings.

Medians and quantiles are written here because NumPy's own load its package for masked arrays: 0.03 s of processor time,
a tenth of a short command.

Loggers fill lost rows with zeros or with the row before, and shift or tear frames. Such rows are found before anything
else looks at the samples. They are bridged by straight lines, so that all rows keep their places and times.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

from imulab.columns import kind_of
from imulab.display import Finding, Note
from imulab.errors import DataError
from imulab.recording import Array, Recording, release, stored_as

# Medians, quantiles, distinct values, root mean squares.


NORMAL_95 = 1.96
"""Standard deviations of a normal distribution from its mean to the ends of its 95 %."""
MAD_TO_SIGMA = 1.4826
"""Median absolute deviation to the standard deviation of a normal distribution, as the literature rounds it."""
_FEW = 256  # values that NumPy's vector instructions partition faster


def median(values: NDArray[Any]) -> float:
    """Return the median of values of any shape, NaN if one of them is NaN.

    Examples
    --------
    >>> median(np.array([4, 1, 2, 3]))
    2.5
    """
    return float(medians(values.ravel()))


def medians(values: NDArray[Any], axis: int = -1) -> Array:
    """Return the medians of values along an axis, NaN where one of the values is NaN.

    Examples
    --------
    >>> medians(np.array([[4.0, 1.0, 2.0], [7.0, 9.0, 8.0]])).tolist()
    [2.0, 8.0]
    """
    middle = values.shape[axis] // 2
    parted = _partition(np.moveaxis(values, axis, -1) if values.ndim > 1 else values, middle)
    high = parted[..., middle]
    low = high if values.shape[axis] % 2 else parted[..., :middle].max(-1)
    unknown = np.isnan(parted[..., middle:].max(-1)) if parted.size and math.isnan(parted.max()) else False
    return np.where(unknown, np.nan, (low + high) / 2)


def quantile(values: NDArray[Any], share: float) -> float:
    """Return the value below which this share of finite values lies, interpolated linearly between neighbours.

    Examples
    --------
    >>> quantile(np.array([4.0, 1.0, 2.0]), 0.75)
    3.0
    """
    place = share * (values.size - 1)
    below = int(place)
    parted = _partition(values.ravel(), below)
    low, above = parted[below], parted[below + 1 :]
    return float(low + (place - below) * (above.min() - low)) if above.size else float(low)


def _partition(values: NDArray[Any], place: int) -> NDArray[Any]:
    """Return values with the smaller ones before a place on the last axis and the larger ones behind it.

    NumPy does so for a single place with vector instructions: five times as fast for few values as its way for two
    places, but up to fifty times as slow for thousands, above all if many are equal, as steps of time are.
    """
    parted = np.array(values, order="C")
    parted.partition(place if values.shape[-1] <= _FEW else (place - 1, place))
    return parted


def distinct(values: NDArray[Any]) -> NDArray[Any]:
    """Return the different values among values of any shape, sorted.

    Examples
    --------
    >>> distinct(np.array([3, 1, 3])).tolist()
    [1, 3]
    """
    ordered = np.sort(values, axis=None)
    return np.asarray(ordered[np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)]])


def resolution(samples: Array) -> float:
    """Return the smallest step between different finite values of the first 20,000 samples, 0 where there is none."""
    values = distinct(samples[:20_000])
    values = values[np.isfinite(values)]
    return float(np.diff(values).min()) if len(values) > 1 else 0.0


def rms(values: ArrayLike) -> float:
    """Return the root mean square of values.

    Examples
    --------
    >>> rms([3.0, -4.0])
    3.5355339059327378
    """
    return float(np.sqrt(np.mean(np.square(values))))


# Changes of level of a sensor at rest, which an Allan curve would take for noise.


_BLOCKS, _SMALLEST = 256, 16  # means among which a jump is looked for; fewest samples of a mean
_LIMITS = {4: 5.5, 8: 5.8, 16: 7.0}
"""Blocks on each side of a step -> how many times the usual difference the step must be. White noise, 1/f noise, random
walk and their sums exceed one of these in at most 4 of 1000 recordings."""
_WHITE = 5.0  # standard uncertainties of white noise that a jump must exceed as well
_REACHES = (8, 16, 32, 64)
"""Blocks on each side of a step over which it is compared with smooth drifts."""
_TAUS = np.geomspace(0.003, 2.0, 20)
"""Time constants of exponential drifts, in lengths of the part that they are fitted to."""
_ALLOWED, _PLAIN = 6.0, 10.0
"""Misfit in variances of a mean: a step may fit worse than a drift by 6 near its place, and must fit better by 10 over
the widest reach."""


class Step(Struct, frozen=True):
    """A change of level: its size, the first sample behind it, and within how many samples its place is known."""

    size: float
    sample: int
    within: int


def find_step(samples: Array) -> Step | None:
    """Return the clearest change of level in samples, shape (n,), or None where noise explains them.

    The samples become 256 means of equal length. At every place between two of them, the means of 4, 8 and 16 blocks on
    both sides are compared. Noise, whether white, 1/f or a random walk, makes these differences alike everywhere; a
    step makes one that is many times their median. So does a drift that is faster in one part of the recording than in
    the others; a step therefore has to fit the means around it better than smooth drifts do. Below 4096 samples no step
    is looked for.
    """
    length = len(samples) // _BLOCKS
    if length < _SMALLEST:
        return None
    means = samples[: _BLOCKS * length].reshape(_BLOCKS, length).mean(axis=1)
    total = np.concatenate([[0.0], np.cumsum(means - means.mean())])
    best, step = 1.0, None
    for width, limit in _LIMITS.items():
        place = np.arange(width, _BLOCKS - width + 1)
        change = (total[place + width] - 2 * total[place] + total[place - width]) / width
        index = int(np.argmax(np.abs(change)))
        others = np.abs(np.delete(change, np.s_[max(0, index - 2 * width) : index + 2 * width + 1]))
        least = limit * MAD_TO_SIGMA * median(others)
        if abs(change[index]) > best * least:  # as hardly ever, so that white noise is seldom asked for
            least = max(least, _WHITE * deviation_of_steps(samples) / np.sqrt(length * width))
        if least > 0 and abs(change[index]) > best * least:
            best = abs(change[index]) / least
            step = Step(float(change[index]), int(place[index]) * length, 4 * length)
    return step if step is not None and _jumps(means, step.sample // length) else None


def deviation_of_steps(samples: Array) -> float:
    """Return the standard deviation of the differences between neighbouring samples, shape (n,), n >= 2."""
    square = math.fsum(float(np.einsum("i,i", steps, steps)) for _, steps in _steps(samples)) / (len(samples) - 1)
    mean = float(samples[-1] - samples[0]) / (len(samples) - 1)
    return math.sqrt(max(square - mean**2, 0.0))


def _jumps(means: Array, place: int) -> bool:
    """Return whether a step near a place fits the means around it better than any smooth drift.

    A drift is a polynomial of fourth order, or one of second order with one or two exponentials. The step comes with a
    polynomial of second order or with an exponential, so that both have as many coefficients.
    """
    for reach in _REACHES:
        low, high = max(0, place - reach), min(_BLOCKS, place + reach)
        part = means[low:high]
        count = len(part)
        time = np.linspace(-1, 1, count)
        rises = [[np.exp(sign * (time - sign) / (2 * tau)) for tau in _TAUS] for sign in (-1, 1)]
        powers = np.vander(time, 5, increasing=True)
        # Two neighbouring exponentials have every time constant between theirs.
        pairs = [pair for rise in rises for pair in pairwise(rise)]
        smooth = min(
            _misfit(np.column_stack(basis), part) for basis in ([powers], *([powers[:, :3], *p] for p in pairs))
        )
        later = np.arange(count)[:, None] >= np.arange(max(place - low - 2, 1), min(place - low + 3, count))
        jumping = min(
            _misfit(np.column_stack([basis, step]), part)
            for step in later.T.astype(np.float64)
            for basis in (powers[:, :3], *(np.column_stack([powers[:, 0], r]) for rise in rises for r in rise))
        )
        allowed = _ALLOWED * smooth if reach < _REACHES[-1] else -_PLAIN * jumping
        if jumping > smooth + allowed / (count - 5):
            return False
    return True


def _misfit(basis: Array, values: Array) -> float:
    """Return the sum of squared residuals of values, shape (n,), fitted by a basis, shape (n, k)."""
    return float(np.sum((values - basis @ np.linalg.lstsq(basis, values)[0]) ** 2))


# Rows that are not readings: exact zeros, repeats of the row before, and samples far from the rows on both sides.


FAR = "far from the rows on both sides"
REPEATED = "exact repeats of the row before"
MOST = 0.05
"""Largest share of a stretch at rest that may be left out; beyond it the rest is not trusted either."""
_GLITCH_SIGMAS = 10.0
"""A sample is no reading beyond this many standard deviations of the noise around it, and steps of the output."""
_SHARE_NOTED = 1e-3  # below this share of all rows, rows left out are a note and no warning
_FAR_ZERO = 5.0  # usual steps around a single zero
_BESIDE = 4  # samples on both sides
_QUIET = 4.0  # a part rests while its steps are below this many times those of the quietest fifth
_AROUND = 64  # samples whose differences show the noise
_AT_ONCE = 1 << 16  # samples that are looked at together, in whole parts of 64: their steps stay in the cache
HISTORY, _FEW_ZEROS = 50, 0.02
"""A row of zeros is no reading of a gyroscope whose last 50 rows hold at most this share of zeros."""
_LONGEST_ZERO = 20  # rows of a dropout; longer zeros are a gyroscope at rest without noise
_BEYOND_CHANCE_ZEROS = 3.0  # repeats beyond 3 times what chance makes, and 6 roots of it, are no readings
_UPPER, _TO_SIGMA = 24, 0.615
"""The quantile at three quarters of 32 steps, since a log may hold each sample twice; its factor to the standard
deviation of white noise."""


class LeftOut(Struct, frozen=True):
    """Rows that were left out of a group of columns.

    Attributes
    ----------
    recording
        With straight lines in their place.
    names
        The columns.
    kinds
        By reason: which rows were left out, shape (n,).
    """

    recording: Recording
    names: tuple[str, ...]
    kinds: Mapping[str, NDArray[np.bool_]]

    def notes(self, rest: NDArray[np.bool_] | None = None) -> list[str]:
        """Return a sentence for each reason why rows were left out; far samples count only at `rest`, shape (n,)."""
        notes: list[str] = []
        for kind, rows in self.kinds.items():
            left_out = rows & rest if rest is not None and kind == FAR else rows
            count = int(np.count_nonzero(left_out))
            if count:
                kind_of = Note if count < _SHARE_NOTED * len(left_out) else Finding
                notes.append(
                    kind_of(
                        f"{count} row{'s' * (count > 1)} of {_shown(self.names)} left out: {kind}, first at "
                        f"{self.recording.place(int(np.argmax(left_out)))}",
                        "check the link to the sensor, and record again",
                    )
                )
        return notes

    def check(self, start: int, stop: int, where: str) -> None:
        """Refuse a stretch at rest, called `where` in the message, of which too many rows are left out.

        Raises
        ------
        DataError
            More than 5 % of the rows from `start` to `stop` are left out.
        """
        if not self.kinds or stop <= start:
            return
        bad = np.logical_or.reduce([rows[start:stop] for rows in self.kinds.values()])
        share = float(bad.mean())
        if share > MOST:
            kind = max(self.kinds, key=lambda kind: int(np.count_nonzero(self.kinds[kind][start:stop])))
            raise DataError(
                f"{self.recording.name}: {self.recording.place(start + int(np.argmax(bad)))}, columns "
                f"{_shown(self.names)}: {100 * share:.0f} % of the rows of {where} are no readings ({kind}); expected "
                f"at most {100 * MOST:.0f} %, which are left out"
            )


def leave_out(recording: Recording, names: Sequence[str]) -> LeftOut:
    """Return a recording in which the rows of one sensor that are not readings are bridged by straight lines.

    - Zeros: all columns are exactly zero; of gyroscopes, where zeros are rare in the rows before.
    - Repeats: all columns are exactly as in the row before, more often than their steps make it by chance, in no more
      than 5 % of the rows (beyond that the sensor is slower than its log).
    - Far: at rest, one or two samples that lie farther from their neighbours than ten standard deviations of the noise
      and ten steps of the output, while the neighbours rest; and a single zero far from values of one sign around it.

    Parameters
    ----------
    recording
        Finite in these columns.
    names
        Columns of one sensor: a triad, the gyros of an array, or a single one.
    """
    values = [np.asarray(recording.column(name), dtype=np.float64) for name in names]
    if len(recording) < 2 * _AROUND:
        return LeftOut(recording, tuple(names), {})
    never_zero = all(kind_of(name) == "accel" for name in names)
    zero = zero_rows(values, never_zero)
    if not never_zero:
        zero &= ~_long_runs(zero)
    by_kind = {"exact zeros": zero, REPEATED: repeated_rows(values) & ~zero}
    by_kind[FAR], by_kind["an exact zero of one column"] = far_rows(values, zero)
    kinds = {kind: rows for kind, rows in by_kind.items() if rows.any()}
    if not kinds:
        return LeftOut(recording, tuple(names), kinds)
    bad = np.logical_or.reduce(list(kinds.values()))
    index, good = np.flatnonzero(bad), np.flatnonzero(~bad)
    if not good.size:
        return LeftOut(recording, tuple(names), kinds)
    columns = {}
    for name, column in zip(names, values, strict=True):
        mended = np.array(column)
        mended[index] = np.interp(index, good, column[good])
        columns[name] = stored_as(mended, column)
    return LeftOut(recording.with_columns(columns, {}), tuple(names), kinds)


def zero_rows(values: Sequence[Array], never_zero: bool = False) -> NDArray[np.bool_]:
    """Return the rows in which all columns are exactly zero, except those of a coarsely quantised sensor at rest.

    Parameters
    ----------
    values
        Columns, each of shape (n,).
    never_zero
        Whether no row of zeros can be a reading, as of accelerometers.
    """
    every, zeros_in_row = np.ones(len(values[0]), dtype=np.bool_), np.zeros(len(values[0]), dtype=np.int16)
    for column in values:
        zero = _released(column == 0, column)
        every &= zero
        if not every.any():
            return every
        zeros_in_row += zero
    if never_zero or len(values) < 2:
        return every if len(values) > 1 else np.zeros_like(every)
    count = np.concatenate([[0], np.cumsum(zeros_in_row[~every])])
    first = np.cumsum(~every)[every]
    before = np.maximum(first, min(HISTORY, len(count) - 1))  # near the start: of the rows after it, too
    rare = count[before] - count[np.maximum(before - HISTORY, 0)] <= _FEW_ZEROS * len(values) * HISTORY
    zeros = np.zeros_like(every)
    zeros[np.flatnonzero(every)[rare & (first > 0) & (before >= HISTORY)]] = True
    return zeros


def _released(rows: NDArray[np.bool_], column: Array) -> NDArray[np.bool_]:
    """Return what was found in a column, whose memory is given back if it lies in a temporary file."""
    release(column)
    return rows


def repeated_rows(values: Sequence[Array]) -> NDArray[np.bool_]:
    """Return the rows that repeat the row before in all columns, where the sensor itself does not repeat readings.

    Many rows do so where a link stood still: `frozen_runs`.
    """
    n = len(values[0])
    every, by_chance = np.ones(n, dtype=np.bool_), float(n)
    every[:1] = False
    for column in values:
        same = _released(column[1:] == column[:-1], column)
        every[1:] &= same
        if not every.any():
            return every
        by_chance *= np.count_nonzero(same) / n
    count = int(np.count_nonzero(every))
    beyond_chance = len(values) > 1 and count > _BEYOND_CHANCE_ZEROS * by_chance + 2 * _BEYOND_CHANCE_ZEROS * np.sqrt(
        by_chance
    )
    if beyond_chance and count <= MOST * n:
        return every
    frozen = np.zeros_like(every)
    for first, behind in frozen_runs(values) if beyond_chance else []:
        frozen[first + 1 : behind] = True
    return frozen


def far_rows(values: Sequence[Array], known: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the rows with a sample far from both neighbours, and those with such a zero, without the `known`."""
    far = np.zeros((2, len(known)), dtype=np.bool_)
    part = np.flatnonzero(~known) if known.any() else slice(None)
    if len(known) - np.count_nonzero(known) >= 2 * _AROUND:
        for column in values:
            far[:, part] |= _far_samples(column[part])
            release(column)
    return far[0] & ~far[1], far[1]


def _steps(x: Array) -> Iterator[tuple[int, Array]]:
    """Yield the sizes of the steps from sample to sample in blocks of whole parts, and where each block begins."""
    for first in range(0, len(x) - 1, _AT_ONCE):
        yield first, _steps_from(x, first)


def _steps_from(x: Array, first: int) -> Array:
    steps = np.diff(x[first : first + _AT_ONCE + 1])
    return np.abs(steps, out=steps)


def _far_samples(x: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which samples, one or two in a row, are far from their neighbours, and which are far zeros, shape (n,).

    Far samples are looked for at rest only, since a motion has knocks; single zeros between values of one sign
    anywhere.
    """
    far, alone = np.zeros((2, len(x)), dtype=np.bool_)
    count = (len(x) - 1) // _AROUND
    local = np.empty(count)
    finest, largest = np.inf, []
    for first, steps in _steps(x):
        largest.append(steps.max())
        parts = steps[: len(steps) // _AROUND * _AROUND].reshape(-1, _AROUND)
        local[first // _AROUND :][: len(parts)] = np.partition(parts[:, : _AROUND // 2], _UPPER, axis=1)[:, _UPPER]
        smallest = float(steps.min())
        if not smallest > 0:
            smallest = float(np.min(steps, where=steps > 0, initial=np.inf))
        finest = min(finest, smallest)
    # Next to a motion there is no rest: the largest of a part's steps and its neighbours' counts.
    wide = local.copy()
    np.maximum(wide[:-1], local[1:], out=wide[:-1])
    np.maximum(wide[1:], local[:-1], out=wide[1:])
    if finest == np.inf:
        return far, alone
    moving = wide > _QUIET * max(quantile(local, 0.2), finest)
    least = _GLITCH_SIGMAS * finest
    limits = np.maximum(_GLITCH_SIGMAS * _TO_SIGMA * wide, least)

    def part(samples: NDArray[np.intp]) -> NDArray[np.intp]:
        return np.minimum(samples // _AROUND, count - 1)

    # A sample far from its surroundings is a large step away from them, or from the sample before.
    far_steps = []
    for first, most in zip(range(0, len(x) - 1, _AT_ONCE), largest, strict=True):
        its = limits[first // _AROUND :][: _AT_ONCE // _AROUND]
        if its.size and most <= its.min():  # as most are
            continue
        steps = _steps_from(x, first)
        its = np.append(its, limits[-1:]) if len(its) * _AROUND < len(steps) else its
        far_steps.append(np.flatnonzero(steps > np.repeat(its, _AROUND)[: len(steps)]) + first)
    suspect = np.concatenate([np.empty(0, dtype=np.intp), *far_steps])
    suspect = suspect[~moving[part(suspect)]]
    index = distinct(np.minimum(suspect[:, None] + np.arange(3), len(x) - 1))
    middle = np.minimum(np.maximum(index, _BESIDE), len(x) - 1 - _BESIDE)
    window = x[middle[:, None] + np.arange(-_BESIDE, _BESIDE + 1)]
    level = np.sort(window, axis=1)[:, _BESIDE]
    # A knock, or a turn that begins, moves more than two samples.
    limit = limits[part(index)]
    still = np.sort(np.abs(window - level[:, None]), axis=1)[:, -3] < limit / 2
    far[index] = still & (np.abs(x[index] - level) > limit)
    zero = np.flatnonzero(x[1:-1] == 0) + 1
    if zero.size:
        before, after = x[zero - 1], x[zero + 1]
        away = np.minimum(np.abs(before), np.abs(after)) > np.maximum(_FAR_ZERO * wide[part(zero)], least)
        alone[zero[away & (before * after > 0)]] = True
    return far, alone


def _long_runs(rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the rows of runs that are longer than any dropout."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(np.int8))).reshape(-1, 2)
    long = np.zeros_like(rows)
    for start, stop in edges[np.diff(edges, axis=1)[:, 0] > _LONGEST_ZERO].tolist():
        long[start:stop] = True
    return long


def _shown(names: Sequence[str]) -> str:
    return " ".join(names) if len(names) <= 3 else f"{names[0]} .. {names[-1]}"


# Columns that stand still for a while.


_STUCK, _CHANGING = 50, 0.5  # samples of one value, while in others so many of the steps are none of 0
_PARTS = 5  # of a run, whose means show whether others move
_COARSE = 1.5  # rows to a change; beyond, steps are as large as the noise, and staying on one is no fault


def long_runs(values: Array, least: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return first rows, and rows behind the last, of the runs of at least `least` rows of one value, 4 or more.

    Such a run holds two rows, half of that apart, among those that are looked at first.

    Examples
    --------
    >>> first, behind = long_runs(np.array([2.0, 2.0, 5.0, 5.0, 5.0, 5.0, 1.0]), 4)
    >>> first.tolist(), behind.tolist()
    ([2], [6])
    """
    apart = least // 2
    size, last = _AT_ONCE // apart * apart, len(values) - 1
    places = [np.empty(0, dtype=np.intp)]
    for start in range(0, last + 1 - apart, size):
        few = values[start : start + size + 1 : apart]
        places.append(start + apart * np.flatnonzero(few[1:] == few[:-1]))
        release(values)
    held = np.concatenate(places)
    for k in range(1, apart):
        held = held[values[held + k] == values[held]]
    first = held[np.diff(held, prepend=-least) != apart]
    end = held[np.diff(held, append=last + least) != apart] + apart
    for _ in range(apart):
        first = first - ((first > 0) & (values[first - 1] == values[first]))
        end = end + ((end < last) & (values[np.minimum(end + 1, last)] == values[end]))
    release(values)
    long = end + 1 - first >= least
    return first[long], end[long] + 1


def frozen_runs(columns: Sequence[Array]) -> list[tuple[int, int]]:
    """Return first row, and row behind the last, of each run of more than 50 rows that are alike in all columns.

    There are none where a column changes in fewer than half of all rows: its steps are coarser than its noise, or it is
    slower than the log, or logged only where it changes, so that it stands still by itself.

    Examples
    --------
    >>> x = np.random.default_rng(1).standard_normal((2, 300))
    >>> x[:, 100:160] = x[:, 99:100]
    >>> frozen_runs(x)
    [(99, 160)]
    """
    if any(2 * count_changes(column) < len(column) for column in columns):
        return []
    runs = [(0, len(columns[0]))]
    for column in columns:
        inside: list[tuple[int, int]] = []
        for begin, end in runs:
            first, behind = long_runs(column[begin:end], _STUCK + 1)
            inside += zip((begin + first).tolist(), (begin + behind).tolist(), strict=True)
        runs = inside
    return runs


def count_changes(values: Array) -> int:
    """Return how many rows differ from the row before."""
    changes = 0
    for start in range(0, len(values) - 1, _AT_ONCE):
        part = values[start : start + _AT_ONCE + 1]
        changes += int(np.count_nonzero(part[1:] != part[:-1]))
        release(values)
    return changes


def stuck_run(values: Array, others: Sequence[Array], *, moving: bool = False) -> tuple[int, int] | None:
    """Return first row and length of the longest run of one value, if the column is stuck there while others change.

    Parameters
    ----------
    values, others
        The column and those of the other sensors, shape (m,) each.
    moving
        Whether the recording is of motion: there a run at the column's largest or smallest value is the end of its
        range, and one while the others' level changes by no more than two of its steps is a coarse sensor at rest.
    """
    first, behind = long_runs(values, _STUCK + 1)
    if not first.size or not others:
        return None
    longest = int(np.argmax(behind - first))
    begin, end = int(first[longest]), int(behind[longest])
    length = end - begin
    if (len(values) - length) / max(count_changes(values), 1) > _COARSE:
        return None
    if moving:
        steps = np.abs(np.diff(values))
        step = float(steps.min(where=steps > 0, initial=np.inf))
        levels = [[part.mean() for part in np.array_split(other[begin:end], _PARTS)] for other in others]
        if values[begin] in (values.min(), values.max()) or np.median(np.ptp(levels, axis=1)) <= 2 * step:
            return None
    changing = [float(np.mean(other[begin + 1 : end] != other[begin : end - 1])) for other in others]
    return (begin, length) if np.median(changing) > 0 and np.mean(changing) > _CHANGING else None


def stuck_message(recording: Recording, name: str, run: tuple[int, int]) -> str:
    """Return the words for a column that is stuck; `run` is from `stuck_run`."""
    begin, length = run
    return (
        f"column {name}: {length} samples of {recording.columns[name][begin]:g} from {recording.place(begin)} on, "
        "while others move: a stuck sensor"
    )
