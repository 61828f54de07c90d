"""Commands: a function of the command line and the public functions that its options come from; and parsing."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from imulab import arguments
from imulab import options as docstrings
from imulab.errors import OptionError, meant
from imulab.options import COMMON, READING, Option, Reads, options_of

NAME = "imulab.toml"
KEYS = ("gravity", "latitude", "height", "layout", "limits", "limit")
"""The project file, and the options that it may state."""
ALIKE = 0.82  # least likeness of a misspelt word: --unit is no misspelt --quiet


class Argument(NamedTuple):
    """Marks a parameter of a command's function that is given without an option; of a list, any number of them."""

    shows: str
    help: str


@dataclass(frozen=True)
class Positional:
    """An argument of a command."""

    keyword: str
    shows: str
    help: str
    many: bool
    required: bool
    default: Any


def option(shows: str, help: str, *flags: str, **more: Any) -> Reads:  # noqa: A002
    """Return the mark of a command's parameter as an option that no public function has."""
    return Reads(None, shows, help=help, flags=flags, **more)


def _common(
    *,
    quiet: Annotated[bool, option("", "No progress and no notes; warnings stay.", "-q", "--quiet"), COMMON] = False,
    verbose: Annotated[
        bool, option("", "Say what was read and chosen, and how long it took.", "-v", "--verbose"), COMMON
    ] = False,
    no_project: Annotated[bool, option("", f"Do without {NAME}."), COMMON] = False,
    unpack_limit: Annotated[
        str | None, option("SIZE", "How much a compressed file may unpack to, such as 20GB."), READING
    ] = None,
) -> None:
    """Declares the options that every command has."""


def _help(
    *,
    help: Annotated[bool, option("", "Show this message and exit.", "-h", "--help"), COMMON] = False,  # noqa: A002
    help_all: Annotated[bool, option("", "Explain every option and exit."), COMMON] = False,
) -> None:
    """Declares the options that are answered at once."""


HELP, HELP_ALL = options_of(_help)


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes
    ----------
    path
        As one types it: ``tumble fit``; with a switch that has options of its own, ``array simulate --imus``.
    function
        What it does. Its parameters are arguments and options of its own; ``**options`` takes those of `owners`.
    owners
        Returns the public functions, and typed dictionaries, whose options it has too.
    without, only
        Keywords of these that it has not; those that it has, where not all others.
    """

    path: str
    function: Callable[..., Any]
    owners: Callable[[], Sequence[Any]] = tuple
    without: tuple[str, ...] = ()
    only: tuple[str, ...] = ()

    @property
    def name(self) -> list[str]:
        """Words of its path without a switch."""
        return [word for word in self.path.split() if not word.startswith("-")]

    @property
    def switch(self) -> bool:
        """Whether a switch chooses it instead of the command without that."""
        return "--" in self.path

    @property
    def summary(self) -> str:
        """Line in lists of commands."""
        return docstrings.summary(self.function)

    @property
    def help(self) -> str:
        """Description in paragraphs."""
        return docstrings.description(self.function)

    @cached_property
    def arguments(self) -> tuple[Positional, ...]:
        """Arguments without an option, in order."""
        types, positionals = arguments.types_of(self.function), []
        for name, parameter in inspect.signature(self.function).parameters.items():
            for marker in arguments.metadata(types[name]):
                if isinstance(marker, Argument):
                    many, required = list[str] in arguments.members(types[name]), parameter.default is parameter.empty
                    default = None if required else parameter.default
                    positionals.append(Positional(name, marker.shows, marker.help, many, required, default))
        return tuple(positionals)

    @cached_property
    def options(self) -> tuple[Option, ...]:
        """Options, in the order of help."""
        function_options = options_of(self.function)
        taken = {
            *self.without,
            *(each.keyword for each in function_options),
            *(each.keyword for each in self.arguments),
        }
        more = [x for owner in self.owners() for x in options_of(owner) if x.keyword not in taken]
        chosen = [*function_options, *(x for x in more if not self.only or x.keyword in self.only)]
        names = {each.keyword for each in chosen}
        left_out = {*([] if names & {*KEYS} else ["no_project"]), *([] if "layout" in names else ["unpack_limit"])}
        chosen += [each for each in options_of(_common) if each.keyword not in left_out]
        return tuple(sorted(chosen, key=lambda each: each.rank))


def values_of(command: Command, words: Sequence[str]) -> tuple[dict[str, Any], set[str]]:
    """Return the values of a command's parameters, and which of them were typed; of help alone, where it is asked for.

    Raises
    ------
    OptionError
        The words are none of this command.
    """
    known = {flag: each for each in (*command.options, HELP, HELP_ALL) for flag in each.flags}
    opposite = {each.opposite: each for each in command.options if each.opposite}
    typed: dict[str, Any] = {}
    rest: list[str] = []

    def refuse(message: str, close: str = "") -> OptionError:
        return OptionError(f"{message}; see 'imulab {command.path} --help'{close}")

    def unknown(flag: str) -> OptionError:
        return refuse(f"No such option: {flag}", meant([*known, *opposite], flag, ALIKE))

    def take(each: Option, flag: str, value: str | None, left: list[str]) -> None:
        if value is None and each.reads.bare and not (left and _is_word(left[0], each.words)):
            typed[each.keyword] = each.reads.bare
        elif each.takes_value:
            if value is None and not left:
                raise OptionError(f"Option '{flag}' requires an argument.")
            text = left.pop(0) if value is None else value
            if not text.strip():  # a variable of a script that is not set
                raise refuse(f"{flag} {text!r} is empty; expected {each.shows}")
            typed[each.keyword] = [*typed.get(each.keyword, []), text] if each.kind == "texts" else text
        elif value is not None and flag.startswith("--"):
            raise OptionError(f"Option '{flag}' does not take a value.")
        else:
            typed[each.keyword] = flag not in opposite

    left = list(words)
    while left:
        word = left.pop(0)
        if word == "--":
            rest += left
            break
        if word[:1] != "-" or word == "-":
            rest.append(word)
        elif word.startswith("--"):
            flag, has_value, value = word.partition("=")
            each = known.get(flag) or opposite.get(flag)
            if each is None:
                raise unknown(flag)
            take(each, flag, value if has_value else None, left)
        else:
            for index, letter in enumerate(word[1:], 2):
                each = known.get(f"-{letter}")
                if each is None:
                    raise unknown(f"-{letter}")
                take(each, f"-{letter}", word[index:] or None, left)
                if each.takes_value:
                    break
    if asked := typed.keys() & {HELP.keyword, HELP_ALL.keyword}:
        return {}, asked
    values = dict(_given(command, rest, refuse))
    for each in command.options:
        if each.required and each.keyword not in typed:
            raise refuse(f"Missing option {' / '.join(map(_quoted, each.flags))}")
        values[each.keyword] = typed.get(each.keyword, False if each.kind == "switch" else each.default)
    if rest:
        raise refuse(f"Got unexpected extra argument(s) ({' '.join(rest)})")
    return values, {*typed}


def _is_word(word: str, known: Sequence[str]) -> bool:
    """Return whether a word behind an option that needs none is its value, perhaps misspelt, or the next argument."""
    return word in known or (word.isalpha() and meant(known, word) != "" and not Path(word).exists())


def _quoted(flag: str) -> str:
    return f"'{flag}'"


def _given(command: Command, rest: list[str], refuse: Callable[[str], OptionError]) -> Iterator[tuple[str, Any]]:
    """Yield the arguments; what is left of `rest` is one too many."""
    if not all(word.strip() for word in rest):
        shown = " ".join(each.shows for each in command.arguments)
        raise refuse(f"an argument is empty; expected {shown or 'none'}, found {' '.join(map(repr, rest))}")
    for each in command.arguments:
        if each.required and not rest:
            raise refuse(f"Missing argument '{each.shows}'")
        if each.many:
            yield each.keyword, list(rest) or None
            rest.clear()
        else:
            yield each.keyword, rest.pop(0) if rest else each.default
