"""What every command does: reading the project file, setting verbosity and the limit of unpacking."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from inspect import signature
from pathlib import Path
from time import perf_counter
from typing import Any

from imulab.cli.command import KEYS, NAME, Command
from imulab.cli.options import choose, note, speech, tell
from imulab.errors import OptionError, listed, quoted
from imulab.files import load_toml, permit

# The project file ``imulab.toml``, which replaces options of every command.


OFF = "IMULAB_NO_PROJECT"
_GRAVITY, _PATHS = KEYS[:3], KEYS[3:5]


def find(folder: Path) -> Path | None:
    """Return the project file of a folder: in it or above, up to the root of its repository or the home folder."""
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
    """Return the content of a project file as texts of options; `shown` is its name in messages.

    Raises
    ------
    ReadError, OptionError
        It cannot be read, or has a key or value that it cannot have.
    """
    permit(path)
    table = load_toml(path, shown, "project")
    settings: dict[str, str] = {}
    for key, value in table.items():
        if key not in KEYS:
            raise OptionError(f"{shown}: unknown key {quoted(key)}; known keys: {listed(KEYS, key)}")
        if isinstance(value, bool) or not isinstance(value, str | int | float) or value == "":
            raise OptionError(f"{shown}: {key} = {quoted(value)}: expected a text or a number, as --{key} takes it")
        if key in _PATHS and not isinstance(value, str):
            raise OptionError(f"{shown}: {key} = {quoted(value)}: expected the name of a file")
        settings[key] = _file(key, str(value), shown) if key in _PATHS else str(value)
    if "gravity" in settings and len(settings.keys() & set(_GRAVITY)) > 1:
        raise OptionError(f"{shown}: gravity together with latitude or height: expected one or the other")
    if "height" in settings and "latitude" not in settings:
        raise OptionError(f"{shown}: height without latitude: expected both")
    _check_values(settings, shown)
    return settings


def _file(key: str, value: str, shown: str) -> str:
    """Return the name of a file beside the project file, or of a layout that comes with imulab."""
    from imulab.readers.layout import shipped_file

    if key == "layout" and shipped_file(value):
        return value
    path = Path(os.path.normpath(Path(shown).parent / value))
    permit(path)
    if path.is_dir():
        raise OptionError(f"{shown}: {key} = {quoted(value)}: expected the name of a file, found a folder")
    if not path.is_file():
        raise OptionError(f"{shown}: {key} = {quoted(value)}: no such file beside it")
    return f"./{path}" if key == "layout" and shipped_file(str(path)) else str(path)


def _check_values(settings: Mapping[str, str], shown: str) -> None:
    """Check gravity and limit as if they were typed, whether or not this command has them."""
    from imulab.gravity import gravity_option
    from imulab.quantities import quantity

    try:
        gravity_option(settings.get("gravity"), settings.get("latitude"), settings.get("height"), "{}")
        if "limit" in settings and not quantity(settings["limit"], "limit", "acceleration", "mg") > 0:
            raise OptionError(f"limit {settings['limit']!r}: expected more than 0")
    except OptionError as error:
        raise OptionError(f"{shown}: {error}") from None


def additions(settings: Mapping[str, str], typed: Mapping[str, object], files: Sequence[str]) -> dict[str, str]:
    """Return the options that a project file adds to a command.

    `typed` are the options that the command has, None where not given; `files` what it reads. Options of gravity count
    together: one that is typed leaves out those of the file. A layout is left out where all files say themselves what
    their columns are; else it is for those that do not.
    """
    added = {key: text for key, text in settings.items() if key in typed and typed[key] is None}
    if any(typed.get(key) is not None for key in (*_GRAVITY, "place")):
        added = {key: text for key, text in added.items() if key not in _GRAVITY}
    if "layout" in added and files and all(map(_describes_itself, files)):
        del added["layout"]
    elif "layout" in added:
        from imulab.readers.layout import IfNeeded

        added["layout"] = IfNeeded(added["layout"])
    return added


def _describes_itself(file: str) -> bool:
    """Return whether a file is a record, a blob, native CSV or a log, which needs no layout."""
    from imulab.device.unit import is_blob
    from imulab.readers import is_pipe
    from imulab.readers.formats import TEXT, recognised
    from imulab.readers.text import is_native
    from imulab.records import is_json

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


# The run of a command.


def run_command(command: Command, values: dict[str, Any], typed: set[str]) -> int | None:
    """Run a command, with options of the project file where none were typed; return its exit status."""
    quiet, verbose, no_project = (values.pop(name, False) for name in ("quiet", "verbose", "no_project"))
    if quiet and verbose:
        raise OptionError("--quiet together with --verbose: expected one or the other")
    choose(quiet=quiet, verbose=verbose, project=not no_project)
    if "unpack_limit" in values:
        from imulab.quantities import size
        from imulab.readers.formats import raise_limit

        limit = values.pop("unpack_limit")
        raise_limit(None if limit is None else size(limit, "--unpack-limit"))
    values |= _from_project(values, [each.keyword for each in command.arguments])
    if "typed" in signature(command.function).parameters:
        values["typed"] = typed
    begun = perf_counter()
    status = command.function(**values)
    tell(f"{command.path} took {perf_counter() - begun:.2f} s")
    return status if isinstance(status, int) else None


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
