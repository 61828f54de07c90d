"""A simulated unit over temperature: tumbles at set points of a chamber, and rest ramps, with true parameters.

The equation of the model stands here a second time, so that fit and simulation do not share errors.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, overload

import numpy as np

from imulab.display import Shown
from imulab.errors import OptionError, listed
from imulab.files import write_text
from imulab.options import choice, measure, parsed
from imulab.procedures.thermal import LAWS, TEMPERATURES
from imulab.quantities import in_si, temperature_list, whole
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY
from imulab.writers import write_csv

_ZERO = 20.0  # degC about which the laws are powers
_SIZES = {
    "bias": (0.05, 3e-4, 4e-6, 4e-8),  # g, g/K, ...
    "scale_factor": (0.02, 1e-4, 1e-6, 0.0),
    "misalignment": (0.02, 1e-5, 0.0, 0.0),
}
_ROUGH = 3e-4  # g; bends of some 25 K on top of the cubic
_GYRO_BIAS = (1.0, 0.03, 2e-4, 2e-6)  # deg/s, deg/s/K, ...
_GYRO_SCALE, _GYRO_G, _GYRO_NOISE = (0.02, 1e-4), 0.02, np.radians(0.05)  # 1 and 1/K; deg/s/g; rad/s
_SOON = 1e-3  # s
_AXES = {"bias": "xyz", "scale_factor": "xyz", "misalignment": ("yx", "zx", "zy")}
_HOLD, _MOVE, _THERMOMETER = 6.0, 2.0, 0.03  # s, s, K


def simulate_thermal(
    temperatures: Annotated[Sequence[float] | str, parsed(temperature_list, "T,T,...", unit="degC")] = TEMPERATURES,
    *,
    attitudes: int | str = 12,
    ramps: int | str = 0,
    law: Annotated[str, choice(LAWS)] = "cubic",
    noise: Annotated[float | str, measure("acceleration", "m/s^2")] = "0.7 mg",
    turn_on: Annotated[float | str, measure("acceleration", "m/s^2")] = "0.1 mg",
    duration: Annotated[float | str, measure("time", "s")] = "30 min",
    rate: Annotated[float | str, measure("frequency", "Hz")] = "50 Hz",
    gyro: bool = False,
    gyro_turn_on: Annotated[float | str, measure("rate", "rad/s")] = "0.01 deg/s",
    seed: int | str = 1,
) -> ThermalRecordings:
    """Simulate the recordings of a unit over temperature, a power cycle each.

    Parameters
    ----------
    temperatures
        Set points of the chamber, a tumble at each. In degC.
    attitudes
        Static attitudes of each tumble; 0 for ramps alone.
    ramps
        Rest ramps from the lowest to the highest temperature. With x, y, z, -x .. up in turn.
    law
        How the biases follow the temperature. ``cubic``: what the default degrees can follow; ``rough``: with bends of
        some 25 K on top.
    noise
        Standard deviation of one sample. In m/s^2.
    turn_on
        Scatter of biases between power cycles. Standard deviation of each, m/s^2.
    duration
        Duration of a ramp. In s.
    rate
        Samples per second of a tumble. In Hz; a tenth of it in ramps.
    gyro
        Columns of gyroscopes too.
    gyro_turn_on
        Scatter of their biases between power cycles. Standard deviation of each, rad/s.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range.

    Examples
    --------
    >>> import imulab as il
    >>> recordings = il.simulate_thermal([-20, 60], attitudes=3, ramps=1)
    >>> [recording.name for recording in recordings]
    ['tumble_-20.csv', 'tumble_60.csv', 'ramp_1.csv']
    """
    made = ThermalRecordings(
        tuple(temperature_list(temperatures, "temperatures")), whole(attitudes, "attitudes"), whole(ramps, "ramps"),
        law,
        in_si(noise, "noise", "acceleration", "m/s^2"), in_si(turn_on, "turn_on", "acceleration", "m/s^2"),
        in_si(duration, "duration", "time", "s"), in_si(rate, "rate", "frequency", "Hz"), whole(seed, "seed"),
        gyro, in_si(gyro_turn_on, "gyro_turn_on", "rate", "rad/s"),
    )  # fmt: skip
    if law not in LAWS:
        raise OptionError(f"law {law!r}: expected one of {listed(LAWS, law)}")
    for name, value, low, high in (
        ("temperatures", len(made.temperatures), 2, 50),
        ("attitudes", made.attitudes, 0, 500),
        ("ramps", made.ramps, 0, 20),
        ("noise", made.noise, 0.0, 10.0),
        ("turn_on", made.turn_on, 0.0, 10.0),
        ("gyro_turn_on", made.gyro_turn_on, 0.0, 1.0),
        ("duration", made.duration, 60.0, 86400.0),
        ("rate", made.rate, 10.0, 1000.0),
        ("seed", made.seed, 0, 2**31),
    ):
        if not low <= value <= high:
            raise OptionError(f"{name} {value:g}: expected {low:g} to {high:g}")
    if not all(-100 <= t <= 150 for t in made.temperatures):
        raise OptionError(f"temperatures {made.temperatures}: expected -100 to 150 degC")
    if not len(made):
        raise OptionError("attitudes 0, ramps 0: make no recording; expected one attitude or one ramp at least")
    return made


@dataclass(frozen=True, repr=False)
class ThermalRecordings(Shown, Sequence[Recording]):
    """The recordings of a simulated unit over temperature, each made when it is asked for.

    Attributes
    ----------
    temperatures
        Set points, degC.
    attitudes, ramps, law, noise, turn_on, duration, rate, seed, gyro, gyro_turn_on
        As for `simulate_thermal`, in SI.
    """

    temperatures: tuple[float, ...]
    attitudes: int
    ramps: int
    law: str
    noise: float
    turn_on: float
    duration: float
    rate: float
    seed: int
    gyro: bool
    gyro_turn_on: float

    def __len__(self) -> int:
        return (len(self.temperatures) if self.attitudes else 0) + self.ramps

    @overload
    def __getitem__(self, index: int) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> list[Recording]: ...
    def __getitem__(self, index: int | slice) -> Recording | list[Recording]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        return _simulate_recording(self, index % len(self))

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return a headline, titles and rows."""
        rows = [[recording.name, str(len(recording))] for recording in self]
        return f"{len(self)} simulated recordings, law {self.law}", ["file", "samples"], rows

    def save(self, folder: str | Path) -> None:
        """Write the recordings into a folder, a file each, and the truth at the set points, SI, as truth.json.

        Raises
        ------
        OptionError
            They cannot be written there.
        """
        place = Path(folder)
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OptionError(f"{folder}: cannot be made: {error.strerror}") from None
        for recording in self:
            write_csv(recording, place / recording.name)
        at = np.unique(self.temperatures)
        truth = {"temperature": at} | thermal_truth(at, self.law, self.seed)
        truth |= thermal_gyro_truth(at, self.seed) if self.gyro else {}
        write_text(place / "truth.json", json.dumps({n: v.tolist() for n, v in truth.items()}, indent=1) + "\n")


def thermal_truth(temperature: Array, law: str = "cubic", seed: int = 1) -> dict[str, Array]:
    """Return the true parameters of the simulated unit at temperatures, SI, under the names of a record."""
    rng = np.random.default_rng([seed, 0])
    t, parameters = temperature - _ZERO, {}
    for kind, sizes in _SIZES.items():
        for axis in _AXES[kind]:
            draws = rng.standard_normal(4) * sizes
            value = draws[0] + draws[1] * t + draws[2] * t**2 + draws[3] * t**3
            if kind == "bias":
                phase = rng.uniform(0, 2 * np.pi)
                bend = _ROUGH * np.sin(t / 8.0 + phase) * rng.uniform(0.3, 1.0) if law == "rough" else 0.0
                value = STANDARD_GRAVITY * (value + bend)
            parameters[f"{kind}_{axis}"] = value + (1.0 if kind == "scale_factor" else 0.0)
    return parameters


def _simulate_recording(made: ThermalRecordings, index: int) -> Recording:
    rng = np.random.default_rng([made.seed, 1, index])
    tumbles = len(made) - made.ramps
    if index < tumbles:
        time, force, turning = _simulate_tumble(made, rng)
        temperature = made.temperatures[index] + 0.3 * np.sin(time / 300.0 + rng.uniform(0, 6.28))
        again = made.temperatures[: index + 1].count(made.temperatures[index])
        name = f"tumble_{made.temperatures[index]:g}{f'_{again}' if again > 1 else ''}.csv"
    else:
        number = index - tumbles
        time = np.arange(int(made.duration * made.rate / 10)) * 10 / made.rate
        low, high = min(made.temperatures), max(made.temperatures)
        temperature = low + (high - low) * (1 - np.exp(-2 * time / time[-1])) / (1 - np.exp(-2))
        up = np.eye(3)[number % 3] * (1 if number % 6 < 3 else -1) + 0.05 * rng.standard_normal(3)
        force = np.tile(STANDARD_GRAVITY * up / np.linalg.norm(up), (len(time), 1))
        turning = np.zeros_like(force)
        name = f"ramp_{number + 1}.csv"
    sensor = thermal_truth(temperature, made.law, made.seed)
    sensed = [
        force[:, 0],
        sensor["misalignment_yx"] * force[:, 0] + force[:, 1],
        sensor["misalignment_zx"] * force[:, 0] + sensor["misalignment_zy"] * force[:, 1] + force[:, 2],
    ]
    offset = made.turn_on * rng.standard_normal(3)
    columns = {"time": time}
    for k, axis in enumerate("xyz"):
        sensed_force = sensed[k] + sensor[f"bias_{axis}"] + offset[k] + made.noise * rng.standard_normal(len(time))
        columns[f"accel_{axis}"] = sensor[f"scale_factor_{axis}"] * sensed_force
    columns["temperature"] = np.round(temperature + _THERMOMETER * rng.standard_normal(len(time)), 2)
    if made.gyro:
        columns |= _simulate_gyroscopes(made, index, temperature, turning, force)
    units = {
        "time": "s",
        **{f"gyro_{a}": "deg/s" for a in "xyz" if made.gyro},
        **{f"accel_{a}": "m/s^2" for a in "xyz"},
        "temperature": "degC",
    }
    metadata = {"serial": f"SIM-{made.seed:04d}", "gravity": f"{STANDARD_GRAVITY!r} m/s^2"}
    return Recording(columns=columns, units=units, metadata=metadata, name=name)


def _simulate_gyroscopes(
    made: ThermalRecordings, index: int, temperature: Array, turning: Array, force: Array
) -> dict[str, Array]:
    """Return the gyroscopes' outputs, deg/s, for rates, rad/s, and specific forces, m/s^2, shapes (n, 3)."""
    rng = np.random.default_rng([made.seed, 2, index])
    truth = thermal_gyro_truth(temperature, made.seed)
    offset = made.gyro_turn_on * rng.standard_normal(3)
    columns = {}
    for k, axis in enumerate("xyz"):
        sensed = turning[:, k] + sum(
            truth[f"gyro_misalignment_{axis}{b}"] * turning[:, j] for j, b in enumerate("xyz") if j != k
        )
        felt = sum(truth[f"gyro_g_sensitivity_{axis}{b}"] * force[:, j] for j, b in enumerate("xyz"))
        noise = _GYRO_NOISE * rng.standard_normal(len(temperature))
        output = truth[f"gyro_scale_factor_{axis}"] * (sensed + truth[f"gyro_bias_{axis}"] + offset[k] + felt + noise)
        columns[f"gyro_{axis}"] = np.degrees(output)
    return columns


def thermal_gyro_truth(temperature: Array, seed: int = 1) -> dict[str, Array]:
    """Return the true parameters of the simulated gyroscopes, SI, under a record's names; scale factors of rad/s."""
    rng = np.random.default_rng([seed, 3])
    t, parameters = temperature - _ZERO, {}
    for axis in "xyz":
        b, s = rng.standard_normal(4) * _GYRO_BIAS, rng.standard_normal(2) * _GYRO_SCALE
        parameters[f"gyro_bias_{axis}"] = np.radians(b[0] + b[1] * t + b[2] * t**2 + b[3] * t**3)
        parameters[f"gyro_scale_factor_{axis}"] = 1 + s[0] + s[1] * t
        for other in "xyz":
            sensitivity = np.radians(_GYRO_G) / STANDARD_GRAVITY * rng.standard_normal()
            parameters[f"gyro_g_sensitivity_{axis}{other}"] = np.full(len(t), sensitivity)
            if other != axis:
                parameters[f"gyro_misalignment_{axis}{other}"] = np.full(len(t), 0.01 * rng.standard_normal())
    return parameters


def _simulate_tumble(made: ThermalRecordings, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return time, specific force, and rate: attitudes spread over the sphere, with a swayed turn between two."""
    k = np.arange(made.attitudes) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / made.attitudes), np.pi * (1 + 5**0.5) * k
    points = np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    points = rng.permutation(points @ np.linalg.qr(rng.standard_normal((3, 3)))[0].T)
    resting, moving = round(_HOLD * made.rate), round(_MOVE * made.rate)
    place = np.arange(made.attitudes * (resting + moving))
    number, phase = place // (resting + moving), place % (resting + moving)
    after = points[np.minimum(number + 1, made.attitudes - 1)]

    def upward(later: float) -> Array:
        share = np.clip((phase - resting + later * made.rate) / moving, 0.0, 1.0)
        share = (share**2 * (3 - 2 * share))[:, None]
        between = points[number] * (1 - share) + after * share
        direction: Array = between / np.maximum(np.linalg.norm(between, axis=1), 1e-3)[:, None]
        return direction

    up = upward(0.0)
    # The least turn that moves the upward direction so, as the body sees it: du/dt = u x w.
    turning = np.cross((upward(_SOON) - upward(-_SOON)) / (2 * _SOON), up)
    sway = 0.5 * np.sin(2 * np.pi * 3.0 * place / made.rate)[:, None] * np.array([1.0, -0.7, 0.5])
    time = place / made.rate
    return time, STANDARD_GRAVITY * up + np.where((phase >= resting)[:, None], sway, 0.0), turning
