"""What column titles of other programs mean: sensor, axis and unit of ``Accelerometer X (g)``, ``a_x``, ``gyroADC[0]``.

A title is cut into words (at blanks, signs, digits, and where a capital follows a small letter). One word is the axis,
the last ones or what stands in brackets may be the unit, and the others say which sensor it is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from msgspec import Struct

from imulab.errors import UnitError
from imulab.units import parse_unit

_BRACKETS = re.compile(r"^(.*\S)\s*(?:\((.*)\)|\[([^\[\]]*)\])\s*$")
_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+|[µμ°ω]+")
_AXES = {"x": 0, "y": 1, "z": 2}
_SHORT = {
    "a": "accel",
    "acc": "accel",
    "accel": "accel",
    "gf": "accel",
    "g": "gyro",
    "gyr": "gyro",
    "gyro": "gyro",
    "w": "gyro",
    "ω": "gyro",
    "omega": "gyro",
    "rate": "gyro",
    "rot": "gyro",
    "m": "mag",
    "mag": "mag",
    "b": "mag",
    "h": "mag",
}
"""Names of a sensor that may stand before an axis without a sign between: ``ax``, ``GYROX``."""
_BEGINS = {
    "acc": "accel",
    "xl": "accel",
    "alpha": "accel",
    "gforce": "accel",
    "gyr": "gyro",
    "omega": "gyro",
    "angular": "gyro",
    "angvel": "gyro",
    "rotation": "gyro",
    "rot": "gyro",
    "rate": "gyro",
    "mag": "mag",
}
"""Beginnings of words that name a sensor wherever they stand in a title."""
_NO_READING = {
    *("bias", "drift", "std", "stddev", "var", "variance", "cov", "covariance", "uncertainty", "error", "offset"),
    *(
        "free",
        "user",
        "without",
        "nog",
        "angle",
        "angles",
        "euler",
        "quat",
        "quaternion",
        "gravity",
        "setpoint",
        "filter",
    ),
    *("clip", "clipping", "count", "temp", "temperature", "jerk", "dt", "fft", "range", "odr", "sensitivity", "status"),
}
"""Words of columns that hold no reading of a sensor, or none with gravity in it."""
_INCREMENT = {"delta", "increment", "incr", "dtheta", "dvel", "dv", "dang"}
_CLOCKS = {
    *(
        "t",
        "time",
        "timestamp",
        "timestamps",
        "stamp",
        "elapsed",
        "seconds",
        "millis",
        "micros",
        "nanos",
        "ticks",
        "tow",
    ),
    *("realtime", "clock", "uptime", "datetime", "date", "sampletimefine", "epoch", "unix", "ts"),
    *("zeit", "uhrzeit", "zeitstempel", "temps", "tiempo", "tempo"),
}
_COUNTERS = {"counter", "packet", "index", "sample", "frame", "seq", "sequence", "row"}
_ENDINGS = {
    "mps2": "m/s^2",
    "ms2": "m/s^2",
    "mss": "m/s^2",
    "radpersec": "rad/s",
    "radps": "rad/s",
    "rads": "rad/s",
    "rad": "rad/s",
    "dps": "deg/s",
    "degpersec": "deg/s",
    "degps": "deg/s",
    "degs": "deg/s",
    "mdps": "mdeg/s",
    "mg": "mg",
    "microt": "uT",
    "ut": "uT",
    "nt": "nT",
    "gauss": "gauss",
    "millis": "ms",
    "millisec": "ms",
    "milliseconds": "ms",
    "msec": "ms",
    "ms": "ms",
    "micros": "us",
    "microseconds": "us",
    "usec": "us",
    "us": "us",
    "nanos": "ns",
    "nanoseconds": "ns",
    "nsec": "ns",
    "ns": "ns",
    "seconds": "s",
    "secs": "s",
    "sec": "s",
    "s": "s",
    "g": "g",
    "raw": "count",
    "adc": "count",
    "lsb": "count",
    "counts": "count",
    "degc": "degC",
    "celsius": "degC",
}
"""Units as the last words of a title write them."""
_MIP = {"x8004": "g", "x8005": "rad/s", "x8006": "gauss"}
"""Fields of MicroStrain's MIP protocol, which its titles have in brackets, and their units."""
_WRITTEN = {
    "rad s^-1": "rad/s",
    "deg s^-1": "deg/s",
    "m s^-2": "m/s^2",
    "ms^-2": "m/s^2",
    "m/(s^2)": "m/s^2",
    "m/s/s": "m/s^2",
    "m/sec^2": "m/s^2",
    "rad/sec": "rad/s",
    "degrees/s": "deg/s",
    "deg/sec": "deg/s",
    "degree/s": "deg/s",
    "grad/s": "deg/s",
    "a.u.": "1",
    "au": "1",
    "local": "1",
    "no_units": "count",
    "sec": "s",
    "seconds": "s",
    "msec": "ms",
    "milliseconds": "ms",
    "usec": "us",
    "microseconds": "us",
    "nsec": "ns",
    "nanoseconds": "ns",
    "deg c": "degC",
    "c": "degC",
    "celsius": "degC",
    "raw": "count",
    "counts": "count",
    "g's": "g",
    "gs": "g",
    "gee": "g",
    "mgauss": "mgauss",
    "milligauss": "mgauss",
    "microtesla": "uT",
    "ut": "uT",
}
"""Units as brackets and units rows write them, beside the spellings that `parse_unit` knows."""


class Title(Struct, frozen=True):
    """What a title says.

    Attributes
    ----------
    text
        The title.
    sensor
        ``accel``, ``gyro``, ``mag``, ``temperature``, ``time``, ``counter``, or nothing where it is none of them.
    axis
        0 to 2, None for none.
    unit
        As the title writes it; empty if it does not.
    stem
        Its words without axis and unit: what the three titles of a triad share.
    increment
        Whether it is an angle or a velocity gained in a sample.
    """

    text: str
    sensor: str
    axis: int | None
    unit: str
    stem: tuple[str, ...]
    increment: bool = False


def known_unit(text: str) -> str:
    """Return the symbol of a unit as titles and units rows write it; empty where it is none."""
    text = " ".join(text.replace("\N{SUPERSCRIPT TWO}", "^2").split())
    for written in (text, _WRITTEN.get(text.lower(), "")):
        try:
            return parse_unit(written).symbol
        except UnitError:
            continue
    return ""


def is_units_row(fields: Sequence[str]) -> bool:
    """Return whether fields are units: none is a number, and most that are not empty are known."""
    words = [word.strip().strip('"').strip() for word in fields if word.strip()]
    if len(words) < 3 or any(map(is_number, words)):
        return False
    return sum(bool(known_unit(word)) for word in words) > len(words) / 2


def is_number(text: str) -> bool:
    """Return whether a text is one number, with a point or a comma."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def fields_of(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line as the C module splits it: blanks are spaces and tabs only."""
    return re.split(r"[ \t]+", line.strip(" \t\r")) if delimiter == " " else line.split(delimiter)


def titles_of(line: str, delimiter: str) -> list[str]:
    """Return the titles in a line, which may begin with # and have them in quotes."""
    return [title.strip().strip('"') for title in fields_of(line.lstrip("# "), delimiter)]


def read_title(title: str, unit: str = "") -> Title:
    """Return what a title says; `unit` is that of a units row, which goes before the title's own."""
    rest, stated = _split_unit(title.strip().lstrip("#").strip())
    words = [word.lower() for word in _WORD.findall(rest)]
    last = "".join(words[-1:])
    axis, words = _axis(words)
    if not (stated or unit):
        words, stated = _unit_of_words(words, last)
    symbol = known_unit(unit) or stated
    if symbol == "g" and rest != title.strip() and title.rstrip().endswith(("(G)", "[G]")) and "mag" in title.lower():
        symbol = "gauss"
    gained = "d" in words and {"ang", "angle", "theta", "v", "vel", "velocity"}.intersection(words)
    increment = bool(gained or _INCREMENT.intersection(words)) and not {"time", "t"}.intersection(words)
    return Title(title, _sensor(words, axis, symbol, increment), axis, symbol, tuple(words), increment)


def _split_unit(title: str) -> tuple[str, str]:
    """Return a title without the unit in brackets or behind ``in``, and that unit."""
    if (behind := re.fullmatch(r"(.+) in (\S+)", title)) and (symbol := known_unit(behind[2])):
        return behind[1], symbol
    match = _BRACKETS.match(title)
    if match is None:
        return title, ""
    inside = (match[2] if match[2] is not None else match[3]).strip()
    symbol = _MIP.get(inside) or ("" if inside.isdigit() else known_unit(inside))
    return (match[1], symbol) if symbol else (title, "")


def _axis(words: list[str]) -> tuple[int | None, list[str]]:
    """Return the axis that words name, and the words without it."""
    for place, word in enumerate(words):
        letter = word.removesuffix("axis")
        if letter in _AXES and (len(words) > 1 or len(word) == 1):
            return _AXES[letter], [*words[:place], *words[place + 1 :]]
    for place, word in enumerate(words):
        for axis, name in ((word[-1:], word[:-1]), (word[:1], word[1:])):
            if axis in _AXES and name in _SHORT:
                return _AXES[axis], [*words[:place], name, *words[place + 1 :]]
    if words[:1] == ["g"] and len(words) > 1 and words[1] in ("fx", "fy", "fz"):
        return _AXES[words[1][1]], ["gf", *words[2:]]
    if len(words) > 1 and words[-1] in ("0", "1", "2"):
        return int(words[-1]), words[:-1]
    if len(words) > 2 and words[-2] in ("0", "1", "2"):
        return int(words[-2]), [*words[:-2], words[-1]]
    return None, words


def _unit_of_words(words: list[str], last: str) -> tuple[list[str], str]:
    """Return words without those at their end that are a unit, and the unit; a lone letter is one behind the axis."""
    for count in (3, 2, 1):
        ending = "".join(words[-count:])
        if len(words) >= count and ending in _ENDINGS and (len(ending) > 1 or (len(words) > count and ending == last)):
            kept = words if ending in ("adc", "seconds", "millis", "micros", "nanos") else words[:-count]
            return kept, _ENDINGS[ending]
    return words, ""


def _sensor(words: list[str], axis: int | None, unit: str, increment: bool) -> str:
    """Return the sensor that words name; its unit goes before a word that several sensors may have."""
    if _NO_READING.intersection(words) and not increment:
        warm = {"temp", "temperature"}.intersection(words)
        return "temperature" if warm and axis is None else ""
    if axis is None:
        if unit in ("degC", "K") or (words == ["t"] and unit == "deg"):
            return "temperature"
        if _CLOCKS.intersection(words) or unit in ("s", "ms", "us", "ns"):
            return "time"
        return "counter" if _COUNTERS.intersection(words) else ""
    quantity = parse_unit(unit).quantity if unit else ""
    of_unit = {"acceleration": "accel", "rate": "gyro", "magnetic field": "mag"}.get(quantity, "")
    if increment:
        of_unit = {"angle": "gyro"}.get(quantity, of_unit)
    sensors = [_BEGINS[start] for word in words for start in _BEGINS if word.startswith(start)]
    sensors = sensors or (["gyro"] if {"ang", "vel"} <= set(words) else [])
    sensors = sensors or [_SHORT[word] for word in words if word in _SHORT]
    if increment and not sensors:
        sensors = ["gyro"] if {"theta", "angle", "ang", "dtheta", "dang"}.intersection(words) else ["accel"]
    if of_unit and (not sensors or of_unit not in sensors):
        return of_unit if not sensors or set(words) <= {"g"} else ""
    return sensors[0] if sensors else ""
