"""The magnetometer triad from what people have: data to a record of the accelerometers and magnetometers together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np

from imulab.errors import DataError, OptionError, listed, quoted
from imulab.estimation.least_squares import f_test
from imulab.gravity import Gravity, at_place
from imulab.procedures.inputs import Record, as_record
from imulab.procedures.result import Result
from imulab.procedures.tumble.choices import LOSSES, MAG_ORDERS
from imulab.procedures.tumble.given import TumbleData, as_attitudes
from imulab.procedures.tumble.gyrorecord import with_gyro_of
from imulab.procedures.tumble.mag.field import FEWEST
from imulab.procedures.tumble.mag.judge import FALSE_ALARM, Disturbed, Seen, leave_one_out, most_disturbed, seen
from imulab.procedures.tumble.mag.prepare import check_seen, prepare
from imulab.procedures.tumble.mag.record import with_mag
from imulab.procedures.tumble.mag.scaling import Ready
from imulab.procedures.tumble.mag.solve import Joint, solve
from imulab.procedures.tumble.mag.stated import Place, stated_place
from imulab.procedures.tumble.options import check_field
from imulab.quantities import in_si
from imulab.reading import Reading
from imulab.records.calibration import Calibration

_STEEPEST = np.radians(87.0)
_OFF = np.radians(0.5)
_CONTRADICTS = 4.0
"""Standard uncertainties, and rad, beyond which a stated dip is refused."""
_GAIN = 0.9
_SIGNIFICANT = 0.01
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
        What the attitudes determine.
    set_aside
        Attitudes that were left out, from 0, with how they miss the others.

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
    dip: float | str | tuple[float, float] | None = None,
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
        is prior knowledge. Gyroscopes that it holds are kept.
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
        ``north`` or ``south``, to check the sign of the dip; by the latitude, where that is given, beyond 20 deg.
    dip
        Of the place, rad, with its standard uncertainty, ``(1.17, 0.003)``, or a text, ``"67.2+-0.2 deg"``; without one
        that of a model of the Earth's field, 0.2 deg. It is compared with the dip that is found, and not used in the
        fit.
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
    place = stated_place(hemisphere, latitude, dip)
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
        if same_direction and not what.enough:  # it was where the fit began
            raise np.linalg.LinAlgError
    except np.linalg.LinAlgError:
        raise DataError(
            f"{name}: the fit of both triads finds no solution: are both of the same attitudes, by one clock"
            f"{', and does one axis point the same way in those of same-direction' if same_direction else ''}?"
        ) from None
    check_seen(what, np.delete(ready.kept, [one.index for one in aside]), name)
    _check_result(joint, ready, place)
    options = {
        "loss": loss, "mag_order": mag_order if mag_order == "auto" else int(mag_order),
        "field": magnitude, "hemisphere": place.hemisphere, "dip": place.dip and list(place.dip),
        "drop": list(map(str, drop)),
        "same_direction": [group if isinstance(group, str) else list(group) for group in same_direction],
    }  # fmt: skip
    given = {name: value for name, value in options.items() if value not in (None, [])}
    record = with_mag(ready, joint, what, aside, given)
    if known is not None and not ready.notes:
        record = with_gyro_of(record, known)
    return MagFit(record, joint, what, aside)


def _check_options(loss: str, mag_order: int | str, order: int | str, field: float | None) -> None:
    for name, value, choices in (("loss", loss, LOSSES), ("mag-order", str(mag_order), MAG_ORDERS)):
        if value not in choices:
            raise OptionError(f"{name} {quoted(value)}: expected one of {listed(choices, str(value))}")
    if str(order) not in ("auto", "1", "2", "3", "4", "5"):
        raise OptionError(f"order {quoted(order)}: expected auto or 1 to 5")
    check_field(field)


def _solved(ready: Ready, loss: str, mag_order: str) -> tuple[Joint, tuple[Disturbed, ...]]:
    """Fit both triads, leave disturbed attitudes out, and take the order that is asked for."""
    robust = loss == "huber"
    joint, aside = solve(ready.pair, ready.start, robust=robust), tuple[Disturbed, ...]()
    if loss == "auto":
        joint, aside = _set_aside(joint, ready)
    if mag_order != "1":
        joint = _order_two(joint, mag_order, robust=robust)
    return joint, aside


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


def _check_result(joint: Joint, ready: Ready, place: Place) -> None:
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
        found = "south" if hemisphere == "north" else "north"
        raise DataError(
            f"{name}: the dip is {np.degrees(dip):+.1f} deg, that of the {found}ern hemisphere: an odd number of "
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
