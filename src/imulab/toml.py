"""TOML files: layouts, manifests of tests, limits, the project file."""

from __future__ import annotations

import os
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

from imulab.errors import ReadError

_LARGEST = 1_000_000
_MOST_DOTS = 50  # the time that a key takes grows with the square of its dots
_NUMBER = re.compile(r"(?<![\w.])\d++\.\d++(?:[eE][-+]?\d++)?(?![\w.])")
_DOT = re.compile(r"(?<!\.)\.(?!\.)")
_WIDEST = 1 << 63


def load_toml(path: str | Path, name: str, what: str) -> dict[str, Any]:
    """Return the table of a TOML file; messages call the file `name`, and `what` is the kind that it should be.

    Raises
    ------
    ReadError
        There is no such file, it is no regular file or too large, it cannot be read, or it is not TOML.
    """
    text = _text(Path(path), name, what)
    for number, line in enumerate(text.split("\n"), start=1):
        if line.count(".") > _MOST_DOTS and len(_DOT.findall(_NUMBER.sub("", line))) > _MOST_DOTS:
            raise ReadError(
                f"{name}: line {number}: more than {_MOST_DOTS} dots in a line of the {what} file; expected keys of a "
                "few words"
            )
    wide = ReadError(f"{name}: the {what} file holds a whole number of more than 64 bits, which TOML does not have")
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ReadError(f"{name}: the {what} file is not TOML: {error}") from None
    except ValueError:  # Python reads no whole numbers of thousands of digits
        raise wide from None
    except RecursionError:
        raise ReadError(f"{name}: the {what} file nests its tables or lists hundreds of levels deep") from None
    if _has_wide(table):
        raise wide
    return table


def _text(path: Path, name: str, what: str) -> str:
    """Return the text of a regular file of no more than the largest size."""
    try:
        mode = path.stat().st_mode  # before it is opened: opening a pipe waits for a writer
        if stat.S_ISDIR(mode):
            raise ReadError(f"{name}: expected a {what} file, found a folder")
        if not stat.S_ISREG(mode):
            raise ReadError(f"{name}: expected a {what} file, found a device or a pipe")
        with path.open("rb") as stream:
            data = stream.read(_LARGEST + 1)
    except FileNotFoundError:
        if os.path.lexists(path):
            raise ReadError(f"{name}: expected a {what} file, found a link to a file that is not there") from None
        raise ReadError(f"{name}: no such {what} file") from None
    except OSError as error:
        raise ReadError(f"{name}: expected a {what} file, which cannot be read: {error.strerror}") from None
    if len(data) > _LARGEST:
        raise ReadError(f"{name}: expected a {what} file of at most 1 MB")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ReadError(f"{name}: line {line}: expected a {what} file of UTF-8 text, as TOML is") from None


def _has_wide(value: Any) -> bool:
    """Return whether a whole number of more than 64 bits is among TOML's values."""
    if isinstance(value, dict):
        return any(map(_has_wide, value.values()))
    if isinstance(value, list):
        return any(map(_has_wide, value))
    return isinstance(value, int) and not -_WIDEST <= value < _WIDEST
