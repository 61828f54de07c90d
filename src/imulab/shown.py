"""Results that are no records, as they show themselves: a headline and a table, as text or as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

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
