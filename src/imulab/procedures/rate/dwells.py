"""The dwells of a rate test: stretches in which the table turns at one rate, and the mean of each gyroscope over it.

A run whose rate changes all the time has none; means by rate of its sweep take their place (`sweeps`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from imulab.errors import DataError, SegmentError
from imulab.procedures.rate import AXES
from imulab.procedures.rate.schema import RateTest
from imulab.procedures.rate.sweeps import Sweep, is_smooth, rate_of_angle, reduce_sweep
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.report.parameters import text_in
from imulab.units import from_si, parse_unit, to_si

# The dwells of a run: stretches in which the table turned at one rate, each with the gyroscopes' mean over it.


_BLOCK, _SIDE, _SETTLING, _LEAST = 0.1, 5, 3, 10
"""Length of a block, s; blocks compared on either side, left out at either end, and in the shortest dwell."""
_SIGMAS, _OF_STEP, _OF_COLUMN, _RIPPLE = 6.0, 1 / 20, 2e-5, 2e-3
"""A change counts from so many sigma of the noise, plus this share of the smallest listed step (or of the largest
recorded rate), plus this share of the rate itself."""
_BATCHES = 8  # parts of a dwell by whose scatter its mean is known
_FEWEST_LEVELS, _OF_RANGE, _SWEEP, _FLAT = 3, 0.02, 500, 0.03
"""Fewest rates of steps; share of the range that a step keeps to; fewest samples of a sweep; share of the range that a
sweep passes at one output where that is saturated."""
_NEXT_TO = 0.3  # of the gap between listed rates: a dwell that is nearer to one belongs to it
_ALIKE, _OUT = 5e-3, 5.0
"""Visits of one rate differ at most by this share of the largest rate, or so many times their median difference."""
_STANDS, _TIES, _MORE = 0.2, 0.2, 3.0
"""A dwell is saturated that scatters by less than this share of what is usual; or of whose samples more than this share
is at one limit, and more than on the step beside it by so many standard deviations."""
_WRONG = 0.5  # of the largest span: where the axis that the manifest names spans less, another was turned
_ROUNDING = 1e-9  # of the largest reading: smaller scatter is rounding
_ROBUST = 0.6745 * np.sqrt(2)  # median of the absolute difference of two normal values, over their sigma


@dataclass(frozen=True)
class Dwells:
    """The n dwells of one run of g gyroscopes; SI except for the outputs.

    Attributes
    ----------
    start, stop
        Times, s, shape (n,).
    rate
        Rate of the table, rad/s, shape (n,).
    mean, variance
        Mean outputs, and variances of these means by batches, shape (n, g).
    level
        Mean cosine and sine of the table's angle, shape (n, 2).
    recorded
        Whether the rates are those of a column of the recording.
    sweep
        For a run whose rate changed all the time: delay and bandwidth of the gyroscope along the table axis; the dwells
        are then means by rate, rising ones first. Else None.
    """

    start: Array
    stop: Array
    rate: Array
    mean: Array
    variance: Array
    level: Array
    recorded: bool
    sweep: Sweep | None = None


def gyro_columns(recording: Recording) -> list[str]:
    """Return the gyroscopes that a recording has, in the order of the axes."""
    return [name for axis in AXES if (name := f"gyro_{axis}") in recording]


def find_dwells(recording: Recording, test: RateTest, index: int) -> Dwells:
    """Return the dwells of run `index` of a test, found in its recording.

    Raises
    ------
    SegmentError
        There are none, or they cannot be at the rates that the manifest lists.
    DataError
        The gyroscope along the table axis does not follow the table, or its output stands still at an end.
    """
    run, place = test.runs[index], test.place(index)
    names = gyro_columns(recording)
    main = f"gyro_{AXES[run.axis]}"
    recording.column(main)
    check_finite(recording, names)
    time = check_time(recording)
    outputs = [recording.column(name) for name in names]
    output = outputs[names.index(main)] if run.sign > 0 else -outputs[names.index(main)]
    column = recorded_rate(recording, time)
    if column is None and run.rates is None:
        raise SegmentError(
            f"{place}: no column table_rate or table_angle; expected the table's rates (rates = [0, 10, -10] in the "
            'manifest, --rates for one recording; in Python rates="0,10,-10")'
        )
    recorded = column is not None
    signal = output if column is None else column
    size = _block_size(time)
    blocks = _block_means(signal, size)
    stretches = _find_stretches(blocks, size, None if recorded else _smallest_step(run.rates or (), output))
    if run.sweep and column is None:
        raise SegmentError(
            f"{place}: a sweep needs the table's rate at every sample: expected table_rate or table_angle"
        )
    if column is not None and (
        run.sweep or (_count_levels(blocks, stretches, size) < _FEWEST_LEVELS and is_smooth(column, blocks))
    ):
        return _reduce_swept_run(recording, time, column, outputs, names, main, place)
    if len(stretches) < 3:
        raise SegmentError(
            f"{place}: stretches of a steady rate: {len(stretches)}, expected 3 or more of 2 s or longer: are the "
            "steps too short, or does the rate never change?"
        )
    mean = np.array([[values[a:b].mean() for values in outputs] for a, b in stretches])
    reading = mean[:, names.index(main)] * run.sign
    _check_ends(recording, main, output, stretches, reading, place)
    _check_axis(names, mean, main, place)
    if column is None:
        rate, zero, scale = _assign_listed_rates(reading, stretches, time, run.rates or (), recording, main, place)
        blocks = (blocks - zero) / scale
    else:
        rate = np.array([column[a:b].mean() for a, b in stretches])
    cosine, sine = _mean_cosine_and_sine(time, blocks, size)
    return Dwells(
        start=np.array([time[a] for a, _ in stretches]),
        stop=np.array([time[b - 1] for _, b in stretches]),
        rate=rate,
        mean=mean,
        variance=np.array([[_variance_by_batches(values[a:b]) for values in outputs] for a, b in stretches]),
        level=np.array([[part[a // size : b // size].mean() for part in (cosine, sine)] for a, b in stretches]),
        recorded=recorded,
    )


def _count_levels(blocks: Array, stretches: list[tuple[int, int]], size: int) -> int:
    """Return the number of different rates at which a run rests; a slow sine has two, at its ends."""
    within = _OF_RANGE * float(np.ptp(blocks))
    parts = [blocks[a // size : b // size] for a, b in stretches]
    rests = np.sort([part.mean() for part in parts if np.ptp(part) < within])
    return int(np.sum(np.diff(rests, prepend=-np.inf) > within))


def _reduce_swept_run(
    recording: Recording, time: Array, rate: Array, outputs: list[Array], names: list[str], main: str, place: str
) -> Dwells:
    """Return the means by rate of a run whose rate changed all the time."""
    if np.ptp(rate) <= 0 or len(time) < _SWEEP:
        raise SegmentError(f"{place}: {len(time)} samples of a rate that does not change; expected a sweep, or steps")
    main_column = names.index(main)
    sweep, reduced = reduce_sweep(time, rate, outputs, main_column)
    _check_axis(names, reduced.mean, main, place)
    for end in (float(outputs[main_column].max()), float(outputs[main_column].min())):
        still = outputs[main_column] == end
        if still.sum() >= _LEAST and np.ptp(rate[still]) > _FLAT * np.ptp(rate):
            raise DataError(
                f"{place}: {main} stands still at {end:.6g} {recording.units[main]} while the rate changes: its output "
                "is saturated; expected rates within its range"
            )
    half, size = reduced.duration / 2, _block_size(time)
    level = [part.mean() for part in _mean_cosine_and_sine(time, _block_means(rate, size), size)]
    return Dwells(
        start=reduced.middle - half,
        stop=reduced.middle + half,
        rate=reduced.rate,
        mean=reduced.mean,
        variance=reduced.variance,
        level=np.tile(level, (len(reduced.rate), 1)),
        recorded=True,
        sweep=sweep,
    )


def recorded_rate(recording: Recording, time: Array) -> Array | None:
    """Return the rate of the table that a recording holds, rad/s, shape (n,)."""
    for name, quantity in (("table_rate", "rate"), ("table_angle", "angle")):
        if name not in recording:
            continue
        check_finite(recording, [name])
        if parse_unit(recording.units[name]).quantity != quantity:
            raise DataError(f"{recording.name}: column {name}: expected a unit of {quantity}")
        values = recording.si(name)
        return values if quantity == "rate" else rate_of_angle(np.unwrap(values), time)
    return None


def _smallest_step(rates: tuple[float, ...], output: Array) -> float:
    """Return the smallest step between listed rates, in units of the output."""
    listed = np.unique(rates)
    return float(np.diff(listed).min() / (listed[-1] - listed[0]) * np.ptp(output))


def _block_size(time: Array) -> int:
    """Return the number of samples in 0.1 s, by the median step of 10,000 samples over the recording."""
    which = np.linspace(0, len(time) - 2, min(len(time) - 1, 10_000)).astype(np.int64)
    return max(1, round(_BLOCK / float(np.median(time[which + 1] - time[which])))) if len(time) > 1 else 1


def _block_means(signal: Array, size: int) -> Array:
    count = len(signal) // size
    return np.asarray(signal[: count * size].reshape(count, size).mean(axis=1))


def _mean_cosine_and_sine(time: Array, rate: Array, size: int) -> tuple[Array, Array]:
    """Return the mean cosine and sine of the table's angle over each block, taken as turning evenly, shape (n,)."""
    edges = time[: (len(rate) + 1) * size : size]
    step = rate * np.diff(edges, append=time[-1])[: len(rate)]
    middle, part = np.cumsum(step) - step / 2, np.sinc(step / (2 * np.pi))
    return np.cos(middle) * part, np.sin(middle) * part


def _find_stretches(blocks: Array, size: int, step: float | None) -> list[tuple[int, int]]:
    """Return first sample and end of each stretch in which the means of 0.5 s do not change."""
    count = len(blocks)
    if count < 2 * _SIDE + 1:
        return []
    sigma = float(np.median(np.abs(np.diff(blocks)))) / _ROBUST
    least = _OF_COLUMN * float(np.abs(blocks).max()) if step is None else _OF_STEP * step
    sums = np.concatenate([[0.0], np.cumsum(blocks)])
    k = np.arange(_SIDE, count - _SIDE + 1)
    change = np.abs(sums[k + _SIDE] - 2 * sums[k] + sums[k - _SIDE]) / _SIDE
    limit = _SIGMAS * sigma * np.sqrt(2 / _SIDE) + least + _RIPPLE * np.abs(blocks[k - 1])
    moving = np.zeros(count + 1, dtype=bool)
    moving[k] = change > limit
    steady = ~(moving[:-1] | moving[1:])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], steady, [False]]).astype(int)))
    stretches = []
    for a, b in edges.reshape(-1, 2).tolist():
        if b - a < 2:
            continue
        middle = float(np.median(blocks[a:b]))
        near = _SIGMAS * sigma + least / 2 + _RIPPLE / 2 * abs(middle)
        first, last = a, b
        while first > max(0, a - _SIDE) and abs(blocks[first - 1] - middle) < near:
            first -= 1
        while last < min(count, b + _SIDE) and abs(blocks[last] - middle) < near:
            last += 1
        first, last = first + _SETTLING, last - _SETTLING
        if last - first >= _LEAST:
            stretches.append((first * size, last * size))
    return stretches


def _variance_by_batches(values: Array) -> float:
    """Return the variance of the mean of an output, by the scatter of batch means."""
    size = len(values) // _BATCHES
    return float(values[: size * _BATCHES].reshape(_BATCHES, size).mean(axis=1).var(ddof=1) / _BATCHES)


def _check_ends(
    recording: Recording, main: str, output: Array, stretches: list[tuple[int, int]], reading: Array, place: str
) -> None:
    """Refuse a gyroscope whose output stands still at the largest rates while it is noisy at the others."""
    spread = np.array([output[a:b].std() for a, b in stretches])
    usual = float(np.median(spread))
    noisy = usual > _ROUNDING * float(np.abs(reading).max())
    if noisy:  # where a count is larger than the noise, outputs stand still at any rate
        first, last = stretches[int(np.argmin(np.abs(spread - usual)))]
        values, counts = np.unique(output[first:last], return_counts=True)
        noisy = usual > float(np.diff(values).min(initial=np.inf)) and counts.max() < (last - first) / 2
    for end in (int(np.argmax(reading)), int(np.argmin(reading))):
        a, b = stretches[end]
        counts = np.append(0, np.unique(output[a:b], return_counts=True)[1][:: 1 if reading[end] > 0 else -1])
        beside, at_limit = counts[-2:].tolist()  # of noise alone, fewer are at its end than beside it
        piled = at_limit > _TIES * (b - a) and at_limit - beside > _MORE * np.sqrt(at_limit + beside)
        if noisy and (spread[end] < _STANDS * usual or piled):
            raise DataError(
                f"{place}: {main} stands still at {recording.column(main)[a:b].mean():.6g} {recording.units[main]} in "
                f"the dwell at {recording.si('time')[a]:.1f} s: its output is saturated; expected rates in its range"
            )


def _check_axis(names: list[str], mean: Array, main: str, place: str) -> None:
    """Refuse a run in which another gyroscope than that along the table axis follows the table."""
    span = np.ptp(mean, axis=0)
    most = names[int(np.argmax(span))]
    if span[names.index(main)] < _WRONG * span.max():
        raise DataError(f"{place}: the table's rates are seen by {most}, not by {main}: expected mounting +{most[-1]}")


def _assign_listed_rates(
    reading: Array,
    stretches: list[tuple[int, int]],
    time: Array,
    rates: tuple[float, ...],
    recording: Recording,
    main: str,
    place: str,
) -> tuple[Array, float, float]:
    """Return the listed rate of each stretch, and zero and scale of the line from rates to outputs."""
    listed = np.unique(rates)
    scale = float(np.ptp(reading) / np.ptp(listed))
    nominal = parse_unit(recording.units[main])
    first = from_si(1.0, nominal.symbol) if nominal.quantity == "rate" else scale
    low, high = (to_si(float(end), nominal.symbol) for end in (reading.min(), reading.max()))
    if not 0.7 < scale / first < 1.4:
        raise SegmentError(
            f"{place}: {main} saw {_degrees(low)} to {_degrees(high)}, the listed rates are {_degrees(listed[0])} to "
            f"{_degrees(listed[-1])} deg/s: is a rate missing, or the unit or a sign wrong?"
        )
    zero = float(reading.min() - scale * listed[0])
    if nominal.quantity == "rate" and abs(zero) > _WRONG / 2 * np.ptp(reading):
        raise SegmentError(
            f"{place}: about this axis {main} saw {_degrees(low)} to {_degrees(high)} deg/s, the listed rates are "
            f"{_degrees(listed[0])} to {_degrees(listed[-1])} deg/s: is the sign of mounting wrong?"
        )
    lines = (scale, zero), (first, 0.0)  # the second where the largest listed rate was not run
    scale, zero = min(lines, key=lambda ab: np.median(np.abs((reading[:, None] - ab[1]) / ab[0] - listed).min(axis=1)))
    gap = np.diff(listed).min()
    for _ in range(2):
        read_rates = (reading - zero) / scale
        nearest = listed[np.argmin(np.abs(read_rates[:, None] - listed), axis=1)]
        scale, zero = np.polyfit(nearest, reading, 1).tolist()
    off = np.abs((reading - zero) / scale - nearest)
    worst = int(np.argmax(off))
    if off[worst] <= _NEXT_TO * gap:  # visits that were assigned to one listed rate must agree with each other
        off = np.abs(read_rates - np.array([np.median(read_rates[nearest == rate]) for rate in nearest]))
        worst, gap = int(np.argmax(off)), max(_ALIKE * np.abs(listed).max(), _OUT * float(np.median(off))) / _NEXT_TO
    if off[worst] > _NEXT_TO * gap:
        a, b = stretches[worst]
        seen_rate, by = (reading[worst] - zero) / scale, "by the line through the listed rates"
        if nominal.quantity == "rate":
            seen_rate, by = to_si(float(reading[worst]), nominal.symbol), "by its nominal scale factor"
        raise SegmentError(
            f"{place}: in the dwell at {time[a]:.1f} to {time[b - 1]:.1f} s {main} is at {_degrees(seen_rate)} deg/s "
            f"{by}, none of the listed rates {', '.join(map(_degrees, listed))} deg/s: did the table slip, is a listed "
            "rate missing or wrong, the output saturated, or the mounting's sign wrong?"
        )
    order, nearest_order = ([rate for rate, _ in groupby(each)] for each in (rates, nearest.tolist()))
    if order == [-rate for rate in nearest_order] != nearest_order:
        raise SegmentError(
            f"{place}: {main} saw the listed rates in their order, each the other way round: is the sign of mounting "
            "wrong?"
        )
    missing = sorted(set(listed.tolist()) - set(nearest.tolist()))
    if missing:
        raise SegmentError(
            f"{place}: no dwell of 2 s or longer at {', '.join(map(_degrees, missing))} deg/s; expected one at each "
            "listed rate"
        )
    return nearest, zero, scale


def _degrees(rate: float) -> str:
    return text_in(rate, "deg/s", 5)
