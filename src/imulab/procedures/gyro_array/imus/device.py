"""The record of a board of whole IMUs on the device: the table of the C core, its test vectors, and how it fuses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.device.imus import NO_LIMIT, ImusStream, imus_table
from imulab.device.tables import DeviceTable, Fusion, field_of, pack
from imulab.errors import OptionError
from imulab.procedures.gyro_array.imus.fuse import board_of, ranges
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import STANDARD_GRAVITY

_SAMPLES = 120  # of the exported self-test
_WELL = 0.01  # uncertainty over size of a rate that float can still compute beyond the gyroscopes' range
_ALIKE = 10.0  # largest over smallest uncertainty of the force: more where most accelerometers are beyond their range


def fusion_of_board(record: Calibration, stated: Mapping[str, Any]) -> Fusion:
    """Return how a unit fuses a board, by the keywords `at`, `gyro_range` and `accel_range` that are stated.

    Raises
    ------
    OptionError
        Another keyword is stated, a range is not positive, or `at` is no point of the board.
    """
    for name in ("method", "memory"):
        if name in stated:
            raise OptionError(f"{name}: for gyros on one axis; whole IMUs take at, gyro_range and accel_range")
    ends = ranges((), stated.get("gyro_range"), stated.get("accel_range"))[:, 0].tolist()
    accel, gyro = (None if end == NO_LIMIT else end for end in ends)
    fusion = Fusion(at=str(stated.get("at", "centroid")), gyro_range=gyro, accel_range=accel)
    board_of(record, fusion.at)
    return fusion


def tables_of_board(record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
    """Return the table of a board; the text beside it holds what only the desk needs, such as latencies.

    Raises
    ------
    RecordError
        The record is of something else, or a matrix cannot be inverted.
    OptionError
        There are too many IMUs for the C core.
    """
    by = fusion or Fusion()
    limits = [[NO_LIMIT if end is None else end] for end in (by.accel_range, by.gyro_range)]
    known = board_of(record, by.at, np.array(limits))
    assert known.settings is not None
    table = imus_table(known.settings)
    columns = {
        **table.columns,
        "at": known.settings.at.tolist(),
        "rate": known.settings.rate,
        "accel_latency": known.latency[0].tolist(),
        "gyro_latency": known.latency[1].tolist(),
        **{
            name: [end if end < NO_LIMIT else None for end in ends.tolist()]
            for name, ends in zip(("accel_range", "gyro_range"), known.limits, strict=True)
        },
    }
    return (DeviceTable(table.kind, table.fields, columns),)


def golden(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return readings of a board that is turned, and what is fused.

    The turn goes beyond the gyroscopes' range where that is known and the accelerometers tell such rates well; it is
    slower where they are beyond theirs. From four IMUs on the last accelerometer is dead for a while, and the first
    gyroscope gives no number.
    """
    end, count = min(filter(None, table.columns["gyro_range"]), default=None), int(table.columns["imus"])
    step = np.full(_SAMPLES, 1 / table.columns["rate"])
    step[0] = 0.0
    noise = rng.standard_normal((_SAMPLES, 2, count, 3))
    for size in (12.0, 3.0) if end is None else (1.2 * end, 0.7 * end, min(0.7 * end, 3.0)):
        readings = _turned(table, size, noise)
        if count > 3:
            readings[40:60, 0, count - 1] = 0.0
            readings[80:85, 1, 0] = np.nan
        out = ImusStream(pack([table], 8), count).process(step, readings)
        if (out.rate_std < _WELL * size).all() and (out.force_std < _ALIKE * out.force_std.min(axis=0)).all():
            break
    stated = (out.force_std, out.rate_std, out.acceleration_std)
    away = field_of(table, "position")
    span = float(np.sqrt(np.square(away - away.mean(axis=0)).sum(axis=1).mean()))
    arm = float(np.linalg.norm(field_of(table, "at") - away.mean(axis=0)))
    force = float(np.nanmax(np.abs(readings[:, 0])))
    return {
        "": _SAMPLES,
        "scale": np.repeat(
            [force * (1 + arm / span), size, force / span, *(float(np.nanmax(v, initial=0.0)) for v in stated)], 3
        ),
        "step": step,
        "reading": readings.reshape(_SAMPLES, -1),
        "fused": np.hstack([out.force, out.rate, out.acceleration, *stated]),
        "flags": out.flags.astype(np.uint32),
    }


def _turned(table: DeviceTable, size: float, noise: Array) -> Array:
    """Return readings in a turn of up to `size` rad/s about each axis, shape (n, 2, K, 3), with noise of that shape."""
    phase = 2 * np.pi * np.linspace(0, 1, _SAMPLES)[:, None] * [1, 2, 3] + [0.3, 1.1, 2.0]
    speed = 2 * np.pi * np.array([1, 2, 3]) * table.columns["rate"] / _SAMPLES
    rate, acceleration, away = size * np.sin(phase), size * speed * np.cos(phase), field_of(table, "position")
    lever = np.cross(acceleration[:, None], away) + np.cross(rate[:, None], np.cross(rate[:, None], away))
    force = STANDARD_GRAVITY * np.sin(phase[:, None, ::-1]) + lever
    accel = np.einsum("kij,nkj->nki", np.linalg.inv(field_of(table, "accel")), force) + field_of(table, "accel_bias")
    gyro = np.einsum("kij,nj->nki", field_of(table, "gyro_rows"), rate) + field_of(table, "gyro_bias")
    deviation = np.stack([field_of(table, "accel_noise"), field_of(table, "gyro_noise")])[:, :, None]
    ends = np.stack([field_of(table, "accel_limit"), field_of(table, "gyro_limit")])[:, :, None]
    readings = np.round(np.stack([accel, gyro], axis=1) + deviation * noise, 6)  # short in the exported file
    return np.asarray(np.clip(readings, -ends, ends))
