"""Biases and noise of an array at rest, and its elements' alignment and latency in motion.

All readings are one motion seen n times. The largest eigenvectors of their covariance, whitened by the noise at rest,
span what the elements sense of it (maximum likelihood of the factor model); a convention fixes the frame within it.

An element whose readings come later by tau than the others' reads ``A w(t - tau) = A w - tau A dw/dt + ...``: its
residual from the consensus is proportional to the derivative of the consensus. The regression on that gives tau to a
fraction of a sample. It is repeated on readings moved by tau (cubic splines) until tau no longer changes.

An element that is not linear leaves a residual that bends with the rate p that it senses, ``c_2 p^2 + c_3 p^3``. What
c_3 makes of its scale factor, ``c_3 <p^4> / <p^2>``, is in the uncertainties where it is above its noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from imulab.errors import ObservabilityError
from imulab.estimation.clock import GAP
from imulab.estimation.column_noise import ColumnNoise, columns_noise
from imulab.estimation.decisions import ELEMENT_BENDS, READINGS_LATE
from imulab.estimation.least_squares import coverage_factor
from imulab.estimation.noise_coefficients import DeviationCurve
from imulab.procedures.gyro_array.elements import Elements
from imulab.recording import Array, Recording, release
from imulab.records.calibration import Calibration
from imulab.records.mean_noise import mean_uncertainties
from imulab.units import to_si

# At rest: biases with their uncertainty, and noise.


_CANDIDATES = ("N", "NK", "NB", "NG", "NBK")
"""Noise models: a stretch at rest is too short to determine more."""


@dataclass(frozen=True)
class AtRest:
    """Biases, their uncertainties, curves and noise of a recording at rest, by axis and element; rad/s."""

    bias: Array
    curves: tuple[tuple[DeviationCurve, ...], ...]
    noise: tuple[tuple[ColumnNoise, ...], ...]
    white: Array
    uncertainty: Array
    duration: float
    rate: float


def at_rest(still: Recording, rate: float, elements: Elements, record: Calibration | None) -> tuple[AtRest, list[str]]:
    """Return biases and noise of the elements in a recording at rest, at a rate, Hz, and notes.

    The uncertainty of a bias is that of a mean over the duration t, averaged over noise models:
    ``u^2 = N^2/t + (2 ln 2/pi) B^2 + K^2 t/3 + ...`` (`terms.mean_terms`).

    Raises
    ------
    RecordError
        The record is no noise record, or lacks an element.
    """
    n, duration = elements.count, len(still) / rate
    names = [name for row in elements.names for name in row]
    columns, units = [still.column(name) for name in names], [still.units[name] for name in names]
    bias = []
    for values, unit in zip(columns, units, strict=True):
        bias.append(to_si(float(values.mean()), unit))
        release(values)
    each = columns_noise(columns, rate, candidates=_CANDIDATES, units=units)
    notes: list[str] = []
    if record is None:
        spread = np.array([gyro.mean_uncertainty(duration) for gyro in each])
    else:
        spread, notes = mean_uncertainties(record, names, duration, "rad/s", still.metadata)
    noise = tuple(tuple(each[k : k + n]) for k in range(0, len(each), n))
    curves = tuple(tuple(gyro.curve for gyro in row) for row in noise)
    white = np.array([[curve.deviation[0] for curve in row] for row in curves])
    spread = spread.reshape(len(elements.axes), n)
    return AtRest(np.reshape(bias, spread.shape), curves, noise, white, spread, duration, rate), notes


def slower_noise(noises: Mapping[str, ColumnNoise], rest: AtRest) -> float:
    """Return how many times as large noise too slow to show could make the uncertainties of the biases; 1: none."""
    return max((each.unseen(rest.duration) for each in noises.values()), default=1.0)


def slower_noise_text(times: float, uncertainties: Array, duration: float) -> str:
    """Return the sentence on that, for uncertainties of biases, rad/s, by a test of a duration, s."""
    largest = math.degrees(float(np.nanmax(uncertainties))) * 3600
    return (
        f"the uncertainties of the biases, up to {largest:.3g} deg/h, hold "
        f"the noise that {duration:.4g} s show; slower noise, which so short a stretch cannot show, could make them up "
        f"to {times:.2g} times as large (--noise RECORD: the noise of a longer log)"
    )


# In motion: alignment of the elements against their consensus.


_BLOCKS = 20  # parts of a motion whose scatter gives the uncertainties (jackknife)
_WORST = 0.05  # largest uncertainty of a useful alignment, relative and in rad
_VISIBLE = 25.0  # least variance of the motion over that of the noise, in the direction of least motion
_NEAR_PERMUTATION = 0.35  # rad
TRUTH = "truth_rate"
"""The gauge of an alignment against a known rate."""


@dataclass(frozen=True)
class Alignment:
    """What each element senses of the array's rate: ``z_i = A_i w + b_i``.

    Attributes
    ----------
    sensing, standard_uncertainty
        A_i and its standard uncertainty, shape (n, axes, axes).
    residual
        Rms of each element's residual from the consensus, rad/s, shape (n, axes).
    gauge
        Convention that fixes the frame.
    latency, latency_uncertainty
        Delay of each element's readings relative to the median's (or the truth), s, shape (n,), or None.
    bend, bend_uncertainty
        Change of the ratio of output to rate over the rates of the recording, from -max to max and from 0 to max, and
        its standard uncertainty, shape (n, axes, 2).
    """

    sensing: Array
    standard_uncertainty: Array
    residual: Array
    gauge: str
    latency: Array | None = None
    latency_uncertainty: Array | None = None
    bend: Array | None = None
    bend_uncertainty: Array | None = None


def align(readings: Array, white: Array, truth: Array | None = None, *, strict: bool = True) -> Alignment:
    """Return what each element senses of the array's rate.

    Without `truth`, element 1 in its nominal orientation gives the directions and the mean over all elements of
    ``P_i' A_i`` is the unit matrix, P_i the nominal orientation of element i (a signed permutation where it is near
    one). With `truth`, A_i is the regression on it. Uncertainties: jackknife over 20 stretches of the recording.

    Parameters
    ----------
    readings
        Readings in motion, shape (m, axes, n), rad/s; their means are subtracted.
    white
        Standard deviation of a sample at rest, shape (axes, n).
    truth
        True rate, shape (m, axes), or None.
    strict
        Whether to refuse an alignment that is not determined to 5 %.

    Raises
    ------
    ObservabilityError
        The motion does not excite every axis.
    """
    m, axes, n = readings.shape
    stacked = np.moveaxis(readings, 2, 1).reshape(m, n * axes)  # element by element
    # Biases may have changed since the array was at rest: only variations count here.
    stacked = stacked - stacked.mean(axis=0)
    truth = None if truth is None else truth - truth.mean(axis=0)
    sigma = white.T.reshape(n * axes)
    edges = np.linspace(0, m, min(_BLOCKS, m // 4) + 1).astype(int)
    moments = [_moments(stacked[a:b], truth if truth is None else truth[a:b]) for a, b in pairwise(edges)]
    total = sum(moments[1:], start=moments[0].copy())
    sensing = _solve(total, sigma, axes, n, known=truth is not None)
    without = np.array([_solve(total - part, sigma, axes, n, known=truth is not None) for part in moments])
    blocks = len(moments)
    uncertainty = np.sqrt((blocks - 1) / blocks * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    size = n * axes
    weakest = np.linalg.eigvalsh(total[:size, :size] / np.outer(sigma, sigma))[-axes] / m
    if strict and (not np.isfinite(uncertainty).all() or uncertainty.max() > _WORST or weakest < _VISIBLE):
        # In its first element's frame, the axis with the least motion relative to its noise.
        worst = int(np.argmin(readings[:, :, 0].std(axis=0) / white[:, 0]))
        axis = f" about {'xyz'[worst]}" if axes == 3 else ""
        raise ObservabilityError(
            f"the motion does not fix the elements' scale factors and alignment{axis} to {100 * _WORST:.0f} %; "
            "expected a recording that turns fast, both ways, about every axis"
        )
    full = sensing.reshape(n * axes, axes)
    weight = full / sigma[:, None] ** 2
    consensus = np.linalg.solve(full.T @ weight, weight.T @ stacked.T)
    sensed = (consensus.T if truth is None else truth) @ full.T
    left = stacked - sensed
    residual = left.std(axis=0).reshape(n, axes)
    bends = [_fit_bend(sensed[:, k], left[:, k], edges) for k in range(size)]
    bend, bend_uncertainty, slope = (np.array([each[k] for each in bends]) for k in range(3))
    uncertainty = _allow_for_bends(sensing, uncertainty, slope.reshape(n, axes), shared=truth is None)
    gauge = TRUTH if truth is not None else "mean over the elements of P_i' A_i = 1, directions of element 1"
    return Alignment(
        sensing, uncertainty, residual, gauge,
        bend=bend.reshape(n, axes, 2), bend_uncertainty=bend_uncertainty.reshape(n, axes, 2),
    )  # fmt: skip


def _fit_bend(sensed: Array, left: Array, edges: NDArray[np.intp]) -> tuple[Array, Array, float]:
    """Return how the ratio of an element's output to its rate bends, with u by jackknife, and what that adds to it.

    Of the ratio: its change from -max to max, and from 0 to max, shape (2,); and its mean change over the recording,
    0 where that is less than its noise makes of it in one of twenty recordings.
    """
    top = float(np.abs(sensed).max())
    if not top > 0:
        return np.zeros(2), np.ones(2), 0.0
    p = sensed / top
    columns = np.stack([np.ones_like(p), p, p**2, p**3, left / top], axis=1)
    moments = np.array([columns[a:b].T @ columns[a:b] for a, b in pairwise(edges)])
    total = moments.sum(axis=0)
    coefficients = np.array([np.linalg.lstsq(each[:4, :4], each[:4, 4])[0] for each in (total, *(total - moments))])
    blocks = len(moments)
    u = np.sqrt((blocks - 1) / blocks * np.square(coefficients[1:] - coefficients[1:].mean(axis=0)).sum(axis=0))
    size, u = coefficients[0, 2:] * (2.0, 1.0), np.maximum(u[2:] * (2.0, 1.0), 1e-300)
    mean = float(size[1] * total[2, 2] / total[1, 1])
    return size, u, mean if abs(size[1]) > coverage_factor(blocks - 1) * u[1] else 0.0


def _allow_for_bends(sensing: Array, uncertainty: Array, slope: Array, *, shared: bool) -> Array:
    """Return the uncertainties with what elements that are not linear make of the scale factors, shape (n, axes).

    Without a truth the mean of all elements is 1, so that each takes its share of what another is off.
    """
    count = len(slope)
    others = np.square(slope).sum(axis=0) / count**2 if shared else np.zeros(slope.shape[1])
    bend = np.square(slope) * ((1 - 2 / count) if shared else 1.0) + others
    bent: Array = np.sqrt(uncertainty**2 + np.square(sensing) * bend[:, :, None])
    return bent


def bend_notes(alignment: Alignment, names: Sequence[str]) -> list[str]:
    """Return a message on elements whose output is not linear in the rate, under these names."""
    if alignment.bend is None or alignment.bend_uncertainty is None:
        return []
    score = np.abs(alignment.bend) / alignment.bend_uncertainty
    limit = coverage_factor(_BLOCKS - 1, 1 - ELEMENT_BENDS.level / score.size)
    # The others share what one element is off, a part of it each.
    clear = (score > limit) & (np.abs(alignment.bend) > 0.5 * np.abs(alignment.bend).max(axis=0))
    if not clear.any():
        return []
    listed = ", ".join(
        f"{names[i]} by {100 * float(np.abs(alignment.bend[i])[clear[i]].max()):.2g} %"
        for i in np.flatnonzero(clear.any(axis=(1, 2))).tolist()
    )
    return [
        f"output over rate is not the same at all rates of the recording: {listed}; what that makes of the scale "
        "factors is in u: move only as fast as the array will in use, or leave the element out"
    ]


def _moments(stacked: Array, truth: Array | None) -> Array:
    """Return the second moments of the readings, with those of the truth appended if there is one."""
    columns = stacked if truth is None else np.hstack([stacked, truth])
    moments: Array = columns.T @ columns
    return moments


def _solve(moments: Array, sigma: Array, axes: int, n: int, *, known: bool) -> Array:
    """Return A_i, shape (n, axes, axes): ``A = sigma U G``, U the largest eigenvectors of ``moments / sigma sigma'``.

    G is the convention of `align`. With a known truth w, A_i is the regression ``sum z w' (sum w w')^-1``.
    """
    size = n * axes
    if known:
        inner = moments[size:, size:]
        if np.linalg.cond(inner) > 1e12:
            return np.full((n, axes, axes), np.nan)
        regression = np.linalg.solve(inner, moments[size:, :size]).T
        return np.asarray(regression, dtype=np.float64).reshape(n, axes, axes)
    scaled = moments / np.outer(sigma, sigma)
    loading = np.linalg.eigh(scaled)[1][:, -axes:] * sigma[:, None]
    parts: Array = loading.reshape(n, axes, axes)
    if np.linalg.cond(parts[0]) > 1e6:
        return np.full((n, axes, axes), np.nan)
    relative = _product(parts, np.linalg.inv(parts[0]))
    nominal = np.array([nominal_orientation(part) for part in relative])
    mean = np.einsum("iba,ibc->ac", nominal, relative) / n
    return _product(relative, np.linalg.inv(mean))


def _product(a: Array, b: Array) -> Array:
    product: Array = np.einsum("iab,bc->iac", a, b)
    return product


def nominal_orientation(matrix: Array) -> Array:
    """Return the signed permutation near a matrix, or the rotation nearest to it, shape (axes, axes)."""
    u, _, vt = np.linalg.svd(matrix)
    rotation: Array = u @ vt
    permutation = np.zeros_like(matrix)
    rows = np.arange(len(matrix))
    columns = np.argmax(np.abs(rotation), axis=1)
    permutation[rows, columns] = np.sign(rotation[rows, columns])
    near = np.abs(rotation - permutation).max() < _NEAR_PERMUTATION and len(set(columns.tolist())) == len(rows)
    return permutation if near else rotation


# Latency: elements whose readings come late, and alignment with the delay removed.


_STEPS = 8  # most Gauss-Newton steps
_HARMLESS = 1e-4  # s; 5 ppm of scale factor in motion at 5 Hz
_SETTLED = 0.02  # standard uncertainties of a step that ends the search
_BESIDE = 4  # samples beside a gap where a spline is not trusted
_FEWEST = 100  # samples that show a latency
_LONGEST = 0.1  # s, of a step


def align_in_time(time: Array, readings: Array, white: Array, truth: Array | None = None) -> Alignment:
    """Return the alignment of elements as `align` does, with late readings moved by their latency.

    Where no latency is clear (four standard uncertainties) and above 0.1 ms, no readings are moved.

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
    # Late elements can make an alignment uncertain: only the last one has to be good enough.
    alignment = align(readings, white, truth, strict=False)
    for _ in range(_STEPS):
        if fine.sum() < _FEWEST or not np.isfinite(alignment.sensing).all():
            break
        step, u = _fit_latency(time[fine], moved[fine], white, alignment, None if truth is None else truth[fine])
        if truth is None:
            step = step - np.median(step)
        delay = delay + np.clip(step, -_LONGEST, _LONGEST)
        if moved is readings and not _is_late(delay, u).any():
            break
        moved, fine = _remove_delays(time, readings, delay)
        alignment = align(moved[fine], white, None if truth is None else truth[fine], strict=False)
        if np.abs(step).max() < _SETTLED * u.min():
            break
    known = bool(np.isfinite(u).all() and np.isfinite(delay).all())
    if not known or not _is_late(delay, u).any() or fine.sum() < _FEWEST:
        alignment = align(readings, white, truth)
    else:
        alignment = align(moved[fine], white, None if truth is None else truth[fine])
    return replace(alignment, latency=delay, latency_uncertainty=u) if known else alignment


def _is_late(delay: Array, u: Array) -> NDArray[np.bool_]:
    """Return which latencies are clear, and large enough to matter."""
    late: NDArray[np.bool_] = np.abs(delay) > np.maximum(READINGS_LATE.limit * u, _HARMLESS)
    return late


def latency_notes(alignment: Alignment, names: Sequence[str]) -> list[str]:
    """Return a message on the late elements, under these names."""
    if alignment.latency is None or alignment.latency_uncertainty is None:
        return []
    late = np.flatnonzero(_is_late(alignment.latency, alignment.latency_uncertainty)).tolist()
    if not late:
        return []
    listed = ", ".join(
        f"{names[i]} by {1e3 * alignment.latency[i]:+.3g} ms (u {1e3 * alignment.latency_uncertainty[i]:.1g} ms)"
        for i in late
    )
    than = "the truth" if alignment.gauge == TRUTH else "the array's median"
    return [
        f"readings come later than {than}: {listed}; scale factors and alignment are of readings moved by as much, but "
        "array fuse does not move them: give such an element a column time_i of its own, or mend the logger"
    ]


def _fit_latency(
    time: Array, readings: Array, white: Array, alignment: Alignment, truth: Array | None
) -> tuple[Array, Array]:
    """Return the remaining latency of each element, s, and its standard uncertainty by jackknife over 20 stretches."""
    weight = alignment.sensing / white.T[:, :, None] ** 2
    centred = readings - readings.mean(axis=0)
    if truth is None:
        normal = np.einsum("iab,iac->bc", alignment.sensing, weight)
        rate = np.linalg.solve(normal, np.einsum("iab,mai->bm", weight, centred)).T
    else:
        rate = truth - truth.mean(axis=0)
    change = np.einsum("iab,mb->mai", alignment.sensing, np.gradient(rate, time, axis=0))
    left = centred - np.einsum("iab,mb->mai", alignment.sensing, rate)
    gap = np.diff(time) > GAP * np.median(np.diff(time))
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
    # The median element has no latency of its own, and is known as well as the others.
    return delays(total), np.maximum(spread, np.median(spread))


def _remove_delays(time: Array, readings: Array, delay: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return readings moved earlier by each element's delay, and which rows are interpolated between samples, (m,)."""
    from scipy.interpolate import CubicSpline

    moved = np.empty_like(readings)
    for i, late in enumerate(delay.tolist()):
        moved[:, :, i] = CubicSpline(time, readings[:, :, i])(time + late) if late else readings[:, :, i]
    usual = float(np.median(np.diff(time)))
    reach = float(np.abs(delay).max())
    fine = (time >= time[0] + reach) & (time <= time[-1] - reach)
    width = int(reach / usual) + _BESIDE
    for k in np.flatnonzero(np.diff(time) > GAP * usual).tolist():
        fine[max(k - width, 0) : k + width + 1] = False
    return moved, fine
