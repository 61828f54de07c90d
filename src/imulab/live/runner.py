"""A session with its source and its recording: what a terminal and a page run alike, a step at a time."""

from __future__ import annotations

from collections.abc import Callable

from imulab.errors import OptionError, ReadError
from imulab.live.formats import Stream
from imulab.live.further import FurtherFits, further_of
from imulab.live.recorder import Recorder
from imulab.live.session import Event, Session
from imulab.live.sources import Source
from imulab.reading import Layout
from imulab.recording import Array, Recording

_SILENT = 3.0
_BEFORE, _BEHIND = 1.0, 0.6
"""What is cut out with an attitude that is dropped, s: the settling before it, and the moment of taking it up."""


class Runner:
    """Brings samples from the source to the session and the recording."""

    def __init__(self, source: Source, session: Session, recorder: Recorder, layout: Layout | None = None) -> None:
        self.source, self.session, self.recorder = source, session, recorder
        self._stream = Stream(source.name, layout, polled=source.polled)
        self._last_arrival = source.now()
        self._silent = False
        self._further: FurtherFits | None = None
        self._fit_due = False
        session.source = source.name
        for block in recorder.before():
            session.feed(block)

    @classmethod
    def open(
        cls, source: Callable[[], Source], session: Session, save: str, layout: Layout | None, *, resume: bool
    ) -> Runner:
        """Open the recording and the source; where the source cannot be opened no empty recording stays behind."""
        recorder = Recorder(save, resume=resume)
        try:
            opened = source()
            try:
                return cls(opened, session, recorder, layout)
            except BaseException:
                opened.close()
                raise
        except BaseException:
            recorder.close()
            raise

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        return self.source.ended

    def step(self, wait: float) -> list[Event]:
        """Take what has come, after `wait` seconds at most, and return what happened.

        Raises
        ------
        ReadError
            The connection is lost, or the stream is none of the known, or its columns have changed; the recording so
            far is kept.
        OptionError
            The recording cannot be written on.
        DataError
            The stream is not one of an accelerometer triad.
        """
        events: list[Event] = []
        arrived = self.source.get(wait)
        for one in arrived:
            events += self._take(self._fed(one.data, one.time), one.time)
            self._answer()
        now = self.source.now()
        if not arrived:
            events += self._take(self._fed(b"", now), now)
            self._answer()
            self.recorder.tick(now)
        if self.source.ended:
            events += self._take(self._stream.finish(), now)
        events += self._check_silence(bool(arrived), now)
        if self._stream.over:
            raise ReadError(f"{self._stream.over}. {self.kept()}")
        if self.source.lost:
            raise ReadError(f"{self.source.lost} {self.kept()}")
        events += self._further_triads(events)
        if self.session.state == "accepted" and not self.session.enough and self.session.next is not None:
            self.source.turn_to(self.session.next)
        return events

    def kept(self) -> str:
        """Say what the recording keeps of a session that ends before its record."""
        count = len(self.session.guide.kept)
        return f"{self.recorder.path} keeps {count} attitude{'s' * (count != 1)}: --resume goes on with it"

    def drop(self, number: int | None = None) -> list[Event]:
        """Drop an attitude, as `Session.drop` does, from the session and from the recording."""
        times = self.session.drop(number)
        if times is not None:
            self.recorder.cut(times[0] - _BEFORE, times[1] + _BEHIND)
        return self.session.events

    def turn(self, direction: Array) -> None:
        """Turn a simulated unit until this direction of the body is up, as a person does; others turn them in hand.

        Raises
        ------
        OptionError
            It is no simulated unit.
        """
        if not self.source.by_hand:
            raise OptionError(f"{self.source.name}: expected a simulated unit (simulate) to be turned from here")
        self.source.turn_by_hand(direction)

    def listen(self, wait: float) -> list[Recording]:
        """Return the samples that have come, after `wait` seconds at most, without session and recording."""
        blocks: list[Recording] = []
        for one in self.source.get(wait):
            blocks += self._fed(one.data, one.time)
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
            if self._further is None and further_of(block.columns):
                self._further = FurtherFits(self.recorder.path, self.session.order, self.session.gravity)
            events += self.session.feed(placed, self._stream.counts)
            if not lies:  # in an attitude that was dropped nothing is recorded until it is left
                self.recorder.write(placed, now)
        return events

    def _further_triads(self, events: list[Event]) -> list[Event]:
        """Fit gyroscopes and magnetometers after an attitude once there is a fit of the accelerometers to stand on."""
        if self._further is None:
            return []
        self._fit_due |= self.session.guide.fit is not None and any(event.kind == "accepted" for event in events)
        if self._fit_due and self._further.ready:
            self._fit_due = False
            self.recorder.flush()
            self._further.begin()
        found = self._further.found()
        return [] if found is None else self.session.know(*found)

    def _answer(self) -> None:
        if self._stream.to_send:
            self.source.send(self._stream.to_send)

    def _check_silence(self, arrived: bool, now: float) -> list[Event]:
        """Say that nothing comes any more, or again."""
        if arrived:
            self._last_arrival = now
            again, self._silent = self._silent, False
            return [Event("again", "samples come again", self.recorder.last)] if again else []
        if self._silent or now - self._last_arrival < _SILENT or self.source.ended:
            return []
        self._silent = True
        text = f"nothing has come from {self.source.name} for {_SILENT:.0f} s: is the unit on, and does it send?"
        return [Event("silent", text, self.recorder.last)]
