"""The part of a file to read: topic, instance, element, time window."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from imulab.arguments import check_fields
from imulab.columns import check_unit, element_number, kind_of, stated_unit
from imulab.display import Note
from imulab.errors import OptionError, listed, meant, several
from imulab.quantities import FromStart, span
from imulab.recording import DAMAGED, EVERY, Array, Ends, Recording, Window, instance_number, packed
from imulab.units import parse_unit


@dataclass(frozen=True, slots=True)
class Selection:
    """The choice of a recording in a file that holds several.

    Attributes
    ----------
    topic
        ROS topic (two, separated by a comma: the accelerometer's and the gyroscope's), ULog topic or DataFlash message;
        with a comma between, a magnetometer's beside it (``sensor_mag:1``: instance 1 of these).
    instance
        Number of the sensor in a flight log, from 0; ``all`` for all of them as whole IMUs on one clock.
    window
        First and last time to read, s, each None for no bound; a text such as ``10:60`` is read.
    element
        Number of the IMU whose columns to read, from 1, in a file of several.
    units
        Units of sensors or columns, in place of those that the file says.
    damaged
        What to do with lines of text that cannot be read: one of `DAMAGED`.
    serial
        Serial number of the unit, in place of the one in the head.
    """

    topic: str | None = None
    instance: int | str | None = None
    window: Window | None = None
    element: int | None = None
    units: Mapping[str, str] | None = None
    damaged: str | None = None
    serial: str | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.damaged is not None and self.damaged not in DAMAGED:
            raise OptionError(f"damaged {self.damaged!r}: expected one of {listed(DAMAGED, self.damaged)}")
        if self.instance is not None:
            object.__setattr__(self, "instance", instance_number(self.instance, "instance"))
        if self.element is not None and self.element < 1:
            raise OptionError(f"element {self.element}: expected a number from 1")
        first, last = self.ends or (None, None)
        alike = isinstance(first, FromStart) == isinstance(last, FromStart)
        if first is not None and last is not None and alike and not first < last:
            raise OptionError(f"window {first:g}:{last:g}: expected a start before its end")

    @property
    def single(self) -> int:
        """The instance of a log that is to be read, the first if none was named."""
        return self.instance if isinstance(self.instance, int) else 0

    @property
    def ends(self) -> Ends | None:
        """First and last time of the window, s; None without one."""
        return span(self.window, "window") if isinstance(self.window, str) else self.window

    def beside(self, title: str) -> tuple[str | None, int | None]:
        """Return the topic without an entry such as ``sensor_mag:1`` of this title, and the number in that entry.

        Raises
        ------
        OptionError
            There is no number behind the colon.
        """
        entries = self.topic.split(",") if self.topic is not None else []
        mine = [entry for entry in entries if entry.partition(":")[0] == title]
        others = ",".join(entry for entry in entries if entry not in mine)
        number = mine[0].partition(":")[2] if mine else ""
        if len(mine) > 1 or not (number.isdecimal() or (mine in ([], [title]))):
            raise OptionError(f"topic {self.topic!r}: expected {title} or {title}:N once, N its instance from 0")
        return (others or None), (int(number) if number else None)

    def of(self, blocks: Iterator[Recording], name: str) -> Iterator[Recording]:
        """Yield the rows of the element within the window, with the stated units and serial number.

        Errors are those of `with_units`, `keep_element` and `windowed`.
        """
        stated = with_serial(with_units(blocks, self.units, name), self.serial)
        return windowed(keep_element(stated, self.element, name), self.ends, name)

    def refuse(self, name: str, kind: str, *, topic: bool = True, instance: bool = True) -> None:
        """Refuse choices that a kind of file cannot offer."""
        if topic and self.topic is not None:
            raise OptionError(f"{name}: {kind} has no topics to choose from; leave out the topic {self.topic!r}")
        if instance and self.instance not in (None, EVERY):
            raise OptionError(f"{name}: {kind} has no instances to choose from; leave out the instance {self.instance}")


class SharedUnits(dict[str, str]):
    """Units that a caller states for several files together, of which each takes those of its columns.

    `unused` are the names that no file had so far.
    """

    def __init__(self, units: Mapping[str, str] | None) -> None:
        super().__init__(units or {})
        self.unused = list(self)


def with_serial(blocks: Iterator[Recording], serial: str | None) -> Iterator[Recording]:
    """Yield blocks whose head has a serial number, in place of the one there, where one is stated."""
    for block in blocks:
        yield block if serial is None else replace(block, metadata={**block.metadata, "serial": serial})


def with_units(blocks: Iterator[Recording], units: Mapping[str, str] | None, name: str) -> Iterator[Recording]:
    """Yield blocks whose columns have the units that a caller states; where the file says others, a note says so.

    Raises
    ------
    OptionError
        A name is no column's and no sensor's.
    UnitError
        A unit is unknown, or of another quantity than the column.
    """
    for block in blocks:
        if not units:
            yield block
            continue
        stated = units_of_columns(block.columns, units, name)
        before = {kind_of(c) or c: (block.units[c], unit) for c, unit in stated.items() if block.units[c] != unit}
        notes = [Note(f"{key} is read in {new} as stated, not in {old}") for key, (old, new) in before.items()]
        yield replace(
            block,
            units={**block.units, **stated},
            notes=(*block.notes, *notes),
            time_stated=block.time_stated or "time" in stated,
        )


def units_of_columns(columns: Iterable[str], units: Mapping[str, str], name: str) -> dict[str, str]:
    """Return the units that a caller states by column; errors as for `with_units`."""
    columns = list(columns)
    names = dict.fromkeys(name for column in columns for name in (column, kind_of(column)) if name)
    unused = [key for key in units if key not in names]
    if isinstance(units, SharedUnits):
        units.unused = [key for key in units.unused if key in unused]
    elif unused:
        raise OptionError(
            f"{name}: unit of {unused[0]}: no such column; columns: {several(columns)}{meant(names, unused[0])}"
        )
    stated = {column: parse_unit(unit).symbol for column in columns if (unit := stated_unit(column, units))}
    for column, unit in stated.items():
        check_unit(column, unit, name)
    return stated


def windowed(blocks: Iterator[Recording], window: Ends | None, name: str) -> Iterator[Recording]:
    """Yield the rows within a time window, and stop reading after it.

    Raises
    ------
    OptionError
        The recording has no time, or nothing in the window.
    """
    if window is None:
        yield from blocks
        return
    first, last = -np.inf, np.inf
    low, high, any_row, any_time = np.inf, -np.inf, False, False
    for block in blocks:
        if "time" not in block:
            raise OptionError(f"{name}: no time column, so there is no window of it to read")
        times = {clock: block.si(clock) for clock in block.clocks}
        finite = np.concatenate([time[np.isfinite(time)] for time in times.values()])
        if finite.size and not any_time:
            any_time = True
            first, last = _from(window[0], float(finite[0]), -np.inf), _from(window[1], float(finite[0]), np.inf)
        if finite.size:
            low, high = min(low, float(finite.min())), max(high, float(finite.max()))
        if len(times) > 1:
            part = _within(block, times, first, last)
            any_row |= len(part) > 0
            yield from [part] if len(part) else []
        else:
            inside = (times["time"] >= first) & (times["time"] <= last)
            edges = np.flatnonzero(np.diff(inside, prepend=False, append=False))
            for start, stop in edges.reshape(-1, 2).tolist():
                any_row = True
                yield replace(
                    block,
                    columns={key: values[start:stop] for key, values in block.columns.items()},
                    first_row=block.first_row + start,
                )
        if any_row and finite.size and finite.min() > last:
            break
    if not any_row:
        raise OptionError(
            f"{name}: nothing in the window {_time(first)} to {_time(last)} s; the file runs from {_time(low)} to "
            f"{_time(high)} s{_from_start(low)}"
        )


def _from(end: float | None, start: float, without: float) -> float:
    """Return an end of a window as a time of the recording, whose first is `start`; `without` where there is none."""
    if end is None:
        return without
    return start + end if isinstance(end, FromStart) else end


def _time(seconds: float) -> str:
    """Return a time in six digits, or in those that show a tenth of a second."""
    return f"{seconds:.1f}" if 1e5 <= abs(seconds) < np.inf else f"{seconds:g}"


def _from_start(low: float) -> str:
    return "; a window such as +0:+60 counts from the start" if abs(low) >= 1e5 else ""


def _within(block: Recording, times: Mapping[str, Array], first: float, last: float) -> Recording:
    """Return a block of several clocks without what lies outside of a window by the clock of each sensor."""
    columns = dict(block.columns)
    for clock, names in block.clocks.items():
        outside = ~((times[clock] >= first) & (times[clock] <= last))
        for name in (clock, *names):
            columns[name] = np.where(outside, np.nan, columns[name])
    return packed(replace(block, columns=columns))


def keep_element(blocks: Iterator[Recording], element: int | None, name: str) -> Iterator[Recording]:
    """Yield the columns of one IMU of several (``accel_x_7`` as ``accel_x``), with those common to all.

    Raises
    ------
    OptionError
        The file has no columns of several IMUs, or none of this one.
    """
    if element is None:
        yield from blocks
        return
    for block in blocks:
        numbers = {column: element_number(column) for column in block.columns}
        there = sorted({number for number in numbers.values() if number is not None})
        if not there:
            raise OptionError(f"{name}: no columns of several IMUs; leave out the element {element}")
        if element not in there:
            raise OptionError(f"{name}: no element {element}; elements found: {' '.join(map(str, there))}")
        renamed = {column: column for column, number in numbers.items() if number is None}
        renamed |= {column: column.rpartition("_")[0] for column, number in numbers.items() if number == element}
        yield replace(
            block,
            columns={renamed[column]: values for column, values in block.columns.items() if column in renamed},
            units={renamed[column]: unit for column, unit in block.units.items() if column in renamed},
            metadata={**block.metadata, "element": str(element)},
        )
