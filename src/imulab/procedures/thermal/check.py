"""New recordings against a record over temperature, to test whether it still holds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Unpack

import numpy as np

from imulab.columns import triad
from imulab.earth import at_latitude
from imulab.errors import DataError, OptionError, RecordError, UnitError
from imulab.gravity import Gravity, at_place, local_gravity
from imulab.procedures.inputs import Record, as_record, as_recording
from imulab.procedures.result import Drawn
from imulab.procedures.thermal.checks import check_holds, prepared
from imulab.procedures.thermal.gyrocheck import GyroCheck, check_gyros
from imulab.procedures.thermal.holds import Holds, find_holds
from imulab.procedures.thermal.model import Laws, forces
from imulab.procedures.thermal.parted import parted
from imulab.procedures.thermal.record import of_record
from imulab.procedures.thermal.rows import Problem, linearise, together
from imulab.procedures.thermal.sections import thermal_of
from imulab.quantities import in_si
from imulab.reading import Data, Reading
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.report.elements import Exhibits
from imulab.units import conversion_factor, from_si
from imulab.verdict import Note

FALSE_ALARM = 0.05
_BEYOND = 1.0  # K outside the record's range: its laws say nothing there


@dataclass(frozen=True, repr=False)
class ThermalCheck(Drawn):
    """How well a record over temperature still holds.

    Attributes
    ----------
    holds
        That were tested.
    residuals
        ``|f| - g`` of each under the record, m/s^2, shape (n,).
    standard_uncertainty
        Of each, from the laws, the power cycle, the temperature and the hold's noise, m/s^2, shape (n,).
    within, between
        Probability of so large residuals, did the record hold: of what differs between the holds of a recording, and
        of what all have in common, as an offset of the biases has. None where there is nothing to test.
    gravity
        That was used.
    limit
        Largest ``| |f| - g |`` that passes, m/s^2; None: the test alone decides.
    notes
        What a user must know of the test, a sentence each.
    gyro
        The gyroscopes' outputs at rest under the record's laws; None where the record or the recordings have none.
    """

    holds: Holds
    residuals: Array
    standard_uncertainty: Array
    within: float | None
    between: float | None
    gravity: Gravity
    limit: float | None
    notes: tuple[str, ...]
    gyro: GyroCheck | None = None

    subject: ClassVar[str] = "Thermal check"

    def exhibits(self) -> Exhibits:
        """Return what its report shows."""
        from imulab.procedures.thermal.checkfigures import exhibits_of_check

        return exhibits_of_check(self)

    def __repr__(self) -> str:
        worst = from_si(float(self.residuals[self.worst]), "ug")
        return (
            f"ThermalCheck({'pass' if self.passed else 'fail'}, p = {self.probability:.2g}, {len(self.holds)} holds, "
            f"the farthest off by {worst:.3g} µg)"
        )

    @property
    def probability(self) -> float:
        """Of the least likely of the tests, as one of so many (Bonferroni)."""
        gyro = [] if self.gyro is None else [self.gyro.within, self.gyro.between]
        made: list[float] = [p for p in (self.within, self.between, *gyro) if p is not None]
        return min([1.0, *(len(made) * p for p in made)])

    @property
    def passed(self) -> bool:
        """Whether the tests find no contradiction at 5 %, and every hold is within the limit, if there is one."""
        within = self.limit is None or bool((np.abs(self.residuals) <= self.limit).all())
        return within and self.probability >= FALSE_ALARM

    @property
    def worst(self) -> int:
        """Index of the hold that is farthest off."""
        return int(np.argmax(np.abs(self.residuals)))


def check_thermal(
    record: Record,
    data: Data | Sequence[Data],
    *,
    limit: float | str | None = None,
    gravity: float | str | Gravity | None = None,
    latitude: float | str | None = None,
    height: float | str | None = None,
    tilt: float | str = "0.2 mrad",
    turn_on_scatter: float | str | None = None,
    gyro_turn_on_scatter: float | str | None = None,
    settle: float | str | None = None,
    temperature_column: str | None = None,
    **reading: Unpack[Reading],
) -> ThermalCheck:
    """Test whether new recordings contradict a record over temperature, without refitting.

    ``r' V^-1 r`` with r the residuals ``|f| - g`` under the record and V the covariance from noise, laws, temperature
    and the offsets of a power cycle. It is parted into what all holds of a recording have in common, as an offset of
    the biases (F, since few power cycles told their scatter), and the rest (chi-square); a record that holds fails
    once in twenty tests. The gyroscopes of a record that has them are tested in the same way, by their outputs at rest.

    Parameters
    ----------
    record
        Of procedure thermal, or its file.
    data
        One recording or several, a power cycle each: tumbles, attitudes at any temperature, or rest ramps.
    limit
        Largest ``| |f| - g |`` that passes, m/s^2 or a text such as ``"2 mg"``, beside the test.
    gravity, latitude, height
        Where they were measured, as for `fit_tumble`; else that of the first head, or of the record.
    tilt
        Standard deviation of the direction of a hold in which the temperature drifts, rad.
    turn_on_scatter
        Standard deviation of each bias from one power cycle to the next, m/s^2; that of the record if not given.
    gyro_turn_on_scatter
        The same of the gyroscopes' biases, rad/s.
    settle, temperature_column
        As for `fit_thermal`; the column as in the record's fit if not given.
    reading
        How files are to be understood, as for `fit_thermal`.

    Raises
    ------
    RecordError
        The record is of another procedure.
    DataError, UnitError, OptionError
        As for `fit_thermal`; or all lies outside the record's range of temperature.

    Examples
    --------
    >>> import imulab as il
    >>> recordings = il.simulate_thermal()
    >>> record = il.fit_thermal([recordings[k] for k in (0, 1, 3, 4)], degrees="2,1,0").calibration
    >>> il.check_thermal(record, recordings[2]).residuals.shape
    (12,)
    """
    held = as_record(record, "check_thermal")
    if held.procedure != "thermal":
        raise RecordError(f"a {held.procedure} record cannot be checked over temperature; expected a thermal record")
    largest = None if limit is None else in_si(limit, "limit", "acceleration", "mg")
    if largest is not None and not largest > 0:
        raise OptionError(f"limit {largest:g} m/s^2: expected more than 0")
    single = not isinstance(data, Sequence) or isinstance(data, str | os.PathLike)
    listed: list[Any] = [data] if single else list(data)  # type: ignore[arg-type]
    given = [as_recording(one, reading, check_thermal) for one in listed]
    if not given:
        raise OptionError("check_thermal: data: expected one recording or more, found none")
    column = temperature_column or held.options.get("temperature_column")
    given = prepared(
        [_in_unit_of(held, one) for one in given],
        column if column is not None and all(column in one for one in given) else temperature_column,
        None if settle is None else in_si(settle, "settle", "time", "s"),
        span=0.0,
    )
    has_gyroscopes = thermal_of(held).model.gyro is not None
    if gyro_turn_on_scatter is not None and not has_gyroscopes:
        raise OptionError("gyro_turn_on_scatter: the record holds no gyroscopes (thermal fit --with gyro)")
    earth = at_latitude(latitude) if has_gyroscopes else None
    local = _gravity(held, at_place(gravity, latitude, height, beside=earth is not None), given[0])
    holds, notes = _inside(held, find_holds(given))
    unit = thermal_of(held).model.output_unit
    check_holds(holds, local.value, conversion_factor(unit, "m/s^2") if unit in ("m/s^2", "g", "mg") else None)
    leaning, tau = _sizes(tilt, turn_on_scatter, held, local.value)
    rank = None if tau is None else 0 if turn_on_scatter is not None else thermal_of(held).fit.between_recordings.rank
    tested, force = _tested(held, holds, local, leaning, tau, rank)
    if tau is None:
        notes.append(
            "the record does not say how far biases move from one power cycle to the next, so an offset that a whole "
            "recording has in common is not tested: state --turn-on-scatter"
        )
    gyro, said = check_gyros(held, holds, force, gyro_turn_on_scatter, earth)
    notes += said
    notes += [*([local.note] if local.note else []), *_known(held, given)]
    return ThermalCheck(holds, *tested, local, largest, tuple(notes), gyro)


def _in_unit_of(record: Calibration, recording: Recording) -> Recording:
    unit, own = thermal_of(record).model.output_unit, recording.triad_unit("accel")
    try:
        factor = conversion_factor(own, unit)
    except UnitError:
        raise UnitError(
            f"{recording.name}: columns accel_x accel_y accel_z are in {own}, but the record calibrates outputs "
            f"in {unit}"
        ) from None
    names = triad("accel")
    return recording.with_columns({n: recording.column(n) * factor for n in names}, dict.fromkeys(names, unit))


def _gravity(record: Calibration, given: float | str | Gravity | None, recording: Recording) -> Gravity:
    """Return what was given, else the head's, else that of the record."""
    if given is None and "gravity" not in recording.metadata:
        stated = record.model["gravity"]
        note = f"gravity {stated['value']:.6g} m/s^2 was taken from the record, as if measured at the same place"
        uncertainty = float(stated.get("standard_uncertainty") or 0.0)
        return Gravity(float(stated["value"]), str(stated.get("from", "record")), uncertainty, Note(note))
    return local_gravity(given, recording)


def _sizes(
    tilt: float | str, turn_on_scatter: float | str | None, record: Calibration, gravity: float
) -> tuple[float, float | None]:
    """Return the tilt, rad, and the scatter of biases between power cycles, g; None where nobody says it."""
    leaning = in_si(tilt, "tilt", "angle", "mrad")
    if not 0 < leaning < np.inf:
        raise OptionError(f"tilt {leaning:g}: expected a size above 0")
    between = thermal_of(record).fit.between_recordings
    if turn_on_scatter is None:
        if between.from_ == "unknown":
            return leaning, None
        # An estimate may be 0 by chance: with what it can tell beside it, F with its rank holds the false alarms.
        least = 0.0 if between.resolution is None else between.resolution.value
        return leaning, float(np.hypot(between.bias.value, least)) / gravity
    tau = in_si(turn_on_scatter, "turn_on_scatter", "acceleration", "mg") / gravity
    if not 0 <= tau < np.inf:
        raise OptionError(f"turn_on_scatter {turn_on_scatter!r}: expected 0 or more")
    return leaning, tau


def _inside(record: Calibration, holds: Holds) -> tuple[Holds, list[str]]:
    """Return the holds within the record's range of temperature, and a sentence on what is not.

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
    chosen = {
        name: getattr(holds, name)[kept]
        for name in (
            "mean",
            "covariance",
            "temperature",
            "rate",
            "step",
            "shared",
            "recording",
            "group",
            "start",
            "stop",
        )
    }
    group = chosen["group"]
    chosen["wander"] = holds.wander[np.ix_(kept, kept)]
    chosen["group"] = np.where(group >= 0, np.searchsorted(np.unique(group[group >= 0]), group), -1)
    note = (
        f"{(~kept).sum()} of {len(kept)} holds are at {where}, outside the {low:.1f} to {high:.1f} degC of the record, "
        "which says nothing there: not tested"
    )
    return replace(holds, **chosen), [note]


def _known(record: Calibration, recordings: Sequence[Recording]) -> list[str]:
    sources = {source.sha256 for source in record.sources}
    return [
        f"{each.name}: the record was made from this recording, which says nothing of whether it still holds"
        for each in recordings
        if each.source is not None and each.source.sha256 in sources
    ]


def _tested(
    record: Calibration, holds: Holds, gravity: Gravity, tilt: float, tau: float | None, rank: int | None
) -> tuple[tuple[Array, Array, float | None, float | None], Array]:
    """Return residuals, their uncertainties, m/s^2, and the probabilities of the two tests; and f, g, shape (n, 3)."""
    g, fit = gravity.value, thermal_of(record).fit
    laws, coefficients, covariance, scale, common = of_record(record, g, gravity.standard_uncertainty)
    problem = Problem(
        holds.mean / scale, holds.covariance / (scale[:, None] * scale), holds.temperature, np.zeros(len(holds)),
        holds.step, holds.shared, holds.recording, holds.group, tilt, np.zeros(3), wander=holds.wander,
    )  # fmt: skip
    rows = linearise(problem, laws, coefficients, _directions(problem, laws, coefficients))
    excess = (fit.excess.value / g) ** 2
    of_scale = fit.between_recordings.scale_factor.value
    noise = together(rows, excess, np.zeros(2))
    jacobian = rows.jacobian[:, : laws.size]
    whole = together(rows, excess, np.array([tau or 0.0, of_scale])) + jacobian @ covariance @ jacobian.T
    whole += common * np.outer(rows.magnitude, rows.magnitude)
    within, between = parted(rows, whole, noise, rows.jacobian[:, laws.size :], rank)
    order = np.argsort(rows.owner[rows.magnitude])
    own = g * np.sqrt(np.diag(whole)[rows.magnitude])[order]
    force, _ = forces(laws.design(problem.temperature) @ coefficients, problem.reading)
    return (g * rows.residual[rows.magnitude][order], own, within, between), force


def _directions(problem: Problem, laws: Laws, coefficients: Array) -> Array:
    """Mean direction of each unmoved group under the record, shape (G, 3)."""
    force, _ = forces(laws.design(problem.temperature) @ coefficients, problem.reading)
    count = int(problem.group.max(initial=-1)) + 1
    found = np.array([force[problem.group == k].mean(axis=0) for k in range(count)]).reshape(-1, 3)
    found /= np.linalg.norm(found, axis=1)[:, None]
    return found
