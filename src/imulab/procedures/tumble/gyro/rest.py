"""The gyroscopes while the accelerometers are at rest, and how well the directions of gravity are known.

Attitudes are found from the accelerometers, which hardly feel a slow beginning of a turn, a twist about the vertical or
a touch. The gyroscopes do: their own stillness decides which samples tell the zero, and where a turn begins and ends.

A direction is moved by the noise of its attitude across the vertical, and all of them together by the errors of the
accelerometers' parameters. The two are independent to first order: those parameters are found from |f|, along it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError
from imulab.estimation.decisions import BIAS_FOLLOWS_GRAVITY
from imulab.estimation.least_squares import f_test
from imulab.estimation.rows import MAD_TO_SIGMA
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.device import specific_force
from imulab.procedures.tumble.schema import fit_of
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


@dataclass(frozen=True)
class RestHolds:
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


@dataclass(frozen=True)
class GyroRest:
    """Output at rest: zero (3,), change with specific force (3, 3) or None, and their standard uncertainties."""

    zero: Array
    slope: Array | None
    zero_uncertainty: Array
    slope_uncertainty: Array | None


def find_holds(attitudes: Attitudes, time: Array, output: Array, name: str) -> RestHolds:
    """Find when the gyroscopes are still: within five standard deviations of the hold's median, in all three.

    Raises
    ------
    DataError
        There are no samples during an attitude.
    """
    start, stop = np.searchsorted(time, np.column_stack([attitudes.start, attitudes.stop])).T
    if (stop <= start).any():
        label = attitudes.label(int(np.argmax(stop <= start)))
        raise DataError(f"{name}: no samples during {label}: do the two recordings share one clock?")
    median = np.array([np.median(output[a:b], axis=0) for a, b in zip(start, stop, strict=True)])
    spread = [np.median(np.abs(output[a:b] - m), axis=0) for a, b, m in zip(start, stop, median, strict=True)]
    sigma = np.maximum(MAD_TO_SIGMA * np.median(spread, axis=0), _resolution(output))
    first = np.searchsorted(time, attitudes.start - _EDGE)
    last = np.minimum(np.searchsorted(time, attitudes.stop + _EDGE), len(time) - 1)
    rate = float((stop - start).sum()) / max(float((time[stop - 1] - time[start]).sum()), 1e-9)
    margin, middle = max(1, round(_MARGIN * rate)), (start + stop) // 2
    early, late = np.minimum(middle, first + round(_DEEPEST * rate)), np.maximum(middle, last - round(_DEEPEST * rate))
    still = np.ones(len(time), dtype=np.bool_)
    arrive, leave = first.copy(), last.copy()
    for k in range(len(start)):
        here = slice(first[k], last[k] + 1)
        still[here] = (np.abs(output[here] - median[k]) <= STILL_SIGMAS * sigma).all(axis=1)
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
    into = np.median(time[holds.arrive] - attitudes.start), np.median(attitudes.stop - time[holds.leave])
    for late, other, when in ((*into, "stop turning {:.1f} s after"), (*into[::-1], "start turning {:.1f} s before")):
        if late > _LATE and other < late / 2:
            return [f"gyro: the gyroscopes {when.format(late)} the accelerometers (median): does one clock drive both?"]
    return []


def beyond_range(output: Array) -> NDArray[np.bool_]:
    """Return which samples lie in a flat top at the largest or smallest output of an axis, shape (n, 3).

    Four readings in a row, cut off where the output was still changing: the top of a slow turn in coarse steps is none,
    nor are readings that are each logged several times.
    """
    clipped = np.zeros(output.shape, dtype=np.bool_)
    least = _CUT_OFF * _resolution(output)
    for axis, values in enumerate(output.T):
        repeats = np.diff(np.flatnonzero(np.concatenate([[True], np.diff(values) != 0, [True]])))
        flat = _FLAT_TOP * float(np.median(repeats))
        for extreme in (values.max(), values.min()):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], values == extreme, [False]]).astype(np.int8)))
            for start, stop in edges.reshape(-1, 2).tolist():
                before, after = values[max(start - 1, 0)], values[min(stop, len(values) - 1)]
                if stop - start >= flat and max(abs(before - extreme), abs(after - extreme)) > least[axis]:
                    clipped[start:stop, axis] = True
    return clipped


def at_rest(
    holds: RestHolds,
    output: Array,
    force: Array,
    sensitivity: str,
    earth: Array | float = 0.0,
    vertical: Array | None = None,
) -> GyroRest:
    """Zero and g-sensitivity from the mean still outputs of each quiet hold, least squares over the holds.

    `earth` is what is known of the Earth's rate in each, as output, (n, 3), which is taken off. Where that is nothing,
    `vertical` is the output by all of it along up: what a part of that explains shows no g-sensitivity. Quiet is a hold
    that is still for three quarters of its samples; where fewer than half are, that half.
    """
    edges = np.column_stack([holds.start, holds.stop]).ravel()
    kept = np.where(holds.still[:, None], np.column_stack([output, np.ones(len(output))]), 0.0)
    sums = np.add.reduceat(np.vstack([kept, np.zeros((1, 4))]), edges, axis=0)[::2]
    fraction = sums[:, 3] / (holds.stop - holds.start)
    quiet = fraction >= min(QUIET_SHARE, float(np.median(fraction)))
    mean, force = (sums[:, :3] / sums[:, 3:] - earth)[quiet], force[quiet]
    n = len(mean)
    middle = (holds.start + holds.stop)[quiet] / 2
    when = (middle - middle.mean()) / max(float(np.ptp(middle)), 1.0)
    flat = mean - mean.mean(axis=0)
    # A zero that drifts goes with some direction of f by chance: held against, and found beside, a slope in time.
    drift, whole = np.column_stack([np.ones(n), when]), np.column_stack([np.ones(n), force, when])
    left, plain, known = _residuals(whole, mean), _residuals(drift, mean), 6
    if vertical is not None:
        along, known = _residuals(drift, vertical[quiet]), 7
        part = float((along * plain).sum()) / max(float((along**2).sum()), 1e-300)
        plain = plain - np.clip(part, -1, 1) * along
    chance = f_test(float((plain**2).sum()), known, float((left**2).sum()), 15, 3 * n) if n > 7 else 1.0
    shown = chance < BIAS_FOLLOWS_GRAVITY.level
    if sensitivity == "no" or (sensitivity == "auto" and not shown):
        scatter: Array = np.sqrt((flat**2).sum(axis=0) / max(n - 1, 1) / n)
        return GyroRest(mean.mean(axis=0), None, scatter, None)
    solution = np.asarray(np.linalg.lstsq(whole, mean, rcond=None)[0], dtype=np.float64)
    root = np.sqrt(np.diag(np.linalg.inv(whole.T @ whole)))
    spread = np.sqrt((left**2).sum(axis=0) / max(n - 5, 1))
    wander = np.sqrt((_residuals(whole[:, :4], mean) ** 2).sum(axis=0) / max(n - 4, 1))
    uncertainty: Array = spread[:, None] * root[1:4]
    return GyroRest(solution[0], solution[1:4].T, np.maximum(spread, wander) * root[0], uncertainty)


def _residuals(design: Array, values: Array) -> Array:
    """What a least-squares fit of each column leaves."""
    left: Array = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    return left


def _resolution(output: Array) -> Array:
    """Smallest step between the values of each axis, shape (3,)."""
    values = [np.unique(column) for column in output.T]
    return np.array([np.diff(v).min() if v.size > 1 else 0.0 for v in values])


# How well the directions of gravity are known that the turns of the gyroscopes are held against.


def direction_covariance(record: Calibration, attitudes: Attitudes, output: Array, force: Array) -> Array:
    """Return the covariance of the upward directions, rad^2, shape (3 n, 3 n).

    Parameters
    ----------
    record
        Of the accelerometers; where it states no covariance, only the noise counts.
    attitudes
        Whose covariances are in their own unit.
    output
        Means of the attitudes in the record's unit, shape (n, 3).
    force
        Their specific force, m/s^2, shape (n, 3).
    """
    n = len(force)
    joint = np.zeros((n, 3, n, 3))
    if attitudes.covariance is not None:
        unit = float(np.linalg.norm(output) / np.linalg.norm(attitudes.mean))
        size = unit * np.sqrt(np.einsum("nii->n", attitudes.covariance).mean() / 3)
        columns = [_slope(record, output, size * np.eye(3)[axis]) / size for axis in range(3)]
        slope = np.stack(columns, axis=2)
        force_covariance = slope @ (attitudes.covariance * unit**2) @ np.swapaxes(slope, 1, 2)
        joint[range(n), :, range(n), :] = force_covariance + fit_of(record).excess.value ** 2 * np.eye(3)
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


def _slope(record: Calibration, output: Array, step: Array) -> Array:
    """Half the change of the specific force from one step before the outputs to one after, shape (n, 3)."""
    change: Array = (specific_force(record, output + step) - specific_force(record, output - step)) / 2
    return change


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
