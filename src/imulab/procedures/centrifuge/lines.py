"""The lines of a run: samples summed over cells, the actual rates of the lines, and their amplitudes.

Model of each channel: constant, trend, and cosine and sine of chi, 2 chi, 3 chi and of the net angle. Over a cell it is
linear in the columns of `COLUMNS`: constant, time, cosine and sine of these four angles, and time times those of chi
and of the net angle. A rate that differs from the assumed one by d turns a line by ``d (t - t0)``; within a cell that
is its value at the centre plus a small linear part, which the last four columns take up to second order, ``(d tau)^2 /
6``. So one pass gives the normal equations at any nearby rates, for any stretch of the run, and the scatter between
stretches.

The noise of a line is the scatter of the line over blocks of the run (batch means), which holds for coloured noise that
is not correlated for longer than a block.

Sources: IEEE Std 1057 (four-parameter sine fit); Fishman, Management Science 24 (1978) 510 (batch means).

Method ``fourier`` (CN102636185A, steps (a) to (e)): ``A = (2/N) sum D cos(j w_s t)``, ``B`` likewise with the sine,
``N = m T / t`` rounded to the nearest sample; j counts samples from 1, as printed, t is the sampling
period, T the table period, m the number of whole periods.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding
from imulab.errors import DataError
from imulab.estimation.decisions import EARTH_LINE_SEEN, RIG_ERROR
from imulab.estimation.least_squares import coverage_factor
from imulab.gravity import EARTH
from imulab.recording import Array
from imulab.units import from_si, to_si

# Sums of a run over cells of about one table period, made as it streams by; all else is computed from them.


# Rows of the design of a cell; beside each row of a cosine stands that of the sine
CONSTANT, TIME, CHI, CHI2, CHI3, NET, TIME_CHI, TIME_NET = 0, 1, 2, 4, 6, 8, 10, 12
COLUMNS = 14  # of the design of a cell
_CHUNK = 16384
"""Samples in one step: few enough to stay in the cache."""
_BINS = 16
"""Means in a cell that are kept as a time series."""
_PRODUCT = 800  # samples of a matrix product that BLAS does not spread over threads
FIRST_LOOK = 1024
"""Samples that the sampling period is computed from."""
FEWEST_PER_PERIOD = 8  # samples in a turn of the table: third harmonics need more than six
_GAP = 2.5  # usual steps: a longer step is a gap


@dataclass(frozen=True)
class CellSamples:
    """A block of a run in SI: time (n,), channels (k, n), and chi, rad, (n,), or None."""

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
        Products of columns and channels with each other, shape (c, 14 + k, 14 + k).
    offset
        Subtracted from the channels before summing, rad/s, shape (k,).
    start, step, samples
        Time of the first sample, sampling period, s, and number of samples.
    cell
        Samples in a full cell.
    table_rate, net_rate
        Signed rates that the sums were made at, rad/s.
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
        """Return the cells from `first` up to `last` (exclusive) as a run."""
        bins = slice(first * self.bins, last * self.bins)
        moments = self.moments[first:last]
        return Cells(
            self.centre[first:last], moments, self.offset, self.start, self.step,
            round(float(moments[:, CONSTANT, CONSTANT].sum())), self.cell, self.table_rate, self.net_rate,
            self.series_time[bins], self.series[:, bins], self.series_begin[bins],
                None if self.series_angle is None else self.series_angle[bins],
        )  # fmt: skip


class TooSlowError(Exception):
    """A table period has fewer samples than three harmonics need; carries their number."""


def sampling_period(time: Array) -> float:
    """Return the sampling period without gaps, s; a whole number of samples in a second where it is one within 1e-9."""
    steps = np.diff(time)
    gaps = steps > _GAP * np.median(steps)
    step = float(time[-1] - time[0] - steps[gaps].sum()) / (len(steps) - np.count_nonzero(gaps))
    nearest = round(1 / step)
    return 1 / nearest if nearest and abs(step * nearest - 1) < 1e-9 else step


def compress(blocks: Iterable[CellSamples], table_rate: float, net_rate: float) -> Cells | None:
    """Return the sums of a run over cells, made block by block.

    Parameters
    ----------
    blocks
        Consecutive blocks of the run.
    table_rate, net_rate
        Signed rates of chi and of the turning against the room, rad/s; the angle chi of the blocks is used if present.

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
        # The remainder is less than a cell and joins the last one, whose columns are about its own centre.
        tail = work.sum_about(rest, float(centre[-1]))
        moments[-1] += tail
        total += left
    return Cells(
        centre, moments, offset, start, step, total, cell, table_rate, net_rate, series_time, series, begin, angle
    )  # fmt: skip


class _Work:
    """Buffers and constants of the sums."""

    def __init__(self, start: float, offset: Array, cell: int, bins: int, table_rate: float, net_rate: float) -> None:
        self.start, self.offset, self.cell, self.bins = start, offset, cell, bins
        self.table_rate, self.net_rate = table_rate, net_rate
        self.design = np.empty((COLUMNS + len(offset), 0))

    def sum(self, part: CellSamples, number: int) -> tuple[Array, Array, Array, Array, Array, Array | None]:
        """Return centres, moments and series of `number` whole cells."""
        shaped = part.time.reshape(number, self.cell)
        centre = shaped.mean(axis=1)
        design = self._fill(part, (shaped - centre[:, None]).ravel())
        # Products this short stay on one thread of BLAS: spreading them costs more than it gains.
        parts = next((n for n in (1, 2, 4, 8) if self.cell % n == 0 and self.cell // n <= _PRODUCT), _BINS)
        parts = parts if self.cell % parts == 0 else 1
        stacked = design.reshape(len(design), number * parts, self.cell // parts).transpose(1, 0, 2)
        moments = (stacked @ stacked.transpose(0, 2, 1)).reshape(number, parts, len(design), len(design)).sum(axis=1)
        inside = self.cell // self.bins
        time = part.time.reshape(-1, inside).mean(axis=1)
        series = part.channels.reshape(len(part.channels), -1, inside).mean(axis=2)
        angle = None if part.angle is None else part.angle[::inside].copy()
        return centre, moments, time, series, part.time[::inside].copy(), angle

    def sum_about(self, part: CellSamples, centre: float) -> Array:
        """Return the moments of a part with time counted from `centre`."""
        design = self._fill(part, part.time - centre)
        moments: Array = design @ design.T
        return moments

    def _fill(self, part: CellSamples, tau: Array) -> Array:
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


def pieces_of(blocks: Iterable[CellSamples]) -> Iterator[CellSamples]:
    """Yield the blocks, the first ones joined until they show the sampling period."""
    waiting: list[CellSamples] = []
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


def _none_first(pieces: Iterator[CellSamples]) -> Iterator[CellSamples | None]:
    """Yield None for the piece at hand, then the other pieces."""
    yield None
    yield from pieces


def _joined(*parts: CellSamples) -> CellSamples:
    if len(parts) == 1:
        return parts[0]
    angles = [part.angle for part in parts if part.angle is not None]
    return CellSamples(
        np.concatenate([part.time for part in parts]),
        np.concatenate([part.channels for part in parts], axis=1),
        np.concatenate(angles) if angles else None,
    )


def _part(samples: CellSamples, first: int, last: int) -> CellSamples:
    angle = None if samples.angle is None else samples.angle[first:last]
    return CellSamples(samples.time[first:last], samples.channels[:, first:last], angle)


# Regression of the channels on the lines, from cells: at given rates, with refined rates, and its noise.


Complex = NDArray[np.complex128]

SIZE = 10  # coefficients of a channel in the regression over cells
TREND, LINE, SECOND, THIRD, ROOM = 1, 2, 4, 6, 8
"""Rows of the solution: constant is 0, then trend; lines at chi, 2 chi, 3 chi; the line at the net rate."""
_BLOCKS = 64  # most parts of a run whose scatter gives a line's noise
_SINGULAR = 1e-7  # eigenvalue of the scaled normal matrix below which a column is left out
_STEPS = 30  # most steps of Newton's method for the rates


@dataclass(frozen=True)
class LineRegression:
    """Lines of all channels of a run.

    Attributes
    ----------
    coefficients
        Solution of all channels, shape (10, k), rad/s (trend per half duration); zero where a column was left out.
    inverse
        Inverse of the normal matrix: covariance per unit variance of a sample, shape (10, 10).
    table_shift, net_shift
        Added to the cells' rates, rad/s.
    middle, half
        Centre of the run and half its duration, s.
    kept
        Columns that the run can separate, shape (10,).
    """

    coefficients: Array
    inverse: Array
    table_shift: float
    net_shift: float
    middle: float
    half: float
    kept: NDArray[np.bool_]

    def line(self, row: int) -> Complex:
        """Return ``A + i B`` of all channels, with the phase of the cells' angle at the middle of the run."""
        pair: Complex = self.coefficients[row] + 1j * self.coefficients[row + 1]
        return pair

    def gain(self, row: int) -> float:
        """Return the variance of one component of a line per variance of a sample; 2/N for a long run."""
        return float(self.inverse[row, row] + self.inverse[row + 1, row + 1]) / 2


def basis(cells: Cells, middle: float, half: float, table_shift: float, net_shift: float) -> Array:
    """Return the ten columns of the model as combinations of those of the cells, shape (c, 14, 10)."""
    since = cells.centre - middle
    P = np.zeros((len(since), COLUMNS, SIZE))
    P[:, CONSTANT, 0] = 1.0
    P[:, CONSTANT, TREND], P[:, TIME, TREND] = since / half, 1 / half
    for row, column, times, linear, shift in (
        (LINE, CHI, 1, TIME_CHI, table_shift),
        (SECOND, CHI2, 2, None, table_shift),
        (THIRD, CHI3, 3, None, table_shift),
        (ROOM, NET, 1, TIME_NET, net_shift),
    ):
        c, s = np.cos(times * shift * since), np.sin(times * shift * since)
        P[:, column, row], P[:, column + 1, row] = c, -s
        P[:, column, row + 1], P[:, column + 1, row + 1] = s, c
        if linear is not None:
            P[:, linear, row], P[:, linear + 1, row] = -shift * s, -shift * c
            P[:, linear, row + 1], P[:, linear + 1, row + 1] = shift * c, -shift * s
    return P


def solve(cells: Cells, table_shift: float = 0.0, net_shift: float = 0.0) -> LineRegression:
    """Return the regression of all channels at the cells' rates plus these shifts."""
    middle, half = _span(cells)
    P = basis(cells, middle, half, table_shift, net_shift)
    normal, right = _normal(cells, P)
    kept = _independent(normal)
    inverse = np.zeros((SIZE, SIZE))
    inverse[np.ix_(kept, kept)] = _inverse(normal[np.ix_(kept, kept)])
    return LineRegression(inverse @ right, inverse, table_shift, net_shift, middle, half, kept)


def _span(cells: Cells) -> tuple[float, float]:
    half = cells.duration / 2
    return float(np.average(cells.centre, weights=cells.moments[:, CONSTANT, CONSTANT])), half


def _normal(cells: Cells, P: Array) -> tuple[Array, Array]:
    carried = cells.moments[:, :COLUMNS, :COLUMNS] @ P
    # Many small products on one thread are faster than a single long and thin one on several.
    turned = P.transpose(0, 2, 1)
    normal = (turned @ carried).sum(axis=0)
    right = (turned @ cells.moments[:, :COLUMNS, COLUMNS:]).sum(axis=0)
    return normal, right


def _independent(normal: Array) -> NDArray[np.bool_]:
    """Return which columns to keep: without the net line, then harmonics and trend, where they are not distinct."""
    kept = np.ones(SIZE, dtype=np.bool_)
    for drop in ((ROOM, ROOM + 1), (THIRD, THIRD + 1), (SECOND, SECOND + 1), (TREND,)):
        part = normal[np.ix_(kept, kept)]
        scale = np.sqrt(np.maximum(np.diagonal(part), np.finfo(float).tiny))
        if np.linalg.eigvalsh(part / np.outer(scale, scale))[0] > _SINGULAR:
            break
        kept[list(drop)] = False
    return kept


def _inverse(normal: Array) -> Array:
    scale = np.sqrt(np.diagonal(normal))
    inverse: Array = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    return inverse


@dataclass(frozen=True)
class Refined:
    """Shifts of table rate and net rate that fit a channel best, and their variances per variance of a sample."""

    table_shift: float
    net_shift: float
    table_gain: float
    net_gain: float


def refine(cells: Cells, channel: int, table_shift: float | None, net_shift: float | None) -> Refined | None:
    """Return rates fitted together with all lines of one channel, from good starts; None without convergence.

    This is the four-parameter sine fit of IEEE Std 1057 with the other lines, constant and trend in the model. A shift
    of None stays at zero.
    """
    middle, half = _span(cells)
    shifts = [table_shift or 0.0, net_shift or 0.0]
    start = list(shifts)
    free = [value is not None for value in (table_shift, net_shift)]
    gains = [0.0, 0.0]
    reach = np.pi / half
    for _ in range(_STEPS):
        P = basis(cells, middle, half, *shifts)
        normal, right = _normal(cells, P)
        kept = _independent(normal)
        if not kept[ROOM]:
            free[1] = False
        if not any(free):
            return Refined(*shifts, *gains)
        beta = np.zeros(SIZE)
        beta[kept] = np.linalg.solve(normal[np.ix_(kept, kept)], right[kept, channel])
        extra = []
        for row, linear, on in ((LINE, TIME_CHI, free[0]), (ROOM, TIME_NET, free[1])):
            if on:
                extra.append(_rate_column(cells, P, beta, row, linear, middle, half))
        both = np.concatenate([P[:, :, kept], np.stack(extra, axis=2)], axis=2)
        normal, right = _normal(cells, both)
        score = right[:, channel] - normal[:, : int(kept.sum())] @ beta[kept]
        inverse = _inverse(normal)
        step = (inverse @ score)[-len(extra) :] / half
        variance = np.diagonal(inverse)[-len(extra) :] / half**2
        for index, (value, gain) in zip(np.flatnonzero(free), zip(step, variance, strict=True), strict=True):
            shifts[index] += float(value)
            gains[index] = float(gain)
            if abs(shifts[index] - start[index]) > reach:
                return None
        if np.abs(step).max() * half < 1e-10:
            break
    return Refined(*shifts, *gains)


def _rate_column(cells: Cells, P: Array, beta: Array, row: int, linear: int, middle: float, half: float) -> Array:
    """Return the derivative of a line by its rate, times `half`, in the columns of the cells, shape (c, 14)."""
    turned = beta[row + 1] * P[:, :, row] - beta[row] * P[:, :, row + 1]
    column: Array = turned * ((cells.centre - middle) / half)[:, None]
    turned_pair = {TIME_CHI: CHI, TIME_NET: NET}[linear]
    column[:, linear : linear + 2] += turned[:, turned_pair : turned_pair + 2] / half
    return column


@dataclass(frozen=True)
class LineScatter:
    """Scatter of a line over blocks of a run.

    Attributes
    ----------
    noise
        Variance of a sample of white noise that scatters the line as much, shape (k, k), Hermitian.
    freedom
        Degrees of freedom of each of its diagonal elements.
    deviation
        Line of each block less that of the run, shape (m, k).
    centre, gain
        Time of each block, s, and variance of its component per variance of a sample, shapes (m,).
    edges
        First cell of each block, and the end, shape (m + 1,).
    """

    noise: Complex
    freedom: float
    deviation: Complex
    centre: Array
    gain: Array
    edges: NDArray[np.int64]


def scatter(
    cells: Cells, solution: LineRegression, row: int = LINE, *, least: float = 0.0, blocks: int = _BLOCKS
) -> LineScatter | None:
    """Return the scatter of a line over blocks of at least `least` seconds; None with fewer than three blocks.

    Each block has its own constant, and a trend if it holds two cells or more, so that slow drift does not count as
    noise of the line.
    """
    per_block = max(1.0, least / (cells.cell * cells.step))
    count = min(blocks, int(len(cells.centre) / per_block))
    if count < 3:
        return None
    P = basis(cells, solution.middle, solution.half, solution.table_shift, solution.net_shift)
    left = cells.moments[:, :COLUMNS, COLUMNS:] - cells.moments[:, :COLUMNS, :COLUMNS] @ (P @ solution.coefficients)
    edges = np.round(np.linspace(0, len(cells.centre), count + 1)).astype(int)
    weights = cells.moments[:, CONSTANT, CONSTANT]
    total = np.add.reduceat(weights, edges[:-1])
    centre = np.add.reduceat(weights * cells.centre, edges[:-1]) / total
    local = np.concatenate([P[:, :, :2], P[:, :, row : row + 2]], axis=2)
    since = cells.centre - np.repeat(centre, np.diff(edges))
    local[:, CONSTANT, 1] = since / solution.half
    if np.diff(edges).min() < 2:
        local = np.delete(local, 1, axis=2)
    normal = np.add.reduceat(
        local.transpose(0, 2, 1) @ cells.moments[:, :COLUMNS, :COLUMNS] @ local, edges[:-1], axis=0
    )
    score = np.add.reduceat(local.transpose(0, 2, 1) @ left, edges[:-1], axis=0)
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return None
    fitted = (inverse @ score)[:, -2:]
    deviation = fitted[:, 0] + 1j * fitted[:, 1]
    gain = (inverse[:, -1, -1] + inverse[:, -2, -2]) / 2
    if not (np.isfinite(gain).all() and gain.min() > 0):  # blocks too short to separate line and constant
        return None
    noise = np.einsum("m,mi,mj->ij", 1 / gain, deviation, deviation.conj()) / (2 * (count - 1))
    return LineScatter(noise, 2.0 * (count - 1), deviation, centre, gain, edges)


# Method fourier: sums over whole periods at the manifest's rate, made as the run streams by.


class PeriodSums:
    """Sums over each whole period, made of the blocks that pass through `watch`."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._sums: list[Array] = []
        self._edge: Array | None = None
        self._index = 0
        self._step = 0.0
        self.turn = 0.0  # from one sample to the next, rad
        self._time = (0.0, 0.0)

    def watch(self, blocks: Iterable[CellSamples]) -> Iterator[CellSamples]:
        """Yield the blocks after summing them; the first block must be long enough for the sampling period."""
        for block in blocks:
            if not self._index:
                if len(block.time) < 2:
                    yield block
                    continue
                self._step = sampling_period(block.time[:FIRST_LOOK])
                self.turn = self._rate * self._step
                self._time = (float(block.time[0]), 0.0)
            self._add(block)
            self._time = (self._time[0], float(block.time[-1]))
            yield block

    @property
    def even(self) -> bool:
        """Whether the samples are evenly spaced over the run, within half a sampling period."""
        span = self._time[1] - self._time[0]
        return abs(span - (self._index - 1) * self._step) < 0.5 * self._step

    def _add(self, block: CellSamples) -> None:
        """Add cosine and sine times the channels and 1, period by period."""
        count = len(block.time)
        phase = self.turn * np.arange(self._index + 1, self._index + 1 + count)
        values = np.vstack([block.channels, np.ones(count)])
        products = np.stack([np.cos(phase) * values, np.sin(phase) * values])
        samples = 2 * np.pi / abs(self._rate) / self._step
        first, last = self._period(self._index, samples), self._period(self._index + count - 1, samples)
        edges = np.round(np.arange(first, last + 1) * samples).astype(np.int64) - self._index
        edges[0] = 0
        sums = np.add.reduceat(products, edges, axis=2)
        if self._edge is not None and self._period(self._index - 1, samples) == first:
            sums[:, :, 0] += self._edge
        elif self._edge is not None:
            self._sums.append(self._edge)
        self._sums += list(np.moveaxis(sums[:, :, :-1], 2, 0))
        self._edge = sums[:, :, -1]
        self._index += count

    @staticmethod
    def _period(sample: int, samples: float) -> int:
        """Return the number of the period of a sample; period m begins at sample round(m T / t)."""
        number = int(sample / samples)
        while round((number + 1) * samples) <= sample:
            number += 1
        while round(number * samples) > sample:
            number -= 1
        return number

    def result(self, mean: Array, first: float = 0.0, last: float = np.inf) -> PeriodResult | None:
        """Return the lines over the whole periods between two times after the start, s; None if there is no period.

        Parameters
        ----------
        mean
            Means of the static records, subtracted from the channels, rad/s, shape (k,).
        """
        samples = 2 * np.pi / abs(self._rate) / self._step
        sums = list(self._sums)
        if self._edge is not None and self._index >= round((len(sums) + 1) * samples):
            sums.append(self._edge)  # a run that ends with a period
        begin = int(np.ceil(first / self._step / samples - 1e-9))
        end = min(len(sums), int(min(last / self._step / samples + 1e-9, 1e15)))
        if end <= begin:
            return None
        total = np.sum(sums[begin:end], axis=0)
        count = round(end * samples) - round(begin * samples)
        lines = 2 / count * (total[:, :-1] - total[:, -1:] * mean)
        return PeriodResult(lines[0] + 1j * lines[1], end - begin, count)


@dataclass(frozen=True)
class PeriodResult:
    """Lines ``A + i B`` of the channels, shape (k,), over `periods` whole periods of `samples` samples."""

    line: Complex
    periods: int
    samples: int


# Spectra of a run's series: places of lines, and how far they stand out.


SEARCH = to_si(1.0, "deg/s")
"""How far from the manifest's rate a line is searched for."""
FAINT = to_si(0.001, "deg/h")
"""Smallest line, however quiet the channel."""
PEAK = 6.0
"""Height of a peak over the median of the spectrum: one false alarm in 1e10 bins of noise."""
FINE = 4
"""Points of a spectrum per resolution 1/T of the run."""


def even_series(cells: Cells, values: Array) -> Array:
    """Return the values of a run's bins at even steps, zero where the recording has a gap, shape (n,)."""
    place = np.round((cells.series_time - cells.series_time[0]) / cells.series_step).astype(np.int64)
    if place[-1] == len(place) - 1:
        return values
    even = np.zeros(int(place[-1]) + 1)
    even[place] = values
    return even


def hann_spectrum(step: float, values: Array, frequencies: Array) -> Complex:
    """Return the Hann-windowed spectrum of values a `step` apart, in which a line shows as its ``A - i B``, (f,)."""
    count = len(values)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    weighted = window * values / window.sum() * 2
    # Time is the start of a stretch plus a multiple of the step: few exponentials and one matrix product.
    stretch = max(1, int(np.sqrt(count)))
    padded = np.append(weighted, np.zeros(-count % stretch)).reshape(-1, stretch)
    inner = padded @ np.exp(-1j * np.outer(np.arange(stretch) * step, frequencies))
    outer = np.exp(-1j * np.outer(np.arange(0, count, stretch) * step, frequencies))
    spectrum: Complex = (inner * outer).sum(axis=0)
    return spectrum


def detrended(time: Array, values: Array) -> Array:
    """Return values without the straight line through them."""
    middle = time - time.mean()
    slope = (middle * values).sum() / (middle * middle).sum()
    left: Array = values - values.mean() - slope * middle
    return left


def search_line(cells: Cells, series: Array, rate: float, within: float) -> tuple[float, float]:
    """Return the shift of a line from `rate`, rad/s, and its height over the median of the spectrum around it."""
    values = even_series(cells, detrended(cells.series_time, series))
    count = len(values)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    size = FINE * count
    height = np.abs(np.fft.rfft(window * values, size)).astype(np.float64)
    step = float(2 * np.pi / (size * cells.series_step))
    centre = min(round(abs(rate) / step), len(height) - 1)
    around = np.concatenate([np.arange(-24, -3), np.arange(4, 25)]) * FINE + centre
    near = height[around[(around > 2 * FINE) & (around < len(height))]]
    floor = max(float(np.median(near)) if near.size else 0.0, 1e-300)
    reach = int(within / step)
    if reach < FINE // 2:
        return 0.0, float(height[centre]) / floor
    low, high = max(centre - reach, 0), min(centre + reach + 1, len(height))
    heights: Array = np.asarray(height[low:high], dtype=np.float64)
    grid: Array = np.arange(low, high, dtype=np.float64) * step - abs(rate)
    shift = interpolated(grid, heights)
    return float(np.sign(rate)) * shift, float(heights.max()) / floor


def interpolated(grid: Array, height: Array) -> float:
    """Return the abscissa of the maximum, by a parabola through the highest point and its neighbours."""
    index = int(np.argmax(height))
    if not 0 < index < len(grid) - 1:
        return float(grid[index])
    low, top, high = height[index - 1 : index + 2]
    curvature = low - 2 * top + high
    part = 0.5 * (low - high) / curvature if curvature < 0 else 0.0
    return float(grid[index] + part * (grid[1] - grid[0]))


def strongest_line(cells: Cells, series: Array, above: float) -> float | None:
    """Return the rate of the highest line faster than `above`, rad/s; None where none stands out."""
    values = even_series(cells, detrended(cells.series_time, series))
    count = len(values)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    height: Array = np.asarray(2 * np.abs(np.fft.rfft(window * values)) / window.sum(), dtype=np.float64)
    rates: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(count, cells.series_step), dtype=np.float64)
    fast = rates > above
    if not fast.any() or height[fast].max() < max(PEAK * float(np.median(height)), FAINT):
        return None
    index = int(np.argmax(np.where(fast, height, 0.0)))
    part = slice(max(index - 1, 0), index + 2)
    return interpolated(rates[part], height[part])


def in_degrees(rate: float, digits: int = 6) -> str:
    """Return a rate as messages state it, in deg/s."""
    return f"{from_si(rate, 'deg/s'):.{digits}g} deg/s"


# The rates of a run: the measured rates of its lines, checked against the manifest.


MISMATCH = to_si(0.5, "deg/s")
_DOUBT = to_si(0.01, "deg/s")
_PLAUSIBLE = to_si(1.0, "deg/h")
_POLAR = to_si(0.05, "deg/h")


@dataclass(frozen=True)
class Rates:
    """Rates of a run, and its regression at these rates.

    Attributes
    ----------
    solution
        The regression.
    table_rate, table_uncertainty
        Signed rate of chi, rad/s, and its standard uncertainty (None where it is the manifest's).
    origin
        ``encoder``, ``fog`` or ``manifest``.
    net_rate, net_uncertainty
        Measured; None where the FOG shows no such line.
    net_noise, net_freedom
        Variance of a sample of white noise that scatters the net line as much, shape (k, k); its degrees of freedom.
    warnings
        Messages for the user.
    """

    solution: LineRegression
    table_rate: float
    table_uncertainty: float | None
    origin: str
    net_rate: float | None
    net_uncertainty: float | None
    net_noise: Complex
    warnings: tuple[str, ...]
    net_freedom: float = 1e9


def find_rates(cells: Cells, place: str) -> Rates:
    """Return table rate and net rate, refined on the FOG (the last channel), and the regression of all channels there.

    Raises
    ------
    DataError
        A rate does not match the manifest, or Earth rate has an impossible size (a wrong unit).
    """
    fog = len(cells.offset) - 1
    encoder = cells.series_angle is not None
    warnings: list[str] = []
    table_shift: float | None = None
    if not encoder:
        table_shift = search_line(cells, cells.series[fog], cells.table_rate, SEARCH)[0]
        alone = refine(cells, fog, table_shift, None)
        table_shift = table_shift if alone is None else alone.table_shift
    net_start = _net_start(cells, table_shift or 0.0, fog, place)
    refined = refine(cells, fog, table_shift, net_start)
    if refined is None and net_start is not None:
        refined, net_start = refine(cells, fog, table_shift, None), None
    if refined is None:
        refined = refine(cells, fog, None, net_start)
        table_shift = None
    shifts = [0.0, 0.0] if refined is None else [refined.table_shift, refined.net_shift]
    solution = solve(cells, *shifts)
    table_noise, _ = _noise(cells, solution, LINE)
    net_noise, net_freedom = _noise(cells, solution, ROOM)
    origin, table_uncertainty = ("encoder", None) if encoder else ("fog", None)
    if not encoder and (table_shift is None or not _significant(solution, LINE, fog, table_noise)):
        origin, shifts[0] = "manifest", 0.0
        warnings.append(
            Finding(
                f"{place}: no significant FOG line at the table rate{_strongest_elsewhere(cells, fog)}; the manifest's "
                "rate was used as it is",
                "check table_rate in the manifest, or record table_angle",
            )
        )
    elif not encoder and refined is not None:
        table_uncertainty = float(np.sqrt(refined.table_gain * table_noise[fog, fog].real))
        if abs(shifts[0]) > max(MISMATCH, 3 * table_uncertainty):
            raise DataError(
                f"{place}: the FOG's line is at {in_degrees(cells.table_rate + shifts[0])}, expected table_rate "
                f"{in_degrees(cells.table_rate)}"
            )
    net_rate = net_uncertainty = None
    if net_start is None or not solution.kept[ROOM] or not _significant(solution, ROOM, fog, net_noise):
        shifts[1] = 0.0
        warnings.append(
            Finding(
                f"{place}: no significant Earth-rate line of the FOG at the net rate {in_degrees(cells.net_rate)}",
                "check arm_rate and table_rate of this run in the manifest",
            )
        )
    else:
        assert refined is not None
        net_rate = cells.net_rate + shifts[1]
        net_uncertainty = float(np.sqrt(refined.net_gain * net_noise[fog, fog].real))
        warnings += _check_net(cells.net_rate, net_rate, net_uncertainty * three_sigma(net_freedom), place)
        warnings += _check_units(solution, net_noise, place)
    solution = solve(cells, *shifts)
    rate = _encoder_rate(cells) if encoder else cells.table_rate + shifts[0]
    return Rates(
        solution, rate, table_uncertainty, origin, net_rate, net_uncertainty, _noise(cells, solution, ROOM)[0],
        tuple(warnings), net_freedom,
    )  # fmt: skip


def three_sigma(freedom: float | None) -> float:
    """Return the number of standard uncertainties, for these degrees of freedom, that is exceeded as rarely as 3."""
    return coverage_factor(freedom, 1 - RIG_ERROR.level)


def _check_net(expected: float, measured: float, reach: float, place: str) -> list[str]:
    off = abs(measured - expected)
    if off > max(MISMATCH, reach):
        raise _mismatch(expected, measured, place)
    if off > max(_DOUBT, reach):
        return [
            Finding(
                f"{place}: the net rate measured on Earth rate is {in_degrees(measured)} ± {in_degrees(reach / 3)}, "
                f"{in_degrees(measured - expected)} from arm_rate less table_rate: the difference is in u of this "
                "run's K",
                "check arm_rate and table_rate of this run in the manifest",
            )
        ]
    return []


def _mismatch(expected: float, rate: float, place: str) -> DataError:
    return DataError(
        f"{place}: rates do not match: the FOG's Earth-rate line is at {in_degrees(abs(rate))}, expected the net rate "
        f"{in_degrees(abs(expected))} (arm_rate less table_rate)"
    )


def _check_units(solution: LineRegression, noise: Complex, place: str) -> list[str]:
    """Refuse an impossible size of the Earth's rate, and return warnings where gyroscope and FOG disagree on it."""
    line = solution.line(ROOM)
    fog, earth = line[-1], float(abs(line[-1]))
    if not _POLAR < earth < 1.2 * EARTH:
        raise DataError(
            f"{place}: column fog shows Earth rate as {from_si(earth, 'deg/h'):.4g} deg/h, expected up to 15.04 deg/h: "
            "is its unit or scale factor wrong?"
        )
    warnings: list[str] = []
    sigma = np.sqrt(solution.gain(ROOM) * np.diagonal(noise).real)
    # A vector fixed in the room passes Y a quarter turn before X.
    for name, value, expected, u in zip(("dtg_x", "dtg_y"), line[:-1], (fog, -1j * fog), sigma[:-1], strict=False):
        if not earth / 2 - 5 * u < abs(value) < 2 * earth + 5 * u:
            raise DataError(
                f"{place}: column {name} shows Earth rate as {from_si(float(abs(value)), 'deg/h'):.4g} deg/h, column "
                f"fog as {from_si(earth, 'deg/h'):.4g} deg/h: wrong or mixed units or scale factors?"
            )
        turned = value * expected.conjugate() / earth
        if abs(turned.imag) - turned.real > 5 * np.sqrt(2) * u:
            message = (
                f"{place}: column {name} shows Earth rate {np.degrees(np.angle(turned)):.0f} deg from where column fog "
                "says: is an axis or a sign reversed, or are columns exchanged?"
            )
            if name == "dtg_x":
                raise DataError(message)
            warnings.append(Finding(message, "check axes and signs of the channels, and title the columns accordingly"))
    return warnings


def _noise(cells: Cells, solution: LineRegression, row: int) -> tuple[Complex, float]:
    """Return the noise of a line from its scatter over blocks, or from residuals in a short run, and its freedom."""
    least = 2 * np.pi / max(abs(cells.net_rate), 1e-9) if row == ROOM else 0.0
    scattered = scatter(cells, solution, row, least=min(least, cells.duration / 3))
    return (residual_noise(cells, solution), 1e9) if scattered is None else (scattered.noise, scattered.freedom)


def residual_noise(cells: Cells, solution: LineRegression) -> Complex:
    """Return the covariance of a sample's residuals, the noise if it is white, shape (k, k)."""
    columns = cells.moments.shape[1] - len(cells.offset)
    P = basis(cells, solution.middle, solution.half, solution.table_shift, solution.net_shift) @ solution.coefficients
    cross = (P.transpose(0, 2, 1) @ cells.moments[:, :columns, columns:]).sum(axis=0)
    square = cells.moments[:, columns:, columns:].sum(axis=0)
    fitted = (P.transpose(0, 2, 1) @ cells.moments[:, :columns, :columns] @ P).sum(axis=0)
    left = square - cross - cross.T + fitted
    noise: Complex = (left / max(cells.samples - int(solution.kept.sum()), 1)).astype(np.complex128)
    return noise


def _significant(solution: LineRegression, row: int, channel: int, noise: Complex) -> bool:
    size = abs(solution.line(row)[channel])
    power = 2 * solution.gain(row) * float(noise[channel, channel].real)
    return bool(size > FAINT and size**2 > EARTH_LINE_SEEN.limit * power)


def _encoder_rate(cells: Cells) -> float:
    """Return the slope of the encoder's angle, rad/s."""
    assert cells.series_angle is not None
    begin = cells.series_begin
    deviation = np.unwrap(cells.series_angle - cells.table_rate * (begin - cells.start))
    return cells.table_rate + float(np.polyfit(begin - begin.mean(), deviation, 1)[0])


def _net_start(cells: Cells, table_shift: float, fog: int, place: str) -> float | None:
    """Return the FOG's Earth-rate line as a shift from the manifest's net rate; None where there is none.

    The whole spectrum without the table lines is searched for peaks; the one nearest to the net rate is taken.
    """
    seconds = cells.duration
    bin_width = 2 * np.pi / seconds
    net = abs(cells.net_rate)
    if net < 1.5 * bin_width:
        return None
    values = even_series(cells, _without_table_lines(cells, table_shift, fog))
    count = len(values)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    height: Array = np.asarray(2 * np.abs(np.fft.rfft(window * values)) / window.sum(), dtype=np.float64)
    rates: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(count, cells.series_step), dtype=np.float64)
    floor = float(np.median(height))
    peak = np.zeros(len(height), dtype=np.bool_)
    peak[1:-1] = (
        (height[1:-1] >= height[:-2]) & (height[1:-1] > height[2:]) & (height[1:-1] > max(PEAK * floor, FAINT / 10))
    )
    tolerance = max(MISMATCH, 1.5 * bin_width)
    near = peak & (np.abs(rates - net) <= tolerance)
    if near.any():
        index = int(np.argmax(np.where(near, height, 0.0)))
        sign = 1.0 if cells.net_rate > 0 else -1.0
        return sign * (_peak_rate(index, rates, height) - net)
    far = peak & (height > _PLAUSIBLE) & (height < 1.1 * EARTH) & (rates > 2 * bin_width)
    for times in (1, 2, 3):
        far &= np.abs(rates - times * abs(cells.table_rate)) > 3 * bin_width
    if far.any():
        candidates = np.flatnonzero(far)
        index = int(candidates[np.argmin(np.abs(rates[candidates] - net))])
        raise _mismatch(net, _peak_rate(index, rates, height), place)
    return None


def _peak_rate(index: int, rates: Array, height: Array) -> float:
    """Return the rate of a peak of a spectrum, interpolated between its neighbours."""
    part = slice(max(index - 2, 0), index + 3)
    return interpolated(rates[part], height[part])


def _strongest_elsewhere(cells: Cells, fog: int) -> str:
    """Return the end of the message that names the FOG's strongest line: perhaps it is the rate of another run."""
    strongest = strongest_line(cells, cells.series[fog], 1.5 * abs(cells.net_rate))
    return (
        ""
        if strongest is None
        else f" {in_degrees(abs(cells.table_rate))} (its strongest line is at {in_degrees(strongest, 5)})"
    )


def _without_table_lines(cells: Cells, table_shift: float, channel: int) -> Array:
    """Return the series of a channel without constant, trend and table lines, fitted by least squares."""
    time = cells.series_time
    if cells.series_angle is not None:
        chi = np.unwrap(cells.series_angle) + cells.table_rate * (cells.series_step - cells.step) / 2
    else:
        chi = (cells.table_rate + table_shift) * (time - cells.start)
    columns = [np.ones(len(time)), (time - time.mean()) / cells.duration]
    for times in (1, 2, 3):
        columns += [np.cos(times * chi), np.sin(times * chi)]
    design = np.stack(columns, axis=1)
    normal = np.einsum("ni,nj->ij", design, design)
    right = np.einsum("ni,n->i", design, cells.series[channel])
    left: Array = cells.series[channel] - np.einsum("ni,i->n", design, np.linalg.lstsq(normal, right, rcond=None)[0])
    return left
