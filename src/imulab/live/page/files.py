"""The files of a session: those in its folder, and those that the command line named. The page reaches no others."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from imulab.device.blob import is_blob
from imulab.errors import ImulabError, OptionError, quoted
from imulab.live.page.security import inside
from imulab.printable import has_hidden
from imulab.records.recognition import is_json
from imulab.toml import load_toml

_LONGEST = 200
_WINDOWS = sys.platform == "win32"
_NO_WINDOWS_NAME = re.compile(
    r"(?i)^(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³]|conin\$|conout\$) *(\.|$)|[<>\"|?*]|[. ]$"
)
_KINDS = {".html": "report", ".htm": "report", ".toml": "manifest", ".zip": "other", ".pdf": "other", ".png": "other"}


@dataclass(frozen=True)
class Entry:
    """One file: what the command line calls it, its own name, its kind, bytes, and when it was changed, s.

    The kind is ``recording``, ``record``, ``report``, ``manifest``, ``folder`` or ``other``; `own` is whether
    it lies in the session's folder.
    """

    name: str
    short: str
    kind: str
    size: int
    modified: float
    own: bool = False


class Files:
    """The files of a session.

    Parameters
    ----------
    folder
        Of the session: what is dropped or made goes there. Relative to the working folder, so that a command that is
        shown is one that can be typed there.
    given
        Files that the command line named.
    later
        Such files that may not be there yet.

    Raises
    ------
    OptionError
        A file is not there.
    """

    def __init__(self, folder: Path, given: Sequence[str] = (), later: Sequence[str] = ()) -> None:
        self.folder = folder
        self._kinds: dict[tuple[str, int, int], str] = {}
        for name in given:
            if not _plain(name):
                raise OptionError(f"{quoted(name)}: expected a file name without control characters")
            if not Path(name).exists():
                raise OptionError(f"{name}: no such file")
        self._first = frozenset(given)
        self._given = [
            f"./{name}" if name.startswith("-") else name for name in dict.fromkeys([*given, *filter(_plain, later)])
        ]

    def make(self) -> None:
        """Make the folder where it is not there.

        Raises
        ------
        OptionError
            It cannot be made.
        """
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OptionError(
                f"{self.folder}: cannot be made: {error.strerror}; start in a folder of your own"
            ) from None

    def entries(self) -> list[Entry]:
        """Return the files there are now, those of the command line first, then by name."""
        there = self.folder.iterdir() if self.folder.is_dir() else ()  # another program may have removed it
        own = sorted(str(path) for path in there if _plain(path.name) and path.name[0] != ".")
        found = (self._entry(name) for name in dict.fromkeys([*self._given, *own]))
        return [entry for entry in found if entry is not None]

    def path(self, name: str) -> str:
        """Return the path of a file of the session, relative to the working folder.

        Raises
        ------
        OptionError
            The session has no such file.
        """
        own = name.removeprefix(f"{self.folder}{os.sep}")
        if name not in self._given and (own == name or own.startswith(".") or not inside(self.folder, own).exists()):
            raise OptionError(f"{quoted(name)}: not among the files of this session")
        return name

    def is_given(self, name: str) -> bool:
        """Whether the command line named a file that was there already."""
        return name.removeprefix("./") in self._first or name in self._first

    def owns(self, name: str) -> bool:
        """Whether a file lies in the session's folder, and was not named by the command line."""
        return name not in self._given and Path(name).parent == self.folder

    def check_manifest(self, name: str) -> None:
        """Check that a manifest in the session's folder names no file elsewhere; one of the command line may.

        Raises
        ------
        OptionError
            It does; the message says which.
        """
        if not self.owns(name):
            return
        try:
            runs = load_toml(name, name, "manifest").get("run")
        except ImulabError:  # the command says so itself
            return
        for run in runs if isinstance(runs, list) else ():
            if isinstance(run, dict) and isinstance(file := run.get("file"), str):
                try:
                    inside(self.folder, file)
                except OptionError as error:
                    raise OptionError(f"{name}: {error}") from None

    def new(self, name: str, taken: Collection[str] = ()) -> str:
        """Return the path of a file to be made in the session's folder.

        Raises
        ------
        OptionError
            The name leads elsewhere, or the file is there already, or is in `taken`.
        """
        self.make()
        path = checked(self.folder, name)
        if str(path) in taken:
            raise OptionError(f"{name}: is being written; expected another name")
        if os.path.lexists(path):
            raise OptionError(f"{name}: is there already; expected another name")
        return str(path)

    def unused(self, name: str, taken: Collection[str] = ()) -> str:
        """Return the path of a file to be made, numbered where one of that name is there, or is in `taken`."""
        self.make()
        stem, dot, rest = name.partition(".")
        path, number = checked(self.folder, name), 1
        while os.path.lexists(path) or str(path) in taken:
            number += 1
            path = checked(self.folder, f"{stem}-{number}{dot}{rest}")
        return str(path)

    def _entry(self, name: str) -> Entry | None:
        path = Path(name)
        try:
            status = path.stat()
        except OSError:  # it has gone meanwhile
            return None
        key = name, status.st_mtime_ns, status.st_size
        if key not in self._kinds:
            self._kinds[key] = _kind(path)
        return Entry(name, path.name, self._kinds[key], status.st_size, status.st_mtime, self.owns(name))

    def end(self) -> bool:
        """Remove the folder where nothing is in it; return whether something is."""
        with suppress(OSError):
            self.folder.rmdir()
        return self.folder.exists()


def checked(folder: Path, name: str) -> Path:
    """Return the path of a file to be written right in a folder; refuse names that a list could not show as they are.

    Raises
    ------
    OptionError
        The name leads elsewhere, is hidden, holds control characters, is too long, or is none on this system.
    """
    path = inside(folder, name)
    if _WINDOWS and _NO_WINDOWS_NAME.search(name):
        raise OptionError(f"{quoted(name)}: expected the name of a file, found one that Windows does not take")
    if not _plain(name) or name.startswith(".") or len(name.encode("utf-8")) > _LONGEST:
        raise OptionError(
            f"{quoted(name)}: expected the name of a file of at most {_LONGEST} bytes, without control characters "
            "and without a dot in front"
        )
    return path


def _plain(name: str) -> bool:
    """Whether a name can be shown and sent as it is."""
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return not has_hidden(name)


def _kind(path: Path) -> str:
    if path.is_dir():
        return "folder"
    if known := _KINDS.get(path.suffix.lower()):
        return known
    try:
        return "record" if is_json(str(path)) or is_blob(str(path)) else "recording"
    except ImulabError:
        return "other"
