"""Records to the YAML files of Kalibr and OpenVINS.

Source: Kalibr, IccSensors.py (IccScaledMisalignedImu) and its result file ``-imu.yaml``.

Source: OpenVINS, "IMU Propagation Derivations" and VioManagerOptions.h (model kalibr; Dw = Tw^-1, Da = Ta^-1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from imulab.columns import triad
from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.model import (
    UnitModel,
    accel_terms,
    gyro_powers_lost,
    held_accelerometers,
    inverse_gain,
    lower_times_rotation,
    one_unit,
    settle_losses,
    write_one,
    yaml_matrix,
    yaml_number,
)
from imulab.exporters.texts import hash_comments
from imulab.records.calibration import Calibration

# Common to both files: noise keys, and the comment on biases.


_KEYS = {
    "accelerometer_noise_density": ("accel", "angle_random_walk", "m/s^2/sqrt(Hz)"),
    "accelerometer_random_walk": ("accel", "rate_random_walk", "m/s^3/sqrt(Hz)"),
    "gyroscope_noise_density": ("gyro", "angle_random_walk", "rad/s/sqrt(Hz)"),
    "gyroscope_random_walk": ("gyro", "rate_random_walk", "rad/s^2/sqrt(Hz)"),
}
_UNITS = {"accel": "m/s^2", "gyro": "rad/s"}


def noise_lines(options: ExportOptions, indent: str) -> list[str]:
    """Return the noise keys and the update rate, or comments in their place.

    The largest of a triad's three axes is taken, since both programs have one number for them.

    Raises
    ------
    OptionError
        What was given is not what ``allan --json`` prints.
    """
    if not options.noise:
        keys = " ".join(_KEYS)
        return [f"{indent}# not known, to be filled in (imulab export --noise FILE): {keys} update_rate"]
    columns = options.noise.get("columns")
    if not isinstance(columns, Mapping):
        raise OptionError(f"{options.noise_file}: lacks 'columns'; expected what 'imulab allan --json' printed")
    lines = []
    for key, (sensor, coefficient, unit) in _KEYS.items():
        per_axis = [_value(columns[name], coefficient, name, options.noise_file) for name in _names(columns, sensor)]
        value = max((coefficient_value for coefficient_value in per_axis if coefficient_value is not None), default=0.0)
        if None in per_axis:  # the largest of the others may not be the largest of all
            lines.append(f"{indent}# {key} is not known: not determined on every axis (imulab allan says why)")
        elif value > 0:
            lines.append(f"{indent}{key}: {yaml_number(value)}  # {unit}, the largest of {len(per_axis)} axes")
        else:
            lines.append(f"{indent}# {key} is not known: {'not resolved' if per_axis else 'not measured'}")
    rate = options.noise.get("sample_rate")
    rate = rate.get("value") if isinstance(rate, Mapping) else rate
    if isinstance(rate, int | float) and rate > 0:
        lines.append(f"{indent}update_rate: {yaml_number(rate)}  # Hz")
    else:
        lines.append(f"{indent}# update_rate is not known")
    return lines


def _names(columns: Mapping[str, Any], sensor: str) -> list[str]:
    return [name for name in triad(sensor) if name in columns]


def _value(column: Any, coefficient: str, name: str, file: str) -> float | None:
    try:
        value = column[coefficient]["value"]
        unit = column["unit"]
    except (KeyError, TypeError):
        raise OptionError(
            f"{file}: lacks {coefficient} of {name}; expected what 'imulab allan --json' printed"
        ) from None
    needed = _UNITS[name.partition("_")[0]]
    if unit != needed:
        raise OptionError(f"{file}: has {name} in {unit!r}; expected {needed!r}")
    if value is None:
        return None
    if not isinstance(value, int | float) or not math.isfinite(value) or value < 0:
        raise OptionError(f"{file}: has {coefficient} of {name} = {value!r}; expected a number of at least 0")
    return float(value)


def bias_lines(unit: UnitModel) -> list[str]:
    """Return the constant biases as comments, in the units of the outputs."""
    lines = ["constant bias has no key here, the program estimates it; as measured:"]
    triads = [("accelerometers", unit.accel), ("gyroscopes", unit.gyro)]
    for name, sensor in triads:
        if sensor is not None:
            values = ", ".join(repr(float(value)) for value in sensor.scale * sensor.bias)
            lines.append(f"b of the {name} = [{values}] {sensor.unit}")
    return lines


def unit_lines(unit: UnitModel) -> list[str]:
    """Return comments that warn of outputs that are not in SI."""
    lines = []
    for name, sensor in (("accelerometers", unit.accel), ("gyroscopes", unit.gyro)):
        if sensor is not None and sensor.unit not in _UNITS.values():
            lines.append(f"the {name}' outputs are in {sensor.unit}: the messages must hold them as they are")
    return lines


def without_nonlinearity(unit: UnitModel, target: str, options: ExportOptions) -> tuple[UnitModel, list[str]]:
    """Return the unit without terms that a full matrix and a bias cannot hold, and the comment on these."""
    accel, error, how = held_accelerometers(unit, inverse_gain, misalignment=True)
    bent = ([], []) if unit.gyro is None else gyro_powers_lost(unit.gyro)
    lost = settle_losses(target, (accel_terms(unit.accel, misalignment=False), error), bent, how=how, options=options)
    if unit.mag is not None:
        comment = "its file has no place for magnetometers: theirs are left out"
        options.tell(f"{target}: {comment}")
        lost.append(comment)
    return replace(unit, accel=accel), lost


# Kalibr's intrinsics: ``a_meas = M a + b``, ``w_meas = M C w + A (C a) + b``, M lower triangular.


def export_kalibr(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
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
    lines = hash_comments(comments)
    lines += ["imu0:", "  T_i_b:", *yaml_matrix(np.eye(4), "  ")]
    lines += ["  accelerometers:", "    M:", *yaml_matrix(accel.gain, "    ")]
    lines += ["  gyroscopes:", "    A:", *yaml_matrix(sensitivity, "    ")]
    lines += ["    C_gyro_i:", *yaml_matrix(rotation, "    "), "    M:", *yaml_matrix(lower, "    ")]
    lines += [*noise_lines(options, "  "), "  model: scale-misalignment", "  rostopic: /imu0", "  time_offset: 0.0"]
    return write_one(folder, "imu.yaml", lines)


# OpenVINS: ``a_meas = Ta R_IMUtoACC a + b``, ``w_meas = Tw R_IMUtoGYRO w + Tg a + b``, Ta and Tw lower triangular.


def export_openvins(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
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
    lines = ["%YAML:1.0", *hash_comments(comments), "", "imu0:", "  T_i_b:", *yaml_matrix(np.eye(4), "    ")]
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
