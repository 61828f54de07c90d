"""Accelerometers and gyroscopes calibrated over temperature.

This file holds the words and numbers of options, which the command line needs before NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence

from imulab.errors import OptionError, meant

LAWS = ("cubic", "rough")
DEGREES = (3, 2, 1)
"""Highest degrees that are tried, of bias, scale factor and misalignment."""
HIGHEST = 5  # degree of a law
TEMPERATURES = "-20,0,25,45,60"
APART = 5.0
"""Temperatures that lie closer count as one, K."""
LEAST_SPAN = 10.0  # K between coldest and hottest: less is no test over temperature
LEAST_KNOTS = 5
"""Temperatures from which a spline of the bias is tried."""
SETTLE = 300.0  # s of a soak that settles a small unit in a chamber
TURNED, FOLLOWED = 9, 3
"""Fewest attitudes of a recording whose turns give scale factors of gyroscopes, and fewest temperatures of such
recordings that give their slope."""

STRETCHES, TURNS = 1e-4, 1e-5
"""Usual slopes of scale factors and misalignments of such sensors, 1/K and rad/K."""


def parse_further(text: str | Sequence[str], option: str) -> tuple[str, ...]:
    """Return the names of further triads; the only one is ``gyro``.

    Raises
    ------
    OptionError
        There is another.
    """
    names = tuple(name.strip() for name in text.split(",")) if isinstance(text, str) else tuple(text)
    if not set(names) <= {"gyro"} or len(names) > 1:
        text = ",".join(names)
        raise OptionError(f"{option} {text!r}: expected gyro{meant(['gyro'], text)}")
    return names


def parse_degrees(text: str, option: str) -> str | tuple[int, int, int]:
    """Return ``auto``, or three degrees from a text such as ``3,2,1``.

    Raises
    ------
    OptionError
        It is neither.
    """
    degrees, spline = parse_laws(text, option)
    if spline:
        raise OptionError(f"{option} {text!r}: expected degrees such as 3,2,1; a spline is for a fit")
    return degrees


def parse_laws(text: str, option: str) -> tuple[str | tuple[int, int, int], bool]:
    """Return ``auto`` or the degrees that a text states, and whether the bias is a spline: ``3,2,1``, ``spline,2,1``.

    Raises
    ------
    OptionError
        It is none of them.
    """
    if text == "auto":
        return text, False
    parts = [part.strip() for part in text.split(",")]
    spline = parts[0] == "spline"
    degrees = [str(DEGREES[0]), *parts[1:]] if spline else parts
    if len(degrees) != 3 or not all(part.isdecimal() and int(part) <= HIGHEST for part in degrees):
        raise OptionError(
            f"{option} {text!r}: expected auto, or the degrees of bias, scale factor and misalignment, 0 to {HIGHEST}, "
            "such as 3,2,1, or spline,2,1 for a bias with a knot at each temperature"
            f"{meant(['auto', 'spline'], parts[0])}"
        )
    return (int(degrees[0]), int(degrees[1]), int(degrees[2])), spline


def check_degrees(text: str, option: str) -> str:
    """Return a text unchanged if `parse_laws` can read it; raises OptionError as it does."""
    parse_laws(text, option)
    return text
