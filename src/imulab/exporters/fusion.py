"""x-io Fusion: ``misalignment (sensitivity . (raw - offset))``, and ``softIronMatrix (raw - hardIronOffset)``.

Source: Fusion (S. Madgwick), FusionCalibration.h of 1.2, FusionModel.h from 1.3 on: the same formulas, g and deg/s.
Before 1.2 FusionCalibrationMagnetic was ``softIronMatrix raw - hardIronOffset``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.exporters import ExportOptions
from imulab.exporters.magnetometer import (
    field_correction,
    in_field,
    largest_quadratic,
    quadratic_loss,
    settle_magnetometers,
)
from imulab.exporters.model import (
    accel_terms,
    gyro_terms,
    held_accelerometers,
    inverse_gain,
    one_unit,
    settle_losses,
    single_precision,
    write_one,
)
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import Accelerometers, Gyroscopes, Magnetometers
from imulab.units import conversion_factor, parse_unit

_ENGINEERING = {"m/s^2": "g", "rad/s": "deg/s"}


def export(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imulab_fusion.h``.

    Raises
    ------
    OptionError
        Fusion cannot hold the record.
    """
    unit = one_unit(records, "fusion")
    accel, error, how = held_accelerometers(unit, inverse_gain, misalignment=True)
    gyro = unit.gyro
    names, costs = gyro_terms(gyro, bias=False) if gyro is not None else ([], [])
    drift = [cost for cost in costs if "within" in cost]
    lost = settle_losses(
        "fusion",
        (accel_terms(unit.accel, misalignment=False), error),
        ([name for name in names if name.startswith(("gyro_g_sensitivity", "gyro_k"))], drift),
        how=how,
        options=options,
    )
    lines = _inertial("accelerometer", accel, "m/s^2")
    lines += _inertial("gyroscope", gyro, "rad/s") if gyro is not None else []
    if unit.mag is not None:
        lost += settle_magnetometers(quadratic_loss(largest_quadratic(unit.mag)), "fusion", options)
        lines += _magnetic(unit.mag)
    comments = [
        "x-io Fusion, " + unit.origin[0],
        unit.origin[1],
        "include it behind Fusion.h: for FusionModelInertial and FusionModelMagnetic, or before 1.3",
        "FusionCalibrationInertial and FusionCalibrationMagnetic",
        "calibrated = Misalignment (Sensitivity . (raw - Offset))",
        *(["magnetometers: calibrated = softIronMatrix (raw - hardIronOffset)"] if unit.mag is not None else []),
        "no axes are turned: the results are in the record's axes",
        *lost,
    ]
    head = ["/*", *(f" * {line}" for line in comments), " */", "#ifndef IMULAB_FUSION_H", "#define IMULAB_FUSION_H", ""]
    return write_one(folder, "imulab_fusion.h", [*head, *lines, "#endif"])


def _inertial(name: str, triad: Accelerometers | Gyroscopes, si: str) -> list[str]:
    """Return the constants of a triad whose outputs are in SI, and taken in g or deg/s; or in counts or volts."""
    engineering = _ENGINEERING[si]
    result = conversion_factor(si, engineering)
    raw = engineering if triad.unit == si else triad.unit
    taken = result if triad.unit == si else 1.0
    return [
        f"/* raw in {raw}, calibrated in {engineering} */",
        _matrix(f"{name}Misalignment", np.asarray(np.linalg.inv(triad.matrix), dtype=np.float64)),
        _vector(f"{name}Sensitivity", result / taken / triad.scale),
        _vector(f"{name}Offset", taken * triad.scale * triad.bias),
        "",
    ]


def _magnetic(mag: Magnetometers) -> list[str]:
    """Return the constants of magnetometers: in uT; or of raw counts or volts, in uT where the field is known."""
    raw, calibrated = mag.unit, "uT"
    if in_field(mag):
        held = field_correction(mag, "fusion")
        raw, soft, hard = "uT", held.matrix, held.in_unit("uT")
    elif mag.field is not None:
        soft, hard = mag.soft_iron / parse_unit("uT").factor, mag.hard_iron
    else:
        calibrated, soft, hard = "units of the local field", mag.soft_iron, mag.hard_iron
    return [
        f"/* raw in {raw}, calibrated in {calibrated} */",
        _matrix("softIronMatrix", soft),
        _vector("hardIronOffset", hard),
        f"/* before Fusion 1.2, softIronMatrix raw - hardIronOffset: hardIronOffset = {_numbers(soft @ hard)} */",
        "",
    ]


def _numbers(values: Array) -> str:
    return "{" + ", ".join(f"{single_precision(value)}f" for value in values) + "}"


def _matrix(name: str, matrix: Array) -> str:
    return f"static const FusionMatrix {name} = {{{{{', '.join(_numbers(row) for row in matrix)}}}}};"


def _vector(name: str, values: Array) -> str:
    return f"static const FusionVector {name} = {{{_numbers(values)}}};"
