"""What a task is: how a procedure is run on the files of one unit."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from imulab.recording import Recording, Source
    from imulab.records.calibration import Calibration


class Files(Protocol):
    """Where a fit gets what its files hold; `name` is what the command line or the manifest calls a file."""

    def recording(self, name: str, layout: str | None, **part: Any) -> Recording:
        """Return a recording as a whole; options as for `imulab.read`."""

    def record(self, name: str) -> Calibration:
        """Return a calibration record."""

    def blocks(self, name: str, layout: str | None, **part: Any) -> Iterator[Recording]:
        """Return a recording in blocks; options as for `imulab.read_blocks`."""

    def path(self, name: str) -> Path:
        """Return where a file lies on this machine."""

    def beside(self, name: str, file: str) -> str:
        """Return the name of a file that file `name` names relative to itself."""


@dataclass(frozen=True)
class Task:
    """How a procedure is run on the files of one unit.

    Attributes
    ----------
    procedure
        Its name in records.
    files
        What the files are, for messages.
    count
        Fewest and most files; None for any number.
    options
        Names of the options of its fit.
    paths
        Those of them that name a file.
    modules
        What its fit loads: whoever has several processes fit loads them once, before.
    values
        Texts of options and how messages call an option (``"--{}"``) to checked values; raises OptionError.
    fit
        Names of the files, values, access to files and a progress callback to the record.
    """

    procedure: str
    files: str
    count: tuple[int, int | None]
    options: tuple[str, ...]
    paths: tuple[str, ...]
    modules: tuple[str, ...]
    values: Callable[[Mapping[str, str], str], dict[str, Any]]
    fit: Callable[[Sequence[str], Mapping[str, Any], Files, Callable[[int], None]], Calibration]


def source_of(access: Files, name: str, called: str | None = None) -> Source | None:
    """Return a file as a source of a record, under the name that the record calls it; None for what is no file."""
    from imulab.recording import Source

    path = access.path(name)
    if name == "-" or not path.is_file():
        return None
    with path.open("rb") as stream:
        return Source(called or name, hashlib.file_digest(stream, "sha256").hexdigest())
