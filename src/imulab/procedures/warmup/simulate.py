"""Simulated power cycles in a temperature chamber: a sensor whose inside heats up in three stages, with its truth.

Each sensor has a zero that depends on its own temperature, b(x); that temperature rises after power-on through die,
package and housing: ``x(t) = T + sum_j h_j (1 - exp(-t / tau_j))``. The output at rest is ``b(x(t))``; the warm-up
curve is ``b(x(t)) - b(x(infinity))``. None of the models of `imulab.procedures.warmup.model` has this form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, overload

import numpy as np

from imulab.display import Shown
from imulab.errors import OptionError, listed
from imulab.options import choice, measure, parsed
from imulab.procedures.warmup import LAWS, TEMPERATURES
from imulab.quantities import in_si, temperature_list, whole
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY
from imulab.writers import write_csv

GYRO_AXES = ("gyro_x", "gyro_y", "gyro_z")
ACCEL_AXES = ("accel_x", "accel_y", "accel_z")

_DEG_PER_HOUR = np.pi / 180 / 3600  # rad/s
_MICRO_G = 1e-6 * STANDARD_GRAVITY  # m/s^2
_TAU = np.array([20.0, 60.0, 180.0])  # s: die, package, housing
_TAU_BY_KELVIN = -1e-3  # 1/K: convection is better when warm
_REST = 20.0  # degC for which the time constants are stated
# Self-heating of each stage at each of the six sensors, K.
_HEAT = np.array(
    [[1.2, 3.3, 5.5], [0.9, 3.15, 4.95], [1.65, 3.63, 5.72], [1.1, 3.2, 5.2], [1.0, 3.4, 5.0], [1.4, 3.1, 5.6]]
)
# Slope of the zero with temperature x: smooth, s0 + s1 (x - 6) + s2 (x - 6)^2; bent, m + P tanh((x0 - x) / w).
_SMOOTH = np.array([[21.5, -0.40, -1.8e-3], [19.0, -0.36, -1.6e-3], [24.0, -0.44, -2.0e-3]])  # deg/h/K
_BENT = np.array([[11.5, 25.0, 26.0, 16.0], [10.0, 23.0, 25.0, 17.0], [13.0, 27.0, 27.0, 15.0]])  # deg/h/K, K
_ACCEL = np.array([14.0, -11.0, 18.0]) / 21.5  # (ug/K) / (deg/h/K) of the gyros' laws
_SIZE = np.array([_DEG_PER_HOUR] * 3 + list(_ACCEL * _MICRO_G))
_TURN_ON = np.array([30 * _DEG_PER_HOUR] * 3 + [300 * _MICRO_G] * 3)


def zero_output(temperature: Array, axis: int, law: str) -> Array:
    """Return the zero b of sensor `axis` (0 to 5: gyroscopes, then accelerometers) at its own temperature, SI."""
    x = temperature
    i = axis % 3
    if law == "smooth":
        s0, s1, s2 = _SMOOTH[i]
        y = x - 6.0
        return np.asarray(_SIZE[axis] * (s0 * y + s1 * y**2 / 2 + s2 * y**3 / 3))
    m, p, x0, w = _BENT[i]
    return np.asarray(_SIZE[axis] * (m * x - p * w * np.logaddexp((x - x0) / w, -(x - x0) / w)))


def warmup_truth(time: Array, temperature: float, law: str = "smooth", *, stages: Array | float = 1.0) -> Array:
    """Return the true curves ``b(x(t)) - b(x(infinity))`` of the six sensors, SI, shape (n, 6).

    Parameters
    ----------
    time
        Since power-on, s, shape (n,).
    temperature
        At power-on, degC.
    law
        ``smooth``: the slope of the zero changes evenly with temperature; ``bent``: it changes within 40 K.
    stages
        Factors of the self-heating of the three stages, shape (6, 3) or broadcast; 1 gives the mean curve.
    """
    heat = _HEAT * stages
    tau = _TAU * (1 + _TAU_BY_KELVIN * (temperature - _REST))
    rise = (1 - np.exp(-time[:, None] / tau)) @ heat.T
    settled = heat.sum(axis=1)
    return np.column_stack(
        [
            zero_output(temperature + rise[:, i], i, law) - zero_output(np.array(temperature + settled[i]), i, law)
            for i in range(6)
        ]
    )


def simulate_power_cycle(
    temperature: float,
    *,
    law: str = "smooth",
    duration: float = 600.0,
    sample_rate: float = 10.0,
    repeatability: float = 0.025,
    random_walk: float = 0.3 * np.pi / 180 / 60,
    accel_random_walk: float = 30e-6 * STANDARD_GRAVITY,
    scatter: float = 0.3,
    unit_spread: float = 0.0,
    serial: str = "SIM-0001",
    accel: bool = True,
    seed: int | Sequence[int] = 1,
) -> Recording:
    """Simulate one power cycle on a still table, axes east, up, south.

    Columns time, gyro_* [deg/h], accel_* [m/s^2], temperature. The zeros start anew with each cycle (turn-on to
    turn-on), so that only the curve repeats.

    Parameters
    ----------
    temperature
        Set point of the chamber, degC.
    law
        How the zeros depend on temperature, see `warmup_truth`.
    duration
        s.
    sample_rate
        Hz.
    repeatability
        Standard deviation of the self-heating of each stage from cycle to cycle, as a fraction.
    random_walk, accel_random_walk
        Angle random walk, rad/sqrt(s), and velocity random walk, (m/s^2) sqrt(s).
    scatter
        Standard deviation of the power-on temperature about the set point, K, within 1 K.
    unit_spread
        Standard deviation of the self-heating from unit to unit, as a fraction; the unit is drawn by its serial.
    serial
        Of the unit.
        Whether there are accelerometer columns.
        Whether there are accelerometer columns.
    seed
        Of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range.

    Examples
    --------
    >>> import imulab as il
    >>> il.simulate_power_cycle(-20.0, accel=False).metadata["serial"]
    'SIM-0001'
    """
    _check(temperature, law, duration, sample_rate, repeatability, scatter)
    for name, value in (
        ("random_walk", random_walk), ("accel_random_walk", accel_random_walk), ("unit_spread", unit_spread),
        ("seed", min(np.atleast_1d(seed).tolist(), default=0)),
    ):  # fmt: skip
        if value < 0:
            raise OptionError(f"{name} {value:g}: expected 0 or more")
    rng = np.random.default_rng(seed)
    unit = np.random.default_rng(list(serial.encode()))
    power_on = temperature + float(np.clip(scatter * rng.standard_normal(), -1.0, 1.0))
    stages = (1 + unit_spread * unit.standard_normal((6, 3))) * (1 + repeatability * rng.standard_normal((1, 3)))
    time = np.arange(round(duration * sample_rate)) / sample_rate
    curve = warmup_truth(time, power_on, law, stages=stages)
    noise = np.sqrt(sample_rate) * np.array([random_walk] * 3 + [accel_random_walk] * 3)
    output = curve + _TURN_ON * rng.standard_normal(6) + noise * rng.standard_normal(curve.shape)
    earth = 7.292115e-5 * np.array([0.0, np.sin(0.7), -np.cos(0.7)])
    output += np.concatenate([earth, [0.0, STANDARD_GRAVITY, 0.0]])
    columns = {"time": time}
    columns |= {axis: output[:, i] / _DEG_PER_HOUR for i, axis in enumerate(GYRO_AXES)}
    units = {"time": "s", **dict.fromkeys(GYRO_AXES, "deg/h")}
    if accel:
        columns |= {axis: output[:, 3 + i].copy() for i, axis in enumerate(ACCEL_AXES)}
        units |= dict.fromkeys(ACCEL_AXES, "m/s^2")
    inside = power_on + (1 - np.exp(-time / _TAU[1])) * 8.0
    columns["temperature"] = np.round(inside + 0.02 * rng.standard_normal(len(time)), 2)
    units["temperature"] = "degC"
    metadata = {
        "serial": serial,
        "model": "simulated unit",
        "power_on_temperature": f"{power_on:.3f}",
        "set_point": f"{temperature:g}",
        "law": law,
    }
    return Recording(columns=columns, units=units, metadata=metadata, name=f"simulated cycle at {temperature:g} degC")


def simulate_warmup(
    temperatures: Annotated[Sequence[float] | str, parsed(temperature_list, "T,T,...", unit="degC")] = TEMPERATURES,
    *,
    cycles: int | str = 3,
    law: Annotated[str, choice(LAWS)] = "smooth",
    duration: Annotated[float | str, measure("time", "s")] = "600 s",
    rate: Annotated[float | str, measure("frequency", "Hz")] = "10 Hz",
    units: int | str = 1,
    seed: int | str = 1,
) -> PowerCycles:
    """Simulate the power cycles of a warm-up test, a recording each; see `simulate_power_cycle`.

    Parameters
    ----------
    temperatures
        Calibration temperatures, ascending. Set points of the chamber, degC.
    cycles
        Power cycles at each temperature.
    law
        How the zeros depend on temperature.
    duration
        Duration of each recording. In s.
    rate
        Sample rate. In Hz.
    units
        Number of units of one type. Several differ by 5 % in their self-heating.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range.

    Examples
    --------
    >>> import imulab as il
    >>> cycles = il.simulate_warmup([-40, 0, 60], cycles=2, duration="400 s")
    >>> len(cycles), cycles[0].metadata["set_point"], len(cycles[0])
    (6, '-40', 4000)
    """
    at = temperature_list(temperatures, "temperatures")
    number, many, start = whole(cycles, "cycles"), whole(units, "units"), whole(seed, "seed")
    for name, value, low in (("cycles", number, 1), ("units", many, 1), ("seed", start, 0)):
        if value < low:
            raise OptionError(f"{name} {value}: expected a whole number from {low}")
    seconds, per_second = in_si(duration, "duration", "time", "s"), in_si(rate, "rate", "frequency", "Hz")
    made = PowerCycles(tuple(at), number, law, seconds, per_second, many, start)
    for temperature in at:
        _check(temperature, law, seconds, per_second, 0.0, 0.0)
    return made


@dataclass(frozen=True, repr=False)
class PowerCycles(Shown, Sequence[Recording]):
    """The recordings of a simulated warm-up test, each made when it is read.

    Attributes
    ----------
    temperatures
        Set points, degC.
    cycles
        Power cycles at each set point.
    law, duration, rate, units, seed
        As for `simulate_warmup`, in SI.
    """

    temperatures: tuple[float, ...]
    cycles: int
    law: str
    duration: float
    rate: float
    units: int
    seed: int

    def __len__(self) -> int:
        return self.units * len(self.temperatures) * self.cycles

    @overload
    def __getitem__(self, index: int) -> Recording: ...

    @overload
    def __getitem__(self, index: slice) -> list[Recording]: ...

    def __getitem__(self, index: int | slice) -> Recording | list[Recording]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        number = range(len(self))[index]
        which, cycle = divmod(number, self.cycles)
        unit, i = divmod(which, len(self.temperatures))
        serial, at = f"SIM-{self.seed + unit:04d}", self.temperatures[i]
        made = simulate_power_cycle(
            at, law=self.law, serial=serial, unit_spread=0.0 if self.units == 1 else 0.05,
            seed=[self.seed, unit, i, cycle], duration=self.duration, sample_rate=self.rate,
        )  # fmt: skip
        middle = f"{serial}_" if self.units > 1 else ""
        return replace(made, name=f"cycle_{middle}{at:+g}_{cycle + 1}")

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the test in a sentence."""
        at = " ".join(f"{t:g}" for t in self.temperatures)
        head = f"{len(self)} simulated power cycles of {self.duration:g} s at {at} degC, law {self.law}"
        return head, [], []

    def save(self, folder: str | Path) -> list[Path]:
        """Write a CSV file for each into a folder, which is made if it is not there.

        Raises
        ------
        OptionError
            The folder cannot be made, or a file cannot be written.
        """
        home = Path(folder)
        try:
            home.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OptionError(f"{folder}: the folder cannot be made: {error.strerror}") from None
        files: list[Path] = []
        for recording in self:
            write_csv(recording, home / f"{recording.name}.csv")
            files.append(home / f"{recording.name}.csv")
        return files


def _check(
    temperature: float, law: str, duration: float, sample_rate: float, repeatability: float, scatter: float
) -> None:
    if law not in LAWS:
        raise OptionError(f"law {law!r}: expected one of {listed(LAWS, law)}")
    for name, value, low, high in (
        ("temperature", temperature, -100.0, 200.0),
        ("duration", duration, 60.0, 1e5),
        ("sample rate", sample_rate, 0.5, 1e4),
        ("repeatability", repeatability, 0.0, 0.5),
        ("scatter", scatter, 0.0, 1.0),
    ):
        if not low <= value <= high:
            raise OptionError(f"{name} {value:g}: expected {low:g} to {high:g}")
