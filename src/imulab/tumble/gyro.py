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
from imulab.estimate import Observability, covariance, levenberg_marquardt, observability
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.rotation import Turns, composed_turns, weighted_turns
from imulab.tumble.apply import output_factor, specific_force
from imulab.tumble.directions import direction_covariance
from imulab.tumble.gyrorest import SENSITIVITIES, Holds, Rest, at_rest, beyond_range, clock_notes, find_holds
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit, to_si

PAIRS = ("xy", "xz", "yx", "yz", "zx", "zy")
_ROWS, _COLUMNS = (0, 0, 1, 1, 2, 2), (1, 2, 0, 2, 0, 1)
_FEWEST_TURNS = 8
_FOREIGN, _TOUCHED = 5.0, 1e-3 * STANDARD_GRAVITY
_LONGEST_TURN = 60.0  # s
_WORST_TURN = np.radians(20.0)
_COARSE = 4  # steps taken as one where a scale factor is only to be found roughly
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
    notes
        What a user should know, a sentence each.
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
    notes: tuple[str, ...] = ()

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
    attitude: NDArray[np.intp]
    """Index of the attitude before each turn; the one after it is the next."""


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
    means = attitudes.mean * factor
    force = specific_force(record, means)
    holds = find_holds(attitudes, time, output, recording.name)
    rest = at_rest(holds, output, force, sensitivity)
    moving = _force_at(record, attitudes.recording, time, factor) if rest.slope is not None else None
    segments, notes = _segments(holds, time, output, force, rest, moving, recording.name)
    notes += _record_notes(record, attitudes, force)
    if attitudes.recording is not recording:
        notes += clock_notes(holds, attitudes, time)
    scale = _start_scale(segments, unit)
    theta, jacobian, residual, converged = _estimate(segments, scale, fit_bias)
    miss = np.linalg.norm(residual.reshape(-1, 3), axis=1)
    if not np.median(miss) < _WORST_TURN:
        raise DataError(
            f"{recording.name}: columns gyro_x gyro_y gyro_z: the turns miss the change of gravity's direction by "
            f"{np.degrees(np.median(miss)):.0f} deg (median of {len(miss)}): swapped or reversed axes, or a wrong unit?"
        )
    # Each turn fixes two angles: how far about its own direction it went, gravity cannot see.
    freedom = max(2 * len(miss) - theta.size, 1)
    seen = observability(jacobian, np.full(len(residual), freedom / max(float(residual @ residual), 1e-30)))
    if seen.rank < theta.size:
        confused = " ".join(seen.confused(gyro_names()[: theta.size]))
        raise ObservabilityError(f"{recording.name}: {len(miss)} turns cannot separate {confused}")
    if not converged:
        raise DataError(
            f"{recording.name}: the fit of the gyroscopes does not converge on these {len(miss)} turns "
            f"(condition number {seen.condition:.0f}); use more turns, about more directions"
        )
    known = direction_covariance(record, attitudes, means, force)
    matrix = _covariance(segments, scale, theta, jacobian, residual, known, None if fit_bias else rest)
    result = _result(theta, matrix, scale, rest, miss, segments, unit, fit_bias, seen)
    return replace(result, notes=tuple(notes))


def _record_notes(record: Calibration, attitudes: Attitudes, force: Array) -> list[str]:
    """Say if the accelerometers' record is hardly of this unit."""
    mine, its = record.sensor.get("serial"), attitudes.recording.metadata.get("serial")
    found = [f"gyro: the record is of {mine}, the recording of {its}"] if mine and its and mine != its else []
    length = np.linalg.norm(force, axis=1)
    scatter, usual = float(length.std()), float(record.fit["rms"]["value"])
    if scatter > _FOREIGN * usual + _TOUCHED:
        found.append(
            f"gyro: under the record |f| scatters by {from_si(scatter, 'mg'):.3g} mg from attitude to attitude, by "
            f"{from_si(usual, 'mg'):.3g} mg when it was made: is it of this unit?"
        )
    return found


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
    rest: Rest,
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


def _force_at(record: Calibration, recording: Recording, time: Array, factor: float) -> Array:
    """Specific force at the gyroscopes' sample times, m/s^2, shape (n, 3)."""
    force = specific_force(record, recording.triad("accel") * factor)
    own = recording.si("time")
    if len(own) == len(time) and np.array_equal(own, time):
        return force
    return np.column_stack([np.interp(time, own, force[:, axis]) for axis in range(3)])


def _segments(
    holds: Holds, time: Array, output: Array, force: Array, rest: Rest, moving: Array | None, name: str
) -> tuple[_Segments, list[str]]:
    begin, end = holds.leave[:-1], holds.arrive[1:]
    clipped = np.vstack([np.zeros((1, 3), dtype=np.int64), np.cumsum(beyond_range(output), axis=0)])
    turns = (end > begin) & (time[end] - time[begin] <= _LONGEST_TURN)
    beyond = (clipped[end + 1] > clipped[begin]) & turns[:, None]
    chosen = np.flatnonzero(turns & ~beyond.any(axis=1))
    notes = []
    if beyond.any():
        axes = " ".join(f"gyro_{'xyz'[axis]}" for axis in range(3) if beyond[:, axis].any())
        where = np.flatnonzero(beyond.any(axis=1))
        at = " ".join(f"{t:.1f}" for t in time[begin[where[:6]]].tolist()) + (" ..." if len(where) > 6 else "")
        notes.append(f"gyro: {len(where)} turns left out, clipped: {axes} stay at the end of their range (from {at} s)")
    if len(chosen) < _FEWEST_TURNS:
        aside = f" ({int(beyond.any(axis=1).sum())} more are clipped)" if notes else ""
        raise SegmentError(f"{name}: {len(chosen)} turns between attitudes{aside}; expected at least {_FEWEST_TURNS}")
    start, stop = begin[chosen], end[chosen]
    index = start[:, None] + np.arange(int((stop - start).max()))
    inside = index < stop[:, None]
    here, there = np.where(inside, index, 0), np.where(inside, index + 1, 0)
    mean = 0.5 * (output[here] + output[there]) - rest.zero
    if moving is not None and rest.slope is not None:
        mean = mean - 0.5 * (moving[here] + moving[there]) @ rest.slope.T
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    step = np.where(inside, time[there] - time[here], 0.0)
    return _Segments(mean, step, up[chosen], up[chosen + 1], time[start], time[stop], chosen), notes


def _start_scale(segments: _Segments, unit: str) -> Array:
    """Output per rad/s to start from: by the unit, or what makes the turns fit best with ideal axes."""
    known = parse_unit(unit)
    if known.quantity == "rate":
        return np.full(3, 1 / to_si(1.0, known.symbol))
    angle = np.arccos(np.clip(np.einsum("mi,mi->m", segments.before, segments.after), -1, 1))
    turned = np.linalg.norm((segments.output * segments.step[:, :, None]).sum(axis=1), axis=1)
    # A turn goes at least as far as the direction of gravity does.
    guess = float(np.median((turned / np.maximum(angle, 1e-3))[angle > 0.3])) if (angle > 0.3).any() else 1.0
    few = slice(None, 40)
    angle_steps = segments.output[few] * segments.step[few, :, None]
    missing = -angle_steps.shape[1] % _COARSE
    coarse = np.pad(angle_steps, ((0, 0), (0, missing), (0, 0))).reshape(len(angle_steps), -1, _COARSE, 3).sum(axis=2)
    costs = []
    for factor in _START_FACTORS:
        miss = (
            np.einsum("mij,mj->mi", composed_turns(coarse / (guess * factor)), segments.before[few])
            - segments.after[few]
        )
        costs.append(float(np.median(np.linalg.norm(miss, axis=1))))
    return np.full(3, guess * float(_START_FACTORS[int(np.argmin(costs))]))


def _estimate(segments: _Segments, scale: Array, fit_bias: bool) -> tuple[Array, Array, Array, bool]:
    """Return scaled parameters (p,), Jacobian (3 m, p), residuals (3 m,), and whether the steps became small."""

    def model(parameters: Array, index: NDArray[np.intp]) -> tuple[Array, Array]:
        residual, jacobian = _model(segments, scale, parameters[0], fit_bias)
        return residual[None], jacobian[None]

    count = 12 if fit_bias else 9
    fit = levenberg_marquardt(model, np.zeros((1, count)), np.ones((1, 3 * len(segments.before))), tolerance=1e-8)
    return fit.parameters[0], fit.jacobian[0], fit.residuals[0], bool(fit.converged[0])


def _covariance(
    segments: _Segments, scale: Array, theta: Array, jacobian: Array, residual: Array, known: Array, rest: Rest | None
) -> Array:
    """Covariance of a least-squares estimate whose observations share errors: (J'J)^-1 J' V J (J'J)^-1.

    V is what the directions of gravity (`known`) and the zero at rest bring to the residuals, and a common variance of
    each for all else, which takes up what the residuals scatter beyond them.
    """
    m, size = len(segments.before), theta.size
    turn = _turns(segments, scale, theta)
    rows = jacobian.reshape(m, 3, size)
    count = len(known) // 3
    seen = np.zeros((count, 3, size))
    np.add.at(seen, segments.attitude, np.swapaxes(turn, 1, 2) @ rows)
    np.add.at(seen, segments.attitude + 1, -rows)
    pulled = seen.reshape(3 * count, size)
    meat: Array = pulled.T @ known @ pulled
    blocks = known.reshape(count, 3, count, 3)
    here, there = segments.attitude, segments.attitude + 1
    spent = float(
        np.einsum("mii->", blocks[here, :, here]) + np.einsum("mii->", blocks[there, :, there])
        - 2 * np.einsum("mij,mji->", turn, blocks[here, :, there])
    )  # fmt: skip
    if rest is not None:
        zero = _model(segments, scale, np.concatenate([theta, np.zeros(3)]), fit_bias=True)[1][:, size:]
        zero = zero * (rest.zero_uncertainty / scale)
        meat += (jacobian.T @ zero) @ (zero.T @ jacobian)
        spent += float((zero**2).sum())
    bread = covariance(jacobian[None], np.ones((1, 3 * m)))[0]
    left = float(residual @ residual) - (spent - float(np.trace(bread @ meat)))
    variance = max(left, 0.0) / max(2 * m - size, 1)
    found: Array = bread @ meat @ bread + variance * bread
    return found


def _turns(segments: _Segments, scale: Array, theta: Array) -> Array:
    """Matrices of the turns under given parameters, shape (m, 3, 3)."""
    t = np.eye(3)
    t[_ROWS, _COLUMNS] = theta[3:9]
    moved = scale * theta[9:12] if theta.size > 9 else 0.0
    rate = (segments.output - moved) / (scale * (1 + theta[:3])) @ np.linalg.inv(t).T
    return composed_turns(rate * segments.step[:, :, None])


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
