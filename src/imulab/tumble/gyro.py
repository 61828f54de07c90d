"""The gyroscope triad on top of calibrated accelerometers.

    M = S (T w + b + G f),  T with unit diagonal and six free off-diagonals

w is the body rate and f the specific force in the accelerometers' frame, G the sensitivity to acceleration. Between two
attitudes the turn that the gyroscopes see must carry the first direction of gravity into the second; the sum of the
squared angles by which it misses is minimised over S and T (and b, if asked). At rest M = S (b + G f): b and G come
from there.

Source: Tedaldi, Pretto, Menegatti, ICRA 2014, section IV; the change of a turn with the rate: Bortz, IEEE Trans. AES-7
(1971) 61; acceleration-sensitive drift: IEEE Std 528.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.attitudes import Attitudes
from imulab.calibration import Calibration
from imulab.errors import DataError, ObservabilityError, OptionError, RecordError, SegmentError
from imulab.estimate import Observability, covariance, f_test, levenberg_marquardt, observability
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.rotation import Turns, weighted_turns
from imulab.tumble.apply import output_factor, specific_force
from imulab.units import parse_unit, to_si

PAIRS = ("xy", "xz", "yx", "yz", "zx", "zy")
SENSITIVITIES = ("auto", "yes", "no")
_ROWS, _COLUMNS = (0, 0, 1, 1, 2, 2), (1, 2, 0, 2, 0, 1)
_EDGE = 0.1  # s back into the 0.3 s of each hold that segmentation drops; slow beginnings of a turn lie there
_FEWEST_TURNS = 8
_LONGEST_TURN = 60.0  # s
_WORST_TURN = np.radians(20.0)
_SIGNIFICANT = 0.01
_START_FACTORS = np.geomspace(0.4, 1.25, 24)


@dataclass(frozen=True)
class GyroFit:
    """A gyroscope triad; arrays of shape (3,) or (3, 3), SI except for the output.

    Attributes
    ----------
    scale_factor
        Output per rad/s.
    misalignment
        T.
    bias
        rad/s.
    sensitivity
        G, rad/s per m/s^2; None where it was not fitted.
    covariance
        Of scale factors, the six misalignments and the biases, shape (12, 12).
    sensitivity_uncertainty
        Standard uncertainties of the sensitivities.
    residuals
        Angle by which each turn misses, rad, shape (m,).
    start, stop
        Time of each turn, s, shape (m,).
    unit
        Of the outputs.
    fit_bias
        Whether the biases were fitted to the turns instead of taken from rest.
    observability
        Of the parameters that were fitted to the turns.
    """

    scale_factor: Array
    misalignment: Array
    bias: Array
    sensitivity: Array | None
    covariance: Array
    sensitivity_uncertainty: Array | None
    residuals: Array
    start: Array
    stop: Array
    unit: str
    fit_bias: bool
    observability: Observability

    @property
    def cost(self) -> float:
        """Sum of the squared angles, rad^2."""
        return float(np.sum(self.residuals**2))


@dataclass(frozen=True)
class _Segments:
    """Turns as steps between samples: mean output less what acceleration adds, (m, n, 3), and durations, (m, n)."""

    output: Array
    step: Array
    before: Array
    after: Array
    start: Array
    stop: Array


@dataclass(frozen=True)
class _Rest:
    """Output at rest: zero (3,), change with specific force (3, 3) or None, and their standard uncertainties."""

    zero: Array
    slope: Array | None
    zero_uncertainty: Array
    slope_uncertainty: Array | None


def fit_gyro(
    record: Calibration,
    attitudes: Attitudes,
    recording: Recording,
    *,
    fit_bias: bool = False,
    sensitivity: str = "auto",
) -> GyroFit:
    """Calibrate a gyroscope triad from the turns between static attitudes.

    Parameters
    ----------
    record
        Tumble record of the accelerometers.
    attitudes
        From `find_attitudes` on the accelerometers' recording.
    recording
        Columns ``time`` and ``gyro_x``, ``_y``, ``_z`` on the same clock; may be the accelerometers' own recording.
    fit_bias
        Fit the biases to the turns too, instead of taking them from the outputs at rest.
    sensitivity
        Whether the zero changes with specific force: ``yes``, ``no``, or ``auto`` where the outputs at rest show it.

    Raises
    ------
    RecordError
        The record is no tumble record.
    SegmentError
        Fewer than eight turns between attitudes.
    DataError
        The columns are missing or not finite, or the gyroscopes do not turn as gravity does.
    ObservabilityError
        The turns cannot separate the parameters.
    OptionError
        `sensitivity` has an unknown value.
    """
    if record.procedure != "tumble":
        raise RecordError(f"a {record.procedure} record holds no accelerometers; expected a tumble record")
    if sensitivity not in SENSITIVITIES:
        raise OptionError(f"g-sensitivity {sensitivity!r}: expected one of {' '.join(SENSITIVITIES)}")
    if attitudes.trace is None:
        raise SegmentError(f"{attitudes.recording.name}: a table of attitudes has no turns between them")
    unit = recording.triad_unit("gyro")
    check_finite(recording, [f"gyro_{axis}" for axis in "xyz"])
    time, output = check_time(recording), recording.triad("gyro")
    factor = output_factor(attitudes.recording.name, "accel", attitudes.unit, str(record.model["output_unit"]))
    force = specific_force(record, attitudes.mean * factor)
    rest = _at_rest(attitudes, time, output, force, sensitivity, recording.name)
    moving = _force_at(record, attitudes.recording, time, factor) if rest.slope is not None else None
    segments = _segments(attitudes, time, output, force, rest, moving, recording.name)
    scale = _start_scale(segments, unit)
    theta, jacobian, residual = _estimate(segments, scale, fit_bias)
    miss = np.linalg.norm(residual.reshape(-1, 3), axis=1)
    if not np.median(miss) < _WORST_TURN:
        raise DataError(
            f"{recording.name}: columns gyro_x gyro_y gyro_z: the turns miss the change of gravity's direction by "
            f"{np.degrees(np.median(miss)):.0f} deg (median of {len(miss)}): swapped or reversed axes, or a wrong unit?"
        )
    # Each turn fixes two angles: how far about its own direction it went, gravity cannot see.
    freedom = 2 * len(miss) - theta.size
    variance = float(residual @ residual) / max(freedom, 1)
    weights = np.full(len(residual), 1 / max(variance, 1e-30))
    seen = observability(jacobian, weights)
    if seen.rank < theta.size:
        confused = " ".join(seen.confused(gyro_names()[: theta.size]))
        raise ObservabilityError(f"{recording.name}: {len(miss)} turns cannot separate {confused}")
    return _result(
        theta, covariance(jacobian[None], weights[None])[0], scale, rest, miss, segments, unit, fit_bias, seen
    )


def gyro_names() -> list[str]:
    """Return the names of the parameters in the order of the covariance."""
    return [
        *(f"gyro_scale_factor_{axis}" for axis in "xyz"),
        *(f"gyro_misalignment_{pair}" for pair in PAIRS),
        *(f"gyro_bias_{axis}" for axis in "xyz"),
    ]


def _result(
    theta: Array,
    matrix: Array,
    scale: Array,
    rest: _Rest,
    miss: Array,
    segments: _Segments,
    unit: str,
    fit_bias: bool,
    seen: Observability,
) -> GyroFit:
    """Turn scaled parameters into the triad."""
    scale_factor = scale * (1 + theta[:3])
    misalignment = np.eye(3)
    misalignment[_ROWS, _COLUMNS] = theta[3:9]
    moved = theta[9:12] if fit_bias else np.zeros(3)
    bias = (rest.zero + scale * moved) / scale_factor
    everything = np.zeros((12, 12))
    everything[: len(matrix), : len(matrix)] = matrix
    if not fit_bias:
        everything[range(9, 12), range(9, 12)] = (rest.zero_uncertainty / scale) ** 2
    derivative = np.diag(np.concatenate([scale, np.ones(6), scale / scale_factor]))
    derivative[range(9, 12), range(3)] = -bias * scale / scale_factor
    return GyroFit(
        scale_factor=scale_factor,
        misalignment=misalignment,
        bias=bias,
        sensitivity=None if rest.slope is None else rest.slope / scale_factor[:, None],
        covariance=derivative @ everything @ derivative.T,
        sensitivity_uncertainty=(
            None if rest.slope_uncertainty is None else rest.slope_uncertainty / scale_factor[:, None]
        ),
        residuals=miss,
        start=segments.start,
        stop=segments.stop,
        unit=unit,
        fit_bias=fit_bias,
        observability=seen,
    )


def _at_rest(attitudes: Attitudes, time: Array, output: Array, force: Array, sensitivity: str, name: str) -> _Rest:
    """Zero and g-sensitivity from the mean outputs of each attitude, least squares over the attitudes."""
    edges = np.searchsorted(time, np.column_stack([attitudes.start, attitudes.stop]))
    if (edges[:, 1] <= edges[:, 0]).any():
        index = int(np.argmax(edges[:, 1] <= edges[:, 0]))
        raise DataError(f"{name}: no samples during {attitudes.label(index)}: do the two recordings share one clock?")
    sums = np.add.reduceat(np.vstack([output, np.zeros((1, 3))]), edges.ravel(), axis=0)[::2]
    mean = sums / np.diff(edges, axis=1)
    n = len(mean)
    flat = mean - mean.mean(axis=0)
    design = np.column_stack([np.ones(n), force])
    solution = np.asarray(np.linalg.lstsq(design, mean, rcond=None)[0], dtype=np.float64)
    left = mean - design @ solution
    costs = float((flat**2).sum()), float((left**2).sum())
    shown = n > 6 and f_test(costs[0], 3, costs[1], 12, 3 * n) < _SIGNIFICANT
    if sensitivity == "no" or (sensitivity == "auto" and not shown):
        scatter: Array = np.sqrt((flat**2).sum(axis=0) / max(n - 1, 1) / n)
        return _Rest(mean.mean(axis=0), None, scatter, None)
    spread: Array = np.sqrt((left**2).sum(axis=0) / max(n - 4, 1))
    root = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    uncertainty: Array = spread[:, None] * root[1:]
    return _Rest(solution[0], solution[1:].T, spread * root[0], uncertainty)


def _force_at(record: Calibration, recording: Recording, time: Array, factor: float) -> Array:
    """Specific force at the gyroscopes' sample times, m/s^2, shape (n, 3)."""
    force = specific_force(record, recording.triad("accel") * factor)
    own = recording.si("time")
    if len(own) == len(time) and np.array_equal(own, time):
        return force
    return np.column_stack([np.interp(time, own, force[:, axis]) for axis in range(3)])


def _segments(
    attitudes: Attitudes, time: Array, output: Array, force: Array, rest: _Rest, moving: Array | None, name: str
) -> _Segments:
    begin, end = attitudes.stop[:-1] + _EDGE, attitudes.start[1:] - _EDGE
    keep = (end > begin) & (end - begin <= _LONGEST_TURN)
    start, stop = np.searchsorted(time, begin[keep]), np.searchsorted(time, end[keep])
    inside_file = (start > 0) & (stop < len(time)) & (stop > start)
    if np.count_nonzero(inside_file) < _FEWEST_TURNS:
        raise SegmentError(
            f"{name}: {np.count_nonzero(inside_file)} turns between attitudes; expected at least {_FEWEST_TURNS}"
        )
    start, stop = start[inside_file], stop[inside_file]
    index = start[:, None] + np.arange(int((stop - start).max()))
    inside = index < stop[:, None]
    here, there = np.where(inside, index, 0), np.where(inside, index + 1, 0)
    mean = 0.5 * (output[here] + output[there]) - rest.zero
    if moving is not None and rest.slope is not None:
        mean = mean - 0.5 * (moving[here] + moving[there]) @ rest.slope.T
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    chosen = np.flatnonzero(keep)[inside_file]
    step = np.where(inside, time[there] - time[here], 0.0)
    return _Segments(mean, step, up[chosen], up[chosen + 1], time[start], time[stop])


def _start_scale(segments: _Segments, unit: str) -> Array:
    """Output per rad/s to start from: by the unit, or what makes the turns fit best with ideal axes."""
    known = parse_unit(unit)
    if known.quantity == "rate":
        return np.full(3, 1 / to_si(1.0, known.symbol))
    angle = np.arccos(np.clip(np.einsum("mi,mi->m", segments.before, segments.after), -1, 1))
    turned = np.linalg.norm((segments.output * segments.step[:, :, None]).sum(axis=1), axis=1)
    # A turn goes at least as far as the direction of gravity does.
    guess = float(np.median((turned / np.maximum(angle, 1e-3))[angle > 0.3])) if (angle > 0.3).any() else 1.0
    few = replace(
        segments, **{f: getattr(segments, f)[:40] for f in ("output", "step", "before", "after", "start", "stop")}
    )
    costs = []
    for factor in _START_FACTORS:
        rate = few.output / (guess * factor)
        carried = weighted_turns(rate, few.step, np.empty((*rate.shape[:2], 0))).matrix
        miss = np.einsum("mij,mj->mi", carried, few.before) - few.after
        costs.append(float(np.median(np.linalg.norm(miss, axis=1))))
    return np.full(3, guess * float(_START_FACTORS[int(np.argmin(costs))]))


def _estimate(segments: _Segments, scale: Array, fit_bias: bool) -> tuple[Array, Array, Array]:
    """Return scaled parameters (p,), Jacobian (3 m, p) and residuals (3 m,)."""

    def model(parameters: Array, index: NDArray[np.intp]) -> tuple[Array, Array]:
        residual, jacobian = _model(segments, scale, parameters[0], fit_bias)
        return residual[None], jacobian[None]

    count = 12 if fit_bias else 9
    fit = levenberg_marquardt(model, np.zeros((1, count)), np.ones((1, 3 * len(segments.before))), tolerance=1e-8)
    return fit.parameters[0], fit.jacobian[0], fit.residuals[0]


def _model(segments: _Segments, scale: Array, theta: Array, fit_bias: bool) -> tuple[Array, Array]:
    """Carried less found direction of each turn, (3 m,), and derivatives, (3 m, p).

    An error ``dw`` of the rate changes a carried direction u by ``C (u x sum C' dw dt)``; dw is linear in the scaled
    output, the rate and a constant, so that five sums per turn hold all derivatives.
    """
    s = scale * (1 + theta[:3])
    t = np.eye(3)
    t[_ROWS, _COLUMNS] = theta[3:9]
    inverse = np.linalg.inv(t)
    scaled = (segments.output - (scale * theta[9:12] if fit_bias else 0.0)) / s
    rate = scaled @ inverse.T
    weights = np.concatenate([scaled, rate, np.ones((*rate.shape[:2], 1))], axis=2)
    turns: Turns = weighted_turns(rate, segments.step, weights)
    found = np.einsum("mij,mj->mi", turns.matrix, segments.before)
    columns = [(k, -inverse[:, k] * (scale / s)[k]) for k in range(3)]
    columns += [(3 + j, -inverse[:, i]) for i, j in zip(_ROWS, _COLUMNS, strict=True)]
    if fit_bias:
        columns += [(6, -inverse[:, k] * (scale / s)[k]) for k in range(3)]
    jacobian = np.empty((len(found), 3, len(columns)))
    for column, (which, direction) in enumerate(columns):
        moved = np.cross(segments.before, turns.weighted[:, which] @ direction)
        jacobian[:, :, column] = np.einsum("mij,mj->mi", turns.matrix, moved)
    return (found - segments.after).ravel(), jacobian.reshape(-1, len(columns))
