"""Entries of a manifest: numbers, units and keys, each refused with its place where it cannot be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from imulab.errors import ReadError, UnitError
from imulab.units import parse_unit, to_si


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


def check_keys(table: Mapping[str, Any], keys: tuple[str, ...], place: str) -> None:
    """Refuse a key that is none of `keys`: a misspelt one must not pass."""
    for key in table:
        if key not in keys:
            raise ReadError(f"{place}: unknown key {key!r}; known keys: {' '.join(keys)}")


def number_of(value: Any, place: str) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ReadError(f"{place}: expected a number, found {value!r}")
    return float(value)


def unit_of(text: Any, kind: str, place: str) -> str:
    """Return the symbol of a unit of one kind."""
    try:
        unit = parse_unit(str(text))
    except UnitError as error:
        raise UnitError(f"{place}: {error}") from None
    if unit.quantity != kind:
        raise UnitError(f"{place}: expected a unit of {kind}, found {text!r} ({unit.quantity})")
    return unit.symbol


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
