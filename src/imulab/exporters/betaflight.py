"""Records of magnetometers to the command lines of Betaflight and INAV.

Both take whole counts of the sensor. Betaflight subtracts the hard iron and nothing else, after it has turned the
outputs by align_mag: ``corrected = raw - mag_calibration``. INAV also scales each axis, before it turns them:
``corrected = (raw - magzero) * 1024 / maggain``, where maggain is the field in counts. Neither has parameters for the
off-diagonal soft iron, nor for gyroscopes over temperature.

Source: Betaflight src/main/sensors/compass.c (compassUpdate), INAV src/main/sensors/compass.c (compassUpdate) and
src/main/fc/settings.yaml.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.matrices import largest_quadratic, quadratic_loss, settle_magnetometers
from imulab.exporters.model import magnetometers_alone, one_unit, origin_of, write_one
from imulab.exporters.texts import hash_comments
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import Magnetometers

_LARGEST = 32767  # of both programs' settings, signed 16-bit numbers
_ONE = 1024  # INAV: length of the corrected field
_DIRECTIONS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
_NEGLIGIBLE = 0.1  # deg
"""Error of directions that is left without a word."""


def export_betaflight(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``betaflight.txt``.

    Raises
    ------
    OptionError
        Betaflight cannot hold the record.
    """
    record, mag = _counted(records, "betaflight")
    lost = _settle(mag, np.ones(3), "betaflight", "soft iron", options)
    offset = _whole(mag.hard_iron, "betaflight", "hard iron")
    comment = "magnetometers: corrected = raw - mag_calibration, counts, of outputs logged with mag_calibration 0,0,0"
    return _write(
        folder, "betaflight.txt", record, [comment, *lost], [f"set mag_calibration = {','.join(map(str, offset))}"]
    )


def export_inav(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``inav.txt``.

    Raises
    ------
    OptionError
        INAV cannot hold the record.
    """
    record, mag = _counted(records, "inav")
    field = (1.0 if mag.field is None else mag.field) * np.diag(np.linalg.inv(_symmetric(mag)))
    lost = _settle(mag, 1 / field, "inav", "off-diagonal soft iron", options)
    offset, gain = _whole(mag.hard_iron, "inav", "hard iron"), _whole(field, "inav", "a field")
    comment = (
        f"magnetometers: corrected = (raw - magzero) * {_ONE} / maggain, of outputs logged with magzero 0 and maggain "
        f"{_ONE}, in the axes of the sensor; maggain is the field in counts"
    )
    lines = [f"set magzero_{axis} = {value}" for axis, value in zip("xyz", offset, strict=True)]
    lines += [f"set maggain_{axis} = {value}" for axis, value in zip("xyz", gain, strict=True)]
    return _write(folder, "inav.txt", record, [comment, *lost], lines)


def _counted(records: Sequence[Calibration], target: str) -> tuple[Calibration, Magnetometers]:
    """Return the record and its magnetometers, whose outputs are counts.

    Raises
    ------
    OptionError
        It has none, or their outputs are a field.
    """
    alone = magnetometers_alone(records, target)
    if alone is None:
        unit = one_unit(records, target)
        if unit.mag is None:
            raise OptionError(f"{target}: holds magnetometers only, and the record has none (imulab tumble mag)")
        record, mag = unit.record, unit.mag
    else:
        record, mag = alone
    if mag.unit != "count":
        raise OptionError(
            f"{target}: subtracts counts of the sensor, but the record has outputs in {mag.unit}; fit the counts that "
            "the flight controller logs (--unit mag=count)"
        )
    return record, mag


def _symmetric(mag: Magnetometers) -> Array:
    """Return the soft iron in the axes of the sensor: W without the rotation into the body, shape (3, 3)."""
    _, sizes, axes = np.linalg.svd(mag.soft_iron)
    return np.asarray(axes.T @ np.diag(sizes) @ axes, dtype=np.float64)


def _settle(mag: Magnetometers, scale: Array, target: str, what: str, options: ExportOptions) -> list[str]:
    """Refuse what scales of the axes alone lose, or return the comments on it."""
    left = scale[:, None] * np.linalg.inv(_symmetric(mag)) @ _DIRECTIONS.T
    cosine = np.sum(left * _DIRECTIONS.T, axis=0) / np.linalg.norm(left, axis=0) / np.linalg.norm(_DIRECTIONS, axis=1)
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)).max()))
    lost = [f"{what}, which turns directions by up to {angle:.2g} deg"] if angle > _NEGLIGIBLE else []
    return settle_magnetometers([*lost, *quadratic_loss(largest_quadratic(mag))], target, options)


def _whole(values: Array, target: str, what: str) -> list[int]:
    """Return values as whole counts; raises OptionError where one is beyond a 16-bit number."""
    if not np.abs(values).max() <= _LARGEST:
        raise OptionError(f"{target}: takes at most {_LARGEST} counts of {what}, found {np.abs(values).max():.4g}")
    return [round(float(value)) for value in values]


def _write(folder: Path, name: str, record: Calibration, comments: Sequence[str], lines: Sequence[str]) -> list[Path]:
    """Write the command lines, which are typed or pasted into the program's command line."""
    turned = "how the sensor is turned on the board is align_mag, set by hand"
    head = hash_comments([*origin_of(record), *comments, turned])
    return write_one(folder, name, [*head, *lines, "save"])
