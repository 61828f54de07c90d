"""Warm-up: the bias in the minutes after power-on, as a table over time. Here are the words that the options take."""

from __future__ import annotations

from imulab.errors import OptionError
from imulab.quantities import number, quantity

MODELS = ("interval-cubic", "knot-cubic", "knot-log-cubic", "exponential")
EXITS = ("zero", "hold", "taper")
BEYOND = ("zero", "hold")
LAWS = ("smooth", "bent")
POOLS = ("unit", "type")
TEMPERATURES = "-40,-30,-20,-10,0,40,50,60"
"""Calibration temperatures of the source (see `fit`), degC."""


def settling_size(text: str, option: str) -> dict[str, float]:
    """Return, by kind, the |Z| that counts as settled; a share of the peak is negative.

    Raises
    ------
    OptionError
        It is neither a percentage nor a rate or an acceleration.
    """
    if text.rstrip().endswith("%"):
        share = number(text.rstrip()[:-1], option) / 100
        if not 0 < share < 1:
            raise OptionError(f"{option} {text!r}: expected more than 0 and less than 100 %")
        return {"gyro": -share, "accel": -share}
    for kind, what, unit in (("gyro", "rate", "deg/h"), ("accel", "acceleration", "mg")):
        try:
            value = quantity(text, option, what, unit)
        except OptionError:
            continue
        if any(symbol in text for symbol in ("deg", "rad")) == (kind == "gyro") and value > 0:
            return {kind: value}
    raise OptionError(f"{option} {text!r}: expected a percentage such as '5 %', a rate or an acceleration")
