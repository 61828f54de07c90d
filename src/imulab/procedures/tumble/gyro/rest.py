"""The gyroscopes while the accelerometers are at rest, and how well the directions of gravity are known.

Attitudes are found from the accelerometers, which hardly feel a slow beginning of a turn, a twist about the vertical or
a touch. The gyroscopes do: their own stillness decides which samples tell the zero.

A direction is moved by the noise of its attitude across the vertical, and all of them together by the errors of the
accelerometers' parameters. The two are independent to first order: those parameters are found from |f|, along it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from msgspec import Struct, structs
from numpy.typing import NDArray

from imulab.display import Finding
from imulab.errors import DataError
from imulab.estimation.decisions import BIAS_FOLLOWS_GRAVITY
from imulab.estimation.least_squares import f_test
from imulab.estimation.rows import MAD_TO_SIGMA, distinct, median, medians
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.device import specific_force
from imulab.recording import Array
from imulab.records.calibration import Calibration

# The gyroscopes while the accelerometers are at rest: when they are still, what they put out, and how f moves that.


_EDGE = 0.1  # s back into the 0.3 s of each hold that segmentation drops
STILL_SIGMAS = 5.0  # sigma of the hold's own noise within which a gyroscope is still
_MARGIN = 0.1  # s
_DEEPEST = 2.0  # s
QUIET_SHARE = 0.75  # share of still samples of a hold that tells the zero
_FLAT_TOP = 4  # readings in a row
_CUT_OFF = 3.0  # steps of the output
_LATE = 0.3  # s
_ENDS = 0.3, 0.075  # s and part of a hold at each end, where turns begin and end: the zero is that between
_TAPER = 0.25  # of the rest at each end, of the cosine that a tremor leaks through least
_FLAT = 9 / 11  # 1 / int h^2 dt of such a window over its length: (1 - taper)^2 / (1 - 5 taper / 4)
_HUBER = 2.5 * MAD_TO_SIGMA  # medians of the absolute deviation, 2.5 sigma: what is beyond pulls no stronger
_REWEIGHTED = 20  # of Huber's fit
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]  # axes of a cross product


class RestHolds(Struct, frozen=True):
    """Attitudes as samples of the gyroscopes; all of shape (n,).

    Attributes
    ----------
    start, stop
        First sample, and one past the last.
    arrive, leave
        Sample where the turn before ends, and where the next one begins: beyond any motion that the gyroscopes see in
        the first two and the last two seconds of the hold (of a shorter one, to its middle).
    still
        Whether a sample of the recording is no motion, shape (samples,); says nothing outside of the holds.
    """

    start: NDArray[np.intp]
    stop: NDArray[np.intp]
    arrive: NDArray[np.intp]
    leave: NDArray[np.intp]
    still: NDArray[np.bool_]


class GyroRest(Struct, frozen=True):
    """Output at rest: zero (3,), change with specific force (3, 3) or None, and their standard uncertainties.

    The zero is that of all holds; a turn has that of its two holds (`zero_between`).
    """

    zero: Array
    slope: Array | None
    zero_uncertainty: Array
    slope_uncertainty: Array | None
    moved: Array | float = 0.0
    """By how much the zero of each hold is probably another, (holds, 3): its deviation, less what noise explains."""
    moved_variance: Array | float = 0.0
    """Variance of that, (3,)."""
    scatter: Array | float = 0.0
    """Standard deviation of the zeros of the holds, (3,)."""


def find_holds(attitudes: Attitudes, time: Array, output: Array, smallest: Array, name: str) -> RestHolds:
    """Find when the gyroscopes are still: within five standard deviations of the hold's median, in all three.

    `smallest` are the smallest steps between values of the output (`resolution`), (3,).

    Raises
    ------
    DataError
        There are no samples during an attitude.
    """
    start, stop = np.searchsorted(time, np.column_stack([attitudes.start, attitudes.stop])).T
    if (stop <= start).any():
        label = attitudes.label(int(np.argmax(stop <= start)))
        raise DataError(f"{name}: no samples during {label}: do the two recordings share one clock?")
    held = [np.ascontiguousarray(output[a:b].T) for a, b in zip(start, stop, strict=True)]
    usual = [medians(values) for values in held]
    spread = [medians(np.abs(values - m[:, None])) for values, m in zip(held, usual, strict=True)]
    sigma = np.maximum(MAD_TO_SIGMA * medians(np.array(spread), 0), smallest)
    first = np.searchsorted(time, attitudes.start - _EDGE)
    last = np.minimum(np.searchsorted(time, attitudes.stop + _EDGE), len(time) - 1)
    rate = float((stop - start).sum()) / max(float((time[stop - 1] - time[start]).sum()), 1e-9)
    margin, middle = max(1, round(_MARGIN * rate)), (start + stop) // 2
    early, late = np.minimum(middle, first + round(_DEEPEST * rate)), np.maximum(middle, last - round(_DEEPEST * rate))
    still = np.ones(len(time), dtype=np.bool_)
    arrive, leave = first.copy(), last.copy()
    for k in range(len(start)):
        here = slice(first[k], last[k] + 1)
        still[here] = (np.abs(output[here] - usual[k]) <= STILL_SIGMAS * sigma).all(axis=1)
        if not still[start[k] : stop[k]].any():
            still[here] = True  # it turns all the time: nothing tells rest from motion
        moved = first[k] + np.flatnonzero(~still[here])
        before, after = moved[moved < early[k]], moved[moved >= late[k]]
        if before.size:
            arrive[k] = min(before[-1] + margin, early[k])
        if after.size:
            leave[k] = max(after[0] - margin, late[k])
    return RestHolds(start, stop, arrive, leave, still)


def clock_notes(holds: RestHolds, attitudes: Attitudes, time: Array) -> list[str]:
    """Say if the gyroscopes, on another clock perhaps, move into one end of the holds and not into the other."""
    into = median(time[holds.arrive] - attitudes.start), median(attitudes.stop - time[holds.leave])
    for late, other, when in ((*into, "stop turning {:.1f} s after"), (*into[::-1], "start turning {:.1f} s before")):
        if late > _LATE and other < late / 2:
            return [
                Finding(
                    f"gyro: the gyroscopes {when.format(late)} the accelerometers (median): does one clock drive both?",
                    "record both sensors by one clock",
                )
            ]
    return []


def beyond_range(output: Array, smallest: Array | None = None) -> NDArray[np.bool_]:
    """Return which samples lie in a flat top at the largest or smallest output of an axis, shape (n, 3).

    `smallest` are the smallest steps between values of the output (`resolution`), where they are known.

    Four readings in a row, cut off where the output was still changing: the top of a slow turn in coarse steps is none,
    nor are readings that are each logged several times.
    """
    clipped = np.zeros(output.shape, dtype=np.bool_)
    least = _CUT_OFF * (resolution(output) if smallest is None else smallest)
    for axis, values in enumerate(output.T):
        repeats = np.diff(np.flatnonzero(np.concatenate([[True], np.diff(values) != 0, [True]])))
        flat = _FLAT_TOP * median(repeats)
        for extreme in (values.max(), values.min()):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], values == extreme, [False]]).astype(np.int8)))
            for start, stop in edges.reshape(-1, 2).tolist():
                before, after = values[max(start - 1, 0)], values[min(stop, len(values) - 1)]
                if stop - start >= flat and max(abs(before - extreme), abs(after - extreme)) > least[axis]:
                    clipped[start:stop, axis] = True
    return clipped


def at_rest(
    still: StillMeans,
    force: Array,
    sensitivity: str,
    density: Array,
    scale: Array | None = None,
    earth: Array | float = 0.0,
    vertical: Array | None = None,
) -> GyroRest:
    """Return zero and g-sensitivity from the mean outputs of the quiet holds, robust least squares over the holds.

    `density` is the noise of the outputs (`noise_density`), `scale` their output per rad/s, where it is known: coning
    is taken off then. `earth` is what is known of the Earth's rate in each hold, as output, (n, 3), which is taken off.
    Where that is nothing, `vertical` is the output by all of it along up: what a part of that explains shows no
    g-sensitivity. Quiet is a hold that is still for three quarters of its samples; of fewer than half, that half.
    """
    quiet = still.fraction >= min(QUIET_SHARE, median(still.fraction))
    every = still.mean - earth if scale is None else still.mean + still.coning * scale**2 / np.prod(scale) - earth
    mean, turned = every[quiet], force[quiet]
    n = len(mean)
    middle = still.middle[quiet]
    when = (middle - middle.mean()) / max(float(np.ptp(middle)), 1.0)
    # A zero that drifts goes with some direction of f by chance: held against, and found beside, a slope in time.
    drift, whole = np.column_stack([np.ones(n), when]), np.column_stack([np.ones(n), turned, when])
    left, plain, known = _residuals(whole, mean), _residuals(drift, mean), 6
    if vertical is not None:
        along, known = _residuals(drift, vertical[quiet]), 7
        part = float((along * plain).sum()) / max(float((along**2).sum()), 1e-300)
        plain = plain - np.clip(part, -1, 1) * along
    chance = f_test(float((plain**2).sum()), known, float((left**2).sum()), 15, 3 * n) if n > 7 else 1.0
    shown = chance < BIAS_FOLLOWS_GRAVITY.level
    if sensitivity == "no" or (sensitivity == "auto" and not shown):
        fit = _robust_fit(np.ones((n, 1)), mean)
        rest = GyroRest(fit.values[0], None, fit.uncertainty[0], None)
    else:
        fit = _robust_fit(whole, mean)
        flat = _robust_fit(whole[:, :4], mean)
        zero_uncertainty = np.maximum(fit.scatter, flat.scatter) * fit.uncertainty[0] / np.maximum(fit.scatter, 1e-300)
        rest = GyroRest(fit.values[0], fit.values[1:4].T, zero_uncertainty, fit.uncertainty[1:4])
        every = every - force @ fit.values[1:4]
    deviation = np.where(quiet[:, None], every - rest.zero, 0.0)
    limit = _HUBER * medians(np.abs(deviation[quiet]), 0)
    alone = density / (_FLAT * median(still.length[quiet]))
    excess = np.maximum((MAD_TO_SIGMA * limit / _HUBER) ** 2 - alone, 0.0)
    share = excess / np.maximum(excess + alone / 2, 1e-300)
    return structs.replace(
        rest,
        moved=share * np.clip(deviation, -limit, limit),
        moved_variance=share * alone,
        scatter=MAD_TO_SIGMA * limit / _HUBER,
    )


class StillMeans(Struct, frozen=True):
    """What the gyroscopes put out in each hold, over its still samples.

    Attributes
    ----------
    mean
        Tapered mean, (n, 3).
    coning
        What it lacks because the unit trembles, times ``s_x s_y s_z / s_i^2`` of the outputs per rad/s, (n, 3).
    fraction
        Share of still samples, (n,).
    length, middle
        Duration, s, and number of the sample in the middle, (n,).
    """

    mean: Array
    coning: Array
    fraction: Array
    length: Array
    middle: Array


def still_means(holds: RestHolds, time: Array, output: Array) -> StillMeans:
    """Return the mean outputs of holds.

    The ends are left out, where turns begin and end slowly. A unit that trembles about two axes turns about the third
    without getting anywhere (coning): 1/2 sum h (phi x w), phi the angle turned so far, is what the mean rate lacks.
    """
    first, last = time[holds.start], time[np.maximum(holds.stop - 1, holds.start)]
    edge = np.minimum(_ENDS[0], _ENDS[1] * (last - first))
    step = (last - first) / np.maximum(holds.stop - holds.start - 1, 1)
    means, coning, fraction = np.empty((len(first), 3)), np.empty((len(first), 3)), np.empty(len(first))
    length = last - first - 2 * edge + step
    for k, (a, b) in enumerate(np.searchsorted(time, [first + edge, last - edge + step / 2]).T.tolist()):
        a, b = (a, b) if b > a else (int(holds.start[k]), int(holds.stop[k]))
        when, values, still = time[a:b], output[a:b], holds.still[a:b]
        fraction[k] = np.count_nonzero(holds.still[holds.start[k] : holds.stop[k]]) / (holds.stop[k] - holds.start[k])
        share = (when - when[0] + step[k] / 2) / max(when[-1] - when[0] + step[k], 1e-300)
        weight = 1 - np.cos(np.pi * np.clip(np.minimum(share, 1 - share) / _TAPER, 0.0, 1.0))
        weight = np.where(still, weight, 0.0) if still.any() else weight
        weight = weight / weight.sum()
        means[k] = weight @ values
        rate = np.where(still[:, None], values - means[k], 0.0)
        angle = np.cumsum(rate, axis=0) * step[k] - 0.5 * rate * step[k]
        turned = (angle - weight @ angle).T @ (weight[:, None] * rate)  # sum h phi_i w_j
        coning[k] = (turned[_NEXT, _AFTER] - turned[_AFTER, _NEXT]) / 2
    return StillMeans(means, coning, fraction, length, (holds.start + holds.stop) / 2)


class _RobustFit(Struct, frozen=True):
    """Coefficients (p, 3) of each column, their standard uncertainties, and its scatter, (3,)."""

    values: Array
    uncertainty: Array
    scatter: Array


def _robust_fit(design: Array, values: Array) -> _RobustFit:
    """Return Huber's fit of each column: residuals beyond 2.5 sigma of their median pull no stronger than these.

    Source: Huber and Ronchetti, Robust statistics, 2009, chapter 7; the covariance is its equation 6.5 without the
    correction for few values.
    """
    n, size = design.shape
    root = np.sqrt(np.diag(np.linalg.pinv(design.T @ design)))
    coefficients, scatter = np.empty((size, values.shape[1])), np.empty(values.shape[1])
    for k, column in enumerate(values.T):
        weight = np.ones(n)
        for _ in range(_REWEIGHTED):
            coefficients[:, k] = np.linalg.lstsq(design * weight[:, None], column * weight, rcond=None)[0]
            left = column - design @ coefficients[:, k]
            limit = max(_HUBER * median(np.abs(left)), 1e-12 * float(np.abs(column).max()), 1e-300)
            before, weight = weight, np.sqrt(limit / np.maximum(np.abs(left), limit))
            if np.array_equal(before, weight):
                break
        inside = np.count_nonzero(np.abs(left) <= limit) / n
        scatter[k] = np.sqrt((np.clip(left, -limit, limit) ** 2).sum() / max(n - size, 1)) / inside
    return _RobustFit(coefficients, root[:, None] * scatter, scatter)


def _residuals(design: Array, values: Array) -> Array:
    """What a least-squares fit of each column leaves."""
    left: Array = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    return left


def resolution(output: Array) -> Array:
    """Return the smallest step between the values of each axis, shape (3,)."""
    values = [distinct(column) for column in output.T]
    return np.array([np.diff(v).min() if v.size > 1 else 0.0 for v in values])


# How well the directions of gravity are known that the turns of the gyroscopes are held against.


def direction_covariance(record: Calibration, output: Array, force: Array) -> Array:
    """Return the covariance of the upward directions by the record's parameters, rad^2, shape (3 n, 3 n).

    The noise in them is not in it, nor what they scatter beyond it, which the turns show.

    Parameters
    ----------
    record
        Of the accelerometers.
    output
        Means of the attitudes in the record's unit, shape (n, 3).
    force
        Their specific force, m/s^2, shape (n, 3).
    """
    n = len(force)
    joint = np.zeros((n, 3, n, 3))
    names = [name for name in record.covariance.names if not name.startswith("gyro_")]
    if names:
        matrix = record.covariance.block(names)
        sigma = np.sqrt(np.diag(matrix))
        moved = np.stack(
            [
                _force_change(record, name, size, output).ravel()
                for name, size in zip(names, sigma.tolist(), strict=True)
            ],
            axis=1,
        )
        joint += (moved @ (matrix / np.outer(sigma, sigma)) @ moved.T).reshape(n, 3, n, 3)
    length = np.linalg.norm(force, axis=1)
    up = force / length[:, None]
    across = (np.eye(3) - up[:, :, None] * up[:, None, :]) / length[:, None, None]
    angular: Array = np.einsum("nij,njmk,mlk->niml", across, joint, across, optimize=True).reshape(3 * n, 3 * n)
    return angular


def _force_change(record: Calibration, name: str, sigma: float, output: Array) -> Array:
    """Change of the specific force with one standard uncertainty of a parameter, shape (n, 3)."""
    parameter = record.parameters[name]
    ends = [
        specific_force(
            replace(
                record, parameters={**record.parameters, name: replace(parameter, value=parameter.value + s * sigma)}
            ),
            output,
        )
        for s in (-1, 1)
    ]
    change: Array = (ends[1] - ends[0]) / 2
    return change
