"""``imulab open``: the workbench, in the browser of this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imulab.cli.options import note, whole_number
from imulab.errors import OptionError

FOLDER = "imulab-files"
_LAST_PORT = 65535
_NOT_OFFERED = ("live", "open", "demo", "fleet ")


def open(  # noqa: A001 -- the name of the command
    files: Annotated[
        list[str] | None, typer.Argument(metavar="[FILE...]", help="Recordings and records to begin with.")
    ] = None,
    port: Annotated[str, typer.Option("--port", metavar="N", help="Port on this machine; 0 takes a free one.")] = "0",
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, and open no browser.")] = False,
) -> None:
    """Open the workbench in the browser: drop a recording, see it, calibrate it, take record, report and firmware.

    Prints one line with the address, which only this machine reaches. What is dropped or made is kept in the folder
    imulab-files. Ctrl-C ends it.
    """
    from imulab.cli.app import command
    from imulab.cli.common import commands_of

    number = whole_number(port, "--port")
    if not 0 <= number <= _LAST_PORT:
        raise OptionError(f"--port {number}: expected 0 to {_LAST_PORT}")
    try:
        from imulab.live.page.bench import Workbench
        from imulab.live.page.files import Files
        from imulab.live.page.forms import forms
        from imulab.live.page.server import serve
    except ModuleNotFoundError as error:
        raise OptionError(f"the page needs {error.name}, which is not here: pip install 'imulab[live]'") from None
    offered = [(path, each) for path, each in commands_of(command()) if not path.startswith(_NOT_OFFERED)]
    session = Files(Path(FOLDER), files or [])
    try:
        serve([Workbench(session, forms(offered))], number, browser=not no_browser)
    finally:
        if session.end():
            note(f"what was dropped and made is in {FOLDER}")
