"""The clock of the gyroscopes: how far it can be trusted, and what the accelerometers' clock says of it.

A scale factor is output per angle and time: a clock that runs fast by 1000 ppm makes all three 1000 ppm too large, and
no turn shows it. Where the accelerometers are stamped by another clock, both see the same turns. In each of them the
accelerometers' direction of gravity follows the one that the gyroscopes carry, with a delay; the line through the
delays over time is the difference of the clocks. Acceleration of the unit along its path is odd about the middle of a
turn, the speed even: it does not move the delay to first order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.procedures.tumble.gyroturns import Segments
from imulab.procedures.tumble.rotation import frame_rotations
from imulab.recording import Array
from imulab.verdict import Note

CRYSTAL = 50 * 1e-6  # as '50 ppm' is read, so that the two compare equal
"""Standard uncertainty of the rate of a clock that nothing is known of but that a crystal drives it."""
_KNOT = 0.05  # s
_LAGS = np.linspace(-2.0, 2.0, 21)  # s
_STEPS = 6
_CLEAR = 2.58
_CLEAR_DELAY = 4.0
_OUTLIER = 4.0 * MAD_TO_SIGMA
_FEWEST = 6
_LATENCY = 5e-3  # s
_JITTER, _COUNTED = 0.02, 1e-6  # of a step
_FEWEST_STAMPS = 100


@dataclass(frozen=True)
class Comparison:
    """The accelerometers' time less the gyroscopes', ``delay + rate (t - middle)``, with standard uncertainties; s."""

    delay: float
    delay_uncertainty: float
    rate: float
    rate_uncertainty: float
    middle: float
    turns: int

    def on_other(self, time: Array) -> Array:
        """Return times of the gyroscopes' clock on that of the accelerometers."""
        return np.asarray(time + self.delay + self.rate * (time - self.middle), dtype=np.float64)

    def variance(self, clock: float) -> float:
        """Of the difference of the rates, if each clock has this relative standard uncertainty."""
        return 2 * clock**2 + self.rate_uncertainty**2

    def clear(self, clock: float) -> bool:
        """Whether two such clocks do not explain the difference (at 1 %)."""
        return bool(abs(self.rate) > _CLEAR * math.sqrt(self.variance(clock)))


@dataclass(frozen=True)
class Clock:
    """What the time is known by that the scale factors are referred to.

    Attributes
    ----------
    uncertainty, assumed
        Relative standard uncertainty of the rate of the clock in use, and as assumed of any.
    of
        Whose it is.
    comparison
        Of the two clocks, or None.
    counted
        Whether the gyroscopes' time stamps are a count times a nominal step, which no clock measured.
    """

    uncertainty: float
    assumed: float
    of: str
    comparison: Comparison | None
    counted: bool = False

    def notes(self, *, apart: bool) -> list[str]:
        """Say what a user should know; `apart`: the two triads come from two recordings."""
        found = self.comparison
        if found is None:
            return []
        if self.of == "gyro" and found.clear(self.assumed):
            return [
                f"gyro: the accelerometers' clock runs {1e6 * found.rate:+.0f} ppm (u "
                f"{1e6 * found.rate_uncertainty:.0f} ppm) against the gyroscopes': if the gyroscopes' is wrong, so are "
                "all their scale factors, by as much; their uncertainty covers it. If the accelerometers' clock is the "
                "true one, use --clock-of accel"
            ]
        late = -found.delay
        if not apart and abs(late) > max(_LATENCY, _CLEAR_DELAY * found.delay_uncertainty):
            return [
                Note(
                    f"gyro: its samples come {1e3 * late:+.1f} ms after the accelerometers' of the same time (u "
                    f"{1e3 * found.delay_uncertainty:.1f} ms): harmless here, where turns go from hold to hold, not in "
                    "a filter that uses both"
                )
            ]
        return []


def clock_of_scale(comparison: Comparison | None, clock: float, of: str, *, counted: bool) -> Clock:
    """Return what is known of the clock that the scale factors are referred to.

    Parameters
    ----------
    comparison
        Of the two clocks, or None.
    clock
        Relative standard uncertainty of the rate of the clock that `of` names.
    of
        ``gyro``: the gyroscopes' own stamps count; what two such clocks leave of the difference is added to it.
        ``accel``: they were carried over to the accelerometers' clock.
    """
    more = 0.0
    if comparison is not None and of == "accel":
        more = comparison.rate_uncertainty**2
    elif comparison is not None:
        more = max(comparison.rate**2 - comparison.variance(clock), 0.0)
    return Clock((clock**2 + more) ** 0.5, clock, of, comparison, counted)


def counted(time: Array) -> bool:
    """Whether time stamps are a count times a step, to rounding."""
    step = np.diff(time)
    return bool(np.ptp(step) < _COUNTED * float(step.mean()) + 8 * np.spacing(np.abs(time).max()))


def evened(time: Array) -> tuple[Array, float] | None:
    """Return even time stamps in place of some that jitter, and by how much they do, rms, s; None where they do not.

    Samples of a sensor that runs by itself come evenly, while a host stamps them when it gets to it. Stamps are
    replaced by a line through them, between gaps.
    """
    step = np.diff(time)
    middle = float(np.median(step))
    gap = step > 1.5 * float(step.mean()) + 8 * MAD_TO_SIGMA * float(np.median(np.abs(step - middle)))
    even = time.copy()
    edges = np.concatenate([[0], np.flatnonzero(gap) + 1, [len(time)]])
    for start, stop in pairwise(edges.tolist()):
        if stop - start >= _FEWEST_STAMPS:
            number = np.arange(stop - start) - (stop - start - 1) / 2
            stamps = time[start:stop] - time[start:stop].mean()
            even[start:stop] -= stamps - number * float(number @ stamps) / float(number @ number)
    jitter = float(np.sqrt(np.mean((time - even) ** 2)))
    return (even, jitter) if jitter > _JITTER * float(step.mean()) and (np.diff(even) > 0).all() else None


def compare_clocks(
    own: Array, force: Array, time: Array, rate: Array, segments: Segments, *, search: bool
) -> Comparison | None:
    """Compare the clocks of the two triads; None where fewer than six turns tell.

    Parameters
    ----------
    own, force
        Time of the accelerometers' samples, s, (k,), and their specific force, m/s^2, (k, 3).
    time, rate
        Time of the gyroscopes' samples, s, (n,), and the body rate, rad/s, (n, 3).
    segments
        The turns, on the gyroscopes' clock.
    search
        Whether delays up to two seconds are to be expected.
    """
    step = max(_KNOT, 2 * float(np.median(np.diff(own))))
    knots, seen = _carried_gravity(time, rate, segments, step)
    moved = np.gradient(seen, axis=1)
    spacing = np.gradient(knots, axis=1)
    speed = moved / np.where(spacing > 0, spacing, np.inf)[:, :, None]
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(own)[:, None], axis=0)])

    def missing(delay: Array) -> Array:
        """Direction that the accelerometers see, later by `delay` (m,), less what the gyroscopes carry."""
        at = knots + delay[:, None]
        parts = [np.interp(at + step / 2, own, column) - np.interp(at - step / 2, own, column) for column in sums.T]
        vector = np.stack(parts, axis=2)
        length = np.linalg.norm(vector, axis=2, keepdims=True)
        return np.asarray(vector / np.maximum(length, 1e-300) - seen, dtype=np.float64)

    delay = np.zeros(len(seen))
    if search:
        costs = np.array([(missing(delay + lag) ** 2).sum(axis=(1, 2)) for lag in _LAGS.tolist()])
        delay = _LAGS[np.argmin(costs, axis=0)]
    power = (speed**2).sum(axis=(1, 2))
    for _ in range(_STEPS):
        delay = delay - np.clip((missing(delay) * speed).sum(axis=(1, 2)) / np.maximum(power, 1e-300), -0.3, 0.3)
    return _line((segments.start + segments.stop) / 2, delay)


def _carried_gravity(time: Array, rate: Array, segments: Segments, step: float) -> tuple[Array, Array]:
    """Knots of each turn (m, k), the last one repeated, and the direction of gravity there, (m, k, 3).

    By how much a turn misses at its end is spread over it in proportion to the angle turned.
    """
    start, stop = np.searchsorted(time, segments.start), np.searchsorted(time, segments.stop)
    samples = max(1, round(step / float(np.median(np.diff(time[start[0] : stop[0] + 1])))))
    count = -(-int((stop - start).max()) // samples)
    index = np.minimum(start[:, None] + samples * np.arange(count + 1), stop[:, None])
    m = len(start)
    turn = frame_rotations(rate, time, index[:, :-1].ravel(), index[:, 1:].ravel()).reshape(m, count, 3, 3)
    up = np.empty((m, count + 1, 3))
    up[:, 0] = segments.before
    for k in range(count):
        up[:, k + 1] = np.einsum("mij,mj->mi", turn[:, k], up[:, k])
    path = np.concatenate([np.zeros((m, 1)), np.cumsum(np.linalg.norm(np.diff(up, axis=1), axis=2), axis=1)], axis=1)
    share = path / np.maximum(path[:, -1:], 1e-300)
    return time[index], up + share[:, :, None] * (segments.after - up[:, -1])[:, None, :]


def _line(when: Array, delay: Array) -> Comparison | None:
    """Line through the delays, those left out that stand out from it (by the median slope of all pairs)."""
    if len(when) < _FEWEST:
        return None
    i, j = np.triu_indices(len(when), 1)
    slope = float(np.median((delay[j] - delay[i]) / (when[j] - when[i])))
    left = delay - slope * when
    left = left - np.median(left)
    kept = np.abs(left) <= max(_OUTLIER * float(np.median(np.abs(left))), 1e-9)
    n = int(kept.sum())
    if n < _FEWEST:
        return None
    middle = float(when[kept].mean())
    centred, mean = when[kept] - middle, float(delay[kept].mean())
    spread = float((centred**2).sum())
    rate = float((centred * delay[kept]).sum()) / spread
    scatter = float(np.sqrt(((delay[kept] - mean - rate * centred) ** 2).sum() / (n - 2)))
    return Comparison(mean, scatter / n**0.5, rate, scatter / spread**0.5, middle, n)
