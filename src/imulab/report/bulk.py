"""Axes that show the bulk of the points, and marks at their edge for the few that lie far beyond."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.recording import Array
from imulab.report.elements import BAD

_FAR = 12.0
_MOST_OUT = 0.1
_WORTH = 2.5
_PAD = 0.08
_FEWEST = 5
_MOST_LABELS = 4


@dataclass(frozen=True)
class Bulk:
    """Range of an axis, and which values lie beyond it, shape (n,)."""

    low: float
    high: float
    beyond: NDArray[np.bool_]


def bulk(values: Array, usual: NDArray[np.bool_] | None = None, room: float = 0.0) -> Bulk | None:
    """Return the range that shows the bulk of some values, or None where all of them fit on one axis.

    A value is far off where it is 12 robust standard deviations from the median. The axis is clipped only where at
    most a tenth of the values is far off, and where they would make it 2.5 times as long.

    Parameters
    ----------
    values
        Shape (n,); what is not finite does not count.
    usual
        Which values belong to the bulk, where that is known, shape (n,).
    room
        Added at both ends, for bars of uncertainty.
    """
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    if np.count_nonzero(finite) < _FEWEST:
        return None
    if usual is None:
        distance = np.abs(values - np.median(values[finite]))
        usual = distance <= _FAR * MAD_TO_SIGMA * float(np.median(distance[finite]))
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
    return Bulk(low, high, finite & ((values < low) | (values > high)))


def edge_marks(
    found: Bulk, values: Array, beside: Sequence[Any], labels: Sequence[str], *, axes: tuple[str, str] = ("x", "y"),
    upright: bool = True,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return triangles at the edge of an axis for the values beyond it, with a label each where they are few.

    Parameters
    ----------
    found, values
        The range and the values that it was found of.
    beside
        Place of each value on the other axis.
    labels
        What stands beside the triangle of each value: its size with the unit.
    axes
        Names of the plot's axes.
    upright
        Whether the values are on the y axis, otherwise on the x axis.
    """
    traces = []
    for above in (False, True):
        index = np.flatnonzero(found.beyond & ((values > found.high) if above else (values < found.low))).tolist()
        if not index:
            continue
        edge = [found.high if above else found.low] * len(index)
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
