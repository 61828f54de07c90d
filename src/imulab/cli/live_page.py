"""What `imulab live --page` and `imulab open` share: the options of the page, and a session that is shown there."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imulab.cli.options import note, whole_number
from imulab.errors import OptionError

if TYPE_CHECKING:
    from imulab.live.runner import Runner
    from imulab.records.calibration import Calibration

PagePort = Annotated[str | None, typer.Option("--port", metavar="N", help="Port of the page; a free one if not given.")]
NoBrowser = Annotated[bool, typer.Option("--no-browser", help="Print the address of the page, and open no browser.")]


def port_number(text: str | None) -> int:
    """Return the port to listen at; 0, a free one, of None."""
    port = 0 if text is None else whole_number(text, "--port")
    if not 0 <= port <= 65535:
        raise OptionError(f"--port {port}: expected 0 (a free one) to 65535")
    return port


def checked_page(page: bool, port: str | None, *, no_browser: bool, plain: bool) -> int | None:
    """Return the port of the page, None where there is to be none."""
    if not page:
        if port is not None or no_browser:
            raise OptionError(f"{'--no-browser' if port is None else '--port'}: expected --page with it")
        return None
    if plain:
        raise OptionError("--page together with --plain: expected one or the other")
    from imulab.live.page import require_server

    require_server()
    return port_number(port)


def again(save: str, texts: Mapping[str, str | None], output: str | None, record: Calibration) -> str:
    """Return the command that makes the same record from the recording, or the two where it has gyroscopes."""
    given = [word for key, text in texts.items() if text is not None for word in (f"--{key}", text)]
    to = ["-o", output] if output else []
    fit = ["imulab", "tumble", "fit", save, *given]
    if "gyro_bias_x" not in record.parameters:
        return shlex.join([*fit, *to])
    gyro = ["imulab", "tumble", "gyro", save, "--accel", "accel.json", *to]
    return f"{shlex.join([*fit, '-o', 'accel.json'])} && {shlex.join(gyro)}"


def on_page(
    runner: Runner,
    made: Callable[[], Calibration],
    command: Callable[[Calibration], str],
    output: str,
    *,
    port: int,
    browser: bool,
) -> None:
    """Show a session on the page until it is ended there or by Ctrl-C.

    Raises
    ------
    ImulabError
        Why the session ended, where it was no ordinary end.
    KeyboardInterrupt
        It was ended before there was a record.
    """
    from imulab.live.page.guided import GuidedPart
    from imulab.live.page.server import serve

    part = GuidedPart(runner, made, command, Path(output).name)
    try:
        serve([part], port, browser=browser)
    except KeyboardInterrupt:
        if part.record is None:
            raise
    else:
        if part.record is None and part.error is None:
            note(runner.kept())
    if part.error is not None:
        raise part.error
