"""Rest ramps: the gyroscopes' biases over temperature from recordings at rest, without any turn.

A unit that rests while its temperature changes shows the biases of its gyroscopes and nothing else: scale factors,
misalignments and g-sensitivities need turns. One recording holds its slow noise beside the law, whose covariance is in
`slow_noise`; the rest is the fit of a whole test (`gyro.fit_gyroscopes`).

A recording is cut into parts of equal duration, short enough that the temperature changes by 1 K or so in each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.display import UNJUDGED, Finding, Note
from imulab.errors import DataError, OptionError
from imulab.estimation.least_squares import Observability
from imulab.estimation.noise.readings import doubtful_units
from imulab.estimation.rows import leave_out, median
from imulab.gravity import EARTH, EarthRate
from imulab.procedures.thermal.accel_change import find_changes, note_on
from imulab.procedures.thermal.degrees import Degrees, judge_observability
from imulab.procedures.thermal.gyro import ThermalGyroscopes, check_gyroscopes, fit_gyroscopes, rates_at_rest
from imulab.procedures.thermal.holds import Holds, find_stretches_at_rest, reading_uncertainty
from imulab.procedures.thermal.model import AXES, GROUPS, MISALIGNMENTS, SENSITIVITIES
from imulab.procedures.thermal.record import with_gyroscopes
from imulab.procedures.thermal.schema import RampEvidence, RampModel, RampSummary
from imulab.procedures.thermal.slow_noise import fit_slow_noise
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance
from imulab.records.sections import Quantity, entries
from imulab.report.parameters import text_in
from imulab.units import parse_unit

_PARTS, _MOST = 48, 160
"""Usual and largest number of parts of a recording."""
_FEWEST = 20
"""Fewest samples of a part."""
_KELVIN = 1.0  # K within a part
_DEGREE = 3  # of the laws that slow noise is found beside
_WHOLE = 6
"""Rest ramps with accelerometers from which the whole model may be told."""
_MOVES = np.radians(1.0)
"""Scatter of the means at rest that no gyroscope has, rad/s."""
_RESTLESS = 0.25
"""Share of the parts in which the unit turned, above which it did not rest."""
_LAG, _FAILS = 20.0, 4.0
"""Usual lag of biases behind the thermometer, s, as in `hidden`; times the uncertainty from which it is a finding."""
NOT_TOLD = (
    *(f"gyro_scale_factor_{axis}" for axis in AXES),
    *MISALIGNMENTS,
    *SENSITIVITIES,
    *(f"{kind}_{axis}" for kind, axes in GROUPS for axis in axes),
)
"""Parameters of a whole test that rest ramps do not show."""


def are_rest_ramps(recordings: Sequence[Recording]) -> bool:
    """Return whether recordings of gyroscopes have no accelerometers, or rest throughout, too few for these."""
    if not all(set(triad("gyro")) <= set(each.columns) and each.time is not None for each in recordings):
        return False
    with_accel = [each for each in recordings if set(triad("accel")) <= set(each.columns)]
    if not with_accel:
        return True
    return len(recordings) < _WHOLE and all(_rests(each) for each in with_accel)


def _rests(recording: Recording) -> bool:
    """Return whether the accelerometers of a recording show no turn."""
    kept = leave_out(recording, triad("accel")).recording
    time, outputs = kept.time, np.column_stack([kept.si(name) for name in triad("accel")])
    if time is None or len(time) < 2 * _FEWEST or not np.isfinite(outputs).all():
        return False
    return find_stretches_at_rest(outputs, time) is not None


def fit_ramps(
    recordings: Sequence[Recording],
    wanted: str | Degrees,
    spline: bool,
    tau: float | None,
    options: Mapping[str, Any],
    earth: EarthRate | None,
) -> tuple[Calibration, Observability]:
    """Return the record of the gyroscopes' biases from prepared recordings at rest, and how well they tell these.

    Raises
    ------
    DataError
        The unit turns, or the recordings have no gyroscopes in a unit of rate.
    ObservabilityError
        The temperatures are too few for the stated degrees.
    """
    name = recordings[0].name + (f" and {len(recordings) - 1} more" if len(recordings) > 1 else "")
    unit = check_gyroscopes(recordings)
    if parse_unit(unit).quantity != "rate":
        raise DataError(
            f"{name}: columns gyro_x gyro_y gyro_z are in {unit}, and a unit at rest does not tell its scale; expected "
            "a rate such as deg/s: state it (--unit gyro=deg/s), or record a tumble beside it"
        )
    holds, notes = find_parts(recordings)
    up = _upward(recordings, earth)[holds.recording]
    held = rates_at_rest(holds, up, np.ones(3))
    _check_rest(holds, len(held), name)
    held = replace(held, earth=earth, slow=slow_noise(holds, held.mean, held.index))
    low, high = float(holds.temperature.min()), float(holds.temperature.max())
    # A single recording has no power cycle beside it, whose offset could look like a bend of the law.
    known = 0.0 if tau is None and len(recordings) == 1 else tau
    gyros = fit_gyroscopes(held, low, high, wanted, known, name, spline=spline)
    _check_steady(gyros, name)
    change = find_changes(recordings, holds)
    sensor = {key: text for key in ("serial", "model", "element") for r in recordings if (text := r.metadata.get(key))}
    sources = tuple(each.source for each in recordings if each.source is not None)
    middle = Quantity(value=gyros.solution.laws.middle, unit="degC")
    record = Calibration(
        procedure="thermal",
        parameters={},
        covariance=Covariance((), ()),
        model=entries(RampModel(range=[low, high], reference_temperature=middle)),
        fit={
            "recordings": len(recordings),
            "holds": len(held),
            **entries(RampSummary(not_told=list(NOT_TOLD))),
        },
        options=dict(options),
        data=entries(RampEvidence(accel_change=change)),
        sensor=sensor,
        sources=sources,
        warnings=(*(note for each in recordings for note in each.notes), *_doubts(recordings), *notes),
        verdict=UNJUDGED,
    )
    record = with_gyroscopes(record, holds, gyros, None, name)
    record = replace(record, warnings=(*record.warnings, *_say_untold(gyros, name), *note_on(change)), verdict=UNJUDGED)
    return record, judge_observability(gyros.solution)


def _upward(recordings: Sequence[Recording], earth: EarthRate | None) -> Array:
    """Return the direction up of each recording, shape (m, 3), which matters where the latitude is stated.

    Raises
    ------
    OptionError
        A latitude is stated, and a recording has no accelerometers.
    """
    if earth is None:  # an unknown rate of the Earth is as likely from any direction
        return np.tile([0.0, 0.0, 1.0], (len(recordings), 1))
    for each in recordings:
        if not set(triad("accel")) <= set(each.columns):
            raise OptionError(
                f"latitude: {each.name} has no accelerometers, which tell how the Earth's rate lies: leave it out"
            )
    force = np.array([np.nanmean(each.triad("accel"), axis=0) for each in recordings])
    return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True), dtype=np.float64)


def find_parts(recordings: Sequence[Recording]) -> tuple[Holds, list[Note]]:
    """Return the parts of recordings at rest, without means of accelerometers, and notes on gaps."""
    edges: list[tuple[int, float, float]] = []
    notes: list[Note] = []
    for number, recording in enumerate(recordings):
        time = recording.si("time")
        bounds = np.linspace(time[0], time[-1], _count_parts(recording) + 1)
        inside = np.histogram(time, bounds)[0]
        kept = np.flatnonzero(inside >= max(_FEWEST, 0.3 * median(inside)))
        if len(kept) < len(inside):
            lost = np.setdiff1d(np.arange(len(inside)), kept)
            notes.append(
                Note(
                    f"{recording.name}: gaps: {len(lost)} of {len(inside)} parts of the ramp, the first at "
                    f"{bounds[lost[0]]:.0f} s, have too few samples and are left out; the laws bridge them"
                )
            )
        edges += [(number, bounds[k], bounds[k + 1]) for k in kept.tolist()]
    if not edges:
        raise DataError(f"{recordings[0].name}: too short for a ramp: expected {_FEWEST} samples in each part of it")
    rows = [_average_temperature(recordings[owner], start, stop) for owner, start, stop in edges]
    whose = np.array([each for each, _, _ in edges])
    step = np.array([reading_uncertainty(each.si("temperature")) for each in recordings])[whose]
    count = len(edges)
    return Holds(
        mean=np.zeros((count, 3)),
        covariance=np.zeros((count, 3, 3)),
        temperature=np.array([row[0] for row in rows]),
        rate=np.array([row[1] for row in rows]),
        step=step,
        shared=np.zeros(count, dtype=np.bool_),
        recording=whose,
        group=whose,
        start=np.array([start for _, start, _ in edges]),
        stop=np.array([np.nextafter(stop, start) for _, start, stop in edges]),
        unit="",
        recordings=tuple(recordings),
        gyroscopes=tuple(recordings),
        attitudes=(),
        wander=np.zeros((count, count)),
    ), notes


def _count_parts(recording: Recording) -> int:
    """Return the number of parts of a recording: by the way of its temperature, and by its samples."""
    temperature = recording.si("temperature")
    blocks = np.linspace(0, len(temperature), _PARTS + 1).astype(np.int64)
    means = np.array([temperature[a:b].mean() for a, b in pairwise(blocks.tolist()) if b > a])
    way = float(np.abs(np.diff(means)).sum())
    return int(np.clip(way / _KELVIN, min(_PARTS, len(temperature) // _FEWEST), _MOST).clip(min=4))


def _average_temperature(recording: Recording, start: float, stop: float) -> tuple[float, float]:
    """Return the mean temperature of a part, degC, and its change, K/s."""
    time, temperature = recording.si("time"), recording.si("temperature")
    first, last = np.searchsorted(time, [start, stop])
    here, read = time[first:last], temperature[first:last]
    return float(read.mean()), float(np.polyfit(here - here.mean(), read, 1)[0])


def slow_noise(holds: Holds, mean: Array, index: NDArray[np.int64]) -> Array:
    """Return the covariance of the parts' means by slow noise on each axis, shape (3, n, n); recordings share none."""
    slow = np.zeros((3, len(index), len(index)))
    number, middle = holds.recording[index], 0.5 * (holds.start + holds.stop)[index]
    for each in np.unique(number).tolist():
        members = np.flatnonzero(number == each)
        place = holds.temperature[index][members]
        theta = 2 * (place - place.min()) / max(float(np.ptp(place)), 1e-9) - 1
        terms = np.polynomial.chebyshev.chebvander(theta, _DEGREE)
        rate = holds.rate[index][members] / np.abs(holds.rate[index][members]).max()
        if rate.min() < 0 < rate.max():  # lag and loop, which one direction does not tell from the laws
            terms = np.column_stack([terms, rate[:, None] * terms[:, :_DEGREE], np.sign(rate) * (1 - theta**2)])
        if len(members) > 2 * terms.shape[1]:
            slow[:, members[:, None], members] = fit_slow_noise(mean[members], terms, middle[members])
    return slow


def _check_rest(holds: Holds, still: int, name: str) -> None:
    """Refuse recordings in which the unit turned in many parts."""
    if still < (1 - _RESTLESS) * len(holds):
        raise DataError(
            f"{name}: columns gyro_x gyro_y gyro_z: the unit turns in {len(holds) - still} of {len(holds)} parts; "
            "expected one at rest while its temperature changes, or accelerometers beside (a tumble over temperature)"
        )


def _check_steady(gyros: ThermalGyroscopes, name: str) -> None:
    """Refuse rates that change by more than those of any gyroscope at rest: the unit turned all the time."""
    left = gyros.solution.rows.residual.reshape(-1, 3)
    rms = np.sqrt(np.mean(left**2, axis=0))
    if rms.max() > _MOVES:
        worst = int(np.argmax(rms))
        raise DataError(
            f"{name}: column gyro_{AXES[worst]}: its means over parts differ from a law of the temperature by "
            f"{np.degrees(rms[worst]):.2g} deg/s rms; expected a unit at rest: does it turn, or is the unit wrong?"
        )
    if len(gyros.aside) > _RESTLESS * (len(gyros.held) + len(gyros.aside)):
        raise DataError(
            f"{name}: columns gyro_x gyro_y gyro_z: {len(gyros.aside)} parts differ from the others as if the unit "
            "turned; expected one at rest while its temperature changes"
        )


def _doubts(recordings: Sequence[Recording]) -> list[str]:
    """Return why the unit of the rates can hardly be right."""
    first = recordings[0]
    time = first.si("time")
    return doubtful_units(first, triad("gyro"), (len(time) - 1) / float(time[-1] - time[0]))


def _say_untold(gyros: ThermalGyroscopes, name: str) -> list[str]:
    """Return what rest ramps cannot tell, and the shift of the biases by a usual lag where none is observable."""
    earth = text_in(EARTH, "deg/h")
    notes: list[str] = [
        Note(
            f"{name}: at rest: scale factors, misalignments and g-sensitivities of the gyroscopes are not told, nor "
            "anything of accelerometers (fit.not_told); biases hold what gravity adds in this attitude, and the "
            f"Earth's rate, {earth} deg/h, is in their uncertainty"
        )
    ]
    if gyros.drift.values is not None or not gyros.drift.reason:
        return notes
    laws, size = gyros.solution.laws, gyros.size
    slope = laws.slope(gyros.held.temperature)[:, :3, :size] @ gyros.solution.coefficients[:size]
    design = laws.design(gyros.held.temperature)[:, :3, :size]
    covariance = gyros.solution.covariance[:size, :size]
    u = float(np.sqrt(np.einsum("nac,cd,nad->na", design, covariance, design)).max())
    shift = float(np.abs(slope * gyros.held.rate[:, None]).max()) * _LAG
    text = (
        f"gyro: {name}: {gyros.drift.reason}: a usual lag of {_LAG:g} s shifts biases by up to "
        f"{text_in(shift, 'deg/h')} deg/h, where their uncertainty is {text_in(u, 'deg/h')}"
    )
    action = "let the temperature change more slowly, or record the way back too"
    return [*notes, Finding(text, action) if shift > _FAILS * u else Note(text)]
