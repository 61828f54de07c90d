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

from imulab.columns import triad
from imulab.earth import EARTH, EarthRate
from imulab.errors import DataError, ObservabilityError, OptionError, RecordError, SegmentError, listed
from imulab.estimation.least_squares import Observability, observability
from imulab.estimation.rows import LeftOut, leave_out
from imulab.procedures.tumble.apply import output_factor, specific_force
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.choices import CLOCKS, SENSITIVITIES
from imulab.procedures.tumble.directions import direction_covariance
from imulab.procedures.tumble.findings import aside_of
from imulab.procedures.tumble.gyroclock import CRYSTAL, Clock, clock_of_scale, compare_clocks, counted, evened
from imulab.procedures.tumble.gyrolinear import Nonlinearity, test_linearity
from imulab.procedures.tumble.gyrorest import clock_notes, find_holds
from imulab.procedures.tumble.gyrosolve import Case, Solved, solve_turns, turn_covariance
from imulab.procedures.tumble.gyroturns import COLUMNS, ROWS, shared_covariance
from imulab.procedures.tumble.sections import fit_of, model_of
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.records.calibration import Calibration
from imulab.records.mean_noise import mean_uncertainties
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit
from imulab.verdict import Note

PAIRS = ("xy", "xz", "yx", "yz", "zx", "zy")
_EVENER = 0.9
_FOREIGN, _TOUCHED = 5.0, 1e-3 * STANDARD_GRAVITY


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
    sensitivity_covariance
        Of the sensitivities row by row, shape (9, 9).
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
    clock
        What the time is known by that the scale factors are referred to.
    nonlinearity
        Of the scale factors over the rate.
    aside
        Start, stop, s, and miss, rad, of turns that stand out and were set aside, shape (k, 3).
    notes
        What a user should know, a sentence each.
    earth
        The Earth's rate whose vertical part was taken off; None where the latitude is not known.
    """

    scale_factor: Array
    misalignment: Array
    bias: Array
    sensitivity: Array | None
    covariance: Array
    sensitivity_covariance: Array | None
    residuals: Array
    start: Array
    stop: Array
    unit: str
    fit_bias: bool
    observability: Observability
    clock: Clock
    nonlinearity: Nonlinearity | None
    aside: Array
    notes: tuple[str, ...] = ()
    earth: EarthRate | None = None

    @property
    def cost(self) -> float:
        """Sum of the squared angles, rad^2."""
        return float(np.sum(self.residuals**2))


def fit_gyro(
    record: Calibration,
    attitudes: Attitudes,
    recording: Recording,
    *,
    fit_bias: bool = False,
    sensitivity: str = "auto",
    clock: float = CRYSTAL,
    clock_of: str = "gyro",
    noise: Calibration | None = None,
    earth: EarthRate | None = None,
) -> GyroFit:
    """Calibrate a gyroscope triad from the turns between static attitudes.

    The options and what is raised are those of `imulab.fit_gyro`; `attitudes` are of the accelerometers' recording, and
    `recording`, which may be the same, has ``time`` and ``gyro_x``, ``_y``, ``_z`` on the same clock.
    """
    _check_request(record, attitudes, sensitivity, clock, clock_of)
    unit = recording.triad_unit("gyro")
    check_finite(recording, triad("gyro"))
    left_out = leave_out(recording, triad("gyro"))
    time, output = check_time(recording), left_out.recording.triad("gyro")
    factor = output_factor(attitudes.recording.name, "accel", attitudes.unit, model_of(record).output_unit)
    means = attitudes.mean * factor
    own = attitudes.recording.si("time")
    moving = leave_out(attitudes.recording, triad("accel")).recording
    own_force = specific_force(record, moving.triad("accel") * factor)
    force, knocked = specific_force(record, means), aside_of(record, attitudes)
    case = Case(recording.name, attitudes, force, own, own_force, output, unit, fit_bias, knocked)
    case, found = _begun(case, time, sensitivity, earth)
    time, found, said = _with_even_stamps(case, time, sensitivity, found)
    apart = attitudes.recording is not recording
    comparison = compare_clocks(own, own_force, time, found.rate(output), found.segments, search=apart)
    if clock_of == "accel":
        if comparison is None:
            raise DataError(f"{recording.name}: the turns do not tell how the two clocks differ")
        time = comparison.on_other(time)
        found = solve_turns(case, time, sensitivity)
    said_of_noise: list[str] = []
    if noise is not None:
        found, said_of_noise = _with_noise(found, noise, attitudes, recording)
    known = clock_of_scale(comparison, clock, clock_of, counted=counted(check_time(recording)))
    notes = [
        *(f"gyro: {note}" for note in left_out.notes(_at_rest(attitudes, time, left_out))),
        *said,
        *said_of_noise,
        *found.notes,
        *_record_notes(record, attitudes, case.force),
        *known.notes(apart=apart),
    ]
    if apart and clock_of == "gyro":
        notes += clock_notes(find_holds(attitudes, time, output, recording.name), attitudes, time)
    segments, residual, jacobian = found.segments, found.residual, found.jacobian
    miss, size = np.linalg.norm(residual.reshape(-1, 3), axis=1), found.theta.size
    # Each turn fixes two angles: how far about its own direction it went, gravity cannot see.
    freedom = max(2 * len(miss) - size, 1)
    seen = _observability_of_turns(found, freedom, recording.name)
    directions = direction_covariance(record, attitudes, means, case.force)
    zero = None if fit_bias else found.rest.zero_uncertainty
    shared = shared_covariance(segments, found.scale, found.theta, directions, zero)
    matrix, variance = turn_covariance(found, shared, freedom)
    linearity = test_linearity(segments, found.scale, found.theta, jacobian, residual, shared, variance)
    if linearity is not None:
        notes += linearity.notes()
    return _on_earth(_result(found, matrix, miss, unit, fit_bias, seen, known, linearity, tuple(notes)), case, earth)


def _on_earth(fit: GyroFit, case: Case, earth: EarthRate | None) -> GyroFit:
    """Return the fit with the Earth's rate; where nobody knows its vertical part v, T v / g is in all sensitivities.

    The variance of v is EARTH^2 / 3 then, the mean over all directions of the Earth's axis.
    """
    if earth is not None or fit.sensitivity_covariance is None:
        return replace(fit, earth=earth)
    gravity = np.linalg.norm(case.force, axis=1).mean()
    common = EARTH / np.sqrt(3) / gravity * fit.misalignment.ravel()
    return replace(fit, sensitivity_covariance=fit.sensitivity_covariance + np.outer(common, common))


def _begun(case: Case, time: Array, sensitivity: str, earth: EarthRate | None) -> tuple[Case, Solved]:
    """Return the case, with what is known of the Earth's rate, as output, or how large it may be, and the solution."""
    found = solve_turns(case, time, sensitivity)
    up = case.force / np.linalg.norm(case.force, axis=1, keepdims=True)
    if earth is not None:
        case = replace(case, earth=found.output_of(earth.vertical * up))
    elif sensitivity == "auto" and found.rest.slope is not None:
        case = replace(case, vertical=found.output_of(EARTH * up))
    else:
        return case, found
    return case, solve_turns(case, time, sensitivity)


def _check_request(record: Calibration, attitudes: Attitudes, sensitivity: str, clock: float, clock_of: str) -> None:
    """Refuse a record, attitudes or options that no gyroscopes can be fitted with."""
    if record.procedure != "tumble":
        raise RecordError(f"a {record.procedure} record holds no accelerometers; expected a tumble record")
    if sensitivity not in SENSITIVITIES:
        raise OptionError(f"g_sensitivity {sensitivity!r}: expected one of {listed(SENSITIVITIES, sensitivity)}")
    if clock_of not in CLOCKS:
        raise OptionError(f"clock_of {clock_of!r}: expected one of {listed(CLOCKS, clock_of)}")
    if not 0 <= clock < 1:
        raise OptionError(f"clock {clock:g}: expected the relative uncertainty of a clock's rate, such as 50 ppm")
    if attitudes.trace is None:
        raise SegmentError(f"{attitudes.recording.name}: a table of attitudes has no turns between them")


def _at_rest(attitudes: Attitudes, time: Array, left_out: LeftOut) -> NDArray[np.bool_]:
    """Return which samples belong to an attitude, shape (n,); refuse one of which too many are left out."""
    rest = np.zeros(len(time), dtype=np.bool_)
    for a, b in np.searchsorted(time, np.column_stack([attitudes.start, attitudes.stop])).tolist():
        left_out.check(a, b, f"the attitude at {time[a]:.1f} to {time[b - 1]:.1f} s")
        rest[a:b] = True
    return rest


def _with_noise(
    found: Solved, noise: Calibration, attitudes: Attitudes, recording: Recording
) -> tuple[Solved, list[str]]:
    """The zero with the uncertainty that a noise record tells of the time at rest, where the holds scatter by less."""
    unit = recording.triad_unit("gyro")
    rate = parse_unit(unit).quantity == "rate"
    duration = float((attitudes.stop - attitudes.start).sum())
    u, said = mean_uncertainties(noise, triad("gyro"), duration, "rad/s" if rate else unit, recording.metadata)
    least = from_si(u, unit) if rate else u
    rest = replace(found.rest, zero_uncertainty=np.maximum(found.rest.zero_uncertainty, least))
    return replace(found, rest=rest), said


def _with_even_stamps(case: Case, time: Array, sensitivity: str, found: Solved) -> tuple[Array, Solved, list[Note]]:
    """Return time, solution and a note with evened time stamps, where the turns miss clearly less with them."""
    even = evened(time)
    if even is not None:
        # Only the turns can tell stamps that jitter from samples that do.
        other = solve_turns(case, even[0], sensitivity)
        if other.typical_miss < _EVENER * found.typical_miss:
            said = Note(
                f"gyro: the time stamps jitter by {1e3 * even[1]:.2g} ms rms: replaced by even ones, with which "
                f"the turns miss by {np.degrees(other.typical_miss):.2g} deg instead of "
                f"{np.degrees(found.typical_miss):.2g} deg (median)"
            )
            return even[0], other, [said]
    return time, found, []


def _observability_of_turns(found: Solved, freedom: int, name: str) -> Observability:
    """Return what the turns determine; refuse those that cannot separate the parameters or do not converge."""
    residual, size, turns = found.residual, found.theta.size, len(found.residual) // 3
    seen = observability(found.jacobian, np.full(len(residual), freedom / max(float(residual @ residual), 1e-30)))
    if seen.rank < size:
        confused = " ".join(seen.confused(gyro_names()[:size]))
        raise ObservabilityError(f"{name}: {turns} turns cannot separate {confused}")
    if not found.converged:
        raise DataError(
            f"{name}: the fit of the gyroscopes does not converge on these {turns} turns "
            f"(condition number {seen.condition:.0f}); use more turns, about more directions"
        )
    return seen


def _record_notes(record: Calibration, attitudes: Attitudes, force: Array) -> list[str]:
    """Say if the accelerometers' record is hardly of this unit."""
    mine, its = record.sensor.get("serial"), attitudes.recording.metadata.get("serial")
    found = [f"gyro: the record is of {mine}, the recording of {its}"] if mine and its and mine != its else []
    length = np.linalg.norm(force, axis=1)
    scatter, usual = float(length.std()), fit_of(record).rms.value
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
    found: Solved,
    matrix: Array,
    miss: Array,
    unit: str,
    fit_bias: bool,
    seen: Observability,
    clock: Clock,
    linearity: Nonlinearity | None,
    notes: tuple[str, ...],
) -> GyroFit:
    """Turn scaled parameters into the triad."""
    theta, scale, rest = found.theta, found.scale, found.rest
    scale_factor = scale * (1 + theta[:3])
    misalignment = np.eye(3)
    misalignment[ROWS, COLUMNS] = theta[3:9]
    moved = theta[9:12] if fit_bias else np.zeros(3)
    bias = (rest.zero + scale * moved) / scale_factor
    everything = np.zeros((12, 12))
    everything[: len(matrix), : len(matrix)] = matrix
    if not fit_bias:
        everything[range(9, 12), range(9, 12)] = (rest.zero_uncertainty / scale) ** 2
    derivative = np.diag(np.concatenate([scale, np.ones(6), scale / scale_factor]))
    derivative[range(9, 12), range(3)] = -bias * scale / scale_factor
    # A clock that is fast makes all scale factors too large by as much, and what is divided by them too small.
    common = clock.uncertainty * np.concatenate([scale_factor, np.zeros(6), -bias])
    return GyroFit(
        scale_factor=scale_factor,
        misalignment=misalignment,
        bias=bias,
        sensitivity=None if rest.slope is None else rest.slope / scale_factor[:, None],
        covariance=derivative @ everything @ derivative.T + np.outer(common, common),
        sensitivity_covariance=(
            None
            if rest.slope_uncertainty is None
            else np.diag((rest.slope_uncertainty / scale_factor[:, None]).ravel() ** 2)
        ),
        residuals=miss,
        start=found.segments.start,
        stop=found.segments.stop,
        unit=unit,
        fit_bias=fit_bias,
        observability=seen,
        clock=clock,
        nonlinearity=linearity,
        aside=found.aside,
        notes=notes,
    )
