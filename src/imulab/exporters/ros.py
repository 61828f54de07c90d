"""ROS: imu_calib's ``a = SM raw - bias``, accelerometers only, and magnetometer_pipeline's ``matrix (raw - bias)``, T.

Source: imu_calib (D. Koch), accel_calib.cpp: ``SM`` holds 9 numbers row by row, ``bias`` 3, subtracted after scaling.
magnetometer_pipeline (M. Pecka), bias_remover.cpp: ``initial_mag_bias_x``, ``_y``, ``_z`` and
``initial_mag_scaling_matrix``, 9 numbers row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.exporters import ExportOptions
from imulab.exporters.magnetometer import field_correction, in_field, quadratic_loss, settle_magnetometers
from imulab.exporters.model import (
    AXES,
    UnitModel,
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
    of_mag, more = _magnetometers(unit, options)
    comments = [
        "ROS imu_calib, " + unit.origin[0],
        unit.origin[1],
        f"a = SM raw - bias, m/s^2, from raw outputs in {accel.unit}",
        "no axes are turned: the result is in the record's axes",
        *lost,
        *more,
    ]
    lines = [f"# {line}" for line in comments]
    lines += ["SM:", *(f"  - {yaml_number(value)}" for value in matrix.ravel())]
    lines += ["bias:", *(f"  - {yaml_number(value)}" for value in bias)]
    return write_one(folder, "imu_calib.yaml", lines + of_mag)


def _magnetometers(unit: UnitModel, options: ExportOptions) -> tuple[list[str], list[str]]:
    """Return the keys of magnetometer_pipeline, and comments on them, none where the unit has no magnetometers."""
    if unit.mag is None:
        return [], []
    if not in_field(unit.mag):
        comment = f"its file has no place for magnetometers with outputs in {unit.mag.unit}: theirs are left out"
        options.tell(f"ros: {comment}")
        return [], [comment]
    mag = field_correction(unit.mag, "ros")
    lost = settle_magnetometers(quadratic_loss(mag.quadratic), "ros", options)
    bias = mag.in_unit("T")
    lines = [f"initial_mag_bias_{axis}: {yaml_number(value)}" for axis, value in zip(AXES, bias, strict=True)]
    lines += ["initial_mag_scaling_matrix:", *(f"  - {yaml_number(value)}" for value in mag.matrix.ravel())]
    return lines, ["magnetometer_pipeline: field = initial_mag_scaling_matrix (raw - initial_mag_bias), T", *lost]
