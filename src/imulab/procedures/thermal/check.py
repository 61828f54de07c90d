"""The test whether new recordings contradict a record over temperature, and its report.

The equations are in `check_thermal` and `degrees.within_and_between`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Unpack

import numpy as np

from imulab.columns import triad
from imulab.display import Note
from imulab.errors import OptionError, RecordError, UnitError
from imulab.estimation.decisions import THERMAL_CHECK
from imulab.estimation.distributions import probability_fact, probability_text
from imulab.gravity import (
    Gravity,
    Height,
    Latitude,
    LocalGravity,
    StatedSite,
    at_latitude,
    at_place,
    local_gravity,
    of_place,
)
from imulab.options import FURTHER_TRIADS, measure, text
from imulab.procedures.result import (
    Record,
    RecordCheck,
    as_record,
    as_recording,
    columns_as_rows,
    warn_made_from,
)
from imulab.procedures.thermal.agreement import within_and_between
from imulab.procedures.thermal.check_gyro import GyroCheck, check_gyros, gyro_figure, select_in_range
from imulab.procedures.thermal.check_ramp import RampCheck, check_ramp
from imulab.procedures.thermal.holds import Holds, check_holds, find_holds, prepare_recordings
from imulab.procedures.thermal.model import AXES, forces
from imulab.procedures.thermal.record import laws_in_g
from imulab.procedures.thermal.schema import is_ramp, thermal_of
from imulab.procedures.thermal.solve import ThermalProblem, linearise, row_covariance
from imulab.quantities import in_si
from imulab.recording import Array, Data, Reading, Recording
from imulab.records.calibration import Calibration
from imulab.records.sections import StatedGravity, entries
from imulab.report.parameters import micro_g, text_in
from imulab.report.traces import Exhibits, figure_axis, points, table, within_and_beyond
from imulab.units import conversion_factor, from_si

# The result.


_BEYOND_RANGE = 2.0  # standard uncertainties from which a residual is drawn as beyond them
_FAILED = (
    "|f| differs from g between attitudes or temperatures by more than the record explains",
    "an offset that whole recordings have in common is larger than power cycles explain",
    "the gyroscopes at rest differ between attitudes or temperatures by more than the record explains",
    "an offset of the gyroscopes that whole recordings have in common is larger than power cycles explain",
)


@dataclass(frozen=True, repr=False)
class ThermalCheck(RecordCheck):
    """How well a record over temperature still holds.

    Attributes
    ----------
    holds
        The tested holds.
    residuals
        ``|f| - g`` of each under the record, m/s^2, shape (n,).
    standard_uncertainty
        Standard uncertainty of each by laws, power cycle, temperature and noise, m/s^2, shape (n,).
    within, between
        Probabilities of such residuals if the record holds: of the differences between the holds of a recording, and of
        what all its holds have in common, as by an offset of the biases. None where there is nothing to test.
    gravity
        Local gravity.
    limit
        Largest ``| |f| - g |`` that passes, m/s^2; None: the test alone decides.
    notes
        Notes on what was and was not tested.
    gyro
        The test of the gyroscopes; None where the record or the recordings have none.
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
    data: ClassVar[str] = "recording"

    def __repr__(self) -> str:
        return (
            f"ThermalCheck({'pass' if self.passed else 'fail'}, {probability_text(self.probability)}, "
            f"{len(self.holds)} holds, the farthest off by {text_in(float(self.residuals[self.worst]), 'ug')} µg)"
        )

    @property
    def probability(self) -> float:
        """Probability of the least likely of the tests, times their number (Bonferroni)."""
        gyro = [] if self.gyro is None else [self.gyro.within, self.gyro.between]
        made: list[float] = [p for p in (self.within, self.between, *gyro) if p is not None]
        return min([1.0, *(len(made) * p for p in made)])

    @property
    def passed(self) -> bool:
        """Whether the tests find no contradiction, and every hold is within the limit, if there is one."""
        within = self.limit is None or bool((np.abs(self.residuals) <= self.limit).all())
        return within and self.probability >= THERMAL_CHECK.level

    @property
    def worst(self) -> int:
        """Index of the hold that is farthest off."""
        return int(np.argmax(np.abs(self.residuals)))

    def meaning(self) -> str:
        """Return what the test says, in words."""
        if self.passed:
            return "the recordings agree with the record"
        if self.probability >= THERMAL_CHECK.level:
            return "no change of the unit is shown, but a hold is beyond the limit"
        gyro = self.gyro
        tests = (self.within, self.between, *((gyro.within, gyro.between) if gyro else ()))
        what = _FAILED[int(np.argmin([2.0 if p is None else p for p in tests]))]
        return (
            f"{what}: the unit has changed since the record was made, or gravity, unit or temperature are not as "
            "assumed"
        )

    def next_step(self, record: str, files: Sequence[str]) -> str:
        """Return how to follow the change."""
        return (
            "measure again; 'imulab thermal fit' of the old recordings with this one says where they disagree, and a "
            "record that follows the change takes recordings over temperature anew"
        )

    def measured(self) -> list[str]:
        """Return the tests, and the residual of every hold."""
        label, worst, u = self.holds.label, self.worst, self.standard_uncertainty
        lines = [
            f"{probability_text(self.probability)} over {len(self.holds)} holds (within recordings "
            f"{probability_text(self.within)}, common to each {probability_text(self.between)}), largest |f| - g "
            f"{_micro_text(self.residuals[worst])} µg ({label(worst)})"
        ]
        if (gyro := self.gyro) is not None:
            row, axis_number = gyro.worst
            off, its_u = from_si(
                np.array([each[row, axis_number] for each in (gyro.residuals, gyro.standard_uncertainty)]), "deg/h"
            )
            lines.append(
                f"gyroscopes: within recordings {probability_text(gyro.within)}, common to each "
                f"{probability_text(gyro.between)}, largest law less output {off:+.3g} ± {its_u:.2g} deg/h "
                f"({AXES[axis_number]}, {label(int(gyro.holds[row]))})"
            )
        for k, value in enumerate(self.residuals):
            beyond = "  beyond the limit" if self.limit is not None and abs(value) > self.limit else ""
            lines.append(f"{label(k)}: {_micro_text(value)} ± {_micro_text(u[k], '')} µg{beyond}")
        return lines

    def content(self) -> dict[str, Any]:
        """Return what was measured, for scripts, in SI."""
        labels = [self.holds.label(k) for k in range(len(self.holds))]
        holds = columns_as_rows(
            label=labels, temperature=self.holds.temperature, residual=self.residuals,
            standard_uncertainty=self.standard_uncertainty,
        )  # fmt: skip
        content = {
            "p": self.probability,
            "p_within": self.within,
            "p_between": self.between,
            "limit": None if self.limit is None else {"value": self.limit, "unit": "m/s^2"},
            "gravity": entries(StatedGravity.of(self.gravity)),
            "holds": holds,
        }
        if (gyro := self.gyro) is not None:
            rows = columns_as_rows(
                label=[labels[k] for k in gyro.holds], residual=gyro.residuals,
                standard_uncertainty=gyro.standard_uncertainty,
            )  # fmt: skip
            content["gyro"] = {"p_within": gyro.within, "p_between": gyro.between, "holds": rows}
        return content

    def stated(self) -> list[tuple[str, str]]:
        """Return gravity."""
        return [("gravity", f"{self.gravity.value:.9g} m/s^2")]

    def exhibits(self) -> Exhibits:
        """Return what its report shows."""
        gyro, labels = self.gyro, [self.holds.label(k) for k in range(len(self.holds))]
        tests = {
            "p, if nothing changed": self.probability,
            "p within recordings": self.within,
            "p of what each has in common": self.between,
        }
        if gyro:
            tests["gyroscopes: p within recordings"] = gyro.within
            tests["gyroscopes: p of what each has in common"] = gyro.between
        columns: dict[str, Callable[[int], str]] = {
            "hold": lambda k: labels[k],
            "|f| − g, µg": lambda k: _micro_text(self.residuals[k]),
            "u, µg": lambda k: _micro_text(self.standard_uncertainty[k], ""),
            "(|f| − g) / u": lambda k: f"{self.residuals[k] / self.standard_uncertainty[k]:+.1f}",
        }
        holds = table(
            "Holds",
            "Residual |f| − g under the record, its standard uncertainty u, and their ratio. The test weighs all "
            "together, with what their errors share.",
            columns,
            range(len(labels)),
        )
        residual, reach = from_si(self.residuals, "ug"), _BEYOND_RANGE * from_si(self.standard_uncertainty, "ug")
        far = np.abs(residual) > reach
        figure = points(
            "Residual |f| − g of each hold under the record, over temperature",
            "Bars: twice the standard uncertainty, from laws, power cycle, temperature and noise; the holds of a "
            "recording have most of it in common. Red diamonds lie beyond.",
            ("temperature, degC", self.holds.temperature),
            (figure_axis("|f| − g, µg", zeroline=True), residual),
            reach,
            within_and_beyond(far),
            labels=labels,
            hover="%{text}<br>%{y:.1f} µg",
            message=f"{int(far.sum())} of {len(far)} holds lie beyond twice the standard uncertainty.",
        )
        facts = [*((name, probability_fact(p)) for name, p in tests.items())]
        facts.append(("largest |f| − g", f"{_micro_text(self.residuals[self.worst])} µg"))
        return self.exhibits_with(facts, [figure, *([gyro_figure(self.holds, gyro)] if gyro else []), holds])


def _micro_text(value: float, sign: str = "+") -> str:
    """Return an acceleration in µg as text, three significant digits, never in powers of ten."""
    size = micro_g(value)
    return f"{size:{sign}.3g}" if abs(size) < 999.5 else f"{size:{sign}.0f}"


# The test.


def check_thermal(
    record: Record,
    data: Data | Sequence[Data],
    *,
    limit: Annotated[float | str | None, measure("acceleration", "mg")] = None,
    gravity: LocalGravity = None,
    latitude: Latitude = None,
    height: Height = None,
    place: StatedSite = None,
    tilt: Annotated[float | str, measure("angle", "mrad")] = "0.2 mrad",
    turn_on_scatter: Annotated[float | str | None, measure("acceleration", "mg", "SIZE")] = None,
    gyro_turn_on_scatter: Annotated[float | str | None, measure("rate", "deg/s", "SIZE"), FURTHER_TRIADS] = None,
    settle: Annotated[float | str | None, measure("time", "s")] = None,
    temperature_column: Annotated[str | None, text("NAME")] = None,
    **reading: Unpack[Reading],
) -> ThermalCheck | RampCheck:
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
        Largest ``| |f| - g |`` that passes, beside the test. In m/s^2, or a text such as ``"2 mg"``.
    gravity
        Local gravity where they were measured; else of the first head, else of the record. As for `fit_tumble`.
    latitude, height, place
        As for `fit_tumble`.
    tilt
        As for `fit_thermal`.
    turn_on_scatter
        What biases move by from one power cycle to the next; that of the record if not given. Standard deviation of
        each, m/s^2.
    gyro_turn_on_scatter
        The same of the gyroscopes' biases. In rad/s.
    settle
        As for `fit_thermal`.
    temperature_column
        Column of the unit's own thermometer; as in the record's fit if not given.
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
    latitude, height = of_place(place, gravity, latitude, height)
    if held.procedure != "thermal":
        raise RecordError(f"a {held.procedure} record cannot be checked over temperature; expected a thermal record")
    if is_ramp(held):
        items = [as_recording(item, reading, check_thermal, clock="gyro") for item in _as_list(data)]
        return check_ramp(held, items, gyro_turn_on_scatter, settle, temperature_column)
    largest = None if limit is None else in_si(limit, "limit", "acceleration", "mg")
    if largest is not None and not largest > 0:
        raise OptionError(f"limit {largest:g} m/s^2: expected more than 0")
    recordings = [as_recording(item, reading, check_thermal, clock="accel") for item in _as_list(data)]
    column = temperature_column or held.options.get("temperature_column")
    recordings = prepare_recordings(
        [_convert_outputs(held, item) for item in recordings],
        column if column is not None and all(column in item for item in recordings) else temperature_column,
        None if settle is None else in_si(settle, "settle", "time", "s"),
        span=0.0,
    )
    has_gyroscopes = thermal_of(held).model.gyro is not None
    if gyro_turn_on_scatter is not None and not has_gyroscopes:
        raise OptionError("gyro_turn_on_scatter: the record holds no gyroscopes (thermal fit --with gyro)")
    earth = at_latitude(latitude) if has_gyroscopes else None
    beside = earth is not None or place is not None
    local = _choose_gravity(held, at_place(gravity, latitude, height, beside=beside), recordings[0])
    holds, notes = select_in_range(held, find_holds(recordings))
    unit = thermal_of(held).model.output_unit
    check_holds(holds, local.value, conversion_factor(unit, "m/s^2") if unit in ("m/s^2", "g", "mg") else None)
    leaning, tau = _tilt_and_scatter(tilt, turn_on_scatter, held, local.value)
    rank = None if tau is None else 0 if turn_on_scatter is not None else thermal_of(held).fit.between_recordings.rank
    tested, force = _run_tests(held, holds, local, leaning, tau, rank)
    if tau is None:
        notes.append(
            "the record does not say how far biases move from one power cycle to the next, so an offset that a whole "
            "recording has in common is not tested: state --turn-on-scatter"
        )
    gyro, gyro_notes = check_gyros(held, holds, force, gyro_turn_on_scatter, earth)
    notes += gyro_notes
    notes += [*([local.note] if local.note else []), *warn_made_from(held, recordings)]
    return ThermalCheck(holds, *tested, local, largest, tuple(notes), gyro)


def _as_list(data: Data | Sequence[Data]) -> list[Any]:
    """Return the recordings as a list."""
    single = not isinstance(data, Sequence) or isinstance(data, str | os.PathLike)
    listed: list[Any] = [data] if single else list(data)  # type: ignore[arg-type]
    if not listed:
        raise OptionError("check_thermal: data: expected one recording or more, found none")
    return listed


def _convert_outputs(record: Calibration, recording: Recording) -> Recording:
    """Return the recording with accelerometers in the unit of the record."""
    unit, present = thermal_of(record).model.output_unit, recording.triad_unit("accel")
    try:
        factor = conversion_factor(present, unit)
    except UnitError:
        raise UnitError(
            f"{recording.name}: columns accel_x accel_y accel_z are in {present}, but the record calibrates outputs "
            f"in {unit}"
        ) from None
    names = triad("accel")
    return recording.with_columns({n: recording.column(n) * factor for n in names}, dict.fromkeys(names, unit))


def _choose_gravity(record: Calibration, gravity: float | str | Gravity | None, recording: Recording) -> Gravity:
    """Return the stated gravity, else that of the recording's head, else that of the record."""
    if gravity is None and "gravity" not in recording.metadata:
        stated = record.model["gravity"]
        note = f"gravity {stated['value']:.6g} m/s^2 was taken from the record, as if measured at the same place"
        uncertainty = float(stated.get("standard_uncertainty") or 0.0)
        return Gravity(float(stated["value"]), str(stated.get("from", "record")), uncertainty, Note(note))
    return local_gravity(gravity, recording)


def _tilt_and_scatter(
    tilt: float | str, turn_on_scatter: float | str | None, record: Calibration, gravity: float
) -> tuple[float, float | None]:
    """Return the tilt, rad, and the scatter of biases between power cycles, g; None where it is unknown."""
    leaning = in_si(tilt, "tilt", "angle", "mrad")
    if not 0 < leaning < np.inf:
        raise OptionError(f"tilt {leaning:g}: expected a size above 0")
    between = thermal_of(record).fit.between_recordings
    if turn_on_scatter is None:
        if between.from_ == "unknown":
            return leaning, None
        # An estimate may be 0 by chance: with its resolution added, F with its rank keeps the rate of false alarms.
        least = 0.0 if between.resolution is None else between.resolution.value
        return leaning, float(np.hypot(between.bias.value, least)) / gravity
    tau = in_si(turn_on_scatter, "turn_on_scatter", "acceleration", "mg") / gravity
    if not 0 <= tau < np.inf:
        raise OptionError(f"turn_on_scatter {turn_on_scatter!r}: expected 0 or more")
    return leaning, tau


def _run_tests(
    record: Calibration, holds: Holds, gravity: Gravity, tilt: float, tau: float | None, rank: int | None
) -> tuple[tuple[Array, Array, float | None, float | None], Array]:
    """Return residuals, their uncertainties, m/s^2, and the probabilities of both tests; and f in g, shape (n, 3).

    The covariance is V of `solve` plus ``J C J'``, C the covariance of the record's coefficients, and gravity's.
    """
    g, fit = gravity.value, thermal_of(record).fit
    laws, coefficients, covariance, scale, common = laws_in_g(record, g, gravity.standard_uncertainty)
    problem = ThermalProblem(
        holds.mean / scale, holds.covariance / (scale[:, None] * scale), holds.temperature, np.zeros(len(holds)),
        holds.step, holds.shared, holds.recording, holds.group, tilt, np.zeros(3), wander=holds.wander,
    )  # fmt: skip
    rows = linearise(problem, laws, coefficients)
    excess = (fit.excess.value / g) ** 2
    of_scale = fit.between_recordings.scale_factor.value
    noise = row_covariance(rows, excess, np.zeros(2))
    jacobian = rows.jacobian[:, : laws.size]
    whole = row_covariance(rows, excess, np.array([tau or 0.0, of_scale])) + jacobian @ covariance @ jacobian.T
    whole += common * np.outer(rows.magnitude, rows.magnitude)
    within, between = within_and_between(rows, whole, noise, rows.jacobian[:, laws.size :], rank)
    order = np.argsort(rows.owner[rows.magnitude])
    residual_u = g * np.sqrt(np.diag(whole)[rows.magnitude])[order]
    force, _ = forces(laws.design(problem.temperature) @ coefficients, problem.reading)
    return (g * rows.residual[rows.magnitude][order], residual_u, within, between), force
