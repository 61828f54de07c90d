"""What every command has: the project file, how much it says, and the size of what it unpacks."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from imulab.cli.options import choose, note, speech, tell
from imulab.errors import OptionError, listed, meant, quoted
from imulab.files import load_toml

# The project file ``imulab.files``: what one would otherwise type with every command.


NAME = "imulab.files"
OFF = "IMULAB_NO_PROJECT"
_GRAVITY = ("gravity", "latitude", "height")
_PATHS = ("layout", "limits")
KEYS = (*_GRAVITY, *_PATHS, "limit")


def find(folder: Path) -> Path | None:
    """Return the project file of a folder: there or above, up to the root of its repository or the home folder."""
    if os.environ.get(OFF):
        return None
    try:
        home = Path.home()
    except RuntimeError:  # no HOME, and nobody of this number is known
        home = None
    for place in (folder, *folder.parents):
        if os.path.lexists(place / NAME):  # what is no file is refused when it is read
            return place / NAME
        if place == home or (place / ".git").exists():
            break
    return None


def load(path: Path, shown: str) -> dict[str, str]:
    """Return what a project file says, as the texts that one would type; `shown` is what messages call it.

    Raises
    ------
    ReadError, OptionError
        It cannot be read, or has a key or value that it cannot have.
    """
    table = load_toml(path, shown, "project")
    found: dict[str, str] = {}
    for key, value in table.items():
        if key not in KEYS:
            raise OptionError(f"{shown}: unknown key {quoted(key)}; known keys: {listed(KEYS, key)}")
        if isinstance(value, bool) or not isinstance(value, str | int | float) or value == "":
            raise OptionError(f"{shown}: {key} = {quoted(value)}: expected a text or a number, as --{key} takes it")
        if key in _PATHS and not isinstance(value, str):
            raise OptionError(f"{shown}: {key} = {quoted(value)}: expected the name of a file")
        found[key] = _file(key, str(value), shown) if key in _PATHS else str(value)
    if "gravity" in found and len(found.keys() & set(_GRAVITY)) > 1:
        raise OptionError(f"{shown}: gravity together with latitude or height: expected one or the other")
    if "height" in found and "latitude" not in found:
        raise OptionError(f"{shown}: height without latitude: expected both")
    _check_values(found, shown)
    return found


def _file(key: str, value: str, shown: str) -> str:
    """Return the name of a file beside the project file, or of a layout that comes with imulab."""
    from imulab.readers.layout import shipped_file

    if key == "layout" and shipped_file(value):
        return value
    path = Path(os.path.normpath(Path(shown).parent / value))
    if path.is_dir():
        raise OptionError(f"{shown}: {key} = {quoted(value)}: expected the name of a file, found a folder")
    if not path.is_file():
        raise OptionError(f"{shown}: {key} = {quoted(value)}: no such file beside it")
    return f"./{path}" if key == "layout" and shipped_file(str(path)) else str(path)


def _check_values(found: Mapping[str, str], shown: str) -> None:
    """Check gravity and limit as if they were typed, whether or not this command takes them."""
    from imulab.gravity import gravity_option
    from imulab.quantities import quantity

    try:
        gravity_option(found.get("gravity"), found.get("latitude"), found.get("height"), "{}")
        if "limit" in found and not quantity(found["limit"], "limit", "acceleration", "mg") > 0:
            raise OptionError(f"limit {found['limit']!r}: expected more than 0")
    except OptionError as error:
        raise OptionError(f"{shown}: {error}") from None


def additions(settings: Mapping[str, str], typed: Mapping[str, object], files: Sequence[str]) -> dict[str, str]:
    """Return what a project file adds to the options of a command.

    `typed` are the options that the command has, None where not given; `files` what it reads. Options of gravity count
    together: one that is typed leaves out those of the file. A layout is left out where all files say themselves what
    their columns are; else it is for those that do not.
    """
    found = {key: text for key, text in settings.items() if key in typed and typed[key] is None}
    if any(typed.get(key) is not None for key in _GRAVITY):
        found = {key: text for key, text in found.items() if key not in _GRAVITY}
    if "layout" in found and files and all(map(_describes_itself, files)):
        del found["layout"]
    elif "layout" in found:
        from imulab.readers.layout import IfNeeded

        found["layout"] = IfNeeded(found["layout"])
    return found


def _describes_itself(file: str) -> bool:
    """Return whether a file is a record, a blob, native CSV or a log, which need no layout."""
    from imulab.cli.options import is_json
    from imulab.device.unit import is_blob
    from imulab.readers import is_pipe
    from imulab.readers.formats import TEXT, recognised
    from imulab.readers.text import is_native

    path = Path(file)
    if path.is_dir() or is_blob(file):
        return True
    if is_pipe(file) or not path.is_file():
        return False
    if is_json(file):
        return True
    with path.open("rb") as stream:
        kind = recognised(head := stream.read(65536))
    if kind is not TEXT:
        return kind.layout == "none"
    lines = head.decode("utf-8", "replace").lstrip("\ufeff").splitlines()
    return is_native(next((line for line in lines if line.strip() and not line.startswith("#")), ""))


# What every command has: how much it says, the project file, and the size of what it unpacks.


_ALIKE = 0.75  # --threshold is no misspelt --hold


def offer(root: Any) -> None:
    """Give every command the options that all have, and every option what the help shows for its value."""
    app = typer.Typer()
    app.command()(_common)
    quiet, verbose, no_project, unpack_limit = typer.main.get_command(app).params[:4]
    for path, command in commands_of(root):
        names = {parameter.name for parameter in command.params}
        given = sorted(names & set(KEYS))
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
    no_project: Annotated[bool, typer.Option("--no-project", help=f"Do without {NAME}.")] = False,
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
        from imulab.readers.formats import raise_limit

        raise_limit(None if unpack_limit is None else size(unpack_limit, "--unpack-limit"))
    values |= _from_project(values, files)
    begun = perf_counter()
    result = command(**values)
    tell(f"{path} took {perf_counter() - begun:.2f} s")
    return result


def _from_project(values: dict[str, Any], files: list[str]) -> dict[str, str]:
    if not speech().project or all(values.get(key, "") is not None for key in KEYS):
        return {}
    try:
        here = Path.cwd()
    except FileNotFoundError:  # the working folder was deleted
        return {}
    path = find(here)
    if path is None:
        tell(f"no project file {NAME} here or above")
        return {}
    shown = os.path.relpath(path, here)
    read = [name for key in files for name in _names(values[key])]
    added = additions(load(path, shown), values, read)
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
