"""The table axis in the body by accelerometers, and an earlier record of the same gyroscopes as prior knowledge.

Table axis (`find_axes`): over whole turns the mean specific force is ``f = g a - w^2 r``, a the table axis and r the
lever arm across it, also on a table off level. The intercept of f over w^2 therefore points along a. In a sweep, terms
in w' and in cosine and sine of the table's angle are fitted beside it.

Prior (`with_prior`): z are the new parameters, d their difference from the prior's. ``z - cov(z, d) cov(d)^-1 d`` is
generalised least squares of both records together (the Kalman update). Biases are left out, since they change from
power-on to power-on. The error of a table or a clock that both records share does not average out.

Source: rotation about a fixed axis; least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imulab.display import UNJUDGED, Finding, Note
from imulab.errors import DataError, RecordError
from imulab.estimation.decisions import LENGTH_AT_REST_OFF, RATE_PRIOR_CONTRADICTED
from imulab.estimation.distributions import probability_fact
from imulab.estimation.least_squares import coverage_factor
from imulab.procedures.rate import AXES, GAINS
from imulab.procedures.rate.dwells import Dwells, recorded_rate
from imulab.procedures.rate.schema import PriorParameter, RatePrior, RateTest
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.comparison import compared, different_units
from imulab.records.sections import Measured, entries
from imulab.report.parameters import reading_unit
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit

# The direction of the table axis in the body, free of the table's level and of the lever arm.


BY_ACCELEROMETERS = "that of the accelerometers"
"""The frame of a record's misalignments."""
_FACE = np.cos(np.radians(30))  # cosine of the largest angle between the table axis and its face
_POWER_CYCLE = 3e-3 * STANDARD_GRAVITY  # m/s^2 by which biases may change until they are switched on again
_PIECE = 0.02  # s over which a sweep is averaged
_BATCHES, _FEWEST = 32, 8
"""Batches of a sweep, and fewest pieces in each."""
_TRIAD = tuple(f"accel_{axis}" for axis in AXES)


@dataclass(frozen=True)
class TableAxes:
    """The table axis in the body in each of m runs, by accelerometers.

    Attributes
    ----------
    direction
        Unit vector along the table axis, upwards, shape (m, 3).
    force, arm
        Specific force at rate 0, m/s^2, and its slope over the rate squared, m, shape (m, 3).
    spread
        Standard uncertainty of each component of a direction by the scatter of dwells, or of batches of a sweep, rad,
        shape (m,).
    changes
        Change of the direction by one standard uncertainty of each of p accelerometer parameters, shape (p, m, 3).
    correlation
        Correlation of these parameters, shape (p, p).
    length_uncertainty
        Standard uncertainty of the magnitude of a force by scatter and parameters, m/s^2, shape (m,).
    """

    direction: Array
    force: Array
    arm: Array
    spread: Array
    changes: Array
    correlation: Array
    length_uncertainty: Array


def find_axes(
    test: RateTest, recordings: Sequence[Recording], dwells: Sequence[Dwells], accel: Calibration
) -> TableAxes:
    """Return the table axis of each run by the accelerometers of its recording, calibrated by their record.

    Raises
    ------
    RecordError
        The record holds no accelerometers.
    DataError
        A recording has no accelerometers, too few dwells of a whole turn, or another face than the manifest says.
    """
    if "bias_x" not in accel.parameters:
        raise RecordError(f"accel: a {accel.procedure} record without accelerometers; expected one of tumble fit")
    pairs = zip(recordings, dwells, strict=True)
    runs_seen = [_outputs_and_columns(recording, axes, test.place(k)) for k, (recording, axes) in enumerate(pairs)]
    unit = recordings[0].triad_unit("accel")
    outputs = np.vstack([each[0] for each in runs_seen])
    runs = np.repeat(np.arange(len(runs_seen)), [len(each[0]) for each in runs_seen])

    def axes_by(record: Calibration) -> list[tuple[Array, Array, float]]:
        force = correct_means(record, outputs, unit)
        swept = [axes.sweep is not None for axes in dwells]
        return [_fit_intercept(force[runs == k], each[1], swept[k]) for k, each in enumerate(runs_seen)]

    axes = axes_by(accel)
    force = np.array([each[0] for each in axes])
    length = np.linalg.norm(force, axis=1)
    direction = force / length[:, None]
    for k, run in enumerate(test.runs):
        if run.sign * direction[k, run.axis] < _FACE:
            raise DataError(
                f"{test.place(k)}: by the accelerometers {_upward_axis(direction[k])} points up: is mounting wrong?"
            )

    shifts, correlation = parameter_sensitivity(accel, lambda record: np.array([each[0] for each in axes_by(record)]))
    spread = np.array([each[2] for each in axes])
    return TableAxes(
        direction=direction,
        force=force,
        arm=np.array([each[1] for each in axes]),
        spread=spread / length,
        changes=unit_vectors(force + shifts) - direction,
        correlation=correlation,
        length_uncertainty=np.hypot(spread, length_uncertainty(force, shifts, correlation)),
    )


def correct_means(record: Calibration, outputs: Array, unit: str) -> Array:
    """Return mean outputs of the accelerometers as specific force by their record, m/s^2, shape (n, 3)."""
    columns = {"time": np.arange(len(outputs), dtype=np.float64), **dict(zip(_TRIAD, outputs.T, strict=True))}
    units = {name: "s" if name == "time" else unit for name in columns}
    corrected = record.apply(Recording(columns, units, {}, name="accelerometers"))
    return np.column_stack([corrected.si(name) for name in _TRIAD])


def unit_vectors(vectors: Array) -> Array:
    """Return vectors (.., 3) divided by their length."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def length_uncertainty(force: Array, shifts: Array, correlation: Array) -> Array:
    """Return the standard uncertainty of |f| of m forces (m, 3) by their record, from `parameter_sensitivity`; (m,)."""
    along = np.sum(shifts * unit_vectors(force), axis=2)
    return np.asarray(np.sqrt(np.maximum(np.einsum("pm,pq,qm->m", along, correlation, along), 0.0)))


def parameter_sensitivity(accel: Calibration, forces: Callable[[Calibration], Array]) -> tuple[Array, Array]:
    """Return the change of m forces by one standard uncertainty of each of p parameters, and their correlation.

    Shapes (p, m, 3) and (p, p).
    """
    names = [name for name in accel.covariance.names if not name.startswith(("gyro_", "mag_", "dip", "k"))]
    matrix = accel.covariance.block(names)
    sigma = np.sqrt(np.diag(matrix))
    at = forces(accel)
    changes = []
    for name, u in zip(names, sigma.tolist(), strict=True):
        parameter = accel.parameters[name]
        other = replace(accel, parameters={**accel.parameters, name: replace(parameter, value=parameter.value + u)})
        changes.append(forces(other) - at)
    known = np.maximum(sigma, 1e-300)
    return np.array(changes).reshape(len(names), len(at), 3), matrix / np.outer(known, known)


def _accelerometer_outputs(recording: Recording, place: str) -> tuple[Array, Array]:
    """Return time, s, and the outputs of the accelerometers, shapes (n,) and (n, 3)."""
    missing = [name for name in _TRIAD if name not in recording]
    if missing:
        raise DataError(f"{place}: no column {missing[0]}; the table axis by accelerometers needs all three")
    time, outputs = recording.si("time"), recording.triad("accel")
    if not np.isfinite(outputs).all():
        raise DataError(f"{place}: accel_*: expected numbers, found none at some times")
    return time, outputs


def _dwell_means(recording: Recording, dwells: Dwells, place: str) -> Array:
    """Return the mean outputs of the accelerometers over each dwell, shape (n, 3)."""
    time, outputs = _accelerometer_outputs(recording, place)
    first, last = np.searchsorted(time, dwells.start), np.searchsorted(time, dwells.stop, side="right")
    return np.array([outputs[a:b].mean(axis=0) for a, b in zip(first, last, strict=True)])


def _outputs_and_columns(recording: Recording, dwells: Dwells, place: str) -> tuple[Array, Array]:
    """Return mean outputs of the accelerometers, shape (n, 3), and the columns of their model, shape (n, c).

    The columns are 1 and w^2, of a sweep also w', cosine and sine; times the square root of the weight, for dwells the
    number of turns.
    """
    if dwells.sweep is not None:
        return _sweep_outputs_and_columns(recording, place)
    turns = np.abs(dwells.rate) * (dwells.stop - dwells.start) / (2 * np.pi)
    which = turns >= 1
    squares = dwells.rate[which] ** 2
    if len(np.unique(np.round(squares, 6))) < 2:
        raise DataError(
            f"{place}: the table axis by accelerometers needs dwells of a whole turn or more at two sizes of rate; "
            f"expected longer dwells, found {int(which.sum())}"
        )
    root = np.sqrt(turns[which])[:, None]  # the effect of a tilt on a mean falls with the number of turns
    return _dwell_means(recording, dwells, place)[which], np.column_stack([np.ones(len(squares)), squares]) * root


def _sweep_outputs_and_columns(recording: Recording, place: str) -> tuple[Array, Array]:
    """Return what `_outputs_and_columns` does over pieces of 0.02 s of a sweep."""
    time, outputs = _accelerometer_outputs(recording, place)
    rate = recorded_rate(recording, time)
    assert rate is not None
    angle = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(time))])
    if np.ptp(angle) < 2 * np.pi:
        raise DataError(
            f"{place}: the table axis by accelerometers needs a sweep that turns the table by a whole turn or more, "
            f"found {from_si(float(np.ptp(angle)), 'deg'):.0f} deg: sweep more slowly, or faster"
        )
    size = max(1, min(round(_PIECE / float(np.median(np.diff(time)))), len(time) // (_FEWEST * _BATCHES)))
    count = len(time) // size

    def pieces(values: Array) -> Array:
        return np.asarray(values[: count * size].reshape(count, size).mean(axis=1))

    columns = (pieces(np.square(rate)), pieces(np.gradient(rate, time)), pieces(np.cos(angle)), pieces(np.sin(angle)))
    force = np.column_stack([pieces(output) for output in outputs.T])
    return force, np.column_stack([np.ones(count), *columns])


def _fit_intercept(force: Array, columns: Array, swept: bool) -> tuple[Array, Array, float]:
    """Return mean force at rate 0, its slope over the rate squared, and the uncertainty of a component of the first.

    Dwells are independent of one another. Pieces of a sweep are not, where noise is filtered or vibration lasts longer
    than a piece: there the scores of longer batches give the variance.

    Source: Liang and Zeger, Biometrika 73 (1986) 13.
    """
    root, largest = columns[:, :1], np.abs(columns).max(axis=0)
    scaled = columns / largest
    inverse = np.linalg.inv(scaled.T @ scaled)
    coefficients = inverse @ (scaled.T @ (force * root))
    left = force * root - scaled @ coefficients
    if swept:
        edges = np.linspace(0, len(force), _BATCHES, endpoint=False).astype(np.int64)
        scores = np.add.reduceat((scaled @ inverse[:, :1]) * left, edges)
        variance = float(np.mean(np.sum(scores**2, axis=0))) * _BATCHES / (_BATCHES - columns.shape[1])
    else:
        freedom = max(len(force) - columns.shape[1], 1)
        variance = float(np.mean(np.sum(left**2, axis=0))) / freedom * float(inverse[0, 0])
    return coefficients[0] / largest[0], coefficients[1] / largest[1], float(np.sqrt(variance)) / largest[0]


def _upward_axis(direction: Array) -> str:
    """Return the body axis that is nearest to a direction, such as ``+z``."""
    k = int(np.argmax(np.abs(direction)))
    return f"{'+' if direction[k] > 0 else '-'}{AXES[k]}"


def warn_faces(test: RateTest, recordings: Sequence[Recording], dwells: Sequence[Dwells]) -> list[str]:
    """Return a warning for each run in which uncalibrated accelerometers see another face up than the manifest says."""
    messages: list[str] = []
    for k, (recording, run_dwells) in enumerate(zip(recordings, dwells, strict=True)):
        if all(name in recording for name in _TRIAD):
            mean = _dwell_means(recording, run_dwells, test.place(k)).mean(axis=0)
            if _upward_axis(mean) != test.runs[k].mounting:
                place = test.place(k)
                messages.append(
                    Finding(
                        f"{place}: the accelerometers see {_upward_axis(mean)} up: is mounting wrong, or their sign?",
                        "correct mounting in the manifest, or the axes of the accelerometers",
                    )
                )
    return messages


def warn_other_unit(record: Calibration, sensor: Mapping[str, str], option: str) -> list[str]:
    """Return a warning where the record of an option is of another unit than the recordings, by serial or element."""
    other = different_units(("the record", record.sensor), ("the recordings", sensor), keys=("serial", "element"))
    return (
        [Finding(f"{option}: {other}: is it of this unit?", f"state the record of this unit ({option})")]
        if other
        else []
    )


def warn_force_length(accel: Calibration, force: Array, uncertainty: Array, places: Sequence[str]) -> list[str]:
    """Return a warning where |f| of m forces (m, 3), m/s^2, is off g by more than record and power cycle explain."""
    off = np.linalg.norm(force, axis=1) - float(accel.model["gravity"]["value"])
    beyond = np.abs(off) - LENGTH_AT_REST_OFF.limit * uncertainty - _POWER_CYCLE
    k = int(np.argmax(beyond))
    if beyond[k] <= 0:
        return []
    return [
        Finding(
            f"accel: under the record |f| is {from_si(float(off[k]), 'mg'):+.3g} mg off gravity in {places[k]}, more "
            f"than its uncertainty ({from_si(float(uncertainty[k]), 'mg'):.2g} mg) and a power cycle explain: is it of "
            "this unit, at this temperature?",
            "use an accelerometer record of this unit and temperature (--accel)",
        )
    ]


def with_accelerometers(accel: Calibration, record: Calibration, remarks: Sequence[str] = ()) -> Calibration:
    """Return the accelerometers' record with the gyroscopes of a rate record in place of its own.

    `remarks` are warnings about the accelerometers. Where records and recordings name the unit, the recordings count.
    """
    accel_parameters = {name: p for name, p in accel.parameters.items() if not name.startswith("gyro_")}
    names = [name for name in accel.covariance.names if not name.startswith("gyro_")]
    size = len(names) + len(record.covariance.names)
    joined = np.zeros((size, size))
    joined[: len(names), : len(names)] = accel.covariance.block(names)
    joined[len(names) :, len(names) :] = record.covariance.array()
    sources = {source.file: source for source in (*accel.sources, *record.sources)}
    kept = ("gyro_order", "gyro_output_unit", "largest_rate")
    return replace(
        accel,
        parameters=accel_parameters | {name: _add_interval(name, p) for name, p in record.parameters.items()},
        covariance=Covariance((*names, *record.covariance.names), tuple(map(tuple, joined.tolist()))),
        model={**accel.model, **{name: record.model[name] for name in kept if name in record.model}},
        fit={**{name: part for name, part in accel.fit.items() if name != "gyro"}, "rate": dict(record.fit)},
        data={**{name: part for name, part in accel.data.items() if name != "gyro"}, "rate": dict(record.data)},
        sensor={**accel.sensor, **record.sensor},
        sources=tuple(sources.values()),
        warnings=(*(w for w in accel.warnings if not w.startswith("gyro")), *remarks, *record.warnings),
        verdict=UNJUDGED,
    )


def note_lean(axes: TableAxes, test: RateTest) -> list[str]:
    """Return the note that says by how much the table axis leaned from the faces."""
    cosines = [run.sign * axes.direction[k, run.axis] for k, run in enumerate(test.runs)]
    most = float(np.arccos(np.clip(min(cosines), -1, 1)))
    degrees = from_si(most, "deg")
    return [Note(f"the table axis leaned from the faces by up to {degrees:.2g} deg, by the accelerometers")]


def _add_interval(name: str, p: Parameter) -> Parameter:
    """Return a parameter with the interval of its uncertainty, as the accelerometers' parameters have one."""
    if p.interval_95 is not None or not p.standard_uncertainty or not name.startswith(GAINS):
        return p
    half = coverage_factor(None) * p.standard_uncertainty
    return replace(p, interval_95=(p.value - half, p.value + half))


# An earlier record of the same gyroscopes as prior knowledge: whether both agree, and both as one fit.


_TINY = 1e-12  # of the largest eigenvalue: smaller ones are of combinations that are known exactly
_APART = 5.0  # K that recordings may differ by to be at one temperature of a thermal record


def with_prior(record: Calibration, prior: Calibration, frame: str | None) -> Calibration:
    """Return the fit of a rate record and a prior together: ``z - cov(z, d) cov(d)^-1 d``.

    It is a record of both triads where the prior holds accelerometers and `record` has no misalignments. `frame` is
    that of the record's misalignments, None where it has none.

    Raises
    ------
    RecordError
        The prior holds no such gyroscopes, or in another unit.
    DataError
        It was made from one of the same recordings.
    """
    unit, its = record.model["gyro_output_unit"], prior.model.get("gyro_output_unit")
    if its is None:
        raise RecordError(f"prior: a {prior.procedure} record without gyroscopes; expected one of tumble gyro or rate")
    if its != unit:
        raise RecordError(f"prior: its gyroscopes are in {its}, those of the recording in {unit}; expected one unit")
    twice = {source.sha256 for source in prior.sources} & {source.sha256 for source in record.sources}
    if twice:
        name = next(source.file for source in record.sources if source.sha256 in twice)
        raise DataError(f"{name}: the prior was made from this recording, which would count twice")
    turned = prior.model.get("frame", BY_ACCELEROMETERS)
    alike = frame is None or frame == turned
    known = [
        name
        for name in prior.covariance.names
        if name.startswith(GAINS)
        and not name.startswith("gyro_scale_factor_slope")
        and (alike or not name.startswith("gyro_misalignment"))
    ]
    test_names = list(record.covariance.names)
    common = [name for name in test_names if name in known and not name.startswith("gyro_bias")]
    if not common:
        raise RecordError("prior: it holds none of the parameters found here; expected gyroscopes of the same axes")
    # a record without misalignments of its own takes over what it lacks
    further = [name for name in known if name not in test_names] if frame is None else []
    comparison = compared(_restrict_to(prior, common), _restrict_to(record, common))
    values, matrix = _update_by_prior(record, prior, test_names, common, further)
    parameters: dict[str, Parameter] = {}
    for name, value, u in zip(test_names + further, values.tolist(), np.sqrt(np.diag(matrix)).tolist(), strict=True):
        source = record.parameters.get(name) or prior.parameters[name]
        parameters[name] = Parameter(value, u, source.unit, interval_95=_scale_interval(source, value, u))
    axes = "".join(axis for axis in AXES if f"gyro_scale_factor_{axis}" in parameters)
    updated = replace(
        record,
        parameters={**record.parameters, **parameters},
        covariance=Covariance((*test_names, *further), tuple(map(tuple, matrix.tolist()))),
        model={
            **record.model,
            "gyro_order": _highest_power(parameters),
            "axes": axes,
        },
        fit={**record.fit, "prior": entries(_prior_section(prior, record, common, comparison.probability))},
        sources=tuple({source.file: source for source in (*prior.sources, *record.sources)}.values()),
        warnings=(
            *record.warnings,
            *warn_other_unit(prior, record.sensor, "prior"),
            _state_agreement(comparison.probability, comparison.changes),
        ),
        verdict=UNJUDGED,
    )
    return with_accelerometers(prior, updated) if frame is None and "bias_x" in prior.parameters else updated


def prior_at(prior: Calibration, recordings: Sequence[Recording]) -> Calibration:
    """Return a prior as it is at the mean temperature of the recordings, where it is a thermal record.

    Raises
    ------
    RecordError
        Their temperature is not known, or outside the record's range, or the record holds no scale factors.
    DataError
        Their temperatures differ, so that no one scale factor is theirs.
    """
    if prior.procedure != "thermal":
        return prior
    from imulab.procedures.thermal.device import gyros_at_temperature

    known = [
        (float(np.nanmean(recording.si("temperature"))), recording.name)
        for recording in recordings
        if "temperature" in recording
        and parse_unit(recording.units["temperature"]).quantity == "temperature"
        and np.isfinite(recording.si("temperature")).any()
    ]
    (coldest, cold), (hottest, hot) = min(known, default=(0.0, "")), max(known, default=(0.0, ""))
    if hottest - coldest > _APART:
        raise DataError(
            f"prior: {cold} was made at {coldest:.1f} degC, {hot} at {hottest:.1f}; a thermal record is a prior of "
            f"recordings at one temperature, {_APART:g} K apart at most: fit each temperature alone"
        )
    whole = float(np.mean([each for each, _ in known])) if len(known) == len(recordings) else None
    return gyros_at_temperature(prior, whole, recordings[0].name)


def _highest_power(parameters: Mapping[str, Parameter]) -> int:
    return max((int(name[6]) for name in parameters if name.startswith("gyro_k")), default=1)


def _restrict_to(record: Calibration, names: list[str]) -> Calibration:
    """Return a record of some of the parameters alone, for a comparison."""
    matrix = record.covariance.block(names)
    return replace(
        record,
        procedure="rate",
        parameters={name: record.parameters[name] for name in names},
        covariance=Covariance(tuple(names), tuple(map(tuple, matrix.tolist()))),
        model={},
    )


def _common_uncertainties(record: Calibration) -> dict[str, float]:
    """Return the relative uncertainty that all scale factors of a record share, under ``table`` or ``clock``."""
    fit: Any = record.fit.get("rate", record.fit)
    if "fence" in fit:  # of turns by hand
        return {"clock": fit.get("clock") or 0.0}
    if record.procedure == "rate" or "rate" in record.fit:
        return {"table": fit.get("table_uncertainty") or 0.0}
    return {"clock": fit.get("gyro", {}).get("clock", {}).get("standard_uncertainty") or 0.0}


def _update_by_prior(
    record: Calibration, prior: Calibration, test_names: list[str], common: list[str], further: list[str]
) -> tuple[Array, Array]:
    """Return values and covariance of `test_names` and `further` parameters by the fit of both records together.

    ``z - K d`` and ``cov(z) - K cov(z, d)'``, ``K = cov(z, d) cov(d)^-1``, d the difference of the `common` parameters.
    """
    mine, its = record.covariance.array(), prior.covariance.block(common + further)
    both = {name: _common_uncertainties(record).get(name, 0.0) * u for name, u in _common_uncertainties(prior).items()}
    scales = [
        np.array([source.parameters[name].value if name.startswith("gyro_scale_factor") else 0.0 for name in names])
        for source, names in ((record, test_names), (prior, common + further))
    ]
    across = sum(both.values()) * np.outer(*scales)
    k, n = len(common), len(test_names)
    at = [test_names.index(name) for name in common]
    whole = np.block([[mine, across[:, k:]], [across[:, k:].T, its[k:, k:]]])
    values = np.array(
        [record.parameters[name].value for name in test_names] + [prior.parameters[name].value for name in further]
    )
    other = np.array([prior.value(name) for name in common])
    with_difference = np.vstack([mine[:, at] - across[:, :k], across[at, k:].T - its[k:, :k]])
    of_difference = mine[np.ix_(at, at)] + its[:k, :k] - across[at, :k] - across[at, :k].T
    size = np.sqrt(np.maximum(np.diag(of_difference), 1e-300))
    inverse = np.linalg.pinv(of_difference / np.outer(size, size), rcond=_TINY, hermitian=True) / np.outer(size, size)
    gain = with_difference @ inverse
    matrix = whole - gain @ with_difference.T
    return values - gain @ (values[:n][at] - other), (matrix + matrix.T) / 2


def _scale_interval(source: Parameter, value: float, u: float) -> tuple[float, float] | None:
    """Return a parameter's interval about a new value, as many standard uncertainties wide as before."""
    if source.interval_95 is None or not source.standard_uncertainty:
        return None
    wide = (source.interval_95[1] - source.interval_95[0]) / 2 / source.standard_uncertainty * u
    return value - wide, value + wide


def _prior_section(prior: Calibration, record: Calibration, names: list[str], probability: float | None) -> RatePrior:
    """Return ``fit.prior``: the parameters that both records hold, by each alone."""
    return RatePrior(
        probability=probability,
        parameters={
            name: PriorParameter(prior=_as_measured(prior.parameters[name]), test=_as_measured(record.parameters[name]))
            for name in names
        },
    )


def _as_measured(parameter: Parameter) -> Measured:
    return Measured(value=parameter.value, standard_uncertainty=parameter.standard_uncertainty, unit=parameter.unit)


def _state_agreement(probability: float | None, changes: Any) -> str:
    """Return the note or warning that says whether prior and test agree, and which parameter differs most."""
    chance = "" if probability is None else f" (probability {probability_fact(probability)})"
    differing = [change for change in changes if change.significant]
    if not differing and probability is not None and probability < RATE_PRIOR_CONTRADICTED.level:
        return Finding(
            f"the prior does not agree{chance}: all parameters together, no one parameter by itself; both are one fit "
            "all the same (see show A B)",
            "compare the two (imulab show A B), and leave --prior out if the unit has changed",
        )
    if not differing:
        return Note(f"the prior agrees{chance}; both are one fit, but for the biases, which are new")
    worst = max(differing, key=lambda change: abs(change.deviations or 0.0))
    read = reading_unit(worst.unit, worst.name)
    return Finding(
        f"the prior does not agree{chance}: {worst.name} differs by {read.factor * worst.difference:+.3g} "
        f"{read.of_difference}, {abs(worst.deviations or 0.0):.1f} times its uncertainty; both are one fit all "
        "the same (see show A B)",
        "compare the two (imulab show A B), and leave --prior out if the unit has changed",
    )
