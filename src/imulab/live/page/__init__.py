"""The page: a guided session and the workbench in a browser, served to this machine alone by default."""

from __future__ import annotations

from importlib.util import find_spec

from imulab.errors import OptionError, install

_NEEDED = ("starlette", "uvicorn", "websockets")


def require_server() -> None:
    """Refuse to go on without the packages that serve the page.

    Raises
    ------
    OptionError
        A package is missing; the message says how to get it.
    """
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        raise OptionError(f"the page needs {' '.join(missing)}, which is not here: {install('live')}")
