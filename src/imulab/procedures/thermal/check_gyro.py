"""The test of gyroscopes against a record over temperature: their outputs at rest under the record's laws."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.display import Finding, Note
from imulab.errors import DataError, OptionError, UnitError
from imulab.gravity import EarthRate
from imulab.procedures.thermal.agreement import within_and_between
from imulab.procedures.thermal.figures import axis_groups
from imulab.procedures.thermal.gyro import RatesAtRest, leave_out_turns, linearise_rates, note_turns, rates_at_rest
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.model import AXES
from imulab.procedures.thermal.ramp import slow_noise
from imulab.procedures.thermal.record import names_and_units, predict_gyro_scale
from imulab.procedures.thermal.schema import gyros_of, is_ramp
from imulab.procedures.thermal.solve import row_covariance
from imulab.quantities import in_si
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.traces import Figure, figure_axis, points
from imulab.units import from_si, parse_unit, to_si

_BEYOND_RANGE = 2.0  # standard uncertainties from which a residual is drawn as beyond them
_BEYOND = 1.0  # K outside the record's range, up to which its laws are taken to hold
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
        Index of each tested hold among those of the check, shape (n,).
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
        """Index of the tested hold, and axis, whose output is farthest off."""
        row, axis = np.unravel_index(int(np.argmax(np.abs(self.residuals))), self.residuals.shape)
        return int(row), int(axis)


def check_gyros(
    record: Calibration,
    holds: Holds,
    force: Array,
    turn_on_scatter: float | str | None,
    earth: EarthRate | None = None,
) -> tuple[GyroCheck | None, list[str]]:
    """Return the test of the outputs at rest under specific forces in g, shape (n, 3), and its notes.

    None where the record or the recordings have no gyroscopes.

    Raises
    ------
    UnitError
        The gyroscopes are in another unit than those of the record.
    OptionError
        The scatter is below 0.
    """
    model = gyros_of(record).model
    if model.gyro is None:
        return None, []
    lacking = [recording.name for recording in holds.recordings if any(name not in recording for name in triad("gyro"))]
    if lacking or any(recording.time is None for recording in holds.recordings):
        which = (
            lacking[0] if lacking else next(recording.name for recording in holds.recordings if recording.time is None)
        )
        return None, [
            Note(f"{which}: no columns gyro_x gyro_y gyro_z over time, so the record's gyroscopes are not tested")
        ]
    tau, rank = _gyro_scatter(record, turn_on_scatter)
    fit = gyros_of(record).fit.gyro
    assert fit is not None
    # Without a latitude the record's g-sensitivities hold the vertical part, which must not be subtracted twice.
    known = earth if fit.latitude is not None or not model.gyro.g_sensitivity else None
    laws = model.gyro_laws
    try:
        held, aside = leave_out_turns(replace(_rates_by_record(record, holds, force), earth=known), laws)
    except DataError as error:  # faulty gyroscopes do not keep accelerometers from being tested
        return None, [Finding(f"gyroscopes not tested: {error}", "check the columns gyro_x gyro_y gyro_z")]
    ramp = is_ramp(record)
    if ramp:
        held = replace(held, slow=slow_noise(holds, held.mean, held.index))
    names, _ = names_and_units(laws, sensitivity=model.gyro.g_sensitivity)
    size = 3 * laws.terms[0]
    factor = np.eye(len(names)) / (1.0 if ramp else record.model["gravity"]["value"])
    factor[:size, :size] = laws.to_powers()[:size, :size]
    inverse = np.linalg.inv(factor)
    coefficients = inverse @ np.array([record.value(name) for name in names])
    covariance = inverse @ record.cov(*names) @ inverse.T
    rows = linearise_rates(held, laws, coefficients, ())
    excess = fit.excess.value**2
    noise = row_covariance(rows, excess, np.zeros(2))
    whole = row_covariance(rows, excess, np.array([tau or 0.0, 0.0])) + rows.jacobian @ covariance @ rows.jacobian.T
    within, between = within_and_between(rows, whole, noise, np.zeros((len(whole), 0)), rank, by_share=False)
    residual, u = (each.reshape(-1, 3) for each in (rows.residual, np.sqrt(np.diag(whole))))
    notes = [*held.notes, *note_turns(holds, aside), *([_UNSAID] if tau is None else [])]
    return GyroCheck(held.index, residual, u, within, between), notes


def _rates_by_record(record: Calibration, holds: Holds, force: Array) -> RatesAtRest:
    """Return the rates at rest by the record's scale factors at each temperature."""
    gyro = gyros_of(record).model.gyro
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
    nominal = predict_gyro_scale(record, middle)[0][:, 0]
    size = to_si(nominal, gyro.output_unit) if of_rate else nominal
    held = rates_at_rest(holds, force, size)
    part = (nominal[:, None] / predict_gyro_scale(record, held.temperature)[0]).T
    covariance = held.covariance * part[:, :, None] * part[:, None, :]
    return replace(held, mean=held.mean * part, covariance=covariance)


def _gyro_scatter(record: Calibration, stated: float | str | None) -> tuple[float | None, int | None]:
    """Return the scatter of biases between power cycles, rad/s, and the rank of its estimate; None where unknown."""
    if stated is not None:
        tau = in_si(stated, "gyro_turn_on_scatter", "rate", "deg/s")
        if not 0 <= tau < np.inf:
            raise OptionError(f"gyro_turn_on_scatter {stated!r}: expected 0 or more")
        return tau, 0
    fit = gyros_of(record).fit.gyro
    assert fit is not None
    between = fit.between_recordings
    if between.from_ == "unknown":
        return None, None
    least = 0.0 if between.resolution is None else between.resolution.value
    return float(np.hypot(between.bias.value, least)), between.rank


def gyro_figure(holds: Holds, gyro: GyroCheck) -> Figure:
    """Return law less output of each hold and axis over temperature."""
    residual, reach = from_si(gyro.residuals, "deg/h"), _BEYOND_RANGE * from_si(gyro.standard_uncertainty, "deg/h")
    return points(
        "The gyroscopes at rest under the record, over temperature",
        "Bars: twice the standard uncertainty, from laws, power cycle, temperature, Earth's rate and noise.",
        ("temperature, degC", np.repeat(holds.temperature[gyro.holds], len(AXES))),
        (figure_axis("law less output, deg/h", zeroline=True), residual.ravel()),
        reach.ravel(),
        axis_groups(len(residual)),
        size=7,
        message=f"{int((np.abs(residual) > reach).sum())} of {residual.size} outputs lie beyond twice the standard "
        "uncertainty.",
    )


def select_in_range(record: Calibration, holds: Holds) -> tuple[Holds, list[str]]:
    """Return the holds within the record's range of temperature, and a note on the others.

    Raises
    ------
    DataError
        None is.
    """
    low, high = record.model["range"]
    kept = (holds.temperature >= low - _BEYOND) & (holds.temperature <= high + _BEYOND)
    out = holds.temperature[~kept]
    if not out.size:
        return holds, []
    where = f"{out.min():.1f} to {out.max():.1f} degC" if np.ptp(out) > 0.1 else f"{out.mean():.1f} degC"
    if not kept.any():
        raise DataError(
            f"{holds.recordings[0].name}: all holds are at {where}, outside the {low:.1f} to {high:.1f} degC of the "
            "record, which says nothing there"
        )
    columns = ("mean", "covariance", "temperature", "rate", "step", "shared", "recording", "group", "start", "stop")
    chosen = {name: getattr(holds, name)[kept] for name in columns}
    group = chosen["group"]
    chosen["wander"] = holds.wander[np.ix_(kept, kept)]
    chosen["group"] = np.where(group >= 0, np.searchsorted(np.unique(group[group >= 0]), group), -1)
    note = Finding(
        f"{(~kept).sum()} of {len(kept)} holds are at {where}, outside the {low:.1f} to {high:.1f} degC of the record, "
        "which says nothing there: not tested",
        "record holds within the range of the record",
    )
    return replace(holds, **chosen), [note]
