"""The elements of a gyro array: columns, clocks, stretches at rest, and faults.

One axis: columns ``gyro_1 .. gyro_n``. Three axes: ``gyro_x_1 .. gyro_z_n``. ``z_i = A_i w + b_i``: reading z of
element i, body rate w, bias b; the record holds ``M_i = A_i^-1`` so that ``w = M_i (z_i - b_i)``.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from imulab.columns import shared_unit
from imulab.display import Bad, Finding, Note, prefixed
from imulab.errors import DataError, RecordError, UnitError
from imulab.estimation.clock import GAP, read_clock
from imulab.estimation.rows import resolution
from imulab.estimation.sampling import KILOHERTZ_IN_MS, mend_stamps, mislabelled, usual_step
from imulab.procedures.gyro_array.schema import array_of
from imulab.recording import Array, Recording, check_finite, check_time, joined
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor, from_si, parse_unit

# Columns of the elements, and what a record states of them.


FEWEST_ROBUST = 3  # elements among which one can be outvoted
SOURCE_RATES = (50.0, 200.0)
"""Sampling rates for which the source states its recursion, Hz."""
MOST_ELEMENTS = 64  # IL_ARRAY_ELEMENTS of the largest configuration of the C core
_ELEMENT = re.compile(r"gyro_(?:([xyz])_)?([1-9][0-9]*)")
_MISNUMBERED = re.compile(r"gyro_(?:[xyz]_)?0[0-9]*")


@dataclass(frozen=True)
class Elements:
    """The elements of an array in a recording.

    Attributes
    ----------
    names
        Column names, axis by axis, each of n elements.
    units
        Unit of each axis.
    axes
        ``("",)`` for one axis, ``("x", "y", "z")`` for three.
    """

    names: tuple[tuple[str, ...], ...]
    units: tuple[str, ...]
    axes: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of elements on each axis."""
        return len(self.names[0])

    def rate_names(self) -> list[str]:
        """Return the names of the fused columns: ``rate``, or ``rate_x rate_y rate_z``."""
        return [f"rate_{axis}" if axis else "rate" for axis in self.axes]

    def readings(self, recording: Recording, rows: slice = slice(None)) -> Array:
        """Return the readings as logged, of all rows or some, shape (m, axes, n), C-contiguous."""
        out = np.empty((len(range(len(recording))[rows]), len(self.axes), self.count))
        for a, row in enumerate(self.names):
            for i, name in enumerate(row):
                out[:, a, i] = recording.columns[name][rows]
        return out

    def truth(self, recording: Recording) -> Array | None:
        """Return the columns ``truth_rate`` (or ``truth_rate_x`` ..) in the unit of the readings, shape (m, axes).

        Raises
        ------
        DataError
            There is a truth for some axes only.
        UnitError
            The truth has a unit that cannot be converted to the readings'.
        """
        names = [f"truth_{name}" for name in self.rate_names()]
        there = [name for name in names if name in recording]
        if not there:
            return None
        if len(there) < len(names):
            missing = next(name for name in names if name not in there)
            raise DataError(f"{recording.name}: column {there[0]} without {missing}; expected {' '.join(names)}")
        columns = []
        for name, unit in zip(names, self.units, strict=True):
            try:
                factor = conversion_factor(recording.units[name], unit)
            except UnitError as error:
                raise UnitError(f"{recording.name}: column {name}: {error}") from None
            columns.append(recording.columns[name] * factor)
        return np.column_stack(columns)


def find_elements(recording: Recording) -> Elements:
    """Return the elements of a recording, found by their column names.

    Raises
    ------
    DataError
        There are no elements, numbers are missing or do not begin with 1, or axes have different numbers of elements.
    UnitError
        The elements of an axis have different units.
    """
    by_axis: dict[str, dict[int, str]] = {}
    for name in recording.columns:
        match = _ELEMENT.fullmatch(name)
        if match:
            by_axis.setdefault(match[1] or "", {})[int(match[2])] = name
        elif _MISNUMBERED.fullmatch(name):
            raise DataError(f"{recording.name}: column {name}: expected elements numbered 1 2 3 ..")
    if not by_axis:
        raise recording.lacking("columns gyro_1 gyro_2 .. (one axis) or gyro_x_1 .. gyro_z_n (three)", "gyro_1")
    if "" in by_axis and len(by_axis) > 1:
        raise DataError(
            f"{recording.name}: both {by_axis[''][min(by_axis[''])]} and columns by axis; expected one form"
        )
    axes = ("",) if "" in by_axis else ("x", "y", "z")
    stem = {axis: f"gyro_{axis}_" if axis else "gyro_" for axis in axes}
    count = max(max(numbers) for numbers in by_axis.values())
    if count > MOST_ELEMENTS:
        raise DataError(f"{recording.name}: {count} elements; expected {MOST_ELEMENTS} at most")
    for axis in axes:
        for number in range(1, count + 1):
            if number not in by_axis.get(axis, {}):
                raise DataError(
                    f"{recording.name}: no column {stem[axis]}{number}; expected {count} elements on each axis, "
                    "numbered from 1"
                )
    names = tuple(tuple(by_axis[axis][i] for i in range(1, count + 1)) for axis in axes)
    units = tuple(
        shared_unit({name: recording.units[name] for name in row}, "the elements of an axis", recording.name)
        for row in names
    )
    return Elements(names, units, axes)


@dataclass(frozen=True)
class ArrayCalibration:
    """The calibration of an array, in the unit of the readings.

    Attributes
    ----------
    bias
        Mean at rest, with the part common to all elements, shape (axes, n).
    matrices
        Shape (n, axes, axes), or None without a calibration in motion.
    weights
        Fixed weights ``C^-1 1 / (1' C^-1 1)``, shape (axes, n).
    white, walk
        Angle random walk, unit s^1/2 (`ArrayRecord.white_noise`), and rate random walk, unit s^-1/2, 0 where it is not
        determined, shape (axes, n).
    """

    bias: Array
    matrices: Array | None
    weights: Array
    white: Array
    walk: Array


def feedback_notes(count: int, rate: float) -> list[str]:
    """Return notes on method `feedback` for this number of gyros on each axis and sampling rate, Hz."""
    notes: list[str] = []
    if count <= FEWEST_ROBUST:
        notes.append(
            Note(
                f"method feedback with {count} gyro{'s' * (count > 1)} on each axis: its source states it for more "
                f"than {FEWEST_ROBUST}" + ", and no gyro stands out from so few" * (count < FEWEST_ROBUST)
            )
        )
    low, high = SOURCE_RATES
    if not 0.99 * low <= rate <= 1.01 * high:
        notes.append(
            Note(
                f"method feedback at {rate:.6g} Hz: its source states it for {low:g} to {high:g} Hz, and its memory "
                "counts samples"
            )
        )
    return notes


def check_calibration(record: Calibration, name: str = "the record") -> None:
    """Refuse a record, of this file name, that is not an array calibration.

    Raises
    ------
    RecordError
        It is of another procedure, or of a comparison.
    """
    if record.procedure != "gyro_array" or record.model.get("kind") != "calibration":
        what = record.model.get("kind", record.procedure) if record.procedure == "gyro_array" else record.procedure
        other = "whole IMUs, which 'imulab array fuse --imus' takes" if what == "imus" else f"a {what}"
        raise RecordError(f"{name}: expected the record of an array calibration, found one of {other}")


def array_calibration(record: Calibration, elements: Elements, recording: str = "recording") -> ArrayCalibration:
    """Return the calibration in a record for the elements of a recording of this name.

    Raises
    ------
    RecordError
        The record is of another procedure, or of another number of elements or axes.
    UnitError
        The readings are not rates.
    """
    check_calibration(record)
    held = array_of(record)
    listed, axes = held.elements, len(held.model.axes)
    if len(listed) != elements.count or axes != len(elements.axes):
        raise RecordError(
            f"{recording}: {elements.count} gyros on {count_of_axes(len(elements.axes))}; "
            f"the record of the calibration holds {len(listed)} on {count_of_axes(axes)}"
        )
    for row, unit in zip(elements.names, elements.units, strict=True):
        if parse_unit(unit).quantity != "rate":
            raise UnitError(f"{recording}: column {row[0]} is in {unit}; the record of the calibration is in rad/s")

    def of(values: Array) -> Array:
        return np.array([from_si(row, unit) for row, unit in zip(values, elements.units, strict=True)])

    matrices = None
    if held.model.aligned:
        matrices = np.array([element.alignment for element in listed])
        size = np.array([conversion_factor("rad/s", unit) for unit in elements.units])
        matrices *= size[:, None] / size[None, :]
    return ArrayCalibration(
        bias=of(np.array([element.bias.values for element in listed]).T),
        matrices=matrices,
        weights=np.array(held.correlation.weights),
        white=of(held.white_noise),
        walk=of(np.nan_to_num(np.array([element.rate_random_walk.values for element in listed]).T)),
    )


def count_of_axes(count: int) -> str:
    """Return ``1 axis`` or ``3 axes``, for messages."""
    return "1 axis" if count == 1 else f"{count} axes"


def fixed_weights(covariance: Array) -> tuple[Array, float]:
    """Return the weights ``C^-1 1 / (1' C^-1 1)`` and the limit ``(1' C^-1 1)^-1/2`` of a covariance, shape (n, n).

    Source: Vaccaro and Zaki, Sensors 17 (2017).
    """
    ones = np.ones(len(covariance))
    raw = np.linalg.solve(covariance, ones)
    return raw / raw.sum(), float(raw.sum() ** -0.5)


def unit_of_angle(unit: str) -> tuple[str, float]:
    """Return the unit of angles for a unit of rates, and the factor from that rate times s to it."""
    known = parse_unit(unit).symbol
    return {"deg/s": ("deg", 1.0), "rad/s": ("rad", 1.0), "deg/h": ("deg", 1 / 3600)}.get(known, (f"{known} s", 1.0))


# Clocks: elements with their own times, brought to one time; gaps in time.


_MOST_OFFSET = 0.5  # s between the time of an element and of its row
_TO_ESTIMATE = 16  # steps that show the usual one
_MOST_NAMED = 3  # gaps that a warning names


@dataclass
class SampleClock:
    """Time over the blocks of a recording: the sampling rate of its beginning, gaps, and order."""

    nominal: float | None = None
    steps: list[float] = field(default_factory=list)
    last: float | None = None
    count: int = 0
    total: float = 0.0
    gaps: list[str] = field(default_factory=list)
    begin: float = 0.0
    block: Recording | None = None

    def watch(self, block: Recording) -> None:
        """Check that a block's time follows the block before, and note gaps.

        Raises
        ------
        DataError
            There is no time column, or time stands still or runs backwards.
        """
        if "time" not in block:
            block.column("time")  # raises the message of a missing column
        time = check_time(block)
        if not len(time):
            return
        if self.last is not None and not time[0] > self.last:
            raise DataError(
                f"{block.name}: {block.place(0)}, column time: time runs backwards: expected more than "
                f"{self.last:.15g} s, found {time[0]:.15g} s"
            )
        known = time if self.last is None else np.concatenate([[self.last], time])
        step = np.diff(known)
        if len(self.steps) < _TO_ESTIMATE:
            self.steps += step[: _TO_ESTIMATE - len(self.steps)].tolist()
        if self.steps:
            longest = usual_step(np.array(self.steps))[1] if self.nominal is None else GAP / self.nominal
            wide = np.flatnonzero(step > longest)
            if wide.size:  # a late stamp whose followers catch up is no gap
                wide = np.intersect1d(wide, read_clock(known).gaps)
            for index in wide.tolist():
                self.count += 1
                self.total += float(step[index])
                if len(self.gaps) < _MOST_NAMED:
                    row = index + (0 if self.last is not None else 1)
                    self.gaps.append(
                        f"a gap of {step[index]:.6g} s before {block.place(row)} at {known[index + 1]:.6g} s"
                    )
        if self.last is None:
            self.begin = float(time[0])
        self.last, self.block = float(time[-1]), block

    @property
    def rate(self) -> float:
        """Sampling rate, Hz: as stated, or from the first steps of time; 100 while there are none."""
        if self.nominal is not None:
            return self.nominal
        return 1 / usual_step(np.array(self.steps))[0] if self.steps else 100.0

    @property
    def settled(self) -> bool:
        """Whether further blocks can no longer change `rate`."""
        return self.nominal is not None or len(self.steps) >= _TO_ESTIMATE

    def lines(self, name: str) -> list[str]:
        """Return messages on gaps, and the question whether the unit of time is right."""
        odd: list[str] = []
        if self.block is not None and self.last is not None and self.steps and self.nominal is None:
            odd = mislabelled(self.block, self.rate, self.begin, self.last - self.begin, least=KILOHERTZ_IN_MS)
        gaps = list(self.gaps)
        if self.count > len(gaps):
            gaps.append(f"{self.count - len(gaps)} more gaps; {self.total:.6g} s in all {self.count} together")
        lost = [Finding(f"{name}: {gap}", "record again without lost samples") for gap in gaps]
        return [*lost, *(prefixed(name, line) for line in odd)]


def find_clocks(recording: Recording) -> dict[int, str]:
    """Return the columns ``time_1 .. time_n`` of elements with their own clocks, by element."""
    clocks = {}
    for name in recording.columns:
        number = name.removeprefix("time_")
        if number != name and number.isdecimal():
            clocks[int(number)] = name
    return clocks


def to_one_clock(blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Yield blocks with all elements interpolated from their clocks (columns ``time_i``) to the column ``time``.

    Interpolation is linear. Rows before an element's first sample or after its last are dropped.

    Raises
    ------
    DataError
        A clock stands still or runs backwards, or is more than half a second away from ``time``.
    """
    held: Recording | None = None
    until = -np.inf  # time of the last row that was yielded
    for block in blocks:
        clocks = find_clocks(block)
        if not clocks:
            yield block
            continue
        if "time" not in block:
            raise DataError(f"{block.name}: columns time_1 .. but no column time; expected the clock to interpolate to")
        pending = block if held is None else joined([held, block])
        time, element_times = check_time(pending), _clock_times(pending, clocks)
        start, stop = max(t[0] for t in element_times.values()), min(t[-1] for t in element_times.values())
        ready = np.flatnonzero((time > until) & (time >= start) & (time <= stop))
        if ready.size:
            until = float(time[ready[-1]])
            yield _interpolate(pending, time[ready], element_times, clocks, ready)
        keep = min(int(np.searchsorted(t, until, side="right")) - 1 for t in (*element_times.values(), time))
        held = _rows(pending, np.arange(max(keep, 0), len(time)))


def on_one_clock(recording: Recording) -> Recording:
    """Return a whole recording with its elements interpolated to the column ``time``; errors as for `to_one_clock`.

    Raises
    ------
    DataError
        The clocks have no time in common.
    """
    for block in to_one_clock([mend_stamps(recording)]):
        return block
    raise DataError(f"{recording.name}: the clocks of the elements have no time in common with column time")


def _clock_times(recording: Recording, clocks: dict[int, str]) -> dict[int, Array]:
    times: dict[int, Array] = {}
    time = recording.si("time")
    for number, name in clocks.items():
        check_finite(recording, [name])
        times[number] = recording.si(name)
        step = np.diff(times[number])
        if step.size and step.min() <= 0:
            place = recording.place(int(np.argmax(step <= 0)) + 1)
            raise DataError(f"{recording.name}: {place}, column {name}: the clock runs backwards or stands still")
        apart = np.abs(times[number] - time)
        if apart.max() > _MOST_OFFSET:
            index = int(np.argmax(apart))
            raise DataError(
                f"{recording.name}: {recording.place(index)}, column {name}: the clocks disagree: "
                f"{times[number][index]:.9g} s where time is {time[index]:.9g} s; expected less than {_MOST_OFFSET} s "
                "apart"
            )
    return times


def _interpolate(
    block: Recording, time: Array, element_times: dict[int, Array], clocks: dict[int, str], ready: np.ndarray
) -> Recording:
    columns = {name: values[ready] for name, values in block.columns.items() if name not in clocks.values()}
    for name in columns:
        stem, _, number = name.rpartition("_")
        if stem.startswith("gyro") and number.isdecimal() and int(number) in element_times:
            columns[name] = np.interp(time, element_times[int(number)], block.columns[name])
    units = {name: block.units[name] for name in columns}
    return replace(block, columns=columns, units=units, first_row=block.first_row + int(ready[0]))


def _rows(block: Recording, index: np.ndarray) -> Recording:
    columns = {name: values[index] for name, values in block.columns.items()}
    return replace(block, columns=columns, first_row=block.first_row + (int(index[0]) if index.size else 0))


# Health: what happened to each gyro during fusion.


NON_FINITE, GATED, STUCK, JUMPED, EXCLUDED, QUIET, HELD, ALONE = (1 << bit for bit in range(8))
"""Flags of a gyro in a sample, as the C core sets them."""
_KINDS = (
    (NON_FINITE, "non-finite"),
    (STUCK, "stuck"),
    (HELD, "held (end of its range?)"),
    (JUMPED, "jumped"),
    (EXCLUDED, "excluded"),
)


@dataclass
class HealthEvent:
    """State of a gyro: in how many samples, and when first, s."""

    samples: int
    first: float


@dataclass
class Health:
    """Numbers of flags of each gyro over the blocks of a recording."""

    names: Sequence[Sequence[str]]
    total: int = 0
    lost: int = 0
    few: int = 0
    events: dict[tuple[int, int, str], HealthEvent] = field(default_factory=dict)

    def watch(self, time: np.ndarray, flags: np.ndarray | None, rate: np.ndarray) -> list[tuple[int, int, str]]:
        """Count the flags (m, axes, n) of a block; return the states that are new: axis, element and kind."""
        self.total += len(time)
        self.lost += int(np.isnan(rate).any(axis=1).sum())
        new: list[tuple[int, int, str]] = []
        if flags is None or not flags.any():
            return new
        self.few += int((flags & ALONE).any(axis=(1, 2)).sum()) - int(np.isnan(rate).any(axis=1).sum())
        any_flag = np.bitwise_or.reduce(flags, axis=0)
        for a, i in zip(*np.nonzero(any_flag), strict=True):
            for bit, kind in _KINDS:
                if not any_flag[a, i] & bit:
                    continue
                held = (flags[:, a, i] & bit) > 0
                key = (int(a), int(i), kind)
                event = self.events.get(key)
                if event is None:
                    self.events[key] = HealthEvent(int(held.sum()), float(time[int(np.argmax(held))]))
                    new.append(key)
                else:
                    event.samples += int(held.sum())
        return new

    def first(self, key: tuple[int, int, str]) -> str:
        """Return a line on the first time of a state of a gyro."""
        axis, element, kind = key
        return f"{self.names[axis][element]}: {kind} at {self.events[key].first:.6g} s"

    def stuck(self) -> set[str]:
        """Return the columns of the gyros that were stuck at any time."""
        return {self.names[a][i] for a, i, kind in self.events if kind == "stuck"}

    def lines(self) -> list[str]:
        """Return a line for each gyro that was excluded, stuck, jumped or not finite, and one where none was left."""
        lines: list[str] = []
        gyros = sorted({(a, i) for a, i, _ in self.events})
        for a, i in gyros:
            parts = [
                f"{kind} {_samples(event.samples)} from {event.first:.6g} s"
                for _, kind in _KINDS
                if (event := self.events.get((a, i, kind))) is not None
            ]
            text = f"{self.names[a][i]}: {'; '.join(parts)} (of {_samples(self.total)})"
            lines.append(Finding(text, "check supply, link and range of this gyro"))
        action = "check supply and link of the gyros that were excluded"
        if self.few > 0:
            text = f"fewer than three gyros left in {_samples(self.few)}: nothing to compare with, equal weights there"
            lines.append(Finding(text, action))
        if self.lost:
            lines.append(Finding(f"no gyro left in {_samples(self.lost)}: the output is nan there", action))
        return lines


def _samples(count: int) -> str:
    return f"{count} sample{'' if count == 1 else 's'}"


# Checks before any alignment: dead gyros, mixed units, elements mounted otherwise.


_FEWEST = 100  # samples
_EVERY_ROW, _THINNED = 20_000, 16  # rows that are all used; beyond them one in so many
_FOLLOWS = 0.81
"""Share of a gyro's variance that the first element must explain: a correlation of 0.9."""
_ONE_AXIS = 0.8  # of the explained share
_APART = 20.0  # times: groups of elements whose readings differ by more have different units
_WITHIN = 8.0  # times: largest ratio within such a group
UNIT_FACTORS = {
    180 / math.pi: "rad/s labelled deg/s, or the other way round",
    3600.0: "deg/h labelled deg/s, or the other way round",
    3600 * 180 / math.pi: "rad/s labelled deg/h, or the other way round",
    1000.0: "thousandths, or the other way round",
}
NEAR_UNIT = 1.6  # times: a ratio this near to that of two units is that of these units
_UNTURNED = "array calibrate --moving finds it, and --calibration puts it right"

Map = tuple[tuple[int, int] | None, ...]
"""For each axis of an element: the axis of the reference that it reads, and the sign; None where motion is small."""


@dataclass
class Checks:
    """Statistics of the readings of an array, block by block."""

    names: Sequence[Sequence[str]]
    row_count: int = 0
    count: int = 0
    moments: list[Array] = field(default_factory=list)
    pivot: Array | None = None
    last: Array | None = None
    first: Array | None = None
    still: np.ndarray | None = None
    twins: list[tuple[int, int]] | None = None

    def watch(self, readings: Array) -> None:
        """Add readings, shape (m, axes, n); rows with a reading that is not finite do not enter the moments.

        The moments are of every row of the first 20,000, and of every 16th beyond them.
        """
        rows, axes, n = readings.shape
        if not rows:
            return
        flat = readings.reshape(rows, axes * n)
        self._watch_still(flat)
        self._watch_twins(flat, n)
        every = min(max(_EVERY_ROW - self.row_count, 0), rows)
        thinned = np.arange(every + -(self.row_count + every) % _THINNED, rows, _THINNED)
        chosen = np.concatenate([np.arange(every), thinned])
        self.row_count += rows
        if not chosen.size:
            self.last = flat[-1]
            return
        before = flat[np.maximum(chosen - 1, 0)]
        if chosen[0] == 0:
            before[0] = np.nan if self.last is None else self.last
        self.last = flat[-1]
        part = flat[chosen]
        fine = np.isfinite(part).all(axis=1)
        part = part[fine]
        step = part - before[fine]
        if not len(part):
            return
        if self.pivot is None:
            self.pivot = part[0]  # about it, the moments of a constant are exactly zero
        part = part - self.pivot
        step[~np.isfinite(step).all(axis=1)] = 0.0
        moments = [
            part.sum(axis=0).reshape(axes, n),
            np.einsum("mk,mk->k", part, part).reshape(axes, n),
            (part.T @ part[:, ::n]).reshape(axes, n, axes),
            np.einsum("mk,mk->k", step, step).reshape(axes, n),
        ]
        self.moments = [a + b for a, b in zip(self.moments, moments, strict=True)] if self.moments else moments
        self.count += len(part)

    def _watch_still(self, flat: Array) -> None:
        """Keep the gyros that have repeated one number so far."""
        if self.still is None or self.first is None:
            self.still, self.first = np.ones(flat.shape[1], dtype=bool), np.full(flat.shape[1], np.nan)
        self.still &= ~(np.abs(flat[-1] - flat[0]) > 0)  # most gyros need no more than two readings
        for k in np.flatnonzero(self.still).tolist():
            column = flat[np.isfinite(flat[:, k]), k]
            if len(column):
                self.first[k] = column[0] if np.isnan(self.first[k]) else self.first[k]
                self.still[k] = bool((column == self.first[k]).all())

    def _watch_twins(self, flat: Array, n: int) -> None:
        """Keep the pairs of an axis with the same readings so far, by their places among the columns."""
        if self.twins is None:
            self.twins = [(i, j) for i in range(flat.shape[1]) for j in range(i + 1, (i // n + 1) * n)]
        self.twins = [
            (i, j)
            for i, j in self.twins
            if np.array_equal(flat[:1, i], flat[:1, j], equal_nan=True)
            and np.array_equal(flat[:, i], flat[:, j], equal_nan=True)
        ]

    def lines(self, *, turned: bool = True, known: Collection[str] = ()) -> list[str]:
        """Return messages on all checks; on `turned` elements only if asked, and not on dead gyros already `known`."""
        lines = self.dead(known) + self.doubled() + self.units()
        if turned:
            lines += [
                Finding(
                    f"{line}: mounted the other way round? {_UNTURNED}",
                    "check the mounting of this gyro, and correct the sign of its column",
                )
                for line in self.turned()
            ]
        return lines

    def dead(self, known: Collection[str] = ()) -> list[str]:
        """Return messages on gyros whose readings never change, and on axes on which no reading changes."""
        if self.still is None or self.first is None or self.row_count < _FEWEST:
            return []
        still = (self.still & np.isfinite(self.first)).reshape(len(self.names), -1)
        messages: list[str] = []
        for row, dead in zip(self.names, still, strict=True):
            named = [name for name, gone in zip(row, dead, strict=True) if gone]
            if len(named) == len(row):
                messages.append(
                    Bad(
                        f"{_listed(named)}: no reading ever changes: all gyros are dead, and so is the result",
                        "check supply and link of the array, and record it again",
                    )
                )
            elif set(named) - set(known):
                messages.append(
                    Finding(
                        f"{' '.join(n for n in named if n not in known)}: no reading ever changes: a dead gyro",
                        "check or replace this gyro, and record it again",
                    )
                )
        return messages

    def doubled(self) -> list[str]:
        """Return a message on gyros with the same readings throughout: one that was logged twice counts twice."""
        if self.still is None or self.first is None or self.row_count < _FEWEST:
            return []
        flat = [name for row in self.names for name in row]
        live = ~self.still
        return [
            Bad(
                f"{flat[i]} and {flat[j]} read the same throughout: one gyro, logged twice? It counts as two",
                "give each column its gyro in the log, and record it again",
            )
            for i, j in self.twins or []
            if live[i]
        ]

    def units(self) -> list[str]:
        """Return a message where the readings of an axis fall into two groups of very different size."""
        if self.count < _FEWEST:
            return []
        spread, explained = self._spread()
        messages: list[str] = []
        for a, row in enumerate(self.names):
            if len(row) < 2:
                continue
            moves = bool(np.median(explained[a]) > _FOLLOWS)
            size = spread[a] if moves else np.sqrt(self.moments[3][a] / self.count)
            alive = np.flatnonzero(size > 0)
            order = alive[np.argsort(size[alive])]
            ordered = np.log(size[order])
            if len(order) < 2:
                continue
            cut = int(np.argmax(np.diff(ordered))) + 1
            low, high = ordered[:cut], ordered[cut:]
            if high[0] - low[-1] < math.log(_APART) or max(np.ptp(low), np.ptp(high)) > math.log(_WITHIN):
                continue
            ratio = math.exp(float(high.mean() - low.mean()))
            likely = [text for factor, text in UNIT_FACTORS.items() if 1 / NEAR_UNIT < ratio / factor < NEAR_UNIT]
            smaller, larger = (" ".join(row[i] for i in sorted(part.tolist())) for part in (order[:cut], order[cut:]))
            what = "size of the readings" if moves else "noise"
            kind = Bad if moves or min(cut, len(order) - cut) > 1 else Finding
            messages.append(
                kind(
                    f"the {what} of {larger} is {ratio:.3g} times as large as that of {smaller}: another unit"
                    f"{f' ({likely[0]})' if likely else ''} or another kind of gyro? Unlike units must not be fused",
                    "correct the unit of these columns",
                )
            )
        return messages

    def turned(self) -> list[str]:
        """Return a message for each way in which elements are mounted, or wired, unlike the others."""
        maps = self.maps()
        if not maps:
            return []
        axes = len(self.names)
        plain: Map = tuple((a, 1) for a in range(axes))
        votes = Counter(axis_map for axis_map in maps if None not in axis_map)
        usual = max(votes, key=lambda axis_map: (votes[axis_map], axis_map == plain), default=plain)
        back = {axis_map: (a, axis_map[1]) for a, axis_map in enumerate(usual) if axis_map is not None}
        origin = {axis: (a, sign) for (axis, sign), (a, _) in back.items()}
        by_map: dict[Map, list[int]] = {}
        for i, axis_map in enumerate(maps):
            mapping: Map = tuple(
                None if pair is None else (origin[pair[0]][0], pair[1] * origin[pair[0]][1]) for pair in axis_map
            )
            if any(pair is not None and pair != plain[a] for a, pair in enumerate(mapping)):
                by_map.setdefault(mapping, []).append(i)
        others = "first gyro of the axis" if usual == plain else "other gyros of the axis"
        lines: list[str] = []
        for mapping, elements in by_map.items():
            if axes == 1:
                verb = "turns" if len(elements) == 1 else "turn"
                lines.append(f"{' '.join(self.names[0][i] for i in elements)} {verb} against the {others}")
                continue
            numbers = " ".join(str(i + 1) for i in elements)
            reads = ", ".join(
                f"{'xyz'[a]} reads {'+' if pair[1] > 0 else '-'}{'xyz'[pair[0]]}"
                for a, pair in enumerate(mapping)
                if pair is not None and pair != plain[a]
            )
            against = "the first" if usual == plain else "most elements"
            lines.append(
                f"element{'s' * (len(elements) > 1)} {numbers} ({self.names[0][elements[0]]} ..): {reads} of {against}"
                f"{_mirrored(mapping)}"
            )
        return lines

    def maps(self) -> list[Map]:
        """Return, for each element, the axes of the first element that its axes read, where motion shows it."""
        turns = self.regression()
        if turns is None:
            return []
        axes, n = self.moments[0].shape
        weights, follows, variance = turns
        shares = weights**2 * variance
        axis_maps: list[Map] = []
        for i in range(n):
            row: list[tuple[int, int] | None] = []
            for a in range(axes):
                axis = int(np.argmax(shares[a, i]))
                sure = follows[a, i] and shares[a, i, axis] > _ONE_AXIS * shares[a, i].sum()
                row.append((axis, 1 if weights[a, i, axis] > 0 else -1) if sure else None)
            read = [pair[0] for pair in row if pair is not None]
            axis_maps.append(tuple(row) if len(set(read)) == len(read) else (None,) * axes)
        return axis_maps

    def regression(self) -> tuple[Array, np.ndarray, Array] | None:
        """Return weights of element 1's axes in each gyro, (axes, n, axes), and whether they explain it, (axes, n).

        And the variance of element 1's axes, shape (axes,); None of too few samples.
        """
        if self.count < _FEWEST or not np.isfinite(self.moments[1]).all():
            return None
        axes, n = self.moments[0].shape
        variance, cross = self._covariance()
        weights = np.linalg.lstsq(_regular(cross[:, 0]), np.moveaxis(cross, 2, 0).reshape(axes, -1), rcond=None)[0]
        weights = np.moveaxis(weights.reshape(axes, axes, n), 0, 2)
        explained = np.einsum("aib,aib->ai", weights, cross)
        return np.asarray(weights), (variance > 0) & (explained > _FOLLOWS * variance), variance[:, 0]

    def _covariance(self) -> tuple[Array, Array]:
        """Return the variance of each gyro, (axes, n), and the covariance with element 1's axes, (axes, n, axes)."""
        mean, square, product = (moment / self.count for moment in self.moments[:3])
        variance = np.maximum(square - mean * mean, 0.0)
        return variance, product - mean[:, :, None] * mean[None, None, :, 0]

    def _spread(self) -> tuple[Array, Array]:
        """Return the standard deviation of each gyro, (axes, n), and the share that an axis of element 1 explains."""
        variance, cross = self._covariance()
        both = variance[:, :, None] * variance[None, None, :, 0]
        share = np.where(both > 0, cross**2 / np.where(both > 0, both, 1.0), 0.0).max(axis=2)
        return np.sqrt(variance), share[:, 1:]


def _regular(matrix: Array) -> Array:
    return matrix + 1e-9 * max(float(np.trace(matrix)), 1e-300) * np.eye(len(matrix))


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def _mirrored(mapping: Map) -> str:
    """Return an addition to a message where a map is left-handed."""
    if any(pair is None for pair in mapping):
        return ""
    matrix = np.zeros((len(mapping), len(mapping)))
    for a, pair in enumerate(mapping):
        if pair is not None:
            matrix[a, pair[0]] = pair[1]
    return (
        " (left-handed, which no mounting does: columns interchanged or reversed)" if np.linalg.det(matrix) < 0 else ""
    )


# Rest: stretches in which no element moves, and all elements together show no motion, however they are mounted.


_WINDOW = 1.0  # s
_FEWEST_WINDOWS = 12  # of a recording
_SMALLEST_WINDOW = 8  # samples
_QUIETEST = 0.1  # quantile of the windows' scatter that is usual at rest
_QUIET_FACTOR = 3.0  # times the usual scatter up to which a window is quiet
_STEP_NOISE = 0.29
"""Least standard deviation that rounding makes, in steps of the output."""
_DRIFT = math.radians(1.0)
"""Largest change of the zero of a gyro at rest within one recording, rad/s."""
_SHORTEST = 5  # windows
_TOGETHER = 10.0  # times the elements' own scatter: more common motion means that the array turned
_ALIKE = 1.25  # between quartiles of the elements: a common part of more unlike sizes is no motion
_STEADY, _STEADY_SPREAD = math.radians(5.0), 0.1
_LARGEST_ZERO = math.radians(100.0)
_MOST_SAMPLES = 20_000  # samples in which a fast motion is looked for
ROWS_AT_ONCE = 1 << 16
"""Rows of an array that are looked at together: those of a long log do not fit in memory as one array."""


@dataclass(frozen=True)
class ArrayRest:
    """A stretch at rest: first sample, last + 1, and what moved first outside it ("" if it is the whole recording)."""

    start: int
    stop: int
    moved: str = ""


def find_rest(
    readings: Callable[[slice], Array], count: int, rate: float, names: Sequence[Sequence[str]], name: str
) -> ArrayRest:
    """Return the longest stretch in which an array is at rest.

    A window of a second is quiet where the standard deviation of every gyro is at most 3 times that of its quietest
    windows (a tenth of all; rounding counts), and its mean within 1 deg/s of the median of the quiet ones. Then the
    whole stretch is at rest unless its elements move together (`common_motion`), or read a rate that no zero has.

    Parameters
    ----------
    readings
        Returns those of some rows, shape (m, axes, n), rad/s.
    count
        Number of rows.
    rate
        Sampling rate, Hz.
    names
        Columns by axis and element, for messages.
    name
        The recording's name, for messages.

    Raises
    ------
    DataError
        No stretch of five windows is quiet, or the quiet one moves.
    """
    size = max(_SMALLEST_WINDOW, min(round(_WINDOW * rate), count // _FEWEST_WINDOWS))
    spread, mean = _window_statistics(readings, count // size, size)
    usual = np.quantile(spread, _QUIETEST, axis=0)
    steps = np.apply_along_axis(resolution, 0, readings(slice(_MOST_SAMPLES)))
    usual = np.maximum(usual, _STEP_NOISE * steps)
    loud = spread > _QUIET_FACTOR * usual
    calm = ~loud.any(axis=(1, 2))
    centre = np.median(mean[calm] if calm.any() else mean, axis=0)
    away = np.abs(mean - centre) > np.maximum(_DRIFT, _SHORTEST * usual / math.sqrt(size))
    restless = loud | away
    edges = np.diff(np.concatenate([[0], (~restless.any(axis=(1, 2))).astype(int), [0]]))
    runs = np.flatnonzero(edges).reshape(-1, 2)
    first, last = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))].tolist() if len(runs) else (0, 0)
    if last - first < _SHORTEST:
        moves, ratio = common_motion(mean - mean.mean(axis=0), usual / math.sqrt(size))
        if ratio > _TOGETHER:
            raise DataError(_motion_message(name, moves, ratio))
        raise DataError(
            f"{name}: no stretch of {_SHORTEST * size / rate:.3g} s at rest: "
            f"{_restless_message(restless, spread, mean - centre, names, size / rate)}; expected a recording at rest"
        )
    start, stop = first * size, count if last == len(mean) else last * size
    _refuse_motion(readings(slice(start, min(stop, start + _MOST_SAMPLES))), mean[first:last], usual, size, names, name)
    if (start, stop) == (0, count):
        return ArrayRest(0, count)
    return ArrayRest(start, stop, _restless_message(restless, spread, mean - centre, names, size / rate))


def _window_statistics(readings: Callable[[slice], Array], count: int, size: int) -> tuple[Array, Array]:
    """Return standard deviation and mean of so many windows of `size` rows, shapes (count, axes, n)."""
    spread, mean = [], []
    at_once = max(1, ROWS_AT_ONCE // size)
    for first in range(0, count, at_once):
        part = readings(slice(first * size, min(first + at_once, count) * size))
        windows = part.reshape(-1, size, *part.shape[1:])
        mean.append(windows.mean(axis=1))
        off = windows - mean[-1][:, None]
        spread.append(np.sqrt(np.einsum("wkan,wkan->wan", off, off) / size))
    return np.concatenate(spread), np.concatenate(mean)


def common_motion(off: Array, noise: Array) -> tuple[float, float]:
    """Return the common motion of the elements of an array, rms, and its ratio to their individual scatter.

    The largest eigenvectors of the covariance, as many as there are axes, whitened by `noise`, contain what all
    elements see of one motion, whatever their orientation and sign. A ratio that a quarter of the elements does not
    reach does not count; neither does a common part of unlike sizes, as of a common temperature.

    Parameters
    ----------
    off
        Readings, or their means, less their mean over time, shape (m, axes, n).
    noise
        Their standard deviation at rest, shape (axes, n).
    """
    count, axes, n = off.shape
    scale = np.maximum(noise, 1e-300).reshape(-1)
    flat = off.reshape(count, -1) / scale
    _, vectors = np.linalg.eigh(flat.T @ flat)
    shared = vectors[:, -axes:]
    common = flat @ shared @ shared.T
    common_rms = np.sqrt(np.mean(((common * scale).reshape(count, axes, n)) ** 2, axis=0).sum(axis=0) / axes)
    apart = np.sqrt(np.mean((((flat - common) * scale).reshape(count, axes, n)) ** 2, axis=0).sum(axis=0) / axes)
    low, high = np.quantile(common_rms, [0.25, 0.75])
    if high > _ALIKE * low:
        return float(np.median(common_rms)), 0.0
    ratio = np.sort(common_rms / np.maximum(apart, 1e-300))[(n - 1) // 4]
    return float(np.median(common_rms)), float(ratio)


def _refuse_motion(
    readings: Array, mean: Array, usual: Array, size: int, names: Sequence[Sequence[str]], name: str
) -> None:
    """Refuse a quiet stretch whose elements move together, or that turns steadily; `readings` are its first."""
    slow = common_motion(mean - mean.mean(axis=0), usual / math.sqrt(size))
    part = readings[: len(readings) // size * size]
    blocks = part.reshape(-1, size, *part.shape[1:])
    fast = common_motion((blocks - blocks.mean(axis=1, keepdims=True)).reshape(part.shape), usual)
    moves, ratio = max(slow, fast, key=lambda pair: pair[1])
    if ratio > _TOGETHER:
        raise DataError(_motion_message(name, moves, ratio))
    steady = mean.mean(axis=0)
    rates = np.sqrt((steady**2).sum(axis=0))
    low, middle, high = np.quantile(rates, [0.0, 0.5, 1.0])
    if len(rates) > 2 and middle > _STEADY and high - low < _STEADY_SPREAD * middle:
        raise DataError(
            f"{name}: all elements read {math.degrees(middle):.3g} deg/s: the array turns steadily; expected a "
            "recording at rest"
        )
    worst = np.unravel_index(int(np.argmax(np.abs(steady))), steady.shape)
    if abs(steady[worst]) > _LARGEST_ZERO:
        raise DataError(
            f"{name}: column {names[int(worst[0])][int(worst[1])]}: {math.degrees(steady[worst]):.4g} deg/s on "
            f"average, which is no zero (is the unit right?); expected less than {math.degrees(_LARGEST_ZERO):.0f} "
            "deg/s at rest"
        )


def _motion_message(name: str, moves: float, ratio: float) -> str:
    return Finding(
        f"{name}: the array moves: its elements go together by {math.degrees(moves):.3g} deg/s, {ratio:.0f} times what "
        "they differ; expected a recording at rest",
        "record the array at rest",
    )


def _restless_message(
    restless: np.ndarray, spread: Array, off: Array, names: Sequence[Sequence[str]], step: float
) -> str:
    """Return the words for the gyro that moves most, its rate, and when, s from the beginning."""
    reach = np.where(restless, np.hypot(spread, off), 0.0)
    k, a, i = (int(index) for index in np.unravel_index(int(np.argmax(reach)), reach.shape))
    return f"{names[a][i]} moves by {math.degrees(reach[k, a, i]):.3g} deg/s {k * step:.3g} s after the beginning"
