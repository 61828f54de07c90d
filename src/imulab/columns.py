"""The names of columns, and the units that they may have: ``accel_x [m/s^2]``, ``gyro_x_3 [deg/s]``."""

from __future__ import annotations

import re

from imulab.errors import UnitError, quoted
from imulab.printable import has_hidden
from imulab.units import parse_unit

_QUANTITIES = {
    "time": ("time",),
    "accel": ("acceleration", "output"),
    "gyro": ("rate", "output"),
    "dtg": ("rate", "output"),
    "fog": ("rate", "output"),
    "temperature": ("temperature", "output"),
    "table_angle": ("angle", "output"),
}
_ELEMENT = re.compile(r"(?:accel|gyro)(?:_[xyz])?_(\d+)")
_CLOCK = re.compile(r"(?:t|time|timestamp|seconds)(?:(?: ?\(|[ _.])(s|ms|us|ns|min|h)\)?)?")
"""What loggers call the time, and the unit in it."""


def element_number(column: str, stem: str = "") -> int | None:
    """Return which of several IMUs a column such as ``accel_x_7`` (of the stem ``accel_x``) is of, None for others."""
    match = _ELEMENT.fullmatch(column)
    return int(match[1]) if match and column.startswith(f"{stem}_" if stem else "") else None


def parse_column_title(title: str, file: str) -> tuple[str, str]:
    """Split ``name [unit]``; a name outside the vocabulary may come without a unit.

    Raises
    ------
    UnitError
        No unit on a column that needs one, or an unknown unit.
    """
    name, bracket, rest = title.strip().strip('"').strip().partition("[")
    name = name.strip()
    check_name(name, title, file)
    if not bracket:
        if expected_quantities(name) is None:
            return name, "1"
        raise UnitError(f"{file}: column {name} has no unit; expected a title such as '{name} [{example_unit(name)}]'")
    if not rest.rstrip().endswith("]"):
        raise UnitError(f"{file}: column title {title.strip()!r}: expected 'name [unit]'")
    symbol = rest.rstrip()[:-1].strip()
    try:
        return name, parse_unit(symbol).symbol
    except UnitError as error:
        if expected_quantities(name) is None and symbol:
            return name, symbol  # not ours to convert: it passes through
        raise UnitError(f"{file}: column {name}: {error}") from None


def check_name(name: str, title: str, file: str) -> None:
    """Refuse what is meant as a name of the vocabulary but is not one."""
    if has_hidden(title.replace("\t", "")):
        raise UnitError(f"{file}: column title {quoted(title.strip())}: expected plain text, found a control character")
    if ";" in title or "\t" in title or title.count("[") > 1:
        mark = "';'" if ";" in title else "a tab" if "\t" in title else "blanks"
        raise UnitError(
            f"{file}: titles {title.strip()[:40]!r}: separated by {mark}, expected ','; describe the file with "
            "--layout FILE.toml (imulab show --formats has an example)"
        )
    lower = name.lower()
    clock = _CLOCK.fullmatch(lower)
    meant = "time" if clock else lower.replace(" ", "_")
    if meant != name and expected_quantities(meant) is not None:
        example = f", in a title such as 'time [{clock[1]}]'" if clock and clock[1] else ""
        raise UnitError(f"{file}: column {name!r}: expected the name {meant!r}{example}")


def expected_quantities(name: str) -> tuple[str, ...] | None:
    """Return what a column of the vocabulary measures, or may; None for other columns."""
    stem = name.removeprefix("truth_").removeprefix("std_")
    for prefix, quantities in _QUANTITIES.items():
        if stem == prefix or stem.startswith(prefix + "_"):
            return quantities
    return None


def example_unit(name: str) -> str:
    """Return a unit that a column of the vocabulary can have, for a message."""
    return {"time": "s", "acceleration": "m/s^2", "rate": "deg/s", "temperature": "degC", "angle": "deg"}[
        (expected_quantities(name) or ("time",))[0]
    ]


def check_unit(name: str, unit: str, file: str) -> None:
    """Check that a column of the vocabulary has a unit of its quantity.

    Raises
    ------
    UnitError
        It has none, or one of another quantity.
    """
    expected = expected_quantities(name)
    if expected is None:
        return
    quantity = parse_unit(unit).quantity if unit else "nothing"
    if quantity not in expected:
        raise UnitError(
            f"{file}: column {name}: expected a unit of {' or '.join(expected)}, found {unit!r} ({quantity})"
        )
