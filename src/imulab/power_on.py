"""What a file says about a power cycle: its temperature, and that its time counts from power-on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from imulab.errors import DataError, UnitError
from imulab.recording import Array, Recording
from imulab.units import parse_unit, to_si

TAKEN_FROM = "power_on_temperature_from"
"""Key of the head beside a power-on temperature that was not measured at power-on, but taken from elsewhere."""
LATEST_START = 5.0
"""A first sample later than this after power-on is refused, s."""
_SLOWEST, _FASTEST = 4.0, 2e-5
"""Sampling periods, s, that no recording of a warm-up has."""


def check_start(recording: Recording, first: float, latest: float) -> None:
    """Check that time counts from power-on.

    Raises
    ------
    DataError
        The first sample lies before power-on, or more than `latest`, s, after it.
    """
    if first < 0:
        raise DataError(
            f"{recording.name}: {recording.place(0)}, column time: starts {-first:.6g} s before power-on; "
            "expected time 0 at power-on"
        )
    if first > latest:
        raise DataError(
            f"{recording.name}: {recording.place(0)}, column time: the first sample is {first:.6g} s after power-on; "
            f"expected at most {latest:g} s (time 0 is power-on; --latest-start allows more)"
        )


def check_clock(recording: Recording, time: Array) -> None:
    """Check that times, s, are not of another unit than their column's title says.

    Raises
    ------
    DataError
        They are so far apart, or so close, as those of no recording of a warm-up.
    """
    if len(time) < 3:
        return
    step = float(np.median(np.diff(time)))
    if step > _SLOWEST or step < _FASTEST:
        other = "milliseconds titled as seconds" if step > _SLOWEST else "seconds titled as a smaller unit"
        raise DataError(
            f"{recording.name}: column time [{recording.units['time']}]: a sample every {step:.4g} s; "
            f"expected {_FASTEST:g} to {_SLOWEST:g} s: are these {other}?"
        )


def power_on_temperature(recording: Recording) -> float | None:
    """Return ``power_on_temperature`` of the head of the file, degC; None where it is missing, NaN where it is nan.

    Raises
    ------
    DataError
        It is there, but no temperature.
    """
    return head_temperature(recording, "power_on_temperature")


def first_reading(recording: Recording) -> float | None:
    """Return the first finite value of the column temperature, degC, or None where there is none."""
    if "temperature" not in recording or parse_unit(recording.units["temperature"]).quantity != "temperature":
        return None
    values = recording.column("temperature")
    finite = values[np.isfinite(values)]
    return to_si(float(finite[0]), recording.units["temperature"]) if finite.size else None


def with_power_on_temperature(blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Pass blocks on; where the head states no power-on temperature, the first reading of the first block stands in.

    Raises
    ------
    DataError
        Neither the head nor the column temperature of the first block holds one.
    """
    found: float | None = None
    for block in blocks:
        stated = power_on_temperature(block)
        if stated is not None and math.isfinite(stated):
            yield block
            continue
        found = first_reading(block) if found is None else found
        if found is None:
            raise DataError(
                f"{block.name}: no power_on_temperature in the head of the file, and no reading in a column "
                "temperature to take its place"
            )
        head = {"power_on_temperature": f"{found!r}", TAKEN_FROM: "the first reading of the column temperature"}
        yield replace(block, metadata={**block.metadata, **head})


def head_temperature(recording: Recording, key: str) -> float | None:
    """Return a temperature that the head of the file states, degC, or None where there is none.

    Raises
    ------
    DataError
        It is there, but no temperature.
    """
    text = recording.metadata.get(key)
    if text is None:
        return None
    number, _, symbol = text.strip().partition(" ")
    try:
        value, unit = float(number), parse_unit(symbol.strip() or "degC")
    except (ValueError, UnitError):
        value, unit = math.inf, None
    if unit is None or unit.quantity != "temperature" or math.isinf(value):
        raise DataError(f"{recording.name}: {key}: expected a temperature such as -20 or '-20 degC', found {text!r}")
    return to_si(value, unit.symbol)
