"""ROS imu_calib: ``a = SM raw - bias``, accelerometers only.

Source: imu_calib (D. Koch), accel_calib.cpp: ``SM`` holds 9 numbers row by row, ``bias`` 3, subtracted after scaling.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.exporters import ExportOptions
from imulab.exporters.model import (
    accel_terms,
    gyro_terms,
    held_accelerometers,
    inverse_gain,
    one_unit,
    settle_losses,
    write_one,
    yaml_number,
)
from imulab.records.calibration import Calibration


def export(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imu_calib.yaml``.

    Raises
    ------
    OptionError
        imu_calib cannot hold the record.
    """
    unit = one_unit(records, "ros")
    gyro = unit.gyro
    accel, error, how = held_accelerometers(unit, inverse_gain, misalignment=True)
    matrix = np.linalg.inv(accel.gain)
    bias = np.linalg.solve(accel.matrix, accel.bias)
    lost = settle_losses(
        "ros",
        (accel_terms(unit.accel, misalignment=False), error),
        gyro_terms(gyro, bias=True) if gyro is not None else ([], []),
        how=how,
        options=options,
    )
    comments = [
        "ROS imu_calib, " + unit.origin[0],
        unit.origin[1],
        f"a = SM raw - bias, m/s^2, from raw outputs in {accel.unit}",
        "no axes are turned: the result is in the record's axes",
        *lost,
    ]
    lines = [f"# {line}" for line in comments]
    lines += ["SM:", *(f"  - {yaml_number(value)}" for value in matrix.ravel())]
    lines += ["bias:", *(f"  - {yaml_number(value)}" for value in bias)]
    return write_one(folder, "imu_calib.yaml", lines)
