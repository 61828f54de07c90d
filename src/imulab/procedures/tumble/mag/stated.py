"""What is known of the field at the place of a test, before there is data: its hemisphere and its dip."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

from imulab.errors import OptionError, quoted
from imulab.procedures.tumble import texts
from imulab.procedures.tumble.choices import HEMISPHERES
from imulab.quantities import in_si

_EQUATOR = math.radians(20.0)
"""The magnetic equator lies within 16 deg of the geographic one."""
_SURE = 4.0
"""Standard uncertainties of a stated dip from which its sign is one of the hemisphere."""

Dip = float | str | tuple[float, float]


@dataclass(frozen=True)
class Place:
    """The hemisphere, ``north`` or ``south``, and the dip with its standard uncertainty, rad; None where unknown."""

    hemisphere: str | None = None
    dip: tuple[float, float] | None = None


def hemisphere_at(latitude: float | str | None) -> str | None:
    """Return the magnetic hemisphere at a latitude, rad or a text; None near the equator, and where none is given."""
    angle = 0.0 if latitude is None else in_si(latitude, "latitude", "angle", "deg")
    return None if abs(angle) < _EQUATOR else "north" if angle > 0 else "south"


def stated_place(hemisphere: str | None, latitude: float | str | None, dip: Dip | None) -> Place:
    """Return what is stated of the field at a place.

    Raises
    ------
    OptionError
        There is no such hemisphere or dip, or they contradict one another.
    """
    if hemisphere is not None and hemisphere not in HEMISPHERES:
        raise OptionError(f"hemisphere {quoted(hemisphere)}: expected north or south")
    known = None if dip is None else stated_dip(dip)
    sides = {"hemisphere": hemisphere, "latitude": hemisphere_at(latitude)}
    if known is not None and abs(known[0]) > _SURE * known[1]:
        sides["dip"] = "north" if known[0] > 0 else "south"
    given = {name: side for name, side in sides.items() if side is not None}
    first = next(iter(given), "")
    for name, side in given.items():
        if side != given[first]:
            raise OptionError(
                f"{name} of the {side}ern hemisphere, {first} of the {given[first]}ern: expected both of one; the dip "
                "is positive where the field points down, in the north"
            )
    return Place(given.get(first), known)


def stated_dip(dip: Dip) -> tuple[float, float]:
    """Return a dip and its standard uncertainty, rad; that of a model of the field where none is given.

    Raises
    ------
    OptionError
        It is none.
    """
    if isinstance(dip, str):
        return texts.dip(dip, "dip")
    value, uncertainty = dip if isinstance(dip, tuple) and len(dip) == 2 else (dip, texts.OF_FIELD_MODELS)
    if not all(isinstance(part, Real) and not isinstance(part, bool) for part in (value, uncertainty)):
        raise OptionError(f"dip {quoted(dip)}: expected rad, rad with a standard uncertainty, or a text '67 deg+-0.2'")
    return texts.check_dip(float(value), float(uncertainty), "dip")
