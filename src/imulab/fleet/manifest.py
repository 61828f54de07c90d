"""The manifest of a fleet, one row per unit, and its files by path or URL, each with its hash."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from imulab.errors import (
    ImulabError,
    OptionError,
    ReadError,
    folder_in_place,
    install,
    listed,
    meant,
    readable,
    several,
)
from imulab.procedures.registry import PROCEDURES
from imulab.readers.formats import library

if TYPE_CHECKING:
    from imulab.procedures.procedure import Procedure
    from imulab.readers import Layout
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


# Files by path or URL: a cluster reads from its own storage, and every file that was used is recorded with its hash.


_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(::[A-Za-z][A-Za-z0-9+.-]*)*://")
_BLOCK = 1 << 22  # bytes copied at once
SCHEMES = ("file", "https", "s3", "gs", "az")
"""Allowed protocols: a manifest may come from somebody else, and fsspec knows dozens of others."""
_LARGEST = 1 << 33  # bytes of a file that is fetched: 8 GiB
# A password may hold any character, "/" and "@" among them: where there is a colon, to the last "@".
_LOGIN = re.compile(r"(?<=://)(?:[^/@\s:]*:[^\s]*|[^/\s]*)@")
_SECRET = re.compile(r"([?&;][\w%-]*(?:pass|pwd|token|secret|key|sig|auth|cred)[\w%-]*=)([^&;\s]+)", re.IGNORECASE)


def is_url(name: str) -> bool:
    """Return whether a name is a URL rather than a path."""
    return _URL.match(name) is not None


def masked(text: str) -> str:
    """Return a text with the credentials of URLs replaced by asterisks."""
    return _SECRET.sub(r"\1***", _LOGIN.sub("***@", text))


def without_secrets(text: str, url: str) -> str:
    """Return a text, such as what a database says, with each part of a URL that is a credential as asterisks."""
    login = _LOGIN.search(url)
    parts = re.split("[:@]", login[0].rstrip("@"))[1:] if login else []
    parts += [login[0].rstrip("@").partition(":")[2]] if login else []
    parts += [match[2] for match in _SECRET.finditer(url)]
    for part in sorted({*parts, *map(unquote, parts)}, key=len, reverse=True):
        text = text.replace(part, "***") if part else text
    return masked(text)


def parent_of(path: str) -> str:
    """Return the folder or URL that the paths of a manifest are relative to."""
    return path.rpartition("/")[0] if is_url(path) else str(Path(os.path.realpath(path)).parent)


@contextmanager
def local_file(address: str, name: str) -> Iterator[Path]:
    """Yield a file (or folder) of this machine: the file, or a copy of a URL's content for the time of the block.

    Raises
    ------
    ReadError
        There is no such file, it is no regular file or too large, the URL cannot be opened or is of a scheme that is
        not read, or fsspec is not there to open it.
    """
    name = masked(name)
    if not is_url(address):
        path = Path(address)
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ReadError(f"{name}: expected a file, found a device or a pipe")
        yield path
        return
    scheme = address.partition("://")[0].lower()
    if scheme not in SCHEMES:
        raise ReadError(
            f"{name}: addresses with {scheme!r} are not read; expected a path, or one of {' '.join(SCHEMES)}"
        )
    if _LOGIN.search(address):
        raise ReadError(
            f"{name}: a login in the address would end up in records and reports; expected it in the environment"
        )
    try:
        _ = urlsplit(address).port
    except ValueError as error:
        raise ReadError(f"{name}: no address: {' '.join(str(error).split())}") from None
    with tempfile.TemporaryDirectory(prefix="imulab-", ignore_cleanup_errors=True) as folder:
        yield _fetched(address, name, Path(folder))


def _fetched(address: str, name: str, folder: Path) -> Path:
    try:
        import fsspec
    except ImportError:
        raise ReadError(f"{name}: a URL needs fsspec: {install('fleet')}") from None
    target = folder / (re.sub(r"[^\w.-]", "_", address.rstrip("/").rpartition("/")[2]) or "file")
    try:
        system, path = fsspec.core.url_to_fs(address)
        if system.isdir(path):
            if system.du(path) > _LARGEST:
                raise _too_large(name)
            system.get(path.rstrip("/") + "/", str(target) + "/", recursive=True)
        elif system.info(path)["type"] != "file":
            raise ReadError(f"{name}: expected a file, found a device or a pipe")
        else:
            with system.open(path, "rb") as stream, target.open("wb") as copy:
                while data := stream.read(_BLOCK):
                    copy.write(data)
                    if copy.tell() > _LARGEST:
                        raise _too_large(name)
    except ReadError:
        raise
    except FileNotFoundError:
        raise ReadError(f"{name}: no such file") from None
    except ImportError as error:
        raise ReadError(f"{name}: cannot be opened: {masked(str(error))}") from None
    except Exception as error:  # fsspec passes on whatever its back ends raise
        reason = masked(" ".join(str(error).split())) or type(error).__name__
        raise ReadError(f"{name}: cannot be read: {reason}") from None
    return target


def _too_large(name: str) -> ReadError:
    return ReadError(
        f"{name}: larger than {_LARGEST >> 30} GiB, the most that is fetched; expected a path of this machine"
    )


def sha256_of(path: Path, name: str) -> str:
    """Return the SHA-256 of a file's bytes, or of those of a bag's files in its order.

    Raises
    ------
    ReadError
        It cannot be read.
    """
    total = hashlib.sha256()
    with readable(name):
        parts: Sequence[Path] = [path]
        if path.is_dir():
            from imulab.readers.rosbag import files_of

            parts = files_of(path, name)
        for part in parts:
            with part.open("rb") as stream:
                hashlib.file_digest(stream, lambda: total)
    return total.hexdigest()


class UnitFiles:
    """Access to one unit's files for `imulab.procedures`, with their hashes and what their heads state.

    Attributes
    ----------
    inputs
        Name to SHA-256 of every file that was used, in the order of use.
    serials
        Serials that heads of files state, without repetition.
    date
        Value of the first ``date`` at the head of a file.
    """

    def __init__(self, base: str) -> None:
        self._base = base
        self._stack = ExitStack()
        self._local: dict[str, Path] = {}
        self.inputs: dict[str, str] = {}
        self.serials: list[str] = []
        self.date: str | None = None

    def __enter__(self) -> UnitFiles:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stack.close()

    def path(self, name: str) -> Path:
        """Return a local path for a name that is relative to the manifest; a URL is fetched once."""
        if name not in self._local:
            if is_url(name):
                address = name
            elif is_url(self._base):
                address = f"{self._base}/{name}"
            else:
                address = str(Path(self._base) / name)
            self._local[name] = self._stack.enter_context(local_file(address, name))
        return self._local[name]

    def sha256(self, name: str) -> str:
        """Return the SHA-256 of a file by its name."""
        return sha256_of(self.path(name), name)

    def _layout(self, name: str | None) -> Layout | None:
        if name is None:
            return None
        from imulab.readers import load_layout
        from imulab.readers.layout import shipped_file

        shipped = shipped_file(name)
        path = shipped or self.path(name)
        self.inputs.setdefault(name, sha256_of(path, name))
        return load_layout(path, name)

    def blocks(self, name: str, layout: str | None, **part: Any) -> Iterator[Recording]:
        """Yield a recording in blocks."""
        from imulab.readers import read_blocks

        known = self._layout(layout)
        self.inputs[name] = self.sha256(name)
        for number, block in enumerate(read_blocks(self.path(name), known, name=name, **part)):
            if not number:
                self.remember_head(block)
            yield block

    def beside(self, name: str, file: str) -> str:
        """Return the name of a file that file `name` refers to relative to itself, and note `name` as used."""
        if name not in self.inputs:
            self.inputs[name] = self.sha256(name)
        if is_url(file) or (not is_url(name) and Path(file).is_absolute()):
            return file
        folder, slash, _ = name.rpartition("/")
        return f"{folder}{slash}{file}"

    def recording(self, name: str, layout: str | None, **part: Any) -> Recording:
        """Return a recording as a whole, with the manifest's name for messages and the record."""
        from imulab.estimation.sampling import mend_stamps
        from imulab.readers import read

        known = self._layout(layout)
        recording = read(self.path(name), known, name=name, **part)
        if recording.source is not None:
            self.inputs[name] = recording.source.sha256
        self.remember_head(recording)
        return mend_stamps(recording)

    def record(self, name: str) -> Calibration:
        """Return a calibration record."""
        from imulab.procedures.registry import loads

        with readable(name):
            data = self.path(name).read_bytes()
        self.inputs[name] = hashlib.sha256(data).hexdigest()
        return loads(data, name)

    def remember_head(self, recording: Recording) -> None:
        """Keep the serial number and the date that the head of a recording states."""
        serial = recording.metadata.get("serial")
        if serial and serial not in self.serials:
            self.serials.append(serial)
        if self.date is None:
            self.date = recording.metadata.get("date")

    def unchanged(self, inputs: Sequence[Any]) -> bool:
        """Return whether every file of a record's list exists with the hash that the record states."""
        try:
            return bool(inputs) and all(self._has(item["file"], item["sha256"]) for item in inputs)
        except (ImulabError, KeyError, TypeError):
            return False

    def _has(self, name: str, sha256: str) -> bool:
        """Return whether a file, or the layout of this name that imulab brings, has this hash."""
        from imulab.readers.layout import shipped_file

        shipped = shipped_file(name)
        return (shipped is not None and sha256_of(shipped, name) == sha256) or self.sha256(name) == sha256


# The manifest, which is checked as a whole before any work.


COLUMNS = ("serial", "procedure", "file")
_SERIAL = re.compile(r"[^\W_][\w .+=@()-]*")
_LONGEST_SERIAL = 120  # bytes, as a serial is part of the names of files
_RESERVED = {"con", "prn", "aux", "nul", *(f"{name}{digit}" for name in ("com", "lpt") for digit in range(10))}


@dataclass(frozen=True)
class FleetUnit:
    """One row: unit, procedure, files, and texts of options as in the manifest."""

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
    """Return a checked manifest, from CSV or Parquet.

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
        if local.is_dir():
            raise ReadError(folder_in_place(path, "a manifest", _manifests_in(local)))
        data = local.read_bytes()
    rows = _parquet(data, path) if data.startswith(b"PAR1") else _csv(data, path)
    titles = rows[0][1]
    table = [(place, dict(zip(titles, cells, strict=True))) for place, cells in rows[1:]]
    _check_columns(titles, {cells.get("procedure", "") for _, cells in table}, path)
    units: list[FleetUnit] = []
    places: dict[str, tuple[str, str]] = {}
    for place, cells in table:
        unit = _unit(place, cells)
        key = unit.serial.casefold()
        if key in places:
            first, other = places[key]
            same = "" if other == unit.serial else f" (as {other!r}; file names may not tell them apart)"
            raise OptionError(f"{place}, column serial: {unit.serial!r} is already in {first}{same}")
        places[key] = place.partition(": ")[2], unit.serial
        units.append(unit)
    if not units:
        raise OptionError(f"{path}: no rows below the titles; expected one row for each unit")
    return FleetManifest(path, parent_of(path), tuple(units))


def _manifests_in(folder: Path) -> list[str]:
    """Return the names of the CSV files in a folder whose titles are those of a manifest."""
    titled = []
    for file in folder.glob("*.csv"):
        with file.open("rb") as stream:
            if set(COLUMNS) <= {
                title.strip().decode("utf-8", "replace") for title in stream.readline(1000).split(b",")
            }:
                titled.append(file.name)
    return titled


def _csv(data: bytes, name: str) -> list[tuple[str, list[str]]]:
    """Return the title row and the data rows, each with its place, without blank lines and comments."""
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


def _check_columns(titles: Sequence[str], procedures: Set[str], name: str) -> None:
    """Refuse titles that are missing, unknown or there twice; the options of unused procedures are seldom imported."""
    for title in COLUMNS:
        if title not in titles:
            if separator := next((mark for mark in ";\t|" if len(titles) == 1 and mark in titles[0]), ""):
                raise OptionError(
                    f"{name}: columns are separated by {separator!r}; expected commas (';' only between a unit's files)"
                )
            raise OptionError(f"{name}: no column {title}; found {several(titles)}{meant(titles, title)}")
    usual = {*COLUMNS, *_options_of(PROCEDURES[key] for key in procedures & PROCEDURES.keys())}
    for index, title in enumerate(titles):
        if title.replace("-", "_") not in usual:
            known = [*COLUMNS, *dict.fromkeys(_options_of(PROCEDURES.values()))]
            if title.replace("-", "_") not in known:
                raise OptionError(f"{name}: unknown column {title!r}; known columns: {listed(known, title)}")
        if title in titles[:index]:
            raise OptionError(f"{name}: column {title} appears twice")


def _options_of(procedures: Iterable[Procedure]) -> Iterator[str]:
    return (name for procedure in procedures for name in procedure.task.names)


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
    """Refuse a serial number that cannot be the name of a file."""
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
