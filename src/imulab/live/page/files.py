"""The files of a session, and the recordings that the page shows, each read by its own process."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

from imulab.device.unit import is_blob
from imulab.display import has_hidden
from imulab.errors import ImulabError, OptionError, quoted
from imulab.files import confined, lies_in, load_toml
from imulab.live.page.curves import CurveView, Head, RangeStatistics, statistics, view
from imulab.live.page.server import inside
from imulab.records import is_json

# Files in the session's folder, and those named on the command line. The page reaches no others.


_LONGEST = 200  # bytes of a name; file systems take 255
_WINDOWS = sys.platform == "win32"
_NO_WINDOWS_NAME = re.compile(
    r"(?i)^(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³]|conin\$|conout\$) *(\.|$)|[<>\"|?*]|[. ]$"
)
_MOST_INSIDE = 500  # files of a folder that are listed
_SHOWN_INSIDE = (".csv", ".parquet", ".toml", ".json")
_PROCEDURE = re.compile(rb'"procedure":\s*"(\w+)"')
_KINDS = {".html": "report", ".htm": "report", ".zip": "other", ".pdf": "other", ".png": "other"}


@dataclass(frozen=True)
class FileEntry:
    """One file: its path as on the command line, its name, its kind, bytes, and when it was changed, s.

    The kind is ``recording``, ``record``, ``report``, ``layout``, ``rate`` or ``centrifuge`` (manifests of such tests),
    ``settings``, ``folder`` or ``other``; `in_folder` is whether it lies in the session's folder, and `folder` the name
    of the folder in it that holds it, empty where that is the session's; `procedure` is that of a record.
    """

    name: str
    short: str
    kind: str
    size: int
    modified: float
    in_folder: bool = False
    folder: str = ""
    procedure: str = ""


class FolderFiles:
    """The files of a session.

    Parameters
    ----------
    folder
        Folder of the session, for dropped files and outputs. Relative to the working folder, so that a shown command
        can be typed there.
    named
        Files that the command line named.
    later
        Such files that may not exist yet.

    Raises
    ------
    OptionError
        A file does not exist.
    """

    def __init__(self, folder: Path, named: Sequence[str] = (), later: Sequence[str] = ()) -> None:
        self.folder = folder
        self._kinds: dict[tuple[str, int, int], tuple[str, str]] = {}
        for name in named:
            if not _plain(name):
                raise OptionError(f"{quoted(name)}: expected a file name without control characters")
            if not Path(name).exists():
                raise OptionError(f"{name}: no such file")
        self._first = frozenset(named)
        self._given = [
            f"./{name}" if name.startswith("-") else name for name in dict.fromkeys([*named, *filter(_plain, later)])
        ]

    def make(self) -> None:
        """Make the folder if it does not exist.

        Raises
        ------
        OptionError
            The folder cannot be made.
        """
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OptionError(
                f"{self.folder}: cannot be made: {error.strerror}; start in a folder of your own"
            ) from None

    def entries(self) -> list[FileEntry]:
        """Return the present files: those of the command line first, then by name."""
        there = self.folder.iterdir() if self.folder.is_dir() else ()  # another program may have removed it
        inside = sorted(str(path) for path in there if _plain(path.name) and path.name[0] != ".")
        entries = [self._entry(name) for name in dict.fromkeys([*self._given, *inside])]
        entries += [inner for each in entries if each and each.kind == "folder" for inner in self._inside(each.name)]
        return [entry for entry in entries if entry is not None]

    def _inside(self, folder: str) -> list[FileEntry]:
        """Return the recordings, records and manifests in a folder that a command has written, or that was named."""
        try:
            names = sorted(path.name for path in Path(folder).iterdir() if path.suffix.lower() in _SHOWN_INSIDE)
        except OSError:
            return []
        plain = [name for name in names if _plain(name) and name[0] != "."][:_MOST_INSIDE]
        paths = (str(Path(folder, name)) for name in plain)
        entries = (self._entry(path, folder) for path in paths if self._holds(path))
        return [each for each in entries if each and (each.kind != "recording" or not each.name.endswith(".json"))]

    def _holds(self, name: str) -> bool:
        """Return whether a path leads to what is in the session's folder, or in a folder of the command line."""
        return lies_in(name, self.readable)

    def path(self, name: str) -> str:
        """Return the path of a file of the session, relative to the working folder.

        Raises
        ------
        OptionError
            The session has no such file.
        """
        if name in self._given:
            return name
        parts = Path(name).parts
        hidden = not _plain(name) or str(Path(name)) != name or any(part.startswith(".") for part in parts)
        parents = {str(self.folder), *self._given}
        below = not Path(name).is_absolute() and parents.intersection(str(each) for each in Path(name).parents)
        if hidden or not below or not self._holds(name) or not Path(name).exists():
            raise OptionError(f"{quoted(name)}: not among the files of this session")
        return name

    def is_given(self, name: str) -> bool:
        """Return whether the command line named a file that already existed."""
        return name.removeprefix("./") in self._first or name in self._first

    def owns(self, name: str) -> bool:
        """Return whether a file lies in the session's folder, and was not named on the command line."""
        return name not in self._given and Path(name).parent == self.folder

    @property
    def readable(self) -> list[str]:
        """The session's folder, and what the command line named."""
        return [str(self.folder), *self._given]

    def within(self, words: Sequence[str]) -> list[str] | None:
        """Return what the command of these words may read: the session's folder, and what the command line named.

        None, all files, where it has a manifest of the command line, which names files where they are.
        """
        manifests = [word for before, word in pairwise(words) if word.endswith(".toml") and before[:1] != "-"]
        if manifests and all(word in self._given for word in manifests):
            return None
        return self.readable

    def new(self, name: str, taken: Collection[str] = ()) -> str:
        """Return the path of a new file in the session's folder.

        Raises
        ------
        OptionError
            The name leads elsewhere, or the file exists, or is in `taken`.
        """
        self.make()
        path = checked(self.folder, name)
        if str(path) in taken:
            raise OptionError(f"{name}: is being written; expected another name")
        if os.path.lexists(path):
            raise OptionError(f"{name}: is there already; expected another name")
        return str(path)

    def unused(self, name: str, taken: Collection[str] = ()) -> str:
        """Return the path of a new file, numbered if the name exists or is in `taken`."""
        self.make()
        stem, dot, rest = name.partition(".")
        path, number = checked(self.folder, name), 1
        while os.path.lexists(path) or str(path) in taken:
            number += 1
            path = checked(self.folder, f"{stem}-{number}{dot}{rest}")
        return str(path)

    def _entry(self, name: str, folder: str = "") -> FileEntry | None:
        path = Path(name)
        try:
            status = path.stat()
        except OSError:  # the file was removed meanwhile
            return None
        key = name, status.st_mtime_ns, status.st_size
        if key not in self._kinds:
            kind = _kind(path)
            self._kinds[key] = kind, _procedure(path) if kind == "record" else ""
        kind, procedure = self._kinds[key]
        return FileEntry(name, path.name, kind, status.st_size, status.st_mtime, self.owns(name), folder, procedure)

    def end(self) -> bool:
        """Remove the folder if it is empty; return whether it still exists."""
        with suppress(OSError):
            self.folder.rmdir()
        return self.folder.exists()


def checked(folder: Path, name: str) -> Path:
    """Return the path of a new file directly in a folder; refuse names that a list cannot show unchanged.

    Raises
    ------
    OptionError
        The name leads elsewhere, is hidden, has control characters, is too long, or not allowed on this system.
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
    """Return whether a name can be shown and sent unchanged."""
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return not has_hidden(name)


def _kind(path: Path) -> str:
    if path.is_dir():
        return "recording" if any(path.glob("*.mcap")) or any(path.glob("*.db3")) else "folder"
    if path.suffix.lower() == ".toml":
        return _kind_of_toml(path)
    if known := _KINDS.get(path.suffix.lower()):
        return known
    try:
        return "record" if is_json(str(path)) or is_blob(str(path)) else "recording"
    except ImulabError:
        return "other"


def _procedure(path: Path) -> str:
    with suppress(OSError), path.open("rb") as stream:
        named = _PROCEDURE.search(stream.read(4096))
        return named[1].decode() if named else ""
    return ""


def _kind_of_toml(path: Path) -> str:
    try:
        table = load_toml(path, path.name, "settings")
    except ImulabError:
        return "settings"
    runs = table.get("run")
    if isinstance(runs, list) and runs:
        return "rate" if all(isinstance(run, dict) and "mounting" in run for run in runs) else "centrifuge"
    return "layout" if isinstance(table.get("columns"), dict) else "settings"


# Recordings that the page shows: each is read by its own process, and its curves can be viewed meanwhile.


_MOST = 6
"""Most recordings whose curves are kept; the one viewed longest ago makes room."""
_KNOWN = {each.name for each in fields(Head)}
_CURVES, _LOCK = "imulab-curves-", "lock"  # beginning of the folder's name, and a file in it


@dataclass
class Opening:
    """A file that is being read or was read.

    Attributes
    ----------
    number
        Number in this session, from 1.
    name, reading, stamp
        The file, the options of reading, and its size and time of change.
    folder
        Folder of its curves.
    about
        Its content so far: all that `contents` has yielded, merged.
    """

    number: int
    name: str
    reading: dict[str, str]
    stamp: tuple[int, int]
    folder: Path
    about: dict[str, Any] = field(default_factory=dict)
    process: subprocess.Popen[str] | None = None
    closed: bool = False

    @property
    def head(self) -> Head:
        """Description of the recording so far."""
        described = self.about.get("head", {})
        return Head(**{key: value for key, value in described.items() if key in _KNOWN})


def _new_place() -> tuple[Path, int | None]:
    """Return a new folder for curves, and its lock, which shows that it is used; remove those of killed programs."""
    place = Path(tempfile.mkdtemp(prefix=_CURVES))
    if sys.platform == "win32":
        return place, None
    import fcntl

    lock = os.open(place / _LOCK, os.O_WRONLY | os.O_CREAT, 0o600)  # held until the program ends, however it does
    fcntl.flock(lock, fcntl.LOCK_EX)
    for old in place.parent.glob(f"{_CURVES}*/{_LOCK}"):
        with suppress(OSError), old.open("rb") as held:  # another user's, or locked
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(old.parent, ignore_errors=True)
    return place, lock


class Openings:
    """The files that the page has opened; `tell` is called with new content, from other threads."""

    def __init__(self, tell: Callable[[Opening], object]) -> None:
        self._tell = tell
        self._open: dict[str, Opening] = {}  # by file and options, the latest viewed last
        self.place, self._lock = _new_place()
        """Folder of what is temporary; that of a killed program goes at the next start."""
        self._number = 0
        self.previews: list[str] = []
        """Layouts of this session that are not saved."""

    def open(self, name: str, reading: Mapping[str, str], within: Sequence[str]) -> Opening:
        """Return a file that is being read; reading starts if it has not, or if the file has changed.

        `within` names the folders and files that reading it may open.

        Raises
        ------
        OptionError
            The file does not exist.
        """
        try:
            status = os.stat(name)  # noqa: PTH116 -- a name, and its stamp
        except OSError as error:
            raise OptionError(f"{name}: cannot be read: {error.strerror}") from None
        stamp, chosen = (status.st_size, status.st_mtime_ns), {key: text for key, text in reading.items() if text}
        key = json.dumps([name, chosen], sort_keys=True)
        known = self._open.pop(key, None)
        if known is not None and known.stamp == stamp:
            self._open[key] = known
            return known
        if known is not None:
            _close(known)
        while len(self._open) >= _MOST:
            _close(self._open.pop(next(iter(self._open))))
        self._number += 1
        folder = self.place / str(self._number)
        folder.mkdir()
        opening = self._open[key] = Opening(self._number, name, chosen, stamp, folder)
        opening.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "imulab.live.page.contents", name, str(folder), json.dumps(chosen)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, encoding="utf-8",
            env=confined([*within, *self.previews]),
        )  # fmt: skip
        threading.Thread(target=self._listen, args=(opening,), daemon=True).start()
        return opening

    def known(self, number: int) -> Opening:
        """Return an open file by the number of its opening.

        Raises
        ------
        OptionError
            It is not open, or no longer.
        """
        for opening in self._open.values():
            if opening.number == number:
                return opening
        raise OptionError("this recording is not open any more: choose it again")

    def new_layout(self, toml: str) -> str:
        """Return the path of a new layout that only this session knows, for a preview."""
        self._number += 1
        path = self.place / f"layout-{self._number}.toml"
        path.write_text(toml, encoding="utf-8")
        self.previews.append(str(path))
        return str(path)

    def statistics(self, opening: Opening, start: float | None, stop: float | None) -> RangeStatistics:
        """Return the numbers of a range."""
        return statistics(opening.folder, opening.head, start, stop)

    def view(self, opening: Opening, start: float | None, stop: float | None, width: int) -> CurveView:
        """Return the curves of a range; errors as for `view` of `curves`."""
        return view(opening.folder, opening.head, start, stop, width)

    def end(self) -> None:
        """Close all files, and remove their curves."""
        for opening in list(self._open.values()):
            _close(opening)
        shutil.rmtree(self.place, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _listen(self, opening: Opening) -> None:
        process = opening.process
        assert process is not None
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                opening.about = {**opening.about, **json.loads(line)}
                if not opening.closed:
                    self._tell(opening)
        if process.wait() and "error" not in opening.about and not opening.closed:
            opening.about = {**opening.about, "error": f"{opening.name}: reading it has failed"}
            self._tell(opening)


def _close(opening: Opening) -> None:
    opening.closed = True
    if opening.process is not None:
        with suppress(OSError):
            opening.process.kill()
        opening.process.wait()
    shutil.rmtree(opening.folder, ignore_errors=True)
