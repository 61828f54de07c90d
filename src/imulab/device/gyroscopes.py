"""The table of a triad of gyroscopes, and the polynomials that accelerometers and gyroscopes have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.device.tables import DeviceTable, Field, nonzero, values_of, whole
from imulab.errors import RecordError
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor, from_si

HIGHEST_POWER = 5
_BEYOND = 1.05
"""Noise, bias and the Earth's rate do not exceed the largest rate by more."""


def gyro_table(
    scale: Array,
    bias: Array,
    misalignment: Array,
    powers: Array,
    columns: Mapping[str, Any],
    *,
    sensitivity: Array | None = None,
) -> DeviceTable:
    """Return the table of gyroscopes ``M = S (s + k2 s^2 + ... + b + G f)``, ``s = T w``.

    Scale factor S and bias b (3,), T and sensitivity G (3, 3), powers k2 .. ke (e - 1, 3).

    Raises
    ------
    RecordError
        A scale factor is 0.
    """
    fields = [
        Field("has_sensitivity", whole(sensitivity is not None)),
        *([Field("order", whole(len(powers) + 1))] if len(powers) else []),
        Field("gain", 1.0 / nonzero(scale)),
        Field("bias", bias),
        Field("turn", np.linalg.inv(misalignment)),
        *([] if sensitivity is None else [Field("sensitivity", sensitivity)]),
        *(polynomial(powers) if len(powers) else ()),
    ]
    return DeviceTable("gyro", tuple(fields), columns)


def gyro_powers(record: Calibration) -> Array:
    """Return k2 .. ke of the gyroscopes of a record, SI, shape (e - 1, 3); 0 where it has none.

    Raises
    ------
    RecordError
        One is in another unit.
    """
    found = np.zeros((HIGHEST_POWER - 1, 3))
    for row, power in enumerate(range(2, HIGHEST_POWER + 1)):
        for i, axis in enumerate("xyz"):
            if (name := f"gyro_k{power}_{axis}") in record.parameters:
                found[row, i] = values_of(record, [name], "1/(rad/s)" + (f"^{power - 1}" if power > 2 else ""))[0]
    return found[: int(np.max(np.flatnonzero(found.any(axis=1)) + 1, initial=0))]


def polynomial(nonlinearity: Array) -> tuple[Field, Field, Field]:
    """Return the fields of ``s + k2 s^2 + ...``: readings between its turning points, and k2 .. ke, shape (e - 1, 3).

    Raises
    ------
    RecordError
        A coefficient cannot be.
    """
    ends = np.array([monotone_range(nonlinearity[:, axis]) for axis in range(3)])
    largest = float(np.finfo(np.float32).max)
    low, high = (np.clip(ends[:, k], -largest, largest) for k in range(2))
    return Field("low", low), Field("high", high), Field("nonlinearity", nonlinearity)


def monotone_range(nonlinearity: Array) -> tuple[float, float]:
    """Return the readings between the turning points of ``s + k2 s^2 + ...`` next to zero, infinite without any."""
    powers = np.concatenate([[0.0, 1.0], nonlinearity])
    slope = np.polynomial.polynomial.polyder(powers)
    try:
        turns = np.polynomial.polynomial.polyroots(slope)
    except np.linalg.LinAlgError:
        raise RecordError("the record has a nonlinearity that cannot be: it has no turning points") from None
    real = turns[np.abs(turns.imag) < 1e-12 * np.maximum(np.abs(turns), 1.0)].real
    low, high = real[real < 0].max(initial=-np.inf), real[real > 0].min(initial=np.inf)
    ends = [float(np.polynomial.polynomial.polyval(s, powers)) if np.isfinite(s) else s for s in (low, high)]
    return ends[0], ends[1]


def beyond_rates(record: Calibration, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie beyond the largest rate tested by more than 5 %, and the largest rate, rad/s.

    Nothing where the record does not say what was tested.
    """
    if "largest_rate" not in record.model:
        return 0, 0.0
    sizes = [np.zeros(len(recording))]
    for axis in record.model.get("axes", "xyz"):
        if (name := f"gyro_{axis}") in recording:
            factor = conversion_factor(recording.units[name], record.model["gyro_output_unit"])
            rate = recording.column(name) * (factor / record.value(f"gyro_scale_factor_{axis}"))
            sizes.append(np.abs(rate - record.value(f"gyro_bias_{axis}")))
    size = np.fmax.reduce(sizes)
    return int(np.count_nonzero(size > _BEYOND * record.model["largest_rate"]["value"])), float(size.max(initial=0.0))


def beyond_message(record: Calibration, count: int, largest: float) -> str:
    """Say that so many samples, the largest in rad/s, lie beyond the rates of the test."""
    held = "line" if record.model["gyro_order"] == 1 else "polynomial"
    return (
        f"{count} samples beyond {from_si(record.model['largest_rate']['value'], 'deg/s'):.4g} deg/s (up to "
        f"{from_si(largest, 'deg/s'):.4g} deg/s), the largest rate of the record's test: its {held} is extrapolated "
        "there"
    )
