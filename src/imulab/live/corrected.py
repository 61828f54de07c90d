"""What a fresh record makes of the readings that still come: to see that it works."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.columns import triad
from imulab.procedures.apply import Loaded, apply
from imulab.recording import Recording
from imulab.units import STANDARD_GRAVITY


@dataclass(frozen=True)
class Reading:
    """Length of the mean reading of a block, m/s^2, as it came (None for counts) and corrected; and its rate, rad/s."""

    raw: float | None
    length: float
    rate: float | None

    def text(self, gravity: float) -> str:
        """Say it in words, the length against local gravity, m/s^2."""
        off = 1e3 * (self.length - gravity) / STANDARD_GRAVITY
        rate = "" if self.rate is None else f"   rate {np.degrees(self.rate):.3f} deg/s"
        return f"corrected |f| {self.length:.4f} m/s², {off:+.2f} mg from g{rate}"


def corrected_reading(ready: Loaded, block: Recording, *, gyro: bool) -> Reading:
    """Return the reading of a block, raw and corrected, with its rate where the record has gyroscopes.

    Raises
    ------
    DataError
        The record corrects nothing in it.
    """
    after = apply(ready, block)

    def length(of: Recording, sensor: str) -> float:
        return float(np.linalg.norm([of.si(name).mean() for name in triad(sensor)]))

    raw = None if block.units["accel_x"] == "count" else length(block, "accel")
    return Reading(raw, length(after, "accel"), length(after, "gyro") if gyro else None)
