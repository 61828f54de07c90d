"""The gyroscopes of new recordings against a record over temperature: their outputs at rest under its laws."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.earth import EarthRate
from imulab.errors import DataError, OptionError, UnitError
from imulab.procedures.thermal.gyro import notes_on_turns, rows_of, without_turns
from imulab.procedures.thermal.gyroholds import RatesAtRest, rates_at_rest
from imulab.procedures.thermal.gyrorecord import gyro_scale_predicted, names_and_units
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.parted import parted
from imulab.procedures.thermal.rows import together
from imulab.procedures.thermal.sections import thermal_of
from imulab.quantities import in_si
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import parse_unit, to_si
from imulab.verdict import Note

_UNSAID = (
    "the record does not say how far the gyroscopes' biases move from one power cycle to the next, so an offset that a "
    "whole recording has in common is not tested: state --gyro-turn-on-scatter"
)


@dataclass(frozen=True)
class GyroCheck:
    """How well the gyroscopes' laws still hold.

    Attributes
    ----------
    holds
        Place of each tested hold among those of the check, shape (n,).
    residuals, standard_uncertainty
        Law less output of each hold and axis, rad/s, shape (n, 3).
    within, between
        Probabilities as in `ThermalCheck`.
    """

    holds: NDArray[np.int64]
    residuals: Array
    standard_uncertainty: Array
    within: float | None
    between: float | None

    @property
    def worst(self) -> tuple[int, int]:
        """Hold, of those tested, and axis whose output is farthest off."""
        row, axis = np.unravel_index(int(np.argmax(np.abs(self.residuals))), self.residuals.shape)
        return int(row), int(axis)


def check_gyros(
    record: Calibration,
    holds: Holds,
    force: Array,
    turn_on_scatter: float | str | None,
    earth: EarthRate | None = None,
) -> tuple[GyroCheck | None, list[str]]:
    """Test the outputs at rest under specific forces in g, shape (n, 3); return what is found, and what is to be said.

    Raises
    ------
    UnitError
        The gyroscopes are in another unit than those of the record.
    OptionError
        The scatter is below 0.
    """
    model = thermal_of(record).model
    if model.gyro is None:
        return None, []
    lacking = [one.name for one in holds.recordings if any(name not in one for name in triad("gyro"))]
    if lacking or any(one.time is None for one in holds.recordings):
        which = lacking[0] if lacking else next(one.name for one in holds.recordings if one.time is None)
        return None, [
            Note(f"{which}: no columns gyro_x gyro_y gyro_z over time, so the record's gyroscopes are not tested")
        ]
    tau, rank = _scatter(record, turn_on_scatter)
    fit = thermal_of(record).fit.gyro
    assert fit is not None
    # In a record without a latitude the vertical part is in the g-sensitivities: taken off, it would count twice.
    known = earth if fit.latitude is not None or not model.gyro.g_sensitivity else None
    laws = model.gyro_laws
    try:
        held, aside = without_turns(replace(_rates(record, holds, force), earth=known), laws)
    except DataError as error:  # faulty columns of gyroscopes say nothing against the accelerometers
        return None, [f"gyroscopes not tested: {error}"]
    names, _ = names_and_units(laws, sensitivity=model.gyro.g_sensitivity)
    size = 3 * laws.terms[0]
    factor = np.eye(len(names)) / model.gravity.value
    factor[:size, :size] = laws.to_powers()[:size, :size]
    inverse = np.linalg.inv(factor)
    coefficients = inverse @ np.array([record.value(name) for name in names])
    covariance = inverse @ record.cov(*names) @ inverse.T
    rows = rows_of(held, laws, coefficients, ())
    excess = fit.excess.value**2
    noise = together(rows, excess, np.zeros(2))
    whole = together(rows, excess, np.array([tau or 0.0, 0.0])) + rows.jacobian @ covariance @ rows.jacobian.T
    within, between = parted(rows, whole, noise, np.zeros((len(whole), 0)), rank, by_share=False)
    residual, u = (each.reshape(-1, 3) for each in (rows.residual, np.sqrt(np.diag(whole))))
    notes = [*held.notes, *notes_on_turns(holds, aside), *([_UNSAID] if tau is None else [])]
    return GyroCheck(held.index, residual, u, within, between), notes


def _rates(record: Calibration, holds: Holds, force: Array) -> RatesAtRest:
    """Return the outputs at rest by the record's scale factors at each temperature."""
    gyro = thermal_of(record).model.gyro
    assert gyro is not None
    of_rate = parse_unit(gyro.output_unit).quantity == "rate"
    for recording in holds.recordings:
        unit = recording.triad_unit("gyro")
        if unit != gyro.output_unit and not (of_rate and parse_unit(unit).quantity == "rate"):
            raise UnitError(
                f"{recording.name}: columns gyro_x gyro_y gyro_z are in {unit}, but the record calibrates outputs in "
                f"{gyro.output_unit}"
            )
    if gyro.scale == "nominal":
        return rates_at_rest(holds, force, np.ones(3))
    middle = np.array([record.model["reference_temperature"]["value"]])
    nominal = gyro_scale_predicted(record, middle)[0][:, 0]
    size = to_si(nominal, gyro.output_unit) if of_rate else nominal
    held = rates_at_rest(holds, force, size)
    part = (nominal[:, None] / gyro_scale_predicted(record, held.temperature)[0]).T
    covariance = held.covariance * part[:, :, None] * part[:, None, :]
    return replace(held, mean=held.mean * part, covariance=covariance)


def _scatter(record: Calibration, given: float | str | None) -> tuple[float | None, int | None]:
    """Return the scatter of biases between power cycles, rad/s, and the rank of what told it; None where unknown."""
    if given is not None:
        tau = in_si(given, "gyro_turn_on_scatter", "rate", "deg/s")
        if not 0 <= tau < np.inf:
            raise OptionError(f"gyro_turn_on_scatter {given!r}: expected 0 or more")
        return tau, 0
    fit = thermal_of(record).fit.gyro
    assert fit is not None
    between = fit.between_recordings
    if between.from_ == "unknown":
        return None, None
    least = 0.0 if between.resolution is None else between.resolution.value
    return float(np.hypot(between.bias.value, least)), between.rank
