"""Layout files, which describe the columns and units of foreign files, and the conversion of what is read.

Where the columns of a foreign file are, and in which units, and what was read to readings in them; `EXAMPLE` has
every key.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from imulab.columns import check_unit, expected_quantities
from imulab.errors import ReadError, UnitError, listed, meant, quoted
from imulab.files import check_keys, load_toml, number_of, scale_factor_of, unit_of, value_and_unit
from imulab.recording import Array, Layout, LayoutColumn, Recording
from imulab.units import Unit, conversion_factor, parse_unit, to_si

# Layout files; `EXAMPLE` has every key.


EXAMPLE = """\
delimiter = "whitespace"                        # or "," ";" "\\t"; without it, what the file has
decimal = "."                                   # or "," where numbers are written 9,81
header = false                                  # true: the first line names the columns
skip_lines = 0                                  # lines above the header or the data
skip_incomplete = false                         # true: rows without a reading in every column are skipped and counted
# prefix = "IMU"                                # only lines whose first field is IMU, without that field; or "Raw:"
# labelled = true                               # in place of delimiter: numbers behind their names, ax: 0.1
# marks = ["DeviceTag:"]                        # one stands above the titles, or the layout is not for the file
# encoding = "gbk"                              # of the names in the header, where they are not UTF-8
# sample_rate = { value = 100, unit = "Hz" }    # instead of time, where no column holds it
# packet = "last"                               # rows of one time are a packet: it is that of the last, or "first"
[columns]
time = { from = 0, unit = "s" }                 # 0-based number, or a name in the header; unit "iso": dates
# time = { from = 0, unit = "iso", day_first = true }   # 11/12/2024 17:41:40.000 is of December; false: of November
# time = { from = 0, unit = "us", bits = 32 }   # a counter of 32 bits, which begins again after 2^32 - 1
accel_x = { from = 1, unit = "count" }
accel_y = { from = 2, unit = "count" }
accel_z = { from = 3, unit = "count" }
gyro_x = { from = 4, unit = "deg/s", scale = 0.0625 } # what is read, times 0.0625, is in deg/s
temperature = { from = 5, unit = "V" }          # by the two tables below: less zero, divided by scale factor
[zero]
temperature = { value = 0.5, unit = "V" }
[scale_factor]
temperature = { value = 10, unit = "mV/degC" }
[metadata]
serial = "SN42"
"""
_SHIPPED = Path(__file__).parent / "layouts"
_DELIMITERS = {"whitespace": " ", " ": " ", ",": ",", ";": ";", "\t": "\t"}
_KEYS = (
    "columns",
    "delimiter",
    "header",
    "labelled",
    "marks",
    "metadata",
    "sample_rate",
    "packet",
    "skip_lines",
    "decimal",
    "encoding",
    "prefix",
    "skip_incomplete",
    "scale_factor",
    "zero",
)
_COLUMN_KEYS = ("from", "unit", "scale", "zero", "scale_factor", "day_first", "bits")
_BITS = (8, 64)  # of counters of time
_PACKETS = ("first", "last")
_ASCII = bytes(range(32, 92)) + bytes(range(93, 127)) + b"\\u0041\t\n"
"""Characters that an encoding of titles must keep; unicode_escape would change the escape."""
_WORD = re.compile(r"[A-Za-z]")  # begins a word whose number stands above the rows
_LARGEST = 1e30  # a scale or offset beyond it, or below its inverse, is a mistake
_RATES = (1e-6, 1e9)  # Hz, of any sensor
_BY_COLUMN = {
    "scale_factor": '{ value = 0.02, unit = "V/(deg/s)" }',
    "zero": '{ value = 2.5, unit = "V" }',
}


class IfNeeded(str):
    """Name of a layout that is used only where a file does not describe its columns."""


def shipped_names() -> list[str]:
    """Return the names of the layouts that come with imulab."""
    return sorted(path.stem for path in _SHIPPED.glob("*.toml"))


def shipped_file(name: str) -> Path | None:
    """Return the file of a layout that comes with imulab, or None if there is none of this name."""
    path = _SHIPPED / f"{name}.toml"
    return path if Path(name).name == name and path.is_file() else None


def load_layout(path: str | Path, name: str | None = None) -> Layout:
    """Return a layout from a file, or by its name if it comes with imulab.

    A text such as ``"phyphox"`` is the name of one that comes with imulab; ``"./phyphox"`` and any `Path` are files.
    `name` is what messages call it, its path if not given.

    Raises
    ------
    ReadError
        The file is missing, is not TOML, or has a key or value that a layout cannot have.
    UnitError
        A unit is unknown or does not belong to its column.
    """
    name = name or str(path)
    shipped = shipped_file(path) if isinstance(path, str) else None
    if shipped is None and not os.path.lexists(path):  # a link in a circle says so when it is opened
        known = shipped_names()
        if Path(path).name != str(path) or Path(path).suffix == ".toml":  # a file, and no choice among names
            near = meant(known, Path(path).stem)
            raise ReadError(
                f"{name}: no such layout file; imulab show --formats lists those that come with imulab{near}"
            )
        raise ReadError(f"{name}: no such layout file; those that come with imulab: {listed(known, name)}")
    table = load_toml(shipped or path, name, "layout")
    return layout_of(table, name)


def layout_of(table: dict[str, Any], path: str) -> Layout:
    """Return the layout that a table of TOML describes; errors as for `load_layout`, `path` begins their messages."""
    check_keys(table, _KEYS, path)
    delimiter = table.get("delimiter", "")
    if not isinstance(delimiter, str) or (delimiter not in _DELIMITERS and "delimiter" in table):
        raise ReadError(f"{path}: delimiter {quoted(delimiter)}; expected 'whitespace' ',' ';' or a tab")
    decimal = table.get("decimal", ".")
    if decimal not in (".", ",") or decimal == delimiter:
        raise ReadError(f"{path}: decimal {quoted(decimal)}; expected '.' or ',', and another sign than the delimiter")
    columns = table.get("columns")
    if not isinstance(columns, dict) or not columns:
        raise ReadError(f'{path}: no [columns]; expected lines such as accel_x = {{ from = 1, unit = "count" }}')
    skip_lines = table.get("skip_lines", 0)
    if type(skip_lines) is not int or skip_lines < 0:
        raise ReadError(f"{path}: skip_lines = {quoted(skip_lines)}; expected a number of lines")
    for key in ("header", "skip_incomplete", "labelled"):
        if not isinstance(table.get(key, False), bool):
            raise ReadError(f"{path}: {key} = {quoted(table[key])}; expected true or false")
    rate = table.get("sample_rate")
    rate_from = rate if isinstance(rate, str) and _WORD.match(rate) else ""
    sample_rate = 1.0 if rate_from else _sample_rate(rate, path)  # until the file says it
    columns = _with_tables(columns, table, path)
    parsed = {name: _column(name, entry, path, counted=sample_rate is not None) for name, entry in columns.items()}
    metadata = table.get("metadata", {})
    if not isinstance(metadata, dict):
        raise ReadError(f"{path}: metadata = {quoted(metadata)}; expected a table of keys and texts")
    if sample_rate is not None and "time" in parsed and parsed["time"].unit != "count":
        raise ReadError(
            f"{path}: both a time column and sample_rate; expected one of them, or a time of unit count, which numbers "
            "the samples"
        )
    return Layout(
        columns=parsed,
        delimiter=_DELIMITERS.get(delimiter, ""),
        header=table.get("header", False)
        or (any(isinstance(c.origin, str) for c in parsed.values()) and not table.get("labelled", False)),
        skip_lines=skip_lines,
        sample_rate=sample_rate,
        metadata={key: str(value) for key, value in metadata.items()},
        name=path,
        text="delimiter" in table or table.get("labelled", False),
        decimal=decimal,
        prefix=_prefix(table["prefix"], _DELIMITERS.get(delimiter, ""), path) if "prefix" in table else "",
        skip_incomplete=table.get("skip_incomplete", False),
        rate_from=rate_from,
        labelled=_labelled(table, parsed, path),
        marks=_marks(table.get("marks", []), path),
        packet=_packet(table.get("packet"), parsed, path),
        encoding=_encoding(table.get("encoding", "utf-8"), path),
    )


def _with_tables(columns: dict[str, Any], table: dict[str, Any], path: str) -> dict[str, Any]:
    """Return the columns with the values of the tables [scale_factor] and [zero]."""
    merged = dict(columns)
    for key, example in _BY_COLUMN.items():
        entries = table.get(key, {})
        if not isinstance(entries, dict):
            raise ReadError(f"{path}: {key}: expected lines such as gyro_x = {example}, found {quoted(entries)}")
        for name, entry in entries.items():
            if name not in columns:
                raise ReadError(f"{path}: {key}: no column {quoted(name)}; columns: {listed(columns, name)}")
            if isinstance(merged[name], dict):
                if key in merged[name]:
                    raise ReadError(f"{path}: column {name}: {key} is given twice, here and under [{key}]")
                merged[name] = {**merged[name], key: entry}
    return merged


def _column(name: str, entry: Any, path: str, *, counted: bool) -> LayoutColumn:
    place = f"{path}: column {name}"
    if not isinstance(entry, dict) or "from" not in entry or "unit" not in entry:
        raise ReadError(f'{place}: expected {name} = {{ from = 1, unit = "count" }}, found {quoted(entry)}')
    check_keys(entry, _COLUMN_KEYS, place)
    origin = entry["from"]
    if not (isinstance(origin, str) or (type(origin) is int and origin >= 0)):
        raise ReadError(f"{place}: from = {quoted(origin)}; expected a column number from 0, or a name")
    scale = entry.get("scale", 1.0)
    scale_from = scale if isinstance(scale, str) and _WORD.match(scale) else ""
    scale = 1.0 if scale_from else number_of(scale, f"{place}: scale")
    if scale == 0:
        raise ReadError(f"{place}: scale = {quoted(entry['scale'])}; expected a number other than 0")
    _check_size(scale, f"{place}: scale")
    if entry["unit"] == "iso":
        try:
            check_unit(name, "s", path)
        except UnitError as error:
            raise UnitError(str(error).replace("'s' (time)", "'iso' (dates)")) from None
        converts = sorted(set(entry) & {"scale", "zero", "scale_factor", "bits"})
        if converts:
            raise ReadError(f"{place}: {converts[0]}: expected none for dates, whose seconds are counted")
        day_first = entry.get("day_first")
        if not isinstance(day_first, bool | None):
            raise ReadError(f"{place}: day_first = {quoted(day_first)}; expected true (11/12 is in December) or false")
        return LayoutColumn(origin, "s", date=True, day_first=day_first)
    if "day_first" in entry:
        raise ReadError(f'{place}: day_first: expected for dates only, whose unit is "iso"')
    bits = _bits(entry.get("bits"), place)
    if bits and expected_quantities(name) != ("time",):
        raise ReadError(f"{place}: bits: expected for a time only, which counts on")
    try:
        unit = parse_unit(str(entry["unit"]), expected_quantities(name) or ())
    except UnitError as error:
        raise UnitError(f"{place}: {error}") from None
    zero = _zero(entry.get("zero"), unit, f"{place}: zero")
    if "scale_factor" not in entry:
        if not (counted and name == "time" and unit.symbol == "count"):
            check_unit(name, unit.symbol, path)
        return LayoutColumn(origin, unit.symbol, scale, zero, scale_from=scale_from, bits=bits)
    known = scale_factor_of(
        entry["scale_factor"], f"{place}: scale_factor", f"scale_factor = {_BY_COLUMN['scale_factor']}"
    )
    try:
        factor = known.value * conversion_factor(known.output.symbol, unit.symbol)
    except UnitError:
        raise UnitError(
            f"{place}: unit = {quoted(entry['unit'])}; expected {known.output.symbol}, the output in the scale "
            f"factor's unit {entry['scale_factor']['unit']}"
        ) from None
    _check_size(factor, f"{place}: scale_factor")
    check_unit(name, known.measured.symbol, path)
    return LayoutColumn(origin, known.measured.symbol, scale, zero, factor, scale_from=scale_from, bits=bits)


def _zero(entry: Any, unit: Unit, place: str) -> float:
    """Return the zero of a column in its unit."""
    if entry is None:
        return 0.0
    value, symbol = value_and_unit(entry, place, f"zero = {_BY_COLUMN['zero']}")
    try:
        zero = value * conversion_factor(symbol, unit.symbol)
    except UnitError as error:
        raise UnitError(f"{place}: {error}") from None
    if zero:
        _check_size(zero, place)
    return zero


def _check_size(value: float, place: str) -> None:
    """Refuse a number that would make ordinary readings infinite or zero."""
    if not 1 / _LARGEST <= abs(value) <= _LARGEST:
        raise ReadError(f"{place}: expected a size from {1 / _LARGEST:g} to {_LARGEST:g}, found {value:g}")


def _prefix(prefix: Any, delimiter: str, path: str) -> str:
    if not isinstance(prefix, str) or prefix.strip() != prefix or not prefix or {delimiter or " ", "\n"} & set(prefix):
        raise ReadError(
            f'{path}: prefix = {quoted(prefix)}; expected the first field of the lines that count, such as "IMU"'
        )
    return prefix


def _labelled(table: dict[str, Any], columns: Mapping[str, LayoutColumn], path: str) -> bool:
    """Return whether numbers stand behind their names in each line, ``ax: 0.1``."""
    if not table.get("labelled", False):
        return False
    for key in ("delimiter", "header", "prefix", "decimal", "skip_lines", "encoding"):
        if key in table:
            raise ReadError(f"{path}: {key} together with labelled = true: expected one of them")
    for name, column in columns.items():
        if not isinstance(column.origin, str) or column.date:
            raise ReadError(f'{path}: column {name}: expected the label of a number, such as from = "Acceleration X"')
    return True


def _marks(entry: Any, path: str) -> tuple[str, ...]:
    if not isinstance(entry, list) or not all(isinstance(mark, str) and mark for mark in entry):
        raise ReadError(f'{path}: marks = {quoted(entry)}; expected texts above the titles, such as ["DeviceTag:"]')
    return tuple(entry)


def _encoding(name: Any, path: str) -> str:
    try:
        bytes(range(128, 256)).decode(name, "replace")  # comments may hold any bytes
        decoded = _ASCII.decode(name)
    except UnicodeError:
        decoded = ""
    except (LookupError, TypeError, ValueError):
        raise ReadError(
            f"{path}: encoding = {quoted(name)}; expected the name of an encoding such as gbk, shift_jis or latin-1"
        ) from None
    if decoded != _ASCII.decode("ascii"):
        raise ReadError(
            f"{path}: encoding = {quoted(name)}; expected one that writes letters and digits as ASCII does: save the "
            "file as UTF-8"
        )
    return str(name)


def _packet(entry: Any, columns: Mapping[str, LayoutColumn], path: str) -> str:
    """Return of which sample of a packet the time is; empty where rows have times of their own."""
    if entry is None:
        return ""
    if entry not in _PACKETS:
        raise ReadError(f'{path}: packet = {quoted(entry)}; expected "first" or "last", the row whose time it is')
    if "time" not in columns:
        raise ReadError(f"{path}: packet: expected a column time, which the rows of a packet share")
    return str(entry)


def _bits(entry: Any, place: str) -> int:
    """Return the bits of a counter, 0 where it does not begin again."""
    if entry is None:
        return 0
    if type(entry) is not int or not _BITS[0] <= entry <= _BITS[1]:
        raise ReadError(f"{place}: bits = {quoted(entry)}; expected {_BITS[0]} to {_BITS[1]}, the width of the counter")
    return entry


def _sample_rate(entry: Any, path: str) -> float | None:
    if entry is None:
        return None
    place = f"{path}: sample_rate"
    if isinstance(entry, int | float):
        entry = {"value": entry, "unit": "Hz"}
    value, symbol = value_and_unit(entry, place, '{ value = 100, unit = "Hz" }')
    return check_rate(to_si(value, unit_of(symbol, "frequency", place)), place)


def check_rate(rate: float, place: str) -> float:
    """Return a sampling rate that sensors can have, Hz; raise a ReadError on any other, which was stated at `place`."""
    low, high = _RATES
    if not low <= rate <= high:
        raise ReadError(f"{place}: expected a number of Hz from {low:g} to {high:g}, found {rate:g}")
    return rate


# Conversion to readings in the units of a layout, block by block.


_COUNTERS = [2.0**8, 2.0**16, 2.0**32]  # where counters of 8, 16 and 32 bits wrap around
_LOST_AT_WRAP = 16
"""Steps that a counter may miss where it wraps around."""


_MISSING = 1.5  # usual times from row to row: beyond them packets are missing
_SEEN = 1000  # packets that show the usual time from row to row
_DAY = 86_400_000_000_000  # ns


def _place(row: int, lines_before: int | None) -> str:
    return f"row {row}" if lines_before is None else f"row {row} (line {row + lines_before})"


def _date_text(stamp: int) -> str:
    """Return a date in ns since 1970, or a time of day, as text."""
    text = str(np.datetime_as_string(np.datetime64(stamp, "ns")))
    return text.partition("T")[2] if 0 <= stamp < _DAY else f"{text} UTC"


class BackwardsError(ReadError):
    """A date is before the one above it; the first `index` rows of the block are good."""

    def __init__(self, message: str, index: int = 0) -> None:
        super().__init__(message)
        self.index = index


class Counter:
    """A counter of so many bits, carried on where it begins again: it fell by more than half of what they hold."""

    def __init__(self, bits: int) -> None:
        self._size = 2.0**bits
        self._last, self._carried = np.nan, 0.0

    def carry(self, numbers: Array) -> Array:
        """Return the next numbers, finite, shape (n,) with n > 0, carried on."""
        carried = self._carried + self._size * np.cumsum(np.diff(numbers, prepend=self._last) < -self._size / 2)
        self._last, self._carried = float(numbers[-1]), float(carried[-1])
        return np.asarray(numbers + carried)


class Readings:
    """The columns of a file as its layout describes them, block by block: converted, and with their time."""

    def __init__(self, layout: Layout, name: str, *, skip_damaged: bool = False) -> None:
        self._layout, self._name, self._skips = layout, name, skip_damaged
        self._last = np.nan
        self._step = np.inf
        self._carried = 0.0
        self._dates: dict[str, tuple[int, int]] = {}
        self._counters = {name: Counter(column.bits) for name, column in layout.columns.items() if column.bits}

    @property
    def epoch(self) -> dict[str, str]:
        """The entry ``epoch`` of the head: the date, s since 1970, or time of day of the first row; {} if unknown."""
        first = self._dates.get("time")
        if first is None:
            return {}
        seconds, rest = divmod(first[0], 1_000_000_000)
        return {"epoch": f"{seconds}.{rest:09d} s{' after midnight' * (0 <= first[0] < _DAY)}"}

    def of(self, columns: Mapping[str, Array], first_row: int, lines_before: int | None = None) -> dict[str, Array]:
        """Return the readings of a block that begins at row `first_row`; the arrays are changed in place.

        Raises
        ------
        BackwardsError
            A date is before the one above it; the arrays are as they were.
        """
        dates = [name for name in columns if self._layout.columns[name].date and len(columns[name])]
        for name in dates:
            self._check_dates(name, columns[name], first_row, lines_before)
        for name, values in columns.items():
            if self._layout.columns[name].bits:
                self._carry(name, values, first_row, lines_before)
        rate = self._layout.sample_rate
        if rate is not None and "time" in columns and not self._layout.columns["time"].bits:
            columns["time"][:] = self._unwrap(columns["time"])
        for name, values in columns.items():
            if name in dates:
                self._count_from_first(name, values)
            else:
                self._layout.columns[name].convert(values)
        if rate is None:
            return dict(columns)
        if "time" in columns:
            return {**columns, "time": columns["time"] / rate}
        count = len(next(iter(columns.values())))
        return {"time": np.arange(first_row - 1, first_row - 1 + count) / rate, **columns}

    def _count_from_first(self, name: str, values: Array) -> None:
        """Convert dates, nanoseconds since 1970 in the bits of `values`, to seconds since the first of the file."""
        stamps = values.view(np.int64)
        first, _ = self._dates.get(name, (int(stamps[0]), 0))
        self._dates[name] = first, int(stamps[-1])
        values[:] = (stamps - first) / 1e9

    def _check_dates(self, name: str, values: Array, first_row: int, lines_before: int | None) -> None:
        """Refuse dates that run backwards; times of day alone are carried on past midnight, in place."""
        stamps = values.view(np.int64)
        _, last = self._dates.get(name, (0, int(stamps[0])))
        if int(stamps.min()) >= 0 and int(stamps.max()) < _DAY:
            rise = np.diff(stamps, prepend=last % _DAY)
            stamps += (last // _DAY + np.cumsum(rise < -_DAY // 2)) * _DAY
        back = np.diff(stamps, prepend=last) < 0
        if back.any() and not self._skips:  # else `without_stray_times` looks at them
            index = int(np.argmax(back))
            above = int(stamps[index - 1]) if index else last
            dates = (_date_text(stamp) for stamp in (above, int(stamps[index])))
            place = _place(first_row + index, lines_before)
            raise BackwardsError(
                "{}: {}, column {}: time runs backwards: expected {} or later, found {}".format(
                    self._name, place, name, *dates
                ),
                index,
            )

    def _carry(self, name: str, values: Array, first_row: int, lines_before: int | None) -> None:
        """Carry a counter on where it begins again: it fell by more than half of what its bits hold."""
        size = 2.0 ** self._layout.columns[name].bits
        known = np.isfinite(values)
        numbers = values[known]
        if not numbers.size:
            return
        wrong = (numbers < 0) | (numbers >= size)
        if wrong.any():
            row = int(np.flatnonzero(known)[np.argmax(wrong)])
            raise ReadError(
                f"{self._name}: {_place(first_row + row, lines_before)}, column {name}: expected a counter below "
                f"2^{self._layout.columns[name].bits} (bits in {self._layout.name}), found {values[row]:.15g}"
            )
        values[known] = self._counters[name].carry(numbers)

    def _unwrap(self, numbers: Array) -> Array:
        """Return a counter without wrap-around, where it wraps within a few of its steps of 2^8, 2^16 or 2^32.

        Where it begins again elsewhere, the number stays as it is: that is time that runs backwards.
        """
        if not len(numbers):
            return numbers
        before = np.concatenate([[self._last], numbers[:-1]])
        rise = numbers - before
        step = np.minimum(np.minimum.accumulate(np.where(rise > 0, rise, np.inf)), self._step)
        size = np.select([before < limit for limit in _COUNTERS], _COUNTERS, np.inf)
        few = np.minimum(_LOST_AT_WRAP * np.where(np.isfinite(step), step, 1.0), size / 4)
        wraps = (rise < 0) & (rise + size <= few) & np.isfinite(size)
        carried = self._carried + np.cumsum(np.where(wraps, size, 0.0))
        self._last, self._step, self._carried = float(numbers[-1]), float(step[-1]), float(carried[-1])
        return numbers + carried


# Packets: rows that share the stamp of their first or last one.


def spread_packets(blocks: Iterable[Recording], layout: Layout) -> Iterator[Recording]:
    """Yield the rows of a file whose rows come in packets of one time stamp, with a time for each row.

    Rows of a packet are spread evenly over the time to the next stamp, or since the one before, as the stamp is that of
    the first or the last; where packets are missing, over the usual time of so many rows.
    """
    held: Recording | None = None
    packets = _Packets(layout.packet)
    for block in blocks:
        joined = block if held is None else _joined(held, block)
        stamps = joined.columns["time"]
        changes = np.flatnonzero(np.diff(stamps) != 0) + 1
        complete = int(changes[-1]) if changes.size > (not packets.begun) else 0  # the first two show the rate
        held = _rows_of(joined, complete, len(joined))
        if complete:
            yield packets.spread(_rows_of(joined, 0, complete), float(stamps[complete]))
    if held is not None:
        yield packets.spread(held, None)


class _Packets:
    """The stamp before, and times from row to row, over the blocks of a file."""

    def __init__(self, whose: str) -> None:
        self._whose = whose
        self._last: float | None = None
        self._known = np.empty(0)

    @property
    def begun(self) -> bool:
        """Whether rows have been spread."""
        return bool(self._known.size)

    def spread(self, rows: Recording, following: float | None) -> Recording:
        """Return rows, whole packets, with a time each; `following` is the stamp of the packet after them."""
        stamps = rows.columns["time"]
        begin = np.concatenate([[0], np.flatnonzero(np.diff(stamps) != 0) + 1])
        count = np.diff(np.append(begin, len(stamps)))
        of_packet = stamps[begin]
        if self._whose == "first":
            span = np.diff(of_packet, append=np.nan if following is None else following)
        else:
            span = np.diff(of_packet, prepend=np.nan if self._last is None else self._last)
        self._last = float(of_packet[-1])
        each = span / count
        self._known = np.concatenate([self._known, each[np.isfinite(each)]])[-_SEEN:]
        if not self._known.size:
            return rows  # a single packet: its rows stay at one time, which is refused
        usual = float(np.median(self._known))
        each = np.where(each <= _MISSING * usual, each, usual)
        place = np.arange(len(stamps)) - np.repeat(begin, count)
        if self._whose == "last":
            place -= np.repeat(count - 1, count)
        return replace(rows, columns={**rows.columns, "time": stamps + place * np.repeat(each, count)})


def _rows_of(recording: Recording, start: int, stop: int) -> Recording:
    columns = {name: values[start:stop] for name, values in recording.columns.items()}
    return replace(recording, columns=columns, first_row=recording.first_row + start)


def _joined(first: Recording, second: Recording) -> Recording:
    columns = {name: np.concatenate([values, second.columns[name]]) for name, values in first.columns.items()}
    return replace(second, columns=columns, first_row=first.first_row, notes=(*first.notes, *second.notes))
