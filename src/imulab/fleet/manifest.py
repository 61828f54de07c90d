"""The manifest of a fleet: one row per unit, checked as a whole before any work."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from imulab.errors import OptionError, ReadError, listed, readable, several
from imulab.fleet.sources import local_file, parent_of
from imulab.procedures.registry import PROCEDURES
from imulab.readers.formats import library

COLUMNS = ("serial", "procedure", "file")
_SERIAL = re.compile(r"[^\W_][\w .+=@()-]*")
_LONGEST_SERIAL = 120
_RESERVED = {"con", "prn", "aux", "nul", *(f"{name}{digit}" for name in ("com", "lpt") for digit in range(10))}


@dataclass(frozen=True)
class FleetUnit:
    """One row: the unit, the procedure, its files and the texts of its options, as the manifest has them."""

    serial: str
    procedure: str
    files: tuple[str, ...]
    options: Mapping[str, str]


@dataclass(frozen=True)
class FleetManifest:
    """A checked manifest: its name, the folder or URL that its paths are relative to, and its units."""

    name: str
    base: str
    units: tuple[FleetUnit, ...]


def load_fleet(path: str) -> FleetManifest:
    """Read and check a manifest, CSV or Parquet.

    Columns ``serial,procedure,file`` (several files: ``;`` between them); any other column is an option of the
    procedure's fit, an empty cell an option that is not given. Paths are relative to the manifest.

    Parameters
    ----------
    path
        Path or URL.

    Raises
    ------
    ReadError
        The file cannot be read, or is no table.
    OptionError
        A row cannot be run: unknown column, duplicate or unsafe serial, unknown procedure, option or number of files;
        or there are no rows.
    """
    with local_file(path, path) as local, readable(path):
        data = local.read_bytes()
    rows = _parquet(data, path) if data.startswith(b"PAR1") else _csv(data, path)
    titles = rows[0][1]
    _check_columns(titles, path)
    units: list[FleetUnit] = []
    seen: dict[str, tuple[str, str]] = {}
    for place, cells in rows[1:]:
        unit = _unit(place, dict(zip(titles, cells, strict=True)))
        key = unit.serial.casefold()
        if key in seen:
            first, other = seen[key]
            same = "" if other == unit.serial else f" (as {other!r}; file names may not tell them apart)"
            raise OptionError(f"{place}, column serial: {unit.serial!r} is already in {first}{same}")
        seen[key] = place.partition(": ")[2], unit.serial
        units.append(unit)
    if not units:
        raise OptionError(f"{path}: no rows below the titles; expected one row for each unit")
    return FleetManifest(path, parent_of(path), tuple(units))


def _csv(data: bytes, name: str) -> list[tuple[str, list[str]]]:
    """Return title row and data rows, each with its place; blank lines and ``#`` comments at the head are passed."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ReadError(f"{name}: expected UTF-8 text or Parquet") from None
    if "\0" in text:
        raise ReadError(f"{name}: expected text or Parquet, found binary data")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[tuple[str, list[str]]] = []
    try:
        for cells in reader:
            cells = [cell.strip() for cell in cells]
            if not any(cells) or (not rows and cells[0].startswith("#")):
                continue
            place = f"{name}: row {len(rows)} (line {reader.line_num})"
            if rows and len(cells) != len(rows[0][1]):
                raise ReadError(f"{place}: expected {len(rows[0][1])} fields, found {len(cells)}")
            rows.append((place, cells))
    except csv.Error as error:
        raise ReadError(f"{name}: line {reader.line_num}: {error}") from None
    if not rows:
        raise ReadError(f"{name}: the file is empty; expected the titles {','.join(COLUMNS)}")
    return rows


def _parquet(data: bytes, name: str) -> list[tuple[str, list[str]]]:
    arrow = library("pyarrow", "Parquet", "tables", name)
    from pyarrow import parquet

    try:
        table = parquet.read_table(io.BytesIO(data))
    except (arrow.ArrowException, OSError, ValueError) as error:
        raise ReadError(f"{name}: not a whole Parquet file ({' '.join(str(error).split())[:160]})") from None
    rows = [(name, [title.strip() for title in table.column_names])]
    for number, cells in enumerate(zip(*(column.to_pylist() for column in table.columns), strict=True), start=1):
        rows.append((f"{name}: row {number}", ["" if cell is None else str(cell).strip() for cell in cells]))
    return rows


def _check_columns(titles: Sequence[str], name: str) -> None:
    for title in COLUMNS:
        if title not in titles:
            raise OptionError(f"{name}: no column {title}; found {several(titles)}")
    known = [*COLUMNS, *dict.fromkeys(option for entry in PROCEDURES.values() for option in entry.task.names)]
    for index, title in enumerate(titles):
        if title.replace("-", "_") not in known:
            raise OptionError(f"{name}: unknown column {title!r}; known columns: {listed(known, title)}")
        if title in titles[:index]:
            raise OptionError(f"{name}: column {title} appears twice")


def _unit(place: str, cells: Mapping[str, str]) -> FleetUnit:
    serial, procedure = cells["serial"], cells["procedure"]
    _check_serial(serial, place)
    if procedure not in PROCEDURES:
        known = listed(PROCEDURES, procedure)
        raise OptionError(f"{place}, column procedure: unknown procedure {procedure!r}; known procedures: {known}")
    task = PROCEDURES[procedure].task
    files = tuple(file.strip() for file in cells["file"].split(";"))
    fewest, most = task.count
    if not all(files) or len(files) < fewest or (most is not None and len(files) > most):
        raise OptionError(f"{place}, column file: {procedure} takes {task.files}, found {cells['file']!r}")
    if "-" in files:
        raise OptionError(f"{place}, column file: expected names of files, found '-'")
    options = {title.replace("-", "_"): text for title, text in cells.items() if title not in COLUMNS and text}
    for name in options:
        if name not in task.names:
            raise OptionError(
                f"{place}, column {name}: not an option of {procedure}; its options: {listed(task.names, name)}"
            )
    try:
        task.values(options, "column {}")
    except OptionError as error:
        raise OptionError(f"{place}: {error}") from None
    return FleetUnit(serial, procedure, files, dict(sorted(options.items())))


def _check_serial(serial: str, place: str) -> None:
    """Check that a serial can name a file in any folder."""
    unsafe = (
        _SERIAL.fullmatch(serial) is None
        or serial.endswith(".")
        or serial.partition(".")[0].lower() in _RESERVED
        or len(serial.encode("utf-8")) > _LONGEST_SERIAL
    )
    if unsafe:
        shown = repr(serial if len(serial) <= 60 else serial[:57] + "...")
        raise OptionError(
            f"{place}, column serial: {shown} cannot name the file of a record; expected a letter or digit, then "
            f"letters, digits, spaces or any of . _ + = @ ( ) -, at most {_LONGEST_SERIAL} bytes"
        )
