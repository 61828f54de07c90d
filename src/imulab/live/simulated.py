"""A simulated unit on a simulated table: turned by the guide, by hand, or from one random attitude to the next."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from typing import Any

import numpy as np

from imulab.errors import OptionError, listed
from imulab.procedures.tumble.simulate import simulate_tumble
from imulab.quantities import number, quantity, whole_number
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY, from_si

_LONGEST = 60.0
_STRUCK, _SHIFT = 0.5, 5e-3 * STANDARD_GRAVITY
"""When an attitude is knocked, s after it is put down: before it is accepted; and by how much, m/s^2."""
_KEYS = ("seed", "order", "rate", "noise", "hold", "move", "unit", "gravity", "knock", "gyro", "field", "dip", "speed")
_KINDS = {
    "rate": ("frequency", "Hz"),
    "noise": ("acceleration", "mg"),
    "hold": ("time", "s"),
    "move": ("time", "s"),
    "gravity": ("acceleration", "m/s^2"),
    "field": ("magnetic field", "uT"),
    "dip": ("angle", "deg"),
}


@dataclass
class SimulatedUnit:
    """A unit that is turned while its samples are asked for.

    Attributes
    ----------
    seed, order, rate, noise, move, unit, gravity
        As for `simulate_tumble`, in SI.
    hold
        How long it stays in an attitude where nobody turns it, s.
    knock
        Number of an attitude, from 1, that is knocked as soon as it is put down, or None.
    gyro
        Whether it has gyroscopes, too.
    field, dip
        Magnitude of the magnetic field, T, and its dip, rad, for magnetometers; None without them.
    follow
        Whether `turn_to` turns it; otherwise it turns by itself, until `turn_by_hand` does.
    """

    seed: int = 1
    order: int = 2
    rate: float = 100.0
    noise: float = 0.7e-3 * STANDARD_GRAVITY
    hold: float = 5.0
    move: float = 2.0
    unit: str = "m/s^2"
    gravity: float = STANDARD_GRAVITY
    knock: int | None = None
    gyro: bool = False
    field: float | None = None
    dip: float = math.radians(67.0)
    follow: bool = False
    _held: bool = dataclass_field(default=False, init=False)
    _wanted: Array | None = dataclass_field(default=None, init=False)
    _field_here: Array | None = dataclass_field(default=None, init=False)

    def turn_to(self, direction: Array) -> None:
        """Turn until this direction of the body is up, where it follows."""
        if self.follow and not self._held:
            self._wanted = direction

    def turn_by_hand(self, direction: Array) -> None:
        """Turn until this direction of the body is up; from then on it is turned by hand alone."""
        self._held, self._wanted = True, direction

    def blocks(self, step: float) -> Iterator[Recording]:
        """Yield its samples, `step` seconds at a time, without end."""
        rng = np.random.default_rng(self.seed)
        here = _random_direction(rng)
        known: dict[str, float] = {}
        metadata: dict[str, str] = {}
        size, row, legs = max(1, round(step * self.rate)), 0, 0
        there = here
        while True:
            leg = self._leg(here, there, known, legs)
            if not legs:
                metadata = dict(leg.metadata)
                known = {
                    key.removeprefix("truth_"): float(text)
                    for key, text in metadata.items()
                    if key.startswith("truth_")
                }
            legs, here = legs + 1, there
            stay = round((self.move if legs > 1 else 0.0) * self.rate)
            for start in range(0, len(leg), size):
                part = {name: column[start : start + size] for name, column in leg.columns.items()}
                count = len(part["time"])
                part["time"] = (row + np.arange(count)) / self.rate
                row += count
                yield Recording(part, leg.units, metadata, "simulated unit")
                alone = not (self.follow or self._held)
                if alone and start + size >= stay and (start + size - stay) / self.rate >= self.hold:
                    self._wanted = _random_direction(rng)
                if self._wanted is not None and np.allclose(self._wanted, here):
                    self._wanted = None  # said once more while the unit was being taken up
                if self._wanted is not None and start + size >= stay:
                    break
            there, self._wanted = here if self._wanted is None else self._wanted, None

    def _leg(self, here: Array, there: Array, known: dict[str, float], number: int) -> Recording:
        """Return the samples of turning from one attitude to the next and lying there."""
        recording = simulate_tumble(
            attitudes=np.vstack([here, there]),
            order=self.order,
            truth=known or None,
            gravity=self.gravity,
            rate=self.rate,
            hold=_LONGEST,
            move=self.move,
            noise=self.noise,
            unit=self.unit,
            gyro=self.gyro,
            field=self.field if self._field_here is None else self._field_here,
            dip=self.dip,
            seed=self.seed if not number else 1000 * (self.seed + 1) + number,
        )
        if self.field is not None:
            # The next turn begins with the field where this one leaves it.
            self._field_here = np.array([recording.si(f"truth_mag_{axis}")[-1] for axis in "xyz"])
        resting = round(_LONGEST * self.rate)
        # The first attitude, and one that lasts longer than expected, are lain in without having been turned to.
        first = 0 if not number or np.allclose(here, there) else resting
        names = [name for name in recording.columns if not name.startswith("truth_")]
        last = resting if first == 0 else len(recording)
        columns = {name: recording.columns[name][first:last] for name in names}
        if self.knock == number + 1:
            struck = round((self.move + _STRUCK) * self.rate)
            for axis, up in zip("xyz", there.tolist(), strict=True):
                columns[f"accel_{axis}"][struck:] += from_si(_SHIFT, self.unit) * up
        return replace(recording, columns=columns, units={name: recording.units[name] for name in names})


def simulated_unit(text: str, *, follow: bool) -> tuple[SimulatedUnit, float]:
    """Return a unit and its speed by a text such as ``seed=3,noise=0.5mg,speed=0``.

    Raises
    ------
    OptionError
        A key or value is none.
    """
    given: dict[str, Any] = {}
    for pair in text.split(",") if text else []:
        key, equals, value = (part.strip() for part in pair.partition("="))
        where = f"simulate: {key}"
        if key not in _KEYS or not equals:
            raise OptionError(f"simulate:{text}: expected key=value, the keys being {listed(_KEYS, key)}")
        if key == "unit":
            given[key] = value
        elif key == "speed":
            given[key] = number(value, where)
        elif key in _KINDS:
            given[key] = quantity(value, where, *_KINDS[key])
        else:
            given[key] = whole_number(value, where)
    if given.setdefault("gyro", 0) not in (0, 1):
        raise OptionError(f"simulate: gyro {given['gyro']}: expected 1 (with gyroscopes) or 0")
    given["gyro"] = bool(given["gyro"])
    speed = given.pop("speed", 1.0)
    if not 0 <= speed <= 1e6:
        raise OptionError(f"simulate: speed {speed:g}; expected 0 (as fast as it goes) to 1e6")
    unit = SimulatedUnit(**given, follow=follow)
    replace(unit)._leg(np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), {}, 0)  # refuses what cannot be
    return unit, speed


def _random_direction(rng: np.random.Generator) -> Array:
    direction = rng.standard_normal(3)
    unit: Array = direction / np.linalg.norm(direction)
    return unit
