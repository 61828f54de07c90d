"""Small multiples: a grid of panels, three across, and what is drawn in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

COLUMNS = 3
_GAP_ACROSS = 0.075
_ROW_HEIGHT = 215
_ROWS = 4

Item = TypeVar("Item")


def names(index: int) -> tuple[str, str]:
    """Return what Plotly calls the axes of a panel."""
    return ("x", "y") if index == 0 else (f"x{index + 1}", f"y{index + 1}")


def axis_key(name: str) -> str:
    """Return the key of an axis in the layout."""
    return f"{name[0]}axis{name[1:]}"


def height(count: int) -> int:
    """Return the height of so many panels, pixels."""
    return 62 + _ROW_HEIGHT * math.ceil(count / COLUMNS)


def pages(panels: Sequence[Item]) -> list[Sequence[Item]]:
    """Return the panels in figures of even size, none too high for a page."""
    count = math.ceil(len(panels) / (COLUMNS * _ROWS))
    size = COLUMNS * math.ceil(len(panels) / max(count, 1) / COLUMNS)
    return [panels[first : first + size] for first in range(0, len(panels), size)]


def paged(title: str, index: int, count: int) -> str:
    """Return a title with its number, where several figures share it."""
    return title if count == 1 else f"{title}, {index + 1} of {count}"


def grid() -> dict[str, Any]:
    """Return the layout that panels are put into."""
    return {
        "showlegend": False,
        "shapes": [],
        "annotations": [],
        "bargap": 0.02,
        "margin": {"l": 50, "r": 15, "t": 52, "b": 35},
    }


def panel(layout: dict[str, Any], index: int, count: int, title: str, up: str = "") -> None:
    """Put the axes and title of panel `index` of `count` into a layout; `up`: what the y axes are of."""
    rows = math.ceil(count / COLUMNS)
    row, column = divmod(index, COLUMNS)
    width = (1 - _GAP_ACROSS * (COLUMNS - 1)) / COLUMNS
    left = column * (width + _GAP_ACROSS)
    gap = 0.32 / rows
    height = (1 - gap * (rows - 1)) / rows
    top = 1 - row * (height + gap)
    x, y = names(index)
    axis = {"zeroline": False, "gridcolor": "#e6eaed", "exponentformat": "none", "tickfont": {"size": 11}}
    layout[axis_key(x)] = {**axis, "domain": [left, left + width], "anchor": y, "nticks": 5}
    layout[axis_key(y)] = {**axis, "domain": [max(top - height, 0.0), top], "anchor": x, "nticks": 5}
    if up and column == 0:
        layout[axis_key(y)]["title"] = {"text": up, "font": {"size": 11}, "standoff": 4}
    layout["annotations"].append(
        {
            "text": title,
            "x": left,
            "y": top,
            "xref": "paper",
            "yref": "paper",
            "xanchor": "left",
            "yanchor": "bottom",
            "showarrow": False,
            "font": {"size": 13},
        }
    )


def line(x: str, y: str, place: float, colour: str, dash: str, height: float = 1) -> dict[str, Any]:
    """Return an upright line through a panel, from its foot to a share of its height."""
    return {
        "type": "line",
        "xref": x,
        "yref": f"{y} domain",
        "x0": place,
        "x1": place,
        "y0": 0,
        "y1": height,
        "line": {"color": colour, "width": 1.5, "dash": dash},
    }
