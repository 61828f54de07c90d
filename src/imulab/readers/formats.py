"""The kinds of file that can be read: recognition, needed libraries, and limits for unpacking.

How each is recognised, which library it needs, and how compressed parts and packed files are unpacked within bounds.

A file may unpack to 64 MiB, or to 200 times its size where that is more, but to no more than 8 GiB; measured data of
sensors compress by less than 20. `raise_limit` (``--unpack-limit``) allows more.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

from msgspec import Struct

from imulab.errors import ReadError, first_of, install
from imulab.files import open_file, permit

# Unpacking within limits: a few kilobytes can unpack to terabytes.


# Bytes that may always be unpacked; times the packed size; the most in any case
_SMALL, _RATIO, _LARGEST = 1 << 26, 200, 1 << 33
_raised: ContextVar[int | None] = ContextVar("unpack_limit", default=None)


def raise_limit(size: int | None) -> None:
    """Set how many bytes a file may unpack to, for this thread; None restores the usual limits."""
    _raised.set(size)


class Budget:
    """Bytes that a file may still unpack to; where its rows are not held together, only its size limits them."""

    def __init__(self, path: Path, name: str, *, most: float = _LARGEST) -> None:
        usual = max(_SMALL, min(most, _RATIO * path.stat().st_size))
        self._name, self._limit = name, _raised.get() or int(usual)
        self.left = self._limit

    def take(self, size: int) -> None:
        """Subtract bytes that are about to be unpacked.

        Raises
        ------
        ReadError
            They are more than the file may have.
        """
        self.check(size)
        self.left -= size

    def check(self, size: int) -> None:
        """Refuse bytes that are more than the file may have; error as for `take`."""
        if size > self.left:
            raise ReadError(
                f"{self._name}: unpacks to more than {self._limit / 1e6:.0f} MB, which no measured data of this size "
                "do; where the file is to be trusted, --unpack-limit SIZE raises the limit"
            )


def unpack(decoder: Callable[[], Any], data: bytes | memoryview, most: int) -> bytes:
    """Return the content of compressed data, or a byte more than `most` where they hold more.

    `decoder` makes a decompressor as the standard library has them (zlib, bz2, and lz4 and zstd likewise).

    Raises
    ------
    EOFError
        The data end before their end is reached.
    """
    parts: list[bytes] = []
    room = most + 1
    while len(data) and room > 0:
        state = decoder()
        parts.append(state.decompress(data, room))
        room -= len(parts[-1])
        if not state.eof:
            if room > 0:
                raise EOFError("the data are cut")
            break
        data = state.unused_data or b""  # None from lz4
    return b"".join(parts)


# Files that are packed as a whole: ``.gz``, and ``.zip`` of one file.


_GZIP, _ZIP = b"\x1f\x8b", b"PK\x03\x04"
_PIECE = 1 << 20  # bytes unpacked at once
_ENCRYPTED = 1  # flag of an entry of a zip file
_SPREADSHEET = "[Content_Types].xml"


_NO_FILE = b"PK\x05\x06"  # of a zip file without one
_PACKED = {
    _GZIP: "gzip",
    _ZIP: "zip",
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"7z\xbc\xaf": "7-Zip",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"Rar!": "RAR",
}


def is_packed(head: bytes) -> bool:
    """Return whether the first bytes are those of a gzip or zip file."""
    return head.startswith((_GZIP, _ZIP, _NO_FILE))


def packed_by(head: bytes) -> str:
    """Return the name of the program that packed a file, from its first bytes; empty where none did."""
    if head[257:262] == b"ustar":
        return "tar"
    return next((name for begin, name in _PACKED.items() if head.startswith(begin)), "")


@contextmanager
def unpacked(path: Path, name: str) -> Iterator[Path]:
    """Yield the path of what a packed file holds, which is in a temporary folder meanwhile.

    Raises
    ------
    ReadError
        It is cut or damaged, holds several files or none, or unpacks to more than it may.
    """
    import gzip  # only for such files
    import tempfile
    import zipfile
    import zlib

    with tempfile.TemporaryDirectory(prefix="imulab-") as folder:
        target = Path(folder) / "unpacked"
        try:
            with open_file(path) as stream, target.open("wb") as out, _content(stream, name) as content:
                budget = Budget(path, name)
                while data := content.read(_PIECE):
                    budget.take(len(data))
                    out.write(data)
        except (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile, NotImplementedError) as error:
            raise ReadError(f"{name}: truncated or damaged, cannot be unpacked: {error}") from None
        except OSError as error:
            raise ReadError(f"{name}: cannot be unpacked: {error.strerror or error}") from None
        permit(target)
        yield target


def _content(stream: IO[bytes], name: str) -> IO[bytes]:
    """Return the content of the one file in a packed one."""
    import gzip
    import zipfile

    if stream.read(2) == _GZIP:
        stream.seek(0)
        return gzip.GzipFile(fileobj=stream)  # type: ignore[return-value]
    archive = zipfile.ZipFile(stream)
    names = archive.namelist()
    if _SPREADSHEET in names:
        raise ReadError(f"{name}: a spreadsheet; expected text: save the sheet as CSV")
    files = [
        each
        for each in archive.infolist()
        if not (each.is_dir() or each.filename.startswith("__MACOSX/") or Path(each.filename).name.startswith("."))
    ]
    if len(files) != 1:
        found = first_of([each.filename for each in files], 5) or "none"
        raise ReadError(f"{name}: expected one file in it, found {found}; unpack it, and name one")
    if files[0].flag_bits & _ENCRYPTED:
        raise ReadError(f"{name}: {files[0].filename} is encrypted; unpack it first")
    return archive.open(files[0])


# Kinds of file: recognition and needed libraries.


_MARKUP = re.compile(rb"<[?!a-zA-Z]")
_JSON = re.compile(rb"(\xef\xbb\xbf)?\s*(\{|\[\s*[\[{\]])")  # a line of text may begin with [12.5]
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MAT = b"MATLAB 5.0 MAT-file"
_MAT73 = b"MATLAB 7.3 MAT-file"


class Format(Struct, frozen=True):
    """A kind of file.

    Attributes
    ----------
    name, endings
        What people call it, and how its file names usually end.
    module
        The module of `imulab.readers` that reads it.
    matches
        Whether the first 1024 bytes are of this kind.
    library, extra
        What it needs beyond imulab's own dependencies, and the extra that installs it.
    layout
        ``needed``, ``possible`` or ``none``: whether a layout file says where the columns are.
    writes
        Whether `convert` writes it.
    """

    name: str
    endings: str
    module: str
    matches: Callable[[bytes], bool]
    library: str = ""
    extra: str = ""
    layout: str = "none"
    writes: bool = False

    @property
    def available(self) -> bool:
        """Whether the library is installed."""
        return not self.library or find_spec(self.library) is not None


FORMATS = (
    Format("Parquet", ".parquet", "parquet", lambda h: h.startswith(b"PAR1"), "pyarrow", "tables", "possible", True),
    Format("MATLAB v7.3", ".mat", "hdf5", lambda h: h.startswith(_MAT73), "h5py", "hdf5", "needed"),
    Format("MATLAB v5 to v7", ".mat", "mat", lambda h: h.startswith(_MAT), layout="needed"),
    Format("HDF5", ".h5 .hdf5", "hdf5", lambda h: h.startswith(_HDF5) or h[512:520] == _HDF5, "h5py", "hdf5", "needed"),
    Format("ROS 1 bag", ".bag", "rosbag", lambda h: h.startswith(b"#ROSBAG V"), "lz4", "ros"),
    Format("ROS 2 MCAP", ".mcap, a folder", "rosbag", lambda h: h.startswith(b"\x89MCAP"), "lz4", "ros"),
    Format("ROS 2 sqlite", ".db3, a folder", "rosbag", lambda h: h.startswith(b"SQLite format 3\0")),
    Format("PX4 ULog", ".ulg", "ulog", lambda h: h.startswith(b"ULog")),
    Format("MIMU4444 log", ".bin", "mimu", lambda h: _is_mimu(h)),
    Format("ArduPilot DataFlash", ".bin", "dataflash", lambda h: h.startswith(b"\xa3\x95")),
    Format("JSON", ".json .jsonl", "jsonfile", lambda h: _JSON.match(h) is not None, layout="needed"),
)
TEXT = Format("text", ".csv, any", "text", lambda _: True, layout="possible", writes=True)


def _is_mimu(head: bytes) -> bool:
    if b"\xaa" not in head:
        return False
    from imulab.readers.mimu import is_mimu

    return is_mimu(head)


def recognised(head: bytes) -> Format:
    """Return the kind of a file from its first bytes; text where nothing else fits."""
    return next((kind for kind in FORMATS if kind.matches(head)), TEXT)


def page(head: bytes) -> str | None:
    """Return what a file is whose first bytes are those of a page, such as ``an XML file``; None for others."""
    text = head.removeprefix(BOM_UTF8).lstrip()
    if text.startswith(b"%PDF-"):
        return "a PDF"
    if text[:9].lower() == b"<!doctype" or text[:5].lower() == b"<html":
        return "a web page"
    return "an XML file" if _MARKUP.match(text) else None


def library(module: str, kind: str, extra: str, name: str) -> Any:
    """Return the imported library that a kind of file needs.

    Raises
    ------
    ReadError
        It is not here; the message says how to install it.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise ReadError(f"{name}: {kind} needs {package}, which is not here: {install(extra)}") from None


def table() -> tuple[list[str], list[list[str]]]:
    """Return titles and rows of the list of formats that can be read and written."""
    rows = []
    for kind in (TEXT, *FORMATS):
        needs = install(kind.extra) if kind.extra and not kind.available else ""
        optional = kind.extra and kind.available
        rows.append(
            [
                kind.name,
                kind.endings,
                "read, write" if kind.writes else "read",
                {"none": "", "possible": "for foreign columns", "needed": "--layout"}[kind.layout],
                (needs or (f"{kind.library} is here" if optional else "nothing"))
                + (" (where compressed)" if kind.extra == "ros" else ""),
            ]
        )
    return ["format", "files", "", "layout", "needs"], rows
