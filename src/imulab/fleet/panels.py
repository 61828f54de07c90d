"""What is drawn in the panels of a fleet, one for each parameter."""

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

_DAYS = 4.0
"""Dates that span no more than so many days are told apart by their time."""


def staggered(marked: NDArray[np.bool_], top: int) -> list[float]:
    """Return heights for marks at the side of a histogram, one below the other from above the highest bar down."""
    order = np.cumsum(marked) - 1
    return [round(top * (1.15 - 0.15 * (k % 7)), 3) for k in order.tolist()]


def limits_in_view(item: ParameterStatistics, shown: Display, values: Array) -> list[float]:
    """Return the limits of a parameter that lie near enough to the values that are shown to be drawn."""
    if item.capability is None:
        return []
    limits = item.capability.limits
    ends = sorted(shown.of(end) for end in (limits.lower, limits.upper) if math.isfinite(end))
    span = max(float(np.ptp(values)), 1e-300)
    return [end for end in ends if values.min() - 2 * span <= end <= values.max() + 2 * span]


def bin_edges(values: Array) -> Array:
    """Return the edges of bins by Freedman and Diaconis over the bulk, at most 60 over all."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        half = abs(low) * 1e-6 or 0.5
        return np.linspace(low - half, high + half, 4)
    quarters = np.quantile(values, [0.25, 0.75])
    width = 2 * float(quarters[1] - quarters[0]) / len(values) ** (1 / 3) or (high - low) / 10
    return np.linspace(low, high, int(np.clip(math.ceil((high - low) / width), 5, 60)) + 1)


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


def which_are_drawn(statistics: Sequence[ParameterStatistics], panels: Sequence[ParameterStatistics]) -> str:
    """Say that not all parameters are drawn, where that is so."""
    if len(panels) == len(statistics):
        return ""
    return f"{len(panels)} of {len(statistics)} parameters, those to be looked at first; the table has all. "
