"""A layout for a foreign file, guessed from its titles: one guess for files, live streams and refusals.

Sensors and units come from the titles and from a units row below them. What the titles leave open may be told by the
readings (|f| near 9.8 or 1, the step of a clock); it is used, and a comment in the layout says so. A unit that neither
tells is refused, never supposed.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from datetime import datetime
from itertools import pairwise
from os import PathLike
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from imulab.columns import KINDS, triad
from imulab.errors import ReadError, file_name, first_of, quoted, readable
from imulab.estimation.likely_unit import unit_by_turns
from imulab.files import open_file
from imulab.options import measure, parsed, text
from imulab.quantities import parse_units
from imulab.readers.formats import TEXT, is_packed, recognised, unpacked
from imulab.readers.jsonfile import DEEP, LARGEST, parsed_document
from imulab.readers.labelled import LabelledLines, pairs
from imulab.readers.layout import check_rate
from imulab.readers.shipped import advice
from imulab.readers.text import is_native
from imulab.readers.titles import Title, is_number, is_units_row, read_title
from imulab.recording import Array, Layout, bits_of_wrap
from imulab.units import STANDARD_GRAVITY, parse_unit

HEAD = 1 << 20
"""Bytes of a file that show its columns."""
_MOST_LABELLED = 20_000  # lines or records that are looked at
_MOST_LINES = 300  # above the rows
_FEWEST = 3  # rows that show a column's size
DELIMITERS = {",": '","', ";": '";"', "\t": '"\\t"', " ": '"whitespace"'}
_LIKELY_RATES = 4.0, 4000.0  # Hz: a clock whose steps give a rate between these in one unit alone has that unit
_GRAVITIES = {"m/s^2": STANDARD_GRAVITY, "g": 1.0, "mg": 1000.0}
_NEAR = 0.25  # relative: a mean this near to g in some unit is a specific force
_SINCE_1970 = 1.2e9, 2.6e9  # s: from 2008 to 2052
_FIELDS = {"uT": (15.0, 150.0), "gauss": (0.15, 1.5), "nT": (15e3, 150e3)}
"""The Earth's field with a share of hard iron, in units whose ranges do not meet."""
_FASTEST = 35.0  # rad/s: no angular rate of a test is beyond 2000 deg/s
_ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d")
_NAMED = 50  # score of a table whose sensor the file's name speaks of
_TIME_OF_DAY = re.compile(r"\d?\d:\d\d:\d\d(?:\.\d+)?$")
_DAY_AND_MONTH = re.compile(r"(\d\d?)[./-](\d\d?)[./-]\d{4} +\d?\d:\d\d")
_ARROW = re.compile(r"[ \t]*(\d?\d:\d\d:\d\d(?:[.:]\d+)?) -> ?")
_EITHER = "either"
_DATES = {"day first": '"iso", day_first = true', "month first": '"iso", day_first = false'}
_RATE = "--sample-rate HZ"
_BY_HAND = "; a layout can be written by hand: imulab show --formats ends with an example"
_HEADING = """\
Guessed by imulab layout guess from titles. A comment at a column says what its title does not.
# Axes and their directions are as the titles say: swapped or reversed ones are not looked for in the readings."""
_NO_GRAVITY = {"linear", "free", "user", "without", "nog"}
_EXAMPLES = {"accel": "m/s^2", "gyro": "deg/s", "mag": "uT"}


class LayoutGuess(Struct, frozen=True):
    """A guessed layout.

    Attributes
    ----------
    toml
        The text of the layout file; comments say what was taken from where.
    supposed
        What the readings told where titles were silent, a sentence each.
    """

    toml: str
    supposed: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return self.toml

    @property
    def why(self) -> str:
        """The same in one line."""
        return "; ".join(self.supposed) or "all of it stands in the titles"

    @property
    def layout(self) -> Layout:
        """The layout, as `imulab.read` takes it."""
        from imulab.readers.layout import layout_of

        return layout_of(tomllib.loads(self.toml), "the guessed layout")

    def save(self, path: str | Path) -> None:
        """Write the layout file.

        Raises
        ------
        OptionError
            The file cannot be written there.
        """
        from imulab.files import write_text

        write_text(path, self.toml)


class GuessError(ReadError):
    """No layout can be guessed; `needs` is the option that would help, such as ``--unit gyro=deg/s``, or nothing."""

    def __init__(self, message: str, needs: str = "") -> None:
        super().__init__(message)
        self.needs = needs


def guess_layout(
    file: str | PathLike[str],
    *,
    units: Annotated[Mapping[str, str] | None, parsed(parse_units, "NAME=UNIT", flags=("--unit",))] = None,
    sample_rate: Annotated[float | None, measure("frequency", "Hz", "HZ")] = None,
    prefix: Annotated[str | None, text("NAME")] = None,
) -> LayoutGuess:
    r"""Return a layout for a text file of another program, guessed from its titles.

    Parameters
    ----------
    file
        Path of the file.
    units
        Units that no title says, by sensor or column, ``{"gyro": "deg/s"}``.
    sample_rate
        Rows in a second, Hz, where no column is a time.
    prefix
        First field of the lines that count, in a file of several kinds of lines.

    Returns
    -------
    LayoutGuess
        ``toml``, the text of the layout, with comments on what the titles left open; `read` takes its ``layout``.

    Raises
    ------
    ReadError
        The file cannot be read, or a title or unit cannot be told; the message names it.

    Examples
    --------
    >>> import imulab as il
    >>> from pathlib import Path
    >>> rows = "".join(f"{0.01 * k:.2f},0.01,0.02,9.81\n" for k in range(9))
    >>> _ = Path("phone.csv").write_text("Time (s),Acc X (m/s^2),Acc Y (m/s^2),Acc Z (m/s^2)\n" + rows)
    >>> il.read("phone.csv", il.guess_layout("phone.csv").layout).units["accel_x"]
    'm/s^2'
    """
    name = os.fsencode(file_name(file)).decode("utf-8", "backslashreplace")
    with readable(name):
        head = read_head(file, name)
    return guess_of_head(head, name, units=units, sample_rate=sample_rate, prefix=prefix or "")


def read_head(file: str | os.PathLike[str], name: str) -> bytes:
    """Return the first bytes of a file, or of what is packed in it; of JSON, as much as may be read."""
    with open_file(file) as stream:
        head = stream.read(HEAD)
    packed = unpacked(Path(file), name) if is_packed(head) else nullcontext(Path(file))
    with packed as content, open_file(content) as stream:
        head = stream.read(HEAD)
        return head + stream.read(LARGEST) if recognised(head[:1024]).module == "jsonfile" else head


def lines_of_head(head: bytes) -> tuple[list[str], str]:
    """Return the whole lines of a text's first bytes, and their encoding."""
    try:
        text = head[: head.rfind(b"\n") + 1 if len(head) == HEAD else None].decode("utf-8-sig")
    except UnicodeDecodeError:
        return head.decode("latin-1").splitlines(), "latin-1"
    return text.splitlines(), "utf-8"


def guess_of_head(
    head: bytes,
    name: str,
    *,
    units: Mapping[str, str] | None = None,
    sample_rate: float | None = None,
    prefix: str = "",
) -> LayoutGuess:
    """Return the layout of a text file from its first bytes; errors as for `guess_layout`."""
    kind = recognised(head[:1024])
    if kind.layout == "none":
        raise GuessError(f"{name}: a {kind.name} file says itself what its columns are; it needs no layout")
    if kind.module == "jsonfile":
        return layout_of_table(table_of_json(head, name), name, units=units, sample_rate=sample_rate)
    if kind is not TEXT or b"\0" in head[:4096]:
        content = "binary data" if kind is TEXT else kind.name
        raise GuessError(f"{name}: a layout is guessed from the titles of text, found {content}")
    lines, encoding = lines_of_head(head)
    titles = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    if _is_native(titles) and (sample_rate is None or "time" in titles):
        raise GuessError(f"{name}: titles with units, as imulab writes them; it needs no layout")
    try:
        bare, stamps = _without_arrows(lines)
        table = _labelled_table(lines) or guess_table(bare, name, prefix=prefix, encoding=encoding)
        try:
            return layout_of_table(table, name, units=units, sample_rate=sample_rate)
        except GuessError as error:
            if not stamps or not stamps[table.above] or table.labelled or table.prefix or error.needs != _RATE:
                raise
            return layout_of_table(_with_stamps(table, stamps), name, units=units)
    except GuessError as error:
        known = advice(head)
        raise GuessError(f"{error}; {known}" if known else str(error), error.needs) from None


def _without_arrows(lines: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return lines without the times that a serial monitor puts before them, and these times; none in other files."""
    arrows = [_ARROW.match(line) for line in lines]
    if sum(match is not None for match in arrows) <= len(lines) / 2:
        return list(lines), []
    bare = [line[match.end() :] if match else line for line, match in zip(lines, arrows, strict=True)]
    return bare, [match[1] if match else "" for match in arrows]


def _with_stamps(table: Table, stamps: Sequence[str]) -> Table:
    """Return a table whose first column are a serial monitor's times, which the reader takes as the first field."""
    rows = [[stamp, *row] for stamp, row in zip(stamps[len(stamps) - len(table.rows) :], table.rows, strict=True)]
    units = ["", *table.units] if table.units else []
    return replace(table, titles=["time", *table.titles], rows=rows, units=units, stamped=True)


def _is_native(titles: str) -> bool:
    """Return whether titles are imulab's own, and one is of a sensor."""
    names = {title.partition("[")[0].strip() for title in titles.split(",")}
    return is_native(titles) and not names.isdisjoint(column for sensor in _EXAMPLES for column in triad(sensor))


def advice_on_guess(head: bytes, name: str) -> str:
    """Return the command that writes a layout for a text file, from its first bytes; empty where none would."""
    needs = supposed = ""
    try:
        guess_of_head(head, name)
    except GuessError as error:
        if not error.needs:
            return ""
        needs = f" {error.needs}"
        if unit := re.match(r"--unit (\w+)=(\S+)$", error.needs):
            supposed = f"neither titles nor readings say the unit of {unit[1]}, {unit[2]} is a guess; "
    return f"{supposed}imulab layout guess {quote(name)}{needs} -o L.toml writes a layout for it (--layout L.toml)"


class Table(Struct):
    """Rows of fields below a line of titles; `stamped`: the first are a serial monitor's times of day."""

    titles: list[str]
    rows: list[list[str]]
    delimiter: str = ","
    decimal: str = "."
    units: list[str] = field(default_factory=list)
    prefix: str = ""
    encoding: str = "utf-8"
    above: int = 0
    labelled: bool = False
    stamped: bool = False
    others: tuple[str, ...] = ()
    titled: bool = True

    def numbers(self, column: int) -> Array:
        """Return the readings of a column, NaN where a field is no number."""
        return np.array([_number(row[column], self.decimal) if column < len(row) else np.nan for row in self.rows])


def guess_table(lines: Sequence[str], name: str, *, prefix: str = "", encoding: str = "utf-8") -> Table:
    """Return the table in the first lines of a text file; of several alike, that of the sensor in the file's name.

    Raises
    ------
    GuessError
        No line names the axes of a sensor.
    """
    best: tuple[int, Table] | None = None
    for delimiter in DELIMITERS:
        if delimiter == " " and best is not None:
            break
        for above, line in enumerate(lines[:_MOST_LINES]):
            titles = fields_of_line(line.lstrip("# ") if line.startswith("#") else line, delimiter)
            if len(titles) < 3 or sum(map(is_number, titles)) > len(titles) / 2:
                continue
            if prefix and titles[0] != prefix and f"${titles[1]}" != prefix:
                continue
            score = _score(_tagged(titles), _sensors_of_name(name))
            if score and (best is None or score > best[0]):
                table = _rows_below(titles, lines[above + 1 :], delimiter, above)
                if table is not None:
                    best = score, table
    if best is None:
        shown = next((line.strip() for line in lines if line.strip() and not line.startswith("#")), "")
        if not shown:
            contents = (
                "only comments; expected a line of titles and rows"
                if any(map(str.strip, lines))
                else "the file is empty"
            )
            raise GuessError(f"{name}: {contents}")
        raise GuessError(
            f"{name}: no line of titles names the axes of a sensor; the first is {quoted(shown)}{_BY_HAND}"
        )
    best[1].encoding = encoding
    return best[1]


def _sensors_of_name(name: str) -> set[str]:
    """Return the sensors that a file's name speaks of: ``Gyroscope.csv``, ``log-mag.txt``."""
    words = re.findall(r"[a-z]+", Path(name).stem.lower().replace("total", ""))
    return {sensor for sensor in _EXAMPLES for word in words if word.startswith(sensor[:3])}


def _labelled_table(lines: Sequence[str]) -> Table | None:
    """Return the table of numbers with a label each, ``Acceleration X: -2.76, Y: ..``; None for other text."""
    counts: dict[str, int] = {}
    units: dict[str, str] = {}
    labelled = [list(pairs(line)) for line in lines[:_MOST_LABELLED]]
    for label, _, unit in (pair for line in labelled for pair in line):
        counts[label] = counts.get(label, 0) + 1
        units[label] = units.get(label) or unit
    often = [label for label, count in counts.items() if count > _FEWEST and count > max(counts.values()) / 2]
    if _score(often, set()) < 10:  # no triad
        return None
    stems = {label: read_title(label).stem for label in often}
    for label in often:  # the unit of the last axis is that of all three
        units[label] = units[label] or next((units[o] for o in often if stems[o] == stems[label] and units[o]), "")
    rows = LabelledLines(often, "", "", skips=True).read("\n".join(lines[:_MOST_LABELLED]).encode()).decode().split()
    table = Table(often, [row.split(",") for row in rows], "", units=[units[label] for label in often], labelled=True)
    return table if rows else None


def table_of_json(data: bytes, name: str) -> Table:
    """Return the table of a JSON file: records, or arrays by key, in which triples may lie flat."""
    try:
        return _table_of_document(parsed_document(data, name), name)
    except RecursionError:
        raise GuessError(f"{name}: {DEEP}") from None


def _table_of_document(document: Any, name: str) -> Table:
    if isinstance(document, dict):
        arrays = dict(_arrays_of(document))
        plain = {key: len(value) for key, value in arrays.items() if not isinstance(value[0], dict | list)}
        triples = {key: size // 3 for key, size in plain.items() if size % 3 == 0 and _is_sensor(key)}
        sizes = [triples.get(key, len(value)) for key, value in arrays.items()]
        rows = max(sizes, key=lambda size: (sizes.count(size), -size), default=0)
        columns: dict[str, list[Any]] = {}
        for key, value in arrays.items():
            if len(value) == 3 * rows and rows and key in plain:
                columns |= {f"{key}[{k}::3]": value[k::3] for k in range(3)}
            elif not rows or len(value) == rows:
                flat = [_numbers_of(item, key) for item in value]
                columns |= {each: [item.get(each) for item in flat] for each in (flat[0] if flat else ())}
        records = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=False)]
    else:
        records = [_numbers_of(item, "") for item in document[:_MOST_LABELLED]] if isinstance(document, list) else []
    records = [record for record in records if record.keys() == records[0].keys()]
    if not records or not records[0]:
        raise GuessError(f"{name}: no records of numbers, and no arrays of them by key")
    return table_of_records(records)


def _arrays_of(document: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, list[Any]]]:
    """Yield the arrays in an object of JSON, and in those within it, by name; those of text are none of readings."""
    for key, value in document.items():
        if isinstance(value, dict):
            yield from _arrays_of(value, f"{before}{key}.")
        elif isinstance(value, list) and value and (isinstance(value[0], dict | list) or _is_json_number(value[0])):
            yield f"{before}{key}", value


def _is_sensor(key: str) -> bool:
    """Return whether a key names a sensor and no axis of it."""
    title = read_title(key)
    return title.axis is None and any(word.startswith(("acc", "gyr", "mag")) for word in title.stem)


def _numbers_of(value: Any, name: str) -> dict[str, float]:
    """Return the numbers in a JSON value by the names that a layout has for them; nan for null."""
    if isinstance(value, dict):
        parts = [_numbers_of(item, f"{name}.{key}" if name else key) for key, item in value.items()]
    elif isinstance(value, list):
        parts = [_numbers_of(item, f"{name}[{place}]") for place, item in enumerate(value[:9])]
    else:
        return {name: float("nan") if value is None else float(value)} if _is_json_number(value) else {}
    return {key: number for part in parts for key, number in part.items()}


def _is_json_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _tagged(titles: list[str]) -> list[str]:
    """Return titles in which bare axes behind a tag, ``$COL,MAG,time,x,y,z``, have its name."""
    tag = titles[1] if titles[0].startswith("$") else titles[0]
    if not any(tag.lower().startswith(sensor[:3]) for sensor in _EXAMPLES):
        return titles
    return [f"{tag} {title}" if title.lower() in ("x", "y", "z") else title for title in titles]


def _score(titles: Sequence[str], likely: set[str]) -> int:
    """Return how many whole triads titles name; bare x, y and z count least, a `likely` sensor more."""
    read = [read_title(title) for title in titles]
    named = {(t.sensor, t.stem, t.axis) for t in read if t.sensor in _EXAMPLES and t.axis is not None}
    whole = [key for key in {(s, stem) for s, stem, _ in named} if all((*key, axis) in named for axis in range(3))]
    bare = {t.axis for t in read if not t.sensor and not t.stem and t.axis is not None}
    timed = bool(whole) and any(title.sensor == "time" for title in read)
    return 10 * len(whole) + (len(bare) == 3) + timed + _NAMED * len(likely.intersection(sensor for sensor, _ in whole))


def _rows_below(titles: list[str], below: Sequence[str], delimiter: str, above: int) -> Table | None:
    """Return the table under titles: its units row, its rows, and the prefix that they have."""
    tag = titles[0] if not is_number(titles[0]) else ""
    tags = {tag: titles[1:], f"${titles[1]}": titles[2:]} if titles[0].startswith("$") else {tag: titles[1:]}
    units: list[str] = []
    rows: dict[str, list[list[str]]] = {}
    for line in below:
        fields = fields_of_line(line, delimiter)
        if not any(fields) or line.startswith("#"):
            continue
        if not rows and not units and (fields[0] in ("$UNIT", "UNIT") or is_units_row(fields)):
            of_these = fields[1:2] == titles[1:2]
            units = fields if not fields[0].endswith("UNIT") else fields[2:] if of_these else []
            continue
        key = fields[0] if fields[0] in tags and sum(map(_is_value, fields[1:])) >= 3 else ""
        if key or len(titles) <= len(fields) <= len(titles) + 1:
            rows.setdefault(key, []).append(fields[1:] if key else fields)
    prefix = next((key for key in tags if key and key in rows), "")
    mine = [row for row in rows.get(prefix, []) if sum(map(_is_value, row)) >= min(3, len(row))]
    if not mine:
        return None
    titles = _tagged(titles)[-len(tags[prefix]) :] if prefix else titles
    joined = " ".join(field for row in mine[:50] for field in row)
    decimal = "," if delimiter != "," and re.search(r"\d,\d", joined) and not re.search(r"\d\.\d", joined) else "."
    starts = [fields_of_line(line, delimiter)[0] for line in below if not line.startswith(("#", "$UNIT"))]
    others = tuple(dict.fromkeys(s for s in starts if prefix and s and s != prefix and not is_number(s)))
    return Table(titles, mine, delimiter, decimal, units, prefix, above=above, others=others)


def layout_of_table(
    table: Table,
    name: str,
    *,
    units: Mapping[str, str] | None = None,
    sample_rate: float | None = None,
    seconds: float | None = None,
    timed: bool = True,
) -> LayoutGuess:
    """Return the layout of a table.

    Parameters
    ----------
    units
        Units of sensors or columns that are known: ``{"gyro": "deg/s"}``.
    sample_rate
        Hz, where no column holds the time.
    seconds
        Time in which the rows came, where that is known.
    timed
        Whether a time is needed.

    Raises
    ------
    GuessError
        A title or a unit cannot be told; the message names it.
    """
    known = dict(units or {})
    titles = [read_title(title, table.units[i] if i < len(table.units) else "") for i, title in enumerate(table.titles)]
    sensors, left = _sensors(titles, table, name, known)
    try:
        clock = _clock(titles, table, known, sample_rate, seconds, name)
    except GuessError:
        if timed:
            raise
        clock = None
    # Column, place in the file, unit, and why, where no title says it.
    chosen: list[tuple[str, int, str, str]] = []
    step, rate = (None, sample_rate) if clock is None else (_step(table.numbers(clock[0]), clock[1]), clock[3])
    if clock is not None:
        chosen.append(("time", *clock[:3]))
    if sample_rate is not None:
        step = 1 / check_rate(sample_rate, f"{name}: sample_rate")
    titled = {sensor: titles[places[0]].unit for sensor, places in sensors.items()}
    for sensor, places in sensors.items():
        unit, reason = _unit(sensor, places, titles, table, titled, known)
        if not unit and sensor == "gyro" and step is not None and "accel" in sensors:
            unit, reason = _rate_unit(table, sensors["accel"], places, step)
        if not unit:
            raise _unknown_unit(sensor, places, titles, name)
        titled[sensor] = unit
        if titles[places[0]].increment and "@" not in unit:
            unit, reason = _increments(unit, rate, titles[places[0]].text, name)
        signed = " ".join(titles[place].text for place in places if titles[place].text.lstrip().startswith("-"))
        if signed:
            reason = "; ".join(filter(None, [reason, f"the minus of {signed} is not applied; scale = -1 applies it"]))
        for column, place in zip(triad(sensor), places, strict=True):
            chosen.append((column, place, known.get(column, unit), reason))
    warm = _temperature(titles, table, known)
    if warm is not None:
        chosen.append(("temperature", *warm))
    about = {column.partition("_")[0]: reason for column, _, _, reason in chosen if reason}
    return LayoutGuess(
        layout_text(table, chosen, left, sample_rate), tuple(f"{sensor}: {reason}" for sensor, reason in about.items())
    )


def layout_text(
    table: Table,
    chosen: Sequence[tuple[str, int, str, str]],
    left: Sequence[str],
    sample_rate: float | None,
    heading: str = _HEADING,
) -> str:
    """Return the text of a layout file; columns are named by title where that names one alone."""
    numbered = (
        bool(table.prefix)
        or table.stamped
        or not table.titled
        or any(table.titles.count(table.titles[place]) > 1 for _, place, _, _ in chosen)
    )
    lines = [f"# {heading}"]
    lines += [f"# Not taken: {first_of(left, 8)}"] if left else []
    lines += [f"# Lines of other kinds: {' '.join(table.others[:8])} (--prefix NAME)"] if table.others else []
    lines += [f"delimiter = {DELIMITERS[table.delimiter]}"] if table.delimiter else []
    lines += ["labelled = true"] if table.labelled else []
    lines += ['decimal = ","'] if table.decimal == "," else []
    lines += [f"encoding = {_toml(table.encoding)}"] if table.encoding != "utf-8" else []
    lines += [f"prefix = {_toml(table.prefix)}"] if table.prefix else []
    if numbered and not table.prefix:
        lines += ["header = true"] * table.titled + [f"skip_lines = {table.above}"] * bool(table.above)
    if sample_rate is not None:
        lines.append(f'sample_rate = {{ value = {sample_rate:g}, unit = "Hz" }}')
    lines.append("[columns]")
    for column, place, unit, reason in chosen:
        title = table.titles[place].strip()
        bits = _bits(table.numbers(place)) if column == "time" else 0
        comments = [*([_toml(title)] if numbered else []), *([reason] if reason else [])]
        comment = f"  # {'; '.join(comments)}" if comments else ""
        origin, written = _toml(place if numbered else title), _DATES.get(unit) or _toml(unit)
        counter = f", bits = {bits}" if bits else ""
        lines.append(f"{column} = {{ from = {origin}, unit = {written}{counter} }}{comment}")
    return "\n".join([*lines, ""])


def _bits(numbers: Array) -> int:
    """Return how many bits a counter has that begins again in the rows; 0 where none does."""
    falls = np.flatnonzero(np.diff(numbers) < 0)
    return bits_of_wrap(float(numbers[falls[0]]), float(numbers[falls[0] + 1])) if falls.size else 0


def _toml(value: str | int) -> str:
    return json.dumps(value, ensure_ascii=False)


# Which columns are which sensor.


def _sensors(
    titles: Sequence[Title], table: Table, name: str, known: Mapping[str, str]
) -> tuple[dict[str, list[int]], list[str]]:
    """Return the columns of each sensor, and the titles that are not taken."""
    groups: dict[tuple[str, tuple[str, ...]], dict[int, int]] = {}
    for place, title in enumerate(titles):
        sensor = title.sensor or (_bare(title, table, name, known) if not title.stem else "")
        if title.axis is not None and sensor in _EXAMPLES and np.isfinite(table.numbers(place)).any():
            groups.setdefault((sensor, title.stem), {}).setdefault(title.axis, place)
    whole = {key: [axes[k] for k in range(3)] for key, axes in groups.items() if len(axes) == 3}
    sensors: dict[str, list[int]] = {}
    for sensor in _EXAMPLES:
        triads = [key for key in whole if key[0] == sensor]
        # Calibrated readings go before raw ones; acceleration that may be without gravity goes last.
        triads.sort(key=lambda key: ("linear" in key[1], "raw" in key[1] or titles[whole[key][0]].unit == "count"))
        if triads and not _is_linear(triads[0], table, whole):
            sensors[sensor] = whole[triads[0]]
    used = {place for places in sensors.values() for place in places}
    if not sensors:
        unknown = next((t.text for t in titles if t.sensor not in ("time", "counter")), table.titles[0])
        bare = all(any(not t.stem and t.axis == axis for t in titles) for axis in range(3))
        hint = "; --unit accel=m/s^2 says what x, y and z are" if bare else _BY_HAND
        linear = next((t.text for t in titles if t.axis is not None and _NO_GRAVITY.intersection(t.stem)), "")
        if linear:
            raise GuessError(
                f"{name}: {quoted(linear)} has no gravity in it, by which accelerometers are calibrated; expected the "
                "sensor's acceleration with gravity, which the program that wrote the file exports too"
            )
        raise GuessError(
            f"{name}: no titles of three axes that are known; not known: {quoted(unknown)}{hint}",
            "--unit accel=m/s^2" if bare else "",
        )
    left = [t.text.strip() for i, t in enumerate(titles) if i not in used and t.sensor in _EXAMPLES and t.text.strip()]
    return sensors, left


def _bare(title: Title, table: Table, name: str, known: Mapping[str, str]) -> str:
    """Return the sensor of a bare x, y or z: by its unit, by the units that were named, or by the file's name."""
    if title.unit == "1":
        return "mag"
    named = [sensor for sensor in _EXAMPLES if sensor in known]
    if len(named) == 1:
        return named[0]
    likely = _sensors_of_name(name)
    return likely.pop() if len(likely) == 1 else ""


def _is_linear(
    key: tuple[str, tuple[str, ...]], table: Table, whole: Mapping[tuple[str, tuple[str, ...]], list[int]]
) -> bool:
    """Return whether an acceleration that its title calls linear has no gravity in it."""
    if "linear" not in key[1]:
        return False
    return not any(abs(_length(table, whole[key]) / g - 1) < _NEAR for g in _GRAVITIES.values())


# Units, from titles or else from the readings.


def _length(table: Table, places: Sequence[int]) -> float:
    """Return the median length of three columns."""
    length = np.linalg.norm([table.numbers(place) for place in places], axis=0)
    length = length[np.isfinite(length)]
    return float(np.median(length)) if len(length) >= _FEWEST else np.nan


def _is_whole(table: Table, places: Sequence[int]) -> bool:
    """Return whether all readings are whole numbers, and not just zeros and ones."""
    values = np.concatenate([table.numbers(place) for place in places])
    values = values[np.isfinite(values)]
    return len(values) >= 3 * _FEWEST and bool((values == np.rint(values)).all()) and float(np.abs(values).max()) > 30


def _unit(
    sensor: str,
    places: Sequence[int],
    titles: Sequence[Title],
    table: Table,
    titled: Mapping[str, str],
    known: Mapping[str, str],
) -> tuple[str, str]:
    """Return the unit of a sensor, and why where no title says it; nothing where it cannot be told."""
    if sensor in known:
        return known[sensor], ""
    columns = triad(sensor)
    if all(column in known for column in columns):
        return known[columns[0]], ""
    stated = {titles[place].unit for place in places}
    first = titles[places[0]]
    if len(stated) == 1 and first.unit and _fits(sensor, first):
        return first.unit, ""
    if len(stated) == 1 and not first.unit:
        return _supposed(sensor, places, titles, table, titled)
    return "", ""


def _unknown_unit(sensor: str, places: Sequence[int], titles: Sequence[Title], name: str) -> GuessError:
    stated = {titles[place].unit for place in places}
    units = "" if stated == {""} else f", found {' '.join(sorted(unit or 'none' for unit in stated))}"
    example = f"--unit {sensor}={_EXAMPLES[sensor]}"
    return GuessError(
        f"{name}: column {quoted(titles[places[0]].text.strip())}: neither the title nor the readings say its "
        f"unit{units}; {example} states it",
        example,
    )


def _fits(sensor: str, title: Title) -> bool:
    """Return whether a stated unit is one of the sensor's quantity, or of its increments."""
    quantity = parse_unit(title.unit).quantity
    if quantity == "output" or (sensor == "mag" and quantity in ("magnetic field", "number")):
        return True
    return quantity == (
        {"accel": "velocity", "gyro": "angle"}.get(sensor) if title.increment else KINDS[sensor].quantity
    )


def _supposed(
    sensor: str, places: Sequence[int], titles: Sequence[Title], table: Table, titled: Mapping[str, str]
) -> tuple[str, str]:
    """Return the unit that readings show, and why; nothing where they do not."""
    words, length = titles[places[0]].stem, _length(table, places)
    if titles[places[0]].increment:
        return "", ""
    if _is_whole(table, places) or "count" in {unit for other, unit in titled.items() if other != sensor}:
        return "count", "no unit in the titles; whole numbers are taken as counts"
    if sensor == "accel":
        if "gf" in words:
            return "g", "g by the name g-force"
        for unit, gravity in _GRAVITIES.items():
            if abs(length / gravity - 1) < _NEAR:
                return unit, f"no unit in the titles; |f| is {length:.3g}, so {unit}"
        if words[:1] in (("a",), ("alpha",)) and _symbol_rate(titles):
            return "m/s^2", "no unit in the titles; supposed as SI, as symbols a and w are"
    if sensor == "gyro" and words[:1] in (("w",), ("omega",), ("angular",)):
        largest = float(np.nanmax(np.abs([table.numbers(place) for place in places])))
        by_name = any("gf" in t.stem for t in titles)
        if largest < _FASTEST and (titled.get("accel") == "m/s^2" or by_name):
            return "rad/s", "no unit in the titles; supposed as SI, as the symbol w is"
    if sensor == "mag":
        for unit, (low, high) in _FIELDS.items():
            if low < length < high:
                return unit, f"no unit in the titles; a length of {length:.3g} is the Earth's field in {unit}"
    return "", ""


def _step(times: Array, unit: str) -> float | None:
    """Return the median step of a clock, s."""
    steps = np.diff(times)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else np.nan
    return usual * parse_unit(unit).factor if np.isfinite(usual) else None


def _rate_unit(table: Table, accel: Sequence[int], gyro: Sequence[int], step: float) -> tuple[str, str]:
    """Return the unit of rates in which they explain how gravity turns in the body, and why."""
    force, rate = (np.column_stack([table.numbers(place) for place in places]) for places in (accel, gyro))
    unit = unit_by_turns(force, rate, step) if np.isfinite(force).all() and np.isfinite(rate).all() else ""
    return unit, unit and f"no unit in the titles; turns of gravity in the accelerometers agree with {unit}"


def _symbol_rate(titles: Iterable[Title]) -> bool:
    return any(title.sensor == "gyro" and title.stem[:1] in (("w",), ("omega",)) and not title.unit for title in titles)


def _increments(unit: str, rate: float | None, title: str, name: str) -> tuple[str, str]:
    """Return the unit of increments with their rate."""
    if rate is None:
        raise GuessError(
            f"{name}: column {quoted(title.strip())}: increments per sample, and no clock shows how many samples there "
            "are in a second; --sample-rate HZ states it",
            "--sample-rate HZ",
        )
    return f"{unit}@{rate:g}Hz", f"increments per sample, by the clock {rate:g} of them a second"


def _temperature(titles: Sequence[Title], table: Table, known: Mapping[str, str]) -> tuple[int, str, str] | None:
    """Return the column of the temperature, its unit, and why; None where there is none that is surely one."""
    places = [i for i, t in enumerate(titles) if t.sensor == "temperature" and np.isfinite(table.numbers(i)).any()]
    if len(places) != 1:
        return None
    (place,) = places
    title, values = titles[place], table.numbers(place)
    unit = known.get("temperature", title.unit)
    if unit in ("degC", "K"):
        return place, unit, ""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if unit in ("", "deg") and low > -60 and high < 150 and not _is_whole(table, [place] * 3):
        return place, "degC", f"supposed: {low:g} to {high:g}"
    return None


# The clock.


def _clock(
    titles: Sequence[Title],
    table: Table,
    known: Mapping[str, str],
    sample_rate: float | None,
    seconds: float | None,
    name: str,
) -> tuple[int, str, str, float | None] | None:
    """Return the column of the time, its unit, why, and the rate in Hz; None where a sample rate is stated."""
    if sample_rate is not None:
        return None
    ranked: list[tuple[tuple[bool, bool, int], int, str, str, float | None]] = []
    unknown = ""
    for place, title in enumerate(titles):
        if title.sensor != "time":
            continue
        values = table.numbers(place)
        date = _date_unit([row[place] for row in table.rows if place < len(row)]) if table.delimiter != " " else ""
        if date == _EITHER:
            raise GuessError(
                f"{name}: column {quoted(title.text.strip())}: {quoted(table.rows[0][place])} may be day or month "
                "first; expected a layout that says so: day_first = true or false (docs/recordings.md)"
            )
        if date:
            ranked.append(((True, False, place), place, date, "", None))
            continue
        steps = np.diff(values)
        back = int((steps < 0).sum())  # a counter may begin again
        if not np.isfinite(values).all() or (len(steps) and (back > 1 + len(steps) / 1000 or steps.max() <= 0)):
            continue
        step = float(np.median(steps[steps > 0])) if len(steps) else np.nan
        unit, reason = (known["time"], "") if "time" in known else _time_unit(title, values, step, seconds)
        if not unit:
            unknown = unknown or title.text.strip()
            continue
        factor = parse_unit(unit).factor
        rate = float(f"{1 / (factor * step):.4g}") if np.isfinite(step) else None
        elapsed = bool({"elapsed", "start"}.intersection(title.stem))
        ranked.append(((False, not elapsed, place), place, unit, reason, rate))
    if ranked:
        return min(ranked)[1:]
    if unknown:
        raise GuessError(
            f"{name}: column {quoted(unknown)}: neither the title nor its steps say the unit of time; --unit time=ms "
            "states it",
            "--unit time=ms",
        )
    others = [(t.text.strip(), place) for place, t in enumerate(titles) if t.sensor == "time"]
    found = ""
    if others:
        text, place = others[0]
        value = next((row[place] for row in table.rows if place < len(row)), "")
        why = "does not rise" if _is_value(value) else f"holds {quoted(value)}, no number and no date that is read"
        found = f", found {quoted(text)}, which {why}"
    raise GuessError(
        f"{name}: no title of a time that rises{found}; --sample-rate HZ states how many rows there are in a second",
        _RATE,
    )


def _date_unit(texts: Sequence[str]) -> str:
    """Return the unit of dates that rise, or of times of day; `_EITHER` where day and month cannot be told apart."""
    if all(_ISO.match(text) for text in texts):
        try:
            dates = [datetime.fromisoformat(f"{text[:10]}T{text[11:]}") for text in texts]
            return "iso" if all(before <= after for before, after in pairwise(dates)) else ""
        except (ValueError, TypeError):  # no dates, or only some with a zone
            return ""
    if all(_TIME_OF_DAY.match(text) for text in texts):
        return "iso"
    days = [match for text in texts if (match := _DAY_AND_MONTH.match(text))]
    if len(days) < len(texts):
        return ""
    first, second = (max(int(match[k]) for match in days) for k in (1, 2))
    if first <= 12 and second <= 12 and all("." in text[:3] for text in texts):
        return "day first"  # as in all countries that write dates with points
    return _EITHER if first <= 12 and second <= 12 else "day first" if first > 12 else "month first"


def likely_time_unit(step: float) -> str:
    """Return the one unit of time in which steps give a likely rate; nothing where none does, or several do."""
    rates = {unit: 1 / (parse_unit(unit).factor * step) for unit in ("s", "ms", "us", "ns")} if step > 0 else {}
    likely = [unit for unit, rate in rates.items() if _LIKELY_RATES[0] <= rate < _LIKELY_RATES[1] and step != 1.0]
    return likely[0] if len(likely) == 1 else ""


def _time_unit(title: Title, values: Array, step: float, seconds: float | None) -> tuple[str, str]:
    """Return the unit of a clock, and why where its title does not say it."""
    if title.unit in ("s", "ms", "us", "ns"):
        return title.unit, ""
    if "tow" in title.stem or "seconds" in title.stem:
        return "s", ""
    rates = {unit: 1 / (parse_unit(unit).factor * step) for unit in ("s", "ms", "us", "ns")} if step > 0 else {}
    likely = [unit for unit, rate in rates.items() if _LIKELY_RATES[0] <= rate < _LIKELY_RATES[1] and step != 1.0]
    if "fine" in title.stem:  # microseconds from a Movella DOT, tenths of a millisecond from MT Manager
        return ("us", f"by its steps us, at {rates['us']:.4g} Hz") if likely == ["us"] else ("", "")
    for word, unit in (("millis", "ms"), ("micros", "us"), ("nanos", "ns")):
        if word in title.stem:
            return unit, ""
    for unit, per_second in (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if _SINCE_1970[0] < values[0] / per_second < _SINCE_1970[1] and 0.5 < rates.get(unit, 1.0) < 1e5:
            return unit, f"counts {unit} since 1970"
    if seconds:
        ticks = float(values[-1] - values[0]) / max(seconds, 1e-3)
        unit = "s" if ticks < 30 else "ms" if ticks < 3e4 else "us"
        return unit, f"{unit} by its steps"
    if likely:
        return likely[0], f"no unit in the title; by its steps {likely[0]}, at {rates[likely[0]]:.4g} Hz"
    return "", ""


# Fields of lines.


def table_of_records(records: Sequence[Mapping[str, float | None]]) -> Table:
    """Return the table of records with the same keys, such as lines of JSON."""
    return Table(
        list(records[0]),
        [["nan" if v is None else repr(v) for v in record.values()] for record in records],
        delimiter="",
    )


def fields_of_line(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line without blanks and quotes around them."""
    fields = line.split() if delimiter == " " else line.split(delimiter)
    return [field.strip().strip('"').strip() for field in fields]


def _number(text: str, decimal: str) -> float:
    try:
        return float(text.replace(",", ".") if decimal == "," else text)
    except ValueError:
        return np.nan


def _is_value(text: str) -> bool:
    return is_number(text) or text == ""
