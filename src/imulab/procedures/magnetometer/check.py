"""The test of new readings against a record of a magnetometer alone: whether they lie on its ellipsoid.

The place may be another one, so that the size of the field is free. With r the readings' ``|m| - 1`` under the record,
J its derivatives by the p parameters, both over the noise, and ``J = U S V'``, all that a change of the parameters can
do to the readings is in

    y = U' r  ~  N(s S V' t, f + S V' C V S),    t = (0, D)

C the record's covariance, f the inflation of the new readings' noise, and s the change of the field. What is left of y
beside s is tested by F(p - 1, nu). With d more columns, the derivatives by the hard iron, the same test shows whether a
change of hard iron alone explains it, and which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, ClassVar, Unpack

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.device.unit import output_factor
from imulab.display import Note
from imulab.errors import DataError, RecordError
from imulab.estimation.decisions import MAGNETOMETER_CHECK
from imulab.estimation.distributions import f_tail
from imulab.procedures.magnetometer import AXES, name_columns
from imulab.procedures.magnetometer.device import output_unit, surface_of
from imulab.procedures.magnetometer.model import read_readings
from imulab.procedures.magnetometer.schema import FieldSummary, fit_of, model_of
from imulab.procedures.magnetometer.solve import evaluate, find_inflation, mark_far
from imulab.procedures.result import RecordCheck, as_record, as_recording, probability_fact, probability_text
from imulab.recording import Array, Data, Reading
from imulab.records.calibration import Calibration
from imulab.report.traces import Exhibits, Figure, figure_axis, marker, rounded, scatter

_SPARE = 4  # readings beyond the parameters
_PASSES = 5  # Gauss-Newton steps for a change of hard iron
_SINGULAR = 1e-9


@dataclass(frozen=True, repr=False)
class MagnetometerCheck(RecordCheck):
    """How well a record of a magnetometer alone still holds.

    Attributes
    ----------
    magnitude
        ``|m|`` of each reading over that of all less 1, shape (n,).
    used
        Which readings were not disturbed, shape (n,).
    field
        Magnitude of the field over that of the record.
    probability
        Probability of such readings if the record holds.
    hard_iron
        Change of hard iron that explains them best, in the unit of the record's biases, shape (d,).
    explained
        Probability of what is left after such a change.
    unit, axes
        Unit of the record's biases, and the axes that it holds.
    notes
        Notes on the test.
    """

    magnitude: Array
    used: NDArray[np.bool_]
    field: float
    probability: float
    hard_iron: Array
    explained: float
    unit: str
    axes: str
    notes: tuple[str, ...]

    subject: ClassVar[str] = "Magnetometer check"
    data: ClassVar[str] = "file"

    @property
    def passed(self) -> bool:
        """Whether the readings agree with the record at 5 %."""
        return self.probability >= MAGNETOMETER_CHECK.level

    @property
    def rms(self) -> float:
        """Scatter of |m| as a part of the field."""
        return float(np.sqrt(np.mean(self.magnitude[self.used] ** 2)))

    def meaning(self) -> str:
        """Return the outcome in a sentence."""
        if self.passed:
            return "the readings agree with the record"
        if self.explained < MAGNETOMETER_CHECK.level:
            return "the readings are not those of the record: hard and soft iron, or the sensor, have changed"
        factor, unit = (1e6, "uT") if self.unit == "T" else (1.0, self.unit)
        change = ", ".join(
            f"{axis} {factor * value:+.3g}" for axis, value in zip(self.axes, self.hard_iron, strict=True)
        )
        return f"a hard iron that changed by {change} {unit} explains the readings (p = {self.explained:.1g})"

    def next_step(self, record: str, files: Sequence[str]) -> str:
        """Return what to do after a failed test."""
        return f"'imulab magnetometer fit {' '.join(files)} -o NEW.json' makes a record that follows the change"

    def measured(self) -> list[str]:
        """Return what was measured, as lines of text."""
        return [
            f"{probability_text(self.probability)} of {int(self.used.sum())} readings; |m| scatters by "
            f"{100 * self.rms:.2g} %",
            f"the field is {self.field:.4g} times that of the record, which is of the place and not tested",
        ]

    def content(self) -> dict[str, Any]:
        """Return what was measured, for scripts, in SI."""
        return {
            "p": self.probability,
            "readings": int(self.used.sum()),
            "rms": self.rms,
            "field": self.field,
            "hard_iron_change": {"value": self.hard_iron.tolist(), "unit": self.unit, "p": self.explained},
        }

    def exhibits(self) -> Exhibits:
        """Return what its report shows."""
        facts = [
            ("p, if the record holds", probability_fact(self.probability)),
            ("readings", str(int(self.used.sum()))),
            ("|m| scatters by", f"{100 * self.rms:.2g} %"),
        ]
        figure = Figure(
            title="Magnitude of the field under the record",
            message=f"|m| scatters by {100 * self.rms:.2g} % rms of the field.",
            caption="|m| of each reading less that of all, in per cent of the field. Red diamonds were set aside.",
            traces=[
                scatter(
                    list(range(1, len(self.used) + 1)), rounded(100 * self.magnitude), "markers",
                    marker=marker(~self.used, 5), hovertemplate="%{x}<br>%{y:+.2f} %<extra></extra>",
                )
            ],
            layout={
                "xaxis": figure_axis("reading"),
                "yaxis": figure_axis("|m|, %", zeroline=True),
                "showlegend": False,
            },
        )  # fmt: skip
        return self.exhibits_with(facts, [figure], f"; {probability_text(self.probability)}")


def check_magnetometer(
    record: Calibration | str | PathLike[str], data: Data, **reading: Unpack[Reading]
) -> MagnetometerCheck:
    """Test whether new readings lie on the ellipsoid of a record of a magnetometer alone, up to the size of the field.

    Parameters
    ----------
    record
        Of `fit_magnetometer`, or its file.
    data
        New readings in several directions; of a record of a level turn, level ones. As for `fit_magnetometer`.
    reading
        How arrays and files are to be understood, as for `fit_magnetometer`.

    Raises
    ------
    RecordError
        The record is of another procedure.
    DataError, UnitError
        There are too few readings, or in another unit; and as for `fit_magnetometer`.

    Examples
    --------
    >>> import imulab as il
    >>> wave = {"field": "48 uT", "duration": "30 s"}
    >>> record = il.fit_magnetometer(il.simulate_magnetometer(**wave)).calibration
    >>> il.check_magnetometer(record, il.simulate_magnetometer(**wave)).passed
    True
    """
    held = as_record(record, "check_magnetometer")
    if held.procedure != "magnetometer":
        raise RecordError(f"expected a magnetometer record, found a {held.procedure} record")
    recording = as_recording(data, reading, check_magnetometer, name_columns, clock="mag")
    readings, model = read_readings(recording), model_of(held)
    factor = output_factor(recording.name, triad("mag"), readings.unit, model.mag_output_unit) * output_unit(held)
    output = factor * readings.output[:, [AXES.index(axis) for axis in model.axes]]
    theta, covariance = surface_of(held)
    if len(output) < len(theta) + _SPARE:
        raise DataError(
            f"{recording.name}: {len(output)} different readings; expected {len(theta) + _SPARE} or more, in several "
            "directions"
        )
    used = _find_used(theta, output)
    size, d = len(theta), output.shape[1]
    first, of_field = _test(theta, output[used], covariance, theta, size - 1, hard=False, summary=fit_of(held))
    moved, after = np.zeros(d), first
    for _ in range(_PASSES):  # |m| is not linear in a large change of hard iron
        there = theta + np.concatenate([moved, np.zeros(size - d)])
        after, change = _test(there, output[used], covariance, theta, size - 1 - d, hard=True, summary=fit_of(held))
        moved = moved + change[1:]
    magnitude = evaluate(theta, output)[0]
    notes = list(readings.notes)
    if not used.all():
        where = ", ".join(readings.stretches(~used)[:3])
        notes.append(Note(f"{int((~used).sum())} of {len(used)} readings set aside ({where}): was steel near?"))
    unit = next(iter(held.parameters.values())).unit
    ratio = 1.0 + float(of_field[0])
    return MagnetometerCheck(
        (1 + magnitude) / ratio - 1, used, ratio, first, moved, after, unit, model.axes, tuple(notes)
    )


def _whitened(theta: Array, output: Array) -> tuple[Array, Array]:
    r, jacobian, weight = evaluate(theta, output)
    return r / weight, jacobian / weight[:, None]


def _find_used(theta: Array, output: Array) -> NDArray[np.bool_]:
    """Return which readings were not disturbed, by what no change of the parameters explains, shape (n,)."""
    x, rows = _whitened(theta, output)
    aside = np.zeros(len(x), dtype=np.bool_)
    for _ in range(_PASSES):
        coefficients = np.linalg.lstsq(rows[~aside], x[~aside])[0]
        aside = mark_far(x - rows @ coefficients, aside)
        if (~aside).sum() < len(theta) + _SPARE:
            return np.ones(len(x), dtype=np.bool_)
    return ~aside


def _test(
    at: Array, output: Array, covariance: Array, theta: Array, freedom: int, *, hard: bool, summary: FieldSummary
) -> tuple[float, Array]:
    """Return the probability of readings under a record, and the change of the field's size, and of hard iron.

    `at` are the parameters where the readings are evaluated: those of the record, with another hard iron.
    """
    x, rows = _whitened(at, output)
    u, size, v = np.linalg.svd(rows, full_matrices=False)
    kept = size > _SINGULAR * size[0]
    u, slopes = u[:, kept], (size[:, None] * v)[kept]
    left = x - u @ (u.T @ x)
    nu = max(len(x) - int(kept.sum()), 1)
    sigma = float(np.sqrt((left**2).sum() / nu))
    if not sigma:
        sigma = 1e-12
    inflation = find_inflation(left, u, sigma)
    total = sigma**2 * inflation * np.eye(len(slopes)) + slopes @ covariance @ slopes.T
    root = np.linalg.cholesky(total)
    d = output.shape[1]
    field = np.concatenate([np.zeros(d), theta[d:]])
    design = slopes @ np.column_stack([field, np.eye(len(theta))[:, :d]] if hard else [field])
    y, columns = np.linalg.solve(root, u.T @ x), np.linalg.solve(root, design)
    coefficients = np.linalg.lstsq(columns, y)[0]
    value = float(((y - columns @ coefficients) ** 2).sum())
    tested = max(freedom - int((~kept).sum()), 1)
    spare = min(nu / inflation, summary.degrees_of_freedom)
    return float(f_tail(value / tested, float(tested), max(spare, 1.0))), -coefficients
