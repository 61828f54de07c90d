"""What happened to each gyro while an array was fused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

NON_FINITE, GATED, STUCK, JUMPED, EXCLUDED, QUIET, ALONE = 1, 2, 4, 8, 16, 32, 128
"""Flags of a gyro in a sample, as the C core sets them."""
_FEWEST_TO_CORRELATE = 100
_AGAINST = 0.9
_KINDS = ((NON_FINITE, "non-finite"), (STUCK, "stuck"), (JUMPED, "jumped"), (EXCLUDED, "excluded"))


@dataclass
class Event:
    """How often a gyro was in one state, and when first: sample count, time, s."""

    samples: int
    first: float


@dataclass
class Health:
    """Counts the flags of each gyro over the blocks of a recording."""

    names: Sequence[Sequence[str]]
    total: int = 0
    lost: int = 0
    few: int = 0
    events: dict[tuple[int, int, str], Event] = field(default_factory=dict)

    def watch(self, time: np.ndarray, flags: np.ndarray | None, rate: np.ndarray) -> list[tuple[int, int, str]]:
        """Count the flags (m, axes, n) of a block; return what is new: axis, element and kind."""
        self.total += len(time)
        self.lost += int(np.isnan(rate).any(axis=1).sum())
        new: list[tuple[int, int, str]] = []
        if flags is None or not flags.any():
            return new
        self.few += int((flags & ALONE).any(axis=(1, 2)).sum()) - int(np.isnan(rate).any(axis=1).sum())
        any_flag = np.bitwise_or.reduce(flags, axis=0)
        for a, i in zip(*np.nonzero(any_flag), strict=True):
            for bit, kind in _KINDS:
                if not any_flag[a, i] & bit:
                    continue
                held = (flags[:, a, i] & bit) > 0
                key = (int(a), int(i), kind)
                event = self.events.get(key)
                if event is None:
                    self.events[key] = Event(int(held.sum()), float(time[int(np.argmax(held))]))
                    new.append(key)
                else:
                    event.samples += int(held.sum())
        return new

    def first(self, key: tuple[int, int, str]) -> str:
        """Return a line on the first time that a gyro was in a state."""
        axis, element, kind = key
        return f"{self.names[axis][element]}: {kind} at {self.events[key].first:.6g} s"

    def lines(self) -> list[str]:
        """Return one line per gyro that was excluded, stuck, jumped or non-finite, and one where all were lost."""
        found = []
        gyros = sorted({(a, i) for a, i, _ in self.events})
        for a, i in gyros:
            parts = [
                f"{kind} {_samples(event.samples)} from {event.first:.6g} s"
                for _, kind in _KINDS
                if (event := self.events.get((a, i, kind))) is not None
            ]
            found.append(f"{self.names[a][i]}: {'; '.join(parts)} (of {_samples(self.total)})")
        if self.few > 0:
            found.append(
                f"fewer than three gyros left in {_samples(self.few)}: nothing to compare with, equal weights there"
            )
        if self.lost:
            found.append(f"no gyro left in {_samples(self.lost)}: the output is nan there")
        return found


def _samples(count: int) -> str:
    return f"{count} sample{'' if count == 1 else 's'}"


@dataclass
class Turned:
    """Tells whether gyros of an axis are mounted the other way round, from readings before any alignment.

    Under motion the readings of gyro i and gyro 1 correlate at +1 or -1; at rest, and on axes that are swapped, in
    between: then nothing is said.
    """

    names: Sequence[Sequence[str]]
    count: float = 0.0
    sums: np.ndarray | None = None

    def watch(self, readings: np.ndarray) -> None:
        """Add the moments of readings, shape (m, axes, n); samples with a reading that is not finite do not count."""
        fine = readings[np.isfinite(readings).all(axis=(1, 2))]
        first = fine[:, :, :1]
        sums = np.array([fine.sum(axis=0), (fine * fine).sum(axis=0), (fine * first).sum(axis=0)])
        self.sums = sums if self.sums is None else self.sums + sums
        self.count += len(fine)

    def lines(self) -> list[str]:
        """Return one line where some gyros turn against gyro 1 of their axis."""
        if self.sums is None or self.count < _FEWEST_TO_CORRELATE:
            return []
        mean, square, product = self.sums / self.count
        spread = np.sqrt(np.maximum(square - mean * mean, 0.0))
        scale = spread * spread[:, :1]
        covariance = product - mean * mean[:, :1]
        against = covariance < -_AGAINST * scale
        named = [self.names[a][i] for a, i in zip(*np.nonzero(against & (scale > 0)), strict=True)]
        if not named:
            return []
        verb = "turns" if len(named) == 1 else "turn"
        return [
            f"{' '.join(named)} {verb} against the first gyro of the axis: mounted the other way round? "
            "array calibrate --moving finds it, and --calibration puts it right"
        ]
