"""``imulab open``: the workbench, in the browser of this machine."""

from __future__ import annotations

from typing import Annotated

import typer

from imulab.cli.live_page import FOLDER, NoBrowser, PageHost, PagePort, checked_host, port_number, workbench
from imulab.cli.options import note


def open(  # noqa: A001 -- the name of the command
    files: Annotated[
        list[str] | None, typer.Argument(metavar="[FILE...]", help="Recordings and records to begin with.")
    ] = None,
    port: PagePort = None,
    host: PageHost = None,
    no_browser: NoBrowser = False,
) -> None:
    """Open the workbench in the browser: drop a recording, see it, calibrate it, take record, report and firmware.

    Prints one line with the address, which only this machine reaches. What is dropped or made is kept in the folder
    imulab-files. Ctrl-C ends it.
    """
    from imulab.live.page import require_server

    number = port_number(port)
    require_server()
    from imulab.live.page.server import serve

    part, session = workbench(files or [])
    session.make()
    try:
        serve([part], number, host=checked_host(host), browser=not no_browser)
    finally:
        if session.end():
            note(f"what was dropped and made is in {FOLDER}")
