"""The fit of a magnetometer triad alone, from data to the record; the mathematics is in `solve`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Unpack

import numpy as np

from imulab.display import UNJUDGED
from imulab.errors import DataError, ObservabilityError, OptionError
from imulab.estimation.decisions import HARD_IRON_STEP, OUTPUTS_BEND
from imulab.gravity import ModelField, Site, check_field_magnitude, field_note, field_of_test, site, stated_site
from imulab.options import Group, measure, parsed, text
from imulab.procedures.magnetometer import AXES, FEWEST, name_columns
from imulab.procedures.magnetometer.model import FittedTurn, MagReadings, check_dead, read_readings
from imulab.procedures.magnetometer.record import make_record
from imulab.procedures.magnetometer.solve import (
    BLOCKS,
    LEAST_IN_BLOCK,
    find_bend,
    find_change,
    find_disturbed,
    fit_sphere,
    uncertainties,
    widest_gap,
)
from imulab.procedures.result import Result, as_recording
from imulab.quantities import in_si
from imulab.recording import Array, Data, Reading, Recording
from imulab.records.calibration import Calibration
from imulab.records.sections import FieldPlace, entries

_WORST_MAGNITUDE, _WORST_CONDITION = 0.05, 200.0
"""Standard uncertainty of |m| in the direction where it is largest, as a part of the field, and condition number, up to
which all parameters count as determined."""
_FLAT, _OBLIQUE, _RAGGED = 0.35, 0.87, 0.15
"""Spread across the plane of a level turn over that along it, least cosine between its normal and an axis, and largest
scatter of the level field, as a part of it."""


@dataclass(frozen=True, repr=False)
class MagnetometerFit(Result):
    """Result of `fit_magnetometer`.

    Attributes
    ----------
    calibration
        The record.
    turned
        The readings, which of them were set aside, and the surface that was fitted.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_magnetometer(il.simulate_magnetometer(turn="level"))
    >>> fit.turned.upright
    'z'
    """

    calibration: Calibration
    turned: FittedTurn


def fit_magnetometer(
    data: Data,
    *,
    field: Annotated[float | str | None, measure("magnetic field", "uT", "48.2uT")] = None,
    place: Annotated[str | Site | None, parsed(site, "LAT,LON[,HEIGHT]", unit="deg, m"), Group("gravity")] = None,
    date: Annotated[str | None, text("YYYY-MM-DD"), Group("gravity")] = None,
    **reading: Unpack[Reading],
) -> MagnetometerFit:
    """Calibrate a magnetometer triad alone, from readings waved through all directions, or of a level turn.

    ``M = D m + h``, ``|m| = F``: hard iron h and symmetric soft iron D, nine parameters. A rotation between the
    magnetometers and the body is not told. A level turn tells an ellipse: two offsets, their ratio and its angle.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays by name with ``mag_x mag_y mag_z``; without a time each row is a
        reading.
    field
        Magnitude of the local field; without it that of the outputs. In T, or a text such as ``"48.2uT"``; outputs in
        counts or volts are then in units of the field.
    place
        Where the test was made: gives the field, and of a level turn its level part. By the World Magnetic Model on the
        date; a text such as ``"48.1,11.6,520"``.
    date
        Day of the test, for the field of the place; else that in the head of the recording.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window`, `element`.

    Raises
    ------
    ObservabilityError
        The directions determine neither all parameters nor those of a level turn; the message says what is missing.
    DataError
        The columns are missing, dead, saturated or in another unit; there are too few readings.
    OptionError
        An option has a value that cannot be.

    Source: Vasconcelos et al., IEEE Trans. Aerosp. Electron. Syst. 47 (2011) 1293.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_magnetometer(il.simulate_magnetometer(field="48 uT"), field="48 uT")
    >>> fit.calibration.model["gauge"]
    'body, rotation not told'
    """
    magnitude = None if field is None else in_si(field, "field", "magnetic field", "uT")
    if magnitude is not None and not 0 < magnitude < 1:
        raise OptionError(f"field {magnitude:g}: expected its magnitude in T, such as 48e-6 (25e-6 to 65e-6 on Earth)")
    where = stated_site(place, date, None, None)
    recording = as_recording(data, reading, fit_magnetometer, name_columns, clock="mag")
    return fit_readings(recording, magnitude, where, date)


def fit_readings(recording: Recording, field: float | None, where: Site | None, date: str | None) -> MagnetometerFit:
    """Calibrate a magnetometer triad; arguments in SI, else as for `fit_magnetometer`."""
    model_field = None if where is None else field_of_test(where, date, recording)
    readings = read_readings(recording)
    turned = _with_unmodelled(_find_surface(readings))
    if turned.upright and field is not None:
        raise OptionError(
            f"field: a level turn sees the level part of the field only, and {recording.name} is one; state the place "
            "and date, or leave it out"
        )
    known, origin = field, "stated"
    if model_field is not None and known is None:
        known = float(model_field.magnitude[0] * (np.cos(model_field.dip[0]) if turned.upright else 1.0))
        origin = "place"
    if turned.upright is None or known is not None:
        check_field_magnitude(turned.surface.gain, readings.unit, recording.name, known)
    options = {
        "field": field,
        "place": None if where is None else [where.latitude, where.longitude, where.height],
        "date": date,
    }
    record = make_record(turned, known, origin, {key: value for key, value in options.items() if value is not None})
    if where is not None and model_field is not None:
        record = _with_place(record, where, model_field)
    return MagnetometerFit(record, turned)


def _with_place(record: Calibration, where: Site, field: ModelField) -> Calibration:
    place = entries(FieldPlace.of(where, field))
    return replace(
        record, model={**record.model, "place": place}, warnings=(*record.warnings, field_note(field)), verdict=UNJUDGED
    )


# All directions, or a level turn.


def _find_surface(readings: MagReadings) -> FittedTurn:
    """Return the fit of all directions, or of a level turn.

    Raises
    ------
    ObservabilityError
        Neither nine parameters nor those of a level turn are determined.
    """
    output, name = readings.output, readings.recording.name
    centred = output - output.mean(axis=0)
    _, spread, directions = np.linalg.svd(centred, full_matrices=False)
    why, scatter = f"{len(output)} readings, fewer than {FEWEST[3]}", 0.0
    if len(output) >= FEWEST[3]:
        try:
            surface, aside = find_disturbed(output, FEWEST[3])
            _, largest, _ = uncertainties(surface)
            if surface.converged and largest <= _WORST_MAGNITUDE and surface.condition <= _WORST_CONDITION:
                return FittedTurn(readings, surface, aside, AXES)
            scatter = surface.sigma / surface.gain
            why = f"in some directions |m| is known to {100 * min(largest, 9.99):.2g} % only"
        except np.linalg.LinAlgError:
            why = "the readings lie on no ellipsoid"
    normal = np.abs(directions[2])
    upright = int(np.argmax(normal))
    turned = _fit_level(readings, AXES[upright]) if spread[2] <= _FLAT * spread[1] else None
    if turned is None:
        check_dead(output, readings.unit, name)
        if scatter > _RAGGED:
            raise DataError(
                f"{name}: no ellipsoid fits the readings: |m| scatters by {100 * scatter:.0f} % of the field; was a "
                "magnet or steel near for a part of them, or are mag_x mag_y mag_z not of one sensor?"
            )
        raise ObservabilityError(
            f"{name}: the readings do not determine hard and soft iron: {why}; {_say_gap(output)}; turn the unit "
            "through all directions, each axis up and down"
        )
    if normal[upright] < _OBLIQUE:
        raise ObservabilityError(
            f"{name}: the readings lie in one plane, oblique to all axes; expected a turn about an axis of the "
            "magnetometers, or readings in all directions"
        )
    if uncertainties(turned.surface)[1] > _WORST_MAGNITUDE:
        raise ObservabilityError(
            f"{name}: the readings lie in one plane, across axis {AXES[upright]}, and determine no ellipse there: "
            f"{_say_turned(turned.output)}; turn the unit once around or more, or through all directions"
        )
    return turned


_POWERS = 2, 3  # of the field; what the square hides counts as far as it is real, without a threshold


def _with_unmodelled(turned: FittedTurn) -> FittedTurn:
    """Return a fit whose uncertainties hold the bends and the change of the hard iron that its residuals tell."""
    surface, output = turned.surface, turned.output[~turned.aside]
    bends, change = {}, None
    if len(output) >= 2 * (len(surface.theta) + len(turned.axes)):
        every = {power: find_bend(surface.theta, output, power) for power in _POWERS}
        bends = {power: bend for power, bend in every.items() if power == 2 or bend.probability < OUTPUTS_BEND.level}
    if len(output) >= LEAST_IN_BLOCK * BLOCKS:
        change = find_change(surface.theta, output)
        change = change if change.probability < HARD_IRON_STEP.level else None
    terms = [*bends.values(), *([change] if change else [])]
    if not terms:
        return turned
    surface = replace(surface, beyond=np.sum([term.covariance for term in terms], axis=0))
    return replace(turned, surface=surface, bends=bends, change=change)


def _fit_level(readings: MagReadings, upright: str) -> FittedTurn | None:
    """Return the fit of a level turn about an axis, None where the readings are on no ellipse."""
    axes = AXES.replace(upright, "")
    output = readings.output[:, [AXES.index(axis) for axis in axes]]
    try:
        surface, aside = find_disturbed(output, FEWEST[2])
    except np.linalg.LinAlgError:
        return None
    turned = FittedTurn(readings, surface, aside, axes)
    scatter = float(np.sqrt(np.mean(turned.residual[~aside] ** 2)))
    return turned if surface.converged and scatter < _RAGGED else None


def _say_gap(output: Array) -> str:
    """Return where readings are missing, about the middle of a sphere."""
    try:
        centre, _ = fit_sphere(output)
    except np.linalg.LinAlgError:
        centre = output.mean(axis=0)
    gap, at = widest_gap(output - centre)
    axis = int(np.argmax(np.abs(at)))
    side = "+" if at[axis] > 0 else "-"
    return f"none is within {np.degrees(gap):.0f} deg of {side}{AXES[axis]}, as far as a sphere tells"


def _say_turned(output: Array) -> str:
    """Return through how large an angle a level turn went."""
    try:
        centre, _ = fit_sphere(output)
    except np.linalg.LinAlgError:
        centre = output.mean(axis=0)
    gap, _ = widest_gap(output - centre)
    return f"the turn leaves out {2 * np.degrees(gap):.0f} of 360 deg"
