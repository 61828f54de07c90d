"""A centrifuge record on the device: table of the C core, test vectors, and the drift subtracted from recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.device.tables import DeviceTable, Field, field_of
from imulab.device.unit import VECTORS, DeviceUnit
from imulab.errors import LackingError, RecordError, UnitError
from imulab.procedures.centrifuge.schema import highest_force
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import from_si, parse_unit

# The table of the C core, and the vectors by which exported code tests itself.


_CURVE_UNITS = {"K0": "rad/s/(m/s^2)", "c1": "1/(m/s^2)", "c2": "1/(m/s^2)^2", "direction": "rad"}


def tables_of(record: Calibration) -> tuple[DeviceTable, ...]:
    """Return the table of a centrifuge record.

    Raises
    ------
    RecordError
        The record lacks an axis or the direction of its drift, or has a parameter in another unit.
    """
    axes = [axis for axis in "xy" if f"{axis}_K0" in record.parameters]
    if not axes:
        raise LackingError("the record lacks x_K0")
    for name, parameter in record.parameters.items():
        expected = _CURVE_UNITS.get(name.rpartition("_")[2])
        if expected is not None and parameter.unit != expected:
            raise RecordError(f"the record has {name} in {parameter.unit!r}, expected {expected!r}")
    for axis in axes:
        if f"{axis}_direction" not in record.parameters:
            raise RecordError(
                f"the record has no {axis}_direction: it was made without table_angle, "
                "so that the direction of the drift in the gyroscope is not known"
            )

    def both(name: str) -> Array:
        return np.array(
            [p.value if (p := record.parameters.get(f"{axis}_{name}")) is not None else 0.0 for axis in "xy"]
        )

    highest = highest_force(record)
    table = DeviceTable(
        "centrifuge",
        (
            Field("has", np.array([axis in axes for axis in "xy"], dtype=np.int64)),
            Field("highest", np.array(highest)),
            *(Field(name.lower(), both(name)) for name in ("K0", "c1", "c2")),
            Field("cosine", np.cos(both("direction"))),
            Field("sine", np.sin(both("direction"))),
        ),
        {"axes": axes, "highest": highest},
    )
    return (table,)


def golden(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return random rates under specific forces up to the highest level, and the rates without the drift."""
    force = rng.uniform(-1, 1, (VECTORS, 2)) * float(field_of(table, "highest")) / np.sqrt(2)
    rate = rng.uniform(-1, 1, (VECTORS, 2)) * 0.01  # rad/s
    rate[1, 0] = np.nan
    out, _ = DeviceUnit.of(table).centrifuge(list(force.T), list(rate.T))
    expected = np.column_stack([column for column in out if column is not None])
    scale = float(np.nanmax(np.abs(np.concatenate([rate, expected]))))
    return {"": VECTORS, "scale": scale, "force": force, "rate": rate, "expected": expected}


# The drift of a two-axis gyroscope, subtracted by the C core.


FORCE_COLUMNS = ("accel_x", "accel_y")
_BEYOND = 1.001
"""Factor of the highest level, so that rounding does not exceed it."""


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
        raise recording.lacking("column dtg_x or dtg_y", "dtg_x")
    for name in names:
        if name[-1] not in columns["axes"]:
            raise RecordError(f"the record has no curve for {name} (no {name[-1]}_K0)")
    force = [_force(recording, name) for name in FORCE_COLUMNS]
    # The core subtracts the drift from a rate of zero: so a column keeps the digits of its own unit.
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
    """Return how many samples lie beyond the highest level of the test, and the largest specific force, m/s^2."""
    top = highest_force(record)
    size = np.hypot(*(_force(recording, name) for name in FORCE_COLUMNS))
    size = np.where(np.isfinite(size), size, 0.0)
    return int(np.count_nonzero(size > _BEYOND * top)), float(size.max(initial=0.0))


def beyond_message(record: Calibration, count: int, largest: float) -> str:
    """Return the warning of samples beyond the highest level, the largest in m/s^2."""
    return (
        f"{count} samples beyond {from_si(highest_force(record), 'g'):.4g} g (up to {from_si(largest, 'g'):.4g} g), "
        "the highest level of the record's test: K(a) is extrapolated there"
    )


def _force(recording: Recording, name: str) -> Array:
    if name not in recording:
        why = "the drift needs the level specific force accel_x and accel_y"
        raise recording.lacking(f"column {name}", name, why)
    unit = recording.units[name]
    if parse_unit(unit).quantity != "acceleration":
        raise UnitError(f"{recording.name}: column {name} is in {unit}, but the record needs specific force in m/s^2")
    return recording.si(name)
