"""Figures and tables that all procedures draw alike: points with bars, by groups, and a table by its columns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imulab.report.traces import BAD, GOOD, LEGEND, Figure, ReportTable, figure_axis, plain_number, rounded, scatter

Item = TypeVar("Item")


@dataclass(frozen=True)
class Group:
    """Points that look alike: their name in the legend, which they are, shape (n,), symbol and colour."""

    name: str
    members: NDArray[np.bool_]
    symbol: str
    colour: str


def within_and_beyond(beyond: NDArray[np.bool_]) -> list[Group]:
    """Return points within their bars as circles, those beyond them as red diamonds."""
    return [Group("", ~beyond, "circle", GOOD), Group("", beyond, "diamond", BAD)]


def point_traces(
    x: ArrayLike,
    y: ArrayLike,
    bars: ArrayLike | None,
    groups: Sequence[Group],
    *,
    size: int = 8,
    labels: Sequence[str] | None = None,
    hover: str = "",
    **more: Any,
) -> list[dict[str, Any]]:
    """Return points with bars, a trace for each group that has any.

    Parameters
    ----------
    x, y, bars
        Where they are, and the half lengths of their bars, shape (n,); None for no bars.
    labels, hover
        What each point is called, shape (n,), and how Plotly shows it on hovering.
    more
        Of every trace, such as its axes.
    """
    at, values = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    traces = []
    for group in groups:
        if not group.members.any():
            continue
        look: dict[str, Any] = {"name": group.name} if group.name else {}
        look["marker"] = {"symbol": group.symbol, "color": group.colour, "size": size}
        if bars is not None:
            half = np.asarray(bars, dtype=np.float64)[group.members]
            look["error_y"] = {"type": "data", "array": rounded(half), "thickness": 1, "width": 2}
        if labels is not None:
            look["text"] = [labels[k] for k in np.flatnonzero(group.members).tolist()]
        if hover:
            look["hovertemplate"] = f"{hover}<extra></extra>"
        traces.append(scatter(rounded(at[group.members]), rounded(values[group.members]), "markers", **look, **more))
    return traces


def points(
    title: str,
    caption: str,
    x: tuple[str | Mapping[str, Any], ArrayLike],
    y: tuple[str | Mapping[str, Any], ArrayLike],
    bars: ArrayLike | None,
    groups: Sequence[Group],
    *,
    message: str = "",
    **more: Any,
) -> Figure:
    """Return a figure of points with bars; `x` and `y` are title or layout of an axis, and values of shape (n,).

    `more` goes to `point_traces`. There is a legend where groups have names.
    """
    layouts = [figure_axis(which) if isinstance(which, str) else dict(which) for which in (x[0], y[0])]
    named = any(group.name for group in groups)
    return Figure(
        title,
        caption,
        point_traces(x[1], y[1], bars, groups, **more),
        {"xaxis": layouts[0], "yaxis": layouts[1], **({"legend": LEGEND} if named else {"showlegend": False})},
        message=message,
    )


def table(
    title: str, caption: str, columns: Mapping[str, Callable[[Item], str]], items: Iterable[Item], **more: Any
) -> ReportTable:
    """Return a table: titles to what each column says of an item, a row each; `more` goes to `ReportTable`."""
    rows = [[text(item) for text in columns.values()] for item in items]
    return ReportTable(title, caption, list(columns), rows, **more)


def number_text(value: float | None, factor: float = 1.0, digits: int = 3) -> str:
    """Return a value times a factor as text, a dash where there is none."""
    return "–" if value is None else plain_number(value * factor, digits)
