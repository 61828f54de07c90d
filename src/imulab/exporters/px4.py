"""PX4 parameters: ``(raw - CAL_ACC0_OFF) * CAL_ACC0_SCALE`` in m/s^2, ``raw - CAL_GYRO0_OFF`` in rad/s, on each axis.

Source: PX4 src/lib/sensor_calibration (Accelerometer.hpp, Gyroscope.hpp) and the QGroundControl parameter file: lines
vehicle, component, name, value, type with tabs between; type 6 is int32, 9 is float.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.magnetometer import magnetometers, px4_rows, settle
from imulab.exporters.model import (
    AXES,
    accel_terms,
    gyro_terms,
    held_accelerometers,
    one_unit,
    refuse_raw,
    settle_losses,
    single_precision,
    write_one,
)
from imulab.records.calibration import Calibration

_INT32, _FLOAT = 6, 9
_SCALES = (0.1, 3.0)
_LARGEST_ID = 2**31 - 1


def export(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imulab.params``.

    Raises
    ------
    OptionError
        PX4 cannot hold the record.
    """
    unit = one_unit(records, "px4")
    refuse_raw(unit, "px4")
    gyro = unit.gyro
    accel, error, how = held_accelerometers(
        unit, lambda held: lambda output: (output - held.scale * held.bias) / held.scale, misalignment=False
    )
    scale, offset = 1 / accel.scale, accel.scale * accel.bias
    for axis, value in zip(AXES, scale, strict=True):
        if not _SCALES[0] <= value <= _SCALES[1]:
            raise OptionError(f"px4: scale of axis {axis} is {value:.4g}; PX4 takes {_SCALES[0]} to {_SCALES[1]}")
    if options.device_id > _LARGEST_ID:
        raise OptionError(f"px4: device id {options.device_id}; expected at most {_LARGEST_ID}")
    lost = settle_losses(
        "px4",
        (accel_terms(unit.accel, misalignment=True), error),
        gyro_terms(gyro, bias=False) if gyro is not None else ([], []),
        how=how,
        options=options,
    )
    rows = [("CAL_ACC0_ID", str(options.device_id), _INT32)]
    rows += [(f"CAL_ACC0_{a.upper()}OFF", single_precision(v), _FLOAT) for a, v in zip(AXES, offset, strict=True)]
    rows += [(f"CAL_ACC0_{a.upper()}SCALE", single_precision(v), _FLOAT) for a, v in zip(AXES, scale, strict=True)]
    if gyro is not None:
        rest = gyro.scale * gyro.bias  # what the gyroscopes put out at rest
        rows.append(("CAL_GYRO0_ID", str(options.device_id), _INT32))
        rows += [(f"CAL_GYRO0_{a.upper()}OFF", single_precision(v), _FLOAT) for a, v in zip(AXES, rest, strict=True)]
    mag = magnetometers(unit.record, "px4")
    if mag is not None:
        lost += settle(mag, "px4", options, turned=options.mag_mount == "external")
        rows += [
            (
                name,
                value if isinstance(value, str) else single_precision(value),
                _INT32 if isinstance(value, str) else _FLOAT,
            )
            for name, value in px4_rows(mag, options)
        ]
    unknown = (
        "device id 0: not known; PX4 ignores the calibration until CAL_ACC0_ID is that of the sensor (--device-id)"
    )
    comments = [
        "PX4 parameters, " + unit.origin[0],
        unit.origin[1],
        "corrected = (raw - OFF) * SCALE, m/s^2; gyroscopes: raw - OFF, rad/s; single precision",
        "no axes are turned: the record's axes are taken as the sensor's; PX4's body frame is FRD (-g on z at rest)",
        *(["magnetometers: corrected = ROT (K (raw - OFF)), gauss, K of SCALE and ODIAG"] if mag is not None else []),
        *([unknown] if options.device_id == 0 else []),
        *lost,
        "",
        "Vehicle-Id Component-Id Name Value Type",
    ]
    lines = [f"# {line}".rstrip() for line in comments]
    lines += [f"1\t1\t{name}\t{value}\t{kind}" for name, value, kind in rows]
    if not all(np.isfinite(float(value)) for _, value, _ in rows):
        raise OptionError("px4: a parameter is beyond single precision")
    return write_one(folder, "imulab.params", lines)
