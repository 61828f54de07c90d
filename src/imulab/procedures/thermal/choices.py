"""The words and numbers that the options of a thermal calibration take."""

from __future__ import annotations

from collections.abc import Sequence

from imulab.errors import OptionError

LAWS = ("cubic", "rough")
DEGREES = (3, 2, 1)
"""Of bias, scale factor and misalignment."""
HIGHEST = 5
TEMPERATURES = "-20,0,25,45,60"
APART = 5.0
"""K: temperatures that lie closer count as one."""
LEAST_SPAN = 10.0
SETTLE = 300.0


def further_of(given: str | Sequence[str], option: str) -> tuple[str, ...]:
    """Return the names of further triads, of which there is one, ``gyro``.

    Raises
    ------
    OptionError
        There is another.
    """
    names = tuple(name.strip() for name in given.split(",")) if isinstance(given, str) else tuple(given)
    if not set(names) <= {"gyro"} or len(names) > 1:
        raise OptionError(f"{option} {','.join(names)!r}: expected gyro")
    return names


def degrees_of(text: str, option: str) -> str | tuple[int, int, int]:
    """Return ``auto``, or three degrees from a text such as ``3,2,1``.

    Raises
    ------
    OptionError
        It is neither.
    """
    if text == "auto":
        return text
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 3 or not all(part.isdecimal() and int(part) <= HIGHEST for part in parts):
        raise OptionError(
            f"{option} {text!r}: expected auto, or the degrees of bias, scale factor and misalignment, 0 to {HIGHEST}, "
            "such as 3,2,1"
        )
    return int(parts[0]), int(parts[1]), int(parts[2])
