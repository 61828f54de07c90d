"""The bytes of a text file as lines: one by one for the head, whole blocks of them below."""

from __future__ import annotations

import hashlib
import os
import stat
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import BinaryIO

from imulab.errors import ReadError

_BLOCK_BYTES = 1 << 21
WORTH_SHARING = 1 << 19
_MOST_THREADS = 8
LONGEST_LINE = 1 << 20


class ParserThreads:
    """Threads to parse with, as many as there are processors; started when there is work for them.

    OMP_NUM_THREADS limits them as it does the linear algebra, so that workers beside each other do not compete.
    """

    def __init__(self) -> None:
        processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
        allowed = os.environ.get("OMP_NUM_THREADS", "")
        self.size = min(_MOST_THREADS, processors, int(allowed) if allowed.isdecimal() and int(allowed) else processors)
        self._pool: ThreadPoolExecutor | None = None

    def begin(self, job: Callable[[], tuple[int, int, int]]) -> Callable[[], tuple[int, int, int]]:
        """Give a thread its work; what comes back waits for the answer."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.size)
        return self._pool.submit(job).result

    def __enter__(self) -> ParserThreads:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


class Hash:
    """SHA-256 of what is read, taken in a thread of its own where there is much of it."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._pool: ThreadPoolExecutor | None = None

    def update(self, data: bytes) -> None:
        """Go on with these bytes."""
        if self._pool is None and len(data) < WORTH_SHARING:
            self._hash.update(data)
            return
        self._pool = self._pool or ThreadPoolExecutor(1)
        self._pool.submit(self._hash.update, data)

    def stop(self) -> None:
        """Wait until all bytes are in."""
        if self._pool is not None:
            self._pool.shutdown()

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
    """

    def __init__(self, stream: BinaryIO, name: str, *, hashed: bool, whole: bool) -> None:
        self.live = _is_pipe(stream)
        self._read = getattr(stream, "read1", stream.read) if self.live else stream.read
        self._name = name
        self._hash = Hash() if hashed else None
        self._rest = b""
        self._at = 0
        self._ended = self.unended = self.overlong = False
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
        if b"\0" in self._rest[:4096]:
            wide = " (UTF-16? expected UTF-8)" if self._rest.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else ""
            raise ReadError(f"{name}: expected text, found binary data{wide}")

    @property
    def waiting(self) -> int:
        """Bytes that were read and not yet taken."""
        return len(self._rest) - self._at

    def sha256(self) -> str:
        """Return the SHA-256 of the bytes read so far, hexadecimal."""
        if self._hash is None:
            return ""
        self._hash.stop()
        return self._hash.hexdigest()

    def drain(self) -> None:
        """Read on to the end, so that the hash is that of the whole file."""
        while not self._ended:
            self._next_bytes()

    def block(self, blanks: bytes) -> bytes | None:
        """Take whole lines of about a block's size, without lines of `blanks` at the end of the file; None at its end.

        A line that is too long ends the file, and `overlong` is set.
        """
        self._rest, self._at = self._rest[self._at :], 0
        while not self._ended:
            end = self._rest.rfind(b"\n") + 1
            if end:
                lines, self._rest = self._rest[:end], self._rest[end:]
                # Blank lines may be the end of the file: they wait for what follows.
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
        self.unended |= bool(self._rest) and not self._rest.endswith(b"\n")
        lines, self._rest = self._rest.rstrip(blanks), b""
        return lines or None

    def next_line(self) -> bytes:
        """Return the next line without taking it, or as much of it as a line may have; empty at the end."""
        end = self._rest.find(b"\n", self._at)
        while end < 0 and not self._ended and self.waiting <= LONGEST_LINE:
            self._rest, self._at = self._rest[self._at :], 0
            looked = len(self._rest)
            self._read_more()
            end = self._rest.find(b"\n", looked)
        return self._rest[self._at : end if end >= 0 else len(self._rest)]

    def first(self) -> bytes:
        """Return the first line that is neither blank nor a comment without taking it; empty where there is none."""
        while True:
            lines = self._rest[self._at :].split(b"\n")
            whole = lines if self._ended or self.waiting > LONGEST_LINE else lines[:-1]
            found = next((line for line in whole if line.strip() and not line.startswith(b"#")), b"")
            if found or whole is lines:
                return found
            self._read_more()

    def line(self, encoding: str = "utf-8", errors: str = "strict", hint: str = "") -> str | None:
        """Take one line of the head, None at the end of the file; comments may be of any encoding.

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
        """Return whether nothing but blanks follows; reads on until that is known."""
        while not self._rest[self._at :].strip() and not self._ended:
            self._read_more()
        return not self._rest[self._at :].strip()

    def _read_more(self) -> None:
        self._rest += self._next_bytes()

    def _next_bytes(self) -> bytes:
        try:
            data = self._read(_BLOCK_BYTES)
        except OSError as error:
            raise ReadError(f"{self._name}: cannot be read: {error.strerror}") from None
        self._ended = not data
        self.taken += len(data)
        if self._hash:
            self._hash.update(data)
        return data


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
