"""The project file ``imulab.toml``: what one would otherwise type with every command."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from imulab.errors import OptionError, listed
from imulab.toml import load_toml

NAME = "imulab.toml"
OFF = "IMULAB_NO_PROJECT"
_GRAVITY = ("gravity", "latitude", "height")
_PATHS = ("layout", "limits")
KEYS = (*_GRAVITY, *_PATHS, "limit")
_TITLE = re.compile(r"[^,\[\]]+\[[^,\[\]]+\]")


def find(folder: Path) -> Path | None:
    """Return the project file of a folder: there or above, up to the root of its repository or the home folder."""
    if os.environ.get(OFF):
        return None
    home = Path.home()
    for place in (folder, *folder.parents):
        if (place / NAME).is_file():
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
            raise OptionError(f"{shown}: unknown key {key!r}; known keys: {listed(KEYS, key)}")
        if isinstance(value, bool) or not isinstance(value, str | int | float) or value == "":
            raise OptionError(f"{shown}: {key} = {value!r}: expected a text or a number, as --{key} takes it")
        if key in _PATHS and not isinstance(value, str):
            raise OptionError(f"{shown}: {key} = {value!r}: expected the name of a file")
        found[key] = os.path.normpath(f"{shown}/../{value}") if key in _PATHS else str(value)
        if key in _PATHS and not Path(found[key]).is_file():
            raise OptionError(f"{shown}: {key} = {value!r}: no such file beside it")
    if "gravity" in found and len(found.keys() & set(_GRAVITY)) > 1:
        raise OptionError(f"{shown}: gravity together with latitude or height: expected one or the other")
    if "height" in found and "latitude" not in found:
        raise OptionError(f"{shown}: height without latitude: expected both")
    return found


def additions(said: Mapping[str, str], typed: Mapping[str, object], files: Sequence[str]) -> dict[str, str]:
    """Return what a project file adds to the options of a command.

    `typed` are the options that the command has, None where not given; `files` what it reads. Options of gravity count
    together: one that is typed leaves out those of the file. A layout is left out where the file that is read says
    itself what its columns are.
    """
    found = {key: text for key, text in said.items() if key in typed and typed[key] is None}
    if any(typed.get(key) is not None for key in _GRAVITY):
        found = {key: text for key, text in found.items() if key not in _GRAVITY}
    if "layout" in found and files and _describes_itself(files[-1]):
        del found["layout"]
    return found


def _describes_itself(file: str) -> bool:
    """Return whether a file is a record, a blob, native CSV or a log, which need no layout."""
    from imulab.cli.options import is_json
    from imulab.device.blob import is_blob
    from imulab.readers import is_pipe
    from imulab.readers.formats import TEXT, recognised

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
    titles = next((line for line in lines if not line.startswith("#")), "")
    return all(_TITLE.fullmatch(title.strip().strip('"')) for title in titles.split(","))
