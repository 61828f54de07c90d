"""Files packed as a whole, ``.gz`` and ``.zip`` of one file: their own room, since the bounds of unpacking are here."""

from __future__ import annotations

import gzip
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from imulab.errors import ReadError, first_of
from imulab.readers.formats import Budget

_GZIP, _ZIP = b"\x1f\x8b", b"PK\x03\x04"
_PIECE = 1 << 20  # bytes unpacked at once
_ENCRYPTED = 1  # flag of an entry of a zip file
_SPREADSHEET = "[Content_Types].xml"


def is_packed(head: bytes) -> bool:
    """Return whether the first bytes are those of a gzip or zip file."""
    return head.startswith((_GZIP, _ZIP))


@contextmanager
def unpacked(path: Path, name: str) -> Iterator[Path]:
    """Yield the path of what a packed file holds, which is in a temporary folder meanwhile.

    Raises
    ------
    ReadError
        It is cut or damaged, holds several files or none, or unpacks to more than it may.
    """
    with tempfile.TemporaryDirectory(prefix="imulab-") as folder:
        target = Path(folder) / "unpacked"
        try:
            with path.open("rb") as stream, target.open("wb") as out, _content(stream, name) as content:
                budget = Budget(path, name)
                while data := content.read(_PIECE):
                    budget.take(len(data))
                    out.write(data)
        except (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile, NotImplementedError) as error:
            raise ReadError(f"{name}: truncated or damaged, cannot be unpacked: {error}") from None
        except OSError as error:
            raise ReadError(f"{name}: cannot be unpacked: {error.strerror or error}") from None
        yield target


def _content(stream: IO[bytes], name: str) -> IO[bytes]:
    """Return the content of the one file in a packed one."""
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
