"""Elements of an array that answer late, and their alignment in spite of it.

An element whose readings come later by tau than the others' reads ``A w(t - tau) = A w - tau A dw/dt + ...``: what the
consensus leaves of it goes with the derivative of the consensus. The regression on that gives tau to a fraction of a
sample, and is repeated on readings moved by it (cubic splines) until it stands still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.gyro_array.align import Alignment, align
from imulab.recording import Array

_STEPS = 8
_BLOCKS = 20
_CLEAR = 4.0
_HARMLESS = 1e-4  # s; 5 ppm of scale factor in motion at 5 Hz
_SETTLED = 0.02  # standard uncertainties
_GAP = 1.5
_BESIDE = 4  # samples beside a gap that a spline does not follow
_FEWEST = 100
_LONGEST = 0.1  # s, of a step


def align_in_time(time: Array, readings: Array, white: Array, truth: Array | None = None) -> Alignment:
    """Align elements as `align` does, after those that are late were moved by their latency.

    Where no latency is clear (four standard uncertainties) and above 0.1 ms, the readings are taken as they are.

    Parameters
    ----------
    time
        s, shape (m,).
    readings, white, truth
        As for `align`.

    Raises
    ------
    ObservabilityError
        The motion does not excite every axis.
    """
    count = readings.shape[2]
    delay, u = np.zeros(count), np.full(count, np.inf)
    moved, fine = readings, np.ones(len(time), dtype=np.bool_)
    # Late elements alone can make an alignment uncertain: only the last one must be good enough.
    found = align(readings, white, truth, strict=False)
    for _ in range(_STEPS):
        if fine.sum() < _FEWEST or not np.isfinite(found.sensing).all():
            break
        step, u = _regressed(time[fine], moved[fine], white, found, None if truth is None else truth[fine])
        if truth is None:
            step = step - np.median(step)
        delay = delay + np.clip(step, -_LONGEST, _LONGEST)
        if moved is readings and not _is_late(delay, u).any():
            break
        moved, fine = _without_delays(time, readings, delay)
        found = align(moved[fine], white, None if truth is None else truth[fine], strict=False)
        if np.abs(step).max() < _SETTLED * u.min():
            break
    known = bool(np.isfinite(u).all() and np.isfinite(delay).all())
    if not known or not _is_late(delay, u).any() or fine.sum() < _FEWEST:
        found = align(readings, white, truth)
    else:
        found = align(moved[fine], white, None if truth is None else truth[fine])
    return replace(found, latency=delay, latency_uncertainty=u) if known else found


def _is_late(delay: Array, u: Array) -> NDArray[np.bool_]:
    """Which latencies are clear, and not too small to matter."""
    found: NDArray[np.bool_] = np.abs(delay) > np.maximum(_CLEAR * u, _HARMLESS)
    return found


def latency_notes(found: Alignment, names: Sequence[str]) -> list[str]:
    """Say which elements are late, under these names."""
    if found.latency is None or found.latency_uncertainty is None:
        return []
    late = np.flatnonzero(_is_late(found.latency, found.latency_uncertainty)).tolist()
    if not late:
        return []
    listed = ", ".join(
        f"{names[i]} by {1e3 * found.latency[i]:+.3g} ms (u {1e3 * found.latency_uncertainty[i]:.1g} ms)" for i in late
    )
    than = "the truth" if found.gauge == "truth_rate" else "the array's median"
    return [
        f"readings come later than {than}: {listed}; scale factors and alignment are of readings moved by as much, but "
        "array fuse does not move them: give such an element a column time_i of its own, or mend the logger"
    ]


def _regressed(
    time: Array, readings: Array, white: Array, found: Alignment, truth: Array | None
) -> tuple[Array, Array]:
    """Latency that is left of each element, s, and its standard uncertainty by jackknife over 20 stretches."""
    weight = found.sensing / white.T[:, :, None] ** 2
    centred = readings - readings.mean(axis=0)
    if truth is None:
        normal = np.einsum("iab,iac->bc", found.sensing, weight)
        rate = np.linalg.solve(normal, np.einsum("iab,mai->bm", weight, centred)).T
    else:
        rate = truth - truth.mean(axis=0)
    change = np.einsum("iab,mb->mai", found.sensing, np.gradient(rate, time, axis=0))
    left = centred - np.einsum("iab,mb->mai", found.sensing, rate)
    gap = np.diff(time) > _GAP * np.median(np.diff(time))
    change[np.append(gap, False) | np.insert(gap, 0, False)] = 0.0
    inverse = 1 / white**2
    across = -np.einsum("mai,mai,ai->mi", left, change, inverse)
    along = np.einsum("mai,mai,ai->mi", change, change, inverse)
    edges = np.linspace(0, len(time), _BLOCKS + 1).astype(int)
    parts = np.array([[across[a:b].sum(axis=0), along[a:b].sum(axis=0)] for a, b in pairwise(edges)])
    total = parts.sum(axis=0)

    def delays(sums: Array) -> Array:
        value = sums[..., 0, :] / np.maximum(sums[..., 1, :], 1e-300)
        return value if truth is not None else value - np.median(value, axis=-1, keepdims=True)

    without = delays(total - parts)
    spread = np.sqrt((_BLOCKS - 1) / _BLOCKS * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    # The element that is the median has none of its own: it is known as well as the others.
    return delays(total), np.maximum(spread, np.median(spread))


def _without_delays(time: Array, readings: Array, delay: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return readings earlier by each element's delay, and which rows are interpolated, not made up, (m,)."""
    from scipy.interpolate import CubicSpline

    moved = np.empty_like(readings)
    for i, late in enumerate(delay.tolist()):
        moved[:, :, i] = CubicSpline(time, readings[:, :, i])(time + late) if late else readings[:, :, i]
    usual = float(np.median(np.diff(time)))
    reach = float(np.abs(delay).max())
    fine = (time >= time[0] + reach) & (time <= time[-1] - reach)
    width = int(reach / usual) + _BESIDE
    for k in np.flatnonzero(np.diff(time) > _GAP * usual).tolist():
        fine[max(k - width, 0) : k + width + 1] = False
    return moved, fine
