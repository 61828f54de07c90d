"""Streams of lines of text: native titles, MotionCal, x-IMU3, and layouts of delimited text or JSON.

Lines are taken one by one in Python: a stream has thousands of lines a second where files have millions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.columns import parse_column_title, triad
from imulab.errors import OptionError, ReadError, UnitError, quoted
from imulab.live.stamps import Counts
from imulab.reading import Layout
from imulab.recording import Array

Rows = list[list[float]]
_LONGEST = 1 << 14


def units_of(sensor: str, unit: str) -> dict[str, str]:
    """Return the columns of a sensor of three axes, with their unit."""
    return dict.fromkeys(triad(sensor), unit)


_EXTRA = {b"M": units_of("mag", "1"), b"T": {"temperature": "degC"}}
"""Messages of the x-IMU3 beside the inertial ones, and their columns."""


class LineDecoder:
    """What all streams of lines share: cutting bytes into lines, and counting those that cannot be read."""

    name = over = ""
    units: Mapping[str, str] = {}

    def __init__(self, counts: Counts) -> None:
        self.counts = counts
        self.metadata: dict[str, str] = {}
        self._rest = b""
        self._begun = False

    def rows(self, data: bytes) -> Array:
        """Return the rows that these bytes complete, shape (n, columns); none behind a line that ends the stream."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST:
            self.counts.damaged += 1
            self._rest = b""
        rows: Rows = []
        for line in lines:
            line = line.strip()
            if self.over:
                break
            if not line:
                continue
            try:
                row = self._row(line)
            except (ValueError, KeyError, TypeError, IndexError):
                # A stream is often joined in the middle of a line, which is no damage.
                self.counts.damaged += self._begun
                row = None
            self._begun = True
            if row is not None and all(map(math.isfinite, row)):
                rows.append(row)
            elif row is not None:
                self.counts.damaged += 1
        return self._table(rows)

    def finish(self) -> Array:
        """Return the row of a last line without an end: none, because it may have been cut."""
        return self._table([])

    def _table(self, rows: Rows) -> Array:
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(self.units))

    def _row(self, line: bytes) -> list[float] | None:
        """Return the numbers of a line, None for one that holds none; raise ValueError where it is damaged."""
        raise NotImplementedError


class Native(LineDecoder):
    """Rows below a line of titles ``name [unit]``, as in files; the titles may come again, in another order too."""

    name = "titles with units"

    def __init__(self, titles: str, counts: Counts) -> None:
        super().__init__(counts)
        self.units = native_units(titles)
        self._titles = titles.encode()
        self._places: list[int] | None = None

    def _row(self, line: bytes) -> list[float] | None:
        if line == self._titles and self._places is None:
            self._places = list(range(len(self.units)))
            return None
        if b"[" in line and not line.startswith(b"#") and self._places is not None:
            self._tell_again(line.decode("utf-8", "replace"))
            return None
        if line.startswith(b"#"):
            key, colon, value = line[1:].decode("utf-8", "replace").partition(":")
            if colon:
                self.metadata[key.strip()] = value.strip()
            return None
        if self._places is None:
            return None
        fields = line.split(b",")
        if len(fields) != len(self.units):
            raise ValueError
        return [float(fields[place]) for place in self._places]

    def _tell_again(self, titles: str) -> None:
        """Take titles that come again; what is no whole line of them is damage."""
        words = titles.split(",")
        if len(words) < len(self.units) or not all(word.endswith("]") for word in words):
            raise ValueError
        units = native_units(titles) if is_titles(titles) else {}
        if units == self.units:
            self._places = [list(units).index(name) for name in self.units]
        else:
            self.over = (
                f"the stream's titles have changed from {quoted(self._titles.decode('utf-8', 'replace'))} to "
                f"{quoted(titles)}: expected the same columns and units to the end"
            )


class MotionCal(LineDecoder):
    """``Raw:`` and nine whole numbers, as MotionCal and Adafruit's sketches write them."""

    name = "MotionCal Raw:"
    units = units_of("accel", "g") | units_of("gyro", "deg/s") | units_of("mag", "uT")
    _SCALES = (8192.0,) * 3 + (16.0,) * 3 + (10.0,) * 3

    def _row(self, line: bytes) -> list[float] | None:
        if not line.startswith(b"Raw:"):
            if line[:4] in (b"Uni:", b"Cal1", b"Cal2"):
                return None
            raise ValueError
        numbers = [int(field) for field in line[4:].split(b",")]
        if len(numbers) != 9 or max(map(abs, numbers)) > 1 << 15:
            raise ValueError
        return [number / scale for number, scale in zip(numbers, self._SCALES, strict=True)]


class XImu3(LineDecoder):
    """ASCII messages of the x-IMU3: ``I`` inertial, with the latest ``M`` magnetometer and ``T`` temperature."""

    name = "x-IMU3 ASCII"

    def __init__(self, kinds: set[bytes], counts: Counts) -> None:
        super().__init__(counts)
        self.units = {"time": "us"} | units_of("gyro", "deg/s") | units_of("accel", "g")
        self._latest: dict[bytes, list[float]] = {}
        self._extra = [kind for kind in _EXTRA if kind in kinds]
        for kind in self._extra:
            self.units |= _EXTRA[kind]

    def _row(self, line: bytes) -> list[float] | None:
        kind, *fields = line.split(b",")
        numbers = [float(field) for field in fields]
        if kind == b"I" and len(numbers) == 7:
            if any(other not in self._latest for other in self._extra):
                return None  # a moment at the beginning, before each sensor has sent a reading
            return numbers + [value for other in self._extra for value in self._latest[other]]
        if kind in self._extra and len(numbers) == 1 + len(_EXTRA[kind]):
            self._latest[kind] = numbers[1:]
        elif len(kind) != 1 or kind in b"IMT":
            raise ValueError
        return None


class LayoutDecoder(LineDecoder):
    """Delimited text or a JSON object a line, through a layout."""

    def __init__(self, layout: Layout, counts: Counts) -> None:
        super().__init__(counts)
        if any(column.date for column in layout.columns.values()):
            raise OptionError(f"{layout.name}: a live stream takes no dates; expected a time in s, ms or us")
        self.name = f"layout {layout.name}"
        self.units = {name: column.unit for name, column in layout.columns.items()}
        self._layout = layout
        if layout.sample_rate is not None:
            self.units = {"time": "s"} | self.units | {"time": "s"}
        self.metadata = dict(layout.metadata or {})
        self._count = 0
        self._places: list[int] | None = None
        origins = [column.origin for column in layout.columns.values()]
        self._titled = not all(isinstance(origin, int) for origin in origins)
        self._keys = [str(origin) for origin in origins]
        if not self._titled:
            self._places = [int(origin) for origin in origins]

    def _row(self, line: bytes) -> list[float] | None:
        text = line.decode(self._layout.encoding, "replace")
        if text.startswith("{"):
            document = json.loads(text)
            return [float(_looked_up(document, key)) for key in self._keys]
        delimiter = None if self._layout.delimiter == " " else self._layout.delimiter
        found = self._layout.behind_prefix([field.strip() for field in text.split(delimiter)])
        if found is None:
            return None
        fields = found
        if self._titled:
            titles = [field.strip('"') for field in fields]
            if all(key in titles for key in self._keys):
                self._places = [titles.index(key) for key in self._keys]
                return None
        if self._places is None:
            return None
        if self._layout.decimal == ",":
            fields = [field.replace(",", ".") for field in fields]
        return [float(fields[place]) for place in self._places]

    def _table(self, rows: Rows) -> Array:
        layout = self._layout
        table = np.array(rows, dtype=np.float64).reshape(len(rows), len(layout.columns))
        named = dict(zip(layout.columns, table.T.copy(), strict=True))
        for name, column in layout.columns.items():
            column.convert(named[name])
        if layout.sample_rate is not None:
            numbers = named["time"] if "time" in named else self._count + np.arange(len(rows), dtype=np.float64)
            named["time"] = numbers / layout.sample_rate
            self._count += len(rows)
        return np.column_stack([named[name] for name in self.units])


def native_units(titles: str) -> dict[str, str]:
    """Return the columns of a native line of titles with their units.

    Raises
    ------
    ReadError, UnitError
        It is none.
    """
    pairs = [parse_column_title(title, "titles") for title in titles.split(",")]
    units = dict(pairs)
    if len(units) < len(pairs) or "[" not in titles or "accel_x" not in units:
        raise ReadError("titles: expected name [unit], each name once, accel_x among them")
    return units


def is_titles(line: str) -> bool:
    """Return whether a line is one of native titles."""
    try:
        return bool(native_units(line))
    except (ReadError, UnitError):
        return False


def _looked_up(document: Any, key: str) -> Any:
    if key in document:
        return document[key]
    for part in key.split("."):
        document = document[int(part) if isinstance(document, list) else part]
    return document
