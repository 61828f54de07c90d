"""Bytes of a live stream to blocks with named columns and units.

The format is recognised from the first two seconds; for an unknown stream of numbers a layout is offered.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from imulab.columns import triad
from imulab.display import printable
from imulab.errors import ReadError, quoted
from imulab.estimation.clock import same_rows
from imulab.live.decoders import (
    LayoutDecoder,
    Mavlink,
    MotionCal,
    Msp,
    Native,
    XImu3,
    is_titles,
    looks_like_mavlink,
    looks_like_msp,
)
from imulab.live.stamps import ArrivalClock, Counts, DeviceClock, SharedClock
from imulab.readers.guess import GuessError, LayoutGuess, guess_table, layout_of_table, table_of_records
from imulab.readers.selection import units_of_columns
from imulab.readers.text import is_number
from imulab.recording import Array, Layout, Recording
from imulab.units import STANDARD_GRAVITY

# Offered layout for an unknown stream of numbers; it is never used without the user's consent.


_FEWEST_STEPS = 1000.0  # of 1/8192 g that gravity has at least
_FEWEST = 5  # lines that show the columns
_UNITS = (("m/s^2", STANDARD_GRAVITY), ("g", 1.0), ("mg", 1000.0))
_NEAR = 0.25  # relative: a mean this near to g in some unit is a specific force
_STEADY = 0.2  # largest relative scatter of the length of three columns of specific force in a hand


_SUPPOSED = {"gyro": "deg/s", "accel": "count", "mag": "count"}
"""Units that are offered where neither titles nor readings say them."""


def guess_stream(lines: list[str], seconds: float, units: Mapping[str, str] | None = None) -> LayoutGuess | None:
    """Return a layout that may fit, or None where the lines hold no rows of numbers.

    Titles are read as those of files are; without titles the readings alone are looked at.

    Parameters
    ----------
    lines
        The first lines of the stream.
    seconds
        Time in which they came, s, which shows the unit of a time column.
    units
        Those that are stated for sensors or columns.
    """
    units = units or {}
    if sum(line.startswith("{") for line in lines) > len(lines) / 2:
        return _guess_json(lines, seconds, units)
    titled = _by_titles(lambda: guess_table(lines, "stream"), seconds, units)
    if titled is not None:
        return titled
    delimiter = max(",;\t", key=lambda sign: sum(line.count(sign) for line in lines))
    split: Callable[[str], list[str]] = lambda line: [field.strip() for field in line.split(delimiter)]  # noqa: E731
    shown = {",": '","', ";": '";"', "\t": '"\\t"'}[delimiter]
    if not any(delimiter in line for line in lines):
        split, shown = str.split, '"whitespace"'
    rows = [split(line) for line in lines]
    glued = _glued(lines)
    if glued:
        rows = [[glued, *split(line.removeprefix(glued))] for line in lines if line.startswith(glued)]
    prefix = glued or _prefix(rows)
    rows = [row[1:] for row in rows if row[0] == prefix] if prefix else rows
    numbers = [row for row in rows if all(map(is_number, row))]
    width = max(map(len, numbers), default=0)
    table = np.array([list(map(float, row)) for row in numbers if len(row) == width])
    if len(table) < _FEWEST or width < 3:
        return None
    head = [f"delimiter = {shown}", *([f"prefix = {json.dumps(prefix)}"] if prefix else [])]
    return _guess(head, list(range(width)), table, seconds)


def _glued(lines: list[str]) -> str:
    """Return what most lines begin with up to a colon, ``Raw:`` before numbers; nothing without it."""
    begins = [match[0] for line in lines if (match := re.match(r"[A-Za-z/]+:(?=[-+\d.])", line))]
    return max(set(begins), key=begins.count) if len(begins) > len(lines) / 2 else ""


def _by_titles(table: Callable[[], Any], seconds: float, stated: Mapping[str, str]) -> LayoutGuess | None:
    """Return the layout that titles give; a unit that they do not say is supposed, and that is said."""
    units = dict(stated)
    for sensor in ("", *_SUPPOSED):
        if sensor:
            units.setdefault(sensor, _SUPPOSED[sensor])
        try:
            guess = layout_of_table(table(), "stream", units=units, seconds=seconds, timed=False)
        except GuessError:
            continue
        more = tuple(
            f"the unit of {name}, {unit}, is only supposed" for name, unit in units.items() if name not in stated
        )
        return LayoutGuess(guess.toml, (*guess.supposed, *more))
    return None


def _guess_json(lines: list[str], seconds: float, units: Mapping[str, str]) -> LayoutGuess | None:
    rows = []
    for line in lines:
        try:
            document = json.loads(line)
        except ValueError:
            continue
        if isinstance(document, dict):
            rows.append(_flatten(document))
    keys = list(rows[-1]) if rows else []
    rows = [row for row in rows if list(row) == keys]
    if len(rows) < _FEWEST or len(keys) < 3:
        return None
    titled = _by_titles(lambda: table_of_records(rows), seconds, units)
    return titled or _guess([], list(keys), np.array([list(row.values()) for row in rows]), seconds)


def _flatten(document: dict[str, object], before: str = "") -> dict[str, float]:
    numbers: dict[str, float] = {}
    for key, value in document.items():
        if isinstance(value, dict):
            numbers |= _flatten(value, f"{before}{key}.")
        elif isinstance(value, list):
            numbers |= _flatten({str(place): each for place, each in enumerate(value)}, f"{before}{key}.")
        elif isinstance(value, int | float):
            numbers[f"{before}{key}"] = float(value)
    return numbers


def _guess(head: list[str], names: list[str | int], table: Array, seconds: float) -> LayoutGuess | None:
    """Return the layout: a rising first column is the time, three columns of steady length the accelerometers."""
    columns, why = ["[columns]"], []
    steps = np.diff(table[:, 0])
    first = 0
    if (steps > 0).all():
        ticks = float(table[-1, 0] - table[0, 0]) / max(seconds, 1e-3)
        unit = "s" if ticks < 30 else "ms" if ticks < 3e4 else "us"
        columns.append(f'time = {{ from = {json.dumps(names[0])}, unit = "{unit}" }}')
        why.append("the first column rises")
        first = 1
    sizes = {start: np.linalg.norm(table[:, start : start + 3], axis=1) for start in range(first, table.shape[1] - 2)}
    steady = {start: float(np.ptp(size) / size.mean()) for start, size in sizes.items() if size.mean() > 0}
    if not steady:
        return None
    at_g = [s for s in steady if any(abs(sizes[s].mean() / g - 1) < _NEAR for _, g in _UNITS) and steady[s] < _STEADY]
    start = at_g[0] if at_g else min((s for s in steady if (s - first) % 3 == 0), key=steady.__getitem__)
    length = float(np.median(sizes[start]))
    unit = next((unit for unit, g in _UNITS if abs(length / g - 1) < _NEAR), "count")
    columns += _triad("accel", names, start, unit)
    why.append(f"the next three have a length of {length:.4g}")
    if start + 6 <= table.shape[1]:
        columns += _triad("gyro", names, start + 3, "deg/s" if unit != "count" else "count")
        why.append("that the gyroscopes follow, and their unit, is only supposed")
    return LayoutGuess("\n".join([*head, *columns, ""]), tuple(why))


def _triad(stem: str, names: list[str | int], start: int, unit: str) -> list[str]:
    return [
        f'{name} = {{ from = {json.dumps(names[start + k])}, unit = "{unit}" }}' for k, name in enumerate(triad(stem))
    ]


def _prefix(rows: list[list[str]]) -> str:
    """Return the first field that most lines share if it is no number, else nothing."""
    first = [row[0] for row in rows if len(row) > 1]
    pairs = [field for field, other in pairwise(first) if field == other and not is_number(field)]
    return max(set(pairs), key=pairs.count) if len(pairs) > len(first) / 2 else ""


# Streams: the format is recognised from the first two seconds.


FIRST = 2.0
"""Seconds from which the format is recognised."""
_MOST = 1 << 18  # most bytes kept until the format is known
_SILENT = 0.5  # s without an answer after which a device is polled again
_POLL_AGAIN = 0.1  # s between two polls of a device that answers
_TEXT = bytes(range(32, 127)) + b"\r\n\t"
_MOSTLY = 0.9  # least share of printable bytes in text
STRAIGHTENED = "arrival time, straightened by a robust line"
"""Entry in the head of a recording for times without a device's stamps."""
SHARED = "shared by several samples, which lie evenly on a robust line through the stamps"
"""The same for stamps of several samples each."""
_MOST_WAITING = 50_000  # samples of one stamp
_SHARED = 0.05  # share of rows with the stamp of the row before and other readings from which stamps are shared


class UnknownFormatError(ReadError):
    """A stream of no known format; `lines` are its first lines, `guess` a layout to start from, if there is one."""

    def __init__(self, message: str, lines: tuple[str, ...] = (), guess: LayoutGuess | None = None) -> None:
        super().__init__(message)
        self.lines = lines
        self.guess = guess


class Decoder(Protocol):
    """Bytes to rows of numbers, in one recognised format."""

    name: str
    metadata: dict[str, str]
    over: str

    @property
    def units(self) -> Mapping[str, str]:
        """Columns and their units; ``time`` where the device stamps its samples."""

    def rows(self, data: bytes) -> Array:
        """Return the rows that these bytes complete, shape (n, columns)."""

    def finish(self) -> Array:
        """Return the rows left at the end."""

    def cut(self) -> None:
        """Forget what is incomplete, as nothing will complete it."""


class LineStream:
    """One stream: bytes with their arrival times to recordings of a few rows.

    Parameters
    ----------
    source
        Name of its source in messages.
    layout
        Layout of a foreign stream.
    polled
        Whether the other side may have to be polled (serial ports and TCP).
    units
        Units of sensors or columns, in place of those that the stream or the layout says.
    """

    def __init__(
        self,
        source: str,
        layout: Layout | None = None,
        *,
        polled: bool = False,
        units: Mapping[str, str] | None = None,
    ) -> None:
        self.counts = Counts()
        self.format = ""
        self.to_send = b""
        self._source, self._layout, self._polled, self._stated = source, layout, polled, units or {}
        self._units: dict[str, str] = {}
        self._held: list[tuple[bytes, float]] = []
        self._first: float | None = None
        self._asked: float | None = None
        self._decoder: Decoder | None = None
        self._device: DeviceClock | SharedClock | None = None
        self._again: Array | None = None
        self._arrival: ArrivalClock | None = None

    def feed(self, data: bytes, arrival: float) -> list[Recording]:
        """Return the recordings that these bytes complete; without bytes only time passes.

        Raises
        ------
        UnknownFormatError
            Two seconds have passed, and the stream has no known format.
        """
        if self._decoder is not None:
            blocks = self._blocks([(data, arrival)])
            self._poll(bool(blocks), arrival)
            return blocks
        self._poll(bool(data), arrival)
        if data:
            self._first = arrival if self._first is None else self._first
            self._held.append((data, arrival))
        if self._first is None or (arrival - self._first < FIRST and sum(len(d) for d, _ in self._held) < _MOST):
            return []
        return self._begin()

    def finish(self) -> list[Recording]:
        """Return the recordings left at the end of the stream.

        Raises
        ------
        UnknownFormatError
            It ended before it was recognised, and has no known format.
        """
        blocks = self._begin() if self._decoder is None and self._held else []
        if self._decoder is None:
            return blocks
        return blocks + self._timed([(self._decoder.finish(), self._held[-1][1])])

    def cut(self) -> None:
        """Go on after an interruption: what was incomplete is left out, and the pause counts as no lost samples."""
        if self._decoder is None:
            self._held, self._first = [], None
            return
        self._decoder.cut()
        if isinstance(self._device, SharedClock):
            self._again = None  # samples that waited for the next stamp
        for clock in (self._device, self._arrival):
            if clock is not None:
                clock.cut()

    def begin_with(self, layout: Layout) -> list[Recording]:
        """Return the recordings of an unknown stream's beginning, read so; what came since then is left out."""
        self._layout = layout
        blocks = self._begin()
        self.cut()
        return blocks

    @property
    def over(self) -> str:
        """Reason why nothing more of the stream can be read; empty while it can."""
        return f"{self._source}: {self._decoder.over}" if self._decoder is not None and self._decoder.over else ""

    def _begin(self) -> list[Recording]:
        head = b"".join(data for data, _ in self._held)
        self._decoder = decoder = self._recognise(head)
        self.format = decoder.name
        stated = units_of_columns(decoder.units, self._stated, self._source) if self._stated else {}
        self._units = {**decoder.units, **stated}
        self._polled = self._polled and isinstance(decoder, Msp)
        if "time" not in decoder.units:
            self._arrival = ArrivalClock(self.counts)
        held, self._held = self._held, self._held[-1:]
        return self._blocks(held)

    def _blocks(self, pieces: list[tuple[bytes, float]]) -> list[Recording]:
        assert self._decoder is not None
        self._held = pieces[-1:]
        return self._timed([(self._decoder.rows(data), arrival) for data, arrival in pieces])

    def _timed(self, pieces: list[tuple[Array, float]]) -> list[Recording]:
        pieces = [(rows, arrival) for rows, arrival in pieces if len(rows)]
        if self._arrival is not None and len(pieces) > 1:
            self._arrival.begin([len(rows) for rows, _ in pieces], [arrival for _, arrival in pieces])
        if self._arrival is None and self._device is None and pieces:
            self._device = self._clock_of_stamps(np.concatenate([rows for rows, _ in pieces]))
        blocks = [self._recording(rows, arrival) for rows, arrival in pieces]
        return [block for block in blocks if len(block)]

    def _recording(self, rows: Array, arrival: float) -> Recording:
        assert self._decoder is not None
        units = dict(self._units)
        if self._again is not None:
            rows = np.concatenate([self._again, rows])
        columns = dict(zip(units, rows.T, strict=True))
        metadata = {"format": self.format, **self._decoder.metadata}
        if isinstance(self._device, SharedClock):
            metadata["time"] = SHARED
        if self._device is not None:
            times, kept, again = self._device.times(columns["time"])
            self._again = rows[again] if again else None
            if len(again) > _MOST_WAITING:
                raise ReadError(
                    f"{self._source}: time stands still at {columns['time'][-1]:.15g} {units['time']} for more than "
                    f"{_MOST_WAITING} samples; expected stamps that rise, or a layout that takes no column time"
                )
            columns = {name: np.ascontiguousarray(column[kept]) for name, column in columns.items()}
            columns["time"] = times[kept]
        elif self._arrival is not None:
            columns = {"time": self._arrival.times(len(rows), arrival)} | columns
            units = {"time": "s"} | units
            metadata["time"] = STRAIGHTENED
        return Recording(columns, units, metadata, self._source)

    def _clock_of_stamps(self, rows: Array) -> DeviceClock | SharedClock:
        """Return the clock of a device by its first rows: whether other readings share the stamps of those before."""
        assert self._decoder is not None
        columns = dict(zip(self._decoder.units, rows.T, strict=True))
        again = np.diff(columns["time"], prepend=np.nan) == 0
        shared = float(np.mean(again & ~same_rows(columns))) > _SHARED
        kind = SharedClock if shared else DeviceClock
        return kind(self._units["time"], self.counts, getattr(self._decoder, "wraps", None))

    def _poll(self, answered: bool, now: float) -> None:
        """Poll a flight controller: when nothing comes without a poll, and again after each answer."""
        self.to_send = b""
        if not self._polled:
            return
        if self._asked is None:
            self._asked = now + _SILENT - _POLL_AGAIN  # a device that sends without a poll gets time to do so
        waited = now - self._asked
        answers = isinstance(self._decoder, Msp)
        silent = answers or not self._held or all(looks_like_msp(d) or d[:1] == b"$" for d, _ in self._held)
        if silent and waited >= (0 if answered else _POLL_AGAIN):
            self.to_send, self._asked = Msp.poll, now

    def _recognise(self, head: bytes) -> Decoder:
        """Return the decoder of a stream, from its first bytes."""
        if self._layout is not None and not self._layout.if_needed:
            return LayoutDecoder(self._layout, self.counts)
        if looks_like_msp(head):
            return Msp(self.counts)
        if looks_like_mavlink(head):
            mavlink = Mavlink(head, self.counts)
            if mavlink.kinds:
                return mavlink
            raise UnknownFormatError(
                f"{self._source}: MAVLink without an inertial message; expected one of RAW_IMU SCALED_IMU "
                "HIGHRES_IMU: ask the autopilot for one (MAV_CMD_SET_MESSAGE_INTERVAL)"
            )
        lines = [line.strip() for line in head.decode("utf-8", "replace").split("\n")[:-1]]
        titles = next((line for line in lines if is_titles(line)), None)
        if titles is not None:
            return Native(titles, self.counts)
        kinds = {line[:1].encode() for line in lines if line[1:2] == ","}
        if _share(lines, lambda line: line.startswith("Raw:") and line.count(",") == 8) > 0.5:
            if _in_steps(lines):
                return MotionCal(self.counts)
            raise self._unknown(head, [line for line in lines if line])
        if b"I" in kinds and _share(lines, lambda line: line[:2] in ("I,", "M,", "T,")) > 0.5:
            return XImu3(kinds, self.counts)
        if self._layout is not None:
            return LayoutDecoder(self._layout, self.counts)
        raise self._unknown(head, [line for line in lines if line])

    def _unknown(self, head: bytes, lines: list[str]) -> UnknownFormatError:
        text = sum(byte in _TEXT for byte in head)
        if text < _MOSTLY * len(head):
            rate = (
                "the baud rate is probably another: try @9600 @57600 @230400 @460800 @921600 behind the port"
                if self._source.startswith("serial:")
                else "expected a stream of text, MAVLink or MSP"
            )
            return UnknownFormatError(
                f"{self._source}: garbage: {len(head) - text} of the first {len(head)} bytes are no text and no "
                f"message that is known; {rate}"
            )
        if not lines:
            return UnknownFormatError(
                f"{self._source}: no line of text has an end among the first {len(head)} bytes; expected lines"
            )
        guess = guess_stream(lines, self._held[-1][1] - self._held[0][1], self._stated)
        shown = tuple(printable(line)[:120] for line in lines[1:6] or lines)
        offered = "--layout FILE.toml says what its columns are" + (", and a guess is offered" if guess else "")
        return UnknownFormatError(
            f"{self._source}: unknown format: {quoted(shown[0])}; {offered}; or let the unit send titles such as "
            "'time [us],accel_x [g],accel_y [g],accel_z [g]'",
            shown,
            guess,
        )


def _in_steps(lines: list[str]) -> bool:
    """Return whether accelerations behind ``Raw:`` are in steps of 1/8192 g: not those of readings in g or m/s^2."""
    lengths = []
    for line in lines:
        fields = line[4:].split(",")
        if line.startswith("Raw:") and len(fields) == 9 and all(map(is_number, fields)):
            lengths.append(float(np.linalg.norm([float(field) for field in fields[:3]])))
    return not lengths or float(np.median(lengths)) > _FEWEST_STEPS or not any("." in line for line in lines)


def _share(lines: list[str], fits: Callable[[str], bool]) -> float:
    """Return the share of lines that fit."""
    return sum(bool(fits(line)) for line in lines) / max(len(lines), 1)
