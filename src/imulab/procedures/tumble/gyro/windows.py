"""Turns without a beginning: Hann windows at the ends of the holds, ramps between them, and the noise of both.

At which instant a hand begins to turn a unit cannot be told to the milliseconds that a scale factor needs, so none is
chosen. Let h_A be a window of integral 1 at the end of hold A, and h_B one at the beginning of hold B. With

u_A = int h_A f dt / |int h_A f dt|,  u_B alike,   w(t) = int_-inf^t (h_A - h_B) dt,   R = prod exp(-[w_i omega_i dt]x)

the directions obey R u_A = u_B to second order of any motion inside the windows: turning dtheta at time t moves u_A by
the share of h_A that is still to come, and the ramp w leaves that share out. A slow beginning inside a window, sway or
tremor cost nothing. Windows of Hann, 1 - cos, see the least of a tremor.

The rate between samples is read in two ways, by cubic splines: through the running sum, as if each sample were the mean
over its interval, and through the samples themselves. Real sensors lie between; half the difference is an uncertainty.

Source: Harris, On the use of windows for harmonic analysis, Proc. IEEE 66 (1978) 51 (Hann); de Boor, A practical guide
to splines, 1978, chapters IX to XI; Savage, J. Guidance Control Dynamics 21 (1998) 19 (rotation vectors).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

import imulab.procedures.tumble._rotation as _rotation
from imulab.estimation.rows import medians
from imulab.recording import Array

LONGEST_WINDOW = 1.0
"""s: longer windows reach into what a hand does in the middle of a hold; shorter ones see more noise."""
_FEWEST_SAMPLES = 6  # of a window, where the hold has as many: with less, Hann's weights are those of one sample
_FINEST = 2.5e-3  # s: of shorter steps, the middle of two readings errs by less than a part per million in usual turns
_MOST_PIECES = 4
_REACH = 10  # samples on each side that a spline is read from: those beyond count by less than 2e-6
_POLE = np.sqrt(3.0) - 2.0  # of the filter that finds the coefficients of a cubic spline
_EFFECTIVE = 2.0 / 3.0
"""1 / int h^2 dt of a Hann window, over its length: a mean of white noise q has the variance q / (effective length)."""
_NO_WEIGHT = 1e-9
_ALL_STILL = 0.999  # of a window's weight
_KNOCKED = 6.0  # medians over the holds: with three differences in each, none of 100 is beyond by chance


class Windows(Struct, frozen=True):
    """Windows by their beginnings and lengths, s, both of shape (n,)."""

    start: Array
    length: Array

    @property
    def stop(self) -> Array:
        """Their ends, s."""
        return self.start + self.length

    def part(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> Windows:
        """Return some of them."""
        return Windows(self.start[chosen], self.length[chosen])

    def weight(self, time: Array) -> Array:
        """Return the integral of each window from its beginning to the times (n, k), shape (n, k)."""
        share = np.clip((time - self.start[:, None]) / self.length[:, None], 0.0, 1.0)
        inside = (share > 0) & (share < 1)
        share[inside] -= np.sin(2 * np.pi * share[inside]) / (2 * np.pi)
        return np.asarray(share, dtype=np.float64)


class HoldEnds(Struct, frozen=True):
    """The windows at the beginning (`first`) and at the end (`last`) of each hold, and all its `neighbours`.

    `hold` says to which hold each of the neighbouring windows belongs.
    """

    first: Windows
    last: Windows
    neighbours: Windows
    hold: NDArray[np.intp]


def hold_ends(start: Array, stop: Array, step: float) -> HoldEnds:
    """Return the windows of holds from first to last sample, s, (n,), of which a sample lasts `step`."""
    start, stop = start - step / 2, stop + step / 2
    duration = stop - start
    length = np.minimum(duration, max(LONGEST_WINDOW, _FEWEST_SAMPLES * step))
    # Neighbours, whose differences tell the noise: of a hold below two windows, its halves.
    short = np.minimum(length, duration / 2)
    count = np.floor(duration / short + 1e-6).astype(np.intp)
    hold = np.repeat(np.arange(len(start)), count)
    number = np.arange(len(hold)) - np.repeat(np.cumsum(count) - count, count)
    neighbours = Windows(start[hold] + number * short[hold], short[hold])
    return HoldEnds(Windows(start, length), Windows(stop - length, length), neighbours, hold)


def hann_means(time: Array, values: Array, windows: Windows) -> Array:
    """Return the Hann-weighted means of columns (k, c) over windows, shape (n, c); nan where one has no sample."""
    first, last = np.searchsorted(time, windows.start), np.searchsorted(time, windows.stop)
    size = last - first
    edges = np.cumsum(size) - size
    index = np.repeat(first - edges, size) + np.arange(int(size.sum()))
    window = np.repeat(np.arange(len(first)), size)
    weight = 1 - np.cos(2 * np.pi * (time[index] - windows.start[window]) / windows.length[window])
    rows = np.column_stack([weight[:, None] * values[index], weight])
    result = np.full((len(first), values.shape[1]), np.nan)
    filled = size > 0
    if filled.any():
        sums = np.add.reduceat(rows, edges[filled], axis=0)
        filled[filled] = weighty = sums[:, -1] > _NO_WEIGHT  # a sample on the edge of a window weighs nothing
        result[filled] = sums[weighty, :-1] / sums[weighty, -1:]
    return result


def noise_density(time: Array, output: Array, still: NDArray[np.bool_], ends: HoldEnds) -> Array:
    """Return the noise of each column, (c,), as the density q of white noise that moves Hann means as much.

    Half the mean square of the differences of neighbouring means is q over the effective length of their windows. What
    is faster than a window, such as vibration, does not count, as it does not in a turn. Windows with samples that are
    not `still`, shape (n,), and knocked holds are left out, unless none is left.
    """
    pairs = _pairs(ends)
    means = hann_means(time, np.column_stack([output, still]), ends.neighbours)
    square = np.diff(means[:, :-1], axis=0)[pairs] ** 2 / 2 * (_EFFECTIVE * ends.neighbours.length[:-1][pairs])[:, None]
    quiet = (np.minimum(means[:-1, -1], means[1:, -1]) > _ALL_STILL)[pairs]
    chosen = quiet if quiet.any() else np.ones_like(quiet)
    return mean_of_holds(square[chosen], ends.hold[:-1][pairs][chosen])


def mean_of_holds(square: Array, hold: NDArray[np.intp]) -> Array:
    """Return the mean of squares (k, c) over those holds whose mean is not far above the usual one, shape (c,)."""
    finite = np.isfinite(square).all(axis=1)
    square, hold = square[finite], hold[finite]
    if not len(square):
        return np.zeros(square.shape[1])
    edges = np.flatnonzero(np.diff(hold, prepend=-1))
    count = np.diff(np.append(edges, len(hold)))
    each = np.add.reduceat(square, edges, axis=0) / count[:, None]
    usual = each <= _KNOCKED * np.asarray(medians(each.T))[None, :]
    return np.asarray(
        [each[kept, k] @ count[kept] / max(int(count[kept].sum()), 1) for k, kept in enumerate(usual.T)],
        dtype=np.float64,
    )


def neighbouring_pairs(ends: HoldEnds) -> tuple[Windows, Windows, NDArray[np.intp]]:
    """Return each window that has a neighbour in its hold, that neighbour, and the hold."""
    pairs = np.flatnonzero(_pairs(ends))
    return ends.neighbours.part(pairs), ends.neighbours.part(pairs + 1), ends.hold[pairs]


def _pairs(ends: HoldEnds) -> NDArray[np.bool_]:
    pairs: NDArray[np.bool_] = np.diff(ends.hold) == 0
    return pairs


# The rate between samples.


class Readings(Struct, frozen=True):
    """The output between samples: shape (m, n, 3), n pieces of equal length for each step of `pieces` of them.

    `middle` of the two readings, and `half` their difference.
    """

    middle: Array
    half: Array
    pieces: int


def pieces_of(step: float) -> int:
    """Return in how many pieces a sampling interval, s, is to be read."""
    return int(np.clip(np.ceil(step / _FINEST - 1e-6), 1, _MOST_PIECES))


def read_between(output: Array, start: NDArray[np.intp], stop: NDArray[np.intp], pieces: int) -> Readings:
    """Return the mean output in the pieces of the sampling intervals from sample `start` to `stop`, (m,) each.

    Beyond the shorter ones it is 0. The splines run over the number of a sample, not over its time: stamps that come in
    bursts do not bend them.
    """
    mean, point = _kernels(pieces)
    shape = (len(start), max(int((stop - start).max()), 1) * pieces, output.shape[1])
    readings = Readings(np.zeros(shape), np.zeros(shape), pieces)
    _rotation.between(
        np.ascontiguousarray(output, dtype=np.float64), output.shape[1],
        np.ascontiguousarray(np.hstack([(mean + point) / 2, (mean - point) / 2])),
        np.ascontiguousarray(start, dtype=np.int64), np.ascontiguousarray(stop, dtype=np.int64), pieces,
        readings.middle, readings.half,
    )  # fmt: skip
    return readings


@cache
def _kernels(pieces: int) -> tuple[Array, Array]:
    """Weights of the samples around a step in the mean over each of its pieces, (2 _REACH, pieces), in both readings.

    The step is from sample 0 to sample 1. A sample as a mean lasts from half a step before it to half a step after it.
    """
    edges, far = np.arange(pieces + 1) / pieces, np.arange(1 - 3 * _REACH, 3 * _REACH + 1)
    kept = slice(2 * _REACH, 4 * _REACH)
    point = np.diff(_cardinal(_b_spline_integral, edges - far[:, None]), axis=1) * pieces
    # The running sum up to the edge behind sample k holds all samples up to k.
    change = np.diff(_cardinal(_b_spline, edges - 0.5 - far[:, None]), axis=1) * pieces
    mean = np.cumsum(change[::-1], axis=0)[::-1]
    return mean[kept] / mean[kept].sum(axis=0), point[kept] / point[kept].sum(axis=0)


def _cardinal(function: Callable[[Array], Array], at: Array) -> Array:
    """The spline through 1 at 0 and 0 at all other whole numbers, or its integral, by that of a B-spline."""
    shift = np.arange(-4 * _REACH, 4 * _REACH + 1)
    values: Array = function(at[..., None] - shift) @ (np.sqrt(3.0) * _POLE ** np.abs(shift))
    return values


def _b_spline(x: Array) -> Array:
    """Cubic B-spline about 0, on whole numbers."""
    return _powers(x, 3) / 6


def _b_spline_integral(x: Array) -> Array:
    """Its integral up to x."""
    return _powers(np.minimum(x, 2.0), 4) / 24


def _powers(x: Array, power: int) -> Array:
    total = np.zeros_like(x)
    for k, binomial in enumerate((1, -4, 6, -4, 1)):
        total += binomial * np.maximum(x + 2 - k, 0.0) ** power
    return np.where(np.abs(x) < 2, total, 0.0) if power == 3 else total
