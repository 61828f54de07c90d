"""What a layout leaves to the file: separators, names with ``*``, and numbers that stand above the titles.

A layout without ``delimiter`` takes the one with which the file has its columns. ``from = "Shimmer_*_Accel_LN_X_CAL"``
is the one title that fits; ``scale = "gscale"`` and ``sample_rate = "rate|data_rate"`` the number behind that word, or
one of these, above the rows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from imulab.errors import ReadError, first_of, several
from imulab.readers.titles import fields_of, is_units_row, known_unit, titles_of
from imulab.recording import Layout, LayoutColumn

HEAD = 1 << 16
"""Bytes of a file that show what its layout leaves open."""
_SEPARATORS = (",", ";", "\t", " ")
_NUMBER = r"\s*[,:=\s]\s*([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"


def opened(layout: Layout, head: bytes, name: str) -> Layout:
    """Return a layout with what it leaves open taken from the first bytes of a text file.

    Raises
    ------
    ReadError
        Several titles fit a name with ``*``, or a number is not there.
    """
    if layout.labelled:
        return replace(layout, delimiter=",")
    if layout.delimiter and not layout.starred and not layout.named_numbers:
        return layout
    lines = [line.rstrip("\r") for line in head.decode(layout.encoding, "replace").lstrip("\ufeff").split("\n")]
    if not layout.delimiter:
        layout = _with_separators(layout, lines)
    if layout.starred:
        layout = replace(layout, columns=_named(layout, lines, name))
    return _with_numbers(layout, lines, name) if layout.named_numbers else layout


def fits(origin: str, title: str) -> bool:
    """Return whether a title is that of a layout, in which ``*`` stands for any text."""
    if "*" not in origin:
        return origin == title
    return re.fullmatch(".*".join(map(re.escape, origin.split("*"))), title) is not None


def holds(layout: Layout, line: str, delimiter: str) -> bool:
    """Return whether a line holds every title of a layout, once."""
    wanted = [column.origin for column in layout.columns.values() if isinstance(column.origin, str)]
    titles = titles_of(line, delimiter)
    plain = {title for title in wanted if "*" not in title}
    if not wanted or not plain.issubset(titles):
        return False
    return all(sum(fits(origin, title) for title in titles) == 1 for origin in wanted if "*" in origin)


def _with_separators(layout: Layout, lines: list[str]) -> Layout:
    """Return a layout with the delimiter, and the decimal comma, of the lines."""
    begin, delimiter = 0, ""
    for number, line in enumerate(lines):
        delimiter = next((sign for sign in _SEPARATORS if holds(layout, line, sign)), "")
        if delimiter:
            begin = number + 1
            break
    rows = [line for line in lines[max(begin, layout.skip_lines) :] if line.strip() and not line.startswith("#")]
    if not delimiter:
        delimiter = _of_rows(layout, rows)
    text = " ".join(rows)
    commas = delimiter not in (",", "") and re.search(r"\d,\d", text) and not re.search(r"\d\.\d", text)
    return replace(layout, delimiter=delimiter, decimal="," if commas else layout.decimal)


def _of_rows(layout: Layout, rows: list[str]) -> str:
    """Return the sign that parts most of the rows into the fields that a layout takes; blanks if none does."""
    last = max((c.origin for c in layout.columns.values() if isinstance(c.origin, int)), default=0)
    some = [row for row in rows[:50] if row.startswith(layout.prefix)]
    for sign in _SEPARATORS[:3]:
        if sign == layout.decimal or not some:
            continue
        if sum(row.count(sign) >= max(last, 1) for row in some) > len(some) / 2:
            return sign
    return " "


def _named(layout: Layout, lines: list[str], name: str) -> dict[str, LayoutColumn]:
    """Return the columns of a layout with the titles that fit their names."""
    line = next((line for line in lines if holds(layout, line, layout.delimiter)), None)
    if line is not None:
        titles = titles_of(line, layout.delimiter)
        return {key: _starless(column, titles) for key, column in layout.columns.items()}
    for key, column in layout.columns.items():
        if isinstance(column.origin, str) and "*" in column.origin:
            fitting = {
                title for line in lines for title in titles_of(line, layout.delimiter) if fits(column.origin, title)
            }
            if len(fitting) != 1:
                found = first_of(sorted(fitting), 4) or several(titles_of(lines[0], layout.delimiter), 120)
                raise ReadError(
                    f"{name}: {layout.name} takes {key} from one column named {column.origin!r}, found {found}"
                )
    return dict(layout.columns)


def _starless(column: LayoutColumn, titles: list[str]) -> LayoutColumn:
    origin = column.origin
    if not isinstance(origin, str) or "*" not in origin:
        return column
    return replace(column, origin=next(title for title in titles if fits(origin, title)))


def _with_numbers(layout: Layout, lines: list[str], name: str) -> Layout:
    """Return a layout with the scales and the sample rate that stand above its rows."""
    titles = [c.origin for c in layout.columns.values() if isinstance(c.origin, str)]
    stop = next((n for n, line in enumerate(lines) if titles and holds(layout, line, layout.delimiter)), len(lines))
    above = lines[:stop]

    def number(word: str, what: str) -> float:
        words = "|".join(map(re.escape, word.split("|")))
        pattern = re.compile(rf"(?<![\w.])(?:{words}){_NUMBER}")
        written = next((match for line in above if (match := pattern.search(line))), None)
        if written is None or float(written[1]) == 0:
            raise ReadError(
                f"{name}: {layout.name} takes {what} from the number behind {word!r} above the rows, found none"
            )
        return float(written[1])

    columns: Mapping[str, LayoutColumn] = {
        key: replace(column, scale=column.scale * number(column.scale_from, f"the scale of {key}"), scale_from="")
        if column.scale_from
        else column
        for key, column in layout.columns.items()
    }
    rate = number(layout.rate_from, "the sample rate") if layout.rate_from else layout.sample_rate
    return replace(layout, columns=columns, sample_rate=rate, rate_from="")


def unit_row(line: str, delimiter: str) -> list[str]:
    """Return the units in the row below the titles; none where it is no row of units."""
    fields = fields_of(line, delimiter)
    return [known_unit(field) for field in fields] if is_units_row(fields) else []
