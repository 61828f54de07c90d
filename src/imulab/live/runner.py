"""A session with its source and its recording: what a terminal and a page run alike."""

from __future__ import annotations

import errno
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from io import BytesIO
from pathlib import Path

import numpy as np

from imulab.errors import DataError, OptionError, ReadError
from imulab.files import replacing
from imulab.gravity import Gravity
from imulab.live.formats import LineStream, UnknownFormatError
from imulab.live.session import Event, Session
from imulab.live.sources import LiveSource
from imulab.live.view import FurtherFits, Trouble, further_triads
from imulab.readers import read_blocks
from imulab.readers.layout import layout_of
from imulab.recording import Array, Layout, Recording
from imulab.units import from_si
from imulab.writers import decimal_rows, write_csv_to

# The recording: native CSV that grows, is written out every second, and can be continued.


EVERY = 1.0
"""s between two writes to the file: what a sudden end may lose."""
_PAUSE = 1.0  # s between two parts of a continued recording
_END = 1 << 12  # bytes at the end of a recording in which its last line is searched for


class Recorder:
    """The file of the samples.

    Parameters
    ----------
    path
        Its name, ending in .csv.
    resume
        Whether to continue it if it exists.

    Raises
    ------
    OptionError
        The file exists and is not to be continued, or cannot be written.
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
        """Yield what the file already holds, in blocks.

        Raises
        ------
        ReadError, UnitError
            The file is no recording.
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
        """Append samples with the times of `placed`, written out once a second of the time `now`, s.

        Raises
        ------
        OptionError
            The disk is full.
        """
        if self._units is None:
            self._units = block.units
            out = BytesIO()
            head = dict(block.metadata)
            if "format" in head:  # it arrives now, which a replay or a simulation does not
                head = {"date": datetime.now().astimezone().isoformat(timespec="seconds"), **head}
            write_csv_to(replace(block, columns={name: np.empty(0) for name in block.columns}, metadata=head), out)
            self._waiting.append(out.getvalue())
        self._waiting.append(bytes(decimal_rows(np.column_stack(list(block.columns.values())))))
        self.rows += len(block)
        self.last = float(block.si("time")[-1])
        self._written = now if self._written is None else self._written
        if now - self._written >= EVERY:
            self.flush(now)

    def flush(self, now: float | None = None) -> None:
        """Write out all waiting lines; a full disk leaves whole lines.

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
        """Write out lines that have waited for a second because the stream stopped."""
        if self._waiting and self._written is not None and now - self._written >= EVERY:
            self.flush(now)

    def cut(self, start: float, stop: float) -> None:
        """Remove the samples of an attitude from the file, through a new file that replaces it."""
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
        """Write out all lines and close the file; a file without samples is deleted."""
        self.flush()
        self._file.close()
        if not self._good:
            Path(self.path).unlink(missing_ok=True)

    def placed(self, block: Recording) -> Recording:
        """Return a block with times that follow what the file already holds.

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
            # A device that stayed on continues with its own time; another device follows a gap wider than a window.
            ahead = float(block.si("time")[0]) - self.last
            self._shift = 0.0 if ahead > _PAUSE else _PAUSE - ahead
        if not self._shift:
            return block
        return block.with_columns({"time": block.column("time") + from_si(self._shift, block.units["time"])}, {})

    def _cut_last_line(self) -> None:
        """Remove a partial line that a sudden end may have left."""
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


# The session with its source and its recording, a step at a time.


_SILENT = 3.0  # s without samples after which a message is given
_GIVEN_UP = 30.0  # s without samples after which a session ends with what it has
_BEFORE, _BEHIND = 1.0, 0.6
"""s that are cut out around a dropped attitude: the settling before it, and the moment of lifting after it."""


class Runner:
    """Passes samples from the source to the session and the recording.

    Attributes
    ----------
    asked
        The refusal of an unknown stream whose layout was guessed, while `take_guess` may answer it.
    """

    def __init__(
        self,
        source: LiveSource,
        session: Session,
        recorder: Recorder,
        layout: Layout | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        self.source, self.session, self.recorder = source, session, recorder
        self._stream = LineStream(source.name, layout, polled=source.polled, units=units)
        self._last_arrival = source.now()
        self._given_up = False
        self._reopened = False  # and no sample has come since
        self.asked: UnknownFormatError | None = None
        self._further: FurtherFits | None = None
        self._fit_due = False
        session.source = source.name
        for block in recorder.before():
            session.feed(block)
        self._begin = recorder.last

    @classmethod
    def open(
        cls,
        source: Callable[[], LiveSource],
        session: Session,
        save: str,
        layout: Layout | None,
        *,
        resume: bool,
        units: Mapping[str, str] | None = None,
    ) -> Runner:
        """Return a runner with open recording and source; if the source fails, no empty recording is left."""
        recorder = Recorder(save, resume=resume)
        try:
            opened = source()
            try:
                return cls(opened, session, recorder, layout, units)
            except BaseException:
                opened.close()
                raise
        except BaseException:
            recorder.close()
            raise

    @property
    def ended(self) -> bool:
        """Whether nothing more will come, or nothing has come for too long."""
        return self.source.ended or self._given_up

    def refuse_hopeless(self) -> None:
        """End a session with a simulated unit that nobody turns by hand, where no record is to be expected.

        Raises
        ------
        DataError
            None is, and why; the recording so far is kept.
        """
        if self.source.by_hand and (why := self.session.hopeless(self._begin)):
            raise DataError(f"{self.source.name}: {why}. {self.kept()}")

    def step(self, wait: float) -> list[Event]:
        """Take the samples that come within `wait` seconds, and return what happened.

        Raises
        ------
        ReadError
            The stream cannot be read any more, or is none of the known, or its columns have changed; the recording so
            far is kept.
        OptionError
            The recording cannot be written any more.
        DataError
            The stream is not one of an accelerometer triad.
        """
        arrived, now = self.source.get(wait), self.source.now()
        if self.asked is not None:
            if self.source.ended:
                raise self.asked
            return []
        self._stream.counts.unread_share = self.source.unread_share
        events = self._check_link(any(len(piece.data) for piece in arrived), now)
        for piece in arrived:
            self._reopened = not len(piece.data) and self.session.begun
            if not len(piece.data):  # the link is open again
                self._stream.cut()
                continue
            events += self._take(self._fed(piece.data, piece.time), piece.time)
            self._answer()
        if not arrived:
            events += self._take(self._fed(b"", now), now)
            self._answer()
            self.recorder.tick(now)
        if self.source.ended:
            events += self._take(self._stream.finish(), now)
        if self._stream.over:
            raise ReadError(f"{self._stream.over}. {self.kept()}")
        if self.source.lost and not self.source.comes_back:
            raise ReadError(f"{self.source.lost} {self.kept()}")
        events += self._further_triads(events)
        if self.session.state == "accepted" and not self.session.enough and self.session.next is not None:
            self.source.turn_to(self.session.next)
        return events

    def step_or_ask(self, wait: float) -> list[Event]:
        """Do as `step`; of an unknown stream whose layout was guessed, wait for `take_guess`, and errors at its end."""
        try:
            return self.step(wait)
        except UnknownFormatError as error:
            if error.guess is None or self.source.ended:
                raise
            self.asked = error
            advice = "unknown format: look at the guess, and take it"
            self.session.trouble = Trouble("unknown", advice, "The session begins as soon as it is taken.")
            return [Event("unknown", str(error).partition("; --layout")[0], self.recorder.last)]

    def take_guess(self) -> list[Event]:
        """Read an unknown stream by the layout that was guessed, from its beginning on; return what happened."""
        if self.asked is None or self.asked.guess is None:
            return []
        layout = layout_of(tomllib.loads(self.asked.guess.toml), "the guess")
        self.asked = self.session.trouble = None
        self._last_arrival = self.source.now()
        return self._take(self._stream.begin_with(layout), self._last_arrival)

    def kept(self) -> str:
        """Return a sentence on what the recording keeps of a session that ends before its record."""
        count = len(self.session.guide.kept)
        if not self.recorder.rows:
            return "no sample came, so nothing is kept"
        return f"{self.recorder.path} keeps {count} attitude{'s' * (count != 1)}: --resume goes on with it"

    def drop(self, number: int | None = None) -> list[Event]:
        """Drop an attitude, as `Session.drop` does, from the session and from the recording."""
        times = self.session.drop(number)
        if times is not None:
            self.recorder.cut(times[0] - _BEFORE, times[1] + _BEHIND)
        return self.session.events

    def state_gravity(self, gravity: Gravity) -> list[Event]:
        """Take local gravity, for the session and for the fits of further triads; return what happened."""
        self.session.state_gravity(gravity)
        if self._further is not None:
            self._further.close()
            self._further, self._fit_due = None, True
        return self.session.events

    def turn(self, direction: Array) -> None:
        """Turn a simulated unit until this direction of the body is up; real units are turned by hand.

        Raises
        ------
        OptionError
            The unit is not simulated.
        """
        if not self.source.by_hand:
            raise OptionError(f"{self.source.name}: expected a simulated unit (simulate) to be turned from here")
        self.source.turn_by_hand(direction)

    def listen(self, wait: float) -> list[Recording]:
        """Return the samples that come within `wait` seconds, without session and recording."""
        blocks: list[Recording] = []
        for piece in self.source.get(wait):
            blocks += self._fed(piece.data, piece.time)
            self._answer()
        return [block for block in blocks if len(block)]

    def close(self) -> None:
        """End the source, and write out the recording."""
        if self._further is not None:
            self._further.close()
        self.source.close()
        self.recorder.close()

    def _fed(self, data: bytes | Recording, time: float) -> list[Recording]:
        return [data] if isinstance(data, Recording) else self._stream.feed(data, time)

    def _take(self, blocks: list[Recording], now: float) -> list[Event]:
        events: list[Event] = []
        for block in blocks:
            lies = self.session.dropping
            placed = self.recorder.placed(block)
            if self._further is None and further_triads(block.columns):
                self._further = FurtherFits(self.recorder.path, self.session.order, self.session.gravity)
            events += self.session.feed(placed, self._stream.counts)
            if not lies:  # after an attitude is dropped nothing is recorded until the unit leaves it
                self.recorder.write(placed, now)
        return events

    def _further_triads(self, events: list[Event]) -> list[Event]:
        """Fit gyroscopes and magnetometers after an attitude, once there is a fit of the accelerometers."""
        if self._further is None:
            return []
        self._fit_due |= self.session.guide.fit is not None and any(event.kind == "accepted" for event in events)
        if self._fit_due and self._further.ready:
            self._fit_due = False
            self.recorder.flush()
            self._further.begin()
        result = self._further.take_result()
        return [] if result is None else self.session.know(*result)

    def _answer(self) -> None:
        if self._stream.to_send:
            self.source.send(self._stream.to_send)

    def _check_link(self, arrived: bool, now: float) -> list[Event]:
        """Return an event when samples stop coming, come again, or have not come for too long."""
        session, source, before = self.session, self.source, self.session.trouble
        if arrived:
            self._last_arrival, session.trouble = now, None
            if before is None:
                return []
            self._stream.cut()
            return [Event("again", "samples come again" if session.begun else "samples come", self.recorder.last)]
        waited = now - self._last_arrival
        if source.absent:
            session.trouble = Trouble("absent", source.absent, "The session begins with the first sample.")
            return [Event("absent", source.absent, self.recorder.last)] if before is None else []
        lost = source.lost or self._reopened
        if source.ended or not (lost or before or waited >= _SILENT):
            return []
        if before is not None and before.state == "absent":  # it has come
            self._last_arrival, session.trouble = now, None
            return []
        silence = f"nothing has come from {source.name} for"
        if session.begun and source.comes_back and waited >= _GIVEN_UP:
            self._given_up = True
            text = f"{silence} {_GIVEN_UP:.0f} s: the session ends with what there is"
            return [Event("gone", text, self.recorder.last)]
        why = source.lost or f"Nothing has come from {source.name} for {waited:.0f} s."
        outlook = f"{why} {self.kept()}." if session.begun else f"{why} The session begins with the first sample."
        if session.begun and source.comes_back:
            outlook += f" In {max(_GIVEN_UP - waited, 0):.0f} s the record is made of what there is."
        if lost or (before is not None and before.state == "lost"):  # until samples come again
            at = f" at {len(session.guide.kept)} of {session.wanted}" if session.wanted else ""
            session.trouble = Trouble("lost", f"link lost{at}; reconnecting", outlook)
            text = f"{session.trouble.advice}: {why}"
        else:
            session.trouble = Trouble("silent", "no samples come: is the unit on, and does it send?", outlook)
            text = f"{silence} {_SILENT:.0f} s: is the unit on, and does it send?"
        changed = before is None or before.state != session.trouble.state
        return [Event(session.trouble.state, text, self.recorder.last)] if changed else []
