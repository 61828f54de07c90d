r"""How results and texts show themselves.

Texts of files made safe to print, results as a headline and a table, the verdict on a result, and what recordings
and records are shown by, handed down from the rooms above them.

A record, a title or a comment is somebody else's text. Unicode knows more line ends than ``\n`` (U+0085, U+2028), and
marks that reverse what is shown (Unicode TR 36, bidirectional text spoofing).

A procedure writes its findings as sentences. A plain ``str`` asks a person to look; a `Bad` one forbids use as it is; a
`Note` is worth knowing and changes nothing.

A person asks a `Recording` or a `Calibration` to plot, to correct or to export; what does so knows every procedure and
lies above them. The face of the package says where it is to be had, and the methods ask `views` for it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import Any, Literal, Protocol

# Texts that files bring along, made safe to print: no character that ends a line, moves the cursor or turns text.


_HIDDEN = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")
_HIDDEN_IN_LINES = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")


def has_hidden(text: str) -> bool:
    """Return whether a text holds a control or bidirectional character."""
    return _HIDDEN.search(text) is not None


def _escape(found: re.Match[str]) -> str:
    r"""Return a character as Python writes it in `repr`: ``\x1b``, ``\u2028``."""
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def printable(text: str, *, lines: bool = False) -> str:
    """Return a text with its control and bidirectional characters as escapes; with `lines`, line breaks stay."""
    return (_HIDDEN_IN_LINES if lines else _HIDDEN).sub(_escape, text)


def first_hidden(value: Any, where: str = "") -> str | None:
    """Return where in plain JSON values the first text or key with a hidden character stands, or None."""
    if isinstance(value, str):
        return where.lstrip(".") if has_hidden(value) else None
    if isinstance(value, Mapping):
        for key, item in value.items():
            place = f"{where}.{printable(str(key))}"
            if has_hidden(str(key)):
                return place.lstrip(".")
            if found := first_hidden(item, place):
                return found
    elif isinstance(value, Sequence) and not set(map(type, value)) <= {float, int}:
        for index, item in enumerate(value):
            if found := first_hidden(item, f"{where}[{index}]"):
                return found
    return None


# Results that are no records, as they show themselves: a headline and a table, as text or as HTML.


LINES = 12
"""Of a result, as Python shows it."""
WIDTH = 150


class Shown:
    """A result that shows itself as `shown` has it."""

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return a headline, the titles of a table, and its rows."""
        raise NotImplementedError

    def __repr__(self) -> str:
        headline, titles, rows = self.shown()
        lines = [headline, *(aligned(titles, rows) if rows else [])]
        if len(lines) > LINES:
            lines = [*lines[: LINES - 1], f"... and {len(lines) - LINES + 1} more"]
        return "\n".join(line if len(line) <= WIDTH else line[: WIDTH - 4] + " ..." for line in lines)

    def _repr_html_(self) -> str:
        headline, titles, rows = self.shown()
        return f"<div><strong>{escape(headline)}</strong>{html_table(titles, rows) if rows else ''}</div>"


def html_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML."""
    right = _numeric_columns(rows, len(titles))
    styles = [f' style="text-align: {"right" if number else "left"}; padding: 1px 8px"' for number in right]
    head = "".join(f"<th{style}>{escape(title)}</th>" for title, style in zip(titles, styles, strict=True))
    cells = (zip(row, styles, strict=True) for row in rows)
    body = "".join("<tr>" + "".join(f"<td{s}>{escape(cell)}</td>" for cell, s in row) + "</tr>" for row in cells)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def aligned(titles: list[str], rows: list[list[str]]) -> list[str]:
    """Return a table as lines of text; texts to the left, numbers to the right."""
    table = [titles, *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(titles))]
    numeric = _numeric_columns(rows, len(titles))
    return [
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in table
    ]


def _numeric_columns(rows: Sequence[Sequence[str]], count: int) -> list[bool]:
    """Return which columns hold numbers."""
    return [all(_numeric(row[i]) for row in rows) for i in range(count)]


def _numeric(text: str) -> bool:
    return text in ("–", "not stated", "in noise") or text.lstrip("+-")[:1].isdigit()


# The verdict on a result: can it be used as it is, should a person look first, or must it not be used.


State = Literal["good", "look", "bad"]


class Note(str):
    """A finding that does not lower the verdict."""

    __slots__ = ()


class Bad(str):
    """A finding after which the result must not be used as it is."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Verdict:
    """``good``, ``look`` or ``bad``, and the findings that led to it, the gravest first."""

    state: State
    reasons: tuple[str, ...] = ()


UNJUDGED = Verdict("good")
"""Stands for a verdict that has not been formed yet."""

SENTENCES: dict[State, str] = {
    "good": "nothing in the data speaks against this result",
    "look": "understand this before you use the result",
    "bad": "do not use this result as it is",
}


def verdict_of(findings: Iterable[str]) -> Verdict:
    """Return the verdict that a procedure's findings lead to."""
    findings = tuple(findings)
    grave = [finding for finding in findings if isinstance(finding, Bad)]
    doubtful = [finding for finding in findings if not isinstance(finding, Bad | Note)]
    return Verdict("bad" if grave else "look" if doubtful else "good", tuple(map(str, grave + doubtful)))


def as_judged(findings: Iterable[str], verdict: Verdict) -> tuple[str, ...]:
    """Return findings, read back as plain texts, as what they were when they led to a verdict.

    What is no reason is a `Note`; the first reason of a bad verdict is `Bad` (the others cannot be told apart).
    """
    worst = verdict.reasons[0] if verdict.state == "bad" and verdict.reasons else None
    return tuple(
        Bad(finding) if finding == worst else finding if finding in verdict.reasons else Note(finding)
        for finding in findings
    )


# What recordings and records show of themselves and are used for, handed down from the rooms above them.


class AnyPlot(Protocol):
    """One figure, which shows itself in a notebook; `imulab.report.plots.Plot` says more."""

    @property
    def name(self) -> str:
        """Title of the figure."""

    def to_dict(self) -> dict[str, Any]:
        """Return the figure as Plotly's own JSON values: ``data`` and ``layout``."""

    def save(self, path: str | Path) -> None:
        """Write the figure: ``.html`` as a page that needs no network, ``.png``, ``.svg`` and ``.pdf`` as a picture."""


class AnyPlots(Protocol):
    """Several figures, by number or by words of their titles; `imulab.report.plots.Plots` says more."""

    def __getitem__(self, which: int | str) -> AnyPlot:
        """Return a figure by its number, or by its title or words of it."""

    def __iter__(self) -> Iterator[AnyPlot]:
        """Yield the figures."""

    def __len__(self) -> int:
        """Return how many there are."""

    @property
    def names(self) -> list[str]:
        """Titles of the figures."""

    def save(self, path: str | Path) -> None:
        """Write all figures as one page, ``.html``, or the only one as a picture."""


class Views(Protocol):
    """The functions of `imulab.procedures.views`; what is a record or a recording is seen from above alone."""

    def load(self, path: Path) -> Any:
        """Return the record in a file."""

    def text(self, record: Any) -> str:
        """Return a record in a few lines."""

    def html(self, record: Any) -> str:
        """Return a record as HTML."""

    def plots(self, record: Any, name: str | int | None) -> AnyPlots | AnyPlot:
        """Return the figures of a record's report, or the one of this name."""

    def write_report(self, record: Any, path: str | Path) -> None:
        """Write the report of a record as one HTML file."""

    def apply_to(self, record: Any, data: Any, reading: Mapping[str, Any], *, again: bool, heading: bool) -> Any:
        """Return data corrected by a record."""

    def export_to(self, record: Any, target: str, folder: str | Path, **options: Any) -> list[Path]:
        """Write a record in the form of another program."""

    def recording_html(self, recording: Any) -> str:
        """Return a recording as HTML."""

    def recording_plots(self, recording: Any, name: str | int | None) -> AnyPlots | AnyPlot:
        """Return a recording's channels over time, a figure for each sensor, or the one of this name."""


_LOADERS: list[Callable[[], Views]] = []


def hand_down(load: Callable[[], Views]) -> None:
    """Say what returns the views; it is called when something is first shown, applied or exported."""
    _LOADERS[:] = [load]


@cache
def views() -> Views:
    """Return the views that were handed down."""
    return _LOADERS[0]()
