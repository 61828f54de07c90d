"""Gyroscopes on a rate table and by whole turns: bias, scale factor, misalignment and nonlinearity.

This file holds the names of axes and the words and numbers of options, which the command line needs before NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from imulab.errors import OptionError
from imulab.quantities import fraction
from imulab.units import to_si

if TYPE_CHECKING:
    from imulab.recording import Array

AXES = "xyz"
MOUNTINGS = tuple(sign + axis for axis in AXES for sign in "+-")
GAINS = ("gyro_bias", "gyro_scale_factor", "gyro_misalignment", "gyro_g_sensitivity", "gyro_k")
"""Prefixes of the parameters that a unit computes with; others are figures of the test."""
ORDERS = ("auto", "1", "2", "3", "4", "5")
RATES = "0,10,50,100,200,300"
FENCE = "0.5 deg"
TILT = "0.5 deg"


def parse_rates(text: str, option: str) -> tuple[float, ...]:
    """Return ``0,10,-10`` (deg/s) as rates in rad/s.

    Raises
    ------
    OptionError
        It is no list of two different numbers or more.
    """
    try:
        rates = tuple(to_si(float(part), "deg/s") for part in text.split(","))
    except ValueError:
        rates = ()
    if len(set(rates)) < 2 or not all(abs(rate) < 1e6 for rate in rates):
        raise OptionError(f"{option} {text!r}: expected rates of the table, deg/s, such as 0,10,100,-10,-100")
    return rates


def parse_fraction(value: float | str, option: str) -> float:
    """Return an uncertainty as a fraction of 0 or more and below 1.

    Raises
    ------
    OptionError
        It is none.
    """
    share = fraction(value, option)
    if not 0 <= share < 1:
        raise OptionError(f"{option} {value}: expected an uncertainty of 0 or more as a fraction, such as 20ppm")
    return share


def name_gyroscopes(samples: Array) -> Mapping[str, Array]:
    """Return an array without names as a triad of gyroscopes, or the one about z."""
    return {"gyro": samples} if samples.shape[1] == 3 else {"gyro_z": samples[:, 0]}
