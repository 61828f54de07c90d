"""Static attitudes: from continuous recordings, tables, files and arrays; clipped samples, and the samples of holds.

Source: batch means: Fishman, Grouping observations in digital simulation, Management Science 24 (1978) 510.

The recording is cut into short blocks whose means and scatters are formed once; windows of a second or so slide over
the blocks. A window is quiet where its variance stays below a threshold relative to the quietest stretch. The
threshold is swept, and the one is kept whose attitudes predict each other best: the outputs of a triad at rest lie on
an ellipsoid, whose leave-one-out error needs no gravity, no model order and no iteration.

Source: Tedaldi, Pretto, Menegatti, ICRA 2014 (threshold sweep).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, Unpack

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

import imulab.procedures.tumble._segment as _segment
from imulab.columns import triad
from imulab.display import Finding, Note
from imulab.errors import DataError, OptionError, SegmentError, UnitError
from imulab.estimation.rows import distinct, leave_out, median, medians, quantile
from imulab.estimation.sampling import bridged, doubt_unit_of_time, mislabelled
from imulab.procedures.result import OWN_CLOCKS, as_recording
from imulab.readers.streams import one_clock
from imulab.recording import Array, Data, Reading, Recording, Sampling, check_finite, check_time, release, state_rate
from imulab.units import conversion_factor

# Attitudes: what segmentation hands to a tumble fit.


POOL_DEGREES = 10.0
"""Weight, in degrees of freedom, of the noise pooled over all attitudes against an attitude's own."""


class Trace(Struct, frozen=True):
    """Windowed variance of a triad over time (sum of the axes), in the squared unit of its columns.

    ``threshold`` is the variance below which a window is at rest, ``quiet`` that of the quietest stretch.
    """

    time: Array
    variance: Array
    threshold: float
    quiet: float

    def describe(self) -> str:
        """Return the trace in a few words, for a message."""
        below = np.count_nonzero(self.variance <= self.threshold) / len(self.variance)
        low, middle, high = np.sqrt(np.quantile(self.variance, [0.05, 0.5, 0.95]))
        return (
            f"standard deviation within a window {low:.3g} (quietest 5 %), {middle:.3g} (median), {high:.3g} "
            f"(95 %); {100 * below:.0f} % of the time below the threshold {np.sqrt(self.threshold):.3g}"
        )


class Motion(Struct, frozen=True):
    """Motion of the unit during each hold, as far as it changes the mean magnitude of f.

    The mean of the magnitudes differs from the magnitude of the mean by the motion, and their scatter is the noise.
    Both follow from the blocks of a hold through df/dM, which is known only when the fit is done.

    Attributes
    ----------
    lengthening
        ``C_w / N - D``, (n, 3, 3): covariance of the mean by white noise, which makes |f| too long, less the motion,
        which makes the magnitude of the mean too short; in the squared unit of the outputs.
    moments
        Covariance of the attitude's means of x, y, z, xx, yy, zz, xy, xz, yz about its mean, from batches, (n, 9, 9).
    usual
        Covariance of the mean that white noise alone would leave, pooled over the attitudes: what tells noisy axes from
        quiet ones, but not how strong the noise is at low frequencies; (n, 3, 3).
    freedom
        Degrees of freedom of `moments`, shape (n,).
    shake
        Variance of each axis within the blocks beyond white noise, which is faster than they tell, shape (n, 3).
    """

    lengthening: Array
    moments: Array
    usual: Array
    freedom: Array
    shake: Array

    def scaled(self, scale: Array) -> Motion:
        """Return it for outputs that are divided by `scale`, shape (3,)."""
        square = scale[:, None] * scale
        each = np.concatenate([scale, scale**2, square[[0, 0, 1], [1, 2, 2]]])
        return Motion(
            self.lengthening / square,
            self.moments / (each[:, None] * each),
            self.usual / square,
            self.freedom,
            self.shake / scale**2,
        )

    def __getitem__(self, which: NDArray[Any]) -> Motion:
        """Return it for some of the attitudes."""
        return Motion(
            self.lengthening[which], self.moments[which], self.usual[which], self.freedom[which], self.shake[which]
        )


@dataclass(frozen=True)
class Attitudes:
    """Static attitudes of one tumble test.

    Attributes
    ----------
    mean
        Mean output of the triad in each attitude, shape (n, 3), in `unit`.
    covariance
        Covariance of each mean, shape (n, 3, 3), or None where nothing is known of the noise.
    samples
        Number of samples behind each mean, shape (n,).
    start, stop
        Time of the first and last sample, s, shape (n,); row numbers for a table of attitudes.
    unit
        Unit of the outputs as in the file.
    recording
        Where they come from, on the clock of the accelerometers.
    temperature
        Mean temperature of the test, degC, if known.
    as_read
        The same, each sensor on its own clock.
    trace
        The variance trace that the attitudes were found in; None for a table.
    pieces
        Static stretches as rows (first sample, last sample + 1, attitude), for a continuous recording.
    swing
        Range of each axis over the whole recording, motion included, shape (3,).
    motion
        How they moved while they were held; None for a table.
    notes
        What a user should know of how they were found.
    numbers
        Where some were set aside: the place of each among all that were found, shape (n,).

    Examples
    --------
    >>> import imulab as il
    >>> attitudes = il.find_attitudes(il.simulate_tumble(order=1, seed=1))
    >>> attitudes.mean.shape, attitudes.covariance.shape, attitudes.unit
    ((24, 3), (24, 3, 3), 'm/s^2')
    """

    mean: Array
    covariance: Array | None
    samples: NDArray[np.int64]
    start: Array
    stop: Array
    unit: str
    recording: Recording
    temperature: float | None = None
    as_read: Recording | None = None
    trace: Trace | None = None
    pieces: NDArray[np.int64] | None = None
    swing: Array | None = None
    motion: Motion | None = None
    notes: tuple[str, ...] = ()
    numbers: NDArray[np.intp] | None = None

    def __repr__(self) -> str:
        return f"Attitudes({len(self)} of {self.recording.name}, in {self.unit})"

    def __len__(self) -> int:
        return len(self.mean)

    def label(self, index: int) -> str:
        """Return how messages name an attitude: by its row, or by its time."""
        number = index if self.numbers is None else int(self.numbers[index])
        if self.trace is None:
            return self.recording.place(int(self.start[index]) - self.recording.first_row)
        return f"attitude {number + 1} ({self.start[index]:.1f} to {self.stop[index]:.1f} s)"

    def only(self, kept: NDArray[np.intp]) -> Attitudes:
        """Return some of the attitudes under the labels that they had; the stretches at rest are left out."""
        return replace(
            self,
            mean=self.mean[kept],
            covariance=None if self.covariance is None else self.covariance[kept],
            samples=self.samples[kept],
            start=self.start[kept],
            stop=self.stop[kept],
            pieces=None,
            motion=None if self.motion is None else self.motion[kept],
            numbers=kept if self.numbers is None else self.numbers[kept],
        )


# A table of attitudes: a recording without time, each of whose rows is an attitude at rest.


_LONG_TABLE = 1000  # rows: more are hardly means of attitudes, but samples whose time is missing
_NEIGHBOURS = 0.1  # of the scatter from row to row if in no order: rows so alike go over into each other, as samples do
_SOME_ROWS, _ALIKE = 100, 0.03  # rows of a shorter table, and the same, that are doubted
_NO_TIME = (
    "no time column: each of the {} rows was taken as an attitude at rest; is this a recording with "
    "motion? Then it needs a column time, or a layout with sample_rate"
)


def attitude_table(
    recording: Recording, sensor: str, names: list[str], unit: str, temperature: float | None
) -> Attitudes:
    """Return the rows of a table as attitudes; a row that repeats an earlier one exactly is not measured again.

    Raises
    ------
    SegmentError
        The rows are samples without a time, and no attitudes.
    """
    mean = recording.triad(sensor)
    apart = float((np.diff(mean, axis=0) ** 2).sum() / max(2 * ((mean - mean.mean(axis=0)) ** 2).sum(), 1e-300))
    if len(mean) > _LONG_TABLE and apart < _NEIGHBOURS:
        raise SegmentError(
            f"{recording.name}: {len(mean)} rows without a time that go over into each other: samples of a recording, "
            f"no attitudes; {state_rate(recording.name)}"
        )
    covariance = stated_covariance(recording, names, unit)
    kept = np.sort(np.unique(mean, axis=0, return_index=True)[1])
    row = (kept + recording.first_row).astype(np.float64)
    doubted = len(mean) > _LONG_TABLE or (len(mean) > _SOME_ROWS and apart < _ALIKE)
    notes = [_NO_TIME.format(len(recording))] if doubted else []
    if len(kept) < len(mean):
        again = int(np.setdiff1d(np.arange(len(mean)), kept)[0])
        first = int(np.argmax((mean == mean[again]).all(axis=1)))
        notes.append(
            Finding(
                f"{len(mean) - len(kept)} of {len(mean)} rows are duplicates of earlier ones, such as "
                f"{recording.place(again)} of {recording.place(first)}: they were left out, being no measurements",
                "record these attitudes anew, or take the copies out of the table",
            )
        )
    return Attitudes(
        mean=mean[kept],
        covariance=None if covariance is None else covariance[kept],
        samples=np.ones(len(kept), dtype=np.int64),
        start=row,
        stop=row.copy(),
        unit=unit,
        recording=recording,
        temperature=temperature,
        notes=tuple(notes),
    )


def stated_covariance(recording: Recording, names: list[str], unit: str) -> Array | None:
    """Covariances from the ``std_*`` columns of a table, in the unit of the means, or None."""
    long, short = [f"std_{name}" for name in names], [f"std_{name[-1]}" for name in names]
    stated = short if any(name in recording for name in short) else long
    if not any(name in recording for name in stated):
        return None
    check_finite(recording, stated)
    try:
        factors = [conversion_factor(recording.units[name], unit) for name in stated]
    except UnitError as error:
        raise UnitError(f"{recording.name}: columns {' '.join(stated)}: {error}") from None
    std = np.column_stack([recording.column(name) for name in stated]) * factors
    if not (std > 0).all():
        row, axis = np.argwhere(std <= 0)[0]
        raise SegmentError(
            f"{recording.name}: {recording.place(row)}, column {stated[axis]}: "
            f"expected a positive standard deviation, found {std[row, axis]:g}"
        )
    covariance = np.zeros((len(std), 3, 3))
    covariance[:, range(3), range(3)] = std**2
    return covariance


# Clipped samples: a flat top where an axis reached the end of its range.


_FEWEST_SAMPLES = 5  # equal samples at an end of the range that show a clipped output
_FEWEST_ROWS = 4  # attitudes at one extreme reading that show a clipped output
_USUAL_TIES = 3.0
"""A flat top is held by this many times more samples than values otherwise share (coarse counts share many)."""


def check_clipping(recording: Recording, names: list[str], pieces: NDArray[np.int64]) -> None:
    """Check that no axis is clipped in a stretch at rest.

    The extreme value of an axis is suspect where far more samples hold it exactly than values usually share.

    Parameters
    ----------
    recording, names
        The columns to look at.
    pieces
        Stretches at rest as rows (first sample, last sample + 1, attitude).

    Raises
    ------
    DataError
        The message names column and row.
    """
    for column in names:
        values = recording.column(column)
        smallest, largest = values.min(), values.max()
        if smallest == largest:
            continue  # not clipped but dead, which is for the procedure to say
        for extreme, side in ((largest, "largest"), (smallest, "smallest")):
            ties = values == extreme
            if np.count_nonzero(ties) < _FEWEST_SAMPLES:
                continue
            shares, held = [], []
            for start, stop, _ in pieces:
                count = int(np.count_nonzero(ties[start:stop]))
                if count >= _FEWEST_SAMPLES:
                    held.append((count / (stop - start), start + int(np.argmax(ties[start:stop]))))
                else:
                    shares.append(_largest_share(values[start:stop]))
            usual = median(np.array(shares)) if shares else 0.0
            if held and max(held)[0] > _USUAL_TIES * usual:
                share, first = max(held)
                raise DataError(
                    f"{recording.name}: {recording.place(first)}, column {column}: clipped: {100 * share:.0f} % of the "
                    f"samples of an attitude at rest have exactly the {side} value {extreme:.9g} "
                    f"{recording.units[column]}; expected a range that holds 1 g with its noise"
                )


def check_clipped_rows(recording: Recording, names: list[str]) -> None:
    """Check the rows of a table of attitudes for a value at the end of the range that many of them hold exactly.

    Raises
    ------
    DataError
        The message names column and row.
    """
    for column in names:
        values = recording.column(column)
        if values.min() == values.max():
            continue
        for extreme, side in ((values.max(), "largest"), (values.min(), "smallest")):
            rows = np.flatnonzero(values == extreme)
            others = np.unique(values[values != extreme], return_counts=True)[1]
            if len(rows) >= _FEWEST_ROWS and len(rows) > _USUAL_TIES * others.max():
                raise DataError(
                    f"{recording.name}: {recording.place(int(rows[0]))}, column {column}: clipped: "
                    f"{len(rows)} attitudes have exactly the {side} value {extreme:.9g} {recording.units[column]}"
                )


def _largest_share(values: Array) -> float:
    """Share of the most frequent value among (at most 1000) samples."""
    few = values[:1000]
    return float(np.unique(few, return_counts=True)[1].max() / len(few))


# The samples of the holds: the covariance of each mean, and how the attitudes moved while they were held.


SMALLEST_BLOCK = 4
"""Least number of samples in a block whose scatter is estimated."""
_TREMOR_SECONDS = 0.125
"""A period of a hand's tremor: the magnitudes of shorter blocks rectify it, longer ones hide the motion of the hand."""
_TOGETHER = 1 << 16  # samples of short stretches that are looked at together
_BATCHES = 10
"""Batches per attitude: few, so that they are long against the correlation of the noise, but enough to tell it."""


class HeldStill(Struct, frozen=True):
    """The holds in blocks as long as a hand's tremor, one after the other.

    `columns` hold all samples; `first` is that of each stretch. `start` and `stop` are the stretches in blocks,
    `attitude` says whose each is; `centre` is an attitude's mean.
    """

    columns: tuple[Array, ...]
    first: NDArray[np.int64]
    mean: Array
    scatter: Array
    length: int
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    attitude: NDArray[np.int64]
    centre: Array

    @classmethod
    def of(cls, recording: Recording, names: list[str], stretches: NDArray[np.int64], step: float) -> HeldStill:
        """Return the samples of the `stretches`, rows (first, last + 1, attitude), which are `step` apart, s."""
        begin, end, attitude = np.ascontiguousarray(stretches.T)
        usual = math.ceil(_TREMOR_SECONDS / step - 0.01)
        length = min(max(SMALLEST_BLOCK, usual), int((end - begin).min()) // 2)
        size = (end - begin) // length
        columns = tuple(np.ascontiguousarray(recording.column(name), dtype=np.float64) for name in names)
        stop = np.cumsum(size)
        mean, scatter, unused = np.empty((stop[-1], 3)), np.empty((stop[-1], 3)), np.empty(stop[-1])
        for (x, y, z), _, part in _stretches(columns, begin, stop - size, stop, length):
            _segment.blocks(x, y, z, x, length, mean[part], scatter[part], unused[part])
        first = np.unique(attitude, return_index=True)[1]
        total = np.add.reduceat(size, first)[:, None]
        centre = np.add.reduceat(mean, (stop - size)[first]) / total
        return cls(columns, begin, mean, scatter, length, stop - size, stop, attitude, centre)


def _stretches(
    columns: tuple[Array, ...], first: NDArray[np.int64], start: NDArray[np.int64], stop: NDArray[np.int64], length: int
) -> Iterator[tuple[list[Array], slice, slice]]:
    """Yield the samples of one stretch or of several short ones, and which stretches and which blocks they are.

    Memory of temporary files is given back behind.
    """
    begin = 0
    while begin < len(first):
        end = max(begin + 1, int(np.searchsorted(stop, start[begin] + _TOGETHER // length, side="right")))
        which, blocks = slice(begin, end), slice(int(start[begin]), int(stop[end - 1]))
        ends = first[which] + (stop - start)[which] * length
        parts = [slice(a, b) for a, b in zip(first[which].tolist(), ends.tolist(), strict=True)]
        each = [[column[part] for part in parts] for column in columns]
        yield [np.concatenate(its) if len(its) > 1 else its[0] for its in each], which, blocks
        release(*columns)
        begin = end


def _statistics(held: HeldStill) -> tuple[Array, Array, Array]:
    """Return `Motion.moments` of each attitude, their degrees of freedom, and the share of a batch in all."""
    count = len(held.centre)
    size = held.stop - held.start
    total = np.bincount(held.attitude, size, count)
    per_batch = max(1, min(int(median(total)) // _BATCHES, int(size.min()) // 2))
    first = np.empty(int((size // per_batch).sum()), dtype=np.int64)
    number = np.empty(count, dtype=np.int64)
    scatter: Array = np.empty((count, 9, 9))
    _segment.batches(
        held.mean, held.start, held.stop, held.attitude, held.centre, per_batch,
        first, np.empty((len(first), 9)), number, scatter,
    )  # fmt: skip
    freedom, share = number.astype(np.float64) - 1, np.full(count, float(per_batch)) / total
    moments: Array = scatter * (share / np.maximum(freedom, 1))[:, None, None]
    return moments, freedom, share


def _shrink_covariance(covariance: Array, freedom: Array, share: Array) -> Array:
    """Return the covariance of each mean, shrunk towards the pooled one: a few batches alone give poor weights."""
    scatter = covariance / share[:, None, None]
    level = np.trace(scatter, axis1=1, axis2=2)
    usual = level <= 3 * median(level)
    pooled = np.einsum("n,nij->ij", freedom[usual], scatter[usual]) / max(float(freedom[usual].sum()), 1.0)
    weight = freedom[:, None, None]
    shrunk: Array = (weight * scatter + POOL_DEGREES * pooled) / (weight + POOL_DEGREES)
    return shrunk * share[:, None, None]


def _motion(held: HeldStill, moments: Array, freedom: Array, share: Array) -> Motion:
    """How the attitudes moved: ``D = cov(x_k) - C_w / B + [mean(e e') - C_w / 2B] / 12``, B samples in a block."""
    count, size = len(held.centre), held.stop - held.start
    sums, its = np.zeros((3, count, 3, 3)), np.empty((3, count, 3, 3))
    for (x, y, z), which, part in _stretches(held.columns, held.first, held.start, held.stop, held.length):
        start, stop = held.start[which] - part.start, held.stop[which] - part.start
        _segment.motion(
            x, y, z, held.length, held.mean[part], start, stop, held.attitude[which], held.centre, *its
        )  # fmt: skip
        sums += its
    terms = size * held.length - 1, size, np.maximum(size - 2, 0)
    numbers = np.array([np.bincount(held.attitude, each, count) for each in terms])
    difference, spread, slope = sums / np.maximum(numbers, 1)[:, :, None, None]
    white = difference / (2 * held.length)
    pooled = medians(white, 0)
    each = np.repeat(held.attitude, size)
    within: Array = np.column_stack([np.bincount(each, held.scatter[:, axis], count) for axis in range(3)])
    within = within * held.length / (held.length - 1) / np.bincount(each, minlength=count)[:, None]
    return Motion(
        lengthening=white * (1 + 1 / 24) - spread - slope / 12,
        moments=moments,
        usual=(pooled + (1e-3 * np.trace(pooled) + np.finfo(float).tiny) * np.eye(3)) * share[:, None, None],
        freedom=freedom,
        shake=np.maximum(within - held.length * np.einsum("nii->ni", white), 0.0),
    )


FINEST_STEP = 2.0**-23
"""Step of an output that never changes, relative to the largest: that of a number of 32 bits."""


def covariance_and_motion(
    held: HeldStill, recording: Recording, names: list[str], resolution: Array
) -> tuple[Array, Motion | None]:
    """Return the covariance of each mean, with that of rounding, and the motion in the attitudes."""
    moments, freedom, share = _statistics(held)
    noise = np.sqrt(medians(held.scatter, 0))
    if (noise < resolution / 2).any():
        resolution = resolutions(recording, names)
    resolution = np.where(resolution > 0, resolution, FINEST_STEP * np.abs(held.centre).max(axis=0))
    # Noise below half a step of the output does not average its rounding away.
    rounding = np.where(noise < resolution / 2, resolution**2 / 12, 0.0)
    covariance = _shrink_covariance(moments[:, :3, :3], freedom, share)
    for matrices in (moments, covariance):
        matrices[:, range(3), range(3)] += rounding
    return covariance, _motion(held, moments, freedom, share)


def resolutions(recording: Recording, names: list[str], part: int | None = None) -> Array:
    """Smallest step between the values of each channel, shape (3,), or within the first `part` samples of each.

    0 for a channel of one value, but infinite for a part of one.
    """
    steps = np.full(len(names), 0.0 if part is None else np.inf)
    for axis, name in enumerate(names):
        samples = recording.column(name)
        values = distinct(samples[:: max(1, len(samples) // 100_000)][:part])
        if len(values) > 1:
            steps[axis] = np.diff(values).min()
    return steps


# A continuous recording to static attitudes.


_BLOCK_SECONDS = 0.1  # s over which the scatter of samples is computed
_GAP_SECONDS, _GAP_STEPS = 0.25, 6.0
"""A step in time that is longer than both is a gap; no window reaches across it."""
_LONGEST_BRIDGE = 3  # rows without numbers that a line may stand for
_MUCH_LOST = 0.05  # share of the time that gaps may take without a warning
_THRESHOLDS = np.geomspace(1.5, 400.0, 18)
_DRIFT, _AS_GOOD = 1.0, 1.1
"""Temperature change, K, from which one ellipsoid no longer fits; thresholds whose error is within this factor of the
least then count as equally good."""
_SAME_ATTITUDE = 2e-3
"""Pieces of one hold whose means differ by less than this fraction of g (rad) are one attitude: averaging them
shortens the vector by less than 0.5 ug."""
_TRACE_POINTS = 2000  # of the drawing of the scatter over time
_AT_ONCE = 1 << 20  # samples of which blocks are formed at once
_A_PART = 250  # samples by which the resolution of an output is told


class _Blocks(Struct, frozen=True):
    """Means and mean squared scatters of consecutive blocks of `length` samples, shape (n, 3)."""

    mean: Array
    scatter: Array
    length: int
    duration: float
    broken: NDArray[np.bool_]


class _Pieces(Struct, frozen=True):
    """Static stretches in blocks, half-open, the attitude that each belongs to, and the attitudes' means (n, 3)."""

    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    attitude: NDArray[np.int64]
    mean: Array


def find_attitudes(
    data: Data,
    *,
    sensor: str = "accel",
    window: float = 1.0,
    settling: float = 0.3,
    shortest: float = 1.0,
    **reading: Unpack[Sampling],
) -> Attitudes:
    """Find the static attitudes of a tumble recording, with the covariance of each mean.

    A recording without a time column is a table of attitudes, a row each; it is taken as it is, with the
    covariances that its ``std_<sensor>_<axis>`` columns state.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays with columns ``<sensor>_x``, ``_y``, ``_z``, and ``time`` unless it is a
        table; or the triad alone, shape (n, 3).
    sensor
        Stem of the triad's columns.
    window
        Length of the window whose variance decides on rest, s.
    settling
        Discarded at both ends of each static stretch, s.
    shortest
        Shortest static stretch to use after that, s.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `element`.

    Returns
    -------
    Attitudes
        Means in the unit of the columns.

    Raises
    ------
    DataError
        A sample is not finite or clipped, time does not rise.
    SegmentError
        No static stretch was found.
    UnitError
        The three columns have different units, or none.

    Examples
    --------
    >>> import imulab as il
    >>> il.find_attitudes(il.simulate_tumble(attitudes=24).triad("accel"), rate=100.0, unit="m/s^2")
    Attitudes(24 of arrays, in m/s^2)
    """
    for name, value in (("window", window), ("settling", settling), ("shortest", shortest)):
        if value < 0:
            raise OptionError(f"{name} {value:g} s: expected 0 or more")
    as_read = as_recording(data, reading, find_attitudes, lambda samples: {sensor: samples}, clock=OWN_CLOCKS)
    return attitudes_and_samples(as_read, sensor, window, settling, shortest)[0]


def attitudes_and_samples(
    as_read: Recording, sensor: str, window: float = 1.0, settling: float = 0.3, shortest: float = 1.0
) -> tuple[Attitudes, Recording]:
    """Return the attitudes by `find_attitudes`, and the samples that they are the means of, none without numbers."""
    recording = one_clock(as_read, sensor)
    unit, names = recording.triad_unit(sensor), triad(sensor)
    if not len(recording):
        raise SegmentError(f"{recording.name}: no samples")
    recording, bridges = without_single_gaps(recording, names)
    temperature = recording.mean_temperature()
    if "time" not in recording:
        check_clipped_rows(recording, names)
        attitudes = attitude_table(recording, sensor, names, unit, temperature)
        return replace(attitudes, notes=(*_corrected_notes(recording), *attitudes.notes)), recording
    time, left_out = check_time(recording), leave_out(recording, names)
    original, recording = recording, left_out.recording
    blocks = _form_blocks(recording, names, time, window)
    width = _window_width(blocks, recording, time, window)
    variance = _window_variance(blocks, width)
    quiet, resolution = _quietest(variance, recording, names)
    pieces, threshold = _sweep(variance, quiet, blocks, width, settling, shortest, _drifts(recording))
    trace = _trace(variance, time, blocks, width, threshold, quiet)
    if not pieces.start.size:
        raise SegmentError(f"{recording.name}: no static attitude found: {trace.describe()}")
    stretches = np.column_stack([pieces.start * blocks.length, pieces.stop * blocks.length, pieces.attitude])
    for a, b, _ in stretches.tolist():
        left_out.check(a, b, f"the attitude at {time[a]:.1f} to {time[b - 1]:.1f} s")
    check_clipping(recording, names, stretches)
    held = HeldStill.of(recording, names, stretches, blocks.duration / blocks.length)
    covariance, motion = covariance_and_motion(held, recording, names, resolution)
    first = np.unique(pieces.attitude, return_index=True)[1]
    attitudes = Attitudes(
        mean=pieces.mean,
        covariance=covariance,
        samples=np.bincount(pieces.attitude, pieces.stop - pieces.start).astype(np.int64) * blocks.length,
        start=time[stretches[first, 0]],
        stop=time[stretches[np.append(first[1:], len(stretches)) - 1, 1] - 1],
        unit=unit,
        recording=original,
        temperature=temperature,
        as_read=as_read,
        trace=trace,
        pieces=stretches,
        swing=np.ptp(np.ascontiguousarray(blocks.mean.T), axis=1),
        motion=motion,
        notes=(
            *[*_corrected_notes(recording), *bridges],
            *left_out.notes(_at_rest(stretches, len(time))),
            *_notes(blocks, variance, recording, time),
        ),
    )
    return attitudes, recording


def without_single_gaps(recording: Recording, names: list[str]) -> tuple[Recording, list[str]]:
    """Return a recording in which single rows without numbers are the line through their neighbours, and notes.

    A line over more than a few rows would look like a hold.

    Raises
    ------
    DataError
        More than three rows in a row hold no numbers, or more than 1 % of all, one is infinite, or it is a table of
        attitudes.
    """
    bad = ~np.logical_and.reduce([np.isfinite(recording.column(name)) for name in names])
    if not bad.any():
        return recording, []
    edges = np.flatnonzero(np.diff(bad, prepend=False, append=False))
    infinite = any(np.isinf(recording.column(name)).any() for name in names)
    longest = int((edges[1::2] - edges[::2]).max())
    if "time" not in recording or longest > _LONGEST_BRIDGE or infinite or bad[0] or bad[-1]:
        check_finite(recording, names)
    return bridged(recording, names)


def _quietest(variance: Array, recording: Recording, names: list[str]) -> tuple[float, Array]:
    """Return the variance of the quietest windows, no smaller than that of rounding, and the step of each output."""
    finite = variance[np.isfinite(variance) & (variance > 0)]
    quietest = quantile(finite, 0.05) if finite.size else 0.0
    # No step within a part is smaller than the smallest of all, which costs a sort: often too small to matter already.
    resolution = resolutions(recording, names, _A_PART)
    if float((resolution**2).sum()) / 12 > quietest:
        resolution = resolutions(recording, names)
    return max(quietest, float((resolution**2).sum()) / 12), resolution


def _at_rest(stretches: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """Return which samples belong to an attitude, shape (count,)."""
    rest = np.zeros(count, dtype=np.bool_)
    for start, stop, _ in stretches.tolist():
        rest[start:stop] = True
    return rest


def _corrected_notes(recording: Recording) -> tuple[str, ...]:
    return tuple(
        Finding(
            f"the recording was corrected by {entry.rpartition(' sha256:')[0]}: what is found is what that left; "
            "expected the recording as it was measured",
            "fit the recording as it was measured",
        )
        for entry in recording.corrected_by
    )


def _notes(blocks: _Blocks, variance: Array, recording: Recording, time: Array) -> tuple[str, ...]:
    """Return what is odd about the clock of the recording; the steps that are gaps lie in `blocks.broken`."""
    rate = blocks.length / blocks.duration
    lost = 1 - float(np.isfinite(variance).mean())
    notes = mislabelled(recording, rate, float(time[0]), float(time[-1] - time[0]))
    if blocks.broken.any():
        step = np.diff(time)
        gaps = np.flatnonzero(step > max(_GAP_SECONDS, _GAP_STEPS / rate))
        lost = max(lost, float(step[gaps].sum()) / float(time[-1] - time[0]))
        worst = int(gaps[np.argmax(step[gaps])])
        kind = Finding if lost > _MUCH_LOST else Note
        notes.append(
            kind(
                f"{len(gaps)} gap{'s' * (len(gaps) > 1)} in time, the longest {step[worst]:.3g} s after "
                f"{recording.place(worst)}: an attitude within it is lost",
                "record again without lost samples, by a faster link or at a lower rate",
            )
        )
    return tuple(notes)


def _form_blocks(recording: Recording, names: list[str], time: Array, window: float) -> _Blocks:
    steps = np.diff(time)
    # The mean, not the median: stamps come in bursts, rates change, samples get lost; long pauses are left out.
    release(time)
    step = float(np.mean(steps, where=steps <= quantile(steps, 0.99))) if steps.size else 1.0
    del steps
    seconds = min(_BLOCK_SECONDS, window / 3, len(time) * step)  # no block is longer than the recording
    length = max(SMALLEST_BLOCK, round(seconds / step))
    count = len(time) // length
    mean, scatter, longest = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    columns = [*(recording.column(name) for name in names), time]
    x, y, z, t = (np.ascontiguousarray(column, dtype=np.float64) for column in columns)
    at_once = max(1, _AT_ONCE // length)
    for first in range(0, count, at_once):
        part = slice(first, min(first + at_once, count))
        its = slice(part.start * length, part.stop * length + 1)  # and the sample that the last step leads to
        _segment.blocks(x[its], y[its], z[its], t[its], length, mean[part], scatter[part], longest[part])
        release(*columns)
    return _Blocks(mean, scatter, length, length * step, longest > max(_GAP_SECONDS, _GAP_STEPS * step))


def _window_width(blocks: _Blocks, recording: Recording, time: Array, window: float) -> int:
    """Return the length of the window in blocks; refuse a recording of less than two."""
    width = max(3, round(window / blocks.duration))
    if len(blocks.mean) < 2 * width:
        duration = float(time[-1] - time[0])
        unit = recording.units["time"]
        doubt = doubt_unit_of_time(unit, len(time) / duration, duration, rare=True) if duration else ""
        raise SegmentError(
            f"{recording.name}: {len(recording)} samples over {duration:.3g} s are too few to find static attitudes "
            f"with a window of {window:g} s{f'; {doubt} --unit time=UNIT states it' if doubt else ''}"
        )
    return width


def _window_variance(blocks: _Blocks, width: int) -> Array:
    """Variance of each window of `width` blocks, summed over the axes; infinite across a gap in time."""
    variance = np.empty(len(blocks.mean) - width + 1)
    _segment.windows(blocks.mean, blocks.scatter, blocks.broken, width, variance)
    return variance


def _sweep(
    variance: Array, quiet: float, blocks: _Blocks, width: int, settling: float, shortest: float, drifting: bool
) -> tuple[_Pieces, float]:
    """Return the attitudes that predict each other best, and the threshold of the variance that they lie below."""
    whole = len(blocks.mean) * blocks.duration
    trim = int(np.ceil(min(settling, whole) / blocks.duration))
    fewest = max(2, int(np.ceil(min(shortest, 2 * whole) / blocks.duration)))
    candidates = _candidates(variance, quiet, blocks, width, trim, fewest)
    best = _choose(candidates, drifting=drifting)
    return candidates[best], _THRESHOLDS[best] * quiet


def _candidates(variance: Array, quiet: float, blocks: _Blocks, width: int, trim: int, fewest: int) -> list[_Pieces]:
    """Return the attitudes under each threshold; neighbouring thresholds with the same stretches share one object.

    A window below one threshold is also below every higher one.
    """
    candidates: list[_Pieces] = []
    start, stop = np.empty((2, len(variance)), dtype=np.int64)
    before = None
    for limit in (_THRESHOLDS * quiet).tolist():
        count = _segment.stretches(variance, limit, width, trim, fewest, start, stop)
        edges = start[:count].tobytes(), stop[:count].tobytes()
        candidates.append(
            candidates[-1] if edges == before else _merge(start[:count].copy(), stop[:count].copy(), blocks)
        )
        before = edges
    return candidates


def _merge(start: NDArray[np.int64], stop: NDArray[np.int64], blocks: _Blocks) -> _Pieces:
    """Number the attitudes: neighbouring stretches with the same mean are one attitude that was interrupted."""
    attitude, mean = np.empty(len(start), dtype=np.int64), np.empty((len(start), 3))
    count = _segment.attitudes(blocks.mean, start, stop, _SAME_ATTITUDE, attitude, mean)
    return _Pieces(start, stop, attitude, mean[:count])


def _drifts(recording: Recording) -> bool:
    """Return whether the temperature changes too much for one ellipsoid to fit all outputs at rest."""
    if "temperature" not in recording:
        return False
    column = recording.column("temperature")
    read = column[np.isfinite(column)]
    release(column)
    return bool(read.size and np.ptp(read) > _DRIFT) and quantile(read, 0.95) - quantile(read, 0.05) > _DRIFT


def _choose(candidates: list[_Pieces], *, drifting: bool = False) -> int:
    """Index of the threshold whose attitudes predict each other best, among those that find enough.

    An ellipsoid ``x' Q x + 2 q' x = 1`` is linear in its nine coefficients, so that the error of each attitude
    predicted from all others follows from the hat matrix, ``r / (1 - h)``; half of it is the relative error of the
    radius. Where the temperature drifts, so does the ellipsoid, which is most of every error: of the thresholds that
    are as good, the one is taken whose neighbours change the time at rest least.
    """
    counts = np.array([len(pieces.mean) for pieces in candidates])
    enough = min(int(counts.max()), max(14, int(np.ceil(0.75 * median(counts[counts > 0])))) if counts.any() else 0)
    known: dict[int, float] = {}
    errors = []
    for pieces, count in zip(candidates, counts, strict=True):
        if id(pieces) not in known:
            usable = count >= max(enough, 1)
            known[id(pieces)] = _segment.ellipsoid_error(pieces.mean) if usable else np.inf
        errors.append(known[id(pieces)])
    if np.isfinite(errors).any() and drifting:
        rest = np.log([max(int((pieces.stop - pieces.start).sum()), 1) for pieces in candidates])
        good = np.array(errors) <= _AS_GOOD * np.min(errors)
        return int(np.argmin(np.where(good, np.abs(np.gradient(rest)), np.inf)))
    if np.isfinite(errors).any():
        return int(np.argmin(errors))
    return int(np.argmax(counts))


def _trace(variance: Array, time: Array, blocks: _Blocks, width: int, threshold: float, quiet: float) -> Trace:
    """Decimate the variance trace for the record: the largest value of each group of windows."""
    group = max(1, -(-len(variance) // _TRACE_POINTS))
    usable = variance[: len(variance) // group * group].reshape(-1, group)
    largest = np.where(np.isfinite(usable), usable, 0.0).max(axis=1)
    middle = (np.arange(len(largest)) * group * blocks.length + width * blocks.length // 2).clip(max=len(time) - 1)
    return Trace(time=time[middle], variance=largest, threshold=float(threshold), quiet=quiet)


# Attitudes from what people have: a file, a recording, a data frame, arrays, or means with their covariances.


TumbleData: TypeAlias = Attitudes | Data
_SYMMETRIC = 1e-9  # relative rounding of a covariance read from decimals


def as_attitudes(
    data: TumbleData,
    reading: Mapping[str, Any] | Reading | Sampling,
    function: Callable[..., Any],
    covariance: ArrayLike | None = None,
) -> Attitudes:
    """Return data as static attitudes.

    Parameters
    ----------
    data
        Attitudes; or data, in which they are found; without a time each row is one.
    reading
        How data are to be understood.
    function
        What was called with them, for messages.
    covariance
        Of the means, in the squared unit of the outputs, shape (3, 3) for all or (n, 3, 3), where rows are attitudes.

    Raises
    ------
    DataError
        The covariances are none, or of something else; and what `as_recording` and `find_attitudes` raise.
    OptionError
        They are given twice, or for a recording with time, which says itself what they are.
    """
    called = function.__name__
    if isinstance(data, Attitudes):
        for key, value in reading.items():
            if value is not None:
                raise OptionError(f"{called}: {key} does not go with attitudes, which were found already")
        attitudes = data
    else:
        attitudes = find_attitudes(as_recording(data, reading, function, clock=OWN_CLOCKS))
    if covariance is None:
        return attitudes
    if attitudes.covariance is not None:
        why = "std_* columns state it" if attitudes.trace is None else "the recording itself says how certain they are"
        raise OptionError(f"{called}: covariance: {why}; expected means of attitudes without")
    return replace(attitudes, covariance=_check_covariance(covariance, len(attitudes), called))


def _check_covariance(covariance: ArrayLike, count: int, called: str) -> Array:
    """Return covariances of shape (n, 3, 3)."""
    try:
        values = np.asarray(covariance, dtype=np.float64)
    except (TypeError, ValueError):
        raise DataError(f"{called}: covariance: expected numbers") from None
    if values.shape not in ((3, 3), (count, 3, 3)):
        raise DataError(f"{called}: covariance: expected the shape (3, 3) or ({count}, 3, 3), found {values.shape}")
    matrices = np.array(np.broadcast_to(values, (count, 3, 3)))
    largest = np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None, None]
    if not np.isfinite(matrices).all() or (np.abs(matrices - matrices.swapaxes(1, 2)) > _SYMMETRIC * largest).any():
        raise DataError(f"{called}: covariance: expected symmetric matrices of finite numbers")
    if (np.linalg.eigvalsh(matrices) <= 0).any():
        raise DataError(f"{called}: covariance: expected positive definite matrices")
    return matrices
