"""The guided session on the page: it runs in its own thread, and every page shows the same.

Messages to the page, beside those of `parts`:

``view``
    The `View` as JSON, at most ten a second: numbers in SI or as `View` says, parameters as texts (`name`, `value`,
    `uncertainty`, `unit`) with `share`, their standard uncertainty over the target's; each attitude in `words`; `phase`
    (``measuring``, ``computing``, ``done`` or ``failed``); `recording`, its file; `by_hand`, whether the unit is one
    that ``turn`` turns; `gravity`, that of the place, m/s², or null where nobody stated it.
``event``
    Something that happened: `kind`, `text`, `time`, as `Event`.
``done``
    The record is made: `headline`, `verdict` (``good``, ``look`` or ``bad``), `reasons` and `next` (what to do now),
    `parameters` as above, `files` (`kind`, `name`, `href`) and `command`, which makes the same record.
``corrected``
    After that, ten times a second: `length`, `raw` and `gravity`, m/s², of the reading now.
``unknown``
    The stream has no known format: its first `lines`, and a layout, `guess`, that ``guess`` takes; none once it is.
``failed``
    The session has ended: `text` says why, `missing` what a record would need where that is the reason, `kept` what the
    recording keeps; `lines` are the first of an unknown stream, `guess` a layout for it.

Messages from the page: ``drop`` (`attitude`: its number), ``turn`` (`up`: the direction of the body that a simulated
unit is to have upward), ``place`` (`latitude` and `height`, or `gravity`, as texts), ``guess`` (read an unknown
stream so), ``finish`` and ``quit``.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextvars import copy_context
from dataclasses import asdict
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic, sleep

import numpy as np
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from imulab.errors import ImulabError, OptionError, quoted
from imulab.gravity import Gravity
from imulab.live.formats import UnknownFormatError
from imulab.live.page.server import Hub, Message, PagePart, report_response
from imulab.live.runner import Runner
from imulab.live.session import Event
from imulab.live.view import View, corrected_reading, in_words
from imulab.procedures.apply import loaded
from imulab.procedures.views import exhibits_of, parameter_rows, render_record
from imulab.records.calibration import Calibration
from imulab.report.traces import format_uncertain

_WAIT, _EVERY = 0.05, 0.1  # s of one wait for the source; s between two messages to the pages
_TOLD = 0.3  # s for the last message to reach the pages
_LONGEST = 100  # characters of a text from the page
_EVENTS = 60  # latest events that a new page shows
_PATIENCE = 5.0  # s for a thread to end, and for a page that is being opened


class GuidedPart(PagePart):
    """The guided session as a part of the page.

    Parameters
    ----------
    runner
        The session with its source and its recording.
    fit
        Makes the record from the recording, and writes the outputs.
    command
        Words of the command, or commands, that make the same record.
    record_name
        Name of the record's file.
    place
        Returns the gravity of a place, from texts of latitude, height or gravity as of the options; record and command
        are then made with it.

    Attributes
    ----------
    record
        The record that `fit` has made, or None.
    error
        Reason of an unexpected end of the session.
    """

    name = "session"

    def __init__(
        self,
        runner: Runner,
        fit: Callable[[], Calibration],
        command: Callable[[Calibration], str],
        record_name: str,
        place: Callable[[Mapping[str, str]], Gravity],
    ) -> None:
        super().__init__()
        self.record: Calibration | None = None
        self.error: Exception | None = None
        self._runner, self._fit, self._command, self._record_name = runner, fit, command, record_name
        self._place = place
        self._asked: SimpleQueue[Message] = SimpleQueue()
        self._view: Message = {}
        self._unknown: Message = {}
        self._done: Message = {}
        self._failed: Message = {}
        self._events: deque[Message] = deque(maxlen=_EVENTS)
        self._phase, self._finish = "measuring", False
        self._stop = threading.Event()
        self._hub = Hub()
        self._thread = threading.Thread(target=partial(copy_context().run, self._run), daemon=True, name="imulab live")
        self.handlers = {
            "drop": self._drop,
            "turn": self._turn,
            "place": self._take_place,
            "guess": self._asked.put,
            "finish": self._asked.put,
            "quit": lambda _: self._hub.stop(),
        }
        self.routes = [Route("/api/session/{kind}", self._file)]

    def begin(self, hub: Hub) -> None:
        """Start the session."""
        self._hub = hub
        self._thread.start()

    def greet(self) -> Iterable[Message]:
        """Yield the view, the latest events, and the end of the session if it has ended."""
        messages = (self._view, *tuple(self._events), self._unknown, self._done, self._failed)
        return [message for message in messages if message]

    def end(self) -> None:
        """End the session; the recording is kept."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(_PATIENCE)

    def _drop(self, message: Message) -> None:
        number = message.get("attitude")
        if type(number) is not int:
            raise OptionError(f"drop: expected the number of an attitude, found {quoted(number)}")
        self._asked.put(message)

    def _turn(self, message: Message) -> None:
        up = message.get("up")
        if not (isinstance(up, list) and len(up) == 3 and all(type(each) in (int, float) for each in up)):
            raise OptionError(f"turn: expected a direction of three numbers, found {quoted(up)}")
        length = float(np.linalg.norm(np.array(up, dtype=np.float64)))
        if not (np.isfinite(length) and length > 0):
            raise OptionError(f"turn: expected a direction, found {quoted(up)}")
        self._asked.put({"type": "turn", "up": np.array(up) / length})

    def _take_place(self, message: Message) -> None:
        texts = {key: message[key] for key in ("gravity", "latitude", "height") if message.get(key)}
        if not texts or not all(isinstance(text, str) and len(text) <= _LONGEST for text in texts.values()):
            raise OptionError("place: expected the latitude, or the gravity")
        self._asked.put({"type": "place", "texts": texts})

    def _run(self) -> None:
        try:
            while not self._measure():
                if self._stop.is_set():
                    return
            self._follow()
        except Exception as error:
            self.error, self._failed, self._phase = error, self._failure(error), "failed"
            self._show()
            self._tell(self._failed)
            given_up = monotonic() + _PATIENCE  # a page that is being opened gets the message too
            while not (self._hub.pages or self._stop.is_set()) and monotonic() < given_up:
                sleep(_WAIT)
            sleep(_TOLD)  # the message reaches the pages before the server ends
            self._hub.stop()

    def _measure(self) -> bool:
        """Measure until the user finishes or the stream ends; return whether there will be a record."""
        runner, last_shown = self._runner, 0.0
        self._phase, self._finish = "measuring", False
        while not (self._stop.is_set() or self._finish or runner.ended):
            events = [*self._do_requests(), *runner.step_or_ask(_WAIT)]
            for event in events:
                self._publish(event)
            if events or monotonic() - last_shown > _EVERY:
                self._show()
                last_shown = monotonic()
        if self._stop.is_set():
            return False
        self._phase = "computing"
        self._show()
        runner.recorder.flush()
        try:
            self.record = self._fit()
        except ImulabError as error:
            if runner.ended:
                raise
            self._tell({"type": "refused", "text": str(error)})
            return False
        runner.recorder.close()
        self._phase, self._done = "done", self._result(self.record)
        self._show()
        self._tell(self._done)
        return True

    def _do_requests(self) -> list[Event]:
        """Do what the pages have asked for, and return the events."""
        events: list[Event] = []
        try:
            while True:
                message = self._asked.get_nowait()
                if message["type"] == "finish":
                    self._finish = True
                    continue
                try:
                    if message["type"] == "turn":
                        self._runner.turn(message["up"])
                    elif message["type"] == "guess":
                        events += self._runner.take_guess()
                        self._unknown = {}
                        self._tell({"type": "unknown"})
                    elif message["type"] == "place":
                        events += self._runner.state_gravity(self._place(message["texts"]))
                    else:
                        events += self._runner.drop(message["attitude"])
                except OptionError as error:
                    self._tell({"type": "refused", "text": str(error)})
        except Empty:
            return events

    def _publish(self, event: Event) -> None:
        if event.kind != "state":
            self._events.append({"type": "event", **asdict(event)})
            self._tell(self._events[-1])
        if event.kind == "unknown" and (error := self._runner.asked) is not None and error.guess is not None:
            self._unknown = {"type": "unknown", "lines": list(error.lines), "guess": error.guess.toml}
            self._tell(self._unknown)

    def _show(self) -> None:
        self._view = {
            **view_message(self._runner.session.view()),
            "phase": self._phase,
            "recording": self._runner.recorder.path,
            "by_hand": self._runner.source.by_hand,
            "gravity": self._gravity(),
        }
        self._tell(self._view, latest=True)

    def _gravity(self) -> float | None:
        session = self._runner.session
        stated = session.gravity is not None or "gravity" in session.guide.metadata
        return session.guide.local_gravity if stated else None

    def _tell(self, message: Message, *, latest: bool = False) -> None:
        self._hub.tell(message, latest=latest)

    def _follow(self) -> None:
        """Show the length of the reading, raw and corrected by the record, until the end."""
        assert self.record is not None
        ready, runner, last_shown = loaded(self.record), self._runner, 0.0
        gravity = runner.session.guide.local_gravity
        gyro = "gyro_bias_x" in self.record.parameters
        while not (self._stop.is_set() or runner.ended):
            blocks = runner.listen(_WAIT)
            if blocks and monotonic() - last_shown > _EVERY:
                shown = corrected_reading(ready, blocks[-1], gyro=gyro and "gyro_x" in blocks[-1])
                self._tell({"type": "corrected", **asdict(shown), "gravity": gravity}, latest=True)
                last_shown = monotonic()

    def _failure(self, error: Exception) -> Message:
        lines: Iterable[str] = ()
        guess = ""
        if isinstance(error, UnknownFormatError):
            lines, guess = error.lines, error.guess.toml if error.guess else ""
        text = str(error) if isinstance(error, ImulabError) else f"a fault of imulab: {type(error).__name__}: {error}"
        kept = self._runner.kept() if self._runner.recorder.rows else ""
        return {
            "type": "failed",
            "text": text,
            "missing": self._runner.session.guide.missing if self._phase == "computing" else "",
            "kept": "" if kept in text else kept,
            "lines": list(lines),
            "guess": guess,
        }

    def _result(self, record: Calibration) -> Message:
        names = {"record": self._record_name, "report": "report", "recording": Path(self._runner.recorder.path).name}
        return {
            "type": "done",
            "headline": exhibits_of(record).headline,
            "verdict": record.verdict.state,
            "reasons": list(record.verdict.reasons),
            "next": list(record.verdict.next),
            "parameters": [
                _parameter(row.name, row.value, row.standard_uncertainty, row.unit) for row in parameter_rows(record)
            ],
            "files": [{"kind": kind, "name": name, "href": f"/api/session/{kind}"} for kind, name in names.items()],
            "command": self._command(record),
        }

    def _file(self, request: Request) -> Response:
        kind = request.path_params["kind"]
        if not self._done:
            raise OptionError("the recording still grows, and there is no record yet: finish the session first")
        assert self.record is not None
        if kind == "recording":
            path = self._runner.recorder.path
            return FileResponse(path, filename=Path(path).name, media_type="text/csv")
        if kind == "report":
            return report_response(render_record(self.record))
        if kind == "record":
            headers = {"content-disposition": f'attachment; filename="{_ascii(self._record_name)}"'}
            return Response(self.record.to_json(), media_type="application/json", headers=headers)
        raise OptionError(f"{quoted(kind)}: expected one of record report recording")


def view_message(view: View) -> Message:
    """Return a view as the message of the page."""
    shown = [{**_parameter(p.name, p.value, p.standard_uncertainty, p.unit), "share": p.share} for p in view.parameters]
    held = [{**asdict(each), "words": in_words(np.array(each.up))} for each in view.attitudes]
    return {"type": "view", **asdict(view), "parameters": shown, "attitudes": held}


def _parameter(name: str, value: float, uncertainty: float | None, unit: str) -> Message:
    texts = format_uncertain(value, uncertainty)
    return {"name": name, "value": texts[0], "uncertainty": texts[1], "unit": unit}


def _ascii(name: str) -> str:
    """Return a file's name with characters that a header allows."""
    return "".join(each if each.isascii() and each.isprintable() and each not in '"\\' else "_" for each in name)
