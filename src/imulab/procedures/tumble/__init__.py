"""Tumble test: an accelerometer triad calibrated with gravity as the only reference.

And the options' words, and texts as a person writes them, to values in SI.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from imulab.errors import OptionError, listed
from imulab.quantities import number, quantity, with_uncertainty
from imulab.units import STANDARD_GRAVITY

# The words that the options of a tumble test take.


HIGHEST_ORDER = 5  # of the polynomial of an output in the specific force
FROM_DATA = ("auto", "blend")
ORDERS = ("auto", *map(str, range(HIGHEST_ORDER + 1)), "blend")
METHODS = ("norm", "linearised")
SOURCE_ORDER = 4  # of the example of method linearised's source, whose e is the order here
LOSSES = ("square", "huber", "auto")
CRITERIA = ("A", "D")
SENSITIVITIES = ("auto", "yes", "no")
CLOCKS = ("gyro", "accel")
MAG_ORDERS = ("1", "2", "auto")
HEMISPHERES = ("north", "south")
FURTHER = ("gyro", "mag")
"""Triads that can be fitted on the attitudes of the accelerometers."""


# Texts of the options of a tumble fit, as a person writes them, to values in SI.


OF_FIELD_MODELS = math.radians(0.2)
"""Standard uncertainty of the dip that a model of the Earth's field gives, rad (technical report of the WMM2025)."""
_MOST_UNCERTAIN = math.radians(10.0)
_CHANGES = (("number", "ppm"), ("acceleration", "ug"), ("angle", "arcsec"))


def ageing(text: str, name: str) -> tuple[float, ...]:
    """Return standard deviations of what biases, scale factors and misalignments changed, in SI, as many as are given.

    Raises
    ------
    OptionError
        It is none.
    """
    kinds = (("acceleration", "ug"), ("number", "ppm"), ("angle", "urad"))
    parts = text.split(",")
    if len(parts) > len(kinds):
        raise OptionError(f"{name} {text!r}: expected up to three, as in 100ug,100ppm,50urad")
    return tuple(quantity(part, name, *kind) for part, kind in zip(parts, kinds, strict=False))


def threshold(text: str, name: str) -> tuple[float, ...]:
    """Return changes of scale factors, biases and misalignments at which method linearised rests, in SI.

    Raises
    ------
    OptionError
        It is none.
    """
    parts = text.split(",")
    if len(parts) != len(_CHANGES):
        raise OptionError(
            f"{name} {text!r}: expected three changes, of scale factors, biases and misalignments, such as "
            "5ppm,2ug,3arcsec"
        )
    changes = tuple(quantity(part.strip(), name, *kind) for part, kind in zip(parts, _CHANGES, strict=True))
    if not all(0 < value < math.inf for value in changes):
        raise OptionError(f"{name} {text!r}: expected three finite changes above 0")
    return changes


def preset(value: Sequence[float] | float | str, name: str) -> tuple[float, ...]:
    """Return the scale factors that method linearised starts from, output per g, one for all axes or three.

    Raises
    ------
    OptionError
        It is none.
    """
    parts = value.split(",") if isinstance(value, str) else [value] if isinstance(value, int | float) else value
    values = tuple(number(part.strip(), name) if isinstance(part, str) else float(part) for part in parts)
    if len(values) not in (1, 3) or not all(0 < value < math.inf for value in values):
        raise OptionError(f"{name} {value!r}: expected one scale factor or three, above 0, in output per g")
    return values


def nonlinearity(text: str, name: str) -> tuple[float, float]:
    """Return the standard deviations of k2 and k3 in units of 1/g and 1/g^2: ``20ug,20ug`` is 20 ug/g^2, 20 ug/g^3.

    Raises
    ------
    OptionError
        It is none.
    """
    parts = text.split(",")
    if len(parts) != 2:
        raise OptionError(f"{name} {text!r}: expected two standard deviations, of k2 and k3, such as 20ug,20ug")
    first, second = (quantity(part.strip(), name, "acceleration", "ug") / STANDARD_GRAVITY for part in parts)
    return first, second


def dip(text: str, name: str) -> tuple[float, float]:
    """Return a dip such as ``67.2`` or ``67.2+-0.1 deg`` and its standard uncertainty, rad.

    Raises
    ------
    OptionError
        It is none.
    """
    first, second = with_uncertainty(text)
    value = quantity(first, name, "angle", "deg")
    if second is None:
        return check_dip(value, OF_FIELD_MODELS, name)
    return check_dip(value, quantity(second, f"{name} {text!r}, uncertainty", "angle", "deg"), name)


def check_dip(value: float, uncertainty: float, name: str) -> tuple[float, float]:
    """Return a dip and its standard uncertainty, rad, that can be.

    Raises
    ------
    OptionError
        They cannot.
    """
    if not (abs(value) <= math.pi / 2 and 0 <= uncertainty <= _MOST_UNCERTAIN):
        raise OptionError(
            f"{name} {math.degrees(value):g} deg ± {math.degrees(uncertainty):g} deg: expected -90 to 90 deg, positive "
            "where the field points down, and a standard uncertainty of 0 to 10 deg"
        )
    return value, uncertainty


def order(text: str, name: str) -> int | str:
    """Return an order as a number, or the word that stands for how it is chosen.

    Raises
    ------
    OptionError
        It is none.
    """
    if text not in ORDERS:
        raise OptionError(f"{name} {text!r}: expected one of {listed(ORDERS, text)}")
    return int(text) if text.isdecimal() else text
