"""A centrifuge record applied by the C core: the acceleration-sensitive drift taken off a two-axis gyroscope."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.device.unit import DeviceUnit
from imulab.errors import DataError, RecordError, UnitError
from imulab.procedures.centrifuge.sections import highest_force
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import from_si, parse_unit

FORCE_COLUMNS = ("accel_x", "accel_y")
_BEYOND = 1.001
"""The highest level is not exceeded by its own rounding."""


def apply_centrifuge(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with ``K(a) (a_x cos theta + a_y sin theta)`` subtracted from `dtg_x` and `dtg_y`.

    ``a = hypot(a_x, a_y)`` of the level specific force; units are kept, the rest is unchanged, NaN passes.

    Raises
    ------
    RecordError
        The record has no curve for a column that the recording has.
    DataError
        The recording has neither `dtg_x` nor `dtg_y`, or no `accel_x`, `accel_y`.
    UnitError
        Rates that are in count or V, or forces that are no specific force.
    """
    names = [name for name in ("dtg_x", "dtg_y") if name in recording]
    if not names:
        raise DataError(f"{recording.name}: no column dtg_x or dtg_y; found {' '.join(recording.columns)}")
    for name in names:
        if name[-1] not in columns["axes"]:
            raise RecordError(f"the record has no curve for {name} (no {name[-1]}_K0)")
    force = [_force(recording, name) for name in FORCE_COLUMNS]
    # The drift alone, as the core takes it off a rate of zero, so that a column keeps the digits of its own unit.
    still = np.zeros(len(recording))
    drift, _ = unit.centrifuge(force, [still if f"dtg_{axis}" in names else None for axis in "xy"])
    corrected = {}
    for name in names:
        kept = recording.units[name]
        if parse_unit(kept).quantity != "rate":
            raise UnitError(f"{recording.name}: column {name} is in {kept}, but the record corrects rates in rad/s")
        taken = drift["xy".index(name[-1])]
        assert taken is not None
        corrected[name] = recording.column(name) + from_si(taken, kept)
    return recording.with_columns(corrected, {})


def beyond_levels(record: Calibration, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie beyond the highest level tested, and the largest specific force, m/s^2."""
    top = highest_force(record)
    size = np.hypot(*(_force(recording, name) for name in FORCE_COLUMNS))
    size = np.where(np.isfinite(size), size, 0.0)
    return int(np.count_nonzero(size > _BEYOND * top)), float(size.max(initial=0.0))


def beyond_message(record: Calibration, count: int, largest: float) -> str:
    """Say that so many samples, the largest in m/s^2, lie beyond the highest level."""
    return (
        f"{count} samples beyond {from_si(highest_force(record), 'g'):.4g} g (up to {from_si(largest, 'g'):.1f} g), "
        "the highest level of the record's test: K(a) is extrapolated there"
    )


def _force(recording: Recording, name: str) -> Array:
    if name not in recording:
        raise DataError(
            f"{recording.name}: no column {name}: the drift needs the level specific force accel_x and accel_y; "
            f"found {' '.join(recording.columns)}"
        )
    unit = recording.units[name]
    if parse_unit(unit).quantity != "acceleration":
        raise UnitError(f"{recording.name}: column {name} is in {unit}, but the record needs specific force in m/s^2")
    return recording.si(name)
