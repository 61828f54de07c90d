"""Help texts of commands, separate because only `--help` needs them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Sequence
from textwrap import TextWrapper

from imulab.cli.command import HELP, HELP_ALL, Command
from imulab.options import GROUPS, Option

_WIDEST, _COLUMN = 100, 30  # characters of a line of help; of the column of options at most
_SCREEN = 40  # lines
_FOLDED = ("further triads", "reading", "all commands")
_KEPT = "\xa0"  # a space where no line ends
_TITLES = {GROUPS[0]: "Options", GROUPS[-1]: "Options of all commands"}


def command_help(command: Command, *, whole: bool = False) -> str:
    """Return the text of ``--help`` for a command: usage, description, and options in their groups.

    Where that is more than a screen, options that few runs need are only named, unless the `whole` is asked for.
    """
    usage = " ".join([f"Usage: imulab {command.path} [OPTIONS]", *(each.shows for each in command.arguments)])
    argument_rows = [(each.shows, f"{each.help}{' [required]' if each.required else ''}") for each in command.arguments]
    head = [*_wrapped(usage, " " * 7, first=""), "", *_paragraphs(command.help)]
    options = (*command.options, HELP, HELP_ALL)

    def lines(explained: Sequence[Option]) -> list[str]:
        rows = [(each.group, each.spelling, f"{each.help}{_remarks(each)}") for each in explained]
        column = _column([term for term, _ in argument_rows] + [term for _, term, _ in rows])
        text = [*head, *_list("Arguments", argument_rows, column)]
        for group in GROUPS:
            text += _list(_TITLES.get(group, group.capitalize()), [row[1:] for row in rows if row[0] == group], column)
        return text

    everything = lines(options)
    if whole or len(everything) <= _SCREEN:
        return "\n".join(everything)
    explained = [each for each in options if each.required or not (each.rare or each.group in _FOLDED)]
    named: dict[str, list[str]] = {}
    for each in options:
        if each not in explained:
            named.setdefault(each.group, []).append(each.flags[-1])
    rows = [(_TITLES.get(group, group.capitalize()), " ".join(flags)) for group, flags in named.items()]
    more = _list(f"More, explained by 'imulab {command.path} {HELP_ALL.flags[0]}'", rows, _COLUMN)
    return "\n".join([*lines(explained), *more])


def group_help(usage: str, text: str, options: Iterable[tuple[str, str]], commands: Iterable[tuple[str, str]]) -> str:
    """Return the text of ``--help`` for a group of commands."""
    lines = [f"Usage: {usage} [OPTIONS] COMMAND [ARGS]...", "", *_paragraphs(text)]
    for title, rows in (("Options", [*options, (", ".join(HELP.flags), HELP.help)]), ("Commands", [*commands])):
        lines += _list(title, rows, _column([term for term, _ in rows]))
    return "\n".join(lines)


def _remarks(option: Option) -> str:
    """Return unit and default of an option, and that it is required, in brackets."""
    default = f"default: {option.default}" if option.default is not None and option.takes_value else ""
    remarks = filter(None, (option.unit, default, "required" * option.required))
    return "".join(f" [{remark.replace(' ', _KEPT)}]" for remark in remarks)


def _paragraphs(text: str) -> list[str]:
    lines: list[str] = []
    for paragraph in text.split("\n\n"):
        lines += [*_wrapped(paragraph, "  "), ""]
    return lines[:-1]


def _column(terms: Sequence[str]) -> int:
    """Return the width of a column that has most of these terms."""
    widths = [len(term) + 2 for term in terms]
    return max((width for width in widths if width <= _COLUMN), default=_COLUMN)


def _list(title: str, rows: Sequence[tuple[str, str]], column: int) -> list[str]:
    """Return the lines of terms with their descriptions below a title; nothing without rows."""
    if not rows:
        return []
    lines = ["", f"{title}:"]
    for term, text in rows:
        head = f"  {term}".ljust(column + 2)
        beside = len(term) + 2 <= column
        lines += [] if beside else [head]
        lines += _wrapped(text, " " * (column + 2), first=head if beside else None) or [head.rstrip()]
    return lines


def _wrapped(text: str, indent: str, first: str | None = None) -> list[str]:
    width = max(min(shutil.get_terminal_size().columns, _WIDEST) - 2, 50)
    first = indent if first is None else first
    text = " ".join(re.split(r"[ \n]+", text))
    lines = TextWrapper(width, first, indent, break_on_hyphens=False, break_long_words=False).wrap(text)
    return [line.replace(_KEPT, " ") for line in lines]
