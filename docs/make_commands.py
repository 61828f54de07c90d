"""Write commands.md, the reference of the command line, from the commands themselves."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from imulab.cli.app import command

HEAD = """# The command line, command by command

Made from the commands themselves: the same text as `imulab COMMAND --help`. What all commands share (units, intervals,
exit status, project file) is [told once](index.md#the-command-line).
"""


def page() -> str:
    """Return the page, Markdown: a heading, the usage, the help and a table of options for every command."""
    root = command()
    return "\n\n".join([HEAD.strip(), *(_section(path, found) for path, found in _commands("imulab", root))]) + "\n"


def _commands(path: str, found: Any) -> Iterator[tuple[str, Any]]:
    """Yield every command below this one that is no group, with the words that call it."""
    inner = getattr(found, "commands", None)
    if inner is None:
        yield path, found
        return
    for name, below in inner.items():
        if not below.hidden:
            yield from _commands(f"{path} {name}", below)


def _section(path: str, found: Any) -> str:
    """Return what the page says of one command."""
    arguments = [item for item in found.params if item.param_type_name == "argument"]
    options = [item for item in found.params if item.param_type_name == "option" and not item.hidden]
    words = [item.make_metavar(_context(found)) for item in arguments]
    usage = " ".join([path, *words, "[OPTIONS]" if options else ""])
    parts = [f"## {path}", f"    {usage.strip()}", _plain(found.help or "")]
    rows = [f"| {_spelt(item, found)} | {_cell(item.help or '')} | {_default(item)} |" for item in options]
    if rows:
        parts.append("\n".join(["| option | what it does | default |", "|---|---|---|", *rows]))
    return "\n\n".join(part for part in parts if part)


def _context(found: Any) -> Any:
    import click

    return click.Context(found)


def _spelt(item: Any, found: Any) -> str:
    """Return the names of an option, and what it takes."""
    names = ", ".join(f"`{name}`" for name in [*item.opts, *item.secondary_opts])
    return names if item.is_flag else f"{names} {_cell(item.make_metavar(_context(found)))}"


def _default(item: Any) -> str:
    """Return the default as it would be typed; empty where there is none."""
    if item.is_flag or item.default is None or callable(item.default):
        return ""
    values = item.default if isinstance(item.default, list | tuple) else [item.default]
    return _cell(" ".join(str(value) for value in values))


def _plain(text: str) -> str:
    """Return help without the marks that are for a terminal."""
    return re.sub(r"[\b\f]\n?", "", text).strip()


def _cell(text: str) -> str:
    """Return text that stands in one cell of a table."""
    return re.sub(r"\s+", " ", _plain(text)).replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    (Path(__file__).parent / "commands.md").write_text(page(), encoding="utf-8")
