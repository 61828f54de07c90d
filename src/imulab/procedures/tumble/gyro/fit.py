"""The gyroscope triad on top of calibrated accelerometers, from data to a record of both triads.

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
from os import PathLike
from typing import Annotated, Any, Unpack

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from imulab.columns import triad, units_without
from imulab.device.unit import output_factor
from imulab.display import UNJUDGED, Bad, Finding, Note, prefixed
from imulab.errors import DataError, ObservabilityError, OptionError, RecordError, SegmentError, listed
from imulab.estimation.decisions import SCALE_OFF_UNIT, SCALES_OFF_ALIKE
from imulab.estimation.least_squares import Observability, coverage_factor, observability
from imulab.estimation.rows import LeftOut, leave_out, median
from imulab.gravity import EARTH, EarthRate, at_latitude
from imulab.options import PROGRAM, choice, measure
from imulab.procedures.result import OWN_CLOCKS, Record, Result, as_record, as_recording
from imulab.procedures.tumble import CLOCKS, SENSITIVITIES
from imulab.procedures.tumble.attitudes import Attitudes, find_attitudes, without_single_gaps
from imulab.procedures.tumble.device import specific_force
from imulab.procedures.tumble.gyro.estimate import Nonlinearity, TurnEstimate, estimate_turns
from imulab.procedures.tumble.gyro.lowpass import without_filter
from imulab.procedures.tumble.gyro.rest import clock_notes, direction_covariance, find_holds
from imulab.procedures.tumble.gyro.solve import (
    CRYSTAL,
    ScaleClock,
    TurnProblem,
    TurnReadings,
    TurnSolution,
    clock_of_scale,
    compare_clocks,
    even_stamps,
    is_counted,
    solve_turns,
)
from imulab.procedures.tumble.gyro.turns import Stamps, misalignment
from imulab.procedures.tumble.record import aside_of
from imulab.procedures.tumble.schema import (
    ClockState,
    GyroModel,
    GyroSummary,
    LargestRates,
    RateTest,
    RateValues,
    TurnAside,
    TurnResiduals,
    fit_of,
    model_of,
)
from imulab.quantities import in_si
from imulab.readers.streams import own_clock
from imulab.recording import Array, Data, Reading, Recording, check_time
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.comparison import different_units
from imulab.records.sections import Length, Measured, entries
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit

# The gyroscope triad on top of calibrated accelerometers.


PAIRS = ("xy", "xz", "yx", "yz", "zx", "zy")
_EVENER = 0.97  # even time stamps are taken if the turns miss by this share of what they miss with those read
# Times the record's scatter, and 1 mg: attitudes that scatter more under it are of another unit
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
    between_samples
        Half of what the two readings between samples change each scale factor by, relative, shape (3,).
    lost_samples
        Root mean square of the share of samples that may be lost.
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
    clock: ScaleClock
    nonlinearity: Nonlinearity | None
    between_samples: Array
    lost_samples: float
    aside: Array
    notes: tuple[str, ...] = ()
    earth: EarthRate | None = None

    @property
    def cost(self) -> float:
        """Sum of the squared angles, rad^2."""
        return float(np.sum(self.residuals**2))


def fit_gyro_triad(
    record: Calibration,
    attitudes: Attitudes,
    recording: Recording,
    *,
    apart: bool | None = None,
    fit_bias: bool = False,
    sensitivity: str = "auto",
    clock: float = CRYSTAL,
    clock_of: str = "gyro",
    noise: Calibration | None = None,
    earth: EarthRate | None = None,
) -> GyroFit:
    """Calibrate a gyroscope triad from the turns between static attitudes.

    The options and what is raised are those of `imulab.fit_gyro`; `attitudes` are of the accelerometers' recording, and
    `recording`, which may be the same, has ``time`` and ``gyro_x``, ``_y``, ``_z``; `apart` says whether another clock
    may have stamped it, by default where it is another recording.
    """
    _check_request(record, attitudes, sensitivity, clock, clock_of)
    apart = attitudes.recording is not recording if apart is None else apart
    unit = recording.triad_unit("gyro")
    recording, bridges = without_single_gaps(recording, triad("gyro"))
    left_out, time, output = _outputs(recording)
    factor = output_factor(attitudes.recording.name, triad("accel"), attitudes.unit, model_of(record).output_unit)
    means = attitudes.mean * factor
    accel_time = attitudes.recording.si("time")
    moving = leave_out(attitudes.recording, triad("accel")).recording
    accel_force = specific_force(record, moving.triad("accel") * factor)
    force, knocked = specific_force(record, means), aside_of(record, attitudes)
    case = TurnProblem(recording.name, attitudes, force, accel_time, accel_force, output, unit, fit_bias, knocked)
    alike = not apart or np.array_equal(time, accel_time)
    stamps = Stamps(time, time if alike else _on_accel_clock(case, time, sensitivity))
    case, solved = _solve_with_earth(case, stamps, sensitivity, earth)
    case, solved, filter_notes = without_filter(case, stamps, sensitivity, solved)
    stamps, solved, stamp_notes = _with_even_stamps(case, stamps, sensitivity, solved)
    comparison = compare_clocks(
        accel_time, accel_force, stamps.time, solved.rate(output), solved.segments, search=apart
    )
    if clock_of == "accel":
        if comparison is None:
            raise DataError(f"{recording.name}: the turns do not tell how the two clocks differ")
        time = comparison.on_other(stamps.time)
        stamps = Stamps(time, time)
        solved = solve_turns(case, stamps, sensitivity, near=solved)
    solved, noise_notes = (solved, []) if noise is None else _with_noise_record(solved, noise, attitudes, recording)
    known = clock_of_scale(comparison, clock, clock_of, counted=is_counted(check_time(recording)))
    notes = [
        *bridges,
        *(prefixed("gyro", note) for note in left_out.notes(_at_rest(attitudes, stamps.on_accel, left_out))),
        *filter_notes,
        *stamp_notes,
        *noise_notes,
        *solved.notes,
        *_warn_foreign_record(record, attitudes, case.force),
        *known.notes(apart=apart),
    ]
    notes += _clock_notes(solved.readings) if apart and clock_of == "gyro" else []
    # Each turn fixes two angles: gravity does not show a rotation about its own direction.
    freedom = max(2 * len(solved.segments.start) - solved.theta.size, 1)
    conditioning = _observability_of_turns(solved, freedom, recording.name)
    directions = direction_covariance(record, means, case.force)
    estimate = estimate_turns(solved, directions, None if fit_bias else solved.rest.zero_uncertainty)
    notes += estimate.notes(median(np.diff(stamps.time)))
    fit = _triad_of_estimate(estimate, unit, fit_bias, conditioning, known, tuple(notes))
    return _on_earth(fit, case, earth)


def _outputs(recording: Recording) -> tuple[LeftOut, Array, Array]:
    """Return what is left out of the gyroscopes' samples, their times and outputs; a dead axis is refused."""
    left_out = leave_out(recording, triad("gyro"))
    time, output = check_time(recording), left_out.recording.triad("gyro")
    if (dead := np.ptp(output, axis=0) == 0).any():
        column = triad("gyro")[int(np.argmax(dead))]
        raise DataError(f"{recording.name}: column {column}: the same output in every sample: a dead axis")
    return left_out, time, output


def _clock_notes(readings: TurnReadings) -> list[str]:
    """Say whether the gyroscopes, as they are stamped, move into one end of the holds."""
    case, stamps, holds = readings.case, readings.stamps, readings.holds
    if not np.array_equal(stamps.time, stamps.on_accel):
        holds = find_holds(case.attitudes, stamps.time, case.output, case.smallest, case.name)
    return clock_notes(holds, case.attitudes, stamps.time)


def _on_accel_clock(case: TurnProblem, time: Array, sensitivity: str) -> Array:
    """Return the times of the gyroscopes' samples by the accelerometers' clock, which stamped another recording."""
    rough = solve_turns(case, Stamps(time, time), sensitivity, rough=True)
    comparison = compare_clocks(case.own, case.own_force, time, rough.rate(case.output), rough.segments, search=True)
    return time if comparison is None else comparison.on_other(time)


def _on_earth(fit: GyroFit, case: TurnProblem, earth: EarthRate | None) -> GyroFit:
    """Return the fit with the Earth's rate; where nobody knows its vertical part v, T v / g is in all sensitivities.

    The variance of v is EARTH^2 / 3 then, the mean over all directions of the Earth's axis.
    """
    if earth is not None or fit.sensitivity_covariance is None:
        return replace(fit, earth=earth)
    gravity = np.linalg.norm(case.force, axis=1).mean()
    common = EARTH / np.sqrt(3) / gravity * fit.misalignment.ravel()
    return replace(fit, sensitivity_covariance=fit.sensitivity_covariance + np.outer(common, common))


def _solve_with_earth(
    case: TurnProblem, stamps: Stamps, sensitivity: str, earth: EarthRate | None
) -> tuple[TurnProblem, TurnSolution]:
    """Return the problem, with the Earth's rate (known, or its largest possible value) as output, and the solution."""
    # Of the scale factors only the size matters for whether gravity shows in the zeros: a plain fit will do.
    first = solve_turns(case, stamps, "no" if sensitivity == "auto" and earth is None else sensitivity)
    up = case.force / np.linalg.norm(case.force, axis=1, keepdims=True)
    if earth is not None:
        case = structs.replace(case, earth=first.output_of(earth.vertical * up))
    elif sensitivity == "auto":
        case = structs.replace(case, vertical=first.output_of(EARTH * up))
    else:
        return case, first
    return case, solve_turns(case, stamps, sensitivity, near=first)


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


def _with_noise_record(
    solved: TurnSolution, noise: Calibration, attitudes: Attitudes, recording: Recording
) -> tuple[TurnSolution, list[str]]:
    """Return the solution, its zero at least as uncertain as a noise record predicts for that time, and notes."""
    from imulab.records.mean_noise import mean_uncertainties

    unit = recording.triad_unit("gyro")
    rate = parse_unit(unit).quantity == "rate"
    duration = float((attitudes.stop - attitudes.start).sum())
    u, noise_notes = mean_uncertainties(noise, triad("gyro"), duration, "rad/s" if rate else unit, recording.metadata)
    least = from_si(u, unit) if rate else u
    rest = structs.replace(solved.rest, zero_uncertainty=np.maximum(solved.rest.zero_uncertainty, least))
    return structs.replace(solved, rest=rest), noise_notes


def _with_even_stamps(
    case: TurnProblem, stamps: Stamps, sensitivity: str, solved: TurnSolution
) -> tuple[Stamps, TurnSolution, list[Note]]:
    """Return stamps, solution and a note with evened time stamps, where the turns miss clearly less with them."""
    even = even_stamps(stamps.time)
    if even is not None:
        # Only the turns can tell stamps that jitter from samples that do.
        evened = Stamps(even[0], even[0] + (stamps.on_accel - stamps.time))
        other = solve_turns(case, evened, sensitivity, near=solved)
        if other.typical_miss < _EVENER * solved.typical_miss:
            note = Note(
                f"gyro: the time stamps jitter by {1e3 * even[1]:.2g} ms rms: replaced by even ones, with which "
                f"the turns miss by {np.degrees(other.typical_miss):.2g} deg instead of "
                f"{np.degrees(solved.typical_miss):.2g} deg (median)"
            )
            return evened, other, [note]
    return stamps, solved, []


def _observability_of_turns(solved: TurnSolution, freedom: int, name: str) -> Observability:
    """Return what the turns determine; refuse those that cannot separate the parameters or do not converge."""
    residual, size, turns = solved.residual, solved.theta.size, len(solved.residual) // 3
    conditioning = observability(
        solved.jacobian, np.full(len(residual), freedom / max(float(residual @ residual), 1e-30))
    )
    if conditioning.rank < size:
        confused = " ".join(conditioning.confused(gyro_names()[:size]))
        raise ObservabilityError(f"{name}: {turns} turns cannot separate {confused}")
    if not solved.converged:
        raise DataError(
            f"{name}: the fit of the gyroscopes does not converge on these {turns} turns "
            f"(condition number {conditioning.condition:.0f}); use more turns, about more directions"
        )
    return conditioning


def _warn_foreign_record(record: Calibration, attitudes: Attitudes, force: Array) -> list[str]:
    """Say if the accelerometers' record is hardly of this unit."""
    other = different_units(("the record", record.sensor), ("the recording", attitudes.recording.metadata))
    action = "use the accelerometers' record of this unit (--accel)"
    messages: list[str] = [Finding(f"gyro: {other}", action)] if other else []
    length = np.linalg.norm(force, axis=1)
    scatter, usual = float(length.std()), fit_of(record).rms.value
    if scatter > _FOREIGN * usual + _TOUCHED:
        messages.append(
            Finding(
                f"gyro: under the record |f| scatters by {from_si(scatter, 'mg'):.3g} mg from attitude to attitude, by "
                f"{from_si(usual, 'mg'):.3g} mg when it was made: is it of this unit?",
                action,
            )
        )
    return messages


def gyro_names() -> list[str]:
    """Return the names of the parameters in the order of the covariance."""
    return [
        *(f"gyro_scale_factor_{axis}" for axis in "xyz"),
        *(f"gyro_misalignment_{pair}" for pair in PAIRS),
        *(f"gyro_bias_{axis}" for axis in "xyz"),
    ]


def _triad_of_estimate(
    estimate: TurnEstimate,
    unit: str,
    fit_bias: bool,
    conditioning: Observability,
    clock: ScaleClock,
    notes: tuple[str, ...],
) -> GyroFit:
    """Turn scaled parameters into the triad."""
    solved, matrix = estimate.solution, estimate.total()
    theta, scale, rest = solved.theta, solved.scale, solved.rest
    scale_factor = scale * (1 + theta[:3])
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
        misalignment=misalignment(theta),
        bias=bias,
        sensitivity=None if rest.slope is None else rest.slope / scale_factor[:, None],
        covariance=derivative @ everything @ derivative.T + np.outer(common, common),
        sensitivity_covariance=(
            None
            if rest.slope_uncertainty is None
            else np.diag((rest.slope_uncertainty / scale_factor[:, None]).ravel() ** 2)
        ),
        residuals=np.linalg.norm(solved.residual.reshape(-1, 3), axis=1),
        start=solved.segments.start,
        stop=solved.segments.stop,
        unit=unit,
        fit_bias=fit_bias,
        observability=conditioning,
        clock=clock,
        nonlinearity=estimate.linearity,
        between_samples=estimate.reading[:3],
        lost_samples=estimate.lost,
        aside=solved.aside,
        notes=notes,
    )


# A tumble record with the gyroscope triad added.


_AXES = ("x", "y", "z")
_USUAL = (
    (np.degrees(1), "are the rates in deg/s?"),
    (np.radians(1), "are the rates in rad/s?"),
    (2.0, "is the sample rate twice what the time stamps say?"),
    (0.5, "is the sample rate half what the time stamps say?"),
)
"""Factors by which scale factors are typically off, and their causes."""
_ALIKE = 5.7  # Student's t of three at 1 %, over root 3
_SMALLEST_ALIKE = 0.05  # %
_LARGE_MISS = 2.0  # deg


def with_gyro(record: Calibration, fit: GyroFit, recording: Recording, accelerometers: Recording) -> Calibration:
    """Return the record with parameters, covariance and residuals of the gyroscope triad; an earlier one is replaced.

    Both triads are in the frame that the accelerometers define.
    """
    kept = {name: p for name, p in record.parameters.items() if not name.startswith("gyro_")}
    names = [name for name in record.covariance.names if not name.startswith("gyro_")]
    index = [record.covariance.names.index(name) for name in names]
    block = record.covariance.array()[np.ix_(index, index)]
    sources = {source.file: source for source in record.sources}
    sources |= {r.source.file: r.source for r in (accelerometers, recording) if r.source is not None}
    freedom = 2 * len(fit.residuals) - (12 if fit.fit_bias else 9)
    # The gyroscopes' covariance holds what the accelerometers' adds; the covariance between the two is not kept.
    joined = _diagonal_blocks(block, _covariance(fit))
    residuals = TurnResiduals(start=fit.start.tolist(), stop=fit.stop.tolist(), residual=fit.residuals.tolist())
    return replace(
        record,
        parameters=kept | _parameters(fit),
        covariance=Covariance((*names, *_covariance_names(fit)), tuple(map(tuple, joined.tolist()))),
        model={**record.model, **entries(GyroModel(gyro_output_unit=fit.unit))},
        sources=tuple(sources.values()),
        fit={**record.fit, "gyro": entries(_summary(fit, freedom))},
        data={**record.data, "gyro": entries(residuals)},
        warnings=tuple(dict.fromkeys((*(w for w in record.warnings if not w.startswith("gyro")), *_warnings(fit)))),
        verdict=UNJUDGED,
    )


def _summary(fit: GyroFit, freedom: int) -> GyroSummary:
    """Return how the gyroscopes were fitted, and how well."""
    turns = len(fit.residuals)
    return GyroSummary(
        turns=turns,
        cost=Length(value=fit.cost, unit="rad^2"),
        rms=Length(value=float(np.sqrt(fit.cost / turns)), unit="rad"),
        degrees_of_freedom=freedom,
        coverage_factor_95=coverage_factor(float(freedom)) if freedom > 0 else None,
        condition_number=fit.observability.condition,
        bias="fitted to the turns" if fit.fit_bias else "from the outputs at rest",
        g_sensitivity="none" if fit.sensitivity is None else "from the outputs at rest",
        latitude=None if fit.earth is None else fit.earth.latitude,
        clock=_clock_state(fit.clock),
        nonlinearity=_rate_test(fit.nonlinearity),
        set_aside=[
            TurnAside(start=start, stop=stop, miss=Length(value=miss, unit="rad"))
            for start, stop, miss in fit.aside.tolist()
        ],
        between_samples=fit.between_samples.tolist(),
        lost_samples=fit.lost_samples,
    )


def with_gyro_of(record: Calibration, known: Calibration) -> Calibration:
    """Return the record with the gyroscope triad of another record of the same unit, if that has one."""
    if "gyro_output_unit" not in known.model:
        return record
    names = [name for name in known.covariance.names if name.startswith("gyro_")]
    joined = _diagonal_blocks(record.covariance.array(), known.covariance.block(names))
    sources = {source.file: source for source in (*known.sources, *record.sources)}
    return replace(
        record,
        parameters={
            **record.parameters,
            **{name: p for name, p in known.parameters.items() if name.startswith("gyro_")},
        },
        covariance=Covariance((*record.covariance.names, *names), tuple(map(tuple, joined.tolist()))),
        model={**record.model, "gyro_output_unit": known.model["gyro_output_unit"]},
        sources=tuple(sources.values()),
        fit={**record.fit, **{key: part for key, part in known.fit.items() if key == "gyro"}},
        data={**record.data, **{key: part for key, part in known.data.items() if key == "gyro"}},
        warnings=(*record.warnings, *(w for w in known.warnings if w.startswith("gyro"))),
        verdict=UNJUDGED,
    )


def _parameters(fit: GyroFit) -> dict[str, Parameter]:
    sigma = np.sqrt(np.diag(fit.covariance))
    parameters = {
        f"gyro_bias_{a}": Parameter(float(fit.bias[i]), float(sigma[9 + i]), "rad/s") for i, a in enumerate(_AXES)
    }
    parameters |= {
        f"gyro_scale_factor_{a}": Parameter(float(fit.scale_factor[i]), float(sigma[i]), f"{fit.unit}/(rad/s)")
        for i, a in enumerate(_AXES)
    }
    parameters |= {
        f"gyro_misalignment_{p}": Parameter(
            float(fit.misalignment[_AXES.index(p[0]), _AXES.index(p[1])]), float(sigma[3 + k]), "rad"
        )
        for k, p in enumerate(PAIRS)
    }
    if fit.sensitivity is not None and fit.sensitivity_covariance is not None:
        sensitivity_sigma = np.sqrt(np.diag(fit.sensitivity_covariance)).reshape(3, 3)
        parameters |= {
            f"gyro_g_sensitivity_{a}{b}": Parameter(
                float(fit.sensitivity[i, j]), float(sensitivity_sigma[i, j]), "rad/s/(m/s^2)"
            )
            for i, a in enumerate(_AXES)
            for j, b in enumerate(_AXES)
        }
    return parameters


def _covariance_names(fit: GyroFit) -> list[str]:
    sensitivities = [] if fit.sensitivity is None else [f"gyro_g_sensitivity_{a}{b}" for a in _AXES for b in _AXES]
    return gyro_names() + sensitivities


def _covariance(fit: GyroFit) -> Array:
    """Covariance of all gyroscope parameters; the sensitivities, from rest, are taken as independent of the others."""
    if fit.sensitivity_covariance is None:
        return fit.covariance
    return _diagonal_blocks(fit.covariance, fit.sensitivity_covariance)


def _diagonal_blocks(first: Array, second: Array) -> Array:
    n, m = len(first), len(second)
    joined = np.zeros((n + m, n + m))
    joined[:n, :n], joined[n:, n:] = first, second
    return joined


def _clock_state(clock: ScaleClock) -> ClockState:
    """Return what the record says of the clock."""
    other = clock.comparison
    if other is None:
        return ClockState(of=clock.of, standard_uncertainty=clock.uncertainty)
    return ClockState(
        of=clock.of,
        standard_uncertainty=clock.uncertainty,
        accel_clock_rate=Measured(value=other.rate, standard_uncertainty=other.rate_uncertainty, unit="1"),
        latency=Measured(value=-other.delay, standard_uncertainty=other.delay_uncertainty, unit="s"),
    )


def _rate_test(test: Nonlinearity | None) -> RateTest | None:
    """Return what the record says of scale factors that change with the rate."""
    if test is None:
        return None
    return RateTest(
        probability=test.probability,
        odd=_with_uncertainty(test.odd, test.odd_uncertainty),
        even=_with_uncertainty(test.even, test.even_uncertainty),
        largest_rate=LargestRates(value=test.largest.tolist(), unit="rad/s"),
    )


def _with_uncertainty(value: Array, uncertainty: Array) -> RateValues:
    return RateValues(value=value.tolist(), standard_uncertainty=uncertainty.tolist(), unit="1")


def _warn_scale_factors(fit: GyroFit) -> list[str]:
    """Say if the scale factors are far from the stated unit, or all three by the same."""
    known = parse_unit(fit.unit)
    if known.quantity != "rate":
        return []
    ratio = fit.scale_factor * known.factor
    error = 100 * (ratio - 1)
    far = bool(np.abs(error).max() > 100 * SCALE_OFF_UNIT)
    listed = " ".join(f"{value:+.1f}" if far else f"{value:+.3g}" for value in error.tolist())
    if far:
        middle = float(np.exp(np.mean(np.log(np.abs(ratio)))))
        guess = next((f": {says}" for factor, says in _USUAL if abs(middle / factor - 1) < SCALE_OFF_UNIT), "")
        return [
            Bad(
                f"gyro: the scale factors are off by {listed} % (x y z){guess or ': is the unit right?'}; check the "
                f"unit ({fit.unit}) and the sample rate of the recording"
            )
        ]
    mean, spread = float(error.mean()), float(error.std(ddof=1))
    largest_uncertainty = 100 * float(np.sqrt(np.diag(fit.covariance)[:3]).max() / fit.scale_factor.mean())
    if abs(mean) > max(_ALIKE * spread, SCALES_OFF_ALIKE.limit * largest_uncertainty, _SMALLEST_ALIKE):
        return [
            f"gyro: the scale factors are off by {listed} % (x y z), all by the same: a sample rate or a clock that is "
            "off by as much does that; compare the time stamps with a clock"
        ]
    return []


def _warnings(fit: GyroFit) -> list[str]:
    messages = [*fit.notes, *([] if fit.earth is None else [fit.earth.note()])]
    messages += _warn_scale_factors(fit)
    if fit.clock.counted and fit.clock.of == "gyro" and fit.clock.assumed == CRYSTAL:
        messages.append(
            Note(
                "gyro: the time stamps are counted in even steps: the scale factors are true to the "
                f"{1e6 * CRYSTAL:.0f} ppm of a crystal only if a crystal sets the sample rate; a sensor's own "
                "oscillator is off by up to some percent: state it, such as --clock 10000ppm for 1 %"
            )
        )
    rms = float(np.degrees(np.sqrt(np.mean(fit.residuals**2))))
    if rms > _LARGE_MISS:
        messages.append(
            Finding(
                f"gyro: the turns miss the change of gravity's direction by {rms:.2g} deg rms",
                "check axes, signs and unit of the gyroscopes against the accelerometers",
            )
        )
    return messages


# The gyroscope triad from what people have: data to a record of both triads.


@dataclass(frozen=True, repr=False)
class BothTriads(Result):
    """Result of `fit_gyro`: the record of both triads, and what was found of the gyroscopes."""

    calibration: Calibration
    gyro: GyroFit


def fit_gyro(
    accel: Record,
    data: Data,
    *,
    accel_data: Annotated[Data | None, PROGRAM] = None,
    fit_bias: bool = False,
    g_sensitivity: Annotated[str, choice(SENSITIVITIES)] = "auto",
    clock: Annotated[float | str, measure("number", "ppm")] = "50 ppm",
    clock_of: Annotated[str, choice(CLOCKS)] = "gyro",
    noise: Record | None = None,
    latitude: Annotated[float | str | None, measure("angle", "deg", "DEG")] = None,
    **reading: Unpack[Reading],
) -> BothTriads:
    """Calibrate a gyroscope triad from the turns between static attitudes.

    ``M = S (T w + b + G f)``: between two attitudes the turn that the gyroscopes see must carry the first direction of
    gravity into the second (Tedaldi, Pretto, Menegatti, ICRA 2014); at rest ``M = S (b + G f)``.

    Parameters
    ----------
    accel
        Tumble record of the accelerometers. Or its file.
    data
        A file, recording, data frame or arrays by name with time and both triads, or the gyroscopes alone.
    accel_data
        The same of the accelerometers, on the same clock, where they are not in `data`.
    fit_bias
        Fit the biases to the turns too. Instead of taking them from the outputs at rest.
    g_sensitivity
        Whether to fit what forces add to the rate. ``auto``: where the data show it.
    clock
        Standard uncertainty of the clock's rate, common to the three scale factors. Relative.
    clock_of
        Whose time stamps are right where two clocks differ.
    noise
        Noise record of the same gyroscopes, for u of their biases. Of `fit_noise`, or its file: the biases are no more
        certain than it says of a mean over the time at rest.
    latitude
        Latitude, for the vertical part of the Earth's rate. In rad or a text such as ``"48.1 deg"``: that part is taken
        off the outputs at rest. Without it that counts as g-sensitivity or scatter, as the level part always does.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window`, `element`.

    Raises
    ------
    RecordError
        `accel` is no tumble record, or `noise` no noise record of these gyroscopes.
    SegmentError
        Fewer than eight turns between attitudes.
    DataError
        The columns are missing or not finite, or the gyroscopes do not turn as gravity does.
    ObservabilityError
        The turns cannot separate the parameters.
    OptionError
        `g_sensitivity`, `clock`, `clock_of` or `latitude` has a value that cannot be.

    Examples
    --------
    >>> import imulab as il
    >>> recording = il.simulate_tumble(gravity=9.81)
    >>> accelerometers = il.fit_tumble(recording, order=1, gravity=9.81).calibration
    >>> both = il.fit_gyro(accelerometers, recording).calibration
    >>> truth = float(recording.metadata["truth_gyro_scale_factor_x"])
    >>> abs(both.parameters["gyro_scale_factor_x"].value / truth - 1) < 1e-3
    True
    """
    known = as_record(accel, "fit_gyro: accel")
    units, named = reading.get("units"), isinstance(accel_data, str | PathLike)
    of_gyro = reading if not named else {**reading, "units": units_without("accel", units)}
    as_read = as_recording(data, of_gyro, fit_gyro, lambda samples: {"gyro": samples}, clock=OWN_CLOCKS)
    accel_recording = as_read
    if accel_data is not None and accel_data is not data:
        accel_reading: dict[str, Any] = {key: reading.get(key) for key in ("layout", "element") if named}
        accel_reading |= {"units": units_without("gyro", units)} if named else {}
        accel_recording = as_recording(accel_data, accel_reading, fit_gyro, name="accel_data", clock=OWN_CLOCKS)
    attitudes, recording = find_attitudes(accel_recording), own_clock(as_read, "gyro")
    gyro_fit = fit_gyro_triad(
        known, attitudes, recording, apart=accel_recording is not as_read, fit_bias=fit_bias, sensitivity=g_sensitivity,
        clock=in_si(clock, "clock", "number", "ppm"), clock_of=clock_of,
        noise=None if noise is None else as_record(noise, "fit_gyro: noise"), earth=at_latitude(latitude),
    )  # fmt: skip
    return BothTriads(with_gyro(known, gyro_fit, recording, accel_recording), gyro_fit)
