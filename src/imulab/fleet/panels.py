"""Small multiples: a grid of panels, one for each parameter, and what is drawn in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.fleet.display import Display
from imulab.fleet.statistics import ParameterStatistics
from imulab.recording import Array

COLUMNS = 3
_GAP_ACROSS = 0.075
_ROW_HEIGHT = 215
_ROWS = 4
_DAYS = 4.0
"""Dates that span no more than so many days are told apart by their time."""


def names(index: int) -> tuple[str, str]:
    """Return what Plotly calls the axes of a panel."""
    return ("x", "y") if index == 0 else (f"x{index + 1}", f"y{index + 1}")


def axis_key(name: str) -> str:
    """Return the key of an axis in the layout."""
    return f"{name[0]}axis{name[1:]}"


def height(count: int) -> int:
    """Return the height of so many panels, pixels."""
    return 62 + _ROW_HEIGHT * math.ceil(count / COLUMNS)


def pages(panels: Sequence[ParameterStatistics]) -> list[Sequence[ParameterStatistics]]:
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


def panel(layout: dict[str, Any], index: int, count: int, title: str) -> None:
    """Put the axes and title of panel `index` of `count` into a layout."""
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


def staggered(marked: NDArray[np.bool_], top: int) -> list[float]:
    """Return heights for marks at the side of a histogram, one below the other from the highest bar down."""
    order = np.cumsum(marked) - 1
    return [round(top * (1 - 0.15 * (k % 7)), 3) for k in order.tolist()]


def line(x: str, y: str, place: float, colour: str, dash: str) -> dict[str, Any]:
    """Return an upright line through a panel."""
    return {
        "type": "line",
        "xref": x,
        "yref": f"{y} domain",
        "x0": place,
        "x1": place,
        "y0": 0,
        "y1": 1,
        "line": {"color": colour, "width": 1.5, "dash": dash},
    }


def ends(item: ParameterStatistics, shown: Display, values: Array) -> list[float]:
    """Limits of a parameter that lie near enough to the values that are shown to be drawn."""
    if item.capability is None:
        return []
    limits = item.capability.limits
    ends = sorted(shown.of(end) for end in (limits.lower, limits.upper) if math.isfinite(end))
    span = max(float(np.ptp(values)), 1e-300)
    return [end for end in ends if values.min() - 2 * span <= end <= values.max() + 2 * span]


def edges(values: Array) -> Array:
    """Edges of bins by Freedman and Diaconis over the bulk, at most 60 over all."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        half = abs(low) * 1e-6 or 0.5
        return np.linspace(low - half, high + half, 4)
    quarters = np.quantile(values, [0.25, 0.75])
    width = 2 * float(quarters[1] - quarters[0]) / len(values) ** (1 / 3) or (high - low) / 10
    return np.linspace(low, high, int(np.clip(math.ceil((high - low) / width), 5, 60)) + 1)


def plain(values: Array) -> list[float]:
    """Return values for a figure, which needs no more than seven digits."""
    return [float(f"{value:.7g}") for value in values.tolist()]


def date(day: float) -> str:
    """Return days since 1970 as Plotly's dates."""
    return datetime.fromtimestamp(day * 86400.0, UTC).strftime("%Y-%m-%d %H:%M:%S")


def date_axis(days: Array) -> dict[str, Any]:
    """Return an axis of dates with three ticks, whatever it spans: the first date, the middle and the last."""
    first, last = float(np.nanmin(days)), float(np.nanmax(days))
    margin = 0.04 * max(last - first, 1 / 24)
    form = "%m-%d<br>%Y" if last - first > _DAYS else "%H:%M<br>%m-%d"
    ticks = [datetime.fromtimestamp(86400.0 * day, UTC) for day in (first, (first + last) / 2, last)]
    return {
        "type": "date",
        "range": [date(first - margin), date(last + margin)],
        "tickvals": [date(first), date((first + last) / 2), date(last)],
        "ticktext": [tick.strftime(form) for tick in ticks],
    }


def some(statistics: Sequence[ParameterStatistics], panels: Sequence[ParameterStatistics]) -> str:
    """Say that not all parameters are drawn, where that is so."""
    if len(panels) == len(statistics):
        return ""
    return f"{len(panels)} of {len(statistics)} parameters, those to be looked at first; the table has all. "
