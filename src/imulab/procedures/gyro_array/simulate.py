"""A simulated gyro array: the two experiments of the source, and a motion to calibrate elements by.

Source of both set-ups: patent CN109443333B (6 gyros; 100 Hz, 2000 s at rest; 50 Hz, 100 s on a rate table).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from imulab.errors import OptionError, listed
from imulab.options import RARE, choice, measure, repeated, text
from imulab.procedures.gyro_array import EXPERIMENTS, FAULTS, MOUNTINGS, UNITS
from imulab.quantities import in_si, quantity, whole
from imulab.recording import Array, Recording
from imulab.units import conversion_factor, parse_unit

_MOST_READINGS = 200_000_000  # of a simulation: it bounds memory
_DEG = math.pi / 180  # rad


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one gyro, rad/s: white noise of a sample, Gauss-Markov noise, rate random walk, turn-on bias.

    Each gyro's white noise is `white` times a factor drawn evenly from `spread`.
    """

    white: float = 0.05 * _DEG
    spread: tuple[float, float] = (0.6, 1.6)
    gauss_markov: float = 0.003 * _DEG
    correlation_time: float = 200.0
    walk: float = 2e-4 * _DEG
    turn_on: float = 0.02 * _DEG


@dataclass(frozen=True)
class Fault:
    """A fault of gyro number `gyro` (from 1) on every axis: kind, begin, s, duration, s, and size, rad/s."""

    kind: str
    gyro: int
    start: float = 0.0
    duration: float = math.inf
    size: float = 2.0 * _DEG


Faults: TypeAlias = Annotated[
    Sequence[Fault | str] | None, repeated("KIND:GYRO[:START[:DURATION[:SIZE]]]", words=FAULTS)
]


def simulate_array(
    *,
    experiment: Annotated[str, choice(tuple(EXPERIMENTS))] = "dynamic",
    elements: int | str = 6,
    axes: int | str = 1,
    rate: Annotated[float | str | None, measure("frequency", "Hz")] = None,
    duration: Annotated[float | str | None, measure("time", "s")] = None,
    white: Annotated[float | str, measure("rate", "deg/s"), RARE] = "0.05 deg/s",
    spread: Annotated[tuple[float, float] | str, text("LOW,HIGH"), RARE] = "0.6,1.6",
    gauss_markov: Annotated[float | str, measure("rate", "deg/s"), RARE] = "0.003 deg/s",
    correlation_time: Annotated[float | str, measure("time", "s"), RARE] = "200 s",
    walk: Annotated[float | str, measure("rate", "deg/s"), RARE] = "0.0002 deg/s",
    turn_on: Annotated[float | str, measure("rate", "deg/s"), RARE] = "0.02 deg/s",
    scale_spread: float | str = 0,
    misalignment: Annotated[float | str, measure("angle", "deg"), RARE] = "0 deg",
    mounting: Annotated[str, choice(MOUNTINGS)] = "same",
    fault: Faults = None,
    unit: Annotated[str, choice(UNITS)] = "deg/s",
    session: int | str = 0,
    seed: int | str = 1,
) -> Recording:
    """Simulate an array's recording with columns time, gyro_1 .. (or gyro_x_1 ..) and truth_rate (or truth_rate_x ..).

    ``z_i = A_i w + turn-on + Gauss-Markov + rate random walk + white``; w is 0 (`static`),
    -12.5 cos(0.2 pi t - 0.2 pi) deg/s on every axis (`dynamic`), or turns by hand about all axes (`moving`).

    Parameters
    ----------
    experiment
        static and dynamic are the source's set-ups.
    elements
        Gyros on each axis.
    axes
        1, or 3: x forward, y right, z down.
    rate
        Sampling rate; that of the experiment if not given. In Hz.
    duration
        Duration; that of the experiment if not given. In s.
    white
        White noise of a sample, before a factor for each gyro. In rad/s; this and the next are those of `NoiseModel`.
    spread
        Range of that factor. Of the white noise of each gyro.
    gauss_markov
        Standard deviation of the correlated noise. In rad/s.
    correlation_time
        Of the correlated noise. In s.
    walk
        Rate random walk, per square root of a second. In rad/s.
    turn_on
        Standard deviation of the turn-on biases. In rad/s.
    scale_spread
        Standard deviation of the scale factors.
    misalignment
        Standard deviation of the misalignments. Of the axes, rad.
    mounting
        alternate: even elements upside down. They measure (-y, -x, -z), or -x on a single axis.
    fault
        Faults to put in: dead stuck spikes jump nan saturation; times in s, sizes in deg/s; repeatable. Each a `Fault`
        or a text ``KIND:GYRO[:START[:DURATION[:SIZE]]]``.
    unit
        Unit of the outputs.
    session
        Another recording of the same array. Biases and scale factors depend on `seed` alone: another experiment or
        session with one seed is another recording of one array.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range.

    Examples
    --------
    >>> import imulab as il
    >>> il.simulate_array(elements=2, duration="10 s", fault=["stuck:1:5"]).units["gyro_2"]
    'deg/s'
    """
    noise = NoiseModel(
        white=in_si(white, "white", "rate", "deg/s"),
        spread=_spread(spread),
        gauss_markov=in_si(gauss_markov, "gauss_markov", "rate", "deg/s"),
        correlation_time=in_si(correlation_time, "correlation_time", "time", "s"),
        walk=in_si(walk, "walk", "rate", "deg/s"),
        turn_on=in_si(turn_on, "turn_on", "rate", "deg/s"),
    )
    elements, axes = whole(elements, "elements"), whole(axes, "axes")
    session, seed = whole(session, "session"), whole(seed, "seed")
    scale_spread = in_si(scale_spread, "scale_spread", "number", "1")
    misalignment = in_si(misalignment, "misalignment", "angle", "deg")
    faults = tuple(_fault(each) if isinstance(each, str) else each for each in fault or ())
    if experiment not in EXPERIMENTS:
        raise OptionError(f"experiment {experiment!r}: expected one of {listed(EXPERIMENTS, experiment)}")
    usual_rate, usual_length = EXPERIMENTS[experiment]
    rate = usual_rate if rate is None else in_si(rate, "rate", "frequency", "Hz")
    length = usual_length if duration is None else in_si(duration, "duration", "time", "s")
    _check(elements, axes, rate, length, mounting, unit)
    _check_numbers(noise, scale_spread, misalignment, session, seed)
    _check_faults(faults, elements)
    count = round(length * rate)
    if not 2 <= count * elements * axes <= _MOST_READINGS:
        raise OptionError(
            f"{length:g} s at {rate:g} Hz of {elements * axes} gyros: expected 2 to {_MOST_READINGS:g} readings in all"
        )
    time = np.arange(count) / rate
    unit_rng = np.random.default_rng([seed, 1])  # for all recordings of one array
    levels = noise.white * unit_rng.uniform(*noise.spread, (axes, elements))
    biases = noise.turn_on * unit_rng.standard_normal((axes, elements))
    sensing = _sensing(elements, axes, scale_spread, misalignment, mounting, unit_rng)
    rng = np.random.default_rng([seed, 2 + list(EXPERIMENTS).index(experiment), session])
    truth = _motion(experiment, time, axes, rng)
    readings = np.einsum("iab,tb->tai", sensing, truth) + biases
    _add_noise(readings, levels, noise, rate, rng)
    for each in faults:
        _break(readings, each, rate, rng)
    head = {"serial": f"ARRAY-{seed:04d}", "model": f"simulated array of {elements}", "experiment": experiment}
    return _recording(time, readings, truth, biases, unit, head)


def _add_noise(readings: Array, levels: Array, noise: NoiseModel, rate: float, rng: np.random.Generator) -> None:
    """Add white noise of standard deviations `levels`, shape (axes, n), rate random walk and correlated noise."""
    readings += levels * rng.standard_normal(readings.shape)
    readings += noise.walk / math.sqrt(rate) * np.cumsum(rng.standard_normal(readings.shape), axis=0)
    readings += _gauss_markov(readings.shape, noise, rate, rng)


def _recording(time: Array, readings: Array, truth: Array, biases: Array, unit: str, head: dict[str, str]) -> Recording:
    """Return readings, shape (m, axes, n), with their truth, shape (m, axes), as a recording in a unit."""
    factor = conversion_factor("rad/s", unit)
    letters = ("",) if readings.shape[1] == 1 else ("x_", "y_", "z_")
    columns, metadata = {"time": time}, dict(head)
    for a, letter in enumerate(letters):
        for i in range(readings.shape[2]):
            columns[f"gyro_{letter}{i + 1}"] = readings[:, a, i] * factor
            metadata[f"truth_bias_{letter}{i + 1}"] = f"{float(biases[a, i])!r} rad/s"
    for a, letter in enumerate(letters):
        columns[f"truth_rate_{letter}".rstrip("_")] = truth[:, a] * factor
    units = {name: "s" if name == "time" else unit for name in columns}
    return Recording(columns=columns, units=units, metadata=metadata, name=f"simulated {head['experiment']} array")


def _spread(stated: tuple[float, float] | str) -> tuple[float, float]:
    """Return the range of a factor, given as LOW,HIGH or as one number for both."""
    if not isinstance(stated, str):
        low, high = stated
        return float(low), float(high)
    first, _, second = stated.partition(",")
    if "," in second:
        raise OptionError(f"spread {stated!r}: expected LOW,HIGH, such as 0.6,1.6")
    return quantity(first, "spread", "number", "1"), quantity(second or first, "spread", "number", "1")


def _fault(text: str) -> Fault:
    """Return a fault from ``KIND:GYRO[:START[:DURATION[:SIZE]]]``."""
    kind, *rest = text.split(":")
    if not 1 <= len(rest) <= 4:
        raise OptionError(f"fault {text!r}: expected KIND:GYRO[:START[:DURATION[:SIZE]]], such as stuck:3:40:20")
    units = (("start", "time", "s"), ("duration", "time", "s"), ("size", "rate", "deg/s"))
    values = {
        name: quantity(part, "fault", kind_of_unit, unit)
        for (name, kind_of_unit, unit), part in zip(units, rest[1:], strict=False)
        if part
    }
    return Fault(kind, whole(rest[0], "fault"), **values)


def _check(elements: int, axes: int, rate: float, length: float, mounting: str, unit: str) -> None:
    for name, value, low, high in (
        ("elements", elements, 1, 64),
        ("sample rate", rate, 1.0, 1e5),
        ("duration", length, 0.1, 1e6),
    ):
        if not low <= value <= high:
            raise OptionError(f"{name} {value:g}: expected {low:g} to {high:g}")
    if axes not in (1, 3):
        raise OptionError(f"axes {axes}: expected 1 or 3")
    if mounting not in MOUNTINGS:
        raise OptionError(f"mounting {mounting!r}: expected one of {listed(MOUNTINGS, mounting)}")
    if parse_unit(unit, ("rate",)).quantity != "rate":
        raise OptionError(f"unit {unit}: expected {listed(UNITS, unit)}")


def _check_numbers(noise: NoiseModel, scale_spread: float, misalignment: float, session: int, seed: int) -> None:
    for name, value in (
        ("white", noise.white),
        ("gauss-markov", noise.gauss_markov),
        ("walk", noise.walk),
        ("turn-on", noise.turn_on),
        ("scale spread", scale_spread),
        ("misalignment", misalignment),
    ):
        if not 0 <= value < math.inf:
            raise OptionError(f"{name} {value:g}: expected a standard deviation, 0 or more")
    if not 0 <= noise.spread[0] <= noise.spread[1] < math.inf:
        raise OptionError(f"spread {noise.spread[0]:g},{noise.spread[1]:g}: expected LOW,HIGH with 0 <= LOW <= HIGH")
    if not 0 < noise.correlation_time < math.inf:
        raise OptionError(f"correlation time {noise.correlation_time:g} s: expected more than 0")
    for name, number in (("session", session), ("seed", seed)):
        if not 0 <= number < 2**63:
            raise OptionError(f"{name} {number}: expected 0 to {2**63 - 1}")


def _check_faults(faults: tuple[Fault, ...], elements: int) -> None:
    for fault in faults:
        if fault.kind not in FAULTS:
            raise OptionError(f"fault {fault.kind!r}: expected one of {listed(FAULTS, fault.kind)}")
        if not 1 <= fault.gyro <= elements:
            raise OptionError(f"fault of gyro {fault.gyro}: expected 1 to {elements}")
        if not (fault.start >= 0 and fault.duration > 0):
            raise OptionError(
                f"fault {fault.kind}: start {fault.start:g} s, duration {fault.duration:g} s: expected 0 or later, and "
                "more than 0"
            )


def _sensing(
    elements: int, axes: int, scale_spread: float, misalignment: float, mounting: str, rng: np.random.Generator
) -> Array:
    """What each element senses of the body rate, A_i, shape (n, axes, axes)."""
    sensing = np.tile(np.eye(axes), (elements, 1, 1))
    scale = scale_spread * rng.standard_normal((elements, axes))
    tilt = misalignment * rng.standard_normal((elements, axes, axes))
    for i in range(elements):
        if axes == 3:
            sensing[i] += tilt[i] * (1 - np.eye(3))
        sensing[i] *= (1 + scale[i])[:, None]
        if mounting == "alternate" and i % 2:
            turned = np.array([[-1.0]]) if axes == 1 else np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
            sensing[i] = sensing[i] @ turned
    return sensing


def _motion(experiment: str, time: Array, axes: int, rng: np.random.Generator) -> Array:
    """Body rate, rad/s, shape (m, axes)."""
    if experiment == "static":
        return np.zeros((len(time), axes))
    if experiment == "dynamic":
        table = -12.5 * _DEG * np.cos(0.2 * np.pi * time - 0.2 * np.pi)
        return np.repeat(table[:, None], axes, axis=1)
    motion = np.zeros((len(time), axes))
    for frequency in (0.11, 0.23, 0.47, 0.81):
        phase = rng.uniform(0, 2 * np.pi, axes)
        motion += 30 * _DEG * np.sin(2 * np.pi * frequency * (1 + 0.1 * np.arange(axes)) * time[:, None] + phase)
    return motion


def _gauss_markov(shape: tuple[int, ...], noise: NoiseModel, rate: float, rng: np.random.Generator) -> Array:
    """First-order Gauss-Markov process, started in its steady state."""
    from scipy.signal import lfilter

    decay = math.exp(-1 / (rate * noise.correlation_time))
    driving = math.sqrt(1 - decay**2) * rng.standard_normal(shape)
    driving[0] = rng.standard_normal(shape[1:])
    filtered: Array = noise.gauss_markov * lfilter([1.0], [1.0, -decay], driving, axis=0)
    return filtered


def _break(readings: Array, fault: Fault, rate: float, rng: np.random.Generator) -> None:
    start = round(fault.start * rate)
    stop = len(readings) if math.isinf(fault.duration) else round((fault.start + fault.duration) * rate)
    piece = readings[start:stop, :, fault.gyro - 1]
    if not len(piece):
        raise OptionError(f"fault {fault.kind} at {fault.start:g} s: expected a time within the recording")
    if fault.kind == "dead":
        piece[:] = 0.0
    elif fault.kind == "stuck":
        piece[:] = piece[0]
    elif fault.kind == "spikes":
        piece[rng.random(len(piece)) < 0.01] += fault.size
    elif fault.kind == "jump":
        piece += fault.size
    elif fault.kind == "nan":
        piece[:] = np.nan
    else:
        np.clip(piece, -fault.size, fault.size, out=piece)
