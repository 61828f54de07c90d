"""A session in the terminal: the view drawn several times a second, or a line for each event."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from textwrap import wrap

import numpy as np
from rich.console import Group
from rich.text import Text

from imulab.live.view import KnownUnit, View, in_words
from imulab.recording import Array
from imulab.report.traces import format_uncertain
from imulab.units import STANDARD_GRAVITY

_COLOURS = {
    "waiting": "white", "moving": "yellow", "settling": "yellow", "still": "cyan", "accepted": "green",
    "absent": "yellow", "unknown": "yellow", "silent": "red", "lost": "red",
}  # fmt: skip
_ROWS, _COLUMNS = 9, 37  # of the sphere on the terminal
_MILLI = 1e3  # to mg
_BAR = 14  # characters of a bar
_EVENTS = 3
"""Lines for the latest events, above the picture."""
_MOST_WARNINGS = 3  # the latest
_NARROW = 70  # characters of a terminal whose table has narrow gaps


def draw(view: View, width: int = 80, height: int = 24, *, by_hand: bool = False) -> Group:
    """Return a view for rich in `width` columns and `height` lines: what to do, the attitudes, and the parameters.

    `by_hand` is whether keys turn the unit. Parts without room are left out, the map first.
    """
    above = [*_advice(view, width), _progress(view), _facts(view)]
    below = [Text(line, style="yellow") for text in view.warnings[-_MOST_WARNINGS:] for line in wrap(text, width)]
    below.append(_keys(view, by_hand=by_hand))
    table = _parameters(view, width)
    room = height - _EVENTS - len(above) - len(below)
    sphere = _sphere(view)
    held = [Text(line) for line in wrap(_attitudes(view), width)]
    beside = max(map(len, table), default=0) + 3
    if beside + _COLUMNS <= width and len(sphere) + len(held) <= room:
        body = [*_side_by_side(table, sphere, beside), *held]
    elif len(table) + len(sphere) + len(held) <= room:
        body = [*table, *sphere, *held]
    else:
        body = [*table, *held[max(len(table) + len(held) - room, 0) :]][: max(room, 0)]
    lines = [*above, *body, *below]
    for line in lines:
        line.no_wrap, line.overflow = True, "ellipsis"
    return Group(*lines)


def _advice(view: View, width: int) -> list[Text]:
    """Return what to do, in a bar across the screen, and the unit's present attitude."""
    style = f"bold reverse {_COLOURS[view.state]}"
    progress = f": {view.hold:.1f} of {view.hold_needed:.1f} s" if view.state == "still" and view.hold else ""
    advice = f"{view.advice}{progress}"
    lines = [Text(f" {line}".ljust(width), style=style) for line in wrap(advice, width - 2) or [""]]
    lines += [Text(line) for line in wrap(view.outlook, width)]
    if view.up is not None:
        now = Text.assemble(("now ", "dim"), in_words(np.array(view.up)))
        if view.next is not None:
            apart = np.degrees(np.arccos(np.clip(np.dot(view.up, view.next), -1, 1)))
            now.append_text(Text.assemble(("   next ", "dim"), view.next_words, f"   {apart:.0f}° to turn"))
        lines.append(now)
    return lines


def _progress(view: View) -> Text:
    count, wanted = len(view.attitudes), max(view.wanted, len(view.attitudes), 1)
    full = round(_BAR * count / wanted)
    parts = [f"{count} of about {view.wanted} attitudes" if view.wanted else f"{count} attitudes"]
    parts += [f"target {text}: {_share(share)}" for text, share in view.targets]
    return Text.assemble(("█" * full, "green"), ("░" * (_BAR - full), "dim"), "  " + "   ".join(parts))


def _share(share: float) -> str:
    return "met" if share <= 1 else f"{share:.2g} times that" if share < np.inf else "not yet known"


def _facts(view: View) -> Text:
    counts = {name: number for name, number in vars(view.counts).items() if number and name != "gaps"}
    share = counts.pop("unread_share", 0.0)
    parts = [
        f"{view.seconds:.0f} s",
        f"{view.rate:.4g} Hz",
        "" if view.length is None else f"|f| {view.length:.5g} {view.unit} uncorrected",
        "" if view.temperature is None else f"{view.temperature:.1f} °C",
        *(f"{number} {name}" for name, number in counts.items()),
        f"{100 * share:.2g} % of bytes lost" if share else "",
        view.source,
        view.format,
    ]
    return Text("  ".join(part for part in parts if part), style="dim")


def _sphere(view: View) -> list[Text]:
    """Return a map of upward directions: z up at the top, x in the middle; o held, x off, N next, + now."""
    marks = np.full((_ROWS, _COLUMNS), "·")
    for up, mark in [
        *((held.up, "x" if held.aside else "o") for held in view.attitudes),
        *([(view.next, "N")] if view.next is not None else []),
        *([(view.up, "+")] if view.up is not None else []),
    ]:
        row = round((np.pi / 2 - np.arcsin(np.clip(up[2], -1, 1))) / np.pi * (_ROWS - 1))
        column = round((np.arctan2(up[1], up[0]) / (2 * np.pi) + 0.5) * (_COLUMNS - 1))
        marks[row, column] = mark
    lines = [Text("upward: o held, N next, + now", style="dim"), *(Text("".join(row)) for row in marks)]
    for line in lines[1:]:
        for mark, style in (("N", "bold magenta"), ("[+]", "bold cyan"), ("o", "green"), ("x", "bold red")):
            line.highlight_regex(mark, style)
    return lines


def _parameters(view: View, width: int) -> list[Text]:
    """Return a line for each kind of parameter: its axes, largest standard uncertainty, and ratio to the target."""
    if not view.parameters:
        return [Text("no result yet: more attitudes are needed", style="dim")] if view.attitudes else []
    kinds: dict[str, list[KnownUnit]] = {}
    for known in view.parameters:
        kinds.setdefault(known.name.rpartition("_")[0], []).append(known)
    rows: list[Sequence[str]] = [("", "x", "y", "z", "±", "unit", "")]
    for stem, each in kinds.items():
        for some in (each[k : k + 3] for k in range(0, len(each), 3)):
            axes = " ".join(known.name.rpartition("_")[2] for known in some)
            shown = [format_uncertain(known.value, known.standard_uncertainty) for known in some]
            worst = max(range(len(some)), key=lambda k: some[k].standard_uncertainty or 0.0)
            share = max((known.share for known in some if known.share is not None), default=None)
            met = "" if share is None else "met" if share <= 1 else f"{share:.2g}×"
            values = [value for value, _ in shown] + [""] * (3 - len(some))
            unit = some[0].unit.removesuffix(" off nominal")
            rows.append((stem if axes == "x y z" else f"{stem} {axes}", *values, shown[worst][1], unit, met))
    widths = [max(len(row[k]) for row in rows) for k in range(7)]
    lines = []
    for row in rows:
        fields = [
            text.ljust(size) if k in (0, 5) else text.rjust(size)
            for k, (text, size) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append(
            Text(
                (" " if width < _NARROW else "  ").join(fields),
                style="dim" if row is rows[0] else "green" if row[6] == "met" else "",
            )
        )
    return lines


def _side_by_side(left: list[Text], right: list[Text], place: int) -> list[Text]:
    lines = []
    for k in range(max(len(left), len(right))):
        line = left[k].copy() if k < len(left) else Text()
        line.pad_right(place - len(line))
        lines.append(line.append_text(right[k]) if k < len(right) else line)
    return lines


def _attitudes(view: View) -> str:
    parts = []
    for held in view.attitudes:
        off = "" if held.residual is None else f" {_MILLI * held.residual / STANDARD_GRAVITY:+.2f}"
        parts.append(f"{held.number}{off}{' OFF' if held.aside else ''}")
    return "|f| - g in mg:  " + "   ".join(parts) if parts else ""


def direction_of_key(key: str, wanted: Array | None) -> Array | None:
    """Return the direction that a key turns upward: x, y, z; down with X, Y, Z; the next one with n; else None."""
    if key == "n":
        return wanted
    axis = "xyz".find(key.lower()) if key else -1
    if axis < 0:
        return None
    direction: Array = np.eye(3)[axis] * (1.0 if key.islower() else -1.0)
    return direction


def _keys(view: View, *, by_hand: bool) -> Text:
    aside = [held.number for held in view.attitudes if held.aside]
    named = (aside or [held.number for held in view.attitudes])[-1:]
    drop = f"u: drop attitude {named[0]}   " if named else ""
    turn = "n xyz XYZ: turn   " if by_hand else ""
    if view.state == "unknown":
        return Text("g: read it as guessed   Ctrl-C: stop", style="dim")
    return Text(f"{turn}{drop}q: finish, write record   Ctrl-C: stop", style="dim")


@contextmanager
def keys(*, wanted: bool) -> Iterator[list[str]]:
    """Yield a list that `pressed` fills: keys without Enter, if standard input is a terminal that has them."""
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
    """Return a key that was pressed, or an empty text."""
    if not usable:
        return ""
    import os
    import select

    return os.read(sys.stdin.fileno(), 1).decode("ascii", "ignore") if select.select([sys.stdin], [], [], 0)[0] else ""
