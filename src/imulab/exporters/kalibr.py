"""Kalibr's intrinsics: ``a_meas = M a + b``, ``w_meas = M C w + A (C a) + b``, M lower triangular.

Source: Kalibr, IccSensors.py (IccScaledMisalignedImu) and its result file ``-imu.yaml``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.exporters import ExportOptions
from imulab.exporters.model import lower_times_rotation, one_unit, write_one, yaml_matrix
from imulab.exporters.yamlimu import bias_lines, noise_lines, unit_lines, without_nonlinearity
from imulab.records.calibration import Calibration


def export(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imu.yaml``.

    Raises
    ------
    OptionError
        Kalibr cannot hold the record, or the noise file is none.
    """
    unit, lost = without_nonlinearity(one_unit(records, "kalibr"), "kalibr", options)
    accel, gyro = unit.accel, unit.gyro
    rotation, lower, sensitivity = np.eye(3), np.eye(3), np.zeros((3, 3))
    if gyro is not None:
        lower, rotation = lower_times_rotation(gyro.gain)
        sensitivity = gyro.scale[:, None] * gyro.sensitivity @ rotation.T
    comments = [
        "Kalibr IMU intrinsics, " + unit.origin[0],
        unit.origin[1],
        "a_meas = M a + b; w_meas = M C w + A (C a) + b; C is C_gyro_i",
        "no axes are turned: a and w are in the record's axes",
        *unit_lines(unit),
        *([] if gyro is not None else ["the record has no gyroscopes: M and C_gyro_i are the identity, A is 0"]),
        *bias_lines(unit),
        *lost,
    ]
    lines = [f"# {line}" for line in comments]
    lines += ["imu0:", "  T_i_b:", *yaml_matrix(np.eye(4), "  ")]
    lines += ["  accelerometers:", "    M:", *yaml_matrix(accel.gain, "    ")]
    lines += ["  gyroscopes:", "    A:", *yaml_matrix(sensitivity, "    ")]
    lines += ["    C_gyro_i:", *yaml_matrix(rotation, "    "), "    M:", *yaml_matrix(lower, "    ")]
    lines += [*noise_lines(options, "  "), "  model: scale-misalignment", "  rostopic: /imu0", "  time_offset: 0.0"]
    return write_one(folder, "imu.yaml", lines)
