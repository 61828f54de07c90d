"""The commands: the module of each, and the search for the command that was typed."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any

from imulab import options
from imulab._version import VERSION
from imulab.cli.command import ALIKE, HELP, HELP_ALL, Command, values_of
from imulab.errors import OptionError, listed, meant

TITLE = "From recordings of inertial sensors to calibration records and reports."
EXAMPLES = """
  Examples:
    imulab show recording.csv
    imulab tumble fit recording.csv --gravity 9.81362 -o sn42.json --report sn42.html
    imulab apply sn42.json flight.csv -o corrected.csv

  'imulab COMMAND --help' says more, '--help-all' all; 'imulab demo' runs five procedures on simulated units."""
ROOT_OPTIONS = (
    ("--version", "Print the version."),
    ("--install-completion", "Install completion for the current shell."),
    ("--show-completion", "Show completion for the current shell, to copy it or customize the installation."),
)
_WHERE = {
    **dict.fromkeys(("apply", "show", "report", "demo"), "records"),
    **{"convert": "records", "export": "records", "allan": "noise", "live": "live", "open": "live"},
    **{
        x: x
        for x in (
            "tumble",
            "array",
            "centrifuge",
            "warmup",
            "noise",
            "thermal",
            "rate",
            "magnetometer",
            "fleet",
            "layout",
        )
    },
    "certificate": "certificate",
}
"""Module of each first word of a command."""


def commands(first: str = "") -> list[Command]:
    """Return all commands, or those that begin with a word."""
    names = [first] if first else _WHERE
    return [each for name in names for each in _module(_WHERE[name]).COMMANDS if each.path.split()[0] == name]


def find(words: Sequence[str]) -> Command | str:
    """Return the command that words begin with, and otherwise how many of them name a group.

    Raises
    ------
    OptionError
        They name none.
    """
    if not words or words[0].startswith("-") or words[0] not in _WHERE:
        return ""
    known = {command.path: command for command in commands(words[0])}
    path = " ".join(words[:2])
    variants = (known[f"{path} {word}"] for word in words[2:] if f"{path} {word}" in known)
    return known.get(words[0]) or next(variants, None) or known.get(path) or words[0]


def listed_commands(group: str = "") -> Iterator[tuple[str, str]]:
    """Yield the commands of a group, or the first words of all, and a line on each."""
    if group:
        yield from ((command.name[-1], command.summary) for command in commands(group) if not command.switch)
        return
    for name in _WHERE:
        first = commands(name)[0]
        yield name, first.summary if first.path == name else options.summary(_module(_WHERE[name]))


def run(words: Sequence[str]) -> int | None:
    """Run a command by the words that were typed; return its exit status, None for 0.

    Raises
    ------
    OptionError
        There is no such command, or it has no such option; and what the command raises.
    """
    from imulab.cli.common import run_command

    words = list(words)
    if _answered("", words):
        return None
    group = words.pop(0)
    if group not in _WHERE:
        raise _no_command(group, "")
    command = find([group, *words])
    if not isinstance(command, Command):
        if _answered(group, words):
            return None
        command = find([group, *words])
    if not isinstance(command, Command):
        raise _no_command(words[0], group)
    values, typed = values_of(command, words[len(command.name) - 1 :])
    if not typed & {HELP.keyword, HELP_ALL.keyword}:
        return run_command(command, values, typed)
    from imulab.cli.help import command_help

    print(command_help(command, whole=HELP_ALL.keyword in typed))
    return None


def _names(group: str) -> list[str]:
    return [name for name, _ in listed_commands(group)] if group else [*_WHERE]


def _no_command(word: str, group: str) -> OptionError:
    known = _names(group)
    second = {} if group else {name: _names(name) for name in known}
    begun = [f"{name} {word}" for name, names in second.items() if word in names]
    near = f"; expected {', '.join(begun)}" if begun else meant([*known, *chain.from_iterable(second.values())], word)
    return OptionError(f"No such command '{word}'; known commands: {' '.join(known)}{near}")


def _answered(group: str, words: list[str]) -> bool:
    """Consume the options of the root or of a group from the words, and print the answers to them."""
    known = {flag: lambda: print(_group_help(group)) for flag in (*HELP.flags, *HELP_ALL.flags)} | (
        {} if group else _ANSWERS
    )
    asked = [] if words else [*HELP.flags]
    while words and words[0].startswith("-") and words[0] != "-":
        word = words.pop(0)
        if word == "--":
            break
        if word not in known:
            path = f"imulab {group}".strip()
            raise OptionError(f"No such option: {word}; see '{path} --help'{meant(known, word, ALIKE)}")
        asked.append(word)
    if asked:
        known[asked[0]]()
    elif not words:
        raise OptionError(f"Missing command; known commands: {listed(_names(group), '')}")
    return bool(asked)


def _group_help(group: str) -> str:
    from imulab.cli.help import group_help

    if group:
        text = options.summary(_module(_WHERE[group]))
        return group_help(f"imulab {group}", text, (), listed_commands(group))
    return f"{group_help('imulab', TITLE, ROOT_OPTIONS, listed_commands())}\n{EXAMPLES}"


def _version() -> None:
    print(f"imulab {VERSION}")


def _show_completion() -> None:
    from imulab.cli import completion

    print(completion.script(completion.current_shell()))


def _install_completion() -> None:
    from imulab.cli import completion

    shell = completion.current_shell()
    print(f"{shell} completion installed in {completion.install(shell)}")
    print("Completion will take effect once you restart the terminal")


_ANSWERS = dict(zip(dict(ROOT_OPTIONS), (_version, _install_completion, _show_completion), strict=True))


def typed_words() -> list[str]:
    """Return the words of this process; on Windows, where no shell does it, with patterns replaced by file names."""
    words = sys.argv[1:]
    if os.name != "nt":
        return words
    expanded: list[str] = []
    for word in words:
        pattern = os.path.expandvars(str(Path(word).expanduser()))
        expanded += glob.glob(pattern, recursive=True) or [word]  # noqa: PTH207
    return expanded


def _module(name: str) -> Any:
    return import_module(f"imulab.cli.{name}")
