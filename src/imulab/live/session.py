"""A guided session: blocks of samples go in, events and warnings come out.

It has no clock, thread or file: the same samples give the same events.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from imulab.columns import triad
from imulab.errors import DataError, OptionError
from imulab.gravity import Gravity
from imulab.live.guide import NEAR, Attitude, Guide, Target
from imulab.live.holds import BLOCK, SHORTEST, SURE, TRIM, Hold, Moment, Stillness
from imulab.live.stamps import Counts
from imulab.live.view import FURTHER, HeldValues, KnownUnit, Trouble, View, in_words
from imulab.procedures.views import parameter_rows
from imulab.recording import Array, Recording
from imulab.units import conversion_factor, parse_unit, to_si

# Warnings on a stream or a unit: each once, when it happens, in one sentence with what to do.


_OFF_GRAVITY = 0.2
"""A unit of MEMS size is never off by more than this part of g."""
_UNITS = ("m/s^2", "g", "mg")
_CONSTANT = 3.0  # s without a change in which a reading that changed before counts as clipped
_WARMING, _PER_MINUTE = 5.0, 2.0  # K since the beginning, and K in a minute, from which a unit still warms up
_MINUTE = 60.0  # s
_LOST = 0.01  # share of lost samples from which a warning is given
_FEWEST = 500  # samples from which that share is meaningful
_SHORT = 10  # times put down without an attitude after which a warning is given
_REST = (SHORTEST + 2 * TRIM) * BLOCK  # s at rest without which there is no attitude


@dataclass
class Watch:
    """The warnings so far, and what is needed to recognise new ones."""

    given_texts: dict[str, str] = field(default_factory=dict)
    _since: list[float | None] = field(default_factory=lambda: [None] * 3)
    _held: Array = field(default_factory=lambda: np.full(3, np.nan))
    _lively: list[bool] = field(default_factory=lambda: [False] * 3)
    _temperatures: list[tuple[float, float]] = field(default_factory=list)
    _refusals: int = 0

    def _once(self, key: str, text: str) -> list[str]:
        if key in self.given_texts:
            return []
        self.given_texts[key] = text
        return [text]

    def scatter(self, text: str) -> list[str]:
        """Return the warning that more attitudes help little, the first time that there is a reason."""
        return self._once("scatter", text) if text else []

    def order(self, text: str) -> list[str]:
        """Return the warning that the model is too simple, the first time that it is."""
        return self._once("order", text) if text else []

    def refusal(self, text: str, count: int, beyond: float) -> list[str]:
        """Return why the fit is refused, each time that all planned attitudes have come once more."""
        if int(beyond) <= self._refusals:
            return []
        self._refusals = int(beyond)
        self.given_texts["refusal"] = f"no record can be made of these {count} attitudes: {text}"
        return [self.given_texts["refusal"]]

    def short(self, count: int) -> list[str]:
        """Return a warning where the unit was put down so often without an attitude, now and then."""
        if not count or count % _SHORT:
            return []
        self.given_texts["short"] = (
            f"{count} times put down without an attitude: each needs {_REST:.1f} s at rest; let go of the unit for "
            f"{2 * _REST:.0f} s, on something that does not shake"
        )
        return [self.given_texts["short"]]

    def hold(self, hold: Hold, unit: str, gravity: float) -> list[str]:
        """Return a warning where the length of f at rest shows a wrong unit."""
        length = float(np.linalg.norm(hold.mean))
        if parse_unit(unit).quantity != "acceleration":
            return [] if length else self._once("unit", "all three outputs are 0: are the accelerometers on?")
        expected = gravity * conversion_factor("m/s^2", unit)
        if abs(length / expected - 1) <= _OFF_GRAVITY:
            return []
        fits = [u for u in _UNITS if abs(length / (gravity * conversion_factor("m/s^2", u)) - 1) <= _OFF_GRAVITY]
        asked = f"is its unit {fits[0]}?" if fits else "is its unit right, and its range?"
        return self._once(
            "unit", f"the accelerometers read {length:.4g} {unit} at rest, where {expected:.4g} is expected: {asked}"
        )

    def moment(self, moment: Moment) -> list[str]:
        """Return warnings on axes that are dead, or at the end of their range."""
        messages: list[str] = []
        for k, axis in enumerate("xyz"):
            since, value = self._since[k], float(moment.mean[k])
            if not moment.constant[k] or value != self._held[k]:
                self._lively[k] |= not moment.constant[k]
                self._since[k] = moment.time if moment.constant[k] else None
                self._held[k] = value
                continue
            if since is None or moment.time - since < _CONSTANT or not any(self._lively):
                continue
            if not self._lively[k]:
                messages += self._once(
                    f"dead {axis}", f"accel_{axis} has read {value:g} since the beginning: is the axis connected?"
                )
            elif abs(value) >= np.abs(moment.mean).max():
                messages += self._once(
                    f"clipped {axis}",
                    f"accel_{axis} stays at exactly {value:g}: clipped? set the unit to a larger range and start again",
                )
        return messages

    def block(self, block: Recording, time: float) -> list[str]:
        """Return warnings on a changing temperature."""
        if "temperature" not in block or block.units["temperature"] not in ("degC", "K"):
            return []
        values = block.column("temperature")
        if not np.isfinite(values).any():
            return []
        now = float(np.nanmean(values))
        last = self._temperatures
        if not last or time - last[-1][0] >= 1.0:
            last.append((time, now))
            del last[1 : max(len(last) - int(_MINUTE), 1)]  # keeps the first, and those of the last minute
        first, minute = last[0][1], last[min(1, len(last) - 1)]
        messages = []
        if time - minute[0] > _MINUTE / 2 and abs(now - minute[1]) > _PER_MINUTE:
            messages += self._once(
                "temperature rate",
                f"the temperature changes by {now - minute[1]:+.1f} K within a minute: wait until it is steady",
            )
        if abs(now - first) > _WARMING:
            messages += self._once(
                "temperature",
                f"the temperature has changed by {now - first:+.1f} K since the beginning: the zeros will have, too",
            )
        return messages

    def counts(self, counts: Counts, samples: int) -> list[str]:
        """Return warnings on lost, damaged, repeated and misplaced samples, and on bytes that nobody read."""
        messages = []
        came = samples + counts.repeated + counts.reordered + counts.stray
        if counts.stray:
            messages += self._once(
                "stray",
                "a sample whose time fits neither those before nor those after is left out, as any more will be: is "
                "the cable all right?",
            )
        if counts.unread_share:
            messages += self._once(
                "unread",
                f"{100 * counts.unread_share:.2g} % of the bytes come faster than they are read and are lost: a lower "
                "rate, or fewer columns?",
            )
        if came > _FEWEST:
            for key, number, text in (
                ("lost", counts.lost, f"of {samples + counts.lost} samples are lost: a lower rate, or a faster link?"),
                ("damaged", counts.damaged, "lines or messages were damaged: is the cable all right?"),
                ("repeated", counts.repeated, f"of {came} samples came again and are left out: is each sent once?"),
                (
                    "late",
                    counts.reordered,
                    f"of {came} samples came too late and are left out: a faster link?",
                ),
                (
                    "strays",
                    counts.stray,
                    f"of {came} samples have a time that fits neither those before nor those after and are left out: "
                    "is the cable all right?",
                ),
            ):
                if number > _LOST * samples:
                    messages += self._once(key, f"{number} {text}")
        if counts.restarts:
            messages += self._once(
                f"restart {counts.restarts}",
                "the device has started again, or its clock was set: is its power or its cable loose?",
            )
        return messages


# The session: samples in, events out, and a view of its state.


_TWICE = 2.0  # the planned attitudes after which a fit that is refused will go on being refused
_NONE_SINCE = 300.0  # s without an attitude after which none is to be expected; a simulated unit lies for 60 at most
_STRIP = 100  # tenths of a second that a view shows
_ADVICE = {
    "waiting": "waiting for samples",
    "moving": "put the unit down",
    "settling": "hands off",
    "still": "hold still",
}


@dataclass(frozen=True)
class Event:
    """Something that happened at a time of the recording, s: its kind, for programs, and a sentence."""

    kind: str
    text: str
    time: float


@dataclass
class Session:
    """The state of a session.

    Attributes
    ----------
    order, gravity, targets, planned
        As for `Guide`.
    source
        Name of the source, as shown.
    guide
        The attitudes and the plan.
    trouble
        Why no samples come, as who feeds the session knows; None while they do.
    """

    order: int | str = "auto"
    gravity: Gravity | None = None
    targets: tuple[Target, ...] = ()
    planned: int | None = None
    source: str = ""
    state: str = "waiting"
    events: list[Event] = field(default_factory=list)
    guide: Guide = field(init=False)
    trouble: Trouble | None = None
    _still: Stillness = field(default_factory=Stillness)
    _watch: Watch = field(default_factory=Watch)
    _counts: Counts = field(default_factory=Counts)
    _format: str = ""
    _samples: int = 0
    _first: float | None = None
    _time: float = 0.0
    _reading: Array | None = None
    _temperature: float | None = None
    _seconds: float = 0.0
    _needed: float = 0.0
    _strip: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=_STRIP))
    _accepted: Attitude | None = None
    _dropping: bool = False
    _put_down: int = 0
    _next: Array | None = None
    _enough: str = ""
    _aside: frozenset[int] = frozenset()
    _further: tuple[KnownUnit, ...] = ()
    _magnetometers: bool = False

    def __post_init__(self) -> None:
        """Make the guide, which gets the unit of the outputs with the first samples."""
        self.guide = Guide(self.order, self.gravity, self.targets, self.planned)

    def feed(self, block: Recording, counts: Counts | None = None) -> list[Event]:
        """Take samples, with the faults of the stream so far, and return what happened.

        Raises
        ------
        DataError
            The samples are not those of an accelerometer triad over time.
        """
        self.events = []
        if not len(block):
            return []
        times = block.time
        if times is None or not all(name in block for name in triad("accel")):
            raise DataError(
                f"{self.source or block.name}: expected time and accel_x accel_y accel_z, found "
                f"{' '.join(block.columns)}"
            )
        if not self.begun:
            self._first = float(times[0])
            self._begin(block)
        self._counts = counts or self._counts
        self._time, self._samples = float(times[-1]), self._samples + len(block)
        if "temperature" in block and block.units["temperature"] in ("degC", "K"):
            self._temperature = float(to_si(float(block.column("temperature")[-1]), block.units["temperature"]))
        self._warn([*self._watch.block(block, self._time), *self._watch.counts(self._counts, self._samples)])
        for moment in self._still.feed(times, block.triad("accel")):
            self._at(moment)
        return self.events

    @property
    def begun(self) -> bool:
        """Whether samples have come."""
        return self._first is not None

    @property
    def wanted(self) -> int:
        """How many attitudes there will be, as far as known; 0 where nothing is known."""
        return self.guide.wanted() if self.guide.kept else (self.guide.planned or 0)

    @property
    def enough(self) -> bool:
        """Whether the target is met."""
        return bool(self._enough)

    def hopeless(self, begin: float) -> str:
        """Return why no record is to be expected of a session since a time, s, as it goes on; empty where one may."""
        if self.guide.beyond_plan >= _TWICE:
            return self._watch.given_texts["refusal"]
        since = begin if self._accepted is None else max(begin, self._accepted.start)
        if self.enough or self._time - since <= _NONE_SINCE:
            return ""
        return self._watch.given_texts.get("short", f"no new attitude for {_NONE_SINCE:.0f} s")

    @property
    def next(self) -> Array | None:
        """The upward direction of the body to take next, shape (3,)."""
        return self._next

    @property
    def dropping(self) -> bool:
        """Whether the unit still lies in an attitude that was dropped."""
        return self._dropping

    def drop(self, number: int | None = None) -> tuple[float, float] | None:
        """Drop an attitude by its number, or the one named as knocked, or the last one; return its times, s.

        Returns None if there is no attitude.

        Raises
        ------
        OptionError
            There is no attitude of this number.
        """
        kept = self.guide.kept
        if not kept:
            return None
        knocked = [each for each in kept if each.number in self._aside]
        gone = (knocked or kept)[-1] if number is None else next((e for e in kept if e.number == number), None)
        if gone is None:
            numbers = " ".join(str(each.number) for each in kept)
            raise OptionError(f"attitude {number}: there is none of this number; expected one of {numbers}")
        self.events = []
        self.guide.drop(gone.number)
        if self._accepted is gone and self.state in ("still", "accepted"):
            self._dropping = True
        self._say("dropped", f"attitude {gone.number} is dropped")
        self._look()
        self._plan()
        return gone.start, gone.stop

    def state_gravity(self, gravity: Gravity) -> None:
        """Take local gravity, with which all attitudes are fitted anew."""
        self.events = []
        self.gravity = self.guide.gravity = gravity
        self.guide.refit()
        self._look()
        self._plan()

    def know(self, further: tuple[KnownUnit, ...], why: Sequence[str]) -> list[Event]:
        """Take the parameters of further triads, or the reasons why some have none, and return what is new."""
        self.events = []
        for name, words in FURTHER.items():
            had, has = (any(row.name.startswith(f"{name}_") for row in rows) for rows in (self._further, further))
            if has and not had:
                text = f"the {words} are calibrated from the attitudes so far; each further one makes them better"
                self._say("further", text)
        if self._enough:
            for each in why:
                self._say("further", each)
        self._further = further or self._further
        return self.events

    def view(self) -> View:
        """Return the view of the session now."""
        guide = self.guide
        residuals, agree = guide.residuals()
        directions = guide.directions()
        held = tuple(
            HeldValues(each.number, tuple(up), None if np.isnan(off) else float(off), not good, each.seconds)
            for each, up, off, good in zip(guide.kept, directions.tolist(), residuals, agree, strict=True)
        )
        known: tuple[KnownUnit, ...] = ()
        if guide.fit is not None:
            rows = parameter_rows(guide.fit.calibration)
            shares = guide.parameter_shares()
            known = tuple(
                KnownUnit(row.name, row.value, row.standard_uncertainty, row.unit, shares.get(row.name)) for row in rows
            )
        seconds = self._time - (self._first or 0.0)
        reading = self._reading
        return View(
            source=self.source,
            format=self._format,
            state=self.trouble.state if self.trouble else self.state,
            advice=self.trouble.advice if self.trouble else self._advice(),
            outlook=self.trouble.outlook if self.trouble else "",
            seconds=seconds,
            samples=self._samples,
            rate=(self._samples - 1) / seconds if seconds > 0 else 0.0,
            counts=Counts(**vars(self._counts)),
            up=None if reading is None else tuple((reading / (np.linalg.norm(reading) or 1.0)).tolist()),
            length=None if reading is None else float(np.linalg.norm(reading)),
            unit=guide.unit,
            temperature=self._temperature,
            hold=self._seconds,
            hold_needed=self._needed,
            strip=tuple(
                (round(time - self._time, 2), *(float(f"{v:.5g}") for v in some)) for time, *some in self._strip
            ),
            attitudes=held,
            wanted=self.wanted,
            parameters=known + (self._further if known else ()),
            targets=tuple(zip((f"{t.stem} {t.text}" for t in self.targets), guide.shares(), strict=True)),
            next=None if self._next is None else tuple(self._next.tolist()),
            next_words="" if self._next is None else self._in_words(self._next),
            enough=self._enough,
            missing=guide.missing,
            warnings=tuple(self._watch.given_texts.values()),
        )

    def _begin(self, block: Recording) -> None:
        guide = self.guide
        guide.unit, guide.metadata = block.triad_unit("accel"), block.metadata
        self._format = block.metadata.get("format", "")
        self._magnetometers = all(name in block for name in triad("mag"))
        rate = f", {self._format}" if self._format else ""
        self._say("format", f"{self.source or block.name}{rate}: {' '.join(block.columns)}")
        self._plan()

    def _at(self, moment: Moment) -> None:
        """Process a tenth of a second."""
        self._reading, self._time = moment.mean, moment.time
        self._strip.append((moment.time, *moment.low.tolist(), *moment.high.tolist()))
        self._warn(self._watch.moment(moment))
        if moment.ended is not None:
            self._ended(moment.ended)
        state = moment.state
        if state != "still":
            self._dropping = self._dropping and state == "settling"
            self._seconds, self._needed = 0.0, SURE * BLOCK
        hold = moment.hold
        if hold is not None:
            self._seconds = hold.seconds
            if self._accepted is not None and self._accepted.start == hold.start:
                state = "accepted"
            elif not self._dropping and hold.blocks >= SURE:
                self._warn(self._watch.hold(hold, self.guide.unit, self.guide.local_gravity))
                self._needed = self.guide.hold_needed(hold.mean, hold.covariance, hold.seconds)
                if hold.seconds >= self._needed:
                    self._accept(hold)
                    state = "accepted"
        if state != self.state:
            if state == "moving" and self.state in ("settling", "still") and not self._dropping:
                self._put_down += 1
                self._warn(self._watch.short(self._put_down))
            self.state = state
            if state != "accepted":  # which, and what is next, is said already
                self._say("state", self._advice())

    def _ended(self, hold: Hold) -> None:
        """Process a hold that has ended: a long enough one counts, and may lengthen the last attitude."""
        last = self._accepted
        if last is not None and last.start == hold.start:
            if not last.dropped and self.guide.attitudes[-1] is last:
                self._accepted = self._attitude(last.number, hold)
                self.guide.lengthen(self._accepted)
        elif hold.blocks >= SHORTEST and not self._dropping:
            self._accept(hold)

    def _accept(self, hold: Hold) -> None:
        number, self._put_down = len(self.guide.attitudes) + 1, 0
        self._accepted = self._attitude(number, hold)
        self.guide.accept(self._accepted)
        self._say("accepted", f"attitude {number} accepted after {hold.seconds:.1f} s")
        self._look()
        self._plan()

    def _attitude(self, number: int, hold: Hold) -> Attitude:
        return Attitude(number, hold.mean, hold.covariance, hold.start, hold.stop, hold.seconds)

    def _look(self) -> None:
        """Give a message on attitudes that disagree with the others."""
        residuals, agree = self.guide.residuals()
        aside = {e.number: off for e, off, good in zip(self.guide.kept, residuals, agree, strict=True) if not good}
        for number, off in aside.items():
            if number not in self._aside:
                milli = 1e3 * off / self.guide.local_gravity
                self._say(
                    "knocked",
                    f"attitude {number} is off by {milli:+.2g} mg: knocked? put it down again, or press u to drop it",
                )
        self._aside = frozenset(aside)
        guide = self.guide
        self._warn(self._watch.refusal(guide.refusal, len(guide.kept), guide.beyond_plan))
        self._warn(self._watch.order(self.guide.too_simple()))
        if not self._aside and self.guide.targets and not self.guide.met:
            self._warn(self._watch.scatter(self.guide.scatter()))

    def _plan(self) -> None:
        guide, was = self.guide, self._enough
        if guide.met:
            self._enough = f"enough: {guide.five_more()}"
            self._next = guide.next_direction()
            if not was:
                self._say("enough", self._enough)
            return
        self._enough = ""
        self._next = guide.next_direction()
        if self._next is not None:
            left = guide.wanted() - len(guide.kept)
            to_go = f"{'over ' if guide.beyond else ''}{max(left, 1)} to go"
            to_go = "no record yet" if guide.beyond_plan >= 1 else to_go
            self._say("next", f"next: {self._in_words(self._next)} ({to_go})")

    def _in_words(self, up: Array) -> str:
        """Return the attitude to take in words; magnetometers need another heading each time."""
        return in_words(up) + (", a quarter turn about the vertical from the last" if self._magnetometers else "")

    def _advice(self) -> str:
        if self._dropping:
            return "dropped: turn the unit to the next attitude"
        if self.state == "accepted":
            if self._enough or self._next is None:
                return self._enough or "accepted"
            return f"accepted; turn it: {self._in_words(self._next)}"
        if self.state == "moving" and self._next is not None:
            if self._reading is not None and self._reading @ self._next > NEAR * np.linalg.norm(self._reading):
                return "that is it: put it down"
            return f"turn it: {self._in_words(self._next)}, and put it down"
        return _ADVICE[self.state]

    def _warn(self, texts: Sequence[str]) -> None:
        for text in texts:
            self._say("warning", text)

    def _say(self, kind: str, text: str) -> None:
        self.events.append(Event(kind, text, self._time))
