"""Files: written whole or not at all, and TOML read entry by entry, with the place of an entry in each refusal."""

from __future__ import annotations

import math
import os
import re
import stat
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BufferedReader
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

from imulab.errors import OptionError, ReadError, UnitError, file_name, folder_in_place, listed, quoted
from imulab.quantities import LARGEST
from imulab.units import Unit, parse_scale_factor, parse_unit

# Writing files whole or not at all.


_UMASK = threading.Lock()


def real_path(path: str | Path) -> Path:
    """Return the absolute path of the file that a name leads to, through links.

    Raises
    ------
    OptionError
        The links go round in a circle.
    """
    target = Path(os.path.realpath(file_name(path)))
    if target.is_symlink():
        raise OptionError(f"{path}: cannot be written: too many levels of symbolic links")
    return target


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Yield a new file beside `path` that replaces it if the block ends without error, and is deleted otherwise.

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
        except BrokenPipeError:  # its reader has ended, which is no failure
            raise
        except OSError as error:
            raise OptionError(f"{path}: cannot be written: {error.strerror}") from None
        return
    part = target.with_name(f".imulab.{os.urandom(8).hex()}.part")  # known before it is there: no signal leaves it
    try:
        with open(part, "xb", opener=_open_for_me) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        part.chmod(_mode(target))
        part.replace(target)
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):
            raise OptionError(f"{path}: cannot be written: {error.strerror}") from None
        raise


def _open_for_me(name: str, flags: int) -> int:
    return os.open(name, flags, 0o600)


def _mode(target: Path) -> int:
    """Return the permissions of the file that is replaced, which may be closed to others, or those of a new one."""
    try:
        return stat.S_IMODE(target.stat().st_mode) & 0o777
    except FileNotFoundError:
        return 0o666 & ~_umask()


def check_no_paper(path: str | Path) -> None:
    """Refuse the name of a file that promises a picture or a printed page.

    Raises
    ------
    OptionError
        It is.
    """
    if Path(path).suffix.lower() in (".pdf", ".png", ".svg", ".docx"):
        raise OptionError(f"{path}: no such file is written; reports are HTML (.html), which any browser prints")


def check_page(path: str | Path) -> None:
    """Refuse the name of a file that promises something else than an HTML page; errors as for `check_no_paper`."""
    check_no_paper(path)
    if Path(path).suffix.lower() not in (".html", ".htm", "") and not Path(path).is_dir():
        raise OptionError(f"{path}: a report is HTML; expected a name that ends in .html")


def write_page(path: str | Path, page: str) -> None:
    """Write an HTML page; errors as for `write_text` and `check_page`."""
    check_page(path)
    write_text(path, page)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file whole or not at all, UTF-8."""
    with replacing(path) as stream:
        stream.write(text.encode("utf-8"))


def _umask() -> int:
    with _UMASK:  # it can only be read by setting it: one thread at a time, and never wider meanwhile
        mask = os.umask(0o077)
        os.umask(mask)
    return mask


# Reading files, within the folders to which a command of a page is confined.


WITHIN = "IMULAB_WITHIN"
"""Variable of the environment: JSON list of folders and files that a process may read by names in its input."""
_PACKAGE = os.path.dirname(os.path.realpath(__file__))  # noqa: PTH120 -- layouts that come with imulab
_permitted: list[str] = []


def permit(path: Path) -> None:
    """Permit a file to be read that this process has made, or that the project file is or names."""
    _permitted.append(os.path.realpath(path))


def lies_in(path: str | PathLike[str], roots: Iterable[str]) -> bool:
    """Return whether a path leads, through whatever links, to one of these files or into one of these folders."""
    real = os.path.realpath(path)
    every = (os.path.realpath(root) for root in roots)
    return any(real == root or real.startswith(os.path.join(root, "")) for root in every)  # noqa: PTH118


def confined(roots: Iterable[str]) -> dict[str, str]:
    """Return the environment of a process that may read, by names in its input, only these files and folders."""
    import json

    return {**os.environ, WITHIN: json.dumps([os.path.realpath(root) for root in roots])}


def check_within(path: str | PathLike[str], roots: Sequence[str] | None = None) -> str:
    """Return the real path of a file; refuse one elsewhere than where this process may read, if it is confined.

    `roots`, folders and files, confine it whatever the process may read.

    Raises
    ------
    OptionError
        It lies elsewhere, perhaps through a link.
    """
    real = os.path.realpath(path)
    if roots is None and WITHIN in os.environ:
        import json

        roots = (*json.loads(os.environ[WITHIN]), _PACKAGE, *_permitted)
    if roots is not None and not lies_in(real, roots):
        raise OptionError(f"{path}: lies elsewhere; expected a file in the session's folder")
    return real


def open_file(path: str | PathLike[str], roots: Sequence[str] | None = None) -> BufferedReader:
    """Return a file opened for reading. It is what its real path names, so that no link can change between the two.

    `roots` are those of `check_within`.

    Raises
    ------
    OSError
        It cannot be opened.
    OptionError
        As for `check_within`.
    """
    if roots is None and WITHIN not in os.environ:
        return Path(path).open("rb")
    stream = Path(check_within(path, roots)).open("rb")  # noqa: SIM115
    try:
        if os.path.samestat(os.fstat(stream.fileno()), os.lstat(check_within(path, roots))):
            return stream
        raise OptionError(f"{path}: was replaced while it was opened")
    except BaseException:
        stream.close()
        raise


def within(path: Path) -> Path | BufferedReader:
    """Return a path for a library that opens files itself, or the open file where this process is confined."""
    return open_file(path) if WITHIN in os.environ else path


# TOML files: layouts, manifests of tests, limits, the project file.


_LARGEST = 1_000_000  # bytes of a file of settings
_MOST_DOTS = 50  # the time that a key takes grows with the square of its dots
_NUMBER = re.compile(r"(?<![\w.])\d++\.\d++(?:[eE][-+]?\d++)?(?![\w.])")
_DOT = re.compile(r"(?<!\.)\.(?!\.)")
_WIDEST = 1 << 63  # TOML's integers have 64 bits


def load_toml(path: str | Path, name: str, what: str) -> dict[str, Any]:
    """Return the table of a TOML file; `name` and `what` are its name and kind in messages.

    Raises
    ------
    ReadError
        There is no such file, it is no regular file or too large, it cannot be read, or it is not TOML.
    """
    import tomllib  # takes 3 ms to load, and most commands meet no such file

    text = _text(Path(path), name, what)
    lines = text.split("\n")  # which end nowhere else in TOML
    for number, line in enumerate(lines, start=1):
        if line.count(".") > _MOST_DOTS and len(_DOT.findall(_NUMBER.sub("", line))) > _MOST_DOTS:
            raise ReadError(
                f"{name}: line {number}: more than {_MOST_DOTS} dots in a line of the {what} file; expected keys of a "
                "few words"
            )
    wide = ReadError(f"{name}: the {what} file holds a whole number of more than 64 bits, which TOML does not have")
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        at = re.search(r"line (\d+)", str(error))
        shown = f": {quoted(lines[int(at[1]) - 1].strip())}" if at else ""
        raise ReadError(f"{name}: the {what} file is not TOML: {error}{shown}") from None
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
        check_within(path)
        mode = path.stat().st_mode  # before it is opened: opening a pipe waits for a writer
        if stat.S_ISDIR(mode):
            inside = [each.name for each in path.glob("*.toml")]
            raise ReadError(folder_in_place(name, f"a {what} file", inside))
        if not stat.S_ISREG(mode):
            raise ReadError(f"{name}: expected a {what} file, found a device or a pipe")
        with open_file(path) as stream:
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


# Entries of TOML files: keys, numbers, units and scale factors.


@dataclass(frozen=True, slots=True)
class ScaleFactor:
    """Output per measured quantity: value, and the units of both."""

    value: float
    output: Unit
    measured: Unit


def scale_factor_of(entry: Any, place: str, example: str) -> ScaleFactor:
    """Return a scale factor ``{ value = 0.02, unit = "V/(deg/s)" }``; `example` is the line as it should be."""
    value, unit = value_and_unit(entry, place, example)
    if value == 0:
        raise ReadError(f"{place}: expected a value other than 0")
    try:
        output, measured = parse_scale_factor(unit)
    except UnitError as error:
        raise UnitError(f"{place}: {error}") from None
    return ScaleFactor(value, output, measured)


def value_and_unit(entry: Any, place: str, example: str) -> tuple[float, str]:
    """Return value and unit of ``{ value = 2.5, unit = "V" }``; `example` is the line as it should be."""
    if not isinstance(entry, dict) or set(entry) != {"value", "unit"}:
        raise ReadError(f"{place}: expected {example}, found {quoted(entry)}")
    return number_of(entry["value"], place), str(entry["unit"])


def check_keys(table: Mapping[str, Any], keys: tuple[str, ...], place: str) -> None:
    """Refuse a key that is not among `keys`, because it may be misspelt."""
    for key in table:
        if key not in keys:
            raise ReadError(f"{place}: unknown key {quoted(key)}; known keys: {listed(keys, key)}")


def number_of(value: Any, place: str) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ReadError(f"{place}: expected a number, found {quoted(value)}")
    if abs(value) > LARGEST:
        raise ReadError(f"{place}: expected a number of at most {LARGEST:g}, found {quoted(value)}")
    return float(value)


def unit_of(text: Any, kind: str, place: str) -> str:
    """Return the symbol of a unit of one kind."""
    try:
        unit = parse_unit(str(text), (kind,))
    except UnitError as error:
        raise UnitError(f"{place}: {error}") from None
    if unit.quantity != kind:
        raise UnitError(f"{place}: expected a unit of {kind}, found {quoted(text)} ({unit.quantity})")
    return unit.symbol
