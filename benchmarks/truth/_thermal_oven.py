"""Accelerometers in an oven: tables of attitudes at set points and rest ramps, apart from imulab's simulator."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Recording

G = 9.80665
MG = 1e-3 * G
Array = NDArray[np.float64]
POINTS = (-20.0, 0.0, 20.0, 40.0, 60.0)
LOW, HIGH = POINTS[0], POINTS[-1]


@dataclass
class Oven:
    """A unit's laws, drawn at random, and what disturbs its test.

    `behind` K that the element stays behind the thermometer at both ends; `loop` m/s^2 of hysteresis in the middle of
    the range; `scatter` of scale factors and `turn_on` m/s^2 of biases from power cycle to power cycle; `lag` s.
    """

    rng: np.random.Generator
    behind: float = 0.0
    loop: float = 0.0
    scatter: float = 0.0
    turn_on: float = 0.2 * MG
    lag: float = 0.0
    shapes: Array = field(init=False)
    stretch: Array = field(init=False)
    loops: Array = field(init=False)

    def __post_init__(self) -> None:
        """Draw the laws: biases of 20 mg, 0.1 mg/K and a bend, scale factors of 50 ppm/K."""
        bias = self.rng.standard_normal((4, 3)) * (MG * np.array([20.0, 4.0, 1.0, 0.4]))[:, None]
        self.shapes = bias
        self.stretch = self.rng.standard_normal((2, 3)) * np.array([5e-3, 2e-3])[:, None]
        self.loops = self.loop * self.rng.choice([-1.0, 1.0], 3)

    def truth(self, temperature: Array) -> tuple[Array, Array]:
        """Return biases, m/s^2, and scale factors at temperatures, shapes (n, 3)."""
        place = (2 * np.asarray(temperature, dtype=np.float64) - LOW - HIGH) / (HIGH - LOW)
        powers = place[:, None] ** np.arange(4)
        return powers @ self.shapes, 1 + powers[:, :2] @ self.stretch

    def outputs(self, force: Array, temperature: Array, way: float | Array, cycle: tuple[Array, Array]) -> Array:
        """Return outputs, m/s^2, of a unit whose thermometer reads `temperature`; `way` is 1 warming, -1 cooling."""
        place = (2 * temperature - LOW - HIGH) / (HIGH - LOW)
        bias, scale = self.truth(temperature - self.behind * place)
        bias = bias + way * self.loops * (1 - place**2)[:, None]
        sensed: Array = scale * cycle[1] * (force + bias + cycle[0])
        return sensed

    def cycle(self) -> tuple[Array, Array]:
        """Return the offsets of biases and the factors of scale factors of a power cycle."""
        return self.turn_on * self.rng.standard_normal(3), 1 + self.scatter * self.rng.standard_normal(3)

    def soak(self, temperature: float, way: float = 1.0, count: int = 20, *, stated: bool = False) -> Recording:
        """Return a table of attitudes at a set point."""
        up = self.rng.standard_normal((count, 3))
        force = G * up / np.linalg.norm(up, axis=1)[:, None]
        read = temperature + 0.1 * self.rng.standard_normal(count)
        noise = 0.02 * MG
        found = self.outputs(force, read, way, self.cycle()) + noise * self.rng.standard_normal((count, 3))
        columns = {f"accel_{a}": found[:, i] for i, a in enumerate("xyz")}
        columns |= {f"std_accel_{a}": np.full(count, noise) for a in "xyz"} | {"temperature": read}
        units = {name: "degC" if name == "temperature" else "m/s^2" for name in columns}
        head = {"serial": "oven"} | ({"reached_by": "warming" if way > 0 else "cooling"} if stated else {})
        return Recording(columns, units, head, name=f"soak {temperature:g}")

    def ramp(self, number: int, *, back: bool = False, rate: float = 2.0, duration: float = 4800.0) -> Recording:
        """Return a rest ramp with one axis up, from cold to hot, or and back again."""
        time = np.arange(int(duration * rate)) / rate
        share = time / time[-1]
        share = 1 - abs(1 - 2 * share) if back else share
        temperature = LOW + (HIGH - LOW) * share
        up = np.eye(3)[number % 3] * (1 if number % 6 < 3 else -1) + 0.05 * self.rng.standard_normal(3)
        force = np.tile(G * up / np.linalg.norm(up), (len(time), 1))
        slow = np.interp(time - self.lag, time, temperature)
        way = np.where(np.gradient(temperature) >= 0, 1.0, -1.0)
        found = self.outputs(force, slow, way[:, None], self.cycle())
        found = found + 0.5 * MG * self.rng.standard_normal(found.shape)
        read = np.round(temperature + 0.02 * self.rng.standard_normal(len(time)), 2)
        columns = {"time": time, **{f"accel_{a}": found[:, i] for i, a in enumerate("xyz")}, "temperature": read}
        units = {n: "s" if n == "time" else "degC" if n == "temperature" else "m/s^2" for n in columns}
        return Recording(columns, units, {"serial": "oven"}, name=f"ramp {number + 1}")
