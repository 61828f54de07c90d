"""A simulated magnetometer triad, waved by hand through all directions or turned level.

The equation of the model stands here a second time, so that fit and simulation do not share errors.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from imulab.errors import OptionError, meant
from imulab.options import choice, measure
from imulab.procedures.magnetometer import TURNS
from imulab.quantities import in_si, whole
from imulab.recording import Array, Recording

_SOFT_IRON, _HARD_IRON = 0.05, 0.5  # of the field
_RESOLUTION = 0.02  # uT
_MOST_SAMPLES = 1e7
_PACE = 1.1  # rad/s, of the hand about each axis
_TURN = 15.0  # s, once around


def simulate_magnetometer(
    *,
    turn: Annotated[str, choice(TURNS)] = "wave",
    duration: Annotated[float | str, measure("time", "s")] = "60 s",
    rate: Annotated[float | str, measure("frequency", "Hz")] = "20 Hz",
    field: Annotated[float | str, measure("magnetic field", "uT")] = "48 uT",
    dip: Annotated[float | str, measure("angle", "deg")] = "65 deg",
    noise: Annotated[float | str, measure("magnetic field", "uT")] = "0.3 uT",
    steel: Annotated[float | str | None, measure("time", "s")] = None,
    seed: int | str = 1,
) -> Recording:
    """Simulate a recording of a magnetometer triad alone, with its truth in the metadata.

    ``M = D (m + steel) + h`` plus white noise, D symmetric.

    Parameters
    ----------
    turn
        How it is turned: wave, through all directions by hand, or level, about z.
    duration
        Duration of the recording. In s.
    rate
        Sample rate. In Hz.
    field
        Magnitude of the field. In T.
    dip
        Its dip, positive where it points down. In rad.
    noise
        Standard deviation of one reading. In T.
    steel
        When a piece of steel passes by, for 2 s. In s from the start.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        An option cannot be used; the message says which.

    Examples
    --------
    >>> import imulab as il
    >>> il.simulate_magnetometer(turn="level", duration="30 s").units["mag_x"]
    'uT'
    """
    if turn not in TURNS:
        raise OptionError(f"turn {turn!r}: expected {' or '.join(TURNS)}{meant(TURNS, turn)}")
    length, per_second = in_si(duration, "duration", "time", "s"), in_si(rate, "rate", "frequency", "Hz")
    magnitude = 1e6 * in_si(field, "field", "magnetic field", "uT")
    spread, angle = 1e6 * in_si(noise, "noise", "magnetic field", "uT"), in_si(dip, "dip", "angle", "deg")
    if not (0 < magnitude < 1000 and spread >= 0 and abs(angle) <= np.pi / 2):
        raise OptionError("field, noise, dip: expected a field of 25 to 65 uT, noise of 0 or more, a dip within 90 deg")
    if not 10 <= length * per_second <= _MOST_SAMPLES:
        raise OptionError(f"duration, rate: expected 10 to {_MOST_SAMPLES:.0e} readings")
    seed = whole(seed, "seed")
    rng = np.random.default_rng(seed)
    time = np.arange(int(length * per_second)) / per_second
    outside = magnitude * np.array([np.cos(angle), 0.0, -np.sin(angle)])
    world = np.tile(outside, (len(time), 1))
    if steel is not None:
        near = np.exp(-(((time - in_si(steel, "steel", "time", "s") - 1) / 0.5) ** 2))
        world = world + 0.2 * magnitude * near[:, None] * np.array([1.0, 0.5, 0.3])
    inside = _turn_level(world, time) if turn == "level" else _wave(world, time, rng)
    square = rng.uniform(-1, 1, (3, 3))
    soft = np.eye(3) + _SOFT_IRON * (square + square.T) / 2
    hard = _HARD_IRON * magnitude * rng.uniform(-1, 1, 3)
    output = inside @ soft + hard + spread * rng.standard_normal(inside.shape)
    output = _RESOLUTION * np.round(output / _RESOLUTION)
    truth = {f"mag_bias_{a}": 1e-6 * hard[i] for i, a in enumerate("xyz")}
    truth |= {f"mag_soft_{a}{b}": soft[i, j] for i, a in enumerate("xyz") for j, b in enumerate("xyz") if i <= j}
    columns = {"time": time, **{f"mag_{a}": output[:, i] for i, a in enumerate("xyz")}}
    columns |= {f"truth_mag_{a}": inside[:, i] for i, a in enumerate("xyz")}
    metadata = {"serial": f"SIM-{seed:04d}", "model": "simulated magnetometers"}
    metadata |= {f"truth_{name}": repr(float(value)) for name, value in truth.items()}
    units = {name: "s" if name == "time" else "uT" for name in columns}
    return Recording(columns, units, metadata, name=f"simulated {turn}")


def _turn_level(world: Array, time: Array) -> Array:
    """Return the field in a body that turns about z, once in 15 s."""
    angle = 2 * np.pi * time / _TURN
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.column_stack(
        [cosine * world[:, 0] + sine * world[:, 1], -sine * world[:, 0] + cosine * world[:, 1], world[:, 2]]
    )


def _wave(world: Array, time: Array, rng: np.random.Generator) -> Array:
    """Return the field in a body that a hand turns at slowly changing rates about all axes."""
    from scipy.spatial.transform import Rotation

    step = float(time[1] - time[0])
    paces, phases = rng.uniform(0.03, 0.35, (2, 3)), rng.uniform(0, 2 * np.pi, (2, 3))
    rates = _PACE * sum(
        np.sin(2 * np.pi * pace * time[:, None] + phase) for pace, phase in zip(paces, phases, strict=True)
    )
    turns = Rotation.from_rotvec(step * np.asarray(rates)).as_quat()
    attitude, inside = Rotation.random(random_state=int(rng.integers(1 << 31))), np.empty_like(world)
    for k, turn in enumerate(turns):
        attitude = attitude * Rotation.from_quat(turn)
        inside[k] = attitude.inv().apply(world[k])
    return inside
