"""Conversion of arrays and data frames to the columns of a recording, and back; pandas and polars are optional."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from imulab.arguments import described
from imulab.columns import TRIADS, check_name, clocks_of, example_unit, expected_quantities
from imulab.errors import DataError, OptionError, UnitError, listed, meant, quoted
from imulab.units import parse_unit

DEFAULT_UNITS = {"time": "s", **{f"time_{sensor}": "s" for sensor in (*TRIADS, "temperature")}, "temperature": "degC"}
"""Units of arrays without a stated one; a data frame states all its units."""
_LIBRARIES = ("pandas", "polars")
_WORDS = (*TRIADS, "temperature", "time", "rate", "unit", "units", "metadata", "name")
_OF_SENSORS = ("acceleration", "rate", "magnetic field", "output")
_LIKE_NUMBERS = "iufb"
_TEXTS = ("object", "str", "string", "category")
_TIMES = ("datetime64", "timedelta64")
_NUMBERS = ("float", "int", "uint", "bool", *_TIMES)

Columns = dict[str, NDArray[np.float64]]


class Frame(Protocol):
    """Methods that pandas and polars data frames have in common."""

    columns: Any

    def __getitem__(self, name: Any) -> Any:
        """Return a column."""


class Units(Struct):
    """Stated units: for single columns or sensors, and one for all sensors of its quantity.

    ``where`` is how a message says to state a unit that is missing, with ``{name}``, ``{sensor}`` and ``{unit}``.
    """

    name: str
    each: Mapping[str, str]
    common: str | None
    where: str
    defaults: Mapping[str, str] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        if not isinstance(self.each, Mapping) or not all(isinstance(v, str) for v in self.each.values()):
            raise OptionError(f"units {quoted(self.each)}: expected names and their units, such as {{'gyro': 'deg/s'}}")
        if self.common is not None:
            if not isinstance(self.common, str):
                raise OptionError(f"unit {quoted(self.common)}: expected a text such as 'g' or 'deg/s'")
            parse_unit(self.common, _OF_SENSORS)

    def of(self, column: str, stated: str | None = None) -> str:
        """Return the unit of a column; `stated` is that in its title."""
        stem = next((key for key in _stems(column) if key in self.each), None)
        if stem is not None:
            self.used.add(stem)
            symbol = self._known(column, self.each[stem])
            if stated is not None and self._known(column, stated) != symbol:
                raise OptionError(f"{self.name}: column {column} [{stated}]: units has {symbol!r} for it; expected one")
            return symbol
        if stated is not None:
            return self._known(column, stated)
        quantities = expected_quantities(column)
        sensor = next((part for part in TRIADS if part in _stems(column)), column)
        fits = quantities or (["magnetic field", "output"] if sensor in TRIADS else [])
        if self.common is not None and column not in DEFAULT_UNITS and parse_unit(self.common).quantity in fits:
            self.used.add("unit")
            return parse_unit(self.common).symbol
        default = self.defaults.get(column)
        if default is not None:
            return default
        if quantities is None and sensor not in TRIADS:
            return "1"
        how = self.where.format(name=column, sensor=sensor, unit=example_unit(column))
        other = "" if self.common is None else f"; unit {self.common!r} is one of {parse_unit(self.common).quantity}"
        raise UnitError(f"{self.name}: column {column} has no unit; expected {how}{other}")

    def check_used(self, columns: Iterable[str]) -> None:
        """Refuse a stated unit that belongs to no column."""
        known = list(dict.fromkeys(stem for column in columns for stem in _stems(column)))
        for key in self.each:
            if key not in self.used:
                raise OptionError(f"{self.name}: units: no column {quoted(key)}; columns: {listed(known, key)}")
        if self.common is not None and "unit" not in self.used:
            raise OptionError(
                f"{self.name}: unit {self.common!r}: expected that of a column that has none of its own; found "
                f"{' '.join(known)}"
            )

    def _known(self, column: str, symbol: str) -> str:
        """Return a unit as it is spelt here; a column outside the vocabulary may have any."""
        try:
            return parse_unit(symbol, expected_quantities(column) or ()).symbol
        except UnitError as error:
            if expected_quantities(column) is None and symbol:
                return symbol
            raise UnitError(f"{self.name}: column {column}: {error}") from None


def columns_of_arrays(
    arrays: Mapping[str, Any],
    *,
    rate: float | None,
    unit: str | None,
    units: Mapping[str, str] | None,
    name: str,
) -> tuple[Columns, dict[str, str]]:
    """Return columns and units of arrays by name: a sensor's of shape (n, 3), others of shape (n,).

    A name may have its unit behind it, ``accel [g]``. Without `rate` and without an array ``time`` the rows are
    attitudes.

    Raises
    ------
    DataError
        An array has another shape, holds no numbers, or is longer than the others.
    UnitError
        A sensor has no unit, or one of another quantity.
    OptionError
        A name is nearly one of those known, or time is stated twice.
    """
    where = "units={{'{sensor}': '{unit}'}}"
    known_units = Units(name, units or {}, unit, where, DEFAULT_UNITS)
    entries = [
        part for title, values in arrays.items() if values is not None for part in _split(str(title), values, name)
    ]
    return _put_together(entries, known_units, rate)


def columns_of_frame(
    frame: Frame,
    *,
    rate: float | None,
    unit: str | None,
    units: Mapping[str, str] | None,
    name: str,
) -> tuple[Columns, dict[str, str]]:
    """Return columns and units of a pandas or polars data frame; times may stand in its index.

    Raises
    ------
    DataError
        A column holds no numbers, or appears twice.
    UnitError
        A column of the vocabulary has no unit, or one of another quantity.
    OptionError
        Time is stated twice.
    """
    if not is_frame(frame):
        raise DataError(f"expected a data frame of pandas or polars, found {described(frame)}")
    where = "a title such as '{name} [{unit}]', or units={{'{sensor}': '{unit}'}}"
    known_units = Units(name, units or {}, unit, where)
    titles = {original: _joined(original) for original in frame.columns}
    if len(titles) < len(frame.columns):
        twice = next(title for title in titles if list(frame.columns).count(title) > 1)
        raise DataError(f"{name}: column {twice} appears twice")
    index = getattr(frame, "index", None)
    titles = _with_times(frame, titles, index, name)
    beside = texts_of(frame)
    entries = [
        (*_title(title, name), _column(frame[at], title, name)) for at, title in titles.items() if at not in beside
    ]
    if index is not None and not any(key == "time" for key, _, _ in entries):
        entries[:0] = _index_times(index, name, stated=rate is not None)
    return _put_together(entries, known_units, rate)


def _with_times(frame: Frame, titles: Mapping[Any, str], index: Any, name: str) -> dict[Any, str]:
    """Return titles in which the one column of dates or durations is called ``time``, unless the index holds times.

    Raises
    ------
    DataError
        Several columns hold dates, and none is called ``time``.
    """
    dated = [at for at in titles if _is_dated(frame[at])]
    named = [at for at, title in titles.items() if title.partition("[")[0].strip() == "time"]  # [s]: numbers
    if index is not None and _dtype(index).startswith(_TIMES):
        return dict(titles)
    if not named and len(dated) > 1:
        known = " ".join(titles[at] for at in dated)
        raise DataError(f"{name}: several columns hold dates ({known}); expected the one of the samples called 'time'")
    return dict(titles) if named else {**titles, **dict.fromkeys(dated, "time")}


def texts_of(frame: Frame) -> list[Any]:
    """Return the titles of columns of texts that are no sensor's, such as labels: they are not read."""

    def is_text(column: Any) -> bool:
        return isinstance(next((value for value in column if value is not None and value == value), None), str)

    return [at for at in foreign_of(frame) if not _dtype(frame[at]).startswith(_NUMBERS) and is_text(frame[at])]


def foreign_of(frame: Frame) -> list[Any]:
    """Return the titles of columns that are no sensor's, nor a time: no record corrects them."""

    def known(key: str) -> bool:
        return expected_quantities(key) is not None or any(stem in TRIADS for stem in _stems(key))

    return [at for at in frame.columns if not known(name_of(at)) and not _is_dated(frame[at])]


def name_of(title: Any) -> str:
    """Return the name in a title ``name [unit]``."""
    return _joined(title).partition("[")[0].strip()


def _is_dated(column: Any) -> bool:
    """Return whether a column holds dates or durations: of NumPy, pandas, polars, or Python's own objects."""
    if _dtype(column).startswith((*_TIMES, "datetime", "duration")):
        return True
    if _dtype(column) != "object":
        return False
    return isinstance(next((value for value in column if value is not None), None), datetime)


def _is_date(value: Any) -> bool:
    """Return whether an object is a date, and not pandas' missing one, which is no number of a year."""
    return isinstance(value, datetime) and value.year == value.year


def is_frame(value: object) -> bool:
    """Return whether an object has the methods of a data frame that are used here."""
    return hasattr(value, "shape") and hasattr(value, "columns") and hasattr(value, "__getitem__")


def frame_library(frame: object) -> str:
    """Return the library of a data frame, as `data_frame` takes it."""
    return type(frame).__module__.partition(".")[0]


def data_frame(columns: Mapping[str, Any], library: str | None = None) -> Any:
    """Return columns as a data frame of pandas or polars; without a `library` of pandas, or else of polars.

    Raises
    ------
    OptionError
        Another library.
    DataError
        It is not installed.
    """
    if library not in (None, *_LIBRARIES):
        raise OptionError(f"library {library!r}: expected one of {listed(_LIBRARIES, library)}")
    for name in _LIBRARIES if library is None else (library,):
        try:
            return import_module(name).DataFrame(dict(columns))
        except ImportError:
            continue
    raise DataError(
        f"to_frame needs {library or ' or '.join(_LIBRARIES)}, which is not installed: pip install "
        f"{library or _LIBRARIES[0]}"
    )


def _stems(column: str) -> list[str]:
    """Return ``truth_gyro_x_3`` and its beginnings: ``truth_gyro_x``, ``truth_gyro``, and those of ``gyro_x_3``."""
    stems = []
    for whole in dict.fromkeys((column, re.sub("^(truth|std)_", "", column))):
        parts = whole.split("_")
        stems += ["_".join(parts[:count]) for count in range(len(parts), 0, -1)]
    return [stem for stem in stems if stem not in ("truth", "std")]


def _joined(title: Any) -> str:
    """Return a title as text; one of several levels with ``_`` between them."""
    return "_".join(str(part) for part in title if str(part)) if isinstance(title, tuple) else str(title)


def _title(title: str, name: str) -> tuple[str, str | None]:
    """Return name and unit of a title ``name [unit]``."""
    key, bracket, rest = title.strip().partition("[")
    key = key.strip()
    check_name(key, title, name)
    if not bracket:
        return key, None
    if not rest.endswith("]"):
        raise UnitError(f"{name}: column title {title.strip()!r}: expected 'name [unit]'")
    return key, rest[:-1].strip()


def _split(title: str, values: Any, name: str) -> Iterator[tuple[str, str | None, Any]]:
    """Yield the columns of an array: one, or three of a triad."""
    key, unit = _title(title, name)
    if key not in _WORDS and expected_quantities(key) is None and (hint := meant(_WORDS, key, 0.7)):
        raise OptionError(f"{name}: unknown name {key!r}{hint}")
    array = _numbers(values, key, name)
    if array.ndim == 2 and array.shape[1] == 3:
        yield from ((f"{key}_{axis}", unit, array[:, i]) for i, axis in enumerate("xyz"))
    elif array.ndim == 1 and key not in TRIADS:
        yield key, unit, array
    else:
        shape = "(n, 3)" if key in TRIADS else "(n,)"
        turned = " (transposed?)" if array.ndim == 2 and array.shape[0] == 3 else ""
        raise DataError(f"{name}: {key}: expected an array of shape {shape}, found {array.shape}{turned}")


def _numbers(column: Any, title: str, name: str) -> NDArray[Any]:
    """Return an array of floats, or of times; missing values are NaN."""
    try:
        values = column.to_numpy() if hasattr(column, "to_numpy") else unmasked(column)
        if values.dtype.kind == "O" and _dtype(column).startswith(_TIMES):
            values = column.to_numpy(dtype="datetime64[ns]")  # pandas' dates of a time zone
        elif values.dtype.kind == "O" and hasattr(column, "array") and _dtype(column) not in _TEXTS:
            values = column.to_numpy(dtype=np.float64, na_value=np.nan)  # pandas' own numbers, some of them missing
        elif values.dtype.kind == "O":
            values = _convert_objects(values)
    except (TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{name}: column {title}: expected numbers ({error})") from None
    if values.dtype.kind in _LIKE_NUMBERS:
        return np.asarray(values, dtype=np.float64)
    if values.dtype.kind in "mM" and _title(title, name) == ("time", None):
        return values
    raise DataError(f"{name}: column {title}: expected numbers, found {_kind(column, values)}")


def unmasked(values: Any) -> NDArray[Any]:
    """Return an array with NaN for the masked values of a masked array."""
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        return np.ma.filled(values.astype(np.float64), np.nan)
    return np.asarray(values)


def _convert_objects(values: NDArray[Any]) -> NDArray[Any]:
    """Return an array of Python objects as numbers or dates; texts and other objects stay."""
    kinds = {type(value) for value in values.flat}
    if any(issubclass(kind, str | bytes) for kind in kinds):
        return values
    first = next((value for value in values.flat if _is_date(value)), None)
    if first is not None and all(issubclass(kind, (datetime, float, type(None))) for kind in kinds):
        return np.array(
            [value - first if _is_date(value) else np.timedelta64("NaT") for value in values], dtype="timedelta64[us]"
        )
    return values.astype(np.float64)


def _column(column: Any, title: str, name: str) -> NDArray[Any]:
    """Return a column of a data frame, shape (n,)."""
    values = _numbers(column, title, name)
    if values.ndim != 1:
        raise DataError(f"{name}: column {title}: expected a number in each row, found {values.shape[1:]} of them")
    return values


def _index_times(index: Any, name: str, *, stated: bool) -> list[tuple[str, str | None, NDArray[Any]]]:
    """Return the times in an index as a column, or None where it only counts the rows.

    Raises
    ------
    DataError
        It may hold times, but does not say so: rows without a time would be taken for attitudes at rest.
    """
    title = str(index.name) if getattr(index, "name", None) is not None else ""
    if _dtype(index).startswith(_TIMES):
        return [("time", None, _numbers(index, "time", name))]
    if title.partition("[")[0].strip() == "time":
        return [(*_title(title, name), _column(index, title, name))]
    if not stated and _dtype(index).startswith(("period", "float")):
        raise DataError(
            f"{name}: the index holds {_dtype(index)} and there is no column 'time'; expected an index of dates or "
            "durations, one named 'time [s]', or reset_index(drop=True) where it is no time"
        )
    return []


def _dtype(column: Any) -> str:
    """Return the name of a column's type."""
    return str(getattr(column, "dtype", "object")).lower()


def _kind(column: Any, values: NDArray[Any]) -> str:
    return "texts" if values.dtype.kind in "OU" else str(getattr(column, "dtype", values.dtype))


def _put_together(
    entries: list[tuple[str, str | None, NDArray[Any]]], units: Units, rate: float | None
) -> tuple[Columns, dict[str, str]]:
    """Return columns and units of equal length, with a time of the stated rate; few samples are followed by NaN."""
    columns: Columns = {}
    symbols: dict[str, str] = {}
    clocks = clocks_of(key for key, _, _ in entries)
    for key, stated, values in entries:
        if key in columns:
            raise DataError(f"{units.name}: column {key} appears twice")
        first = next((name for name in columns if clocks[name] == clocks[key]), key)
        if key != first and len(values) != len(columns[first]):
            raise DataError(
                f"{units.name}: {key} has {len(values)} rows, {first} has {len(columns[first])}: expected as many"
            )
        if values.dtype.kind in "mM":
            columns[key], symbols[key] = _seconds(values), "s"
        else:
            columns[key], symbols[key] = np.ascontiguousarray(values), units.of(key, stated)
    if not columns:
        raise DataError(f"{units.name}: expected data, found no columns")
    if rate is not None:
        columns, symbols = _with_rate(columns, symbols, rate, units.name)
    units.check_used(columns)
    rows = max(map(len, columns.values()))
    for key, values in columns.items():
        if len(values) < rows:
            columns[key] = np.concatenate([values, np.full(rows - len(values), np.nan)])
    return columns, symbols


def _with_rate(columns: Columns, symbols: dict[str, str], rate: float, name: str) -> tuple[Columns, dict[str, str]]:
    """Return columns and units with a time that begins at 0."""
    if "time" in columns:
        raise OptionError(f"{name}: time and rate: expected one of the two, found both")
    if isinstance(rate, bool) or not isinstance(rate, int | float | np.number) or not 0 < rate < math.inf:
        raise OptionError(f"{name}: rate {quoted(rate)}: expected a number of samples per second, such as 100.0")
    count = len(next(iter(columns.values())))
    return {"time": np.arange(count) / float(rate), **columns}, {"time": "s", **symbols}


def _seconds(times: NDArray[Any]) -> NDArray[np.float64]:
    """Return dates or durations as seconds since the first date, or as they are."""
    known = times[~np.isnat(times)]
    since = times - known[0] if times.dtype.kind == "M" and known.size else times
    return np.asarray(since / np.timedelta64(1, "ns"), dtype=np.float64) * 1e-9
