"""Least squares over a sweep, block by block: what a run of 10^7 samples takes is a few columns of memory.

Sums of products of the columns and the outputs, apart for each batch of the run, say all that is asked: coefficients,
what they leave of a column, and their covariance by the scores of the batches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array

ONE, TIME, RATE, SQUARE, CUBE, TURN, BOW, *DERIVATIVES = range(11)
"""Places of the columns of `regressors`: 1, time from its mean, s, the rate, its powers, 1 where it rises and -1 where
it falls, that times the square of the rate over its largest, and its four derivatives."""
WHOLE = 8.8
"""Steps that eight steps take at most where no sample is missing."""
_BATCHES, _BLOCK = 32, 1 << 15
_POWERS = np.vander(np.arange(-4.0, 5.0), increasing=True).T
KERNELS = np.linalg.solve(_POWERS, np.diag([1.0, 1.0, 2.0, 6.0, 24.0, 0.0, 0.0, 0.0, 0.0]))[:, 1:5].T
"""Four derivatives of polynomials of degree 8, over the spacing to the power of their order, shape (4, 9)."""


@dataclass(frozen=True)
class Samples:
    """The samples of a sweep, n of them, that have four neighbours on either side, without a gap between.

    Attributes
    ----------
    time, outputs
        s, and of each gyroscope, shape (n,).
    rate
        Of the table, of all samples, rad/s.
    first
        Which sample of `rate` the first neighbour of each is, shape (n,); None where they follow one another.
    side, spacing
        Samples, and time, s, from neighbour to neighbour.
    """

    time: Array
    outputs: list[Array]
    rate: Array
    first: NDArray[np.int64] | None
    side: int
    spacing: float

    def neighbours(self, part: slice) -> Array:
        """Return the rate at the nine neighbours of each of n samples, the middle one itself, shape (9, n)."""
        shifts = [k * self.side for k in range(9)]
        if self.first is None:
            return np.array([self.rate[part.start + shift : part.stop + shift] for shift in shifts])
        return np.array([self.rate[self.first[part] + shift] for shift in shifts])


def with_neighbours(time: Array, rate: Array, outputs: Sequence[Array], side: int, step: float) -> Samples:
    """Return the samples that have neighbours `side` samples apart, without a gap between."""
    whole = time[8 * side :] - time[: len(rate) - 8 * side] < WHOLE * side * step
    first = None if whole.all() else np.flatnonzero(whole)
    which = slice(4 * side, len(rate) - 4 * side) if first is None else first + 4 * side
    return Samples(time[which], [output[which] for output in outputs], rate, first, side, side * step)


def blocks(count: int) -> Iterator[tuple[int, slice]]:
    """Yield the parts of `count` samples, each small enough for a cache, with the number of its batch."""
    edges = np.linspace(0, count, _BATCHES + 1).astype(np.int64).tolist()
    for batch, (first, last) in enumerate(pairwise(edges)):
        for start in range(first, last, _BLOCK):
            yield batch, slice(start, min(start + _BLOCK, last))


@dataclass(frozen=True)
class Moments:
    """Sums of products of c columns and g outputs over each batch of a run, shape (batches, c + g, c + g)."""

    batches: Array
    columns: int

    @property
    def whole(self) -> Array:
        """Sums over all batches, shape (c + g, c + g)."""
        return np.asarray(self.batches.sum(axis=0))

    def variance(self, column: int) -> float:
        """Return the variance of a column; column 0 is that of ones."""
        whole = self.whole
        return float(whole[column, column] / whole[0, 0] - (whole[column, 0] / whole[0, 0]) ** 2)

    def fitted(self, columns: Sequence[int], output: int) -> Array:
        """Return the coefficients of columns that make up an output."""
        return self._solved(columns, self.columns + output)

    def left_of(self, column: int, others: Sequence[int]) -> float:
        """Return the sum of squares that others leave of a column."""
        return float(self.whole[column, column] - self.whole[column, others] @ self._solved(others, column))

    def covariance(self, columns: Sequence[int], fitted: Sequence[int], output: int, found: Array) -> Array:
        """Return the covariance of coefficients of columns by what coefficients `found` of columns `fitted` leave.

        By the scores of parts of the run, so that what is left may be correlated; each score stands for what the fit
        took from its part, too. Source: Bell and McCaffrey, Survey Methodology 28 (2002) 169.
        """
        both = self.batches[:, columns]
        size, normal = self._normal(columns)
        scores = (both[:, :, self.columns + output] - both[:, :, fitted] @ found) / size
        spread, turn = np.linalg.eigh(normal)
        half = turn * np.sqrt(np.maximum(spread, 0.0)) @ turn.T
        share, turn = np.linalg.eigh(half @ (both[:, :, columns] / np.outer(size, size)) @ half)
        kept = np.einsum("bji,bj->bi", turn, scores @ half) / np.sqrt(np.maximum(1 - share, 1 / _BATCHES))
        scores = np.einsum("bij,bj->bi", turn, kept) @ half / size
        return np.asarray(scores.T @ scores)

    def _normal(self, columns: Sequence[int]) -> tuple[Array, Array]:
        """Return the size of columns, and the inverse of the sums of their products over it."""
        whole = self.whole[np.ix_(columns, columns)]
        size = np.sqrt(np.diag(whole))
        size = np.where(size > 0, size, 1.0)
        return size, np.linalg.pinv(whole / np.outer(size, size))

    def _solved(self, columns: Sequence[int], column: int) -> Array:
        size, normal = self._normal(columns)
        return np.asarray(normal @ (self.whole[columns, column] / size) / size)


def moments(count: int, columns: Callable[[slice], Sequence[Array] | Array], outputs: Sequence[Array]) -> Moments:
    """Return the sums of products of what `columns` returns for each part of `count` samples, and the outputs."""
    found, number = None, 0
    for batch, part in blocks(count):
        made = columns(part)
        rows = np.array([*made, *(output[part] for output in outputs)])
        found = np.zeros((_BATCHES, len(rows), len(rows))) if found is None else found
        number = len(made)
        found[batch] += rows @ rows.T
    assert found is not None
    return Moments(found, number)


def regressors(samples: Samples, felt: Array | None = None) -> Moments:
    """Return the sums of products of the rate's powers, branches and derivatives, a constant, time, and the outputs.

    The branches are those of the rate as the gyroscopes felt it, where that is known.
    """
    middle, largest = float(samples.time.mean()), float(np.abs(samples.rate).max())
    rises = None if felt is None else rising(felt)
    scales = samples.spacing ** -np.arange(1.0, 5.0)

    def columns(part: slice) -> list[Array]:
        near = samples.neighbours(part)
        rate = near[4]
        derivatives = scales[:, None] * (KERNELS @ near)
        square = rate**2
        turn = np.sign(derivatives[0]) if rises is None else np.where(rises[part], 1.0, -1.0)
        loop = turn, turn * (square if felt is None else felt[part] ** 2) / largest**2
        return [np.ones(len(rate)), samples.time[part] - middle, rate, square, square * rate, *loop, *derivatives]

    return moments(len(samples.time), columns, samples.outputs)


def rising(rate: Array) -> NDArray[np.bool_]:
    """Return whether a rate rises at each sample, shape (n,)."""
    rises = np.empty(len(rate), dtype=bool)
    rises[1:-1], rises[0], rises[-1] = rate[2:] > rate[:-2], rate[1] > rate[0], rate[-1] > rate[-2]
    return rises


def felt_rate(samples: Samples, weights: Array) -> Array:
    """Return the rate and its four derivatives, each times its weight (5,), at each of n samples, shape (n,)."""
    taps = (weights[1:] * samples.spacing ** -np.arange(1.0, 5.0)) @ KERNELS
    taps[4] += weights[0]
    found = np.empty(len(samples.time))
    for _, part in blocks(len(found)):
        found[part] = taps @ samples.neighbours(part)
    return found
