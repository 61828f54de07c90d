"""What code reads of a gyro array's record, a calibration or a comparison of methods, with types."""

from __future__ import annotations

from typing import Annotated, TypeVar

import numpy as np

from imulab.errors import LackingError, RecordError
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.sections import Above0, Length, Part, Positive, Quantity, holds, part

T = TypeVar("T")
PerAxis = Annotated[list[T], "axes"]
PerElement = Annotated[list[T], "elements"]
_LEAST_WHITE = 0.05  # of the mean noise: no element is believed to be quieter, as in the core
Square = Annotated[list[Annotated[list[float], "elements"]], "elements"]


class ArrayModel(Part):
    """``model``; `units`, `truth` and `calibrated` of a comparison, `aligned` and `gauge` of a calibration."""

    kind: str
    elements: int
    axes: PerAxis[str]
    aligned: bool
    gauge: str | None
    unit: str
    units: PerAxis[str]
    truth: str
    calibrated: bool
    temperature: Quantity | None = None


class ArraySummary(Part):
    """``fit``; `slower_noise` is by what factor noise too slow to show could enlarge the biases' uncertainties."""

    sample_rate: Above0
    duration: Above0
    slower_noise: Positive | None = None


class PerGyro(Part):
    """A number of an element: one where it has one axis, a list over x, y, z where it has three."""

    value: PerAxis[float | None] | float | None
    standard_uncertainty: PerAxis[float | None] | float | None
    unit: str

    @property
    def values(self) -> Array:
        """The values, shape (axes,), nan where there is none."""
        return np.atleast_1d(np.array(self.value, dtype=np.float64))

    @property
    def uncertainties(self) -> Array:
        """The standard uncertainties, likewise."""
        return np.atleast_1d(np.array(self.standard_uncertainty, dtype=np.float64))


class Matrix(Part):
    """The alignment of an element of three axes."""

    value: PerAxis[PerAxis[float]]
    standard_uncertainty: PerAxis[PerAxis[float]]
    unit: str


class Element(Part):
    """One of ``elements``."""

    name: str
    bias: PerGyro
    scale_factor: Quantity | None = None
    matrix: Matrix | None = None
    residual: PerGyro | None = None
    angle_random_walk: PerGyro
    bias_instability: PerGyro
    rate_random_walk: PerGyro
    quantisation: PerGyro

    @property
    def alignment(self) -> Array:
        """The matrix from readings to rates, shape (axes, axes); one axis has the inverse of its scale factor."""
        if self.matrix is not None:
            return np.array(self.matrix.value)
        if self.scale_factor is None or not self.scale_factor.value:
            raise LackingError(f"the record lacks the matrix or scale factor of element {self.name}")
        return np.array([[1 / self.scale_factor.value]])


class Correlation(Part):
    """``correlation``: the noise that elements share on each axis, and the weights that it asks for."""

    averaging_time: Above0
    matrix: PerAxis[Square]
    covariance: PerAxis[Square]
    standard_uncertainty: PerAxis[Square]
    weights: PerAxis[PerElement[float]]
    limit: PerAxis[Length]


class ElementCurve(Part):
    """A curve of Allan deviation over averaging time, s."""

    tau: list[Positive]
    deviation: list[float]


class CalibrationData(Part):
    """``data`` of a calibration."""

    allan: PerAxis[PerElement[ElementCurve]]


class ArrayRecord(Part):
    """The record of a calibration."""

    model: ArrayModel
    fit: ArraySummary
    elements: PerElement[Element]
    correlation: Correlation
    data: CalibrationData

    @property
    def white_noise(self) -> Array:
        """Return the angle random walk of each element, rad/s s^1/2, shape (axes, n).

        Where it is not determined, or next to nothing, it is what the covariance at its averaging time would be as
        white noise: a weight needs a size.
        """
        variance = np.array([np.diag(matrix) for matrix in np.array(self.correlation.covariance)])
        size: Array = np.sqrt(variance * self.correlation.averaging_time.value)
        white = np.array([element.angle_random_walk.values for element in self.elements]).T
        known: Array = np.where(np.isnan(white), size, np.maximum(white, _LEAST_WHITE * size))
        return known


class MethodRow(Part):
    """The figures of one method on one axis; rates in the unit of the readings, angles in that unit times s.

    ``rate_std`` has the mean removed; ``angle_*`` are of the integral of the rate error; ``reduction`` is the mean of
    rate_std over the single gyros that work, over this one (None where the output does not change at all);
    ``over_limit`` the noise from sample to sample over (1' C^-1 1)^-1/2; ``bandwidth`` in Hz at -3 dB, half the
    sampling rate where nothing is filtered; ``split_half`` the standard deviation of the difference of the two halves.
    """

    rate_std: float
    rate_max: float
    angle_std: float
    angle_max: float
    reduction: float | None
    over_limit: float
    bandwidth: float
    split_half: float | None = None


class HealthCurves(Part):
    """Weights and flags of each gyro over time, s; nothing where the method robust failed."""

    time: Annotated[list[float], "times"]
    weight: Annotated[list[PerAxis[PerElement[float | None]]], "times"]
    flags: Annotated[list[PerAxis[PerElement[int]]], "times"]

    @property
    def known(self) -> bool:
        """Whether there are any."""
        return holds(self, "time")


class ComparisonData(Part):
    """``data`` of a comparison, by method; a method that failed has the reason as text."""

    figures: dict[str, PerAxis[MethodRow] | str]
    allan: dict[str, PerAxis[ElementCurve]]
    angle: dict[str, PerAxis[Annotated[list[float], "trace"]]]
    trace_time: Annotated[list[float], "trace"]
    health: HealthCurves
    single: PerAxis[float]
    working: PerAxis[list[str]] | None = None
    readings_names: PerAxis[PerElement[str]]


class ComparisonRecord(Part):
    """The record of a comparison."""

    model: ArrayModel
    fit: ArraySummary
    data: ComparisonData


def model_of(record: Calibration) -> ArrayModel:
    """Return the section ``model``; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, ArrayModel, "model")


def comparison_of(record: Calibration) -> ComparisonRecord:
    """Return the sections of a comparison; errors as for `model_of`."""
    return part(record, ComparisonRecord)


def array_of(record: Calibration) -> ArrayRecord:
    """Return the sections of a calibration; errors as for `model_of`.

    Raises
    ------
    RecordError
        Its elements have another number of axes than it says, or noise without size.
    """
    array = part(record, ArrayRecord)
    many = holds(array, "model") and holds(array.model, "axes") and len(array.model.axes) > 1
    for number, element in enumerate(array.elements if holds(array, "elements") else ()):
        values = {name: getattr(element, name) for name in element.__struct_fields__ if holds(element, name)}
        for name, value in values.items():
            stated = ("value", "standard_uncertainty") if isinstance(value, PerGyro) else ()
            for part_of in (key for key in stated if holds(value, key)):
                if isinstance(getattr(value, part_of), list) is not many:
                    raise RecordError(
                        f"elements[{number}].{name}.{part_of}: expected "
                        f"{'a list over the axes' if many else 'a number'}"
                    )
    known = holds(array, "correlation") and holds(array.correlation, "covariance")
    for axis, matrix in enumerate(array.correlation.covariance if known else ()):
        if not all(row[i] > 0 for i, row in enumerate(matrix)):
            raise RecordError(f"correlation.covariance[{axis}]: expected variances above 0")
    return array


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    kind = record.model.get("kind")
    if kind == "comparison":
        comparison_of(record)
    elif kind == "imus":
        from imulab.procedures.gyro_array.imus.schema import imus_of

        imus_of(record)
    else:
        array_of(record)
