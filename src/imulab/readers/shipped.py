"""Layouts that come with imulab, by name, and which of them fit a file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from imulab.columns import kind_of
from imulab.readers.layout import load_layout, shipped_file, shipped_names
from imulab.readers.opened import holds
from imulab.recording import Layout

_MOST_LINES = 200  # of a head that show a known logger


@dataclass(frozen=True, slots=True)
class Shipped:
    """A layout that comes with imulab: name, the files that it is for, and its text."""

    name: str
    about: str
    layout: Layout

    @property
    def titles(self) -> frozenset[str]:
        """Titles of its columns; none where it uses numbers."""
        return frozenset(c.origin for c in self.layout.columns.values() if isinstance(c.origin, str))

    @property
    def sensors(self) -> list[str]:
        """Content of its columns, with a triad as one: ``time``, ``accel``, ``gyro``."""
        return list(dict.fromkeys(name.partition("_")[0] for name in self.layout.columns))


@cache
def shipped() -> tuple[Shipped, ...]:
    """Return all layouts that come with imulab, by name."""
    layouts = []
    for name in shipped_names():
        text = (shipped_file(name) or Path()).read_text(encoding="utf-8")
        layouts.append(Shipped(name, text.partition("\n")[0].removeprefix("# "), load_layout(name)))
    return tuple(layouts)


def fitting(head: bytes) -> list[str]:
    """Return the names of the layouts that fit the first lines of a text file.

    A layout fits where one line holds all titles that it wants, or begins with its prefix, and a line has one of its
    marks. One that wants only some of the titles of another that fits is not named. Layouts that count columns without
    a prefix cannot be recognised.
    """
    lines = head.decode("utf-8-sig", "replace").splitlines()[:_MOST_LINES]
    fits = [entry for entry in shipped() if any(_fits(entry, line) for line in lines) and _is_marked(entry, lines)]
    return [a.name for a in fits if not any(a.titles and a.titles < b.titles for b in fits)]


def _fits(entry: Shipped, line: str) -> bool:
    layout = entry.layout
    if layout.prefix:
        return line.startswith(layout.prefix + ("" if layout.prefix.endswith(":") else layout.delimiter))
    return bool(entry.titles) and any(holds(layout, line, sign) for sign in layout.delimiter or ",;\t")


def _is_marked(entry: Shipped, lines: list[str]) -> bool:
    """Return whether lines hold what only files of this program have beside their titles."""
    marks = entry.layout.marks
    return not marks or any(mark in line for line in lines for mark in marks)


def advice(head: bytes, layout: str | None = None) -> str:
    """Return advice on a layout for a text file, from its first lines; empty if none fits, or if `layout` does."""
    names = fitting(head)
    if not names:
        return _separated(head)
    if layout in names:
        return ""
    return f"looks like a file of {' or '.join(names)}: try {' or '.join(f'--layout {name}' for name in names)}"


def _separated(head: bytes) -> str:
    """Return the layout that fits except for the delimiter, with the change that it needs; empty if there is none."""
    lines = head.decode("utf-8-sig", "replace").splitlines()[:_MOST_LINES]
    for entry in shipped():
        if not entry.layout.delimiter or not _is_marked(entry, lines):
            continue
        for delimiter in {",", ";", "\t"} - {entry.layout.delimiter}:
            for number, line in enumerate(lines):
                if not entry.titles or not holds(entry.layout, line, delimiter):
                    continue
                rows = "".join(lines[number + 1 :])
                decimal = ' and decimal = ","' if delimiter != "," and "," in rows and "." not in rows else ""
                written = delimiter.replace("\t", "\\t")
                return (
                    f"looks like a file of {entry.name} with other separators: copy its layout (imulab show --formats "
                    f'{entry.name}) and set delimiter = "{written}"{decimal}'
                )
    return ""


def is_titled(head: bytes) -> bool:
    """Return whether titles name a sensor with its unit in brackets, as imulab does."""
    lines = head.decode("utf-8", "replace").splitlines()
    titles = next((line for line in lines if line.strip() and not line.startswith("#")), "").split(",")
    names = [title.partition("[")[0].strip(' "') for title in titles if "[" in title]
    return any(kind_of(name) not in (None, "time") for name in names)


def table() -> tuple[list[str], list[list[str]]]:
    """Return titles and rows of the list of layouts."""
    rows = [[entry.name, entry.about, " ".join(entry.sensors)] for entry in shipped()]
    return ["--layout", "files", "columns"], rows
