"""Power cycles in a chamber, simulated apart from imulab: an inside that warms up, and a zero that follows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import imulab as il

DEG_PER_HOUR = np.pi / 180 / 3600
TEMPERATURES = (-40.0, -30.0, -20.0, -10.0, 0.0, 40.0, 50.0, 60.0)
AXES = ("gyro_x", "gyro_y", "gyro_z")


@dataclass(frozen=True)
class Chamber:
    """A unit: zero of an axis at its own temperature x, deg/h, and how its inside warms up."""

    bend: float = 0.0  # height of a bend near 20 degC, deg/h per K
    repeat: float = 0.025  # of the heat of each stage from cycle to cycle
    scatter: float = 0.3  # of power-on temperatures about the set point, K
    walk: float = 0.3  # deg/sqrt(h)
    rate: float = 5.0
    seconds: float = 600.0
    cycles: int = 3
    late: float = 0.0  # s after power-on at which every log begins
    thermometer: bool = False

    def zero(self, x: np.ndarray, axis: int) -> np.ndarray:
        """Zero at the sensor's temperature, deg/h."""
        y = x - 5.0
        smooth = (16.0 + 2 * axis) * y - 0.2 * y**2 - 6e-4 * y**3
        return smooth - self.bend * 15.0 * np.log(np.cosh((x - 22.0) / 15.0))

    def inside(self, time: np.ndarray, power_on: float, stages: np.ndarray | float = 1.0) -> np.ndarray:
        """Temperature of the sensor, degC, shape (n,)."""
        heat = np.array([1.3, 3.1, 5.3]) * stages
        tau = np.array([18.0, 66.0, 170.0]) * (1 - 8e-4 * (power_on - 20.0))
        return power_on + (heat * (1 - np.exp(-time[:, None] / tau))).sum(axis=1)

    def curve(self, time: np.ndarray, power_on: float, stages: np.ndarray | float = 1.0) -> np.ndarray:
        """Zero less its final value, deg/h, shape (n, 3)."""
        x = self.inside(time, power_on, stages)
        final = np.array(power_on + (np.array([1.3, 3.1, 5.3]) * stages).sum())
        return np.stack([self.zero(x, i) - self.zero(final, i) for i in range(3)], axis=1)

    def cycle(self, set_point: float, rng: np.random.Generator, seconds: float | None = None) -> il.Recording:
        """One power cycle."""
        power_on = set_point + float(np.clip(self.scatter * rng.standard_normal(), -0.95, 0.95))
        n = round((seconds or self.seconds) * self.rate)
        time = np.arange(n) / self.rate
        stages = 1 + self.repeat * rng.standard_normal(3)
        z = self.curve(time + self.late, power_on, stages) + 30 * rng.standard_normal(3)
        z = z + self.walk * 60 * np.sqrt(self.rate) * rng.standard_normal(z.shape)
        columns = {"time": time} | {name: z[:, i] for i, name in enumerate(AXES)}
        units = {"time": "s"} | dict.fromkeys(AXES, "deg/h")
        if self.thermometer:
            columns["temperature"] = self.inside(time + self.late, power_on, stages) + 0.02 * rng.standard_normal(n)
            units["temperature"] = "degC"
        return il.Recording(
            columns=columns,
            units=units,
            metadata={"power_on_temperature": f"{power_on:.3f}", "serial": "U1"},
            name=f"cycle_{set_point:+g}.csv",
        )

    def test(self, seed: int, temperatures: tuple[float, ...] = TEMPERATURES) -> list[il.Recording]:
        """All power cycles of a test."""
        rng = np.random.default_rng(seed)
        return [self.cycle(t, rng) for t in temperatures for _ in range(self.cycles)]
