"""The tree of commands."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from imulab._version import VERSION
from imulab.cli import allan, array, centrifuge, convert, export, fleet, records, tumble, warmup

_SETTINGS: dict[str, Any] = {
    "add_completion": False,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"], "max_content_width": 100},
}


def command() -> Any:
    """Return the root command."""
    app = typer.Typer(help="From recordings of inertial sensors to calibration records and reports.", **_SETTINGS)
    app.callback()(_root)
    app.add_typer(
        tumble.commands(_SETTINGS), name="tumble", help="Calibrate an accelerometer triad with gravity alone."
    )
    app.add_typer(array.commands(_SETTINGS), name="array", help="Fuse several gyroscopes on one axis into one rate.")
    app.add_typer(
        centrifuge.commands(_SETTINGS),
        name="centrifuge",
        help="Measure how a gyroscope's g-sensitive drift changes with g.",
    )
    app.add_typer(warmup.commands(_SETTINGS), name="warmup", help="Tabulate and subtract the bias after power-on.")
    app.add_typer(fleet.commands(_SETTINGS), name="fleet", help="Calibrate many units, and watch the line.")
    records.add_commands(app)
    app.command("convert")(convert.convert)
    app.command("export")(export.export)
    app.command("allan")(allan.allan)
    return typer.main.get_command(app)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"imulab {VERSION}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """From recordings of inertial sensors to calibration records and reports."""
