"""Recordings to power cycles: the samples averaged over bins of one second, block by block.

A bin keeps the mean of the data and, for the basis functions, two instants with weights that have the same first three
moments as the times of its samples (a Gauss rule): averages of cubics over a bin are then exact, those of smooth
functions good to fourth order, and 60,000 samples cost no more than 600.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError, UnitError
from imulab.power_on import (
    LATEST_START,
    check_clock,
    check_start,
    first_reading,
    head_temperature,
    power_on_temperature,
)
from imulab.recording import Array, Recording, Source, check_finite, check_time
from imulab.units import conversion_factor, parse_unit, si_unit

BIN = 1.0
"""Width of a bin, s."""
_DAY = 86400.0
_AXIS = re.compile(r"(gyro|accel)_.+")


@dataclass(frozen=True)
class Bins:
    """Averages over bins of time: of b bins that hold samples, in order.

    Attributes
    ----------
    start
        Nominal start of each bin, s since power-on, shape (b,); a bin is at least as wide as `BIN`.
    stop
        Nominal end, s, shape (b,).
    count
        Samples, shape (b,).
    nodes, shares
        Two instants, s, and their weights (sum 1), shapes (b, 2).
    mean
        Shape (b, axes), SI, or count or V.
    variance
        Of the samples within the bin, shape (b, axes).
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

    def where(self, keep: np.ndarray) -> Bins:
        """Return some of the bins."""
        return Bins(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Cycle:
    """One power cycle of one unit.

    Attributes
    ----------
    bins
        The samples, averaged.
    axes, units
        Columns, and their units in SI (or count, V).
    temperature
        At power-on, degC.
    first, last
        Time of the first and the last sample, s since power-on.
    name, serial, sensor_model
        What messages call it; of the head of the file.
    first_reading
        First value of the column temperature, degC, or None.
    chamber
        ``chamber_temperature`` or ``set_point`` of the head of the file, degC, or None.
    source, corrected_by
        File and hash, and what it was corrected by.
    file_units
        Units of the axes as the file has them.
    zeros
        Rows left out because every axis is exactly zero in them, as where a logger writes what it has not got.
    """

    bins: Bins
    axes: tuple[str, ...]
    units: tuple[str, ...]
    temperature: float
    first: float
    last: float
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
    """Average a recording of one power cycle, or its consecutive blocks, over bins of one second.

    Parameters
    ----------
    recording
        With columns time (0 is power-on) and gyro_* or accel_*, and ``power_on_temperature`` in its head.
    latest_start
        A first sample later than this is refused, s.
    temperature_from_column
        Whether the first reading of the column temperature may stand in for a missing ``power_on_temperature``.
    source
        File and hash, for the record; that of the recording if not given.

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
    head: Recording | None = None
    axes: tuple[str, ...] = ()
    temperature, first, last, reading, zeros = np.nan, 0.0, -np.inf, None, 0
    for block in blocks:
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
        elif time[0] <= last:
            raise DataError(
                f"{block.name}: {block.place(0)}, column time: time does not rise: "
                f"expected more than {last:.9g} s, found {time[0]:.9g} s"
            )
        last = float(time[-1])
        if last > _DAY:
            raise DataError(
                f"{block.name}: {block.place(len(time) - 1)}, column time: {last:.6g} s after power-on; expected a "
                "power cycle of less than a day: are these milliseconds titled as seconds?"
            )
        here = _empty_rows(block, axes)
        zeros += int(here.sum())
        if not here.all():
            pieces.append(_accumulate(block, axes, time, ~here if here.any() else None))
    if head is None:
        raise DataError("no samples")
    if not pieces:
        raise DataError(f"{head.name}: every row is zero in {' '.join(axes)}")
    return Cycle(
        bins=_bins(pieces, [conversion_factor(head.units[axis], si_unit(head.units[axis])) for axis in axes]),
        axes=axes,
        units=tuple(si_unit(head.units[axis]) for axis in axes),
        temperature=temperature,
        first=first,
        last=last,
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


def _axes(recording: Recording) -> tuple[str, ...]:
    axes = tuple(name for name in recording.columns if _AXIS.fullmatch(name))
    if not axes:
        raise DataError(f"{recording.name}: no column gyro_* or accel_*; found {' '.join(recording.columns)}")
    for kind in ("gyro", "accel"):
        units = {name: recording.units[name] for name in axes if name.startswith(kind)}
        if len({parse_unit(unit).symbol for unit in units.values()}) > 1:
            found = ", ".join(f"{name} [{unit}]" for name, unit in units.items())
            raise UnitError(f"{recording.name}: the axes of one kind must share one unit, found {found}")
    return axes


def _power_on(recording: Recording, from_column: bool, reading: float | None) -> float:
    stated = power_on_temperature(recording)
    if stated is not None and np.isfinite(stated):
        return stated
    if from_column and reading is not None:
        return reading
    found = "no power_on_temperature in the head of the file" if stated is None else "power_on_temperature is nan"
    raise DataError(f"{recording.name}: {found}; expected a line such as '# power_on_temperature: -20'")


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


def _bins(pieces: list[tuple[np.ndarray, Array, Array]], factors: list[float]) -> Bins:
    number = np.concatenate([piece[0] for piece in pieces])
    moments = np.concatenate([piece[1] for piece in pieces])
    sums = np.concatenate([piece[2] for piece in pieces])
    if len(pieces) > 1:  # a bin that two blocks share
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
    return Bins(
        start=number * BIN,
        stop=(number + 1) * BIN,
        count=count,
        nodes=nodes + ((number + 0.5) * BIN)[:, None],
        shares=shares,
        mean=sums[:, :, 0] * factor,
        variance=sums[:, :, 1] / count[:, None] * factor**2,
    )


def gauss_nodes(moments: Array) -> tuple[Array, Array]:
    """Return two nodes and their weights, shapes (b, 2), with the given mean, mean square and mean cube (b, 3).

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


def merge(bins: Bins, edges: Array) -> Bins:
    """Return wider bins between the given times, shape (e,); bins that cross an edge or lie outside are left out.

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
    return Bins(edges[groups], edges[groups + 1], count, nodes + centre[:, None], shares, mean, variance)


def common_axes(cycles: list[Cycle]) -> tuple[str, ...]:
    """Check that all cycles have the same axes in the same units, and return the axes.

    Raises
    ------
    DataError
        A file lacks an axis, or the same file is given twice.
    UnitError
        Units differ between files; they are not converted.
    """
    first = cycles[0]
    for cycle in cycles[1:]:
        for one, other in ((cycle, first), (first, cycle)):
            missing = [axis for axis in other.axes if axis not in one.axes]
            if missing:
                raise DataError(f"{one.name}: no column {missing[0]}, which {other.name} has; --axes chooses columns")
        for axis, unit in zip(first.axes, first.file_units, strict=True):
            found = cycle.file_units[cycle.axes.index(axis)]
            if found != unit:
                raise UnitError(
                    f"{cycle.name}: column {axis} is in {found}, but in {unit} in {first.name}: "
                    "all files must share one unit"
                )
    hashes: dict[str, str] = {}
    for cycle in cycles:
        if cycle.source is not None:
            if cycle.source.sha256 in hashes:
                raise DataError(f"{cycle.name}: the same samples as {hashes[cycle.source.sha256]}: given twice")
            hashes[cycle.source.sha256] = cycle.name
    return first.axes


def with_axes(cycle: Cycle, wanted: tuple[str, ...]) -> Cycle:
    """Return a cycle with some of its axes.

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
        units=tuple(cycle.units[i] for i in index),
        file_units=tuple(cycle.file_units[i] for i in index),
    )
