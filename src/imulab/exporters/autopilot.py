"""What both autopilots take of a unit: an offset and a scale of each accelerometer, and an offset of each gyroscope."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from imulab.exporters import ExportOptions
from imulab.exporters.magnetometer import FieldCorrection, symmetric
from imulab.exporters.model import (
    UnitModel,
    accel_terms,
    gyro_terms,
    held_accelerometers,
    one_unit,
    refuse_raw,
    settle_losses,
)
from imulab.recording import Array
from imulab.records.calibration import Calibration


@dataclass(frozen=True)
class Corrections:
    """``(raw - offset) * scale``, m/s^2, and ``raw - rest``, rad/s, on each axis, shape (3,); rest None without gyros.

    With the magnetometers, None where there are none, and comments on what is left out.
    """

    unit: UnitModel
    offset: Array
    scale: Array
    rest: Array | None
    mag: FieldCorrection | None
    lost: list[str]


def corrections(
    records: Sequence[Calibration], target: str, options: ExportOptions, check: Callable[[Array, Array], None]
) -> Corrections:
    """Return what an autopilot takes of the one record; `check` refuses offsets and scales that it does not take.

    Raises
    ------
    OptionError
        The autopilot cannot hold the record.
    """
    unit = one_unit(records, target)
    refuse_raw(unit, target)
    accel, error, how = held_accelerometers(
        unit, lambda held: lambda output: (output - held.scale * held.bias) / held.scale, misalignment=False
    )
    offset, scale = accel.scale * accel.bias, 1 / accel.scale
    check(offset, scale)
    gyro = unit.gyro
    lost = settle_losses(
        target,
        (accel_terms(unit.accel, misalignment=True), error),
        gyro_terms(gyro, bias=False) if gyro is not None else ([], []),
        how=how,
        options=options,
    )
    mag = None
    if unit.mag is not None:
        mag, left_out = symmetric(unit.mag, target, options, turned=options.mag_mount == "external")
        lost += left_out
    return Corrections(unit, offset, scale, None if gyro is None else gyro.scale * gyro.bias, mag, lost)
