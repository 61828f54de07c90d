"""Regression of a run's channels on its lines, from cells: at given rates, with rates refined, and its noise.

Model of each channel: constant, trend, and cosine and sine of chi, 2 chi, 3 chi and of the net angle. Noise of a line
is taken from the scatter of the line over blocks of the run (batch means): it holds for coloured noise as long as
that is no longer correlated than a block.

Sources: IEEE Std 1057 (four-parameter sine fit); Fishman, Management Science 24 (1978) 510 (batch means).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.centrifuge.cells import (
    CHI,
    CHI2,
    CHI3,
    COLUMNS,
    CONSTANT,
    NET,
    TIME,
    TIME_CHI,
    TIME_NET,
    Cells,
)
from imulab.recording import Array

Complex = NDArray[np.complex128]

SIZE = 10
TREND, LINE, SECOND, THIRD, ROOM = 1, 2, 4, 6, 8
"""Rows of the solution: constant is 0, then trend; lines at chi, 2 chi, 3 chi; the line at the net rate."""
_BLOCKS = 64
_SINGULAR = 1e-7
_STEPS = 30


@dataclass(frozen=True)
class Regression:
    """Lines of all channels of a run.

    Attributes
    ----------
    coefficients
        Shape (10, k), rad/s (the trend per half duration); zero where a column was left out.
    inverse
        Inverse of the normal matrix: covariance per unit variance of a sample, shape (10, 10).
    table_shift, net_shift
        What was added to the cells' rates, rad/s.
    middle, half
        Centre of the run and half its duration, s.
    kept
        Columns that the run could tell apart, shape (10,).
    """

    coefficients: Array
    inverse: Array
    table_shift: float
    net_shift: float
    middle: float
    half: float
    kept: NDArray[np.bool_]

    def line(self, row: int) -> Complex:
        """Return ``A + i B`` of all channels, with the phase that the cells' angle has at the middle of the run."""
        pair: Complex = self.coefficients[row] + 1j * self.coefficients[row + 1]
        return pair

    def gain(self, row: int) -> float:
        """Variance of one component of a line per variance of a sample; 2/N for a long run."""
        return float(self.inverse[row, row] + self.inverse[row + 1, row + 1]) / 2


def basis(cells: Cells, middle: float, half: float, table_shift: float, net_shift: float) -> Array:
    """Return the ten columns of the model in those of the cells, shape (c, 14, 10)."""
    since = cells.centre - middle
    P = np.zeros((len(since), COLUMNS, SIZE))
    P[:, CONSTANT, 0] = 1.0
    P[:, CONSTANT, TREND], P[:, TIME, TREND] = since / half, 1 / half
    for row, column, times, linear, shift in (
        (LINE, CHI, 1, TIME_CHI, table_shift),
        (SECOND, CHI2, 2, None, table_shift),
        (THIRD, CHI3, 3, None, table_shift),
        (ROOM, NET, 1, TIME_NET, net_shift),
    ):
        c, s = np.cos(times * shift * since), np.sin(times * shift * since)
        P[:, column, row], P[:, column + 1, row] = c, -s
        P[:, column, row + 1], P[:, column + 1, row + 1] = s, c
        if linear is not None:
            P[:, linear, row], P[:, linear + 1, row] = -shift * s, -shift * c
            P[:, linear, row + 1], P[:, linear + 1, row + 1] = shift * c, -shift * s
    return P


def solve(cells: Cells, table_shift: float = 0.0, net_shift: float = 0.0) -> Regression:
    """Regress all channels at the cells' rates plus the given shifts."""
    middle, half = _span(cells)
    P = basis(cells, middle, half, table_shift, net_shift)
    normal, right = _normal(cells, P)
    kept = _independent(normal)
    inverse = np.zeros((SIZE, SIZE))
    inverse[np.ix_(kept, kept)] = _inverse(normal[np.ix_(kept, kept)])
    return Regression(inverse @ right, inverse, table_shift, net_shift, middle, half, kept)


def _span(cells: Cells) -> tuple[float, float]:
    half = cells.duration / 2
    return float(np.average(cells.centre, weights=cells.moments[:, CONSTANT, CONSTANT])), half


def _normal(cells: Cells, P: Array) -> tuple[Array, Array]:
    carried = cells.moments[:, :COLUMNS, :COLUMNS] @ P
    # Many small products, which no threads are spent on, rather than one long and thin one.
    turned = P.transpose(0, 2, 1)
    normal = (turned @ carried).sum(axis=0)
    right = (turned @ cells.moments[:, :COLUMNS, COLUMNS:]).sum(axis=0)
    return normal, right


def _independent(normal: Array) -> NDArray[np.bool_]:
    """Which columns to keep: without the net line, then without harmonics and trend, where they are not distinct."""
    kept = np.ones(SIZE, dtype=np.bool_)
    for drop in ((ROOM, ROOM + 1), (THIRD, THIRD + 1), (SECOND, SECOND + 1), (TREND,)):
        part = normal[np.ix_(kept, kept)]
        scale = np.sqrt(np.maximum(np.diagonal(part), np.finfo(float).tiny))
        if np.linalg.eigvalsh(part / np.outer(scale, scale))[0] > _SINGULAR:
            break
        kept[list(drop)] = False
    return kept


def _inverse(normal: Array) -> Array:
    scale = np.sqrt(np.diagonal(normal))
    inverse: Array = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    return inverse


@dataclass(frozen=True)
class Refined:
    """Shifts of the table rate and of the net rate that fit a channel best, and their variance per sample variance."""

    table_shift: float
    net_shift: float
    table_gain: float
    net_gain: float


def refine(cells: Cells, channel: int, table_shift: float | None, net_shift: float | None) -> Refined | None:
    """Fit rates together with all lines of one channel, from good starts; None where that does not converge.

    The four-parameter sine fit of IEEE Std 1057, with the other lines, constant and trend in the model. A shift that is
    given as None stays at zero.
    """
    middle, half = _span(cells)
    shifts = [table_shift or 0.0, net_shift or 0.0]
    start = list(shifts)
    free = [value is not None for value in (table_shift, net_shift)]
    gains = [0.0, 0.0]
    reach = np.pi / half
    for _ in range(_STEPS):
        P = basis(cells, middle, half, *shifts)
        normal, right = _normal(cells, P)
        kept = _independent(normal)
        if not kept[ROOM]:
            free[1] = False
        if not any(free):
            return Refined(*shifts, *gains)
        beta = np.zeros(SIZE)
        beta[kept] = np.linalg.solve(normal[np.ix_(kept, kept)], right[kept, channel])
        extra = []
        for row, linear, on in ((LINE, TIME_CHI, free[0]), (ROOM, TIME_NET, free[1])):
            if on:
                extra.append(_rate_column(cells, P, beta, row, linear, middle, half))
        both = np.concatenate([P[:, :, kept], np.stack(extra, axis=2)], axis=2)
        normal, right = _normal(cells, both)
        score = right[:, channel] - normal[:, : int(kept.sum())] @ beta[kept]
        inverse = _inverse(normal)
        step = (inverse @ score)[-len(extra) :] / half
        variance = np.diagonal(inverse)[-len(extra) :] / half**2
        for index, (value, gain) in zip(np.flatnonzero(free), zip(step, variance, strict=True), strict=True):
            shifts[index] += float(value)
            gains[index] = float(gain)
            if abs(shifts[index] - start[index]) > reach:
                return None
        if np.abs(step).max() * half < 1e-10:
            break
    return Refined(*shifts, *gains)


def _rate_column(cells: Cells, P: Array, beta: Array, row: int, linear: int, middle: float, half: float) -> Array:
    """Derivative of a line with respect to its rate times `half`, in the columns of the cells, shape (c, 14)."""
    turned = beta[row + 1] * P[:, :, row] - beta[row] * P[:, :, row + 1]
    column: Array = turned * ((cells.centre - middle) / half)[:, None]
    own = {TIME_CHI: CHI, TIME_NET: NET}[linear]
    column[:, linear : linear + 2] += turned[:, own : own + 2] / half
    return column


@dataclass(frozen=True)
class Scatter:
    """A line's scatter over blocks.

    Attributes
    ----------
    noise
        Variance of a sample that white noise would need to scatter the line so, shape (k, k), Hermitian.
    freedom
        Degrees of freedom of each of its diagonal elements.
    deviation
        Line of each block less that of the run, shape (m, k).
    centre, gain
        Of each block: time, s, and variance of a component per variance of a sample, shapes (m,).
    edges
        First cell of each block, and the end, shape (m + 1,).
    """

    noise: Complex
    freedom: float
    deviation: Complex
    centre: Array
    gain: Array
    edges: NDArray[np.int64]


def scatter(
    cells: Cells, solution: Regression, row: int = LINE, *, least: float = 0.0, blocks: int = _BLOCKS
) -> Scatter | None:
    """Return the scatter of a line over blocks of at least `least` seconds; None with fewer than three of them.

    Each block has a constant of its own, and a trend where it holds two cells or more, so that slow drift does not pass
    for noise at the line.
    """
    per_block = max(1.0, least / (cells.cell * cells.step))
    count = min(blocks, int(len(cells.centre) / per_block))
    if count < 3:
        return None
    P = basis(cells, solution.middle, solution.half, solution.table_shift, solution.net_shift)
    left = cells.moments[:, :COLUMNS, COLUMNS:] - cells.moments[:, :COLUMNS, :COLUMNS] @ (P @ solution.coefficients)
    edges = np.round(np.linspace(0, len(cells.centre), count + 1)).astype(int)
    weights = cells.moments[:, CONSTANT, CONSTANT]
    total = np.add.reduceat(weights, edges[:-1])
    centre = np.add.reduceat(weights * cells.centre, edges[:-1]) / total
    local = np.concatenate([P[:, :, :2], P[:, :, row : row + 2]], axis=2)
    since = cells.centre - np.repeat(centre, np.diff(edges))
    local[:, CONSTANT, 1] = since / solution.half
    if np.diff(edges).min() < 2:
        local = np.delete(local, 1, axis=2)
    normal = np.add.reduceat(
        local.transpose(0, 2, 1) @ cells.moments[:, :COLUMNS, :COLUMNS] @ local, edges[:-1], axis=0
    )
    score = np.add.reduceat(local.transpose(0, 2, 1) @ left, edges[:-1], axis=0)
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return None
    fitted = (inverse @ score)[:, -2:]
    deviation = fitted[:, 0] + 1j * fitted[:, 1]
    gain = (inverse[:, -1, -1] + inverse[:, -2, -2]) / 2
    if not (np.isfinite(gain).all() and gain.min() > 0):  # blocks too short to tell the line from their constant
        return None
    noise = np.einsum("m,mi,mj->ij", 1 / gain, deviation, deviation.conj()) / (2 * (count - 1))
    return Scatter(noise, 2.0 * (count - 1), deviation, centre, gain, edges)
