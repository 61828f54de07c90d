"""The dwells of a run: stretches in which the table turned at one rate, each with the gyroscopes' mean over it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from imulab.errors import DataError, SegmentError
from imulab.procedures.rate.choices import AXES
from imulab.procedures.rate.manifest import RateTest
from imulab.procedures.rate.sweep import Sweep, is_smooth, rate_of_angle, reduce_sweep
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.units import from_si, parse_unit, to_si

_BLOCK, _SIDE, _SETTLING, _LEAST = 0.1, 5, 3, 10
"""s, and numbers of such blocks: compared on either side, left out at either end, and the shortest dwell."""
_SIGMAS, _OF_STEP, _OF_COLUMN, _RIPPLE = 6.0, 1 / 20, 2e-5, 2e-3
"""Changes that count: of the noise, the smallest listed step, the largest recorded rate, and the rate itself."""
_BATCHES = 8
_FEW, _OF_RANGE, _SWEEP, _FLAT = 3, 0.02, 500, 0.03
"""Rates of steps; share of the range that a step keeps to; samples of a sweep; share of its range at one output."""
_NEXT_TO = 0.3
_ALIKE, _OUT = 5e-3, 5.0
"""Of the largest rate, and of what is usual: by how much visits of one rate differ at most."""
_STANDS = 0.2
_WRONG = 0.5
_ROUNDING = 1e-9
_ROBUST = 0.6745 * np.sqrt(2)


@dataclass(frozen=True)
class Dwells:
    """Dwells of one run, n of them, of g gyroscopes; SI except for the outputs.

    Attributes
    ----------
    start, stop
        s, shape (n,).
    rate
        Of the table, rad/s, shape (n,).
    mean, variance
        Of the outputs, and of that mean by its batches, shape (n, g).
    level
        Mean cosine and sine of the table's angle, shape (n, 2).
    recorded
        Whether the rates are those of a column of the recording.
    sweep
        Delay and bandwidth of the gyroscope along the table axis where the rate changed all the time, and the dwells
        are means by rate, rising ones first; else None.
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
    """Find the dwells of one run.

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
    own = outputs[names.index(main)] if run.sign > 0 else -outputs[names.index(main)]
    column = recorded_rate(recording, time)
    if column is None and run.rates is None:
        raise SegmentError(
            f"{place}: no column table_rate or table_angle; expected the table's rates (rates = [0, 10, -10] in the "
            'manifest, --rates for one recording; in Python rates="0,10,-10")'
        )
    recorded = column is not None
    signal = own if column is None else column
    size = _block_size(time)
    blocks = _block_means(signal, size)
    stretches = _stretches(blocks, size, None if recorded else _smallest_step(run.rates or (), own))
    if run.sweep and column is None:
        raise SegmentError(
            f"{place}: a sweep needs the table's rate at every sample: expected table_rate or table_angle"
        )
    if column is not None and (run.sweep or (_levels(blocks, stretches, size) < _FEW and is_smooth(column, blocks))):
        return _swept(recording, time, column, outputs, names, main, place)
    if len(stretches) < 3:
        raise SegmentError(
            f"{place}: {len(stretches)} stretches of a steady rate found, expected 3 or more of 2 s or longer: are the "
            "steps too short?"
        )
    mean = np.array([[values[a:b].mean() for values in outputs] for a, b in stretches])
    reading = mean[:, names.index(main)] * run.sign
    _check_ends(recording, main, own, stretches, reading, place)
    _check_axis(names, mean, main, place)
    if column is None:
        rate, zero, scale = _listed_rates(reading, stretches, time, run.rates or (), recording, main, place)
        blocks = (blocks - zero) / scale
    else:
        rate = np.array([column[a:b].mean() for a, b in stretches])
    cosine, sine = _level(time, blocks, size)
    return Dwells(
        start=np.array([time[a] for a, _ in stretches]),
        stop=np.array([time[b - 1] for _, b in stretches]),
        rate=rate,
        mean=mean,
        variance=np.array([[_variance(values[a:b]) for values in outputs] for a, b in stretches]),
        level=np.array([[part[a // size : b // size].mean() for part in (cosine, sine)] for a, b in stretches]),
        recorded=recorded,
    )


def _levels(blocks: Array, stretches: list[tuple[int, int]], size: int) -> int:
    """Return the number of different rates at which a run rests; of a slow sine there are two, at its ends."""
    within = _OF_RANGE * float(np.ptp(blocks))
    parts = [blocks[a // size : b // size] for a, b in stretches]
    rests = np.sort([part.mean() for part in parts if np.ptp(part) < within])
    return int(np.sum(np.diff(rests, prepend=-np.inf) > within))


def _swept(
    recording: Recording, time: Array, rate: Array, outputs: list[Array], names: list[str], main: str, place: str
) -> Dwells:
    """Return the means by rate of a run whose rate changed all the time."""
    if np.ptp(rate) <= 0 or len(time) < _SWEEP:
        raise SegmentError(f"{place}: {len(time)} samples of a rate that does not change; expected a sweep, or steps")
    own = names.index(main)
    sweep, found = reduce_sweep(time, rate, outputs, own)
    _check_axis(names, found.mean, main, place)
    for end in (float(outputs[own].max()), float(outputs[own].min())):
        still = outputs[own] == end
        if still.sum() >= _LEAST and np.ptp(rate[still]) > _FLAT * np.ptp(rate):
            raise DataError(
                f"{place}: {main} stands still at {end:.6g} {recording.units[main]} while the rate changes: its output "
                "is saturated; expected rates within its range"
            )
    half, size = found.duration / 2, _block_size(time)
    level = [part.mean() for part in _level(time, _block_means(rate, size), size)]
    return Dwells(
        start=found.middle - half,
        stop=found.middle + half,
        rate=found.rate,
        mean=found.mean,
        variance=found.variance,
        level=np.tile(level, (len(found.rate), 1)),
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


def _smallest_step(rates: tuple[float, ...], own: Array) -> float:
    """Return the smallest step between listed rates, in units of the output."""
    listed = np.unique(rates)
    return float(np.diff(listed).min() / (listed[-1] - listed[0]) * np.ptp(own))


def _block_size(time: Array) -> int:
    """Return the number of samples in 0.1 s, by the median step of 10,000 samples over the recording."""
    which = np.linspace(0, len(time) - 2, min(len(time) - 1, 10_000)).astype(np.int64)
    return max(1, round(_BLOCK / float(np.median(time[which + 1] - time[which]))))


def _block_means(signal: Array, size: int) -> Array:
    count = len(signal) // size
    return np.asarray(signal[: count * size].reshape(count, size).mean(axis=1))


def _level(time: Array, rate: Array, size: int) -> tuple[Array, Array]:
    """Return the mean cosine and sine of the table's angle over each block, which turns at one rate, shape (n,)."""
    edges = time[: (len(rate) + 1) * size : size]
    step = rate * np.diff(edges, append=time[-1])[: len(rate)]
    middle, part = np.cumsum(step) - step / 2, np.sinc(step / (2 * np.pi))
    return np.cos(middle) * part, np.sin(middle) * part


def _stretches(blocks: Array, size: int, step: float | None) -> list[tuple[int, int]]:
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
    found = []
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
        first, last = first + _SETTLING, last - _SETTLING  # what moves within it is left out, too
        if last - first >= _LEAST:
            found.append((first * size, last * size))
    return found


def _variance(values: Array) -> float:
    """Return the variance of the mean of an output by the means of its batches."""
    size = len(values) // _BATCHES
    return float(values[: size * _BATCHES].reshape(_BATCHES, size).mean(axis=1).var(ddof=1) / _BATCHES)


def _check_ends(
    recording: Recording, main: str, own: Array, stretches: list[tuple[int, int]], reading: Array, place: str
) -> None:
    """Refuse a gyroscope whose output stands still at the largest rates while it is noisy at the others."""
    spread = np.array([own[a:b].std() for a, b in stretches])
    usual = float(np.median(spread))
    noisy = usual > _ROUNDING * float(np.abs(reading).max())
    if noisy:  # where a count is larger than the noise, outputs stand still at any rate
        first, last = stretches[int(np.argmin(np.abs(spread - usual)))]
        noisy = usual > float(np.diff(np.unique(own[first:last])).min(initial=np.inf))
    for end in (int(np.argmax(reading)), int(np.argmin(reading))):
        if noisy and spread[end] < _STANDS * usual:
            a, b = stretches[end]
            found = float(recording.column(main)[a:b].mean())
            raise DataError(
                f"{place}: {main} stands still at {found:.6g} {recording.units[main]} in the dwell at "
                f"{recording.si('time')[a]:.1f} s: its output is saturated; expected rates within its range"
            )


def _check_axis(names: list[str], mean: Array, main: str, place: str) -> None:
    """Refuse a run in which another gyroscope than that along the table axis follows the table."""
    span = np.ptp(mean, axis=0)
    most = names[int(np.argmax(span))]
    if span[names.index(main)] < _WRONG * span.max():
        raise DataError(f"{place}: the table's rates are seen by {most}, not by {main}: expected mounting +{most[-1]}")


def _listed_rates(
    reading: Array,
    stretches: list[tuple[int, int]],
    time: Array,
    rates: tuple[float, ...],
    recording: Recording,
    main: str,
    place: str,
) -> tuple[Array, float, float]:
    """Return the listed rate of each stretch, and zero and scale of the output that lead to it."""
    listed = np.unique(rates)
    scale = float(np.ptp(reading) / np.ptp(listed))
    nominal = parse_unit(recording.units[main])
    first = from_si(1.0, nominal.symbol) if nominal.quantity == "rate" else scale
    if not 0.7 < scale / first < 1.4:
        low, high = (to_si(float(end), nominal.symbol) for end in (reading.min(), reading.max()))
        raise SegmentError(
            f"{place}: {main} saw {_degrees(low)} to {_degrees(high)}, the listed rates are {_degrees(listed[0])} to "
            f"{_degrees(listed[-1])} deg/s: is a rate missing, or the unit or a sign wrong?"
        )
    zero = float(reading.min() - scale * listed[0])
    if nominal.quantity == "rate" and abs(zero) > _WRONG / 2 * np.ptp(reading):
        low, high = (to_si(float(end), nominal.symbol) for end in (reading.min(), reading.max()))
        raise SegmentError(
            f"{place}: about this axis {main} saw {_degrees(low)} to {_degrees(high)} deg/s, the listed rates are "
            f"{_degrees(listed[0])} to {_degrees(listed[-1])} deg/s: is the sign of mounting wrong?"
        )
    gap = np.diff(listed).min()
    for _ in range(2):
        seen = (reading - zero) / scale
        nearest = listed[np.argmin(np.abs(seen[:, None] - listed), axis=1)]
        scale, zero = np.polyfit(nearest, reading, 1).tolist()
    off = np.abs((reading - zero) / scale - nearest)
    worst = int(np.argmax(off))
    if off[worst] <= _NEXT_TO * gap:  # what one listed rate was taken for is one rate
        off = np.abs(seen - np.array([np.median(seen[nearest == rate]) for rate in nearest]))
        worst, gap = int(np.argmax(off)), max(_ALIKE * np.abs(listed).max(), _OUT * float(np.median(off))) / _NEXT_TO
    if off[worst] > _NEXT_TO * gap:
        a, b = stretches[worst]
        seen_rate, by = (reading[worst] - zero) / scale, "by the line through the listed rates"
        if nominal.quantity == "rate":
            seen_rate, by = to_si(float(reading[worst]), nominal.symbol), "by its nominal scale factor"
        raise SegmentError(
            f"{place}: in the dwell at {time[a]:.1f} to {time[b - 1]:.1f} s {main} is at {_degrees(seen_rate)} deg/s "
            f"{by}, none of the listed rates {', '.join(map(_degrees, listed))} deg/s: did the table slip, is a listed "
            "rate missing or wrong, or the mounting's sign?"
        )
    order, found = ([rate for rate, _ in groupby(each)] for each in (rates, nearest.tolist()))
    if order == [-rate for rate in found] != found:
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
    return f"{from_si(rate, 'deg/s'):.5g}"
