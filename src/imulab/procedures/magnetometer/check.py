"""The test of new readings against a record of a magnetometer alone: whether they lie on its ellipsoid.

The place may be another one, so that the size of the field is free. With r the readings' ``|m| - 1`` under the record,
J its derivatives by the p parameters, both over the noise, and ``J = U S V'``, all that a change of the parameters can
do to the readings is in

    y = U' r  ~  N(s S V' t, f + S V' C V S),    t = (0, D)

C the record's covariance, f the inflation of the new readings' noise, and s the change of the field. What is left of y
beside s is tested by F(p - 1, nu). With d more columns, the derivatives by the hard iron, the same test shows whether a
change of hard iron alone explains it, and which, where the size of the field and the hard iron change by a third of it
as a rule: what readings do not tell, as a change upwards in a level turn, is then taken for none.

J is taken at the points of the ellipsoid nearest to the readings, and without the directions that noise alone makes:
at the readings themselves J would share their noise, and a record that holds would not pass. Readings that scatter by
far more than those of the record are not its sensor's, or not in its unit or range, and fail by that.
"""

from __future__ import annotations

import math
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
from imulab.estimation.distributions import f_tail, probability_fact, probability_text
from imulab.estimation.rows import median
from imulab.procedures.magnetometer import AXES, name_columns
from imulab.procedures.magnetometer.device import output_unit, surface_of
from imulab.procedures.magnetometer.model import read_readings
from imulab.procedures.magnetometer.schema import FieldSummary, fit_of, model_of
from imulab.procedures.magnetometer.solve import evaluate, find_inflation, mark_far, unpack
from imulab.procedures.result import RecordCheck, as_record, as_recording, warn_made_from
from imulab.recording import Array, Data, Reading
from imulab.records.calibration import Calibration
from imulab.report.traces import Exhibits, Figure, figure_axis, marker, rounded, scatter

_SPARE = 4  # readings beyond the parameters
_PASSES = 10  # Gauss-Newton steps for the size of the field and a change of hard iron
_CLOSE = 1e-7  # of the field: the last step
_NOISIER = 3.0  # times the scatter of the record's readings, which another filter or room may make
_LEAST_NOISE, _MOST_NOISE = 0.002, 0.05  # of the field
_ABOVE_NOISE = 3.0  # times what the noise of readings makes of the derivatives: less tells nothing of a parameter
_USUAL = 0.3  # of the field: changes of hard iron that are likely without readings
_TOLD = _USUAL / 2  # a change along an axis that is known to less is not said


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
        Change of hard iron that explains them best, in the unit of the record's biases, shape (d,); nan along an axis
        of which the readings do not tell it.
    hard_iron_std
        Its standard uncertainty, shape (d,).
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
    hard_iron_std: Array
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
        determined = np.isfinite(self.hard_iron_std)
        if self.explained < MAGNETOMETER_CHECK.level or not determined.any():
            return "the readings are not those of the record: hard and soft iron, or the sensor, have changed"
        factor, unit = (1e6, "uT") if self.unit == "T" else (1.0, self.unit)
        change = ", ".join(
            f"{axis} {factor * value:+.3g}"
            for axis, value, known in zip(self.axes, self.hard_iron, determined, strict=True)
            if known
        )
        others = " ".join(axis for axis, known in zip(self.axes, determined, strict=True) if not known)
        rest = f"; along {others} they tell no change" if others else ""
        chance = probability_text(self.explained)
        return f"a hard iron that changed by {change} {unit} explains the readings ({chance}){rest}"

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
            "hard_iron_change": {
                "value": [_number(value) for value in self.hard_iron.tolist()],
                "standard_uncertainty": [_number(u) for u in self.hard_iron_std.tolist()],
                "unit": self.unit,
                "p": self.explained,
            },
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


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


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
    d, fit = output.shape[1], fit_of(held)
    first, ratio, _, _ = _explain(theta, output[used], covariance, fit, hard=False)
    after, _, moved, u = _explain(theta, output[used], covariance, fit, hard=True)
    moved, u = np.where(u < _TOLD * _field(theta, d), [moved, u], np.nan)
    magnitude = evaluate(theta, output)[0]
    notes = [*readings.notes, *warn_made_from(held, [recording])]
    if not used.all():
        where = ", ".join(readings.stretches(~used)[:3])
        notes.append(Note(f"{int((~used).sum())} of {len(used)} readings set aside ({where}): was steel near?"))
    unit = next(iter(held.parameters.values())).unit
    return MagnetometerCheck(
        (1 + magnitude) / ratio - 1, used, ratio, first, moved, u, after, unit, model.axes, tuple(notes)
    )


def _whitened(theta: Array, output: Array) -> tuple[Array, Array]:
    """Return the readings' distances from the ellipsoid, (n,), and their derivatives at its nearest points, (n, p)."""
    r, jacobian, weight = evaluate(theta, output)
    nearest = output + (r / weight**2)[:, None] * jacobian[:, : output.shape[1]]
    _, there, normal = evaluate(theta, nearest)
    return r / weight, there / normal[:, None]


def _field(theta: Array, d: int) -> float:
    """Return the field in the unit of the outputs."""
    return float(abs(np.linalg.det(unpack(theta, d)[1])) ** (1 / d))


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


def _explain(
    theta: Array, output: Array, covariance: Array, fit: FieldSummary, *, hard: bool
) -> tuple[float, float, Array, Array]:
    """Return the probability of readings, the field over the record's, the change of hard iron, and its u, shape (d,).

    Without `hard` the hard iron does not change.
    """
    d, field = output.shape[1], _field(theta, output.shape[1])
    p, ratio, moved, u = 0.0, 1.0 + median(evaluate(theta, output)[0]), np.zeros(d), np.zeros(d)
    for _ in range(_PASSES):
        p, change, u = _test(theta, output, covariance, fit, ratio, moved if hard else None)
        change = change / max(1.0, abs(change[0]) / _USUAL, np.abs(change[1:]).max(initial=0) / (_USUAL * field))
        ratio *= 1 + float(change[0])
        moved = moved + change[1:] if hard else moved
        if abs(change[0]) < _CLOSE and (np.abs(change[1:]) < _CLOSE * field).all():
            break
    return p, ratio, moved, u


def _test(
    theta: Array, output: Array, covariance: Array, fit: FieldSummary, ratio: float, moved: Array | None
) -> tuple[float, Array, Array]:
    """Return the probability of readings, and how the size of the field and the hard iron change, and u of the latter.

    `ratio` and `moved` are where the readings are evaluated: the size of the field over that of the record, and the
    change of hard iron, None where it does not change.
    """
    d, size = output.shape[1], len(theta)
    scale = np.concatenate([np.ones(d), np.full(size - d, ratio)])
    x, rows = _whitened(scale * theta + np.pad(np.zeros(d) if moved is None else moved, (0, size - d)), output)
    u, sizes, v = np.linalg.svd(rows, full_matrices=False)
    left = x - u @ (u.T @ x)
    sigma = float(np.sqrt((left**2).sum() / max(len(x) - size, 1))) or 1e-12
    field = _field(theta, d)
    kept = sizes > _ABOVE_NOISE * math.sqrt(len(x)) * min(sigma / (ratio * field), _MOST_NOISE)
    u, slopes = u[:, kept], (sizes[:, None] * v)[kept]
    left, nu = x - u @ (u.T @ x), max(len(x) - int(kept.sum()), 1)
    inflation = find_inflation(left, u, sigma)
    total = sigma**2 * inflation * np.eye(len(slopes)) + slopes * scale @ covariance @ (slopes * scale).T
    root = np.linalg.cholesky(total)
    changes = [np.concatenate([np.zeros(d), scale[d:] * theta[d:]])[:, None]]
    before, aim = np.zeros((0, 1)), np.zeros(0)
    if moved is not None:
        changes.append(np.eye(size)[:, :d])
        likely = _USUAL * np.concatenate([[1.0], np.full(d, field)])
        before = np.diag(np.concatenate([[ratio], np.ones(d)]) / likely)
        aim = np.concatenate([[ratio - 1], moved]) / likely
    y, columns = np.linalg.solve(root, u.T @ x), np.linalg.solve(root, slopes @ np.hstack(changes))
    joint = np.vstack([columns, before])
    coefficients = np.linalg.lstsq(joint, np.concatenate([y, aim]))[0]
    spread = np.linalg.pinv(joint.T @ joint)
    value = float(((y - columns @ coefficients) ** 2).sum())
    tested = max(int(kept.sum()) - float(np.trace(columns @ spread @ columns.T)), 1.0)
    after = max(min(nu / inflation, fit.degrees_of_freedom), 1.0)
    usual = _NOISIER * max(fit.rms, _LEAST_NOISE) * field
    scatter = float(f_tail((sigma / usual) ** 2, nu / inflation, after))
    p = min(float(f_tail(value / tested, tested, after)), scatter)
    return p, -coefficients, np.sqrt(np.diag(spread)[1:])
