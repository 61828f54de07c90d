"""A continuous recording to static attitudes.

The recording is cut into short blocks whose means and scatters are formed once; windows of a second or so slide over
the blocks. A window is quiet where its variance stays below a threshold relative to the quietest stretch. The
threshold is swept, and the one is kept whose attitudes predict each other best: the outputs of a triad at rest lie on
an ellipsoid, whose leave-one-out error needs no gravity, no model order and no iteration.

Source: Tedaldi, Pretto, Menegatti, ICRA 2014 (threshold sweep).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

import imulab.procedures.tumble._segment as _segment
from imulab.columns import triad
from imulab.errors import OptionError, SegmentError
from imulab.estimation.ranked import median, quantile
from imulab.estimation.rows import leave_out
from imulab.procedures.inputs import as_recording
from imulab.procedures.tumble.attitude_table import attitude_table
from imulab.procedures.tumble.attitudes import Attitudes, Trace
from imulab.procedures.tumble.clipping import check_clipped_rows, check_clipping
from imulab.procedures.tumble.held import SMALLEST_BLOCK, Held, covariance_and_motion, resolutions
from imulab.reading import Data, Sampling
from imulab.recording import Array, Recording, check_finite, check_time

_BLOCK_SECONDS = 0.1
_GAP_SECONDS, _GAP_STEPS = 0.25, 6.0
"""A step in time that is longer than both is a gap; no window reaches across it."""
_SLOW = 5.0
_MUCH_LOST = 0.05
_THRESHOLDS = np.geomspace(1.5, 400.0, 18)
_DRIFT, _AS_GOOD = 1.0, 1.1
"""K by which the temperature moves where the ellipsoid moves with it, and the share of the least error that then tells
thresholds apart no more."""
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
    recording = as_recording(data, reading, find_attitudes, lambda samples: {sensor: samples})
    unit = recording.triad_unit(sensor)
    names = triad(sensor)
    if not len(recording):
        raise SegmentError(f"{recording.name}: no samples")
    check_finite(recording, names)
    temperature = recording.mean_temperature()
    if "time" not in recording:
        check_clipped_rows(recording, names)
        found = attitude_table(recording, sensor, names, unit, temperature)
        return replace(found, notes=(*_corrected_notes(recording), *found.notes))
    time = check_time(recording)
    left_out = leave_out(recording, names)
    given, recording = recording, left_out.recording
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
    held = Held.of(recording, names, stretches, blocks.duration / blocks.length)
    covariance, motion = covariance_and_motion(held, recording, names, resolution)
    first = np.unique(pieces.attitude, return_index=True)[1]
    return Attitudes(
        mean=pieces.mean,
        covariance=covariance,
        samples=np.bincount(pieces.attitude, pieces.stop - pieces.start).astype(np.int64) * blocks.length,
        start=time[stretches[first, 0]],
        stop=time[stretches[np.append(first[1:], len(stretches)) - 1, 1] - 1],
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


def _form_blocks(recording: Recording, names: list[str], time: Array, window: float) -> _Blocks:
    steps = np.diff(time)
    # The mean, not the median: stamps come in bursts, rates change, samples get lost; long pauses are left out.
    usual = steps[steps <= quantile(steps, 0.99)] if steps.size else np.ones(1)
    step = float(usual.mean())
    seconds = min(_BLOCK_SECONDS, window / 3, len(time) * step)  # no block is longer than the recording
    length = max(SMALLEST_BLOCK, round(seconds / step))
    count = len(time) // length
    mean, scatter, longest = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    x, y, z = (np.ascontiguousarray(recording.column(name), dtype=np.float64) for name in names)
    _segment.blocks(x, y, z, np.ascontiguousarray(time), length, mean, scatter, longest)
    return _Blocks(mean, scatter, length, length * step, longest > max(_GAP_SECONDS, _GAP_STEPS * step))


def _window_width(blocks: _Blocks, recording: Recording, time: Array, window: float) -> int:
    """Return the length of the window in blocks; refuse a recording of less than two."""
    width = max(3, round(window / blocks.duration))
    if len(blocks.mean) < 2 * width:
        raise SegmentError(
            f"{recording.name}: {len(recording)} samples over {time[-1] - time[0]:.3g} s are too few to find static "
            f"attitudes with a window of {window:g} s"
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


def _drifts(recording: Recording) -> bool:
    """Return whether the temperature moves so much that the outputs at rest lie on no one ellipsoid."""
    if "temperature" not in recording:
        return False
    read = recording.column("temperature")
    read = read[np.isfinite(read)]
    return bool(read.size) and quantile(read, 0.95) - quantile(read, 0.05) > _DRIFT


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
