"""What every command has: how much it says, the project file, and the size of what it unpacks."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from imulab.cli import project
from imulab.cli.speech import choose, note, speech, tell
from imulab.errors import OptionError, listed, meant

_ALIKE = 0.75  # --threshold is no misspelt --hold


def offer(root: Any) -> None:
    """Give every command the options that all have, and every option what the help shows for its value."""
    app = typer.Typer()
    app.command()(_common)
    quiet, verbose, no_project, unpack_limit = typer.main.get_command(app).params[:4]
    for path, command in commands_of(root):
        names = {parameter.name for parameter in command.params}
        given = sorted(names & set(project.KEYS))
        command.params += [quiet, verbose, *([no_project] if given else [])]
        command.params += [unpack_limit] if "layout" in names else []
        files = [parameter.name for parameter in command.params if parameter.param_type_name == "argument"]
        command.callback = partial(_run, command.callback, path, files)
        for parameter in command.params:
            if parameter.param_type_name == "argument":
                parameter.display_type_rich = lambda ctx: ""  # the name says what it is
            elif parameter.metavar is None and not parameter.is_flag:
                parameter.metavar = _stand_in(parameter.default)


def _stand_in(default: Any) -> str:
    """What the help shows in the place of an option's value."""
    if not isinstance(default, str) or not default[:1].isdigit():
        return "VALUE"
    return "NUMBER" if default.replace(".", "", 1).isdigit() else "QUANTITY"


def commands_of(group: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every command below a group, with its path (``tumble fit``)."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands_of(command, f"{path}{name} ")
        else:
            yield f"{path}{name}", command


def _common(
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="No progress and no notes; warnings stay.")] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Say what was read and chosen, and how long it took.")
    ] = False,
    no_project: Annotated[bool, typer.Option("--no-project", help=f"Do without {project.NAME}.")] = False,
    unpack_limit: Annotated[
        str | None,
        typer.Option("--unpack-limit", metavar="SIZE", help="How much a compressed file may unpack to, such as 20GB."),
    ] = None,
) -> None:
    """Stand for the options that every command has."""


def _run(
    command: Callable[..., Any],
    path: str,
    files: list[str],
    /,
    *,
    quiet: bool,
    verbose: bool,
    no_project: bool = False,
    unpack_limit: str | None = None,
    **values: Any,
) -> Any:
    """Run a command, with what a project file says put where nothing was typed."""
    if quiet and verbose:
        raise OptionError("--quiet together with --verbose: expected one or the other")
    choose(quiet=quiet, verbose=verbose, project=not no_project)
    if "layout" in values:
        from imulab.quantities import size
        from imulab.readers.unpacking import raise_limit

        raise_limit(None if unpack_limit is None else size(unpack_limit, "--unpack-limit"))
    values |= _from_project(values, files)
    begun = perf_counter()
    result = command(**values)
    tell(f"{path} took {perf_counter() - begun:.2f} s")
    return result


def _from_project(values: dict[str, Any], files: list[str]) -> dict[str, str]:
    if not speech().project or all(values.get(key, "") is not None for key in project.KEYS):
        return {}
    try:
        here = Path.cwd()
    except FileNotFoundError:  # the working folder was deleted
        return {}
    path = project.find(here)
    if path is None:
        tell(f"no project file {project.NAME} here or above")
        return {}
    shown = os.path.relpath(path, here)
    read = [name for key in files for name in _names(values[key])]
    added = project.additions(project.load(path, shown), values, read)
    tell(f"project file {shown}{'' if added else ', which says nothing for this command'}")
    if added:
        note(f"{', '.join(f'--{key} {text}' for key, text in added.items())} from {shown}")
    return added


def _names(value: Any) -> list[str]:
    return [value] if isinstance(value, str) else list(value or [])


def usage(error: Any) -> str:
    """Return a mistake in the way a command was typed, as one line that says what there is instead."""
    context = getattr(error, "ctx", None)
    message = str(error.format_message())
    if context is None:
        return message
    known = getattr(context.command, "commands", None)
    if known and "command" in message.lower():
        typed = message.partition("'")[2].partition("'")[0]
        return f"{message.partition('. ')[0].rstrip('.')}; known commands: {listed(known, typed)}"
    close = ""
    if hasattr(error, "possibilities"):  # typer names the options that it finds like it, in its own words
        options = [name for parameter in context.command.params for name in parameter.opts]
        message, close = f"No such option: {error.option_name}", meant(options, error.option_name, _ALIKE)
    return f"{message.rstrip('.')}; see '{context.command_path} --help'{close}"
