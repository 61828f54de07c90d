"""How to put down and to move a board of whole IMUs, and what that will give: the covariance before the recording.

The information of rests and of a motion by hand such as `simulate_imus` makes, for a board whose readings fit exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from imulab.errors import OptionError
from imulab.options import measure
from imulab.procedures.gyro_array.imus.model import (
    ACCEL,
    ACCEL_LATENCY,
    ACCELERATION,
    FORCE,
    GYRO,
    GYRO_LATENCY,
    NUMBERS,
    POSITION,
    RATE,
    Board,
)
from imulab.procedures.gyro_array.imus.record import record_values
from imulab.procedures.gyro_array.imus.schema import AT_ROTATION
from imulab.procedures.gyro_array.imus.simulate import path_by_hand
from imulab.procedures.gyro_array.imus.solve import Held, Measured, expected_covariance, mean_scale
from imulab.procedures.result import PlannedTest, amount
from imulab.quantities import in_si, whole
from imulab.recording import Array
from imulab.report.traces import plain_number

_G = 9.80665
_STILL, _SETTLE = 5.0, 1.5  # s at rest in each attitude, and from one to the next
_SHARES = (0.125, 0.25, 0.5, 1.0, 2.0)  # of the duration that a plan compares
_KNOWN = 1e-6  # of the mean gyro scale: the size counts as known


@dataclass(frozen=True)
class PredictedBoard:
    """What a motion of some duration gives, largest standard uncertainties: m, rad, s, s; the size counts as known."""

    duration: float
    position: float
    rotation: float
    accel_latency: float
    gyro_latency: float

    def texts(self) -> list[str]:
        """Return positions in mm, rotations in mrad and latencies in microseconds, as texts."""
        values = (1e3 * self.position, 1e3 * self.rotation, 1e6 * self.accel_latency, 1e6 * self.gyro_latency)
        return [plain_number(value, 2) for value in values]


@dataclass(frozen=True, repr=False)
class ImusPlan(PlannedTest):
    """How a board of whole IMUs is put down and moved.

    Attributes
    ----------
    attitudes
        In which it lies still.
    chosen
        The plan, and what it gives.
    others
        Shorter and longer motions.
    """

    no_file: ClassVar[str] = "a motion by hand has no file"

    attitudes: int
    chosen: PredictedBoard
    others: tuple[PredictedBoard, ...]

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the plan in a sentence, and what other durations give."""
        position, rotation, accel, gyro = self.chosen.texts()
        head = (
            f"{self.attitudes} attitudes of {_STILL:g} s at rest, then {self.chosen.duration:g} s of turning by hand; "
            f"predicted standard uncertainties: positions {position} mm, rotations {rotation} mrad, latencies "
            f"{accel} µs (accelerometers) and {gyro} µs (gyroscopes)"
        )
        titles = ["motion, s", "position, mm", "rotation, mrad", "accel latency, µs", "gyro latency, µs"]
        return head, titles, [[f"{each.duration:g}", *each.texts()] for each in self.others]

    def remarks(self) -> list[str]:
        """Return how to move the board."""
        few = (
            [
                f"{self.attitudes} attitudes do not tell common scale factors and biases of the accelerometers; six or "
                "more, 20 deg apart, do."
            ]
            if self.attitudes < 6
            else []
        )
        return [
            "",
            *few,
            f"Put the board down and leave it for {_STILL:g} s, on each of its faces and edges. Turn it smoothly from "
            "one to the next: the size of the board is from gravity turned between rests.",
            "Then take it in the hand and turn it about all three axes, at half the gyroscopes' range, with many "
            "reversals.",
            "Shaking along the axes adds nothing. Stay below the ends of all ranges: a clipped reading costs a sample.",
            "Record all IMUs with the same clock, at 100 Hz or more.",
        ]

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""

        def row(each: PredictedBoard) -> dict[str, Any]:
            return {
                "duration": amount(each.duration, "s"), "position": amount(each.position, "m"),
                "rotation": amount(each.rotation, "rad"), "accel_latency": amount(each.accel_latency, "s"),
                "gyro_latency": amount(each.gyro_latency, "s"),
            }  # fmt: skip

        return {"attitudes": self.attitudes, **row(self.chosen), "others": [row(each) for each in self.others]}


def plan_imus(
    *,
    elements: int | str = 4,
    span: Annotated[float | str, measure("length", "mm")] = "40 mm",
    attitudes: int | str = 12,
    duration: Annotated[float | str, measure("time", "s")] = "40 s",
    rate: Annotated[float | str, measure("frequency", "Hz")] = "100 Hz",
    turning: Annotated[float | str, measure("rate", "deg/s")] = "380 deg/s",
    accel_noise: Annotated[float | str, measure("acceleration", "m/s^2")] = "0.03 m/s^2",
    gyro_noise: Annotated[float | str, measure("rate", "deg/s")] = "0.1 deg/s",
) -> ImusPlan:
    """Plan how to put down and to move a board of whole IMUs, and what that will give.

    Parameters
    ----------
    elements
        Number of IMUs, on a circle.
    span
        Its diameter. In m.
    attitudes
        Attitudes at rest, before the motion.
    duration
        Of the motion. In s.
    rate
        Sampling rate. In Hz.
    turning
        Root mean square of the rate in motion. In rad/s.
    accel_noise
        Noise of a sample of the accelerometers. In m/s^2, in motion; real chips scatter there 8 to 20 times as much as
        at rest.
    gyro_noise
        Noise of a sample of the gyroscopes. In rad/s, in motion likewise.

    Raises
    ------
    OptionError
        A value is out of range.

    Examples
    --------
    >>> import imulab as il
    >>> [each.duration for each in il.plan_imus(elements=3, duration="8 s").others]
    [2.0, 4.0, 8.0, 16.0]
    """
    count, faces = whole(elements, "elements"), whole(attitudes, "attitudes")
    across, length = in_si(span, "span", "length", "mm"), in_si(duration, "duration", "time", "s")
    hertz, turn = in_si(rate, "rate", "frequency", "Hz"), in_si(turning, "turning", "rate", "deg/s")
    noise = in_si(accel_noise, "accel_noise", "acceleration", "m/s^2"), in_si(gyro_noise, "gyro_noise", "rate", "deg/s")
    for name, value, low, high in (
        ("elements", count, 2, 64), ("span", across, 1e-3, 1), ("attitudes", faces, 1, 100),
        ("duration", length, 4, 600), ("rate", hertz, 20, 2000), ("turning", turn, 0.5, 40),
        ("accel_noise", noise[0], 1e-6, 10), ("gyro_noise", noise[1], 1e-7, 1),
    ):  # fmt: skip
        if not low <= value <= high:
            raise OptionError(f"{name} {value:g}: expected {low:g} to {high:g}, in SI")
    others = tuple(
        _predict(count, across, faces, part * length, hertz, turn, noise)
        for part in _SHARES
        if 2 <= part * length <= 600 and part * length * hertz * count < 2e6
    )
    chosen = next(each for each in others if each.duration == length)
    return ImusPlan(faces, chosen, others)


def _predict(
    count: int, span: float, attitudes: int, duration: float, rate: float, turning: float, noise: tuple[float, float]
) -> PredictedBoard:
    path, _ = path_by_hand(attitudes, duration, turning, "xyz", np.random.default_rng(1))
    begin = attitudes * (_STILL + _SETTLE)
    time = begin + np.arange(int(duration * rate)) / rate
    motion = np.zeros((len(time), 9))
    motion[:, FORCE], motion[:, RATE], motion[:, ACCELERATION] = path.at(time)
    angle = 2 * math.pi * np.arange(count) / count
    places = span / 2 * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    numbers = np.zeros((count, NUMBERS))
    numbers[:, ACCEL] = numbers[:, GYRO] = np.eye(3).ravel()
    numbers[:, POSITION] = places - places[0]
    middle: Array = np.arange(attitudes, dtype=np.float64) * (_STILL + _SETTLE) + _STILL / 2
    force = _G * _units(path.at(middle)[0])
    at_rest = np.broadcast_to(force[:, None], (attitudes, count, 3))
    measured = Measured(
        None, None, time, np.zeros(1, dtype=np.intp), at_rest, np.zeros_like(at_rest),
        np.full(attitudes, _STILL * rate), np.full((count, 3), noise[0]), np.full((count, 3), noise[1]),
        np.broadcast_to(np.eye(3), (count, 3, 3)), _G,
    )  # fmt: skip
    board = Board(numbers)
    covariance = expected_covariance(measured, board, motion, force, Held(mean_scale(measured), 1.0, _KNOWN))
    deviation = np.sqrt(np.diag(covariance)).reshape(count, NUMBERS)
    turned = np.sqrt(np.diag(record_values(board, covariance)[1])).reshape(count, NUMBERS)
    return PredictedBoard(
        duration, float(deviation[:, POSITION].max()), float(turned[:, AT_ROTATION].max()),
        float(deviation[:, ACCEL_LATENCY].max()), float(deviation[:, GYRO_LATENCY].max()),
    )  # fmt: skip


def _units(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
