"""Write commands.md, the reference of the command line, from the commands themselves."""

from __future__ import annotations

import re
from pathlib import Path

from imulab.cli.app import commands
from imulab.cli.command import Command
from imulab.options import GROUPS, Option

HEAD = """# The command line, command by command

Made from the commands themselves: the same text as `imulab COMMAND --help-all`. What all commands share (units,
intervals, exit status, project file) is [told once](index.md#the-command-line).
"""


def page() -> str:
    """Return the page, Markdown: a heading, the usage, the help and a table of options for every command."""
    return "\n\n".join([HEAD.strip(), *map(_section, commands())]) + "\n"


def _section(command: Command) -> str:
    """Return what the page says of one command."""
    words = ["imulab", command.path, *(each.shows for each in command.arguments), "[OPTIONS]"]
    parts = [f"## imulab {command.path}", f"    {' '.join(words)}", command.help]
    for group in GROUPS[:-1]:
        rows = [
            f"| {_spelt(each)} | {_cell(each.help)} | {_cell(each.unit)} | {_cell(_default(each))} |"
            for each in command.options
            if each.group == group
        ]
        if rows:
            title = "option" if group == GROUPS[0] else group
            parts.append("\n".join([f"| {title} | what it does | unit | default |", "|---|---|---|---|", *rows]))
    return "\n\n".join(parts)


def _spelt(option: Option) -> str:
    """Return the names of an option, and what it takes."""
    names = ", ".join(f"`{name}`" for name in (*option.flags, option.opposite) if name)
    return f"{names} {_cell(option.shows)}" if option.takes_value else names


def _default(option: Option) -> str:
    """Return the default as it would be typed; empty where there is none."""
    return (option.default or "") if option.takes_value else ""


def _cell(text: str) -> str:
    """Return text that stands in one cell of a table."""
    return re.sub(r"\s+", " ", text).replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    (Path(__file__).parent / "commands.md").write_text(page(), encoding="utf-8")
