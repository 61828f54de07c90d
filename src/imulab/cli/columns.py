"""Tables as plain text."""

from __future__ import annotations


def aligned(titles: list[str], rows: list[list[str]]) -> list[str]:
    """Return a table as lines of text; texts to the left, numbers to the right."""
    table = [titles, *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(titles))]
    numeric = [all(_numeric(row[i]) for row in rows) for i in range(len(titles))]
    return [
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in table
    ]


def _numeric(text: str) -> bool:
    return text in ("–", "not stated") or text.lstrip("+-")[:1].isdigit()
