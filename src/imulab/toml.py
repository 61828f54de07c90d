"""TOML files: layouts, manifests of tests, limits."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from imulab.errors import ReadError


def load_toml(path: str | Path, name: str, what: str) -> dict[str, Any]:
    """Return the table of a TOML file; messages call the file `name`, and `what` is the kind that it should be.

    Raises
    ------
    ReadError
        There is no such file, it cannot be read, or it is not TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ReadError(f"{name}: no such {what} file") from None
    except IsADirectoryError:
        raise ReadError(f"{name}: expected a {what} file, found a folder") from None
    except OSError as error:
        raise ReadError(f"{name}: the {what} file cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ReadError(f"{name}: the {what} file cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ReadError(f"{name}: the {what} file is not TOML: {error}") from None
    except RecursionError:
        raise ReadError(f"{name}: the {what} file nests its tables or lists hundreds of levels deep") from None
