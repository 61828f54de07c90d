"""Detection of rest, sample by sample with bounded memory, and the mean outputs at rest.

As in `find_attitudes`, the recording is cut into short blocks, windows slide over them, and the unit is at rest where
the variance of a window is not much above that of the quietest window so far.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from imulab.procedures.tumble.attitudes import FINEST_STEP, POOL_DEGREES, SMALLEST_BLOCK
from imulab.recording import Array

BLOCK = 0.1  # s over which the scatter of samples is computed, as in a recording
WINDOW, TRIM = 6, 3
"""Blocks of a window, and blocks left out at both ends of a hold."""
SHORTEST, SURE = 12, 15
"""Blocks, after trimming, of a hold that counts once it has ended, and of one that is accepted while it lasts.

`find_attitudes` needs 10; its threshold is another.
"""
_THRESHOLD = 10.0  # times the quiet variance up to which the unit rests
_LOUDEST = 0.03
"""A window with a larger variance than this part of the reading, squared, is not at rest."""
_SAME = 2e-3  # of g: a hold that differs less from the one before is the same attitude, as in a recording
# Histogram of log10 of the variances: bins, lower end, and bins in a decade
_BINS, _LOWEST, _PER_DECADE = 1200, -22.0, 50
_QUIET = 0.05  # quantile of the variances that is the quiet one
_GAP, _GAP_STEPS = 0.25, 6.0  # s, and usual steps: a longer gap ends a hold, as in a recording
_LEARNED = 50  # samples that show the usual step


@dataclass(frozen=True)
class Hold:
    """A stretch at rest: times, s, mean output with its covariance, and length in blocks after trimming."""

    start: float
    stop: float
    mean: Array
    covariance: Array
    blocks: int
    resumed: bool = False

    @property
    def seconds(self) -> float:
        """Length after trimming, s."""
        return self.blocks * BLOCK


@dataclass(frozen=True)
class Moment:
    """State after a block (``moving``, ``settling`` or ``still``), its mean and range, the present or ended hold."""

    time: float
    state: str
    mean: Array
    low: Array
    high: Array
    constant: tuple[bool, bool, bool]
    hold: Hold | None = None
    ended: Hold | None = None


class Stillness:
    """Samples to moments, one for each tenth of a second."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._rest_times: Array = np.empty(0)
        self._rest: Array = np.empty((0, 3))
        self._length = 0
        self._step = 0.0
        self._window: deque[tuple[Array, Array]] = deque(maxlen=WINDOW)
        self._histogram = np.zeros(_BINS, dtype=np.int64)
        self._resolution: Array = np.full(3, np.inf)
        self._pooled: Array = np.zeros((3, 3))
        self._freedom = 0
        self._pending: deque[Array] = deque()
        self._hold: _Sum | None = None
        self._last: _Sum | None = None

    @property
    def moving(self) -> bool:
        """Whether the unit was not at rest in the last window."""
        return self._hold is None

    def feed(self, times: Array, values: Array) -> list[Moment]:
        """Return the moments that these samples complete; times in s, shape (n,), outputs of shape (n, 3)."""
        times, values = np.concatenate([self._rest_times, times]), np.concatenate([self._rest, values])
        if not self._length:
            if len(times) < _LEARNED:
                self._rest_times, self._rest = times, values
                return []
            self._step = float(np.median(np.diff(times)))
            self._length = max(SMALLEST_BLOCK, round(BLOCK / self._step))
        count = len(times) // self._length
        moments = []
        for k in range(count):
            part = slice(k * self._length, (k + 1) * self._length)
            moments.append(self._block(times[part], values[part]))
        self._rest_times, self._rest = times[count * self._length :], values[count * self._length :]
        return moments

    def _block(self, times: Array, values: Array) -> Moment:
        if np.diff(times).max() > max(_GAP, _GAP_STEPS * self._step):
            self._window.clear()  # no window reaches across a gap
        mean, scatter = values.mean(axis=0), values.var(axis=0, ddof=1)
        self._learn_resolution(values)
        self._window.append((mean, scatter))
        state, ended = "moving", None
        variance = self._variance()
        limit = self._limit(variance, mean)
        if variance <= limit:
            state = "still"
            self._go_on(mean, float(times[0]), float(times[-1]))
        else:
            ended = self._end()
            if len(self._window) > 1 and all(s.sum() <= limit for _, s in list(self._window)[-2:]):
                state = "settling"
        hold = None if self._hold is None else self._made(self._hold)
        constant = scatter == 0
        return Moment(
            float(times[-1]), state, mean, values.min(axis=0), values.max(axis=0),
            (bool(constant[0]), bool(constant[1]), bool(constant[2])), hold, ended,
        )  # fmt: skip

    def _variance(self) -> float:
        """Return the variance of the window, summed over the axes; infinite until it is full."""
        if len(self._window) < WINDOW:
            return np.inf
        means, scatters = (np.array(part) for part in zip(*self._window, strict=True))
        return float(scatters.mean(axis=0).sum() + means.var(axis=0).sum())

    def _limit(self, variance: float, mean: Array) -> float:
        """Return the variance below which a window is at rest, with this window included."""
        size = float(mean @ mean) or 1.0
        if np.isfinite(variance):
            place = int((np.log10(max(variance / size, 10**_LOWEST)) - _LOWEST) * _PER_DECADE)
            self._histogram[min(max(place, 0), _BINS - 1)] += 1
        total = int(self._histogram.sum())
        if not total:
            return 0.0
        place = int(np.searchsorted(np.cumsum(self._histogram), _QUIET * total, side="left"))
        quiet = size * 10 ** (_LOWEST + (place + 1) / _PER_DECADE)
        steps = self._resolution[np.isfinite(self._resolution)]
        quiet = max(quiet, float((steps**2).sum()) / 12)
        return min(_THRESHOLD * quiet, _LOUDEST**2 * size)

    def _learn_resolution(self, values: Array) -> None:
        """Follow the smallest step of each output: rounding keeps the variance above it."""
        for axis in range(3):
            steps = np.diff(np.unique(values[:, axis]))
            if steps.size:
                self._resolution[axis] = min(self._resolution[axis], float(steps.min()))

    def _go_on(self, mean: Array, start: float, stop: float) -> None:
        """Add a block to the hold; the last blocks wait, because a motion may begin in them."""
        if self._hold is None:
            recent = np.mean([each for each, _ in list(self._window)[-TRIM:]], axis=0)
            last = self._last
            if last is not None and np.linalg.norm(recent - last.mean) < _SAME * np.linalg.norm(last.mean):
                self._hold, last.resumed = last, True
            else:
                self._hold = _Sum(start)
            self._pending = deque(each for each, _ in list(self._window)[-TRIM:])
        else:
            self._pending.append(mean)
        while len(self._pending) > TRIM:
            self._hold.add(self._pending.popleft())
            self._hold.stop = stop

    def _end(self) -> Hold | None:
        """End the hold, if there is one, and return it; its scatter updates the quiet variance."""
        if self._hold is None:
            return None
        ended, self._hold = self._hold, None
        if not ended.count:
            return None
        if not ended.resumed:
            self._pooled += ended.squares
            self._freedom += ended.count - 1
        self._last = ended
        return self._made(ended)

    def _made(self, total: _Sum) -> Hold | None:
        if not total.count:
            return None
        squares, freedom = total.squares, max(total.count - 1, 0)
        spread = self._pooled / self._freedom if self._freedom else squares / max(freedom, 1)
        spread = (POOL_DEGREES * spread + squares) / (POOL_DEGREES + freedom)
        if not np.any(spread):
            finest = FINEST_STEP * np.abs(total.mean).max()
            spread = np.diag(np.where(np.isfinite(self._resolution), self._resolution, finest) ** 2 / 12)
        return Hold(total.start, total.stop, total.mean.copy(), spread / total.count, total.count, total.resumed)


class _Sum:
    """Running mean and sum of squares of blocks (Welford 1962)."""

    def __init__(self, start: float) -> None:
        self.start = self.stop = start
        self.count = 0
        self.mean: Array = np.zeros(3)
        self.squares: Array = np.zeros((3, 3))
        self.resumed = False

    def add(self, mean: Array) -> None:
        self.count += 1
        delta = mean - self.mean
        self.mean = self.mean + delta / self.count
        self.squares = self.squares + np.outer(delta, mean - self.mean)
