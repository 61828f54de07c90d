"""What a report shows: figures and tables, made from a record by its procedure, laid out by `imulab.report`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

GOOD, BAD, QUIET, INK = "#1f6f8b", "#c8553d", "#9aa5ad", "#22303a"
"""Colours: what holds, what stands out, what is background, text."""
LEGEND = {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"}
"""The key of a figure: above the plot, where a second line of it pushes the plot down."""
ALARM = 0.5
"""An observation with less than this share of its weight is drawn as standing out."""


@dataclass(frozen=True)
class Figure:
    """A Plotly figure (traces and layout as plain JSON values), a title, how to read it, and what it shows."""

    title: str
    caption: str
    traces: list[dict[str, Any]]
    layout: dict[str, Any] = field(default_factory=dict)
    height: int = 380
    message: str = ""


@dataclass(frozen=True)
class ReportTable:
    """A table: column titles, rows of text, how to read it, the row to highlight, and what it shows."""

    title: str
    caption: str
    columns: list[str]
    rows: list[list[str]]
    highlight: int | None = None
    message: str = ""


@dataclass(frozen=True)
class Exhibits:
    """What a procedure shows of a record.

    Attributes
    ----------
    headline
        The result in one sentence.
    facts
        Label and value of the few numbers to see first.
    items
        Figures and tables in the order of the report.
    """

    headline: str
    facts: list[tuple[str, str]]
    items: list[Figure | ReportTable]

    @property
    def figures(self) -> list[Figure]:
        """The figures alone."""
        return [item for item in self.items if isinstance(item, Figure)]


def plain_number(value: float, digits: int) -> str:
    """Return a number with at least `digits` significant digits, never in powers of ten."""
    if value == 0 or not math.isfinite(value):
        return f"{value:.0f}"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{places}f}"


def format_uncertain(value: float, uncertainty: float | None, digits: int = 2) -> tuple[str, str]:
    """Return a value and its uncertainty as text, both to the last of `digits` significant digits of the latter."""
    if uncertainty is None or not uncertainty > 0 or not math.isfinite(uncertainty):
        return f"{value:.6g}", "not stated"
    places = digits - 1 - math.floor(math.log10(uncertainty))
    if round(uncertainty, places) >= 10 ** (digits - places):
        places -= 1
    if places < 0:
        return f"{round(value, places):.0f}", f"{round(uncertainty, places):.0f}"
    return f"{value:z.{places}f}", f"{uncertainty:.{places}f}"
