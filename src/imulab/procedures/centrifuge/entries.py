"""Entries of a manifest: quantities and windows, each refused with its place where it cannot be."""

from __future__ import annotations

import math
from typing import Any

from imulab.errors import ReadError
from imulab.quantity_entries import check_keys, number_of, unit_of
from imulab.units import to_si

Window = tuple[float | None, float | None]
"""First and last time of a part of a file, s, either None for no bound."""


def quantity_of(entry: Any, key: str, kind: str, name: str) -> tuple[float, float]:
    """Return value and standard uncertainty of ``{ value, standard_uncertainty, unit }`` in SI."""
    place = f"{name}: {key}"
    if not isinstance(entry, dict) or not {"value", "unit"} <= set(entry):
        raise ReadError(f"{place}: expected {example(key)}, found {entry!r}")
    check_keys(entry, ("value", "unit", "standard_uncertainty") if key == "radius" else ("value", "unit"), place)
    unit = unit_of(entry["unit"], kind, place)
    value = to_si(number_of(entry["value"], place), unit)
    uncertainty = to_si(number_of(entry.get("standard_uncertainty", 0.0), place), unit)
    if not value > 0:
        raise ReadError(f"{place} {entry['value']!r}: expected more than 0")
    if uncertainty < 0:
        raise ReadError(f"{place}: standard_uncertainty {entry['standard_uncertainty']!r}: expected 0 or more")
    return value, uncertainty


def example(key: str) -> str:
    """Return how a key of a manifest is written."""
    return {
        "radius": 'radius = { value = 2.0, standard_uncertainty = 2e-5, unit = "m" }',
        "gravity": 'gravity = { value = 9.8015, unit = "m/s^2" }',
        "rates": 'rates = { unit = "deg/s", standard_uncertainty = 0.0005 }',
        "reference": 'reference = { value = 1.0, unit = "g" }',
        "scale_factor": 'fog = { value = 1250.0, unit = "count/(deg/s)" }',
        "run": "tables [[run]], one for each file",
    }[key]


def window_text(window: Window) -> str:
    """Return a window as a manifest writes it, FROM:TO in seconds."""
    return ":".join("" if end is None else f"{end:.12g}" for end in window)


def overlap(one: Window, other: Window) -> bool:
    """Return whether two windows have more than a bound in common; a window overlaps itself unless it is empty."""

    def ends(window: Window) -> tuple[float, float]:
        first, last = window
        return (-math.inf if first is None else first), (math.inf if last is None else last)

    (first, last), (begin, end) = ends(one), ends(other)
    return first < end and begin < last


def window_of(text: Any, place: str) -> Window | None:
    """Return a window that a manifest writes as FROM:TO in seconds."""
    if text is None:
        return None
    try:
        first, last = (float(end) if end.strip() else None for end in str(text).split(":"))
    except ValueError:
        first = last = math.nan
    if any(math.isnan(end) for end in (first, last) if end is not None) or not overlap((first, last), (first, last)):
        raise ReadError(f'{place}: window {text!r}: expected FROM:TO in seconds, such as "100:1000", "100:" or ":900"')
    return first, last
