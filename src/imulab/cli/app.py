"""The tree of commands."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from imulab._version import VERSION
from imulab.cli.common import offer

_SETTINGS: dict[str, Any] = {
    "no_args_is_help": True,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"], "max_content_width": 100},
}
_EXAMPLES = """
\b
Examples:
  imulab show recording.csv
  imulab tumble fit recording.csv --gravity 9.81362 -o sn42.json --report sn42.html
  imulab apply sn42.json flight.csv -o corrected.csv
\b
'imulab COMMAND --help' says more; 'imulab demo' runs everything on simulated instruments.
"""
_GROUPS = {
    "tumble": "Calibrate an accelerometer triad with gravity alone.",
    "array": "Fuse several gyroscopes on one axis into one rate.",
    "centrifuge": "Measure how a gyroscope's g-sensitive drift changes with g.",
    "warmup": "Tabulate and subtract the bias after power-on.",
    "noise": "Model the noise of sensors at rest, for filters.",
    "thermal": "Calibrate an accelerometer triad over temperature.",
    "rate": "Calibrate gyroscopes by a rate table or by turns.",
    "fleet": "Calibrate many units, and watch the line.",
}
_SINGLE = ("convert", "export", "allan", "live", "open")
"""Commands with a module of their own; the others that are in no group are those of records."""
_SUMMARIES = {
    "apply": "Correct a recording by records.",
    "show": "Say what is in a record or recording, or what changed.",
    "report": "Draw the report of a record.",
    "demo": "Run all procedures on simulated instruments.",
    "convert": "Write a recording of any kind as CSV or Parquet.",
    "export": "Write firmware, a blob, or another program's files.",
    "live": "Guide a test while the unit is connected.",
    "open": "Open the workbench in the browser.",
    "allan": "Print Allan deviation and noise coefficients.",
    "tumble plan": "Choose the attitudes to measure.",
    "tumble simulate": "Simulate a recording of a tumble test.",
    "tumble fit": "Calibrate an accelerometer triad.",
    "tumble gyro": "Calibrate the gyroscope triad on top of that.",
    "tumble mag": "Calibrate a magnetometer triad beside it.",
    "tumble check": "Hold fresh attitudes against a record.",
    "array simulate": "Simulate a recording of an array.",
    "array merge": "Join files of one gyro each to an array.",
    "array calibrate": "Find bias, noise and alignment of every element.",
    "array fuse": "Fuse a file or a live stream into one rate.",
    "array compare": "Run every method over one recording.",
    "warmup plan": "Write the chamber programme of a test.",
    "warmup simulate": "Simulate the power cycles of a test.",
    "warmup fit": "Fit the table of a unit to its power cycles.",
    "warmup table": "Write the table as CSV, or a record from that CSV.",
    "centrifuge plan": "List the runs of a test, with what they will give.",
    "centrifuge simulate": "Simulate the runs of a test.",
    "centrifuge reduce": "Reduce a test to K at every g and to its curve.",
    "noise fit": "Fit a model of the noise to logs at rest.",
    "noise plan": "Say how long to record for a wanted accuracy.",
    "noise check": "Hold a new log against a noise record.",
    "noise simulate": "Simulate a log at rest.",
    "thermal simulate": "Simulate a unit at several temperatures.",
    "thermal fit": "Fit one model to recordings at several temperatures.",
    "rate simulate": "Simulate a unit on a rate table.",
    "rate fit": "Calibrate gyroscopes from steps of rate.",
    "rate turn": "Find scale factors from whole turns by hand.",
    "fleet run": "Calibrate every unit of a manifest that has no record.",
    "fleet status": "Say what is done, failed and missing.",
    "fleet report": "Draw the statistics of the line.",
}
"""What the lists of commands say, each a line; the commands' own help says more."""


def command(arguments: Sequence[str] = ()) -> Any:
    """Return the root command; where the arguments begin with a command or a group, without the others.

    Importing and building all of them takes a fifth of the time of a short command.
    """
    app = typer.Typer(
        help="From recordings of inertial sensors to calibration records and reports.", epilog=_EXAMPLES, **_SETTINGS
    )
    app.callback()(_root)
    first = arguments[0] if arguments else ""
    known = {name for name in (*_GROUPS, *_SUMMARIES) if " " not in name}
    wanted = {first} if first in known else known
    for name in _GROUPS:
        if name in wanted:
            app.add_typer(_module(name).commands(_SETTINGS), name=name, help=_GROUPS[name])
    if wanted - {*_GROUPS, *_SINGLE}:
        _module("records").add_commands(app)
    for name in _SINGLE:
        if name in wanted:
            app.command(name)(
                getattr(
                    _module(
                        {"allan": "noise", "convert": "records", "export": "records", "open": "live"}.get(name, name)
                    ),
                    name,
                )
            )
    root: Any = typer.main.get_command(app)
    for path, summary in _SUMMARIES.items():
        found = root
        for name in path.split():
            found = getattr(found, "commands", {}).get(name)
        if found:
            found.short_help = summary
    offer(root)
    return root


def _module(name: str) -> Any:
    return import_module(f"imulab.cli.{name}")


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
