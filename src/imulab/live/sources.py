"""Sources of a live stream: serial ports, sockets, standard input, files, and a simulated unit.

Each source returns the bytes that came with their time of arrival. Reads that block run in a thread, so that neither a
fit nor a slow screen overflows the operating system's buffer. `imulab.live.links` opens ports and sockets.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from typing import Any

import numpy as np

from imulab.errors import OptionError, ReadError, meant
from imulab.live.links import CHUNK, GONE, AbsentError, Link, LinkKind, reason, serial_link, tcp_link, udp_link
from imulab.procedures.tumble.simulate import simulate_tumble
from imulab.quantities import number, quantity, whole_number
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY, from_si

# Simulated unit: turned by the guide, by hand, or from one random attitude to the next.


_LONGEST = 60.0  # s of a hold of the simulated unit
_STRUCK, _SHIFT = 0.5, 5e-3 * STANDARD_GRAVITY
"""s after an attitude is put down when it is knocked (before it is accepted), and by how much, m/s^2."""
_KEYS = ("seed", "order", "rate", "noise", "hold", "move", "unit", "gravity", "knock", "gyro", "field", "dip", "speed")
_KINDS = {
    "rate": ("frequency", "Hz"),
    "noise": ("acceleration", "mg"),
    "hold": ("time", "s"),
    "move": ("time", "s"),
    "gravity": ("acceleration", "m/s^2"),
    "field": ("magnetic field", "uT"),
    "dip": ("angle", "deg"),
}


@dataclass
class SimulatedUnit:
    """A simulated unit that is turned while its samples are read.

    Attributes
    ----------
    seed, order, rate, noise, move, unit, gravity
        As for `simulate_tumble`, in SI.
    hold
        Duration of an attitude where nobody turns the unit, s.
    knock
        Number of an attitude, from 1, that is knocked as soon as it is put down, or None.
    gyro
        Whether it has gyroscopes.
    field, dip
        Magnitude of the magnetic field, T, and its dip, rad, for magnetometers; None without them.
    follow
        Whether `turn_to` turns it; otherwise it turns by itself, until `turn_by_hand` does.
    """

    seed: int = 1
    order: int = 2
    rate: float = 100.0
    noise: float = 0.7e-3 * STANDARD_GRAVITY
    hold: float = 5.0
    move: float = 2.0
    unit: str = "m/s^2"
    gravity: float = STANDARD_GRAVITY
    knock: int | None = None
    gyro: bool = False
    field: float | None = None
    dip: float = math.radians(67.0)
    follow: bool = False
    _held: bool = dataclass_field(default=False, init=False)
    _wanted: Array | None = dataclass_field(default=None, init=False)
    _field_here: Array | None = dataclass_field(default=None, init=False)

    def turn_to(self, direction: Array) -> None:
        """Turn until this direction of the body is up, if the unit follows the guide."""
        if self.follow and not self._held:
            self._wanted = direction

    def turn_by_hand(self, direction: Array) -> None:
        """Turn until this direction of the body is up; from then on the unit is turned by hand alone."""
        self._held, self._wanted = True, direction

    def blocks(self, step: float) -> Iterator[Recording]:
        """Yield its samples, `step` seconds in each block, without end."""
        rng = np.random.default_rng(self.seed)
        here = _random_direction(rng)
        known: dict[str, float] = {}
        metadata: dict[str, str] = {}
        size, row, legs = max(1, round(step * self.rate)), 0, 0
        there = here
        while True:
            leg = self._leg(here, there, known, legs)
            if not legs:
                metadata = dict(leg.metadata)
                known = {
                    key.removeprefix("truth_"): float(text)
                    for key, text in metadata.items()
                    if key.startswith("truth_")
                }
            legs, here = legs + 1, there
            stay = round((self.move if legs > 1 else 0.0) * self.rate)
            for start in range(0, len(leg), size):
                part = {name: column[start : start + size] for name, column in leg.columns.items()}
                count = len(part["time"])
                part["time"] = (row + np.arange(count)) / self.rate
                row += count
                yield Recording(part, leg.units, metadata, "simulated unit")
                alone = not (self.follow or self._held)
                if alone and start + size >= stay and (start + size - stay) / self.rate >= self.hold:
                    self._wanted = _random_direction(rng)
                if self._wanted is not None and np.allclose(self._wanted, here):
                    self._wanted = None  # asked for again while the unit was being lifted
                if self._wanted is not None and start + size >= stay:
                    break
            there, self._wanted = here if self._wanted is None else self._wanted, None

    def _leg(self, here: Array, there: Array, known: dict[str, float], number: int) -> Recording:
        """Return the samples of turning from one attitude to the next and lying there."""
        recording = simulate_tumble(
            attitudes=np.vstack([here, there]),
            order=self.order,
            truth=known or None,
            gravity=self.gravity,
            rate=self.rate,
            hold=_LONGEST,
            move=self.move,
            noise=self.noise,
            unit=self.unit,
            gyro=self.gyro,
            field=self.field if self._field_here is None else self._field_here,
            dip=self.dip,
            seed=self.seed if not number else 1000 * (self.seed + 1) + number,
        )
        if self.field is not None:
            # The next turn begins with the field at the end of this one.
            self._field_here = np.array([recording.si(f"truth_mag_{axis}")[-1] for axis in "xyz"])
        resting = round(_LONGEST * self.rate)
        # The first attitude, and one that lasts longer than expected, have no turn before them.
        first = 0 if not number or np.allclose(here, there) else resting
        names = [name for name in recording.columns if not name.startswith("truth_")]
        last = resting if first == 0 else len(recording)
        columns = {name: recording.columns[name][first:last] for name in names}
        if self.knock == number + 1:
            struck = round((self.move + _STRUCK) * self.rate)
            for axis, up in zip("xyz", there.tolist(), strict=True):
                columns[f"accel_{axis}"][struck:] += from_si(_SHIFT, self.unit) * up
        return replace(recording, columns=columns, units={name: recording.units[name] for name in names})


def simulated_unit(text: str, *, follow: bool) -> tuple[SimulatedUnit, float]:
    """Return the unit and its speed that a text such as ``seed=3,noise=0.5mg,speed=0`` describes.

    Raises
    ------
    OptionError
        A key is unknown, or a value cannot be used.
    """
    settings: dict[str, Any] = {}
    for pair in text.split(",") if text else []:
        key, equals, value = (part.strip() for part in pair.partition("="))
        where = f"simulate: {key}"
        if key not in _KEYS or not equals:
            keys = " ".join(f"{each} [{_KINDS[each][1]}]" if each in _KINDS else each for each in _KEYS)
            raise OptionError(
                f"simulate:{text}: expected key=value, the keys being {keys}, bare numbers in these units"
                f"{meant(_KEYS, key)}"
            )
        if key == "unit":
            settings[key] = value
        elif key == "speed":
            settings[key] = number(value, where)
        elif key in _KINDS:
            settings[key] = quantity(value, where, *_KINDS[key])
        else:
            settings[key] = whole_number(value, where)
    if settings.setdefault("gyro", 0) not in (0, 1):
        raise OptionError(f"simulate: gyro {settings['gyro']}: expected 1 (with gyroscopes) or 0")
    settings["gyro"] = bool(settings["gyro"])
    speed = settings.pop("speed", 1.0)
    if not 0 <= speed <= 1e6:
        raise OptionError(f"simulate: speed {speed:g}; expected 0 (as fast as it goes) to 1e6")
    unit = SimulatedUnit(**settings, follow=follow)
    replace(unit)._leg(np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), {}, 0)  # refuses impossible settings
    return unit, speed


def _random_direction(rng: np.random.Generator) -> Array:
    direction = rng.standard_normal(3)
    unit: Array = direction / np.linalg.norm(direction)
    return unit


# Sources.


KINDS = ("serial:PORT[@BAUD]", "udp:PORT", "tcp:HOST:PORT", "-", "replay:FILE[@SPEED]", "simulate[:key=value,..]")
_STEP = 0.05  # s of a block of a replay or a simulation
_AGAIN = 0.5  # s between two attempts to open a lost link
_MOST_QUEUED = 1 << 22  # bytes that wait to be handed on: 10 s of a fast port, for the longest fit


@dataclass(frozen=True, slots=True)
class Arrived:
    """Bytes, or decoded samples, with their time of arrival, s on the source's clock."""

    data: bytes | Recording
    time: float


class LiveSource:
    """Base of all sources.

    Attributes
    ----------
    name
        Name in messages.
    polled
        Whether it can be polled.
    ended
        Whether nothing more will come.
    lost
        Why the link is lost, while it is; the reason of an unexpected end.
    absent
        Why there has been no link yet, where nobody is at its other end; empty otherwise.
    comes_back
        Whether a lost link is opened again.
    unread_share
        Share of the bytes that were lost because they came faster than they were handed on.
    by_hand
        Whether it is a simulated unit, which `turn_by_hand` turns.
    """

    polled = by_hand = comes_back = False
    unread_share = 0.0
    absent = ""

    def __init__(self, name: str) -> None:
        self.name = name
        self.ended = False
        self.lost = ""

    def get(self, wait: float) -> list[Arrived]:
        """Return what comes within `wait` seconds, or nothing."""
        raise NotImplementedError

    def now(self) -> float:
        """Return the time on the clock of arrivals, s."""
        return time.monotonic()

    def send(self, data: bytes) -> None:
        """Send bytes to the unit, if the source can."""

    def turn_to(self, direction: Array) -> None:
        """Turn a simulated unit that follows the guide until this direction of the body is up."""

    def turn_by_hand(self, direction: Array) -> None:
        """Turn a simulated unit until this direction of the body is up, as if by hand."""

    def close(self) -> None:
        """Release what the source holds."""


class Linked(LiveSource):
    """A unit at a link, which a thread reads and opens again where it is lost, and standard input.

    A server where nobody listens yet is waited for.
    What waits to be handed on is bounded. Beyond that a sender that can be held back (a pipe, TCP) has to wait; bytes
    of any other are lost, and counted. No bytes, with a time, are handed on where a link is open again.
    """

    def __init__(self, kind: LinkKind, *, comes_back: bool = True) -> None:
        super().__init__(kind.name)
        self.polled, self.comes_back = kind.polled, comes_back
        self._kind = kind
        try:
            self._link = kind.open()
        except AbsentError as error:
            self._link, self.absent = Link(lambda: b""), str(error)
        self._changed = threading.Condition()
        self._pieces: deque[Arrived] = deque()
        self._queued = self._taken = self._unread = 0
        self._over = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"imulab {self.name}")
        self._thread.start()

    def _run(self) -> None:
        if self.absent:
            self._open_again()
        while not self._stop.is_set():
            try:
                data = self._link.read()
            except GONE as error:
                if self._stop.is_set():
                    break
                self.lost = f"{self.name}: the connection is lost ({reason(error)}): unplugged?"
                if not self.comes_back or not self._open_again():
                    break
                continue
            if data is None:
                break
            if data:
                self._put(Arrived(data, time.monotonic()), len(data))
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _open_again(self) -> bool:
        """Open a lost link again; return whether it is open, and not the source closed."""
        with suppress(*GONE):
            self._link.close()
        while not self._stop.wait(_AGAIN):
            with suppress(ReadError, OSError):
                self._link, self.lost, self.absent = self._kind.open(), "", ""
                self._put(Arrived(b"", time.monotonic()), 0)
                return True
        return False

    def _put(self, piece: Arrived, size: int) -> None:
        """Queue bytes once there is room, or lose them."""
        with self._changed:
            if self._kind.held_back:
                self._changed.wait_for(lambda: self._queued < _MOST_QUEUED or self._stop.is_set())
            self._taken += size
            if self._queued >= _MOST_QUEUED:
                self._unread += size
                self.unread_share = self._unread / max(self._taken, 1)
                return
            self._pieces.append(piece)
            self._queued += size
            self._changed.notify_all()

    def get(self, wait: float) -> list[Arrived]:
        """Return what comes within `wait` seconds, not all at once where much has waited."""
        arrived: list[Arrived] = []
        size = 0
        with self._changed:
            self._changed.wait_for(lambda: self._pieces or self._over, wait)
            while self._pieces and size < CHUNK:
                arrived.append(self._pieces.popleft())
                size += len(arrived[-1].data)
            self._queued -= size
            self.ended = self.ended or (self._over and not self._pieces)
            self._changed.notify_all()
        return arrived

    def send(self, data: bytes) -> None:
        """Send bytes; that the link is lost is found by the reading thread."""
        if self._link.write is not None:
            with suppress(*GONE):
                self._link.write(data)

    def close(self) -> None:
        """End the thread and close the link."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join(0.5)
        with suppress(*GONE):
            self._link.close()


class Paced(LiveSource):
    """Blocks of samples that are replayed or simulated at `speed` times their pace; 0 is without waiting."""

    def __init__(self, name: str, blocks: Iterator[Recording], speed: float) -> None:
        super().__init__(name)
        self._blocks, self._speed = blocks, speed
        self._begun: float | None = None
        self._first = self._time = 0.0
        self._waiting: Arrived | None = None

    def get(self, wait: float) -> list[Arrived]:
        """Return the next block once its time has come."""
        if self._waiting is None:
            block = next(self._blocks, None)
            if block is None:
                self.ended = True
                return []
            times = block.time
            end = self._time + _STEP if times is None or not len(times) else float(times[-1])
            self._waiting = Arrived(block, end)
        if self._begun is None:
            self._begun, self._first = time.monotonic(), self._waiting.time
        if self._speed:
            left = self._begun + (self._waiting.time - self._first) / self._speed - time.monotonic()
            if left > 0:
                time.sleep(min(left, wait))
                if left > wait:
                    return []
        arrived, self._waiting = self._waiting, None
        self._time = arrived.time
        return [arrived]

    def now(self) -> float:
        """Return the time of the last block."""
        return self._time


class Simulated(Paced):
    """A simulated unit, which can follow the guide."""

    by_hand = True

    def __init__(self, name: str, unit: SimulatedUnit, speed: float) -> None:
        super().__init__(name, unit.blocks(_STEP), speed)
        self.unit = unit

    def turn_to(self, direction: Array) -> None:
        """Turn the unit."""
        self.unit.turn_to(direction)

    def turn_by_hand(self, direction: Array) -> None:
        """Turn the unit."""
        self.unit.turn_by_hand(direction)


def open_source(
    text: str, layout: str | None = None, *, units: Mapping[str, str] | None = None, follow: bool = False
) -> LiveSource:
    """Return the open source that a text names.

    Parameters
    ----------
    text
        ``serial:PORT[@BAUD]``, ``udp:PORT``, ``tcp:HOST:PORT``, ``-``, ``replay:FILE[@SPEED]`` or
        ``simulate[:key=value,..]``.
    layout, units
        Layout, and stated units, of a replayed file.
    follow
        Whether a simulated unit follows the guide.

    Raises
    ------
    OptionError
        There is no such kind of source, or a part of its name is missing.
    ReadError
        The port, address or file cannot be opened; the message says what to do.
    """
    kind, _, rest = text.partition(":")
    if follow and kind != "simulate":
        raise OptionError(f"--follow: expected a simulated unit (simulate), found {text!r}")
    if text == "-":
        pipe = Link(lambda: os.read(0, CHUNK) or None)
        return Linked(LinkKind("standard input", lambda: pipe, held_back=True), comes_back=False)
    kinds = {"serial": serial_link, "udp": udp_link, "tcp": tcp_link}
    if kind in kinds and rest:
        return Linked(kinds[kind](rest))
    if kind == "replay" and rest:
        return _replay(rest, layout, units)
    if kind == "simulate":
        if units:
            raise OptionError(
                "--unit: expected a source that is connected or replayed; simulate:unit=g is of a simulated unit"
            )
        unit, speed = simulated_unit(rest, follow=follow)
        return Simulated("simulated unit", unit, speed)
    hint = meant([*kinds, "replay", "simulate"], kind)
    raise OptionError(f"source {text!r}: expected one of {' '.join(KINDS)}{hint}")


def _replay(rest: str, layout: str | None, units: Mapping[str, str] | None) -> LiveSource:
    from imulab.estimation.sampling import mend_blocks
    from imulab.readers import read_blocks
    from imulab.readers.streams import on_clock_of

    path, at, text = rest.rpartition("@")
    speed = 1.0
    if at and path and not os.path.lexists(rest):
        speed = number(text, f"replay:{rest}: speed")
    else:
        path = rest
    if not 0 <= speed <= 1e6:
        raise OptionError(f"replay:{rest}: speed {speed:g}; expected 0 (as fast as it goes) to 1e6")
    blocks = mend_blocks(on_clock_of(read_blocks(path, layout, units=units)))
    return Paced(f"replay:{path}", _slices(blocks), speed)


def _slices(blocks: Iterator[Recording]) -> Iterator[Recording]:
    """Yield blocks of a file in pieces of a twentieth of a second."""
    for block in blocks:
        times = block.time
        if times is None:
            raise ReadError(
                f"{block.name}: a table of attitudes has no time to be replayed; imulab tumble fit takes it"
            )
        ends = np.flatnonzero(np.diff(np.floor((times - times[0]) / _STEP)) != 0) + 1
        for start, stop in zip([0, *ends.tolist()], [*ends.tolist(), len(times)], strict=True):
            columns = {name: column[start:stop] for name, column in block.columns.items()}
            yield Recording(columns, block.units, block.metadata, block.name)
