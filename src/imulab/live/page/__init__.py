"""The page: a guided session and the workbench in a browser, served on this machine alone."""

from __future__ import annotations

from importlib.util import find_spec

from imulab.errors import OptionError

_NEEDED = ("starlette", "uvicorn", "websockets")


def require_server() -> None:
    """Check that what serves the page is here.

    Raises
    ------
    OptionError
        It is not; the message says how to get it.
    """
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        raise OptionError(f"the page needs {' '.join(missing)}, which is not here: pip install 'imulab[live]'")
