"""The recording of a session: native CSV that grows, is written out every second, and can be gone on with."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np

from imulab.atomic_write import replacing
from imulab.errors import OptionError
from imulab.readers import read_blocks
from imulab.recording import Recording
from imulab.units import from_si
from imulab.writers import write_csv_to
from imulab.writers.decimals import decimal_rows

EVERY = 1.0
"""Written to the file at least every so many seconds: what a sudden end may lose."""
_PAUSE = 1.0
_END = 1 << 12


class Recorder:
    """The file that the samples go to.

    Parameters
    ----------
    path
        Its name, which ends in .csv.
    resume
        Whether to go on with it where it is there.

    Raises
    ------
    OptionError
        The file is there and is not to be gone on with, or cannot be written.
    """

    def __init__(self, path: str, *, resume: bool) -> None:
        if Path(path).suffix.lower() != ".csv":
            raise OptionError(f"{path}: a live recording is CSV; expected a name that ends in .csv")
        self.path = path
        self.rows = 0
        self.last = 0.0
        self._units: Mapping[str, str] | None = None
        self._shift: float | None = None
        self._waiting: list[bytes] = []
        self._written: float | None = None
        self._good = 0
        try:
            there = Path(path).exists() and Path(path).stat().st_size > 0
            if there and not resume:
                raise OptionError(f"{path}: is there already; --resume goes on with it, or give another name")
            self._file = open(path, "r+b" if there else "wb", buffering=0)  # noqa: SIM115, PTH123
        except OSError as error:
            raise OptionError(f"{path}: cannot be written: {error.strerror}") from None
        self.resumed = there
        if there:
            self._cut_last_line()

    def before(self) -> Iterator[Recording]:
        """Yield what the file holds already, in blocks.

        Raises
        ------
        ReadError, UnitError
            It is no recording.
        """
        if not self.resumed or not self._good:
            return
        for block in read_blocks(self.path):
            if block.time is None:
                raise OptionError(f"{self.path}: has no time; expected a live recording to go on with")
            self._units, self.last = block.units, float(block.time[-1])
            self.rows += len(block)
            yield block

    def write(self, block: Recording, now: float) -> None:
        """Append samples with the times of `placed`, written out once a second by the time `now`, s.

        Raises
        ------
        OptionError
            The disk is full.
        """
        if self._units is None:
            self._units = block.units
            out = BytesIO()
            write_csv_to(replace(block, columns={name: np.empty(0) for name in block.columns}), out)
            self._waiting.append(out.getvalue())
        self._waiting.append(bytes(decimal_rows(np.column_stack(list(block.columns.values())))))
        self.rows += len(block)
        self.last = float(block.si("time")[-1])
        self._written = now if self._written is None else self._written
        if now - self._written >= EVERY:
            self.flush(now)

    def flush(self, now: float | None = None) -> None:
        """Write out what waits; a disk that is full leaves whole lines.

        Raises
        ------
        OptionError
            It cannot be written.
        """
        whole, done = b"".join(self._waiting), 0
        self._waiting, self._written = [], now
        try:
            while done < len(whole):
                done += self._file.write(memoryview(whole)[done:])
        except OSError as error:
            self._good += whole.rfind(b"\n", 0, done) + 1
            self._file.truncate(self._good)
            why = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else error.strerror
            raise OptionError(
                f"{self.path}: cannot be written on: {why}; what came before is kept, and --resume goes on with it"
            ) from None
        self._good += len(whole)

    def tick(self, now: float) -> None:
        """Write out what has waited for a second where the stream has stopped."""
        if self._waiting and self._written is not None and now - self._written >= EVERY:
            self.flush(now)

    def cut(self, start: float, stop: float) -> None:
        """Take the samples of an attitude out of the file; it is written anew beside itself and renamed."""
        self.flush(self._written)
        first = True
        with replacing(self.path) as out:
            for block in read_blocks(self.path):
                time = block.si("time")
                kept = (time < start) | (time > stop)
                part = replace(block, columns={name: column[kept] for name, column in block.columns.items()})
                text = BytesIO()
                write_csv_to(part, text)
                whole = text.getvalue()
                out.write(whole if first else b"".join(whole.splitlines(keepends=True)[_head_lines(whole) :]))
                first = False
        self._file.close()
        self._file = open(self.path, "r+b", buffering=0)  # noqa: SIM115, PTH123
        self._good = self._file.seek(0, os.SEEK_END)

    def close(self) -> None:
        """Write out what waits and close the file; one without a sample is taken away."""
        self.flush()
        self._file.close()
        if not self._good:
            Path(self.path).unlink(missing_ok=True)

    def placed(self, block: Recording) -> Recording:
        """Return a block behind what the file holds already.

        Raises
        ------
        OptionError
            The stream has other columns than the file.
        """
        if self._units is None or not self.resumed:
            return block
        if dict(block.units) != dict(self._units):
            raise OptionError(
                f"{self.path}: has the columns {_titles(self._units)}, the stream {_titles(block.units)}; expected the "
                "same unit and format to go on with a recording"
            )
        if self._shift is None:
            # A device that stayed on goes on in its own time; another one behind a gap that no window reaches across.
            ahead = float(block.si("time")[0]) - self.last
            self._shift = 0.0 if ahead > _PAUSE else _PAUSE - ahead
        if not self._shift:
            return block
        return block.with_columns({"time": block.column("time") + from_si(self._shift, block.units["time"])}, {})

    def _cut_last_line(self) -> None:
        """Take off the part of a line that a sudden end may have left."""
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(max(size - _END, 0))
        tail = self._file.read()
        self._good = size - (len(tail) - tail.rfind(b"\n") - 1)
        self._file.truncate(self._good)
        self._file.seek(self._good)


def _titles(units: Mapping[str, str]) -> str:
    return " ".join(f"{name} [{unit}]" for name, unit in units.items())


def _head_lines(text: bytes) -> int:
    return next(k for k, line in enumerate(text.split(b"\n"), start=1) if not line.startswith(b"#"))
