"""What happened to each gyro while an array was fused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

NON_FINITE, GATED, STUCK, JUMPED, EXCLUDED, QUIET, HELD, ALONE = (1 << bit for bit in range(8))
"""Flags of a gyro in a sample, as the C core sets them."""
_KINDS = (
    (NON_FINITE, "non-finite"),
    (STUCK, "stuck"),
    (HELD, "held (end of its range?)"),
    (JUMPED, "jumped"),
    (EXCLUDED, "excluded"),
)


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

    def stuck(self) -> set[str]:
        """Return the columns of the gyros that were stuck at any time."""
        return {self.names[a][i] for a, i, kind in self.events if kind == "stuck"}

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
