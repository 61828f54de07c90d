"""Readings of a magnetometer triad that was turned, checked, and the names of its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.display import Finding, Note
from imulab.errors import DataError, UnitError
from imulab.procedures.magnetometer import AXES, FEWEST
from imulab.procedures.magnetometer.solve import Surface, Unmodelled, evaluate, pairs, unpack
from imulab.recording import Array, Recording
from imulab.units import parse_unit

_DEAD = 1e-3  # of the largest span: an axis that spans less is dead
_CLIPPED, _PILED, _NEXT = 0.01, 5.0, 5
"""An axis is clipped where this share of the readings, and so many times as many as at the next 5 values, are at one
end."""
_LEAST_PILED = 10
_ALIKE, _MOSTLY = np.cos(0.3), 0.5
"""Cosine of the angle between readings in a row that point alike, and the share of them by which noise is told."""
_SPANS = 1e-30, 1e30  # of the outputs, in any unit; beyond them there are no squares


@dataclass(frozen=True)
class MagReadings:
    """Outputs of a magnetometer triad in the order of time.

    Attributes
    ----------
    output
        Shape (n, 3), in `unit`.
    row
        Row of each in the recording, shape (n,).
    recording
        Where they are from.
    unit
        Unit of the columns.
    notes
        What was left out.
    """

    output: Array
    row: NDArray[np.intp]
    recording: Recording
    unit: str
    notes: tuple[str, ...]

    @property
    def time(self) -> Array | None:
        """Time of each, s, shape (n,); None of a table."""
        return None if self.recording.time is None else np.asarray(self.recording.si("time"))[self.row]

    def stretches(self, marked: NDArray[np.bool_]) -> list[str]:
        """Return where marked readings are, shape (n,): times from and to, or rows; near ones as one."""
        index = np.flatnonzero(marked)
        if not index.size:
            return []
        time = self.time
        apart = np.flatnonzero(np.diff(index) > 64)
        first, last = index[np.concatenate([[0], apart + 1])], index[np.concatenate([apart, [len(index) - 1]])]
        if time is None:
            return [f"rows {self.row[a] + 1} to {self.row[b] + 1}" for a, b in zip(first, last, strict=True)]
        return [f"{time[a]:.1f} to {time[b]:.1f} s" for a, b in zip(first.tolist(), last.tolist(), strict=True)]


@dataclass(frozen=True)
class FittedTurn:
    """Readings and the surface that was fitted to them: an ellipsoid, or the ellipse of a level turn.

    Attributes
    ----------
    readings
        The outputs.
    surface
        In the unit of the outputs.
    aside
        Which readings were disturbed and left out, shape (n,).
    axes
        Axes that the surface holds.
    bends
        By how much outputs bend with a power of the field, 2 or 3, where the residuals tell it.
    change
        A change of the hard iron at some time, where the residuals tell one.
    """

    readings: MagReadings
    surface: Surface
    aside: NDArray[np.bool_]
    axes: str
    bends: Mapping[int, Unmodelled] = field(default_factory=dict)
    change: Unmodelled | None = None

    @property
    def upright(self) -> str | None:
        """Axis about which the unit was turned level, None where it was turned through all directions."""
        return next(iter(set(AXES) - set(self.axes)), None)

    @property
    def output(self) -> Array:
        """Outputs of the axes that the surface holds, shape (n, d)."""
        return self.readings.output[:, [AXES.index(axis) for axis in self.axes]]

    @property
    def residual(self) -> Array:
        """``|m| - 1`` of all readings, shape (n,)."""
        return evaluate(self.surface.theta, self.output)[0]

    @property
    def field(self) -> Array:
        """The corrected field in units of its magnitude, shape (n, d)."""
        hard, soft = unpack(self.surface.theta, len(self.axes))
        corrected: Array = (self.output - hard) @ np.linalg.inv(soft)
        return corrected

    def white(self) -> float:
        """Return the part of the scatter of |m| that differs from reading to reading, at most `scatter`.

        By differences of readings in a row, where these point alike; 0 where most do not, as in a table of attitudes:
        there noise cannot be told from iron.
        """
        field = self.field[~self.aside]
        unit = field / np.linalg.norm(field, axis=1)[:, None]
        near = (unit[1:] * unit[:-1]).sum(axis=1) > _ALIKE
        if near.mean() < _MOSTLY:
            return 0.0
        change = np.diff(self.residual[~self.aside])[near]
        return min(float(np.sqrt(np.mean(change**2) / 2)), self.scatter())

    def scatter(self) -> float:
        """Return the scatter of |m| as a part of the field, without readings that were set aside."""
        return float(np.sqrt(np.mean(self.residual[~self.aside] ** 2)))


def read_readings(recording: Recording) -> MagReadings:
    """Return the readings of a recording; rows without numbers and repeats of the row before are left out.

    Raises
    ------
    DataError
        There are no magnetometers, or too few readings; an axis is clipped.
    UnitError
        The columns have different units, or one of something else.
    """
    names = triad("mag")
    missing = [name for name in names if name not in recording]
    if missing:
        raise recording.lacking(f"column {' '.join(missing)}", missing[0])
    unit = recording.triad_unit("mag")
    if parse_unit(unit).quantity not in ("magnetic field", "output", "number"):
        raise UnitError(
            f"{recording.name}: columns {' '.join(names)}: expected a unit of field or output such as uT, mgauss or "
            f"count, found {unit!r}"
        )
    output = np.asarray(recording.triad("mag"), dtype=np.float64)
    notes: list[str] = []
    there = np.isfinite(output).all(axis=1)
    zero = there & (output == 0).all(axis=1)
    if zero.any():
        kind = Note if zero.mean() < _CLIPPED else Finding
        text = (
            f"mag: {int(zero.sum())} rows of exact zeros left out, the first at {recording.place(int(zero.argmax()))}"
        )
        notes.append(kind(text, "check the link to the sensor, and record again"))
    row = np.flatnonzero(there & ~zero)
    new = np.ones(len(row), dtype=np.bool_)
    new[1:] = (output[row[1:]] != output[row[:-1]]).any(axis=1)
    if not new.all():
        notes.append(
            Note(f"mag: {int((~new).sum())} rows that repeat the row before left out: each reading counts once")
        )
    row = row[new]
    _check_readings(output[row], unit, recording.name)
    return MagReadings(output[row], row, recording, unit, tuple(notes))


def _check_readings(output: Array, unit: str, name: str) -> None:
    """Refuse too few readings, and a clipped axis."""
    least = min(FEWEST.values())
    if len(output) < least:
        raise DataError(
            f"{name}: {len(output)} different readings of mag_x mag_y mag_z; expected {FEWEST[3]} or more in all "
            f"directions, or {least} or more of a level turn"
        )
    span = float(np.ptp(output, axis=0).max())
    if not _SPANS[0] < span < _SPANS[1]:
        raise DataError(f"{name}: the outputs of mag_x mag_y mag_z span {span:.3g} {unit}: these are no readings")
    for axis, column in enumerate(triad("mag")):
        for end in (np.min, np.max):
            count, extreme = _count_at_end(output[:, axis], float(end(output[:, axis])))
            if count:
                raise DataError(
                    f"{name}: column {column}: {count} of {len(output)} readings are {extreme:.6g} {unit}, where they "
                    "end: the axis is saturated; expected a wider range, or less iron near"
                )


def check_dead(output: Array, unit: str, name: str) -> None:
    """Refuse an axis whose output does not change, and a unit that was not turned.

    Raises
    ------
    DataError
        There is one.
    """
    span = np.ptp(output, axis=0)
    for axis, column in enumerate(triad("mag")):
        if span[axis] <= _DEAD * span.max():
            raise DataError(
                f"{name}: column {column}: the output changes by {span[axis]:.3g} {unit}, other axes by "
                f"{span.max():.3g} {unit}: a dead axis?"
            )


def _count_at_end(values: Array, extreme: float) -> tuple[int, float]:
    """Return how many values are at an end where they pile up, 0 where they do not, and that end."""
    count = int(np.count_nonzero(values == extreme))
    if count < max(_LEAST_PILED, _CLIPPED * len(values)):
        return 0, extreme
    levels, counts = np.unique(values, return_counts=True)
    beside = counts[1 : 1 + _NEXT] if extreme == levels[0] else counts[-1 - _NEXT : -1]
    return (count, extreme) if beside.size and count > _PILED * beside.mean() else (0, extreme)


def parameter_names(axes: str) -> list[str]:
    """Return the names of the parameters in a record, of the axes that were turned."""
    return [
        *(f"mag_bias_{axis}" for axis in axes),
        *(f"mag_soft_{axes[i]}{axes[j]}" for i, j in pairs(len(axes))),
    ]


def not_told(axes: str) -> list[str]:
    """Return what such a test cannot show: the rotation to the body, and the parameters of an axis kept upright."""
    return ["rotation", *(name for name in parameter_names(AXES) if name not in parameter_names(axes))]
