"""Recording: the samples of one test as read, with their units and clocks; and how a caller describes data.

Also the columns of large recordings in temporary files, and the temperature and time at power-on.
"""

from __future__ import annotations

import errno
import math
import mmap
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypedDict, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imulab.arguments import checked, described
from imulab.columns import check_unit, clocks_of, element_number, expected_quantities, kind_of, shared_unit, triad
from imulab.display import Note, has_hidden, printable, reverses
from imulab.errors import DataError, OptionError, UnitError, meant, several
from imulab.frames import Frame, columns_of_arrays, columns_of_frame, data_frame
from imulab.options import PROGRAM, READING, choice, file, parsed, text
from imulab.quantities import LARGEST, parse_units, span, whole, whole_number
from imulab.units import ask_unit_of_time, parse_unit, to_si
from imulab.views import AnyPlot, AnyPlots, views

if TYPE_CHECKING:
    import pandas
    import polars


# Recording: the samples of one test, as they were read, with their units.


Array = NDArray[np.float64]

CORRECTED_BY = "corrected_by"
"""Key, in the head of a file, of each record that its samples were corrected by."""


RESAMPLED = "resampled"
"""Key of the head: which sensors were interpolated to another clock, and from which rate to which."""


@dataclass(frozen=True, slots=True)
class Source:
    """A file that a recording was read from, and the SHA-256 of its bytes.

    `measured` is the day of its first sample, or the time in UTC, where the recording tells it; else None.
    """

    file: str
    sha256: str
    measured: str | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Recording:
    """The samples of one test: columns as read with their units; SI arrays are derived on request.

    A sensor may have a clock of its own, a column such as ``time_gyro``; the samples of sensors with fewer of them than
    others are followed by rows without numbers.

    Attributes
    ----------
    columns
        Name to samples, each of shape (n,), in file order.
    units
        Name to unit symbol, in the same order; ``1`` where a column outside the vocabulary came without.
    metadata
        ``key: value`` comments at the head of the file (serial, model, power_on_temperature, ...).
    name
        What messages call the recording: its file name.
    source
        File and hash, where the recording was read from a file as a whole.
    first_row
        Number of the first sample's data row, counted from 1 (blocks of a file start further down).
    lines_before
        Lines of the file above data row 1; None where rows are not lines of text.
    notes
        What a user should know: what the reader did to the data, and what `apply` doubts.
    corrected_by
        The records that the samples were corrected by, ``NAME sha256:HASH`` each.
    from_file
        Whether a reader made it: messages then advise on files, not on data frames.
    time_stated
        Whether the caller stated the unit of time, or the rate: it is not doubted then.

    Examples
    --------
    >>> import numpy as np
    >>> import imulab as il
    >>> recording = il.Recording.from_arrays(accel=np.zeros((100, 3)), rate=50.0, unit="g")
    >>> list(recording.columns), recording.units["accel_x"]
    (['time', 'accel_x', 'accel_y', 'accel_z'], 'g')
    """

    columns: Mapping[str, Array]
    units: Mapping[str, str]
    metadata: Mapping[str, str] = field(default_factory=dict)
    name: str = "recording"
    source: Source | None = None
    first_row: int = 1
    lines_before: int | None = None
    notes: tuple[str, ...] = ()
    corrected_by: tuple[str, ...] = ()
    from_file: bool = False
    time_stated: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.metadata, Mapping) and any(isinstance(each, int | float) for each in self.metadata.values()):
            texts = {key: repr(each) if isinstance(each, int | float) else each for key, each in self.metadata.items()}
            object.__setattr__(self, "metadata", texts)
        for what in ("columns", "units", "metadata"):
            if not isinstance(getattr(self, what), Mapping):
                raise DataError(f"{what}: expected a mapping from names, found {described(getattr(self, what))}")
            for key, value in getattr(self, what).items():
                if not (isinstance(key, str) and _is_column(value) if what == "columns" else isinstance(value, str)):
                    expected = "an array of numbers, shape (n,)" if what == "columns" else "a text"
                    raise DataError(f"{what}[{key!r}]: expected {expected}, found {described(value)}")
        lengths = {len(column) for column in self.columns.values()}
        if len(lengths) > 1:
            raise DataError(f"{self.name}: columns of different length: {sorted(lengths)}")
        for name in self.columns:
            if has_hidden(name):
                raise DataError(f"{self.name}: column name {printable(name)!r} holds a control character")
            check_unit(name, self.units.get(name, ""), self.name)
        if reverses(serial := self.metadata.get("serial", "")):
            raise DataError(
                f"{self.name}: serial {printable(serial)!r} holds a character that reverses text: it would read as "
                "another unit's"
            )
        if any(has_hidden(text) for pair in self.metadata.items() for text in pair):
            clean = {printable(key): printable(value) for key, value in self.metadata.items()}
            object.__setattr__(self, "metadata", clean)
        object.__setattr__(self, "units", {name: self.units.get(name, "1") for name in self.columns})

    def __repr__(self) -> str:
        titles = ", ".join(f"{name} [{unit}]" for name, unit in self.units.items())
        return f"Recording({self.name}: {len(self)} samples of {titles})"

    def _repr_html_(self) -> str:
        return views().recording_html(self)

    @overload
    def plot(self, name: None = None) -> AnyPlots: ...
    @overload
    def plot(self, name: str | int) -> AnyPlot: ...
    @checked
    def plot(self, name: str | int | None = None) -> AnyPlots | AnyPlot:
        """Return the columns over time, a figure for each sensor, or that of one sensor, such as ``"accel"``.

        Raises
        ------
        OptionError
            There is no such figure; the message lists them.
        """
        return views().recording_plots(self, name)

    def __len__(self) -> int:
        for column in self.columns.values():
            return len(column)
        return 0

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def place(self, index: int) -> str:
        """Return the name of sample `index` in messages: ``row 50 (line 51)``."""
        row = self.first_row + int(index)
        return f"row {row}" if self.lines_before is None else f"row {row} (line {row + self.lines_before})"

    def column(self, name: str) -> Array:
        """Return the samples of a column as read, shape (n,).

        Raises
        ------
        DataError
            The recording has no such column; the message lists those that it has.
        """
        try:
            return self.columns[name]
        except KeyError:
            numbers = sorted({number for other in self.columns if (number := element_number(other, name)) is not None})
            if numbers:
                raise DataError(
                    f"{self.name}: no column {name}, but one of each of {len(numbers)} IMUs; choose one, from "
                    f"{numbers[0]} to {numbers[-1]} (--element {numbers[0]})"
                ) from None
            raise self.lacking(f"column {name}", name) from None

    def lacking(self, what: str, example: str, why: str = "") -> DataError:
        """Return the error of a recording without what is needed: what there is, and how to read other names.

        Parameters
        ----------
        what
            What there is not, such as ``column gyro_x``.
        example
            The name of a column that would do.
        why
            What the column is needed for.
        """
        foreign = all(expected_quantities(other) in (None, ("time",)) for other in self.columns)
        other = next((name for name in self.columns if expected_quantities(name) is None), "x")
        advice = next((note for note in self.notes if "--layout" in note), None) or (
            "a layout says where columns of other names are (--layout; docs/recordings.md)"
            if self.from_file
            else f"rename what is the sensor's, such as df.rename(columns={{{other!r}: {example!r}}})"
        )
        hint = f"; {advice}" if foreign else f"; {state_rate(self.name)}" if example == "time" else ""
        reason = f": {why}" if why else ""
        return DataError(f"{self.name}: no {what}; found {several(self.columns)}{reason}{hint}")

    def si(self, name: str) -> Array:
        """Return the samples of a column in SI (counts and volts as they are), shape (n,)."""
        return converted(self.column(name), self.units[name])

    @property
    def time(self) -> Array | None:
        """Time of each sample, s, shape (n,), or None for a table without a time column."""
        return self.si("time") if "time" in self.columns else None

    @property
    def clocks(self) -> dict[str, list[str]]:
        """Names of columns by the column of time that stamps them: ``time``, or a clock of their own, ``time_gyro``."""
        stamped: dict[str, list[str]] = {"time": []}
        for name, clock in clocks_of(self.columns).items():
            if name not in ("time", clock):
                stamped.setdefault(clock, []).append(name)
        return stamped if stamped["time"] else {clock: names for clock, names in stamped.items() if names}

    @property
    def on_one_clock(self) -> bool:
        """Whether the column ``time`` stamps all sensors, or nothing does."""
        return list(self.clocks) in ([], ["time"])

    def stream(self, clock: str) -> Recording:
        """Return the columns that a clock stamps, with it as ``time``, without the rows that have none of its samples.

        Parameters
        ----------
        clock
            One of `clocks`, or a sensor, such as ``gyro``.
        """
        clocks = self.clocks
        if self.on_one_clock:
            return self
        chosen = clock if clock in clocks else f"time_{clock}" if f"time_{clock}" in clocks else "time"
        kept = [name for name in (chosen, *clocks[chosen]) if name in self.columns]
        there = np.zeros(len(self), dtype=np.bool_)
        for name in kept:
            there |= np.isfinite(self.columns[name])
        called = {name: "time" if name == chosen else name for name in kept}
        columns = {called[name]: self.columns[name] for name in kept}
        if not there.all():
            columns = {name: stored_as(values[there], values) for name, values in columns.items()}
        return replace(self, columns=columns, units={called[name]: self.units[name] for name in kept})

    def triad(self, sensor: str) -> Array:
        """Return the three columns ``<sensor>_x``, ``_y``, ``_z`` as read, shape (n, 3).

        Raises
        ------
        DataError
            A column is missing.
        """
        return np.column_stack([self.column(name) for name in triad(sensor)])

    def triad_unit(self, sensor: str) -> str:
        """Return the unit that the three columns of a triad share.

        Raises
        ------
        UnitError
            They have different units.
        """
        names = triad(sensor)
        for name in names:
            self.column(name)
        return shared_unit({name: self.units[name] for name in names}, "the axes of a triad", self.name)

    def mean_temperature(self) -> float | None:
        """Return the mean temperature, degC: of the column, or else as the head of the file states it."""
        if "temperature" in self.columns and parse_unit(self.units["temperature"]).quantity == "temperature":
            values = self.si("temperature")
            finite = np.isfinite(values)
            values = values if finite.all() else values[finite]
            if values.size:
                return float(values.mean())
        for key in ("temperature", "power_on_temperature"):
            number, _, symbol = self.metadata.get(key, "").partition(" ")
            try:
                value, unit = float(number), parse_unit(symbol.strip() or "degC")
            except (ValueError, UnitError):
                continue
            if unit.quantity == "temperature" and np.isfinite(value):
                return to_si(value, unit.symbol)
        return None

    @checked
    def with_columns(self, columns: Mapping[str, Array], units: Mapping[str, str]) -> Recording:
        """Return a copy in which some columns are replaced (or added at the end)."""
        return replace(self, columns={**self.columns, **columns}, units={**self.units, **units})

    @classmethod
    @checked
    def from_arrays(
        cls,
        *,
        accel: ArrayLike | None = None,
        gyro: ArrayLike | None = None,
        mag: ArrayLike | None = None,
        temperature: ArrayLike | None = None,
        time: ArrayLike | None = None,
        rate: float | None = None,
        unit: str | None = None,
        units: Mapping[str, str] | None = None,
        metadata: Mapping[str, str] | None = None,
        name: str = "arrays",
        **columns: ArrayLike,
    ) -> Recording:
        """Make a recording from arrays.

        Parameters
        ----------
        accel, gyro, mag
            Outputs of a triad, shape (n, 3).
        temperature, time
            Shape (n,), in degC and s unless `units` says otherwise; times may be dates (`datetime64`). A sensor with a
            clock of its own has its times as ``time_gyro``, and as many samples as these.
        rate
            Sampling rate, Hz, instead of `time`; with neither, the rows are attitudes at rest.
        unit
            Unit of the sensors whose quantity it measures, such as ``"g"``; ``"count"`` and ``"V"`` are of all.
        units
            Units of sensors or single columns: ``{"accel": "g", "gyro": "deg/s"}``.
        metadata
            What the head of a file would say: ``{"serial": "42", "gravity": "9.81362 m/s^2"}``.
        name
            What messages call the recording.
        columns
            Further columns, shape (n,) or (n, 3): ``gyro_1``, ``std_accel``, ``truth_rate`` ...

        Raises
        ------
        DataError
            An array has another shape, holds no numbers, or is longer than the others.
        UnitError
            A sensor has no unit, or one of another quantity.
        OptionError
            A name is nearly one of those above, or both `time` and `rate` are given.

        Examples
        --------
        >>> import numpy as np
        >>> import imulab as il
        >>> il.Recording.from_arrays(accel=np.tile([0.0, 0.0, 1.0], (200, 1)), rate=100.0, unit="g")
        Recording(arrays: 200 samples of time [s], accel_x [g], accel_y [g], accel_z [g])
        """
        arrays = {"time": time, "accel": accel, "gyro": gyro, "mag": mag, "temperature": temperature, **columns}
        converted, symbols = columns_of_arrays(arrays, rate=rate, unit=unit, units=units, name=name)
        stated = rate is not None or "time" in (units or {})
        return cls(converted, symbols, metadata or {}, name, time_stated=stated)

    @classmethod
    @checked
    def from_frame(
        cls,
        frame: Frame,
        units: Mapping[str, str] | None = None,
        *,
        unit: str | None = None,
        rate: float | None = None,
        metadata: Mapping[str, str | float] | None = None,
        name: str = "frame",
    ) -> Recording:
        """Make a recording from a pandas or polars data frame with columns named as in files, ``accel_x [g]``.

        Parameters
        ----------
        frame
            The data; where it has no column ``time``, dates in its index are the times.
        units
            Units of columns whose titles have none: ``{"accel": "g", "gyro_x": "deg/s", "time": "ms"}``.
        unit, rate, metadata, name
            As for `from_arrays`.

        Raises
        ------
        DataError
            A column holds no numbers, or appears twice.
        UnitError
            A column of a sensor has no unit, or one of another quantity.
        OptionError
            `units` names no column, or both a time and a rate are there.

        Examples
        --------
        >>> import imulab as il
        >>> frame = il.simulate_tumble(gravity=9.81).to_frame()
        >>> frame.columns[1]
        'accel_x [m/s^2]'
        >>> il.Recording.from_frame(frame).units["accel_x"]
        'm/s^2'
        """
        converted, symbols = columns_of_frame(frame, rate=rate, unit=unit, units=units, name=name)
        lines = getattr(frame, "attrs", {}).get("corrected_by", ())
        before = tuple(line if isinstance(line, str) else str(line) for line in lines)
        return cls(converted, symbols, {**(metadata or {})}, name, corrected_by=before)  # type: ignore[dict-item]

    @overload
    def to_frame(self, library: Literal["pandas"] | None = None) -> pandas.DataFrame: ...
    @overload
    def to_frame(self, library: Literal["polars"]) -> polars.DataFrame: ...
    @checked
    def to_frame(self, library: str | None = None) -> pandas.DataFrame | polars.DataFrame:
        """Return a data frame with columns named ``name [unit]``: of pandas, or of the `library` ``"polars"``.

        Raises
        ------
        DataError
            The library is not installed.
        OptionError
            `library` is neither of the two.
        """
        titled = {f"{name} [{self.units[name]}]": values for name, values in self.columns.items()}
        frame = data_frame(titled, library)
        if self.corrected_by and hasattr(frame, "attrs"):  # of pandas; a frame of polars does not know what made it
            frame.attrs["corrected_by"] = list(self.corrected_by)
        return frame


def _is_column(values: object) -> bool:
    return isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype.kind in "iufb"


def padded(parts: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Return columns of one length, those of fewer samples followed by NaN."""
    rows = max(len(values) for part in parts for values in part.values())
    columns = {name: values for part in parts for name, values in part.items()}
    short = {name: values for name, values in columns.items() if len(values) < rows}
    rest = np.full(rows, np.nan)
    return columns | {
        name: stored_as(np.concatenate([values, rest[len(values) :]]), values) for name, values in short.items()
    }


def packed(recording: Recording) -> Recording:
    """Return a recording with the samples of each clock together, and what pads them at the end."""
    return recording if recording.on_one_clock else by_clock(recording, lambda part: part)


def by_clock(recording: Recording, change: Callable[[Recording], Recording]) -> Recording:
    """Return a recording of several clocks with the samples of each as `change` returns them."""
    parts, notes = [], dict.fromkeys(recording.notes)
    for clock in recording.clocks:
        part = change(recording.stream(clock))
        parts.append({clock if name == "time" else name: values for name, values in part.columns.items()})
        notes |= dict.fromkeys(part.notes)
    columns = padded(parts)
    return replace(recording, columns={name: columns[name] for name in recording.columns}, notes=tuple(notes))


def joined(blocks: Sequence[Recording]) -> Recording:
    """Return consecutive blocks as one recording, with the notes of all."""
    columns = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    notes = dict.fromkeys(note for block in blocks for note in block.notes)
    return replace(blocks[0], columns=columns, notes=tuple(notes))


def check_not_resampled(recording: Recording, names: Iterable[str]) -> None:
    """Refuse columns whose noise was changed when they were interpolated to another clock.

    Raises
    ------
    DataError
        The head of the file says so of one of them.
    """
    for sentence in recording.metadata.get(RESAMPLED, "").split(";"):
        sensors, _, rates = sentence.strip().partition(" from ")
        changed = [name for name in names if kind_of(name) in sensors.split(" and ")]
        if changed:
            raise DataError(
                f"{recording.name}: {' '.join(changed)}: resampled from {rates}, which changes the noise; expected the "
                "log as it was recorded, each sensor on its own clock (convert without --one-clock)"
            )


def check_finite(recording: Recording, names: list[str]) -> None:
    """Check that the named columns hold finite numbers only, and none beyond any quantity of a sensor.

    Raises
    ------
    DataError
        NaN, infinity or a size beyond 1e100; the message names column and row of the first, and their count.
    """
    for name in names:
        values = recording.column(name)
        # Neither NaN nor infinite, nor of a size whose square is. Without a copy where all are so.
        if len(values) and not (values.min() >= -LARGEST and values.max() <= LARGEST):
            finite = np.abs(values) <= LARGEST
            index = int(np.argmin(finite))
            count = int(np.size(finite) - np.count_nonzero(finite))
            more = f" (and {count - 1} more)" if count > 1 else ""
            expected = "a finite number" if not np.isfinite(values[index]) else f"a number of at most {LARGEST:g}"
            timed = count > 1 and "time" in recording and name != "time"
            advice = "; --window reads a part without them" if timed else ""
            raise DataError(
                f"{recording.name}: {recording.place(index)}, column {name}: "
                f"expected {expected}, found {values[index]}{more}{advice}"
            )


def state_rate(name: str) -> str:
    """Return what to do about samples without a time in a file of this name."""
    guess = f"imulab layout guess {name} --sample-rate 100Hz -o L.toml writes one"
    return f"state the rate of samples: sample_rate in a layout ({guess}; in Python rate=100)"


EVEN_SAMPLES = "where samples are even, state sample_rate in a layout instead of this column (in Python rate=)"
"""What to do about time stamps that do not tell the rate."""
_BACKWARDS = "--damaged skip leaves out single rows of text that are torn; a file of several runs is to be split there"


def bits_of_wrap(last: float, first: float) -> int:
    """Return the bits of a counter that begins again with `first` behind `last`: near 2^16, 2^24 or 2^32; else 0."""
    return next((bits for bits in (16, 24, 32) if 0.95 * 2**bits < last < 2**bits and 0 <= first < 0.05 * 2**bits), 0)


def check_time(recording: Recording) -> Array:
    """Check that time rises from sample to sample and return it, s, shape (n,).

    Raises
    ------
    DataError
        Time runs backwards or stands still; the message names the row.
    """
    check_finite(recording, ["time"])
    time = recording.si("time")
    rises = time[1:] > time[:-1]
    if not rises.all():
        index = int(np.argmin(rises)) + 1
        raw = recording.column("time")
        verb = "stands still" if time[index] == time[index - 1] else "runs backwards"
        unit = recording.units["time"]
        bits = bits_of_wrap(float(raw[index - 1]), float(raw[index]))
        wraps = f"a counter that began again at 2^{bits}: bits = {bits} beside its unit in a layout carries it on"
        advice = EVEN_SAMPLES if time[index] == time[index - 1] else wraps if bits else _BACKWARDS
        raise DataError(
            f"{recording.name}: {recording.place(index)}, column time: time {verb}: "
            f"expected more than {raw[index - 1]:.15g} {unit}, found {raw[index]:.15g} {unit}; {advice}"
        )
    return time


# Columns of large recordings in temporary files: only one whole column is in memory at a time.


LARGE = 1 << 28
"""Bytes of a file whose rows are not kept in memory."""


_AT_ONCE = 1 << 18  # rows of a column in a temporary file that are converted together
_KEPT = (1 << 22) - (1 << 12)  # numbers, just below 32 MB: of no larger block glibc learns how much to keep


def is_large(file: str | PathLike[str] | None) -> bool:
    """Return whether the rows of a file are too many to be kept in memory."""
    if file is None or not (path := Path(file)).is_file():
        return False
    return path.stat().st_size > LARGE


def on_disk(blocks: Iterator[Recording]) -> Recording:
    """Return a recording from its blocks of rows, its columns in temporary files, which go with the last use of them.

    Raises
    ------
    DataError
        There is no room for the files.
    """
    # The C library of Linux keeps twice what was once freed; what it gives back is cleared anew for every block.
    np.empty(_KEPT)
    first = next(blocks)
    files = {name: _file() for name in first.columns}
    notes: dict[str, None] = {}
    head, block = replace(first, columns={}), first
    while True:
        notes |= dict.fromkeys(block.notes)
        for name, stream in files.items():
            _write(stream, block.columns[name], head.name)
        if (following := next(blocks, None)) is None:
            break
        block = following
    columns = _OnDisk((name, _mapped(stream)) for name, stream in files.items())
    return packed(replace(head, columns=columns, units=first.units, notes=tuple(notes)))


class _OnDisk(dict[str, Array]):
    """Columns in temporary files: the memory that held the others is given back where one is asked for."""

    def __getitem__(self, name: str) -> Array:
        release(*(values for other, values in self.items() if other != name))
        return super().__getitem__(name)


def release(*columns: Array) -> None:
    """Give back the memory that holds columns of temporary files; what is used again is read again.

    A map that can be written to, a caller's, may hold changes that are in no file: it is left alone.
    """
    for values in columns:
        base = _map_of(values)
        if base is not None and memoryview(base).readonly and hasattr(mmap, "MADV_DONTNEED"):
            base.madvise(mmap.MADV_DONTNEED)


def _map_of(values: Array) -> mmap.mmap | None:
    """Return the map of the temporary file in which values lie, None for values in memory."""
    base: Any = values
    while base is not None and not isinstance(base, mmap.mmap):
        base = getattr(base, "base", None)
    return base


def converted(values: Array, unit: str) -> Array:
    """Return samples in SI, shape (n,); those in a temporary file part by part, so as not to be in memory twice."""
    if _map_of(values) is None or to_si(first := values[:1], unit) is first:
        return to_si(values, unit)
    samples = np.empty(len(values))
    for start in range(0, len(values), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        samples[rows] = to_si(values[rows], unit)
        release(values)
    return samples


def stored_as(values: Array, like: Array) -> Array:
    """Return values, shape (n,), in a temporary file if `like` is in one; else unchanged."""
    if _map_of(like) is None:
        return values
    file = _file()
    _write(file, values, "recording")
    return _mapped(file)


def _file() -> IO[bytes]:
    return tempfile.TemporaryFile(buffering=0)


def _write(file: IO[bytes], values: Array, name: str) -> None:
    try:
        left = np.ascontiguousarray(values, dtype=np.float64).view(np.uint8).data
        while left:
            left = left[file.write(left) :]
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        raise DataError(
            f"{name}: no room in {tempfile.gettempdir()} for columns that do not fit in memory; expected 8 bytes for "
            "each number of the log there, or another folder in the environment variable TMPDIR"
        ) from None


def _mapped(file: IO[bytes]) -> Array:
    with file:
        return np.asarray(np.memmap(file, np.float64, "r")) if file.tell() else np.empty(0)


# Power cycles: temperature at power-on, and time that counts from power-on.


TAKEN_FROM = "power_on_temperature_from"
"""Key of the head beside a power-on temperature that was not measured at power-on, but taken from elsewhere."""
LATEST_START = 5.0
"""A first sample later than this after power-on is refused, s."""
_SLOWEST, _FASTEST = 4.0, 2e-5
"""Limits of the sampling period of a warm-up recording, s."""


def check_start(recording: Recording, first: float, latest: float) -> None:
    """Refuse time that does not count from power-on.

    Raises
    ------
    DataError
        The first sample lies before power-on, or more than `latest`, s, after it.
    """
    if first < 0:
        raise DataError(
            f"{recording.name}: {recording.place(0)}, column time: starts {-first:.6g} s before power-on; "
            "expected time 0 at power-on"
        )
    if first > latest:
        raise DataError(
            f"{recording.name}: {recording.place(0)}, column time: the first sample is {first:.6g} s after power-on; "
            f"expected at most {latest:g} s (time 0 is power-on; --latest-start allows more)"
        )


def check_clock(recording: Recording, time: Array) -> None:
    """Refuse times, s, that are probably in another unit than their column's title states.

    Raises
    ------
    DataError
        They are so far apart, or so close, as those of no recording of a warm-up.
    """
    if len(time) < 3:
        return
    steps = np.sort(np.diff(time))
    step = float(steps[(len(steps) - 1) // 2] + steps[len(steps) // 2]) / 2  # np.median loads a package for it
    if step > _SLOWEST or step < _FASTEST:
        unit = recording.units["time"]
        asked = ask_unit_of_time(unit, 1 / step if step else math.inf, float(time[-1] - time[0]))
        raise DataError(
            f"{recording.name}: column time [{unit}]: a sample every {step:.4g} s; expected {_FASTEST:g} to "
            f"{_SLOWEST:g} s: {asked} --unit time=UNIT states it"
        )


def power_on_temperature(recording: Recording) -> float | None:
    """Return ``power_on_temperature`` of the head of the file, degC; None where it is missing, NaN where it is nan.

    Raises
    ------
    DataError
        It is there, but no temperature.
    """
    return head_temperature(recording, "power_on_temperature")


def first_reading(recording: Recording) -> float | None:
    """Return the first finite value of the column temperature, degC, or None where there is none."""
    if "temperature" not in recording or parse_unit(recording.units["temperature"]).quantity != "temperature":
        return None
    values = recording.column("temperature")
    finite = values[np.isfinite(values)]
    return to_si(float(finite[0]), recording.units["temperature"]) if finite.size else None


def with_power_on_temperature(blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Yield blocks; where the head states no power-on temperature, the first reading replaces it.

    Raises
    ------
    DataError
        Neither the head nor the column temperature of the first block holds one.
    """
    temperature: float | None = None
    for block in blocks:
        stated = power_on_temperature(block)
        if stated is not None and math.isfinite(stated):
            yield block
            continue
        temperature = first_reading(block) if temperature is None else temperature
        if temperature is None:
            raise DataError(
                f"{block.name}: no power_on_temperature in the head of the file, and no reading in a column "
                "temperature to take its place"
            )
        head = {"power_on_temperature": f"{temperature!r}", TAKEN_FROM: "the first reading of the column temperature"}
        yield replace(block, metadata={**block.metadata, **head})


def state_power_on(recording: Recording, example: str) -> str:
    """Return how to state the power-on temperature, degC, of a file or of a recording in memory, for a message."""
    if not recording.from_file:
        return (
            f"expected it in the metadata: Recording.from_frame(frame, metadata={{'power_on_temperature': {example}}})"
        )
    column = " there, or --temperature-column: the first reading of the column temperature"
    there = "" if first_reading(recording) is None else column
    return f"expected a line such as '# power_on_temperature: {example}'{there}"


def head_temperature(recording: Recording, key: str) -> float | None:
    """Return a temperature that the head of the file states, degC, or None where there is none.

    Raises
    ------
    DataError
        It is there, but no temperature.
    """
    text = recording.metadata.get(key)
    if text is None:
        return None
    number, _, symbol = text.strip().partition(" ")
    try:
        value, unit = float(number), parse_unit(symbol.strip() or "degC")
    except (ValueError, UnitError):
        value, unit = math.inf, None
    if unit is None or unit.quantity != "temperature" or math.isinf(value):
        raise DataError(f"{recording.name}: {key}: expected a temperature such as -20 or '-20 degC', found {text!r}")
    return to_si(value, unit.symbol)


# Description of data by a caller: layout of a foreign file, a part of it, units of arrays.


Data: TypeAlias = str | os.PathLike[str] | Recording | Frame | ArrayLike | Mapping[str, ArrayLike]
"""A file, a recording, a data frame of pandas or polars, an array of samples, or arrays by name."""
Ends: TypeAlias = tuple[float | None, float | None]
Window: TypeAlias = Annotated[str | Ends, "(FROM, TO) in s, such as (10, 60) or '10:60'"]
"""First and last time to read, s, each None for no bound; the bounds belong to the window."""


@dataclass(frozen=True, slots=True)
class LayoutColumn:
    """Where a column comes from (0-based number, or name in the header), and how it becomes a reading.

    A reading in `unit` is (what was read x `scale` - `zero`) / `scale_factor`. Dates become seconds since the first;
    `day_first` says whether 11/12 is in December, None that only dates which fit one way are read. A counter of so many
    `bits` is carried on where it begins again. `scale_from` is the word above the rows whose number is a factor of
    `scale`.
    """

    origin: int | str
    unit: str
    scale: float = 1.0
    zero: float = 0.0
    scale_factor: float = 1.0
    date: bool = False
    scale_from: str = ""
    day_first: bool | None = None
    bits: int = 0

    def convert(self, values: Array) -> None:
        """Turn what was read into readings, in place; a number that no reading can be becomes infinite."""
        with np.errstate(over="ignore", invalid="ignore"):
            if self.scale != 1.0:
                values *= self.scale
            if self.zero != 0.0:
                values -= self.zero
            if self.scale_factor != 1.0:
                values /= self.scale_factor


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the columns of a foreign file are.

    ``delimiter`` is one character, a blank meaning any run of blanks, or nothing where the file shows it; ``decimal`` a
    point or a comma; ``sample_rate`` in Hz or None; ``encoding`` that of the header's names; ``prefix`` the first field
    of the lines that count (what that field begins with, where the prefix ends with a colon), or nothing; ``text`` says
    that the file is delimited text whatever it looks like (it names a delimiter); ``if_needed`` that it is left out
    where a file says itself what its columns are; ``rate_from`` the word above the rows before the sample rate;
    ``marks`` texts of which one stands above the titles of such a file; ``packet`` says which row's stamp a packet of
    rows shares, the ``first`` or the ``last``, or nothing; ``labelled`` whether
    numbers stand behind their names.
    """

    columns: Mapping[str, LayoutColumn]
    delimiter: str = " "
    header: bool = False
    skip_lines: int = 0
    sample_rate: float | None = None
    metadata: Mapping[str, str] | None = None
    name: str = "layout"
    text: bool = False
    decimal: str = "."
    encoding: str = "utf-8"
    prefix: str = ""
    skip_incomplete: bool = False
    if_needed: bool = False
    rate_from: str = ""
    marks: tuple[str, ...] = ()
    packet: str = ""
    labelled: bool = False

    @property
    def starred(self) -> bool:
        """Whether a name has a ``*``, which stands for any text."""
        return any(isinstance(column.origin, str) and "*" in column.origin for column in self.columns.values())

    @property
    def named_numbers(self) -> bool:
        """Whether a scale or the sample rate stands above the rows."""
        return bool(self.rate_from) or any(column.scale_from for column in self.columns.values())

    @property
    def units(self) -> dict[str, str]:
        """Name to unit of the columns as `Readings` makes them."""
        known = {name: column.unit for name, column in self.columns.items()}
        return (
            known if self.sample_rate is None else {**({} if "time" in known else {"time": "s"}), **known, "time": "s"}
        )

    def behind_prefix(self, fields: list[str]) -> list[str] | None:
        """Return the fields of a line after the prefix, None where it does not begin with it."""
        first = fields[0].strip()
        if not self.prefix:
            return fields
        if first == self.prefix:
            return fields[1:]
        glued = self.prefix.endswith(":") and first.startswith(self.prefix)
        return [first.removeprefix(self.prefix), *fields[1:]] if glued else None

    def skipped(self, count: int, *, so_far: bool = False) -> str:
        """Return a note on how many rows were skipped by ``skip_incomplete``."""
        what, lack = ("rows were", "lack") if count > 1 else ("row was", "lacks")
        columns, far = " ".join(self.columns), " so far" if so_far else ""
        return Note(f"{count} {what}{far} skipped that {lack} a reading of {columns} (skip_incomplete in {self.name})")


DAMAGED = ("refuse", "skip")
"""What to do with lines of text that cannot be read."""


EVERY = "all"
"""The instance that stands for all of a flight log."""


def instance_number(value: int | str, called: str) -> int | str:
    """Return the number of an instance, from 0, or `EVERY`.

    Raises
    ------
    OptionError
        It is neither.
    """
    if isinstance(value, str) and value == EVERY:
        return EVERY
    try:
        number = whole(value, called)
    except OptionError as error:
        raise OptionError(f"{error}, or {EVERY}{meant([EVERY], value)}") from None
    if number < 0:
        raise OptionError(f"{called} {number}: expected a number from 0")
    return number


class Part(TypedDict, total=False):
    """How data are to be understood: arrays and data frames by `time` to `units`, files by `units` to `instance`.

    Attributes
    ----------
    time
        Times of an array, s, shape (n,).
    unit
        Unit of the sensors whose quantity it measures.
    units
        Units by sensor or column, such as accel=g,gyro=deg/s; of a file, in place of those that it says.
    layout
        Columns of a foreign file; see imulab show --formats.
    topic
        Topic of a bag or log, where there are several; with a comma, the magnetometer's beside it.
    instance
        Sensor of a flight log, from 0, or all, as whole IMUs on one clock; not given, the first, all for --imus.
    element
        One IMU of a file of several, from 1.
    damaged
        Lines of text that cannot be read: refuse them, or skip and count them.
    serial
        Serial number of the unit, in place of the one in the data's head.
    """

    time: Annotated[ArrayLike | None, PROGRAM]
    unit: Annotated[str | None, PROGRAM]
    units: Annotated[Mapping[str, str] | None, parsed(parse_units, "NAME=UNIT", flags=("--unit",)), READING]
    layout: Annotated[str | os.PathLike[str] | Layout | None, file("NAME|L.toml"), READING]
    topic: Annotated[str | None, text("TOPIC"), READING]
    instance: Annotated[int | str | None, parsed(instance_number, "N|all", (EVERY,)), READING]
    element: Annotated[int | None, parsed(whole_number, "N"), READING]
    damaged: Annotated[str | None, choice(DAMAGED), READING]
    serial: Annotated[str | None, text("TEXT"), READING]


class Sampling(Part, total=False):
    """The same, and how often arrays were sampled.

    Attributes
    ----------
    rate
        Samples per second, Hz, of arrays without `time`.
    """

    rate: float | None


class Reading(Sampling, total=False):
    """The same, and which part of them.

    Attributes
    ----------
    window
        Part to read; either side may be left out. First and last time, s, as ``(10, 60)`` or ``"10:60"``;
        ``"+10:+60"`` counts from the first sample.
    """

    window: Annotated[Window | None, parsed(span, "FROM:TO", unit="s"), READING]
