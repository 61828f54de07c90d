"""The curves of a recording for a screen: smallest and largest sample of every channel per column of pixels.

A recording is written once, block by block, as numbers of 8 bytes, with the smallest and largest sample of each
`BUCKET` rows beside them. A wide view reads these, a narrow view the samples, so that the cost of a view does not
depend on the recording's length, and memory holds no more than a block.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array, Recording

BUCKET = 256  # rows whose extremes are kept
_FINE = 2000 * BUCKET
"""Most rows of a view that is made of samples."""
_GAP_SECONDS, _GAP_STEPS = 0.25, 6.0
"""A step in time longer than both is a gap, as for `find_attitudes`."""
_MOST_ROWS = 1 << 22  # of a spectrum
_FEWEST_ROWS = 64  # of a spectrum
_BANDS = 240  # of a spectrum that is drawn
_MOST_GAPS = 1000  # that are marked
_NUMBER = np.dtype("<f8")


@dataclass
class Head:
    """Description of a recording while it is written.

    Attributes
    ----------
    units
        Unit of each column but the time, in file order.
    rows
        Samples so far.
    timed
        Whether there are times, finite and never falling; otherwise places are numbers of rows.
    first, last
        Time or row number of the first and the last sample.
    usual
        Usual step in time, s: the median of the first block.
    gaps
        End of the sample before and begin of the sample after each gap, s; the first thousand.
    gap_count
        Number of gaps.
    """

    units: dict[str, str] = field(default_factory=dict)
    rows: int = 0
    timed: bool = True
    first: float = 0.0
    last: float = 0.0
    usual: float = 0.0
    gaps: list[tuple[float, float]] = field(default_factory=list)
    gap_count: int = 0

    @property
    def longest_step(self) -> float:
        """Longest step in time that is no gap, s."""
        return max(_GAP_SECONDS, _GAP_STEPS * self.usual)


class Writer:
    """Writer of the blocks of a recording into a folder; `head` describes what is written."""

    def __init__(self, folder: Path) -> None:
        self.head = Head()
        self._folder = folder
        self._rest: list[Array] = []

    def add(self, block: Recording) -> None:
        """Write a block behind the others."""
        head, names = self.head, [name for name in block.columns if name != "time"]
        if not head.units:
            head.units = {name: block.units[name] for name in names}
            self._rest = [np.empty(0) for _ in names]
        self._time(block)
        for number, name in enumerate(names):
            values = np.ascontiguousarray(block.columns[name], dtype=_NUMBER)
            _append(_file(self._folder, number, "values"), values)
            open_ = np.concatenate([self._rest[number], values])
            full = len(open_) // BUCKET * BUCKET
            buckets = open_[:full].reshape(-1, BUCKET)
            _append(_file(self._folder, number, "low"), np.fmin.reduce(buckets, axis=1))
            _append(_file(self._folder, number, "high"), np.fmax.reduce(buckets, axis=1))
            self._rest[number] = open_[full:].copy()
        head.rows += len(block)
        if not head.timed:
            head.first, head.last = 1.0, float(head.rows)

    def _time(self, block: Recording) -> None:
        head, time = self.head, block.time
        if time is None or not head.timed or not len(time):
            head.timed = head.timed and (time is not None or not len(block))
            return
        _append(self._folder / "time.values", time)
        ends = [head.last] if head.rows else []
        behind = np.concatenate([time[:1] - ends, np.diff(time)]) if ends else np.diff(time)
        if not ends:
            head.first, head.usual = float(time[0]), float(np.median(behind)) if behind.size else 0.0
        head.last = float(time[-1])
        if behind.size and not (behind.min() >= 0 and np.isfinite(head.last)):  # nor with a time that is not a number
            head.timed = False
        elif behind.size and behind.max() > head.longest_step:
            places = np.flatnonzero(behind > head.longest_step)
            head.gap_count += len(places)
            ends_of = time[places if ends else places + 1]
            gaps = np.column_stack([ends_of - behind[places], ends_of])[: _MOST_GAPS - len(head.gaps)]
            head.gaps += [(a, b) for a, b in gaps.tolist()]


@dataclass(frozen=True)
class CurveView:
    """What a screen shows of a range.

    Attributes
    ----------
    rows
        First row of each of n columns of pixels, from 0, and the end of the last, shape (n + 1,).
    at, until
        Place (time, s, or row number) of the first and last sample of each, shape (n,).
    low, high
        Smallest and largest sample of each, by channel, shape (n,); NaN where there is no number.
    breaks
        Numbers of the columns of pixels that a gap lies in front of.
    """

    rows: NDArray[np.int64]
    at: Array
    until: Array
    low: dict[str, Array]
    high: dict[str, Array]
    breaks: list[int]


def view(folder: Path, head: Head, start: float | None, stop: float | None, width: int) -> CurveView:
    """Return the curves of a range for a screen.

    Parameters
    ----------
    folder, head
        What a `Writer` has written so far.
    start, stop
        Range of places; the ends of the recording where None.
    width
        Columns of pixels, at least; up to twice as many where every sample is shown.
    """
    place = _Places(folder, head)
    first = 0 if start is None else max(place.row(start, "left") - 1, 0)
    last = head.rows if stop is None else min(place.row(stop, "right") + 1, head.rows)
    first = min(first, max(last - 1, 0))
    full = head.rows // BUCKET * BUCKET
    coarse = last - first > _FINE
    if coarse:  # ends and bounds at whole buckets; what follows the last of them are samples
        first, last = first // BUCKET * BUCKET, min(-(-last // BUCKET) * BUCKET, head.rows)
    edges = _edges(place, first, min(last, full) if coarse else last, width)
    if coarse:
        inner = np.rint(edges[1:-1] / BUCKET).astype(np.int64) * BUCKET
        edges = np.concatenate([edges[:1], inner[(inner > edges[0]) & (inner < edges[-1])], edges[-1:]])
    edges = np.unique(edges)
    low, high = {}, {}
    for number, name in enumerate(head.units):
        both = []
        for kind, smallest in (("low", np.fmin), ("high", np.fmax)):
            source = _file(folder, number, kind if coarse else "values")
            unit = BUCKET if coarse else 1
            begins = edges[:-1] // unit
            values = _values(source, int(edges[-1]) // unit)[begins[0] if len(begins) else 0 :]
            extremes = smallest.reduceat(values, begins - begins[0]) if len(begins) else np.empty(0)
            if coarse and last > full:
                rest = _values(_file(folder, number, "values"), head.rows)[full:last]
                extremes = np.append(extremes, smallest.reduce(rest))
            both.append(extremes)
        low[name], high[name] = both
    if coarse and last > full:
        edges = np.append(edges, last)
    at, until = place.of(edges[:-1]), place.of(edges[1:] - 1)
    wide = np.flatnonzero(at[1:] - until[:-1] > head.longest_step) + 1 if head.timed else np.empty(0, np.int64)
    return CurveView(edges, at, until, low, high, wide.tolist())


@dataclass(frozen=True)
class RangeStatistics:
    """Numbers of a range: its rows, and by channel mean, standard deviation, and one-sided spectral density.

    Attributes
    ----------
    mean, sigma
        By channel, in its unit, without rows that are no number; NaN where there are too few.
    frequencies
        Frequencies of the densities, Hz, shape (k,); empty where there is no time, or where rows are few.
    density
        By channel, unit^2/Hz, shape (k,).
    """

    rows: int
    mean: dict[str, float]
    sigma: dict[str, float]
    frequencies: Array
    density: dict[str, Array]


def statistics(folder: Path, head: Head, start: float | None, stop: float | None) -> RangeStatistics:
    """Return mean, standard deviation and spectrum of a range of places, the ends of the recording where None.

    The spectrum is Welch's, of Hann windows that overlap by half, of the middle `_MOST_ROWS` rows at most, as if they
    came in even steps; densities are averaged over bands of equal ratio (P. D. Welch, IEEE Trans. AU-15 (1967) 70).
    """
    place = _Places(folder, head)
    first = 0 if start is None else place.row(start, "left")
    last = head.rows if stop is None else place.row(stop, "right")
    rows = max(last - first, 0)
    mean, sigma, density = dict[str, float](), dict[str, float](), dict[str, Array]()
    inner = first + max(rows - _MOST_ROWS, 0) // 2
    step = 0.0
    if head.timed and rows > _FEWEST_ROWS:
        ends = place.of(np.array([first, last - 1]))
        step = float(ends[1] - ends[0]) / (rows - 1)
    frequencies = np.empty(0)
    for number, name in enumerate(head.units):
        values = _values(_file(folder, number, "values"), head.rows)[first:last]
        good = values[np.isfinite(values)]
        mean[name] = float(good.mean()) if good.size else np.nan
        sigma[name] = float(good.std(ddof=1)) if good.size > 1 else np.nan
        if step > 0 and good.size == rows:
            frequencies, density[name] = _spectrum(values[inner - first : inner - first + _MOST_ROWS], 1 / step)
    return RangeStatistics(rows, mean, sigma, frequencies, density)


def _spectrum(values: Array, rate: float) -> tuple[Array, Array]:
    """Return frequencies and densities, averaged over bands of equal ratio."""
    from scipy.signal import welch  # takes 0.4 s to load, and is asked for rarely

    length = min(len(values), max(256, 1 << int(np.log2(len(values) / 4))))
    frequencies, density = welch(values, rate, nperseg=length)
    edges = np.unique(np.geomspace(1, len(frequencies), _BANDS + 1).round().astype(int))
    counts = np.diff(edges)
    sums = [np.add.reduceat(each, edges[:-1]) / counts for each in (frequencies, density)]
    return sums[0], sums[1]


class _Places:
    """Time of each sample, or its row number from 1."""

    time: Any

    def __init__(self, folder: Path, head: Head) -> None:
        self.count = head.rows
        self.time = _values(folder / "time.values", head.rows) if head.timed and head.rows else None

    def row(self, place: float, side: Any) -> int:
        """Return the first row at a place or behind it; with side ``right``, the first behind it."""
        if self.time is None:
            return int(np.clip(np.floor(place) if side == "right" else np.ceil(place) - 1, 0, self.count))
        return int(np.searchsorted(self.time, place, side))

    def of(self, rows: NDArray[np.int64]) -> Array:
        """Return the places of rows."""
        return np.asarray(rows + 1 if self.time is None else self.time[rows], dtype=np.float64)


def _edges(place: _Places, first: int, last: int, width: int) -> NDArray[np.int64]:
    """Return the bounds of the columns of pixels, in rows: equal steps in time; every row where there are few."""
    if last - first <= 2 * width:
        return np.arange(first, last + 1)
    if place.time is None:
        return np.linspace(first, last, width + 1).astype(np.int64)
    ends = place.of(np.array([first, last - 1]))
    inner = np.searchsorted(place.time[first:last], np.linspace(ends[0], ends[1], width + 1)[1:-1]) + first
    return np.concatenate([[first], inner, [last]]).astype(np.int64)


def _file(folder: Path, number: int, kind: str) -> Path:
    return folder / f"{number}.{kind}"


def _append(path: Path, values: Array) -> None:
    with path.open("ab") as stream:
        stream.write(values.astype(_NUMBER, copy=False).tobytes())


def _values(path: Path, count: int) -> Any:
    """Return the first numbers of a file, which are read when they are used."""
    return np.memmap(path, _NUMBER, "r", shape=(count,)) if count else np.empty(0)
