"""The columns of a text file as a person states them: what a guess says of each, and the layout of what was stated.

A guess is refused as a whole where one unit is open; a person needs what is known of every column, also of files
without titles, and states the rest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from msgspec import Struct

from imulab.columns import KINDS, kind_of, triad
from imulab.errors import OptionError, ReadError, listed, quoted
from imulab.estimation.rows import median
from imulab.readers.formats import TEXT, recognised
from imulab.readers.guess import (
    DELIMITERS,
    GuessError,
    LayoutGuess,
    Table,
    fields_of_line,
    guess_table,
    layout_of_table,
    layout_text,
    likely_time_unit,
    lines_of_head,
    read_head,
    table_of_json,
)
from imulab.readers.titles import is_number, is_units_row, known_unit, read_title

_MOST_LINES = 500  # of the head in which a table without known titles is looked for
_FEWEST = 3  # rows alike that make a table
_MOST_COLUMNS = 200
_MOST_SENSORS = 4  # whose units may be open


class StatedColumn(Struct, frozen=True):
    """One column: its title in the file, what it is (``accel_x``, nothing where that is open), its unit, and why."""

    title: str
    column: str = ""
    unit: str = ""
    reason: str = ""


def table_of_file(file: str | Path) -> Table:
    """Return the first rows of a text or JSON file, with titles or without.

    Raises
    ------
    ReadError
        It holds no rows of numbers, or says itself what its columns are.
    """
    name = Path(file).name
    head = read_head(file, name)
    kind = recognised(head[:1024])
    if kind.module == "jsonfile":
        return table_of_json(head, name)
    if kind is not TEXT or b"\0" in head[:4096]:
        content = "binary data" if kind is TEXT else f"a {kind.name} file"
        raise ReadError(f"{name}: columns are stated for text, found {content}")
    lines, encoding = lines_of_head(head)
    try:
        return guess_table(lines, name, encoding=encoding)
    except GuessError:
        return _plain_table(lines, name, encoding)


def _plain_table(lines: list[str], name: str, encoding: str) -> Table:
    """Return the table of the longest run of lines with the same number of fields, most of them numbers."""
    best: tuple[int, str, int, list[list[str]]] | None = None
    for delimiter in DELIMITERS:
        begin, rows = 0, list[list[str]]()
        for number, line in enumerate(lines[:_MOST_LINES]):
            fields = fields_of_line(line, delimiter)
            numbers = sum(is_number(field.replace(",", ".") if delimiter != "," else field) for field in fields)
            if not (2 <= len(fields) <= _MOST_COLUMNS and 2 * numbers >= len(fields)):
                fields = []
            if not rows or len(fields) != len(rows[0]):
                begin, rows = number, []
            if fields:
                rows.append(fields)
            if len(rows) >= _FEWEST and (best is None or len(rows) * len(fields) > best[0]):
                best = len(rows) * len(fields), delimiter, begin, rows
    if best is None:
        raise ReadError(f"{name}: no rows of numbers in its first {min(len(lines), _MOST_LINES)} lines")
    _, delimiter, begin, rows = best
    above = [fields_of_line(line.lstrip("# "), delimiter) for line in lines[max(begin - 2, 0) : begin]]
    alike = [fields for fields in above if len(fields) == len(rows[0])]
    units = alike.pop() if len(alike) == 2 and is_units_row(alike[1]) else []
    titles = alike[-1] if alike else [f"column {number + 1}" for number in range(len(rows[0]))]
    joined = " ".join(field for row in rows[:50] for field in row)
    decimal = "," if delimiter != "," and "," in joined and "." not in joined else "."
    titled = begin - 1 - bool(units) if alike else begin
    return Table(titles, rows, delimiter, decimal, units, encoding=encoding, above=titled, titled=bool(alike))


def columns_of_table(table: Table, name: str) -> tuple[list[StatedColumn], str]:
    """Return what is known of each column, and what was taken from the readings, in a sentence."""
    names = {column: "" for sensor in ("accel", "gyro", "mag") for column in triad(sensor)}
    columns: list[StatedColumn] = []
    for place, text in enumerate(table.titles):
        title = read_title(text, table.units[place] if place < len(table.units) else "")
        sensor, axis = title.sensor, title.axis
        column = f"{sensor}_{'xyz'[axis]}" if axis is not None and f"{sensor}_x" in names else sensor
        if (column not in names and column not in ("time", "temperature")) or any(c.column == column for c in columns):
            column = ""
        unit = known_unit(title.unit) if title.unit else ""
        columns.append(StatedColumn(text.strip(), column, unit or title.unit))
    columns = _with_clock(columns, table)
    guess, open_units = _guess(table, name)
    if guess is None:
        return columns, ""
    for column, entry in guess.layout.columns.items():
        place = entry.origin if isinstance(entry.origin, int) else table.titles.index(entry.origin)
        columns = [StatedColumn(c.title, "" if c.column == column else c.column, c.unit) for c in columns]
        columns[place] = StatedColumn(columns[place].title, column, "" if kind_of(column) in open_units else entry.unit)
    return columns, "; ".join(guess.supposed)


def _guess(table: Table, name: str) -> tuple[LayoutGuess | None, dict[str, str]]:
    """Return the guess of a layout, and the sensors whose units it has from nowhere."""
    units: dict[str, str] = {}
    while len(units) < _MOST_SENSORS:
        try:
            return layout_of_table(table, name, units=units, timed=False), units
        except GuessError as error:
            needed = re.match(r"--unit (\w+)=(\S+)$", error.needs)
            if needed is None or needed[1] in units:
                return None, {}
            units[needed[1]] = needed[2]
    return None, {}


def _with_clock(columns: list[StatedColumn], table: Table) -> list[StatedColumn]:
    """Return the columns with the unit of the time by its steps, and the first that rises as the time if none is."""
    titled = any(column.column == "time" for column in columns)
    for place, column in enumerate(columns):
        values = table.numbers(place)
        steps = np.diff(values)
        if (
            column.column != "time" * titled
            or column.unit
            or len(steps) < _FEWEST
            or not (np.isfinite(steps).all() and steps.min() > 0)
        ):
            continue
        unit = likely_time_unit(median(steps))
        columns[place] = StatedColumn(column.title, "time", unit, "rises in every row")
        break
    return columns


def layout_of_columns(table: Table, chosen: Mapping[int, tuple[str, str]], sample_rate: float | None, name: str) -> str:
    """Return the text of the layout of columns that were stated, by their places: what each is, and its unit.

    Raises
    ------
    OptionError
        A column is stated twice, has no unit, or there is no sensor.
    """
    places: dict[str, int] = {}
    for place, (column, unit) in chosen.items():
        title = table.titles[place].strip() if 0 <= place < len(table.titles) else ""
        if not title or kind_of(column) is None:
            raise OptionError(f"{name}: column {place + 1} {quoted(column)}: expected one of {listed(KINDS, column)}")
        if column in places:
            raise OptionError(
                f"{column} is chosen for two columns: {quoted(table.titles[places[column]])} and {quoted(title)}"
            )
        if not unit:
            raise OptionError(f"{quoted(title)}: expected the unit of {column}")
        places[column] = place
    if not set(places) - {"time", "temperature"}:
        raise OptionError("expected a column of a sensor: say which is accel_x, gyro_x and so on")
    if "time" not in places and sample_rate is None:
        raise OptionError("expected the column of the time, or how many rows there are in a second")
    order = sorted(places, key=lambda column: (column != "time", places[column]))
    rows = [(column, places[column], chosen[places[column]][1], "") for column in order]
    left = [title for place, title in enumerate(table.titles) if place not in chosen and title.strip()]
    rate = None if "time" in places else sample_rate
    return layout_text(table, rows, left, rate, heading="The columns as stated on the page.")
