"""What a gyro array is: which columns of a recording are its elements, and what a record says of them.

One axis: columns ``gyro_1 .. gyro_n``. Three axes: ``gyro_x_1 .. gyro_z_n``. ``z_i = A_i w + b_i``: reading z of
element i, body rate w, bias b; the record holds ``M_i = A_i^-1`` so that ``w = M_i (z_i - b_i)``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError, RecordError, UnitError
from imulab.procedures.gyro_array.sections import array_of
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor, from_si, parse_unit
from imulab.verdict import Note

FEWEST_ROBUST = 3
SOURCE_RATES = (50.0, 200.0)
"""Sampling rates for which the source states its recursion, Hz."""
MOST_ELEMENTS = 64
_ELEMENT = re.compile(r"gyro_(?:([xyz])_)?([1-9][0-9]*)")
_MISNUMBERED = re.compile(r"gyro_(?:[xyz]_)?0[0-9]*")


@dataclass(frozen=True)
class Elements:
    """The elements of an array in a recording.

    Attributes
    ----------
    names
        Column names, axis by axis, each of n elements.
    units
        Unit of each axis.
    axes
        ``("",)`` for one axis, ``("x", "y", "z")`` for three.
    """

    names: tuple[tuple[str, ...], ...]
    units: tuple[str, ...]
    axes: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of elements on each axis."""
        return len(self.names[0])

    def rate_names(self) -> list[str]:
        """Return the names of the fused columns: ``rate``, or ``rate_x rate_y rate_z``."""
        return [f"rate_{axis}" if axis else "rate" for axis in self.axes]

    def readings(self, recording: Recording) -> Array:
        """Return the readings as logged, shape (m, axes, n), C-contiguous."""
        out = np.empty((len(recording), len(self.axes), self.count))
        for a, row in enumerate(self.names):
            for i, name in enumerate(row):
                out[:, a, i] = recording.columns[name]
        return out

    def truth(self, recording: Recording) -> Array | None:
        """Return the columns ``truth_rate`` (or ``truth_rate_x`` ..) in the unit of the readings, shape (m, axes).

        Raises
        ------
        DataError
            There is a truth for some axes only.
        UnitError
            The truth has a unit that cannot be converted to the readings'.
        """
        names = [f"truth_{name}" for name in self.rate_names()]
        there = [name for name in names if name in recording]
        if not there:
            return None
        if len(there) < len(names):
            missing = next(name for name in names if name not in there)
            raise DataError(f"{recording.name}: column {there[0]} without {missing}; expected {' '.join(names)}")
        columns = []
        for name, unit in zip(names, self.units, strict=True):
            try:
                factor = conversion_factor(recording.units[name], unit)
            except UnitError as error:
                raise UnitError(f"{recording.name}: column {name}: {error}") from None
            columns.append(recording.columns[name] * factor)
        return np.column_stack(columns)


def find_elements(recording: Recording) -> Elements:
    """Find the elements of a recording by their column names.

    Raises
    ------
    DataError
        There are none, numbers are missing or do not begin with 1, or the axes have different numbers of elements.
    UnitError
        The elements of an axis have different units.
    """
    found: dict[str, dict[int, str]] = {}
    for name in recording.columns:
        match = _ELEMENT.fullmatch(name)
        if match:
            found.setdefault(match[1] or "", {})[int(match[2])] = name
        elif _MISNUMBERED.fullmatch(name):
            raise DataError(f"{recording.name}: column {name}: expected elements numbered 1 2 3 ..")
    if not found:
        raise DataError(
            f"{recording.name}: no columns gyro_1 gyro_2 .. (one axis) or gyro_x_1 .. gyro_z_n (three); "
            f"found {' '.join(recording.columns)}"
        )
    if "" in found and len(found) > 1:
        raise DataError(f"{recording.name}: both {found[''][min(found[''])]} and columns by axis; expected one form")
    axes = ("",) if "" in found else ("x", "y", "z")
    stem = {axis: f"gyro_{axis}_" if axis else "gyro_" for axis in axes}
    count = max(max(numbers) for numbers in found.values())
    if count > MOST_ELEMENTS:
        raise DataError(f"{recording.name}: {count} elements; expected {MOST_ELEMENTS} at most")
    for axis in axes:
        for number in range(1, count + 1):
            if number not in found.get(axis, {}):
                raise DataError(
                    f"{recording.name}: no column {stem[axis]}{number}; expected {count} elements on each axis, "
                    "numbered from 1"
                )
    names = tuple(tuple(found[axis][i] for i in range(1, count + 1)) for axis in axes)
    units = []
    for row in names:
        of_column = {name: parse_unit(recording.units[name]).symbol for name in row}
        if len(set(of_column.values())) > 1:
            listed = ", ".join(f"{name} [{unit}]" for name, unit in of_column.items())
            raise UnitError(f"{recording.name}: the elements of an axis must share one unit, found {listed}")
        units.append(of_column[row[0]])
    return Elements(names, tuple(units), axes)


@dataclass(frozen=True)
class ArrayCalibration:
    """What a record says of an array, in the unit of the readings.

    Attributes
    ----------
    bias
        Plain means at rest, the common part included, shape (axes, n).
    matrices
        Shape (n, axes, axes), or None where no moving recording was calibrated from.
    weights
        Fixed weights ``C^-1 1 / (1' C^-1 1)``, shape (axes, n).
    white, walk
        Angle random walk, unit s^1/2 (`ArrayRecord.white_noise`), and rate random walk, unit s^-1/2, 0 where it is not
        determined, shape (axes, n).
    """

    bias: Array
    matrices: Array | None
    weights: Array
    white: Array
    walk: Array


def feedback_notes(count: int, rate: float) -> list[str]:
    """Return what to know of the method `feedback` for so many gyros on each axis and this sampling rate, Hz."""
    found: list[str] = []
    if count < FEWEST_ROBUST:
        found.append(
            Note(
                f"method feedback with {count} gyro{'s' * (count > 1)} on each axis: with fewer than {FEWEST_ROBUST} "
                "no gyro stands out from the others, so that the weights mean little"
            )
        )
    low, high = SOURCE_RATES
    if not 0.99 * low <= rate <= 1.01 * high:
        found.append(
            Note(
                f"method feedback at {rate:.6g} Hz: its source states it for {low:g} to {high:g} Hz, and its memory "
                "counts samples"
            )
        )
    return found


def check_calibration(record: Calibration, name: str = "the record") -> None:
    """Check that a record, of this file name, is that of an array calibration.

    Raises
    ------
    RecordError
        It is of another procedure, or of a comparison.
    """
    if record.procedure != "gyro_array" or record.model.get("kind") != "calibration":
        what = record.model.get("kind", record.procedure) if record.procedure == "gyro_array" else record.procedure
        raise RecordError(f"{name}: expected the record of an array calibration, found one of a {what}")


def array_calibration(record: Calibration, elements: Elements, recording: str = "recording") -> ArrayCalibration:
    """Return what a record says of the elements of a recording of this name.

    Raises
    ------
    RecordError
        The record is of another procedure, or of another number of elements or axes.
    UnitError
        The readings are not rates.
    """
    check_calibration(record)
    held = array_of(record)
    listed, axes = held.elements, len(held.model.axes)
    if len(listed) != elements.count or axes != len(elements.axes):
        raise RecordError(
            f"{recording}: {elements.count} gyros on {count_of_axes(len(elements.axes))}; "
            f"the record of the calibration holds {len(listed)} on {count_of_axes(axes)}"
        )
    for row, unit in zip(elements.names, elements.units, strict=True):
        if parse_unit(unit).quantity != "rate":
            raise UnitError(f"{recording}: column {row[0]} is in {unit}; the record of the calibration is in rad/s")

    def of(values: Array) -> Array:
        return np.array([from_si(row, unit) for row, unit in zip(values, elements.units, strict=True)])

    matrices = None
    if held.model.aligned:
        matrices = np.array([element.alignment for element in listed])
        size = np.array([conversion_factor("rad/s", unit) for unit in elements.units])
        matrices *= size[:, None] / size[None, :]
    return ArrayCalibration(
        bias=of(np.array([element.bias.values for element in listed]).T),
        matrices=matrices,
        weights=np.array(held.correlation.weights),
        white=of(held.white_noise),
        walk=of(np.nan_to_num(np.array([element.rate_random_walk.values for element in listed]).T)),
    )


def count_of_axes(count: int) -> str:
    """Return ``1 axis`` or ``3 axes``, for messages."""
    return "1 axis" if count == 1 else f"{count} axes"


def fixed_weights(covariance: Array) -> tuple[Array, float]:
    """Return the weights ``C^-1 1 / (1' C^-1 1)`` and the limit ``(1' C^-1 1)^-1/2`` of a covariance, shape (n, n).

    Source: Vaccaro and Zaki, Sensors 17 (2017).
    """
    ones = np.ones(len(covariance))
    raw = np.linalg.solve(covariance, ones)
    return raw / raw.sum(), float(raw.sum() ** -0.5)


def unit_of_angle(unit: str) -> tuple[str, float]:
    """Return the unit of angles for a unit of rates, and the factor from that rate times s to it."""
    known = parse_unit(unit).symbol
    return {"deg/s": ("deg", 1.0), "rad/s": ("rad", 1.0), "deg/h": ("deg", 1 / 3600)}.get(known, (f"{known} s", 1.0))
