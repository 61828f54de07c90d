"""Layout files: where the columns of a foreign file are, and in which units; `EXAMPLE` has every key."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imulab.errors import ReadError, UnitError
from imulab.recording import check_unit
from imulab.units import parse_unit, to_si

EXAMPLE = """\
delimiter = "whitespace"                        # or "," ";" "\\t"
decimal = "."                                   # or "," where numbers are written 9,81
header = false                                  # true: the first line names the columns
skip_lines = 0                                  # lines above the header or the data
# sample_rate = { value = 100, unit = "Hz" }    # instead of time, where no column holds it
[columns]
time = { from = 0, unit = "s" }                 # 0-based number, or a name in the header
accel_x = { from = 1, unit = "count" }
accel_y = { from = 2, unit = "count" }
accel_z = { from = 3, unit = "count" }
[metadata]
serial = "SN42"
"""
_DELIMITERS = {"whitespace": " ", " ": " ", ",": ",", ";": ";", "\t": "\t"}
_KEYS = ("columns", "delimiter", "header", "metadata", "sample_rate", "skip_lines", "decimal")


@dataclass(frozen=True, slots=True)
class LayoutColumn:
    """Where a column comes from (0-based number, or name in the header) and its unit."""

    origin: int | str
    unit: str


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the columns of a foreign file are.

    ``delimiter`` is one character, a blank meaning any run of blanks; ``decimal`` a point or a comma; ``sample_rate``
    in Hz or None; ``text`` says that the file is delimited text whatever it looks like (it names a delimiter).
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


def load_layout(path: str | Path, name: str | None = None) -> Layout:
    """Read a layout file; `name` is what messages call it, its path if not given.

    Raises
    ------
    ReadError
        The file is missing, is not TOML, or has a key or value that a layout cannot have.
    UnitError
        A unit is unknown or does not belong to its column.
    """
    name = name or str(path)
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ReadError(f"{name}: no such layout file") from None
    except IsADirectoryError:
        raise ReadError(f"{name}: expected a layout file, found a folder") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ReadError(f"{name}: the layout cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ReadError(f"{name}: the layout is not TOML: {error}") from None
    return _layout(table, name)


def _layout(table: dict[str, Any], path: str) -> Layout:
    unknown = sorted(set(table) - set(_KEYS))
    if unknown:
        raise ReadError(f"{path}: unknown key {unknown[0]!r}; known keys: {' '.join(_KEYS)}")
    delimiter = table.get("delimiter", "whitespace")
    if not isinstance(delimiter, str) or delimiter not in _DELIMITERS:
        raise ReadError(f"{path}: delimiter {delimiter!r}; expected 'whitespace' ',' ';' or a tab")
    decimal = table.get("decimal", ".")
    if decimal not in (".", ",") or decimal == delimiter:
        raise ReadError(f"{path}: decimal {decimal!r}; expected '.' or ',', and another sign than the delimiter")
    columns = table.get("columns")
    if not isinstance(columns, dict) or not columns:
        raise ReadError(f'{path}: no [columns]; expected lines such as accel_x = {{ from = 1, unit = "count" }}')
    skip_lines = table.get("skip_lines", 0)
    if type(skip_lines) is not int or skip_lines < 0:
        raise ReadError(f"{path}: skip_lines = {skip_lines!r}; expected a number of lines")
    if not isinstance(table.get("header", False), bool):
        raise ReadError(f"{path}: header = {table['header']!r}; expected true or false")
    parsed = {name: _column(name, entry, path) for name, entry in columns.items()}
    metadata = table.get("metadata", {})
    if not isinstance(metadata, dict):
        raise ReadError(f"{path}: metadata = {metadata!r}; expected a table of keys and texts")
    sample_rate = _sample_rate(table.get("sample_rate"), path)
    if sample_rate is not None and "time" in parsed:
        raise ReadError(f"{path}: both a time column and sample_rate; expected one of them")
    return Layout(
        columns=parsed,
        delimiter=_DELIMITERS[delimiter],
        header=table.get("header", False) or any(isinstance(c.origin, str) for c in parsed.values()),
        skip_lines=skip_lines,
        sample_rate=sample_rate,
        metadata={key: str(value) for key, value in metadata.items()},
        name=path,
        text="delimiter" in table,
        decimal=decimal,
    )


def _column(name: str, entry: Any, path: str) -> LayoutColumn:
    example = f'{name} = {{ from = 1, unit = "count" }}'
    if not isinstance(entry, dict) or "from" not in entry or "unit" not in entry:
        raise ReadError(f"{path}: column {name}: expected {example}, found {entry!r}")
    if set(entry) != {"from", "unit"}:
        extra = sorted(set(entry) - {"from", "unit"})[0]
        raise ReadError(f"{path}: column {name}: unknown key {extra!r}; known keys: from unit")
    origin = entry["from"]
    if not (isinstance(origin, str) or (type(origin) is int and origin >= 0)):
        raise ReadError(f"{path}: column {name}: from = {origin!r}; expected a column number from 0, or a name")
    try:
        unit = parse_unit(str(entry["unit"])).symbol
    except UnitError as error:
        raise UnitError(f"{path}: column {name}: {error}") from None
    check_unit(name, unit, path)
    return LayoutColumn(origin, unit)


def _sample_rate(entry: Any, path: str) -> float | None:
    if entry is None:
        return None
    if isinstance(entry, int | float) and not isinstance(entry, bool):
        entry = {"value": entry, "unit": "Hz"}
    if not isinstance(entry, dict) or set(entry) != {"value", "unit"} or entry["unit"] != "Hz":
        raise ReadError(f'{path}: sample_rate: expected {{ value = 100, unit = "Hz" }}, found {entry!r}')
    value = entry["value"]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e9:
        raise ReadError(f"{path}: sample_rate: expected a positive number of Hz, found {value!r}")
    return to_si(float(value), "Hz")
