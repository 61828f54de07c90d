"""What is to be seen of a session at one moment: numbers and sentences that a terminal and a page draw alike."""

from __future__ import annotations

from dataclasses import dataclass

from imulab.live.stamps import Counts
from imulab.recording import Array

_FULL, _HALF, _LITTLE = 0.88, 0.55, 0.2


@dataclass(frozen=True)
class Held:
    """An attitude: its number, upward direction of the body, ``|f| - g``, m/s^2, whether it disagrees, length, s."""

    number: int
    up: tuple[float, ...]
    residual: float | None
    aside: bool
    seconds: float


@dataclass(frozen=True)
class Known:
    """A parameter as people read it, and its standard uncertainty over its target where it has one."""

    name: str
    value: float
    standard_uncertainty: float | None
    unit: str
    share: float | None = None


@dataclass(frozen=True)
class View:
    """A session at one moment.

    Attributes
    ----------
    source, format
        Where the stream comes from, and what it is.
    state
        ``waiting``, ``moving``, ``settling``, ``still`` or ``accepted``.
    advice
        What to do now, in one sentence.
    seconds, samples, rate
        Length of the stream, s; its samples; samples per second.
    counts
        What was wrong with it.
    up, length
        Upward direction of the body, shape (3,), and length of the reading, in `unit`; None before samples.
    temperature
        degC, where the stream has it.
    hold
        How long the present hold is, trimmed, s.
    attitudes
        Those that are kept.
    wanted
        How many there will be, as far as can be told.
    parameters
        Of the fit; empty before there are enough attitudes.
    targets
        Each target and the worst standard uncertainty over it: met at 1 or below, infinite before a fit.
    next, next_words
        Upward direction to take next, None where none is needed; in words.
    enough
        A sentence once the target is met, with what five more attitudes would bring; empty before.
    why_not
        Why there is no fit; empty where there is one.
    warnings
        All that were given.
    """

    source: str
    format: str
    state: str
    advice: str
    seconds: float
    samples: int
    rate: float
    counts: Counts
    up: tuple[float, ...] | None
    length: float | None
    unit: str
    temperature: float | None
    hold: float
    attitudes: tuple[Held, ...]
    wanted: int
    parameters: tuple[Known, ...]
    targets: tuple[tuple[str, float], ...]
    next: tuple[float, ...] | None
    next_words: str
    enough: str
    why_not: str
    warnings: tuple[str, ...]


def in_words(up: Array) -> str:
    """Return an upward direction of the body in words: ``x down``, ``x half up, z half down``."""
    parts = []
    for size, axis in sorted(zip(abs(up).tolist(), range(3), strict=True), reverse=True):
        if size >= _LITTLE:
            much = "" if size >= _FULL else "half " if size >= _HALF else "slightly "
            parts.append(f"{'xyz'[axis]} {much}{'up' if up[axis] > 0 else 'down'}")
    return ", ".join(parts)
