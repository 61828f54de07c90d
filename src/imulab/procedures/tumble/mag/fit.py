"""The magnetometer triad from what people have: data to a record of the accelerometers and magnetometers together."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError, ObservabilityError, OptionError, RecordError, listed, quoted
from imulab.estimation.least_squares import chi_square_probability, f_test
from imulab.gravity import Gravity, at_place, local_gravity
from imulab.procedures.inputs import Reading, Record, as_record
from imulab.procedures.result import Result
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.checks import check_attitudes, check_prior, made_from
from imulab.procedures.tumble.choices import HEMISPHERES, LOSSES, MAG_ORDERS
from imulab.procedures.tumble.findings import Estimate
from imulab.procedures.tumble.fit import estimate_triad, nominal_scaling
from imulab.procedures.tumble.given import TumbleData, as_attitudes
from imulab.procedures.tumble.mag.field import FEWEST, FieldMeans, check_magnitude, field_means
from imulab.procedures.tumble.mag.judge import FALSE_ALARM, Disturbed, Seen, leave_one_out, most_disturbed, seen
from imulab.procedures.tumble.mag.model import ACCELEROMETERS, MAGNETOMETERS, triad
from imulab.procedures.tumble.mag.pointing import find_held
from imulab.procedures.tumble.mag.record import with_mag
from imulab.procedures.tumble.mag.scaling import MagScaling, Ready, nominal_mag
from imulab.procedures.tumble.mag.solve import Joint, Pair, solve
from imulab.procedures.tumble.mag.start import find_start
from imulab.procedures.tumble.prior import known_of
from imulab.procedures.tumble.record import Scaling
from imulab.procedures.tumble.sections import model_of
from imulab.quantities import in_si
from imulab.recording import Array
from imulab.records.calibration import Calibration

_STEEPEST = np.radians(87.0)
_GAIN = 0.9
_SIGNIFICANT = 0.01
_MOST_ASIDE = 5
"""At most one attitude of so many is set aside."""
_DISAGREES = 1e-3
_WORST_CONDITION = 30.0
"""Attitudes that all face one way have 45 and more; within 20 deg of one way 7, at any heading 3."""
_FAINTEST, _STRONGEST = 1e-6, 1e-2  # T


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
        What the attitudes determine.
    set_aside
        Attitudes that were left out, from 0, with how they miss the others.
    """

    calibration: Calibration
    joint: Joint
    seen: Seen
    set_aside: tuple[Disturbed, ...]


def fit_mag(
    data: TumbleData,
    *,
    accel: Record | None = None,
    same_direction: Sequence[str | Sequence[int]] = (),
    field: float | str | None = None,
    loss: str = "auto",
    mag_order: int | str = 1,
    drop: Sequence[int | str] = (),
    hemisphere: str | None = None,
    gravity: float | str | Gravity | None = None,
    latitude: float | str | None = None,
    height: float | str | None = None,
    order: int | str = "auto",
    **reading: Unpack[Reading],
) -> MagFit:
    """Calibrate a magnetometer triad, in the accelerometers' frame, from the attitudes of a tumble test.

    ``|m| = F`` and ``m.f = -|m| |f| sin(dip)`` in every attitude, ``M = S (A + b)``, ``A = s (+ k2 s^2)``, ``s = T m``:
    hard iron b, soft iron, scale and mounting in S and T. Both triads are fitted together.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays by name with both triads; without a time each row is an attitude.
    accel
        Tumble record of the accelerometers, or its file: of these data it says how they were fitted; of another test it
        is prior knowledge.
    same_direction
        Groups of attitudes, numbers from 1 or texts such as ``"9-16"``, in which one axis of the body points the same
        way.
    field
        Magnitude of the field, T, or a text such as ``"48.2uT"``; without it the field is the unit, and biases are
        parts of it.
    loss
        ``auto``: attitudes that do not fit the others are set aside and named; ``square``: all count; ``huber``: the
        pull of single ones is limited.
    mag_order
        1, 2 (with quadratic terms), or ``auto``: 2 where it predicts better and the gain is significant.
    drop
        Attitudes to leave out, numbers from 1.
    hemisphere
        ``north`` or ``south``, to check the sign of the dip.
    gravity, latitude, height, order
        As for `fit_tumble`.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window`, `element`.

    Raises
    ------
    ObservabilityError
        The attitudes cannot separate the parameters, as where all face one way; the message says what would help.
    DataError
        The columns are missing, dead, saturated or in another unit; there are too few attitudes.
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
    _check_options(loss, mag_order, order, hemisphere, magnitude)
    attitudes = as_attitudes(data, reading, fit_mag)
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
    name = attitudes.recording.name
    try:
        with np.errstate(all="ignore"):  # what runs away ends in no solution
            joint, aside = _solved(ready, loss, str(mag_order))
            what = seen(joint.pair, joint.theta)
    except np.linalg.LinAlgError:
        raise DataError(
            f"{name}: the fit of both triads finds no solution: are both of the same attitudes, by one clock"
            f"{', and does one axis point the same way in those of same-direction' if same_direction else ''}?"
        ) from None
    _check_seen(what, np.delete(ready.kept, [one.index for one in aside]), name)
    _check_result(joint, ready, hemisphere)
    options = {
        "loss": loss, "mag_order": mag_order, "field": magnitude, "hemisphere": hemisphere,
        "drop": list(map(str, drop)),
        "same_direction": [group if isinstance(group, str) else list(group) for group in same_direction],
    }  # fmt: skip
    given = {name: value for name, value in options.items() if value not in (None, [])}
    record = with_mag(ready, joint, what, aside, given)
    return MagFit(record, joint, what, aside)


def _check_options(
    loss: str, mag_order: int | str, order: int | str, hemisphere: str | None, field: float | None
) -> None:
    for name, value, choices in (("loss", loss, LOSSES), ("mag-order", str(mag_order), MAG_ORDERS)):
        if value not in choices:
            raise OptionError(f"{name} {quoted(value)}: expected one of {listed(choices, str(value))}")
    if str(order) not in ("auto", "1", "2", "3", "4", "5"):
        raise OptionError(f"order {quoted(order)}: expected auto or 1 to 5")
    if hemisphere is not None and hemisphere not in HEMISPHERES:
        raise OptionError(f"hemisphere {quoted(hemisphere)}: expected north or south")
    if field is not None and not (isinstance(field, numbers.Real) and _FAINTEST < field < _STRONGEST):
        raise OptionError(
            f"field {quoted(field)}: expected its magnitude in T, such as 48.2e-6 (20e-6 to 70e-6 on Earth)"
        )


def prepare(
    attitudes: Attitudes,
    known: Calibration | None,
    *,
    gravity: float | str | Gravity | None,
    order: int | str,
    field: float | None,
    same_direction: Sequence[str | Sequence[int]],
    drop: Sequence[int | str],
) -> Ready:
    """Fit the accelerometers by themselves, find where the joint fit starts, and refuse what it cannot see."""
    means = field_means(attitudes)
    name, count = attitudes.recording.name, len(attitudes)
    dropped = _numbers(drop, count, "drop")
    kept = np.setdiff1d(np.arange(count), dropped)
    groups = [_numbers(group, count, "same-direction") for group in same_direction]
    if known is not None:
        check_prior(known)
    local = local_gravity(_gravity(gravity, known), attitudes.recording)
    if known is not None:
        if str(order) not in ("auto", str(model_of(known).order)):
            raise OptionError(f"order {order} with a record of order {model_of(known).order}: expected that or auto")
        order = model_of(known).order
    order = order if order == "auto" else int(order)
    used = attitudes.only(kept) if dropped.size else attitudes
    check_attitudes(used, local.value)
    scaling = nominal_scaling(used, local.value)
    estimate = estimate_triad(used, local, scaling, order, "auto")
    kept = kept[estimate.found.aside.others(len(kept))] if estimate.found.aside.index else kept
    if len(kept) < FEWEST:
        raise DataError(f"{name}: {len(kept)} attitudes are left; a magnetometer needs {FEWEST} or more")
    prior, notes = _prior(known, attitudes, estimate, scaling, local)
    theta = estimate.solution.theta[0]
    force = triad(theta, estimate.problem.reading[0], ACCELEROMETERS).vector
    begin = find_start(means.mean[kept], force / np.linalg.norm(force, axis=1)[:, None])
    mag, first = nominal_mag(begin, field)
    check_magnitude(mag.size, means.unit, name, field)
    pair, start = _pair(estimate, means, kept, mag, prior), np.concatenate([first, [begin.dip], theta])
    if groups:
        places = [np.flatnonzero(np.isin(kept, group)).tolist() for group in groups]
        _check_groups(places, name)
        held, more = find_held(triad(first, pair.mag, MAGNETOMETERS).vector, force, places)
        pair, start = replace(pair, held=held), np.concatenate([start, more])
    try:
        _check_seen(seen(pair, start), kept, name)
    except np.linalg.LinAlgError:
        raise DataError(f"{name}: the attitudes determine no field: are both triads of the same attitudes?") from None
    return Ready(estimate, scaling, local, means, kept, mag, pair, start, notes)


def _numbers(given: str | Sequence[int | str], count: int, option: str) -> NDArray[np.intp]:
    """Attitudes by their numbers from 1, or texts such as ``"8"``, ``"9-16"``, ``"3,9-16"``, as places from 0."""
    found: list[int] = []
    for entry in [given] if isinstance(given, str) else given:
        for part in str(entry).split(","):
            first, dash, last = part.strip().partition("-")
            ends = (first, last if dash else first)
            if not all(end.strip().isdecimal() and 1 <= int(end) <= count for end in ends) or int(ends[0]) > int(
                ends[1]
            ):
                raise OptionError(
                    f"{option} {quoted(entry)}: expected the number of an attitude, 1 to {count}, or a range as 9-16"
                )
            found += range(int(ends[0]) - 1, int(ends[1]))
    return np.unique(np.array(found, dtype=np.intp))


def _check_groups(places: Sequence[Sequence[int]], name: str) -> None:
    """Refuse groups of attitudes from which no direction can be told."""
    every = [place for group in places for place in group]
    if len(set(every)) < len(every):
        raise OptionError(f"same-direction: an attitude of {name} is in two groups; expected each in one")
    if any(len(group) < 2 for group in places) or 2 * len(every) <= 2 + 2 * len(places):
        raise OptionError(
            "same-direction: too few attitudes in the groups to tell a direction from; expected three or more of one "
            "group"
        )


def _solved(ready: Ready, loss: str, mag_order: str) -> tuple[Joint, tuple[Disturbed, ...]]:
    """Fit both triads, leave disturbed attitudes out, and take the order that is asked for."""
    robust = loss == "huber"
    joint, aside = solve(ready.pair, ready.start, robust=robust), tuple[Disturbed, ...]()
    if loss == "auto":
        joint, aside = _set_aside(joint, ready)
    if mag_order != "1":
        joint = _order_two(joint, mag_order, robust=robust)
    return joint, aside


def _gravity(given: float | str | Gravity | None, known: Calibration | None) -> float | str | Gravity | None:
    """Gravity as given, else that of the accelerometers' record."""
    if given is not None or known is None:
        return given
    stated = model_of(known).gravity
    return Gravity(stated.value, stated.from_, stated.standard_uncertainty or 0.0)


def _prior(
    known: Calibration | None, attitudes: Attitudes, estimate: Estimate, scaling: Scaling, local: Gravity
) -> tuple[tuple[Array, Array] | None, list[str]]:
    """Mean and rows of a record of another test as prior knowledge, unless these attitudes contradict it."""
    if known is None or made_from(known, attitudes.recording):
        return None, []
    if model_of(known).output_unit != attitudes.unit:
        raise RecordError(
            f"accel: a record of outputs in {model_of(known).output_unit}, {attitudes.recording.name} has them in "
            f"{attitudes.unit}"
        )
    held = known_of(known, scaling, local, attitudes.unit)
    own = estimate.given_order or estimate.stated
    if own is not None:
        off = estimate.solution.theta[0] - held.mean
        distance = float(off @ np.linalg.solve(own.covariance + held.covariance, off))
        p = chi_square_probability(distance, len(off))
        if p < _DISAGREES:
            return None, [
                f"mag: the accelerometers of {attitudes.recording.name} contradict their record (p = {p:.2g}): it was "
                "not used; they were calibrated anew from these attitudes"
            ]
    return (held.mean, np.linalg.inv(np.linalg.cholesky(held.covariance))), []


def _pair(
    estimate: Estimate, means: FieldMeans, kept: NDArray[np.intp], mag: MagScaling, prior: tuple[Array, Array] | None
) -> Pair:
    """Both triads' scaled outputs, with what is known of their noise."""
    problem, solution = estimate.problem, estimate.solution
    n, size = problem.reading.shape[1], solution.theta.shape[1]
    variance, freedom = solution.variance[0], float(solution.freedom[0])
    if problem.covariance is None:
        freedom = float(n - size)
        variance = np.full(n, float((solution.residuals[0] ** 2).sum()) / max(freedom, 1.0))
    noise = None
    if problem.covariance is not None and means.covariance is not None:
        noise = np.zeros((n, 6, 6))
        noise[:, :3, :3], noise[:, 3:, 3:] = problem.covariance[0], mag.covariance(means.covariance[kept])
    return Pair(
        problem.reading[0],
        mag.outputs(means.mean[kept]),
        noise,
        variance,
        solution.lengthening[0],
        freedom,
        size,
        prior,
    )


def _set_aside(joint: Joint, ready: Ready) -> tuple[Joint, tuple[Disturbed, ...]]:
    """Leave out the attitude that fits the others worst, and solve again, as long as one is disturbed."""
    aside: list[Disturbed] = []
    left = np.arange(len(ready.pair.mag))
    while len(left) > FEWEST and len(aside) < len(ready.pair.mag) // _MOST_ASIDE:
        worst = most_disturbed(joint)
        if worst.probability >= FALSE_ALARM:
            break
        without = np.delete(left, worst.index)
        fewer = ready.pair.only(without)
        if seen(fewer, joint.theta).rank < joint.pair.layout.mag + 1:
            break
        aside.append(replace(worst, index=int(left[worst.index])))
        left, joint = without, solve(fewer, joint.theta)
    return joint, tuple(aside)


def _order_two(joint: Joint, asked: str, *, robust: bool) -> Joint:
    """Fit quadratic terms too; with ``auto`` keep them where they predict better and the gain is significant."""
    pair = replace(joint.pair, mag_order=2)
    at = joint.pair.layout.dip_at
    second = solve(pair, np.insert(joint.theta, [at] * 3, 0.0), robust=robust)
    if asked == "2":
        return second
    one, two = leave_one_out(joint), leave_one_out(second)
    better = two.rms(1) * two.rms(2) < _GAIN * one.rms(1) * one.rms(2)
    cost = [
        float(np.einsum("ni,nij,nj->", of.found.residuals, joint.information, of.found.residuals))
        for of in (joint, second)
    ]
    size = len(joint.theta)
    p = f_test(cost[0], size, cost[1], size + 3, joint.found.residuals.size)
    return second if better and p < _SIGNIFICANT else joint


def _check_seen(what: Seen, kept: NDArray[np.intp], name: str) -> None:
    """Refuse attitudes that leave something blind, and say what would help."""
    if what.rank == what.size and what.condition < _WORST_CONDITION:
        return
    blind = " and ".join(f"({', '.join(f'{part:+.2f}' for part in axis)})" for axis in what.blind)
    cannot = (
        f": a rotation of the magnetometers about the body axis {blind} changes neither |m| nor the dip"
        if blind
        else ""
    )
    which = " ".join(str(int(kept[i]) + 1) for i in sorted(what.heading))
    raise ObservabilityError(
        f"{name}: {len(kept)} attitudes determine {what.rank} of {what.size} combinations of "
        f"the magnetometers' parameters and the dip{cannot}; turn the heading between attitudes: attitudes {which} "
        "once more with the unit facing a quarter turn away would help most"
    )


def _check_result(joint: Joint, ready: Ready, hemisphere: str | None) -> None:
    name = ready.estimate.attitudes.recording.name
    if not joint.converged and not np.isfinite(joint.theta).all():
        raise DataError(f"{name}: the fit of both triads does not converge on these attitudes")
    dip = float(joint.theta[joint.pair.layout.dip_at])
    if abs(dip) > _STEEPEST:
        raise DataError(
            f"{name}: the field is vertical to {90 - abs(np.degrees(dip)):.1f} deg (dip {np.degrees(dip):+.1f} deg): "
            "headings cannot be told, and the alignment about the vertical is blind"
        )
    if hemisphere is not None and (dip > 0) != (hemisphere == "north"):
        found = "south" if hemisphere == "north" else "north"
        raise DataError(
            f"{name}: the dip is {np.degrees(dip):+.1f} deg, that of the {found}ern hemisphere: an odd number of "
            "magnetometer axes is reversed, or the accelerometers read minus the specific force (gravity): change the "
            "signs of the three accelerometer columns, or of one or three magnetometer columns"
        )
