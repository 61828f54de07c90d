"""PX4 parameters: ``(raw - CAL_ACC0_OFF) * CAL_ACC0_SCALE`` in m/s^2, ``raw - CAL_GYRO0_OFF`` in rad/s, on each axis.

A record over temperature fills ``TC_A0_*`` too. Source: PX4 src/lib/sensor_calibration (Accelerometer.hpp,
Gyroscope.hpp), src/modules/temperature_compensation (TemperatureCompensation.cpp) and the QGroundControl parameter
file: lines vehicle, component, name, value, type with tabs between; type 6 is int32, 9 is float.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.autopilot import corrections
from imulab.exporters.magnetometer import px4_rows
from imulab.exporters.model import AXES, single_precision, write_one
from imulab.exporters.temperature import OffsetLaw, offset_law
from imulab.recording import Array
from imulab.records.calibration import Calibration

_INT32, _FLOAT = 6, 9
_SCALES = (0.1, 3.0)
_LARGEST_ID = 2**31 - 1
_THERMAL = (
    "corrected = (raw - X1 d - X2 d^2 - X3 d^3 - OFF) * SCALE, m/s^2, d = T - TREF, T in degC held within TMIN to TMAX",
    "PX4 takes a new temperature only where it has moved by more than 1 K; TC_A_ENABLE needs a reboot",
)
_RATES = "gyroscopes: the same with TC_G, TC_G0 and CAL_GYRO0, rad/s, without SCALE"


def export(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imulab.params``.

    Raises
    ------
    OptionError
        PX4 cannot hold the record.
    """
    if options.device_id > _LARGEST_ID:
        raise OptionError(f"px4: device id {options.device_id}; expected at most {_LARGEST_ID}")
    law = offset_law(records, "px4", options)
    if law is not None:
        return _write(
            folder,
            law.origin,
            _thermal_rows(law, options),
            [*_THERMAL, *([] if law.rest is None else [_RATES]), *law.lost],
            options,
        )
    held = corrections(records, "px4", options, _check)
    device = str(options.device_id)
    values: list[tuple[str, float | str]] = [("CAL_ACC0_ID", device)]
    values += [(f"CAL_ACC0_{a}OFF", v) for a, v in zip("XYZ", held.offset, strict=True)]
    values += [(f"CAL_ACC0_{a}SCALE", v) for a, v in zip("XYZ", held.scale, strict=True)]
    if held.rest is not None:
        values.append(("CAL_GYRO0_ID", device))
        values += [(f"CAL_GYRO0_{a}OFF", v) for a, v in zip("XYZ", held.rest, strict=True)]
    comments = ["corrected = (raw - OFF) * SCALE, m/s^2; gyroscopes: raw - OFF, rad/s; single precision"]
    if held.mag is not None:
        values += px4_rows(held.mag, options)
        comments += ["magnetometers: corrected = ROT (K (raw - OFF)), gauss, K of SCALE and ODIAG"]
    return _write(folder, held.unit.origin, values, [*comments, *held.lost], options)


def _thermal_rows(law: OffsetLaw, options: ExportOptions) -> list[tuple[str, float | str]]:
    _check(law.offset[0], law.scale)
    device = str(options.device_id)
    rows = _over_temperature("A", law, law.offset, device)
    rows.append(("CAL_ACC0_ID", device))
    rows += [(f"CAL_ACC0_{a}OFF", v) for a, v in zip("XYZ", law.offset[0], strict=True)]
    rows += [(f"CAL_ACC0_{a}SCALE", v) for a, v in zip("XYZ", law.scale, strict=True)]
    if law.rest is None:
        return rows
    rows += [*_over_temperature("G", law, law.rest, device), ("CAL_GYRO0_ID", device)]
    return rows + [(f"CAL_GYRO0_{a}OFF", v) for a, v in zip("XYZ", law.rest[0], strict=True)]


def _over_temperature(sensor: str, law: OffsetLaw, offset: Array, device: str) -> list[tuple[str, float | str]]:
    """Return ``TC_A0_*`` or ``TC_G0_*``, whose offset at the reference is in the calibration at one temperature."""
    rows: list[tuple[str, float | str]] = [(f"TC_{sensor}_ENABLE", "1"), (f"TC_{sensor}0_ID", device)]
    rows += [(f"TC_{sensor}0_{k}", v) for k, v in (("TREF", law.reference), ("TMIN", law.low), ("TMAX", law.high))]
    powers = np.vstack([np.zeros(3), offset[1:]])
    return rows + [(f"TC_{sensor}0_X{power}_{axis}", powers[power, axis]) for power in range(4) for axis in range(3)]


def _check(offset: Array, scale: Array) -> None:
    for axis, value in zip(AXES, scale, strict=True):
        if not _SCALES[0] <= value <= _SCALES[1]:
            raise OptionError(f"px4: scale of axis {axis} is {value:.4g}; PX4 takes {_SCALES[0]} to {_SCALES[1]}")


def _write(
    folder: Path,
    origin: Sequence[str],
    values: Sequence[tuple[str, float | str]],
    said: Sequence[str],
    options: ExportOptions,
) -> list[Path]:
    """Write rows of name and value, texts as whole numbers, after comments on what they are."""
    rows = [
        (name, value, _INT32) if isinstance(value, str) else (name, single_precision(value), _FLOAT)
        for name, value in values
    ]
    unknown = (
        "device id 0: not known; PX4 ignores the calibration until CAL_ACC0_ID is that of the sensor (--device-id)"
    )
    comments = [
        "PX4 parameters, " + origin[0],
        origin[1],
        "no axes are turned: the record's axes are taken as the sensor's; PX4's body frame is FRD (-g on z at rest)",
        *([unknown] if options.device_id == 0 else []),
        *said,
        "",
        "Vehicle-Id Component-Id Name Value Type",
    ]
    lines = [f"# {line}".rstrip() for line in comments]
    lines += [f"1\t1\t{name}\t{value}\t{kind}" for name, value, kind in rows]
    if not all(np.isfinite(float(value)) for _, value, _ in rows):
        raise OptionError("px4: a parameter is beyond single precision")
    return write_one(folder, "imulab.params", lines)
