"""Whole IMUs on one board in the C core: their table, and the stream that fuses their readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import imulab.device._runtime as _runtime
from imulab.device.tables import DeviceTable, Field, pack, whole
from imulab.errors import DataError, OptionError, RecordError
from imulab.recording import Array

MOST_IMUS = 32  # IL_IMUS of the C core
GATE = 30.664849706213795
"""Chi-square of three degrees of freedom that one triad in a million exceeds: ``scipy.stats.chi2.isf(1e-6, 3)``."""
NO_LIMIT = 1e30
_STUCK, _QUIET = 0.5, 1.0  # s
_WITHIN = 1 - 1e-6  # of a range: a reading at its end, or the end itself, may be rounded to float


@dataclass(frozen=True)
class ImusSettings:
    """Calibration of K IMUs, SI, and how they are fused.

    Accelerometers read ``accel (s + (W^2 + [al]x) position) + accel_bias``, gyroscopes ``gyro w + gyro_bias``.

    Attributes
    ----------
    accel, gyro
        Shape (K, 3, 3).
    accel_bias, gyro_bias, position
        m/s^2, rad/s and m, shape (K, 3).
    accel_noise, gyro_noise
        Standard deviation of a reading, m/s^2 and rad/s, shape (K,).
    accel_limit, gyro_limit
        Size of a reading at the end of the range, shape (K,); ``NO_LIMIT`` where it is not known.
    at
        Where the specific force is wanted, m, shape (3,).
    rate
        Samples per second, which turns times into samples.
    """

    accel: Array
    accel_bias: Array
    accel_noise: Array
    gyro: Array
    gyro_bias: Array
    gyro_noise: Array
    position: Array
    at: Array
    accel_limit: Array
    gyro_limit: Array
    rate: float = 100.0

    @property
    def count(self) -> int:
        """Number of IMUs."""
        return len(self.position)


def imus_table(settings: ImusSettings) -> DeviceTable:
    """Return the table of a board's settings.

    Raises
    ------
    OptionError
        There are too few or too many IMUs.
    RecordError
        A matrix cannot be inverted.
    """
    s, count = settings, settings.count
    if not 2 <= count <= MOST_IMUS:
        raise OptionError(f"{count} IMUs: expected 2 to {MOST_IMUS}")
    for name, matrices in (("accelerometers", s.accel), ("gyroscopes", s.gyro)):
        bad = np.flatnonzero(~(np.linalg.cond(matrices) < 1e3))
        if bad.size:
            raise RecordError(f"IMU {bad[0] + 1}: the matrix of its {name} cannot be inverted")
    words = {
        "count": count,
        "stuck": max(round(_STUCK * s.rate), 20),
        "quiet": max(round(_QUIET * s.rate), 8),
    }
    numbers = {"gate": np.array(GATE), "at": s.at}
    pointed = {
        "position": s.position,
        "accel": np.linalg.inv(s.accel),
        "accel_bias": s.accel_bias,
        "accel_noise": s.accel_noise,
        "accel_limit": _WITHIN * s.accel_limit,
        "gyro": np.linalg.inv(s.gyro),
        "gyro_bias": s.gyro_bias,
        "gyro_noise": s.gyro_noise,
        "gyro_limit": _WITHIN * s.gyro_limit,
        "gyro_rows": s.gyro,
    }
    fields = [Field(name, whole(value)) for name, value in words.items()]
    fields += [Field(name, np.asarray(value, dtype=np.float64)) for name, value in numbers.items()]
    fields += [Field(name, np.asarray(value, dtype=np.float64), pointed=True) for name, value in pointed.items()]
    return DeviceTable("imus", tuple(fields), {"imus": count})


@dataclass(frozen=True)
class FusedImus:
    """Fused samples, (m, 3) each: `force` [m/s^2], `rate` [rad/s], `acceleration` [rad/s^2] and their uncertainties.

    `flags` (m,) and `health` (m, 2, K) of accelerometers and gyroscopes are bits of ``imulab.device.unit``.
    """

    force: Array
    rate: Array
    acceleration: Array
    force_std: Array
    rate_std: Array
    acceleration_std: Array
    flags: NDArray[np.uint8]
    health: NDArray[np.uint8]


class ImusStream:
    """Fusion of whole IMUs with the core's state, so that blocks give the same as one call over the whole.

    Parameters
    ----------
    blob
        The bytes of `imulab.device.tables.pack`, or of an exported blob, with a section of whole IMUs.

    Raises
    ------
    RecordError
        The core refuses them.
    """

    def __init__(self, blob: bytes, count: int) -> None:
        try:
            self._unit = _runtime.load(blob)
            self._state = _runtime.imus_start(self._unit)
        except ValueError as error:
            raise RecordError(f"the fusion of whole IMUs cannot run: {error}") from None
        self.count = count

    @classmethod
    def of(cls, settings: ImusSettings) -> ImusStream:
        """Return the stream of these settings, in double."""
        return cls(pack([imus_table(settings)], 8), settings.count)

    def process(self, step: Array, readings: Array) -> FusedImus:
        """Fuse the next samples.

        Parameters
        ----------
        step
            s since the sample before, shape (m,); 0 where that is not known.
        readings
            Accelerometers [m/s^2], then gyroscopes [rad/s], shape (m, 2, K, 3).

        Raises
        ------
        DataError
            The shape does not fit.
        RecordError
            The board has another number of IMUs.
        """
        block = np.ascontiguousarray(readings, dtype=np.float64)
        if block.shape[1:] != (2, self.count, 3) or np.shape(step) != (len(block),):
            raise DataError(f"expected readings of shape (m, 2, {self.count}, 3) and m steps, found {block.shape}")
        numbers, flags = np.empty((len(block), 6, 3)), np.empty(len(block), dtype=np.uint8)
        health = np.empty((len(block), 2, self.count), dtype=np.uint8)
        steps = np.ascontiguousarray(step, dtype=np.float64)
        try:
            _runtime.imus_block(self._unit, self._state, steps, block, numbers, flags, health)
        except ValueError:  # a blob whose text was changed
            raise RecordError(f"the blob's table and its text, which says {self.count} IMUs, differ") from None
        force, rate, acceleration, *stated = (numbers[:, k] for k in range(6))
        return FusedImus(force, rate, acceleration, stated[0], stated[1], stated[2], flags, health)
