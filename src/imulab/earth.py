"""The Earth's rate in a unit at rest: along the vertical known by the latitude, across it of unknown heading."""

from __future__ import annotations

import math
from dataclasses import dataclass

from imulab.gravity import checked_latitude
from imulab.quantities import in_si
from imulab.units import from_si
from imulab.verdict import Note

EARTH = 7.292115e-5
"""Rate of the Earth, rad/s (WGS 84)."""


@dataclass(frozen=True)
class EarthRate:
    """The Earth's rate at a latitude, rad: north of the equator it points up, south of it down."""

    latitude: float

    @property
    def vertical(self) -> float:
        """Its part along up, rad/s."""
        return EARTH * math.sin(self.latitude)

    @property
    def level(self) -> float:
        """The size of its level part, to the north, rad/s."""
        return EARTH * math.cos(self.latitude)

    def note(self) -> Note:
        """Return what a record says of it."""
        vertical, level = (f"{from_si(rate, 'deg/h'):.1f} deg/h" for rate in (self.vertical, self.level))
        return Note(
            f"gyro: of the Earth's rate at latitude {math.degrees(self.latitude):.4g} deg the vertical part, "
            f"{vertical}, was taken off; the level part, {level}, whose heading is unknown, is in the uncertainties"
        )


def at_latitude(latitude: float | str | None, name: str = "latitude") -> EarthRate | None:
    """Return the Earth's rate at a latitude, rad or a text, None where none is given; `name` is what messages call it.

    Raises
    ------
    OptionError
        It is no latitude.
    """
    return None if latitude is None else EarthRate(checked_latitude(in_si(latitude, name, "angle", "deg"), name))
