"""What `imulab live --page` and `imulab open` share: the options of the page, and a session that is shown there."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imulab.cli.options import note, whole_number
from imulab.cli.speech import warn
from imulab.errors import OptionError

if TYPE_CHECKING:
    from imulab.live.page.bench import Workbench
    from imulab.live.page.files import Files
    from imulab.live.runner import Runner
    from imulab.records.calibration import Calibration

FOLDER = "imulab-files"
_NOT_OFFERED = ("live", "open", "demo", "fleet ")
PagePort = Annotated[str | None, typer.Option("--port", metavar="N", help="Port of the page; a free one if not given.")]
PageHost = Annotated[
    str | None,
    typer.Option(
        "--host", metavar="ADDRESS", help="Address of this machine to listen at, for others; 0.0.0.0 or ::, all."
    ),
]
NoBrowser = Annotated[bool, typer.Option("--no-browser", help="Print the address of the page, and open no browser.")]


def port_number(text: str | None) -> int:
    """Return the port to listen at; 0, a free one, of None."""
    port = 0 if text is None else whole_number(text, "--port")
    if not 0 <= port <= 65535:
        raise OptionError(f"--port {port}: expected 0 (a free one) to 65535")
    return port


def checked_host(text: str | None) -> str | None:
    """Return the address to listen at, with a warning where others reach it; None, this machine alone, of None."""
    if text is not None and text not in ("localhost", "::1") and not text.startswith("127."):
        warn(f"whoever reaches {text} and has the address below can use the page; it is not encrypted")
    return text


def checked_page(page: bool, port: str | None, host: str | None, *, no_browser: bool, plain: bool) -> int | None:
    """Return the port of the page, None where there is to be none."""
    if not page:
        for given, name in ((port, "--port"), (host, "--host"), (no_browser or None, "--no-browser")):
            if given is not None:
                raise OptionError(f"{name}: expected --page with it")
        return None
    if plain:
        raise OptionError("--page together with --plain: expected one or the other")
    from imulab.live.page import require_server

    require_server()
    return port_number(port)


def again(save: str, texts: Mapping[str, str | None], output: str | None, record: Calibration) -> str:
    """Return the command that makes the same record from the recording."""
    from imulab.live.further import FURTHER

    given = [word for key, text in texts.items() if text is not None for word in (f"--{key}", text)]
    further = [name for name in FURTHER if f"{name}_bias_x" in record.parameters]
    others = ["--with", ",".join(further)] if further else []
    return shlex.join(["imulab", "tumble", "fit", save, *given, *others, *(["-o", output] if output else [])])


def workbench(given: Sequence[str] = (), later: Sequence[str] = ()) -> tuple[Workbench, Files]:
    """Return the workbench and its files: those of its folder, those given, and those that may come later."""
    from imulab.cli.app import command
    from imulab.cli.common import commands_of
    from imulab.live.page.bench import Workbench
    from imulab.live.page.files import Files
    from imulab.live.page.forms import forms

    offered = [(path, each) for path, each in commands_of(command()) if not path.startswith(_NOT_OFFERED)]
    files = Files(Path(FOLDER), given, later)
    return Workbench(files, forms(offered)), files


def on_page(
    runner: Runner,
    made: Callable[[], Calibration],
    command: Callable[[Calibration], str],
    outputs: Sequence[str | None],
    *,
    port: int,
    host: str | None,
    browser: bool,
) -> None:
    """Show a session on the page, the workbench beside it, until it is ended there or by Ctrl-C.

    `outputs` are the names of the record, None where none was given, and of the other files to be written.

    Raises
    ------
    ImulabError
        Why the session ended, where it was no ordinary end.
    KeyboardInterrupt
        It was ended before there was a record.
    """
    from imulab.live.page.guided import GuidedPart
    from imulab.live.page.server import serve

    part = GuidedPart(runner, made, command, Path(outputs[0] or "record.json").name)
    bench, files = workbench(later=[name for name in (runner.recorder.path, *outputs) if name])
    try:
        serve([part, bench], port, host=checked_host(host), browser=browser)
    except KeyboardInterrupt:
        if part.record is None:
            raise
    else:
        if part.record is None and part.error is None:
            note(runner.kept())
    finally:
        files.end()
    if part.error is not None:
        raise part.error
