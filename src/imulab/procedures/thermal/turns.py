"""Scale factors and misalignments of the gyroscopes over temperature, from the turns of each recording.

Each tumble gives them at its temperature as `imulab.fit_gyro` does. Polynomials are fitted to these by weighted least
squares; recordings share no turn. Misalignments are constant, scale factors too, or of degree 1 where there are turns
at three temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.device.unit import DeviceUnit
from imulab.display import Bad, Note, prefixed
from imulab.errors import DataError, SegmentError
from imulab.estimation.decisions import SCALE_LAW_SCATTERS, SCALE_OFF_UNIT
from imulab.estimation.least_squares import chi_square_probability
from imulab.estimation.rows import leave_out, median
from imulab.procedures.thermal import FOLLOWED, STRETCHES, TURNED
from imulab.procedures.thermal.degrees import (
    number_temperatures,
)
from imulab.procedures.thermal.device import tables_of
from imulab.procedures.thermal.gyro import ThermalGyroscopes, scale_output
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import AXES, Laws, forces
from imulab.procedures.thermal.solve import (
    ThermalProblem,
    ThermalSolution,
)
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.gyro.estimate import TurnEstimate, estimate_turns
from imulab.procedures.tumble.gyro.rest import beyond_range
from imulab.procedures.tumble.gyro.solve import TurnProblem, solve_turns
from imulab.procedures.tumble.gyro.turns import Stamps, by_directions, model
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import parse_unit

CRYSTAL = 50e-6
"""Relative standard uncertainty of the clock by which all recordings are timed."""
_LARGE_MISS, _ASKEW = 2.0, 0.2
"""Error of gravity's direction after turns, deg, and misalignment, rad, from which axes are swapped or reversed."""


@dataclass(frozen=True)
class Turned:
    """Scale factors and misalignments (9,) by the turns of one recording, with their covariance (9, 9).

    `by_shared` are their derivatives by what all recordings share, the coefficients of the accelerometers' laws and the
    g-sensitivities, (9, c); `cost` is the sum of squares of the errors of gravity's direction, rad^2.
    """

    values: Array
    covariance: Array
    by_shared: Array
    temperature: float
    turns: int
    cost: float


@dataclass(frozen=True)
class ScaleLaws:
    """Laws of scale factors, in units of the nominal ones, and misalignments: coefficients and covariance.

    `laws` have the degrees (0, that of the scale factor, 0); `miss` is the rms error of gravity's direction after the
    turns, rad; `chi_square` and `freedom` say how the recordings agree.
    """

    laws: Laws
    coefficients: Array
    covariance: Array
    recordings: int
    turns: int
    miss: float
    chi_square: float
    freedom: int
    notes: tuple[str, ...]

    @property
    def degree(self) -> int:
        """Degree of the scale factors' laws."""
        return self.laws.degrees[1]

    def functions(self, temperature: Array) -> Array:
        """Return the functions of the scale factors' laws, shape (n, degree + 1)."""
        place = self.laws.place(temperature)
        return np.asarray(np.polynomial.chebyshev.chebvander(place, self.degree), dtype=np.float64)

    def scale_at(self, temperature: Array) -> Array:
        """Return the scale factors, shape (n, 3)."""
        rows = self.coefficients[:-6].reshape(3, -1)
        scale: Array = self.functions(temperature) @ rows.T
        return scale


def nominal_output(holds: Holds, record: Calibration, unit: str) -> Array:
    """Return the output per rad/s to start from, shape (3,): 1 for a unit of rate, else by the turns.

    Raises
    ------
    DataError
        The unit is no rate, and there are no turns.
    """
    if parse_unit(unit).quantity == "rate":
        return np.ones(3)
    scales, why = [], "no recording has nine attitudes"
    accelerometers = DeviceUnit.of(tables_of(record)[0])
    for number in _find_turned(holds):
        try:
            solved = solve_turns(*_turn_problem(holds, number, record, accelerometers, np.ones(3), None, unit), "auto")
        except SegmentError as error:
            why = str(error)
            continue
        scales.append(solved.scale * (1 + solved.theta[:3]))
    if not scales:
        raise DataError(
            f"{holds.recordings[0].name}: columns gyro_x gyro_y gyro_z are in {unit}, of which turns between attitudes "
            f"tell the scale; expected a tumble of {TURNED} attitudes or more: {why}"
        )
    return np.asarray(np.mean(scales, axis=0), dtype=np.float64)


def _find_turned(holds: Holds) -> list[int]:
    """Return the numbers of the recordings with attitudes enough for scale factors from turns; a rest ramp has one."""
    pieces = [each.pieces for each in holds.attitudes]
    return [k for k, its in enumerate(pieces) if its is not None and len(np.unique(its[:, 2])) >= TURNED]


def scale_from_turns(
    holds: Holds,
    problem: ThermalProblem,
    solution: ThermalSolution,
    record: Calibration,
    gyros: ThermalGyroscopes,
    reading: Array,
) -> ScaleLaws | None:
    """Return the laws of scale factors and misalignments, None where no recording has turns for them.

    Raises
    ------
    DataError
        The turns miss the change of gravity's direction by far: swapped or reversed axes.

    Parameters
    ----------
    record
        Record of the accelerometers.
    gyros
        Biases and g-sensitivities at nominal scale factors.
    reading
        Output of the accelerometers per unit of `problem`, shape (3,).
    """
    turned: list[Turned] = []
    notes: list[str] = []
    numbers = _find_turned(holds)
    if not numbers:
        return None
    accelerometers = DeviceUnit.of(tables_of(record)[0])
    for number in numbers:
        attitudes = holds.attitudes[number]
        case, stamps = _turn_problem(holds, number, record, accelerometers, gyros.held.size, gyros, "rad/s")
        try:
            solved = solve_turns(case, stamps, "no")
        except SegmentError as error:
            notes.append(Note(f"gyro: no scale factors from {error}"))
            continue
        notes += [prefixed(holds.recordings[number].name, note) for note in solved.notes]
        if 2 * len(solved.segments.start) <= solved.theta.size or not solved.converged:
            notes.append(Note(f"gyro: {case.name}: its turns do not tell scale factors and misalignment apart"))
            continue
        temperature = _mean_temperatures(holds, number, attitudes)
        across, moved = _covariance_of_directions(problem, solution, attitudes, reading, temperature)
        estimate = estimate_turns(solved, across, solved.rest.zero_uncertainty)
        step = median(np.diff(stamps.time))
        notes += [prefixed(holds.recordings[number].name, note) for note in estimate.notes(step)]
        turned.append(_evaluate_turns(estimate, moved, float(temperature.mean())))
    if not turned:
        return None
    known = block_diagonal(
        solution.covariance[: solution.laws.size, : solution.laws.size],
        gyros.solution.covariance[gyros.size : gyros.count, gyros.size : gyros.count]
        if gyros.sensitivity
        else np.zeros((9, 9)),
    )
    # Sampling and losses act alike in all recordings: they are no noise that many of them take the mean of.
    known = block_diagonal(known, np.eye(2))
    return _fit_scale_laws(turned, known, solution.laws, notes)


def _evaluate_turns(estimate: TurnEstimate, moved: Array, temperature: float) -> Turned:
    """Return scale factors and misalignments by the turns of one recording.

    `moved` is how the directions change with what all recordings share, (3 n, c).
    """
    solved = estimate.solution
    size = np.concatenate([solved.scale, np.ones(6)])
    values = solved.theta * size
    values[:3] += solved.scale
    slope = by_directions(solved.segments, solved.scale, solved.theta, len(moved) // 3) @ moved
    slope = np.hstack([slope, _derivatives_by_sensitivity(estimate)])
    by_shared = size[:, None] * np.hstack([estimate.gain @ estimate.project(slope), estimate.common()])
    turns, cost = len(solved.segments.start), float(solved.residual @ solved.residual)
    return Turned(values, estimate.covariance * np.outer(size, size), by_shared, temperature, turns, cost)


def _derivatives_by_sensitivity(estimate: TurnEstimate) -> Array:
    """Return the derivatives of the residuals by the subtracted g-sensitivities, rad per rad/s/g, shape (3 m, 9).

    A g-sensitivity acts as a zero: times the force half-way in the turn less the mean force over the holds, which is in
    the zero at rest.
    """
    solved, segments = estimate.solution, estimate.solution.segments
    m = len(segments.start)
    zero = model(segments, solved.scale, np.concatenate([solved.theta[:9], np.zeros(3)]), fit_bias=True)[1][:, 9:]
    middle = 0.5 * (segments.before + segments.after)
    felt = (zero / solved.scale).reshape(m, 3, 3, 1) * (middle - middle.mean(axis=0))[:, None, None, :]
    return np.asarray(felt.reshape(3 * m, 9), dtype=np.float64)


def _fit_scale_laws(turned: list[Turned], known: Array, over: Laws, notes: list[str]) -> ScaleLaws:
    """Return polynomials through the scale factors of each recording by weighted least squares.

    `known` is the covariance of what all recordings share.
    """
    temperature = np.array([each.temperature for each in turned])
    degree = 1 if number_temperatures(temperature).max() + 1 >= FOLLOWED else 0
    laws = Laws(over.low, over.high, (0, degree, 0))
    functions = np.polynomial.chebyshev.chebvander(laws.place(temperature), degree)
    size, n = 3 * (degree + 1), len(turned)
    design = np.zeros((n, 9, size + 6))
    design[:, :3, :size] = np.einsum("ij,nk->nijk", np.eye(3), functions).reshape(n, 3, size)
    design[:, 3:, size:] = np.eye(6)
    rows: Array = design.reshape(9 * n, size + 6)
    values = np.concatenate([each.values for each in turned])
    by_coefficients = np.vstack([each.by_shared for each in turned])
    whole = by_coefficients @ known @ by_coefficients.T
    for k, each in enumerate(turned):
        block = slice(9 * k, 9 * k + 9)
        whole[block, block] += each.covariance
    weight = np.linalg.inv(whole)
    matrix = np.linalg.inv(rows.T @ weight @ rows)
    coefficients = matrix @ (rows.T @ weight @ values)
    left = values - rows @ coefficients
    square = float(left @ weight @ left)
    freedom = 9 * len(turned) - len(coefficients)
    if freedom and chi_square_probability(square, freedom) < SCALE_LAW_SCATTERS.level:
        notes.append(
            f"gyro: the scale factors of {len(turned)} recordings differ by more than their uncertainties explain "
            f"(chi-square {square:.0f} of {freedom}), which are widened: turn at more temperatures, and further"
        )
        matrix = matrix * square / freedom
    common = np.concatenate([coefficients[:size], np.zeros(6)]) * CRYSTAL
    matrix = matrix + np.outer(common, common)
    if not degree:
        notes += _warn_constant(float(temperature.mean()), over, float(np.sqrt(np.diag(matrix)[:3].max())))
    middle = coefficients[: size : degree + 1] - 1
    if np.abs(middle).max() > SCALE_OFF_UNIT:
        off = " ".join(f"{100 * value:+.1f}" for value in middle)
        notes.append(
            Bad(
                f"gyro: the scale factors are off by {off} % (x y z): is the unit, or the sample rate, wrong?",
                "check the unit of the gyroscopes and the sample rate of the recordings",
            )
        )
    turns = sum(each.turns for each in turned)
    miss = float(np.sqrt(sum(each.cost for each in turned) / turns))
    if np.degrees(miss) > _LARGE_MISS or np.abs(coefficients[size:]).max() > _ASKEW:
        notes.append(
            Bad(
                f"gyro: the turns miss the change of gravity's direction by {np.degrees(miss):.2g} deg rms, with axes "
                f"askew by up to {1e3 * np.abs(coefficients[size:]).max():.0f} mrad: swapped or reversed axes?",
                "check axes and signs of the gyroscopes against the accelerometers",
            )
        )
    return ScaleLaws(laws, coefficients, matrix, len(turned), turns, miss, square, freedom, tuple(notes))


def _warn_constant(temperature: float, over: Laws, stated: float) -> list[str]:
    """Return a warning of the usual slope of scale factors measured at one temperature, if large beside `stated`."""
    end = max(over.low, over.high, key=lambda each: abs(each - temperature))
    off = STRETCHES * abs(end - temperature)
    if off < 0.5 * stated:
        return []
    return [
        f"gyro: turns at about {temperature:.0f} degC do not tell whether scale factors follow the temperature, which "
        f"are taken as constant: one that moves by {1e6 * STRETCHES:.0f} ppm/K, as is usual, is off by "
        f"{1e6 * off:.0f} ppm at {end:.0f} degC, where its uncertainty is {1e6 * stated:.0f} ppm: turn the unit at "
        f"{FOLLOWED} temperatures or more"
    ]


def _mean_temperatures(holds: Holds, number: int, attitudes: Attitudes) -> Array:
    """Return the mean temperature of each attitude, degC."""
    recording = holds.recordings[number]
    time, temperature = recording.si("time"), recording.si("temperature")
    total = np.concatenate([[0.0], np.cumsum(temperature)])
    first, last = np.searchsorted(time, attitudes.start), np.searchsorted(time, attitudes.stop, side="right")
    means: Array = (total[last] - total[first]) / (last - first)
    return means


def _turn_problem(
    holds: Holds,
    number: int,
    record: Calibration,
    accelerometers: DeviceUnit,
    size: Array,
    gyros: ThermalGyroscopes | None,
    unit: str,
) -> tuple[TurnProblem, Stamps]:
    """Return the turns of one recording, less biases and g-sensitivities, and the times of its samples."""
    recording, gyroscopes, attitudes = holds.recordings[number], holds.gyroscopes[number], holds.attitudes[number]
    kept = leave_out(gyroscopes, triad("gyro")).recording
    accel_time, time = recording.si("time"), gyroscopes.si("time")
    mean = accelerometers.thermal(_mean_temperatures(holds, number, attitudes), list(attitudes.mean.T))[0]
    each = accelerometers.thermal(recording.si("temperature"), list(recording.triad("accel").T))[0]
    force, accel_force = np.column_stack(mean), np.column_stack(each)
    output = scale_output(kept, size)
    if gyros is not None:
        clipped = beyond_range(output)
        output = output - gyros.at_rest(gyroscopes.si("temperature"))
        if gyros.sensitivity:
            felt = accel_force
            if gyroscopes is not recording:
                felt = np.column_stack([np.interp(time, accel_time, axis) for axis in accel_force.T])
            output = output - felt @ gyros.sensitivities(record.model["gravity"]["value"]).T
        output[clipped] = 2 * np.abs(output).max()  # a saturated sample stays one, so that its turn is left out
    knocked: NDArray[np.bool_] = np.zeros(len(attitudes), dtype=np.bool_)
    case = TurnProblem(
        recording.name, attitudes, force, accel_time, accel_force, output, unit, fit_bias=False, knocked=knocked
    )
    return case, Stamps(time, time)


def _covariance_of_directions(
    problem: ThermalProblem, solution: ThermalSolution, attitudes: Attitudes, reading: Array, temperature: Array
) -> tuple[Array, Array]:
    """Return the covariance of the directions up, rad^2, (3 n, 3 n), and their derivatives by the laws, (3 n, c).

    The covariance is that of the offset of the power cycle; the noise, what scatters beyond it, and the accelerometers'
    laws are counted elsewhere.
    """
    n, size = len(attitudes), solution.laws.size
    design = solution.laws.design(temperature)
    parameters = design @ solution.coefficients[:size]
    force, change = forces(parameters, attitudes.mean / reading)
    moved = np.einsum("nij,njc->nic", change, design)
    offset = solution.scatter.tau[0] * change[:, :, :3].reshape(3 * n, 3)
    joint = (offset @ offset.T).reshape(n, 3, n, 3)
    length = np.linalg.norm(force, axis=1)
    up = force / length[:, None]
    across = (np.eye(3) - up[:, :, None] * up[:, None, :]) / length[:, None, None]
    covariance: Array = np.einsum("nij,njmk,mlk->niml", across, joint, across, optimize=True).reshape(3 * n, 3 * n)
    return covariance, (across @ moved).reshape(3 * n, size)


def rescale_gyroscopes(gyros: ThermalGyroscopes, scale: ScaleLaws) -> ThermalGyroscopes:
    """Return biases and g-sensitivities refitted to outputs over these scale factors, without their uncertainty."""
    factor = 1 / scale.scale_at(gyros.held.temperature)
    held = replace(
        gyros.held,
        mean=gyros.held.mean * factor,
        covariance=gyros.held.covariance * factor[:, :, None] * factor[:, None, :],
    )
    return gyros.refit(held)


def block_diagonal(first: Array, second: Array) -> Array:
    """Return a matrix with two blocks on its diagonal."""
    joined = np.zeros((len(first) + len(second), first.shape[1] + second.shape[1]))
    joined[: len(first), : first.shape[1]], joined[len(first) :, first.shape[1] :] = first, second
    return joined


def joint_covariance(gyros: ThermalGyroscopes, scale: ScaleLaws) -> Array:
    """Return the covariance of the coefficients of `gyros`, fitted to outputs over S(T), and of those of `scale`."""
    solution, held = gyros.solution, gyros.held
    white = solution.white
    inverse = np.linalg.pinv(white(solution.rows.jacobian), rcond=1e-13)
    # db / dS: each mean changes by -mean / S for a unit of S.
    functions, size = scale.functions(held.temperature), len(scale.coefficients) - 6
    moved = np.zeros((len(held), 3, len(scale.coefficients)))
    each = -(held.mean / scale.scale_at(held.temperature))[:, :, None] * functions[:, None, :]
    for k in range(len(AXES)):
        moved[:, k, k * functions.shape[1] : (k + 1) * functions.shape[1]] = each[:, k]
    assert functions.shape[1] * len(AXES) == size
    n = gyros.count
    slope = (inverse @ white(moved.reshape(-1, len(scale.coefficients))))[:n]
    joint = np.zeros((n + len(scale.coefficients),) * 2)
    joint[:n, :n] = solution.covariance[:n, :n] + slope @ scale.covariance @ slope.T
    joint[:n, n:] = slope @ scale.covariance
    joint[n:, :n] = joint[:n, n:].T
    joint[n:, n:] = scale.covariance
    return joint
