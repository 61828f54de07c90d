"""Files that the page looks into: each is read by a process of its own, whose curves can be viewed while it goes on."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from imulab.errors import OptionError
from imulab.live.page.curves import Head, View, view

_MOST = 6
"""Recordings whose curves are kept; the one that was looked at longest ago makes room."""
_KNOWN = {each.name for each in fields(Head)}


@dataclass
class Opening:
    """A file that is or was read.

    Attributes
    ----------
    number
        Of this session, from 1.
    name, reading, stamp
        The file, the options of reading, and its size and time of change.
    folder
        Of its curves.
    about
        What is known of it: all that `contents` has yielded, in one.
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
        """What there is to view so far."""
        told = self.about.get("head", {})
        return Head(**{key: value for key, value in told.items() if key in _KNOWN})


class Openings:
    """The files of a session that the page has looked into; `tell` is called with what is found, from other threads."""

    def __init__(self, tell: Callable[[Opening], object]) -> None:
        self._tell = tell
        self._open: dict[str, Opening] = {}  # by file and options, those looked at lately last
        self._place = Path(tempfile.mkdtemp(prefix="imulab-curves-"))
        self._number = 0

    def open(self, name: str, reading: Mapping[str, str]) -> Opening:
        """Return a file that is read, beginning where it was not or has changed since.

        Raises
        ------
        OptionError
            It is not there.
        """
        try:
            status = os.stat(name)  # noqa: PTH116 -- a name, and its stamp
        except OSError as error:
            raise OptionError(f"{name}: cannot be read: {error.strerror}") from None
        stamp, given = (status.st_size, status.st_mtime_ns), {key: text for key, text in reading.items() if text}
        key = json.dumps([name, given], sort_keys=True)
        known = self._open.pop(key, None)
        if known is not None and known.stamp == stamp:
            self._open[key] = known
            return known
        if known is not None:
            _close(known)
        while len(self._open) >= _MOST:
            _close(self._open.pop(next(iter(self._open))))
        self._number += 1
        folder = self._place / str(self._number)
        folder.mkdir()
        found = self._open[key] = Opening(self._number, name, given, stamp, folder)
        found.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "imulab.live.page.contents", name, str(folder), json.dumps(given)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, encoding="utf-8",
        )  # fmt: skip
        threading.Thread(target=self._listen, args=(found,), daemon=True).start()
        return found

    def known(self, number: int) -> Opening:
        """Return a file that is open, by the number of its opening.

        Raises
        ------
        OptionError
            It is not, or not any more.
        """
        for found in self._open.values():
            if found.number == number:
                return found
        raise OptionError("this recording is not open any more: choose it again")

    def view(self, opening: Opening, start: float | None, stop: float | None, width: int) -> View:
        """Return the curves of a range; errors as for `view` of `curves`."""
        return view(opening.folder, opening.head, start, stop, width)

    def end(self) -> None:
        """Close all files, and remove their curves."""
        for opening in self._open.values():
            _close(opening)
        shutil.rmtree(self._place, ignore_errors=True)

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
