"""What was read to readings in the units of a layout, block by block."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from imulab.errors import ReadError
from imulab.reading import Layout
from imulab.recording import Array

_COUNTERS = [2.0**8, 2.0**16, 2.0**32]
_LOST_AT_WRAP = 16
"""Steps that a counter may miss where it begins again."""


class BackwardsError(ReadError):
    """A date is before the one above it; `index` rows of the block are good."""

    def __init__(self, message: str, index: int) -> None:
        super().__init__(message)
        self.index = index


class Readings:
    """The columns of a file as its layout describes them, block by block: converted, and with their time."""

    def __init__(self, layout: Layout, name: str) -> None:
        self._layout, self._name = layout, name
        self._last = np.nan
        self._step = np.inf
        self._carried = 0.0
        self._dates: dict[str, tuple[int, int]] = {}

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
        rate = self._layout.sample_rate
        if rate is not None and "time" in columns:
            columns["time"][:] = self._unwrapped(columns["time"])
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
        """Turn dates, nanoseconds since 1970 in the bits of `values`, into seconds since the first of the file."""
        stamps = values.view(np.int64)
        first, _ = self._dates.get(name, (int(stamps[0]), 0))
        self._dates[name] = first, int(stamps[-1])
        values[:] = (stamps - first) / 1e9

    def _check_dates(self, name: str, values: Array, first_row: int, lines_before: int | None) -> None:
        stamps = values.view(np.int64)
        _, last = self._dates.get(name, (0, int(stamps[0])))
        back = np.diff(stamps, prepend=last) < 0
        if back.any():
            index = int(np.argmax(back))
            row = first_row + index
            place = f"row {row}" if lines_before is None else f"row {row} (line {row + lines_before})"
            above = stamps[index - 1] if index else last
            dates = (np.datetime_as_string(np.datetime64(int(stamp), "ns")) for stamp in (above, stamps[index]))
            raise BackwardsError(
                "{}: {}, column {}: time runs backwards: expected {} UTC or later, found {}".format(
                    self._name, place, name, *dates
                ),
                index,
            )

    def _unwrapped(self, numbers: Array) -> Array:
        """Carry a counter on where it begins again within a few of its steps of 2^8, 2^16 or 2^32.

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
