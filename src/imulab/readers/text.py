"""Delimited text: native CSV, and foreign text through a layout.

Native CSV has comment lines ``# key: value`` at the head, one line of titles ``name [unit]``, and rows of numbers.
The numbers are read by the C module `_text` in blocks of whole lines.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import BinaryIO

import numpy as np

from imulab.errors import ReadError
from imulab.readers import _text
from imulab.readers.layout import Layout, Readings
from imulab.recording import CORRECTED_BY, Recording, parse_column_title
from imulab.tens import powers_of_five
from imulab.verdict import Note

_BLOCK_BYTES = 1 << 21
_WORTH_SHARING = 1 << 19
_MOST_THREADS = 8

_text.prepare(powers_of_five())
_LONGEST_LINE = 1 << 20


class _Crew:
    """Threads to parse with, as many as there are processors; started when there is work for them.

    OMP_NUM_THREADS limits them as it does the linear algebra, so that workers beside each other do not compete.
    """

    def __init__(self) -> None:
        processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
        allowed = os.environ.get("OMP_NUM_THREADS", "")
        self.size = min(_MOST_THREADS, processors, int(allowed) if allowed.isdecimal() and int(allowed) else processors)
        self._pool: ThreadPoolExecutor | None = None

    def begin(self, job: Callable[[], tuple[int, int, int]]) -> Callable[[], tuple[int, int, int]]:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.size)
        return self._pool.submit(job).result

    def __enter__(self) -> _Crew:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


_UNENDED = Note("the last line has no line end: if the file was cut there, its last number is short")


class _Hash:
    """SHA-256 of what is read, taken in a thread of its own where there is much of it."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._pool: ThreadPoolExecutor | None = None

    def update(self, data: bytes) -> None:
        if self._pool is None and len(data) < _WORTH_SHARING:
            self._hash.update(data)
            return
        self._pool = self._pool or ThreadPoolExecutor(1)
        self._pool.submit(self._hash.update, data)

    def stop(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def hexdigest(self) -> str:
        return self._hash.hexdigest()


class TextFile:
    """One pass over a text file; the head is read when it is opened, rows come from `blocks`."""

    def __init__(
        self, stream: BinaryIO, name: str, layout: Layout | None, *, hashed: bool = True, whole: bool = False
    ) -> None:
        self._live = _is_pipe(stream)
        self._read = getattr(stream, "read1", stream.read) if self._live else stream.read
        self._name = name
        self._layout = layout
        self._readings = Readings(layout) if layout else None
        self._hash = _Hash() if hashed else None
        self._rest = b""
        self._ended = self._unended = False
        self._taken = 0
        self._size = os.fstat(stream.fileno()).st_size if whole and not self._live and _is_file(stream) else 0
        self._room: np.ndarray | None = None
        self._used = 0
        self._corrected_by: list[str] = []
        self._metadata: dict[str, str] = dict(layout.metadata or {}) if layout else {}
        self._lines_before = 0
        self._read_more()
        while len(self._rest) < len(BOM_UTF8) and not self._ended:
            self._read_more()
        self._rest = self._rest.removeprefix(BOM_UTF8)
        while not self._rest.strip() and not self._ended:
            self._read_more()
        if not self._rest.strip():
            raise ReadError(f"{name}: the file is empty")
        if b"\0" in self._rest[:4096]:
            wide = " (UTF-16? expected UTF-8)" if self._rest.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else ""
            raise ReadError(f"{name}: expected text, found binary data{wide}")
        self._delimiter = layout.delimiter if layout else ","
        self._blanks = b" \r\n" if self._delimiter == "\t" else b" \t\r\n"
        self._titles, self._units, self._slots = self._layout_head(layout) if layout else self._native_head()

    def sha256(self) -> str:
        """Return the SHA-256 of the bytes read so far, hexadecimal."""
        if self._hash is None:
            return ""
        self._hash.stop()
        return self._hash.hexdigest()

    def drain(self) -> None:
        """Read on to the end, so that the hash is that of the whole file."""
        while not self._ended:
            self._read_more()
            self._rest = b""

    def blocks(self) -> Iterator[Recording]:
        """Yield the rows as recordings; there is at least one row, or the file is refused."""
        row = 1
        waiting: deque[tuple[bytes, np.ndarray, Callable[[], tuple[int, int, int]]]] = deque()
        with _Crew() as crew:
            while True:
                block = self._next_lines()
                if block is not None:
                    waiting.append(self._begin(block, crew))
                # A file is read ahead while threads parse what has come; a pipe's lines go on at once.
                while waiting and (block is None or self._live or len(waiting) > crew.size):
                    recording = self._finish(*waiting.popleft(), row)
                    if self._unended and not waiting:
                        recording = replace(recording, notes=(*recording.notes, _UNENDED))
                    row += len(recording)
                    yield recording
                if block is None:
                    break
        if row == 1:
            raise ReadError(f"{self._name}: no rows of data below the header")

    # --- bytes -------------------------------------------------------------------------------------------------

    def _read_more(self) -> None:
        self._rest += self._next_bytes()

    def _next_bytes(self) -> bytes:
        try:
            data = self._read(_BLOCK_BYTES)
        except OSError as error:
            raise ReadError(f"{self._name}: cannot be read: {error.strerror}") from None
        self._ended = not data
        self._taken += len(data)
        if self._hash:
            self._hash.update(data)
        return data

    def _next_lines(self) -> bytes | None:
        """Return whole lines of about a block's size, without blank lines at the end of the file."""
        while not self._ended:
            end = self._rest.rfind(b"\n") + 1
            if end:
                lines, self._rest = self._rest[:end], self._rest[end:]
                # Blank lines may be the end of the file: they wait for what follows.
                kept = lines.rstrip(self._blanks)
                if kept:
                    self._rest = lines[len(kept) :].partition(b"\n")[2] + self._rest
                    return kept
                self._rest = lines + self._rest
                self._read_more()
                continue
            data = self._next_bytes()
            end = data.rfind(b"\n")
            if data[max(end - 2, 0) : max(end, 0)].strip(self._blanks) and data[end - 1] not in b" \t\n":
                # As almost always: the last whole line is none of blanks, and nothing need be moved but the lines.
                lines = b"".join((self._rest, memoryview(data)[:end]))
                self._rest = data[end + 1 :]
                return lines
            self._rest += data
        self._unended |= bool(self._rest) and not self._rest.endswith(b"\n")
        lines, self._rest = self._rest.rstrip(self._blanks), b""
        return lines or None

    def _fill_line(self) -> None:
        """Read on until a whole line is there, or the end of the file."""
        while b"\n" not in self._rest and not self._ended and len(self._rest) < _LONGEST_LINE:
            self._read_more()

    def _line(self, encoding: str = "utf-8", errors: str = "strict") -> str | None:
        """Take one line of the head; comments may be of any encoding."""
        self._fill_line()
        if not self._rest:
            return None
        line, _, self._rest = self._rest.partition(b"\n")
        self._lines_before += 1
        if len(line) > _LONGEST_LINE:
            place = f"{self._name}: line {self._lines_before}"
            raise ReadError(f"{place}: expected a line of text, found more than {_LONGEST_LINE} bytes without an end")
        try:
            return line.decode(encoding, errors).rstrip("\r")
        except UnicodeDecodeError:
            if line.startswith(b"#"):
                return line.decode("latin-1").rstrip("\r")
            hint = '; the layout says otherwise with encoding = "gbk", or another' if self._layout else ""
            shown = "UTF-8" if encoding == "utf-8" else encoding
            raise ReadError(f"{self._name}: line {self._lines_before}: expected {shown} text{hint}") from None

    # --- head --------------------------------------------------------------------------------------------------

    def _comments(self) -> str | None:
        """Take the comment lines and return the first line that is none."""
        while (line := self._line()) is not None:
            if line.startswith("#"):
                self._note(line)
            elif line.strip():
                return line
        return None

    def _note(self, comment: str) -> None:
        """Keep a comment ``# key: value``; what a layout says goes before."""
        key, colon, value = comment.lstrip("# ").partition(":")
        if colon and key.strip() and not (self._layout and key.strip() in (self._layout.metadata or {})):
            if key.strip() == CORRECTED_BY:
                self._corrected_by.append(value.strip())
            else:
                self._metadata[key.strip()] = value.strip()

    def _native_head(self) -> tuple[list[str], dict[str, str], np.ndarray]:
        line = self._comments()
        if line is None:
            raise ReadError(f"{self._name}: only comments; expected a line of titles 'name [unit]' and rows")
        if line.lstrip().startswith("{"):
            raise ReadError(f"{self._name}: expected a recording, found JSON (a calibration record?)")
        if line.startswith("FMT,"):
            raise ReadError(f"{self._name}: an ArduPilot log as text; expected the binary log (.bin) it was made from")
        if all(_is_number(field) for field in line.replace(",", " ").replace(";", " ").split()):
            raise ReadError(
                f"{self._name}: line {self._lines_before}: expected titles such as 'time [s],accel_x [m/s^2]', "
                "found numbers; describe a foreign file with --layout FILE.toml (imulab show --formats has an example)"
            )
        titles, units = [], {}
        for title in line.split(","):
            name, unit = parse_column_title(title, self._name)
            if not name:
                at_end = " (a comma at the end of the line?)" if line.rstrip().endswith(",") else ""
                raise ReadError(f"{self._name}: line {self._lines_before}: a column without a name{at_end}")
            if name in units:
                raise ReadError(f"{self._name}: line {self._lines_before}: column {name} appears twice")
            titles.append(name)
            units[name] = unit
        return titles, units, np.arange(len(titles), dtype=np.int32)

    def _layout_head(self, layout: Layout) -> tuple[list[str], dict[str, str], np.ndarray]:
        for _ in range(layout.skip_lines):
            line = self._line(layout.encoding, "replace")
            if line is None:
                break
            if line.startswith("#"):
                self._note(line)
        if layout.header:
            present = self._layout_titles(layout)
        else:
            self._fill_line()
            while self._rest.startswith(b"#"):
                self._note(self._line() or "")
                self._fill_line()
            first = self._rest.partition(b"\n")[0].decode("utf-8", "replace")
            present = [str(number) for number in range(len(_fields(first, layout.delimiter)))]
        if not self._rest.strip():
            raise ReadError(f"{self._name}: no rows of data below the header")
        slots = np.full(len(present), -1, dtype=np.int32)
        for slot, (name, column) in enumerate(layout.columns.items()):
            origin = column.origin
            if isinstance(origin, str) and present.count(origin) > 1:
                raise ReadError(
                    f"{self._name}: {layout.name} takes {name} from a column named {origin!r}, found it twice"
                )
            index = origin if isinstance(origin, int) else present.index(origin) if origin in present else -1
            if not 0 <= index < len(present):
                what = f"column {origin}" if isinstance(origin, int) else f"a column named {origin!r}"
                found = f"{len(present)} columns" if isinstance(origin, int) else " ".join(present)
                raise ReadError(f"{self._name}: {layout.name} takes {name} from {what}, found {found}")
            if slots[index] >= 0:
                other = list(layout.columns)[slots[index]]
                raise ReadError(f"{self._name}: {layout.name} takes both {other} and {name} from column {origin}")
            slots[index] = slot
        return list(layout.columns), layout.units, slots

    def _layout_titles(self, layout: Layout) -> list[str]:
        """Take the line of titles, which may itself begin with #; comments above it are kept."""
        wanted = {column.origin for column in layout.columns.values() if isinstance(column.origin, str)}
        while True:
            line = self._line(layout.encoding) or ""
            titles = [title.strip().strip('"') for title in _fields(line.lstrip("# "), layout.delimiter)]
            if not (wanted and line.startswith("#") and wanted.isdisjoint(titles)):
                return titles
            self._note(line)

    # --- rows --------------------------------------------------------------------------------------------------

    def _begin(self, block: bytes, crew: _Crew) -> tuple[bytes, np.ndarray, Callable[[], tuple[int, int, int]]]:
        """Begin to parse a block of whole lines; return it, where its numbers will be, and the answer to wait for."""
        if self._layout and self._layout.decimal == ",":
            block = block.replace(b",", b".")
        # A whole row has at least a sign for each of its fields; the first that has not is refused.
        capacity = min(block.count(b"\n"), len(block) // len(self._slots) + 1) + 1
        room, first = self._place_for(capacity, len(block))
        job = partial(_text.parse, block, self._delimiter, self._slots, room, room.shape[1], 0, -1, first)
        return block, room[:, first : first + capacity], crew.begin(job) if len(block) >= _WORTH_SHARING else job

    def _place_for(self, rows: int, size: int) -> tuple[np.ndarray, int]:
        """Return an array of columns, and the row of it where a block of so many rows and bytes goes.

        A file that is read as a whole goes into one array, made for as many rows as its first block foretells.
        """
        if self._size and self._room is None:
            left = max(self._size - self._taken + len(self._rest), 0)
            self._room = np.empty((len(self._titles), rows + int(1.02 * rows * left / size) + 16))
        if self._room is None or self._used + rows > self._room.shape[1]:
            return np.empty((len(self._titles), rows)), 0
        first, self._used = self._used, self._used + rows
        return self._room, first

    def _finish(self, block: bytes, out: np.ndarray, answer: Callable[[], tuple[int, int, int]], row: int) -> Recording:
        """Wait for a block and return its rows, which begin at row `row` of the file."""
        rows, problem, field = answer()
        if problem:
            self._refuse(block, row, rows, problem, field)
        columns = dict(zip(self._titles, out[:, :rows], strict=True))
        if self._readings is not None:
            columns = self._readings.of(columns, row)
        return Recording(
            columns=columns,
            units=self._units,
            metadata=self._metadata,
            name=self._name,
            first_row=row,
            lines_before=self._lines_before,
            corrected_by=tuple(self._corrected_by),
        )

    def _refuse(self, block: bytes, row: int, index: int, problem: int, field: int) -> None:
        number = row + index
        place = f"{self._name}: row {number} (line {number + self._lines_before})"
        line = block.split(b"\n", index + 1)[index].decode("utf-8", "replace").rstrip("\r")
        if not line.strip(" \t"):
            raise ReadError(f"{place}: expected {len(self._slots)} fields, found an empty line")
        if problem == 2:
            raise ReadError(f"{place}: expected {len(self._slots)} fields, found {field}")
        found = _fields(line, self._delimiter)[field].strip(" \t\r")
        slot = int(self._slots[field])
        shown = found if len(found) <= 40 else found[:37] + "..."
        comma = " (a decimal comma? expected a point)" if re.fullmatch(r"[-+]?\d+,\d+", found) else ""
        if comma and self._layout:
            comma += '; decimal = "," in the layout reads it'
        raise ReadError(f"{place}, column {self._titles[slot]}: expected a number, found {shown!r}{comma}")


def _fields(line: str, delimiter: str) -> list[str]:
    """Split a line as the C module does: blanks are spaces and tabs, nothing else."""
    return re.split(r"[ \t]+", line.strip(" \t\r")) if delimiter == " " else line.split(delimiter)


def _is_file(stream: BinaryIO) -> bool:
    """Whether the stream is an open file, whose size is known."""
    try:
        return stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
    except (OSError, ValueError):
        return False


def _is_pipe(stream: BinaryIO) -> bool:
    """Whether lines come as they are made, so that none may be held back."""
    try:
        return not stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
    except (OSError, ValueError):
        return False


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
