"""Scale factors and misalignments of gyroscopes from whole turns by hand, with a rest against a fence between them.

Scale factor (`_fit_scale`): between two rests at the fence the unit turned n times, so that the angle stated by the
gyroscopes, integrated over the turn, is ``2 pi n S``. Each stop is off the fence by its own error, which the turns
before and after share with opposite signs: ``u(S)/S = u_stop / (2 pi sqrt(sum (j_k - mean j)^2))``, j_k the turns made
at stop k.

Misalignment (`add_misalignments`): the integrals of turn k about the vertical, n_k times round, are
``2 pi n_k B a_k``, ``B = diag(S) T``, with a_k the vertical in the body. That is the direction of g a in
``f = g a + c cos + s sin + w^2 r + w' q``, fitted to the accelerometers over the turn; the other terms hold the tilt of
the table and the lever arm.

Source: rotation about a fixed axis; least squares; Bortz, IEEE Trans. AES-7 (1971) 61.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Unpack

import numpy as np

from imulab.display import UNJUDGED, Bad, Note
from imulab.errors import DataError, ObservabilityError, OptionError, RecordError
from imulab.estimation.decisions import (
    AXIS_TILTED,
    SCALE_OFF_UNIT,
    TURNS_ACROSS_SCATTER,
    TURNS_LOSE_SAMPLES,
    TURNS_SCATTER,
)
from imulab.estimation.least_squares import chi_square_probability, coverage_factor
from imulab.gravity import EARTH, checked_latitude
from imulab.options import measure, text
from imulab.procedures.rate import AXES, FENCE, TILT, name_gyroscopes, parse_fraction
from imulab.procedures.rate.axes import (
    BY_ACCELEROMETERS,
    correct_means,
    length_uncertainty,
    parameter_sensitivity,
    prior_at,
    unit_vectors,
    warn_force_length,
    warn_other_unit,
    with_accelerometers,
    with_prior,
)
from imulab.procedures.rate.motions import Motions, carry_direction, compose_turns, find_motions
from imulab.procedures.rate.schema import TurnsEvidence, TurnsModel, TurnsSummary, WholeTurns
from imulab.procedures.rate.turn_errors import LIKELY, MISALIGNMENT, RestingBias, bias_at_rest, share_lost, tilt_shift
from imulab.procedures.result import Record, Result, as_record, as_recording
from imulab.quantities import in_si
from imulab.recording import Array, Data, Reading, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.sections import Quantity, entries
from imulab.report.parameters import text_in
from imulab.units import from_si


@dataclass(frozen=True)
class AxisTurns:
    """The turns about one body axis.

    Attributes
    ----------
    count, angle
        Turns made, signed, and the angle that the gyroscope states, rad, shape (k,).
    residual, uncertainty
        Residual of each angle under the scale factor, and its standard uncertainty, rad, shape (k,).
    scale, scale_uncertainty
        Stated over true angle, and its standard uncertainty.
    freedom
        Turns less one where they scatter beyond the fence, and that scatter is in the uncertainty; else None.
    motion
        Index of each turn among the motions, shape (k,).
    tilt
        What `scale` holds too much by tilt and misalignment of the axis, relative, and its standard uncertainty.
    across
        Largest angle by which the other gyroscopes see the axis lie off this one's, rad.
    usual
        What such an angle usually is, by tilt or misalignment, rad.
    lost, lost_probability
        Root mean square share of samples that may be lost, and the probability that any are.
    """

    count: Array
    angle: Array
    residual: Array
    uncertainty: Array
    scale: float
    scale_uncertainty: float
    freedom: int | None
    motion: tuple[int, ...]
    tilt: tuple[float, float] = (0.0, 0.0)
    across: float = 0.0
    usual: float = MISALIGNMENT
    lost: float = 0.0
    lost_probability: float = 0.0


# Misalignments, from the axis of each turn in the body by accelerometers.


_TURN = 2 * np.pi  # rad
_SMOOTH = 0.05  # s over which the rate of a turn is averaged
_BATCHES = 8  # parts of a turn whose scatter gives the uncertainty of its axis
_FACE = np.cos(np.radians(30))  # cosine of the largest angle between a turn's axis and its body axis
_EXACT = 1e-12  # of a turn: noise that is assumed of data without noise


def check_accel(accel: Calibration, recording: Recording) -> None:
    """Refuse a record without accelerometers, and a recording without their columns.

    Raises
    ------
    RecordError, DataError
        See above.
    """
    if "bias_x" not in accel.parameters:
        raise RecordError(f"accel: a {accel.procedure} record without accelerometers; expected one of tumble fit")
    for name in (f"accel_{axis}" for axis in AXES):
        if name not in recording:
            raise recording.lacking(f"column {name}", name, "the axis of turns by accelerometers needs all three")


def add_misalignments(
    record: Calibration, recording: Recording, motions: Motions, axis_turns: Mapping[str, AxisTurns], accel: Calibration
) -> Calibration:
    """Return the record of turns with scale factors and misalignments in the frame of the accelerometers.

    ``B A = Y``: a column of A is the mean axis of the turns about one body axis, that of Y their integrals over
    ``2 pi n``.

    Raises
    ------
    ObservabilityError
        The unit was not turned about x, y and z.
    DataError
        The accelerometers see another axis upright than that of a turn.
    """
    lacking = [axis for axis in AXES if axis not in axis_turns]
    if lacking:
        raise ObservabilityError(
            f"{recording.name}: no turns about {' '.join(lacking)}; accel tells misalignments from turns about x, y "
            "and z: lay the unit on three faces"
        )
    turned = [(axis, k) for axis in range(3) for k in axis_turns[AXES[axis]].motion]
    outputs = recording.triad("accel")
    count = np.concatenate([axis_turns[axis].count for axis in AXES])
    rests = [
        _fit_upright_output(outputs, motions, k, axis, n) for (axis, k), n in zip(turned, count.tolist(), strict=True)
    ]
    force, spread = np.array([mean for mean, _ in rests]), np.array([u for _, u in rests])
    unit = recording.triad_unit("accel")

    def corrected(by: Calibration) -> Array:
        return correct_means(by, force, unit)

    seen_force = corrected(accel)
    direction = _find_axes(seen_force, turned, motions, recording.name)
    shifts, correlation = parameter_sensitivity(accel, corrected)
    sign = np.sign(np.sum(direction * seen_force, axis=1))[:, None]
    changes = sign * unit_vectors(seen_force + shifts) - direction
    of_length = np.linalg.norm(seen_force, axis=1) * np.linalg.norm(spread, axis=1)
    of_length = np.hypot(of_length, length_uncertainty(seen_force, shifts, correlation))
    places = [f"the turn at {motions.start[k]:.1f} to {motions.stop[k]:.1f} s" for _, k in turned]
    remarks = warn_force_length(accel, seen_force, of_length, places)
    scale = np.array([axis_turns[axis].scale for axis in AXES])
    u_scale = np.array([np.hypot(t.scale_uncertainty, t.scale * t.lost) for t in (axis_turns[axis] for axis in AXES)])
    across = np.array([motions.angle[k] for _, k in turned]) / _TURN
    noise = np.array([motions.zero[k] for _, k in turned]) / _TURN
    noise = np.hypot(noise, count[:, None] * spread * scale)
    groups = [np.array([axis == j for axis, _ in turned]) for j in range(3)]

    def gains(directions: Array, c: Array, y: Array) -> Array:
        """Return B from the axes, the composed turns c along their own axes, and the integrals y across these."""
        sides = np.column_stack([_average_axes(directions[members], count[members]) for members in groups])
        felt = y.copy()
        for j in range(3):
            felt[j, j] = np.sqrt(c[j] ** 2 - np.sum(np.delete(y[:, j], j) ** 2))
        return np.asarray(felt @ np.linalg.inv(sides))

    crossed = np.column_stack(
        [(count[members] @ across[members]) / (count[members] @ count[members]) for members in groups]
    )
    matrix = gains(direction, scale, crossed)
    u_crossed = np.zeros((3, 3))
    for j, members in enumerate(groups):
        left = across[members] - count[members][:, None] * (direction[members] @ matrix.T)
        u_crossed[:, j] = _uncertainty_of_slopes(left, count[members], noise[members])
    covariance = _propagate(gains, direction, scale, crossed, u_scale, u_crossed, changes, correlation)
    return replace(_extend_record(record, matrix, covariance), warnings=(*record.warnings, *remarks), verdict=UNJUDGED)


def _fit_upright_output(outputs: Array, motions: Motions, k: int, axis: int, count: float) -> tuple[Array, Array]:
    """Return the output of the accelerometers due to g a in turn k, shape (3,), and its uncertainty over g.

    By least squares of 1, cos, sin, w^2 and w', weighted by the rate; the uncertainty is by the scores of 8 batches.
    """
    first, last = motions.span[k]
    step, size = motions.steps[k], np.linalg.norm(motions.steps[k], axis=1)
    angle = np.cumsum(step[:, axis])
    angle *= _TURN * count / angle[-1]
    period = motions.period
    width = max(1, round(_SMOOTH / period))
    rate = np.convolve(step[:, axis], np.full(width, 1 / width), mode="same") / period
    rise = np.gradient(rate)
    columns = [np.ones(len(rate)), np.cos(angle), np.sin(angle), rate**2, rise]
    matrix = np.column_stack([column / max(float(np.abs(column).max()), 1e-300) for column in columns])
    values = (outputs[first + 1 : last + 1] + outputs[first:last]) / 2
    weight = np.sqrt(size / size.max())[:, None]
    normal = np.linalg.pinv((matrix * weight).T @ (matrix * weight))
    estimate = normal @ (matrix * weight**2).T @ values
    left = (values - matrix @ estimate) * weight**2
    edges = np.linspace(0, len(left), _BATCHES + 1).astype(np.int64)[:-1]
    scores = np.add.reduceat(left[:, None, :] * matrix[:, :, None], edges, axis=0)
    shift = np.einsum("j,bjk->bk", normal[0], scores)
    return estimate[0], np.sqrt(np.sum(shift**2, axis=0)) / float(np.linalg.norm(estimate[0]))


def _find_axes(force: Array, turned: list[tuple[int, int]], motions: Motions, name: str) -> Array:
    """Return the axis of each turn in the body, of unit length, along the positive axis that it is next to."""
    direction = force / np.linalg.norm(force, axis=1)[:, None]
    for (axis, k), along in zip(turned, direction, strict=True):
        if abs(along[axis]) < _FACE:
            upright = AXES[int(np.argmax(np.abs(along)))]
            raise DataError(
                f"{name}: the turn at {motions.start[k]:.1f} to {motions.stop[k]:.1f} s is about {AXES[axis]} by the "
                f"gyroscopes, but by the accelerometers {upright} is upright; expected turns on a level table"
            )
    signs = [np.sign(along[axis]) for (axis, _), along in zip(turned, direction, strict=True)]
    return np.asarray(direction * np.array(signs)[:, None])


def _average_axes(direction: Array, count: Array) -> Array:
    """Return the mean of axes, weighted by the square of the turns made about each."""
    return np.asarray(count**2 @ direction / (count @ count))


def _uncertainty_of_slopes(left: Array, count: Array, noise: Array) -> Array:
    """Return the standard uncertainty of three slopes over turns made; by their scatter where it exceeds the noise."""
    noise = np.maximum(noise, _EXACT * np.abs(count)[:, None])  # the scatter of data without noise is rounding
    variance = (count**2 @ noise**2) / (count @ count) ** 2
    freedom = len(count) - 1
    if not freedom:
        return np.asarray(np.sqrt(variance))
    chi_square = np.sum((left / noise) ** 2, axis=0)
    beyond = np.array(
        [chi_square_probability(float(value), freedom) < TURNS_ACROSS_SCATTER.level for value in chi_square]
    )
    return np.asarray(np.sqrt(variance * np.where(beyond, chi_square / freedom, 1.0)))


def _scale_and_misalignment(matrix: Array) -> Array:
    """Return scale factors and then misalignments of ``B = diag(S) T``, shape (9,)."""
    scale = np.diag(matrix)
    turn = matrix / scale[:, None]
    return np.concatenate([scale, turn[~np.eye(3, dtype=bool)]])


def _propagate(
    gains: Callable[[Array, Array, Array], Array], direction: Array, scale: Array, crossed: Array, u_scale: Array,
    u_crossed: Array, changes: Array, correlation: Array,
) -> Array:  # fmt: skip
    """Return the covariance of `_scale_and_misalignment`: of stops, of integrals across, and of the accelerometers."""
    at = _scale_and_misalignment(gains(direction, scale, crossed))
    rows = []
    for j in range(3):
        moved = scale.copy()
        moved[j] += u_scale[j]
        rows.append(_scale_and_misalignment(gains(direction, moved, crossed)) - at)
        for i in range(3):
            if i != j:
                other = crossed.copy()
                other[i, j] += u_crossed[i, j]
                rows.append(_scale_and_misalignment(gains(direction, scale, other)) - at)
    by_scale = np.array(rows)
    of_record = np.array(
        [_scale_and_misalignment(gains(direction + change, scale, crossed)) - at for change in changes]
    )
    of_record = of_record.reshape(-1, len(at))
    return np.asarray(by_scale.T @ by_scale + of_record.T @ correlation @ of_record)


def _extend_record(record: Calibration, matrix: Array, covariance: Array) -> Calibration:
    """Return the record of turns with these scale factors, misalignments and their covariance."""
    unit = str(record.model["gyro_output_unit"])
    clock = float(record.fit["clock"] or 0.0)
    values = _scale_and_misalignment(matrix) * np.concatenate([np.full(3, from_si(1.0, unit)), np.ones(6)])
    factor = values / _scale_and_misalignment(matrix)
    names = [f"gyro_scale_factor_{a}" for a in AXES]
    names += [f"gyro_misalignment_{a}{b}" for a in AXES for b in AXES if a != b]
    common = np.where(np.arange(9) < 3, values, 0.0) * clock
    joined = covariance * np.outer(factor, factor) + np.outer(common, common)
    biases = {name: p for name, p in record.parameters.items() if name.startswith("gyro_bias")}
    parameters = dict(biases)
    for name, value, u in zip(names, values.tolist(), np.sqrt(np.diag(joined)).tolist(), strict=True):
        before = record.parameters.get(name)
        interval = None if before is None else before.interval_95
        if before is not None and interval is not None and before.standard_uncertainty:
            wide = (interval[1] - interval[0]) / 2 / before.standard_uncertainty * u
            interval = (value - wide, value + wide)
        kind = "rad" if "misalignment" in name else f"{unit}/(rad/s)"
        parameters[name] = Parameter(value, u, kind, interval_95=interval)
    whole = np.zeros((len(parameters),) * 2)
    whole[:3, :3] = record.covariance.block(list(biases))
    whole[3:, 3:] = joined
    return replace(
        record,
        parameters=parameters,
        covariance=Covariance(tuple(parameters), tuple(map(tuple, whole.tolist()))),
        model={**record.model, "frame": BY_ACCELEROMETERS},
    )


# The calibration record of whole turns.


def turns_record(
    recording: Recording,
    motions: Motions,
    axis_turns: Mapping[str, AxisTurns],
    fence: float,
    clock: float | None,
    latitude: float | None = None,
) -> Calibration:
    """Return the record of the scale factors and biases."""
    unit = recording.triad_unit("gyro")
    bias = _bias_of_rests(motions, axis_turns, latitude)
    parameters = _bias_parameters(bias, axis_turns) | _scale_parameters(axis_turns, clock, unit)
    spread = np.array([p.standard_uncertainty or 0.0 for p in parameters.values()])
    matrix = np.diag(spread**2)
    names = list(parameters)
    for i, a in enumerate(names):
        for k, b in enumerate(names):
            if i != k and a.startswith("gyro_scale") and b.startswith("gyro_scale"):
                matrix[i, k] = parameters[a].value * parameters[b].value * (clock or 0.0) ** 2
    turned = sorted((k, a, j) for a, turned_axis in axis_turns.items() for j, k in enumerate(turned_axis.motion))
    turns = WholeTurns(
        axis=[a for _, a, _ in turned],
        start=[float(motions.start[k]) for k, _, _ in turned],
        stop=[float(motions.stop[k]) for k, _, _ in turned],
        count=[float(axis_turns[a].count[j]) for _, a, j in turned],
        angle=[float(axis_turns[a].angle[j]) for _, a, j in turned],
        residual=[float(axis_turns[a].residual[j]) for _, a, j in turned],
        standard_uncertainty=[float(axis_turns[a].uncertainty[j]) for _, a, j in turned],
    )
    return Calibration(
        procedure="rate",
        parameters=parameters,
        covariance=Covariance(tuple(names), tuple(map(tuple, matrix.tolist()))),
        model=entries(TurnsModel(gyro_order=1, gyro_output_unit=unit, axes="".join(axis_turns), from_="turns")),
        fit=entries(TurnsSummary(turns=len(turned), fence=Quantity(value=fence, unit="rad"), clock=clock)),
        options={"fence": fence},
        data=entries(TurnsEvidence(turns=turns)),
        sensor={key: text for key in ("serial", "model", "element") if (text := recording.metadata.get(key))},
        sources=() if recording.source is None else (recording.source,),
        warnings=(
            *motions.notes,
            *_warn_turns(axis_turns, clock),
            *_warn_unseen(axis_turns, bias, latitude, motions),
        ),
    )


def _bias_of_rests(motions: Motions, axis_turns: Mapping[str, AxisTurns], latitude: float | None) -> RestingBias:
    """Return the biases by the rests; a rest has the axis upright about which the unit turned beside it."""
    upright = np.full(len(motions.zeros), -1)
    for axis, turned_axis in axis_turns.items():
        for k in turned_axis.motion:
            upright[k : k + 2] = AXES.index(axis)
    force = None
    if motions.before is not None and motions.after is not None:
        force = np.vstack([motions.before, motions.after[-1:]])
    return bias_at_rest(motions.zeros, force, upright, latitude)


def _bias_parameters(bias: RestingBias, axis_turns: Mapping[str, AxisTurns]) -> dict[str, Parameter]:
    """Return ``gyro_bias_i``; intervals are Student's t of the rests, as far as their scatter is the uncertainty."""
    parameters = {}
    for a, turned_axis in axis_turns.items():
        i = AXES.index(a)
        value, noise = float(bias.value[i]) / turned_axis.scale, float(bias.noise[i]) / turned_axis.scale
        u = float(np.hypot(noise, bias.earth[i]))
        half = coverage_factor((bias.rests - 1) * (u / noise) ** 4) * u if noise else None
        interval = None if half is None else (value - half, value + half)
        parameters[f"gyro_bias_{a}"] = Parameter(value, u, "rad/s", interval_95=interval)
    return parameters


def _scale_parameters(axis_turns: Mapping[str, AxisTurns], clock: float | None, unit: str) -> dict[str, Parameter]:
    """Return ``gyro_scale_factor_i``, with the uncertainty by stops, tilt, lost samples and clock."""
    nominal = float(from_si(1.0, unit))
    parameters = {}
    for a, turned_axis in axis_turns.items():
        scale = turned_axis.scale / (1 + turned_axis.tilt[0])
        relative = np.linalg.norm([turned_axis.tilt[1], turned_axis.lost, clock or 0.0])
        u = float(np.hypot(turned_axis.scale_uncertainty, scale * relative))
        interval = None
        if turned_axis.freedom is not None:
            reach = coverage_factor(float(turned_axis.freedom)) * u
            interval = ((scale - reach) * nominal, (scale + reach) * nominal)
        parameters[f"gyro_scale_factor_{a}"] = Parameter(
            scale * nominal, u * nominal, f"{unit}/(rad/s)", interval_95=interval
        )
    return parameters


def _warn_turns(axis_turns: Mapping[str, AxisTurns], clock: float | None) -> list[str]:
    """Return warnings and notes about scale factors: off the unit, scattered, turned one way, or per clock."""
    messages: list[str] = []
    made = sorted(
        (k, n * np.sign(each.scale))
        for each in axis_turns.values()
        for k, n in zip(each.motion, each.count, strict=True)
    )
    turned = ",".join(f"{count:.0f}" for _, count in made)
    for a, turned_axis in axis_turns.items():
        if turned_axis.scale < 0:
            messages.append(
                Bad(
                    f"gyro_{a} turned the other way round than stated: its scale factor is {turned_axis.scale:.3g}",
                    f"state the turns as --turns {turned}, positive by the right-hand rule about their own axis",
                )
            )
        off = abs(turned_axis.scale) - 1
        if abs(off) > SCALE_OFF_UNIT:
            messages.append(
                Bad(
                    f"gyro_{a}: the scale factor is off by {100 * off:+.3g} %: is the unit right?",
                    "check the unit of the outputs, and the turns stated",
                )
            )
        if turned_axis.freedom is not None:
            messages.append(
                Note(f"gyro_{a}: the turns scatter more than the fence; its interval is Student's t of them")
            )
        if not ((turned_axis.count > 0).any() and (turned_axis.count < 0).any()):
            messages.append(
                Note(
                    f"gyro_{a} was turned one way round only: what is even in the rate, and an error of the zero, "
                    "is in its scale factor; turn as many back"
                )
            )
    if clock is None:
        messages.append(
            Note(
                "the scale factors are those per clock: a sample rate that is off is in them; state what it is known "
                "to (--clock)"
            )
        )
    return messages


def _warn_unseen(
    axis_turns: Mapping[str, AxisTurns], bias: RestingBias, latitude: float | None, motions: Motions
) -> list[str]:
    """Return what is said of lost samples, a tilted axis and the Earth's rate."""
    messages: list[str] = []
    for a, turned_axis in axis_turns.items():
        if turned_axis.lost_probability > LIKELY:
            messages.append(
                f"gyro_{a}: the turns scatter as if {100 * turned_axis.lost:.2g} % of the samples were lost; its scale "
                "factor may be low by as much, which its uncertainty holds; record with a counter or stamps of the "
                "sensor's clock"
            )
        if turned_axis.tilt[1] and turned_axis.across > AXIS_TILTED.limit * turned_axis.usual:
            messages.append(
                f"gyro_{a}: by the other gyroscopes the turns were about an axis "
                f"{np.degrees(turned_axis.across):.2g} deg off its own, by tilt or misalignment; the scale factor's "
                "uncertainty holds what that may add; turn about x, y and z, with the record of the accelerometers "
                "(--accel)"
            )
    which = [AXES.index(a) for a in axis_turns]
    if latitude is None and (bias.earth[which] > bias.noise[which] / 3).any():
        messages.append(
            Note(
                f"the Earth's rate, up to {text_in(EARTH, 'deg/h', 2)} deg/h, is in the uncertainties of the biases; "
                "the latitude tells its vertical part (--latitude)"
            )
        )
    elif latitude is not None and motions.before is None:
        messages.append(
            Note(
                "which way is up is not known without accelerometers: the Earth's rate is in the uncertainties of the "
                "biases"
            )
        )
    return messages


# The fit.


_SAME, _OTHER = np.radians(10), np.radians(30)  # angle of gravity between rests: the same, and another attitude
_PART, _WHOLE, _FIRST, _OFF = 0.4, 0.12, 0.2, 0.1
"""Parts of a turn: a smaller motion is no turn; whole turns miss by this at most, the first ones by that; and the
scale factor is off by this share at most."""
_ASKEW = 0.4
"""Angle about a second axis over that about the first, from which the turn is about no one body axis."""
_FACTORS = np.geomspace(0.4, 2.5, 41)  # by which the stated sample rate may be wrong
_CARRIES = np.radians(15)  # by which gravity is missed at most under the right sample rate


@dataclass(frozen=True, repr=False)
class TurnsFit(Result):
    """Result of whole turns by hand.

    Attributes
    ----------
    calibration
        The record: scale factor and bias of each gyroscope that was turned.
    turns
        By body axis.

    Examples
    --------
    >>> import imulab as il
    >>> import numpy as np
    >>> gyro = np.zeros((1200, 3))
    >>> gyro[300:900, 2] = 60.6
    >>> float(round(il.fit_turns({"gyro": gyro}, rate=100, unit="deg/s").turns["z"].scale, 3))
    1.01
    """

    calibration: Calibration
    turns: dict[str, AxisTurns]


def fit_turns(
    data: Data,
    *,
    fence: Annotated[float | str, measure("angle", "deg")] = FENCE,
    turns: Annotated[str | Sequence[int] | None, text("N,N,...")] = None,
    clock: Annotated[float | str | None, text("FRACTION")] = None,
    latitude: Annotated[float | str | None, measure("angle", "deg")] = None,
    tilt: Annotated[float | str, measure("angle", "deg")] = TILT,
    accel: Record | None = None,
    prior: Record | None = None,
    **reading: Unpack[Reading],
) -> TurnsFit:
    """Calibrate gyroscopes by whole turns by hand, with a rest against a fence before and after each.

    ``S = sum of stated angles / (2 pi sum of turns)``, by generalised least squares over stops that two turns share.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays with ``time`` and ``gyro_x``, ``_y``, ``_z`` in a unit of rate; with
        ``accel_*`` a wrong sample rate is found from turns that change the attitude.
    fence
        Uncertainty of the difference of two stops. Standard uncertainty, rad.
    turns
        Number of turns of each, such as 1,5,-6; else counted. In order; counted from the gyroscopes.
    clock
        Uncertainty of the sample rate, such as 50ppm. Relative standard uncertainty; without it the scale factors are
        those per clock.
    latitude
        Of the place, for the Earth's rate. In rad; without it that rate is in the uncertainties of the biases.
    tilt
        How far the axis of the turns may lie off the body axis. Standard uncertainty, rad; not used with accel.
    accel
        Tumble record, whose accelerometers tell the turns' axes. Of `fit_tumble` of the same unit or its file, for
        turns about x, y and z on a level table: the result is a record of both triads, with misalignments.
    prior
        Earlier record of the same gyroscopes, as prior knowledge. Of `fit_gyro` or of a rate test, or its file: both
        are one fit. The record says whether they agree, and holds what turns do not show as the prior has it. A thermal
        record is one at the mean temperature of the recording.
    reading
        How data are to be understood: `rate` or `time`, `unit`; `layout`, `topic`, `instance`, `window`, `element`.

    Raises
    ------
    SegmentError
        There are no rests between turns.
    DataError
        No motion is a whole turn, one is none, the sample rate cannot be right, or the accelerometers see another
        axis upright.
    ObservabilityError
        With accel: the unit was not turned about x, y and z.
    RecordError
        `accel` or `prior` is not such a record.
    OptionError
        An option has an unknown value.

    Source: GUM (JCGM 100:2008); Bortz, IEEE Trans. AES-7 (1971) 61.

    Examples
    --------
    >>> import imulab as il
    >>> import numpy as np
    >>> gyro = np.zeros((1200, 3))
    >>> gyro[300:900, 2] = 60.6
    >>> il.fit_turns({"gyro": gyro}, rate=100, unit="deg/s").calibration.parameters["gyro_scale_factor_z"].unit
    'deg/s/(rad/s)'
    """
    width = in_si(fence, "fence", "angle", "deg")
    if not 0 < width < 1:
        raise OptionError(f"fence {fence}: expected the uncertainty of the difference of two stops, such as 0.5 deg")
    of_clock = None if clock is None else parse_fraction(clock, "clock")
    place = None if latitude is None else checked_latitude(in_si(latitude, "latitude", "angle", "deg"))
    lean = in_si(tilt, "tilt", "angle", "deg")
    if not 0 <= lean < 0.5:
        raise OptionError(f"tilt {tilt}: expected an angle of 0 or more, such as 0.5 deg")
    stated = None if turns is None else _parse_counts(turns)
    held = None if accel is None else as_record(accel, "fit_turns: accel")
    tilted = lean if held is None else 0.0  # accelerometers show the axis
    recording = as_recording(data, reading, fit_turns, name_gyroscopes, clock="gyro")
    if held is not None:
        check_accel(held, recording)
    motions = find_motions(recording, width)
    _check_sample_rate(motions, recording.name)
    which = _select_turns(motions, recording.name)
    if stated is not None and len(stated) != len(which):
        raise OptionError(f"turns: {len(stated)} given, {len(which)} found in {recording.name}; expected one for each")
    axis_turns = {}
    for axis in range(3):
        members = [k for k in which if np.argmax(np.abs(motions.angle[k])) == axis]
        if members:
            angle = np.array([_whole_angle(motions, k, axis) for k in members])
            stated_counts = (
                None if stated is None else np.array([stated[which.index(k)] for k in members], dtype=np.float64)
            )
            count = _count_turns(angle, motions, members, recording.name) if stated_counts is None else stated_counts
            _check_counts(angle / _TURN, count, motions, members, recording.name)
            axis_turns[AXES[axis]] = _fit_scale(motions, members, axis, angle, count, width, tilted)
    record = turns_record(recording, motions, axis_turns, width, of_clock, place)
    if held is not None:
        record = add_misalignments(record, recording, motions, axis_turns, held)
    if prior is not None:
        frame = None if held is None else BY_ACCELEROMETERS
        record = with_prior(record, prior_at(as_record(prior, "fit_turns: prior"), [recording]), frame)
    if held is not None:
        record = with_accelerometers(held, record, warn_other_unit(held, record.sensor, "accel"))
    return TurnsFit(record, axis_turns)


def _parse_counts(turns: str | Sequence[int]) -> list[int]:
    """Return the stated numbers of turns, such as ``1,5,-6``."""
    try:
        counts = [int(part) for part in (turns.split(",") if isinstance(turns, str) else turns)]
    except ValueError:
        counts = []
    if not counts or not all(counts):
        raise OptionError(f"turns {turns!r}: expected whole numbers such as 1,5,-6")
    return counts


def _angle_between_rests(motions: Motions, k: int) -> float:
    """Return the angle between gravity at the rests before and after a motion, rad; 0 where it is not known."""
    if motions.before is None or motions.after is None:
        return 0.0
    a, b = motions.before[k], motions.after[k]
    return float(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def _check_sample_rate(motions: Motions, name: str) -> None:
    """Refuse a sample rate with which the motions do not carry gravity from one attitude to the next."""
    if motions.before is None or motions.after is None:
        return
    tipped = [k for k in range(len(motions.steps)) if _angle_between_rests(motions, k) > _OTHER]
    if len(tipped) < 2:
        return
    before, after = (v / np.linalg.norm(v, axis=1)[:, None] for v in (motions.before, motions.after))

    def misses(factor: float) -> float:
        turned = [carry_direction(compose_turns(motions.steps[k] * factor), before[k]) for k in tipped]
        angles = [np.arccos(np.clip(v @ after[k], -1, 1)) for v, k in zip(turned, tipped, strict=True)]
        return float(np.median(angles))

    best = min(_FACTORS.tolist(), key=misses)
    best = min((best * np.linspace(0.95, 1.05, 41)).tolist(), key=misses)
    if abs(best - 1) > _OFF and misses(best) < _CARRIES:
        way = "high" if best > 1 else "low"
        raise DataError(
            f"{name}: gravity is carried from attitude to attitude only if every turn was {best:.2f} times what the "
            f"gyroscopes and the sample rate say: is the stated sample rate {max(best, 1 / best):.2g} times too {way}, "
            "or the unit of the gyroscopes another?"
        )


def _select_turns(motions: Motions, name: str) -> list[int]:
    """Return the indices of motions that are turns: they return to the same attitude, and are large enough."""
    whole = []
    for k in range(len(motions.start)):
        part = float(np.abs(motions.angle[k]).max()) / _TURN
        if _angle_between_rests(motions, k) > _SAME or part < _PART:
            continue
        if part < 1 - _PART:
            raise DataError(
                f"{name}: the turn at {motions.start[k]:.1f} to {motions.stop[k]:.1f} s is of {360 * part:.0f} deg by "
                "the gyroscopes: half a turn, or a whole one with a stated sample rate twice too high; expected whole "
                "turns"
            )
        first, second = np.argsort(-np.abs(motions.angle[k]))[:2].tolist()
        if abs(motions.angle[k, second]) > _ASKEW * abs(motions.angle[k, first]):
            degrees = np.degrees(motions.angle[k])
            raise DataError(
                f"{name}: the turn at {motions.start[k]:.1f} to {motions.stop[k]:.1f} s is about {AXES[first]} and "
                f"{AXES[second]} together ({degrees[first]:.0f} and {degrees[second]:.0f} deg): was the unit lifted or "
                "tipped, or do its axes lie askew? Expected turns about one axis"
            )
        whole.append(k)
    if not whole:
        raise DataError(f"{name}: no whole turn between two rests; expected one turn or more back to the same place")
    return whole


def _whole_angle(motions: Motions, k: int, axis: int) -> float:
    """Return the angle about a body axis by the composed small turns, whole turns included, rad."""
    closing, rough = float(motions.closing[k, axis]), float(motions.angle[k, axis])
    return closing + _TURN * round((rough - closing) / _TURN)


def _count_turns(angle: Array, motions: Motions, members: list[int], name: str) -> Array:
    """Return the signed number of turns of each angle; the smaller ones give the scale factor for the larger."""
    ratio, count, scale = angle / _TURN, np.zeros(len(angle)), 1.0
    done: list[int] = []
    for k in np.argsort(np.abs(ratio)).tolist():
        low, high = (int(f(abs(ratio[k]) / (1 + s * _OFF))) for f, s in ((np.ceil, 1), (np.floor, -1)))
        where = f"{name}: the turn at {motions.start[members[k]]:.1f} to {motions.stop[members[k]]:.1f} s"
        if not done and high > low:
            raise DataError(
                f"{where} is of {360 * abs(ratio[k]):.0f} deg by the gyroscopes: {low} to {high} turns; begin with one "
                "turn, or say how many there were (--turns)"
            )
        number = abs(ratio[k]) / scale
        missing, whole = abs(number - round(number)), round(number)
        if not done and whole > 1 and _FIRST < missing < 1.5 * _OFF * whole:
            raise DataError(
                f"{where} is of {360 * number:.0f} deg by the gyroscopes: {whole} turns with a scale factor of "
                f"{number / whole:.3f}, or {number:.2f} turns, which are not whole; begin with one turn, or say "
                "how many there were (--turns)"
            )
        if whole == 0 or missing > (_WHOLE if done or whole == 1 else _FIRST):
            raise DataError(
                f"{where} is of {360 * number:.0f} deg: {number:.2f} turns; expected a whole number, back to the same "
                "place at the fence; where the turns were whole, --turns says how many each was, such as --turns 1,-1"
            )
        count[k] = np.sign(ratio[k]) * round(number)
        done.append(k)
        scale = float(np.abs(ratio[done]).sum() / np.abs(count[done]).sum())
    return count


def _check_counts(ratio: Array, count: Array, motions: Motions, members: list[int], name: str) -> None:
    """Refuse a stated number of turns that does not go with the others."""
    scale = float(np.median(ratio / count))
    off = np.abs(ratio / scale - count)
    k = int(np.argmax(off))
    if off[k] > 0.5:
        raise DataError(
            f"{name}: the turn at {motions.start[members[k]]:.1f} to {motions.stop[members[k]]:.1f} s is of "
            f"{360 * ratio[k]:.0f} deg, {count[k]:+.0f} turns as stated, but {ratio[k] / scale:+.2f} as the others go: "
            "is --turns right?"
        )


def _fit_scale(
    motions: Motions, members: list[int], axis: int, angle: Array, count: Array, fence: float, tilt: float
) -> AxisTurns:
    """Return the scale factor about one axis: ``S = (t' C^-1 angle) / (t' C^-1 t)``, ``t = 2 pi count``.

    C holds fence^2 and the zero's variance on the diagonal, and -fence^2 / 2 between successive turns, which share a
    stop. Where the turns scatter beyond that (chi-square), the variance is enlarged.
    """
    stops = fence**2 * np.eye(len(members))
    for k in range(len(members) - 1):
        if members[k + 1] == members[k] + 1:
            stops[k, k + 1] = stops[k + 1, k] = -(fence**2) / 2
    of_zero = motions.zero[members, axis] ** 2
    covariance = stops + np.diag(of_zero)
    turned = _TURN * count
    weight = np.linalg.solve(covariance, turned)
    variance = 1 / float(turned @ weight)
    scale = variance * float(weight @ angle)
    left = angle - scale * turned
    chi_square, freedom = float(left @ np.linalg.solve(covariance, left)), len(members) - 1
    by_stops = chi_square_probability(chi_square, freedom) if freedom > 0 else 1.0
    beyond = by_stops < TURNS_SCATTER.level
    wide = chi_square / freedom if beyond else 1.0
    others = [other for other in range(3) if other != axis]
    across = count @ motions.angle[members][:, others] / (count @ turned)
    square = np.array([np.sum(motions.steps[k][:, axis] ** 2) for k in members])
    lost, probability = share_lost(angle, turned, stops, of_zero, square)
    return AxisTurns(
        count=count,
        angle=angle,
        residual=left,
        uncertainty=np.sqrt(np.diag(covariance)),
        scale=scale,
        scale_uncertainty=float(np.sqrt(variance * wide)),
        freedom=freedom if beyond else None,
        motion=tuple(members),
        tilt=tilt_shift(across, tilt),
        across=float(np.abs(across).max()),
        usual=max(MISALIGNMENT, tilt),
        lost=lost,
        lost_probability=probability if by_stops < TURNS_LOSE_SAMPLES.level else 0.0,
    )
