"""Figures and tables of reports: their types, Plotly's traces and axes, and builders that all procedures share.

A procedure makes them from a record; `imulab.report` lays them out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from msgspec import Struct, field
from numpy.typing import ArrayLike, NDArray

from imulab.estimation.clock import is_epoch, utc
from imulab.estimation.rows import MAD_TO_SIGMA, median
from imulab.recording import Array

# Types.


GOOD, BAD, QUIET, INK = "#1f6f8b", "#c8553d", "#9aa5ad", "#22303a"
AXIS_COLOURS = (GOOD, BAD, "#7a5c99")
"""Colours: what holds, what stands out, what is background, text."""
LEGEND = {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"}
"""The legend of a figure: above the plot, where a second line of it pushes the plot down."""
ALARM = 0.5
"""An observation with less than this share of its weight is drawn as standing out."""


TIME = "time, s"
"""Title of an axis of a recording's times."""


_FEW_DECADES, _PART_DECADE = 2.0, 0.5  # below the first, 2 and 5 are numbered; below the second, what there is room for
_TICKS = {"ticks": "outside", "ticklen": 6, "tickcolor": "rgba(0,0,0,0)"}


class Figure(Struct, frozen=True):
    """A Plotly figure (traces and layout as plain JSON values), a title, how to read it, and what it shows.

    Times since 1970 are drawn from their first on, which the axis names: 1.656e9 s has no digits left for seconds.
    The numbers of an x axis stand a little below it, off that of the y axis in the corner; a logarithmic axis of less
    than two decades has numbers between its powers of ten.
    """

    title: str
    caption: str
    traces: list[dict[str, Any]]
    layout: dict[str, Any] = field(default_factory=dict)
    height: int = 380
    message: str = ""

    def __post_init__(self) -> None:
        for key in self.layout:
            if key[1:5] == "axis" and isinstance(title := self.layout[key].get("title"), str):
                self.layout[key] = {**self.layout[key], "title": {"text": title}}
            if key.startswith("xaxis"):
                self.layout[key] = {**_TICKS, **self.layout[key]}
            if key[1:5] == "axis" and (decades := self._decades(key)) < _FEW_DECADES:
                numbers = {"dtick": "D2"} if decades > _PART_DECADE else {"dtick": None, "nticks": 6}
                self.layout[key] = {**self.layout[key], **numbers, "tickformat": "~g"}
        axis = self.layout.get("xaxis", {})
        if axis.get("title", {}).get("text") != TIME:
            return
        start = min((x for trace in self.traces for x in trace.get("x", ()) if x is not None), default=0.0)
        if not is_epoch(start):
            return
        self.layout["xaxis"] = {**axis, "title": {**axis["title"], "text": f"time from {utc(start)} UTC on, s"}}
        if "range" in axis:
            self.layout["xaxis"]["range"] = [x - start for x in axis["range"]]
        for trace in self.traces:
            if "x" in trace:
                trace["x"] = [None if x is None else x - start for x in trace["x"]]
        for shape in self.layout.get("shapes", ()):
            if shape.get("xref") == "x":
                shape |= {"x0": shape["x0"] - start, "x1": shape["x1"] - start}

    def _decades(self, key: str) -> float:
        """Return over how many powers of ten an axis goes; infinite for one that is not numbered by them."""
        axis, letter = self.layout[key], key[0]
        if axis.get("type") != "log" or axis.get("dtick") != 1:
            return math.inf
        if "range" in axis:
            return float(axis["range"][1] - axis["range"][0])
        drawn = [
            trace.get(letter, ()) for trace in self.traces if trace.get(f"{letter}axis", letter) == letter + key[5:]
        ]
        values = [value for values in drawn for value in values if value is not None and value > 0]
        return math.log10(max(values) / min(values)) if values else math.inf


class ReportTable(Struct, frozen=True):
    """A table: column titles, rows of text, how to read it, the row to highlight, and what it shows."""

    title: str
    caption: str
    columns: list[str]
    rows: list[list[str]]
    highlight: int | None = None
    message: str = ""


@dataclass(frozen=True)
class Exhibits:
    """The content of a report on a record.

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


# Figures for a phone: panels that stand side by side go beneath one another.


_LEAST, _MOST = 150, 300  # height of a panel on a phone, pixels
_GAP = 84  # pixels between panels, for ticks and titles
_KEY_LINE = 21  # height of a line of the legend, pixels
_ROW = 14  # height of a row of a map, pixels
_MOST_NUMBERS = 8  # along an axis of a narrow panel


def narrow(figure: Figure) -> dict[str, Any] | None:
    """Return layout and height of a figure for a narrow screen; None where they stay as they are."""
    layout = {key: _with_fewer_numbers(value) for key, value in figure.layout.items()}
    keys = _legend_lines(figure)
    panels = [key[5:] for key in layout if key.startswith("xaxis") and "yaxis" + key[5:] in layout]
    if len({tuple(layout["xaxis" + panel].get("domain", (0, 1))) for panel in panels}) < 2:
        if "coloraxis" in layout:
            return _narrow_map(figure, layout)
        if not keys and layout == figure.layout:
            return None
        return {"layout": layout, "height": figure.height + keys * _KEY_LINE}
    margin = {"l": 62, "r": 14, "t": 30, "b": 55, **{k: v for k, v in layout.get("margin", {}).items() if k == "l"}}
    shares = [_domain(layout["yaxis" + panel]) for panel in panels]
    tallest = max(high - low for low, high in shares) * (figure.height - 75)
    size = min(max(tallest, _LEAST), _MOST)
    plot = len(panels) * size + (len(panels) - 1) * _GAP
    changed: dict[str, Any] = {}
    places: dict[tuple[float, float], float] = {}
    first = layout["yaxis" + panels[0]].get("title", {})
    for number, panel in enumerate(panels):
        top = 1 - number * (size + _GAP) / plot
        x, y = layout["xaxis" + panel], layout["yaxis" + panel]
        places[(round(_domain(x)[0], 9), round(_domain(y)[1], 9))] = top
        changed["xaxis" + panel] = {**x, "domain": [0, 1]}
        title = y.get("title", {}) if y.get("title", {}).get("text") else first
        changed["yaxis" + panel] = {**y, "domain": [max(top - size / plot, 0.0), top], "title": title}
        if "showticklabels" in y:
            changed["yaxis" + panel]["showticklabels"] = True
    notes = [_moved(note, places) for note in layout.get("annotations", [])]
    legend = {**layout.get("legend", {}), "y": 1 + 26 / plot, "yanchor": "bottom"}
    if "title" in legend:
        legend["title"] = {**legend["title"], "side": "top"}
    return {
        "layout": {**layout, **changed, "annotations": notes, "legend": legend, "margin": margin},
        "height": round(plot + margin["t"] + margin["b"] + keys * _KEY_LINE),
    }


def _narrow_map(figure: Figure, layout: dict[str, Any]) -> dict[str, Any]:
    """Return layout and height of a map: small names, and the colours along its top, leave the width to its cells."""
    small = {"tickfont": {"size": 9}}
    bar = {"orientation": "h", "thickness": 10, "y": 1, "yanchor": "bottom", "ypad": 6, **small}
    colours = {**layout["coloraxis"], "colorbar": bar}
    axes = {"xaxis": {**layout["xaxis"], **small, "tickangle": -90}, "yaxis": {**layout["yaxis"], **small}}
    height = min(figure.height, _ROW * len(figure.traces[0]["y"]) + 200)
    return {"layout": {**layout, **axes, "coloraxis": colours, "margin": {"l": 10, "r": 6, "t": 46}}, "height": height}


def _with_fewer_numbers(axis: Any) -> Any:
    """Return an axis that is numbered evenly, with no more numbers than a narrow screen has room for."""
    if not isinstance(axis, dict) or axis.get("type") == "log" or not {"dtick", "range"} <= axis.keys():
        return axis
    low, high = axis["range"]
    return {**axis, "dtick": max(axis["dtick"], math.ceil((high - low) / _MOST_NUMBERS))}


def _domain(axis: dict[str, Any]) -> tuple[float, float]:
    low, high = axis.get("domain", (0.0, 1.0))
    return float(low), float(high)


def _moved(note: dict[str, Any], places: dict[tuple[float, float], float]) -> dict[str, Any]:
    """Return a note, moved with its panel if it is the title of one."""
    if note.get("xref") != "paper" or note.get("yref") != "paper":
        return note
    top = places.get((round(note["x"], 9), round(note["y"], 9)))
    return note if top is None else {**note, "x": 0, "y": top}


def _legend_lines(figure: Figure) -> int:
    """Return the number of lines of a legend on a narrow screen, beyond none for a single name."""
    if figure.layout.get("showlegend") is False:
        return 0
    named = [t for t in figure.traces if t.get("name") and t.get("showlegend", True) and t["type"] != "heatmap"]
    return math.ceil(len(named) / 2) if len(named) > 1 else 0


# Axes, curves and bands, dashes and marks, maps of correlation.


MARGIN = {"l": 70, "r": 20, "t": 64, "b": 55}
"""A legend above the plot has room below the buttons in the corner."""
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot", "6px 2px 2px 2px", "2px 6px")
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "x", "star", "triangle-down", "cross")
"""Dashes and marks that distinguish lines without colour, by their number."""


def figure_axis(title: str, **more: Any) -> dict[str, Any]:
    """Return the layout of an axis; its title stands off its numbers, however wide they are."""
    named = {"title": {"text": title, "standoff": 8}, "automargin": True} if title else {}
    return {**named, "zeroline": False, "gridcolor": "#e6eaed", **more}


def number_axis(title: str, numbers: Sequence[int], **more: Any) -> dict[str, Any]:
    """Return the layout of an axis of whole numbers from 1 on, such as those of attitudes or turns."""
    return figure_axis(title, dtick=max(1, round(len(numbers) / 20)), range=[0.4, max(numbers) + 0.6], **more)


def log_axis(title: str, **more: Any) -> dict[str, Any]:
    """Return the layout of a logarithmic axis."""
    return figure_axis(title, **{"type": "log", "dtick": 1, "exponentformat": "none"} | more)


def scatter(x: Sequence[Any], y: Sequence[Any], mode: str, **more: Any) -> dict[str, Any]:
    """Return lines or markers."""
    return {"type": "scatter", "mode": mode, "x": x, "y": y, **more}


def marker(beyond: Iterable[bool], size: int) -> dict[str, Any]:
    """Return the look of points: circles, and those that are beyond a limit as red diamonds."""
    marks = [bool(mark) for mark in beyond]
    return {
        "size": size,
        "color": [BAD if mark else GOOD for mark in marks],
        "symbol": ["diamond" if mark else "circle" for mark in marks],
    }


def band(x: Array, low: Array, high: Array, colour: str, digits: int = 7, **more: Any) -> dict[str, Any]:
    """Return the area between two curves, in a faint shade of a colour #rrggbb."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    around, edge = rounded([*x, *x[::-1]], digits), rounded([*low, *high[::-1]], digits)
    fill = {"fill": "toself", "fillcolor": f"rgba({red},{green},{blue},0.18)", "line": {"width": 0}}
    return scatter(around, edge, "lines", **fill, hoverinfo="skip", **more)


def rounded(values: Any, digits: int = 7) -> list[float | None]:
    """Return values for a figure, which needs no more than seven digits; what is not finite leaves a gap."""
    numbers = np.asarray(values, dtype=np.float64)
    return [float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in numbers.tolist()]


def correlation_map(
    title: str, caption: str, matrix: Array, names: Sequence[str], *, numbered: bool = False, **more: Any
) -> Figure:
    """Return the figure of correlations from -1 to 1, shape (n, n), with the numbers in it or on hovering alone."""
    trace = {
        "type": "heatmap", "z": matrix.round(3).tolist(), "x": names, "y": names, "coloraxis": "coloraxis",
        "xgap": 1, "ygap": 1, "hovertemplate": "%{y}, %{x}: %{z:.2f}<extra></extra>",
        "texttemplate": "%{z:.2f}" if numbered else "",
    }  # fmt: skip
    layout = {
        "xaxis": {"tickangle": -45, "automargin": True},
        "yaxis": {"autorange": "reversed", "automargin": True},
        "coloraxis": {
            "cmin": -1, "cmax": 1, "colorscale": [[0, GOOD], [0.5, "#ffffff"], [1, BAD]], "colorbar": {"thickness": 12}
        },
    }  # fmt: skip
    return Figure(title, caption, [trace], layout, **more)


def strongest_pair(matrix: Array, names: Sequence[str]) -> str:
    """Return the names of the most correlated pair with its correlation, such as ``a and b, -0.93``."""
    i, j = divmod(int(np.argmax(np.abs(np.triu(matrix, 1)))), len(names))
    return f"{names[i]} and {names[j]}, {matrix[i, j]:+.2f}"


# Axes that show the bulk of the points, and marks at their edge for the few that lie far beyond.


PLOT, PANEL = 260.0, 155.0
"""Usual height of a plot that fills a figure, and of a panel of several, pixels."""
_DEVIATIONS_OFF_AXIS = 12.0  # robust standard deviations from the median, from which a point is far
_MOST_OUT = 0.1  # share of far points from which all are shown
_WORTH = 2.5  # times the usual range, from which the whole range is clipped
_PAD = 0.08  # of the range, free at both ends
_FEWEST = 5  # points that have a usual range
_MOST_LABELS = 4  # points outside the range that are labelled
_LABEL = 24.0  # height of a triangle and its label, pixels


class Bulk(Struct, frozen=True):
    """Range of an axis, and which values lie beyond it, shape (n,)."""

    low: float
    high: float
    beyond: NDArray[np.bool_]


def bulk(
    values: Array, usual: NDArray[np.bool_] | None = None, room: float = 0.0, *, pixels: float | None = None
) -> Bulk | None:
    """Return the range that shows the bulk of some values, or None where all of them fit on one axis.

    A value is far off where it is 12 robust standard deviations from the median. The axis is clipped only where at
    most a tenth of the values is far off, and where they would make it 2.5 times as long.

    Parameters
    ----------
    values
        The values, shape (n,); those that are not finite do not count.
    usual
        Which values belong to the bulk, where that is known, shape (n,).
    room
        Added at both ends, for bars of uncertainty.
    pixels
        Height of the plot, where the values beyond the range are marked with labels, which need room.
    """
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    if np.count_nonzero(finite) < _FEWEST:
        return None
    if usual is None:
        distance = np.abs(values - median(values[finite]))
        usual = distance <= _DEVIATIONS_OFF_AXIS * MAD_TO_SIGMA * median(distance[finite])
        if np.count_nonzero(finite & ~usual) > _MOST_OUT * len(values):
            return None
    inside = values[finite & usual]
    if not inside.size or not np.ptp(inside) + room > 0:
        return None
    low, high = float(inside.min()) - room, float(inside.max()) + room
    if np.ptp(values[finite]) <= _WORTH * (high - low):
        return None
    pad = _PAD * (high - low)
    low, high = low - pad, high + pad
    shown = Bulk(low, high, finite & ((values < low) | (values > high)))
    return shown if pixels is None else with_labels(shown, values, pixels)


def with_labels(bulk: Bulk, values: Array, pixels: float) -> Bulk:
    """Return a range with room for the labels of `edge_marks` at its ends, on a plot of this height."""
    ends = [
        np.count_nonzero(bulk.beyond & side) in range(1, _MOST_LABELS + 1)
        for side in (values < bulk.low, values > bulk.high)
    ]
    room = (bulk.high - bulk.low) * _LABEL / (pixels - _LABEL * sum(ends))
    return Bulk(bulk.low - ends[0] * room, bulk.high + ends[1] * room, bulk.beyond)


def edge_marks(
    bulk: Bulk, values: Array, beside: Sequence[Any], labels: Sequence[str], *, axes: tuple[str, str] = ("x", "y"),
    upright: bool = True,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return triangles at the edge of an axis for the values beyond it, with a label each where they are few.

    Parameters
    ----------
    bulk, values
        The range, and the values that it belongs to.
    beside
        Place of each value on the other axis.
    labels
        Label of each value: its size with the unit.
    axes
        Names of the plot's axes.
    upright
        Whether the values are on the y axis, otherwise on the x axis.
    """
    traces = []
    for above in (False, True):
        index = np.flatnonzero(bulk.beyond & ((values > bulk.high) if above else (values < bulk.low))).tolist()
        if not index:
            continue
        edge = [bulk.high if above else bulk.low] * len(index)
        other = [beside[i] for i in index]
        symbol, place = {
            (True, True): ("triangle-up", "bottom center"), (True, False): ("triangle-down", "top center"),
            (False, True): ("triangle-right", "middle left"), (False, False): ("triangle-left", "middle right"),
        }[upright, above]  # fmt: skip
        traces.append(
            {
                "type": "scatter",
                "mode": "markers+text" if len(index) <= _MOST_LABELS else "markers",
                "x": other if upright else edge,
                "y": edge if upright else other,
                "text": [labels[i] for i in index],
                "textposition": place,
                "textfont": {"color": BAD},
                "marker": {"color": BAD, "size": 11, "symbol": symbol},
                "cliponaxis": False,
                "showlegend": False,
                "xaxis": axes[0],
                "yaxis": axes[1],
                "hovertemplate": "%{text}<extra></extra>",
            }
        )
    return traces


def edge_note(count: int) -> str:
    """Return the sentence of a caption that explains the triangles; nothing where there are none."""
    if not count:
        return ""
    return (
        " 1 point beyond the axis is drawn as a triangle at its edge, with its value."
        if count == 1
        else f" {count} points beyond the axis are drawn as triangles at its edge, with their values (hover where they "
        "are many)."
    )


# Small multiples: a grid of panels, three across.


COLUMNS = 3  # of panels
_GAP_ACROSS = 0.075  # of the width, between two panels
_ROW_HEIGHT = 215  # pixels
_ROWS = 4  # of panels in one figure

Item = TypeVar("Item")


def names(index: int) -> tuple[str, str]:
    """Return Plotly's names of the axes of a panel."""
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
    """Return the layout of a grid without panels."""
    return {
        "showlegend": False,
        "shapes": [],
        "annotations": [],
        "bargap": 0.02,
        "margin": {"l": 50, "r": 15, "t": 52, "b": 35},
    }


def panel(layout: dict[str, Any], index: int, count: int, title: str, up: str = "") -> None:
    """Put the axes and title of panel `index` of `count` into a layout; `up` is the title of the y axes."""
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


def line(
    x: str, y: str, place: float, colour: str, dash: str, share: float = 1, *, upright: bool = True
) -> dict[str, Any]:
    """Return an upright line through a panel, from its foot to a share of its height, or a level one."""
    along, across = ("y", "x") if upright else ("x", "y")
    axes = {"x": x, "y": y}
    return {
        "type": "line",
        f"{across}ref": axes[across],
        f"{along}ref": f"{axes[along]} domain",
        **{f"{across}0": place, f"{across}1": place, f"{along}0": 0, f"{along}1": share},
        "line": {"color": colour, "width": 1.5, "dash": dash},
    }


# Builders that all procedures share: points with bars, by groups, and a table by its columns.


class Group(Struct, frozen=True):
    """Points of one look: their name in the legend, which points they are, shape (n,), symbol and colour."""

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
        Places of the points, and half lengths of their bars, shape (n,); None for no bars.
    labels, hover
        Label of each point, and Plotly's template on hovering.
    more
        Further keys of every trace, such as its axes.
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
    """Return a table with a row for each item; `columns` maps titles to functions that return an item's cell."""
    rows = [[text(item) for text in columns.values()] for item in items]
    return ReportTable(title, caption, list(columns), rows, **more)


def number_text(value: float | None, factor: float = 1.0, digits: int = 3) -> str:
    """Return a value times a factor as text, a dash where there is none."""
    return "–" if value is None else plain_number(value * factor, digits)
