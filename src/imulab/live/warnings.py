"""What is wrong with a stream or a unit, said when it happens and once, in one sentence with what to do."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from imulab.live.holds import Hold, Moment
from imulab.live.stamps import Counts
from imulab.recording import Array, Recording
from imulab.units import conversion_factor, parse_unit

_FAR = 0.2
"""Part of g by which a unit of MEMS size is never off."""
_UNITS = ("m/s^2", "g", "mg")
_CONSTANT = 3.0
_WARMING, _PER_MINUTE = 5.0, 2.0
_MINUTE = 60.0
_LOST = 0.01
_FEWEST = 500


@dataclass
class Watch:
    """What was said already, and what is needed to tell what is new."""

    said: dict[str, str] = field(default_factory=dict)
    _since: list[float | None] = field(default_factory=lambda: [None] * 3)
    _held: Array = field(default_factory=lambda: np.full(3, np.nan))
    _lively: list[bool] = field(default_factory=lambda: [False] * 3)
    _temperatures: list[tuple[float, float]] = field(default_factory=list)

    def _once(self, key: str, text: str) -> list[str]:
        if key in self.said:
            return []
        self.said[key] = text
        return [text]

    def scatter(self, text: str) -> list[str]:
        """Take why more attitudes help little; empty where they help."""
        return self._once("scatter", text) if text else []

    def hold(self, hold: Hold, unit: str, gravity: float) -> list[str]:
        """Look at the length of f at rest."""
        length = float(np.linalg.norm(hold.mean))
        if parse_unit(unit).quantity != "acceleration":
            return [] if length else self._once("unit", "all three outputs are 0: are the accelerometers on?")
        expected = gravity * conversion_factor("m/s^2", unit)
        if abs(length / expected - 1) <= _FAR:
            return []
        fits = [u for u in _UNITS if abs(length / (gravity * conversion_factor("m/s^2", u)) - 1) <= _FAR]
        asked = f"is its unit {fits[0]}?" if fits else "is its unit right, and its range?"
        return self._once(
            "unit", f"the accelerometers read {length:.4g} {unit} at rest, where {expected:.4g} is expected: {asked}"
        )

    def moment(self, moment: Moment) -> list[str]:
        """Look for an axis that is dead, or that has reached the end of its range."""
        found: list[str] = []
        for k, axis in enumerate("xyz"):
            since, value = self._since[k], float(moment.mean[k])
            if not moment.constant[k] or value != self._held[k]:
                self._lively[k] |= not moment.constant[k]
                self._since[k] = moment.time if moment.constant[k] else None
                self._held[k] = value
                continue
            if since is None or moment.time - since < _CONSTANT or not any(self._lively):
                continue
            if not self._lively[k]:
                found += self._once(
                    f"dead {axis}", f"accel_{axis} has read {value:g} since the beginning: is the axis connected?"
                )
            elif abs(value) >= np.abs(moment.mean).max():
                found += self._once(
                    f"clipped {axis}",
                    f"accel_{axis} stays at exactly {value:g}: clipped? set the unit to a larger range and start again",
                )
        return found

    def block(self, block: Recording, time: float) -> list[str]:
        """Look at the temperature."""
        if "temperature" not in block or block.units["temperature"] not in ("degC", "K"):
            return []
        values = block.column("temperature")
        if not np.isfinite(values).any():
            return []
        now = float(np.nanmean(values))
        last = self._temperatures
        if not last or time - last[-1][0] >= 1.0:
            last.append((time, now))
            del last[1 : max(len(last) - int(_MINUTE), 1)]  # the first, and those of the last minute
        first, minute = last[0][1], last[min(1, len(last) - 1)]
        found = []
        if time - minute[0] > _MINUTE / 2 and abs(now - minute[1]) > _PER_MINUTE:
            found += self._once(
                "temperature rate",
                f"the temperature changes by {now - minute[1]:+.1f} K within a minute: wait until it is steady",
            )
        if abs(now - first) > _WARMING:
            found += self._once(
                "temperature",
                f"the temperature has changed by {now - first:+.1f} K since the beginning: the zeros will have, too",
            )
        return found

    def counts(self, counts: Counts, samples: int) -> list[str]:
        """Look at what the stream has lost."""
        found = []
        came = samples + counts.repeated + counts.reordered + counts.stray
        if counts.stray:
            found += self._once(
                "stray",
                "a sample whose time fits neither those before nor those after is left out, as any more will be: is "
                "the cable all right?",
            )
        if came > _FEWEST:
            for key, number, text in (
                ("lost", counts.lost, f"of {samples + counts.lost} samples are lost: a lower rate, or a faster link?"),
                ("damaged", counts.damaged, "lines or messages were damaged: is the cable all right?"),
                ("repeated", counts.repeated, f"of {came} samples came again and are left out: is each sent once?"),
                (
                    "late",
                    counts.reordered,
                    f"of {came} samples came too late and are left out: a faster link?",
                ),
                (
                    "strays",
                    counts.stray,
                    f"of {came} samples have a time that fits neither those before nor those after and are left out: "
                    "is the cable all right?",
                ),
            ):
                if number > _LOST * samples:
                    found += self._once(key, f"{number} {text}")
        if counts.restarts:
            found += self._once(
                f"restart {counts.restarts}",
                "the device has started again, or its clock was set: is its power or its cable loose?",
            )
        return found
