"""Writing files whole or not at all."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from imulab.errors import OptionError, file_name

_UMASK = threading.Lock()


def real_path(path: str | Path) -> Path:
    """Return the absolute path of the file that a name leads to, through links.

    Raises
    ------
    OptionError
        The links go round in a circle.
    """
    found = Path(os.path.realpath(file_name(path)))
    if found.is_symlink():
        raise OptionError(f"{path}: cannot be written: too many levels of symbolic links")
    return found


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Open a new file beside `path` that takes its place when the block ends well, and vanishes otherwise.

    Raises
    ------
    OptionError
        The file cannot be written there.
    """
    target = real_path(path)  # through a link to the file that it names
    if target.is_dir():
        raise OptionError(f"{path}: expected the name of a file to write, found a folder")
    if target.exists() and not target.is_file():  # a device or a pipe is written to, not replaced
        try:
            with target.open("wb") as stream:
                yield stream
        except BrokenPipeError:  # its reader has had enough, which is no failure
            raise
        except OSError as error:
            raise OptionError(f"{path}: cannot be written: {error.strerror}") from None
        return
    try:
        descriptor, name = tempfile.mkstemp(prefix=".imulab.", suffix=".part", dir=target.parent)
    except OSError as error:
        raise OptionError(f"{path}: cannot be written: {error.strerror}") from None
    part = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        part.chmod(0o666 & ~_umask())
        part.replace(target)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OptionError(f"{path}: cannot be written: {error.strerror}") from None
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def check_no_paper(path: str | Path) -> None:
    """Check that no file is asked for that promises a picture or a printed page.

    Raises
    ------
    OptionError
        It is.
    """
    if Path(path).suffix.lower() in (".pdf", ".png", ".svg", ".docx"):
        raise OptionError(f"{path}: no such file is written; reports are HTML (.html), which any browser prints")


def write_page(path: str | Path, page: str) -> None:
    """Write an HTML page; errors as for `write_text` and `check_no_paper`."""
    check_no_paper(path)
    write_text(path, page)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file whole or not at all, UTF-8."""
    with replacing(path) as stream:
        stream.write(text.encode("utf-8"))


def _umask() -> int:
    with _UMASK:  # there is no way to look without setting it: one thread at a time, and never wider meanwhile
        mask = os.umask(0o077)
        os.umask(mask)
    return mask
