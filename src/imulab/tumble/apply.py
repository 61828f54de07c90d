"""A tumble record applied: raw triad to specific force."""

from __future__ import annotations

import numpy as np

from imulab.calibration import Calibration
from imulab.errors import UnitError
from imulab.recording import Array, Recording
from imulab.tumble.model import AXES, MISALIGNMENTS, invert
from imulab.units import conversion_factor


def apply_tumble(record: Calibration, recording: Recording) -> Recording:
    """Return the recording with accel_* as specific force, m/s^2, in the body frame of the record's gauge.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording has no accelerometer triad.
    """
    unit, needed = recording.triad_unit("accel"), str(record.model["output_unit"])
    try:
        factor = conversion_factor(unit, needed)
    except UnitError:
        raise UnitError(
            f"{recording.name}: columns accel_x accel_y accel_z are in {unit}, "
            f"but the record calibrates outputs in {needed}"
        ) from None
    force = specific_force(record, recording.triad("accel") * factor)
    names = [f"accel_{axis}" for axis in AXES]
    return recording.with_columns(
        {name: np.ascontiguousarray(force[:, i]) for i, name in enumerate(names)},
        dict.fromkeys(names, "m/s^2"),
    )


def specific_force(record: Calibration, output: Array) -> Array:
    """Return the specific force, m/s^2, for outputs in the record's unit; both of shape (n, 3).

    ``A = M / S - b``, the polynomial inverted by Newton's method, then ``f = T^-1 s``; NaN stays in what it touches.
    """
    order = int(record.model["order"])
    scale = np.array([record.value(f"scale_factor_{axis}") for axis in AXES])
    bias = np.array([record.value(f"bias_{axis}") for axis in AXES])
    misalignment = np.array([record.value(f"misalignment_{pair}") for pair in MISALIGNMENTS])
    nonlinearity = np.array([[record.value(f"k{p}_{axis}") for axis in AXES] for p in range(2, order + 1)])
    return invert(output / scale - bias, misalignment, nonlinearity.reshape(order - 1, 3)).force
