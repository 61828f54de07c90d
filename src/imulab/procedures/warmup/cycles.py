"""Recordings to power cycles on common bins of time, each relative to the mean of its settled part.

A bin keeps the mean of the data and, for the basis functions, two instants with weights that have the same first three
moments as the times of its samples (a Gauss rule). So averages of cubics over a bin are exact, those of smooth
functions good to fourth order, and 60,000 samples cost no more than 600.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import shared_unit
from imulab.errors import DataError, UnitError
from imulab.estimation.rows import median, medians, quantile, resolution
from imulab.estimation.sampling import mend_blocks
from imulab.recording import (
    LATEST_START,
    Array,
    Recording,
    Source,
    check_clock,
    check_finite,
    check_start,
    check_time,
    first_reading,
    head_temperature,
    power_on_temperature,
    state_power_on,
)
from imulab.units import ask_unit_of_time, conversion_factor, likely_times, parse_unit, si_unit

# Recordings averaged over bins of one second, block by block.


BIN = 1.0
"""Width of a bin, s."""
_DAY = 86400.0  # s: a longer cycle has another unit of time
_MOMENT = 10.0  # s: a shorter one may have
_OF_STEPS = 5000  # samples of a block that show the steps of its outputs
_AXIS = re.compile(r"(gyro|accel)_.+")


@dataclass(frozen=True)
class CycleBins:
    """Averages over bins of time; only the b bins that hold samples, in order.

    Attributes
    ----------
    start
        Nominal start of each bin, s since power-on, shape (b,); a bin is at least as wide as `BIN`.
    stop
        Nominal end, s, shape (b,).
    count
        Number of samples, shape (b,).
    nodes, shares
        Two instants, s, and their weights (sum 1), shapes (b, 2).
    mean
        Mean of the samples, shape (b, axes), SI, or count or V.
    variance
        Variance of the samples within the bin, shape (b, axes).
    """

    start: Array
    stop: Array
    count: Array
    nodes: Array
    shares: Array
    mean: Array
    variance: Array

    def __len__(self) -> int:
        return len(self.start)

    def where(self, keep: np.ndarray) -> CycleBins:
        """Return some of the bins."""
        return CycleBins(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Cycle:
    """One power cycle of one unit.

    Attributes
    ----------
    bins
        Averaged samples.
    axes, units
        Columns, and their units in SI (or count, V).
    temperature
        Temperature at power-on, degC.
    first, last
        Time of the first and the last sample, s since power-on.
    steps
        Smallest step between different values of each axis, shape (axes,); 0 where all are the same.
    name, serial, sensor_model
        Name for messages; serial number and model from the head of the file.
    first_reading
        First value of the column temperature, degC, or None.
    chamber
        ``chamber_temperature`` or ``set_point`` of the head of the file, degC, or None.
    source, corrected_by
        File and hash, and the records that it was corrected by.
    file_units
        Units of the axes in the file.
    zeros
        Rows left out because all axes are exactly zero in them: some loggers write missing rows so.
    """

    bins: CycleBins
    axes: tuple[str, ...]
    units: tuple[str, ...]
    temperature: float
    first: float
    last: float
    steps: Array
    name: str
    serial: str | None = None
    first_reading: float | None = None
    chamber: float | None = None
    source: Source | None = None
    sensor_model: str | None = None
    file_units: tuple[str, ...] = ()
    zeros: int = 0
    corrected_by: tuple[str, ...] = ()


def find_power_cycle(
    recording: Recording | Iterable[Recording],
    *,
    latest_start: float = LATEST_START,
    temperature_from_column: bool = False,
    source: Source | None = None,
) -> Cycle:
    """Return a recording of one power cycle, or its consecutive blocks, averaged over bins of one second.

    Parameters
    ----------
    recording
        Recording with columns time (0 is power-on) and gyro_* or accel_*, and ``power_on_temperature`` in its head.
    latest_start
        A first sample later than this is refused, s.
    temperature_from_column
        Whether the first reading of the column temperature replaces a missing ``power_on_temperature``.
    source
        File and hash, for the record; those of the recording if None.

    Raises
    ------
    DataError
        No power-on temperature, time that does not start at power-on, does not rise or is of another unit, NaN, or no
        axes.
    UnitError
        The axes of one kind have different units.

    Examples
    --------
    >>> import imulab as il
    >>> cycle = il.find_power_cycle(il.simulate_power_cycle(-20.0, sample_rate=5.0))
    >>> abs(cycle.temperature + 20.0) < 2.0
    True
    """
    blocks = [recording] if isinstance(recording, Recording) else recording
    pieces: list[tuple[np.ndarray, Array, Array]] = []
    steps: list[Array] = []
    head: Recording | None = None
    axes: tuple[str, ...] = ()
    temperature, first, last, reading, zeros, rows = np.nan, 0.0, -np.inf, None, 0, 0
    for block in mend_blocks(blocks):
        time = check_time(block)
        if not time.size:
            continue
        if head is None:
            head = block
            axes = _axes(block)
            first, reading = float(time[0]), first_reading(block)
            temperature = _power_on(block, temperature_from_column, reading)
            check_start(block, first, latest_start)
            check_clock(block, time)
        _check_rises(block, time, last)
        last, rows = float(time[-1]), rows + len(time)
        _check_length(block, first, last, rows)
        here = _empty_rows(block, axes)
        zeros += int(here.sum())
        if not here.all():
            if not pieces:
                first = _first_reading_time(block, time, int(np.argmin(here)), latest_start)
            pieces.append(_accumulate(block, axes, time, ~here if here.any() else None))
            some = slice(None, None, 1 + len(time) // _OF_STEPS)
            steps.append(np.array([resolution(block.columns[axis][some]) or np.inf for axis in axes]))
    if head is None:
        raise DataError("no samples")
    if not pieces:
        raise DataError(f"{head.name}: every row is zero in {' '.join(axes)}")
    _check_length(head, first, last, rows, ended=True)
    factors = [conversion_factor(head.units[axis], si_unit(head.units[axis])) for axis in axes]
    return Cycle(
        bins=_bins(pieces, factors),
        axes=axes,
        units=tuple(si_unit(head.units[axis]) for axis in axes),
        temperature=temperature,
        first=first,
        last=last,
        steps=np.where(np.isfinite(smallest := np.min(steps, axis=0)), smallest * factors, 0.0),
        name=head.name,
        serial=head.metadata.get("serial"),
        first_reading=reading,
        chamber=_chamber(head),
        source=source or head.source,
        sensor_model=head.metadata.get("model"),
        file_units=tuple(parse_unit(head.units[axis]).symbol for axis in axes),
        zeros=zeros,
        corrected_by=head.corrected_by,
    )


def _check_rises(block: Recording, time: Array, last: float) -> None:
    """Refuse a block that begins no later than the `last` time before it, s."""
    if time[0] <= last:
        raise DataError(
            f"{block.name}: {block.place(0)}, column time: time does not rise: "
            f"expected more than {last:.9g} s, found {time[0]:.9g} s"
        )


def _first_reading_time(block: Recording, time: Array, row: int, latest_start: float) -> float:
    """Return the time of the first row that is not zero in all axes, s; refuse one that is too late."""
    first = float(time[row])
    if first > latest_start:
        raise DataError(
            f"{block.name}: {block.place(row)}, column time: every axis is zero before {first:.6g} s, as before "
            f"power comes on; expected readings from at most {latest_start:g} s on: leave those rows out and let time "
            "count from power-on (--latest-start allows more)"
        )
    return first


def _check_length(block: Recording, first: float, last: float, rows: int, *, ended: bool = False) -> None:
    """Refuse a cycle of more than a day, and one that ended in a moment and is likely in another unit of time."""
    unit, duration = block.units["time"], last - first or 1.0
    asked = f"{ask_unit_of_time(unit, (rows - 1) / duration, duration)} --unit time=UNIT states it"
    if last > _DAY:
        raise DataError(
            f"{block.name}: {block.place(len(block) - 1)}, column time: {last:.6g} s after power-on; expected a power "
            f"cycle of less than a day: {asked}"
        )
    likely = likely_times(unit, (rows - 1) / duration, duration)
    if ended and last < _MOMENT and likely and not block.time_stated:
        raise DataError(f"{block.name}: column time [{unit}]: ends {last:.3g} s after power-on: {asked}")


def _axes(recording: Recording) -> tuple[str, ...]:
    axes = tuple(name for name in recording.columns if _AXIS.fullmatch(name))
    if not axes:
        raise recording.lacking("column gyro_* or accel_*", "gyro_x")
    for kind in ("gyro", "accel"):
        units = {name: recording.units[name] for name in axes if name.startswith(kind)}
        if units:
            shared_unit(units, "the axes of one kind", recording.name)
    return axes


def _power_on(recording: Recording, from_column: bool, reading: float | None) -> float:
    stated = power_on_temperature(recording)
    if stated is not None and np.isfinite(stated):
        return stated
    if from_column and reading is not None:
        return reading
    problem = "no power_on_temperature in the head of the file" if stated is None else "power_on_temperature is nan"
    raise DataError(f"{recording.name}: {problem}; {state_power_on(recording, '-20')}")


def _chamber(recording: Recording) -> float | None:
    for key in ("chamber_temperature", "set_point"):
        value = head_temperature(recording, key)
        if value is not None and np.isfinite(value):
            return value
    return None


def _empty_rows(block: Recording, axes: tuple[str, ...]) -> NDArray[np.bool_]:
    """Return which rows are zero in all of two axes or more."""
    empty: NDArray[np.bool_] = block.columns[axes[0]] == 0
    if len(axes) < 2 or not empty.any():
        return np.zeros(len(empty), dtype=np.bool_)
    for axis in axes[1:]:
        empty = empty & (block.columns[axis] == 0)
    return empty


def _accumulate(
    block: Recording, axes: tuple[str, ...], time: Array, used: NDArray[np.bool_] | None = None
) -> tuple[np.ndarray, Array, Array]:
    """Return bin numbers (k,), moments (k, 4), and per axis mean and sum of squared deviations (k, axes, 2).

    Moments are sums of 1, x, x^2, x^3 with x the time from the bin's middle; the rest is in the units of the file.
    """
    time = time if used is None else time[used]
    number = np.floor(time / BIN).astype(np.int64)
    first = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
    sizes = np.diff(first, append=len(time))
    x = time - (number + 0.5) * BIN
    moments = np.empty((len(first), 4))
    moments[:, 0] = sizes
    power = x
    for k in (1, 2, 3):
        moments[:, k] = np.add.reduceat(power, first)
        if k < 3:
            power = power * x
    sums = np.empty((len(first), len(axes), 2))
    for a, axis in enumerate(axes):
        values = block.columns[axis] if used is None else block.columns[axis][used]
        total = np.add.reduceat(values, first)
        if not np.isfinite(total).all():
            check_finite(block, [axis])
        mean = total / sizes
        deviation = values - np.repeat(mean, sizes)
        np.square(deviation, out=deviation)
        sums[:, a, 0] = mean
        sums[:, a, 1] = np.add.reduceat(deviation, first)
    return number[first], moments, sums


def _bins(pieces: list[tuple[np.ndarray, Array, Array]], factors: list[float]) -> CycleBins:
    number = np.concatenate([piece[0] for piece in pieces])
    moments = np.concatenate([piece[1] for piece in pieces])
    sums = np.concatenate([piece[2] for piece in pieces])
    if len(pieces) > 1:  # two blocks may share a bin
        first = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        size = moments[:, 0, None]
        weighted = np.add.reduceat(size * sums[:, :, 0], first, axis=0)
        count = np.add.reduceat(size, first, axis=0)
        mean = weighted / count
        apart = sums[:, :, 0] - np.repeat(mean, np.diff(first, append=len(number)), axis=0)
        within = np.add.reduceat(sums[:, :, 1] + size * apart**2, first, axis=0)
        number, moments = number[first], np.add.reduceat(moments, first, axis=0)
        sums = np.stack([mean, within], axis=2)
    factor = np.array(factors)
    count = moments[:, 0]
    nodes, shares = gauss_nodes(moments[:, 1:] / count[:, None])
    return CycleBins(
        start=number * BIN,
        stop=(number + 1) * BIN,
        count=count,
        nodes=nodes + ((number + 0.5) * BIN)[:, None],
        shares=shares,
        mean=sums[:, :, 0] * factor,
        variance=sums[:, :, 1] / count[:, None] * factor**2,
    )


def gauss_nodes(moments: Array) -> tuple[Array, Array]:
    """Return two nodes and their weights, shapes (b, 2), with this mean, mean square and mean cube, shape (b, 3).

    With central moments m2, m3 the nodes lie at the roots of ``x^2 - (m3 / m2) x - m2 = 0`` about the mean.
    Source: Golub and Welsch, Mathematics of Computation 23 (1969) 221, for n = 2.
    """
    mean, square, cube = moments.T
    m2 = np.maximum(square - mean**2, 0.0)
    m3 = cube - 3 * mean * square + 2 * mean**3
    spread = m2 > 1e-12 * square
    skew = np.where(spread, m3 / np.where(spread, m2, 1.0), 0.0)
    root = np.sqrt(skew**2 / 4 + m2)
    low, high = skew / 2 - root, skew / 2 + root
    share = np.where(spread, high / np.where(spread, high - low, 1.0), 0.5)
    return mean[:, None] + np.column_stack([low, high]), np.column_stack([share, 1 - share])


def merge(bins: CycleBins, edges: Array) -> CycleBins:
    """Return wider bins between times, shape (e,), without bins that cross an edge or lie outside.

    The averages of cubics stay exact.
    """
    owner = np.searchsorted(edges, bins.start + 1e-9, side="right") - 1
    inside = (owner >= 0) & (owner < len(edges) - 1)
    inside[inside] &= bins.stop[inside] <= edges[owner[inside] + 1] + 1e-9
    kept, owner = bins.where(inside), owner[inside]
    if not owner.size:
        return kept
    first = np.flatnonzero(np.diff(owner, prepend=owner[0] - 1))
    n = kept.count
    count = np.add.reduceat(n, first)
    centre = np.add.reduceat(n * (kept.shares * kept.nodes).sum(axis=1), first) / count
    sizes = np.diff(first, append=len(owner))
    x = kept.nodes - np.repeat(centre, sizes)[:, None]
    moments = np.column_stack([np.add.reduceat(n * (kept.shares * x**k).sum(axis=1), first) / count for k in (1, 2, 3)])
    nodes, shares = gauss_nodes(moments)
    mean = np.add.reduceat(n[:, None] * kept.mean, first, axis=0) / count[:, None]
    apart = kept.mean - np.repeat(mean, sizes, axis=0)
    variance = np.add.reduceat(n[:, None] * (kept.variance + apart**2), first, axis=0) / count[:, None]
    groups = owner[first]
    return CycleBins(edges[groups], edges[groups + 1], count, nodes + centre[:, None], shares, mean, variance)


def common_axes(cycles: list[Cycle]) -> tuple[str, ...]:
    """Return the axes that all cycles share, in the same units.

    Raises
    ------
    DataError
        A file lacks an axis, or the same file is given twice.
    UnitError
        Units differ between files; they are not converted.
    """
    first = cycles[0]
    for cycle in cycles[1:]:
        for lacking, other in ((cycle, first), (first, cycle)):
            missing = [axis for axis in other.axes if axis not in lacking.axes]
            if missing:
                raise DataError(
                    f"{lacking.name}: no column {missing[0]}, which {other.name} has; --axes chooses columns"
                )
        for axis, unit in zip(first.axes, first.file_units, strict=True):
            cycle_unit = cycle.file_units[cycle.axes.index(axis)]
            if cycle_unit != unit:
                raise UnitError(
                    f"{cycle.name}: column {axis} is in {cycle_unit}, but in {unit} in {first.name}: "
                    f"all files must share one unit; if a title is wrong, --unit {axis}=UNIT states it for all"
                )
    hashes: dict[str, str] = {}
    for cycle in cycles:
        if cycle.source is not None:
            if cycle.source.sha256 in hashes:
                raise DataError(f"{cycle.name}: the same samples as {hashes[cycle.source.sha256]}: given twice")
            hashes[cycle.source.sha256] = cycle.name
    return first.axes


def with_axes(cycle: Cycle, wanted: tuple[str, ...]) -> Cycle:
    """Return a cycle with only these axes.

    Raises
    ------
    DataError
        It lacks one.
    """
    missing = [axis for axis in wanted if axis not in cycle.axes]
    if missing:
        raise DataError(f"{cycle.name}: no column {missing[0]}; found {' '.join(cycle.axes)}")
    index = [cycle.axes.index(axis) for axis in wanted]
    bins = replace(cycle.bins, mean=cycle.bins.mean[:, index], variance=cycle.bins.variance[:, index])
    return replace(
        cycle,
        bins=bins,
        axes=wanted,
        steps=cycle.steps[index],
        units=tuple(cycle.units[i] for i in index),
        file_units=tuple(cycle.file_units[i] for i in index),
    )


# Power cycles side by side on common bins of time, grouped by temperature, each relative to its settled mean.


SETTLED = 30.0
"""A shorter settled part makes no reference, s."""
_WIDTH, _GROWTH = 2.0, 0.15
"""Bins are two seconds wide at first, later this share of the time since power-on, so that noise weighs little."""
_MOVED = 9.0  # times the variance at rest, beyond which the unit moved; more in seconds of few samples
_MOVED_RANGE = 0.02  # of the range of a curve: smaller changes within a second are the curve's, not a motion
_APART, _APART_RANGE = 10.0, 0.1  # a second stands apart by so many sigma, and by this share of the curve's range
_QUIET = 60  # s whose variance is that at rest
_FEWEST = 10  # s of samples before T_M that a curve needs
_NEARLY = 1e-9  # s, and K: rounding of decimal limits

Index = NDArray[np.intp]


@dataclass(frozen=True)
class Curves:
    """The cycles of a test on common bins of time before T_M.

    Attributes
    ----------
    cycles
        The power cycles, c of them.
    temperatures
        Calibration temperatures, shape (k,), degC.
    group
        Index of each cycle's calibration temperature, shape (c,).
    power_on
        Measured power-on temperatures, shape (c,), degC.
    unit
        Index of each cycle's unit, shape (c,).
    settling_time
        T_M, s.
    edges
        Edges of the bins, shape (b + 1,), s.
    nodes, shares
        Two instants of each bin and their weights, shapes (c, b, 2).
    seconds
        Seconds of samples in each bin, shape (c, b); the weights of a fit.
    mean
        Referenced to the cycle's settled mean, shape (c, b, axes), SI or count or V.
    noise
        Variance of the mean over one second by white noise, shape (axes,).
    reference, reference_seconds
        Settled mean, shape (c, axes), and the time that it was averaged over, shape (c,).
    drift, drift_uncertainty
        Change of the settled part from its start to its end, and standard uncertainty, shapes (c, axes).
    end
        End of each cycle (or the beginning of a motion that does not stop), s, shape (c,).
    moved
        Seconds left out because the unit moved, and the time when that began, shape (c, 2).
    halved
        Whether the settled part is the cycle's second half, shape (c,).
    """

    cycles: tuple[Cycle, ...]
    temperatures: Array
    group: Index
    power_on: Array
    unit: Index
    settling_time: float
    edges: Array
    nodes: Array
    shares: Array
    seconds: Array
    mean: Array
    noise: Array
    reference: Array
    reference_seconds: Array
    drift: Array
    drift_uncertainty: Array
    end: Array
    moved: Array
    halved: NDArray[np.bool_]

    @property
    def axes(self) -> tuple[str, ...]:
        """Columns, in order."""
        return self.cycles[0].axes

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each axis."""
        return self.cycles[0].units

    def kinds(self) -> dict[str, list[int]]:
        """Return the indices of the axes of each kind: gyro, accel."""
        return {
            kind: places
            for kind in ("gyro", "accel")
            if (places := [i for i, axis in enumerate(self.axes) if axis.startswith(kind)])
        }

    def expected_noise(self) -> Array:
        """Return the mean square of white noise in each cycle's curve, shape (c, axes)."""
        used = (self.seconds > 0).sum(axis=1)
        share = used / np.maximum(self.seconds.sum(axis=1), 1e-300) + 1 / self.reference_seconds
        return np.asarray(share[:, None] * self.noise)

    def group_means(self) -> tuple[Array, Array]:
        """Return the mean curve at each calibration temperature, shape (k, b, axes), and its seconds, shape (k, b)."""
        member = (self.group[None, :] == np.arange(len(self.temperatures))[:, None]).astype(np.float64)
        seconds = member @ self.seconds
        total = np.einsum("kc,cb,cba->kba", member, self.seconds, self.mean)
        return total / np.maximum(seconds, 1e-300)[:, :, None], seconds


def assign_temperatures(cycles: Sequence[Cycle], temperatures: Array, tolerance: float) -> Index:
    """Return the index of each cycle's calibration temperature.

    Raises
    ------
    DataError
        A cycle fits none, or a calibration temperature has no cycle.
    """
    known = " ".join(f"{t:g}" for t in temperatures)
    power_on = np.array([cycle.temperature for cycle in cycles])
    apart = np.abs(power_on[:, None] - temperatures)
    group = apart.argmin(axis=1)
    for cycle, distance in zip(cycles, apart.min(axis=1), strict=True):
        if distance > tolerance + _NEARLY:
            raise DataError(
                f"{cycle.name}: power-on temperature {cycle.temperature:g} degC fits no calibration temperature within "
                f"{tolerance:g} K; expected one of {known} (--temperatures names others, --tolerance takes more)"
            )
    missing = [f"{temperatures[k]:g}" for k in range(len(temperatures)) if k not in group]
    if missing:
        raise DataError(
            f"no power cycle at {' '.join(missing)} degC among {len(cycles)} files: every interval needs cycles at its "
            "two end points (--temperatures names those that were measured)"
        )
    return np.asarray(group, dtype=np.intp)


def make_curves(
    cycles: Sequence[Cycle],
    temperatures: Array,
    *,
    tolerance: float,
    settling_time: float | None,
    limit: dict[str, float],
) -> tuple[Curves, bool]:
    """Return power cycles side by side, and whether all curves settle; T_M is chosen unless it is stated.

    Parameters
    ----------
    cycles
        Power cycles with the same axes and units.
    temperatures
        Calibration temperatures, degC, ascending.
    tolerance
        How far a power-on temperature may lie from its calibration temperature, K.
    settling_time
        T_M, s, or None.
    limit
        |Z| by kind (gyro, accel) below which a curve counts as settled; if negative, a share of the largest.

    Returns
    -------
    Curves, and whether every curve settles within its recording.

    Raises
    ------
    DataError
        A cycle fits no temperature, is too short, or moved most of the time.
    """
    group = assign_temperatures(cycles, temperatures, tolerance)
    still = [_still(cycle, level) for cycle, level in zip(cycles, quiet_levels(cycles), strict=True)]
    end = np.array([bins.stop[-1] for bins, _ in still])
    settled = True
    serials = [cycle.serial or "" for cycle in cycles]
    unit = np.array([sorted(set(serials)).index(serial) for serial in serials])
    if settling_time is None:  # the longest over temperatures and units
        _, each = np.unique(unit * len(temperatures) + group, return_inverse=True)
        settling_time, settled = _choose_settling_time(cycles, [bins for bins, _ in still], each, end, limit)
    _check_early(cycles, [bins for bins, _ in still], settling_time)
    noise = _white_noise([bins for bins, _ in still])
    edges = bin_edges(settling_time)
    c, b, a = len(cycles), len(edges) - 1, len(cycles[0].axes)
    nodes, shares = np.zeros((c, b, 2)), np.full((c, b, 2), 0.5)
    nodes[:] = (0.5 * (edges[1:] + edges[:-1]))[:, None]
    seconds, mean = np.zeros((c, b)), np.zeros((c, b, a))
    reference, reference_seconds = np.zeros((c, a)), np.zeros(c)
    drift, uncertain = np.zeros((c, a)), np.zeros((c, a))
    halved = end < settling_time + SETTLED - _NEARLY
    for i, (bins, _) in enumerate(still):
        late = bins.where(bins.start >= (end[i] / 2 if halved[i] else settling_time) - _NEARLY)
        reference[i], reference_seconds[i], drift[i], uncertain[i] = _settled_mean(late, bins, noise)
        wide = merge(bins, edges)
        where = np.searchsorted(edges, wide.start + _NEARLY, side="right") - 1
        nodes[i, where], shares[i, where] = wide.nodes, wide.shares
        seconds[i, where] = wide.count / median(bins.count)
        mean[i, where] = wide.mean - reference[i]
    curves = Curves(
        cycles=tuple(cycles),
        temperatures=temperatures,
        group=group,
        power_on=np.array([cycle.temperature for cycle in cycles]),
        unit=unit,
        settling_time=settling_time,
        edges=edges,
        nodes=nodes,
        shares=shares,
        seconds=seconds,
        mean=mean,
        noise=noise,
        reference=reference,
        reference_seconds=reference_seconds,
        drift=drift,
        drift_uncertainty=uncertain,
        end=end,
        moved=np.array([moved for _, moved in still]),
        halved=halved,
    )
    return curves, settled


def _check_early(cycles: Sequence[Cycle], still: Sequence[CycleBins], settling_time: float) -> None:
    """Refuse a cycle with hardly any samples before T_M."""
    for cycle, bins in zip(cycles, still, strict=True):
        early = int((bins.stop <= settling_time + _NEARLY).sum())
        if early < _FEWEST:
            raise DataError(
                f"{cycle.name}: {early} s of samples before T_M = {settling_time:g} s: expected {_FEWEST} s or more"
            )


def bin_edges(stop: float) -> Array:
    """Return edges of bins from 0 to `stop`, in whole seconds: two apart at first, later 15 % of the time."""
    edges = [0.0]
    while edges[-1] < stop:
        edges.append(edges[-1] + max(_WIDTH, round(_GROWTH * edges[-1])))
    edges[-1] = stop
    if len(edges) > 2 and edges[-1] - edges[-2] < 0.5 * (edges[-2] - edges[-3]):
        del edges[-2]
    return np.array(edges)


def quiet_levels(cycles: Sequence[Cycle]) -> list[Array]:
    """Return the variance within a bin at rest, shape (axes,) for each cycle.

    It is that of the cycle's quietest minute (a vehicle may fly for most of its log); where the cycles of the same
    sample rate are mostly quieter, it is theirs (a cycle may move throughout).
    """
    quietest = np.array([_quietest(cycle.bins.variance) for cycle in cycles])
    rate = np.array([median(cycle.bins.count) for cycle in cycles])
    levels = []
    for level, mine in zip(quietest, rate, strict=True):
        usual = medians(quietest[np.abs(rate / mine - 1) < 0.1], 0)
        levels.append(np.where(usual > 0, np.minimum(level, usual), level))
    return levels


def _quietest(variance: Array) -> Array:
    """Return the smallest running median over 1 min, or over a quarter of a log shorter than 4 min."""
    width = max(min(_QUIET, len(variance) // 4), 1)
    windows = np.lib.stride_tricks.sliding_window_view(variance, width, axis=0)[:: max(width // 6, 1)]
    return np.asarray(medians(windows, -1).min(axis=0))


def _still(cycle: Cycle, quiet: Array) -> tuple[CycleBins, tuple[float, float]]:
    """Return the bins in which the unit stood still, and the seconds left out with the time of the first motion.

    In a bin with motion the variance is far above `quiet` and above what the warm-up curve makes of it, or the mean
    stands apart from those around it, as after a knock that fills a bin. Outputs in steps that are coarser than their
    noise rest at one value and change between two: a step is no motion.
    """
    bins = cycle.bins
    quiet = np.maximum(quiet, np.square(cycle.steps) / 12)
    slope = np.gradient(bins.mean, axis=0) if len(bins) > 1 else 0.0
    excess = bins.variance - np.square(slope) / 12
    noise = _MOVED * (1 + 10 / bins.count[:, None]) * quiet
    away = np.square(bins.mean - _running_medians(bins.mean))
    # Noise from neighbouring bins, because within a bin of few samples the variance is poorly known.
    steps = np.diff(bins.mean, axis=0)
    usual = medians(np.abs(steps - medians(steps, 0)), 0) if len(steps) else np.inf
    alone = _APART**2 * np.maximum(quiet / bins.count[:, None], (1.05 * usual) ** 2)
    alone += np.square(cycle.steps)
    moved = np.zeros(len(bins), dtype=np.bool_)
    while not moved.all():
        # The curve's range is taken from bins at rest: in motion a larger range would hide the motion.
        spread = np.array([quantile(axis, 0.95) - quantile(axis, 0.05) for axis in bins.mean[~moved].T])
        moved_now = (excess > noise + (_MOVED_RANGE * spread) ** 2).any(axis=1) & (bins.count > 2)
        moved_now |= (away > alone + (_APART_RANGE * spread) ** 2).any(axis=1)
        if not (moved_now & ~moved).any():
            break
        moved |= moved_now
    if not moved.any():
        return bins, (0.0, 0.0)
    near = np.convolve(moved, [1, 1, 1], mode="same") > 0
    began = float(bins.start[np.argmax(near)])
    if (~near).sum() < 2 * _FEWEST:
        axis = int(np.argmax(medians(bins.variance / np.maximum(quiet, 1e-300), 0)))
        louder = math.sqrt(median(bins.variance[:, axis]) / max(float(quiet[axis]), 1e-300))
        raise DataError(
            f"{cycle.name}: the unit moved from {began:g} s on: {int((~near).sum())} s at rest are too few (noise of "
            f"{cycle.axes[axis]} {louder:.3g} times that at rest): was it shaken, or is the unit of that column "
            "another than in the other files?"
        )
    return bins.where(~near), (float(near.sum()), began)


def _running_medians(values: Array) -> Array:
    """Return the median of each row and the three on either side, which two bad rows do not change."""
    if len(values) <= 3:
        return medians(values, 0)[None]
    padded = np.pad(values, ((3, 3), (0, 0)), mode="reflect", reflect_type="odd")
    return medians(np.lib.stride_tricks.sliding_window_view(padded, 7, axis=0), -1)


def _white_noise(still: Sequence[CycleBins]) -> Array:
    """Return the variance of the mean over 1 s by white noise, from differences of neighbouring bins, shape (axes,)."""
    total, number = np.zeros(still[0].mean.shape[1]), 0
    for bins in still:
        neighbours = (np.diff(bins.start) < 1.5) & (bins.start[1:] > bins.stop[-1] / 4)
        steps = np.diff(bins.mean, axis=0)[neighbours]
        if len(steps) > 1:
            # Second differences, so that the curve's slope does not count as noise.
            bends = np.diff(steps, axis=0)
            total += (bends**2).sum(axis=0) / 6
            number += len(bends)
    return total / max(number, 1)


def _settled_mean(late: CycleBins, bins: CycleBins, noise: Array) -> tuple[Array, float, Array, Array]:
    """Return mean and length of the settled part, s, and its change from start to end with standard uncertainty."""
    weight = late.count / late.count.sum()
    mean = weight @ late.mean
    seconds = float(late.count.sum() / median(bins.count))
    time = (late.shares * late.nodes).sum(axis=1)
    time = time - weight @ time
    spread = float(weight @ time**2)
    if spread <= 0:
        return mean, seconds, np.zeros_like(mean), np.zeros_like(mean)
    length = float(late.stop[-1] - late.start[0])
    slope = (weight * time) @ (late.mean - mean) / spread
    return mean, seconds, slope * length, np.sqrt(noise / (seconds * spread)) * length


def _choose_settling_time(
    cycles: Sequence[Cycle], still: Sequence[CycleBins], group: Index, end: Array, limit: dict[str, float]
) -> tuple[float, bool]:
    """Return the first time after which all mean curves stay below their limits, rounded up to 10 s, and if any is.

    There is a curve for each group: a temperature of a unit. The curves are relative to the mean after that time, so it
    is found by iteration from three quarters of the shortest cycle.
    """
    shortest = float(np.floor(end.min()))
    latest = 10.0 * np.floor((shortest - SETTLED) / 10)
    if latest < 2 * _FEWEST:
        raise DataError(
            f"{cycles[int(end.argmin())].name}: ends {shortest:g} s after power-on: too short to find the settling "
            "time; record until the output has settled, or give --settling-time"
        )
    edges = bin_edges(shortest)
    noise = _white_noise(still)
    wide = [merge(bins, edges) for bins in still]
    count = int(group.max()) + 1
    axes = cycles[0].axes
    total, weight = np.zeros((count, len(edges) - 1, len(axes))), np.zeros((count, len(edges) - 1, 1))
    for bins, k in zip(wide, group, strict=True):
        where = np.searchsorted(edges, bins.start + _NEARLY, side="right") - 1
        share = (bins.count / median(bins.count / (bins.stop - bins.start)))[:, None]
        settled = bins.where(bins.start >= 0.75 * shortest)
        level = np.average(settled.mean, axis=0, weights=settled.count) if len(settled) else bins.mean[-1]
        total[k, where] += share * (bins.mean - level)
        weight[k, where] += share
    curve = total / np.maximum(weight, 1e-300)
    margin = 2 * np.sqrt(noise / np.maximum(weight, 1.0))
    chosen = 0.75 * shortest
    reached = True
    for _ in range(5):
        late = edges[:-1] >= min(chosen, latest, edges[-2]) - _NEARLY
        z = curve - (curve[:, late] * weight[:, late]).sum(axis=1, keepdims=True) / weight[:, late].sum(
            axis=1, keepdims=True
        )
        z = np.where(weight > 0, z, 0.0)
        over = np.zeros(len(edges) - 1, dtype=np.bool_)
        for kind, stated in limit.items():
            index = [i for i, axis in enumerate(axes) if axis.startswith(kind)]
            if index:
                threshold = stated if stated > 0 else -stated * np.abs(z[:, :, index]).max()
                over |= (np.abs(z[:, :, index]) - margin[:, :, index] > threshold).any(axis=(0, 2))
        above = edges[1:][over & (edges[:-1] < latest)]
        first = 10.0 * np.ceil((above[-1] if above.size else edges[1]) / 10)
        first = max(first, 3.0 * _FEWEST)
        reached = first < latest and not (over & (edges[:-1] >= latest)).any()
        first = min(first, latest)
        if abs(first - chosen) < 1:
            break
        chosen = first
    return float(min(chosen, latest)), reached
