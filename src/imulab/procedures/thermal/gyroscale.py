"""Scale factors and misalignment of the gyroscopes: from the turns of each recording, then as laws of the temperature.

Each tumble tells them at its temperature as `imulab.fit_gyro` does, with their covariance. Polynomials through these,
each weighed by it, are the joint estimate: recordings share no turn. Misalignment is constant, the scale factor too,
or of degree 1 where there are turns at three temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.device.unit import DeviceUnit
from imulab.errors import DataError, SegmentError
from imulab.estimation.least_squares import chi_square_probability
from imulab.estimation.rows import leave_out
from imulab.procedures.thermal.choices import FOLLOWED, STRETCHES, TURNED
from imulab.procedures.thermal.degrees import clusters_of
from imulab.procedures.thermal.device import tables_of
from imulab.procedures.thermal.gyro import Gyroscopes
from imulab.procedures.thermal.gyroholds import output_in
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import AXES, Laws, forces
from imulab.procedures.thermal.rows import Problem
from imulab.procedures.thermal.solve import Solution
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.gyrorest import beyond_range
from imulab.procedures.tumble.gyrosolve import Case, Solved, solve_turns, turn_covariance
from imulab.procedures.tumble.gyroturns import by_directions, model, shared_covariance
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import parse_unit
from imulab.verdict import Bad, Note

CRYSTAL = 50e-6
"""Standard uncertainty of the rate of the clock that all recordings are timed by."""
_SIGNIFICANT = 0.01
_WORST = 0.1
_LARGE_MISS, _ASKEW = 2.0, 0.2  # deg, rad


@dataclass(frozen=True)
class Turned:
    """What the turns of a recording say: scale factors and misalignments (9,), and how they miss.

    Their covariance (9, 9), and their derivatives by what all share: the coefficients of the accelerometers' laws and
    the g-sensitivities, (9, c).
    """

    values: Array
    covariance: Array
    by_shared: Array
    temperature: float
    turns: int
    cost: float


@dataclass(frozen=True)
class ScaleLaws:
    """Scale factors in units of the nominal ones, then misalignments: coefficients, covariance, and how they agree.

    `laws` have the degrees (0, that of the scale factor, 0); `freedom` is that of the chi-square of the recordings.
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
        """Of the scale factor."""
        return self.laws.degrees[1]

    def functions(self, temperature: Array) -> Array:
        """Return the functions of the scale factors' laws, shape (n, degree + 1)."""
        place = self.laws.place(temperature)
        return np.asarray(np.polynomial.chebyshev.chebvander(place, self.degree), dtype=np.float64)

    def scale_at(self, temperature: Array) -> Array:
        """Return the scale factors, shape (n, 3)."""
        rows = self.coefficients[:-6].reshape(3, -1)
        found: Array = self.functions(temperature) @ rows.T
        return found


def nominal_output(holds: Holds, record: Calibration, unit: str) -> Array:
    """Return the output per rad/s to start from, shape (3,): that of the unit, or of the turns where it is no rate.

    Raises
    ------
    DataError
        The unit is no rate, and there are no turns.
    """
    if parse_unit(unit).quantity == "rate":
        return np.ones(3)
    found, why = [], "no recording has nine attitudes"
    for number, attitudes in enumerate(holds.attitudes):
        if not _turns(attitudes):
            continue
        try:
            solved = solve_turns(*_case(holds, number, record, np.ones(3), None, unit), "auto")
        except SegmentError as error:
            why = str(error)
            continue
        found.append(solved.scale * (1 + solved.theta[:3]))
    if not found:
        raise DataError(
            f"{holds.recordings[0].name}: columns gyro_x gyro_y gyro_z are in {unit}, of which turns between attitudes "
            f"tell the scale; expected a tumble of {TURNED} attitudes or more: {why}"
        )
    return np.asarray(np.mean(found, axis=0), dtype=np.float64)


def _turns(attitudes: Attitudes) -> bool:
    """Whether a recording has attitudes enough for turns to tell anything; one that rests while it drifts has one."""
    return attitudes.pieces is not None and len(np.unique(attitudes.pieces[:, 2])) >= TURNED


def scale_from_turns(
    holds: Holds, problem: Problem, solution: Solution, record: Calibration, gyros: Gyroscopes, reading: Array
) -> ScaleLaws | None:
    """Return the laws of scale factors and misalignments, None where no recording tells them.

    Raises
    ------
    DataError
        The turns miss the change of gravity's direction by far: swapped or reversed axes.

    Parameters
    ----------
    record
        Of the accelerometers.
    gyros
        Biases and g-sensitivities at nominal scale factors.
    reading
        Output of the accelerometers per unit of `problem`, shape (3,).
    """
    found: list[Turned] = []
    notes: list[str] = []
    for number, attitudes in enumerate(holds.attitudes):
        if not _turns(attitudes):
            continue
        case, time = _case(holds, number, record, gyros.held.size, gyros, "rad/s")
        try:
            solved = solve_turns(case, time, "no")
        except SegmentError as error:
            notes.append(Note(f"gyro: no scale factors from {error}"))
            continue
        notes += [f"{holds.recordings[number].name}: {note}" for note in solved.notes]
        freedom = 2 * len(solved.segments.start) - solved.theta.size
        if freedom < 1 or not solved.converged:
            notes.append(Note(f"gyro: {case.name}: its turns do not tell scale factors and misalignment apart"))
            continue
        temperature = _temperature(holds, number, attitudes)
        found.append(
            _turned(solved, _directions(problem, solution, attitudes, reading, temperature), temperature, freedom)
        )
    if not found:
        return None
    known = block_diagonal(
        solution.covariance[: solution.laws.size, : solution.laws.size],
        gyros.solution.covariance[gyros.size : gyros.count, gyros.size : gyros.count]
        if gyros.sensitivity
        else np.zeros((9, 9)),
    )
    return _laws(found, known, solution.laws, notes)


def _turned(solved: Solved, directions: tuple[Array, Array], temperature: Array, freedom: int) -> Turned:
    """Return what the turns of one recording say; `directions` as of `_directions`."""
    own, moved = directions
    segments, jacobian = solved.segments, solved.jacobian
    shared = shared_covariance(segments, solved.scale, solved.theta, own, solved.rest.zero_uncertainty)
    size = np.concatenate([solved.scale, np.ones(6)])
    values = solved.theta * size
    values[:3] += solved.scale
    matrix = turn_covariance(solved, shared, freedom)[0]
    slope = by_directions(segments, solved.scale, solved.theta, len(moved) // 3) @ moved
    slope = np.hstack([slope, _by_sensitivity(solved)])
    by_coefficients = -size[:, None] * np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ slope)
    turns, cost = len(segments.start), float(solved.residual @ solved.residual)
    matrix = matrix * np.outer(size, size)
    return Turned(values, matrix, by_coefficients, float(temperature.mean()), turns, cost)


def _by_sensitivity(solved: Solved) -> Array:
    """Return the derivatives of the residuals by the g-sensitivities that were taken off, rad per rad/s/g, (3 m, 9).

    They act as a zero that is theirs times the force: half-way in a turn, less its mean over the holds, which is in the
    zero at rest.
    """
    segments, m = solved.segments, len(solved.segments.start)
    zero = model(segments, solved.scale, np.concatenate([solved.theta[:9], np.zeros(3)]), fit_bias=True)[1][:, 9:]
    middle = 0.5 * (segments.before + segments.after)
    felt = (zero / solved.scale).reshape(m, 3, 3, 1) * (middle - middle.mean(axis=0))[:, None, None, :]
    return np.asarray(felt.reshape(3 * m, 9), dtype=np.float64)


def _laws(found: list[Turned], known: Array, over: Laws, notes: list[str]) -> ScaleLaws:
    """Return the polynomials through what each recording says; `known` is the covariance of what all share."""
    temperature = np.array([each.temperature for each in found])
    degree = 1 if clusters_of(temperature).max() + 1 >= FOLLOWED else 0
    laws = Laws(over.low, over.high, (0, degree, 0))
    functions = np.polynomial.chebyshev.chebvander(laws.place(temperature), degree)
    size, n = 3 * (degree + 1), len(found)
    design = np.zeros((n, 9, size + 6))
    design[:, :3, :size] = np.einsum("ij,nk->nijk", np.eye(3), functions).reshape(n, 3, size)
    design[:, 3:, size:] = np.eye(6)
    rows: Array = design.reshape(9 * n, size + 6)
    values = np.concatenate([each.values for each in found])
    by_coefficients = np.vstack([each.by_shared for each in found])
    whole = by_coefficients @ known @ by_coefficients.T
    for k, each in enumerate(found):
        own = slice(9 * k, 9 * k + 9)
        whole[own, own] += each.covariance
    weight = np.linalg.inv(whole)
    matrix = np.linalg.inv(rows.T @ weight @ rows)
    coefficients = matrix @ (rows.T @ weight @ values)
    left = values - rows @ coefficients
    square = float(left @ weight @ left)
    freedom = 9 * len(found) - len(coefficients)
    if freedom and chi_square_probability(square, freedom) < _SIGNIFICANT:
        notes.append(
            f"gyro: the scale factors of {len(found)} recordings differ by more than their uncertainties explain "
            f"(chi-square {square:.0f} of {freedom}), which are widened: turn at more temperatures, and further"
        )
        matrix = matrix * square / freedom
    common = np.concatenate([coefficients[:size], np.zeros(6)]) * CRYSTAL
    matrix = matrix + np.outer(common, common)
    if not degree:
        notes += _constant(float(temperature.mean()), over, float(np.sqrt(np.diag(matrix)[:3].max())))
    middle = coefficients[: size : degree + 1] - 1
    if np.abs(middle).max() > _WORST:
        off = " ".join(f"{100 * value:+.3g}" for value in middle)
        notes.append(
            Bad(f"gyro: the scale factors are off by {off} % (x y z): is the unit, or the sample rate, wrong?")
        )
    turns = sum(each.turns for each in found)
    miss = float(np.sqrt(sum(each.cost for each in found) / turns))
    if np.degrees(miss) > _LARGE_MISS or np.abs(coefficients[size:]).max() > _ASKEW:
        notes.append(
            Bad(
                f"gyro: the turns miss the change of gravity's direction by {np.degrees(miss):.2g} deg rms, with axes "
                f"askew by up to {1e3 * np.abs(coefficients[size:]).max():.0f} mrad: swapped or reversed axes?"
            )
        )
    return ScaleLaws(laws, coefficients, matrix, len(found), turns, miss, square, freedom, tuple(notes))


def _constant(temperature: float, over: Laws, stated: float) -> list[str]:
    """Return what scale factors told at about one temperature may be off by elsewhere, if it counts beside `stated`."""
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


def _temperature(holds: Holds, number: int, attitudes: Attitudes) -> Array:
    """Return the mean temperature of each attitude, degC."""
    recording = holds.recordings[number]
    time, temperature = recording.si("time"), recording.si("temperature")
    total = np.concatenate([[0.0], np.cumsum(temperature)])
    first, last = np.searchsorted(time, attitudes.start), np.searchsorted(time, attitudes.stop, side="right")
    found: Array = (total[last] - total[first]) / (last - first)
    return found


def _case(
    holds: Holds, number: int, record: Calibration, size: Array, gyros: Gyroscopes | None, unit: str
) -> tuple[Case, Array]:
    """Return the turns of one recording, its biases and g-sensitivities taken off, and the times of its samples."""
    recording, attitudes = holds.recordings[number], holds.attitudes[number]
    kept = leave_out(recording, triad("gyro")).recording
    time, temperature = recording.si("time"), recording.si("temperature")
    unit_of = DeviceUnit.of(tables_of(record)[0])
    force = np.column_stack(unit_of.thermal(_temperature(holds, number, attitudes), list(attitudes.mean.T))[0])
    own = np.column_stack(unit_of.thermal(temperature, list(recording.triad("accel").T))[0])
    output = output_in(kept, size)
    if gyros is not None:
        clipped = beyond_range(output)
        output = output - gyros.at_rest(temperature)
        if gyros.sensitivity:
            output = output - own @ gyros.sensitivities(record.model["gravity"]["value"]).T
        output[clipped] = 2 * np.abs(output).max()  # what was cut off stays so, and is left out with its turn
    knocked: NDArray[np.bool_] = np.zeros(len(attitudes), dtype=np.bool_)
    case = Case(recording.name, attitudes, force, time, own, output, unit, fit_bias=False, knocked=knocked)
    return case, time


def _directions(
    problem: Problem, solution: Solution, attitudes: Attitudes, reading: Array, temperature: Array
) -> tuple[Array, Array]:
    """Return the covariance of the attitudes' upward directions, rad^2, (3 n, 3 n), but for the accelerometers' laws.

    And how they move with the coefficients of these, (3 n, c).
    """
    n, size = len(attitudes), solution.laws.size
    design = solution.laws.design(temperature)
    parameters = design @ solution.coefficients[:size]
    force, change = forces(parameters, attitudes.mean / reading)
    moved = np.einsum("nij,njc->nic", change, design)
    offset = solution.scatter.tau[0] * change[:, :, :3].reshape(3 * n, 3)
    joint = (offset @ offset.T).reshape(n, 3, n, 3)
    if attitudes.covariance is not None:
        sensed = -change[:, :, :3] / parameters[:, None, 3:6]
        own = np.einsum("nij,njk,nlk->nil", sensed, attitudes.covariance / np.outer(reading, reading), sensed)
        joint[range(n), :, range(n), :] += own + solution.excess**2 * np.eye(3)
    length = np.linalg.norm(force, axis=1)
    up = force / length[:, None]
    across = (np.eye(3) - up[:, :, None] * up[:, None, :]) / length[:, None, None]
    found: Array = np.einsum("nij,njmk,mlk->niml", across, joint, across, optimize=True).reshape(3 * n, 3 * n)
    return found, (across @ moved).reshape(3 * n, size)


def rescaled(gyros: Gyroscopes, scale: ScaleLaws) -> Gyroscopes:
    """Return biases and g-sensitivities of outputs over these scale factors, whose uncertainty is not in them yet."""
    factor = 1 / scale.scale_at(gyros.held.temperature)
    held = replace(
        gyros.held,
        mean=gyros.held.mean * factor,
        covariance=gyros.held.covariance * factor[:, :, None] * factor[:, None, :],
    )
    return gyros.again(held)


def block_diagonal(first: Array, second: Array) -> Array:
    """Return two matrices along the diagonal of one."""
    joined = np.zeros((len(first) + len(second), first.shape[1] + second.shape[1]))
    joined[: len(first), : first.shape[1]], joined[len(first) :, first.shape[1] :] = first, second
    return joined


def joint_covariance(gyros: Gyroscopes, scale: ScaleLaws) -> Array:
    """Return the covariance of the coefficients of `gyros`, fitted to outputs over S(T), and of those of `scale`."""
    from imulab.procedures.thermal.rows import whitener

    solution, held = gyros.solution, gyros.held
    white = whitener(solution.rows, solution.excess**2, solution.scatter.tau)
    inverse = np.linalg.pinv(white(solution.rows.jacobian), rcond=1e-13)
    # db / dS: each mean moves by -mean / S for a unit of S.
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
