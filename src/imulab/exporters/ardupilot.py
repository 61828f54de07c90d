"""ArduPilot parameters: ``(raw - INS_ACCOFFS) * INS_ACCSCAL`` in m/s^2, ``raw - INS_GYROFFS`` in rad/s, on each axis.

Source: ArduPilot AP_InertialSensor_Backend, _rotate_and_correct_accel (rotate, subtract the offset, scale; since
October 2015, pull request 3029: Copter 3.4, Plane 3.5); over temperature AP_InertialSensor_tempcal.cpp. Lines
``NAME,value``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.autopilot import corrections
from imulab.exporters.magnetometer import ardupilot_rows
from imulab.exporters.model import AXES, single_precision, write_one
from imulab.exporters.temperature import OffsetLaw, offset_law
from imulab.recording import Array
from imulab.records.calibration import Calibration

_LARGEST_OFFSET = 3.5
_SCALES = (0.8, 1.2)
_REFERENCE = 35.0
_THERMAL = (
    "corrected = (raw - P(T) + P(CALTEMP) - OFFS) * SCAL, m/s^2, P = 1e-6 (ACC1 t + ACC2 t^2 + ACC3 t^3), t = T - 35,"
    " T in degC held within TMIN to TMAX",
    "ArduPilot's logs are corrected outputs: record the test with INS_TCAL1_ENABLE 0",
)
_RATES = (
    "gyroscopes: the same with GYR, GYR1_CALTEMP and GYROFFS, rad/s, without SCAL; ArduPilot measures GYROFFS again at "
    "each start unless INS_GYR_CAL is 0"
)


def export(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imulab.param``.

    Raises
    ------
    OptionError
        ArduPilot cannot hold the record.
    """
    law = offset_law(records, "ardupilot", options, _REFERENCE)
    if law is not None:
        return _write(
            folder, law.origin, _thermal_rows(law), [*_THERMAL, *([] if law.rest is None else [_RATES]), *law.lost]
        )
    held = corrections(records, "ardupilot", options, _check)
    rows: list[tuple[str, float]] = [(f"INS_ACCOFFS_{a}", v) for a, v in zip("XYZ", held.offset, strict=True)]
    rows += [(f"INS_ACCSCAL_{a}", v) for a, v in zip("XYZ", held.scale, strict=True)]
    if held.rest is not None:
        rows += [(f"INS_GYROFFS_{a}", v) for a, v in zip("XYZ", held.rest, strict=True)]
    if held.mag is not None:
        rows += ardupilot_rows(held.mag, options)
    comments = [
        "for Copter 3.4, Plane 3.5 and later: corrected = (raw - OFFS) * SCAL, m/s^2; older versions scale first",
        "gyroscopes: raw - OFFS, rad/s; ArduPilot measures these again at each start unless INS_GYR_CAL is 0",
        *(
            ["magnetometers: corrected = K (raw + OFS) after ORIENT, mgauss; for 4.2 and later"]
            if held.mag is not None
            else []
        ),
        *held.lost,
    ]
    return _write(folder, held.unit.origin, rows, comments)


def _thermal_rows(law: OffsetLaw) -> list[tuple[str, float]]:
    caltemp = 0.5 * (law.low + law.high)
    offset = (caltemp - law.reference) ** np.arange(4.0) @ law.offset
    _check(offset, law.scale)
    rows = [("INS_TCAL1_ENABLE", 1.0), ("INS_TCAL1_TMIN", law.low), ("INS_TCAL1_TMAX", law.high)]
    rows += _coefficients("ACC", law.offset)
    rows.append(("INS_ACC1_CALTEMP", caltemp))
    rows += [(f"INS_ACCOFFS_{a}", v) for a, v in zip("XYZ", offset, strict=True)]
    rows += [(f"INS_ACCSCAL_{a}", v) for a, v in zip("XYZ", law.scale, strict=True)]
    if law.rest is None:
        return rows
    rows += _coefficients("GYR", law.rest)
    rows.append(("INS_GYR1_CALTEMP", caltemp))
    rest = (caltemp - law.reference) ** np.arange(4.0) @ law.rest
    return rows + [(f"INS_GYROFFS_{a}", v) for a, v in zip("XYZ", rest, strict=True)]


def _coefficients(sensor: str, powers: Array) -> list[tuple[str, float]]:
    return [
        (f"INS_TCAL1_{sensor}{power}_{a}", 1e6 * value)
        for power in (1, 2, 3)
        for a, value in zip("XYZ", powers[power], strict=True)
    ]


def _write(folder: Path, origin: Sequence[str], rows: Sequence[tuple[str, float]], said: Sequence[str]) -> list[Path]:
    """Write rows of name and value after comments on what they are."""
    comments = [
        "ArduPilot parameters, " + origin[0],
        origin[1],
        "no axes are turned: the record's axes are taken as ArduPilot's body axes (FRD, after the board's rotation)",
        *said,
    ]
    lines = [f"# {line}" for line in comments] + [f"{name},{single_precision(value)}" for name, value in rows]
    return write_one(folder, "imulab.param", lines)


def _check(offset: Array, scale: Array) -> None:
    for axis, s, o in zip(AXES, scale, offset, strict=True):
        if not _SCALES[0] <= s <= _SCALES[1]:
            raise OptionError(
                f"ardupilot: scale of axis {axis} is {s:.4g}; ArduPilot takes {_SCALES[0]} to {_SCALES[1]}"
            )
        if abs(o) > _LARGEST_OFFSET:
            raise OptionError(
                f"ardupilot: offset of axis {axis} is {o:.4g} m/s^2; ArduPilot takes at most {_LARGEST_OFFSET}"
            )
