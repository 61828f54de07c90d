"""A fused rate as it shows itself: the rate over time, and when each gyro was not in use."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from imulab.procedures.gyro_array.elements import EXCLUDED, HELD, JUMPED, NON_FINITE, STUCK, Elements, Health
from imulab.procedures.gyro_array.figures import curves, of_axis
from imulab.procedures.result import Drawn
from imulab.recording import Array, Recording
from imulab.report.noise_figures import thinned
from imulab.report.traces import (
    BAD,
    DASHES,
    GOOD,
    INK,
    QUIET,
    Exhibits,
    Figure,
    ReportTable,
    figure_axis,
    rounded,
    scatter,
)

STATES = (
    (EXCLUDED, "excluded", "circle-open", QUIET),
    (STUCK, "stuck", "square", BAD),
    (NON_FINITE, "non-finite", "x", INK),
    (JUMPED, "jumped", "triangle-up", "#c99a2e"),
    (HELD, "held (end of its range?)", "diamond", "#8e6bbd"),
)
"""Flag, what it means, its mark and its colour."""
_PIECES = 240  # parts of the time of which health is drawn
_COLOURS = (GOOD, BAD, "#8e6bbd")


@dataclass(frozen=True, repr=False)
class Fused(Drawn):
    """The fused rate.

    Attributes
    ----------
    time
        s, shape (m,).
    rate
        In the unit of the readings, shape (m, axes).
    weights, flags
        Of each gyro in each sample, shape (m, axes, n), or None where they were not asked for.
    elements
        The columns that were fused.
    health
        What happened to each gyro.
    block
        The samples that were fused.
    notes
        Gaps in time, and whatever else a user should know.

    Examples
    --------
    >>> import imulab as il
    >>> fused = il.fuse(il.simulate_array(experiment="static", duration=10.0))
    >>> fused.rate.shape == (len(fused.time), 1)
    True
    """

    time: Array
    rate: Array
    weights: Array | None
    flags: np.ndarray | None
    elements: Elements
    health: Health
    block: Recording
    notes: tuple[str, ...] = ()

    subject: ClassVar[str] = "Fused rate"

    def exhibits(self) -> Exhibits:
        """Return the rate and the state of the gyros over time."""
        return _exhibits(self)

    def recording(self) -> Recording:
        """Return the fused rate as a recording, with the time and the head of what was fused: ``write`` takes it."""
        columns, units = {"time": self.block.columns["time"]}, {"time": self.block.units["time"]}
        for a, (name, unit) in enumerate(zip(self.elements.rate_names(), self.elements.units, strict=True)):
            columns[name], units[name] = np.ascontiguousarray(self.rate[:, a]), unit
        return replace(self.block, columns=columns, units=units, notes=())

    def __repr__(self) -> str:
        gyros, axes = self.elements.count, len(self.elements.axes)
        return f"Fused({len(self.time)} samples of {gyros} gyros on {axes} axes, in {' '.join(self.elements.units)})"


def _exhibits(fused: Fused) -> Exhibits:
    """Return the rate over time and, for each axis with flags, the state of its gyros; a table of them."""
    elements = fused.elements
    length = f"{fused.time[-1] - fused.time[0]:.4g} s"
    health = fused.health.lines()
    return Exhibits(
        headline=f"{len(fused.time)} samples of {elements.count} gyros fused over {length}; "
        + (f"not all gyros were in use: {'; '.join(health[:2])}." if health else "every gyro was in use throughout."),
        facts=[],
        items=[_rate(fused), *_states(fused), _table(fused)],
    )


def _rate(fused: Fused) -> Figure:
    names, units = fused.elements.rate_names(), list(dict.fromkeys(fused.elements.units))
    traces = []
    for a, name in enumerate(names):
        time, rate = thinned(fused.time, fused.rate[:, a])
        line = {"color": _COLOURS[a], "width": 1.2, "dash": DASHES[a]}
        traces.append(scatter(rounded(time, 10), rounded(rate), "lines", name=name, line=line))
    for bit, label, symbol, colour in STATES:
        k, axes, gyros = _begins(fused, bit)
        if not k.size:
            continue
        who = [fused.elements.names[a][i] for a, i in zip(axes, gyros, strict=True)]
        marker = {"symbol": symbol, "color": colour, "size": 9}
        hover = f"%{{text}}: {label} from %{{x:.6g}} s<extra></extra>"
        points = rounded(fused.time[k], 10), rounded(fused.rate[k, axes])
        traces.append(scatter(*points, "markers", name=label, text=who, marker=marker, hovertemplate=hover))
    return curves(
        title="Fused rate over time",
        caption="Marks: where a gyro began to be in such a state."
        if len(traces) > len(names)
        else "No gyro was flagged.",
        traces=traces,
        x=figure_axis("time, s"),
        y=figure_axis(f"rate, {' '.join(units)}"),
    )


def _begins(fused: Fused, bit: int) -> tuple[np.ndarray, ...]:
    """Return where gyros begin to have a flag: samples, axes and gyros, each of shape (k,)."""
    if fused.flags is None:
        return (np.empty(0, dtype=np.intp),) * 3
    held = (fused.flags & bit) != 0
    held[1:] &= ~held[:-1]
    return np.nonzero(held)


def _states(fused: Fused) -> list[Figure]:
    """Return when each gyro was flagged, a figure for each axis on which one was."""
    if fused.flags is None:
        return []
    edges = np.linspace(0, len(fused.time), min(_PIECES, len(fused.time)) + 1).astype(int)[:-1]
    pieces = np.bitwise_or.reduceat(fused.flags, edges, axis=0)
    figures = []
    for a, letter in enumerate(fused.elements.axes):
        names = fused.elements.names[a]
        traces = []
        for bit, label, symbol, colour in STATES:
            k, i = np.nonzero(pieces[:, a] & bit)
            if k.size:
                at, who = rounded(fused.time[edges[k]], 10), [names[index] for index in i]
                marker = {"symbol": symbol, "color": colour, "size": 7}
                hover = f"%{{y}} {label}, %{{x:.4g}} s<extra></extra>"
                traces.append(scatter(at, who, "markers", marker=marker, name=label, hovertemplate=hover))
        if traces:
            figures.append(
                curves(
                    title=f"State of each gyro{of_axis(letter)}",
                    caption=f"A mark where a gyro was in that state in one of {len(edges)} equal pieces of time.",
                    traces=traces,
                    x=figure_axis("time, s", range=[float(fused.time[0]), float(fused.time[-1])]),
                    y={"automargin": True, "categoryorder": "array", "categoryarray": [*names],
                       "range": [len(names) - 0.5, -0.5]},
                    height=max(260, 30 * len(names) + 120),
                )
            )  # fmt: skip
    return figures


def _table(fused: Fused) -> ReportTable:
    labels = [label for _, label, _, _ in STATES]
    events, rows = fused.health.events, []
    for a, row in enumerate(fused.elements.names):
        for i, name in enumerate(row):
            row_events = [events.get((a, i, label)) for label in labels]
            rows.append([name, *("–" if event is None else str(event.samples) for event in row_events)])
    return ReportTable("Samples in each state", "", ["gyro", *labels], rows)
