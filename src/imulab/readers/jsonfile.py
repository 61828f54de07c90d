"""JSON through a layout: an array of records, one record a line, or an object of arrays; ``from = "acc.x"``.

A name leads from key to key. The first array that it meets holds the rows; the rest of the name is looked up in each.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

import imulab.readers._text as _text
from imulab.display import Note
from imulab.errors import ReadError, meant
from imulab.files import open_file
from imulab.readers.arrays import FLAT, origins, recordings
from imulab.readers.text import EITHER_ORDER, are_torn, date_flags, of_few
from imulab.recording import Array, Layout, Recording
from imulab.records.calibration import FORMAT

LARGEST = 20_000_000
"""Bytes of a file: what they hold may take 35 times as many in memory."""
DEEP = "nests arrays or objects hundreds of levels deep; expected records"
_LISTED = 20  # keys that a message lists


class KeysError(ReadError):
    """A JSON file of which no layout says which key is what."""


class _Literal(str):
    """NaN, Infinity or -Infinity, which some programs write and JSON does not have."""


def blocks(path: Path, name: str, layout: Layout | None, *, skip_damaged: bool = False) -> Iterator[Recording]:
    """Yield the columns that a layout names; the file is held in memory. Torn lines of records may be left out.

    Raises
    ------
    ReadError
        The file is too large or not JSON, there is no layout, or a key is not there or holds no numbers.
    """
    size = path.stat().st_size
    if size > LARGEST:
        raise ReadError(
            f"{name}: {size / 1e6:.0f} MB of JSON; expected at most {LARGEST / 1e6:.0f} MB, which are held in memory "
            "as a whole: write CSV, or several files"
        )
    try:
        with open_file(path) as stream:
            document, torn = _document(stream.read(), name, skip_damaged=skip_damaged)
        if isinstance(document, dict) and document.get("format") == FORMAT:
            raise ReadError(f"{name}: expected a recording, found JSON (a calibration record?)")
        if layout is None:
            keys = _listed(_names(document))
            raise KeysError(
                f"{name}: not a calibration record; of a recording --layout says which key is what; found {keys}"
            )
    except RecursionError:
        raise ReadError(f"{name}: {DEEP}") from None
    values = {}
    for column, (key, number) in origins(layout, name, "JSON").items():
        where = f"{name}: {layout.name} takes {column} from {key!r}"
        flat = FLAT.fullmatch(key)
        if flat is None:
            values[column] = _values(document, key, number, where, layout.skip_incomplete)
        else:
            numbers = _values(document, flat[1], None, where, layout.skip_incomplete)
            values[column] = _every(numbers, int(flat[2]), int(flat[3]), where)
    for block in _blocks(values, layout, name):
        yield replace(block, notes=(*block.notes, *torn)) if torn else block


def _document(data: bytes, name: str, *, skip_damaged: bool) -> tuple[Any, list[str]]:
    """Return what a file holds, and a note on torn lines of records that are left out."""
    try:
        return parsed_document(data, name), []
    except ReadError as error:
        lines = [line for line in data.decode("utf-8-sig", "replace").splitlines() if line.strip()]
        if sum(line.startswith("{") for line in lines) < 2:
            raise
        if not skip_damaged:
            raise ReadError(f"{error}; --damaged skip passes over such lines and counts them") from None
        records = [record for line in lines if (record := _record(line)) is not None]
        torn = len(lines) - len(records)
        if not are_torn(torn, len(records)):
            raise
        left_out = f"{torn} damaged line{'s are' if torn > 1 else ' is'} left out; the first: "
        return records, [of_few(left_out + str(error).removeprefix(f"{name}: "), torn, len(records))]


def _record(line: str) -> dict[str, Any] | None:
    try:
        record = _parsed(line.rstrip().rstrip(","))
    except ValueError:
        return None
    return record if isinstance(record, dict) else None


def parsed_document(data: bytes, name: str) -> Any:
    """Return what a file holds; of a record a line, the list of them."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ReadError(f"{name}: byte {error.start}: expected UTF-8 text, as JSON is") from None
    try:
        try:
            return _parsed(text)
        except json.JSONDecodeError as error:
            begun = text[: error.pos].strip()
            if error.msg != "Extra data" or not begun.startswith("{") or "\n" in begun:
                raise
            # Commas at the ends of lines move no line, and no column below the first.
            text = "[" + text.rstrip().replace("}\n", "},\n").replace("}\r\n", "},\r\n") + "]"
            return _parsed(text)
    except json.JSONDecodeError as error:
        _refuse(error, text, name)
    except ValueError:
        raise ReadError(f"{name}: a whole number of thousands of digits; expected readings") from None


def _parsed(text: str) -> Any:
    return json.loads(text, parse_constant=_Literal)


def _refuse(error: json.JSONDecodeError, text: str, name: str) -> NoReturn:
    end = "; the file ends there: was it cut?" if not text[error.pos :].strip(" \r\n\t]") else ""
    reason = error.msg[0].lower() + error.msg[1:]
    raise ReadError(f"{name}: line {error.lineno}, column {error.colno}: not JSON: {reason}{end}") from None


# --- from keys to columns ------------------------------------------------------------------------------------------


def _values(document: Any, key: str, number: int | None, where: str, skips: bool) -> list[Any]:
    """Return the values of a column, None where one is missing."""
    rows, rest = document, key
    while rest and isinstance(rows, dict):
        if rest in rows:
            rows, rest = rows[rest], ""
            continue
        first, _, after = rest.partition(".")
        if first not in rows:
            there = list(islice(_names(document), _LISTED + 1))
            raise ReadError(f"{where}: no such key, found {_listed(there)}{meant(there, key)}")
        rows, rest = rows[first], after
    if not isinstance(rows, list):
        raise ReadError(f"{where}: expected an array, found {_described(rows)}")
    values = [_inside(row, rest, number, index, where) for index, row in enumerate(rows, 1)]
    if KeyError not in values:
        return values
    index = values.index(KeyError)
    if skips and any(value is not KeyError for value in values):
        return [None if value is KeyError else value for value in values]
    there = list(islice(_names(rows[index]), _LISTED + 1))
    other = any(value is not KeyError for value in values)
    advice = "; skip_incomplete = true in the layout skips such rows" if other else ""
    raise ReadError(f"{where}: row {index + 1}: no such key, found {_listed(there)}{meant(there, rest)}{advice}")


def _every(numbers: list[Any], first: int, step: int, where: str) -> list[Any]:
    """Return every so manieth number of a flat array, ``x, y, z, x, y, z ..``."""
    if not first < step:
        raise ReadError(f"{where}: expected a first place below the step, such as [0::3] for x of x, y, z, x ..")
    if len(numbers) % step:
        raise ReadError(f"{where}: an array of {len(numbers)} numbers, which are no whole groups of {step}")
    return numbers[first::step]


def _inside(value: Any, rest: str, number: int | None, row: int, where: str) -> Any:
    """Return the value that a name leads to in a row; None for null, `KeyError` without such a key."""
    while rest and value is not None:
        if not isinstance(value, dict):
            raise ReadError(f"{where}: row {row}: expected an object with the key {rest!r}, found {_described(value)}")
        if rest in value:
            value, rest = value[rest], ""
            continue
        first, _, rest = rest.partition(".")
        value = value.get(first, KeyError) if rest else KeyError
        if value is KeyError:
            return KeyError
    if number is None or value is None:
        return value
    if not isinstance(value, list) or len(value) <= number:
        flat = f'; where x, y, z lie flat in one array, from = "..[{number}::3]"' if _is_number(value) else ""
        raise ReadError(
            f"{where}: row {row}: expected an array with a place [{number}], found {_described(value)}{flat}"
        )
    return value[number]


def _blocks(values: dict[str, list[Any]], layout: Layout, name: str) -> Iterator[Recording]:
    lengths = {column: len(entries) for column, entries in values.items()}
    count = min(lengths.values())
    rows, notes = np.arange(1, count + 1), tuple[Note, ...]()
    if layout.skip_incomplete and max(lengths.values()) == count:
        whole = np.array([None not in row for row in zip(*values.values(), strict=True)], dtype=bool)
        skipped = count - int(whole.sum())
        if skipped:
            reason = layout.skipped(skipped)
            if skipped == count:
                raise ReadError(f"{name}: no rows of data: {reason}")
            rows, notes = rows[whole], (Note(reason),)
            values = {key: [entries[row - 1] for row in rows.tolist()] for key, entries in values.items()}
            lengths = dict.fromkeys(values, len(rows))
    columns = {key: _column(key, entries, rows, layout, name) for key, entries in values.items()}
    take = {key: lambda start, stop, column=column: column[start:stop] for key, column in columns.items()}
    for block in recordings(take, lengths, layout, name):
        yield replace(block, notes=(*block.notes, *notes)) if notes else block


def _column(column: str, values: list[Any], rows: np.ndarray, layout: Layout, name: str) -> Array:
    """Return the values of a column as numbers; dates as nanoseconds in their bits, as `Readings` takes them."""
    entry = layout.columns[column]
    if not entry.date:
        wrong = next((i for i, value in enumerate(values) if not _is_number(value)), None)
        if wrong is None:
            return np.array(values, dtype=np.float64)
        expected = "a number"
    else:
        wrong = next((i for i, value in enumerate(values) if not isinstance(value, str) or "\n" in value), None)
        out = np.empty((1, len(values) + 1))
        if wrong is None:
            lines = "\n".join(values).encode("utf-8", "replace")
            read, problem, _ = _text.parse(lines, "\x1f", np.array([date_flags(entry)], np.int32), out, len(values))
            if not problem and read == len(values):
                return out[0, :read]
            if problem == EITHER_ORDER:
                raise ReadError(
                    f"{name}: row {rows[read]}, key {entry.origin!r}: {values[read]!r} may be day or month first; "
                    "expected day_first = true or false for this column in the layout"
                )
            wrong = read
        expected = "a date and time such as 2026-11-22T15:04:05.250Z"
    row = wrong + 1 if wrong >= len(rows) else rows[wrong]
    hint = " (missing readings are written null)" if isinstance(values[wrong], _Literal) else ""
    raise ReadError(
        f"{name}: row {row}, key {entry.origin!r}: expected {expected}, found {_described(values[wrong])}{hint}"
    )


def _is_number(value: Any) -> bool:
    """Return whether a value is a number within the range of a double, or missing."""
    return value is None or (type(value) in (int, float) and abs(value) <= 1.7976931348623157e308)


# --- words for messages --------------------------------------------------------------------------------------------


def _names(value: Any, prefix: str = "") -> Iterator[str]:
    """Yield the names that a layout can use; for a list of records, those of the first."""
    first = value[0] if isinstance(value, list) and value else value
    if not isinstance(first, dict):
        if prefix:
            yield prefix
        return
    for key, inside in first.items():
        yield from _names(inside, f"{prefix}.{key}" if prefix else key)


def _listed(names: Any) -> str:
    some = [name if len(name) <= 40 else name[:37] + "..." for name in islice(names, _LISTED + 1)]
    return (" ".join(some[:_LISTED]) + (" ..." if len(some) > _LISTED else "")) or "no keys"


def _described(value: Any) -> str:
    if isinstance(value, dict):
        return f"an object ({_listed(value)})"
    if isinstance(value, list):
        return f"an array of {len(value)}"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    shown = str(value) if isinstance(value, _Literal | float) else repr(value) if isinstance(value, str) else f"{value}"
    return shown if len(shown) <= 40 else shown[:37] + "..."
