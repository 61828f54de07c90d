"""The options of a procedure's fit, defined once: the command line, manifests of fleets and checks are made from them.

An option is a text as a person writes it (``--settling-time "90 s"``, a cell of a manifest) and becomes a value in SI.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from keyword import iskeyword
from typing import Any

from imulab.errors import OptionError, listed
from imulab.quantities import number, quantity, span, whole_number

FLAG = "--{}"
"""How the command line calls an option in its messages."""
_SWITCH = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}


@dataclass(frozen=True)
class Option:
    """One option of a fit.

    Attributes
    ----------
    name
        As in Python and in manifests; the command line has dashes instead of underscores.
    help
        What it does, in a line, with the unit of a bare number.
    read
        The text, and how messages call the option, to its value; raises OptionError.
    default
        Text that stands where none is given, None where that means: not used.
    shows
        What stands for its value in the help: choices, or an example.
    choices
        The words that it takes, for completion; others may be taken too where `shows` says so.
    switch
        Whether the command line gives it without a value; a manifest says yes or no.
    names_file
        Whether it is the name of a file.
    """

    name: str
    help: str
    read: Callable[[str, str], Any]
    default: str | None = None
    shows: str = "TEXT"
    choices: tuple[str, ...] = ()
    switch: bool = False
    names_file: bool = False

    @property
    def keyword(self) -> str:
        """Its name as a parameter in Python, which ``with`` cannot be."""
        return self.name + "_" * iskeyword(self.name)

    @property
    def flag(self) -> str:
        """The option on the command line."""
        return "--" + self.name.replace("_", "-")


def names_of_columns(text: str, option: str) -> list[str]:
    """Return ``gyro_x,gyro_y`` as names.

    Raises
    ------
    OptionError
        It is no such list.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names) or len(set(names)) < len(names):
        raise OptionError(f"{option} {text!r}: expected names of columns, each once, such as gyro_x,gyro_y")
    return names


def text_option(name: str, help: str, **more: Any) -> Option:  # noqa: A002
    """Return an option that stays a text."""
    return Option(name, help, lambda text, _: text, **more)


def choice(name: str, help: str, choices: Sequence[str], default: str | None = None) -> Option:  # noqa: A002
    """Return an option that is one of a few words."""

    def read(text: str, called: str) -> str:
        if text not in choices:
            raise OptionError(f"{called} {text!r}: expected one of {listed(choices, text)}")
        return text

    return Option(name, help, read, default, "|".join(choices), tuple(choices))


def measure(name: str, help: str, kind: str, unit: str, default: str | None = None, **more: Any) -> Option:  # noqa: A002
    """Return an option that is a number with a unit of a kind; a bare number is in `unit`."""
    shows = more.pop("shows", unit.upper() if default is None else default.replace(" ", ""))
    return Option(name, help, lambda text, called: quantity(text, called, kind, unit), default, shows, **more)


def finite(name: str, help: str, default: str | None = None, shows: str = "NUMBER") -> Option:  # noqa: A002
    """Return an option that is a finite number."""
    return Option(name, help, number, default, shows)


def whole(name: str, help: str, default: str | None = None, shows: str = "N") -> Option:  # noqa: A002
    """Return an option that is a whole number."""
    return Option(name, help, whole_number, default, shows)


def switch(name: str, help: str) -> Option:  # noqa: A002
    """Return an option that is given or not."""

    def read(text: str, called: str) -> bool:
        if text.lower() not in _SWITCH:
            raise OptionError(f"{called} {text!r}: expected yes or no")
        return _SWITCH[text.lower()]

    return Option(name, help, read, "no", "yes|no", ("yes", "no"), switch=True)


def file_option(name: str, help: str, shows: str) -> Option:  # noqa: A002
    """Return an option that names a file."""
    return Option(name, help, lambda text, _: text, None, shows, names_file=True)


LAYOUT = file_option("layout", "Columns of a foreign file; see imulab show --formats.", "NAME|L.toml")
READING = (
    LAYOUT,
    text_option(
        "topic",
        "Topic of a bag or log, where there are several; with a comma, the magnetometer's beside it.",
        shows="TOPIC",
    ),
    whole("instance", "Sensor of a flight log, from 0; the first if not given."),
    Option("window", "Part to read, s; either side may be left out.", span, shows="FROM:TO"),
)
"""How a recording is read, whatever the procedure."""
ELEMENT = whole("element", "One IMU of a file of several, from 1.")


def part_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of `imulab.read` that choose a part of a file."""
    return {name: values[name] for name in ("topic", "instance", "window", "element") if name in values}


def read_options(options: Sequence[Option], texts: Mapping[str, str | None], label: str) -> dict[str, Any]:
    """Return the values of all options, from the texts of those given; `label` is how messages call one (`FLAG`).

    Raises
    ------
    OptionError
        A text is none that its option takes.
    """
    values: dict[str, Any] = {}
    for option in options:
        given = texts.get(option.name)
        text = option.default if given is None else given
        called = label.format(option.name.replace("_", "-") if label.startswith("--") else option.name)
        values[option.name] = None if text is None else option.read(text, called)
    return values
