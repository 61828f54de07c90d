"""Delimited text: its lines, native CSV, and foreign text through a layout.

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
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import BinaryIO

import numpy as np
from msgspec import Struct

import imulab.readers._text as _text
from imulab.columns import kind_of, measured, parse_column_title
from imulab.display import Finding, Note
from imulab.errors import ReadError, meant, several
from imulab.readers.formats import packed_by
from imulab.readers.labelled import LabelledLines
from imulab.readers.layout import BackwardsError, Readings
from imulab.readers.opened import HEAD, opened, unit_row
from imulab.readers.titles import fields_of, titles_of
from imulab.recording import CORRECTED_BY, Array, Layout, LayoutColumn, Recording
from imulab.writers import powers_of_five

# Lines of a file: one by one for the head, in whole blocks below.


_BLOCK_BYTES = 1 << 21  # read at once
WORTH_SHARING = 1 << 19  # bytes from which a block is shared among threads
_MOST_THREADS = 8  # that parse one file
_MOST_WAITING = 4  # blocks that are read and not yet hashed
LONGEST_LINE = 1 << 20  # bytes: a longer line without an end is no text
_OF_DATA = re.compile(rb"^(?!#)[^\n]*\S[^\n]*", re.M)  # a line that is neither blank nor a comment


class ParserThreads:
    """Threads of the parser, as many as processors; they are started when there is work.

    OMP_NUM_THREADS limits them as it does the linear algebra, so that workers beside each other do not compete.
    """

    def __init__(self) -> None:
        processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
        allowed = os.environ.get("OMP_NUM_THREADS", "")
        self.size = min(_MOST_THREADS, processors, int(allowed) if allowed.isdecimal() and int(allowed) else processors)
        self._pool: ThreadPoolExecutor | None = None

    def begin(self, job: Callable[[], tuple[int, int, int]]) -> Callable[[], tuple[int, int, int]]:
        """Start work on a thread, and return a function that waits for the result."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.size)
        return self._pool.submit(job).result

    def __enter__(self) -> ParserThreads:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


class Hash:
    """SHA-256 of the bytes read, computed in its own thread for large files; its errors are raised here."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._pool: ThreadPoolExecutor | None = None
        self._waiting: deque[Future[None]] = deque()

    def update(self, data: bytes) -> None:
        """Add these bytes; wait first where several blocks are not yet hashed, so that they do not fill the memory."""
        if self._pool is None and len(data) < WORTH_SHARING:
            self._hash.update(data)
            return
        self._pool = self._pool or ThreadPoolExecutor(1)
        if len(self._waiting) == _MOST_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._pool.submit(self._hash.update, data))

    def stop(self) -> None:
        """Wait until all bytes are in."""
        if self._pool is not None:
            self._pool.shutdown()
        while self._waiting:
            self._waiting.popleft().result()

    def hexdigest(self) -> str:
        """Return the hash, hexadecimal."""
        return self._hash.hexdigest()


class Lines:
    """One pass over the lines of a stream.

    Attributes
    ----------
    live
        Whether lines come as they are made, so that none may be held back.
    size, taken
        Bytes of the file, 0 where that is not known or not asked for; bytes read so far.
    before
        Lines that `line` has taken.
    unended
        Whether the last line has no line end.
    overlong
        Whether the rows ended with a line that is too long to be one.
    zeros
        Bytes of zero at the end of the file, as a card has them whose file was made larger than what was written.
    """

    def __init__(self, stream: BinaryIO, name: str, *, hashed: bool, whole: bool) -> None:
        self.live = _is_pipe(stream)
        self._read = getattr(stream, "read1", stream.read) if self.live else stream.read
        self._name = name
        self._hash = Hash() if hashed else None
        self._rest = b""
        self._at = 0
        self._ended = self.unended = self.overlong = False
        self.zeros = 0
        self.taken = self.before = 0
        self.size = os.fstat(stream.fileno()).st_size if whole and not self.live and _is_file(stream) else 0
        self._read_more()
        while len(self._rest) < len(BOM_UTF8) and not self._ended:
            self._read_more()
        self._rest = self._rest.removeprefix(BOM_UTF8)
        while not self._rest.strip() and not self._ended:
            self._read_more()
        if not self._rest.strip():
            raise ReadError(f"{name}: the file is empty")
        if packer := packed_by(self._rest):
            raise ReadError(f"{name}: expected text, found what {packer} packed: unpack it first")
        if b"\0" in self._rest[:4096]:
            wide = " (UTF-16? expected UTF-8)" if self._rest.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else ""
            raise ReadError(f"{name}: expected text, found binary data{wide}")

    @property
    def waiting(self) -> int:
        """Number of bytes that were read and not yet used."""
        return len(self._rest) - self._at

    def sha256(self) -> str:
        """Return the SHA-256 of the bytes read so far, hexadecimal."""
        if self._hash is None:
            return ""
        self._hash.stop()
        return self._hash.hexdigest()

    def drain(self) -> None:
        """Read to the end, so that the hash is that of the whole file."""
        while not self._ended:
            self._next_bytes()

    def block(self, blanks: bytes) -> bytes | None:
        """Return whole lines of about a block's size, without blank lines at the end of the file; None at its end.

        A line that is too long ends the file, and `overlong` is set.
        """
        self._rest, self._at = self._rest[self._at :], 0
        while not self._ended:
            end = self._rest.rfind(b"\n") + 1
            if end:
                lines, self._rest = self._rest[:end], self._rest[end:]
                # Blank lines may be the end of the file: they wait for the lines after them.
                kept = lines.rstrip(blanks)
                if kept:
                    self._rest = lines[len(kept) :].partition(b"\n")[2] + self._rest
                    return kept
                self._rest = lines + self._rest
                self._read_more()
                continue
            data = self._next_bytes()
            end = data.rfind(b"\n")
            if data[max(end - 2, 0) : max(end, 0)].strip(blanks) and data[end - 1] not in b" \t\n":
                # As almost always: the last whole line is none of blanks, and nothing need be moved but the lines.
                lines = b"".join((self._rest, memoryview(data)[:end]))
                self._rest = data[end + 1 :]
                return lines
            if end < 0 and len(self._rest) + len(data) > LONGEST_LINE:
                self.overlong, self._rest = True, b""
                return None
            self._rest += data
        if self.zeros and not self._rest.endswith(b"\n"):  # the line in which the writing stopped
            self._rest = self._rest[: self._rest.rfind(b"\n") + 1]
        self.unended |= bool(self._rest) and not self._rest.endswith(b"\n")
        lines, self._rest = self._rest.rstrip(blanks), b""
        return lines or None

    def next_line(self) -> bytes:
        """Return the next line without consuming it, or as much as a line may have; empty at the end."""
        end = self._rest.find(b"\n", self._at)
        while end < 0 and not self._ended and self.waiting <= LONGEST_LINE:
            self._rest, self._at = self._rest[self._at :], 0
            looked = len(self._rest)
            self._read_more()
            end = self._rest.find(b"\n", looked)
        return self._rest[self._at : end if end >= 0 else len(self._rest)]

    def first(self) -> bytes:
        """Return the first line that is neither blank nor a comment without consuming it; empty if there is none."""
        while True:
            match = _OF_DATA.search(self._rest, self._at)
            if self._ended or self.waiting > LONGEST_LINE or (match and match.end() < len(self._rest)):
                return match[0] if match else b""
            self._read_more()

    def head(self, size: int) -> bytes:
        """Return the first bytes without consuming them, fewer from a pipe or a short file."""
        while self.waiting < size and not self._ended and not self.live:
            self._read_more()
        return self._rest[self._at : self._at + size]

    def line(self, encoding: str = "utf-8", errors: str = "strict", hint: str = "") -> str | None:
        """Return one line of the head, None at the end of the file; comments may have any encoding.

        Raises
        ------
        ReadError
            The line is too long, or is not of that encoding; `hint` ends the message.
        """
        line = self.next_line()
        if not self.waiting:
            return None
        self._at = min(self._at + len(line) + 1, len(self._rest))
        self.before += 1
        place = f"{self._name}: line {self.before}"
        if len(line) > LONGEST_LINE:
            raise ReadError(f"{place}: expected a line of text, found more than {LONGEST_LINE} bytes without an end")
        try:
            return line.decode(encoding, errors).rstrip("\r")
        except UnicodeDecodeError:
            if line.startswith(b"#"):
                return line.decode("latin-1").rstrip("\r")
            shown = "UTF-8" if encoding == "utf-8" else encoding
            raise ReadError(f"{place}: expected {shown} text{hint}") from None

    def is_blank(self) -> bool:
        """Return whether only blank lines follow; reads on until that is known."""
        while not self._rest[self._at :].strip() and not self._ended:
            self._read_more()
        return not self._rest[self._at :].strip()

    def _read_more(self) -> None:
        self._rest += self._next_bytes()

    def _next_bytes(self) -> bytes:
        while True:
            try:
                data = self._read(_BLOCK_BYTES)
            except OSError as error:
                raise ReadError(f"{self._name}: cannot be read: {error.strerror}") from None
            self._ended = not data
            self.taken += len(data)
            if self._hash:
                self._hash.update(data)
            if not (data and (self.zeros or data.endswith(b"\0"))):
                return data
            data = self._without_zeros(data)
            if data:
                return data

    def _without_zeros(self, data: bytes) -> bytes:
        """Return bytes without the zeros at their end, which are counted; text behind zeros is refused."""
        kept = data.rstrip(b"\0")
        if self.zeros and kept:
            raise ReadError(
                f"{self._name}: {self.zeros} bytes of zero before byte {self.taken}: expected text, found a gap"
            )
        self.zeros += len(data) - len(kept)
        return kept


def without_stray_times(blocks: Iterable[Recording], name: str) -> Iterator[Recording]:
    """Yield blocks without rows whose time alone is off: it falls, or leaps ahead, and the next goes on as before.

    The last block has a note that counts them. Rows after which time goes on from there stay.

    Raises
    ------
    ReadError
        More rows are so than are torn.
    """
    count, rows, first, last = 0, 0, "", -np.inf
    held: Recording | None = None
    for block in blocks:
        time = block.time
        stray = np.zeros(len(block), dtype=bool) if time is None else _stray(time, last)
        if time is not None and stray.any():
            first = first or block.place(int(np.argmax(stray)))
            count += int(stray.sum())
            kept = {key: values[~stray] for key, values in block.columns.items()}
            block = replace(block, columns=kept, lines_before=None)
        rows += len(block)
        if not are_torn(count, rows):
            raise ReadError(f"{name}: the times of {count} rows are off, the first at {first}: these are no torn lines")
        if time is not None and len(block):
            last = float(time[~stray][-1])
        if held is not None:
            yield held
        held = block
    if held is not None:
        many = "1 row whose time is" if count == 1 else f"{count} rows whose times are"
        note = (of_few(f"{many} off alone left out; the first: {first}", count, rows),) if count else ()
        yield replace(held, notes=(*held.notes, *note))


def are_torn(count: int, rows: int) -> bool:
    """Return whether so many damaged lines among so many rows are torn ones, which may be left out."""
    return count <= max(_FEW_DAMAGED, _MOST_DAMAGED * rows)


def of_few(text: str, count: int, rows: int) -> str:
    """Return a note on damaged lines where they are few, else a finding that asks for another recording."""
    return Note(text) if count == 1 or count < _FEW * rows else Finding(text, "record again without torn lines")


def _stray(time: Array, last: float) -> np.ndarray:
    """Return which rows have a time that falls or leaps, with the next going on from the row before, shape (n,)."""
    stray = np.zeros(len(time), dtype=bool)
    before = np.concatenate([[last], time])
    for row in np.flatnonzero(np.diff(before) < 0).tolist():  # earlier than the row above it
        ahead = time[row + 1] if row + 1 < len(time) else np.inf
        above = row - 1
        if above >= 0 and before[above] < time[row] < ahead:
            stray[above] = True
        elif ahead > before[row]:
            stray[row] = True
    return stray


def _is_file(stream: BinaryIO) -> bool:
    """Return whether the stream is an open file with a known size."""
    try:
        return stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
    except (OSError, ValueError):
        return False


def _is_pipe(stream: BinaryIO) -> bool:
    """Return whether lines arrive one by one, so that none may be delayed."""
    try:
        return not stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
    except (OSError, ValueError):
        return False


# Delimited text: native CSV, and foreign text through a layout.


_text.prepare(powers_of_five())
_TITLE = re.compile(r"[^,\[\]]+\[[^,\[\]]+\]")
_DATE, _DAY_FIRST, _MONTH_FIRST = 1 << 30, 1 << 28, 1 << 29  # flags of a column of dates, beyond any column's number
_COLUMN = _DAY_FIRST - 1  # the number without flags
_LONGEST = 1100  # characters of a number, as in C: the exact digits of any double are fewer
_NOT_A_NUMBER, _WRONG_COUNT, _NOT_A_DATE, EITHER_ORDER = 1, 2, 3, 4  # problems that the parser in C reports
_ARROW = re.compile(rb"^[ \t]*(\d?\d:\d\d:\d\d(?:[.:]\d+)?) -> ?", re.M)
"""What a serial monitor puts before each line."""
_DATE_ELSEWHERE = re.compile(r'"?\d\d?[./-]\d\d?[./-]\d{4}\b')
_FEW_DAMAGED, _MOST_DAMAGED = 20, 0.02  # lines, and share of lines, that may be left out as damaged
_FEW = 0.001  # share of lines below which those that are left out are only noted
_MOST_ABOVE = 100  # lines above the titles
_BEFORE_BLANK = re.compile(rb",(?=[ \t\r\n])|,$")
_UNENDED = Note("the last line has no line end: if the file was cut there, its last number is short")


class _Job(Struct, frozen=True):
    """A block of lines that is being parsed.

    Attributes
    ----------
    lines
        As they stand in the file.
    rows
        The rows among them: the same lines, but for what a layout's prefix and skip_incomplete leave out.
    out
        Where the numbers will be, a row of the array for each column.
    answer
        What the parser says, once it has finished.
    parse
        The parser from a byte of `rows` into a row of `out` on, for these fields' columns.
    """

    lines: bytes
    rows: bytes
    out: np.ndarray
    answer: Callable[[], tuple[int, int, int]]
    parse: Callable[[int, int, np.ndarray], tuple[int, int, int]]


class TextFile:
    """One pass over a text file; the head is read when it is opened, rows come from `blocks`.

    `doubts` are notes on whether the file is one that the layout is for.
    """

    def __init__(
        self,
        stream: BinaryIO,
        name: str,
        layout: Layout | None,
        units: Mapping[str, str] | None = None,
        *,
        skip_damaged: bool = False,
        hashed: bool = True,
        whole: bool = False,
    ) -> None:
        self._name, self._stated, self._skips_damaged = name, units, skip_damaged
        self._damaged = 0
        self._first_damage = ""
        self._texts: dict[str, int] = {}
        self._is_ours = False
        self._lines = Lines(stream, name, hashed=hashed, whole=whole)
        if layout is not None and layout.if_needed and is_native(self._lines.first().decode("utf-8", "replace")):
            layout = None
        self.doubts: list[str] = []
        if layout is not None:
            layout = opened(layout, self._lines.head(HEAD), name)
            head = self._lines.head(HEAD)
            if layout.marks and not any(mark.encode() in head for mark in layout.marks):
                self.doubts.append(
                    f"none of {', '.join(layout.marks)} stands above the titles, as in files of {layout.name}: are its "
                    "units those of this file?"
                )
        self._layout = layout
        self._readings = Readings(layout, name, skip_damaged=skip_damaged) if layout else None
        self._room: np.ndarray | None = None
        self._used = 0
        self._corrected_by: list[str] = []
        self._metadata: dict[str, str] = dict(layout.metadata or {}) if layout else {}
        self.sha256, self.drain = self._lines.sha256, self._lines.drain
        self._delimiter = layout.delimiter if layout else ","
        self._blanks = b" \r\n" if self._delimiter == "\t" else b" \t\r\n"
        self._prefix = (layout.prefix if layout else "").encode()
        self._skips = layout is not None and layout.skip_incomplete
        self._chooses = bool(self._prefix) or self._skips
        self._most_fields = 0
        self._passed = self._incomplete = 0
        self._arrow = _arrow(layout, self._lines.first()) if layout else None
        self._labels: LabelledLines | None = None
        self._titles, self._units, self._slots = self._layout_head(layout) if layout else self._native_head()
        if layout is None or layout.header:
            self._pass_last_delimiter()

    def blocks(self) -> Iterator[Recording]:
        """Yield the rows as recordings; a file without rows is refused."""
        last, noted = None, False
        for block in self._blocks():
            if not self._skips:
                yield block
                continue
            if self._lines.live:
                first, noted = self._incomplete > 0 and not noted, noted or self._incomplete > 0
                yield replace(block, notes=(*block.notes, self._skipped())) if first else block
                continue
            if last is not None:
                yield last
            last = block
        if last is not None:
            note = (self._skipped(),) if self._incomplete else ()
            yield replace(last, notes=(*last.notes, *note))

    def _blocks(self) -> Iterator[Recording]:
        row = 1
        waiting: deque[_Job] = deque()
        live, counts = self._lines.live, self._chooses or self._skips_damaged or self._labels is not None
        with ParserThreads() as threads:
            while True:
                lines = self._lines.block(self._blanks)
                if lines is not None:
                    waiting.append(self._begin(lines, threads))
                # A file is read ahead while threads parse; lines of a pipe are passed on at once.
                while waiting and (lines is None or live or len(waiting) > threads.size):
                    job = waiting.popleft()
                    rows, problem, field = self._mended(job, row, *job.answer())
                    try:
                        recording = self._finish(job.out[:, :rows], row)
                    except BackwardsError as error:
                        if live and error.index:
                            yield self._finish(job.out[:, : error.index], row)
                        raise
                    if (live or (lines is None and not waiting)) and (notes := self._notes(row + rows)):
                        recording = replace(recording, notes=(*recording.notes, *notes))
                    if self._lines.zeros and lines is None and not waiting:
                        recording = replace(recording, notes=(*recording.notes, self._zeros()))
                    if self._lines.unended and not waiting:
                        recording = replace(recording, notes=(*recording.notes, _UNENDED))
                    # The good rows of a stream are kept if a bad one follows them.
                    if rows and (live or not problem):
                        yield recording
                    if problem:
                        self._refuse(job, row, rows, problem, field)
                    row += rows
                    self._passed += job.lines.count(b"\n") + (not job.lines.endswith(b"\n")) if counts else rows
                if lines is None:
                    break
        if self._lines.overlong:
            raise ReadError(
                f"{self._name}: row {row} (line {self._lines.before + self._passed + 1}): expected a line of text, "
                f"found more than {LONGEST_LINE} bytes without an end"
            )
        if row == 1 and self._incomplete:
            raise ReadError(f"{self._name}: no rows of data: {self._skipped()}")
        if row == 1:
            raise ReadError(f"{self._name}: no rows of data below the header")

    def _zeros(self) -> str:
        return f"truncated: {self._lines.zeros} bytes of zero behind the rows, and a line cut there, are left out"

    def _skipped(self) -> str:
        return self._layout.skipped(self._incomplete, so_far=self._lines.live) if self._layout else ""

    # --- head --------------------------------------------------------------------------------------------------

    def _comments(self) -> str | None:
        """Read the comment lines and return the first other line."""
        while (line := self._lines.line()) is not None:
            if line.startswith("#"):
                self._note(line)
            elif line.strip():
                return line
        return None

    def _note(self, comment: str) -> None:
        """Store a comment ``# key: value``; an entry of the layout has precedence."""
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
        if all(is_number(field) for field in line.replace(",", " ").replace(";", " ").split()):
            raise ReadError(
                f"{self._name}: line {self._lines.before}: expected titles such as 'time [s],accel_x [m/s^2]', "
                "found numbers; describe a foreign file with --layout FILE.toml (imulab show --formats has an example)"
            )
        titles, units = [], {}
        for title in line.split(","):
            name, unit = parse_column_title(title, self._name, self._stated)
            if not name:
                at_end = " (a comma at the end of the line?)" if line.rstrip().endswith(",") else ""
                raise ReadError(f"{self._name}: line {self._lines.before}: a column without a name{at_end}")
            if name in units:
                raise ReadError(f"{self._name}: line {self._lines.before}: column {name} appears twice")
            titles.append(name)
            units[name] = unit
        return self._without_text(titles, units)

    def _without_text(self, titles: list[str], units: dict[str, str]) -> tuple[list[str], dict[str, str], np.ndarray]:
        """Return the columns without those that imulab does not know and whose first field is text."""
        self._is_ours = any(kind_of(measured(name)) not in (None, "time") for name in titles)
        fields = [field.strip(' "\t\r') for field in fields_of(self._lines.first().decode("utf-8", "replace"), ",")]
        texts = [
            name
            for name, field in zip(titles, fields, strict=False)
            if kind_of(measured(name)) is None and field and not is_number(field)
        ]
        kept = [name for name in titles if name not in texts]
        if not texts or not self._is_ours:
            return titles, units, np.arange(len(titles), dtype=np.int32)
        holds = f"column {texts[0]} holds" if len(texts) == 1 else f"columns {' '.join(texts)} hold"
        self.doubts.append(Note(f"{holds} text, which is left out"))
        slots = np.array([-1 if name in texts else kept.index(name) for name in titles], dtype=np.int32)
        return kept, {name: units[name] for name in kept}, slots

    def _layout_head(self, layout: Layout) -> tuple[list[str], dict[str, str], np.ndarray]:
        if layout.labelled:
            labels = [str(column.origin) for column in layout.columns.values()]
            self._labels = LabelledLines(labels, self._name, layout.name, skips=self._skips)
            self._labels.check(self._lines.head(HEAD).decode("utf-8", "replace"))
            self._chooses = self._skips = False
            return list(layout.columns), layout.units, np.arange(len(labels), dtype=np.int32)
        for _ in range(layout.skip_lines):
            line = self._lines.line(layout.encoding, "replace")
            if line is None:
                break
            if line.startswith("#"):
                self._note(line)
        if layout.header:
            present = self._layout_titles(layout)
            self._check_units_row(layout, present)
        else:
            present = [str(number) for number in range(self._first_fields(layout))]
        if self._lines.is_blank():
            raise ReadError(f"{self._name}: no rows of data below the header")
        self._most_fields = len(present) if layout.header else 0
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
                known = f"{len(present)} columns" if isinstance(origin, int) else several(present)
                raise ReadError(f"{self._name}: {layout.name} takes {name} from {what}, found {known}")
            if slots[index] >= 0:
                other = list(layout.columns)[slots[index] & _COLUMN]
                raise ReadError(f"{self._name}: {layout.name} takes both {other} and {name} from column {origin}")
            slots[index] = slot | date_flags(column) if column.date else slot
        if self._skips:
            slots = slots[: int(np.flatnonzero(slots >= 0)[-1]) + 1]
        return list(layout.columns), layout.units, slots

    def _check_units_row(self, layout: Layout, titles: list[str]) -> None:
        """Read a row of units below the titles; one that says other units than the layout is refused."""
        row = unit_row(self._lines.next_line().decode(layout.encoding, "replace").rstrip("\r"), layout.delimiter)
        if not row:
            return
        self._lines.line(layout.encoding, "replace")
        for name, column in layout.columns.items():
            place = titles.index(column.origin) if isinstance(column.origin, str) else column.origin
            unit = row[place] if place < len(row) else ""
            if unit and column.scale == column.scale_factor == 1.0 and not column.date and unit != column.unit:
                raise ReadError(
                    f"{self._name}: line {self._lines.before}: the row of units says {unit} for {titles[place]!r}, "
                    f"{layout.name} says {column.unit} for {name}: correct the layout"
                )

    def _pass_last_delimiter(self) -> None:
        """Allow an empty field more than there are titles, in every row, if the first row ends with a delimiter."""
        line = self._lines.next_line().decode("utf-8", "replace").rstrip("\r")
        titles = self._most_fields or len(self._slots)
        if self._delimiter == " " or self._prefix or not line.endswith(self._delimiter):
            return
        if len(fields_of(line, self._delimiter)) == titles + 1:
            self._most_fields = titles + 1
            if not self._skips:
                self._slots = np.append(self._slots, np.int32(-1))

    def _first_fields(self, layout: Layout) -> int:
        """Return the number of fields in a row: as in the first, or as asked for where rows may lack some."""
        line = self._unstamped(self._lines.next_line())
        while self._lines.waiting and (line.startswith(b"#") or not self._has_prefix(line)):
            comment = self._lines.line(layout.encoding, "replace") or ""
            if comment.startswith("#"):
                self._note(comment)
            line = self._unstamped(self._lines.next_line())
        if self._skips:
            return 1 + max(column.origin for column in layout.columns.values() if isinstance(column.origin, int))
        if self._prefix and not self._lines.waiting:
            raise ReadError(
                f"{self._name}: no line whose first field is {layout.prefix!r}, the prefix in {layout.name}"
            )
        return len(layout.behind_prefix(fields_of(line.decode("utf-8", "replace"), layout.delimiter)) or [])

    def _unstamped(self, lines: bytes) -> bytes:
        """Return lines with a serial monitor's time of day as their first field, or without it where none is taken."""
        return lines if self._arrow is None else self._arrow[0].sub(self._arrow[1], lines)

    def _has_prefix(self, line: bytes) -> bool:
        return (
            not self._prefix
            or _text.choose(line, self._delimiter, bytearray(len(line) + 1), self._prefix, b"", False)[1] == 1
        )

    def _layout_titles(self, layout: Layout) -> list[str]:
        """Read the line of titles, which may begin with #, and the lines above it; their comments are kept."""
        wanted = {column.origin for column in layout.columns.values() if isinstance(column.origin, str)}
        hint = '; the layout says of which encoding it is, such as encoding = "gbk"'
        best: list[str] = []
        above = 0
        while above < _MOST_ABOVE:
            line = self._lines.line(layout.encoding, hint=hint)
            if line is None:
                break
            titles = titles_of(self._unstamped(line.encode()).decode(), layout.delimiter)
            if wanted.issubset(titles):
                return layout.behind_prefix(titles) or titles[1:]
            if line.startswith("#") and wanted.isdisjoint(titles):
                self._note(line)
                continue
            above += 1
            if line.strip() and (not best or len(wanted.intersection(titles)) > len(wanted.intersection(best))):
                best = titles
        if not wanted:
            return best
        name, origin = next(
            (name, column.origin) for name, column in layout.columns.items() if column.origin in wanted.difference(best)
        )
        raise ReadError(
            f"{self._name}: {layout.name} takes {name} from a column named {origin!r}, "
            f"found {several(best) or 'no titles'}{meant(best, origin)}"
        )

    # --- rows --------------------------------------------------------------------------------------------------

    def _begin(self, lines: bytes, threads: ParserThreads) -> _Job:
        """Start parsing a block of whole lines."""
        rows = self._unstamped(lines)
        if self._layout and self._layout.decimal == ",":
            rows = rows.replace(b",", b".")
        if self._labels is not None:
            rows = self._labels.read(rows)
            self._incomplete = self._labels.incomplete
        if self._delimiter == " " and b"," in rows:  # 0.1, 0.2, 0.3
            rows = _BEFORE_BLANK.sub(b"", rows)
        if self._chooses:
            rows, _ = self._chosen(rows, -1)
        # A row has at least one character for each of its fields; a shorter one is refused.
        capacity = min(_text.line_ends(rows), len(rows) // len(self._slots) + 1) + 1
        room, first = self._place_for(capacity, len(lines))
        job = partial(_text.parse, rows, self._delimiter, self._slots, room, room.shape[1], 0, -1, first)
        answer = threads.begin(job) if len(rows) >= WORTH_SHARING else job

        def parse(start: int, row: int, slots: np.ndarray) -> tuple[int, int, int]:
            return _text.parse(rows, self._delimiter, slots, room, room.shape[1], start, -1, first + row)

        return _Job(lines, rows, room[:, first : first + capacity], answer, parse)

    def _mended(self, job: _Job, row: int, rows: int, problem: int, field: int) -> tuple[int, int, int]:
        """Return the parser's answer once what may be passed over is.

        Text in a column that imulab does not know is no reading, and becomes nan; a damaged line is left out where that
        was asked for. With a problem that remains, the first number is the index of its line.
        """
        if not problem:
            return rows, problem, field
        ends = np.flatnonzero(np.frombuffer(job.rows, np.uint8) == ord("\n"))
        slots, line, good = self._slots, rows, rows
        while problem:
            foreign = problem == _NOT_A_NUMBER and self._foreign(int(self._slots[field]))
            if foreign:
                slots = np.where(np.arange(len(slots)) == field, np.int32(-1), slots)
                column = int(self._slots[field])
                job.out[column, good:] = np.nan
                self._texts.setdefault(self._titles[column], row + good)
            elif self._skips_damaged:
                self._count_damage(job, row, line, problem, field, row + good)
                line += 1
            else:
                return line, problem, field
            start = int(ends[line - 1]) + 1 if 0 < line <= len(ends) else 0 if not line else len(job.rows)
            rows, problem, field = job.parse(start, good, slots)
            good, line = good + rows, line + rows
        return good, 0, field

    def _foreign(self, slot: int) -> bool:
        """Return whether a column of a native file is none that imulab knows."""
        return self._layout is None and self._is_ours and kind_of(measured(self._titles[slot])) is None

    def _count_damage(self, job: _Job, row: int, line: int, problem: int, field: int, good: int) -> None:
        self._damaged += 1
        try:
            self._refuse(job, row, line, problem, field)
        except ReadError as error:
            self._first_damage = self._first_damage or str(error).removeprefix(f"{self._name}: ")
        if not are_torn(self._damaged, good):
            raise ReadError(
                f"{self._name}: {self._damaged} lines of the first {good + self._damaged} cannot be read, which are no "
                f"torn lines; the first: {self._first_damage}"
            )

    def _notes(self, rows: int) -> list[str]:
        """Return notes on what was passed over in a file of so many rows."""
        lines = "line is" if self._damaged == 1 else "lines are"
        notes = [self._skipped()] if self._labels and self._incomplete else []
        if self._damaged:
            damage = f"{self._damaged} damaged {lines} left out; the first: {self._first_damage}"
            notes.append(of_few(damage, self._damaged, rows))
        return notes + [
            f"column {name} holds text from row {row} on, which is no reading (nan)"
            for name, row in self._texts.items()
        ]

    def _chosen(self, lines: bytes, most: int) -> tuple[bytes, int]:
        """Return the rows that prefix and skip_incomplete leave, at most so many, and the number of lines for them."""
        out = bytearray(len(lines) + 1)
        size, _, count, incomplete = _text.choose(
            lines, self._delimiter, out, self._prefix, self._slots, self._skips, self._most_fields, most
        )
        self._incomplete += incomplete if most < 0 else 0
        return bytes(memoryview(out)[:size]), count

    def _place_for(self, rows: int, size: int) -> tuple[np.ndarray, int]:
        """Return an array of columns, and the row of it where a block of so many rows and bytes goes.

        A file that is read as a whole goes into one array, made for as many rows as its first block foretells.
        """
        if self._lines.size and self._room is None:
            left = max(self._lines.size - self._lines.taken + self._lines.waiting, 0)
            self._room = np.empty((len(self._titles), rows + int(1.02 * rows * left / size) + 16))
        if self._room is None or self._used + rows > self._room.shape[1]:
            return np.empty((len(self._titles), rows)), 0
        first, self._used = self._used, self._used + rows
        return self._room, first

    def _finish(self, out: np.ndarray, row: int) -> Recording:
        """Return the rows of a block, which begin at row `row` of the file."""
        columns = dict(zip(self._titles, out, strict=True))
        before = None if self._chooses or self._damaged or self._labels else self._lines.before
        if self._readings is not None:
            columns = self._readings.of(columns, row, before)
            self._metadata |= self._readings.epoch
        return Recording(
            columns=columns,
            units=self._units,
            metadata=self._metadata,
            name=self._name,
            first_row=row,
            lines_before=before,
            corrected_by=tuple(self._corrected_by),
            from_file=True,
        )

    def _refuse(self, job: _Job, row: int, index: int, problem: int, field: int) -> None:
        above = self._chosen(job.lines, index + 1)[1] if self._chooses else index + 1
        place = f"{self._name}: row {row + index} (line {self._lines.before + self._passed + above})"
        line = job.rows.split(b"\n", index + 1)[index].decode("utf-8", "replace").rstrip("\r")
        expected = self._most_fields or len(self._slots)
        if self._prefix and not line.strip(" \t"):
            raise ReadError(f"{place}: expected {expected} fields behind the prefix, found none")
        if not line.strip(" \t"):
            raise ReadError(f"{place}: expected {expected} fields, found an empty line")
        if problem == _WRONG_COUNT:
            raise ReadError(f"{place}: expected {expected} fields, found {field}")
        entry = fields_of(line, self._delimiter)[field].strip(" \t\r")
        column = self._titles[int(self._slots[field]) & _COLUMN]
        shown = entry if len(entry) <= 40 else entry[:37] + "..."
        if problem == EITHER_ORDER:
            raise ReadError(
                f"{place}, column {column}: {shown!r} may be day or month first; expected day_first = true or false "
                "for this column in the layout"
            )
        if problem == _NOT_A_DATE:
            hint = "; day_first in the layout says which of day and month comes first"
            raise ReadError(
                f"{place}, column {column}: expected a date and time such as 2026-11-22T15:04:05.250Z, found {shown!r}"
                + (hint if _DATE_ELSEWHERE.match(entry) else "")
            )
        comma = " (a decimal comma? expected a point)" if re.fullmatch(r"[-+]?\d+,\d+", entry) else ""
        if comma and self._layout:
            comma += '; decimal = "," in the layout reads it'
        wanted = "a number" if len(entry) <= _LONGEST else f"a number of at most {_LONGEST} characters"
        raise ReadError(f"{place}, column {column}: expected {wanted}, found {shown!r}{comma}")


def _arrow(layout: Layout, line: bytes) -> tuple[re.Pattern[bytes], bytes] | None:
    """Return what to replace in lines of a serial monitor, ``13:58:48.156 -> 0.1,0.2``, by what; None for others.

    The time of day becomes the first field where the layout takes a date; else it goes. With blanks between fields
    and no prefix, time and arrow are two fields already.
    """
    blank = layout.delimiter == " "
    if not _ARROW.match(line) or (blank and not layout.prefix):
        return None
    between = layout.delimiter.encode()
    prefix = re.escape(layout.prefix.encode())
    joined = rb"[ \t]*" if blank else re.escape(between) + b"?"
    pattern = re.compile(_ARROW.pattern + (b"(" + prefix + b")" if prefix else b"()") + joined, re.M)
    dated = any(column.date for column in layout.columns.values())
    if prefix:
        return pattern, rb"\2" + between + (rb"\1" + between if dated else b"")
    return pattern, rb"\1" + between if dated else b""


def date_flags(column: LayoutColumn) -> int:
    """Return the flags by which the parser knows a column of dates, and which of day and month comes first."""
    return _DATE | {None: 0, True: _DAY_FIRST, False: _MONTH_FIRST}[column.day_first]


def is_native(line: str) -> bool:
    """Return whether a line has titles with units, such as ``time [s],accel_x [g]``."""
    return all(_TITLE.fullmatch(title.strip().strip('"')) for title in line.lstrip("\ufeff").split(","))


def is_number(text: str) -> bool:
    """Return whether a text is one number, as Python reads it."""
    try:
        float(text)
    except ValueError:
        return False
    return True
