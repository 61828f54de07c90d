"""``imulab open``: the workbench, in the browser of this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imulab.cli.live_page import NoBrowser, PagePort, port_number
from imulab.cli.options import note
from imulab.errors import OptionError

FOLDER = "imulab-files"
_NOT_OFFERED = ("live", "open", "demo", "fleet ")


def open(  # noqa: A001 -- the name of the command
    files: Annotated[
        list[str] | None, typer.Argument(metavar="[FILE...]", help="Recordings and records to begin with.")
    ] = None,
    port: PagePort = None,
    no_browser: NoBrowser = False,
) -> None:
    """Open the workbench in the browser: drop a recording, see it, calibrate it, take record, report and firmware.

    Prints one line with the address, which only this machine reaches. What is dropped or made is kept in the folder
    imulab-files. Ctrl-C ends it.
    """
    from imulab.cli.app import command
    from imulab.cli.common import commands_of

    number = port_number(port)
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
