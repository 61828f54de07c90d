"""What happened to each gyro while an array was fused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

NON_FINITE, GATED, STUCK, JUMPED, EXCLUDED, QUIET, ALONE = 1, 2, 4, 8, 16, 32, 128
"""Flags of a gyro in a sample, as the C core sets them."""
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
                f"{kind} {self.events[a, i, kind].samples} samples from {self.events[a, i, kind].first:.6g} s"
                for _, kind in _KINDS
                if (a, i, kind) in self.events
            ]
            found.append(f"{self.names[a][i]}: {'; '.join(parts)} (of {self.total} samples)")
        if self.few > 0:
            found.append(
                f"fewer than three gyros left in {self.few} samples: nothing to compare with, equal weights there"
            )
        if self.lost:
            found.append(f"no gyro left in {self.lost} samples: the output is nan there")
        return found
