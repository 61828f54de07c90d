"""Entries of TOML files: keys, numbers, units and scale factors, each refused with its place where it cannot be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from imulab.errors import ReadError, UnitError, listed, quoted
from imulab.units import Unit, parse_scale_factor, parse_unit


@dataclass(frozen=True, slots=True)
class ScaleFactor:
    """Output per unit of what is measured: its value, and the units of both."""

    value: float
    output: Unit
    measured: Unit


def scale_factor_of(entry: Any, place: str, example: str) -> ScaleFactor:
    """Return a scale factor ``{ value = 0.02, unit = "V/(deg/s)" }``; `example` is how the whole line is written."""
    value, unit = value_and_unit(entry, place, example)
    if value == 0:
        raise ReadError(f"{place}: expected a value other than 0")
    try:
        output, measured = parse_scale_factor(unit)
    except UnitError as error:
        raise UnitError(f"{place}: {error}") from None
    return ScaleFactor(value, output, measured)


def value_and_unit(entry: Any, place: str, example: str) -> tuple[float, str]:
    """Return both of ``{ value = 2.5, unit = "V" }``; `example` is how the whole line is written."""
    if not isinstance(entry, dict) or set(entry) != {"value", "unit"}:
        raise ReadError(f"{place}: expected {example}, found {quoted(entry)}")
    return number_of(entry["value"], place), str(entry["unit"])


def check_keys(table: Mapping[str, Any], keys: tuple[str, ...], place: str) -> None:
    """Refuse a key that is none of `keys`: a misspelt one must not pass."""
    for key in table:
        if key not in keys:
            raise ReadError(f"{place}: unknown key {quoted(key)}; known keys: {listed(keys, key)}")


def number_of(value: Any, place: str) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ReadError(f"{place}: expected a number, found {quoted(value)}")
    return float(value)


def unit_of(text: Any, kind: str, place: str) -> str:
    """Return the symbol of a unit of one kind."""
    try:
        unit = parse_unit(str(text))
    except UnitError as error:
        raise UnitError(f"{place}: {error}") from None
    if unit.quantity != kind:
        raise UnitError(f"{place}: expected a unit of {kind}, found {quoted(text)} ({unit.quantity})")
    return unit.symbol
