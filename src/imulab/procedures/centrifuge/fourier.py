"""The source's reduction: sums over whole periods at the manifest's rate, as the run streams by.

``A = (2/N) sum D cos(j w_s t)``, ``B`` likewise with the sine, ``N = m T / t`` rounded to the nearest sample; j
counts samples from 0, t is the sampling period, T the table period, m the number of whole periods.

Source: CN102636185A, steps (a) to (e).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from imulab.procedures.centrifuge.cells import FIRST_LOOK, Samples, sampling_period
from imulab.procedures.centrifuge.regress import Complex
from imulab.recording import Array


class PeriodSums:
    """Sums over each whole period, fed block by block through `watch`."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._sums: list[Array] = []
        self._edge: Array | None = None
        self._index = 0
        self._step = 0.0
        self._time = (0.0, 0.0)

    def watch(self, blocks: Iterable[Samples]) -> Iterator[Samples]:
        """Pass blocks on and sum them; the first block must hold what the sampling period is found from."""
        for block in blocks:
            if not self._index:
                if len(block.time) < 2:
                    yield block
                    continue
                self._step = sampling_period(block.time[:FIRST_LOOK])
                self._time = (float(block.time[0]), 0.0)
            self._add(block)
            self._time = (self._time[0], float(block.time[-1]))
            yield block

    @property
    def even(self) -> bool:
        """Whether the samples were evenly spaced over the run, within half a period of sampling."""
        span = self._time[1] - self._time[0]
        return abs(span - (self._index - 1) * self._step) < 0.5 * self._step

    def _add(self, block: Samples) -> None:
        """Sum cosine and sine times the channels and 1 from period to period."""
        count = len(block.time)
        j = np.arange(self._index, self._index + count)
        phase = self._rate * self._step * j
        values = np.vstack([block.channels, np.ones(count)])
        products = np.stack([np.cos(phase) * values, np.sin(phase) * values])
        samples = 2 * np.pi / abs(self._rate) / self._step
        first, last = self._period(self._index, samples), self._period(self._index + count - 1, samples)
        edges = np.round(np.arange(first, last + 1) * samples).astype(np.int64) - self._index
        edges[0] = 0
        sums = np.add.reduceat(products, edges, axis=2)
        if self._edge is not None and self._period(self._index - 1, samples) == first:
            sums[:, :, 0] += self._edge
        elif self._edge is not None:
            self._sums.append(self._edge)
        self._sums += list(np.moveaxis(sums[:, :, :-1], 2, 0))
        self._edge = sums[:, :, -1]
        self._index += count

    @staticmethod
    def _period(sample: int, samples: float) -> int:
        """Number of the period that a sample belongs to; period m begins at sample round(m T / t)."""
        number = int(sample / samples)
        while round((number + 1) * samples) <= sample:
            number += 1
        while round(number * samples) > sample:
            number -= 1
        return number

    def result(self, mean: Array, first: float = 0.0, last: float = np.inf) -> PeriodResult | None:
        """Return the lines over the whole periods between two times after the start, s; None without any.

        Parameters
        ----------
        mean
            Of the static records, taken from the channels, rad/s, shape (k,).
        """
        samples = 2 * np.pi / abs(self._rate) / self._step
        sums = list(self._sums)
        if self._edge is not None and self._index >= round((len(sums) + 1) * samples):
            sums.append(self._edge)  # the run ends with a period
        begin = int(np.ceil(first / self._step / samples - 1e-9))
        end = min(len(sums), int(min(last / self._step / samples + 1e-9, 1e15)))
        if end <= begin:
            return None
        total = np.sum(sums[begin:end], axis=0)
        count = round(end * samples) - round(begin * samples)
        lines = 2 / count * (total[:, :-1] - total[:, -1:] * mean)
        return PeriodResult(lines[0] + 1j * lines[1], end - begin, count)


@dataclass(frozen=True)
class PeriodResult:
    """Lines ``A + i B`` of the channels, shape (k,), over `periods` whole periods of `samples` samples."""

    line: Complex
    periods: int
    samples: int
