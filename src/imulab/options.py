"""The options of public functions, said once.

Name, type and default in the signature, help in the docstring, unit and choices in the annotation. Command line,
manifests, the project file and the page's forms are made from them.

A signature says name, type and default, its docstring the help. `Annotated` carries what a type cannot: a unit, the
words to choose from, how a text is read, and the group where help lists it. An option is a switch, or a keyword that a
text can stand for, unless it is `PROGRAM`; and whatever else is annotated with one of the functions below.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Unpack, get_args, get_origin, is_typeddict

from imulab import arguments
from imulab.errors import OptionError, listed
from imulab.quantities import number, quantity, whole_number

# Contents of docstrings in numpy's style, also where Python has removed them (``python -OO``).


_ENTRY = re.compile(r"^(\S[^\n]*)\n((?:[ ]+\S[^\n]*\n|\n(?=[ ]))+)", re.M)
_SENTENCE = re.compile(r".*?\.(?=\s+[A-Z\"`*]|$)", re.S)
_MARKS = re.compile(r"``\"?(.*?)\"?``|`([^`]*)`")


@cache
def docstring(owner: Any) -> str:
    """Return the docstring of a function, class or module, from its source where it has none at run time."""
    owner = inspect.unwrap(owner)
    return inspect.cleandoc(owner.__doc__) if owner.__doc__ else _from_source(owner)


def summary(owner: Any) -> str:
    """Return the first paragraph of a docstring, in one line."""
    return " ".join(docstring(owner).partition("\n\n")[0].split())


def description(owner: Any) -> str:
    """Return the text of a docstring before its sections."""
    return re.split(r"\n\n\w+\n-+\n", docstring(owner))[0]


@cache
def parameters(owner: Any) -> dict[str, str]:
    """Return the first sentence on each parameter in a function's docstring, or on each field in a class's.

    A ``TypedDict`` says of its further fields alone; those of the ones that it extends are theirs.
    """
    descriptions: dict[str, str] = {}
    for each in _extended(owner):
        section = re.search(r"^(?:Parameters|Attributes)\n-+\n(.*?)(?:\n\n\S|\Z)", docstring(each), re.M | re.S)
        for names, text in _ENTRY.findall(f"{section[1]}\n" if section else ""):
            text = " ".join(text.split())
            first = _SENTENCE.match(text)
            plain = _MARKS.sub(r"\1\2", first[0] if first else text)
            descriptions |= dict.fromkeys((name.strip() for name in names.split(",")), plain)
    return descriptions


def _extended(owner: Any) -> list[Any]:
    """Return a function or class, after the typed dictionaries that it extends, which Python does not keep."""
    if not is_typeddict(owner):
        return [owner]
    others = vars(sys.modules[owner.__module__]).values()
    return [x for x in others if is_typeddict(x) and x.__annotations__.keys() <= owner.__annotations__.keys()]


def _from_source(owner: Any) -> str:
    import ast  # 2 ms that no command needs

    name = owner.__name__ if inspect.ismodule(owner) else owner.__module__
    path = getattr(sys.modules.get(name), "__file__", None)
    try:
        place: Any = ast.parse(Path(path or "").read_bytes())
    except OSError:  # a module that was not read from a file
        return ""
    for name in () if inspect.ismodule(owner) else owner.__qualname__.split("."):
        kinds = (ast.FunctionDef, ast.ClassDef)
        place = next((each for each in place.body if isinstance(each, kinds) and each.name == name), None)
        if place is None:
            return ""
    return ast.get_docstring(place) or ""


# The options of commands, manifests and forms, made from the signatures of public functions, where each is said
# once.


FLAG = "--{}"
"""Name of an option in messages of the command line."""
GROUPS = ("model", "gravity", "further triads", "reading", "output", "all commands")
"""Order in which help and forms list options."""
_SWITCH = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}
Read = Callable[[str, str], Any]
"""The text of an option, and how messages call it, to its value; raises OptionError."""


class Mark(NamedTuple):
    """Marks an option."""

    name: str


class Group(NamedTuple):
    """Group of an option that does not belong to the model."""

    name: str


class Reads(NamedTuple):
    """Reader of the text of an option, and its placeholder in help.

    `words` are offered to complete it; where there are no `other` ones, they are all that it takes. `unit` is that of a
    bare number; `off` the option that says the opposite of a switch; `bare` the word that counts
    where none of the words follows the option.
    """

    read: Read | None = None
    shows: str = ""
    words: Sequence[str] | Callable[[], Sequence[str]] = ()
    other: bool = True
    unit: str = ""
    file: bool = False
    repeated: bool = False
    flags: tuple[str, ...] = ()
    off: str = ""
    help: str = ""
    bare: str = ""


PROGRAM, RARE = Mark("for programs only"), Mark("few runs need it: long help only names it")
FURTHER_TRIADS = Group("further triads")
READING = Group("reading")
OUTPUT = Group("output")
COMMON = Group("all commands")


def text(shows: str = "TEXT", words: Sequence[str] | Callable[[], Sequence[str]] = (), **more: Any) -> Reads:
    """Return the reader of an option whose value is the text."""
    return Reads(None, shows, words, **more)


def choice(words: Sequence[str], **more: Any) -> Reads:
    """Return the reader of one of a few words."""

    def read(word: str, called: str) -> str:
        if word not in words:
            raise OptionError(f"{called} {word!r}: expected one of {listed(words, word)}")
        return word

    return Reads(read, "|".join(words), tuple(words), other=False, **more)


def measure(kind: str, unit: str, shows: str = "", **more: Any) -> Reads:
    """Return the reader of a number with a unit of a kind; a bare number is in `unit`."""
    return Reads(
        lambda value, called: quantity(value, called, kind, unit), shows or kind.upper().split()[0], unit=unit, **more
    )


def parsed(read: Read, shows: str, words: Sequence[str] = (), **more: Any) -> Reads:
    """Return the reader of a text that another function reads."""
    return Reads(read, shows, tuple(words), **more)


def file(shows: str = "FILE", **more: Any) -> Reads:
    """Return the reader of the name of a file."""
    return Reads(None, shows, file=True, **more)


def either(off: str, **more: Any) -> Reads:
    """Return the reader of a switch that is on, off, or neither; `off` is the option that turns it off."""
    return Reads(off=off, **more)


def repeated(shows: str, **more: Any) -> Reads:
    """Return the reader of an option that may be repeated."""
    return Reads(None, shows, repeated=True, **more)


@dataclass(frozen=True)
class Option:
    """One option.

    Attributes
    ----------
    keyword
        Its name as a parameter in Python.
    owner
        The function or typed dictionary that has it, whose docstring says what it does.
    reads
        How its text is read, and what help shows for it.
    default
        Text that stands where none is given, None where that means: not used.
    required
        Whether it must be given.
    kind
        ``switch``, ``either`` (on, off or neither), ``texts`` (any number of them) or ``text``.
    group
        Where help lists it.
    rare
        Whether few runs need it.
    """

    keyword: str
    owner: Any
    reads: Reads
    default: str | None
    required: bool
    kind: str
    group: str
    rare: bool = False

    @property
    def name(self) -> str:
        """Name in manifests; the command line has dashes instead of underscores."""
        return self.keyword.rstrip("_")

    @property
    def flags(self) -> tuple[str, ...]:
        """Names on the command line, the short one first."""
        return self.reads.flags or ("--" + self.name.replace("_", "-"),)

    @property
    def takes_value(self) -> bool:
        """Whether a value follows it."""
        return self.kind.startswith("text")

    @property
    def shows(self) -> str:
        """Placeholder of its value in help."""
        default = self.default or ""
        if self.reads.shows or not default[:1].isdigit():
            return self.reads.shows or "VALUE"
        return "NUMBER" if default.replace(".", "", 1).isdigit() else "QUANTITY"

    @property
    def unit(self) -> str:
        """The unit of a bare number, where the default does not show it."""
        unit = self.reads.unit
        return "" if (self.default or "").endswith(f" {unit}") else unit

    @property
    def spelling(self) -> str:
        """Names on the command line, and the placeholder of its value."""
        names = ", ".join(self.flags) + (f" / {self.opposite}" if self.opposite else "")
        return f"{names} {self.shows}" if self.takes_value else names

    @property
    def opposite(self) -> str:
        """Flag that turns it off; empty where there is none."""
        return f"--{self.reads.off}" if self.reads.off else ""

    @property
    def rank(self) -> int:
        """Place of its group among all."""
        return GROUPS.index(self.group)

    @cached_property
    def help(self) -> str:
        """Its effect, in a sentence."""
        text = self.reads.help or parameters(self.owner).get(self.keyword, "")
        if elsewhere := re.fullmatch(r"As for (\w+)\.", text):
            function = getattr(import_module("imulab"), elsewhere[1])
            return next(each.help for each in options_of(function) if each.keyword == self.keyword)
        return text

    @property
    def words(self) -> tuple[str, ...]:
        """Words that complete it."""
        return tuple(self.reads.words() if callable(self.reads.words) else self.reads.words)

    def value(self, typed: str, called: str) -> Any:
        """Return the value of a text.

        Raises
        ------
        OptionError
            It is none that the option takes; the message calls the option `called`.
        """
        if self.kind == "switch":
            if typed.lower() not in _SWITCH:
                raise OptionError(f"{called} {typed!r}: expected yes or no")
            return _SWITCH[typed.lower()]
        return typed if self.reads.read is None else self.reads.read(typed, called)


@cache
def options_of(owner: Any) -> tuple[Option, ...]:
    """Return the options in the signature of a function, or in the fields of a typed dictionary."""
    owner = inspect.unwrap(owner)
    types = arguments.types_of(owner)
    options: list[Option] = []
    if not inspect.isfunction(owner):
        return tuple(x for name, kind in types.items() if (x := _option(owner, name, kind, None)) is not None)
    for name, parameter in inspect.signature(owner).parameters.items():
        kind = types.get(name)
        if parameter.kind is parameter.VAR_KEYWORD:
            if get_origin(kind) is Unpack:
                options += options_of(get_args(kind)[0])
        elif parameter.kind is parameter.KEYWORD_ONLY or _reads(kind) is not None:
            option = _option(owner, name, kind, parameter.default)
            options += [] if option is None else [option]
    return tuple(options)


def _reads(kind: Any) -> Reads | None:
    return next((each for each in arguments.metadata(kind) if isinstance(each, Reads)), None)


def _option(owner: Any, name: str, kind: Any, default: Any) -> Option | None:
    """Return a parameter as an option; None where it is for programs alone."""
    markers, kinds = arguments.metadata(kind), arguments.members(kind)
    reads, switch = _reads(kind), kinds == (bool,)
    if PROGRAM in markers or (reads is None and not switch and str not in kinds):
        return None
    group = next((each.name for each in markers if isinstance(each, Group)), GROUPS[0])
    reads = _by_type(kinds) if reads is None else reads
    shape = "either" if reads.off else "switch" if switch else "texts" if reads.repeated else "text"
    required = default is inspect.Parameter.empty
    return Option(name, owner, reads, _text(default), required, shape, group, RARE in markers)


def _by_type(kinds: Sequence[Any]) -> Reads:
    """Return the reader of a text for one of these types."""
    if kinds == (bool,):
        return Reads(words=("yes", "no"), other=False)
    if int in kinds:
        return Reads(whole_number, "N")
    if float in kinds:
        return Reads(number, "NUMBER")
    return file() if any(get_origin(kind) is PathLike or kind is PathLike for kind in kinds) else text()


def _text(default: Any) -> str | None:
    """Return the default of a signature as it is typed."""
    if default in (None, (), inspect.Parameter.empty):
        return None
    if isinstance(default, bool):
        return "yes" if default else "no"
    if isinstance(default, tuple):
        return ",".join(f"{each:g}" for each in default)
    return default if isinstance(default, str) else f"{default:g}"


def read_options(options: Sequence[Option], texts: Mapping[str, str | None], label: str) -> dict[str, Any]:
    """Return the values of all options, from the stated texts; `label` makes the name of one in messages (`FLAG`).

    Raises
    ------
    OptionError
        A text is none that its option takes.
    """
    values: dict[str, Any] = {}
    for option in options:
        typed = texts.get(option.name)
        words = option.default if typed is None else typed
        called = option.flags[-1] if label == FLAG else label.format(option.name)
        values[option.name] = None if words is None else option.value(words, called)
    return values


def names_of_columns(typed: str, called: str) -> list[str]:
    """Return the names in ``gyro_x,gyro_y``.

    Raises
    ------
    OptionError
        It is no such list.
    """
    names = [name.strip() for name in typed.split(",")]
    if not all(names) or len(set(names)) < len(names):
        raise OptionError(f"{called} {typed!r}: expected names of columns, each once, such as gyro_x,gyro_y")
    return names


def part_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of `imulab.read` that choose a part of a file."""
    names = ("topic", "instance", "window", "element", "units", "damaged", "serial")
    return {name: values[name] for name in names if name in values}
