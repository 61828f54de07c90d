"""Laws over temperature as figures: the curves, and beneath them how well they are known and what lies off them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imulab.procedures.thermal.engineering import rows as engineering_rows
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import GOOD, LEGEND, Figure, format_uncertain, plain_number
from imulab.report.traces import DASHES, axis, band, rounded, scatter

COLOURS = (GOOD, "#b58a1b", "#7a5c99")
SYMBOLS = ("circle", "diamond", "square")
_UPPER, _LOWER = [0.5, 1.0], [0.0, 0.38]
"""Shares of the figure's height."""


@dataclass(frozen=True)
class Curves:
    """Three laws in the unit of their figure: names, temperatures, degC (n,), values and their u, (3, n)."""

    names: tuple[str, ...]
    temperature: Array
    values: Array
    standard_uncertainty: Array


@dataclass(frozen=True)
class Alone:
    """What recordings give alone in the same unit: temperatures, degC (m,), values, the laws there and u, (3, m)."""

    temperature: Array
    values: Array
    laws: Array
    standard_uncertainty: Array | None = None


def law_figure(
    title: str, what: str, unit: str, curves: Curves, alone: Alone | None, *, read: str, at_middle: str = ""
) -> Figure:
    """Return the figure of three laws.

    Parameters
    ----------
    what, unit
        Of the laws' axis.
    read
        How to read band and points.
    at_middle
        The values in the middle of the range, in words: the laws are then drawn as changes from these.
    """
    temperature, reach = curves.temperature, 2 * curves.standard_uncertainty
    middle = len(temperature) // 2
    zero = curves.values[:, middle] if at_middle else np.zeros(len(curves.names))
    beneath: dict[str, Any] = {"yaxis": "y2", "showlegend": False}
    traces = []
    for k, name in enumerate(curves.names):
        line = {"color": COLOURS[k], "dash": DASHES[k]}
        around = band(temperature, -reach[k], reach[k], COLOURS[k], **beneath) | {"line": line | {"width": 1}}
        traces += [
            scatter(rounded(temperature), rounded(curves.values[k] - zero[k]), "lines", name=name, line=line),
            around,
        ]
        if alone is not None:
            u = None if alone.standard_uncertainty is None else 2 * alone.standard_uncertainty[k]
            traces += [
                own_points(alone.temperature, alone.values[k] - zero[k], None, k, name),
                own_points(alone.temperature, alone.values[k] - alone.laws[k], u, k, name) | beneath,
            ]
    message = (
        f"The laws are known to {plain_number(float(reach.max()), 2)} {unit} or better (two standard uncertainties)"
    )
    if alone is not None:
        off = plain_number(float(np.abs(alone.values - alone.laws).max()), 2)
        message += f"; what recordings give alone is up to {off} {unit} off them"
    changes = f" Change from the value at {temperature[middle]:.3g} degC: {at_middle}." if at_middle else ""
    plain = {"exponentformat": "none", "automargin": True}
    return Figure(
        title=title,
        message=f"{message}.",
        caption=f"Above: the laws. Beneath: what is off them, and bands of two standard uncertainties, {read}{changes}",
        traces=traces,
        layout={
            "xaxis": axis("temperature, degC", anchor="y2"),
            "yaxis": axis(f"{what}, {unit}", domain=_UPPER, **plain),
            "yaxis2": axis(f"off the law, {unit}", domain=_LOWER, **plain),
            "legend": LEGEND,
        },
        height=560,
    )


def power_cycles(known_from: str) -> str:
    """Return what bands hold of the scatter between power cycles, known by a record's ``between_recordings.from``."""
    if known_from == "unknown":
        return "without what power cycles add, which is not known."
    return "what power cycles differ by included."


def values_at_middle(record: Calibration, names: Sequence[str]) -> str:
    """Return coefficients of a record in words: as those of powers of T - T0 they are values in the middle."""
    by_name = {row.name: row for row in engineering_rows(record)}
    found = [by_name[name] for name in names]
    each = (f"{row.name[-2:].lstrip('_')} {format_uncertain(row.value, row.standard_uncertainty)[0]}" for row in found)
    return f"{', '.join(each)} {found[0].unit}"


def own_points(temperature: Array, values: Array, reach: Array | None, axis: int, label: str) -> dict[str, Any]:
    """Return the values of single recordings as points with bars, beside the law of an axis."""
    bars = {} if reach is None else {
        "error_y": {"type": "data", "array": rounded(np.abs(reach)), "thickness": 1, "color": COLOURS[axis]}
    }  # fmt: skip
    marker = {"symbol": SYMBOLS[axis], "color": COLOURS[axis], "size": 7}
    return scatter(
        rounded(temperature), rounded(values), "markers", name=f"{label} alone", showlegend=False, marker=marker, **bars
    )
