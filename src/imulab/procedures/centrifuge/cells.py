"""A run compressed as it streams by: sums over cells of about one table period, from which all else is computed.

Over a cell the model is linear in the columns of `COLUMNS`: constant, time, cosine and sine of chi, 2 chi, 3 chi and
of the net angle, and time times those of chi and of the net angle. A rate that differs from the assumed one by d
turns a line by ``d (t - t0)``; within a cell that is its value at the centre plus a small linear part, which the last
four columns take up to second order, ``(d tau)^2 / 6``. So one pass gives the normal equations at any nearby rates,
for any stretch of the run, and the scatter between stretches.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from imulab.recording import Array

CONSTANT, TIME, CHI, CHI2, CHI3, NET, TIME_CHI, TIME_NET = 0, 1, 2, 4, 6, 8, 10, 12
COLUMNS = 14
_CHUNK = 16384
"""Samples worked on at once: small enough to stay in the cache."""
_BINS = 16
"""Means per cell that are kept as a time series."""
_PRODUCT = 800
FIRST_LOOK = 1024
"""Samples from which the sampling period is found."""
FEWEST_PER_PERIOD = 8
_GAP = 2.5


@dataclass(frozen=True)
class Samples:
    """A block of a run in SI: time (n,), channels (k, n), chi, rad, (n,), or None."""

    time: Array
    channels: Array
    angle: Array | None


@dataclass(frozen=True)
class Cells:
    """A run as sums over cells.

    Attributes
    ----------
    centre
        Mean time of each cell, s, shape (c,).
    moments
        Products of the columns and channels with each other, shape (c, 14 + k, 14 + k).
    offset
        Taken from the channels before summing, rad/s, shape (k,).
    start, step, samples
        Time of the first sample, sampling period, s, and number of samples.
    cell
        Samples in a full cell.
    table_rate, net_rate
        Signed rates that the cells were summed at, rad/s.
    series_time, series
        Centre, s, and mean of short bins, shapes (b,) and (k, b); `series_step` s apart unless samples are missing.
    series_begin, series_angle
        Time, s, and chi, rad, at the first sample of each bin; chi is None without encoder.
    """

    centre: Array
    moments: Array
    offset: Array
    start: float
    step: float
    samples: int
    cell: int
    table_rate: float
    net_rate: float
    series_time: Array
    series: Array
    series_begin: Array
    series_angle: Array | None

    @property
    def duration(self) -> float:
        """Samples times sampling period, s."""
        return self.samples * self.step

    @property
    def series_step(self) -> float:
        """Sampling period of the series, s."""
        return self.step * self.cell / self.bins

    @property
    def bins(self) -> int:
        """Bins per cell."""
        return min(_BINS, self.cell)

    def cut(self, first: int, last: int) -> Cells:
        """Return the cells from `first` up to `last` (half-open) as a run of their own."""
        bins = slice(first * self.bins, last * self.bins)
        moments = self.moments[first:last]
        return Cells(
            self.centre[first:last], moments, self.offset, self.start, self.step,
            round(float(moments[:, CONSTANT, CONSTANT].sum())), self.cell, self.table_rate, self.net_rate,
            self.series_time[bins], self.series[:, bins], self.series_begin[bins],
                None if self.series_angle is None else self.series_angle[bins],
        )  # fmt: skip


class TooSlowError(Exception):
    """Fewer samples in a table period than three harmonics need; carries their number."""


def sampling_period(time: Array) -> float:
    """Return the sampling period without gaps, s: a whole number of samples a second where it is one within 1e-9."""
    steps = np.diff(time)
    gaps = steps > _GAP * np.median(steps)
    step = float(time[-1] - time[0] - steps[gaps].sum()) / (len(steps) - np.count_nonzero(gaps))
    nearest = round(1 / step)
    return 1 / nearest if nearest and abs(step * nearest - 1) < 1e-9 else step


def compress(blocks: Iterable[Samples], table_rate: float, net_rate: float) -> Cells | None:
    """Sum a run over cells, block by block.

    Parameters
    ----------
    blocks
        Consecutive blocks of the run.
    table_rate, net_rate
        Signed rates of chi and of the turning against the room, rad/s; chi is taken from the blocks where they have it.

    Returns
    -------
    Cells
        None where the run is shorter than one cell.

    Raises
    ------
    TooSlowError
        Fewer than 8 samples in a table period.
    """
    pieces = pieces_of(blocks)
    head = next(pieces, None)
    if head is None or len(head.time) < 2:
        return None
    step = sampling_period(head.time[:FIRST_LOOK])
    per_period = 2 * np.pi / abs(table_rate) / step
    if per_period < FEWEST_PER_PERIOD:
        raise TooSlowError(per_period)
    bins = min(_BINS, max(int(per_period), 1))
    cell = bins * max(1, round(per_period / bins))
    start, offset = float(head.time[0]), head.channels[:, : min(cell, head.channels.shape[1])].mean(axis=1)
    work = _Work(start, offset, cell, bins, table_rate, net_rate)
    results, total = [], 0
    rest = head
    for piece in _none_first(pieces):
        if piece is not None:
            rest = _joined(rest, piece)
        whole = len(rest.time) // cell
        per_chunk = max(1, _CHUNK // cell)
        for first in range(0, whole, per_chunk):
            number = min(per_chunk, whole - first)
            results.append(work.sum(_part(rest, first * cell, (first + number) * cell), number))
        total += whole * cell
        rest = _part(rest, whole * cell, len(rest.time))
    if not results:
        return None
    centre, moments, series_time, series, begin, angle = (
        None if parts[0] is None else np.concatenate(parts, axis=-1 if parts[0].ndim == 2 else 0)
        for parts in zip(*results, strict=True)
    )
    assert centre is not None
    assert moments is not None
    assert series_time is not None
    assert series is not None
    assert begin is not None
    left = len(rest.time)
    if left:
        # What remains is less than a cell: it joins the last one, whose columns are about its own centre.
        tail = work.sum_about(rest, float(centre[-1]))
        moments[-1] += tail
        total += left
    return Cells(
        centre, moments, offset, start, step, total, cell, table_rate, net_rate, series_time, series, begin, angle
    )  # fmt: skip


class _Work:
    """Buffers and constants of the summation."""

    def __init__(self, start: float, offset: Array, cell: int, bins: int, table_rate: float, net_rate: float) -> None:
        self.start, self.offset, self.cell, self.bins = start, offset, cell, bins
        self.table_rate, self.net_rate = table_rate, net_rate
        self.design = np.empty((COLUMNS + len(offset), 0))

    def sum(self, part: Samples, number: int) -> tuple[Array, Array, Array, Array, Array, Array | None]:
        """Return centres, moments and series of `number` whole cells."""
        shaped = part.time.reshape(number, self.cell)
        centre = shaped.mean(axis=1)
        design = self._fill(part, (shaped - centre[:, None]).ravel())
        # Products short enough that BLAS does not spread each over threads, which costs more than it gives.
        parts = next((n for n in (1, 2, 4, 8) if self.cell % n == 0 and self.cell // n <= _PRODUCT), _BINS)
        parts = parts if self.cell % parts == 0 else 1
        stacked = design.reshape(len(design), number * parts, self.cell // parts).transpose(1, 0, 2)
        moments = (stacked @ stacked.transpose(0, 2, 1)).reshape(number, parts, len(design), len(design)).sum(axis=1)
        inside = self.cell // self.bins
        time = part.time.reshape(-1, inside).mean(axis=1)
        series = part.channels.reshape(len(part.channels), -1, inside).mean(axis=2)
        angle = None if part.angle is None else part.angle[::inside].copy()
        return centre, moments, time, series, part.time[::inside].copy(), angle

    def sum_about(self, part: Samples, centre: float) -> Array:
        """Return the moments of a part with time counted from `centre`."""
        design = self._fill(part, part.time - centre)
        moments: Array = design @ design.T
        return moments

    def _fill(self, part: Samples, tau: Array) -> Array:
        count = len(tau)
        if self.design.shape[1] != count:
            self.design = np.empty((len(self.design), count))
        rows = self.design
        elapsed = part.time - self.start
        chi = self.table_rate * elapsed if part.angle is None else part.angle
        rows[CONSTANT], rows[TIME] = 1.0, tau
        c, s = rows[CHI], rows[CHI + 1]
        np.cos(chi, out=c)
        np.sin(chi, out=s)
        np.multiply(c - s, c + s, out=rows[CHI2])
        np.multiply(2 * c, s, out=rows[CHI2 + 1])
        np.subtract(rows[CHI2] * c, rows[CHI2 + 1] * s, out=rows[CHI3])
        np.add(rows[CHI2 + 1] * c, rows[CHI2] * s, out=rows[CHI3 + 1])
        net = self.net_rate * elapsed
        np.cos(net, out=rows[NET])
        np.sin(net, out=rows[NET + 1])
        np.multiply(rows[CHI : CHI + 2], tau, out=rows[TIME_CHI : TIME_CHI + 2])
        np.multiply(rows[NET : NET + 2], tau, out=rows[TIME_NET : TIME_NET + 2])
        np.subtract(part.channels, self.offset[:, None], out=rows[COLUMNS:])
        return rows


def pieces_of(blocks: Iterable[Samples]) -> Iterator[Samples]:
    """Yield the blocks, the first ones joined until there is enough to find the sampling period."""
    waiting: list[Samples] = []
    count = 0
    enough = False
    for block in blocks:
        if enough:
            yield block
            continue
        waiting.append(block)
        count += len(block.time)
        if count >= FIRST_LOOK:
            enough = True
            yield _joined(*waiting)
            waiting = []
    if waiting:
        yield _joined(*waiting)


def _none_first(pieces: Iterator[Samples]) -> Iterator[Samples | None]:
    """Yield None for what is already at hand, then the rest."""
    yield None
    yield from pieces


def _joined(*parts: Samples) -> Samples:
    if len(parts) == 1:
        return parts[0]
    angles = [part.angle for part in parts if part.angle is not None]
    return Samples(
        np.concatenate([part.time for part in parts]),
        np.concatenate([part.channels for part in parts], axis=1),
        np.concatenate(angles) if angles else None,
    )


def _part(samples: Samples, first: int, last: int) -> Samples:
    angle = None if samples.angle is None else samples.angle[first:last]
    return Samples(samples.time[first:last], samples.channels[:, first:last], angle)
