"""A continuous recording to static attitudes.

The recording is cut into short blocks whose means and scatters are formed once; windows of a second or so slide over
the blocks. A window is quiet where its variance stays below a threshold relative to the quietest stretch. The
threshold is swept, and the one is kept whose attitudes predict each other best: the outputs of a triad at rest lie on
an ellipsoid, whose leave-one-out error needs no gravity, no model order and no iteration.

Source: Tedaldi, Pretto, Menegatti, ICRA 2014 (threshold sweep); batch means: Fishman, Grouping observations in
digital simulation, Management Science 24 (1978) 510.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.errors import SegmentError, UnitError
from imulab.estimation.rows import leave_out
from imulab.procedures.tumble import _segment
from imulab.procedures.tumble.attitudes import POOL_DEGREES, Attitudes, Motion, Trace
from imulab.procedures.tumble.clipping import check_clipped_rows, check_clipping
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.units import conversion_factor

_BLOCK_SECONDS = 0.1
_TREMOR_SECONDS = 0.125
"""A period of a hand's tremor: the magnitudes of shorter blocks rectify it, longer ones hide the motion of the hand."""
_SMALLEST_BLOCK = 4
_GAP_SECONDS, _GAP_STEPS = 0.25, 6.0
"""A step in time that is longer than both is a gap; no window reaches across it."""
_SLOW = 5.0
_MUCH_LOST = 0.05
_LONG_TABLE = 1000
_NO_TIME = (
    "no time column: each of the {} rows was taken as an attitude at rest; is this a recording with "
    "motion? Then it needs a column time, or a layout with sample_rate"
)
_BATCHES = 10
"""Batches per attitude: few, so that they are long against the correlation of the noise, but enough to tell it."""
_THRESHOLDS = np.geomspace(1.5, 400.0, 18)
_SAME_ATTITUDE = 2e-3
"""Pieces of one hold whose means differ by less than this fraction of g (rad) are one attitude: averaging them
shortens the vector by less than 0.5 ug."""
_TRACE_POINTS = 2000
_A_PART = 2000


@dataclass(frozen=True)
class _Blocks:
    """Means and mean squared scatters of consecutive blocks of `length` samples, shape (n, 3)."""

    mean: Array
    scatter: Array
    length: int
    duration: float
    broken: NDArray[np.bool_]


@dataclass(frozen=True)
class _Pieces:
    """Static stretches in blocks, half-open, the attitude that each belongs to, and the attitudes' means (n, 3)."""

    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    attitude: NDArray[np.int64]
    mean: Array


def find_attitudes(
    recording: Recording,
    *,
    sensor: str = "accel",
    window: float = 1.0,
    settling: float = 0.3,
    shortest: float = 1.0,
) -> Attitudes:
    """Find the static attitudes of a tumble recording, with the covariance of each mean.

    A recording without a time column is a table of attitudes, a row each; it is taken as it is, with the
    covariances that its ``std_<sensor>_<axis>`` columns state.

    Parameters
    ----------
    recording
        Columns ``<sensor>_x``, ``_y``, ``_z``, and ``time`` unless it is a table.
    sensor
        Stem of the triad's columns.
    window
        Length of the window whose variance decides on rest, s.
    settling
        Discarded at both ends of each static stretch, s.
    shortest
        Shortest static stretch to use after that, s.

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
        The three columns have different units.
    """
    unit = recording.triad_unit(sensor)
    names = [f"{sensor}_{axis}" for axis in "xyz"]
    if not len(recording):
        raise SegmentError(f"{recording.name}: no samples")
    check_finite(recording, names)
    temperature = recording.mean_temperature()
    if "time" not in recording:
        check_clipped_rows(recording, names)
        return _table(recording, sensor, names, unit, temperature)
    time = check_time(recording)
    left_out = leave_out(recording, names)
    given, recording = recording, left_out.recording
    blocks = _form_blocks(recording, names, time, window)
    width = max(3, round(window / blocks.duration))
    if len(blocks.mean) < 2 * width:
        raise SegmentError(
            f"{recording.name}: {len(recording)} samples over {time[-1] - time[0]:.3g} s are too few to find static "
            f"attitudes with a window of {window:g} s"
        )
    variance = _window_variance(blocks, width)
    quiet, resolution = _quietest(variance, recording, names)
    whole = len(blocks.mean) * blocks.duration
    trim = int(np.ceil(min(settling, whole) / blocks.duration))
    fewest = max(2, int(np.ceil(min(shortest, 2 * whole) / blocks.duration)))
    candidates = _candidates(variance, quiet, blocks, width, trim, fewest)
    best = _choose(candidates)
    trace = _trace(variance, time, blocks, width, _THRESHOLDS[best] * quiet, quiet)
    pieces = candidates[best]
    if not pieces.start.size:
        raise SegmentError(f"{recording.name}: no static attitude found: {trace.describe()}")
    stretches = np.column_stack([pieces.start * blocks.length, pieces.stop * blocks.length, pieces.attitude])
    for a, b, _ in stretches.tolist():
        left_out.check(a, b, f"the attitude at {time[a]:.1f} to {time[b - 1]:.1f} s")
    check_clipping(recording, names, stretches)
    held = _Held.of(recording, names, pieces, blocks)
    covariance, motion = _covariance_and_motion(held, recording, names, resolution)
    first = np.unique(pieces.attitude, return_index=True)[1]
    last = np.append(first[1:], len(pieces.start)) - 1
    return Attitudes(
        mean=pieces.mean,
        covariance=covariance,
        samples=np.bincount(pieces.attitude, pieces.stop - pieces.start).astype(np.int64) * blocks.length,
        start=time[pieces.start[first] * blocks.length],
        stop=time[pieces.stop[last] * blocks.length - 1],
        unit=unit,
        recording=given,
        temperature=temperature,
        trace=trace,
        pieces=stretches,
        swing=np.ptp(blocks.mean, axis=0),
        motion=motion,
        notes=(
            *_corrected_notes(recording),
            *left_out.notes(_at_rest(stretches, len(time))),
            *_notes(blocks, variance),
        ),
    )


def _quietest(variance: Array, recording: Recording, names: list[str]) -> tuple[float, Array]:
    """Return the variance of the quietest windows, no smaller than that of rounding, and the step of each output."""
    finite = variance[np.isfinite(variance) & (variance > 0)]
    quietest = float(np.quantile(finite, 0.05)) if finite.size else 0.0
    # No step within a part is smaller than the smallest of all, which costs a sort: often too small to matter already.
    resolution = _resolutions(recording, names, _A_PART)
    if float((resolution**2).sum()) / 12 > quietest:
        resolution = _resolutions(recording, names)
    return max(quietest, float((resolution**2).sum()) / 12), resolution


def _covariance_and_motion(
    held: _Held, recording: Recording, names: list[str], resolution: Array
) -> tuple[Array, Motion | None]:
    """Return the covariance of each mean, with that of rounding, and the motion in the attitudes."""
    moments, freedom, share = _statistics(held)
    noise = np.sqrt(np.median(held.scatter, axis=0))
    if (noise < resolution / 2).any():
        resolution = _resolutions(recording, names)
    # Noise below half a step of the output does not average its rounding away.
    rounding = np.where(noise < resolution / 2, resolution**2 / 12, 0.0)
    covariance = _pooled(moments[:, :3, :3], freedom, share)
    for matrices in (moments, covariance):
        matrices[:, range(3), range(3)] += rounding
    return covariance, _motion(held, moments, freedom, share)


def _table(recording: Recording, sensor: str, names: list[str], unit: str, temperature: float | None) -> Attitudes:
    """Return the rows of a table as attitudes; a row that repeats an earlier one exactly is not measured again."""
    mean, covariance = recording.triad(sensor), _stated_covariance(recording, names, unit)
    kept = np.sort(np.unique(mean, axis=0, return_index=True)[1])
    row = (kept + recording.first_row).astype(np.float64)
    notes = [_NO_TIME.format(len(recording))] if len(recording) > _LONG_TABLE else []
    if len(kept) < len(mean):
        again = int(np.setdiff1d(np.arange(len(mean)), kept)[0])
        first = int(np.argmax((mean == mean[again]).all(axis=1)))
        notes.append(
            f"{len(mean) - len(kept)} of {len(mean)} rows are duplicates of earlier ones, such as "
            f"{recording.place(again)} of {recording.place(first)}: they were left out, being no measurements"
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
        notes=(*_corrected_notes(recording), *notes),
    )


def _at_rest(stretches: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """Return which samples belong to an attitude, shape (count,)."""
    rest = np.zeros(count, dtype=np.bool_)
    for start, stop, _ in stretches.tolist():
        rest[start:stop] = True
    return rest


def _corrected_notes(recording: Recording) -> tuple[str, ...]:
    return tuple(
        f"the recording was corrected by {entry.rpartition(' sha256:')[0]}: what is found is what that left; expected "
        "the recording as it was measured"
        for entry in recording.corrected_by
    )


def _notes(blocks: _Blocks, variance: Array) -> tuple[str, ...]:
    """What is odd about the clock of the recording."""
    rate = blocks.length / blocks.duration
    lost = 1 - float(np.isfinite(variance).mean())
    notes = []
    if rate < _SLOW:
        notes.append(f"about {rate:.3g} samples per second: is the unit of time right?")
    if lost > _MUCH_LOST:
        notes.append(f"gaps in time: {100 * lost:.0f} % of the windows reach across one and were not used")
    return tuple(notes)


def _stated_covariance(recording: Recording, names: list[str], unit: str) -> Array | None:
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


def _form_blocks(recording: Recording, names: list[str], time: Array, window: float) -> _Blocks:
    steps = np.diff(time)
    # The mean, not the median: stamps come in bursts, rates change, samples get lost; long pauses are left out.
    usual = steps[steps <= np.quantile(steps, 0.99)] if steps.size else np.ones(1)
    step = float(usual.mean())
    seconds = min(_BLOCK_SECONDS, window / 3, len(time) * step)  # no block is longer than the recording
    length = max(_SMALLEST_BLOCK, round(seconds / step))
    count = len(time) // length
    mean, scatter, longest = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    x, y, z = (np.ascontiguousarray(recording.column(name), dtype=np.float64) for name in names)
    _segment.blocks(x, y, z, np.ascontiguousarray(time), length, mean, scatter, longest)
    return _Blocks(mean, scatter, length, length * step, longest > max(_GAP_SECONDS, _GAP_STEPS * step))


def _window_variance(blocks: _Blocks, width: int) -> Array:
    """Variance of each window of `width` blocks, summed over the axes; infinite across a gap in time."""
    variance = np.empty(len(blocks.mean) - width + 1)
    _segment.windows(blocks.mean, blocks.scatter, blocks.broken, width, variance)
    return variance


def _candidates(variance: Array, quiet: float, blocks: _Blocks, width: int, trim: int, fewest: int) -> list[_Pieces]:
    """Return the attitudes under each threshold; the same object where two thresholds find the same stretches.

    Those are neighbours: what is quiet under one threshold is so under the next.
    """
    candidates: list[_Pieces] = []
    start, stop = np.empty((2, len(variance)), dtype=np.int64)
    before = None
    for limit in (_THRESHOLDS * quiet).tolist():
        count = _segment.stretches(variance, limit, width, trim, fewest, start, stop)
        found = start[:count].tobytes(), stop[:count].tobytes()
        candidates.append(
            candidates[-1] if found == before else _merge(start[:count].copy(), stop[:count].copy(), blocks)
        )
        before = found
    return candidates


def _merge(start: NDArray[np.int64], stop: NDArray[np.int64], blocks: _Blocks) -> _Pieces:
    """Number the attitudes: neighbouring stretches with the same mean are one attitude that was interrupted."""
    attitude, mean = np.empty(len(start), dtype=np.int64), np.empty((len(start), 3))
    count = _segment.attitudes(blocks.mean, start, stop, _SAME_ATTITUDE, attitude, mean)
    return _Pieces(start, stop, attitude, mean[:count])


def _choose(candidates: list[_Pieces]) -> int:
    """Index of the threshold whose attitudes predict each other best, among those that find enough.

    An ellipsoid ``x' Q x + 2 q' x = 1`` is linear in its nine coefficients, so that the error of each attitude
    predicted from all others follows from the hat matrix, ``r / (1 - h)``; half of it is the relative error of the
    radius.
    """
    counts = np.array([len(pieces.mean) for pieces in candidates])
    enough = min(int(counts.max()), max(14, int(np.ceil(0.75 * np.median(counts[counts > 0])))) if counts.any() else 0)
    known: dict[int, float] = {}
    errors = []
    for pieces, count in zip(candidates, counts, strict=True):
        if id(pieces) not in known:
            usable = count >= max(enough, 1)
            known[id(pieces)] = _segment.ellipsoid_error(pieces.mean) if usable else np.inf
        errors.append(known[id(pieces)])
    if np.isfinite(errors).any():
        return int(np.argmin(errors))
    return int(np.argmax(counts))


@dataclass(frozen=True)
class _Held:
    """The samples of all holds, one after the other, in blocks as long as a hand's tremor.

    `start` and `stop` are the stretches in blocks, `attitude` says whose each is; `centre` is an attitude's mean.
    """

    samples: tuple[Array, Array, Array]
    mean: Array
    scatter: Array
    length: int
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    attitude: NDArray[np.int64]
    centre: Array

    @classmethod
    def of(cls, recording: Recording, names: list[str], pieces: _Pieces, blocks: _Blocks) -> _Held:
        begin, end = pieces.start * blocks.length, pieces.stop * blocks.length
        usual = math.ceil(_TREMOR_SECONDS / blocks.duration * blocks.length - 0.01)
        length = min(max(_SMALLEST_BLOCK, usual), int((end - begin).min()) // 2)
        size = (end - begin) // length
        index = np.concatenate([np.arange(a, a + n * length) for a, n in zip(begin, size, strict=True)])
        x, y, z = (np.ascontiguousarray(recording.column(name)[index], dtype=np.float64) for name in names)
        stop = np.cumsum(size)
        mean, scatter, unused = np.empty((stop[-1], 3)), np.empty((stop[-1], 3)), np.empty(stop[-1])
        _segment.blocks(x, y, z, x, length, mean, scatter, unused)
        first = np.unique(pieces.attitude, return_index=True)[1]
        total = np.add.reduceat(size, first)[:, None]
        centre = np.add.reduceat(mean, (stop - size)[first]) / total
        return cls((x, y, z), mean, scatter, length, stop - size, stop, pieces.attitude, centre)


def _statistics(held: _Held) -> tuple[Array, Array, Array]:
    """Return `Motion.moments` of each attitude, their degrees of freedom, and the share of a batch in all."""
    count = len(held.centre)
    size = held.stop - held.start
    total = np.bincount(held.attitude, size, count)
    per_batch = max(1, min(int(np.median(total)) // _BATCHES, int(size.min()) // 2))
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


def _pooled(covariance: Array, freedom: Array, share: Array) -> Array:
    """Covariance of each mean, shrunk towards the noise common to all: a few batches alone make poor weights."""
    scatter = covariance / share[:, None, None]
    level = np.trace(scatter, axis1=1, axis2=2)
    usual = level <= 3 * np.median(level)
    pooled = np.einsum("n,nij->ij", freedom[usual], scatter[usual]) / max(float(freedom[usual].sum()), 1.0)
    own = freedom[:, None, None]
    shrunk: Array = (own * scatter + POOL_DEGREES * pooled) / (own + POOL_DEGREES)
    return shrunk * share[:, None, None]


def _motion(held: _Held, moments: Array, freedom: Array, share: Array) -> Motion:
    """How the attitudes moved: ``D = cov(x_k) - C_w / B + [mean(e e') - C_w / 2B] / 12``, B samples in a block."""
    count, size = len(held.centre), held.stop - held.start
    sums = np.empty((3, count, 3, 3))
    _segment.motion(
        *held.samples, held.length, held.mean, held.start, held.stop, held.attitude, held.centre, *sums
    )  # fmt: skip
    terms = size * held.length - 1, size, np.maximum(size - 2, 0)
    numbers = np.array([np.bincount(held.attitude, each, count) for each in terms])
    difference, spread, slope = sums / np.maximum(numbers, 1)[:, :, None, None]
    white = difference / (2 * held.length)
    pooled = np.median(white, axis=0)
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


def _resolutions(recording: Recording, names: list[str], part: int | None = None) -> Array:
    """Smallest step between the values of each channel, shape (3,), or within the first `part` samples of each.

    0 for a channel of one value, but infinite for a part of one.
    """
    found = np.full(len(names), 0.0 if part is None else np.inf)
    for axis, name in enumerate(names):
        samples = recording.column(name)
        values = np.unique(samples[:: max(1, len(samples) // 100_000)][:part])
        if len(values) > 1:
            found[axis] = np.diff(values).min()
    return found


def _trace(variance: Array, time: Array, blocks: _Blocks, width: int, threshold: float, quiet: float) -> Trace:
    """Decimate the variance trace for the record: the largest value of each group of windows."""
    group = max(1, -(-len(variance) // _TRACE_POINTS))
    usable = variance[: len(variance) // group * group].reshape(-1, group)
    largest = np.where(np.isfinite(usable), usable, 0.0).max(axis=1)
    middle = (np.arange(len(largest)) * group * blocks.length + width * blocks.length // 2).clip(max=len(time) - 1)
    return Trace(time=time[middle], variance=largest, threshold=float(threshold), quiet=quiet)
