"""A session in the terminal: the view drawn anew several times a second, or a line for each event."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from rich.console import Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from imulab.live.view import View
from imulab.report.elements import format_uncertain
from imulab.units import STANDARD_GRAVITY

_COLOURS = {"waiting": "white", "moving": "yellow", "settling": "yellow", "still": "cyan", "accepted": "green"}
_ROWS, _COLUMNS = 9, 37
_MILLI = 1e3


def draw(view: View) -> Group:
    """Return a view as what rich prints: what to do first, then where one is, then what is known."""
    colour = _COLOURS[view.state]
    head = Text(f" {view.advice} ", style=f"bold black on {colour}")
    beside = Table.grid(padding=(0, 3))
    beside.add_row(_sphere(view), _parameters(view))
    below = [Text(text, style="yellow") for text in view.warnings]
    if not view.parameters and view.why_not and view.attitudes:
        below.append(Text("No result yet: more attitudes are needed.", style="dim"))
    keys = Text("u drops the last attitude (or the one that is off)   q finishes and writes the record", style="dim")
    return Group(head, _facts(view), beside, _attitudes(view), *below, keys)


def _facts(view: View) -> Text:
    counts = {name: number for name, number in vars(view.counts).items() if number and name != "gaps"}
    wrong = ", ".join(f"{number} {name}" for name, number in counts.items())
    parts = [
        f"{view.source} {view.format}".strip(),
        f"{view.rate:.4g} Hz, {view.seconds:.0f} s",
        f"{len(view.attitudes)} of about {view.wanted} attitudes" if view.wanted else "",
        "" if view.length is None else f"|f| = {view.length:.5g} {view.unit}",
        "" if view.temperature is None else f"{view.temperature:.1f} °C",
        f"{view.state} {view.hold:.1f} s" if view.hold else view.state,
        wrong,
    ]
    return Text("  ".join(part for part in parts if part))


def _sphere(view: View) -> Panel:
    """The sphere of upward directions as a map: z up at the top, x in the middle; o held, x off, N next, + now."""
    marks = np.full((_ROWS, _COLUMNS), "·")
    for up, mark in [
        *((held.up, "x" if held.aside else "o") for held in view.attitudes),
        *([(view.next, "N")] if view.next is not None else []),
        *([(view.up, "+")] if view.up is not None else []),
    ]:
        row = round((np.pi / 2 - np.arcsin(np.clip(up[2], -1, 1))) / np.pi * (_ROWS - 1))
        column = round((np.arctan2(up[1], up[0]) / (2 * np.pi) + 0.5) * (_COLUMNS - 1))
        marks[row, column] = mark
    text = Text("\n".join("".join(row) for row in marks))
    for mark, style in (("N", "bold magenta"), ("[+]", "bold cyan"), ("o", "green"), ("x", "bold red")):
        text.highlight_regex(mark, style)
    return Panel(text, title="o held  N next  + now", expand=False)


def _parameters(view: View) -> Table:
    table = Table(box=None, padding=(0, 1))
    for title in ("parameter", "value", "±", "unit"):
        table.add_column(title, justify="right" if title in ("value", "±") else "left")
    for row in view.parameters:
        table.add_row(row.name, *format_uncertain(row.value, row.standard_uncertainty), row.unit)
    for text, share in view.targets:
        met = Text("met", style="green") if share <= 1 else Text(f"{share:.2g} times" if share < np.inf else "not yet")
        table.add_row(Text(f"target {text}"), met)
    return table


def _attitudes(view: View) -> Text:
    parts = Text("attitudes, |f| - g in mg: " if view.attitudes else "")
    for held in view.attitudes[-16:]:
        off = "" if held.residual is None else f" {_MILLI * held.residual / STANDARD_GRAVITY:+.2f}"
        parts.append(f"{held.number}{off}  ", style="bold red" if held.aside else "")
    return parts


@contextmanager
def keys(*, wanted: bool) -> Iterator[list[str]]:
    """Yield a list that `pressed` fills: keys without Enter where standard input is a terminal that has them."""
    try:
        import termios
        import tty

        usable = wanted and sys.stdin is not None and sys.stdin.isatty()
        before = termios.tcgetattr(sys.stdin) if usable else None
    except ImportError:  # no terminal of this kind, as on Windows
        usable, before = False, None
    try:
        if usable:
            tty.setcbreak(sys.stdin)
        yield ["yes"] if usable else []
    finally:
        if before is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def pressed(usable: list[str]) -> str:
    """Return a key that was pressed, or nothing."""
    if not usable:
        return ""
    import os
    import select

    return os.read(sys.stdin.fileno(), 1).decode("ascii", "ignore") if select.select([sys.stdin], [], [], 0)[0] else ""
