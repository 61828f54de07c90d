"""What the head of a file says about a power cycle."""

from __future__ import annotations

import math

from imulab.errors import DataError, UnitError
from imulab.recording import Recording
from imulab.units import parse_unit, to_si


def power_on_temperature(recording: Recording) -> float | None:
    """Return ``power_on_temperature`` of the head of the file, degC; None where it is missing, NaN where it is nan.

    Raises
    ------
    DataError
        It is there, but no temperature.
    """
    return head_temperature(recording, "power_on_temperature")


def head_temperature(recording: Recording, key: str) -> float | None:
    """Return a temperature that the head of the file states, degC, or None where there is none.

    Raises
    ------
    DataError
        It is there, but no temperature.
    """
    text = recording.metadata.get(key)
    if text is None:
        return None
    number, _, symbol = text.strip().partition(" ")
    try:
        value, unit = float(number), parse_unit(symbol.strip() or "degC")
    except (ValueError, UnitError):
        value, unit = math.inf, None
    if unit is None or unit.quantity != "temperature" or math.isinf(value):
        raise DataError(f"{recording.name}: {key}: expected a temperature such as -20 or '-20 degC', found {text!r}")
    return to_si(value, unit.symbol)
