"""OpenVINS: ``a_meas = Ta R_IMUtoACC a + b``, ``w_meas = Tw R_IMUtoGYRO w + Tg a + b``, Ta and Tw lower triangular.

Source: OpenVINS, "IMU Propagation Derivations" and VioManagerOptions.h (model kalibr; Dw = Tw^-1, Da = Ta^-1).
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
    """Write ``kalibr_imu_chain.yaml``.

    Raises
    ------
    OptionError
        OpenVINS cannot hold the record, or the noise file is none.
    """
    unit, lost = without_nonlinearity(one_unit(records, "openvins"), "openvins", options)
    accel, gyro = unit.accel, unit.gyro
    rotation, lower, sensitivity = np.eye(3), np.eye(3), np.zeros((3, 3))
    if gyro is not None:
        lower, rotation = lower_times_rotation(gyro.gain)
        sensitivity = gyro.scale[:, None] * gyro.sensitivity
    comments = [
        "OpenVINS IMU intrinsics, " + unit.origin[0],
        unit.origin[1],
        "a_meas = Ta R_IMUtoACC a + b; w_meas = Tw R_IMUtoGYRO w + Tg a + b",
        "no axes are turned: a and w are in the record's axes",
        *unit_lines(unit),
        *([] if gyro is not None else ["the record has no gyroscopes: Tw and R_IMUtoGYRO are the identity, Tg is 0"]),
        *bias_lines(unit),
        *lost,
    ]
    lines = ["%YAML:1.0", *(f"# {line}" for line in comments), "", "imu0:", "  T_i_b:", *yaml_matrix(np.eye(4), "    ")]
    lines += [*noise_lines(options, "  "), "  rostopic: /imu0", "  time_offset: 0.0", '  model: "kalibr"']
    for key, matrix in (
        ("Tw", lower),
        ("R_IMUtoGYRO", rotation),
        ("Ta", accel.gain),
        ("R_IMUtoACC", np.eye(3)),
        ("Tg", sensitivity),
    ):
        lines += [f"  {key}:", *yaml_matrix(matrix, "    ")]
    return write_one(folder, "kalibr_imu_chain.yaml", lines)
