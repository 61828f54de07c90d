"""How to wave or turn a magnetometer alone, and the uncertainties that will give.

The covariance of the fit is ``sigma^2 / n`` times the inverse of a reading's mean information (`solve`), over the
directions that the field takes in the body: all headings, and tilts up to a largest one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np

from imulab.errors import OptionError, meant
from imulab.options import choice, measure
from imulab.procedures.magnetometer import FEWEST, TURNS
from imulab.procedures.magnetometer.model import parameter_names
from imulab.procedures.magnetometer.solve import Surface, evaluate, even_directions, pairs, uncertainties
from imulab.procedures.result import PlannedTest, amount
from imulab.quantities import in_si, whole
from imulab.recording import Array
from imulab.report.traces import plain_number
from imulab.units import from_si

_TILTS = (20.0, 30.0, 45.0, 60.0, 90.0, 180.0)  # deg, largest tilts that a plan compares
_COUNTS = (12, 16, 24, 50, 100, 200, 500, 1000, 2000, 5000)
_MOST = 1_000_000
_HEADINGS, _RINGS = 24, 24
_FARTHEST = 180.0


@dataclass(frozen=True)
class PredictedTurn:
    """What some readings with some tilt give: standard uncertainties of hard iron, T, soft iron, |m| and direction.

    `magnitude` is that of |m| where it is largest, as a part of the field; `direction` is in rad.
    """

    readings: int
    tilt: float
    hard: float
    soft: float
    magnitude: float
    direction: float

    def texts(self) -> list[str]:
        """Return hard iron in uT, soft iron and |m| in per cent, and direction in deg, as texts."""
        values = (from_si(self.hard, "uT"), 100 * self.soft, 100 * self.magnitude, float(np.degrees(self.direction)))
        return [plain_number(value, 2) for value in values]


@dataclass(frozen=True, repr=False)
class MagnetometerPlan(PlannedTest):
    """How a magnetometer alone is to be turned.

    Attributes
    ----------
    turn
        ``wave`` or ``level``.
    chosen
        The plan: its number of readings, and what it gives.
    others
        Fewer and more readings, or smaller and larger tilts with as many.
    wanted
        Wanted standard uncertainty of the direction, rad.
    """

    no_file: ClassVar[str] = "a turn by hand has no file"

    turn: str
    chosen: PredictedTurn
    others: tuple[PredictedTurn, ...]
    tilts: tuple[PredictedTurn, ...]
    wanted: float

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the plan in a sentence, and what other numbers of readings give."""
        how = (
            f"{self.chosen.readings} readings evenly around, the unit level: one each "
            f"{plain_number(360 / self.chosen.readings, 2)} deg"
            if self.turn == "level"
            else f"{self.chosen.readings} readings in all headings, tilted up to {np.degrees(self.chosen.tilt):.0f} deg"
        )
        hard, soft, _, direction = self.chosen.texts()
        head = (
            f"{how}; predicted standard uncertainties: hard iron {hard} uT, soft iron {soft} %, direction {direction} "
            f"deg; wanted {plain_number(float(np.degrees(self.wanted)), 2)} deg"
        )
        titles = ["readings", "hard iron, uT", "soft iron, %", "|m| at worst, %", "direction, deg"]
        return head, titles, [[str(each.readings), *each.texts()] for each in self.others]

    def tables(self) -> list[tuple[list[str], list[list[str]]]]:
        """Return what smaller and larger tilts give with as many readings."""
        if not self.tilts:
            return []
        titles = ["tilt up to, deg", "hard iron, uT", "soft iron, %", "|m| at worst, %", "direction, deg"]
        return [(titles, [[f"{np.degrees(each.tilt):.0f}", *each.texts()] for each in self.tilts])]

    def remarks(self) -> list[str]:
        """Return how to turn the unit."""
        how = (
            "Turn the unit level, once around or more; nothing of the upright axis is told."
            if self.turn == "level"
            else "Wave the unit through all directions, each axis up, down and to all sides."
        )
        return ["", f"{how} Stay on one spot, away from steel."]

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""

        def row(each: PredictedTurn) -> dict[str, Any]:
            return {
                "readings": each.readings, "tilt": amount(each.tilt, "rad"), "mag_bias": amount(each.hard, "T"),
                "mag_soft": each.soft, "magnitude": each.magnitude, "direction": amount(each.direction, "rad"),
            }  # fmt: skip

        return {
            "turn": self.turn,
            "wanted": amount(self.wanted, "rad"),
            **row(self.chosen),
            "others": [row(each) for each in self.others],
            "tilts": [row(each) for each in self.tilts],
        }


def plan_magnetometer(
    *,
    turn: Annotated[str, choice(TURNS)] = "wave",
    wanted: Annotated[float | str, measure("angle", "deg")] = "0.2 deg",
    readings: int | str | None = None,
    tilt: Annotated[float | str, measure("angle", "deg")] = "180 deg",
    noise: Annotated[float | str, measure("magnetic field", "uT")] = "0.5 uT",
    field: Annotated[float | str, measure("magnetic field", "uT")] = "48 uT",
    dip: Annotated[float | str, measure("angle", "deg")] = "65 deg",
) -> MagnetometerPlan:
    """Plan how to turn a magnetometer alone: how many readings, how far to tilt, and what that will give.

    Parameters
    ----------
    turn
        How it is turned: wave, through all directions by hand, or level.
    wanted
        Wanted standard uncertainty of the direction of the field. Beside the rotation, which is not told; in rad.
    readings
        Number of readings; as many as are wanted if not given. With independent errors; those within a second share
        theirs.
    tilt
        Largest tilt of the unit. In rad; 180 deg is upside down.
    noise
        Standard deviation of one reading, with the scatter of the field on the way. In T.
    field
        Magnitude of the field. In T.
    dip
        Its dip. In rad.

    Raises
    ------
    OptionError
        An option cannot be used, or the wanted uncertainty is out of reach.

    Examples
    --------
    >>> import imulab as il
    >>> plan = il.plan_magnetometer(turn="level", wanted="1 deg")
    >>> plan.chosen.direction <= plan.wanted
    True
    """
    if turn not in TURNS:
        raise OptionError(f"turn {turn!r}: expected {' or '.join(TURNS)}{meant(TURNS, turn)}")
    target, largest = in_si(wanted, "wanted", "angle", "deg"), in_si(tilt, "tilt", "angle", "deg")
    size, spread = in_si(field, "field", "magnetic field", "uT"), in_si(noise, "noise", "magnetic field", "uT")
    angle = in_si(dip, "dip", "angle", "deg")
    if not (0 < size < 1e-3 and 0 < spread < size and abs(angle) < math.pi / 2):
        raise OptionError("field, noise, dip: expected a field of 25 to 65 uT, noise below it, a dip within 90 deg")
    if not 0 < largest <= math.radians(_FARTHEST) * (1 + 1e-9) or not 0 < target < 1:
        raise OptionError("tilt, wanted: expected a tilt of up to 180 deg, and a wanted uncertainty below 57 deg")
    if turn == "level":
        size, directions = size * math.cos(angle), even_directions(2)
    else:
        directions = _tilted(largest, angle)
    single = _predict(directions, largest, size, spread)
    fewest = FEWEST[directions.shape[1]]
    needed = max(math.ceil((single.direction / target) ** 2), fewest)
    if readings is None and needed > _MOST:
        raise OptionError(
            f"wanted {math.degrees(target):.3g} deg: that takes {needed:.2g} readings; expected a larger tilt, less "
            "noise, or a larger uncertainty"
        )
    count = needed if readings is None else whole(readings, "readings")
    if not fewest <= count <= _MOST:
        raise OptionError(f"readings {count}: expected {fewest} to {_MOST}")
    counts = sorted({*(each for each in _COUNTS if each >= fewest), count})
    tilts = () if turn == "level" else tuple(
        _with_readings(_predict(_tilted(math.radians(each), angle), math.radians(each), size, spread), count)
        for each in _TILTS
    )  # fmt: skip
    return MagnetometerPlan(
        turn, _with_readings(single, count), tuple(_with_readings(single, each) for each in counts), tilts, target
    )


def _with_readings(single: PredictedTurn, count: int) -> PredictedTurn:
    """Return what so many readings give, by what one gives."""
    root = math.sqrt(count)
    return replace(
        single, readings=count, hard=single.hard / root, soft=single.soft / root, magnitude=single.magnitude / root,
        direction=single.direction / root,
    )  # fmt: skip


def _tilted(largest: float, dip: float) -> Array:
    """Return directions of the field in a body in all headings, its up axis tilted up to an angle to all sides."""
    up = 1 - (1 - math.cos(largest)) * (np.arange(_RINGS) + 0.5) / _RINGS
    angle = 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS
    tilt, side, heading = (each.ravel() for each in np.meshgrid(np.arccos(up), angle, angle, indexing="ij"))
    level, down = math.cos(dip), -math.sin(dip)
    # The field in a frame whose x axis is the horizontal direction of the tilt, then tilted about y.
    x, y, z = level * np.cos(heading), level * np.sin(heading), np.full_like(heading, down)
    x, z = np.cos(tilt) * x - np.sin(tilt) * z, np.sin(tilt) * x + np.cos(tilt) * z
    return np.column_stack([np.cos(side) * x - np.sin(side) * y, np.sin(side) * x + np.cos(side) * y, z])


def _predict(directions: Array, tilt: float, field: float, noise: float) -> PredictedTurn:
    """Return what one reading of these directions gives on the average, of a sensor without soft iron."""
    d = directions.shape[1]
    theta = np.concatenate([np.zeros(d), [1.0 if i == j else 0.0 for i, j in pairs(d)]])
    rows = evaluate(theta, directions)[1] / math.sqrt(len(directions))
    surface = Surface(theta, np.zeros(len(rows)), rows, noise / field, 1.0, True)
    spread = np.sqrt(np.diag(surface.covariance))
    soft = [k for k, name in enumerate(parameter_names("xyz"[:d])) if "soft" in name]
    _, magnitude, direction = uncertainties(surface)
    return PredictedTurn(1, tilt, field * float(spread[:d].max()), float(spread[soft].max()), magnitude, direction)
