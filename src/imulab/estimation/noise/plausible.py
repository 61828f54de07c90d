"""Whether the unit of samples at rest can be right: by the steps of known sensors, gravity and the Earth's rate.

Sources: data sheets of InvenSense and Bosch (16 bits over 125 to 2000 deg/s) and ST (4.375 to 70 mdeg/s) for the steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from imulab.columns import kind_of, triad
from imulab.estimation.ranked import distinct
from imulab.estimation.steps import deviation_of_steps
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY, to_si
from imulab.verdict import Note

_SEEN, _OF_STEPS = 100_000, 20_000
_STEPS = (*(full / 32768 for full in (125, 250, 500, 1000, 2000)), *(1 / lsb for lsb in (262.4, 131, 65.5, 32.8, 16.4)),
          0.004375, 0.00875, 0.0175, 0.035, 0.07)  # fmt: skip
"""deg/s, of gyroscopes of 16 bits."""
_ALIKE = 1e-3
_LOUD, _QUIET = 0.3, 0.035
"""deg/s/sqrt(Hz), louder than any gyroscope in use; deg/sqrt(h), so quiet that it shows the Earth's rate."""
_EARTH, _PLAIN = (4.0, 100.0), 10.0
"""deg/h that three such gyroscopes show at rest, the Earth's 15 and their offsets together; not zeroed ones, whose mean
is within ten standard uncertainties of 0."""
_NEAR = 0.03


def doubtful_units(recording: Recording, names: Sequence[str], rate: float) -> list[str]:
    """Say of a recording at rest, by its first samples at a rate, Hz, where its unit is hardly right."""
    notes: list[str] = []
    for kind, why in (("gyro", _of_gyros), ("accel", _of_accelerometers)):
        its = [name for name in names if kind_of(name) == kind]
        if its and (reason := why(recording, its, rate)):
            named = its[0] if len(its) == 1 else f"{its[0]} .. {its[-1]}"
            unit = recording.units[its[0]]
            notes.append(Note(f"{recording.name}: {named}: {reason}; is their unit, {unit}, right?"))
    return notes


def _of_gyros(recording: Recording, names: Sequence[str], rate: float) -> str:
    """Why the unit of gyroscopes is doubtful; else nothing."""
    degrees = [np.degrees(_first(recording, name)) for name in names]
    step = max(map(_step, degrees))
    for factor, other in ((math.degrees(1), "rad/s"), (math.radians(1), "deg/s")):
        if any(abs(factor * step / known - 1) < _ALIKE for known in _STEPS):
            return (
                f"no usual gyroscope has steps of {step:.3g} deg/s, but many have {factor * step:.3g} deg/s, as the "
                f"same numbers make in {other}"
            )
    white = max(deviation_of_steps(each) for each in degrees) / math.sqrt(2 * rate)
    if white > _LOUD:
        return f"white noise of {white:.2g} deg/s/√Hz is more than that of any gyroscope in use"
    shown = 3600 * math.hypot(*(float(each.mean()) for each in degrees))
    chance = 3600 * white * math.sqrt(rate / len(degrees[0]))
    if len(names) == 3 and 0 < 60 * white < _QUIET and shown > _PLAIN * chance and not _EARTH[0] < shown < _EARTH[1]:
        return (
            f"gyroscopes of so little white noise, {60 * white:.2g} deg/√h, show the Earth's 15 deg/h and little more "
            f"at rest, these {shown:.3g} deg/h"
        )
    return ""


def _of_accelerometers(recording: Recording, names: Sequence[str], _: float) -> str:
    """Why the unit of accelerometers is doubtful: another one would make gravity of what they show; else nothing."""
    if list(names) != triad("accel"):
        return ""
    force = math.hypot(*(float(_first(recording, name).mean()) for name in names))
    unit = recording.units[names[0]]
    for other in ("m/s^2", "g", "mg"):
        if other != unit and abs(force / to_si(1.0, unit) * to_si(1.0, other) / STANDARD_GRAVITY - 1) < _NEAR:
            return f"{force / to_si(1.0, unit):.4g} {unit} at rest are no gravity, as {other} would be"
    return ""


def _first(recording: Recording, name: str) -> Array:
    return np.asarray(recording.si(name), dtype=np.float64)[:_SEEN]


def _step(samples: Array) -> float:
    """The step of an output, shape (n,): the mean of the smallest ones, which a file has rounded; 0 of none."""
    steps = np.diff(distinct(samples[:_OF_STEPS]))
    return float(steps[steps < 1.5 * steps.min()].mean()) if len(steps) else 0.0
