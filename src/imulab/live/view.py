"""The view of a session at one moment, the fits of further triads, and readings corrected by a fresh record.

Fits of gyroscopes and magnetometers run in their own process beside the session.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Container
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from time import monotonic

import numpy as np

from imulab.columns import triad
from imulab.errors import ImulabError
from imulab.gravity import Gravity
from imulab.live.stamps import Counts
from imulab.procedures.apply import Loaded, apply
from imulab.procedures.tumble.attitudes import find_attitudes
from imulab.procedures.tumble.fit import fit_tumble
from imulab.procedures.views import parameter_rows
from imulab.readers import read
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import STANDARD_GRAVITY

# The view: numbers and sentences that terminal and page draw alike.


_FULL, _HALF, _LITTLE = 0.88, 0.55, 0.2  # sines of the angle from which a side is up, half up or slightly up


@dataclass(frozen=True)
class HeldValues:
    """An attitude: number, upward direction of the body, ``|f| - g``, m/s^2, whether it disagrees, length, s."""

    number: int
    up: tuple[float, ...]
    residual: float | None
    aside: bool
    seconds: float


@dataclass(frozen=True)
class KnownUnit:
    """A parameter in its reading unit, and the ratio of its standard uncertainty to its target, if it has one."""

    name: str
    value: float
    standard_uncertainty: float | None
    unit: str
    share: float | None = None


@dataclass(frozen=True)
class Trouble:
    """Why no samples come: a state, ``absent``, ``silent`` or ``lost``, what to do, and what will happen, in words."""

    state: str
    advice: str
    outlook: str


@dataclass(frozen=True)
class View:
    """A session at one moment.

    Attributes
    ----------
    source, format
        Name of the stream's source, and its format.
    state
        ``waiting``, ``moving``, ``settling``, ``still`` or ``accepted``; ``absent``, ``silent`` or ``lost`` while
        no samples come.
    advice
        What to do now, in one sentence.
    outlook
        What will happen if no samples come; empty while they do.
    seconds, samples, rate
        Length of the stream, s; its samples; samples per second.
    counts
        Faults of the stream.
    up, length
        Upward direction of the body, shape (3,), and length of the reading, in `unit`; None before samples.
    temperature
        degC, if the stream has it.
    hold
        Length of the present hold after trimming, s.
    hold_needed
        Length at which it will be accepted, s, as far as known.
    strip
        The last 10 s, a row each tenth of a second: time before now, s, lowest x y z and highest x y z, in `unit`.
    attitudes
        The kept attitudes.
    wanted
        How many there will be, as far as known.
    parameters
        Parameters of the fit; empty before there are enough attitudes.
    targets
        Each target, with the largest ratio of standard uncertainty to target: met at 1 or below, infinite before a fit.
    next, next_words
        Upward direction to take next, None where none is needed; the same in words.
    enough
        A sentence once the target is met, with the gain of five more attitudes; empty before.
    missing
        What is missing for a record, a few words; empty if one can be made.
    warnings
        All warnings so far.
    """

    source: str
    format: str
    state: str
    advice: str
    outlook: str
    seconds: float
    samples: int
    rate: float
    counts: Counts
    up: tuple[float, ...] | None
    length: float | None
    unit: str
    temperature: float | None
    hold: float
    hold_needed: float
    strip: tuple[tuple[float, ...], ...]
    attitudes: tuple[HeldValues, ...]
    wanted: int
    parameters: tuple[KnownUnit, ...]
    targets: tuple[tuple[str, float], ...]
    next: tuple[float, ...] | None
    next_words: str
    enough: str
    missing: str
    warnings: tuple[str, ...]


def in_words(up: Array) -> str:
    """Return an upward direction of the body in words: ``x down``, ``x half up, z half down``."""
    parts = []
    for size, axis in sorted(zip(abs(up).tolist(), range(3), strict=True), reverse=True):
        if size >= _LITTLE:
            much = "" if size >= _FULL else "half " if size >= _HALF else "slightly "
            parts.append(f"{'xyz'[axis]} {much}{'up' if up[axis] > 0 else 'down'}")
    return ", ".join(parts)


# Readings corrected by a fresh record, to show that it works.


@dataclass(frozen=True)
class CorrectedReading:
    """Length of a block's mean reading, m/s^2, raw (None for counts) and corrected, and its rate, rad/s."""

    raw: float | None
    length: float
    rate: float | None

    def text(self, gravity: float) -> str:
        """Return it in words, with the length against local gravity, m/s^2."""
        off = 1e3 * (self.length - gravity) / STANDARD_GRAVITY
        rate = "" if self.rate is None else f"   rate {np.degrees(self.rate):.3f} deg/s"
        return f"corrected |f| {self.length:.4f} m/s², {off:+.2f} mg from g{rate}"


def corrected_reading(ready: Loaded, block: Recording, *, gyro: bool) -> CorrectedReading:
    """Return the reading of a block, raw and corrected, with its rate where the record has gyroscopes.

    Raises
    ------
    DataError
        The record corrects nothing in the block.
    """
    after = apply(ready, block)

    def length(recording: Recording, sensor: str) -> float:
        return float(np.linalg.norm([recording.si(name).mean() for name in triad(sensor)]))

    raw = None if block.units["accel_x"] == "count" else length(block, "accel")
    return CorrectedReading(raw, length(after, "accel"), length(after, "gyro") if gyro else None)


# Further triads, gyroscopes and magnetometers, fitted to the growing recording.


_REST = 5.0
"""The next fit waits so many times as long as the last one took, so that the session stays fast."""
FURTHER = {"gyro": "gyroscopes", "mag": "magnetometers"}
"""Triads that are fitted beside the accelerometers, by the first part of their columns' names."""
TriadResult = tuple[tuple[KnownUnit, ...], tuple[str, ...]]
"""Parameters of the further triads, and the reasons why some have none."""


class FurtherFits:
    """Fits of a recording that grows, one at a time."""

    def __init__(self, path: str, order: int | str, gravity: Gravity | None) -> None:
        self._given = (path, order, gravity)
        self._process: BaseProcess | None = None
        self._answer: Connection | None = None
        self._begun = self._after = 0.0

    @property
    def ready(self) -> bool:
        """Whether another fit can begin."""
        return self._process is None and monotonic() >= self._after

    def begin(self) -> None:
        """Start a fit of what the file holds now."""
        context = get_context("spawn")
        self._answer, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_fit, args=(theirs, *self._given), daemon=True)
        self._process.start()
        theirs.close()
        self._begun = monotonic()

    def take_result(self) -> TriadResult | None:
        """Return the result of a fit that has ended, or None."""
        if self._process is None or self._answer is None or not self._answer.poll():
            return None
        try:
            result: TriadResult = self._answer.recv()
        except EOFError:
            result = (), ("the fit of the further triads was ended from outside",)
        self._after = monotonic() + _REST * (monotonic() - self._begun)
        self.close()
        return result

    def close(self) -> None:
        """End a running fit."""
        if self._process is not None and self._answer is not None:
            self._process.kill()
            self._process.join(1.0)
            self._answer.close()
            self._process = None


def fit_triads(fit: Callable[[list[str]], Calibration], there: list[str]) -> tuple[Calibration, list[str], list[str]]:
    """Return the record of accelerometers and further triads, the triads in it, and why others are left out.

    Parameters
    ----------
    fit
        Makes a record with these further triads.
    there
        Further triads in the recording, of `FURTHER`.
    """
    try:
        return fit(there), there, []
    except ImulabError:
        if not there:
            raise
    record, further, why = fit([]), list[str](), list[str]()
    for name in there:
        try:
            record, further = fit([*further, name]), [*further, name]
        except ImulabError as error:
            why.append(f"the {FURTHER[name]} are not calibrated: {error}")
    return record, further, why


def further_triads(columns: Container[str]) -> list[str]:
    """Return the further triads in a recording or block with these columns."""
    return [name for name in FURTHER if all(column in columns for column in triad(name))]


def _fit(answer: Connection, path: str, order: int | str, gravity: Gravity | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the session, which ends this process too
    try:
        recording = read(path)
        attitudes = find_attitudes(recording)
        record, further, why = fit_triads(
            lambda names: fit_tumble(attitudes, order=order, gravity=gravity, with_=names).calibration,
            further_triads(recording.columns),
        )
    except ImulabError as error:
        answer.send(((), (str(error),)))
        return
    rows = [row for row in parameter_rows(record) if row.name.split("_")[0] in further or row.name == "dip"]
    answer.send((tuple(KnownUnit(row.name, row.value, row.standard_uncertainty, row.unit) for row in rows), tuple(why)))
