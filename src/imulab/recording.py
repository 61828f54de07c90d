"""Recording: the samples of one test, as they were read, with their units."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError, UnitError, quoted
from imulab.printable import has_hidden, printable
from imulab.units import parse_unit, to_si

Array = NDArray[np.float64]

CORRECTED_BY = "corrected_by"
"""Key, in the head of a file, of each record that its samples were corrected by."""
_QUANTITIES = {
    "time": ("time",),
    "accel": ("acceleration", "output"),
    "gyro": ("rate", "output"),
    "dtg": ("rate", "output"),
    "fog": ("rate", "output"),
    "temperature": ("temperature", "output"),
    "table_angle": ("angle", "output"),
}
_ELEMENT = re.compile(r"(?:accel|gyro)(?:_[xyz])?_(\d+)")
_CLOCK = re.compile(r"(?:t|time|timestamp|seconds)(?:(?: ?\(|[ _.])(s|ms|us|ns|min|h)\)?)?")
"""What loggers call the time, and the unit in it."""


@dataclass(frozen=True, slots=True)
class Source:
    """A file that a recording was read from, and the SHA-256 of its bytes."""

    file: str
    sha256: str


class Frame(Protocol):
    """What pandas and polars data frames have in common."""

    columns: Any

    def __getitem__(self, name: str) -> Any:
        """Return a column."""


@dataclass(frozen=True)
class Recording:
    """The samples of one test: columns as read with their units; SI arrays are derived on request.

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
        What the reader did to the data that a user should know.
    corrected_by
        The records that the samples were corrected by, ``NAME sha256:HASH`` each.
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

    def __post_init__(self) -> None:
        lengths = {len(column) for column in self.columns.values()}
        if len(lengths) > 1:
            raise DataError(f"{self.name}: columns of different length: {sorted(lengths)}")
        for name in self.columns:
            if has_hidden(name):
                raise DataError(f"{self.name}: column name {printable(name)!r} holds a control character")
            check_unit(name, self.units.get(name, ""), self.name)
        if any(has_hidden(text) for pair in self.metadata.items() for text in pair):
            clean = {printable(key): printable(value) for key, value in self.metadata.items()}
            object.__setattr__(self, "metadata", clean)
        object.__setattr__(self, "units", {name: self.units.get(name, "1") for name in self.columns})

    def __repr__(self) -> str:
        titles = ", ".join(f"{name} [{unit}]" for name, unit in self.units.items())
        return f"Recording({self.name}: {len(self)} samples of {titles})"

    def __len__(self) -> int:
        for column in self.columns.values():
            return len(column)
        return 0

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def place(self, index: int) -> str:
        """Return how messages name sample `index`: ``row 50 (line 51)``."""
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
            foreign = all(_expected(other) in (None, ("time",)) for other in self.columns)
            several = sorted({number for other in self.columns if (number := element_number(other, name)) is not None})
            if several:
                raise DataError(
                    f"{self.name}: no column {name}, but one of each of {len(several)} IMUs; choose one, from "
                    f"{several[0]} to {several[-1]} (--element {several[0]})"
                ) from None
            said = next((note for note in self.notes if "--layout" in note), None)
            said = said or "a layout says where columns of other names are (--layout; docs/recordings.md)"
            hint = f"; {said}" if foreign else ""
            raise DataError(f"{self.name}: no column {name}; found {' '.join(self.columns)}{hint}") from None

    def si(self, name: str) -> Array:
        """Return the samples of a column in SI (counts and volts as they are), shape (n,)."""
        return to_si(self.column(name), self.units[name])

    @property
    def time(self) -> Array | None:
        """Time of each sample, s, shape (n,), or None for a table without a time column."""
        return self.si("time") if "time" in self.columns else None

    def triad(self, sensor: str) -> Array:
        """Return the three columns ``<sensor>_x``, ``_y``, ``_z`` as read, shape (n, 3).

        Raises
        ------
        DataError
            A column is missing.
        """
        return np.column_stack([self.column(f"{sensor}_{axis}") for axis in "xyz"])

    def triad_unit(self, sensor: str) -> str:
        """Return the unit that the three columns of a triad share.

        Raises
        ------
        UnitError
            They have different units.
        """
        names = [f"{sensor}_{axis}" for axis in "xyz"]
        for name in names:
            self.column(name)
        units = {name: parse_unit(self.units[name]).symbol for name in names}
        if len(set(units.values())) > 1:
            found = ", ".join(f"{name} [{unit}]" for name, unit in units.items())
            raise UnitError(f"{self.name}: the axes of a triad must share one unit, found {found}")
        return units[names[0]]

    def mean_temperature(self) -> float | None:
        """Return the mean temperature, degC: of the column, or else as the head of the file states it."""
        if "temperature" in self.columns and parse_unit(self.units["temperature"]).quantity == "temperature":
            values = self.si("temperature")
            values = values[np.isfinite(values)]
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

    def with_columns(self, columns: Mapping[str, Array], units: Mapping[str, str]) -> Recording:
        """Return a copy in which some columns are replaced (or added at the end)."""
        return replace(self, columns={**self.columns, **columns}, units={**self.units, **units})

    @classmethod
    def from_frame(cls, frame: Frame, name: str = "frame") -> Recording:
        """Make a recording from a pandas or polars data frame with columns named ``name [unit]``."""
        columns, units = {}, {}
        for title in frame.columns:
            key, unit = parse_column_title(str(title), name)
            if key in columns:
                raise DataError(f"{name}: column {key} appears twice")
            values = frame[title].to_numpy()
            if values.dtype.kind not in "iufb":
                raise DataError(f"{name}: column {key}: expected numbers, found {values.dtype}")
            columns[key] = np.asarray(values, dtype=np.float64)
            units[key] = unit
        return cls(columns=columns, units=units, name=name)

    def to_frame(self) -> Any:
        """Return a polars data frame with columns named ``name [unit]`` (needs polars)."""
        try:
            import polars
        except ImportError:
            raise DataError("to_frame needs polars: pip install polars") from None
        return polars.DataFrame({f"{name} [{self.units[name]}]": values for name, values in self.columns.items()})


def element_number(column: str, stem: str = "") -> int | None:
    """Return which of several IMUs a column such as ``accel_x_7`` (of the stem ``accel_x``) is of, None for others."""
    match = _ELEMENT.fullmatch(column)
    return int(match[1]) if match and column.startswith(f"{stem}_" if stem else "") else None


def parse_column_title(title: str, file: str) -> tuple[str, str]:
    """Split ``name [unit]``; a name outside the vocabulary may come without a unit.

    Raises
    ------
    UnitError
        No unit on a column that needs one, or an unknown unit.
    """
    name, bracket, rest = title.strip().strip('"').strip().partition("[")
    name = name.strip()
    _check_name(name, title, file)
    if not bracket:
        if _expected(name) is None:
            return name, "1"
        raise UnitError(f"{file}: column {name} has no unit; expected a title such as '{name} [{_example(name)}]'")
    if not rest.rstrip().endswith("]"):
        raise UnitError(f"{file}: column title {title.strip()!r}: expected 'name [unit]'")
    symbol = rest.rstrip()[:-1].strip()
    try:
        return name, parse_unit(symbol).symbol
    except UnitError as error:
        if _expected(name) is None and symbol:
            return name, symbol  # not ours to convert: it passes through
        raise UnitError(f"{file}: column {name}: {error}") from None


def _check_name(name: str, title: str, file: str) -> None:
    """Refuse what is meant as a name of the vocabulary but is not one."""
    if has_hidden(title.replace("\t", "")):
        raise UnitError(f"{file}: column title {quoted(title.strip())}: expected plain text, found a control character")
    if ";" in title or "\t" in title or title.count("[") > 1:
        mark = "';'" if ";" in title else "a tab" if "\t" in title else "blanks"
        raise UnitError(
            f"{file}: titles {title.strip()[:40]!r}: separated by {mark}, expected ','; describe the file with "
            "--layout FILE.toml (imulab show --formats has an example)"
        )
    lower = name.lower()
    clock = _CLOCK.fullmatch(lower)
    meant = "time" if clock else lower.replace(" ", "_")
    if meant != name and _expected(meant) is not None:
        example = f", in a title such as 'time [{clock[1]}]'" if clock and clock[1] else ""
        raise UnitError(f"{file}: column {name!r}: expected the name {meant!r}{example}")


def _expected(name: str) -> tuple[str, ...] | None:
    stem = name.removeprefix("truth_").removeprefix("std_")
    for prefix, quantities in _QUANTITIES.items():
        if stem == prefix or stem.startswith(prefix + "_"):
            return quantities
    return None


def _example(name: str) -> str:
    return {"time": "s", "acceleration": "m/s^2", "rate": "deg/s", "temperature": "degC", "angle": "deg"}[
        (_expected(name) or ("time",))[0]
    ]


def check_unit(name: str, unit: str, file: str) -> None:
    """Check that a column of the vocabulary has a unit of its quantity.

    Raises
    ------
    UnitError
        It has none, or one of another quantity.
    """
    expected = _expected(name)
    if expected is None:
        return
    quantity = parse_unit(unit).quantity if unit else "nothing"
    if quantity not in expected:
        raise UnitError(
            f"{file}: column {name}: expected a unit of {' or '.join(expected)}, found {unit!r} ({quantity})"
        )


def check_finite(recording: Recording, names: list[str]) -> None:
    """Check that the named columns hold finite numbers only.

    Raises
    ------
    DataError
        NaN or infinity; the message names column and row of the first, and their count.
    """
    for name in names:
        values = recording.column(name)
        finite = np.isfinite(values)
        if not finite.all():
            index = int(np.argmin(finite))
            count = int(np.size(finite) - np.count_nonzero(finite))
            more = f" (and {count - 1} more)" if count > 1 else ""
            raise DataError(
                f"{recording.name}: {recording.place(index)}, column {name}: "
                f"expected a finite number, found {values[index]}{more}"
            )


def check_time(recording: Recording) -> Array:
    """Check that time rises from sample to sample and return it, s, shape (n,).

    Raises
    ------
    DataError
        Time runs backwards or stands still; the message names the row.
    """
    check_finite(recording, ["time"])
    time = recording.si("time")
    step = np.diff(time)
    if step.size and not step.min() > 0:
        index = int(np.argmax(step <= 0)) + 1
        raw = recording.column("time")
        verb = "stands still" if step[index - 1] == 0 else "runs backwards"
        unit = recording.units["time"]
        raise DataError(
            f"{recording.name}: {recording.place(index)}, column time: time {verb}: "
            f"expected more than {raw[index - 1]:.15g} {unit}, found {raw[index]:.15g} {unit}"
        )
    return time
