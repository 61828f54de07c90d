"""How long a rest ramp of gyroscopes should last, and how well that will tell their biases over temperature.

Parts of a recording of duration D, evenly over the range, have white noise ``N^2 n / D``, 1/f noise and a random walk
of the rate, as `slow_noise` fits them. Generalised least squares of a law of the temperature beside these gives its
covariance; the Earth's rate, of unknown direction, is common to all temperatures and comes on top.

1/f noise of one-sided density ``B^2 / (pi f)`` (IEEE Std 952, bias instability B) is a sum of Markov processes with
time constants in steps of two, each of variance ``B^2 ln 2 / pi``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from imulab.errors import OptionError
from imulab.options import measure, parsed, text
from imulab.procedures.result import PlannedTest, amount
from imulab.procedures.thermal import LEAST_SPAN
from imulab.procedures.thermal.gyro import VERTICAL
from imulab.procedures.thermal.slow_noise import slow_covariances
from imulab.quantities import RANDOM_WALK, in_si, of_units, temperature_list, whole
from imulab.report.parameters import text_in
from imulab.report.traces import plain_number

_RATE_WALK = {"deg/h/sqrt(h)": math.radians(1) / 3600 / 60, "rad/s/sqrt(s)": 1.0}
_PARTS = 48
_DURATIONS = 60.0 * np.array([5, 10, 20, 30, 45, 60, 90, 120, 180, 240, 360, 480, 720, 1440])
_LAG = 20.0
"""Usual lag of the sensor behind its thermometer, s, as in `ramp`."""
_FASTEST = 2.0 / 60 * (1 + 1e-9)
"""Change of the temperature, K/s, above which no ramp is recommended: the sensor follows its thermometer too late."""


@dataclass(frozen=True)
class PredictedRamp:
    """What a ramp of one duration, s, gives: standard uncertainties of the biases over the range.

    Attributes
    ----------
    rate
        Change of the temperature, K/s.
    law
        Of the biases beside the Earth's rate, where it is largest over the range, rad/s.
    bias
        The same with the Earth's rate of unknown direction.
    behind
        How far a usual lag sets the sensor's temperature behind the thermometer's, K.
    """

    duration: float
    rate: float
    law: float
    bias: float
    behind: float

    def texts(self) -> list[str]:
        """Return minutes, K/min, deg/h of law and bias, and K as texts."""
        read = (text_in(each, "deg/h") for each in (self.law, self.bias))
        return [f"{self.duration / 60:.0f}", plain_number(60 * self.rate, 2), *read, plain_number(self.behind, 2)]


@dataclass(frozen=True, repr=False)
class RampPlan(PlannedTest):
    """How long the temperature is to change in one direction.

    Attributes
    ----------
    low, high
        Range of the temperature, degC.
    degree
        Degree of the law of the biases.
    chosen
        The shortest ramp that is as certain as wanted, and no faster than 2 K/min.
    others
        Shorter and longer ones.
    wanted
        Wanted standard uncertainty of the biases beside the Earth's rate, rad/s.
    """

    no_file: ClassVar[str] = "a ramp at rest has no attitudes"

    low: float
    high: float
    degree: int
    chosen: PredictedRamp
    others: tuple[PredictedRamp, ...]
    wanted: float

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the plan in a sentence, and what other durations give."""
        _, rate, law, bias, _ = self.chosen.texts()
        head = (
            f"{self.chosen.duration / 60:.0f} min at rest from {self.low:g} to {self.high:g} degC, {rate} K/min: "
            f"biases of degree {self.degree} over temperature to {law} deg/h (standard uncertainty at worst, wanted "
            f"{text_in(self.wanted, 'deg/h')}), {bias} deg/h with the Earth's rate"
        )
        titles = ["min", "K/min", "bias beside the Earth's rate, deg/h", "bias, deg/h", "behind by a lag of 20 s, K"]
        return head, titles, [each.texts() for each in self.others]

    def remarks(self) -> list[str]:
        """Return how to record it."""
        return [
            "",
            "Let the unit rest, change the temperature by 2 K/min or less, and record the way back too: one direction "
            "does not tell a lag from the law. The next power cycle moves the biases by what no single ramp tells.",
        ]

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""

        def row(each: PredictedRamp) -> dict[str, Any]:
            return {
                "duration": amount(each.duration, "s"), "rate": amount(each.rate, "K/s"),
                "law": amount(each.law, "rad/s"), "bias": amount(each.bias, "rad/s"),
                "behind": amount(each.behind, "K"),
            }  # fmt: skip

        return {
            "range": [self.low, self.high],
            "degree": self.degree,
            "wanted": amount(self.wanted, "rad/s"),
            **row(self.chosen),
            "others": [row(each) for each in self.others],
        }


def plan_ramp(
    temperatures: Annotated[tuple[float, float] | str, parsed(temperature_list, "LOW,HIGH", unit="degC")] = "10,50",
    *,
    wanted: Annotated[float | str, measure("rate", "deg/h")] = "10 deg/h",
    degree: Annotated[int | str, text("0..5")] = 3,
    gyro_noise: Annotated[float | str, text("N", unit="deg/sqrt(h)")] = "0.3 deg/sqrt(h)",
    instability: Annotated[float | str, measure("rate", "deg/h")] = "5 deg/h",
    walk: Annotated[float | str, text("K", unit="deg/h/sqrt(h)")] = "5 deg/h/sqrt(h)",
) -> RampPlan:
    """Say how long gyroscopes should rest while their temperature changes, and how well that tells their biases.

    Parameters
    ----------
    temperatures
        Lowest and highest temperature. In degC.
    wanted
        Wanted standard uncertainty of the biases over the range. Beside the Earth's rate, which comes on top; in rad/s.
    degree
        Degree of the biases over temperature.
    gyro_noise
        Angle random walk of the gyroscopes. In rad/sqrt(s).
    instability
        Their bias instability. In rad/s.
    walk
        Their rate random walk. In rad/s/sqrt(s).

    Raises
    ------
    OptionError
        An option cannot be used, or a day is too short for the wanted uncertainty.

    Source: IEEE Std 952-1997, annex C.

    Examples
    --------
    >>> import imulab as il
    >>> plan = il.plan_ramp("10,50", wanted="10 deg/h")
    >>> plan.chosen.law <= plan.wanted
    True
    """
    low, high = _read_range(temperatures)
    size = whole(degree, "degree")
    if not 0 <= size <= 5:
        raise OptionError(f"degree {size}: expected 0 to 5")
    target = in_si(wanted, "wanted", "rate", "deg/h")
    noise = (
        of_units(gyro_noise, "gyro_noise", RANDOM_WALK),
        in_si(instability, "instability", "rate", "deg/h"),
        of_units(walk, "walk", _RATE_WALK),
    )
    if not (0 < noise[0] < 1 and 0 <= noise[1] < 1 and 0 <= noise[2] < 1 and 0 < target < 1):
        raise OptionError(
            "gyro_noise, instability, walk, wanted: expected an angle random walk and a wanted uncertainty above 0, "
            "the others 0 or more, all below 1 in SI"
        )
    predicted = [_predict(low, high, size, each, noise) for each in _DURATIONS.tolist()]
    slow = [each for each in predicted if each.rate <= _FASTEST]
    chosen = next((each for each in slow if each.law <= target), None)
    if chosen is None:
        best = min(slow, key=lambda each: each.law)
        raise OptionError(
            f"wanted {text_in(target, 'deg/h')} deg/h: the noise of these gyroscopes leaves "
            f"{text_in(best.law, 'deg/h')} deg/h after {best.duration / 60:.0f} min, the best of a day; expected more, "
            "a lower degree, or several ramps"
        )
    return RampPlan(low, high, size, chosen, tuple(predicted), target)


def _read_range(temperatures: Any) -> tuple[float, float]:
    ends = temperature_list(temperatures, "temperatures") if isinstance(temperatures, str) else temperatures
    if len(ends) != 2 or not all(math.isfinite(each) for each in ends) or not ends[1] - ends[0] >= LEAST_SPAN:
        raise OptionError(
            f"temperatures {temperatures!r}: expected lowest and highest, {LEAST_SPAN:g} K apart or more, such as 10,50"
        )
    return float(ends[0]), float(ends[1])


def _predict(low: float, high: float, degree: int, duration: float, noise: tuple[float, float, float]) -> PredictedRamp:
    """Return what a ramp of some duration gives with angle random walk, bias instability and rate random walk, SI."""
    white, instability, walk = noise
    place = (np.arange(_PARTS) + 0.5) / _PARTS
    flicker, walked = slow_covariances(duration * place)
    covariance = (
        white**2 * _PARTS / duration * np.eye(_PARTS)
        + instability**2 * math.log(2) / math.pi * flicker
        + walk**2 * walked
    )
    design = np.polynomial.chebyshev.chebvander(2 * place - 1, degree)
    spread = np.linalg.inv(design.T @ np.linalg.solve(covariance, design))
    over = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, _PARTS), degree)
    law = float(np.sqrt(np.einsum("na,ab,nb->n", over, spread, over).max()))
    rate = (high - low) / duration
    return PredictedRamp(duration, rate, law, math.hypot(law, VERTICAL), _LAG * rate)
