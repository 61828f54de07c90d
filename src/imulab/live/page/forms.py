"""Forms made from the commands themselves: what the command line takes stands once, in its own definitions."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imulab.errors import OptionError, listed, quoted

_FILE = re.compile(r"FILE|RECORD|[A-Z]+\.[a-z]+")
_SHARED = 8
"""An option that so many commands have is of files and output, not of the procedure."""
_LONGEST = 10_000


@dataclass(frozen=True)
class Field:
    """One parameter of a command.

    Attributes
    ----------
    name
        In the values of a form.
    flag
        As typed; empty for an argument. `unflag` is what turns a switch off that is neither way by default.
    kind
        ``file`` or ``files`` of the session, ``output``, ``switch``, ``either`` (on, off or neither), ``text``, or
        ``texts``: any number of them, the option once for each.
    shows
        What the help has in the place of the value.
    help
        As the command's help has it.
    default
        Text that stands where none is given.
    choices
        Words that it takes.
    other
        Whether it takes other texts too.
    required
        Whether it must be given.
    shared
        Whether many commands have it.
    ending
        Of the name of an output; empty for a folder.
    """

    name: str
    flag: str
    kind: str
    shows: str
    help: str
    default: str
    choices: tuple[str, ...] = ()
    other: bool = True
    required: bool = False
    shared: bool = False
    ending: str = ""
    unflag: str = ""


@dataclass(frozen=True)
class Form:
    """A command: its path (``tumble fit``), its line in the list of commands, its help, and its fields in order."""

    path: str
    summary: str
    help: str
    fields: tuple[Field, ...]

    def words(
        self, values: Mapping[str, Any], file: Callable[[str], str], output: Callable[[str, str], str]
    ) -> list[str]:
        """Return the words of the command line that these values make.

        Parameters
        ----------
        values
            By the names of fields: a text, a list of texts for files and texts, or a truth value, which says of an
            output that it is to be written under a name to be found. Empty ones count as not given.
        file
            Name of a file of the session to what the command line calls it.
        output
            Name that was given for an output (empty for one to be found) and its ending, to the same.

        Raises
        ------
        OptionError
            A value cannot be one of that field, or what is required is missing.
        """
        fields = {field.name: field for field in self.fields}
        for name in values:
            if name not in fields:
                raise OptionError(f"{self.path}: no field {quoted(name)}; expected {listed(fields, name)}")
        words = self.path.split()
        for field in sorted(self.fields, key=lambda field: bool(field.flag)):
            words += _words(field, values.get(field.name), file, output)
        return words


def forms(commands: Iterable[tuple[str, Any]]) -> dict[str, Form]:
    """Return the forms of commands by their paths, from paths and the definitions that typer made."""
    known = [(path, command) for path, command in commands]
    shared = Counter(parameter.name for _, command in known for parameter in command.params)
    found = {}
    for path, command in known:
        drawn = any(parameter.name == "report" for parameter in command.params)
        fields = tuple(_field(each, shared[each.name] >= _SHARED, drawn=drawn) for each in command.params)
        text = " ".join((command.help or "").split())
        found[path] = Form(path, command.short_help or text.partition(". ")[0].rstrip("."), text, fields)
    return found


def _field(parameter: Any, shared: bool, *, drawn: bool) -> Field:
    """Return a parameter as a field; `drawn` says that the command writes a report beside its output: a record."""
    shows = parameter.metavar or ""
    common = {"name": parameter.name, "shows": shows, "required": bool(parameter.required)}
    if parameter.param_type_name == "argument":
        kind = "files" if parameter.nargs == -1 else "file"
        return Field(flag="", kind=kind, help="", default="", other=False, **common)
    flag = next((name for name in parameter.opts if name.startswith("--")), parameter.opts[0])
    common |= {"flag": flag, "help": parameter.help or ""}
    if "-o" in parameter.opts or flag == "--report":
        return Field(
            kind="output", default="", ending=_ending(shows, drawn=drawn), **common | {"flag": _short(parameter)}
        )
    if parameter.is_flag:
        if parameter.secondary_opts:
            return Field(kind="either", default="", unflag=parameter.secondary_opts[0], shared=shared, **common)
        return Field(kind="switch", default="", shared=shared, **common)
    alternatives = [part for part in shows.split("|") if part]
    files = [part for part in alternatives if _FILE.fullmatch(part)]
    choices = tuple(getattr(each, "value", each) for each in parameter.shell_complete(None, ""))
    if files:
        other = len(files) < len(alternatives)
        return Field(
            kind="file", default=_text(parameter.default), choices=choices, other=other, shared=shared, **common
        )
    if parameter.multiple and shows.startswith("FILE"):  # from a form, each in its own layout
        return Field(kind="files", default="", other=False, shared=shared, **common)
    closed = bool(choices) and {*alternatives} == {*choices}
    kind = "texts" if parameter.multiple else "text"
    return Field(
        kind=kind, default=_text(parameter.default), choices=choices, other=not closed, shared=shared, **common
    )


def _short(parameter: Any) -> str:
    return "-o" if "-o" in parameter.opts else str(parameter.opts[0])


def _ending(shows: str, *, drawn: bool) -> str:
    if "." in shows:
        return "." + shows.rpartition(".")[2].lower()
    if shows == "DIR":
        return ""
    return ".json" if drawn else ".csv"


def _text(default: Any) -> str:
    return "" if default is None or isinstance(default, list | tuple) else str(default)


def _words(field: Field, value: Any, file: Callable[[str], str], output: Callable[[str, str], str]) -> list[str]:
    called = field.flag or field.shows or field.name
    if field.kind == "switch" or field.kind == "either":
        if not isinstance(value, bool | None):
            raise OptionError(f"{called}: expected yes or no, found {quoted(value)}")
        return [field.flag] if value else [field.unflag] if value is False and field.unflag else []
    named = field.kind == "output" and value is True
    texts = [] if named else [text for text in _texts(value, called) if text.strip()]
    if field.kind == "output":
        if not (named or texts or field.required):
            return []
        return [field.flag, output(texts[0] if texts else "", field.ending)]
    if not texts:
        if field.required:
            raise OptionError(f"{called}: expected {'a file' if 'file' in field.kind else 'a value'}")
        return []
    if field.kind == "files":
        return [word for text in texts for word in (_option(field.flag, file(text)) if field.flag else [file(text)])]
    if field.kind == "texts":
        return [word for text in texts for word in _option(field.flag, text.strip())]
    (text,) = texts[:1]
    if field.kind == "file":
        text = _file_or_word(field, text, file)
    elif field.choices and not field.other and text not in field.choices:
        raise OptionError(f"{called} {quoted(text)}: expected one of {listed(field.choices, text)}")
    if not field.flag:
        return [text]
    return [] if text == field.default else _option(field.flag, text)


def _file_or_word(field: Field, text: str, file: Callable[[str], str]) -> str:
    """Return what the command line calls a file of the session, or a word that names no other file."""
    try:
        return file(text)
    except OptionError:
        if not field.other or set(text) & {"/", "\\"} or Path(text).exists():
            raise
        return text


def _option(flag: str, text: str) -> list[str]:
    return [f"{flag}={text}"] if text.startswith("-") else [flag, text]


def _texts(value: Any, called: str) -> Sequence[str]:
    texts = [] if value is None else value if isinstance(value, list) else [value]
    for text in texts:
        if not isinstance(text, str) or "\0" in text or len(text) > _LONGEST:
            raise OptionError(f"{called}: expected a text, found {quoted(text)}")
    return texts
