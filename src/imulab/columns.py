"""The names of columns, and the units that they may have: ``accel_x [m/s^2]``, ``gyro_x_3 [deg/s]``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from msgspec import Struct

from imulab.display import has_hidden
from imulab.errors import UnitError, quoted
from imulab.units import parse_unit


class Kind(Struct, frozen=True):
    """The quantities of columns of one name (None: any unit passes), a unit for messages, and the sensor's name.

    `triad`: the sensors have three axes, which may come as one array of shape (n, 3).
    """

    quantity: str | None
    example: str
    sensors: str = ""
    triad: bool = False


KINDS = {
    "time": Kind("time", "s"),
    "accel": Kind("acceleration", "m/s^2", "accelerometers", triad=True),
    "gyro": Kind("rate", "deg/s", "gyroscopes", triad=True),
    "mag": Kind(None, "uT", "magnetometers", triad=True),
    "dtg": Kind("rate", "deg/s", "tuned gyroscopes"),
    "fog": Kind("rate", "deg/s", "fibre-optic gyroscopes"),
    "temperature": Kind("temperature", "degC"),
    "table_angle": Kind("angle", "deg"),
}
"""The vocabulary: the name of a column is one of these, or begins with one and ``_``."""
TRIADS = tuple(name for name, kind in KINDS.items() if kind.triad)
INERTIAL = tuple(name for name, kind in KINDS.items() if kind.quantity in ("acceleration", "rate"))
"""The sensors whose noise a recording at rest shows."""
_ELEMENT = re.compile(rf"(?:{'|'.join(TRIADS)})(?:_[xyz])?_(\d+)")
_CLOCK = re.compile(r"(?:t|time|timestamp|seconds)(?:(?: ?\(|[ _.])(s|ms|us|ns|min|h)\)?)?")
"""Names of time columns in loggers, with their units."""
_WRITTEN_UNIT = re.compile(
    r"([\w .-]+?)[ _/,]*(?:\(([^()]*[^\d()][^()]*)\)|\{([^{}]*)\}|[ _]in[ _]([^\s()]+)| ([^\s()]*/[^\s()]*))"
)
"""Names with a unit in round brackets or braces, or behind a blank or ``in``."""


def kind_of(column: str) -> str | None:
    """Return the name in the vocabulary that a column such as ``gyro_x_3`` begins with, None for others."""
    return next((name for name in KINDS if column == name or column.startswith(f"{name}_")), None)


def triad(sensor: str) -> list[str]:
    """Return the names of the three columns of a sensor: ``accel_x``, ``accel_y``, ``accel_z``."""
    return [f"{sensor}_{axis}" for axis in "xyz"]


def shared_unit(units: Mapping[str, str], what: str, file: str) -> str:
    """Return the unit that columns of one kind share; `what` they are for the message.

    Raises
    ------
    UnitError
        They have different units.
    """
    symbols = {name: parse_unit(unit).symbol for name, unit in units.items()}
    if len({*symbols.values()}) > 1:
        titles = ", ".join(f"{name} [{unit}]" for name, unit in symbols.items())
        kind = kind_of(next(iter(units))) or next(iter(units))
        stated = f"if a title is wrong, --unit {kind}=UNIT states it for all"
        raise UnitError(f"{file}: {what} must share one unit, found {titles}; {stated}")
    return next(iter(symbols.values()))


def element_number(column: str, stem: str = "") -> int | None:
    """Return the number of the IMU of a column such as ``accel_x_7`` (with the stem ``accel_x``), None for others."""
    match = _ELEMENT.fullmatch(column)
    return int(match[1]) if match and column.startswith(f"{stem}_" if stem else "") else None


def stated_unit(column: str, units: Mapping[str, str]) -> str:
    """Return the unit that a caller states for a column, by its name or its sensor's; empty where none is stated."""
    return units.get(column) or units.get(kind_of(column) or "") or ""


def units_without(sensor: str, units: Mapping[str, str] | None) -> dict[str, str] | None:
    """Return stated units without those of a sensor, which is in another file; None where nothing is left."""
    return {name: unit for name, unit in (units or {}).items() if kind_of(name) != sensor} or None


def parse_column_title(title: str, file: str, units: Mapping[str, str] | None = None) -> tuple[str, str]:
    """Return name and unit of ``name [unit]``; a name outside the vocabulary may have no unit.

    `units` are stated by the caller, and stand for what titles do not say.

    Raises
    ------
    UnitError
        No unit on a column that needs one, or an unknown unit.
    """
    name, bracket, rest = title.strip().strip('"').strip().partition("[")
    name = name.strip()
    check_name(name, title, file)
    if not bracket:
        if stated := stated_unit(name, units or {}):
            return name, stated
        if expected_quantities(name) is None:
            return name, "1"
        example = example_unit(name)
        raise UnitError(
            f"{file}: column {name} has no unit; expected a title such as '{name} [{example}]', or "
            f"--unit {kind_of(name) or name}={example}"
        )
    if not rest.rstrip().endswith("]"):
        raise UnitError(f"{file}: column title {title.strip()!r}: expected 'name [unit]'")
    symbol = rest.rstrip()[:-1].strip()
    try:
        unit = parse_unit(symbol, expected_quantities(name) or ())
        stated = stated_unit(name, units or {})
        if stated and unit.quantity not in (expected_quantities(name) or (unit.quantity,)):
            return name, stated
        check_unit(name, unit.symbol, file)
        return name, unit.symbol
    except UnitError as error:
        if str(error).startswith(f"{file}:"):
            raise
        if expected_quantities(name) is None and symbol:
            return name, symbol  # not ours to convert: it passes through
        raise UnitError(f"{file}: column {name}: {error}") from None


def check_name(name: str, title: str, file: str) -> None:
    """Refuse a name that is probably a misspelt name of the vocabulary."""
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
    written = None if clock else _WRITTEN_UNIT.fullmatch(name)
    meant = "time" if clock else _words_joined(lower)
    if written and _is_sensor(stem := _words_joined(written[1].lower())):
        example = f"{stem} [{_known_unit(next(filter(None, written.groups()[1:])), stem)}]"
        raise UnitError(f"{file}: column {name!r}: expected a title such as {example!r}")
    if meant != name and _is_sensor(meant):
        example = f", in a title such as 'time [{clock[1]}]'" if clock and clock[1] else ""
        raise UnitError(f"{file}: column {name!r}: expected the name {meant!r}{example}")


def _words_joined(name: str) -> str:
    """Return a name with ``_`` between its words."""
    return re.sub(r"[ .()-]+", "_", name).strip("_")


def _is_sensor(name: str) -> bool:
    """Return whether a column is of the vocabulary; other columns may begin with ``mag``, too."""
    return (
        expected_quantities(name) is not None or re.fullmatch(r"(?:truth_|std_)?mag_[xyz](?:_\d+)?", name) is not None
    )


def _known_unit(text: str, name: str) -> str:
    """Return a unit as written, or an example of the column's where it is none of these."""
    try:
        parse_unit(text)
    except UnitError:
        return example_unit(name)
    return text


def expected_quantities(name: str) -> tuple[str, ...] | None:
    """Return the quantities that a column of the vocabulary may measure; None for other columns."""
    kind = kind_of(measured(name))
    quantity = None if kind is None else KINDS[kind].quantity
    return None if quantity is None else ("time",) if quantity == "time" else (quantity, "output")


def example_unit(name: str) -> str:
    """Return a unit that a column of the vocabulary can have, for a message."""
    return KINDS[kind_of(measured(name)) or "time"].example


def clocks_of(names: Iterable[str]) -> dict[str, str]:
    """Return the column of time that stamps each column: ``time``, or its sensor's own, such as ``time_gyro``."""
    names = list(names)
    clocks = {sensor: clock for sensor in KINDS if (clock := f"time_{sensor}") in names}
    return {
        name: name if name in clocks.values() else clocks.get(kind_of(measured(name)) or "", "time") for name in names
    }


def measured(name: str) -> str:
    """Return the column that a truth or a standard deviation belongs to: ``gyro_x`` of ``truth_gyro_x``."""
    return name.removeprefix("truth_").removeprefix("std_")


def check_unit(name: str, unit: str, file: str) -> None:
    """Refuse a unit of another quantity in a column of the vocabulary.

    Raises
    ------
    UnitError
        It has none, or one of another quantity.
    """
    expected = expected_quantities(name)
    if expected is None:
        return
    quantity = parse_unit(unit, expected).quantity if unit else "nothing"
    if quantity not in expected:
        gained = (quantity, expected[0]) in (("angle", "rate"), ("velocity", "acceleration"))
        hint = f"; of increments per sample state their rate too, such as {unit}@100Hz" if gained else ""
        raise UnitError(
            f"{file}: column {name}: expected a unit of {' or '.join(expected)}, found {unit!r} ({quantity}){hint}"
        )
