"""The fit of a magnetometer triad, from data to the record of both triads; the mathematics is in `model`, `solve`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.display import UNJUDGED, Bad, Finding, Note
from imulab.errors import DataError, OptionError, listed, meant, quoted
from imulab.estimation.decisions import (
    DIP_MOVES_ACCELEROMETERS,
    DIP_OFF_STATED,
    FIELD_DISTURBED,
    FIELD_ORDER_TWO,
    FIELD_SET_ASIDE,
    FIELD_STEP,
    FIELD_STEP_BESIDE_POSE,
)
from imulab.estimation.distributions import probability_text
from imulab.estimation.least_squares import coverage_factor, f_test
from imulab.estimation.rows import rms
from imulab.gravity import (
    Height,
    Latitude,
    LocalGravity,
    ModelField,
    Site,
    at_place,
    field_note,
    field_of_test,
    site,
    stated_site,
)
from imulab.options import RARE, Group, choice, measure, parsed, repeated, text
from imulab.procedures import tumble
from imulab.procedures.magnetometer.fit import MagnetometerFit, fit_readings
from imulab.procedures.result import OWN_CLOCKS, Record, Result, as_record, as_recording
from imulab.procedures.tumble import HEMISPHERES, LOSSES, MAG_ORDERS
from imulab.procedures.tumble.attitudes import Attitudes, TumbleData, as_attitudes
from imulab.procedures.tumble.estimate import check_field
from imulab.procedures.tumble.gyro.fit import with_gyro_of
from imulab.procedures.tumble.mag.model import FEWEST, FieldMeans, count_extremes, mag_names
from imulab.procedures.tumble.mag.prepare import (
    Disturbed,
    MagObservability,
    check_observability,
    find_most_disturbed,
    find_step,
    heading_uncertainty,
    judge_observability,
    leave_one_out,
    prepare,
)
from imulab.procedures.tumble.mag.solve import Joint, Place, Ready, parse_place, solve
from imulab.procedures.tumble.model import gravity_slope, parameter_names, parameter_units
from imulab.procedures.tumble.record import make_record, si_parameters
from imulab.procedures.tumble.schema import (
    FieldAgreement,
    Heading,
    MagFields,
    MagModel,
    MagSummary,
    OneSample,
)
from imulab.quantities import in_si
from imulab.recording import Array, Reading
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.sections import FieldPlace, Length, Quantity, entries
from imulab.units import parse_unit

# The record.


_AXES = "xyz"
_ATTITUDES_ASKED = 16  # attitudes below which the noise of |m| and dip is poorly known
_ONE_WAY = 6.0
"""Condition number from which turning the heading would halve the uncertainty, or better."""
_LARGE_RMS, _LARGE_DIP = 0.02, np.radians(1.0)
"""Scatter of |m| and dip, rad, that attitudes at rest in one field do not have; of real ones at most 0.5 %, 0.3 deg."""
_HOPELESS = 5.0  # times that, from which the record is bad
_POINTING = np.radians(3.0)  # scatter of attitudes that point the same way, from which there is a warning
_OF_THE_EARTH = 22e-6, 67e-6  # T, least and largest magnitude of the Earth's field
_BUILDING = 1.4
"""Factor by which iron in a building may raise or lower the field."""


def make_mag_record(
    ready: Ready, joint: Joint, observability: MagObservability, aside: Sequence[Disturbed], options: Mapping[str, Any]
) -> Calibration:
    """Return the record of both triads: parameters, covariance, and residuals of |m| and dip of each attitude."""
    accel = make_record(
        ready.estimate, ready.gravity, ready.scaling,
        {"order": ready.order, "method": "norm", "loss": ready.loss, "gravity": ready.gravity.option},
    )  # fmt: skip
    known = _parameter_covariance(ready, joint)
    heading = heading_uncertainty(joint, known)
    names, values, matrix, units = _convert_to_si(ready, joint, known)
    parameters = _make_parameters(names, values, matrix, units, joint.freedom[: len(names)])
    accel_parameters = accel.parameters
    moved = {
        name: (parameters[name].value - accel_parameters[name].value) / u
        for name in parameter_names(ready.estimate.problem.order)
        if (u := accel_parameters[name].standard_uncertainty)
    }
    kept = {
        name: replace(parameters[name], standard_uncertainty_given_order=parameter.standard_uncertainty_given_order)
        for name, parameter in accel_parameters.items()
    }
    return replace(
        accel,
        parameters=kept | {name: parameters[name] for name in mag_names(joint.pair.mag_order)},
        covariance=Covariance(tuple(names), tuple(map(tuple, matrix.tolist()))),
        model={**accel.model, **entries(_model_section(ready, joint))},
        fit={
            **accel.fit,
            "mag": entries(
                _summarize_fit(ready, joint, observability, aside, moved, heading, _sample_noise(ready, parameters))
            ),
        },
        options={
            **accel.options,
            **{f"mag_{name}" if name == "loss" else name: value for name, value in options.items()},
        },
        data={**accel.data, "mag": entries(_fields_section(ready, joint, aside))},
        warnings=tuple(
            dict.fromkeys(
                (
                    *accel.warnings,
                    *ready.means.notes,
                    *ready.notes,
                    *_warn_fit(ready, joint, observability, aside, moved, options, heading[0]),
                    *_warn_stated_dip(parameters["dip"], options.get("dip")),
                )
            )
        ),
        verdict=UNJUDGED,
    )


def _parameter_covariance(ready: Ready, joint: Joint) -> Array:
    """Return the covariance of the scaled parameters, with that of the accelerometers' order, shape (p, p)."""
    covariance = joint.covariance.copy()
    covariance[joint.pair.layout.of_accel, joint.pair.layout.of_accel] += _order_covariance(ready)
    return covariance


def _convert_to_si(ready: Ready, joint: Joint, known: Array) -> tuple[list[str], Array, Array, list[str]]:
    """Return names, values in SI, covariance and units of all parameters, the magnetometers' first."""
    layout, order = joint.pair.layout, ready.estimate.problem.order
    g = ready.gravity.value
    of_mag, mag_slope = ready.mag.in_si(joint.theta[: layout.mag])
    of_accel, accel_slope = si_parameters(joint.theta[layout.of_accel], ready.scaling, g, order)
    size = layout.mag + 1 + layout.accel
    slope = np.eye(size)
    slope[: layout.mag, : layout.mag] = mag_slope
    slope[layout.of_accel, layout.of_accel] = accel_slope
    matrix = slope @ known[:size, :size] @ slope.T
    shared = np.zeros(size)
    shared[layout.of_accel] = ready.gravity.standard_uncertainty / g * gravity_slope(of_accel, order)
    unit = "1" if ready.mag.field is None else "T"
    output = ready.means.unit
    per = output if unit == "1" else f"{output}/T"
    names = [*mag_names(joint.pair.mag_order), *parameter_names(order)]
    units = [unit] * 3 + [per] * 3 + ["rad"] * 6 + ["1" if unit == "1" else "1/T"] * (layout.mag - 12) + ["rad"]
    units += parameter_units(order, ready.estimate.attitudes.unit)
    values = np.concatenate([of_mag, [joint.theta[layout.dip_at]], of_accel])
    return names, values, matrix + np.outer(shared, shared), units


def _order_covariance(ready: Ready) -> Array:
    """Return the covariance to add for an order of the accelerometers that was chosen from the data, shape (p, p)."""
    stated = ready.estimate.stated
    size = ready.estimate.solution.theta.shape[1]
    if stated is None or stated.given_order is None:
        return np.zeros((size, size))
    values, vectors = np.linalg.eigh(stated.covariance - stated.given_order)
    gained: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return gained


def _make_parameters(
    names: list[str], values: Array, matrix: Array, units: list[str], freedom: Array
) -> dict[str, Parameter]:
    """Return the parameters with 95 % intervals of Student's t, by the degrees of freedom of each variance."""
    parameters = {}
    for name, value, u, unit, nu in zip(
        names, values.tolist(), np.sqrt(np.diag(matrix)).tolist(), units, freedom.tolist(), strict=True
    ):
        half = coverage_factor(nu if np.isfinite(nu) else None) * u
        parameters[name] = Parameter(value, u, unit, interval_95=(value - half, value + half))
    return parameters


def _name_columns(axes: Array) -> str:
    """Return the output that became each axis, such as ``+y -x +z``, from a signed permutation."""
    return " ".join(
        f"{'+' if row[output] > 0 else '-'}{'xyz'[output]}"
        for row, output in zip(axes, np.abs(axes).argmax(axis=1).tolist(), strict=True)
    )


def _model_section(ready: Ready, joint: Joint) -> MagModel:
    """Return ``model``: order, unit and field of the magnetometers, and which output became which axis."""
    field = ready.mag.field
    return MagModel(
        mag_order=joint.pair.mag_order,
        mag_output_unit=ready.means.unit,
        mag_axes=_name_columns(ready.mag.axes),
        field=Quantity(value=1.0, unit="1") if field is None else Quantity(value=field, unit="T"),
    )


def _summarize_fit(
    ready: Ready,
    joint: Joint,
    observability: MagObservability,
    aside: Sequence[Disturbed],
    moved: Mapping[str, float],
    heading: tuple[float, float],
    one_sample: OneSample | None,
) -> MagSummary:
    """Return ``fit.mag``: how well magnitude and dip of the field agree over the attitudes."""
    predicted, residuals = leave_one_out(joint), joint.found.residuals
    directed = joint.pair.held is not None
    return MagSummary(
        attitudes=len(residuals),
        magnitude=FieldAgreement(rms=rms(residuals[:, 1]), leave_one_out=predicted.rms(1)),
        dip=FieldAgreement(rms=rms(residuals[:, 2]), leave_one_out=predicted.rms(2)),
        noise="estimated from the residuals" if joint.pair.noise is None else "known",
        sigma_magnitude=float(joint.sigma[0]),
        sigma_dip=Length(value=float(joint.sigma[1]), unit="rad"),
        sigma_direction=Length(value=float(joint.sigma[2]), unit="rad") if directed else None,
        condition_number=observability.condition,
        set_aside=[int(ready.kept[disturbed.index]) + 1 for disturbed in aside],
        heading=Heading(
            standard_uncertainty=Length(value=heading[0], unit="rad"),
            of_one_reading=Length(value=heading[1], unit="rad"),
        ),
        moved=dict(moved),
        of_one_sample=one_sample,
    )


def _sample_noise(ready: Ready, parameters: Mapping[str, Parameter]) -> OneSample | None:
    """Return the noise of one axis of one sample, m/s^2 and parts of the field; None of a table of means."""
    if ready.means.of_one_sample is None:
        return None
    of_accel, of_mag = ready.means.of_one_sample
    scale = float(np.median([abs(parameters[f"scale_factor_{axis}"].value) for axis in "xyz"]))
    return OneSample(
        accel=Length(value=of_accel / scale, unit="m/s^2"), mag=Length(value=of_mag / ready.mag.size, unit="1")
    )


def _fields_section(ready: Ready, joint: Joint, aside: Sequence[Disturbed]) -> MagFields:
    """Return ``data.mag``: number, mean output, field (of length 1) and residuals of each attitude."""
    used = ready.pair.mag
    layout = joint.pair.layout
    every = ready.pair if layout.mag == ready.pair.layout.mag else replace(ready.pair, mag_order=joint.pair.mag_order)
    evaluated = every.evaluate(joint.theta)
    return MagFields(
        number=(ready.kept + 1).tolist(),
        label=[ready.estimate.attitudes.label(i) for i in range(len(used))],
        mean=ready.means.mean[ready.kept].tolist(),
        field=evaluated.field.vector.tolist(),
        force=evaluated.force.vector.tolist(),
        magnitude=evaluated.residuals[:, 1].tolist(),
        dip=evaluated.residuals[:, 2].tolist(),
        used=np.isin(np.arange(len(used)), [disturbed.index for disturbed in aside], invert=True).tolist(),
    )


def _warn_scatter(joint: Joint, means: FieldMeans, used: NDArray[np.intp]) -> list[str]:
    """Return a warning where |m| or dip scatter more than in a steady field and with triads that belong together."""
    magnitude, dip = rms(joint.found.residuals[:, 1]), rms(joint.found.residuals[:, 2])
    worst = max(magnitude / _LARGE_RMS, dip / _LARGE_DIP)
    if worst <= 1:
        return []
    kind = Bad if worst > _HOPELESS else Finding
    count, axis, value = count_extremes(means.mean[used])
    clipped = f", is mag_{_AXES[axis]} saturated at {value:.4g} {means.unit} ({count} attitudes)" if count > 2 else ""
    return [
        kind(
            f"mag: |m| scatters by {100 * magnitude:.2g} % of the field, the dip by {np.degrees(dip):.2g} deg: "
            f"were both triads in the same attitudes, by one clock, and was no iron near that moved{clipped}?",
            "record both triads in the same attitudes, by one clock, away from iron that moves",
        )
    ]


def _warn_step(joint: Joint, labels: Sequence[str]) -> list[str]:
    """Return a warning of a step of |m| and dip from some attitude on; a note where pose explains it as well."""
    step = find_step(joint)
    if step is None or step.probability > FIELD_STEP.level:
        return []
    what = (
        f"mag: from {labels[step.first]} on |m| is {100 * abs(step.magnitude):.2g} % "
        f"{'higher' if step.magnitude > 0 else 'lower'} and the dip {np.degrees(abs(step.dip)):.2g} deg "
        f"{'higher' if step.dip > 0 else 'lower'} than before ({probability_text(step.probability)})"
    )
    if step.beside_pose > FIELD_STEP_BESIDE_POSE.level:
        return [
            Note(
                f"{what}; the attitudes from there on point other ways than those before, so that pose explains this "
                "as well as time: attitudes in mixed order would tell"
            )
        ]
    return [
        Finding(
            f"{what}: was iron, such as a phone, near in a part of the attitudes, or did the place change?",
            "record all attitudes again at one place, away from phones and iron",
        )
    ]


def _warn_stated_dip(dip: Parameter, stated: Sequence[float] | None) -> list[str]:
    """Return a warning where the dip is off the stated one by more than the uncertainty of both."""
    if stated is None:
        return []
    off, sigma = dip.value - stated[0], float(np.hypot(dip.standard_uncertainty or 0.0, stated[1]))
    if abs(off) <= DIP_OFF_STATED.limit * sigma:
        return []
    return [
        Finding(
            f"mag: the dip of {np.degrees(dip.value):.2f} deg is {np.degrees(abs(off)):.2g} deg "
            f"{'more' if off > 0 else 'less'} than the {np.degrees(stated[0]):.2f} deg stated, {abs(off) / sigma:.1f} "
            "standard uncertainties: is iron near, or is the stated dip of another place?",
            "state the dip of this place (--dip), or measure farther from iron",
        )
    ]


def _note_set_aside(label: str, off: Disturbed) -> str:
    """Return the words that name an attitude which was set aside, and by how much it is off: a note by its chance."""
    kind = Finding if off.probability < FIELD_DISTURBED.level else Note
    return kind(
        f"mag: {label} set aside: |m| {100 * abs(off.magnitude):.2g} % "
        f"{'high' if off.magnitude > 0 else 'low'}, dip {np.degrees(abs(off.dip)):.2g} deg "
        f"{'high' if off.dip > 0 else 'low'} against the others ({probability_text(off.probability)}): "
        "iron or a vehicle near?",
        "measure this attitude again, away from iron and vehicles",
    )


def _warn_moved(moved: Mapping[str, float]) -> list[str]:
    """Return a message on the accelerometers' parameter that the dip moves most, by its standard uncertainties."""
    name, value = max(moved.items(), key=lambda item: abs(item[1]), default=("", 0.0))
    if abs(value) <= DIP_MOVES_ACCELEROMETERS.limit:
        return []
    return [
        Finding(
            f"mag: the dip moves the accelerometers' {name} by {abs(value):.1f} standard uncertainties: field and "
            "gravity contradict each other; was iron near, or did the unit move?",
            "record again away from iron, each attitude held still",
        )
    ]


def _warn_fit(
    ready: Ready,
    joint: Joint,
    observability: MagObservability,
    aside: Sequence[Disturbed],
    moved: Mapping[str, float],
    options: Mapping[str, Any],
    heading: float,
) -> list[str]:
    """Return the warnings and notes of a fit of both triads."""
    attitudes = ready.estimate.attitudes
    messages = [_note_set_aside(attitudes.label(disturbed.index), disturbed) for disturbed in aside]
    n = len(joint.pair.mag)
    if n < _ATTITUDES_ASKED:
        text = f"mag: {n} attitudes leave little to tell the noise from; {_ATTITUDES_ASKED} or more are asked for"
        messages.append(Finding(text, f"record {_ATTITUDES_ASKED} attitudes or more (imulab tumble plan --with mag)"))
    if not joint.converged:
        messages.append(
            Finding(
                "mag: the fit of both triads did not come to rest: more attitudes, at several headings, would help",
                "record more attitudes, at several headings",
            )
        )
    if observability.condition > _ONE_WAY:
        left = np.delete(ready.kept, [disturbed.index for disturbed in aside])
        which = " ".join(str(int(left[i]) + 1) for i in sorted(observability.heading))
        messages.append(
            Note(
                f"mag: the attitudes face nearly one way (condition {observability.condition:.0f}): heading is known "
                f"to {np.degrees(heading):.2g} deg only; attitudes {which} once more, facing a quarter turn away, "
                "would help most"
            )
        )
    messages += _warn_moved(moved)
    left = np.delete(ready.kept, [disturbed.index for disturbed in aside])
    labels = [attitudes.label(int(np.searchsorted(ready.kept, i))) for i in left]
    messages += [*_warn_scatter(joint, ready.means, left), *_warn_step(joint, labels)]
    if joint.pair.held is not None and joint.sigma[2] > _POINTING:
        messages.append(
            Finding(
                f"mag: the attitudes of --same-direction scatter by {np.degrees(joint.sigma[2]):.2g} deg about their "
                "directions: does one axis of the body point the same way in them?",
                "check which attitudes --same-direction names",
            )
        )
    if "hemisphere" not in options:
        messages.append(_warn_sign_of_dip(float(joint.theta[joint.pair.layout.dip_at]), ready.mag.axes))
    if ready.mag.field is None and parse_unit(ready.means.unit).quantity == "magnetic field":
        messages.append(_warn_field_size(ready.mag.size * parse_unit(ready.means.unit).factor, ready.means.unit))
    return messages


def _warn_sign_of_dip(dip: float, axes: Array) -> str:
    """Return what the sign of a dip, rad, rests on: all of field, gravity and turns look alike with the other sign.

    With the other sign the columns that became axes are reversed, which the fit cannot tell from a turn of the
    magnetometers in the body. It is to be looked at where that reverses fewer columns: two exchanged axes, or one
    reversed axis, explain the data more simply.
    """
    where, other = ("northern", "southern") if dip > 0 else ("southern", "northern")
    sentence = (
        f"mag: the dip of {np.degrees(dip):+.1f} deg is one of the {where} hemisphere; if this is the {other}, a "
        "magnetometer axis is reversed, two are exchanged, or the accelerometers read minus the specific force"
    )
    if np.count_nonzero(axes < 0) < 2:
        return Note(f"{sentence} (--hemisphere checks it)")
    return Finding(
        f"{sentence}: x y z are taken from the columns {_name_columns(axes)}, and would be {_name_columns(-axes)}",
        "state the hemisphere (--hemisphere)",
    )


def _warn_field_size(field: float, unit: str) -> str:
    """Return a warning that |m|, T, is not that of the Earth's field, or else that its magnitude was not stated."""
    low, high = _OF_THE_EARTH
    if not low / _BUILDING < field < high * _BUILDING:
        return (
            f"mag: |m| is {1e6 * field:.3g} uT in the unit {unit}, but the Earth's field has {1e6 * low:.0f} to "
            f"{1e6 * high:.0f} uT: state the unit that the outputs have, or the field by --field"
        )
    return Note(
        "mag: the field's magnitude was not stated: the field is in units of the local one; give --field, such "
        f"as --field {1e6 * field:.3g}uT, for uT"
    )


# The fit.


_STEEPEST = np.radians(87.0)  # dip from which headings cannot be determined
_OFF, _CONTRADICTS = np.radians(0.5), 4.0
"""A fitted dip is refused that is off the stated one by more than this, rad, and by so many standard uncertainties."""
_GAIN = 0.9  # quadratic terms must lower the product of the leave-one-out errors of |m| and dip to this part
_MOST_ASIDE = 5
"""At most one attitude of so many is set aside."""


@dataclass(frozen=True, repr=False)
class MagFit(Result):
    """Result of `fit_mag`.

    Attributes
    ----------
    calibration
        The record of both triads.
    joint
        The fit, in units of gravity and of the field.
    seen
        Observability of the magnetometers' parameters.
    set_aside
        Attitudes that were left out, from 0, with their deviations from the others.

    Examples
    --------
    >>> import imulab as il
    >>> recording = il.simulate_tumble(order=1, gravity=9.81362, field="48 uT")
    >>> fit = il.fit_mag(recording, gravity=9.81362, field="48 uT")
    >>> fit.calibration.parameters["mag_bias_x"].unit
    'T'
    """

    calibration: Calibration
    joint: Joint
    seen: MagObservability
    set_aside: tuple[Disturbed, ...]


def fit_mag(
    data: TumbleData,
    *,
    accel: Record | None = None,
    same_direction: Annotated[Sequence[str | Sequence[int]], repeated("A-B")] = (),
    field: Annotated[float | str | None, measure("magnetic field", "uT", "48.2uT")] = None,
    loss: Annotated[str, choice(LOSSES)] = "auto",
    mag_order: Annotated[int | str, choice(MAG_ORDERS)] = 1,
    drop: Annotated[Sequence[int | str], repeated("N"), RARE] = (),
    hemisphere: Annotated[str | None, choice(HEMISPHERES), RARE] = None,
    dip: Annotated[float | str | tuple[float, float] | None, parsed(tumble.dip, "67.2+-0.2", unit="deg"), RARE] = None,
    gravity: LocalGravity = None,
    latitude: Latitude = None,
    height: Height = None,
    place: Annotated[str | Site | None, parsed(site, "LAT,LON[,HEIGHT]", unit="deg, m"), Group("gravity")] = None,
    date: Annotated[str | None, text("YYYY-MM-DD"), Group("gravity")] = None,
    order: Annotated[int | str, text("auto|1..5", ("auto", "1", "2", "3", "4", "5")), RARE] = "auto",
    **reading: Unpack[Reading],
) -> MagFit | MagnetometerFit:
    """Calibrate a magnetometer triad, in the accelerometers' frame, from the attitudes of a tumble test.

    Of data without accelerometers, waved or turned level, see `fit_magnetometer`, which is what they get.

    ``|m| = F`` and ``m.f = -|m| |f| sin(dip)`` in every attitude, ``M = S (A + b)``, ``A = s (+ k2 s^2)``, ``s = T m``:
    hard iron b, soft iron, scale and mounting in S and T. Both triads are fitted together.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays by name with both triads; without a time each row is an attitude.
    accel
        Tumble record of the accelerometers; of another test: a prior. Or its file: of these data it says how they were
        fitted; of another test it is prior knowledge. Gyroscopes that it holds are kept.
    same_direction
        Attitudes in which one axis points the same way; repeatable. Groups of attitudes, numbers from 1 or texts such
        as ``"9-16"``, and an axis of the body.
    field
        Magnitude of the local field; without it the field is 1. In T, or a text such as ``"48.2uT"``; biases are parts
        of the field then.
    loss
        auto: set disturbed attitudes aside and name them; square: keep all; huber: limit them. Those that do not fit
        the others; ``huber`` limits the pull of single ones.
    mag_order
        2: quadratic terms too; auto: where they predict. Better, and the gain is significant.
    drop
        Attitude to leave out; repeatable. Numbers from 1.
    hemisphere
        To check the sign of the dip. By the latitude, where that is given, beyond 20 deg.
    dip
        Dip of the place, to compare with the one found. In rad with its standard uncertainty, ``(1.17, 0.003)``, or a
        text, ``"67.2+-0.2 deg"``; without one that of a model of the Earth's field, 0.2 deg. It is not used in the fit.
    gravity
        Local gravity; else of the accelerometers' record, else of the head. As for `fit_tumble`.
    latitude, height
        As for `fit_tumble`.
    place
        Where the test was made: gives gravity, field and dip that are not stated otherwise. Field and dip are those of
        the World Magnetic Model on the date; a text such as ``"48.1,11.6,520"``.
    date
        Day of the test, for the field of the place; else that in the head of the recording.
    order
        Order of the accelerometers' model, auto or 1 to 5.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window`, `element`.

    Raises
    ------
    ObservabilityError
        The attitudes cannot separate the parameters, as where all face one way; the message says what would help.
    DataError
        The columns are missing, dead, saturated or in another unit; there are too few attitudes; the dip is not
        that of the hemisphere, or off what was stated by 4 standard uncertainties and 0.5 deg.
    OptionError
        An option has a value that cannot be.

    Source: Vasconcelos et al., IEEE Trans. Aerosp. Electron. Syst. 47 (2011) 1293; Liu et al., Sensors 14 (2014) 8485.

    Examples
    --------
    A simulated unit, whose true dip stands in the recording's head:

    >>> import imulab as il
    >>> recording = il.simulate_tumble(gravity=9.81, field="48 uT", dip="67 deg")
    >>> fit = il.fit_mag(recording, gravity=9.81, order=1, field="48 uT")
    >>> abs(fit.calibration.parameters["dip"].value - float(recording.metadata["truth_dip"])) < 0.01
    True
    """
    magnitude = None if field is None else in_si(field, "field", "magnetic field", "uT")
    _check_options(loss, mag_order, order, magnitude)
    stated = parse_place(hemisphere, latitude, dip)
    where = stated_site(place, date, latitude, height)
    if not isinstance(data, Attitudes):
        recording = as_recording(data, reading, fit_mag, clock=OWN_CLOCKS)
        data, reading = recording, Reading()
        if not any(name in recording for name in triad("accel")) and all(name in recording for name in triad("mag")):
            _refuse_alone(
                recording.name, mag_order, accel=accel, same_direction=same_direction, drop=drop, gravity=gravity,
                latitude=latitude, height=height, hemisphere=hemisphere, dip=dip,
            )  # fmt: skip
            return fit_readings(recording, magnitude, where, date)
    attitudes = as_attitudes(data, reading, fit_mag)
    model_field = None if where is None else field_of_test(where, date, attitudes.recording)
    if where is not None and model_field is not None:
        stated = parse_place(hemisphere, None, stated.dip or model_field.dip)
        magnitude = model_field.magnitude[0] if magnitude is None else magnitude
        latitude, height = (where.latitude, where.height) if gravity is None else (None, None)
    known = None if accel is None else as_record(accel, "fit_mag: accel")
    ready = prepare(
        attitudes,
        known,
        gravity=at_place(gravity, latitude, height),
        order=order,
        field=magnitude,
        same_direction=same_direction,
        drop=drop,
    )
    joint, aside, what = _solve_observed(ready, loss, str(mag_order), held=bool(same_direction))
    check_observability(what, np.delete(ready.kept, [one.index for one in aside]), attitudes.recording.name)
    _check_result(joint, ready, stated)
    set_options = _stated_options(loss, mag_order, magnitude, stated, drop, same_direction)
    record = make_mag_record(ready, joint, what, aside, set_options)
    if where is not None and model_field is not None:
        record = _with_place(record, where, model_field)
    if known is not None and not ready.notes:
        record = with_gyro_of(record, known)
    return MagFit(record, joint, what, aside)


def _refuse_alone(name: str, mag_order: int | str, **options: Any) -> None:
    """Refuse options that need accelerometers."""
    stated = [key for key, value in options.items() if value is not None and value != ()]
    if stated or str(mag_order) != "1":
        option = stated[0] if stated else "mag_order"
        raise OptionError(f"{option} needs accelerometers, and {name} has magnetometers alone: leave it out")


def _solve_observed(
    ready: Ready, loss: str, mag_order: str, *, held: bool
) -> tuple[Joint, tuple[Disturbed, ...], MagObservability]:
    """Return the fit, the attitudes that it leaves out, and how well they tell the magnetometers' parameters."""
    try:
        with np.errstate(all="ignore"):  # a diverging fit ends in LinAlgError
            joint, aside = _solve_pair(ready, loss, mag_order)
            what = judge_observability(joint.pair, joint.theta)
        if held and not what.enough:  # it was enough at the start of the fit
            raise np.linalg.LinAlgError
    except np.linalg.LinAlgError:
        raise DataError(
            f"{ready.estimate.attitudes.recording.name}: the fit of both triads finds no solution: are both of the "
            f"same attitudes, by one clock{', and does one axis point the same way in those of same-direction' * held}?"
        ) from None
    return joint, aside, what


def _stated_options(
    loss: str,
    mag_order: int | str,
    field: float | None,
    stated: Place,
    drop: Sequence[int | str],
    same_direction: Sequence[str | Sequence[int]],
) -> dict[str, Any]:
    """Return the options of a fit that say something, as the record keeps them."""
    options = {
        "loss": loss, "mag_order": mag_order if mag_order == "auto" else int(mag_order),
        "field": field, "hemisphere": stated.hemisphere, "dip": stated.dip and list(stated.dip),
        "drop": list(map(str, drop)),
        "same_direction": [group if isinstance(group, str) else list(group) for group in same_direction],
    }  # fmt: skip
    return {name: value for name, value in options.items() if value not in (None, [])}


def _with_place(record: Calibration, where: Site, field: ModelField) -> Calibration:
    """Return a record with the place of the test, and the model whose field was used there."""
    place = entries(FieldPlace.of(where, field))
    return replace(record, model={**record.model, "place": place}, warnings=(*record.warnings, field_note(field)))


def _check_options(loss: str, mag_order: int | str, order: int | str, field: float | None) -> None:
    for name, value, choices in (("loss", loss, LOSSES), ("mag_order", str(mag_order), MAG_ORDERS)):
        if value not in choices:
            raise OptionError(f"{name} {quoted(value)}: expected one of {listed(choices, str(value))}")
    if str(order) not in ("auto", "1", "2", "3", "4", "5"):
        raise OptionError(f"order {quoted(order)}: expected auto or 1 to 5{meant(['auto'], order)}")
    check_field(field)


def _solve_pair(ready: Ready, loss: str, mag_order: str) -> tuple[Joint, tuple[Disturbed, ...]]:
    """Return the fit of both triads in the order that is asked for, and the disturbed attitudes that it leaves out."""
    robust = loss == "huber"
    joint, aside = solve(ready.pair, ready.start, robust=robust), tuple[Disturbed, ...]()
    if loss == "auto":
        joint, aside = _leave_out_disturbed(joint, ready)
    if mag_order != "1":
        joint = _fit_order_two(joint, mag_order, robust=robust)
    return joint, aside


def _leave_out_disturbed(joint: Joint, ready: Ready) -> tuple[Joint, tuple[Disturbed, ...]]:
    """Return the fit without disturbed attitudes, left out one by one, the worst first, and these attitudes."""
    aside: list[Disturbed] = []
    left = np.arange(len(ready.pair.mag))
    while len(left) > FEWEST and len(aside) < len(ready.pair.mag) // _MOST_ASIDE:
        worst = find_most_disturbed(joint)
        if worst.probability >= FIELD_SET_ASIDE.level:
            break
        without = np.delete(left, worst.index)
        fewer = ready.pair.only(without)
        if judge_observability(fewer, joint.theta).rank < joint.pair.layout.mag + 1:
            break
        aside.append(replace(worst, index=int(left[worst.index])))
        left, joint = without, solve(fewer, joint.theta)
    return joint, tuple(aside)


def _fit_order_two(joint: Joint, asked: str, *, robust: bool) -> Joint:
    """Return the fit with quadratic terms; with ``auto`` only if it predicts better and the gain is significant."""
    pair = replace(joint.pair, mag_order=2)
    at = joint.pair.layout.dip_at
    second = solve(pair, np.insert(joint.theta, [at] * 3, 0.0), robust=robust)
    if asked == "2":
        return second
    linear_errors, quadratic_errors = leave_one_out(joint), leave_one_out(second)
    better = quadratic_errors.rms(1) * quadratic_errors.rms(2) < _GAIN * linear_errors.rms(1) * linear_errors.rms(2)
    cost = [
        float(np.einsum("ni,nij,nj->", fit.found.residuals, joint.information, fit.found.residuals))
        for fit in (joint, second)
    ]
    size = len(joint.theta)
    p = f_test(cost[0], size, cost[1], size + 3, joint.found.residuals.size)
    return second if better and p < FIELD_ORDER_TWO.level else joint


def _check_result(joint: Joint, ready: Ready, place: Place) -> None:
    """Refuse a fit that diverged, or whose dip is vertical, of the other hemisphere, or far off the stated one."""
    name = ready.estimate.attitudes.recording.name
    if not joint.converged and not np.isfinite(joint.theta).all():
        raise DataError(f"{name}: the fit of both triads does not converge on these attitudes")
    at, hemisphere = joint.pair.layout.dip_at, place.hemisphere
    dip = float(joint.theta[at])
    if abs(dip) > _STEEPEST:
        raise DataError(
            f"{name}: the field is vertical to {90 - abs(np.degrees(dip)):.1f} deg (dip {np.degrees(dip):+.1f} deg): "
            "headings cannot be told, and the alignment about the vertical is blind"
        )
    if hemisphere is not None and (dip > 0) != (hemisphere == "north"):
        fitted_side = "south" if hemisphere == "north" else "north"
        raise DataError(
            f"{name}: the dip is {np.degrees(dip):+.1f} deg, that of the {fitted_side}ern hemisphere: an odd number of "
            "magnetometer axes is reversed, or the accelerometers read minus the specific force (gravity): change the "
            "signs of the three accelerometer columns, or of one or three magnetometer columns"
        )
    if place.dip is None:
        return
    stated, uncertainty = place.dip
    sigma = float(np.hypot(np.sqrt(joint.covariance[at, at]), uncertainty))
    if abs(dip - stated) > max(_CONTRADICTS * sigma, _OFF):
        raise DataError(
            f"{name}: the dip is {np.degrees(dip):.2f} deg, {np.degrees(stated):.2f} deg was stated: they differ by "
            f"{abs(dip - stated) / sigma:.0f} standard uncertainties: is iron near, do both triads belong to the same "
            "attitudes, or is the stated dip of another place? Without it the dip of this place is found and used"
        )
